"""Parameters fitted by gradients and searches: one loop for every estimator.

    fitted = jaxevent.optimise(loss, params, ["c_on", "c_off"], batches)

`loss(params, batch)` is a scalar, the mean over the measurements of a batch; nothing else of the
estimator is used. Several processes can share a fit: see `jaxevent.processes`.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Generic, NamedTuple, Protocol, TypeVar, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int
from numpy.typing import ArrayLike, NDArray
from tqdm import tqdm

from jaxevent import processes
from jaxevent.deprecated import renamed_names
from jaxevent.errors import InputError
from jaxevent.parameters import (
    Number,
    Parameters,
    Positive,
    UnitInterval,
    check_choice,
    suggest_name,
)
from jaxevent.progress import bar

P = TypeVar("P", bound=Parameters)

# Forward mode is used for derivatives of up to this many numbers, reverse mode for more. Loss and
# gradient of the AKF on slider_depth (1.08 M events, 22 images, 2 cores): the loss alone 67 ms;
# forward 135 ms for 1 number, 181 ms for 2; reverse 213 ms for any. Forward over reverse, measured
# alternately: 0.60 for 1 number, 0.80 for 2, 1.12 for 3, 1.15 for 4, 1.9 for 8, and 3.9 for 8 with
# 4 starts.
MAX_FORWARD_PARAMETERS = 2

# Points at which a loss is probed along a line, in unit steps: 0.1 and 0.3 of one apart.
PROBE_STEPS = (-0.4, -0.1, 0.0, 0.1, 0.4)
MIN_SKILL = 0.5  # skill of the gradient below which a loss is rough
NEGLIGIBLE_CHANGE = 1e-5  # of a loss, relative: single precision rounds sums by about 1e-6
ROUGH_SEARCH_REACH, N_ROUGH_CANDIDATES = 6.4, 17  # unit steps to both sides: a factor of 600

Loss = Callable[[Any, Any], Array]
Batches = tuple[Sequence[Any], Sequence[Any]]
Interval = tuple[float | int, float | int, int]


@runtime_checkable
class WeightedBatch(Protocol):
    """Batch with its own weight in means over batches."""

    weight: Any


@dataclasses.dataclass(frozen=True)
class LossWithPrior:
    """Loss plus a Gaussian prior on some unconstrained numbers; made by `with_prior`.

    The prior adds weight / 2 ((u - centre) / spread)^2 for each of `terms`, (name, centre, spread),
    with u the unconstrained number, the logarithm of a positive one.
    """

    loss: Loss
    terms: tuple[tuple[str, float, float], ...]
    weight: float

    @property
    def likelihood(self) -> bool:
        """True if the loss is the mean of -ln p, see `jaxevent.confidence.confidence_intervals`."""
        return bool(getattr(self.loss, "likelihood", False))

    def penalty(self, params: Any) -> Array:
        """Compute the term that the prior adds, ()."""
        parts = [(((params.raw[k] - c) / s) ** 2).mean() for k, c, s in self.terms]
        return 0.5 * self.weight * jnp.stack(parts).sum()

    def __call__(self, params: Any, batch: Any) -> Array:
        return self.loss(params, batch) + self.penalty(params)


@dataclasses.dataclass(frozen=True)
class PartwiseLossWithPrior(LossWithPrior):
    """A `jaxevent.confidence.PartwiseLoss` plus a prior."""

    def parts(self, params: Any, batch: Any) -> tuple[Array, Array]:
        """Compute the loss of each part of a batch, with the prior's term, and its weight.

        Args:
            params: Parameters of an estimator.
            batch: One batch, in the form that the loss takes.

        Returns:
            The mean of each part, (parts,), and its weight, (parts,).
        """
        part: Any = self.loss
        values, weights = part.parts(params, batch)
        return values + self.penalty(params), weights


def with_prior(
    loss: Loss,
    params: Parameters,
    prior: Mapping[str, Sequence[float | int]],
    weight: float | int = 1.0,
) -> Loss:
    """Add a log-normal prior to a loss.

    Args:
        loss: A loss for `optimise`.
        params: Parameters of the class that is fitted.
        prior: (centre, spread) of each number: its expected value in its unit, and the standard
            deviation of its logarithm, or of ln(p / (1 - p)) for a number p in [0, 1).
        weight: Twice the cost of one standard deviation, in the loss's unit. If the loss is the
            mean of -ln p over n measurements, 1 / n is the Bayesian weight.

    Returns:
        A loss for `optimise`.

    Raises:
        InputError: A number does not exist, a centre is not one of its values or has no logarithm,
            a spread or the weight is not positive.
    """
    if not 0 < weight < math.inf:
        raise InputError(f"the weight of a prior is {weight}; give a number above 0")
    terms = []
    for name, (centre, spread) in prior.items():
        if name not in params.raw:
            raise InputError(
                f"the prior names {name!r}, which is no number; {suggest_name(name, params.raw)}"
            )
        if not 0 < spread < math.inf:
            raise InputError(
                f"the prior of {name} has the spread {spread}; give a standard deviation of its "
                "logarithm, above 0"
            )
        raw = float(params.replace(**{name: centre}).raw[name].mean())
        if not math.isfinite(raw):
            raise InputError(f"the prior of {name} is about {centre}, which has no logarithm")
        terms.append((name, raw, float(spread)))
    if not terms:
        return loss
    kind = PartwiseLossWithPrior if hasattr(loss, "parts") else LossWithPrior
    return kind(loss, tuple(terms), float(weight))


@dataclasses.dataclass(frozen=True)
class Settings:
    """Settings of `optimise`.

    A round searches all searched parameters, then takes `iterations` steps of Adam. The learning
    rate falls along a cosine from `learning_rate`, which is halved with every round, to a tenth of
    it. Every `every` iterations batches are prepared anew, if a function of the parameters prepares
    them, and the validation loss is computed; a start that has not improved for `patience`
    iterations stops. If the fit loss of batches prepared anew is greater than it was `every`
    iterations before, what preparation fixes, such as motion, has become worse: the start returns
    to where it was then, and its learning rate is halved. The result is the best point evaluated,
    with parameters within their bounds. `starts` starting points are optimised at once: the given
    one, and others drawn around it with a standard deviation of `spread` in the unconstrained
    numbers. A step uses `batch` batches, drawn without replacement; None uses all. `forward`
    chooses forward or reverse differentiation; None takes the faster. With `probe` the loss is
    probed before the first step: numbers whose gradient does not predict how the loss changes
    (`gradient_skill`) are searched first.
    """

    iterations: int = 300
    learning_rate: float | int = 0.05
    patience: int = 50
    every: int = 5
    starts: int = 1
    spread: float | int = 0.3
    rounds: int = 2
    batch: int | None = None
    seed: int = 0
    forward: bool | None = None
    probe: bool = True


class RoughNumber(NamedTuple):
    """Result for a number in which the loss is rough.

    Attributes:
        skill: The gradient's skill at the start, see `gradient_skill`.
        searched: Result of the search before the descent, in the number's unit.
    """

    skill: float
    searched: float


class Position(eqx.Module):
    """Parameters of all starting points, and the state of their optimisers.

    The leading axis of the leaves of `raw`, `best` and `optimiser` is that of starts.
    """

    raw: dict[str, Array]  # the fitted parameters, unconstrained
    optimiser: Any
    best: dict[str, Array]  # best `raw` of this round
    best_loss: Float[Array, " starts"]
    best_at: Int[Array, " starts"]  # iteration of the best loss
    searched: dict[str, Array]  # searched parameters, common to all starts, unconstrained
    prepared: dict[str, Array]  # `raw` of the one start that batches were prepared with
    kept: dict[str, Array]  # `raw` when batches were last prepared anew
    kept_loss: Float[Array, " starts"]  # fit loss of `kept` with these batches
    rate: Float[Array, " starts"]  # factor on the learning rate


@dataclasses.dataclass
class Run:
    """State of a running fit, as checkpoints store it.

    Stage 2 r is the search of round r, 2 r + 1 its descent; one last search follows. `tried` holds
    the losses of this search's candidates in order. The search depends on nothing else, so a
    resumed search replays them. A row of `history` has start, round, iteration, fit loss and
    validation loss (None where it was not computed). `rough` has a `RoughNumber` for each number
    in which the loss is rough.
    """

    position: Position
    stage: int = 0
    iteration: int = 0
    tried: list[float] = dataclasses.field(default_factory=list)
    history: list[list[Any]] = dataclasses.field(default_factory=list)
    rough: dict[str, RoughNumber] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass(frozen=True)
class FitResult(Generic[P]):
    """The fitted parameters, and the losses along the fit.

    Attributes:
        params: The parameters.
        loss: Their validation loss; without validation their fit loss.
        history: Losses over iterations, see `Run`.
        rough: Numbers in which the loss is rough, which were searched first.
    """

    params: P
    loss: float
    history: list[list[Any]]
    rough: Mapping[str, RoughNumber] = dataclasses.field(default_factory=dict)

    @property
    def diverged(self) -> bool:
        """True if all starts ended at greater losses than the initial ones, or at none.

        Both the fit loss and the validation loss have grown then. Where only the validation loss
        has, the fit follows its own images, and early stopping keeps what was best. Even of a fit
        that diverged `params` are the best that were evaluated.
        """
        starts: dict[int, tuple[list[float], list[float]]] = {}  # losses of fit and validation
        for start, _, _, *pair in self.history:
            for losses, loss in zip(starts.setdefault(start, ([], [])), pair, strict=True):
                losses += [] if loss is None else [loss]
        if not starts:
            return False
        first = [losses[0] if losses else math.inf for losses in starts[0]]
        return not any(
            math.isfinite(validation[-1])
            and (validation[-1] <= first[1] or len(fit) > 1 and fit[-1] <= first[0])
            for fit, validation in starts.values()
        )


def begin(
    params: Parameters,
    names: Sequence[str],
    settings: Settings = Settings(),
    search: Mapping[str, Interval] | None = None,
) -> Run:
    """Make the state of a fit before its first step.

    Args:
        params: Parameters at the start.
        names: Parameters to fit by gradient.
        settings: See `Settings`.
        search: Parameters to search, see `optimise`.

    Returns:
        The state that `optimise` takes as `run`.

    Raises:
        InputError: A name does not exist, has no gradient, or has an initial value without one.
    """
    search = search or {}
    for name in [*names, *search]:
        check_choice(name, "parameter", params.raw)
    stuck = params.names_without_gradient()
    for name in names:
        if name in stuck:
            raise InputError(
                f"{name} {stuck[name]}; or search it: search = {{ {name} = [from, to, number of "
                "points] }"
            )
        if name in search:
            raise InputError(f"{name} is both to be fitted and searched; choose one")
        if not np.isfinite(params.raw[name]).all():
            raise InputError(
                f"the parameter {name} starts at 0, where its logarithm has no gradient; start at "
                "a positive value or do not fit it"
            )
    for name, (low, high, count) in search.items():
        if params.raw[name].ndim or not low < high or count < 3:
            raise InputError(
                f"the search of {name} is {[low, high, count]}; give [from, to, number of points], "
                "3 or more, of a parameter that is one number"
            )
        for end in (low, high):
            params.numbers[name].check(float(end))
    normal = np.random.default_rng(settings.seed).standard_normal
    raw = {}
    for name in names:
        leaf = np.asarray(params.raw[name])
        drawn = settings.spread * normal((settings.starts - 1, *leaf.shape))
        raw[name] = jnp.asarray(np.concatenate([leaf[None], leaf + drawn]), leaf.dtype)
    dtype = jnp.result_type(float)
    position = Position(
        raw,
        jax.vmap(ADAM_TRANSFORM.init)(raw) if raw else None,
        raw,
        jnp.full(settings.starts, jnp.inf, dtype),
        jnp.zeros(settings.starts, int),
        {name: params.raw[name] for name in search},
        {name: leaf[0] for name, leaf in raw.items()},
        raw,
        jnp.full(settings.starts, jnp.inf, dtype),
        jnp.ones(settings.starts, dtype),
    )
    return Run(position)


# Seven positional arguments: users pass them so.
def optimise(
    loss: Loss,
    params: P,
    names: Sequence[str],
    batches: Sequence[Any] | Callable[[P], Batches],
    validation: Sequence[Any] = (),
    settings: Settings = Settings(),
    search: Mapping[str, Interval] | None = None,
    *,
    run: Run | None = None,
    save: Callable[[Run, bool], None] | None = None,
    progress: bool | None = None,
    title: str = "fit",
) -> FitResult[P]:
    """Fit some parameters of an estimator: minimise the mean loss over batches.

    Args:
        loss: `loss(params, batch)`, the mean over a batch's measurements; pure.
        params: Parameters at the start; those not named keep their values.
        names: Parameters to fit by gradient. Where a loss jumps as they change, its gradient does
            not predict its changes; the AKF's loss jumps with `ratio_width = 0`.
        batches: Pytrees, one compilation for each shape. A batch with an attribute `weight` counts
            that much in means over batches. Or a function `prepare(params)` that returns batches to
            fit to and batches to validate on, for parameters that act when batches are made; it is
            called with the best start's parameters whenever the validation loss is computed. With
            several processes (`processes.join`) all pass the same list and each computes its share;
            a function returns `processes.REMOTE_BATCH` for batches that others compute.
        validation: Batches for early stopping, if `batches` is a list; without any, the fit's.
        settings: See `Settings`.
        search: By name, (from, to, number of points): parameters searched without gradients, one
            after another, by the fit loss of the best start. Every round evaluates all points and
            searches around the best one, ever closer.
        run: State of an interrupted fit to continue; by default `begin(...)`.
        save: Function of the run, called after every step, and of whether it must be saved.
        progress: Whether to show a bar; None shows it in a terminal or notebook.
        title: Name of the fit in the bar.

    Returns:
        The parameters of the best start, their loss, and the history.

    Raises:
        InputError: A name does not exist, or the loss is not finite at the start.
    """
    prepare = batches_by_params(batches, validation)
    fresh = run is None
    run = begin(params, names, settings, search) if run is None else run
    loop = _Loop(
        loss, params, prepare, settings=settings, intervals=search or {}, run=run,
        save=save or (lambda *_: None),
    )  # fmt: skip
    total = settings.rounds * settings.iterations * bool(names)
    with bar(total=total, desc=title, unit="step", progress=progress) as loop.bar:
        if fresh:
            loop.check_losses()
            loop.save(run, True)
        while run.stage <= 2 * settings.rounds:
            stage = loop.descend if run.stage % 2 else loop.search
            stage()
            run.stage, run.iteration, run.tried = run.stage + 1, 0, []
            loop.save(run, True)
        fitted = loop.best_params()
        batches, validation = prepare(fitted)
        least = loop.loss(fitted, validation or batches)
        return FitResult(fitted, least, run.history, run.rough)


def gradient_skill(steps: ArrayLike, losses: ArrayLike, slopes: ArrayLike) -> float:
    """Measure how well the gradient of a loss predicts its changes along a line.

    From one point to the next, h apart, the derivatives g and g' predict the change h (g + g') / 2,
    which is exact for a parabola. With d the changes and e the errors of these predictions, the
    skill is 1 - sum e^2 / sum d^2. A prediction of no change has the skill 0. Negligible errors
    count as 0.

    Args:
        steps: (n,) points on the line, in ascending order.
        losses: (n,) losses there.
        slopes: (n,) derivatives by the step; points without a finite one are left out.

    Returns:
        The skill, at most 1.
    """
    error, _ = _prediction_errors(steps, losses, slopes)
    change = np.diff(np.asarray(losses)[np.isfinite(slopes)])
    total = float(change @ change)
    return 1.0 - float(error @ error) / total if total > 0 else 1.0


def _prediction_errors(
    steps: ArrayLike, losses: ArrayLike, slopes: ArrayLike
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Compare changes of a loss with those that its derivative predicts.

    Args:
        steps: (n,) steps.
        losses: (n,) losses.
        slopes: (n,) derivatives of the loss by the step.

    Returns:
        Errors of the predicted changes, 0 where negligible, and the predicted changes, (n - 1,)
            each.
    """
    table = np.array([steps, losses, slopes], float)
    at, loss, slope = table[:, np.isfinite(table).all(0)]
    predicted = np.diff(at) * (slope[1:] + slope[:-1]) / 2
    error = np.diff(loss) - predicted
    least = NEGLIGIBLE_CHANGE * np.abs(loss).max(initial=0)
    return np.where(np.abs(error) > least, error, 0.0), predicted


