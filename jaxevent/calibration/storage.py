"""Calibrations kept in the user's cache folder, by the content of their recordings.

A recording is known again by its sizes and by samples of its events and frames, so that long ones
are not read whole. The key holds the source of estimators and methods too, so that others find
nothing.
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
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import jaxevent
from jaxevent import cache
from jaxevent.calibration.estimation import calibrate
from jaxevent.calibration.result import Calibration, CalibrationValue
from jaxevent.calibration.sampling import Sample
from jaxevent.io import toml
from jaxevent.parameters import CALIBRATION_TABLE
from jaxevent.recording import Recording

N_EVENT_SAMPLES = 64  # pieces of the events that are hashed
SAMPLE_EVENTS = 4096  # events of a piece
N_FRAME_SAMPLES = 24  # frames that are hashed
N_KEPT_FILES = 500  # of calibrations; the oldest are removed
N_KEPT_IN_MEMORY = 32

_FIELDS = "fields"  # name of the array that holds the JSON of all fields
_memory: collections.OrderedDict[str, Any] = collections.OrderedDict()


def recall_calibration(
    recording: Recording, I0: float = 1.0, sample: Sample | None = None
) -> Calibration:
    """Return the calibration of a recording, which is computed once for its content.

    Args:
        recording: The recording.
        I0: Offset inside the logarithm, L = ln(I + I0), for which thresholds hold.
        sample: A sample of it (`sampling.take_sample`); None: it is taken where it is needed.

    Returns:
        The same as `jaxevent.calibrate` returns.
    """
    key = hash_content(recording, I0)
    return _recall(key, lambda: calibrate(recording, I0, sample), encode, decode)


def recall_numbers(
    recording: Recording, what: str, compute: Callable[[], Mapping[str, float]]
) -> dict[str, float]:
    """Return numbers that a recording determines, which are computed once for its content.

    Args:
        recording: The recording.
        what: All else that the numbers depend on, in words.
        compute: A function that finds them.

    Returns:
        The numbers by name.
    """
    key = hash_content(recording, what)
    found = _recall(key, compute, lambda numbers: json.dumps(numbers).encode(), json.loads)
    return dict(found)


def _recall(
    key: str,
    compute: Callable[[], Any],
    to_bytes: Callable[[Any], bytes],
    of_bytes: Callable[[bytes], Any],
) -> Any:
    """Return the value of a key: from memory, from the folder, or computed and kept in both.

    Args:
        key: The key.
        compute: Function that computes the value.
        to_bytes: Function that encodes it.
        of_bytes: Function that decodes it.
    """
    found = _memory.get(key)
    if found is None:
        found = _read(key, of_bytes)
    if found is None:
        found = compute()
        _write(key, to_bytes(found))
    _memory[key] = found
    while len(_memory) > N_KEPT_IN_MEMORY:
        _memory.popitem(last=False)
    return found


def hash_content(recording: Recording, what: float | str) -> str:
    """Hash samples of a recording, its sizes, the source of the estimator and the request.

    Args:
        recording: The recording.
        what: Offset inside the logarithm, or words.

    Returns:
        Hexadecimal digits.
    """
    whole = hashlib.blake2b(digest_size=16)

    def feed(*values: Any) -> None:
        for value in values:
            array = np.ascontiguousarray(value)
            whole.update(f"{array.dtype.str} {array.shape};".encode())
            whole.update(array.tobytes())

    whole.update(f"{jaxevent.__version__} {_hash_source()} {what!r};".encode())
    source, frames = recording.events, recording.frames
    feed(recording.width, recording.height, len(source))
    starts = np.arange(0, len(source), SAMPLE_EVENTS)
    for first in _choose_evenly(starts, N_EVENT_SAMPLES).tolist():
        events = source[first : first + SAMPLE_EVENTS]
        feed(events.t, events.x, events.y, events.p)
    if frames is not None:
        rows = _choose_evenly(np.arange(len(frames)), N_FRAME_SAMPLES)
        feed(frames.t, frames.exposure, recording.gain, np.asarray(frames.images[rows]))
        for name in ("response", "certainty", "f_Q"):
            if name in recording.extra:
                feed(recording.extra[name])
    return whole.hexdigest()


def _choose_evenly(values: NDArray[np.integer], count: int) -> NDArray[np.integer]:
    """Choose evenly spread values, the first and the last among them.

    Args:
        values: (n,) values.
        count: Most values to choose.

    Returns:
        (at most count,) values.
    """
    if len(values) <= count:
        return values
    return values[np.linspace(0, len(values) - 1, count).round().astype(int)]


@functools.cache
def _hash_source() -> str:
    """Hash the files of estimators and of methods that refine what these find."""
    package = Path(__file__).parents[1]
    files = [
        file
        for folder in ("calibration", "reconstruction")
        for file in sorted((package / folder).rglob("*.py"))
    ]
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


def format_toml(
    calibration: Calibration,
    I0: float,
    source: str,
    methods: Mapping[str, Mapping[str, float]] | None = None,
) -> str:
    """Format a calibration as a TOML file, which `Parameters.load` reads.

    Args:
        calibration: The calibration.
        I0: Offset inside the logarithm that its thresholds hold for.
        source: Name of the recording, for a remark.
        methods: Numbers of single methods by name, which win over the calibration there.

    Returns:
        The text: a table `[calibration]` of values, one of their 95 % intervals, and one for each
            of the methods.
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
    for name, numbers in (methods or {}).items():
        intervals += ["", f"[{toml.key(name)}]"]
        intervals += [f"{key} = {value!r}" for key, value in numbers.items()]
    return "\n".join([*lines, "", *intervals]) + "\n"


def _read(key: str, of_bytes: Callable[[bytes], Any]) -> Any:
    """Return the value that is stored under a key; None if it is missing or damaged.

    Args:
        key: Key of the value, the name of its file.
        of_bytes: Function that decodes a file's bytes.

    Returns:
        The value, or None.
    """
    folder = cache.folder_for_calibrations()
    with contextlib.suppress(Exception):  # whatever NumPy says of damaged archives
        if folder is not None:
            return of_bytes((folder / f"{key}.kept").read_bytes())
    return None


def _write(key: str, content: bytes) -> None:
    """Store a result where this is possible, and at most `N_KEPT_FILES` in all."""
    folder = cache.folder_for_calibrations()
    if folder is None:
        return
    with contextlib.suppress(OSError):
        descriptor, name = tempfile.mkstemp(dir=folder)
        try:
            with os.fdopen(descriptor, "wb") as file:
                file.write(content)
            os.replace(name, folder / f"{key}.kept")
        except BaseException:
            os.unlink(name)
            raise
        files = sorted(folder.glob("*.kept"), key=lambda path: path.stat().st_mtime_ns)
        for path in files[:-N_KEPT_FILES]:
            path.unlink(missing_ok=True)
