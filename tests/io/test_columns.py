"""Layouts of columns that published programs and users write, in every format that holds them."""

import bz2
import gzip
import pickle
import sys
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import scipy.io
from commands import fails

import jaxevent
from jaxevent import cli
from jaxevent.errors import InputError
from jaxevent.io.columns import find_fields

SIZE = (50, 40)
COUNT = 500


def columns(seed: int = 0) -> dict[str, Any]:
    random = np.random.default_rng(seed)
    found = {
        "t": np.sort(random.choice(300_000, COUNT, replace=False)).astype(np.int64),
        "x": random.integers(0, SIZE[0], COUNT),
        "y": random.integers(0, SIZE[1], COUNT),
        "p": random.integers(0, 2, COUNT),
    }
    found["x"][:2], found["y"][:2] = (0, SIZE[0] - 1), (SIZE[1] - 1, 0)
    return found


def assert_read(path: Path, c: dict, **options: Any) -> Any:
    """The file holds these events, in memory and left on disk, and `info` describes it."""
    recording: Any = None
    for in_memory in (False, True):
        recording = jaxevent.load(path, SIZE, in_memory, **options)
        events = recording.events[:]
        for name in "txyp":
            np.testing.assert_array_equal(getattr(events, name), c[name])
        part = recording.events[COUNT - 7 : COUNT - 2]
        np.testing.assert_array_equal(part.p, c["p"][COUNT - 7 : COUNT - 2])
    assert cli.main(["info", str(path), "--size", "50,40"]) == 0
    return recording


def rows(c: dict, order: str = "txyp") -> Any:
    return np.stack([c[name] for name in order], 1)


# One array


@pytest.mark.parametrize("order", ["txyp", "xytp", "ptxy", "xypt"])
@pytest.mark.parametrize("wide", [False, True])
@pytest.mark.parametrize("kind", ["i8", "f8"])
def test_one_array_is_read_alike(order, wide, kind, tmp_path):
    c = columns(1)
    array = rows(c, order).astype(kind)
    array = array.T if wide else array
    np.save(tmp_path / "a.npy", array)
    np.savez(tmp_path / "a.npz", array, note=np.array("kept"))
    np.savez(tmp_path / "b.npz", events=array, other=np.zeros((3, 4)))
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["events"] = array
    with h5py.File(tmp_path / "b.h5", "w") as file:
        file["data"] = array
    ones = {"x": c["x"] + 1, "y": c["y"] + 1}
    from_one = rows(c | ones, order).astype(kind)
    scipy.io.savemat(tmp_path / "a.mat", {"data": from_one.T if wide else from_one})
    scipy.io.savemat(tmp_path / "b.mat", {"data": array})
    for name in ("a.npy", "a.npz", "b.npz", "a.h5", "b.h5", "a.mat", "b.mat"):
        recording = assert_read(tmp_path / name, c)
    assert recording.notes == ("x and y count from 0, as a 0 occurs",)


def test_arrays_in_which_no_order_fits_are_refused(tmp_path, capsys):
    c = columns(2)
    for shape in ("npy", "npz"):
        path = tmp_path / f"a.{shape}"
        (np.save if shape == "npy" else np.savez)(path, rows(c)[::-1])
        fails(capsys, ["info", path, "--size", "50,40"], path, "its four columns without names")
    np.savez(tmp_path / "b.npz", rows(c), rows(c))
    fails(capsys, ["info", tmp_path / "b.npz", "--size", "50,40"], "has no t and no x")
    np.save(tmp_path / "b.npy", rows(c)[:, :3])
    fails(capsys, ["info", tmp_path / "b.npy", "--size", "50,40"], "with the fields t, x, y and p")


# Polarities without a sign


@pytest.mark.parametrize("bits", [8, 16, 32, 64])
def test_minus_one_without_its_sign(bits, tmp_path):
    """HDF5 of v2e holds -1 in uint32, which is 4294967295."""
    c = columns(3)
    p = np.where(c["p"] == 1, 1, -1).astype(f"i{bits // 8}").view(f"u{bits // 8}")
    stored = c | {"p": p}
    np.savez(tmp_path / "a.npz", **stored)
    records = np.zeros(COUNT, [(name, stored[name].dtype) for name in "xytp"])
    for name in "xytp":
        records[name] = stored[name]
    np.save(tmp_path / "a.npy", records)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for name, values in stored.items():
            file[f"events/{name}"] = values
    lines = [f"{t} {x} {y} {p}" for t, x, y, p in zip(*stored.values(), strict=True)]
    (tmp_path / "a.txt").write_text("t x y p\n" + "\n".join(lines))
    names = ["a.npz", "a.npy", "a.h5", "a.txt"]
    if bits == 32:
        with h5py.File(tmp_path / "b.h5", "w") as file:
            file["events"] = rows(stored).astype(np.uint32)
        np.save(tmp_path / "b.npy", rows(stored).astype(np.float64))
        names += ["b.h5", "b.npy"]
    for name in names:
        assert_read(tmp_path / name, c)


