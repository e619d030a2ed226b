import subprocess

import h5py
import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from PIL import Image

from jaxevent import blob, simulate
from jaxevent.blob import quantities
from jaxevent.errors import InputError
from jaxevent.recording import Events, Recording
from jaxevent.show import track_figures as pictures
from jaxevent.show.images import video_writer
from jaxevent.show.track_figures import write_track_plot
from jaxevent.show.track_tables import STATE_COLUMNS, track_writer
from jaxevent.simulate.blobs import CAR_MOTIONS, blob_scene

RNG = np.random.default_rng
INVERSE_TTC = jax.jit(quantities.inverse_ttc)


def covariance(rng, *shape, scale=1.0):
    root = rng.normal(size=(*shape, 8, 8)) * scale
    return root @ np.swapaxes(root, -1, -2)


def lights(speed=3.0, depth=10.0):
    """Two lights 1.4 m apart at `depth` m that come nearer at `speed` m/s, focal length 1000 px."""
    mean = np.zeros((2, 8))
    x = np.array([[-0.7, 0.2], [0.7, 0.3]])
    mean[:, :2] = 1000 * x / depth
    mean[:, 2:4] = 1000 * x * speed / depth**2
    mean[:, 4:6] = 10, 5
    return mean


def gradient(function, x, step):
    """Central differences of a scalar function."""
    return np.array([(function(x + e) - function(x - e)) / (2 * step) for e in step * np.eye(8)])


def test_inverse_ttc_takes_batches_and_either_order():
    rng = RNG(0)
    mean, P = jnp.array(rng.normal(size=(2, 5, 8)) * 50), jnp.array(covariance(rng, 2, 5))
    value, variance = INVERSE_TTC(mean[0], P[0], mean[1], P[1])
    swapped = INVERSE_TTC(mean[1], P[1], mean[0], P[0])
    np.testing.assert_allclose(swapped, (value, variance), rtol=1e-12)
    for k in range(5):
        one = INVERSE_TTC(mean[0, k], P[0, k], mean[1, k], P[1, k])
        np.testing.assert_allclose(one, (value[k], variance[k]), rtol=1e-12)
    for speed in (3.0, -3.0):
        a, b = jnp.array(lights(speed))
        value, variance = INVERSE_TTC(a, 0 * P[0, 0], b, 0 * P[0, 0])
        assert abs(float(value) - speed / 10) < 1e-12 and float(variance) == 0


def test_variance_of_inverse_ttc_is_that_of_finite_differences():
    rng = RNG(1)
    a, b = rng.normal(size=(2, 8)) * 30
    Pa, Pb = covariance(rng, 2)
    zero = jnp.zeros((8, 8))

    def value(a, b):
        return float(INVERSE_TTC(jnp.array(a), zero, jnp.array(b), zero)[0])

    ga, gb = gradient(lambda x: value(x, b), a, 1e-5), gradient(lambda x: value(a, x), b, 1e-5)
    _, variance = INVERSE_TTC(*map(jnp.array, (a, Pa, b, Pb)))
    np.testing.assert_allclose(float(variance), ga @ Pa @ ga + gb @ Pb @ gb, rtol=1e-6)


@pytest.mark.slow
def test_three_cars_tell_their_times_to_contact():
    """Six lights at once; of each event of a car its inverse time to contact."""
    recording, truth = blob_scene("cars", 2, rate=2e3)
    seeds = [(*state[:2], 6.0) for state in truth(0.0)[0]]
    params = blob.constant_velocity.Params(
        preset="ttc", lambda0=6.0, events_per_step=8, P0_p=1.0, P0_v=1e4
    )
    tracks = blob.constant_velocity.estimate(recording, params, seeds=seeds, progress=False)
    target_of = np.concatenate([one.id for one in tracks.events()])
    t = np.concatenate([one.t for one in tracks.events()])
    for car, (_, distance, speed, acceleration) in enumerate(CAR_MOTIONS):
        pair = 2 * car, 2 * car + 1
        times = t[np.isin(target_of, pair)]
        assert len(times) > 0.95 * 2 * 2e3 * truth.duration
        times = times[(times > 300_000) & (times < 1_700_000)][::20]
        states = tracks(times, pair)
        assert states.valid.all()
        parts = states.mean, states.covariance
        result = (jnp.asarray(part[:, k]) for k in (0, 1) for part in parts)
        value, variance = (np.asarray(part) for part in INVERSE_TTC(*result))
        s = times * 1e-6
        true = (speed + acceleration * s) / (distance - speed * s - acceleration * s**2 / 2)
        assert np.abs(value - true).max() < 0.06
        assert np.sqrt(((value - true) ** 2).mean()) < 0.025
        assert ((value - true) ** 2 / variance).mean() < 2


