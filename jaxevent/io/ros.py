"""Recordings of ROS 1 and ROS 2 bags, as the drivers of DAVIS and Prophesee cameras make them.

Of one camera are read its events, and by their types frames (sensor_msgs/Image and
CompressedImage), inertial samples (sensor_msgs/Imu), ground-truth poses (geometry_msgs/PoseStamped)
and the calibration (sensor_msgs/CameraInfo). Where several topics have a type, the one under the
events' own name is taken (/dvs/imu for /dvs/events); topics of these types that are not read are
named in `extra["topics_left_out"]` and, where a field stays None, in `left_out`. A bag with several
cameras needs the topic of the events. A bag without events is read for its frames.

Of several topics of images under the events' name those are taken that can be read and have the
sensor's size, then `image_raw`, then images as they are rather than their compressed copies. Depth
images (32FC1, compressedDepth, and 16UC1 of a topic named so) are never taken, and those of another
size are another camera's, which `register` brings onto the events' pixels. `frames` names another
topic, or "none".

Images are mono8, mono10, 12, 14 and 16, in colours of 8 or 16 bits, YUV 4:2:2 (of which the luma is
read), in a Bayer pattern of 8 or 16 bits (interpolated), or compressed as Pillow reads them. Those
of 10 to 14 bits are shifted to 16.

A topic holds events where its messages have the fields of one of these, in any order and beside any
others. Where a message states no size, frames or the caller do.

    array   header, height, width, events of x and y, a time (seconds, nanoseconds) and a polarity:
            EventArray of dvs_msgs, prophesee_event_msgs, dv_ros_msgs
    packet  header, height, width, time base, encoding, encoded bytes: EventPacket of
            event_camera_msgs, EventArray of event_array_msgs

The encodings of event_camera_msgs/EventPacket that are read:

    mono  64-bit words: 32 bits of nanoseconds since the packet's time base, 16 of x, 15 of y, 1 of
          polarity
    evt3  the camera's EVT3 words, see `prophesee`; the time base is not used

Times are those of the messages' headers and of the events, not those of recording, as ROS time in
us (nanoseconds are cut off). Times in packets are the camera's. One constant is added, so that the
time base of the first packet (mono) or the first event (evt3) is at the time of the first packet's
header. Frames of another topic are then on the same clock, but for the drift of the camera's. The
exposure of images is unknown: 0. Colour images become grey (ITU-R 601 luma), and `extra["rgb"]`
keeps their colours.

Decoder. The package rosbags reads the containers, see `bags`. importRosbag (GPL) fails with NumPy
2. Both agree on bags of ROS 1 written by rosbags; of ROS 2, bags are read that rosbags wrote.
"""

import contextlib
import dataclasses
import functools
import io
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.camera import PinholeCamera
from jaxevent.errors import InputError, require
from jaxevent.io import decoded
from jaxevent.io.bags import Bag, MessageLayout, Place
from jaxevent.io.checks import (
    ReadOptions,
    check_unfolded,
    damaged,
    image_size,
    make_supported_camera,
    reading,
    sensor_size,
)
from jaxevent.io.decoded import Columns, Decoder, FirstPass, gather_pieces, read_events
from jaxevent.io.images import BAYER_PATTERNS, demosaic, drop_alpha, gather_frames, read_image
from jaxevent.io.prophesee import decode_evt3
from jaxevent.recording import Events, Frames, Imu, Poses, Recording, Triggers

_IMAGE, _COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
_IMU, _POSE = "sensor_msgs/msg/Imu", "geometry_msgs/msg/PoseStamped"
_CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
_FIELD_OF_KIND = {_IMU: "imu", _POSE: "poses", _CAMERA_INFO: "camera"}
_LUMA_BYTE = {"yuv422": 1, "uyvy": 1, "yuv422_yuy2": 0, "yuyv": 0}  # byte of a pixel's two
_BITS_OF_ENCODING = {"mono10": 10, "mono12": 12, "mono14": 14}  # bits, of 16
_DTYPE_AND_CHANNELS = {
    "mono8": ("u1", 1),
    "8UC1": ("u1", 1),
    "mono16": ("u2", 1),
    "16UC1": ("u2", 1),
    "8UC3": ("u1", 3),  # blue, green, red, as OpenCV has them
    "8UC4": ("u1", 4),
    **{name: ("u2", 1) for name in _BITS_OF_ENCODING},
    **{name: ("u1", 2) for name in _LUMA_BYTE},
    **{
        f"{order}{bits}": (f"u{bits // 8}", len(order))
        for order in ("rgb", "bgr", "rgba", "bgra")
        for bits in (8, 16)
    },
    **{
        f"bayer_{pattern.lower()}{bits}": (f"u{bits // 8}", 1)
        for pattern in BAYER_PATTERNS
        for bits in (8, 16)
    },
}
_TIME_FIELDS = ("ts", "t", "time", "stamp", "timestamp")
_POLARITY_FIELDS = ("polarity", "p", "pol", "on")


