"""The report of an evaluation as a browser shows it: layout, sorting, enlarging, dark mode."""

from pathlib import Path

import browser
import numpy as np
import pytest

from jaxevent.runs.scores import Sample
from jaxevent.show.page import page, picture

METHODS = ["akf", "cf", "a method whose label is as long as labels get", "blend"]
RECORDINGS = ["/data/somewhere/far/away/night_run_with_a_rather_long_name.h5", "/data/day.h5"]


def report() -> str:
    """Of two recordings and four methods, one of which failed once."""
    rng = np.random.default_rng(0)
    rows, pictures = [], []
    y, x = np.mgrid[:90, :120]
    truth = 0.5 + 0.4 * np.sin(x / 9) * np.cos(y / 7)
    for recording in RECORDINGS:
        for place, method in enumerate(METHODS):
            row = {"recording": recording, "method": method, "params": {"c_on": 0.1}}
            if place == 3 and recording == RECORDINGS[0]:
                said = f"{recording}: no frame and no event between 0 and 1 us; give another span"
                rows.append({**row, "error": said})
                pictures.append(None)
                continue
            mse = 0.002 * (1 + place) * rng.uniform(0.8, 1.25, 200)
            series = {"t": [*range(0, 2_000_000, 10_000)], "mse": [*mse], "ssim": [*(1 - 9 * mse)]}
            rows.append({
                **row, "mse": mse.mean(), "ssim": (1 - 9 * mse).mean(), "frames": 200,
                "events": 1000, "seconds": 9.0 + 2 * place, "per_frame": series,
            })  # fmt: skip
            image = truth + 0.03 * rng.normal(size=truth.shape)
            deviation = np.full(truth.shape, 0.01) if place == 0 else None
            pictures.append(picture(Sample(1_000_000, image, truth, False, deviation, truth)))
    return page(rows, pictures, "held-out", "recordings = []\n", ["here"], "compare.toml")


@pytest.fixture(scope="module")
def path(tmp_path_factory) -> Path:
    file = tmp_path_factory.mktemp("page") / "report.html"
    file.write_text(report(), encoding="utf-8")
    return file


@pytest.fixture(scope="module")
def tab(tmp_path_factory):
    program = browser.find()
    if program is None:
        pytest.skip(f"no browser: none of {', '.join(browser.NAMES)} is installed")
    with browser.Browser(program, tmp_path_factory.mktemp("profile")) as opened:
        yield opened


@pytest.mark.slow
@pytest.mark.parametrize("width", [420, 1600])
def test_nothing_is_wider_than_the_window(tab, path, width):
    tab.open(path, width)
    assert tab.ask("innerWidth") == width
    assert tab.ask("document.documentElement.scrollWidth") <= width
    # Tables may scroll within themselves; nothing else is cut off.
    cut = """[...document.querySelectorAll("body *")].filter(e => !e.closest(".scroll, dialog, pre")
        && e.getBoundingClientRect().right > innerWidth + 0.5).map(e => e.outerHTML.slice(0, 80))"""
    assert tab.ask(cut) == []
    images = tab.ask("""[...document.querySelectorAll("img[src]")].map(e => [e.className,
        e.naturalWidth, e.getBoundingClientRect().width, e.alt])""")
    # Six plots; of each recording the truth and the frame before, and two or three for each method.
    assert len(images) == 6 + (2 + 3 + 2 + 2) + (2 + 3 + 2 + 2 + 2)
    for kind, own, shown, alt in images:
        assert own > 0 and alt, "an image that does not load, or without a name"
        # Of a plot 4.5 inches wide letters of 10 pt are at least 9 pt large.
        assert shown >= (0.88 * 4.5 * 96 if kind == "plot" else 200)


@pytest.mark.slow
def test_recordings_are_called_by_name(tab, path):
    tab.open(path, 1600)
    text = tab.ask("document.body.innerText")
    assert "night_run_with_a_rather_long_name.h5 at 1.000 s" in text
    cells = tab.ask("""[...document.querySelectorAll("td")].map(e => [e.textContent, e.title])""")
    assert ["day.h5", "/data/day.h5"] in cells
    assert not any(text.startswith("/data/day") for text, _ in cells)


