"""Variance of images, of errors that the models of filter and smoother leave out.

Filter and smoother take noise as white. Errors of real recordings last: the noise of a frame is
that of the whole gap after it, thresholds are wrong at every event, a pixel moves below its
threshold without events, and frames change their brightness. The estimate between two frames rests
on both, whatever the gains, so its error is that of a bridge between them. Let w = 4 v (1 - v) at
the part v of the gap. The variance is

    V = r (1 - w / 2) + w (c^2 (s^2 M + e^2 A) + d^2 D^2 / (1 + A) + F / (I + I0)^2)

r is the noise of the frames, A the activity, events of the pixel and of its neighbours, D the
change between the frames that events do not explain, M how much of the recording moves, F the
flicker of its frames, c^2 the mean of the squares of the thresholds and of a usual one. Before the
first frame and after the last one D is not known, and the error walks on:
V = r + 4 c^2 (s^2 M + e^2 A) + F / (I + I0)^2.

The filter's gains follow its own P, which falls without bound. P is added: it is the noise of
events that the filter has not forgotten yet.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxevent.parameters import Positive
from jaxevent.reconstruction.augment import integrate_counts, measured_share
from jaxevent.reconstruction.features import FrameFeatures, ImagePoints

# Members of a `Params`, in this order: r, e, s and d of the module's formula.
ERROR_PARAMETERS = (
    Positive(0.005, "intensity", "noise of a frame's pixel, for the variance of images"),
    Positive(0.27, "c", "error halfway between frames, per square root of events"),
    Positive(0.08, "c", "error halfway between frames where no events are"),
    Positive(0.41, "1", "error halfway between frames, as part of the change without events"),
)
# Errors do not shrink in proportion to low thresholds, or to those found too low.
USUAL_THRESHOLD = 0.1  # ln I
MIN_INTENSITY = 1e-15  # whose square is in the range of float32
NEIGHBOUR_SHARE = 0.5  # of an event, that belongs to the activity of its eight neighbours
ONE_SIDED_FACTOR = 4.0  # of a random walk's variance over that of its bridge, halfway


def activity_variance(params: Any, activity: Any, movement: Any) -> Array:
    """Return the variance halfway between frames by activity alone, D = 0.

    Args:
        params: Thresholds, `error_event` and `error_still`.
        activity: Events of a pixel and its neighbours, A.
        movement: How much of the recording moves, 0 to 1.

    Returns:
        The variance, (ln I)^2.
    """
    c2 = (params.c_on**2 + params.c_off**2) / 2
    c2 = (c2 + USUAL_THRESHOLD**2) / 2
    return c2 * (params.error_still**2 * movement + params.error_event**2 * activity)


def gap_variance(params: Any, activity: Array, residual: Array, movement: Any) -> Array:
    """Return the variance halfway between two frames, beside their noise and flicker.

    Args:
        params: Thresholds, `error_event`, `error_still` and `error_change`.
        activity: Events of a pixel and its neighbours between the frames, A.
        residual: Change between the frames that events do not explain, ln I, D.
        movement: How much of the recording moves, 0 to 1.

    Returns:
        The variance, (ln I)^2.
    """
    unexplained = (params.error_change * residual) ** 2 / (1 + activity)
    return activity_variance(params, activity, movement) + unexplained


def bridge_weight(part: Array) -> Array:
    """Return w, 1 halfway between two frames and 0 at them, at a part of the gap."""
    return 4 * part * (1 - part)


class AugmentedFrameErrors(eqx.Module):
    """Variance of the augmented frame: `steady` + w `halfway` + `per_event` (ON + OFF events).

    Attributes:
        steady: Variance at all times, (ln I)^2.
        halfway: Variance per weight w of the blend, (ln I)^2.
        per_event: Variance per event, (ln I)^2.
    """

    steady: Float[Array, "pieces pixels"]
    halfway: Float[Array, "pieces pixels"]
    per_event: Float[Array, "pieces pixels"]

    def __init__(self, params: Any, frames: FrameFeatures):
        between = jnp.asarray(frames.blend_rate)[:, None] > 0
        here = frames.intensity + params.I0
        there = jnp.where(between, jnp.roll(here, -1, axis=0), here)
        counts = jnp.asarray(frames.span)
        if frames.head is not None and frames.tail is not None:  # from the middles of exposures
            counts = counts - frames.head - jnp.roll(jnp.asarray(frames.tail), -1, axis=1)
        # ln a - ln b = 2 (a - b) / (a + b), to the third order of the difference.
        slope = 2 / (here + there)  # of ln(I + I0), between the two frames
        residual = (there - here) * slope - integrate_counts(params, counts[0], counts[1])
        own = counts[0] + counts[1]
        around = jnp.asarray(frames.around) - frames.span[0] - frames.span[1]
        activity = (1 - NEIGHBOUR_SHARE) * own + NEIGHBOUR_SHARE / 8 * around
        noise, flicker = (params.frame_noise * slope) ** 2, frames.flicker * slope**2
        shown = measured_share(params, frames)
        if shown is not None:  # a level beyond white is known to within a threshold
            both = jnp.minimum(shown, jnp.where(between, jnp.roll(shown, -1, axis=0), shown))
            noise = noise + (1 - both) * params.c_on * params.c_off / 3
        # Of neighbours those of the last gap count: half of it lies between frame and time.
        near = jnp.where(between, around, jnp.roll(around, 1, axis=0)) * NEIGHBOUR_SHARE / 16
        walk = ONE_SIDED_FACTOR * activity_variance(params, near, frames.movement)
        step = ONE_SIDED_FACTOR * activity_variance(params, 1 - NEIGHBOUR_SHARE, 0.0)
        bridge = gap_variance(params, activity, residual, frames.movement) + flicker
        alone = noise + flicker + walk
        steady = jnp.where(between, noise, alone)
        halfway = jnp.where(between, bridge - noise / 2, 0)
        per_event = jnp.where(between, 0, step) * jnp.ones_like(own)
        # Before the first frame the events until then count.
        first = alone[0] + step * (frames.before[0] + frames.before[1])
        begin = (first, jnp.zeros_like(first), -step * jnp.ones_like(first))
        pieces = 1 if frames.head is None else 2  # of a frame: its exposure, and the gap after it
        self.steady, self.halfway, self.per_event = (
            jnp.concatenate([before[None], jnp.repeat(table, pieces, axis=0)])
            for before, table in zip(begin, (steady, halfway, per_event), strict=True)
        )

    def __call__(self, points: ImagePoints) -> Float[Array, "times pixels"]:
        events = points.gather_piece(self.per_event) * (points.on + points.off)
        bridge = bridge_weight(points.blend) * points.gather_piece(self.halfway)
        return points.gather_piece(self.steady) + bridge + events
