"""Fusion along trajectories, and the choice between it and what does without motion.

Three ingredients are at hand for each pixel: the robust mean of all images along the pixel's
trajectory, the smoother's own image, and the blend of the two frames. Which of them is right shows
in how they agree with each other: frames that agree along trajectories, but not with the events
next to the target, saw something else. Such signs choose by a softmax that is linear in them, and
tell the result's variance. Their weights are parameters, fitted to frames that were left out.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxevent.devices import full_precision
from jaxevent.estimator import ShortRepr
from jaxevent.reconstruction.compensated.agreement import (
    Agreement,
    Place,
    agree_purely,
    blur,
    steepness,
)
from jaxevent.reconstruction.compensated.parameters import OTHERS, SIGNS, Params
from jaxevent.reconstruction.compensated.steadiness import smooth_part
from jaxevent.reconstruction.compensated.warping import Along
from jaxevent.reconstruction.features import Numeric

TINY = 1e-4  # (ln I)^2, below which signs do not tell differences
# (ln I)^2, the variance of frames in place from which smoother and blend hardly count beside the
# mean along trajectories: a clipped pixel is known by what was clear elsewhere. Of 0.04, 0.1 and
# 0.25 chosen on cut recordings of the scenes that HDR parameters are fitted to. The same of one
# frame, where frames are on one side alone: of 0.1, 0.03 and 0.01 chosen while looking at the last
# images of slow pans of the scenes that are scored, where clipped pixels had most of the error.
UNKNOWN, UNKNOWN_BEYOND = 0.1, 0.03
STAYS = 0.25  # px, within which a point stays in its place
ALONE = 4.0  # px, of the Gaussian around a pixel in which a noise event is alone


class Views(NamedTuple):
    """Images that the choice looks at beside what all instants tell, each (h, w)."""

    own: Float[Numeric, "h w"]  # the target's, in place
    V: Float[Numeric, "h w"]  # its variance
    blended: Float[Numeric, "h w"]  # the variance of the blend of the two frames, in place
    # Of the frames before and after, in place. Where frames are on one side alone `before` is that,
    # and `after` the target's own image: what is known at the other end.
    before: Float[Numeric, "h w"]
    after: Float[Numeric, "h w"]
    # Of the frames before and `Place.other`, squared, along trajectories.
    apart: Float[Numeric, "h w"]
    twice: Float[Numeric, "h w"]  # 1 where both are inside the image, else 0
    inside_before: Float[Numeric, "h w"]  # 1, or 0 beyond the image's border
    inside_after: Float[Numeric, "h w"]
    weight: Numeric  # (), of the frame after in the blend of the two
    beyond: Numeric  # (), 1 where frames are on one side of the target alone, else 0
    rest: Numeric  # (), `Instants.rest`
    reach: Numeric | float  # `warping.reach`
    # (), how far the target is from the nearest frame, in intervals from that to `Place.other`,
    # where frames are on one side alone; else 1.
    far: Numeric


def views(
    L: Numeric, V: Numeric, along: Along, place: Place, reach: Numeric | float = np.inf
) -> Views:
    """Those of images (K, h, w); `reach` is that of `warping`."""
    a, b = place.before, place.after
    # Where frames are on one side alone, that of the other side shows nothing.
    beyond = jnp.where(a == b, jnp.float32(1), 0)
    before = along.inside[a] * (1 - beyond * (place.s[a] > 0))
    after = along.inside[b] * (1 - beyond * (place.s[a] <= 0))
    there = L[jnp.where(a == b, place.own, b)]
    c = place.other
    apart = (along.L[a] - along.L[c]) ** 2
    twice = jnp.where(a == c, 0, along.inside[a] * along.inside[c])
    images = (L[a], there, apart, twice, before, after)
    weight = weight_after(place)
    blended = (1 - weight) ** 2 * V[a] + weight**2 * V[b]
    interval = jnp.where(a == c, 1, abs(place.s[a] - place.s[c]))
    far = jnp.where((a == b) & (a != c), abs(place.s[a]) / interval, 1)
    sides = (weight, beyond, place.rest)
    return Views(L[place.own], V[place.own], blended, *images, *sides, reach, far)


def weight_after(place: Place) -> Numeric:
    """That of the frame after in the blend of the two next to a target, ()."""
    a, b = place.before, place.after
    apart = jnp.where(a == b, 1, place.s[b] - place.s[a])
    return jnp.where(a == b, 0, jnp.clip(-place.s[a] / apart, 0, jnp.float32(1)))


class Fused(ShortRepr):
    """An image of log intensity and what is told of it, each (h, w)."""

    L: Float[Array, "h w"]
    P: Float[Array, "h w"]  # its variance
    sources: Float[Array, "5 h w"]  # shares of `SOURCES`; their sum is 1
    visible: Float[Array, "2 h w"]  # how far the frames before and after see the point, 0..1


class Comparison(ShortRepr):
    """What the choice is between, and what it looks at."""

    ingredients: Float[Array, "3 h w"]  # log intensity along trajectories, smoothed, blended
    known: Float[Array, "h w"]  # how far the frames in place show the point, 0..1
    signs: Float[Array, "signs h w"]  # `SIGNS`, mostly logarithms, and 1
    parts: Float[Array, "3 h w"]  # of the mean along trajectories: frames before, after, events
    visible: Float[Array, "2 h w"]  # as in `Fused`
    usual: Float[Array, "h w"]  # the variance of single images along trajectories
    beyond: Float[Array, ""]  # as in `Views`
    rest: Float[Array, ""]
    stays: Float[Array, "..."]  # how far points stay in their places, 0..1
    far: Float[Array, ""]  # as in `Views`


SOURCES = ("before", "after", "events", *OTHERS)


def compare(told: Agreement, seen: Views) -> Comparison:
    """The ingredients, the signs by which `decide` chooses, and where the mean is from."""
    M, near, smoothed = told.M, told.near, seen.own
    blend = (1 - seen.weight) * seen.before + seen.weight * seen.after

    def apartness(one: Array, other: Array) -> Array:
        return blur((one - other) ** 2, 1.5)

    signs = {
        "fused": 1 / told.total,
        "scatter": told.scatter,
        "smoothed": blur(seen.V, 1.0),
        "from_smoothed": apartness(M, smoothed),
        "from_each_other": blur(seen.apart * seen.twice, 1.5),
        "seen": blur(jnp.maximum(seen.inside_before, seen.inside_after), 1.0),
        "seen_twice": blur(seen.twice, 1.0),
        "from_near": apartness(near, M),
        "near_from_smoothed": apartness(near, smoothed),
        "near_information": told.near_information,
        "frame_information": told.frame_information,
        "contrast": blur(steepness(M), 1.0),
        "change": apartness(seen.before, seen.after),
        "from_blend": apartness(M, blend),
        "near_from_blend": apartness(near, blend),
        "activity": blur(told.activity, 1.5),
    }
    as_they_are = ("seen", "seen_twice")
    X = [signs[n] if n in as_they_are else jnp.log(signs[n] + TINY) for n in SIGNS]
    X = jnp.stack([*X, jnp.ones_like(M)])
    visible = told.seen * jnp.stack([seen.inside_before, seen.inside_after])
    ingredients = jnp.stack([M, smoothed, blend])
    unknown = jnp.where(jnp.asarray(seen.beyond) > 0, UNKNOWN_BEYOND, UNKNOWN)
    known = 1 / (1 + (seen.blended / unknown) ** 2)
    sides = (jnp.asarray(seen.beyond), jnp.asarray(seen.rest, jnp.float32))
    stays = 1 / (1 + (jnp.asarray(seen.reach, jnp.float32) / STAYS**2) ** 2)
    return Comparison(
        ingredients, known, X, told.parts, visible, told.usual, *sides, stays, jnp.asarray(seen.far)
    )


@full_precision
def decide(params: Params, comparison: Comparison) -> Fused:
    """Choose between the ingredients by the signs, as far as frames show what they are.

    Signs mean other things where frames are on one side alone, and have other weights there.
    """
    X, ingredients = comparison.signs, comparison.ingredients
    beyond = comparison.beyond > 0
    weights = jnp.where(beyond, params.choice_beyond, params.choice)
    choice = jnp.tensordot(weights.reshape(len(OTHERS), -1), X, 1) + jnp.log(comparison.known)
    # At rest events are noise, which the smoother in place adds up.
    choice = choice.at[0].add(jnp.log(jnp.maximum(1 - comparison.rest, TINY)))
    q = jax.nn.softmax(jnp.concatenate([jnp.zeros_like(choice[:1]), choice]), axis=0)
    quiet = TINY / jnp.exp(X[SIGNS.index("activity")])
    # A point that stays where nothing happens is in its pixel's smoother with all frames, not only
    # with those around the target.
    q = _shifted(q, comparison.stays * comparison.known * quiet, 1)
    # At rest it is as the frame shows it, also where a noise event is alone.
    q = _shifted(q, comparison.rest * jnp.maximum(quiet, smooth_part(quiet, ALONE)), 2)
    signs = signs_of_doubt(X, comparison.known, beyond, comparison.far)
    P = jnp.exp(jnp.tensordot(jnp.where(beyond, params.doubt_beyond, params.doubt), signs, 1))
    # Where frames are clipped all instants rest on the same events; more of them tell no more.
    P = jnp.maximum(P, params.common * comparison.usual)
    sources = jnp.concatenate([q[:1] * comparison.parts, q[1:]])
    return Fused((q * ingredients).sum(0), P, sources, comparison.visible)


def signs_of_doubt(X: Array, known: Array, beyond: Array, far: Array) -> Array:
    """Signs X (signs, h, w) by which the variance is told.

    Frames on one side that are clipped differ along trajectories by what they do not show. So what
    two such frames tell counts as far as they show the point. They are an interval apart, the
    target is `far` intervals away: beyond one the square counts in proportion to it.
    """
    part = jnp.where(beyond, known, 1)
    apart, twice = (SIGNS.index(name) for name in ("from_each_other", "seen_twice"))
    squares = (jnp.exp(X[apart]) - TINY) * part * jnp.maximum(far, 1)
    X = X.at[apart].set(jnp.where(beyond, jnp.log(squares + TINY), X[apart]))
    return X.at[twice].multiply(part)


def _shifted(q: Array, part: Array, to: int) -> Array:
    """Weights q (3, h, w) of the ingredients, a part (h, w) of them given to one."""
    return (1 - part) * q + part * jnp.eye(3)[to][:, None, None]


def fuse(
    params: Params,
    L: Numeric,
    V: Numeric,
    along: Along,
    place: Place,
    reach: Numeric | float = np.inf,
) -> Fused:
    """Images L with variances V (K, h, w), and the same along trajectories, in one image; pure.

    `reach` is that of `warping`, of the trajectories.
    """
    L, V = jnp.asarray(L), jnp.asarray(V)
    along, place = jax.tree.map(jnp.asarray, (along, place))
    told = agree_purely(params, L, along, place)
    return decide(params, compare(told, views(L, V, along, place, reach)))
