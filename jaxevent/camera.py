"""Cameras: the response from intensity to grey levels and its certainty, and the lens.

Lens models take normalised coordinates X / Z, Y / Z to places in the image, and back:

    radtan       k1 k2 p1 p2 k3              Brown-Conrady; ROS: plumb_bob, OpenCV's five numbers
    rational     k1 k2 p1 p2 k3 k4 k5 k6     the same, the radial part over 1 + k4 r^2 + k5 r^4
                                             + k6 r^6; ROS: rational_polynomial
    equidistant  k1 k2 k3 k4                 Kannala and Brandt, PAMI 2006, as OpenCV's fisheye:
                                             an angle a from the axis is seen at the radius
                                             a (1 + k1 a^2 + k2 a^4 + k3 a^6 + k4 a^8)

All places are (n, 2), before focal lengths and centre are applied.
"""

import abc
import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike, NDArray

from jaxevent.errors import InputError
from jaxevent.precision import to_jax

_LARGEST_SENSOR = (1 << 16, 1 << 16)  # px: coordinates of events are uint16
_MAX_TAN_ANGLE = 20.0  # tan of the widest angle from the axis that is supported, 87 degrees


@dataclasses.dataclass(frozen=True)
class PinholeCamera:
    """A camera of one centre of projection, with the distortion of its lens.

    Attributes:
        fx: Horizontal focal length in px, a float, int or traced number, as those that follow.
        fy: Vertical focal length in px.
        cx: Column of the centre in px.
        cy: Row of the centre in px.
        distortion: Coefficients of the lens, floats; missing ones are 0.
        model: Model of the distortion, as listed above: "radtan" (Brown-Conrady: k1, k2, p1,
            p2, k3), "rational" (k1, k2, p1, p2, k3, k4, k5, k6) or "equidistant" (fisheye: k1, k2,
            k3, k4).

    Raises:
        InputError: The model is another, or there are more coefficients than it has; a number is
            not finite, a focal length is not positive, or no sensor sees anything within 87 degrees
            of the axis. Traced values are not checked.
    """

    fx: Any
    fy: Any
    cx: Any
    cy: Any
    distortion: tuple = ()
    model: str = "radtan"

    def __post_init__(self) -> None:
        model = find_model(str(self.model))
        if model is None:
            raise InputError(
                f"the lens model {self.model!r} of a camera is not supported; give one of "
                f"{', '.join(LENS_MODELS)}"
            )
        names, given = LENS_MODELS[model].coefficients, tuple(self.distortion)
        if len(given) > len(names):
            raise InputError(
                f"a camera of the lens model {model} has {len(given)} coefficients; give at most "
                f"{len(names)}, {', '.join(names)}"
            )
        object.__setattr__(self, "distortion", (*given, *(0.0,) * (len(names) - len(given))))
        object.__setattr__(self, "model", model)
        self._check_numbers()
        self.check_sensor(*_LARGEST_SENSOR)

    def _check_numbers(self) -> None:
        """Raise `InputError` for what is not finite, and focal lengths that are not positive."""
        given = {name: getattr(self, name) for name in ("fx", "fy", "cx", "cy")}
        names = LENS_MODELS[self.model].coefficients
        given |= dict(zip(names, self.distortion, strict=True))
        for name, value in given.items():
            if isinstance(value, jax.core.Tracer):
                continue
            if np.ndim(value) or np.asarray(value).dtype.kind not in "iuf":
                raise InputError(f"{name} of a camera is {value!r}; give one number")
            if not np.isfinite(value):
                raise InputError(
                    f"{name} of a camera is {value}; give the calibration's finite numbers"
                )
        focal = [f for f in (self.fx, self.fy) if not isinstance(f, jax.core.Tracer)]
        if not all(f > 0 for f in focal):
            raise InputError(
                f"a camera of focal lengths {self.fx} and {self.fy} px is not possible; give the "
                "calibration's positive fx and fy in px"
            )

    def check_sensor(self, width: int, height: int, source: str = "") -> None:
        """Check that a sensor reaches to within 87 degrees of the axis.

        Args:
            width: Columns of the sensor.
            height: Its rows.
            source: Name of the recording for messages.

        Raises:
            InputError: The centre is farther beside the sensor.
        """
        for f, c, side, name in ((self.fx, self.cx, width, "cx"), (self.fy, self.cy, height, "cy")):
            if isinstance(f, jax.core.Tracer) or isinstance(c, jax.core.Tracer):
                continue
            if max(-c, c - (side - 1)) > _MAX_TAN_ANGLE * f:
                raise InputError(
                    f"{source}{': ' * bool(source)}a camera with {name} = {c} px, more than 87 "
                    f"degrees beside the sensor at a focal length of {f} px, is not possible; give "
                    "the calibration's centre in px, usually near (width - 1) / 2, (height - 1) / 2"
                )

    @property
    def is_distorted(self) -> bool:
        """True if the image of a straight line may be bent."""
        return self.model == "equidistant" or any(self.distortion)

    @property
    def undistorted(self) -> "PinholeCamera":
        """Camera of the same focal lengths and centre without distortion."""
        return PinholeCamera(self.fx, self.fy, self.cx, self.cy)

    def distort(self, at: NDArray[np.floating]) -> NDArray[np.float64]:
        """Project normalised coordinates X / Z, Y / Z (n, 2) to places in px (n, 2).

        NaN beyond the radius at which the distortion turns back, where no light passes the lens.
        """
        at, lens = np.asarray(at, np.float64), LENS_MODELS[self.model]
        bent, _ = lens.distort(at, self.distortion)
        bent = np.where((np.hypot(*at.T) < lens.turn(self.distortion))[:, None], bent, np.nan)
        return bent * (self.fx, self.fy) + (self.cx, self.cy)

    def normalise(self, x: ArrayLike, y: ArrayLike) -> NDArray[np.float64]:
        """Return the normalised coordinates of places in the image, with the distortion undone.

        Args:
            x: (n,) columns in px.
            y: (n,) rows in px.

        Returns:
            (n, 2) coordinates X / Z, Y / Z. NaN where the distortion has no inverse, which is far
            from the centre, and more than 87 degrees from the axis.
        """
        x, y = np.asarray(x), np.asarray(y)
        places, which = np.unique(np.stack([x, y], -1).astype(float), axis=0, return_inverse=True)
        seen = (places - (self.cx, self.cy)) / (self.fx, self.fy)
        straight = LENS_MODELS[self.model].undistort(seen, self.distortion)
        return np.asarray(straight[which.reshape(-1)], np.float64)


