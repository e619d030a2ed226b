"""Figures of recordings and results, and the HTML that notebooks show of them.

`import jaxevent` hands `as_html` to `jaxevent.display`, so that recordings import no figures.
"""

import base64
import functools
import html
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxevent.blob.tracks import Tracks
from jaxevent.display import describe_type, format_seconds, format_span, plural
from jaxevent.egomotion.motion import MotionEstimate
from jaxevent.egomotion.scores import warn_of_gyro_axes
from jaxevent.egomotion.truth import KnownMotion
from jaxevent.errors import InputError, require
from jaxevent.events import event_image
from jaxevent.reconstruction.video import ImageSequence
from jaxevent.recording import Events, EventSource, Recording, Times, microseconds
from jaxevent.show.images import COLOURS, Tone, display_limits, new_figure, tone_map
from jaxevent.show.motion_figures import motion_figure
from jaxevent.show.track_figures import draw_paths
from jaxevent.tuning import FitResult

ON_COLOUR, OFF_COLOUR = "#c8401e", "#3a78b5"
WIDTH_INCHES = 7.0
MAX_EVENTS_3D = 20_000  # events drawn in x, y and t
TONES_BY_PLACE = ("relative", "clahe")  # in which equal intensities have different greys
N_PATH_TIMES = 400  # at which a track's path is drawn
MAX_HTML_EVENTS = 1_000_000  # events that notebooks process for a picture
MAX_HTML_TRACKS = 12  # lines of a table of tracks


def plot_events(
    part: Events | Recording, count: int | None = None, *, size: tuple[int, int] | None = None
) -> Any:
    """Draw the events in the middle, ON red and OFF blue, over the frame of that time.

    Cut the recording for events of other times: `plot_events(recording[1.0:1.02])`.

    Args:
        part: Events, or a recording.
        count: Number of events; None for a quarter of the pixels.
        size: Width and height of the sensor, px; needed for `Events`.

    Returns:
        A `matplotlib.figure.Figure`.

    Raises:
        InputError: The extra "plot" or the size is missing.
    """
    (width, height), events = _sensor(part, size), _middle(part, count, size)
    figure, axis = _image_figure(width, height)
    frame = _frame_at(part, events)
    axis.imshow(np.ones((height, width)) if frame is None else frame, "gray", vmin=0, vmax=1)
    polarity = event_image(events, size=(width, height))
    top = max(1, int(np.percentile(np.abs(polarity[polarity != 0]), 95))) if len(events) else 1
    colours = np.zeros((height, width, 4))
    colours[polarity > 0, :3], colours[polarity < 0, :3] = _rgb(ON_COLOUR), _rgb(OFF_COLOUR)
    colours[..., 3] = np.where(polarity == 0, 0, 0.35 + 0.65 * np.clip(abs(polarity) / top, 0, 1))
    axis.imshow(colours, interpolation="nearest")
    axis.set_title(_title(part, events), fontsize=10)
    return figure


def plot_events_3d(
    part: Events | Recording, count: int | None = None, *, size: tuple[int, int] | None = None
) -> Any:
    """Draw the events in the middle in x, y and t, ON red and OFF blue.

    Of more than 20,000 events every n-th is drawn.

    Args:
        part: Events, or a recording.
        count: Number of events; None for the number of pixels.
        size: Width and height of the sensor, px; needed for `Events`.

    Returns:
        A `matplotlib.figure.Figure`.

    Raises:
        InputError: The extra "plot" or the size is missing.
    """
    width, height = _sensor(part, size)
    events = _middle(part, width * height if count is None else count, size)
    shown = slice(None, None, max(1, math.ceil(len(events) / MAX_EVENTS_3D)))
    t, x, y, p = (getattr(events, name)[shown] for name in "txyp")
    figure = new_figure(WIDTH_INCHES, 5.5)
    axis = figure.add_subplot(projection="3d")
    zero = t[0] if len(t) else 0
    for chosen, colour, label in ((p, ON_COLOUR, "ON"), (~p, OFF_COLOUR, "OFF")):
        ms = (t[chosen] - zero) / 1000
        axis.scatter(ms, x[chosen], y[chosen], c=colour, s=1, lw=0, label=label)
    axis.set(xlabel="t (ms)", ylabel="x (px)", zlabel="y (px)", ylim=(0, width), zlim=(height, 0))
    axis.legend(frameon=False, fontsize=8, markerscale=6)
    axis.set_title(_title(part, events), fontsize=10)
    return figure


