"""Images read along trajectories: in loops for images, and as a pure function for derivatives."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import NDArray

from jaxevent.codegen import njit_noalloc, njit_noalloc_inlined, row_scratch, run_over_rows
from jaxevent.reconstruction.compensated.trajectories import Row, locate
from jaxevent.reconstruction.features import Numeric

CUBIC = -0.75  # slope of the cubic kernel at 1, as OpenCV's; the sharper of the usual two


class Along(NamedTuple):
    """Images at instants, seen at the target's points: each (K, h, w)."""

    L: Float[Numeric, "k h w"]  # bicubic
    V: Float[Numeric, "k h w"]  # its variance, bilinear
    clear: Float[Numeric, "k h w"]  # 1 where a frame shows the point, bilinear
    inside: Float[Numeric, "k h w"]  # 1, or 0 beyond the image's border


@njit_noalloc_inlined
def _cubic(part, out):
    """The weights (4, points) of the four pixels around each point."""
    a, one, two, three = np.float32(CUBIC), np.float32(1), np.float32(2), np.float32(3)
    for i in range(len(part)):
        f = part[i]
        far, rest = one + f, one - f
        first = ((a * far - np.float32(5) * a) * far + np.float32(8) * a) * far
        out[0, i] = first - np.float32(4) * a
        out[1, i] = ((a + two) * f - (a + three)) * f * f + one
        out[2, i] = ((a + two) * rest - (a + three)) * rest * rest + one
        out[3, i] = one - out[0, i] - out[1, i] - out[2, i]


@njit_noalloc_inlined
def _read_bilinear(image, pixel, part, out):
    h, w = image.shape
    one = np.float32(1)
    for i in range(len(out)):
        x0, y0, fx, fy = pixel[0, i], pixel[1, i], part[0, i], part[1, i]
        x1 = min(x0 + 1, w - 1)
        upper, lower = image[y0], image[min(y0 + 1, h - 1)]
        a, b = (one - fy) * (one - fx), (one - fy) * fx
        c, d = fy * (one - fx), fy * fx
        out[i] = a * upper[x0] + b * upper[x1] + c * lower[x0] + d * lower[x1]


@njit_noalloc_inlined
def _read_bicubic(image, pixel, across, down, out):
    h, w = image.shape
    for i in range(len(out)):
        x, y, total = int(pixel[0, i]) - 1, int(pixel[1, i]) - 1, np.float32(0)
        if 0 <= x < w - 3 and 0 <= y < h - 3:
            for n in range(4):
                row = image[y + n]
                part = across[0, i] * row[x] + across[1, i] * row[x + 1]
                part = part + across[2, i] * row[x + 2] + across[3, i] * row[x + 3]
                total += down[n, i] * part
        else:  # the image's border goes on
            for n in range(4):
                row, part = image[min(max(y + n, 0), h - 1)], np.float32(0)
                for m in range(4):
                    part += across[m, i] * row[min(max(x + m, 0), w - 1)]
                total += down[n, i] * part
        out[i] = total


@njit_noalloc
def _warp(begin, end, L, V, clear, s, paths, row, weights, out):
    count, h, w = L.shape
    path, pixel, part, at = row.path[begin], row.pixel[begin], row.part[begin], row.x[begin]
    across, down = weights[begin, :4], weights[begin, 4:]
    for x in range(w):
        at[x] = np.float32(x)
    for y in range(begin, end):
        for x in range(w):
            for c in range(4):
                path[c, x] = paths[y, x, c]
        for k in range(count):
            locate(path, at, np.float32(y), s[k], (h, w), pixel, part, out.inside[k, y])
            _cubic(part[0], across)
            _cubic(part[1], down)
            _read_bicubic(L[k], pixel, across, down, out.L[k, y])
            _read_bilinear(V[k], pixel, part, out.V[k, y])
            _read_bilinear(clear[k], pixel, part, out.clear[k, y])


def warp(L: NDArray, V: NDArray, clear: NDArray, s: NDArray, paths: NDArray) -> Along:
    """Images (K, h, w) float32 at instants s (K,) along the paths of pixels, (h, w, 4)."""
    _, h, w = L.shape
    out = Along(*(np.empty(L.shape, np.float32) for _ in range(4)))
    run_over_rows(_warp, h, L, V, clear, s, paths, Row.over(h, w), row_scratch(h, 8, w), out)
    return out


