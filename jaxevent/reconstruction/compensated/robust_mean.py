"""Robust mean of images along trajectories: in numba loops, and in JAX for derivatives."""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import NDArray

from jaxevent.codegen import empty, njit_fastmath, njit_fastmath_inlined, row_scratch, run_over_rows
from jaxevent.reconstruction.compensated.instants import TargetInstants
from jaxevent.reconstruction.compensated.params import Params
from jaxevent.reconstruction.compensated.warp import (
    WarpedImages,
    gradient_at_pixel,
    gradient_jax,
    pad_edges,
)
from jaxevent.reconstruction.features import Numeric

SCATTER_TOLERANCE = 3.0  # squared residual of an instant that scatter hardly counts
OUTSIDE_VARIANCE = 1e6  # (ln I)^2, beyond the image's border
# Squared difference of an image from the mean, in units of its variance.
EXPECTED_SQUARED_RESIDUAL = 0.6
RESIDUAL_SIGMA_PX, SCATTER_SIGMA_PX = 1.5, 2.0  # of the Gaussians that gather them
N_HALF_TAPS = 7  # of filters of loops
N_NEAR_INSTANTS = 5  # instants without frame next to the target


class InstantLayout(NamedTuple):
    """The instants of a target as arrays, padded to a common number."""

    s: Float[Numeric, " k"]  # times relative to the target, -1..1
    present: Float[Numeric, " k"]  # 1, or 0 of instants that only pad the number
    framed: Float[Numeric, " k"]  # 1 where a frame was taken
    near: Float[Numeric, " k"]  # 1 of the target and of those next to it without frame
    target: Numeric  # (), index of the target
    before: Numeric  # (), index of the frame before
    after: Numeric  # (), index of the frame after
    # Index of the frame that `before` is compared with: `after`, and where frames are on one side
    # alone the next nearest; where there is none, `before`.
    other: Numeric
    rest: Numeric = np.float32(0)  # (), `TargetInstants.rest`


def make_layout(instants: TargetInstants, clear: NDArray, count: int) -> InstantLayout:
    """Lay out a target's instants as arrays.

    Args:
        instants: The instants.
        clear: (K, h, w) 1 where a frame shows the pixel unclipped.
        count: Number to which the instants are padded.

    Returns:
        The arrays.
    """
    framed: NDArray = clear.reshape(len(instants), -1).max(1) > 0
    framed[[instants.before, instants.after]] |= instants.before != instants.after
    target, other = instants.target, instants.after
    order = np.argsort(np.abs(instants.t - instants.t[target]), kind="stable")
    near = np.zeros(len(instants), bool)
    near[[k for k in order if k == target or not framed[k]][:N_NEAR_INSTANTS]] = True
    near[target] = True
    if instants.before == other:
        other = next((k for k in order if framed[k] and k not in (target, other)), other)
    indices = (np.asarray(k, np.int32) for k in (target, instants.before, instants.after, other))

    def pad(values: NDArray, fill: float = 0) -> NDArray[np.float32]:
        return np.pad(
            np.asarray(values, np.float32), (0, count - len(values)), constant_values=fill
        )

    layout = pad(instants.s, 1), pad(np.ones(len(instants))), pad(framed), pad(near)
    return InstantLayout(*layout, *indices, rest=np.float32(instants.rest))


class RobustMean(NamedTuple):
    """The robust mean of a target's images along trajectories, each (h, w), and its evidence."""

    M: Float[Numeric, "h w"]  # log intensity
    information: Float[Numeric, "h w"]  # 1 / (ln I)^2
    scatter: Float[Numeric, "h w"]  # variance beyond that of the images, (ln I)^2
    near_mean: Float[Numeric, "h w"]  # of the near instants
    near_information: Float[Numeric, "h w"]
    frame_information: Float[Numeric, "h w"]
    activity: Float[Numeric, "h w"]  # squared changes in place over `activity_range`
    shares: Float[Numeric, "3 h w"]  # in M: of frames before, frames after, all others
    visible: Float[Numeric, "2 h w"]  # 1 where the frame before, after, sees the point, else 0
    image_variance: Float[Numeric, "h w"]  # mean of the images, as in M, 0 of frames unclipped


