"""Scenes of high dynamic range, a camera that moves over them, and objects that move themselves."""

import dataclasses
import functools
import math
import zlib
from collections.abc import Callable
from typing import Any, Literal, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter, map_coordinates, spline_filter, uniform_filter

from jaxevent.deprecated import renamed_names
from jaxevent.errors import InputError
from jaxevent.recording import Times, microseconds

Speed = Literal["slow", "fast"]

# px/s at the image centre; the speed varies by a third about it.
PAN_SPEEDS_PX_S = {"slow": 30.0, "fast": 300.0}

# The lens: a Gaussian point spread, and a wide one, its glare, with a part of the light.
_BLUR_PX, _GLARE_PX, _GLARE_SHARE = 1.1, 12.0, 2e-4
# A second blur, of the logarithm: linear blur alone leaves a step of 10 in ln I 4.5 / px steep.
_LOG_BLUR_PX = 1.0
# Beyond a panorama's edges: mirrored vertically, periodic horizontally.
_EDGES: Any = ("reflect", "wrap")


def parse_seconds(times: Times, duration: float | int) -> NDArray[np.float64]:
    """Convert times to seconds, and check that the truth is known then.

    Args:
        times: (T,) integer us or float s.
        duration: Length of the simulation, s.

    Returns:
        (T,) s.

    Raises:
        InputError: A time is outside the simulation.
    """
    us, given = np.atleast_1d(microseconds(times)), np.atleast_1d(np.asarray(times))
    if ((us < 0) | (us > math.ceil(duration * 1e6))).any():
        raise InputError(
            f"the truth is known from 0 to {duration} s, not at {us.min()} to {us.max()} us; "
            "integers are microseconds, floats seconds"
        )
    return np.asarray(given if given.dtype.kind == "f" else us * 1e-6, np.float64)


