"""What a fit found: the interval of every number, and which ran to a bound or away.

    fitted = jaxevent.optimise(loss, params, names, batches)
    for finding in examine(loss, params, fitted.params, names, batches).findings:
        print(finding)

A loss is a mean over parts: batches, or smaller ones that the loss tells apart (`Parted`). With H
the curvature of the loss where the fit ended and g_k the slope of part k, which has the share w_k,
fits to other such parts would spread by the covariance (White 1982)

    H^-1 J H^-1,  J = K / (K - p) sum_k w_k^2 (g_k - g)(g_k - g)^T,  g = sum_k w_k g_k,

for K parts and p numbers. It holds for any smooth loss and takes the parts as independent. With
fewer than p + 2 parts that of a likelihood of n measurements, H^-1 / n, takes its place; of other
losses there is no interval then. H is found by differences of gradients, in the unconstrained
numbers, so that an interval of a positive number is positive.

The curvature says nothing where it is not positive, where the interval would be wide, and where the
fit stopped away from the least loss. There the loss itself is followed in both directions, the
other numbers held, until its rise is as large as at the ends of an interval by curvature: t / 2
standard errors of the rise's mean over parts. An end that is not found is open.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
import scipy.special
from jaxtyping import Array
from numpy.typing import NDArray

from jaxevent.parameters import LARGEST, Number, Parameters, Positive, Share
from jaxevent.tuning import FORWARD, Batches, Interval, Loss, Prepared, each_of, loss_of, slopes

LEVEL = 0.95
STEP = 0.02  # of differences, in logarithms, or in shares of a number that has none
WIDE = 2.0  # half widths in logarithms from which the curvature at one place does not tell them
FIRST, DOUBLINGS, HALVINGS = 0.1, 6, 5  # of the steps that look for an end
AWAY = math.log(10.0)  # how far a number has run that ran away
NEAR = 0.25  # of a bound, in the same measure

AT_BOUND = "ran to its bound {:g}"
AT_END = "ran to the end of its search, {:g}"
RAN_AWAY = "ran away: the loss does not hold it"
UNKNOWN = "these data do not tell it"
UNSETTLED = "had not come to rest"


@dataclasses.dataclass(frozen=True)
class Finding:
    """A number that was fitted or searched, in its unit, and its interval of 95 %.

    An end that is None is open: the loss does not rise as far as was looked. Without an interval
    both are NaN. `remark` says what is to be known of it, and is mostly empty.
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
        """Whether a value is inside the interval."""
        above = self.low is None or self.low <= value
        return bool(above and (self.high is None or value <= self.high))


@dataclasses.dataclass(frozen=True)
class Findings:
    """All numbers of a fit, and of how many parts their intervals are; 0: of measurements."""

    findings: list[Finding]
    parts: int

    def __getitem__(self, name: str) -> Finding:
        return next(one for one in self.findings if one.name == name)


@runtime_checkable
class Parted(Protocol):
    """A loss that tells parts of a batch apart which are about independent."""

    def parts(self, params: Any, batch: Any) -> tuple[Array, Array]:
        """The mean of each part, (parts,), and its weight; their weighted mean is the loss."""
        ...


def examine(
    loss: Loss,
    start: Parameters,
    found: Parameters,
    names: Sequence[str],
    batches: Sequence[Any] | Callable[[Any], Batches],
    search: Mapping[str, Interval] | None = None,
    forward: bool | None = None,
) -> Findings:
    """Tell how well each number of a fit is known from what it was fitted to.

    Args:
        loss: As `optimise` was given it. Its attribute `likelihood`, if it has one, says whether it
            is the mean of -ln p over as many measurements as the batches' `weight` says.
        start: The parameters that the fit began with.
        found: Those that it ended with.
        names: What was fitted by gradient.
        batches: As `optimise` was given them.
        search: What was searched.
        forward: Mode of the derivatives, as in `tuning.Settings`.
    """
    prepared = Prepared.of(batches, (), None)
    given = _Sample(loss, found, names, forward, prepared(found)[0])
    findings = _fitted(given, start)
    for name, interval in (search or {}).items():
        findings.append(_searched(loss, start, found, name, interval, prepared))
    return Findings(findings, 0 if given.by_measurements else given.count)


@functools.partial(jax.jit, static_argnums=0)
def _parts(loss: Any, params: Any, batch: Any) -> tuple[Array, Array]:
    return loss.parts(params, batch)


@functools.partial(jax.jit, static_argnums=0)
def _along(loss: Any, params: Any, raw: dict[str, Array], way: dict[str, Array], batch: Any):
    """The slope of every part along a direction, (parts,)."""

    def value(one: dict[str, Array]) -> Array:
        return loss.parts(params.with_raw(one), batch)[0]

    return jax.jvp(value, (raw,), (way,))[1]


