"""AEDAT recordings: version 2 of DAVIS cameras and the DVS128 (jAER), and version 4 (iniVation DV).

AEDAT 2 holds events, frames and inertial samples. After lines of text that begin with "#" every
record is 8 bytes, big-endian: an address and a time in us. The address, by its bits:

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

Decoder of AEDAT 2. Those that exist are GPL (jAER itself LGPL), and the records are of one length:
decoded here by NumPy, 18 million events/s. The events of rotating_disk_imu.aedat equal an unpacked
copy's in all 374,296, its 7,384 inertial samples in all values. No file with frames was at hand:
they are checked against files written in the tests by the layout above, as jAER's own decoder
states it.

AEDAT 4 holds events, frames with their exposures and IMU samples. The file is a row of packets,
each of one stream: events (t in us, x, y from the top left, p), frames, inertial samples or
triggers. Kept are one stream of events and what stands beside it: the only stream of frames and of
samples, or the one with the same number among its kind. Streams that are not kept are named in
`extra["streams_left_out"]`; a file with several cameras needs the number of the stream of events.
Times stay those of the file. A frame's time is the middle of its exposure; where the file has no
exposure, its own timestamp. Colour frames become grey (ITU-R 601 luma) and are kept in
`extra["rgb"]`. Samples turn from g into m/s^2 (9.80665) and from degrees into radians per second.
Triggers have the number of DV's type as channel: 1 and 2 are the edges of a signal from outside, 3
its pulse, 4 and 5 those of the generator, 6 to 9 starts and ends of frames.

Decoder of AEDAT 4. The package aedat (MIT) is taken: it is small and fast, and gives frames and
both ends of their exposures. dv-processing decodes the same file (davis346.aedat4) to the same
78,830 events, 59 frames with exposures and 2,363 samples; it gives a frame the start of its
exposure as time and takes g as 9.81. aedat reports most damage, but some as a Rust panic, which is
no Exception, and a header whose text is damaged ends the whole process; so header and packets are
checked here first.
"""

import contextlib
import dataclasses
import re
import struct
import warnings
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from jaxevent.arrays import times
from jaxevent.errors import InputError, require
from jaxevent.io import decoded
from jaxevent.io.checks import (
    GRAVITY_M_S2,
    ReadOptions,
    check_unfolded,
    check_whole_records,
    damaged,
    reading,
    sensor_size,
)
from jaxevent.io.decoded import Columns, DecodedImages, FirstPass, gather_pieces, read_events
from jaxevent.io.images import gather_frames
from jaxevent.recording import Frames, Imu, Recording

_MAX_HEADER_BYTES = 1 << 24  # bytes
_CHIP_SIZES_PX = (  # by the name of the chip in lower case
    ("davis240", (240, 180)),
    ("davis346", (346, 260)),
    ("davis640", (640, 480)),
    ("davis128", (128, 128)),
    ("davis208", (208, 192)),
)
# jAER's chips whose addresses are the DVS128's; those of two sensors have more.
_DVS128_CHIPS = {"dvs128", "tmpdiff128", "dvs128phidget", "arctds_dvs128"}
_RESET, _SIGNAL, _IMU = 0, 1, 3


# The first bytes of LZ4 and Zstandard.
_COMPRESSION_MAGIC = (b"\x04\x22\x4d\x18", b"\x28\xb5\x2f\xfd")


@dataclasses.dataclass(frozen=True)
class _Header:
    """The header of AEDAT 2."""

    size: tuple[int, int]
    start: int
    gyro_scale: float  # rad/s per unit
    acc_scale: float  # m/s^2 per unit
    global_shutter: bool
    is_dvs128: bool


@dataclasses.dataclass(frozen=True)
class _Readout:
    """The samples of one kind of one frame: the rows of their records, and their times."""

    first: int  # row of the first record
    last: int  # row of the last record
    samples: int  # number of records
    mean: float  # mean time of the samples, us
    begin: int  # time of the first sample, us
    end: int  # time of the last sample, us


