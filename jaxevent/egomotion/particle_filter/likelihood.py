"""Likelihood of motions: the votes of the candidates of an event, and those expected by chance.

Functions that are equations of the thesis are of one candidate, one event and one particle, in
scalars. `init_votes`, `accumulate_votes` and `event_log_likelihood` map them over the particles of
one event, and `score_batch` over events (`engine` makes loops of them). Shapes: K events, C
candidates, and N particles, which are the last axis.
"""

import functools
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxevent.egomotion.candidates import Candidates
from jaxevent.egomotion.models import Model
from jaxevent.egomotion.particle_filter.params import Params

SEARCH_SIGMA_FACTOR = 2.0  # sigma_x of a search, in sigma_x
MIN_CHANCE_VOTES = 0.2  # per event; a point that moves alone gets about 1.5
BORDER_SIGMAS = 2.0  # sigma_x, distance from the border of the origin of an event that counts
RELATIVE_AGE_TOLERANCE = 1e-6  # relative
CANDIDATES_PER_BLOCK = 8  # candidates per event that are scored together


class EventScores(NamedTuple):
    """Log-likelihoods of a batch for all particles, and votes compared with chance.

    Attributes:
        log_likelihood: Log-likelihood of each event for each particle.
        votes: Mean over particles of the sum of votes over events.
        chance: Votes expected by chance.
        lag: Time by which the observed motion precedes the last event, s.
    """

    log_likelihood: Float[Array, "K N"]
    votes: Float[Array, ""]
    chance: Float[Array, ""]
    lag: Float[Array, ""]


class Event(eqx.Module):
    """One event, or K, without candidates; see `Candidates`.

    Attributes:
        xi: Positions, px.
        bounds: Least and largest displacement within the sensor, px.
        valid: Whether the event is scored.
        scale: Number of candidates that each stands for.
        rate: Candidates per time of age, 1/s.
    """

    xi: Float[Array, "*K 2"]
    bounds: Float[Array, "*K 2 2"]
    valid: Bool[Array, "*K"]
    scale: Float[Array, "*K"]
    rate: Float[Array, "*K"]


class CommonRange(eqx.Module):
    """The range of ages that particles of a known motion share, and whether an event counts."""

    tau: Float[Array, "*K"]  # s, largest age
    counts: Bool[Array, "*K"]  # while the motion is tracked
    counts_in_search: Bool[Array, "*K"]  # where every hypothesis has its own range


class AgeRange(eqx.Module):
    """Least and largest age of the candidates that vote.

    Attributes:
        youngest: Least age, s.
        oldest: Largest age, s.
    """

    youngest: Float[Array, "*K_N"]
    oldest: Float[Array, "*K_N"]


class Votes(eqx.Module):
    """Expectations of particles for the candidates of an event, or K, before they vote.

    Attributes:
        U: Flow, px/s.
        line: Direction of the half-line; None: there is none.
        ages: Ages of the candidates that vote.
        rate: Factor of the votes in a band; else 1.
        counts: Whether the event counts.
        tau: Largest age of candidates that vote, s.
    """

    U: Float[Array, "*K 2 N"]
    line: Float[Array, "*K 2 N"] | None
    ages: AgeRange
    rate: Float[Array, "*K_N"]
    counts: Bool[Array, "*K"]
    tau: Float[Array, "*K"]


class EventLikelihood(NamedTuple):
    """Log-likelihoods of an event, or of K, for all particles, and votes compared with chance.

    Attributes:
        log_likelihood: Log-likelihood for each particle.
        votes: Mean over particles of the votes.
        chance: Votes expected by chance.
    """

    log_likelihood: Float[Array, "*K N"]
    votes: Float[Array, "*K"]
    chance: Float[Array, "*K"]


def common_range(
    params: Params, model: Model, event: Event, mean_flow: Float[Array, "2"]
) -> CommonRange:
    """Return the common range of ages, with tau = b / |U_mean|.

    An event does not count if its point would have come from outside the sensor.

    Args:
        params: The parameters.
        model: Motion model.
        event: The event.
        mean_flow: (2,) mean flow of the particles, px/s.

    Returns:
        The range.
    """
    b = params.baseline
    # A little less: distances to the border are often whole px, as b may be, but for rounding.
    inside = jnp.minimum(-event.bounds[0], event.bounds[1]).min() >= 0.99 * b
    if model.half_line:
        return CommonRange(params.tau_general, event.valid & inside, event.valid & inside)
    tau = jnp.minimum(b / jnp.sqrt((mean_flow**2).sum() + 1e-12), params.tau_max)
    pad, back = BORDER_SIGMAS * params.sigma_x, mean_flow * tau
    origin_inside = ((back >= event.bounds[0] + pad) & (back <= event.bounds[1] - pad)).all()
    return CommonRange(tau, event.valid & origin_inside, event.valid & inside)


