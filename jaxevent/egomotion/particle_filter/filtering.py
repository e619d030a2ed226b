"""The particle filter: predict, score, reweight, resample, batch after batch; and its smoother."""

import dataclasses
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.nn import logsumexp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray
from numpy.typing import NDArray
from scipy.linalg import solveh_banded

from jaxevent.egomotion.candidates import Candidates
from jaxevent.egomotion.models import Model
from jaxevent.egomotion.motion import MotionEstimate
from jaxevent.egomotion.particle_filter.likelihood import score_batch
from jaxevent.egomotion.particle_filter.params import Params
from jaxevent.precision import full_precision

CONTRAST_TIME_CONSTANT_MEMORIES = 5.0  # time constant of the mean contrast, in `Params.memory`
SEARCH_NOISE_SIGMAS = 0.1  # noise of a search, per batch, in standard deviations of the particles
MAX_LOG_WEIGHT_STD = 0.5  # of a batch over particles, in a search
MIN_RELATIVE_HISTORY = 0.99  # of the oldest candidates of a search
KNOTS_PER_LAG = 4  # of the motion whose means over candidates' ages are estimated
SINGLE_PRECISION = 1e-6  # of covariances
MIN_RELATIVE_VARIANCE = 1e-9  # of an estimate, as part of that of the motion between knots
MAX_LAG_RATIO = 4.0  # of a pixel, by the mean
# Knots that are solved for together, so that memory does not grow with the recording, and those
# beside them, which they depend on.
PIECE_KNOTS, MARGIN_KNOTS = 4096, 256
MIN_RUN_ESTIMATES = 16  # in a row, from which such means are undone


class RandomNumbers(eqx.Module):
    """All random numbers of some batches.

    Attributes:
        normal: Normal numbers that move the particles.
        uniform: Uniform numbers for resampling, 0..1.
        cloud: Uniform numbers in [-1, 1], for a search that begins in these batches.
    """

    normal: Float[Array, "batches N d"]
    uniform: Float[Array, " batches"]
    cloud: Float[Array, "N d"]


class ParticleState(eqx.Module):
    """State that is carried from batch to batch.

    Attributes:
        particles: Motions, in the units of the model.
        log_weights: Normalised log weights.
        searching: Whether the motion is searched for.
        votes: Recent votes for the particles.
        chance: Recent votes that are expected by chance.
        mean_contrast: Mean of votes / chance since the motion was found.
        age: Batches since then.
    """

    particles: Float[Array, "N d"]
    log_weights: Float[Array, " N"]
    searching: Bool[Array, ""]
    votes: Float[Array, ""]
    chance: Float[Array, ""]
    mean_contrast: Float[Array, ""]
    age: Float[Array, ""]


class BatchInfo(eqx.Module):
    """Results that are reported for a batch; an axis of batches leads where stacked.

    Attributes:
        mean: Mean motion before resampling.
        covariance: Covariance of the weighted particles.
        searching: Whether the motion is searched for.
        contrast: Votes relative to chance.
        lag: Time by which the observed motion precedes the last event, s.
        evidence: Log of the mean likelihood of the batch.
        cloud: Some particles, drawn by weight.
    """

    mean: Float[Array, "*batches d"]
    covariance: Float[Array, "*batches d d"]
    searching: Bool[Array, "*batches"]
    contrast: Float[Array, "*batches"]
    lag: Float[Array, "*batches"]
    evidence: Float[Array, "*batches"]
    cloud: Float[Array, "*batches n_cloud d"]


class BatchTiming(eqx.Module):
    """Times of a batch, and whether it holds an event.

    Attributes:
        elapsed: Time from the last event of the batch before to this one's, s.
        history: Age up to which all candidates are known, s.
        has_events: Whether the batch holds an event.
    """

    elapsed: Float[Array, ""]
    history: Float[Array, ""]
    has_events: Bool[Array, ""]


class BatchLikelihood(eqx.Module):
    """Likelihood of all events of a batch; see `EventScores`.

    Attributes:
        log_likelihood: Log-likelihood of the batch for each particle.
        votes: Mean over particles of the sum of votes over events.
        chance: Votes expected by chance.
    """

    log_likelihood: Float[Array, " N"]
    votes: Float[Array, ""]
    chance: Float[Array, ""]


