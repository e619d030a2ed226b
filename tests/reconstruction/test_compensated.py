"""The motion-compensated reconstruction: its parts against slow ones, its images against truth."""

import dataclasses
import functools
import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import correlate1d, gaussian_filter, map_coordinates
from traced import FULL, products

import jaxevent
from jaxevent import codegen
from jaxevent.errors import InputError
from jaxevent.methods import find
from jaxevent.reconstruction.colour import chrominance, colour_video, luminance
from jaxevent.reconstruction.compensated import (
    estimator,
    exposures,
    fusion,
    instants,
    normal_equations,
    robust_mean,
    target_motion,
    trajectories,
    warp,
)
from jaxevent.reconstruction.compensated.normal_equations import (
    CostParams,
    NormalEquations,
    PackedImages,
    solve_normal_equations,
)
from jaxevent.reconstruction.compensated.params import FALLBACK_SOURCES, FEATURE_NAMES, Params
from jaxevent.reconstruction.compensated.warp import PathTimes
from jaxevent.recording import Events, Frames, Recording
from jaxevent.simulate import Sensor, simulate

mc = find("mc", "reconstruction")
compiled_fuse = jax.jit(fusion.fuse)
COST = CostParams(*map(np.float32, (2e-4, 10, 40, 0.04, 0.1, 0.2)))


def fuse(params, L, V, along, at, reach=np.inf):
    """Fuse by a program that all tests of as many instants share."""
    return compiled_fuse(params, L, V, along, at, np.full(L.shape[1:], reach, np.float32))


def texture(height, width, seed=0):
    """A texture as a function of continuous y, x: log intensity."""
    rng = np.random.default_rng(seed)
    waves = [
        (*rng.uniform(-0.7, 0.7, 2), rng.uniform(0, 6.28), rng.uniform(0.05, 0.2))
        for _ in range(12)
    ]

    def level(y, x):
        return -1 + sum(a * np.cos(ky * y + kx * x + ph) for ky, kx, ph, a in waves)

    return level


def moved(v, a, s, height=40, width=56):
    """Images (K, h, w) of a texture path_index points go by v s + a s^2."""
    y, x = np.mgrid[:height, :width].astype(float)
    level = texture(height, width)
    shifts = [(v[0] * k + a[0] * k**2, v[1] * k + a[1] * k**2) for k in s]
    return np.stack([level(y - dy, x - dx) for dx, dy in shifts]).astype(np.float32)


@pytest.mark.slow
@pytest.mark.parametrize("v, a", [((-9.0, 4.0), (2.5, -1.5)), ((0.0, 0.0), (0.0, 0.0))])
def test_motion_is_found_from_nothing(v, a):
    s = np.array([-1, -0.75, -0.5, -0.25, 0, 0.25, 0.5, 0.75, 1], np.float32)
    L = moved(v, a, s)
    pyramid = trajectories.ImagePyramid(L, np.full_like(L, 1e-3), 0.35)
    plan = trajectories.plan_stages(s, 0.5)
    motion = trajectories.estimate_trajectories(pyramid, PathTimes.without_common(s), plan, COST)
    assert motion.level == 1
    p = motion.at_level(0, (40, 56)).p
    inner = p[6:-6, 6:-6]
    # The scene's points go by v s + a s^2.
    np.testing.assert_allclose(inner.mean((0, 1)), [*v, *a], atol=0.15)
    assert np.abs(inner - inner.mean((0, 1)))[..., :2].max() < 0.6
    paths = warp.interpolate_paths(p, (40, 56))
    np.testing.assert_allclose(paths[12:-12, 12:-12].mean((0, 1)), [*v, *a], atol=0.15)


@pytest.mark.slow
def test_motion_of_a_pattern_finer_than_coarse_pixels():
    """The search began at a level on which two pixels are a period, and found -5 px."""
    s, (y, x) = np.linspace(-1, 1, 11, dtype=np.float32), np.mgrid[:48, :64]
    wave = [np.sin(np.pi * (x - 12 * t) / 10) * np.cos(np.pi * y / 10) for t in s]
    L = 0.8 * np.array(wave, np.float32)
    L += np.random.default_rng(0).normal(0, 0.05, L.shape).astype(np.float32)
    pyramid = trajectories.ImagePyramid(L, np.full_like(L, 2.5e-3), 0.35)
    plan = trajectories.plan_stages(s, 0.2)
    p = trajectories.estimate_trajectories(pyramid, PathTimes.without_common(s), plan, COST).p
    np.testing.assert_allclose(2 * np.median(p, (0, 1))[:2], (12, 0), atol=0.3)


@pytest.mark.slow
def test_motion_of_half_the_image_alone():
    s = np.array([-1, -0.5, 0, 0.5, 1], np.float32)
    still, moving = moved((0, 0), (0, 0), s), moved((3.0, 0), (0, 0), s)
    L = np.where(np.arange(56) < 28, still, moving).astype(np.float32)
    pyramid = trajectories.ImagePyramid(L, np.full_like(L, 1e-3), 0.35)
    plan = trajectories.plan_stages(s, 0.5)
    p = trajectories.estimate_trajectories(pyramid, PathTimes.without_common(s), plan, COST).p
    assert np.abs(p[:, :5, :2] * 2).max() < 0.3  # of half resolution
    np.testing.assert_allclose(p[2:-2, -5:-2, 0] * 2, 3, atol=0.4)


def test_motion_of_a_later_target():
    p = np.zeros((8, 10, 4), np.float32)
    p[..., 0], p[..., 2] = 0.2 * 2 * np.arange(10), 0.5  # px/s at s = 0: it grows with x
    p[..., 1] = -2.0
    later = trajectories.advect_nodes(p, 0.4, 1.5, np.float32([0.7, -0.3]))
    # x + (0.2 x) s + 0.5 s^2 + 0.7 is where a point is; x is that of the target before.
    before = (2 * np.arange(10) - 0.5 * 0.4**2 - 0.7) / (1 + 0.2 * 0.4)
    expected = 1.5 * (0.2 * before + 2 * 0.5 * 0.4)
    np.testing.assert_allclose(later[3, 1:, 0], expected[1:], atol=2e-3)
    np.testing.assert_allclose(later[..., 1], -3, atol=1e-5)
    np.testing.assert_allclose(later[..., 2], 0.5 * 1.5**2, atol=1e-5)


@pytest.mark.slow
def test_equations_are_solved():
    rng = np.random.default_rng(1)
    rows, columns = 3, 4
    J = rng.normal(size=(rows, columns, 6, 4))
    full = np.einsum("yxki,yxkj->yxij", J, J)
    N = np.stack([full[..., i, j] for i in range(4) for j in range(i, 4)], -1).astype(np.float32)
    b, p = rng.normal(size=(2, rows, columns, 4)).astype(np.float32)
    sums = np.concatenate([N, b], -1)  # in one array, as `linearise` makes them
    N, b = sums[..., :10], sums[..., 10:]
    weights = rng.uniform(0.2, 1, (2, rows, columns)).astype(np.float32)
    across, down = weights[0], weights[1]
    smooth = np.array([2, 2, 3, 3], np.float32)
    ridge = np.array([0.1, 0.1, 0.5, 0.5], np.float32)
    d = solve_normal_equations(NormalEquations(N, b, across, down, smooth, ridge), p, 60)

    size = rows * columns
    laplacian = np.zeros((size, size))
    at = np.arange(size).reshape(rows, columns)
    pairs = [
        (at[i, j], at[i, j + 1], across[i, j]) for i in range(rows) for j in range(columns - 1)
    ]
    pairs += [(at[i, j], at[i + 1, j], down[i, j]) for i in range(rows - 1) for j in range(columns)]
    for one, other, w in pairs:
        laplacian[one, one] += w
        laplacian[other, other] += w
        laplacian[one, other] -= w
        laplacian[other, one] -= w
    A = np.zeros((size, 4, size, 4))
    for n in range(size):
        A[n, :, n] += full.reshape(size, 4, 4)[n] + np.diag(ridge)
    for c in range(4):
        A[:, c, :, c] += smooth[c] * laplacian
    flat = p.reshape(size, 4)
    right = b.reshape(size, 4) - smooth * (laplacian @ flat) - ridge * flat
    expected = np.linalg.solve(A.reshape(4 * size, -1), right.ravel())
    np.testing.assert_allclose(d.ravel(), expected, atol=2e-4)


