"""Motion of a scene past a moving camera, and the background as a map that moves along.

An image of events is aligned to those before by a shift and a turn, from coarse to fine (Lucas and
Kanade), with little weight where they differ. Chained, these motions give the places of the scene
on the sensor.

The moving background is taken only where a scene covers the sensor, dense with edges or textured,
and where its map, moved along, predicts events better than one at rest. Targets that go together,
as stars do, are no scene.
"""

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from jaxevent.blob.search.background import (
    CELL_PX,
    FINE_CELL_PX,
    N_TIME_SLICES,
    Background,
    SceneMotion,
    count_in_slices,
    move_places,
    pool,
)
from jaxevent.blob.search.config import CONFIG
from jaxevent.blob.search.detection import Blobs, clutter_model, detect, larger_variance, sum_blobs
from jaxevent.blob.search.paths import TargetPath
from jaxevent.blob.search.scale import TRIED_WINDOWS_US, ScaleSelection
from jaxevent.blob.search.stream import Stream, WindowEvents
from jaxevent.codegen import njit, njit_inlined

BLUR_SIGMAS_BINS = (4, 2, 1)  # standard deviations of blurs, from coarse to fine
MAX_GAUSS_NEWTON_STEPS, MIN_STEP_BINS = 8, 0.02  # steps, and the step at which they end
N_TILES_PER_SIDE = 4  # along each side of the sensor
# Windows in those of blobs: of a shaking scene any of them may be suitable.
TRIED_WINDOW_RATIOS = (1, 1 / 4, 1 / 16, 4)


def measure_scene_motion(stream: Stream, window: float | int) -> SceneMotion:
    """Measure the shift and turn of the whole scene, from windows aligned to those before.

    The reference is a mean of earlier windows, each moved along with the scene. Images are those of
    the part of the sensor that is not left out.

    Args:
        stream: Events.
        window: Length of the windows, s.
    """
    steps = int(min(2 * N_TIME_SLICES, stream.duration / window))
    begins = np.linspace(0, stream.duration - window, steps)
    seen = [np.flatnonzero(~stream.hot.all(axis)) for axis in (0, 1)]
    corner, size = (np.array([fit(one) for one in seen]) for fit in (np.min, np.ptp))
    bins = int(size.max()) // CONFIG.max_image_bins + 1
    shape = size[::-1] // bins + 1
    maps, motion, reference = [np.eye(2, 3)], None, None
    for number, begin in enumerate(begins):
        image = _event_image(stream.window(begin, begin + window), corner, bins, shape)
        if reference is None:
            reference = image
            continue
        motion = _align(reference, image, _offset(reference, image) if motion is None else motion)
        turn, shift = _rigid_motion(motion, shape)
        middle = corner + (bins * shape[::-1] - 1) / 2
        moved = bins * shift + middle - turn @ middle
        maps.append(turn @ maps[-1] + np.outer(moved, (0, 0, 1)))
        # Rows and columns of the image are turned back.
        middle = (shape - 1) / 2
        offset = middle - turn @ (middle + shift[::-1])
        before = ndimage.affine_transform(reference, turn, offset, order=1, cval=np.nan)
        gain = max(CONFIG.reference_gain, 1 / (number + 1))
        reference = np.where(np.isnan(before), image, (1 - gain) * before + gain * image)
    return SceneMotion(begins + window / 2, np.array(maps))


def _event_image(
    events: WindowEvents, corner: NDArray, bins: int, shape: NDArray
) -> NDArray[np.float64]:
    """Return roots of event counts in bins, whose noise is the same everywhere.

    Args:
        events: Events of a window.
        corner: (2,) x and y, px, where the image begins.
        bins: Side of a bin, px.
        shape: (2,) rows and columns of the image.

    Returns:
        (rows, columns).
    """
    row, column = (events.y - corner[1]) // bins, (events.x - corner[0]) // bins
    counts = np.bincount(row * shape[1] + column, minlength=int(shape.prod()))
    return np.sqrt(counts.reshape(shape))


def _rigid_motion(motion: NDArray, shape: NDArray) -> tuple[NDArray, NDArray]:
    """Return the rotation and shift of a motion.

    `_normal_equations` moves both images by half of it.

    Args:
        motion: (3,) motion, see `_normal_equations`.
        shape: (2,) rows and columns of the image.

    Returns:
        Rotation (2, 2) about the middle of the image, and shift (2,) in bins.
    """
    half = motion[0] / (shape.sum() / 2) * np.array([[0, -1], [1, 0]])
    after_half = np.linalg.inv(np.eye(2) - half)
    return after_half @ (np.eye(2) + half), after_half @ motion[1:]