class ReweightResult(eqx.Module):
    """Weights after a batch, and the changes of the state and the report.

    Attributes:
        log_weights: Normalised log weights.
        mean: Mean motion.
        covariance: Covariance of the particles.
        contrast: Votes relative to chance.
        evidence: Log of the mean likelihood of the batch.
        is_finite: Whether the weights are finite.
        lost: Whether the motion is lost.
        reported_searching: Whether the report says that the motion is searched for.
        searching: Whether it is in the state after the batch.
        resample: Whether to resample the particles.
        votes: Recent votes for the particles.
        chance: Recent votes that are expected by chance.
        mean_contrast: Mean of votes / chance since the motion was found.
        age: Batches since then.
    """

    log_weights: Float[Array, " N"]
    mean: Float[Array, " d"]
    covariance: Float[Array, "d d"]
    contrast: Float[Array, ""]
    evidence: Float[Array, ""]
    is_finite: Bool[Array, ""]
    lost: Bool[Array, ""]
    reported_searching: Bool[Array, ""]
    searching: Bool[Array, ""]
    resample: Bool[Array, ""]
    votes: Float[Array, ""]
    chance: Float[Array, ""]
    mean_contrast: Float[Array, ""]
    age: Float[Array, ""]


def draw(key: PRNGKeyArray | Array, batches: int, params: Params, model: Model) -> RandomNumbers:
    """Draw the random numbers of some batches at once, which is far faster than one by one.

    Args:
        key: Key of the random numbers. It gives the same numbers in single and double precision.
        batches: Number of batches.
        params: The parameters.
        model: Motion model.

    Returns:
        The random numbers.
    """
    one, two, three = jax.random.split(key, 3)
    N, real = params.particles, jnp.result_type(float)
    return RandomNumbers(
        jax.random.normal(one, (batches, N, model.dimension), real),
        jax.random.uniform(two, (batches,), real),
        jax.random.uniform(three, (N, model.dimension), real, -1, 1),
    )


def init(params: Params, model: Model, noise: RandomNumbers) -> ParticleState:
    """Start without knowledge, with particles everywhere.

    Args:
        params: The parameters.
        model: Motion model.
        noise: Random numbers.

    Returns:
        The state.
    """
    state = init_near(params, init_uniform(params, model, noise))
    return eqx.tree_at(lambda s: s.searching, state, jnp.asarray(params.likelihood != "literal"))


def init_near(params: Params, particles: Float[Array, "N d"]) -> ParticleState:
    """Start with particles near the motion, of equal weights.

    Args:
        params: Parameters.
        particles: Motions.

    Returns:
        The state, which is not searching.
    """
    N, zero = params.particles, jnp.zeros((), particles.dtype)
    equal = jnp.full(N, -jnp.log(N), particles.dtype)
    return ParticleState(particles, equal, jnp.asarray(False), zero, zero, zero, zero)


def init_uniform(params: Params, model: Model, noise: RandomNumbers) -> Float[Array, "N d"]:
    """Place the particles of a search.

    Args:
        params: Parameters, which hold the range of motions.
        model: The model of d components.
        noise: Random numbers of N particles.

    Returns:
        (N, d) particles.
    """
    return jax.vmap(functools.partial(model.initial_particle, params))(noise.cloud)


def resample(
    log_weights: Float[Array, " N"], uniform: Float[Array, ""]
) -> tuple[Int[Array, " N"], Float[Array, " N"]]:
    """Resample systematically.

    The weights keep their gradient: lw_new = -log N + (lw - stop_gradient(lw))[ancestor], whose
    value is 1/N and whose derivative is the ancestor's score (Scibior & Wood, "Differentiable
    Particle Filtering without Modifying the Forward Pass"). Without it the gradient is biased.

    Args:
        log_weights: (N,) normalised log weights.
        uniform: Random number in [0, 1).

    Returns:
        The ancestor of each particle (N,), and the new log weights (N,).
    """
    N = len(log_weights)
    ancestor = _systematic_rows(jnp.exp(lax.stop_gradient(log_weights)), N, uniform)
    carried = log_weights - lax.stop_gradient(log_weights)
    return ancestor, carried[ancestor] - jnp.log(N).astype(log_weights.dtype)


