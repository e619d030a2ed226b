"""`jaxevent track`: what it writes is what `track` says, and bad input is said in one line."""

import csv
import dataclasses
import functools
import shlex
import sys
import tomllib
from pathlib import Path

import h5py
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from commands import decoded, described, fails
from PIL import Image

import jaxevent
from jaxevent import blob, cli
from jaxevent.blob import constant_velocity
from jaxevent.blob.quantities import inverse_ttc, size_range
from jaxevent.errors import InputError, install_command
from jaxevent.recording import Events, Frames, Recording
from jaxevent.show import tracks as written
from jaxevent.show.track_figures import track_colour
from jaxevent.show.track_tables import STATE_COLUMNS
from jaxevent.simulate import LinearMotion, Target, simulate_blobs

WIDTH, HEIGHT = 120, 80
SEEDS = [(30.0, 30.0, 6.0), (80.0, 50.0, 6.0)]
HEADER = ["t", "id", *STATE_COLUMNS]
# A filter that compiles fast.
METHOD = ["--method", "constant_velocity"]
SETTINGS = "events_per_step = 8\nQ_v = 1e4\nP0_v = 1e4\n"


@functools.cache
def two() -> Recording:
    """Two blobs that move slowly apart, from 0 to 0.05 s."""
    targets = [
        Target(LinearMotion((30, 30), (-100, 0), size=(4.0, 2.0)), 4e4),
        Target(LinearMotion((80, 50), (100, 20), size=(3.0, 3.0)), 4e4),
    ]
    return simulate_blobs(targets, (WIDTH, HEIGHT), 0.05, seed=1)[0]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    jaxevent.save(two(), tmp_path / "two.h5")
    (tmp_path / "mine.toml").write_text(SETTINGS)
    return tmp_path


def seeded(*more: object) -> list[str]:
    seeds = [f"--seed={x:g},{y:g},{size:g}" for x, y, size in SEEDS]
    return [*seeds, *(str(word) for word in more)]


def followed(**more):
    params = constant_velocity.Params(**tomllib.loads(SETTINGS))
    return constant_velocity.estimate(two(), params, seeds=SEEDS, **more)


def read_table(path: Path) -> tuple[list[str], np.ndarray]:
    with path.open() as file:
        lines = list(csv.reader(file))
    return lines[0], np.array(lines[1:], float).reshape(-1, len(lines[0]))


def test_header_is_exact():
    assert HEADER == ["t", "id", "x", "y", "vx", "vy", "lambda1", "lambda2", "theta", "q"]


def test_a_dataframe_is_the_table_that_the_command_writes(folder):
    argv = ["track", folder / "two.h5", *METHOD, "--params", folder / "mine.toml"]
    out = folder / "tracks.csv"
    assert cli.main([*map(str, [*argv, "--out", out]), *seeded()]) == 0
    tracks, rows = followed(), pd.read_csv(out)
    table = tracks.to_dataframe()
    pd.testing.assert_frame_equal(table.astype(rows.dtypes), rows, rtol=1e-12)
    assert table.attrs["units"]["sigma_vx"] == "px/s" and table["id"].dtype == np.int64

    times = [tracks.start + 5000, tracks.start + 1000]  # sorted by time
    part, states = tracks.to_dataframe(times, [1]), tracks(np.sort(times), [1])
    assert part["t"].tolist() == [t / 1e6 for t in sorted(times)] and set(part["id"]) == {1}
    np.testing.assert_array_equal(part["x"], states.mean[:, 0, 0])
    np.testing.assert_array_equal(part["sigma_x"], np.sqrt(states.covariance[:, 0, 0, 0]))
    none = tracks.to_dataframe(np.zeros(0, int))
    assert len(none) == 0 and list(none) == list(table)
    with pytest.raises(InputError, match="times from"):
        tracks.to_dataframe(tracks.stop + 10**6)


