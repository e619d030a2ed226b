"""Bags that rosbags wrote, most of ROS 2: events of each type, frames, and what is refused."""

import sqlite3
import struct
import sys
import zlib
from pathlib import Path
from typing import Any

import formats
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import refuses

from jaxevent import io
from jaxevent.errors import MissingExtra
from jaxevent.io import bags, decoded, ros
from jaxevent.recording import Events

pytest.importorskip("rosbags")

load: Any = io.load
SIZE = (40, 30)
START = 1_468_939_993_078_616
EVENTS = formats.events_of(0, 130, SIZE, start=START)
ENCODINGS = ("dvs_msgs", "prophesee_event_msgs", "mono", "evt3")


def needs(encoding):
    if encoding == "evt3":
        pytest.importorskip("evt3")


def assert_events(got, want):
    for name in ("t", "x", "y", "p"):
        a, b = getattr(got[:], name), getattr(want, name)
        assert a.dtype == b.dtype, name
        np.testing.assert_array_equal(a, b)


@pytest.fixture
def small_blocks(monkeypatch):
    monkeypatch.setattr(decoded, "BLOCK_EVENTS", 16)


def stored(folder, storage):
    """The folder itself, or the file of it under a name that tells nothing."""
    if storage == "folder":
        return folder
    (path,) = folder.glob(f"*.{storage}")
    return path.rename(folder.parent / "a.bin")


@pytest.mark.parametrize("storage", ["folder", "mcap", "db3"])
@pytest.mark.parametrize("encoding", ENCODINGS)
def test_events_are_read_as_written(encoding, storage, tmp_path, small_blocks):
    needs(encoding)
    plugin = "sqlite3" if storage == "db3" else "mcap"
    formats.bag2(tmp_path / "bag", EVENTS, SIZE, encoding, plugin, message=9)
    path = stored(tmp_path / "bag", storage)
    for in_memory in (True, False):
        got = load(path, None, in_memory)
        assert (got.width, got.height) == SIZE and not got.extra
        assert_events(got.events, EVENTS)
        for row in (40, 3, 128, 70):
            assert_events(got.events[row : row + 20], EVENTS[row : row + 20])
            assert got.events.index(int(EVENTS.t[row])) == EVENTS.index(int(EVENTS.t[row]))


