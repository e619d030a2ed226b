"""What the camera's motion was, from poses or a gyro, and how far an estimate is from it.

    truth = from_poses(recording.poses, span=0.02)
    T, Omega = truth(times)
    scores = motion_errors(Omega=(estimate, Omega), T=(heading, T))

Twists are the camera's, as in `jaxevent.egomotion.geometry`: T in m/s and Omega in rad/s in its own
axes. Errors follow the egomotion thesis, 5.20 to 5.21 and 6.22 to 6.29. All on the host.
"""

import dataclasses
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from jaxevent.egomotion.models import Model, find_model, in_words
from jaxevent.errors import InputError
from jaxevent.recording import Imu, Poses, Recording, Times, microseconds

# Rotations from the axes of an IMU to the camera's, x to the right, y down, z forward, by name.
AXES = {
    "camera": np.eye(3),
    "y-up": np.diag([1.0, -1.0, -1.0]),  # x right, y up, z backward, as jAER has them
    "x-left": np.diag([-1.0, 1.0, -1.0]),  # x left, y down, z backward
    "turned": np.diag([-1.0, -1.0, 1.0]),  # x left, y up, z forward
}
LARGEST_BIAS = 0.2  # rad/s, of a gyro's rate that may be taken for its bias
_OUTLIER = 0.05  # relative magnitude error from which the thesis counts an outlier


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


@dataclasses.dataclass(frozen=True)
class Known:
    """A motion that is known at times t (us), n of them: values (n, components) of `model`."""

    model: type[Model]
    t: NDArray[np.int64]
    values: NDArray[np.float64]

    def __call__(self, times: Times) -> NDArray[np.float64]:
        """The motion (times, components) at integers (us) or floats (s), linear in between.

        Raises `InputError` for times before the first and after the last that is known.
        """
        us = np.atleast_1d(microseconds(times))
        if len(us) and (us.min() < self.t[0] or us.max() > self.t[-1]):
            raise InputError(
                f"the true motion is known from {self.t[0]} to {self.t[-1]} us, not at {us.min()} "
                f"to {us.max()} us; integers are microseconds, floats seconds"
            )
        between = np.stack([np.interp(us, self.t, column) for column in self.values.T], 1)
        for part in self.model.parts:
            if part.direction:
                between[:, part.rows] = _unit(between[:, part.rows])
        return between

    def within(self, times: NDArray[np.int64]) -> NDArray[np.bool_]:
        """At which times (us) it is known."""
        return (times >= self.t[0]) & (times <= self.t[-1])


def known(
    recording: Recording,
    model: str | type[Model],
    source: str | Path = "auto",
    bias: ArrayLike = (0.0, 0.0, 0.0),
    span: float | int = 0.02,
    *,
    rotation: ArrayLike | None = None,
    depth: float | int | None = None,
) -> Known:
    """What is true of a recording's motion.

    Args:
        recording: With poses or an IMU, unless `source` is a table.
        model: See `models`; `Model.known_from` says what tells its motion.
        source: "poses", "gyro", "auto" (poses, else the gyro), or the path of a table.
        bias: Taken off the gyro, rad/s.
        span: Time (s) over which velocities are taken from poses.
        rotation: From the gyro's axes to the camera's; see `from_gyro`.
        depth: Of the scene (m): with it poses tell an image velocity too.

    Raises:
        InputError: The model is unknown, the recording holds no such truth, or the table cannot be
            read.
    """
    model = find_model(model)
    if source not in ("auto", "poses", "gyro"):
        return read_motion(source, model)
    parts = in_words([part.name for part in model.parts])
    if depth is not None and not model.fits_depth:
        raise InputError(f"a depth does not help to know {parts}; leave it out")
    if depth is not None:
        if recording.poses is None or recording.camera is None:
            lacking = "poses" if recording.poses is None else "calibration"
            raise InputError(
                f"{recording.name}: holds no {lacking}, which a depth belongs to; "
                "leave it out and give a table of the true motion"
            )
        twists, f = from_poses(recording.poses, span), recording.camera.fx * recording.camera.fy
        return Known(model, twists.t, model.at_depth(twists, float(np.sqrt(f)), float(depth)))
    if not model.known_from:
        raise InputError(
            f"{recording.name}: {parts} is known neither from poses nor from a gyro"
            f"{' unless a depth is given' if model.fits_depth else ''}; give a table "
            f"with the columns {', '.join(('t', *model.components))}"
            f"{', or the depth' if model.fits_depth else ''}"
        )
    poses, imu = recording.poses, recording.imu
    by_gyro = imu is not None and len(imu) > 0 and "gyro" in model.known_from
    by_poses = poses is not None and len(poses) > 0 and "poses" in model.known_from
    if source != "gyro" and by_poses and poses is not None:
        twists = from_poses(poses, span)
    elif source != "poses" and by_gyro and imu is not None:
        twists = from_gyro(imu, bias, rotation)
    else:
        what = {"auto": "neither poses nor an IMU", "poses": "no poses", "gyro": "no IMU"}[
            str(source)
        ]
        if source != "poses" and imu is not None and "gyro" not in model.known_from:
            what = f"no poses, and its gyro does not tell {parts}"
        raise InputError(f"{recording.name}: holds {what}; give a table of the true motion")
    return Known(model, twists.t, model.of_twist(twists.T, twists.Omega))


