"""The unit of times in files of columns: stated, inferred, doubted, refused."""

import re
import warnings
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import scipy.io
from commands import fails
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from refusals import refuses

import jaxevent
from jaxevent import cli
from jaxevent.errors import InputWarning
from jaxevent.io.images import read_times
from jaxevent.recording import Events
from jaxevent.time_units import (
    JUDGED_EVENTS,
    doubt_given_unit,
    doubt_microseconds,
    infer_unit,
    numbers_of_dates,
    to_microseconds,
    unit_of_name,
)

SIZE = (48, 32)
COUNT = 600
PER_UNIT = {"s": 1e-6, "ms": 1e-3, "us": 1, "ns": 1000}


def columns(seed: int = 0, span: int = 250_000) -> dict[str, Any]:
    """Events of 600 moments of a quarter of a second, us."""
    random = np.random.default_rng(seed)
    return {
        "t": np.sort(random.choice(span, COUNT, replace=False)).astype(np.int64),
        "x": random.integers(0, SIZE[0], COUNT),
        "y": random.integers(0, SIZE[1], COUNT),
        "p": random.integers(0, 2, COUNT),
    }


def stored(unit: str, t: Any) -> Any:
    """Times (us) in a unit: whole numbers of ns, decimals of ms and s."""
    return t * PER_UNIT[unit]


def write_npz(path: Path, c: dict) -> Path:
    np.savez(path / "a.npz", **c)
    return path / "a.npz"


def write_npy(path: Path, c: dict) -> Path:
    kinds = [(name, np.asarray(c[name]).dtype) for name in "xytp"]
    records = np.zeros(COUNT, kinds)
    for name in "xytp":
        records[name] = c[name]
    np.save(path / "a.npy", records)
    return path / "a.npy"


def write_rows(path: Path, c: dict) -> Path:
    np.save(path / "b.npy", np.stack([c[name] for name in "xytp"], 1))
    return path / "b.npy"


def write_csv(path: Path, c: dict) -> Path:
    decimals = np.asarray(c["t"]).dtype.kind == "f"
    rows = zip(*(np.asarray(c[name]).tolist() for name in "txyp"), strict=True)
    lines = [f"{t:.9g},{x},{y},{p}" if decimals else f"{t},{x},{y},{p}" for t, x, y, p in rows]
    (path / "a.csv").write_text("t,x,y,p\n" + "\n".join(lines) + "\n")
    return path / "a.csv"


def write_hdf5(path: Path, c: dict) -> Path:
    with h5py.File(path / "a.h5", "w") as file:
        for name, values in c.items():
            file[f"events/{name}"] = values
    return path / "a.h5"


def write_hdf5_rows(path: Path, c: dict) -> Path:
    with h5py.File(path / "b.h5", "w") as file:
        file["events"] = np.stack([c[name] for name in "txyp"], 1)
    return path / "b.h5"


def write_mat(path: Path, c: dict) -> Path:
    columns = [c["t"], c["x"] + 1, c["y"] + 1, c["p"]]
    scipy.io.savemat(path / "a.mat", {"events": np.stack(columns, 1)})
    return path / "a.mat"


def write_parquet(path: Path, c: dict) -> Path:
    arrow = pytest.importorskip("pyarrow")
    parquet = pytest.importorskip("pyarrow.parquet")
    table = arrow.table({name: arrow.array(values) for name, values in c.items()})
    parquet.write_table(table, path / "a.parquet", row_group_size=250)
    return path / "a.parquet"


def write_text(path: Path, c: dict) -> Path:
    rows = zip(*(np.asarray(c[name]).tolist() for name in "txyp"), strict=True)
    (path / "events.txt").write_text("".join(f"{t} {x} {y} {p}\n" for t, x, y, p in rows))
    return path


WRITERS = [
    write_npz, write_npy, write_rows, write_csv, write_hdf5, write_hdf5_rows, write_mat,
    write_parquet, write_text,
]  # fmt: skip


def assert_read(recording: Any, c: dict, t: Any = None) -> None:
    events = recording.events[:]
    np.testing.assert_array_equal(events.t, c["t"] if t is None else t)
    for name in "xyp":
        np.testing.assert_array_equal(getattr(events, name), c[name])


