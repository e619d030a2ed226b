"""Pickles and copies of methods, parameters, recordings and results."""

import copy
import dataclasses
import functools
import os
import pickle
import subprocess
import sys

import formats
import jax
import numpy as np
import own_filter
import points
import pytest
import texture
from together import assert_equal

import jaxevent
from jaxevent.egomotion import MotionEstimate
from jaxevent.errors import InputError
from jaxevent.estimator import Estimate
from jaxevent.events import crop
from jaxevent.io import decoded
from jaxevent.io.decoded import DecodedEvents, DecodedImages
from jaxevent.io.hdf5 import StoredEvents, StoredImages

# The default thresholds are not those of the texture.
pytestmark = pytest.mark.filterwarnings("ignore:moving. events contradict frames")

COPIES = {
    "pickle": lambda one: pickle.loads(pickle.dumps(one)),
    "deepcopy": copy.deepcopy,
    "copy": copy.copy,
}


@pytest.fixture(params=COPIES)
def again(request, float32):
    """A function that makes a thing anew."""
    return COPIES[request.param]


def assert_same(one, other):
    """Two recordings hold the same."""
    assert (one.name, one.width, one.height) == (other.name, other.width, other.height)
    assert_equal(vars(one.events[:]).values(), vars(other.events[:]).values())
    assert (one.frames is None) == (other.frames is None)
    if one.frames is not None:
        assert_equal(map(np.asarray, vars(one.frames).values()), vars(other.frames).values())


@pytest.mark.parametrize("name", jaxevent.METHODS)
def test_a_method_is_the_same_object(name, again):
    method = jaxevent.METHODS[name]
    assert again(method) is method
    params = method.Params()
    found = again(params)
    assert found.values() == params.values()
    assert jax.tree.structure(found) == jax.tree.structure(params)


def test_methods_of_others(again):
    assert again(jaxevent.METHODS) is jaxevent.METHODS
    assert again(own_filter.trend) is own_filter.trend
    other = dataclasses.replace(own_filter.trend, name="other")
    if again is COPIES["pickle"]:
        with pytest.raises(InputError, match="no module holds it"):
            again(other)
    else:
        assert again(other) is other


@functools.cache
def read_video(name, *options):
    recording, method = texture.moving(), jaxevent.METHODS[name]
    times = recording.frames.t[[5, 1]] + 3000
    video = method.estimate(recording, method.Params(clock_offset=1e-3), **dict(options))
    return video, times, video(times)


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("akf", {"window_events": 3000}),
        ("aks", {"window_events": 3000}),
        ("flow", {}),
        pytest.param("edi", {"compiler": "xla"}, marks=pytest.mark.slow),
        pytest.param("mc", {"refine": False}, marks=pytest.mark.slow),
    ],
)
def test_videos(name, options, again):
    if name == "flow":
        pytest.importorskip("cv2")
    video, times, images = read_video(name, *options.items())
    other = again(video)
    assert type(other) is type(video) and other.estimator is jaxevent.METHODS[name]
    assert_equal(other(times), images)
    assert isinstance(images, Estimate)
    assert_equal(again(images), images)


@functools.cache
def prepared(name):
    recording, method = texture.moving()[0.0:0.1], jaxevent.METHODS[name]
    images, params = (
        method.prepare_images(recording, recording.frames.t[:3]),
        method.Params(c_on=0.013),
    )
    true = [np.asarray(part)[[2, 0]] for part in images(params)]
    return images.take(np.array([2, 0])), params, true


@pytest.mark.parametrize("name", ["akf", "aks"])
def test_images_as_functions_of_parameters(name, again):
    images, params, true = prepared(name)
    assert_equal(again(images)(params), true)


def test_tracks(again):
    recording = texture.moving()[0.0:0.08]
    times = np.linspace(10_000, 70_000, 5).astype(int)
    tracks = jaxevent.blob.moment.estimate(recording, seeds=[(5, 5, 2), (12, 9, 3)])
    before = again(tracks)
    states = tracks(times)
    for other in (before, again(tracks)):
        assert_equal(vars(other(times)).values(), vars(states).values())
        assert_equal((other.birth, other.death), (tracks.birth, tracks.death))
        assert_equal(other.filtered(times), tracks.filtered(times))
    assert_equal(vars(again(states)).values(), vars(states).values())


@functools.cache
def found_targets():
    return jaxevent.blob.find(texture.moving())


@pytest.mark.slow
def test_what_was_found(again):
    found = found_targets()
    assert again(found).summary() == found.summary()


