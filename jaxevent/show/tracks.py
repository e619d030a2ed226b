"""Tracks written to files: a table, a video of ellipses and trails, plots over time.

Tracks come as arrays: times (T,), int us or float s on the recording's clock; ids (N,); mean
(T, N, 8) and covariance (T, N, 8, 8) of (px, py, vx, vy, lambda1, lambda2, theta, q) in px, s and
rad; alive (T, N), False where a track does not exist and its numbers may be anything.
"""

import colorsys
import contextlib
import dataclasses
import functools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py
import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray
from PIL import Image, ImageDraw, ImageFont
from tqdm import tqdm

from jaxevent.blob.quantities import SIZE_FACTORS, growth, inverse_ttc, size_range
from jaxevent.blob.tracker import Tracks
from jaxevent.errors import InputError, require
from jaxevent.io.output import complete, complete_hdf5
from jaxevent.recording import Recording, Times, microseconds
from jaxevent.show.report import video_writer

COLUMNS = ("x", "y", "vx", "vy", "lambda1", "lambda2", "theta", "q")
UNITS = ("px", "px", "px/s", "px/s", "px", "px", "rad", "rad/s")
_DARK, _ON, _OFF = (24, 24, 28), (235, 235, 235), (110, 130, 190)  # background and events
_PLOTS = (".png", ".pdf", ".svg")
_COARSE, _PLOTTED = 4096, 16  # most times of the plot and of quantities, most tracks plotted
_FPS, _PICTURES = 60.0, 300  # of a video: most pictures per second, and least in all
_STRETCH = 2_000_000  # events of which rows are written at a time
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
    with track_writer(path) as write:
        write(times, ids, mean, covariance, alive)


@contextlib.contextmanager
def track_writer(path: str | Path) -> Iterator[Callable[..., None]]:
    """Open a file as of `write_tracks` and give the function that appends to it.

    The file appears at the end, complete.
    """
    path = Path(path)
    kinds = {".csv": _csv_writer, ".h5": _hdf5_writer, ".hdf5": _hdf5_writer}
    if path.suffix.lower() not in kinds:
        raise InputError(
            f"{path}: tracks cannot be stored as {path.suffix or 'a file without suffix'}; end the "
            "name in .csv or .h5"
        )
    with kinds[path.suffix.lower()](path) as append:

        def write(
            times: Times,
            ids: ArrayLike,
            mean: ArrayLike,
            covariance: ArrayLike,
            alive: ArrayLike | None = None,
        ) -> None:
            t, number, m, P, seen = _checked(path, times, ids, mean, covariance, alive)
            if m.ndim == 3:
                row, column = np.nonzero(seen)
                t, number, m, P = t[row], number[column], m[row, column], P[row, column]
            append(t, number, m, P)

        yield write


@contextlib.contextmanager
def _csv_writer(path: Path) -> Iterator[Callable[..., None]]:
    with complete(path) as partial, partial.open("w", newline="") as file:
        names = ("t", "id", *COLUMNS, *(f"std_{name}" for name in COLUMNS))
        file.write(",".join(names) + "\n")

        def append(t: NDArray, number: NDArray, mean: NDArray, covariance: NDArray) -> None:
            deviation = np.sqrt(np.maximum(np.diagonal(covariance, axis1=1, axis2=2), 0))
            columns = [t / 1e6, number, *mean.T, *deviation.T]
            table = pd.DataFrame(dict(enumerate(columns)))
            table.to_csv(file, index=False, header=False)

        yield append


@contextlib.contextmanager
def _hdf5_writer(path: Path) -> Iterator[Callable[..., None]]:
    with complete_hdf5(path) as (file, check):
        file.attrs["format"] = "jaxevent tracks"
        row = 0

        def append(*arrays: NDArray) -> None:
            nonlocal row
            names = ("t", "id", "mean", "covariance")
            for name, array in zip(names, arrays, strict=True):
                if name not in file:
                    file.create_dataset(
                        name, (0, *array.shape[1:]), array.dtype, maxshape=(None, *array.shape[1:]),
                        chunks=(4096, *array.shape[1:]),
                    )  # fmt: skip
                stored = file[name]
                assert isinstance(stored, h5py.Dataset)
                stored.resize(row + len(array), axis=0)
                stored[row:] = array
            row += len(arrays[0])
            check()

        yield append
        if "t" not in file:
            append(*_no_rows())
        file["t"].attrs["unit"] = "us on the recording's clock"
        for name in ("mean", "covariance"):
            file[name].attrs["columns"], file[name].attrs["units"] = COLUMNS, UNITS


