"""AEDAT 2 recordings of DAVIS cameras and the DVS128 (jAER): events, frames, inertial samples.

After lines of text that begin with "#" every record is 8 bytes, big-endian: an address and a time
in us. The address, by its bits:

    31     0: an event; 1: a sample of a frame or of the IMU
    30-22  row, from the bottom        21-12  column
    11-10  of events: polarity, and whether it is an external trigger (kept in
           `Recording.triggers`); of samples: 0 reset level, 1 signal level, 3 IMU
    9-0    the level that the converter measured
    30-28, 27-12  of the IMU: which of its seven values, and the value

Events are mirrored: jAER turns their columns round, not those of frames. A frame is the reset level
of each pixel less its signal level: 10 bits, stretched to uint16. With a global shutter the pixels
are exposed from the last reset to the first signal, with a rolling one each between its own two
samples; the middle of both is the mean of all samples' times, which is the frame's time. Frames
with missing samples, as at both ends of a file, are left out and counted in
`extra["incomplete_frames"]`. Full scales of the IMU and the shutter are taken from jAER's
preferences in the header, else 1000 degrees/s, 8 g and global. The axes are those of the chip.
The DVS128 has addresses of its own: bit 0 polarity (1 is OFF), 7-1 column from the right, 14-8 row
from the bottom, 15 and 31 an external trigger; checked against files written by jAER's layout.

The counter of time continues over its overflow (2^32 us).

Decoder. Those that exist are GPL (jAER itself LGPL), and the records are of one length: decoded
here by NumPy, 18 million events/s. The events of rotating_disk_imu.aedat equal an unpacked copy's
in all 374,296, its 7,384 inertial samples in all values. No file with frames was at hand: they are
checked against files written in the tests by the layout above, as jAER's own decoder states it.
"""

import dataclasses
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxevent.errors import InputError
from jaxevent.io import reading
from jaxevent.io.decoded import BLOCK, Columns, DecodedImages, TriggerList, decoded
from jaxevent.io.options import ReadOptions
from jaxevent.recording import Frames, Imu, Recording

MAGIC = b"#!AER-DAT2"
_STANDARD_GRAVITY = 9.80665  # m/s^2
_LONGEST_HEADER = 1 << 24
_SIZES = (  # by the name of the chip in lower case
    ("davis240", (240, 180)),
    ("davis346", (346, 260)),
    ("davis640", (640, 480)),
    ("davis128", (128, 128)),
    ("davis208", (208, 192)),
)
# jAER's chips whose addresses are the DVS128's; those of two sensors have more.
_DVS128 = {"dvs128", "tmpdiff128", "dvs128phidget", "arctds_dvs128"}
_RESET, _SIGNAL, _IMU = 0, 1, 3


@dataclasses.dataclass(frozen=True)
class _Header:
    size: tuple[int, int]
    start: int
    gyro_scale: float  # rad/s per unit
    acc_scale: float  # m/s^2 per unit
    global_shutter: bool
    is_dvs128: bool


@dataclasses.dataclass(frozen=True)
class _Pass:
    """The samples of one kind of one frame: which records, and their times' mean and ends."""

    first: int
    last: int
    samples: int
    mean: float
    begin: int
    end: int


