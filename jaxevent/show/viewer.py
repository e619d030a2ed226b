"""A recording and its results on one timeline of the Rerun viewer."""

import contextlib
import functools
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from jaxevent.blob.tracks import Tracks
from jaxevent.egomotion.motion import MotionEstimate
from jaxevent.errors import InputError, require
from jaxevent.io.images import is_series, read_series
from jaxevent.io.output import complete
from jaxevent.io.tables import read_table
from jaxevent.reconstruction.video import ImageSequence
from jaxevent.recording import Recording, microseconds
from jaxevent.show.export import default_tone, display_images, image_times
from jaxevent.show.images import tone_map
from jaxevent.show.track_tables import STATE_COLUMNS

ON_COLOUR, OFF_COLOUR = (200, 64, 30), (58, 120, 181)
BLOCK_EVENTS = 1 << 20  # events sent at a time
VIDEO_RATE_HZ = 30.0  # of images where there are no frames
STATE_STEP_US = 5_000  # us between states of tracks and of motion
TABLE_FILES = "tracks.csv", "motion.csv"  # of the folders that the commands write
CIRCLE_ANGLES_RAD = np.linspace(0, 2 * np.pi, 25)

Result = ImageSequence | Tracks | MotionEstimate | str | Path


def view(
    recording: Recording,
    *results: Result,
    out: str | Path | None = None,
    window: float | int = 0.01,
) -> None:
    """Show events, frames and results in the Rerun viewer, or store them in a file for it.

    Time begins with the recording. Every sequence of images has a view of its own, with events and
    tracks over it; motions have one of curves.

    Args:
        recording: Events and frames.
        results: Reconstructions (shown at the frames' times, or 30 per second), tracks, motions,
            or paths: images with times, as `jaxevent reconstruct` writes in HDF5, or the folder or
            table (CSV) of `jaxevent track` and `jaxevent motion`.
        out: File .rrd that is written; None to open a viewer.
        window: Length of the windows in which events are shown, s.

    Raises:
        MissingExtra: The extra "view" is missing.
        InputError: A result is none of these.
    """
    if not 0 < window < np.inf:
        raise InputError(f"a window of {window:g} s is not possible; give seconds above 0")
    layers = [_layer(result, recording) for result in results]
    with _stream(None if out is None else Path(out)) as stream:
        send = _Sender(stream, recording.start)
        if recording.frames is not None:
            frames = recording.frames
            send.images("image/frames", frames.t, lambda row: frames[row : row + 1].intensity[0])
        send.events(recording, round(window * 1e6))
        for name, log in layers:
            log(send, name)
        stream.send_blueprint(send.layout(recording.width, recording.height))


@contextlib.contextmanager
def _stream(out: Path | None) -> Iterator[Any]:
    """Open a stream to the viewer, or to a file that appears when complete.

    Rerun's own thread for files waits forever at a full disk, so the file is written here, at once:
    parts that are read one by one have indices that no longer hold in the whole.
    """
    rerun: Any = require("rerun", "view")
    stream = rerun.RecordingStream("jaxevent")
    if out is None:
        stream.spawn()
        yield stream
        stream.flush()
        return
    if out.suffix != ".rrd":
        raise InputError(f"{out}: the viewer opens files that end in .rrd; rename it")
    with complete(out) as partial:
        sent = stream.binary_stream()
        yield stream
        partial.write_bytes(sent.read())