def plot_image(video: ImageSequence, time: Times, *, tone: Tone | None = None) -> Any:
    """Draw the image of a reconstruction, and its uncertainty.

    Pixels whose intensity is not known are hatched. The uncertainty, if the method estimates it, is
    the standard deviation of ln(intensity + I0).

    Args:
        video: A reconstruction.
        time: Time of the image; an integer is us, a float s.
        tone: Tone of `jaxevent.show.images.tone_map`. None: "display", whose white is the image's
            brightest 0.5 %; "relative" or "changes" where intensity is known up to a factor only.

    Returns:
        A `matplotlib.figure.Figure`.

    Raises:
        InputError: This is no reconstruction, the tone is unknown, or the extra "plot" is missing.
    """
    _check_kind("plot_image", video, ImageSequence)
    estimate = video(time)
    valid, method = estimate.valid[0], video.estimator
    image, variance = (np.where(valid, part[0], np.nan) for part in estimate[:2])
    deviation = np.sqrt(variance)
    ticker: Any = require("matplotlib.ticker", "plot")
    absolute = getattr(method, "is_absolute", True) and video.recording.frames is not None
    if tone is None:
        tone = "display" if absolute else "relative" if method.has_covariance else "changes"
    values, norm = _tone_values(image, tone, variance)
    what = "intensity" if absolute else "relative intensity"
    panels = [(values, what, {"cmap": "gray", "norm": norm})]
    if np.isfinite(deviation).any():
        scale = {"cmap": "viridis", "vmin": 0.0, "vmax": _bright(deviation, 1e-6)}
        panels.append((deviation, "standard deviation of ln(I + I0)", scale))
    height, width = image.shape
    figure = new_figure(WIDTH_INCHES * len(panels) / 1.4, WIDTH_INCHES / 1.4 * height / width + 0.6)
    axes = figure.subplots(1, len(panels), squeeze=False)[0]
    for axis, (values, label, scale) in zip(axes, panels, strict=True):
        axis.patch.set(facecolor="white", edgecolor=ON_COLOUR, hatch="///")
        shown = axis.imshow(values, interpolation="nearest", **scale)
        axis.set(xticks=[], yticks=[])
        axis.set_title(label, fontsize=10)
        if label != what or tone not in TONES_BY_PLACE:
            bar = figure.colorbar(shown, ax=axis, fraction=0.046, pad=0.03)
            bar.outline.set_visible(False)
            if label == what and tone != "log":  # others than linear scales have ticks beyond
                ends = norm.vmin, norm.vmax
                inside = [t for t in ticker.MaxNLocator(4).tick_values(*ends) if t <= ends[1]]
                bar.set_ticks([t for t in inside if t >= ends[0]])
    at = format_seconds(microseconds(np.ravel(np.asarray(time))[0]))
    name = video.recording.name
    unknown = "" if valid.all() else "; hatched: not known"
    figure.suptitle(f"{name} by {method.name} at {at} s{unknown}", fontsize=10)
    return figure


def _tone_values(
    image: NDArray[np.floating], tone: str, variance: NDArray[np.floating]
) -> tuple[NDArray[np.floating], Any]:
    """Return the values of an image in a tone, and the scale of greys for them.

    For tones in which equal intensities have different greys, the values are the greys themselves.

    Args:
        image: (height, width) intensity, NaN where unknown.
        tone: Name of the tone.
        variance: (height, width) variance of log intensity.

    Returns:
        (height, width) values, and matplotlib's norm.
    """
    colors: Any = require("matplotlib.colors", "plot")
    known = np.isfinite(image)
    seen = image[known][None]
    low, high = display_limits(seen, tone, variance[known][None])
    if tone in TONES_BY_PLACE:
        filled = np.where(known, image, seen.mean() if seen.size else low)
        grey = tone_map(filled, tone, (low, high), variance)
        return np.where(known, grey, np.nan), colors.Normalize(0, 255)
    if tone == "display":
        return image, colors.PowerNorm(1 / 2.2, low, high, clip=True)
    if tone == "log":
        return image.clip(low), colors.LogNorm(low, high, clip=True)
    if tone == "changes":
        scale = (lambda values: np.log1p(np.maximum(values, low)), np.expm1)
        return image.clip(low), colors.FuncNorm(scale, low, high, clip=True)
    return image, colors.Normalize(low, high, clip=True)


