"""The other camera's images on the event camera's pixels, and the registered recording."""

import numpy as np
import pytest
from rigs import OTHER, RIG, SIZE, part_grid, small
from scipy.ndimage import gaussian_filter

from jaxevent import register
from jaxevent.errors import InputError
from jaxevent.register import Registration, ResampledImages
from jaxevent.register.frames import largest_rectangle


def ramp(width: int, height: int) -> np.ndarray:
    """An image of its coordinates: x + 1000 y."""
    y, x = np.mgrid[:height, :width]
    return (x + 1000.0 * y)[None]


def test_warped_ramps_are_the_grid():
    grid = RIG.grid(SIZE, OTHER, depth=2.0)
    inside = (grid > 2) & (grid < [197, 147])
    grid = np.where(np.all(inside, axis=-1, keepdims=True), grid, np.nan)
    image = np.asarray(ResampledImages(ramp(*OTHER), grid, np.nan))[0]
    np.testing.assert_allclose(image, grid[..., 0] + 1000 * grid[..., 1], atol=1e-6)


def test_where_the_other_camera_resolves_more_pixels_are_means():
    rng = np.random.default_rng(0)
    fine = rng.random((1, 90, 120))
    grid = np.moveaxis(np.mgrid[:30, :40], 0, -1)[..., ::-1] * 3.0 + 1
    (image,) = np.asarray(ResampledImages(fine, grid))
    means = fine[0].reshape(30, 3, 40, 3).mean((1, 3))
    np.testing.assert_allclose(image[1:-1, 1:-1], means[1:-1, 1:-1], atol=1e-9)


def test_clipped_pixels_stay_clipped_and_nothing_overshoots():
    image = np.full((1, 20, 20), 100, np.uint8)
    image[:, :, 10:] = 255
    grid = np.moveaxis(np.mgrid[:20, :19], 0, -1)[..., ::-1] + np.array([0.4, 0.0])
    grey = np.asarray(ResampledImages(image, grid)).reshape(20, 19)
    assert grey.dtype == np.uint8
    # A tenth more of the neighbour than 0.4 by the cubic; the others are between 100 and 255.
    np.testing.assert_array_equal(np.unique(grey[:, :9]), [100])
    assert 150 < int(grey[0, 9]) < 170 and (grey[:, 10:] == 255).all()
    more = np.asarray(ResampledImages(image, grid + np.array([0.2, 0.0])))[0]
    assert more[0, 9] == 255


def test_resampled_images_are_lazy():
    images = np.random.default_rng(0).integers(0, 255, (5, 20, 30, 3), dtype=np.uint8)
    grid = np.full((4, 6, 2), np.nan)
    grid[:, :3] = 7.25
    lazy = ResampledImages(images, grid, fill=9)
    assert lazy.shape == (5, 4, 6, 3) and lazy.dtype == np.uint8 and len(lazy) == 5
    whole = np.asarray(lazy)
    assert (whole[:, :, 3:] == 9).all()
    np.testing.assert_array_equal(np.asarray(lazy[3:]), whole[3:])
    np.testing.assert_array_equal(np.asarray(lazy[np.array([4, 0])]), whole[[4, 0]])
    with pytest.raises(IndexError):
        lazy[2]


def shifts(image: np.ndarray, truth: np.ndarray, block: int) -> list[np.ndarray]:
    """Of each block, how far the image is off the truth (px), by one Lucas-Kanade step."""
    image, truth = gaussian_filter(image, 1.0), gaussian_filter(truth, 1.0)
    down, across = (np.gradient((image + truth) / 2, axis=axis) for axis in (0, 1))
    found = []
    for top in range(0, truth.shape[0] - block + 1, block):
        for left in range(0, truth.shape[1] - block + 1, block):
            part = np.s_[top : top + block, left : left + block]
            if np.isfinite(image[part]).all():
                A = np.stack([across[part].ravel(), down[part].ravel(), np.ones(block * block)], 1)
                found.append(np.linalg.lstsq(A, (truth - image)[part].ravel())[0][:2])
    return found


