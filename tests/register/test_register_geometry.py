"""Grids of a calibrated rig and of a homography."""

import dataclasses

import numpy as np
import pytest
from rigs import ONE, OTHER, RIG, SIZE, TWO, turned

from jaxevent import register
from jaxevent.camera import PinholeCamera
from jaxevent.register import Rig
from jaxevent.register.geometry import pixel_rays


@pytest.mark.parametrize("plane", [(0.0, 0.0, 1.0, 2.0), (0.3, -0.2, 1.0, 1.5)])
def test_grid_of_a_plane_is_that_of_opencv(plane):
    cv2 = pytest.importorskip("cv2")
    grid = RIG.grid(SIZE, OTHER, plane=plane)
    seen = ~np.isnan(grid[..., 0])
    assert 0.5 < seen.mean() < 1
    y, x = np.nonzero(seen)
    matrix, other = (np.array([[c.fx, 0, c.cx], [0, c.fy, c.cy], [0, 0, 1]]) for c in (ONE, TWO))
    # The undistorted place, as a fixed point of OpenCV's distortion.
    ray = np.concatenate(
        [(np.stack([x, y], 1) - (ONE.cx, ONE.cy)) / (ONE.fx, ONE.fy)] + [np.ones((len(x), 1))], 1
    )
    none = np.zeros(3)
    for _ in range(60):
        bent, _ = cv2.projectPoints(ray, none, none, matrix, np.array(ONE.distortion))
        ray[:, :2] -= (bent[:, 0] - np.stack([x, y], 1)) / (ONE.fx, ONE.fy)
    X = ray * (plane[3] / (ray @ np.array(plane[:3])))[:, None]
    turn = cv2.Rodrigues(RIG.rotation)[0]
    places, _ = cv2.projectPoints(X, turn, RIG.translation, other, np.array(TWO.distortion))
    np.testing.assert_allclose(grid[y, x], places[:, 0], atol=1e-6)


def test_grid_between_fisheyes_is_that_of_opencv():
    cv2 = pytest.importorskip("cv2")
    one = PinholeCamera(70, 71, 63.5, 47.5, (0.05, -0.01, 2e-3, -1e-3), "equidistant")
    two = PinholeCamera(80.0, 79.0, 101.0, 74.0, (-0.02, 0.01, -3e-3, 1e-3), "equidistant")
    rig = Rig(one, two, RIG.rotation, RIG.translation)
    grid = rig.grid(SIZE, OTHER, depth=2.0)
    y, x = np.nonzero(~np.isnan(grid[..., 0]))
    assert len(x) > 0.5 * SIZE[0] * SIZE[1]
    matrix, other = (np.array([[c.fx, 0, c.cx], [0, c.fy, c.cy], [0, 0, 1]]) for c in (one, two))
    at = np.stack([x, y], 1)[:, None].astype(float)
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 100, 1e-12)
    ray = cv2.fisheye.undistortPoints(at, matrix, np.array(one.distortion), criteria=stop)[:, 0]
    X = 2.0 * np.concatenate([ray, np.ones((len(ray), 1))], 1)[:, None]
    turn = cv2.Rodrigues(RIG.rotation)[0]
    k = np.array(two.distortion)
    places, _ = cv2.fisheye.projectPoints(X, turn, RIG.translation[:, None], other, k)
    np.testing.assert_allclose(grid[y, x], places[:, 0], atol=1e-6)


def test_a_depth_map_is_the_plane_and_far_away_the_translation_does_not_matter():
    plane = (0.3, -0.2, 1.0, 1.5)
    ray = pixel_rays(ONE, SIZE)
    depth = (1.5 / (ray @ np.array(plane[:3]))).reshape(96, 128)
    of_map = RIG.grid(SIZE, OTHER, depth=depth)
    np.testing.assert_allclose(of_map, RIG.grid(SIZE, OTHER, plane=plane), atol=1e-9)
    part = depth.copy()
    part[10:20] = np.nan
    assert np.isnan(RIG.grid(SIZE, OTHER, depth=part)[10:20]).all()
    here = dataclasses.replace(RIG, translation=np.zeros(3))
    np.testing.assert_allclose(RIG.grid(SIZE, OTHER), here.grid(SIZE, OTHER, depth=3.0), atol=1e-9)
    assert np.nanmax(np.abs(RIG.grid(SIZE, OTHER) - RIG.grid(SIZE, OTHER, depth=2.0))) > 5


def test_what_is_behind_a_camera_or_outside_its_image_is_not_seen():
    back = dataclasses.replace(RIG, rotation=turned(0, np.pi, 0))
    assert np.isnan(back.grid(SIZE, OTHER)).all()
    # With k1 = -0.5 the lens's circle ends at r = 0.816: what lies beyond folds back inside.
    strong = PinholeCamera(40.0, 40.0, 50.0, 50.0, (-0.5, 0.0, 0.0, 0.0, 0.0))
    wide = Rig(PinholeCamera(20.0, 20.0, 63.5, 47.5), strong, np.eye(3), np.zeros(3))
    seen = ~np.isnan(wide.grid(SIZE, (101, 101))[..., 0])
    y, x = np.mgrid[:96, :128]
    np.testing.assert_array_equal(seen, np.hypot(x - 63.5, y - 47.5) / 20 < np.sqrt(2 / 3))


def test_the_homography_of_a_far_scene_is_that_of_its_calibration():
    K = [np.array([[c.fx, 0, c.cx], [0, c.fy, c.cy], [0, 0, 1]]) for c in (ONE, TWO)]
    H = K[1] @ RIG.rotation @ np.linalg.inv(K[0])
    grid = register.homography_grid(H, SIZE, OTHER, ONE, TWO)
    np.testing.assert_allclose(grid, RIG.grid(SIZE, OTHER), atol=1e-6)
