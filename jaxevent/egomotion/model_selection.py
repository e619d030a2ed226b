"""Selection of the motion model that explains a recording, by held-out events.

    selection = select_model(recording)
    selection.model, selection.lines  # the simplest model, and what was found, in words
    flow_consistency(recording)       # whether all parts of the image move as one

At some times patches of the image are evaluated (`patches.measure_sharpness`). Every model is
fitted to one half of the pixels, and predicts the displacement of each patch. Models with a
half-line choose the position along it that fits the patch best. On the other half, D_p is the log
of a patch's sharpness under one model less that under another. Errors of patches are independent,
so z = sum D_p / sqrt(sum D_p^2) is standard normal where both explain the events alike.

A general motion whose parallax is less than a pixel in so short a time looks like a rotation.
Therefore rotations are tested again in longer windows, to which scenes are fitted with and without
a translation (`bundle.translation`).
"""

import dataclasses
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from scipy.optimize import minimize

from jaxevent.camera import PinholeCamera
from jaxevent.deprecated import renamed_fields, renamed_methods, renamed_names
from jaxevent.egomotion.bundle.hypotheses import MotionGuess, translation_z
from jaxevent.egomotion.candidates import pixel_coordinates
from jaxevent.egomotion.geometry import A, rotation_basis
from jaxevent.egomotion.models import MODELS, General, Model, Planar, Rotation
from jaxevent.egomotion.patches import (
    DURATIONS_S,
    ImageSpeed,
    PatchSharpness,
    describe_windows,
    measure_image_speed,
    measure_sharpness,
    spread_times,
)
from jaxevent.errors import InputError
from jaxevent.recording import Recording

N_TIMES = 4  # at which patches are evaluated
MAX_DISPLACEMENT_PX = 10  # of patches, in x and y
WINDOW_DISPLACEMENT_PX = 5.0  # median displacement of the image in a window
HALF_LINE_PX = np.linspace(0, 1.4 * MAX_DISPLACEMENT_PX, 29)  # positions along a half-line
N_HEADINGS = 6  # from which a general motion is refined

MIN_Z = 3.0  # from which one model explains more than another, or parts of the image move apart
# Half-lines fit an edge's ambiguity too, on both halves: simulated rotation and planar motion reach
# 3.8, simulated depth 3.5 and more.
MIN_Z_DEPTH = 4.0
# Of longer windows, from which general motion is not excluded. Rotations have -6 to 2.5, as the
# parameters that general motion adds fit noise too, and general motion 2.8 and more.
MAX_Z_EXCLUDED = 0.0
N_LONG_WINDOWS = 2  # in which a translation is tested
# Of the model's displacement; a roll moves half of the patches backwards.
SPEED_FACTORS = np.concatenate([-np.geomspace(3.0, 0.3, 25), np.geomspace(0.3, 3.0, 25)])


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


@renamed_fields(both="both_directions")
@renamed_methods(several="is_inconsistent")
@dataclasses.dataclass(frozen=True)
class FlowConsistency:
    """Differences between the motions of parts of the image, along the model's direction.

    Attributes:
        spread: Standard deviation of the speeds, relative to their median.
        z: Test statistic of whether they differ.
        slow: 10th percentile of the speeds, px/s.
        fast: 90th percentile of the speeds, px/s.
        both_directions: Whether some parts move backwards.
    """

    spread: float
    z: float
    slow: float
    fast: float
    both_directions: bool

    @property
    def is_inconsistent(self) -> bool:
        """Return whether the image does not move as one."""
        return self.z > MIN_Z


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
                window.middle, WINDOW_DISPLACEMENT_PX / duration, turn / duration, six[:3],
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
        _comparison_line(one, other, value, MIN_Z_DEPTH if one == General.name else MIN_Z)
        for (one, other), value in z.items()
    ]
    # Where these two do equally well, a camera that turns is more probable than a scene with one
    # wall.
    simple = Rotation if z["rotation", "planar"] > -MIN_Z else Planar
    chosen, sure = General if z["general", simple.name] > MIN_Z_DEPTH else simple, True
    if chosen is Rotation:
        value = test_long_windows()
        if value is not None:
            z = z | {("general", "rotation"): value}
            line = _comparison_line("general", "rotation", value, MIN_Z)
            lines.append(f"in longer windows {line}")
        chosen = General if value is not None and value > MIN_Z else Rotation
        sure = chosen is General or (value is not None and value < MAX_Z_EXCLUDED)
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


