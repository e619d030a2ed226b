"""A camera that moves in a rigid, textured world, with the truth of its twist and of depth.

    recording, truth = motion_scene("texture", motion="varying", seed=3)
    truth.twist(0.2)   # T (1, 3) in m/s and Omega (1, 3) in rad/s, the camera's own
    truth.depth(0.2)   # (height, width) in m

Camera axes are x to the right, y down, z forward; the world's are the camera's at time 0. Pixel
centres are whole numbers. `frame_events` is the egomotion thesis' own generator instead: events
are differences of images 50 us apart.
"""

import dataclasses
import functools
import math
from collections.abc import Sequence
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import gaussian_filter, map_coordinates, spline_filter
from scipy.spatial.transform import RigidTransform, Rotation

from jaxevent.camera import PinholeCamera
from jaxevent.errors import InputError
from jaxevent.parameters import suggest_name
from jaxevent.recording import Events, Poses, Recording, Times, microseconds
from jaxevent.simulate.hybrid import SENSORS, Sensor, simulate

Six = tuple[float | int, float | int, float | int, float | int, float | int, float | int]
Three = tuple[float | int, float | int, float | int]
Change = Literal["constant", "linear", "varying"]
_NONE: Six = (0, 0, 0, 0, 0, 0)

_STEP = 5e-4  # s, of the integration of poses
_POSE_RATE = 200.0  # Hz, of a recording's ground truth
_TEXELS = 512
_FADE = 16.0  # texels from a wall's edge within which its texture fades
# Few frames of one instant each; no more truth images than one.
_IDEAL = dataclasses.replace(
    SENSORS["ideal"], frame_rate=25.0, exposure=1e-3, exposure_samples=1, truth_rate=1e-3
)


