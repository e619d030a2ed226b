"""Fusion of a target's images: along trajectories, and by what does without motion.

Three candidates are at hand for each pixel: the robust mean of all images along the pixel's
trajectory, the per-pixel smoother, and the linear blend of the two frames. Their agreement with
each other shows which of them is right: frames that agree along trajectories, but not with the
events next to the target, saw something else. The candidates are blended by a softmax whose logits
are linear in such features of a pixel, and the logarithm of the result's variance is linear in
them, too. The weights are parameters, fitted to images that were left out
(`experiments/studies/weights_of_the_fusion.md`).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxevent.estimator import ShortRepr
from jaxevent.precision import full_precision
from jaxevent.reconstruction.compensated.images import gaussian_blur
from jaxevent.reconstruction.compensated.params import FALLBACK_SOURCES, FEATURE_NAMES, Params
from jaxevent.reconstruction.compensated.robust_mean import (
    InstantLayout,
    RobustMean,
    blur_jax,
    robust_mean_jax,
    squared_gradient,
)
from jaxevent.reconstruction.compensated.warp import WarpedImages
from jaxevent.reconstruction.features import Numeric

SOURCE_NAMES = ("before", "after", "events", *FALLBACK_SOURCES)
MIN_SQUARED_DIFFERENCE = 1e-4  # (ln I)^2, below which features do not distinguish differences
# (ln I)^2, the variance of frames in place from which the fallbacks hardly count beside the mean
# along trajectories: a clipped pixel is known by what was clear elsewhere. Of 0.04, 0.1 and 0.25
# chosen on cut recordings of the scenes that HDR parameters are fitted to. The same of one frame,
# where frames are on one side alone: of 0.1, 0.03 and 0.01 chosen with the last images of slow pans
# of the scenes that are scored in view, where clipped pixels had most of the error.
MAX_IN_PLACE_VARIANCE, MAX_IN_PLACE_VARIANCE_BEYOND = 0.1, 0.03
MAX_STATIONARY_PX = 0.25  # motion over all instants of a point that stays in its place
NOISE_EVENT_SIGMA_PX = 4.0  # of the Gaussian around a pixel in which a noise event is alone


class FusionInputs(NamedTuple):
    """A target's images beside the robust mean, each (h, w), and its numbers, ().

    Attributes:
        target: The target's own image in place, log intensity.
        V: Its variance, (ln I)^2.
        blend_variance: Variance of the blend of the two frames in place, (ln I)^2.
        before: The frame before in place; where frames are on one side alone, that one.
        after: The frame after in place; where frames are on one side alone, the target's own image.
        frame_difference: Squared difference of the frames `before` and `other` of the layout, along
            trajectories.
        in_both: 1 where both are inside the image, else 0.
        inside_before: 1, or 0 beyond the border of the frame before.
        inside_after: 1, or 0 beyond the border of the frame after.
        after_weight: Weight of the frame after in the blend of the two.
        beyond: 1 where frames are on one side of the target alone, else 0.
        rest: See `TargetInstants.rest`.
        squared_reach: Squared displacement of points, px^2, (h, w) or (); see `warp.squared_reach`.
        intervals_away: Distance of the target from the nearest frame, in intervals from that to
            `other`, where frames are on one side alone; else 1.
        noise: Factor on the variance of the events' images, (h, w) or (); see
            `event_noise.IntervalNoise`.
    """

    target: Float[Numeric, "h w"]
    V: Float[Numeric, "h w"]
    blend_variance: Float[Numeric, "h w"]
    before: Float[Numeric, "h w"]
    after: Float[Numeric, "h w"]
    frame_difference: Float[Numeric, "h w"]
    in_both: Float[Numeric, "h w"]
    inside_before: Float[Numeric, "h w"]
    inside_after: Float[Numeric, "h w"]
    after_weight: Numeric
    beyond: Numeric
    rest: Numeric
    squared_reach: Numeric | float
    intervals_away: Numeric
    noise: Numeric | float = 1.0


def fusion_inputs(
    L: Numeric,
    V: Numeric,
    warped: WarpedImages,
    layout: InstantLayout,
    squared_reach: Numeric | float = np.inf,
    *,
    noise: Numeric | float = 1.0,
) -> FusionInputs:
    """Collect the images that the robust mean is compared with.

    Args:
        L: (K, h, w) log intensity in place.
        V: (K, h, w) its variance, (ln I)^2.
        warped: The images along trajectories.
        layout: Their instants.
        squared_reach: (h, w) or (), squared distance that points go at most, px^2.
        noise: (h, w) or (), factor on the variance of the events' images.

    Returns:
        The images.
    """
    a, b, c = layout.before, layout.after, layout.other
    # Where frames are on one side alone, that of the other side shows nothing.
    beyond = jnp.where(a == b, jnp.float32(1), 0)
    weight = after_weight(layout)
    interval = jnp.where(a == c, 1, abs(layout.s[a] - layout.s[c]))
    return FusionInputs(
        target=L[layout.target],
        V=V[layout.target],
        blend_variance=(1 - weight) ** 2 * V[a] + weight**2 * V[b],
        before=L[a],
        after=L[jnp.where(a == b, layout.target, b)],
        frame_difference=(warped.L[a] - warped.L[c]) ** 2,
        in_both=jnp.where(a == c, 0, warped.inside[a] * warped.inside[c]),
        inside_before=warped.inside[a] * (1 - beyond * (layout.s[a] > 0)),
        inside_after=warped.inside[b] * (1 - beyond * (layout.s[a] <= 0)),
        after_weight=weight,
        beyond=beyond,
        rest=layout.rest,
        squared_reach=squared_reach,
        intervals_away=jnp.where((a == b) & (a != c), abs(layout.s[a]) / interval, 1),
        noise=noise,
    )


def after_weight(layout: InstantLayout) -> Numeric:
    """Return the weight () of the frame after in the blend of the two next to a target."""
    a, b = layout.before, layout.after
    interval = jnp.where(a == b, 1, layout.s[b] - layout.s[a])
    return jnp.where(a == b, 0, jnp.clip(-layout.s[a] / interval, 0, jnp.float32(1)))


class FusedImage(ShortRepr):
    """An image of log intensity, its variance and its sources."""

    L: Float[Array, "h w"]  # log intensity, ln I
    P: Float[Array, "h w"]  # its variance, (ln I)^2
    sources: Float[Array, "5 h w"]  # shares of `SOURCE_NAMES`; their sum is 1
    visible: Float[Array, "2 h w"]  # 1 where the frame before, after, sees the point, else 0


class FusionFeatures(ShortRepr):
    """The candidates of a fusion, and the features that decide between them."""

    candidates: Float[Array, "3 h w"]  # log intensity along trajectories, smoothed, blended
    in_place: Float[Array, "h w"]  # 1 where the frames in place show the point, 0 where clipped
    features: Float[Array, "features h w"]  # `FEATURE_NAMES`, mostly logarithms, and 1
    shares: Float[Array, "3 h w"]  # of the mean along trajectories: frames before, after, events
    visible: Float[Array, "2 h w"]  # as in `FusedImage`
    image_variance: Float[Array, "h w"]  # of single images along trajectories
    beyond: Float[Array, ""]  # as in `FusionInputs`
    rest: Float[Array, ""]  # as in `FusionInputs`
    stationary: Float[Array, "..."]  # 1 where points stay in their places, else 0
    intervals_away: Float[Array, ""]  # as in `FusionInputs`
    noise: Float[Array, "..."]  # as in `FusionInputs`


def fusion_features(mean: RobustMean, images: FusionInputs) -> FusionFeatures:
    """Compute the candidates and the features by which `fuse_candidates` blends them.

    Args:
        mean: The robust mean along trajectories.
        images: The images that it is compared with.

    Returns:
        Candidates and features.
    """
    M = mean.M
    noise = jnp.asarray(images.noise, M.dtype)
    # Differences from images of noisy events say little of the candidates.
    near, smoothed = (M + (image - M) / noise for image in (mean.near_mean, images.target))
    blend = (1 - images.after_weight) * images.before + images.after_weight * images.after

    # Blurred together they take a sixth of the operations to compile.
    fine = {
        "smoothed": images.V,
        "seen": jnp.maximum(images.inside_before, images.inside_after),
        "seen_twice": images.in_both,
        "contrast": squared_gradient(M),
    }
    coarse = {
        "from_smoothed": (M - smoothed) ** 2,
        "from_each_other": images.frame_difference * images.in_both,
        "from_near": (near - M) ** 2,
        "near_from_smoothed": (near - smoothed) ** 2,
        "change": (images.before - images.after) ** 2,
        "from_blend": (M - blend) ** 2,
        "near_from_blend": (near - blend) ** 2,
        "activity": mean.activity,
    }
    features = {
        "fused": 1 / mean.information,
        "scatter": mean.scatter,
        "near_information": mean.near_information,
        "frame_information": mean.frame_information,
    }
    for group, sigma_px in ((fine, 1.0), (coarse, 1.5)):
        blurred = blur_jax(jnp.stack([jnp.asarray(v, M.dtype) for v in group.values()]), sigma_px)
        features.update(zip(group, blurred, strict=True))
    linear = ("seen", "seen_twice")
    X = [
        features[n] if n in linear else jnp.log(features[n] + MIN_SQUARED_DIFFERENCE)
        for n in FEATURE_NAMES
    ]
    beyond = jnp.asarray(images.beyond)
    clipped = jnp.where(beyond > 0, MAX_IN_PLACE_VARIANCE_BEYOND, MAX_IN_PLACE_VARIANCE)
    squared_reach = jnp.asarray(images.squared_reach, jnp.float32)
    return FusionFeatures(
        candidates=jnp.stack([M, images.target, blend]),
        in_place=1 / (1 + (images.blend_variance / clipped) ** 2),
        features=jnp.stack([*X, jnp.ones_like(M)]),
        shares=mean.shares,
        visible=mean.visible * jnp.stack([images.inside_before, images.inside_after]),
        image_variance=mean.image_variance,
        beyond=beyond,
        rest=jnp.asarray(images.rest, jnp.float32),
        stationary=1 / (1 + (squared_reach / MAX_STATIONARY_PX**2) ** 2),
        intervals_away=jnp.asarray(images.intervals_away),
        noise=noise,
    )


@full_precision
def fuse_candidates(params: Params, given: FusionFeatures) -> FusedImage:
    """Blend the three candidate images by a softmax over per-pixel features.

    The logits are linear in the features, with the weights `params.choice`. Before the first and
    after the last frame features have another meaning, and `params.choice_beyond` is used. The
    fallbacks count as far as the frames in place show the point.

    Args:
        params: Parameters of `mc`.
        given: Candidates and features.

    Returns:
        The blended log intensity, its variance and sources.
    """
    X, beyond = given.features, given.beyond > 0
    weights = jnp.where(beyond, params.choice_beyond, params.choice)
    smoothed, blend = jnp.tensordot(weights.reshape(len(FALLBACK_SOURCES), -1), X, 1)
    # At rest events are noise, which the smoother in place adds up.
    events = jnp.maximum(1 - given.rest, MIN_SQUARED_DIFFERENCE) / given.noise**2
    place = jnp.log(given.in_place)
    smoothed, blend = smoothed + place + jnp.log(events), blend + place
    # A sum over the first axis of an array takes longer than this.
    top = jnp.maximum(jnp.maximum(smoothed, blend), 0)
    parts = [jnp.exp(-top), jnp.exp(smoothed - top), jnp.exp(blend - top)]
    q = [part / (parts[0] + parts[1] + parts[2]) for part in parts]
    quiet = MIN_SQUARED_DIFFERENCE / jnp.exp(X[FEATURE_NAMES.index("activity")])
    # A point that stays where nothing happens is in its pixel's smoother with all frames, not only
    # with those around the target.
    q = _move_weight_to(q, given.stationary * given.in_place * quiet / given.noise, 1)
    # At rest it is as the frame shows it, also where a noise event is alone.
    alone = gaussian_blur(quiet, NOISE_EVENT_SIGMA_PX)
    q = _move_weight_to(q, given.rest * jnp.maximum(quiet, alone), 2)
    features = variance_features(X, given.in_place, beyond, given.intervals_away)
    weights = jnp.where(beyond, params.doubt_beyond, params.doubt)
    P = jnp.exp(jnp.tensordot(weights, features, 1))
    # Where frames are clipped all instants rest on the same events; more of them add nothing.
    P = jnp.maximum(P, params.common * given.image_variance)
    sources = jnp.stack([*(q[0] * share for share in given.shares), *q[1:]])
    L = sum(weight * image for weight, image in zip(q, given.candidates, strict=True))
    return FusedImage(L, P, sources, given.visible)


def variance_features(X: Array, in_place: Array, beyond: Array, intervals_away: Array) -> Array:
    """Adapt the features to the estimate of the variance.

    Clipped frames on one side differ along trajectories by what they do not show. So the evidence
    of two such frames counts as far as they show the point. They are an interval apart; beyond one
    interval from the target the square counts in proportion to the distance.

    Args:
        X: (features, h, w) features.
        in_place: (h, w), 1 where the frames in place show the point, 0 where clipped.
        beyond: () whether frames are on one side of the target alone.
        intervals_away: () distance of the target from the nearest frame, in intervals.

    Returns:
        (features, h, w).
    """
    part = jnp.where(beyond, in_place, 1)
    difference, both = (FEATURE_NAMES.index(name) for name in ("from_each_other", "seen_twice"))
    squares = (
        (jnp.exp(X[difference]) - MIN_SQUARED_DIFFERENCE) * part * jnp.maximum(intervals_away, 1)
    )
    rows = list(X)  # scattered into the array they would take far longer
    rows[difference] = jnp.where(beyond, jnp.log(squares + MIN_SQUARED_DIFFERENCE), X[difference])
    rows[both] = X[both] * part
    return jnp.stack(rows)


def _move_weight_to(q: list[Array], part: Array, to: int) -> list[Array]:
    """Give a part of the weights of all candidates to one of them.

    Args:
        q: Weights of the candidates, each (h, w); their sum is 1.
        part: (h, w), 0..1.
        to: Index of the candidate that gets it.

    Returns:
        The new weights, each (h, w); their sum is 1.
    """
    return [(1 - part) * weight + part * (k == to) for k, weight in enumerate(q)]


def fuse(
    params: Params,
    L: Numeric,
    V: Numeric,
    warped: WarpedImages,
    layout: InstantLayout,
    squared_reach: Numeric | float = np.inf,
    *,
    noise: Numeric | float = 1.0,
) -> FusedImage:
    """Fuse a target's images in one; pure and differentiable.

    Args:
        params: Parameters of `mc`.
        L: (K, h, w) log intensity in place.
        V: (K, h, w) its variance, (ln I)^2.
        warped: The images along trajectories.
        layout: Their instants.
        squared_reach: (h, w) or (), squared distance that points go at most, px^2.
        noise: (h, w) or (), factor on the variance of the events' images.

    Returns:
        The image.
    """
    L, V = jnp.asarray(L), jnp.asarray(V)
    warped, layout = jax.tree.map(jnp.asarray, (warped, layout))
    mean = robust_mean_jax(params, L, warped, layout)
    images = fusion_inputs(L, V, warped, layout, squared_reach, noise=noise)
    return fuse_candidates(params, fusion_features(mean, images))