def spread_purely(p: Array, height: int, width: int) -> Array:
    """The same as `trajectories.spread`; differentiable."""
    rows, columns, _ = p.shape

    def upsampled(nodes: int, size: int) -> tuple[Array, Array, Array]:
        at = jnp.clip(jnp.arange(size) / 2 - 0.25, 0, nodes - 1)
        low = at.astype(int)
        return low, jnp.minimum(low + 1, nodes - 1), at - low

    i, i1, fy = upsampled(rows, height)
    j, j1, fx = upsampled(columns, width)
    fy, fx = fy[:, None, None], fx[None, :, None]
    top = (1 - fx) * p[i][:, j] + fx * p[i][:, j1]
    bottom = (1 - fx) * p[i1][:, j] + fx * p[i1][:, j1]
    return (1 - fy) * top + fy * bottom


def displaced(paths: Array, s: Array) -> Array:
    """How far the points of pixels, of paths (h, w, 4), have gone at s (K,): x, y, (K, h, w, 2)."""
    s = s[:, None, None, None]
    return (paths[..., :2] + paths[..., 2:] * s) * s


def reach(paths: Numeric) -> Numeric:
    """How far points of paths (h, w, 4) go, squared (px^2): at least as far as they do."""
    return ((abs(paths[..., :2]) + abs(paths[..., 2:])) ** 2).sum(-1)


def places(paths: Array, s: Array) -> tuple[Array, Array]:
    """Where points are at instants: y and x, (K, h, w)."""
    height, width, _ = paths.shape
    gone = displaced(paths, s)
    return jnp.arange(height)[:, None] + gone[..., 1], jnp.arange(width) + gone[..., 0]


def sample(images: Array, Y: Array, X: Array) -> Array:
    """Images (K, h, w) at the points Y and X (K, h, w) of each, bilinear; differentiable."""
    _, h, w = images.shape
    Y, X = jnp.clip(Y, 0, h - 1), jnp.clip(X, 0, w - 1)
    y0 = jnp.minimum(Y.astype(int), max(h - 2, 0))
    x0 = jnp.minimum(X.astype(int), max(w - 2, 0))
    y1, x1 = jnp.minimum(y0 + 1, h - 1), jnp.minimum(x0 + 1, w - 1)
    fy, fx = Y - y0, X - x0
    k = jnp.arange(len(images))[:, None, None]
    top = (1 - fx) * images[k, y0, x0] + fx * images[k, y0, x1]
    bottom = (1 - fx) * images[k, y1, x0] + fx * images[k, y1, x1]
    return (1 - fy) * top + fy * bottom


def within(Y: Array, X: Array, height: int, width: int) -> Array:
    """Where points lie in an image."""
    return (X >= -0.5) & (X <= width - 0.5) & (Y >= -0.5) & (Y <= height - 0.5)


def warp_purely(L: Array, V: Array, clear: Array, s: Array, paths: Array) -> Along:
    """The same as `warp`; differentiable."""
    _, h, w = L.shape
    Y, X = places(paths, s)
    inside = within(Y, X, h, w)
    V, clear = sample(V, Y, X), sample(clear, Y, X)
    Y, X = jnp.clip(Y, 0, h - 1), jnp.clip(X, 0, w - 1)
    y0 = jnp.minimum(Y.astype(int), max(h - 2, 0))
    x0 = jnp.minimum(X.astype(int), max(w - 2, 0))
    fy, fx = Y - y0, X - x0
    k = jnp.arange(len(s))[:, None, None]
    row = [jnp.clip(y0 + i, 0, h - 1) for i in range(-1, 3)]
    column = [jnp.clip(x0 + j, 0, w - 1) for j in range(-1, 3)]

    def cubic(f: Array) -> Array:
        a = CUBIC
        far, rest = 1 + f, 1 - f
        first = ((a * far - 5 * a) * far + 8 * a) * far - 4 * a
        second = ((a + 2) * f - (a + 3)) * f * f + 1
        third = ((a + 2) * rest - (a + 3)) * rest * rest + 1
        return jnp.stack([first, second, third, 1 - first - second - third])

    # Around the points: (rows, columns, k, h, w).
    taps = L[k, jnp.stack(row)[:, None], jnp.stack(column)]
    bicubic = (cubic(fy)[:, None] * cubic(fx) * taps).sum((0, 1))
    return Along(bicubic, V, clear, inside.astype(L.dtype))
