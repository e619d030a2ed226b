"""What is true of a recording's motion, as one of the models has it.

    truth = known(recording, "rotation")
    Omega = truth(times)

It comes from poses or a gyro (`twists`), or from a table. All on the host.
"""

import dataclasses
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from jaxevent.egomotion.models import Model, find_model, in_words
from jaxevent.egomotion.scores import unit_vectors
from jaxevent.egomotion.twists import from_gyro, from_poses
from jaxevent.errors import InputError
from jaxevent.recording import Recording, Times, microseconds


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
                between[:, part.rows] = unit_vectors(between[:, part.rows])
        return between

    def within(self, times: NDArray[np.int64]) -> NDArray[np.bool_]:
        """At which times (us) it is known."""
        return (times >= self.t[0]) & (times <= self.t[-1])


def known(
    recording: Recording,
    model: str | type[Model],
    source: "str | Path | pd.DataFrame" = "auto",
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
        source: "poses", "gyro", "auto" (poses, else the gyro), a table, or the path of one.
        bias: Taken off the gyro, rad/s.
        span: Time (s) over which velocities are taken from poses.
        rotation: From the gyro's axes to the camera's; see `from_gyro`.
        depth: Of the scene (m): with it poses tell an image velocity too.

    Raises:
        InputError: The model is unknown, the recording holds no such truth, or the table cannot be
            read.
    """
    model = find_model(model)
    if isinstance(source, pd.DataFrame):
        return motion_of(source, model, f"{recording.name}: the true motion")
    if source not in ("auto", "poses", "gyro"):
        return read_motion(source, model)
    parts = in_words([part.name for part in model.parts])
    if depth is not None and not model.fits_depth:
        raise InputError(f"a depth does not help to know {parts}; leave it out")
    if depth is not None:
        if recording.poses is None or recording.camera is None:
            lacking = "poses" if recording.poses is None else "calibration"
            raise InputError(
                f"{recording.name}: holds no {lacking}, which a depth belongs to"
                f"{recording.describe_left_out('poses' if lacking == 'poses' else 'camera')}; "
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
    return motion_of(table, model, str(path), "line", 2)


def motion_of(
    table: pd.DataFrame, model: type[Model], path: str, row: str = "row", first: int = 0
) -> Known:
    """The true motion from a table, as `read_motion`.

    Args:
        table: t (s), the components, and further columns.
        model: The motion model.
        path: How messages call the table.
        row: How they call a row.
        first: The number of the first row in them.

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
    if "lost" in table.columns:  # as `jaxevent motion` writes them: rows without a motion
        numbers = numbers[~(np.asarray(table["lost"], float) > 0)]
    finite = np.isfinite(numbers).all(1)
    if not len(numbers) or not finite.all():
        line = int(np.argmin(finite)) + first if len(numbers) else first
        raise InputError(
            f"{path}: {row} {line} holds no numbers; give them, or leave the {row} out"
        )
    t = np.rint(numbers[:, 0] * 1e6).astype(np.int64)
    if (np.diff(t) <= 0).any():
        line = int(np.argmax(np.diff(t) <= 0)) + 1 + first
        raise InputError(f"{path}: the time in {row} {line} does not rise; sort the table by t")
    return Known(model, t, numbers[:, 1:])
