"""Tracks written to files: a table, a video of ellipses and trails, plots over time.

Tracks come as arrays: times (T,), int us or float s on the recording's clock; ids (N,); mean
(T, N, 8) and covariance (T, N, 8, 8) of (px, py, vx, vy, lambda1, lambda2, theta, q) in px, s and
rad; alive (T, N), False where a track does not exist and its numbers may be anything.
"""

import colorsys
import math
from collections.abc import Iterable, Iterator
from pathlib import Path

import h5py
import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray
from PIL import Image, ImageDraw, ImageFont

from jaxevent.blob.quantities import SIZE_FACTORS, growth, inverse_ttc, size_range
from jaxevent.errors import InputError, require
from jaxevent.io.output import complete
from jaxevent.recording import Recording, Times, microseconds
from jaxevent.report import video_writer

COLUMNS = ("x", "y", "vx", "vy", "lambda1", "lambda2", "theta", "q")
UNITS = ("px", "px", "px/s", "px/s", "px", "px", "rad", "rad/s")
_DARK, _ON, _OFF = (24, 24, 28), (235, 235, 235), (110, 130, 190)  # background and events
_LOW = 480  # rows; smaller sensors are enlarged, so that lines and numbers can be seen


def write_tracks(
    path: str | Path,
    times: Times,
    ids: ArrayLike,
    mean: ArrayLike,
    covariance: ArrayLike,
    alive: ArrayLike | None = None,
) -> None:
    """Write tracks to a file that ends in .csv, .h5 or .hdf5, one row per time and track alive.

    A table is written as it is instead where ids are (rows,), mean (rows, 8), covariance (rows, 8,
    8) and `times` (rows,), say one row per event. CSV has the columns t (s), id, the state x, y,
    vx, vy, lambda1, lambda2, theta, q and their standard deviations std_x ... std_q. HDF5 has t
    (rows,) int64 us, id (rows,), mean (rows, 8) and covariance (rows, 8, 8), with the attributes
    `columns` and `units`. Raises `InputError` for another suffix and shapes that do not fit.
    """
    path = Path(path)
    if path.suffix.lower() not in (".csv", ".h5", ".hdf5"):
        raise InputError(
            f"{path}: tracks cannot be stored as {path.suffix or 'a file without suffix'}; end the "
            "name in .csv or .h5"
        )
    t, number, mean, covariance, alive = _checked(path, times, ids, mean, covariance, alive)
    if mean.ndim == 3:
        row, column = np.nonzero(alive)
        t, number = t[row], number[column]
        mean, covariance = mean[row, column], covariance[row, column]
    if path.suffix.lower() == ".csv":
        deviation = np.sqrt(np.maximum(np.diagonal(covariance, axis1=1, axis2=2), 0))
        columns = {"t": t / 1e6, "id": number}
        columns |= {name: mean[:, i] for i, name in enumerate(COLUMNS)}
        columns |= {f"std_{name}": deviation[:, i] for i, name in enumerate(COLUMNS)}
        with complete(path) as partial:
            pd.DataFrame(columns).to_csv(partial, index=False)
        return
    with complete(path) as partial, h5py.File(partial, "w") as file:
        file.attrs["format"] = "jaxevent tracks"
        file["t"], file["id"], file["mean"], file["covariance"] = t, number, mean, covariance
        file["t"].attrs["unit"] = "us on the recording's clock"
        for name in ("mean", "covariance"):
            file[name].attrs["columns"], file[name].attrs["units"] = COLUMNS, UNITS