def _systematic_rows(
    weights: Float[Array, " N"], number: int, uniform: Float[Array, ""]
) -> Int[Array, " number"]:
    """Return the particles at equal steps of their summed weights.

    Args:
        weights: Weights; their sum need not be 1.
        number: Number of steps.
        uniform: Place of the first step, in steps, 0..1.

    Returns:
        Indices of the particles, rising.
    """
    edges = jnp.cumsum(weights)
    points = (jnp.arange(number) + uniform) * (edges[-1] / number)
    return jnp.minimum((edges[None, :] <= points[:, None]).sum(1), len(weights) - 1)


def predict(
    params: Params,
    model: Model,
    state: ParticleState,
    timing: BatchTiming,
    normal: Float[Array, "N d"],
) -> tuple[Float[Array, "N d"], Float[Array, " N"]]:
    """Predict the particles at the end of a batch.

    Args:
        params: The parameters.
        model: Motion model.
        state: State after the batch before.
        timing: Times of the batch.
        normal: (N, d) normal random numbers.

    Returns:
        Particles (N, d) and their weights (N,).
    """
    weights = jnp.exp(state.log_weights)
    mean = model.mean(state.particles, weights)
    deviation = jax.vmap(model.deviation, (0, None))
    fixed, far = lax.stop_gradient((weights, deviation(state.particles, mean)))
    spread = model.standard_deviations(_covariance(far, fixed))
    std = model.diffusion(params, mean) * jnp.sqrt(timing.elapsed)
    enough = _has_history(params, model, timing) & timing.has_events
    search_std = SEARCH_NOISE_SIGMAS * spread * enough * model.relative_size(state.particles, fixed)
    noise = jnp.where(state.searching, search_std, std) * normal
    return jax.vmap(model.retract)(state.particles, noise), weights


def _has_history(params: Params, model: Model, timing: BatchTiming) -> Bool[Array, ""]:
    """Return whether slow hypotheses have candidates; with less history only fast ones have."""
    return timing.history >= MIN_RELATIVE_HISTORY * lax.stop_gradient(model.max_age(params))


def reweight(
    params: Params,
    model: Model,
    state: ParticleState,
    timing: BatchTiming,
    particles: Float[Array, "N d"],
    likelihood: BatchLikelihood,
) -> ReweightResult:
    """Update the weights by a batch, and decide whether the motion is found or lost.

    Args:
        params: The parameters.
        model: Motion model.
        state: State after the batch before.
        timing: Times of the batch.
        particles: (N, d) predicted particles.
        likelihood: Likelihood of the batch.

    Returns:
        The weights, and what becomes of the state and the report.
    """
    N, searching = params.particles, state.searching
    has_history = _has_history(params, model, timing)
    gain, fixed = likelihood.log_likelihood, lax.stop_gradient(likelihood.log_likelihood)
    deviation = jnp.sqrt(((fixed - fixed.sum() / N) ** 2).sum() / N + 1e-12)
    annealed = jnp.minimum(1, MAX_LOG_WEIGHT_STD / deviation) * has_history
    gain = gain * jnp.where(searching, annealed, 1)
    joint = state.log_weights + gain
    evidence = logsumexp(joint)
    log_weights = joint - evidence
    weights = jnp.exp(log_weights)
    mean = model.mean(particles, weights)
    covariance = _covariance(jax.vmap(model.deviation, (0, None))(particles, mean), weights)

    memory = jnp.exp(-1 / lax.stop_gradient(params.memory))
    votes = memory * state.votes + likelihood.votes
    chance = memory * state.chance + likelihood.chance
    contrast = jnp.where(chance > 0, votes / jnp.where(chance > 0, chance, 1), 1)
    counted = likelihood.chance > 0
    age = state.age + counted
    is_finite = jnp.isfinite(evidence) & jnp.isfinite(particles).all()
    can_search = params.likelihood != "literal"
    converged = model.is_converged(*lax.stop_gradient((params, mean, covariance)))
    found = searching & has_history & counted & converged
    forget = (1 - memory) / CONTRAST_TIME_CONSTANT_MEMORIES
    change = jnp.where(counted, forget * (contrast - state.mean_contrast), 0)
    mean_contrast = state.mean_contrast + change
    least = lax.stop_gradient(params.drop * mean_contrast)
    if not model.half_line:  # where chance is the larger part of all votes
        least = jnp.maximum(lax.stop_gradient(params.contrast), least)
    poor = ~searching & (age > params.memory) & (contrast < least)
    lost = ~is_finite | (poor & can_search)
    over = lost | found
    return ReweightResult(
        log_weights,
        mean,
        covariance,
        jnp.where(is_finite, contrast, 0),
        jnp.where(is_finite, evidence, 0),
        is_finite,
        lost,
        (searching & ~found) | lost,
        (searching & ~found) | (lost & can_search),
        1 / (weights**2).sum() <= params.resample_below * N,
        *(jnp.where(over, 0, value) for value in (votes, chance, mean_contrast, age)),
    )


