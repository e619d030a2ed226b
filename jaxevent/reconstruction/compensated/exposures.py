"""What frames say of an image besides sharp, unclipped values: blurred averages and clipped pixels.

A frame integrates over its exposure. While it does, the points of the target's image L move on: at
the pixel to which the point x has gone by mid-exposure, the frame has seen

    B(x) = ln mean_j exp L(x - D_j(x)),   D_j(x) = u(x, s + h_j) - u(x, s),

the mean over the exposure, as the event double integral has it per pixel. Where a pixel of a frame
is clipped it says only that B lies beyond the clip. Both correct the image that was fused, with its
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
from jaxevent.reconstruction.augment import clipped_side, clipping_bound, unclipped_weight
from jaxevent.reconstruction.compensated.agreement import MISFIT, blur, steepness
from jaxevent.reconstruction.compensated.fusion import Fused
from jaxevent.reconstruction.compensated.parameters import Params
from jaxevent.reconstruction.compensated.trajectories import around
from jaxevent.reconstruction.compensated.warping import displaced, places, sample, within
from jaxevent.reconstruction.features import Numeric
from jaxevent.reconstruction.smoother import Gaussian, Message, one_sided_message

STEPS = 4
BLURRED = 0.5  # px that a point moves within an exposure, below which the frame counts as sharp
DISCORD = 0.5  # px, by which points that met within an exposure may move in other ways
PER_SAMPLE = 2.0  # px of that motion, at most, from one sample of an exposure to the next
SAMPLES = (3, 7, 15, 31)  # of an exposure; few numbers, so that few programs are compiled


class Taken(NamedTuple):
    """When the frames next to a target were taken: those before and after, or at its time."""

    frame: Int[Numeric, " n"]  # of the recording
    s: Float[Numeric, " n"]  # mid-exposures, relative to the target as `Place.s`
    half: Float[Numeric, " n"]  # half of the exposures, on the same clock
    present: Float[Numeric, " n"]  # 1, or 0 where there is none


class Shots(NamedTuple):
    """These frames as the camera gave them, as `features.FrameFeatures` has them."""

    grey: Float[Numeric, "n pixels"]
    intensity: Float[Numeric, "n pixels"]
    response: Float[Numeric, " 256"]
    gain: Float[Numeric, " n"]


class _Seen(NamedTuple):
    """What shots tell of the target's points, each (n, h, w)."""

    level: Float[Array, "n h w"]  # ln(I + I0)
    V: Float[Array, "n h w"]  # its variance
    clear: Float[Array, "n h w"]  # 1 where it is believed: unclipped and blurred
    clipped: Message  # what clipped pixels tell of B


class _Side(NamedTuple):
    """Clipped pixels as `smoother.one_sided_message` reads them."""

    side: Float[Array, "n h w"]  # +1, -1: B lies above, below `bound`; 0: nothing known
    bound: Float[Array, "n h w"]


def samples_for(moved: float) -> int:
    """How many samples of an exposure are needed in which points move that far (px)."""
    if moved < BLURRED:
        return 1
    return next((n for n in SAMPLES if n * PER_SAMPLE >= moved), SAMPLES[-1])


def smeared(L: Array, D: Array) -> tuple[Array, Array]:
    """B (n, h, w), and the shares (n, j, h, w) of the samples in it.

    L is (h, w), D are displacements (n, j, h, w, 2) of x and y.
    """
    h, w = L.shape
    n, j = D.shape[:2]
    y, x = jnp.arange(h)[:, None], jnp.arange(w)
    Y, X = (y - D[..., 1]).reshape(-1, h, w), (x - D[..., 0]).reshape(-1, h, w)
    moved = sample(jnp.broadcast_to(L, (n * j, h, w)), Y, X).reshape(n, j, h, w)
    return jax.scipy.special.logsumexp(moved, axis=1) - np.log(j), jax.nn.softmax(moved, axis=1)


def returned(error: Array, shares: Array, D: Array) -> Array:
    """Errors (n, h, w) of B, brought back to the points of L that it averaged: (h, w)."""
    n, j, h, w = shares.shape
    y, x = jnp.arange(h)[:, None], jnp.arange(w)
    Y, X = (y + D[..., 1]).reshape(-1, h, w), (x + D[..., 0]).reshape(-1, h, w)
    parts = (error[:, None] * shares).reshape(-1, h, w)
    return sample(parts, Y, X).sum(0)