@pytest.mark.slow
def test_pixels_take_the_path_of_their_side():
    s = np.array([-1, -0.5, 0, 0.5, 1], np.float32)
    x = np.arange(56)
    still, moving = moved((0, 0), (0, 0), s), moved((6.0, -3.0), (0, 0), s)
    packed = trajectories.pack_images(np.where(x < 28, still, moving), np.full_like(still, 1e-3))
    images = PackedImages.of(packed, PathTimes.without_common(s))
    # Between both motions a ramp, 12 px wide, as nodes leave it.
    part = np.clip((x - 21.5) / 12, 0, 1)[None, :, None] * np.ones((40, 1, 1))
    paths = (part * [6.0, -3, 0, 0]).astype(np.float32)
    path_index = trajectories.select_paths(images, paths, COST)
    chosen = paths.reshape(-1, 4)[path_index][4:-4]
    before = paths[4:-4]
    truth = np.where(x < 28, 0.0, 6.0)
    near = (np.abs(x - 27.5) < 8) & (np.abs(x - 27.5) > 1)

    def wrong(paths):
        return (np.abs(paths[..., 0] - truth)[:, near] > 0.7).mean()

    # What moves has left the image's other half, so that some pixels see it in few instants.
    assert wrong(before) > 0.5 and wrong(chosen) < 0.25
    # Steps from paths of others leave fewer wrong ones than steps alone; sizes may be odd.
    odd = PackedImages.of(np.ascontiguousarray(packed[:, :39, :55]), PathTimes.without_common(s))
    p = np.ascontiguousarray(paths[::2, ::2])
    step = trajectories.gauss_newton_step
    refined = step(odd, trajectories.borrow_paths(odd, step(odd, p, COST), COST), COST)
    plain = step(odd, step(odd, p, COST), COST)
    near, truth = near[:55], truth[:55]
    after, steps_alone = (warp.interpolate_paths(one, (39, 55)) for one in (refined, plain))
    assert wrong(after) < 0.9 * wrong(steps_alone)
    # Where all move alike none is better, and each keeps its own.
    even = np.broadcast_to(np.float32([6, -3, 0, 0]), paths.shape).copy()
    own = np.arange(40 * 56).reshape(40, 56)
    np.testing.assert_array_equal(trajectories.select_paths(images, even, COST), own)
    # What noise prefers is not chosen: here nothing but noise tells paths apart.
    rng = np.random.default_rng(4)
    noise = rng.normal(0, 0.05, still.shape).astype(np.float32)
    packed = trajectories.pack_images(noise, np.full_like(still, 0.01))
    images = PackedImages.of(packed, PathTimes.without_common(s))
    rough = rng.normal(0, 1, paths.shape).astype(np.float32)
    assert (trajectories.select_paths(images, rough, COST) != own).mean() < 0.05


@functools.cache
def warped_case():
    rng = np.random.default_rng(2)
    L = moved((2.0, 1.0), (0, 0), [-1, 0, 1], 18, 23)
    V = rng.uniform(0.01, 0.1, L.shape).astype(np.float32)
    clear = (rng.random(L.shape) < 0.5).astype(np.float32)
    p = rng.uniform(-4, 4, (9, 12, 4)).astype(np.float32)
    times = PathTimes(np.float32([-1, 0, 1]), np.float32([[1.5, -0.7], [0, 0], [-2.1, 3.2]]))
    return L, V, clear, times, warp.interpolate_paths(p, (18, 23))


@pytest.mark.slow
def test_images_along_trajectories():
    L, V, clear, times, paths = warped_case()
    quick = warp.warp_images(L, V, clear, times, paths)
    pure = jax.jit(warp.warp_images_jax)(L, V, clear, times, paths)
    for one, other in zip(quick, pure, strict=True):
        np.testing.assert_allclose(one, other, atol=2e-5)
    s, (common_x, common_y) = times.s[:, None, None], times.common.T[..., None, None]
    y, x = np.mgrid[:18, :23]
    Y = y + paths[..., 1] * s + paths[..., 3] * s**2 + common_y
    X = x + paths[..., 0] * s + paths[..., 2] * s**2 + common_x
    for k in range(3):
        at = [Y[k], X[k]]
        expected = map_coordinates(V[k], at, order=1, mode="nearest")
        np.testing.assert_allclose(quick.V[k], expected, atol=1e-5)
        outside = (Y[k] < -0.5) | (Y[k] > 17.5) | (X[k] < -0.5) | (X[k] > 22.5)
        np.testing.assert_array_equal(quick.inside[k] == 0, outside)
    np.testing.assert_array_equal(quick.L[1], L[1])  # the target's own


def make_layout(count, own, before, after):
    s = np.arange(count).astype(np.float32) - own
    s /= np.abs(s).max()
    framed = np.zeros(count, np.float32)
    framed[[before, after]] = 1
    near = (np.abs(np.arange(count) - own) <= 1).astype(np.float32)
    return robust_mean.InstantLayout(
        s,
        np.ones(count, np.float32),
        framed,
        near,
        np.zeros((count, 2), np.float32),
        *map(np.int32, (own, before, after)),
        np.array(after, np.int32),
    )


def still(L, V=0.01):
    """Images along trajectories that stand still."""
    ones = np.ones_like(L)
    return warp.WarpedImages(L, np.full_like(L, V), ones, ones)


@pytest.mark.slow
def test_robust_mean_is_that_of_jax():
    L, V, clear, times, paths = warped_case()
    along = warp.warp_images(L, V, clear, times, paths)
    L[0, 4:9, 5:12] += 1.0  # a thing in front
    # Activity is what changes between frames; where none follows, or is before, up to the target.
    purely = jax.jit(robust_mean.robust_mean_jax)
    activity = ((3, 1, 0, 2), 0), ((3, 2, 0, 0), L[2] - L[1]), ((3, 0, 2, 2), L[1] - L[0])
    for numbers, change in activity:
        at = make_layout(*numbers)
        one = robust_mean.robust_mean(Params(), L, along, at)
        other = purely(Params(), L, along, at)
        for name, quick, pure in zip(robust_mean.RobustMean._fields, one, other, strict=True):
            np.testing.assert_allclose(quick, pure, rtol=3e-5, atol=3e-5, err_msg=name)
        np.testing.assert_allclose(one.activity, np.broadcast_to(change, L[0].shape) ** 2, 1e-6)


