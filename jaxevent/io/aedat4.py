"""AEDAT 4 recordings (iniVation DV): events, frames with their exposures, IMU samples.

The file is a row of packets, each of one stream: events (t in us, x, y from the top left, p),
frames, inertial samples or triggers. Kept are one stream of events and what stands beside it: the
only stream of frames and of samples, or the one with the same number among its kind. Streams that
are not kept are named in `extra["streams_left_out"]`; a file with several cameras needs the number
of the stream of events. Times stay those of the file. A frame's time is the middle of its
exposure; where the file has no exposure, its own timestamp. Colour frames become grey (ITU-R 601
luma) and are kept in `extra["rgb"]`. Samples turn from g into m/s^2 (9.80665) and from degrees
into radians per second. Triggers have the number of DV's type as channel: 1 and 2
are the edges of a signal from outside, 3 its pulse, 4 and 5 those of the generator, 6 to 9 starts
and ends of frames.

Decoder. The package aedat (MIT) is taken: it is small and fast, and tells frames and both ends of
their exposures. dv-processing decodes the same file (davis346.aedat4) to the same 78,830 events,
59 frames with exposures and 2,363 samples; it gives a frame the start of its exposure as time and
takes g as 9.81. aedat reports most damage, but some as a Rust panic, which is no Exception, and a
header whose text is damaged ends the whole process; so header and packets are checked here first.
"""

import contextlib
import struct
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from jaxevent.errors import InputError, require
from jaxevent.io import check_unfolded, reading
from jaxevent.io import times as microseconds
from jaxevent.io.decoded import BLOCK, Columns, DecodedImages, TriggerList, decoded
from jaxevent.io.options import ReadOptions
from jaxevent.recording import Frames, Imu, Recording, Triggers

MAGIC = b"#!AER-DAT4.0"
_STANDARD_GRAVITY = 9.80665  # m/s^2
_COMPRESSED = (b"\x04\x22\x4d\x18", b"\x28\xb5\x2f\xfd")  # the first bytes of LZ4 and Zstandard


def read(path: Path, options: ReadOptions) -> Recording:
    """Read a file. Raises `InputError` for bad input.

    `options.stream` is the number of a stream of events, needed where there are several, and
    `options.frames` that of a stream of frames.
    """
    source = str(path)
    with reading(source):
        _walk(path)
    with _decoding(path):
        aedat: Any = require("aedat", "aedat")
        streams: dict[int, dict] = dict(sorted(aedat.Decoder(path).id_to_stream().items()))
    of_kind = {
        kind: [number for number, stream in streams.items() if stream["type"] == kind]
        for kind in ("events", "frame", "imus", "triggers")
    }
    number, chosen = _choose(path, of_kind["events"], options, streams)
    unchosen: dict[str, str] = {}
    for kind, field in (("frame", "frames"), ("imus", "imu"), ("triggers", "triggers")):
        several = of_kind[kind]
        listed = ", ".join(map(str, several))
        if kind == "frame" and options.without_frames:
            continue
        if kind == "frame" and options.frames is not None:
            if options.frames not in map(str, several):
                raise InputError(
                    f"{path}: has no stream of frames {options.frames!r}; its streams of frames "
                    f"are {listed or 'none'}"
                )
            chosen[kind] = int(options.frames)
        elif len(several) == 1:
            chosen[kind] = several[0]
        elif number is not None and len(several) == len(of_kind["events"]):
            chosen[kind] = several[of_kind["events"].index(number)]
        elif several:
            remedy = f"; choose one with frames={several[0]}" if kind == "frame" else ""
            unchosen[field] = f"the streams {listed} hold some, of which none is chosen{remedy}"
    if number is None and "frame" not in chosen:
        raise InputError(
            f"{path}: holds no events, and frames in the streams "
            f"{', '.join(map(str, of_kind['frame']))}; choose one with frames="
        )
    frames, rgb, imu, triggers = _others(path, chosen, options.in_memory)
    extra: dict[str, NDArray] = {} if rgb is None else {"rgb": rgb}
    left_out = [
        f"{number} {stream['type']}"
        for number, stream in streams.items()
        if number not in chosen.values()
    ]
    if left_out:
        extra["streams_left_out"] = np.array(left_out)
    told = streams[number if number is not None else chosen["frame"]]
    size = options.size or (int(told["width"]), int(told["height"]))

    def decode(state: int | None) -> Iterator[tuple[int, Columns]]:
        held: list[NDArray] = []
        first = 0
        with _decoding(path):
            for packet, content in enumerate(aedat.Decoder(path)):
                if packet < (state or 0) or content["stream_id"] != number:
                    continue
                first = first if held else packet
                held.append(content["events"])
                if sum(map(len, held)) >= BLOCK:
                    yield first, _columns(held)
                    held = []
        if held:
            yield first, _columns(held)

    events = decoded(decode, size, source, options)
    return Recording(
        path.stem,
        *size,
        events,
        frames,
        imu=imu,
        extra=extra,
        triggers=triggers,
        left_out=unchosen,
    )


