"""How images agree along trajectories: in loops for images, as a pure function for derivatives."""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import NDArray

from jaxevent.codegen import njit_noalloc, njit_noalloc_inlined, row_scratch, run_over_rows
from jaxevent.reconstruction.compensated.instants import Instants
from jaxevent.reconstruction.compensated.parameters import Params
from jaxevent.reconstruction.compensated.warping import Along
from jaxevent.reconstruction.features import Numeric

PLAIN = 3.0  # the misfit of an instant that scatter hardly counts
OUTSIDE = 1e6  # variance beyond the image's border
MISFIT, SCATTER = 1.5, 2.0  # px, of the Gaussians that gather them


class Place(NamedTuple):
    """Where the instants of a target lie among each other."""

    s: Float[Numeric, " k"]  # times relative to the target, -1..1
    present: Float[Numeric, " k"]  # 1, or 0 of instants that only fill up the number
    framed: Float[Numeric, " k"]  # 1 where a frame was taken
    near: Float[Numeric, " k"]  # 1 of those next to the target, frames aside, and of the target
    own: Numeric  # (), the target's
    before: Numeric  # (), that of the frame before
    after: Numeric
    # The frame that `before` is compared with: `after`, and where frames are on one side alone the
    # next nearest; where there is none, `before`.
    other: Numeric
    rest: Numeric = np.float32(0)  # (), `Instants.rest`


def place_of(instants: Instants, clear: NDArray, room: int) -> Place:
    """A target's instants for `fuse`, filled up to a number of `room`."""
    count = len(instants)
    framed: NDArray = clear.reshape(count, -1).max(1) > 0
    framed[[instants.before, instants.after]] |= instants.before != instants.after
    order = np.argsort(np.abs(instants.t - instants.t[instants.own]), kind="stable")
    near = np.zeros(count, bool)
    near[[k for k in order if k == instants.own or not framed[k]][:5]] = True
    near[instants.own] = True
    other = instants.after
    if instants.before == other:
        other = next((k for k in order if framed[k] and k not in (instants.own, other)), other)
    return Place(
        _filled(instants.s, room, 1),
        _filled(np.ones(count, np.float32), room),
        _filled(framed.astype(np.float32), room),
        _filled(near.astype(np.float32), room),
        *(np.asarray(k, np.int32) for k in (instants.own, instants.before, instants.after, other)),
        rest=np.float32(instants.rest),
    )


def _filled(values: NDArray, room: int, rest: float | int = 0) -> NDArray:
    """Values (K, ...) of instants, filled up to the number `room`."""
    more = np.full((room - len(values), *values.shape[1:]), rest, values.dtype)
    return np.concatenate([values, more]) if len(more) else values


class Agreement(NamedTuple):
    """What all instants together tell of the target's points, each (h, w)."""

    M: Float[Numeric, "h w"]  # their robust mean
    total: Float[Numeric, "h w"]  # its information
    scatter: Float[Numeric, "h w"]  # variance beyond what the instants' own explain
    near: Float[Numeric, "h w"]  # the mean of the near instants
    near_information: Float[Numeric, "h w"]
    frame_information: Float[Numeric, "h w"]
    activity: Float[Numeric, "h w"]  # squared changes in place over `stretch`
    parts: Float[Numeric, "3 h w"]  # shares in M: frames before, frames after, all others
    seen: Float[Numeric, "2 h w"]  # how far the frames before and after see the point, 0..1
    usual: Float[Numeric, "h w"]  # mean variance of the images, as in M, 0 of frames unclipped


def taps_of(sigma: float) -> NDArray[np.float32]:
    """A Gaussian of `sigma` px, of odd length."""
    reach = int(np.ceil(3 * sigma))
    taps = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    return (taps / taps.sum()).astype(np.float32)


