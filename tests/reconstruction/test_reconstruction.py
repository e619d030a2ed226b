"""The reconstruction chain against a loop over events, and the laws it must keep."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
from examples import examples
from hypothesis import given
from hypothesis import strategies as st
from jax.flatten_util import ravel_pytree

import jaxevent
from jaxevent.methods import names
from jaxevent.reconstruction import video
from jaxevent.reconstruction.compensated.images import InstantImages
from jaxevent.reconstruction.estimator import PixelEstimator
from jaxevent.reconstruction.filtering import Event, Observation, PixelState
from jaxevent.recording import Events, Frames, Recording

pytestmark = pytest.mark.filterwarnings("ignore:random. holds no frames")

PARAMS = {
    "c_on": 0.13,
    "c_off": 0.09,
    "I0": 0.4,
    "ratio_min": 0.05,
    "ratio_width": 0.5,
    "kappa": 3e4,
    "sigma_proc": 0.3,
    "sigma_iso": 0.4,
    "sigma_ref": 0.1,
    "rho": 0.004,
    "alpha": 40.0,
}


# Every option that the paper does not have.
OPTIONS = {
    **PARAMS,
    "rho_ref": 0.0008,
    "exposure": 0.0011,
    "calibrate": False,
    "weighting": "certainty",
    "margin": 2.5,
    "w_min": 1e-3,
    "certainty": [0.5, 1.3, 2.0, 0.7],
    "log_bias": 40.0,
    "rho_width": 0.4,
    "above": 0.7,
    "below": 0.4,
    "one_sided": True,
    "clip_rate": 300.0,
    "spread": 0.004,
    "share": 0.3,
}


def params_of(method, **values):
    """Params of a method with those of the values that it has."""
    known = {**method.Params.numbers, **method.Params.choices}
    return method.Params(**{k: v for k, v in values.items() if k in known})


def followed(params):
    """Return parameters with derivatives by those that act when data are prepared."""
    return params.with_derivatives(*(k for k, n in params.numbers.items() if not n.gradient))


@st.composite
def recordings(draw, fewest_frames=0, most=60):
    """Small recordings: bursts, equal times, silent and border pixels, odd exposures.

    All have as many pixels, so that they share programs.
    """
    width, height = draw(st.sampled_from([(4, 3), (1, 12)]))
    count = draw(st.integers(fewest_frames, 4))
    n = draw(st.integers(0 if count else 1, most))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    # A small range of times forces equal ones; the frames may lie before, among or after them.
    span = draw(st.sampled_from([20, 1000, 60_000]))
    t = np.sort(rng.integers(0, span, n)) + draw(st.sampled_from([0, 5_000, 10**9]))
    x, y = rng.integers(0, width, n), rng.integers(0, height, n)
    events = Events(t, x.astype(np.uint16), y.astype(np.uint16), rng.random(n) < 0.6)
    images = None
    if count:
        base = int(t[0]) if n else 0
        mid = (
            base
            + draw(st.sampled_from([-4_000, 0, 2_000]))
            + np.cumsum(rng.integers(1, max(span // 2, 3), count))
        )
        # Unknown, short, odd (half-microsecond edges) and overlapping exposures.
        exposure = rng.choice([0, 3, 500, 2_001, span // 2], count)
        grey = rng.integers(0, 256, (count, height, width)).astype(np.uint8)
        images = Frames(mid, grey, exposure)
    return Recording("random", width, height, events, images).check()


def look(video, times):
    """Image and variance, also beyond the recording's ends."""
    images = video(times, extrapolate=True)
    return np.stack([images.mean, images.covariance])