def read_aedat2(path: Path, options: ReadOptions) -> Recording:
    """Read a file of version 2.

    Args:
        path: The file.
        options: Options of `jaxevent.io.load`.

    Returns:
        The recording; unless `options.in_memory`, events and images stay in the file.

    Raises:
        InputError: The file is damaged or of another camera.
    """
    source = str(path)
    with reading(source):
        header = _read_header(path, options.size)
        check_whole_records(path, path.stat().st_size - header.start, 8)
    if header.is_dvs128:
        return _read_dvs128(path, header, options)
    width, height = header.size
    counts: Counter[str] = Counter()
    first_pass = FirstPass()
    readouts = _Readouts(width, height)
    samples = _ImuSamples(counts)
    seen: set = set()

    def decode(state: Any) -> Iterator[tuple[Any, Columns]]:
        for here, first, a, t in _records(path, header.start, state):
            is_event = a >> 31 == 0
            if here not in seen:  # on the first pass, samples are collected too
                seen.add(here)
                kind = np.where(is_event, -1, a >> 10 & 3)
                for level in (_RESET, _SIGNAL):
                    readouts.add(first, a, t, kind == level, level)
                samples.add(a[kind == _IMU], t[kind == _IMU])
                first_pass.add_triggers(first, t[is_event & (a >> 10 & 1 == 1)], -1, 0)
                if unknown := int(np.count_nonzero(kind == 2)):
                    counts["samples_of_unknown_kind"] += unknown
            chosen = is_event & (a >> 10 & 1 == 0)
            a, t = a[chosen], t[chosen]
            x = width - 1 - (a >> 12 & 0x3FF)
            y = height - 1 - (a >> 22 & 0x1FF)
            yield here, (t, x, y, a >> 11 & 1 == 1)

    events = read_events(decode, header.size, source, options)
    imu = samples.scaled(header)
    frames, incomplete = _whole_frames(path, header, readouts)
    if incomplete:
        counts["incomplete_frames"] = incomplete
    if frames is not None and options.in_memory:
        frames = dataclasses.replace(frames, images=np.asarray(frames.images))
    extra = {name: np.array(number) for name, number in sorted(counts.items())}
    return Recording(
        path.stem,
        *header.size,
        events,
        frames,
        imu=imu,
        extra=extra,
        triggers=first_pass.triggers(),
    )


def _read_dvs128(path: Path, header: _Header, options: ReadOptions) -> Recording:
    first_pass = FirstPass()

    def decode(state: Any) -> Iterator[tuple[Any, Columns]]:
        for here, first, a, t in _records(path, header.start, state):
            if (a >> 16 & 0x7FFF).any():
                row = first + int(np.argmax(a >> 16 & 0x7FFF))
                raise InputError(
                    f"{path}: record {row} has the address {int(a[row - first]):#x}, which the "
                    "DVS128 lacks; the file is damaged or of another chip"
                )
            special = a & 0x80008000 != 0
            first_pass.add_triggers(first, t[special], -1, 0)
            a, t = a[~special], t[~special]
            yield here, (t, 127 - (a >> 1 & 0x7F), 127 - (a >> 8 & 0x7F), a & 1 == 0)

    events = read_events(decode, header.size, str(path), options)
    return Recording(path.stem, *header.size, events, triggers=first_pass.triggers())


def _read_header(path: Path, size: tuple[int, int] | None) -> _Header:
    with path.open("rb") as file:
        head = file.read(_MAX_HEADER_BYTES)
    at = 0
    while head.startswith(b"#", at) and (stop := head.find(b"\n", at)) >= 0:
        at = stop + 1
        if head[:at].rstrip().endswith(b"#!END-HEADER"):
            break
    text = head[:at].decode("latin-1")
    chip = re.search(r"^#\s*AEChip:\s*(\S+)", text, re.MULTILINE)
    name = chip.group(1).rpartition(".")[2] if chip else ""
    known = next((size for key, size in _CHIP_SIZES_PX if name.lower().startswith(key)), None)
    known = (128, 128) if name.lower() in _DVS128_CHIPS else known
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
    size = sensor_size(f"{path}: the header does not name the chip", size, known)

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
        GRAVITY_M_S2 * g / 32768,
        shutter.lower() != "false",
        name.lower() in _DVS128_CHIPS,
    )


def _last_number(text: str, allowed: set[int], otherwise: int) -> int:
    match = re.search(r"(\d+)$", text)
    return int(match.group(1)) if match and int(match.group(1)) in allowed else otherwise


