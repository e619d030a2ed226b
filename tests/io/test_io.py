"""Every format read back from files written without the readers, and every kind of bad input."""

import contextlib
import os
import re
import subprocess
import sys
import tempfile
import tracemalloc
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import scipy.io
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from refusals import refuses

from jaxevent import io
from jaxevent.camera import PinholeCamera
from jaxevent.errors import InputError
from jaxevent.io import hdf5, save
from jaxevent.io.output import complete
from jaxevent.recording import Events, Frames, Imu, Poses, Recording

# Typed loosely: each test knows which optional parts its recording has and what a file holds.
load: Any = io.load
File: Any = h5py.File


@contextlib.contextmanager
def folder():
    """A fresh folder per hypothesis example, which tmp_path is not."""
    with tempfile.TemporaryDirectory() as path:
        yield Path(path)


def random_recording(seed, events, frames=0, parts=True, name="random", offset=0) -> Any:
    """A valid recording of random content on a sensor of random size."""
    random = np.random.default_rng(seed)
    width, height = (int(n) for n in random.integers(1, 40, 2))

    def stamps(n):
        return np.sort(offset + random.choice(3_000_000, n, replace=False)).astype(np.int64)

    t = np.sort(offset + random.integers(0, 3_000_000, events))
    return Recording(
        name,
        width,
        height,
        Events(
            t,
            random.integers(0, width, events).astype(np.uint16),
            random.integers(0, height, events).astype(np.uint16),
            random.random(events) < 0.5,
        ),
        Frames(
            stamps(frames),
            random.integers(0, 256, (frames, height, width)).astype(np.uint8),
            random.integers(0, 9_000, frames),
        )
        if frames
        else None,
        PinholeCamera(1.5, 2.5, 0.1, 1 / 3, (0.1, -2e-9, 0.0, 1.0, 3.0)) if parts else None,
        Poses(stamps(4), random.normal(size=(4, 3)), random.normal(size=(4, 4))) if parts else None,
        Imu(stamps(5), random.normal(size=(5, 3)), random.normal(size=(5, 3))) if parts else None,
    )


recordings = st.builds(
    random_recording,
    seed=st.integers(0, 2**32 - 1),
    events=st.integers(1, 300),
    frames=st.integers(0, 3),
    parts=st.booleans(),
    offset=st.sampled_from([0, 7, 1_468_939_993_078_616]),
)


def assert_same(got, want, exposure=True):
    assert (got.name, got.width, got.height) == (want.name, want.width, want.height)
    assert got.camera == want.camera
    for part in ("events", "frames", "poses", "imu"):
        a, b = getattr(got, part), getattr(want, part)
        if b is None:
            assert a is None
            continue
        for field in vars(b):
            if field == "exposure" and not exposure:
                assert not a.exposure.any()
                continue
            x, y = getattr(a, field), getattr(b, field)
            assert x.dtype == y.dtype, (part, field)
            np.testing.assert_array_equal(x, y, err_msg=f"{part}.{field}")
    assert set(got.extra) == set(want.extra)
    for key, value in want.extra.items():
        assert got.extra[key].dtype == value.dtype
        np.testing.assert_array_equal(got.extra[key], value)


def calib(camera):
    return [camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion]


def write_text(path, recording, header=False, minus=False):
    path.mkdir(parents=True, exist_ok=True)
    events = recording.events
    with open(path / "events.txt", "w") as file:
        if header:
            file.write(f"{recording.width} {recording.height}\n")
        for t, x, y, p in zip(events.t, events.x, events.y, events.p, strict=True):
            sign = int(p) if not minus else (1 if p else -1)
            file.write(f"{t // 10**6}.{t % 10**6:06d} {x} {y} {sign}\n")
    if recording.frames is not None:
        (path / "images").mkdir(exist_ok=True)
        with open(path / "images.txt", "w") as file:
            for i, t in enumerate(recording.frames.t):
                Image.fromarray(recording.frames.images[i]).save(path / f"images/{i:03d}.png")
                file.write(f"{t // 10**6}.{t % 10**6:06d} images/{i:03d}.png\n")
    if recording.poses is not None:
        poses, imu = recording.poses, recording.imu
        for name, t, values in (
            ("groundtruth", poses.t, np.hstack([poses.position, poses.quaternion])),
            ("imu", imu.t, np.hstack([imu.acc, imu.gyro])),
        ):
            with open(path / f"{name}.txt", "w") as file:
                file.write("# a comment\n")
                for time, row in zip(t, values, strict=True):
                    stamp = f"{time // 10**6}.{time % 10**6:06d}"
                    file.write(" ".join([stamp, *(repr(float(v)) for v in row)]) + "\n")
        numbers = " ".join(repr(float(v)) for v in calib(recording.camera))
        (path / "calib.txt").write_text(numbers + "\n")
    return path


def zip_folder(path, target, prefix=""):
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in sorted(path.rglob("*")):
            if file.is_file():
                archive.write(file, prefix + file.relative_to(path).as_posix())
    return target


def npz_arrays(recording, seconds=False):
    """The arrays of the .npz layout, with exact exposures."""

    def clock(t):
        return t / 1e6 if seconds else t

    events = recording.events
    arrays = dict(t=clock(events.t), x=events.x, y=events.y, p=events.p)
    arrays |= dict(width=recording.width, height=recording.height)
    if recording.frames is not None:
        frames = recording.frames
        start = frames.t - frames.exposure // 2
        arrays |= dict(frames=frames.images, exp_start=clock(start))
        arrays |= dict(exp_end=clock(start + frames.exposure), frame_t=clock(frames.t + 999))
    if recording.imu is not None:
        imu = recording.imu
        arrays |= dict(imu_t=clock(imu.t), gyro=imu.gyro, acc=imu.acc)
        arrays |= dict(calib=calib(recording.camera))
    return arrays