def unit_step(number: Number, value: float, start: float) -> float:
    """Return the unit step of a stored number: 1 for a logarithm or logit, else the number's size.

    Args:
        number: The number.
        value: Value of the number.
        start: Value at the start of a fit; the larger of both sizes is taken.

    Returns:
        The step of the unconstrained number.
    """
    if isinstance(number, Positive | UnitInterval):
        return 1.0
    return max(abs(value), abs(start)) or 1.0


# Any number of steps with a gradient that is not finite are skipped.
ADAM_TRANSFORM = optax.apply_if_finite(optax.scale_by_adam(), max_consecutive_errors=2**31 - 1)


@functools.partial(jax.jit, static_argnums=0)
def evaluate_loss(loss: Loss, params: Parameters, batch: Any) -> Array:
    """Compute the loss of a batch, compiled.

    Args:
        loss: `loss(params, batch)`, a scalar.
        params: Parameters of an estimator.
        batch: One batch.

    Returns:
        The loss, ().
    """
    return loss(params, batch)


@functools.partial(jax.jit, static_argnums=0)
def _compute_losses(loss: Loss, params: Parameters, raw: dict[str, Array], batch: Any) -> Array:
    """Compute the loss of each start.

    Args:
        loss: The loss.
        params: Parameters; those in `raw` are replaced.
        raw: Unconstrained numbers by name, each (starts, ...).
        batch: One batch.

    Returns:
        (starts,) losses, infinite where a parameter is out of bounds.
    """

    def value(one: dict[str, Array]) -> Array:
        stepped = params.with_raw(one)
        allowed = [params.numbers[name].allows(getattr(stepped, name)) for name in one]
        return jnp.where(jnp.stack(allowed).all(), loss(stepped, batch), jnp.inf)

    return jax.vmap(value)(raw)


