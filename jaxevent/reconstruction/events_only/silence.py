"""Share of events that motion explains: noise and flicker show no image.

Events of an edge are carried by its motion to one place of the image, whichever pixels saw it, with
one polarity. Pixels are coloured like a chessboard. Each event is compared with the sum S and the
number N of the other colour's events at its place in the image. Over a neighbourhood of pixels

    share = sum p S / sum N                                                                  (6)

has the mean 0 for events whose polarities are independent, and for pixels that flicker where they
are, and 1 for edges on true paths. A bound of two standard deviations is subtracted.
"""

import numpy as np
from numpy.typing import NDArray

from jaxevent.codegen import njit_noalloc

NEIGHBOURHOOD_PX = 4.0  # standard deviation of the Gaussian weights in (6)
N_SIGMAS = 2.0


def explained_share(
    pixel: NDArray[np.int32],
    p: NDArray[np.bool_],
    places: NDArray[np.float32],
    shape: tuple[int, int],
) -> NDArray[np.float32]:
    """Return the share of events that their paths explain, by neighbourhood.

    Args:
        pixel: (n,) flat index of the pixel of each event.
        p: (n,) polarity.
        places: (n, 2) x and y of each event in the image, px.
        shape: (height, width) of the sensor.

    Returns:
        (height * width,) shares, 0 to 1.
    """
    from scipy.ndimage import gaussian_filter

    votes = np.zeros((2, 2, *shape), np.float32)  # colour; sum and number
    sums = np.zeros((2, *shape), np.float32)
    sign = np.where(p, np.float32(1), np.float32(-1))
    _compare_colours(pixel, sign, places, votes, sums)
    agreement, number = (gaussian_filter(part, NEIGHBOURHOOD_PX, mode="constant") for part in sums)
    one = np.float32(1 / (4 * np.pi * NEIGHBOURHOOD_PX**2))  # mean square weight of an event
    bound = N_SIGMAS * np.sqrt(one * number)
    return (np.maximum(agreement - bound, 0) / (number + one)).ravel()


@njit_noalloc
def _compare_colours(pixel, sign, places, votes, sums):
    """Compare each event with those of pixels of the other colour of a chessboard at its place.

    Args:
        pixel: (n,) flat index of the pixel of each event.
        sign: (n,) 1 of ON events, -1 of OFF events.
        places: (n, 2) x and y of each event in the image, px.
        votes: (2, 2, height, width) of each colour the sum of signs and the number, 0 at first.
        sums: (2, height, width) output, at the events' pixels: agreement, and number of the others.
    """
    height, width = sums.shape[1:]
    for is_second in range(2):
        for k in range(len(pixel)):
            x, y = places[k, 0], places[k, 1]
            if not (0 <= x < width - 1 and 0 <= y < height - 1):
                continue
            row, column = pixel[k] // width, pixel[k] % width
            colour = (row + column) % 2
            i, j = int(x), int(y)
            fx, fy = x - i, y - j
            for dj in range(2):
                for di in range(2):
                    weight = (fx if di else 1 - fx) * (fy if dj else 1 - fy)
                    if is_second:
                        other = votes[1 - colour, :, j + dj, i + di]
                        sums[0, row, column] += weight * sign[k] * other[0]
                        sums[1, row, column] += weight * other[1]
                    else:
                        votes[colour, 0, j + dj, i + di] += weight * sign[k]
                        votes[colour, 1, j + dj, i + di] += weight
