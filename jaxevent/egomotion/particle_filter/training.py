"""Runs of the particle filter for a fit: means around a known motion, by a kernel or by XLA.

The kernel carries the derivatives of all particles and weights along the numbers that are fitted.
JAX sees a function with a rule for its derivatives (`custom_jvp`), linear in the changes of the
parameters, so that gradients in reverse cost the same.
"""

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import NDArray

from jaxevent.codegen import map_ahead
from jaxevent.codegen.derivative import (
    DerivativeDirections,
    are_zero_tangents,
    moving_numbers,
    refuse_second_derivatives,
    zero_tangents,
)
from jaxevent.egomotion.candidates import Candidates
from jaxevent.egomotion.estimator import TrainingRuns
from jaxevent.egomotion.geometry import length
from jaxevent.egomotion.models import Model
from jaxevent.egomotion.particle_filter import filtering
from jaxevent.egomotion.particle_filter.engine import CompiledFilter
from jaxevent.egomotion.particle_filter.filtering import RandomNumbers
from jaxevent.egomotion.particle_filter.params import Params
from jaxevent.errors import InputError
from jaxevent.precision import full_precision

RELATIVE_TRAINING_SPREAD = 0.2  # of the first particles of a fit, relative to the true motion


def training_spread(model: Model, motion: Any) -> Any:
    """Return how far the first particles of a fit are from the true motion.

    Args:
        model: Motion model of d components.
        motion: (d,) the motion, in the units of the model.

    Returns:
        (d,) standard deviations.
    """
    sizes = [jnp.sqrt((motion[part.rows] ** 2).mean()) for part in model.parts]
    parts = zip(model.parts, sizes, strict=True)
    spread = [jnp.full_like(motion[part.rows], size) for part, size in parts]
    return RELATIVE_TRAINING_SPREAD * jnp.concatenate(spread)


class WarmStartedRuns(TrainingRuns):
    """Runs of the filter over a segment, with particles that start around the true motion."""

    candidates: Candidates
    noise: RandomNumbers  # leaves begin with [runs]
    start: Float[Array | np.ndarray, "N d"]  # standard normal, of the first particles
    by_kernel: bool = eqx.field(static=True)  # or else by XLA

    def estimates(self, params: Params) -> tuple[Array, Array]:
        near = self._first_particles()
        if self.by_kernel:
            return _estimate(params, self.model, self.candidates, self.noise, near)

        def run(noise: RandomNumbers) -> tuple[Array, Array]:
            state = filtering.init_near(params, near)
            _, info = filtering.run(params, self.model, self.candidates, noise, state)
            return info.mean, info.lag

        return jax.vmap(run)(self.noise)

    def _first_particles(self) -> Float[Array, "N d"]:
        """Return the particles of all runs at the start."""
        first, normal = jnp.asarray(self.truth)[0], jnp.asarray(self.start)
        particles, spread = [], training_spread(self.model, first)
        for part in self.model.parts:
            near = first[part.rows] + spread[part.rows] * normal[:, part.rows]
            if part.direction:
                near = near / length(near)[:, None]
            particles.append(near)
        return jnp.concatenate(particles, 1)


def _evaluate(
    model: Model, numbers: tuple[tuple[int, int], ...], tree: Any, leaves: list[Any]
) -> tuple[NDArray, ...]:
    """Run the filter, on the host.

    Args:
        model: Motion model of d components.
        numbers: Numbers of the parameters by which the means are differentiated.
        tree: Structure of parameters, candidates, random numbers and particles.
        leaves: Their leaves.

    Returns:
        Means (runs, T, d) and lags (runs, T), and with numbers the derivatives of the means
        (runs, T, numbers, d).
    """
    given = jax.tree.unflatten(tree, [np.asarray(leaf) for leaf in leaves])
    params, candidates, noise, particles = given
    with jax.ensure_compile_time_eval():
        params = jax.tree.map(jnp.asarray, params)
        state = jax.tree.map(np.asarray, filtering.init_near(params, jnp.asarray(particles)))

    def run(k: int) -> Any:
        kernel = CompiledFilter(params, model, DerivativeDirections(numbers))
        return kernel.run(candidates, jax.tree.map(lambda leaf: leaf[k], noise), state).out

    found = list(map_ahead(run, range(len(noise.uniform))))
    means, lags = (np.stack([getattr(one, name) for one in found]) for name in ("mean", "lag"))
    if not numbers:
        return means, lags
    slopes = np.stack([one.mean_tangents for one in found])
    return means, lags, slopes.reshape(*slopes.shape[:2], len(numbers), -1)


