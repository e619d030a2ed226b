"""Figures of a motion: components over time, events warped along it, and their flow."""

import dataclasses
import functools
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from numpy.typing import NDArray

from jaxevent.egomotion import flow as event_flow
from jaxevent.egomotion.candidates import pixel_coordinates
from jaxevent.egomotion.flow import Flow
from jaxevent.egomotion.geometry import blur, image_variance, splat
from jaxevent.egomotion.models import Model, Numeric, Part
from jaxevent.egomotion.motion import MotionEstimate, is_observable
from jaxevent.egomotion.scores import axis_error, endpoint_error
from jaxevent.egomotion.truth import KnownMotion
from jaxevent.estimator import Estimate
from jaxevent.recording import Events, Recording
from jaxevent.show.images import new_figure, save_figure

_MAX_TIMES = 4096  # times of the plot
_MAX_PARTICLES = 30_000  # particles of a component in the plot
_WINDOW_SHIFT_PX = 8.0  # px that the image moves in the window that is warped,
_MIN_WINDOW_S, _DEFAULT_WINDOW_S, _MAX_WINDOW_S = 0.02, 0.05, 0.5  # whose length has bounds
_MAX_EVENTS = 500_000  # events that are warped or coloured
_TRUE, _ESTIMATE, _LOST, _CLOUD = "black", "#c8401e", "#bbbbbb", "#3a78b5"


def motion_figure(
    motion: MotionEstimate,
    times: NDArray[np.int64],
    truth: KnownMotion | None = None,
    *,
    centred: bool | None = None,
) -> Any:
    """Draw the components over times, against the truth and with errors where it is known.

    Bands are two standard deviations, grey spans those in which the motion is lost, dots some of
    the particles, where the motion has a `cloud` (estimates, particles, components). Where a
    direction is not observable there is neither line nor band.

    Args:
        motion: A motion.
        times: (T,) us.
        truth: The true motion.
        centred: Whether estimates count for the middle of the events that they use.

    Returns:
        A `matplotlib.figure.Figure`.
    """
    figure = new_figure()
    if len(times) > _MAX_TIMES:
        times = times[np.linspace(0, len(times) - 1, _MAX_TIMES).astype(int)]
    estimated = motion(times, centred=centred)
    model, seconds = motion.model, times * 1e-6
    extra = _errors(model, times, estimated, truth) or _contrasts(motion, times)
    sizes = [len(model.components[part.rows]) for part in model.parts]
    rows, columns = max(sizes), len(sizes)  # a column for each part
    figure.set_size_inches(6.0 * columns + 2 * (columns == 1), 1.9 * rows + 1.9 * bool(extra))
    grid = figure.subplots(rows + bool(extra), columns, sharex=True, squeeze=False)
    for column, part in enumerate(model.parts):
        for row, i in enumerate(range(len(model.components))[part.rows]):
            _draw_particles(grid[row, column], motion, i, centred)
            _plot_component(grid[row, column], i, part, model, times, estimated, truth=truth)
    for k, (label, series) in enumerate(extra):
        _plot_extra(grid[rows, min(k, columns - 1)], seconds, label, series)
    empty = range(len(extra), columns) if extra else ()
    for column in empty:
        grid[-1, column].remove()
    for column in range(columns):
        axis = grid[-2 if column in empty else -1, column]
        axis.tick_params(labelbottom=True)
        axis.set_xlabel("t (s)")
    for axis in figure.axes:
        for begin, end in _spans(seconds, ~estimated.valid):
            axis.axvspan(begin, end, color=_LOST, alpha=0.4, lw=0, label="lost")
        if not estimated.valid.any():
            axis.text(0.5, 0.5, "never found", transform=axis.transAxes, ha="center", va="center")
        axis.spines[["top", "right"]].set_visible(False)
        axis.set_xlim(seconds[0], max(seconds[-1], seconds[0] + 1e-6))
    drawn = [axis.get_legend_handles_labels() for axis in figure.axes]
    known = {label: handle for pair in drawn for handle, label in zip(*pair, strict=True)}
    grid[0, 0].legend(
        list(known.values()), list(known), fontsize=8, frameon=False, ncols=5, loc="lower left",
        bbox_to_anchor=(0, 1), borderpad=0.2,
    )  # fmt: skip
    return figure


