"""No value is altered silently: each is kept exactly or refused; and triggers are kept."""

import struct
from io import BytesIO
from typing import Any

import formats
import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from refusals import refuses

from jaxevent import io
from jaxevent.errors import InputError
from jaxevent.recording import Events, Recording, Triggers, microseconds

load: Any = io.load
SIZE = (40, 30)
EVENTS = formats.events_of(0, 200, SIZE, start=5_000)


def same(got, want):
    for name in "txyp":
        np.testing.assert_array_equal(getattr(got[:], name), getattr(want, name), err_msg=name)


# Sizes and coordinates


@pytest.mark.parametrize("kind", ["npz", "npy", "csv", "h5", "evt2"])
def test_no_coordinate_wraps(kind, tmp_path):
    path, x = tmp_path / f"a.{kind}", np.array([66_000, 1])
    columns = dict(t=np.array([1, 2]), x=x, y=x * 0, p=x == 1)
    if kind == "npz":
        np.savez(path, **columns, width=70_000, height=30)
    elif kind == "npy":
        records = np.zeros(2, [(name, values.dtype) for name, values in columns.items()])
        for name, values in columns.items():
            records[name] = values
        np.save(path, records)
    elif kind == "csv":
        path.write_text("t,x,y,p\n1,66000,0,0\n2,1,0,1\n")
    elif kind == "h5":
        with h5py.File(path, "w") as file:
            for name, values in columns.items():
                file[f"events/{name}"] = values
            file.attrs["width"], file.attrs["height"] = 70_000, 30
    else:
        path.write_bytes(formats.evt2(EVENTS, (70_000, 30)))
    refuses("at most 65536", load, path, (70_000, 30))
    if kind in ("npz", "h5", "evt2"):
        for in_memory in (True, False):
            with pytest.raises(InputError, match="70000x30 pixels, but at most 65536"):
                load(path, None, in_memory).events[:]


@pytest.mark.parametrize("value", [40.5, "wide", [40, 41], np.nan])
def test_sizes_are_whole_numbers(value, tmp_path):
    path = tmp_path / "a.h5"
    path.write_bytes(formats.dsec(EVENTS, SIZE))
    with h5py.File(path, "r+") as file:
        file.attrs["width"], file.attrs["height"] = value, 30
    refuses("width must be one whole number", load, path)