def _records(path: Path, start: int, state: Any) -> Iterator[tuple[Any, int, NDArray, NDArray]]:
    """Yield blocks of records of an AEDAT 2 file.

    Args:
        path: The file.
        start: Offset of the first record, bytes.
        state: State from which to go on; None at the start.

    Yields:
        The state before the block, the number of its first record, addresses (n,) and times (n,),
            us.
    """
    offset, before = state or (start, None)
    with path.open("rb") as file:
        file.seek(offset)
        while len(words := np.fromfile(file, ">u4", 2 * decoded.BLOCK_EVENTS)):
            state = (offset, before)
            a, t = words[0::2].astype(np.int64), words[1::2].astype(np.int64)
            # The counter is signed and rarely starts below 0; a fall by half its range is its end.
            before = int(t[0]) if before is None else before
            steps = np.diff(t, prepend=before & 0xFFFFFFFF)
            t += (before >> 32 << 32) + (np.cumsum(steps < -(1 << 31)) << 32)
            yield state, (offset - start) // 8, a, t
            before = int(t[-1])
            offset += words.nbytes


class _ImuSamples:
    """Inertial samples of AEDAT 2: seven records each, of codes 0 to 6."""

    def __init__(self, counts: Counter[str]):
        self._counts = counts
        self._rest = np.empty((0, 2), np.int64)  # records that may begin the next sample
        self._pieces = [(np.empty(0, np.int64), np.empty((0, 7), np.int16))]

    def add(self, a: NDArray, t: NDArray) -> None:
        """Keep the whole samples among further records.

        Args:
            a: (n,) addresses.
            t: (n,) times, us.
        """
        records = np.concatenate([self._rest, np.stack([a, t], axis=1)])
        code = records[:, 0] >> 28 & 7
        begins = np.flatnonzero(code == 0)
        rest = len(records)
        if len(begins) and len(records) - begins[-1] < 7:
            rest = int(begins[-1])
        elif not len(begins) and rest < 7:
            rest = 0
        begins = begins[begins + 7 <= len(records)]
        rows = begins[:, None] + np.arange(7)
        rows = rows[(code[rows] == np.arange(7)).all(axis=1)]
        unused = rest - 7 * len(rows)
        if unused > 0:
            self._counts["incomplete_imu_samples"] += -(-unused // 7)
        values = (records[rows, 0] >> 12 & 0xFFFF).astype(np.uint16).view(np.int16)
        self._pieces.append((records[rows[:, 0], 1], values))
        self._rest = records[rest:]

    def scaled(self, header: _Header) -> Imu | None:
        """Return all samples in SI units; None if there are none."""
        if len(self._rest):
            self._counts["incomplete_imu_samples"] += 1
        t, values = (np.concatenate(column) for column in zip(*self._pieces, strict=True))
        if not len(t):
            return None
        return Imu(t, values[:, 4:] * header.gyro_scale, values[:, :3] * header.acc_scale)


class _Readouts:
    """The records of the reset and the signal levels of each frame.

    Every readout goes from one corner of the sensor to the opposite one, so that a readout begins
    with a sample of a corner that follows one of a corner among the samples of its kind, with no
    other in between, or with the first sample of all.
    """

    def __init__(self, width: int, height: int):
        self._size = width, height
        self._corner_before = {_RESET: True, _SIGNAL: True}
        self.by_kind: dict[int, list[_Readout]] = {_RESET: [], _SIGNAL: []}

    def add(self, first: int, a: NDArray, t: NDArray, chosen: NDArray, kind: int) -> None:
        """Add samples of one kind from a block of records.

        Args:
            first: Number of the block's first record.
            a: (n,) addresses.
            t: (n,) times, us.
            chosen: (n,) whether a record is such a sample.
            kind: `_RESET` or `_SIGNAL`.
        """
        rows = np.flatnonzero(chosen)
        if not len(rows):
            return
        width, height = self._size
        x, y = a[rows] >> 12 & 0x3FF, a[rows] >> 22 & 0x1FF
        corner = ((x == 0) | (x == width - 1)) & ((y == 0) | (y == height - 1))
        begins = corner & np.concatenate([[self._corner_before[kind]], corner[:-1]])
        self._corner_before[kind] = bool(corner[-1])
        found = self.by_kind[kind]
        for piece in np.split(np.arange(len(rows)), np.flatnonzero(begins)):
            if not len(piece):
                continue
            times = t[rows[piece]]
            one = _Readout(
                first + int(rows[piece[0]]),
                first + int(rows[piece[-1]]),
                len(piece),
                float(times.mean()),
                int(times[0]),
                int(times[-1]),
            )
            if found and not begins[piece[0]]:
                one = _join_readouts(found.pop(), one)
            found.append(one)


def _join_readouts(a: _Readout, b: _Readout) -> _Readout:
    number = a.samples + b.samples
    # Relative to one of them: a time in float64 keeps its us to 285 years.
    mean = a.mean + (b.mean - a.mean) * (b.samples / number)
    return _Readout(a.first, b.last, number, mean, a.begin, b.end)


def _whole_frames(path: Path, header: _Header, readouts: _Readouts) -> tuple[Frames | None, int]:
    """Return the frames of which every sample is there, and the number of the others."""
    width, height = header.size
    resets, signals = readouts.by_kind[_RESET], readouts.by_kind[_SIGNAL]
    starts = np.array([one.first for one in resets])
    whole: list[tuple[_Readout, _Readout]] = []
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
        lambda row: (_read_image(path, header, *pair) for pair in whole[row:]),
        (len(whole), height, width),
        np.dtype(np.uint16),
        str(path),
    )
    exposure = np.maximum(np.array(exposure, np.int64), 0)
    return Frames(np.rint(t).astype(np.int64), images, exposure), incomplete


