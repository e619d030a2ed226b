"""A camera that moves in a rigid, textured world, with the true twist and depth.

    recording, truth = motion_scene("texture", motion="varying", seed=3)
    truth.twist(0.2)   # T (1, 3) in m/s and Omega (1, 3) in rad/s, the camera's own
    truth.depth(0.2)   # (height, width) in m

Camera axes are x to the right, y down, z forward; the world's are the camera's at time 0. Pixel
centres are whole numbers. `simulate_frame_events` is the generator of the egomotion thesis: events
are differences of images 50 us apart.
"""

import dataclasses
import functools
import math
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import gaussian_filter, map_coordinates, spline_filter
from scipy.spatial.transform import RigidTransform, Rotation

from jaxevent.arrays import as_size
from jaxevent.camera import PinholeCamera
from jaxevent.deprecated import RenamedAttribute, renamed_names
from jaxevent.errors import InputError
from jaxevent.parameters import check_choice
from jaxevent.recording import Events, Poses, Recording, Times
from jaxevent.simulate.hybrid import SENSORS, Sensor, simulate
from jaxevent.simulate.scenes import parse_seconds

Six = tuple[float | int, float | int, float | int, float | int, float | int, float | int]
Three = tuple[float | int, float | int, float | int]
Change = Literal["constant", "linear", "varying"]
_NONE: Six = (0, 0, 0, 0, 0, 0)

_STEP_S = 5e-4  # of the integration of poses
_POSE_RATE_HZ = 200.0  # of a recording's ground truth
_TEXELS = 512
_FADE_TEXELS = 16.0  # from a wall's edge, within which its texture fades
# Few frames of one instant each, and one image of the truth.
_IDEAL = dataclasses.replace(
    SENSORS["ideal"], frame_rate=25.0, exposure=1e-3, exposure_samples=1, truth_rate=1e-3
)


