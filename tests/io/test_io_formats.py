"""Formats of cameras, programs and data sets, against writers and decoders of others."""

import importlib.util
import itertools
import os
import re
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import formats
import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import refuses

from jaxevent import io
from jaxevent.errors import InputError, install_command
from jaxevent.io import decoded, save, tables
from jaxevent.recording import Events, Frames, Imu, Recording, Triggers
from jaxevent.show import describe

pytestmark = pytest.mark.slow

load: Any = io.load
SIZE = (40, 30)

# Packages that are extras; CI has them.
NEEDS = {"evt3": "evt3", "aedat4": "aedat", "bag": "rosbags"}
WRITERS: dict[str, Any] = {
    "evt2": formats.evt2,
    "evt21": formats.evt21,
    "evt21-legacy": lambda events, size: formats.evt21(events, size, legacy=True),
    "evt3": formats.evt3,
    "evt3-single": lambda events, size: formats.evt3(events, size, vectors=False),
    "dat": formats.dat,
    "dat-0": lambda events, size: formats.dat(events, size, kind=0),
    "dat-version-1": lambda events, size: formats.dat(events, size, kind=0, version=1),
    "es-dvs": formats.es,
    "es-atis": lambda events, size: formats.es(events, size, np.arange(len(events)) % 3 == 0),
    "aedat2": lambda events, size: formats.aedat2(events, size),
    "aedat4": formats.aedat4,
    "bag": None,
    "rvt": formats.rvt,
    "event_utils": formats.event_utils,
    "metavision": formats.metavision,
    "npy": formats.npy,
    "csv": formats.csv,
    "csv-seconds": lambda events, size: formats.csv(events, size, seconds=True),
    "text": lambda events, size: formats.csv(events, size, None, " ", seconds=True),
}


