"""Live tracks are at every moment those of what has been added so far."""

import dataclasses

import numpy as np
import pytest
from test_blob_tracker import cloud, line, noise, together

from jaxevent import blob
from jaxevent.blob.engine.runner import KernelRunner
from jaxevent.blob.live import CHUNKS_PER_RUN, STEPS_PER_CHUNK
from jaxevent.blob.prepare import ChunkPacker
from jaxevent.blob.tracks import Tracks
from jaxevent.errors import InputError
from jaxevent.recording import Events, Recording

FEW = {"n_birth": 8.0, "n_confirm": 20.0, "lambda0": 8.0, "t_coast": 0.02, "max_targets": 3}
SIZE = (240, 180)


def scene() -> Recording:
    """A blob that stays, one that comes late, one that ends, and stray events."""
    rng = np.random.default_rng(1)
    return together(
        cloud(rng, line(60, 80, 900), (5, 3), 4000, (0, 0.12)),
        cloud(rng, line(168, 92, -200), (3, 3), 4000, (0.03, 0.12)),
        cloud(rng, line(40, 150, 300), (3, 3), 4000, (0.01, 0.05)),
        noise(rng, 1000, 0.12),
    )


def chunked(recording: Recording, seed: int, most: int = 300):
    """Its events in chunks of random sizes, some of them empty."""
    rng, row = np.random.default_rng(seed), 0
    while row < len(recording.events):
        number = int(rng.choice([0, 1, 7, 40, most]))
        yield recording.events[row : row + number]
        row += number


def so_far(recording: Recording, events: int) -> Recording:
    return dataclasses.replace(recording, events=recording.events[:events])


def compare(states, tracks, time: int, known: np.ndarray) -> None:
    """States of one time against those of tracks, whose numbers are `known`."""
    whole = tracks(time)
    shown = whole.valid[0] & (tracks.confirmed <= time)
    now = np.flatnonzero(states.valid[0])
    shown = np.flatnonzero(shown)[np.argsort(known[shown])]
    assert list(states.id[now]) == list(known[shown])
    for name in ("mean", "covariance", "idle"):
        found, true = getattr(states, name)[0, now], getattr(whole, name)[0, shown]
        np.testing.assert_allclose(found, true, rtol=1e-7, atol=1e-7)


def by_confirmation(tracks, given: int) -> np.ndarray:
    """The numbers that live tracks give."""
    number = np.arange(len(tracks))
    number[given:][np.argsort(tracks.confirmed[given:], kind="stable")] = np.arange(
        given, len(tracks)
    )
    return number


@pytest.mark.slow
def test_states_are_those_of_the_whole_however_it_is_divided():
    recording, tracker = scene(), blob.constant_velocity
    params = tracker.Params(**FEW)
    seeds = [(60.0, 80.0, 8.0), (168.0, 92.0, 8.0, 0.03)]
    start = recording.start
    seeds[1] = (*seeds[1][:3], start + 30_000)
    packer = ChunkPacker(
        recording, params, seeds, detect=True, steps=STEPS_PER_CHUNK, chunks=CHUNKS_PER_RUN
    )
    whole = Tracks(KernelRunner(tracker.filter, params, detect=packer.detect), packer)
    assert len(whole) > 2 and (whole.ended[2] == "idle")
    known = by_confirmation(whole, 2)
    for seed in range(2):
        live = tracker.live(SIZE, params, seeds=seeds, detect=True)
        held, number = [], 0
        for chunk in chunked(recording, seed):
            live.add(chunk)
            number += len(chunk)
            held.append(len(live._tail.retained()))
            if number and len(held) % 5 == 0:
                compare(live(live.stop), whole, live.stop, known)
        assert number == len(recording.events) and max(held) < 64 + 300


@pytest.mark.slow
def test_steps_of_several_events_are_those_of_what_was_added():
    recording, tracker = scene(), blob.constant_velocity
    params = tracker.Params(**FEW, events_per_step=5, prefilter=True)
    live, row = tracker.live(SIZE, params), 0
    for number in (301, 202, 413):
        live.add(recording.events[row : row + number])
        row += number
        packer = ChunkPacker(
            so_far(recording, row), params, steps=STEPS_PER_CHUNK, chunks=CHUNKS_PER_RUN
        )
        part = Tracks(KernelRunner(tracker.filter, params, detect=packer.detect), packer)
        compare(live(live.stop), part, live.stop, by_confirmation(part, 0))


