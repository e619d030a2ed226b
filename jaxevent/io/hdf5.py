"""Recordings as HDF5: jaxevent's own layout, a superset of that of DSEC.

    /                     attributes: format = "jaxevent", version = 1, name, width, height
    /events/t             (events,) int64 us since /t_offset, sorted
    /events/x, /events/y  (events,) uint16 column and row, from 0
    /events/p             (events,) uint8, 1 is ON, 0 is OFF
    /t_offset             scalar int64 us: the recording's clock at events/t = 0 (its first event)
    /ms_to_idx            (milliseconds,) uint64: entry m is the first event with t >= 1000 m;
                          absent where it would have over 2^22 entries and two for each event
    /frames/t             (frames,) int64 us, mid-exposure
    /frames/exposure      (frames,) int64 us, 0 where unknown
    /frames/images        (frames, height, width) uint8, uint16 or floats in [0, 1]
    /camera               (9,) float64: fx fy cx cy k1 k2 p1 p2 k3; of another lens model
                          (`jaxevent.camera`), which the attribute model names, its numbers
    /poses/t, position, quaternion   (poses,) int64 us, (poses, 3) m, (poses, 4) x y z w
    /imu/t, gyro, acc     (samples,) int64 us, (samples, 3) rad/s, (samples, 3) m/s^2
    /triggers/t, edge, channel   (triggers,) int64 us, 1 rising 0 falling -1 unknown, number
    /extra/*              further arrays by name

All times but events/t are on the recording's clock. Only /events is required to read a file, so
files of DSEC and VECtor (t uint32, no attributes) can be read too, and RVT's (events/width and
height). DSEC's rectify_map.h5, where it lies beside the file, shows the sensor's size and is kept
in `extra["rectify_map"]`; otherwise files of this layout compressed by Blosc, as DSEC and VECtor
publish theirs, have 640x480 pixels, and of others the size must be given. Other
layouts: `hdf5_layouts`.

Data compressed by a filter that HDF5 itself lacks (DSEC: Blosc) need the package hdf5plugin, which
is imported when first needed. A file that claims many more events than its bytes can hold is
refused before any memory is taken.
"""

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from jaxevent.arrays import UNIT_NAMES, times, to_microseconds
from jaxevent.errors import InputError, OrderError
from jaxevent.io.checks import (
    ReadOptions,
    check_events,
    check_unfolded,
    images_folder,
    make_camera,
    reading,
    rectify_map_file,
    sensor_size,
    whole_number,
    whole_size,
)
from jaxevent.io.columns import MICROSECOND_FORMAT, ColumnFormat, infer_format, sample_ends
from jaxevent.io.decoded import EventsInFile, ImagesInFile, read_events
from jaxevent.io.disorder import Columns, find_disorder
from jaxevent.io.hdf5_files import (
    array,
    attribute,
    dataset,
    describe_images,
    filter_ids,
    open_file,
)
from jaxevent.io.output import CLOCK_UNIT, complete_hdf5
from jaxevent.progress import bar
from jaxevent.recording import (
    EventColumns,
    Events,
    EventSource,
    Frames,
    ImageSource,
    Imu,
    Poses,
    Recording,
    Triggers,
    slice_bounds,
)
from jaxevent.time_units import Clock, unit_of_words

