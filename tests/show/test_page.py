"""The report of an evaluation as a browser shows it: layout, plots, sorting, comparing, dark."""

import base64
import itertools
import json
import re
from io import BytesIO
from pathlib import Path

import browser
import numpy as np
import pytest
from PIL import Image

from jaxevent.runs.scores import Sample
from jaxevent.show.images import COLOURS, DARK_COLOURS
from jaxevent.show.page import page, picture, spread_rows

METHODS = ["akf", "cf", "a method whose label is as long as labels get", "blend"]
RECORDINGS = ["/data/somewhere/far/away/night_run_with_a_rather_long_name.h5", "/data/day.h5"]
WIDTHS = [400, 1400]
TIMES = [500_000, 1_000_000, 1_500_000]  # of pictures, us


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
            deviation = np.full(truth.shape, 0.01) if place == 0 else None
            pictures.append([
                picture(Sample(
                    t, truth + 0.03 * rng.normal(size=truth.shape), truth, False, deviation, truth
                ))
                for t in TIMES
            ])  # fmt: skip
    title = "compare </script><b>.toml"
    return page(rows, pictures, "held-out", "recordings = []\n", ["here"], title)


@pytest.mark.parametrize(
    ("higher", "marked", "title"),
    [
        (True, ["0.9000"], ", higher is better"),
        (False, ["0.2000"], ", lower is better"),
        (None, [], ""),
    ],
)
def test_the_best_of_an_own_metric_is_marked_if_it_says_which(higher, marked, title):
    row = {"recording": "a", "params": {}, "frames": 1, "events": 9, "seconds": 1.0}
    rows = [
        {
            **row,
            "method": name,
            "gain": gain,
            "own_metrics": {"gain": higher},
            "per_frame": {"t": [0], "gain": [gain]},
        }
        for name, gain in (("akf", 0.2), ("cf", 0.9))
    ]
    text = page(rows, [None, None], "held-out", "", [], "gain")
    assert re.findall(r'class="?best"?>([^<]*)<', text) == marked
    assert f'"title":"gain{title}"' in text


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
@pytest.mark.parametrize("width", WIDTHS)
def test_nothing_is_wider_than_the_window(tab, path, width):
    tab.open(path, width)
    assert tab.errors == []
    assert tab.ask("innerWidth") == width
    assert tab.ask("document.documentElement.scrollWidth") <= width
    # Tables may scroll within themselves; nothing else is cut off.
    cut = """[...document.querySelectorAll("body *")].filter(e => !e.closest(".scroll, dialog, pre")
        && e.getBoundingClientRect().right > innerWidth + 0.5).map(e => e.outerHTML.slice(0, 80))"""
    assert tab.ask(cut) == []
    images = tab.ask("""[...document.querySelectorAll("img[src]")].map(e => [e.naturalWidth,
        e.getBoundingClientRect().width, e.alt])""")
    # Of each recording the truth and the frame before, and two or three for each method.
    assert len(images) == (2 + 3 + 2 + 2) + (2 + 3 + 2 + 2 + 2)
    for own, shown, alt in images:
        assert own == 120 and shown >= 150 and alt


