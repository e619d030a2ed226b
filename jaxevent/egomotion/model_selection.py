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
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.calibration.faults import warn_of_unit
from jaxevent.camera import PinholeCamera
from jaxevent.deprecated import renamed_names
from jaxevent.egomotion.bundle.hypotheses import MotionGuess, translation_z
from jaxevent.egomotion.candidates import pixel_coordinates
from jaxevent.egomotion.geometry import rotation_basis
from jaxevent.egomotion.models import MODELS, General, Model, Planar, Rotation
from jaxevent.egomotion.motion import MotionEstimate
from jaxevent.egomotion.patches import (
    FIT_WINDOW_DISPLACEMENT_PX,
    PatchSharpness,
    describe_windows,
    fit_general,
    fit_planar,
    fit_rotation,
    half_line_displacements,
    log_sharpness,
    measure_image_speed,
    measure_windows,
    refine_rotation,
    z_score,
)
from jaxevent.errors import InputError
from jaxevent.recording import Recording, check_recording

MIN_SELECTION_Z = 3.0  # from which one model explains more than another
# Half-lines fit an edge's ambiguity too, on both halves: simulated rotation and planar motion reach
# 3.8, simulated depth 3.5 and more.
MIN_DEPTH_SELECTION_Z = 4.0
# Of longer windows, from which general motion is not excluded. Rotations have -6 to 2.5, as the
# parameters that general motion adds fit noise too, and general motion 2.8 and more.
MAX_EXCLUSION_Z = 0.0
N_LONG_WINDOWS = 2  # in which a translation is tested
LENS = "a rotation before a lens that distorts"
MIN_REPORTED_WEIGHT = 0.01  # of a model that was not chosen
TRIED_DIVISIONS = (-0.6, -0.45, -0.3, -0.2, -0.1, 0.1, 0.2)  # of a lens of which none is known
MIN_DIVISOR = 0.2  # 1 + l |x|^2 / f^2 at the patches, below which a lens is not tried
MIN_LENS_Z = 3.0  # from which a distortion explains more than none
MIN_LENS_DOUBT_Z = 1.0  # from which it may


