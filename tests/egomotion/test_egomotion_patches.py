"""Speeds and models of patches, and the covariance of estimates."""

import dataclasses

import numpy as np
import pytest
from points import recorded

from jaxevent.calibration import check_consistency
from jaxevent.camera import PinholeCamera
from jaxevent.egomotion import batch, contrast, find_model, scores, truth, voting
from jaxevent.egomotion.bundle.hypotheses import WindowTest, combine_z
from jaxevent.egomotion.candidates import pixel_coordinates
from jaxevent.egomotion.geometry import A, B, rotation_basis
from jaxevent.egomotion.model_selection import select_by_z, select_model
from jaxevent.egomotion.models import Rotation
from jaxevent.egomotion.motion import (
    RELATIVE_LENS_ERROR,
    CovarianceCalibration,
    MotionEstimate,
    is_observable,
)
from jaxevent.egomotion.particle_filter.estimator import mean_square_flow
from jaxevent.egomotion.patches import (
    MIN_INCONSISTENCY_Z,
    edge_event_fraction,
    flow_consistency,
    measure_image_speed,
)
from jaxevent.errors import InputError, InputWarning
from jaxevent.recording import Events, Frames, Imu, Poses, Recording
from jaxevent.show.motion import WrittenMotion
from jaxevent.show.motion_figures import motion_figure
from jaxevent.simulate.motion import motion_scene

WIDTH, HEIGHT, F = 120, 96, 100.0
CAMERA = PinholeCamera(F, F, (WIDTH - 1) / 2, (HEIGHT - 1) / 2)


def moving(flow, seconds: float, number: int = 700, every: float = 0.7, camera=CAMERA, seed=0):
    """Events of points that move by `flow(positions)`, constant for each, one each `every` px."""
    rng = np.random.default_rng(seed)
    place = rng.uniform([-20, -20], [WIDTH + 20, HEIGHT + 20], (number, 2))
    U = flow(place - [(WIDTH - 1) / 2, (HEIGHT - 1) / 2])
    sign = rng.random(number) < 0.5
    parts = []
    for x, u, p in zip(place, U, sign, strict=True):
        n = max(int(np.hypot(*u) * seconds / every), 2)
        t = (np.arange(n) + rng.random(n)) / n * seconds
        at = np.rint(x + (t - seconds / 2)[:, None] * u).astype(int)
        inside = (at >= 0).all(1) & (at < [WIDTH, HEIGHT]).all(1)
        parts.append(np.c_[np.rint(1e6 * t), at, np.full(n, p)][inside])
    return recorded(*np.concatenate(parts).T, WIDTH, HEIGHT, camera)


def uniformly(velocity):
    """The flow of all points with one velocity, px/s."""
    return lambda positions: np.tile(velocity, (len(positions), 1))


def estimate_of(model, t, mean, variance=1.0):
    """An estimate with the same variance of each component, and one or n means."""
    n, d = len(t), np.shape(mean)[-1]
    covariance = np.tile(variance * np.eye(d), (n, 1, 1))
    return MotionEstimate.from_arrays(
        model, np.asarray(t), np.broadcast_to(mean, (n, d)), covariance
    )


@pytest.mark.slow
@pytest.mark.parametrize(("speed", "seconds"), [(12.0, 2.0), (900.0, 0.1)])
def test_image_speed(speed, seconds):
    recording = moving(uniformly([0.8 * speed, -0.6 * speed]), seconds)
    found = measure_image_speed(recording)
    assert found is not None and abs(found.median / speed - 1) < 0.2
    for camera in (None, CAMERA):
        assert measure_image_speed(recording, camera) is found
    suited = contrast.adapt_params(recording, contrast.Params())
    way = float(suited.params.duration) * speed
    assert 4 < way < 61 and "px/s" in suited.speed_message and suited.speed == found
    given = contrast.adapt_params(recording, contrast.Params(duration=0.07), given=["duration"])
    assert float(given.params.duration) == pytest.approx(0.07)  # a number that is given wins
    params = voting.adapt_params(recording, voting.Params(), speed=found).params
    assert float(params.tau_max) * speed > float(params.baseline)
    literal = voting.adapt_params(recording, voting.Params(preset="literal"), speed=found).params
    assert float(literal.r_t) == pytest.approx(25 * found.median), "a speed grows with the image's"
    half = float(batch.adapt_params(recording, batch.Params(), speed=found).params.half_window)
    assert 20 < 2 * half * speed < 151