def track_frames(
    recording: Recording,
    times: Times,
    ids: ArrayLike,
    mean: ArrayLike,
    alive: ArrayLike,
    *,
    images: Iterable[NDArray] | None = None,
    sigmas: float | int = 2.0,
    trail: float | int = 0.3,
    window: float | int | None = None,
    scale: int | None = None,
) -> Iterator[NDArray[np.uint8]]:
    """Pictures (scale height, scale width, 3) at sorted times, of the tracks alive at each.

    A track is the ellipse of `sigmas` standard deviations, its id, and the way it went in the last
    `trail` seconds, in a colour of its own. Behind are the events of the last `window` seconds
    (default: since the time before), ON white and OFF blue, or `images`: as many uint8 images of
    the sensor's size, grey or colour. `scale` (default: 1, or more for sensors of fewer than 480
    rows) enlarges. Raises `InputError` for arrays that do not fit each other or the sensor.
    """
    t, number, mean, _, alive = _checked(recording.name, times, ids, mean, None, alive)
    if (np.diff(t) < 0).any():
        raise InputError(f"{recording.name}: the times of a video are not sorted; sort them")
    if scale is None:
        scale = max(1, math.ceil(_LOW / recording.height))
    if window is None:
        window = float(np.median(np.diff(t))) * 1e-6 if len(t) > 1 else 0.01
    events = _event_images(recording, t, round(window * 1e6)) if images is None else images
    colours = [track_colour(int(n)) for n in number]
    behind, font = iter(events), ImageFont.load_default(14)
    for k, now in enumerate(t):
        image = next(behind, None)
        size = (recording.height, recording.width)
        if image is None or image.shape[:2] != size or image.dtype != np.uint8:
            found = "none" if image is None else f"{image.dtype} of shape {image.shape}"
            raise InputError(
                f"{recording.name}: image {k} of {len(t)} behind the tracks is {found}; give uint8 "
                f"of {size}, grey or colour, for each time"
            )
        large = Image.fromarray(image.repeat(scale, 0).repeat(scale, 1)).convert("RGB")
        draw = ImageDraw.Draw(large)
        first = int(np.searchsorted(t, now - round(trail * 1e6)))
        for i in np.flatnonzero(alive[k] & np.isfinite(mean[k]).all(1)):
            gone = np.flatnonzero(~alive[first : k + 1, i])
            begin = first + (gone[-1] + 1 if len(gone) else 0)
            _line(draw, mean[begin : k + 1, i, :2], colours[i], scale, 1)
            outline = _ellipse(mean[k, i], sigmas)
            _line(draw, outline, colours[i], scale, 2)
            x, y = _large(np.array([outline[:, 0].max(), outline[:, 1].min()]), scale)
            draw.text((x, y), str(number[i]), fill=colours[i], font=font, anchor="ls")
        yield np.asarray(large)


def write_track_video(
    path: str | Path,
    recording: Recording,
    times: Times,
    ids: ArrayLike,
    mean: ArrayLike,
    alive: ArrayLike,
    *,
    fps: float | int | None = None,
    **settings,
) -> None:
    """Write the pictures of `track_frames`, which has the further settings, as an MP4 file.

    By default it plays in real time, but at most at 60 pictures per second. Raises `InputError` as
    `track_frames` and without the extra "video".
    """
    t = np.atleast_1d(microseconds(times))
    if fps is None:
        span = int(t[-1] - t[0]) if len(t) else 0
        fps = min((len(t) - 1) / (span * 1e-6), 60.0) if span > 0 else 25.0
    with video_writer(path, fps) as write:
        for image in track_frames(recording, t, ids, mean, alive, **settings):
            write(image)


