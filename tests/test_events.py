"""Events cut, filtered and gathered, against loops over single events."""

import dataclasses
import math

import jax
import numpy as np
import pytest

import jaxevent
from jaxevent import events
from jaxevent.camera import PinholeCamera
from jaxevent.errors import InputError
from jaxevent.events import blocks as event_blocks
from jaxevent.recording import Events, Frames, Recording

WIDTH, HEIGHT = 7, 5


def drawn(count: int = 400, seed: int = 0, span: int = 3_000) -> Events:
    rng = np.random.default_rng(seed)
    t = 1_000_000_000 + np.sort(rng.integers(0, span, count))
    x, y = rng.integers(0, WIDTH, count), rng.integers(0, HEIGHT, count)
    return Events(t, x.astype(np.uint16), y.astype(np.uint16), rng.random(count) < 0.5)


def recorded(count: int = 400) -> Recording:
    rng = np.random.default_rng(1)
    some = drawn(count)
    t = some.t[0] + np.array([100, 900])
    images = rng.integers(0, 256, (2, HEIGHT, WIDTH), np.uint8)
    camera = PinholeCamera(6.0, 6.5, 3.2, 2.1, (-0.2, 0.05, 0.01, -0.01, 0.0))
    extra = {
        "rgb": rng.integers(0, 256, (2, HEIGHT, WIDTH, 3), np.uint8),
        "hdr": rng.random((3, HEIGHT, WIDTH)),
        "c_on": np.float64(0.2),
    }
    frames = Frames(t, images, np.zeros(2, np.int64))
    return Recording("drawn", WIDTH, HEIGHT, some, frames, camera, extra=extra)


def rows(part: Events) -> list[tuple[int, int, int, bool]]:
    columns = part.t, part.x, part.y, part.p
    return [(int(t), int(x), int(y), bool(p)) for t, x, y, p in zip(*columns, strict=True)]


@pytest.fixture(autouse=True, params=[1 << 20, 33])
def blocks(request, monkeypatch):
    """Results do not depend on the blocks in which events are read."""
    monkeypatch.setattr(event_blocks, "BLOCK_EVENTS", request.param)


def test_background_activity_is_what_no_neighbour_supports():
    part = drawn(300)
    for reach, least in ((1, 1), (40, 1), (150, 3)):
        last, kept = {}, []
        for t, x, y, p in rows(part):
            around = [(x + dx, y + dy) for dx in (-1, 0, 1) for dy in (-1, 0, 1) if dx or dy]
            if sum(t - last.get(one, -math.inf) <= reach for one in around) >= least:
                kept.append((t, x, y, p))
            last[x, y] = t
        found = events.filter_background(part, reach, least, size=(WIDTH, HEIGHT))
        assert rows(found) == kept and 0 < len(kept) < 300
        seconds = events.filter_background(part, reach * 1e-6, least, size=(WIDTH, HEIGHT))
        assert rows(seconds) == kept


def test_a_refractory_pixel_fires_again_after_its_period():
    part, last, kept = drawn(), {}, []
    for t, x, y, p in rows(part):
        if t - last.get((x, y), -math.inf) >= 200:
            kept.append((t, x, y, p))
            last[x, y] = t
    assert rows(events.filter_refractory(part, 200, size=(WIDTH, HEIGHT))) == kept
    # A pixel that fires every 150 us: every second one remains, not the first alone.
    zero = np.zeros(10, np.uint16)
    fast = Events(np.arange(0, 1500, 150), zero, zero, np.ones(10, bool))
    assert events.filter_refractory(fast, 200, size=(1, 1)).t.tolist() == [0, 300, 600, 900, 1200]


