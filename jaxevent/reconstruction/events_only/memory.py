"""Memory: the gradient of the log image that other windows of events have measured.

A row (1) of a window measures M(b) - M(a), the integral of the gradient along the path from a to b.
Its information is shared out equally among the path's pixels, so that with d = b - a

    Lambda += r d d' / (c^2 n),    eta += r d change / (c^2 n)        at each of n places     (4)

is a Gaussian measurement of the gradient of M: Lambda (grad M - g) = 0, g = Lambda^-1 eta. Along
the motion it is known, across it is not, until the motion turns. From time to time it is carried
along the flow. A path that is uncertain by the covariance P displaces the gradient's image, so with
its derivative G the information fades to

    (Lambda^-1 + G P G' + q I)^-1                                                            (5)

where P grows with time by the flow's covariance and by `drift`, and q by `forgetting`. Independent
information is added. No image is solved for: memory costs little more than the rows themselves.
"""

from typing import NamedTuple, Protocol

import numpy as np

from jaxevent.codegen import njit_noalloc, njit_noalloc_inlined
from jaxevent.reconstruction.events_only.prior import GradientPrior
from jaxevent.reconstruction.events_only.rows import EVENT, Paths, Rows
from jaxevent.recording import Recording

KEYS_PER_BLOCK = 16  # whose memories are kept at a time, for each direction
KEYS_BEYOND_BLOCK = 8  # from which a block's memories begin with nothing
LEAST_INFORMATION = 1e-3  # (px / c)^2; with less a gradient counts as 0


class MemoryParams(NamedTuple):
    """Numbers of the memory; log intensity is in thresholds."""

    forgetting: float = 0.6  # variance that a gradient gains in time, (c / px)^2 / s
    drift: float = 1.0  # variance that a path gains in time beside the flow's, px^2 / s