def read_motion(path: str | Path, model: str | type[Model]) -> Known:
    """The true motion from a table: columns t (s) and the components; further ones are left out.

    Raises `InputError` for a file that cannot be read, missing columns or numbers, times that do
    not rise.
    """
    model = find_model(model)
    path = Path(path)
    try:
        table = pd.read_csv(path)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the path") from None
    except ValueError as error:
        raise InputError(f"{path}: is no table ({error}); give columns t and components") from None
    names = ("t", *model.components)
    for name in names:
        if name not in table.columns:
            raise InputError(f"{path}: has no column {name!r}; give the columns {', '.join(names)}")
    numbers = np.stack(
        [np.asarray(pd.to_numeric(table[name], errors="coerce"), np.float64) for name in names], 1
    )
    if "lost" in table.columns:  # as `jaxevent motion` writes them: rows without a motion
        numbers = numbers[~(np.asarray(table["lost"], float) > 0)]
    finite = np.isfinite(numbers).all(1)
    if not len(numbers) or not finite.all():
        line = int(np.argmin(finite)) + 2 if len(numbers) else 2
        raise InputError(f"{path}: line {line} holds no numbers; give them, or leave the line out")
    t = np.rint(numbers[:, 0] * 1e6).astype(np.int64)
    if (np.diff(t) <= 0).any():
        line = int(np.argmax(np.diff(t) <= 0)) + 3
        raise InputError(f"{path}: the time in line {line} does not rise; sort the table by t")
    return Known(model, t, numbers[:, 1:])


def endpoint_error(estimate: ArrayLike, truth: ArrayLike) -> NDArray[np.float64]:
    """|U - U_g| (n,) of vectors (n, components), in their unit; the mean is AEE (5.20)."""
    estimate, truth = _pair(estimate, truth)
    return np.linalg.norm(estimate - truth, axis=-1)


def relative_error(estimate: ArrayLike, truth: ArrayLike) -> NDArray[np.float64]:
    """|V - V_g| / |V_g| (n,); of flow the mean is AEE_rel (5.21), of Omega the vector error.

    Infinite where only the truth is the zero vector, 0 where both are.
    """
    return _ratio(endpoint_error(estimate, truth), np.linalg.norm(_pair(truth, truth)[1], axis=-1))


def axis_error(estimate: ArrayLike, truth: ArrayLike) -> NDArray[np.float64]:
    """Angles (n,) in degrees between vectors (n, 2 or 3) of any length; the mean is AAE (6.22-25).

    arccos of the normalised product, computed by arctan2, which stays exact near 0 and 180 degrees.
    90 degrees where one of them is the zero vector, the mean over all directions, and 0 where both
    are.
    """
    estimate, truth = (_unit(v) for v in _pair(estimate, truth))
    # tan(angle / 2) = |a - b| / |a + b| of unit vectors.
    apart = np.linalg.norm(estimate - truth, axis=-1)
    together = np.linalg.norm(estimate + truth, axis=-1)
    return np.degrees(2 * np.arctan2(apart, together))


def magnitude_error(estimate: ArrayLike, truth: ArrayLike) -> NDArray[np.float64]:
    """| |V| - |V_g| | (n,), in their unit; of Omega the mean is AME (6.26-27)."""
    estimate, truth = _pair(estimate, truth)
    return np.abs(np.linalg.norm(estimate, axis=-1) - np.linalg.norm(truth, axis=-1))


def relative_magnitude_error(estimate: ArrayLike, truth: ArrayLike) -> NDArray[np.float64]:
    """| |V| - |V_g| | / |V_g| (n,); of Omega the mean is AME_rel (6.28).

    Infinite where only the truth is the zero vector, 0 where both are.
    """
    return _ratio(magnitude_error(estimate, truth), np.linalg.norm(_pair(truth, truth)[1], axis=-1))