def flow_consistency(
    recording: Recording,
    model: type[Model] = Planar,
    camera: PinholeCamera | None = None,
    speed: ImageSpeed | None = None,
) -> FlowConsistency | None:
    """Test whether the image moves as one, as planar motion or a rotation does.

    Each patch may move by its own factor of the displacement that the model makes there.

    Args:
        recording: The recording.
        model: `Planar` or `Rotation`.
        camera: The camera; by default the recording's.
        speed: The speed of the image; by default it is measured.

    Returns:
        The consistency, or None where nothing is seen to move, and for other models.
    """
    camera = camera or recording.camera
    if model not in (Planar, Rotation):
        return None
    speed = speed or measure_image_speed(recording, camera)
    if speed is None:
        return None
    _, f = pixel_coordinates(recording.width, recording.height, camera)
    factors = np.append(SPEED_FACTORS, 1.0)
    differences, best_factors, speeds = [], [], []
    for window in measure_windows(recording, speed, camera):
        d = fit_planar(window)
        if float(np.hypot(*d)) < 1:
            continue
        displacements = np.tile(d, (len(window.xi), 1))
        if model is Rotation:
            turn = fit_rotation(window, f, d)
            displacements = np.asarray(rotation_basis(window.xi, f)) @ turn
        own = factors[:, None, None] * displacements
        train = log_sharpness(window, 0, own)
        best, rows = train.argmax(0), np.arange(len(window.xi))
        differences.append(
            log_sharpness(window, 1, own[best, rows]) - log_sharpness(window, 1, own[-1])
        )
        gain = train.max(0) - train[-1] + train.max(0) - np.median(train, 0)
        is_sharp = gain > np.log(1.3)
        factor = factors[best][is_sharp]
        best_factors.append(factor)
        speeds.append(np.abs(factor) * np.hypot(*displacements[is_sharp].T) / window.duration)
    if not best_factors or not len(np.concatenate(best_factors)):
        return None
    factor = np.concatenate(best_factors)
    low, high = np.percentile(factor, [16, 84])
    slow, fast = np.percentile(np.concatenate(speeds), [10, 90])
    median = float(np.median(np.abs(factor)))
    spread = float((high - low) / 2 / max(median, 1e-9))
    z = z_score(np.concatenate(differences))
    return FlowConsistency(spread, z, float(slow), float(fast), bool(low < 0))


def measure_windows(
    recording: Recording, speed: ImageSpeed, camera: PinholeCamera | None = None
) -> list[PatchSharpness]:
    """Evaluate patches at some times, in windows in which the image moves by a few px.

    Args:
        recording: The recording.
        speed: Speed of the image.
        camera: The camera; by default the recording's.

    Returns:
        The windows that hold enough events.
    """
    windows = []
    xi, _ = pixel_coordinates(recording.width, recording.height, camera or recording.camera)
    for middle in spread_times(recording, N_TIMES):
        near = [(abs(t - middle), v) for t, v in speed.by_time if np.isfinite(v)]
        here = min(near)[1] if near else speed.median
        duration = DURATIONS_S[np.abs(np.log(DURATIONS_S * here / WINDOW_DISPLACEMENT_PX)).argmin()]
        window = measure_sharpness(recording, middle, float(duration), MAX_DISPLACEMENT_PX, xi)
        if window is not None:
            windows.append(window)
    return windows