def plot_tracks(
    path: str | Path,
    times: Times,
    ids: ArrayLike,
    mean: ArrayLike,
    covariance: ArrayLike,
    alive: ArrayLike,
    *,
    pair: tuple[int, int] | None = None,
    extent: float | int | None = None,
    focal: float | int | None = None,
    size_factor: float | int = SIZE_FACTORS["ring"],
    Q: float | int = 0.01,
    Q_lambda: float | int | None = None,
) -> None:
    """Draw size and inverse time to contact over time, with bands of two standard deviations.

    1 / TTC is that of each track's growth (`quantities.growth`, smoothed, with Q and Q_lambda) and,
    given the ids of a `pair`, that of the two blobs. Range is drawn where `extent` (m) and `focal`
    (px) are given. The suffix of `path` chooses the format (PNG, PDF, SVG). Raises `InputError`
    without the extra "plot", for unknown ids and suffixes and for arrays that do not fit.
    """
    require("matplotlib", "plot")
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    t, number, mean, covariance, alive = _checked(path, times, ids, mean, covariance, alive)
    known = number.tolist()
    if pair is not None and not (len(set(pair)) == 2 and set(pair) <= set(known)):
        raise InputError(f"{path}: the pair {pair} is not two of the tracks {known}")
    if (extent is None) != (focal is None):
        raise InputError(f"{path}: range needs both the extent (m) and the focal length (px)")
    names = ["lambda (px)", "1 / TTC (1/s)"] + ["range (m)"] * (extent is not None)
    figure = Figure(figsize=(8, 2.6 * len(names)), layout="constrained")
    suffix = Path(path).suffix.lstrip(".").lower()
    if suffix not in FigureCanvasAgg(figure).get_supported_filetypes():
        raise InputError(
            f"{path}: a figure cannot be stored as {suffix or 'a file without suffix'}; "
            "end the name in .png, .pdf or .svg"
        )
    axes = dict(zip(names, figure.subplots(len(names), 1, sharex=True), strict=True))
    seconds, bounds, faint = t * 1e-6, [], min(0.2, 0.5 / max(len(known), 1))

    def band(name: str, value, variance, seen: NDArray, colour: str, **line) -> None:
        deviation = np.sqrt(np.maximum(np.asarray(variance, np.float64), 0))
        value = np.where(seen & np.isfinite(deviation), np.asarray(value, np.float64), np.nan)
        axes[name].plot(seconds, value, color=colour, lw=1.3, **line)
        low, high = value - 2 * deviation, value + 2 * deviation
        axes[name].fill_between(seconds, low, high, color=colour, alpha=faint, lw=0)
        if name == names[1] and np.isfinite(value).any():
            # Before anything has been measured a band reaches beyond every scale.
            clear = np.isfinite(value) & (deviation <= 3 * np.nanmedian(deviation[seen]))
            bounds.extend([np.nanmin(low[clear]), np.nanmax(high[clear])])

    filled = np.where(alive[..., None], mean, 1.0)
    filled_P = np.where(alive[..., None, None], covariance, np.eye(8))
    m, P = jnp.asarray(filled), jnp.asarray(filled_P)
    since = jnp.asarray((t - t[0]) * 1e-6, m.dtype)
    grown, spread = jax.vmap(
        lambda m, P, seen: growth(since, m, P, seen, Q=Q, Q_lambda=Q_lambda), in_axes=1, out_axes=1
    )(m, P, jnp.asarray(alive))
    ranges = None
    if extent is not None and focal is not None:
        ranges = jax.jit(size_range)(m, P, extent, focal, size_factor)
    for i, one in enumerate(known):
        colour = "#{:02x}{:02x}{:02x}".format(*track_colour(one, dark=True))
        for axis, style in ((4, "-"), (5, "--")):
            label = f"{one}" if axis == 4 else None
            variance = filled_P[:, i, axis, axis]
            band(names[0], filled[:, i, axis], variance, alive[:, i], colour, ls=style, label=label)
        band(names[1], grown[:, i], spread[:, i], alive[:, i], colour, label=f"{one}, growth")
        if ranges is not None:
            value, variance = ranges
            band(names[2], value[:, i], variance[:, i], alive[:, i], colour, label=f"{one}")
    if pair is not None:
        a, b = (known.index(one) for one in pair)
        value, variance = jax.jit(inverse_ttc)(m[:, a], P[:, a], m[:, b], P[:, b])
        both = alive[:, a] & alive[:, b]
        band(names[1], value, variance, both, "black", label=f"{pair[0]} and {pair[1]}")
    for name, axis in axes.items():
        axis.set_ylabel(name)
        axis.spines[["top", "right"]].set_visible(False)
        if 0 < len(known) <= 8:
            axis.legend(fontsize=8, frameon=False, loc="center left", bbox_to_anchor=(1, 0.5))
    if bounds:
        axes[names[1]].set_ylim(min(bounds), max(bounds) + 1e-9)
    axes[names[0]].set_title(
        "lambda1 solid, lambda2 dashed; bands: 2 standard deviations", fontsize=9
    )
    axes[names[-1]].set_xlabel("t (s)")
    with complete(Path(path)) as temporary:
        figure.savefig(temporary, format=suffix, dpi=150)