@pytest.mark.slow
@pytest.mark.parametrize("width", WIDTHS)
def test_labels_do_not_overlap_and_every_line_has_a_legend(tab, path, width):
    tab.open(path, width)
    boxes = tab.ask("""[...document.querySelectorAll("#spreads svg, .curves svg")].map(s =>
        [...s.querySelectorAll("text")].map(e => { const r = e.getBoundingClientRect();
            return [e.textContent, r.left, r.right, r.top, r.bottom]; }))""")
    assert len(boxes) == 2 + 2
    for texts in boxes:
        for one, other in itertools.combinations(texts, 2):
            apart = one[1] >= other[2] or other[1] >= one[2]
            assert apart or one[3] >= other[4] - 2 or other[3] >= one[4] - 2, (one, other)
        assert sum(bool(re.fullmatch(r"[-\d.e]+", text)) for text, *_ in texts) >= 4
    strokes = 'map(e => [e.getAttribute("stroke"), e.getAttribute("stroke-dasharray")])'
    for number, methods in enumerate((METHODS[:3], METHODS)):
        part = f'document.querySelectorAll("#recordings > section")[{number}]'
        drawn = tab.ask(f'[...{part}.querySelectorAll(".curve")].{strokes}')
        legend = tab.ask(f'[...{part}.querySelectorAll(".legend path")].{strokes}')
        names = tab.ask(f'[...{part}.querySelectorAll(".legend span")].map(e => e.innerText)')
        assert names == [*methods, "times of pictures: click to see them"]
        assert drawn == legend[: len(methods)] and len({*map(tuple, drawn)}) == len(methods)
    parts = tab.ask('[...document.querySelectorAll("#spread-legend span")].map(e => e.innerText)')
    assert len(parts) == 5  # box, median, whiskers, dots, mean


@pytest.mark.slow
def test_plots_have_the_units_and_numbers_of_the_table(tab, path):
    tab.open(path, 1400)
    titles = tab.ask('[...document.querySelectorAll("#spreads h3")].map(e => e.innerText)')
    assert titles == ["MSE x 1e-2, lower is better", "SSIM, higher is better"]
    heads = tab.ask('[...document.querySelectorAll("table")[0].rows[0].cells].map(e=>e.innerText)')
    assert [title.partition(",")[0] for title in titles] == heads[2:4]
    for column, title in enumerate(heads[2:4]):
        cells = f'[...document.querySelectorAll("table")[0].tBodies[0].rows].map(r => r.cells[{2 + column}].innerText)'  # noqa: E501
        means = tab.ask(cells)
        right = f'[...document.querySelectorAll("#spreads svg")[{column}].querySelectorAll("text[text-anchor=end]")].map(e => e.textContent)'  # noqa: E501
        assert tab.ask(right) == means, title
    data = json.loads(tab.ask('document.getElementById("data").textContent'))
    rng = np.random.default_rng(0)
    mse = 0.002 * rng.uniform(0.8, 1.25, 200)  # of the first method and recording
    curve = data["recordings"][0]["curves"]["lines"][0]["values"]
    np.testing.assert_allclose(curve, 100 * mse, rtol=1e-4)


@pytest.mark.slow
def test_recordings_are_called_by_name(tab, path):
    tab.open(path, 1400)
    assert tab.ask("document.title") == "compare </script><b>.toml"
    text = tab.ask("document.body.innerText")
    assert "night_run_with_a_rather_long_name.h5\n" in text
    cells = tab.ask("""[...document.querySelectorAll("td")].map(e => [e.textContent, e.title])""")
    assert ["day.h5", "/data/day.h5"] in cells
    assert not any(text.startswith("/data/day") for text, _ in cells)


@pytest.mark.slow
def test_a_click_or_a_key_on_a_title_sorts(tab, path):
    tab.open(path, 1400)
    table = 'document.querySelectorAll("table")[1]'
    column = f'[...{table}.tBodies[0].rows].map(r => r.cells[5]?.textContent ?? "")'
    head = f"{table}.tHead.rows[0].cells[5]"
    assert tab.ask(f"{head}.textContent") == "seconds"
    assert tab.ask(column) == ["9.00", "11.00", "13.00", "", "9.00", "11.00", "13.00", "15.00"]
    tab.click(head)
    # As numbers, and what has none comes last.
    up = ["9.00", "9.00", "11.00", "11.00", "13.00", "13.00", "15.00", ""]
    assert tab.ask(column) == up and tab.ask(f"{head}.ariaSort") == "ascending"
    tab.ask(f"{head}.firstChild.focus()")
    tab.press("Enter", 13)
    assert tab.ask(column) == [*up[-2::-1], ""]
    tab.click(f"{table}.tHead.rows[0].cells[1]")
    methods = tab.ask(f"[...{table}.tBodies[0].rows].map(r => r.cells[1].textContent)")
    assert methods == sorted(methods)