@pytest.mark.slow
def test_a_folder_of_everything(folder, capsys):
    out = folder / "out"
    argv = [
        *("track", folder / "two.h5", *METHOD, "--params", folder / "mine.toml", "--rate", 500),
        *("--pair", "0,1", "--extent", 0.3, "--focal", 200, "--size-factor", 0.25, "--out", out),
    ]
    assert cli.main([*map(str, argv), *seeded()]) == 0
    said = capsys.readouterr().out
    names = ["params.toml", "quantities.csv", "tracks.csv", "tracks.h5", "tracks.mp4", "tracks.png"]
    assert sorted(path.name for path in out.iterdir()) == names
    assert all(name in said for name in names) and f"{out}: 2 tracks" in said

    tracks = followed()
    times = tracks.start + 2000 * np.arange(25)
    states = tracks(times)
    assert states.valid.all()
    header, table = read_table(out / "tracks.csv")
    assert header == [*HEADER, *(f"sigma_{name}" for name in STATE_COLUMNS)]
    assert np.array_equal(table[:, 0], np.repeat(times, 2) / 1e6)
    assert np.array_equal(table[:, 1], np.tile([0, 1], 25))
    np.testing.assert_allclose(table[:, 2:10], states.mean.reshape(-1, 8), rtol=1e-12)
    variance = np.diagonal(states.covariance, axis1=2, axis2=3).reshape(-1, 8)
    np.testing.assert_allclose(table[:, 10:] ** 2, variance, rtol=1e-12)
    with h5py.File(out / "tracks.h5") as file:
        assert np.array_equal(file["t"], np.repeat(times, 2))
        assert np.array_equal(file["mean"], states.mean.reshape(-1, 8))
        assert np.array_equal(file["covariance"], states.covariance.reshape(-1, 8, 8))
        assert list(file["mean"].attrs["columns"]) == list(STATE_COLUMNS)

    scale = 6  # 80 rows become 480
    images, about = decoded(out / "tracks.mp4", scale * HEIGHT, scale * WIDTH, "rgb24")
    # 150 pictures would be 3000 a second, of which the rate allows 500.
    assert len(images) == 25 and " 30 fps" in about
    for one, place in enumerate(states.mean[-1, :, :2]):
        x, y = np.rint((place + 0.5) * scale).astype(int)
        near = images[-1][max(y - 60, 0) : y + 60, max(x - 60, 0) : x + 60].astype(int)
        wanted = track_colour(one)
        assert (abs(near - wanted).sum(2) < 60).sum() > 30
    with Image.open(out / "tracks.png") as figure:
        assert figure.width > 800 and figure.height > 1000  # three plots

    with (out / "quantities.csv").open() as file:
        rows = list(csv.DictReader(file))
    names = ["t", "id", "other", "inverse_ttc", "sigma_inverse_ttc", "range", "sigma_range"]
    assert list(rows[0]) == names and len(rows) == 75
    pair = [row for row in rows if row["other"] == "1"]
    a, b = (jnp.asarray(states.mean[:, k]) for k in (0, 1))
    P_a, P_b = (jnp.asarray(states.covariance[:, k]) for k in (0, 1))
    value, variance = inverse_ttc(a, P_a, b, P_b)
    np.testing.assert_allclose([float(row["inverse_ttc"]) for row in pair], value, rtol=1e-9)
    deviation = [float(row["sigma_inverse_ttc"]) for row in pair]
    np.testing.assert_allclose(deviation, np.sqrt(variance), rtol=1e-9)
    one = [row for row in rows if row["id"] == "1"]
    value, variance = size_range(b, P_b, 0.3, 200, 0.25)
    assert [row["other"] for row in one] == [""] * 25
    np.testing.assert_allclose([float(row["range"]) for row in one], value, rtol=1e-9)
    np.testing.assert_allclose([float(row["sigma_range"]) ** 2 for row in one], variance, rtol=1e-9)


