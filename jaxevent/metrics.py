"""Image errors against the truth, on intensities in [0, 1]."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxevent.errors import InputError


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


def mse(image: ArrayLike, truth: ArrayLike) -> NDArray[np.float64]:
    """The mean squared error of each image, an array of shape (...).

    `image` and `truth` are float intensities of equal shape (..., height, width); values outside
    [0, 1] count as they are. Raises `InputError` if shapes differ or a value is not finite.
    """
    image, truth = _pair(image, truth)
    return np.asarray(np.mean((image - truth) ** 2, axis=(-2, -1)))


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
