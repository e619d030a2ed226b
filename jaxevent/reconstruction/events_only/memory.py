"""Memory: the gradient of the log image that other windows of events have measured.

A row (1) of a window measures M(b) - M(a), the integral of the gradient along the path from a to b.
Its information is shared out equally among the path's pixels, so that with d = b - a

    Lambda += r d d' / (c^2 n),    eta += r d change / (c^2 n)        at each of n places     (4)

is a Gaussian measurement of the gradient of M: Lambda (grad M - g) = 0 with g = Lambda^-1 eta.
Along the motion it is known, across it is not, until the motion turns. It is carried along the
flow. A path that is uncertain by the variance P displaces the gradient's image, so with its
derivative G the information fades to

    (Lambda^-1 + P G G' + q I)^-1                                                            (5)

where P and q grow with time. What contradicts newer events loses, and independent information is
added. No image is solved for: memory costs little more than the rows themselves.
"""

from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from jaxevent.codegen import njit_noalloc, njit_noalloc_inlined
from jaxevent.reconstruction.events_only.prior import GradientPrior
from jaxevent.reconstruction.events_only.rows import EVENT, Paths, Rows, carry_pixels
from jaxevent.reconstruction.events_only.silence import explained_share
from jaxevent.recording import Events, Recording

KEYS_PER_BLOCK = 16  # whose memories are kept at a time, for each direction
KEYS_BEYOND_BLOCK = 8  # from which a block's memories begin with nothing
RELATIVE_RIDGE = 1e-6  # of the information's trace, so that rounding leaves it invertible
LEAST_INFORMATION = 1e-3  # (px / c)^2; with less a gradient counts as 0


class MemoryParams(NamedTuple):
    """Numbers of the memory; log intensity is in thresholds."""

    forgetting: float = 4.0  # variance that a gradient gains in time, (c / px)^2 / s
    drift: float = 1.0  # variance that a path gains in time, px^2 / s
    blur: float = 0.3  # variance of a path when the memory enters an image, px^2
    detail: float = 0.5  # mean square of gradients, that errors of paths act by, (c / px)^2
    tail: float = 1.5  # difference, in standard deviations, beyond which memory counts less
    independent: float = 0.3  # part of its information that an image takes; windows share errors

    def noise(self, seconds: float, threshold: float, blur: float) -> tuple[float, float]:
        """Return the variances that gradients, (ln I / px)^2, and paths, px^2, gain in a time.

        Args:
            seconds: The time, s.
            threshold: Threshold c, ln I.
            blur: Further variance of paths, px^2.

        Returns:
            Both variances.
        """
        return self.forgetting * threshold**2 * seconds, self.drift * seconds + blur


def measure_gradient(rows: Rows, silence: float) -> GradientPrior:
    """Measure the gradient at each pixel by the rows of a window (4).

    Args:
        rows: Equations of the window.
        silence: Weight of rows without an event at one end.

    Returns:
        The gradient at the rows' target time and its information.
    """
    c = np.float32(rows.threshold)
    information = np.zeros((*rows.shape, 2, 2), np.float32)
    eta = np.zeros((*rows.shape, 2), np.float32)
    weight = np.where(rows.kind == EVENT, 1, silence).astype(np.float32) * rows.weight / c**2
    _add_rows(rows, weight, c, information, eta)
    gradient = np.empty_like(eta)
    _solve_gradient(information, eta, float(LEAST_INFORMATION / c**2), gradient)
    return GradientPrior(gradient, information)


@njit_noalloc_inlined
def _add_row(a, b, change, weight, information, eta):
    """Share out M(b) - M(a) = change among the pixels between, if both ends are in the image.

    Args:
        a: x and y, px, in single precision.
        b: The same of the other end.
        change: Change, in double precision, ln I.
        weight: Weight of the row, in double precision.
        information: (height, width, 2, 2) output.
        eta: (height, width, 2) output.
    """
    height, width = eta.shape[:2]
    for x, y in (a, b):
        if not (0 <= x <= width - 1 and 0 <= y <= height - 1):
            return
    dx, dy = b[0] - a[0], b[1] - a[1]
    n = int(np.sqrt(dx * dx + dy * dy)) + 1
    w = weight / n
    for step in range(n):
        part = (step + np.float32(0.5)) / n
        x, y = int(a[0] + part * dx + 0.5), int(a[1] + part * dy + 0.5)
        information[y, x, 0, 0] += w * dx * dx
        information[y, x, 0, 1] += w * dx * dy
        information[y, x, 1, 0] += w * dx * dy
        information[y, x, 1, 1] += w * dy * dy
        eta[y, x, 0] += w * dx * change
        eta[y, x, 1] += w * dy * change