@dataclasses.dataclass(frozen=True)
class CameraMotion:
    """Twists mean + slope t + amplitude sin(2 pi frequency t + phase), six numbers each.

    They are T (m/s) and Omega (rad/s) of the camera, in its own axes; frequency is in Hz, phase in
    rad. The pose at time 0 is the identity. Raises `InputError` for numbers that are not finite.
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
        """T and Omega, (times, 6), at times (s)."""
        t = np.asarray(t, np.float64)[:, None]
        turn = 2 * np.pi * np.asarray(self.frequency) * t + np.asarray(self.phase)
        swing = np.asarray(self.amplitude) * np.sin(turn)
        return np.asarray(self.mean) + np.asarray(self.slope) * t + swing

    def pose(self, t: NDArray[np.floating]) -> NDArray[np.float64]:
        """Camera-to-world poses (times, 4, 4) at times (s) from 0 on, to about 1e-11."""
        t = np.asarray(t, np.float64)
        k = np.floor(t / _STEP).astype(int)
        grid = self._grid(1 << int(k.max(initial=0)).bit_length())
        return grid[k] @ self._steps(k * _STEP, t - k * _STEP)

    def _steps(self, t: NDArray[np.floating], h: NDArray[np.floating]) -> NDArray[np.float64]:
        """P(t)^-1 P(t + h): Magnus' series for dP/dt = P X, to fourth order, by Gauss' points."""
        far = math.sqrt(3) / 6
        (v1, w1), (v2, w2) = (
            np.split(self.twist(t + (0.5 + s * far) * h), 2, axis=-1) for s in (-1, 1)
        )
        # h (X1 + X2) / 2 + sqrt(3) / 12 h^2 [X1, X2], as vectors.
        h, bend = h[:, None], math.sqrt(3) / 12 * h[:, None] ** 2
        turn = h * (w1 + w2) / 2 + bend * np.cross(w1, w2)
        way = h * (v1 + v2) / 2 + bend * (np.cross(w1, v2) - np.cross(w2, v1))
        return RigidTransform.from_exp_coords(np.concatenate([turn, way], 1)).as_matrix()

    @functools.cache  # noqa: B019, motions are small and few
    def _grid(self, count: int) -> NDArray[np.float64]:
        """Poses at the times 0, _STEP, ..., (count + 1,)."""
        steps = self._steps(np.arange(count) * _STEP, np.full(count, _STEP))
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
    """A motion before a wall at `depth` (m) that moves the whole image with the same velocity.

    U = velocity + slope t + amplitude sin(2 pi frequency t + phase), in px/s and px/s^2, with the
    focal length in px: T = -U depth / f. Raises `InputError` as `CameraMotion` does.
    """

    def six(pair: tuple[float | int, float | int]) -> Six:
        scale = -depth / focal
        return (pair[0] * scale, pair[1] * scale, 0, 0, 0, 0)

    both: Six = (frequency, frequency, 0, 0, 0, 0)
    return CameraMotion(six(velocity), six(slope), six(amplitude), both, (phase, phase, 0, 0, 0, 0))


@dataclasses.dataclass(frozen=True, eq=False)
class Texture:
    """ln intensity over a plane: periodic cubic splines through `level` (rows, columns).

    `grain` is the size of a texel in m. For events without aliasing, texels should not be seen
    smaller than pixels and `level` be smooth over about two texels.
    """

    level: NDArray[np.float64]
    grain: float | int

    def __call__(self, u: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
        """ln intensity at places (m) on the plane, `u` along the rows."""
        at = np.stack([v, u]) / self.grain
        return map_coordinates(self._spline, at, order=3, mode="grid-wrap", prefilter=False)

    @functools.cached_property
    def _spline(self) -> NDArray[np.float64]:
        return spline_filter(np.asarray(self.level, np.float64), 3, mode="grid-wrap")


def texture_of(
    kind: str, grain: float | int, seed: int = 0, contrast: float | int = 1.0
) -> Texture:
    """A texture by name, of 512 x 512 texels; `contrast` is the range of ln intensity.

    - noise: blobs of about 12 texels, dense;
    - shapes: discs and rectangles of 10 to 45 texels on even ground, sparse;
    - plain: constant.

    Raises `InputError` for an unknown name or a grain that is not positive.
    """
    kinds = ("noise", "shapes", "plain")
    if kind not in kinds:
        raise InputError(f"there is no texture {kind!r}; {suggest_name(kind, kinds)}")
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
class Patch:
    """A flat, opaque shape: an ellipse or a rectangle of half axes `half` (m) about `centre` (m).

    Its axes are the world's x and y, turned by the rotation vector `turn` (rad).
    """

    centre: Three
    half: tuple[float | int, float | int]
    texture: Texture
    base: float | int = 0.0  # ln intensity added to the texture's
    turn: Three = (0.0, 0.0, 0.0)
    ellipse: bool = True


@dataclasses.dataclass(frozen=True, eq=False)
class World:
    """The inside of a box from `lower` to `upper` (m), in which the camera is, and patches in it.

    All walls have the same texture, which fades near their edges. Patches are seen before the
    walls, and each before those that come ahead of it in `patches`: give the farthest first. Their
    outlines are drawn out over a pixel.
    """

    lower: Three
    upper: Three
    texture: Texture
    patches: tuple[Patch, ...] = ()

    def seen(
        self, centre: NDArray[np.float64], ray: NDArray[np.float64], pixel: float | int
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """ln intensity and depth (n,) along rays (n, 3) that advance by 1 in depth.

        `pixel` is the angle of a pixel, 1 / f. Raises `InputError` where the camera has left the
        box.
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
        edge = np.minimum(edge[rows, first], edge[rows, second]) / (_FADE * self.texture.grain)
        # Rows and columns of a wall are the world's axes; on walls before and behind x and y.
        u, v = hit[rows, np.where(axis == 2, 0, first)], hit[rows, np.where(axis == 2, 1, second)]
        level = self.texture(u, v) * _smooth(edge)
        size = np.sqrt(np.einsum("ni,ni->n", ray, ray))
        for patch in self.patches:
            self._before(patch, centre, ray, size, pixel, level, depth)
        return level, depth

    @staticmethod
    def _before(
        patch: Patch,
        centre: NDArray[np.float64],
        ray: NDArray[np.float64],
        size: NDArray[np.float64],
        pixel: float | int,
        level: NDArray[np.float64],
        depth: NDArray[np.float64],
    ) -> None:
        """Draw a patch over `level` and `depth`; `size` is the rays' length."""
        across, down, normal = Rotation.from_rotvec(patch.turn).as_matrix().T
        towards = np.asarray(patch.centre) - centre
        # Only rays that meet the sphere about the patch, drawn out by two pixels.
        away = float(np.linalg.norm(towards))
        sine = math.hypot(*patch.half) / away + 2 * pixel
        along = ray @ (towards / away)
        close = along > math.sqrt(max(1 - sine * sine, 0)) * size
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
        cover = _smooth(inside / (reach * pixel * 2) + 0.5)
        some = cover > 0
        near, cover, reach = near[some], cover[some], reach[some]
        own = patch.base + patch.texture(u[some], v[some])
        level[near] += cover * (own - level[near])
        depth[near] = np.where(cover > 0.5, reach, depth[near])