def age_range(
    params: Params, common: CommonRange, speed: Float[Array, ""], band: Bool[Array, ""] | bool
) -> AgeRange:
    """Return the range of ages [0.7 tau, tau]; in a `band` [0.7 b, b] / speed.

    Times are whole microseconds, as the limits often are: rounding must not separate them.

    Args:
        params: The parameters.
        common: The common range.
        speed: Speed of the particle's flow, px/s.
        band: Whether the particle has its own range.

    Returns:
        The range.
    """
    own = params.baseline / speed
    return AgeRange(
        (1 - RELATIVE_AGE_TOLERANCE) * params.youngest * jnp.where(band, own, common.tau),
        (1 + RELATIVE_AGE_TOLERANCE)
        * jnp.where(band, jnp.minimum(own, params.tau_max), common.tau),
    )


class VoteWidth(NamedTuple):
    """Constants of `vote`."""

    exponent: Float[Array, ""]  # -1 / (2 sigma_x^2), 1/px^2
    rho_max: Float[Array, ""]  # px/s


def vote(
    d: tuple[Float[Array, ""], Float[Array, ""]],
    dt: Float[Array, ""],
    U: Float[Array, "2"],
    line: Float[Array, "2"] | None,
    ages: AgeRange,
    width: VoteWidth,
) -> Float[Array, ""]:
    """Return the vote exp(-r_c^2 / (2 sigma_x^2)) of a candidate; 0 outside the range of ages.

    r_c is the distance of d_c from U dt_c, or from the half-line that begins there.

    Args:
        d: Displacement in x and y, px.
        dt: Age, s.
        U: (2,) flow of the particle, px/s.
        line: (2,) direction of the half-line, or None.
        ages: The range of ages.
        width: Constants.

    Returns:
        The vote, up to 1.
    """
    x, y = d[0] - U[0] * dt, d[1] - U[1] * dt
    distance2 = x**2 + y**2
    if line is not None:
        s = x * line[0] + y * line[1]
        to = jnp.clip(s, 0, width.rho_max * dt)
        distance2 = distance2 + to * (to - 2 * s)
    inside = (dt >= ages.youngest) & (dt <= ages.oldest)
    return jnp.where(inside, jnp.exp(distance2 * width.exponent), 0)


def log_gain(
    params: Params, S: Float[Array, ""], rate: Float[Array, ""], counts: Bool[Array, ""]
) -> Float[Array, ""]:
    """Return the gain of a particle's log weight by an event, alpha log(1 + S / s0).

    Args:
        params: Parameters.
        S: Votes for the particle's motion.
        rate: Factor on them, as of `Votes`.
        counts: Whether the event counts.

    Returns:
        The gain; 0 where the event does not count.
    """
    return jnp.where(counts, params.alpha * jnp.log1p(S * rate / params.s0), 0)


def chance_votes(
    params: Params,
    model: Model,
    event: Event,
    tau: Float[Array, ""],
    sigma: Float[Array, ""],
    radius: int | Float[Array, ""],
) -> Float[Array, ""]:
    """Return the number of votes for an event that is expected of candidates without order.

    Candidates in the common range of ages lie anywhere in the window, and each gives 2 pi sigma_x^2
    / (2 R + 1)^2 votes. The number is at least `MIN_CHANCE_VOTES`. So a motion that is too fast for
    any candidate counts as one that explains nothing.

    Args:
        params: The parameters.
        model: Motion model.
        event: The event.
        tau: Largest age, s.
        sigma: Spread of a candidate, px.
        radius: Largest distance of candidates in x and y, R, px.

    Returns:
        The number of votes.
    """
    number = event.rate * (1 - params.youngest) * tau
    # The area of a vote, px^2; of a half-line it is a strip's.
    area = jnp.sqrt(2 * jnp.pi) * sigma
    area = area * (area / 2 + radius if model.half_line else area)
    return jnp.maximum(number * (area / (2 * radius + 1) ** 2), MIN_CHANCE_VOTES)


