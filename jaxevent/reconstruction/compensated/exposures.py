"""Constraints of frames on a fused image: exposures that blur, and clipped pixels.

A frame integrates over its exposure. Meanwhile the points of the target's image L move on: at the
pixel to which the point x has gone by mid-exposure, the frame has seen

    B(x) = ln mean_j exp L(x - D_j(x)),   D_j(x) = u(x, s + h_j) - u(x, s),

the mean over the exposure, as the event double integral has it per pixel. A clipped pixel of a
frame shows only that B lies beyond the clip. Both correct the image that was fused, with its
variance P as prior, by preconditioned gradient steps of

    (L' - L)^2 / P + sum over frames of rho((b - B(L'))^2 / R),   b: what the frame read.
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from numpy.typing import NDArray

from jaxevent.codegen import njit_noalloc, run_over_rows
from jaxevent.reconstruction.augment import (
    clipped_side,
    clipping_bound,
    expected_excess,
    unclipped_weight,
)
from jaxevent.reconstruction.compensated.fusion import FusedImage
from jaxevent.reconstruction.compensated.instants import TargetInstants
from jaxevent.reconstruction.compensated.params import Params
from jaxevent.reconstruction.compensated.robust_mean import (
    RESIDUAL_SIGMA_PX,
    blur_jax,
    squared_gradient,
)
from jaxevent.reconstruction.compensated.warp import (
    PathTimes,
    bilinear_cell,
    is_in_image,
    path_displacements,
    path_positions,
    sample_bilinear,
)
from jaxevent.reconstruction.features import Numeric
from jaxevent.reconstruction.frames import EventTiming, FrameClock, FrameImages
from jaxevent.reconstruction.smoother import Gaussian, Message, one_sided_message
from jaxevent.recording import Recording

N_CONSTRAINT_STEPS = 4
MIN_BLUR_PX = 0.5  # motion within an exposure, below which the frame counts as sharp
MAX_DISAGREEMENT_PX = 0.5  # by which points that met within an exposure may move differently
MAX_SAMPLE_SPACING_PX = 2.0  # motion from one sample of an exposure to the next
SAMPLE_COUNTS = (3, 7, 15, 31)  # of an exposure; few numbers, so that few programs are compiled
SPEED_MARGIN = 2.0  # times the measured speed, for which exposures are sampled


class AdjacentExposures(NamedTuple):
    """Exposures of the n frames next to a target: before, and after or at its time.

    Attributes:
        frame: Index of the frame in the recording.
        s: Mid-exposure relative to the target, as `InstantLayout.s`.
        half: Half of the exposure, on the same clock.
        present: 1, or 0 where there is no frame.
        common: Common displacement of all points along x and y, px.
        drift: Change of the common displacement over `half`, px.
    """

    frame: Int[Numeric, " n"]
    s: Float[Numeric, " n"]
    half: Float[Numeric, " n"]
    present: Float[Numeric, " n"]
    common: Float[Numeric, "n 2"]
    drift: Float[Numeric, "n 2"]

    @property
    def path_times(self) -> PathTimes:
        """Mid-exposures on the clock of paths."""
        return PathTimes(self.s, self.common)


class AdjacentFrames(NamedTuple):
    """Images of the n frames next to a target as the camera gave them.

    Attributes:
        grey: Grey values, see `features.FrameFeatures`.
        intensity: Intensity.
        response: Camera response by grey value.
        gain: Brightness of each frame relative to one in which intensity 1 is white.
        white: Ends of the grey values beyond which pixels are clipped; None: not known.
    """

    grey: Float[Numeric, "n pixels"]
    intensity: Float[Numeric, "n pixels"]
    response: Float[Numeric, " 256"]
    gain: Float[Numeric, " n"]
    white: Float[Numeric, " 2"] | None = None


class _FrameEvidence(NamedTuple):
    """Evidence of frames on the target's points, each (n, h, w)."""

    level: Float[Array, "n h w"]  # ln(I + I0)
    V: Float[Array, "n h w"]  # its variance
    weight: Float[Array, "n h w"]  # 1 where it is used: unclipped and blurred
    clipped: Message  # of clipped pixels on B


class _ClippedSide(NamedTuple):
    """Clipped pixels as `smoother.one_sided_message` reads them.

    Attributes:
        side: +1, -1: B lies above, below `bound`; 0: nothing is known.
        bound: Bound of the log intensity.
        excess: Expected log intensity beyond the bound; None: not known.
    """

    side: Float[Array, "n h w"]
    bound: Float[Array, "n h w"]
    excess: Float[Array, "n #h #w"] | None