@dataclasses.dataclass(frozen=True)
class CameraMotion:
    """A camera's twist: mean + slope t + amplitude sin(2 pi frequency t + phase).

    The six numbers of a twist are T (m/s) and Omega (rad/s) of the camera, in its own axes. The
    pose at time 0 is the identity.

    Attributes:
        mean: (6,) twist.
        slope: (6,) its change, 1/s.
        amplitude: (6,) amplitudes of oscillations.
        frequency: (6,) their frequencies, Hz.
        phase: (6,) their phases, rad.

    Raises:
        InputError: A number is not finite.
    """

    mean: Six
    slope: Six = _NONE
    amplitude: Six = _NONE
    frequency: Six = _NONE
    phase: Six = _NONE

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = np.asarray(getattr(self, field.name), np.float64)
            if value.shape != (6,) or not np.isfinite(value).all():
                raise InputError(
                    f"the {field.name} of a camera's motion is {value.tolist()}; give six finite "
                    "numbers, of T and of Omega"
                )
            object.__setattr__(self, field.name, tuple(value.tolist()))

    def twist(self, t: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return T (m/s) and Omega (rad/s), (times, 6), at times (s)."""
        t = np.asarray(t, np.float64)[:, None]
        turn = 2 * np.pi * np.asarray(self.frequency) * t + np.asarray(self.phase)
        swing = np.asarray(self.amplitude) * np.sin(turn)
        return np.asarray(self.mean) + np.asarray(self.slope) * t + swing

    def pose(self, t: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return camera-to-world poses (times, 4, 4) at times (s) from 0 on, to about 1e-11."""
        t = np.asarray(t, np.float64)
        k = np.floor(t / _STEP_S).astype(int)
        grid = self._grid_poses(1 << int(k.max(initial=0)).bit_length())
        return grid[k] @ self._steps(k * _STEP_S, t - k * _STEP_S)

    def _steps(self, t: NDArray[np.floating], h: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return changes of the pose, by the Magnus series for dP/dt = P X, to fourth order.

        Args:
            t: (n,) times, s.
            h: (n,) steps, s.

        Returns:
            (n, 4, 4) P(t)^-1 P(t + h).
        """
        gauss = math.sqrt(3) / 6  # of the two points of Gauss' quadrature from the middle
        (v1, w1), (v2, w2) = (
            np.split(self.twist(t + (0.5 + s * gauss) * h), 2, axis=-1) for s in (-1, 1)
        )
        # h (X1 + X2) / 2 + sqrt(3) / 12 h^2 [X1, X2], as vectors.
        h, bend = h[:, None], math.sqrt(3) / 12 * h[:, None] ** 2
        turn = h * (w1 + w2) / 2 + bend * np.cross(w1, w2)
        way = h * (v1 + v2) / 2 + bend * (np.cross(w1, v2) - np.cross(w2, v1))
        return RigidTransform.from_exp_coords(np.concatenate([turn, way], 1)).as_matrix()

    @functools.cache  # noqa: B019, motions are small and few
    def _grid_poses(self, count: int) -> NDArray[np.float64]:
        """Return the poses (count + 1, 4, 4) at the times 0, _STEP_S, ..."""
        steps = self._steps(np.arange(count) * _STEP_S, np.full(count, _STEP_S))
        poses = [np.eye(4)]
        for step in steps:
            poses.append(poses[-1] @ step)
        return np.array(poses)


def planar_motion(
    velocity: tuple[float | int, float | int],
    depth: float | int = 2.0,
    focal: float | int = 200.0,
    *,
    slope: tuple[float | int, float | int] = (0, 0),
    amplitude: tuple[float | int, float | int] = (0, 0),
    frequency: float | int = 2.0,
    phase: float | int = 0.0,
) -> CameraMotion:
    """Make a motion before a wall that moves the whole image with one velocity.

    The velocity U = velocity + slope t + amplitude sin(2 pi frequency t + phase) is that of the
    translation T = -U depth / f.

    Args:
        velocity: Along x and y, px/s.
        depth: Distance of the wall, m.
        focal: Focal length, px.
        slope: Along x and y, px/s^2.
        amplitude: Along x and y, px/s.
        frequency: Of both, Hz.
        phase: Of both, rad.

    Returns:
        The motion.

    Raises:
        InputError: A number is not finite.
    """

    def six(pair: tuple[float | int, float | int]) -> Six:
        scale = -depth / focal
        return (pair[0] * scale, pair[1] * scale, 0, 0, 0, 0)

    both: Six = (frequency, frequency, 0, 0, 0, 0)
    return CameraMotion(six(velocity), six(slope), six(amplitude), both, (phase, phase, 0, 0, 0, 0))


@dataclasses.dataclass(frozen=True, eq=False)
class Texture:
    """A texture of a plane: periodic cubic splines through samples of ln intensity.

    For events without aliasing, the image of a texel should be no smaller than a pixel, and `level`
    smooth over about two texels.
    """

    level: NDArray[np.float64]  # (rows, columns), ln intensity
    grain: float | int  # size of a texel, m

    def __call__(self, u: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the ln intensity of points on the plane.

        Args:
            u: (n,) coordinates along the rows, m.
            v: (n,) coordinates along the columns, m.

        Returns:
            (n,) ln intensity.
        """
        at = np.stack([v, u]) / self.grain
        return map_coordinates(self._spline, at, order=3, mode="grid-wrap", prefilter=False)

    @functools.cached_property
    def _spline(self) -> NDArray[np.float64]:
        return spline_filter(np.asarray(self.level, np.float64), 3, mode="grid-wrap")


def make_texture(
    kind: str, grain: float | int, seed: int = 0, contrast: float | int = 1.0
) -> Texture:
    """Make a texture of 512 x 512 texels by name.

    - noise: blobs of about 12 texels, dense;
    - shapes: discs and rectangles of 10 to 45 texels on even ground, sparse;
    - plain: constant.

    Args:
        kind: Name of the texture.
        grain: Size of a texel, m.
        seed: Seed of all random numbers.
        contrast: Range of ln intensity.

    Returns:
        The texture.

    Raises:
        InputError: The name is unknown, or the grain is not positive.
    """
    kinds = ("noise", "shapes", "plain")
    check_choice(kind, "texture", kinds)
    if not 0 < grain < math.inf:
        raise InputError(f"a texture's grain of {grain} m is not possible; give a positive length")
    rng = np.random.default_rng(seed)
    edges: Any = "wrap"
    level = np.zeros((_TEXELS, _TEXELS))
    if kind == "noise":
        level = gaussian_filter(rng.normal(size=level.shape), 4.0, mode=edges)
        level = contrast / 2 * np.tanh(level / level.std())
    elif kind == "shapes":
        dy, dx = np.mgrid[-32:33, -32:33]
        for number in range(110):
            (cx, cy), (a, b) = rng.integers(0, _TEXELS, 2), rng.uniform(5, 22, 2)
            angle = rng.uniform(0, np.pi)
            along = np.cos(angle) * dx + np.sin(angle) * dy
            across = np.cos(angle) * dy - np.sin(angle) * dx
            disc = np.hypot(along / a, across / b) < 1
            box = (abs(along) < a) & (abs(across) < b)
            drawn = disc if number % 2 else box
            rows, columns = (cy + dy) % _TEXELS, (cx + dx) % _TEXELS
            level[rows[drawn], columns[drawn]] = contrast * rng.choice([-1, -0.6, 0.5])
        level = gaussian_filter(level, 1.0, mode=edges)
    return Texture(level, grain)


@dataclasses.dataclass(frozen=True, eq=False)
class FlatPatch:
    """A flat, opaque ellipse or rectangle.

    Its axes are the world's x and y, turned by the rotation vector `turn`.

    Attributes:
        centre: X, Y and Z of the middle, m.
        half: Half axes, m.
        texture: Its texture.
        base: ln intensity added to the texture's.
        turn: (3,) rotation vector of its axes, rad.
        ellipse: Whether it is an ellipse, else a rectangle.
    """

    centre: Three
    half: tuple[float | int, float | int]
    texture: Texture
    base: float | int = 0.0
    turn: Three = (0.0, 0.0, 0.0)
    ellipse: bool = True


class _Rays(NamedTuple):
    """Rays of the pixels from a camera, which advance by 1 in depth."""

    centre: NDArray[np.float64]  # (3,), of the camera, m
    direction: NDArray[np.float64]  # (n, 3)
    length: NDArray[np.float64]  # (n,)
    pixel: float | int  # angle of a pixel, 1 / f


@dataclasses.dataclass(frozen=True, eq=False)
class BoxWorld:
    """The inside of a box, in which the camera is, and patches in it.

    All walls have the same texture, which fades near their edges. Patches hide the walls, and each
    hides those before it in `patches`: give the farthest first. Their outlines are blurred over a
    pixel.

    Attributes:
        lower: Least X, Y and Z of the box, m.
        upper: Largest X, Y and Z of the box, m.
        texture: Texture of the walls.
        patches: Patches in the box, the farthest first.
    """

    lower: Three
    upper: Three
    texture: Texture
    patches: tuple[FlatPatch, ...] = ()

    seen = RenamedAttribute("render")

    def render(
        self, centre: NDArray[np.float64], ray: NDArray[np.float64], pixel: float | int
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Render the world along rays.

        Args:
            centre: (3,) position of the camera, m.
            ray: (n, 3) directions that advance by 1 in depth.
            pixel: Angle of a pixel, 1 / f.

        Returns:
            ln intensity (n,) and depth (n,), m.

        Raises:
            InputError: The camera has left the box.
        """
        lower, upper = np.asarray(self.lower, np.float64), np.asarray(self.upper, np.float64)
        if not ((lower < centre) & (centre < upper)).all():
            raise InputError(
                f"the camera has moved to {np.round(centre, 2).tolist()} m, outside the world; "
                "shorten the motion or enlarge the box"
            )
        wall = np.where(ray > 0, upper, lower)
        reach = (wall - centre) / np.where(ray == 0, 1e-300, ray)
        reach = np.where(reach > 0, reach, np.inf)
        axis = np.argmin(reach, -1)
        depth = np.take_along_axis(reach, axis[:, None], -1)[:, 0]
        hit = centre + depth[:, None] * ray
        first, second = np.array([1, 0, 0])[axis], np.array([2, 2, 1])[axis]
        rows = np.arange(len(hit))
        edge = np.minimum(hit - lower, upper - hit)
        edge = np.minimum(edge[rows, first], edge[rows, second]) / (
            _FADE_TEXELS * self.texture.grain
        )
        # Rows and columns of a wall are the world's axes; on walls before and behind x and y.
        u, v = hit[rows, np.where(axis == 2, 0, first)], hit[rows, np.where(axis == 2, 1, second)]
        level = self.texture(u, v) * _smooth_step(edge)
        rays = _Rays(centre, ray, np.sqrt(np.einsum("ni,ni->n", ray, ray)), pixel)
        for patch in self.patches:
            self._draw_patch(patch, rays, level, depth)
        return level, depth

    @staticmethod
    def _draw_patch(
        patch: FlatPatch, rays: _Rays, level: NDArray[np.float64], depth: NDArray[np.float64]
    ) -> None:
        """Draw a patch over level and depth.

        Args:
            patch: The patch.
            rays: n rays of a view.
            level: (n,) ln intensity, in place.
            depth: (n,) m, in place.
        """
        centre, ray, length, pixel = rays
        across, down, normal = Rotation.from_rotvec(patch.turn).as_matrix().T
        towards = np.asarray(patch.centre) - centre
        # Only rays that meet the sphere about the patch, enlarged by two pixels.
        away = float(np.linalg.norm(towards))
        sine = math.hypot(*patch.half) / away + 2 * pixel
        along = ray @ (towards / away)
        close = along > math.sqrt(max(1 - sine * sine, 0)) * length
        near = np.flatnonzero(close if sine < 1 else np.ones(len(ray), bool))
        facing = ray[near] @ normal
        reach = towards @ normal / np.where(facing == 0, 1e-300, facing)
        ahead = (reach > 0) & (reach < 1e3)
        near, reach = near[ahead], reach[ahead]
        offset = reach[:, None] * ray[near] - towards
        u, v = offset @ across, offset @ down
        a, b = patch.half
        # About the distance from the outline (m), positive inside.
        if patch.ellipse:
            radius = np.hypot(u / a, v / b)
            slope = np.hypot(u / a**2, v / b**2) / np.maximum(radius, 1e-9)
            inside = (1 - radius) / np.maximum(slope, 1e-9)
        else:
            inside = np.minimum(a - abs(u), b - abs(v))
        cover = _smooth_step(inside / (reach * pixel * 2) + 0.5)
        some = cover > 0
        near, cover, reach = near[some], cover[some], reach[some]
        own = patch.base + patch.texture(u[some], v[some])
        level[near] += cover * (own - level[near])
        depth[near] = np.where(cover > 0.5, reach, depth[near])


def _smooth_step(a: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return 0 below 0, 1 above 1, and a cubic between."""
    a = np.clip(a, 0, 1)
    return a * a * (3 - 2 * a)


@dataclasses.dataclass(frozen=True, eq=False)
class MovingCamera:
    """A camera in a world, an `IntensitySource` for `simulate`, with the truth of its motion.

    Times of the truth are integers (us) or floats (s) from 0 to the duration.

    Attributes:
        world: The world.
        motion: Motion of the camera.
        size: Width and height of the sensor, px.
        focal: Focal length of a lens without distortion, centred in the image, px.
        duration: Length of the recording, s.
        lens: Another lens, instead of `focal`.

    Raises:
        InputError: A time is outside the duration, or the distortion of the lens has no inverse in
            the image.
    """

    world: BoxWorld
    motion: CameraMotion
    size: tuple[int, int] = (240, 180)
    focal: float | int = 200.0
    duration: float | int = 0.5
    lens: PinholeCamera | None = None

    @property
    def camera(self) -> PinholeCamera:
        """The calibration."""
        if self.lens is not None:
            return self.lens
        width, height = self.size
        f = float(self.focal)
        return PinholeCamera(f, f, (width - 1) / 2, (height - 1) / 2)

    def intensity(self, t: float | int) -> NDArray[np.float64]:
        """Return the linear intensity (height, width) at t seconds."""
        return np.exp(self._render(float(t))[0])

    def depth(self, time: Times) -> NDArray[np.float64]:
        """Return the true depth (height, width) in m at one time."""
        return self._render(float(parse_seconds(time, self.duration)[0]))[1]

    def twist(self, times: Times) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the true T (times, 3) in m/s and Omega (times, 3) in rad/s."""
        twist = self.motion.twist(parse_seconds(times, self.duration))
        return twist[:, :3], twist[:, 3:]

    def velocity(self, times: Times) -> NDArray[np.float64]:
        """Return the true flow (times, 2) in px/s at the principal point.

        In planar motion it is that of the whole image.
        """
        t = parse_seconds(times, self.duration)
        twist = self.motion.twist(t)
        axis = np.array([0.0, 0.0, 1.0])
        depth = np.empty(len(t))
        for k, pose in enumerate(self.motion.pose(t)):
            ray = (pose[:3, :3] @ axis)[None]
            depth[k] = self.world.render(pose[:3, 3], ray, 1 / self._f)[1][0]
        turn = np.stack([-twist[:, 4], twist[:, 3]], 1)
        return self._f * (turn - twist[:, :2] / depth[:, None])

    def pose(self, times: Times) -> NDArray[np.float64]:
        """Return the true camera-to-world poses (times, 4, 4)."""
        return self.motion.pose(parse_seconds(times, self.duration))

    def poses(self, rate: float | int = _POSE_RATE_HZ) -> Poses:
        """Return the poses of a recording, `rate` per second."""
        count = math.floor(self.duration * rate + 1e-9) + 1
        t = np.rint(np.arange(count) / rate * 1e6).astype(np.int64)
        pose = self.motion.pose(t * 1e-6)
        return Poses(t, pose[:, :3, 3], Rotation.from_matrix(pose[:, :3, :3]).as_quat())

    def _render(self, t: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return ln intensity and depth (height, width) at t seconds."""
        pose = self.motion.pose(np.array([t]))[0]
        level, depth = self.world.render(pose[:3, 3], self._rays @ pose[:3, :3].T, 1 / self._f)
        return level.reshape(self.size[::-1]), depth.reshape(self.size[::-1])

    @functools.cached_property
    def _rays(self) -> NDArray[np.float64]:
        width, height = self.size
        y, x = np.mgrid[:height, :width].reshape(2, -1)
        direction = self.camera.normalise(x, y)
        if np.isnan(direction).any():
            raise InputError(
                f"the lens {self.camera} has no inverse in an image of {width}x{height} pixels; "
                "give a longer focal length or less distortion"
            )
        return np.concatenate([direction, np.ones((len(x), 1))], 1)

    @property
    def _f(self) -> float:
        """The focal length of both axes (px), their geometric mean."""
        return math.sqrt(self.camera.fx * self.camera.fy)


def simulate_motion(
    source: MovingCamera, sensor: Sensor | None = None, seed: int = 0, name: str = "motion"
) -> Recording:
    """Record a moving camera, with its calibration and its poses at 200 Hz; see `simulate`.

    The ideal sensor has thresholds of 0.2, no dead time and no noise, stamps to the microsecond,
    and 25 frames/s of one instant each. Intensity changes linearly within steps in which 95 % of
    the pixels change by half a threshold or less, 0.1 ms or longer. Intensity 1 is even ground.
    Deterministic in `seed`, which draws the level between the thresholds at which a pixel starts,
    and the noise of other sensors.

    Args:
        source: The camera.
        sensor: The sensor; None: an ideal one.
        seed: Seed of all random numbers.
        name: Name of the recording.

    Returns:
        The recording.

    Raises:
        InputError: The camera leaves the world.
    """
    recording = simulate(source, _IDEAL if sensor is None else sensor, seed, name)
    return dataclasses.replace(recording, camera=source.camera, poses=source.poses())


_GRAIN_M = 0.012  # 1 px at 2.4 m and f = 200 px


def _describe_room(kind: str, depth: float, seed: int) -> tuple[Three, Three, Texture]:
    """Describe a room.

    Args:
        kind: Kind of texture.
        depth: Depth of its front wall, m.
        seed: Seed of the texture.

    Returns:
        Lower and upper corner, m, and texture.
    """
    lower: Three = (-3.5, -3.5, -3.0)
    return lower, (3.5, 3.5, depth), make_texture(kind, _GRAIN_M, seed)


def _scatter_patches(
    rng: np.random.Generator, kinds: Sequence[str], count: int, half: tuple[float, float]
) -> tuple[FlatPatch, ...]:
    """Scatter patches at 1.4 to 3 m within 75 degrees of the axis.

    Args:
        rng: Generator.
        kinds: Textures, by turns.
        count: Number of patches.
        half: Least and greatest half axis, relative to the distance.

    Returns:
        The patches, the farthest first.
    """
    textures = [
        make_texture(kind, _GRAIN_M * 0.7, int(rng.integers(1 << 30)), 1.0) for kind in kinds
    ]
    distance = np.sort(rng.uniform(1.4, 3.0, count))[::-1]
    patches = []
    for k, r in enumerate(distance):
        # Even over the sphere.
        cosine = rng.uniform(math.cos(math.radians(75)), 1)
        azimuth = rng.uniform(0, 2 * np.pi)
        sine = math.sqrt(1 - cosine**2)
        direction = np.array([sine * np.cos(azimuth), sine * np.sin(azimuth), cosine])
        x, y, z = (r * direction).tolist()
        # It faces the camera within about 20 degrees.
        facing = Rotation.align_vectors([direction], [[0, 0, 1]])[0]
        turn = facing * Rotation.from_rotvec(rng.normal(0, 0.25, 3))
        a, b = (rng.uniform(*half, 2) * r).tolist()
        tx, ty, tz = turn.as_rotvec().tolist()
        base = float(rng.choice([-0.7, -0.4, 0.4, 0.7]))
        patches.append(
            FlatPatch(
                (x, y, z), (a, b), textures[k % len(textures)], base, (tx, ty, tz), k % 2 == 0
            )
        )
    return tuple(patches)


def _random_direction(rng: np.random.Generator, dimensions: int = 3) -> NDArray[np.float64]:
    """Draw a unit vector."""
    v = rng.normal(size=dimensions)
    return v / np.linalg.norm(v)


def _six(T: ArrayLike, Omega: ArrayLike) -> Six:
    """Return a twist as six numbers.

    Args:
        T: (3,) velocity, m/s.
        Omega: (3,) angular velocity, rad/s.

    Returns:
        The numbers.
    """
    a, b, c, d, e, f = np.concatenate([np.asarray(T, float), np.asarray(Omega, float)]).tolist()
    return a, b, c, d, e, f


def _draw_motion(rng: np.random.Generator, motion: str, speed: float, rate: float) -> CameraMotion:
    """Draw a motion in random directions.

    Args:
        rng: Generator.
        motion: "constant", "linear" or "varying".
        speed: Mean |T|, m/s.
        rate: Mean |Omega|, rad/s.

    Returns:
        The motion.
    """
    T, Omega = speed * _random_direction(rng), rate * _random_direction(rng)
    if motion == "constant":
        return CameraMotion(_six(T, Omega))
    if motion == "linear":
        return CameraMotion(
            _six(0.5 * T, 0.5 * Omega),
            _six(2 * speed * _random_direction(rng), 2 * rate * _random_direction(rng)),
        )
    return CameraMotion(
        _six(T, Omega),
        amplitude=_six(0.6 * speed * _random_direction(rng), 0.6 * rate * _random_direction(rng)),
        frequency=_six(*rng.uniform(1, 2, (2, 3))),
        phase=_six(*rng.uniform(0, 2 * np.pi, (2, 3))),
    )


MOTION_SCENES = ("planar", "rotation", "wall", "shapes", "texture")


def motion_scene(
    name: str,
    motion: str = "constant",
    seed: int = 0,
    *,
    size: tuple[int, int] = (240, 180),
    focal: float | int = 200.0,
    duration: float | int = 0.5,
    sensor: Sensor | None = None,
    texture: str | None = None,
    speed: float | int | None = None,
    lens: PinholeCamera | None = None,
) -> tuple[Recording, MovingCamera]:
    """Record a scene of `MOTION_SCENES` by name; deterministic in `seed`.

    - planar: a wall at 2 m that moves in a random direction through the image, of `texture`
      "noise" (default) or "shapes", at `speed` px/s, 200 by default; linear: from half of that,
      gaining 3 times `speed` per second; varying: speed (1 + sin(2 pi 2 Hz t) / 2);
    - rotation: "texture" with a camera that only turns, by default at `speed` = 2 rad/s;
    - wall: a wall at 2 m in a room 7 m wide, of `texture` "noise" by default: little parallax;
    - shapes: 60 plain shapes at 1.4 to 3 m before a plain wall at 3.2 m;
    - texture: 24 textured patches at 1.4 to 3 m before a textured wall at 3.2 m.

    The last three have the mean |T| drawn from 0.6 to 1 m/s (or `speed`) and |Omega| from 0.4 to
    1.8 rad/s, in random directions. "varying" motion adds sinusoids of 1 to 2 Hz to each component
    of T and Omega, with vectors of amplitudes of random direction and 60 % of the mean's length;
    "linear" starts at half the drawn motion and changes in a random direction by twice its length
    per second.

    Args:
        name: Name of the scene.
        motion: "constant", "linear" or "varying".
        seed: Seed of all random numbers.
        size: Width and height, px.
        focal: Focal length, px.
        duration: Length, s.
        sensor: The sensor; None: an ideal one.
        texture: Name of the texture, see `make_texture`; None: that of the scene.
        speed: Speed, in the scene's unit; None: that of the scene.
        lens: Lens of the camera; None: one without distortion.

    Returns:
        The recording, and the camera with the truth.

    Raises:
        InputError: The name or the motion is unknown, the size is not possible, or the camera
            leaves the world.
    """
    check_choice(name, "scene", MOTION_SCENES)
    check_choice(motion, "motion", get_args(Change))
    size = as_size(*size, name)
    rng = np.random.default_rng([seed, MOTION_SCENES.index(name)])
    texture_seed = int(rng.integers(1 << 30))
    if name == "planar":
        mean_speed = 200.0 if speed is None else float(speed)
        direction = _random_direction(rng, 2)

        def pair(factor: float | int) -> tuple[float, float]:
            x, y = (factor * mean_speed * direction).tolist()
            return x, y

        world = BoxWorld(
            (-50, -50, -1), (50, 50, 2), make_texture(texture or "noise", 2 / focal, texture_seed)
        )
        moved = {
            "constant": lambda: planar_motion(pair(1), 2, focal),
            "linear": lambda: planar_motion(pair(0.5), 2, focal, slope=pair(3)),
            "varying": lambda: planar_motion(pair(1), 2, focal, amplitude=pair(0.5)),
        }[motion]()
    else:
        kind = {"shapes": "plain"}.get(name, "noise") if texture is None else texture
        room = _describe_room(kind, 2.0 if name == "wall" else 3.2, texture_seed)
        patches = ()
        if name != "wall":
            patches = (
                _scatter_patches(rng, ("plain",), 60, (0.05, 0.16))
                if name == "shapes"
                else _scatter_patches(rng, ("noise", "shapes"), 24, (0.1, 0.24))
            )
        world = BoxWorld(*room, patches)
        if name == "rotation":
            moved = _draw_motion(rng, motion, 0.0, 2.0 if speed is None else float(speed))
        else:
            mean_speed = rng.uniform(0.6, 1.0) if speed is None else float(speed)
            moved = _draw_motion(rng, motion, mean_speed, rng.uniform(0.4, 1.8))
    source = MovingCamera(world, moved, size, focal, duration, lens)
    return simulate_motion(source, sensor, seed, f"{name} {motion}"), source


def simulate_frame_events(
    flow: NDArray[np.float64],
    image: NDArray[np.float64] | None = None,
    *,
    size: tuple[int, int] = (32, 32),
    threshold: float | int = 0.3,
    step: int = 50,
    noise: float | int = 0.0,
    seed: int = 0,
    name: str = "frame generator",
) -> tuple[Recording, NDArray[np.float64]]:
    """Simulate events with the generator of the egomotion thesis (appendix B).

    At frame k the image is that of the frame before, moved by flow[k]. A pixel whose value changes
    by more than the threshold between frames makes one event, at the later frame's time (k + 1)
    step (B.11). The large image is sampled bilinearly, as a torus, from a random start.

    Corrected against the print: the weights of B.10 are those of the nearer neighbours, and the
    upper neighbour is the lower one plus 1, without which whole-numbered places have no weight;
    I_t is not warped from I_(t-1), which blurs it more with every frame.

    Args:
        flow: (frames, 2) image velocity, px/frame.
        image: (rows, columns) values; None: 512 x 512 pixels of smooth noise, of standard deviation
            0.5.
        size: Width and height of the sensor, px.
        threshold: Least change of an event.
        step: Time between frames, us.
        noise: Random events per pixel and frame, 0 to 1.
        seed: Seed of all random numbers.
        name: Name of the recording.

    Returns:
        The recording, and the true velocities (frames, 2), px/s.

    Raises:
        InputError: A setting is not possible, or there is no event.
    """
    flow = np.asarray(flow, np.float64)
    width, height = size
    if flow.ndim != 2 or flow.shape[1:] != (2,) or not len(flow) or not np.isfinite(flow).all():
        raise InputError(f"{name}: flow of shape {flow.shape}; give finite px/frame, (frames, 2)")
    if not (0 < threshold < math.inf and step > 0 and 0 <= noise <= 1 and min(size) > 0):
        raise InputError(
            f"{name}: a threshold of {threshold}, steps of {step} us, noise {noise} and {size} "
            "pixels are not possible; give positive numbers, noise from 0 to 1"
        )
    rng = np.random.default_rng(seed)
    if image is None:
        edges: Any = "wrap"
        image = gaussian_filter(rng.normal(size=(_TEXELS, _TEXELS)), 1.5, mode=edges)
        image = 0.5 * image / image.std()
    image = np.asarray(image, np.float64)
    if image.ndim != 2 or not np.isfinite(image).all():
        raise InputError(f"{name}: the image of shape {image.shape} is not finite (rows, columns)")
    begin = rng.integers(0, image.shape[::-1])
    position = begin - np.concatenate([np.zeros((1, 2)), np.cumsum(flow, axis=0)])
    y, x = np.mgrid[:height, :width]
    before = _sample_bilinear(image, x + position[0, 0], y + position[0, 1])
    parts = []
    for k, (px, py) in enumerate(position[1:], start=1):
        now = _sample_bilinear(image, x + px, y + py)
        change = now - before
        if noise:
            lit = rng.random(change.shape) < noise
            change = np.where(lit, rng.choice([-np.inf, np.inf], change.shape), change)
        rows, columns = np.nonzero(np.abs(change) > threshold)
        # The bus's order within a frame is not that of the rows.
        order = rng.permutation(len(rows))
        rows, columns = rows[order], columns[order]
        parts.append((np.full(len(rows), k * step), columns, rows, change[rows, columns] > 0))
        before = now
    t, columns, rows, p = (np.concatenate(column) for column in zip(*parts, strict=True))
    events = Events(
        t.astype(np.int64), columns.astype(np.uint16), rows.astype(np.uint16), p.astype(np.bool_)
    )
    return Recording(name, width, height, events).check(), flow / (step * 1e-6)


def _sample_bilinear(
    image: NDArray[np.float64], x: NDArray[np.float64], y: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Sample an image by B.10, periodic beyond its border.

    v = d2 (d0 v0 + d1 v1) + d3 (d0 v2 + d1 v3), d0 = i_p - x, d1 = x - i_m.

    Args:
        image: (height, width).
        x: Columns, px, of any shape.
        y: Rows, px, of that shape.

    Returns:
        Values of that shape.
    """
    height, width = image.shape
    i, j = np.floor(x).astype(int), np.floor(y).astype(int)
    d1, d3 = x - i, y - j
    i_m, i_p, j_m, j_p = i % width, (i + 1) % width, j % height, (j + 1) % height
    upper = (1 - d1) * image[j_m, i_m] + d1 * image[j_m, i_p]
    lower = (1 - d1) * image[j_p, i_m] + d1 * image[j_p, i_p]
    return (1 - d3) * upper + d3 * lower


__getattr__ = renamed_names(__name__)
