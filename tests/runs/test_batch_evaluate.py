"""Many recordings, methods and parameters: what is computed where, how often, and what it says."""

import base64
import html.parser
import io
import json
import logging
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import jax
import numpy as np
import pytest
from errands import log
from noise import ONE, small, write_config
from PIL import Image
from pyarrow import parquet

import jaxevent
from jaxevent import cli
from jaxevent.methods import METHODS
from jaxevent.reconstruction.video import N_BATCH_IMAGES
from jaxevent.recording import Frames, Recording
from jaxevent.runs.evaluate import evaluate
from jaxevent.runs.scores import MEASURE_FUNCTIONS, score

SEVERAL = """
recordings = ["*.h5"]
[[method]]
name = "blend"
grid = { clock_offset = [0.0, 0.001, 0.002, 0.003, 0.004, 0.005, 0.006, 0.007, 0.008] }
[[method]]
name = "cf"
"""


def long(seed: int) -> Recording:
    """60 frames of noise and few events, which takes some time to score."""
    rng = np.random.default_rng(seed)
    t = 10_000 * np.arange(60)
    images = rng.integers(0, 256, (60, 60, 80)).astype(np.uint8)
    return small(width=80, height=60, frames=Frames(t, images, np.zeros_like(t)))


TASKS = 20


def untimed(rows: list[dict]) -> list[dict]:
    return [{key: value for key, value in row.items() if key != "seconds"} for row in rows]


@pytest.mark.slow
def test_a_grid_is_every_combination(tmp_path):
    jaxevent.save(small(), tmp_path / "small.h5")
    text = """
    recordings = ["small.h5"]
    [[method]]
    name = "cf"
    label = "mine"
    params = { I0 = 2, c_on = 0.3 }
    grid = { c_off = [0.0, 0.1], I0 = [1, 0.5], deblur = [false] }
    """
    rows = evaluate(write_config(tmp_path, text))
    points = [(0.0, 1), (0.0, 0.5), (0.1, 1), (0.1, 0.5)]
    assert [row["method"] for row in rows] == [
        f"mine, c_off {c_off:g}, I0 {I0:g}, deblur False" for c_off, I0 in points
    ]
    for row, (c_off, I0) in zip(rows, points, strict=True):
        params = METHODS["cf"].Params(c_on=0.3, c_off=c_off, I0=I0, deblur=False)
        assert row["params"].items() >= {"c_on": 0.3, "c_off": c_off, "I0": I0}.items()
        assert row["mse"] == pytest.approx(score(small(), METHODS["cf"], params)["mse"])
    assert rows[0]["mse"] != rows[2]["mse"]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("grid = 3", "grid is 3; give a table of lists"),
        ("grid = { I0 = 1 }", "grid is .*give a table of lists"),
        ("grid = { I0 = [] }", "grid is .*give a table of lists"),
        ("grid = { c_onn = [1] }", "no parameter 'c_onn'; did you mean 'c_on'"),
        ("grid = { I0 = [1, -1] }", "I0 is -1"),
        ("grid = { I0 = [1, 1] }", "another one is labelled 'blend, I0 1' too"),
        ('grid = { preset = ["paper"] }', r"add a \[\[method\]\] for each preset"),
        ('[[method]]\nname = "blend"', "2: another one is labelled 'blend' too; add a label"),
        ('normalise = "yes"', "normalise is 'yes'; give 'none' or 'affine'"),
    ],
)
def test_grids_that_cannot_be(text, said, tmp_path):
    with pytest.raises(jaxevent.InputError, match=f"run.toml: method .*{said}"):
        evaluate(write_config(tmp_path, ONE + text))