class _Sender:
    """Sender of named things to a stream, at times in us on the recording's clock."""

    def __init__(self, stream: Any, start: int):
        self._stream, self._start = stream, start
        self._rerun: Any = require("rerun", "view")
        self._pictures: list[str] = []
        self._curves = False
        self._white = 0.0

    def layout(self, width: int, height: int) -> Any:
        """Lay out a view for each sequence of images, with events and tracks, and one of curves."""
        plan = self._rerun.blueprint
        bounds = plan.VisualBounds2D(x_range=(0, width), y_range=(0, height))
        over = ["/image/events", "/image/tracks/**", "/image/paths/**"]
        views = [
            plan.Spatial2DView(
                origin="/image", contents=[name, *over], name=name.rpartition("/")[2],
                visual_bounds=bounds,
            )
            for name in self._pictures or ["/image/events"]
        ]  # fmt: skip
        shown = plan.Grid(*views)
        if self._curves:
            curves = plan.TimeSeriesView(origin="/motion", name="motion")
            shown = plan.Vertical(shown, curves, row_shares=[2, 1])
        return plan.Blueprint(
            shown,
            plan.TimePanel(timeline="time", state="expanded"),
            plan.SelectionPanel(state="collapsed"),
            plan.BlueprintPanel(state="collapsed"),
        )

    def _times(self, t: NDArray[np.int64]) -> list[Any]:
        return [self._rerun.TimeColumn("time", duration=(t - self._start) * 1e-6)]

    def events(self, recording: Recording, window: int) -> None:
        """Send events as points, ON red and OFF blue, window by window."""
        source, rerun = recording.events, self._rerun
        for first in range(0, len(source), BLOCK_EVENTS):
            events = source[first : first + BLOCK_EVENTS]
            number = (events.t - self._start) // window
            begin = np.flatnonzero(np.diff(number, prepend=number[0] - 1))
            lengths = np.diff(begin, append=len(events))
            columns = rerun.Points2D.columns(
                positions=np.stack([events.x + 0.5, events.y + 0.5], 1),
                colors=np.where(events.p[:, None], ON_COLOUR, OFF_COLOUR).astype(np.uint8),
                radii=np.full(len(events), 0.5, np.float32),
            ).partition(lengths=lengths)
            times = self._start + number[begin] * window
            self._stream.send_columns("image/events", self._times(times), columns)

    def images(self, name: str, t: NDArray[np.int64], image: Callable[[int], NDArray]) -> None:
        """Send grey images of linear intensity.

        White is the brightest 0.5 % of the first image of all sequences, so that these compare, and
        of brighter images that follow.

        Args:
            name: Name of the sequence.
            t: (n,) times, us.
            image: Function of the row that returns (H, W) intensity.
        """
        self._pictures.append(f"/{name}")
        for row, time in enumerate(t.tolist()):
            values = np.asarray(image(row))
            bright = np.nanpercentile(values, 99.5) if np.isfinite(values).any() else 0.0
            self._white = max(self._white, float(bright))
            limits = (0.0, self._white or 1.0)
            self._image(name, time, tone_map(np.nan_to_num(values), "display", limits))

    def toned_images(self, name: str, images: Iterable[tuple[int, NDArray[np.uint8]]]) -> None:
        """Send images for the display.

        Args:
            name: Name of the sequence.
            images: Times, us, with images (H, W[, 3]).
        """
        self._pictures.append(f"/{name}")
        for time, image in images:
            self._image(name, time, image)

    def _image(self, name: str, time: int, image: NDArray[np.uint8]) -> None:
        self._stream.set_time("time", duration=(time - self._start) * 1e-6)
        self._stream.log(name, self._rerun.Image(image))

    def tracks(self, table: pd.DataFrame) -> None:
        """Send ellipses of two standard deviations, until the track ends, and paths."""
        rerun = self._rerun
        for number, rows in table.groupby("id"):
            x, y, along, across, angle = (
                rows[name].to_numpy()[:, None] for name in ("x", "y", "lambda1", "lambda2", "theta")
            )
            u, v = 2 * along * np.cos(CIRCLE_ANGLES_RAD), 2 * across * np.sin(CIRCLE_ANGLES_RAD)
            c, s = np.cos(angle), np.sin(angle)
            outline = np.stack([x + c * u - s * v, y + s * u + c * v], 2) + 0.5
            t = microseconds(rows["t"].to_numpy(np.float64))
            columns = rerun.LineStrips2D.columns(
                strips=list(outline), labels=[str(number)] * len(rows)
            )
            self._stream.send_columns(f"image/tracks/{number}", self._times(t), columns)
            self._stream.set_time("time", duration=(int(t[-1]) + 1 - self._start) * 1e-6)
            self._stream.log(f"image/tracks/{number}", rerun.Clear(recursive=False))
            path = rerun.LineStrips2D([np.concatenate([x, y], 1) + 0.5], colors=[(120, 120, 120)])
            self._stream.log(f"image/paths/{number}", path, static=True)

    def curves(self, table: pd.DataFrame) -> None:
        """Send a curve for each column but t and those of sigmas, with gaps where it is lost."""
        self._curves = True
        names = [n for n in table.columns if n not in ("t", "lost") and not n.startswith("sigma_")]
        for name in names:
            values = table[name].to_numpy(np.float64)
            known = np.isfinite(values)
            t = microseconds(table["t"].to_numpy(np.float64)[known])
            columns = self._rerun.Scalars.columns(scalars=values[known])
            self._stream.send_columns(f"motion/{name}", self._times(t), columns)


