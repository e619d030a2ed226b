"""Models of the camera's motion: what its components are, and how they move the image.

A model is one class: a `Model` with a name and components, and the flow that they make. To add one:
the class and a line in `MODELS`, or from outside "package.module:Class" wherever a model is asked
for. The least that it takes, here a zoom (1/s) and a roll (rad/s) about the image's centre:

    class ZoomRoll(Model):
        name, title = "zoom-roll", "zoom and roll"
        components, units = ("zoom", "roll"), ("1/s", "rad/s")
        parts = (Part("rates", slice(0, 2), "1/s"),)

        def basis(self, xi):
            x, y = xi[..., 0], xi[..., 1]
            return jnp.stack([jnp.stack([x, -y], -1), jnp.stack([y, x], -1)], -2)

        def extent(self, params):
            return params.omega_max

        def diffusion(self, params, mean):
            return jnp.broadcast_to(params.noise_rotation, (2,))

Methods of one place and one motion are pure functions that are mapped with `jax.vmap`.
"""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float
from numpy.typing import NDArray

from jaxevent.devices import full_precision
from jaxevent.egomotion.geometry import A, rotation_basis, rotation_exp, unit
from jaxevent.errors import InputError
from jaxevent.estimator import imported
from jaxevent.parameters import suggest_name

if TYPE_CHECKING:
    from jaxevent.egomotion.twists import Twists

Numeric = Array | np.ndarray
Params = Any  # of the method that asks
SLOWEST = 0.3  # baseline / tau_max, the slowest of the first planar hypotheses


@dataclasses.dataclass(frozen=True)
class Part:
    """Components that belong together: a vector, or a direction, which is a unit vector.

    `figure` is what `scores.motion_errors` calls such vectors.
    """

    name: str
    rows: slice
    unit: str
    figure: str = "V"
    direction: bool = False


