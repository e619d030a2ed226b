import dataclasses

import numpy as np
import pytest
import scipy.stats

from jaxevent import simulate as sim
from jaxevent.errors import InputError

SIZE = (400, 300)
CENTRE = (200, 150)
MOTIONS = {
    "lissajous": sim.LissajousMotion(
        CENTRE, (90, 60), (1.3, 2.1), (0.4, 1.0), theta=0.3, spin=-3.0
    ),
    "line": sim.LinearMotion((50, 60), (220.0, -31.0), spin=1.0),
    "circle": sim.CircularMotion(CENTRE, 70, 5.0, 0.7),
    "approach": sim.ApproachMotion(
        (0.3, -0.2), 6.0, 2.0, (0.3, 0.2), 500.0, CENTRE, acceleration=1.5
    ),
    "walk": sim.RandomWalk((200, 150, 80, -40, 9, 6, 0.2, 1), 1.0, Q_v=1e4, Q_q=9.0, seed=2),
}


def still(**settings):
    values = {"motion": sim.LinearMotion(CENTRE, size=(9, 5), theta=0.6), "rate": 5e4, **settings}
    return sim.Target(**values)


def offsets(truth, source=0):
    """Offsets of a target's events, unrounded, along the two axes of its true state."""
    mine = truth.source == source
    state = truth(truth.t[mine])[:, source]
    e = truth.xi[mine] - state[:, :2]
    c, s = np.cos(state[:, 6]), np.sin(state[:, 6])
    return np.stack([c * e[:, 0] + s * e[:, 1], c * e[:, 1] - s * e[:, 0]], 1), state


@pytest.mark.parametrize("name", MOTIONS)
def test_rates_are_derivatives(name):
    # Away from the ends; those of the walk are rough between its grid times.
    t, h = np.linspace(0.1, 0.9, 173) + 3.3e-5, 1e-6
    motion = MOTIONS[name]
    later, earlier = motion.state(t + h), motion.state(t - h)
    slope = (later - earlier) / (2 * h)
    state = motion.state(t)
    scale = np.abs(state[:, [2, 3, 7]]).max() + 1
    np.testing.assert_allclose(slope[:, [0, 1, 6]], state[:, [2, 3, 7]], atol=2e-4 * scale)


@pytest.mark.parametrize("shape", ["gaussian", "ring", "uniform", "disc"])
@pytest.mark.parametrize("name", ["lissajous", "walk", "approach"])
def test_events_have_the_moments_of_the_true_state(shape, name):
    target = sim.Target(MOTIONS[name], 6e4, shape=shape)
    _, truth = sim.simulate_blobs([target], (4000, 4000), 0.9, seed=3)
    u, state = offsets(truth)
    u = u / state[:, 4:6]
    n = len(u)
    assert abs(n - 6e4 * 0.9) < 5 * np.sqrt(6e4 * 0.9)
    # Standard errors: 1 / sqrt(n) of means and of the correlation; of a second moment at most
    # sqrt(2 / n), that of the Gaussian.
    assert np.abs(u.mean(0)).max() < 5 / np.sqrt(n)
    assert np.abs((u**2).mean(0) - 1).max() < 5 * np.sqrt(2 / n)
    assert abs((u[:, 0] * u[:, 1]).mean()) < 5 / np.sqrt(n)
    fourth = {"gaussian": 3, "ring": 1.5, "uniform": 2, "disc": 6 / 5}[shape]
    assert abs((u[:, 0] ** 4).mean() / fourth - 1) < 5 * 6 / np.sqrt(n)