def blur(image: Array, sigma: float) -> Array:
    """A Gaussian over the last two axes."""
    taps = taps_of(sigma)
    for axis in (image.ndim - 2, image.ndim - 1):
        size = image.shape[axis]
        padded = _pad(image, axis, len(taps) // 2)
        moved = [jax.lax.slice_in_dim(padded, i, i + size, axis=axis) for i in range(len(taps))]
        image = functools.reduce(
            jnp.add, [float(tap) * one for tap, one in zip(taps, moved, strict=True)]
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


def stretch(place: Place) -> tuple[Numeric, Numeric]:
    """Between which instants activity is gathered: the frames next to the target, both left out.

    Where frames are on one side alone, from there to the target, which takes part.
    """
    a, b, own = place.before, place.after, place.own
    last = place.s[a] <= 0  # no frame follows
    low = jnp.where((a == b) & ~last, own - 1, a)
    return low, jnp.where((a == b) & last, own + 1, b)


def agree_purely(params: Params, L: Float[Array, "k h w"], along: Along, place: Place) -> Agreement:
    """The robust mean along trajectories, begun from the target's own image; differentiable.

    An instant counts by its information, V and what warping adds to it; where it differs from the
    others by more than that the point is hidden there. Excess scatter tells failed motion. L are
    the images as they are.
    """
    p = params
    count = len(place.s)
    s, present, framed = (v[:, None, None] for v in (place.s, place.present, place.framed))
    here = (jnp.arange(count) == place.own)[:, None, None]
    eta = (p.information + (1 - p.information) * along.clear) * present
    base = jnp.where(along.inside > 0, along.V + p.floor, OUTSIDE)
    steep = steepness(blur(L[place.own], 1.0))
    variance, misfit = base, base
    seen = jnp.broadcast_to(jnp.exp(-2 * s**2), base.shape)  # at first the near instants tell
    for turn in range(3):
        variance = base + jnp.where(here, 0, p.sigma_place**2 * steep + p.sigma_between**2)
        R = eta / variance * seen
        M = (R * along.L).sum(0) / R.sum(0)
        steep = steepness(M)
        misfit = blur((along.L - M) ** 2 / variance, MISFIT)
        if turn == 0:
            misfit = jnp.where(here, jnp.minimum(misfit, 1), misfit)
        seen = 1 / (1 + (misfit / p.tolerance) ** 2)
    W = eta / variance
    R = W * seen
    total = R.sum(0)
    M = (R * along.L).sum(0) / total
    # Of all instants but the plainly hidden ones, whatever the tolerance.
    plain = present / variance / (1 + (misfit / PLAIN) ** 2)
    excess = (plain * ((along.L - M) ** 2 - 0.6 * variance)).sum(0)
    scatter = jnp.maximum(blur(excess, SCATTER) / blur((plain * eta).sum(0), SCATTER), 0)
    W = W * along.inside
    near_information = (W * place.near[:, None, None]).sum(0)
    near = (W * place.near[:, None, None] * along.L).sum(0) / jnp.maximum(near_information, 1e-9)
    order = jnp.arange(count)
    low, high = stretch(place)
    between = ((order > low) & (order + 1 < high))[:-1, None, None]
    share = R / total
    parts = [(share * framed * side).sum(0) for side in (s < 0, s > 0)]
    return Agreement(
        M,
        total,
        scatter,
        near,
        near_information,
        (W * framed).sum(0),
        ((L[1:] - L[:-1]) ** 2 * between).sum(0),
        jnp.stack([*parts, (share * (1 - framed * (s != 0))).sum(0)]),
        jnp.stack([seen[k] * along.inside[k] for k in (place.before, place.after)]),
        (R * (1 - along.clear) * along.V).sum(0) / total,
    )


def shown(params: Params, M: Float[Array, "h w"], along: Along) -> Float[Array, "k h w"]:
    """How far images along trajectories show the points of an image M of log intensity, 0..1."""
    p = params
    V = along.V + p.floor + p.sigma_place**2 * steepness(M) + p.sigma_between**2
    misfit = blur((along.L - M) ** 2 / V, MISFIT)
    return along.inside / (1 + (misfit / p.tolerance) ** 2)


class _Settings(NamedTuple):
    """Numbers of `agree` for its loops."""

    information: Any
    floor: Any
    place: Any  # variances of the place of points and between pixels
    between: Any
    tolerance: Any
    low: Any  # the stretch of activity
    high: Any


@njit_noalloc_inlined
def across(row, taps, padded, out):
    """`row` blurred along x; the image's border goes on."""
    w, reach = len(row), len(taps) // 2
    for x in range(reach):
        padded[x] = row[0]
        padded[w + reach + x] = row[w - 1]
    for x in range(w):
        padded[reach + x] = row[x]
        out[x] = np.float32(0)
    for i in range(len(taps)):
        tap = taps[i]
        for x in range(w):
            out[x] += tap * padded[i + x]


@njit_noalloc_inlined
def down(image, y, taps, out):
    """The row y of an image that is blurred along y."""
    h, w = image.shape
    for x in range(w):
        out[x] = np.float32(0)
    for i in range(len(taps)):
        row, tap = image[min(max(y + i - len(taps) // 2, 0), h - 1)], taps[i]
        for x in range(w):
            out[x] += tap * row[x]


@njit_noalloc_inlined
def _steep(image, y, out):
    """|grad|^2 in the row y."""
    h, w = image.shape
    eight, twelfth = np.float32(8), np.float32(1 / 12)
    here, up, down = image[y], image[max(y - 1, 0)], image[min(y + 1, h - 1)]
    up2, down2 = image[max(y - 2, 0)], image[min(y + 2, h - 1)]
    for x in range(w):
        left, right = here[max(x - 1, 0)], here[min(x + 1, w - 1)]
        left2, right2 = here[max(x - 2, 0)], here[min(x + 2, w - 1)]
        gx = (eight * (right - left) - right2 + left2) * twelfth
        gy = (eight * (down[x] - up[x]) - down2[x] + up2[x]) * twelfth
        out[x] = gx * gx + gy * gy


@njit_noalloc_inlined
def _variance(V, inside, steep, settings, here, out):
    for x in range(len(V)):
        added = settings.place * steep[x] + settings.between
        base = V[x] + settings.floor if inside[x] > 0 else np.float32(OUTSIDE)
        out[x] = base if here else base + added


@njit_noalloc_inlined
def _add(L, clear, variance, seen, settings, total, mean):
    one = np.float32(1)
    for x in range(len(L)):
        eta = settings.information + (one - settings.information) * clear[x]
        R = eta / variance[x] * seen[x]
        total[x] += R
        mean[x] += R * L[x]


@njit_noalloc_inlined
def _see(misfit, tolerance, most, seen):
    one = np.float32(1)
    for x in range(len(misfit)):
        ratio = min(misfit[x], most) / tolerance
        seen[x] = one / (one + ratio * ratio)


@njit_noalloc_inlined
def _differ(L, M, variance, out):
    for x in range(len(L)):
        out[x] = (L[x] - M[x]) * (L[x] - M[x]) / variance[x]


@njit_noalloc_inlined
def _copy(a, out):
    for x in range(len(a)):
        out[x] = a[x]


@njit_noalloc_inlined
def _multiply(a, b, out):
    for x in range(len(a)):
        out[x] = a[x] * b[x]


@njit_noalloc_inlined
def _divide(a, b, out):
    for x in range(len(a)):
        out[x] = a[x] / b[x]


@njit_noalloc
def _blur_across(begin, end, image, taps, room, out):
    padded = room[begin]
    for y in range(begin, end):
        across(image[y], taps, padded, out[y])


@njit_noalloc
def _blur_down(begin, end, image, taps, out):
    for y in range(begin, end):
        down(image, y, taps, out[y])


@njit_noalloc
def _find_mean(begin, end, along, near, misfits, M, steep, settings, own, turn, taps, room, out):
    """The mean over instants of some rows; `misfits` are blurred across."""
    count, own_room = along.L.shape[0], room[begin]
    variance, misfit, seen = own_room[0], own_room[1], own_room[2]
    total, mean, slope = own_room[3], own_room[4], own_room[5]
    for y in range(begin, end):
        _steep(M, y, slope)
        _copy(slope, steep[y])
        total[:] = np.float32(0)
        mean[:] = np.float32(0)
        for k in range(count):
            if turn == 0:
                seen[:] = near[k]
            else:
                down(misfits[k], y, taps, misfit)
                most = np.float32(1 if turn == 1 and k == own else np.inf)
                _see(misfit, settings.tolerance, most, seen)
            _variance(along.V[k, y], along.inside[k, y], slope, settings, k == own, variance)
            _add(along.L[k, y], along.clear[k, y], variance, seen, settings, total, mean)
        _divide(mean, total, out[y])


@njit_noalloc
def _find_misfits(begin, end, along, M, steep, settings, own, taps, room, padded, misfits):
    """Squared differences from M in parts of their variances, blurred across."""
    count = len(along.L)
    variance, ratio = room[begin, 0], room[begin, 1]
    for y in range(begin, end):
        for k in range(count):
            here = k == own
            _variance(along.V[k, y], along.inside[k, y], steep[y], settings, here, variance)
            _differ(along.L[k, y], M[y], variance, ratio)
            across(ratio, taps, padded[begin], misfits[k, y])


@njit_noalloc_inlined
def _gather(along, y, k, seen, variance, settings, place, out):
    """Add an instant to what the means are made of."""
    one, zero = np.float32(1), np.float32(0)
    near, framed = place.near[k], place.framed[k]
    before = framed if place.s[k] < 0 else zero
    after = framed if place.s[k] > 0 else zero
    rest = one - before - after
    L, clear, inside = along.L[k, y], along.clear[k, y], along.inside[k, y]
    total, mean, near_total, near_mean = out[0], out[1], out[2], out[3]
    frames, from_before, from_after, from_rest = out[4], out[5], out[6], out[7]
    V, usual = along.V[k, y], out[8]
    for x in range(len(L)):
        eta = settings.information + (one - settings.information) * clear[x]
        W = eta / variance[x]
        R = W * seen[x]
        total[x] += R
        mean[x] += R * L[x]
        W = W * inside[x]
        near_total[x] += W * near
        near_mean[x] += W * near * L[x]
        frames[x] += W * framed
        from_before[x] += R * before
        from_after[x] += R * after
        from_rest[x] += R * rest
        usual[x] += R * (one - clear[x]) * V[x]


@njit_noalloc_inlined
def _exceed(L, clear, M, misfit, variance, settings, excess, weight):
    one, plainly, expected = np.float32(1), np.float32(PLAIN), np.float32(0.6)
    for x in range(len(L)):
        eta = settings.information + (one - settings.information) * clear[x]
        ratio = misfit[x] / plainly
        plain = one / variance[x] / (one + ratio * ratio)
        e = L[x] - M[x]
        excess[x] += plain * (e * e - expected * variance[x])
        weight[x] += plain * eta


@njit_noalloc_inlined
def _change(early, late, out):
    for x in range(len(out)):
        out[x] += (late[x] - early[x]) * (late[x] - early[x])


@njit_noalloc
def _finish(begin, end, L, along, misfits, steep, settings, place, taps, room, out, excess, weight):
    """What is told of some rows; scatter is yet to be gathered."""
    count, _, w = along.L.shape
    seen, sums = room[begin, 0], room[begin, 1:10]
    misfit, variance = room[begin, 10 : 10 + count], room[begin, 10 + count :]
    own, a, b = place.own, place.before, place.after
    for y in range(begin, end):
        sums[:] = np.float32(0)
        excess[y], weight[y], out.activity[y] = np.float32(0), np.float32(0), np.float32(0)
        for k in range(count):
            here = k == own
            down(misfits[k], y, taps, misfit[k])
            _see(misfit[k], settings.tolerance, np.float32(np.inf), seen)
            _variance(along.V[k, y], along.inside[k, y], steep[y], settings, here, variance[k])
            _gather(along, y, k, seen, variance[k], settings, place, sums)
            if k == a:
                _multiply(seen, along.inside[k, y], out.seen[0, y])
            if k == b:
                _multiply(seen, along.inside[k, y], out.seen[1, y])
            if settings.low < k and k + 1 < settings.high:
                _change(L[k, y], L[k + 1, y], out.activity[y])
        _copy(sums[0], out.total[y])
        _divide(sums[1], sums[0], out.M[y])
        _copy(sums[2], out.near_information[y])
        for x in range(w):
            out.near[y, x] = sums[3, x] / max(sums[2, x], np.float32(1e-9))
        _copy(sums[4], out.frame_information[y])
        _divide(sums[8], sums[0], out.usual[y])
        for part_of in range(3):
            _divide(sums[5 + part_of], sums[0], out.parts[part_of, y])
        for k in range(count):
            clear, M = along.clear[k, y], out.M[y]
            _exceed(along.L[k, y], clear, M, misfit[k], variance[k], settings, excess[y], weight[y])


def blurred(image: NDArray[np.float32], sigma: float) -> NDArray[np.float32]:
    """`blur` of an image (h, w), in loops."""
    taps = taps_of(sigma)
    half, out = np.empty_like(image), np.empty_like(image)
    room = row_scratch(len(image), image.shape[1] + len(taps))
    run_over_rows(_blur_across, len(image), image, taps, room, half)
    run_over_rows(_blur_down, len(image), half, taps, out)
    return out


def agree(params: Params, L: NDArray, along: Along, place: Place) -> Agreement:
    """The same as `agree_purely`, of instants that are all present."""
    p = params
    count, h, w = L.shape
    numbers = (p.information, p.floor, p.sigma_place**2, p.sigma_between**2, p.tolerance)
    settings = _Settings(*(np.float32(v) for v in numbers), *(int(k) for k in stretch(place)))
    own, taps = int(place.own), taps_of(MISFIT)
    weights = np.exp(-2 * place.s**2).astype(np.float32)
    place = place._replace(own=own, before=int(place.before), after=int(place.after))
    misfits = np.empty((count, h, w), np.float32)
    steep, M = np.empty((2, h, w), np.float32)
    seen_from = blurred(np.ascontiguousarray(L[own]), 1.0)
    room, padded = row_scratch(h, 10 + 2 * count, w), row_scratch(h, w + len(taps))
    for turn in range(3):
        given = (along, weights, misfits, seen_from, steep, settings, own, turn, taps)
        run_over_rows(_find_mean, h, *given, room, M)
        given = (along, M, steep, settings, own, taps, room, padded)
        run_over_rows(_find_misfits, h, *given, misfits)
        seen_from = M.copy()
    images = np.empty((8, h, w), np.float32)
    M, total, scatter, near, near_information, frame_information, activity, usual = images
    parts, seen = np.empty((3, h, w), np.float32), np.empty((2, h, w), np.float32)
    told = (M, total, scatter, near, near_information, frame_information, activity)
    out = Agreement(*told, parts, seen, usual)
    excess, weight = np.empty((2, h, w), np.float32)
    given = (L, along, misfits, steep, settings, place, taps, room)
    run_over_rows(_finish, h, *given, out, excess, weight)
    scatter = np.maximum(blurred(excess, SCATTER) / blurred(weight, SCATTER), 0)
    return out._replace(scatter=scatter)