def test_blobs_in_one_place_say_nothing_of_contact():
    mean, P = jnp.ones(8), jnp.eye(8)
    value, variance = INVERSE_TTC(mean, P, mean, P)
    assert float(value) == 0 and float(variance) == np.inf
    slope = jax.jit(jax.grad(lambda m: quantities.inverse_ttc(m, P, mean, P)[0]))(mean)
    assert np.isfinite(slope).all()


def test_log_size_does_not_depend_on_the_order_of_the_axes():
    rng = RNG(3)
    mean, P = rng.uniform(2, 9, 8), covariance(rng, scale=0.1)
    value, variance = quantities.log_size(jnp.array(mean), jnp.array(P))
    zero = jnp.zeros((8, 8))
    g = gradient(lambda x: float(quantities.log_size(jnp.array(x), zero)[0]), mean, 1e-6)
    assert abs(float(value) - np.log(mean[4] * mean[5]) / 2) < 1e-12
    np.testing.assert_allclose(float(variance), g @ P @ g, rtol=1e-7)
    swap = [0, 1, 2, 3, 5, 4, 6, 7]
    other = quantities.log_size(jnp.array(mean[swap]), jnp.array(P[np.ix_(swap, swap)]))
    np.testing.assert_allclose(other, (value, variance), rtol=1e-12)


def approach(times, speed=8.0, depth=17.0, size=60.0):
    """Means of a blob (size / Z, size / 2 Z) px, and the true inverse time to contact."""
    Z = depth - speed * times
    mean = np.zeros((len(times), 8))
    mean[:, 4], mean[:, 5] = size / Z, size / Z / 2
    return mean, speed / Z


def sized(times, relative):
    """Covariances with independent errors of the sizes, of the given relative deviation."""
    mean, _ = approach(times)
    P = np.zeros((len(times), 8, 8))
    P[:, 4, 4], P[:, 5, 5] = ((relative * mean[:, i]) ** 2 for i in (4, 5))
    return P


def grow(times, mean, P, valid=None, **settings):
    """Growth of one signature, so that it is compiled once."""
    valid = np.ones(len(times), bool) if valid is None else valid
    settings = {"Q": 0.0, "smooth": True, **settings}
    return quantities.inverse_ttc_from_size(*map(jnp.asarray, (times, mean, P, valid)), **settings)


def test_inverse_ttc_from_size_without_speed_changes_is_the_least_squares_line():
    rng = RNG(4)
    times = np.sort(rng.uniform(0, 1.5, 50))
    mean, _ = approach(times)
    mean[:, 4:6] *= np.exp(0.02 * rng.normal(size=(50, 2)))
    P = sized(times, 0.02)
    value, variance = grow(times, mean, P)
    w = 1 / np.sqrt(mean[:, 4] * mean[:, 5])
    relative = (P[:, 4, 4] / mean[:, 4] ** 2 + P[:, 5, 5] / mean[:, 5] ** 2) / 4
    root = 1 / (w * np.sqrt(relative))
    design = np.stack([np.ones(50), times], 1)
    line, *_ = np.linalg.lstsq(design * root[:, None], w * root, rcond=None)
    C = np.linalg.inv((design * root[:, None] ** 2).T @ design)
    at = design @ line
    expected = -line[1] / at
    np.testing.assert_allclose(value, expected, rtol=1e-3)
    g = np.stack([-expected / at, -(1 + expected * times) / at], 1)
    np.testing.assert_allclose(variance, np.einsum("ti,ij,tj->t", g, C, g), rtol=5e-3)


def test_inverse_ttc_from_size_undoes_the_lag_of_a_filter():
    """A settled filter of variance P and density Q shows what was true P / Q ago."""
    times, lag, Q_lambda = np.linspace(0, 1.2, 60), 0.03, 1.6
    late, _ = approach(times - lag)
    _, true = approach(times)
    P = np.zeros((60, 8, 8))
    P[:, [4, 5], [4, 5]] = lag * Q_lambda
    value, _ = grow(times, late, P, Q_lambda=Q_lambda)
    np.testing.assert_allclose(value[5:], true[5:], rtol=3e-3)
    without, _ = grow(times, late, P)
    assert (np.abs(without / true - 1)[5:] > 5e-3).all()


