"""Models of the camera's motion: their components, and how these move the image.

A model is one class: a `Model` with a name, components, and the flow that they make. To add one,
write the class and a line in `MODELS`. From outside give "package.module:Class" wherever a model is
an option. A minimal model has a zoom (1/s) and a roll (rad/s) about the centre of the image:

    class ZoomRoll(Model):
        name, title = "zoom-roll", "zoom and roll"
        components, units = ("zoom", "roll"), ("1/s", "rad/s")
        parts = (Part("rates", slice(0, 2), "1/s"),)

        def basis(self, xi):
            x, y = xi[..., 0], xi[..., 1]
            return jnp.stack([jnp.stack([x, -y], -1), jnp.stack([y, x], -1)], -2)

        def search_bound(self, params):
            return params.omega_max

        def diffusion(self, params, mean):
            return jnp.broadcast_to(params.noise_rotation, (2,))

Methods of one position and one motion are pure functions, to be mapped by `jax.vmap`.
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

from jaxevent.deprecated import renamed_methods
from jaxevent.egomotion.geometry import A, rotation_basis, rotation_exp, unit
from jaxevent.errors import InputError
from jaxevent.estimator import import_object
from jaxevent.parameters import check_choice
from jaxevent.precision import full_precision

if TYPE_CHECKING:
    from jaxevent.egomotion.truth import Twists

Numeric = Array | np.ndarray
Params = Any  # of the method that calls
MIN_SEARCH_BASELINES_PER_TAU = (
    0.3  # baselines per tau_max: the slowest of the first planar hypotheses
)


@dataclasses.dataclass(frozen=True)
class Part:
    """Components that form one vector, or a direction, which is a unit vector.

    Attributes:
        name: Name in messages and tables.
        rows: Components of the motion that belong to it.
        unit: Unit of the components; "1" without one.
        figure: Name of such vectors in `scores.motion_errors`: "U", "T", "Omega" or "V".
        direction: Whether the vector is a direction.
    """

    name: str
    rows: slice
    unit: str
    figure: str = "V"
    direction: bool = False


@renamed_methods(
    known_from="truth_sources", unknown="prior_sigma", method="best_method",
    otherwise="fallback_method", line="half_line_direction", arms="pixel_scale",
    extent="search_bound", first="initial_particle", oldest="max_age", certain="is_converged",
    moved="retract", on_manifold="project", apart="deviation", share="relative_size",
    spreads="standard_deviations", between="interpolate", of_twist="from_twist",
    of_scene="from_scene", at_one_depth="from_twists_at_fitted_depth",
    at_depth="from_twists_at_depth",
)  # fmt: skip
class Model(eqx.Module):
    """A motion of d components that moves the image by the flow U = basis(xi) @ motion.

    Positions xi (px) are undistorted and relative to the principal point, if there is a camera, and
    else to the middle of the sensor. The flow of a model with `half_line` is determined up to a
    speed from 0 on, along `half_line_direction`, because the depth is unknown.

    Attributes:
        f: Focal length (px) of the positions; 1 without a camera.
        name: Name in configurations and on the command line.
        title: Name in sentences.
        components: Names of the components, of columns of tables.
        units: Units of the components; "1" without one.
        parts: The vectors and directions that the components form.
        needs_camera: Whether the flow depends on a calibration.
        uniform: Whether the flow is the same everywhere.
        half_line: Whether the flow is determined up to a speed only.
        truth_sources: Sources of its true motion beside tables: "poses", "gyro".
        fits_depth: Whether poses give its true motion up to the depth of the scene, see
            `from_twists_at_fitted_depth`.
        prior_sigma: Standard deviation of a motion about which nothing is known.
        best_method: The method that suits the model best.
        fallback_method: The method to try if that one finds no motion, or None.
        preset: The preset of the parameters of `voting` that suits the model, or None.
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
    truth_sources: ClassVar[tuple[str, ...]] = ()
    fits_depth: ClassVar[bool] = False
    prior_sigma: ClassVar[float] = 10.0
    best_method: ClassVar[str] = "voting"
    fallback_method: ClassVar[str | None] = "contrast"
    preset: ClassVar[str | None] = None

    @property
    def dimension(self) -> int:
        """Number of components, d."""
        return len(self.components)

    # Motion of the image.

    def basis(self, xi: Float[Numeric, "*points 2"]) -> Float[Numeric, "*points 2 d"]:
        """Return the flow (*points, 2, d) at positions xi (px), px/s per unit of each component."""
        raise NotImplementedError

    @full_precision
    def flow(self, xi: Float[Array, "2"], motion: Float[Array, " d"]) -> Float[Array, "2"]:
        """Return the flow at a position; of a half-line its start.

        Args:
            xi: (2,) position, px.
            motion: (d,) components.

        Returns:
            (2,) flow, px/s.
        """
        return jnp.asarray(self.basis(xi)) @ motion

    def half_line_direction(
        self, xi: Float[Array, "2"], motion: Float[Array, " d"]
    ) -> Float[Array, "2"]:
        """Return the direction along which the flow of a half-line may be faster.

        Args:
            xi: (2,) position, px.
            motion: (d,) components.

        Returns:
            (2,) unit vector; 0 if there is no direction.
        """
        raise NotImplementedError

    def warp(
        self, xi: Float[Numeric, "*points 2"], integral: Float[Numeric, "*points d"]
    ) -> Float[Array, "*points 2"]:
        """Move positions back in time along a motion.

        By one Runge-Kutta step of 4th order along the flow. Speeds along half-lines are left out.

        Args:
            xi: (*points, 2) positions now, px.
            integral: (*points, d) integral of the motion over the time passed, units times s.

        Returns:
            (*points, 2) positions before, px.
        """
        flow = jnp.vectorize(self.flow, signature="(i),(d)->(i)")
        xi, back = jnp.asarray(xi), -jnp.asarray(integral)
        one = flow(xi, back)
        two = flow(xi + one / 2, back)
        three = flow(xi + two / 2, back)
        four = flow(xi + three, back)
        return xi + (one + 2 * two + 2 * three + four) / 6

    def pixel_scale(self, xi: Float[np.ndarray, "*points 2"]) -> NDArray[np.float64]:
        """Return the typical flow (d,) at positions xi, px/s per unit of each component."""
        columns = np.asarray(self.basis(xi), np.float64)
        return np.sqrt((columns**2).sum(-2).reshape(-1, self.dimension).mean(0))

    # Particles.

    def search_bound(self, params: Params) -> Float[Array, ""]:
        """Return the largest absolute value of each component of the first particles."""
        raise NotImplementedError

    def initial_particle(self, params: Params, uniform: Float[Array, " d"]) -> Float[Array, " d"]:
        """Place a particle of a search, from uniform random numbers.

        Args:
            params: Parameters of the method.
            uniform: (d,) random numbers, uniform in [-1, 1].

        Returns:
            (d,) motion.
        """
        return uniform * lax.stop_gradient(self.search_bound(params))

    def diffusion(self, params: Params, mean: Float[Array, " d"]) -> Float[Array, " d"]:
        """Return the process noise of each component.

        Args:
            params: Parameters of the method.
            mean: (d,) mean of the particles.

        Returns:
            (d,) standard deviation per sqrt(s).
        """
        raise NotImplementedError

    def max_age(self, params: Params) -> Float[Array, ""]:
        """Return the age (s) of the oldest candidates that a search uses."""
        return params.tau_max

    def is_converged(
        self, params: Params, mean: Float[Array, " d"], covariance: Float[Array, "d d"]
    ) -> Bool[Array, ""]:
        """Return whether the particles are so narrow that a search ends.

        Args:
            params: Parameters of the method.
            mean: (d,) mean of the particles.
            covariance: (d, d) covariance of the particles.

        Returns:
            A boolean.
        """
        return self.standard_deviations(covariance)[0] < params.found * jnp.sqrt((mean**2).sum())

    # The manifold: directions stay of length 1, their steps and covariances are tangential.

    def retract(self, motion: Float[Array, " d"], step: Float[Array, " d"]) -> Float[Array, " d"]:
        """Move a motion by a step, along the manifold.

        Args:
            motion: (d,) components.
            step: (d,) change; of a direction only its tangential part acts.

        Returns:
            (d,) motion.
        """

        def move(part: Part, motion: Array, step: Array) -> Array:
            if not part.direction:
                return motion + step
            return unit(motion + step - motion * (motion * step).sum())

        return self._by_part(move, motion, step)

    def project(self, motion: Float[Array, " d"]) -> Float[Array, " d"]:
        """Return a motion (d,) with its directions scaled to unit vectors."""
        return self._by_part(lambda part, v: unit(v) if part.direction else v, motion)

    @full_precision
    def mean(
        self, particles: Float[Array, "N d"], weights: Float[Array, " N"]
    ) -> Float[Array, " d"]:
        """Return the weighted mean of particles.

        Args:
            particles: (N, d) motions.
            weights: (N,) weights of sum 1.

        Returns:
            (d,) mean; of directions the direction of the mean vector.
        """
        return self.project(weights @ particles)

    @full_precision
    def deviation(self, motion: Float[Array, " d"], mean: Float[Array, " d"]) -> Float[Array, " d"]:
        """Return the deviation of a motion from a mean, as the covariance counts it.

        Args:
            motion: (d,) components.
            mean: (d,) components of the mean.

        Returns:
            (d,) difference; of directions its tangential part.
        """

        def subtract(part: Part, difference: Array, mean: Array) -> Array:
            return difference - (difference @ mean) * mean if part.direction else difference

        return self._by_part(subtract, motion - mean, mean)

    @full_precision
    def relative_size(
        self, particles: Float[Array, "N d"], weights: Float[Array, " N"]
    ) -> Float[Array, "N 1"]:
        """Return the size of each motion relative to the root mean square of all.

        Args:
            particles: (N, d) motions.
            weights: (N,) weights of sum 1.

        Returns:
            (N, 1) ratios; 1 for models with a direction.
        """
        if any(part.direction for part in self.parts):
            return jnp.ones_like(particles[:, :1])
        size2 = lax.stop_gradient((particles**2).sum(1, keepdims=True))
        return jnp.sqrt((size2 + 1e-12) / (weights @ size2 + 1e-12))

    def standard_deviations(self, covariance: Float[Array, "d d"]) -> Float[Array, " d"]:
        """Return the root mean square standard deviation of the part of each component, (d,)."""

        def average(part: Part, variance: Array) -> Array:
            n = len(variance)
            mean = variance.sum() / (n - 1) if part.direction else variance.mean()
            return jnp.broadcast_to(jnp.sqrt(mean), (n,))

        return self._by_part(average, jnp.diagonal(covariance))

    def _by_part(self, function: Any, *vectors: Array) -> Array:
        """Apply function(part, ...) to the rows of each part of some vectors (d,)."""
        results = [function(part, *(v[part.rows] for v in vectors)) for part in self.parts]
        return results[0] if len(results) == 1 else jnp.concatenate(results)

    # Known motions, on the host.

    @classmethod
    def interpolate(
        cls,
        before: NDArray[np.floating],
        after: NDArray[np.floating],
        fraction: NDArray[np.floating],
    ) -> NDArray[np.floating]:
        """Interpolate linearly between motions.

        Args:
            before: (n, d) motions.
            after: (n, d) motions.
            fraction: (n,) position between them, from 0 to 1.

        Returns:
            (n, d) motions, with directions scaled to unit vectors.
        """
        fraction = fraction[:, None]
        mean = (1 - fraction) * before + fraction * after
        for part in cls.parts:
            if part.direction:
                v = mean[:, part.rows]
                size = np.linalg.norm(v, axis=1, keepdims=True)
                v = np.where(size > 0, v, before[:, part.rows])
                mean[:, part.rows] = v / np.where(size > 0, size, 1)
        return mean

    @classmethod
    def from_twist(
        cls, T: NDArray[np.floating] | None, Omega: NDArray[np.floating]
    ) -> NDArray[np.float64]:
        """Convert camera twists from a source in `truth_sources`.

        Args:
            T: (n, 3) velocity, m/s, or None if it was not measured.
            Omega: (n, 3) angular velocity, rad/s.

        Returns:
            (n, d) motions.
        """
        raise NotImplementedError

    @classmethod
    def from_scene(cls, source: Any, times: Any) -> NDArray[np.float64]:
        """Return the true motions of a simulated camera.

        Args:
            source: A `simulate.motion.MovingCamera`.
            times: (n,) times, integers in us or floats in s.

        Returns:
            (n, d) motions.
        """
        return cls.from_twist(*source.twist(times))

    @classmethod
    def from_twists_at_fitted_depth(
        cls, twists: "Twists", f: float, mean: NDArray[np.floating]
    ) -> NDArray[np.float64]:
        """Convert camera twists at the one depth of the scene that fits estimates best.

        Args:
            twists: n camera twists, with T.
            f: Focal length, px.
            mean: (n, d) estimates at the times of the twists, NaN where lost.

        Returns:
            (n, d) motions.
        """
        raise NotImplementedError

    @classmethod
    def from_twists_at_depth(cls, twists: "Twists", f: float, depth: float) -> NDArray[np.float64]:
        """Convert camera twists in front of a scene at a known depth.

        Args:
            twists: n camera twists, with T.
            f: Focal length, px.
            depth: Depth of the scene, m.

        Returns:
            (n, d) motions.
        """
        raise NotImplementedError