def only(name, beyond="none"):
    """Return params that choose one candidate; `beyond` where frames are on one side alone."""
    chosen = []
    for one in (name, beyond):
        rows = np.zeros((len(FALLBACK_SOURCES), len(FEATURE_NAMES) + 1))
        rows[:, -1] = [40.0 if one == other else -40.0 for other in FALLBACK_SOURCES]
        chosen.append(rows.ravel().tolist())
    return Params(choice=chosen[0], choice_beyond=chosen[1])


@pytest.mark.slow
def test_what_differs_is_hidden():
    rng = np.random.default_rng(3)
    truth = moved((0, 0), (0, 0), [0], 20, 24)[0]
    L = truth + rng.normal(0, 0.05, (9, 20, 24)).astype(np.float32)
    L[6:, 3:13, 3:13] += 1.5  # a thing in front, in three instants
    at = make_layout(9, 4, 0, 8)
    fused = fuse(only("none"), L, np.full_like(L, 0.0025), still(L, 0.0025), at)
    error = np.abs(np.asarray(fused.L) - truth)
    assert error[5:11, 5:11].max() < 0.15
    assert np.sqrt((error[:, 17:] ** 2).mean()) < 0.05 * 0.45  # of nine images, 0.33
    visible = np.asarray(fused.visible)
    assert visible[0, 6:10, 6:10].min() > 0.9 and visible[1, 6:10, 6:10].max() < 0.1
    np.testing.assert_allclose(np.asarray(fused.sources).sum(0), 1, atol=1e-5)


@pytest.mark.parametrize("name", FALLBACK_SOURCES)
def test_other_candidates_can_be_chosen(name):
    L = moved((3.0, 1.0), (0, 0), np.linspace(-1, 1, 9), 20, 24)
    at = make_layout(9, 2, 1, 5)
    fused = fuse(only(name), L, np.full_like(L, 0.01), still(L), at)
    w = (at.s[2] - at.s[1]) / (at.s[5] - at.s[1])
    expected = {"smoothed": L[2], "blend": (1 - w) * L[1] + w * L[5]}[name]
    np.testing.assert_allclose(fused.L, expected, atol=1e-5)
    # Beyond the frames weights are others, and the blend is the frame.
    for numbers in ((9, 8, 3, 3), (9, 0, 4, 4)):
        _, own, frame, _ = numbers
        params = only("none", beyond=name)
        fused = fuse(params, L, np.full_like(L, 0.01), still(L), make_layout(*numbers))
        expected = {"smoothed": L[own], "blend": L[frame]}[name]
        np.testing.assert_allclose(fused.L, expected, atol=1e-5)
    # A candidate that is not known in place is not chosen, whatever the features are.
    mild = Params(choice=(np.array(only(name).choice) / 10).tolist())
    V = np.full_like(L, 0.01)
    V[:, 5, 7] = 9.0
    share = np.asarray(fuse(mild, L, V, still(L), at).sources)[3 + FALLBACK_SOURCES.index(name)]
    assert share[5, 7] < 0.03 and np.delete(share, 5, 0).min() > 0.97


def test_a_scene_at_rest_is_as_its_last_frame():
    L = np.repeat(moved((0, 0), (0, 0), [0], 20, 24), 9, 0)
    L[3] += 0.3  # the frame; after it nothing happens but a noise event, or in a corner
    noisy, partly = L.copy(), L.copy()
    noisy[6:, 10, 12] += 0.1
    partly[6:, 8:, 8:] += 0.5
    params, at = only("none", beyond="smoothed"), make_layout(9, 8, 3, 3)

    def found(images, rest):
        along = at._replace(rest=np.float32(rest))
        return np.asarray(fuse(params, images, np.full_like(L, 0.01), still(images), along).L)

    np.testing.assert_allclose(found(noisy, 0), noisy[8], atol=1e-5)
    resting = abs(found(noisy, 1) - L[3])
    assert resting[:, :6].max() < 1e-3 and resting[9:12, 11:14].max() < 0.1
    np.testing.assert_allclose(found(partly, 1)[14:, 16:], partly[8, 14:, 16:], atol=2e-2)


def test_a_stationary_point_is_that_of_its_smoother():
    L = np.repeat(moved((0, 0), (0, 0), [0], 20, 24), 9, 0)
    L[[1, 5]] += 0.02  # the frames; between them nothing happens but at one pixel
    L[4, 10, 12] += 0.5
    at, V = make_layout(9, 2, 1, 5), np.full_like(L, 0.01)
    moving, staying, far = (
        np.asarray(fuse(only("none"), L, V, still(L), at, px**2).L) for px in (2.0, 0.02, np.inf)
    )
    np.testing.assert_allclose(moving, far, atol=1e-4)
    assert np.abs(far - L[2])[:, :6].min() > 1e-3
    np.testing.assert_allclose(staying[:, :6], L[2, :, :6], atol=1e-4)
    np.testing.assert_allclose(staying[10, 12], far[10, 12], rtol=1e-2)
    frames_move = np.float32([1.0, -2.0, 0.5, 0])  # to 1.5, -2 px at s = 1
    paths, common = np.broadcast_to(frames_move, (2, 3, 4)), np.zeros((2, 2), np.float32)
    assert warp.squared_reach(paths, common).tolist() == [[6.25] * 3] * 2
    common[1, 0] = -1  # and all points by as much
    assert warp.squared_reach(paths, common).tolist() == [[10.25] * 3] * 2


@pytest.mark.slow
def test_instants_that_fill_up_change_nothing():
    L = moved((3.0, 1.0), (0, 0), np.linspace(-1, 1, 9), 20, 24)
    at = make_layout(9, 2, 1, 5)
    params = Params()
    fused = fuse(params, L, np.full_like(L, 0.01), still(L), at)
    none = np.zeros(2, np.float32)
    longer = at._replace(
        s=np.append(at.s, none + 1),
        present=np.append(at.present, none),
        framed=np.append(at.framed, none),
        near=np.append(at.near, none),
    )
    pad = np.zeros((2, 20, 24), np.float32)
    L2 = np.concatenate([L, pad])
    V2 = np.concatenate([np.full_like(L, 0.01), pad])
    along = warp.WarpedImages(*(np.concatenate([part, pad]) for part in still(L)))
    again = fuse(params, L2, V2, along, longer)
    np.testing.assert_allclose(fused.L, again.L, atol=1e-5)
    np.testing.assert_allclose(fused.P, again.P, rtol=1e-3)


def test_instants():
    frames = np.arange(10) * 40_000
    choose = instants.InstantSchedule(frames, (0, 360_000), 100.0)
    assert choose.step == 6_000 and choose.max_distance == 60_000
    one = choose(133_333)
    assert one.t[one.target] == 133_333 and one.s[one.target] == 0
    assert (np.diff(one.t) > 0).all() and np.abs(one.s).max() == 1
    assert one.t[one.before] == 120_000 and one.t[one.after] == 160_000
    assert set(one.t) >= {80_000, 120_000, 160_000, 200_000} and 40_000 not in one.t
    between = one.t[(one.t > 120_000) & (one.t < 160_000) & (one.t != 133_333)]
    assert (between % 6_000 == 0).all() and len(between) >= 2
    first = choose(0)  # nothing before
    assert first.target == first.before - 0 or first.t[first.before] > 0
    assert (first.t >= 0).all()