def _smooth(a: NDArray[np.float64]) -> NDArray[np.float64]:
    a = np.clip(a, 0, 1)
    return a * a * (3 - 2 * a)


@dataclasses.dataclass(frozen=True, eq=False)
class MovingCamera:
    """A camera in a world, a `Source` for `simulate`, and the truth of its motion.

    `size` is (width, height), `duration` in s. The lens is `lens`, or one without distortion, of
    the focal length `focal` (px), whose principal point is the middle of the image. Times of the
    truth are integers (us) or floats (s) from 0 to the duration; `InputError` is raised for others,
    and for a lens whose distortion has no inverse in the image.
    """

    world: World
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
        """Linear intensity (height, width) at t seconds."""
        return np.exp(self._seen(float(t))[0])

    def depth(self, time: Times) -> NDArray[np.float64]:
        """True depth (height, width) in m at one time."""
        return self._seen(float(self._seconds(time)[0]))[1]

    def twist(self, times: Times) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """True T (times, 3) in m/s and Omega (times, 3) in rad/s."""
        twist = self.motion.twist(self._seconds(times))
        return twist[:, :3], twist[:, 3:]

    def velocity(self, times: Times) -> NDArray[np.float64]:
        """True flow (times, 2) in px/s at the principal point: all over the image in planar motion.

        Its depth is that on the optical axis.
        """
        t = self._seconds(times)
        twist = self.motion.twist(t)
        axis = np.array([0.0, 0.0, 1.0])
        depth = np.empty(len(t))
        for k, pose in enumerate(self.motion.pose(t)):
            ray = (pose[:3, :3] @ axis)[None]
            depth[k] = self.world.seen(pose[:3, 3], ray, 1 / self._f)[1][0]
        turn = np.stack([-twist[:, 4], twist[:, 3]], 1)
        return self._f * (turn - twist[:, :2] / depth[:, None])

    def pose(self, times: Times) -> NDArray[np.float64]:
        """True camera-to-world poses (times, 4, 4)."""
        return self.motion.pose(self._seconds(times))

    def poses(self, rate: float | int = _POSE_RATE) -> Poses:
        """Poses as a recording holds them, `rate` per second."""
        count = math.floor(self.duration * rate + 1e-9) + 1
        t = np.rint(np.arange(count) / rate * 1e6).astype(np.int64)
        pose = self.motion.pose(t * 1e-6)
        return Poses(t, pose[:, :3, 3], Rotation.from_matrix(pose[:, :3, :3]).as_quat())

    def _seen(self, t: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        pose = self.motion.pose(np.array([t]))[0]
        level, depth = self.world.seen(pose[:3, 3], self._rays @ pose[:3, :3].T, 1 / self._f)
        return level.reshape(self.size[::-1]), depth.reshape(self.size[::-1])

    @functools.cached_property
    def _rays(self) -> NDArray[np.float64]:
        width, height = self.size
        y, x = np.mgrid[:height, :width].reshape(2, -1)
        seen = self.camera.normalise(x, y)
        if np.isnan(seen).any():
            raise InputError(
                f"the lens {self.camera} has no inverse in an image of {width}x{height} pixels; "
                "give a longer focal length or less distortion"
            )
        return np.concatenate([seen, np.ones((len(x), 1))], 1)

    @property
    def _f(self) -> float:
        """The focal length of both axes (px), their geometric mean."""
        return math.sqrt(self.camera.fx * self.camera.fy)

    def _seconds(self, times: Times) -> NDArray[np.float64]:
        rounded = np.atleast_1d(microseconds(times))
        given = np.atleast_1d(np.asarray(times))
        if ((rounded < 0) | (rounded > math.ceil(self.duration * 1e6))).any():
            raise InputError(
                f"the motion is known from 0 to {self.duration} s, not at {rounded.min()} to "
                f"{rounded.max()} us; integers are microseconds, floats seconds"
            )
        return np.asarray(given if given.dtype.kind == "f" else rounded * 1e-6, np.float64)


def simulate_motion(
    source: MovingCamera, sensor: Sensor | None = None, seed: int = 0, name: str = "motion"
) -> Recording:
    """Record a moving camera, with its calibration and its poses at 200 Hz; see `simulate`.

    The sensor's default is ideal: thresholds of 0.2, no dead time and no noise, stamps to the
    microsecond; intensity is taken to change linearly within steps in which 95 % of the pixels
    change by half a threshold or less, 0.1 ms or longer. It takes 25 frames/s, each of one instant.
    Intensity 1 is even ground. Deterministic in `seed`, which draws where between the thresholds a
    pixel starts, and the noise of other sensors.
    """
    recording = simulate(source, _IDEAL if sensor is None else sensor, seed, name)
    return dataclasses.replace(recording, camera=source.camera, poses=source.poses())


_GRAIN = 0.012  # m: 1 px at 2.4 m and f = 200 px


def _room(kind: str, depth: float, seed: int) -> tuple[Three, Three, Texture]:
    lower: Three = (-3.5, -3.5, -3.0)
    return lower, (3.5, 3.5, depth), texture_of(kind, _GRAIN, seed)


def _scattered(
    rng: np.random.Generator, kinds: Sequence[str], count: int, half: tuple[float, float]
) -> tuple[Patch, ...]:
    """Patches at 1.4 to 3 m within 75 degrees of the axis, the farthest first.

    Their half axes are `half` times their distance.
    """
    textures = [texture_of(kind, _GRAIN * 0.7, int(rng.integers(1 << 30)), 1.0) for kind in kinds]
    distance = np.sort(rng.uniform(1.4, 3.0, count))[::-1]
    patches = []
    for k, r in enumerate(distance):
        # Even over the sphere.
        cosine = rng.uniform(math.cos(math.radians(75)), 1)
        azimuth = rng.uniform(0, 2 * np.pi)
        sine = math.sqrt(1 - cosine**2)
        direction = np.array([sine * np.cos(azimuth), sine * np.sin(azimuth), cosine])
        x, y, z = (r * direction).tolist()
        # It faces the camera, but for some 20 degrees.
        facing = Rotation.align_vectors([direction], [[0, 0, 1]])[0]
        turn = facing * Rotation.from_rotvec(rng.normal(0, 0.25, 3))
        a, b = (rng.uniform(*half, 2) * r).tolist()
        tx, ty, tz = turn.as_rotvec().tolist()
        base = float(rng.choice([-0.7, -0.4, 0.4, 0.7]))
        patches.append(
            Patch((x, y, z), (a, b), textures[k % len(textures)], base, (tx, ty, tz), k % 2 == 0)
        )
    return tuple(patches)


def _unit(rng: np.random.Generator, dimensions: int = 3) -> NDArray[np.float64]:
    v = rng.normal(size=dimensions)
    return v / np.linalg.norm(v)


def _six(T: ArrayLike, Omega: ArrayLike) -> Six:
    a, b, c, d, e, f = np.concatenate([np.asarray(T, float), np.asarray(Omega, float)]).tolist()
    return a, b, c, d, e, f


def _drawn(rng: np.random.Generator, motion: str, speed: float, rate: float) -> CameraMotion:
    """A motion of the mean |T| = speed and |Omega| = rate in random directions."""
    T, Omega = speed * _unit(rng), rate * _unit(rng)
    if motion == "constant":
        return CameraMotion(_six(T, Omega))
    if motion == "linear":
        return CameraMotion(
            _six(0.5 * T, 0.5 * Omega), _six(2 * speed * _unit(rng), 2 * rate * _unit(rng))
        )
    return CameraMotion(
        _six(T, Omega),
        amplitude=_six(0.6 * speed * _unit(rng), 0.6 * rate * _unit(rng)),
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
    """A scene of `MOTION_SCENES` by name, recorded by an ideal event camera, and its truth.

    - planar: a wall at 2 m that moves in a random direction through the image, of `texture`
      "noise" (default) or "shapes", at `speed` px/s, 200 by default; linear: from half of that,
      gaining 3 times `speed` per second; varying: speed (1 + sin(2 pi 2 Hz t) / 2);
    - rotation: "texture" seen by a camera that only turns, by default at `speed` = 2 rad/s;
    - wall: a wall at 2 m in a room 7 m wide, of `texture` "noise" by default: little parallax;
    - shapes: 60 plain shapes at 1.4 to 3 m before a plain wall at 3.2 m;
    - texture: 24 textured patches at 1.4 to 3 m before a textured wall at 3.2 m.

    The last three have the mean |T| drawn from 0.6 to 1 m/s (or `speed`) and |Omega| from 0.4 to
    1.8 rad/s, in random directions. "varying" motion adds sinusoids of 1 to 2 Hz to each component
    of T and Omega, with vectors of amplitudes of random direction and 60 % of the mean's length;
    "linear" starts at half the drawn motion and changes in a random direction by twice its length
    per second. `lens` is that of `MovingCamera`. Deterministic in `seed`.

    Raises `InputError` for an unknown name or motion, and where the camera leaves the world.
    """
    if name not in MOTION_SCENES:
        raise InputError(f"there is no scene {name!r}; {suggest_name(name, MOTION_SCENES)}")
    if motion not in get_args(Change):
        raise InputError(f"there is no motion {motion!r}; {suggest_name(motion, get_args(Change))}")
    names = MOTION_SCENES.index(name)
    rng = np.random.default_rng([seed, names])
    texture_seed = int(rng.integers(1 << 30))
    if name == "planar":
        pace = 200.0 if speed is None else float(speed)
        direction = _unit(rng, 2)

        def pair(factor: float | int) -> tuple[float, float]:
            x, y = (factor * pace * direction).tolist()
            return x, y

        world = World(
            (-50, -50, -1), (50, 50, 2), texture_of(texture or "noise", 2 / focal, texture_seed)
        )
        moved = {
            "constant": lambda: planar_motion(pair(1), 2, focal),
            "linear": lambda: planar_motion(pair(0.5), 2, focal, slope=pair(3)),
            "varying": lambda: planar_motion(pair(1), 2, focal, amplitude=pair(0.5)),
        }[motion]()
    else:
        kind = {"shapes": "plain"}.get(name, "noise") if texture is None else texture
        room = _room(kind, 2.0 if name == "wall" else 3.2, texture_seed)
        patches = ()
        if name != "wall":
            patches = (
                _scattered(rng, ("plain",), 60, (0.05, 0.16))
                if name == "shapes"
                else _scattered(rng, ("noise", "shapes"), 24, (0.1, 0.24))
            )
        world = World(*room, patches)
        if name == "rotation":
            moved = _drawn(rng, motion, 0.0, 2.0 if speed is None else float(speed))
        else:
            pace = rng.uniform(0.6, 1.0) if speed is None else float(speed)
            moved = _drawn(rng, motion, pace, rng.uniform(0.4, 1.8))
    source = MovingCamera(world, moved, size, focal, duration, lens)
    return simulate_motion(source, sensor, seed, f"{name} {motion}"), source


def frame_events(
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
    """Events of the egomotion thesis' generator (appendix B), and the true velocities in px/s.

    `flow` (frames, 2) is the image velocity in px/frame, frames being `step` us apart: at frame k
    the image shows what the one before showed, moved by flow[k]. A pixel whose value changes by
    more than `threshold` between frames makes one event, at the later frame's time (k + 1) step
    (B.11). The large `image` (rows, columns) of values is sampled directly, bilinearly, as a torus;
    the start is drawn by `seed`. Default: 512 x 512 pixels of smooth noise, of deviation 0.5.
    `noise` adds random events, as many per frame as that times the number of pixels. The second
    result (frames, 2) is flow / step. Size is (width, height).

    Corrected against the print: the weights of B.10 are those of the nearer neighbours, and the
    upper neighbour is the lower one plus 1, without which whole-numbered places have no weight;
    I_t is not warped from I_(t-1), which blurs it more with every frame.

    Raises `InputError` for settings that are not possible, and if there is no event.
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
    place = begin - np.concatenate([np.zeros((1, 2)), np.cumsum(flow, axis=0)])
    y, x = np.mgrid[:height, :width]
    before = _bilinear(image, x + place[0, 0], y + place[0, 1])
    parts = []
    for k, (px, py) in enumerate(place[1:], start=1):
        now = _bilinear(image, x + px, y + py)
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


def _bilinear(
    image: NDArray[np.float64], x: NDArray[np.float64], y: NDArray[np.float64]
) -> NDArray[np.float64]:
    """B.10: v = d2 (d0 v0 + d1 v1) + d3 (d0 v2 + d1 v3), d0 = i_p - x, d1 = x - i_m."""
    height, width = image.shape
    i, j = np.floor(x).astype(int), np.floor(y).astype(int)
    d1, d3 = x - i, y - j
    i_m, i_p, j_m, j_p = i % width, (i + 1) % width, j % height, (j + 1) % height
    upper = (1 - d1) * image[j_m, i_m] + d1 * image[j_m, i_p]
    lower = (1 - d1) * image[j_p, i_m] + d1 * image[j_p, i_p]
    return (1 - d3) * upper + d3 * lower