@pytest.mark.slow
def test_the_pointer_marks_a_row_and_titles_say_what_they_mean(tab, path):
    tab.open(path, 1400)
    row = 'document.querySelector("tbody tr")'
    colour = f"getComputedStyle({row}).backgroundColor"
    before = tab.ask(colour)
    tab.hover(f"{row}.cells[0]")
    assert tab.ask(colour) != before
    titles = dict(tab.ask('[...document.querySelectorAll("th")].map(e => [e.innerText, e.title])'))
    assert "mean square error" in titles["MSE x 1e-2"] and "similarity" in titles["SSIM"]


@pytest.mark.slow
def test_errors_over_time_choose_the_pictures(tab, path):
    tab.open(path, 1400)
    data = json.loads(tab.ask('document.getElementById("data").textContent'))
    part = 'document.querySelectorAll("#recordings > section")[1]'
    sources = f'[...{part}.querySelectorAll("img")].map(e => e.src.split(",")[1])'

    def shown() -> tuple[str, int]:
        there = tab.ask(sources)
        figures = data["recordings"][1]["figures"]
        by_time = zip(
            *(one for figure in figures for one in figure["images"].values()), strict=True
        )
        return tab.ask(f'{part}.querySelector("output").value'), [*map(list, by_time)].index(there)

    assert shown() == ("pictures at 1.000 s", 1)
    last = f'{part}.querySelectorAll(".time")[2]'
    tab.click(last)
    assert shown() == ("pictures at 1.500 s", 2)
    tab.ask(f'{part}.querySelector("input").focus()')
    tab.press("ArrowLeft", 37)
    tab.press("ArrowLeft", 37)
    assert shown() == ("pictures at 0.500 s", 0)
    assert tab.errors == []


@pytest.mark.slow
@pytest.mark.parametrize("width", WIDTHS)
def test_a_click_or_a_key_on_a_picture_compares_it(tab, path, width):
    """Left of the border is the picture that was clicked, right of it the truth."""
    tab.open(path, width)
    button = 'document.querySelectorAll(".picture")[2]'
    small = tab.ask(f"{button}.getBoundingClientRect().width")
    is_open = 'document.querySelector("dialog").open'
    assert not tab.ask(is_open)
    tab.click(button)
    assert tab.ask(is_open)
    under, over = (f'document.querySelectorAll(".both img")[{k}]' for k in (0, 1))
    assert tab.ask(f"{over}.src === {button}.firstChild.src")
    assert tab.ask(f"[{under}.alt, {over}.alt]") == ["truth", "akf"]
    box = tab.ask(
        f"(({{left, right, width}}) => [left, right, width])({under}.getBoundingClientRect())"
    )
    assert 0 <= box[0] and box[1] <= width and box[2] > min(2 * small, 0.9 * width - 30)
    cut = f"getComputedStyle({over}).clipPath"
    assert tab.ask(cut) == "inset(0px 50% 0px 0px)"
    tab.press("ArrowRight", 39)
    assert tab.ask(cut) == "inset(0px 49% 0px 0px)"
    choose = 'document.querySelectorAll("dialog select")[1]'
    tab.ask(f'{choose}.value = "3"; {choose}.onchange()')
    assert tab.ask(f"{under}.alt") == "akf, error"
    tab.press("Escape", 27)
    assert not tab.ask(is_open)
    tab.ask(f"{button}.focus()")
    tab.press("Enter", 13)
    assert tab.ask(is_open)
    tab.click('document.querySelector("dialog button")')
    assert not tab.ask(is_open) and tab.errors == []


@pytest.mark.slow
def test_all_that_can_be_used_is_reached_by_the_tab_key(tab, path):
    tab.open(path, 1400)
    wanted = tab.ask("""[...document.querySelectorAll("body :is(button, input, summary, .scroll)")]
        .filter(e => !e.closest("dialog, details :not(summary)") && e.offsetParent).length""")
    assert wanted > 30
    seen = "window.seen = new Set(); document.addEventListener('focusin', e => seen.add(e.target))"
    tab.ask(f"{seen}; 0")
    for _ in range(wanted + 2):
        tab.press("Tab", 9)
    assert tab.ask("seen.size") >= wanted


