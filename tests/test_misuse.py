"""Samples of the table of misuse; `python tests/misuse.py` tries all of it."""

import dataclasses
import functools
import inspect

import numpy as np
import pytest
from misuse import EQUAL, REFUSED, Case, clean, constructions, estimates, is_right, outcome, run

import jaxevent
from jaxevent import InputError
from jaxevent.show.images import video_writer
from jaxevent.simulate import motion_scene


def wrong_of(told: dict[str, str], tried: list[Case]) -> dict[str, str]:
    return {one.name: told[one.name] for one in tried if not is_right(one, told[one.name])}


def test_recordings_of_unusual_arrays():
    tried = constructions()[::9]
    told = {one.name: outcome(one) for one in tried}
    assert len(told) > 150 and not wrong_of(told, tried)


@pytest.mark.slow
def test_estimates_in_a_child_of_limited_memory():
    kinds = ("stride 2", "read-only", "own source/place", "own source/short", "x 600")
    tried = [
        one
        for one in estimates()
        if one.name.startswith("akf.estimate") and any(kind in one.name for kind in kinds)
    ]
    assert len(tried) == len(kinds) and not wrong_of(run(tried), tried)


def test_the_table_notices_what_is_wrong():
    def raises(error: Exception) -> Case:
        def call() -> None:
            raise error

        return Case("a", call, lambda: [1], REFUSED)

    assert not is_right(raises(TypeError()), outcome(raises(TypeError("x"))))
    assert not is_right(raises(TypeError()), outcome(raises(ValueError("x is wrong; correct it"))))
    other = Case("b", lambda: [1, 2], lambda: [1, 3], EQUAL)
    assert outcome(other) == "DIFFERS" and not is_right(other, "DIFFERS")


def unchecked(function):
    """Return a function or class method without the tests' own checks of types."""
    if owner := getattr(function, "__self__", None):
        return functools.partial(inspect.unwrap(function.__func__), owner)
    return inspect.unwrap(function)


@pytest.mark.parametrize(
    "function",
    [
        *(jaxevent.calibrate, jaxevent.check_consistency, jaxevent.akf.Params.for_recording),
        *(jaxevent.mc.Params.for_recording, jaxevent.flow_from_events, jaxevent.blob.find),
        *(jaxevent.egomotion.known_motion, jaxevent.events.undistort),
        *(jaxevent.colour.split_channels, jaxevent.register.trigger_times),
    ],
)
def test_functions_of_a_recording_refuse_what_is_none(function):
    more = ["rotation"] if function.__name__ == "known_motion" else []
    with pytest.raises(InputError, match=r"a recording, not a path; give jaxevent.load\('a.h5'\)"):
        unchecked(function)("a.h5", *more)
    with pytest.raises(InputError, match="a recording, not bare events; give jaxevent.load"):
        unchecked(function)(jaxevent.Events.empty(), *more)


@pytest.mark.parametrize(("name", "more"), [("crop_time", ()), ("crop", (0, 0, 2, 2))])
def test_functions_of_events_refuse_a_path(name, more):
    with pytest.raises(InputError, match="takes events or a recording, not a path; give jaxevent"):
        unchecked(getattr(jaxevent.events, name))("a.h5", *more)


@pytest.fixture(scope="module")
def bar() -> jaxevent.Recording:
    columns = (clean()[name] for name in "txyp")
    return jaxevent.Recording.from_arrays(*columns, width=64, height=48)


