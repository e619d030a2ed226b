"""Files of tracks: tables, a video of ellipses and trails, and plots over time."""

import contextlib
import dataclasses
import functools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from numpy.typing import NDArray

from jaxevent.blob.quantities import SIZE_FACTORS, inverse_ttc, inverse_ttc_from_size, size_range
from jaxevent.blob.track import TrackStates
from jaxevent.blob.tracks import TABLE_RATE_HZ, Tracks, evenly_spaced_times
from jaxevent.errors import InputError, MissingExtra, require
from jaxevent.io.output import check_writable, complete
from jaxevent.progress import bar
from jaxevent.recording import Recording
from jaxevent.show.images import video_writer
from jaxevent.show.tables import align_cells
from jaxevent.show.track_figures import draw_frames, write_track_plot
from jaxevent.show.track_tables import (
    QUANTITIES,
    check_rate,
    empty_rows,
    quantity_writer,
    track_writer,
)

_PLOT_SUFFIXES = (".png", ".pdf", ".svg")
_TABLE_SUFFIXES = {".csv", ".h5", ".hdf5"}
_EXTRA_OF_SUFFIX = {".mp4": ("imageio_ffmpeg", "video")} | {
    kind: ("matplotlib", "plot") for kind in _PLOT_SUFFIXES
}
_MAX_TIMES, _MAX_TRACKS = 4096, 64  # of the plot; times also of quantities
_MAX_FPS, _MIN_PICTURES = 30.0, 150  # of a video: pictures per second, and in all
_BATCH_EVENTS = 2_000_000  # events of which rows are written at a time

_ranges = jax.jit(size_range)
_closing = jax.jit(inverse_ttc)
_MIN_COMPILED_ROWS = 64  # rows that a compiled function takes; more come in powers of two