class Planar(Model):
    """The image velocity (px/s), the same everywhere."""

    name, title = "planar", "planar motion"
    components, units = ("vx", "vy"), ("px/s", "px/s")
    parts = (Part("image velocity", slice(0, 2), "px/s", "U"),)
    uniform = True
    fits_depth = True
    prior_sigma = 1e3

    def basis(self, xi):
        xp = np if isinstance(xi, np.ndarray) else jnp
        return xp.broadcast_to(xp.eye(2, dtype=xi.dtype), (*xi.shape[:-1], 2, 2))

    def warp(self, xi, integral):
        return xi - integral

    def search_bound(self, params):
        return params.speed_max

    def initial_particle(self, params, uniform):
        # Uniform in direction and in the logarithm of speed: a search has to end within a fraction.
        fastest = lax.stop_gradient(self.search_bound(params))
        slowest = lax.stop_gradient(MIN_SEARCH_BASELINES_PER_TAU * params.baseline / params.tau_max)
        speed = fastest * (slowest / fastest) ** ((1 + uniform[0]) / 2)
        azimuth = jnp.pi * uniform[1]
        return speed * jnp.stack([jnp.cos(azimuth), jnp.sin(azimuth)])

    def diffusion(self, params, mean):
        # In proportion to the speed, which counts as at least baseline / tau_max.
        slowest = params.baseline / params.tau_max
        return jnp.broadcast_to(params.noise * jnp.sqrt((mean**2).sum() + slowest**2), (2,))

    @classmethod
    def from_scene(cls, source, times):
        return source.velocity(times)

    @classmethod
    def from_twists_at_fitted_depth(cls, twists, f, mean):
        # U = f (-Omega_y - T_x / Z, Omega_x - T_y / Z), Z by least squares.
        T, Omega = twists.T, twists.Omega
        assert T is not None  # of poses
        turn = f * np.stack([-Omega[:, 1], Omega[:, 0]], 1)
        across = -f * T[:, :2]
        use = np.isfinite(mean).all(1)
        square = (across[use] ** 2).sum()
        rho = ((mean - turn)[use] * across[use]).sum() / square if square > 0 else 0.0
        return turn + max(float(rho), 0.0) * across

    @classmethod
    def from_twists_at_depth(cls, twists, f, depth):
        if not depth > 0:
            raise InputError(f"the depth {depth:g} is not possible; give metres above 0")
        T, Omega = twists.T, twists.Omega
        assert T is not None  # of poses
        return f * (np.stack([-Omega[:, 1], Omega[:, 0]], 1) - T[:, :2] / depth)