def test_the_clock_counts_events_that_are_missing():
    # Ten events per ms, of which those of two stretches are missing, about one of two blocks.
    t = np.arange(0, 400_000, 100)
    kept = t[~(((t > 90_000) & (t < 130_000)) | ((t > 210_000) & (t < 240_000)))]
    none = np.zeros(len(kept), np.uint16)
    lossy = Recording("lossy", 4, 4, Events(kept, none, none, none > 0))
    missed = instants.MissedEvents(lossy, 80_000)
    times = np.array([50_000, 90_000, 110_000, 130_000, 200_000, 225_000, 300_000])
    found = missed(times)
    np.testing.assert_allclose(found - found[0], [0, 0, 200, 400, 400, 550, 700], atol=2)
    np.testing.assert_allclose(missed(times[5:]) - missed(times[5:])[0], [0, 150], atol=2)
    clock = instants.MotionClock(lossy.events.index, 0, 100.0, 0.8, missed)
    np.testing.assert_allclose(np.diff(clock(times)), np.diff(times), rtol=2e-2)
    # Between two times of which events are missing the clock is nearer to time.
    assert clock.between(80_000, 140_000).event_share == pytest.approx(0.8 / 3, rel=0.02)
    assert clock.between(140_000, 200_000) is clock


def test_a_clock_that_stops_with_the_scene():
    # Ten events per ms until 200 ms, none until 300 ms, then five.
    gone = np.concatenate([np.arange(0, 200_000, 100), np.arange(300_000, 400_000, 200)])
    apart = 400_000 / len(gone)

    def clock(share):
        return instants.MotionClock(lambda t: int(np.searchsorted(gone, t)), 0, apart, share)

    times = np.array([0, 100_000, 200_000, 250_000, 300_000, 400_000])
    np.testing.assert_array_equal(instants.TIME_CLOCK(times), times)
    even = clock(1.0)(times) / apart
    np.testing.assert_allclose(even, [0, 1000, 2000, 2000, 2000, 2500])
    np.testing.assert_allclose(clock(0.25)(times), 0.75 * times + 0.25 * apart * even)
    frames = np.arange(0, 440_000, 40_000)
    choose = instants.InstantSchedule(frames, (0, 400_000), 100.0, clock(0.9))
    one = choose(262_000)
    still = np.diff(one.s)[(one.t[:-1] >= 200_000) & (one.t[1:] <= 300_000)]
    steps = np.diff(one.t)[(one.t[:-1] >= 200_000) & (one.t[1:] <= 300_000)]
    np.testing.assert_allclose(still * one.unit, 0.1e-6 * steps, rtol=1e-3)
    np.testing.assert_allclose(one.to_relative_times(one.t), one.s, atol=1e-6)
    assert one.relative_times_per_second(1000) * one.unit == pytest.approx(0.1)
    # At rest after the last frame and before the first; not between two, nor while things move.
    early, late = frames[:7], frames[7:]
    assert (
        one.rest == 0
        and instants.InstantSchedule(late, (0, 400_000), 100.0, clock(0.0))(262_000).rest > 0.9
    )
    assert instants.InstantSchedule(early, (0, 400_000), 100.0, clock(0.9))(262_000).rest > 0.9
    assert instants.InstantSchedule(early, (0, 400_000), 100.0, clock(0.9))(390_000).rest < 0.05
    plain, timed = (
        one.with_clock(instants.TIME_CLOCK),
        instants.InstantSchedule(frames, (0, 400_000), 100.0)(262_000),
    )
    np.testing.assert_array_equal(plain.s, timed.s)
    assert plain.unit == timed.unit


def test_parts_of_the_image_that_share_a_course():
    rng = np.random.default_rng(4)
    pace = np.array([1.0, 2, 3, 2, 1, 0, 0, 0.5])
    texture = rng.uniform(50, 500, (1, 9, 1))
    together = rng.poisson(texture * pace, (3, 9, 8)).astype(float)
    assert instants.common_motion_fraction(together) == instants.MAX_EVENT_SHARE
    alone = rng.poisson(texture * rng.permuted(np.tile(pace, (3, 9, 1)), axis=2)).astype(float)
    assert instants.common_motion_fraction(alone) < 0.1
    even = rng.poisson(texture * np.ones(8), (3, 9, 8)).astype(float)
    assert instants.common_motion_fraction(even) < 0.2
    assert instants.common_motion_fraction(np.zeros((1, 9, 8))) == 0


def test_trajectories_on_another_clock():
    rng = np.random.default_rng(5)
    p = rng.normal(size=(3, 4, 4)).astype(np.float32)
    s = np.array([-1, -0.6, -0.3, 0, 0.2, 0.7], np.float32)

    def gone(p, s):
        return p[..., :2, None] * s + p[..., 2:, None] * s**2

    twice = trajectories.change_clock(p, s, s / 2)
    np.testing.assert_allclose(gone(twice, s / 2), gone(p, s), atol=1e-5)
    # A clock that goes ever faster makes parabolas of straight lines.
    straight = p * np.array([1, 1, 0, 0], np.float32)
    early = (np.sqrt(1 + 4 * 0.2 * s) - 1) / (2 * 0.2)  # s = early + 0.2 early^2
    bent = trajectories.change_clock(straight, s, early.astype(np.float32))
    np.testing.assert_allclose(bent[..., 2:], 0.2 * straight[..., :2], atol=1e-4)
    np.testing.assert_allclose(bent[..., :2], straight[..., :2], atol=1e-4)


SHIFT = (6.0, -4.0)  # px per unit


@functools.cache
def exposed(half=0.5, common=0.0):
    """Two frames of a texture that goes by while they are exposed, and its sharp image.

    A part of the motion is common to all points, and not in the paths.
    """
    level = texture(18, 23, 8)
    y, x = np.mgrid[:18, :23].astype(float)

    def intensity(s):
        return np.exp(2 * level(y - SHIFT[1] * s, x - SHIFT[0] * s))

    frames = np.stack(
        [np.mean([intensity(s + h) for h in np.linspace(-half, half, 401)], 0) for s in (-0.5, 0.4)]
    )
    adjacent = exposures.AdjacentExposures(
        np.int32([0, 1]),
        np.float32([-0.5, 0.4]),
        np.float32([half, half]),
        np.ones(2, np.float32),
        np.outer([-0.5, 0.4], SHIFT).astype(np.float32) * np.float32(common),
        np.outer([half, half], SHIFT).astype(np.float32) * np.float32(common),
    )
    adjacent_frames = exposures.AdjacentFrames(
        np.full((2, 18 * 23), 0.5, np.float32),
        frames.reshape(2, -1).astype(np.float32),
        np.linspace(0, 1, 256, dtype=np.float32),
        np.ones(2, np.float32),
    )
    paths = np.zeros((18, 23, 4), np.float32)
    paths[..., :2] = (1 - common) * np.array(SHIFT)
    I0 = float(Params().I0)
    return np.log(intensity(0) + I0).astype(np.float32), adjacent, adjacent_frames, paths


constrain_jax = jax.jit(exposures.constrain_image_jax, static_argnums=3)


def constrain(params, L, P, case, pure=True):
    """Constrain an image in loops, and check that JAX does the same."""
    _, adjacent, adjacent_frames, paths = case
    ones = jnp.ones((7, *L.shape), np.float32)
    fused = fusion.FusedImage(jnp.asarray(L), jnp.asarray(P), ones[:5], ones[:2])
    model = exposures.ExposureModel(adjacent, adjacent_frames, paths)
    quick = exposures.constrain_image(params, fused, model, 7)
    if pure:
        model = model._replace(paths=jnp.asarray(paths, float))
        other = constrain_jax(params, fused, model, 7)
        np.testing.assert_allclose(quick.L, other.L, rtol=2e-4, atol=2e-4)
        np.testing.assert_allclose(quick.P, other.P, rtol=2e-4, atol=2e-4)
    return np.asarray(quick.L), np.asarray(quick.P)


