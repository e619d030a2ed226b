"""The likelihood of frames given events, by which clock, thresholds and noises are estimated.

From a frame to the next the log intensity of a pixel changes by

    d = c_on n_on(delta, T, rho) - c_off n_off(delta, T, rho) + e,

where counts n are interpolated between events (`brightness`), each averaged over the exposure T at
the clock offset delta, with the dead time rho. So counts are known to a fraction of an event, and
errors stand on d alone, but for noise of events. Their variance is a sum of that of both frames,
sigma^2 (dI/dg)^2 / (I + I0)^2, of the interpolation, a part of c^2 that grows with the time between
the events around a frame, and of the events, a part of c^2 each. Errors are Student's t.

Only those pixels and pairs of frames count at which the events around both frames are near in time
and of equal polarity: there the intensity is on its way, and interpolation is right on average. The
choice depends neither on the change nor on the number of events, and so does not bias thresholds.
"""

import copy
import dataclasses
import functools
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.calibration.brightness import (
    Interpolation,
    Positions,
    interpolate,
    read_positions,
    sort_by_pixel,
)
from jaxevent.calibration.sampling import Sample, SampledSegment

DEGREES_OF_FREEDOM = 4.0  # of Student's t
# Curvature of the likelihood by the mean, as part of the mean of weights.
CURVATURE = (DEGREES_OF_FREEDOM + 1) / (DEGREES_OF_FREEDOM + 3)
SHORTEST_US = 50.0  # exposure, below which it is a point in time
_LEAST_SQUARE_S2 = (1e-6 * SHORTEST_US) ** 2
# Of the time between frames: means of several frames are exposed for longer than that.
MAX_EXPOSURE_INTERVALS = 2.0
MAX_RELATIVE_NOISE = 0.15  # of a frame's I + I0, beyond which logarithms of noise are biased
MIN_CHANGES = 60
MAX_CHANGES = 60_000
GAUSSIAN_SCALE = 1.15  # standard deviation of Gaussian errors, per scale of Student's t
MAX_FIT_STEPS = 12  # Gauss-Newton steps
TRUST = np.array([np.inf, np.inf, 2e-3, 5e-4, np.inf])  # largest steps of the last three
PRECISION = np.array([1e-5, 1e-5, 1e-6, 1e-6, 1e-6])


@dataclasses.dataclass(frozen=True)
class Physics:
    """Parameters of the model.

    Attributes:
        theta: c_on, c_off, clock offset (s), dead time (s), square of the exposure (s^2).
        V: Variances: of a frame's grey value, of interpolation and of an event, in c^2.
    """

    theta: NDArray[np.float64]
    V: NDArray[np.float64]


class Changes(NamedTuple):
    """Pixels at two consecutive frames, with the change that events report."""

    intensity: NDArray[np.float32]  # (2, n) of both frames
    slope: NDArray[np.float64]  # (2, n) of intensity by the grey value
    n: NDArray[np.float64]  # (4, n) differences of mean counts
    by_clock: NDArray[np.float64]  # (2, n) derivatives, 1/s
    by_square: NDArray[np.float64]  # (2, n) derivatives by the exposure's square, 1/s^2
    travel: NDArray[np.float64]  # (2, 2, n) ON and OFF counts within both exposures
    loose: NDArray[np.float64]  # (n,) 0 to 2, see `Positions.spread`
    loose_by_square: NDArray[np.float64]  # (n,) derivative by the exposure's square, 1/s^2
    sum_by_square: NDArray[np.float64]  # (n,) the same of errors that add up
    gap: NDArray[np.float64]  # (n,) that time's mean of both frames, s
    tile: NDArray[np.intp]  # (n,)
    interval: NDArray[np.intp]  # (n,) number of the pair of frames
    segment: NDArray[np.intp]  # (n,)
    pixel: NDArray[np.intp]  # (n,)


class Terms(NamedTuple):
    """Terms of the likelihood at some parameters."""

    residual: NDArray[np.float64]  # (n,) ln I
    J: NDArray[np.float64]  # (n, 5) derivatives of the predicted change by theta
    X: NDArray[np.float64]  # (3, n) factors of the three variances
    X_by_square: NDArray[np.float64]  # (2, n) derivatives of the last two by exposure's square
    log_slope: NDArray[np.float64]  # (n,) mean ln(I + I0) of both frames


class Fit(NamedTuple):
    """Parameters that were fitted."""

    physics: Physics
    covariance: NDArray[np.float64]  # (5, 5), 0 where held
    losses: NDArray[np.float64]  # (n,) negative log likelihood of each change
    changes: Changes
    terms: Terms
    weight: NDArray[np.float64]  # (n,)


