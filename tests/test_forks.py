"""Forked processes compute with kernels, and say what they cannot do; none waits for ever."""

import os
import threading

import formats
import jax.numpy as jnp
import numpy as np
import pytest
import texture
from together import assert_equal, in_child

import jaxevent
from jaxevent import codegen, progress
from jaxevent.codegen import module as kernel_module
from jaxevent.errors import InputError
from jaxevent.io import decoded
from jaxevent.threads import TurnLock

pytestmark = [
    pytest.mark.skipif(not hasattr(os, "fork"), reason="there are no forks"),
    # The default thresholds are not those of the texture.
    pytest.mark.filterwarnings("ignore:moving. events contradict frames"),
]


@pytest.fixture(autouse=True)
def parent(float32):
    """Has computed with JAX and with kernels, on several threads."""
    (jnp.arange(3) + 1).block_until_ready()


@pytest.mark.parametrize("name", ["akf", "aks"])
def test_images(name):
    recording, method = texture.moving(), jaxevent.METHODS[name]
    times = np.linspace(recording.start, recording.stop, 6).astype(int)
    video = method.estimate(recording)
    images = video(times)
    assert_equal(in_child(lambda: video(times)), images)
    assert_equal(in_child(lambda: method.estimate(recording)(times)), images)
    assert_equal(video(times), images)


def test_rows_are_divided_among_new_threads(monkeypatch):
    monkeypatch.setattr(codegen, "N_THREADS", 2)

    def numbered(begin, end, out):
        out[begin:end] = np.arange(begin, end)

    def fill():
        out = np.zeros(64)
        codegen.run_over_rows(numbered, 64, out)
        return out

    for out in (fill(), in_child(fill), fill()):
        np.testing.assert_array_equal(out, np.arange(64))


def test_items_that_threads_of_the_parent_were_to_compute(monkeypatch):
    monkeypatch.setattr(codegen, "N_THREADS", 2)
    allowed = threading.Event()

    def square(k):
        assert k == 0 or allowed.wait(60)
        return k * k

    found = codegen.map_ahead(square, range(6))
    assert next(found) == 0

    def rest():
        allowed.set()
        return list(found)

    assert in_child(rest) == [1, 4, 9, 16, 25]
    assert rest() == [1, 4, 9, 16, 25]


@pytest.mark.slow
def test_tracks():
    recording = texture.moving()[0.0:0.08]
    times = np.linspace(10_000, 70_000, 5).astype(int)
    tracks = jaxevent.blob.moment.estimate(recording, seeds=[(5, 5, 2)])
    states = tracks(times)

    def follow():
        return jaxevent.blob.moment.estimate(recording, seeds=[(5, 5, 2)])(times)

    for job in (lambda: tracks(times), follow):
        assert_equal(vars(in_child(job)).values(), vars(states).values())


@pytest.mark.slow
def test_what_needs_xla_is_refused():
    recording = texture.moving()
    cold, warm = jaxevent.mc.estimate(recording), jaxevent.cf.estimate(recording, compiler="xla")
    warm(100_000)
    for video in (cold, warm):
        with pytest.raises(InputError, match="forked from one that has computed with JAX"):
            in_child(lambda video=video: video(200_000))
    with pytest.raises(InputError, match="spawn or forkserver"):
        in_child(lambda: jnp.arange(7) * jnp.arange(7))
    assert np.isfinite(warm(200_000).mean).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["voting", "contrast"])
def test_motion_that_needs_xla_is_refused(name):
    method = jaxevent.METHODS[name]
    with pytest.raises(InputError, match="spawn or forkserver"):
        in_child(lambda: method.estimate(texture.moving(), method.Params(), model="planar"))


@pytest.mark.parametrize("kind", ["h5", "dat"])
def test_recordings_in_files(tmp_path, monkeypatch, kind):
    recording = texture.moving()
    size, path = (recording.width, recording.height), tmp_path / f"a.{kind}"
    if kind == "h5":
        jaxevent.save(recording, path)
    else:
        monkeypatch.setattr(decoded, "BLOCK_EVENTS", 500)
        path.write_bytes(formats.dat(recording.events, size))
    events = jaxevent.load(path, size, in_memory=False).events
    assert_equal([events[:1300].t], [recording.events.t[:1300]])  # on the way through the file
    rest = slice(1300, 5000)
    assert_equal([in_child(lambda: events[rest].t)], [recording.events.t[rest]])
    assert_equal([events[rest].t], [recording.events.t[rest]])


def busy(enter):
    """Have another thread hold something until the function returned is called."""
    held, over = threading.Event(), threading.Event()

    def hold():
        with enter:
            held.set()
            over.wait(60)

    thread = threading.Thread(target=hold)
    thread.start()
    held.wait(60)

    def end():
        over.set()
        thread.join()

    return end


def test_what_another_thread_was_reading_is_refused():
    recording = texture.moving()
    video, other = (jaxevent.akf.estimate(recording) for _ in range(2))
    image = video(100_000)
    end = busy(video._turns)
    try:
        with pytest.raises(InputError, match="another thread was reading it"):
            in_child(lambda: video(100_000))
        assert_equal(in_child(lambda: other(100_000)), image)
    finally:
        end()
    assert_equal(in_child(lambda: video(100_000)), image)


def test_own_turns_go_on():
    turns = TurnLock("a thing")

    def enter():
        with turns:
            return True

    with turns:
        assert in_child(enter)


def test_locks_of_all_are_free():
    end = busy(progress.tqdm.get_lock())
    try:
        assert in_child(lambda: list(progress.bar(range(3), desc="", unit=""))) == [0, 1, 2]
    finally:
        end()
    # What is compiled when a process is forked is finished first.
    end = busy(kernel_module._lock)
    threading.Timer(0.2, end).start()
    assert in_child(lambda: kernel_module.get_or_make({}, "key", lambda: 5)) == 5