def test_time_polarity_and_hot_pixels():
    recording = recorded()
    part, (start, stop) = recording.events, (1_000_000_500, 1_000_001_500)
    inside = [row for row in rows(part) if start <= row[0] < stop]
    assert rows(events.crop_time(part, start, stop)) == inside
    assert rows(events.crop_time(recording, start, stop).events) == inside
    assert rows(events.select_polarity(part)) == [row for row in rows(part) if row[3]]
    assert rows(events.select_polarity(part, False)) == [row for row in rows(part) if not row[3]]
    burning = np.full(900, 3, np.uint16)
    t = np.r_[part.t, part.t[-1] + np.arange(900)]
    x, y = np.r_[part.x, burning], np.r_[part.y, burning]
    hot = dataclasses.replace(recording, events=Events(t, x, y, np.r_[part.p, burning > 0]))
    assert np.argwhere(events.find_hot_pixels(hot)).tolist() == [[3, 3]]
    left = events.remove_hot_pixels(hot)
    assert rows(left.events) == [row for row in rows(part) if row[1:3] != (3, 3)]
    assert left.frames is hot.frames and left.camera is hot.camera


def test_a_region_is_a_sensor():
    recording = recorded()
    part = events.crop(recording, 2, 1, 4, 3)
    expected = [
        (t, x - 2, y - 1, p) for t, x, y, p in rows(recording.events) if 2 <= x < 6 and 1 <= y < 4
    ]
    assert rows(part.events) == expected and (part.width, part.height) == (4, 3)
    np.testing.assert_array_equal(part.frames.images, recording.frames.images[:, 1:4, 2:6])
    np.testing.assert_array_equal(part.extra["rgb"], recording.extra["rgb"][:, 1:4, 2:6])
    np.testing.assert_array_equal(part.extra["hdr"], recording.extra["hdr"][:, 1:4, 2:6])
    assert part.extra["c_on"] == 0.2
    # The same ray is seen at the same thing.
    at = np.array([[0.1, -0.05]])
    np.testing.assert_allclose(part.camera.distort(at), recording.camera.distort(at) - (2, 1))
    part.check()