def _offset(one: NDArray, other: NDArray) -> NDArray[np.float64]:
    """Return the motion (3,) without turn at which two images correlate most.

    Args:
        one: (rows, columns) image.
        other: (rows, columns) image.

    Returns:
        Motion from `one` to `other`, (0, right, down), bins.
    """
    a, b = (np.fft.rfft2(ndimage.gaussian_filter(i, 3) - i.mean()) for i in (one, other))
    correlation = np.fft.irfft2(b * a.conj(), one.shape)
    at = np.unravel_index(correlation.argmax(), correlation.shape)
    y, x = (int(k) if k < n / 2 else int(k) - n for k, n in zip(at, one.shape, strict=True))
    return np.array([0.0, x, y])


def _align(one: NDArray, other: NDArray, motion: NDArray) -> NDArray[np.float64]:
    """Estimate the motion that takes one image to the other.

    Args:
        one: (rows, columns) image, NaN where unknown.
        other: (rows, columns) image.
        motion: (3,) initial motion, see `_normal_equations`.

    Returns:
        (3,) motion.
    """
    for blur in BLUR_SIGMAS_BINS:
        a, b = (ndimage.gaussian_filter(image, blur, mode="constant") for image in (one, other))
        for _ in range(MAX_GAUSS_NEWTON_STEPS):
            H, gradient = _normal_equations(a, b, motion)
            H += np.eye(3) * (1e-4 * np.trace(H) / 3 + 1e-12)
            step = np.linalg.solve(H, gradient)
            motion = motion - step
            if abs(step).max() < MIN_STEP_BINS:
                break
    return motion


@njit
def _normal_equations(a: Any, b: Any, motion: Any) -> Any:
    """Return J^T W J and J^T W e of Gauss and Newton, of two images each moved half the way.

    A motion is a turn about the middle, of which one unit moves what is a quarter of the sides' sum
    away by one bin, and shifts right and down.

    Args:
        a: (rows, columns) image.
        b: (rows, columns) image.
        motion: (3,) motion.

    Returns:
        (3, 3) matrix and (3,) right-hand side.
    """
    rows, columns = a.shape
    quarter = (rows + columns) / 4
    e, mean = np.empty(a.shape), np.zeros(a.shape)
    total, number = 0.0, 0
    for row in range(rows):
        y = (row - (rows - 1) / 2) / quarter
        for column in range(columns):
            x = (column - (columns - 1) / 2) / quarter
            half_x, half_y = (motion[1] - motion[0] * y) / 2, (motion[2] + motion[0] * x) / 2
            before = _interpolate_pixel(a, row - half_y, column - half_x)
            after = _interpolate_pixel(b, row + half_y, column + half_x)
            difference = after - before
            e[row, column] = difference  # NaN where one was not seen
            if difference == difference:
                mean[row, column] = (after + before) / 2
                total += difference * difference
                number += 1
    scale = 1 / (CONFIG.outlier_scale * (np.sqrt(total / max(number, 1)) + 1e-12))
    tt = tx = ty = xx = xy = yy = st = sx = sy = 0.0
    for row in range(rows):
        y = (row - (rows - 1) / 2) / quarter
        above, below = max(row - 1, 0), min(row + 1, rows - 1)
        for column in range(columns):
            difference = e[row, column]
            if not difference == difference:
                continue
            x = (column - (columns - 1) / 2) / quarter
            left, right = max(column - 1, 0), min(column + 1, columns - 1)
            gx = (mean[row, right] - mean[row, left]) / (right - left)
            gy = (mean[below, column] - mean[above, column]) / (below - above)
            gt = x * gy - y * gx
            weight = 1 / (1 + (difference * scale) ** 2)
            wt, wx, wy = weight * gt, weight * gx, weight * gy
            st, sx, sy = st + wt * difference, sx + wx * difference, sy + wy * difference
            tt, tx, ty = tt + wt * gt, tx + wt * gx, ty + wt * gy
            xx, xy, yy = xx + wx * gx, xy + wx * gy, yy + wy * gy
    H = np.array([[tt, tx, ty], [tx, xx, xy], [ty, xy, yy]])
    return H, np.array([st, sx, sy])


