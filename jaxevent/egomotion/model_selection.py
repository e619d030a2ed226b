"""Selection of the motion model that explains a recording, by held-out events.

    selection = select_model(recording)
    selection.model, selection.lines  # the simplest model, and what was found, in words

Every model is fitted to patches of the image, on one half of the pixels, and predicts the
displacement of each patch. Models with a half-line choose the position along it that fits the patch
best. The models are compared by the sharpness of the other half, by the statistic z of `patches`.

A general motion whose parallax is less than a pixel in so short a time looks like a rotation.
Therefore rotations are tested again in longer windows, to which scenes are fitted with and without
a translation (`bundle.hypotheses`).
"""

import dataclasses
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from jaxevent.camera import PinholeCamera
from jaxevent.deprecated import renamed_names
from jaxevent.egomotion.bundle.hypotheses import MotionGuess, translation_z
from jaxevent.egomotion.candidates import pixel_coordinates
from jaxevent.egomotion.geometry import rotation_basis
from jaxevent.egomotion.models import MODELS, General, Model, Planar, Rotation
from jaxevent.egomotion.patches import (
    FIT_WINDOW_DISPLACEMENT_PX,
    describe_windows,
    fit_general,
    fit_planar,
    fit_rotation,
    half_line_displacements,
    log_sharpness,
    measure_image_speed,
    measure_windows,
    z_score,
)
from jaxevent.errors import InputError
from jaxevent.recording import Recording

MIN_SELECTION_Z = 3.0  # from which one model explains more than another
# Half-lines fit an edge's ambiguity too, on both halves: simulated rotation and planar motion reach
# 3.8, simulated depth 3.5 and more.
MIN_DEPTH_SELECTION_Z = 4.0
# Of longer windows, from which general motion is not excluded. Rotations have -6 to 2.5, as the
# parameters that general motion adds fit noise too, and general motion 2.8 and more.
MAX_EXCLUSION_Z = 0.0
N_LONG_WINDOWS = 2  # in which a translation is tested


@dataclasses.dataclass(frozen=True)
class ModelSelection:
    """The selected model.

    Attributes:
        model: The simplest model that explains the recording.
        lines: What was found, lines to print.
        z: Test statistic by names (general model, simpler model); positive if the first one
            explains held-out events better.
    """

    model: type[Model]
    lines: tuple[str, ...]
    z: dict[tuple[str, str], float]


def select_model(recording: Recording, camera: PinholeCamera | None = None) -> ModelSelection:
    """Select the simplest model that explains a recording.

    Args:
        recording: The recording.
        camera: The camera; by default the recording's. Without one planar motion is selected.

    Returns:
        The selection.

    Raises:
        InputError: Nothing is seen to move.
    """
    camera = camera or recording.camera
    speed = measure_image_speed(recording, camera)
    windows = [] if speed is None else measure_windows(recording, speed, camera)
    if not windows:
        raise InputError(
            f"{recording.name}: nothing is seen to move {describe_windows(recording)}; name the "
            "model of its motion"
        )
    if camera is None:
        line = (
            "planar motion, since there is no calibration, which the others need"
            f"{recording.describe_left_out('camera')}; --focal PX stands for one"
        )
        return ModelSelection(Planar, (line,), {})
    _, f = pixel_coordinates(recording.width, recording.height, camera)
    sharpness: dict[str, list[NDArray]] = {"planar": [], "rotation": [], "general": []}
    guesses = []
    for window in windows:
        rows = np.arange(len(window.xi))
        d = fit_planar(window)
        turn = fit_rotation(window, f, d)
        six = fit_general(window, f, turn)
        along = half_line_displacements(window, f, six[:3], six[3:])
        best = log_sharpness(window, 0, along).argmax(0)
        turned = np.asarray(rotation_basis(window.xi, f)) @ turn
        sharpness["planar"].append(log_sharpness(window, 1, np.tile(d, (len(rows), 1))))
        sharpness["rotation"].append(log_sharpness(window, 1, turned))
        sharpness["general"].append(log_sharpness(window, 1, along[best, rows]))
        duration = window.duration
        guesses.append(
            MotionGuess(
                window.middle, FIT_WINDOW_DISPLACEMENT_PX / duration, turn / duration, six[:3],
                six[3:] / duration,
            )
        )  # fmt: skip
    every = {name: np.concatenate(parts) for name, parts in sharpness.items()}
    z = {
        pair: z_score(every[pair[0]] - every[pair[1]])
        for pair in (("rotation", "planar"), ("general", "planar"), ("general", "rotation"))
    }
    step = -(-len(guesses) // N_LONG_WINDOWS)
    return select_by_z(z, lambda: translation_z(recording, camera, guesses[::step]))


def select_by_z(
    z: dict[tuple[str, str], float], test_long_windows: Callable[[], float | None]
) -> ModelSelection:
    """Select a model by test statistics.

    Args:
        z: Test statistic of patches by names (general model, simpler model).
        test_long_windows: Function that returns that of general motion over rotation in longer
            windows, or None if these hold too few events. It is called if rotation is the simplest
            model left.

    Returns:
        The selection.
    """
    lines = [
        _comparison_line(
            one, other, value, MIN_DEPTH_SELECTION_Z if one == General.name else MIN_SELECTION_Z
        )
        for (one, other), value in z.items()
    ]
    # Where these two do equally well, a camera that turns is more probable than a scene with one
    # wall.
    simple = Rotation if z["rotation", "planar"] > -MIN_SELECTION_Z else Planar
    chosen, sure = General if z["general", simple.name] > MIN_DEPTH_SELECTION_Z else simple, True
    if chosen is Rotation:
        value = test_long_windows()
        if value is not None:
            z = z | {("general", "rotation"): value}
            line = _comparison_line("general", "rotation", value, MIN_SELECTION_Z)
            lines.append(f"in longer windows {line}")
        chosen = General if value is not None and value > MIN_SELECTION_Z else Rotation
        sure = chosen is General or (value is not None and value < MAX_EXCLUSION_Z)
    lines.append(f"chosen: {chosen.title}")
    if not sure:
        lines.append(
            "this is not sure: general motion with little parallax may explain the events as well; "
            "--model general shows whether there is any"
        )
    return ModelSelection(chosen, tuple(lines), z)


def _comparison_line(one: str, other: str, z: float, threshold: float) -> str:
    """Describe which of two models explains events better, significantly beyond a threshold."""
    than = "better than" if z > threshold else "worse than" if z < -threshold else "as well as"
    return (
        f"{MODELS[one].title} explains events that it was not fitted to {than} "
        f"{MODELS[other].title} (z = {z:.1f}, which counts from {threshold:g} on)"
    )


__getattr__ = renamed_names(__name__)