def _plot_component(
    axis: Any,
    i: int,
    part: Part,
    model: type[Model],
    times: NDArray[np.int64],
    estimated: Estimate,
    *,
    truth: KnownMotion | None,
) -> None:
    """Plot a component of a part of the model with its band and its truth.

    Args:
        axis: Axes that are drawn on.
        i: Number of the component.
        part: Part of the model that it belongs to.
        model: The model.
        times: (times,) us.
        estimated: Estimates at these times.
        truth: True motion, or None.
    """
    seconds = times * 1e-6
    observable = is_observable(model, estimated.covariance)[:, i]
    value = np.where(estimated.valid & observable, estimated.mean[:, i], np.nan)
    sigma = np.sqrt(estimated.covariance[:, i, i].clip(0))
    low, high = value - 2 * sigma, value + 2 * sigma
    band = {"color": _ESTIMATE, "alpha": 0.25, "lw": 0, "label": "2 sigma"}
    axis.fill_between(seconds, low, high, **band)
    axis.plot(seconds, value, color=_ESTIMATE, lw=1.3, label="estimate")
    seen = [line[np.isfinite(line)] for line in (low, value, high)]
    seen = [np.percentile(line, [2, 98]) for line in seen if len(line)]
    if truth is not None:
        inside = truth.covers(times)
        true = truth(times[inside])[:, i]
        axis.plot(seconds[inside], true, color=_TRUE, lw=1.0, ls="--", label="truth")
        seen.append(true)
    name, unit = model.components[i], model.units[i]
    axis.set_ylabel(name if unit == "1" else f"{name} ({unit})")
    if part.direction:
        axis.set_ylim(-1.08, 1.08)
        _mark_unobservable(axis, seconds, estimated.valid & np.isnan(value))
    elif any(map(len, seen)):
        # A component that hardly changes is not enlarged until its noise fills the axis.
        least, most = np.concatenate(seen).min(), np.concatenate(seen).max()
        usual = np.abs(estimated.mean[estimated.valid]).max(initial=0)
        half = max(0.6 * (most - least), 0.08 * usual)
        axis.set_ylim((least + most) / 2 - half - 1e-9, (least + most) / 2 + half + 1e-9)


def _plot_extra(axis: Any, seconds: NDArray, label: str, series: NDArray) -> None:
    """Plot an error or a contrast over time, from 0 up.

    Args:
        axis: Axis of matplotlib.
        seconds: (T,) times, s.
        label: Label of the axis.
        series: (T,) values, 0 or more; NaN: none.
    """
    axis.plot(seconds, series, color=_ESTIMATE, lw=1.1)
    axis.set_ylabel(label)
    good = series[np.isfinite(series)]
    if len(good):
        axis.set_ylim(0, 1.15 * max(np.percentile(good, 99), 1e-9))


def _errors(
    model: type[Model], times: NDArray[np.int64], estimated: Estimate, truth: KnownMotion | None
) -> list[tuple[str, NDArray[np.float64]]]:
    """Compute errors over time.

    Args:
        model: Model of the motion.
        times: (T,) us.
        estimated: Motion at these times.
        truth: The true motion; None: it is not known.

    Returns:
        Labels of axes, each with (T,) errors, NaN where motion or truth are not known.
    """
    if truth is None:
        return []
    inside = truth.covers(times) & estimated.valid
    if not inside.any():
        return []
    true, mean = truth(times[inside]), estimated.mean[inside]

    def spread(values: NDArray) -> NDArray[np.float64]:
        series = np.full(len(times), np.nan)
        series[inside] = values
        return series

    errors = []
    for part in model.parts:
        pair = mean[:, part.rows], true[:, part.rows]
        if part.direction:
            errors.append((f"{part.name} error (deg)", spread(axis_error(*pair))))
            continue
        far = endpoint_error(*pair)
        of = f" of {part.name}" if len(model.parts) > 1 else ""
        errors.append((f"|error{of}| ({part.unit})", spread(far)))
    return errors


def _contrasts(
    motion: MotionEstimate, times: NDArray[np.int64]
) -> list[tuple[str, NDArray[np.float64]]]:
    """Interpolate the contrast of the events or the share explained, where there is no truth.

    Args:
        motion: The motion.
        times: (T,) us.

    Returns:
        At most one label of an axis, with (T,) values.
    """
    for label, values in (("contrast", motion.contrast), ("events explained", motion.agreement)):
        if values is not None and np.isfinite(values).any():
            return [(label, np.interp(times, motion.t, values))]
    return []