def test_inverse_ttc_from_size_is_the_joint_gaussian():
    """Against conditioning the scales and rates at all times at once on three sizes."""
    times, Q, spread = np.linspace(0, 1, 50) ** 1.5, 0.4, 0.01
    valid = np.isin(np.arange(50), [0, 20, 41])
    mean, P = np.full((50, 8), 10.0), np.zeros((50, 8, 8))
    mean[:, 4:6] *= 1 - 1e-4 * times[:, None]  # Q is relative to the scale, hence almost constant
    P[:, [4, 5], [4, 5]] = (spread * 10) ** 2
    t, s = times[:, None], times[None]
    m = np.minimum(t, s)
    ww = 100 + 100 * t * s + Q * (m**3 / 3 + m**2 * np.abs(t - s) / 2)
    wr = 100 * t + Q * (t * m - m**2 / 2)  # of the scale at t and the rate at s
    joint = np.block([[ww, wr], [wr.T, 100 + Q * m]])
    seen = np.flatnonzero(valid)
    gain = joint[:, seen] @ np.linalg.inv(joint[np.ix_(seen, seen)] + spread**2 / 2 * np.eye(3))
    posterior = joint - gain @ joint[seen]
    value, variance = grow(times, mean, P, valid, Q=Q)
    np.testing.assert_allclose(variance, np.diag(posterior)[50:], rtol=5e-3)
    assert np.abs(value).max() < 2e-3
    # At the end of the times the filter knows as much as the smoother.
    forward = grow(times, mean, P, valid, Q=Q, smooth=False)
    np.testing.assert_allclose([part[-1] for part in forward], [value[-1], variance[-1]], rtol=1e-9)


@pytest.mark.slow
def test_inverse_ttc_from_size_allows_for_errors_that_last():
    """Sizes as a Kalman filter of a walk leaves them that measures a constant size."""
    rng = RNG(6)
    tracks, steps, dt, Q_lambda, noise = 300, 400, 0.005, 3.0, 0.54
    spread = noise  # the filter's variance, which settles
    for _ in range(300):
        prediction = spread + Q_lambda * dt
        gain = prediction / (prediction + noise)
        spread = (1 - gain) * prediction
    size = np.full((tracks, steps + 200, 2), 10.0)
    for k in range(1, steps + 200):
        measured = 10 + np.sqrt(noise) * rng.normal(size=(tracks, 2))
        size[:, k] = size[:, k - 1] + gain * (measured - size[:, k - 1])
    times = dt * np.arange(steps)

    def nees(size, spread, Q_lambda, smoothed):
        mean = jnp.zeros((tracks, steps, 8)).at[..., 4:6].set(size)
        P = jnp.zeros((steps, 8, 8)).at[:, [4, 5], [4, 5]].set(spread)
        run = jax.vmap(lambda m: grow(times, m, P, Q_lambda=Q_lambda, smoothed=smoothed))
        value, variance = run(mean)
        return float(np.mean(np.asarray(value) ** 2 / np.asarray(variance)))

    # The mean of 300 squares is known to 8 %.
    assert 0.75 < nees(size[:, 200:], spread, Q_lambda, False) < 1.25
    assert nees(size[:, 200:], spread, 100 * Q_lambda, False) > 5
    back = spread / prediction
    for k in range(steps + 198, -1, -1):
        size[:, k] += back * (size[:, k + 1] - size[:, k])
    spread = (spread - back**2 * prediction) / (1 - back**2)
    assert 0.75 < nees(size[:, 100:-100], spread, Q_lambda, True) < 1.25
    assert nees(size[:, 100:-100], spread, Q_lambda, False) > 2


@pytest.mark.slow
def test_rows_that_are_not_valid_do_not_matter():
    times = np.linspace(0, 1, 50)
    mean, _ = approach(times)
    P = sized(times, 0.01)
    valid = np.ones(50, bool)
    valid[[0, 1, 20, 21, 22, 49]] = False
    broken = mean.copy()
    broken[~valid] = np.nan
    # As sizes of which nothing is known.
    vague = P * np.where(valid, 1, 1e14)[:, None, None]
    value, variance = grow(times, broken, P, valid, Q=0.1)
    expected, expected_variance = grow(times, mean, vague, Q=0.1)
    np.testing.assert_allclose(value[valid], expected[valid], rtol=1e-5)
    np.testing.assert_allclose(variance[valid], expected_variance[valid], rtol=1e-5)

    def total(mean):
        return grow(times, mean, P, valid)[0].sum()

    slope = jax.jit(jax.grad(total))(jnp.array(broken))
    assert np.isfinite(slope).all()


