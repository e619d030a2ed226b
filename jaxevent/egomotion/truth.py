"""Known motion of a camera: from poses, a gyro, or a table. All on the host.

    truth = known_motion(recording, "rotation")
    Omega = truth(times)

    twists = twists_from_poses(recording.poses, span=0.02)
    T, Omega = twists(times)

Twists are the camera's, as in `jaxevent.egomotion.geometry`: T in m/s and Omega in rad/s, in its
own axes.
"""

import dataclasses
import warnings
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from jaxevent.deprecated import renamed_fields, renamed_methods, renamed_names
from jaxevent.egomotion.models import Model, find_model, in_words, unit_vectors
from jaxevent.errors import InputError, InputWarning
from jaxevent.io.tables import read_table
from jaxevent.recording import Imu, Poses, Recording, Times, check_recording, microseconds, one_time

# Rotations from the axes of an IMU to the camera's, x to the right, y down, z forward, by name.
IMU_AXES = {
    "camera": np.eye(3),
    "y-up": np.diag([1.0, -1.0, -1.0]),  # x right, y up, z backward, as jAER has them
    "x-left": np.diag([-1.0, 1.0, -1.0]),  # x left, y down, z backward
    "turned": np.diag([-1.0, -1.0, 1.0]),  # x left, y up, z forward
}
MAX_GYRO_BIAS_RAD_S = 0.2  # rad/s


def _check_known(us: NDArray[np.int64], start: int | np.integer, stop: int | np.integer) -> None:
    """Check that a motion is known at some times.

    Args:
        us: (times,) us.
        start: First time at which it is known, us.
        stop: Last time, us.

    Raises:
        InputError: A time is outside.
    """
    if len(us) and (us.min() < start or us.max() > stop):
        raise InputError(
            f"the true motion is known from {start} to {stop} us, not at {us.min()} to "
            f"{us.max()} us; integers are microseconds, floats seconds"
        )


def _interpolate_columns(at: NDArray, t: NDArray[np.int64], values: NDArray) -> NDArray[np.float64]:
    """Interpolate columns linearly in time.

    Args:
        at: (times,) times to interpolate to, us.
        t: (n,) rising times, us.
        values: (n, components).

    Returns:
        (times, components).
    """
    return np.stack([np.interp(at, t, column) for column in values.T], 1)


@dataclasses.dataclass(frozen=True)
class Twists:
    """Camera twists at some times, a function of time: `T, Omega = twists(times)`.

    Attributes:
        t: (n,) times, us.
        Omega: (n, 3) angular velocity, rad/s.
        T: (n, 3) velocity, m/s, or None if it was not measured.
        start: First time at which the twists are known, us.
        stop: Last time at which they are known, us.
    """

    t: NDArray[np.int64]
    Omega: NDArray[np.float64]
    T: NDArray[np.float64] | None
    start: int
    stop: int

    def __call__(self, times: Times) -> tuple[NDArray[np.float64] | None, NDArray[np.float64]]:
        """Interpolate linearly; the first and the last twist hold up to `start` and `stop`.

        Args:
            times: Integers (us) or floats (s).

        Returns:
            T (times, 3), or None if it was not measured, and Omega (times, 3).

        Raises:
            InputError: A time is before `start` or after `stop`.
        """
        us = np.atleast_1d(microseconds(times))
        given = np.atleast_1d(np.asarray(times))
        _check_known(us, self.start, self.stop)
        at = given * 1e6 if given.dtype.kind == "f" else us.astype(np.float64)
        T = None if self.T is None else _interpolate_columns(at, self.t, self.T)
        return T, _interpolate_columns(at, self.t, self.Omega)