class Rotation(Model):
    """The camera's angular velocity (rad/s): U = B Omega (`geometry.B`)."""

    name, title = "rotation", "rotation"
    components, units = ("wx", "wy", "wz"), ("rad/s",) * 3
    parts = (Part("angular velocity", slice(0, 3), "rad/s", "Omega"),)
    needs_camera = True
    truth_sources = ("poses", "gyro")

    def basis(self, xi):
        return rotation_basis(xi, self.f)

    def warp(self, xi, integral):
        return _rotate_rays(xi, integral, self.f)

    def pixel_scale(self, xi):
        return np.array([self.f, self.f, float(np.sqrt((xi**2).sum(-1).mean()))])

    def search_bound(self, params):
        return params.omega_max

    def diffusion(self, params, mean):
        return jnp.broadcast_to(params.noise_rotation, (3,))

    @classmethod
    def from_twist(cls, T, Omega):
        return Omega


class General(Model):
    """The camera's heading, a unit vector, and its angular velocity (rad/s).

    The flow is on the half-line B Omega + rho a with a = A T / |A T| and rho from 0 on, because the
    depth is unknown; see `geometry.half_line_residual`.
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
    truth_sources = ("poses",)
    best_method, fallback_method = "batch", None
    preset = "general"

    def basis(self, xi):
        # The heading determines the direction of the half-line alone.
        rotation = rotation_basis(xi, self.f)
        xp = np if isinstance(rotation, np.ndarray) else jnp
        return xp.concatenate([xp.zeros_like(rotation), rotation], -1)

    @full_precision
    def flow(self, xi, motion):
        return rotation_basis(xi, self.f) @ motion[3:]

    @full_precision
    def half_line_direction(self, xi, motion):
        # 0 in the focus of expansion.
        along = A(xi[0], xi[1], jnp.asarray(self.f, xi.dtype)) @ motion[:3]
        return along / jnp.sqrt(jnp.maximum((along**2).sum(), 1e-12))

    def warp(self, xi, integral):
        return _rotate_rays(xi, integral[..., 3:], self.f)

    def search_bound(self, params):
        return params.omega_max

    def initial_particle(self, params, uniform):
        # Headings are uniform on the sphere.
        z, azimuth = uniform[0], jnp.pi * uniform[1]
        ring = jnp.sqrt(1 - z**2)
        heading = jnp.stack([ring * jnp.cos(azimuth), ring * jnp.sin(azimuth), z])
        rates = uniform[3:] * lax.stop_gradient(self.search_bound(params))
        return jnp.concatenate([heading, rates])

    def diffusion(self, params, mean):
        noises = params.noise_heading, params.noise_rotation
        return jnp.concatenate([jnp.broadcast_to(noise, (3,)) for noise in noises])

    def max_age(self, params):
        return params.tau_general

    def is_converged(self, params, mean, covariance):
        heading, *_, rate = self.standard_deviations(covariance)
        limit = params.found_heading
        return (heading < limit) & (rate < limit * self.search_bound(params))

    @classmethod
    def from_twist(cls, T, Omega):
        return np.concatenate([unit_vectors(np.asarray(T)), Omega], 1)


MODELS: Mapping[str, type[Model]] = {model.name: model for model in (Planar, Rotation, General)}


@functools.cache
def _load(path: str) -> type[Model]:
    """Import the model "package.module:Class"."""
    found = import_object(path, type, "motion model")
    if not issubclass(found, Model):
        raise InputError(f"{path!r} is no motion model; give a subclass of egomotion.Model")
    return found


def find_model(model: str | type[Model]) -> type[Model]:
    """Return the model of a name, of "package.module:Class", or the class itself.

    Raises:
        InputError: There is no model of that name; the message has the nearest one.
    """
    if not isinstance(model, str):
        return model
    if ":" in model:
        return _load(model)
    check_choice(model, "motion model", MODELS)
    return MODELS[model]


def in_words(names: Sequence[str]) -> str:
    """Join names as in "planar and rotation"."""
    return " and ".join(filter(None, [", ".join(names[:-1]), *names[-1:]]))


def unit_vectors(v: NDArray[np.floating]) -> NDArray[np.float64]:
    """Scale vectors (n, components) to length 1, tiny ones too; zero vectors stay."""
    # The largest component first: the square of a tiny one would underflow.
    largest = np.abs(v).max(-1, keepdims=True)
    v = v / np.where(largest > 0, largest, 1)
    size = np.linalg.norm(v, axis=-1, keepdims=True)
    return v / np.where(size > 0, size, 1)


def _rotate_rays(
    xi: Numeric, phi: Numeric, f: float | Float[Array, ""]
) -> Float[Array, "*points 2"]:
    """Rotate the rays of positions: f (X_x, X_y) / X_z.

    Args:
        xi: (*points, 2) positions, px.
        phi: (*points, 3) rotation vectors, rad.
        f: Focal length, px.

    Returns:
        Positions, px; 1e6 for rays behind the camera.
    """
    R = rotation_exp(phi)
    x, y, z = (
        R[..., k, 0] * xi[..., 0] + R[..., k, 1] * xi[..., 1] + R[..., k, 2] * f for k in range(3)
    )
    # A direction behind the camera has no position: far outside the image.
    ahead = z > 1e-3 * f
    z = jnp.where(ahead, z, 1)
    return jnp.where(ahead[..., None], f * jnp.stack([x, y], -1) / z[..., None], 1e6)