def times_of(recording):
    rng = np.random.default_rng(3)
    span = max(recording.stop - recording.start, 10)
    return np.sort(recording.start + rng.integers(-3, span + span // 3, 7))


# They compile most; `blend` and `last-frame` look at frames as they do.
SLOW = {"akf", "aks", "cf-augmented", "augmented", "high-pass", "cf", "edi"}
METHODS = [
    pytest.param(name, marks=[pytest.mark.slow] * (name in SLOW))
    for name in names("reconstruction")
    if isinstance(jaxevent.METHODS[name], PixelEstimator)
]


@pytest.mark.parametrize("name", METHODS)
@examples(8)
@given(
    recording=recordings(),
    offset=st.sampled_from([0.0, 0.0007, -0.0021]),
    delay=st.sampled_from([0.0, 0.0004, -0.0003]),
    values=st.sampled_from(
        [PARAMS, OPTIONS, {**OPTIONS, "weighting": "linear", "one_sided": False, "log_bias": -9.0}]
    ),
)
def test_chain_equals_loop_over_events(name, recording, offset, delay, values):
    method = jaxevent.METHODS[name]
    if recording.frames is None and method.needs_frames:
        with pytest.raises(jaxevent.InputError, match="holds no frames"):
            method.estimate(recording)
        return
    values = {"weighting": "linear", **values, "clock_offset": offset, "event_delay": delay}
    params, times = params_of(method, **values), times_of(recording)
    image, variance = look(method.estimate(recording, params), times)
    expected, P = oracles.reconstruct(name, recording, params.values(), times)
    # The oracle finds the moments of truncated Gaussians on a grid.
    close = 3e-5 if name == "aks" and params.one_sided else 1e-10
    np.testing.assert_allclose(image, expected, rtol=close, atol=close)
    np.testing.assert_allclose(variance, P, rtol=close)


@pytest.mark.slow
@examples(8)
@given(recording=recordings())
def test_float32_chain(recording):
    with jax.enable_x64(False):
        params = params_of(jaxevent.akf, **PARAMS)
        values = params.values()
        times = times_of(recording)
        image, variance = look(jaxevent.akf.estimate(recording, params), times)
    assert image.dtype == np.float32
    expected, P = oracles.reconstruct("akf", recording, values, times)
    np.testing.assert_allclose(image, expected, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(variance, P, rtol=1e-4)


# Laws


def random_recording(seed, n, frames, size=(4, 3), span=200_000, exposure=3_000, hot=0):
    """One recording; `hot` of its events happen at a single pixel, a tenth of that at another."""
    rng = np.random.default_rng(seed)
    width, height = size
    t = np.sort(rng.integers(0, span, n)) + 7
    x, y = rng.integers(0, width, n), rng.integers(0, height, n)
    chosen = rng.permutation(n)[:hot]
    x[chosen], y[chosen] = 1, 1
    x[chosen[: hot // 10]] = 2
    events = Events(t, x.astype(np.uint16), y.astype(np.uint16), rng.random(n) < 0.5)
    mid = np.linspace(10_000, span - 5_000, frames).astype(np.int64)
    grey = rng.integers(0, 256, (frames, height, width)).astype(np.uint8)
    images = Frames(mid, grey, np.full(frames, exposure)) if frames else None
    return Recording("random", width, height, events, images).check()


def whole_at(images, i):
    return [image[i : i + 1] for image in images]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["akf", "aks", "edi"])
@examples(6)  # each window takes 30 ms, however short it is
@given(recording=recordings(fewest_frames=1, most=24), events=st.sampled_from([1, 5, 13]))
def test_windows_do_not_change_the_result(name, recording, events):
    method = jaxevent.METHODS[name]
    params = params_of(method, **OPTIONS)
    times = times_of(recording)
    whole = look(method.estimate(recording, params), times)
    video = method.estimate(recording, params, window_events=events)
    np.testing.assert_allclose(look(video, times), whole, rtol=1e-12, atol=1e-12)
    # Read again from the start: windows are opened anew from their kept states.
    np.testing.assert_allclose(look(video, times[2]), whole_at(whole, 2), rtol=1e-12, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["high-pass", "augmented", "blend"])
def test_windows_do_not_change_the_result_of_baselines(name):
    method, recording = jaxevent.METHODS[name], random_recording(4, 300, 6, exposure=500)
    times = np.linspace(recording.start, recording.stop, 7).astype(np.int64)
    whole = look(method.estimate(recording), times)
    parts = look(method.estimate(recording, window_events=37), times)
    for a, b in zip(whole, parts, strict=True):
        np.testing.assert_allclose(b, a, rtol=1e-12, atol=1e-12)


@pytest.mark.slow
def test_windows_do_not_change_the_evidence_of_mc():
    recording, params = random_recording(4, 300, 6, exposure=500), jaxevent.mc.Params()
    times = np.linspace(recording.start, recording.stop, 7).astype(np.int64)
    whole = InstantImages(recording, params, 10**6)(times)
    for a, b in zip(whole, InstantImages(recording, params, 37)(times), strict=True):
        np.testing.assert_allclose(b, a, rtol=2e-6, atol=1e-9)  # kept in single precision


@pytest.mark.slow
def test_many_frames_and_uneven_pixels_in_windows(monkeypatch):
    """Hundreds of frames and a pixel with thousands of events use every kind of tile."""
    recording = random_recording(1, 5_000, 150, exposure=500, hot=4_500)
    params = params_of(jaxevent.akf, **PARAMS)
    times = np.linspace(0, 210_000, 30).astype(np.int64)
    whole = jaxevent.akf.estimate(recording, params, window_events=10**6)
    features, out = jaxevent.akf.prepare(recording, times, extrapolate=True)
    assert set(np.unique(features.tiles.kind)) == {0, 1, 2, 3}
    trajectory = jax.jit(jaxevent.akf.run)(params, features)[0]
    image, variance, _ = jax.jit(jaxevent.akf.read)(params, trajectory, out)
    expected = look(whole, times)
    assert len(whole._starts) > 1  # cut by frames
    np.testing.assert_allclose(
        image.reshape(expected[0].shape), expected[0], rtol=1e-12, atol=1e-12
    )
    np.testing.assert_allclose(variance.reshape(expected[1].shape), expected[1], rtol=1e-12)
    monkeypatch.setattr(video, "MAX_WINDOW_STARTS", 8)
    small = jaxevent.akf.estimate(recording, params, window_events=400)
    np.testing.assert_allclose(look(small, times), expected, rtol=1e-12, atol=1e-12)
    # More windows than states are kept: some images are filtered to from further back.
    assert len(small._starts) <= video.MAX_WINDOW_STARTS < 5_000 / 400
    for i in (3, 17, 11):
        again = [image[0] for image in look(small, times[i])]
        np.testing.assert_allclose(again, [e[i] for e in expected], rtol=1e-12, atol=1e-12)


@pytest.mark.slow
@examples(4)
@given(recording=recordings())
def test_reading_more_times_changes_nothing(recording):
    params = params_of(jaxevent.akf, **PARAMS)
    times = times_of(recording)
    few = look(jaxevent.akf.estimate(recording, params), times[::3])
    video = jaxevent.akf.estimate(recording, params)
    look(video, times[::-1])
    more = np.sort(np.concatenate([times, times + 1, times - 5]))
    dense = look(video, more)
    np.testing.assert_array_equal(few, dense[:, np.searchsorted(more, times[::3])])


@pytest.mark.slow
@examples(4)
@given(recording=recordings())
def test_later_clock_changes_nothing(recording):
    shift = 10**9
    frames = recording.frames
    later = dataclasses.replace(
        recording,
        events=dataclasses.replace(recording.events, t=recording.events.t + shift),
        frames=frames and dataclasses.replace(frames, t=frames.t + shift),
    )
    params = params_of(jaxevent.akf, **PARAMS)
    times = times_of(recording)
    np.testing.assert_array_equal(
        look(jaxevent.akf.estimate(later, params), times + shift),
        look(jaxevent.akf.estimate(recording, params), times),
    )


@pytest.mark.slow
@examples(4)
@given(recording=recordings(fewest_frames=1))
def test_order_of_pixels_changes_nothing(recording):
    """Mirrored in x and y, the neighbourhoods stay and every pixel gets another number."""
    e, f = recording.events, recording.frames
    mirrored = dataclasses.replace(
        recording,
        events=Events(
            e.t,
            (recording.width - 1 - e.x).astype(np.uint16),
            (recording.height - 1 - e.y).astype(np.uint16),
            e.p,
        ),
        frames=dataclasses.replace(f, images=f.images[:, ::-1, ::-1]),
    )
    params = params_of(jaxevent.akf, **PARAMS)
    times = times_of(recording)
    image, variance = look(jaxevent.akf.estimate(mirrored, params), times)
    expected = look(jaxevent.akf.estimate(recording, params), times)
    # Not to the last bit: compilers round whole vectors and their remainder differently.
    np.testing.assert_allclose(image[:, ::-1, ::-1], expected[0], rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(variance[:, ::-1, ::-1], expected[1], rtol=1e-12)


@pytest.mark.slow
def test_without_events_the_filter_tends_to_the_augmented_frame():
    recording = random_recording(2, 1, 6)
    recording = dataclasses.replace(recording, events=Events.empty())
    times = recording.frames.t[2:]
    exact = dict.fromkeys(("frame_noise", "error_event", "error_still", "error_change"), 0.0)
    params = jaxevent.akf.Params(kappa=7e7, **exact)
    image, variance, _ = jaxevent.akf.estimate(recording, params)(times)
    expected, _, _ = jaxevent.augmented.estimate(recording)(times)
    # What is left of the start is 1 / (1 + P0 t / R) < 1e-4: R < 1.6e-7 s, t > 0.07 s, P0 = 0.09.
    np.testing.assert_allclose(image, expected, atol=1e-4)
    elapsed = (times - recording.start)[:, None, None] * 1e-6
    assert (variance < 1 / (0.09 * 7e7 * elapsed)).all()  # P < R / elapsed, I + I0 >= 1


@pytest.mark.slow
def test_without_belief_in_frames_the_filter_integrates_events():
    recording = random_recording(3, 80, 3)
    params = jaxevent.akf.Params(kappa=1e-12, c_on=0.2, c_off=0.15)
    image, _, _ = jaxevent.akf.estimate(recording, params)(recording.stop)
    first, _ = look(jaxevent.akf.estimate(recording, params), recording.start - 1)
    total = np.zeros((3, 4))
    e = recording.events
    np.add.at(total, (e.y, e.x), np.where(e.p, 0.2, -0.15))
    np.testing.assert_allclose(np.log1p(image[0]) - np.log1p(first[0]), total, atol=1e-9)


def test_deblurring_a_blur_made_from_events_returns_the_sharp_image():
    """Known brightness: constant between events. The frame is its mean over the exposure."""
    rng = np.random.default_rng(5)
    recording = random_recording(5, 60, 1, span=20_000, exposure=12_000)
    e, f = recording.events, recording.frames
    params = jaxevent.edi.Params(c_on=0.07, c_off=0.05, I0=0.3)
    level = rng.uniform(-1, -0.6, (3, 4))  # ln(I + I0) before the first event

    def sharp(t):
        moved = np.zeros((3, 4))
        done = e.t <= t
        np.add.at(moved, (e.y[done], e.x[done]), np.where(e.p[done], 0.07, -0.05))
        return np.exp(level + moved)

    left, right = f.t[0] - 6_000, f.t[0] + 6_000
    blurred = np.mean([sharp(t) for t in range(left, right)], axis=0) - 0.3
    frames = dataclasses.replace(f, images=blurred[None])
    video = jaxevent.edi.estimate(dataclasses.replace(recording, frames=frames), params)
    for t in (0, left, f.t[0], right - 1, 30_000):
        np.testing.assert_allclose(
            video(int(t), extrapolate=True).mean[0], sharp(t) - 0.3, atol=1e-12
        )


# The authors' program


def recorded(path):
    """Read a run of the authors' program: at each event a pixel's L and P before it, and its row.

    A pixel's state is its previous row, or the last image written after that row (their program
    updates every pixel whenever it writes one). Files of the complementary filter have no P.
    """
    z = np.load(path)
    columns = [str(c) for c in z["ev_columns"]]
    par = json.loads(str(z["par_json"]))
    L = np.log(z["in_image"][:, :, 1] / 255 + 1)
    P = np.full(L.shape, par["p_ini"])
    images_P = z["snap_P"] if "snap_P" in z else np.broadcast_to(P, z["snap_L"].shape)
    writes = sorted(zip(z["snap_event"], z["snap_kind"], range(len(z["snap_ts"])), strict=True))
    before, path = [], []
    for values in z["ev"]:
        row = dict(zip(columns, values, strict=True))
        # Images of kind 1 come before the update of their event, of kind 2 after it.
        while writes and (writes[0][0], writes[0][1]) < (row["i"], 2):
            snapshot = writes.pop(0)[2]
            L, P = z["snap_L"][snapshot].copy(), images_P[snapshot].copy()
        at = int(row["y"]) - 1, int(row["x"]) - 1
        before.append((L[at], P[at]))
        path.append(row)
        L[at], P[at] = row["L_after"], row.get("P_after", par["p_ini"])
    state = PixelState(*(jnp.asarray(v) for v in zip(*before, strict=True)))
    rows = {k: jnp.asarray([row[k] for row in path]) for k in columns}
    assert len(path) == 1257
    return par, float(z["in_ct"]), state, rows


@pytest.mark.parametrize("name", ["mini_akf_deblur_hfr300", "mini_akf_nodeblur_hfr300"])
def test_step_reproduces_the_authors_program(name, golden):
    """Row by row: state, augmented frame, certainty and noise as they recorded them."""
    par, c, state, rows = recorded(golden / f"{name}.npz")
    # Their noise is fed as recorded: sigma_iso = 1 makes `near` a variance.
    params = jaxevent.akf.Params(
        c_on=c, c_off=c, sigma_proc=par["sigma_p"] ** 0.5, sigma_iso=1.0, sigma_ref=0.0
    )
    event = Event(
        rows["delta_t_s"],
        rows["Q_i"] + rows["Q_r"],
        rows["polarity"].astype(int),
        Observation(rows["LA_used"], rows["Rinv_used"]),
    )
    after = jax.jit(jax.vmap(jaxevent.akf.step, (None, 0, 0)))(params, state, event)
    np.testing.assert_allclose(after.L, rows["L_after"], rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(after.P, rows["P_after"], rtol=1e-12)


def test_step_reproduces_the_authors_complementary_filter(golden):
    """Row by row, of their filter with a constant gain on the augmented frame, 15 rad/s."""
    par, c, state, rows = recorded(golden / "mini_eaf_cf15_hfr300.npz")
    params = jaxevent.cf_augmented.Params(c_on=c, c_off=c, alpha=par["cutoff_rad_s"])
    event = Event(
        rows["delta_t_s"],
        jnp.zeros_like(rows["delta_t_s"]),
        rows["polarity"].astype(int),
        Observation(rows["LA_used"], jnp.full_like(rows["LA_used"], params.alpha)),
    )
    after = jax.vmap(lambda s, e: jaxevent.cf_augmented.step(params, s, e))(state, event)
    np.testing.assert_allclose(after.L, rows["L_after"], rtol=1e-12, atol=1e-15)
    assert par["cutoff_rad_s"] == 15 and float(jnp.abs(rows["LA_used"] - state.L).max()) > 0.1


# Pure functions


def chain(method, recording, times, params=None):
    features, out = method.prepare(recording, times, params, extrapolate=True)

    def images(params):
        trajectory, _ = method.run(params, features)
        return method.read(params, trajectory, out)

    return images


@pytest.mark.slow
def test_run_jits_and_maps_over_parameters():
    recording = random_recording(6, 90, 4)
    times = recording.frames.t + 900
    images = chain(jaxevent.akf, recording, times)
    params = [jaxevent.akf.Params(c_on=c, kappa=k) for c, k in ((0.1, 7e5), (0.2, 1e3))]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *params)
    mapped = jax.jit(jax.vmap(images))(stacked)
    for i, p in enumerate(params):
        video, _ = look(jaxevent.akf.estimate(recording, p), times)
        np.testing.assert_allclose(
            mapped.mean[i].reshape(video.shape), video, rtol=1e-12, atol=1e-13
        )


def weighted(method, params, features, out, of_image, of_variance):
    """A loss of all pixels of all images and of their variances."""
    image, variance, _ = method.read(params, method.run(params, features)[0], out)
    total = (image * of_image).sum()
    return total + (variance * of_variance).sum() if method.has_covariance else total


# Recordings of as many pixels, frames and times share these.
LOSS = jax.jit(weighted, static_argnums=0)
GRADIENT = jax.jit(jax.grad(weighted, 1), static_argnums=0)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name, exposure, values",
    [
        ("akf", 3_000, PARAMS),
        ("akf", 0, OPTIONS),
        ("aks", 3_000, OPTIONS),
        ("cf-augmented", 3_000, OPTIONS),
    ],
)
def test_gradients_equal_central_differences(name, exposure, values):
    """Every leaf, through deblurring, calibration, filter and read-out."""
    method = jaxevent.METHODS[name]
    recording = random_recording(7, 90, 4, exposure=exposure)
    times = recording.frames.t + 1_300
    params = followed(params_of(method, **values))
    features, out = method.prepare(recording, times, params, extrapolate=True)
    weight = jnp.asarray(np.random.default_rng(0).normal(size=(len(times), 12)))
    given = features, out, weight, weight

    gradient = GRADIENT(method, params, *given)
    if name == "akf" and values is PARAMS:  # forwards too: what goes backwards is made of it
        ones = jax.tree.map(jnp.ones_like, params)
        _, along = jax.jit(
            lambda params: jax.jvp(lambda p: weighted(method, p, *given), (params,), (ones,))
        )(params)
        total = sum(np.nansum(leaf) for leaf in jax.tree.leaves(gradient))
        assert float(along) == pytest.approx(float(total), rel=1e-9)
    flat, unflatten = ravel_pytree(params)
    for i, value in enumerate(flat.tolist()):
        if np.isneginf(value):
            continue  # a positive parameter at 0
        h = 1e-5 * max(abs(value), 1e-2)
        up, down = (LOSS(method, unflatten(flat.at[i].add(s)), *given) for s in (h, -h))
        expected = float(up - down) / (2 * h)
        got = float(ravel_pytree(gradient)[0][i])
        np.testing.assert_allclose(got, expected, rtol=1e-6, atol=1e-7, err_msg=str(i))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["akf", "aks"])
def test_gradients_are_finite_at_corners(name):
    """No events, equal times, black and saturated pixels."""
    method = jaxevent.METHODS[name]
    for recording, values in (
        (dataclasses.replace(random_recording(8, 1, 4), events=Events.empty()), PARAMS),
        (random_recording(9, 50, 4, span=24_000), OPTIONS),
    ):
        images = np.zeros_like(recording.frames.images)
        images[:, 1] = 255
        recording = dataclasses.replace(
            recording,
            frames=dataclasses.replace(recording.frames, images=images),
            events=dataclasses.replace(recording.events, t=recording.events.t // 4_000 * 4_000),
        )
        params = followed(params_of(method, **values))
        times = recording.frames.t + 1
        features, out = method.prepare(recording, times, params, extrapolate=True)
        ones = jnp.ones((len(times), 12))
        gradient = GRADIENT(method, params, features, out, ones, ones)
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["akf", "aks"])
def test_gradients_are_finite_at_extremes(name):
    """Each number at 0 or its least, and at 10,000 times its default."""
    method, recording = jaxevent.METHODS[name], random_recording(9, 50, 4, span=24_000)
    plain = followed(params_of(method, **OPTIONS))
    features, out = method.prepare(recording, recording.frames.t + 1, plain, extrapolate=True)
    ones = jnp.ones((len(recording.frames.t), 12))
    given = 0
    for setting, number in method.Params.numbers.items():
        most = 10.0 if number.unit == "ln I" else 1e4  # thresholds: e^10 is beyond any scene
        for factor in (0.0, most) if number.gradient and np.ndim(number.default) == 0 else ():
            value = max(factor * max(number.default, 1e-2), number.least)
            if setting in ("share", "rho_ref"):
                continue
            params = plain.replace(**{setting: value})
            gradient = GRADIENT(method, params, features, out, ones, ones)
            finite = all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))
            assert finite, (setting, value)
            given += 1
    assert given > 20


@pytest.mark.slow
@pytest.mark.parametrize("name", ["akf", "aks", "edi"])
def test_derivative_by_the_dead_time_is_that_of_preparing_anew(name):
    method = jaxevent.METHODS[name]
    recording = random_recording(7, 90, 4)
    times = recording.frames.t + 1_300
    rho, h = 0.0008, 1e-7  # rounded to 10 ns

    def anew(rho):
        params = params_of(method, **{**OPTIONS, "rho_ref": rho})
        return look(method.estimate(recording, params), times)[0].sum()

    params = followed(params_of(method, **{**OPTIONS, "rho_ref": rho}))
    features, out = method.prepare(recording, times, params, extrapolate=True)
    ones = jnp.ones((len(times), 12))
    slope = GRADIENT(method, params, features, out, ones, 0 * ones).raw["rho_ref"]
    expected = (anew(rho + h) - anew(rho - h)) / (2 * h) * rho  # by ln rho
    np.testing.assert_allclose(slope, expected, rtol=1e-5)


LIKELIHOOD = jax.jit(jaxevent.aks.log_likelihood)


@pytest.mark.slow
@examples(6)
@given(recording=recordings(fewest_frames=1), one_sided=st.booleans())
def test_likelihood_equals_that_of_measurements_one_by_one(recording, one_sided):
    params = params_of(jaxevent.aks, **{**OPTIONS, "one_sided": one_sided})
    features, _ = jaxevent.aks.prepare(recording, [recording.start], params)
    _, expected = oracles.reconstruct("aks", recording, params.values(), [], likelihood=True)
    total = LIKELIHOOD(params, features)
    np.testing.assert_allclose(total, expected, rtol=1e-5 if one_sided else 1e-9)


@pytest.mark.slow
def test_next_recording_of_the_sensor_compiles_nothing():
    params = jaxevent.akf.Params()

    def reconstruct(seed, n, frames):
        recording = random_recording(seed, n, frames)
        return jaxevent.akf.estimate(recording, params)(recording.frames.t)

    reconstruct(1, 300, 5)
    compiled = []

    def listen(event, duration, **kwargs):
        if event == "/jax/core/compile/backend_compile_duration":
            compiled.append(event)

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        reconstruct(2, 2_000, 40)
        assert compiled == []
        jax.jit(lambda x: x + 1.5)(jnp.zeros(17))
        assert compiled  # the listener works
    finally:
        jax.monitoring.clear_event_listeners()


def test_times_must_make_sense():
    recording = random_recording(1, 20, 2)
    video = jaxevent.akf.estimate(recording)
    with pytest.raises(jaxevent.InputError, match="integers are microseconds, floats seconds"):
        video(np.array([5_000.0]))
    with pytest.raises(jaxevent.InputError, match="not finite"):
        video(np.array([np.nan]))
    np.testing.assert_array_equal(video(0.05).mean, video(50_000).mean)


def test_stored_recording_gives_the_same_images(tmp_path):
    """Events and frames read window by window from a file."""
    recording = random_recording(12, 400, 30, exposure=900)
    jaxevent.save(recording, tmp_path / "stored.h5")
    stored = jaxevent.load(tmp_path / "stored.h5", in_memory=False)
    params = params_of(jaxevent.akf, **PARAMS)
    times = np.linspace(recording.start, recording.stop, 9).astype(np.int64)
    expected = look(jaxevent.akf.estimate(recording, params, window_events=90), times)
    images = look(jaxevent.akf.estimate(stored, params, window_events=90), times)
    np.testing.assert_array_equal(images, expected)


def test_frames_of_an_automatic_exposure_share_a_scale():
    """Grey levels divided by the gain, also where only some of the frames are given."""
    recording = random_recording(13, 40, 4)
    gain = np.array([1.0, 2.0, 0.5, 4.0])
    recording = dataclasses.replace(recording, extra={"gain": gain}).with_frames(slice(1, 4))
    image, _, _ = jaxevent.last_frame.estimate(recording)(recording.frames.t)
    expected = np.asarray(recording.frames.images) / 255 / gain[1:, None, None]
    np.testing.assert_allclose(image, expected, rtol=1e-12, atol=1e-14)
    wrong = dataclasses.replace(recording, extra={"gain": gain})
    with pytest.raises(jaxevent.InputError, match="one positive number for each of the 3 frames"):
        jaxevent.last_frame.estimate(wrong)
    bare = dataclasses.replace(wrong, frames=None)  # without frames gains tell nothing
    assert jaxevent.high_pass.estimate(bare)(bare.stop).valid.any()


@pytest.mark.parametrize("width", [0.0, 0.4])
def test_gradients_by_thresholds_integrate_to_the_change_of_a_loss(width):
    """With soft bounds on calibrated thresholds; hard ones make jumps that no gradient shows."""
    recording = random_recording(5, 500, 5)
    times = np.linspace(recording.start, recording.stop, 9).astype(np.int64)
    images = chain(jaxevent.augmented, recording, times)
    params = jaxevent.augmented.Params(ratio_width=width)

    @jax.jit
    @jax.vmap
    @jax.value_and_grad
    def loss(log_c):
        return (images(params.with_raw({"c_on": log_c})).mean ** 2).mean()

    log_c = np.linspace(np.log(0.08), np.log(0.12), 401)
    value, slope = (np.asarray(v) for v in loss(log_c))
    gained = np.trapezoid(slope, log_c)
    agree = abs(gained - (value[-1] - value[0])) < 0.01 * np.abs(slope).mean() * np.ptp(log_c)
    assert agree == (width > 0)


def test_presets():
    paper, hdr = (jaxevent.akf.Params(preset=name) for name in ("paper", "hdr"))
    assert paper.values() == jaxevent.akf.Params(ratio_width=0.0).values()
    assert hdr.weighting == "certainty" and not hdr.calibrate
    assert float(jaxevent.akf.Params(preset="hdr", I0=0.5).I0) == 0.5
    with pytest.raises(jaxevent.InputError, match="no preset 'hdri'; did you mean 'hdr'"):
        jaxevent.akf.Params(preset="hdri")
    with pytest.raises(jaxevent.InputError, match="weighting is 'none'; give 'linear' or"):
        jaxevent.akf.Params(weighting="none")
    with pytest.raises(jaxevent.InputError, match="certainty is 2; give a list of numbers"):
        jaxevent.akf.Params(certainty=2)


@pytest.mark.slow
def test_a_video_becomes_an_xarray_dataset():
    xarray = pytest.importorskip("xarray", reason="needs the extra xarray")
    recording = random_recording(6, 90, 4)
    video = jaxevent.akf.estimate(recording, params_of(jaxevent.akf, **PARAMS))
    times = [recording.start + 5_000, recording.start + 1_000]
    dataset = video.to_xarray(times)
    assert isinstance(dataset, xarray.Dataset)
    for name, array in zip(("image", "variance", "valid"), video(times), strict=True):
        assert dataset[name].dims == ("t", "y", "x")
        np.testing.assert_array_equal(dataset[name].values, array)
    assert dataset.t.values.tolist() == times and dataset.attrs["method"] == "akf"
