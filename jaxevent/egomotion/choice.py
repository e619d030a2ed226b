"""Which model explains a recording: planar motion, rotation or general motion, by held-out events.

    choice = choose(recording)
    choice.model, choice.lines   # the simplest that explains it, and what was found, in words

At some times patches of the image are looked at (`patches.look`). Every model is fitted to one half
of the pixels: it says which way each patch took, along its half-line any way that fits if it has
one. On the other half, D_p is by how much the log of a patch's sharpness is larger under one model
than under another; patches err independently, so z = sum D_p / sqrt(sum D_p^2) is standard normal
where both explain it alike.
"""

import dataclasses
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from scipy.optimize import minimize

from jaxevent.camera import PinholeCamera
from jaxevent.egomotion.candidates import coordinates
from jaxevent.egomotion.geometry import A, rotation_basis
from jaxevent.egomotion.models import General, Model, Planar, Rotation
from jaxevent.egomotion.patches import LENGTHS, Look, Speed, look, middles, usual_speed
from jaxevent.errors import InputError
from jaxevent.recording import Recording

TIMES = 4  # at which patches are looked at
REACH = 10  # px, the longest way that is tried, in x and y
WAY = 5.0  # px, that the image usually moves in a window
Z = 3.0  # from which one model explains more than another
# Half-lines fit an edge's ambiguity too, on both halves: simulated rotation and planar motion reach
# 3.8, simulated depth 3.5 and more.
Z_DEPTH = 4.0
SPEEDS = np.linspace(0, 1.4 * REACH, 29)  # px along a half-line
HEADINGS = 6  # that a general motion is looked for from
FACTORS = np.geomspace(0.3, 3.0, 25)  # of the usual speed, by patches


@dataclasses.dataclass(frozen=True)
class Choice:
    """The model, lines to print, and z of the more general models against the simpler ones."""

    model: type[Model]
    lines: tuple[str, ...]
    z: dict[tuple[str, str], float]


@dataclasses.dataclass(frozen=True)
class Layers:
    """How differently parts of the image move, along the usual direction.

    `spread` is the standard deviation of their speeds, in shares of the usual one, `z` how sure it
    is that they differ, and `slow` and `fast` (px/s) bound the middle four fifths of them.
    """

    spread: float
    z: float
    slow: float
    fast: float

    @property
    def several(self) -> bool:
        """Whether the image does not move as one."""
        return self.z > Z


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


def _along(seen: Look, f: float, T: NDArray, turn: NDArray) -> NDArray[np.float64]:
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
            f"{recording.name}: nothing is seen to move in windows of 1.6 ms to 1.6 s; name the "
            "model of its motion"
        )
    if camera is None:
        line = "planar motion, since there is no calibration, which the others need"
        return Choice(Planar, (line,), {})
    _, f = coordinates(recording.width, recording.height, camera)
    told: dict[str, list[NDArray]] = {"planar": [], "rotation": [], "general": []}
    for one in seen:
        d = planar(one)
        turn = rotation(one, f, d)
        six = general(one, f, turn)
        ways = _along(one, f, six[:3], six[3:])
        pick = sharpness(one, 0, ways).argmax(0)
        told["planar"].append(sharpness(one, 1, np.tile(d, (len(one.xi), 1))))
        told["rotation"].append(sharpness(one, 1, np.asarray(rotation_basis(one.xi, f)) @ turn))
        told["general"].append(sharpness(one, 1, ways[pick, np.arange(len(one.xi))]))
    every = {name: np.concatenate(parts) for name, parts in told.items()}
    z = {
        pair: standard(every[pair[0]] - every[pair[1]])
        for pair in (("rotation", "planar"), ("general", "planar"), ("general", "rotation"))
    }
    # Where these two do equally well, a camera that turns is likelier than a scene before one wall.
    simple = Rotation if z["rotation", "planar"] > -Z else Planar
    chosen = General if z["general", simple.name] > Z_DEPTH else simple
    lines = [
        f"{one} explains events left out {_than(value)} {other} (z = {value:.1f})"
        for (one, other), value in z.items()
    ]
    lines.append(f"chosen: {chosen.title}")
    if chosen is Rotation:
        lines.append(
            "this is not sure: general motion with little parallax, as before one wall, looks the "
            "same in short windows; --model general fits longer ones and says whether there is any"
        )
    return Choice(chosen, tuple(lines), z)


def _than(z: float) -> str:
    return "better than" if z > Z else "worse than" if z < -Z else "as well as"


def standard(D: NDArray[np.float64]) -> float:
    """The sum of independent differences, in its standard deviation."""
    size = float(np.sqrt((D**2).sum()))
    return float(D.sum()) / size if size > 0 else 0.0


def layers(
    recording: Recording,
    model: type[Model] = Planar,
    camera: PinholeCamera | None = None,
) -> Layers | None:
    """Whether the image moves as one, as planar motion or a rotation does; None where nothing is
    seen to move, and of other models.

    Every patch may go its own share of the way that the model makes there.
    """
    camera = camera or recording.camera
    speed = usual_speed(recording, camera) if model in (Planar, Rotation) else None
    seen = [] if speed is None else looks(recording, speed, camera)
    _, f = coordinates(recording.width, recording.height, camera)
    differ, factors, speeds = [], [], []
    for one in seen:
        d = planar(one)
        if float(np.hypot(*d)) < 1:
            continue
        ways = np.tile(d, (len(one.xi), 1))
        if model is Rotation:
            ways = np.asarray(rotation_basis(one.xi, f)) @ rotation(one, f, d)
        own = np.append(FACTORS, 1.0)[:, None, None] * ways
        train = sharpness(one, 0, own)
        pick, at = train.argmax(0), np.arange(len(one.xi))
        differ.append(sharpness(one, 1, own[pick, at]) - sharpness(one, 1, own[-1]))
        telling = train.max(0) - train[-1] + train.max(0) - np.median(train, 0) > np.log(1.3)
        factor = np.append(FACTORS, 1.0)[pick][telling]
        factors.append(factor)
        speeds.append(factor * np.hypot(*ways[telling].T) / one.length)
    if not factors or not len(np.concatenate(factors)):
        return None
    factor, speed_of = np.concatenate(factors), np.concatenate(speeds)
    low, high = np.percentile(factor, [16, 84])
    slow, fast = np.percentile(speed_of, [10, 90])
    usual = float(np.median(factor))
    spread = float((high - low) / 2 / max(usual, 1e-9))
    return Layers(spread, standard(np.concatenate(differ)), float(slow), float(fast))
