"""Estimates that things which move before a camera at rest explain as well.

A gyro measures a rotation directly: where its rates contradict an estimate, the events are those of
moving things, or of another motion. Without a gyro, edges of frames make events where the camera
moves (`patches`). Without either, one object covers a part of the image only. It alone supports the
motion (`evidence`), whatever noise there is elsewhere.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.egomotion.candidates import pixel_coordinates
from jaxevent.egomotion.evidence import MIN_BLOCKS, N_BLOCKS, EvidenceTest
from jaxevent.egomotion.models import Model
from jaxevent.egomotion.patches import (
    FIT_WINDOW_DISPLACEMENT_PX,
    ImageSpeed,
    edge_event_fraction,
    is_camera_static,
    measure_image_speed,
    spread_times,
)
from jaxevent.egomotion.truth import MAX_GYRO_BIAS_RAD_S
from jaxevent.recording import Imu, Recording

GYRO_SPAN_US = 30_000  # over which rates are averaged
GYRO_RELATIVE_ERROR = 0.1  # of the estimate's size and the gyro's, beside noise and bias
GYRO_SIGMAS = 3.0
N_TESTED_WINDOWS = 12  # of events, for the part of the image that moves
WINDOW_DISPLACEMENT_PX = 6.5  # of the image in a window of evidence
MAX_WINDOW_S = 1.0


class MotionRows(NamedTuple):
    """Estimates of a motion of d components.

    Attributes:
        model: The model.
        t: (n,) times at which they were observed, us.
        mean: (n, d) motion.
        covariance: (n, d, d) its covariance.
        valid: (n,) whether the motion is known.
    """

    model: type[Model]
    t: NDArray[np.int64]
    mean: NDArray[np.floating]
    covariance: NDArray[np.floating]
    valid: NDArray[np.bool_]


def find_undecided(recording: Recording, motion: MotionRows) -> tuple[NDArray[np.bool_], str]:
    """Find the estimates that a camera at rest, before which things move, explains as well.

    Args:
        recording: The recording.
        motion: Its motion, of n estimates.

    Returns:
        (n,) booleans, and a warning; "" if there are none.
    """
    reported = motion.valid
    none = np.zeros(len(reported), bool)
    if not reported.any():
        return none, ""
    turns = [part.rows for part in motion.model.parts if part.figure == "Omega"]
    if recording.imu is not None and turns:
        undecided = reported & _contradicts(recording.imu, motion, turns[0])
        if not undecided.any():
            return none, ""
        if undecided.sum() > reported.sum() / 2:
            undecided = reported
        return undecided, (
            f"the gyro contradicts {100 * undecided.sum() / reported.sum():.0f} % of the "
            "estimates: things move, or the camera does otherwise; those rows are empty"
        )
    speed = measure_image_speed(recording)
    if recording.frames and edge_event_fraction(recording, speed) is not None:
        if is_camera_static(recording, speed):
            return reported, (
                "the camera seems to stand still while objects move: edges in the frames make no "
                "events; rows are empty, and jaxevent track follows objects"
            )
        return none, ""
    blocks = _supporting_blocks(recording, motion)
    if blocks is None:
        blocks = N_BLOCKS**2 if speed is None else _active_blocks(recording, speed)
    if blocks >= MIN_BLOCKS:
        return none, ""
    return reported, (
        f"the camera may stand still while objects move: only about {blocks:.1f} of "
        f"{N_BLOCKS**2} parts of the image move so; rows are empty, and jaxevent track follows "
        "objects"
    )


def _contradicts(imu: Imu, motion: MotionRows, rows: slice) -> NDArray[np.bool_]:
    """Return where an angular velocity is of another size than the gyro's rates, in any axes.

    Args:
        imu: The gyro.
        motion: The motion, of n estimates.
        rows: The components of its angular velocity.

    Returns:
        (n,) booleans.
    """
    rates = np.asarray(imu.gyro, np.float64)
    total = np.concatenate([np.zeros((1, 3)), np.cumsum(rates, 0)])
    first = np.searchsorted(imu.t, motion.t - GYRO_SPAN_US // 2)
    last = np.searchsorted(imu.t, motion.t + GYRO_SPAN_US // 2)
    count = np.maximum(last - first, 1)[:, None]
    measured = np.linalg.norm((total[last] - total[first]) / count, axis=1)
    size = np.linalg.norm(np.nan_to_num(motion.mean[:, rows]), axis=1)
    sigma = np.sqrt(np.maximum(np.linalg.eigvalsh(motion.covariance[:, rows, rows])[:, -1], 0))
    allowed = GYRO_SIGMAS * sigma + np.sqrt(3) * MAX_GYRO_BIAS_RAD_S
    allowed = allowed + GYRO_RELATIVE_ERROR * np.maximum(size, measured)
    return (last > first) & (np.abs(size - measured) > allowed)


def _supporting_blocks(recording: Recording, motion: MotionRows) -> float | None:
    """Return the median effective number of blocks that support estimates against rest.

    Args:
        recording: The recording.
        motion: Its motion.

    Returns:
        The number; None where there is no such evidence: of flow that is not linear in the motion,
        and of too few events.
    """
    xi, f = pixel_coordinates(recording.width, recording.height, recording.camera)
    model = motion.model(f)
    if model.half_line:
        return None
    test, numbers = EvidenceTest(model, xi), []
    longest = min(MAX_WINDOW_S, 1e-6 * (recording.stop - recording.start))
    rows = np.flatnonzero(motion.valid)
    for k in rows[np.unique(np.linspace(0, len(rows) - 1, N_TESTED_WINDOWS).round().astype(int))]:
        speed = max(float(test.speed(motion.mean[k : k + 1])[0]), 1e-9)
        half = 5e5 * min(WINDOW_DISPLACEMENT_PX / speed, longest)
        end = int(min(max(motion.t[k], recording.start + half) + half, recording.stop))
        found = test.measure(
            recording.events, end, motion.mean[k], motion.covariance[k], WINDOW_DISPLACEMENT_PX,
            longest,
        )  # fmt: skip
        if found is not None:
            numbers.append(found.blocks)
    return float(np.median(numbers)) if numbers else None


def _active_blocks(recording: Recording, speed: ImageSpeed) -> float:
    """Return the median effective number of blocks that hold the events of short windows."""
    half, numbers = round(5e5 * FIT_WINDOW_DISPLACEMENT_PX / speed.median), []
    for middle in spread_times(recording, N_TESTED_WINDOWS):
        index = recording.events.index
        part = recording.events[index(middle - half) : index(middle + half)]
        block = part.y.astype(int) * N_BLOCKS // recording.height * N_BLOCKS
        count = np.bincount(block + part.x.astype(int) * N_BLOCKS // recording.width).astype(float)
        numbers.append(count.sum() ** 2 / max(float((count**2).sum()), 1.0))
    return float(np.median(numbers))
