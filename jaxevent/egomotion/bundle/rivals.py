"""Rival scenes of a window compared on pixels that neither was fitted to.

Both at one sigma, from the same map's beginnings: d_e is by how much more an event costs under one
than under the other, and D_c its sum over cells of 48 px, which err independently:

    z = sum_c D_c / sqrt(sum_c D_c^2)

Single events would claim more: those of a cell see the same edges.
"""

import dataclasses

import numpy as np
from numpy.typing import NDArray

from jaxevent.egomotion.bundle.path import Path, Prior
from jaxevent.egomotion.bundle.photometric import adjust, begin
from jaxevent.egomotion.bundle.tracks import Scene, Tracks
from jaxevent.egomotion.bundle.weighing import subtract_mean

CELL = 48  # px, within which errors are alike
FAR = -9.0  # log inverse depth that makes no parallax
SIGMA = 0.1  # C, at least
SETTLE, STEPS = 4, 16  # of the map alone, and in all
TELLING = 3.0  # z, from which there is a translation
REFUTED = 2.0  # z of another motion, from which one is not possible


@dataclasses.dataclass(frozen=True)
class Trial:
    """Pixels of a window that rivals are fitted to, and others on which they are compared."""

    tracks: Tracks
    left_out: Tracks
    prior: Prior
    sigma: float  # C, the same for all

    def fit(self, path: Path, *, moves: bool = True, steps: int = STEPS) -> Scene:
        """A scene fitted from a path; unless it `moves` by rotation alone."""
        return fitted(self.tracks, path, self.prior, self.sigma, moves=moves, steps=steps)

    def rotation(
        self,
        path: Path,
        sharpest: NDArray[np.float64],
        moving: Scene,
        *,
        begun: bool = False,
    ) -> tuple[Scene, float]:
        """What rotation alone makes of a path, or from the sharpest one (rad/s) if that is better.

        And z of the `moving` scene over that of both which it refutes least: on evbench_seq3 this
        is 2 to 2.7, and over the better one up to 3.4, since z counts how sure a difference is.

        A path may have come to a false turn with a translation that makes up for it, from which
        rotation alone does not find back: on evbench_seq3 260 % off, from the sharpest 9.5 %.
        Where both explain less than the `moving` scene as soon as their maps are made they are left
        at that: steps of the rotation hardly change z. Where they do not, and that scene has only
        `begun`, it is fitted from the path.
        """

        first = without_translation(path)
        turn = np.zeros_like(path.O)
        turn[0] = sharpest
        paths = first, Path(turn, first.D, first.log_rho)
        settled = [self.fit(one, moves=False, steps=SETTLE) for one in paths]
        z = self.over_all(settled, moving)
        if z >= TELLING:
            return self.likelier(*settled), z
        ended = [self.fit(one, moves=False) for one in paths]
        if begun and self.over_all(ended, moving) < TELLING:
            moving = self.fit(path)
            z = self.over_all(settled, moving)
            if z >= TELLING:
                return self.likelier(*settled), z
        return self.likelier(*ended), self.over_all(ended, moving)

    def over_all(self, scenes: list[Scene], moving: Scene) -> float:
        """z of the `moving` scene over that of the scenes which it refutes least."""
        return min(self.z(one, moving) for one in scenes)

    def likelier(self, one: Scene, other: Scene) -> Scene:
        """The scene under which events left out cost less."""
        return other if self.z(one, other) > 0 else one

    def z(self, one: Scene, other: Scene) -> float:
        """Of `other` over `one`, above 0 where events left out cost less under `other`."""
        return compared(self.left_out, one, other, self.prior, self.sigma)

    def best(self, scenes: list[Scene]) -> int:
        """Which scene to take: the first, or what is furthest before it, if it is refuted."""
        z = [0.0, *(self.z(scenes[0], other) for other in scenes[1:])]
        best = int(np.argmax(z))
        return best if z[best] > REFUTED else 0


def without_translation(path: Path) -> Path:
    """A rotation before a scene at infinity, that makes about the flow of the path.

    At the usual depth T_x and T_y do in the middle of the image what T_x rho does as Omega_y and
    -T_y rho as Omega_x.
    """
    rho, O = float(np.exp(np.median(path.log_rho))), path.O.copy()  # noqa: E741
    O[0] += rho * np.array([-path.D[0, 1], path.D[0, 0], 0])
    return Path(O, path.D, np.full_like(path.log_rho, FAR))


def fitted(
    tracks: Tracks,
    path: Path,
    prior: Prior,
    sigma: float,
    *,
    moves: bool = True,
    steps: int = STEPS,
) -> Scene:
    """A scene fitted from a path, at one sigma at last; unless it `moves` by rotation alone."""
    prior = prior._replace(moves=moves)
    scene = Scene(path, np.zeros(tracks.shape, tracks.x.dtype), prior.skew)
    scene, _ = adjust(tracks, scene, prior, sigma=1.0, settle=2, steps=2)
    return adjust(tracks, scene, prior, sigma=sigma, settle=SETTLE, steps=steps)[0]


def _costs(tracks: Tracks, scene: Scene, prior: Prior, sigma: float) -> tuple[NDArray, NDArray]:
    """Of events, and which of them lie inside the map."""
    problem, seen = begin(tracks, scene, prior, sigma, plane=False)
    left, on = seen.e.copy(), seen.places.inside
    subtract_mean(left, on, tracks.begin)
    return left**2 / (1 + left**2 / problem.limit), on


def compared(tracks: Tracks, one: Scene, other: Scene, prior: Prior, sigma: float) -> float:
    """z of `other` over `one`, above 0 where events of these pixels cost less under `other`."""
    (a, on), (b, both) = (_costs(tracks, scene, prior, sigma) for scene in (one, other))
    D = np.asarray((a - b) * on * both, np.float64)
    across, down = (tracks.x - tracks.corner[0]) // CELL, (tracks.y - tracks.corner[1]) // CELL
    cell = (down * (tracks.shape[1] // CELL + 1) + across).astype(int)
    sums = np.bincount(np.maximum(cell, 0), D)
    size = float(np.sqrt((sums**2).sum()))
    return float(sums.sum()) / size if size > 0 else 0.0