def make_terms(changes: Changes, theta: NDArray[np.float64], I0: float, noise: float) -> Terms:
    """Return the terms of the likelihood.

    Args:
        changes: The changes.
        theta: Parameters, as of `Physics`.
        I0: Offset inside the logarithm.
        noise: Standard deviation of grey values, for the mean of the logarithm.

    Returns:
        The terms.
    """
    c = np.array([theta[0], -theta[1]])
    n = changes.n
    by_clock = c @ changes.by_clock
    by_rho = c @ n[2:] - by_clock / 2
    J = np.stack([n[0], -n[1], by_clock, by_rho, c @ changes.by_square], 1)
    level = np.maximum(changes.intensity, 0).astype(np.float64) + I0
    relative = changes.slope / level
    # E ln(I + n) = ln I - var n / (2 I^2) for noise n.
    logs = np.log(level) + (noise * relative) ** 2 / 2
    # Of a straight path ln mean exp is the mean plus half of the variance.
    bend = (c @ changes.travel) ** 2 / 24
    residual = logs[1] - logs[0] - (bend[1] - bend[0]) - J[:, :2] @ theta[:2]
    of_events = theta[0] ** 2 * abs(n[0]) + theta[1] ** 2 * abs(n[1])
    X = np.stack([(relative**2).sum(0), theta[0] * theta[1] * changes.loose, of_events])
    X_by_square = np.stack([changes.loose_by_square, changes.sum_by_square]) * theta[0] * theta[1]
    return Terms(residual, J, X, X_by_square, np.log(level).mean(0))


