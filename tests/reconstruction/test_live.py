"""A live video is at every moment that of what has been added so far."""

import dataclasses
import warnings
from typing import Any

import numpy as np
import pytest
from noise import HEIGHT, WIDTH, small

import jaxevent
from jaxevent.errors import InputError
from jaxevent.events.live import Tail
from jaxevent.recording import Events, Frames, Recording

EVENTS = 128  # of a window


def longer() -> Recording:
    """`small` four times over: 1600 events and 24 frames of 3 ms."""
    once: Any = small()
    shift = 55_000 * np.arange(4)[:, None]
    t, x, y, p = (np.tile(getattr(once.events, name), 4) for name in "txyp")
    events = Events(t + np.repeat(shift, len(once.events)), x, y, p)
    images = np.tile(once.frames.images, (4, 1, 1))
    frames = Frames((once.frames.t + shift).ravel(), images, np.full(24, 3000))
    return dataclasses.replace(once, events=events, frames=frames)


def so_far(recording: Recording, rows: int, frames: int) -> Recording:
    part = dataclasses.replace(recording, events=recording.events[:rows])
    given = recording.frames[:frames] if frames else None
    return dataclasses.replace(part, frames=given)


def compare(live, recording: Recording, params, times) -> None:
    whole = jaxevent.akf.estimate(recording, params, window_events=EVENTS)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*holds no frames")
        expected = whole(times)
    for found, true in zip(live(times), expected, strict=True):
        np.testing.assert_allclose(found, true, rtol=1e-9, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("frames", [False, True])
def test_images_are_those_of_what_was_added(frames):
    recording = longer()
    if not frames:
        recording = dataclasses.replace(recording, frames=None)
    # A live recording does not know how much of it will move.
    params = jaxevent.akf.Params(
        exposure=0.003, clock_offset=0.0008, event_delay=0.0002, rho_ref=1e-5, error_still=0.0
    )
    live = jaxevent.akf.live((WIDTH, HEIGHT), params, frames=frames, window_events=EVENTS)
    events, given, held = recording.events, 0, 0
    for row in range(0, len(events), 50):
        chunk = events[row : row + 50]
        while frames and given < 24 and recording.frames.t[given] <= chunk.t[-1]:
            image = recording.frames.images[given]
            live.add_frame(int(recording.frames.t[given]), image, 3000)
            given += 1
        live.add(chunk)
        held = max(held, len(live._events.retained()))
        if row in (0, 450, 1150):
            compare(live, so_far(recording, row + 50, given), params, [live.start, live.stop])
    # Two windows remain, and with frames what the last two or three of them bound.
    assert live.start > events.t[1000] and held < (700 if frames else 3 * EVENTS)
    if frames:
        assert len(live._recording.frames.images.images) <= 32
    assert f"{len(events):,} events" in repr(live)
    if not frames:  # what is settled is final
        t = np.linspace(live.start, live.stop, 4).astype(int)
        compare(live, recording, params, t)
    with pytest.raises(InputError, match="earlier ones are forgotten"):
        live(live.start - 1)
    with pytest.raises(InputError, match="later ones not known"):
        live(live.stop + 1)


def test_what_cannot_be_added_is_said():
    live = jaxevent.akf.live((WIDTH, HEIGHT), frames=True)
    events, image = small().events, np.zeros((HEIGHT, WIDTH), np.uint8)
    with pytest.raises(InputError, match="nothing has been added"):
        live(0.1)
    live.add(events[50:60])
    with pytest.raises(InputError, match="in order of time"):
        live.add(events[40:50])
    with pytest.raises(InputError, match="event 11 has x = 99"):
        live.add(dataclasses.replace(events[60:62], x=np.array([1, 99], np.uint16)))
    live.add_frame(0.01, image)
    with pytest.raises(InputError, match="not after the one before"):
        live.add_frame(0.01, image)
    with pytest.raises(InputError, match="the frame added: frames have shape"):
        live.add_frame(0.02, image[:3])
    with pytest.raises(InputError, match="frames=True"):
        jaxevent.akf.live((WIDTH, HEIGHT), frames=False).add_frame(0.01, image)
    with pytest.raises(InputError, match="needs what comes later"):
        jaxevent.aks.live((WIDTH, HEIGHT), frames=False)


def test_the_tail_keeps_its_numbers():
    events, tail = small().events, Tail(WIDTH, HEIGHT)
    for row in range(0, 400, 50):
        tail.add(events[row : row + 50])
    tail.drop(120)
    assert (len(tail), tail.dropped, len(tail.retained())) == (400, 120, 280)
    assert tail[:1].t[0] == events.t[0] and tail.index(int(events.t[200])) <= 200
    np.testing.assert_array_equal(tail[130:170].t, events.t[130:170])
    with pytest.raises(IndexError):
        tail[100:130]
