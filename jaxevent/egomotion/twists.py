"""The camera's twist, measured by poses or a gyro.

    twists = from_poses(recording.poses, span=0.02)
    T, Omega = twists(times)

Twists are the camera's, as in `jaxevent.egomotion.geometry`: T in m/s and Omega in rad/s in its own
axes. All on the host.
"""

import dataclasses

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from jaxevent.errors import InputError
from jaxevent.recording import Imu, Poses, Times, microseconds

# Rotations from the axes of an IMU to the camera's, x to the right, y down, z forward, by name.
AXES = {
    "camera": np.eye(3),
    "y-up": np.diag([1.0, -1.0, -1.0]),  # x right, y up, z backward, as jAER has them
    "x-left": np.diag([-1.0, 1.0, -1.0]),  # x left, y down, z backward
    "turned": np.diag([-1.0, -1.0, 1.0]),  # x left, y up, z forward
}
LARGEST_BIAS = 0.2  # rad/s, of a gyro's rate that may be taken for its bias


@dataclasses.dataclass(frozen=True)
class Twists:
    """Camera twists at times t (us): Omega (n, 3) in rad/s, T (n, 3) in m/s, None if not measured.

    They are known from `start` to `stop` (us).
    """

    t: NDArray[np.int64]
    Omega: NDArray[np.float64]
    T: NDArray[np.float64] | None
    start: int
    stop: int

    def __call__(self, times: Times) -> tuple[NDArray[np.float64] | None, NDArray[np.float64]]:
        """T and Omega, (times, 3) each, at integers (us) or floats (s); T None if not measured.

        Linear between the twists, and the first or the last one up to `start` and `stop`. Raises
        `InputError` for other times.
        """
        us = np.atleast_1d(microseconds(times))
        given = np.atleast_1d(np.asarray(times))
        if len(us) and (us.min() < self.start or us.max() > self.stop):
            raise InputError(
                f"the true motion is known from {self.start} to {self.stop} us, not at {us.min()} "
                f"to {us.max()} us; integers are microseconds, floats seconds"
            )
        at = given * 1e6 if given.dtype.kind == "f" else us.astype(np.float64)

        def between(values: NDArray[np.float64]) -> NDArray[np.float64]:
            return np.stack([np.interp(at, self.t, column) for column in values.T], 1)

        return None if self.T is None else between(self.T), between(self.Omega)


def from_poses(poses: Poses, span: float | int = 0.0) -> Twists:
    """Twists log(P1^-1 P2) / (t2 - t1) of camera-to-world poses, at the middle of t1 and t2.

    P2 is the first pose at least `span` s after P1: noise of the poses falls with the span, and so
    does the bandwidth. Exact for a constant twist; otherwise the error grows with the square of
    t2 - t1. (Thesis 6.18 to 6.20 take log(P2^-1 P1), the scene's motion, and the displacement for
    the logarithm's translation.) Raises `InputError` for fewer than two poses of different times,
    poses that are not finite and quaternions of length 0.
    """
    t = np.asarray(poses.t, np.int64)
    if not span >= 0:
        raise InputError(f"the span {span} of two poses is not possible; give seconds from 0")
    if not (np.isfinite(poses.position).all() and np.isfinite(poses.quaternion).all()):
        raise InputError("poses hold values that are not finite; remove these poses")
    if (np.abs(poses.quaternion).sum(-1) == 0).any():
        raise InputError("poses hold a quaternion of length 0; remove these poses")
    # Of poses at one time the last counts.
    later = np.searchsorted(t, t + max(int(microseconds(float(span))), 1))
    first = np.flatnonzero((later < len(t)) & np.append(np.diff(t) > 0, True))
    if not len(first):
        raise InputError(
            f"{len(t)} poses are none {span} s apart and tell no velocity; give a longer part of "
            "the recording or a shorter span"
        )
    later = later[first]
    dt = (t[later] - t[first]) * 1e-6
    rotation = Rotation.from_quat(poses.quaternion)
    P = RigidTransform.from_components(poses.position, rotation)
    twist = (P[first].inv() * P[later]).as_exp_coords() / dt[:, None]
    middle = (t[first] + t[later]) // 2
    return Twists(middle, twist[:, :3], twist[:, 3:], int(t[0]), int(t[-1]))


