"""A window's events pixel by pixel, the scene that they show, and where it puts them."""

import dataclasses
from typing import NamedTuple

import numpy as np
import scipy.ndimage
from numpy.typing import NDArray

from jaxevent.egomotion.bundle.path import Path
from jaxevent.egomotion.bundle.placing import Grids, Points, place
from jaxevent.egomotion.bundle.weighing import read_map, subtract_mean

SIDE = 4  # nodes about an event among whose depths its own is


@dataclasses.dataclass(frozen=True)
class Tracks:
    """Events of a window in tracks, each a pixel's, one after another.

    Arrays of events are (E,): place `x`, `y` (px, undistorted, from the principal point), `tau` (s
    from the reference time), `level`, the sum of the track's polarities up to and with it, `number`
    of these, and its polarity `p`, +-1. Those of track k begin at `begin[k]`, (tracks + 1,). After
    `events` of them there may be pixels of frames, `number` and `p` 0, in a track for each frame
    (`frames`). `trust` divides the noise of an event by their own, at most 1.
    """

    x: NDArray
    y: NDArray
    tau: NDArray
    level: NDArray
    number: NDArray
    p: NDArray
    trust: NDArray
    events: int
    begin: NDArray[np.int64]
    f: float  # px
    half: float  # s
    shape: tuple[int, int]  # of the map
    corner: tuple[float, float]  # px, where its pixel [0, 0] lies
    node: int  # px between nodes of depth

    @property
    def points(self) -> Points:
        return Points(self.x, self.y, self.tau)

    @property
    def nodes(self) -> tuple[int, int]:
        """Rows and columns of nodes."""
        height, width = self.shape
        return (height - 2) // self.node + 2, (width - 2) // self.node + 2

    @property
    def grids(self) -> Grids:
        (x, y), (height, width), (rows, columns) = self.corner, self.shape, self.nodes
        return Grids(float(x), float(y), height, width, float(self.node), rows, columns)

    @property
    def places(self) -> tuple[NDArray, NDArray]:
        """Where nodes lie in the reference view: x and y (px), row by row."""
        rows, columns = self.nodes
        j, i = np.divmod(np.arange(rows * columns), columns)
        return self.corner[0] + i * self.node, self.corner[1] + j * self.node


class Scene(NamedTuple):
    """The unknowns: path with log depths at nodes, map of log intensity, difference of thresholds.

    The map is in units of the mean threshold C; C (1 + skew) is that of ON, C (1 - skew) of OFF.
    """

    path: Path
    map: NDArray  # (height, width)
    skew: float


class Places(NamedTuple):
    """Where events are in the reference view, which splines they are of, and the map's value."""

    X: NDArray
    Y: NDArray
    depth: NDArray  # log inverse depths
    first: NDArray[np.int32]
    u: NDArray
    v: NDArray
    inside: NDArray
    value: NDArray


def placed(
    path: Path, tracks: Tracks, before: NDArray | None = None
) -> tuple[NDArray, NDArray, NDArray]:
    """Where events are in the reference view and their log depths (`placing.place`).

    From those `before`, of a scene that is about the same, it is quicker.
    """
    X, Y = np.empty_like(tracks.x), np.empty_like(tracks.x)
    root = np.full_like(tracks.x, -np.inf) if before is None else before.copy()
    # Of nodes within reach the nearest and the farthest depth.
    depth = np.ascontiguousarray(path.log_rho)
    of, size = depth.reshape(tracks.nodes), 2 * SIDE + 1
    high = scipy.ndimage.maximum_filter(of, size, mode="nearest").ravel()
    low = scipy.ndimage.minimum_filter(of, size, mode="nearest").ravel()
    place(tracks.points, path.motion(tracks.f), depth, high, low, tracks.grids, root, X, Y)
    return X, Y, root


def read(
    scene: Scene, tracks: Tracks, before: Places | None = None, *, stays: bool = False
) -> Places:
    """What the scene shows where it puts the events: near those `before`, there if it `stays`."""
    if before is not None and stays:
        X, Y, depth = before.X, before.Y, before.depth
    else:
        X, Y, depth = placed(scene.path, tracks, None if before is None else before.depth)
    u, v, inside, value = (np.empty_like(X) for _ in range(4))
    first = np.empty(len(X), np.int32)
    read_map(scene.map.ravel(), X, Y, tracks.grids, first, u, v, inside, value)
    return Places(X, Y, depth, first, u, v, inside, value)


def misfits(scene: Scene, tracks: Tracks) -> NDArray:
    """L(x_e) - s_e less its mean over the track's events, in units of C; 0 beyond the map."""
    there = read(scene, tracks)
    left = there.value - tracks.level - scene.skew * tracks.number
    left = left.astype(tracks.x.dtype)
    subtract_mean(left, there.inside, tracks.begin)
    return there.inside * left
