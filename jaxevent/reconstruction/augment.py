"""What the frames say at any time: deblurring, integration of events, interpolation.

Equation numbers are those of Wang et al., "An Asynchronous Kalman Filter for Hybrid Event Cameras",
ICCV 2021. Letters: L log intensity ln(I + I0), c contrast threshold, T exposure, tau mid-exposure.
Each model makes its tables, [rows, pixels], once per window; called with points (where they lie
among the frames, `pixels.Points`) it looks them up.
"""

from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxevent.camera import Response, UnknownResponse
from jaxevent.parameters import Number, Parameters, Positive
from jaxevent.reconstruction.pixels import FrameFeatures, Points


class FrameParams(Parameters):
    """Parameters of every estimator: thresholds and the frames' clock, offset and response."""

    response: Response

    c_on = Positive(0.1, "ln I", "contrast threshold of ON events")
    c_off = Positive(0.1, "ln I", "contrast threshold of OFF events")
    I0 = Positive(1.0, "intensity", "offset inside the logarithm, L = ln(I + I0)")
    clock_offset = Number(0.0, "s", "added to the frames' time stamps")

    def __init__(self, *, response: Response | None = None, **values: Any):
        super().__init__(**values)
        self.response = UnknownResponse() if response is None else response


class AugmentParams(FrameParams):
    """... and of the per-pixel contrast calibration (10)."""

    ratio_min = Positive(0.01, "1", "smallest calibrated over nominal threshold that is believed")
    ratio_max = Positive(1 / 0.6, "1", "largest calibrated over nominal threshold believed")

    def __init__(self, **values: Any):
        super().__init__(**values)


def brightness(params: FrameParams, on: Array, off: Array) -> Array:
    """Change of log intensity that events report: the sum of s c over them."""
    return params.c_on * on - params.c_off * off


def intensity(params: FrameParams, frames: FrameFeatures) -> Float[Array, "frames pixels"]:
    return params.response.intensity(jnp.asarray(frames.grey))


def late(params: FrameParams, frames: FrameFeatures) -> Float[Array, ""]:
    """Seconds by which the frames' clock differs from the one that was prepared; 0 in `video`."""
    return params.clock_offset - frames.clock_offset


def deblurred(
    params: FrameParams, frames: FrameFeatures
) -> tuple[Float[Array, "frames pixels"], Float[Array, "frames pixels"]]:
    """Log intensity at the left and right edge of each exposure (event double integral).

    The exposure averages exp(E(t)), E the events' change since mid-exposure. E is piecewise
    constant, so the mean is exact: m = 1 + sum over segments of share (exp(E) - 1), and
    l(D) = ln((I + I0) / m).
    """
    grey = intensity(params, frames)
    level = jnp.log(grey + params.I0)
    if frames.segments is None or frames.head is None or frames.tail is None:
        return level, level
    s = frames.segments
    share = s.share + late(params, frames) * s.edge
    excess = share * jnp.expm1(brightness(params, s.on, s.off))
    total = jax.ops.segment_sum(excess, s.cell, grey.size).reshape(grey.shape)
    level = level - jnp.log1p(total)
    return (
        level - brightness(params, frames.head[0], frames.head[1]),
        level + brightness(params, frames.tail[0], frames.tail[1]),
    )


def _lagging(lag: Array, here: Array, there: Array) -> tuple[Array, Array]:
    """Ends whose blend with weight w is that of `here` and `there` with weight w - lag."""
    drift = lag * (here - there)
    return here + drift, there + drift


class Level(eqx.Module):
    """Base of the models of log intensity."""

    Params: ClassVar[type[FrameParams]] = FrameParams

    def __init__(self, params: FrameParams, frames: FrameFeatures):
        raise NotImplementedError

    def __call__(self, points: Points) -> Float[Array, "*points"]:
        raise NotImplementedError