def track_colour(number: int, dark: bool = False) -> tuple[int, int, int]:
    """Red, green and blue (0 to 255) of a track; neighbouring ids differ."""
    hue = (0.07 + number * 0.618034) % 1
    r, g, b = colorsys.hsv_to_rgb(hue, 0.9 if dark else 0.65, 0.75 if dark else 1.0)
    return round(255 * r), round(255 * g), round(255 * b)


def _checked(
    place: str | Path,
    times: Times,
    ids: ArrayLike,
    mean: ArrayLike,
    covariance: ArrayLike | None,
    alive: ArrayLike | None,
) -> tuple[NDArray, NDArray, NDArray, NDArray, NDArray]:
    """The arrays, as arrays whose shapes fit."""
    t, ids, mean = np.atleast_1d(microseconds(times)), np.asarray(ids), np.asarray(mean)
    if covariance is None:
        covariance = np.broadcast_to(0.0, (*mean.shape, 8))
    covariance = np.asarray(covariance)
    flat = mean.ndim == 2 and alive is None
    shape = (len(t),) if flat else (len(t), ids.size)
    alive = np.ones(shape, bool) if alive is None else np.asarray(alive, bool)
    rows = ids.shape == ((len(t),) if flat else (ids.size,))
    fit = mean.shape == (*shape, 8) and covariance.shape == (*shape, 8, 8) and alive.shape == shape
    if not (rows and fit and ids.dtype.kind in "iu"):
        raise InputError(
            f"{place}: {len(t)} times, {ids.dtype} ids of {ids.shape}, mean {mean.shape}, "
            f"covariance {covariance.shape} and alive {alive.shape} do not fit; give T times, N "
            "integer ids, (T, N, 8), (T, N, 8, 8) and (T, N)"
        )
    return t, ids, mean, covariance, alive


def _event_images(
    recording: Recording, times: NDArray[np.int64], window: int
) -> Iterator[NDArray[np.uint8]]:
    """The events of (t - window, t], the last one of a pixel on top."""
    for t in times:
        image = np.full((recording.height, recording.width, 3), _DARK, np.uint8)
        first, last = (recording.events.index(int(at)) for at in (t - window + 1, t + 1))
        part = recording.events[first:last]
        image[part.y, part.x] = np.where(part.p[:, None], _ON, _OFF)
        yield image


def _ellipse(state: NDArray, sigmas: float | int) -> NDArray[np.float64]:
    """Points (49, 2) of a closed outline, px."""
    angle = np.linspace(0, 2 * np.pi, 49)
    u, v = sigmas * state[4] * np.cos(angle), sigmas * state[5] * np.sin(angle)
    c, s = np.cos(state[6]), np.sin(state[6])
    return np.stack([state[0] + c * u - s * v, state[1] + s * u + c * v], 1)


def _large(points: NDArray, scale: int) -> tuple[float, ...]:
    """Places in an enlarged image, x and y by turns; pixel centres stay whole for scale 1."""
    return tuple(((points + 0.5) * scale - 0.5).clip(-1e5, 1e5).ravel().tolist())


def _line(draw, points: NDArray, colour: tuple[int, int, int], scale: int, width: int) -> None:
    if len(points) > 1:
        draw.line(_large(points, scale), fill=colour, width=width)