def choose_sample_count(motion_px: float) -> int:
    """Choose the number of samples of an exposure in which points move that far (px)."""
    if motion_px < MIN_BLUR_PX:
        return 1
    return next(
        (n for n in SAMPLE_COUNTS if n * MAX_SAMPLE_SPACING_PX >= motion_px), SAMPLE_COUNTS[-1]
    )


class FrameExposures:
    """The exposures of a recording's frames.

    Args:
        recording: The recording.
        params: Parameters of `mc`.
        speed: Speed of the moving points, px/s.

    Attributes:
        mid: (frames,) the first whole microsecond after mid-exposure.
        samples: Samples of each exposure; None where images need no constraints.
    """

    def __init__(self, recording: Recording, params: Params, speed: float):
        clock = FrameClock.of(recording, EventTiming.of(params))
        self.mid = np.ceil(clock.mid).astype(np.int64) + clock.origin
        self._half = np.rint((clock.right - clock.left) / 2).astype(np.int64)  # us
        moved = SPEED_MARGIN * speed * 2e-6 * float(self._half.max(initial=0))
        samples = choose_sample_count(moved) if params.deblur else 1
        images = FrameImages(recording, np.dtype(np.float32))
        clips = float(params.margin) > 0 or images.white is not None
        wanted = samples > 1 or (clips and params.one_sided)
        self.samples = samples if params.integrate and wanted else None

    def __call__(self, t: int, instants: TargetInstants) -> AdjacentExposures:
        """Choose the exposures next to a target: before, and after or at its time.

        Args:
            t: Time of the target, us.
            instants: Its instants, which define the clock.

        Returns:
            Two exposures.
        """
        after = int(np.searchsorted(self.mid, t, "right"))
        here = int(np.searchsorted(self.mid, t, "left"))
        frame, present = np.array([here - 1, after]), np.array([here > 0, after < len(self.mid)])
        if here < after:  # the farther one gives way to that at this time
            far = np.where(present, np.abs(self.mid[frame.clip(0, len(self.mid) - 1)] - t), 1 << 62)
            frame[far.argmax()], present[far.argmax()] = here, True
        frame = frame.clip(0, max(len(self.mid) - 1, 0)).astype(np.int32)
        mid, half = self.mid[frame], self._half[frame]
        at, begin, end = (instants.path_times_at(t) for t in (mid, mid - half, mid + half))
        return AdjacentExposures(
            frame,
            np.where(present, at.s, np.float32(0)),
            (end.s - begin.s) / 2,
            present.astype(np.float32),
            at.common * present[:, None],
            (end.common - begin.common) / 2,
        )


def blur_by_motion_jax(L: Array, D: Array) -> tuple[Array, Array]:
    """Average an image over exposures; differentiable.

    Args:
        L: (h, w) log intensity.
        D: (n, j, h, w, 2) displacements along x and y at the samples of each exposure, px.

    Returns:
        B (n, h, w), and the shares (n, j, h, w) of the samples in it.
    """
    h, w = L.shape
    n, j = D.shape[:2]
    y, x = jnp.arange(h)[:, None], jnp.arange(w)
    Y, X = (y - D[..., 1]).reshape(-1, h, w), (x - D[..., 0]).reshape(-1, h, w)
    moved = sample_bilinear(jnp.broadcast_to(L, (n * j, h, w)), Y, X).reshape(n, j, h, w)
    return jax.scipy.special.logsumexp(moved, axis=1) - np.log(j), jax.nn.softmax(moved, axis=1)


def blur_by_motion_adjoint_jax(error: Array, shares: Array, D: Array) -> Array:
    """Bring errors of B back to the points of L that it averaged.

    Args:
        error: (n, h, w) errors of B.
        shares: (n, j, h, w) shares of the samples, of `blur_by_motion_jax`.
        D: (n, j, h, w, 2) displacements at the samples, px.

    Returns:
        (h, w).
    """
    n, j, h, w = shares.shape
    y, x = jnp.arange(h)[:, None], jnp.arange(w)
    Y, X = (y + D[..., 1]).reshape(-1, h, w), (x + D[..., 0]).reshape(-1, h, w)
    parts = (error[:, None] * shares).reshape(-1, h, w)
    return sample_bilinear(parts, Y, X).sum(0)