def test_only_what_changed_is_computed(tmp_path, monkeypatch):
    monkeypatch.setattr("jaxevent.show.page.page", lambda *arguments: "")
    out = tmp_path / "out"
    path = tmp_path / "small.h5"
    jaxevent.save(small(), path)
    evaluate(write_config(tmp_path, ONE), out)

    def computed(text: str = ONE) -> int:
        before = len(log(out / "tasks", "started"))
        evaluate(write_config(tmp_path, text), out)
        return len(log(out / "tasks", "started")) - before

    assert computed() == 0
    os.utime(path, (1e9, 1e9))  # as old files are, of which the hash is kept
    assert computed() == 0 and computed() == 0
    shutil.copy(path, tmp_path / "copy.h5")
    assert computed(ONE.replace("small", "copy") + 'label = "other"') == 0
    assert computed(ONE + "params = { clock_offset = 0.0 }") == 0  # the default
    assert computed(ONE + "params = { clock_offset = 0.001 }") == 1
    assert computed(ONE.replace("blend", "last-frame")) == 1
    assert computed(ONE + 'normalise = "affine"') == 1
    assert computed('metrics = ["global_ssim"]\n' + ONE) == 1
    assert computed("size = [24, 20]\n" + ONE) == 1
    assert computed() == 0
    frames = small().frames
    assert isinstance(frames, Frames)
    images = np.asarray(frames.images).copy()
    images[1] = 255 - images[1]
    jaxevent.save(small(frames=Frames(frames.t, images, frames.exposure)), path)
    os.utime(path, (2e9, 2e9))
    assert computed() == 1
    text = (out / "results.json").read_text()
    assert json.loads(text)["rows"][0]["mse"] == score(jaxevent.load(path), METHODS["blend"])["mse"]


@pytest.mark.slow
def test_folders_are_known_by_all_their_files(tmp_path):
    folder = tmp_path / "folder"
    (folder / "images").mkdir(parents=True)
    frames = small().frames
    lines = []
    for row, (t, image) in enumerate(zip(frames.t, np.asarray(frames.images), strict=True)):
        Image.fromarray(image).save(folder / "images" / f"{row}.png")
        lines.append(f"{t / 1e6:.6f} images/{row}.png\n")
    (folder / "images.txt").write_text("".join(lines))
    events = small().events
    columns = np.stack([events.t / 1e6, events.x, events.y, events.p], axis=1)
    np.savetxt(folder / "events.txt", columns, "%.6f %d %d %d")
    config, out = write_config(tmp_path, ONE.replace("small.h5", "folder")), tmp_path / "out"
    (row,) = evaluate(config, out)
    assert evaluate(config, out) == [row]
    assert row["mse"] == pytest.approx(score(small(), METHODS["blend"])["mse"])
    Image.fromarray(255 - np.asarray(frames.images[1])).save(folder / "images" / "1.png")
    (other,) = evaluate(config, out)
    assert other["mse"] != row["mse"]
    assert len(log(out / "tasks", "finished")) == 2


@pytest.mark.slow
def test_a_bad_recording_does_not_stop_the_others(tmp_path, capsys):
    jaxevent.save(small(), tmp_path / "a.h5")
    (tmp_path / "b<i>.h5").write_bytes(b"not a recording")
    jaxevent.save(small(frames=None), tmp_path / "c.h5")
    text = (
        'recordings = ["*.h5"]\n[[method]]\nname = "blend"\n'
        '[[method]]\nname = "high-pass"\nlabel = "<b>events & more"'
    )
    config, out = write_config(tmp_path, text), tmp_path / "out"
    assert cli.main(["evaluate", str(config), "--out", str(out)]) == 0
    said = capsys.readouterr()
    assert said.err == "jaxevent: 4 of 6 rows failed, see below them\n"
    rows = json.loads((out / "results.json").read_text())["rows"]
    assert ["error" in row for row in rows] == [False, False, True, True, True, True]
    assert [row["recording"] for row in rows[::2]] == ["a.h5", "b<i>.h5", "c.h5"]
    assert rows[2]["error"].startswith(f"{tmp_path / 'b<i>.h5'}: the format is not recognised")
    assert rows[2]["params"] == rows[0]["params"]
    assert said.out.startswith((out / "results.md").read_text())
    assert f"failed (2): {rows[2]['error']}" in said.out
    assert re.search(r"\| c.h5 +\| blend +\| +- \| +- \| +- \| +- \|\n", said.out)

    table = parquet.read_table(out / "results.parquet").to_pylist()
    for row, flat in zip(rows, table, strict=True):
        assert flat["error"] == row.get("error") and flat["mse"] == row.get("mse")
        assert flat["params.c_on"] == row["params"]["c_on"]
        assert flat["per_frame.t"] == row.get("per_frame", {}).get("t")
    assert {type(flat["frames"]) for flat in table[:2]} == {int}

    page = (out / "report.html").read_text()
    assert "<i>" not in page and "<b>" not in page
    assert "4 of 6 failed" in page and page.count("has 0 frames") == 2 + 2
    (tmp_path / "a.h5").unlink()
    before = (out / "results.json").read_bytes()
    assert cli.main(["evaluate", str(config), "--out", str(out)]) == 2
    said = capsys.readouterr()
    assert said.out == "" and said.err.count("\n") == 1
    assert said.err.endswith("(and 1 further errors)\n")
    assert (out / "results.json").read_bytes() == before