@pytest.mark.slow
def test_a_row_for_each_event(folder, capsys, monkeypatch):
    monkeypatch.setattr(written, "_BATCH_EVENTS", 300)
    argv = ["track", folder / "two.h5", *METHOD, "--params", folder / "mine.toml", "--at", "events"]
    path = folder / "events.csv"
    span = ["--start", "0.01", "--stop", "0.04"]
    assert cli.main([*map(str, argv), *seeded(*span, "--out", path)]) == 0
    assert f"{path}: 2 tracks" in capsys.readouterr().out
    tracks = followed(start=0.01, stop=0.04)
    (told,) = tracks.events()
    held = told.id >= 0
    states = tracks(told.t[held])
    _, table = read_table(path)
    assert 1000 < held.sum() == len(table)
    # Events of one time may come in any order.
    order = np.lexsort((table[:, 1], table[:, 0]))
    expected = np.lexsort((told.id[held], told.t[held]))
    assert np.array_equal(table[order, 0], told.t[held][expected] / 1e6)
    assert np.array_equal(table[order, 1], told.id[held][expected])
    mean = states.mean[np.arange(held.sum()), told.id[held]][expected]
    np.testing.assert_allclose(table[order, 2:10], mean, rtol=1e-12)


@pytest.mark.slow
def test_quantities_at_event_rate(folder, capsys, monkeypatch):
    """Two pairs and a range, stretch by stretch, against all events at once."""
    monkeypatch.setattr(written, "_BATCH_EVENTS", 300)
    out = folder / "out"
    argv = [
        *("track", folder / "two.h5", *METHOD, "--params", folder / "mine.toml", "--at", "events"),
        *("--pair", "0,1", "--pair", "1,0", "--extent", 0.3, "--focal", 200, "--stop", 0.02),
    ]
    assert cli.main([*map(str, argv), *seeded("--out", out)]) == 0
    assert "quantities.h5" in capsys.readouterr().out
    tracks = followed(stop=0.02)
    told = list(tracks.events())
    t, whose = (np.concatenate([getattr(one, name) for one in told]) for name in ("t", "id"))
    t, whose = t[whose >= 0], whose[whose >= 0]
    states = tracks(t)
    mean, P = (jnp.asarray(part) for part in (states.mean, states.covariance))
    with h5py.File(out / "quantities.h5") as file:
        columns = {name: np.array(file[name]) for name in file}
        assert file["t"].attrs["unit"].startswith("us") and file["range"].attrs["unit"] == "m"
    for one, other in ((0, 1), (1, 0)):
        rows = (columns["id"] == one) & (columns["other"] == other)
        np.testing.assert_array_equal(columns["t"][rows], t)
        value, variance = inverse_ttc(mean[:, one], P[:, one], mean[:, other], P[:, other])
        np.testing.assert_allclose(columns["inverse_ttc"][rows], value, rtol=1e-9)
        np.testing.assert_allclose(columns["sigma_inverse_ttc"][rows] ** 2, variance, rtol=1e-9)
        assert np.isnan(columns["range"][rows]).all()
    rows = columns["other"] == -1
    np.testing.assert_array_equal(columns["t"][rows], t)
    np.testing.assert_array_equal(columns["id"][rows], whose)
    at = np.arange(len(t)), whose
    value, variance = size_range(mean[at], P[at], 0.3, 200)
    np.testing.assert_allclose(columns["range"][rows], value, rtol=1e-9)
    np.testing.assert_allclose(columns["sigma_range"][rows] ** 2, variance, rtol=1e-9)


