"""Whether a camera moved or only turned, by pixels that are left out of fits of whole windows.

A rotation and general motions are fitted to a part of the pixels of a window (`rivals`). In its
length the image moves by `WAY`, several times farther than in the windows of patches, so that what
a little parallax adds up to is seen, edges in all directions together.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.camera import PinholeCamera
from jaxevent.egomotion.batch_fit.depths import depths
from jaxevent.egomotion.batch_fit.path import Path
from jaxevent.egomotion.batch_fit.rivals import FAR
from jaxevent.egomotion.batch_fit.starts import side_by_side
from jaxevent.egomotion.batch_fit.windows import Params, Windows
from jaxevent.recording import Recording

WAY = 25.0  # px, that the image moves in a window
SHORTEST, LONGEST = 0.01, 1.0  # s, of half a window
PARALLAX = 0.3  # of the image's way, that a translation makes to begin with


class Guess(NamedTuple):
    """A motion about a time to begin with: a turn alone, and a heading with the turn beside it."""

    centre: int  # us
    speed: float  # px/s of the image
    turn: NDArray[np.float64]  # rad/s
    heading: NDArray[np.float64]  # (3,), a unit vector
    Omega: NDArray[np.float64]  # rad/s


def told(recording: Recording, camera: PinholeCamera, guesses: list[Guess]) -> list[float]:
    """z of a translation, of the windows about some times: above 3 it is seen.

    Windows that hold too few events are left out.
    """
    found = [_told(recording, camera, guess) for guess in guesses]
    return [z for z in found if z is not None]


def _told(recording: Recording, camera: PinholeCamera, guess: Guess) -> float | None:
    half = min(max(WAY / 2 / guess.speed, SHORTEST), LONGEST)
    centre = guess.centre
    windows = Windows(recording, Params.of({"half_window": half}), camera)
    first, last = windows.rows(centre, half)
    if last - first < windows.params.fewest:
        return None
    trial = windows.trial(centre)
    nodes = np.prod(trial.tracks.nodes)
    level = np.log(PARALLAX * guess.speed / windows.f)

    def constant(heading: NDArray, turn: NDArray, log_rho: float) -> Path:
        return Path.constant(heading, turn, np.full(nodes, log_rho, windows.real))

    still = constant(guess.heading, guess.turn, FAR)
    moving = [
        constant(guess.heading, guess.Omega, level),
        constant(-guess.heading, guess.Omega, level),
        constant(guess.heading, guess.turn, level),
    ]
    moving[0] = Path(moving[0].O, moving[0].D, depths(moving[0], trial.tracks))
    fits = side_by_side(lambda path: trial.fit(path, moves=path is not still), [still, *moving])
    return max(trial.z(fits[0], fit) for fit in fits[1:])