def _no_rows() -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """Times, ids, means and covariances of no row."""
    none = np.empty(0, np.int64)
    return none, none, np.empty((0, 8), np.float32), np.empty((0, 8, 8), np.float32)


def write_states(path: str | Path, times: Times, states: ArrayLike, alive: ArrayLike) -> None:
    """Write known states (T, N, 8), say the truth, as CSV: t, id, x, ... q, where alive (T, N)."""
    t, ids = np.atleast_1d(microseconds(times)), np.arange(np.shape(states)[1])
    t, ids, states, _, alive = _checked(path, t, ids, states, None, alive)
    row, column = np.nonzero(alive)
    columns = {"t": t[row] / 1e6, "id": ids[column]}
    columns |= {name: states[row, column, i] for i, name in enumerate(COLUMNS)}
    pd.DataFrame(columns).to_csv(path, index=False)


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
    states = zip(mean, alive & np.isfinite(mean).all(-1), strict=True)
    yield from _frames(recording, t, number, states, images, sigmas, trail, window, scale)


def _frames(
    recording: Recording,
    t: NDArray[np.int64],
    number: NDArray,
    states: Iterable[tuple[NDArray, NDArray]],
    images: Iterable[NDArray] | None,
    sigmas: float | int = 2.0,
    trail: float | int = 0.3,
    window: float | int | None = None,
    scale: int | None = None,
) -> Iterator[NDArray[np.uint8]]:
    """The same of states (tracks, 8), and which of them are alive, that come one by one."""
    if scale is None:
        scale = max(1, math.ceil(_LOW / recording.height))
    if window is None:
        window = float(np.median(np.diff(t))) * 1e-6 if len(t) > 1 else 0.01
    events = _event_images(recording, t, round(window * 1e6)) if images is None else images
    colours = [track_colour(int(n)) for n in number]
    behind, font = iter(events), ImageFont.load_default(14)
    ways: dict[int, list[tuple[int, NDArray]]] = {}  # of the tracks alive: times and places
    for k, (now, (mean, alive)) in enumerate(zip(t.tolist(), states, strict=True)):
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
        first = now - round(trail * 1e6)
        ways = {int(i): ways.get(int(i), []) for i in np.flatnonzero(alive)}
        for i, way in ways.items():
            way.append((now, mean[i, :2]))
            while way[0][0] < first:
                way.pop(0)
            _line(draw, np.stack([place for _, place in way]), colours[i], scale, 1)
            outline = _ellipse(mean[i], sigmas)
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


