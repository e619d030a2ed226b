"""Checks of recordings find each fault that is put into a sound recording, and none in that."""

import dataclasses
import functools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter

import jaxevent
from jaxevent.calibration.correspondence import TRANSFORMS
from jaxevent.calibration.hot import find_hot_pixels, measure_dead_share
from jaxevent.calibration.light import common_change
from jaxevent.calibration.sampling import count_between, take_sample
from jaxevent.events import filter_refractory
from jaxevent.recording import Events, Frames, Recording
from jaxevent.show.describe import describe
from jaxevent.simulate import faults

SIDE, SECONDS, STEP_US = 64, 0.9, 1000
NAMES = {
    "half of the events dropped": "missing events",
    "50 ms without events": "missing events",
    "polarity inverted": "inverted polarity",
    "polarity random": "lost polarity",
    "polarity all ON": "lost polarity",
    "20 % hot pixels": "hot pixels",
    "half of the pixels dead": "dead pixels",
    "a fifth of the columns dead": "dead pixels",
    "rows flipped": "flipped or swapped axes",
    "columns flipped": "flipped or swapped axes",
    "axes swapped": "flipped or swapped axes",
    "frames flicker": "flickering frames",
    "frames clipped": "clipped frames",
    "frames blurred": "blurred frames",
    "frames at 3 Hz": "sparse frames",
    "frames 20 ms late": "clock offset",
    "frames 20 ms early": "clock offset",
    "clocks disjoint": "disjoint clocks",
}


def passing_texture(seed: int = 0, late_us: int = 0, c: float = 0.25) -> Recording:
    """A texture that passes: events where ln I has moved by a threshold, frames each 40 ms."""
    recording = passing_on_time(seed, c)
    assert recording.frames is not None
    late = dataclasses.replace(recording.frames, t=recording.frames.t + late_us)
    return dataclasses.replace(recording, frames=late)


@functools.cache
def passing_on_time(seed: int, c: float) -> Recording:
    rng = np.random.default_rng(seed)
    wide = gaussian_filter(rng.normal(size=(SIDE, 4 * SIDE)), 2, mode="wrap")
    wide = 0.16 * np.exp(0.7 * wide / wide.std()).clip(None, 5.5)

    def image(t_us: int) -> np.ndarray:
        part, x = math.modf(60e-6 * t_us)
        left, right = (np.arange(SIDE) + int(x) + k for k in (0, 1))
        columns = wide.take(left, 1, mode="wrap"), wide.take(right, 1, mode="wrap")
        return (1 - part) * columns[0] + part * columns[1]

    at = np.log(image(0)) + c * rng.uniform(-1, 1, (SIDE, SIDE))
    parts = []
    for t in range(STEP_US, int(SECONDS * 1e6), STEP_US):
        steps = np.fix((np.log(image(t)) - at) / c).astype(int)
        at += c * steps
        rows, columns = np.nonzero(steps)
        many = np.abs(steps[rows, columns])
        parts.append(
            np.repeat([np.full(len(rows), t), columns, rows, steps[rows, columns] > 0], many, 1)
        )
    t, x_of, y_of, p = np.concatenate(parts, 1)
    t = t - rng.integers(0, STEP_US, len(t))  # within the step
    order = np.argsort(t, kind="stable")
    events = Events(*(column[order] for column in (t, x_of, y_of, p)))
    stamps = np.arange(20_000, int(SECONDS * 1e6), 40_000)
    grey = np.rint(255 * np.stack([image(one) for one in stamps.tolist()]).clip(0, 1))
    frames = Frames(stamps, grey.astype(np.uint8), np.zeros(len(stamps), int))
    return Recording("passing", SIDE, SIDE, events, frames)


@pytest.fixture(scope="module")
def sound():
    return passing_texture()


def names_of(recording):
    return [fault.name for fault in jaxevent.check_consistency(recording)]


def test_sound_recordings_have_no_fault(sound):
    assert jaxevent.check_consistency(sound) == ()
    assert names_of(dataclasses.replace(sound, frames=None)) == []
    assert dict(describe(sound))["faults"] == "none found"


@pytest.mark.parametrize("fault", faults.FAULTS)
def test_each_fault_is_found_alone(sound, fault):
    faulty = faults.FAULTS[fault](sound, 0)
    found = jaxevent.check_consistency(faulty)
    assert [one.name for one in found] == [NAMES[fault]]
    assert found[0].statistic > found[0].limit > 0
    assert dict(describe(faulty))["fault"] == str(found[0])