def _draw_particles(
    axis: Any, motion: MotionEstimate, component: int, centred: bool | None
) -> None:
    """Draw some of the particles of a component.

    Args:
        axis: Axes of matplotlib.
        motion: The motion; without a cloud nothing is drawn.
        component: Index of the component.
        centred: Whether to shift particles by the lag of the estimates; None: unless it is causal.
    """
    cloud = motion.cloud
    if cloud is None or not len(cloud):
        return
    keep = np.unique(
        np.linspace(0, len(cloud) - 1, max(1, min(len(cloud), _MAX_PARTICLES // cloud.shape[1])))
        .round().astype(int)
    )  # fmt: skip
    if centred is None:
        centred = not motion.causal
    t = (motion.t * 1e-6 - (motion.lag if centred else 0))[keep]
    values = cloud[keep][..., component]
    axis.plot(
        np.repeat(t, values.shape[1]), values.ravel(), ".", color=_CLOUD, ms=2.5, mew=0, alpha=0.3,
        zorder=0, rasterized=True,
    )  # fmt: skip
    axis.plot([], [], ".", color=_CLOUD, label="particles")


def _mark_unobservable(axis: Any, seconds: NDArray, rows: NDArray[np.bool_]) -> None:
    """Mark the times at which a direction is not observable.

    Args:
        axis: Axis of matplotlib.
        seconds: (T,) times, s.
        rows: (T,) whether it is not observable.
    """
    for begin, end in _spans(seconds, rows):
        axis.axvspan(begin, end, fc="none", ec=_LOST, hatch="///", lw=0)
    if rows.any():
        place = float(seconds[rows].mean())
        axis.text(place, 0, "not observable", ha="center", va="center", backgroundcolor="white")


def _spans(seconds: NDArray, rows: NDArray[np.bool_]) -> Iterator[tuple[float, float]]:
    """List spans of time in which a condition holds.

    Args:
        seconds: (T,) times, s.
        rows: (T,) whether it holds.

    Yields:
        Begin and end of each span, s.
    """
    edges = np.flatnonzero(np.diff(np.r_[False, rows, False].astype(int)))
    for begin, end in zip(edges[::2], edges[1::2], strict=True):
        yield seconds[begin], seconds[min(end, len(seconds) - 1)]


@dataclasses.dataclass(frozen=True)
class Window:
    """Rows start to stop of the events, and the time (us) to which they are warped."""

    start: int
    stop: int
    reference: int


def representative_window(recording: Recording, motion: MotionEstimate) -> Window:
    """Choose a window of 20 to 500 ms in the middle of the recording, or where motion is found.

    The image moves by 8 px in it, at the median speed over the sensor. Events beyond the first half
    million are left out.
    """
    events = recording.events
    middle = sum(recording.event_span()) // 2
    good = motion.t[motion.valid]
    if len(good) and not motion(middle, extrapolate=True).valid[0]:
        middle = int(good[np.argmin(np.abs(good - middle))])
    estimated = motion(middle, extrapolate=True)
    span = _DEFAULT_WINDOW_S
    if estimated.valid[0] and np.isfinite(estimated.mean).all():
        xi, f = pixel_coordinates(recording.width, recording.height, recording.camera)
        xi = xi[::8, ::8].reshape(-1, 2)
        U = _linear_flow(
            motion.model(f), xi, np.broadcast_to(estimated.mean, (len(xi), estimated.mean.shape[1]))
        )
        speed = float(np.median(np.hypot(*U.T)))
        span = _WINDOW_SHIFT_PX / max(speed, 1e-9)
        span = min(max(span, _MIN_WINDOW_S), _MAX_WINDOW_S)
    half = round(5e5 * span)
    begin = events.index(middle - half)
    end = min(events.index(middle + half), begin + _MAX_EVENTS)
    return Window(begin, end, middle)


def window_flow(recording: Recording, motion: MotionEstimate, part: Window) -> Flow:
    """Estimate the flow of a window's events, with those of 100 ms before as candidates."""
    if part.start == part.stop:
        return Flow(np.zeros((0, 2), np.float32), np.zeros(0, bool), np.zeros(0, np.float32))
    begin = recording.events.index(
        int(recording.events[part.start : part.start + 1].t[0]) - 100_000
    )
    cut = dataclasses.replace(recording, events=recording.events[begin : part.stop])
    flows = event_flow.flow(cut, motion)
    rows = slice(part.start - begin, None)
    return Flow(flows.flow[rows], flows.valid[rows], flows.residual[rows])


def warped_events(
    recording: Recording,
    motion: MotionEstimate,
    events: Events,
    reference_us: int,
    flow_px_s: NDArray[np.floating] | None = None,
) -> NDArray[np.float64]:
    """Warp events along the motion to one time, by the model's `warp` of the motion's integral.

    Args:
        recording: Recording of the events.
        motion: A motion.
        events: n events.
        reference_us: Time, us.
        flow_px_s: (n, 2) px/s, flow due to translation at each event, for motion along half-lines.

    Returns:
        (n, 2) px, columns and rows: pixels, or with a calibration undistorted coordinates about the
        principal point.
    """
    xi, f = pixel_coordinates(recording.width, recording.height, recording.camera)
    xy = xi[events.y, events.x]
    since = (events.t - reference_us) * 1e-6
    # The motion is smooth: its integral on a grid of 1 ms or less.
    low, high = int(events.t.min(initial=reference_us)), int(events.t.max(initial=reference_us))
    grid = np.linspace(low, high, 2 + math.ceil((high - low) / 1000))
    mean = np.asarray(
        motion(np.rint(grid).astype(np.int64), centred=True, extrapolate=True).mean, float
    )
    mean = np.nan_to_num(mean)
    steps = (mean[1:] + mean[:-1]) / 2 * np.diff(grid)[:, None] * 1e-6
    total = np.concatenate([np.zeros((1, mean.shape[1])), np.cumsum(steps, 0)])
    way = np.stack(
        [np.interp(events.t, grid, c) - np.interp(reference_us, grid, c) for c in total.T], 1
    )
    # In single precision a place is off by some 1e-5 px.
    xy = np.asarray(_warp_positions(motion.model(f), _padded(xy), _padded(way)), float)[: len(xy)]
    if flow_px_s is not None:
        xy = xy - flow_px_s * since[:, None]
    centre = _centre(recording)
    return xy + centre


def _centre(recording: Recording) -> NDArray[np.float64]:
    """Return the principal point, or the middle of the sensor, px."""
    camera = recording.camera
    if camera is None:
        return np.array([(recording.width - 1) / 2, (recording.height - 1) / 2])
    return np.array([camera.cx, camera.cy])


def plot_warped(
    path: str | Path,
    recording: Recording,
    motion: MotionEstimate,
    part: Window | None = None,
    flows: Flow | None = None,
) -> None:
    """Draw the events of a window before and after warping, side by side.

    Images are sums of polarities under a bilinear kernel, of one grey scale. The titles have their
    contrast, the variance in the sensor. For motion along half-lines events without flow are left
    out of both images.

    Args:
        path: PNG file that is written.
        recording: Recording of the events.
        motion: A motion.
        part: The window; None for `representative_window`.
        flows: Flow of the window's events, which motion along half-lines needs.
    """
    part = part or representative_window(recording, motion)
    events = recording.events[part.start : part.stop]
    moved = None
    if motion.model.half_line:
        flows = flows or window_flow(recording, motion, part)
        keep = flows.valid
        events = Events(events.t[keep], events.x[keep], events.y[keep], events.p[keep])
        xi, f = pixel_coordinates(recording.width, recording.height, recording.camera)
        mean = np.nan_to_num(motion(events.t, centred=True, extrapolate=True).mean)
        moved = flows.flow[keep] - _linear_flow(motion.model(f), xi[events.y, events.x], mean)
    xi, _ = pixel_coordinates(recording.width, recording.height, recording.camera)
    shape = recording.height, recording.width
    sign = np.where(events.p, 1.0, -1.0)
    places = (
        xi[events.y, events.x] + _centre(recording),
        warped_events(recording, motion, events, part.reference, moved),
    )
    sign = _padded(sign)
    drawn = [_accumulate_image(_padded(xy), sign, shape) for xy in places]
    images, sharp = [np.asarray(one[0]) for one in drawn], [float(one[1]) for one in drawn]
    limit = max(np.percentile(np.abs(images[1]), 99.7), 1e-9)
    figure = new_figure()
    wide = 5.2
    figure.set_size_inches(2 * wide, wide * shape[0] / shape[1] + 0.8)
    span = (int(events.t[-1] - events.t[0]) * 1e-3) if len(events) else 0.0
    figure.suptitle(
        f"{len(events):,} events of {span:.0f} ms at {part.reference * 1e-6:.3f} s", fontsize=10
    )
    gain = sharp[1] / sharp[0] if sharp[0] > 0 else math.nan
    titles = (
        f"as they fell: contrast {sharp[0]:.3g}",
        f"moved back along the motion: {sharp[1]:.3g}, {gain:.2f} times as much",
    )
    if not motion(part.reference, extrapolate=True).valid[0]:
        titles = (titles[0], "not moved: the motion is not found here")
    for axis, image, title in zip(figure.subplots(1, 2), images, titles, strict=True):
        axis.imshow(image, cmap="gray", vmin=-limit, vmax=limit, interpolation="nearest")
        axis.set_title(title, fontsize=10)
        axis.set_axis_off()
    save_figure(figure, path, dpi=130)


def _padded(array: NDArray) -> NDArray:
    """Pad rows with zeros up to a power of two, so that few lengths are compiled."""
    more = (1 << max(len(array) - 1, 0).bit_length()) - len(array)
    return np.concatenate([array, np.zeros((more, *array.shape[1:]), array.dtype)])


@functools.partial(jax.jit, static_argnums=2)
def _accumulate_image(xy: Array, weight: Array, shape: tuple[int, int]) -> tuple[Array, Array]:
    """Sum weights at places in an image.

    Args:
        xy: (n, 2) places, px.
        weight: (n,) weights.
        shape: Height and width of the image, px.

    Returns:
        The image, and its contrast, ().
    """
    image = splat(xy, weight, shape)
    return image, image_variance(blur(image, 1))


def _linear_flow(
    model: Model, xi: NDArray[np.floating], mean: NDArray[np.floating]
) -> NDArray[np.floating]:
    """Compute the flow of motions at positions, without translation of half-line models.

    Args:
        model: The model.
        xi: (n, 2) positions, px.
        mean: (n, d) motions.

    Returns:
        (n, 2) px/s.
    """
    return np.asarray(_flows(model, _padded(xi), _padded(mean)))[: len(xi)]


@eqx.filter_jit
def _flows(model: Model, xi: Numeric, mean: Numeric) -> Array:
    return jax.vmap(model.flow)(jnp.asarray(xi), jnp.asarray(mean))


@eqx.filter_jit
def _warp_positions(model: Model, xi: Numeric, way: Numeric) -> Array:
    return model.warp(jnp.asarray(xi), jnp.asarray(way))


def plot_flow(path: str | Path, recording: Recording, part: Window, flows: Flow) -> None:
    """Draw a window's events in colours of their flow: hue is direction, saturation is speed.

    Events without flow are grey. Of several events at a pixel the last one is drawn.

    Args:
        path: PNG file that is written.
        recording: Recording of the events.
        part: The window.
        flows: Flow of its events.
    """
    from matplotlib.colors import hsv_to_rgb

    events = recording.events[part.start : part.stop]
    speed = np.hypot(*flows.flow.T.astype(float))
    most = float(np.percentile(speed[flows.valid], 95)) if flows.valid.any() else 1.0
    most = max(most, 1e-9)

    def colours(u: NDArray, v: NDArray) -> NDArray:
        hue = (np.arctan2(v, u) / (2 * np.pi)) % 1
        depth = np.clip(np.hypot(u, v) / most, 0, 1)
        return hsv_to_rgb(np.stack([hue, depth, np.ones_like(hue)], -1))

    image = np.full((recording.height, recording.width, 3), 0.06)
    # The middle third of the window: more would smear fast edges.
    third = (events.t[-1] - events.t[0]) // 6 if len(events) else 0
    now = np.abs(events.t - part.reference) <= third
    image[events.y[now], events.x[now]] = 0.35
    ok = flows.valid & now
    image[events.y[ok], events.x[ok]] = colours(*flows.flow[ok].T.astype(float))
    figure = new_figure()
    wide = 7.0
    figure.set_size_inches(wide + 1.7, wide * recording.height / recording.width + 0.5)
    left, right = figure.subplots(1, 2, width_ratios=(wide, 1.5))
    left.imshow(image, interpolation="nearest")
    left.set_title(f"flow at {part.reference * 1e-6:.3f} s", fontsize=10)
    left.set_axis_off()
    v, u = np.mgrid[-1:1:121j, -1:1:121j] * most
    wheel = np.where((np.hypot(u, v) <= most)[..., None], colours(u, v), 1.0)
    right.imshow(wheel, interpolation="nearest")
    right.set_title(f"{most:.3g} px/s\nat the rim", fontsize=9)
    right.set_axis_off()
    save_figure(figure, path, dpi=130)