def load(path: Path, in_memory: bool = True, **options: Any) -> Any:
    return jaxevent.load(path, SIZE, in_memory, **options)


@pytest.mark.parametrize("write", WRITERS)
@pytest.mark.parametrize("unit", ["ns", "us", "ms", "s"])
def test_every_reader_infers_the_unit_and_takes_a_given_one(unit, write, tmp_path):
    """The usual unit comes without a word, another with a warning, a given one without."""
    c = columns()
    path = write(tmp_path, c | {"t": stored(unit, c["t"])})
    usual = {"us": write is not write_text, "s": write is not write_mat}.get(unit, False)
    for in_memory in (True, False):
        given = load(path, in_memory, time_unit=unit)
        assert_read(given, c)
        assert given.notes == ()
        if usual:
            assert load(path, in_memory).notes == ()
            assert_read(load(path, in_memory), c)
            continue
        with pytest.warns(InputWarning, match=f"--time-unit {unit}"):
            found = load(path, in_memory)
        assert_read(found, c)
        words = {"ns": "nano", "us": "micro", "ms": "milli", "s": ""}[unit] + "seconds"
        assert found.notes[0].startswith(
            f"event times are taken as {words}, since they last 0.25 s"
        )


@pytest.mark.parametrize("write", [write_npz, write_csv, write_hdf5])
def test_other_units_that_are_given_are_taken(write, tmp_path):
    c = columns()
    path = write(tmp_path, c)
    assert load(path, time_unit="ms").events.t[-1] == 1000 * c["t"][-1]
    for unit, last in (("s", 1_000_000 * c["t"][-1]), ("ns", (c["t"][-1] + 500) // 1000)):
        with pytest.warns(InputWarning, match="seconds events are unusual: .* give time_unit='us'"):
            assert load(path, time_unit=unit).events.t[-1] == last


@pytest.mark.parametrize(
    ("name", "unit"),
    [
        ("timestamp_us", "us"), ("timestamp [us]", "us"), ("t_ns", "ns"), ("Time (ms)", "ms"),
        ("t/µs", "us"), ("time_s", "s"), ("timestampNs", "ns"), ("t [in seconds]", "s"),
        ("ts_usec", "us"), ("timestamps (milliseconds)", "ms"), ("t.nanoseconds", "ns"),
        ("time in s", "s"), ("ts", None), ("times", None), ("timestamps", None), ("t", None),
        ("t_offset", None), ("x_us", None), ("ts_first", None), ("status", None),
    ],
)  # fmt: skip
def test_names_state_units(name, unit):
    assert unit_of_name(name) == unit


@pytest.mark.parametrize(
    ("name", "unit", "separator"),
    [
        ("timestamp_us", "us", ","),
        ("timestamp [us]", "us", ","),
        ("t_ns", "ns", ";"),
        ("t [ms]", "ms", " "),
        ("time (s)", "s", "\t"),
    ],
)
def test_columns_of_text_named_with_units(name, unit, separator, tmp_path, capsys):
    c = columns(1)
    stamps = [f"{stored(unit, t):.10g}" for t in c["t"].tolist()]
    rows = zip(c["x"], c["y"], c["p"], stamps, strict=True)
    lines = [separator.join(["x", "y", "pol", name])]
    lines += [separator.join(map(str, row)) for row in rows]
    path = tmp_path / "a.csv"
    path.write_bytes(("\r\n".join(lines) + "\r\n").encode())
    for in_memory in (True, False):
        recording = load(path, in_memory)
        assert_read(recording, c)
    assert re.fullmatch(r"event times are \w+, by the name '.*'", recording.notes[0])
    assert cli.main(["info", str(path), "--size", "48,32"]) == 0
    said = capsys.readouterr()
    assert said.err == "" and f"note            {recording.notes[0]}" in said.out


def test_names_types_and_attributes_with_units_elsewhere(tmp_path):
    c = columns(2)
    ns = c["t"] * 1000
    rest = {name: c[name] for name in "xyp"}
    np.savez(tmp_path / "a.npz", t_ns=ns, **rest)
    np.savez(tmp_path / "b.npz", t=ns.astype("m8[ns]"), **rest)
    np.savez(tmp_path / "c.npz", t=c["t"].astype("M8[us]"), **rest)
    np.savez(tmp_path / "d.npz", t=(c["t"] // 1000).astype("m8[ms]"), **rest)
    scipy.io.savemat(tmp_path / "e.mat", {"t_ns": ns, **rest})
    with h5py.File(tmp_path / "f.h5", "w") as file:
        for name, values in ({"t": ns} | rest).items():
            file[f"events/{name}"] = values
        file["events/t"].attrs["units"] = "ns"
    with h5py.File(tmp_path / "g.h5", "w") as file:
        for name, values in ({"timestamp_ns": ns} | rest).items():
            file[name] = values
    for name in ("a.npz", "b.npz", "c.npz", "e.mat", "f.h5", "g.h5"):
        recording = load(tmp_path / name)
        assert_read(recording, c)
        assert len([note for note in recording.notes if note.startswith("event times are")]) == 1
    assert_read(load(tmp_path / "d.npz"), c, c["t"] // 1000 * 1000)


def test_types_of_parquet_state_units(tmp_path):
    arrow = pytest.importorskip("pyarrow")
    parquet = pytest.importorskip("pyarrow.parquet")
    c = columns(3)
    for kind in (arrow.timestamp("us"), arrow.duration("ns")):
        t = c["t"] * 1000 if kind.unit == "ns" else c["t"]
        table = arrow.table({"ts": arrow.array(t, kind), **{k: c[k] for k in "xyp"}})
        parquet.write_table(table, tmp_path / "a.parquet")
        recording = load(tmp_path / "a.parquet")
        assert_read(recording, c)
        assert "by the type" in recording.notes[0]


def test_a_name_that_the_numbers_contradict_is_doubted(tmp_path):
    c = columns()
    lines = [f"{t / 1e6:.6f},{x},{y},{p}" for t, x, y, p in zip(*c.values(), strict=True)]
    (tmp_path / "a.csv").write_text("timestamp_us,x,y,p\n" + "\n".join(lines))
    with pytest.warns(InputWarning, match="microseconds by the name 'timestamp_us', but"):
        assert load(tmp_path / "a.csv").events.t[-1] == 0


def test_short_whole_numbers_may_be_milliseconds(tmp_path, capsys):
    """Eight thousand ticks: 8 ms of an edge, or 8 s of noise."""
    random = np.random.default_rng(5)
    c = columns(5)
    c["t"] = np.sort(random.integers(0, 8000, COUNT))
    path = write_npz(tmp_path, c)
    with pytest.warns(InputWarning, match="as milliseconds they last 7.9"):
        load(path)
    assert cli.main(["info", str(path), "--size", "48,32"]) == 0
    said = capsys.readouterr()
    assert said.err.count("\n") == 1 and said.err.startswith("jaxevent: warning: ")
    assert "note            event times are taken as" in said.out
    assert cli.main(["info", str(path), "--size", "48,32", "--time-unit", "ms"]) == 0
    said = capsys.readouterr()
    assert said.err == "" and "(7.9" in said.out and "note" not in said.out


def test_microseconds_with_halves(tmp_path):
    c = columns(6)
    path = write_npz(tmp_path, c | {"t": c["t"] + 0.5})
    with pytest.warns(InputWarning, match="microseconds are taken, since they last 0.2"):
        np.testing.assert_allclose(load(path).events.t, c["t"], atol=1)


def test_dates_in_nanoseconds_need_few_events(tmp_path):
    t = 1_700_000_000_000_000_000 + np.arange(5) * 10**7
    path = write_npz(tmp_path, {"t": t, "x": t % 7, "y": t % 5, "p": t % 2})
    with pytest.warns(InputWarning, match="nanoseconds are taken"):
        assert np.diff(load(path).events.t).tolist() == [10_000] * 4


# Resolution


@pytest.mark.parametrize(("span", "count"), [(0, COUNT), (300, COUNT), (300, 40)])
def test_dates_in_single_precision_are_refused(span, count, tmp_path, capsys):
    c = {name: values[:count] for name, values in columns(7).items()}
    t = (1.7e9 + np.linspace(0, span, count)).astype(np.float32)
    path = write_npz(tmp_path, c | {"t": t})
    for in_memory in (True, False):
        refuses("as seconds its numbers near 17.* are 128 s apart", load, path, in_memory)
    fails(capsys, ["info", path, "--size", "48,32"], path, "128 s apart", "64-bit floats")


def test_few_steps_of_a_type_are_refused(tmp_path):
    """Single precision at 6000 s has steps of 0.5 ms: forty in 20 ms."""
    c = columns(8)
    path = write_npz(tmp_path, c | {"t": (6000 + c["t"] / 12.5e6).astype(np.float32)})
    refuses("488 us apart", load, path, time_unit="s")


@pytest.mark.parametrize("wide", [False, True])
def test_rounded_times_are_noted(wide, tmp_path, capsys):
    c = columns(9)
    t = (250 + c["t"] / 1e6).astype(np.float32)
    path = write_npz(tmp_path, c | {"t": t.astype(np.float64) if wide else t})
    recording = load(path)
    assert recording.notes == ("event times are rounded by their type to 15.3 us",)
    np.testing.assert_allclose(recording.events.t, 250_000_000 + c["t"], atol=8)
    rows = np.stack([c["x"], c["y"], 3e8 + c["t"], c["p"]], 1).astype(np.float32)
    np.save(tmp_path / "b.npy", rows)
    assert cli.main(["info", str(tmp_path / "b.npy"), "--size", "48,32"]) == 0
    said = capsys.readouterr()
    assert said.err == ""
    assert "note            event times are rounded by their type to 32 us" in said.out


def test_exact_floats_are_not_noted(tmp_path):
    c = columns(10)
    for t in (c["t"] / 1e6 + 1.7e9, c["t"] + 1.7e15, c["t"] / 2**20, c["t"].astype(np.float32)):
        recording = load(write_npz(tmp_path, c | {"t": t}))
        assert recording.notes == () and len(recording.events) == COUNT


# Refusals


def test_formats_that_state_their_unit_take_no_other(tmp_path, capsys):
    c = columns()
    jaxevent.save(load(write_npz(tmp_path, c)), tmp_path / "own.h5")
    with h5py.File(tmp_path / "dsec.h5", "w") as file:
        for name, values in c.items():
            file[f"events/{name}"] = values
        file["ms_to_idx"] = np.searchsorted(c["t"], np.arange(250) * 1000)
    (tmp_path / "a.raw").write_bytes(b"% evt 2.0\n% end\n" + bytes(8))
    (tmp_path / "a.aedat4").write_bytes(b"#!AER-DAT4.0\r\n")
    for name in ("own.h5", "dsec.h5", "a.raw", "a.aedat4"):
        argv = ["info", tmp_path / name, "--size", "48,32", "--time-unit", "ns"]
        fails(capsys, argv, name, "states the unit of its times; leave out")
        refuses("leave out time_unit=", load, tmp_path / name, time_unit="us")


def test_units_that_are_none_are_refused(tmp_path):
    path = write_npz(tmp_path, columns())
    refuses("time_unit = 'minutes' is not a unit of time", load, path, time_unit="minutes")
    with pytest.raises(SystemExit):
        cli.main(["info", str(path), "--time-unit", "minutes"])


# Times of images, poses and samples


def folder(path: Path, stamps: list[str], first_line: str = "") -> dict[str, Any]:
    """A folder of text whose images have these times; their files hold events of 0.25 s."""
    c = columns(11)
    rows = zip(*(column.tolist() for column in c.values()), strict=True)
    lines = [f"{t / 1e6:.6f} {x} {y} {p}" for t, x, y, p in rows]
    (path / "events.txt").write_text("\n".join(lines) + "\n")
    for i in range(len(stamps)):
        Image.fromarray(np.full((32, 48), i, np.uint8)).save(path / f"{i}.png")
    names = [f"{t} {i}.png" for i, t in enumerate(stamps)]
    (path / "images.txt").write_text("\n".join([first_line] * bool(first_line) + names) + "\n")
    return c


@pytest.mark.parametrize("factor", [1000, 1, 0.001])
def test_whole_numbers_in_images_txt_fit_the_events(factor, tmp_path, capsys):
    want = [10_000, 60_000, 110_000, 160_000]
    folder(tmp_path, [str(round(t * factor)) for t in want])
    with pytest.warns(InputWarning, match="images.txt: image times are taken as"):
        recording = jaxevent.load(tmp_path)
    assert recording.frames.t.tolist() == want
    assert cli.main(["info", str(tmp_path)]) == 0
    said = capsys.readouterr()
    assert said.err.count("\n") == 1 and "note            image times are taken as" in said.out


def test_images_txt_may_name_its_columns(tmp_path):
    folder(tmp_path, ["10000000", "60000000"], "timestamp_ns filename")
    assert jaxevent.load(tmp_path).frames.t.tolist() == [10_000, 60_000]
    folder(tmp_path, ["0.01", "0.06"], "t path")
    assert jaxevent.load(tmp_path).frames.t.tolist() == [10_000, 60_000]


@pytest.mark.parametrize("stamps", [["5", "6", "7"], ["0.0", "0.1"], ["-3", "-2"]])
def test_images_that_fit_as_seconds_or_not_at_all_stay_seconds(stamps, tmp_path):
    folder(tmp_path, stamps)
    assert jaxevent.load(tmp_path).frames.t.tolist() == [float(t) * 1e6 for t in stamps]


def test_parts_of_an_archive_follow_the_events(tmp_path):
    c = columns(12)
    frame_t, imu_t = np.arange(5) * 50_000, np.arange(250) * 1000
    more = {
        "frames": np.zeros((5, 32, 48), np.uint8),
        "gyro": np.zeros((250, 3)),
        "acc": np.zeros((250, 3)),
    }
    ns = {"t": c["t"] * 1000, "frame_t": frame_t * 1000, "imu_t": imu_t * 1000}
    np.savez(tmp_path / "a.npz", **(c | more | ns))
    recording = jaxevent.load(tmp_path / "a.npz", time_unit="ns")
    np.testing.assert_array_equal(recording.frames.t, frame_t)
    np.testing.assert_array_equal(recording.imu.t, imu_t)
    stated = {"t": c["t"], "frame_t_ms": frame_t // 1000, "imu_t_ns": imu_t * 1000}
    np.savez(tmp_path / "b.npz", **(c | more | stated))
    recording = jaxevent.load(tmp_path / "b.npz")
    np.testing.assert_array_equal(recording.frames.t, frame_t)
    np.testing.assert_array_equal(recording.imu.t, imu_t)
    assert not recording.extra


def test_a_crop_of_events_beside_a_long_series_changes_nothing(tmp_path):
    """A minute of images and samples, of which 0.25 s have events."""
    c = columns(13)
    for start in (0, 20_000_000):
        frame_t, imu_t = np.arange(60) * 1_000_000, np.arange(600) * 100_000
        np.savez(
            tmp_path / "a.npz",
            **(c | {"t": c["t"] + start}),
            frames=np.zeros((60, 32, 48), np.uint8),
            frame_t=frame_t,
            imu_t=imu_t / 1e6,
            gyro=np.zeros((600, 3)),
            acc=np.zeros((600, 3)),
        )
        recording = jaxevent.load(tmp_path / "a.npz")
        np.testing.assert_array_equal(recording.frames.t, frame_t)
        np.testing.assert_array_equal(recording.imu.t, imu_t)
        assert recording.notes == ()


def test_times_that_are_asked_for(tmp_path):
    """Whole numbers are us, unless they lie in the recording as another unit alone."""
    path = tmp_path / "times.txt"
    path.write_text("0\n50000000\n100000000\n")
    with pytest.warns(InputWarning, match="times are taken as nanoseconds"):
        assert read_times(path, (0, 250_000)).tolist() == [0, 50_000, 100_000]
    assert read_times(path, (0, 200_000_000)).tolist() == [0, 50_000_000, 100_000_000]
    assert read_times(path).tolist() == [0, 50_000_000, 100_000_000]
    path.write_text("0.3\n0.4\n")  # beyond the end, not milliseconds
    assert read_times(path, (0, 250_000)).tolist() == [300_000, 400_000]
    path.write_text("t_ms,name\n50,a\n100,b\n")
    assert read_times(path).tolist() == [50_000, 100_000]


# Numbers


def test_conversions_are_exact():
    large = np.array([-1501, -1500, -500, 0, 499, 500, 2**62 * 100 // 100], np.int64)
    got = to_microseconds(large, "ns", "a", "event")
    assert got.tolist() == [(t + 500) // 1000 for t in large.tolist()]
    wide = np.array([2**64 - 1, 5], np.uint64)
    assert to_microseconds(wide, "ns", "a", "event").tolist() == [18446744073709552, 0]
    assert to_microseconds(np.array([3], np.uint8), "s", "a", "event").tolist() == [3_000_000]
    assert to_microseconds(np.array([1e-3]), "s", "a", "event").tolist() == [1000]
    for value, unit in ((2**45, "s"), (2**60, "ms")):
        refuses(
            "a: event 4 has the time",
            to_microseconds,
            np.array([value], np.int64),
            unit,
            "a",
            "event",
            4,
        )
    t, unit = numbers_of_dates(np.array(["2020-01-01", "2020-01-02"], "M8[D]"))
    assert unit == "us" and np.diff(t).tolist() == [86_400_000_000]


@pytest.mark.parametrize("unit", ["s", "us"])
def test_long_and_quiet_recordings_are_not_doubted(unit):
    """A star tracker: an hour at 0.003 events per pixel and second."""
    random = np.random.default_rng(14)
    for seconds, rate in ((3600, 0.003), (60, 0.01), (0.1, 40), (10, 30)):
        count = int(seconds * rate * 240 * 180)
        held = min(count, 65_536)
        t = np.sort(random.integers(0, int(seconds * 1e6 * held / count), held))
        t = np.append(t, int(seconds * 1e6))
        x, y = (random.integers(0, n, held + 1) for n in (240, 180))
        sample = {"t": t / 1e6 if unit == "s" else t, "x": x, "y": y}
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            found = infer_unit(sample, count + 1, (240, 180), "a")
        assert found == (unit, ())


# Times in text

SORTED_TIMES = st.lists(st.integers(-(10**12), 10**12), min_size=1, max_size=20).map(sorted)


@given(
    SORTED_TIMES,
    st.booleans(),
    st.sampled_from([",", ";", ", ", " ", "\t"]),
    st.integers(0, 2),
    st.booleans(),
)
def test_what_was_written_is_read(tmp_path_factory, us, seconds, between, place, named):
    path = tmp_path_factory.mktemp("times") / "times.csv"
    stamps = [f"{t / 1e6:.6f}" if seconds else str(t) for t in us]
    names = ["a", "b"]
    names.insert(place, "t")
    rows = [["7", "8.5"] for _ in us]
    for row, stamp in zip(rows, stamps, strict=True):
        row.insert(place if named else 0, stamp)
    lines = ([between.join(names)] if named else []) + [between.join(row) for row in rows]
    path.write_text("# made up\n" + "\n".join(lines) + "\n\n")
    assert read_times(path).tolist() == us


def test_a_list_in_place_of_a_file():
    assert read_times(Path("0.65,.7")).tolist() == [650_000, 700_000]
    assert read_times(Path("650000")).tolist() == [650_000]
    refuses("times.csv", read_times, Path("times.csv"))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "no times"),
        ("t\n", "no times"),
        ("time,x\n1,2\n", "column t"),
        ("1\n\n0.5\n", "sort"),
        ("1\nnan\n", "'nan'"),
        ("t,x\n1,2\n\n,3\n", "''"),
        ("1e30\n", "'1e30'"),
    ],
)
def test_bad_times(text: str, said: str, tmp_path: Path):
    path = tmp_path / "times.txt"
    path.write_text(text)
    assert said in refuses("times.txt", read_times, path)


@pytest.mark.parametrize("n", [JUDGED_EVENTS // 2, 3 * JUDGED_EVENTS])
def test_arrays_and_events_are_doubted_by_the_same_rows(n):
    """Beyond the first events only the last one counts, in both."""
    rng, size = np.random.default_rng(0), (20, 15)
    t = np.sort(rng.integers(0, 40_000_000 * n // JUDGED_EVENTS, n)) * 1000
    x, y = rng.integers(0, size[0], n), rng.integers(0, size[1], n)
    found = doubt_microseconds(Events(t, x, y, x % 2 == 0), size)
    text = doubt_given_unit(t, x, y, size, None)
    assert found is not None and text is not None
    assert found.text.partition(": ")[2] in text
    t[JUDGED_EVENTS + 1 : -1] = t[-1]
    assert doubt_microseconds(Events(t, x, y, x % 2 == 0), size) == found
    assert doubt_given_unit(t, x, y, size, None) == text