def test_edges_of_a_disc():
    """Events on a circle, as |cos| of the angle to the heading; ON in front of a bright disc."""
    radius = 12.0
    motion = dataclasses.replace(MOTIONS["circle"], size=(radius * np.sqrt(2 / 3),) * 2)
    recordings = {}
    for bright in (True, False):
        target = sim.Target(motion, 5e4, shape="disc", bright=bright)
        recordings[bright] = sim.simulate_blobs([target], SIZE, 1.0)
    recording, truth = recordings[True]
    u, state = offsets(truth)
    np.testing.assert_allclose(np.hypot(*u.T), radius, rtol=1e-9)
    heading = np.arctan2(state[:, 3], state[:, 2])
    np.testing.assert_allclose(np.cos(state[:, 6] - heading), 1, atol=1e-9)
    np.testing.assert_allclose(state[:, 7], 5.0, rtol=1e-6)
    # The density |cos| / 4: the sine of the angle is uniform; E cos^2 = 2/3, E sin^2 = 1/3.
    assert scipy.stats.kstest(u[:, 1] / radius, scipy.stats.uniform(-1, 2).cdf).pvalue > 1e-3
    np.testing.assert_allclose(state[0, 4:6], [radius * (2 / 3) ** 0.5, radius * (1 / 3) ** 0.5])
    np.testing.assert_array_equal(recording.events.p, u[:, 0] > 0)
    np.testing.assert_array_equal(recordings[False][0].events.p, ~recording.events.p)


def test_events_are_rounded_to_pixels_and_microseconds():
    recording, truth = sim.simulate_blobs([still()], SIZE, 0.5)
    events = recording.events
    assert np.abs(events.t - truth.t * 1e6).max() <= 0.5
    assert np.abs(np.stack([events.x, events.y], 1) - truth.xi).max() <= 0.5
    assert (np.diff(events.t) >= 0).all() and recording.frames is None
    rounding = np.stack([events.x, events.y], 1) - truth.xi
    assert abs(rounding.var() * 12 - 1) < 0.03


def test_labels_say_which_target_made_an_event():
    far = sim.LinearMotion((330, 250), size=(3, 3))
    recording, truth = sim.simulate_blobs(
        [still(), still(motion=far, rate=2e4)], SIZE, 0.5, noise=3e4
    )
    assert len(truth.source) == len(recording.events)
    for source, rate in ((-1, 3e4), (0, 5e4), (1, 2e4)):
        expected = rate * 0.5
        assert abs((truth.source == source).sum() - expected) < 5 * np.sqrt(expected)
    at = np.stack([recording.events.x, recording.events.y], 1)
    assert np.hypot(*(at[truth.source == 1] - [330, 250]).T).max() < 3 * 6
    assert np.hypot(*(at[truth.source == 0] - CENTRE).T).max() < 9 * 6


def test_clutter_is_uniform_in_place_and_time():
    only = still(rate=1.0, dropouts=((-1, 3),))
    recording, _ = sim.simulate_blobs([only], SIZE, 2.0, noise=4e4)
    events = recording.events
    counts, *_ = np.histogram2d(events.x, events.y, [8, 6], [[-0.5, 399.5], [-0.5, 299.5]])
    assert scipy.stats.chisquare(counts.ravel()).pvalue > 1e-3
    assert scipy.stats.chisquare(np.histogram(events.t, 50, (0, 2e6))[0]).pvalue > 1e-3
    for edge in (events.x == 0, events.x == 399):
        assert abs(edge.sum() - 200) < 5 * np.sqrt(200)
    assert abs(events.p.mean() - 0.5) < 5 * 0.5 / np.sqrt(len(events))


def test_drop_outs_are_silent_and_change_nothing_else():
    gaps = ((0.1, 0.15), (0.3, 0.32))
    recording, truth = sim.simulate_blobs([still(dropouts=gaps)], SIZE, 0.5)
    hidden = [((begin <= truth.t) & (truth.t < end)).sum() for begin, end in gaps]
    assert hidden == [0, 0]
    visible = truth.visible(np.array([0.05, 0.1, 0.149, 0.15, 0.31]))
    np.testing.assert_array_equal(visible[:, 0], [True, False, False, True, False])
    expected = 5e4 * 0.43
    assert abs(len(recording.events) - expected) < 5 * np.sqrt(expected)


def test_times_are_a_poisson_process():
    _, truth = sim.simulate_blobs([still()], SIZE, 1.0, seed=5)
    assert scipy.stats.kstest(np.diff(truth.t) * 5e4, "expon").pvalue > 1e-3


