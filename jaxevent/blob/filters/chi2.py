"""The paper's extended Kalman filter: 0 = L^-1 e + N(0, I), and a window's sum of |L^-1 e|^2.

`chi2` is eq. 11-23: the one sum is driven to 2 n (`target`) with the variance 4 n. `chi2_split` has
one sum per axis, driven to n, with the variance 2 n n, as each residual counts n times; the
pseudo-measurement L^-1 e then does not act on the sizes, so they are unbiased and positive. Of M
events per step the mean of L^-1 e has the covariance I / m, and the window's slots hold the step's
sums; n counts steps.

While the window fills, and while the position's variance exceeds a quarter of the smaller size
squared (beta would not hold), the shape stays.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from jaxevent.blob.filter import EventBatch, Filter, PredictedMeasurement, where_tree
from jaxevent.blob.filters.motion import (
    ellipse_covariance,
    gated_moments,
    transition,
    turn_transition,
)
from jaxevent.blob.params import TrackerParams
from jaxevent.blob.track import wrap_angle
from jaxevent.blob.tracker import Tracker
from jaxevent.parameters import Choice, Count, Positive
from jaxevent.precision import full_precision

MAX_POSITION_VARIANCE_PX2 = 1e6  # px^2; in single precision a longer pause would leave nothing of R


class WindowParams(TrackerParams):
    """Parameters of `chi2_split`."""

    n: Count = Count(10, "", "steps in the window of squared residuals")
    beta: Positive = Positive(
        0.01, "", "ratio of the position's variance to that of the events, in the window"
    )


class Params(WindowParams):
    """Parameters of `chi2`."""

    target: Choice = Choice(
        ("2n+4", "2n"),
        "expected sum of the window; 2n biases sizes by sqrt((n+1)/(n-1))",
    )
    current_in_jacobian: Choice = Choice(
        (False, True), "whether the newest event's residual acts on p and theta through the window"
    )
    formulation: Choice = Choice(
        ("corrected", "authors"),
        "authors: leaves the newest event out of the window, has no guards, and has lambda in "
        "the state, not its logarithm",
    )

    presets = {
        **TrackerParams.presets,
        # As printed, but for the errors that docs/theory/tracking.md lists. Of the gate the paper
        # gives no numbers; its shape and that it follows the size are the paper's.
        "paper": {
            "target": "2n", "current_in_jacobian": True, "association": "nearest",
            "gate_shape": "circle", "gate_position": 0.0,
        },
        # Published settings of the authors' program, for cars.
        "authors": {
            "formulation": "authors", "association": "authors", "target": "2n", "beta": 0.0,
            "polarity_offset": True,
            "Q_p": 200.0, "Q_v": 1e3, "Q_lambda": 1.0, "Q_theta": 0.005, "Q_q": 0.01,
            "P0_p": 10.0, "P0_v": 500.0, "P0_lambda": 5.0, "P0_theta": 0.5, "P0_q": 2.0,
            "lambda0": 30.0, "gate_shape": "circle", "gate": 2.5, "gate_decay": 1.4,
            "gate_min": 10.0, "gate_max": 1e6, "t_coast": 1e3,
        },
    }  # fmt: skip


class ResidualWindow(eqx.Module):
    """Squared residuals of the last n steps, along the axes that the blob had then.

    A row of `ring` holds a step's sums of w u1^2, w u2^2 and w over its events; as u is the
    residual of the state predicted for the step, |L^-1 e|^2 with any later sizes is u1^2 /
    lambda1^2 + u2^2 / lambda2^2. `sums` is that of the ring; `fresh` collects what came since slot
    0 and replaces it once per turn, so that rounding does not add up.
    """

    ring: Float[Array, "n 3"]
    sums: Float[Array, " 3"]
    fresh: Float[Array, " 3"]
    slot: Int[Array, ""]
    filled: Int[Array, ""]

    @classmethod
    def empty(cls, n: int, dtype: Any) -> "ResidualWindow":
        three, zero = jnp.zeros(3, dtype), jnp.zeros((), jnp.int32)
        return cls(jnp.zeros((n, 3), dtype), three, three, zero, zero)

    def push(self, new: Float[Array, " 3"]) -> "ResidualWindow":
        n = len(self.ring)
        here = (jnp.arange(n) == self.slot)[:, None]
        old = jnp.where(here, self.ring, 0).sum(0)
        fresh = self.fresh + new
        last = self.slot == n - 1
        return ResidualWindow(
            jnp.where(here, new, self.ring),
            jnp.where(last, fresh, jnp.maximum(self.sums + (new - old), new)),
            jnp.where(last, 0, fresh),
            jnp.where(last, 0, self.slot + 1),
            jnp.minimum(self.filled + 1, n),
        )


class Chi2State(eqx.Module):
    """Joint state and window of residuals.

    Attributes:
        x: px py vx vy lambda1 lambda2 theta q [dx dy], in px, s and rad; lambda or its logarithm.
        P: Covariance of `x`.
        window: Squared residuals.
        logarithmic: Whether `x` holds log lambda.
    """

    x: Float[Array, " d"]
    P: Float[Array, "d d"]
    window: ResidualWindow
    logarithmic: bool = eqx.field(static=True)

    @property
    def size(self) -> Array:
        """(2,), px."""
        return jnp.exp(self.x[4:6]) if self.logarithmic else self.x[4:6]


def _init(params: WindowParams, position: Array, size: Array, logarithmic: bool) -> Chi2State:
    """Return the state of a round blob at rest.

    Args:
        params: Parameters.
        position: (2,) centre, px.
        size: () size, px.
        logarithmic: Whether the state holds log sizes.

    Returns:
        The state.
    """
    none = jnp.zeros_like(position)
    P_size = params.P0_lambda / params.lambda0**2 if logarithmic else params.P0_lambda
    blocks = [position, none, (jnp.log(size) if logarithmic else size) + none, none]
    P = [params.P0_p, params.P0_p, params.P0_v, params.P0_v, P_size, P_size]
    P += [params.P0_theta, params.P0_q] + [params.P0_d] * 2 * params.polarity_offset
    return Chi2State(
        jnp.concatenate(blocks + [none] * params.polarity_offset),
        jnp.diag(jnp.stack(P)).astype(position.dtype),
        ResidualWindow.empty(params.n, position.dtype),
        logarithmic,
    )


def _predict(params: WindowParams, state: Chi2State, dt: Array, authors: bool) -> Chi2State:
    """Predict a state without events.

    Args:
        params: Parameters.
        state: The state.
        dt: () time to predict ahead, s.
        authors: Whether process noise is the authors', which enters each component alone.

    Returns:
        The state then.
    """
    x, P = state.x, state.P
    to_theta, to_q, tt, tq, qq = turn_transition(params, dt)
    pp, pv, vv = params.Q_p * dt, params.Q_v * dt**2 / 2, params.Q_v * dt
    if authors:
        tt, tq, pv = params.Q_theta * dt, 0 * dt, 0 * dt
    else:
        pp = pp + params.Q_v * dt**3 / 3
    Q_size = params.Q_lambda * dt * jnp.ones(2)
    if state.logarithmic:
        Q_size = Q_size * jnp.exp(-2 * x[4:6])

    def propagate(rows: Array) -> Array:
        p, v, size, theta, q, rest = jnp.split(rows, [2, 4, 6, 7, 8])
        return jnp.concatenate([p + dt * v, v, size, theta + to_theta * q, to_q * q, rest])

    P = propagate(propagate(P).T)
    own = [pp, pp, vv, vv, Q_size[0], Q_size[1], tt, qq]
    Q = jnp.diag(jnp.stack(own + [params.Q_d * dt] * (len(x) - 8)))
    for i, j, covariance in ((0, 2, pv), (1, 3, pv), (6, 7, tq)):
        pair = np.zeros((len(x), len(x)))
        pair[i, j] = pair[j, i] = 1
        Q = Q + jnp.asarray(pair, P.dtype) * covariance
    return dataclasses.replace(state, x=propagate(x), P=P + Q)


class _Residuals(NamedTuple):
    """Residuals of a step's events along the blob's axes.

    Attributes:
        m: Total weight of the step.
        age: Mean age of the events, s.
        sign: Mean polarity.
        cos: Cosine of the blob's angle.
        sin: Sine of the blob's angle.
        size: (2,) sizes, px.
        mean: (2,) mean residuals, px.
        energy: (2,) sums of squares, px^2.
    """

    m: Array
    age: Array
    sign: Array
    cos: Array
    sin: Array
    size: Array
    mean: Array
    energy: Array


class _Measurement(NamedTuple):
    """Scalar measurement of the joint state.

    Attributes:
        row: (d,) row of the Jacobian.
        innovation: Innovation.
        noise: Variance of the noise, in the square of the innovation's unit.
        weight: Weight of the measurement; 0: it has no effect.
    """

    row: Array
    innovation: Array
    noise: Array
    weight: Array


class _WindowStep(NamedTuple):
    """Residuals of a step and the window of those before.

    Attributes:
        residuals: Residuals of the step.
        trusted: Whether the position is certain enough for the shape.
        shape: 1 where the shape is updated, else 0.
        past: (2,) sums of squares without this step, px^2.
        W: Weight of the window.
        filled: Number of steps in the window.
    """

    residuals: _Residuals
    trusted: Array
    shape: Array
    past: Array
    W: Array
    filled: Array


def _rotate_residuals(
    params: WindowParams, state: Chi2State, batch: EventBatch, weight: Array
) -> _Residuals:
    """Rotate the residuals of a step's events to the blob's axes.

    Args:
        params: Parameters.
        state: State at the step's time.
        batch: The M events.
        weight: (M,) their weights, 0 to 1.

    Returns:
        Their mean and their sums of squares.
    """
    x = state.x
    m = weight.sum()
    share = weight / jnp.where(m > 0, m, 1)
    age = (share * batch.age).sum()
    sign = jnp.sign(batch.polarity)
    e = batch.xi - x[:2] + x[2:4] * batch.age[:, None]
    if params.polarity_offset:
        e = e - sign[:, None] * x[8:]
    e = jnp.where(weight[:, None] > 0, e, 0)
    theta = x[6] - age * x[7]
    cos, sin = jnp.cos(theta), jnp.sin(theta)
    u = jnp.stack([cos * e[:, 0] + sin * e[:, 1], cos * e[:, 1] - sin * e[:, 0]])
    mean, energy = (share * u).sum(1), (weight * u**2).sum(1)
    return _Residuals(m, age, (share * sign).sum(), cos, sin, state.size, mean, energy)


def _limit_variances(params: WindowParams, state: Chi2State) -> tuple[Array, Array]:
    """Limit variances in P; return too whether the position is certain enough for the shape."""
    P = state.P
    limits = {0: MAX_POSITION_VARIANCE_PX2, 1: MAX_POSITION_VARIANCE_PX2, 6: params.P_theta_max}
    if state.logarithmic:
        limits |= {4: 1.0, 5: 1.0}
    keep = [jnp.ones((), P.dtype)] * len(state.x)
    for i, limit in limits.items():
        keep[i] = limit / jnp.maximum(jnp.maximum(P[i, i], limit), 1e-30)
    keep = jnp.stack(keep)
    # Covariances shrink as much as variances: the gain of a velocity does not change.
    P = P * keep[:, None] * keep + jnp.diag((keep - keep**2) * jnp.diagonal(P))
    a, b, c = lax.stop_gradient((P[0, 0], P[0, 1], P[1, 1]))
    radius = (a + c) / 2 + jnp.hypot((a - c) / 2, b)
    return P, radius <= 0.25 * state.size.min() ** 2


def _measure_mean(
    params: WindowParams,
    state: Chi2State,
    residuals: _Residuals,
    trusted: Array,
    on_size: Array | None,
) -> list[_Measurement]:
    """Return the measurements 0 = L^-1 e + N(0, I / m) along both axes.

    Args:
        params: Parameters.
        state: Predicted state.
        residuals: Residuals of the step.
        trusted: Whether the position is certain enough for the orientation to be measured.
        on_size: Factor of the derivative by lambda; None: the mean does not act on the sizes.

    Returns:
        One measurement for each axis.
    """
    unit = jnp.eye(len(state.x), dtype=state.P.dtype)
    size, mean = residuals.size, residuals.mean
    over = 1 / size
    turning = (over[0] - over[1]) * (unit[6] - residuals.age * unit[7]) * trusted
    found = []
    for i, (a, b) in enumerate(((residuals.cos, residuals.sin), (-residuals.sin, residuals.cos))):
        along = a * (unit[0] - residuals.age * unit[2]) + b * (unit[1] - residuals.age * unit[3])
        if params.polarity_offset:
            along = along + residuals.sign * (a * unit[8] + b * unit[9])
        row = -over[i] * along + turning * mean[1 - i]
        if on_size is not None:
            per = _size_derivative(state)
            row = row - on_size * over[i] ** 2 * mean[i] * per[i] * unit[4 + i]
        found.append(_Measurement(row, -mean[i] * over[i], jnp.ones(()), residuals.m))
    return found


def _size_derivative(state: Chi2State) -> Array:
    """Return the derivative of lambda by its component of the state, (2,)."""
    return state.size if state.logarithmic else jnp.ones_like(state.size)


@full_precision
def _update_scalars(x: Array, P: Array, measurements: list[_Measurement]) -> tuple[Array, Array]:
    """Update by one scalar after the other, all at the predicted state: equal to a joint update.

    Args:
        x: (d,) predicted state.
        P: (d, d) its covariance.
        measurements: Scalar measurements with independent noise.

    Returns:
        The state and its covariance.
    """
    # Rounding may take a variance that falls a millionfold below 0; the last term is as large.
    step, rounding = jnp.zeros_like(x), 4 * jnp.finfo(P.dtype).eps * jnp.diagonal(P)
    for row, innovation, noise, weight in measurements:
        B = P @ row
        gain = weight * B / (weight * jnp.maximum(row @ B, 0) + noise)
        step = step + gain * (innovation - row @ step)
        P = P - gain[:, None] * B
    # What rounding makes P and its transpose differ by would grow, at one pixel to 1.9 standard
    # deviations squared in 9,000 events.
    return x + step, (P + P.T) / 2 + jnp.diag(rounding)


def _clip_state(params: WindowParams, x: Array) -> Array:
    """Clip log sizes to their limits, and wrap the angle to [-pi, pi].

    Args:
        params: Parameters.
        x: (d,) state with log sizes.

    Returns:
        (d,).
    """
    low, high = jnp.log(params.lambda_min), jnp.log(params.lambda_max)
    return jnp.concatenate([x[:4], jnp.clip(x[4:6], low, high), wrap_angle(x[6])[None], x[7:]])


def _update(
    params: Any,
    state: Chi2State,
    batch: EventBatch,
    weight: Array,
    measure: Callable[[Any, Chi2State, _WindowStep], list[_Measurement]],
) -> Chi2State:
    """Update by a step's mean residual and by the window's sums of squares.

    Args:
        params: Parameters.
        state: Predicted state.
        batch: The M events of the step.
        weight: (M,) weights of the events, 0 to 1.
        measure: Function that makes measurements of the predicted state and the window.

    Returns:
        The state after the step.
    """
    authors = not state.logarithmic
    residuals = _rotate_residuals(params, state, batch, weight)
    P, trusted = (state.P, jnp.bool(True)) if authors else _limit_variances(params, state)
    push = jnp.concatenate([residuals.energy, residuals.m[None]])
    window = state.window.push(push)
    shape = (trusted & ((window.filled >= params.n) | authors)).astype(P.dtype)
    W = jnp.where(residuals.m > 0, window.sums[2], 1)
    step = _WindowStep(residuals, trusted, shape, (window.sums - push)[:2], W, window.filled)
    x, P = _update_scalars(state.x, P, measure(params, state, step))
    if not authors:
        x = _clip_state(params, x)
    window = where_tree(trusted, window, state.window)
    return where_tree(residuals.m > 0, Chi2State(x, P, window, state.logarithmic), state)


# ---- chi2: one sum.


def init(params: Params, position: Array, size: Array) -> Chi2State:
    return _init(params, position, size, params.formulation == "corrected")


def predict(params: Params, state: Chi2State, dt: Array) -> Chi2State:
    return _predict(params, state, dt, params.formulation == "authors")


def update(params: Params, state: Chi2State, batch: EventBatch, weight: Array) -> Chi2State:
    return _update(params, state, batch, weight, _measure_sum)


def _measure_sum(params: Params, state: Chi2State, step: _WindowStep) -> list[_Measurement]:
    """Return the measurements of the mean and of the window's one sum."""
    authors, residuals = params.formulation == "authors", step.residuals
    measurements = _measure_mean(params, state, residuals, step.trusted, step.shape)
    unit = jnp.eye(len(state.x), dtype=state.P.dtype)
    over = 1 / residuals.size
    scale = 1.0 if authors else 1 / (1 + params.beta)
    inside = step.past * scale + (0 if authors else residuals.energy)
    found = (inside * over**2).sum()
    pull = -2 * inside * over**3 * _size_derivative(state)
    row = pull[0] * unit[4] + pull[1] * unit[5]
    if params.current_in_jacobian and not authors:
        for i in range(2):
            other = measurements[i].row * (1 - unit[4] - unit[5])
            row = row + 2 * residuals.m * residuals.mean[i] * over[i] * other
    goal = 2 * step.W + (4 if params.target == "2n+4" else 0)
    on = jnp.where(step.filled > 1, 1.0, 0.0) if authors else step.shape
    return [*measurements, _Measurement(row, goal - found, 4 * step.W, on)]


