"""Targets before a scene that moves past the camera, and the scene's motion against the truth."""

import dataclasses

import numpy as np
import pytest

from jaxevent import blob
from jaxevent.blob.search.background import Background, SceneMotion, move_places
from jaxevent.blob.search.paths import TargetPath
from jaxevent.blob.search.scene import (
    _required_gain,
    drop_edges,
    has_own_motion,
    map_gain,
    measure_moving_background,
    measure_scene_motion,
    split_at_pauses,
)
from jaxevent.blob.search.stream import Stream
from jaxevent.recording import Events, Recording
from jaxevent.simulate import Sensor, motion_scene
from jaxevent.simulate.blobs import CircularMotion, LinearMotion, Target, simulate_blobs

FRAME, DURATION = (128, 96), 0.8
SIZE = np.array(FRAME)
SHIFT, TURN = np.array([60.0, -25.0]), 0.3  # px/s, rad/s about the sensor's middle


def maps(t):
    """(times, 2, 3), of px at the start."""
    c, s = np.cos(TURN * t), np.sin(TURN * t)
    R = np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], -2)
    middle = (SIZE - 1) / 2
    b = middle + SHIFT * t[:, None] - np.einsum("nij,j->ni", R, middle)
    return np.concatenate([R, b[..., None]], 2)


def shaking(t):
    """(times, 2, 3): 3 px to and fro at 7 Hz."""
    M = np.tile(np.eye(2, 3), (len(t), 1, 1))
    M[:, :, 2] = 3 * np.sin(2 * np.pi * 7 * t)[:, None] * [0.8, 0.6]
    return M


def seen_by_a_moving_camera(recording, seed=0, rate=1e6, maps=maps, begin=0.0):
    """A recording with the events of 150 edges that go as `maps` tells, from `begin` (s) on."""
    rng = np.random.default_rng(seed)
    n = rng.poisson(rate * DURATION)
    a = rng.uniform(-SIZE, 2 * SIZE, (150, 2))
    angle = rng.uniform(0, np.pi, 150)
    d = np.stack([np.cos(angle), np.sin(angle)], 1) * rng.uniform(10, 40, (150, 1))
    k, t = rng.integers(0, 150, n), rng.uniform(0, DURATION, n)
    there = a[k] + rng.random((n, 1)) * d[k]
    M = maps(t)
    xi = np.rint(np.einsum("nij,nj->ni", M[:, :, :2], there) + M[:, :, 2])
    inside = ((xi >= 0) & (xi < SIZE)).all(1) & (t >= begin)
    own = recording.events[:]
    x, y = xi[inside].astype(np.uint16).T
    us = np.concatenate([own.t, (t[inside] * 1e6).astype(np.int64)])
    order = np.argsort(us, kind="stable")
    x, y = np.concatenate([own.x, x])[order], np.concatenate([own.y, y])[order]
    p = np.concatenate([own.p, rng.random(len(us) - len(own)) < 0.5])[order]
    return Recording("moving", *FRAME, Events(us[order], x, y, p))


def before_noise(targets, seed=0, noise=2e3):
    far = Target(LinearMotion((-500.0, -500.0), size=(1.0, 1.0)), 1.0)  # never seen
    return simulate_blobs([*targets, far], FRAME, DURATION, noise, seed)


@pytest.mark.slow
def test_the_scene_goes_as_it_was_made_to():
    recording = seen_by_a_moving_camera(before_noise([])[0], rate=4e5)
    scene = measure_scene_motion(Stream(recording, 0, 500_000), 0.01)
    corners = np.array([[0, 0], [127, 0], [0, 95], [127, 95]], float)
    # Its places are px of the first window, whose middle is 5 ms after the start.
    first = maps(scene.t[:1])[0]
    start = (corners - first[:, 2]) @ np.linalg.inv(first[:, :2]).T
    true = maps(scene.t)
    moved = np.einsum("nij,kj->nki", true[:, :, :2], start) + true[:, None, :, 2]
    for k, corner in enumerate(corners):
        x, y = move_places(scene.maps, *corner)
        assert np.hypot(*(np.stack([x, y], 1) - moved[:, k]).T).max() < 2.5
        np.testing.assert_allclose(
            np.stack(move_places(scene.to_scene(scene.t), x, y), 1),
            np.broadcast_to(corner, moved[:, k].shape),
            atol=1e-9,
        )
    assert scene.travel == pytest.approx(np.hypot(*SHIFT) * 0.5, rel=0.3)
    # So it does where it hardly leaves its place.
    part = blob.find(recording, 0.3, 0.4, progress=False)
    assert part.camera_moves and not len(part)


