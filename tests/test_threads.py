"""Threads that share results, recordings and kernels get what one thread gets."""

import contextlib
import copy
import dataclasses
import itertools
import threading
import time

import formats
import numpy as np
import points
import pytest
import texture
from together import THREADS, assert_equal, at_once

import jaxevent
from jaxevent import codegen
from jaxevent.codegen import map_ahead, run_over_rows
from jaxevent.codegen import module as kernel_module
from jaxevent.errors import InputError
from jaxevent.io import decoded
from jaxevent.reconstruction.engine import filter_loop, filter_program, smoother_program
from jaxevent.reconstruction.engine import images as image_module

# The default thresholds are not those of the texture.
pytestmark = [
    pytest.mark.filterwarnings("ignore:moving. events contradict frames"),
    pytest.mark.filterwarnings("ignore:moving. holds no frames"),
]

WINDOWS = {"window_events": 3000}  # of 8,000
RESULTS = [
    ("akf", WINDOWS),
    ("aks", WINDOWS),
    ("cf", {"compiler": "xla", **WINDOWS}),
    ("flow", {}),
    ("mc", {}),
]


@pytest.fixture(autouse=True)
def precision(float32):
    """As users have it."""


@pytest.mark.parametrize("cores", [1, 2, 3])
def test_an_item_is_made_while_the_one_before_is_computed(cores, monkeypatch):
    monkeypatch.setattr(codegen, "N_THREADS", cores)
    made, maker = [], threading.get_ident()
    later_made = [threading.Event() for _ in range(9)]

    def items():
        for k in range(9):
            assert threading.get_ident() == maker
            made.append(k)
            later_made[k].set()
            yield k

    def square(k):
        if cores > 1 and k < 8:
            assert later_made[k + 1].wait(60)  # for ever, if nothing were made ahead
        return k * k

    for k, found in enumerate(map_ahead(square, items())):
        assert found == k * k
        assert len(made) == min(k + cores, 9)  # no more are held