@pytest.mark.parametrize(
    ("first", "second"),
    [
        ("polarity inverted", "frames 20 ms late"),
        ("columns flipped", "frames flicker"),
        ("axes swapped", "frames blurred"),
    ],
)
def test_what_frames_show_is_told_beside_events_that_are_turned(sound, first, second):
    faulty = faults.FAULTS[second](faults.FAULTS[first](sound, 0), 0)
    assert names_of(faulty) == [NAMES[first], NAMES[second]]


def test_frames_that_show_nothing_new_are_told(sound):
    images = sound.frames.images
    twice = np.repeat(images[::2], 2, 0)[: len(images)]
    black = np.zeros_like(images)
    told = [
        jaxevent.check_consistency(
            dataclasses.replace(sound, frames=dataclasses.replace(sound.frames, images=one))
        )[0]
        for one in (twice, black)
    ]
    assert [one.name for one in told] == ["repeated frames", "empty frames"]
    assert told[0].statistic == pytest.approx(0.5, abs=0.05)


@pytest.mark.parametrize("number", range(1, len(TRANSFORMS)))
def test_the_cause_of_a_mismatch_is_named(sound, number):
    """Every way to turn the frames is told from the others, with and without the polarity."""
    name, kind = list(TRANSFORMS.items())[number]
    images = np.asarray(sound.frames.images)
    inverse = next(one for one in TRANSFORMS.values() if (one(kind(images[0])) == images[0]).all())
    frames = dataclasses.replace(sound.frames, images=np.stack([inverse(one) for one in images]))
    events = faults.invert_polarity(sound).events if number % 2 else sound.events
    (found,) = jaxevent.check_consistency(dataclasses.replace(sound, events=events, frames=frames))
    changed = name + " and polarity inverted" * (number % 2)
    assert f"with {changed} by" in found.text and changed in found.remedy


def test_swapped_axes_are_healed_by_what_is_named(sound):
    """Events moved as the words say are the sound recording's."""
    e = sound.events
    last = np.uint16(SIDE - 1)
    # Rotated events: (x, y) to (last - y, x). Swapped these are (x, last - y), then rows flip.
    rotated = Events(e.t, last - e.y, e.x, e.p)
    (found,) = jaxevent.check_consistency(dataclasses.replace(sound, events=rotated))
    assert "with axes swapped, then rows flipped by" in found.text
    healed = Events(e.t, rotated.y, last - rotated.x, e.p)
    assert (healed.x == e.x).all() and (healed.y == e.y).all()


def test_bursts(sound):
    e, rng = sound.events, np.random.default_rng(1)
    extra = np.repeat([200_000, 500_000, 700_000], 4000) + rng.integers(0, 900, 12_000)
    x, y = rng.integers(0, SIDE, (2, 12_000))
    columns = ((e.t, extra), (e.x, x), (e.y, y), (e.p, rng.random(12_000) < 0.5))
    t, x, y, p = (np.concatenate(pair) for pair in columns)
    order = np.argsort(t, kind="stable")
    noisy = dataclasses.replace(sound, events=Events(*(c[order] for c in (t, x, y, p))))
    assert names_of(noisy) == ["event bursts"]
    # The same events spread over the recording are noise.
    t[len(e) :] = rng.integers(0, int(SECONDS * 1e6), 12_000)
    order = np.argsort(t, kind="stable")
    spread = dataclasses.replace(sound, events=Events(*(c[order] for c in (t, x, y, p))))
    assert names_of(spread) == []


def test_frames_of_another_scene(sound):
    images = np.asarray(passing_texture(seed=5).frames.images).transpose(0, 2, 1)
    frames = dataclasses.replace(sound.frames, images=images)
    assert names_of(dataclasses.replace(sound, frames=frames)) == ["unrelated events"]


@pytest.mark.parametrize("late_us", [-14_000, 6_000, 14_000])
def test_offset_is_found_beyond_a_quarter_of_the_interval(late_us):
    found = jaxevent.check_consistency(passing_texture(late_us=late_us, c=0.1))
    if abs(late_us) < 10_000:
        assert found == ()
    else:
        assert [fault.name for fault in found] == ["clock offset"]
        assert found[0].statistic == pytest.approx(14e-3, abs=3e-3)
        assert ("earlier" if late_us > 0 else "later") in found[0].text


@pytest.mark.parametrize("most", [20_000, 100_000])
def test_events_that_a_sample_leaves_out_are_known(sound, most, monkeypatch):
    """Dense recordings are sampled at fewer pixels, and not far from the frames."""
    monkeypatch.setattr("jaxevent.calibration.sampling.MAX_EVENTS", most)
    events, sample = sound.events, take_sample(sound)
    place = events.y.astype(int) * sound.width + events.x
    sampled = np.concatenate([[0], np.cumsum(np.isin(place, sample.places))])
    assert 0 < len(sample.places) < sound.width * sound.height
    for segment in sample.segments:
        first, last = segment.span
        offsets = (0, first - int(segment.frame_t[0]), last + 1 - int(segment.frame_t[-1]))
        for offset, covered in zip(offsets, (True, True, False), strict=True):
            known = segment.is_covered(offset)
            assert known[:-1].all() and known[-1] == covered
            counted = count_between(segment, offset).sum((1, 2))
            edges = np.searchsorted(events.t, segment.frame_t + offset)
            np.testing.assert_array_equal(counted[known], np.diff(sampled[edges])[known])