def test_a_moving_map_holds_the_rates_of_places():
    """Of a scene of even rate: that rate, whatever part of the time a place is seen."""
    recording, _ = before_noise([], 1, 4e5)
    t = np.linspace(0, DURATION, 9)
    M = np.tile(np.eye(2, 3), (9, 1, 1))
    M[:, 0, 2] = 100 * t
    background = measure_moving_background(Stream(recording, 0, 800_000), SceneMotion(t, M))
    true = 4e5 / SIZE.prod()
    assert background.mean_rate == pytest.approx(true, rel=0.15)
    y, x = np.mgrid[42:54, 2:126]
    for time in np.linspace(0, 0.79, 5):
        assert background.rate_at(x, y, time).mean() == pytest.approx(true, rel=0.1)


def test_what_moves_two_ways_is_no_scene():
    """A map that goes as one half of the sensor does gains there, and loses in the other."""

    def back(t):
        return maps(-t)

    one, other = (
        seen_by_a_moving_camera(before_noise([])[0], rate=4e5, maps=way).events[:]
        for way in (maps, back)
    )
    parts = one[one.x < 64], other[other.x >= 64]
    columns = [np.concatenate([getattr(part, k) for part in parts]) for k in "txyp"]
    order = np.argsort(columns[0], kind="stable")
    halves = Events(*(column[order] for column in columns))
    gains = []
    for events in (one, halves):
        stream = Stream(Recording("moving", *FRAME, events), 0, 300_000)
        t = np.linspace(0, 0.3, 31)
        moving = measure_moving_background(stream, SceneMotion(t, maps(t)))
        gains.append(map_gain(stream, moving, 0.01))
    assert gains[0] > 0 and gains[1] == -np.inf


def test_what_another_depth_does_is_no_own_way():
    """The scene goes right at 100 px/s: others go faster, slower, across and against it."""
    t = np.linspace(0, 1, 51)
    M = np.tile(np.eye(2, 3), (51, 1, 1))
    M[:, 0, 2] = 100 * t
    scene = SceneMotion(t, M)
    C = np.tile(9.0 * np.eye(2), (51, 1, 1))
    for v, own in (((100, 0), 0), ((250, 0), 0), ((20, 0), 0), ((100, 60), 1), ((-60, 0), 1)):
        p = np.array([60.0, 50]) + t[:, None] * v
        us = 5_000_000 + np.rint(t * 1e6).astype(np.int64)
        path = TargetPath(us, p, np.zeros_like(p), C, np.full(51, 30.0), 20_000, 1.0)
        assert has_own_motion(path, scene, 5_000_000) == bool(own)
        # What leaves its way by its size in every window is none.
        astray = dataclasses.replace(path, velocity_noise=3 * 9.0 / 0.02**3)
        assert not has_own_motion(astray, scene, 5_000_000)


@pytest.mark.slow
def test_only_what_goes_its_own_way_is_a_target():
    """While the camera moves, and before it begins to."""
    own = CircularMotion((64, 48), 28, 8.0, size=(4.0, 3.0))
    recording, truth = before_noise([Target(own, 3e4)])
    found = blob.find(seen_by_a_moving_camera(recording, begin=0.3), progress=False)
    assert found.camera_moves and "the camera moves" in found.summary()
    assert found.paths[0].begin < 20_000 and len(found) <= 2
    assert sum(path.end - path.begin for path in found.paths) > 0.9 * DURATION * 1e6
    for path in found.paths:
        assert np.median(np.hypot(*(path.p - truth(path.t)[:, 0, :2]).T)) < 2