@pytest.mark.parametrize("cores", [1, 3])
def test_a_failure_comes_where_its_result_is_due(cores, monkeypatch):
    monkeypatch.setattr(codegen, "N_THREADS", cores)

    def items():
        yield from range(4)
        raise KeyError("items")

    found = map_ahead(lambda k: 1 // (k - 2), items())
    assert [next(found), next(found)] == [-1, -1]
    with pytest.raises(ZeroDivisionError):
        next(found)
    found = map_ahead(lambda k: k, items())
    with pytest.raises(KeyError, match="items"):
        list(found)


def test_kernels_of_several_items_share_the_cores(monkeypatch):
    monkeypatch.setattr(codegen, "N_THREADS", 4)

    def parts(_=None):
        found = []
        run_over_rows(lambda *rows: found.append(rows), 8)
        return sorted(found)

    halves = [(0, 4), (4, 8)]
    assert list(map_ahead(parts, range(3), 2)) == [halves] * 3
    assert len(parts()) == 4
    names = map_ahead(lambda _: (threading.get_ident(), len(parts())), range(2), 1)
    assert list(names) == [(threading.get_ident(), 4)] * 2


@pytest.mark.slow
@pytest.mark.parametrize(("name", "options"), RESULTS)
def test_images_of_a_shared_video(name, options):
    if name == "flow":
        pytest.importorskip("cv2")
    recording, method = texture.moving(), jaxevent.METHODS[name]
    number = 6 if name == "mc" else 10 if "compiler" in options else 30
    times = np.linspace(recording.start, recording.stop, number).astype(int)
    alone = {t: method.estimate(recording, **options)(t) for t in times.tolist()[:2]}
    whole = method.estimate(recording, **options)(times)
    for k, t in enumerate(alone):
        assert_equal(alone[t], [part[k : k + 1] for part in whole])
    shared = method.estimate(recording, **options)

    def read(random):
        chosen = np.array(random.sample(range(len(times)), len(times) // 2))
        for one in chosen:
            assert_equal(shared(int(times[one])), [part[one : one + 1] for part in whole])
        assert_equal(shared(times[chosen]), [part[chosen] for part in whole])
        chosen.sort()
        done = 0
        for at, images in shared.batches(times[chosen]):
            rows = chosen[done : done + len(at)]
            time.sleep(1e-4)  # while others write where these images came from
            assert_equal(images, [part[rows] for part in whole])
            done += len(at)

    at_once(read)


def test_readings_of_one_video_may_alternate():
    recording = texture.moving()
    times = np.linspace(recording.start, recording.stop, 12).astype(int)
    video = jaxevent.akf.estimate(recording, **WINDOWS)
    whole = video(times)
    pairs = zip(video.batches(times[:6]), video.batches(times[6:]), strict=False)
    for first, second in pairs:
        for at, images in (first, second):
            rows = np.searchsorted(times, at)
            assert_equal(images, [part[rows] for part in whole])


@pytest.mark.slow
def test_own_videos_translate_a_method_once(monkeypatch):
    for module in (filter_program, smoother_program):
        monkeypatch.setattr(module._kernels, "_programs", {})
    traced, trace = [], filter_program.trace_filter
    monkeypatch.setattr(
        filter_program, "trace_filter", lambda *given: traced.append(given) or trace(*given)
    )
    recording = texture.moving()
    times = np.linspace(recording.start, recording.stop, 5).astype(int)
    methods = jaxevent.akf, jaxevent.aks
    found = at_once(lambda _: [method.estimate(recording)(times) for method in methods])
    assert len(traced) == 1
    for one in found:
        for method, images in zip(methods, one, strict=True):
            assert_equal(images, method.estimate(recording)(times))


def test_what_is_made_once_is_made_by_one():
    known, made = {}, []

    def make():
        time.sleep(0.02)
        made.append(1)
        return object()

    found = at_once(lambda _: kernel_module.get_or_make(known, "key", make))
    assert len(made) == 1 and len({id(one) for one in found}) == 1


@pytest.mark.slow
@pytest.mark.parametrize("name", ["akf", "aks"])
def test_shared_images_as_functions_of_parameters(name):
    recording, method = texture.moving(), jaxevent.METHODS[name]
    images = method.prepare_images(recording, recording.frames.t[2:6])
    params = [method.Params(c_on=0.01 + 0.002 * k) for k in range(THREADS)]
    alone = [images(one) for one in params]

    def read(random):
        for k in random.sample(range(THREADS), THREADS):
            assert_equal(images(params[k]), alone[k])

    at_once(read)


@pytest.mark.slow
def test_shared_tracks():
    recording = texture.moving()[0.0:0.08]
    seeds, times = [(5, 5, 2), (12, 9, 3)], np.linspace(10_000, 70_000, 16).astype(int)

    def follow():
        return jaxevent.blob.moment.estimate(recording, seeds=seeds)

    def told(tracks, t):
        now = tracks(t)
        return now.mean, now.covariance, now.valid, now.idle, tracks.filtered(t).mean

    alone = follow()
    whole, owners = told(alone, times), [np.stack(one) for one in alone.events()]
    shared = follow()

    def read(random):
        for row in random.sample(range(len(times)), 4):
            found = told(shared, times[row : row + 1])
            assert_equal(found, [part[row : row + 1] for part in whole])
        assert_equal([np.stack(one) for one in shared.events()], owners)
        assert_equal(told(follow(), times), whole)

    at_once(read)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:made. .* found no motion:jaxevent.errors.InputWarning")
@pytest.mark.parametrize("name", ["planes", "voting"])
def test_motion_shared_and_of_ones_own(name):
    recording = points.moved(points.turning([0.3, 0.2, 0.1]), 0.15, 300, 0)
    recording = dataclasses.replace(
        recording, camera=jaxevent.camera.PinholeCamera(100.0, 100.0, 59.5, 44.5)
    )
    method = jaxevent.METHODS[name]

    def estimate():
        return method.estimate(recording, method.Params(), model="rotation", progress=False)

    alone = estimate()
    times = np.linspace(recording.start, recording.stop, 20).astype(int)
    true = alone(times)

    def read(_):
        assert_equal(alone(times), true)
        assert_equal(estimate()(times), true)

    at_once(read)


def written(tmp_path, monkeypatch, kind: str):
    """A recording that stays in a file, and the same in memory."""
    recording = texture.moving()
    path = tmp_path / f"recording.{kind}"
    size = (recording.width, recording.height)
    if kind == "h5":
        jaxevent.save(recording, path)
    elif kind == "images.h5":  # decoded one by one
        frames = recording.frames
        path.write_bytes(formats.event_utils(recording.events, size, frames.images, frames.t))
    else:
        monkeypatch.setattr(decoded, "BLOCK_EVENTS", 500)
        path.write_bytes(formats.dat(recording.events, size))
    return jaxevent.load(path, size, in_memory=False), jaxevent.load(path, size)


@pytest.mark.parametrize("kind", ["h5", "images.h5", "dat"])
def test_recordings_in_files_are_shared(tmp_path, monkeypatch, kind):
    stored, whole = written(tmp_path, monkeypatch, kind)
    assert not isinstance(stored.events, jaxevent.Events)
    events, count = whole.events, len(whole.events)

    def read(random):
        for _ in range(12):
            first = random.randrange(count)
            rows = slice(first, min(first + random.randrange(1, 1500), count))
            found = stored.events[rows]
            for name in "txyp":
                np.testing.assert_array_equal(getattr(found, name), getattr(events[rows], name))
            at = random.randrange(whole.start, whole.stop)
            assert stored.events.index(at) == events.index(at)
            if whole.frames is not None:
                some = slice(random.randrange(10), 20, random.randrange(1, 4))
                images = np.asarray(stored.frames.images[some])
                np.testing.assert_array_equal(images, whole.frames.images[some])

    at_once(read)


@pytest.mark.slow
def test_one_thread_adds_what_others_read():
    recording = dataclasses.replace(texture.moving(), frames=None)
    events, last = recording.events, recording.stop
    live = jaxevent.akf.live((recording.width, recording.height), frames=False, window_events=512)
    live.add(events[:100])
    numbers = itertools.count()

    def add_or_read(_):
        if next(numbers) == 0:
            for row in range(100, len(events), 800):
                live.add(events[row : row + 800])
        while (now := live.stop) < last:
            with contextlib.suppress(InputError):  # where it is forgotten meanwhile
                assert np.isfinite(live(now).mean).all()

    at_once(add_or_read, 3)
    true = jaxevent.akf.estimate(recording, compiler="xla", window_events=512)(last)
    assert_equal(live(last), true)


def test_a_copy_is_read_apart():
    recording = texture.moving()
    video = jaxevent.akf.estimate(recording)
    other = copy.copy(video)
    times = np.linspace(recording.start, recording.stop, 9).astype(int)
    whole = video(times)
    for k in (7, 2, 5):
        assert_equal(other(int(times[k])), [part[k : k + 1] for part in whole])
        assert_equal(video(int(times[8 - k])), [part[8 - k : 9 - k] for part in whole])


@pytest.mark.parametrize(("name", "module"), [("akf", filter_loop), ("aks", image_module)])
def test_what_is_interrupted_is_read_anew(monkeypatch, name, module):
    recording, method = texture.moving(), jaxevent.METHODS[name]
    times = np.linspace(recording.start, recording.stop, 40).astype(int)
    whole = method.estimate(recording, **WINDOWS)(times)
    for place in range(8):
        video = method.estimate(recording, **WINDOWS)
        calls = itertools.count()

        def interrupted(*given, place=place, calls=calls):
            run_over_rows(*given)
            if next(calls) == place:
                raise KeyboardInterrupt

        with monkeypatch.context() as patch:
            patch.setattr(module, "run_over_rows", interrupted)
            with pytest.raises(KeyboardInterrupt):
                video(times)
        for row in (1, 6, 2):
            assert_equal(video(int(times[row])), [part[row : row + 1] for part in whole])
