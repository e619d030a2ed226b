"""Windows prepared on the device are those that loops over events prepare on the host."""

import dataclasses

import jax
import numpy as np
import pytest
from test_reconstruction import look, random_recording

import jaxevent
from jaxevent.reconstruction import on_device
from jaxevent.reconstruction.clock import Timing
from jaxevent.reconstruction.on_device import DeviceWindows
from jaxevent.reconstruction.video import _windows_of
from jaxevent.reconstruction.windows import WindowedRecording
from jaxevent.recording import Events

RECORDINGS = {
    "short exposures": random_recording(4, 300, 6, exposure=500),
    "exposures that overlap": random_recording(5, 300, 6, exposure=45_000),
    "instants": random_recording(6, 300, 6, exposure=0),
    "busy pixels": random_recording(7, 3000, 9, size=(11, 9), exposure=0, hot=2500),
    "no frames": random_recording(8, 300, 0),
}


def equal(one, other, rows=None):
    """Arrays of the same kinds and numbers; of read-outs the rows in use."""
    for a, b in zip(*map(jax.tree.leaves, (one, other)), strict=True):
        assert a.shape == b.shape and a.dtype == b.dtype
        np.testing.assert_allclose(a[:rows], b[:rows], rtol=1e-12, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("name", RECORDINGS)
def test_windows_are_those_of_the_host(name):
    recording, timing = RECORDINGS[name], Timing(clock_offset=0.0007)
    for filtering in (True, False):
        on_host, there = (
            kind(recording, timing, filtering=filtering, events=len(recording.events) // 3)
            for kind in (WindowedRecording, DeviceWindows)
        )
        windows = 0
        for (window, features), (other, same) in zip(on_host, there, strict=True):
            windows += 1
            assert isinstance(same.last, jax.Array) and isinstance(features.last, np.ndarray)
            assert (window.start, window.stop, window.events) == (
                other.start, other.stop, other.events,
            )  # fmt: skip
            equal(*(jax.tree.map(np.atleast_1d, v) for v in (features, same)))
            np.testing.assert_array_equal(window.after.last, other.after.last)
            if filtering:
                shape = recording.height + 2, recording.width + 2
                inner = (v.after.near.reshape(shape)[1:-1, 1:-1] for v in (window, other))
                np.testing.assert_array_equal(*inner)
            begin = recording.start - 5 if window.start is None else window.start
            end = recording.stop + 90_000 if window.stop is None else window.stop - 1
            times = np.sort(np.r_[np.linspace(begin, end, 5).astype(np.int64), recording.events.t])
            times = times[(times >= begin) & (times <= end)][:: max(len(times) // 8, 1)][:12]
            equal(window.reader(12)(times), other.reader(12)(times), len(times))
            # Again from the window's start: what was read before does not matter.
            equal(window.reader(12)(times[:1]), other.reader(12)(times[:1]), 1)
        assert windows > 2


@pytest.mark.slow
@pytest.mark.parametrize("name", ["akf", "aks", "edi"])
def test_images_are_those_of_the_host(name, monkeypatch):
    recording = RECORDINGS["short exposures"]
    method = jaxevent.METHODS[name]
    times = np.linspace(recording.start, recording.stop, 7).astype(np.int64)
    params = method.Params(spread=0.0) if "spread" in method.Params.numbers else method.Params()

    def images(backend, kind):
        monkeypatch.setattr(jax, "default_backend", lambda: backend)
        video = method.estimate(recording, params, compiler="xla", window_events=90)
        assert type(video._windows) is kind
        return look(video, times)

    expected = images("cpu", WindowedRecording)
    found = images("gpu", DeviceWindows)
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.slow
def test_single_precision(float32):
    """Differences of times are whole microseconds until they are rounded once."""
    recording = RECORDINGS["busy pixels"]
    windows = [
        kind(recording, events=1000).prepare(recording.start, kind(recording).initial())[1]
        for kind in (WindowedRecording, DeviceWindows)
    ]
    for a, b in zip(*map(jax.tree.leaves, windows), strict=True):
        assert a.dtype == b.dtype != np.float64
        np.testing.assert_allclose(a, b, rtol=4e-7, atol=1e-7)


def test_what_32_bits_cannot_tell_is_prepared_on_the_host(monkeypatch):
    recording = RECORDINGS["instants"]
    events = recording.events
    t = events.t + np.where(np.arange(len(events)) < 100, 0, 2 * on_device.FARTHEST)
    late = dataclasses.replace(
        recording, frames=None, events=Events(t, events.x, events.y, events.p)
    )
    (_, features), *_ = DeviceWindows(late, events=1000)
    assert isinstance(features.last, np.ndarray)
    assert not DeviceWindows.serves(Timing(rho_ref=1e-4))
    assert not DeviceWindows.serves(Timing(spread=0.01))
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert isinstance(_windows_of(late, Timing(), 0), DeviceWindows)
    assert type(_windows_of(late, Timing(), 2)) is WindowedRecording