def read(path: Path, options: ReadOptions) -> Recording:
    """Read a file. Raises `InputError` for bad input."""
    source = str(path)
    with reading(source):
        header = _header(path, options.size)
        length = path.stat().st_size - header.start
    if length % 8:
        raise InputError(
            f"{path}: ends inside a record, {length % 8} bytes after the last whole one of 8 "
            "bytes; the recording was cut off, so fetch it again or drop these bytes: truncate "
            f"-s -{length % 8} FILE"
        )
    if header.is_dvs128:
        return _read_dvs128(path, header, options)
    width, height = header.size
    found: Counter[str] = Counter()
    triggers = TriggerList()
    levels = _Levels(width, height)
    imu: list[tuple[NDArray[np.int64], NDArray[np.int16]]] = []
    left = np.empty((0, 2), np.int64)

    def decode(state: Any) -> Iterator[tuple[Any, Columns]]:
        nonlocal left
        for here, first, a, t in _records(path, header.start, state):
            is_event = a >> 31 == 0
            if here not in seen:  # on the first pass, samples are collected too
                seen.add(here)
                kind = a >> 10 & 3
                levels.add(first, a, t, ~is_event & (kind == _RESET), _RESET)
                levels.add(first, a, t, ~is_event & (kind == _SIGNAL), _SIGNAL)
                chosen = ~is_event & (kind == _IMU)
                left = _imu_samples(np.concatenate([left, _stack(a, t, chosen)]), imu, found)
                triggers.add(first, t[is_event & (a >> 10 & 1 == 1)], -1, 0)
                if unknown := int(np.count_nonzero(~is_event & (kind == 2))):
                    found["samples_of_unknown_kind"] += unknown
            chosen = is_event & (a >> 10 & 1 == 0)
            a, t = a[chosen], t[chosen]
            x = width - 1 - (a >> 12 & 0x3FF)
            y = height - 1 - (a >> 22 & 0x1FF)
            yield here, (t, x, y, a >> 11 & 1 == 1)

    seen: set = set()
    events = decoded(decode, header.size, source, options)
    if len(left):
        found["incomplete_imu_samples"] += 1
    frames, incomplete = _frames(path, header, levels)
    if incomplete:
        found["incomplete_frames"] = incomplete
    if frames is not None and options.in_memory:
        frames = dataclasses.replace(frames, images=np.asarray(frames.images))
    extra = {name: np.array(number) for name, number in sorted(found.items())}
    return Recording(
        path.stem,
        *header.size,
        events,
        frames,
        imu=_inertial(imu, header),
        extra=extra,
        triggers=triggers.all(),
    )


def _read_dvs128(path: Path, header: _Header, options: ReadOptions) -> Recording:
    triggers = TriggerList()

    def decode(state: Any) -> Iterator[tuple[Any, Columns]]:
        for here, first, a, t in _records(path, header.start, state):
            if (a >> 16 & 0x7FFF).any():
                row = first + int(np.argmax(a >> 16 & 0x7FFF))
                raise InputError(
                    f"{path}: record {row} has the address {int(a[row - first]):#x}, which the "
                    "DVS128 lacks; the file is damaged or of another chip"
                )
            special = a & 0x80008000 != 0
            triggers.add(first, t[special], -1, 0)
            a, t = a[~special], t[~special]
            yield here, (t, 127 - (a >> 1 & 0x7F), 127 - (a >> 8 & 0x7F), a & 1 == 0)

    events = decoded(decode, header.size, str(path), options)
    return Recording(path.stem, *header.size, events, triggers=triggers.all())


def _header(path: Path, size: tuple[int, int] | None) -> _Header:
    with path.open("rb") as file:
        head = file.read(_LONGEST_HEADER)
    at = 0
    while head.startswith(b"#", at) and (stop := head.find(b"\n", at)) >= 0:
        at = stop + 1
        if head[:at].rstrip().endswith(b"#!END-HEADER"):
            break
    text = head[:at].decode("latin-1")
    chip = re.search(r"^#\s*AEChip:\s*(\S+)", text, re.MULTILINE)
    name = chip.group(1).rpartition(".")[2] if chip else ""
    known = next((size for key, size in _SIZES if name.lower().startswith(key)), None)
    known = (128, 128) if name.lower() in _DVS128 else known
    if name and known is None:
        raise InputError(
            f"{path}: was recorded by the chip {name[:40]}, but only DAVIS cameras' and DVS128's "
            "AEDAT 2 files can be read; convert it to AEDAT 4 with jAER or DV"
        )
    tick = re.search(r"[Tt]imestamps? tick is ([\d.]+) *(\w+)", text)
    if tick and (tick[2] not in ("us", "microseconds") or float(tick[1]) != 1):
        raise InputError(
            f"{path}: its times count ticks of {tick[1]} {tick[2]}; only ticks of 1 us can be "
            "read, so convert it with jAER"
        )
    size = size or known
    if size is None:
        raise InputError(
            f"{path}: the header does not tell the chip; give the size of the DAVIS sensor, "
            "size=(width, height) or --size"
        )

    def preference(key: str, otherwise: str) -> str:
        match = re.search(rf'key="{key}" value="([^"]*)"', text)
        return match.group(1) if match else otherwise

    # Units per full scale as the InvenSense MPU-6150 counts: 32768.
    degrees = _last_number(preference("ImuGyroScale", ""), {250, 500, 1000, 2000}, 1000)
    g = _last_number(preference("ImuAccelScale", ""), {2, 4, 8, 16}, 8)
    shutter = preference(f"{re.escape(name)}.[gG]lobalShutter", "true")
    # 16.4 units per degree/s at 2000 full scale, as its data sheet and jAER round it.
    return _Header(
        size,
        at,
        float(np.deg2rad(1 / (16.4 * 2000 / degrees))),
        _STANDARD_GRAVITY * g / 32768,
        shutter.lower() != "false",
        name.lower() in _DVS128,
    )