def restart(
    params: Params, model: Model, cloud: Float[Array, "N d"]
) -> tuple[Float[Array, "N d"], Float[Array, " d"], Float[Array, "d d"]]:
    """Start a search.

    Args:
        params: The parameters.
        model: Motion model.
        cloud: (N, d) random numbers in [-1, 1].

    Returns:
        Particles (N, d), their mean (d,), and a covariance (d, d) of their range.
    """
    particles = jax.vmap(functools.partial(model.initial_particle, params))(cloud)
    equal = jnp.full(len(particles), 1 / params.particles, particles.dtype)
    covariance = jnp.eye(model.dimension) * model.search_bound(params) ** 2 / 3
    return particles, model.mean(particles, equal), covariance


class BatchNoise(eqx.Module):
    """Random numbers of one batch, see `RandomNumbers`.

    Attributes:
        normal: Normal numbers that move the particles.
        uniform: Uniform number for resampling, 0..1.
        cloud: Uniform numbers in [-1, 1], for a search that begins in this batch.
    """

    normal: Float[Array, "N d"]
    uniform: Float[Array, ""]
    cloud: Float[Array, "N d"]


def step(
    params: Params,
    model: Model,
    state: ParticleState,
    batch: Candidates,
    noise: BatchNoise,
    n_cloud: int = 0,
) -> tuple[ParticleState, BatchInfo]:
    """Process one batch: predict, score, reweight, report, resample; restart where lost.

    Args:
        params: The parameters.
        model: Motion model.
        state: State after the batch before.
        batch: The candidates.
        noise: Random numbers.
        n_cloud: Number of particles to report, drawn by weight.

    Returns:
        The state, and the report.
    """
    timing = BatchTiming(*map(jnp.asarray, (batch.elapsed, batch.history, batch.valid.any())))
    particles, before = predict(params, model, state, timing, noise.normal)
    scores = score_batch(params, model, batch, particles, before, state.searching)
    likelihood = BatchLikelihood(scores.log_likelihood.sum(0), scores.votes, scores.chance)
    found = reweight(params, model, state, timing, particles, likelihood)

    weights = jnp.exp(found.log_weights)
    cloud = particles[:0]
    if n_cloud:
        cloud = particles[_systematic_rows(weights, n_cloud, jnp.asarray(0.5))]
    ancestor, renewed = resample(found.log_weights, noise.uniform)
    particles = jnp.where(found.resample, particles[ancestor], particles)
    log_weights = jnp.where(found.resample, renewed, found.log_weights)
    restarted, middle, widest = restart(params, model, noise.cloud)
    after = ParticleState(
        jnp.where(found.lost, restarted, particles),
        jnp.where(found.lost, -jnp.log(params.particles), log_weights),
        found.searching,
        found.votes,
        found.chance,
        found.mean_contrast,
        found.age,
    )
    info = BatchInfo(
        jnp.where(found.is_finite, found.mean, middle),
        jnp.where(found.is_finite, found.covariance, widest),
        found.reported_searching,
        found.contrast,
        scores.lag,
        found.evidence,
        jnp.where(found.is_finite, cloud, 0),
    )
    return after, info


