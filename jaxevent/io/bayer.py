"""Bayer patterns: which pixel of a sensor sees which colour, and colours of all pixels.

A pattern names the colours of the upper left 2 x 2 pixels, row by row: "RGGB".
"""

import numpy as np
from numpy.typing import NDArray

from jaxevent.errors import InputError

PATTERNS = ("RGGB", "BGGR", "GRBG", "GBRG")  # of a 2 x 2 cell, row by row


def sites(pattern: str) -> dict[str, tuple[int, int]]:
    """Return the row and column in the 2 x 2 cell of R, G1, G2 and B.

    G1 is the first green, row by row. Raises `InputError` for other patterns.
    """
    if pattern not in PATTERNS:
        raise InputError(
            f"the colour pattern {pattern!r} is not one of {', '.join(PATTERNS)}; other patterns "
            "cannot be split"
        )
    greens = iter(("G1", "G2"))
    names = [next(greens) if letter == "G" else letter for letter in pattern]
    found = {name: divmod(place, 2) for place, name in enumerate(names)}
    return {name: found[name] for name in ("R", "G1", "G2", "B")}


def demosaic(mosaic: NDArray, pattern: str) -> NDArray[np.floating]:
    """Return the colours (n, height, width, 3), red first, of raw images (n, height, width).

    Bilinear: a colour keeps its values at its sites; elsewhere it is the mean of its 2 or 4 nearest
    sites, at the border of those that exist. Floats of the precision of `mosaic`, at least 32 bits.
    Raises `InputError` for other patterns.
    """
    import scipy.ndimage  # slow to import

    places = sites(pattern)
    shape, dtype = mosaic.shape, np.result_type(np.float32, mosaic)
    out = np.empty((*shape, 3), dtype)
    cross = np.array([[0, 1, 0], [1, 4, 1], [0, 1, 0]], dtype)
    square = np.array([[1, 2, 1], [2, 4, 2], [1, 2, 1]], dtype)
    for axis, (names, kernel) in enumerate(
        ((("R",), square), (("G1", "G2"), cross), (("B",), square))
    ):
        known = np.zeros(shape[1:], dtype)
        for name in names:
            row, column = places[name]
            known[row::2, column::2] = 1
        weights = scipy.ndimage.convolve(known, kernel, mode="constant")
        total = scipy.ndimage.convolve(mosaic * known, kernel[None], mode="constant")
        out[..., axis] = total / weights
    return out