def _check_kind(function: str, thing: Any, kind: type) -> None:
    """Check the class of an object that is to be drawn.

    Args:
        function: Name of the function that draws.
        thing: Object to draw.
        kind: Class that the function draws.

    Raises:
        InputError: It has another class; the message names the function for it.
    """
    if isinstance(thing, kind):
        return
    others = {
        ImageSequence: "plot_image(video, time)",
        Tracks: "plot_tracks(tracks)",
        MotionEstimate: "plot_motion(motion)",
        Recording: "plot_events(recording)",
        FitResult: "plot_losses(fitted)",
    }
    right = next((call for other, call in others.items() if isinstance(thing, other)), None)
    remedy = f"give a {kind.__name__}" if right is None else f"use {right}"
    raise InputError(f"{function} cannot draw {describe_type(thing)}; {remedy}")


def plot_tracks(tracks: Tracks, ids: Sequence[int] | None = None, *, most: int = 40) -> Any:
    """Draw the paths of tracks in the image plane over the events of their whole time.

    Time is colour; ellipses of two standard deviations stand along a path, and its id at its end.
    Behind is the number of events of each pixel, of at most a million in the middle.

    Args:
        tracks: Tracks of a recording.
        ids: Tracks that are drawn; None for those that live longest.
        most: Number of the tracks that are then drawn.

    Returns:
        A `matplotlib.figure.Figure`.

    Raises:
        InputError: These are no tracks, or the extra "plot" is missing.
    """
    _check_kind("plot_tracks", tracks, Tracks)
    recording = tracks.recording
    figure, axis = _image_figure(recording.width, recording.height)
    if ids is None:
        longest = np.argsort(tracks.birth - tracks.death, kind="stable")[:most]
        ids = sorted(tracks.id[longest].tolist())
    times = np.linspace(tracks.start, tracks.stop - 1, N_PATH_TIMES).round().astype(np.int64)
    states = tracks(times, ids)
    draw_paths(axis, recording, times, list(ids), (states.mean, states.valid))
    span = format_span((tracks.start, tracks.stop))
    axis.set_title(f"{recording.name}: {len(ids)} of {len(tracks)} tracks, {span}", fontsize=10)
    return figure


def plot_motion(
    motion: MotionEstimate,
    times: Times | None = None,
    truth: KnownMotion | None = None,
    *,
    centred: bool | None = None,
) -> Any:
    """Draw a motion's components over time, with bands of two standard deviations.

    Grey spans are those in which the motion is lost.

    Args:
        motion: A motion.
        times: Times, us or s; None for times spread over the estimates.
        truth: The true motion (`egomotion.known_motion`), whose errors are drawn too.
        centred: Whether estimates count for the middle of the events that they use.

    Returns:
        A `matplotlib.figure.Figure`. An `InputWarning` tells of a gyro that agrees in other axes.

    Raises:
        InputError: This is no motion, the truth is none, there is no estimate and no time, or the
            extra "plot" is missing.
    """
    _check_kind("plot_motion", motion, MotionEstimate)
    if truth is not None and not isinstance(truth, KnownMotion):
        raise InputError(
            f"the truth is {describe_type(truth)}; give jaxevent.egomotion.known_motion(recording, "
            f"{motion.model.name!r})"
        )
    if times is None and not len(motion):
        raise InputError(f"{motion.recording}: the motion has no estimate; nothing to draw")
    if times is None:
        us = np.linspace(motion.t[0], motion.t[-1], 2000).round().astype(np.int64)
    else:
        us = np.atleast_1d(microseconds(times))
    if truth is not None:
        warn_of_gyro_axes(motion, truth)
    return motion_figure(motion, np.unique(us), truth, centred=centred)