def twists_from_poses(poses: Poses, span: float | int = 0.0) -> Twists:
    """Measure twists log(P1^-1 P2) / (t2 - t1) from camera-to-world poses.

    The twist holds at the middle of t1 and t2. Noise of the poses falls with the span, and so does
    the bandwidth. A constant twist is exact, and otherwise the error grows with the square of
    t2 - t1. (Thesis 6.18 to 6.20 take log(P2^-1 P1), the scene's motion, and the displacement for
    the logarithm's translation.)

    Args:
        poses: The poses; of several at one time the last counts.
        span: P2 is the first pose at least this time after P1, s.

    Returns:
        The twists.

    Raises:
        InputError: No two poses are so far apart in time, or a pose is not finite or has a
            quaternion of length 0.
    """
    t = np.asarray(poses.t, np.int64)
    if not span >= 0:
        raise InputError(f"the span {span} of two poses is not possible; give seconds from 0")
    if not (np.isfinite(poses.position).all() and np.isfinite(poses.quaternion).all()):
        raise InputError("poses hold values that are not finite; remove these poses")
    if (np.abs(poses.quaternion).sum(-1) == 0).any():
        raise InputError("poses hold a quaternion of length 0; remove these poses")
    later = np.searchsorted(t, t + max(one_time(float(span), "the span"), 1))
    first = np.flatnonzero((later < len(t)) & np.append(np.diff(t) > 0, True))
    if not len(first):
        raise InputError(
            f"{len(t)} poses are none {span} s apart and determine no velocity; give a longer part "
            "of the recording or a shorter span"
        )
    later = later[first]
    dt = (t[later] - t[first]) * 1e-6
    rotation = Rotation.from_quat(poses.quaternion)
    P = RigidTransform.from_components(poses.position, rotation)
    twist = (P[first].inv() * P[later]).as_exp_coords() / dt[:, None]
    middle = (t[first] + t[later]) // 2
    return Twists(middle, twist[:, :3], twist[:, 3:], int(t[0]), int(t[-1]))


def _is_rotation(R: NDArray[np.float64]) -> bool:
    """Return whether an array is a (3, 3) rotation matrix, to 1e-3."""
    is_orthogonal = R.shape == (3, 3) and np.allclose(R @ R.T, np.eye(3), atol=1e-3)
    return is_orthogonal and float(np.linalg.det(R)) > 0


def twists_from_gyro(
    imu: Imu,
    bias: ArrayLike | tuple[float, ...] = (0.0, 0.0, 0.0),
    rotation: ArrayLike | str | None = None,
) -> Twists:
    """Convert a gyro's rates to twists without T: Omega = rotation (gyro - bias).

    Args:
        imu: The samples; those at one time are averaged.
        bias: (3,) bias in the gyro's axes, rad/s; see `gyro_bias`.
        rotation: (3, 3) from the gyro's axes to the camera's, or a name of `IMU_AXES`; by default
            the identity.

    Returns:
        The twists. An `InputWarning` tells of a bias that is more than 0.2 rad/s from 0 and from
        all of the rates, as one in deg/s.

    Raises:
        InputError: There is no sample, one is not finite, or the matrix is no rotation.
    """
    bias = np.asarray(bias, np.float64)
    if isinstance(rotation, str):
        rotation = parse_imu_rotation(rotation)
    R = np.eye(3) if rotation is None else np.asarray(rotation, np.float64)
    if bias.shape != (3,) or not np.isfinite(bias).all():
        raise InputError(
            f"the gyro's bias {bias.tolist()} is not possible; give three rates, rad/s"
        )
    if not _is_rotation(R):
        raise InputError(
            "the rotation from the gyro to the camera is no rotation; give an orthogonal matrix "
            f"(3, 3), or a name, {', '.join(IMU_AXES)}"
        )
    if not len(imu) or not np.isfinite(imu.gyro).all():
        raise InputError(
            f"an IMU of {len(imu)} samples, not all of them finite, determines no rotation; give a "
            "recording with a working gyro"
        )
    t, which, count = np.unique(imu.t, return_inverse=True, return_counts=True)
    gyro = np.stack([np.bincount(which, column) / count for column in imu.gyro.T], 1)
    beyond = np.abs(bias - np.clip(bias, gyro.min(0), gyro.max(0)))
    if (np.minimum(np.abs(bias), beyond) > MAX_GYRO_BIAS_RAD_S).any():
        warnings.warn(
            f"the gyro's bias {bias.tolist()} rad/s is beyond every rate that it measured, from "
            f"{gyro.min(0).round(3).tolist()} to {gyro.max(0).round(3).tolist()} rad/s; give it in "
            "rad/s: numpy.radians converts deg/s",
            InputWarning,
            stacklevel=2,
        )
    return Twists(t, (gyro - bias) @ R.T, None, int(t[0]), int(t[-1]))


