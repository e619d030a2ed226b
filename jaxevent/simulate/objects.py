"""Textured objects that move on their own before a moving background, with the true flow."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates, spline_filter

from jaxevent.deprecated import renamed_names, warn_renamed
from jaxevent.errors import InputError

# Signed distance (px) of points x, y from a shape's edge, negative inside; distances are of the
# nearest straight part, which differs from the true one only outside of corners.
Distance = Callable[[NDArray, NDArray, float], NDArray]

_TILE_PX = 256  # after which a texture repeats
# Layers of a texture: standard deviation (px) of the Gaussian that each is made of, and its weight.
_LAYERS = ((1.5, 0.4), (4.0, 0.8), (12.0, 0.6))
_MARGIN_PX = 2  # around an object, in which it is drawn


def _disc(x: NDArray, y: NDArray, r: float) -> NDArray:
    return np.hypot(x, y) - r


def _box(x: NDArray, y: NDArray, r: float) -> NDArray:
    return np.maximum(abs(x) - r, abs(y) - 0.6 * r)


def _triangle(x: NDArray, y: NDArray, r: float) -> NDArray:
    # An equilateral one, its corners r from the middle and its edges r / 2.
    return np.maximum(np.sqrt(0.75) * abs(x) + y / 2, -y) - r / 2


def _diamond(x: NDArray, y: NDArray, r: float) -> NDArray:
    return (abs(x) + abs(y) - r) / np.sqrt(2)


def _cross(x: NDArray, y: NDArray, r: float) -> NDArray:
    bar, post = (np.maximum(abs(a) - r, abs(b) - r / 3) for a, b in ((x, y), (y, x)))
    return np.minimum(bar, post)


OBJECT_SHAPES: tuple[Distance, ...] = (_disc, _box, _triangle, _diamond, _cross)


class MovingSurface(NamedTuple):
    """The background or an object, with a texture that moves with it."""

    distance: Distance | None  # None: everywhere
    radius: float  # px
    middle: NDArray[np.floating]  # (2,), x and y of the middle of its motion, px
    swing: NDArray[np.floating]  # (2,), amplitude along x and y, px
    rate: NDArray[np.floating]  # (2,), rad/s
    phase: NDArray[np.floating]  # (2,), rad
    spline: NDArray[np.floating]  # coefficients of a texture of unit variance
    light: float  # mean intensity
    contrast: float  # largest deviation of the intensity from it

    def position(self, t: float | int) -> NDArray[np.floating]:
        """Return x and y (px) at t seconds, (2,)."""
        return self.middle + self.swing * np.sin(self.rate * t + self.phase)

    def place(self, t: float | int) -> NDArray[np.floating]:
        """Return `position`; the old name of the method."""
        warn_renamed("MovingSurface.place", "MovingSurface.position")
        return self.position(t)

    def velocity(self, t: float | int) -> NDArray[np.floating]:
        """Return the velocity (px/s) at t seconds, (2,)."""
        return self.swing * self.rate * np.cos(self.rate * t + self.phase)

    def covers(self, x: NDArray, y: NDArray, t: float | int) -> NDArray[np.bool_]:
        """Return which points of the image lie on the surface.

        Args:
            x: (n,) columns, px; broadcast with `y`.
            y: (n,) rows, px.
            t: Time, s.

        Returns:
            (n,), True where the surface is.
        """
        if self.distance is None:
            return np.ones(np.broadcast(x, y).shape, bool)
        px, py = self.position(t)
        return self.distance(x - px, y - py, self.radius) < 0

    def intensity(self, x: NDArray, y: NDArray) -> NDArray[np.float64]:
        """Return the intensity of points of the surface.

        Args:
            x: (n,) offsets from its position along x, px; broadcast with `y`.
            y: (n,) offsets along y, px.

        Returns:
            (n,) linear intensity.
        """
        at = np.broadcast_arrays(y, x)
        grain = map_coordinates(self.spline, at, order=3, mode="grid-wrap", prefilter=False)
        return self.light + self.contrast * np.tanh(grain)


@dataclasses.dataclass(frozen=True)
class MovingObjects:
    """Five textured objects before a moving background, an `IntensitySource` with known flow.

    A disc, a box, a triangle, a diamond and a cross swing about different points, sideways and up
    and down at different rates, so that they are always accelerated. The speed of each, its root
    mean square over time, is drawn within `spread` of `speed`; the background's is the part
    `background` of `speed`. Nearer objects hide farther ones. Edges cover pixels in part.
    Intensities lie between 0.1 and 0.9, which frames show without clipping. Deterministic in
    `seed`.

    Surfaces are numbered: 0 is the background, higher ones are nearer. Flow and displacement are
    those of the surface at a pixel's middle, x before y.

    Raises:
        InputError: There are fewer than 32x32 pixels, the speed or background is negative, or the
            spread is outside [0, 1).
    """

    size: tuple[int, int] = (160, 120)  # width, height, px
    duration: float | int = 1.0  # s
    speed: float | int = 90.0  # px/s
    spread: float | int = 0.6
    seed: int = 0
    background: float | int = 0.4

    def __post_init__(self) -> None:
        if not 0 <= self.background < np.inf:
            raise InputError(
                f"a background of {self.background} times the objects' speed is not possible; "
                "give a number from 0"
            )
        if min(self.size) < 32 or not 0 <= self.speed < np.inf or not 0 <= self.spread < 1:
            raise InputError(
                f"objects of {self.speed} px/s within {self.spread} of it on {self.size[0]}x"
                f"{self.size[1]} pixels are not possible; give a speed from 0, a spread in [0, 1) "
                "and at least 32x32 pixels"
            )

    def intensity(self, t: float | int) -> NDArray[np.float64]:
        """Return the linear intensity (height, width) at t seconds."""
        y, x = self._grid
        image: Any = None
        for surface in self.surfaces:
            px, py = surface.position(t)
            if surface.distance is None:
                image = surface.intensity(x - px, y - py)
                continue
            reach = surface.radius + _MARGIN_PX
            rows, columns = (
                slice(max(int(p - reach), 0), max(int(p + reach) + 2, 0)) for p in (py, px)
            )
            dx, dy = x[:, columns] - px, y[rows] - py
            if dx.size and dy.size:
                share = np.clip(0.5 - surface.distance(dx, dy, surface.radius), 0, 1)
                part = image[rows, columns]
                part += share * (surface.intensity(dx, dy) - part)
        return image

    def visible(self, t: float | int) -> NDArray[np.int64]:
        """Return the number of the surface that each pixel shows, (height, width), at t seconds."""
        y, x = self._grid
        number = np.zeros((self.size[1], self.size[0]), np.int64)
        for k, surface in enumerate(self.surfaces):
            number[surface.covers(x, y, t)] = k
        return number

    def flow(self, t: float | int) -> NDArray[np.floating]:
        """Return the optical flow (height, width, 2) at t seconds, px/s."""
        return np.array([surface.velocity(t) for surface in self.surfaces])[self.visible(t)]

    def displacement(
        self, t0: float | int, t1: float | int
    ) -> tuple[NDArray[np.floating], NDArray[np.bool_]]:
        """Return the displacement of the points that pixels show, between two times.

        Args:
            t0: Time at which pixels show the points, s.
            t1: Time to which they move, s.

        Returns:
            Displacements (height, width, 2), px, and which points (height, width) are hidden at t1,
            behind a nearer surface or outside the image.
        """
        y, x = self._grid
        number = self.visible(t0)
        moves = np.array([one.position(t1) - one.position(t0) for one in self.surfaces])[number]
        x, y = x + moves[..., 0], y + moves[..., 1]
        width, height = self.size
        hidden = (x < -0.5) | (x > width - 0.5) | (y < -0.5) | (y > height - 0.5)
        for k, surface in enumerate(self.surfaces):
            hidden |= surface.covers(x, y, t1) & (k > number)
        return moves, hidden

    @functools.cached_property
    def surfaces(self) -> tuple[MovingSurface, ...]:
        """The background and the objects, from far to near."""
        rng = np.random.default_rng(self.seed)
        size = np.array(self.size, float)
        shapes: list[Distance | None] = [
            None,
            *(OBJECT_SHAPES[k] for k in rng.permutation(len(OBJECT_SHAPES))),
        ]
        # Middles about a ring, from where all objects come across one another.
        angles = rng.uniform(0, 2 * np.pi) + 2 * np.pi * np.arange(len(OBJECT_SHAPES)) / len(
            OBJECT_SHAPES
        )
        lights = rng.permutation(np.linspace(0.3, 0.7, len(OBJECT_SHAPES)))
        surfaces = []
        for k, shape in enumerate(shapes):
            swing = size * rng.uniform(0.15, 0.25, 2)
            speed = self.speed * rng.uniform(1 - self.spread, 1 + self.spread)
            middle, light, contrast = (size - 1) / 2, 0.5, 0.25
            if shape is None:
                speed = self.speed * self.background
            else:
                turn = np.array([np.cos(angles[k - 1]), np.sin(angles[k - 1])])
                middle, light, contrast = middle + 0.22 * size * turn, lights[k - 1], 0.2
            surfaces.append(
                MovingSurface(
                    shape,
                    float(size.min() * rng.uniform(0.12, 0.2)),
                    middle,
                    swing,
                    # The mean square of a sine is a half, and there are two of them.
                    speed / swing,
                    rng.uniform(0, 2 * np.pi, 2),
                    _texture(rng),
                    float(light),
                    contrast,
                )
            )
        return tuple(surfaces)

    @functools.cached_property
    def _grid(self) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
        """Rows (height, 1) and columns (1, width) of the pixels."""
        width, height = self.size
        return np.arange(height)[:, None] * 1.0, np.arange(width)[None] * 1.0


def _texture(rng: np.random.Generator) -> NDArray[np.floating]:
    """Draw the spline coefficients of a texture of unit variance, fine and coarse."""
    noise = np.zeros((_TILE_PX, _TILE_PX))
    for deviation, weight in _LAYERS:
        grain = gaussian_filter(rng.normal(size=noise.shape), deviation, mode="wrap")
        noise += weight * grain / grain.std()
    return spline_filter(noise / noise.std(), 3, mode="grid-wrap")


__getattr__ = renamed_names(__name__)