@pytest.mark.parametrize("valid", [[], [0], [3]])
def test_inverse_ttc_from_size_of_too_few_sizes_is_not_known(valid):
    mask = np.isin(np.arange(50), valid)
    mean, P = np.full((50, 8), 4.0), np.tile(np.eye(8), (50, 1, 1))
    for times in (np.linspace(0.0, 1.0, 50), np.zeros(50)):
        value, variance = grow(times, mean, P, mask, Q_lambda=1.0)
        assert np.isfinite(value).all() and (np.asarray(variance) > 10).all()


def test_inverse_ttc_from_size_in_single_precision(float32):
    times = np.linspace(0, 1.5, 1500)
    mean, truth = approach(times)
    args = (jnp.asarray(x, jnp.float32) for x in (times, mean, sized(times, 0.01)))
    value, variance = quantities.inverse_ttc_from_size(*args)
    assert value.dtype == jnp.float32 and np.isfinite(variance).all()
    np.testing.assert_allclose(value, truth, rtol=0.02)


def test_inverse_ttc_from_size_of_times_since_1970(float32):
    times = np.linspace(0, 1.5, 50)
    mean, _ = approach(times)
    args = (jnp.asarray(mean, jnp.float32), jnp.asarray(sized(times, 0.01), jnp.float32))
    late, early = (quantities.inverse_ttc_from_size(t, *args)[0] for t in (1.7e9 + times, times))
    np.testing.assert_allclose(late, early, rtol=1e-3)


def test_range_from_size():
    mean = np.zeros((2, 8))
    mean[:, 4:6] = (6, 3), (2, 6)
    P = np.zeros((2, 8, 8))
    P[:, 4, 4], P[:, 5, 5] = 0.04, 0.09
    value, variance = quantities.size_range(
        jnp.array(mean), jnp.array(P), extent=0.24, focal=1000.0, size_factor=0.25
    )
    np.testing.assert_allclose(value, [10, 10])
    np.testing.assert_allclose(variance, [100 * 0.04 / 36, 100 * 0.09 / 36])
    _, wider = quantities.size_range(
        jnp.array(mean), jnp.array(P), 0.24, 1000, 0.25, size_factor_variance=0.01**2
    )
    np.testing.assert_allclose(wider - variance, 100 * (0.01 / 0.25) ** 2)


@pytest.mark.parametrize("shape", ["ring", "disc", "uniform"])
def test_size_factors_are_those_of_sampled_events(shape):
    target = simulate.Target(
        simulate.LinearMotion((100, 100), (50.0, 0.0), size=(7, 7)), 2e5, shape=shape
    )
    _, truth = simulate.simulate_blobs([target], (300, 200), 1.0)
    offset = truth.xi - truth(truth.t)[:, 0, :2]
    diameter = 2 * np.hypot(*offset.T).max()
    factor = offset[:, 0].std() / diameter
    # 200,000 events: the deviation is known to 0.16 %, the largest radius to less.
    assert abs(factor / quantities.SIZE_FACTORS[shape] - 1) < 0.01


def test_calibration_finds_the_size_factor():
    rng = RNG(7)
    known = np.linspace(5, 17, 40)
    true = 0.31 * 0.24 * 1000 / known

    def calibrate(size, variance):
        return quantities.calibrate_size_factor(size, jnp.array(known), 0.24, 1000.0, variance)

    exact, nothing = calibrate(jnp.array(true), None)
    assert abs(float(exact) - 0.31) < 1e-12 and float(nothing) < 1e-20
    spread = 0.1 * true
    sizes = jnp.array(true + spread * rng.normal(size=(500, 40)))
    deviations = []
    for weights in (None, jnp.array(spread**2)):
        factor, variance = jax.jit(jax.vmap(lambda s, w=weights: calibrate(s, w)))(sizes)
        deviations.append(float(np.std(factor)))
        bound = 4 * np.std(factor) / np.sqrt(500)
        assert abs(np.mean(factor) - 0.31) < bound
        if weights is not None:  # otherwise the residuals are not alike
            assert abs(np.mean(variance) / np.var(factor) - 1) < 0.25
    assert deviations[1] < deviations[0]
    # Weights count in proportion only.
    scaled = calibrate(sizes[0], jnp.array(5 * spread**2))
    np.testing.assert_allclose(scaled, calibrate(sizes[0], jnp.array(spread**2)), rtol=1e-12)