def gyro_bias(imu: Imu, start: Times, stop: Times) -> NDArray[np.float64]:
    """Average the rates of a gyro while the camera is static.

    Args:
        imu: The samples.
        start: First time, an integer (us) or a float (s).
        stop: End of the time, which is not included.

    Returns:
        (3,) bias in the gyro's axes, rad/s.

    Raises:
        InputError: There is no sample in that time.
    """
    rows = slice(
        *np.searchsorted(imu.t, [one_time(start, "the start"), one_time(stop, "the stop")])
    )
    if rows.start >= rows.stop:
        raise InputError(
            f"no gyro sample lies between {start} and {stop}; integers are microseconds, floats "
            "seconds on the recording's clock"
        )
    return imu.gyro[rows].mean(0)


def parse_imu_rotation(text: str) -> NDArray[np.float64]:
    """Parse the rotation (3, 3) from the axes of an IMU to the camera's.

    Args:
        text: A name of `IMU_AXES`, or nine numbers with commas between, row by row.

    Raises:
        InputError: The text is neither.
    """
    if text in IMU_AXES:
        return IMU_AXES[text]
    try:
        R = np.array([float(part) for part in text.split(",")]).reshape(3, 3)
    except ValueError:
        raise InputError(
            f"the axes {text!r} of the gyro (rotation, --imu-rotation) are not known; give "
            f"{', '.join(IMU_AXES)}, or the nine numbers of a rotation matrix, row by row"
        ) from None
    if not _is_rotation(R):
        raise InputError(
            f"{text} (rotation, --imu-rotation) is no rotation; give an orthogonal matrix"
        )
    return R


def fit_gyro_bias(
    estimate: NDArray[np.floating], measured: NDArray[np.floating]
) -> NDArray[np.float64]:
    """Fit the bias of a gyro to an estimated angular velocity, by the median difference.

    Args:
        estimate: (n, 3) estimated angular velocity, rad/s.
        measured: (n, 3) measured angular velocity, rad/s.

    Returns:
        (3,) bias, clipped to +- `MAX_GYRO_BIAS_RAD_S`, rad/s.
    """
    middle = np.median(measured - estimate, 0)
    return np.clip(middle, -MAX_GYRO_BIAS_RAD_S, MAX_GYRO_BIAS_RAD_S)


def find_imu_axes(estimate: NDArray[np.floating], measured: NDArray[np.floating]) -> str | None:
    """Find the axes of a gyro in which its rates agree with an estimate.

    All 24 ways in which axes can lie along the camera's are compared, each with its best bias. One
    of `IMU_AXES` is preferred: others have to fit twice as well.

    Args:
        estimate: (n, 3) estimated angular velocity in the camera's axes, rad/s.
        measured: (n, 3) measured angular velocity, rad/s.

    Returns:
        The axes as text for `parse_imu_rotation`; None if the camera's own fit about as well.
    """

    def misalignment(R: NDArray[np.floating]) -> float:
        rotated = measured @ R.T
        residual = rotated - estimate - fit_gyro_bias(estimate, rotated)
        # The rates themselves distinguish axes that their changes do not, as of a roll.
        return float(np.sqrt((residual**2).mean() + ((rotated - estimate) ** 2).mean() / 10))

    named = {name: misalignment(R) for name, R in IMU_AXES.items()}
    best = min(named, key=lambda name: named[name])
    found, least = best, named[best]
    for R in np.rint(Rotation.create_group("O").as_matrix()):
        if misalignment(R) < min(named[best] / 2, least):
            found, least = ",".join(f"{v:.0f}" for v in R.ravel()), misalignment(R)
    return found if least < named["camera"] / 2 else None