class Model:
    """The likelihood of a sample.

    Args:
        sample: The sample.
        I0: Offset inside the logarithm.
        grey_noise: Standard deviation of grey values, for the choice of pixels.
        slope: (2, entries) grey values, and dI/dg there.
    """

    def __init__(self, sample: Sample, I0: float, grey_noise: float, slope: NDArray[np.float64]):
        self.sample, self.I0, self.grey_noise, self.slope = sample, I0, grey_noise, slope
        self._rho: float | None = None
        self._paths: list[Interpolation] = []
        self._events = [sort_by_pixel(segment, segment.clear) for segment in sample.segments]
        self._choose_clear()

    def _choose_clear(self) -> None:
        """Choose the pixels at whose brightness noise changes the logarithm little."""
        for row, segment in enumerate(self.sample.segments):
            active = self._events[row].active
            level = np.maximum(segment.intensity[:, active], 0) + self.I0
            noise = self.grey_noise * np.interp(segment.grey[:, active], *self.slope)
            clear = segment.clear[:, active] & (noise < MAX_RELATIVE_NOISE * level)
            self._events[row] = self._events[row]._replace(clear=np.ascontiguousarray(clear.T))

    def with_offset(self, I0: float) -> "Model":
        """Return the likelihood with another offset inside the logarithm."""
        other = copy.copy(self)
        other.I0, other._events = I0, list(self._events)
        other._choose_clear()
        return other

    def thinned(self, most: int) -> "Model":
        """Return the likelihood of at most about `most` pixels of each segment, evenly chosen."""
        other = copy.copy(self)
        other._rho = None
        other._events = [
            events.take_every(-(-len(events.active) // most)) for events in self._events
        ]
        return other

    @functools.cached_property
    def interval_s(self) -> float:
        """Median time between frames, s."""
        steps = [np.diff(s.frame_t) for s in self.sample.segments]
        return float(np.median(np.concatenate(steps))) * 1e-6

    def _lengths(self, segment: SampledSegment, theta: NDArray) -> NDArray[np.float64]:
        """Return the lengths of exposures.

        Args:
            segment: A segment of frames.
            theta: (5,) parameters, as of `Physics`; the last one stands for unknown lengths.

        Returns:
            (frames,) us, at least `SHORTEST_US`.
        """
        unknown = 1e6 * np.sqrt(max(theta[4], 0))
        return np.maximum(np.where(segment.exposure > 0, segment.exposure, unknown), SHORTEST_US)

    def _positions(self, theta: NDArray[np.float64]) -> list[Positions]:
        if self._rho != theta[3]:
            self._paths = [interpolate(events, 1e6 * theta[3]) for events in self._events]
            self._rho = theta[3]
        return [
            read_positions(
                events,
                path,
                (segment.frame_t - path.origin) + 1e6 * theta[2],
                self._lengths(segment, theta),
                self.interval_s,
            )
            for segment, events, path in zip(
                self.sample.segments, self._events, self._paths, strict=True
            )
        ]

    def changes(self, theta: NDArray[np.float64]) -> Changes:
        """Return the changes that count at some parameters."""
        parts, interval = [], 0
        for number, (segment, events, at) in enumerate(
            zip(self.sample.segments, self._events, self._positions(theta), strict=True)
        ):
            row, pair = np.nonzero(at.good[:, 1:] & at.good[:, :-1])
            length = 1e-6 * self._lengths(segment, theta)
            pixel, ends = events.active[row], (pair, pair + 1)
            mean, edges, travel = (
                [values[row, f].astype(np.float64).T for f in ends]
                for values in (at.mean, at.edges, at.travel)
            )
            slope = [v[:2] / length[f] for v, f in zip(travel, ends, strict=True)]
            square = [
                (e - m)[:2] / (2 * length[f] ** 2)
                for e, m, f in zip(edges, mean, ends, strict=True)
            ]
            # The longer the time between events, the larger are errors of the interpolation. Of an
            # instant two thirds remain on average.
            loose = [1.5 / (1 + self.interval_s / 4 / at.gap[row, f]) for f in ends]
            spread = [at.spread[row, f].astype(np.float64).T for f in ends]
            parts.append(
                Changes(
                    np.stack([segment.intensity[f, pixel] for f in ends]),
                    np.stack([np.interp(segment.grey[f, pixel], *self.slope) for f in ends]),
                    mean[1] - mean[0],
                    slope[1] - slope[0],
                    square[1] - square[0],
                    np.stack([v[:2] for v in travel]),
                    sum(a * s[0] for a, s in zip(loose, spread, strict=True)),
                    sum(
                        a * s[1] / length[f] ** 2
                        for a, s, f in zip(loose, spread, ends, strict=True)
                    ),
                    spread[0][3] / length[pair] ** 2 + spread[1][2] / length[pair + 1] ** 2,
                    (at.gap[row, pair] + at.gap[row, pair + 1]).astype(np.float64) / 2,
                    self.sample.tile[pixel],
                    pair + interval,
                    np.full(len(pair), number),
                    pixel,
                )
            )
            interval += len(segment.frame_t)
        columns: list[Any] = [np.concatenate(one, -1) for one in zip(*parts, strict=True)]
        joined = Changes(*columns)
        if len(joined.n[0]) > MAX_CHANGES:
            keep = np.sort(np.random.default_rng(0).permutation(len(joined.n[0]))[:MAX_CHANGES])
            joined = Changes(*[values[..., keep] for values in columns])
        return joined

    def fit(self, start: Physics, free: tuple[bool, ...], steps: int = MAX_FIT_STEPS) -> Fit | None:
        """Maximise the likelihood by Gauss-Newton steps.

        Args:
            start: First parameters.
            free: Which of the five of `theta` move.
            steps: Largest number of steps.

        Returns:
            The fit; None where fewer than `MIN_CHANGES` changes count.
        """
        physics, moves = start, np.flatnonzero(free)
        for step in range(steps + 1):
            if step == 0 or moves[-1] > 1:  # thresholds alone move no event
                changes = self.changes(physics.theta)
            if len(changes.loose) < MIN_CHANGES:
                return None
            fit, move = self.step(physics, changes, moves)
            if step == steps or (step > 2 and np.all(np.abs(move) < PRECISION)):
                break
            theta = self._bounded(physics.theta, np.clip(move, -TRUST, TRUST))
            physics = Physics(theta, fit.physics.V)
        covariance = np.zeros((5, 5))
        part = sandwich(fit.terms.J[:, moves], fit.weight, fit.terms.residual, changes)
        covariance[np.ix_(moves, moves)] = part
        return fit._replace(covariance=covariance)

    def step(
        self, physics: Physics, changes: Changes, moves: NDArray[np.intp], I0: float | None = None
    ) -> tuple[Fit, NDArray[np.float64]]:
        """Return the likelihood of changes with its best variances, and a Gauss-Newton step.

        Args:
            physics: Parameters.
            changes: The changes.
            moves: Which of `theta` move.
            I0: Offset inside the logarithm; None: the model's.

        Returns:
            The likelihood, without covariance, and the step (5,).
        """
        noise = GAUSSIAN_SCALE * np.sqrt(physics.V[0])
        terms = make_terms(changes, physics.theta, I0 or self.I0, noise)
        V, weight = reweight(physics.V, terms)
        J = terms.J[:, moves]
        A = (J * weight[:, None]).T @ J
        # A little damping keeps what the data do not determine where it is.
        H = A + np.diag(1e-6 * np.diag(A) + 1e-12)
        # A longer exposure averages errors of events away, so that residuals fall without being
        # nearer to the truth. What they fall by is taken from the gradient.
        gradient = terms.J.T @ (weight * terms.residual)
        gradient[4] += ((V[1:] @ terms.X_by_square) / (V @ terms.X)).sum() / 2
        move = np.zeros(5)
        move[moves] = np.linalg.solve(H, gradient[moves])
        if move[4] < 0 and physics.theta[4] <= _LEAST_SQUARE_S2:
            move[4], inner = 0, moves[moves != 4]
            move[inner] = np.linalg.solve(H[moves != 4][:, moves != 4], gradient[inner])
        losses = losses_of(terms.residual, V @ terms.X)
        new = Physics(physics.theta, V)
        return Fit(new, np.zeros((5, 5)), losses, changes, terms, weight), move

    def _bounded(self, theta: NDArray, move: NDArray) -> NDArray[np.float64]:
        """Return parameters after a move, within their bounds.

        Args:
            theta: (5,) parameters, as of `Physics`.
            move: (5,) change of them.

        Returns:
            (5,) new parameters.
        """
        new = theta + move
        new[:2] = np.clip(new[:2], theta[:2] / 2, theta[:2] * 2)
        new[3] = np.clip(new[3], 0, self.interval_s / 4)
        longest = MAX_EXPOSURE_INTERVALS * self.interval_s
        new[4] = np.clip(new[4], _LEAST_SQUARE_S2, longest**2)
        return new


def losses_of(residual: NDArray, variance: NDArray) -> NDArray[np.float64]:
    """Return the negative log likelihood of changes under Student's t, but for a constant.

    Args:
        residual: (n,) ln I.
        variance: (n,) its variance, (ln I)^2.

    Returns:
        (n,).
    """
    nu = DEGREES_OF_FREEDOM
    return np.log(variance) / 2 + (nu + 1) / 2 * np.log1p(residual**2 / variance / nu)


def reweight(V: NDArray[np.float64], terms: Terms) -> tuple[NDArray, NDArray]:
    """Improve variances, and weigh changes by them.

    Args:
        V: (3,) variances of the sources of errors.
        terms: Terms of the likelihood.

    Returns:
        The variances, and the weights of changes (n,).
    """
    nu, X, square = DEGREES_OF_FREEDOM, terms.X, terms.residual**2
    for _ in range(5):
        v = V @ X
        share = (nu + 1) / (nu + square / v) * square / v**2
        # The factors that make the gradient 0; they keep variances positive.
        V = V * np.sqrt((X @ share) / (X @ (1 / v)))
        V = np.clip(V, [1e-7, 1e-5, 1e-7], [0.1, 1.0, 4.0])
    v = V @ X
    return V, (nu + 1) / (nu + square / v) / v


def sandwich(
    J: NDArray, weight: NDArray, residual: NDArray, changes: Changes
) -> NDArray[np.float64]:
    """Return the covariance that allows for errors in common of a tile or of a pair of frames.

    H^-1 (K_tile + K_interval - K_both) H^-1, K the sums of squared gradients of clusters (Cameron,
    Gelbach & Miller 2011).

    Args:
        J: (n, parameters) derivatives of the predicted changes.
        weight: (n,) weights of the changes.
        residual: (n,) residuals, ln I.
        changes: The changes.

    Returns:
        (parameters, parameters).
    """
    H = np.linalg.pinv((J * weight[:, None]).T @ J * CURVATURE)
    S = J * (weight * residual)[:, None]
    parts = [H @ cluster_sums(S, changes, by) @ H for by in ("tile", "interval", "both")]
    sums = [np.diag(part) for part in (parts[0] + parts[1] - parts[2], *parts)]
    # Few clusters can make the difference too small, or negative: no less than one of its parts.
    scale = np.sqrt(np.max(sums, 0) / np.maximum(sums[3], 1e-30))
    return parts[2] * np.outer(scale, scale)


def cluster_sums(score: NDArray, changes: Changes, by: str) -> NDArray[np.float64]:
    """Return the sum of squares of the gradients of clusters.

    Args:
        score: (n, parameters) gradients of changes.
        changes: The changes.
        by: "tile", "interval", or "both" for a tile in an interval.

    Returns:
        (parameters, parameters).
    """
    tile, interval = changes.tile, changes.interval
    both = tile * (interval.max() + 1) + interval
    _, index = np.unique(
        {"tile": tile, "interval": interval, "both": both}[by], return_inverse=True
    )
    total = np.stack([np.bincount(index, column) for column in score.T], 1)
    return total.T @ total * len(total) / max(len(total) - 1, 1)
