"""Folders of EVIMO2, written by the layout in tests/formats.py."""

import pickle

import formats
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import refuses

from jaxevent import io
from jaxevent.errors import InputError
from jaxevent.io.checks import ReadOptions
from jaxevent.io.folders import read_evimo
from jaxevent.recording import Events

SIZE = (40, 30)
EVENTS = formats.events_of(3, 500, SIZE)
RANDOM = np.random.default_rng(5)
IMAGES = {i: RANDOM.integers(0, 256, (30, 40, 3)).astype(np.uint8) for i in (0, 1)}
DEPTHS = {i: RANDOM.integers(0, 5000, (30, 40)).astype(np.uint16) for i in (2, 4)}
META = formats.evimo_meta(
    (10_000, 20_000, 35_000), SIZE, [(0, 11_000), (1, 50_000)], [(2, 20_000), (4, 70_000)]
)


@pytest.fixture
def folder(tmp_path):
    return formats.evimo(tmp_path / "scene13_dyn_test_00", EVENTS, META, IMAGES, DEPTHS)


def check_events(events, expected=EVENTS):
    read = events[:]
    # float32 seconds below 0.125 s are within 4 ns.
    for name in "txyp":
        np.testing.assert_array_equal(getattr(read, name), getattr(expected, name))


@pytest.mark.parametrize("in_memory", [True, False])
def test_events_and_numbers_are_read_without_the_pickle(folder, in_memory, monkeypatch):
    def refuse(*words, **options):
        raise AssertionError("something was unpickled")

    monkeypatch.setattr(pickle, "load", refuse)
    recording = io.load(folder, in_memory=in_memory)
    assert (recording.name, recording.width, recording.height) == ("scene13_dyn_test_00", *SIZE)
    check_events(recording.events)
    np.testing.assert_array_equal(recording.extra["K"], [[30, 0, 20], [0, 31, 15], [0, 0, 1]])
    np.testing.assert_array_equal(recording.extra["D"], [-0.1, 0.05, 0, 0])
    assert recording.extra["arrays_left_out"].tolist() == ["meta"]
    assert "2 images in dataset_classical.npz are pickled" in recording.left_out["frames"]
    assert recording.camera is None and recording.poses is None and recording.frames is None


@pytest.mark.parametrize("in_memory", [True, False])
def test_who_trusts_the_pickle_gets_the_truth(folder, in_memory):
    recording = read_evimo(
        folder, ReadOptions(in_memory=in_memory), meta=META, imu="/prophesee/left/imu"
    )
    recording.check()
    check_events(recording.events)
    assert recording.camera.fx == 30 and recording.camera.distortion[2:4] == (0.001, 0.002)
    np.testing.assert_array_equal(recording.poses.t, [10_000, 20_000, 35_000])
    np.testing.assert_allclose(recording.poses.position[:, 0], [0, 0.1, 0.2])
    np.testing.assert_array_equal(recording.poses.quaternion[0], [0.6, 0, 0, 0.8])
    np.testing.assert_array_equal(recording.imu.t, [20_000, 30_000])
    np.testing.assert_array_equal(recording.imu.gyro[0], [-0.1, 0.2, 0.3])
    np.testing.assert_array_equal(recording.frames.t, [11_000, 50_000])
    grey = np.rint(IMAGES[1] @ [0.114, 0.587, 0.299])  # blue, green, red
    np.testing.assert_array_equal(np.asarray(recording.frames.images)[1], grey)
    for name in ("depth", "mask"):
        np.testing.assert_array_equal(recording.extra[f"{name}_t"], [20_000, 70_000])
        images = np.asarray(recording.extra[name], float) * (1000 if name == "depth" else 1)
        np.testing.assert_allclose(images, [DEPTHS[2], DEPTHS[4]], rtol=1e-6)
    assert "arrays_left_out" not in recording.extra


def test_it_can_be_stored_and_columns_may_be_arrays_of_one(folder, tmp_path):
    for name in "tp":
        file = folder / f"dataset_events_{name}.npy"
        np.save(file, np.load(file)[:, None])
    io.save(read_evimo(folder, ReadOptions(in_memory=False), meta=META), tmp_path / "a.h5")
    back = io.load(tmp_path / "a.h5")
    check_events(back.events)
    np.testing.assert_array_equal(back.extra["mask"], [DEPTHS[2], DEPTHS[4]])
    assert len(back.poses) == 3 and len(back.frames) == 2