class _Sample:
    """The loss of the parts that it is a mean of, near where a fit ended."""

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
        self.forward = len(self.at) <= FORWARD if forward is None else forward
        self.likelihood = bool(getattr(loss, "likelihood", False))
        self.values, self.weights = self.losses(found)
        self.measurements = float(self.weights.sum())
        self.shares = self.weights / self.measurements
        self.count = int((self.weights > 0).sum())

    @property
    def robust(self) -> bool:
        """Whether there are parts enough to tell from how they differ."""
        return self.count >= len(self.at) + 2

    @property
    def by_measurements(self) -> bool:
        """Whether it is told by the number of measurements instead."""
        return self.likelihood and not self.robust

    @property
    def quantile(self) -> float:
        """Of the interval, in standard deviations."""
        tail = 0.5 + LEVEL / 2
        degrees = self.count - max(len(self.at), 1)
        return float(
            scipy.special.stdtrit(degrees, tail) if self.robust else scipy.special.ndtri(tail)
        )

    def raw(self, at: NDArray[np.float64]) -> dict[str, Array]:
        """What is stored of all fitted numbers."""
        leaves = {name: np.array(self.found.raw[name], np.float64) for name in self.names}
        for (name, index), value in zip(self.places, at, strict=True):
            leaves[name][index] = value
        return {name: jnp.asarray(v, self.found.raw[name].dtype) for name, v in leaves.items()}

    def losses(self, params: Parameters, batches: Sequence[Any] | None = None):
        """The loss of every part and its weight."""
        batches = self.batches if batches is None else batches
        if not isinstance(self.loss, Parted):
            found = each_of(lambda batch: loss_of(self.loss, params, batch), batches)
            pairs = [(np.atleast_1d(value), np.atleast_1d(weight)) for weight, value in found]
        else:
            found = each_of(lambda batch: _parts(self.loss, params, batch), batches)
            pairs = [(np.asarray(v), _filled(np.asarray(w), whole)) for whole, (v, w) in found]
        values, weights = (
            np.concatenate(column).astype(np.float64) for column in zip(*pairs, strict=True)
        )
        return np.where(weights > 0, values, 0.0), weights

    def slope(self, at: NDArray[np.float64]) -> NDArray[np.float64]:
        """The gradient of every batch, (batches, numbers)."""
        raw = {name: leaf[None] for name, leaf in self.raw(at).items()}
        function = functools.partial(slopes, self.loss, self.forward, self.found, raw)
        found = each_of(lambda batch: function(batch)[1], self.batches)
        rows = [[np.asarray(s[name][0])[index] for name, index in self.places] for _, s in found]
        return np.array(rows, np.float64)

    def mean_slope(self, at: NDArray[np.float64]) -> NDArray[np.float64]:
        weights = [weight for weight, _ in each_of(lambda _: 0, self.batches)]
        return np.average(self.slope(at), axis=0, weights=weights)

    def slopes_of_parts(self) -> NDArray[np.float64]:
        """(parts, numbers)"""
        if not isinstance(self.loss, Parted):
            return self.slope(self.at)
        raw, columns = self.raw(self.at), []
        for name, index in self.places:
            way = {key: jnp.zeros_like(leaf) for key, leaf in raw.items()}
            way[name] = way[name].at[index].set(1.0)
            function = functools.partial(_along, self.loss, self.found, raw, way)
            found = each_of(lambda batch, function=function: function(batch), self.batches)
            columns.append(np.concatenate([np.asarray(part) for _, part in found]))
        table = np.stack(columns, 1).astype(np.float64)
        return np.where(self.weights[:, None] > 0, table, 0.0)

    def rises(self, values: NDArray[np.float64]) -> bool | None:
        """Whether the loss is larger than here by what an interval's end asks; None: no telling."""
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


def _filled(weights: NDArray, whole: float) -> NDArray:
    """Weights of parts, so that their sum is that of the batch."""
    return weights * (whole / max(float(weights.sum()), 1e-300))


def _physical(number: Number, raw: float) -> float:
    return float(number.physical(jnp.asarray(raw)))


def _scale(number: Number, value: float, start: float) -> float:
    """What a step of 1 is: a factor of e of what is stored as a logarithm, else all of it."""
    if isinstance(number, Positive | Share):
        return 1.0
    return max(abs(value), abs(start)) or 1.0


