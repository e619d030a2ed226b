"""What is sent to the Rerun viewer, which a stand-in for its package writes down."""

import dataclasses
import re
import subprocess
import sys
import types
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from jaxevent.cli import main
from jaxevent.errors import InputError, MissingExtra
from jaxevent.io import save
from jaxevent.recording import Events, Frames, Recording
from jaxevent.show import view
from jaxevent.show.track_tables import STATE_COLUMNS

START = 5_000_000


class Columns(dict):
    def partition(self, lengths):
        return Columns(self, lengths=np.asarray(lengths))


class Kind:
    """An archetype: what it is made of is kept."""

    def __init__(self, *values, **named):
        self.values, self.named = values, named

    @staticmethod
    def columns(**named):
        return Columns(named)


class Stream:
    sent: list = []
    layout: Kind

    def __init__(self, name):
        self.time = None

    def binary_stream(self):
        return self

    def read(self):
        return b"complete"

    def spawn(self):
        Stream.sent.append(("viewer", None, None))

    def set_time(self, name, duration):
        self.time = duration

    def log(self, name, kind, static=False):
        Stream.sent.append((name, None if static else self.time, kind))

    def send_columns(self, name, times, columns):
        Stream.sent.append((name, times[0].named["duration"], columns))

    def send_blueprint(self, blueprint):
        Stream.layout = blueprint

    def flush(self):
        pass


@pytest.fixture
def sent(monkeypatch):
    rerun = types.ModuleType("rerun")
    kinds = ("TimeColumn", "Points2D", "LineStrips2D", "Scalars", "Image", "Clear")
    for name in kinds:
        setattr(rerun, name, type(name, (Kind,), {}))
    setattr(rerun, "RecordingStream", Stream)  # noqa: B010
    parts = ("Blueprint", "BlueprintPanel", "Grid", "SelectionPanel", "Spatial2DView", "TimePanel",
             "TimeSeriesView", "Vertical", "VisualBounds2D")  # fmt: skip
    plan = types.SimpleNamespace(**{name: type(name, (Kind,), {}) for name in parts})
    setattr(rerun, "blueprint", plan)  # noqa: B010
    monkeypatch.setitem(sys.modules, "rerun", rerun)
    Stream.sent = []
    return Stream.sent


def seen():
    t = START + np.array([0, 100, 9_999, 10_000, 35_000, 35_001])
    x, y = np.arange(6, dtype=np.uint16), np.arange(1, 7, dtype=np.uint16)
    events = Events(t, x, y, np.array([1, 0, 1, 0, 1, 0], bool))
    images = np.full((2, 8, 8), 51, np.uint8)
    images[:, :4] = 102
    frames = Frames(START + np.array([0, 20_000]), images, np.zeros(2, np.int64))
    return Recording("a", 8, 8, events, frames)


def test_events_are_shown_in_windows_and_frames_at_their_times(sent):
    view(seen())
    assert sent[0][0] == "viewer"
    (name, times, points) = next(one for one in sent if one[0] == "image/events")
    assert points["lengths"].tolist() == [3, 1, 2]
    np.testing.assert_allclose(times, [0, 0.01, 0.03], atol=1e-9)
    np.testing.assert_array_equal(points["positions"][4], [4.5, 5.5])
    on, off = points["colors"][0].tolist(), points["colors"][1].tolist()
    assert on != off and points["colors"][4].tolist() == on
    frames = [one for one in sent if one[0] == "image/frames"]
    assert [time for _, time, _ in frames] == pytest.approx([0, 0.02])
    # White is the brightest of the first frame, half of its light grey 188 of sRGB.
    assert np.unique(frames[0][2].values[0]).tolist() == [188, 255]
    (view_of_frames,) = Stream.layout.values[0].values
    assert view_of_frames.named["contents"][:2] == ["/image/frames", "/image/events"]
    assert view_of_frames.named["visual_bounds"].named == {"x_range": (0, 8), "y_range": (0, 8)}


def test_a_track_is_an_ellipse_until_it_ends(sent, tmp_path):
    state = {"x": 3.0, "y": 4.0, "vx": 0, "vy": 0, "lambda1": 2.0, "lambda2": 0.5, "theta": 0.3}
    rows = [{"t": 5.0 + 0.01 * k, "id": 7, **state, "q": 0} for k in range(3)]
    pd.DataFrame(rows, columns=["t", "id", *STATE_COLUMNS]).to_csv(
        tmp_path / "tracks.csv", index=False
    )
    view(seen(), tmp_path, out=tmp_path / "a.rrd")
    assert (tmp_path / "a.rrd").read_text() == "complete"
    (name, times, outline), (_, end, _), (_, _, path) = [
        one for one in sent if one[0] in ("image/tracks/7", "image/paths/7")
    ]
    np.testing.assert_allclose(times, [0, 0.01, 0.02], atol=1e-9)
    assert end == pytest.approx(0.020001) and outline["labels"] == ["7"] * 3
    offset = np.asarray(outline["strips"][1]) - [3.5, 4.5]
    turn = np.array([[np.cos(0.3), -np.sin(0.3)], [np.sin(0.3), np.cos(0.3)]])
    along, across = (offset @ turn).T
    np.testing.assert_allclose((along / 4) ** 2 + (across / 1) ** 2, 1)
    np.testing.assert_allclose(path.values[0], [[[3.5, 4.5]] * 3])