FORMAT_VERSION = 1
_LEVELS_UNIT = "levels: 0 black, {most} white"  # of images
# Names of datasets by their unit. The units of further arrays are not known here.
_NAMES_OF_UNITS: dict[str, str] = {
    CLOCK_UNIT: "t_offset frames/t poses/t imu/t triggers/t extra/hdr_t extra/depth_t extra/mask_t "
    "extra/flow_t",
    "us since t_offset": "events/t",
    "px": "events/x events/y extra/flow",
    "1 ON, 0 OFF": "events/p",
    "rows of events": "ms_to_idx",
    "us": "frames/exposure",
    "px (fx, fy, cx, cy), 1 (of the lens)": "camera",
    "m": "poses/position extra/depth",
    "1": "poses/quaternion triggers/channel extra/gain extra/hot extra/covered extra/mismatch",
    "rad/s": "imu/gyro",
    "m/s^2": "imu/acc",
    "1 rising, 0 falling, -1 unknown": "triggers/edge",
    "linear intensity: 0 is the frames' black, 1 their white": "extra/hdr",
    "intensity of grey values from 0 to 1": "extra/response",
    "1, of grey values from 0 to 1": "extra/certainty",
    "intensity": "extra/clip extra/dark_offset",
    "px to px": "extra/homography",
    "s": "extra/register_offset extra/refractory extra/clock_offset",
    "ln I": "extra/c_on extra/c_off",
    "Hz": "extra/background_rate",
    "linear light of the video, 1 its white": "extra/white",
    "levels: 0 black, 255 white": "extra/cut extra/read_noise",
    "1000 times the number of the object": "extra/mask",
}
_UNIT_OF_NAME = {name: unit for unit, names in _NAMES_OF_UNITS.items() for name in names.split()}
_BLOSC_FILTER_ID = 32001
_BLOCK_EVENTS = 1 << 20  # events copied at a time: 13 MB
_CHUNK_VALUES = 1 << 16  # values compressed together
_MAX_TABLE_ENTRIES = 1 << 22  # entries of ms_to_idx, 70 minutes and 33 MB, or two for each event

Column = Any  # one field of the events: a dataset, or an object that is sliced like one


def infer_column_format(
    columns: Mapping[str, Column],
    size: tuple[int, int],
    source: str,
    options: ReadOptions,
    *,
    name: str = "t",
    usual: str | None = None,
) -> ColumnFormat:
    """Infer the format of stored columns, without reading more than their ends.

    Args:
        columns: Columns t, x, y and p, in any unit of time.
        size: (width, height) of the sensor in px.
        source: Name of the file for messages.
        options: Options of `jaxevent.io.load`.
        name: Name of the column of times, which may state a unit.
        usual: Usual unit of the layout, see `infer_unit`.

    Returns:
        The format of the columns.

    Raises:
        InputError: The type of the times cannot resolve them.
    """
    t = columns["t"]
    shapes = {column.shape for column in columns.values()}
    if len(shapes) > 1 or len(t.shape) != 1 or not t.shape[0]:
        return MICROSECOND_FORMAT  # `StoredEvents` names the fault
    with reading(f"{source}: events"):
        sample = sample_ends(
            lambda rows: {key: np.asarray(columns[key][rows]) for key in "txyp"}, t.shape[0]
        )
    stated = None
    for attribute_name in ("unit", "units") if isinstance(t, h5py.Dataset) else ():
        if (unit := unit_of_words(attribute(t, attribute_name))) is not None:
            stated = stated or (unit, f"its attribute {attribute_name!r}")
    return infer_format(
        sample, t.shape[0], size, source, options, name=name, stated=stated, usual=usual
    )