def init_votes(
    params: Params,
    model: Model,
    event: Event,
    particles: Float[Array, "N d"],
    weights: Float[Array, " N"],
    searching: Bool[Array, ""] | bool,
) -> Votes:
    """Compute each particle's expectation of the candidates of one event.

    Args:
        params: The parameters.
        model: Motion model.
        event: The event.
        particles: (N, d) motions.
        weights: (N,) weights of sum 1.
        searching: Whether the motion is searched for.

    Returns:
        The expectations.
    """
    U = jax.vmap(model.flow, (None, 0), -1)(event.xi, particles)
    line = None
    if model.half_line:
        line = jax.vmap(model.half_line_direction, (None, 0), -1)(event.xi, particles)
    speed = jax.vmap(_speed, -1)(U)
    fixed, now, mean_flow = lax.stop_gradient((params, speed, (U * weights).sum(-1)))
    common = common_range(fixed, model, event, mean_flow)
    band = _has_own_ranges(params, model, searching)
    ages = jax.vmap(functools.partial(age_range, fixed, common, band=band))(now)
    rate = jnp.where(band, speed / jnp.maximum((speed * weights).sum(), 1e-12), 1)
    counts = jnp.where(band, common.counts_in_search, common.counts)
    return Votes(U, line, ages, rate, counts, jnp.where(event.valid, common.tau, 0))


def _has_own_ranges(
    params: Params, model: Model, searching: Bool[Array, ""] | bool
) -> Bool[Array, ""] | bool:
    """Return whether every hypothesis has its own range of ages.

    Args:
        params: Parameters; `likelihood` decides.
        model: Motion model.
        searching: Whether the filter searches the whole range of motions.

    Returns:
        True or false; an array if `searching` is one and decides.
    """
    if model.half_line:
        return False
    return True if params.likelihood == "band" else searching


def vote_sigma(params: Params, searching: Bool[Array, ""] | bool) -> Float[Array, ""]:
    """Return the spread of a candidate, which is larger in a search.

    Args:
        params: Parameters.
        searching: Whether the motion is searched.

    Returns:
        The standard deviation, px.
    """
    return params.sigma_x * jnp.where(searching, SEARCH_SIGMA_FACTOR, 1.0)


def accumulate_votes(
    params: Params,
    d: Float[Array, "2"],
    dt: Float[Array, ""],
    votes: Votes,
    S: Float[Array, " N"],
    searching: Bool[Array, ""] | bool,
) -> Float[Array, " N"]:
    """Add the votes of one more candidate of an event.

    Args:
        params: The parameters.
        d: (2,) displacement of the candidate, px.
        dt: Age of the candidate, s.
        votes: What each particle expects.
        S: (N,) votes so far.
        searching: Whether the motion is searched for.

    Returns:
        (N,) votes.
    """
    exponent = -0.5 / vote_sigma(params, searching) ** 2
    width = VoteWidth(exponent, lax.stop_gradient(params.rho_max))
    ages = jax.tree.map(lambda age: jnp.broadcast_to(age, S.shape), votes.ages)
    line = None if votes.line is None else 1
    over_particles = jax.vmap(vote, (None, None, 1, line, 0, None))
    return S + over_particles((d[0], d[1]), dt, votes.U, votes.line, ages, width)


def event_log_likelihood(
    params: Params,
    model: Model,
    event: Event,
    votes: Votes,
    S: Float[Array, " N"],
    weights: Float[Array, " N"],
    *,
    searching: Bool[Array, ""] | bool,
    radius: int | Float[Array, ""],
) -> EventLikelihood:
    """Compute the log-likelihood of one event from its votes.

    Args:
        params: The parameters.
        model: Motion model.
        event: The event.
        votes: What each particle expects.
        S: (N,) votes.
        weights: (N,) weights of the particles, of sum 1.
        searching: Whether the motion is searched for.
        radius: Largest distance of candidates in x and y, px.

    Returns:
        Log-likelihoods (N,), the mean of the votes, and the number expected by chance.
    """
    S = S * event.scale
    rate = jnp.broadcast_to(votes.rate, S.shape)
    gain = functools.partial(log_gain, params)
    log_likelihood = jax.vmap(gain, (0, 0, None))(S, rate, votes.counts)
    fixed, sigma = lax.stop_gradient((params, vote_sigma(params, searching)))
    chance = chance_votes(fixed, model, event, votes.tau, sigma, radius)
    mean = (lax.stop_gradient(S) * lax.stop_gradient(weights)).sum()
    return EventLikelihood(
        log_likelihood, jnp.where(votes.counts, mean, 0), jnp.where(votes.counts, chance, 0)
    )


