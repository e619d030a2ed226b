"""What turns in its place, against what it was made to do."""

import numpy as np
import pytest

from jaxevent import blob
from jaxevent.blob.search.background import measure_background
from jaxevent.blob.search.merge import _events_within
from jaxevent.blob.search.scene import measure_scene_motion
from jaxevent.blob.search.stream import Stream
from jaxevent.recording import Events, Recording

FRAME, DURATION, HUB, RADIUS, OMEGA = (96, 80), 0.6, np.array([50.0, 38.0]), 22, -14.0


def turned(places, per_place, blur, seed=0, noise=2e3):
    """A recording of places (n, 2) px about the hub that turn about it and send events."""
    rng = np.random.default_rng(seed)
    n = rng.poisson(per_place * len(places) * DURATION)
    t = rng.uniform(0, DURATION, n)
    at = places[rng.integers(0, len(places), n)] + blur * rng.normal(size=(n, 2))
    c, s = np.cos(OMEGA * t), np.sin(OMEGA * t)
    xi = HUB + np.stack([c * at[:, 0] - s * at[:, 1], s * at[:, 0] + c * at[:, 1]], 1)
    n = rng.poisson(noise * DURATION)
    t = np.concatenate([t, rng.uniform(0, DURATION, n)])
    x, y = np.rint(np.concatenate([xi, rng.uniform(0, np.array(FRAME) - 1, (n, 2))])).T
    order = np.argsort(t, kind="stable")
    us, p = (1e6 * t[order]).astype(np.int64), rng.random(len(t)) < 0.5
    return Recording(
        "turning", *FRAME, Events(us, *(v[order].astype(np.uint16) for v in (x, y)), p)
    )


def texture(rng):
    """Places of a disc, more of them where a soft texture is bright."""
    places = rng.uniform(-RADIUS, RADIUS, (6000, 2))
    waves = rng.normal(size=(12, 2)) * 0.35
    bright = np.cos(places @ waves.T + rng.uniform(0, 6, 12)).sum(1)
    return places[(np.hypot(*places.T) < RADIUS) & (bright > rng.normal(size=6000))]


@pytest.mark.slow
def test_a_textured_disc_that_turns_in_its_place_is_one():
    disc = turned(texture(np.random.default_rng(1)), 60, 0.3)
    found = blob.find(disc, progress=False)
    (path,) = found.paths
    assert path.turn_rate == pytest.approx(OMEGA, rel=0.01)
    assert "1 turns in place at -14 rad/s" in found.summary()
    assert np.hypot(*(path.p - HUB).T).max() < 1
    assert path.end - path.begin > 0.95 * DURATION * 1e6
    # A full disc's deviation along each axis is half of its radius.
    np.testing.assert_allclose(np.median(path.size, 0), RADIUS / 2, rtol=0.2)


@pytest.mark.slow
def test_blobs_that_circle_about_one_point_are_as_many_as_they_are():
    angle = 2 * np.pi * np.arange(5) / 5
    places = RADIUS * np.stack([np.cos(angle), np.sin(angle)], 1)
    found = blob.find(turned(places, 8e3, 2.0), progress=False)
    assert len(found) == 5 and all(path.turn_rate is None for path in found.paths)


def test_the_turn_of_events_is_what_it_was_made():
    disc = turned(texture(np.random.default_rng(2)), 60, 0.3, seed=1)
    stream = Stream(disc, 0, round(1e6 * DURATION))
    bright = measure_background(stream).rate
    own = _events_within(stream, bright > 4 * np.median(bright))
    scene = measure_scene_motion(own, 0.006)
    turns, shifts = scene.maps[:, :, :2], scene.maps[:, :, 2]
    np.testing.assert_allclose(
        turns @ turns.swapaxes(1, 2), np.tile(np.eye(2), (100, 1, 1)), atol=1e-9
    )
    angle = np.unwrap(np.arctan2(turns[:, 1, 0], turns[:, 0, 0]))
    np.testing.assert_allclose(angle, OMEGA * (scene.t - scene.t[0]), atol=0.05)
    np.testing.assert_allclose(turns @ HUB + shifts, np.tile(HUB, (100, 1)), atol=1)