def _choose(
    path: Path, several: list[int], options: ReadOptions, streams: dict[int, dict]
) -> tuple[int | None, dict[str, int]]:
    """The number of the stream of events, None where there is none, and it by its kind."""
    stream = options.stream
    if stream is not None and stream not in map(str, several):
        raise InputError(
            f"{path}: has no stream of events {stream!r}; its streams of events are "
            f"{', '.join(map(str, several)) or 'none'}"
        )
    if stream is None and len(several) > 1 and not options.without_events:
        named = ", ".join(f"{n} ({streams[n]['width']}x{streams[n]['height']})" for n in several)
        raise InputError(
            f"{path}: holds {len(several)} streams of events, {named}; choose one with stream=, or "
            "with jaxevent convert --stream"
        )
    if not several or options.without_events:
        if not any(other["type"] == "frame" for other in streams.values()):
            raise InputError(f"{path}: holds no stream of events and none of frames")
        return None, {}
    number = several[0] if stream is None else int(stream)
    return number, {"events": number}


def _columns(packets: list[NDArray]) -> Columns:
    events = np.concatenate(packets)
    t = events["t"]
    # The decoder passes signed 64-bit times on as unsigned.
    return (
        t.view(np.int64) if t.dtype == np.uint64 and t.flags.c_contiguous else t.astype(np.int64),
        events["x"].copy(),
        events["y"].copy(),
        events["p"].copy(),
    )


