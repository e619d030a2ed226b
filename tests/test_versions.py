"""Every core dependency has a lower bound, which is the oldest version in docs/versions.md."""

import re
import tomllib
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.version import Version

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
CORE = [Requirement(line) for line in PROJECT["dependencies"]]


def rows() -> dict[str, list[str]]:
    """The table of the page: each row's cells by its first."""
    lines = re.findall(r"^\| (.*) \|$", (ROOT / "docs/versions.md").read_text(), re.MULTILINE)
    split = [[cell.strip() for cell in line.split("|")] for line in lines]
    return {first: cells for first, *cells in split}


@pytest.mark.parametrize("one", CORE, ids=lambda one: one.name)
def test_a_core_dependency_has_a_bound_that_was_tried(one):
    (bound,) = (Version(s.version) for s in one.specifier if s.operator == ">=")
    tried = [Version(cell) for cell in rows()[one.name]]
    assert min(tried) == bound
    assert metadata.version(one.name) in one.specifier


def test_every_version_that_was_tried_works():
    heads, results = (next(c for f, c in rows().items() if f == name) for name in ("", "result"))
    assert len(heads) == len(results) >= 2
    assert all(re.fullmatch(r"all \d+ parts work", result) for result in results)
    pythons = {re.search(r"3\.\d+", head)[0] for head in heads}
    named = {c.rsplit(" ", 1)[1] for c in PROJECT["classifiers"] if ":: Python :: 3." in c}
    assert pythons <= named and f"oldest, Python {min(named, key=Version)}" in heads
