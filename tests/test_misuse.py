"""Samples of the table of misuse; `python tests/misuse.py` tries all of it."""

import functools
import inspect

import pytest
from misuse import EQUAL, REFUSED, Case, constructions, estimates, is_right, outcome, run

import jaxevent
from jaxevent import InputError


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