def evaluate_fitted_loss(loss: Loss, params: Parameters, names: Sequence[str], batch: Any) -> Array:
    """Compute the loss of a batch by the program that a fit of some numbers runs anyway.

    Args:
        loss: `loss(params, batch)`, a scalar.
        params: Parameters of an estimator.
        names: The numbers that are fitted by gradient.
        batch: One batch.

    Returns:
        The loss, (); infinite where a fitted number is out of bounds.
    """
    if not names:
        return evaluate_loss(loss, params, batch)
    raw = {name: jnp.asarray(np.asarray(params.raw[name])[None]) for name in names}
    return _compute_losses(loss, params, raw, batch)[0]


@functools.partial(jax.jit, static_argnums=(0, 1))
def loss_and_grad(
    loss: Loss, forward: bool, params: Parameters, raw: dict[str, Array], batch: Any
) -> tuple[Array, dict[str, Array]]:
    """Compute the loss of each start and its gradient with respect to the unconstrained numbers.

    Args:
        loss: `loss(params, batch)`, a scalar.
        forward: True for forward-mode differentiation, false for reverse.
        params: Parameters of an estimator; those in `raw` are replaced.
        raw: Unconstrained numbers by name, each (starts, ...).
        batch: One batch.

    Returns:
        The losses, (starts,), and the gradient in the shape of `raw`.
    """

    def value(one: dict[str, Array]) -> Array:
        return loss(params.with_raw(one), batch)

    def forwards(one: dict[str, Array]) -> tuple[Array, dict[str, Array]]:
        flat, restore = ravel_pytree(one)

        def along(direction: Array) -> tuple[Array, Array]:
            return jax.jvp(lambda at: value(restore(at)), (flat,), (direction,))

        directions = jnp.eye(flat.size, dtype=flat.dtype)
        here, slope = jax.vmap(along, out_axes=(None, 0))(directions)
        return here, restore(slope)

    return jax.vmap(forwards if forward else jax.value_and_grad(value))(raw)


