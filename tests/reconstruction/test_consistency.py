"""Events that report other changes of log intensity than frames, and the warning of it."""

import dataclasses
import warnings

import numpy as np
import pytest

import jaxevent
from jaxevent.errors import InputWarning
from jaxevent.estimator import Estimate
from jaxevent.reconstruction.consistency import change_ratio, events_contradict_frames
from jaxevent.reconstruction.video import ImageSequence
from jaxevent.recording import Events, Frames, Recording

C, I0, WIDTH, HEIGHT = 0.2, 0.003, 40, 30
Params = jaxevent.akf.Params


def recorded(reverse=False):
    """Six frames whose log intensity ln(I + I0) wanders, and its events of threshold C.

    Of each change less than C stays unreported, so that frames change by a few percent more.
    """
    rng = np.random.default_rng(0)
    level = np.log(rng.uniform(0.05, 0.9, (6, HEIGHT * WIDTH)) + I0)
    stamps, rows = 10_000 + 20_000 * np.arange(6), []
    crossed = np.trunc((level - level[0]) / C).astype(int)
    for k, steps in enumerate(np.diff(crossed, axis=0)):
        pixel = np.repeat(np.arange(steps.size), np.abs(steps))
        t = rng.integers(stamps[k] + 1, stamps[k + 1], len(pixel))
        rows.append(np.c_[t, pixel, np.repeat(steps > 0, np.abs(steps)) ^ reverse])
    t, pixel, p = np.concatenate(rows)[np.argsort(np.concatenate(rows)[:, 0], kind="stable")].T
    x, y = (pixel % WIDTH).astype(np.uint16), (pixel // WIDTH).astype(np.uint16)
    images = (np.exp(level) - I0).astype(np.float32).reshape(6, HEIGHT, WIDTH)
    frames = Frames(stamps, images, np.zeros_like(stamps))
    return Recording("wandering", WIDTH, HEIGHT, Events(t, x, y, p > 0), frames)


def test_the_ratio_is_that_of_thresholds():
    recording = recorded()
    right = change_ratio(recording, Params(c_on=C, c_off=C, I0=I0))
    assert right.ratio == pytest.approx(1, abs=0.1) and right.agreement > 0.99
    assert right.pixels > 1000 and right.sigma < 0.01
    half = change_ratio(recording, Params(c_on=C / 2, c_off=C / 2, I0=I0))
    assert half.ratio == pytest.approx(2 * right.ratio, rel=1e-5)
    # Of frames that are stamped early, on the events' clock.
    late = dataclasses.replace(recording.frames, t=recording.frames.t - 5000)
    moved = dataclasses.replace(recording, frames=late)
    given = Params(c_on=C, c_off=C, I0=I0, clock_offset=0.005)
    assert change_ratio(moved, given) == right


def test_contradictions_are_said_with_the_parameters():
    recording = recorded()
    said = events_contradict_frames(recording, Params(c_on=C, c_off=C))
    assert said is not None
    assert said.startswith("wandering: events contradict frames") and "\n" not in said
    assert "c_on = 0.2, c_off = 0.2 and I0 = 1; " in said and "I0 about 0.003" in said
    high = events_contradict_frames(recording, Params(c_on=C / 3, c_off=C / 3, I0=I0))
    assert high is not None
    assert "changes by 3.2 times" in high and "higher thresholds" in high
    for c in (C / 1.5, C, 1.5 * C):
        assert events_contradict_frames(recording, Params(c_on=c, c_off=c, I0=I0)) is None


def test_what_differs_by_more_than_a_scale_is_no_matter_of_thresholds():
    wrong = Params(c_on=C, c_off=C)
    assert events_contradict_frames(recorded(reverse=True), wrong) is None
    recording = recorded()
    for other in (
        dataclasses.replace(recording, frames=None),
        recording.with_frames(slice(0, 1)),
        dataclasses.replace(recording, events=Events.empty()),
        dataclasses.replace(recording, events=recording.events[:50]),
    ):
        assert change_ratio(other, wrong) is None


@pytest.mark.parametrize("name", ["edi", "blend", "high-pass"])
def test_the_first_reading_warns_of_methods_that_fuse_both(name):
    recording, method = recorded(), jaxevent.METHODS[name]
    with (
        pytest.warns(UserWarning, match="events contradict frames")
        if method.fuses
        else (warnings.catch_warnings())
    ):
        video = method.estimate(recording, method.Params(c_on=C, c_off=C))
        video(recording.frames.t)
    video(recording.frames.t)  # once
    method.estimate(recording, method.Params(c_on=C, c_off=C, I0=I0))(recording.frames.t)


@pytest.mark.parametrize(
    "name", ["slider_depth.zip", "davis346_street.npz", "evbench_seq3_calibrated.npz"]
)
def test_real_recordings_agree_with_the_defaults(name, data):
    recording = jaxevent.load(data / name)
    assert events_contradict_frames(recording, Params()) is None
    assert events_contradict_frames(recording, Params(c_on=C, c_off=C)) is not None


class Flat(ImageSequence):
    """Images of one grey, which no kernel makes."""

    dtype = np.dtype(np.float32)

    def _read(self, times):
        shape = len(times), HEIGHT * WIDTH
        yield times, Estimate(*np.ones((2, *shape), np.float32), np.ones(shape, bool))


@pytest.mark.parametrize("has_frames", [True, False])
def test_without_frames_images_are_valid_from_the_first_event_on(has_frames):
    recording = recorded() if has_frames else dataclasses.replace(recorded(), frames=None)
    video = Flat(jaxevent.akf, recording, Params(c_on=C, c_off=C, I0=I0))
    times = np.array([30_000, 60_000])
    if has_frames:
        assert video(times).valid.all()
        return
    with pytest.warns(InputWarning, match="holds no frames, .*; take jaxevent.events_only"):
        valid = video(times).valid
    for t, found in zip(times, valid, strict=True):
        seen, e = np.zeros((HEIGHT, WIDTH), bool), recording.events
        seen[e.y[e.t <= t], e.x[e.t <= t]] = True
        assert np.array_equal(found, seen) and 0 < seen.mean() < 1