def test_curves_have_gaps_where_the_motion_is_lost(sent, tmp_path):
    table = {"t": [5.0, 5.1, 5.2], "vx": [1.0, np.nan, 3.0], "sigma_vx": 0.1, "lost": [0, 1, 0]}
    pd.DataFrame(table).to_csv(tmp_path / "motion.csv", index=False)
    view(seen(), tmp_path / "motion.csv", out=tmp_path / "a.rrd")
    curves = [one for one in sent if one[0].startswith("motion/")]
    assert [name for name, _, _ in curves] == ["motion/vx"]
    np.testing.assert_allclose(curves[0][1], [0, 0.2], atol=1e-9)
    assert curves[0][2]["scalars"].tolist() == [1, 3]


def test_what_cannot_be_shown_is_told(sent, tmp_path, monkeypatch):
    pd.DataFrame({"t": [1], "id": [2]}).to_csv(tmp_path / "a.csv", index=False)
    for result, message in (
        (tmp_path / "a.csv", "columns t, id"),
        (tmp_path / "b", "is no result"),
    ):
        with pytest.raises(InputError, match=message):
            view(seen(), result, out=tmp_path / "a.rrd")
    with pytest.raises(InputError, match="end in .rrd"):
        view(seen(), out=tmp_path / "a.mp4")
    with pytest.raises(InputError, match="a window of 0 s"):
        view(seen(), window=0.0)
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(MissingExtra, match="view"):
        view(seen())
    assert not list(tmp_path.glob("*.rrd"))


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device without room")
def test_a_full_disk_is_told_in_one_sentence(sent, tmp_path, monkeypatch):
    write = Path.write_bytes
    monkeypatch.setattr(Path, "write_bytes", lambda path, data: write(Path("/dev/full"), data))
    with pytest.raises(InputError, match="a.rrd: cannot be written .No space.*enough room"):
        view(seen(), out=tmp_path / "a.rrd")
    assert not list(tmp_path.iterdir())


def test_the_command(sent, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    save(seen(), "a.h5")
    save(dataclasses.replace(seen(), events=Events.empty()), "b.h5")
    assert main(["view", "a.h5", "--stop", "5.02", "--out", "a.rrd"]) == 0
    assert "4 events" in capsys.readouterr().out
    for words in (["b.h5"], ["a.h5", "a.h5"]):
        assert main(["view", *words, "--out", "a.rrd", "--force"]) == 2
    # A result is an input: it is not written over.
    (tmp_path / "moved.rrd").write_text("kept")
    assert main(["view", "a.h5", "moved.rrd", "--out", "moved.rrd", "--force"]) == 2
    assert (tmp_path / "moved.rrd").read_text() == "kept"


def test_the_viewer_itself_reads_it(tmp_path):
    """With the extra "view": entities, times and rows as its own tool prints them."""
    pytest.importorskip("rerun", reason="the extra view is not installed")
    state = {"x": 3.0, "y": 4.0, "vx": 0, "vy": 0, "lambda1": 2.0, "lambda2": 0.5, "theta": 0.3}
    rows = [{"t": 5.0 + 0.01 * k, "id": 7, **state, "q": 0} for k in range(3)]
    pd.DataFrame(rows, columns=["t", "id", *STATE_COLUMNS]).to_csv(
        tmp_path / "tracks.csv", index=False
    )
    table = {"t": [5.0, 5.1, 5.2], "vx": [1.0, 2.0, 3.0]}
    pd.DataFrame(table).to_csv(tmp_path / "motion.csv", index=False)
    out = tmp_path / "a.rrd"
    view(seen(), tmp_path / "tracks.csv", tmp_path / "motion.csv", out=out)
    command = [sys.executable, "-m", "rerun", "rrd", "print", out]
    done = subprocess.run(command, capture_output=True, text=True)
    told = done.stdout
    assert done.returncode == 0, done.stderr
    rows_of = {name: int(n) for n, name in re.findall(r"with (\d+) rows.*? - (/\S+) - ", told)}
    assert rows_of["/image/events"] == 3 and rows_of["/image/frames"] == 2
    assert rows_of["/motion/vx"] == 3 and "/image/tracks/7" in rows_of
    assert told.count("VisualBounds2D:range") == 1 and "/time_panel" in told
