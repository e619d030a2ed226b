"""Recordings written in each format by its specification, without the readers.

Every writer takes events (t us, x, y from the top left, p bool) on a sensor of `size` (width,
height) and returns the bytes of a file, or writes one where a library does.
"""

import functools
import struct
import zlib
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from jaxevent.recording import Events


def events_of(seed, count, size, span=100_000, start=0) -> Events:
    """Random events, many of them at the same time and in the same row."""
    random = np.random.default_rng(seed)
    t = np.sort(start + random.integers(0, max(1, span // 7), count) * 7).astype(np.int64)
    y = random.integers(0, size[1], count)
    p = random.random(count) < 0.5
    run = random.random(count) < 0.5
    for i in range(1, count):
        if run[i]:
            t[i], y[i], p[i] = t[i - 1], y[i - 1], p[i - 1]
    t = np.sort(t)
    return Events(t, random.integers(0, size[0], count).astype(np.uint16), y.astype(np.uint16), p)


def rows(events):
    return zip(*(getattr(events, name).tolist() for name in "txyp"), strict=True)


# Prophesee


def evt2(events, size, header=None):
    header = header or f"% evt 2.0\n% geometry {size[0]}x{size[1]}\n% end\n"
    words, high = [], None
    for t, x, y, p in rows(events):
        if t >> 6 != high:
            high = t >> 6
            words.append(8 << 28 | high & 0xFFFFFFF)
        words.append(p << 28 | (t & 63) << 22 | x << 11 | y)
    return header.encode() + np.array(words, "<u4").tobytes()


def evt21(events, size, legacy=False, stated=True):
    order = "legacy" if legacy else "little"
    stated = f";endianness={order}" if stated else ""
    header = f"% evt 2.1\n% format EVT21;height={size[1]};width={size[0]}{stated}\n% end\n"
    words, high, last, last_x = [], None, None, 0
    for t, x, y, p in rows(events):
        if t >> 6 != high:
            high, last = t >> 6, None
            words.append(8 << 60 | (high & 0xFFFFFFF) << 32)
        key = (p, t & 63, x & ~31, y)
        if key == last and x > last_x:
            words[-1] |= 1 << (x & 31)
        else:
            head = p << 60 | (t & 63) << 54 | (x & ~31) << 43 | y << 32
            words.append(head | 1 << (x & 31))
        last, last_x = key, x
    words = np.array(words, "<u8")
    if legacy:
        words = words << 32 | words >> 32
    return header.encode() + words.tobytes()


def evt3(events, size, vectors=True):
    header = f"% evt 3.0\n% format EVT3;height={size[1]};width={size[0]}\n% end\n"
    words, high, low, row = [], None, None, None
    todo = list(rows(events))
    while todo:
        t, x, y, p = todo.pop(0)
        if (t >> 12) != high:
            high = t >> 12
            words += [0x8000 | high & 0xFFF]
        if (t & 0xFFF) != low:
            low = t & 0xFFF
            words.append(0x6000 | low)
        if y != row:
            row = y
            words.append(y)
        mask = 1
        while vectors and todo and todo[0][0] == t and todo[0][2:] == (y, p):
            ahead = todo[0][1] - x
            if not 0 < ahead < 12 or mask >> ahead:
                break
            mask |= 1 << ahead
            todo.pop(0)
        if mask == 1:
            words.append(0x2000 | p << 11 | x)
        elif mask < 256:
            words += [0x3000 | p << 11 | x, 0x5000 | mask]
        else:
            words += [0x3000 | p << 11 | x, 0x4000 | mask]
    return header.encode() + np.array(words, "<u2").tobytes()


def evt3_decoded(words):
    """EVT3 by its state machine, one word at a time; events before all state is known are None.

    As in OpenEB, a high time sets the low one to 0: the camera sends the low one after it.
    """
    state: dict[str, Any] = {**dict.fromkeys(("high", "y", "x")), "low": 0, "p": 0}
    wraps, out = 0, []
    for word in words:
        kind, data = int(word) >> 12, int(word) & 0xFFF
        known = None not in (state["high"], state["y"])
        if kind == 8:
            if state["high"] is not None and data < state["high"] - 2048:
                wraps += 1
            state["high"], state["low"] = data, 0
        elif kind == 6:
            state["low"] = data
        elif kind == 0:
            state["y"] = data & 0x7FF
        elif kind == 2:
            t = (wraps << 24 | state["high"] << 12 | state["low"]) if known else 0
            event = (t, data & 0x7FF, state["y"], bool(data >> 11))
            out.append(event if known else None)
        elif kind == 3:
            state["x"], state["p"] = data & 0x7FF, data >> 11
        elif kind in (4, 5):
            length = 12 if kind == 4 else 8
            for bit in range(length):
                if data >> bit & 1:
                    if known and state["x"] is not None:
                        t = wraps << 24 | state["high"] << 12 | state["low"]
                        out.append((t, state["x"] + bit, state["y"], bool(state["p"])))
                    else:
                        out.append(None)
            if state["x"] is not None:
                state["x"] += length
    return out


def dat(events, size, kind=12, version=2):
    header = f"% Data file containing CD events.\n% Version {version}\n"
    header += f"% Width {size[0]}\n% Height {size[1]}\n"
    for_x, for_y = (14, 14) if version == 2 else (9, 8)
    words = [(t & 0xFFFFFFFF, x | y << for_x | p << (for_x + for_y)) for t, x, y, p in rows(events)]
    return header.encode() + bytes([kind, 8]) + np.array(words, "<u4").tobytes()


# Event Stream


def es(events, size, crossings=None):
    """With `crossings` an ATIS, which crosses a threshold after each event where it is True."""
    out = bytearray(b"Event Stream\x02\x00\x00")
    out += bytes([1 if crossings is None else 2]) + struct.pack("<2H", *size)
    last = 0
    for i, (t, x, y, p) in enumerate(rows(events)):
        since, last = t - last, t
        place = struct.pack("<2H", x, size[1] - 1 - y)
        if crossings is None:
            out += b"\xff" * (since // 127) + bytes([(since % 127) << 1 | p]) + place
        else:
            while since >= 63:
                times = min(3, since // 63)
                out.append(0xFC | times)
                since -= 63 * times
            out += bytes([since << 2 | p << 1]) + place
            if crossings[i]:
                out += bytes([1 | (not p) << 1]) + place
    return bytes(out)


# AEDAT 2


def aedat2(events, size, images=(), image_t=(), exposure=200, imu=(), chip="DAVIS240C", **keys):
    """Images (10 bits) are read out reset first, 1 us a pixel, column by column from the right.

    `imu` holds (t, seven raw values); `keys` are preferences of jAER.
    """
    width, height = size
    header = f"#!AER-DAT2.0\r\n# AEChip: eu.seebetter.ini.chips.davis.{chip}\r\n"
    for key, value in keys.items():
        header += f'#  <entry key="{key.replace("__", ".")}" value="{value}"/>\r\n'
    header += "#End Of ASCII Header\r\n"
    records = [
        (t, 1, (height - 1 - y) << 22 | (width - 1 - x) << 12 | p << 11)
        for t, x, y, p in rows(events)
    ]
    for image, t in zip(images, image_t, strict=True):
        # Mid-exposure of the means of both readouts is t.
        step = width * height
        reset = t - (exposure + step - 1) // 2 - step // 2
        for start, level in (
            (reset, np.full_like(image, 1000)),
            (reset + step - 1 + exposure, 1000 - image),
        ):
            kind = 0 if start == reset else 1
            pixels = [(x, y) for x in reversed(range(width)) for y in range(height)]
            for i, (x, y) in enumerate(pixels):
                address = 1 << 31 | y << 22 | x << 12 | kind << 10 | int(level[height - 1 - y, x])
                records.append((start + i, 0, address))
    for t, values in imu:
        for code, value in enumerate(values):
            records.append((t, 2, 1 << 31 | code << 28 | (value & 0xFFFF) << 12 | 3 << 10))
    records.sort(key=lambda record: record[:2])
    words = [(address & 0xFFFFFFFF, t & 0xFFFFFFFF) for t, _, address in records]
    return header.encode() + np.array(words, ">u4").tobytes()


# AEDAT 4, not compressed


def dvs128(events, triggers=(), tick="1 us") -> bytes:
    records = [(t, (127 - y) << 8 | (127 - x) << 1 | (not p)) for t, x, y, p in rows(events)] + [
        (t, 0x8000) for t in triggers
    ]
    words = np.array(
        [(address, t) for t, address in sorted(records, key=lambda record: record[0])], ">u4"
    )
    head = "#!AER-DAT2.0\r\n# AEChip: ch.unizh.ini.jaer.chip.retina.DVS128\r\n"
    return (head + f"# Timestamps tick is {tick}\r\n").encode() + words.tobytes()


def flatbuffer(name: bytes, fields: dict[int, tuple]) -> bytes:
    """A FlatBuffers table with its size before it: slot -> (format, value) or (bytes, count).

    Everything is aligned from the size on, as verifiers ask.
    """
    count = max(fields) + 1
    table_at = 8 + 4 + 2 * count
    table_at += (4 - table_at) % 8
    offsets, inline, tail = [0] * count, bytearray(4), []
    for slot, (kind, value) in sorted(fields.items()):
        form = "<I" if isinstance(kind, bytes) else kind
        inline += bytes(-(len(inline) + table_at + 4) % struct.calcsize(form))
        offsets[slot] = len(inline)
        if isinstance(kind, bytes):
            tail.append((len(inline), kind, value))
            inline += bytes(4)
        else:
            inline += struct.pack(form, value)
    out = bytearray(struct.pack("<I4s", table_at, name))
    out += struct.pack(f"<2H{count}H", 4 + 2 * count, len(inline), *offsets)
    out += bytes(table_at - len(out))
    struct.pack_into("<i", inline, 0, table_at - 8)
    out += inline
    for offset, data, number in tail:
        out += bytes(-len(out) % 8)  # the vector's items, after two sizes of 4 bytes
        struct.pack_into("<I", out, table_at + offset, len(out) - table_at - offset)
        out += struct.pack("<I", number) + data + b"\0"
    return struct.pack("<I", len(out)) + bytes(out)


def aedat4(events, size, images=(), image_t=(), exposure=200, packet=100, streams=1, cameras=1):
    """Events in packets of every `streams`-th; streams 0.. of events, then those of frames.

    The images are those of `cameras` streams in turn.
    """
    xml = '<dv version="2.0"><node name="outInfo" path="/mainloop/Recorder/outInfo/">'
    kinds = ["EVTS"] * streams + ["FRME"] * cameras * (len(images) > 0)
    for number, kind in enumerate(kinds):
        xml += f'<node name="{number}" path="/mainloop/Recorder/outInfo/{number}/">'
        xml += '<attr key="compression" type="string">NONE</attr>'
        xml += f'<attr key="typeIdentifier" type="string">{kind}</attr>'
        xml += f'<node name="info" path="/mainloop/Recorder/outInfo/{number}/info/">'
        xml += f'<attr key="sizeX" type="int">{size[0]}</attr>'
        xml += f'<attr key="sizeY" type="int">{size[1]}</attr></node></node>'
    xml += "</node></dv>"
    out = bytearray(b"#!AER-DAT4.0\r\n")
    text = xml.encode()
    out += flatbuffer(b"IOHE", {0: ("<i", 0), 1: ("<q", -1), 2: (text, len(text))})
    event = np.dtype([("t", "<i8"), ("x", "<i2"), ("y", "<i2"), ("p", "u1"), ("pad", "V3")])
    for number in range(streams):
        for first in range(0, len(events), packet):
            part = events[first : first + packet]
            held = np.zeros(len(part), event)
            for name in "txyp":
                held[name] = getattr(part, name)
            body = flatbuffer(b"EVTS", {0: (held.tobytes(), len(part))})
            out += struct.pack("<2i", number, len(body)) + body
    for number, (image, t) in enumerate(zip(images, image_t, strict=True)):
        start = t - exposure // 2
        fields = {
            **{
                slot: ("<q", value)
                for slot, value in enumerate((t, start, t, start, start + exposure))
            },
            5: ("<b", 0),
            6: ("<h", size[0]),
            7: ("<h", size[1]),
            10: (image.tobytes(), image.size),
        }
        body = flatbuffer(b"FRME", fields)
        out += struct.pack("<2i", streams + number % cameras, len(body)) + body
    return bytes(out)


# HDF5


def _hdf5(fill: Callable[[h5py.File], None]) -> bytes:
    held = BytesIO()
    with h5py.File(held, "w") as file:
        fill(file)
    return held.getvalue()


def dsec(events, size, offset=0, filters: dict | None = None):
    def fill(file):
        for name, dtype in (("t", "u4"), ("x", "u2"), ("y", "u2"), ("p", "u1")):
            values = getattr(events, name).astype(dtype)
            file.create_dataset(f"events/{name}", data=values, **(filters or {}))
        file["t_offset"] = offset
        milliseconds = np.arange(int(events.t[-1]) // 1000 + 1 if len(events) else 0)
        file["ms_to_idx"] = np.searchsorted(events.t, 1000 * milliseconds).astype("u8")

    return _hdf5(fill)


def rvt(events, size):
    def fill(file):
        for name in "txyp":
            file[f"events/{name}"] = getattr(events, name).astype("i8")
        file["events/width"], file["events/height"] = size

    return _hdf5(fill)


def event_utils(events, size, images=(), image_t=()):
    def fill(file):
        file["events/ts"] = events.t / 1e6
        file["events/xs"], file["events/ys"] = events.x.astype("i2"), events.y.astype("i2")
        file["events/ps"] = events.p
        file.attrs["sensor_resolution"] = size[::-1]
        for i, (image, t) in enumerate(zip(images, image_t, strict=True)):
            file[f"images/image{i:09d}"] = image
            file[f"images/image{i:09d}"].attrs["timestamp"] = t / 1e6

    return _hdf5(fill)


def mvsec(events, size, images, image_t, imu_t=(), imu=(), sides=("left",)):
    def fill(file):
        for side in sides:
            group = file.create_group(f"davis/{side}")
            sign = np.where(events.p, 1, -1)
            group["events"] = np.stack([events.x, events.y, events.t / 1e6, sign], axis=1)
            group["image_raw"], group["image_raw_ts"] = images, np.array(image_t) / 1e6
            if len(imu_t):
                group["imu_ts"], group["imu"] = np.array(imu_t) / 1e6, imu

    return _hdf5(fill)


def m3ed(events, size, sides=("left", "right")):
    def fill(file):
        for side in sides:
            group = file.create_group(f"prophesee/{side}")
            for name in "txyp":
                group[name] = getattr(events, name).astype("i8" if name == "t" else "u2")
            milliseconds = np.arange(int(events.t[-1]) // 1000 + 1 if len(events) else 0)
            group["ms_map_idx"] = np.searchsorted(events.t, 1000 * milliseconds).astype("u8")
            group["calib/intrinsics"] = np.array([1000.0, 1001.0, 20.0, 10.0])
            group["calib/distortion_coeffs"] = np.array([-0.1, 0.1, 0.001, 0.002])
            group["calib/resolution"] = np.array(size)

    return _hdf5(fill)


def metavision(events, size):
    records = np.zeros(len(events), [("x", "<u2"), ("y", "<u2"), ("p", "<i2"), ("t", "<i8")])
    for name in "txyp":
        records[name] = getattr(events, name)

    def fill(file):
        file["CD/events"] = records
        file.attrs["geometry"] = f"{size[0]}x{size[1]}"

    return _hdf5(fill)


# Tables


def npy(events, size, names=("x", "y", "t", "p"), dtypes=("<i2", "<i2", "<i8", "?")):
    records = np.zeros(len(events), list(zip(names, dtypes, strict=True)))
    aliases = {"timestamp": "t", "ts": "t", "on": "p", "pol": "p", "polarity": "p"}
    for name in names:
        records[name] = getattr(events, aliases.get(name, name))
    held = BytesIO()
    np.save(held, records)
    return held.getvalue()


def csv(events, size, names="t,x,y,p", separator=",", seconds=False, minus=False):
    lines = [] if names is None else [names]
    order = ["t", "x", "y", "p"]
    if names is not None:
        aliases = {"timestamp": "t", "ts": "t", "on": "p", "pol": "p", "polarity": "p"}
        order = [aliases.get(name, name) for name in names.split(separator)]
    for t, x, y, p in rows(events):
        stamp = f"{t // 10**6}.{t % 10**6:06d}" if seconds else str(t)
        held = {"t": stamp, "x": x, "y": y, "p": (1 if p else -1) if minus else int(p)}
        lines.append(separator.join(str(held[name]) for name in order))
    return ("\n".join(lines) + "\n").encode()


# N-Caltech101


def n_caltech(events) -> bytes:
    out, overflows = bytearray(), 0
    for t, x, y, p in rows(events):
        while t - (overflows << 13) >= 1 << 13:  # the row of 240 comes as the counter overflows
            overflows += 1
            out += bytes([0, 240, 0, 0, 0])
        low = t - (overflows << 13)
        out += bytes([x, y, p << 7 | low >> 16, low >> 8 & 255, low & 255])
    return bytes(out)


# ROS


def ros_image(image) -> tuple:
    """The fields of sensor_msgs/Image after its header: mono8, or bgr8 of (height, width, 3)."""
    height, width = image.shape[:2]
    if image.ndim == 2:
        return height, width, "mono8", 0, width, image.ravel()
    return height, width, "bgr8", 0, 3 * width, image[..., ::-1].ravel()


def bag(path: Path, events, size, images=(), image_t=(), prefix="/dvs", message=50, typed=False):
    """Written by rosbags; events as raw bytes, or `typed` as rosbags serialises them."""
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(
        get_types_from_msg("uint16 x\nuint16 y\ntime ts\nbool polarity", "dvs_msgs/msg/Event")
    )
    definition = "std_msgs/Header header\nuint32 height\nuint32 width\ndvs_msgs/Event[] events"
    store.register(get_types_from_msg(definition, "dvs_msgs/msg/EventArray"))
    types = store.types

    def stamp(t):
        return types["builtin_interfaces/msg/Time"](int(t) // 10**6, int(t) % 10**6 * 1000)

    def header(t):
        return types["std_msgs/msg/Header"](0, stamp(t), "camera")

    def vector(kind, values):
        return types[f"geometry_msgs/msg/{kind}"](*values)

    record = np.dtype([("x", "<u2"), ("y", "<u2"), ("s", "<u4"), ("ns", "<u4"), ("p", "u1")])
    writer = Writer(path)
    writer.set_compression(Writer.CompressionFormat.LZ4)
    with writer:

        def add(topic, kind):
            return writer.add_connection(prefix + topic, kind, typestore=store)

        link = add("/events", "dvs_msgs/msg/EventArray")
        for first in range(0, len(events), message):
            part = events[first : first + message]
            # Several messages of one time of recording.
            at = 10**18 + first // (4 * message) * 10**6
            if typed:
                one = types["dvs_msgs/msg/Event"]
                held = [one(x, y, stamp(t), p) for t, x, y, p in rows(part)]
                array = types["dvs_msgs/msg/EventArray"](header(part.t[0]), size[1], size[0], held)
                raw = bytes(store.serialize_ros1(array, "dvs_msgs/msg/EventArray"))
            else:
                held = np.zeros(len(part), record)
                held["x"], held["y"], held["p"] = part.x, part.y, part.p
                held["s"], held["ns"] = part.t // 10**6, part.t % 10**6 * 1000
                start = struct.pack("<4I", 0, 0, 0, 3) + b"cam"
                raw = start + struct.pack("<3I", size[1], size[0], len(part)) + held.tobytes()
            writer.write(link, at, raw)
        if len(images):
            link = add("/image_raw", "sensor_msgs/msg/Image")
            other = add("/imu", "sensor_msgs/msg/Imu")
            pose = add("/pose", "geometry_msgs/msg/PoseStamped")
            info = add("/camera_info", "sensor_msgs/msg/CameraInfo")
        for i, (image, t) in enumerate(zip(images, image_t, strict=True)):
            at = 10**18 + i
            one = types["sensor_msgs/msg/Image"](header(t), *ros_image(image))
            writer.write(link, at, store.serialize_ros1(one, "sensor_msgs/msg/Image"))
            turn = vector("Quaternion", (0.1, 0.2, 0.3, 0.4))
            none = np.zeros(9)
            gyro, acc = (vector("Vector3", (i, i + a, i + 2 * a)) for a in (1.0, 0.5))
            one = types["sensor_msgs/msg/Imu"](header(t), turn, none, gyro, none, acc, none)
            writer.write(other, at, store.serialize_ros1(one, "sensor_msgs/msg/Imu"))
            place = types["geometry_msgs/msg/Pose"](vector("Point", (i, 2.0, 3.0)), turn)
            one = types["geometry_msgs/msg/PoseStamped"](header(t), place)
            writer.write(pose, at, store.serialize_ros1(one, "geometry_msgs/msg/PoseStamped"))
            region = types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
            k = np.array([5.0, 0, 2, 0, 6, 3, 0, 0, 1])
            d = np.array([0.1, 0.2, 0.3, 0.4, 0.5])
            one = types["sensor_msgs/msg/CameraInfo"](
                header(t),
                size[1],
                size[0],
                "plumb_bob",
                d,
                k,
                np.zeros(9),
                np.zeros(12),
                0,
                0,
                region,
            )
            writer.write(info, at, store.serialize_ros1(one, "sensor_msgs/msg/CameraInfo"))


_PACKET = """std_msgs/Header header
uint32 height
uint32 width
uint64 seq
uint64 time_base
string encoding
bool is_bigendian
uint8[] events"""


@functools.cache
def ros2_types():
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    event = "uint16 x\nuint16 y\nbuiltin_interfaces/Time ts\nbool polarity"
    for package in ("dvs_msgs", "prophesee_event_msgs"):
        store.register(get_types_from_msg(event, f"{package}/msg/Event"))
        array = f"std_msgs/Header header\nuint32 height\nuint32 width\n{package}/Event[] events"
        store.register(get_types_from_msg(array, f"{package}/msg/EventArray"))
    store.register(get_types_from_msg(_PACKET, "event_camera_msgs/msg/EventPacket"))
    return store


def packed(events, encoding, size, message, clock=0):
    """Events as (row of the first, words) of event_camera_msgs; `clock` (us) is the camera's."""
    if encoding == "evt3":
        # One stream, cut anywhere between words: most packets do not begin with a time.
        held = Events(events.t - clock, events.x, events.y, events.p)
        words = np.frombuffer(evt3(held, size).partition(b"% end\n")[2], "<u2")
        cuts = range(0, len(words), 2 * message)
        return [(min(at // 3, len(events) - 1), words[at : at + 2 * message]) for at in cuts]
    pieces = []
    for at in range(0, len(events), message):
        part = events[at : at + message]
        dt = (part.t - part.t[0]).astype("<u8") * 1000
        word = dt | part.x.astype("<u8") << 32 | part.y.astype("<u8") << 48
        pieces.append((at, word | part.p.astype("<u8") << 63))
    return pieces


def bag2(
    path: Path,
    events,
    size,
    encoding="dvs_msgs",
    storage="mcap",
    images=(),
    image_t=(),
    message=50,
    topics=("/dvs/events",),
    little_endian=True,
    compression=None,
):
    """A folder of ROS 2, by rosbags; `encoding` is a package of EventArray or of EventPacket."""
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

    store = ros2_types()
    types = store.types

    def header(t):
        stamp = types["builtin_interfaces/msg/Time"](int(t) // 10**6, int(t) % 10**6 * 1000)
        return types["std_msgs/msg/Header"](stamp, "cam")

    def array(kind, part):
        one = types[kind.replace("Array", "")]
        held = [one(x, y, header(t).stamp, p) for t, x, y, p in rows(part)]
        return types[kind](header(part.t[0]), size[1], size[0], held)

    plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
    writer = Writer(path, version=9, storage_plugin=plugin)
    if compression:
        writer.set_compression(CompressionMode[compression], CompressionFormat.ZSTD)
    with writer:
        for topic in topics:
            if encoding in ("dvs_msgs", "prophesee_event_msgs"):
                kind = f"{encoding}/msg/EventArray"
                cuts = range(0, len(events), message)
                messages = [array(kind, events[at : at + message]) for at in cuts]
            else:
                kind = "event_camera_msgs/msg/EventPacket"
                clock = int(events.t[0]) - 77
                messages = [
                    types[kind](
                        header(events.t[at]),
                        size[1],
                        size[0],
                        number,
                        (int(events.t[at]) - clock) * 1000,
                        encoding,
                        False,
                        words.view(np.uint8),
                    )
                    for number, (at, words) in enumerate(
                        packed(events, encoding, size, message, clock)
                    )
                ]
            link = writer.add_connection(topic, kind, typestore=store)
            for number, one in enumerate(messages):
                # Several messages of one time of recording.
                at = 10**18 + number // 4 * 10**6
                writer.write(link, at, store.serialize_cdr(one, kind, little_endian=little_endian))
        kind = "sensor_msgs/msg/Image"
        if len(images):
            link = writer.add_connection("/dvs/image_raw", kind, typestore=store)
            camera = writer.add_connection(
                "/dvs/camera_info", "sensor_msgs/msg/CameraInfo", typestore=store
            )
        for number, (image, t) in enumerate(zip(images, image_t, strict=True)):
            one = types[kind](header(t), *ros_image(image))
            writer.write(link, 10**18 + number, store.serialize_cdr(one, kind))
            region = types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
            d, k = np.arange(5) / 10, np.array([5.0, 0, 2, 0, 6, 3, 0, 0, 1])
            told = (header(t), size[1], size[0], "plumb_bob", d, k, np.zeros(9), np.zeros(12))
            one = types["sensor_msgs/msg/CameraInfo"](*told, 0, 0, region)
            data = store.serialize_cdr(one, "sensor_msgs/msg/CameraInfo")
            writer.write(camera, 10**18 + number, data)


def evimo_meta(t, size, images=(), depths=()) -> dict:
    """The dictionary that EVIMO2 pickles: poses at `t` (us), frames at the times of images."""
    poses = [
        {
            "ts": one / 1e6,
            "cam": {
                "ts": one / 1e6,
                "pos": {
                    "t": {"x": 0.1 * i, "y": 0.2, "z": -1.5},
                    "q": {"w": 0.8, "x": 0.6, "y": 0.0, "z": 0.0},
                },
            },
            "gt_frame": "depth_mask_18446744073709551615.png",
            "id": 18446744073709551615,
        }
        for i, one in enumerate(t)
    ]
    frames: list[dict] = [
        {"id": i, "ts": one / 1e6, "classical_frame": f"img_{i}.png"} for i, one in images
    ]
    frames += [{"id": i, "ts": one / 1e6, "gt_frame": f"depth_mask_{i}.png"} for i, one in depths]
    sample = {
        "angular_velocity": {"x": -0.1, "y": 0.2, "z": 0.3},
        "linear_acceleration": {"x": 8.0, "y": 0.5, "z": -5.0},
    }
    about = {"fx": 30.0, "fy": 31.0, "cx": 20.0, "cy": 15.0, "res_x": size[0], "res_y": size[1]}
    about |= {"k1": -0.1, "k2": 0.05, "k3": 0.0, "k4": 0.0, "p1": 0.001, "p2": 0.002}
    return {
        "frames": frames,
        "full_trajectory": poses,
        "imu": {"/prophesee/left/imu": [{"ts": 0.02, **sample}, {"ts": 0.03, **sample}]},
        "meta": {**about, "dist_model": "radtan", "ros_time_offset": 1606265321.4},
    }


def evimo(folder: Path, events, meta, images=None, depths=None):
    """A folder of EVIMO2; images and depths by number of their frame, depths used as masks too."""
    folder.mkdir()
    np.save(folder / "dataset_events_t.npy", (events.t / 1e6).astype(np.float32))
    np.save(folder / "dataset_events_xy.npy", np.stack([events.x, events.y], 1).astype("u2"))
    np.save(folder / "dataset_events_p.npy", events.p.astype("u1"))
    about = meta["meta"]
    matrix = np.diag([about["fx"], about["fy"], 1.0])
    matrix[:2, 2] = about["cx"], about["cy"]
    distortion = np.array([about[name] for name in ("k1", "k2", "k3", "k4")])
    index = np.searchsorted(events.t, np.arange(0, 100_000, 10_000)).astype("u4")
    np.savez(
        folder / "dataset_info.npz",
        allow_pickle=True,
        K=matrix,
        D=distortion,
        index=index,
        discretization=0.01,
        meta=np.array(meta),
    )
    kinds = {"classical": images, "depth": depths, "mask": depths}
    for name, held in kinds.items():
        arrays = {f"{name}_{i:010d}": image for i, image in (held or {}).items()}
        none = {} if arrays else {"empty": np.array(None)}  # as the dataset's own writer does
        np.savez_compressed(folder / f"dataset_{name}.npz", allow_pickle=True, **arrays, **none)
    return folder


# Ground truth beside recordings


def mvsec_truth(matrices, pose_t, depth, flow, image_t, side="left") -> bytes:
    """NAME_gt.hdf5; matrices are of the camera in the world, times in us."""

    def fill(file):
        group = file.create_group(f"davis/{side}")
        group["pose"], group["pose_ts"] = matrices, np.array(pose_t) / 1e6
        group["depth_image_raw"], group["depth_image_raw_ts"] = depth, np.array(image_t) / 1e6
        group["flow_dist"], group["flow_dist_ts"] = flow, np.array(image_t) / 1e6

    return _hdf5(fill)


def m3ed_truth(matrices, t, depth=None) -> bytes:
    """NAME_pose_gt.h5, or with depth NAME_depth_gt.h5."""

    def fill(file):
        file["Cn_T_C0"], file["ts"] = np.linalg.inv(matrices), np.array(t, float)
        if depth is not None:
            file.create_dataset("depth/prophesee/left", data=depth, compression="lzf")

    return _hdf5(fill)


def png16(image) -> bytes:
    """A PNG of (height, width) or (height, width, 3) uint16, red first."""

    def chunk(kind, data):
        crc = zlib.crc32(kind + data)
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", crc)

    height, width = image.shape[:2]
    rows = image.astype(">u2").reshape(height, -1).view(np.uint8)
    data = zlib.compress(np.insert(rows, 0, 0, axis=1).tobytes())  # no filter
    head = struct.pack(">IIBBBBB", width, height, 16, 2 if image.ndim == 3 else 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", data) + chunk(b"IEND", b"")


def dsec_flow(folder: Path, flow, t):
    """The folder flow of DSEC: flow (n, 2, height, width) in px, NaN where unknown."""
    (folder / "forward").mkdir(parents=True)
    lines = [f"{a}, {b}" for a, b in t]
    text = "\n".join(["# from_timestamp_us, to_timestamp_us", *lines]) + "\n"
    (folder / "forward_timestamps.txt").write_text(text)
    for i, one in enumerate(flow):
        known = np.isfinite(one[0])
        stored = np.where(known, 2**15 + 128 * one, 0)
        image = np.stack([*stored, known], axis=-1).astype(np.uint16)
        (folder / f"forward/{2 * i + 4:06d}.png").write_bytes(png16(image))


def dsec_disparity(folder: Path, disparity, t):
    """The folder disparity of DSEC: disparity (n, height, width) in px, NaN where unknown."""
    (folder / "event").mkdir(parents=True)
    (folder / "timestamps.txt").write_text("".join(f"{one}\n" for one in t))
    for i, one in enumerate(disparity):
        image = np.where(np.isfinite(one), 256 * one, 0).astype(np.uint16)
        (folder / f"event/{2 * i:06d}.png").write_bytes(png16(image))