def write(path, name, events, size=SIZE):
    pytest.importorskip(NEEDS.get(name.partition("-")[0], "numpy"))
    if name == "bag":
        path.unlink(missing_ok=True)
        formats.bag(path, events, size, message=max(7, len(events) // 40))
    else:
        path.write_bytes(WRITERS[name](events, size))
    return path


def assert_events(got, want):
    got = got[:]
    for name in ("t", "x", "y", "p"):
        a, b = getattr(got, name), getattr(want, name)
        assert a.dtype == b.dtype, name
        np.testing.assert_array_equal(a, b, err_msg=name)


@pytest.fixture
def blocks_of(monkeypatch):
    """Blocks of so many events, so that short files consist of several."""

    def set_to(count):
        monkeypatch.setattr(decoded, "BLOCK_EVENTS", count)
        monkeypatch.setattr(tables, "_TEXT_BLOCK_BYTES", 20 * count)

    return set_to


@pytest.fixture
def small_blocks(blocks_of):
    blocks_of(16)


# Every format


@pytest.mark.parametrize("name", WRITERS)
@pytest.mark.usefixtures("small_blocks")
@settings(max_examples=8)
@given(
    seed=st.integers(0, 2**32 - 1),
    count=st.integers(1, 120),
    span=st.sampled_from([50, 5_000, 300_000]),
    data=st.data(),
)
def test_events_are_read_as_written(name, seed, count, span, data):
    """In memory and, by pieces and times drawn at random, from the file."""
    # Event Stream starts at 0, and its single bytes of time would fill the file before.
    events = formats.events_of(seed, count, SIZE, span, 0 if name.startswith("es") else 5_000)
    with tempfile.TemporaryDirectory() as folder:
        path = write(Path(folder) / "a.bin", name, events)
        got = load(path, SIZE)
        assert (got.name, got.width, got.height) == ("a", *SIZE)
        assert_events(got.events, events)
        stored = load(path, SIZE, in_memory=False).events
        assert len(stored) == count
        for _ in range(4):
            i, j = (data.draw(st.integers(-count - 2, count + 2)) for _ in range(2))
            assert_events(stored[i:j], events[i:j])
            time = int(data.draw(st.sampled_from(events.t.tolist()))) + data.draw(
                st.integers(-8, 8)
            )
            assert stored.index(time) == events.index(time)
        del stored


TELLS_SIZE = {"rvt", "event_utils", "metavision"} | {
    name for name in WRITERS if name.startswith(("evt", "dat", "es", "aedat4", "bag"))
}


@pytest.mark.parametrize("name", WRITERS)
def test_sensor_size_is_told_or_asked_for(name, tmp_path):
    path = write(tmp_path / "a.bin", name, formats.events_of(0, 50, SIZE))
    if name in TELLS_SIZE:
        assert (load(path).width, load(path).height) == SIZE
    elif name == "aedat2":
        assert (load(path).width, load(path).height) == (240, 180)  # by the chip's name
    else:
        refuses(r"size=\(width, height\)", load, path)
    # A smaller sensor than the events need is refused, at the event.
    refuses("event [0-9]+ has [xy] = ", load, path, (20, 15))


def test_events_left_on_disk_need_no_memory(tmp_path):
    """The memory of a pass does not grow with the file, but for the index of its blocks.

    In a process of its own, as the checks of argument types that tests add hold memory too.
    """
    code = """
import sys, tracemalloc
from jaxevent.io import columns, decoded, load, tables
decoded.BLOCK_EVENTS = columns.SAMPLE_EVENTS = tables.SAMPLE_EVENTS = 500
tables._TEXT_BLOCK_BYTES, tables._TEXT_SAMPLE_BYTES = 10_000, 8_000
for path in sys.argv[1:]:
    for _ in range(2):
        tracemalloc.start()
        stored = load(path, (40, 30), in_memory=False).events
        for row in range(0, len(stored), 500):
            stored[row : row + 500]
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    print(peak)
"""
    names = ["evt2", "evt3", "dat", "es-atis", "aedat2", "aedat4", "npy", "csv"]
    sizes = [(name, count) for name in names for count in (3_000, 9_000)]
    paths = [
        write(tmp_path / f"{name}{n}", name, formats.events_of(0, n, SIZE, 20 * n))
        for name, n in sizes
    ]
    done = subprocess.run(
        [sys.executable, "-c", code, *paths], capture_output=True, text=True, check=True
    )
    peaks = dict(zip(sizes, map(int, done.stdout.split()), strict=True))
    for name in names:
        growth = (peaks[name, 9_000] - peaks[name, 3_000]) / 6_000
        assert growth < 4, (name, growth)  # bytes an event, of 13


@pytest.mark.parametrize(
    "name", ["evt2", "evt3", "dat", "es-atis", "aedat2", "aedat4", "bag", "csv"]
)
def test_pieces_in_any_order(name, tmp_path, small_blocks):
    path = write(tmp_path / "a.bin", name, events := formats.events_of(3, 300, SIZE))
    stored = load(path, SIZE, in_memory=False).events
    for row in np.random.default_rng(0).permutation(300)[:60].tolist():
        assert_events(stored[row : row + 3], events[row : row + 3])


@pytest.mark.parametrize("name", ["evt2", "evt3", "dat", "es-atis", "aedat4", "csv"])
def test_converting_gives_the_same_recording(name, tmp_path, small_blocks):
    path = write(tmp_path / "a.bin", name, events := formats.events_of(3, 500, SIZE))
    save(load(path, SIZE, in_memory=False), tmp_path / "a.h5")
    assert_events(load(tmp_path / "a.h5").events, events)


@pytest.mark.parametrize("name", WRITERS)
def test_content_decides_not_the_name(name, tmp_path):
    events = formats.events_of(1, 60, SIZE)
    for suffix in (".raw", ".h5", ".txt"):
        path = write(tmp_path / f"a{suffix}", name, events)
        assert_events(load(path, SIZE).events, events)


# Clocks


@pytest.mark.parametrize(
    ("name", "period"), [("evt2", 2**34), ("evt21", 2**34), ("dat", 2**32), ("aedat2", 2**32)]
)
@pytest.mark.usefixtures("small_blocks")
def test_clocks_continue_over_their_end(name, period, tmp_path):
    events = formats.events_of(2, 300, SIZE, 100_000)
    shifted = Events(events.t + period - 50_000, *(getattr(events, k) for k in "xyp"))
    assert shifted.t[0] < period < shifted.t[-1]
    path = write(tmp_path / "a.bin", name, shifted)
    for in_memory in (True, False):
        assert_events(load(path, SIZE, in_memory).events, shifted)


def test_a_clock_that_steps_back_over_its_end_is_not_continued_twice(tmp_path):
    words = []
    for high in (2**28 - 1, 0, 2**28 - 1, 0):
        words += [8 << 28 | high, 1 << 28 | 3 << 11 | 4]
    content = b"% evt 2.0\n% geometry 40x30\n% end\n" + np.array(words, "<u4").tobytes()
    (tmp_path / "a.raw").write_bytes(content)
    refuses(f"event 2 is at {2**34 - 64} us, earlier", load, tmp_path / "a.raw")


@pytest.mark.usefixtures("small_blocks")
@settings(max_examples=8)
@given(seed=st.integers(0, 2**32 - 1), periods=st.integers(1, 4))
def test_the_clock_of_evt3_continues_over_its_end(seed, periods):
    """Every 16.8 s. Between two events at most half of that may pass unseen."""
    pytest.importorskip("evt3")
    events = formats.events_of(seed, 40 * periods, SIZE, periods << 24, 1 << 23)
    with tempfile.TemporaryDirectory() as folder:
        path = write(Path(folder) / "a.raw", "evt3", events)
        assert_events(load(path).events, events)
        stored = load(path, in_memory=False).events
        for row in np.random.default_rng(seed).integers(0, len(events), 5).tolist():
            assert_events(stored[row : row + 9], events[row : row + 9])


@pytest.mark.usefixtures("small_blocks")
@given(words=st.lists(st.integers(0, 2**16 - 1), min_size=1, max_size=120), data=st.data())
def test_evt3_is_its_state_machine(words, data):
    """Any words at all, times apart, against a decoder that takes one word after another."""
    pytest.importorskip("evt3")
    defined = [0, 2, 3, 4, 5, 6, 7, 8, 10, 14, 15]
    words = [defined[word % 11] << 12 | word >> 4 for word in words]
    high = low = 0
    for i, word in enumerate(words):  # the clock runs forward
        if word >> 12 == 8:
            high, low = (high + data.draw(st.integers(1, 3))) & 0xFFF, 0
            words[i] = 8 << 12 | high
        elif word >> 12 == 6:
            low = max(low, word & 0xFFF)
            words[i] = 6 << 12 | low
    want = formats.evt3_decoded(words)
    lost = sum(event is None for event in want)
    want = [event for event in want if event is not None]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.raw"
        path.write_bytes(b"% evt 3.0\n% end\n" + np.array(words, "<u2").tobytes())
        if not want:
            refuses("holds no event", load, path, (4096, 4096))
            return
        got = load(path, (4096, 4096))
        assert list(formats.rows(got.events)) == want
        assert int(got.extra.get("events_without_time", 0)) == lost


@pytest.mark.usefixtures("small_blocks")
def test_evt3_keeps_what_comes_before_its_first_time(tmp_path):
    """Row and base, blocks before the first time, which the decoder waits for."""
    pytest.importorskip("evt3")
    words = [0x0007, 0x3805] + [0xE000] * 40 + [0x8002, 0x6009, 0x4003, 0x2004]
    (tmp_path / "a.raw").write_bytes(b"% evt 3.0\n% end\n" + np.array(words, "<u2").tobytes())
    got = list(formats.rows(load(tmp_path / "a.raw", SIZE).events))
    t = 2 << 12 | 9
    assert got == formats.evt3_decoded(words) == [(t, 5, 7, 1), (t, 6, 7, 1), (t, 4, 7, 0)]


# Prophesee


@pytest.mark.parametrize("in_memory", [True, False])
def test_reserved_words_are_skipped_and_counted_unless_many_differ(tmp_path, in_memory):
    pytest.importorskip("evt3")
    events = formats.events_of(0, 40, SIZE)
    path = tmp_path / "a.raw"
    for name, width in (("evt2", 4), ("evt21", 8), ("evt3", 2)):
        content = WRITERS[name](events, SIZE)
        start = content.index(b"% end\n") + 6
        words = [content[at : at + width] for at in range(start, len(content), width)]
        padding = [bytes([0x99] * width)] * 3
        padded = [words[0], *padding, *(w for word in words[1:] for w in (word, *padding[:1]))]
        path.write_bytes(content[:start] + b"".join(padded))
        got = load(path, in_memory=in_memory)
        assert list(formats.rows(got.events[:])) == list(formats.rows(events))
        assert got.extra == {"reserved_words": 3 + len(words) - 1}
        differ = b"".join(bytes([n] * (width - 1)) + b"\xb0" for n in range(17))
        path.write_bytes(content[: start + 8 * width] + differ + content[start + 8 * width :])
        message = f"the word at byte {start + 8 * width} has the type 0xb"
        refuses(message, load, path)
        path.write_bytes(content[:-1])
        refuses(rf"drop these bytes: truncate -s -{width - 1} FILE", load, tmp_path / "a.raw")


def test_events_before_the_first_time_are_counted(tmp_path):
    content = formats.evt2(formats.events_of(0, 40, SIZE), SIZE)
    start = content.index(b"% end\n") + 6
    early = np.array([1 << 28 | 3 << 11 | 4, 10 << 28, 5 << 11], "<u4").tobytes()
    path = tmp_path / "a.raw"
    path.write_bytes(content[:start] + early + content[start:])
    got = load(path)
    assert len(got.events) == 40
    assert {key: int(value) for key, value in got.extra.items()} == {
        "events_without_time": 2,
        "triggers_without_time": 1,
    }


def test_headers_of_prophesee(tmp_path):
    events = formats.events_of(0, 40, SIZE)
    words = formats.evt2(events, SIZE, "% evt 2.0\n% end\n").partition(b"% end\n")[2]
    path = tmp_path / "a.raw"
    for header, size in (
        ("% evt 2.0\n% plugin_name hal_plugin_gen3_fx3\n", (640, 480)),
        ("% evt 2.0\n% plugin_name hal_plugin_imx636_evk4\n% end\n", (1280, 720)),
        ("% format EVT2;height=31;width=41\n% end\n", (41, 31)),
        ("% Date 2020-09-14\r\n% geometry 44x33\r\n% evt 2.0\r\n", (44, 33)),
    ):
        path.write_bytes(header.encode() + words)
        got = load(path)
        assert (got.width, got.height) == size and len(got.events) == 40
    for header, message in (
        ("% evt 4.0\n% end\n", "its format '4.0' is not EVT2"),
        ("% format AER;width=9\n", "its format 'AER' is not EVT2"),
        ("% something else\n", "its format '.' is not EVT2"),
        ("% evt 2.0\n", "does not state the sensor's size"),
        ("% format EVT21\n% geometry 9x9\n", "order of the halves .* is not known"),
    ):
        path.write_bytes(header.encode() + words)
        refuses(message, load, path)
    path.write_bytes(formats.dat(events, SIZE, kind=1))
    refuses("holds DAT events of type 01 and 8 bytes", load, path)


def test_data_that_begin_like_a_header(tmp_path):
    """Without '% end' the first word may begin with the byte of '%', here y = 37."""
    events = Events(np.r_[0], np.r_[3].astype("u2"), np.r_[37].astype("u2"), np.r_[False])
    words = np.array([0 << 28 | 3 << 11 | 37], "<u4").tobytes()
    time = np.array([8 << 28], "<u4").tobytes()
    path = tmp_path / "a.raw"
    path.write_bytes(b"% evt 2.0\n% geometry 40x40\n" + words + time + words)
    got = load(path)
    assert int(got.extra["events_without_time"]) == 1
    assert_events(got.events, events)


# AEDAT


def test_frames_of_aedat_2(tmp_path, small_blocks):
    """Reset less signal, turned the right way up, at the middle of the exposure."""
    random = np.random.default_rng(0)
    images = random.integers(0, 1000, (3, 30, 40))
    times = [20_000, 45_000, 70_000]
    events = formats.events_of(0, 300, SIZE)
    imu = [(500 * i, random.integers(-(2**15), 2**15, 7).tolist()) for i in range(9)]
    path = tmp_path / "a.aedat"
    for shutter, exposure in (("true", 300), ("false", 300 + 1200 - 1)):
        keys = dict(ImuGyroScale="Gyro500", ImuAccelScale="ImuAccelScaleG4")
        keys["DAVIS240C__globalShutter"] = shutter
        path.write_bytes(formats.aedat2(events, SIZE, images, times, 300, imu, **keys))
        for in_memory in (True, False):
            got = load(path, SIZE, in_memory)
            assert_events(got.events, events)
            assert np.abs(got.frames.t - times).max() <= 1
            assert (got.frames.exposure == exposure).all()
            held = np.asarray(got.frames.images)
            np.testing.assert_array_equal(held >> 6, images)
            assert got.frames.intensity.max() <= 1
            values = np.array([values for _, values in imu], np.float64)
            assert got.imu.t.tolist() == [t for t, _ in imu]
            np.testing.assert_allclose(got.imu.acc, values[:, :3] / 8192 * 9.80665)
            np.testing.assert_allclose(got.imu.gyro, np.deg2rad(values[:, 4:] / 65.6))
            assert not got.extra
    # Frames with missing samples, at both ends, are left out and counted.
    content = path.read_bytes()
    start = content.index(b"Header\r\n") + 8
    words = np.frombuffer(content, ">u4", offset=start).reshape(-1, 2)
    samples = np.flatnonzero(words[:, 0] >> 31 & (words[:, 0] >> 10 & 3 == 0))
    signals = np.flatnonzero(words[:, 0] >> 31 & (words[:, 0] >> 10 & 3 == 1))
    cut = words[samples[100] : signals[-100]]
    path.write_bytes(content[:start] + cut.tobytes())
    got = load(path, SIZE)
    assert len(got.frames) == 1 and got.extra["incomplete_frames"] == 2
    np.testing.assert_array_equal(got.frames.images[0] >> 6, images[1])


def test_other_versions_and_chips_of_aedat(tmp_path):
    path = tmp_path / "a.aedat"
    path.write_bytes(b"#!AER-DAT3.1\r\n" + bytes(200))
    refuses("is AEDAT 3.1; only AEDAT 2 and 4", load, path)
    path.write_bytes(b"#!AER-DAT2.0\r\n# AEChip: ch.unizh.DVS128StereoBoard\r\n" + bytes(80))
    refuses("by the chip DVS128StereoBoard, but only DAVIS", load, path)
    path.write_bytes(b"#!AER-DAT2.0\r\n# AEChip: x.DAVIS240C\r\n" + bytes(81))
    refuses("ends inside a record, 1 bytes after", load, path)


def test_aedat_4_in_its_parts(tmp_path, small_blocks):
    pytest.importorskip("aedat")
    events = formats.events_of(0, 300, SIZE)
    images = np.random.default_rng(0).integers(0, 256, (3, 30, 40)).astype(np.uint8)
    path = tmp_path / "a.aedat4"
    content = formats.aedat4(events, SIZE, images, (10_000, 20_000, 30_000))
    path.write_bytes(content)
    for in_memory in (True, False):
        got = load(path, None, in_memory)
        assert_events(got.events, events)
        assert got.frames.t.tolist() == [10_000, 20_000, 30_000]
        assert got.frames.exposure.tolist() == [200] * 3
        np.testing.assert_array_equal(np.asarray(got.frames.images[::-1]), images[::-1])
    for part in (0.001, 0.02, 0.5, 0.999):
        path.write_bytes(content[: int(part * len(content))])
        refuses("cut off|damaged|cannot be read|is AEDAT", load, path)


def test_damage_that_the_decoder_does_not_survive(tmp_path):
    """A name in the header that is not UTF-8 aborts the package aedat, and with it Python."""
    pytest.importorskip("aedat")
    content = formats.aedat4(formats.events_of(0, 9, SIZE), SIZE)
    (tmp_path / "a.aedat4").write_bytes(content.replace(b"sizeX", b"size\xca"))
    refuses("its header is not valid", load, tmp_path / "a.aedat4")


def test_aedat_4_of_several_cameras(tmp_path):
    pytest.importorskip("aedat")
    events = formats.events_of(0, 100, SIZE)
    path = tmp_path / "a.aedat4"
    path.write_bytes(formats.aedat4(events, SIZE, streams=2))
    refuses(r"2 cameras, 0 \(40x30\), 1 .*--stream", load, path)
    refuses("has no stream of events '7'; its .* are 0, 1", load, path, stream="7")
    got = load(path, stream="1")
    assert_events(got.events, events)
    assert got.extra["streams_left_out"].tolist() == ["0 events"]


def test_aedat_4_of_several_streams_of_frames(tmp_path):
    pytest.importorskip("aedat")
    events = formats.events_of(0, 100, SIZE)
    images = np.arange(4, dtype=np.uint8)[:, None, None] * np.ones((30, 40), np.uint8)
    path = tmp_path / "a.aedat4"
    shots = {"images": images, "image_t": [1000, 1010, 3000, 3010], "cameras": 2}
    path.write_bytes(formats.aedat4(events, SIZE, **shots))
    got = load(path)
    assert got.frames is None
    remedy = "choose one with frames=1"
    assert got.left_out == {
        "frames": f"the streams 1, 2 hold some, of which none is chosen; {remedy}"
    }
    got = load(path, frames="2")
    np.testing.assert_array_equal(got.frames.t, [1010, 3010])
    np.testing.assert_array_equal(got.frames.images, images[1::2])
    assert got.left_out == {}
    alone = load(path, stream="none", frames="2")
    assert not len(alone.events) and alone.frames.t.tolist() == [1010, 3010]
    refuses("has no stream of frames '0'; its .* of frames are 1, 2", load, path, frames="0")
    path.write_bytes(formats.aedat4(events, SIZE, streams=0, **shots))
    refuses("holds no events, and frames in the streams 0, 1; choose", load, path)


# ROS


def test_bags_in_their_parts(tmp_path, small_blocks):
    pytest.importorskip("rosbags")
    events = formats.events_of(0, 300, SIZE, start=1_468_939_993_078_616)
    images = np.random.default_rng(0).integers(0, 256, (3, 30, 40)).astype(np.uint8)
    times = [int(t) for t in events.t[[10, 100, 200]]]
    path = tmp_path / "a.bag"
    formats.bag(path, events, SIZE, images, times)
    for in_memory in (True, False):
        got = load(path, None, in_memory)
        assert_events(got.events, events)
        for part in (got.frames, got.imu, got.poses):
            assert part.t.tolist() == times
        np.testing.assert_array_equal(np.asarray(got.frames.images[1:]), images[1:])
        assert not got.frames.exposure.any() and not got.extra
        assert got.imu.gyro.tolist() == [[i, i + 1, i + 2] for i in range(3)]
        assert got.imu.acc.tolist() == [[i, i + 0.5, i + 1] for i in range(3)]
        assert got.poses.position.tolist() == [[i, 2, 3] for i in range(3)]
        assert got.poses.quaternion[0].tolist() == [0.1, 0.2, 0.3, 0.4]
        camera = got.camera
        assert (camera.fx, camera.fy, camera.cx, camera.cy) == (5, 6, 2, 3)
        assert camera.distortion == (0.1, 0.2, 0.3, 0.4, 0.5)
    refuses("has no topic of events 'left'; .* are /dvs/events", load, path, stream="left")


def test_raw_bytes_are_what_rosbags_serialises(tmp_path):
    pytest.importorskip("rosbags")
    events = formats.events_of(5, 120, SIZE)
    for typed in (True, False):
        formats.bag(tmp_path / f"{typed}.bag", events, SIZE, typed=typed)
        assert_events(load(tmp_path / f"{typed}.bag").events, events)


# HDF5


@pytest.mark.parametrize("in_memory", [True, False])
def test_dsec_with_its_map(tmp_path, in_memory):
    events = formats.events_of(0, 500, SIZE)
    offset = 50_000_000_000
    (tmp_path / "events.h5").write_bytes(formats.dsec(events, SIZE, offset))
    with h5py.File(tmp_path / "rectify_map.h5", "w") as file:
        file["rectify_map"] = np.arange(30 * 40 * 2, dtype=np.float32).reshape(30, 40, 2)
    got = load(tmp_path / "events.h5", None, in_memory)
    assert (got.width, got.height) == SIZE
    assert_events(got.events, replace(events, t=events.t + offset))
    assert got.extra["rectify_map"][3, 4].tolist() == [2 * (3 * 40 + 4), 2 * (3 * 40 + 4) + 1]


def test_blosc_needs_its_extra(tmp_path, monkeypatch):
    plugin = pytest.importorskip("hdf5plugin")
    events = formats.events_of(0, 5000, SIZE)
    path = tmp_path / "events.h5"
    path.write_bytes(formats.dsec(events, SIZE, filters=dict(plugin.Blosc(cname="zstd"))))
    assert_events(load(path, SIZE).events, events)
    assert_events(load(path, SIZE, in_memory=False).events, events)
    # A process that has not imported the plugin yet brings it itself; one that cannot says so.
    code = "import sys; from jaxevent import io; print(len(io.load(sys.argv[1], (40, 30)).events))"
    without = "import sys; sys.modules['hdf5plugin'] = None; " + code.partition("; ")[2]
    done = [
        subprocess.run(
            [sys.executable, "-c", text, path], capture_output=True, text=True, env=os.environ
        )
        for text in (code, without)
    ]
    assert done[0].stdout == "5000\n", done[0].stderr
    assert install_command("dsec") in done[1].stderr


def test_filters_that_cannot_be_had(tmp_path):
    """Written by the low-level interface: HDF5 lets unknown filters be declared as optional."""
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        plist = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        plist.set_chunk((10,))
        plist.set_filter(777, h5py.h5z.FLAG_OPTIONAL)
        space = h5py.h5s.create_simple((10,))
        records = np.dtype([("x", "<u2"), ("y", "<u2"), ("p", "<i2"), ("t", "<i8")])
        kind = h5py.h5t.py_create(records)
        group = file.create_group("CD")
        h5py.h5d.create(group.id, b"events", kind, space, plist)
    plugin = importlib.util.find_spec("hdf5plugin")
    message = "filter 777" if plugin else re.escape(install_command("dsec"))
    refuses(message, load, path, SIZE)


def test_event_utils_and_mvsec_have_frames(tmp_path):
    events = formats.events_of(0, 300, SIZE, start=1_500_000_000_000_000)
    images = np.random.default_rng(0).integers(0, 256, (3, 30, 40)).astype(np.uint8)
    times = (events.t[0] + np.array([0, 100, 9_000])).tolist()
    imu = np.arange(12.0).reshape(2, 6)
    path = tmp_path / "a.h5"
    for content in (
        formats.event_utils(events, SIZE, images, times),
        formats.mvsec(events, SIZE, images, times, times[:2], imu),
    ):
        path.write_bytes(content)
        for in_memory in (False, True):
            got = load(path, None, in_memory)
            assert (got.width, got.height) == SIZE
            # Seconds in float64 keep a quarter of a microsecond.
            assert_events(got.events, events)
            assert got.frames.t.tolist() == times and not got.frames.exposure.any()
            np.testing.assert_array_equal(np.asarray(got.frames.images), images)
    assert got.imu.acc.tolist() == imu[:, :3].tolist() and got.imu.gyro[1, 0] == 9


def test_two_cameras_in_hdf5(tmp_path):
    events = formats.events_of(0, 300, SIZE)
    path = tmp_path / "a.h5"
    path.write_bytes(formats.m3ed(events, SIZE))
    refuses("2 cameras, left, right; choose .*--stream", load, path)
    refuses("has no camera 'up'; its cameras are left, right", load, path, stream="up")
    for in_memory in (False, True):
        got = load(path, None, in_memory, stream="right")
        assert_events(got.events, events)
        assert (got.width, got.height, got.camera.fx) == (*SIZE, 1000)
        assert got.camera.distortion == (-0.1, 0.1, 0.001, 0.002, 0)
        assert got.events.index(int(events.t[99])) == events.index(int(events.t[99]))
    path.write_bytes(formats.rvt(events, SIZE))
    refuses("one camera only; leave out stream=", load, path, stream="left")


def test_files_that_claim_more_than_they_hold(tmp_path):
    """2^40 events in no bytes at all; without the check the fields would be filled with zeros."""
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for name in "txyp":
            file.create_dataset(f"events/{name}", (2**40,), "i8", chunks=(1 << 16,))
    refuses("events/t claims 1099511627776 values but holds 0 bytes", load, tmp_path / "a.h5", SIZE)


# Tables


@pytest.mark.parametrize(
    ("names", "dtypes"),
    [
        ("x y t p", "<i2 <i2 <i8 ?"),  # tonic
        ("t x y p", "<i8 <i2 <i2 u1"),  # expelliarmus
        ("timestamp x y polarity", "<i8 <i2 <i2 i1"),  # dv-processing
        ("t x y on", "<u8 <u2 <u2 ?"),  # faery, aedat, event_stream
        ("p x y ts", "i1 <f4 <f4 <i8"),
    ],
)
def test_structured_arrays_by_the_names_of_their_fields(tmp_path, names, dtypes):
    events = formats.events_of(0, 200, SIZE)
    content = formats.npy(events, SIZE, names.split(), dtypes.split())
    (tmp_path / "a.npy").write_bytes(content)
    assert_events(load(tmp_path / "a.npy", SIZE).events, events)
    np.savez(tmp_path / "a.npz", arr_0=np.load(tmp_path / "a.npy"), width=40, height=30)
    assert_events(load(tmp_path / "a.npz").events, events)
    columns = {name: np.load(tmp_path / "a.npy")[name] for name in names.split()}
    np.savez(tmp_path / "b.npz", **columns, width=40, height=30)
    assert_events(load(tmp_path / "b.npz").events, events)


def test_arrays_without_names_are_refused(tmp_path):
    np.save(tmp_path / "a.npy", np.zeros((5, 3)))
    refuses("records with the fields t, x, y and p", load, tmp_path / "a.npy", SIZE)
    np.save(tmp_path / "a.npy", np.zeros(5, [("t", "i8"), ("x", "i2"), ("y", "i2")]))
    refuses("holds an array of t, x, y of shape", load, tmp_path / "a.npy", SIZE)
    np.save(tmp_path / "a.npy", np.array([{}]))
    refuses("cannot be read .*pickle|object", load, tmp_path / "a.npy", SIZE)


@pytest.mark.parametrize("minus", [False, True])
@pytest.mark.parametrize("seconds", [False, True])
@pytest.mark.parametrize(
    ("names", "separator"),
    list(itertools.product(["t x y p", "timestamp x y polarity", "p y x ts"], ",; \t")),
)
def test_tables_of_text(tmp_path, names, separator, seconds, minus):
    events = formats.events_of(0, 200, SIZE, start=10**9)
    names = names.replace(" ", separator)
    path = tmp_path / "a.csv"
    path.write_bytes(formats.csv(events, SIZE, names, separator, seconds, minus))
    assert_events(load(path, SIZE).events, events)


@pytest.mark.parametrize(
    "before",
    ["40 30\n", "# a comment\n40 30\n", "%geometry:40,30\n", "# geometry: 40x30\n# t x y p\n"],
)
def test_tables_tell_the_size(tmp_path, before):
    events = formats.events_of(0, 50, SIZE)
    text = before.encode() + formats.csv(events, SIZE, None, " ", seconds=True)
    (tmp_path / "a.txt").write_bytes(text)
    got = load(tmp_path / "a.txt")
    assert (got.width, got.height) == SIZE
    assert_events(got.events, events)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1,2,3,1\n4,5,6,0\n", "without names could be t x y p or x y t p; .*a line 't x y p'"),
        ("9,2,3,5\n4,5,6,0\n", "without names cannot be t x y p or x y p t or"),
        ("1,2,3\n4,5,6\n", "'1,2,3' is neither names of .* nor four numbers; .* line of names"),
        ("t,x,y,p\n", "holds no event"),
        ("t,x,y,p\n1,2,3\n", "does not have the columns t, x, y, p"),
        ("t,x,y,p\n1,2,3,1\n4,5\n", "event 1 has y = nan"),
        ("t,x,y,p\n1,2,3,1\n4,5,oops,0\n", "event 1 has y = oops"),
        ("t,x,y,p\n1,2,3,1\n4,5,6,0,7\n", "cannot be read .*line 2, saw 5"),
        ("t,x,y,p\n1,2,3,1\n4,5,99,0\n", "event 1 has y = 99; on the 40x30 sensor"),
        ("t,x,y,p\n9,2,3,1\n4,5,6,0\n", "event 1 is at 4 us, earlier"),
        ("t,x,y,p\n1,2,3,yes\n", "event 0 has p = yes"),
        ("t,t,x,y,p\n1,1,2,3,1\n", "is neither names of"),
        ("t x y p\n" + "1" * 5000, "line of over 4096 bytes"),
    ],
)
def test_bad_tables_of_text(tmp_path, text, message):
    (tmp_path / "a.csv").write_text(text)
    assert str(tmp_path) in refuses(message, load, tmp_path / "a.csv", SIZE)