@pytest.mark.slow
def test_a_click_on_a_title_sorts(tab, path):
    tab.open(path, 1600)
    table = 'document.querySelectorAll("table.sortable")[1]'
    column = f'[...{table}.tBodies[0].rows].map(r => r.cells[5]?.textContent ?? "")'
    head = f"{table}.tHead.rows[0].cells[5]"
    assert tab.ask(f"{head}.textContent") == "seconds"
    assert tab.ask(column) == ["9.00", "11.00", "13.00", "", "9.00", "11.00", "13.00", "15.00"]
    tab.click(head)
    # As numbers, and what has none comes last.
    up = ["9.00", "9.00", "11.00", "11.00", "13.00", "13.00", "15.00", ""]
    assert tab.ask(column) == up and tab.ask(f"{head}.ariaSort") == "ascending"
    tab.click(head)
    assert tab.ask(column) == [*up[-2::-1], ""]
    tab.click(f"{table}.tHead.rows[0].cells[1]")
    methods = tab.ask(f"[...{table}.tBodies[0].rows].map(r => r.cells[1].textContent)")
    assert methods == sorted(methods)


@pytest.mark.slow
def test_the_pointer_marks_a_row_and_titles_say_what_they_mean(tab, path):
    tab.open(path, 1600)
    row = 'document.querySelector("tbody tr")'
    colour = f"getComputedStyle({row}).backgroundColor"
    before = tab.ask(colour)
    tab.hover(f"{row}.cells[0]")
    assert tab.ask(colour) != before
    titles = dict(tab.ask('[...document.querySelectorAll("th")].map(e => [e.innerText, e.title])'))
    assert "mean square error" in titles["MSE x 1e-2"] and "similarity" in titles["SSIM"]


@pytest.mark.slow
@pytest.mark.parametrize("width", [420, 1600])
def test_a_picture_is_enlarged_by_a_click_or_the_keyboard(tab, path, width):
    tab.open(path, width)
    picture = 'document.querySelectorAll("figure img")[2]'
    small = tab.ask(f"{picture}.getBoundingClientRect().width")
    large = 'document.querySelector("dialog img")'
    is_open = 'document.querySelector("dialog").open'
    assert not tab.ask(is_open)
    tab.click(picture)
    assert tab.ask(is_open) and tab.ask(f"{large}.src === {picture}.src")
    box = tab.ask(
        f"(({{left, right, width}}) => [left, right, width])({large}.getBoundingClientRect())"
    )
    assert 0 <= box[0] and box[1] <= width and box[2] > min(2 * small, 0.9 * width - 20)
    tab.click(large)
    assert not tab.ask(is_open)
    tab.ask(f"{picture}.focus()")
    tab.press("Enter", 13)
    assert tab.ask(is_open)
    tab.press("Escape", 27)
    assert not tab.ask(is_open)


LIGHTNESS = """(() => {{ const light = c => {{ const [r, g, b] = c.match(/[0-9.]+/g).map(v => {{
    v = v / 255; return v <= 0.03928 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4; }});
    return 0.2126 * r + 0.7152 * g + 0.0722 * b; }};
  const paper = light(getComputedStyle(document.body).backgroundColor);
  return [paper, ...[...document.querySelectorAll("h1, .meta, .note, td, th, figcaption, pre")]
    .map(e => light(getComputedStyle(e).color))]; }})()""".replace("{{", "{").replace("}}", "}")


@pytest.mark.slow
@pytest.mark.parametrize("dark", [False, True])
def test_text_can_be_read_in_the_light_and_in_the_dark(tab, path, dark):
    """The contrast ratio of WCAG 2 is 4.5 or more; plots follow the page."""
    tab.open(path, 1600, dark=dark)
    paper, *inks = tab.ask(LIGHTNESS)
    assert (paper < 0.05) == dark
    for ink in inks:
        high, low = max(paper, ink), min(paper, ink)
        assert (high + 0.05) / (low + 0.05) >= 4.5
    style = tab.ask('getComputedStyle(document.querySelector("img.plot")).filter')
    assert ("invert" in style) == dark