def test_errors_of_other_kinds_are_rows_too(tmp_path, monkeypatch):
    def broken(*arguments):
        raise ZeroDivisionError("by zero")

    jaxevent.save(small(), tmp_path / "small.h5")
    monkeypatch.setitem(MEASURE_FUNCTIONS, "global_ssim", broken)
    config = write_config(tmp_path, 'metrics = ["global_ssim"]\n' + ONE)
    with pytest.raises(jaxevent.InputError, match="^ZeroDivisionError: by zero$"):
        evaluate(config, tmp_path / "out")
    assert not (tmp_path / "out").exists()


class Page(html.parser.HTMLParser):
    """What a page shows, and that its tags are closed in turn."""

    VOID = ("img", "meta", "br", "link", "input")

    def __init__(self, text: str):
        super().__init__()
        self.open: list[str] = []
        self.links: list[str] = []
        self.cells: list[str] = []
        self.data: dict = {}
        self.feed(text)
        assert not self.open

    def handle_starttag(self, tag, attrs):
        self.links += [value for key, value in attrs if key in ("src", "href")]
        if tag not in self.VOID:
            self.open.append(tag)
        if tag in ("td", "h3"):
            self.cells.append("")

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] == "script" and data.startswith("{"):
            self.data = json.loads(data)
        if "td" in self.open or "h3" in self.open:
            self.cells[-1] += data


def test_the_page_holds_everything_itself(tmp_path, monkeypatch):
    jaxevent.save(small(), tmp_path / "small.h5")
    config = write_config(tmp_path, ONE + 'label = "one"\n[[method]]\nname = "last-frame"\n')
    rows = evaluate(config, tmp_path / "out")
    text = (tmp_path / "out" / "report.html").read_text()
    page = Page(text)
    assert set(page.links) == {"data:,"}
    (shown,) = page.data["recordings"]
    assert [one["label"] for one in shown["figures"]] == [
        "truth", "last frame given", "one", "last-frame",
    ]  # fmt: skip
    assert "url(" not in text and "@import" not in text and "<script src" not in text
    for row in rows:
        at = page.cells.index(row["method"])
        assert page.cells[at + 1 : at + 3] == [f"{100 * row['mse']:.3f}", f"{row['ssim']:.3f}"]
    at = shown["times"].index(small().frames.t[3] / 1e6)  # the second of three hidden ones
    pictures = []
    for one in shown["figures"]:
        for kind in one["images"].values():
            with Image.open(io.BytesIO(base64.b64decode(kind[at]))) as image:
                pictures.append(np.asarray(image.convert("RGB"), np.int64))
    truth, before, blend, error, last, _ = pictures
    np.testing.assert_array_equal(before, last)
    frames = np.asarray(small().frames.images)
    # White is the truth's brightest 0.5 %, and greys are encoded by the sRGB curve.
    order = np.argsort(frames[3].ravel(), kind="stable")
    assert (np.diff(truth[..., 0].ravel()[order]) >= 0).all()
    white = np.quantile(frames[3], 0.995)
    for picture, frame in ((truth, frames[3]), (last, frames[2])):
        linear = np.clip(frame / white, 0, 1)
        curve = np.where(linear < 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
        assert np.abs(picture[..., 0] - 255 * curve).max() <= 2
    difference = blend[..., 0] - truth[..., 0]
    far = np.abs(difference) > 24
    assert (difference[far] > 0).tolist() == (error[far][:, 0] > error[far][:, 2]).tolist()
    assert (error[difference == 0] >= 250).all()

    monkeypatch.setitem(sys.modules, "pyarrow", None)
    evaluate(config, tmp_path / "out")
    assert not (tmp_path / "out" / "results.parquet").exists()


def test_images_are_read_piece_by_piece():
    class Stored:
        """Frames in a file: how many are read at once."""

        most = 0

        def __init__(self, images):
            self.images, self.dtype, self.shape = images, images.dtype, images.shape

        def __getitem__(self, rows):
            return Stored(self.images[rows])

        def __array__(self, dtype=None, copy=None):
            Stored.most = max(Stored.most, len(self.images))
            return np.array(self.images, dtype)

    frames = long(0).frames
    stored = Frames(frames.t, Stored(np.asarray(frames.images)), frames.exposure)
    row = score(small(width=80, height=60, frames=stored), METHODS["last-frame"])
    whole = score(long(0), METHODS["last-frame"])
    assert untimed([row]) == untimed([whole])
    assert Stored.most <= 2 * N_BATCH_IMAGES  # of 30 given and 30 hidden ones


def wait_for(count: int, tasks: Path, process: subprocess.Popen, what: str = "finished") -> None:
    """Until so many lines of the log say so."""
    deadline = time.monotonic() + 120
    while not (tasks / "log.txt").exists() or len(log(tasks, what)) < count:
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.01)