# Grey values or intensities of any shape, in JAX or NumPy.
Values = Float[Array | np.ndarray, "..."] | float


class Response(eqx.Module):
    """A camera response: grey values of intensities, its inverse, and the certainty of grey values.

    Grey values are in [0, 1], of a uint8 level `level / 255`. Intensity is in units of the range
    that the camera resolves. All methods take arrays of any shape and are differentiable.
    """

    @abc.abstractmethod
    def grey(self, intensity: Values) -> Float[Array, "..."]:
        """Return the grey value in [0, 1] of an intensity, clipped at both ends."""

    @abc.abstractmethod
    def intensity(self, grey: Values) -> Float[Array, "..."]:
        """Return the intensity in [0, 1] of a grey value in [0, 1]."""

    @abc.abstractmethod
    def certainty(self, grey: Values) -> Float[Array, "..."]:
        """Return w = dCRF/dE at a grey value, scaled to the maximum 1 (AKF paper section 3.2.1)."""


class UnknownResponse(Response):
    """Grey is intensity; certainty 4 I (1 - I): full at mid-grey, none where the sensor clips."""

    def grey(self, intensity: Values) -> Float[Array, "..."]:
        return jnp.clip(jnp.asarray(intensity), 0, 1)

    def intensity(self, grey: Values) -> Float[Array, "..."]:
        return to_jax(grey)

    def certainty(self, grey: Values) -> Float[Array, "..."]:
        grey = jnp.asarray(grey)
        return 4 * grey * (1 - grey)