@renamed_methods(within="covers")
@renamed_fields(guesses_axes="assumes_camera_axes")
@dataclasses.dataclass(frozen=True, repr=False)
class KnownMotion:
    """A motion that is known at some times, a function of time: `values = truth(times)`.

    Attributes:
        model: The motion model, of d components.
        t: (n,) times, us.
        values: (n, d) motions.
        assumes_camera_axes: Whether they are a gyro's rates, whose axes are taken for the camera's.
    """

    model: type[Model]
    t: NDArray[np.int64]
    values: NDArray[np.float64]
    assumes_camera_axes: bool = False

    def __call__(self, times: Times) -> NDArray[np.float64]:
        """Interpolate the motion (times, d) linearly, at integers (us) or floats (s).

        Raises:
            InputError: A time is before the first or after the last at which the motion is known.
        """
        us = np.atleast_1d(microseconds(times))
        _check_known(us, self.t[0], self.t[-1])
        values = _interpolate_columns(us, self.t, self.values)
        for part in self.model.parts:
            if part.direction:
                values[:, part.rows] = unit_vectors(values[:, part.rows])
        return values

    def __repr__(self) -> str:
        span = f"{self.t[0] * 1e-6:.6g} to {self.t[-1] * 1e-6:.6g} s" if len(self.t) else "never"
        return f"KnownMotion({self.model.name}, at {len(self.t)} times, {span})"

    def covers(self, times: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return at which times (us) the motion is known."""
        return (times >= self.t[0]) & (times <= self.t[-1])


def known_motion(
    recording: Recording,
    model: str | type[Model],
    source: "str | Path | pd.DataFrame" = "auto",
    bias: ArrayLike | tuple[float, ...] = (0.0, 0.0, 0.0),
    span: float | int = 0.02,
    *,
    rotation: ArrayLike | str | None = None,
    depth: float | int | None = None,
) -> KnownMotion:
    """Return the true motion of a recording.

    Args:
        recording: A recording with poses or an IMU, unless `source` is a table.
        model: Motion model, or its name; `Model.truth_sources` lists the sources that suit it.
        source: "poses", "gyro", "auto" (poses, else the gyro), a table, or the path of one.
        bias: (3,) bias of the gyro in its own axes, rad/s.
        span: Time over which velocities are measured from poses, s.
        rotation: (3, 3) from the gyro's axes to the camera's, or a name of `IMU_AXES`. None takes
            them to be the same; `score_motion` and `plot_motion` warn where others fit far better.
        depth: Depth of the scene, m. With it poses determine an image velocity too.

    Returns:
        The motion.

    Raises:
        InputError: The model is unknown, the recording holds no such truth, or the table cannot be
            read.
    """
    check_recording(recording, "known_motion")
    model = find_model(model)
    if isinstance(rotation, str):
        rotation = parse_imu_rotation(rotation)
    if isinstance(source, pd.DataFrame):
        return motion_from_table(source, model, f"{recording.name}: the true motion")
    if source not in ("auto", "poses", "gyro"):
        return read_motion(source, model)
    parts = in_words([part.name for part in model.parts])
    if depth is not None and not model.fits_depth:
        raise InputError(f"a depth does not help to know {parts}; leave it out")
    if depth is not None:
        return _planar_at_depth(recording, model, span, float(depth))
    if not model.truth_sources:
        raise InputError(
            f"{recording.name}: {parts} is known neither from poses nor from a gyro"
            f"{' unless a depth is given' if model.fits_depth else ''}; give a table "
            f"with the columns {', '.join(('t', *model.components))}"
            f"{', or the depth' if model.fits_depth else ''}"
        )
    poses, imu, guesses = recording.poses, recording.imu, False
    by_gyro = imu is not None and len(imu) > 0 and "gyro" in model.truth_sources
    by_poses = poses is not None and len(poses) > 0 and "poses" in model.truth_sources
    if source != "gyro" and by_poses and poses is not None:
        twists = twists_from_poses(poses, span)
    elif source != "poses" and by_gyro and imu is not None:
        twists, guesses = twists_from_gyro(imu, bias, rotation), rotation is None
    else:
        missing = {"auto": "neither poses nor an IMU", "poses": "no poses", "gyro": "no IMU"}
        what = missing[str(source)]
        if source != "poses" and imu is not None and "gyro" not in model.truth_sources:
            what = f"no poses, and its gyro does not determine {parts}"
        raise InputError(f"{recording.name}: holds {what}; give a table of the true motion")
    return KnownMotion(model, twists.t, model.from_twist(twists.T, twists.Omega), guesses)


def _planar_at_depth(
    recording: Recording, model: type[Model], span: float | int, depth: float
) -> KnownMotion:
    """Make the image velocity of a scene at a depth from poses.

    Args:
        recording: A recording with poses and a camera.
        model: The model of planar motion.
        span: Time between the poses that a velocity is taken from, s.
        depth: The depth, m.

    Returns:
        The motion.

    Raises:
        InputError: The recording holds no poses or no camera.
    """
    if recording.poses is None or recording.camera is None:
        missing = "poses" if recording.poses is None else "calibration"
        raise InputError(
            f"{recording.name}: holds no {missing}, which a depth belongs to"
            f"{recording.describe_left_out('poses' if missing == 'poses' else 'camera')}; "
            "leave it out and give a table of the true motion"
        )
    twists, f2 = twists_from_poses(recording.poses, span), recording.camera.fx * recording.camera.fy
    return KnownMotion(
        model, twists.t, model.from_twists_at_depth(twists, float(np.sqrt(f2)), depth)
    )


def read_motion(path: str | Path, model: str | type[Model]) -> KnownMotion:
    """Read the true motion from a CSV table.

    Args:
        path: Table with the columns t (s) and the components; further ones are left out.
        model: Motion model, or its name.

    Returns:
        The motion.

    Raises:
        InputError: The file cannot be read, columns or numbers are missing, or times do not rise.
    """
    model = find_model(model)
    table = read_table(Path(path), "give columns t and components")
    return motion_from_table(table, model, str(path), "line", 2)


def motion_from_table(
    table: pd.DataFrame, model: type[Model], path: str, row: str = "row", first: int = 0
) -> KnownMotion:
    """Convert a table of the true motion.

    Args:
        table: Columns t (s), the components, and further ones. Rows with `lost` are left out.
        model: Motion model.
        path: Name of the table in messages.
        row: Word for a row in messages.
        first: Number of the first row in messages.

    Returns:
        The motion.

    Raises:
        InputError: Columns or numbers are missing, or times do not rise.
    """
    names = ("t", *model.components)
    for name in names:
        if name not in table.columns:
            raise InputError(f"{path}: has no column {name!r}; give the columns {', '.join(names)}")
    numbers = np.stack(
        [np.asarray(pd.to_numeric(table[name], errors="coerce"), np.float64) for name in names], 1
    )
    if "lost" in table.columns:
        numbers = numbers[~(np.asarray(table["lost"], float) > 0)]
    if not len(numbers):
        raise InputError(f"{path}: holds no motion; give a {row} for each time")
    finite = np.isfinite(numbers).all(1)
    if not finite.all():
        line = int(np.argmin(finite)) + first
        raise InputError(
            f"{path}: {row} {line} holds no numbers; give them, or leave the {row} out"
        )
    t = np.rint(numbers[:, 0] * 1e6).astype(np.int64)
    if (np.diff(t) <= 0).any():
        line = int(np.argmax(np.diff(t) <= 0)) + 1 + first
        raise InputError(f"{path}: the time in {row} {line} does not rise; sort the table by t")
    return KnownMotion(model, t, numbers[:, 1:])


__getattr__ = renamed_names(__name__)