def normalised_magnitude_error(estimate: ArrayLike, truth: ArrayLike) -> NDArray[np.float64]:
    """| |V| - |V_g| | / max |V_g| (n,), over the whole truth; of Omega the mean is AME_N (6.29).

    Infinite where the whole truth is 0 and the estimate is not, 0 where both are.
    """
    error = magnitude_error(estimate, truth)
    largest = np.linalg.norm(_pair(truth, truth)[1], axis=-1).max(initial=0)
    return _ratio(error, np.full(len(error), largest))


def outlier_percentage(
    estimate: ArrayLike, truth: ArrayLike, limit: float | int = _OUTLIER
) -> float:
    """Percentage of vectors whose relative magnitude error is at least `limit` (thesis 6.5.3)."""
    return _percent(relative_magnitude_error(estimate, truth) >= limit)


def motion_errors(
    *,
    U: tuple[ArrayLike, ArrayLike] | None = None,
    T: tuple[ArrayLike, ArrayLike] | None = None,
    Omega: tuple[ArrayLike, ArrayLike] | None = None,
    V: tuple[ArrayLike, ArrayLike] | None = None,
) -> dict[str, float]:
    """The thesis' figures for pairs of (estimate, truth), each (n, components), n > 0.

    - U, image velocity in px/s: AEE (px/s), AEE_rel (%), AAE_U (degrees);
    - T, translation in any unit and of any length: AAE_T (degrees);
    - Omega, in rad/s: AAE_Omega (degrees), AME (degrees/s), AME_rel (%), AME_N (%), vector_error
      (%), outliers (%);
    - V, any other vector: AME_rel (%), vector_error (%), outliers (%).

    All are means over the n times except outliers. Scaling the estimate or the truth of T by a
    positive number changes nothing. Raises `InputError` for pairs of other shapes, none at all,
    and values that are not finite.
    """
    scores: dict[str, float] = {}
    if U is not None:
        scores["AEE"] = float(endpoint_error(*U).mean())
        scores["AEE_rel"] = _percent(relative_error(*U))
        scores["AAE_U"] = float(axis_error(*U).mean())
    if T is not None:
        scores["AAE_T"] = float(axis_error(*T).mean())
    if Omega is not None:
        scores["AAE_Omega"] = float(axis_error(*Omega).mean())
        scores["AME"] = float(np.degrees(magnitude_error(*Omega)).mean())
        scores["AME_rel"] = _percent(relative_magnitude_error(*Omega))
        scores["AME_N"] = _percent(normalised_magnitude_error(*Omega))
        scores["vector_error"] = _percent(relative_error(*Omega))
        scores["outliers"] = outlier_percentage(*Omega)
    if V is not None:
        scores["AME_rel"] = _percent(relative_magnitude_error(*V))
        scores["vector_error"] = _percent(relative_error(*V))
        scores["outliers"] = outlier_percentage(*V)
    return scores


def _pair(estimate: ArrayLike, truth: ArrayLike) -> tuple[NDArray[np.float64], ...]:
    pair = np.asarray(estimate, np.float64), np.asarray(truth, np.float64)
    if pair[0].shape != pair[1].shape or pair[0].ndim != 2 or not len(pair[0]):
        raise InputError(
            f"motions of shapes {pair[0].shape} and {pair[1].shape} cannot be compared; give both "
            "as (times, components), at the same times, one or more"
        )
    for name, values in zip(("estimated", "true"), pair, strict=True):
        if not np.isfinite(values).all():
            row = int(np.argmin(np.isfinite(values).all(-1)))
            raise InputError(f"the {name} motion is not finite in row {row}; leave that time out")
    return pair


def _unit(v: NDArray[np.float64]) -> NDArray[np.float64]:
    # The largest component first: the square of a tiny one would be lost.
    largest = np.abs(v).max(-1, keepdims=True)
    v = v / np.where(largest > 0, largest, 1)
    size = np.linalg.norm(v, axis=-1, keepdims=True)
    return v / np.where(size > 0, size, 1)


def _ratio(error: NDArray[np.float64], size: NDArray[np.float64]) -> NDArray[np.float64]:
    infinite = np.where(error > 0, np.inf, 0.0)
    return np.where(size > 0, error / np.where(size > 0, size, 1), infinite)


def _percent(values: NDArray) -> float:
    return 100 * float(np.mean(values))