def mat_arrays(recording, minus=True):
    """The MATLAB variables of a recording, as MATLAB would show them."""
    e = recording.events
    p = np.where(e.p, 1, -1) if minus else e.p
    arrays = {"events": np.stack([e.t, e.x + 1.0, e.y + 1.0, p], axis=1).astype(np.float64)}
    if (frames := recording.frames) is not None:
        arrays["image"] = np.moveaxis(frames.images, 0, 2)
        arrays["time_image"] = frames.t[:, None].astype(np.float64)
        arrays["exposure"] = frames.exposure[None].astype(np.float64)
    return arrays


def write_v73(path, arrays):
    """Write a file as MATLAB's -v7.3 does: a 512-byte header, then HDF5 with axes reversed."""
    with File(path, "w", userblock_size=512) as file:
        for name, value in arrays.items():
            value = np.asarray(value)
            if value.size == 0:
                file[name] = np.array(value.shape, np.uint64)
                file[name].attrs["MATLAB_empty"] = np.uint8(1)
            else:
                file[name] = np.atleast_2d(value).T
    with open(path, "r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM")
    return path


MAT_WRITERS = {"v5": lambda path, arrays: scipy.io.savemat(path, arrays), "v7.3": write_v73}
either_mat = pytest.mark.parametrize("write_mat", MAT_WRITERS.values(), ids=MAT_WRITERS)


# Text


@given(recordings, st.booleans(), st.booleans(), st.sampled_from(["folder", "", "top/"]))
def test_text_round_trip(recording, header, minus, where):
    with folder() as path:
        written = write_text(path / "random", recording, header, minus)
        if where != "folder":
            written = zip_folder(written, path / "random.zip", where)
        if not header and recording.frames is None:
            refuses("sensor's size; give size=", load, written)
        size = None if header or recording.frames else (recording.width, recording.height)
        assert_same(load(written, size), recording, exposure=False)


def test_text_tolerates_tabs_comments_blank_and_unfinished_lines(tmp_path):
    (tmp_path / "events.txt").write_bytes(
        b"# t x y p\n\n0.1\t1\t2\t1\r\n0.2 3  4 0 \r\n\n0.3 1 1 1"
    )
    events = load(tmp_path, size=(5, 5)).events
    assert events.t.tolist() == [100_000, 200_000, 300_000]
    assert events.p.tolist() == [True, False, True]


def test_text_whole_numbers_are_seconds_and_one_event_is_enough(tmp_path):
    (tmp_path / "events.txt").write_text("3 1 2 1\n")
    assert load(tmp_path, size=(5, 5)).events.t.tolist() == [3_000_000]


def test_text_size_overrides_header_and_images(tmp_path):
    (tmp_path / "events.txt").write_text("4 4\n3 7 2 1\n")
    assert load(tmp_path, size=(9, 5)).width == 9


def test_text_without_events_but_with_frames(tmp_path):
    recording = random_recording(0, events=0, frames=2, name=tmp_path.name)
    write_text(tmp_path, recording)
    assert_same(load(tmp_path), recording, exposure=False)


def test_text_images_become_grey_or_stay_16_bit(tmp_path):
    (tmp_path / "events.txt").write_text("")
    colour = np.zeros((2, 3, 3), np.uint8)
    colour[..., 1] = 200
    Image.fromarray(colour).save(tmp_path / "a b.png")
    (tmp_path / "images.txt").write_text("0.5 a b.png\n")
    frames = load(tmp_path).frames
    assert frames.images.dtype == np.uint8 and frames.images.shape == (1, 2, 3)
    assert (frames.images == round(0.587 * 200)).all()
    deep = np.array([[0, 300, 65535]], np.uint16)
    Image.fromarray(deep).save(tmp_path / "a b.png")
    frames = load(tmp_path).frames
    assert frames.images.dtype == np.uint16
    np.testing.assert_array_equal(frames.images[0], deep)


@pytest.mark.parametrize(
    "lines, message",
    [
        ("", "holds no event and no frame"),
        ("0.1 1 2 1\n0.2 3 4\n", "events.txt: row 1 has p = nan; each line must be"),
        ("0.1 1 2 1\n0.2 nan 4 1\n", "events.txt: row 1 has x = nan"),
        ("0.1 1 2 1\ninf 3 4 1\n", "events.txt: row 1 has t = inf"),
        ("0.1 1 2 1\n0.2 abc 4 1\n", "events.txt: row 1 has x = abc"),
        ("t,x,y,p\n0.1,1,2,1\n", "events.txt: row 0 has t = t,x,y,p"),
        ("0.1 1 2 1 0\n0.2 3 4 1 0\n", "too many columns"),
        ("0.1 1 2 1\n0.2 3 4 1 0\n", "events.txt: cannot be read .*line 2, saw 5"),
        ("0.1 1\n", "line 1 has 2 fields but is not 'width height'"),
        ("0.1 1 2 1\n0.2 -3 4 1\n", "event 1 has x = -3; on the 9x9 sensor"),
        (
            "0.1 1 2 1\n0.2 3 9 1\n",
            "event 1 has y = 9; .* from 0 to 8, so .*give the sensor's size",
        ),
        ("0.1 1 2 1\n0.2 3.5 4 1\n", "event 1 has x = 3.5; .*whole number"),
        ("0.1 1 2 1\n0.2 3 4 2\n", "event 1 has the polarity 2; it must be 1 for ON"),
        ("0.1 1 2 1\n0.2 3 4 0\n0.3 1 1 -1\n", "polarities 0 and -1 both occur"),
        ("0.2 1 2 1\n0.1 3 4 1\n", "event 1 is at 100000 us, earlier .*; sort the events"),
        ("1e15 1 2 1\n", "event 0 has the time 10{15}, not .* for seconds; correct the unit"),
        ("\xff\xfe 1 2 1\n", "events.txt: cannot be read"),
    ],
)
def test_text_bad_events(tmp_path, lines, message):
    (tmp_path / "events.txt").write_bytes(lines.encode("latin-1"))
    assert str(tmp_path) in refuses(message, load, tmp_path, size=(9, 9))