class StoredEvents(EventsInFile):
    """Events left in an HDF5 file, an `EventSource`; pieces are read and checked when sliced.

    The file stays open for as long as this object lives.
    """

    def __init__(
        self,
        columns: Mapping[str, Column],
        size: tuple[int, int],
        source: str,
        found: ColumnFormat = MICROSECOND_FORMAT,
        *,
        offset: int = 0,
        ms_to_idx: h5py.Dataset | None = None,
    ):
        """Check that columns fit each other.

        Args:
            columns: t, x, y and p as stored.
            size: (width, height) of the sensor in px.
            source: Name of the file for messages.
            found: Format of the columns.
            offset: Time in us that is added to those of the events.
            ms_to_idx: Table of the first row of each millisecond after `offset`.

        Raises:
            InputError: The columns do not fit each other.
        """
        self.checked_size = size
        self._source, self._format = source, found
        self._t, self._x, self._y, self._p = (columns[name] for name in "txyp")
        shapes = [field.shape for field in (self._t, self._x, self._y, self._p)]
        if len(shapes[0]) != 1 or len(set(shapes)) != 1:
            raise InputError(
                f"{source}: events/t, x, y and p have shapes {', '.join(map(str, shapes))}; they "
                "must be equally long lists"
            )
        if self._t.dtype.kind not in "iuf":
            raise InputError(f"{source}: events/t is {self._t.dtype}; store integer microseconds")
        self._offset = offset
        self._ms_to_idx = ms_to_idx
        if ms_to_idx is not None and (ms_to_idx.ndim != 1 or ms_to_idx.dtype.kind not in "iu"):
            raise InputError(f"{source}: ms_to_idx must be a list of integers; remove it")

    def __len__(self) -> int:
        return self._t.shape[0]

    def _times(self, start: int, stop: int) -> NDArray[np.int64]:
        """Read the times of a range of rows, without the offset.

        Args:
            start: First row.
            stop: Row after the last one.

        Returns:
            (rows,) us.
        """
        stored = np.asarray(self._t[start:stop])
        return to_microseconds(stored, self._format.unit.name, self._source, "event", start)

    def _read(self, start: int, stop: int) -> Columns:
        with reading(f"{self._source}: events"):
            t = self._times(start, stop) + self._offset
            x, y, p = (np.asarray(c[start:stop]) for c in (self._x, self._y, self._p))
        return t, x, y, self._format.signed(p)

    def __getitem__(self, rows: slice) -> Events:
        """Read the events of a range of rows; `InputError` if one of them is not valid.

        The event before the range is read too, so that pieces read in turn are sorted as a whole.
        """
        start, stop = slice_bounds(rows, len(self))
        if stop <= start:
            return Events.empty()
        lead = min(start, 1)
        columns = self._read(start - lead, stop)
        try:
            events = check_events(*columns, self.checked_size, self._source, first_row=start - lead)
        except OrderError:
            times_of_blocks = (columns[0] for _, columns in self.decode(None))
            raise find_disorder(times_of_blocks, source=self._source).explain(
                self._source
            ) from None
        return events[lead:] if lead else events

    def decode(self, row: int | None) -> Iterator[tuple[int, Columns]]:
        """Yield blocks of columns that are not checked, from a row on: a `Decoder`."""
        for start in range(row or 0, len(self), _BLOCK_EVENTS):
            yield start, self._read(start, min(start + _BLOCK_EVENTS, len(self)))

    def repaired(self, options: ReadOptions) -> EventSource:
        """Return these events, with their times repaired by the options."""
        if options.repair is None:
            return self
        return read_events(self.decode, self.checked_size, self._source, options)

    def clock(self) -> Clock:
        """Return the clock of the events, for the times of images, poses and samples."""
        if not len(self):
            return self._format.clock(0, 0)._replace(is_float=False)
        with reading(f"{self._source}: events"):
            first, last = (self._times(row, row + 1)[0] for row in (0, len(self) - 1))
        return self._format.clock(int(first) + self._offset, int(last) + self._offset)

    def image_rows(self, rows: slice) -> NDArray[np.uint16] | None:
        """Read the y of a range of rows; see `recording.ColumnSource`.

        Args:
            rows: The rows, step 1.
        """
        if not self._has_plain_columns():
            return None
        with reading(f"{self._source}: events"):
            return self._y[rows]

    def _has_plain_columns(self) -> bool:
        """Return whether columns are stored as `columns` reads them."""
        stored: list[Any] = [self._t, self._x, self._y, self._p]
        if not all(isinstance(column, h5py.Dataset) for column in stored):
            return False
        kinds = [column.dtype for column in stored]
        known = [[t, np.uint16, np.uint16, np.uint8] for t in (np.int64, np.uint32)]
        return kinds in known and self._format[:2] == MICROSECOND_FORMAT[:2]

    def columns(self, rows: slice, out: EventColumns | None = None) -> EventColumns | None:
        """Read a range of rows as they are stored; see `recording.ColumnSource`.

        Args:
            rows: The rows, step 1.
            out: Columns to write to, if they are long enough.

        Returns:
            The columns; None if they are stored as other types.
        """
        if not self._has_plain_columns():
            return None
        stored: list[Any] = [self._t, self._x, self._y, self._p]
        start, stop, _ = rows.indices(len(self))
        count, previous = max(stop - start, 0), np.iinfo(np.int64).min
        if out is None or len(out.t) < count:
            t, x, y, p = (np.empty(count, kind) for kind in ("i8", "u2", "u2", "u1"))
        else:
            t, x, y, p = out.t[:count], out.x[:count], out.y[:count], out.p[:count]
        with reading(f"{self._source}: events"):
            if start and count:
                previous = int(self._t[start - 1])
            for column, values in zip(stored, (t, x, y, p), strict=True):
                if count:
                    column.read_direct(values, np.s_[start:stop])
        return EventColumns(t, x, y, p, self._offset, previous)

    def index(self, time: int) -> int:
        """Count the events earlier than `time` (us) by a few small reads."""
        since = int(time) - self._offset
        with reading(f"{self._source}: ms_to_idx"):
            low, high = self._millisecond(since // 1000)
            if 0 <= low <= high <= len(self):
                # Without the table, or in a dense millisecond, bisect down to one chunk.
                while high - low > _CHUNK_VALUES:
                    middle = (low + high) // 2
                    if self._times(middle, middle + 1)[0] < since:
                        low = middle + 1
                    else:
                        high = middle
                row = low + int(np.searchsorted(self._times(low, high), since))
                fits_before = row == 0 or self._times(row - 1, row)[0] < since
                fits_after = row == len(self) or self._times(row, row + 1)[0] >= since
                if fits_before and fits_after:
                    return row
        raise InputError(
            f"{self._source}: ms_to_idx does not fit events/t at {time} us; load the file in "
            "memory and save it again"
        )

    def _millisecond(self, ms: int) -> tuple[int, int]:
        """Return the rows between which the first event of a millisecond lies."""
        table = self._ms_to_idx
        low, high = 0, len(self)
        if table is not None and len(table):
            if ms >= 0:
                low = int(table[min(ms, len(table) - 1)])
            if ms + 1 < len(table):
                high = int(table[max(ms + 1, 0)])
        return low, high


class StoredImages(ImagesInFile):
    """Images (frames, height, width) that stay in an HDF5 file until np.asarray reads them."""

    def __init__(self, stored: h5py.Dataset, source: str):
        super().__init__(stored.shape, stored.dtype)
        self._dataset, self._source = stored, source

    def read(self, rows: Sequence[int]) -> NDArray:
        """Read images of the file by their numbers."""
        with reading(self._source):
            if isinstance(rows, range) and rows.step > 0:
                return np.asarray(self._dataset[rows.start : rows.stop : rows.step])
            return np.array([self._dataset[i] for i in rows], self.dtype)


def read(path: Path, options: ReadOptions) -> Recording:
    """Read a file of jaxevent's own layout.

    Args:
        path: The file.
        options: Options of `jaxevent.io.load`.

    Returns:
        The recording; unless `options.in_memory`, events and images stay in the file.

    Raises:
        InputError: The file is damaged, or what it holds is not valid.
    """
    return read_by(_read_open, path, options)


def read_by(
    read_open: Callable[[h5py.File, Path, ReadOptions], Recording],
    path: Path,
    options: ReadOptions,
) -> Recording:
    """Read an HDF5 file by a reader of open files.

    Args:
        read_open: Reader of an open file, which leaves events and images in it.
        path: The file.
        options: Options of `jaxevent.io.load`.

    Returns:
        The recording; with `options.in_memory`, its events and images are read and the file closed.
    """
    with reading(path):
        if not options.in_memory:
            return read_open(open_file(path), path, options)
        with open_file(path) as file:
            return _in_memory(read_open(file, path, options))


def _in_memory(recording: Recording) -> Recording:
    """Read the events and images of a recording from their file."""
    frames = recording.frames
    if frames is not None:
        frames = dataclasses.replace(frames, images=np.asarray(frames.images))
    return dataclasses.replace(recording, events=recording.events[:], frames=frames)


def is_matlab(path: Path) -> bool:
    """Return whether MATLAB wrote a file: it puts 512 bytes of its own before HDF5."""
    with path.open("rb") as stored:
        return stored.read(6) == b"MATLAB"


def _read_open(file: h5py.File, path: Path, options: ReadOptions) -> Recording:
    source = str(path)
    with reading(source):
        names = ("format", "version", "name", "width", "height")
        held = ((name, attribute(file, name)) for name in names)
        attributes: dict[str, Any] = {name: value for name, value in held if value is not None}
    is_ours = attributes.get("format") == "jaxevent"
    if is_ours and attributes.get("version") != FORMAT_VERSION:
        raise InputError(
            f"{path}: has version {attributes.get('version')} of the layout but this jaxevent "
            f"reads version {FORMAT_VERSION}; update jaxevent"
        )
    extra = _read_extra(file, source)
    rectify_map = None if is_ours else _read_rectify_map(path)
    size = options.size or _stored_size(file, source, attributes)
    if rectify_map is not None:
        extra["rectify_map"] = rectify_map
        size = size or (rectify_map.shape[1], rectify_map.shape[0])
    size = sensor_size(f"{path}: has no attributes width and height", size)
    states_unit = is_ours or "ms_to_idx" in file
    if states_unit:
        options.refuse_time_unit(path)
    events, notes = _read_events(file, source, size, options, states_unit)

    def stored_times(name: str, what: str) -> NDArray[np.int64]:
        clock = Clock("us", 0, 0, False) if states_unit else events.clock()
        return clock.read(array(file, name, source), f"{source}: {name}", what, notes)

    parts = _read_parts(file, source, stored_times)
    name = str(attributes.get("name", path.stem))
    left_out = {} if parts.get("frames") is not None else _describe_frames(file, path)
    return Recording(
        name, *size, events.repaired(options), extra=extra, notes=tuple(notes), left_out=left_out,
        **parts,
    )  # fmt: skip


def _stored_size(
    file: h5py.File, source: str, attributes: Mapping[str, Any]
) -> tuple[int, int] | None:
    """Return the size of the sensor by a file's attributes, its events or its kind.

    Args:
        file: The file.
        source: Name of the file for messages.
        attributes: Attributes of the file, by name.

    Returns:
        (width, height), px; None if the file does not state it.
    """
    if "width" in attributes and "height" in attributes:
        return whole_size(attributes["width"], attributes["height"], source)
    if "events/width" in file and "events/height" in file:
        width, height = (array(file, f"events/{name}", source) for name in ("width", "height"))
        return whole_size(width, height, source)
    return (640, 480) if _is_dsec(file) else None


def _read_events(
    file: h5py.File, source: str, size: tuple[int, int], options: ReadOptions, states_unit: bool
) -> tuple[StoredEvents, list[str]]:
    """Open the events of a file of the package's own layout.

    Args:
        file: The open file.
        source: Name of the file for messages.
        size: (width, height) of the sensor in px.
        options: Options of `jaxevent.io.load`.
        states_unit: Whether the file states that times are in us.

    Returns:
        The events, and notes about the unit of their times where it had to be inferred.
    """
    columns: dict[str, Column] = {n: dataset(file, f"events/{n}", source) for n in "txyp"}
    offset = 0
    if "t_offset" in file:
        offset = whole_number(array(file, "t_offset", source), source, "t_offset")
    found = MICROSECOND_FORMAT
    if not states_unit or columns["t"].dtype.kind == "f":
        found = infer_column_format(columns, size, source, options)
    if found.unit.name != "us" and offset:
        raise InputError(
            f"{source}: events/t is in {UNIT_NAMES[found.unit.name]} and t_offset in microseconds; "
            "store all times in integer microseconds"
        )
    table = dataset(file, "ms_to_idx", source) if "ms_to_idx" in file else None
    events = StoredEvents(columns, size, source, found, offset=offset, ms_to_idx=table)
    return events, list(found.unit.notes)


def _read_parts(
    file: h5py.File, source: str, stored_times: Callable[[str, str], NDArray[np.int64]]
) -> dict[str, Any]:
    """Read frames, camera, poses, IMU samples and triggers.

    Args:
        file: The file.
        source: Name of the file for messages.
        stored_times: Function (dataset, name of a row) that reads times, us.

    Returns:
        Arguments of `Recording` by name; those that the file lacks are missing.
    """

    def arrays(group: str, *names: str) -> list[NDArray]:
        return [array(file, f"{group}/{name}", source) for name in names]

    parts: dict[str, Any] = {}
    if isinstance(file.get("frames"), h5py.Group):
        name = f"{source}: frames/images"
        images = StoredImages(dataset(file, "frames/images", source), name)
        if len(images.shape) != 3:
            raise InputError(f"{name} has shape {images.shape}; store (frames, height, width)")
        t, exposure = stored_times("frames/t", "frame"), arrays("frames", "exposure")[0]
        exposure = times(exposure, f"{source}: frames/exposure", "row")
        parts["frames"] = Frames(t, images, exposure) if len(t) else None
    if isinstance(file.get("camera"), h5py.Dataset):
        with reading(f"{source}: camera"):
            model = str(file["camera"].attrs.get("model", "radtan"))
        parts["camera"] = make_camera(array(file, "camera", source), f"{source}: camera", model)
    for group, make, what, names in (
        ("poses", Poses, "pose", ("position", "quaternion")),
        ("imu", Imu, "IMU sample", ("gyro", "acc")),
        ("triggers", Triggers, "trigger", ("edge", "channel")),
    ):
        if isinstance(file.get(group), h5py.Group):
            parts[group] = make(stored_times(f"{group}/t", what), *arrays(group, *names))
    return parts


def _describe_frames(file: h5py.File, path: Path) -> dict[str, str]:
    """Describe, for `Recording.left_out`, frames in the file, or those of DSEC beside it."""
    images = images_folder(path)
    if images is None:
        return describe_images(file)
    return {
        "frames": (
            f"{images} holds those of another camera; bring them onto the events' pixels by "
            "jaxevent register"
        )
    }


def _is_dsec(file: Any) -> bool:
    """Return whether a file has the layout of DSEC and VECtor: no size, compressed by Blosc."""
    kinds = {"t": np.uint32, "x": np.uint16, "y": np.uint16, "p": np.uint8}
    for name, kind in kinds.items():
        stored = file.get(f"events/{name}")
        if not isinstance(stored, h5py.Dataset) or stored.dtype != kind:
            return False
        if _BLOSC_FILTER_ID not in filter_ids(stored):
            return False
    return {"ms_to_idx", "t_offset"} <= set(file) and not len(file.attrs)


def _read_rectify_map(path: Path) -> NDArray | None:
    """Read the places of a DSEC camera's pixels in the rectified image, (height, width, 2)."""
    beside = rectify_map_file(path)
    if beside is None:
        return None
    with open_file(beside) as file:
        values = array(file, "rectify_map", str(beside))
    if values.ndim != 3 or values.shape[2] != 2 or values.dtype.kind != "f":
        raise InputError(
            f"{beside}: rectify_map is {values.dtype} of shape {values.shape}; it must be "
            "(height, width, 2)"
        )
    return values


def write(
    recording: Recording, path: Path, compression: str | None = None, progress: bool | None = None
) -> None:
    """Write a recording, completely or not at all.

    Args:
        recording: The recording, which is checked first.
        path: File to write.
        compression: None or "gzip".
        progress: Whether to show a progress bar; None shows one on a terminal.

    Raises:
        InputError: The recording is not valid, or the file cannot be written.
    """
    if compression not in (None, "gzip"):
        raise InputError(f'{path}: compression {compression!r} is unknown; use None or "gzip"')
    recording.check()
    with complete_hdf5(path) as (file, check):
        file.attrs.update(
            format="jaxevent",
            version=FORMAT_VERSION,
            name=recording.name,
            width=recording.width,
            height=recording.height,
        )
        _write_events(file, recording.events, compression, progress, check)
        for group, part in (
            ("frames", recording.frames),
            ("poses", recording.poses),
            ("imu", recording.imu),
            ("triggers", recording.triggers),
        ):
            if part is not None:
                for name, values in vars(part).items():
                    _write(file, f"{group}/{name}", values, compression, check)
        if (camera := recording.camera) is not None:
            file["camera"] = [camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion]
            if camera.model != "radtan":
                file["camera"].attrs["model"] = camera.model
        for name, values in recording.extra.items():
            _write(file, f"extra/{name}", values, compression, check)
        _write_units(file)


def _write_units(file: h5py.File) -> None:
    for name in ("frames/images", "extra/rgb", *_UNIT_OF_NAME):
        if isinstance(stored := file.get(name), h5py.Dataset):
            whole = stored.dtype.kind in "iu"
            levels = _LEVELS_UNIT.format(most=np.iinfo(stored.dtype).max if whole else 1)
            stored.attrs["unit"] = _UNIT_OF_NAME.get(name, levels)


def _write_events(
    file: h5py.File,
    events: EventSource,
    compression: str | None,
    progress: bool | None,
    check: Callable[[], None],
) -> None:
    count = len(events)
    offset = int(events[:1].t[0]) if count else 0
    last_ms = (int(events[count - 1 :].t[0]) - offset) // 1000 if count else -1
    # Where times go back, reading the block that does so raises the error.
    is_sparse = not -1 <= last_ms < max(_MAX_TABLE_ENTRIES, 2 * count)
    file["t_offset"] = np.int64(offset)
    options = _options(count, compression)
    t, x, y, p = (
        file.create_dataset(f"events/{name}", (count,), dtype, **options)
        for name, dtype in (("t", "i8"), ("x", "u2"), ("y", "u2"), ("p", "u1"))
    )
    ms_to_idx = None
    if not is_sparse:
        ms_to_idx = file.create_dataset(
            "ms_to_idx", (last_ms + 1,), "u8", **_options(last_ms + 1, compression)
        )
    ms = 0
    blocks = range(0, count, _BLOCK_EVENTS)
    for row in bar(blocks, desc="store events", unit="M events", progress=progress):
        block = events[row : row + _BLOCK_EVENTS]
        since = block.t - offset
        rows = slice(row, row + len(block))
        t[rows], x[rows], y[rows], p[rows] = since, block.x, block.y, block.p
        check()
        if ms_to_idx is None:
            continue
        # The milliseconds that begin after the last block and not after this one's last event.
        end = min(int(since[-1]) // 1000, last_ms) + 1
        for first in range(ms, end, _BLOCK_EVENTS):
            begin = np.arange(first, min(first + _BLOCK_EVENTS, end))
            ms_to_idx[first : first + len(begin)] = row + np.searchsorted(since, 1000 * begin)
        ms = end


def _write(
    file: h5py.File, name: str, values: Any, compression: str | None, check: Callable[[], None]
) -> None:
    if isinstance(values, ImageSource) and not isinstance(values, np.ndarray):
        options = _options(values.shape[0], compression)
        if options:
            options["chunks"] = (1, *values.shape[1:])
        stored = file.create_dataset(name, values.shape, values.dtype, **options)
        for row in range(values.shape[0]):
            stored[row : row + 1] = np.asarray(values[row : row + 1])
            check()
        return
    values = np.asarray(values)
    dtype = h5py.string_dtype() if values.dtype.kind == "U" else values.dtype
    options = _options(len(values) if values.size and values.ndim else 0, compression)
    if options:
        rows = max(1, _CHUNK_VALUES // values[0].size)
        options["chunks"] = (min(rows, len(values)), *values.shape[1:])
    try:
        file.create_dataset(name, values.shape, dtype, values.astype(dtype, copy=False), **options)
    except (TypeError, ValueError) as error:
        raise InputError(
            f"{name} ({values.dtype}) cannot be stored in HDF5 ({error}); rename or remove it"
        ) from error


def _options(count: int, compression: str | None) -> dict[str, Any]:
    if compression is None or count == 0:
        return {}
    return {"compression": compression, "shuffle": True, "chunks": (min(count, _CHUNK_VALUES),)}


def _read_strings(stored: h5py.Dataset, source: str) -> NDArray:
    """Read strings one by one, as many may stand for one place of the file."""
    text, longest = stored.asstr(), 1
    values = np.empty(stored.shape, object)
    for place in np.ndindex(stored.shape):
        values[place] = text[place]
        longest = max(longest, len(values[place]))
        check_unfolded(4 * longest * values.size, stored.file.id.get_filesize(), source)
    return values.astype(np.str_)


def _read_extra(file: h5py.File, source: str) -> dict[str, NDArray]:
    extra: dict[str, NDArray] = {}
    group = file.get("extra")
    if isinstance(group, h5py.Group):

        def keep(name: str, item: h5py.Dataset | h5py.Group) -> None:
            if isinstance(item, h5py.Dataset):
                item = dataset(file, f"extra/{name}", source)
                text = h5py.check_string_dtype(item.dtype) is not None and item.dtype.kind == "O"
                extra[name] = _read_strings(item, source) if text else np.asarray(item[()])
                held = sum(values.nbytes for values in extra.values())
                check_unfolded(held, file.id.get_filesize(), f"{source}: extra")

        with reading(f"{source}: extra"):
            group.visititems(keep)
    return extra