@pytest.mark.slow
def test_one_file_of_each_kind(folder, capsys):
    # The frames, which nobody looks at, begin before the events and end after.
    stamps = np.array([-5_000, 90_000])
    frames = Frames(stamps, np.zeros((2, HEIGHT, WIDTH), np.uint8), 0 * stamps)
    path = folder / "framed.h5"
    jaxevent.save(Recording("framed", WIDTH, HEIGHT, two().events, frames), path)
    argv = [
        "track",
        str(path),
        *METHOD,
        "--params",
        str(folder / "mine.toml"),
        *seeded("--rate", 100),
    ]
    for name, more in (
        ("a.csv", []),
        ("a.hdf5", []),
        ("a.svg", ["--pair", "0,1"]),
        ("a.mp4", ["--background", "high-pass"]),
    ):
        before = set(folder.iterdir())
        assert cli.main([*argv, *more, "--out", str(folder / name)]) == 0
        assert set(folder.iterdir()) - before == {folder / name}
        assert ("of real time" in capsys.readouterr().out) == (name == "a.mp4")
    _, table = read_table(folder / "a.csv")
    with h5py.File(folder / "a.hdf5") as file:
        assert np.array_equal(file["t"], np.rint(1e6 * table[:, 0]).astype(int))
        np.testing.assert_allclose(np.asarray(file["mean"]), table[:, 2:10], rtol=1e-12)
    assert "<svg" in (folder / "a.svg").read_text()
    images, _ = decoded(folder / "a.mp4", 6 * HEIGHT, 6 * WIDTH, "rgb24")
    assert len(images) == 5
    assert abs(np.median(images[0]) - 128) < 20  # grey where nothing happened


@pytest.mark.slow
def test_the_summary_counts_from_the_recordings_start(tmp_path):
    events = two().events[:]
    later = Recording(
        "later", WIDTH, HEIGHT, Events(events.t + 7_000_000, events.x, events.y, events.p)
    )
    params = constant_velocity.Params(**tomllib.loads(SETTINGS))
    told = []
    for k, recording in enumerate((two(), later)):
        tracks = constant_velocity.estimate(recording, params, seeds=SEEDS)
        told.append(written.Output(tmp_path / f"{k}.csv").write(tracks).summary())
    (note,) = [line for line in told[1] if line not in told[0]]
    assert note.startswith("birth, death: from the recording's start, 7.00")
    assert [line for line in told[1] if line != note] == told[0] and len(told[0]) > 3


@pytest.mark.slow
def test_tracks_are_doubted_where_the_camera_may_move(folder, capsys, monkeypatch):
    find, argv = (
        blob.find,
        ["track", f"{folder}/two.h5", *METHOD, "--params", f"{folder}/mine.toml"],
    )
    for full, camera_moves in ((True, False), (True, True), (False, False)):
        given = {"full": full, "camera_moves": camera_moves}
        monkeypatch.setattr(
            blob, "find", lambda *a, given=given, **k: dataclasses.replace(find(*a, **k), **given)
        )
        assert cli.main([*argv, "--out", f"{folder}/a.csv", "--force"]) == 0
        said = capsys.readouterr().out
        assert ("tracks may be pieces of its scene" in said) == (full and not camera_moves)


@pytest.mark.slow
def test_nothing_found_is_an_empty_table(tmp_path, capsys, monkeypatch):
    t = np.arange(0, 60_000, 3_000)
    x, y = (37 * np.arange(20)) % WIDTH, (23 * np.arange(20)) % HEIGHT
    events = Events(t, x.astype(np.uint16), y.astype(np.uint16), x % 2 == 0)
    jaxevent.save(Recording("stray", WIDTH, HEIGHT, events), tmp_path / "stray.h5")
    out = tmp_path / "out"
    (tmp_path / "mine.toml").write_text(SETTINGS)
    argv = [
        "track",
        tmp_path / "stray.h5",
        *METHOD,
        "--params",
        tmp_path / "mine.toml",
        "--out",
        out,
    ]
    assert cli.main([*map(str, argv)]) == 0
    said = capsys.readouterr().out
    assert "no blob was found" in said and "--seed" in said and f"{out}: 0 tracks" in said
    header, table = read_table(out / "tracks.csv")
    assert header[:10] == HEADER and len(table) == 0
    with h5py.File(out / "tracks.h5") as file:
        assert {name: file[name].shape for name in file} == {
            "t": (0,),
            "id": (0,),
            "mean": (0, 8),
            "covariance": (0, 8, 8),
        }
    images, _ = decoded(out / "tracks.mp4", 6 * HEIGHT, 6 * WIDTH)
    assert len(images) > 40
    with Image.open(out / "tracks.png") as figure:
        assert figure.width > 800
    # Where the camera moves it is said, and where it may.
    for name, given, told in (
        ("a.csv", {"camera_moves": True}, "the camera moves, and no blob was found"),
        ("b.csv", {"full": True}, "no blob was found, and most of the image changes"),
    ):
        nothing = functools.partial(blob.TargetSearchResult, (), (), 0, 1.0, **given)
        monkeypatch.setattr(blob, "find", lambda one, nothing=nothing, **_: nothing(one))
        assert cli.main([*map(str, argv[:-1]), str(tmp_path / name)]) == 0
        assert told in capsys.readouterr().out