class _ImageTopic(NamedTuple):
    """A topic of images, described by its first one."""

    is_depth: bool
    is_read: bool  # its encoding
    size: tuple[int, int] | None  # (width, height); None where a compressed image is damaged


def read(path: Path, options: ReadOptions) -> Recording:
    """Read a bag.

    Args:
        path: The file or folder.
        options: Options of `jaxevent.io.load`: `stream` is the topic of the events, needed where
            there are several, and `frames` that of the frames.

    Returns:
        The recording; unless `options.in_memory`, events and images stay in the bag.

    Raises:
        InputError: The bag is damaged, or what it holds is not valid or ambiguous.
    """
    source = str(path)
    with reading(source):
        bag = Bag(path)
        several, images = _find_event_topics(bag), _find_image_topics(bag)
    topic = _choose_events(bag, several, any(not one.is_depth for one in images.values()), options)
    with reading(source):
        held = None if topic is None else open_event_topic(bag, topic)
    stated = held.size if held else None
    image, left_out = _choose_frames(bag, topic, images, options, options.size or stated)
    chosen: dict[str, str | None] = {}
    for kind, field in _FIELD_OF_KIND.items():
        found = bag.beside(topic, topics := bag.topics(kind))
        chosen[kind] = found[0] if len(found) == 1 else None
        if topics and chosen[kind] is None:
            number = "several are" if found else "none is"
            left_out[field] = (
                f"the topics {', '.join(topics)} hold some, of which {number} under the name of "
                f"{topic or 'the frames'}"
            )
    with reading(source):
        frames, extra = _read_frames(bag, image, options.in_memory)
        imu = _read_imu(bag, chosen[_IMU])
        poses = _read_poses(bag, chosen[_POSE])
        camera, left_out_camera = _read_camera(bag, chosen[_CAMERA_INFO])
    otherwise = f"{path}: the events of {topic} do not state the sensor's size"
    size = sensor_size(
        otherwise, options.size, stated, image_size(None if frames is None else frames.images)
    )
    events = read_events(held.decode, size, source, options) if held else Events.empty()
    unread = set(images) | {one for kind in _FIELD_OF_KIND for one in bag.topics(kind)}
    unread -= {image, *chosen.values()}
    names = [*sorted(unread), *(other for other in several if other != topic)]
    extra |= {"topics_left_out": np.array(names)} if names else {}
    extra |= held.first_pass.counts() if held else {}
    triggers = held.triggers() if held else None
    left_out |= left_out_camera
    return Recording(
        path.stem, *size, events, frames, camera, poses, imu, extra, triggers, left_out=left_out
    )


def _choose_events(
    bag: Bag, topics: list[str], has_images: bool, options: ReadOptions
) -> str | None:
    """Choose the topic of the events; None in a bag of images alone."""
    if options.without_events and has_images:
        return None
    topic = options.choose_stream(bag.path, "topic of events", topics)
    if topic is None:
        held = ", ".join(f"{name} ({kind})" for name, kind in sorted(bag.kinds().items()))
        if not has_images or options.without_frames:
            raise InputError(
                f"{bag.path}: the bag holds no topic of events; record them as dvs_msgs/EventArray "
                f"or event_camera_msgs/EventPacket; its topics are {held[:300] or 'empty'}"
            )
        options.notes.append(f"no topic of {held[:300]} holds events")
    return topic


def _find_image_topics(bag: Bag) -> dict[str, _ImageTopic]:
    """Describe all topics of images, sorted."""
    from PIL import Image

    found = {}
    for topic in bag.topics(_IMAGE, _COMPRESSED):
        _, message = next(bag.decoded(topic))
        if bag.kind(topic) == _COMPRESSED:
            size = None
            # A fault of it is reported when its images are read.
            with contextlib.suppress(Exception), Image.open(io.BytesIO(message.data)) as opened:
                size = opened.size
            found[topic] = _ImageTopic("compressedDepth" in message.format, True, size)
            continue
        encoding = message.encoding
        is_depth = encoding in ("32FC1", "64FC1")
        is_depth |= encoding == "16UC1" and "depth" in topic.lower()
        size = (message.width, message.height)
        found[topic] = _ImageTopic(is_depth, encoding in _DTYPE_AND_CHANNELS, size)
    return found