@pytest.mark.filterwarnings("ignore:.*unusual clock")
def test_noise_has_no_speed():
    rng, n = np.random.default_rng(0), 6000
    t = np.sort(rng.integers(0, 300_000, n))
    x, y = (rng.integers(0, size, n).astype(np.uint16) for size in (WIDTH, HEIGHT))
    noise = recorded(t, x, y, rng.random(n) < 0.5, WIDTH, HEIGHT, CAMERA)
    assert measure_image_speed(noise) is None
    suited = voting.adapt_params(noise, voting.Params())
    # The longest window is the whole recording.
    assert suited.speed is None
    assert "nothing was seen to move in windows of 1.6 ms to 0.3 s" in suited.message
    assert suited.params.values() == voting.Params().values()
    hasty = dataclasses.replace(noise, events=Events(t // 300, x, y, x % 2 == 0))
    said = "in windows of 1.6 ms to 2.9 ms", "in so few events", "in so short a recording"
    for recording, words in zip((noise[:0.003], noise[:0.001], hasty), said, strict=True):
        with pytest.raises(InputError, match=f"nothing is seen to move {words};"):
            select_model(recording)


@pytest.mark.parametrize(
    ("scale", "words"),
    [
        (1000, "like nanoseconds, .* as nanoseconds they last 0.4 s.* divide the times by 1,000"),
        (0.001, "like milliseconds, .* they last 0.399 s.* multiply the times by 1,000"),
    ],
)
def test_a_clock_of_another_unit_is_told_where_nothing_moves(scale, words):
    sound = moving(uniformly([70.0, 20.0]), 0.4, 400)
    e = sound.events
    clock = dataclasses.replace(sound, events=Events((e.t * scale).astype(int), e.x, e.y, e.p))
    with pytest.raises(InputError, match="nothing is seen to move .* of its motion$"):
        with pytest.warns(InputWarning, match=words) as told:
            select_model(clock)
    with pytest.warns(InputWarning, match=words):
        suited = voting.adapt_params(clock, voting.Params())
    assert "nothing was seen to move" in suited.message
    # The warning is that of the fault, so that a command that reported it does not repeat it.
    faults = [str(one) for one in check_consistency(clock) if one.name == "unusual clock"]
    assert [f"{clock.name}: {fault}" for fault in faults] == [str(one.message) for one in told]
    # Where something moves, and of noise at a usual rate, the unit is not doubted.
    voting.adapt_params(sound, voting.Params())
    rng, n = np.random.default_rng(1), 6000
    t = np.sort(rng.integers(0, 300_000, n))
    x, y = (rng.integers(0, size, n) for size in (WIDTH, HEIGHT))
    with pytest.raises(InputError, match="name the model of its motion$"):
        select_model(recorded(t, x, y, x % 2 == 0, WIDTH, HEIGHT, CAMERA))


def rates(x, T, Omega, rho):
    parallax = np.asarray(A(*x.T, F)) @ T * rho[:, None]
    return parallax + np.asarray(B(*x.T, F)) @ Omega


@pytest.mark.slow
def test_models_are_distinguished():
    one = np.array([70.0, 20.0])
    plane = moving(uniformly(one), 0.4, 400)
    bare = dataclasses.replace(plane, camera=None)

    def turn(x):
        return rates(x, np.zeros(3), [0.2, -0.3, 1.5], np.ones(len(x)))

    def deep(x):
        # Near and far stripes, across which the camera slides.
        rho = np.where((x[:, 1] // 24) % 2 == 0, 1.0, 0.5)
        return rates(x, np.array([-0.9, 0.0, 0.2]), np.zeros(3), rho)

    turning, sliding = moving(turn, 0.6), moving(deep, 0.6, 900)
    turns, slides = select_model(moving(turn, 0.4, 400)), select_model(sliding)
    assert turns.model.name == "rotation" and slides.model.name == "general"
    assert turns.z["rotation", "planar"] > 3 and "better than" in " ".join(turns.lines)
    assert "not sure" in turns.lines[-1] and "not sure" not in " ".join(slides.lines)
    flat, several, rolling = (flow_consistency(one) for one in (plane, sliding, turning))
    speeds = [measure_image_speed(one) for one in (turning, sliding, plane)]
    assert speeds[0] != speeds[1] != speeds[2]
    assert rolling.is_inconsistent and rolling.spread > 0.5 and rolling.both_directions
    assert flat is None or not flat.is_inconsistent
    assert several.is_inconsistent and not several.both_directions
    assert 0.2 < several.spread < 0.9
    assert several.slow < 50 and several.fast > 75  # 45 and 90 px/s
    assert select_model(bare).model.name == "planar"

    t = [100_000, 500_000]
    motion = estimate_of("planar", t, one)
    wider, line = motion.with_flow_consistency(dataclasses.replace(sliding, camera=None))
    along = several.spread**2 * (1 + 0.1**2) * (one @ one)
    unit = one / np.linalg.norm(one)
    assert unit @ wider.covariance[0] @ unit == pytest.approx(1 + along)
    assert (
        "depths" in line
        and "the model general, which needs the camera's focal length, may explain it" in line
    )
    turn = estimate_of("rotation", t, [0.2, -0.3, 1.5])
    same, line = turn.with_flow_consistency(turning)
    assert (same.covariance == turn.covariance).all() and not line
    turn = estimate_of("rotation", t, [0.0, -0.7, 0])  # translation may have made all of it
    wider, line = turn.with_flow_consistency(sliding)
    assert wider.covariance[0, 1, 1] == pytest.approx(1 + 0.49 * 1.01)
    assert "rotation" in line and "the model general may explain it" in line


def test_a_rotation_is_not_doubted_for_less_than_the_tried_speeds_resolve():
    recording, _ = motion_scene(
        "rotation", "varying", 3002, size=(120, 90), focal=100.0, duration=0.3
    )
    found = flow_consistency(recording, Rotation)
    assert found.z > MIN_INCONSISTENCY_Z and not found.is_inconsistent
    assert dataclasses.replace(found, spread=0.06).is_inconsistent


@pytest.mark.parametrize(
    ("patches", "windows", "model", "sure"),
    [
        ((0.0, 0.0, 0.0), -2.8, "rotation", True),
        ((0.0, 0.0, 0.0), 1.4, "rotation", False),
        ((0.0, 0.0, 0.0), 3.5, "general", True),
        ((0.0, 0.0, 0.0), None, "rotation", False),
        ((0.0, 5.0, 5.0), -5.0, "general", True),  # longer windows are not needed
        ((-4.0, 2.0, 5.0), 5.0, "planar", True),
        ((0.0, 3.5, 3.5), -2.8, "rotation", True),
    ],
)
def test_simplest_model_that_is_not_rejected_is_selected(patches, windows, model, sure):
    pairs = ("rotation", "planar"), ("general", "planar"), ("general", "rotation")
    found = select_by_z(dict(zip(pairs, patches, strict=True)), lambda: windows)
    assert found.model.name == model
    assert ("not sure" in found.lines[-1]) is not sure
    # No line says of a general motion that is not chosen that it explains more.
    better = [line for line in found.lines if "general motion" in line and "better" in line]
    assert not better or model == "general" or patches[0] < 0


def test_windows_that_share_events_are_not_independent():
    """Of white noise of each event z of all windows has variance 1, whatever they share."""
    noise = np.random.default_rng(3).normal(size=(1500, 400))
    for spans in ([(0, 400), (0, 400)], [(0, 300), (100, 400)], [(0, 150), (250, 400)]):
        z = []
        for row in noise:
            sums = [WindowTest(row[a:b].sum() / np.sqrt(b - a), a, b) for a, b in spans]
            z.append(combine_z(sums))
        assert np.array(z, float).var() == pytest.approx(1, abs=0.1)
    assert combine_z([]) is None and combine_z([WindowTest(2.5, 0, 10)]) == pytest.approx(2.5)


def test_unobservable_heading_is_reported():
    t, mean = np.array([0, 100_000]), np.tile([0.0, 0, 1, 0.1, 0, 0], (2, 1))
    covariance = np.tile(np.diag([1.2, 1.2, 0, 1e-4, 1e-4, 1e-4]), (2, 1, 1))
    for sigma2, said in ((1.2, True), (1e-4, False)):
        covariance[:, [0, 1], [0, 1]] = sigma2
        motion = dataclasses.replace(
            MotionEstimate.from_arrays("general", t, mean, covariance), n_extended=1
        )
        lines = WrittenMotion([], t, motion(t), motion, None, None, None).summary()
        assert lines[0].startswith("1 estimate, found")  # the other one holds it
        assert ("not observable" in " ".join(lines)) == ("unobservable" in lines[2]) == said
        # An unobservable heading is not drawn, nor is an empty panel.
        figure = motion_figure(dataclasses.replace(motion, agreement=np.array([0.5, 0.9])), t)
        drawn = {axis.get_ylabel(): axis.lines[0].get_ydata() for axis in figure.axes}
        assert len(drawn) == 7 and np.isfinite(drawn["wx (rad/s)"]).all()
        assert np.isnan(drawn["tx"]).all() == said
        np.testing.assert_allclose(drawn["events explained"], [0.5, 0.9])


def test_a_camera_that_stands_still_while_things_move():
    """Edges of frames on that side of the image where events are, or on the other."""
    recording = moving(uniformly([70.0, 20.0]), 0.6)
    e = recording.events
    right = e.x >= WIDTH // 2
    events = Events(e.t[right], e.x[right], e.y[right], e.p[right])
    t = np.arange(100_000, 600_000, 100_000)
    light = np.random.default_rng(0).uniform(0.2, 1, (HEIGHT // 8, WIDTH // 8)).repeat(8, 0)
    image, shares = np.full((HEIGHT, WIDTH), 0.5, np.float32), []
    motion = estimate_of("planar", [100_000, 500_000], [70.0, 20.0])
    for columns in (slice(0, 56), slice(64, WIDTH)):
        image[:], image[:, columns] = 0.5, light.repeat(8, 1)[:, columns]
        frames = Frames(t, np.tile(image, (len(t), 1, 1)), np.zeros(len(t), np.int64))
        shown = dataclasses.replace(recording, events=events, frames=frames)
        shares.append(edge_event_fraction(shown))
        told, line = motion.with_flow_consistency(shown)
        still = "stand still" in line
        assert still == (told.covariance[0, 0, 0] > 70**2) == (columns.start == 0)
    assert shares[0] < 0.1 and shares[1] > 0.5
    assert edge_event_fraction(recording) is None
    for grey in (0.0, 1.0):  # without any edge
        frames = dataclasses.replace(shown.frames, images=np.full_like(shown.frames.images, grey))
        assert edge_event_fraction(dataclasses.replace(shown, frames=frames)) is None
    general = estimate_of("general", motion.t, [0.0, 0, 1, 0.1, 0, 0], 0)
    unsure = general._with_full_uncertainty().covariance
    assert not is_observable("general", unsure)[:, :3].any() and unsure[0, 3, 3] > 0.1**2


def test_calibrated_covariance():
    t = np.array([0, 100_000, 200_000])
    mean = np.array([[1.0, 0], [2, 0], [3, 0]])
    motion = estimate_of("planar", t, mean)
    calibration = CovarianceCalibration(factor=4, share=0.5, change=0.2)
    told = motion.with_calibrated_covariance(calibration, 0.1)
    expected = 4 + 0.25 * 4 + 0.04 * 1.0**2  # the motion changes by 1 in 0.1 s, and is straight
    np.testing.assert_allclose(told.covariance[1], np.diag([expected, 5]))
    # At the ends it is taken to change as it comes, and later it is known less and less.
    np.testing.assert_allclose(
        told.covariance[:, 0, 0], [4 + 0.25 + 0.04, expected, 4 + 2.25 + 0.04]
    )
    later = told(np.array([200_000, 250_000, 300_000]), extrapolate=True)
    grown = later.covariance - told.covariance[2]
    np.testing.assert_allclose(grown, [[[v, 0], [0, 0]] for v in (0, 0.25, 1)], atol=1e-12)
    fast = estimate_of("planar", t, mean + [0, 1])
    told = fast.with_calibrated_covariance(CovarianceCalibration(speed=0.5))
    np.testing.assert_allclose(told.covariance[1] - np.eye(2), [[1.0, 0.5], [0.5, 0.25]])
    # A component whose flow is a third as large errs three times as much for the same flow.
    metric = np.diag([9.0, 1.0])
    told = motion.with_calibrated_covariance(
        CovarianceCalibration(flow_change=0.2), 0.1, flow_metric=metric
    )
    np.testing.assert_allclose(told.covariance[1], np.eye(2) + 0.04 * np.diag([1.0, 9.0]))
    lost = estimate_of("planar", t, mean, np.nan)
    assert not lost(t).valid.any()  # without a sigma


def test_mean_square_flow_is_that_of_a_sensor():
    y, x = np.mgrid[:90, :120].astype(float)
    xi = np.stack([x - 59.5, y - 44.5], -1)
    found = mean_square_flow(Rotation(100.0), xi)
    for motion in ([1.0, 0.0, 0.0], [0.2, -0.5, 3.0]):
        flow = np.asarray(rotation_basis(xi, 100.0)) @ motion
        np.testing.assert_allclose(motion @ found @ motion, (flow**2).sum(-1).mean(), rtol=1e-5)


def test_lone_estimate_is_extended():
    mean, calibration = np.array([[3.0, 0]]), CovarianceCalibration(change=0.5)
    motion = estimate_of("planar", [100_000], mean)
    same = motion.with_calibrated_covariance(calibration, 0.2)
    assert (same.covariance == np.eye(2)).all()
    told = motion.with_calibrated_covariance(calibration, 0.2, np.array([0.0, 4.0]))
    np.testing.assert_allclose(told.covariance[0], np.diag([1, 1 + 0.25 * 16]))
    rate = np.diag([0, 4.0**2]) / 2e5**2
    assert (told.n_extended, told.extended_to(0, 200_000).n_extended) == (0, 2)
    whole = told.extended_to(0, 200_000, rate).with_recording(moving(lambda x: x, 0.2))
    assert list(whole.t) == [0, 100_000, 200_000] and whole.valid.all()
    np.testing.assert_allclose(whole.mean, np.tile(mean, (3, 1)))
    # In half a window it changes by half as much.
    np.testing.assert_allclose(whole.covariance[:, 1, 1], [9, 5, 9])
    assert whole(np.arange(5000, 195_000, 1000)).valid.all()
    lost = dataclasses.replace(motion, valid=np.array([False]))
    assert len(lost.extended_to(0, 200_000)) == 1


def test_error_that_a_calibrated_lens_leaves():
    """Rotations from the flow that they make, if the calibration is off as far as usual.

    Of a DAVIS240C's lens; every fourth pixel is enough.
    """
    lens = np.array([199, 199, 132, 110, -0.37, 0.15]) / [4, 4, 4, 4, 1, 1]
    usual = np.array([1, 1, 1, 1, 0.01, 0.02]) / [4, 4, 4, 4, 1, 1]
    axes = np.random.default_rng(0).normal(size=(3, 50))
    axes /= np.linalg.norm(axes, axis=0)

    def camera(values):
        fx, fy, cx, cy, k1, k2 = values.tolist()
        return PinholeCamera(fx, fy, cx, cy, (k1, k2, 0.0, 0.0, 0.0))

    def places(values):
        xi, f = pixel_coordinates(60, 45, camera(values))
        slope = np.stack([np.gradient(xi, axis=axis) for axis in (1, 0)], -1)
        return slope.reshape(-1, 2, 2), rotation_basis(xi.reshape(-1, 2), f)

    slope, flow = places(lens)
    seen = np.linalg.solve(slope, flow @ axes)
    square = 0.0
    for off in np.diag(usual):
        slope, flow = places(lens + off)
        found = np.linalg.lstsq(flow.reshape(-1, 3), (slope @ seen).reshape(-1, 50))[0]
        square += np.square(found - axes).mean()
    assert RELATIVE_LENS_ERROR / 1.3 < np.sqrt(square) < 1.3 * RELATIVE_LENS_ERROR
    ideal = CovarianceCalibration(share=0.02)
    assert ideal.with_lens(None) == ideal.with_lens(CAMERA) == ideal
    assert ideal.with_lens(camera(lens)).share == pytest.approx(np.hypot(0.02, RELATIVE_LENS_ERROR))


def test_a_gyro_in_other_axes_and_with_a_bias():
    t = np.linspace(0, 1, 50)
    Omega = np.stack([0.3 * np.sin(7 * t), 0.2 * np.cos(5 * t), 0.5 + 0.2 * np.sin(9 * t)], 1)
    bias = np.array([0.05, -0.06, 0.02])
    np.testing.assert_allclose(truth.fit_gyro_bias(Omega, Omega + bias), bias)
    for name, R in truth.IMU_AXES.items():
        assert np.linalg.det(R) == pytest.approx(1)
        measured = (Omega + bias) @ R  # R takes the gyro's axes to the camera's
        found = truth.find_imu_axes(Omega, measured)
        assert found == (None if name == "camera" else name)
        imu = Imu(np.rint(1e6 * t).astype(np.int64), measured, np.zeros_like(measured))
        np.testing.assert_allclose(truth.twists_from_gyro(imu, rotation=R).Omega, Omega + bias)
    # Axes without a name are told as `parse_imu_rotation` reads them.
    R = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
    found = truth.find_imu_axes(Omega, (Omega + bias) @ R)
    assert found is not None
    np.testing.assert_array_equal(truth.parse_imu_rotation(found), R)
    np.testing.assert_array_equal(truth.parse_imu_rotation("y-up"), np.diag([1.0, -1, -1]))
    np.testing.assert_array_equal(truth.parse_imu_rotation("0,1,0,0,0,1,1,0,0")[0], [0, 1, 0])
    for wrong in ("y_up", "1,2", "1,0,0,0,1,0,0,0,-1"):
        with pytest.raises(InputError, match="imu-rotation"):
            truth.parse_imu_rotation(wrong)


def test_a_bias_in_degrees_is_told():
    t = np.arange(50) * 10_000
    rates = np.random.default_rng(0).uniform(-0.5, 0.5, (50, 3)) + [0.0, 0.0, 3.0]
    imu = Imu(t, rates, np.zeros_like(rates))
    for bias in ([0.0, 0.0, 0.0], [0.19, -0.05, 0.1], [0.4, 0.0, 3.1]):
        np.testing.assert_allclose(truth.twists_from_gyro(imu, bias).Omega, rates - bias)
    for degrees in ([60.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 6.0]):
        with pytest.warns(InputWarning, match="give it in rad/s: numpy.radians converts deg/s"):
            truth.twists_from_gyro(imu, degrees)


@pytest.mark.parametrize("name", ["camera", "y-up", "turned"])
def test_comparisons_tell_of_a_gyro_in_other_axes(name):
    t = np.linspace(0, 1_000_000, 50).astype(np.int64)
    Omega = np.stack([np.sin(7e-6 * t), np.cos(5e-6 * t), 0.5 + np.sin(9e-6 * t)], 1)
    zeros = np.zeros((50, 3))
    imu = Imu(t, Omega @ truth.IMU_AXES[name], zeros)
    recording = Recording("r", WIDTH, HEIGHT, Events.empty(), camera=CAMERA, imu=imu)
    motion = MotionEstimate(
        find_model("rotation"),
        t,
        Omega,
        np.tile(np.eye(3), (50, 1, 1)),
        np.ones(50, bool),
        *np.zeros((3, 50)),
    )
    known = truth.known_motion(recording, "rotation")
    if name == "camera":
        assert scores.score_motion(motion, known, t).figures["AME"] < 1e-9
    else:
        with pytest.warns(InputWarning, match=f"in other axes; give .* rotation='{name}'"):
            scores.score_motion(motion, known, t)
    known = truth.known_motion(recording, "rotation", rotation=name)
    assert scores.score_motion(motion, known, t).figures["vector_error"] < 1e-9


def test_image_velocity_from_poses_and_a_depth():
    t = np.arange(0, 1_000_001, 50_000)
    position = np.stack([0.4e-6 * t, -0.1e-6 * t, 0 * t], 1)
    quaternion = np.tile([0.0, 0, 0, 1], (len(t), 1))
    recording = Recording(
        "r", WIDTH, HEIGHT, Events.empty(), camera=CAMERA, poses=Poses(t, position, quaternion)
    )
    known = truth.known_motion(recording, "planar", depth=2.0)
    np.testing.assert_allclose(known.values, np.tile([-F * 0.2, F * 0.05], (len(known.t), 1)))
    with pytest.raises(InputError, match="depth"):
        truth.known_motion(recording, "rotation", depth=2.0)
    with pytest.raises(InputError, match="depth 0"):
        truth.known_motion(recording, find_model("planar"), depth=0.0)
