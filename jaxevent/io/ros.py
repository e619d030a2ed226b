"""ROS 1 bags with dvs_msgs/EventArray, as the drivers of DAVIS and Prophesee cameras record them.

Of one camera are read its events, and by their types frames (sensor_msgs/Image), inertial samples
(sensor_msgs/Imu), ground-truth poses (geometry_msgs/PoseStamped) and the calibration
(sensor_msgs/CameraInfo, plumb_bob). Where several topics have a type, the one under the events'
own name is taken (/dvs/image_raw for /dvs/events); topics of these types that are not read are
named in `extra["topics_left_out"]`. A bag with several cameras needs the topic of the events.

Times are those of the messages' headers and of the events, not those of recording, as ROS time in
us (nanoseconds are cut off). The exposure of images is unknown: 0. Colour images become grey
(ITU-R 601 luma). Events in the old prophesee_event_msgs/EventArray are laid out alike.

Decoder. The package rosbags (Apache 2, no ROS) reads the container, compressed or not. Its typed
decoding of EventArray takes 0.3 million events/s; here the 13 bytes of each event are read by
NumPy, at 20 million events/s. importRosbag (GPL) fails with NumPy 2. Both agree on bags written by
rosbags.
"""

import contextlib
import functools
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxevent.camera import PinholeCamera
from jaxevent.errors import InputError, require
from jaxevent.io import check_unfolded, most_unfolded, pinhole, reading, sensor_size
from jaxevent.io.decoded import BLOCK, Columns, DecodedImages, decoded
from jaxevent.recording import Frames, Imu, Poses, Recording

MAGIC = b"#ROSBAG V"
_EVENTS = ("dvs_msgs/msg/EventArray", "prophesee_event_msgs/msg/EventArray")
_IMAGE, _IMU = "sensor_msgs/msg/Image", "sensor_msgs/msg/Imu"
_POSE, _CAMERA = "geometry_msgs/msg/PoseStamped", "sensor_msgs/msg/CameraInfo"
_EVENT = np.dtype([("x", "<u2"), ("y", "<u2"), ("s", "<u4"), ("ns", "<u4"), ("p", "u1")])
_CHANNELS = {
    "mono8": ("u1", 1),
    "8UC1": ("u1", 1),
    "mono16": ("u2", 1),
    "16UC1": ("u2", 1),
    "rgb8": ("u1", 3),
    "bgr8": ("u1", 3),
}


def read(
    path: Path,
    size: tuple[int, int] | None,
    in_memory: bool = True,
    progress: bool | None = None,
    stream: str | None = None,
) -> Recording:
    """Read a bag; `size` is (width, height). Raises `InputError` for bad input.

    `stream` is the topic of the events, needed where there are several.
    """
    source = str(path)
    with reading(source):
        bag = _Bag(path)
    topic = _choose(path, bag.topics(*_EVENTS), stream)
    chosen = {kind: bag.beside(topic, kind) for kind in (_IMAGE, _IMU, _POSE, _CAMERA)}
    with reading(source):
        frames = _frames(path, bag, chosen[_IMAGE], in_memory)
        imu = _imu(bag, chosen[_IMU])
        poses = _poses(bag, chosen[_POSE])
        camera = _camera(bag, chosen[_CAMERA])
        told = _size(bag, topic)
    otherwise = f"{path}: the events of {topic} do not tell the sensor's size;"
    size = sensor_size(size, told, frames=frames, otherwise=otherwise)

    def decode(state: tuple[int, int] | None) -> Iterator[tuple[Any, Columns]]:
        held: list[NDArray] = []
        first: tuple[int, int] | None = None
        here = (-1, 0)
        for stamp, data in bag.messages(topic, state):
            here = (stamp, here[1] + 1 if stamp == here[0] else _skipped(state, stamp))
            first = here if not held else first
            held.append(_message(path, topic, data)[1])
            if sum(map(len, held)) >= BLOCK:
                yield first, _columns(path, topic, held)
                held = []
        if held:
            yield first, _columns(path, topic, held)

    events = decoded(decode, size, source, in_memory, progress)
    left_out = sorted(
        {topic for kind in chosen for topic in bag.topics(kind)} - set(chosen.values()) - {None}
    )
    left_out += [other for other in bag.topics(*_EVENTS) if other != topic]
    extra = {"topics_left_out": np.array(left_out)} if left_out else {}
    return Recording(path.stem, *size, events, frames, camera, poses, imu, extra)


