"""Bags of ROS 1 and ROS 2, as the drivers of DAVIS and Prophesee cameras record them.

Of one camera are read its events (see `ros_events`), and by their types frames (sensor_msgs/Image
and CompressedImage), inertial samples (sensor_msgs/Imu), ground-truth poses
(geometry_msgs/PoseStamped) and the calibration (sensor_msgs/CameraInfo). Where several topics have
a type, the one under the events' own name is taken (/dvs/imu for /dvs/events); topics of these
types that are not read are named in `extra["topics_left_out"]` and, where a field stays None, in
`left_out`. A bag with several cameras needs the topic of the events. A bag without events is read
for its frames.

Of several topics of images under the events' name those are taken that can be read and have the
sensor's size, then `image_raw`, then images as they are rather than their compressed copies. Depth
images (32FC1, compressedDepth, and 16UC1 of a topic named so) are never taken, and those of another
size are another camera's, which `register` brings onto the events' pixels. `frames` names another
topic, or "none".

Images are mono8, mono10, 12, 14 and 16, in colours of 8 or 16 bits, YUV 4:2:2 (of which the luma is
read), in a Bayer pattern of 8 or 16 bits (interpolated, see `bayer`), or compressed as Pillow reads
them. Those of 10 to 14 bits are shifted to 16.

Times are those of the messages' headers and of the events, not those of recording, as ROS time in
us (nanoseconds are cut off). The exposure of images is unknown: 0. Colour images become grey
(ITU-R 601 luma), and `extra["rgb"]` keeps their colours.

Decoder. The package rosbags reads the containers, see `bags`. importRosbag (GPL) fails with NumPy
2. Both agree on bags of ROS 1 written by rosbags; of ROS 2, bags are read that rosbags wrote.
"""

import contextlib
import io
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.arrays import LUMA
from jaxevent.camera import PinholeCamera
from jaxevent.errors import InputError
from jaxevent.io import calibrated, check_unfolded, reading, sensor_size
from jaxevent.io.bags import Bag
from jaxevent.io.bayer import PATTERNS, demosaic
from jaxevent.io.decoded import DecodedImages, decoded
from jaxevent.io.images import read_image
from jaxevent.io.options import ReadOptions
from jaxevent.io.ros_events import event_topic, event_topics
from jaxevent.recording import Events, Frames, Imu, Poses, Recording

_IMAGE, _COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
_IMU, _POSE = "sensor_msgs/msg/Imu", "geometry_msgs/msg/PoseStamped"
_CAMERA = "sensor_msgs/msg/CameraInfo"
_FIELDS = {_IMU: "imu", _POSE: "poses", _CAMERA: "camera"}
_LUMA_AT = {"yuv422": 1, "uyvy": 1, "yuv422_yuy2": 0, "yuyv": 0}  # byte of a pixel's two
_DEEP = {"mono10": 10, "mono12": 12, "mono14": 14}  # bits, of 16
_CHANNELS = {
    "mono8": ("u1", 1),
    "8UC1": ("u1", 1),
    "mono16": ("u2", 1),
    "16UC1": ("u2", 1),
    "8UC3": ("u1", 3),  # blue, green, red, as OpenCV has them
    "8UC4": ("u1", 4),
    **{name: ("u2", 1) for name in _DEEP},
    **{name: ("u1", 2) for name in _LUMA_AT},
    **{
        f"{order}{bits}": (f"u{bits // 8}", len(order))
        for order in ("rgb", "bgr", "rgba", "bgra")
        for bits in (8, 16)
    },
    **{
        f"bayer_{pattern.lower()}{bits}": (f"u{bits // 8}", 1)
        for pattern in PATTERNS
        for bits in (8, 16)
    },
}


class _Topic(NamedTuple):
    """A topic of images, by its first one."""

    is_depth: bool
    is_read: bool  # its encoding
    size: tuple[int, int] | None  # (width, height); None where a compressed image is damaged