def _choose_frames(
    bag: Bag,
    events: str | None,
    images: dict[str, _ImageTopic],
    options: ReadOptions,
    size: tuple[int, int] | None,
) -> tuple[str | None, dict[str, str]]:
    """Choose the topic of the frames.

    Args:
        bag: The bag.
        events: Topic of the events.
        images: Topics of images by name.
        options: Options of `jaxevent.io.load`.
        size: (width, height) of the sensor in px; None where it is not known.

    Returns:
        The topic, None where none is chosen, and the entry of `Recording.left_out`.
    """
    several = [topic for topic, one in images.items() if not one.is_depth]
    listed = ", ".join(several)
    if options.without_frames:
        return None, {}
    if options.frames is not None:
        if options.frames not in several:
            held = "depths in" if options.frames in images else "no images in a topic"
            raise InputError(
                f"{bag.path}: holds {held} {options.frames!r}, and images in "
                f"{listed or 'no topic'}; correct frames= or --frames, or give none to read no "
                "frames"
            )
        return options.frames, {}
    found = bag.beside(events, several)
    if (
        len(several) > 1
        and not found
        and len({_uncompressed_topic(topic) for topic in several}) == 1
    ):
        found = several

    def fits(topic: str) -> bool:
        return None in (size, images[topic].size) or images[topic].size == size

    for prefer in (
        lambda topic: images[topic].is_read,
        fits,
        lambda topic: _uncompressed_topic(topic).rpartition("/")[2] == "image_raw",
        lambda topic: bag.kind(topic) == _IMAGE,
    ):
        found = [topic for topic in found if prefer(topic)] or found
    if len(found) == 1 and not fits(found[0]):
        (width, height), (across, down) = images[found[0]].size or (0, 0), size or (0, 0)
        return None, {
            "frames": f"the images of {found[0]} have {width}x{height} pixels, not the sensor's "
            f"{across}x{down}; jaxevent register --images {found[0]} brings them onto it"
        }
    if len(found) == 1:
        if len(several) > 1:
            others = ", ".join(topic for topic in several if topic != found[0])
            options.notes.append(
                f"the frames are the images of {found[0]}; frames= or --frames chooses those of "
                f"{others}"
            )
        return found[0], {}
    if several:
        return None, {
            "frames": f"these topics hold images: {listed}; choose one with frames= or --frames"
        }
    if images:
        return None, {"frames": f"the images of {', '.join(images)} are depths, not frames"}
    return None, {}


def _uncompressed_topic(topic: str) -> str:
    """Return the topic of images to which a topic of compressed copies belongs."""
    return topic.removesuffix("/compressed")


def _stamp_us(message: Any) -> int:
    """Return the time of a message's header in us."""
    stamp = message.header.stamp
    return stamp.sec * 1_000_000 + stamp.nanosec // 1000


def _read_frames(
    bag: Bag, topic: str | None, in_memory: bool
) -> tuple[Frames | None, dict[str, Any]]:
    """Read the frames of a topic, and the entry of `Recording.extra` for their colours."""
    if topic is None:
        return None, {}
    name, times, places = topic, [], []

    def first_pass() -> Iterator[NDArray]:
        for place, message in bag.decoded(topic):
            times.append(_stamp_us(message))
            places.append(place)
            yield _read_image(bag, name, message)

    def decode(row: int) -> Iterator[NDArray]:
        return (_read_image(bag, name, one) for _, one in bag.decoded(name, places[row]))

    images, extra = gather_frames(
        first_pass(),
        decode,
        lambda n: f"{bag.path}: image {n} of {topic}",
        str(bag.path),
        in_memory,
    )
    t = np.array(times, np.int64)
    return None if images is None else Frames(t, images, np.zeros_like(t)), extra