@dataclasses.dataclass(frozen=True)
class Output:
    """Destination of tracks: `output.write(tracks)`.

    `path` is a folder for tracks.csv, tracks.h5, tracks.mp4, tracks.png and, given pairs or an
    extent, quantities.csv; or one file by its suffix (.csv, .h5, .mp4, .png, .pdf, .svg). Tables
    hold a row per track and time, `rate` times per second. With None they hold a row for each event
    in the gate of a track, of its likeliest one. Behind the video are "events" or the
    "high-pass" reconstruction; it plays at 30 pictures per second, slower than real time if that
    would be less than 5 s. quantities.csv and the plot have at most 4096 times, evenly spaced; the
    plot shows the 64 longest tracks. Memory does not grow with the recording's length.

    quantities.csv has the columns t (s), id, other, inverse_ttc (1/s), range (m) and their standard
    deviations; where `other` is empty, inverse_ttc is that of the growth of one blob, see
    `quantities`. With a row for each event quantities.h5 has those columns at event rate: 1 / TTC
    of each of the `pairs` at the events of both, and range at those of each track; t in us, other
    -1 where there is none. `extent` (m), `focal` (px) and `size_factor` are those of `size_range`.
    Without the extra "video" or "plot" a folder has no tracks.mp4 or tracks.png. `InputError` is
    raised for settings that do not fit each other, a place that cannot be written, and a video or
    plot as the one file without its extra.
    """

    path: Path
    rate: float | int | None = TABLE_RATE_HZ
    background: str = "events"
    pairs: Sequence[tuple[int, int]] = ()
    extent: float | int | None = None
    focal: float | int | None = None
    size_factor: float | int | None = None

    def __post_init__(self) -> None:
        path, suffix = self.path, self.path.suffix.lower()
        if not path.name:
            raise InputError(f"{path}: is a folder in use; give the name of a new file or folder")
        known = ("", ".csv", ".h5", ".hdf5", ".mp4", *_PLOT_SUFFIXES)
        if suffix not in known:
            raise InputError(
                f"{path}: tracks cannot be stored as {suffix}; end the name in .csv, .h5, .mp4 or "
                ".png, or leave out the suffix for a folder of all of them"
            )
        if self.rate is not None:
            check_rate(self.rate)
        if (self.extent is None) != (self.focal is None):
            raise InputError("a range needs both --extent (m) and --focal (px); give the other too")
        if self.size_factor is not None and self.extent is None:
            raise InputError("--size-factor is for a range; give --extent and --focal too")
        for name in ("extent", "focal", "size_factor"):
            value = getattr(self, name)
            if value is not None and not 0 < value < math.inf:
                option = name.replace("_", "-")
                raise InputError(f"--{option} {value:g} is not possible; give a number above 0")
        for one, other in self.pairs:
            if one == other:
                raise InputError(f"--pair {one},{other} is one track; give two")
        if self._has_quantities and suffix not in ("", *_PLOT_SUFFIXES):
            raise InputError(
                f"{path}: --pair and --extent are for a folder or a plot; leave them out"
            )
        if self.background != "events" and suffix not in ("", ".mp4"):
            raise InputError(f"{path}: --background is for a video; leave it out")
        if suffix in _EXTRA_OF_SUFFIX:
            require(*_EXTRA_OF_SUFFIX[suffix])
        check_writable(path, directory=not suffix)

    @property
    def _has_quantities(self) -> bool:
        """Return whether time to contact or range are written."""
        return bool(len(self.pairs)) or self.extent is not None

    def write(
        self,
        tracks: Tracks,
        progress: bool | None = None,
        texts: Mapping[str, str] | None = None,
        method: str | None = None,
    ) -> "WrittenTracks":
        """Write everything, complete or not at all.

        Args:
            tracks: The tracks.
            progress: Whether a bar is shown; None: in a terminal or notebook.
            texts: Further files of a folder, by name.
            method: Name of the method that made the tracks.

        Raises:
            InputError: A pair is not two of the tracks.
        """
        known = tracks.id.tolist()
        for one, other in self.pairs:
            if not {one, other} <= set(known):
                raise InputError(
                    f"{tracks.recording.name}: --pair {one},{other} is not two of the tracks "
                    f"found, {', '.join(map(str, known[:20])) or 'none'}"
                )
        if self.path.suffix:
            return self._write_all(tracks, {self.path.suffix.lower(): self.path}, progress, method)
        with complete(self.path, directory=True) as folder:
            places = {kind: folder / f"tracks{kind}" for kind in (".csv", ".h5", ".mp4", ".png")}
            left_out = []
            for kind in set(places) & set(_EXTRA_OF_SUFFIX):
                try:
                    require(*_EXTRA_OF_SUFFIX[kind])
                except MissingExtra as missing:
                    left_out.append(f"{places.pop(kind).name} is left out: {missing}")
            if self._has_quantities:
                places["quantities"] = folder / "quantities.csv"
                if self.rate is None:
                    places["per event"] = folder / "quantities.h5"
            for name, text in (texts or {}).items():
                (folder / name).write_text(text, encoding="utf-8")
            written = self._write_all(tracks, places, progress, method)
            files = [*written.files, *(texts or {})]
            return dataclasses.replace(written, files=files, left_out=sorted(left_out))

    def _write_all(
        self,
        tracks: Tracks,
        places: Mapping[str, Path],
        progress: bool | None,
        method: str | None,
    ) -> "WrittenTracks":
        """Write files by kind; states are read once for all of them."""
        times = self._choose_times(tracks, places)
        rows = _TrackRows(times.coarse, tracks.id)
        with contextlib.ExitStack() as stack:
            writers = [
                stack.enter_context(track_writer(path, method, tracks.params))
                for kind, path in places.items()
                if kind in _TABLE_SUFFIXES
            ]

            def write(*table: Any) -> None:
                for one in writers:
                    one(*table)

            states = _read_states(tracks, times, write, rows, progress)
            if ".mp4" in places:
                self._write_video(places[".mp4"], tracks, times, states)
            else:
                for _ in states:
                    pass
            if self.rate is None and writers:
                put = None
                if "per event" in places:
                    put = stack.enter_context(
                        quantity_writer(places["per event"], method, tracks.params)
                    )
                for one in _per_event(tracks, progress):
                    write(*one.table)
                    if put is not None:
                        for columns in self._event_quantities(one):
                            put(*columns)
        if "quantities" in places:
            self._write_quantities(places["quantities"], rows, tracks)
        for kind in set(places) & set(_PLOT_SUFFIXES):
            self._write_plot(places[kind], rows, tracks)
        slow = min(times.per_second, _MAX_FPS) / times.per_second if ".mp4" in places else None
        return WrittenTracks(tracks, rows, [path.name for path in places.values()], slow, [])

    def _choose_times(self, tracks: Tracks, places: Mapping[str, Path]) -> "_Times":
        """Choose the times at which the files show states."""
        duration = (tracks.stop - tracks.start) * 1e-6
        rate = TABLE_RATE_HZ if self.rate is None else float(self.rate)
        often = min(max(_MAX_FPS, _MIN_PICTURES / duration), max(rate, _MAX_FPS))
        spaced = functools.partial(evenly_spaced_times, tracks.start, tracks.stop)
        none = np.empty(0, np.int64)
        return _Times(
            coarse=spaced(min(rate, _MAX_TIMES / duration)),
            pictures=spaced(often) if ".mp4" in places else none,
            rows=spaced(rate) if self.rate is not None and set(places) & _TABLE_SUFFIXES else none,
            per_second=often,
        )

    def _write_video(
        self,
        path: Path,
        tracks: Tracks,
        times: "_Times",
        states: Iterator[tuple[NDArray, NDArray]],
    ) -> None:
        """Write a video of the states at the pictures' times.

        Args:
            path: File to write.
            tracks: The tracks.
            times: Times of the output, with those of pictures.
            states: States (N, 8) of the tracks, and whether each is valid (N,), for each picture.
        """
        recording, pictures = tracks.recording, times.pictures
        behind = _high_pass(recording, pictures) if self.background != "events" else None
        with video_writer(path, min(times.per_second, _MAX_FPS)) as show:
            for image in draw_frames(recording, pictures, tracks.id, states, behind):
                show(image)

    def _write_plot(self, path: Path, rows: "_TrackRows", tracks: Tracks) -> None:
        """Write a plot of the longest tracks and of those of pairs."""
        chosen = rows.longest(_MAX_TRACKS, [one for pair in self.pairs for one in pair])
        mean, covariance, valid = rows.dense(chosen)
        write_track_plot(
            path, tracks.recording, rows.t, tracks.id[chosen], mean, covariance,
            valid=valid, pairs=self.pairs, extent=self.extent, focal=self.focal,
            size_factor=self._factor(), total=len(tracks),
            Q_lambda=[float(tracks.track_params(one).Q_lambda) for one in tracks.id[chosen]],
            smoothed=tracks.smooth,
        )  # fmt: skip

    def _factor(self) -> float | int:
        return SIZE_FACTORS["ring"] if self.size_factor is None else self.size_factor

    def _event_quantities(self, now: "_EventStates") -> Iterator[tuple[NDArray, ...]]:
        """Yield the columns `QUANTITIES` of the events of some times."""
        states = now.states

        def columns(row: NDArray, one: Any, other: int, *values: NDArray) -> tuple[NDArray, ...]:
            ids = np.broadcast_to(one, row.shape), np.full(row.shape, other)
            return now.t[row], *ids, *values

        if self.extent is not None:
            k, i = now.row, now.place
            arrays = states.mean[k, i], states.covariance[k, i]
            scale = self.extent, self.focal, self._factor()
            value, deviation = _evaluate(lambda m, P: _ranges(m, P, *scale), *arrays)
            nothing = np.full(len(k), np.nan)
            yield columns(k, states.id[i], -1, nothing, nothing, value, deviation)
        for pair in self.pairs:
            a, b = (int(np.flatnonzero(states.id == one)[0]) for one in pair)
            k = now.row[np.isin(now.place, [a, b])]
            k = k[states.valid[k, a] & states.valid[k, b]]
            arrays = (array[k, i] for i in (a, b) for array in (states.mean, states.covariance))
            value, deviation = _evaluate(_closing, *arrays)
            nothing = np.full(len(k), np.nan)
            yield columns(k, pair[0], pair[1], value, deviation, nothing, nothing)

    def _write_quantities(self, path: Path, rows: "_TrackRows", tracks: Tracks) -> None:
        """Write time to contact and range at coarse times as CSV."""
        tables = []
        since = jnp.asarray((rows.t - rows.t[0]) * 1e-6, jnp.result_type(float))

        def add(one: int, other: int | None, seen: NDArray, *values: Any) -> None:
            names = ("inverse_ttc", "sigma_inverse_ttc", "range", "sigma_range")
            table: dict[str, Any] = {"t": rows.t / 1e6, "id": one, "other": other}
            for name, value in zip(names, values, strict=True):
                value = np.asarray(value, np.float64)
                table[name] = np.sqrt(np.maximum(value, 0)) if name.startswith("sigma") else value
            tables.append(pd.DataFrame(table)[seen])

        nothing = np.full(len(rows.t), np.nan)
        for place, one in enumerate(tracks.id.tolist()):
            mean, covariance, valid = (part[:, 0] for part in rows.dense([place]))
            value = inverse_ttc_from_size(
                since, mean, covariance, jnp.asarray(valid),
                Q_lambda=float(tracks.track_params(one).Q_lambda), smoothed=tracks.smooth,
            )  # fmt: skip
            span = nothing, nothing
            if self.extent is not None and self.focal is not None:
                span = _ranges(mean, covariance, self.extent, self.focal, self._factor())
            add(one, None, valid, *value, *span)
        for pair in self.pairs:
            mean, covariance, valid = rows.dense([tracks.id.tolist().index(i) for i in pair])
            (a, b), (P_a, P_b) = np.moveaxis(mean, 1, 0), np.moveaxis(covariance, 1, 0)
            value = _closing(a, P_a, b, P_b)
            add(*pair, np.asarray(valid.all(1)), *value, nothing, nothing)
        table = pd.DataFrame(columns=list(QUANTITIES))
        if tables:
            table = pd.concat([part.astype({"other": "Int64"}) for part in tables])
            table = table.sort_values(["t", "id"], kind="stable")
        with complete(path) as partial:
            table.to_csv(partial, index=False)