def candidate_lag(params: Params, tau: Float[Array, ""]) -> Float[Array, ""]:
    """Return the lag of candidates: half their mean age.

    Args:
        params: Parameters.
        tau: Greatest age, s.

    Returns:
        The lag, s.
    """
    return (1 + lax.stop_gradient(params.youngest)) / 4 * tau


def score_batch(
    params: Params,
    model: Model,
    batch: Candidates,
    particles: Float[Array, "N d"],
    weights: Float[Array, " N"],
    searching: Bool[Array, ""] | bool,
) -> EventScores:
    """Compute the log-likelihoods of a batch of K events.

    Args:
        params: The parameters.
        model: Motion model.
        batch: The candidates.
        particles: (N, d) motions.
        weights: (N,) weights of sum 1.
        searching: Whether the motion is searched for.

    Returns:
        Log-likelihoods (K, N), votes, chance and lag.
    """
    event = Event(*map(jnp.asarray, (batch.xi, batch.bounds, batch.valid, batch.scale, batch.rate)))
    init = functools.partial(init_votes, params, model, weights=weights, searching=searching)
    votes = jax.vmap(init, (0, None))(event, particles)
    number = jnp.maximum(event.valid.sum(), 1)
    lag = candidate_lag(params, votes.tau.sum() / number)
    if params.likelihood == "literal":
        one = jnp.ones((), particles.dtype)
        literal = literal_log_likelihood(params, model, batch, votes.U, votes.line)
        return EventScores(literal, one, one, lag)
    S = _sum_votes(params, batch, votes, searching)
    of_event = functools.partial(
        event_log_likelihood, params, model, weights=weights, searching=searching,
        radius=batch.radius,
    )  # fmt: skip
    found = jax.vmap(of_event)(event, votes, S)
    return EventScores(found.log_likelihood, found.votes.sum(), found.chance.sum(), lag)


def _speed(U: Float[Array, "2"]) -> Float[Array, ""]:
    return jnp.sqrt((U**2).sum() + 1e-12)


def _sum_votes(
    params: Params, batch: Candidates, votes: Votes, searching: Bool[Array, ""] | bool
) -> Float[Array, "K N"]:
    """Sum the votes S over candidates.

    Candidates fill the entries from the first, so the later blocks of most batches hold none and
    are skipped. The condition is outside of the maps, within which both sides would be computed.
    Args:
        params: Parameters.
        batch: Candidates of K events.
        votes: Flow of N particles at the events.
        searching: Whether the motion is searched.

    Returns:
        S of each event and particle.
    """
    K, C = batch.age.shape
    pad = -C % CANDIDATES_PER_BLOCK
    age = jnp.pad(jnp.asarray(batch.age), [(0, 0), (0, pad)]).T.reshape(-1, CANDIDATES_PER_BLOCK, K)
    d = jnp.pad(jnp.asarray(batch.d), [(0, 0), (0, pad), (0, 0)])
    d = jnp.swapaxes(d, 0, 1).reshape(-1, CANDIDATES_PER_BLOCK, K, 2)
    accumulate = jax.vmap(functools.partial(accumulate_votes, params, searching=searching))

    def add(S, d, age):
        for c in range(CANDIDATES_PER_BLOCK):
            S = accumulate(d[c], age[c], votes, S)
        return S

    def body(S, block):
        return lax.cond((block[1] > 0).any(), add, lambda S, *_: S, S, *block), None

    return lax.scan(body, jnp.zeros_like(votes.U[:, 0]), (d, age))[0]


class Hypothesis(NamedTuple):
    """The flow of an event under one particle."""

    U: Float[Array, "2"]  # px/s
    line: Float[Array, "2"] | None  # direction of the half-line
    speed: Float[Array, ""]  # px/s