@pytest.mark.parametrize(
    "file, content, message",
    [
        ("images.txt", "0.1\n", "images.txt: line 1 is '0.1'; each line must be 't path'"),
        ("images.txt", "x a.png\n", "images.txt: line 1 is"),
        ("images.txt", "0.1 b.png\n", "images.txt names b.png, which does not exist"),
        ("images.txt", "0.1 ../../b.png\n", "../../b.png, outside the recording"),
        ("images.txt", "0.1 /etc/b.png\n", "/etc/b.png, outside the recording"),
        ("images.txt", "0.1 b.png\n", "which does not exist"),
        ("images.txt", "0.1 bad.png\n", "bad.png: cannot be read .*cannot identify"),
        ("images.txt", "0.1 a.png\n0.2 small.png\n", "small.png is 2x1 uint8 but the first .* 9x9"),
        ("images.txt", "0.2 a.png\n0.1 a.png\n", "frame 1 at 100000 us is not later"),
        ("images.txt", "0.1 small.png\n", "frames have shape .1, 1, 2.*9x9 sensor"),
        ("groundtruth.txt", "0.1 1 2 3\n", "groundtruth.txt: row 0 has qx = nan"),
        ("groundtruth.txt", "2 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n", "pose times are not sorted"),
        ("imu.txt", "0.1 1 2 3 4 5 oops\n", "imu.txt: row 0 has gz = oops"),
        ("calib.txt", "1 2 3 4\n", "calib.txt: row 0 has k1 = nan"),
        ("calib.txt", "", "calib.txt: the calibration must be nine finite numbers"),
    ],
)
def test_text_bad_other_files(tmp_path, file, content, message):
    (tmp_path / "events.txt").write_text("0.1 1 2 1\n")
    Image.fromarray(np.zeros((9, 9), np.uint8)).save(tmp_path / "a.png")
    Image.fromarray(np.zeros((1, 2), np.uint8)).save(tmp_path / "small.png")
    (tmp_path / "bad.png").write_bytes(b"not a png")
    (tmp_path / file).write_text(content)
    refuses(message, load, tmp_path, size=(9, 9))


def test_zip_of_two_recordings(tmp_path):
    with zipfile.ZipFile(tmp_path / "two.zip", "w") as archive:
        archive.writestr("a/events.txt", "0 0 0 1\n")
        archive.writestr("b/events.txt", "0 0 0 1\n")
    refuses("holds 2 events.txt", load, tmp_path / "two.zip")


# MATLAB


@either_mat
@given(recordings, st.booleans())
def test_mat_round_trip(write_mat, recording, minus):
    with folder() as path:
        write_mat(path / "random.mat", mat_arrays(recording, minus))
        got = load(path / "random.mat", (recording.width, recording.height))
        want = replace(recording, camera=None, poses=None, imu=None)
        assert_same(got, want)


@either_mat
def test_mat_golden(tmp_path, write_mat):
    """Two events, two frames of 3 rows and 4 columns, and the extras of the HDR recordings."""
    image = np.arange(24, dtype=np.uint8).reshape(3, 4, 2)
    write_mat(
        tmp_path / "golden.mat",
        {
            "events": np.array([[10.0, 1, 1, 1], [25.4, 4, 3, 0]]),
            "image": image,
            "time_image": np.array([[5.0, 105.0]]),
            "exposure": np.array([[50.0]]),
            "f_Q": np.linspace(0, 1, 256)[None],
            "ct": np.array([[0.1]]),
            "HDR_mat": np.arange(24.0).reshape(3, 4, 2),
            "other": np.array([[1.0, 2.0]]),
        },
    )
    got = load(tmp_path / "golden.mat")
    assert (got.name, got.width, got.height) == ("golden", 4, 3)
    events, frames = got.events, got.frames
    assert events.t.tolist() == [10, 25]
    assert (events.x.tolist(), events.y.tolist()) == ([0, 3], [0, 2])
    assert events.p.tolist() == [True, False]
    assert frames.t.tolist() == [5, 105] and frames.exposure.tolist() == [50, 50]
    assert frames.images[1, 2, 3] == image[2, 3, 1]
    assert got.extra["f_Q"].shape == (256,)
    assert got.extra["ct"].shape == () and got.extra["ct"] == 0.1
    assert got.extra["HDR_mat"].shape == (2, 3, 4)
    assert got.extra["HDR_mat"][1, 2, 3] == image[2, 3, 1]
    assert got.extra["other"].tolist() == [1, 2]


@either_mat
@pytest.mark.parametrize("count", [1, 2, 3])
def test_mat_colour_references_become_the_mean_of_their_channels(tmp_path, write_mat, count):
    """Three planes are three channels, unless there are three frames."""
    rng = np.random.default_rng(3)
    several, one = rng.random((3, 4, 3, count)), rng.integers(0, 9, (3, 4, 3)).astype(np.uint16)
    path = tmp_path / "a.mat"
    frames = {"image": np.zeros((3, 4, count), np.uint8), "time_image": np.arange(1.0, count + 1)}

    def reference(images):
        write_mat(path, bad_mat(**frames, HDR_mat=images))
        return load(path).extra["HDR_mat"]

    got = reference(several)
    assert got.shape == (count, 3, 4)
    for k, y, x in np.ndindex(count, 3, 4):
        r, g, b = several[y, x, :, k]
        assert got[k, y, x] == pytest.approx((r + g + b) / 3)
    planes = np.moveaxis(one, 2, 0)
    np.testing.assert_allclose(reference(one), planes if count == 3 else sum(planes / 3))