def test_changes_in_common_are_beyond_the_scatter():
    changes = np.random.default_rng(0).normal(size=(3, 400))
    changes[1:] += [[0.5], [-0.5]]
    found = common_change(changes)
    assert found[0] == 0
    np.testing.assert_array_equal(found[1:], np.median(changes[1:], axis=1))


def test_gain_of_frames_is_no_flicker(sound):
    factor = 1 + 0.3 * np.random.default_rng(0).uniform(-1, 1, len(sound.frames))
    faulty = faults.flicker_frames(sound, 0)
    assert names_of(faulty) == ["flickering frames"]
    assert names_of(dataclasses.replace(faulty, extra={"gain": factor})) == []


def test_files_are_checked_as_arrays_are(sound, tmp_path):
    faulty = faults.flip_rows(faults.cut_events(sound))
    jaxevent.save(faulty, tmp_path / "faulty.h5")
    stored = jaxevent.load(tmp_path / "faulty.h5", in_memory=False)
    assert jaxevent.check_consistency(stored) == jaxevent.check_consistency(faulty)
    assert len(jaxevent.check_consistency(faulty)) == 2


def test_stamps_in_milliseconds_are_no_gaps(sound):
    events = dataclasses.replace(sound.events, t=sound.events.t // 1000 * 1000)
    assert names_of(dataclasses.replace(sound, events=events)) == []


@pytest.mark.parametrize(("rate", "share"), [(15, 0.99), (4, 0.85)])
def test_hot_pixels_are_those_that_fire_in_all_parts(rate, share):
    """Of 20 % at 15 events a part 99 % are found, and no pixel of an edge that passes."""
    rng = np.random.default_rng(0)
    counts = rng.poisson(0.1, (8, 50, 50))
    for part in range(8):
        counts[part, :, 6 * part : 6 * part + 6] += rng.poisson(10, (50, 6))
    assert not find_hot_pixels(counts).any()
    hot = rng.random((50, 50)) < 0.2
    found = find_hot_pixels(counts + hot * rng.poisson(rate, counts.shape))
    assert found[hot].mean() > share and not found[~hot].any()


@pytest.mark.parametrize("inverted", [False, True])
def test_a_block_of_dead_pixels_is_told_by_the_frames(sound, inverted):
    """Frames tell it from a region at rest; without frames the two are alike."""
    events = sound.events[:]
    block = (events.x >= 20) & (events.x < 40) & (events.y >= 10) & (events.y < 34)
    columns = (events.t, events.x, events.y, events.p ^ inverted)
    faulty = dataclasses.replace(sound, events=Events(*(one[~block] for one in columns)))
    fault = jaxevent.check_consistency(faulty)[-1]
    assert fault.name == "dead pixels"
    assert fault.statistic == pytest.approx(20 * 24 / SIDE**2, rel=0.2)
    assert names_of(dataclasses.replace(faulty, frames=None)) == []
    still = sound.frames.images.copy()
    still[:, 10:34, 20:40] = still[:1, 10:34, 20:40]
    frames = dataclasses.replace(sound.frames, images=still)
    assert "dead pixels" not in names_of(dataclasses.replace(faulty, frames=frames))


@pytest.mark.parametrize("shape", ["disc", "rows", "dots"])
def test_regions_at_rest_are_not_dead(shape):
    """Pixels count as dead between busy ones that see the same edges, not between hot ones."""
    y, x = np.mgrid[:60, :80]
    moving = {
        "disc": np.hypot(y - 30, x - 40) < 20,
        "rows": y % 8 < 3,
        "dots": (y % 6 == 0) & (x % 6 == 0),
    }[shape]
    rng = np.random.default_rng(0)
    rate = gaussian_filter(rng.normal(size=(8, 60, 80)), (0, 3, 3))
    rate = 5 * np.exp(rate / rate.std())
    counts, hot = rng.poisson(rate * moving), np.zeros(moving.shape, bool)
    assert measure_dead_share(counts, hot) == 0
    broken = rng.random(moving.shape) < 0.3
    share = measure_dead_share(counts * ~broken, hot)
    assert share == (0 if shape == "dots" else pytest.approx(0.3, abs=0.05))
    assert measure_dead_share(counts * ~broken, broken) == 0
    random = rng.poisson(10 * (rng.random(moving.shape) < 0.3), counts.shape)
    assert measure_dead_share(random, hot) == 0
    assert find_hot_pixels(random).sum() > 0.9 * random.any(0).sum()


def test_faulty_recordings_are_what_they_are_called(sound):
    before = sound.events.t.copy()
    cut = faults.cut_events(sound, 3, length=0.05)
    assert np.diff(cut.events.t).max() == pytest.approx(50_000, abs=1000)
    packets = np.unique(faults.drop_packets(sound, 3).events.t // 10_000)
    assert 0.3 < len(packets) / len(np.unique(before // 10_000)) < 0.7
    assert faults.randomise_polarity(sound).events.p.mean() == pytest.approx(0.5, abs=0.02)
    blurred = faults.blur_frames(sound).frames.intensity
    mean = sound.frames.intensity[3:6].mean(0)
    np.testing.assert_allclose(blurred[4], mean, atol=0.5 / 255 + 1e-6)
    assert (np.diff(faults.thin_frames(sound).frames.t) >= 333_333).all()
    hot = faults.add_hot_pixels(sound, 1, share=0.1, rate=50)
    added = len(hot.events) - len(before)
    assert added == pytest.approx(0.1 * SIDE**2 * 50 * SECONDS, rel=0.05)
    for make_faulty in faults.FAULTS.values():
        one, two = (make_faulty(sound, 7).check().events[:].to_structured() for _ in range(2))
        assert (one == two).all()
    assert (sound.events.t == before).all()


def test_few_pixels_that_make_many_of_the_events_are_told(sound):
    few = faults.add_hot_pixels(sound, 1, share=0.002, rate=50 * len(sound.events) / SIDE**2)
    (told,) = (one for one in jaxevent.check_consistency(few) if one.name == "hot pixels")
    assert told.limit < told.statistic < 0.15 and "of the events" in told.text


def test_events_stored_twice_are_told(sound):
    e = sound.events
    twice = Events(*(np.repeat(getattr(e, name), 2) for name in "txyp"))
    (told,) = jaxevent.check_consistency(dataclasses.replace(sound, events=twice))
    assert told.name == "repeated events" and told.statistic == pytest.approx(0.5, abs=0.01)
    once = filter_refractory(twice, 1, size=(SIDE, SIDE))
    assert names_of(dataclasses.replace(sound, events=once)) == []
    # A simulator whose clock has the frames' steps has events of one pixel at one time.
    coarse = dataclasses.replace(twice, t=twice.t // 1000 * 1000)
    assert "repeated events" not in names_of(dataclasses.replace(sound, events=coarse))


@pytest.mark.parametrize(("scale", "unit", "remedy"), [
    (1000, "nanoseconds", "divide the times by 1,000"),
    (1 / 1000, "milliseconds", "multiply the times by 1,000"),
])  # fmt: skip
def test_a_clock_of_another_unit_is_told(sound, scale, unit, remedy):
    e = sound.events
    t = (e.t * scale).astype(np.int64)
    fast = dataclasses.replace(sound, events=dataclasses.replace(e, t=t), frames=None)
    (told,) = (one for one in jaxevent.check_consistency(fast) if one.name == "unusual clock")
    assert f"like {unit}, not microseconds: they last" in told.text and remedy in told.remedy
    assert told.statistic > told.limit
    assert str(told) in dict(describe(fast)).values()


@settings(max_examples=20, deadline=None)
@given(st.data())
def test_odd_recordings_are_checked_without_errors(data):
    """Few events, few frames, one pixel, equal stamps, black and white: an answer each time."""
    draw = data.draw
    width, height = draw(st.integers(1, 30)), draw(st.integers(1, 30))
    count, frames = draw(st.integers(0, 200)), draw(st.integers(0, 5))
    rng = np.random.default_rng(draw(st.integers(0, 99)))
    span = draw(st.sampled_from([1, 1000, 10**6, 10**12]))
    t = np.sort(rng.integers(0, span, count)) + draw(st.sampled_from([0, -(2**60), 2**60]))
    events = Events(
        t, rng.integers(0, width, count), rng.integers(0, height, count), rng.random(count) < 0.5
    )
    images = rng.integers(0, draw(st.sampled_from([1, 256])), (frames, height, width), np.uint8)
    stamps = np.cumsum(rng.integers(1, span + 1, frames))
    shown = Frames(stamps, images, np.zeros(frames, int)) if frames else None
    for fault in jaxevent.check_consistency(Recording("odd", width, height, events, shown)):
        assert fault.statistic > fault.limit and not str(fault).endswith(".")
