"""Whether a camera moved or only turned, by pixels that are left out of fits of whole windows.

A rotation and general motions are fitted to a part of the pixels of a window (`rivals`). In its
length the image moves by `WAY`, several times farther than in the windows of patches, so that what
a little parallax adds up to is seen, edges in all directions together.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.camera import PinholeCamera
from jaxevent.egomotion.bundle.depths import depths
from jaxevent.egomotion.bundle.path import Path
from jaxevent.egomotion.bundle.rivals import FAR
from jaxevent.egomotion.bundle.starts import side_by_side
from jaxevent.egomotion.bundle.windows import Params, Windows
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


class Told(NamedTuple):
    """z of a translation in a window, and which events it holds, the first and after the last."""

    z: float
    first: int
    last: int


def told(recording: Recording, camera: PinholeCamera, guesses: list[Guess]) -> float | None:
    """z of a translation, of the windows about some times: above 3 it is seen.

    None where all windows hold too few events.
    """
    found = [_told(recording, camera, guess) for guess in guesses]
    return together([one for one in found if one is not None])


def together(windows: list[Told]) -> float | None:
    """z of some windows, None of none.

    Each is standard normal where nothing moves; two windows that share events correlate by the
    number of these over the geometric mean of their own: windows of a recording that is shorter
    than they are hold the same events, and two of them tell no more than one.
    """
    if not windows:
        return None
    z, first, last = np.array(windows, np.float64).T
    shared = np.minimum(last, last[:, None]) - np.maximum(first, first[:, None])
    own = np.sqrt(last - first)
    alike = np.maximum(shared, 0) / (own * own[:, None])
    return float(z.sum() / np.sqrt(alike.sum()))


def _told(recording: Recording, camera: PinholeCamera, guess: Guess) -> Told | None:
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
    return Told(max(trial.z(fits[0], fit) for fit in fits[1:]), first, last)