@pytest.mark.slow
@pytest.mark.parametrize("common", [0.0, 0.4])
def test_an_exposure_is_the_mean_along_trajectories(common):
    L, adjacent, adjacent_frames, paths = exposed(common=common)
    I0 = float(Params().I0)
    smeared = jax.jit(exposures.blur_by_motion_jax)
    D = jax.jit(exposures.exposure_displacements, static_argnums=2)(adjacent, paths, 15)
    B, shares = smeared(L, D)
    np.testing.assert_allclose(shares.sum(1), 1, atol=1e-5)
    Y, X = (np.asarray(v) for v in warp.path_positions(jnp.asarray(paths), adjacent.path_times))
    for k in range(2):
        seen = map_coordinates(adjacent_frames.intensity[k].reshape(18, 23), [Y[k], X[k]], order=3)
        expected = np.log(seen + I0)  # exp L is I + I0, path_index mean is that of I, plus I0
        error = (np.asarray(B[k]) - expected)[6:-6, 7:-7]
        assert np.abs(error).max() < 0.01 and np.abs(expected - L)[6:-6, 7:-7].max() > 0.06
    # What is brought back is the adjoint where motion is even: <q, B(L)> grows as <back(q), L>.
    rng = np.random.default_rng(1)
    q, dL = np.zeros((2, 18, 23), np.float32), np.zeros((18, 23), np.float32)
    q[:, 7:11, 8:14], dL[5:13, 6:16] = rng.normal(size=(2, 4, 6)), rng.normal(size=(8, 10))
    back = exposures.blur_by_motion_adjoint(q, np.asarray(shares), np.asarray(D))
    slope = jax.jvp(lambda L: smeared(L, D)[0], (jnp.asarray(L),), (jnp.asarray(dL),))[1]
    np.testing.assert_allclose((back * dL).sum(), (q * slope).sum(), rtol=0.1)


@pytest.mark.slow
def test_images_are_fitted_to_blurred_frames():
    case = exposed()
    truth = case[0]
    blurred = gaussian_filter(truth, 1.5).astype(np.float32)
    P = np.full_like(truth, 0.02)
    L, after = constrain(Params(smear=0.3), blurred, P, case)

    def error(image):
        return float(((image - truth)[4:-4, 6:-6] ** 2).mean())

    assert error(L) < 0.6 * error(blurred)  # what blurs across the motion is lost on frames
    assert (after >= P).all() and after.max() > 1.1 * 0.02
    same, _ = constrain(Params(), truth, P, case)
    assert error(same) < 0.02 * error(blurred)
    sharp = case[:1] + (case[1]._replace(half=np.float32([0.01, 0.01])),) + case[2:]
    unchanged, _ = constrain(Params(), blurred, P, sharp)
    np.testing.assert_allclose(unchanged, blurred, atol=1e-6)


@pytest.mark.slow
def test_clipped_pixels_bound_the_image():
    truth, adjacent, adjacent_frames, p = exposed()
    white = adjacent_frames._replace(grey=np.ones_like(adjacent_frames.grey))
    params = Params(margin=2.0, sigma_floor=1e-3)
    bound = float(np.log((255 - 2) / 255 + float(params.I0)))
    L, P = np.full_like(truth, bound - 0.6), np.full_like(truth, 0.04)
    # One frame, exposed for an instant.
    alone = adjacent._replace(
        present=np.float32([1, 0]), half=0 * adjacent.half, drift=0 * adjacent.drift
    )
    case = truth, alone, white, p
    got, _ = constrain(params, L, P, case)
    grid = np.linspace(bound, bound + 3, 20_000)
    density = np.exp(-0.5 * (grid - (bound - 0.6)) ** 2 / 0.04)
    expected = (grid * density).sum() / density.sum()
    np.testing.assert_allclose(got[6:-6, 8:-8], expected, atol=0.01)
    above, _ = constrain(params, L + 1.2, P, case)
    np.testing.assert_allclose(above, L + 1.2, atol=0.01)
    off, _ = constrain(params.replace(one_sided=False), L, P, case, pure=False)
    np.testing.assert_array_equal(off, L)


class Slide:
    """A texture that slides by: a source for the simulated sensor."""

    size, duration = (48, 40), 0.42
    velocity = (70.0, -30.0)  # px/s

    def __init__(self):
        self.level = texture(40, 48, 5)
        self.y, self.x = np.mgrid[:40, :48].astype(float)

    def intensity(self, t):
        u, v = self.velocity
        return np.exp(self.level(self.y - v * t, self.x - u * t) * 0.9 - 0.3).clip(0.02, 0.95)


@functools.cache
def slide():
    """A recording of it, and the true images between its frames."""
    sensor = Sensor(
        frame_rate=20.0, exposure=1e-3, background_rate=0.1, hot_fraction=0.0, truth_rate=20.0
    )
    return simulate(Slide(), sensor, 3, "slide")


def params():
    return Params(c_on=0.2, c_off=0.18, I0=0.03, rho_ref=5e-4, exposure=1e-3, margin=2.0)


@functools.cache
def video():
    return mc.estimate(slide(), params(), progress=False)


@pytest.mark.slow
def test_images_are_better_than_those_of_pixels_and_frames():
    recording = slide()
    t, truth = recording.extra["hdr_t"], recording.extra["hdr"]
    inner = (t > 60_000) & (t < 340_000)
    given = {"akf": find("akf"), "aks": find("aks"), "blend": find("blend")}

    def error(method, values):
        image = method.estimate(recording, values, progress=False)(t[inner]).mean
        return float(((image - truth[inner]) ** 2).mean())

    ours = error(mc, params())
    shared = {k: v for k, v in params().values().items()}
    for name, method in given.items():
        values = {k: v for k, v in shared.items() if k in method.Params.settings()}
        assert ours < 0.5 * error(method, method.Params(**values)), name


class Swirl:
    """A known flow: it grows with time and place."""

    def flow(self, times, extrapolate=False):
        y, x = np.mgrid[:21, :30].astype(float)
        t = np.asarray(times)[:, None, None] * 1e-6
        return np.stack([3.0 * x - 40 * t * np.ones_like(x), 5.0 + 0 * x + 0 * t], -1)


def test_motion_that_is_known_is_begun_with():
    p = target_motion.InitialMotion(Swirl())(500_000, 2_000, 0.2)
    x = (np.arange(15) * 2 + 0.5)[None]
    u = 3.0 * x - 20  # px/s, and points accelerate by -40 + 3 u
    np.testing.assert_allclose(p[:-1, 1:-1, 0], np.repeat(0.2 * u, 10, 0)[:, 1:-1], rtol=1e-5)
    acceleration = np.repeat((-40 + 3 * u) / 2 * 0.2**2, 10, 0)
    np.testing.assert_allclose(p[:-1, 1:-1, 2], acceleration[:, 1:-1], rtol=0.02)
    np.testing.assert_allclose(p[..., 1], 1.0, rtol=1e-5)
    np.testing.assert_allclose(p[..., 3], 0.0, atol=1e-5)


class Sliding:
    """The motion of `Slide`, from `since` (us) on."""

    def __init__(self, since=0):
        self.since = since

    def flow(self, times, extrapolate=False):
        flow = np.broadcast_to(Slide.velocity, (len(times), 40, 48, 2)).copy()
        flow[np.asarray(times) < self.since] = np.nan
        return flow


