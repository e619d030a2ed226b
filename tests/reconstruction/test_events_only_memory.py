"""Memory of video from events alone: closed forms of a ramp, fading, and requests in any order."""

import numpy as np

from jaxevent import Recording
from jaxevent.reconstruction.events_only.memory import (
    KEYS_PER_BLOCK,
    MemoryParams,
    carry,
    discount,
    fuse,
    measure_gradient,
)
from jaxevent.reconstruction.events_only.params import Params
from jaxevent.reconstruction.events_only.prior import GradientPrior
from jaxevent.reconstruction.events_only.rows import make_rows
from jaxevent.reconstruction.events_only.windows import WindowSolver

SHAPE = 24, 30
SLOPE = np.array([0.05, -0.04])  # ln I / px
SPEED = 100.0  # px/s
THRESHOLD = 0.1
TURN_US = 200_000  # the motion is horizontal before, vertical from then on


class Turning:
    """Motion of the whole image: a `Paths` towards the time `at` and a `FlowSource`."""

    covariance = None  # the paths are known
    spacing = 1.0

    def __init__(self, at=0):
        self.at = at

    def moved(self, t):
        t = np.asarray(t, np.float64)
        x, y = np.minimum(t, TURN_US), np.maximum(t - TURN_US, 0)
        return SPEED * 1e-6 * x, SPEED * 1e-6 * y

    def carry(self, x, y, t):
        (x0, y0), (x1, y1) = self.moved(t), self.moved(self.at)
        return (x + x1 - x0).astype(np.float32), (y + y1 - y0).astype(np.float32)

    def flow(self, times, extrapolate=False):
        late = np.atleast_1d(times) >= TURN_US
        flow = SPEED * np.stack([~late, late], -1).astype(np.float32)
        return np.broadcast_to(flow[:, None, None], (len(flow), *SHAPE, 2))


def ramp_recording(shift_us=0):
    """Events of the plane SLOPE . (x, y) that moves as `Turning` says, one at each crossing."""
    t = np.arange(0, 2 * TURN_US, 500)
    y, x = np.indices(SHAPE)
    moved = Turning().moved(t)
    level = x[..., None] * SLOPE[0] + y[..., None] * SLOPE[1] - np.tensordot(SLOPE, moved, 1)
    step = np.diff(np.floor(level / THRESHOLD + 0.5), axis=-1)
    row, column, k = np.nonzero(step)
    order = np.argsort(k, kind="stable")
    row, column, k = row[order], column[order], k[order]
    on = step[row, column, k] > 0
    return Recording.from_arrays(
        t[k + 1] + shift_us, column, row, on, width=SHAPE[1], height=SHAPE[0], time_unit="us"
    )


def measured(recording, start, stop, at):
    events = recording.events
    part = events[events.index(start) : events.index(stop)]
    rows = make_rows(part, Turning(at), np.full(2, THRESHOLD), SHAPE, (start, stop))
    return measure_gradient(rows, 0.5)


def random_memory(seed, gain=1.0):
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(*SHAPE, 2, 2))
    information = gain * (root @ root.swapaxes(-1, -2) + 0.1 * np.eye(2))
    return GradientPrior(
        rng.normal(size=(*SHAPE, 2)).astype(np.float32), information.astype(np.float32)
    )


INNER = np.s_[8:16, 10:20]


def test_a_window_measures_the_gradient_along_its_motion_alone():
    horizontal = measured(ramp_recording(), 0, TURN_US, TURN_US)
    assert np.allclose(horizontal.gradient[INNER][..., 0], SLOPE[0], rtol=0.2)
    assert np.allclose(horizontal.gradient[INNER][..., 1], 0, atol=1e-6)
    information = horizontal.information[INNER]
    assert (information[..., 0, 0] > 10 / THRESHOLD**2).all()
    assert np.abs(information[..., 1, :]).max() < 1e-6 * information[..., 0, 0].min()


def test_after_a_turn_both_components_of_the_gradient_are_known():
    recording = ramp_recording()
    old = measured(recording, 0, TURN_US, TURN_US)
    stop = TURN_US + 100_000
    kept = carry(old, Turning(TURN_US), stop, (0.0, 0.0))
    both = fuse(kept, measured(recording, TURN_US, stop, stop), THRESHOLD)
    assert np.allclose(both.gradient[14:18, 10:20], SLOPE, rtol=0.15)