@pytest.mark.slow
def test_targets_are_added_while_events_come():
    recording, tracker = scene(), blob.constant_velocity
    params, start = tracker.Params(**FEW), recording.start
    # In order of time; they are added in another one, the last two when their time has nearly come.
    places = [(60, 80, 8), (40, 150, 8), (168, 92, 8), (100, 30, 8), (20, 20, 8)]
    begins = start + 1000 * np.array([0, 10, 30, 60, 95])
    given = [(*place, int(begin)) for place, begin in zip(places, begins, strict=True)]
    packer = ChunkPacker(recording, params, given, steps=STEPS_PER_CHUNK, chunks=CHUNKS_PER_RUN)
    whole = Tracks(KernelRunner(tracker.filter, params, detect=packer.detect), packer)
    live = tracker.live(SIZE, params, seeds=given[:1])
    order = [0, 2, 1]
    assert [live.add_target(*given[k]) for k in order[1:]] == [1, 2]
    for chunk in chunked(recording, 3, most=60):
        due = len(order)
        if due < 5 and len(live._tail) and live.stop > begins[due] - 10_000:
            assert live.add_target(*given[due]) == due
            order.append(due)
        live.add(chunk)
        if len(chunk):
            compare(live(live.stop), whole, live.stop, np.array([0, 2, 1, 3, 4]))
    # The second one ended before the fifth was added, and made room for it.
    assert whole.death[1] < begins[4] - 10_000 and len(live._packer.seeds.t) == 4
    with pytest.raises(InputError, match="is forgotten"):
        live.add_target(10, 10, 5, start + 10)


@pytest.mark.slow
def test_the_kernel_says_the_same(float32):
    recording, params = scene(), blob.moment.Params(**FEW)
    seeds = [(60.0, 80.0, 8.0)]
    kernel, scan = (
        blob.moment.live(SIZE, params, seeds=seeds, detect=True, compiler=compiler)
        for compiler in ("numba", "xla")
    )
    for live in (kernel, scan):
        live.add(recording.events[:500])
        live.add_target(168, 92, 8)
        live.add(recording.events[500:900])
    one, other = (live(live.stop) for live in (kernel, scan))
    assert one.id.tolist() == other.id.tolist() and len(one.id) >= 2
    np.testing.assert_allclose(one.mean, other.mean, rtol=1e-3, atol=1e-3)


@pytest.mark.slow
def test_after_the_last_event_states_are_predicted():
    recording, params = scene(), blob.constant_velocity.Params(**FEW)
    seeds = [(60.0, 80.0, 8.0)]
    live = blob.constant_velocity.live(SIZE, params, seeds=seeds)
    live.add(recording.events[:600])
    packer = ChunkPacker(recording, params, seeds, steps=STEPS_PER_CHUNK, chunks=CHUNKS_PER_RUN)
    whole = Tracks(
        KernelRunner(blob.constant_velocity.filter, params, detect=packer.detect), packer
    )
    compare(live(live.stop), whole, live.stop, np.arange(1))
    times = live.stop + np.array([0, 5_000, 30_000])
    states = live(times)
    moved = states.mean[1, 0, :2] - states.mean[0, 0, :2]
    np.testing.assert_allclose(moved, 0.005 * states.mean[0, 0, 2:4], rtol=1e-6)
    assert states.valid[:, 0].tolist() == [True, True, False]  # t_coast
    with pytest.raises(InputError, match="forgotten"):
        live(live.start - 1)


def test_noise_that_is_left_out_is_not_held():
    """The prefilter drops lonely events: no chunk waits for one that is kept."""
    params = blob.constant_velocity.Params(prefilter=True, prefilter_time=1e-4)
    live = blob.constant_velocity.live(SIZE, params, seeds=[(60.0, 80.0, 8.0)])
    number = 2000
    t = 1000 * np.arange(number)
    x, y = np.random.default_rng(0).integers(0, SIZE, (number, 2)).T.astype(np.uint16)
    events = Events(t, x, y, t % 2 == 0)
    near = Events(*(np.repeat(getattr(events[:1], name), 9) for name in "txyp"))
    live.add(dataclasses.replace(near, x=near.x + np.arange(9, dtype=np.uint16) % 3))
    for row in range(0, number, 100):
        live.add(events[row : row + 100])
        assert len(live._tail.retained()) < 250


def test_what_cannot_be_added_is_said():
    events = scene().events
    live = blob.moment.live(SIZE, seeds=[])
    with pytest.raises(InputError, match="nothing has been added"):
        live(0.1)
    with pytest.raises(InputError, match="outside the 240x180"):
        live.add_target(300, 10, 5)
    live.add(events[50:60])
    with pytest.raises(InputError, match="in order of time"):
        live.add(events[40:50])
    with pytest.raises(InputError, match="give x, y, size"):
        blob.moment.live(SIZE, seeds=[(1, 2)])
    with pytest.raises(InputError, match="no compiler"):
        blob.moment.live(SIZE, compiler="gcc")
    assert "10 events" in repr(live)
    early = blob.moment.live(SIZE, seeds=[], start=int(events.t[20]))
    early.add(events[:30])
    assert len(early._tail) == 10 and early.stop == events.t[29]