@pytest.mark.slow
def test_images_from_known_motion():
    recording, t = slide(), np.array([126_000, 226_000])
    truth = np.stack([Slide().intensity(one * 1e-6) for one in t])

    def made(**options):
        return mc.estimate(recording, params(), progress=False, **options)

    def error(images):
        return ((images - truth)[:, 4:-4, 4:-4] ** 2).mean()

    fixed = made(motion=Sliding(), refine=False)
    flow = fixed.flow(t)
    np.testing.assert_allclose(flow, np.broadcast_to(Slide.velocity, flow.shape), rtol=1e-4)
    sought = error(video()(t).mean)
    assert error(fixed(t).mean) < 1.05 * sought
    assert error(made(motion=Sliding())(t).mean) < 1.2 * sought
    # Where it is not known motion is sought from nothing.
    late = made(motion=Sliding(200_000))(t).mean
    np.testing.assert_array_equal(late[0], video()(t[:1]).mean[0])
    assert (late[1] != video()(t[1:]).mean[0]).any()


@pytest.mark.slow
def test_variance_and_flow_are_true():
    recording, made = slide(), video()
    t, truth = recording.extra["hdr_t"], recording.extra["hdr"]
    inner = (t > 60_000) & (t < 340_000)
    image, P, valid = made(t[inner])
    assert valid[:, 2:-2, 2:-2].all() and (P > 0).all()  # a corner may be hidden in both frames
    z2 = np.log((image + 0.03) / (truth[inner] + 0.03)) ** 2 / P
    assert 0.1 < z2.mean() < 4
    flow = made.flow(t[inner][:2])
    assert flow.shape == (2, 40, 48, 2)
    error = np.hypot(*np.moveaxis(flow - Slide.velocity, -1, 0))[:, 6:-6, 6:-6]
    assert np.median(error) < 4 and error.mean() < 8  # px/s, of 76


@pytest.mark.slow
def test_sources_are_shares():
    shares = video().sources(np.array([200_000]))
    assert shares["before"].shape == (1, 40, 48)
    total = sum(shares[name] for name in fusion.SOURCE_NAMES)
    np.testing.assert_allclose(total, 1, atol=1e-4)
    assert shares["visible_before"].mean() > 0.5


@pytest.mark.slow
def test_colours_move_with_their_points():
    recording = slide()
    hue, frames, table = texture(40, 48, 9), recording.frames, np.arange(256) / 255
    y, x = np.mgrid[:40, :48].astype(float)
    u, v = Slide.velocity

    def chroma(t):
        part = 0.5 + 0.4 * np.sin(3 * hue(y - v * t * 1e-6, x - u * t * 1e-6))
        rgb = np.stack([part, 0.9 - 0.5 * part, 1.2 - part], -1)
        return rgb / luminance(rgb)[..., None]

    linear = 0.25 * np.stack([chroma(t) for t in frames.t])
    rgb = np.interp(linear, table, np.arange(256)).round().astype(np.uint8)
    response = {"response": table, "rgb": rgb}
    coloured = dataclasses.replace(recording, extra={**recording.extra, **response})
    t = np.array([300_000, 126_000, 226_000])
    truth = np.stack([chroma(one) for one in t])

    def error(made):
        got = colour_video(made, coloured)(t)
        assert np.allclose(luminance(got), made(t).mean, rtol=1e-5)
        return np.square(chrominance(got, white=np.inf) - truth)[:, 5:-5, 5:-5].mean()

    in_place = error(find("aks").estimate(recording, progress=False))
    assert error(video()) < 0.15 * in_place


@pytest.mark.parametrize(("before", "after"), [(-0.02, 0.06), (0.06, -0.02), (-0.01, -0.02)])
def test_the_clock_of_a_target_is_that_of_the_evidence(before, after):
    """The nearest anchor decides; halfway both do, whichever is called the nearest."""
    found, step = {10_000: before, 50_000: after}, 6_000
    estimator = object.__new__(target_motion.TrajectoryEstimator)
    estimator._anchor_motion = lambda at: target_motion.TwoClockMotion(None, None, found[at])
    estimator.schedule = instants.InstantSchedule(np.array([0, 60_000]), (0, 60_000), 100.0)
    assert estimator.schedule.step == step
    for t in (9_000, 10_000, 26_900, 29_999, 30_000, 30_001, 33_100, 50_000, 60_000):
        anchors = sorted(found, key=lambda at: abs(at - t))
        timed = [found[anchors[0]] < 0, before + after < 0][abs(t - 30_000) < 1_000]
        assert estimator._prefers_time(t, anchors) == timed
        if t == 30_000:
            assert estimator._prefers_time(t, anchors[::-1]) == timed
        assert estimator._prefers_time(t, anchors[:1]) == (found[anchors[0]] < 0)


@pytest.mark.slow
def test_images_do_not_depend_on_others():
    times = np.array([210_000, 105_000, 206_000])
    together = video()(times)
    for row, t in enumerate(times):
        alone = mc.estimate(slide(), params(), progress=False)(np.array([t]))
        for one, other in zip(together, alone, strict=True):
            np.testing.assert_array_equal(one[row], other[0])