def measure_gradient(rows: Rows, silence: float) -> GradientPrior:
    """Return what the rows of a window say of the gradient at each pixel (4).

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
    _solve_gradient(information, eta, LEAST_INFORMATION / c**2, gradient)
    return GradientPrior(gradient, information)


@njit_noalloc
def _add_rows(rows, weight, c, information, eta):
    height, width = rows.shape
    for k in range(len(weight)):
        bx = rows.corner[k, 0] % width + rows.fraction[k, 0, 0]
        by = rows.corner[k, 0] // width + rows.fraction[k, 0, 1]
        dx = bx - (rows.corner[k, 1] % width + rows.fraction[k, 1, 0])
        dy = by - (rows.corner[k, 1] // width + rows.fraction[k, 1, 1])
        n = int(np.sqrt(dx * dx + dy * dy)) + 1
        w = weight[k] / n
        change = c * rows.change[k]
        for step in range(n):
            part = (step + np.float32(0.5)) / n
            x, y = int(bx - part * dx + 0.5), int(by - part * dy + 0.5)
            information[y, x, 0, 0] += w * dx * dx
            information[y, x, 0, 1] += w * dx * dy
            information[y, x, 1, 1] += w * dy * dy
            eta[y, x, 0] += w * dx * change
            eta[y, x, 1] += w * dy * change
    for y in range(height):
        for x in range(width):
            information[y, x, 1, 0] = information[y, x, 0, 1]


@njit_noalloc
def _solve_gradient(information, eta, least, out):
    height, width = out.shape[:2]
    for y in range(height):
        for x in range(width):
            L = information[y, x]
            a, b, d = L[0, 0] + least, L[0, 1], L[1, 1] + least
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
    eta = _times(one) + _times(other)
    information = one.information + other.information
    gradient = np.empty_like(eta)
    _solve_gradient(information, eta, LEAST_INFORMATION / threshold**2, gradient)
    return GradientPrior(gradient, information)


def _times(prior):
    return np.einsum("hwij,hwj->hwi", prior.information, prior.gradient)


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
    shape = memory.gradient.shape[:2]
    y, x = np.indices(shape, np.float32).reshape(2, -1)
    x, y = (v.reshape(shape) for v in paths.carry(x, y, np.full(x.size, at, np.int64)))
    out = GradientPrior(np.zeros_like(memory.gradient), np.zeros_like(memory.information))
    _carry(x, y, memory, (np.float32(noise[0]), np.float32(noise[1])), out)
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
def _carry(px, py, memory, noise, out):
    height, width = px.shape
    g, L = memory.gradient, memory.information
    q, P = noise
    for row in range(height):
        for column in range(width):
            x, y = px[row, column], py[row, column]
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
            # (Lambda^-1 + Q)^-1 = (1 + Lambda Q)^-1 Lambda
            A, B = 1 + xx * Qx + xy * Qxy, xx * Qxy + xy * Qy
            C, D = xy * Qx + yy * Qxy, 1 + xy * Qxy + yy * Qy
            scale = 1 / (A * D - B * C)
            out.information[row, column, 0, 0] = scale * (D * xx - B * xy)
            out.information[row, column, 0, 1] = scale * (D * xy - B * yy)
            out.information[row, column, 1, 0] = out.information[row, column, 0, 1]
            out.information[row, column, 1, 1] = scale * (A * yy - C * xy)
            out.gradient[row, column, 0] = gx
            out.gradient[row, column, 1] = gy


def join_memories(
    before: GradientPrior | None,
    after: GradientPrior | None,
    shape: tuple[int, int],
    threshold: float,
) -> GradientPrior:
    """Return what the windows before and after one say of its image, if any do.

    Args:
        before: Memory of earlier windows.
        after: Memory of later ones.
        shape: (height, width) of the sensor.
        threshold: Threshold c, ln I.

    Returns:
        Both together; without any the information is 0.
    """
    if before is not None and after is not None:
        return fuse(before, after, threshold)
    if before is None and after is None:
        zeros = np.zeros((*shape, 2), np.float32)
        return GradientPrior(zeros, np.zeros((*shape, 2, 2), np.float32))
    return before if after is None else after


class Windows(Protocol):
    """A source of a recording's paths and equations."""

    def paths(self, start: int, stop: int, at: int) -> Paths:
        """Return the paths between two times (us) towards the time `at`."""
        ...

    def rows(self, first: int, last: int, at: int, span: tuple[int, int]) -> Rows:
        """Return the equations of some rows of events for the image at a time."""
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
        params: Numbers of the memory.
    """

    def __init__(
        self,
        windows: Windows,
        recording: Recording,
        step: int,
        silence: float,
        params: MemoryParams | None = None,
    ):
        self.windows, self.recording, self.step, self.silence = windows, recording, step, silence
        self.params = MemoryParams() if params is None else params
        self.last = -(-len(recording.events) // step)  # the key at the recording's end
        self._blocks: dict[int, tuple[int, dict[int, GradientPrior | None]]] = {}
        self._threshold = 1.0

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

    def before(self, key: int, at: int) -> GradientPrior | None:
        """Return the memory of the windows before a key, carried to a time (us)."""
        return self._carried(self._at_key(key, 1), key, at)

    def after(self, key: int, at: int) -> GradientPrior | None:
        """Return the memory of the windows after a key, carried to a time (us)."""
        return self._carried(self._at_key(key, -1), key, at)

    def _carried(self, memory: GradientPrior | None, key: int, at: int) -> GradientPrior | None:
        start = self.time(key)
        if memory is None or start == at:
            return memory
        seconds = 1e-6 * abs(at - start)
        noise = self.params.forgetting * self._threshold**2 * seconds, self.params.drift * seconds
        paths = self.windows.paths(min(start, at), max(start, at), start)
        return carry(memory, paths, at, noise)

    def _at_key(self, key: int, side: int) -> GradientPrior | None:
        """Return the memory at a key of the windows before (side 1) or after it (side -1)."""
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
        """Return the memory at the next key on the way."""
        other = key + side
        first, last = min(key, other), max(key, other)
        start, stop, at = self.time(first), self.time(last), self.time(other)
        rows = self.windows.rows(self.row(first), self.row(last), at, (start, stop))
        self._threshold = rows.threshold
        new = measure_gradient(rows, self.silence)
        carried = self._carried(memory, key, at)
        return new if carried is None else fuse(carried, new, rows.threshold)