@jax.jit
def _keep_or_return(position: Position, loss: Array) -> tuple[Position, Array]:
    """Keep where each start is, or return it to where it was, at half its learning rate.

    Args:
        position: State of the fit.
        loss: (starts,) fit losses with batches prepared anew.

    Returns:
        The state, and which starts returned, (starts,).
    """
    returned = ~(loss <= position.kept_loss)

    def choose(old: Array, new: Array) -> Array:
        return jnp.where(returned.reshape(-1, *[1] * (new.ndim - 1)), old, new)

    raw = jax.tree.map(choose, position.kept, position.raw)
    memory = jax.vmap(ADAM_TRANSFORM.init)(raw)
    kept = dataclasses.replace(
        position,
        raw=raw,
        kept=raw,
        kept_loss=choose(position.kept_loss, loss),
        optimiser=jax.tree.map(choose, memory, position.optimiser),
        rate=position.rate * jnp.where(returned, 0.5, 1),
    )
    return kept, returned


@jax.jit
def _adam_step(position: Position, slope: dict[str, Array], rate: float | Array) -> Position:
    """Take a step of Adam from each start.

    Args:
        position: Parameters of all starts.
        slope: Gradient with respect to `raw`, each (starts, ...).
        rate: Learning rate.

    Returns:
        The new position.
    """
    update: Any = jax.vmap(ADAM_TRANSFORM.update)
    direction, memory = update(slope, position.optimiser)
    rates = rate * position.rate
    raw = {
        name: leaf - rates.reshape(-1, *[1] * (leaf.ndim - 1)) * direction[name]
        for name, leaf in position.raw.items()
    }
    return dataclasses.replace(position, raw=raw, optimiser=memory)


