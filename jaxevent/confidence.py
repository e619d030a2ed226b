"""Confidence intervals of fitted parameters, and parameters that ran to a bound or away.

    fitted = jaxevent.optimise(loss, params, names, batches)
    for interval in confidence_intervals(loss, params, fitted.params, names, batches).intervals:
        print(interval)

A loss is a mean over parts: batches, or the smaller ones of a `PartwiseLoss`. With H the curvature
of the loss at the fitted parameters, g_k the gradient of part k and w_k its share, fits to other
such parts would spread by the covariance (White 1982)

    H^-1 J H^-1,  J = K / (K - p) sum_k w_k^2 (g_k - g)(g_k - g)^T,  g = sum_k w_k g_k,

for K parts and p numbers. The formula holds for any smooth loss and assumes independent parts. With
fewer than p + 2 parts, the covariance of a likelihood of n measurements, H^-1 / n, takes its place;
other losses then have no interval. H is found by differences of gradients with respect to the
unconstrained numbers, so that an interval of a positive number is positive.

The curvature is not used where it is not positive, where the interval would be wide, and where the
fit stopped away from the minimum. There the loss itself is followed in both directions, with the
other numbers held, until its rise is as large as at the ends of an interval by curvature: t / 2
standard errors of the rise's mean over parts. An end that is not found is open.

Neither holds where the loss is rough at the scale of the interval, so that derivatives tell nothing
of its changes. There the loss of every part is smoothed: a parabola is fitted to it on a line as
long as the interval or longer. The formula above, with its derivatives, gives an interval around
its minimum. Where the parabola does not fit, as to a flat loss between steep walls, the loss itself
is followed.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from numpy.typing import NDArray

from jaxevent.deprecated import RenamedAttribute, renamed_names
from jaxevent.parameters import MAX_VALUE, Number, Parameters, Positive
from jaxevent.tuning import (
    MAX_FORWARD_PARAMETERS,
    MIN_SKILL,
    Batches,
    Interval,
    Loss,
    batches_by_params,
    evaluate_fitted_loss,
    gradient_skill,
    loss_and_grad,
    map_batches,
    unit_step,
)

CONFIDENCE_LEVEL = 0.95
DIFFERENCE_LOG_STEP = 0.02  # of differences, in logarithms, or in shares of a number that has none
MAX_TRUSTED_LOG_WIDTH = 2.0  # half widths in logarithms beyond which the curvature is not trusted
MAX_RISE_RATIO = 4.0  # of a loss at an interval's ends and its rise by the curvature
SMOOTHED_REACHES, N_SMOOTHED = (0.35, 0.7, 1.4, 2.8), 9  # unit steps, and points on such a line
MIN_CURVATURE_ERRORS = 4.0  # of a smoothed loss, standard errors
FIRST_SEARCH_STEP, MAX_DOUBLINGS, N_HALVINGS = 0.1, 6, 5  # of the steps of the search for an end
RUNAWAY_LOG_DISTANCE = math.log(10.0)  # distance from the start of a number that ran away
BOUND_LOG_TOLERANCE = 0.25  # of a bound, in the same measure

REACHED_BOUND = "ran to its bound {:g}"
REACHED_SEARCH_END = "ran to the end of its search, {:g}"
RAN_AWAY = "ran away: the loss does not bound it"
UNDETERMINED = "these data do not determine it"
NOT_CONVERGED = "had not converged"
ROUGH = "the loss is rough at the scale of its interval"


@dataclasses.dataclass(frozen=True)
class ParameterInterval:
    """Confidence interval (95 %) of a number that was fitted or searched, in its unit.

    An end that is None is open: the loss does not rise enough within the range of the search.
    Without an interval both ends are NaN. `remark` says why an interval may not be trusted; it is
    mostly empty.

    Attributes:
        name: Name of the parameter.
        unit: Its unit.
        start: Value before the fit.
        value: Value that was fitted or searched.
        low: Lower end of the interval.
        high: Upper end of the interval.
        remark: Reason why the interval may not be trusted.
    """

    name: str
    unit: str
    start: float
    value: float
    low: float | None
    high: float | None
    remark: str = ""

    @property
    def interval(self) -> str:
        """The interval as text."""
        low, high = (None if end is None else f"{end:.4g}" for end in (self.low, self.high))
        if "nan" in (low, high):
            return "-"
        if low is None:
            return "any" if high is None else f"below {high}"
        return f"above {low}" if high is None else f"{low} to {high}"

    def holds(self, value: float) -> bool:
        """Return true if a value is inside the interval."""
        above = self.low is None or self.low <= value
        return bool(above and (self.high is None or value <= self.high))


@dataclasses.dataclass(frozen=True)
class FitIntervals:
    """Intervals of all numbers of a fit.

    Attributes:
        intervals: One interval for each number.
        parts: Number of parts that the intervals rest on; 0 where they rest on measurements.
    """

    intervals: list[ParameterInterval]
    parts: int

    findings = RenamedAttribute("intervals")

    def __getitem__(self, name: str) -> ParameterInterval:
        return next(one for one in self.intervals if one.name == name)


@runtime_checkable
class PartwiseLoss(Protocol):
    """A loss that can be split into about independent parts of a batch."""

    def parts(self, params: Any, batch: Any) -> tuple[Array, Array]:
        """Compute the loss of each part; their weighted mean is the loss of the batch.

        Args:
            params: Parameters of an estimator.
            batch: One batch, as the loss takes it.

        Returns:
            The mean of each part, (parts,), and its weight, (parts,).
        """
        ...


# Seven positional arguments, in the order of `optimise`.
def confidence_intervals(
    loss: Loss,
    start: Parameters,
    found: Parameters,
    names: Sequence[str],
    batches: Sequence[Any] | Callable[[Any], Batches],
    search: Mapping[str, Interval] | None = None,
    forward: bool | None = None,
) -> FitIntervals:
    """Estimate how precisely the data determine each number of a fit.

    Args:
        loss: The loss that `optimise` minimised. An attribute `likelihood` that is true marks it as
            the mean of -ln p over as many measurements as the batches' `weight` counts.
        start: The parameters that the fit began with.
        found: The parameters that the fit ended with.
        names: Numbers that were fitted by gradient.
        batches: The batches that `optimise` was given.
        search: The searches that `optimise` was given.
        forward: Mode of differentiation, see `tuning.Settings`.

    Returns:
        One interval for each number that was fitted or searched.
    """
    prepared = batches_by_params(batches)
    given = _Sample(loss, found, names, forward, prepared(found)[0])
    findings = _intervals_of_fitted(given, start)
    for name, interval in (search or {}).items():
        findings.append(_interval_of_searched(loss, start, found, name, interval, prepared))
    return FitIntervals(findings, 0 if given.by_measurements else given.count)


@functools.partial(jax.jit, static_argnums=0)
def _parts(loss: Any, params: Any, batch: Any) -> tuple[Array, Array]:
    """Return the loss of the parts of a batch and their weights, compiled.

    Args:
        loss: A `PartwiseLoss`.
        params: Parameters of the method.
        batch: A batch.

    Returns:
        Losses and weights, both (parts,).
    """
    return loss.parts(params, batch)


@functools.partial(jax.jit, static_argnums=0)
def _directional_derivatives(
    loss: Any, params: Any, raw: dict[str, Array], way: dict[str, Array], batch: Any
):
    """Compute the derivative of every part of a loss along a direction.

    Args:
        loss: The loss.
        params: Parameters.
        raw: Unconstrained numbers by name.
        way: The direction, in the shape of `raw`.
        batch: One batch.

    Returns:
        (parts,).
    """

    def value(one: dict[str, Array]) -> Array:
        return loss.parts(params.with_raw(one), batch)[0]

    return jax.jvp(value, (raw,), (way,))[1]


class _Sample:
    """The loss of all parts near the parameters where a fit ended."""

    def __init__(
        self,
        loss: Any,
        found: Parameters,
        names: Sequence[str],
        forward: bool | None,
        batches: Sequence[Any],
    ):
        self.loss, self.found, self.names, self.batches = loss, found, names, batches
        leaves = {name: np.asarray(found.raw[name], np.float64) for name in names}
        self.places = [(name, index) for name in names for index in np.ndindex(leaves[name].shape)]
        self.at = np.array([leaves[name][index] for name, index in self.places])
        self.forward = len(self.at) <= MAX_FORWARD_PARAMETERS if forward is None else forward
        self.likelihood = bool(getattr(loss, "likelihood", False))
        self.values, self.weights = self.losses(found)
        self.measurements = float(self.weights.sum())
        self.shares = self.weights / self.measurements
        self.count = int((self.weights > 0).sum())

    @property
    def robust(self) -> bool:
        """True if there are enough parts to estimate the covariance from their scatter."""
        return self.count >= len(self.at) + 2

    @property
    def by_measurements(self) -> bool:
        """True if the covariance is that of a likelihood of n measurements."""
        return self.likelihood and not self.robust

    @property
    def quantile(self) -> float:
        """Half width of the interval in standard deviations."""
        from scipy.special import ndtri, stdtrit

        tail = 0.5 + CONFIDENCE_LEVEL / 2
        degrees = self.count - max(len(self.at), 1)
        return float(stdtrit(degrees, tail) if self.robust else ndtri(tail))

    def raw(self, at: NDArray[np.float64]) -> dict[str, Array]:
        """Return the unconstrained numbers at a point, by name."""
        leaves = {name: np.array(self.found.raw[name], np.float64) for name in self.names}
        for (name, index), value in zip(self.places, at, strict=True):
            leaves[name][index] = value
        return {name: jnp.asarray(v, self.found.raw[name].dtype) for name, v in leaves.items()}

    def losses(self, params: Parameters, batches: Sequence[Any] | None = None):
        """Compute the loss and the weight of every part.

        Args:
            params: Parameters of the loss.
            batches: Batches of the loss; None: those of the sample.

        Returns:
            Losses and weights, (parts,) each; the loss of a part of weight 0 is 0.
        """
        batches = self.batches if batches is None else batches
        if not isinstance(self.loss, PartwiseLoss):
            function = functools.partial(evaluate_fitted_loss, self.loss, params, self.names)
            found = map_batches(function, batches)
            pairs = [(np.atleast_1d(value), np.atleast_1d(weight)) for weight, value in found]
        else:
            found = map_batches(lambda batch: _parts(self.loss, params, batch), batches)
            pairs = [
                (np.asarray(v), _rescale_weights(np.asarray(w), whole)) for whole, (v, w) in found
            ]
        values, weights = (
            np.concatenate(column).astype(np.float64) for column in zip(*pairs, strict=True)
        )
        return np.where(weights > 0, values, 0.0), weights

    def slope(self, at: NDArray[np.float64]) -> NDArray[np.float64]:
        """Compute the gradient of every batch, (batches, numbers)."""
        raw = {name: leaf[None] for name, leaf in self.raw(at).items()}
        function = functools.partial(loss_and_grad, self.loss, self.forward, self.found, raw)
        found = map_batches(lambda batch: function(batch)[1], self.batches)
        rows = [[np.asarray(s[name][0])[index] for name, index in self.places] for _, s in found]
        return np.array(rows, np.float64)

    def mean_slope(self, at: NDArray[np.float64]) -> NDArray[np.float64]:
        weights = [weight for weight, _ in map_batches(lambda _: 0, self.batches)]
        return np.average(self.slope(at), axis=0, weights=weights)

    def slopes_of_parts(self) -> NDArray[np.float64]:
        """Compute the gradient of every part, (parts, numbers)."""
        if not isinstance(self.loss, PartwiseLoss):
            return self.slope(self.at)
        raw, columns = self.raw(self.at), []
        for name, index in self.places:
            way = {key: jnp.zeros_like(leaf) for key, leaf in raw.items()}
            way[name] = way[name].at[index].set(1.0)
            function = functools.partial(_directional_derivatives, self.loss, self.found, raw, way)
            found = map_batches(lambda batch, function=function: function(batch), self.batches)
            columns.append(np.concatenate([np.asarray(part) for _, part in found]))
        table = np.stack(columns, 1).astype(np.float64)
        return np.where(self.weights[:, None] > 0, table, 0.0)

    def rises(self, values: NDArray[np.float64]) -> bool | None:
        """Return true if the loss has risen as much as at an interval's end.

        None if undetermined.
        """
        if not np.isfinite(values).all():
            return True
        rise = values - self.values
        mean = float(self.shares @ rise)
        if self.by_measurements:
            return mean * self.measurements > self.quantile**2 / 2
        if self.count < 3:
            return None
        spread = self.shares**2 @ (rise - mean) ** 2 * self.count / (self.count - 1)
        return mean > max(self.quantile / 2 * math.sqrt(spread), 1e-12)


def _rescale_weights(weights: NDArray, whole: float) -> NDArray:
    """Scale the weights of parts so that their sum is the weight of the batch.

    Args:
        weights: (parts,) weights.
        whole: Weight of the batch.

    Returns:
        (parts,).
    """
    return weights * (whole / max(float(weights.sum()), 1e-300))


def _to_physical(number: Number, raw: float) -> float:
    return float(number.physical(jnp.asarray(raw)))


def _intervals_of_fitted(sample: _Sample, start: Parameters) -> list[ParameterInterval]:
    """Find the intervals of all numbers that were fitted by gradient."""
    numbers = [sample.found.numbers[name] for name, _ in sample.places]
    begun = np.array([float(np.asarray(start.raw[name])[i]) for name, i in sample.places])
    scales = np.array(list(map(unit_step, numbers, sample.at, begun)))
    widths, newton, curvatures = _widths(sample, scales) if len(numbers) else (scales,) * 3
    findings = []
    for k, ((name, index), number) in enumerate(zip(sample.places, numbers, strict=True)):
        settled = abs(newton[k]) <= max(widths[k], DIFFERENCE_LOG_STEP)
        # Longer lines have every other point of shorter ones.
        objective = functools.cache(functools.partial(_losses_at_step, sample, k, scales[k]))
        follow = functools.partial(_follow_loss, sample, objective)
        trusted = widths[k] < MAX_TRUSTED_LOG_WIDTH and settled
        if trusted:
            ends = [-widths[k], widths[k]]
            rough = _rises_otherwise(sample, objective, widths[k], curvatures[k])
        else:
            ends = follow()
            rough = _has_no_skill(sample, k, scales[k], ends)
        if rough:
            ends = _smoothed_ends(sample, objective) or follow()
        low, high = (None if end is None else sample.at[k] + end * scales[k] for end in ends)
        remark = _remark(sample, k, (sample.at[k] - begun[k]) / scales[k], ends, scales[k])
        if not remark and not settled and np.isfinite(newton[k]):
            remark = NOT_CONVERGED
        if not remark and rough:
            remark = ROUGH
        label = name if not index else f"{name}[{index[0] + 1}]"
        began, value = (_to_physical(number, raw) for raw in (begun[k], sample.at[k]))
        low, high = (None if raw is None else _to_physical(number, raw) for raw in (low, high))
        findings.append(ParameterInterval(label, number.unit, began, value, low, high, remark))
    return findings


def _rises_otherwise(
    sample: _Sample,
    objective: Callable[[float], NDArray[np.float64] | None],
    width: float,
    curvature: float,
) -> bool:
    """Return true if the loss at the ends of an interval differs from the curvature's prediction.

    Args:
        sample: The loss of all parts.
        objective: Function of a step that returns the losses (parts,), None outside the bounds.
        width: Half width of the interval, unit steps.
        curvature: Second derivative of the loss by the step.
    """
    found = [objective(sign * width) for sign in (-1.0, 1.0)]
    rises = [sample.shares @ (values - sample.values) for values in found if values is not None]
    if len(rises) < 2 or not np.isfinite(rises).all():
        return False
    ratio = float(np.mean(rises)) / (curvature * width**2 / 2)
    return not 1 / MAX_RISE_RATIO < ratio < MAX_RISE_RATIO


def _has_no_skill(sample: _Sample, k: int, scale: float, ends: Sequence[float | None]) -> bool:
    """Return true if the slope does not predict the changes of the loss inside an interval.

    Args:
        sample: The loss of all parts.
        k: Which of the numbers.
        scale: Its unit step.
        ends: Ends of the interval, unit steps; None: open.
    """
    if not all(end is not None and math.isfinite(end) for end in ends):
        return False
    low, high = (0.99 * float(end) for end in ends if end is not None)
    steps, losses, slopes = [low, low / 2, 0.0, high / 2, high], [], []
    for step in steps:
        values = _losses_at_step(sample, k, scale, step)
        at = sample.at.copy()
        at[k] += step * scale
        losses.append(math.nan if values is None else sample.shares @ values)
        slopes.append(scale * sample.mean_slope(at)[k])
    return gradient_skill(steps, losses, slopes) < MIN_SKILL


def _follow_loss(
    sample: _Sample, objective: Callable[[float], NDArray[np.float64] | None]
) -> list[float | None]:
    """Find both ends of an interval by following the loss, see `_find_interval_end`.

    Args:
        sample: The loss of all parts.
        objective: Function of a step that returns the losses (parts,), None outside the bounds.

    Returns:
        The ends, unit steps.
    """
    return [_find_interval_end(sample, objective, sign) for sign in (-1.0, 1.0)]


def _smoothed_ends(
    sample: _Sample, objective: Callable[[float], NDArray[np.float64] | None]
) -> list[float | None] | None:
    """Find the ends of the interval of a smoothed loss.

    The loss is smoothed by a parabola over the shortest line that holds the interval and determines
    the curvature to a quarter. The interval is extended to where the fit ended, to which such data
    can lead.

    Args:
        sample: The loss of all parts.
        objective: Function of a step that returns the losses (parts,), None outside the bounds.

    Returns:
        The ends, unit steps; None if the loss has no minimum near, or is no parabola, as a flat one
            between steep walls.
    """
    if sample.count < 3:
        return None

    def standard_error(each: NDArray[np.float64]) -> float:
        apart = (each - sample.shares @ each) * sample.shares
        return math.sqrt(apart @ apart * sample.count / (sample.count - 1))

    for reach in SMOOTHED_REACHES:
        steps = np.arange(-(N_SMOOTHED // 2), N_SMOOTHED // 2 + 1) * (2 * reach / (N_SMOOTHED - 1))
        found = [objective(float(step)) for step in steps]
        table = np.array([value for value in found if value is not None])
        if len(table) < N_SMOOTHED or not np.isfinite(table).all():
            return None
        coefficients = np.polyfit(steps, table, 2)
        half_curvature, slope, _ = coefficients
        H = 2 * sample.shares @ half_curvature
        if not H > MIN_CURVATURE_ERRORS * standard_error(2 * half_curvature):
            continue
        lowest = -(sample.shares @ slope) / H
        each = slope + 2 * half_curvature * lowest
        width = sample.quantile * standard_error(each) / H
        if abs(lowest) + width <= reach:
            residuals = table - np.vander(steps, 3) @ coefficients
            errors = [standard_error(each) for each in residuals]
            off = (residuals @ sample.shares) / np.maximum(errors, 1e-300)
            if np.sqrt(np.mean(off**2)) > sample.quantile:
                return None
            return [min(lowest - width, 0.0), max(lowest + width, 0.0)]
    return None


def _widths(sample: _Sample, scales: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
    """Compute half widths by curvature, Newton steps and curvatures, in unit steps.

    Args:
        sample: Sample of the loss.
        scales: (p,) length of a unit step of each parameter.

    Returns:
        Half widths, Newton steps and curvatures, (p,) each; widths and steps are infinite where
        they are not determined.
    """
    p = len(scales)
    rows = []
    for k in range(p):
        step = np.zeros(p)
        step[k] = DIFFERENCE_LOG_STEP * scales[k]
        rows.append(sample.mean_slope(sample.at + step) - sample.mean_slope(sample.at - step))
    H = np.array(rows) * scales / (2 * DIFFERENCE_LOG_STEP)
    H = (H + H.T) / 2
    widths, newton = np.full(p, np.inf), np.full(p, np.inf)
    kept = [k for k in range(p) if np.isfinite(H[k]).all()]
    while kept:
        size, ways = np.linalg.eigh(H[np.ix_(kept, kept)])
        if size[0] > 1e-7 * abs(size[-1]):
            break
        kept.pop(int(np.argmax(np.abs(ways[:, 0]))))
    if not kept:
        return widths, newton, np.diag(H)
    slope = sample.mean_slope(sample.at)[kept] * scales[kept]
    inverse = np.linalg.inv(H[np.ix_(kept, kept)])
    newton[kept] = -inverse @ slope
    if sample.robust:
        each = sample.slopes_of_parts()[:, kept] * scales[kept]
        apart = (each - sample.shares @ each) * sample.shares[:, None]
        covariance = inverse @ (apart.T @ apart) @ inverse * sample.count / (sample.count - p)
    elif sample.by_measurements:
        covariance = inverse / sample.measurements
    else:
        return widths, newton, np.diag(H)
    widths[kept] = sample.quantile * np.sqrt(np.diag(covariance))
    return widths, newton, np.diag(H)


def _losses_at_step(
    sample: _Sample, k: int, scale: float, step: float
) -> NDArray[np.float64] | None:
    """Compute the losses of all parts with one number moved.

    Args:
        sample: The loss of all parts.
        k: Which of the numbers.
        scale: Its unit step.
        step: Number of unit steps.

    Returns:
        (parts,); None outside the number's bounds.
    """
    at = sample.at.copy()
    at[k] += step * scale
    params = sample.found.with_raw(sample.raw(at))
    name, _ = sample.places[k]
    if not bool(params.numbers[name].allows(getattr(params, name))):
        return None
    return sample.losses(params)[0]


def _find_interval_end(
    sample: _Sample, objective: Callable[[float], NDArray[np.float64] | None], sign: float
) -> float | None:
    """Find the distance at which the loss has risen enough.

    Args:
        sample: The loss of all parts.
        objective: Function of a step that returns the losses (parts,), None outside the bounds.
        sign: 1 to search upwards, -1 downwards.

    Returns:
        The end, unit steps; None if not found, NaN if undetermined.
    """
    inside, step = 0.0, FIRST_SEARCH_STEP
    for _ in range(MAX_DOUBLINGS + 1):
        values = objective(sign * step)
        if values is None:
            return None
        risen = sample.rises(values)
        if risen is None:
            return math.nan
        if risen:
            break
        inside, step = step, 2 * step
    else:
        return None
    for _ in range(N_HALVINGS):
        middle = (inside + step) / 2
        values = objective(sign * middle)
        if values is None or sample.rises(values):
            step = middle
        else:
            inside = middle
    return sign * step


def _remark(
    sample: _Sample, k: int, moved: float, ends: Sequence[float | None], scale: float
) -> str:
    """Describe a number that ran to a bound or away.

    Args:
        sample: The loss of all parts.
        k: Which of the numbers.
        moved: Its move in the fit, unit steps.
        ends: Ends of its interval, unit steps; None: open.
        scale: Its unit step.

    Returns:
        The remark; empty if there is none.
    """
    number = sample.found.numbers[sample.places[k][0]]
    for bound in (number.least, number.most):
        if abs(bound) >= MAX_VALUE or (bound == 0 and isinstance(number, Positive)):
            continue
        away = (float(number.unconstrained(jnp.asarray(bound))) - sample.at[k]) / scale
        if abs(away) < BOUND_LOG_TOLERANCE:
            values = _losses_at_step(sample, k, scale, away * (1 - 1e-3))
            if values is not None and sample.shares @ (values - sample.values) <= 0:
                return REACHED_BOUND.format(bound)
    low, high = ends
    if abs(moved) > RUNAWAY_LOG_DISTANCE and (high if moved > 0 else low) is None:
        return RAN_AWAY
    return UNDETERMINED if low is None and high is None else ""


def _interval_of_searched(
    loss: Any,
    start: Parameters,
    found: Parameters,
    name: str,
    interval: Interval,
    prepared: Callable[[Any], Batches],
) -> ParameterInterval:
    """Find the interval of a number that was searched; every value prepares the batches again.

    Args:
        loss: The loss.
        start: Parameters at the start of the fit.
        found: Parameters at its end.
        name: Name of the number.
        interval: Low and high end, and number of values that were tried.
        prepared: Function that prepares the batches for parameters.

    Returns:
        The interval.
    """
    low, high, count = interval
    value, scale = float(getattr(found, name)), (high - low) / (count - 1)
    number = found.numbers[name]

    def objective(step: float) -> NDArray[np.float64] | None:
        place = value + step * scale
        if not low <= place <= high:
            return None
        stored = number.unconstrained(jnp.asarray(place, found.raw[name].dtype))
        params = found.with_raw({name: stored})
        return sample.losses(params, prepared(params)[0])[0]

    sample = _Sample(loss, found, (), None, prepared(found)[0])
    ends = [_find_interval_end(sample, objective, sign) for sign in (-1.0, 1.0)]
    below, above = (None if end is None else value + end * scale for end in ends)
    remark = ""
    for bound in (low, high):
        if abs(value - bound) < 1e-3 * scale:
            remark = REACHED_SEARCH_END.format(bound)
    if not remark and ends == [None, None]:
        remark = UNDETERMINED
    began = float(getattr(start, name))
    return ParameterInterval(name, number.unit, began, value, below, above, remark)


__getattr__ = renamed_names(__name__)