def read(path: Path, options: ReadOptions) -> Recording:
    """Read a bag. Raises `InputError` for bad input.

    `options.stream` is the topic of the events, needed where there are several, `options.frames`
    that of the frames.
    """
    source = str(path)
    with reading(source):
        bag = Bag(path)
        several, images = event_topics(bag), _image_topics(bag)
    topic = _choose(bag, several, any(not one.is_depth for one in images.values()), options)
    with reading(source):
        events_of = None if topic is None else event_topic(bag, topic)
    told = events_of.size if events_of else None
    image, left_out = _choose_frames(bag, topic, images, options, options.size or told)
    chosen: dict[str, str | None] = {}
    for kind, field in _FIELDS.items():
        found = bag.beside(topic, held := bag.topics(kind))
        chosen[kind] = found[0] if len(found) == 1 else None
        if held and chosen[kind] is None:
            number = "several are" if found else "none is"
            left_out[field] = (
                f"the topics {', '.join(held)} hold some, of which {number} under the name of "
                f"{topic or 'the frames'}"
            )
    with reading(source):
        frames, colours = _frames(path, bag, image, options.in_memory)
        imu = _imu(bag, chosen[_IMU])
        poses = _poses(bag, chosen[_POSE])
        camera, of_lens = _camera(bag, chosen[_CAMERA])
    otherwise = f"{path}: the events of {topic} do not tell the sensor's size;"
    size = sensor_size(options.size, told, frames=frames, otherwise=otherwise)
    events = decoded(events_of.decode, size, source, options) if events_of else Events.empty()
    unread = set(images) | {one for kind in _FIELDS for one in bag.topics(kind)}
    unread -= {image, *chosen.values()}
    names = [*sorted(unread), *(other for other in several if other != topic)]
    extra: dict[str, Any] = dict(events_of.untimed.arrays()) if events_of else {}
    extra |= {"topics_left_out": np.array(names)} if names else {}
    extra |= {} if colours is None else {"rgb": colours}
    triggers = events_of.triggers() if events_of else None
    left_out |= of_lens
    return Recording(
        path.stem, *size, events, frames, camera, poses, imu, extra, triggers, left_out=left_out
    )


def _choose(bag: Bag, topics: list[str], has_images: bool, options: ReadOptions) -> str | None:
    """The topic of the events; None in a bag of images alone."""
    path, stream = bag.path, options.stream
    if options.without_events and has_images:
        return None
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
        held = ", ".join(f"{name} ({kind})" for name, kind in sorted(bag.kinds().items()))
        if not has_images or options.without_frames:
            raise InputError(
                f"{path}: the bag holds no topic of events; record them as dvs_msgs/EventArray or "
                f"event_camera_msgs/EventPacket; its topics are {held[:300] or 'empty'}"
            )
        options.notes.append(f"no topic of {held[:300]} holds events")
        return None
    return stream or topics[0]


def _image_topics(bag: Bag) -> dict[str, _Topic]:
    """All topics of images, sorted."""
    from PIL import Image

    found = {}
    for topic in bag.topics(_IMAGE, _COMPRESSED):
        _, message = next(bag.decoded(topic))
        if bag.kind(topic) == _COMPRESSED:
            size = None
            # What is wrong with it is told where its images are read.
            with contextlib.suppress(Exception), Image.open(io.BytesIO(message.data)) as opened:
                size = opened.size
            found[topic] = _Topic("compressedDepth" in message.format, True, size)
            continue
        encoding = message.encoding
        is_depth = encoding in ("32FC1", "64FC1")
        is_depth |= encoding == "16UC1" and "depth" in topic.lower()
        size = (message.width, message.height)
        found[topic] = _Topic(is_depth, encoding in _CHANNELS, size)
    return found