def plot_losses(fitted: FitResult | Sequence[FitResult], names: Sequence[str] = ()) -> Any:
    """Draw the losses of fits over iterations, a line for each start.

    Args:
        fitted: Results of fits.
        names: Titles of the panels.

    Returns:
        A `matplotlib.figure.Figure`.

    Raises:
        InputError: The extra "plot" is missing.
    """
    several = list(fitted) if isinstance(fitted, Sequence) else [fitted]
    titles = list(names) or [""] * len(several)
    figure = new_figure(WIDTH_INCHES, 3 * len(several))
    grid = figure.subplots(len(several), squeeze=False)[:, 0]
    for one, title, axis in zip(several, titles, grid, strict=True):
        # Rounds follow each other.
        length = 1 + max((line[2] for line in one.history), default=0)
        for start in sorted({line[0] for line in one.history}):
            lines = [line for line in one.history if line[0] == start]
            for column, colour, name in ((3, COLOURS[0], "fit"), (4, COLOURS[1], "validation")):
                seen = [line for line in lines if line[column] is not None]
                at = [line[1] * length + line[2] for line in seen]
                losses = [line[column] for line in seen]
                axis.plot(at, losses, color=colour, lw=1, label=name if start == 0 else None)
        axis.set(title=title, xlabel="iteration", ylabel="loss")
        axis.spines[["top", "right"]].set_visible(False)
        if axis.lines:
            axis.legend(frameon=False)
    return figure


@functools.singledispatch
def as_html(thing: Any) -> str:
    """Return a table about a thing and a picture of it, as HTML.

    Without the extra "plot" the picture is left out.
    """
    return f"<pre>{html.escape(repr(thing))}</pre>"


@as_html.register
def _(recording: Recording) -> str:
    start, stop = recording.start, recording.stop
    rows = [
        ("sensor", f"{recording.width} x {recording.height} px"),
        ("time", format_span((start, stop))),
        ("events", f"{len(recording.events):,}"),
        ("frames", f"{0 if recording.frames is None else len(recording.frames):,}"),
    ]
    also = [name for name in ("camera", "poses", "imu") if getattr(recording, name) is not None]
    rows.append(("also", ", ".join([*also, *recording.extra]) or "-"))
    return _format_block(recording.name, rows, lambda: plot_events(recording))


@as_html.register
def _(video: ImageSequence) -> str:
    recording = video.recording
    middle = (recording.start + recording.stop) // 2
    if recording.events.index(middle) > MAX_HTML_EVENTS:
        middle = int(recording.events[MAX_HTML_EVENTS : MAX_HTML_EVENTS + 1].t[0])
    rows = [
        ("method", video.estimator.name),
        ("images", f"{recording.width} x {recording.height} px, at any time"),
        ("time", format_span((recording.start, recording.stop))),
    ]
    return _format_block(recording.name, rows, lambda: plot_image(video, middle))


@as_html.register
def _(tracks: Tracks) -> str:
    order = sorted(
        np.argsort(tracks.birth - tracks.death, kind="stable")[:MAX_HTML_TRACKS].tolist()
    )
    rows = [
        (
            f"track {tracks.id[i]}",
            f"{format_span((tracks.birth[i], tracks.death[i]))}, {tracks.ended[i]}",
        )
        for i in order
    ]
    if len(tracks) > len(order):
        rows.append(("", f"and {len(tracks) - len(order)} shorter ones"))
    picture = (
        (lambda: plot_tracks(tracks)) if len(tracks.recording.events) <= MAX_HTML_EVENTS else None
    )
    title = f"{len(tracks)} {plural('track', len(tracks))} of {tracks.recording.name}"
    return _format_block(title, rows, picture)


