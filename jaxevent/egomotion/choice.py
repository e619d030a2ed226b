"""Which model explains a recording: planar motion, rotation or general motion, by held-out events.

    choice = choose(recording)
    choice.model, choice.lines   # the simplest that explains it, and what was found, in words

At some times patches of the image are looked at (`patches.look`). Every model is fitted to one half
of the pixels: it says which way each patch took, along its half-line any way that fits if it has
one. On the other half, D_p is by how much the log of a patch's sharpness is larger under one model
than under another; patches err independently, so z = sum D_p / sqrt(sum D_p^2) is standard normal
where both explain it alike.

What patches take for a rotation may be a general motion whose parallax is less than a pixel in so
short a time, so that it is asked again in longer windows, of which scenes are fitted with and
without a translation (`bundle.translation`).
"""

import dataclasses
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from jaxevent.camera import PinholeCamera
from jaxevent.egomotion.bundle.hypotheses import MotionGuess, translation_z
from jaxevent.egomotion.candidates import coordinates
from jaxevent.egomotion.geometry import rotation_basis
from jaxevent.egomotion.models import MODELS, General, Model, Planar, Rotation
from jaxevent.egomotion.patch_fits import (
    WAY,
    along,
    general,
    looks,
    planar,
    rotation,
    sharpness,
    standard,
)
from jaxevent.egomotion.patches import Look, tried, usual_speed
from jaxevent.errors import InputError
from jaxevent.recording import Recording

Z = 3.0  # from which one model explains more than another
# Half-lines fit an edge's ambiguity too, on both halves: simulated rotation and planar motion reach
# 3.8, simulated depth 3.5 and more.
Z_DEPTH = 4.0
# Of longer windows, from which general motion is not excluded. Rotations have -6 to 2.5, as what
# general motion adds fits noise too, and general motion 2.8 and more.
UNSURE = 0.0
WINDOWS = 2  # longer ones, in which a translation is looked for


@dataclasses.dataclass(frozen=True)
class Choice:
    """The model, lines to print, and z of the more general models against the simpler ones."""

    model: type[Model]
    lines: tuple[str, ...]
    z: dict[tuple[str, str], float]


def choose(recording: Recording, camera: PinholeCamera | None = None) -> Choice:
    """The simplest model that explains a recording.

    Without a camera planar motion alone is possible. Raises `InputError` where nothing is seen to
    move.
    """
    camera = camera or recording.camera
    speed = usual_speed(recording, camera)
    seen = [] if speed is None else looks(recording, speed, camera)
    if not seen:
        raise InputError(
            f"{recording.name}: nothing is seen to move {tried(recording)}; name the model of its "
            "motion"
        )
    if camera is None:
        line = (
            "planar motion, since there is no calibration, which the others need"
            f"{recording.describe_left_out('camera')}; --focal PX stands for one"
        )
        return Choice(Planar, (line,), {})
    _, f = coordinates(recording.width, recording.height, camera)
    sharp: dict[str, list[NDArray]] = {"planar": [], "rotation": [], "general": []}
    guesses = []
    for one in seen:
        d = planar(one)
        turn = rotation(one, f, d)
        six = general(one, f, turn)
        ways = along(one, f, six[:3], six[3:])
        pick = sharpness(one, 0, ways).argmax(0)
        sharp["planar"].append(sharpness(one, 1, np.tile(d, (len(one.xi), 1))))
        sharp["rotation"].append(sharpness(one, 1, np.asarray(rotation_basis(one.xi, f)) @ turn))
        sharp["general"].append(sharpness(one, 1, ways[pick, np.arange(len(one.xi))]))
        guesses.append(_guess(one, turn, six))
    every = {name: np.concatenate(parts) for name, parts in sharp.items()}
    z = {
        pair: standard(every[pair[0]] - every[pair[1]])
        for pair in (("rotation", "planar"), ("general", "planar"), ("general", "rotation"))
    }
    return decide(
        z, lambda: translation_z(recording, camera, guesses[:: -(-len(guesses) // WINDOWS)])
    )


def decide(z: dict[tuple[str, str], float], longer: Callable[[], float | None]) -> Choice:
    """The choice by z of patches and, where rotation is the simplest left, that of `longer`
    windows, of general motion over rotation, None where these hold too few events."""
    lines = [
        _line(one, other, value, Z_DEPTH if one == General.name else Z)
        for (one, other), value in z.items()
    ]
    # Where these two do equally well, a camera that turns is likelier than a scene before one wall.
    simple = Rotation if z["rotation", "planar"] > -Z else Planar
    chosen, sure = General if z["general", simple.name] > Z_DEPTH else simple, True
    if chosen is Rotation:
        value = longer()
        if value is not None:
            z = z | {("general", "rotation"): value}
            lines.append(f"in longer windows {_line('general', 'rotation', value, Z)}")
        chosen = General if value is not None and value > Z else Rotation
        sure = chosen is General or (value is not None and value < UNSURE)
    lines.append(f"chosen: {chosen.title}")
    if not sure:
        lines.append(
            "this is not sure: general motion with little parallax may explain the events as well; "
            "--model general says whether there is any"
        )
    return Choice(chosen, tuple(lines), z)


def _guess(seen: Look, turn: NDArray, six: NDArray) -> MotionGuess:
    """A rotation (rad) and a general motion of a window, per second."""
    return MotionGuess(
        seen.middle, WAY / seen.length, turn / seen.length, six[:3], six[3:] / seen.length
    )


def _line(one: str, other: str, z: float, enough: float) -> str:
    """Whether one model explains events better than another, which z beyond `enough` says."""
    than = "better than" if z > enough else "worse than" if z < -enough else "as well as"
    return (
        f"{MODELS[one].title} explains events that it was not fitted to {than} "
        f"{MODELS[other].title} (z = {z:.1f}, which counts from {enough:g} on)"
    )