_Layer = tuple[str, Callable[[_Sender, str], None]]


def _layer(result: Any, recording: Recording) -> _Layer:
    """Make the layer of a result.

    Args:
        result: Tracks, a motion, a video, or the path of a file or folder of these.
        recording: The recording.

    Returns:
        Name of the layer, and the function that sends it to the viewer.

    Raises:
        InputError: A path holds no result.
    """
    if isinstance(result, Tracks):
        table = _table_of_tracks(result)
        return "tracks", lambda send, _: send.tracks(table)
    if isinstance(result, MotionEstimate):
        table = _table_of_motion(result)
        return "motion", lambda send, _: send.curves(table)
    if isinstance(result, ImageSequence):
        return result.estimator.name, functools.partial(_send_video, result, recording)
    path = Path(result)
    for name in TABLE_FILES:
        if (path / name).exists():
            return _layer_of_table(path / name)
    if path.suffix.lower() == ".csv":
        return _layer_of_table(path)
    if path.exists() and is_series(path):
        series = read_series(path)
        return path.stem, lambda send, name: send.images(f"image/{name}", series.t, series.read)
    raise InputError(
        f"{path}: is no result that can be shown; give images with times (HDF5, folder), or the "
        "folder or CSV of jaxevent track or jaxevent motion"
    )


def _layer_of_table(path: Path) -> _Layer:
    """Return the name of a CSV table and the function that sends it."""
    table = read_table(path, "write it again")
    if {"t", "id", *STATE_COLUMNS[:2], *STATE_COLUMNS[4:7]} <= set(table.columns):
        return path.stem, lambda send, _: send.tracks(table)
    if "t" in table.columns and len(table.columns) > 1 and "id" not in table.columns:
        return path.stem, lambda send, _: send.curves(table)
    raise InputError(
        f"{path}: has the columns {', '.join(map(str, table.columns))}; give a table as of "
        "jaxevent track or jaxevent motion"
    )


def _send_video(video: ImageSequence, recording: Recording, send: _Sender, name: str) -> None:
    """Send a reconstruction at the frames' times, or at even times where there are no frames."""
    if recording.frames is None:
        times = image_times(recording, VIDEO_RATE_HZ)
        tone = default_tone(video.estimator.has_covariance, recording)
        send.toned_images(f"image/{name}", display_images(video, times, tone))
        return
    t = recording.frames.t
    send.images(f"image/{name}", t, lambda row: video(t[row]).mean[0])


def _table_of_tracks(tracks: Tracks) -> pd.DataFrame:
    """Tabulate tracks at even times."""
    times = np.arange(tracks.start, tracks.stop, STATE_STEP_US)
    states = tracks(times)
    row, column = np.nonzero(states.valid)
    mean = np.asarray(states.mean)[row, column]
    known = {"t": times[row] / 1e6, "id": tracks.id[column]}
    return pd.DataFrame(known | dict(zip(STATE_COLUMNS, mean.T, strict=True)))


def _table_of_motion(motion: MotionEstimate) -> pd.DataFrame:
    """Tabulate a motion at even times."""
    times = np.arange(motion.t[0], motion.t[-1] + 1, STATE_STEP_US) if len(motion) else motion.t
    estimated = motion(times)
    values = np.where(estimated.valid[:, None], estimated.mean, np.nan)
    return pd.DataFrame(
        {"t": times / 1e6} | dict(zip(motion.model.components, values.T, strict=True))
    )
