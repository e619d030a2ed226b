"""Registration of two recordings: estimation of its unknown parts."""

import dataclasses
import math

import numpy as np
from numpy.typing import ArrayLike

from jaxevent.errors import InputError
from jaxevent.progress import stage
from jaxevent.recording import Recording, check_recording
from jaxevent.register.clocks import clock_offsets
from jaxevent.register.features import match_frames
from jaxevent.register.geometry import Grid, Registration, check_homography, recording_grid
from jaxevent.register.refinement import MIN_AGREEMENT, refine


def estimate(
    recording: Recording,
    other: Recording,
    grid: Grid | None = None,
    *,
    homography: ArrayLike | None = None,
    offset: float | int | None = None,
    search: float | int | None = None,
    progress: bool | None = None,
) -> Registration:
    """Estimate the registration of another camera's frames to the events.

    Without `grid` and `homography` a homography is estimated, that of a distant or flat scene:
    features (SIFT, Lowe 2004) of frames, and of their differences, are matched with those of images
    of the events alone at the same times (`jaxevent.high_pass`, and their sums), RANSAC (Barath et
    al., MAGSAC++, CVPR 2020) finds the homography of most of them, and `refine`, which needs no
    features, makes it sub-pixel. Only this needs OpenCV, the extra "vision". The cameras must have
    moved, or the scene.

    Without `offset` the clocks are compared (`clock_offsets`), and the best offset is refined
    together with the homography, or alone. A given grid, homography or offset is kept as it is.

    Errors on simulated rigs are in the results (`experiments/register.py`). Take a recording of a
    scene that frames resolve: where they clip most moving edges, the result is worse.

    Args:
        recording: Events of the event camera.
        other: Frames of the other camera.
        grid: Grid (height, width, 2) of a calibrated rig.
        homography: (3, 3), from the event camera's pixels to the other's.
        offset: Seconds to add to the frames' time stamps.
        search: Largest offset to try, s. By default half of the recordings overlaps.
        progress: Whether to show progress; by default on a terminal.

    Returns:
        The registration.

    Raises:
        InputError: There are too few matches, or changes of frames and events do not agree in the
            end: their correlation is below 0.25.
    """
    _check_request(recording, other, offset, search)
    if homography is not None:
        homography = check_homography(homography)
        grid = recording_grid(recording, other, homography)
    if grid is not None and np.isnan(grid).all():
        raise InputError(
            f"{other.name}: shows nothing that the event camera sees; correct the calibration, the "
            "depth or the homography"
        )
    if grid is not None and offset is not None:
        return Registration(grid, float(offset), homography)
    assert other.frames is not None
    if len(other.frames) < 3:
        raise InputError(
            f"{other.name}: holds {len(other.frames)} frames, and estimating needs 3; give the "
            "offset and the homography or calibration"
        )
    if offset is not None:
        offsets = [float(offset)]
    else:
        with stage("compare clocks", progress):
            offsets = clock_offsets(recording, other, search)
    best, problem = None, None
    for candidate in offsets:
        try:
            with stage("match features", progress):
                starts = (
                    None
                    if grid is not None
                    else match_frames(recording, other, candidate, progress)
                )
            with stage("refine", progress):
                now = refine(
                    recording, other, candidate, grid, starts, keep_offset=offset is not None
                )
        except InputError as error:
            problem = problem or error
            continue
        if best is None or (now.agreement or 0) > (best.agreement or 0):
            best = now
        if (now.agreement or 0) > 2 * MIN_AGREEMENT:
            break
    if best is None:
        assert problem is not None
        raise problem
    if (best.agreement or 0) < MIN_AGREEMENT:
        raise InputError(
            f"{other.name}: what its frames show and the events do not agree, the correlation of "
            f"their changes is {best.agreement:.2f}; give what is known of the offset, homography "
            "or calibration, or a part of the recordings in which the cameras move more"
        )
    return dataclasses.replace(best, homography=homography) if grid is not None else best


def _check_request(
    recording: Recording,
    other: Recording,
    offset: float | int | None,
    search: float | int | None,
) -> None:
    """Check that there is something to register, and that times make sense.

    Args:
        recording: Events.
        other: Frames.
        offset: Offset of the clocks, s; None: it is estimated.
        search: Largest offset to try, s; None: the default.

    Raises:
        InputError: Something is missing, or not possible.
    """
    check_recording(recording, "register.estimate")
    check_recording(other, "register.estimate")
    frames = other.frames
    if frames is None or not len(recording.events):
        empty, what = (other, "frames") if frames is None else (recording, "events")
        raise InputError(
            f"{empty.name}: holds no {what}{empty.describe_left_out(what)}, so there is nothing to "
            "register"
        )
    if offset is not None and not math.isfinite(offset):
        raise InputError(f"the offset {offset} of the clocks is not possible; give seconds")
    if search is not None and not 0 < search < math.inf:
        raise InputError(f"a search of {search} s is not possible; give seconds above 0")
