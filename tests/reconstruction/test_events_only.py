"""Video from events alone: by the contract, against its own JAX path, differences and truth."""

import dataclasses
import functools
import pickle

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from commands import fails
from scipy.ndimage import gaussian_filter, map_coordinates

import jaxevent
from jaxevent.reconstruction.events_only.gradient import sample_variance, solve_equations
from jaxevent.recording import Frames, Recording

events_only = jaxevent.events_only
SIZE = (24, 32)  # height, width
VELOCITY = np.array([60.0, 25.0])  # px/s, x before y
C_ON, C_OFF = 0.2, 0.3
SPAN_US = 300_000
NAMES = ("c_on", "c_off", "silence", "tail", "gradient", "edge", "leak")
PLAIN = events_only.Params(learn=False)


@functools.cache
def log_scene() -> np.ndarray:
    """A smooth log image, wider than what moves through the sensor."""
    noise = np.random.default_rng(5).normal(size=(96, 128))
    smooth = gaussian_filter(noise, 2, mode="wrap")
    return 0.9 * smooth / smooth.std() - 0.8


def log_image(t: float) -> np.ndarray:
    """What the sensor sees at a time (s)."""
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    place = [y - t * VELOCITY[1], x - t * VELOCITY[0]]
    return map_coordinates(log_scene(), place, order=1, mode="grid-wrap")