class _Bag:
    """A bag's topics and raw messages; every pass opens the file anew."""

    def __init__(self, path: Path):
        require("rosbags", "ros")
        self._path = path
        with self._open() as reader:
            self._types = [(c.topic, c.msgtype, c.msgcount) for c in reader.connections]

    def _open(self) -> Any:
        from rosbags.rosbag1 import Reader
        from rosbags.rosbag1.reader import decompressors

        reader = Reader(self._path)
        reader.open()
        for place, chunk in reader.chunks.items():
            if chunk.decompressor is not decompressors["none"]:
                unfold = functools.partial(_unfolded, self._path)
                reader.chunks[place] = chunk._replace(decompressor=unfold)
        return contextlib.closing(reader)

    def topics(self, *kinds: str) -> list[str]:
        return sorted({topic for topic, kind, count in self._types if kind in kinds and count})

    def beside(self, events: str, kind: str) -> str | None:
        """The topic of a type that belongs to the same camera as the events, if one does."""
        several = self.topics(kind)
        if len(several) > 1:
            parent = events.rpartition("/")[0] + "/"
            several = [topic for topic in several if topic.startswith(parent)]
        return several[0] if len(several) == 1 else None

    def messages(
        self, topic: str, state: tuple[int, int] | None = None
    ) -> Iterator[tuple[int, bytes]]:
        """Times of recording (ns) and contents; `state` is a time and how many of it to skip."""
        start, skip = state or (None, 0)
        with self._open() as reader:
            connections = [c for c in reader.connections if c.topic == topic]
            for _, stamp, data in reader.messages(connections, start=start):
                if skip and stamp == start:
                    skip -= 1
                    continue
                yield stamp, data

    def decoded(self, topic: str | None, kind: str, start: int = 0) -> Iterator[Any]:
        """Typed messages of a topic, from number `start` on."""
        if topic is None:
            return
        store = _types()
        for number, (_, data) in enumerate(self.messages(topic)):
            if number >= start:
                yield store.deserialize_ros1(data, kind)


def _unfolded(path: Path, data: bytes) -> bytes:
    """A chunk without its compression, bz2 or LZ4; rosbags takes however much it unfolds to."""
    import bz2

    import lz4.frame

    length = path.stat().st_size
    is_bz2 = data.startswith(b"BZh")
    decompressor: Any = bz2.BZ2Decompressor() if is_bz2 else lz4.frame.LZ4FrameDecompressor()
    unfolded = decompressor.decompress(data, max_length=most_unfolded(length) + 1)
    check_unfolded(len(unfolded), length, str(path))
    return unfolded


@functools.cache
def _types() -> Any:
    """What the messages of ROS 1 hold; made once, as it takes 25 ms."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS1_NOETIC)


def _skipped(state: tuple[int, int] | None, stamp: int) -> int:
    return state[1] if state is not None and stamp == state[0] else 0


def _choose(path: Path, topics: list[str], stream: str | None) -> str:
    if stream is not None and stream not in topics:
        raise InputError(
            f"{path}: has no topic of events {stream!r}; its topics of events are "
            f"{', '.join(topics) or 'none'}"
        )
    if len(topics) > 1 and stream is None:
        raise InputError(
            f"{path}: holds the events of several cameras, {', '.join(topics)}; choose one with "
            "stream=, or with jaxevent convert --stream"
        )
    if not topics:
        raise InputError(
            f"{path}: the bag holds no topic of type dvs_msgs/EventArray; record the events as that"
        )
    return stream or topics[0]


def _message(path: Path, topic: str, data: bytes) -> tuple[tuple[int, int], NDArray]:
    """The sensor's size (width, height) that a message tells, and its events."""
    at = 16 + struct.unpack_from("<I", data, 12)[0]
    height, width, count = struct.unpack_from("<3I", data, at)
    if at + 12 + count * _EVENT.itemsize != len(data):
        raise InputError(
            f"{path}: a message of {topic} has {len(data) - at - 12} bytes for {count} events of "
            f"{_EVENT.itemsize}; the bag is damaged, so fetch it again"
        )
    return (width, height), np.frombuffer(data, _EVENT, count, at + 12)


def _size(bag: _Bag, topic: str) -> tuple[int, int] | None:
    for _, data in bag.messages(topic):
        (width, height), _ = _message(bag._path, topic, data)
        return (width, height) if width and height else None
    return None