class SCurve(Response):
    """An artificial camera that crops: what it resolves is [0, 1], pressed into an S-shape.

    A normalised logistic of steepness s, E clipped to [0, 1]:

        CRF(E) = 1/2 + tanh(s (E - 1/2) / 2) / (2 tanh(s / 4))
        CRF^-1(g) = 1/2 + (2 / s) artanh((2 g - 1) tanh(s / 4))
        w(g) = 1 - ((2 g - 1) tanh(s / 4))^2

    so CRF(0) = 0, CRF(1) = 1 and the certainty at both ends is sech^2(s / 4), 0.07 by default. It
    makes artificial HDR data of ordinary images (AKF supplement 4.2, which prints no formula): the
    grey levels from `cut` to `255 - cut` of an image are the camera's [0, 1], see `scene`. Raises
    `InputError` unless 0 <= cut < 127.5 and 0 < steepness <= 20.
    """

    cut: Float[Array, ""]
    steepness: Float[Array, ""]

    def __init__(self, cut: float | int | Array = 50, steepness: float | int | Array = 8):
        if not isinstance(cut, jax.core.Tracer) and not 0 <= cut < 127.5:
            raise InputError(f"a camera cannot crop {cut} of 255 levels; give 0 to 127")
        if not isinstance(steepness, jax.core.Tracer) and not 0 < steepness <= 20:
            raise InputError(
                f"the steepness {steepness} of a camera response is not in (0, 20]; 8 is common"
            )
        self.cut = jnp.asarray(cut, jnp.result_type(float))
        self.steepness = jnp.asarray(steepness, jnp.result_type(float))

    def scene(self, level: ArrayLike | int | float) -> Float[Array, "..."]:
        """Return the intensity of a level in [0, 255] of an original image; it is not clipped."""
        return (jnp.asarray(level) - self.cut) / (255 - 2 * self.cut)

    def level(self, intensity: Values) -> Float[Array, "..."]:
        """Return the original image's level, 0 to 255, of an intensity: the inverse of `scene`."""
        return self.cut + jnp.asarray(intensity) * (255 - 2 * self.cut)

    def grey(self, intensity: Values) -> Float[Array, "..."]:
        inside = jnp.clip(jnp.asarray(intensity), 0, 1)
        # The rounding error of tanh may lead an ulp beyond the ends, which float frames may not.
        grey = 0.5 + jnp.tanh(self.steepness * (inside - 0.5) / 2) / (2 * self._normaliser())
        return jnp.clip(grey, 0, 1)

    def intensity(self, grey: Values) -> Float[Array, "..."]:
        return 0.5 + 2 / self.steepness * jnp.arctanh(
            (2 * jnp.asarray(grey) - 1) * self._normaliser()
        )

    def certainty(self, grey: Values) -> Float[Array, "..."]:
        return 1 - ((2 * jnp.asarray(grey) - 1) * self._normaliser()) ** 2

    def table(self, entries: int = 256) -> Float[Array, " entries"]:
        """Return the intensities of evenly spaced grey values, as `TableResponse` takes them."""
        return self.intensity(jnp.linspace(0, 1, entries))

    def _normaliser(self) -> Float[Array, ""]:
        return jnp.tanh(self.steepness / 4)


class TableResponse(Response):
    """A monotone table: `levels[i]` is the intensity at grey value i / (len(levels) - 1).

    The certainty is `weights`, entry by entry, scaled to the maximum 1; omitted, it is the slope of
    grey over intensity, by central differences of the table as it was given. Tables of the authors'
    recordings: `TableResponse(jnp.linspace(0, 1, 256), recording.extra["f_Q"])`. Between entries
    all is linear; an intensity that several grey values share has the grey value of one of them.
    Raises `InputError` for a table of fewer than 3 intensities, one that falls, values that are not
    finite, and weights of another length.
    """

    levels: Float[Array, " entries"]
    weights: Float[Array, " entries"]

    def __init__(self, levels: ArrayLike, weights: ArrayLike | None = None):
        table = np.asarray(levels, float)
        finite = np.isfinite(table).all()
        if table.ndim != 1 or len(table) < 3 or not finite or not (np.diff(table) >= 0).all():
            raise InputError("a camera response needs 3 or more intensities that never fall")
        certain = 1 / np.maximum(np.gradient(table), 1e-9) if weights is None else weights
        certain = np.asarray(certain, float)
        positive = np.isfinite(certain).all() and (certain >= 0).all() and (certain > 0).any()
        if certain.shape != table.shape or not positive:
            raise InputError(
                f"a camera response of {len(table)} intensities needs as many weights, none "
                "negative and not all 0"
            )
        self.levels = jnp.asarray(table, jnp.result_type(float))
        self.weights = jnp.asarray(certain / certain.max(), jnp.result_type(float))

    def grey(self, intensity: Values) -> Float[Array, "..."]:
        return jnp.interp(jnp.asarray(intensity), self.levels, self._greys())

    def intensity(self, grey: Values) -> Float[Array, "..."]:
        return jnp.interp(jnp.asarray(grey), self._greys(), self.levels)

    def certainty(self, grey: Values) -> Float[Array, "..."]:
        return jnp.interp(jnp.asarray(grey), self._greys(), self.weights)

    def _greys(self) -> Float[Array, " entries"]:
        return jnp.linspace(0, 1, self.levels.shape[0])


