"""Figures and videos of tracks: paths in the image, ellipses and trails, quantities over time.

Arrays are those of `jaxevent.show.tracks`.
"""

import colorsys
import functools
import itertools
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Array
from numpy.typing import ArrayLike, NDArray
from PIL import Image, ImageDraw, ImageFont

from jaxevent.blob.quantities import SIZE_FACTORS, inverse_ttc, inverse_ttc_from_size, size_range
from jaxevent.errors import InputError
from jaxevent.events import count_events
from jaxevent.precision import to_jax
from jaxevent.recording import Recording, Times
from jaxevent.show.images import COLOURS, new_figure, save_figure
from jaxevent.show.track_tables import check_tracks

_BACKGROUND, _ON, _OFF = (24, 24, 28), (235, 235, 235), (110, 130, 190)  # RGB of a video
_MIN_VIDEO_HEIGHT_PX = (
    480  # smaller sensors are enlarged in a video, so that lines and numbers can be seen
)
_MAX_VIDEO_WIDTH_PX = 1920  # of those that are enlarged: no codec takes a row of 64 px by 480
_MAX_BACKGROUND_EVENTS = 1_000_000  # most events behind the paths
_N_PATH_ELLIPSES = 6  # along a path
_GROWTH_SIGMAS, _GROWTH_SHARE = 3.0, 0.2  # of a growth from 0, and share of its times
_MIN_GROWTH_RATIO = 1.2  # ratio of sizes of a target that grows
_MIN_AXES_RATIO = 0.5  # change of one axis, as a share of the other's
_MONOTONE_SHARE = 0.8  # share of all changes that are growth, or shrinking
_MIN_SIZE_PX = 2.0  # px along the shorter axis; smaller spots are as large as pixels
_N_LIFE_PARTS = 8  # parts of a life, whose median sizes are compared
_CHANGE_SIGMAS = 2.0  # standard deviations of the change; errors within a part are alike
_MAX_CURVES = 6  # tracks in the panels over time
_MAX_LEGEND_LINES = 16  # lines that a legend lists
_SIZE, _TTC, _RANGE = "lambda (px)", "1 / TTC (1/s)", "range (m)"
_BAND_ALPHA = 0.2
_PAIR_LINE_STYLES = ("-", "--", ":", "-.")  # lines of pairs


def track_frames(
    recording: Recording,
    times: Times,
    ids: ArrayLike,
    mean: ArrayLike,
    valid: ArrayLike,
    *,
    images: Iterable[NDArray] | None = None,
    sigmas: float | int = 2.0,
    trail: float | int = 0.3,
    window: float | int | None = None,
    scale: int | None = None,
) -> Iterator[NDArray[np.uint8]]:
    """Draw the tracks alive at each of some times.

    A track is an ellipse, its id, and its latest way, in a colour of its own. Behind are the latest
    events, ON white and OFF blue, or images.

    Args:
        recording: Recording of the tracks.
        times: (T,) sorted times, us or s.
        ids: (N,) ids of the tracks.
        mean: (T, N, 8) states.
        valid: (T, N) whether a track exists.
        images: T uint8 images of the sensor's size, grey or colour; None for events.
        sigmas: Standard deviations of the ellipse.
        trail: Length of the way, s.
        window: Length of the events, s; None for the time since the picture before.
        scale: Enlargement; None: up to 480 rows, where these have no more than 1920 columns.

    Yields:
        Pictures (scale height, scale width, 3), uint8.

    Raises:
        InputError: Arrays do not fit each other or the sensor.
    """
    t, number, mean, _, valid = check_tracks(recording.name, times, ids, mean, None, valid)
    if (np.diff(t) < 0).any():
        raise InputError(f"{recording.name}: the times of a video are not sorted; sort them")
    states = zip(mean, valid & np.isfinite(mean).all(-1), strict=True)
    style = {"sigmas": sigmas, "trail": trail, "window": window, "scale": scale}
    yield from draw_frames(recording, t, number, states, images, **style)