@njit_noalloc
def _smear(begin, end, L, D, B, shares):
    """Write the averages of an image over exposures, for some rows.

    Args:
        begin: First row.
        end: Row after the last one.
        L: (h, w) log intensity.
        D: (n, j, h, w, 2) displacements along x and y at the samples of each exposure, px.
        B: (n, h, w) output, log intensity.
        shares: (n, j, h, w) output, shares of the samples in it.
    """
    n, count, h, w, _ = D.shape
    one = np.float32(1)
    for k in range(n):
        for y in range(begin, end):
            for x in range(w):
                total = np.float32(0)
                for j in range(count):
                    X, Y = np.float32(x) - D[k, j, y, x, 0], np.float32(y) - D[k, j, y, x, 1]
                    x0, y0, x1, y1, fx, fy = bilinear_cell(X, Y, h, w)
                    top = (one - fx) * L[y0, x0] + fx * L[y0, x1]
                    bottom = (one - fx) * L[y1, x0] + fx * L[y1, x1]
                    shares[k, j, y, x] = np.exp((one - fy) * top + fy * bottom)
                    total += shares[k, j, y, x]
                for j in range(count):
                    shares[k, j, y, x] /= total
                B[k, y, x] = np.log(total / np.float32(count))


@njit_noalloc
def _smear_adjoint(begin, end, error, shares, D, out):
    """Write the errors of B, brought back to the points of L, for some rows.

    Args:
        begin: First row.
        end: Row after the last one.
        error: (n, h, w) errors of B.
        shares: (n, j, h, w) shares of the samples.
        D: (n, j, h, w, 2) displacements at the samples, px.
        out: (h, w) output.
    """
    n, count, h, w, _ = D.shape
    one = np.float32(1)
    for y in range(begin, end):
        for x in range(w):
            total = np.float32(0)
            for k in range(n):
                for j in range(count):
                    X, Y = np.float32(x) + D[k, j, y, x, 0], np.float32(y) + D[k, j, y, x, 1]
                    x0, y0, x1, y1, fx, fy = bilinear_cell(X, Y, h, w)
                    part, e = shares[k, j], error[k]
                    a, b = e[y0, x0] * part[y0, x0], e[y0, x1] * part[y0, x1]
                    c, d = e[y1, x0] * part[y1, x0], e[y1, x1] * part[y1, x1]
                    total += (one - fy) * ((one - fx) * a + fx * b) + fy * ((one - fx) * c + fx * d)
            out[y, x] = total


def blur_by_motion(L: NDArray, D: NDArray) -> tuple[NDArray, NDArray]:
    """Average an image over exposures, as `blur_by_motion_jax` does.

    Args:
        L: (h, w) log intensity, float32.
        D: (n, j, h, w, 2) displacements along x and y at the samples of each exposure, px.

    Returns:
        B (n, h, w), and the shares (n, j, h, w) of the samples in it.
    """
    B, shares = np.empty((len(D), *L.shape), np.float32), np.empty(D.shape[:-1], np.float32)
    run_over_rows(_smear, len(L), L, D, B, shares)
    return B, shares


def blur_by_motion_adjoint(error: NDArray, shares: NDArray, D: NDArray) -> NDArray:
    """Bring errors of B back to the points of L, as `blur_by_motion_adjoint_jax` does.

    Args:
        error: (n, h, w) errors of B.
        shares: (n, j, h, w) shares of the samples, of `blur_by_motion`.
        D: (n, j, h, w, 2) displacements along x and y at the samples, px.

    Returns:
        (h, w).
    """
    out = np.empty(error.shape[1:], np.float32)
    run_over_rows(_smear_adjoint, len(out), error, shares, D, out)
    return out


def exposure_displacements(exposures: AdjacentExposures, paths: Array, samples: int) -> Array:
    """Return the displacements of points from mid-exposure to the samples of each exposure.

    Args:
        exposures: The n exposures.
        paths: (h, w, 4) paths of the points, px.
        samples: Samples of each exposure.

    Returns:
        D, (n, samples, h, w, 2), along x and y, px.
    """
    s, half, common, drift = (
        jnp.asarray(part)[:, None]
        for part in (exposures.s, exposures.half, exposures.common, exposures.drift)
    )
    part = (jnp.arange(samples) + 0.5) / samples * 2 - 1
    at = s + half * part
    moved = common + drift * part[:, None]
    whole = path_displacements(paths, PathTimes(at.reshape(-1), moved.reshape(-1, 2)))
    whole = whole.reshape(*at.shape, *paths.shape[:2], 2)
    return whole - path_displacements(paths, exposures.path_times)[:, None]