class Augmented(Level):
    """L^A(t), (8)-(11): between two deblurred frames, integrated from both with c calibrated.

    Each piece blends two lines base + ratio S, S the nominal integral of events since the left edge
    of the piece's exposure. The calibrated threshold is `ratio` times the nominal one (10).
    """

    Params = AugmentParams
    params: AugmentParams
    from_base: Float[Array, "pieces pixels"]
    from_ratio: Float[Array, "pieces pixels"]
    to_base: Float[Array, "pieces pixels"]
    to_ratio: Float[Array, "pieces pixels"]

    def __init__(self, params: AugmentParams, frames: FrameFeatures):
        left, right = deblurred(params, frames)
        span = brightness(params, frames.span[0], frames.span[1])  # row f: from frame f to f + 1
        following = jnp.roll(right, -1, axis=0)
        ratio = (following - left) / jnp.where(span == 0, 1, span)
        believed = (span != 0) & (ratio >= params.ratio_min) & (ratio <= params.ratio_max)
        ratio = jnp.where(believed, ratio, 1)

        # Before the first exposure: backwards from its right edge with the nominal threshold.
        first = right[0] - brightness(params, frames.before[0], frames.before[1])
        one = jnp.ones_like(first)
        before = (first, one, first, one)
        # In the gap after frame f: forwards from its left edge (8), backwards from the next one's
        # right edge (9). After the last frame span is 0, so the forward line is nominal.
        gap = (left, ratio, following - ratio * span, ratio)
        if frames.head is None or frames.tail is None:
            rows = [jnp.concatenate([b[None], g]) for b, g in zip(before, gap, strict=True)]
        else:
            # Within exposure f: from the backward line of the interval before it to the forward
            # line of the one after it (11).
            back = jnp.concatenate([one[None], ratio[:-1]])
            own = frames.head + frames.tail
            inside = (right - back * brightness(params, own[0], own[1]), back, left, ratio)
            rows = [
                jnp.concatenate([b[None], jnp.stack([e, g], 1).reshape(-1, len(first))])
                for b, e, g in zip(before, inside, gap, strict=True)
            ]
        from_base, from_ratio, to_base, to_ratio = rows
        lag = late(params, frames) * frames.piece_rate[:, None]
        self.params = params
        self.from_base, self.to_base = _lagging(lag, from_base, to_base)
        self.from_ratio, self.to_ratio = _lagging(lag, from_ratio, to_ratio)

    def __call__(self, points: Points) -> Float[Array, "*points"]:
        S = brightness(self.params, points.on, points.off)
        u = points.weight
        forward = points.of_piece(self.from_base) + points.of_piece(self.from_ratio) * S
        backward = points.of_piece(self.to_base) + points.of_piece(self.to_ratio) * S
        return (1 - u) * forward + u * backward


class EventIntegral(Level):
    """EDI alone: the latest deblurred frame plus the events since, thresholds nominal."""

    params: FrameParams
    base: Float[Array, "pieces pixels"]

    def __init__(self, params: FrameParams, frames: FrameFeatures):
        left, right = deblurred(params, frames)
        first = right[0] - brightness(params, frames.before[0], frames.before[1])
        if frames.head is not None:  # an exposure and the gap after it are two pieces
            left = jnp.repeat(left, 2, axis=0)
        self.params, self.base = params, jnp.concatenate([first[None], left])

    def __call__(self, points: Points) -> Float[Array, "*points"]:
        return points.of_piece(self.base) + brightness(self.params, points.on, points.off)


class Held(Level):
    """The last frame whose mid-exposure has passed (zero-order hold); before, the first one."""

    level: Float[Array, "frames pixels"]

    def __init__(self, params: FrameParams, frames: FrameFeatures):
        self.level = jnp.log(intensity(params, frames) + params.I0)

    def __call__(self, points: Points) -> Float[Array, "*points"]:
        return points.of_frame(self.level)


class Blended(Level):
    """Intensity linear in time between two frames."""

    I0: Float[Array, ""]
    image: "BetweenFrames"

    def __init__(self, params: FrameParams, frames: FrameFeatures):
        self.I0 = params.I0
        self.image = BetweenFrames(params, frames, intensity(params, frames))

    def __call__(self, points: Points) -> Float[Array, "*points"]:
        return jnp.log(self.image(points) + self.I0)


class Nothing(Level):
    """No frames at all: log intensity 0."""

    def __init__(self, params: FrameParams, frames: FrameFeatures):
        pass

    def __call__(self, points: Points) -> Float[Array, "*points"]:
        return jnp.zeros(points.on.shape, points.weight.dtype)


class BetweenFrames(eqx.Module):
    """A quantity known at mid-exposures: linear in time between them, constant outside."""

    here: Float[Array, "frames pixels"]
    there: Float[Array, "frames pixels"]

    def __init__(
        self, params: FrameParams, frames: FrameFeatures, table: Float[Array, "frames pixels"]
    ):
        lag = late(params, frames) * frames.level_rate[:, None]
        self.here, self.there = _lagging(lag, table, jnp.roll(table, -1, axis=0))

    def __call__(self, points: Points) -> Float[Array, "*points"]:
        v = points.blend
        return (1 - v) * points.of_frame(self.here) + v * points.of_frame(self.there)
