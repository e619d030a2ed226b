"""Images of warped events: where events fall if they are moved back along a motion, and how sharp.

If the motion is the right one, the events that one point of the scene made fall together, and the
image of their polarities has a high contrast (Gallego, Rebecq & Scaramuzza, "A Unifying Contrast
Maximization Framework for Event Cameras", CVPR 2018).

    image = blur(splat(warped, polarity, (height, width)), 1)
    sharpness = contrast(image)
"""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float
from numpy.typing import NDArray

from jaxevent.egomotion.geometry import Scalars


def splat(
    xy: Float[Array | NDArray, "E 2"],
    weight: Float[Array | NDArray, "*channels E"],
    shape: tuple[int, int],
    offset: tuple[Scalars, Scalars] = (0.0, 0.0),
) -> Float[Array, "*channels height width"]:
    """Images I(x) = sum_e weight_e k(x - xy_e), k bilinear: an event goes to its four pixels.

    The pixel [j, i] lies at (i, j) + `offset`, x first, px: minus the principal point for
    coordinates that are counted from there. What would fall outside the image, or is not finite,
    counts nothing; at the border weights fade, so the image is continuous in `xy`. Differentiable
    in `xy` and `weight`, forward and in reverse.
    """
    xy, weight = jnp.asarray(xy), jnp.asarray(weight)
    height, width = shape
    # A frame of one pixel around the image takes what leaves it.
    x = jnp.clip(_finite(xy[:, 0] - offset[0]) + 1, 0, width + 1)
    y = jnp.clip(_finite(xy[:, 1] - offset[1]) + 1, 0, height + 1)
    i, j = jnp.floor(x), jnp.floor(y)
    u, v = x - i, y - j
    place = j.astype(jnp.int32) * (width + 2) + i.astype(jnp.int32)
    share = jnp.stack([(1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v], -1)
    # One row of four per event, then four shifted sums: 1.6 ms for 100 k events, 2.4 ms as four
    # scatters. At the last row and column u and v are 0.
    rows = jnp.zeros((*weight.shape[:-1], (height + 2) * (width + 2), 4), xy.dtype)
    rows = rows.at[..., place, :].add(weight[..., None] * share, mode="promise_in_bounds")
    four = rows.reshape(*weight.shape[:-1], height + 2, width + 2, 4)
    return (
        four[..., 1:-1, 1:-1, 0]
        + four[..., 1:-1, :-2, 1]
        + four[..., :-2, 1:-1, 2]
        + four[..., :-2, :-2, 3]
    )


def blur(image: Float[Array, "*channels height width"], times: int = 1) -> Array:
    """The image under [1 2 1] / 4 in x and in y, so many times; black beyond the border."""
    for _ in range(times):
        for axis in (image.ndim - 2, image.ndim - 1):
            n = image.shape[axis]
            pad = [(1, 1) if k == axis else (0, 0) for k in range(image.ndim)]
            wide = jnp.pad(image, pad)
            before, here, after = (lax.slice_in_dim(wide, k, k + n, axis=axis) for k in range(3))
            image = (before + 2 * here + after) / 4
    return image


def energy(image: Float[Array, "*channels height width"]) -> Float[Array, ""]:
    """The sum of squares: of polarities, how many pairs of like events fall together, net."""
    return jnp.sum(image**2)


def contrast(image: Float[Array, "height width"]) -> Float[Array, ""]:
    """The variance of an image (Gallego et al., 2018)."""
    return jnp.var(image)


def _finite(value: Array) -> Array:
    return jnp.where(jnp.isfinite(value), value, -1e6)
