"""Memory: the gradient of the log image that other windows of events have measured.

A row (1) of a window measures M(b) - M(a), the integral of the gradient along the path from a to b.
Its information is shared out equally among the path's pixels, so that with d = b - a

    Lambda += r d d' / (c^2 n),    eta += r d change / (c^2 n)        at each of n places     (4)

is a Gaussian measurement of the gradient of M: Lambda (grad M - g) = 0 with g = Lambda^-1 eta. Along
the motion it is known, across it is not, until the motion turns. From time to time it is carried
along the flow. A path that is uncertain by the covariance P displaces the gradient's image, so with
its derivative G the information fades to

    (Lambda^-1 + G P G' + q I)^-1                                                            (5)

where P grows with time by the flow's covariance and by `drift`, and q by `forgetting`. Independent
information is added. No image is solved for: memory costs little more than the rows themselves.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.codegen import njit_noalloc, njit_noalloc_inlined
from jaxevent.reconstruction.events_only.prior import GradientPrior
from jaxevent.reconstruction.events_only.rows import EVENT, Paths, Rows

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
    weight = np.where(rows.kind == EVENT, 1, silence).astype(np.float32) / c**2
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
            p = (1 - fy) * (g[j, i + 1, 0] - g[j, i, 0]) + fy * (g[j + 1, i + 1, 0] - g[j + 1, i, 0])
            s = (1 - fy) * (g[j, i + 1, 1] - g[j, i, 1]) + fy * (g[j + 1, i + 1, 1] - g[j + 1, i, 1])
            r = (1 - fx) * (g[j + 1, i, 0] - g[j, i, 0]) + fx * (g[j + 1, i + 1, 0] - g[j, i + 1, 0])
            t = (1 - fx) * (g[j + 1, i, 1] - g[j, i, 1]) + fx * (g[j + 1, i + 1, 1] - g[j, i + 1, 1])
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