def from_gyro(
    imu: Imu,
    bias: ArrayLike = (0.0, 0.0, 0.0),
    rotation: ArrayLike | None = None,
) -> Twists:
    """Omega = rotation (gyro - bias), without T; repeated times are averaged.

    `bias` is in rad/s in the gyro's axes (see `gyro_bias`), `rotation` (3, 3) takes them to the
    camera's, default the identity. Raises `InputError` for no sample, values that are not finite,
    and a matrix that is no rotation.
    """
    bias = np.asarray(bias, np.float64)
    R = np.eye(3) if rotation is None else np.asarray(rotation, np.float64)
    if bias.shape != (3,) or not np.isfinite(bias).all():
        raise InputError(
            f"the gyro's bias {bias.tolist()} is not possible; give three rates, rad/s"
        )
    if R.shape != (3, 3) or not np.allclose(R @ R.T, np.eye(3), atol=1e-3) or np.linalg.det(R) < 0:
        raise InputError("the rotation from the gyro to the camera is none; give a (3, 3) rotation")
    if not len(imu) or not np.isfinite(imu.gyro).all():
        raise InputError(
            f"an IMU of {len(imu)} samples, not all of them finite, tells no rotation; give a "
            "recording with a working gyro"
        )
    t, which, count = np.unique(imu.t, return_inverse=True, return_counts=True)
    gyro = np.stack([np.bincount(which, column) / count for column in imu.gyro.T], 1)
    return Twists(t, (gyro - bias) @ R.T, None, int(t[0]), int(t[-1]))


def gyro_bias(imu: Imu, start: Times, stop: Times) -> NDArray[np.float64]:
    """The mean rate (3,) in rad/s over times in which the camera is still, start <= t < stop.

    Raises `InputError` where there is no sample.
    """
    rows = slice(*np.searchsorted(imu.t, [int(microseconds(start)), int(microseconds(stop))]))
    if rows.start >= rows.stop:
        raise InputError(
            f"no gyro sample lies between {start} and {stop}; integers are microseconds, floats "
            "seconds on the recording's clock"
        )
    return imu.gyro[rows].mean(0)


def imu_rotation(text: str) -> NDArray[np.float64]:
    """The rotation (3, 3) from the axes of an IMU to the camera's.

    A name of `AXES`, or nine numbers with commas between, row by row. Raises `InputError` for
    others.
    """
    if text in AXES:
        return AXES[text]
    try:
        R = np.array([float(part) for part in text.split(",")]).reshape(3, 3)
    except ValueError:
        raise InputError(
            f"--imu-rotation {text!r} is not known; give {', '.join(AXES)}, or the nine numbers of "
            "a rotation matrix, row by row"
        ) from None
    if not np.allclose(R @ R.T, np.eye(3), atol=1e-3) or np.linalg.det(R) < 0:
        raise InputError(f"--imu-rotation {text} is no rotation; give an orthogonal matrix")
    return R


def constant_between(
    estimate: NDArray[np.floating], measured: NDArray[np.floating]
) -> NDArray[np.float64]:
    """The constant (3,) in rad/s by which rates (n, 3) were measured too high: a gyro's bias.

    The median of the differences, of which what is beyond `LARGEST_BIAS` is no bias.
    """
    middle = np.median(measured - estimate, 0)
    return np.clip(middle, -LARGEST_BIAS, LARGEST_BIAS)


def nearest_axes(estimate: NDArray[np.floating], measured: NDArray[np.floating]) -> str | None:
    """The axes, as `imu_rotation` reads them, in which measured rates (n, 3) are like the estimate.

    All 24 ways in which axes can lie along the camera's are tried; a constant between the rates
    does not count. One of `AXES` is preferred: others have to fit twice as well. None where the
    axes as they are fit about as well.
    """

    def off(R: NDArray[np.floating]) -> float:
        turned = measured @ R.T
        left = turned - estimate - constant_between(estimate, turned)
        # The rates themselves tell axes apart that their changes do not, as of a roll.
        return float(np.sqrt((left**2).mean() + ((turned - estimate) ** 2).mean() / 10))

    named = {name: off(R) for name, R in AXES.items()}
    best = min(named, key=lambda name: named[name])
    found, least = best, named[best]
    for R in np.rint(Rotation.create_group("O").as_matrix()):
        if off(R) < min(named[best] / 2, least):
            found, least = ",".join(f"{v:.0f}" for v in R.ravel()), off(R)
    return found if least < named["camera"] / 2 else None
