"""Fusion along trajectories, and the choice between it and what does without motion.

Three ingredients are at hand for each pixel: the robust mean of all images along the pixel's
trajectory, the smoother's own image, and the blend of the two frames. Which of them is right shows
in how they agree with each other: frames that agree along trajectories, but not with the events
next to the target, saw something else. Such signs choose by a softmax that is linear in them, and
tell the result's variance. Their weights are parameters, fitted to frames that were left out.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxevent.estimator import Described
from jaxevent.reconstruction.compensated.parameters import OTHERS, SIGNS, Params
from jaxevent.reconstruction.compensated.warping import Along
from jaxevent.reconstruction.features import Numeric

TINY = 1e-4  # (ln I)^2, below which signs do not tell differences
PLAIN = 3.0  # the misfit of an instant that scatter hardly counts
OUTSIDE = 1e6  # variance beyond the image's border


class Place(NamedTuple):
    """Where the instants of a target lie among each other."""

    s: Float[Numeric, " k"]  # times relative to the target, -1..1
    present: Float[Numeric, " k"]  # 1, or 0 of instants that only fill up the number
    framed: Float[Numeric, " k"]  # 1 where a frame was taken
    near: Float[Numeric, " k"]  # 1 of those next to the target, frames aside, and of the target
    own: Numeric  # (), the target's
    before: Numeric  # (), that of the frame before
    after: Numeric


class Fused(Described):
    """An image of log intensity and what is told of it, each (h, w)."""

    L: Float[Array, "h w"]
    P: Float[Array, "h w"]  # its variance
    sources: Float[Array, "5 h w"]  # shares of `SOURCES`; their sum is 1
    visible: Float[Array, "2 h w"]  # how far the frames before and after see the point, 0..1


class Comparison(Described):
    """What the choice is between, and what it looks at."""

    ingredients: Float[Array, "3 h w"]  # log intensity along trajectories, smoothed, blended
    signs: Float[Array, "signs h w"]  # `SIGNS`, mostly logarithms, and 1
    parts: Float[Array, "3 h w"]  # of the mean along trajectories: frames before, after, events
    visible: Float[Array, "2 h w"]  # as in `Fused`


SOURCES = ("before", "after", "events", *OTHERS)


def blur(image: Array, sigma: float) -> Array:
    """A Gaussian over the last two axes."""
    reach = int(np.ceil(3 * sigma))
    taps = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    taps /= taps.sum()
    for axis in (image.ndim - 2, image.ndim - 1):
        size = image.shape[axis]
        padded = _pad(image, axis, reach)
        moved = [jax.lax.slice_in_dim(padded, i, i + size, axis=axis) for i in range(len(taps))]
        image = functools.reduce(
            jnp.add, [float(tap) * part for tap, part in zip(taps, moved, strict=True)]
        )
    return image


def _pad(image: Array, axis: int, size: int) -> Array:
    rest = [(0, 0)] * image.ndim
    rest[axis] = (size, size)
    return jnp.pad(image, rest, mode="edge")


def steepness(image: Array) -> Array:
    """|grad|^2 of an image (h, w)."""
    total = jnp.zeros_like(image)
    for axis in (0, 1):
        padded, size = _pad(image, axis, 2), image.shape[axis]
        a, b, _, d, e = (jax.lax.slice_in_dim(padded, i, i + size, axis=axis) for i in range(5))
        total = total + ((8 * (d - b) - e + a) / 12) ** 2
    return total


class Agreement(NamedTuple):
    """What all instants together tell along trajectories."""

    M: Float[Array, "h w"]  # their robust mean
    W: Float[Array, "k h w"]  # information of each instant
    R: Float[Array, "k h w"]  # the same where the point is seen
    seen: Float[Array, "k h w"]  # 0..1
    scatter: Float[Array, "h w"]  # variance beyond what the instants' own explain


def agree(params: Params, L: Float[Array, "h w"], along: Along, place: Place) -> Agreement:
    """The robust mean along trajectories, begun from the target's own image L.

    An instant counts by its information, V and what warping adds to it; where it differs from the
    others by more than that the point is hidden there. Excess scatter tells failed motion.
    """
    p = params
    s = place.s[:, None, None]
    here = (jnp.arange(len(place.s)) == place.own)[:, None, None]
    eta = p.information + (1 - p.information) * along.clear
    eta = eta * place.present[:, None, None]
    base = jnp.where(along.inside > 0, along.V + p.floor, OUTSIDE)
    steep = steepness(blur(L, 1.0))
    variance, seen = base, jnp.exp(-2 * s**2)  # at first the near instants tell
    for turn in range(3):
        variance = base + jnp.where(here, 0, p.sigma_place**2 * steep + p.sigma_between**2)
        R = eta / variance * seen
        M = (R * along.L).sum(0) / R.sum(0)
        steep = steepness(M)
        misfit = blur((along.L - M) ** 2 / variance, 1.5)
        if turn == 0:
            misfit = jnp.where(here, jnp.minimum(misfit, 1), misfit)
        seen = 1 / (1 + (misfit / p.tolerance) ** 2)
    W = eta / variance
    R = W * seen
    M = (R * along.L).sum(0) / R.sum(0)
    # Of all instants but the plainly hidden ones, whatever the tolerance.
    plain = place.present[:, None, None] / variance / (1 + (misfit / PLAIN) ** 2)
    excess = (plain * ((along.L - M) ** 2 - 0.6 * variance)).sum(0)
    scatter = jnp.maximum(blur(excess, 2.0) / blur((plain * eta).sum(0), 2.0), 0)
    return Agreement(M, W, R, seen, scatter)


def compare(params: Params, L: Numeric, V: Numeric, along: Along, place: Place) -> Comparison:
    """Images L with variances V (K, h, w), and the same along trajectories: the ingredients.

    Beside them the signs by which `decide` chooses, and where the mean along trajectories is from.
    """
    L, V = jnp.asarray(L), jnp.asarray(V)
    along, place = jax.tree.map(jnp.asarray, (along, place))
    own, a, b = place.own, place.before, place.after
    M, W, R, seen, scatter = agree(params, L[own], along, place)
    total = R.sum(0)
    smoothed = L[own]
    apart = jnp.where(a == b, 1, place.s[b] - place.s[a])
    w = jnp.where(a == b, 0, jnp.clip(-place.s[a] / apart, 0, 1))
    blend = (1 - w) * L[a] + w * L[b]
    near, near_information = _mean(along, W, place.near)
    _, frame_information = _mean(along, W, place.framed)
    inside = along.inside
    twice = inside[a] * inside[b]
    order = jnp.arange(len(place.s))
    between = ((order > a) & (order + 1 < b))[:-1, None, None]

    def apartness(one: Array, other: Array) -> Array:
        return blur((one - other) ** 2, 1.5)

    signs = {
        "fused": 1 / total,
        "scatter": scatter,
        "smoothed": blur(V[own], 1.0),
        "from_smoothed": apartness(M, smoothed),
        "from_each_other": blur((along.L[a] - along.L[b]) ** 2 * twice, 1.5),
        "seen": blur(jnp.maximum(inside[a], inside[b]), 1.0),
        "seen_twice": blur(twice, 1.0),
        "from_near": apartness(near, M),
        "near_from_smoothed": apartness(near, smoothed),
        "near_information": near_information,
        "frame_information": frame_information,
        "contrast": blur(steepness(M), 1.0),
        "change": apartness(L[a], L[b]),
        "from_blend": apartness(M, blend),
        "near_from_blend": apartness(near, blend),
        "activity": blur(((L[1:] - L[:-1]) ** 2 * between).sum(0), 1.5),
    }
    as_they_are = ("seen", "seen_twice")
    X = [signs[n] if n in as_they_are else jnp.log(signs[n] + TINY) for n in SIGNS]
    X = jnp.stack([*X, jnp.ones_like(M)])
    share = R / total
    framed, s = place.framed[:, None, None], place.s[:, None, None]
    parts = [
        (share * framed * (s < 0)).sum(0),
        (share * framed * (s > 0)).sum(0),
        (share * (1 - framed)).sum(0) + (share * framed * (s == 0)).sum(0),
    ]
    return Comparison(
        jnp.stack([M, smoothed, blend]),
        X,
        jnp.stack(parts),
        jnp.stack([seen[a] * inside[a], seen[b] * inside[b]]),
    )


def decide(params: Params, comparison: Comparison) -> Fused:
    """Choose between the ingredients by the signs."""
    X, ingredients = comparison.signs, comparison.ingredients
    choice = jnp.tensordot(params.choice.reshape(len(OTHERS), -1), X, 1)
    q = jax.nn.softmax(jnp.concatenate([jnp.zeros_like(choice[:1]), choice]), axis=0)
    P = jnp.exp(jnp.tensordot(params.doubt, X, 1))
    sources = jnp.concatenate([q[:1] * comparison.parts, q[1:]])
    return Fused((q * ingredients).sum(0), P, sources, comparison.visible)


def fuse(params: Params, L: Numeric, V: Numeric, along: Along, place: Place) -> Fused:
    """Images L with variances V (K, h, w), and the same along trajectories, in one image."""
    return decide(params, compare(params, L, V, along, place))


def _mean(along: Along, W: Array, chosen: Array) -> tuple[Array, Array]:
    """The mean along trajectories over some instants, and its information."""
    weight = W * along.inside * chosen[:, None, None]
    total = weight.sum(0)
    return (weight * along.L).sum(0) / jnp.maximum(total, 1e-9), total
