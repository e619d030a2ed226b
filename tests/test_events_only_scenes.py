"""Scenes and scores of experiments/events_only.py."""

import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates
from skimage.exposure import match_histograms
from skimage.metrics import structural_similarity

SCRIPTS = Path(__file__).parents[1] / "experiments"


@pytest.fixture(scope="module")
def script():
    sys.path.insert(0, str(SCRIPTS))
    try:
        import events_only
    finally:
        sys.path.remove(str(SCRIPTS))
    return events_only


def test_scores_are_those_of_scikit_image(script):
    """An image whose brightness is an affine function of the truth has no error but its noise."""
    rng = np.random.default_rng(0)
    truth = gaussian_filter(rng.uniform(size=(40, 50)), 2)
    truth = (truth - truth.min()) / np.ptp(truth)
    noisy = 3 * (truth + 0.1 * rng.normal(size=truth.shape)) - 7
    X = np.stack([noisy.ravel(), np.ones(noisy.size)], 1)
    fitted = (X @ np.linalg.solve(X.T @ X, X.T @ truth.ravel())).reshape(truth.shape).clip(0, 1)
    expected = []
    for image in (fitted, match_histograms(noisy, truth)):
        expected += [
            np.mean((image - truth) ** 2),
            structural_similarity(
                image, truth, data_range=1, gaussian_weights=True, sigma=1.5,
                use_sample_covariance=False,
            ),
        ]  # fmt: skip
    np.testing.assert_allclose(script.score(noisy, truth), expected, rtol=1e-9)
    np.testing.assert_allclose(script.score(5 - 2 * truth, truth)[:2], [0, 1], atol=1e-9)


def test_variance_of_images_is_judged_up_to_their_scale(script):
    rng = np.random.default_rng(0)
    truth, variance = rng.normal(size=(60, 60)), rng.uniform(1e-3, 1e-2, (60, 60))
    image = 4 + 3 * truth + np.sqrt(variance) * rng.normal(size=truth.shape)
    assert script.honesty(image, variance, truth) == pytest.approx(1, abs=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["slider", "objects"])
def test_brightness_is_constant_along_the_true_flow(script, name):
    source, t, step = script.make_source(name, 7), 0.3, 2e-3
    before, after = source.intensity(t), source.intensity(t + step)
    flow = source.flow(t + step / 2)
    rows, columns = np.mgrid[: before.shape[0], : before.shape[1]].astype(float)
    moved = map_coordinates(
        after, [rows + step * flow[..., 1], columns + step * flow[..., 0]], mode="nearest"
    )
    moving = np.hypot(*np.moveaxis(flow, -1, 0)) > 10
    change, rest = (np.abs(one - before)[moving] for one in (after, moved))
    assert np.median(rest) < 0.3 * np.median(change)


@pytest.mark.slow
def test_scenes_are_deterministic_and_have_no_frames(script):
    scene, again = script.make_scene("turn", 7), script.make_source("turn", 7)
    at = scene.times[-1] / 1e6
    np.testing.assert_array_equal(scene.intensity[-1], again.intensity(at))
    np.testing.assert_array_equal(scene.flow[-1], again.flow(at))
    assert scene.recording.frames is None and not scene.recording.extra
    assert abs(scene.flow[0, 90, 120, 0]) > 10 * abs(scene.flow[0, 90, 120, 1])
    assert abs(scene.flow[-1, 90, 120, 1]) > 10 * abs(scene.flow[-1, 90, 120, 0])