@full_precision
def _covariance(deviation: Float[Array, "N d"], weights: Float[Array, " N"]) -> Float[Array, "d d"]:
    """Return a weighted covariance.

    Args:
        deviation: Deviations from the mean.
        weights: Weights, of sum 1.

    Returns:
        The covariance.
    """
    return (deviation * weights[:, None]).T @ deviation


def run(
    params: Params,
    model: Model,
    candidates: Candidates,
    noise: RandomNumbers,
    state: ParticleState | None = None,
    n_cloud: int = 0,
) -> tuple[ParticleState, BatchInfo]:
    """Run the filter over stacked batches: pure, differentiable, and to be mapped by vmap.

    Derivatives are those of weights and particles while the motion is tracked. Ranges of ages, the
    times of resampling and all that a search adds are constant.

    Args:
        params: The parameters.
        model: Motion model.
        candidates: Stacked batches.
        noise: Random numbers.
        state: State at the start; by default particles are everywhere.
        n_cloud: Number of particles to report for each batch.

    Returns:
        The state at the end, and the stacked reports.
    """
    state = init(params, model, noise) if state is None else state

    def body(state, inputs):
        batch, normal, uniform = inputs
        drawn = BatchNoise(normal, uniform, noise.cloud)
        return step(params, model, state, batch, drawn, n_cloud)

    batches = jax.tree.map(jnp.asarray, candidates)
    return lax.scan(body, state, (batches, noise.normal, noise.uniform))


_diffusions = eqx.filter_jit(
    lambda model, params, means: jax.vmap(model.diffusion, (None, 0))(params, means)
)


def smooth(motion: MotionEstimate, params: Params | None = None) -> MotionEstimate:
    """Smooth an estimate by later events, and remove its lag.

    The filter's means and covariances are treated as those of a Kalman filter with the process
    noise of `params`, and passed backwards (Rauch, Tung & Striebel 1965): with G = P (P + Q)^-1,

        m_s = m + G (m_s' - m),  P_s = P + G (P_s' - P - Q) G',

    where ' is the next batch. That halves the variance, and removes the delay with which the filter
    follows a change. Nothing passes a search.

    Args:
        motion: The filter's estimate.
        params: The filter's parameters; by default those of the model.

    Returns:
        The smoothed estimate, with `lag` subtracted from its times, none before the recording.
    """
    model = motion.model()
    params = Params(preset=model.preset) if params is None else params
    if not len(motion):
        return motion
    m, P = motion.mean.astype(float), motion.covariance.astype(float)
    padded = np.zeros((1 << (len(m) - 1).bit_length(), model.dimension))  # compiles for few sizes
    padded[: len(m)] = m
    noise = np.asarray(_diffusions(model, params, jnp.asarray(padded)))[: len(m)]
    dt = np.diff(motion.t, append=motion.t[-1]) * 1e-6
    Q = np.eye(model.dimension) * (noise**2 * dt[:, None])[:, None, :]
    # Covariances of headings have no spread along them, and those of few particles none at all.
    tiny = 1e-9 * np.trace(P, axis1=1, axis2=2)[:, None, None] + 1e-12
    G = np.linalg.solve(P + Q + tiny * np.eye(model.dimension), P).transpose(0, 2, 1)
    for k in range(len(m) - 2, -1, -1):
        if not (motion.valid[k] and motion.valid[k + 1]):
            continue
        m[k] += G[k] @ (m[k + 1] - m[k])
        P[k] += G[k] @ (P[k + 1] - P[k] - Q[k]) @ G[k].T
        for part in model.parts:
            if part.direction:
                m[k, part.rows] /= np.linalg.norm(m[k, part.rows])
    seen = motion.observed_t
    if motion.span is not None:
        seen = np.maximum(seen, motion.span[0])
    return dataclasses.replace(
        motion,
        t=np.maximum.accumulate(seen),
        mean=m.astype(motion.mean.dtype),
        covariance=P.astype(motion.mean.dtype),
        lag=np.zeros_like(motion.lag),
    )


