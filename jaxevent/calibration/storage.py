"""Calibrations kept in the user's cache folder, by the content of their recordings.

A recording is known again by its sizes and by samples of its events and frames, so that long ones
are not read whole. The key holds the source of this package too: another estimator finds nothing.
A file that is damaged or cannot be read is as none, and what cannot be written is not kept.
"""

import collections
import contextlib
import functools
import hashlib
import io
import json
import os
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import jaxevent
from jaxevent import cache
from jaxevent.calibration.estimation import calibrate
from jaxevent.calibration.result import Calibration, CalibrationValue
from jaxevent.io import toml
from jaxevent.parameters import CALIBRATION_TABLE
from jaxevent.recording import Recording

N_EVENT_SAMPLES = 64  # pieces of the events that are hashed
SAMPLE_EVENTS = 4096  # events of a piece
N_FRAME_SAMPLES = 24  # frames that are hashed
N_KEPT_FILES = 500  # of calibrations; the oldest are removed
N_KEPT_IN_MEMORY = 32

_FIELDS = "fields"  # name of the array that holds the JSON of all fields
_memory: collections.OrderedDict[str, Calibration] = collections.OrderedDict()


def recall_calibration(recording: Recording, I0: float = 1.0) -> Calibration:
    """Return the calibration of a recording, which is computed once for its content.

    Args:
        recording: The recording.
        I0: Offset inside the logarithm, L = ln(I + I0), for which thresholds hold.

    Returns:
        The same as `jaxevent.calibrate` returns.
    """
    key = hash_content(recording, I0)
    found = _memory.get(key) or _read(key)
    if found is None:
        found = calibrate(recording, I0)
        _write(key, found)
    _memory[key] = found
    while len(_memory) > N_KEPT_IN_MEMORY:
        _memory.popitem(last=False)
    return found


def hash_content(recording: Recording, I0: float) -> str:
    """Hash samples of a recording, its sizes, `I0` and the source of the estimator.

    Args:
        recording: The recording.
        I0: Offset inside the logarithm.

    Returns:
        Hexadecimal digits.
    """
    whole = hashlib.blake2b(digest_size=16)

    def feed(*values: Any) -> None:
        for value in values:
            array = np.ascontiguousarray(value)
            whole.update(f"{array.dtype.str} {array.shape};".encode())
            whole.update(array.tobytes())

    whole.update(f"{jaxevent.__version__} {_hash_source()} {I0!r};".encode())
    source, frames = recording.events, recording.frames
    feed(recording.width, recording.height, len(source))
    starts = np.arange(0, len(source), SAMPLE_EVENTS)
    for first in _spread(starts, N_EVENT_SAMPLES).tolist():
        events = source[first : first + SAMPLE_EVENTS]
        feed(events.t, events.x, events.y, events.p)
    if frames is not None:
        rows = _spread(np.arange(len(frames)), N_FRAME_SAMPLES)
        feed(frames.t, frames.exposure, recording.gain, np.asarray(frames.images[rows]))
        for name in ("response", "certainty", "f_Q"):
            if name in recording.extra:
                feed(recording.extra[name])
    return whole.hexdigest()


def _spread(values: NDArray[np.integer], count: int) -> NDArray[np.integer]:
    """Return at most `count` evenly spread values, the first and the last among them."""
    if len(values) <= count:
        return values
    return values[np.linspace(0, len(values) - 1, count).round().astype(int)]


@functools.cache
def _hash_source() -> str:
    """Hash the files of this package."""
    files = sorted(Path(__file__).parent.glob("*.py"))
    return hashlib.blake2b(b"".join(file.read_bytes() for file in files)).hexdigest()


def encode(calibration: Calibration) -> bytes:
    """Return the content of a file that `decode` reads.

    Args:
        calibration: Fields are values, arrays, and what JSON holds.

    Returns:
        An .npz archive.
    """
    arrays, fields = {}, {}
    for name, value in vars(calibration).items():
        if isinstance(value, np.ndarray):
            arrays[name] = value
        else:
            fields[name] = list(value) if isinstance(value, CalibrationValue) else [value]
    content = io.BytesIO()
    np.savez_compressed(content, **arrays, **{_FIELDS: np.array(json.dumps(fields))})
    return content.getvalue()


def decode(content: bytes) -> Calibration:
    """Read the content of a file that `encode` made.

    Args:
        content: An .npz archive.

    Returns:
        The calibration.

    Raises:
        Exception: It is no such archive, of one kind or another.
    """
    with np.load(io.BytesIO(content), allow_pickle=False) as archive:
        found = {name: archive[name] for name in archive.files}
    fields = json.loads(str(found.pop(_FIELDS)))
    values: dict[str, Any] = {
        name: CalibrationValue(*value) if len(value) > 1 else value[0]
        for name, value in fields.items()
    }
    return Calibration(**{**values, **found})


def format_toml(calibration: Calibration, I0: float, source: str) -> str:
    """Format a calibration as a TOML file, which `Parameters.load` reads.

    Args:
        calibration: The calibration.
        I0: Offset inside the logarithm that its thresholds hold for.
        source: Name of the recording, for a remark.

    Returns:
        The text: a table `[calibration]` of values, and one of their 95 % intervals.
    """
    lines = [
        f"# {' '.join(source.split())} by jaxevent {jaxevent.__version__}",
        f"[{CALIBRATION_TABLE}]",
        f"I0 = {toml.text(float(I0))}",
    ]
    intervals = [f"[{CALIBRATION_TABLE}.intervals]"]
    for name, one in calibration.values().items():
        note = " ".join(one.note.split())
        if not one.is_identifiable:
            lines.append(f"# {name}: {note}")
            continue
        lines.append(f"{name} = {one.value!r}  # {one.unit}{'; ' * bool(note)}{note}")
        if np.isfinite([one.low, one.high]).all():
            intervals.append(f"{name} = [{one.low!r}, {one.high!r}]")
    places = np.argwhere(calibration.hot_pixels)[:, ::-1]
    lines.append(f"hot_pixels = {toml.text(places.tolist())}  # [x, y]")
    return "\n".join([*lines, "", *intervals]) + "\n"


def _read(key: str) -> Calibration | None:
    """Return what is kept under a key; None where it is missing or damaged."""
    folder = cache.folder_for_calibrations()
    with contextlib.suppress(Exception):  # whatever NumPy says of damaged archives
        if folder is not None:
            return decode((folder / f"{key}.npz").read_bytes())
    return None


def _write(key: str, calibration: Calibration) -> None:
    """Keep a calibration where this is possible, and at most `N_KEPT_FILES` in all."""
    folder = cache.folder_for_calibrations()
    if folder is None:
        return
    content = encode(calibration)
    with contextlib.suppress(OSError):
        descriptor, name = tempfile.mkstemp(dir=folder)
        try:
            with os.fdopen(descriptor, "wb") as file:
                file.write(content)
            os.replace(name, folder / f"{key}.npz")
        except BaseException:
            os.unlink(name)
            raise
        files = sorted(folder.glob("*.npz"), key=lambda path: path.stat().st_mtime_ns)
        for path in files[:-N_KEPT_FILES]:
            path.unlink(missing_ok=True)
