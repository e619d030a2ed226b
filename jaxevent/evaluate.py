"""Reconstructions compared with images they have not seen, for every recording and method.

    recordings = ["slider_depth.zip", "more/*.h5"]  # paths or globs; $NAME is expanded
    protocol = "held-out"                           # the default
    size = [240, 180]                               # only for recordings that do not tell it

    [[method]]
    name = "akf"                                    # a key of jaxevent.METHODS
    params = { c_on = 0.08, clock_offset = 0.0075 } # or the path of a TOML file; omitted: defaults
    label = "akf, by hand"                          # in the table; omitted: the name

Paths are relative to the folder of this file. The protocol "held-out" gives the methods frames 0,
2, 4, ... and asks for images where frames 1, 3, 5, ... are, at their time stamps plus the method's
`clock_offset`. Images are clipped to [0, 1], the range of the truth, before they are scored.
"""

import contextlib
import dataclasses
import glob
import json
import math
import os
import re
import shutil
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxevent.errors import InputError
from jaxevent.io import load
from jaxevent.io.output import complete
from jaxevent.metrics import mse, ssim
from jaxevent.parameters import nearest, read_toml
from jaxevent.reconstruction import METHODS
from jaxevent.reconstruction.augment import FrameParams
from jaxevent.reconstruction.estimator import Estimator
from jaxevent.recording import Frames, Recording
from jaxevent.report import markdown_table


def held_out(recording: Recording) -> tuple[Recording, Frames]:
    """The recording with every second frame, and the frames taken out of it.

    Raises `InputError` for fewer than 3 frames and for no events.
    """
    frames = recording.frames
    if frames is None or len(frames) < 3:
        raise InputError(
            f"{recording.name}: has {0 if frames is None else len(frames)} frames; hiding every "
            "second one needs at least 3, so choose a recording with more"
        )
    if not len(recording.events):
        raise InputError(
            f"{recording.name}: holds no events, so there is nothing to reconstruct from; choose "
            "another recording"
        )
    return recording.with_frames(slice(0, None, 2)), frames[1::2]


Protocol = Callable[[Recording], tuple[Recording, Frames]]
PROTOCOLS: dict[str, Protocol] = {"held-out": held_out}


def find_method(name: str) -> Estimator:
    """The method of that name; raises `InputError` naming the nearest."""
    if name not in METHODS:
        raise InputError(f"there is no method {name!r}; {nearest(name, METHODS)}")
    return METHODS[name]


def values_of(params: FrameParams) -> dict[str, float | None]:
    """The physical values as they were given, to 6 digits; None where JSON has no number."""
    return {name: _finite(float(f"{value:.6g}")) for name, value in params.values().items()}


def frame_times(frames: Frames, params: FrameParams) -> np.ndarray:
    """When the frames were taken (us) on the events' clock: time stamps plus `clock_offset`."""
    return frames.t + round(float(params.clock_offset) * 1e6)


def score(
    recording: Recording,
    method: Estimator,
    params: FrameParams | None = None,
    protocol: str = "held-out",
    *,
    progress: bool = False,
) -> dict[str, Any]:
    """Reconstruct the images that `protocol` hides, and compare: one row of a table of results.

    Memory does not grow with the recording's length. Intensities are clipped to [0, 1] before they
    are compared; `mse` and `ssim` are means over the images. `seconds` is the time of
    reconstructing and reading images, with compilation but without scoring. What is not a number is
    None. `per_frame` lists t (us, as stamped), mse and ssim of every image.

    Raises `InputError` for a recording that the protocol or the method cannot use.
    """
    if protocol not in PROTOCOLS:
        raise InputError(f"there is no protocol {protocol!r}; {nearest(protocol, PROTOCOLS)}")
    values = params or method.Params()
    given, hidden = PROTOCOLS[protocol](recording)
    clock = time.perf_counter()
    seconds, done = 0.0, 0
    errors: list[float] = []
    similarities: list[float] = []
    video = method.reconstruct(given, values, progress=progress)
    for _, images, _ in video.batches(frame_times(hidden, values)):
        seconds += time.perf_counter() - clock
        truths = hidden[done : done + len(images)].intensity
        done += len(images)
        for image, truth in zip(np.clip(images, 0, 1), truths, strict=True):
            known = bool(np.isfinite(image).all())
            errors.append(float(mse(image, truth)) if known else math.nan)
            similarities.append(float(ssim(image, truth)) if known else math.nan)
        clock = time.perf_counter()
    return {
        "recording": recording.name,
        "method": method.name,
        "mse": _finite(float(np.mean(errors))),
        "ssim": _finite(float(np.mean(similarities))),
        "frames": len(errors),
        "events": len(recording.events),
        "seconds": seconds,
        "params": values_of(values),
        "per_frame": {
            "t": [int(t) for t in hidden.t],
            "mse": [_finite(value) for value in errors],
            "ssim": [_finite(value) for value in similarities],
        },
    }


