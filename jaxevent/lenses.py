"""Lens models: places in a camera's image of normalised coordinates X / Z, Y / Z, and back.

    radtan       k1 k2 p1 p2 k3              Brown-Conrady; ROS: plumb_bob, OpenCV's five numbers
    rational     k1 k2 p1 p2 k3 k4 k5 k6     the same, the radial part over 1 + k4 r^2 + k5 r^4
                                             + k6 r^6; ROS: rational_polynomial
    equidistant  k1 k2 k3 k4                 Kannala and Brandt, PAMI 2006, as OpenCV's fisheye:
                                             an angle a from the axis is seen at the radius
                                             a (1 + k1 a^2 + k2 a^4 + k3 a^6 + k4 a^8)

All places are (n, 2), before focal lengths and centre are applied.
"""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

Places = NDArray[np.float64]
Coefficients = Sequence[float]
_MAX_TAN_ANGLE = 20.0  # tan of the widest angle from the axis that is supported, 87 degrees
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
    """Apply Brown-Conrady distortion, its radial part N / D; return also its Jacobian."""
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
    """Invert the distortion by Newton's method, where the Jacobian is positive definite."""
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
    """Invert the distortion by Newton's method, up to the angle at which the radius turns."""
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
    """Return the radius at which angles from the axis are imaged, and its derivative."""
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