def _read_image(bag: Bag, topic: str, message: Any) -> NDArray:
    """Read an image as it is stored, in colour with red first.

    Args:
        bag: The bag.
        topic: Topic of the image.
        message: The message.

    Returns:
        (height, width) or (height, width, 3).

    Raises:
        InputError: The encoding is not read.
    """
    if bag.kind(topic) == _COMPRESSED:
        image = _decompress(bag, topic, message.data)
        encoding = message.format.partition(";")[0].strip()
        return _interpolate_colours(image, encoding) if image.ndim == 2 else image
    encoding = message.encoding
    if encoding not in _DTYPE_AND_CHANNELS:
        raise InputError(
            f"{bag.path}: the images of {topic} are encoded as {encoding[:20]!r}, which is not "
            "read; record them as mono8, rgb8 or bayer_rggb8, or leave them out with "
            "frames='none' or --frames none"
        )
    depth, channels = _DTYPE_AND_CHANNELS[encoding]
    dtype = np.dtype(depth).newbyteorder(">" if message.is_bigendian else "<")
    rows = np.frombuffer(message.data.tobytes(), np.uint8).reshape(message.height, message.step)
    row = message.width * channels * dtype.itemsize
    image = np.ascontiguousarray(rows[:, :row]).view(dtype)
    image = image.reshape(message.height, message.width, channels).astype(dtype.newbyteorder("="))
    if encoding in _LUMA_BYTE:
        return np.ascontiguousarray(image[..., _LUMA_BYTE[encoding]])
    if channels == 1:
        return _interpolate_colours(
            image[..., 0] << (16 - _BITS_OF_ENCODING.get(encoding, 16)), encoding
        )
    return np.ascontiguousarray(image[..., :3] if encoding[0] == "r" else image[..., 2::-1])


def _decompress(bag: Bag, topic: str, data: NDArray[np.uint8]) -> NDArray:
    """Read a compressed image by Pillow.

    Args:
        bag: The bag.
        topic: Topic of the image, for messages.
        data: (bytes,) the compressed image.

    Returns:
        Grey (height, width), else (height, width, 3).
    """
    from PIL import Image

    source = f"{bag.path}: an image of {topic}"
    with reading(source):
        with Image.open(io.BytesIO(data.tobytes())) as opened:
            unfolded = opened.width * opened.height * len(opened.getbands())
            check_unfolded(unfolded, len(data), source)
        return drop_alpha(read_image(io.BytesIO(data.tobytes()), source))


def _interpolate_colours(image: NDArray, encoding: str) -> NDArray:
    """Interpolate the colours of the mosaic of a Bayer pattern.

    Args:
        image: (height, width[, 3]).
        encoding: Encoding, as ROS names it.

    Returns:
        (height, width, 3); images of other encodings as they are.
    """
    pattern = encoding.removeprefix("bayer_")[:4].upper()
    if not encoding.startswith("bayer_") or pattern not in BAYER_PATTERNS:
        return image
    return np.rint(demosaic(image[None], pattern)[0]).astype(image.dtype)


def _read_imu(bag: Bag, topic: str | None) -> Imu | None:
    rows = [
        (_stamp_us(m), _xyz(m.angular_velocity), _xyz(m.linear_acceleration))
        for _, m in bag.decoded(topic)
    ]
    if not rows:
        return None
    t, gyro, acc = zip(*rows, strict=True)
    return Imu(np.array(t, np.int64), np.array(gyro), np.array(acc))


def _read_poses(bag: Bag, topic: str | None) -> Poses | None:
    rows = [
        (
            _stamp_us(m),
            _xyz(m.pose.position),
            (*_xyz(m.pose.orientation), float(m.pose.orientation.w)),
        )
        for _, m in bag.decoded(topic)
    ]
    if not rows:
        return None
    t, position, quaternion = zip(*rows, strict=True)
    return Poses(np.array(t, np.int64), np.array(position), np.array(quaternion))


def _xyz(vector: Any) -> tuple[float, float, float]:
    return float(vector.x), float(vector.y), float(vector.z)


def _read_camera(bag: Bag, topic: str | None) -> tuple[PinholeCamera | None, dict[str, str]]:
    """Read the first calibration, and the entry of `left_out` where it cannot be used."""
    for _, message in bag.decoded(topic):
        matrix, k = (message.K, message.D) if bag.is_ros1 else (message.k, message.d)
        fx, _, cx, _, fy, cy = (float(value) for value in matrix[:6])
        source = f"{bag.path}: {topic}"
        return make_supported_camera(
            np.array([fx, fy, cx, cy]), message.distortion_model, k, source
        )
    return None, {}


class _EventFields(NamedTuple):
    """Names of the fields of an array of events: the array itself, and an event's numbers."""

    array: str
    sec: str
    nanosec: str
    x: str
    y: str
    p: str