@either_mat
def test_mat_events_as_rows_without_events_and_a_single_frame(tmp_path, write_mat):
    path = tmp_path / "a.mat"
    arrays = mat_arrays(random_recording(1, events=7))
    write_mat(path, {"events": arrays["events"].T})
    np.testing.assert_array_equal(load(path, (40, 40)).events.t, arrays["events"][:, 0])
    single = {"image": np.ones((3, 4)) / 2, "time_image": 9.0, "HDR_mat": np.ones((3, 4))}
    write_mat(path, {"events": np.zeros((0, 4))} | single)
    got = load(path)
    assert len(got.events) == 0 and got.frames.images.shape == (1, 3, 4)
    assert got.frames.exposure.tolist() == [0] and got.extra["HDR_mat"].shape == (3, 4)


def bad_mat(**changes):
    events = np.array([[10.0, 1, 1, 1], [25, 4, 3, 0], [26, 4, 3, 0]])
    arrays = {"events": events, "image": np.zeros((3, 4, 2), np.uint8)}
    arrays |= {"time_image": np.array([5.0, 105])} | changes
    return {name: value for name, value in arrays.items() if value is not None}


def changed(row, column, value):
    events = bad_mat()["events"].copy()
    events[row, column] = value
    return events


@either_mat
@pytest.mark.parametrize(
    "changes, message",
    [
        (dict(events=np.ones((3, 5))), r"events has shape \(3, 5\); store it as N x 4"),
        (dict(events=changed(1, 1, 0)), "event 1 has x = 0; on the 4x3 .* from 1 to 4"),
        (dict(events=changed(1, 1, 5)), "event 1 has x = 5; on the 4x3 .* from 1 to 4"),
        (dict(events=changed(1, 2, np.nan)), "event 1 has y = nan"),
        (dict(events=changed(1, 2, np.inf)), "event 1 has y = inf"),
        (dict(events=changed(1, 0, np.nan)), "event 1 has the time nan"),
        (dict(events=changed(1, 0, 5)), "event 1 is at 5 us, earlier"),
        (dict(events=changed(1, 3, 7)), "event 1 has the polarity 7"),
        (dict(image=None, time_image=None), "no image to show the sensor's size; give size="),
        (dict(time_image=None), "image has no times; add time_image"),
        (dict(time_image=np.array([5.0])), r"frames have shape \(2, 3, 4\)"),
        (dict(time_image=np.array([5.0, np.nan])), "time_image: image 1 has the time nan"),
        (dict(exposure=np.array([5.0, 6, 7])), "3 exposures"),
        (dict(exposure=-1.0), "frame 0 has the exposure -1 us"),
        (dict(image=np.full((3, 4, 2), 99.0)), "image is float64 with values up to 99; .* uint8"),
        (dict(image=np.full((3, 4, 2), np.nan)), "frame 0 holds NaN"),
        (dict(image=np.zeros((3, 4, 3, 2), np.uint8)), "store grey images as H x W x K"),
        (dict(HDR_mat=np.zeros((3, 4, 2, 2))), r"HDR_mat has shape \(3, 4, 2, 2\); .* 3 x K"),
    ],
)
def test_mat_bad(tmp_path, write_mat, changes, message):
    write_mat(tmp_path / "a.mat", bad_mat(**changes))
    refuses(message, load, tmp_path / "a.mat")


def test_mat_without_events(tmp_path):
    scipy.io.savemat(tmp_path / "a.mat", {"events": "text", "image": np.zeros((3, 4))})
    refuses("no numeric variable events", load, tmp_path / "a.mat")


# NumPy archives


@given(recordings, st.booleans(), st.booleans())
def test_npz_round_trip(recording, seconds, compressed):
    if recording.events.t[0] > 10**15:
        seconds = False  # the exposures' halves are not representable in float64 seconds
    arrays = npz_arrays(recording, seconds) | {"omega": np.arange(3.0), "note": np.array("hello")}
    with folder() as path:
        (np.savez_compressed if compressed else np.savez)(path / "random.npz", **arrays)
        extra = {"omega": arrays["omega"], "note": arrays["note"]}
        want = replace(recording, poses=None, extra=extra)
        assert_same(load(path / "random.npz"), want)


def test_npz_takes_colours_as_arrays_are(tmp_path):
    rng = np.random.default_rng(0)
    frames = rng.integers(0, 256, (2, 4, 6, 3), np.uint8)
    columns = {"t": np.arange(3) * 5_000, "x": [1, 2, 3], "y": [0, 1, 2], "p": [0, 1, 1]}
    np.savez(tmp_path / "a.npz", **columns, frames=frames, frame_t=[1_000, 9_000])
    read = load(tmp_path / "a.npz", time_unit="us")
    made = Recording.from_arrays(**columns, frames=frames, frame_times=[1_000, 9_000])
    assert (read.width, read.height) == (6, 4)
    np.testing.assert_array_equal(read.frames.images, made.frames.images)
    np.testing.assert_array_equal(read.extra["rgb"], made.extra["rgb"])


def test_npz_size_from_frames_and_times_without_exposure(tmp_path):
    arrays = npz_arrays(random_recording(3, events=5, frames=2))
    for name in ("width", "height", "exp_start", "exp_end"):
        arrays.pop(name)
    np.savez(tmp_path / "a.npz", **arrays)
    frames = load(tmp_path / "a.npz").frames
    assert frames.t.tolist() == arrays["frame_t"].tolist() and not frames.exposure.any()