def predicted_measurement(params: WindowParams, state: Chi2State) -> PredictedMeasurement:
    x, size = state.x, state.size
    return PredictedMeasurement(
        x[:2], x[2:4], ellipse_covariance(x[6], size), state.P[:2, :2], size
    )


def zero_velocity(params: WindowParams, state: Chi2State, known: bool) -> Chi2State:
    moving = np.zeros(len(state.x))
    moving[[2, 3, 7]] = 1  # velocity and turn rate
    keep = jnp.asarray(1 - moving, state.x.dtype)
    P = state.P * keep[:, None] * keep
    if not known:
        start = jnp.stack([params.P0_v, params.P0_v, params.P0_q])
        P = P + jnp.zeros_like(P).at[(2, 3, 7), (2, 3, 7)].set(start)
    return dataclasses.replace(state, x=keep * state.x, P=P)


def readout(params: WindowParams, state: Chi2State) -> tuple[Array, Array]:
    x, P = state.x[:8], state.P[:8, :8]
    if state.logarithmic:
        size = state.size
        x = jnp.concatenate([x[:4], size, x[6:]])
        per = jnp.concatenate([jnp.ones(4, P.dtype), size, jnp.ones(2, P.dtype)])
        P = P * per[:, None] * per
    return x, P


# ---- chi2_split: one sum per axis.