def test_motion(again):
    camera = jaxevent.camera.PinholeCamera(100.0, 100.0, 59.5, 44.5)
    recording = points.moved(points.turning([0.3, 0.2, 0.1]), 0.1, 300, 0, camera=camera)
    times = np.linspace(recording.start, recording.stop, 5).astype(int)
    mean, covariance = np.arange(15.0).reshape(5, 3), np.tile(np.eye(3), (5, 1, 1))
    motion = MotionEstimate.from_arrays("rotation", times, mean, covariance)
    motion = motion.with_recording(recording)
    assert_equal(again(motion)(times), motion(times))
    assert again(motion).model is motion.model


def test_streams_say_what_to_keep(again):
    lives = [jaxevent.akf.live((20, 16), frames=False), jaxevent.blob.moment.live((20, 16))]
    for live in lives:
        with pytest.raises(InputError, match=r"keep .* live\(times\)"):
            again(live)


def test_recordings_in_memory(again):
    recording = texture.moving()
    assert_same(again(recording), recording)
    part = crop(recording, 2, 3, 10, 8)
    assert_same(again(part), part)


def test_recordings_in_hdf5(tmp_path, monkeypatch, again):
    recording = texture.moving()
    jaxevent.save(recording, tmp_path / "a.h5")
    monkeypatch.chdir(tmp_path)
    stored = jaxevent.load("a.h5", in_memory=False)
    monkeypatch.chdir("/")
    found = again(stored)
    assert isinstance(found.events, StoredEvents) and isinstance(found.frames.images, StoredImages)
    assert_same(found, recording)
    for rows in (slice(3, 12, 2), np.array([1, 7])):
        some = again(stored.with_frames(rows).frames)
        assert isinstance(some.images, StoredImages)
        assert_equal(map(np.asarray, vars(some).values()), vars(recording.frames[rows]).values())
    assert_same(again(stored[0.1:0.2]), recording[0.1:0.2])
    # Changed as they are read: what is shown is held.
    part = again(crop(stored, 2, 3, 10, 8))
    assert_same(part, crop(recording, 2, 3, 10, 8))


@pytest.mark.parametrize("kind", ["dat", "h5"])
def test_recordings_that_are_decoded(tmp_path, monkeypatch, kind, again):
    whole = texture.moving()
    size, path = (whole.width, whole.height), tmp_path / f"a.{kind}"
    if kind == "dat":
        monkeypatch.setattr(decoded, "BLOCK_EVENTS", 500)
        path.write_bytes(formats.dat(whole.events, size))
    else:
        frames = whole.frames
        path.write_bytes(formats.event_utils(whole.events, size, frames.images, frames.t))
    found = again(jaxevent.load(path, size=size, in_memory=False))
    assert_same(found, jaxevent.load(path, size))
    if kind == "dat":
        assert isinstance(found.events, DecodedEvents)
    else:
        assert isinstance(found.frames.images, DecodedImages)


def test_files_that_changed_are_named(tmp_path):
    recording, path = texture.moving(), tmp_path / "a.h5"
    jaxevent.save(recording, path)
    stored = pickle.dumps(jaxevent.load(path, in_memory=False))
    images = pickle.dumps(jaxevent.load(path, in_memory=False).frames.images)
    jaxevent.save(recording[0.0:0.2], path)
    with pytest.raises(InputError, match=f"{path}: no longer holds the events"):
        pickle.loads(stored)
    with pytest.raises(InputError, match=f"{path}: no longer holds the frames"):
        pickle.loads(images)
    os.unlink(path)
    with pytest.raises(InputError, match=f"{path}: there is no such file"):
        pickle.loads(stored)


@pytest.mark.slow
def test_another_process_reads_them(tmp_path, float32):
    recording = texture.moving()
    jaxevent.save(recording, tmp_path / "a.h5")
    stored = jaxevent.load(tmp_path / "a.h5", in_memory=False)
    video, time = jaxevent.akf.estimate(stored), int(recording.frames.t[4])
    (tmp_path / "video").write_bytes(pickle.dumps(video))
    program = (
        "import pathlib, pickle, sys; folder = pathlib.Path(sys.argv[1]);"
        "video = pickle.loads((folder / 'video').read_bytes());"
        "(folder / 'images').write_bytes(pickle.dumps(video(int(sys.argv[2]))))"
    )
    subprocess.run([sys.executable, "-c", program, tmp_path, str(time)], check=True)
    assert_equal(pickle.loads((tmp_path / "images").read_bytes()), video(time))
