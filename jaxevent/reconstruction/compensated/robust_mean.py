"""Robust mean of images along trajectories: in numba loops, and in JAX for derivatives."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import NDArray

from jaxevent.codegen import empty_row_scratch, njit_noalloc, njit_noalloc_inlined, run_over_rows
from jaxevent.reconstruction.compensated.instants import TargetInstants
from jaxevent.reconstruction.compensated.params import Params
from jaxevent.reconstruction.compensated.warp import (
    PathTimes,
    WarpedImages,
    filter_along,
    gradient_at_pixel,
    gradient_jax,
    sum_images,
)
from jaxevent.reconstruction.features import Numeric

SCATTER_TOLERANCE = 3.0  # squared residual of an instant that scatter hardly counts
OUTSIDE_VARIANCE = 1e6  # (ln I)^2, beyond the image's border
# Squared difference of an image from the mean, in units of its variance.
EXPECTED_SQUARED_RESIDUAL = 0.6
RESIDUAL_SIGMA_PX, SCATTER_SIGMA_PX = 1.5, 2.0  # of the Gaussians that gather them
N_NEAR_INSTANTS = 5  # instants without frame next to the target


class InstantLayout(NamedTuple):
    """The instants of a target as arrays, padded to a common number."""

    s: Float[Numeric, " k"]  # times relative to the target, -1..1
    present: Float[Numeric, " k"]  # 1, or 0 of instants that only pad the number
    framed: Float[Numeric, " k"]  # 1 where a frame was taken
    near: Float[Numeric, " k"]  # 1 of the target and of those next to it without frame
    common: Float[Numeric, "k 2"]  # displacements that all points share, px
    target: Numeric  # (), index of the target
    before: Numeric  # (), index of the frame before
    after: Numeric  # (), index of the frame after
    # Index of the frame that `before` is compared with: `after`, and where frames are on one side
    # alone the next nearest; where there is none, `before`.
    other: Numeric
    rest: Numeric = np.float32(0)  # (), `TargetInstants.rest`

    @property
    def path_times(self) -> PathTimes:
        """The instants on the clock of paths."""
        return PathTimes(self.s, self.common)


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
    common = np.pad(instants.path_times.common, [(0, count - len(instants)), (0, 0)])
    return InstantLayout(*layout, common, *indices, rest=np.float32(instants.rest))


class RobustMean(NamedTuple):
    """The robust mean of a target's images along trajectories, each (h, w), and its evidence."""

    M: Float[Numeric, "h w"]  # log intensity
    information: Float[Numeric, "h w"]  # 1 / (ln I)^2
    scatter: Float[Numeric, "h w"]  # variance beyond that of the images, (ln I)^2
    near_mean: Float[Numeric, "h w"]  # log intensity by the near instants
    near_information: Float[Numeric, "h w"]  # of the near instants, 1 / (ln I)^2
    frame_information: Float[Numeric, "h w"]  # of the instants of frames, 1 / (ln I)^2
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
    taps = tuple(gaussian_taps(sigma_px).tolist())
    return filter_along(filter_along(image, -2, taps), -1, taps)


def squared_gradient(image: Array) -> Array:
    """Return |grad|^2 of images (..., h, w), 1/px^2; differentiable."""
    gx, gy = gradient_jax(image)
    return gy**2 + gx**2