def _motion_disagreement(D: Array) -> Array:
    """Return the difference (px) in motion of points that met within an exposure, (n, h, w).

    At the edges of moving things the mean along one path is not what the frame has seen.
    """
    n, _, h, w, _ = D.shape
    y, x = jnp.arange(h)[:, None], jnp.arange(w)
    found = jnp.zeros((n, h, w))
    for j in (0, -1):
        own = D[:, j]
        Y, X = y - own[..., 1], x - own[..., 0]
        there = jnp.stack([sample_bilinear(own[..., c], Y, X) for c in (0, 1)], -1)
        found = jnp.maximum(found, jnp.sqrt(((there - own) ** 2).sum(-1) + 1e-12))
    return found


class ExposureModel(NamedTuple):
    """The frames next to a target, and the paths of its points."""

    exposures: AdjacentExposures
    frames: AdjacentFrames
    paths: Float[Numeric, "h w 4"]  # px


def clipped_part(params: Params, model: ExposureModel) -> Array | None:
    """Return 1 (h, w) for points that all frames next to the target show at white, 0 for others.

    Args:
        params: Parameters of `mc`.
        model: The frames, and the paths of the image's points.

    Returns:
        (h, w), 0 to 1; None where frames do not clip.
    """
    exposures, frames, paths = model
    if frames.white is None or not params.one_sided:
        return None
    Y, X = path_positions(paths, exposures.path_times)
    side = jnp.maximum(clipped_side(params, frames), 0).reshape(-1, *Y.shape[1:])
    absent = 1 - jnp.asarray(exposures.present)[:, None, None]
    return jnp.maximum(sample_bilinear(side, Y, X), absent).min(0)


def clipped_variance(params: Params, fused: FusedImage, model: ExposureModel) -> Array:
    """Return the variance of an image, at white no less than that by events alone.

    A point that all frames next to the target show clipped is known by events, to within a
    threshold, and by frames that showed it darker, if they did: no evidence that it is as dark.

    Args:
        params: Parameters of `mc`.
        fused: The image.
        model: The frames, and the paths of the image's points.

    Returns:
        (h, w), (ln I)^2.
    """
    clipped = clipped_part(params, model)
    if clipped is None:
        return fused.P
    return jnp.maximum(fused.P, clipped * params.c_on * params.c_off / 12)


def _frame_evidence(
    params: Params, model: ExposureModel, D: Array, B: Array, fused: FusedImage
) -> _FrameEvidence:
    """Read the evidence of frames at the target's points.

    Args:
        params: Parameters of `mc`.
        model: The n frames, and the paths of the image's points.
        D: (n, j, h, w, 2) displacements at the samples of each exposure, px.
        B: (n, h, w) log intensity that the frames would show of the image.
        fused: The image.

    Returns:
        The evidence, in which weights are 0 where a frame is sharp or does not see the point.
    """
    exposures, frames, paths = model
    _, h, w = B.shape
    Y, X = path_positions(paths, exposures.path_times)
    light = jnp.asarray(frames.intensity) + params.I0
    at_target = jnp.asarray(exposures.s)[:, None, None] == 0
    inside = is_in_image(Y, X, h, w) * jnp.asarray(exposures.present)[:, None, None]
    inside = inside * jnp.where(at_target, 1, fused.visible)
    moved = jnp.sqrt(((D[:, -1] - D[:, 0]) ** 2).sum(-1) + 1e-12)
    blurred = jnp.clip((moved - MIN_BLUR_PX) / MIN_BLUR_PX, 0, 1)
    blurred = blurred / (1 + (_motion_disagreement(D) / MAX_DISAGREEMENT_PX) ** 2)

    def read(values: Array) -> Array:
        return sample_bilinear(values.reshape(-1, h, w), Y, X)

    # A clipped pixel acts as the Gaussian that gives the moments of the truncated one.
    side = read(clipped_side(params, frames)) * inside * params.one_sided
    clipped = clipped_part(params, model)
    if clipped is not None:  # at an edge one of them may show another point
        side = jnp.where(side > 0, side * clipped, side)
    excess = expected_excess(params, frames)
    excess = None if excess is None else excess[:, :, None]
    row = _ClippedSide(side, read(clipping_bound(params, frames)), excess)
    state = Gaussian(B, jnp.broadcast_to(fused.P, B.shape))
    message, _ = one_sided_message(state, row, params.sigma_floor**2)
    return _FrameEvidence(
        read(jnp.log(light)),
        (params.sigma_pixel * read(1 / light)) ** 2 + 1e-4,
        read(unclipped_weight(params, frames)) * inside * blurred,
        jax.tree.map(lambda part: jnp.where(side == 0, 0, part), message),
    )