def test_registered_views_are_the_rendered_ones(near):
    source, other, _, _, rig, _ = near
    grid = rig.grid(source.size, other.size, plane=(0, 0, 1, 2.0))
    worst = []
    for t in (0.1, 0.5):
        images = other.intensity(t)[None]
        (image,) = np.asarray(ResampledImages(images, grid, np.nan))
        worst += shifts(np.log(image), np.log(source.intensity(t)), 24)
    assert len(worst) >= 8
    assert np.linalg.norm(worst, axis=1).max() < 0.1
    # The check sees what it is for: a wall 10 % farther away is off by half a pixel.
    grid = rig.grid(source.size, other.size, plane=(0, 0, 1, 2.2))
    (image,) = np.asarray(ResampledImages(other.intensity(0.1)[None], grid, np.nan))
    off = shifts(np.log(image), np.log(source.intensity(0.1)), 24)
    assert np.linalg.norm(np.mean(off, 0)) > 0.3


def test_registered_frames_have_the_events_clock():
    recording, other = small(9)
    both = register.apply_registration(
        recording, other, Registration(part_grid(), -5.0 - 0.04)
    ).check()
    # Those more than a frame away are left out: of -40, -20, ..., 120 ms the first.
    np.testing.assert_array_equal(both.frames.t, np.arange(-20_000, 120_001, 20_000)[:-1])
    assert (both.frames.exposure == 3_000).all()
    np.testing.assert_array_equal(both.gain, np.arange(2.0, 9.0))
    assert both.extra["rgb"].shape == (7, 6, 8, 3) and both.camera == recording.camera
    assert (both.extra["rgb"][:, 1, :2] == 0).all() and (both.extra["rgb"][:, 1, 3] == 50).all()
    assert np.asarray(both.frames.images)[:, 0].tolist() == [[0, 0, 100, 100, 100, 0, 100, 100]] * 7
    assert both.extra["kept"] is recording.extra["kept"]
    with pytest.raises(InputError, match="give the offset"):
        register.apply_registration(recording, other, Registration(part_grid(), 1.0))
    with pytest.raises(InputError, match="nothing that the event camera sees"):
        register.apply_registration(recording, other, Registration(part_grid() * np.nan, -5.0))


def test_a_crop_is_a_smaller_recording():
    recording, other = small()
    H = np.array([[1.0, 0.1, 2], [0, 1, 3], [0, 0, 1]])
    both = register.apply_registration(
        recording, other, Registration(part_grid(), -5.0, H), crop=True
    )
    both.check()
    assert (both.width, both.height) == (6, 5)
    assert (both.camera.cx, both.camera.cy) == (2.0, 2.0)
    inside = (recording.events.x >= 2) & (recording.events.y >= 1)
    np.testing.assert_array_equal(both.events.t, recording.events.t[inside])
    np.testing.assert_array_equal(both.events.x, recording.events.x[inside] - 2)
    np.testing.assert_array_equal(both.events.y, recording.events.y[inside] - 1)
    assert both.extra["covered"].all() and both.extra["hdr"].shape == (1, 5, 6)
    assert both.extra["rgb"].shape == (6, 5, 6, 3)
    np.testing.assert_allclose(both.extra["homography"] @ [1, 1, 1], H @ [3, 2, 1])


def test_the_largest_rectangle():
    rng = np.random.default_rng(0)
    for _ in range(20):
        mask = rng.random((6, 7)) < 0.8
        left, top, right, bottom = largest_rectangle(mask)
        areas = [
            (y1 - y0) * (x1 - x0)
            for y0 in range(6) for y1 in range(y0 + 1, 7)
            for x0 in range(7) for x1 in range(x0 + 1, 8)
            if mask[y0:y1, x0:x1].all()
        ]  # fmt: skip
        assert mask[top:bottom, left:right].all()
        assert (bottom - top) * (right - left) == max(areas)