def estimate_response(
    images: NDArray,
    exposures: ArrayLike,
    *,
    smoothness: float | int = 20,
    margin: int = 4,
    samples: int = 20,
    seed: int = 0,
) -> TableResponse:
    """Estimate a camera response from images of one still scene under different exposure times.

    Debevec and Malik, "Recovering High Dynamic Range Radiance Maps from Photographs", SIGGRAPH
    1997: with g(z) = ln CRF^-1 the least squares fit of g(z_ij) = ln E_i + ln t_j, weighted by a
    hat over the grey levels, and of g'' = 0, weighted by `smoothness`.

    Args:
        images: (N, H, W) uint8.
        exposures: (N,) exposure times in s, of which only the ratios matter.
        smoothness: Weight of g'' = 0, relative to the data of a grey level.
        margin: Levels within this distance of 0 and 255 count as clipped. A clipped pixel that
            noise shows as unclipped misleads the fit: give 3 to 4 standard deviations of the noise.
        samples: Number of pixels of each grey level of each image, unclipped in two images or more.
        seed: Seed of the choice of pixels.

    Returns:
        A response that never falls; grey level 255 has intensity 1. Its certainty is its
        derivative, and 0 at levels that no chosen pixel has, as clipped ones: there intensity is
        extrapolated.

    Raises:
        InputError: Images and exposures do not fit together or all have one exposure, too few
            pixels are usable, or a setting is outside its range.
    """
    stack, times = _check_stack(images, exposures)
    if len(np.unique(times)) < 2:
        raise InputError(
            f"{len(stack)} images of one exposure time determine no camera response; give images "
            "of two or more exposure times"
        )
    if not smoothness > 0 or not samples > 0 or not 0 <= margin <= 32:
        raise InputError(
            f"smoothness {smoothness} and samples {samples} must be positive and margin {margin} "
            "0 to 32 grey levels"
        )
    level = np.arange(256)
    hat = np.maximum(np.minimum(level, 255 - level) - margin, 0) / (127 - margin)
    z = _draw_pixels(stack.reshape(len(stack), -1), hat > 0, samples, np.random.default_rng(seed))
    shown = (np.bincount(z.ravel(), minlength=256) > 0) & (hat > 0)
    surplus = int((hat[z] > 0).sum()) - z.shape[1]
    if surplus < 256 or not shown[:48].any() or not shown[208:].any():
        raise InputError(
            f"only {z.shape[1]} usable pixels, unclipped in two images, is too few or their grey "
            "levels too alike to determine a camera response; expose so that many pixels are "
            "unclipped in two images, from dark to bright"
        )
    levels = _debevec(z, np.log(times), hat, smoothness)
    slope = np.gradient(levels)
    return TableResponse(levels, np.where(shown & (slope > 0), 1 / np.maximum(slope, 1e-9), 0))


def _check_stack(images: NDArray, exposures: ArrayLike) -> tuple[NDArray, NDArray[np.float64]]:
    """Check the images and exposure times of a stack.

    Args:
        images: (images, height, width) uint8.
        exposures: (images,) exposure times, s.

    Returns:
        Both as arrays.

    Raises:
        InputError: They are not.
    """
    stack, times = np.asarray(images), np.asarray(exposures, float)
    if stack.dtype != np.uint8 or stack.ndim != 3:
        raise InputError(
            f"an exposure stack of shape {stack.shape} and type {stack.dtype} cannot be used; give "
            "(images, height, width) uint8"
        )
    if times.shape != stack.shape[:1] or not len(times):
        raise InputError(
            f"{len(stack)} images have exposures of shape {times.shape}; give one exposure time "
            "for each image"
        )
    if not (np.isfinite(times) & (times > 0)).all():
        raise InputError(f"exposure times must be positive; they are {times.tolist()}")
    return stack, times