def _columns(path: Path, topic: str, messages: list[NDArray]) -> Columns:
    events = np.concatenate(messages)
    if len(events) and events["ns"].max() >= 10**9:
        raise InputError(
            f"{path}: an event of {topic} has more than 10^9 nanoseconds; the bag is damaged, so "
            "fetch it again"
        )
    t = events["s"] * np.int64(1_000_000) + events["ns"] // 1000
    return t, events["x"].copy(), events["y"].copy(), events["p"].copy()


def _stamp(message: Any) -> int:
    stamp = message.header.stamp
    return stamp.sec * 1_000_000 + stamp.nanosec // 1000


def _frames(path: Path, bag: _Bag, topic: str | None, in_memory: bool) -> Frames | None:
    if topic is None:
        return None
    times, images, shape = [], [], None
    for message in bag.decoded(topic, _IMAGE):
        times.append(_stamp(message))
        image = _image(path, topic, message)
        shape = shape or (image.shape, image.dtype)
        if shape != (image.shape, image.dtype):
            raise InputError(
                f"{path}: image {len(times) - 1} of {topic} is {image.dtype} of shape "
                f"{image.shape} but the first one is {shape[1]} of shape {shape[0]}; all images "
                "must have the sensor's size and one depth"
            )
        if in_memory:
            images.append(image)
    if shape is None:
        return None
    if in_memory:
        stored: Any = np.stack(images)
    else:
        stored = DecodedImages(
            lambda row: (_image(path, topic, one) for one in bag.decoded(topic, _IMAGE, row)),
            (len(times), *shape[0]),
            shape[1],
            str(path),
        )
    t = np.array(times, np.int64)
    return Frames(t, stored, np.zeros_like(t))


def _image(path: Path, topic: str, message: Any) -> NDArray:
    if message.encoding not in _CHANNELS:
        raise InputError(
            f"{path}: the images of {topic} are encoded as {message.encoding[:20]!r}; record them "
            f"as {', '.join(_CHANNELS)}"
        )
    depth, channels = _CHANNELS[message.encoding]
    dtype = np.dtype(depth).newbyteorder(">" if message.is_bigendian else "<")
    rows = np.frombuffer(message.data.tobytes(), np.uint8).reshape(message.height, message.step)
    row = message.width * channels * dtype.itemsize
    image = np.ascontiguousarray(rows[:, :row]).view(dtype)
    image = image.reshape(message.height, message.width, channels).astype(dtype.newbyteorder("="))
    if channels == 1:
        return image[..., 0]
    red_first = image if message.encoding == "rgb8" else image[..., ::-1]
    return np.rint(red_first @ np.array([0.299, 0.587, 0.114])).astype(np.uint8)


def _imu(bag: _Bag, topic: str | None) -> Imu | None:
    rows = [
        (_stamp(m), _xyz(m.angular_velocity), _xyz(m.linear_acceleration))
        for m in bag.decoded(topic, _IMU)
    ]
    if not rows:
        return None
    t, gyro, acc = zip(*rows, strict=True)
    return Imu(np.array(t, np.int64), np.array(gyro), np.array(acc))


def _poses(bag: _Bag, topic: str | None) -> Poses | None:
    rows = [
        (_stamp(m), _xyz(m.pose.position), (*_xyz(m.pose.orientation), float(m.pose.orientation.w)))
        for m in bag.decoded(topic, _POSE)
    ]
    if not rows:
        return None
    t, position, quaternion = zip(*rows, strict=True)
    return Poses(np.array(t, np.int64), np.array(position), np.array(quaternion))


def _xyz(vector: Any) -> tuple[float, float, float]:
    return float(vector.x), float(vector.y), float(vector.z)


def _camera(bag: _Bag, topic: str | None) -> PinholeCamera | None:
    """The first calibration; None where there is none, or of another model than plumb_bob."""
    for message in bag.decoded(topic, _CAMERA):
        fx, _, cx, _, fy, cy = (float(value) for value in message.K[:6])
        k = [float(value) for value in message.D]
        if fx <= 0 or message.distortion_model not in ("plumb_bob", "") or len(k) not in (0, 4, 5):
            return None
        k += [0.0] * (5 - len(k))
        return pinhole(np.array([fx, fy, cx, cy, *k]), f"{bag._path}: {topic}")
    return None