def _others(
    path: Path, chosen: dict[str, int], in_memory: bool
) -> tuple[Frames | None, NDArray | None, Imu | None, Triggers | None]:
    """Frames, their colours, inertial samples and triggers, in one pass."""
    if not chosen.keys() & {"frame", "imus", "triggers"}:
        return None, None, None, None
    aedat: Any = require("aedat", "aedat")
    times, exposures, images, colours, samples = [], [], [], [], []
    triggers = TriggerList()
    shape, count = None, 0
    with _decoding(path), warnings.catch_warnings():
        # Frames of an unknown kind would be passed over with a warning.
        warnings.simplefilter("error")
        for packet in aedat.Decoder(path):
            if packet["stream_id"] == chosen.get("frame", -1):
                frame = packet["frame"]
                start, end = frame["exposure_begin_t"], frame["exposure_end_t"]
                known = 0 < start < end
                times.append(start + (end - start) // 2 if known else frame["t"])
                exposures.append(end - start if known else 0)
                image = _grey(frame["pixels"])
                shape = shape or (image.shape, image.dtype)
                if shape != (image.shape, image.dtype):
                    raise InputError(
                        f"{path}: frame {len(times) - 1} is {image.dtype} of shape {image.shape} "
                        f"but the first one is {shape[1]} of shape {shape[0]}; all frames must "
                        "have the sensor's size and one depth"
                    )
                if in_memory:
                    images.append(image)
                if frame["pixels"].ndim == 3:
                    colours.append(frame["pixels"][..., :3])
            elif packet["stream_id"] == chosen.get("imus", -1):
                samples.append(packet["imus"])
            elif packet["stream_id"] == chosen.get("triggers", -1):
                signals = packet["triggers"]
                source = signals["source"]
                edge = np.select([np.isin(source, (1, 4)), np.isin(source, (2, 5))], [1, 0], -1)
                triggers.add(count, signals["t"].astype(np.int64), edge, source)
                count += 1
    frames = imu = None
    if shape is not None:
        t, exposure = (_signed(values, path) for values in (times, exposures))
        if in_memory:
            stored: Any = np.stack(images)
        else:
            stored = DecodedImages(
                lambda row: _images(path, chosen["frame"], row),
                (len(times), *shape[0]),
                shape[1],
                str(path),
            )
        frames = Frames(t, stored, exposure)
    if samples:
        rows = np.concatenate(samples)
        gyro, acc = (
            np.stack([rows[f"{name}_{axis}"] for axis in "xyz"], axis=1).astype(np.float64)
            for name in ("gyroscope", "accelerometer")
        )
        if not (np.isfinite(gyro).all() and np.isfinite(acc).all()):
            raise InputError(f"{path}: an IMU sample is not finite; the file is damaged")
        t = rows["t"].astype(np.int64)
        imu = Imu(t, np.deg2rad(gyro), acc * _STANDARD_GRAVITY)
    rgb = np.stack(colours) if colours and len(colours) == len(times) else None
    return frames, rgb, imu, triggers.all()


def _signed(values: list[int], path: Path) -> NDArray[np.int64]:
    """Times and spans of frames, which the decoder may give as unsigned numbers."""
    return microseconds(np.array(values), f"{path}: a frame", "frame")


def _images(path: Path, number: int, row: int) -> Iterator[NDArray]:
    aedat: Any = require("aedat", "aedat")
    with _decoding(path):
        for packet in aedat.Decoder(path):
            if packet["stream_id"] == number:
                if row <= 0:
                    yield _grey(packet["frame"]["pixels"])
                row -= 1


def _grey(pixels: NDArray) -> NDArray:
    if pixels.ndim == 2:
        return pixels
    return np.rint(pixels[..., :3] @ np.array([0.299, 0.587, 0.114])).astype(pixels.dtype)


@contextlib.contextmanager
def _decoding(path: Path) -> Iterator[None]:
    """Like `reading`, and for a panic of the decoder, which is no Exception, too."""
    try:
        with reading(str(path)):
            yield
    except BaseException as error:
        if type(error).__name__ != "PanicException":
            raise
        raise InputError(
            f"{path}: a packet is damaged ({' '.join(str(error).split())[:120]}); fetch the file "
            "again"
        ) from None


def _unfolded(file: Any, at: int, size: int) -> int:
    """The most bytes to which a packet can unfold, by the headers of its blocks.

    LZ4 (frame format 1.6): blocks of at most 2^(8 + 2 code) bytes. Zstandard (RFC 8878): of at most
    128 KiB, those of type 1 of the size stated, from one byte.
    """
    file.seek(at)
    head = file.read(18)
    unfolded, stop = 0, at + size
    if head[:4] == _COMPRESSED[0]:
        flags = head[4]
        at += 7 + 8 * (flags >> 3 & 1) + 4 * (flags & 1)
        block, checked = 1 << 8 + 2 * (head[5] >> 4 & 7), 4 * (flags >> 4 & 1)
        while at < stop and file.seek(at) and len(word := file.read(4)) == 4:
            (stored,) = struct.unpack("<I", word)
            if stored == 0:
                break
            unfolded += block
            at += 4 + (stored & 0x7FFFFFFF) + checked
    elif head[:4] == _COMPRESSED[1]:
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


def _is_table(file: Any, at: int, length: int) -> bool:
    """Whether the table of packets stands at a byte, plain or compressed, or the file ends there.

    Decoders stop there: a packet in its place would hide those after it.
    """
    file.seek(at)
    head = file.read(12)
    return at == length or head[:4] in _COMPRESSED or head[8:12] == b"FTAB"


def _walk(path: Path) -> None:
    """Check the header, and that the packets fill the file, to the table of packets or the end.

    The header is a FlatBuffers table: its second field is the place of that table (-1: none), its
    third an XML text that names the streams.
    """
    length = path.stat().st_size
    damaged = InputError(f"{path}: its header is damaged; fetch the file again")
    with path.open("rb") as file:
        head = file.read(18)
        (size,) = struct.unpack_from("<I", head, 14)
        if not 8 <= size <= length - 18:
            raise InputError(f"{path}: its header is cut off; fetch the file again")
        header = file.read(size)
        try:
            (root,) = struct.unpack_from("<I", header)
            (back,) = struct.unpack_from("<i", header, root)
            if root < back:
                raise damaged
            fields, _, _, for_table, for_text = struct.unpack_from("<5H", header, root - back)
            if header[4:8] != b"IOHE" or fields < 10 or not for_text:
                raise damaged
            stop = struct.unpack_from("<q", header, root + for_table)[0] if for_table else -1
            start = root + for_text
            start += struct.unpack_from("<I", header, start)[0]
            (count,) = struct.unpack_from("<I", header, start)
            text = header[start + 4 : start + 4 + count]
            if b"<!" in text:  # entities of XML grow without end
                raise damaged
            streams = {
                int(node.get("name", ""))
                for node in ElementTree.fromstring(text.decode()).iterfind("node/node")
            }
        except (struct.error, ValueError, ElementTree.ParseError) as error:
            raise damaged from error
        if len(text) != count:
            raise damaged
        at = 18 + size
        if stop < 0:
            stop = length
        elif not at <= stop <= length or not _is_table(file, stop, length):
            raise InputError(
                f"{path}: its header puts the table of packets at byte {stop} of {length}, where "
                "there is none; the file was cut off or its header is damaged, so fetch it again"
            )
        while at < stop:
            file.seek(at)
            packet = file.read(8)
            number, size = struct.unpack("<ii", packet) if len(packet) == 8 else (-1, -1)
            if number not in streams or size < 0 or at + 8 + size > stop:
                raise InputError(
                    f"{path}: the packet at byte {at} does not fit into the file; the recording "
                    "was cut off or is damaged, so fetch it again"
                )
            check_unfolded(
                _unfolded(file, at + 8, size), length, f"{path}: the packet at byte {at}"
            )
            at += 8 + size
