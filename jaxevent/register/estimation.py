"""Registration of two recordings: what is not known is estimated."""

import dataclasses
import math

import numpy as np
from numpy.typing import ArrayLike

from jaxevent.errors import InputError
from jaxevent.progress import stage
from jaxevent.recording import Recording
from jaxevent.register.clocks import clock_offsets
from jaxevent.register.geometry import Grid, check_homography, grid_between
from jaxevent.register.match import match
from jaxevent.register.refinement import AGREE, Registration, refine


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
    """How another camera's frames fit the events: what is not given is estimated.

    Without `grid` and `homography` (3, 3) a homography is, that of a distant or flat scene:
    features (SIFT, Lowe 2004) of frames, and of their differences, are matched with those of what
    the events alone say of the same times (`jaxevent.high_pass`, and their sums), RANSAC (Barath et
    al., MAGSAC++, CVPR 2020) finds the homography of most of them, and `refine`, which needs no
    features, makes it sub-pixel. Only this needs OpenCV, the extra "vision". The
    cameras must have moved, or the scene.

    Without `offset` (s, added to the frames' time stamps) the clocks are compared: offsets are
    tried at which the frames change when the events say so (`clock_offsets`), up to `search` s
    either way, by default wherever the recordings overlap by half, and the best one is refined
    together with the homography, or alone. A given grid, homography or offset is kept as it is.

    Simulated rigs of 2.5 decades (`experiments/register.py`): 0.04 to 0.16 px rms, clock to 0.6 ms
    or, where images move 20 to 40 px/s, to 2.4 ms. Where frames clip most of what moves (4.5
    decades) up to 1.1 px and 15 ms were seen: take a recording of a scene that frames resolve.

    Raises `InputError` for too few matches, and if the changes of frames and events do not agree in
    the end: correlation below 0.25.
    """
    _check_request(recording, other, offset, search)
    if homography is not None:
        homography = check_homography(homography)
        grid = grid_between(recording, other, homography)
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
                starts = None if grid is not None else match(recording, other, candidate, progress)
            with stage("refine", progress):
                now = refine(
                    recording, other, candidate, grid, starts, keep_offset=offset is not None
                )
        except InputError as error:
            problem = problem or error
            continue
        if best is None or (now.agreement or 0) > (best.agreement or 0):
            best = now
        if (now.agreement or 0) > 2 * AGREE:
            break
    if best is None:
        assert problem is not None
        raise problem
    if (best.agreement or 0) < AGREE:
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
    """Raise `InputError` if there is nothing to register, or for times that make no sense."""
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