@njit_inlined
def _interpolate_pixel(image: Any, y: float, x: float) -> float:
    """Interpolate an image linearly; NaN outside.

    Args:
        image: (rows, columns).
        y: Row, px.
        x: Column, px.

    Returns:
        The value.
    """
    rows, columns = image.shape
    if not (0 <= y <= rows - 1 and 0 <= x <= columns - 1):
        return np.nan
    row, column = min(int(y), rows - 2), min(int(x), columns - 2)
    v, u = y - row, x - column
    top = (1 - u) * image[row, column] + u * image[row, column + 1]
    return (1 - v) * top + v * ((1 - u) * image[row + 1, column] + u * image[row + 1, column + 1])


def split_at_pauses(background: Background) -> list[tuple[float, float]]:
    """Split the recording into spans (s) in which most of a scene is quiet, and those between.

    Shorter spans than `SearchConfig.min_windows` join those about them. Without pauses the
    whole is one span.
    """
    full = float(np.quantile(background.level, CONFIG.nearly_all))
    long = np.ones(CONFIG.min_windows)
    quiet = ndimage.binary_opening(background.level < CONFIG.considerable * full, long)
    moves = ndimage.binary_opening(~quiet, long)
    first = np.flatnonzero(np.diff(moves)) + 1 if background.is_dense else []
    edges = np.array([0, *first, N_TIME_SLICES]) / N_TIME_SLICES * background.duration
    return list(zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True))


def find_scene(
    stream: Stream, background: Background, selection: ScaleSelection
) -> tuple[bool, Background | None]:
    """Find whether a scene covers the sensor, and measure the background as a map that moves.

    Args:
        stream: Events.
        background: Background at rest.
        selection: Scale of its blobs.

    Returns:
        Whether a scene seems to move over most of the sensor; and the moving background, which is
        None if the events do not show that it moves, as where the scene hardly leaves its place.
    """
    tiles = _count_filled_tiles(stream, background, selection)
    if tiles <= CONFIG.majority * N_TILES_PER_SIDE**2:
        return False, None
    covered, longest = False, stream.duration / CONFIG.min_windows
    # Blobs may be seen in longer windows than a scene's motion; these are halves of each other.
    usual = selection.scale.window / (2 if selection.scale.window > longest else 1)
    for ratio in TRIED_WINDOW_RATIOS:
        window = ratio * usual
        if not TRIED_WINDOWS_US[0] * 1e-6 <= window <= longest:
            continue
        scene = measure_scene_motion(stream, window)
        moving = measure_moving_background(stream, scene)
        gain = _required_gain(moving)
        if gain is None:
            break
        if scene.travel >= CONFIG.min_travel_px:
            covered = True
            if map_gain(stream, moving, window) >= gain:
                return True, moving
    return covered, None


def _required_gain(moving: Background) -> float | None:
    """Return the nats per event that a scene's map must gain by moving; None if it is no scene.

    A scene consists of edges, or of a texture of which much is bright, by more than chance makes
    of few events.
    """
    visible = moving.visible
    events = moving.mean_rate * FINE_CELL_PX**2 * moving.duration
    edges = _edge_share(np.where(visible, moving.rate, 0), moving.mean_rate)
    few = events < CONFIG.min_blob_events
    if edges >= (CONFIG.scene_edge_share_few if few else CONFIG.scene_edge_share):
        return 0.0
    bright = float((moving.rate[visible] > CONFIG.edge_rate * moving.mean_rate).mean())
    texture = events >= CONFIG.min_fine_events and bright > CONFIG.scene_edge_share
    return CONFIG.min_gain if texture else None


def map_gain(stream: Stream, moving: Background, w: float | int) -> float:
    """Compute the gain of a map that moves over one at rest, in most windows.

    Things that move differently are no scene: where they are, some places gain, and others lose.

    Args:
        stream: Events.
        moving: The background whose map moves.
        w: Length of the windows, s.

    Returns:
        Nats per event; minus infinity unless nearly all that places gain or lose is gain.
    """
    scene = moving.scene
    assert scene is not None
    rest = dataclasses.replace(scene, maps=np.broadcast_to(np.eye(2, 3), scene.maps.shape))
    still, gains = measure_moving_background(stream, rest), []
    tiles, area = np.zeros((N_TILES_PER_SIDE,) * 2), [(0, stream.height), (0, stream.width)]
    for t in np.maximum(stream.quantile_times(CONFIG.scale_trials), w):
        part = stream.window(t - w, t)
        one, other = (b.rate_at(part.x, part.y, part.t) for b in (moving, still))
        nats = np.log(one / other)
        gains.append(float(nats.mean()) if len(part) else 0.0)
        tiles += np.histogram2d(part.y, part.x, N_TILES_PER_SIDE, area, weights=nats)[0]
    agree = np.maximum(tiles, 0).sum() >= CONFIG.nearly_all * abs(tiles).sum()
    return float(np.quantile(gains, 1 - CONFIG.nearly_all)) if agree else -np.inf