@pytest.mark.parametrize(
    "changes, message",
    [
        (dict(x=None), "has no x; add the arrays"),
        (dict(width=None), "no width and height"),
        (dict(width=np.array([1, 2])), "width must be one whole number"),
        (dict(width=0), "the sensor has 0x3 pixels"),
        (dict(x=np.zeros(2, int)), "t, x, y and p have 3, 2, 3 and 3 values"),
        (dict(x=np.zeros((3, 1))), r"x has shape \(3, 1\)"),
        (dict(x=np.array(["a", "b", "c"])), "x is <U1"),
        (dict(x=np.array([0, -1, 0])), "event 1 has x = -1"),
        (dict(x=np.array([0, 70000, 0])), "event 1 has x = 70000"),
        (dict(y=np.array([0, np.nan, 0])), "event 1 has y = nan"),
        (dict(t=np.array([0.0, np.inf, 1])), "event 1 has the time inf"),
        (dict(t=np.array([3, 2, 1])), "event 1 is at 2 us, earlier"),
        (dict(t=np.array([1j, 2, 3])), "event times is complex128"),
        (dict(p=np.array([0, 1, 5], np.uint8)), "event 2 has the polarity 5"),
        (dict(t=[], x=[], y=[], p=[]), "holds no event and no frame"),
        (dict(frames=np.zeros((2, 3, 4), np.uint8)), "frames have no times; add frame_t"),
        (dict(frames=np.zeros((3, 4), np.uint8), frame_t=[1]), r"frames have the shape \(3, 4\)"),
        (dict(frames=np.zeros((1, 3, 9)), frame_t=[1]), r"frames have shape \(1, 3, 9\)"),
        (dict(frames=np.full((1, 3, 4), np.nan), frame_t=[1]), "frame 0 holds NaN"),
        (dict(frames=np.zeros((1, 3, 4), int), frame_t=[1]), "frames are int64"),
        (dict(frames=np.zeros((1, 3, 4)), exp_start=[1]), "has no exp_end"),
        (dict(frames=np.zeros((1, 3, 4)), exp_start=[1], exp_end=[1, 2]), "have 1 and 2 values"),
        (dict(frames=np.zeros((1, 3, 4)), exp_start=[9], exp_end=[1]), "exposure -8 us"),
        (dict(imu_t=[1, 2], gyro=np.zeros((2, 3))), "has no acc"),
        (dict(imu_t=[1], gyro=np.zeros((2, 3)), acc=np.zeros((1, 3))), "IMU: gyro is .* of shape"),
        (dict(calib=np.zeros(4)), "calib: the calibration must be nine"),
        (dict(note=np.array([{}], object)), "note: cannot be read .*pickle"),
    ],
)
def test_npz_bad(tmp_path, changes, message):
    arrays = dict(t=[1, 2, 3], x=[0, 1, 2], y=[0, 1, 2], p=[0, 1, 1], width=4, height=3) | changes
    np.savez(tmp_path / "a.npz", **{k: v for k, v in arrays.items() if v is not None})
    assert str(tmp_path / "a.npz") in refuses(message, load, tmp_path / "a.npz")


# HDF5


@pytest.mark.slow
@given(recordings, st.sampled_from([None, "gzip"]), st.integers(0, 2))
def test_hdf5_round_trip(recording, compression, extras):
    extra = {
        "table": np.linspace(0, 1, 256),
        "deep/er": np.ones((2, 0, 3), np.float32),
        "note": np.array("hellö"),
        "names": np.array(["a", "bcd"]),
        "flags": np.array([[True], [False]]),
        "ct": np.array(0.1),
    }
    recording = replace(recording, extra=dict(list(extra.items())[: 3 * extras]))
    with folder() as path:
        save(recording, path / "a.h5", compression)
        assert os.listdir(path) == ["a.h5"]
        assert_same(load(path / "a.h5"), recording)
        stored = load(path / "a.h5", in_memory=False)
        assert isinstance(stored.events, hdf5.StoredEvents)
        save(stored, path / "a.h5", compression)  # onto the file being read
        assert_same(load(path / "a.h5"), recording)
        assert_same(stored[:], recording[:])


@given(recordings, st.sampled_from([None, "gzip"]), st.data())
def test_stored_events_are_those_in_memory(recording, compression, data):
    events = recording.events
    with folder() as path:
        save(recording, path / "a.h5", compression)
        stored = load(path / "a.h5", in_memory=False).events
        assert len(stored) == len(events)
        row = st.none() | st.integers(-len(events) - 2, len(events) + 2)
        for _ in range(5):
            rows = slice(data.draw(row), data.draw(row))
            for got, want in zip(
                vars(stored[rows]).values(), vars(events[rows]).values(), strict=True
            ):
                assert got.dtype == want.dtype
                np.testing.assert_array_equal(got, want)
        for near in (-5000, -1, 0, 1, 5000):
            for time in (events.t[0], events.t[-1], data.draw(st.sampled_from(events.t))):
                assert stored.index(int(time) + near) == events.index(int(time) + near)