@pytest.mark.slow
def test_bad_ways_to_track(folder, capsys):
    path, out = folder / "two.h5", folder / "out"
    bare = folder / "bare.h5"
    frames = Frames(np.array([0]), np.zeros((1, HEIGHT, WIDTH), np.uint8), np.array([0]))
    jaxevent.save(Recording("bare", WIDTH, HEIGHT, Events.empty(), frames), bare)
    (folder / "wrong.toml").write_text("Q_vv = 3\n")
    (folder / "negative.toml").write_text("gate = -3\n")
    (folder / "other.toml").write_text("[akf]\nc_on = 0.2\n")
    (folder / "full").mkdir()
    (folder / "full" / "a").touch()
    before = sorted(folder.rglob("*"))
    to = ["--out", out]
    fails(capsys, ["track", folder / "none.h5", *to], "none.h5")
    fails(capsys, ["track", bare, *to], bare, "no events")
    for name, said in (
        ("wrong.toml", "did you mean 'Q_v'"),
        ("negative.toml", "gate"),
        ("other.toml", "none of moment"),
        ("none.toml", "cannot be read"),
    ):
        fails(capsys, ["track", path, "--params", folder / name, *to], folder / name, said)
    fails(capsys, ["track", path, "--method", "chi", *to], "did you mean 'chi2'")
    fails(capsys, ["track", path, "--method", "akf", *to], "is of reconstruction, not of blob")
    fails(capsys, ["track", path, "--method", "no.such:thing", *to], "cannot be imported")
    for seed, said in (
        ("200,10,5", "outside the 120x80 sensor"),
        ("-9,10,5", "outside the 120x80 sensor"),
        ("20,10,0", "size above 0"),
        ("20,nan,5", "outside"),
        ("20,10,5,7.5", "begins at 7500000 us"),
    ):
        fails(capsys, ["track", path, f"--seed={seed}", *to], path, "seed 0", said)
    fails(capsys, ["track", path, "--start", 3, *to], path, "nothing to track")
    fails(capsys, ["track", path, "--start", "nan", *to], "start")
    for rate in ("0", "-1", "nan", "1e7"):
        fails(capsys, ["track", path, f"--rate={rate}", *to], "--rate")
    fails(capsys, ["track", path, "--pair", "0,0", *to], "--pair 0,0 is one track")
    pair = [*METHOD, "--params", folder / "mine.toml", *seeded("--pair", "0,7")]
    fails(capsys, ["track", path, *pair, *to], path, "--pair 0,7", "found, 0, 1")
    fails(capsys, ["track", path, "--extent", 1, *to], "--focal")
    fails(capsys, ["track", path, "--focal", 1, *to], "--extent")
    fails(capsys, ["track", path, "--size-factor", 1, *to], "--extent")
    fails(capsys, ["track", path, "--extent", 0, "--focal", 9, *to], "--extent 0")
    for name in ("a.txt", "a.csv.gz"):
        fails(capsys, ["track", path, "--out", folder / name], folder / name, "stored as")
    for name in ("a.csv", "a.h5", "a.mp4"):
        fails(capsys, ["track", path, "--pair", "0,1", "--out", folder / name], "--pair")
    fails(capsys, ["track", path, "--background", "high-pass", "--out", folder / "a.csv"], "video")
    for name in ("missing/a", "missing/a.csv", "two.h5/a.mp4", "full", "full/b/a.png"):
        fails(capsys, ["track", path, "--out", folder / name], folder / name)
    fails(capsys, ["track", path, "--out", "."])
    assert sorted(folder.rglob("*")) == before