def _choose_frames(
    bag: Bag,
    events: str | None,
    images: dict[str, _Topic],
    options: ReadOptions,
    size: tuple[int, int] | None,
) -> tuple[str | None, dict[str, str]]:
    """The topic of the frames, None where none is chosen, and what that leaves out.

    `size` is that of the sensor, None where it is not known.
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
    if len(several) > 1 and not found and len({_source_of(topic) for topic in several}) == 1:
        found = several

    def fits(topic: str) -> bool:
        return None in (size, images[topic].size) or images[topic].size == size

    for prefer in (
        lambda topic: images[topic].is_read,
        fits,
        lambda topic: _source_of(topic).rpartition("/")[2] == "image_raw",
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


def _source_of(topic: str) -> str:
    """The topic of the images of which another one may hold compressed copies."""
    return topic.removesuffix("/compressed")


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
        stored = _image(bag, topic, message)
        coloured = coloured and stored.ndim == 3 and stored.dtype == np.uint8
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
            lambda row: (of(_image(bag, name, one)) for _, one in bag.decoded(name, places[row])),
            (len(times), *shape[0], *channels),
            shape[1],
            str(path),
        )

    kept = decoded_images(lambda image: image, 3) if coloured and differ else None
    return Frames(t, decoded_images(_grey), np.zeros_like(t)), kept


def _image(bag: Bag, topic: str, message: Any) -> NDArray:
    """An image as it is stored, in colour (height, width, 3) with red first."""
    if bag.kind(topic) == _COMPRESSED:
        image = _decompressed(bag, topic, message.data)
        encoding = message.format.partition(";")[0].strip()
        return _colours(image, encoding) if image.ndim == 2 else image
    encoding = message.encoding
    if encoding not in _CHANNELS:
        raise InputError(
            f"{bag.path}: the images of {topic} are encoded as {encoding[:20]!r}, which is not "
            "read; record them as mono8, rgb8 or bayer_rggb8, or leave them out with "
            "frames='none' or --frames none"
        )
    depth, channels = _CHANNELS[encoding]
    dtype = np.dtype(depth).newbyteorder(">" if message.is_bigendian else "<")
    rows = np.frombuffer(message.data.tobytes(), np.uint8).reshape(message.height, message.step)
    row = message.width * channels * dtype.itemsize
    image = np.ascontiguousarray(rows[:, :row]).view(dtype)
    image = image.reshape(message.height, message.width, channels).astype(dtype.newbyteorder("="))
    if encoding in _LUMA_AT:
        return np.ascontiguousarray(image[..., _LUMA_AT[encoding]])
    if channels == 1:
        return _colours(image[..., 0] << (16 - _DEEP.get(encoding, 16)), encoding)
    return np.ascontiguousarray(image[..., :3] if encoding[0] == "r" else image[..., 2::-1])


def _decompressed(bag: Bag, topic: str, data: NDArray[np.uint8]) -> NDArray:
    """An image that Pillow reads: grey (height, width), else (height, width, 3)."""
    from PIL import Image

    source = f"{bag.path}: an image of {topic}"
    with reading(source):
        with Image.open(io.BytesIO(data.tobytes())) as opened:
            unfolded = opened.width * opened.height * len(opened.getbands())
            check_unfolded(unfolded, len(data), source)
        image = read_image(io.BytesIO(data.tobytes()), source)
    return image if image.ndim == 2 else image[..., :3]


def _colours(image: NDArray, encoding: str) -> NDArray:
    """The colours of a grey image that is the mosaic of a Bayer pattern; others as they are."""
    pattern = encoding.removeprefix("bayer_")[:4].upper()
    if not encoding.startswith("bayer_") or pattern not in PATTERNS:
        return image
    return np.rint(demosaic(image[None], pattern)[0]).astype(image.dtype)


def _grey(image: NDArray) -> NDArray:
    """An image in grey: ITU-R 601 luma of colours."""
    return image if image.ndim == 2 else np.rint(image @ LUMA).astype(image.dtype)


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


def _camera(bag: Bag, topic: str | None) -> tuple[PinholeCamera | None, dict[str, str]]:
    """The first calibration, and what is left out where it cannot be used."""
    for _, message in bag.decoded(topic):
        matrix, k = (message.K, message.D) if bag.is_ros1 else (message.k, message.d)
        fx, _, cx, _, fy, cy = (float(value) for value in matrix[:6])
        if fx <= 0:
            return None, {"camera": f"{topic} holds no calibration, but a focal length of {fx:g}"}
        source = f"{bag.path}: {topic}"
        return calibrated(np.array([fx, fy, cx, cy]), message.distortion_model, k, source)
    return None, {}
