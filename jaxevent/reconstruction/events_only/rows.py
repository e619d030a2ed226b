"""Rows: linear equations that the events of a window give for one log image.

Brightness is constant along paths: the pixel x sees at time t the point that is at X(x, t) in the
image M at the target time, so L(x, t) = M(X(x, t)). Each row looks twice at M, bilinearly:

    M(X(x, t_b)) - M(X(x, t_a)) = change + noise                                             (1)

| kind | from t_a | to t_b | change |
|---|---|---|---|
| event | event before of the same pixel | event | p c_p |
| first | begin of the window | first event | p c_p 0.55 |
| last | last event | end of the window | p c_p 0.3 |
| silent | begin of the window | end of the window | 0 |

An edge that passes makes events only when its level reaches a threshold, so a part of the change
comes before the first event and after the last one. Without that part the edge would be too low,
and would lag behind. The shares are means over simulated scenes (`experiments/studies`).
A path whose velocity has the covariance C is uncertain by C (t_b - t_a)^2, so that the image there
is another. With the mean square `ROUGHNESS` of a gradient of log images, the row has the variance

    1 + SHARED_ROWS ROUGHNESS trace C (t_b - t_a)^2                                          (1b)

against that of a row with a known path, as so many rows share the error of one path. Where no event
shows the motion, silence says nothing. Weights are reciprocal variances times the share of the
events around that motion explains (`silence`).
The model of events is that of Zhang, Yezzi and Gallego (TPAMI 2022); silence is new.
"""

from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Int32, UInt32
from numpy.typing import NDArray

from jaxevent.codegen import njit_noalloc, njit_noalloc_inlined
from jaxevent.reconstruction.events_only.silence import explained_share
from jaxevent.recording import Events

EVENT, FIRST, LAST, SILENT = range(4)  # kinds of rows
NONE, MUTED = -1, -2  # in place of the number of a pixel's last event
FIRST_SHARE, LAST_SHARE = np.float32(0.55), np.float32(0.3)  # thresholds
SHARED_ROWS = 10
ROUGHNESS = 0.15  # mean square of an image's gradient along one axis, (c / px)^2


@runtime_checkable
class Paths(Protocol):
    """Paths of the scene's points towards one time, as `event_flow.WindowPaths` has them."""

    @property
    def covariance(self) -> NDArray | None:
        """Return the covariance of the velocity, (K, height, width, 2, 2), (px/s)^2, or None."""
        ...

    @property
    def spacing(self) -> float:
        """Return the distance of the nodes between which velocity is bilinear, px."""
        ...

    def carry(self, x: NDArray, y: NDArray, t: NDArray) -> tuple[NDArray, NDArray]:
        """Carry points along their paths to the target time.

        Args:
            x: (n,) positions along x, px.
            y: (n,) positions along y, px.
            t: (n,) times at which points are at these positions, us.

        Returns:
            x and y at the target time, (n,) each, px.
        """
        ...


class Rows(NamedTuple):
    """Equations (1) of one window; positions are those of the look-ups at t_b and t_a.

    Attributes:
        shape: Height and width of the image.
        threshold: Mean threshold of both polarities, ln I.
        corner: Flat index of the look-up's pixel above and left.
        fraction: Distance from there along x and y, px.
        change: Change, in thresholds.
        weight: Reciprocal variance relative to that of a common row.
        kind: (rows,) kind of the row, such as `EVENT`.
        pixel: Flat index of the pixel x.
    """

    shape: tuple[int, int]
    threshold: float
    corner: UInt32[np.ndarray, "rows 2"]
    fraction: Float[np.ndarray, "rows 2 2"]
    change: Float[np.ndarray, " rows"]
    weight: Float[np.ndarray, " rows"]
    kind: NDArray[np.uint8]
    pixel: Int32[np.ndarray, " rows"]