def activity_range(layout: InstantLayout) -> tuple[Numeric | np.integer, Numeric | np.integer]:
    """Return the indices between which changes are summed: the frames next to the target.

    Both are left out. Where frames are on one side alone, the range is from there to the target,
    which takes part.
    """
    a, b, target = layout.before, layout.after, layout.target
    last = layout.s[a] <= 0  # no frame follows
    # No `jnp.where`, which compiles a program where the indices are known.
    return a + ((a == b) & ~last) * (target - 1 - a), b + ((a == b) & last) * (target + 1 - b)


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
    order = jnp.arange(len(layout.s))
    s, present = (v[:, None, None] for v in (layout.s, layout.present))
    here, framed = (order == layout.target)[:, None, None], layout.framed
    eta = (p.information + (1 - p.information) * warped.clear) * present
    base = jnp.where(warped.inside > 0, warped.V + p.floor, OUTSIDE_VARIANCE)
    steepness = squared_gradient(blur_jax(L[layout.target], 1.0))
    variance, residual = base, base
    visible = jnp.broadcast_to(jnp.exp(-2 * s**2), base.shape)  # near instants begin
    for turn in range(3):
        added = p.sigma_place**2 * steepness + p.sigma_between**2
        variance = base + jnp.where(here, 0, added)
        R = eta / variance * visible
        M = sum_images(R * warped.L) / sum_images(R)
        steepness = squared_gradient(M)
        residual = blur_jax((warped.L - M) ** 2 / variance, RESIDUAL_SIGMA_PX)
        if turn == 0:
            residual = jnp.where(here, jnp.minimum(residual, 1), residual)
        visible = 1 / (1 + (residual / p.tolerance) ** 2)
    W = eta / variance
    R = W * visible
    total = sum_images(R)
    M = sum_images(R * warped.L) / total
    # Of all instants but the plainly hidden ones, whatever the tolerance.
    plain = present / variance / (1 + (residual / SCATTER_TOLERANCE) ** 2)
    square = (warped.L - M) ** 2
    excess = sum_images(plain * (square - EXPECTED_SQUARED_RESIDUAL * variance))
    weight = blur_jax(sum_images(plain * eta), SCATTER_SIGMA_PX)
    scatter = jnp.maximum(blur_jax(excess, SCATTER_SIGMA_PX) / weight, 0)
    W = W * warped.inside
    near_information, frame_information = sum_images(W, jnp.stack([layout.near, framed]))
    near = sum_images(W * warped.L, layout.near) / jnp.maximum(near_information, 1e-9)
    low, high = activity_range(layout)
    between = ((order > low) & (order + 1 < high))[:-1]
    before, after = framed * (layout.s < 0), framed * (layout.s > 0)
    return RobustMean(
        M,
        total,
        scatter,
        near,
        near_information,
        frame_information,
        sum_images((L[1:] - L[:-1]) ** 2, between),
        sum_images(R, jnp.stack([before, after, 1 - before - after])) / total,
        jnp.stack([visible[k] * warped.inside[k] for k in (layout.before, layout.after)]),
        sum_images(R * (1 - warped.clear) * warped.V) / total,
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


@njit_noalloc_inlined
def blur_along_x(row, taps, padded_scratch, out_row):
    """Blur a row; the image's border goes on.

    Args:
        row: (w,) the row.
        taps: (n,) the filter, n odd.
        padded_scratch: (w + n,) scratch.
        out_row: (w,) output.
    """
    w, reach = len(row), len(taps) // 2
    for x in range(reach):
        padded_scratch[x] = row[0]
        padded_scratch[w + reach + x] = row[w - 1]
    for x in range(w):
        padded_scratch[reach + x] = row[x]
        out_row[x] = np.float32(0)
    for i in range(len(taps)):
        tap = taps[i]
        for x in range(w):
            out_row[x] += tap * padded_scratch[i + x]


@njit_noalloc_inlined
def blur_along_y(image, y, taps, out_row):
    """Blur an image along y, for one of its rows.

    Args:
        image: (h, w) the image.
        y: The row.
        taps: (n,) the filter, n odd.
        out_row: (w,) output.
    """
    h, w = image.shape
    for x in range(w):
        out_row[x] = np.float32(0)
    for i in range(len(taps)):
        row, tap = image[min(max(y + i - len(taps) // 2, 0), h - 1)], taps[i]
        for x in range(w):
            out_row[x] += tap * row[x]


@njit_noalloc
def _blur_across(begin, end, image, taps, scratch, out):
    """Blur some rows of an image along x.

    Args:
        begin: First row.
        end: Row after the last one.
        image: (h, w).
        taps: (n,) the filter, n odd.
        scratch: (rows, w + n).
        out: (h, w) output.
    """
    for y in range(begin, end):
        blur_along_x(image[y], taps, scratch[begin], out[y])


@njit_noalloc
def _blur_down(begin, end, image, taps, out):
    """Blur an image along y, for some of its rows.

    Args:
        begin: First row.
        end: Row after the last one.
        image: (h, w).
        taps: (n,) the filter, n odd.
        out: (h, w) output.
    """
    for y in range(begin, end):
        blur_along_y(image, y, taps, out[y])


def blur_image(image: NDArray[np.float32], sigma_px: float) -> NDArray[np.float32]:
    """Blur an image by a Gaussian, in loops.

    Args:
        image: (h, w).
        sigma_px: Standard deviation, px.

    Returns:
        (h, w).
    """
    taps = gaussian_taps(sigma_px)
    half, out = np.empty_like(image), np.empty_like(image)
    scratch = empty_row_scratch(len(image), image.shape[1] + len(taps))
    run_over_rows(_blur_across, len(image), image, taps, scratch, half)
    run_over_rows(_blur_down, len(image), half, taps, out)
    return out


class _MeanInputs(NamedTuple):
    """Inputs of the kernels of `robust_mean`.

    Attributes:
        L: (K, h, w) log intensity in place.
        warped: The images along trajectories.
        layout: Layout of the instants, with indices as int.
        weights: (K,) weights with which the mean begins.
        taps: Taps of the Gaussian filter.
        low: First instant of the range of activity.
        high: Instant after its last one.
        information: Weight of an instant without frame.
        floor: Least variance of an image read between pixels, (ln I)^2.
        place_variance: Variance of the positions of points, px^2.
        between_variance: Variance between pixels, (ln I)^2.
        tolerance: Standardised squared difference beyond which a point is hidden.
    """

    L: NDArray[np.float32]
    warped: WarpedImages
    layout: InstantLayout
    weights: NDArray[np.float32]
    taps: NDArray[np.float32]
    low: int
    high: int
    information: np.float32
    floor: np.float32
    place_variance: np.float32
    between_variance: np.float32
    tolerance: np.float32


class _MeanScratch(NamedTuple):
    """Arrays that the kernels of `robust_mean` exchange, and scratch memory."""

    residuals: NDArray[np.float32]  # (K, h, w), blurred along x
    steepness: NDArray[np.float32]  # (h, w), |grad M|^2
    excess: NDArray[np.float32]  # (h, w), of squared differences
    weight: NDArray[np.float32]  # (h, w), that it is divided by
    rows: NDArray[np.float32]  # (h, 10 + 2 K, w)
    padded: NDArray[np.float32]  # (h, w + taps)


@njit_noalloc_inlined
def _fill_variance(inputs, k, y, steepness, out):
    """Write the variance of an image along trajectories, for a row.

    Args:
        inputs: `_MeanInputs`.
        k: Index of the instant.
        y: The row.
        steepness: (w,) |grad M|^2, (ln I / px)^2.
        out: (w,) output, (ln I)^2; with the error of warping, but for the target's own image.
    """
    V, inside = inputs.warped.V[k, y], inputs.warped.inside[k, y]
    here = k == inputs.layout.target
    for x in range(len(V)):
        added = inputs.place_variance * steepness[x] + inputs.between_variance
        base = V[x] + inputs.floor if inside[x] > 0 else np.float32(OUTSIDE_VARIANCE)
        out[x] = base if here else base + added


@njit_noalloc_inlined
def _fill_visibility(residual, tolerance, most, out):
    """Write the visibility of points, by residuals around them.

    Args:
        residual: (w,) blurred squared residuals in units of their variance.
        tolerance: Residual at which a point counts half.
        most: Greatest residual; larger ones count as this.
        out: (w,) output, 0..1.
    """
    one = np.float32(1)
    for x in range(len(residual)):
        ratio = min(residual[x], most) / tolerance
        out[x] = one / (one + ratio * ratio)


@njit_noalloc
def _update_mean(begin, end, inputs, scratch, turn, means):
    """Update the mean M of some rows.

    Args:
        begin: First row.
        end: Row after the last one.
        inputs: `_MeanInputs`.
        scratch: `_MeanScratch`.
        turn: Number of the update, from 0.
        means: (h, w) image to begin from, and (h, w) output, ln I.
    """
    warped, rows, one = inputs.warped, scratch.rows[begin], np.float32(1)
    count, h, w = warped.L.shape
    before, M = means
    variance, residual, visible, total, mean = rows[0], rows[1], rows[2], rows[3], rows[4]
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
                blur_along_y(scratch.residuals[k], y, inputs.taps, residual)
                most = np.float32(1 if turn == 1 and k == inputs.layout.target else np.inf)
                _fill_visibility(residual, inputs.tolerance, most, visible)
            _fill_variance(inputs, k, y, steepness, variance)
            L, clear = warped.L[k, y], warped.clear[k, y]
            for x in range(w):
                eta = inputs.information + (one - inputs.information) * clear[x]
                R = eta / variance[x] * visible[x]
                total[x] += R
                mean[x] += R * L[x]
        for x in range(w):
            M[y, x] = mean[x] / total[x]


@njit_noalloc
def _fill_residuals(begin, end, inputs, scratch, M):
    """Write squared differences from M in units of their variances, blurred along x.

    Args:
        begin: First row.
        end: Row after the last one.
        inputs: `_MeanInputs`.
        scratch: `_MeanScratch`, whose `residuals` are written.
        M: (h, w) mean, ln I.
    """
    count, h, w = inputs.warped.L.shape
    variance, ratio, padded = scratch.rows[begin, 0], scratch.rows[begin, 1], scratch.padded[begin]
    for y in range(begin, end):
        for k in range(count):
            _fill_variance(inputs, k, y, scratch.steepness[y], variance)
            L = inputs.warped.L[k, y]
            for x in range(w):
                ratio[x] = (L[x] - M[y, x]) * (L[x] - M[y, x]) / variance[x]
            blur_along_x(ratio, inputs.taps, padded, scratch.residuals[k, y])


@njit_noalloc_inlined
def _add_instant(inputs, k, y, visible, variance, sums):
    """Add an instant to the sums that means are made of, for a row.

    Args:
        inputs: `_MeanInputs`.
        k: Index of the instant.
        y: The row.
        visible: (w,) 0..1.
        variance: (w,), (ln I)^2.
        sums: (9, w) added to.
    """
    one, zero, layout, warped = np.float32(1), np.float32(0), inputs.layout, inputs.warped
    near, framed = layout.near[k], layout.framed[k]
    before = framed if layout.s[k] < 0 else zero
    after = framed if layout.s[k] > 0 else zero
    rest = one - before - after
    L, V, clear, inside = warped.L[k, y], warped.V[k, y], warped.clear[k, y], warped.inside[k, y]
    total, mean, near_total, near_mean = sums[0], sums[1], sums[2], sums[3]
    frames, from_before, from_after, from_rest = sums[4], sums[5], sums[6], sums[7]
    image_variance = sums[8]
    for x in range(len(L)):
        eta = inputs.information + (one - inputs.information) * clear[x]
        W = eta / variance[x]
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


@njit_noalloc_inlined
def _add_excess(inputs, k, y, residual, variance, sums):
    """Add an instant to the excess of squared differences, and to its weight, for a row.

    Args:
        inputs: `_MeanInputs`.
        k: Index of the instant.
        y: The row.
        residual: (w,) blurred squared residuals in units of their variance.
        variance: (w,), (ln I)^2.
        sums: M (w,), excess (w,) and weight (w,), of which the last two are added to.
    """
    M, excess, weight = sums
    one, tolerance = np.float32(1), np.float32(SCATTER_TOLERANCE)
    L, clear = inputs.warped.L[k, y], inputs.warped.clear[k, y]
    expected = np.float32(EXPECTED_SQUARED_RESIDUAL)
    for x in range(len(L)):
        eta = inputs.information + (one - inputs.information) * clear[x]
        ratio = residual[x] / tolerance
        plain = one / variance[x] / (one + ratio * ratio)
        e = L[x] - M[x]
        excess[x] += plain * (e * e - expected * variance[x])
        weight[x] += plain * eta


@njit_noalloc
def _finish(begin, end, inputs, scratch, out):
    """Write all outputs but the scatter of some rows, and the sums for the scatter.

    Args:
        begin: First row.
        end: Row after the last one.
        inputs: `_MeanInputs`.
        scratch: `_MeanScratch`, whose `excess` and `weight` are written.
        out: `RobustMean`, output.
    """
    layout, warped = inputs.layout, inputs.warped
    count, _, w = warped.L.shape
    rows, zero = scratch.rows[begin], np.float32(0)
    visible, sums = rows[0], rows[1:10]
    residual, variance = rows[10 : 10 + count], rows[10 + count :]
    for y in range(begin, end):
        excess, weight, activity = scratch.excess[y], scratch.weight[y], out.activity[y]
        sums[:], excess[:], weight[:], activity[:] = zero, zero, zero, zero
        for k in range(count):
            blur_along_y(scratch.residuals[k], y, inputs.taps, residual[k])
            _fill_visibility(residual[k], inputs.tolerance, np.float32(np.inf), visible)
            _fill_variance(inputs, k, y, scratch.steepness[y], variance[k])
            _add_instant(inputs, k, y, visible, variance[k], sums)
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
            _add_excess(inputs, k, y, residual[k], variance[k], found)


def robust_mean(
    params: Params, L: NDArray, warped: WarpedImages, layout: InstantLayout
) -> RobustMean:
    """Compute the robust mean as `robust_mean_jax` does, of instants that are all present.

    Args:
        params: Parameters of `mc`.
        L: (K, h, w) float32, log intensity in place.
        warped: The images along trajectories.
        layout: Their instants.

    Returns:
        The mean and its evidence.
    """
    p = params
    count, h, w = L.shape
    target, taps = int(layout.target), gaussian_taps(RESIDUAL_SIGMA_PX)
    weights = np.exp(-2 * layout.s**2).astype(np.float32)
    low, high = (int(k) for k in activity_range(layout))
    layout = layout._replace(target=target, before=int(layout.before), after=int(layout.after))
    numbers = [np.float32(v) for v in (p.information, p.floor)]
    numbers += [np.square(np.float32(v)) for v in (p.sigma_place, p.sigma_between)]
    numbers.append(np.float32(p.tolerance))
    inputs = _MeanInputs(L, warped, layout, weights, taps, low, high, *numbers)
    rows, padded = empty_row_scratch(h, 10 + 2 * count, w), empty_row_scratch(h, w + len(taps))
    images = np.empty((3, h, w), np.float32)
    scratch = _MeanScratch(np.empty((count, h, w), np.float32), *images, rows, padded)
    out = RobustMean(
        *np.empty((7, h, w), np.float32),
        np.empty((3, h, w), np.float32),
        np.empty((2, h, w), np.float32),
        np.empty((h, w), np.float32),
    )
    before = blur_image(np.ascontiguousarray(L[target]), 1.0)
    for turn in range(3):
        run_over_rows(_update_mean, h, inputs, scratch, turn, (before, out.M))
        run_over_rows(_fill_residuals, h, inputs, scratch, out.M)
        before = out.M.copy()
    run_over_rows(_finish, h, inputs, scratch, out)
    excess, weight = (
        blur_image(part, SCATTER_SIGMA_PX) for part in (scratch.excess, scratch.weight)
    )
    return out._replace(scatter=np.maximum(excess / weight, 0))
