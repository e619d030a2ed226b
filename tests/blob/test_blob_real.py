"""Blob tracking on real recordings, short slices, against references made without the tracker."""

import numpy as np
import pytest
from scripts import script

import jaxevent
from jaxevent.blob import Tracks, moment
from jaxevent.blob.engine.runner import KernelRunner
from jaxevent.blob.prepare import ChunkPacker
from jaxevent.recording import Events, Recording


@pytest.fixture(scope="module")
def real():
    """The experiment; its references are what these tests compare with."""
    return script("blob_real")


@pytest.fixture(scope="module")
def dot(data):
    return jaxevent.load(data / "spinning_dot.npz")


def follow(recording, params, steps, chunks):
    """`estimate` with chunks of a size that suits short slices."""
    packer = ChunkPacker(recording, params, steps=steps, chunks=chunks)
    return Tracks(KernelRunner(moment.filter, params, detect=packer.detect), packer)


def test_reference_finds_a_known_path(real):
    # Events of a known ellipse, turned by 0.1 rad against its travel, on a known circle.
    rng = np.random.default_rng(0)
    t = np.sort(rng.uniform(0, 0.05, 100_000))
    angle = 2 * np.pi * 19.3 * t + 1
    u = rng.normal(size=(2, len(t))) * [[12.0], [7.0]]
    heading = angle + np.pi / 2 + 0.1
    x = 314 + 107 * np.cos(angle) + np.cos(heading) * u[0] - np.sin(heading) * u[1]
    y = 202 + 107 * np.sin(angle) + np.sin(heading) * u[0] + np.cos(heading) * u[1]
    xi = np.rint([x, y]).astype(np.uint16)
    events = Events(np.rint(t * 1e6).astype(np.int64), xi[0], xi[1], t > 0)
    path = real.fit_circular_path(Recording("circle", 640, 480, events))
    assert path.omega == pytest.approx(2 * np.pi * 19.3, rel=1e-3)
    np.testing.assert_allclose(path.terms[0], [314, 202], atol=0.2)
    # A circle of 3 lambda1 leaves out 1 % of the variance along the longer axis or more.
    np.testing.assert_allclose(path.size, [12, 7], rtol=0.03)
    assert path.turned == pytest.approx(0.1, abs=0.02)


@pytest.mark.slow
def test_spinning_dot_is_found_and_followed(real, dot, float32):
    path = real.fit_circular_path(dot)
    cut = dot[0:10_000]
    tracks = follow(cut, moment.Params(preset="fast", **real.DOT_FOUND), 64, 128)
    assert len(tracks) == 1  # not its tail, no hot pixel
    row = real.score_dot(tracks, path, (0.004, 0.01))
    assert row["tracked"] == 1
    assert row["rmse"] < 1
    assert abs(row["velocity"]) < 0.03
    assert abs(row["velocity_circle"]) < 0.03
    assert abs(row["direction"]) < 4
    assert abs(row["lambda1"]) < 0.03
    assert abs(row["lambda2"]) < 0.03
    assert row["theta"] < 2


@pytest.mark.slow
def test_tail_of_the_dot_begins_no_track(real, dot, float32):
    cut = dot[0:20_000]
    begun = {}
    for surround in (1.0, 2.0):
        params = moment.Params(preset="fast", **real.DOT_FOUND, surround=surround)
        packer = ChunkPacker(cut, params, steps=64, chunks=128)
        runner = KernelRunner(moment.filter, params, detect=True)
        cursor, state = packer.first, None
        while cursor is not None:
            segment = packer.pack(cursor)
            state = runner.init(segment.features) if state is None else state
            state, _ = runner.run(state, segment.features)
            cursor = segment.next
        begun[surround] = int(state.next_id)
    assert begun[2.0] == 1 < begun[1.0]


@pytest.mark.slow
def test_cars_are_found_and_followed(real, data, float32):
    recording = jaxevent.load(data / "davis346_street.npz")
    cars = real.find_cars(np.asarray(recording.frames.images))
    assert len(cars) == 3
    cut = recording.with_frames(slice(0))[0:500_000]
    tracks = follow(cut, moment.Params(**real.STREET), 64, 128)
    row = real.score_cars(tracks, cars, recording.frames.t, (0.1, 0.5))
    assert row["tracks"] == 2
    assert row["coverage"] == 1
    assert row["median"] < 4
    assert row["switches"] == row["strays"] == 0