@dataclasses.dataclass(frozen=True)
class Output:
    """What is written of `Tracks`: `output.write(tracks)`.

    `path` is a folder for tracks.csv, tracks.h5, tracks.mp4, tracks.png and, given a pair or an
    extent, quantities.csv; or one file by its suffix (.csv, .h5, .mp4, .png, .pdf, .svg). Tables
    hold a row per track and time, `rate` times per second, or with None a row for each event that
    is in the gate of a track, of its likeliest one. Behind the video are "events" or the
    "high-pass" reconstruction; it plays at 60 pictures per second, slower than real time if that
    would be less than 5 s. quantities.csv and the plot have at most 4096 times, evenly spaced; the
    plot shows the 16 longest tracks. Memory does not grow with the recording's length.

    quantities.csv has the columns t (s), id, other, inverse_ttc (1/s), range (m) and their standard
    deviations; where `other` is empty, inverse_ttc is that of the growth of one blob, see
    `quantities`. `extent` (m), `focal` (px) and `size_factor` are those of `size_range`. Raises
    `InputError` for settings that do not fit each other, a place that cannot be written and for
    the extras "video" and "plot" where they are needed and missing.
    """

    path: Path
    rate: float | int | None = 1000.0
    background: str = "events"
    pair: tuple[int, int] | None = None
    extent: float | int | None = None
    focal: float | int | None = None
    size_factor: float | int | None = None

    def __post_init__(self) -> None:
        path, suffix = self.path, self.path.suffix.lower()
        if not path.name:
            raise InputError(f"{path}: is a folder in use; give the name of a new file or folder")
        known = ("", ".csv", ".h5", ".hdf5", ".mp4", *_PLOTS)
        if suffix not in known:
            raise InputError(
                f"{path}: tracks cannot be stored as {suffix}; end the name in .csv, .h5, .mp4 or "
                ".png, or leave out the suffix for a folder of all of them"
            )
        if self.rate is not None and not 0 < self.rate <= 1e6:
            raise InputError(f"--rate {self.rate:g} is not possible; give times per s, up to 1e6")
        if (self.extent is None) != (self.focal is None):
            raise InputError("a range needs both --extent (m) and --focal (px); give the other too")
        if self.size_factor is not None and self.extent is None:
            raise InputError("--size-factor is for a range; give --extent and --focal too")
        for name in ("extent", "focal", "size_factor"):
            value = getattr(self, name)
            if value is not None and not 0 < value < math.inf:
                option = name.replace("_", "-")
                raise InputError(f"--{option} {value:g} is not possible; give a number above 0")
        if self.pair is not None and self.pair[0] == self.pair[1]:
            raise InputError(f"--pair {self.pair[0]},{self.pair[1]} is one track; give two")
        asked = self.pair is not None or self.extent is not None
        if asked and suffix not in ("", *_PLOTS):
            raise InputError(
                f"{path}: --pair and --extent are for a folder or a plot; leave them out"
            )
        if self.background != "events" and suffix not in ("", ".mp4"):
            raise InputError(f"{path}: --background is for a video; leave it out")
        if suffix in ("", ".mp4"):
            require("imageio_ffmpeg", "video")
        if suffix in ("", *_PLOTS):
            require("matplotlib", "plot")
        # A place that cannot be written is told before the work.
        with contextlib.suppress(_Tried), complete(path, directory=not suffix):
            raise _Tried

    def write(self, tracks: Tracks, progress: bool = False) -> "Written":
        """Write everything, complete or not at all; raises `InputError` for an unknown pair."""
        known = tracks.id.tolist()
        if self.pair is not None and not set(self.pair) <= set(known):
            raise InputError(
                f"{tracks.recording.name}: --pair {self.pair[0]},{self.pair[1]} is not two of the "
                f"tracks found, {', '.join(map(str, known[:20])) or 'none'}"
            )
        if self.path.suffix:
            return self._all(tracks, {self.path.suffix.lower(): self.path}, progress)
        with complete(self.path, directory=True) as folder:
            places = {kind: folder / f"tracks{kind}" for kind in (".csv", ".h5", ".mp4", ".png")}
            if self.pair is not None or self.extent is not None:
                places["quantities"] = folder / "quantities.csv"
            return self._all(tracks, places, progress)

    def _all(self, tracks: Tracks, places: Mapping[str, Path], progress: bool) -> "Written":
        duration = (tracks.stop - tracks.start) * 1e-6
        rate = 1000.0 if self.rate is None else float(self.rate)
        coarse = _evenly(tracks, min(rate, _COARSE / duration))
        often = min(max(_FPS, _PICTURES / duration), max(rate, _FPS))
        pictures = _evenly(tracks, often) if ".mp4" in places else coarse[:0]
        tables = [path for kind, path in places.items() if kind in (".csv", ".h5", ".hdf5")]
        times = _evenly(tracks, rate) if tables and self.rate is not None else coarse[:0]
        rows = _Rows(coarse, tracks.id)
        with contextlib.ExitStack() as stack:
            writers = [stack.enter_context(track_writer(path)) for path in tables]

            def write(*table: Any) -> None:
                for one in writers:
                    one(*table)

            def states() -> Iterator[tuple[NDArray, NDArray]]:
                """Of the pictures' times; the tables are written on the way."""
                everything = np.unique(np.concatenate([coarse, pictures, times]))
                with tqdm(
                    total=len(everything), unit="time", desc="read", delay=2,
                    disable=not progress, leave=False,
                ) as bar:  # fmt: skip
                    for t, now in tracks.batches(everything):
                        k = _within(t, times)
                        if len(k):
                            write(t[k], tracks.id, now.mean[k], now.covariance[k], now.alive[k])
                        k = _within(t, coarse)
                        rows.add(t[k], now.mean[k], now.covariance[k], now.alive[k])
                        for i in _within(t, pictures):
                            yield now.mean[i], now.alive[i]
                        bar.update(len(t))

            if ".mp4" in places:
                recording = tracks.recording
                behind = _high_pass(recording, pictures) if self.background != "events" else None
                fps = min(often, _FPS)
                with video_writer(places[".mp4"], fps) as show:
                    for image in _frames(recording, pictures, tracks.id, states(), behind):
                        show(image)
            else:
                for _ in states():
                    pass
            if self.rate is None and writers:
                for table in _per_event(tracks, progress):
                    write(*table)
        if "quantities" in places:
            self._write_quantities(places["quantities"], rows, tracks)
        for kind in set(places) & set(_PLOTS):
            chosen = rows.longest(_PLOTTED, self.pair or ())
            plot_tracks(
                places[kind], coarse, tracks.id[chosen], *rows.dense(chosen), pair=self.pair,
                extent=self.extent, focal=self.focal, size_factor=self._factor(),
                Q_lambda=float(tracks.params.Q_lambda),
            )  # fmt: skip
        slow = min(often, _FPS) / often if ".mp4" in places else None
        return Written(tracks, rows, [path.name for path in places.values()], slow)

    def _factor(self) -> float | int:
        return SIZE_FACTORS["ring"] if self.size_factor is None else self.size_factor

    def _write_quantities(self, path: Path, rows: "_Rows", tracks: Tracks) -> None:
        tables = []
        since = jnp.asarray((rows.t - rows.t[0]) * 1e-6, jnp.result_type(float))
        Q_lambda = float(tracks.params.Q_lambda)

        def add(one: int, other: int | None, seen: NDArray, *values: Any) -> None:
            names = ("inverse_ttc", "std_inverse_ttc", "range", "std_range")
            table: dict[str, Any] = {"t": rows.t / 1e6, "id": one, "other": other}
            for name, value in zip(names, values, strict=True):
                value = np.asarray(value, np.float64)
                table[name] = np.sqrt(np.maximum(value, 0)) if name.startswith("std") else value
            tables.append(pd.DataFrame(table)[seen])

        nothing = np.full(len(rows.t), np.nan)
        for place, one in enumerate(tracks.id.tolist()):
            mean, covariance, alive = (part[:, 0] for part in rows.dense([place]))
            value = growth(since, mean, covariance, jnp.asarray(alive), Q_lambda=Q_lambda)
            span = nothing, nothing
            if self.extent is not None and self.focal is not None:
                span = _ranges(mean, covariance, self.extent, self.focal, self._factor())
            add(one, None, alive, *value, *span)
        if self.pair is not None:
            mean, covariance, alive = rows.dense([tracks.id.tolist().index(i) for i in self.pair])
            (a, b), (P_a, P_b) = np.moveaxis(mean, 1, 0), np.moveaxis(covariance, 1, 0)
            value = _closing(a, P_a, b, P_b)
            add(*self.pair, np.asarray(alive.all(1)), *value, nothing, nothing)
        names = ["t", "id", "other", "inverse_ttc", "std_inverse_ttc", "range", "std_range"]
        table = pd.DataFrame(columns=names)
        if tables:
            table = pd.concat([part.astype({"other": "Int64"}) for part in tables])
            table = table.sort_values(["t", "id"], kind="stable")
        with complete(path) as partial:
            table.to_csv(partial, index=False)