@dataclasses.dataclass(frozen=True)
class WrittenTracks:
    """Result of `Output.write`: the names of the files, and the speed of the video.

    `slow` is that speed over real time; `left_out` are sentences about missing files.
    """

    tracks: Tracks
    rows: "_TrackRows"
    files: list[str]
    slow: float | None
    left_out: list[str]

    def summary(self, most: int = 20) -> list[str]:
        """Return lines of a table of the longest tracks: times in s, median speed and size in px.

        Times are from the recording's start, as in the plot.
        """
        tracks, zero = self.tracks, self.tracks.recording.start
        order = sorted(np.argsort(tracks.birth - tracks.death, kind="stable")[:most].tolist())
        cells = [["id", "birth s", "death s", "ended", "px/s", "lambda1, lambda2 px"]]
        for i in order:
            speed, size = "-", "-"
            mean = self.rows.of(i)
            if len(mean):
                median = np.median(np.c_[np.hypot(mean[:, 2], mean[:, 3]), mean[:, 4:6]], axis=0)
                speed, size = f"{median[0]:.4g}", f"{median[1]:.3g}, {median[2]:.3g}"
            birth, death = (f"{(at[i] - zero) * 1e-6:.4f}" for at in (tracks.birth, tracks.death))
            cells.append([str(tracks.id[i]), birth, death, tracks.ended[i], speed, size])
        lines = align_cells(cells)
        if len(tracks) > most:
            lines.append(f"and {len(tracks) - most} shorter ones")
        reasons = dict.fromkeys(tracks.ended[i] for i in order)
        lines += [
            "",
            f"ended: {'; '.join(f'{one}, {END_REASONS[one]}' for one in reasons)}",
        ] * bool(order)
        if order and abs(zero) >= 1000:
            at = f"{zero * 1e-6:.4f} s on its clock, which tables tell"
            lines.append(f"birth, death: from the recording's start, {at}")
        lines += [
            "px/s, lambda1, lambda2: medians over time of the speed and of the standard deviations "
            "of a blob's events along its axes"
        ] * bool(order)
        return lines


