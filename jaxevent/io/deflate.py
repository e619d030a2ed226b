"""Chunks of real numbers, compressed as HDF5's own filters "shuffle" and "gzip" have them, faster.

zlib spends most of its time on the bytes of mantissas, in which there is nothing to find. Here a
sample of each byte plane tells whether it is compressed or stored as it is; repeated bytes are all
that is looked for. What is written is one zlib stream, which every HDF5 library reads
(experiments/storage.py compares).
"""

import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

_SAMPLE = 1024  # bytes from the middle of a plane
_WORTH = 0.9  # of a sample: planes that do not get smaller than that are stored
_RAW = -15  # deflate alone, without zlib's header and check


def shuffled(numbers: NDArray[np.floating]) -> bytes:
    """Numbers as a chunk of a dataset of their type, with `compression="gzip", shuffle=True`."""
    size = numbers.dtype.itemsize
    words = np.ascontiguousarray(numbers).reshape(-1).view(f"u{size}")
    parts, check = [b"\x78\x01"], 1
    for k in range(size):
        plane = (words >> (8 * k)).astype(np.uint8).data
        squeezer = _squeezer(plane)
        how = zlib.Z_FINISH if k + 1 == size else zlib.Z_FULL_FLUSH
        parts += [squeezer.compress(plane), squeezer.flush(how)]
        check = zlib.adler32(plane, check)
    return b"".join([*parts, check.to_bytes(4, "big")])


def _squeezer(plane: memoryview) -> Any:
    middle = max(len(plane) // 2 - _SAMPLE // 2, 0)
    sample = plane[middle : middle + _SAMPLE]
    tried = _compressor(1)
    size = len(tried.compress(sample)) + len(tried.flush())
    return _compressor(int(size < _WORTH * len(sample)))


def _compressor(level: int) -> Any:
    """Of deflate; level 0 stores."""
    return zlib.compressobj(level, zlib.DEFLATED, _RAW, 9, zlib.Z_RLE)
