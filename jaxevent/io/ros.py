"""Bags of ROS 1 and ROS 2, as the drivers of DAVIS and Prophesee cameras record them.

Of one camera are read its events (see `ros_events`), and by their types frames (sensor_msgs/Image),
inertial samples (sensor_msgs/Imu), ground-truth poses (geometry_msgs/PoseStamped) and the
calibration (sensor_msgs/CameraInfo, plumb_bob). Where several topics have a type, the one under the
events' own name is taken (/dvs/image_raw for /dvs/events); topics of these types that are not read
are named in `extra["topics_left_out"]`. A bag with several cameras needs the topic of the events.

Times are those of the messages' headers and of the events, not those of recording, as ROS time in
us (nanoseconds are cut off). The exposure of images is unknown: 0. Colour images become grey
(ITU-R 601 luma), and `extra["rgb"]` keeps their colours.

Decoder. The package rosbags reads the containers, see `bags`. importRosbag (GPL) fails with NumPy
2. Both agree on bags of ROS 1 written by rosbags; of ROS 2, bags are read that rosbags wrote.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxevent.camera import PinholeCamera
from jaxevent.errors import InputError
from jaxevent.io import pinhole, reading, sensor_size
from jaxevent.io.bags import Bag
from jaxevent.io.decoded import DecodedImages, decoded
from jaxevent.io.images import LUMA
from jaxevent.io.options import ReadOptions
from jaxevent.io.ros_events import ARRAYS, PACKET, event_topic
from jaxevent.recording import Frames, Imu, Poses, Recording

_IMAGE, _IMU = "sensor_msgs/msg/Image", "sensor_msgs/msg/Imu"
_POSE, _CAMERA = "geometry_msgs/msg/PoseStamped", "sensor_msgs/msg/CameraInfo"
_CHANNELS = {
    "mono8": ("u1", 1),
    "8UC1": ("u1", 1),
    "mono16": ("u2", 1),
    "16UC1": ("u2", 1),
    "rgb8": ("u1", 3),
    "bgr8": ("u1", 3),
}


def read(path: Path, options: ReadOptions) -> Recording:
    """Read a bag. Raises `InputError` for bad input.

    `options.stream` is the topic of the events, needed where there are several.
    """
    source = str(path)
    with reading(source):
        bag = Bag(path)
    topic = _choose(path, bag.topics(*ARRAYS, PACKET), options.stream)
    chosen = {kind: bag.beside(topic, kind) for kind in (_IMAGE, _IMU, _POSE, _CAMERA)}
    with reading(source):
        frames, colours = _frames(path, bag, chosen[_IMAGE], options.in_memory)
        imu = _imu(bag, chosen[_IMU])
        poses = _poses(bag, chosen[_POSE])
        camera = _camera(bag, chosen[_CAMERA])
        found = event_topic(bag, topic)
    otherwise = f"{path}: the events of {topic} do not tell the sensor's size;"
    size = sensor_size(options.size, found.size, frames=frames, otherwise=otherwise)
    events = decoded(found.decode, size, source, options)
    left_out = sorted(
        {topic for kind in chosen for topic in bag.topics(kind)} - set(chosen.values()) - {None}
    )
    left_out += [other for other in bag.topics(*ARRAYS, PACKET) if other != topic]
    extra: dict[str, Any] = dict(found.untimed.arrays())
    extra |= {"topics_left_out": np.array(left_out)} if left_out else {}
    extra |= {} if colours is None else {"rgb": colours}
    triggers = found.triggers()
    return Recording(path.stem, *size, events, frames, camera, poses, imu, extra, triggers)


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
            f"{path}: the bag holds no topic of events; record them as dvs_msgs/EventArray or "
            "event_camera_msgs/EventPacket"
        )
    return stream or topics[0]


def _stamp(message: Any) -> int:
    stamp = message.header.stamp
    return stamp.sec * 1_000_000 + stamp.nanosec // 1000


def _frames(path: Path, bag: Bag, topic: str | None, in_memory: bool) -> tuple[Frames | None, Any]:
    """The frames of a topic, and their colours (frames, height, width, 3), None of grey ones."""
    if topic is None:
        return None, None
    times, images, colours, places, shape = [], [], [], [], None
    coloured, differ = True, False
    for place, message in bag.decoded(topic):
        times.append(_stamp(message))
        places.append(place)
        stored = _image(path, topic, message)
        coloured = coloured and stored.ndim == 3
        differ = differ or (coloured and bool((stored != stored[..., :1]).any()))
        image = _grey(stored)
        shape = shape or (image.shape, image.dtype)
        if shape != (image.shape, image.dtype):
            raise InputError(
                f"{path}: image {len(times) - 1} of {topic} is {image.dtype} of shape "
                f"{image.shape} but the first one is {shape[1]} of shape {shape[0]}; all images "
                "must have the sensor's size and one depth"
            )
        if in_memory:
            images.append(image)
            colours += [stored] * coloured
    if shape is None:
        return None, None
    t = np.array(times, np.int64)
    if in_memory:
        kept = np.stack(colours) if coloured and differ else None
        return Frames(t, np.stack(images), np.zeros_like(t)), kept

    name: str = topic

    def decoded_images(of: Callable[[NDArray], NDArray], *channels: int) -> DecodedImages:
        return DecodedImages(
            lambda row: (of(_image(path, name, one)) for _, one in bag.decoded(name, places[row])),
            (len(times), *shape[0], *channels),
            shape[1],
            str(path),
        )

    kept = decoded_images(lambda image: image, 3) if coloured and differ else None
    return Frames(t, decoded_images(_grey), np.zeros_like(t)), kept


def _image(path: Path, topic: str, message: Any) -> NDArray:
    """An image as it is stored, in colour (height, width, 3) with red first."""
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
    return image if message.encoding == "rgb8" else np.ascontiguousarray(image[..., ::-1])


def _grey(image: NDArray) -> NDArray:
    """An image in grey: ITU-R 601 luma of colours."""
    return image if image.ndim == 2 else np.rint(image @ LUMA).astype(np.uint8)


def _imu(bag: Bag, topic: str | None) -> Imu | None:
    rows = [
        (_stamp(m), _xyz(m.angular_velocity), _xyz(m.linear_acceleration))
        for _, m in bag.decoded(topic)
    ]
    if not rows:
        return None
    t, gyro, acc = zip(*rows, strict=True)
    return Imu(np.array(t, np.int64), np.array(gyro), np.array(acc))


def _poses(bag: Bag, topic: str | None) -> Poses | None:
    rows = [
        (_stamp(m), _xyz(m.pose.position), (*_xyz(m.pose.orientation), float(m.pose.orientation.w)))
        for _, m in bag.decoded(topic)
    ]
    if not rows:
        return None
    t, position, quaternion = zip(*rows, strict=True)
    return Poses(np.array(t, np.int64), np.array(position), np.array(quaternion))


def _xyz(vector: Any) -> tuple[float, float, float]:
    return float(vector.x), float(vector.y), float(vector.z)


def _camera(bag: Bag, topic: str | None) -> PinholeCamera | None:
    """The first calibration; None where there is none, or of another model than plumb_bob."""
    for _, message in bag.decoded(topic):
        matrix, k = (message.K, message.D) if bag.is_ros1 else (message.k, message.d)
        fx, _, cx, _, fy, cy = (float(value) for value in matrix[:6])
        k = [float(value) for value in k]
        if fx <= 0 or message.distortion_model not in ("plumb_bob", "") or len(k) not in (0, 4, 5):
            return None
        k += [0.0] * (5 - len(k))
        return pinhole(np.array([fx, fy, cx, cy, *k]), f"{bag.path}: {topic}")
    return None