def killed_twice(folder: Path, out: Path, *options: str) -> Path:
    """Start an evaluation, kill one of its workers and then itself, both while they compute."""
    config = folder / "run.toml"
    argv = [sys.executable, "-m", "jaxevent", "evaluate", str(config), "--out", str(out)]
    client = subprocess.Popen([*argv, *options], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    with client:
        wait_for(2, out / "tasks", client)
        lines = (out / "tasks" / "log.txt").read_text().splitlines()
        os.kill(int(lines[0].split()[2]), signal.SIGKILL)
        wait_for(len(log(out / "tasks", "finished")) + 1, out / "tasks", client)
        client.kill()
    assert not (out / "results.json").exists()
    assert len(list((out / "tasks").glob("*.json"))) < TASKS
    return out


def check_nothing_twice(out: Path, rows: list[dict], expected: list[dict]) -> None:
    assert untimed(rows) == untimed(expected)
    finished = Counter(log(out / "tasks", "finished"))
    assert len(finished) == TASKS and set(finished.values()) == {1}
    started = Counter(log(out / "tasks", "started"))
    # Twice what the dead worker and the workers of the dead client had begun.
    assert started.keys() == finished.keys() and started.total() <= TASKS + 3
    assert json.loads((out / "results.json").read_text()) == {"rows": rows}


@pytest.fixture(scope="module")
def several(tmp_path_factory) -> tuple[Path, list[dict]]:
    """A folder of two recordings, and the rows as this process computes them."""
    folder = tmp_path_factory.mktemp("several")
    for seed in range(2):
        jaxevent.save(long(seed), folder / f"{seed}.h5")
    with jax.enable_x64(False):
        return folder, evaluate(write_config(folder, SEVERAL))


@pytest.mark.slow
def test_workers_and_client_of_a_cluster_may_die(several, tmp_path, float32, monkeypatch):
    distributed = pytest.importorskip("distributed", reason="needs the extra 'cluster'")

    monkeypatch.setattr("jaxevent.show.page.page", lambda *arguments: "")
    folder, expected = several
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=":0", silence_logs=logging.CRITICAL
    ) as cluster:
        address = cluster.scheduler_address
        out = killed_twice(folder, tmp_path / "out", "--cluster", address)
        rows = evaluate(folder / "run.toml", out, cluster=address)
        check_nothing_twice(out, rows, expected)