def test_levels_of_0_and_255_are_refused(tmp_path, capsys):
    """They are ON where they are not 0 in one program, -1 in another."""
    c = columns(4)
    stored = c | {"p": (c["p"] * 255).astype(np.uint8)}
    np.savez(tmp_path / "a.npz", **stored)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for name, values in stored.items():
            file[f"events/{name}"] = values
    fails(capsys, ["info", tmp_path / "a.npz", "--size", "50,40"], "polarity 255")
    lazy = jaxevent.load(tmp_path / "a.h5", SIZE, in_memory=False).events
    first = int(np.argmax(c["p"]))
    with pytest.raises(InputError, match="has the polarity 255"):
        lazy[first : first + 1]


# Tables of text


def text(c: dict, stamps: list[str], separator: str = ",", p: list[str] | None = None) -> str:
    polarity = p or [str(value) for value in c["p"]]
    table = zip(stamps, c["x"], c["y"], polarity, strict=True)
    return "".join(separator.join(map(str, row)) + "\n" for row in table)


def test_a_first_stamp_without_decimals(tmp_path):
    c = columns(5)
    c["t"][0] = 0
    stamps = ["0"] + [f"{t / 1e6:.6f}" for t in c["t"][1:]]
    (tmp_path / "a.csv").write_text("t,x,y,p\n" + text(c, stamps))
    (tmp_path / "b.txt").write_text(text(c, stamps, " "))
    for name in ("a.csv", "b.txt"):
        assert assert_read(tmp_path / name, c).notes == ()


@pytest.mark.parametrize(
    ("before", "separator", "end", "mark"),
    [
        ("t;x;y;on", ";", "\n", ","),
        ("t;x;y;p", ";", "\r\n", "."),
        ("# t x y p", " ", "\r\n", "."),
        ("% recorded outdoors\n#t,x,y,polarity", ",", "\n", "."),
        ("timestamp\tx\ty\tpol", "\t", "\n", ","),
        ('"t","x","y","p"', ",", "\r\n", "."),
        ("T , X , Y , P", " , ", "\n", "."),
    ],
)
def test_tables_as_programs_write_them(before, separator, end, mark, tmp_path):
    c = columns(6)
    stamps = [f"{t / 1e6:.6f}".replace(".", mark) for t in c["t"]]
    table = before + "\n" + text(c, stamps, separator)
    (tmp_path / "a.csv").write_bytes(table.replace("\n", end).encode())
    assert_read(tmp_path / "a.csv", c)


def test_decimal_commas_between_commas_are_refused(tmp_path, capsys):
    c = columns(6)
    stamps = [f"{t / 1e6:.6f}".replace(".", ",") for t in c["t"]]
    (tmp_path / "a.csv").write_text("t,x,y,p\n" + text(c, stamps))
    fails(capsys, ["info", tmp_path / "a.csv"], "does not have the columns t, x, y, p")


@pytest.mark.parametrize(
    ("first", "order", "scale"),
    [
        ("t x y p", "txyp", None),
        ("x y pol timestamp", "xypt", None),
        ("# t [us] x y p", "txyp", 1),
        ("50 40\nx y t_ns p", "xytp", 1000),
        ("x y ts_us polarity\n50 40", "xytp", 1),
    ],
)
def test_folders_may_name_the_columns_of_events(first, order, scale, tmp_path):
    c = columns(7)
    stamps = [f"{t / 1e6:.6f}" if scale is None else str(t * scale) for t in c["t"]]
    held = {"t": stamps, "x": c["x"], "y": c["y"], "p": c["p"]}
    lines = [" ".join(map(str, row)) for row in zip(*(held[name] for name in order), strict=True)]
    (tmp_path / "events.txt").write_text(first + "\n" + "\n".join(lines) + "\n")
    assert_read(tmp_path, c)