def test_fewer_pixels_show_the_same_scene():
    recording = recorded()
    part = events.downsample(recording, 2)
    expected = [(t, x // 2, y // 2, p) for t, x, y, p in rows(recording.events) if x < 6 and y < 4]
    assert rows(part.events) == expected and (part.width, part.height) == (3, 2)
    block = recording.frames.images[1, 2:4, 4:6].astype(float)
    assert part.frames.images[1, 1, 2] == np.rint(block.mean())
    np.testing.assert_allclose(
        part.extra["hdr"][2, 0, 1], recording.extra["hdr"][2, :2, 2:4].mean()
    )
    # The middle of four pixels is the middle of the one they become.
    ray = recording.camera.normalise([4.5], [2.5])
    np.testing.assert_allclose(part.camera.distort(ray), [[2, 1]], atol=1e-6)
    seen, kept = set(), []
    for t, x, y, p in expected:
        if (t // 500, x, y, p) not in seen:
            kept.append((t, x, y, p))
        seen.add((t // 500, x, y, p))
    assert rows(events.downsample(recording, 2, 500).events) == kept


@pytest.mark.slow
def test_undistorted_events_lie_where_an_ideal_camera_sees_them():
    recording = recorded()
    camera = recording.camera
    straight = events.undistort(recording)
    assert straight.camera == PinholeCamera(6.0, 6.5, 3.2, 2.1)
    kept = []
    grid = np.mgrid[-12:13, -12:13].reshape(2, -1).T * 0.25  # px around a start
    for t, x, y, p in rows(recording.events):
        # By search in ever finer grids for the ray that the camera sees at (x, y).
        ray = np.array([(x - 3.2) / 6.0, (y - 2.1) / 6.5])
        for step in 0.3 ** np.arange(14):
            rays = ray + step * grid / 6
            ray = rays[np.argmin(np.abs(camera.distort(rays) - (x, y)).sum(1))]
        column, row = np.rint(ray * (6.0, 6.5) + (3.2, 2.1)).astype(int)
        if 0 <= column < WIDTH and 0 <= row < HEIGHT:
            kept.append((t, column, row, p))
    assert rows(straight.events) == kept
    # A frame that is linear in the place stays so, at the places where it is seen.
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    ramp = (0.02 + 0.1 * x + 0.03 * y)[None].astype(np.float32)
    one = dataclasses.replace(recording, extra={}, frames=Frames(
        recording.frames.t[:1], ramp, np.zeros(1, np.int64)))  # fmt: skip
    image = events.undistort(one).frames.images[0]
    rays = (np.stack([x, y], -1).reshape(-1, 2) - (3.2, 2.1)) / (6.0, 6.5)
    u, v = camera.distort(rays).T.reshape(2, HEIGHT, WIDTH)
    inside = (u >= 0) & (u <= WIDTH - 1) & (v >= 0) & (v <= HEIGHT - 1)
    np.testing.assert_allclose(
        np.asarray(image), np.where(inside, 0.02 + 0.1 * u + 0.03 * v, 0), atol=1e-6
    )
    with pytest.raises(InputError, match="holds no calibration"):
        events.undistort(dataclasses.replace(recording, camera=None))


def test_images_that_stay_in_a_file_are_changed_when_they_are_read(tmp_path):
    recording = dataclasses.replace(recorded(), extra={})
    jaxevent.save(recording, tmp_path / "r.h5")
    stored = jaxevent.load(tmp_path / "r.h5", in_memory=False)
    part = events.crop(stored, 1, 0, 4, 4)
    assert not isinstance(part.frames.images, np.ndarray)
    same = events.crop(recording, 1, 0, 4, 4)
    np.testing.assert_array_equal(part.frames[1:].images, same.frames.images[1:])
    assert rows(part.events) == rows(same.events)
    jaxevent.save(part, tmp_path / "part.h5")
    again = jaxevent.load(tmp_path / "part.h5")
    np.testing.assert_array_equal(again.frames.images, same.frames.images)


def gathered(part: Events, bins: int, first: int, last: int) -> dict[str, np.ndarray]:
    """All images, event by event."""
    out = {
        "count": np.zeros((HEIGHT, WIDTH)), "image": np.zeros((HEIGHT, WIDTH)),
        "frames": np.zeros((3, 2, HEIGHT, WIDTH)), "grid": np.zeros((bins, HEIGHT, WIDTH)),
        "surface": np.zeros((2, HEIGHT, WIDTH)),
    }  # fmt: skip
    edges = first + np.array([100, 900, 1000, 2500])
    for t, x, y, p in rows(part):
        sign = 1 if p else -1
        out["count"][y, x] += 1
        out["image"][y, x] += sign
        for i in range(3):
            out["frames"][i, int(p), y, x] += edges[i] <= t < edges[i + 1]
        for b in range(bins):
            at = (bins - 1) * (t - first) / (last - first)
            out["grid"][b, y, x] += sign * max(0, 1 - abs(b - at)) * (first <= t <= last)
        if t <= first + 2000:
            out["surface"][int(p), y, x] = math.exp((t - first - 2000) / 700)
    return out


@pytest.mark.parametrize("bins", [1, 4])
def test_images_are_sums_over_events(bins):
    part, size = drawn(), (WIDTH, HEIGHT)
    first, last = int(part.t[0]), int(part.t[-1])
    true = gathered(part, bins, first, last)
    edges = first + np.array([100, 900, 1000, 2500])
    np.testing.assert_array_equal(events.count_events(part, size=size), true["count"])
    np.testing.assert_array_equal(events.event_image(part, size=size), true["image"])
    np.testing.assert_array_equal(events.count_frames(part, edges, size=size), true["frames"])
    grid = events.voxel_grid(part, bins, size=size)
    np.testing.assert_allclose(grid, true["grid"], atol=1e-5)
    surface = events.time_surface(part, 700, first + 2000, size=size)
    np.testing.assert_allclose(surface, true["surface"], rtol=1e-5)
    given = events.voxel_grid(part, bins, first + 300, first + 1200, size=size)
    shifted = gathered(part, bins, first + 300, first + 1200)
    np.testing.assert_allclose(given, shifted["grid"], atol=1e-5)

    fixed = events.to_device(part, 512, size=size)
    on_device = jax.jit(
        lambda e: (
            events.count_events(e), events.event_image(e), events.count_frames(e, edges - first),
            events.voxel_grid(e, bins), events.time_surface(e, 700, 2000),
        )
    )(fixed)  # fmt: skip
    for name, image in zip(("count", "image", "frames", "grid", "surface"), on_device, strict=True):
        np.testing.assert_allclose(image, true[name], rtol=1e-5, atol=2e-5, err_msg=name)


def test_batches_of_windows_are_mapped():
    part = drawn()
    windows = [events.to_device(part[a : a + 90], 100, size=(WIDTH, HEIGHT)) for a in (0, 90)]
    batch = jax.tree.map(lambda *one: np.stack(one), *windows)
    grids = jax.jit(jax.vmap(lambda e: events.voxel_grid(e, 3)))(batch)
    for grid, a in zip(grids, (0, 90), strict=True):
        alone = events.voxel_grid(part[a : a + 90], 3, size=(WIDTH, HEIGHT))
        np.testing.assert_allclose(grid, alone, atol=1e-5)


def test_what_cannot_be_is_said():
    part, size = drawn(), (WIDTH, HEIGHT)
    for call, said in (
        (lambda: events.filter_background(part, 5), r"give size=\(width, height\)"),
        (lambda: events.filter_background(part, 0, size=size), "is 0 us; give 1 us or more"),
        (lambda: events.filter_background(part, 5, 9, size=size), "give 1 to 8"),
        (lambda: events.crop(part, 5, 0, 3, 1, size=size), "not inside the 7x5 sensor"),
        (lambda: events.downsample(part, 6, size=size), "pixels of 6x6"),
        (lambda: events.count_frames(part, [2, 1], size=size), "rising times"),
        (lambda: events.voxel_grid(part, 0, size=size), "0 bins"),
        (lambda: events.to_device(part, 3, size=size), "do not fit"),
        (lambda: events.to_device(part, origin=-(10**10), size=size), "2\\^31 us"),
        (lambda: events.event_image(part, size=(3, 5)), "on the 3x5 sensor"),
        (lambda: events.remove_hot_pixels(part, np.zeros((2, 2), bool), size=size), "give bool of"),
    ):
        with pytest.raises(InputError, match=said):
            call()


def test_no_event_is_no_error():
    none, size = Events.empty(), (WIDTH, HEIGHT)
    assert not events.event_image(none, size=size).any()
    assert not events.voxel_grid(none, 2, size=size).any()
    assert not events.time_surface(none, 5, size=size).any()
    assert not len(events.filter_background(none, 5, size=size))
    assert events.to_device(none, size=size).t.shape == (1,)


def test_tables():
    part = drawn(9)
    records = part.to_structured()
    assert records.dtype == np.dtype([("t", "<i8"), ("x", "<u2"), ("y", "<u2"), ("p", "?")])
    assert [tuple(row) for row in records.tolist()] == rows(part)
    table = part.to_dataframe()
    assert list(table) == ["t", "x", "y", "p"]
    assert [tuple(row) for row in table.itertuples(index=False)] == rows(part)
    assert table.dtypes.tolist() == [np.int64, np.uint16, np.uint16, bool]


def test_images_that_do_not_fit_in_memory_are_refused():
    with pytest.raises(InputError, match="need [0-9,]+ GB of memory; ask for fewer"):
        events.voxel_grid(drawn(), 10**12, size=(WIDTH, HEIGHT))