def test_a_flickering_light_is_on_and_off_in_turns():
    light = still(flicker=100.0, burst=2e-4)
    recording, truth = sim.simulate_blobs([light], SIZE, 0.5)
    phase = truth.t * 100 % 1
    p = recording.events.p
    # Bursts: the delays after 0 and after half of the period are exponential.
    delay = np.where(p, phase, phase - 0.5) / 100
    assert (delay >= 0).all()
    assert scipy.stats.kstest(delay / 2e-4, "expon").pvalue > 1e-3
    assert abs(len(p) - 2.5e4) < 5 * np.sqrt(2.5e4) and abs(p.mean() - 0.5) < 0.02


def test_recordings_are_deterministic_and_targets_independent():
    def run(targets, **settings):
        return sim.simulate_blobs(targets, SIZE, 0.2, **settings)

    first, truth = run([still(), still(shape="ring")], noise=1e4, seed=4)
    again, _ = run([still(), still(shape="ring")], noise=1e4, seed=4)
    other, others = run([still(), still(shape="ring")], noise=1e4, seed=5)
    alone, alone_truth = run([still()], seed=4)
    for name in "txyp":
        np.testing.assert_array_equal(getattr(first.events, name), getattr(again.events, name))
    for source in (-1, 0, 1):
        mine, theirs = truth.xi[truth.source == source], others.xi[others.source == source]
        assert not np.array_equal(mine[:100], theirs[:100])
    np.testing.assert_array_equal(truth.xi[truth.source == 0], alone_truth.xi)


def test_approach_obeys_the_pinhole():
    motion = MOTIONS["approach"]
    t = np.linspace(0, 1, 11)
    state, depth = motion.state(t), 6 - 2 * t - 1.5 * t**2 / 2
    np.testing.assert_allclose(state[:, 0], 200 + 500 * 0.3 / depth)
    np.testing.assert_allclose(state[:, 1], 150 - 500 * 0.2 / depth)
    np.testing.assert_allclose(state[:, 4], 0.25 * 500 * 0.3 / depth)
    np.testing.assert_allclose(state[:, 5] / state[:, 4], 2 / 3)
    # Inverse time to contact of the motion in the image: p' / (p - centre).
    closing = (2 + 1.5 * t) / depth
    np.testing.assert_allclose(state[:, 2] / (state[:, 0] - 200), closing)


def test_random_walks_spread_as_their_densities_say():
    """What 4,000 stretches of a walk add to its prediction, against the exact covariance."""
    Q = {"Q_p": 5.0, "Q_v": 9e4, "Q_lambda": 2.0, "Q_theta": 3e-3, "Q_q": 50.0}
    start, count = (0.0, 0, 30, -20, 300, 200, 0.1, 0.5), 4000
    walk = sim.RandomWalk(start, count * 0.08, **Q, seed=3, step=0.02)
    t = 0.08 * np.arange(count) + 1e-9
    before = walk.state(t)
    for gap in (0.02, 0.06, 0.0759):  # one step of the grid, three, and between two
        after = walk.state(t + gap)
        added = after - before
        added[:, [0, 1, 6]] -= gap * before[:, [2, 3, 7]]
        expected = np.zeros((8, 8))
        for i, j, wander, change in (
            (0, 2, Q["Q_p"], Q["Q_v"]),
            (1, 3, Q["Q_p"], Q["Q_v"]),
            (6, 7, Q["Q_theta"], Q["Q_q"]),
        ):
            expected[i, i] = wander * gap + change * gap**3 / 3
            expected[i, j] = expected[j, i] = change * gap**2 / 2
            expected[j, j] = change * gap
        expected[4, 4] = expected[5, 5] = Q["Q_lambda"] * gap
        deviation = np.sqrt(np.diag(expected))
        error = (np.cov(added.T) - expected) / np.outer(deviation, deviation)
        # The standard error of a sample covariance is at most sqrt(2 / 4000) = 0.022 of that;
        # between its grid times a walk lacks up to 5 % of its variance.
        assert np.abs(error).max() < 4 * 0.022 + 0.05 * (gap == 0.0759)
        assert np.abs(added.mean(0) / deviation).max() < 4 / np.sqrt(count)
    np.testing.assert_allclose(walk.state(np.zeros(1))[0], start)