def _fitted(sample: _Sample, start: Parameters) -> list[Finding]:
    """Of all numbers that were fitted by gradient."""
    numbers = [sample.found.numbers[name] for name, _ in sample.places]
    begun = np.array([float(np.asarray(start.raw[name])[i]) for name, i in sample.places])
    scales = np.array(list(map(_scale, numbers, sample.at, begun)))
    widths, newton = _widths(sample, scales) if len(numbers) else (scales, scales)
    findings = []
    for k, ((name, index), number) in enumerate(zip(sample.places, numbers, strict=True)):
        settled = abs(newton[k]) <= max(widths[k], STEP)
        trusted = widths[k] < WIDE and settled
        if trusted:
            ends = [-widths[k], widths[k]]
        else:
            look = functools.partial(_moved, sample, k, scales[k])
            ends = [_end(sample, look, sign) for sign in (-1.0, 1.0)]
        low, high = (None if end is None else sample.at[k] + end * scales[k] for end in ends)
        remark = _remark(sample, k, (sample.at[k] - begun[k]) / scales[k], ends, scales[k])
        if not remark and not settled and np.isfinite(newton[k]):
            remark = UNSETTLED
        label = name if not index else f"{name}[{index[0] + 1}]"
        began, value = (_physical(number, raw) for raw in (begun[k], sample.at[k]))
        low, high = (None if raw is None else _physical(number, raw) for raw in (low, high))
        findings.append(Finding(label, number.unit, began, value, low, high, remark))
    return findings


def _widths(
    sample: _Sample, scales: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Half widths by curvature and steps to the least loss, in scales; infinite: not told."""
    p = len(scales)
    rows = []
    for k in range(p):
        step = np.zeros(p)
        step[k] = STEP * scales[k]
        rows.append(sample.mean_slope(sample.at + step) - sample.mean_slope(sample.at - step))
    H = np.array(rows) * scales / (2 * STEP)
    H = (H + H.T) / 2
    widths, newton = np.full(p, np.inf), np.full(p, np.inf)
    kept = [k for k in range(p) if np.isfinite(H[k]).all()]
    while kept:
        size, ways = np.linalg.eigh(H[np.ix_(kept, kept)])
        if size[0] > 1e-7 * abs(size[-1]):
            break
        kept.pop(int(np.argmax(np.abs(ways[:, 0]))))
    if not kept:
        return widths, newton
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
        return widths, newton
    widths[kept] = sample.quantile * np.sqrt(np.diag(covariance))
    return widths, newton


def _moved(sample: _Sample, k: int, scale: float, step: float) -> NDArray[np.float64] | None:
    """The losses of all parts where a number is moved by a step; None: outside its bounds."""
    at = sample.at.copy()
    at[k] += step * scale
    params = sample.found.with_raw(sample.raw(at))
    name, _ = sample.places[k]
    if not bool(params.numbers[name].allows(getattr(params, name))):
        return None
    return sample.losses(params)[0]


def _end(
    sample: _Sample, look: Callable[[float], NDArray[np.float64] | None], sign: float
) -> float | None:
    """How far off the loss has risen enough; None: not found; NaN: no telling."""
    inside, step = 0.0, FIRST
    for _ in range(DOUBLINGS + 1):
        values = look(sign * step)
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
    for _ in range(HALVINGS):
        middle = (inside + step) / 2
        values = look(sign * middle)
        if values is None or sample.rises(values):
            step = middle
        else:
            inside = middle
    return sign * step


def _remark(
    sample: _Sample, k: int, moved: float, ends: Sequence[float | None], scale: float
) -> str:
    """What is to be said of a number that moved so far, in scales."""
    number = sample.found.numbers[sample.places[k][0]]
    for bound in (number.least, number.most):
        if abs(bound) >= LARGEST or (bound == 0 and isinstance(number, Positive)):
            continue
        away = (float(number.unconstrained(jnp.asarray(bound))) - sample.at[k]) / scale
        if abs(away) < NEAR:
            values = _moved(sample, k, scale, away * (1 - 1e-3))
            if values is not None and sample.shares @ (values - sample.values) <= 0:
                return AT_BOUND.format(bound)
    low, high = ends
    if abs(moved) > AWAY and (high if moved > 0 else low) is None:
        return RAN_AWAY
    return UNKNOWN if low is None and high is None else ""


def _searched(
    loss: Any,
    start: Parameters,
    found: Parameters,
    name: str,
    interval: Interval,
    prepared: Callable[[Any], Batches],
) -> Finding:
    """Of a number that was searched, which prepares every batch anew."""
    low, high, count = interval
    value, scale = float(getattr(found, name)), (high - low) / (count - 1)
    number = found.numbers[name]

    def look(step: float) -> NDArray[np.float64] | None:
        place = value + step * scale
        if not low <= place <= high:
            return None
        stored = number.unconstrained(jnp.asarray(place, found.raw[name].dtype))
        params = found.with_raw({name: stored})
        return sample.losses(params, prepared(params)[0])[0]

    sample = _Sample(loss, found, (), None, prepared(found)[0])
    ends = [_end(sample, look, sign) for sign in (-1.0, 1.0)]
    below, above = (None if end is None else value + end * scale for end in ends)
    remark = ""
    for bound in (low, high):
        if abs(value - bound) < 1e-3 * scale:
            remark = AT_END.format(bound)
    if not remark and ends == [None, None]:
        remark = UNKNOWN
    began = float(getattr(start, name))
    return Finding(name, number.unit, began, value, below, above, remark)