@jax.jit
def _update_best(
    position: Position, seen: Array, i: int | Array, patience: int | Array
) -> tuple[Position, Array]:
    """Update the best parameters of each start that has not stopped.

    Args:
        position: State of the fit.
        seen: (starts,) validation losses of this iteration.
        i: Number of the iteration.
        patience: Iterations without improvement after which a start stops.

    Returns:
        The state, and whether any start continues.
    """
    first = i == 0
    going = first | (i - position.best_at < patience)
    better = first | (going & (seen < position.best_loss))

    def choose(new: Array, old: Array) -> Array:
        return jnp.where(better.reshape(-1, *[1] * (new.ndim - 1)), new, old)

    best_at = choose(jnp.full_like(position.best_at, i), position.best_at)
    seen = jnp.where(jnp.isnan(seen), jnp.inf, seen)
    position = dataclasses.replace(
        position,
        best=jax.tree.map(choose, position.raw, position.best),
        best_loss=choose(seen, position.best_loss),
        best_at=best_at,
    )
    return position, (i - best_at < patience).any()


def map_batches(function: Callable[[Any], Any], batches: Sequence[Any]) -> list[tuple[float, Any]]:
    """Apply a function to the batches of all processes, and gather the results.

    Args:
        function: A function of a batch that returns a pytree of arrays.
        batches: All batches, with `processes.REMOTE_BATCH` for those of other processes.

    Returns:
        For each batch its weight and the function's value.
    """
    if processes.is_single():
        return [(_weight(batch), function(batch)) for batch in batches]
    own = ((k, batch) for k, batch in enumerate(batches) if batch is not processes.REMOTE_BATCH)
    mine = {k: (batch, function(batch)) for k, batch in own}  # all are dispatched before any wait
    said = {k: (_weight(batch), jax.device_get(part)) for k, (batch, part) in mine.items()}
    gathered = {k: v for some in processes.allgather(said) for k, v in some.items()}
    values = (gathered[k] for k in range(len(batches)))
    return [(weight, jax.tree.map(jnp.asarray, value)) for weight, value in values]