def test_an_image_after_a_turn_has_the_edges_seen_before_it():
    recording = ramp_recording()
    params = Params().replace(c_on=THRESHOLD, c_off=THRESHOLD, learn=False, window=1.0)
    windows = WindowSolver(recording, params, motion=Turning(), causal=True)
    windows.memory.params = MemoryParams(forgetting=0.1)
    image = windows(TURN_US + 150_000).solution.log_image
    slopes = [np.diff(image, axis=axis)[17:20, 10:20].mean() for axis in (1, 0)]
    assert np.allclose(slopes, SLOPE, rtol=0.25)
    windows = WindowSolver(recording, params, motion=Turning(), causal=True)
    windows.memory.params = MemoryParams(forgetting=1e12)
    forgotten = windows(TURN_US + 150_000).solution.log_image
    assert abs(np.diff(forgotten, axis=1)[17:20, 10:20].mean()) < 0.3 * abs(SLOPE[0])


def test_fusion_is_that_of_gaussians():
    one, other = random_memory(0), random_memory(1)
    both = fuse(one, other, 1.0)
    L = one.information + other.information
    eta = np.einsum("hwij,hwj->hwi", one.information, one.gradient)
    eta += np.einsum("hwij,hwj->hwi", other.information, other.gradient)
    expected = np.linalg.solve(L + 1e-3 * np.eye(2), eta[..., None])[..., 0]
    assert np.allclose(both.gradient, expected, rtol=1e-3, atol=1e-4)
    assert np.allclose(both.information, L)


def test_information_fades_to_that_of_the_noise_gained():
    memory = random_memory(2)
    here = Turning(0)
    faded = carry(memory, here, 0, (0.5, 0.0)).information
    exact = np.linalg.inv(np.linalg.inv(memory.information) + 0.5 * np.eye(2))
    assert np.allclose(faded[:-1, :-1], exact[:-1, :-1], rtol=1e-3, atol=1e-4)
    uncertain = carry(memory, here, 0, (0.0, 0.3)).information
    gx = np.stack([np.diff(memory.gradient, axis=1)[:-1], np.diff(memory.gradient, axis=0)[:, :-1]])
    Q = 0.3 * np.einsum("khwi,khwj->hwij", gx, gx)
    exact = np.linalg.inv(np.linalg.inv(memory.information[:-1, :-1]) + Q)
    assert np.allclose(uncertain[:-1, :-1], exact, rtol=1e-3, atol=1e-4)
    assert carry(memory, here, 0, (1e9, 0.0)).information.max() < 1e-8


def test_what_enters_the_image_is_not_known():
    late = carry(random_memory(3), Turning(0), 50_000, (0.0, 0.0))
    assert not late.information[:, :5].any()
    assert (late.information[:, 5:, 0, 0] > 0).all()


def test_a_contradicted_memory_loses_and_a_confirmed_one_does_not():
    new = random_memory(4, gain=1e3)
    far = GradientPrior(new.gradient + 5, new.information)
    assert np.allclose(discount(new, new, 1.0, 2.0).information, new.information, rtol=1e-5)
    assert (discount(far, new, 1.0, 2.0).information < 0.01 * far.information).all(
        where=np.eye(2) > 0
    )


def windows_of(recording):
    params = Params().replace(c_on=THRESHOLD, c_off=THRESHOLD, learn=False, window=0.45)
    return WindowSolver(recording, params, motion=Turning())


def test_images_do_not_depend_on_earlier_requests_and_few_memories_are_kept():
    recording = ramp_recording()
    windows = windows_of(recording)
    times = [390_000, 20_000, 211_000, 20_000, 350_000, 399_999]
    first = [windows(t, variance=False).solution.log_image for t in times]
    kept = [len(memories) for _, memories in windows.memory._blocks.values()]
    assert windows.memory.last > 2 * KEYS_PER_BLOCK
    assert max(kept) <= KEYS_PER_BLOCK
    for t, image in zip(times[::-1], first[::-1], strict=True):
        assert (windows_of(recording)(t, variance=False).solution.log_image == image).all()


def test_causal_images_do_not_depend_on_later_events():
    recording = ramp_recording()
    params = Params().replace(c_on=THRESHOLD, c_off=THRESHOLD, learn=False, window=1.0)
    at = 310_000
    early = recording[: at * 1e-6]
    images = [
        WindowSolver(part, params, motion=Turning(), causal=True)(at, variance=False)
        for part in (recording, early)
    ]
    assert images[0].prior.information.any()
    assert (images[0].solution.log_image == images[1].solution.log_image).all()


def test_information_of_one_direction_stays_finite_and_positive():
    along = np.random.default_rng(5).normal(size=(*SHAPE, 2)).astype(np.float32) * 1e4
    memory = GradientPrior(along, (along[..., None] * along[..., None, :]).astype(np.float32))
    faded = carry(memory, Turning(0), 0, (1e3, 1e3))
    both = fuse(discount(faded, memory, 0.1, 2.0), memory, 0.1)
    for one in (faded, both):
        assert np.isfinite(one.gradient).all()
        values = np.linalg.eigvalsh(one.information.astype(np.float64))
        assert np.isfinite(values).all()
        assert (values >= -1e-6 * np.abs(values).max()).all()
