"""The site builds without a warning, its examples run, its tables are those of the code."""

import os
import pkgutil
import re
import runpy
import subprocess
import sys
import tomllib
from pathlib import Path

import browser
import pytest
from pages import run_page, shortened
from scripts import script

import jaxevent
from jaxevent.metrics import MEASURE_MEANINGS

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
WITH_CODE = [
    page.relative_to(DOCS).as_posix()
    for page in sorted(DOCS.rglob("*.md"))
    if "```" in page.read_text()
]


def generated(page: str) -> str:
    """Return a page that is made from the code."""
    return runpy.run_path(str(ROOT / "experiments" / "generated_pages.py"))[page]()


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The site, built without running the notebooks."""
    pytest.importorskip("jupytext", reason="needs the extra 'docs'")
    folder = tmp_path_factory.mktemp("site")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", folder],
        cwd=ROOT, capture_output=True, text=True,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1", "JAXEVENT_GALLERY": "0"},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return folder


@pytest.mark.slow
def test_the_site_needs_no_network(site):
    pages = list(site.rglob("*.html"))
    assert len(pages) > 40
    fetched = re.compile(
        r'<(?:script|img|link rel="stylesheet")[^>]+(?:src|href)="?https?://'
        r'|data-md-component="source"'  # for which the theme's script asks GitHub
    )
    assert not [page for page in pages if fetched.search(page.read_text())]


@pytest.mark.slow
def test_equations_are_set_as_mathematics(site, tmp_path):
    program = browser.find()
    if program is None:
        pytest.skip(f"no browser: none of {', '.join(browser.NAMES)} is installed")
    count = "document.querySelectorAll({!r}).length"
    with browser.Browser(program, tmp_path) as opened:
        for page in sorted((DOCS / "theory").glob("*.md")):
            opened.open(site / "theory" / page.stem / "index.html", 1200)
            opened.ask("MathJax.startup.promise")
            written = opened.ask(count.format(".arithmatex"))
            assert opened.ask(count.format("mjx-container")) == written > 10, page.stem
            assert opened.ask(count.format("[data-mml-node=merror]")) == 0, page.stem


@pytest.mark.slow
@pytest.mark.parametrize("page", WITH_CODE)
def test_examples_run(page, tmp_path, monkeypatch, float32):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(os, "environ", os.environ.copy())
    text = (DOCS / page).read_text()
    if page in ("extending.md", "fitting.md"):
        text = shortened(text, tmp_path / "short.h5")
    scope = run_page(text)
    if page == "fitting.md":  # frames that the filter is given would lead to 0.033
        fitted = scope["fitted"].params
        assert 0.065 < float(fitted.c_on) < 0.095 and 0.045 < float(fitted.c_off) < 0.065


def test_table_of_parameters_is_that_of_the_code():
    text = generated("parameters_page")
    for name, method in jaxevent.METHODS.items():
        own = text.split(f"### {name}\n")[1].split("\n### ")[0].split("\n## ")[0]
        values = method.Params().values()
        told = {}
        for row in re.findall(r"^\| `(\w+)` \| (.*?) \| .*? \| (.*?) \|", own, re.MULTILINE):
            setting, default, gradient = row
            told[setting] = tomllib.loads(f"value = {default}")["value"]
            assert not gradient or method.differentiable
        assert list(told) == list(method.Params.settings())
        for setting, value in values.items():  # numbers are shown to four digits
            number = isinstance(value, float | list)
            assert told[setting] == (pytest.approx(value, rel=1e-3) if number else value), setting


def test_the_page_of_measures_explains_every_number():
    text = generated("measures_page")
    rows = re.findall(r"^\| `([\w.]+)` \| (.*?) \| (.*) \|$", text, re.MULTILINE)
    assert [name for name, _, _ in rows] == list(MEASURE_MEANINGS)
    assert {title for _, title, _ in rows} >= {"MSE x 1e-2", "SSIM", "IDF1"}
    assert any("mean of |U - U_true|" in row[2].replace(r"\|", "|") for row in rows)


def test_toml_is_toml():
    for page in DOCS.rglob("*.md"):
        for block in re.findall(r"```toml\n(.*?)```", page.read_text(), re.DOTALL):
            tomllib.loads(block)


def test_every_page_is_in_the_navigation():
    nav = (ROOT / "mkdocs.yml").read_text()
    pages = [*DOCS.rglob("*.md"), *(page.with_suffix(".md") for page in DOCS.rglob("*.py"))]
    for page in pages:
        assert page.relative_to(DOCS).as_posix() in nav


def test_pages_are_short():
    """Results together, the start page, and every page but theory and formats."""
    words = {page.relative_to(DOCS).as_posix(): len(page.read_text().split())
             for page in DOCS.rglob("*.md")}  # fmt: skip
    assert words["index.md"] <= 1000
    assert sum(count for page, count in words.items() if page.startswith("results/")) < 7000
    for page, count in words.items():
        assert count <= 2500 or page.startswith("theory/") or page == "formats.md", page


def test_pages_of_the_reference_show_names_that_exist():
    pattern = re.compile(r"^::: ([\w.]+)\n    options: \{.*?members: \[(.*?)\]", re.M)
    shown = [
        found for page in (DOCS / "api").glob("*.md") for found in pattern.findall(page.read_text())
    ]
    assert len(shown) > 10
    for module, members in shown:
        known = dir(pkgutil.resolve_name(module))
        assert {name.strip() for name in members.split(",")} <= {*known}, module


def test_the_page_of_guards_lists_the_faults_that_can_be_put_in():
    page = (DOCS / "guards.md").read_text()
    rows = re.findall(r"^\| (.*?) \| `(.*?)` \| `.*?` \| caught \|$", page, re.MULTILINE)
    mutations = script("mutations").MUTATIONS
    assert rows == [(one.fault, one.file) for one in mutations]
    for one in mutations:
        assert one.old in (ROOT / one.file).read_text(), one.fault


def test_links_within_the_site_lead_to_its_pages():
    """MkDocs checks them, too, where the extra `docs` is installed."""
    link = re.compile(r"\]\(([^)#:]+)(?:#[^)]*)?\)")
    known = {page.relative_to(DOCS).as_posix() for page in DOCS.rglob("*") if page.is_file()}
    known |= {page.removesuffix(".py") + ".md" for page in known if page.endswith(".py")}
    known |= {"parameters.md", "measures.md", "security.md", "changelog.md"}  # made by the build
    count = 0
    for page in DOCS.rglob("*.md"):
        for place in link.findall(page.read_text()):
            where = os.path.normpath(page.relative_to(DOCS).parent / place)
            assert where in known, (page.name, place)
            count += 1
    assert count > 80


def test_links_of_other_pages_lead_somewhere():
    link = re.compile(r"\]\(((?:https://github.com/jaxevent/jaxevent/blob/main/)?)([^)#]+)[^)]*\)")
    pages = [*ROOT.glob("*.md"), *(ROOT / "experiments" / "studies").glob("*.md")]
    count = 0
    for page in pages:
        for absolute, place in link.findall(page.read_text()):
            if absolute or "://" not in place:
                assert ((ROOT if absolute else page.parent) / place).exists(), (page.name, place)
                count += 1
    assert count > 50