def evaluate(
    config: str | Path, out: str | Path | None = None, progress: bool = False
) -> list[dict[str, Any]]:
    """Run an evaluation that a TOML file describes: one row, as of `score`, per recording, method.

    The file's layout is in the text of this module. In a row, `recording` is the path as the file
    gives it and `method` is the label.

    Args:
        config: The TOML file.
        out: A folder for results.json ({"rows": [...]}), results.md (the table) and config.toml
            (the file as it was run); made if missing. Existing results are replaced at the end.
        progress: Show a bar on stderr while a method takes long.

    Raises:
        InputError: The file, a recording or a parameter cannot be used, or `out` not be written.
    """
    plan = read_plan(Path(config))
    with contextlib.ExitStack() as stack:
        text = Path(config).read_bytes()
        write = None if out is None else stack.enter_context(results(Path(out)))
        rows = []
        for given, path in plan.recordings:
            recording = load(path, plan.size, in_memory=False, progress=progress)
            recording = dataclasses.replace(recording, name=str(path))  # for messages
            for label, method, params in plan.methods:
                row = score(recording, method, params, plan.protocol, progress=progress)
                rows.append({**row, "recording": given, "method": label})
        if write is not None:
            write("config.toml", text)
            write_rows(rows, write)
    return rows


Write = Callable[[str, bytes], None]


def write_rows(rows: Iterable[Mapping[str, Any]], write: Write) -> None:
    """Write results.json and results.md by a function that `results` gives."""
    rows = list(rows)
    text = json.dumps({"rows": rows}, indent=1, allow_nan=False) + "\n"
    write("results.json", text.encode())
    write("results.md", markdown_table(rows).encode())


@contextlib.contextmanager
def results(folder: Path) -> Iterator[Write]:
    """Open a folder for results, made if missing; gives the function `write(name, content)`.

    A folder made here is removed again if the block raises. Raises `InputError` if the folder
    cannot be made.
    """
    made = not folder.exists()
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise InputError(
            f"{folder}: the folder cannot be made ({error.strerror}); choose a place for a new "
            "folder in an existing, writable one"
        ) from None

    def write(name: str, content: bytes) -> None:
        with complete(folder / name) as partial:
            partial.write_bytes(content)

    try:
        if not os.access(folder, os.W_OK):  # before hours of computing
            raise InputError(f"{folder}: is not writable; choose another folder")
        yield write
    except BaseException:
        if made:
            shutil.rmtree(folder, ignore_errors=True)
        raise


@dataclasses.dataclass(frozen=True)
class Plan:
    """A checked configuration: recordings (as given, path), methods (label, method, params)."""

    recordings: list[tuple[str, Path]]
    methods: list[tuple[str, Estimator, FrameParams]]
    protocol: str
    size: tuple[int, int] | None


def read_plan(config: Path) -> Plan:
    """Read and check a configuration; raises `InputError` naming the file and the setting."""
    table = read_toml(config)
    try:
        _refuse_unknown(table, ("recordings", "protocol", "size", "method"))
        protocol = table.get("protocol", "held-out")
        if protocol not in PROTOCOLS:
            near = nearest(str(protocol), PROTOCOLS)
            raise InputError(f"there is no protocol {protocol!r}; {near}")
        size = table.get("size")
        if size is not None and not (
            isinstance(size, list) and len(size) == 2 and all(type(n) is int for n in size)
        ):
            raise InputError(f"size is {size!r}; give [width, height] in pixels")
        recordings = _recordings(table.get("recordings"), config.parent)
        return Plan(
            recordings,
            _methods(table.get("method"), config.parent),
            protocol,
            None if size is None else (size[0], size[1]),
        )
    except InputError as error:
        raise InputError(f"{config}: {error}") from None


def _recordings(given: Any, folder: Path) -> list[tuple[str, Path]]:
    if not (isinstance(given, list) and given and all(isinstance(one, str) for one in given)):
        raise InputError('recordings is missing or not a list; give recordings = ["file.zip", ...]')
    found: dict[Path, str] = {}
    for text in given:
        expanded = os.path.expanduser(os.path.expandvars(text))
        unset = re.search(r"\$(\w+|\{[^}]*\})", expanded)
        if unset and not (folder / expanded).exists():
            name = unset.group(1).strip("{}")
            raise InputError(f"the recording {text!r} needs the variable {name}, which is not set")
        if not glob.has_magic(expanded) or (folder / expanded).exists():
            found.setdefault(folder / expanded, text)
            continue
        matches = sorted(glob.glob(expanded, root_dir=folder, recursive=True))
        if not matches:
            raise InputError(f"no recording matches {text!r} in {folder}; correct the pattern")
        for match in matches:
            found.setdefault(folder / match, match)
    return [(text, path) for path, text in found.items()]


def _methods(given: Any, folder: Path) -> list[tuple[str, Estimator, FrameParams]]:
    if not (isinstance(given, list) and given and all(isinstance(one, dict) for one in given)):
        raise InputError('no method is given; add [[method]] with name = "akf"')
    methods: list[tuple[str, Estimator, FrameParams]] = []
    for number, entry in enumerate(given, 1):
        try:
            _refuse_unknown(entry, ("name", "params", "label"))
            name = entry.get("name")
            label = entry.get("label", name)
            if not isinstance(name, str) or not isinstance(label, str):
                raise InputError('name and label must be text; give name = "akf"')
            method, values = find_method(name), entry.get("params", {})
            if isinstance(values, str):
                params = method.Params.load(folder / os.path.expandvars(values))
            elif isinstance(values, dict):
                params = method.Params.of(values)
            else:
                raise InputError(f"params is {values!r}; give a table or the path of a TOML file")
            methods.append((label, method, params))
        except InputError as error:
            raise InputError(f"method {number}: {error}") from None
    return methods


def _refuse_unknown(table: Mapping[str, Any], known: tuple[str, ...]) -> None:
    for name in table:
        if name not in known:
            raise InputError(f"there is no setting {name!r}; {nearest(name, known)}")


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