def test_true_and_false_are_polarities(tmp_path):
    (tmp_path / "a.csv").write_text("t,x,y,on\n1,2,3,True\n4,5,6,False\n")
    assert load(tmp_path / "a.csv", SIZE).events.p.tolist() == [True, False]


def test_a_file_that_changes_while_it_is_open(tmp_path, small_blocks):
    path = write(tmp_path / "a.raw", "evt2", formats.events_of(0, 400, SIZE))
    stored = load(path, in_memory=False).events
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(InputError, match="no longer holds the events"):
        stored[200:300]


# What info tells


def test_hot_pixels_and_jumps_of_clocks(monkeypatch):
    """A pixel among idle ones is hot, one of a busy edge is not; in blocks as at once."""
    t = np.sort(np.r_[np.arange(100) * 500, 700_000 + np.arange(200) * 1000])
    x = np.r_[np.full(100, 7), np.arange(200) % 3 + 20].astype(np.uint16)
    y = np.r_[np.full(100, 5), np.full(200, 9)].astype(np.uint16)
    events = Events(t, x, y, x == 7)
    frame_t = np.r_[0, 10, 20, 50, 60] * 10_000
    frames = Frames(frame_t, np.zeros((5, 30, 40), np.uint8), np.zeros(5, np.int64))
    late = Imu(2_000_000 + np.arange(3), np.zeros((3, 3)), np.zeros((3, 3)))
    extra = {"omega": np.zeros(3), "triggers": np.array(4)}
    signals = Triggers(
        np.arange(5), np.array([1, 0, 1, -1, 1], "i1"), np.array([7, 7, 2, 7, 7], "u1")
    )
    recording = Recording("r", 40, 30, events, frames, imu=late, extra=extra, triggers=signals)
    told = describe.describe(recording)
    monkeypatch.setattr(describe, "BLOCK_EVENTS", 7)
    assert describe.describe(recording) == told
    lines = dict(told)
    assert lines["hot pixels"].startswith("1, with 33.33 % of the events (jaxevent filter")
    assert lines["gaps"].startswith("longest 650.500 ms, after 0.049500 s; 1 of 100 ms and more")
    part = 0.899 / 10
    rates = [np.sum((t >= i * part * 1e6) & (t < (i + 1) * part * 1e6)) / part for i in range(9)]
    shown = lines["rate over time"].split(" per s")[0].split(", ")
    for text, rate in zip(shown, rates, strict=False):
        value = float(text.removesuffix("k")) * (1000 if text.endswith("k") else 1)
        assert value == pytest.approx(rate, rel=0.01)
    assert lines["ground truth"] == "omega" and lines["extra triggers"] == "4"
    assert lines["triggers"] == (
        "5: 1 on channel 2, 4 on channel 7; 3 rising, 1 falling, 1 of unknown edge"
    )
    clocks = [text for name, text in told if name == "clocks"]
    assert clocks[0] == (
        "frames: 1 intervals over 1.5 medians, the longest 300.000 ms after 0.200000 s"
    )
    assert "IMU: 2.000000 to 2.000002 s, not at the time of the events" in clocks[1]


