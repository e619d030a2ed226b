"""Prophesee's event compression format (ECF, HDF5 filter 36559), read without its plugin.

A chunk holds at most 65,535 events, little-endian:

    uint32             4 n + 2 a + b: n events; a = 1: y, x and p are packed, b = 1: x and p are
    uint64             time t (us)
    times              runs until n events: uint8 16 d + c, c events at t += d. Of c = 15 the count
                       follows, uint16. d = 15: c is four bits of a difference, the lowest first,
                       and so on until d < 15
    a = 1              24 bits an event, 4096 y + 2 x + p, the highest first, in words of 32 bits
    else y             runs: uint16 32 y + c; of c = 31 the count follows, uint16
      b = 1            12 bits an event, 2 x + p, the highest first, in words of 16 bits
      else x           uint16 32 x + m: x, and of x + 1 to x + 5 those whose bit of m is set, the
                       highest first
           p           runs: uint8 128 p + c; of c = 127 the count follows, uint16

Source: ecf_codec.cpp of github.com/prophesee-ai/hdf5_ecf.
"""

from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from jaxevent.codegen import njit, njit_inlined
from jaxevent.deprecated import renamed_names
from jaxevent.io.checks import damaged

HDF5_FILTER_ID = 36559
MAX_CHUNK_EVENTS = 65535  # of a chunk
EVENT_DTYPE: np.dtype = np.dtype([("x", "<u2"), ("y", "<u2"), ("p", "<i2"), ("t", "<i8")])