def _weighted_mean(function: Callable[[Any], Any], batches: Sequence[Any]) -> Any:
    """Compute the mean of a function over batches, weighted by the batches' `weight`.

    Several processes add the results in the same order as one process does.

    Args:
        function: Function of a batch that returns a pytree of arrays.
        batches: The batches.
    """
    found = map_batches(function, batches)
    if len(batches) == 1:
        return found[0][1]
    whole, total = sum(weight for weight, _ in found), None
    for weight, part in found:
        share = weight / whole
        part = jax.tree.map(lambda leaf, share=share: share * leaf, part)
        total = part if total is None else jax.tree.map(jnp.add, total, part)
    return total


def _weight(batch: Any) -> float:
    return float(batch.weight) if isinstance(batch, WeightedBatch) else 1.0


def batches_by_params(
    batches: Sequence[Any] | Callable[[Any], Batches], validation: Sequence[Any] = ()
) -> Callable[[Any], Batches]:
    """Return the batches of this process as a function of parameters.

    Args:
        batches: Batches to fit to, or a function `prepare(params)`; see `optimise`.
        validation: Batches to validate on, if `batches` is a list.

    Returns:
        A function from parameters to batches to fit to and batches to validate on. An `InputError`
        of one process is raised on all.
    """
    if callable(batches):
        prepare: Callable[[Any], Batches] = batches  # ty: ignore[invalid-assignment]
        return lambda params: processes.on_all_processes(lambda: prepare(params))
    shares = processes.partition_batches(batches), processes.partition_batches(validation)
    return lambda _: shares