@njit_noalloc
def _smear(begin, end, L, D, B, shares):
    n, count, h, w, _ = D.shape
    one = np.float32(1)
    for k in range(n):
        for y in range(begin, end):
            for x in range(w):
                total = np.float32(0)
                for j in range(count):
                    X, Y = np.float32(x) - D[k, j, y, x, 0], np.float32(y) - D[k, j, y, x, 1]
                    _, x0, y0, x1, y1, fx, fy = around(X, Y, h, w)
                    top = (one - fx) * L[y0, x0] + fx * L[y0, x1]
                    bottom = (one - fx) * L[y1, x0] + fx * L[y1, x1]
                    shares[k, j, y, x] = np.exp((one - fy) * top + fy * bottom)
                    total += shares[k, j, y, x]
                for j in range(count):
                    shares[k, j, y, x] /= total
                B[k, y, x] = np.log(total / np.float32(count))


@njit_noalloc
def _return(begin, end, error, shares, D, out):
    n, count, h, w, _ = D.shape
    one = np.float32(1)
    for y in range(begin, end):
        for x in range(w):
            total = np.float32(0)
            for k in range(n):
                for j in range(count):
                    X, Y = np.float32(x) + D[k, j, y, x, 0], np.float32(y) + D[k, j, y, x, 1]
                    _, x0, y0, x1, y1, fx, fy = around(X, Y, h, w)
                    a, b = (
                        error[k, y0, x0] * shares[k, j, y0, x0],
                        error[k, y0, x1] * shares[k, j, y0, x1],
                    )
                    c, d = (
                        error[k, y1, x0] * shares[k, j, y1, x0],
                        error[k, y1, x1] * shares[k, j, y1, x1],
                    )
                    total += (one - fy) * ((one - fx) * a + fx * b) + fy * ((one - fx) * c + fx * d)
            out[y, x] = total


def _quickly_smeared(L: NDArray, D: NDArray) -> tuple[NDArray, NDArray]:
    """`smeared`, in loops."""
    B, shares = np.empty((len(D), *L.shape), np.float32), np.empty(D.shape[:-1], np.float32)
    run_over_rows(_smear, len(L), L, D, B, shares)
    return B, shares


def _quickly_returned(error: NDArray, shares: NDArray, D: NDArray) -> NDArray:
    """`returned`, in loops."""
    out = np.empty(error.shape[1:], np.float32)
    run_over_rows(_return, len(out), error, shares, D, out)
    return out


def _shifts(taken: Taken, paths: Array, samples: int) -> Array:
    """D (n, samples, h, w, 2)."""
    s, half = jnp.asarray(taken.s), jnp.asarray(taken.half)
    at = s[:, None] + half[:, None] * ((jnp.arange(samples) + 0.5) / samples * 2 - 1)
    whole = displaced(paths, at.reshape(-1)).reshape(*at.shape, *paths.shape[:2], 2)
    return whole - displaced(paths, s)[:, None]


def _discord(D: Array) -> Array:
    """By how much (px) points that met at x within an exposure move in other ways, (n, h, w).

    At the edges of moving things the mean along one path is not what the frame has seen.
    """
    n, _, h, w, _ = D.shape
    y, x = jnp.arange(h)[:, None], jnp.arange(w)
    found = jnp.zeros((n, h, w))
    for j in (0, -1):
        own = D[:, j]
        Y, X = y - own[..., 1], x - own[..., 0]
        there = jnp.stack([sample(own[..., c], Y, X) for c in (0, 1)], -1)
        found = jnp.maximum(found, jnp.sqrt(((there - own) ** 2).sum(-1) + 1e-12))
    return found