def test_models_of_distortion(folder):
    fisheye = {**META, "meta": {**META["meta"], "dist_model": "equidistant", "k4": 0.1}}
    camera = read_evimo(folder, meta=fisheye).camera
    assert (camera.model, camera.distortion) == ("equidistant", (-0.1, 0.05, 0.0, 0.1))
    other = read_evimo(folder, meta={**META, "meta": {**META["meta"], "dist_model": "fov"}})
    assert other.camera is None and "'fov'" in other.describe_left_out("camera")


def test_a_folder_of_the_classical_camera(tmp_path):
    folder = formats.evimo(tmp_path / "flea3_7", Events.empty(), META, IMAGES)
    refuses("no event and no frame", io.load, folder, SIZE)
    recording = read_evimo(folder, meta=META).check()
    assert len(recording.frames) == 2 and len(recording.events) == 0


def spoilt(folder, how):
    if how == "no xy":
        (folder / "dataset_events_xy.npy").unlink()
    elif how == "pickled times":
        np.save(folder / "dataset_events_t.npy", np.array([{}], object), allow_pickle=True)
    elif how == "lengths":
        np.save(folder / "dataset_events_p.npy", EVENTS.p[1:])
    elif how == "shape":
        np.save(folder / "dataset_events_xy.npy", np.zeros((500, 3), "u2"))
    elif how == "back":
        np.save(folder / "dataset_events_t.npy", EVENTS.t[::-1] / 1e6)
    elif how == "no archive":
        (folder / "dataset_info.npz").write_bytes(b"PK something")
    elif how == "a bomb":
        zeros = np.zeros((15_000, 12_000), np.uint8)
        np.savez_compressed(folder / "dataset_depth.npz", depth_0000000002=zeros)
    elif how == "no ts":
        return {**META, "frames": [{"id": 0}]}
    return META


@pytest.mark.slow
@pytest.mark.parametrize(
    ("how", "match"),
    [
        ("no xy", "dataset_events_xy.npy"),
        ("pickled times", "dataset_events_t.npy.*cannot be read"),
        ("lengths", "500, 500 and 499"),
        ("shape", r"\(500, 3\)"),
        ("back", "earlier than"),
        ("no archive", "dataset_info.npz"),
        ("a bomb", "claim to hold"),
        ("no ts", "meta: cannot be read .'ts'"),
    ],
)
def test_what_is_wrong_is_refused(folder, how, match):
    meta = spoilt(folder, how)
    assert str(folder) in refuses(match, read_evimo, folder, meta=meta)


FILES = ("events_t.npy", "events_xy.npy", "events_p.npy", "info.npz", "depth.npz")


@pytest.mark.slow
@settings(max_examples=60)
@given(
    name=st.sampled_from(FILES),
    place=st.floats(0, 1),
    how=st.sampled_from(("cut", "byte", "number")),
    value=st.integers(0, 255),
)
def test_damaged_files_are_refused_or_read(name, place, how, value, tmp_path_factory):
    folder = tmp_path_factory.mktemp("evimo") / "a"
    formats.evimo(folder, EVENTS[:50], META, depths=DEPTHS)
    file = folder / f"dataset_{name}"
    content = file.read_bytes()
    at = min(int(place * len(content)), len(content) - 1)
    new = {"cut": b"", "byte": bytes([value]), "number": b"\xff\xff\xff\x7f"}[how]
    after = b"" if how == "cut" else content[at + len(new) :]
    file.write_bytes(content[:at] + new + after)
    for in_memory in (True, False):
        try:
            recording = read_evimo(folder, ReadOptions(in_memory=in_memory), meta=META).check()
            np.asarray(recording.extra.get("depth", 0))
        except InputError as error:
            assert str(folder) in str(error) and "\n" not in str(error)


def test_the_size_must_be_known(tmp_path):
    folder = formats.evimo(tmp_path / "a", EVENTS, META)
    refuses("no image shows the sensor's size", io.load, folder)
    check_events(io.load(folder, SIZE).events)
