"""PNG images of 16 bits, grey or in three colours, of which Pillow reads 8 bits (W3C PNG, 3rd ed.).

Rows are filtered (section 9): what is stored is the difference to a prediction from the bytes to
the left (a), above (b) and above to the left (c).
"""

import struct
import zlib

import numpy as np
from numpy.typing import NDArray

from jaxevent.codegen import njit
from jaxevent.io.checks import check_unfolded, damaged

_MAGIC = b"\x89PNG\r\n\x1a\n"
_CHANNELS = {0: 1, 2: 3}  # by the type of colour
_HEADER = ">IIBBBBB"  # width, height, bits, colour, compression, filter, interlacing


def decode(data: bytes, source: str) -> NDArray[np.uint16] | None:
    """Decode a PNG image of 16 bits.

    Args:
        data: The bytes of the file.
        source: Name of the file for messages.

    Returns:
        (height, width), or (height, width, 3) with red first; None of other images.

    Raises:
        InputError: The file is damaged.
    """
    if data[:8] != _MAGIC or data[12:16] != b"IHDR" or len(data) < 33:
        return None
    width, height, bits, colour, *rest = struct.unpack(_HEADER, data[16:29])
    if bits != 16 or colour not in _CHANNELS or rest != [0, 0, 0]:
        return None
    channels = _CHANNELS[colour]
    shape = height, 1 + 2 * width * channels
    check_unfolded(shape[0] * shape[1], len(data), source)
    parts, place = [], 8
    while place + 8 <= len(data):
        length, kind = struct.unpack(">I4s", data[place : place + 8])
        if kind == b"IDAT":
            parts.append(data[place + 8 : place + 8 + length])
        place += 12 + length
    unpack = zlib.decompressobj()
    try:
        raw = unpack.decompress(b"".join(parts), shape[0] * shape[1] + 1)
    except zlib.error as error:
        raise damaged(f"{source}: its image cannot be unpacked ({error})") from None
    if len(raw) != shape[0] * shape[1]:
        raise damaged(f"{source}: its image has {len(raw)} bytes instead of {shape[0] * shape[1]}")
    rows = np.frombuffer(raw, np.uint8).reshape(shape)
    if rows[:, 0].max(initial=0) > 4:
        raise damaged(f"{source}: a row has the filter {rows[:, 0].max()}, not 0 to 4")
    image = _without_filters(rows, 2 * channels).view(">u2").astype(np.uint16)
    return image.reshape((height, width, channels)[: 2 + (channels > 1)])


def encode(image: NDArray[np.uint16]) -> bytes:
    """Encode a PNG image of 16 bits.

    Args:
        image: (height, width), or (height, width, 3) with red first.

    Returns:
        The bytes of the file.
    """
    height, width = image.shape[:2]
    raw = image.astype(">u2").reshape(height, -1).view(np.uint8)
    # Each row begins with its filter, 2: what is stored is the difference to the row above.
    rows = np.concatenate([raw[:1], raw[1:] - raw[:-1]])
    filtered = np.concatenate([np.full((height, 1), 2, np.uint8), rows], 1)

    def chunk(kind: bytes, data: bytes) -> bytes:
        crc = zlib.crc32(kind + data)
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", crc)

    header = struct.pack(_HEADER, width, height, 16, 2 if image.ndim == 3 else 0, 0, 0, 0)
    data = zlib.compress(filtered.tobytes(), 6)
    return _MAGIC + chunk(b"IHDR", header) + chunk(b"IDAT", data) + chunk(b"IEND", b"")


@njit
def _without_filters(rows, step):
    """Undo the filters of rows.

    Args:
        rows: (height, 1 + n) kind of filter of each row, and its filtered bytes.
        step: Bytes of a pixel.

    Returns:
        (height, n) bytes.
    """
    height, n = rows.shape[0], rows.shape[1] - 1
    out = np.zeros((height, n), np.uint8)
    for y in range(height):
        kind = rows[y, 0]
        for i in range(n):
            a = np.int64(out[y, i - step]) if i >= step else np.int64(0)
            b = np.int64(out[y - 1, i]) if y > 0 else np.int64(0)
            c = np.int64(out[y - 1, i - step]) if y > 0 and i >= step else np.int64(0)
            guess = np.int64(0)
            if kind == 1:
                guess = a
            elif kind == 2:
                guess = b
            elif kind == 3:
                guess = (a + b) // 2
            elif kind == 4:
                # Paeth: the one nearest to a + b - c, whose distance is that of the others' sum.
                to_a, to_b, to_c = abs(b - c), abs(a - c), abs(a + b - 2 * c)
                guess = a if to_a <= to_b and to_a <= to_c else (b if to_b <= to_c else c)
            out[y, i] = np.uint8((np.int64(rows[y, i + 1]) + guess) & 255)
    return out