def _last_number(text: str, allowed: set[int], otherwise: int) -> int:
    match = re.search(r"(\d+)$", text)
    return int(match.group(1)) if match and int(match.group(1)) in allowed else otherwise


def _records(path: Path, start: int, state: Any) -> Iterator[tuple[Any, int, NDArray, NDArray]]:
    """Blocks of records from `state` on: the state, the first one's number, addresses and times."""
    offset, before = state or (start, None)
    with path.open("rb") as file:
        file.seek(offset)
        while len(words := np.fromfile(file, ">u4", 2 * BLOCK)):
            state = (offset, before)
            a, t = words[0::2].astype(np.int64), words[1::2].astype(np.int64)
            # The counter is signed and rarely starts below 0; a fall by half its range is its end.
            before = int(t[0]) if before is None else before
            steps = np.diff(t, prepend=before & 0xFFFFFFFF)
            t += (before >> 32 << 32) + (np.cumsum(steps < -(1 << 31)) << 32)
            yield state, (offset - start) // 8, a, t
            before = int(t[-1])
            offset += words.nbytes


def _stack(a: NDArray, t: NDArray, chosen: NDArray) -> NDArray[np.int64]:
    return np.stack([a[chosen], t[chosen]], axis=1)


def _imu_samples(
    records: NDArray[np.int64],
    imu: list[tuple[NDArray[np.int64], NDArray[np.int16]]],
    found: Counter[str],
) -> NDArray[np.int64]:
    """Keep whole samples, seven records of codes 0 to 6; what is left may begin the next one."""
    code = records[:, 0] >> 28 & 7
    begins = np.flatnonzero(code == 0)
    rest = len(records)
    if len(begins) and len(records) - begins[-1] < 7:
        rest = int(begins[-1])
    elif not len(begins):
        rest = len(records) if len(records) >= 7 else 0
    begins = begins[begins + 7 <= len(records)]
    rows = begins[:, None] + np.arange(7)
    whole = (code[rows] == np.arange(7)).all(axis=1)
    rows = rows[whole]
    unused = rest - 7 * len(rows)
    if unused > 0:
        found["incomplete_imu_samples"] += -(-unused // 7)
    values = (records[rows, 0] >> 12 & 0xFFFF).astype(np.uint16).view(np.int16)
    imu.append((records[rows[:, 0], 1], values))
    return records[rest:]


def _inertial(
    imu: list[tuple[NDArray[np.int64], NDArray[np.int16]]], header: _Header
) -> Imu | None:
    t = np.concatenate([np.empty(0, np.int64)] + [times for times, _ in imu])
    if not len(t):
        return None
    values = np.concatenate([values for _, values in imu]).astype(np.float64)
    return Imu(t, values[:, 4:] * header.gyro_scale, values[:, :3] * header.acc_scale)


class _Levels:
    """Which records hold the reset and the signal levels of each frame.

    Every readout goes from one corner of the sensor to the opposite one, so that a readout begins
    with a sample of a corner that follows one of a corner among the samples of its kind, with no
    other in between, or with the first sample of all.
    """

    def __init__(self, width: int, height: int):
        self._size = width, height
        self._corner_before = {_RESET: True, _SIGNAL: True}
        self.passes: dict[int, list[_Pass]] = {_RESET: [], _SIGNAL: []}

    def add(self, first: int, a: NDArray, t: NDArray, chosen: NDArray, kind: int) -> None:
        rows = np.flatnonzero(chosen)
        if not len(rows):
            return
        width, height = self._size
        x, y = a[rows] >> 12 & 0x3FF, a[rows] >> 22 & 0x1FF
        corner = ((x == 0) | (x == width - 1)) & ((y == 0) | (y == height - 1))
        begins = corner & np.concatenate([[self._corner_before[kind]], corner[:-1]])
        self._corner_before[kind] = bool(corner[-1])
        passes = self.passes[kind]
        for piece in np.split(np.arange(len(rows)), np.flatnonzero(begins)):
            if not len(piece):
                continue
            times = t[rows[piece]]
            one = _Pass(
                first + int(rows[piece[0]]),
                first + int(rows[piece[-1]]),
                len(piece),
                float(times.mean()),
                int(times[0]),
                int(times[-1]),
            )
            if passes and not begins[piece[0]]:
                one = _merged(passes.pop(), one)
            passes.append(one)


def _merged(a: _Pass, b: _Pass) -> _Pass:
    number = a.samples + b.samples
    # Relative to one of them: a time in float64 keeps its us to 285 years.
    mean = a.mean + (b.mean - a.mean) * (b.samples / number)
    return _Pass(a.first, b.last, number, mean, a.begin, b.end)


def _frames(path: Path, header: _Header, levels: _Levels) -> tuple[Frames | None, int]:
    """The frames of which every sample is there, and the number of the others."""
    width, height = header.size
    resets, signals = levels.passes[_RESET], levels.passes[_SIGNAL]
    starts = np.array([one.first for one in resets])
    whole: list[tuple[_Pass, _Pass]] = []
    for signal in signals:
        row = int(np.searchsorted(starts, signal.first)) - 1 if len(starts) else -1
        if row < 0:
            continue
        pair = (resets[row], signal)
        if all(one.samples == width * height for one in pair):
            if not whole or whole[-1][0] is not pair[0]:
                whole.append(pair)
    incomplete = max(len(resets), len(signals)) - len(whole)
    if not whole:
        return None, incomplete
    t = np.array([(reset.mean + signal.mean) / 2 for reset, signal in whole])
    if header.global_shutter:
        exposure = [signal.begin - reset.end for reset, signal in whole]
    else:
        exposure = [round(signal.mean - reset.mean) for reset, signal in whole]
    images = DecodedImages(
        lambda row: (_image(path, header, *pair) for pair in whole[row:]),
        (len(whole), height, width),
        np.dtype(np.uint16),
        str(path),
    )
    exposure = np.maximum(np.array(exposure, np.int64), 0)
    return Frames(np.rint(t).astype(np.int64), images, exposure), incomplete


def _image(path: Path, header: _Header, reset: _Pass, signal: _Pass) -> NDArray[np.uint16]:
    width, height = header.size
    levels = []
    for one, kind in ((reset, _RESET), (signal, _SIGNAL)):
        a = np.fromfile(
            path, ">u4", 2 * (one.last - one.first + 1), offset=header.start + 8 * one.first
        )
        a = a[0::2].astype(np.int64)
        a = a[(a >> 31 == 1) & (a >> 10 & 3 == kind)]
        level = np.zeros((height, width), np.int64)
        level[height - 1 - (a >> 22 & 0x1FF), a >> 12 & 0x3FF] = a & 0x3FF
        levels.append(level)
    grey = np.clip(levels[0] - levels[1], 0, 1023)
    return (grey << 6 | grey >> 4).astype(np.uint16)