@runtime_checkable
class IntensitySource(Protocol):
    """A scene for the simulated sensor."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        ...

    @property
    def duration(self) -> float | int:
        """Length in seconds; intensity is defined for 0 <= t <= duration."""
        ...

    def intensity(self, t: float | int) -> NDArray[np.float64]:
        """Return the linear intensity (height, width) at t seconds, positive; 1 is white."""
        ...


class _Canvas:
    """A canvas of ln intensity, whose left and right edges meet.

    Lengths are in pixels of a canvas of height 512, and scale with its height.
    """

    def __init__(self, size: tuple[int, int], rng: np.random.Generator):
        self.width, self.height = size
        self.unit = self.height / 512
        self.rng = rng
        self.level = np.zeros((self.height, self.width))
        self.y, self.x = np.mgrid[: self.height, : self.width] / self.unit
        self.columns = self.width / self.unit  # in units

    def noise(
        self, slope: float | int, longest: float | int = 200.0, stretch: float | int = 1.0
    ) -> NDArray:
        """Draw periodic noise of unit variance; its amplitude falls as frequency^-slope.

        Args:
            slope: The exponent.
            longest: Wavelength above which waves are damped, in units of the canvas.
            stretch: Factor by which noise is drawn out horizontally.

        Returns:
            (height, width).
        """
        fy = np.fft.fftfreq(self.height)[:, None] * self.unit
        fx = np.fft.rfftfreq(self.width) * self.unit * stretch
        f = np.hypot(fx, fy)
        amplitude = (f**2 + longest**-2.0) ** (-slope / 2)
        amplitude[0, 0] = 0
        white = np.fft.rfft2(self.rng.normal(size=self.level.shape))
        noise = np.fft.irfft2(white * amplitude, self.level.shape)
        return noise / noise.std()

    def away(self, x: float | int, y: float | int) -> tuple[NDArray, NDArray]:
        """Return the offsets of every pixel from a point, the short way round.

        Args:
            x: Place of the point along x, in units of the canvas.
            y: Place along y, likewise.

        Returns:
            Offsets along x (height, width) and y (height, width), in units of the canvas.
        """
        return (self.x - x + self.columns / 2) % self.columns - self.columns / 2, self.y - y

    def skyline(self, at: float | int, rough: float | int) -> NDArray:
        """Draw a periodic curve y(x).

        Args:
            at: Mean of the curve, in units of the canvas.
            rough: Its standard deviation, likewise.

        Returns:
            (width,) y, in units of the canvas.
        """
        wave = np.cumsum(self.noise(1.2, 300)[0])
        wave = wave - np.linspace(0, wave[-1], len(wave))
        return at + rough * (wave - wave.mean()) / wave.std()

    def paint(self, where: NDArray, level: float | NDArray) -> None:
        """Set the level of some pixels.

        Args:
            where: Mask that broadcasts with the canvas.
            level: ln intensity there.
        """
        self.level = np.where(where, level, self.level)

    def box(
        self, x: float | int, y: float | int, width: float | int, height: float | int
    ) -> NDArray:
        """Return the mask of a box.

        Args:
            x: Place of its middle along x, in units of the canvas.
            y: Place along y, likewise.
            width: Its width, likewise.
            height: Its height, likewise.

        Returns:
            (height, width) of the canvas.
        """
        dx, dy = self.away(x, y)
        return (abs(dx) < width / 2) & (abs(dy) < height / 2)

    def glow(self, x: float | int, y: float | int, radius: float | int, level: float | int) -> None:
        """Add a lamp: a disc in a halo that falls as 1 / r^2.

        Args:
            x: Place of its middle along x, in units of the canvas.
            y: Place along y, likewise.
            radius: Radius of the disc, likewise.
            level: ln intensity of the disc.
        """
        dx, dy = self.away(x, y)
        r = np.hypot(dx, dy) / radius
        self.level = np.logaddexp(self.level, level - 2 * np.log(np.maximum(r, 1)) * (1 + r / 12))

    def places(self, count: int, low: float | int = 0.0, high: float | int = 512.0):
        """Draw points spread over the width.

        Args:
            count: Number of points.
            low: Least y, in units of the canvas.
            high: Greatest y, likewise.

        Returns:
            x and y of each point, likewise.
        """
        x = (np.arange(count) + self.rng.uniform(0.28, 0.72, count)) * self.columns / count
        return list(zip(x.tolist(), self.rng.uniform(low, high, count).tolist(), strict=True))


def _paint_room(c: _Canvas) -> None:
    """Paint a living room: windows on bright outdoors, shaded walls, dark furniture, a lamp."""
    c.level = -2.4 + 0.5 * c.noise(1.7) + 0.9 * np.cos(2 * np.pi * (c.y - 160) / 512)
    outside = 3.6 + 0.5 * c.noise(1.3, 60)
    for x, y in c.places(4, 120, 200):
        c.paint(c.box(x, y, 92, 130), -3.2)
        for dx, dy in ((-21, -31), (21, -31), (-21, 31), (21, 31)):
            c.paint(c.box(x + dx, y + dy, 36, 56), outside)
    wood = -5.6 + 0.4 * c.noise(1.2, 40, 4)
    for x, y in c.places(5, 360, 440):
        c.paint(c.box(x, y, c.rng.uniform(50, 90), c.rng.uniform(40, 110)), wood)
    for x, y in c.places(6, 270, 330):
        picture = c.rng.uniform(-3, 0) + 0.6 * c.noise(1.6, 20)
        c.paint(c.box(x, y, 34, 26), picture)
    for x, y in c.places(2, 250, 300):
        c.glow(x, y, 6, 3.8)


def _forest(c: _Canvas) -> None:
    """Paint tree trunks and leaves before a bright sky, spots of sun on dark ground."""
    c.level = 4.2 - c.y / 90 + 0.4 * c.noise(1.8, 80)
    c.paint(c.noise(2.3, 110) > c.y / 300 - 0.4, -2.0 + 0.4 * c.noise(1.6, 40))
    c.paint(c.y > c.skyline(360, 8), -3.6 + 0.5 * c.noise(1.6, 50, 3))
    bark = -4.2 + 0.4 * c.noise(1.2, 30, 0.3)
    for x, _ in c.places(8):
        lean = c.rng.uniform(-0.08, 0.08)
        dx, _ = c.away(x, 0)
        wide = c.rng.uniform(4, 17)
        c.paint(abs(dx - lean * (c.y - 256)) < wide, bark + dx / wide)
    c.paint((c.y > 365) & (c.noise(1.9, 50, 2) > 1.4), 1.0 + 0.4 * c.noise(1.4, 20))


def _mountain(c: _Canvas) -> None:
    """Paint a sunny sky over ridges and a city, dark grass and a road in front."""
    x, y = c.places(1, 60, 90)[0]
    c.level = 3.0 + 0.5 * c.noise(2.0, 150, 2) - 0.3 * np.cos(2 * np.pi * c.y / 512)
    c.glow(x, y, 14, 6.0)
    for at, rough, level in ((190, 30, 0.6), (235, 22, -0.4), (275, 12, -1.3)):
        c.paint(c.y > c.skyline(at, rough), level + 0.35 * c.noise(1.3, 60))
    for x, y in c.places(40, 268, 310):
        c.paint(c.box(x, y, c.rng.uniform(4, 14), c.rng.uniform(8, 26)), c.rng.uniform(-1, 1.5))
    c.paint(c.y > c.skyline(330, 10), -3.9 + 0.6 * c.noise(1.1, 30))
    road = 400 + 30 * np.sin(2 * np.pi * c.x / c.columns)
    c.paint(abs(c.y - road) < 22, -3.2 + 0.15 * c.noise(1.0, 20))
    c.paint((abs(c.y - road) < 1.8) & (c.x % 32 < 18), -1.2)


def _lake(c: _Canvas) -> None:
    """Paint clouds and their reflection on rippled water, dark trees behind and in front."""
    cloud = c.noise(1.9, 120, 2)
    c.level = 1.4 + 1.1 * np.tanh(1.3 * cloud) + 0.2 * c.noise(1.6, 30)
    trees = c.skyline(210, 14) + 7 * c.noise(1.2, 16)[0]
    c.paint(c.y > trees, -3.2 + 0.4 * c.noise(1.4, 20))
    ripple = c.noise(1.7, 40, 6)
    water = c.level[::-1] - 1.2 + 0.5 * ripple
    c.paint(c.y > 256, water)
    glitter = (c.y > 262) & (c.noise(1.7, 24, 5) > 2.2) & (cloud[::-1] > 0)
    c.paint(glitter, 4.6)
    for x, _ in c.places(3):
        dx, _ = c.away(x, 0)
        crown = (dx / 42) ** 2 + ((c.y - 430) / 70) ** 2 + 0.25 * c.noise(1.8, 24)
        c.paint((crown < 1) | ((abs(dx) < 5) & (c.y > 430)), -4.4 + 0.4 * c.noise(1.4, 16))


def _night(c: _Canvas) -> None:
    """Paint a street at night: lit windows, lamps and signs between nearly black walls."""
    c.level = -5.6 + 0.3 * c.noise(1.6, 200)
    houses = np.linspace(0, c.columns, 9)
    for left, right in zip(houses[:-1], houses[1:], strict=True):
        wide, top = right - left, c.rng.uniform(60, 160)
        wall = c.rng.uniform(-4.4, -3.0) + 0.3 * c.noise(1.2, 30)
        c.paint((c.x >= left) & (c.x < right) & (c.y > top) & (c.y < 380), wall)
        for x in np.arange(left + 16, right - 12, 26):
            for y in np.arange(top + 26, 345, 42):
                lit = c.rng.uniform() < 0.3
                level = c.rng.uniform(-0.2, 1.8) if lit else -4.6
                c.paint(c.box(x, y, 13, 22), level + 0.3 * c.noise(1.4, 10))
        c.paint(c.box(left + wide / 2, 362, wide * 0.6, 10), c.rng.uniform(0.5, 2.2))
    c.paint(c.y > 380, -4.0 + 0.5 * c.noise(1.3, 40, 4))
    for x, y in c.places(6, 300, 330):
        c.paint(c.box(x, y + 50, 3, 100), -5.5)
        c.glow(x, y, 4, 4.6)
        c.glow(x, 440, 6, 1.2)


def _tunnel(c: _Canvas) -> None:
    """Paint the mouth of a tunnel, blinding outdoors, rows of tiles and weak lamps inside."""
    c.level = -5.0 + 0.35 * c.noise(1.4, 60)
    joint = ((c.y % 26 < 2.2) | ((c.x + 17 * (c.y // 26)) % 34 < 2.2)) & (c.y < 340)
    c.paint(joint, c.level - 1.0)
    for x, y in c.places(2, 210, 240):
        dx, dy = c.away(x, y)
        r = np.hypot(dx, np.where(dy > 0, dy * 0.8, dy))
        c.level = np.logaddexp(c.level, 1.0 - r / 30 + 0.15 * c.noise(1.2, 30))
        hills = 3.4 - 1.7 * (dy > 12 * c.noise(1.5, 60)[0]) + 0.45 * c.noise(1.2, 30)
        c.paint(r < 74, hills)
        c.paint((r >= 74) & (r < 82), -1.0 + 0.3 * c.noise(1.0, 10))
    c.paint(c.y > 400, -2.4 + 0.5 * c.noise(1.3, 50, 5))
    for x, y in c.places(10, 100, 104):
        c.paint(c.box(x, y, 18, 4), 1.6)
    c.paint(c.box(0, 440, 2 * c.columns, 3) & (c.x % 42 < 22), -0.8)


# Functions that paint, and the part of the scene that is brighter than the frames' white.
_SCENES: dict[str, tuple[Callable[[_Canvas], None], float]] = {
    "room": (_paint_room, 0.10),
    "forest": (_forest, 0.30),
    "mountain": (_mountain, 0.32),
    "lake": (_lake, 0.30),
    "night": (_night, 0.06),
    "tunnel": (_tunnel, 0.13),
}
SCENES = tuple(_SCENES)
# Scenes for fits of parameters, and for held-out scores.
FITTING_SCENES, TESTING_SCENES = SCENES[:2], SCENES[2:]


def scene(
    name: str | int, decades: float | int = 4.5, size: tuple[int, int] = (480, 320)
) -> NDArray[np.float64]:
    """Paint a textured panorama of high dynamic range; deterministic.

    Intensity 1 is the frames' white: a part of the scene that is fixed for each name, 6 to 32 %, is
    brighter. The panorama is band-limited to about 1.5 pixels, for sampling between pixels. Its
    left and right edges meet.

    Args:
        name: One of `SCENES`, or a whole number, which chooses among them and seeds a variant.
        decades: Range of luminance between the darkest and the brightest 0.1 %, base-10 logarithm.
        size: Width and height, px, at least 64 each.

    Returns:
        (height, width) linear intensity.

    Raises:
        InputError: The name is unknown, or decades or size are not possible.
    """
    if isinstance(name, int):
        kind, seed = SCENES[name % len(SCENES)], name
    else:
        kind, seed = name, zlib.crc32(name.encode())
    if kind not in _SCENES or seed < 0:
        raise InputError(
            f"there is no scene {name!r}; choose {', '.join(SCENES)} or a number from 0"
        )
    if not 0.5 <= decades <= 7 or min(size) < 64:
        raise InputError(
            f"a scene of {decades} decades and {size[0]}x{size[1]} pixels is not possible; choose "
            "0.5 to 7 decades and at least 64x64"
        )
    draw, bright = _SCENES[kind]
    canvas = _Canvas(size, np.random.default_rng(seed))
    draw(canvas)
    light = np.exp(canvas.level)
    sharp, glare = (
        gaussian_filter(light, width, mode=_EDGES) for width in (_BLUR_PX, _GLARE_PX * canvas.unit)
    )
    level = np.log((1 - _GLARE_SHARE) * sharp + _GLARE_SHARE * glare)
    level = gaussian_filter(level, _LOG_BLUR_PX, mode=_EDGES)
    darkest, white, brightest = np.quantile(level, [0.001, 1 - bright, 0.999])
    return np.exp((level - white) * (decades * np.log(10) / (brightest - darkest)))


@dataclasses.dataclass(frozen=True)
class Pan:
    """A camera that moves over a panorama: an `IntensitySource`.

    The heading swings by 2 rad about left or right within 1.6 s and the speed by a third, 20 to
    40 px/s ("slow") or 200 to 400 px/s ("fast"), or about a number given in px/s; the camera rolls
    by 5 degrees and zooms by 4 %. Of 64 random starts that one is taken whose path is most evenly
    bright (I > 1), dark (I < 0.05) and between. ln intensity is interpolated by cubic splines;
    beyond the panorama's edges it is repeated sideways and mirrored up and down. Deterministic in
    `seed`.

    Attributes:
        panorama: (rows, columns) intensity.
        size: Width and height of the sensor, px.
        duration: Length of the recording, s.
        speed: Mean speed: "slow", "fast", or px/s.
        seed: Seed of the path.

    Raises:
        InputError: The panorama is not positive, or the speed is unknown.
    """

    panorama: NDArray[np.float64]
    size: tuple[int, int] = (128, 96)
    duration: float | int = 1.5
    speed: Speed | float | int = "slow"
    seed: int = 0

    def __post_init__(self) -> None:
        if self.panorama.ndim != 2 or not (self.panorama > 0).all():
            raise InputError("a panorama needs positive intensities of shape (height, width)")
        if self.speed not in PAN_SPEEDS_PX_S and not (
            isinstance(self.speed, float | int) and 0 <= self.speed < np.inf
        ):
            raise InputError(
                f"there is no speed {self.speed!r}; choose slow, fast or a number of px/s"
            )

    def intensity(self, t: float | int) -> NDArray[np.float64]:
        """Return the linear intensity (height, width) at t seconds."""
        width, height = self.size
        (x, y), roll, zoom = self.pose(t)
        across = (np.arange(width) - (width - 1) / 2) * zoom
        down = (np.arange(height)[:, None] - (height - 1) / 2) * zoom
        cos, sin = np.cos(roll), np.sin(roll)
        at = np.broadcast_arrays(y + sin * across + cos * down, x + cos * across - sin * down)
        return np.exp(map_coordinates(self._spline, at, order=3, mode="grid-wrap", prefilter=False))

    def pose(self, t: float | int) -> tuple[NDArray[np.float64], float, float]:
        """Return the point at the image centre (x, y, px), roll (rad) and zoom at t seconds."""
        sway = 2 * np.pi * t / 2.3 + self._phases[2]
        return self._path(t), 0.09 * float(np.sin(sway)), 1 + 0.04 * float(np.cos(sway))

    @functools.cached_property
    def _spline(self) -> NDArray[np.float64]:
        return spline_filter(np.log(self._torus), 3, mode="grid-wrap")

    @functools.cached_property
    def _phases(self) -> NDArray[np.float64]:
        return np.random.default_rng(self.seed).uniform(0, 2 * np.pi, 4)

    @functools.cached_property
    def _path(self) -> Callable[[float], NDArray[np.float64]]:
        t = np.linspace(0, self.duration, max(8, int(self.duration * 200)))
        bearing, swing, _, phase = self._phases
        bearing = 0.0 if bearing < np.pi else np.pi
        mean = PAN_SPEEDS_PX_S[self.speed] if isinstance(self.speed, str) else self.speed
        speed = mean * (1 + np.sin(2 * np.pi * t / 1.1 + phase) / 3)
        heading = bearing + 2 * np.sin(2 * np.pi * t / 1.6 + swing)
        velocity = speed[:, None] * np.stack([np.cos(heading), np.sin(heading)], 1)
        path = CubicSpline(t, velocity).antiderivative()
        start = self._choose_start(path(t[::20]))
        return lambda time: start + path(time)

    @functools.cached_property
    def _torus(self) -> NDArray[np.float64]:
        """The panorama and its mirror image: a torus without a seam."""
        return np.vstack([self.panorama, self.panorama[::-1]])

    def _choose_start(self, path: NDArray[np.float64]) -> NDArray[np.float64]:
        height, width = self._torus.shape
        places = np.random.default_rng([self.seed, 1]).uniform(0, [width, height / 2], (64, 2))
        x, y = np.rint(places[:, None] + path).astype(int).T
        view: Any = self.size[::-1]
        bright, dark = (
            uniform_filter(part.astype(float), view, mode="wrap")[y % height, x % width].mean(0)
            for part in (self._torus > 1, self._torus < 0.05)
        )
        return places[np.argmax(np.min([bright, dark, 1 - bright - dark], axis=0))]


# Signed distance (px) of points x, y from a shape's edge, negative inside; distances are of the
# nearest straight part, which differs from the true one only outside of corners.
Distance = Callable[[NDArray, NDArray, float], NDArray]

_TILE_PX = 256  # after which a texture repeats
# Layers of a texture: standard deviation (px) of the Gaussian that each is made of, and its weight.
_LAYERS = ((1.5, 0.4), (4.0, 0.8), (12.0, 0.6))
_MARGIN_PX = 2  # around an object, in which it is drawn


def _disc(x: NDArray, y: NDArray, r: float) -> NDArray:
    """Return the signed distance from a disc, negative inside.

    Args:
        x: Offsets from its middle along x, of any shape.
        y: Offsets along y, likewise.
        r: Its radius, in the same unit.

    Returns:
        Distances, of that shape.
    """
    return np.hypot(x, y) - r


def _box(x: NDArray, y: NDArray, r: float) -> NDArray:
    """Return about the signed distance from a box, negative inside.

    Args:
        x: Offsets from its middle along x, of any shape.
        y: Offsets along y, likewise.
        r: Half of its width, in the same unit; its height is 0.6 of the width.

    Returns:
        Distances, of that shape.
    """
    return np.maximum(abs(x) - r, abs(y) - 0.6 * r)


def _triangle(x: NDArray, y: NDArray, r: float) -> NDArray:
    # An equilateral one, its corners r from the middle and its edges r / 2.
    """Return about the signed distance from an equilateral triangle, negative inside.

    Args:
        x: Offsets from its middle along x, of any shape.
        y: Offsets along y, likewise.
        r: Distance of its corners from the middle, in the same unit.

    Returns:
        Distances, of that shape.
    """
    return np.maximum(np.sqrt(0.75) * abs(x) + y / 2, -y) - r / 2


def _diamond(x: NDArray, y: NDArray, r: float) -> NDArray:
    """Return about the signed distance from a square on its corner, negative inside.

    Args:
        x: Offsets from its middle along x, of any shape.
        y: Offsets along y, likewise.
        r: Distance of its corners from the middle, in the same unit.

    Returns:
        Distances, of that shape.
    """
    return (abs(x) + abs(y) - r) / np.sqrt(2)


def _cross(x: NDArray, y: NDArray, r: float) -> NDArray:
    """Return about the signed distance from an upright cross, negative inside.

    Args:
        x: Offsets from its middle along x, of any shape.
        y: Offsets along y, likewise.
        r: Half of its width, in the same unit; its bars are a third as wide.

    Returns:
        Distances, of that shape.
    """
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

    Attributes:
        size: Width and height of the sensor, px.
        duration: Length of the recording, s.
        speed: Root mean square speed of objects, px/s.
        spread: Relative spread of their speeds, 0..1.
        seed: Seed of the scene.
        background: Speed of the background over `speed`.

    Raises:
        InputError: There are fewer than 32x32 pixels, the speed or background is negative, or the
            spread is outside [0, 1).
    """

    size: tuple[int, int] = (160, 120)
    duration: float | int = 1.0
    speed: float | int = 90.0
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