class Model(eqx.Module):
    """How `components` of a motion move the image: U = basis(xi) @ motion, of dimension d.

    Places xi (px) are undistorted, from the principal point, where there is a camera, and else from
    the middle of the sensor. A model with `half_line` adds a speed from 0 on along a unit vector
    that `line` tells, as the depth is not known.

    Attributes:
        f: The focal length (px) that places belong to; 1 without a camera.
        name: How configurations and the command line call it.
        title: What it is, in words that go on a sentence.
        components: Their names, of columns of tables.
        units: Of the components; "1": none.
        parts: Which components form a vector, and which a direction.
        needs_camera: Whether its flow depends on a calibration.
        uniform: Whether the flow is the same everywhere.
        half_line: Whether the flow is known up to a speed only.
        known_from: What tells its truth, beside tables: "poses", "gyro".
        fits_depth: Whether poses tell its truth up to the depth of the scene, see `at_one_depth`.
        unknown: The spread of a motion that nothing tells, in its unit.
        method: The method that suits it best.
        otherwise: The method to try where that finds nothing, if there is one.
        preset: Of the parameters of voting, that it starts with.
    """

    f: float = eqx.field(static=True, default=1.0)

    name: ClassVar[str]
    title: ClassVar[str]
    components: ClassVar[tuple[str, ...]]
    units: ClassVar[tuple[str, ...]]
    parts: ClassVar[tuple[Part, ...]]
    needs_camera: ClassVar[bool] = False
    uniform: ClassVar[bool] = False
    half_line: ClassVar[bool] = False
    known_from: ClassVar[tuple[str, ...]] = ()
    fits_depth: ClassVar[bool] = False
    unknown: ClassVar[float] = 10.0
    method: ClassVar[str] = "voting"
    otherwise: ClassVar[str | None] = "contrast"
    preset: ClassVar[str | None] = None

    @property
    def dimension(self) -> int:
        """The number of components, d."""
        return len(self.components)

    # The image's motion.

    def basis(self, xi: Float[Numeric, "*places 2"]) -> Float[Numeric, "*places 2 d"]:
        """How the components move the image at xi: (px/s) per unit."""
        raise NotImplementedError

    @full_precision
    def flow(self, xi: Float[Array, "2"], motion: Float[Array, " d"]) -> Float[Array, "2"]:
        """The flow (px/s) at a place, of a half-line its begin."""
        return jnp.asarray(self.basis(xi)) @ motion

    def line(self, xi: Float[Array, "2"], motion: Float[Array, " d"]) -> Float[Array, "2"]:
        """The unit vector along which the flow of a half-line may be faster."""
        raise NotImplementedError

    def warp(
        self, xi: Float[Numeric, "*places 2"], way: Float[Numeric, "*places d"]
    ) -> Float[Array, "*places 2"]:
        """Where places xi were before motions whose integrals over time are `way`.

        By a Runge-Kutta step of 4th order along the flow; speeds along half-lines are left out.
        """
        flow = jnp.vectorize(self.flow, signature="(i),(d)->(i)")
        xi, way = jnp.asarray(xi), -jnp.asarray(way)
        one = flow(xi, way)
        two = flow(xi + one / 2, way)
        three = flow(xi + two / 2, way)
        four = flow(xi + three, way)
        return xi + (one + 2 * two + 2 * three + four) / 6

    def arms(self, xi: Float[np.ndarray, "*places 2"]) -> NDArray[np.float64]:
        """How far (px) a unit of each component moves the image at some places, about."""
        columns = np.asarray(self.basis(xi), np.float64)
        return np.sqrt((columns**2).sum(-2).reshape(-1, self.dimension).mean(0))

    # Particles.

    def extent(self, params: Params) -> Float[Array, ""]:
        """The largest first motion, in every component."""
        raise NotImplementedError

    def first(self, params: Params, even: Float[Array, " d"]) -> Float[Array, " d"]:
        """A particle anywhere, of even numbers in [-1, 1]."""
        return even * lax.stop_gradient(self.extent(params))

    def diffusion(self, params: Params, mean: Float[Array, " d"]) -> Float[Array, " d"]:
        """Process noise per sqrt(s)."""
        raise NotImplementedError

    def oldest(self, params: Params) -> Float[Array, ""]:
        """The age (s) of the oldest candidates that a search looks at."""
        return params.tau_max

    def certain(
        self, params: Params, mean: Float[Array, " d"], covariance: Float[Array, "d d"]
    ) -> Bool[Array, ""]:
        """Whether the cloud is narrow enough for a search to end."""
        return self.spreads(covariance)[0] < params.found * jnp.sqrt((mean**2).sum())

    # The manifold: directions are moved across themselves, and stay of length 1.

    def moved(self, motion: Float[Array, " d"], step: Float[Array, " d"]) -> Float[Array, " d"]:
        """A motion after a random step."""

        def one(part: Part, motion: Array, step: Array) -> Array:
            if not part.direction:
                return motion + step
            return unit(motion + step - motion * (motion * step).sum())

        return self._by_part(one, motion, step)

    def on_manifold(self, motion: Float[Array, " d"]) -> Float[Array, " d"]:
        """A motion with its directions made unit vectors."""
        return self._by_part(lambda part, v: unit(v) if part.direction else v, motion)

    @full_precision
    def mean(
        self, particles: Float[Array, "N d"], weights: Float[Array, " N"]
    ) -> Float[Array, " d"]:
        """The weighted mean; of directions that of the mean vector."""
        return self.on_manifold(weights @ particles)

    @full_precision
    def apart(self, motion: Float[Array, " d"], mean: Float[Array, " d"]) -> Float[Array, " d"]:
        """How far a motion is from the mean, as the covariance counts it."""

        def one(part: Part, apart: Array, mean: Array) -> Array:
            return apart - (apart @ mean) * mean if part.direction else apart

        return self._by_part(one, motion - mean, mean)

    @full_precision
    def share(
        self, particles: Float[Array, "N d"], weights: Float[Array, " N"]
    ) -> Float[Array, "N 1"]:
        """The size of each motion, in what is usual among them; 1 of a direction, that has none."""
        if any(part.direction for part in self.parts):
            return jnp.ones_like(particles[:, :1])
        size2 = lax.stop_gradient((particles**2).sum(1, keepdims=True))
        return jnp.sqrt((size2 + 1e-12) / (weights @ size2 + 1e-12))

    def spreads(self, covariance: Float[Array, "d d"]) -> Float[Array, " d"]:
        """The standard deviation of a component, the same for all of a part."""

        def one(part: Part, variance: Array) -> Array:
            n = len(variance)
            mean = variance.sum() / (n - 1) if part.direction else variance.mean()
            return jnp.broadcast_to(jnp.sqrt(mean), (n,))

        return self._by_part(one, jnp.diagonal(covariance))

    def _by_part(self, function: Any, *vectors: Array) -> Array:
        cut = [function(part, *(v[part.rows] for v in vectors)) for part in self.parts]
        return cut[0] if len(cut) == 1 else jnp.concatenate(cut)

    # What is known, on the host.

    @classmethod
    def between(
        cls, one: NDArray[np.floating], two: NDArray[np.floating], share: NDArray[np.floating]
    ) -> NDArray[np.floating]:
        """Motions (n, d) between others, at shares (n,) of the way."""
        share = share[:, None]
        mean = (1 - share) * one + share * two
        for part in cls.parts:
            if part.direction:
                v = mean[:, part.rows]
                size = np.linalg.norm(v, axis=1, keepdims=True)
                v = np.where(size > 0, v, one[:, part.rows])
                mean[:, part.rows] = v / np.where(size > 0, size, 1)
        return mean

    @classmethod
    def of_twist(
        cls, T: NDArray[np.floating] | None, Omega: NDArray[np.floating]
    ) -> NDArray[np.float64]:
        """The motions (n, d) of camera twists (n, 3), of those in `known_from`."""
        raise NotImplementedError

    @classmethod
    def of_scene(cls, source: Any, times: Any) -> NDArray[np.float64]:
        """The motions (n, d) of a simulated camera (`simulate.motion.MovingCamera`)."""
        return cls.of_twist(*source.twist(times))

    @classmethod
    def at_one_depth(
        cls, twists: "Twists", f: float, mean: NDArray[np.floating]
    ) -> NDArray[np.float64]:
        """The motions (n, d) of twists at the depth that fits estimates (n, d), NaN where lost."""
        raise NotImplementedError

    @classmethod
    def at_depth(cls, twists: "Twists", f: float, depth: float) -> NDArray[np.float64]:
        """The motions (n, d) of twists before a scene at a depth (m)."""
        raise NotImplementedError