END_REASONS = {  # of `Tracks.ended`, what it means
    "end": "with the events",
    "idle": "no event for too long",
    "left": "it left the image",
    "size": "larger, smaller or longer than blobs may be",
    "uncertain": "its place is too uncertain",
    "merged": "it was at an older one for too long",
    "not finite": "a number of it was not finite",
}


class _Times(NamedTuple):
    """Times (us) at which states are read."""

    coarse: NDArray[np.int64]  # of the plot and of quantities
    pictures: NDArray[np.int64]  # of the video
    rows: NDArray[np.int64]  # of tables
    per_second: float  # pictures, in time of the recording


class _EventStates(NamedTuple):
    """States at the times of some events, and the tracks of the events."""

    t: NDArray[np.int64]  # (times,) us
    states: TrackStates
    row: NDArray[np.intp]  # of each event, in t
    place: NDArray[np.intp]  # of each event, in `states.id`

    @property
    def table(self) -> tuple[NDArray, NDArray, NDArray, NDArray]:
        """Time, id, mean and covariance of each event."""
        k, i = self.row, self.place
        return self.t[k], self.states.id[i], self.states.mean[k, i], self.states.covariance[k, i]


def _evaluate(quantity: Callable[..., Any], *arrays: NDArray) -> tuple[NDArray, NDArray]:
    """Evaluate a quantity of rows and its standard deviation, compiled for few lengths."""
    count = len(arrays[0])
    fill = (
        max(_MIN_COMPILED_ROWS, 1 << (count - 1).bit_length()) - count
        if count
        else _MIN_COMPILED_ROWS
    )
    filled = [np.pad(a, [(0, fill)] + [(0, 0)] * (a.ndim - 1), mode="empty") for a in arrays]
    value, variance = (np.asarray(part, np.float64)[:count] for part in quantity(*filled))
    return value, np.sqrt(np.maximum(variance, 0))


