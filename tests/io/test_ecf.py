"""Prophesee's compression of events in HDF5, against an encoder that follows its layout."""

import itertools

import formats
import h5py
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from refusals import refuses

from jaxevent.io import ecf, load

SIZE = (40, 30)


def records_of(events):
    records = np.zeros(len(events), ecf.EVENT_DTYPE)
    for name in "xypt":
        records[name] = getattr(events, name)
    return records


def runs(values, count_bits, size):
    """Equal values in a row: value and count in one number, large counts behind it."""
    most = (1 << count_bits) - 1
    for value, group in itertools.groupby(values):
        count = len(list(group))
        yield (value << count_bits | min(count, most)).to_bytes(size, "little")
        if count >= most:
            yield count.to_bytes(2, "little")


def times(t):
    now = t[0]
    yield now.to_bytes(8, "little")
    for value, group in itertools.groupby(t):
        count, far = len(list(group)), value - now
        if far >= 15:
            while far:
                yield bytes([240 | far & 15])
                far >>= 4
        yield bytes([far << 4 | min(count, 15)])
        if count >= 15:
            yield count.to_bytes(2, "little")
        now = value


def packed(values, width):
    """Four numbers in three words, as bits from the highest to the lowest."""
    bits = "".join(f"{value:0{width}b}" for value in values)
    bits += "0" * (-len(bits) % (4 * width))
    word = 4 * width // 3
    for begin in range(0, len(bits), word):
        yield int(bits[begin : begin + word], 2).to_bytes(word // 8, "little")


def masked(x):
    i = 0
    while i < len(x):
        value, first, i = x[i] << 5, x[i], i + 1
        for step in range(1, 6):
            if i < len(x) and x[i] == first + step:
                value, i = value | 1 << (5 - step), i + 1
        yield value.to_bytes(2, "little")


def encoded(records, kind):
    """`kind`: 0 nothing is packed, 1 x and p, 2 y, x and p."""
    t, x, y, p = (records[name].tolist() for name in "txyp")
    parts = [(len(t) << 2 | kind).to_bytes(4, "little"), *times(t)]
    if kind == 2:
        parts += packed([4096 * b + 2 * a + c for a, b, c in zip(x, y, p, strict=True)], 24)
        return b"".join(parts)
    parts += runs(y, 5, 2)
    if kind == 1:
        parts += packed([2 * a + c for a, c in zip(x, p, strict=True)], 12)
    else:
        parts += [*masked(x), *runs(p, 7, 1)]
    return b"".join(parts)


def decoded(data):
    return ecf.decode(np.frombuffer(data, np.uint8))


@pytest.mark.slow
def test_chunks_written_out_by_hand():
    one = bytes.fromhex("06000000 0400000000000000 01 00022000 00000000 00000000")
    assert decoded(one).tolist() == [(1, 2, 0, 4)]
    # Two events at t = 256 + 3 in row 5: x = 7 and 9, the second one ON.
    two = bytes.fromhex("08000000 0001000000000000 32 a200 e000 2001 01 81")
    assert decoded(two).tolist() == [(7, 5, 0, 259), (9, 5, 1, 259)]


STEPS = {
    "t": [0, 0, 0, 1, 14, 15, 16, 255, 70_000, 1 << 33],
    "x": [0, 1, 1, 1, 2, 5, 6, 700],
    "y": [0] * 40 + [1, 3],
    "p": [0] * 99 + [1],
}
events = st.integers(1, 400).flatmap(
    lambda n: st.tuples(
        *(st.lists(st.sampled_from(steps), min_size=n, max_size=n) for steps in STEPS.values())
    )
)


@pytest.mark.slow
@given(events, st.integers(0, 2), st.integers(0, 1 << 40))
def test_what_was_encoded_is_decoded(steps, kind, start):
    records = np.zeros(len(steps[0]), ecf.EVENT_DTYPE)
    dt, dx, dy, dp = (np.cumsum(part) for part in steps)
    records["t"], records["x"], records["y"], records["p"] = (
        start + dt,
        dx % 2048,
        dy % 2048,
        dp % 2,
    )
    np.testing.assert_array_equal(decoded(encoded(records, kind)), records)


@pytest.mark.parametrize("kind", [0, 1, 2])
def test_a_chunk_that_ends_early_is_damaged(kind):
    data = encoded(records_of(formats.events_of(1, 61, SIZE)), kind)
    assert decoded(data) is not None
    assert all(decoded(data[:n]) is None for n in range(len(data)))
    # A count of 0 would never end, one that is larger than the chunk would write beyond it.
    assert decoded(data[:12] + b"\0" * 500) is None
    assert decoded(data[:12] + b"\xff" * 500) is None


def write(path, records, size, kind=0, name="CD/events"):
    with h5py.File(path, "w") as file:
        plist = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        plist.set_chunk((size,))
        plist.set_filter(ecf.HDF5_FILTER_ID, h5py.h5z.FLAG_OPTIONAL)
        lcpl = h5py.h5p.create(h5py.h5p.LINK_CREATE)
        lcpl.set_create_intermediate_group(True)
        stored = h5py.h5d.create(
            file.id, name.encode(), h5py.h5t.py_create(records.dtype),
            h5py.h5s.create_simple((len(records),)), plist, lcpl,
        )  # fmt: skip
        for first in range(0, len(records), size):
            part = records[first : first + size].astype(ecf.EVENT_DTYPE)
            stored.write_direct_chunk((first,), encoded(part, kind))
        triggers = [("p", "<i2"), ("t", "<i8"), ("id", "<i2")]
        file["EXT_TRIGGER/events"] = np.array([(1, 30, 0), (0, 80, 6)], triggers)
        file.attrs["geometry"] = f"{SIZE[0]}x{SIZE[1]}"


@pytest.mark.parametrize("kind", [0, 1, 2])
def test_a_file_is_read_whole_and_in_parts(tmp_path, kind):
    events = formats.events_of(0, 1000, SIZE)
    write(tmp_path / "a.hdf5", records_of(events), 96, kind)
    whole, stored = (load(tmp_path / "a.hdf5", in_memory=kept) for kept in (True, False))
    assert (whole.width, whole.height) == SIZE
    for got in (whole.events, stored.events[:]):
        for name in "txyp":
            np.testing.assert_array_equal(getattr(got, name), getattr(events, name))
    for first, last in ((0, 0), (95, 97), (500, 501), (990, 1000)):
        np.testing.assert_array_equal(stored.events[first:last].x, events.x[first:last])
    middle = int(events.t[500])
    assert stored.events.index(middle) == np.searchsorted(events.t, middle)
    assert whole.triggers.t.tolist() == [30, 80] and whole.triggers.edge.tolist() == [1, 0]
    assert whole.triggers.channel.tolist() == [0, 6]


def test_damage_is_told(tmp_path):
    path = tmp_path / "a.hdf5"
    write(path, records_of(formats.events_of(0, 200, SIZE)), 96)
    with h5py.File(path, "r+") as file:
        file["CD/events"].id.write_direct_chunk((96,), b"\x08")
    refuses("CD/events: the chunk of row 96 cannot be decoded", load, path)
    other = np.zeros(10, [("x", "<u2"), ("y", "<u2"), ("p", "<i2"), ("t", "<f8")])
    write(path, other, 10)
    refuses("ECF but holds.*records x, y, p and t", load, path)