def test_names_above_poses_are_passed_over(tmp_path):
    c = columns(8)
    (tmp_path / "events.txt").write_text(text(c, [f"{t / 1e6:.6f}" for t in c["t"]], " "))
    (tmp_path / "groundtruth.txt").write_text(
        "timestamp tx ty tz qx qy qz qw\n0.1 1 2 3 0 0 0 1\n0.2 1 2 3 0 0 0 1\n"
    )
    assert jaxevent.load(tmp_path, SIZE).poses.t.tolist() == [100_000, 200_000]


def test_names_of_columns():
    assert find_fields(["x", "y", "pol", "t_ns"]) == {"t": "t_ns", "x": "x", "y": "y", "p": "pol"}
    assert find_fields(["t", "t_ns", "x", "y", "on"])["t"] == "t"
    assert find_fields(["t_us", "t_ns", "x", "y", "on"])["t"] == "t_us"
    assert find_fields(["t", "ts", "x", "y", "p"]) is None
    assert find_fields(["x", "y", "p"]) is None
    units = ["x [px]", "y_px", "t [us]", "polarity (1)"]
    assert find_fields(units) == dict(zip("xytp", units, strict=True))


# Parquet and Feather


def table_of(c: dict) -> Any:
    arrow = pytest.importorskip("pyarrow")
    more = {"label": arrow.array(["a"] * COUNT), "y": c["y"].astype(np.int16)}
    return arrow.table({"x": c["x"], "t": c["t"], "polarity": c["p"].astype(bool), **more})