@dataclasses.dataclass(frozen=True)
class ModelSelection:
    """The selected model.

    Attributes:
        model: The simplest model that explains the recording.
        lines: What was found, lines to print.
        z: Test statistic by names (general model, simpler model); positive if the first one
            explains held-out events better.
        doubt: (d, d) covariance of what the other models tell, relative to the motion's size; None
            where they are excluded.
        camera: The camera with a distortion that was found, or None.
    """

    model: type[Model]
    lines: tuple[str, ...]
    z: dict[tuple[str, str], float]
    doubt: NDArray[np.float64] | None = None
    camera: PinholeCamera | None = None

    def include_doubt(self, motion: MotionEstimate) -> MotionEstimate:
        """Add the differences of models that are not excluded to the covariance.

        Args:
            motion: A motion of the selected model.

        Returns:
            The motion with the larger covariance.
        """
        if self.doubt is None:
            return motion
        mean = np.nan_to_num(motion.mean)
        scale = np.ones_like(mean)  # of directions; others are relative to their size
        for part in motion.model.parts:
            if not part.direction:
                scale[:, part.rows] = np.linalg.norm(mean[:, part.rows], axis=1)[:, None]
        added = self.doubt * scale[:, :, None] * scale[:, None, :]
        return dataclasses.replace(motion, covariance=motion.covariance + added)


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
    check_recording(recording, "select_model")
    camera = camera or recording.camera
    speed = measure_image_speed(recording, camera)
    windows = [] if speed is None else measure_windows(recording, speed, camera)
    if not windows:
        warn_of_unit(recording)  # a clock that is too fast or too slow may be the cause
        raise InputError(
            f"{recording.name}: nothing is seen to move {describe_windows(recording)}; this "
            "may be noise; if something moves, name the model of its motion"
        )
    if camera is None:
        line = (
            "planar motion, since there is no calibration, which the others need"
            f"{recording.describe_left_out('camera')}; --focal PX stands for one"
        )
        return ModelSelection(Planar, (line,), {})
    _, f = pixel_coordinates(recording.width, recording.height, camera)
    sharpness: dict[str, list[NDArray]] = {"planar": [], "rotation": [], "general": []}
    guesses, fits = [], []
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
        fits.append(_WindowFits(np.asarray(rotation_basis(window.xi, f)), d, turn, six))
        duration = window.duration
        guesses.append(
            MotionGuess(
                window.middle, FIT_WINDOW_DISPLACEMENT_PX / duration, turn / duration, six[:3],
                six[3:] / duration,
            )
        )  # fmt: skip
    lines: tuple[str, ...] = ()
    lens = None if camera.is_distorted else _fit_lens(windows, f, [one.turn for one in fits])
    every = {name: np.concatenate(parts) for name, parts in sharpness.items()}
    if lens is not None:
        gain = z_score(lens.sharpness - every["rotation"])
        ahead = z_score(every["general"] - lens.sharpness) < MIN_DEPTH_SELECTION_Z
        if gain > MIN_LENS_Z and ahead and z_score(lens.sharpness - every["planar"]) > 0:
            every["rotation"] = lens.sharpness
            camera = dataclasses.replace(camera, distortion=lens.distortion(recording, camera))
            lines = (
                f"a lens that distorts, k1 about {camera.distortion[0]:.2g}, explains a rotation "
                f"better than one that does not (z = {gain:.1f}); it is used, and a calibration is "
                "better",
            )
    z = {
        pair: z_score(every[pair[0]] - every[pair[1]])
        for pair in (("rotation", "planar"), ("general", "planar"), ("general", "rotation"))
    }
    step = -(-len(guesses) // N_LONG_WINDOWS)
    # What a lens that is known roughly leaves looks like parallax in longer windows.
    test = None if lines else translation_z
    found = select_by_z(z, lambda: test(recording, camera, guesses[::step]) if test else None)
    chosen = found.model.name
    both_ways = found.z | {(other, one): -value for (one, other), value in found.z.items()}
    against = {other: both_ways[chosen, other] for other in MODELS if other != chosen}
    if lens is not None and not lines:
        gain = z_score(lens.sharpness - every["rotation"])
        if gain > MIN_LENS_DOUBT_Z:
            against[LENS] = z_score(every[chosen] - lens.sharpness)
            fits = [one._replace(lens=turn) for one, turn in zip(fits, lens.turns, strict=True)]
    doubt, doubts = _model_doubt(found.model, fits, against)
    return dataclasses.replace(
        found, lines=(*lines, *doubts, *found.lines), doubt=doubt, camera=camera if lines else None
    )


class _WindowFits(NamedTuple):
    """The motions that models find in a window."""

    basis: NDArray[np.float64]  # (patches, 2, 3) of rotations
    planar: NDArray[np.float64]  # (2,) px
    turn: NDArray[np.float64]  # (3,) rad
    general: NDArray[np.float64]  # (6,) heading and rad

    lens: NDArray[np.float64] | None = None  # (3,) rad, before a lens that distorts

    def motion(self, name: str, model: type[Model]) -> NDArray[np.float64]:
        """Return the components of one model as the fit of another determines them."""
        turns = {Rotation.name: self.turn, General.name: self.general[3:], LENS: self.lens}
        turn = turns.get(name)
        if model is Planar:
            return self.planar if turn is None else self.basis.mean(0) @ turn
        if turn is None:
            flow = np.tile(self.planar, len(self.basis))
            rows = self.basis.reshape(-1, 3)
            turn = np.asarray(np.linalg.lstsq(rows, flow, rcond=None)[0], np.float64)
        return turn


def _model_doubt(
    model: type[Model], fits: list[_WindowFits], against: dict[str, float]
) -> tuple[NDArray[np.float64] | None, list[str]]:
    """Average the squared differences of other models, by their weights exp(-z^2 / 2).

    Args:
        model: The chosen model.
        fits: Fits of all models.
        against: z, the evidence against other models by their names; below 0 it counts as 0.

    Returns:
        (d, d) covariance relative to the motion's size, None without doubt; and lines about it.
    """
    lines = []
    d = len(model.components)
    total = np.zeros((d, d))
    rows = slice(3, 6) if model is General else slice(0, d)
    for other, z in against.items():
        odds = np.exp(-(max(z, 0.0) ** 2) / 2)
        weight = float(odds / (1 + odds))
        if weight < MIN_REPORTED_WEIGHT:
            continue
        size, away = 0.0, np.zeros((rows.stop - rows.start,) * 2)
        for one in fits:
            own = one.motion(model.name, model)
            far = one.motion(other, model) - own
            away += np.outer(far, far)
            size += float(own @ own)
        total[rows, rows] += weight * away / max(size, 1e-12)
        if model is General:
            total[:3, :3] += weight * np.eye(3)
        share = 100 * np.sqrt(np.trace(away) / max(size, 1e-12))
        title = MODELS[other].title if other in MODELS else other
        lines.append(
            f"{title} is not excluded: its weight is {weight:.2f}, and it differs by "
            f"{share:.0f} %; sigmas include that"
        )
    return (total if lines else None), lines


class _LensFit(NamedTuple):
    """Rotations before a lens that distorts.

    Attributes:
        division: Coefficient of the lens's division model.
        likelihood: Log-likelihood of the pixels that the coefficient was fitted to.
        sharpness: Log sharpness of the patches' held-out pixels.
        turns: (3,) rotation of each window, rad.
    """

    division: float
    likelihood: float
    sharpness: NDArray[np.float64]
    turns: list[NDArray[np.float64]]

    def distortion(self, recording: Recording, camera: PinholeCamera) -> tuple[float, ...]:
        """Return coefficients k1, k2, p1, p2, k3 that distort about alike on a sensor."""
        size = np.array([recording.width, recording.height]) / 2
        farthest = float(np.hypot(*(size / [camera.fx, camera.fy])))
        r = np.linspace(0.05, 1, 40) * farthest
        u = r / (1 + self.division * r**2)
        powers = u[:, None] ** [3, 5, 7]
        k1, k2, k3 = np.linalg.lstsq(powers, r - u, rcond=None)[0].tolist()
        return k1, k2, 0.0, 0.0, k3


def _fit_lens(
    windows: list[PatchSharpness], f: float, turns: list[NDArray[np.float64]]
) -> _LensFit | None:
    """Fit rotations and one distortion to patches' own half of the pixels.

    A pixel x would be at u = x / (1 + l |x|^2 / f^2) without the distortion (Fitzgibbon,
    "Simultaneous linear estimation of multiple view geometry and lens distortion", 2001). It moves
    with (du / dx)^-1 B(u) Omega.

    Args:
        windows: Patches of windows.
        f: Focal length, px.
        turns: (3,) rotation vector of each window, rad, from which the fits start.

    Returns:
        The best fit; None if no distortion is possible.
    """
    tried = [_try_lens(windows, f, turns, division) for division in TRIED_DIVISIONS]
    likelihood = np.array([-np.inf if one is None else one.likelihood for one in tried])
    best = int(likelihood.argmax())
    near = slice(max(best - 1, 0), best + 2)
    if not np.isfinite(likelihood[near]).all() or best in (0, len(tried) - 1):
        return tried[best]
    bend, slope, _ = np.polyfit(TRIED_DIVISIONS[near], likelihood[near], 2)
    refined = _try_lens(windows, f, turns, -slope / 2 / bend)
    better = refined is not None and refined.likelihood > likelihood[best]
    return refined if better else tried[best]


def _try_lens(
    windows: list[PatchSharpness], f: float, turns: list[NDArray[np.float64]], division: float
) -> _LensFit | None:
    """Fit rotations before a lens of a given distortion.

    Args:
        windows: Patches of windows.
        f: Focal length, px.
        turns: (3,) rotation vector of each window, rad, from which the fits start.
        division: The distortion l, see `_fit_lens`.

    Returns:
        The fit; None if the distortion is impossible at the patches.
    """
    likelihood, held, found = 0.0, [], []
    for window, turn in zip(windows, turns, strict=True):
        x = window.xi
        s = 1 + division * (x**2).sum(1) / f**2
        if s.min() < MIN_DIVISOR:
            return None
        outer = 2 * division / f**2 * x[:, :, None] * x[:, None, :]
        slope = (s[:, None, None] * np.eye(2) - outer) / s[:, None, None] ** 2
        basis = np.linalg.solve(slope, np.asarray(rotation_basis(x / s[:, None], f)))
        found.append(refine_rotation(window, basis, turn))
        turned = basis @ found[-1]
        likelihood += float(log_sharpness(window, 0, turned).sum())
        held.append(log_sharpness(window, 1, turned))
    return _LensFit(division, likelihood, np.concatenate(held), found)


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
            "the model general shows whether there is any"
        )
    return ModelSelection(chosen, tuple(lines), z)


def _comparison_line(one: str, other: str, z: float, threshold: float) -> str:
    """Describe which of two models explains events better, significantly beyond a threshold.

    Args:
        one: Name of the first model.
        other: Name of the other one.
        z: Difference in standard deviations, above 0 where the first one is better.
        threshold: Significant difference.

    Returns:
        A sentence without a full stop.
    """
    than = "better than" if z > threshold else "worse than" if z < -threshold else "as well as"
    return (
        f"{MODELS[one].title} explains events that it was not fitted to {than} "
        f"{MODELS[other].title} (z = {z:.1f}, which counts from {threshold:g} on)"
    )


__getattr__ = renamed_names(__name__)