class Planar(Model):
    """The image velocity (px/s), the same everywhere."""

    name, title = "planar", "planar motion"
    components, units = ("vx", "vy"), ("px/s", "px/s")
    parts = (Part("image velocity", slice(0, 2), "px/s", "U"),)
    uniform = True
    fits_depth = True
    unknown = 1e3

    def basis(self, xi):
        xp = np if isinstance(xi, np.ndarray) else jnp
        return xp.broadcast_to(xp.eye(2, dtype=xi.dtype), (*xi.shape[:-1], 2, 2))

    def warp(self, xi, way):
        return xi - way

    def extent(self, params):
        return params.speed_max

    def first(self, params, even):
        """Even in direction and in the logarithm of speed: a search has to come within a share."""
        fastest = lax.stop_gradient(self.extent(params))
        slowest = lax.stop_gradient(SLOWEST * params.baseline / params.tau_max)
        speed = fastest * (slowest / fastest) ** ((1 + even[0]) / 2)
        azimuth = jnp.pi * even[1]
        return speed * jnp.stack([jnp.cos(azimuth), jnp.sin(azimuth)])

    def diffusion(self, params, mean):
        """A share of the speed, which counts as at least baseline / tau_max."""
        slowest = params.baseline / params.tau_max
        return jnp.broadcast_to(params.noise * jnp.sqrt((mean**2).sum() + slowest**2), (2,))

    @classmethod
    def of_scene(cls, source, times):
        return source.velocity(times)

    @classmethod
    def at_one_depth(cls, twists, f, mean):
        """U = f (-Omega_y - T_x / Z, Omega_x - T_y / Z), Z by least squares."""
        T, Omega = twists.T, twists.Omega
        assert T is not None  # poses tell it
        turn = f * np.stack([-Omega[:, 1], Omega[:, 0]], 1)
        across = -f * T[:, :2]
        use = np.isfinite(mean).all(1)
        square = (across[use] ** 2).sum()
        rho = ((mean - turn)[use] * across[use]).sum() / square if square > 0 else 0.0
        return turn + max(float(rho), 0.0) * across

    @classmethod
    def at_depth(cls, twists, f, depth):
        if not depth > 0:
            raise InputError(f"the depth {depth:g} is not possible; give metres above 0")
        T, Omega = twists.T, twists.Omega
        assert T is not None  # poses tell it
        return f * (np.stack([-Omega[:, 1], Omega[:, 0]], 1) - T[:, :2] / depth)


class Rotation(Model):
    """The camera's angular velocity (rad/s): U = B Omega, eq 6.1 with its misprint mended."""

    name, title = "rotation", "rotation"
    components, units = ("wx", "wy", "wz"), ("rad/s",) * 3
    parts = (Part("angular velocity", slice(0, 3), "rad/s", "Omega"),)
    needs_camera = True
    known_from = ("poses", "gyro")

    def basis(self, xi):
        return rotation_basis(xi, self.f)

    def warp(self, xi, way):
        """x = f (X_x, X_y) / X_z of the ray X after exp(way)."""
        return _turned(xi, way, self.f)

    def arms(self, xi):
        return np.array([self.f, self.f, float(np.sqrt((xi**2).sum(-1).mean()))])

    def extent(self, params):
        return params.omega_max

    def diffusion(self, params, mean):
        return jnp.broadcast_to(params.noise_rotation, (3,))

    @classmethod
    def of_twist(cls, T, Omega):
        return Omega