def undo_averages(
    motion: MotionEstimate,
    span: NDArray[np.floating],
    params: Params,
    basis: NDArray[np.floating] | None = None,
) -> NDArray:
    """Return the motions of which smoothed estimates are the means over the ages of candidates.

    Where the image is slow, candidates are as old as the motion takes to change, so that estimates
    are flatter than it. Where the flow U(p) differs between pixels p, with B(p) the model's basis,
    slow pixels tell of older motions than fast ones, and a change of one component looks like
    another component. A pixel's events of time t say what the mean is over the ages of its own
    candidates, up to tau(p) = b / |U(p)|, and all of them together

        C y = M^-1 sum_p w(p) B(p)' B(p) mean(y over [t - l(p), t]),  M = sum_p w(p) B(p)' B(p),

    with l(p) in proportion to tau(p) and its mean over events the span of an estimate. A pixel
    makes |U| events per time, and each fixes its flow to 1 / tau: w = |U| tau^2. Motions y at
    knots, of which a span holds 2 `KNOTS_PER_LAG`, minimise

        sum_k |x_k - (C y)_k|^2 / S_k + sum_k |y_k+1 - y_k|^2 / (q h_k),

    where q is the process noise of `params`, and h_k the time between knots. Estimates within a
    span share events, so their errors are about alike: S_k is their covariance times the knots of a
    span.

    Args:
        motion: Smoothed estimates of a model whose flow is linear in its components.
        span: (n,) length of the time span of an estimate's events, s.
        params: The filter's parameters.
        basis: (pixels, 2, d) the model's basis at pixels spread over the sensor; None where the
            flow is the same everywhere.

    Returns:
        (n, d) motions.
    """
    mean, model = np.array(motion.mean, np.float64), motion.model()
    change = np.flatnonzero(np.diff(motion.valid.astype(int), prepend=0, append=0))
    for first, last in change.reshape(-1, 2):
        if last - first < MIN_RUN_ESTIMATES:
            continue
        rows = slice(first, last)
        t = (motion.t[rows] - motion.t[first]) * 1e-6
        per_s = 2 * KNOTS_PER_LAG / np.maximum(span[rows], 1e-6)
        u = np.append(0, np.cumsum(np.diff(t) * (per_s[1:] + per_s[:-1]) / 2))
        count = int(u[-1]) + 1
        if count < 2 * KNOTS_PER_LAG:
            continue
        at = np.interp(np.arange(-0.5, count) * (u[-1] / (count - 1)), u, t)  # cells' ends
        middle = (at[1:] + at[:-1]) / 2
        h = np.diff(np.interp(np.arange(count) * (u[-1] / (count - 1)), u, t))
        x = mean[rows]
        total = np.concatenate(
            [0 * x[:1], np.cumsum(np.diff(t)[:, None] * (x[1:] + x[:-1]) / 2, 0)]
        )
        ends = np.stack([np.interp(at, t, column) for column in total.T], 1)
        cells = np.diff(ends, axis=0) / np.diff(at)[:, None]
        nearest = np.clip(np.searchsorted(t, middle), 0, len(t) - 1)
        S = 2 * KNOTS_PER_LAG * motion.covariance[rows][nearest].astype(float)
        noise = np.asarray(model.diffusion(params, jnp.asarray(x.mean(0)))) ** 2
        steps, y = h[:, None] * noise, np.empty_like(cells)
        for begin in range(0, count, PIECE_KNOTS):
            end = min(begin + PIECE_KNOTS, count)
            low, high = max(begin - MARGIN_KNOTS, 0), min(end + MARGIN_KNOTS, count)
            some, weights = cells[low:high], _mean_weights(cells[low:high], params, basis)
            piece = _solve_averages(some, S[low:high], steps[low : high - 1], weights)
            y[begin:end] = piece[begin - low : end - low]
        for k in range(x.shape[1]):
            mean[rows, k] = np.interp(t, middle, y[:, k])
    return mean