def _call(
    numbers: tuple[tuple[int, int], ...],
    params: Params,
    model: Model,
    candidates: Candidates,
    noise: RandomNumbers,
    particles: Array,
) -> tuple[Array, ...]:
    """Call `_evaluate` from a compiled program.

    Args:
        numbers: Numbers of the parameters by which the means are differentiated.
        params: The parameters.
        model: Motion model of d components.
        candidates: The candidates.
        noise: Random numbers of the runs.
        particles: (N, d) motions at the start.

    Returns:
        What `_evaluate` does.
    """
    leaves, tree = jax.tree.flatten((params, candidates, noise, particles))
    runs, T, d = len(noise.uniform), len(candidates.elapsed), model.dimension
    shapes = [(runs, T, d), (runs, T)] + [(runs, T, len(numbers), d)] * bool(numbers)
    out = tuple(jax.ShapeDtypeStruct(shape, particles.dtype) for shape in shapes)
    evaluate = functools.partial(_evaluate, model, numbers, tree)
    return jax.pure_callback(evaluate, out, leaves, vmap_method="sequential")


@jax.custom_jvp
def _estimate(
    params: Params,
    model: Model,
    candidates: Candidates,
    noise: RandomNumbers,
    particles: Array,
) -> tuple[Array, Array]:
    """Return the means (runs, T, d) and lags (runs, T) of all runs.

    Args:
        params: The parameters.
        model: Motion model of d components.
        candidates: The candidates.
        noise: Random numbers of the runs.
        particles: (N, d) motions at the start.
    """
    mean, lag = _call((), params, model, candidates, noise, particles)
    return mean, lag


@full_precision
def _estimate_jvp(primals: Any, tangents: Any) -> Any:
    """Compute means and lags and their tangents: derivatives times those of parameters, summed.

    Args:
        primals: Parameters, model, candidates, random numbers and particles.
        tangents: Tangents of these.

    Returns:
        Means and lags, and their tangents.

    Raises:
        InputError: Others than parameters have tangents.
    """
    if not are_zero_tangents(tangents[1:]):
        raise InputError(
            "the kernel of 'voting' has derivatives by parameters alone; for those by events give "
            'compiler="xla"'
        )
    numbers, changes = moving_numbers(tangents[0])
    if not numbers:
        made = _estimate(*primals)
        return made, zero_tangents(made)
    mean, lag, slopes = _with_slopes(numbers, *primals)
    change = jnp.concatenate([jnp.ravel(change) for change in changes])
    return (mean, lag), (jnp.einsum("rtnd,n->rtd", slopes, change), jnp.zeros_like(lag))


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _with_slopes(numbers: tuple[tuple[int, int], ...], *given: Any) -> tuple[Array, ...]:
    return _call(numbers, *given)


def _with_slopes_jvp(numbers: Any, primals: Any, tangents: Any) -> Any:
    refuse_second_derivatives("voting", tangents, 'compiler="xla"')
    made = _with_slopes(numbers, *primals)
    return made, zero_tangents(made)


_estimate.defjvp(_estimate_jvp, symbolic_zeros=True)
_with_slopes.defjvp(_with_slopes_jvp, symbolic_zeros=True)