def _find_event_fields(layout: MessageLayout) -> _EventFields | None:
    """Find the fields of a message that is an array of events; None of others."""
    for field, type_ in layout.fields.items():
        members = [name for name, _ in layout.members(type_) or ()]
        lower = {name.lower(): name for name in members}
        t = next((name for name in _TIME_FIELDS if f"{name}.nanosec" in lower), None)
        p = next((name for name in _POLARITY_FIELDS if name in lower), None)
        if t is not None and p is not None and {"x", "y", f"{t}.sec"} <= set(lower):
            wanted = (f"{t}.sec", f"{t}.nanosec", "x", "y", p)
            return _EventFields(field, *(lower[name] for name in wanted))
    return None


def _is_packet(layout: MessageLayout) -> bool:
    """Return whether a message is a packet of encoded events."""
    fields = layout.fields
    wanted = {"header", "time_base", "encoding", "events"}
    return wanted <= set(fields) and layout.members(fields["events"]) == [("", "u1")]


def _layout(bag: Bag, kind: str) -> MessageLayout:
    return MessageLayout(bag.fields, kind, bag.is_ros1)


def _find_event_topics(bag: Bag) -> list[str]:
    """Find the topics whose messages are events by their fields, sorted."""
    layouts = {kind: _layout(bag, kind) for kind in set(bag.kinds().values())}
    held = {
        kind
        for kind, one in layouts.items()
        if _is_packet(one) or _find_event_fields(one) is not None
    }
    return sorted(topic for topic, kind in bag.kinds().items() if kind in held)


@dataclasses.dataclass(frozen=True)
class EventTopic:
    """The events of a topic.

    Attributes:
        decode: Their decoder.
        size: (width, height) of the sensor in px, if messages state it.
        first_pass: Counts of events and triggers before any time.
        triggers: Function that returns the triggers of the decoder's first pass.
    """

    decode: Decoder
    size: tuple[int, int] | None
    first_pass: FirstPass
    triggers: Callable[[], Triggers | None]