class Records:
    """Compressed records x, y, p, t of a dataset, decoded when they are sliced.

    The rows of the last slice are kept, as the fields are read one after the other.
    """

    def __init__(self, stored: h5py.Dataset, source: str):
        if stored.dtype != EVENT_DTYPE or len(stored.shape) != 1:
            raise damaged(
                f"{source} is compressed with Prophesee's ECF but holds {stored.dtype}, not "
                "records x, y, p and t"
            )
        self._stored, self._source = stored, source
        self._size: int = (stored.chunks or (1,))[0]
        self.shape, self.dtype = stored.shape, EVENT_DTYPE
        self._recent = 0, 0, np.empty(0, EVENT_DTYPE)  # a range of rows, replaced as a whole

    def fields(self, name: str) -> "_Field":
        """Return one field of the records, decoded when it is sliced."""
        return _Field(self, name)

    def __getitem__(self, rows: slice) -> NDArray:
        """Decode a range of rows; `InputError` if a chunk is damaged."""
        start, stop, _ = rows.indices(self.shape[0])
        low, high, recent = self._recent
        if not low <= start <= stop <= high:
            size = self._size
            chunks = range(start // size, -(-stop // size))
            parts = [self._chunk(number) for number in chunks]
            low, high = chunks.start * size, min(chunks.stop * size, self.shape[0])
            recent = np.concatenate(parts) if parts else np.empty(0, EVENT_DTYPE)
            self._recent = low, high, recent
        return recent[start - low : stop - low]

    def _chunk(self, number: int) -> NDArray:
        first = number * self._size
        count = min(self._size, self.shape[0] - first)
        mask, data = self._stored.id.read_direct_chunk((first,))
        if mask:  # stored as they are
            records = np.frombuffer(data, EVENT_DTYPE)
        else:
            records = decode(np.frombuffer(data, np.uint8))
        if records is None or len(records) < count:
            raise damaged(f"{self._source}: the chunk of row {first} cannot be decoded")
        return records[:count]


class _Field:
    """A field of compressed records as a list of its own."""

    def __init__(self, records: Records, name: str):
        self._records, self._name = records, name

    def __getitem__(self, rows: Any) -> Any:
        if isinstance(rows, slice):
            return self._records[rows][self._name]
        row = range(self._records.shape[0])[rows]
        return self._records[row : row + 1][self._name][0]


def decode(data: NDArray[np.uint8]) -> NDArray | None:
    """Decode the records of a chunk; None if it is damaged."""
    count = int(data[:4].copy().view("<u4")[0]) >> 2 if len(data) >= 12 else MAX_CHUNK_EVENTS + 1
    if count > MAX_CHUNK_EVENTS:
        return None
    records = np.zeros(count, EVENT_DTYPE)
    t, x, y, p = np.zeros(count, np.int64), *np.zeros((3, count), np.uint16)
    if not _decode(data, t, x, y, p):
        return None
    records["t"], records["x"], records["y"], records["p"] = t, x, y, p
    return records


@njit_inlined
def _word(data, at, size):
    """Read a little-endian number.

    Args:
        data: (bytes,) uint8.
        at: Offset of the number.
        size: Number of its bytes.
    """
    value = np.uint64(0)
    for k in range(size):
        value |= np.uint64(data[at + k]) << np.uint64(8 * k)
    return np.int64(value)


@njit_inlined
def _runs(data, at, bits, size, out):
    """Decode run lengths: numbers with the count of their repetitions in the low bits.

    Args:
        data: (bytes,) uint8.
        at: Offset of the first number.
        bits: Number of bits of the count; if all are set the count follows as uint16.
        size: Bytes of a number.
        out: Output, filled.

    Returns:
        The offset after the last run; -1 if the data end before, or a count is not valid.
    """
    most, i = (1 << bits) - 1, 0
    while i < len(out):
        if at + size > len(data):
            return -1
        value = _word(data, at, size)
        count, at = value & most, at + size
        if count == most:
            if at + 2 > len(data):
                return -1
            count, at = _word(data, at, 2), at + 2
        if count == 0 or i + count > len(out):
            return -1
        out[i : i + count] = value >> bits
        i += count
    return at


@njit_inlined
def _times(data, at, t):
    """Decode the times of a chunk.

    Args:
        data: (bytes,) uint8.
        at: Offset of the first time.
        t: (n,) output, us.

    Returns:
        The offset after the times; -1 if the data end before, or a count is not valid.
    """
    now, i = _word(data, at, 8), 0
    at += 8
    while i < len(t):
        far = 0
        while at < len(data) and data[at] >= 240:
            if far < 64:
                now += np.int64(data[at] & 15) << far
            far += 4
            at += 1
        if at >= len(data):
            return -1
        now += data[at] >> 4
        count, at = np.int64(data[at] & 15), at + 1
        if count == 15:
            if at + 2 > len(data):
                return -1
            count, at = _word(data, at, 2), at + 2
        if count == 0 or i + count > len(t):
            return -1
        t[i : i + count] = now
        i += count
    return at


@njit_inlined
def _packed(data, at, width, i):
    """Read one of the numbers that are packed four to three words.

    Args:
        data: (bytes,) uint8.
        at: Offset of the first number.
        width: Bits of a number, 24 or 12.
        i: Which of the numbers.
    """
    size, begin = width // 6, i % 4 * width  # bytes of a word; the bit where the number begins
    bits = 8 * size
    first = min(begin // bits, 1)
    place = at + (i // 4 * 3 + first) * size
    both = _word(data, place, size) << bits | _word(data, place + size, size)
    return both >> ((2 + first) * bits - begin - width) & ((1 << width) - 1)


@njit
def _decode(data, t, x, y, p):
    """Decode the events of a chunk.

    Args:
        data: (bytes,) uint8.
        t: (n,) output, us.
        x: (n,) output, px.
        y: (n,) output, px.
        p: (n,) output.

    Returns:
        Whether the chunk is whole.
    """
    n, kind = len(t), data[0] & 3
    at = _times(data, 4, t)
    if at < 0:
        return False
    if kind & 2:
        if at + -(-n // 4) * 12 > len(data):
            return False
        for i in range(n):
            value = _packed(data, at, 24, i)
            y[i], x[i], p[i] = value >> 12 & 2047, value >> 1 & 2047, value & 1
        return True
    at = _runs(data, at, 5, 2, y)
    if at < 0:
        return False
    if kind & 1:
        if at + -(-n // 4) * 6 > len(data):
            return False
        for i in range(n):
            value = _packed(data, at, 12, i)
            x[i], p[i] = value >> 1, value & 1
        return True
    i = 0
    while i < n:
        if at + 2 > len(data):
            return False
        value, at = _word(data, at, 2), at + 2
        x[i] = value >> 5
        i += 1
        for k in range(5):
            if value >> (4 - k) & 1 and i < n:
                x[i] = (value >> 5) + k + 1
                i += 1
    return _runs(data, at, 7, 1, p) >= 0


__getattr__ = renamed_names(__name__)