def _mean_weights(
    x: NDArray, params: Params, basis: NDArray[np.floating] | None
) -> NDArray[np.float64]:
    """Return the weights with which motions at knots count in the estimate at each knot.

    The estimate x_k is a mean of motions from knot k - back to knot k + `KNOTS_PER_LAG`.

    Args:
        x: (n, d) estimates at knots.
        params: The parameters.
        basis: (pixels, 2, d) flow per unit of each component, px/s; None: all components lag alike.

    Returns:
        (n, knots, d, d) weights, whose sum over knots is 1.
    """
    (n, d), after = x.shape, KNOTS_PER_LAG
    if basis is None:
        knots = np.arange(-after, after + 1)
        return np.tile(_box_weights(np.ones(1), knots)[0][:, None, None] * np.eye(d), (n, 1, 1, 1))
    knots = np.arange(-round(after * (2 * MAX_LAG_RATIO - 1)), after + 1)
    square = np.einsum("pid,pie->pde", basis, basis)
    slowest, found = float(params.baseline) / float(params.tau_max), np.empty((n, len(knots), d, d))
    for k in range(n):
        speed = np.linalg.norm(basis @ x[k], axis=-1)
        age = 1 / np.maximum(speed, slowest)
        ratio = age * (speed.sum() / max((speed * age).sum(), 1e-12))
        ratio = np.minimum(ratio, MAX_LAG_RATIO)
        share = (ratio**2 * speed)[:, None, None] * square
        share = np.linalg.solve(share.sum(0) + 1e-9 * np.eye(d), share)
        found[k] = np.einsum("pk,pde->kde", _box_weights(ratio, knots), share)
    return found


def _box_weights(ratio: NDArray, knots: NDArray) -> NDArray[np.float64]:
    """Return the weights of values at knots in means over spans.

    Values between knots are interpolated. Spans end at `KNOTS_PER_LAG` and are `ratio` times twice
    as long.

    Args:
        ratio: (p,) lengths of the spans.
        knots: (knots,) positions of the knots.

    Returns:
        (p, knots).
    """
    length = 2 * KNOTS_PER_LAG * ratio[:, None]
    return (
        _hat_integral(KNOTS_PER_LAG - knots) - _hat_integral(KNOTS_PER_LAG - length - knots)
    ) / length


def _hat_integral(z: NDArray) -> NDArray[np.float64]:
    """Return the integral to z of the function that is 1 at 0 and falls to 0 at -1 and 1."""
    z = np.clip(z, -1, 1)
    return 0.5 + z - np.sign(z) * z**2 / 2


def _solve_averages(
    x: NDArray, S: NDArray, q: NDArray, weights: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Solve for the values whose weighted sums are known.

    Args:
        x: (n, d) sums.
        S: (n, d, d) their covariances.
        q: (n - 1, d) variances of steps.
        weights: (n, knots, d, d) of `_mean_weights`.

    Returns:
        (n, d) values.
    """
    after = KNOTS_PER_LAG
    back = weights.shape[1] - after - 1
    (n, d), total = x.shape, len(x) + back + after  # with knots beyond both ends
    # Particles that all agree have no variance, of which no sum is positive definite.
    rounding = SINGLE_PRECISION * np.trace(S, axis1=1, axis2=2)[:, None, None] * np.eye(d)
    information = np.linalg.inv(S + rounding + MIN_RELATIVE_VARIANCE * np.diag(q.mean(0)))
    rows = weights.transpose(0, 2, 1, 3).reshape(n, d, -1)
    weighted = np.einsum("nde,nek->ndk", information, rows)
    width = rows.shape[2]
    band, side = np.zeros((width, total * d)), np.zeros(total * d)
    for i in range(width):
        side[i : i + n * d : d] += (weighted[:, :, i] * x).sum(1)
        for j in range(i + 1):
            band[i - j, j : j + n * d : d] += (rows[:, :, i] * weighted[:, :, j]).sum(1)
    steps = np.pad(1 / q, [(back, after), (0, 0)], mode="edge").ravel()
    band[0, :-d] += steps
    band[0, d:] += steps
    band[d, :-d] -= steps
    found = solveh_banded(band, side, lower=True)
    return found.reshape(total, d)[back : back + n]