def test_a_size_may_be_an_array(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("0.1 1 2 1\n0.2 3 4 0\n")
    found = load(path, size=np.array([40, 30]))
    assert (found.width, found.height) == (40, 30) and type(found.width) is int


def test_sizes_are_positive(tmp_path):
    path = tmp_path / "a.h5"
    path.write_bytes(formats.dsec(EVENTS, SIZE))
    with h5py.File(path, "r+") as file:
        file.attrs["width"], file.attrs["height"] = -40, 30
    refuses("the sensor has -40x30 pixels", load, path)


def test_a_message_names_the_file_once(tmp_path):
    path, columns = tmp_path / "mine.npz", {name: getattr(EVENTS, name) for name in "txyp"}
    np.savez(path, **columns, width=40, height=30, frames=np.zeros((2, 20, 40)), frame_t=[1, 2])
    with pytest.raises(InputError) as caught:
        load(path)
    assert str(caught.value).startswith(f"{path}: frames have shape (2, 20, 40)")


def test_an_array_of_another_shape_is_named_by_it(tmp_path):
    np.save(tmp_path / "a.npy", np.zeros((5, 50)))
    refuses(r"float64 of shape \(5, 50\)", load, tmp_path / "a.npy", SIZE)


# Times


@pytest.mark.parametrize("value", [2**62, 0.5, np.nan, [1, 2]])
def test_offsets_of_time_are_whole_numbers(value, tmp_path):
    path = tmp_path / "a.h5"
    path.write_bytes(formats.dsec(EVENTS, SIZE, value))
    refuses("t_offset must be one whole number", load, path, SIZE)


@pytest.mark.parametrize("value", [2**62, 2**63 + 5, 2**64 - 1])
def test_no_time_turns_negative(value, tmp_path):
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        file["events/t"] = np.array([1, value], np.uint64)
        for name in "xyp":
            file[f"events/{name}"] = np.zeros(2, np.uint8)
    refuses(f"event 1 has the time {value}, .* too large", load, path, SIZE)
    refuses("too large for microseconds", load(path, SIZE, in_memory=False).events.index, 5)
    if value >= 2**63:
        refuses("too large for microseconds", microseconds, np.array([value], np.uint64))


def test_times_of_infinite_seconds_are_refused():
    refuses("too large for microseconds", microseconds, 1e13)
    assert microseconds(9e12).item() == 9 * 10**18


@pytest.mark.parametrize("name", ["evt2", "evt21"])
def test_a_clock_below_its_start_loses_no_event(name, tmp_path):
    """TIME_HIGH 0, then 2^28 - 1: the counter steps back over 0, and time goes on from -64 us."""
    shift, words = (0, []) if name == "evt2" else (32, [])
    width = 28 + shift
    place = (lambda x, y: x << 11 | y) if name == "evt2" else (lambda x, y: y << 32 | 1 << x)
    for high, x in ((2**28 - 1, 3), (0, 4), (1, 5)):
        words += [8 << width | high << shift, 1 << width | place(x, 7)]
    early = [1 << width | place(1, 1)]
    content = f"% evt {'2.0' if name == 'evt2' else '2.1'}\n".encode()
    content += b"" if name == "evt2" else b"% format EVT21;endianness=little\n"
    words = early + [8 << width] + words
    kind = "<u4" if name == "evt2" else "<u8"
    (tmp_path / "a.raw").write_bytes(content + b"% end\n" + np.array(words, kind).tobytes())
    got = load(tmp_path / "a.raw", SIZE)
    assert got.events.t.tolist() == [-64, 0, 64] and got.events.x.tolist() == [3, 4, 5]
    assert got.extra["events_without_time"] == 1


def test_float_times_are_seconds_or_whole_microseconds(tmp_path):
    columns = {name: getattr(EVENTS, name) for name in "xyp"}
    for scale in (1.0, 1e6):  # us, s
        t = EVENTS.t / scale
        np.savez(tmp_path / "a.npz", t=t, **columns)
        same(load(tmp_path / "a.npz", SIZE).events, EVENTS)
        with h5py.File(tmp_path / "a.h5", "w") as file:
            for name, values in {"ts": t, **columns}.items():
                file[f"events/{name}"] = values
        with h5py.File(tmp_path / "b.h5", "w") as file:
            for name, values in {"t": t, **columns}.items():
                file[f"events/{name}"] = values
        for in_memory in (True, False):
            same(load(tmp_path / "a.h5", SIZE, in_memory).events, EVENTS)
            same(load(tmp_path / "b.h5", SIZE, in_memory).events, EVENTS)
    np.savez(tmp_path / "a.npz", t=EVENTS.t * 1e3 + 0.5, **columns)
    refuses("span .* days; store them as integer microseconds", load, tmp_path / "a.npz", SIZE)


def test_times_of_images_may_be_microseconds(tmp_path):
    path = tmp_path / "a.h5"
    path.write_bytes(formats.event_utils(EVENTS, SIZE, np.zeros((1, 30, 40), "u1"), [7_000]))
    with h5py.File(path, "r+") as file:
        file["images/image000000000"].attrs["timestamp"] = 7_000
    assert load(path).frames.t.tolist() == [7_000]


def test_whole_seconds_in_the_text_layout_are_refused(tmp_path):
    (tmp_path / "events.txt").write_text("5000 1 2 1\n6000 1 2 0\n")
    refuses("all times are whole numbers, but .* are seconds", load, tmp_path, SIZE)


def test_a_day_between_two_events_makes_no_large_index(tmp_path):
    far = Events(np.array([0, 86_400_000_000]), *(getattr(EVENTS[:2], name) for name in "xyp"))
    io.save(Recording("a", *SIZE, far), tmp_path / "a.h5")
    assert (tmp_path / "a.h5").stat().st_size < 100_000
    stored = load(tmp_path / "a.h5", in_memory=False).events
    same(stored, far)
    assert [stored.index(t) for t in (0, 1, 86_400_000_000, 86_400_000_001)] == [0, 1, 1, 2]


# Columns without names


@pytest.mark.parametrize("order", ["txyp", "xypt", "xytp", "ptxy"])
@settings(max_examples=6)
@given(seed=st.integers(0, 2**32 - 1), sign=st.booleans())
def test_columns_are_told_apart_by_what_they_hold(order, seed, sign, tmp_path_factory):
    events = formats.events_of(seed, 60, SIZE, start=5_000)
    held = {name: getattr(events, name).astype(np.int64) for name in "txyp"}
    held["p"] = np.where(events.p, 1, -1 if sign else 0)
    table = np.stack([held[name] for name in order], 1)
    folder = tmp_path_factory.getbasetemp()
    np.save(folder / "a.npy", table)
    np.save(folder / "b.npy", table.astype(np.float64))
    lines = "\n".join(" ".join(map(str, row)) for row in table.tolist())
    (folder / "a.txt").write_text(lines)
    (folder / "a.csv").write_text(lines.replace(" ", ","))
    with h5py.File(folder / "v2e.h5", "w") as file:
        file["events"] = table if sign else table.astype(np.uint32)
    for name in ("a.npy", "b.npy", "a.txt", "a.csv", "v2e.h5"):
        for in_memory in (True, False):
            same(load(folder / name, SIZE, in_memory).events, events)


def test_columns_that_could_be_others_are_refused(tmp_path):
    np.save(tmp_path / "a.npy", np.array([[1, 2, 3, 1], [2, 3, 4, 0]]))
    refuses("could be t x y p or x y t p; .* name the columns", load, tmp_path / "a.npy", SIZE)
    np.save(tmp_path / "a.npy", np.full((3, 4), 0.5))
    refuses("cannot be t x y p or", load, tmp_path / "a.npy", SIZE)


# Images


def _png_of_16_bit_colours() -> bytes:
    import zlib

    def chunk(name, body):
        return (
            struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))
        )

    rows = b"".join(b"\0" + bytes(6 * 40) for _ in range(30))
    head = chunk(b"IHDR", struct.pack(">2I5B", 40, 30, 16, 2, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + head + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")


def _tiff(values) -> bytes:
    held = BytesIO()
    Image.fromarray(values).save(held, "TIFF")
    return held.getvalue()


@pytest.mark.parametrize(
    "content, want",
    [
        (_tiff(np.full((30, 40), 0.7, np.float32)), np.float32(0.7)),
        (_tiff(np.full((30, 40), 30_000, np.int32)), np.uint16(30_000)),
        (_tiff(np.full((30, 40), 70_000, np.int32)), "holds values from 70000 to 70000"),
        (_tiff(np.full((30, 40), -1, np.int32)), "holds values from -1 to -1"),
        (_tiff(np.full((30, 40), 1.5, np.float32)), "outside .0, 1.; scale"),
        (_png_of_16_bit_colours(), "holds colours of 16 bits"),
    ],
)
def test_images_keep_their_values(content, want, tmp_path):
    (tmp_path / "events.txt").write_text("0.5 1 2 1\n")
    (tmp_path / "images.txt").write_text("0.5 a.tif\n")
    (tmp_path / "a.tif").write_bytes(content)
    if isinstance(want, str):
        refuses(want, load, tmp_path)
        return
    images = load(tmp_path).frames.images
    assert images.dtype == want.dtype and (images == want).all()


def test_several_images_in_one_file_are_refused(tmp_path):
    frame = Image.fromarray(np.zeros((30, 40), np.uint8))
    frame.save(tmp_path / "a.tif", save_all=True, append_images=[frame])
    (tmp_path / "events.txt").write_text("0.5 1 2 1\n")
    (tmp_path / "images.txt").write_text("0.5 a.tif\n")
    refuses("holds several images", load, tmp_path)


def test_float_colours_in_hdf5_stay_floats(tmp_path):
    path = tmp_path / "a.h5"
    colours = np.full((1, 30, 40, 3), 0.25)
    path.write_bytes(formats.event_utils(EVENTS, SIZE, colours, [7_000]))
    np.testing.assert_allclose(load(path).frames.images, 0.25)


# AEDAT


def test_a_table_of_packets_where_a_packet_is(tmp_path):
    pytest.importorskip("aedat")
    content = bytearray(formats.aedat4(EVENTS, SIZE, packet=50))
    (size,) = struct.unpack_from("<I", content, 14)
    first = 18 + size
    (length,) = struct.unpack_from("<i", content, first + 4)
    at = content.index(struct.pack("<q", -1), 14, first)
    struct.pack_into("<q", content, at, first + 8 + length)
    (tmp_path / "a.aedat4").write_bytes(content)
    refuses("table of packets at byte [0-9]+ .* there is none", load, tmp_path / "a.aedat4")


def test_dvs128(tmp_path):
    events = formats.events_of(3, 300, (128, 128), span=10**6)
    (tmp_path / "a.aedat").write_bytes(formats.dvs128(events, [7, 70_000]))
    for in_memory in (True, False):
        got = load(tmp_path / "a.aedat", None, in_memory)
        assert (got.width, got.height) == (128, 128)
        assert sorted(formats.rows(got.events[:])) == sorted(formats.rows(events))
        assert got.triggers.t.tolist() == [7, 70_000] and got.triggers.edge.tolist() == [-1, -1]
    (tmp_path / "a.aedat").write_bytes(formats.dvs128(events, tick="20 ms"))
    refuses("count ticks of 20 ms", load, tmp_path / "a.aedat")
    (tmp_path / "a.aedat").write_bytes(formats.dvs128(events) + struct.pack(">2I", 1 << 20, 10**7))
    refuses("record 300 has the address 0x100000", load, tmp_path / "a.aedat")


# N-Caltech101


@given(seed=st.integers(0, 2**32 - 1), count=st.integers(20, 60))
def test_n_caltech(seed, count, tmp_path_factory):
    events = formats.events_of(seed, count, (200, 180), 100_000)
    path = tmp_path_factory.getbasetemp() / "a.bin"
    path.write_bytes(formats.n_caltech(events))
    for in_memory in (True, False):
        same(load(path, (200, 180), in_memory).events, events)
    refuses("could be a .bin of N-Caltech101", load, path)


# Triggers


def test_triggers_of_evt2_and_evt21(tmp_path):
    words = [8 << 28 | 5, 1 << 28 | 3 << 11 | 4, 10 << 28 | 9 << 22 | 6 << 8 | 1, 8 << 28 | 7]
    words += [10 << 28 | 2 << 22 | 1 << 8, 1 << 28 | 5 << 22]
    (tmp_path / "a.raw").write_bytes(b"% evt 2.0\n% end\n" + np.array(words, "<u4").tobytes())
    long = [word >> 28 << 60 | (word & 0xFFFFFFF) << 32 for word in words]
    long[1] |= 1
    head = b"% evt 2.1\n% format EVT21;endianness=little\n% end\n"
    (tmp_path / "b.raw").write_bytes(head + np.array(long, "<u8").tobytes())
    for name in "ab":
        for in_memory in (True, False):
            got = load(tmp_path / f"{name}.raw", (2048, 2048), in_memory).triggers
            assert got.t.tolist() == [5 * 64 + 9, 7 * 64 + 2]
            assert got.edge.tolist() == [1, 0] and got.channel.tolist() == [6, 1]


def test_triggers_of_evt3_continue_over_the_clocks_end(tmp_path, monkeypatch):
    pytest.importorskip("evt3")
    from jaxevent.io import decoded

    words = [0xA101, 0x8FFE, 0x6005, 0x0003, 0x2004, 0xA201, 0x8FFF, 0xA200]
    words += [0x8000, 0x6009, 0xA301, 0x2005]
    (tmp_path / "a.raw").write_bytes(b"% evt 3.0\n% end\n" + np.array(words, "<u2").tobytes())
    for block in (1, 2, 3, 1 << 20):
        monkeypatch.setattr(decoded, "BLOCK_EVENTS", block)
        got = load(tmp_path / "a.raw", SIZE)
        assert got.triggers.t.tolist() == [0xFFE << 12 | 5, 0xFFF << 12, 1 << 24 | 9]
        assert got.triggers.edge.tolist() == [1, 0, 1]
        assert got.triggers.channel.tolist() == [2, 2, 3]
        assert got.events.t.tolist() == [0xFFE << 12 | 5, 1 << 24 | 9]


def test_triggers_of_dat_lie_beside_the_events(tmp_path, monkeypatch):
    monkeypatch.setattr("jaxevent.io.decoded.BLOCK_EVENTS", 2)
    head = b"% Data file containing trigger events.\n% Version 2\n"
    # The third comes after the end of the clock.
    signals = [(0xF0000000, 1 | 6 << 26), (0xFFFFFFFE, 0), (9, 1 | 63 << 26)]
    content = head + bytes([14, 8]) + np.array(signals, "<u4").tobytes()
    (tmp_path / "a_trigger.dat").write_bytes(content)
    for name in ("a_cd", "a_td"):
        (tmp_path / f"{name}.dat").write_bytes(formats.dat(EVENTS, SIZE))
        for in_memory in (True, False):
            got = load(tmp_path / f"{name}.dat", None, in_memory)
            assert len(got.events) == len(EVENTS)
            assert got.triggers.t.tolist() == [0xF0000000, 0xFFFFFFFE, (1 << 32) + 9]
            assert got.triggers.edge.tolist() == [1, 0, 1]
            assert got.triggers.channel.tolist() == [6, 0, 63]
    refuses(
        "holds external triggers only; read the file of events", load, tmp_path / "a_trigger.dat"
    )
    (tmp_path / "a_trigger.dat").write_bytes(content[:-3])
    refuses("a_trigger.dat: ends inside a word, 5 bytes after", load, tmp_path / "a_cd.dat")
    (tmp_path / "a_trigger.dat").write_bytes(formats.dat(EVENTS, SIZE))
    refuses("a_trigger.dat: holds no external triggers", load, tmp_path / "a_cd.dat")


def test_triggers_are_saved_and_cut(tmp_path):
    triggers = Triggers(np.array([10, 50_000]), np.array([1, -1], "i1"), np.array([0, 7], "u1"))
    recording = Recording("a", *SIZE, EVENTS, triggers=triggers)
    io.save(recording, tmp_path / "a.h5")
    got = load(tmp_path / "a.h5").triggers
    for name in ("t", "edge", "channel"):
        np.testing.assert_array_equal(getattr(got, name), getattr(triggers, name))
    assert recording[20_000:60_000].triggers.t.tolist() == [50_000]
    assert recording[20_000:30_000].triggers is None
    with h5py.File(tmp_path / "a.h5", "r+") as file:
        del file["triggers/edge"]
        file["triggers/edge"] = [5, 1]
    refuses("triggers need an edge, -1, 0 or 1", load, tmp_path / "a.h5")