def _read_image(
    path: Path, header: _Header, reset: _Readout, signal: _Readout
) -> NDArray[np.uint16]:
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


def read_aedat4(path: Path, options: ReadOptions) -> Recording:
    """Read a file of version 4.

    Args:
        path: The file.
        options: Options of `jaxevent.io.load`: `stream` is the number of a stream of events, needed
            where there are several, and `frames` that of a stream of frames.

    Returns:
        The recording; unless `options.in_memory`, events and images stay in the file.

    Raises:
        InputError: The file is damaged, or a stream must be chosen.
    """
    source = str(path)
    with reading(source):
        _check_packets(path)
    with _decoding(path):
        aedat: Any = require("aedat", "aedat")
        streams: dict[int, dict] = dict(sorted(aedat.Decoder(path).id_to_stream().items()))
    chosen, left_out = _choose_streams(path, streams, options)
    number = chosen.get("events")
    if number is None and "frame" not in chosen:
        frames_in = (str(n) for n, stream in streams.items() if stream["type"] == "frame")
        raise InputError(
            f"{path}: holds no events, and frames in the streams {', '.join(frames_in)}; choose "
            "one with frames="
        )
    frames, imu, first_pass, extra = _read_others(path, chosen, options.in_memory)
    unread = [
        f"{other} {stream['type']}"
        for other, stream in streams.items()
        if other not in chosen.values()
    ]
    if unread:
        extra["streams_left_out"] = np.array(unread)
    stated = streams[number if number is not None else chosen["frame"]]
    size = options.size or (int(stated["width"]), int(stated["height"]))

    def decode(state: int | None) -> Iterator[tuple[int, Columns]]:
        pieces = (
            (packet, len(content["events"]), content["events"])
            for packet, content in enumerate(_packets(path))
            if packet >= (state or 0) and content["stream_id"] == number
        )
        for first, packets in gather_pieces(pieces):
            yield first, _event_columns(packets)

    events = read_events(decode, size, source, options)
    return Recording(
        path.stem, *size, events, frames, imu=imu, extra=extra, triggers=first_pass.triggers(),
        left_out=left_out,
    )  # fmt: skip


def _choose_streams(
    path: Path, streams: Mapping[int, dict], options: ReadOptions
) -> tuple[dict[str, int], dict[str, str]]:
    """Choose one stream of each kind.

    Args:
        path: The file.
        streams: Descriptions of the streams by number.
        options: Options of `jaxevent.io.load`.

    Returns:
        Numbers of streams by kind, "events", "frame", "imus" and "triggers", and the entries of
        `Recording.left_out` where there are several.

    Raises:
        InputError: There is no stream that can be read, or none that was chosen.
    """
    of_kind = {
        kind: [number for number, stream in streams.items() if stream["type"] == kind]
        for kind in ("events", "frame", "imus", "triggers")
    }
    several = of_kind["events"]
    described = [f"{n} ({streams[n]['width']}x{streams[n]['height']})" for n in several]
    name = options.choose_stream(path, "stream of events", [str(n) for n in several], described)
    if (name is None or options.without_events) and not of_kind["frame"]:
        raise InputError(f"{path}: holds no stream of events and none of frames")
    number = None if name is None or options.without_events else int(name)
    chosen = {} if number is None else {"events": number}
    left_out: dict[str, str] = {}
    for kind, field in (("frame", "frames"), ("imus", "imu"), ("triggers", "triggers")):
        held = of_kind[kind]
        listed = ", ".join(map(str, held))
        if kind == "frame" and options.without_frames:
            continue
        if kind == "frame" and options.frames is not None:
            if options.frames not in map(str, held):
                raise InputError(
                    f"{path}: has no stream of frames {options.frames!r}; its streams of frames "
                    f"are {listed or 'none'}"
                )
            chosen[kind] = int(options.frames)
        elif len(held) == 1:
            chosen[kind] = held[0]
        elif number is not None and len(held) == len(several):
            chosen[kind] = held[several.index(number)]
        elif held:
            remedy = f"; choose one with frames={held[0]}" if kind == "frame" else ""
            left_out[field] = f"the streams {listed} hold some, of which none is chosen{remedy}"
    return chosen, left_out