def _look(
    params: Params, taken: Taken, shots: Shots, paths: Array, D: Array, B: Array, fused: Fused
) -> _Seen:
    """What shots tell; B is what they would show of the image."""
    _, h, w = B.shape
    Y, X = places(paths, jnp.asarray(taken.s))
    light = jnp.asarray(shots.intensity) + params.I0
    own = jnp.asarray(taken.s)[:, None, None] == 0
    inside = within(Y, X, h, w) * jnp.asarray(taken.present)[:, None, None]
    inside = inside * jnp.where(own, 1, fused.visible)
    moved = jnp.sqrt(((D[:, -1] - D[:, 0]) ** 2).sum(-1) + 1e-12)
    blurred = jnp.clip((moved - BLURRED) / BLURRED, 0, 1)
    blurred = blurred / (1 + (_discord(D) / DISCORD) ** 2)

    def read(values: Array) -> Array:
        return sample(values.reshape(-1, h, w), Y, X)

    # A clipped pixel acts as the Gaussian that gives the moments of the truncated one.
    side = read(clipped_side(params, shots)) * inside * params.one_sided
    row = _Side(side, read(clipping_bound(params, shots)))
    state = Gaussian(B, jnp.broadcast_to(fused.P, B.shape))
    said, _ = one_sided_message(state, row, params.sigma_floor**2)
    return _Seen(
        read(jnp.log(light)),
        (params.sigma_pixel * read(1 / light)) ** 2 + 1e-4,
        read(unclipped_weight(params, shots)) * inside * blurred,
        jax.tree.map(lambda part: jnp.where(side == 0, 0, part), said),
    )


def _weigh(params: Params, seen: _Seen, B: Array) -> tuple[Array, Array]:
    """What shots say of B: the pull, which is information times error, and the information."""
    slope = jax.vmap(steepness)(B)
    V = seen.V + params.sigma_place**2 * slope + params.sigma_between**2
    square = (seen.level - B) ** 2 / V
    hidden = (blur(square, MISFIT) / params.tolerance) ** 2
    W = seen.clear / V / (1 + hidden) / (1 + square / params.robust)
    pull = W * (seen.level - B) + seen.clipped.h - seen.clipped.J * B
    return pull, (W + seen.clipped.J).sum(0)


def _lost(seen: _Seen, image: Array, B: Array) -> Array:
    """What exposures smear, squared."""
    lost = (seen.clear * (B - image) ** 2).sum(0) / jnp.maximum(seen.clear.sum(0), 1)
    return blur(lost, MISFIT)


def constrain_purely(
    params: Params, fused: Fused, paths: Array, taken: Taken, shots: Shots, samples: int
) -> Fused:
    """An image held to what frames integrated and to clipped pixels; differentiable.

    Args:
        params: Its `smear` says which part of what an exposure smears is in doubt.
        fused: The image.
        paths: Of all pixels, (h, w, 4).
        taken: When the frames were taken.
        shots: The frames.
        samples: Of each exposure.
    """
    D = _shifts(taken, paths, samples)
    L, P = fused.L.astype(D.dtype), fused.P.astype(D.dtype)
    seen = _look(params, taken, shots, paths, D, smeared(L, D)[0], fused)

    def step(image: Array, _: None) -> tuple[Array, None]:
        B, shares = smeared(image, D)
        pull, information = _weigh(params, seen, B)
        pull = (L - image) / P + returned(pull, shares, D)
        return image + pull / (1 / P + information), None

    image, _ = jax.lax.scan(step, L, None, length=STEPS)
    P = P + params.smear * _lost(seen, image, smeared(image, D)[0])
    return dataclasses.replace(fused, L=image, P=P)


def _single(values: Any) -> NDArray[np.float32]:
    return np.asarray(values, np.float32)


_shifts_now = jax.jit(_shifts, static_argnums=2)
_look_now, _weigh_now, _lost_now = jax.jit(_look), jax.jit(_weigh), jax.jit(_lost)


def constrain(
    params: Params, fused: Fused, paths: Any, taken: Taken, shots: Shots, samples: int
) -> Fused:
    """The same as `constrain_purely`, in loops."""
    L, P = _single(fused.L), _single(fused.P)
    D = _single(_shifts_now(taken, paths, samples))
    B, _ = _quickly_smeared(L, D)
    seen, image = _look_now(params, taken, shots, paths, D, B, fused), L
    for _ in range(STEPS):
        B, shares = _quickly_smeared(image, D)
        pull, information = map(_single, _weigh_now(params, seen, B))
        back = _quickly_returned(pull, shares, D)
        image = image + ((L - image) / P + back) / (1 / P + information)
    B, _ = _quickly_smeared(image, D)
    P = P + _single(params.smear) * _single(_lost_now(seen, image, B))
    return dataclasses.replace(fused, L=jnp.asarray(image), P=jnp.asarray(P))