@pytest.mark.parametrize("group", [COUNT, 130, 64])
def test_parquet_is_read_by_groups_of_rows(group, tmp_path, monkeypatch):
    parquet = pytest.importorskip("pyarrow.parquet")
    from jaxevent.io import decoded

    c = columns(9)
    parquet.write_table(table_of(c), tmp_path / "a.parquet", row_group_size=group)
    assert_read(tmp_path / "a.parquet", c)
    monkeypatch.setattr(decoded, "BLOCK_EVENTS", 90)
    read: list[int] = []
    whole = parquet.ParquetFile.read_row_group
    monkeypatch.setattr(
        parquet.ParquetFile,
        "read_row_group",
        lambda self, number, **more: (read.append(number), whole(self, number, **more))[1],
    )
    stored = jaxevent.load(tmp_path / "a.parquet", SIZE, in_memory=False).events
    read.clear()
    np.testing.assert_array_equal(stored[:].t, c["t"])
    assert read == sorted(read)  # forwards, each once or twice
    assert len(read) <= 2 * -(-COUNT // group)


def test_feather(tmp_path):
    feather = pytest.importorskip("pyarrow.feather")
    c = columns(10)
    for compression in ("uncompressed", "lz4"):
        feather.write_feather(
            table_of(c), tmp_path / "a.feather", compression=compression, chunksize=90
        )
        assert_read(tmp_path / "a.feather", c)


def test_pandas_writes_parquet(tmp_path):
    pytest.importorskip("pyarrow")
    import pandas as pd

    c = columns(11)
    frame = pd.DataFrame(c).rename(columns={"t": "timestamp"})
    frame["timestamp"] = pd.to_timedelta(frame["timestamp"], unit="us")
    frame.to_parquet(tmp_path / "a.parquet")
    recording = assert_read(tmp_path / "a.parquet", c)
    assert "by the type timedelta64" in recording.notes[0]


def test_bad_parquet(tmp_path, capsys, monkeypatch):
    arrow = pytest.importorskip("pyarrow")
    parquet = pytest.importorskip("pyarrow.parquet")
    c = columns(12)
    path = tmp_path / "a.parquet"
    argv = ["info", path, "--size", "50,40"]
    for changed, said in (
        ({"t": [None] + [5] * (COUNT - 1)}, "the column t has empty values"),
        ({"x": ["a"] * COUNT}, "the column x is string; store numbers"),
        ({"p": [3] * COUNT}, "has the polarity 3"),
        ({"t": c["t"][::-1].copy()}, "earlier"),
    ):
        parquet.write_table(arrow.table({**c, **changed}), path)
        fails(capsys, argv, path, said)
    parquet.write_table(arrow.table({"a": c["t"], "b": c["x"]}), path)
    fails(capsys, argv, path, "has the columns a, b; name those of the events t, x, y and p")
    parquet.write_table(arrow.table(c), path)
    fails(capsys, argv[:2], path, "--size")
    content = path.read_bytes()
    path.write_bytes(content[:-300])
    fails(capsys, argv, path, "cannot be read")
    path.write_bytes(content)
    monkeypatch.setitem(sys.modules, "pyarrow.parquet", None)
    fails(capsys, argv, "'pyarrow'", "parquet")


# MATLAB


@pytest.mark.parametrize("first", [0, 1])
def test_vectors_and_structs_of_matlab(first, tmp_path):
    """ASL-DVS has ts, x, y and pol; others a struct of them."""
    c = columns(13)
    held = {"ts": c["t"], "x": c["x"] + first, "y": c["y"] + first, "pol": c["p"]}
    scipy.io.savemat(tmp_path / "a.mat", {k: v[:, None] for k, v in held.items()})
    scipy.io.savemat(tmp_path / "b.mat", held, do_compression=True)
    struct = {"events": held, "info": {"name": "a", "rate": 5.0, "more": {"deep": 1.0}}}
    scipy.io.savemat(tmp_path / "c.mat", struct, do_compression=True)
    scipy.io.savemat(tmp_path / "d.mat", {"TD": {**held, "note": "text"}, "gain": 2.0})
    with h5py.File(tmp_path / "e.mat", "w", userblock_size=512) as file:
        for name, values in held.items():
            file[f"events/{name}"] = values[None, :]
    with (tmp_path / "e.mat").open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\0\2IM")
    for name in "abcde":
        recording = assert_read(tmp_path / f"{name}.mat", c)
        assert len(recording.notes) == (first == 0)
    assert jaxevent.load(tmp_path / "c.mat", SIZE).extra["info.rate"] == 5
    assert set(jaxevent.load(tmp_path / "c.mat", SIZE).extra) == {"info.rate"}
    assert set(jaxevent.load(tmp_path / "d.mat", SIZE).extra) == {"gain"}


def test_arrays_of_structs_are_refused(tmp_path, capsys):
    c = columns(14)
    records = np.zeros(COUNT, [(name, "f8") for name in "txyp"])
    for name in "txyp":
        records[name] = c[name]
    scipy.io.savemat(tmp_path / "a.mat", {"events": records})
    argv = ["info", tmp_path / "a.mat", "--size", "50,40"]
    fails(capsys, argv, "no numeric variable events", "vectors t, x, y and p")


def test_damaged_structs_are_refused_or_read(tmp_path):
    c = columns(15)
    path = tmp_path / "a.mat"
    scipy.io.savemat(path, {"e": {name: c[name][:20] for name in "txyp"}})
    content = path.read_bytes()
    random = np.random.default_rng(0)
    outcomes = set()
    for _ in range(150):
        damaged = bytearray(content)
        damaged[random.integers(128, len(content))] = random.integers(256)
        path.write_bytes(damaged)
        try:
            jaxevent.load(path, SIZE)
            outcomes.add("read")
        except InputError as error:
            assert str(path) in str(error)
            outcomes.add("refused")
    assert outcomes == {"read", "refused"}


# HDF5


@pytest.mark.parametrize("resolution", [(40, 50), (40, 50, 1), (40, 50, 3)])
def test_sensor_resolution_of_two_or_three_numbers(resolution, tmp_path):
    c = columns(16)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        names = {"t": "ts", "x": "xs", "y": "ys", "p": "ps"}
        for name, values in c.items():
            file[f"events/{names[name]}"] = values / 1e6 if name == "t" else values
        file.attrs["sensor_resolution"] = resolution
    recording = jaxevent.load(tmp_path / "a.h5")
    assert (recording.width, recording.height) == SIZE
    np.testing.assert_array_equal(recording.events.t, c["t"])


def test_sensor_resolution_of_another_length_is_refused(tmp_path, capsys):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for name, values in columns().items():
            file[f"events/{name}s"] = values
        file.attrs["sensor_resolution"] = (1, 40, 50, 3)
    fails(capsys, ["info", tmp_path / "a.h5"], "the sensor's size is 4 numbers", "--size")
    assert cli.main(["info", str(tmp_path / "a.h5"), "--size", "50,40"]) == 0


# What is not read


def test_what_is_packed_or_pickled_is_named(tmp_path, capsys):
    c = columns()
    table = b"t,x,y,p\n" + text(c, [str(t) for t in c["t"]]).encode()
    for name, content, said in (
        ("a.csv.gz", gzip.compress(table), "is compressed by gzip; unpack it"),
        ("a.csv.bz2", bz2.compress(table), "is compressed by bzip2; unpack it"),
        ("a.pkl", pickle.dumps(c), "is a pickle, which can run any program"),
        ("a.feather", b"FEA1" + bytes(60), "is Feather version 1; write it anew"),
    ):
        (tmp_path / name).write_bytes(content)
        fails(capsys, ["info", tmp_path / name, "--size", "50,40"], name, said)