@pytest.mark.slow
def test_of_a_camera_that_shakes_it_is_said_that_it_moves():
    recording = seen_by_a_moving_camera(before_noise([])[0], 2, rate=4e5, maps=shaking)
    found = blob.find(recording, stop=0.4, progress=False)
    assert found.camera_moves and not len(found)


def test_pauses_are_told_by_most_of_the_sensor():
    ones = np.ones((6, 8))
    background = Background(ones, ones[None] > 0, ones < 0, np.ones(64), 6.4)
    assert split_at_pauses(background) == [(0.0, 6.4)]
    level = np.repeat([0.8, 0.05, 0.7], [20, 24, 20])
    level[[5, 30]], level[-7:] = (0.1, 0.7), 0.1  # what is short is none
    told = split_at_pauses(dataclasses.replace(background, level=level))
    np.testing.assert_allclose(told, [(0, 2), (2, 4.4), (4.4, 6.4)])
    # Nor is there one where most of the sensor never sees much.
    assert len(split_at_pauses(dataclasses.replace(background, level=level / 4))) == 1


def test_noise_of_few_events_is_no_scene():
    """Bright cells lie side by side by chance; those of a scene lie along its lines."""
    rng = np.random.default_rng(0)
    lines = np.where(np.arange(180) % 12 == 0, 1.0, 0.0) * np.ones((320, 1))
    for mean in (0.5, 1.0, 2.0):
        for rate, scene in ((np.full(lines.shape, mean), False), (12 * mean * lines, True)):
            rate = rng.poisson(rate) / 16  # px, for 1 s
            seen = np.ones((1, 80, 45), bool)
            one = Background(rate, seen, seen[0], np.ones(1), 1.0)
            assert (_required_gain(one) is not None) == scene


@pytest.mark.slow
def test_targets_that_go_together_are_no_scene():
    rng = np.random.default_rng(2)
    places = np.stack(np.meshgrid(np.arange(-30, 128, 24), np.arange(8, 110, 24)), -1)
    targets = [
        Target(
            LinearMotion(tuple(p + rng.uniform(-5, 5, 2)), (30.0, -4.0), size=(1.5, 1.2)), 1500.0
        )
        for p in places.reshape(-1, 2)
    ]
    recording, _ = before_noise(targets)
    found = blob.find(recording, progress=False)
    assert not found.camera_moves and len(found) > 15


def test_stars_side_by_side_are_no_edges():
    rate = np.full((180, 320), 10.0)
    one = Background(rate, np.ones((1, 45, 80)) > 0, rate < 0, np.ones(1), 1.0)
    rate[10::20, 10::24] = rate[10::20, 12::24] = 200.0  # each of two cells, 8 px apart
    rate[10::20, 11::24] = 30.0  # and some of both between them
    assert _required_gain(one) is None
    rate[10::20, 10::24] = rate[10::20, 16::24] = 200.0  # 24 px long
    for k in range(12, 16):
        rate[10::20, k::24] = 200.0
    assert _required_gain(one) is not None


def test_edges_of_a_scene_that_hardly_moves_are_no_targets():
    """A wall of shapes that goes 4 px: a piece of an edge has one polarity."""
    recording, _ = motion_scene(
        "planar", "varying", 555, size=(144, 108), duration=0.1, speed=40.0, texture="shapes",
        sensor=Sensor(),
    )  # fmt: skip
    found = blob.find(recording, progress=False)
    assert not len(found) and found.full


def test_two_edges_may_be_an_object():
    """More of both polarities, or a scene about them, make a scene."""
    t = np.arange(4) * 10_000
    p = np.stack([np.arange(4.0), np.zeros(4)], 1)
    round_one, across = np.tile(np.eye(2), (4, 1, 1)), np.tile(np.diag([1.0, 9.0]), (4, 1, 1))
    star, whole, on, off = (
        TargetPath(t, p, p, C, np.full(4, 30.0), 10_000, 1.0, balance=balance)
        for C, balance in ((round_one, 0.95), (across, 0.3), (across, 0.95), (across, -0.95))
    )
    for kept in ([star, whole, on, off], [star, on, on, on, whole]):
        assert drop_edges(kept, covered=False) == kept
        assert drop_edges(kept, covered=True) == [whole]
    assert drop_edges([on, star, whole, off, on], covered=False) == [star, whole]