def carry_pixels(
    paths: Paths, shape: tuple[int, int], t: int
) -> Float[np.ndarray, "height width 2"]:
    """Carry all pixels along their paths from one time, between nodes by interpolation.

    Args:
        paths: Paths towards the target time.
        shape: (height, width) of the sensor.
        t: Time at which the pixels are in place, us.

    Returns:
        Where they are at the target time, x before y, px.
    """
    step = max(int(paths.spacing) // 2, 1)
    y, x = step * np.indices([(n + step - 2) // step + 1 for n in shape], np.float32)
    there = np.stack(paths.carry(x.ravel(), y.ravel(), np.full(x.size, t)), -1)
    there = there.astype(np.float32).reshape(*x.shape, 2)
    for axis in (0, 1) if step > 1 else ():
        k = np.arange(shape[axis])
        part = (k % step / np.float32(step)).astype(np.float32).reshape(-1, *[1] * (2 - axis))
        before, after = there.take(k // step, axis), there.take(-(-k // step), axis)
        there = before + part * (after - before)
    return there


def make_rows(
    events: Events,
    paths: Paths,
    thresholds: NDArray,
    shape: tuple[int, int],
    span: tuple[int, int],
    muted: NDArray[np.bool_] | None = None,
) -> Rows:
    """Make the equations of a window's events and of its silence.

    Args:
        events: Events of the window, in order of time.
        paths: Paths towards the target time.
        thresholds: (2,) or (2, height, width) ln I, of ON and OFF events.
        shape: (height, width) of the sensor.
        span: Begin and end of the window, us.
        muted: (height, width), true for pixels without events whose silence tells nothing; None:
            there are none.

    Returns:
        The rows whose look-ups are both inside the image.
    """
    height, width = shape
    c = np.broadcast_to(
        np.asarray(thresholds, np.float32).reshape(2, *np.shape(thresholds)[1:] or (1, 1)),
        (2, height, width),
    )
    threshold = float(c.mean())
    begin, end = (carry_pixels(paths, shape, t).reshape(-1, 2) for t in span)
    at_event = np.stack(
        paths.carry(events.x.astype(np.float32), events.y.astype(np.float32), events.t), -1
    )
    pixel = events.y.astype(np.int32) * width + events.x
    change = np.where(events.p, c[0].reshape(-1)[pixel], -c[1].reshape(-1)[pixel]) / threshold
    doubt = np.zeros(height * width, np.float32)  # (c / s)^2
    if paths.covariance is not None:
        doubt[:] = (
            SHARED_ROWS
            * ROUGHNESS
            * np.einsum("khwii->hw", paths.covariance).ravel()
            / len(paths.covariance)
        )
    share = explained_share(pixel, events.p, at_event.astype(np.float32), shape)
    n = len(pixel) + height * width
    rows = Rows(
        shape,
        threshold,
        np.empty((n, 2), np.uint32),
        np.empty((n, 2, 2), np.float32),
        np.empty(n, np.float32),
        np.ones(n + 1, np.float32),
        np.empty(n, np.uint8),
        np.empty(n, np.int32),
    )
    last = np.full(height * width, NONE, np.int32)
    if muted is not None:
        last[muted.ravel()] = MUTED
    ends = (begin, at_event.astype(np.float32), end)
    times = (1e-6 * (events.t - span[0]), 1e-6 * (span[1] - span[0]), doubt)
    n = _lay_rows(pixel, change.astype(np.float32), ends, times, last, rows)
    rows = Rows(shape, threshold, *(column[:n] for column in rows[2:]))
    rows.weight[:] *= share[rows.pixel]
    return rows


@njit_noalloc
def _lay_rows(pixel, change, positions, times, last, rows):
    """Lay the rows of all pixels, from event to event and at the ends of the window.

    Args:
        pixel: (n,) flat index of the pixel of each event.
        change: (n,) signed change of each event, thresholds.
        positions: x and y at the target time, px: of pixels at the begin of the window
            (pixels, 2), of events (n, 2), and of pixels at its end (pixels, 2).
        times: (n,) times of events, s since the begin, the end, s, and (pixels,) the
            doubt of paths, (c / s)^2.
        last: (pixels,) `NONE` or `MUTED`; overwritten by the number of the last event.
        rows: `Rows`, output.

    Returns:
        The number of rows; those that leave the image are left out.
    """
    begin, at_event, end = positions
    t, stop, doubt = times
    n = 0
    for k in range(len(pixel)):
        x, before = pixel[k], last[pixel[k]]
        rows.pixel[n] = x
        if before < 0:
            rows.weight[n] = 1 / (1 + doubt[x] * t[k] ** 2)
            rows.change[n], rows.kind[n] = FIRST_SHARE * change[k], FIRST
            n += _lay_row(n, at_event[k], begin[x], rows)
        else:
            rows.weight[n] = 1 / (1 + doubt[x] * (t[k] - t[before]) ** 2)
            rows.change[n], rows.kind[n] = change[k], EVENT
            n += _lay_row(n, at_event[k], at_event[before], rows)
        last[x] = k
    for x in range(len(last)):
        before = last[x]
        if before == MUTED:
            continue
        rows.pixel[n] = x
        if before == NONE:
            rows.weight[n] = 1 / (1 + doubt[x] * stop**2)
            rows.change[n], rows.kind[n] = 0, SILENT
            n += _lay_row(n, end[x], begin[x], rows)
        else:
            rows.weight[n] = 1 / (1 + doubt[x] * (stop - t[before]) ** 2)
            rows.change[n], rows.kind[n] = LAST_SHARE * change[before], LAST
            n += _lay_row(n, end[x], at_event[before], rows)
    return n


@njit_noalloc_inlined
def _lay_row(n, after, before, rows):
    """Write the look-ups of a row.

    Args:
        n: The row.
        after: (2,) x and y of the look-up at t_b, px.
        before: (2,) x and y of that at t_a, px.
        rows: `Rows`, output.

    Returns:
        1, or 0 if a look-up is outside the image.
    """
    height, width = rows.shape
    for side in range(2):
        x, y = (after[0], after[1]) if side == 0 else (before[0], before[1])
        if not (0 <= x <= width - 1 and 0 <= y <= height - 1):
            return 0
        i, j = min(int(x), max(width - 2, 0)), min(int(y), max(height - 2, 0))
        rows.corner[n, side] = j * width + i
        rows.fraction[n, side, 0] = x - i
        rows.fraction[n, side, 1] = y - j
    return 1