# Real recordings: counts and sizes as shared/data/README.md states them


@pytest.mark.parametrize(
    ("name", "count", "size", "first", "last"),
    [
        ("davis346.aedat4", 78_830, (346, 260), 1589163147368868, 1589163149728813),
        ("rotating_disk_imu.aedat", 374_296, (240, 180), 341_678, 3_508_437),
        ("spinning_dot_evt2.raw", 539_481, (640, 480), 1_317_888, 1_367_888),
        ("gen4.dat", 1_218_618, (1280, 720), 5_856, 10_773_853),
        ("evt3.raw", 1_218_618, (1280, 720), 11_200_224, 21_968_221),
        ("atis.es", 473_225, (320, 240), 0, 999_000),
    ],
)
def test_real_files(data, name, count, size, first, last):
    needs = {"davis346.aedat4": "aedat", "evt3.raw": "evt3"}
    pytest.importorskip(needs.get(name, "numpy"))
    for in_memory in (True, False):
        got = load(data / name, None, in_memory)
        assert len(got.events) == count and (got.width, got.height) == size
        assert (int(got.events[:1].t[0]), int(got.events[count - 1 :].t[0])) == (first, last)
        assert got.events.index(last) < count == got.events.index(last + 1)


def same_events(got, stored):
    """Equal but for the time of the first one, which the unpacked copies count from."""
    for name in ("x", "y", "p"):
        np.testing.assert_array_equal(getattr(got, name), stored[name])
    np.testing.assert_array_equal(got.t - got.t[0], np.rint(stored["t"] * 1e6).astype(np.int64))


