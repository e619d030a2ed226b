"""The image of a window as a function of parameters, in JAX, with its implicit derivative.

The energy E(u) is that of `solve` (3). The solver on the host finds its minimum, which is
differentiated as a root of dE/du: with F(u, p) = dE/du = 0,

    du/dp = -(dF/du)^-1 dF/dp,

where conjugate gradients, on the host too, solve with the exact second derivative of E.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from numpy.typing import NDArray

from jaxevent.reconstruction.events_only.params import Params
from jaxevent.reconstruction.events_only.prior import SolverParams
from jaxevent.reconstruction.events_only.rows import EVENT
from jaxevent.reconstruction.events_only.solve import (
    BLUR_PX,
    SAMPLES,
    VARIANCE_FACTOR,
    Energy,
    factor_information,
    find_minimum,
    pack_prior,
    solve_linear,
)
from jaxevent.reconstruction.events_only.windows import SolvedWindow
from jaxevent.reconstruction.features import Numeric

# By bytes of a number: relative residual of a linear problem, and change of an image in thresholds.
TOLERANCES = {4: 5e-3, 8: 1e-8}
LEAST_CHANGES = {4: 2e-4, 8: 1e-9}
LEAST_STUDENT_SHAPE = 0.6  # at 0.5 the distribution has no integral


class Perturbation(NamedTuple):
    """Normal numbers that perturb the equations of a window, for the variance.

    Attributes:
        rows: Numbers of the rows.
        pixels: Numbers of the differences to the right and below, and of the leak.
        pull: Numbers of the gradient by other windows, times the root of `information`.
    """

    rows: Float[Numeric, "*times samples rows"]
    pixels: Float[Numeric, "*times samples 3 height width"]
    pull: Float[Numeric, "*times samples height width 2"]

    @classmethod
    def draw(cls, n_rows: int, shape: tuple[int, int]) -> "Perturbation":
        """Draw the numbers that `solve` draws.

        Args:
            n_rows: Number of rows.
            shape: Height and width of the image, px.

        Returns:
            The numbers of all samples, with `pull` not yet times the root of `information`.
        """
        random = np.random.default_rng(0)
        drawn = [
            [
                random.standard_normal(size, np.float32)
                for size in (n_rows, (3, *shape), (*shape, 2))
            ]
            for _ in range(SAMPLES)
        ]
        return cls(*(np.stack(one) for one in zip(*drawn, strict=True)))


class WindowEquations(NamedTuple):
    """Equations of one window, or of several, stacked; thresholds are left open.

    Attributes:
        corner: Flat index of the look-up's pixel above and left.
        fraction: Distance from there along x and y, px.
        on: Change, in ON thresholds.
        off: Change, in OFF thresholds.
        weight: Weight of rows of events.
        silent: Weight of the other rows, in `silence`.
        pull: Gradient by other windows, thresholds / px.
        information: Its information, (px / threshold)^2.
        start: The host's solution, thresholds.
        unseen: Variance of the solution where rows say little, thresholds^2.
        relative: Mean of the learned thresholds of ON and OFF events, relative to those of the
            parameters.
        noise: Numbers that perturb the equations.
    """

    corner: Int[Numeric, "*times rows 2"]
    fraction: Float[Numeric, "*times rows 2 2"]
    on: Float[Numeric, "*times rows"]
    off: Float[Numeric, "*times rows"]
    weight: Float[Numeric, "*times rows"]
    silent: Float[Numeric, "*times rows"]
    pull: Float[Numeric, "*times height width 2"]
    information: Float[Numeric, "*times height width 2 2"]
    start: Float[Numeric, "*times height width"]
    unseen: Float[Numeric, "*times height width"]
    relative: Float[Numeric, "*times 2"]
    noise: Perturbation


def pack_equations(
    window: SolvedWindow, relative: NDArray, params: Params, count: int
) -> WindowEquations:
    """Pack a window's equations for JAX, with thresholds factored out.

    Args:
        window: Rows of the window, and the host's solution.
        relative: (2, height, width) thresholds, relative to those of the parameters.
        params: Parameters that the rows were made with.
        count: Number of rows to fill up to.

    Returns:
        The equations.
    """
    dtype = np.dtype(jnp.result_type(float))
    rows, prior, solution, _ = window
    c, n = rows.threshold, len(rows.kind)

    def fill(column: NDArray, kind: Any = dtype) -> NDArray:
        whole = np.zeros((count, *column.shape[1:]), kind)
        whole[:n] = column
        return whole

    information = prior.information * c**2
    xx, xy, yy = information[..., 0, 0], information[..., 0, 1], information[..., 1, 1]
    event, noise = rows.kind == EVENT, Perturbation.draw(n, rows.shape)
    return WindowEquations(
        fill(rows.corner, np.int32),
        fill(rows.fraction),
        fill(np.maximum(rows.change, 0) * (c / float(params.c_on))),
        fill(np.maximum(-rows.change, 0) * (c / float(params.c_off))),
        fill(event * rows.weight),
        fill(~event * rows.weight),
        (prior.gradient / c).astype(dtype),
        information.astype(dtype),
        (solution.log_image / c).astype(dtype),
        (solution.unseen / c**2).astype(dtype),
        relative.mean((1, 2)).astype(dtype),
        Perturbation(
            np.pad(noise.rows, [(0, 0), (0, count - n)]).astype(dtype),
            noise.pixels.astype(dtype),
            np.einsum("hwij,nhwj->nhwi", factor_information(xx, xy, yy), noise.pull).astype(dtype),
        ),
    )


def look_up(u: Array, corner: Array, fraction: Array) -> Array:
    """Return the difference of the two bilinear look-ups of rows.

    Args:
        u: (height, width) image.
        corner: (rows, 2) flat indices of the pixels above and left.
        fraction: (rows, 2, 2) px from there.

    Returns:
        (rows,) differences.
    """
    width, flat = u.shape[1], u.reshape(-1)
    x, y = fraction[..., 0], fraction[..., 1]
    upper = flat[corner] * (1 - x) + flat[corner + 1] * x
    lower = flat[corner + width] * (1 - x) + flat[corner + width + 1] * x
    both = upper * (1 - y) + lower * y
    return both[:, 0] - both[:, 1]


def _gradient(u: Array) -> Array:
    """Central differences, one-sided at the border, (height, width, 2)."""

    def along(axis: int) -> Array:
        n = u.shape[axis]
        before, after = np.maximum(np.arange(n) - 1, 0), np.minimum(np.arange(n) + 1, n - 1)
        span = np.maximum(after - before, 1)
        difference = jnp.take(u, after, axis) - jnp.take(u, before, axis)
        return difference / (span[:, None] if axis == 0 else span)

    return jnp.stack([along(1), along(0)], -1)


def _mean_squares(u: Array) -> Array:
    """Mean squares q of the differences of cells, (height - 1, width - 1)."""
    across, down = jnp.diff(u, axis=1) ** 2, jnp.diff(u, axis=0) ** 2
    return (across[:-1] + across[1:] + down[:, :-1] + down[:, 1:]) / 2


def energy(u: Array, equations: WindowEquations, params: Params) -> Array:
    """Return the energy E (3) of a log image in thresholds.

    Args:
        u: (height, width) image, thresholds.
        equations: Equations of the window.
        params: Parameters.

    Returns:
        E.
    """
    numbers = params.solver()
    weight, e = _residuals(u, equations, params)
    total = (weight * numbers.tail**2 * jnp.log1p(e**2 / (2 * numbers.tail**2))).sum()
    total += numbers.gradient / 2 * jnp.log1p(_mean_squares(u) / numbers.edge**2).sum()
    return total + _quadratic(u, equations, jnp.asarray(numbers.leak))


def _residuals(u: Array, equations: WindowEquations, params: Params) -> tuple[Array, Array]:
    """Return the weights of rows and their residuals.

    Args:
        u: (height, width) image, thresholds.
        equations: Equations of the window.
        params: Parameters.

    Returns:
        Weights and residuals, each (rows,), residuals in thresholds.
    """
    weight = equations.weight + params.silence * equations.silent
    return weight, look_up(u, equations.corner, equations.fraction) - _event_changes(
        equations, params
    )


def _event_changes(equations: WindowEquations, params: Params) -> Array:
    """Return the changes that rows show, in mean thresholds.

    Args:
        equations: Equations of the window.
        params: Parameters, with thresholds in ln I.

    Returns:
        (rows,).
    """
    c = threshold(equations, params)
    return (params.c_on * equations.on - params.c_off * equations.off) / c


def threshold(equations: WindowEquations, params: Params) -> Array:
    """Return the mean threshold, in whose multiples the image is solved for.

    Args:
        equations: Equations of one window, or of several, stacked.
        params: Parameters, with thresholds in ln I.

    Returns:
        () or (times,), ln I.
    """
    mean = equations.relative
    return (params.c_on * mean[..., 0] + params.c_off * mean[..., 1]) / 2


def _quadratic(u: Array, equations: WindowEquations, leak: Array) -> Array:
    """Return the quadratic part of the energy: the prior of gradients, and the leak.

    Args:
        u: (height, width) image, thresholds.
        equations: Equations of the window.
        leak: () weight of u^2.

    Returns:
        ().
    """
    g = _gradient(u) - equations.pull
    pulled = jnp.einsum("hwi,hwij,hwj->", g, equations.information, g)
    return (pulled + leak * (u**2).sum()) / 2


class _Weights(NamedTuple):
    """Weights of the reweighted problem at an image.

    Attributes:
        rows: (rows,) weights of rows.
        across: (height, width - 1) weights of differences with the pixel right.
        down: (height - 1, width) weights of differences with the pixel below.
    """

    rows: Array
    across: Array
    down: Array


def _weights(u: Array, equations: WindowEquations, params: Params) -> _Weights:
    """Return the weights of the reweighted problem at an image.

    Args:
        u: (height, width) image, thresholds.
        equations: Equations of the window.
        params: Parameters.

    Returns:
        The weights.
    """
    numbers = params.solver()
    weight, e = _residuals(u, equations, params)
    s = numbers.gradient / (2 * (_mean_squares(u) + numbers.edge**2))
    across = jnp.pad(s, [(0, 1), (0, 0)]) + jnp.pad(s, [(1, 0), (0, 0)])
    down = jnp.pad(s, [(0, 0), (0, 1)]) + jnp.pad(s, [(0, 0), (1, 0)])
    return _Weights(weight / (1 + e**2 / (2 * numbers.tail**2)), across, down)


def _product(
    weights: _Weights, equations: WindowEquations, leak: Array
) -> Callable[[Array], Array]:
    """Return the product with the matrix A of the reweighted problem.

    Args:
        weights: Weights of the reweighted problem.
        equations: Equations of the window.
        leak: () weight of u^2.

    Returns:
        Function of an image (height, width) that returns A times it.
    """

    def form(v: Array) -> Array:
        total = (weights.rows * look_up(v, equations.corner, equations.fraction) ** 2).sum()
        total += (weights.across * jnp.diff(v, axis=1) ** 2).sum()
        total += (weights.down * jnp.diff(v, axis=0) ** 2).sum()
        g = _gradient(v)
        total += jnp.einsum("hwi,hwij,hwj->", g, equations.information, g)
        return (total + leak * (v**2).sum()) / 2

    return jax.linearize(jax.grad(form), jnp.zeros_like(equations.start))[1]


class _Problem(NamedTuple):
    """Equations with their parameters in place, from which the host makes an `Energy`.

    Attributes:
        corner: (rows, 2) flat index of the look-up's pixel above and left.
        fraction: (rows, 2, 2) distance from there along x and y, px.
        weight: (rows,) weights.
        change: (rows,) changes, thresholds.
        pull: (height, width, 2) gradient by other windows, thresholds / px.
        information: (height, width, 2, 2) its information, (px / threshold)^2.
        params: Parameters of the solver.
    """

    corner: Array
    fraction: Array
    weight: Array
    change: Array
    pull: Array
    information: Array
    params: SolverParams


def _set_parameters(equations: WindowEquations, params: Params) -> _Problem:
    return _Problem(
        equations.corner,
        equations.fraction,
        equations.weight + params.silence * equations.silent,
        _event_changes(equations, params),
        equations.pull,
        equations.information,
        params.solver(),
    )


def _make_energy(problem: _Problem) -> Energy:
    corner, *of_rows, pull, information = (np.asarray(leaf) for leaf in problem[:-1])
    numbers = SolverParams(*(float(value) for value in problem.params))
    prior = pack_prior(pull, information)
    return Energy(corner.astype(np.uint32), *of_rows, *prior, numbers)


def _find_minimum(problem: _Problem, start: Array) -> NDArray:
    """Find the image of least energy on the host.

    Args:
        problem: The problem.
        start: (height, width) image to start from, thresholds.

    Returns:
        (height, width), thresholds.
    """
    least_change = LEAST_CHANGES[start.dtype.itemsize]
    return find_minimum(_make_energy(problem), np.asarray(start), least_change)


def _solve_linear(exact: bool, problem: _Problem, u: Array, right: Array) -> NDArray:
    """Solve a linear problem at an image on the host.

    Args:
        exact: Whether with the exact second derivative, else that of the reweighted problem.
        problem: The problem.
        u: (height, width) image, thresholds.
        right: (height, width) right side.

    Returns:
        (height, width).
    """
    tolerance, images = TOLERANCES[right.dtype.itemsize], (np.asarray(u), np.asarray(right))
    return solve_linear(_make_energy(problem), *images, tolerance, exact=exact)


def _call_solver(solver: Callable, equations: WindowEquations, params: Params, *u: Array) -> Array:
    """Call a solver on the host with a problem and images.

    Args:
        solver: Function on the host of a `_Problem` and the images.
        equations: Equations of the window.
        params: Parameters.
        *u: (height, width) images.

    Returns:
        (height, width), without a derivative.
    """
    equations, params = jax.lax.stop_gradient((equations, params))
    shape = jax.ShapeDtypeStruct(u[0].shape, u[0].dtype)
    problem = _set_parameters(equations, params)
    return jax.pure_callback(solver, shape, problem, *u, vmap_method="sequential")


def solve_equations(equations: WindowEquations, params: Params) -> Array:
    """Find the image of least energy; differentiable by parameters.

    Args:
        equations: Equations of one window.
        params: Parameters.

    Returns:
        (height, width) log image, thresholds.
    """
    found = _call_solver(_find_minimum, equations, params, equations.start)
    return _implicit_solution(found, equations, params)


def _slope(u: Array, equations: WindowEquations, params: Params) -> Array:
    """Return the derivative of the energy by the image.

    Args:
        u: (height, width) image, thresholds.
        equations: Equations of the window.
        params: Parameters.

    Returns:
        (height, width), 1 / threshold.
    """
    return jax.grad(energy)(u, equations, params)


@jax.custom_jvp
def _implicit_solution(u: Array, equations: WindowEquations, params: Params) -> Array:
    """Make a solution a differentiable function of the parameters.

    Args:
        u: (height, width) image of least energy, thresholds.
        equations: Equations of the window.
        params: Parameters.

    Returns:
        u as it is.
    """
    return u


@_implicit_solution.defjvp
def _differentiate(values: tuple, changes: tuple) -> tuple[Array, Array]:
    """Differentiate `_implicit_solution` by the parameters, as a root of the energy's slope.

    Args:
        values: Its arguments.
        changes: Their tangents, of which that of the parameters counts.

    Returns:
        u, (height, width), thresholds, and its tangent.
    """
    u, equations, params = values

    def times(du: Array) -> Array:
        return jax.jvp(lambda v: _slope(v, equations, params), (u,), (du,))[1]

    def solve(product: Callable[[Array], Array], right: Array) -> Array:
        return _call_solver(functools.partial(_solve_linear, True), equations, params, u, right)

    _, right = jax.jvp(lambda numbers: _slope(u, equations, numbers), (params,), (changes[2],))
    return u, -jax.lax.custom_linear_solve(times, right, solve, symmetric=True)


def held_out_likelihood(equations: WindowEquations, held: Array, params: Params) -> Array:
    """Return the log likelihood of events that the image was not solved for.

    A residual e, in thresholds, has Student's t distribution of the energy's robust loss,

        p(e) = Gamma(a) / (sqrt(2 pi) tail Gamma(a - 1/2)) (1 + e^2 / (2 tail^2))^-a,  a = tail^2.

    Args:
        equations: Equations of a window.
        held: (rows,) 1 for the rows of events to predict, else 0.
        params: Parameters; a `tail` whose distribution has no integral counts as the least.

    Returns:
        (), a sum over these rows.
    """
    others = equations._replace(weight=equations.weight * (1 - held))
    u = solve_equations(others, params)
    e = _residuals(u, equations, params)[1]
    a = jnp.maximum(params.tail**2, LEAST_STUDENT_SHAPE)
    norm = jax.scipy.special.gammaln(a) - jax.scipy.special.gammaln(a - 0.5)
    each = norm - 0.5 * jnp.log(2 * jnp.pi * a) - a * jnp.log1p(e**2 / (2 * a))
    return (held * each).sum()


def sample_variance(u: Array, equations: WindowEquations, params: Params) -> Array:
    """Return the variance of a solution as `solve` does: perturb the equations and solve again.

    Args:
        u: (height, width) solution, thresholds.
        equations: Equations of the window, with the perturbations.
        params: Parameters.

    Returns:
        (height, width) variance, squared thresholds.
    """
    weights = _weights(u, equations, params)
    product = _product(weights, equations, params.leak)
    # Rows that only fill up have the weight 0, at which the root has no derivative.
    counts = weights.rows > 0
    roots = jnp.where(counts, jnp.sqrt(jnp.where(counts, weights.rows, 1)), 0)

    def solve(product: Callable[[Array], Array], right: Array) -> Array:
        image = jax.lax.stop_gradient(u)
        return _call_solver(
            functools.partial(_solve_linear, False), equations, params, image, right
        )

    def sample(noise: Perturbation) -> Array:
        def spread(v: Array) -> Array:
            rows = noise.rows * roots
            n = noise.pixels
            total = (rows * look_up(v, equations.corner, equations.fraction)).sum()
            total += (n[0, :, :-1] * jnp.sqrt(weights.across) * jnp.diff(v, axis=1)).sum()
            total += (n[1, :-1] * jnp.sqrt(weights.down) * jnp.diff(v, axis=0)).sum()
            total += (_gradient(v) * noise.pull).sum()
            return total + jnp.sqrt(params.leak) * (n[2] * v).sum()

        right = jax.grad(spread)(jnp.zeros_like(u))
        z = jax.lax.custom_linear_solve(product, right, solve, symmetric=True)
        return (z - z.mean()) ** 2

    squares = jax.lax.map(sample, equations.noise).mean(0)
    down, across = (jnp.asarray(_blur_matrix(n), u.dtype) for n in u.shape)
    return VARIANCE_FACTOR * (down @ squares @ across.T) + equations.unseen


@functools.cache
def _blur_matrix(n: int) -> NDArray[np.float64]:
    """Return the Gaussian blur of n pixels as a matrix."""
    from scipy.ndimage import gaussian_filter1d

    return gaussian_filter1d(np.eye(n), BLUR_PX, axis=0)