@pytest.mark.parametrize("little_endian", [True, False])
@settings(max_examples=10)
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(1, 40), message=st.integers(1, 7))
def test_bytes_of_arrays_are_what_rosbags_serialises(little_endian, seed, count, message):
    """Any number of events in a message, in either order of bytes, with any length of names."""
    store = formats.ros2_types()
    events = formats.events_of(seed, count, SIZE)
    kind = "dvs_msgs/msg/EventArray"
    time, one = store.types["builtin_interfaces/msg/Time"], store.types["dvs_msgs/msg/Event"]
    held = [one(x, y, time(t // 10**6, t % 10**6 * 1000), p) for t, x, y, p in formats.rows(events)]
    header = store.types["std_msgs/msg/Header"](time(1, 2), "c" * message)
    array = store.types[kind](header, SIZE[1], SIZE[0], held)
    data = bytes(store.serialize_cdr(array, kind, little_endian=little_endian))

    bag = object.__new__(bags.Bag)
    bag.path = Path("a")
    fields = {name: fields for name, (_, fields) in store.fielddefs.items()}
    layout = bags.MessageLayout(fields, kind, False)
    names = ros._find_event_fields(layout)
    for filled in (data, data + bytes(3)):
        read = layout.read(filled)
        assert (read["width"], read["height"]) == SIZE
        assert read["header"]["frame_id"] == "c" * message
        t, x, y, p = ros._columns(bag, "/events", names, read["events"])
        got = Events(t, x.astype("u2"), y.astype("u2"), p.astype(bool))
        assert_events(got, events)
    with pytest.raises(ValueError, match="bytes for .* elements, not"):
        layout.read(data[:-1])


def test_packets_in_a_bag_of_ros_1(tmp_path, small_blocks):
    from rosbags.rosbag1 import Writer

    store = bags._type_store(True)
    kind, types = "event_camera_msgs/msg/EventPacket", store.types
    with Writer(tmp_path / "a.bag") as writer:
        link = writer.add_connection("/events", kind, typestore=store)
        for number, (at, words) in enumerate(formats.packed(EVENTS, "mono", SIZE, 9)):
            t = int(EVENTS.t[at])
            stamp = types["builtin_interfaces/msg/Time"](t // 10**6, t % 10**6 * 1000)
            header = types["std_msgs/msg/Header"](number, stamp, "cam")
            content = words.view(np.uint8)
            one = types[kind](header, 30, 40, number, t * 1000, "mono", False, content)
            writer.write(link, t * 1000, store.serialize_ros1(one, kind))
    for in_memory in (True, False):
        assert_events(load(tmp_path / "a.bag", None, in_memory).events, EVENTS)


def test_frames_and_calibration(tmp_path):
    images = np.random.default_rng(0).integers(0, 256, (3, 30, 40)).astype(np.uint8)
    times = [int(t) for t in EVENTS.t[[10, 60, 100]]]
    formats.bag2(tmp_path / "bag", EVENTS, SIZE, "mono", "sqlite3", images, times)
    for in_memory in (True, False):
        got = load(tmp_path / "bag", None, in_memory)
        assert got.frames.t.tolist() == times
        for rows in (slice(1, None), slice(0, 2)):
            np.testing.assert_array_equal(np.asarray(got.frames.images[rows]), images[rows])
        assert (got.camera.fx, got.camera.fy, got.camera.cx, got.camera.cy) == (5, 6, 2, 3)
        assert got.camera.distortion == (0, 0.1, 0.2, 0.3, 0.4)


def test_triggers_of_evt3_packets(tmp_path):
    pytest.importorskip("evt3")
    before = formats.packed

    def with_trigger(*args):
        (first, words), *others = before(*args)
        return [(first, np.r_[words, [0xA000 | 3 << 8 | 1]].astype("<u2")), *others]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(formats, "packed", with_trigger)
        formats.bag2(tmp_path / "bag", EVENTS, SIZE, "evt3", message=5)
    got = load(tmp_path / "bag")
    assert_events(got.events, EVENTS)
    assert got.triggers.edge.tolist() == [1] and got.triggers.channel.tolist() == [3]
    assert got.triggers.t[0] in EVENTS.t[:10]


def test_several_cameras_need_a_stream(tmp_path):
    formats.bag2(tmp_path / "bag", EVENTS, SIZE, "mono", topics=("/left/events", "/right/events"))
    refuses("2 cameras, /left/events, /right/events; .*--strea", load, tmp_path / "bag")
    got = load(tmp_path / "bag", stream="/right/events")
    assert_events(got.events, EVENTS)
    assert got.extra["topics_left_out"].tolist() == ["/left/events"]
    refuses("has no topic of events '/a'; .* are /left/events", load, tmp_path / "bag", stream="/a")


def test_other_encodings_and_topics_are_refused(tmp_path):
    formats.bag2(tmp_path / "a", EVENTS, SIZE, "libcaer_cmp")
    refuses("/dvs/events are encoded as 'libcaer_cmp'; only mono", load, tmp_path / "a")
    formats.bag2(tmp_path / "b", EVENTS, SIZE, topics=())
    refuses("holds no topic of events; record them as dvs_msgs", load, tmp_path / "b")


def test_a_missing_extra_is_named(tmp_path, monkeypatch):
    formats.bag2(tmp_path / "a", EVENTS, SIZE, "evt3")
    monkeypatch.setitem(sys.modules, "evt3", None)
    with pytest.raises(MissingExtra, match="needs the package 'evt3'.*prophesee"):
        load(tmp_path / "a")
    monkeypatch.setitem(sys.modules, "rosbags", None)
    with pytest.raises(MissingExtra, match="needs the package 'rosbags'.*ros"):
        load(tmp_path / "a")


@pytest.mark.parametrize("mode", ["FILE", "MESSAGE"])
def test_compression_of_rosbag2_itself_is_refused(mode, tmp_path):
    formats.bag2(tmp_path / "a", EVENTS, SIZE, "mono", "sqlite3", compression=mode)
    refuses(f"rosbag2 compressed its {mode.lower()}s; write the bag", load, tmp_path / "a")


def test_chunks_of_mcap_are_bounded(tmp_path):
    formats.bag2(tmp_path / "a", EVENTS, SIZE, "mono", compression="STORAGE")
    assert_events(load(tmp_path / "a").events, EVENTS)
    (path,) = (tmp_path / "a").glob("*.mcap")
    content = path.read_bytes()
    assert b"zstd" in content
    # What one chunk's index claims: the size follows the compression's name and its own size.
    at = content.rindex(b"zstd") + 4 + 8
    path.write_bytes(content[:at] + struct.pack("<Q", 1 << 40) + content[at + 8 :])
    refuses("claim to hold 1,099,511,627,776, over 100 times", load, path)
    # A chunk that holds more than its index claims is not unfolded beyond that.
    (size,) = struct.unpack_from("<Q", content, at)
    path.write_bytes(content[:at] + struct.pack("<Q", size - 8) + content[at + 8 :])
    refuses(f"expected {size - 8} bytes, got {size - 7}", load, path)


def test_mcap_is_read_without_its_index(tmp_path):
    formats.bag2(tmp_path / "a", EVENTS, SIZE, "mono", compression="STORAGE")
    (path,) = (tmp_path / "a").glob("*.mcap")
    content = path.read_bytes()
    (summary,) = struct.unpack_from("<Q", content, len(content) - 28)
    footer = b"\x02" + struct.pack("<QQQI", 20, 0, 0, 0)
    path.write_bytes(content[:summary] + footer + content[-8:])
    for in_memory in (True, False):
        assert_events(load(path, None, in_memory).events, EVENTS)
    # What a chunk claims for itself counts, too: after its length, two times.
    at = content.index(b"\x06", 8 + 9 + struct.unpack_from("<Q", content, 9)[0])
    lie = content[: at + 25] + struct.pack("<Q", 1 << 40) + content[at + 33 :]
    path.write_bytes(lie[:summary] + footer + lie[-8:])
    refuses("claim to hold 1,099,511,627,776, over 100 times", load, path)


def test_databases_of_more_than_tables_are_refused(tmp_path):
    formats.bag2(tmp_path / "a", EVENTS, SIZE, "mono", "sqlite3")
    (path,) = (tmp_path / "a").glob("*.db3")
    endless = "WITH RECURSIVE n(id) AS (SELECT 1 UNION ALL SELECT id + 1 FROM n)"
    view = f"CREATE VIEW messages AS {endless} SELECT id, 1 AS topic_id, id AS timestamp FROM n"
    column = "CREATE TABLE more (id INTEGER, data BLOB AS (zeroblob(1000000000)))"
    for statements in (["DROP TABLE messages", view], [column]):
        original = path.read_bytes()
        with sqlite3.connect(path) as database:
            for statement in statements:
                database.execute(statement)
        database.close()
        for place in (path, tmp_path / "a"):
            refuses("holds more than plain tables", load, place)
        path.write_bytes(original)
    path.write_bytes(zlib.compress(path.read_bytes()).rjust(20, b" "))
    refuses("file is not a database", load, tmp_path / "a")


def test_folders_name_their_own_files_only(tmp_path):
    formats.bag2(tmp_path / "a", EVENTS, SIZE, "mono")
    (path,) = (tmp_path / "a").glob("*.mcap")
    path.rename(tmp_path / "a.mcap")
    refuses("names '.*', which is no file of this folder", load, tmp_path / "a")
    (tmp_path / "a" / "metadata.yaml").write_text("a: [")
    refuses("cannot be read", load, tmp_path / "a")
