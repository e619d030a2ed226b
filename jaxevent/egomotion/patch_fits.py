"""Models fitted to how patches of the image move (`patches`): the way that each patch took.

Every model is fitted to one half of the pixels; the other half tells how sharp patches become by
the ways that it makes.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from scipy.optimize import minimize

from jaxevent.camera import PinholeCamera
from jaxevent.egomotion.candidates import coordinates
from jaxevent.egomotion.geometry import A, rotation_basis
from jaxevent.egomotion.patches import LENGTHS, Look, Speed, look, middles
from jaxevent.recording import Recording

TIMES = 4  # at which patches are looked at
REACH = 10  # px, the longest way that is tried, in x and y
WAY = 5.0  # px, that the image usually moves in a window
SPEEDS = np.linspace(0, 1.4 * REACH, 29)  # px along a half-line
HEADINGS = 6  # that a general motion is looked for from


def looks(recording: Recording, speed: Speed, camera: PinholeCamera | None = None) -> list[Look]:
    """Patches at some times, of windows in which the image moves by a few px."""
    found = []
    xi, _ = coordinates(recording.width, recording.height, camera or recording.camera)
    for middle in middles(recording, TIMES):
        near = [(abs(t - middle), v) for t, v in speed.at if np.isfinite(v)]
        usual = min(near)[1] if near else speed.usual
        length = LENGTHS[np.abs(np.log(LENGTHS * usual / WAY)).argmin()]
        seen = look(recording, middle, float(length), REACH, xi)
        if seen is not None:
            found.append(seen)
    return found


def sharpness(seen: Look, half: int, ways: NDArray[np.float64]) -> NDArray[np.float64]:
    """The log of how sharp one half of each patch is by ways (..., patches, 2) in px."""
    at = np.clip(ways + REACH, 0, 2 * REACH)
    patch = np.broadcast_to(np.arange(len(seen.xi)), at.shape[:-1])
    values = np.log(np.maximum(seen.energy[half], 1e-6))
    return map_coordinates(values, [patch, at[..., 1], at[..., 0]], order=1, mode="nearest")


def _best(loss: Callable[[NDArray], float], starts: list[NDArray], size: float) -> NDArray:
    options = {"maxiter": 250, "xatol": 1e-3 * size, "fatol": 1e-3}
    found = []
    for start in starts:
        simplex = np.concatenate([start[None], start + size * np.eye(len(start))])
        options["initial_simplex"] = simplex
        found.append(minimize(loss, start, method="Nelder-Mead", options=options))
    return min(found, key=lambda one: one.fun).x


def planar(seen: Look) -> NDArray[np.float64]:
    """The way (2,) in px of all patches alike."""
    n = len(seen.ways)
    sums = np.log(np.maximum(seen.energy[0], 1e-6)).sum(0)
    row, column = divmod(int(sums.argmax()), n)
    start = seen.ways[[column, row]]
    return _best(
        lambda d: -float(sharpness(seen, 0, np.tile(d, (len(seen.xi), 1))).sum()), [start], 0.5
    )


def rotation(seen: Look, f: float, start: NDArray[np.float64]) -> NDArray[np.float64]:
    """The turn (3,) in rad over the window, from the planar way on."""
    basis = np.asarray(rotation_basis(seen.xi, f))
    first = np.array([start[1] / f, -start[0] / f, 0.0])
    roll = 2.0 / max(float(np.hypot(*seen.xi.T).mean()), 1.0)
    starts = [first + np.array([0, 0, k * roll]) for k in (-2, 0, 2)]
    starts.append(np.zeros(3))
    unit = np.array([1 / f, 1 / f, roll / 2])

    def loss(v: NDArray) -> float:
        return -float(sharpness(seen, 0, basis @ (v * unit)).sum())

    return _best(loss, [one / unit for one in starts], 1.0) * unit


def along(seen: Look, f: float, T: NDArray, turn: NDArray) -> NDArray[np.float64]:
    """Ways (speeds, patches, 2) along the half-lines of a general motion."""
    base = np.asarray(rotation_basis(seen.xi, f)) @ turn
    line = np.einsum("pij,j->pi", _translations(seen.xi, f), T)
    line /= np.maximum(np.linalg.norm(line, axis=1, keepdims=True), 1e-9)
    return base + SPEEDS[:, None, None] * line


def _translations(xi: NDArray[np.float64], f: float) -> NDArray[np.float64]:
    return np.stack([np.asarray(A(x, y, f)) for x, y in xi])


def general(seen: Look, f: float, turn: NDArray[np.float64]) -> NDArray[np.float64]:
    """Heading and turn (6,) of highest sharpness, every patch as fast as fits it best."""
    columns = _translations(seen.xi, f)
    basis = np.asarray(rotation_basis(seen.xi, f))

    def ways(v: NDArray) -> NDArray:
        line = columns @ v[:3]
        line = line / np.maximum(np.linalg.norm(line, axis=1, keepdims=True), 1e-9)
        return basis @ (v[3:] / f) + SPEEDS[:, None, None] * line

    def loss(v: NDArray) -> float:
        size = float(np.linalg.norm(v[:3]))
        return -float(sharpness(seen, 0, ways(v)).max(0).sum()) + 10 * (size - 1) ** 2

    tried = np.random.default_rng(0).normal(size=(40, 3))
    tried /= np.linalg.norm(tried, axis=1, keepdims=True)
    tried = np.concatenate([tried, np.eye(3), -np.eye(3)])
    firsts = [np.append(T, part * f * turn) for T in tried for part in (0.0, 0.5, 1.0)]
    firsts = sorted(firsts, key=loss)[:HEADINGS]
    found = _best(loss, firsts, 0.3)
    return np.append(found[:3] / np.linalg.norm(found[:3]), found[3:] / f)


def standard(D: NDArray[np.float64]) -> float:
    """The sum of independent differences, in its standard deviation."""
    size = float(np.sqrt((D**2).sum()))
    return float(D.sum()) / size if size > 0 else 0.0