def open_event_topic(bag: Bag, topic: str) -> EventTopic:
    """Read the first message of a topic of events and make their decoder.

    Args:
        bag: The bag.
        topic: Topic of the events.

    Returns:
        The topic's decoder and size.

    Raises:
        InputError: A message is damaged, or its encoding is not known.
    """
    found, layout = FirstPass(), _layout(bag, bag.kind(topic))
    names = _find_event_fields(layout)
    messages = (message for _, message in _messages(bag, topic, layout))
    if names is not None:
        decode = functools.partial(_decode_arrays, bag, topic, layout, names)
        return EventTopic(decode, _size(next(messages)), found, lambda: None)
    packet = next(messages)
    size, encoding = _size(packet), packet["encoding"]
    stamp = packet["header"]["stamp"]
    stamp = stamp["sec"] * 10**9 + stamp["nanosec"]
    packets = functools.partial(_packets, bag, topic, layout)
    if encoding == "mono":
        shift = stamp - packet["time_base"]
        return EventTopic(
            functools.partial(_decode_mono, packets, shift), size, found, lambda: None
        )
    if encoding != "evt3":
        raise InputError(
            f"{bag.path}: the packets of {topic} are encoded as {encoding[:20]!r}; only "
            "mono and evt3 can be read, so record the events as one of these"
        )
    require("evt3", "prophesee")
    words = _Evt3Packets(f"{bag.path}: {topic}", packets, stamp // 1000, found)
    return EventTopic(words.decode, size, found, words.triggers)


def _messages(
    bag: Bag, topic: str, layout: MessageLayout, place: Place | None = None
) -> Iterator[tuple[Place, dict[str, Any]]]:
    """Yield the messages of a topic, each with its place, from a place on."""
    for here, data in bag.messages(topic, place):
        try:
            yield here, layout.read(data)
        except ValueError as error:
            raise damaged(f"{bag.path}: a message of {topic} has {error}") from None


def _size(message: Mapping[str, Any]) -> tuple[int, int] | None:
    width, height = (message.get(name) for name in ("width", "height"))
    return (width, height) if width and height else None


def _decode_arrays(
    bag: Bag, topic: str, layout: MessageLayout, names: _EventFields, state: Place | None
) -> Iterator[tuple[Place, Columns]]:
    messages = (
        (place, sum(map(len, message[names.array])), message[names.array])
        for place, message in _messages(bag, topic, layout, state)
    )
    for first, arrays in gather_pieces(messages):
        yield first, _columns(bag, topic, names, [piece for array in arrays for piece in array])


def _columns(bag: Bag, topic: str, names: _EventFields, pieces: list[NDArray]) -> Columns:
    """Concatenate the events of messages.

    Args:
        bag: The bag.
        topic: Topic of the events.
        names: Names of the fields.
        pieces: Structured arrays of the messages' events.

    Returns:
        t in us, x, y and p, (n,) each.

    Raises:
        InputError: A time is not possible.
    """
    s, ns, x, y, p = (
        np.concatenate([piece[name] for piece in pieces])
        for name in (names.sec, names.nanosec, names.x, names.y, names.p)
    )
    if len(ns) and ns.max() >= 10**9:
        raise damaged(f"{bag.path}: an event of {topic} has more than 10^9 nanoseconds")
    # Seconds are unsigned in ROS 1, and in ROS 2 not below 0; rosbags declares both as int32.
    s = s.view(np.uint32) if s.dtype == np.int32 else s
    return s * np.int64(1_000_000) + ns // 1000, x, y, p


def _packets(
    bag: Bag, topic: str, layout: MessageLayout, encoding: str, width: int, place: Place | None
) -> Iterator[tuple[Place, Any, NDArray[np.uint8]]]:
    """Yield the packets of a topic.

    Args:
        bag: The bag.
        topic: The topic.
        layout: Layout of its messages.
        encoding: Encoding that all packets must have.
        width: Bytes of a word.
        place: Place of the first packet; None: the start.

    Yields:
        The place of a packet, the packet, and its bytes (n,), whole words.

    Raises:
        InputError: A packet has another encoding, or holds parts of words.
    """
    for here, packet in _messages(bag, topic, layout, place):
        is_bigendian = packet.get("is_bigendian", False)
        if packet["encoding"] != encoding or (is_bigendian and width == 8):
            raise InputError(
                f"{bag.path}: {topic} has packets of {packet['encoding'][:20]!r} "
                f"{'in big-endian words ' if is_bigendian else ''}after packets of "
                f"{encoding!r}; record them as one encoding, in little-endian words"
            )
        content = np.concatenate([piece["value"] for piece in packet["events"]])
        if len(content) % width:
            raise damaged(
                f"{bag.path}: a packet of {topic} has {len(content)} bytes, which are not whole "
                f"words of {width}"
            )
        yield here, packet, content


Packets = Callable[[str, int, Any], Iterator[tuple[Place, Any, NDArray[np.uint8]]]]


def _decode_mono(
    packets: Packets, shift: int, state: Place | None
) -> Iterator[tuple[Place, Columns]]:
    """Decode packets of mono words.

    Args:
        packets: Function that yields packets of an encoding.
        shift: Difference from time bases to the clock of headers, ns.
        state: Place of the first packet; None: the start.

    Yields:
        The place of a block, and its columns.
    """
    pieces = (
        (place, len(content) // 8, (content.view("<u8"), packet["time_base"] + shift))
        for place, packet, content in packets("mono", 8, state)
    )
    for first, held in gather_pieces(pieces):
        words = np.concatenate([one for one, _ in held])
        t = np.concatenate([(one & 0xFFFFFFFF).astype(np.int64) + base for one, base in held])
        x, y = (words >> 32 & 0xFFFF).astype(np.uint16), (words >> 48 & 0x7FFF).astype(np.uint16)
        yield first, (t // 1000, x, y, words >> 63 == 1)


class _Evt3Packets:
    """The words of evt3 packets, one after the other, on the clock of the first header (us)."""

    def __init__(self, source: str, packets: Packets, stamp: int, found: FirstPass):
        self._source, self._packets, self._stamp, self._found = source, packets, stamp, found
        self._shift: int | None = None

    def decode(self, state: Any) -> Iterator[tuple[Any, Columns]]:
        blocks = decode_evt3(self._source, self._words, self._found, state)
        for here, (t, x, y, p) in blocks:
            if self._shift is None and len(t):
                self._shift = self._stamp - int(t[0])
            yield here, (t + (self._shift or 0), x, y, p)

    def triggers(self) -> Triggers | None:
        held = self._found.triggers()
        return held and dataclasses.replace(held, t=held.t + (self._shift or 0))

    def _words(self, place: tuple[int, Place] | None) -> Iterator[tuple[int, Any, NDArray]]:
        offset, at = place or (0, None)
        pieces = (
            (here, len(content), content) for here, _, content in self._packets("evt3", 2, at)
        )
        for first, held in gather_pieces(pieces, 2 * decoded.BLOCK_EVENTS):
            words = np.concatenate(held).view("<u2")
            yield offset, (offset, first), words
            offset += words.nbytes