@pytest.mark.parametrize(
    ("raw", "unpacked"),
    [
        ("davis346.aedat4", "davis346_street.npz"),
        ("rotating_disk_imu.aedat", "rotating_disk_imu.npz"),
        ("spinning_dot_evt2.raw", "spinning_dot.npz"),
    ],
)
def test_real_files_equal_their_unpacked_copies(data, raw, unpacked):
    if raw.endswith("aedat4"):
        pytest.importorskip("aedat")
    got = load(data / raw)
    with np.load(data / unpacked) as stored:
        same_events(got.events, stored)
        first = got.events.t[0]
        if "gyro" in stored:
            np.testing.assert_allclose(got.imu.gyro, stored["gyro"], rtol=1e-12)
            np.testing.assert_allclose(got.imu.acc, stored["acc"], rtol=1e-12)
            np.testing.assert_array_equal(got.imu.t - first, np.rint(stored["imu_t"] * 1e6))
        if "frames" in stored:
            np.testing.assert_array_equal(got.frames.images, stored["frames"])
            middle = np.rint((stored["exp_start"] + stored["exp_end"]) / 2 * 1e6)
            np.testing.assert_array_equal(got.frames.t - first, middle)
            assert (got.frames.exposure == 500).all()


def test_dv_processing_decodes_the_same(data):
    dv = pytest.importorskip("dv_processing")
    pytest.importorskip("aedat")
    got = load(data / "davis346.aedat4")
    other = dv.io.MonoCameraRecording(str(data / "davis346.aedat4"))
    batches = list(iter(other.getNextEventBatch, None))
    events = np.concatenate([batch.numpy() for batch in batches])
    for name, field in (("t", "timestamp"), ("x", "x"), ("y", "y"), ("p", "polarity")):
        np.testing.assert_array_equal(getattr(got.events, name), events[field])
    frames = list(iter(other.getNextFrame, None))
    np.testing.assert_array_equal(got.frames.images, [frame.image for frame in frames])
    start = got.frames.t - got.frames.exposure // 2
    assert start.tolist() == [frame.timestamp for frame in frames]
    samples = [sample for batch in iter(other.getNextImuBatch, None) for sample in batch]
    assert got.imu.t.tolist() == [sample.timestamp for sample in samples]
    gyro = [sample.getAngularVelocities() for sample in samples]
    np.testing.assert_allclose(got.imu.gyro, gyro, rtol=1e-4, atol=1e-6)
    acc = np.array([sample.getAccelerations() for sample in samples])
    np.testing.assert_allclose(got.imu.acc, acc * 9.80665 / 9.81, rtol=1e-4, atol=1e-5)


def test_evt3_and_dat_are_the_same_recording(data):
    pytest.importorskip("evt3")
    a, b = load(data / "evt3.raw").events, load(data / "gen4.dat").events
    for name in ("x", "y", "p"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    assert set((a.t - b.t).tolist()) == {11_194_368}