def _count_filled_tiles(stream: Stream, background: Background, selection: ScaleSelection) -> float:
    """Count the tiles of the sensor that hold blobs, in the median window.

    It is 0 if blobs seldom reach three of the sensor's sides: an object may be large, but it is
    seen whole. Blobs stand out from the sensor's dark places here: in a short recording a scene
    hardly leaves its place, and most of it is in the background.
    """
    w, (rows, columns) = selection.scale.window, stream.shape
    dark = np.full_like(background.rate, np.quantile(background.rate, 1 - CONFIG.nearly_all))
    background = dataclasses.replace(background, rate=dark)
    tiles, sides, few, width = [], [], CONFIG.min_blob_events, CONFIG.side_width
    for t in np.maximum(stream.quantile_times(CONFIG.scale_trials), w):
        part = stream.window(t - w, t)
        clutter = clutter_model(background, selection.scale, stream.shape, t)
        labels, _ = detect(part, clutter, stream.shape)
        y, x = part.y[labels > 0], part.x[labels > 0]
        filled, *_ = np.histogram2d(y, x, N_TILES_PER_SIDE, [(0, rows), (0, columns)])
        tiles.append((filled >= few).sum())
        edges = (x, columns), (columns - 1 - x, columns), (y, rows), (rows - 1 - y, rows)
        strips = [width * v < n for v, n in edges]
        sides.append(sum(strip.sum() >= few for strip in strips))
    wide = np.mean(np.array(sides) > CONFIG.majority * 4) >= CONFIG.considerable
    return float(np.median(tiles)) if wide else 0.0


def _edge_share(rate: NDArray[np.float64], mean: float) -> float:
    """Compute the share of the bright that is long or large: edges, and not possible targets.

    Args:
        rate: (rows, columns) rates of cells, 1/(px s).
        mean: Mean rate, 1/(px s).

    Returns:
        Share, 0..1.
    """
    excess = np.where(rate > CONFIG.edge_rate * mean, rate - mean, 0)
    labels = np.zeros(rate.shape, np.int32)
    ndimage.label(excess > 0, np.ones((3, 3)), labels)
    number = int(labels.max())
    y, x = np.nonzero(excess)
    parts = Blobs.zeros(number)
    sum_blobs(x, y, excess[y, x], labels[y, x], number, parts)
    square = larger_variance(parts.C)
    rest = np.maximum(np.trace(parts.C, axis1=1, axis2=2) - square, 0)
    long = square > CONFIG.edge_aspect**2 * rest
    long &= square > CONFIG.edge_min_size_cells**2
    large = square > ((1 - CONFIG.nearly_all) * min(rate.shape)) ** 2
    return float(parts.n[long | large].sum() / max(parts.n.sum(), 1e-300))


def has_own_motion(path: TargetPath, scene: SceneMotion, start: int) -> bool:
    """Return whether a target goes farther than its size, and a cell, on a way of its own.

    What is nearer or farther than most of the scene goes the scene's way, faster or slower. So the
    path across the scene's motion counts, and along it only what goes against it. What goes another
    way in every window is no target, but parts of the scene that are seen by turns.

    Args:
        path: Path of the target.
        scene: Motion of the scene.
        start: Start of the stream, us.
    """
    window, size = path.window * 1e-6, float(np.median(path.size[:, 0]))
    if path.velocity_noise * window**3 / 3 > (CONFIG.own_way_erratic_sizes * size) ** 2:
        return False
    t = np.asarray((path.t - start) * 1e-6, np.float64)
    if len(t) < 2:
        return False
    # From each window to the next, and the scene's motion from the same place.
    moved, before = np.diff(path.p, axis=0), path.p[:-1]
    carried = move_places(scene.at(t[1:]), *move_places(scene.to_scene(t[:-1]), *before.T))
    flow = np.stack(carried, 1) - before
    along = flow / np.maximum(np.hypot(*flow.T), 1e-9)[:, None]
    own = moved - np.maximum((moved * along).sum(1), 0)[:, None] * along
    way = np.cov(np.concatenate([[[0, 0]], np.cumsum(own, 0)]).T)
    ratio = np.linalg.solve(np.median(path.C, 0) + FINE_CELL_PX**2 * np.eye(2), way)
    return bool(np.linalg.eigvals(ratio).real.max() > CONFIG.common_way_sizes**2)