def _event_columns(packets: list[NDArray]) -> Columns:
    events = np.concatenate(packets)
    t = events["t"]
    # The decoder passes signed 64-bit times on as unsigned.
    return (
        t.view(np.int64) if t.dtype == np.uint64 and t.flags.c_contiguous else t.astype(np.int64),
        events["x"].copy(),
        events["y"].copy(),
        events["p"].copy(),
    )


def _read_others(
    path: Path, chosen: Mapping[str, int], in_memory: bool
) -> tuple[Frames | None, Imu | None, FirstPass, dict[str, Any]]:
    """Read frames, inertial samples and triggers in one pass.

    Args:
        path: The file.
        chosen: Numbers of the chosen streams by kind.
        in_memory: Whether to read images into memory.

    Returns:
        Frames, IMU samples, the pass with the triggers, and entries of `Recording.extra`.
    """
    stamps, exposures, samples = [], [], []
    first_pass = FirstPass()
    if not chosen.keys() & {"frame", "imus", "triggers"}:
        return None, None, first_pass, {}

    def frames_of_first_pass() -> Iterator[NDArray]:
        for number, packet in enumerate(_packets(path, strict=True)):
            if packet["stream_id"] == chosen.get("frame", -1):
                frame = packet["frame"]
                start, end = frame["exposure_begin_t"], frame["exposure_end_t"]
                known = 0 < start < end
                stamps.append(start + (end - start) // 2 if known else frame["t"])
                exposures.append(end - start if known else 0)
                yield frame["pixels"] if frame["pixels"].ndim == 2 else frame["pixels"][..., :3]
            elif packet["stream_id"] == chosen.get("imus", -1):
                samples.append(packet["imus"])
            elif packet["stream_id"] == chosen.get("triggers", -1):
                signals = packet["triggers"]
                kind = signals["source"]
                edge = np.select([np.isin(kind, (1, 4)), np.isin(kind, (2, 5))], [1, 0], -1)
                first_pass.add_triggers(number, signals["t"].astype(np.int64), edge, kind)

    def decode(row: int) -> Iterator[NDArray]:
        for packet in _packets(path):
            if packet["stream_id"] == chosen["frame"]:
                pixels = packet["frame"]["pixels"]
                if row <= 0:
                    yield pixels if pixels.ndim == 2 else pixels[..., :3]
                row -= 1

    images, extra = gather_frames(
        frames_of_first_pass(), decode, lambda n: f"{path}: frame {n}", str(path), in_memory
    )
    frames = imu = None
    if images is not None:
        t, exposure = (
            times(np.array(values), f"{path}: a frame", "frame") for values in (stamps, exposures)
        )
        frames = Frames(t, images, exposure)
    if samples:
        rows = np.concatenate(samples)
        gyro, acc = (
            np.stack([rows[f"{name}_{axis}"] for axis in "xyz"], axis=1).astype(np.float64)
            for name in ("gyroscope", "accelerometer")
        )
        imu = Imu(rows["t"].astype(np.int64), np.deg2rad(gyro), acc * GRAVITY_M_S2)
    return frames, imu, first_pass, extra


def _packets(path: Path, *, strict: bool = False) -> Iterator[dict[str, Any]]:
    """Yield the packets of a file; with `strict` a frame of an unknown kind is an error."""
    aedat: Any = require("aedat", "aedat")
    with _decoding(path):
        packets = iter(aedat.Decoder(path))
        while True:
            with warnings.catch_warnings() if strict else contextlib.nullcontext():
                if strict:
                    warnings.simplefilter("error")
                packet = next(packets, None)
            if packet is None:
                return
            yield packet


@contextlib.contextmanager
def _decoding(path: Path) -> Iterator[None]:
    """Turn exceptions of the decoder, and its panics, which are none, into an `InputError`."""
    try:
        with reading(path):
            yield
    except BaseException as error:
        if type(error).__name__ != "PanicException":
            raise
        reason = " ".join(str(error).split())[:120]
        raise damaged(f"{path}: a packet cannot be read ({reason})") from None


def _max_unfolded_packet(file: Any, at: int, size: int) -> int:
    """Return the most bytes to which a packet can unfold, by the headers of its blocks.

    LZ4 (frame format 1.6): blocks of at most 2^(8 + 2 code) bytes. Zstandard (RFC 8878): of at most
    128 KiB, those of type 1 of the size stated, from one byte.

    Args:
        file: The open file.
        at: Offset of the packet, bytes.
        size: Its size, bytes.
    """
    file.seek(at)
    head = file.read(18)
    unfolded, stop = 0, at + size
    if head[:4] == _COMPRESSION_MAGIC[0]:
        flags = head[4]
        at += 7 + 8 * (flags >> 3 & 1) + 4 * (flags & 1)
        block, checked = 1 << 8 + 2 * (head[5] >> 4 & 7), 4 * (flags >> 4 & 1)
        while at < stop and file.seek(at) and len(word := file.read(4)) == 4:
            (stored,) = struct.unpack("<I", word)
            if stored == 0:
                break
            unfolded += block
            at += 4 + (stored & 0x7FFFFFFF) + checked
    elif head[:4] == _COMPRESSION_MAGIC[1]:
        flags = head[4]
        single = flags >> 5 & 1
        at += 5 + (1 - single) + (0, 1, 2, 4)[flags & 3]
        at += (single, 2, 4, 8)[flags >> 6]
        last = 0
        while not last and at < stop and file.seek(at) and len(word := file.read(3)) == 3:
            value = int.from_bytes(word, "little")
            last, kind, stored = value & 1, value >> 1 & 3, value >> 3
            unfolded += 1 << 17 if kind == 2 else stored
            at += 3 + (1 if kind == 1 else stored)
    return unfolded


def _is_packet_table(file: Any, at: int, length: int) -> bool:
    """Return whether the table of packets, plain or compressed, or the end of file is at a byte.

    Decoders stop there: a packet in its place would hide those after it.

    Args:
        file: The open file.
        at: Offset, bytes.
        length: Size of the file, bytes.
    """
    file.seek(at)
    head = file.read(12)
    return at == length or head[:4] in _COMPRESSION_MAGIC or head[8:12] == b"FTAB"


def _check_packets(path: Path) -> None:
    """Check the header, and that the packets fill the file, to the table of packets or the end.

    The header is a FlatBuffers table: its second field is the place of that table (-1: none), its
    third an XML text that names the streams.
    """
    length = path.stat().st_size
    wrong = damaged(f"{path}: its header is not valid")
    with path.open("rb") as file:
        head = file.read(18)
        (size,) = struct.unpack_from("<I", head, 14)
        if not 8 <= size <= length - 18:
            raise damaged(f"{path}: its header ends early")
        header = file.read(size)
        try:
            (root,) = struct.unpack_from("<I", header)
            (back,) = struct.unpack_from("<i", header, root)
            if root < back:
                raise wrong
            fields, _, _, for_table, for_text = struct.unpack_from("<5H", header, root - back)
            if header[4:8] != b"IOHE" or fields < 10 or not for_text:
                raise wrong
            stop = struct.unpack_from("<q", header, root + for_table)[0] if for_table else -1
            start = root + for_text
            start += struct.unpack_from("<I", header, start)[0]
            (count,) = struct.unpack_from("<I", header, start)
            text = header[start + 4 : start + 4 + count]
            if b"<!" in text:  # entities of XML grow without end
                raise wrong
            streams = {
                int(node.get("name", ""))
                for node in ElementTree.fromstring(text.decode()).iterfind("node/node")
            }
        except (struct.error, ValueError, ElementTree.ParseError) as error:
            raise wrong from error
        if len(text) != count:
            raise wrong
        at = 18 + size
        if stop < 0:
            stop = length
        elif not at <= stop <= length or not _is_packet_table(file, stop, length):
            raise damaged(
                f"{path}: its header puts the table of packets at byte {stop} of {length}, where "
                "there is none"
            )
        while at < stop:
            file.seek(at)
            packet = file.read(8)
            number, size = struct.unpack("<ii", packet) if len(packet) == 8 else (-1, -1)
            if number not in streams or size < 0 or at + 8 + size > stop:
                raise damaged(f"{path}: the packet at byte {at} does not fit into the file")
            check_unfolded(
                _max_unfolded_packet(file, at + 8, size), length, f"{path}: the packet at byte {at}"
            )
            at += 8 + size