LIGHTNESS = """(() => {{ const light = c => {{ const [r, g, b] = c.match(/[0-9.]+/g).map(v => {{
    v = v / 255; return v <= 0.03928 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4; }});
    return 0.2126 * r + 0.7152 * g + 0.0722 * b; }};
  const paper = light(getComputedStyle(document.body).backgroundColor);
  const ink = [...document.querySelectorAll("h1, .meta, .note, td, th, figcaption, pre, .legend")];
  return [paper, [...ink.map(e => getComputedStyle(e).color),
    ...[...document.querySelectorAll("svg text")].map(e => getComputedStyle(e).fill)].map(light),
    [...document.querySelectorAll(".curve")].map(e => light(getComputedStyle(e).stroke))];
  }})()""".replace("{{", "{").replace("}}", "}")


@pytest.mark.slow
@pytest.mark.parametrize("dark", [False, True])
def test_text_and_lines_can_be_seen_in_the_light_and_in_the_dark(tab, path, dark):
    """The contrast ratio of WCAG 2 is 4.5 or more for text, 3 or more for lines."""
    tab.open(path, 1400, dark=dark)
    paper, inks, lines = tab.ask(LIGHTNESS)
    assert (paper < 0.05) == dark
    for least, values in ((4.5, inks), (3.0, lines)):
        for value in values:
            high, low = max(paper, value), min(paper, value)
            assert (high + 0.05) / (low + 0.05) >= least


# Linear red, green and blue to eyes without one kind of cone (Machado et al. 2009).
VISIONS = {
    "all cones": np.eye(3),
    "no long": [[0.1523, 1.0526, -0.2049], [0.1145, 0.7863, 0.0992], [-0.0039, -0.0481, 1.0520]],
    "no middle": [[0.3673, 0.8606, -0.2280], [0.2801, 0.6725, 0.0474], [-0.0118, 0.0429, 0.9689]],
    "no short": [[1.2555, -0.0767, -0.1788], [-0.0784, 0.9308, 0.1476], [0.0047, 0.6914, 0.3039]],
}


def lab(colour: str, vision) -> np.ndarray:
    """CIELAB of a colour as an eye sees it."""
    c = np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)]) / 255
    linear = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
    linear = (np.array(vision) @ linear).clip(0, 1)
    to_xyz = [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]
    X, Y, Z = np.cbrt(np.array(to_xyz) @ linear / [0.9505, 1.0, 1.089])
    return np.array([116 * Y - 16, 500 * (X - Y), 200 * (Y - Z)])


@pytest.mark.parametrize("colours", [COLOURS, DARK_COLOURS], ids=["light", "dark"])
@pytest.mark.parametrize("vision", VISIONS)
def test_colours_differ_to_every_eye(colours, vision):
    seen = [lab(one, VISIONS[vision]) for one in colours]
    assert min(np.linalg.norm(a - b) for a, b in itertools.combinations(seen, 2)) > 28


def test_pictures_are_spread_with_the_middle_among_them():
    for count, most in itertools.product(range(1, 40), (1, 3, 5)):
        rows = spread_rows(count, most)
        assert len(set(rows)) == min(count, most) and sorted(rows) == rows
        assert 0 <= rows[0] and rows[-1] < count
        assert count // 2 in rows or len(rows) % 2 == 0
    assert spread_rows(0, 5) == []


def test_a_dark_picture_is_shown_with_the_brightest_as_white():
    """Half of the brightest light is grey 188 of sRGB, of the truth and the estimate alike."""
    truth = np.full((40, 50), 0.1)
    truth[:, :25] = 0.05
    shown = picture(Sample(0, truth, truth, False))
    for name in ("image", "truth"):
        grey = np.asarray(Image.open(BytesIO(base64.b64decode(shown[name]))))
        assert grey[0, 0] == 188 and grey[0, -1] == 255