def test_sizes_of_a_random_walk_stay_positive():
    walk = sim.RandomWalk((0, 0, 0, 0, 2, 1, 0, 0), 2.0, Q_lambda=50.0, seed=1, step=1e-3)
    sizes = walk.state(np.linspace(0, 2, 500))[:, 4:6]
    assert (sizes > 0).all() and np.isfinite(sizes).all() and np.ptp(np.log(sizes)) > 1


@pytest.mark.parametrize("name", sim.BLOB_SCENES)
def test_scenes_have_truth_for_every_event(name):
    settings = {"rate": 5000.0, **({"Q_q": 1.0} if name == "walk" else {})}
    recording, truth = sim.blob_scene(name, seed=1, **settings)
    state = truth(recording.events.t)
    assert state.shape == (len(recording.events), len(truth.targets), 8)
    assert np.isfinite(state).all() and (state[..., 4:6] > 0).all()
    target = truth.source >= 0
    rows = np.flatnonzero(target)
    miss = truth.xi[rows] - state[rows, truth.source[rows], :2]
    reach = state[rows, truth.source[rows], 4]
    assert (np.hypot(*miss.T) < 6 * reach).all()
    assert target.mean() > (0.4 if name == "noise" else 0.85)


def test_scenes_are_what_they_say():
    def truth(name, **settings):
        return sim.blob_scene(name, rate=100.0, **settings)[1]

    t = np.linspace(0, 1.5, 3001)
    speed = np.hypot(*truth("lissajous")(t)[:, 0, 2:4].T)
    assert 1990 < speed.max() < 2030
    sizes = truth("growing")(np.array([0.0, 1.5]))[:, 0, 4]
    np.testing.assert_allclose(sizes, [60 / 17, 12])
    lights = truth("ttc")(np.array([0.0, 3.45]))
    d = lights[:, 0] - lights[:, 1]
    inverse = (d[:, :2] * d[:, 2:4]).sum(1) / (d[:, :2] ** 2).sum(1)
    np.testing.assert_allclose(inverse, [0.08, 0.67], atol=0.005)
    crossing = truth("crossing", offset=10.0)(0.3)[0]
    np.testing.assert_allclose(crossing[1, :2] - crossing[0, :2], [0, 10], atol=1e-9)
    np.testing.assert_allclose(crossing[0, 2] - crossing[1, 2], 1200)
    flock = truth("flock", stagger=0.01)
    assert flock.visible(0.035).sum() == 4 and len(flock.targets) == 8


def test_impossible_settings_are_named():
    def run(target=None, size=SIZE, duration=0.2, **settings):
        sim.simulate_blobs([still() if target is None else target], size, duration, **settings)

    with pytest.raises(InputError, match="target of 0 events/s"):
        still(rate=0)
    with pytest.raises(InputError, match="did you mean 'disc'"):
        still(shape="disk")
    with pytest.raises(InputError, match="drop-outs"):
        still(dropouts=((0.2, 0.1),))
    with pytest.raises(InputError, match="0.0 s of"):
        run(duration=0.0)
    with pytest.raises(InputError, match="-1.0 background"):
        run(noise=-1.0)
    with pytest.raises(InputError, match="no target"):
        sim.simulate_blobs([], SIZE, 0.2)
    with pytest.raises(InputError, match="size of target 0"):
        run(still(motion=sim.LinearMotion(CENTRE, size=(3, 0))))
    with pytest.raises(InputError, match="size of target 0"):  # reaches the camera
        run(still(motion=dataclasses.replace(MOTIONS["approach"], speed=50.0)))
    with pytest.raises(InputError, match="no event"):
        run(still(motion=sim.LinearMotion((-900, 0))))
    with pytest.raises(InputError, match="8 values"):
        sim.RandomWalk((0, 0), 1.0)
    with pytest.raises(InputError, match="not possible"):
        sim.RandomWalk((0, 0, 0, 0, 1, 0, 0, 0), 1.0)
    with pytest.raises(InputError, match="known from 0 to 0.2"):
        sim.simulate_blobs([still()], SIZE, 0.2)[1](0.3)
    with pytest.raises(InputError, match="did you mean 'crossing'"):
        sim.blob_scene("crosing")