@dataclasses.dataclass(frozen=True)
class Written:
    """What `Output.write` has written: the names of the files, and how slowly the video plays."""

    tracks: Tracks
    rows: "_Rows"
    files: list[str]
    slow: float | None

    def summary(self, most: int = 20) -> list[str]:
        """Lines of a table of the longest tracks: times in s, median speed and size in px."""
        tracks = self.tracks
        order = sorted(np.argsort(tracks.birth - tracks.death, kind="stable")[:most].tolist())
        cells = [["id", "birth s", "death s", "ended", "px/s", "lambda1, lambda2 px"]]
        for i in order:
            speed, size = "-", "-"
            mean = self.rows.of(i)
            if len(mean):
                median = np.median(np.c_[np.hypot(mean[:, 2], mean[:, 3]), mean[:, 4:6]], axis=0)
                speed, size = f"{median[0]:.4g}", f"{median[1]:.3g}, {median[2]:.3g}"
            birth, death = (f"{at[i] * 1e-6:.4f}" for at in (tracks.birth, tracks.death))
            cells.append([str(tracks.id[i]), birth, death, tracks.ended[i], speed, size])
        widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
        lines = [
            "  ".join(cell.rjust(w) for cell, w in zip(line, widths, strict=True)) for line in cells
        ]
        if len(tracks) > most:
            lines.append(f"and {len(tracks) - most} shorter ones")
        return lines


class _Tried(Exception):
    """Only to leave a block without effect."""