class _TrackRows:
    """States at some times, of valid tracks only."""

    def __init__(self, t: NDArray[np.int64], ids: NDArray[np.int64]):
        self.t, self.ids = t, ids
        self._parts: list[tuple[NDArray, NDArray, NDArray, NDArray]] = []

    def add(self, t: NDArray, mean: NDArray, covariance: NDArray, valid: NDArray) -> None:
        row, column = np.nonzero(valid)
        at = np.searchsorted(self.t, t)[row]
        self._parts.append((at, column, mean[row, column], covariance[row, column]))

    @functools.cached_property
    def _sorted_rows(self) -> tuple[NDArray, NDArray, NDArray, NDArray]:
        at, _, mean, covariance = empty_rows()
        parts = self._parts or [(at, at, mean, covariance)]
        at, column, mean, covariance = (np.concatenate(x) for x in zip(*parts, strict=True))
        order = np.argsort(column, kind="stable")
        return at[order], column[order], mean[order], covariance[order]

    def _slice(self, place: int) -> slice:
        return slice(*np.searchsorted(self._sorted_rows[1], [place, place + 1]))

    def of(self, place: int) -> NDArray:
        """Return the means (rows, 8) of one track."""
        return self._sorted_rows[2][self._slice(place)]

    def longest(self, most: int, also: Sequence[int]) -> list[int]:
        """Return the places of the tracks that are seen at the most times, and of some others.

        Args:
            most: Number of tracks.
            also: Ids of the others.

        Returns:
            Places, ascending.
        """
        count = np.bincount(self._sorted_rows[1], minlength=len(self.ids))
        order = np.argsort(-count, kind="stable")[:most].tolist()
        return sorted({*order, *(int(np.flatnonzero(self.ids == one)[0]) for one in also)})

    def dense(self, places: Sequence[int]) -> tuple[NDArray, NDArray, NDArray]:
        """Return mean (T, n, 8), covariance (T, n, 8, 8) and valid (T, n) of some tracks."""
        at, _, rows, P = self._sorted_rows
        shape = len(self.t), len(places)
        mean, valid = np.ones((*shape, 8), rows.dtype), np.zeros(shape, bool)
        covariance = np.broadcast_to(np.eye(8, dtype=rows.dtype), (*shape, 8, 8)).copy()
        for k, place in enumerate(places):
            part = self._slice(place)
            mean[at[part], k], covariance[at[part], k] = rows[part], P[part]
            valid[at[part], k] = True
        return mean, covariance, valid