def literal_distance(
    params: Params,
    model: Model,
    d: Float[Array, "2"],
    age: Float[Array, ""],
    before: Float[Array, ""],
    hypothesis: Hypothesis,
) -> Float[Array, ""]:
    """Return the distance of a candidate from the expected one, with a penalty of time (thesis).

    Of a uniform flow by eqs 5.2, 5.3, 5.7, else 6.9 to 6.16, with distances in px. 6.12 is printed
    as a norm and squared, in px^2/s^2, and 6.9 is signed, in px^2/s; only px suit V_max = 2 to 3
    and r_t in px/s. So 6.9 is read as |F| dt / |A T|, the distance from the whole line of all
    depths, positive or not. The time penalty of 6.10 compares with the last event at the same
    pixel.

    Args:
        params: The parameters.
        model: Motion model.
        d: (2,) displacement of the candidate, px.
        age: Age of the candidate, s.
        before: Age of the last event at the event's pixel, s; infinite means no penalty.
        hypothesis: The flow.

    Returns:
        The distance, px.
    """
    U, line, speed = hypothesis
    if model.uniform:
        past = 1 / speed if params.horizon == "crossing" else params.past
        ex, ey, late = d[0] - U[0] * past, d[1] - U[1] * past, age - past
    else:
        late = jnp.where(jnp.isfinite(before), age - before, 0)
        ex, ey = d[0] - U[0] * age, d[1] - U[1] * age
        if line is not None:
            ex, ey = ex * line[1] - ey * line[0], jnp.zeros_like(ex)
    return jnp.sqrt(ex**2 + ey**2 + 1e-12) + params.r_t * jnp.abs(late)


def is_along_edge(
    params: Params, d: Float[Array, "2 C"], age: Float[Array, " C"], last: Float[Array, ""]
) -> Bool[Array, " C"]:
    """Return which candidates fired along one edge with the event, across the motion (6.6.5).

    Such a candidate is younger than `params.edge`, and the event before it at its pixel is as near
    in time to the one before at the event's own pixel. In the thesis' words both lie "within a very
    small time window", whose length it does not give.

    Args:
        params: The parameters.
        d: (2, C) displacements, px.
        age: (C,) ages, s; 0 for no candidate.
        last: Age of the last event at the event's pixel, s.

    Returns:
        (C,) booleans.
    """
    same = (d[:, :, None] == d[:, None, :]).all(0)
    before = jnp.where(same & (age[None] > age[:, None]), age[None], jnp.inf).min(1)
    together = jnp.isfinite(before) & (jnp.abs(before - last) <= params.edge)
    return (age > 0) & (age <= params.edge) & together


def literal_log_likelihood(
    params: Params,
    model: Model,
    batch: Candidates,
    U: Float[Array, "K 2 N"],
    line: Float[Array, "K 2 N"] | None,
) -> Float[Array, "K N"]:
    """Return -alpha_p times the least distance of an event's candidates, up to d_max or V_max.

    The last event at the same pixel is itself no candidate where the flow is not uniform: to a
    camera that does not move it would always be the best.

    Args:
        params: The parameters.
        model: Motion model.
        batch: The candidates.
        U: (K, 2, N) flow, px/s.
        line: (K, 2, N) directions of half-lines, or None.

    Returns:
        (K, N) log-likelihoods.
    """
    d, age = jnp.moveaxis(jnp.asarray(batch.d), -1, 0), jnp.asarray(batch.age).T
    d = jnp.swapaxes(d, 1, 2)
    there, before, most = age > 0, jnp.full_like(age[0], jnp.inf), params.d_max
    own = there & (d == 0).all(0)
    last = jnp.where(own, age, jnp.inf).min(0)
    edge = jax.vmap(functools.partial(is_along_edge, params), -1, -1)
    there &= ~lax.cond(params.edge > 0, edge, lambda d, age, last: age < 0, d, age, last)
    if not model.uniform:
        before, there, most = last, there & ~own, params.V_max
    of_particle = functools.partial(literal_distance, params, model)
    of_particles = jax.vmap(of_particle, (None, None, None, -1))
    of_events = jax.vmap(of_particles, (-1, -1, 0, 0))
    hypothesis = Hypothesis(U, line, jnp.sqrt((U**2).sum(1) + 1e-12))
    distances = jax.vmap(lambda d, age: of_events(d, age, before, hypothesis), (1, 0))
    least = jnp.where(there[..., None], distances(d, age), jnp.inf).min(0)
    loss = jnp.where(batch.valid[:, None], jnp.minimum(least, most), 0)
    return -params.alpha_literal * loss