def tracks(seed=0, T=12, N=2):
    """Times (s), ids, mean, covariance and valid of N tracks; the second is born late."""
    rng = RNG(seed)
    times = 0.1 + 0.05 * np.arange(T)
    mean = rng.uniform(3, 9, (T, N, 8))
    mean[..., 0], mean[..., 1] = np.array([40.0, 90])[:N], np.array([30.0, 45])[:N]
    valid = np.ones((T, N), bool)
    valid[:4, 1:] = False
    mean[:4, 1:] = np.nan
    return times, np.array([3, 17])[:N], mean, covariance(rng, T, N, scale=0.1), valid


def still(size=(120, 80)):
    target = simulate.Target(simulate.LinearMotion((40, 30), size=(6, 3), theta=0.5), 2e4)
    return simulate.simulate_blobs([target], size, 1.0, seed=1)[0]


def write_tracks(path, *arrays):
    with track_writer(path) as write:
        write(*arrays)


@pytest.mark.parametrize("flat", [False, True])
def test_csv_holds_every_living_row(tmp_path, flat):
    times, ids, mean, P, valid = tracks()
    row, column = np.nonzero(valid)
    if flat:
        write_tracks(
            tmp_path / "tracks.csv", times[row], ids[column], mean[row, column], P[row, column]
        )
    else:
        write_tracks(tmp_path / "tracks.csv", times, ids, mean, P, valid)
    table = pd.read_csv(tmp_path / "tracks.csv")
    first = "t id x y vx vy lambda1 lambda2 theta q sigma_x sigma_y sigma_vx sigma_vy sigma_lambda1"
    assert list(table.columns) == [*first.split(), "sigma_lambda2", "sigma_theta", "sigma_q"]
    assert len(table) == 12 + 8
    np.testing.assert_allclose(table["t"], times[row], rtol=0, atol=1e-9)
    np.testing.assert_array_equal(table["id"], ids[column])
    np.testing.assert_allclose(table[list(STATE_COLUMNS)], mean[row, column], rtol=4e-16, atol=0)
    deviation = np.sqrt(np.diagonal(P[row, column], axis1=1, axis2=2))
    np.testing.assert_array_equal(table.iloc[:, 10:], deviation)


def test_hdf5_holds_means_and_covariances(tmp_path):
    times, ids, mean, P, valid = tracks()
    path = tmp_path / "tracks.h5"
    write_tracks(path, np.rint(times * 1e6).astype(int), ids, mean, P, valid)
    row, column = np.nonzero(valid)
    with h5py.File(path) as file:
        np.testing.assert_array_equal(file["t"], np.rint(times[row] * 1e6))
        np.testing.assert_array_equal(file["id"], ids[column])
        np.testing.assert_array_equal(file["mean"], mean[row, column])
        np.testing.assert_array_equal(file["covariance"], P[row, column])
        assert tuple(file["mean"].attrs["columns"]) == STATE_COLUMNS
        assert file["t"].attrs["unit"].startswith("us")


def test_tracks_that_cannot_be_written_are_named(tmp_path):
    times, ids, mean, P, valid = tracks()
    with pytest.raises(InputError, match="cannot be stored as .txt"):
        write_tracks(tmp_path / "tracks.txt", times, ids, mean, P, valid)
    with pytest.raises(InputError, match="do not fit"):
        write_tracks(tmp_path / "tracks.csv", times[1:], ids, mean, P, valid)
    with pytest.raises(InputError, match="do not fit"):
        write_tracks(tmp_path / "tracks.csv", times, ids * 1.0, mean, P, valid)
    with pytest.raises(InputError, match="not two of the tracks"):
        write_track_plot(
            tmp_path / "a.png", still(), times, ids, mean, P, valid=valid, pairs=[(3, 4)]
        )
    with pytest.raises(InputError, match="both the extent"):
        write_track_plot(tmp_path / "a.png", still(), times, ids, mean, P, valid=valid, extent=1.0)
    with pytest.raises(InputError, match="file without suffix"):
        write_track_plot(tmp_path / "a", still(), times, ids, mean, P, valid=valid)
    with pytest.raises(InputError, match="not sorted"):
        list(pictures.track_frames(still(), times[::-1], ids, mean, valid))
    with pytest.raises(InputError, match="image 0 of 12 .* shape"):
        images = np.zeros((12, 70, 120), np.uint8)
        list(pictures.track_frames(still(), times, ids, mean, valid, images=images))
    with pytest.raises(InputError, match="image 5 of 12 .* none"):
        images = np.zeros((5, 80, 120), np.uint8)
        list(pictures.track_frames(still(), times, ids, mean, valid, images=images))
    assert not list(tmp_path.iterdir())


