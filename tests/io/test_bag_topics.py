"""Bags: events of any type of message, a choice of frames, encodings of images, lenses."""

import functools
import io as streams

import formats
import numpy as np
import pytest
from commands import fails
from PIL import Image
from refusals import refuses

import jaxevent
from jaxevent import cli
from jaxevent.events import undistort
from jaxevent.io import bags
from jaxevent.recording import Events, Frames, Recording
from jaxevent.register import read_frames

pytest.importorskip("rosbags")

SIZE = (12, 10)
EVENTS = formats.events_of(3, 60, SIZE, start=1_600_000_000_000_123)
T = [int(t) for t in EVENTS.t[[5, 30]]]
IMAGES = np.random.default_rng(0).integers(0, 256, (2, 10, 12)).astype(np.uint8)
TYPES = {
    "dv_ros_msgs/msg/Event": "uint16 x\nuint16 y\nbuiltin_interfaces/Time ts\nbool polarity",
    "dv_ros_msgs/msg/EventArray": (
        "std_msgs/Header header\nuint32 height\nuint32 width\ndv_ros_msgs/Event[] events"
    ),
    "own_msgs/msg/Spike": (
        "bool on\nbuiltin_interfaces/Time stamp\nfloat64[2] weight\nuint32 y\nuint8 x"
    ),
    "own_msgs/msg/Burst": (
        "string name\nfloat32[3] turn\nown_msgs/Spike[] spikes\nuint16[] others\n"
        "uint32 width\nuint32 height"
    ),
    "event_array_msgs/msg/EventArray": (
        "std_msgs/Header header\nuint32 height\nuint32 width\nuint64 seq\nuint64 time_base\n"
        "string encoding\nuint8[] events"
    ),
}


@functools.cache
def store(is_ros1):
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    made = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
    for name, text in TYPES.items():
        made.register(get_types_from_msg(text, name))
    return made


def one(kind, *values, is_ros1=True):
    return store(is_ros1).types[kind](*values)


def stamp(t, is_ros1=True):
    return one(
        "builtin_interfaces/msg/Time", int(t) // 10**6, int(t) % 10**6 * 1000, is_ros1=is_ros1
    )


def header(t, is_ros1=True):
    start = (0,) if is_ros1 else ()
    return one("std_msgs/msg/Header", *start, stamp(t, is_ros1), "cam", is_ros1=is_ros1)


def spikes(events, is_ros1):
    """Messages of a type and an order of fields that no driver has."""
    for at in range(0, len(events), 7):
        held = [
            one("own_msgs/msg/Spike", p, stamp(t, is_ros1), np.arange(2.0), y, x, is_ros1=is_ros1)
            for t, x, y, p in formats.rows(events[at : at + 7])
        ]
        turn, others = np.arange(3, dtype=np.float32), np.arange(3, dtype=np.uint16)
        values = ("n" * (at % 5), turn, held, others, *SIZE)
        yield one("own_msgs/msg/Burst", *values, is_ros1=is_ros1)


def arrays(events):
    held = [one("dv_ros_msgs/msg/Event", x, y, stamp(t), p) for t, x, y, p in formats.rows(events)]
    yield one("dv_ros_msgs/msg/EventArray", header(events.t[0]), SIZE[1], SIZE[0], held)


def image(t, values, encoding):
    values = np.ascontiguousarray(values)
    step = values.nbytes // len(values)
    data = values.view(np.uint8).ravel()
    return one("sensor_msgs/msg/Image", header(t), *values.shape[:2], encoding, 0, step, data)


def images(stack, encoding="mono8"):
    kind = "sensor_msgs/msg/Image"
    return kind, [image(t, each, encoding) for t, each in zip(T, stack, strict=True)]


def compressed(stack, file_type, text):
    held = []
    for t, each in zip(T, stack, strict=True):
        file = streams.BytesIO()
        Image.fromarray(each).save(file, file_type)
        data = np.frombuffer(file.getvalue(), np.uint8)
        held.append(one("sensor_msgs/msg/CompressedImage", header(t), text, data))
    return "sensor_msgs/msg/CompressedImage", held