def drop_edges(paths: list[TargetPath], covered: bool) -> list[TargetPath]:
    """Return paths without edges of a scene.

    What goes farther than it is long has events of both polarities. One lone edge may be all that
    is seen of an object, or two that nothing connects; more, of both polarities, are a scene's.

    Args:
        paths: Paths of targets, with their balances of polarities.
        covered: Whether a scene seems to move over most of the sensor: then what has one polarity
            is an edge of it, whatever its shape.
    """
    if covered:
        return [path for path in paths if not path.has_one_polarity]
    signs = [path.balance > 0 for path in paths if path.lone_edge]
    if len(signs) < 3 or len(set(signs)) < 2:
        return paths
    return [path for path in paths if not path.lone_edge]


def measure_moving_background(stream: Stream, scene: SceneMotion) -> Background:
    """Measure rates of a scene's places while they are seen, from the calmer slices.

    What goes its own way is nowhere in the scene for long.

    Args:
        stream: Events.
        scene: Motion of the scene.
    """
    size = np.array([stream.width, stream.height])
    middles = (np.arange(N_TIME_SLICES) + 0.5) / N_TIME_SLICES * stream.duration
    x, y = (np.array([[0, 1, 0, 1], [0, 0, 1, 1]]) * (size[:, None] - 1))[..., None]
    places = np.stack(move_places(scene.to_scene(middles), x, y))
    low = np.floor(places.min((1, 2)))
    columns, rows = ((places.max((1, 2)) - low) // CELL_PX + 1).astype(int).tolist()
    corner = int(low[0]), int(low[1])

    y, x = np.mgrid[:rows, :columns] * CELL_PX + CELL_PX / 2
    x, y = move_places(scene.at(middles), x[..., None] + low[0], y[..., None] + low[1])
    seen = np.moveaxis((x >= 0) & (x < size[0]) & (y >= 0) & (y < size[1]), 2, 0)
    by = CELL_PX // FINE_CELL_PX
    cells = count_in_slices(stream, (rows * by, columns * by), scene, corner)

    N = np.where(seen, pool(cells, by), np.inf)
    rank = np.ceil((1 - CONFIG.considerable) * seen.sum(0)).astype(int) - 1
    most = np.take_along_axis(np.sort(N, 0), np.maximum(rank, 0)[None], 0)[0]
    calm = seen & (N <= most)
    activity = _slice_activity(N, calm, seen)
    there = np.kron(calm, np.ones((1, by, by))) > 0
    expected = (there * activity[:, None, None]).sum(0)
    rate = (cells * there).sum(0) / np.maximum(expected, 1) / FINE_CELL_PX**2
    known = expected > 0
    usual = max(float(rate[known].mean()), 0.02 / CELL_PX**2)
    rate = np.where(known, np.maximum(rate, CONFIG.min_rate_share * usual), usual)
    rate = rate * N_TIME_SLICES / stream.duration
    bright = np.ones((rows, columns), bool)
    return Background(rate, calm, bright, activity, stream.duration, scene, corner)


def _slice_activity(N: NDArray, calm: NDArray, seen: NDArray) -> NDArray[np.float64]:
    """Compute the activity of each slice: the median ratio of its counts to calm ones.

    Args:
        N: (slices, rows, columns) counts.
        calm: (slices, rows, columns) whether a cell is without target.
        seen: (slices, rows, columns) whether a cell is seen.

    Returns:
        (slices,) ratios.
    """
    mean = np.where(calm, N, 0).sum(0) / np.maximum(calm.sum(0), 1)
    full = mean >= CONFIG.min_dispersion_events
    ratios = np.array([
        np.median(n[s & full] / mean[s & full]) if (s & full).any() else 1.0
        for n, s in zip(N, seen, strict=True)
    ])  # fmt: skip
    return np.clip(ratios / max(float(np.median(ratios)), 1e-9), 0.1, 10)