def test_ellipses_are_drawn_where_the_tracks_are():
    """Each pixel of a track's colour is on its ellipse or in its number, and all angles are."""
    scale = 4
    times, ids, mean, _, valid = tracks(T=2)
    valid[:], mean[:] = True, 5.0
    mean[:, 0] = 40, 30, 0, 0, 8, 4, 0.5, 0
    mean[:, 1] = 90, 50, 0, 0, 5, 5, 0, 0
    black = np.zeros((2, 80, 120), np.uint8)
    frames = list(
        pictures.track_frames(
            still(), times, ids, mean, valid, images=black, scale=scale, trail=0.0
        )
    )
    assert len(frames) == 2 and frames[0].shape == (80 * scale, 120 * scale, 3)
    y, x = np.mgrid[: 80 * scale, : 120 * scale]
    x, y = (x + 0.5) / scale - 0.5, (y + 0.5) / scale - 0.5
    for i, one in enumerate(ids):
        drawn = (frames[0] == pictures.track_colour(int(one))).all(2)
        px, py, _, _, l1, l2, theta, _ = mean[0, i]
        u = np.cos(theta) * (x - px) + np.sin(theta) * (y - py)
        v = np.cos(theta) * (y - py) - np.sin(theta) * (x - px)
        radius = np.hypot(u / l1, v / l2)
        # The line is 2 pixels wide, and l2 is the shorter axis.
        reach = 2.5 / (scale * min(l1, l2))
        number = (x > px) & (y < py) & (radius > 2)
        assert (np.abs(radius - 2) < reach)[drawn & ~number].all()
        angles = np.round(np.arctan2(v / l2, u / l1)[drawn] / (np.pi / 8))
        assert set(angles % 16) == set(range(16))


def test_trails_and_numbers_end_with_their_track():
    times, ids, mean, _, valid = tracks(N=1)
    valid[:], mean[:, 0, 4:6] = True, 2.0
    mean[:, 0, 0], mean[:, 0, 1] = 20 + 6 * np.arange(12), 40
    valid[3] = False
    mean[3] = np.nan
    black = np.zeros((12, 80, 120), np.uint8)

    def drawn(trail):
        settings = {"images": black, "scale": 1, "trail": trail}
        frames = pictures.track_frames(still(), times, ids, mean, valid, **settings)
        colour = pictures.track_colour(3)
        return [np.flatnonzero((frame == colour).all(2)[40]) for frame in frames]

    columns = drawn(0.2)
    assert columns[3].size == 0
    # Behind the ellipse of two standard deviations: as far as 0.2 s, four steps of 6 px, ago;
    # and not beyond the time without the track.
    assert columns[11].min() == 20 + 6 * 7 and columns[5].min() == 20 + 6 * 4
    assert np.ptp(drawn(0.0)[11]) < 12


def test_events_are_shown_behind():
    """Those of (t - window, t], where both ends are the times of events."""
    recording = still()
    events = recording.events
    start, now = events.t[500], events.t[700]
    inside = (events.t > start) & (events.t <= now)
    assert 0 < inside.sum() < 205
    _, ids, mean, _, valid = tracks(T=1)
    frames = pictures.track_frames(
        recording, [now], ids, mean, np.zeros_like(valid), scale=1, window=float(now - start) / 1e6
    )
    (frame,) = frames
    expected = np.zeros((80, 120), int)
    expected[events.y[inside], events.x[inside]] = np.where(events.p[inside], 1, 2)
    for kind, colour in ((1, (235, 235, 235)), (2, (110, 130, 190))):
        np.testing.assert_array_equal((frame == colour).all(2), expected == kind)