class _Loop:
    """The stages of `optimise`, which change its `Run`."""

    bar: tqdm

    def __init__(
        self,
        loss: Loss,
        params: Parameters,
        prepare: Callable[[Any], Batches],
        *,
        settings: Settings,
        intervals: Mapping[str, Interval],
        run: Run,
        save: Callable[[Run, bool], None],
    ):
        self.function, self.params, self.settings = loss, params, settings
        self.prepare = prepare
        self.intervals, self.run, self.save = intervals, run, save
        numbers = sum(leaf[0].size for leaf in run.position.raw.values())
        self.forward = (
            numbers <= MAX_FORWARD_PARAMETERS if settings.forward is None else settings.forward
        )

    def best_params(self) -> Any:
        """Return the parameters of the best start."""
        position = self.run.position
        best = int(jnp.argmin(position.best_loss))
        raw = {name: leaf[best] for name, leaf in position.raw.items()}
        return self.params.with_raw({**raw, **position.searched})

    def loss(self, params: Any, batches: Sequence[Any]) -> float:
        names = list(self.run.position.raw)
        function = functools.partial(evaluate_fitted_loss, self.function, params, names)
        return float(_weighted_mean(function, batches))

    def check_losses(self) -> None:
        """Raise `InputError` unless the losses of the initial parameters are finite."""
        fit, validation = self.prepare(self.params)
        if not fit:
            raise InputError("there is nothing to fit to; give recordings with images or positions")
        for batches in (fit, validation or fit):
            if not math.isfinite(self.loss(self.params, batches)):
                raise InputError(
                    "the loss is not finite where the fit starts; start from other parameters, or "
                    "remove hot pixels"
                )

    def search(self) -> None:
        """Search the searched parameters one after another, with the others at the best start's."""
        replay, leader = iter(list(self.run.tried)), self.best_params()

        def objective(name: str, value: float) -> float:
            """Compute the fit loss of a candidate; infinite if it is not a number.

            Args:
                name: Name of the number.
                value: Its value, in its unit.
            """
            loss = next(replay, None)
            if loss is None:
                candidate = self._with_value(leader, name, value)
                loss = self.loss(candidate, self.prepare(candidate)[0])
                loss = loss if math.isfinite(loss) else math.inf
                self.bar.set_postfix({name: f"{value:.4g}", "loss": f"{loss:.4g}"})
                self._log_tried(loss)
            return loss

        for name, interval in self.intervals.items():
            here = float(getattr(leader, name))
            found = _search_minimum(
                functools.partial(objective, name), interval, here, self.run.stage // 2
            )
            leader = self._with_value(leader, name, found)
        searched = {name: leader.raw[name] for name in self.intervals}
        self.run.position = dataclasses.replace(self.run.position, searched=searched)
        if self.run.stage == 0 and self.settings.probe and self.run.position.raw:
            self._search_rough_numbers(replay)

    def _search_rough_numbers(self, replay: Iterator[float]) -> None:
        """Probe the loss around the initial parameters, and search numbers in which it is rough.

        A line along all numbers is probed first. Numbers whose predicted changes are not large
        against the errors of the predictions on that line are then probed one by one.
        """
        position = self.run.position
        params = self.params.with_raw(position.searched)
        fit = self.prepare(params)[0]
        batches = [fit[k] for k in self._draw_batches(len(fit))]
        raw = {name: leaf[:1] for name, leaf in position.raw.items()}
        units = {}
        for name, leaf in raw.items():
            size = float(jnp.abs(leaf).max())
            units[name] = unit_step(params.numbers[name], size, size)

        def moved(names: Sequence[str], step: float) -> dict[str, Array]:
            return {n: leaf + step * units[n] if n in names else leaf for n, leaf in raw.items()}

        def loss(
            names: Sequence[str], step: float, batches_at: Callable[[Any], Sequence[Any]]
        ) -> float:
            value = next(replay, None)
            if value is None:
                at = moved(names, step)
                chosen = batches_at({name: leaf[0] for name, leaf in at.items()})
                function = functools.partial(_compute_losses, self.function, params, at)
                value = float(_weighted_mean(function, chosen)[0])
                value = value if math.isfinite(value) else math.inf
                self._log_tried(value)
            return value

        def prepare_anew(one: dict[str, Array]) -> Sequence[Any]:
            anew = self.prepare(params.with_raw(one))[0]
            return [anew[k] for k in self._draw_batches(len(anew))]

        def gradient_along(names: Sequence[str], step: float) -> list[float]:
            at = moved(names, step)
            known = [value for _, value in zip(names, replay, strict=False)]
            if known:
                return known
            function = functools.partial(loss_and_grad, self.function, self.forward, params, at)
            gradient = _weighted_mean(function, batches)[1]
            found = [units[name] * float(gradient[name].sum()) for name in names]
            self._log_tried(*found)
            return found

        def probe(names: Sequence[str]) -> tuple[list[float], list[float], NDArray[np.float64]]:
            losses = {step: loss(names, step, lambda _: batches) for step in PROBE_STEPS}
            steps = [step for step, value in losses.items() if math.isfinite(value)]
            table = np.array([gradient_along(names, step) for step in steps])
            return steps, [losses[step] for step in steps], table

        names = list(raw)
        steps, losses, table = probe(names)
        error, _ = _prediction_errors(steps, losses, table.sum(1))
        for k, name in enumerate(names):
            _, predicted = _prediction_errors(steps, losses, table[:, k])
            if error @ error <= (1 - MIN_SKILL) * (predicted @ predicted):
                continue
            if len(names) > 1:
                steps, alone, slope = probe([name])
                found = gradient_skill(steps, alone, slope[:, 0])
            else:
                found = gradient_skill(steps, losses, table[:, 0])
            if found >= MIN_SKILL:
                continue
            objective = functools.partial(loss, [name], batches_at=prepare_anew)
            step = _search_smoothed(objective)
            raw[name] = moved([name], step)[name]
            value = float(params.numbers[name].physical(raw[name].mean()))
            self.run.rough[name] = RoughNumber(found, value)
        shifted = {n: leaf + (raw[n] - leaf[:1]) for n, leaf in position.raw.items()}
        self.run.position = dataclasses.replace(position, raw=shifted, best=shifted)

    def _log_tried(self, *values: float) -> None:
        """Log values, which a resumed search replays."""
        self.run.tried += values
        self.save(self.run, False)

    def _with_value(self, params: Any, name: str, value: float) -> Any:
        raw = params.numbers[name].unconstrained(jnp.asarray(value, params.raw[name].dtype))
        return params.with_raw({name: raw})

    def descend(self) -> None:
        """Take the gradient steps of a round, then return to the best parameters found."""
        run, settings = self.run, self.settings
        position, turn = run.position, run.stage // 2
        if not position.raw:
            return
        params = self.params.with_raw(position.searched)
        fit, validation = [], []
        if run.iteration:  # resumed
            fit, validation = self.prepare(params.with_raw(position.prepared))
        else:
            worst = jnp.full_like(position.best_loss, jnp.inf)
            position = dataclasses.replace(
                position,
                optimiser=jax.vmap(ADAM_TRANSFORM.init)(position.raw),
                best_loss=worst,
                kept=position.raw,
                kept_loss=worst,
                rate=jnp.ones_like(worst),
            )
        while True:
            i, seen = run.iteration, None
            if i % settings.every == 0 or i == settings.iterations:
                position, (fit, validation) = self._prepare_anew(params, position, fit)
                objective = functools.partial(_compute_losses, self.function, params, position.raw)
                seen = _weighted_mean(objective, validation or fit)
                position, going = _update_best(position, seen, i, settings.patience)
                if i == settings.iterations or not bool(going):
                    self._record(turn, i, None, seen)
                    break
            objective = functools.partial(
                loss_and_grad, self.function, self.forward, params, position.raw
            )
            losses, slope = _weighted_mean(
                objective, [fit[k] for k in self._draw_batches(len(fit))]
            )
            fall = 0.55 + 0.45 * math.cos(math.pi * i / settings.iterations)
            position = _adam_step(position, slope, settings.learning_rate / 2**turn * fall)
            self._record(turn, i, losses, seen)
            run.position, run.iteration = position, i + 1
            self.bar.n = turn * settings.iterations + i + 1
            self.bar.set_postfix(loss=f"{float(jnp.min(losses)):.5g}")
            self.save(run, False)
        run.position = dataclasses.replace(position, raw=position.best)

    def _prepare_anew(
        self, params: Any, position: Position, before: Sequence[Any]
    ) -> tuple[Position, Batches]:
        """Prepare batches with the best start; starts whose fit loss has grown return.

        Args:
            params: Parameters; those in `position.raw` are replaced.
            position: The state of the fit.
            before: Batches that the steps since the last preparation were taken with.

        Returns:
            The state, and the batches to fit to and to validate on.
        """
        leader = int(jnp.argmin(position.best_loss))

        def prepare() -> Batches:
            prepared = {name: leaf[leader] for name, leaf in position.raw.items()}
            return self.prepare(params.with_raw(prepared))

        batches = prepare()
        if batches[0] is not before:
            objective = functools.partial(_compute_losses, self.function, params, position.raw)
            position, returned = _keep_or_return(position, _weighted_mean(objective, batches[0]))
            if returned[leader]:
                batches = prepare()
        prepared = {name: leaf[leader] for name, leaf in position.raw.items()}
        return dataclasses.replace(position, prepared=prepared), batches

    def _draw_batches(self, count: int) -> Sequence[int]:
        """Return the indices of this iteration's batches, the next of successive permutations."""
        size = self.settings.batch
        if size is None or size >= count:
            return range(count)
        first = (self.run.stage // 2 * self.settings.iterations + self.run.iteration) * size
        chosen = []
        for k in range(first, first + size):
            order = np.random.default_rng([self.settings.seed, k // count]).permutation(count)
            chosen.append(int(order[k % count]))
        return chosen

    def _record(self, turn: int, i: int, losses: Array | None, seen: Array | None) -> None:
        for start in range(self.settings.starts):
            pair = [None if v is None else float(v[start]) for v in (losses, seen)]
            self.run.history.append([start, turn, i, *pair])


def _search_smoothed(objective: Callable[[float], float]) -> float:
    """Search a rough loss along a line, up to `ROUGH_SEARCH_REACH` on both sides of 0.

    Losses are smoothed over neighbours with weights 1/4, 1/2, 1/4, so that no single dip decides.
    The grid is then refined around the best point, twice.
    """
    grid = np.linspace(-ROUGH_SEARCH_REACH, ROUGH_SEARCH_REACH, N_ROUGH_CANDIDATES)
    best, width = 0.0, grid[1] - grid[0]
    tried: dict[float, float] = {}

    def cached_loss(step: float) -> float:
        step = float(step)
        if step not in tried:
            tried[step] = objective(step)
        return tried[step]

    for _ in range(3):
        losses = np.array([cached_loss(step) for step in grid])
        finite = losses[np.isfinite(losses)]
        losses = np.minimum(losses, finite.max(initial=-np.inf))
        smooth = np.convolve(np.pad(losses, 1, "edge"), [0.25, 0.5, 0.25], "valid")
        best = float(grid[int(np.argmin(smooth))])
        width /= 2
        grid = best + width * np.arange(-2, 3)
    return best


def _search_minimum(
    objective: Callable[[float], float], interval: Interval, value: float, turn: int
) -> float:
    """Search the value of one number with the least loss.

    Every round evaluates all points of the interval, as the best one may change once the other
    parameters have moved. The first round adds the vertex of the parabola through the best point
    and its neighbours; later rounds approach the minimum around the best by Brent's method.

    Args:
        objective: Loss as a function of the value.
        interval: Lowest and highest value, and the number of points.
        value: Present value, which is among the candidates.
        turn: Number of the round, from 0.

    Returns:
        The best value.
    """
    low, high, count = interval
    step = (high - low) / (count - 1)
    grid = [float(x) for x in np.linspace(low, high, count)]
    losses = [objective(x) for x in grid]
    k = int(np.argmin(losses))
    best = min((losses[k], grid[k]), (objective(value), value))
    if turn:
        from scipy.optimize import minimize_scalar  # an import of half a second, rarely needed

        reach, middle = step / 2 ** (turn - 1), min(max(best[1], low), high)
        found = minimize_scalar(
            objective,
            bounds=(max(low, middle - reach), min(high, middle + reach)),
            method="bounded",
            options={"xatol": step / 100, "maxiter": 20},
        )
        return min((float(found.fun), float(found.x)), best)[1]
    if 0 < k < count - 1:
        a, b, c = losses[k - 1 : k + 2]
        if math.isfinite(a + c) and a - 2 * b + c > 0:
            vertex = grid[k] + step * (a - c) / (a - 2 * b + c) / 2
            best = min((objective(vertex), vertex), best)
    return best[1]


__getattr__ = renamed_names(__name__)