@as_html.register
def _(motion: MotionEstimate) -> str:
    lost = int((~motion.valid).sum())
    rows = [
        ("motion", motion.model.title + ", assumed" * motion.model_assumed),
        ("estimates", f"{len(motion):,}, {lost:,} of them lost"),
    ]
    for i, (name, unit) in enumerate(zip(motion.model.components, motion.model.units, strict=True)):
        if motion.valid.any():
            mean = motion.mean[motion.valid, i].mean()
            rows.append((name, f"{mean:.4g}{'' if unit == '1' else f' {unit}'} on average"))
    return _format_block(motion.recording, rows, lambda: plot_motion(motion))


def _format_block(
    title: str, rows: Sequence[tuple[str, str]], picture: Callable[[], Any] | None
) -> str:
    """Format a title, a table and a picture as HTML.

    Args:
        title: The title.
        rows: Names and texts of the table.
        picture: Function that draws a figure of matplotlib, or None.

    Returns:
        A block of HTML.
    """
    cells = "".join(
        f"<tr><th>{html.escape(name)}</th><td style='text-align:left'>{html.escape(text)}</td></tr>"
        for name, text in rows
    )
    image = ""
    if picture is not None:
        try:
            png = base64.b64encode(picture()._repr_png_()).decode()
            image = f"<img alt='' style='max-width:100%' src='data:image/png;base64,{png}'>"
        except InputError as error:  # no matplotlib, or nothing to draw
            image = f"<p>{html.escape(str(error))}</p>"
    return f"<div><b>{html.escape(title)}</b><table>{cells}</table>{image}</div>"


def _image_figure(width: int, height: int) -> tuple[Any, Any]:
    """Make a figure with axes for an image of the sensor."""
    figure = new_figure(
        WIDTH_INCHES, min(max(WIDTH_INCHES * height / width, 2), 2 * WIDTH_INCHES) + 0.3
    )
    axis = figure.subplots()
    axis.set(xlabel="x (px)", ylabel="y (px)")
    return figure, axis


def _sensor(part: Events | Recording, size: tuple[int, int] | None) -> tuple[int, int]:
    """Return the size of the sensor.

    Args:
        part: Events, or a recording, which knows it.
        size: Width and height, px, for events.

    Returns:
        Width and height, px.

    Raises:
        InputError: It is not known.
    """
    if isinstance(part, Recording):
        return part.width, part.height
    if size is None:
        raise InputError(
            "the size of the sensor is not known from events; give size=(width, height)"
        )
    return size


def _middle(
    part: Events | Recording, count: int | None, size: tuple[int, int] | None = None
) -> Events:
    """Return events from the middle.

    Args:
        part: Events, or a recording.
        count: Number of events; None: one for each four pixels.
        size: Width and height of the sensor, px, for events.

    Returns:
        The events.
    """
    width, height = _sensor(part, size)
    source: EventSource = part.events if isinstance(part, Recording) else part
    count = width * height // 4 if count is None else count
    first = max(0, (len(source) - count) // 2)
    return source[first : first + count]


def _frame_at(part: Events | Recording, events: Events) -> NDArray[np.float32] | None:
    """Return the frame nearest to the middle of the events, faint, so that they are seen on it."""
    if not isinstance(part, Recording) or part.frames is None:
        return None
    middle = (events.t[0] + events.t[-1]) // 2 if len(events) else part.frames.t[0]
    row = int(np.argmin(np.abs(part.frames.t - middle)))
    return 0.35 + 0.65 * part.frames[row : row + 1].intensity[0]


def _title(part: Events | Recording, events: Events) -> str:
    """Describe events by name, number and time."""
    name = f"{part.name}: " if isinstance(part, Recording) else ""
    span = ""
    if len(events):
        span = f", {format_span(events.t)}"
    return f"{name}{len(events):,} events{span}"


def _bright(values: NDArray, least: float) -> float:
    """Return the 99.5 % quantile of finite values.

    Args:
        values: Values of any shape.
        least: Least result.

    Returns:
        The quantile, or `least`.
    """
    known = values[np.isfinite(values)]
    return max(least, float(np.percentile(known, 99.5))) if len(known) else least


def _rgb(colour: str) -> tuple[float, ...]:
    """Convert a colour #rrggbb to red, green and blue from 0 to 1."""
    return tuple(int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5))