class _Rows:
    """States at some times, of the tracks alive only."""

    def __init__(self, t: NDArray[np.int64], ids: NDArray[np.int64]):
        self.t, self.ids = t, ids
        self._parts: list[tuple[NDArray, NDArray, NDArray, NDArray]] = []

    def add(self, t: NDArray, mean: NDArray, covariance: NDArray, alive: NDArray) -> None:
        row, column = np.nonzero(alive)
        at = np.searchsorted(self.t, t)[row]
        self._parts.append((at, column, mean[row, column], covariance[row, column]))

    @functools.cached_property
    def _joined(self) -> tuple[NDArray, NDArray, NDArray, NDArray]:
        at, _, mean, covariance = _no_rows()
        parts = self._parts or [(at, at, mean, covariance)]
        at, column, mean, covariance = (np.concatenate(x) for x in zip(*parts, strict=True))
        order = np.argsort(column, kind="stable")
        return at[order], column[order], mean[order], covariance[order]

    def _slice(self, place: int) -> slice:
        return slice(*np.searchsorted(self._joined[1], [place, place + 1]))

    def of(self, place: int) -> NDArray:
        """Means (rows, 8) of one track."""
        return self._joined[2][self._slice(place)]

    def longest(self, most: int, also: Sequence[int]) -> list[int]:
        """The places of the tracks seen at the most times, and of some ids, by rising id."""
        count = np.bincount(self._joined[1], minlength=len(self.ids))
        order = np.argsort(-count, kind="stable")[:most].tolist()
        return sorted({*order, *(int(np.flatnonzero(self.ids == one)[0]) for one in also)})

    def dense(self, places: Sequence[int]) -> tuple[NDArray, NDArray, NDArray]:
        """Mean (T, n, 8), covariance (T, n, 8, 8) and alive (T, n) of some tracks."""
        at, _, rows, P = self._joined
        shape = len(self.t), len(places)
        mean, alive = np.ones((*shape, 8), rows.dtype), np.zeros(shape, bool)
        covariance = np.broadcast_to(np.eye(8, dtype=rows.dtype), (*shape, 8, 8)).copy()
        for k, place in enumerate(places):
            part = self._slice(place)
            mean[at[part], k], covariance[at[part], k], alive[at[part], k] = (
                rows[part],
                P[part],
                True,
            )
        return mean, covariance, alive


_ranges = jax.jit(size_range)
_closing = jax.jit(inverse_ttc)


def _evenly(tracks: Tracks, rate: float) -> NDArray[np.int64]:
    """Times (us) at a rate (1/s) from the start of the tracking to before its end."""
    count = math.ceil((tracks.stop - tracks.start) * rate / 1e6)
    times = tracks.start + np.rint(np.arange(count) * (1e6 / rate)).astype(np.int64)
    return np.unique(times[times < tracks.stop])


def _within(t: NDArray[np.int64], some: NDArray[np.int64]) -> NDArray[np.intp]:
    """The places in t (sorted) of those times (sorted) that are in its reach; t holds them all."""
    first, last = np.searchsorted(some, [t[0], t[-1] + 1]) if len(t) else (0, 0)
    return np.searchsorted(t, some[first:last])


def _high_pass(recording: Recording, times: NDArray[np.int64]) -> Iterator[NDArray[np.uint8]]:
    """Images of the events alone, grey where nothing happens."""
    from jaxevent.reconstruction import high_pass
    from jaxevent.show.export import shown

    video = high_pass.estimate(recording)
    return (image for _, image in shown(video, times, "percentile"))


def _per_event(
    tracks: Tracks, progress: bool
) -> Iterator[tuple[NDArray, NDArray, NDArray, NDArray]]:
    """Time, id, mean and covariance, a row for each event that a track holds."""
    events, end = tracks.recording.events, tracks.stop
    row, last = events.index(tracks.start), events.index(end)
    with tqdm(
        total=last - row, unit="event", unit_scale=True, desc="read", delay=2,
        disable=not progress, leave=False,
    ) as bar:  # fmt: skip
        while row < last:
            # Every stretch reads from one of few windows on, so it must not be short.
            until = min(row + _STRETCH, last)
            begin = int(events[row : row + 1].t[0])
            stop = end if until == last else max(int(events[until : until + 1].t[0]), begin + 1)
            told = list(tracks.events(begin, stop))
            held = [(one.t[one.id >= 0], one.id[one.id >= 0]) for one in told]
            none = np.empty(0, np.int64)
            t, number = (np.concatenate(x) for x in zip((none, none), *held, strict=True))
            for now, states in tracks.batches(np.unique(t)):
                a, b = np.searchsorted(t, [now[0], now[-1] + 1])
                k, i = np.searchsorted(now, t[a:b]), np.searchsorted(tracks.id, number[a:b])
                seen = states.alive[k, i]
                k, i = k[seen], i[seen]
                yield now[k], tracks.id[i], states.mean[k, i], states.covariance[k, i]
            next_row = events.index(stop)
            bar.update(next_row - row)
            row = next_row


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