def _draw_pixels(z: NDArray, usable: NDArray, samples: int, rng: np.random.Generator) -> NDArray:
    """Draw pixels that are usable twice, spread over the grey levels.

    Args:
        z: (images, pixels) grey levels.
        usable: (256,) whether a level is usable.
        samples: Pixels of each level that are drawn in each image.
        rng: Generator.

    Returns:
        (images, drawn) grey levels.
    """
    z = z[:, usable[z].sum(0) >= 2]
    z = z[:, rng.permutation(z.shape[1])]
    drawn = np.zeros(z.shape[1], bool)
    for image in z:
        order = np.argsort(image, kind="stable")
        level = image[order]
        rank = np.arange(len(level)) - np.searchsorted(level, level)  # within its grey level
        drawn[order[(rank < samples) & usable[level]]] = True
    return z[:, drawn]


def _debevec(
    z: NDArray, log_exposure: NDArray, hat: NDArray, smoothness: float | int
) -> NDArray[np.float64]:
    """Fit the intensity of every grey level.

    Pixel i contributes sum_j h_j (g(z_j) - ln t_j - ln E_i)^2, h_j = hat(z_j)^2. Its best ln E_i is
    the mean of g(z_j) - ln t_j under h. Put in, normal equations of the 256 values of g remain:
    their matrix is the sum over pixels of diag(v) - v v' / sum v, v = sum_j h_j e_zj.

    Args:
        z: (images, pixels) grey levels, 0 to 255.
        log_exposure: (images,) logarithms of the exposure times t.
        hat: (256,) weights of grey levels.
        smoothness: Weight of the second differences of g.

    Returns:
        (256,) intensities; that of the highest level is 1.
    """
    import scipy.linalg
    import scipy.optimize

    h = hat[z] ** 2
    total = h.sum(0)
    matrix = np.diag(np.bincount(z.ravel(), h.ravel(), 256))
    for j in range(len(z)):
        for k in range(len(z)):
            pair = z[j].astype(np.intp) * 256 + z[k]
            matrix -= np.bincount(pair, h[j] * h[k] / total, 256 * 256).reshape(256, 256)
    centred = log_exposure[:, None] - (h * log_exposure[:, None]).sum(0) / total
    right = np.bincount(z.ravel(), (h * centred).ravel(), 256)
    scale = np.trace(matrix) / 256
    level = np.arange(256)
    full = np.minimum(level, 255 - level) / 127
    bend = smoothness * full[1:-1, None] * np.diff(np.eye(256), n=2, axis=0)
    # Data and bends leave a constant open: g(128) = 0.
    anchor = np.zeros((256, 256))
    anchor[128, 128] = 1
    g = scipy.linalg.solve(matrix / scale + bend.T @ bend + anchor, right / scale, assume_a="pos")
    g = scipy.optimize.isotonic_regression(g, weights=hat + 1e-3).x
    return np.exp(g - g[-1])