def calibration(model, d):
    region = one("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False)
    k = np.array([5.0, 0, 6, 0, 5.5, 5, 0, 0, 1])
    values = (SIZE[1], SIZE[0], model, np.array(d), k, np.zeros(9), np.zeros(12), 0, 0, region)
    kind = "sensor_msgs/msg/CameraInfo"
    return kind, [one(kind, header(T[0]), *values)]


EVENTS_TOPIC = {"/cam/events": ("dv_ros_msgs/msg/EventArray", list(arrays(EVENTS)))}


def bag(path, topics, with_events=True):
    from rosbags.rosbag1 import Writer

    topics = {**(EVENTS_TOPIC if with_events else {}), **topics}
    with Writer(path) as writer:
        for topic, (kind, messages) in topics.items():
            link = writer.add_connection(topic, kind, typestore=store(True))
            for number, message in enumerate(messages):
                writer.write(link, 10**18 + number, store(True).serialize_ros1(message, kind))
    return path


def bag2(path, topic, kind, messages, little_endian=True):
    from rosbags.rosbag2 import StoragePlugin, Writer

    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        link = writer.add_connection(topic, kind, typestore=store(False))
        for number, message in enumerate(messages):
            data = store(False).serialize_cdr(message, kind, little_endian=little_endian)
            writer.write(link, 10**18 + number, data)
    return path


def assert_events(got):
    for name in ("t", "x", "y", "p"):
        np.testing.assert_array_equal(getattr(got.events[:], name), getattr(EVENTS, name))
    assert (got.width, got.height) == SIZE


def test_events_are_known_by_their_fields(tmp_path):
    assert_events(jaxevent.load(bag(tmp_path / "a.bag", {})))
    kind = "own_msgs/msg/Burst"
    path = bag(tmp_path / "b.bag", {"/spikes": (kind, list(spikes(EVENTS, True)))}, False)
    assert_events(jaxevent.load(path))
    assert cli.main(["convert", str(path), str(tmp_path / "b.h5")]) == 0
    assert_events(jaxevent.load(tmp_path / "b.h5"))


@pytest.mark.parametrize("little_endian", [True, False])
def test_events_of_ros_2_are_known_by_their_fields(little_endian, tmp_path):
    messages = list(spikes(EVENTS, False))
    path = bag2(tmp_path / "a", "/spikes", "own_msgs/msg/Burst", messages, little_endian)
    for in_memory in (True, False):
        assert_events(jaxevent.load(path, in_memory=in_memory))


def test_packets_of_another_package(tmp_path):
    kind = "event_array_msgs/msg/EventArray"
    held = []
    for number, (at, words) in enumerate(formats.packed(EVENTS, "mono", SIZE, 9)):
        t = int(EVENTS.t[at])
        values = (SIZE[1], SIZE[0], number, t * 1000, "mono", words.view(np.uint8))
        held.append(one(kind, header(t), *values))
    assert_events(jaxevent.load(bag(tmp_path / "a.bag", {"/e": (kind, held)}, False)))


def test_messages_of_another_length_are_refused(tmp_path):
    from rosbags.rosbag1 import Writer

    kind = "own_msgs/msg/Burst"
    data = bytes(store(True).serialize_ros1(next(spikes(EVENTS, True)), kind))
    for number, part in enumerate((data[:-1], data[:60], data + b"0")):
        with Writer(tmp_path / f"{number}.bag") as writer:
            link = writer.add_connection("/spikes", kind, typestore=store(True))
            writer.write(link, 1, part)
        refuses(
            f"{number}.bag: a message of /spikes has .* fetch",
            jaxevent.load,
            tmp_path / f"{number}.bag",
        )


@pytest.mark.parametrize("parts", ["own_msgs/Burst again", "own_msgs/Part0 part"])
def test_definitions_may_not_take_any_time(parts):
    """Parts within themselves, and 2^16 parts of which none takes a byte."""
    from rosbags.typesys import get_types_from_msg

    texts = {f"Part{k}": f"own_msgs/Part{k + 1} a\nown_msgs/Part{k + 1} b" for k in range(16)}
    texts |= {"Part16": "", "Burst": f"{parts}\n{TYPES['own_msgs/msg/Burst']}"}
    fields = {name: held for name, (_, held) in store(True).fielddefs.items()}
    for name, text in texts.items():
        kind = f"own_msgs/msg/{name}"
        fields |= {one: held for one, (_, held) in get_types_from_msg(text, kind).items()}
    layout = bags.MessageLayout(fields, "own_msgs/msg/Burst", True)
    with pytest.raises(ValueError, match="without a usable definition"):
        layout.read(bytes(1000))


SEVERAL = {
    "/cam/image_raw": images(IMAGES),
    "/cam/image_corrupted": images(255 - IMAGES),
    "/cam/depthmap": images(np.ones((2, 10, 12), np.float32), "32FC1"),
    "/cam/depth/range": images(np.ones((2, 10, 12), np.uint16), "16UC1"),
    "/cam/image_raw/compressed": compressed(IMAGES, "PNG", "mono8; png compressed mono8"),
    "/cam/depth/compressedDepth": compressed(IMAGES, "PNG", "32FC1; compressedDepth png"),
}


def test_frames_are_chosen_among_topics(tmp_path, capsys):
    path = bag(tmp_path / "a.bag", SEVERAL)
    got = jaxevent.load(path)
    np.testing.assert_array_equal(got.frames.images, IMAGES)
    assert got.frames.t.tolist() == T
    (note,) = got.notes
    assert "/cam/image_raw;" in note and "--frames" in note and "depth" not in note
    other = jaxevent.load(path, frames="/cam/image_corrupted")
    np.testing.assert_array_equal(other.frames.images, 255 - IMAGES)
    none = jaxevent.load(path, frames="none")
    assert none.frames is None and "frames='none'" in none.describe_left_out("frames")
    refuses(
        "depths in '/cam/depthmap', and images in /cam/image_c",
        jaxevent.load,
        path,
        frames="/cam/depthmap",
    )
    refuses("no images in a topic '/a'", jaxevent.load, path, frames="/a")

    out = tmp_path / "a.h5"
    words = ["convert", str(path), str(out), "--frames", "/cam/image_corrupted"]
    assert cli.main(words) == 0
    np.testing.assert_array_equal(jaxevent.load(out).frames.images, 255 - IMAGES)
    capsys.readouterr()
    assert cli.main(["info", str(path)]) == 0
    assert note in capsys.readouterr().out
    fails(capsys, ["info", path, "--frames", "/a"], "a.bag", "'/a'", "--frames")


def test_topics_that_are_left_out_are_named(tmp_path):
    held = {f"/cam/{name}": images(IMAGES) for name in ("one", "two")}
    got = jaxevent.load(bag(tmp_path / "a.bag", held))
    assert got.frames is None
    assert "/cam/one, /cam/two; choose one with frames=" in got.describe_left_out("frames")
    assert got.extra["topics_left_out"].tolist() == ["/cam/one", "/cam/two"]
    elsewhere = {f"/{name}/image_raw": images(IMAGES) for name in ("left", "right")}
    got = jaxevent.load(bag(tmp_path / "b.bag", elsewhere))
    assert got.frames is None and "/left/image_raw" in got.left_out["frames"]
    depth = {"/cam/depth": images(np.ones((2, 10, 12), np.float32), "32FC1")}
    got = jaxevent.load(bag(tmp_path / "c.bag", depth))
    assert got.frames is None and "/cam/depth are depths" in got.left_out["frames"]


def test_a_bag_of_images_alone_is_another_camera(tmp_path):
    path = bag(tmp_path / "a.bag", {"/cam/image_raw": images(IMAGES)}, with_events=False)
    got = jaxevent.load(path)
    assert not len(got.events) and got.frames.t.tolist() == T
    assert "/cam/image_raw" in got.notes[0]
    refuses("holds no topic of events", jaxevent.load, path, frames="none")


def test_compressed_images(tmp_path):
    colours = np.zeros((2, 10, 12, 3), np.uint8)
    colours[..., 0], colours[..., 2] = 200, IMAGES
    path = bag(tmp_path / "a.bag", {"/cam/image/compressed": compressed(colours, "PNG", "png")})
    for in_memory in (True, False):
        got = jaxevent.load(path, in_memory=in_memory)
        grey = colours @ [0.299, 0.587, 0.114]
        np.testing.assert_allclose(np.asarray(got.frames.images), grey, rtol=0, atol=0.51)
        np.testing.assert_array_equal(np.asarray(got.extra["rgb"]), colours)
    flat = np.full((2, 10, 12), 77, np.uint8)
    path = bag(tmp_path / "b.bag", {"/cam/image/compressed": compressed(flat, "JPEG", "jpeg")})
    np.testing.assert_array_equal(jaxevent.load(path).frames.images, flat)
    kind, (first, second) = compressed(flat, "PNG", "png")
    first.data = first.data[:40]
    path = bag(tmp_path / "c.bag", {"/cam/image/compressed": (kind, [first, second])})
    refuses("image of /cam/image/compressed: cannot be read", jaxevent.load, path)


PLACES = {"rggb": (0, 1, 1, 2), "bggr": (2, 1, 1, 0), "gbrg": (1, 2, 0, 1), "grbg": (1, 0, 2, 1)}


@pytest.mark.parametrize("pattern", PLACES)
@pytest.mark.parametrize("bits", [8, 16])
def test_bayer_images(pattern, bits, tmp_path):
    """Colours that rise linearly are interpolated exactly, but for the border."""
    y, x = np.mgrid[:10, :12]
    colours = np.stack([20 + 2 * x, 90 + 4 * y, 200 - 2 * x - 2 * y], -1) << (bits - 8)
    cell = np.tile(np.array(PLACES[pattern]).reshape(2, 2), (5, 6))
    mosaic = np.take_along_axis(colours, cell[..., None], -1)[..., 0].astype(f"u{bits // 8}")
    topic = {"/cam/image_raw": images([mosaic, mosaic], f"bayer_{pattern}{bits}")}
    got = jaxevent.load(bag(tmp_path / "a.bag", topic))
    grey = colours @ [0.299, 0.587, 0.114]
    assert got.frames.images.dtype == mosaic.dtype
    images_read = np.asarray(got.frames.images)
    np.testing.assert_allclose(images_read[0, 1:-1, 1:-1], grey[1:-1, 1:-1], rtol=0, atol=1)
    if bits == 8:
        np.testing.assert_array_equal(got.extra["rgb"][1, 1:-1, 1:-1], colours[1:-1, 1:-1])


def test_a_compressed_mosaic_is_interpolated(tmp_path):
    flat = np.tile(np.array([[200, 100], [100, 20]], np.uint8), (2, 5, 6))
    topic = {"/cam/image_raw/compressed": compressed(flat, "PNG", "bayer_rggb8; png compressed ")}
    got = jaxevent.load(bag(tmp_path / "a.bag", topic))
    assert (got.extra["rgb"] == [200, 100, 20]).all()


def test_other_encodings(tmp_path):
    rgba = np.random.default_rng(1).integers(0, 256, (2, 10, 12, 4)).astype(np.uint8)
    rgb = rgba[..., :3]
    deep = rgb.astype(np.uint16) * 257
    held = {
        "rgba8": rgba,
        "bgra8": rgba[..., [2, 1, 0, 3]],
        "rgb16": deep,
        "bgr16": deep[..., ::-1],
        "8UC3": rgb[..., ::-1],
        "8UC4": rgba[..., [2, 1, 0, 3]],
        "mono12": IMAGES.astype(np.uint16) << 4,
        "yuv422": np.stack([255 - IMAGES, IMAGES], -1),
        "yuv422_yuy2": np.stack([IMAGES, 255 - IMAGES], -1),
    }
    for encoding, stack in held.items():
        topic = {"/cam/image_raw": images(stack, encoding)}
        got = jaxevent.load(bag(tmp_path / f"{encoding}.bag", topic))
        if encoding == "mono12":
            np.testing.assert_array_equal(got.frames.images, IMAGES.astype(np.uint16) << 8)
            continue
        if encoding.startswith("yuv"):
            np.testing.assert_array_equal(got.frames.images, IMAGES)
            continue
        colours = deep if encoding.endswith("16") else rgb
        grey = colours @ [0.299, 0.587, 0.114]
        np.testing.assert_allclose(np.asarray(got.frames.images), grey, rtol=0, atol=1)
        assert ("rgb" in got.extra) == (not encoding.endswith("16"))


def test_encodings_that_are_not_read_can_be_left_out(tmp_path, capsys):
    path = bag(tmp_path / "a.bag", {"/cam/image_raw": images(IMAGES, "nv21")})
    refuses("image_raw are encoded as 'nv21'.*frames='none'", jaxevent.load, path)
    assert_events(jaxevent.load(path, frames="none"))
    fails(capsys, ["info", path], "nv21", "--frames none")
    assert cli.main(["info", str(path), "--frames", "none"]) == 0
    topics = {"/cam/image_raw": images(IMAGES, "nv21"), "/cam/image_rect": images(255 - IMAGES)}
    got = jaxevent.load(bag(tmp_path / "b.bag", topics))
    np.testing.assert_array_equal(got.frames.images, 255 - IMAGES)


def test_images_of_another_size_are_another_camera(tmp_path, capsys):
    large = np.kron(IMAGES, np.ones((1, 2, 2), np.uint8))
    path = bag(tmp_path / "a.bag", {"/rgb/image_raw": images(large)})
    got = jaxevent.load(path)
    assert_events(got)
    assert got.frames is None
    assert "24x20 pixels, not the sensor's 12x10" in got.describe_left_out("frames")
    assert cli.main(["info", str(path)]) == 0
    assert "register --images /rgb/image_raw" in capsys.readouterr().out
    topics = {"/cam/image_raw": images(large), "/cam/image_small": images(IMAGES)}
    got = jaxevent.load(bag(tmp_path / "b.bag", topics))
    np.testing.assert_array_equal(got.frames.images, IMAGES)

    other = read_frames(path, frames="/rgb/image_raw")
    assert (other.width, other.height) == (24, 20) and not len(other.events)
    np.testing.assert_array_equal(np.asarray(other.frames.images), large)
    grid = np.eye(3) * [2, 2, 1]
    np.savetxt(tmp_path / "H.csv", grid, delimiter=",")
    words = ["register", path, "--frames", path, "--images", "/rgb/image_raw", "--offset", "0"]
    words += ["--homography", tmp_path / "H.csv", "--out", tmp_path / "both.h5"]
    assert cli.main([str(word) for word in words]) == 0
    both = jaxevent.load(tmp_path / "both.h5")
    assert both.frames.images.shape == IMAGES.shape and both.frames.t.tolist() == T


def test_lenses_of_camera_info(tmp_path):
    found = {}
    for model, d in (
        ("plumb_bob", [0.1, 0.2, 0.3, 0.4, 0.5]),
        ("equidistant", [0.1, 0.2, 0.3, 0.4]),
        ("rational_polynomial", [0.1] * 8),
        ("rational_polynomial", [0.1] * 8 + [0.0] * 6),
        ("fov", [0.9]),
        ("plumb_bob", [0.1] * 14),
    ):
        name = f"{model}{len(d)}"
        held = {"/cam/camera_info": calibration(model, d)}
        found[name] = jaxevent.load(bag(tmp_path / f"{name}.bag", held))
    assert found["plumb_bob5"].camera.distortion == (0.1, 0.2, 0.3, 0.4, 0.5)
    assert found["equidistant4"].camera.model == "equidistant"
    assert found["equidistant4"].camera.distortion == (0.1, 0.2, 0.3, 0.4)
    for name in ("rational_polynomial8", "rational_polynomial14"):
        assert found[name].camera.model == "rational"
        assert found[name].camera.distortion == (0.1,) * 8
    refuses("holds no calibration.*lens model 'fov'", undistort, found["fov1"])
    assert "14 coefficients" in found["plumb_bob14"].left_out["camera"]


def test_formats_of_one_kind_of_frames(tmp_path):
    frames = Frames(np.array(T), IMAGES, np.zeros(2, np.int64))
    extra = {"gain": np.ones(2), "kept": np.arange(3)}
    own = Events(EVENTS.t, EVENTS.x, EVENTS.y, EVENTS.p)
    path = tmp_path / "a.h5"
    jaxevent.save(Recording("a", *SIZE, own, frames, extra=extra), path)
    got = jaxevent.load(path, frames="none")
    assert got.frames is None and list(got.extra) == ["kept"]
    assert "leaves them out" in got.describe_left_out("frames")
    refuses("one kind of frames, and none named 'left'", jaxevent.load, path, frames="left")