def _read_states(
    tracks: Tracks,
    times: _Times,
    write: Callable[..., None],
    rows: _TrackRows,
    progress: bool | None,
) -> Iterator[tuple[NDArray, NDArray]]:
    """Yield means and validity at the pictures' times; tables and rows are filled on the way."""
    everything = np.unique(np.concatenate([times.coarse, times.pictures, times.rows]))
    with bar(total=len(everything), unit="time", desc="read", progress=progress) as shown:
        for t, now in tracks.batches(everything):
            k = _within(t, times.rows)
            if len(k):
                write(t[k], tracks.id, now.mean[k], now.covariance[k], now.valid[k])
            k = _within(t, times.coarse)
            rows.add(t[k], now.mean[k], now.covariance[k], now.valid[k])
            for i in _within(t, times.pictures):
                yield now.mean[i], now.valid[i]
            shown.update(len(t))


def _within(t: NDArray[np.int64], some: NDArray[np.int64]) -> NDArray[np.intp]:
    """Return the places in a range of times of those that are among some times.

    Args:
        t: (n,) sorted times, which hold all of `some` in their range.
        some: Sorted times.

    Returns:
        Indices of `t`.
    """
    first, last = np.searchsorted(some, [t[0], t[-1] + 1]) if len(t) else (0, 0)
    return np.searchsorted(t, some[first:last])


def _high_pass(recording: Recording, times: NDArray[np.int64]) -> Iterator[NDArray[np.uint8]]:
    """Make images from the events alone, grey where nothing happens.

    Args:
        recording: The recording.
        times: (T,) us.

    Returns:
        Images (H, W), one for each time.
    """
    from jaxevent.reconstruction import high_pass
    from jaxevent.show.export import display_images

    video = high_pass.estimate(recording)
    return (image for _, image in display_images(video, times, "changes"))


def _per_event(tracks: Tracks, progress: bool | None) -> Iterator[_EventStates]:
    """Yield the events in the gates of tracks, with the states at their times."""
    events, end = tracks.recording.events, tracks.stop
    row, last = events.index(tracks.start), events.index(end)
    with bar(
        total=last - row, unit="event", unit_scale=True, desc="read", progress=progress
    ) as shown:
        while row < last:
            # Every batch reads from one of few windows on, so it must not be short.
            until = min(row + _BATCH_EVENTS, last)
            begin = int(events[row : row + 1].t[0])
            stop = end if until == last else max(int(events[until : until + 1].t[0]), begin + 1)
            batches = list(tracks.events(begin, stop))
            held = [(one.t[one.id >= 0], one.id[one.id >= 0]) for one in batches]
            none = np.empty(0, np.int64)
            t, number = (np.concatenate(x) for x in zip((none, none), *held, strict=True))
            for now, states in tracks.batches(np.unique(t)):
                a, b = np.searchsorted(t, [now[0], now[-1] + 1])
                k, i = np.searchsorted(now, t[a:b]), np.searchsorted(tracks.id, number[a:b])
                seen = states.valid[k, i]
                yield _EventStates(now, states, k[seen], i[seen])
            next_row = events.index(stop)
            shown.update(next_row - row)
            row = next_row
