import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxevent.errors import InputError
from jaxevent.metrics import mse, ssim


def slow_ssim(image, truth):
    """Wang et al. 2004, equations 13-16, one window at a time."""
    offset = np.arange(-5, 6)
    window = np.exp(-(offset[:, None] ** 2 + offset[None, :] ** 2) / (2 * 1.5**2))
    window /= window.sum()
    c1, c2 = 0.01**2, 0.03**2
    values = []
    for row in range(image.shape[0] - 10):
        for column in range(image.shape[1] - 10):
            x = image[row : row + 11, column : column + 11]
            y = truth[row : row + 11, column : column + 11]
            mu_x, mu_y = (window * x).sum(), (window * y).sum()
            var_x = (window * (x - mu_x) ** 2).sum()
            var_y = (window * (y - mu_y) ** 2).sum()
            cov = (window * (x - mu_x) * (y - mu_y)).sum()
            values.append(
                (2 * mu_x * mu_y + c1)
                * (2 * cov + c2)
                / ((mu_x**2 + mu_y**2 + c1) * (var_x + var_y + c2))
            )
    return np.mean(values)


def pairs(seed, shape=(14, 19), noise=0.2):
    rng = np.random.default_rng(seed)
    truth = rng.uniform(size=shape)
    return np.clip(truth + noise * rng.normal(size=shape), 0, 1), truth


@given(st.integers(0, 2**32 - 1), st.integers(11, 20), st.integers(11, 20), st.floats(0, 1))
def test_ssim_is_that_of_explicit_windows(seed, height, width, noise):
    image, truth = pairs(seed, (height, width), noise)
    np.testing.assert_allclose(ssim(image, truth), slow_ssim(image, truth), rtol=0, atol=1e-10)


def test_ssim_of_constant_images_in_closed_form():
    # Without variance only the luminance term remains.
    image, truth = np.full((12, 15), 0.3), np.full((12, 15), 0.8)
    expected = (2 * 0.3 * 0.8 + 1e-4) / (0.3**2 + 0.8**2 + 1e-4)
    np.testing.assert_allclose(ssim(image, truth), expected, rtol=1e-9)


def test_mse_in_closed_form():
    truth = np.zeros((2, 3, 4, 5))
    image = truth + np.arange(6).reshape(2, 3, 1, 1) / 10
    np.testing.assert_allclose(mse(image, truth), np.arange(6).reshape(2, 3) ** 2 / 100)
    # A ramp against its mean has the variance (n^2 - 1) / 12 of n equal steps.
    ramp = np.broadcast_to(np.arange(9.0), (4, 9))
    np.testing.assert_allclose(mse(ramp, np.full((4, 9), 4.0)), (9**2 - 1) / 12)


@pytest.mark.parametrize("measure", [mse, ssim])
def test_each_image_counts_by_itself(measure):
    image, truth = pairs(1, (2, 3, 13, 12))
    values = measure(image, truth)
    assert values.shape == (2, 3) and values.dtype == np.float64
    for place in np.ndindex(2, 3):
        single = measure(image[place], truth[place])
        assert isinstance(single, np.ndarray) and single.shape == ()
        assert single == values[place]
    assert measure(image[:0], truth[:0]).shape == (0, 3)


@pytest.mark.parametrize("measure, best", [(mse, 0.0), (ssim, 1.0)])
def test_identical_images_are_best(measure, best):
    image, truth = pairs(2)
    assert measure(truth, truth) == pytest.approx(best, abs=1e-12)
    assert abs(measure(image, truth) - best) > 1e-3


@pytest.mark.parametrize("measure", [mse, ssim])
@pytest.mark.parametrize(
    "turn", [np.transpose, np.fliplr, np.flipud, np.rot90], ids=lambda turn: turn.__name__
)
@given(seed=st.integers(0, 2**32 - 1))
def test_turning_both_images_changes_nothing(measure, turn, seed):
    image, truth = pairs(seed)
    np.testing.assert_allclose(measure(turn(image), turn(truth)), measure(image, truth), rtol=1e-11)
    np.testing.assert_allclose(measure(truth, image), measure(image, truth), rtol=1e-11)


@pytest.mark.parametrize("measure", [mse, ssim])
def test_single_precision_images_are_summed_in_double(measure):
    image, truth = (part.astype(np.float32) for part in pairs(3, (60, 80)))
    np.testing.assert_allclose(
        measure(image, truth), measure(image.astype(float), truth.astype(float)), rtol=1e-12
    )


@pytest.mark.parametrize("measure", [mse, ssim])
def test_bad_input_is_named(measure):
    image, truth = pairs(4)
    with pytest.raises(InputError, match=r"shape \(14, 18\) and truth \(14, 19\)"):
        measure(image[:, :-1], truth)
    with pytest.raises(InputError, match="equal number"):
        measure(image[None], truth)
    broken = image.copy()
    broken[3, 5] = np.nan
    with pytest.raises(InputError, match=r"image: holds nan at \(3, 5\)"):
        measure(broken, truth)
    broken[3, 5] = np.inf
    with pytest.raises(InputError, match=r"truth: holds inf at \(3, 5\)"):
        measure(image, broken)
    with pytest.raises(InputError, match="uint8"):
        measure((255 * image).astype(np.uint8), truth)
    with pytest.raises(InputError, match=r"\(height, width\)|\.\.\., height, width"):
        measure(image[0], truth[0])
    with pytest.raises(InputError, match="height, width"):
        measure(image[:0], truth[:0])


def test_images_must_hold_one_window():
    image, truth = pairs(5, (11, 30))
    assert np.isfinite(ssim(image, truth))
    with pytest.raises(InputError, match="30x10 pixels are smaller than the 11x11 window"):
        ssim(image[:10], truth[:10])
    with pytest.raises(InputError, match="smaller than the 11x11 window"):
        ssim(image[:, :10], truth[:, :10])