@functools.cache
def translated(shift_us: int = 0) -> Recording:
    """Events of a scene that moves evenly."""
    level, found = log_image(0.0), []
    for k in range(1, SPAN_US // 500):
        now = log_image(k * 5e-4)
        for sign, c in ((1, C_ON), (-1, C_OFF)):
            y, x = np.nonzero(sign * (now - level) >= c)
            level[y, x] += sign * c
            found.append((np.full(len(x), 500 * k), x, y, np.full(len(x), sign > 0)))
    t, x, y, p = (np.concatenate(part) for part in zip(*found, strict=True))
    size = {"width": SIZE[1], "height": SIZE[0]}
    return Recording.from_arrays(t.astype(np.int64) + shift_us, x, y, p, **size)


class EvenFlow:
    """The true flow."""

    def flow(self, times, extrapolate=False):
        return np.broadcast_to(VELOCITY, (np.size(times), *SIZE, 2)).astype(np.float32)


def correlation(image: np.ndarray, truth: np.ndarray) -> float:
    inner = (slice(3, -3), slice(3, -3))
    return float(np.corrcoef(image[inner].ravel(), truth[inner].ravel())[0, 1])


def with_hot_pixels(recording: Recording, share: float, each: int) -> Recording:
    """Add pixels that fire without cause, so many events each."""
    rng, n = np.random.default_rng(8), SIZE[0] * SIZE[1]
    place = np.repeat(rng.choice(n, round(share * n), replace=False), each)
    y, x = np.divmod(place, SIZE[1])
    noise = rng.integers(0, SPAN_US, len(place)), x, y, rng.random(len(place)) < 0.5
    old = recording.events[:]
    columns = [np.r_[getattr(old, name), part] for name, part in zip("txyp", noise, strict=True)]
    order = np.argsort(columns[0], kind="stable")
    size = {"width": SIZE[1], "height": SIZE[0]}
    return Recording.from_arrays(*(column[order] for column in columns), **size)


def test_many_hot_pixels_leave_the_image():
    # Windows count events: with those of hot pixels nothing would move in them.
    recording = with_hot_pixels(translated(), 0.2, 600)
    params = PLAIN.replace(c_on=C_ON, c_off=C_OFF, window=1.0, learn=True)
    mean, _, valid = events_only.estimate(recording, params, motion=EvenFlow())(0.15)
    L = np.log(mean[0] + float(params.I0))
    assert correlation(L, log_image(0.15)) > 0.8
    assert valid.mean() > 0.8


@pytest.mark.slow
def test_images_are_those_of_the_scene_up_to_scale():
    params = PLAIN.replace(c_on=C_ON, c_off=C_OFF, window=1.0)
    video = events_only.estimate(translated(), params, motion=EvenFlow())
    for t in (0.1, 0.2):
        L = np.log(video(t).mean[0] + float(params.I0))
        assert correlation(L, log_image(t)) > 0.93
    np.testing.assert_allclose(video.flow([0.1])[0, 5, 5], VELOCITY)
    causal, earlier = (
        events_only.estimate(events, params, motion=EvenFlow(), causal=True)
        for events in (translated(), translated()[:0.2])
    )
    np.testing.assert_array_equal(causal(0.19).mean, earlier(0.19).mean)
    assert (causal(0.19).mean != video(0.19).mean).any()


def with_frames(stamps: list[float], seen: list[float], gain: float = 1.0) -> Recording:
    """Give the recording frames of what was seen at some times (s), F = 0.6 L - 1, and stamps."""
    images = np.stack([gain * (np.exp(0.6 * log_image(t) - 1) - 0.02) for t in seen])
    images = images.clip(0, 1).astype(np.float32)
    frames = Frames(
        np.rint(np.multiply(stamps, 1e6)).astype(np.int64), images, np.zeros_like(stamps, np.int64)
    )
    return dataclasses.replace(translated(), frames=frames)


@pytest.mark.slow
def test_one_frame_gives_the_scale_whatever_its_clock():
    params = PLAIN.replace(c_on=C_ON, c_off=C_OFF, window=1.0, use_frames=True)
    inner = np.s_[0, 3:-3, 3:-3]

    def image(recording, **changes):
        video = events_only.estimate(recording, params.replace(**changes), motion=EvenFlow())
        return np.log(video(0.2).mean + float(params.I0))

    truth = 0.6 * log_image(0.2)[None] - 1
    for stamp in (0.15, 0.17, 0.13):
        found = image(with_frames([stamp], [0.15]))
        assert np.sqrt(np.mean((found - truth)[inner] ** 2)) < 0.16
        assert correlation(found[0], truth[0]) > 0.97
    # A camera whose response is known shows the same.
    plain = with_frames([0.15], [0.15])
    assert plain.frames is not None
    curved = dataclasses.replace(plain.frames, images=np.sqrt(np.asarray(plain.frames.images)))
    extra = {"response": np.linspace(0, 1, 4096) ** 2}
    through = image(dataclasses.replace(plain, frames=curved, extra=extra))
    np.testing.assert_allclose(through, image(plain), atol=1e-3)
    # Frames without an unclipped pixel leave the image as it is.
    clipped, none = with_frames([0.1, 0.2], [0.1, 0.2], 1e6), image(translated())
    np.testing.assert_array_equal(image(clipped), none)
    np.testing.assert_array_equal(image(with_frames([0.15], [0.15]), use_frames=False), none)
    assert np.sqrt(np.mean((none - truth)[inner] ** 2)) > 0.5


@pytest.mark.slow
def test_images_do_not_depend_on_order_time_or_copies():
    times = np.array([80_000, 200_000, 140_000])
    video = events_only.estimate(translated())
    whole = video(times)
    for row, t in enumerate(times):
        np.testing.assert_array_equal(video(t).mean[0], whole.mean[row])
    again = pickle.loads(pickle.dumps(video))(times)
    np.testing.assert_array_equal(again.covariance, whole.covariance)
    late = events_only.estimate(translated(7_000_000))(times + 7_000_000)
    np.testing.assert_allclose(late.mean, whole.mean, rtol=1e-5)


@pytest.mark.slow
def test_jax_makes_the_images_of_the_host():
    """For a batch of parameters at once."""
    host = events_only.estimate(translated())(0.15)
    with jax.enable_x64(False):
        images = events_only.prepare_images(translated(), [0.15])
        leaks = jnp.array([float(events_only.Params().leak), 0.1], jnp.float32)
        made = jax.jit(jax.vmap(lambda v: images(events_only.Params(leak=v))))(leaks)
    means = made.mean.reshape(2, *SIZE)
    np.testing.assert_allclose(means[0], host.mean[0], rtol=2e-3)
    assert np.log(means[1]).std() < 0.5 * np.log(means[0]).std()  # what leaks fades
    assert 0.5 < np.median(made.covariance[0].reshape(SIZE) / host.covariance[0]) < 2


@pytest.mark.slow
def test_derivatives_are_differences():
    """Of image and variance by all numbers at once, through the solution."""
    weights = np.random.default_rng(0).normal(size=SIZE)
    params = PLAIN.replace(leak=1e-2, edge=1.0, gradient=3.0, tail=5.0)
    features, _ = events_only.prepare(translated(), [0.02, 0.15], params)
    filled = (features.equations.weight + features.equations.silent == 0).sum(1)
    assert filled.max() > 0  # with rows of no weight, as many as another window has more
    window = jax.tree.map(lambda leaf: leaf[filled.argmax()], features.equations)
    random = np.random.default_rng(1)
    direction = {name: float(random.normal()) for name in NAMES}

    @jax.jit
    @jax.value_and_grad
    def loss(step, window):
        moved = params.replace(**{
            name: getattr(params, name) * jnp.exp(step * direction[name])
            for name in NAMES
        })  # fmt: skip
        u = solve_equations(window, moved)
        V = sample_variance(u, window, moved)
        return (weights * (u - u.mean() + 0.1 * jnp.log(V))).sum()

    (_, slope), step = loss(0.0, window), 1e-3
    difference = (loss(step, window)[0] - loss(-step, window)[0]) / (2 * step)
    np.testing.assert_allclose(slope, difference, rtol=0.01)


@pytest.mark.slow
def test_the_likelihood_refuses_ratios_of_thresholds_far_from_the_true_one():
    held = events_only.prepare_likelihood(translated(), [0.1, 0.2], PLAIN)
    ratios = np.array([0.75, 1.0, 1.5, 2.25, 3.0])

    @jax.jit
    def likelihood(ratio):
        c = PLAIN.replace(c_on=0.2 / jnp.sqrt(ratio), c_off=0.2 * jnp.sqrt(ratio))
        return events_only.log_likelihood(c, held)

    found = [likelihood(r) for r in ratios]
    assert ratios[np.argmax(found)] in (1.0, C_OFF / C_ON)  # it leans to equal thresholds
    assert found[2] > max(found[0], found[3], found[4])


@pytest.mark.parametrize("size", [(1, 1), (1, 5), (5, 1), (2, 3)])
def test_any_size(size):
    random, n = np.random.default_rng(1), 40
    t, (y, x) = np.sort(random.integers(0, 50_000, n)), (random.integers(0, s, n) for s in size)
    recording = Recording.from_arrays(
        t, x, y, random.random(n) < 0.5, width=size[1], height=size[0]
    )
    found = events_only.estimate(recording)([recording.start, recording.stop])
    assert all(np.isfinite(part).all() for part in found)


def test_wrong_calls_end_in_a_sentence(tmp_path, capsys):
    path = tmp_path / "events.h5"
    jaxevent.save(translated(), path)
    words = ["reconstruct", path, "--method", "events-only", "--out", tmp_path / "out.h5"]
    fails(capsys, [*words, "--at", "frames"], "give --rate instead")
    (tmp_path / "wrong.toml").write_text("window = -1.0")
    fails(capsys, [*words, "--params", tmp_path / "wrong.toml"], "window is -1.0; it must not be")
    with pytest.raises(jaxevent.InputError, match="no times to prepare images for"):
        events_only.prepare(translated(), [])
    with pytest.raises(jaxevent.InputError, match="has no option 'refine'"):
        events_only.estimate(translated(), refine=True)
    with pytest.raises(jaxevent.InputError, match="'events-only' takes whole recordings"):
        events_only.live((32, 24), frames=False)