def log_sharpness(
    window: PatchSharpness, half: int, displacements: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Interpolate the log of the sharpness of patches.

    Args:
        window: The patches.
        half: Half of the pixels, 0 or 1.
        displacements: (..., patches, 2) displacements, px.

    Returns:
        (..., patches) values.
    """
    at = np.clip(displacements + MAX_DISPLACEMENT_PX, 0, 2 * MAX_DISPLACEMENT_PX)
    patch = np.broadcast_to(np.arange(len(window.xi)), at.shape[:-1])
    values = np.log(np.maximum(window.energy[half], 1e-6))
    return map_coordinates(values, [patch, at[..., 1], at[..., 0]], order=1, mode="nearest")


def _minimise(loss: Callable[[NDArray], float], starts: list[NDArray], size: float) -> NDArray:
    """Minimise a loss from several starts by simplexes of a size."""
    options = {"maxiter": 250, "xatol": 1e-3 * size, "fatol": 1e-3}
    found = []
    for start in starts:
        simplex = np.concatenate([start[None], start + size * np.eye(len(start))])
        options["initial_simplex"] = simplex
        found.append(minimize(loss, start, method="Nelder-Mead", options=options))
    return min(found, key=lambda one: one.fun).x


def fit_planar(window: PatchSharpness) -> NDArray[np.float64]:
    """Fit one displacement (2,) in px to all patches."""
    n = len(window.displacements)
    sums = np.log(np.maximum(window.energy[0], 1e-6)).sum(0)
    row, column = divmod(int(sums.argmax()), n)
    start = window.displacements[[column, row]]

    def loss(d: NDArray) -> float:
        return -float(log_sharpness(window, 0, np.tile(d, (len(window.xi), 1))).sum())

    return _minimise(loss, [start], 0.5)


def fit_rotation(
    window: PatchSharpness, f: float, planar: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Fit a rotation to the patches.

    Args:
        window: The patches.
        f: Focal length, px.
        planar: (2,) displacement of all patches, px, from which the fit starts.

    Returns:
        (3,) rotation vector over the window, rad.
    """
    basis = np.asarray(rotation_basis(window.xi, f))
    first = np.array([planar[1] / f, -planar[0] / f, 0.0])
    roll = 2.0 / max(float(np.hypot(*window.xi.T).mean()), 1.0)
    starts = [first + np.array([0, 0, k * roll]) for k in (-2, 0, 2)]
    starts.append(np.zeros(3))
    unit = np.array([1 / f, 1 / f, roll / 2])

    def loss(v: NDArray) -> float:
        return -float(log_sharpness(window, 0, basis @ (v * unit)).sum())

    return _minimise(loss, [one / unit for one in starts], 1.0) * unit


def half_line_displacements(
    window: PatchSharpness, f: float, T: NDArray, turn: NDArray
) -> NDArray[np.float64]:
    """Return displacements along the half-lines of a general motion.

    Args:
        window: The patches.
        f: Focal length, px.
        T: (3,) heading.
        turn: (3,) rotation vector over the window, rad.

    Returns:
        (positions, patches, 2) displacements, px.
    """
    base = np.asarray(rotation_basis(window.xi, f)) @ turn
    line = np.einsum("pij,j->pi", _translation_basis(window.xi, f), T)
    line /= np.maximum(np.linalg.norm(line, axis=1, keepdims=True), 1e-9)
    return base + HALF_LINE_PX[:, None, None] * line


def _translation_basis(xi: NDArray[np.float64], f: float) -> NDArray[np.float64]:
    """Return `geometry.A` at positions (n, 2), (n, 2, 3)."""
    return np.stack([np.asarray(A(x, y, f)) for x, y in xi])


def fit_general(window: PatchSharpness, f: float, turn: NDArray[np.float64]) -> NDArray[np.float64]:
    """Fit a general motion, with the best position along its half-line for each patch.

    Args:
        window: The patches.
        f: Focal length, px.
        turn: (3,) rotation vector over the window from which the fit starts, rad.

    Returns:
        (6,) heading and rotation vector over the window, rad.
    """
    columns = _translation_basis(window.xi, f)
    basis = np.asarray(rotation_basis(window.xi, f))

    def displacements(v: NDArray) -> NDArray:
        line = columns @ v[:3]
        line = line / np.maximum(np.linalg.norm(line, axis=1, keepdims=True), 1e-9)
        return basis @ (v[3:] / f) + HALF_LINE_PX[:, None, None] * line

    def loss(v: NDArray) -> float:
        size = float(np.linalg.norm(v[:3]))
        best = log_sharpness(window, 0, displacements(v)).max(0)
        return -float(best.sum()) + 10 * (size - 1) ** 2

    headings = np.random.default_rng(0).normal(size=(40, 3))
    headings /= np.linalg.norm(headings, axis=1, keepdims=True)
    headings = np.concatenate([headings, np.eye(3), -np.eye(3)])
    starts = [np.append(T, factor * f * turn) for T in headings for factor in (0.0, 0.5, 1.0)]
    starts = sorted(starts, key=loss)[:N_HEADINGS]
    found = _minimise(loss, starts, 0.3)
    return np.append(found[:3] / np.linalg.norm(found[:3]), found[3:] / f)


def z_score(D: NDArray[np.float64]) -> float:
    """Return the sum of independent differences, relative to its standard deviation."""
    size = float(np.sqrt((D**2).sum()))
    return float(D.sum()) / size if size > 0 else 0.0


__getattr__ = renamed_names(__name__)