def test_small_sensors_are_enlarged_in_a_video(tmp_path):
    imageio = pytest.importorskip("imageio_ffmpeg")
    times, ids, mean, _, valid = tracks()
    path = tmp_path / "tracks.mp4"
    with video_writer(path, 20) as write:
        for picture in pictures.track_frames(still(), times, ids, mean, valid):
            write(picture)
    # Not by the reader of imageio, which forks; JAX warns that this may deadlock.
    decode = [imageio.get_ffmpeg_exe(), "-i", path, "-f", "rawvideo", "-pix_fmt", "rgb24", "pipe:1"]
    decoded = subprocess.run(decode, capture_output=True, check=True)
    (stream,) = [line for line in decoded.stderr.decode().splitlines() if "Video: h264" in line]
    assert " 720x480" in stream and " 20 fps" in stream
    assert len(decoded.stdout) == 12 * 720 * 480 * 3


@pytest.mark.parametrize(("size", "drawn"), [((64, 1), (30, 1920)), ((1280, 4), (4, 1280))])
def test_a_line_of_pixels_is_no_wider_than_a_video_may_be(size, drawn):
    times, ids, mean, _, valid = tracks()
    line = Recording("line", *size, Events([0, 10**6], [0, 0], [0, 0], [True, False]))
    frame = next(iter(pictures.track_frames(line, times, ids, mean, valid)))
    assert frame.shape[:2] == drawn


@pytest.mark.slow
def test_plots_are_written(tmp_path):
    pytest.importorskip("matplotlib")
    times, ids, mean, P, valid = tracks(T=12)
    given = still(), times, ids, mean, P
    write_track_plot(
        tmp_path / "both.png", *given, valid=valid, pairs=[(3, 17)], extent=0.2, focal=500.0
    )
    # None is valid: there is nothing to be shown over time.
    write_track_plot(tmp_path / "none.png", *given, valid=np.zeros_like(valid))
    sizes = []
    for name in ("both.png", "none.png"):
        with Image.open(tmp_path / name) as image:
            sizes.append(image.size)
    panels = 3 * 330  # of 2.2 inches
    assert sizes[0][0] == sizes[1][0] and sizes[0][1] - sizes[1][1] == panels


def test_what_comes_nearer_grows_along_both_axes():
    t = np.linspace(0, 1, 50)
    both, one, little = np.exp(0.5 * t), np.exp(-0.7 * t), np.exp(0.1 * t)
    sizes = np.stack([
        np.stack([5 * both, 3 * both], 1),
        np.stack([5 / both, 3 / both], 1),
        np.stack([5 * one, np.full(50, 3.0)], 1),
        np.stack([5 * little, 3 * little], 1),
        np.stack([5 * both, 3 / both], 1),
    ], 1)  # fmt: skip
    valid = np.ones((50, 6), bool)
    valid[:, 5] = False
    sizes = np.concatenate([sizes, np.ones((50, 1, 2))], 1)
    few = np.zeros_like(sizes)
    result = pictures._changes_scale(sizes, few, valid)
    assert result.tolist() == [True, True, False, False, False, False]
    flickers = np.exp(0.3 * np.sin(20 * t))[:, None, None] * 5 * np.ones((1, 1, 2))
    swells = np.exp(np.clip(4 - 20 * abs(t - 0.5), 0, 1))[:, None, None] * 5 * np.ones((1, 1, 2))
    tiny = sizes[:, :2] / 3
    for one in (flickers, swells, tiny):
        assert not pictures._changes_scale(
            one, few[:, : one.shape[1]], valid[:, : one.shape[1]]
        ).any()
    # From the first to the last eighth both sizes grow by exp(0.44): of errors of 10 % of each at
    # both ends this is 4.4 standard deviations, of 30 % it is 1.5.
    for error, clear in ((0.1, True), (0.3, False)):
        variances = (error * sizes[:, :1]) ** 2
        assert pictures._changes_scale(sizes[:, :1], variances, valid[:, :1]) == [clear]


@pytest.mark.slow
def test_panels_hold_the_tracks_that_are_seen_longest():
    valid = np.arange(10)[:, None] >= np.arange(8)
    shown = pictures._choose_longest(valid, [7])
    assert shown.tolist() == [True] * 6 + [False, True]


def test_the_package_has_the_quantities():
    assert blob.quantities is quantities and "quantities" in blob.__all__