def draw_frames(
    recording: Recording,
    t: NDArray[np.int64],
    track_ids: NDArray,
    states: Iterable[tuple[NDArray, NDArray]],
    images: Iterable[NDArray] | None,
    *,
    sigmas: float | int = 2.0,
    trail: float | int = 0.3,
    window: float | int | None = None,
    scale: int | None = None,
) -> Iterator[NDArray[np.uint8]]:
    """Draw `track_frames` of states that come one by one.

    Args:
        recording: Recording of the tracks.
        t: (T,) sorted times, us.
        track_ids: (N,) ids.
        states: For each time the states (N, 8), and whether each is valid (N,).
        images: Images behind the tracks, (height, width[, 3]) uint8; None: the events.
        sigmas: Size of the ellipses, standard deviations.
        trail: Length of the trails, s.
        window: Time in which events are shown, s; None: between two images.
        scale: Enlargement; None: by the sensor's size.

    Yields:
        Images, uint8.

    Raises:
        InputError: An image behind the tracks is missing, or has another shape or type.
    """
    if scale is None:
        scale = math.ceil(_MIN_VIDEO_HEIGHT_PX / recording.height)
        scale = max(1, min(scale, _MAX_VIDEO_WIDTH_PX // recording.width))
    if window is None:
        window = float(np.median(np.diff(t))) * 1e-6 if len(t) > 1 else 0.01
    events = _event_images(recording, t, round(window * 1e6)) if images is None else images
    colours = [track_colour(int(n)) for n in track_ids]
    behind, font = iter(events), ImageFont.load_default(14)
    ways: dict[int, list[tuple[int, NDArray]]] = {}  # of the tracks alive: times and places
    for k, (now, (mean, valid)) in enumerate(zip(t.tolist(), states, strict=True)):
        image = next(behind, None)
        size = (recording.height, recording.width)
        if image is None or image.shape[:2] != size or image.dtype != np.uint8:
            found = "none" if image is None else f"{image.dtype} of shape {image.shape}"
            raise InputError(
                f"{recording.name}: image {k} of {len(t)} behind the tracks is {found}; give uint8 "
                f"of {size}, grey or colour, for each time"
            )
        large = Image.fromarray(image).convert("RGB")
        if scale > 1:
            wide, high = (scale * side for side in large.size)
            large = large.resize((wide, high), Image.Resampling.NEAREST)
        draw = ImageDraw.Draw(large)
        first = now - round(trail * 1e6)
        ways = {int(i): ways.get(int(i), []) for i in np.flatnonzero(valid)}
        for i, way in ways.items():
            way.append((now, mean[i, :2]))
            while way[0][0] < first:
                way.pop(0)
            _line(draw, np.stack([place for _, place in way]), colours[i], scale, 1)
            ellipse = outline(mean[i], sigmas)
            _line(draw, ellipse, colours[i], scale, 2)
            x, y = _large(np.array([ellipse[:, 0].max(), ellipse[:, 1].min()]), scale)
            draw.text((x, y), str(track_ids[i]), fill=colours[i], font=font, anchor="ls")
        yield np.asarray(large)


def track_colour(track_id: int) -> tuple[int, int, int]:
    """Return red, green and blue (0 to 255) of a track; neighbouring ids differ."""
    hue = (0.07 + track_id * 0.618034) % 1
    r, g, b = colorsys.hsv_to_rgb(hue, 0.65, 1.0)
    return round(255 * r), round(255 * g), round(255 * b)


def _event_images(
    recording: Recording, times: NDArray[np.int64], window: int
) -> Iterator[NDArray[np.uint8]]:
    """Draw the events of windows that end at some times, the last one of a pixel on top.

    Args:
        recording: The recording.
        times: (T,) ends of the windows, us; each one counts.
        window: Length of the windows, us.

    Yields:
        (H, W, 3) images.
    """
    for t in times:
        image = np.full((recording.height, recording.width, 3), _BACKGROUND, np.uint8)
        first, last = (recording.events.index(int(at)) for at in (t - window + 1, t + 1))
        part = recording.events[first:last]
        image[part.y, part.x] = np.where(part.p[:, None], _ON, _OFF)
        yield image


def outline(ellipse_state: NDArray, sigmas: float | int) -> NDArray[np.float64]:
    """Return points on the outline of a state's ellipse.

    Args:
        ellipse_state: (8,) state, as of `TrackStates`.
        sigmas: Half axes of the outline, in standard deviations.

    Returns:
        (49, 2) x and y, px, the last point the first one.
    """
    angle = np.linspace(0, 2 * np.pi, 49)
    u, v = sigmas * ellipse_state[4] * np.cos(angle), sigmas * ellipse_state[5] * np.sin(angle)
    c, s = np.cos(ellipse_state[6]), np.sin(ellipse_state[6])
    return np.stack([ellipse_state[0] + c * u - s * v, ellipse_state[1] + s * u + c * v], 1)


def _large(points: NDArray, scale: int) -> tuple[float, ...]:
    """Convert points to places in an enlarged image, as Pillow takes them.

    Args:
        points: (n, 2) x and y, px.
        scale: Factor of enlargement.

    Returns:
        x and y by turns, px of the enlarged image.
    """
    return tuple(((points + 0.5) * scale - 0.5).clip(-1e5, 1e5).ravel().tolist())


def _line(draw, points: NDArray, colour: tuple[int, int, int], scale: int, width: int) -> None:
    if len(points) > 1:
        draw.line(_large(points, scale), fill=colour, width=width)


def write_track_plot(
    path: str | Path,
    recording: Recording,
    times: Times,
    ids: ArrayLike,
    mean: ArrayLike,
    covariance: ArrayLike,
    *,
    valid: ArrayLike,
    pairs: Sequence[tuple[int, int]] = (),
    extent: float | int | None = None,
    focal: float | int | None = None,
    size_factor: float | int = SIZE_FACTORS["ring"],
    Q: float | int = 0.01,
    Q_lambda: Sequence[float] | None = None,
    smoothed: bool = False,
    total: int | None = None,
) -> None:
    """Draw the paths of tracks and, over time, their sizes, with bands of two standard deviations.

    Over time are the six tracks that are seen longest, and those of pairs. Paths are drawn over the
    events, coloured by time, with ellipses of two standard deviations at intervals. 1 / TTC of a
    track is that of its size (`quantities.inverse_ttc_from_size`, smoothed). It is drawn if it
    differs from 0 and both axes, larger than pixels, grow alike and one way, as those of an
    approaching object do.
    Time counts from the recording's start.

    Args:
        path: File that is written, PNG, PDF or SVG by its suffix.
        recording: Recording of the tracks.
        times: (T,) sorted times, us or s.
        ids: (N,) ids of the tracks.
        mean: (T, N, 8) states.
        covariance: (T, N, 8, 8) their covariances.
        valid: (T, N) whether a track exists.
        pairs: Ids of two tracks each, whose 1 / TTC is drawn.
        extent: Size of the objects, m, for their range.
        focal: Focal length, px, for their range.
        size_factor: Size of a blob over that of its object's image.
        Q: Process noise of the growth.
        Q_lambda: (N,) process noises of the sizes; None for that of `inverse_ttc_from_size`.
        smoothed: Whether the tracks are smoothed.
        total: Number of all tracks, of which these are a part.

    Raises:
        InputError: The extra "plot" is missing, an id or the suffix is unknown, or arrays do not
            fit.
    """
    t, number, mean, covariance, valid = check_tracks(path, times, ids, mean, covariance, valid)
    known = number.tolist()
    for pair in pairs:
        if not (len(set(pair)) == 2 and set(pair) <= set(known)):
            raise InputError(f"{path}: the pair {pair} is not two of the tracks {known}")
    if (extent is None) != (focal is None):
        raise InputError(f"{path}: range needs both the extent (m) and the focal length (px)")
    all_ids, all_states = known, (mean, valid)
    shown = _choose_longest(valid, [known.index(one) for pair in pairs for one in pair])
    known, mean, covariance, valid = (
        number[shown].tolist(), mean[:, shown], covariance[:, shown], valid[:, shown],
    )  # fmt: skip
    filled = np.where(valid[..., None], mean, 1.0)
    filled_P = np.where(valid[..., None, None], covariance, np.eye(8))
    m, P = to_jax(filled), to_jax(filled_P)
    noise = None if Q_lambda is None else np.asarray(Q_lambda, m.dtype)[shown]
    grown, spread, grows = _growths(t, m, P, valid, Q, noise, smoothed=smoothed)
    sizes = filled[..., 4:6], np.diagonal(filled_P, axis1=2, axis2=3)[..., 4:6]
    grows &= _changes_scale(*sizes, valid)

    further = [_TTC] * bool(grows.any() or len(pairs)) + [_RANGE] * (extent is not None)
    names = [_SIZE, *further] if valid.any() else []
    high = 7.0 * min(recording.height / recording.width, 1.2)
    figure = new_figure(8, high + 2.2 * len(names))
    grid = figure.add_gridspec(1 + len(names), 1, height_ratios=[high, *([2.2] * len(names))])
    seconds = (t - recording.start) * 1e-6
    draw_paths(figure.add_subplot(grid[0]), recording, t, all_ids, all_states, total=total)
    bands = _Bands({name: figure.add_subplot(grid[k + 1]) for k, name in enumerate(names)}, seconds)
    ranges = None
    if extent is not None and focal is not None:
        ranges = jax.jit(size_range)(m, P, extent, focal, size_factor)
    _draw_states(bands, known, valid, sizes, (grown, spread, grows), ranges)
    for pair, ls in zip(pairs if names else (), itertools.cycle(_PAIR_LINE_STYLES)):
        a, b = (known.index(one) for one in pair)
        value, variance = jax.jit(inverse_ttc)(m[:, a], P[:, a], m[:, b], P[:, b])
        line = {"color": "black", "ls": ls, "label": f"{pair[0]} and {pair[1]}"}
        bands.add(_TTC, value, variance, valid[:, a] & valid[:, b], **line)
    bands.finish(len(known), len(number) if total is None else total)
    save_figure(figure, path)


def _draw_states(
    bands: "_Bands",
    known: Sequence[int],
    valid: NDArray[np.bool_],
    sizes: tuple[NDArray, NDArray],
    growths: tuple[NDArray, NDArray, NDArray],
    ranges: tuple[Array, Array] | None,
) -> None:
    """Draw sizes, growth and range of tracks, each with its variance.

    Args:
        bands: Panels.
        known: (N,) ids.
        valid: (T, N) whether a track is seen.
        sizes: Both sizes (T, N, 2), px, and their variances.
        growths: 1 / TTC (T, N), 1/s, its variance, and the tracks (N,) for which it is drawn.
        ranges: Ranges (T, N), m, and their variances; None: not drawn.
    """
    grown, spread, grows = growths
    for i in np.flatnonzero(valid.any(0)).tolist():
        one, seen, label = known[i], valid[:, i], f"{known[i]}"
        colour = COLOURS[i % len(COLOURS)]
        for axis, more in enumerate(({"label": label}, {"ls": "--"})):
            size, variance = (part[:, i, axis] for part in sizes)
            bands.add(_SIZE, size, variance, seen, colour, **more)
        if grows[i]:
            bands.add(_TTC, grown[:, i], spread[:, i], seen, colour, label=f"{one}, growth")
        if ranges is not None:
            value, variance = ranges
            bands.add(_RANGE, value[:, i], variance[:, i], seen, colour, label=label)


def _choose_longest(valid: NDArray[np.bool_], also: Sequence[int]) -> NDArray[np.bool_]:
    """Choose the tracks that are seen at the most times, and some others.

    Args:
        valid: (times, tracks) whether a track is seen.
        also: Indices of the others.

    Returns:
        (tracks,) whether a track is chosen.
    """
    shown = np.zeros(valid.shape[1], bool)
    shown[np.argsort(-valid.sum(0), kind="stable")[:_MAX_CURVES]] = True
    shown[list(also)] = True
    return shown


def _changes_scale(
    sizes: NDArray, variances: NDArray, valid: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Return the tracks that change both of their sizes alike: they approach or recede.

    A target that turns, or comes into sight, changes one size. A target that flickers, or takes
    events of others for a while, grows and shrinks by turns. One as small as pixels has their size,
    and one that is seen shortly changes by no more than its errors.

    Args:
        sizes: (T, N, 2), px.
        variances: (T, N, 2), px^2.
        valid: (T, N) whether a track is seen.

    Returns:
        (N,) booleans.
    """
    alike = np.zeros(valid.shape[1], bool)
    for i, seen in enumerate(valid.T):
        parts = np.array_split(np.log(sizes[seen, i]), _N_LIFE_PARTS)
        errors = np.array_split((variances[seen, i] / sizes[seen, i] ** 2).sum(1), _N_LIFE_PARTS)
        if len(parts[-1]):
            medians = np.array([np.median(part, axis=0) for part in parts])
            if np.median(medians.min(1)) < np.log(_MIN_SIZE_PX):
                continue
            mean = medians.sum(1)
            most, least = mean.argmax(), mean.argmin()
            change = medians[most] - medians[least]
            error = np.sqrt(np.median(errors[most]) + np.median(errors[least]))
            ratio = _MIN_AXES_RATIO
            both = change.min() > ratio * change.max() > ratio * np.log(_MIN_GROWTH_RATIO)
            both = both and change.sum() > _CHANGE_SIGMAS * error
            alike[i] = both and np.ptp(mean) > _MONOTONE_SHARE * abs(np.diff(mean)).sum()
    return alike


def _growths(
    t: NDArray[np.int64],
    m: Array,
    P: Array,
    valid: NDArray[np.bool_],
    Q: float | int,
    Q_lambda: NDArray | None,
    *,
    smoothed: bool,
) -> tuple[NDArray, NDArray, NDArray]:
    """Compute 1 / TTC of tracks by their growth.

    Args:
        t: (T,) times, us.
        m: (T, N, 8) states.
        P: (T, N, 8, 8) covariances.
        valid: (T, N) whether a track is seen.
        Q: See `inverse_ttc_from_size`.
        Q_lambda: (N,), see `inverse_ttc_from_size`; None: independent errors.
        smoothed: Whether the tracks are smoothed.

    Returns:
        1 / TTC (T, N), 1/s, its variance, and the tracks (N,) where it is significantly not 0.
    """
    since = to_jax(((t - t[0]) * 1e-6).astype(m.dtype))
    one = functools.partial(inverse_ttc_from_size, since, Q=Q, smoothed=smoothed)
    all_tracks = jax.vmap(
        lambda m, P, seen, noise: one(m, P, seen, Q_lambda=noise),
        in_axes=(1, 1, 1, None if Q_lambda is None else 0),
        out_axes=1,
    )
    # Compiled as one program, not as one for each step outside of `inverse_ttc_from_size`.
    grown, spread = jax.jit(all_tracks)(m, P, valid, Q_lambda)
    grown, spread = np.asarray(grown, np.float64), np.asarray(spread, np.float64)
    clear = valid & (np.abs(grown) > _GROWTH_SIGMAS * np.sqrt(np.maximum(spread, 0)))
    return grown, spread, clear.sum(0) > _GROWTH_SHARE * np.maximum(valid.sum(0), 1)


class _Bands:
    """Panels of lines over time, with bands of two standard deviations."""

    def __init__(self, axes: Mapping[str, Any], seconds: NDArray[np.float64]):
        self.axes, self.seconds = axes, seconds
        self.bounds: list[float] = []
        for axis in list(axes.values())[1:]:
            axis.sharex(axes[_SIZE])

    def add(self, name: str, value: Any, variance: Any, seen: NDArray, color: str, **line: Any):
        deviation = np.sqrt(np.maximum(np.asarray(variance, np.float64), 0))
        value = np.where(seen & np.isfinite(deviation), np.asarray(value, np.float64), np.nan)
        self.axes[name].plot(self.seconds, value, color=color, lw=1.3, **line)
        low, high = value - 2 * deviation, value + 2 * deviation
        self.axes[name].fill_between(self.seconds, low, high, color=color, alpha=_BAND_ALPHA, lw=0)
        if name == _TTC and np.isfinite(value).any():
            # Before anything has been measured a band reaches beyond every scale.
            clear = np.isfinite(value) & (deviation <= 3 * np.nanmedian(deviation[seen]))
            self.bounds += [float(np.nanmin(low[clear])), float(np.nanmax(high[clear]))]

    def finish(self, shown: int, total: int) -> None:
        """Label the panels of tracks."""
        legend = 0 < shown <= _MAX_LEGEND_LINES
        some = "" if shown == total else f" of the {shown} tracks seen longest"
        if not self.axes:
            return
        for name, axis in self.axes.items():
            axis.set_ylabel(name)
            axis.spines[["top", "right"]].set_visible(False)
            if legend:
                axis.legend(fontsize=8, frameon=False, loc="center left", bbox_to_anchor=(1, 0.5))
        if self.bounds:
            self.axes[_TTC].set_ylim(min(self.bounds), max(self.bounds) + 1e-9)
        title = f"lambda1 solid, lambda2 dashed{some}; bands: 2 standard deviations"
        self.axes[_SIZE].set_title(title, fontsize=9)
        list(self.axes.values())[-1].set_xlabel("t (s) from the recording's start")


def draw_paths(
    axis: Any,
    recording: Recording,
    t: NDArray[np.int64],
    ids: Sequence[int],
    states: tuple[NDArray, NDArray[np.bool_]],
    total: int | None = None,
) -> None:
    """Draw paths in the image plane over the number of events of each pixel.

    Time is colour. Ellipses of two standard deviations stand at intervals, a track's id where it
    ends. Behind are the events of that time, at most a million in its middle.

    Args:
        axis: Axes of matplotlib.
        recording: Recording of the tracks.
        t: (T,) sorted times, us.
        ids: Ids of the N tracks.
        states: States (T, N, 8), and their validity (T, N).
        total: Number of all tracks, of which these are a part.
    """
    from matplotlib.collections import LineCollection

    (mean, valid), seconds = states, (t - recording.start) * 1e-6
    first, last = (recording.events.index(int(at)) for at in (t[0], t[-1] + 1))
    middle = max(first, (first + last - _MAX_BACKGROUND_EVENTS) // 2)
    events = recording.events[middle : min(last, middle + _MAX_BACKGROUND_EVENTS)]
    behind = np.log1p(count_events(events, size=(recording.width, recording.height)))
    axis.imshow(behind, "Greys", vmin=0, vmax=2 * max(float(np.percentile(behind, 99.9)), 0.5))
    lines = None
    for i, one in enumerate(ids):
        seen = np.flatnonzero(valid[:, i] & np.isfinite(mean[:, i]).all(1))
        if not len(seen):
            continue
        places = mean[seen, i, :2]
        parts = np.stack([places[:-1], places[1:]], 1)[np.diff(seen) == 1]
        lines = LineCollection(list(parts), lw=1.5, cmap="viridis")
        lines.set_array(seconds[seen[:-1]][np.diff(seen) == 1])
        lines.set_clim(seconds[0], max(float(seconds[-1]), float(seconds[0]) + 1e-9))
        axis.add_collection(lines)
        for k in np.unique(np.linspace(0, len(seen) - 1, _N_PATH_ELLIPSES).astype(np.int64)):
            colour = lines.to_rgba(seconds[seen[k]])
            axis.plot(*outline(mean[seen[k], i], 2.0).T, color=colour, lw=0.8)
        axis.annotate(
            str(one), places[-1], (4, 4), textcoords="offset points", color=COLOURS[-1], fontsize=9,
            weight="bold",
        )  # fmt: skip
    if lines is not None:
        axis.figure.colorbar(lines, ax=axis, fraction=0.03, pad=0.01, label="t (s)")
    axis.set(xlim=(-0.5, recording.width - 0.5), ylim=(recording.height - 0.5, -0.5))
    axis.set(xlabel="x (px)", ylabel="y (px)")
    some = ""
    if total is not None and total > len(ids):
        some = f" of the {len(ids)} of {total} tracks seen longest"
    title = f"paths{some}, ellipses of 2 standard deviations, numbers where they end"
    axis.set_title("events; no track" if lines is None else title, fontsize=9)