def _pull_and_information(
    params: Params, evidence: _FrameEvidence, B: Array
) -> tuple[Array, Array]:
    """Weigh the errors of blurred images against frames.

    Args:
        params: Parameters of `mc`.
        evidence: Evidence of n frames.
        B: (n, h, w) log intensity that the frames would show of the image.

    Returns:
        Information times error of B, (n, h, w), 1 / ln I, and the information, summed over frames,
        (h, w), 1 / (ln I)^2.
    """
    steepness = jax.vmap(squared_gradient)(B)
    V = evidence.V + params.sigma_place**2 * steepness + params.sigma_between**2
    square = (evidence.level - B) ** 2 / V
    hidden = (blur_jax(square, RESIDUAL_SIGMA_PX) / params.tolerance) ** 2
    W = evidence.weight / V / (1 + hidden) / (1 + square / params.robust)
    clipped = evidence.clipped
    pull = W * (evidence.level - B) + clipped.h - clipped.J * B
    return pull, (W + clipped.J).sum(0)


def _squared_blur(evidence: _FrameEvidence, image: Array, B: Array) -> Array:
    """Measure how much the blur of exposures changes an image.

    Args:
        evidence: Evidence of n frames.
        image: (h, w) log intensity.
        B: (n, h, w) the same, averaged over the exposures.

    Returns:
        (h, w) squared change, a weighted mean over frames, blurred, (ln I)^2.
    """
    total = (evidence.weight * (B - image) ** 2).sum(0)
    return blur_jax(total / jnp.maximum(evidence.weight.sum(0), 1), RESIDUAL_SIGMA_PX)


def constrain_image_jax(
    params: Params, fused: FusedImage, model: ExposureModel, samples: int
) -> FusedImage:
    """Fit an image to exposures and clipped pixels; differentiable.

    Args:
        params: Parameters of `mc`.
        fused: The image.
        model: The frames, and the paths of the image's points.
        samples: Samples of each exposure.

    Returns:
        The image with other `L` and `P`.
    """
    D = exposure_displacements(model.exposures, model.paths, samples)
    fused = dataclasses.replace(fused, P=clipped_variance(params, fused, model))
    L, P = fused.L.astype(D.dtype), fused.P.astype(D.dtype)
    evidence = _frame_evidence(params, model, D, blur_by_motion_jax(L, D)[0], fused)

    def step(image: Array, _: None) -> tuple[Array, None]:
        B, shares = blur_by_motion_jax(image, D)
        pull, information = _pull_and_information(params, evidence, B)
        pull = (L - image) / P + blur_by_motion_adjoint_jax(pull, shares, D)
        return image + pull / (1 / P + information), None

    image, _ = jax.lax.scan(step, L, None, length=N_CONSTRAINT_STEPS)
    P = P + params.smear * _squared_blur(evidence, image, blur_by_motion_jax(image, D)[0])
    return dataclasses.replace(fused, L=image, P=P)


def _to_float32(values: Any) -> NDArray[np.float32]:
    return np.asarray(values, np.float32)


_compiled_displacements = jax.jit(exposure_displacements, static_argnums=2)
_compiled_evidence, _compiled_pull = jax.jit(_frame_evidence), jax.jit(_pull_and_information)
_compiled_squared_blur = jax.jit(_squared_blur)
_compiled_variance = jax.jit(clipped_variance)


def constrain_image(
    params: Params, fused: FusedImage, model: ExposureModel, samples: int
) -> FusedImage:
    """Fit an image to exposures and clipped pixels, as `constrain_image_jax` does.

    Args:
        params: Parameters of `mc`.
        fused: The image.
        model: The frames, and the paths of the image's points.
        samples: Samples of each exposure.

    Returns:
        The image with other `L` and `P`.
    """
    fused = dataclasses.replace(fused, P=_compiled_variance(params, fused, model))
    L, P = _to_float32(fused.L), _to_float32(fused.P)
    D = _to_float32(_compiled_displacements(model.exposures, model.paths, samples))
    B, _ = blur_by_motion(L, D)
    evidence, image = _compiled_evidence(params, model, D, B, fused), L
    for _ in range(N_CONSTRAINT_STEPS):
        B, shares = blur_by_motion(image, D)
        pull, information = map(_to_float32, _compiled_pull(params, evidence, B))
        back = blur_by_motion_adjoint(pull, shares, D)
        image = image + ((L - image) / P + back) / (1 / P + information)
    B, _ = blur_by_motion(image, D)
    P = P + _to_float32(params.smear) * _to_float32(_compiled_squared_blur(evidence, image, B))
    return dataclasses.replace(fused, L=jnp.asarray(image), P=jnp.asarray(P))