@njit_noalloc
def _add_rows(rows, weight, c, information, eta):
    """Add the evidence of rows on the gradient, each shared out between its two look-ups' pixels.

    Args:
        rows: `Rows` of a window.
        weight: (rows,) weights, 1 / (ln I)^2.
        c: Threshold, ln I, in single precision.
        information: (height, width, 2, 2) added to.
        eta: (height, width, 2) information times gradient, added to.
    """
    width = rows.shape[1]
    for k in range(len(weight)):
        i, j = rows.corner[k, 0], rows.corner[k, 1]
        ix, iy, jx, jy = i % width, i // width, j % width, j // width
        after, before = rows.fraction[k, 0], rows.fraction[k, 1]
        b = np.float32(ix) + after[0], np.float32(iy) + after[1]
        a = np.float32(jx) + before[0], np.float32(jy) + before[1]
        change = np.float64(c * rows.change[k])
        _add_row(a, b, change, np.float64(weight[k]), information, eta)


@njit_noalloc
def _add_span(events, positions, errors, numbers, information, eta):
    """Add the rows of a span; events are in order of time, or in reverse order for the side -1.

    Args:
        events: (n,) flat index of the pixel, (n,) signed change, ln I, and (pixels,) -1,
            overwritten by the number of the pixel's last event.
        positions: x and y at the target time, px: of pixels at the key before and at the key,
            (pixels, 2) each, and of events (n, 2).
        errors: Variance of pixels' paths, 1/s^2, and share of their events that motion explains,
            (pixels,) each; distances from the target time: of events (n,) and of both keys, s.
        numbers: Number of events before the key, side, and weights of rows with an event at both
            ends and at one, 1 / (ln I)^2.
        information: (height, width, 2, 2) added to.
        eta: (height, width, 2) information times gradient, added to.
    """
    pixel, change, last = events
    begin, middle, at_event = positions
    variance, share, time, ends = errors
    n_before, side, weight, silence = numbers
    width = eta.shape[1]
    for k in range(len(pixel)):
        x = pixel[k]
        previous = last[x]
        last[x] = k
        if k < n_before:
            continue
        here = at_event[k, 0], at_event[k, 1]
        if previous < 0:
            # In reverse order nothing happens between the event and the span's end.
            half = 0.5 * change[k] if side > 0 else 0.0
            w = np.float64(share[x] * silence / (1 + variance[x] * (ends[0] - time[k]) ** 2))
            _add_row((begin[x, 0], begin[x, 1]), here, half, w, information, eta)
        else:
            step = change[k] if side > 0 else change[previous]
            there = at_event[previous, 0], at_event[previous, 1]
            w = np.float64(share[x] * weight / (1 + variance[x] * (time[previous] - time[k]) ** 2))
            _add_row(there, here, np.float64(step), w, information, eta)
    for x in range(len(last)):
        if last[x] < n_before:
            here = np.float32(x % width), np.float32(x // width)
            w = np.float64(share[x] * silence / (1 + variance[x] * ends[1] ** 2))
            _add_row((middle[x, 0], middle[x, 1]), here, 0.0, w, information, eta)


@njit_noalloc
def _solve_gradient(information, eta, least, out):
    """Solve eta = information gradient at each pixel, with a ridge on the information.

    Args:
        information: (height, width, 2, 2), (px / ln I)^2.
        eta: (height, width, 2), px / ln I.
        least: Ridge that is added to the diagonal, beside one relative to the trace.
        out: (height, width, 2) output, ln I / px.
    """
    height, width = out.shape[:2]
    for y in range(height):
        for x in range(width):
            L = information[y, x]
            xx, b, yy = np.float64(L[0, 0]), np.float64(L[0, 1]), np.float64(L[1, 1])
            ridge = least + RELATIVE_RIDGE * (xx + yy)
            a, d = xx + ridge, yy + ridge
            scale = 1 / (a * d - b * b)
            out[y, x, 0] = scale * (d * eta[y, x, 0] - b * eta[y, x, 1])
            out[y, x, 1] = scale * (a * eta[y, x, 1] - b * eta[y, x, 0])


def fuse(one: GradientPrior, other: GradientPrior, threshold: float) -> GradientPrior:
    """Add independent information about one gradient.

    Args:
        one: A gradient and its information.
        other: Another measurement of it.
        threshold: Threshold c, ln I.

    Returns:
        The gradient that both give, and the sum of the information.
    """
    information = one.information + other.information
    eta, gradient = np.empty_like(one.gradient), np.empty_like(one.gradient)
    _add_products(one, other, eta)
    _solve_gradient(information, eta, LEAST_INFORMATION / threshold**2, gradient)
    return GradientPrior(gradient, information)


@njit_noalloc
def _add_products(one, other, out):
    """Write the sum of information times gradient of two priors.

    Args:
        one: `GradientPrior`.
        other: `GradientPrior`.
        out: (height, width, 2) output.
    """
    height, width = out.shape[:2]
    for y in range(height):
        for x in range(width):
            g, h = one.gradient[y, x], other.gradient[y, x]
            A, B = one.information[y, x], other.information[y, x]
            for i in range(2):
                out[y, x, i] = A[i, 0] * g[0] + A[i, 1] * g[1] + B[i, 0] * h[0] + B[i, 1] * h[1]


def discount(
    memory: GradientPrior, new: GradientPrior, threshold: float, tail: float
) -> GradientPrior:
    """Reduce a memory's information where a new measurement contradicts it, as at occlusions.

    With the squared difference q = d' (Lambda^-1 + Lambda_new^-1)^-1 d of both gradients the
    information is divided by 1 + q / tail^2.

    Args:
        memory: A gradient and its information.
        new: Another measurement of it.
        threshold: Threshold c, ln I.
        tail: Difference, in standard deviations, from which the memory counts less.

    Returns:
        The memory, with less information.
    """
    information = np.empty_like(memory.information)
    _discount(memory, new, (LEAST_INFORMATION / threshold**2, tail**-2), information)
    return GradientPrior(memory.gradient, information)


@njit_noalloc
def _discount(memory, new, numbers, out):
    """Write a memory's information, less where a new measurement contradicts it.

    Args:
        memory: `GradientPrior`.
        new: `GradientPrior`.
        numbers: Ridge of the information, (px / ln I)^2, and 1 / tail^2.
        out: (height, width, 2, 2) output.
    """
    height, width = out.shape[:2]
    least, scale = np.float32(numbers[0]), np.float32(numbers[1])
    for y in range(height):
        for x in range(width):
            A, B = memory.information[y, x], new.information[y, x]
            dx = memory.gradient[y, x, 0] - new.gradient[y, x, 0]
            dy = memory.gradient[y, x, 1] - new.gradient[y, x, 1]
            xx, yy = np.float64(A[0, 0]) + B[0, 0], np.float64(A[1, 1]) + B[1, 1]
            ridge = least + RELATIVE_RIDGE * (xx + yy)
            a, b, d = xx + ridge, np.float64(A[0, 1]) + B[0, 1], yy + ridge
            # q = d' A (A + B)^-1 B d
            ux, uy = A[0, 0] * dx + A[0, 1] * dy, A[0, 1] * dx + A[1, 1] * dy
            vx, vy = B[0, 0] * dx + B[0, 1] * dy, B[0, 1] * dx + B[1, 1] * dy
            q = (ux * (d * vx - b * vy) + uy * (a * vy - b * vx)) / (a * d - b * b)
            weight = 1 / (1 + scale * max(q, 0.0))
            for i in range(2):
                for k in range(2):
                    out[y, x, i, k] = weight * A[i, k]


def carry(
    memory: GradientPrior, paths: Paths, at: int, noise: tuple[float, float]
) -> GradientPrior:
    """Carry a memory along the flow to another time (5).

    Args:
        memory: The gradient and its information at the time to which `paths` lead.
        paths: Paths from any time to that of the memory.
        at: Time to which the memory is carried, us.
        noise: Variance that gradients gain on the way, (ln I / px)^2, and paths, px^2.

    Returns:
        The memory at the new time. What was outside the image is not known.
    """
    places = carry_pixels(paths, memory.gradient.shape[:2], at)
    out = GradientPrior(np.zeros_like(memory.gradient), np.zeros_like(memory.information))
    _carry(places, memory, (np.float32(noise[0]), np.float32(noise[1])), out)
    return out


@njit_noalloc_inlined
def _cubic(f):
    """Return the weights of four neighbours by Catmull and Rom."""
    g = 1 - f
    return (
        -0.5 * f * g * g,
        1 + f * f * (1.5 * f - 2.5),
        1 + g * g * (1.5 * g - 2.5),
        -0.5 * g * f * f,
    )


@njit_noalloc
def _carry(places, memory, noise, out):
    """Write a memory at the pixels of another time: gradients bicubic, information bilinear (5).

    Args:
        places: (height, width, 2) x and y of the pixels at the memory's time, px.
        memory: `GradientPrior`.
        noise: Variance that gradients gain, (ln I / px)^2, and paths, px^2.
        out: `GradientPrior`, output; as it is where a place is outside the image.
    """
    height, width = places.shape[:2]
    g, L = memory.gradient, memory.information
    q, P = noise
    for row in range(height):
        for column in range(width):
            x, y = places[row, column, 0], places[row, column, 1]
            if not (0 <= x <= width - 1 and 0 <= y <= height - 1):
                continue
            i, j = min(int(x), width - 2), min(int(y), height - 2)
            fx, fy = x - i, y - j
            a, b, c, d = (1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy
            xx = a * L[j, i, 0, 0] + b * L[j, i + 1, 0, 0]
            xx += c * L[j + 1, i, 0, 0] + d * L[j + 1, i + 1, 0, 0]
            xy = a * L[j, i, 0, 1] + b * L[j, i + 1, 0, 1]
            xy += c * L[j + 1, i, 0, 1] + d * L[j + 1, i + 1, 0, 1]
            yy = a * L[j, i, 1, 1] + b * L[j, i + 1, 1, 1]
            yy += c * L[j + 1, i, 1, 1] + d * L[j + 1, i + 1, 1, 1]
            wx, wy = _cubic(fx), _cubic(fy)
            gx = gy = np.float32(0)
            for m in range(4):
                for n in range(4):
                    w = wy[m] * wx[n]
                    v = g[min(max(j + m - 1, 0), height - 1), min(max(i + n - 1, 0), width - 1)]
                    gx += w * v[0]
                    gy += w * v[1]
            # G: derivative of the gradient along x and y.
            p = (1 - fy) * (g[j, i + 1, 0] - g[j, i, 0]) + fy * (
                g[j + 1, i + 1, 0] - g[j + 1, i, 0]
            )
            s = (1 - fy) * (g[j, i + 1, 1] - g[j, i, 1]) + fy * (
                g[j + 1, i + 1, 1] - g[j + 1, i, 1]
            )
            r = (1 - fx) * (g[j + 1, i, 0] - g[j, i, 0]) + fx * (
                g[j + 1, i + 1, 0] - g[j, i + 1, 0]
            )
            t = (1 - fx) * (g[j + 1, i, 1] - g[j, i, 1]) + fx * (
                g[j + 1, i + 1, 1] - g[j, i + 1, 1]
            )
            Qx, Qxy, Qy = q + P * (p * p + r * r), P * (p * s + r * t), q + P * (s * s + t * t)
            # (Lambda^-1 + Q)^-1 = (Lambda + |Lambda| adj Q) / (1 + tr Lambda Q + |Lambda| |Q|),
            # in double precision: Lambda of one direction of motion is nearly singular.
            det_L = max(np.float64(xx) * yy - np.float64(xy) * xy, 0.0)
            det_Q = max(np.float64(Qx) * Qy - np.float64(Qxy) * Qxy, 0.0)
            trace = np.float64(xx) * Qx + 2 * np.float64(xy) * Qxy + np.float64(yy) * Qy
            scale = 1 / (1 + max(trace, 0.0) + det_L * det_Q)
            out.information[row, column, 0, 0] = scale * (xx + det_L * Qy)
            out.information[row, column, 0, 1] = scale * (xy - det_L * Qxy)
            out.information[row, column, 1, 0] = out.information[row, column, 0, 1]
            out.information[row, column, 1, 1] = scale * (yy + det_L * Qx)
            out.gradient[row, column, 0] = gx
            out.gradient[row, column, 1] = gy


@runtime_checkable
class WindowSource(Protocol):
    """A source of a recording's events, their thresholds and their paths."""

    shape: tuple[int, int]  # (height, width)
    thresholds: NDArray[np.float32]  # (2, height, width) ln I, of ON and OFF events

    def events(self, first: int, last: int) -> Events:
        """Return the events of some rows, without those of hot pixels.

        Args:
            first: First row.
            last: Row after the last one.

        Returns:
            The events.
        """
        ...

    def paths(self, start: int, stop: int, at: int, *, until: int | None = None) -> Paths:
        """Return the paths of points through a window.

        Args:
            start: Beginning of the window, us.
            stop: Its end, us.
            at: Time to which points are carried, us.
            until: Time of the last event that flow may rest on, us; None: any.
        """
        ...


class KeyMemories:
    """Memories of a recording at keys: times one for so many events.

    A memory is that of the windows between keys on one side, the oldest at least
    `KEYS_BEYOND_BLOCK` away. Keys are in blocks. A block's memories are found from a key beyond it,
    so that they do not depend on what was asked for before, and one block is kept for each side.

    Args:
        windows: Source of paths and equations.
        recording: Events.
        step: Events between keys.
        silence: Weight of rows without an event at one end.
        threshold: Mean threshold c, ln I.
    """

    def __init__(
        self,
        windows: WindowSource,
        recording: Recording,
        step: int,
        *,
        silence: float,
        threshold: float,
    ):
        self.windows, self.recording, self.step = windows, recording, step
        self.silence, self.threshold, self.params = silence, threshold, MemoryParams()
        self.last = -(-len(recording.events) // step)  # the key at the recording's end
        self._blocks: dict[int, tuple[int, dict[int, GradientPrior | None]]] = {}

    def row(self, key: int) -> int:
        """Return the number of events before a key."""
        return min(key * self.step, len(self.recording.events))

    def time(self, key: int) -> int:
        """Return the time of a key, us: that of its first event."""
        row = min(self.row(key), max(len(self.recording.events) - 1, 0))
        first = self.recording.events[row : row + 1].t
        return int(first[0]) if len(first) else self.recording.start

    def key_after(self, row: int) -> int:
        """Return the first key with so many events before it, or the last one."""
        return min(-(-row // self.step), self.last)

    def prior(self, rows: Rows, at: int, first: int, last: int | None) -> GradientPrior:
        """Return the prior of a window's gradient by the windows before and after it.

        Where images are causal, a window begins at least two steps before its image: flow for the
        memory rests on so many events after the key.

        Args:
            rows: Equations of the window for the image.
            at: Time of the image, us.
            first: Key at which the window begins.
            last: Key at which it ends; None: no later window is used.

        Returns:
            The memories together; where no window saw anything the information is 0.
        """
        ends = [(first, 1)] + ([] if last is None else [(last, -1)])
        found = [self._carry_to(self._at_key(k, s), k, at, at, self.params.blur) for k, s in ends]
        known = [memory for memory in found if memory is not None]
        if not known:
            zeros = np.zeros((*rows.shape, 2), np.float32)
            return GradientPrior(zeros, np.zeros((*zeros.shape, 2), np.float32))
        joint = known[0] if len(known) == 1 else fuse(*known, self.threshold)
        new = measure_gradient(rows, self.silence)
        joint = discount(joint, new, self.threshold, self.params.tail)
        return joint._replace(information=np.float32(self.params.independent) * joint.information)

    def _carry_to(
        self, memory: GradientPrior | None, key: int, at: int, until: int, blur: float = 0.0
    ) -> GradientPrior | None:
        """Carry the memory at a key to another time.

        Args:
            memory: The memory; None: there is none.
            key: Its key.
            at: Time to carry it to, us.
            until: Time until which events may be used for the motion, us.
            blur: Further variance of paths, px^2.

        Returns:
            The memory at that time, None where there is none.
        """
        if memory is None:
            return None
        start = self.time(key)
        seconds = 1e-6 * abs(at - start)
        noise = self.params.noise(seconds, self.threshold, blur)
        paths = self.windows.paths(min(start, at), max(start, at), start, until=until)
        return carry(memory, paths, at, noise)

    def _at_key(self, key: int, side: int) -> GradientPrior | None:
        """Return the memory at a key of the windows on one side of it.

        Args:
            key: The key.
            side: 1: windows before it; -1: windows after it.

        Returns:
            The memory; None where there are none.
        """
        block = key // KEYS_PER_BLOCK
        number, memories = self._blocks.get(side, (-1, {}))
        if number != block:
            memories = {}
            self._blocks[side] = block, memories
        if key not in memories:
            low = block * KEYS_PER_BLOCK
            nearest = [k for k in memories if (key - k) * side > 0]
            if nearest:
                k = max(nearest, key=lambda k: k * side)
            elif side > 0:
                k = max(low - KEYS_BEYOND_BLOCK, 0)
            else:
                k = min(low + KEYS_PER_BLOCK - 1 + KEYS_BEYOND_BLOCK, self.last)
            memory = memories.get(k)
            while k != key:
                memory = self._extend(memory, k, side)
                k += side
                if k // KEYS_PER_BLOCK == block:
                    memories[k] = memory
            memories[key] = memory
        return memories[key]

    def _extend(self, memory: GradientPrior | None, key: int, side: int) -> GradientPrior:
        """Extend a memory to the next key on the way.

        Args:
            memory: Memory at the key; None: there is none.
            key: The key.
            side: 1: towards later keys; -1: towards earlier ones.

        Returns:
            The memory at `key + side`.
        """
        new = self._measure(key, side)
        carried = self._carry_to(memory, key, self.time(key + side), self.time(key + side + 2))
        if carried is None:
            return new
        return fuse(discount(carried, new, self.threshold, self.params.tail), new, self.threshold)

    def _measure(self, key: int, side: int) -> GradientPrior:
        """Measure the gradient by the events from a key to the next one on the way.

        A pixel's first row begins at its last event before the key, if it has one since the key
        before: otherwise windows of few events would find gradients too small. Silence after a
        pixel's last event is left to the next window.
        Args:
            key: The key.
            side: 1: towards later keys; -1: towards earlier ones.

        Returns:
            The gradient at `key + side`.
        """
        keys = min(max(key - side, 0), self.last), key, key + side
        rows, times = [self.row(k) for k in keys], [self.time(k) for k in keys]
        before = self.windows.events(*sorted(rows[:2]))
        within = self.windows.events(*sorted(rows[1:]))
        x, y, t, p = (
            np.concatenate([getattr(before, name)[::side], getattr(within, name)[::side]])
            for name in "xytp"
        )
        height, width = shape = self.windows.shape
        until = self.time(key + side + 2)
        paths = self.windows.paths(min(times), max(times), times[2], until=until)
        begin, middle = (carry_pixels(paths, shape, t).reshape(-1, 2) for t in times[:2])
        at_event = np.stack(paths.carry(x.astype(np.float32), y.astype(np.float32), t), -1)
        pixel = y.astype(np.int32) * width + x
        on, off = self.windows.thresholds.reshape(2, -1)
        change = side * np.where(p, on[pixel], -off[pixel])
        variance = np.zeros(height * width, np.float32)
        if paths.covariance is not None:
            variance = np.trace(paths.covariance.mean(0), axis1=-2, axis2=-1).ravel()
        share = explained_share(pixel, p, at_event, shape)
        information = np.zeros((*shape, 2, 2), np.float32)
        eta, gradient = np.zeros((2, *shape, 2), np.float32)
        seconds = 1e-6 * np.abs(t - times[2]), 1e-6 * np.abs(np.subtract(times[:2], times[2]))
        _add_span(
            (pixel, change, np.full(height * width, -1, np.int32)),
            (begin, middle, at_event),
            (self.params.detail * variance, share, *seconds),
            (len(before), side, 1 / self.threshold**2, self.silence / self.threshold**2),
            information,
            eta,
        )
        _solve_gradient(information, eta, LEAST_INFORMATION / self.threshold**2, gradient)
        return GradientPrior(gradient, information)