@pytest.mark.slow
@given(recordings, st.integers(1, 50))
def test_plain_h5py_reads_the_layout(recording, block):
    """ms_to_idx by its definition, whatever the size of the blocks that were copied."""
    with folder() as path, pytest.MonkeyPatch.context() as patch:
        patch.setattr(hdf5, "_BLOCK_EVENTS", block)
        save(recording, path / "a.h5")
        with File(path / "a.h5") as file:
            assert file.attrs["format"] == "jaxevent" and file.attrs["version"] == 1
            assert file.attrs["width"] == recording.width
            t, offset = file["events/t"][()], file["t_offset"][()]
            np.testing.assert_array_equal(t + offset, recording.events.t)
            assert file["events/p"].dtype == np.uint8
            np.testing.assert_array_equal(file["events/p"][()], recording.events.p)
            ms_to_idx = file["ms_to_idx"][()]
            assert len(ms_to_idx) == t[-1] // 1000 + 1
            for m in range(0, len(ms_to_idx), 1 + len(ms_to_idx) // 50):
                assert ms_to_idx[m] == np.count_nonzero(t < 1000 * m)


def test_hdf5_without_events(tmp_path):
    recording = random_recording(5, events=0, frames=2)
    for compression in (None, "gzip"):
        save(recording, tmp_path / "a.h5", compression)
        assert_same(load(tmp_path / "a.h5"), recording)
        stored = load(tmp_path / "a.h5", in_memory=False)
        assert stored.events.index(5) == 0 and len(stored.events[:]) == 0
        assert stored.start == recording.start


def test_gzip_is_smaller(tmp_path):
    recording = random_recording(6, events=20_000)
    save(recording, tmp_path / "plain.h5")
    save(recording, tmp_path / "small.h5", "gzip")
    assert (tmp_path / "small.h5").stat().st_size < 0.8 * (tmp_path / "plain.h5").stat().st_size


def test_dense_millisecond_and_missing_table(tmp_path, monkeypatch):
    monkeypatch.setattr(hdf5, "_CHUNK_VALUES", 16)
    recording = random_recording(7, events=3000)
    recording.events.t[500:2500] = recording.events.t[500] // 1000 * 1000 + np.arange(2000) // 4
    recording.events.t.sort()
    save(recording, tmp_path / "a.h5")
    for _ in range(2):
        stored = load(tmp_path / "a.h5", in_memory=False).events
        for time in recording.events.t[::37]:
            for near in (time - 1, time, time + 1):
                assert stored.index(int(near)) == recording.events.index(int(near))
        del stored
        with File(tmp_path / "a.h5", "r+") as file:
            file.pop("ms_to_idx", None)


def test_dsec_layout(tmp_path):
    events = random_recording(8, events=100).events
    with File(tmp_path / "events.h5", "w") as file:
        for name, dtype in (("t", "u4"), ("x", "u2"), ("y", "u2"), ("p", "u1")):
            file[f"events/{name}"] = getattr(events, name).astype(dtype)
        file["t_offset"] = 50_000_000_000
        last_ms = int(events.t[-1]) // 1000
        file["ms_to_idx"] = np.searchsorted(events.t, 1000 * np.arange(last_ms + 1)).astype("u8")
    refuses("no attributes width and height; give size=", load, tmp_path / "events.h5")
    for in_memory in (True, False):
        got = load(tmp_path / "events.h5", (40, 40), in_memory)
        np.testing.assert_array_equal(got.events[:].t, events.t + 50_000_000_000)
        assert got.start == events.t[0] + 50_000_000_000
        for time in (0, *events.t, 10**13):
            assert got.events.index(int(time) + 50_000_000_000) == events.index(int(time))


def test_stored_events_are_saved_at_constant_memory(tmp_path, monkeypatch):
    monkeypatch.setattr(hdf5, "_BLOCK_EVENTS", 1 << 13)
    save(random_recording(9, events=400_000, parts=False), tmp_path / "a.h5")
    stored = load(tmp_path / "a.h5", in_memory=False)
    tracemalloc.start()
    save(stored, tmp_path / "b.h5")
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 400_000 * 13 / 4


@pytest.mark.parametrize(
    "name, value, message",
    [
        ("events/x", np.zeros(2, np.uint16), "events/t, x, y and p have shapes"),
        ("events/x", None, "has no dataset events/x"),
        ("events/x", np.arange(100, 150, dtype=np.uint16), "event 0 has x = 100; on the"),
        ("events/t", np.arange(50)[::-1], "event 1 is at .* us, earlier"),
        ("events/t", np.full(50, 1j), "events/t is complex128; store integer microseconds"),
        ("events/t", np.arange(50) / 8, "events/t is in seconds and t_offset in microseconds"),
        ("events/p", np.full(50, 3, np.uint8), "event 0 has the polarity 3"),
        ("ms_to_idx", np.zeros((2, 2)), "ms_to_idx must be a list of integers"),
        ("frames/t", None, "has no dataset frames/t"),
        ("frames/exposure", np.zeros(5, int), "5 exposures"),
        ("camera", np.zeros(3), "camera: the calibration must be nine"),
        ("poses/position", np.zeros((3, 3)), "pose: position is .* of shape"),
        ("imu/gyro", np.full((5, 3), np.nan), "IMU: gyro is .* must be finite"),
    ],
)
def test_hdf5_bad(tmp_path, name, value, message):
    path = tmp_path / "a.h5"
    save(random_recording(10, events=50, frames=2), path)
    with File(path, "r+") as file:
        del file[name]
        if value is not None:
            file[name] = value
    for in_memory in (True, False):
        with pytest.raises(InputError, match=message) as error:
            load(path, in_memory=in_memory).events[:]
        assert str(path) in str(error.value)


def test_stored_events_are_sorted_across_pieces(tmp_path):
    save(random_recording(11, events=50), tmp_path / "a.h5")
    with File(tmp_path / "a.h5", "r+") as file:
        file["events/t"][20:] = np.arange(30)
    events = load(tmp_path / "a.h5", in_memory=False).events
    assert len(events[:20]) + len(events[21:]) == 49
    with pytest.raises(InputError, match="event 20 is at .* us, earlier than the one before it"):
        events[20:40]


def test_stored_index_notices_a_wrong_table(tmp_path):
    recording = random_recording(12, events=50)
    save(recording, tmp_path / "a.h5")
    for wrong in (0, 10**6):
        with File(tmp_path / "a.h5", "r+") as file:
            file["ms_to_idx"][1:] = wrong
        events = load(tmp_path / "a.h5", in_memory=False).events
        refuses("ms_to_idx does not fit events/t at", events.index, int(recording.events.t[30]))
        del events


def test_hdf5_of_a_later_version(tmp_path):
    save(random_recording(13, events=5), tmp_path / "a.h5")
    with File(tmp_path / "a.h5", "r+") as file:
        file.attrs["version"] = 2
    refuses("has version 2 .* update jaxevent", load, tmp_path / "a.h5")


def test_save_refuses_what_it_cannot_write(tmp_path):
    good = random_recording(14, events=5)
    path = tmp_path / "a.h5"
    save(good, path)
    before = path.read_bytes()
    changed = random_recording(14, events=5)
    changed.events.t[:] = changed.events.t[::-1].copy()  # after it was checked
    for bad, message in (
        (replace(good, extra={"thing": np.array([{}])}), "extra/thing .object. cannot"),
        (changed, "sort the events"),
    ):
        refuses(message, save, bad, path)
    refuses("compression 'zip' is unknown", save, good, path, "zip")
    refuses("a.npz: recordings are stored as HDF5; end", save, good, tmp_path / "a.npz")
    refuses("writes recordings, not an Events; write flow by", save, good.events, path)
    refuses(
        "the folder .*missing does not exist; create it", save, good, tmp_path / "missing" / "a.h5"
    )
    assert os.listdir(tmp_path) == ["a.h5"] and path.read_bytes() == before


# Finding the reader, and damage


def test_content_tells_the_format_not_the_name(tmp_path):
    recording = random_recording(15, events=20, frames=1, name="a")
    for write in (
        lambda path: hdf5.write(recording, path),
        lambda path: zip_folder(write_text(tmp_path / "text", recording), path),
        lambda path: write_v73(path, mat_arrays(recording)),
        lambda path: scipy.io.savemat(path, mat_arrays(recording), appendmat=False),
        lambda path: np.savez(path.with_suffix(".npz"), **npz_arrays(recording)),
    ):
        write(tmp_path / "a.bin")
        if (tmp_path / "a.npz").exists():
            (tmp_path / "a.npz").replace(tmp_path / "a.bin")
        np.testing.assert_array_equal(load(tmp_path / "a.bin").events.t, recording.events.t)


def test_load_refuses_other_things(tmp_path):
    refuses("no such file or folder", load, tmp_path / "missing")
    refuses("holds no events.txt; readable are a folder or zip", load, tmp_path)
    other = tmp_path / "other"
    for content, message in (
        (b"", "is empty"),
        (b"some text", "format is not recognised; readable are"),
        (b"\x89PNG" + bytes(500), "format is not recognised"),
        (b"PK\x03\x04 cut off", "cannot be read .*zip"),
    ):
        other.write_bytes(content)
        refuses(message, load, other)
    with zipfile.ZipFile(other, "w") as archive:
        archive.writestr("readme.txt", "nothing")
    refuses("neither events.txt nor .npy arrays", load, other)
    with File(other, "w") as file:
        file["data"] = 1
    refuses(r"neither events/t, x, y and p nor .* it holds data int64 \(\); read", load, other)
    with File(other, "w") as file:
        for number in range(12):
            file[f"some/{number:02}"] = np.zeros((3, 2), np.int16)
    refuses(r"holds some/00 int16 \(3, 2\), some/01 .*, 4 more; read .*from_arrays", load, other)
    with File(other, "w"):
        pass
    refuses("it holds no dataset; read", load, other)
    refuses("two positive numbers of pixels", load, other, size=(0, 5))


def damaged(tmp_path, format):
    recording = random_recording(16, events=400, frames=2)
    path = tmp_path / f"a.{format}"
    if format == "zip":
        zip_folder(write_text(tmp_path / "text", recording, header=True), path)
    elif format == "npz":
        np.savez_compressed(path, **npz_arrays(recording))
    elif format == "h5":
        save(recording, path, "gzip")
    else:
        MAT_WRITERS[format](path, mat_arrays(recording))
    return path


@pytest.mark.parametrize("format", ["zip", "npz", "h5", "v5", "v7.3"])
def test_cut_files_are_refused(tmp_path, format):
    path = damaged(tmp_path, format)
    content = path.read_bytes()
    for part in (0.01, 0.1, 0.3, 0.5, 0.8, 0.99):
        path.write_bytes(content[: int(part * len(content))])
        assert str(path) in refuses(re.escape(str(path)), load, path)


@pytest.mark.parametrize("format", ["zip", "npz", "v5"])
def test_changed_bytes_are_refused_or_harmless(tmp_path, format):
    path = damaged(tmp_path, format)
    content = path.read_bytes()
    random = np.random.default_rng(0)
    for _ in range(40):
        broken = bytearray(content)
        for at in random.integers(0, len(content), 3):
            broken[at] = random.integers(256)
        path.write_bytes(broken)
        with contextlib.suppress(InputError):
            load(path)


@pytest.mark.slow
def test_importing_is_cheap():
    code = (
        "import sys, jaxevent.io; "
        "sys.exit(any(m in sys.modules for m in ('pandas', 'h5py', 'scipy.io', 'PIL')))"
    )
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


# Output


def test_complete_file(tmp_path):
    target = tmp_path / "a.txt"
    with complete(target) as partial:
        partial.write_text("new")
        assert not target.exists() and partial.parent == tmp_path
    assert target.read_text() == "new"
    with pytest.raises(KeyError), complete(target) as partial:
        partial.write_text("half")
        raise KeyError
    with pytest.raises(InputError, match="a.txt: cannot be written .*No space"):
        with complete(target):
            raise OSError(28, "No space left on device")
    assert target.read_text() == "new" and os.listdir(tmp_path) == ["a.txt"]


def test_complete_directory(tmp_path):
    target = tmp_path / "run"
    for _ in range(2):  # the second time onto an empty directory
        with complete(target, directory=True) as partial:
            (partial / "a").write_text("a")
        assert os.listdir(target) == ["a"]
        (target / "a").unlink()
    (target / "b").write_text("kept")
    with pytest.raises(InputError, match="not empty; choose another or empty it"):
        with complete(target, directory=True):
            pass
    with pytest.raises(KeyError), complete(tmp_path / "other", directory=True) as partial:
        (partial / "a").write_text("a")
        raise KeyError
    assert os.listdir(tmp_path) == ["run"] and os.listdir(target) == ["b"]


def test_complete_refuses_what_cannot_be_written(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    for path, directory, message in (
        (tmp_path, False, "is a folder; give the name of a file"),
        (tmp_path / "file", True, "exists and is not what is to be written"),
        (Path(os.devnull), False, "exists and is not what is to be written"),
        (tmp_path / "file" / "a", False, "file does not exist; create it first"),
    ):
        with pytest.raises(InputError, match=message), complete(path, directory):
            raise AssertionError("must not be entered")

    def denied(*_, **__):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "touch", denied)
    refuses(
        "a.h5: cannot be written .Permission denied",
        save,
        random_recording(17, events=3),
        tmp_path / "a.h5",
    )
    assert os.listdir(tmp_path) == ["file"]


# Real recordings


@pytest.mark.parametrize(
    "name, counts, size, parts",
    [
        ("slider_depth.zip", (1_078_541, 87), (240, 180), "camera poses"),
        ("davis346_street.npz", (78_830, 59), (346, 260), "imu"),
        ("rotating_disk_imu.npz", (374_296, 0), (240, 180), "imu"),
        ("spinning_dot.npz", (539_481, 0), (640, 480), ""),
        ("tubrip_boxes_rotation.npz", (30_000, 0), (240, 180), "camera"),
        ("tubrip_shapes_rotation.npz", (20_000, 0), (240, 180), "camera"),
        ("evbench_seq3.npz", (321_343, 16), (190, 180), ""),
    ],
)
def test_real_recordings(data, tmp_path, name, counts, size, parts):
    recording = load(data / name)
    assert (len(recording.events), len(recording.frames or ())) == counts
    assert (recording.width, recording.height) == size
    for part in ("camera", "poses", "imu"):
        assert (getattr(recording, part) is not None) == (part in parts)
    save(recording, tmp_path / "a.h5")
    assert_same(load(tmp_path / "a.h5"), recording)


def test_real_values(data):
    slider = load(data / "slider_depth.zip")
    first = slider.events[:2]
    assert (first.t.tolist(), first.x.tolist(), first.y.tolist()) == (
        [3811, 3820],
        [96, 127],
        [133, 171],
    )
    assert not first.p.any() and slider.camera.fx == 335.419462958
    assert slider.frames.t[:3].tolist() == [0, 38766, 77531]
    assert slider.poses.position[0].tolist() == [0.1116875, 0, 0]
    street = load(data / "davis346_street.npz")
    with np.load(data / "davis346_street.npz") as stored:
        np.testing.assert_allclose(street.frames.t, stored["frame_t"] * 1e6, atol=1)
    assert (street.frames.exposure == 500).all()


def test_stored_images_are_read_when_asked_for(tmp_path):
    images = np.arange(7 * 3 * 4, dtype=np.uint8).reshape(7, 3, 4)
    frames = Frames(np.arange(7) * 1000 + 5, images, np.zeros(7, np.int64))
    path = tmp_path / "frames.h5"
    io.save(Recording("r", 4, 3, Events.empty(), frames), path)
    stored = io.load(path, in_memory=False).frames
    assert stored is not None and not isinstance(stored.images, np.ndarray)
    odd = stored[1::2]
    np.testing.assert_array_equal(np.asarray(odd.images), images[1::2])
    np.testing.assert_array_equal(np.asarray(odd[1:].images), images[3::2])
    np.testing.assert_array_equal(np.asarray(stored.images[::-1]), images[::-1])
    chosen = stored[np.array([0, 4, 5])]
    np.testing.assert_array_equal(chosen.intensity, images[[0, 4, 5]] / np.float32(255))
    copy = tmp_path / "copy.h5"
    io.save(io.load(path, in_memory=False), copy, compression="gzip")
    again = io.load(copy).frames
    assert again is not None and isinstance(again.images, np.ndarray)
    np.testing.assert_array_equal(again.images, images)


def test_a_recording_is_shown_in_a_line():
    none = Events.empty()
    place = np.zeros(2, np.uint16)
    two = Events(np.array([5, 2_000_000]), place, place, np.zeros(2, bool))
    assert repr(two[1:]) == "<1 event at 2 s>"
    extra = {"hdr": np.zeros(3)}
    shown = repr(Recording("two", 3, 4, two, extra=extra))
    assert shown == "<two: 3x4, 2 events from 0.000005 to 2 s, hdr>"
    many = Recording("many", 3, 4, none, extra=dict.fromkeys("abcd", np.zeros(1)))
    assert repr(many) == "<many: 3x4, 0 events, 4 arrays in extra>"
    assert repr(Recording("none", 3, 4, none)) == "<none: 3x4, 0 events>"


def test_an_imu_may_lack_its_acceleration(tmp_path):
    t, gyro = np.arange(3), np.arange(9.0).reshape(3, 3)
    recording = replace(random_recording(1, 20, 0, False), imu=Imu(t, gyro))
    assert np.isnan(recording.imu.acc).all()
    save(recording, tmp_path / "imu.h5")
    back = io.load(tmp_path / "imu.h5").imu
    np.testing.assert_array_equal(back.gyro, gyro)
    assert back.acc.shape == (3, 3) and np.isnan(back.acc).all()
    with pytest.raises(InputError, match="IMU: gyro is float64 .* must be finite"):
        Imu(t, gyro * np.nan)
    with pytest.raises(InputError, match="IMU: acc is float64 of shape .3,."):
        Imu(t, gyro, np.zeros(3))