def gaussian_taps(sigma_px: float) -> NDArray[np.float32]:
    """Return the taps of a Gaussian of `sigma_px` px, an odd number."""
    reach = int(np.ceil(3 * sigma_px))
    taps = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma_px) ** 2)
    return (taps / taps.sum()).astype(np.float32)


def blur_jax(image: Array, sigma_px: float) -> Array:
    """Blur the last two axes by a Gaussian; differentiable.

    Args:
        image: (..., h, w).
        sigma_px: Standard deviation, px.

    Returns:
        (..., h, w).
    """
    taps = gaussian_taps(sigma_px)
    for axis in (image.ndim - 2, image.ndim - 1):
        size = image.shape[axis]
        padded = pad_edges(image, axis, len(taps) // 2)
        moved = [jax.lax.slice_in_dim(padded, i, i + size, axis=axis) for i in range(len(taps))]
        image = functools.reduce(
            jnp.add, [float(tap) * one for tap, one in zip(taps, moved, strict=True)]
        )
    return image


def squared_gradient(image: Array) -> Array:
    """Return |grad|^2 of images (..., h, w), 1/px^2; differentiable."""
    gx, gy = gradient_jax(image)
    return gy**2 + gx**2


def activity_range(layout: InstantLayout) -> tuple[Any, Any]:
    """Return the indices between which changes are summed: the frames next to the target.

    Both are left out. Where frames are on one side alone, the range is from there to the target,
    which takes part.
    """
    a, b, target = layout.before, layout.after, layout.target
    follows = layout.s[a] > 0  # no frame is before
    low = a + (a == b) * follows * (target - 1 - a)
    return low, b + (a == b) * (1 - follows) * (target + 1 - b)


def robust_mean_jax(
    params: Params, L: Float[Array, "k h w"], warped: WarpedImages, layout: InstantLayout
) -> RobustMean:
    """Compute the robust mean of images along trajectories; differentiable.

    It begins with the target's own image. An instant counts by its information, which is of V and
    of the error of warping. Where it differs from the others by more than that, the point is hidden
    there. Excess scatter shows that the motion is wrong.

    Args:
        params: Parameters of `mc`.
        L: (K, h, w) log intensity in place.
        warped: The images along trajectories.
        layout: Their instants.

    Returns:
        The mean and its evidence.
    """
    p = params
    count = len(layout.s)
    s, present, framed = (v[:, None, None] for v in (layout.s, layout.present, layout.framed))
    here = (jnp.arange(count) == layout.target)[:, None, None]
    eta = (p.information + (1 - p.information) * warped.clear) * present
    base = jnp.where(warped.inside > 0, warped.V + p.floor, OUTSIDE_VARIANCE)
    steepness = squared_gradient(blur_jax(L[layout.target], 1.0))
    variance, residual = base, base
    visible = jnp.broadcast_to(jnp.exp(-2 * s**2), base.shape)  # near instants begin
    for turn in range(3):
        added = p.sigma_place**2 * steepness + p.sigma_between**2
        variance = base + jnp.where(here, 0, added)
        R = eta / variance * visible
        M = (R * warped.L).sum(0) / R.sum(0)
        steepness = squared_gradient(M)
        residual = blur_jax((warped.L - M) ** 2 / variance, RESIDUAL_SIGMA_PX)
        if turn == 0:
            residual = jnp.where(here, jnp.minimum(residual, 1), residual)
        visible = 1 / (1 + (residual / p.tolerance) ** 2)
    W = eta / variance
    R = W * visible
    total = R.sum(0)
    M = (R * warped.L).sum(0) / total
    # Of all instants but the plainly hidden ones, whatever the tolerance.
    plain = present / variance / (1 + (residual / SCATTER_TOLERANCE) ** 2)
    excess = (plain * ((warped.L - M) ** 2 - EXPECTED_SQUARED_RESIDUAL * variance)).sum(0)
    weight = blur_jax((plain * eta).sum(0), SCATTER_SIGMA_PX)
    scatter = jnp.maximum(blur_jax(excess, SCATTER_SIGMA_PX) / weight, 0)
    W = W * warped.inside
    near_information = (W * layout.near[:, None, None]).sum(0)
    near = (W * layout.near[:, None, None] * warped.L).sum(0) / jnp.maximum(near_information, 1e-9)
    order = jnp.arange(count)
    low, high = activity_range(layout)
    between = ((order > low) & (order + 1 < high))[:-1, None, None]
    share = R / total
    shares = [(share * framed * side).sum(0) for side in (s < 0, s > 0)]
    return RobustMean(
        M,
        total,
        scatter,
        near,
        near_information,
        (W * framed).sum(0),
        ((L[1:] - L[:-1]) ** 2 * between).sum(0),
        jnp.stack([*shares, (share * (1 - framed * (s != 0))).sum(0)]),
        jnp.stack([visible[k] * warped.inside[k] for k in (layout.before, layout.after)]),
        (R * (1 - warped.clear) * warped.V).sum(0) / total,
    )


def visibility(
    params: Params, M: Float[Array, "h w"], warped: WarpedImages
) -> Float[Array, "k h w"]:
    """Estimate the visibility of an image's points in images along trajectories.

    Args:
        params: Parameters of `mc`.
        M: (h, w) log intensity of the points.
        warped: The images along trajectories.

    Returns:
        (K, h, w), 0 where a point is hidden, to 1.
    """
    p = params
    V = warped.V + p.floor + p.sigma_place**2 * squared_gradient(M) + p.sigma_between**2
    residual = blur_jax((warped.L - M) ** 2 / V, RESIDUAL_SIGMA_PX)
    return warped.inside / (1 + (residual / p.tolerance) ** 2)


def half_taps(sigma_px: float) -> NDArray[np.float32]:
    """Return the taps of `gaussian_taps` from the middle on, of at most 2 px, filled with zeros."""
    taps = gaussian_taps(sigma_px)
    out = np.zeros(N_HALF_TAPS, np.float32)
    out[: len(taps) // 2 + 1] = taps[len(taps) // 2 :]
    return out


@njit_fastmath_inlined
def blur_along_x(row, taps, padded_scratch, out_row):
    """Blur a row; the image's border goes on.

    Args:
        row: (w,) the row.
        taps: (7,) half of the filter, of `half_taps`.
        padded_scratch: (w + 12,) scratch.
        out_row: (w,) output.
    """
    w, padded, t = len(row), padded_scratch, taps
    for x in range(6):
        padded[x], padded[w + 6 + x] = row[0], row[w - 1]
    for x in range(w):
        padded[6 + x] = row[x]
    t0, t1, t2, t3, t4, t5, t6 = t[0], t[1], t[2], t[3], t[4], t[5], t[6]
    for x in range(w):
        near = t0 * padded[x + 6] + t1 * (padded[x + 5] + padded[x + 7])
        near += t2 * (padded[x + 4] + padded[x + 8]) + t3 * (padded[x + 3] + padded[x + 9])
        far = t4 * (padded[x + 2] + padded[x + 10]) + t5 * (padded[x + 1] + padded[x + 11])
        out_row[x] = near + far + t6 * (padded[x] + padded[x + 12])


@njit_fastmath_inlined
def blur_along_y(image, y, taps, out_row):
    """Blur an image along y, for one of its rows.

    Args:
        image: (h, w) the image.
        y: The row.
        taps: (7,) half of the filter, of `half_taps`.
        out_row: (w,) output.
    """
    h, w = image.shape
    for x in range(w):
        out_row[x] = taps[0] * image[y, x]
    for i in range(1, 7, 2):  # few rows at once: compilers compare the places of all of them
        a, b = image[max(y - i, 0)], image[min(y + i, h - 1)]
        c, d = image[max(y - i - 1, 0)], image[min(y + i + 1, h - 1)]
        t, u = taps[i], taps[i + 1]
        for x in range(w):
            out_row[x] += t * (a[x] + b[x]) + u * (c[x] + d[x])


@njit_fastmath
def _blur_across(begin, end, images, taps, scratch, out):
    for k in range(len(images)):
        for y in range(begin, end):
            blur_along_x(images[k, y], taps, scratch[begin], out[k, y])


@njit_fastmath
def _blur_down(begin, end, images, taps, out):
    for k in range(len(images)):
        for y in range(begin, end):
            blur_along_y(images[k], y, taps, out[k, y])


def blur_images(images: NDArray[np.float32], sigma_px: float) -> NDArray[np.float32]:
    """Blur images by a Gaussian, in loops.

    Args:
        images: (n, h, w).
        sigma_px: Standard deviation, px, at most 2.

    Returns:
        (n, h, w).
    """
    taps, (_, h, w) = half_taps(sigma_px), images.shape
    half, out = empty(*images.shape), empty(*images.shape)
    run_over_rows(_blur_across, h, images, taps, row_scratch(h, w + 12), half, min_rows=32)
    run_over_rows(_blur_down, h, half, taps, out, min_rows=32)
    return out


class MeanParams(NamedTuple):
    """Parameters of the robust mean, float32; `Params` has their meanings."""

    information: np.float32
    floor: np.float32
    place_variance: np.float32  # px^2, of the place of points
    between_variance: np.float32  # (ln I)^2, between pixels
    tolerance: np.float32

    @classmethod
    def of(cls, params: Params) -> "MeanParams":
        """Take the parameters of the robust mean from those of `mc`."""
        p = params
        numbers = (p.information, p.floor, p.sigma_place**2, p.sigma_between**2, p.tolerance)
        return cls(*(np.float32(number) for number in numbers))


class _MeanInputs(NamedTuple):
    """Inputs of the kernels of `robust_mean`."""

    L: NDArray[np.float32]  # (K, h, w), in place
    warped: WarpedImages
    layout: InstantLayout  # indices are int
    weights: NDArray[np.float32]  # (K,), with which the mean begins
    taps: NDArray[np.float32]
    low: int  # range of activity
    high: int
    params: MeanParams


class _MeanScratch(NamedTuple):
    """Arrays that the kernels of `robust_mean` exchange, and scratch memory."""

    steepness: NDArray[np.float32]  # (h, w), |grad M|^2
    excess: NDArray[np.float32]  # (2, h, w), of squared differences, and what it is divided by
    rows: NDArray[np.float32]  # (h, 13 + 2 K, w)
    padded: NDArray[np.float32]  # (h, w + 12)


@njit_fastmath_inlined
def _fill_information(inputs, k, y, steepness, out):
    """Write the inverse of the variance of an instant's values."""
    V, inside, p = inputs.warped.V[k, y], inputs.warped.inside[k, y], inputs.params
    one, out_variance = np.float32(1), np.float32(OUTSIDE_VARIANCE)
    moved = np.float32(0 if k == inputs.layout.target else 1)
    for x in range(len(V)):
        added = moved * (p.place_variance * steepness[x] + p.between_variance)
        base = V[x] + p.floor if inside[x] > 0 else out_variance
        out[x] = one / (base + added)


@njit_fastmath_inlined
def _fill_visibility(residual, tolerance, most, out):
    one = np.float32(1)
    for x in range(len(residual)):
        ratio = min(residual[x], most) / tolerance
        out[x] = one / (one + ratio * ratio)


@njit_fastmath
def _update_mean(begin, end, inputs, scratch, turn, images, residuals):
    """Update the mean M of some rows, and the squared differences from it.

    `images` are the mean to begin from and that to write, `residuals` (K, h, w) squared differences
    in units of their variances, blurred along x: those from the mean before, and those to write.
    """
    warped, rows, one = inputs.warped, scratch.rows[begin], np.float32(1)
    count, h, w = warped.L.shape
    before, M = images
    known, found = residuals
    residual, visible, total, mean, info = rows[0], rows[1], rows[2], rows[3], rows[4 : 4 + count]
    least, padded = inputs.params.information, scratch.padded[begin]
    for y in range(begin, end):
        steepness = scratch.steepness[y]
        for x in range(w):
            gx, gy = gradient_at_pixel(before, y, x)
            steepness[x] = gx * gx + gy * gy
            total[x], mean[x] = np.float32(0), np.float32(0)
        for k in range(count):
            if turn == 0:
                visible[:] = inputs.weights[k]
            else:
                blur_along_y(known[k], y, inputs.taps, residual)
                most = np.float32(1 if turn == 1 and k == inputs.layout.target else np.inf)
                _fill_visibility(residual, inputs.params.tolerance, most, visible)
            _fill_information(inputs, k, y, steepness, info[k])
            L, clear = warped.L[k, y], warped.clear[k, y]
            for x in range(w):
                R = (least + (one - least) * clear[x]) * info[k, x] * visible[x]
                total[x] += R
                mean[x] += R * L[x]
        for x in range(w):
            M[y, x] = mean[x] / total[x]
        for k in range(count):
            for x in range(w):
                e = warped.L[k, y, x] - M[y, x]
                residual[x] = e * e * info[k, x]
            blur_along_x(residual, inputs.taps, padded, found[k, y])


@njit_fastmath_inlined
def _add_instant(inputs, k, y, visible, info, sums):
    """Add an instant to the sums (9, w) that means are made of."""
    one, zero, layout, warped = np.float32(1), np.float32(0), inputs.layout, inputs.warped
    near, framed = layout.near[k], layout.framed[k]
    before = framed if layout.s[k] < 0 else zero
    after = framed if layout.s[k] > 0 else zero
    rest = one - before - after
    L, V, clear, inside = warped.L[k, y], warped.V[k, y], warped.clear[k, y], warped.inside[k, y]
    total, mean, near_total, near_mean = sums[0], sums[1], sums[2], sums[3]
    frames, from_before, from_after, from_rest = sums[4], sums[5], sums[6], sums[7]
    image_variance = sums[8]
    least = inputs.params.information
    for x in range(len(L)):
        W = (least + (one - least) * clear[x]) * info[x]
        R = W * visible[x]
        total[x] += R
        mean[x] += R * L[x]
        W = W * inside[x]
        near_total[x] += W * near
        near_mean[x] += W * near * L[x]
        frames[x] += W * framed
        from_before[x] += R * before
        from_after[x] += R * after
        from_rest[x] += R * rest
        image_variance[x] += R * (one - clear[x]) * V[x]


@njit_fastmath_inlined
def _add_excess(inputs, k, y, residual, info, sums):
    """Add an instant to the excess of squared differences (w,), and to its weight."""
    M, excess, weight = sums
    one, tolerance = np.float32(1), np.float32(SCATTER_TOLERANCE)
    L, clear = inputs.warped.L[k, y], inputs.warped.clear[k, y]
    expected, least = np.float32(EXPECTED_SQUARED_RESIDUAL), inputs.params.information
    for x in range(len(L)):
        ratio = residual[x] / tolerance
        plain = one / (one + ratio * ratio)
        e = L[x] - M[x]
        excess[x] += plain * (e * e * info[x] - expected)
        weight[x] += plain * info[x] * (least + (one - least) * clear[x])


@njit_fastmath
def _finish(begin, end, inputs, scratch, residuals, out):
    """Write all but the scatter of some rows, and what the scatter is gathered from."""
    layout, warped = inputs.layout, inputs.warped
    count, _, w = warped.L.shape
    rows, zero = scratch.rows[begin], np.float32(0)
    visible, sums = rows[0], rows[1:10]
    residual, info = rows[10 : 10 + count], rows[10 + count :]
    for y in range(begin, end):
        excess, weight, activity = scratch.excess[0, y], scratch.excess[1, y], out.activity[y]
        sums[:], excess[:], weight[:], activity[:] = zero, zero, zero, zero
        for k in range(count):
            blur_along_y(residuals[k], y, inputs.taps, residual[k])
            _fill_visibility(residual[k], inputs.params.tolerance, np.float32(np.inf), visible)
            _fill_information(inputs, k, y, scratch.steepness[y], info[k])
            _add_instant(inputs, k, y, visible, info[k], sums)
            for side in range(2):
                if k == (layout.before if side == 0 else layout.after):
                    for x in range(w):
                        out.visible[side, y, x] = visible[x] * warped.inside[k, y, x]
            if inputs.low < k and k + 1 < inputs.high:
                early, late = inputs.L[k, y], inputs.L[k + 1, y]
                for x in range(w):
                    activity[x] += (late[x] - early[x]) * (late[x] - early[x])
        for x in range(w):
            total = sums[0, x]
            out.information[y, x], out.M[y, x] = total, sums[1, x] / total
            out.near_information[y, x] = sums[2, x]
            out.near_mean[y, x] = sums[3, x] / max(sums[2, x], np.float32(1e-9))
            out.frame_information[y, x] = sums[4, x]
            out.image_variance[y, x] = sums[8, x] / total
            for n in range(3):
                out.shares[n, y, x] = sums[5 + n, x] / total
        for k in range(count):
            found = (out.M[y], excess, weight)
            _add_excess(inputs, k, y, residual[k], info[k], found)


def robust_mean(
    params: MeanParams, L: NDArray, warped: WarpedImages, layout: InstantLayout
) -> RobustMean:
    """Compute the robust mean as `robust_mean_jax` does, of instants that are all present.

    Args:
        params: Its parameters.
        L: (K, h, w) float32, log intensity in place.
        warped: The images along trajectories.
        layout: Their instants.

    Returns:
        The mean and its evidence.
    """
    count, h, w = L.shape
    target, taps = int(layout.target), half_taps(RESIDUAL_SIGMA_PX)
    weights = np.exp(-2 * layout.s**2).astype(np.float32)
    low, high = (int(k) for k in activity_range(layout))
    layout = layout._replace(target=target, before=int(layout.before), after=int(layout.after))
    inputs = _MeanInputs(L, warped, layout, weights, taps, low, high, params)
    rows, padded = row_scratch(h, 13 + 2 * count, w), row_scratch(h, w + 12)
    images, means = empty(3, h, w), empty(2, h, w)
    scratch = _MeanScratch(images[0], images[1:], rows, padded)
    residuals = empty(2, count, h, w)
    before = blur_images(L[target : target + 1], 1.0)[0]
    # No row reads what another one writes at the same time.
    for turn in range(3):
        now, last = turn % 2, 1 - turn % 2
        given = (before, means[now]), (residuals[last], residuals[now])
        run_over_rows(_update_mean, h, inputs, scratch, turn, *given)
        before = means[now]
    out = RobustMean(*(empty(h, w) for _ in range(7)), empty(3, h, w), empty(2, h, w), empty(h, w))
    run_over_rows(_finish, h, inputs, scratch, residuals[0], out)
    excess, weight = blur_images(scratch.excess, SCATTER_SIGMA_PX)
    return out._replace(scatter=np.maximum(excess / weight, 0))