@pytest.mark.slow
@pytest.mark.parametrize("options", [{}, {"motion": Sliding()}])
def test_images_are_made_beside_each_other(options, monkeypatch):
    times = np.array([105_000, 206_000, 206_000, 210_000])

    def make(cores):
        monkeypatch.setattr(codegen, "N_THREADS", cores)
        return mc.estimate(slide(), params(), progress=False, **options)(times)

    alone, refine, both = make(1), target_motion.TrajectoryEstimator.refine, threading.Barrier(2)

    def refine_two(self, initial):
        both.wait(60)
        return refine(self, initial)

    monkeypatch.setattr(target_motion.TrajectoryEstimator, "refine", refine_two)
    for one, other in zip(make(2), alone, strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.slow
def test_large_images_are_made_one_after_another(monkeypatch):
    monkeypatch.setattr(codegen, "N_THREADS", 2)
    monkeypatch.setattr(estimator, "MAX_PIXELS_AT_ONCE", 2 * 40 * 48 - 1)
    refine, found = target_motion.TrajectoryEstimator.refine, []

    def note(self, initial):
        found.append(threading.get_ident())
        return refine(self, initial)

    monkeypatch.setattr(target_motion.TrajectoryEstimator, "refine", note)
    mc.estimate(slide(), params(), progress=False)(np.array([105_000, 206_000]))
    assert found == [threading.get_ident()] * 2


@pytest.mark.slow
def test_a_later_clock_changes_nothing():
    recording = slide()
    shift = 5_000_000_000_000
    late = dataclasses.replace(
        recording,
        events=dataclasses.replace(recording.events, t=recording.events.t + shift),
        frames=dataclasses.replace(recording.frames, t=recording.frames.t + shift),
    )
    moved_images = mc.estimate(late, params(), progress=False)
    # The first and last instants of the recording, and its grid, are those of its own clock.
    t = np.array([205_000])
    assert moved_images.trajectories.schedule.step == video().trajectories.schedule.step
    one, other = video()(t), moved_images(t + shift)
    np.testing.assert_array_equal(one.mean, other.mean)


@pytest.mark.slow
def test_late_events_show_earlier_times():
    """Of events and frames that fit as they are, but are both 3 ms late."""
    delayed = params().replace(clock_offset=-0.003, event_delay=0.003)
    late, t = mc.estimate(slide(), delayed, progress=False), np.array([206_000])
    for one, other in zip(late(t - 3_000), video()(t), strict=True):
        np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(late.flow(t - 3_000), video().flow(t))
    pair = np.random.default_rng(0).random((2, 40, 48, 1))
    places = np.array([190_000, 230_000])
    carried = late.carry(pair, places - 3_000, int(t[0]) - 3_000)
    for one, other in zip(carried, video().carry(pair, places, int(t[0])), strict=True):
        np.testing.assert_array_equal(one, other)


@functools.cache
def prepared():
    """Prepared images, and what is made of them: a function of raw parameters and targets."""
    times = np.array([190_000, 212_000])
    features, out = mc.prepare(slide(), times, params())
    weights = np.random.default_rng(0).normal(size=(2, 40 * 48)).astype(np.float32)

    @jax.jit
    @functools.partial(jax.value_and_grad, has_aux=True)
    def value(raw, out):
        p = params().with_raw(raw)
        estimate = mc.read(p, mc.run(p, features)[0], out)
        image, P, _ = estimate
        return (weights * image).sum() + 10 * jnp.log(P).mean(), estimate

    return times, lambda raw, out=out: value(raw, out)  # compiled once for all targets


@pytest.mark.slow
def test_prepared_images_are_those_of_the_video():
    times, value = prepared()
    (_, (image, P, valid)), _ = value(params().raw)
    whole = video()(times)
    np.testing.assert_allclose(image.reshape(2, 40, 48), whole.mean, atol=2e-3)
    np.testing.assert_allclose(P.reshape(2, 40, 48), whole.covariance, rtol=0.1)
    np.testing.assert_array_equal(valid.reshape(2, 40, 48), whole.valid)


def test_chosen_images_keep_only_their_instants():
    times = np.array([150_000, 190_000, 212_000, 240_000])
    _, out = mc.prepare(slide(), times, params())
    rows = np.array([2, 2])
    chosen = out.take(rows)
    assert len(chosen.instants.slot) < len(out.instants.slot)
    for part in ("points", "slot", "since"):
        whole, kept = (jax.tree.leaves(getattr(one.instants, part)) for one in (out, chosen))
        for before, after in zip(whole, kept, strict=True):
            expected = np.asarray(before)[np.asarray(out.targets.rows)[rows]]
            np.testing.assert_array_equal(np.asarray(after)[chosen.targets.rows], expected)


@pytest.mark.slow
def test_products_are_of_full_precision():
    """GPUs round the factors of others to 11 bits: choices shift, images by up to 0.05."""
    _, value = prepared()
    found = products(value, params().raw)
    assert len(found) > 5 and set(found) == {FULL}


@pytest.mark.slow
def test_prepared_images_of_frames_that_are_not_steady(monkeypatch):
    """The video and prepared images leave out the smooth part alike; `test_frame_brightness`."""
    times, value = prepared()
    sure = video()(times)
    # What is in doubt of brightness is in the variance, of steady frames too.
    monkeypatch.setattr(target_motion.FrameBrightness, "variance", lambda *_: 0.02)
    steady = mc.estimate(slide(), params(), progress=False)(times)
    np.testing.assert_allclose(steady.covariance, sure.covariance + 0.02, rtol=1e-5)
    monkeypatch.setattr(target_motion.FrameBrightness, "is_steady", lambda *_: False)
    whole = mc.estimate(slide(), params(), progress=False)(times)
    assert (whole.mean != sure.mean).any() and whole.covariance.min() > 0.02
    _, out = mc.prepare(slide(), times, params())
    (_, (image, P, _)), _ = value(params().raw, out)
    np.testing.assert_allclose(image.reshape(2, 40, 48), whole.mean, atol=2e-3)
    np.testing.assert_allclose(P.reshape(2, 40, 48), whole.covariance, rtol=0.1)


@pytest.mark.slow
def test_images_are_of_learned_thresholds(monkeypatch):
    """The video and prepared images take what is learned; tests/reconstruction/test_thresholds."""
    times, at = prepared()[0], params()
    usual = video()(times).mean
    factors = np.random.default_rng(2).uniform(1, 4, (2, 40 * 48)).astype(np.float32)
    monkeypatch.setattr(target_motion, "learn_thresholds", lambda *_: factors)
    images = mc.estimate(slide(), at, progress=False)(times).mean
    assert np.abs(images - usual).max() > 0.01
    features, out = mc.prepare(slide(), times, at)
    estimate = jax.jit(lambda p: mc.read(p, mc.run(p, features)[0], out))(at)
    np.testing.assert_allclose(estimate.mean.reshape(2, 40, 48), images, atol=2e-3)


@pytest.mark.slow
def test_derivatives_are_those_of_differences():
    _, value = prepared()

    names = ("c_on", "sigma_pixel", "information", "sigma_place", "choice", "doubt", "sigma_bg")
    raw = params().raw
    _, gradient = value(raw)
    rng = np.random.default_rng(1)
    direction = {n: jnp.asarray(rng.normal(size=raw[n].shape) * 0.1, raw[n].dtype) for n in names}
    slope = sum(float((gradient[n] * direction[n]).sum()) for n in names)
    h = 2e-2
    ends = [
        float(value({**raw, **{n: raw[n] + sign * h * direction[n] for n in names}})[0][0])
        for sign in (1, -1)
    ]
    assert slope == pytest.approx((ends[0] - ends[1]) / (2 * h), rel=0.05)
    assert all(np.isfinite(v).all() for v in gradient.values())
    assert all(np.any(gradient[n] != 0) for n in names)


def slow_equations(L, V, times, p, cost):
    """The normal equations in float64: N as matrices, b, and the weights of differences."""
    (h, w), n = L.shape[1:], len(L)
    gradient = [
        [correlate1d(one, warp.GRADIENT_TAPS, axis, mode="nearest") for one in L] for axis in (1, 0)
    ]
    at = np.mgrid[:h, :w] / 2 - 0.25
    paths = [map_coordinates(p[..., c], at, order=1, mode="nearest") for c in range(4)]
    s = np.asarray(times.s, float)[:, None, None]
    X, Y = (
        np.arange(w) * [1.0, 0][c]
        + np.arange(h)[:, None] * [0, 1.0][c]
        + s * paths[c]
        + s**2 * paths[c + 2]
        + times.common[:, c, None, None]
        for c in (0, 1)
    )
    inside = (X >= -0.5) & (X <= w - 0.5) & (Y >= -0.5) & (Y <= h - 0.5)
    read = [
        [map_coordinates(one[k], [Y[k], X[k]], order=1, mode="nearest") for k in range(n)]
        for one in (L, V, *gradient)
    ]
    L, V, gx, gy = np.array(read)
    W = np.where(inside, 1 / (V + cost.floor), 1e-6)
    R = W * np.exp(-2 * s**2)
    for _ in range(2):
        M = (R * L).sum(0) / R.sum(0)
        R = W / (1 + (L - M) ** 2 * W / cost.robust)
    M = (R * L).sum(0) / R.sum(0)
    mx, my = (correlate1d(M, warp.GRADIENT_TAPS, axis, mode="nearest") for axis in (1, 0))
    J = np.stack([(gx + mx) / 2 * s, (gy + my) / 2 * s])
    J = np.concatenate([J, J * s])
    J = J - (R * J).sum(1, keepdims=True) / R.sum(0)

    def of_nodes(pixels):
        rows, columns = p.shape[:2]
        return np.array(
            [
                [
                    pixels[..., 2 * i : 2 * i + 2, 2 * j : 2 * j + 2].mean((-2, -1))
                    for j in range(columns)
                ]
                for i in range(rows)
            ]
        )

    def smooth(nodes):
        for axis in (0, 1):
            nodes = correlate1d(nodes, np.array([1, 6, 1]) / 8, axis, mode="nearest")
        return nodes

    N = smooth(of_nodes(np.einsum("khw,akhw,bkhw->abhw", R, J, J)))
    b = smooth(of_nodes(-np.einsum("khw,akhw,khw->ahw", R, J, L - M)))
    edge = of_nodes(np.hypot(mx, my))

    def weights(axis):
        length = np.sqrt((np.diff(p[..., :2], axis=axis) ** 2).sum(-1) + cost.jump**2)
        mean = (np.delete(edge, 0, axis) + np.delete(edge, -1, axis)) / 2
        return cost.jump / length * (0.1 + 0.9 * np.exp(-mean / cost.edge))

    return N, b, weights(1), weights(0)


def test_equations_are_those_of_a_slow_program():
    rng = np.random.default_rng(6)
    s = np.linspace(-1, 1, 3).astype(np.float32)
    L = moved((1.0, -0.5), (0.2, 0.1), s, 9, 10) + rng.normal(0, 0.02, (3, 9, 10))
    V = rng.uniform(2e-4, 1e-3, L.shape)
    p = np.float32([1, -0.5, 0.2, 0.1]) + rng.normal(0, 0.02, (5, 5, 4)).astype(np.float32)
    times = PathTimes(s, np.float32([[0.1, -0.05], [0, 0], [-0.08, 0.12]]))
    packed = trajectories.pack_images(L.astype(np.float32), V.astype(np.float32))
    found = normal_equations.linearise(PackedImages.of(packed, times), p, COST)
    N, b, across, down = slow_equations(L, V, times, p, COST)
    upper = np.stack([N[..., i, j] for i in range(4) for j in range(i, 4)], -1)
    np.testing.assert_allclose(found.N, upper, atol=1e-4 * np.abs(upper).max())
    np.testing.assert_allclose(found.b, b, atol=1e-4 * np.abs(b).max())
    np.testing.assert_allclose(found.across[:, :-1], across, rtol=1e-3)
    np.testing.assert_allclose(found.down[:-1], down, rtol=1e-3)
    tiny = 1e-5 * COST.smooth
    np.testing.assert_allclose(found.smooth, np.full(4, COST.smooth), rtol=1e-6)
    np.testing.assert_allclose(found.ridge, [tiny, tiny, COST.straight, COST.straight], rtol=1e-6)


def test_equations_do_not_depend_on_the_turns_of_threads():
    """Rows at the border of two threads are sampled by both, here at nearly the same time."""
    rng = np.random.default_rng(8)
    s = np.linspace(-1, 1, 5).astype(np.float32)
    L = moved((1.0, -0.5), (0.2, 0.1), s, 8, 200) + rng.normal(0, 0.02, (5, 8, 200))
    V = np.full(L.shape, 5e-4, np.float32)
    packed = trajectories.pack_images(L.astype(np.float32), V)
    images = PackedImages.of(packed, PathTimes.without_common(s))
    p = np.float32([1, -0.5, 0.2, 0.1]) + rng.normal(0, 0.02, (4, 100, 4)).astype(np.float32)
    cost = CostParams(*map(np.float32, (2e-4, 10, 40, 0.04, 0.1, 0.2)))
    first = normal_equations.linearise(images, p, cost)
    for _ in range(1000):
        again = normal_equations.linearise(images, p, cost)
        np.testing.assert_array_equal(again.N, first.N)


def test_bad_input():
    recording = slide()
    with pytest.raises(InputError, match="holds no frames"):
        mc.estimate(jaxevent.recording.Recording("bare", 48, 40, recording.events, None))
    with pytest.raises(InputError, match="were requested"):
        video()(np.array([-5_000_000]))
    with pytest.raises(InputError, match="no option"):
        mc.estimate(recording, params(), seeds=())


@pytest.mark.slow
@pytest.mark.parametrize("size", [(1, 5), (9, 7)])
def test_tiny_sensors_and_single_frames(size):
    width, height = size
    rng = np.random.default_rng(4)
    n = 40
    t = np.sort(rng.integers(0, 50_000, n))
    events = jaxevent.recording.Events(
        t,
        rng.integers(0, width, n).astype(np.uint16),
        rng.integers(0, height, n).astype(np.uint16),
        rng.random(n) < 0.5,
    )
    for count in (1, 2):
        frames = Frames(
            np.arange(count) * 30_000 + 1000,
            rng.integers(30, 200, (count, height, width)).astype(np.uint8),
            np.zeros(count, np.int64),
        )
        tiny = jaxevent.recording.Recording("tiny", width, height, events, frames)
        image, P, valid = mc.estimate(tiny, progress=False)(np.array([20_000, 40_000]))
        assert image.shape == (2, height, width) and np.isfinite(image).all()
        assert not valid[np.sqrt(P) >= mc.Params().vague].any() and (P > 0).all()


@pytest.mark.slow
@pytest.mark.parametrize("size", [(20, 25), (7, 600)], ids=["one-piece", "pieces"])
def test_blurring_is_scipys(size):
    image = np.random.default_rng(5).normal(size=size).astype(np.float32)
    expected = gaussian_filter(image, 1.5, mode="nearest", truncate=3.34)
    blurred = jax.jit(robust_mean.blur_jax, static_argnums=1)(image, 1.5)
    np.testing.assert_allclose(blurred, expected, atol=1e-5)
    along_x, along_y = warp.gradient_jax(jnp.asarray(image))
    taps = np.array([1, -8, 0, 8, -1]) / 12
    for found, axis in ((along_x, 1), (along_y, 0)):
        expected = correlate1d(image, taps, axis, mode="nearest")
        np.testing.assert_allclose(found, expected, atol=1e-6)


def test_variance_features_of_frames_on_one_side():
    X, known = (
        np.random.default_rng(3).normal(-4, 1, (len(FEATURE_NAMES) + 1, 1, 3)),
        np.array([[0, 0.5, 1]]),
    )
    given = jnp.asarray(X), jnp.asarray(known)
    np.testing.assert_array_equal(
        fusion.variance_features(*given, jnp.asarray(False), jnp.asarray(3)), X
    )
    once, far, near = (
        np.asarray(fusion.variance_features(*given, jnp.asarray(True), jnp.asarray(away)))
        for away in (1, 3, 0.5)
    )
    apart, twice = (FEATURE_NAMES.index(name) for name in ("from_each_other", "seen_twice"))
    squares = np.exp(X[apart]) - fusion.MIN_SQUARED_DIFFERENCE
    np.testing.assert_allclose(
        np.exp(once[apart]) - fusion.MIN_SQUARED_DIFFERENCE, known * squares, atol=1e-7
    )
    np.testing.assert_allclose(
        np.exp(far[apart]) - fusion.MIN_SQUARED_DIFFERENCE, 3 * known * squares, atol=1e-7
    )
    np.testing.assert_array_equal(near, once)
    np.testing.assert_allclose(once[twice], known * X[twice])
    others = np.delete(np.arange(len(X)), [apart, twice])
    np.testing.assert_array_equal(once[others], X[others])