@pytest.mark.parametrize(
    ("module", "extra", "name"),
    [("imageio_ffmpeg", "video", "a.mp4"), ("matplotlib", "plot", "a.png")],
)
def test_missing_extras_are_named(module, extra, name, folder, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, module, None)
    fails(capsys, ["track", folder / "two.h5", "--out", folder / name], f"[{extra}]")
    assert not (folder / name).exists()


@pytest.mark.slow
def test_without_extras_the_tables_are_written(folder, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    argv = ["track", folder / "two.h5", *METHOD, "--params", folder / "mine.toml", *seeded()]
    argv = [*map(str, argv), "--rate", "100", "--pair", "0,1", "--out", str(folder / "out")]
    assert cli.main(argv) == 0
    names = ["params.toml", "quantities.csv", "tracks.csv", "tracks.h5"]
    assert sorted(path.name for path in (folder / "out").iterdir()) == names
    said = capsys.readouterr().out
    for name, extra in (("tracks.mp4", "video"), ("tracks.png", "plot")):
        assert f"{name} is left out: this needs the package" in said
        assert install_command(extra) in said
    assert "tracks.csv, tracks.h5, quantities.csv, params.toml in" in said

    told = described(folder / "out" / "tracks.h5")
    assert told["method"] == "constant_velocity"
    assert told["command"] == shlex.join(["jaxevent", *argv])
    assert set(told["inputs"]) == {str(folder / "two.h5"), str(folder / "mine.toml")}
    # The values that the run took, to the last digit.
    assert told["params"] == tomllib.loads((folder / "out" / "params.toml").read_text())


def test_simulated_blobs_and_their_truth(tmp_path, capsys):
    truth, out = tmp_path / "truth.csv", tmp_path / "dot.h5"
    argv = f"simulate --blobs dropout --seed 3 --truth {truth} --out {out}"
    assert cli.main([*argv.split(), "--duration", "0.56"]) == 0
    recording, states = jaxevent.simulate.blob_scene("dropout", 3)
    loaded = jaxevent.load(out)
    assert f"{out}: {len(loaded.events):,} events" in capsys.readouterr().out
    assert np.array_equal(loaded.events[:].t, recording[:0.56].events[:].t)
    header, table = read_table(truth)
    assert header == HEADER
    times = np.arange(0, loaded.stop + 1, 1000)
    times = times[states.visible(times)[:, 0]]
    assert np.array_equal(table[:, 0], times / 1e6) and 0 < 560 - len(table) < 560
    assert (table[:, 1] == 0).all()
    np.testing.assert_allclose(table[:, 2:], states(times)[:, 0], rtol=1e-9)

    before = sorted(tmp_path.iterdir())
    for options, said in (
        ("--blobs disk", "did you mean 'disc'"),
        ("--blobs disc --seed -1", "--seed -1"),
        ("--blobs disc --duration 0", "--duration 0"),
        ("--blobs disc --sensor good", "--sensor is not for blobs"),
        ("--blobs disc --max-size 9", "--max-size is not for blobs"),
        ("--blobs disc --truth no/a.csv", "no/a.csv"),
        ("--scene lake --truth a.csv", "--truth is that of --blobs"),
    ):
        fails(capsys, ["simulate", *options.split(), "--out", tmp_path / "b.h5"], said)
    assert sorted(tmp_path.iterdir()) == before