def test_a_list_of_lists_of_times_is_refused(bar):
    for read in (jaxevent.high_pass.estimate(bar), jaxevent.flow_from_events(bar)):
        with pytest.raises(InputError, match=r"times have the shape \(1, 2\); give a list"):
            read([[0.07, 0.08]])


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda r: unchecked(jaxevent.events.crop)(r, 0.0, 0, 10, 10), "^x is 0.0; give a whole"),
        (lambda r: unchecked(jaxevent.events.voxel_grid)(r, 5.0), "5.0 bins .* whole number"),
        (lambda r: unchecked(jaxevent.events.downsample)(r, 2.5), "2.5x2.5 .* number from 1 to 48"),
        (lambda r: unchecked(jaxevent.events.select_polarity)(r, "ON"), "'ON' is not possible"),
        (lambda r: unchecked(jaxevent.events.select_polarity)(r, 2), "polarity 2 is not possible"),
        (lambda r: unchecked(motion_scene)("planar", size=(40.5, 30)), "give a whole number"),
        (lambda r: motion_scene("planar", size=(0, 10)), "0x10 pixels, .* correct its size"),
        (lambda r: r[0.1:0.05], "from 100000 to 50000 us ends before it begins"),
        (lambda r: r[9.0:], "no event and no frame from 9000000 us; the recording reaches"),
        (lambda r: jaxevent.load(None), r"the path is None; call jaxevent.load\(path\)"),
        (lambda r: jaxevent.load("https://a.org/b.h5"), "^https://a.org/b.h5: is an address"),
        (lambda r: jaxevent.load("a.h5", size="60x45"), "size = '60x45' must be two positive"),
        (lambda r: jaxevent.load("a.h5", size=(60.0, 45)), "positive numbers .* whole"),
        (lambda r: jaxevent.save("a.h5", r), r"the path is a Recording; .*save\(recording, path"),
        (lambda r: jaxevent.flow_from_events(
            dataclasses.replace(r, events=jaxevent.Events.empty())), "holds no events"),
        (lambda r: r.events[[len(r.events)]], "events have no row .* give rows from 0 to below"),
        (lambda r: r.events[[0, -9_999_999]], "events have no row -9999999"),
        (lambda r: r.events[[1.5]], "by a slice, a mask or a list of rows"),
        (lambda r: r.events[[True]], "a mask of 1 values, but there are .* one value for each"),
        (lambda r: unchecked(r.events.__getitem__)(slice(0.1, 0.2)), r"recording\[start:stop\]"),
        (lambda r: r[[1, 2]:], r"the start is \[1, 2\]; give one finite number"),
        (lambda r: unchecked(jaxevent.events.filter_background)(r, "abc"),
         "^the window of the background filter is 'abc'; give one finite number"),
        (lambda r: unchecked(jaxevent.events.filter_refractory)(r, [1, 2]), r"period is \[1, 2\]"),
        (lambda r: jaxevent.events.filter_background(r, float("nan")), "filter is nan; give one"),
        (lambda r: dataclasses.replace(r, events=jaxevent.Events.empty()).start, "no event and no"),
        (lambda r: dataclasses.replace(r, events=jaxevent.Events.empty())[0.0:1.0], "and no frame"),
        (lambda r: dataclasses.replace(r, name="a\0b"), "without the character NUL"),
        (lambda r: dataclasses.replace(r, extra={5: 1}), "5 is no name of a further array"),
        (lambda r: unchecked(jaxevent.events.voxel_grid)(r, True), "True bins .* whole number"),
        (lambda r: unchecked(jaxevent.events.remove_hot_pixels)(r, [True]), r"of shape \(1,\)"),
        (lambda r: unchecked(jaxevent.events.remove_hot_pixels)(r, "a"), "hot is a str; give an"),
        (lambda r: video_writer("a.gif", 30).__enter__(), "a.gif: .* end the name in .mp4"),
    ],
)  # fmt: skip
def test_likely_slips_are_refused(call, said, bar):
    with pytest.raises(InputError, match=said):
        call(bar)


@pytest.mark.parametrize(
    ("rows", "said"),
    [([9], "have no row 9, for there are 3"), ([0, -4], "no row -4"), (1, "a list of rows, not 1"),
     ([True] * 2, "a mask of 2 values"), (slice(0.0, 0.1), "not a range of rows")],
)  # fmt: skip
def test_rows_that_are_not_there_are_refused(rows, said, bar):
    t = np.arange(3) * 10_000
    frames = jaxevent.Frames(t, np.zeros((3, 48, 64), np.uint8), t * 0)
    imu = jaxevent.recording.Imu(t, np.zeros((3, 3)))
    recording = dataclasses.replace(bar, frames=frames, imu=imu)
    for choose in (recording.with_frames, frames.__getitem__, imu.__getitem__):
        with pytest.raises(InputError, match=said):
            choose(rows)
    assert len(recording.with_frames(np.array([-1])).frames) == 1
    assert recording.with_frames([]).frames is None


@pytest.mark.parametrize(("off", "on"), [(False, True), (0, 1), (-1, 1.0), (np.int8(-1), np.True_)])
def test_polarities_are_selected_as_any_file_spells_them(bar, off, on):
    select, count = unchecked(jaxevent.events.select_polarity), int(bar.events.p.sum())
    assert 0 < count < len(bar.events)
    assert len(select(bar, on).events) == count
    assert len(select(bar, off).events) == len(bar.events) - count