class General(Model):
    """The camera's heading, a unit vector, and its angular velocity (rad/s).

    The flow is on a half-line, see `geometry.half_line_residual`: B Omega + rho a, a = A T / |A T|,
    with rho from 0 on, as depth is not known.
    """

    name, title = "general", "general motion"
    components = ("tx", "ty", "tz", "wx", "wy", "wz")
    units = ("1", "1", "1", "rad/s", "rad/s", "rad/s")
    parts = (
        Part("heading", slice(0, 3), "1", "T", direction=True),
        Part("angular velocity", slice(3, 6), "rad/s", "Omega"),
    )
    needs_camera = True
    half_line = True
    known_from = ("poses",)
    method, otherwise = "batch", None
    preset = "general"

    def basis(self, xi):
        """0 for the heading, which tells the half-line's direction alone."""
        turning = rotation_basis(xi, self.f)
        xp = np if isinstance(turning, np.ndarray) else jnp
        return xp.concatenate([xp.zeros_like(turning), turning], -1)

    @full_precision
    def flow(self, xi, motion):
        return rotation_basis(xi, self.f) @ motion[3:]

    @full_precision
    def line(self, xi, motion):
        """0 in the focus of expansion."""
        along = A(xi[0], xi[1], jnp.asarray(self.f, xi.dtype)) @ motion[:3]
        return along / jnp.sqrt(jnp.maximum((along**2).sum(), 1e-12))

    def warp(self, xi, way):
        """The rotation's part alone."""
        return _turned(xi, way[..., 3:], self.f)

    def extent(self, params):
        return params.omega_max

    def first(self, params, even):
        """Headings all over the sphere."""
        z, azimuth = even[0], jnp.pi * even[1]
        ring = jnp.sqrt(1 - z**2)
        heading = jnp.stack([ring * jnp.cos(azimuth), ring * jnp.sin(azimuth), z])
        return jnp.concatenate([heading, even[3:] * lax.stop_gradient(self.extent(params))])

    def diffusion(self, params, mean):
        return _six(params.noise_heading, params.noise_rotation)

    def oldest(self, params):
        return params.tau_general

    def certain(self, params, mean, covariance):
        heading, *_, turning = self.spreads(covariance)
        limit = params.found_heading
        return (heading < limit) & (turning < limit * self.extent(params))

    @classmethod
    def of_twist(cls, T, Omega):
        T = np.asarray(T)
        largest = np.abs(T).max(-1, keepdims=True)
        T = T / np.where(largest > 0, largest, 1)
        size = np.linalg.norm(T, axis=-1, keepdims=True)
        return np.concatenate([T / np.where(size > 0, size, 1), Omega], 1)


MODELS: Mapping[str, type[Model]] = {model.name: model for model in (Planar, Rotation, General)}


@functools.cache
def _load(path: str) -> type[Model]:
    found = imported(path, type, "motion model")
    if not issubclass(found, Model):
        raise InputError(f"{path!r} is no motion model; give a subclass of egomotion.Model")
    return found


def find_model(model: str | type[Model]) -> type[Model]:
    """The model of that name, or of "package.module:Class", or the class itself.

    Raises `InputError` for an unknown name, naming the nearest.
    """
    if not isinstance(model, str):
        return model
    if ":" in model:
        return _load(model)
    if model not in MODELS:
        raise InputError(f"there is no motion model {model!r}; {suggest_name(model, MODELS)}")
    return MODELS[model]


def in_words(models: Sequence[str]) -> str:
    """As in "planar and rotation"."""
    return " and ".join(filter(None, [", ".join(models[:-1]), *models[-1:]]))


def _six(heading: Array, turning: Array) -> Float[Array, "6"]:
    return jnp.concatenate([jnp.broadcast_to(v, (3,)) for v in (heading, turning)])


def _turned(xi: Numeric, way: Numeric, f: float | Float[Array, ""]) -> Float[Array, "*places 2"]:
    """Places after rotations of the rays, exp(way)."""
    R = rotation_exp(way)
    x, y, z = (
        R[..., k, 0] * xi[..., 0] + R[..., k, 1] * xi[..., 1] + R[..., k, 2] * f for k in range(3)
    )
    # A direction behind the camera has no place: far outside the image.
    ahead = z > 1e-3 * f
    z = jnp.where(ahead, z, 1)
    return jnp.where(ahead[..., None], f * jnp.stack([x, y], -1) / z[..., None], 1e6)