def _measure_axes(params: WindowParams, state: Chi2State, step: _WindowStep) -> list[_Measurement]:
    """Return the measurements of the mean and of the window's sums along both axes."""
    residuals = step.residuals
    measurements = _measure_mean(params, state, residuals, step.trusted, None)
    unit = jnp.eye(len(state.x), dtype=state.P.dtype)
    over = 1 / residuals.size
    scale = 1 / (1 + params.beta)
    kappa, fourth = gated_moments(params)
    variance = 3 * fourth / kappa**2 - 1
    for i in range(2):
        found = (residuals.energy[i] + scale * step.past[i]) * over[i] ** 2 / kappa
        row = -kappa * variance * step.W * unit[4 + i]
        noise = variance * step.W * params.n
        measurements.append(_Measurement(row, step.W - found, noise, step.shape))
    return measurements


chi2 = Tracker(
    "chi2",
    Params,
    Filter(init, predict, update, predicted_measurement, readout, zero_velocity, transition),
    about="The asynchronous event-blob tracker (Wang et al. 2023), equations corrected.",
)
chi2_split = Tracker(
    "chi2_split",
    WindowParams,
    Filter(
        functools.partial(_init, logarithmic=True),
        functools.partial(_predict, authors=False),
        functools.partial(_update, measure=_measure_axes),
        predicted_measurement,
        readout,
        zero_velocity,
        transition,
    ),
    about="The asynchronous event-blob tracker with one sum of squares per axis of the blob.",
)