def merge_exposures(
    images: NDArray,
    exposures: ArrayLike,
    response: Response,
    *,
    reference: float | int | None = None,
    margin: int = 3,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Merge images of one still scene under different exposure times into an HDR image.

    The intensity is the mean of CRF^-1(z_j) t_ref / t_j under the weights w(z_j) (t_j / t_ref)^2,
    the inverse variances if CRF^-1(z) has the variance 1 / w(z) (AKF paper (4); Robertson et al.,
    ICIP 1999).

    Args:
        images: (N, H, W) uint8.
        exposures: (N,) exposure times in s.
        response: Camera response.
        reference: Exposure time in s of the frames in whose units intensity is; by default the
            first image's.
        margin: Levels within this distance of 0 and 255 count as clipped and have no weight.

    Returns:
        Intensity (H, W), and its variance (H, W) relative to that of a pixel of certainty 1 in a
        frame of the reference exposure. Where all images are clipped the variance is infinite and
        intensity a bound: that of the shortest saturated exposure, of the longest dark one, or
        their mean where there are both.

    Raises:
        InputError: Images and exposures do not fit together.
    """
    stack, times = _check_stack(images, exposures)
    reference = float(times[0]) if reference is None else reference
    if not 0 < reference < np.inf or not 0 <= margin < 127:
        raise InputError(
            f"the reference exposure {reference} must be positive and the margin {margin} 0 to 126"
        )
    ratio = times / reference
    level = np.arange(256)
    intensity = np.asarray(response.intensity(level / 255), float)
    certainty = np.asarray(response.certainty(level / 255), float)
    inside = (level > margin) & (level < 255 - margin)
    certainty = np.where(inside, np.maximum(certainty, 0), 0)

    # Image by image: memory is that of a few images, however many are merged.
    shape = stack.shape[1:]
    total, weighted = np.zeros(shape), np.zeros(shape)
    dark, bright = np.full(shape, np.nan), np.full(shape, np.nan)
    for j in np.argsort(ratio, kind="stable"):
        z = stack[j]
        weight = certainty[z] * ratio[j] ** 2
        total += weight
        weighted += weight * (intensity[z] / ratio[j])
        bound = intensity[z] / ratio[j]
        dark = np.where(z < 128, bound, dark)
        bright = np.where((z >= 128) & np.isnan(bright), bound, bright)
    bound = np.where(np.isnan(dark), bright, np.where(np.isnan(bright), dark, (dark + bright) / 2))
    used = total > 0
    safe = np.where(used, total, 1)
    return np.where(used, weighted / safe, bound), np.where(used, 1 / safe, np.inf)


Places = NDArray[np.float64]
Coefficients = Sequence[float]
_NEWTON_STEPS = 20  # of Newton's method


@dataclasses.dataclass(frozen=True)
class Lens:
    """A model of distortion.

    Attributes:
        coefficients: Names of its numbers, in order.
        aliases: Other names of the model, as calibration programs write them.
        distort: Map places (n, 2) and coefficients to distorted places (n, 2) and their
            Jacobian (n, 2, 2).
        undistort: The inverse; NaN where there is none.
        turn: The radius from which on the distorted radius no longer rises; infinite if it always
            does.
    """

    coefficients: tuple[str, ...]
    aliases: tuple[str, ...]
    distort: Callable[[Places, Coefficients], tuple[Places, NDArray[np.float64]]]
    undistort: Callable[[Places, Coefficients], Places]
    turn: Callable[[Coefficients], float]


def find_model(name: str) -> str | None:
    """Find the name in `LENS_MODELS` of a model by any of its names; None if unsupported."""
    name = name.strip().lower()
    for model, lens in LENS_MODELS.items():
        if name == model or name in lens.aliases:
            return model
    return None


def _distort_rational(xy: Places, k: Coefficients) -> tuple[Places, NDArray[np.float64]]:
    """Apply Brown-Conrady distortion, its radial part N / D.

    Args:
        xy: (n, 2) straight places x / z and y / z.
        k: Coefficients k1, k2, p1, p2, k3, k4, k5, k6; missing ones are 0.

    Returns:
        Distorted places (n, 2), and their Jacobian (n, 2, 2).
    """
    k1, k2, p1, p2, k3, k4, k5, k6 = (*k, *(0.0,) * (8 - len(k)))
    x, y = xy.T
    r2 = x * x + y * y
    N = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    D = 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
    dN = k1 + r2 * (2 * k2 + 3 * r2 * k3)  # by r^2
    dD = k4 + r2 * (2 * k5 + 3 * r2 * k6)
    radial = N / D
    slope = 2 * (dN * D - N * dD) / D**2  # of radial, times x or y
    bent = np.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        ],
        -1,
    )
    across = x * y * slope + 2 * p1 * x + 2 * p2 * y
    xx = radial + x * x * slope + 2 * p1 * y + 6 * p2 * x
    yy = radial + y * y * slope + 6 * p1 * y + 2 * p2 * x
    return bent, np.stack([np.stack([xx, across], -1), np.stack([across, yy], -1)], -2)


def _undistort_rational(seen: Places, k: Coefficients) -> Places:
    """Invert the distortion by Newton's method, where the Jacobian is positive definite.

    Args:
        seen: (n, 2) distorted places.
        k: Coefficients, as of `_distort_rational`.

    Returns:
        (n, 2) straight places.
    """
    straight = seen.copy()
    if not any(k):
        return straight
    for _ in range(_NEWTON_STEPS):
        bent, jacobian = _distort_rational(straight, k)
        straight = straight + np.linalg.solve(jacobian, (seen - bent)[..., None])[..., 0]
    bent, jacobian = _distort_rational(straight, k)
    good = np.abs(bent - seen).max(-1) < 1e-9
    good &= (np.linalg.det(jacobian) > 0) & (np.hypot(*straight.T) < _MAX_TAN_ANGLE)
    straight[~good] = np.nan
    return straight


def _turn_rational(k: Coefficients) -> float:
    """Return the least root of D or of (r N / D)' D^2, polynomials in r^2 = s."""
    k1, k2, _, _, k3, k4, k5, k6 = (*k, *(0.0,) * (8 - len(k)))
    N, D = np.poly1d([k3, k2, k1, 1.0]), np.poly1d([k6, k5, k4, 1.0])
    s = np.poly1d([1.0, 0.0])
    rising = (N + 2 * s * N.deriv()) * D - 2 * s * N * D.deriv()
    return float(np.sqrt(_least_root(np.concatenate([rising.roots, D.roots]))))


def _distort_equidistant(xy: Places, k: Coefficients) -> tuple[Places, NDArray[np.float64]]:
    """Apply the distortion of a fisheye lens.

    Args:
        xy: (n, 2) straight places x / z and y / z.
        k: Coefficients k1 to k4, as of `_radius`.

    Returns:
        Distorted places (n, 2), and their Jacobian (n, 2, 2).
    """
    r = np.hypot(*xy.T)
    radius, slope = _radius(np.arctan(r), k)
    far = r > 1e-9
    scale = np.where(far, radius / np.where(far, r, 1), 1.0)
    # d(scale x) = scale dx + x scale' dr, with r scale' = radius' / (1 + r^2) - scale
    u = xy / np.where(far, r, 1)[:, None]
    along = slope / (1 + r * r) - scale
    jacobian = scale[:, None, None] * np.eye(2) + along[:, None, None] * u[:, :, None] * u[:, None]
    return xy * scale[:, None], jacobian


def _undistort_equidistant(seen: Places, k: Coefficients) -> Places:
    """Invert the distortion by Newton's method, up to the angle at which the radius turns.

    Args:
        seen: (n, 2) distorted places.
        k: Coefficients k1 to k4, as of `_radius`.

    Returns:
        (n, 2) straight places.
    """
    radius = np.hypot(*seen.T)
    most = min(_widest(k), np.arctan(_MAX_TAN_ANGLE))
    angle = np.minimum(radius, most)
    for _ in range(_NEWTON_STEPS):
        value, slope = _radius(angle, k)
        angle = np.clip(angle - (value - radius) / np.where(slope > 0, slope, 1), 0, most)
    value, slope = _radius(angle, k)
    good = (np.abs(value - radius) < 1e-9) & (slope > 0)
    scale = np.where(radius > 1e-9, np.tan(angle) / np.where(radius > 1e-9, radius, 1), 1.0)
    return np.where(good[:, None], seen * scale[:, None], np.nan)


def _turn_equidistant(k: Coefficients) -> float:
    widest = _widest(k)
    return float(np.tan(widest)) if widest < np.pi / 2 else np.inf


def _radius(
    angle: NDArray[np.float64], k: Coefficients
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the radius at which angles from the axis are imaged, and its derivative.

    Args:
        angle: Angles, rad, of any shape.
        k: Coefficients k1 to k4 of the equidistant model.

    Returns:
        Radius, in focal lengths, and its derivative by the angle, of that shape.
    """
    k1, k2, k3, k4 = k
    a2 = angle * angle
    radius = angle * (1 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4))))
    return radius, 1 + a2 * (3 * k1 + a2 * (5 * k2 + a2 * (7 * k3 + a2 * 9 * k4)))


def _widest(k: Coefficients) -> float:
    """Return the angle from which on the radius no longer rises."""
    k1, k2, k3, k4 = k
    return float(np.sqrt(_least_root(np.roots([9 * k4, 7 * k3, 5 * k2, 3 * k1, 1.0]))))


def _least_root(roots: NDArray) -> float:
    """Return the least positive real root; infinite if there is none."""
    real = roots.real[(abs(roots.imag) < 1e-9) & (roots.real > 0)]
    return float(real.min(initial=np.inf))


LENS_MODELS = {
    "radtan": Lens(
        ("k1", "k2", "p1", "p2", "k3"),
        ("plumb_bob", "brown-conrady", "radial-tangential", "opencv", ""),
        _distort_rational,
        _undistort_rational,
        _turn_rational,
    ),
    "rational": Lens(
        ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
        ("rational_polynomial",),
        _distort_rational,
        _undistort_rational,
        _turn_rational,
    ),
    "equidistant": Lens(
        ("k1", "k2", "k3", "k4"),
        ("fisheye", "equi", "kannala_brandt", "kannala-brandt", "kannala_brandt4", "kb4"),
        _distort_equidistant,
        _undistort_equidistant,
        _turn_equidistant,
    ),
}
