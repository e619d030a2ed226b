"""The particle filter: propagate, score, weigh, tell the mean, resample, batch after batch."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.nn import logsumexp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from jaxevent.devices import full_precision
from jaxevent.egomotion.candidates import Candidates
from jaxevent.egomotion.models import Model
from jaxevent.egomotion.particle_filter.likelihood import score
from jaxevent.egomotion.particle_filter.parameters import Params

HISTORY = 5.0  # over how many times `memory` it is learnt how many votes are usual
JITTER = 0.1  # noise of particles while searching, per batch, in standard deviations of the cloud
STEP = 0.5  # largest standard deviation over particles of a batch's log weights while searching


class Noise(eqx.Module):
    """All random numbers of a stretch of batches."""

    normal: Float[Array, "batches N d"]
    uniform: Float[Array, " batches"]
    cloud: Float[Array, "N d"]  # in [-1, 1]; where a search begins in this stretch


class State(eqx.Module):
    """What is carried from batch to batch."""

    particles: Float[Array, "N d"]
    log_weights: Float[Array, " N"]  # normalised
    searching: Bool[Array, ""]
    votes: Float[Array, ""]  # of the cloud, lately
    chance: Float[Array, ""]  # of candidates without order, lately
    usual: Float[Array, ""]  # what votes / chance has been since the motion was found
    age: Float[Array, ""]  # batches since then


class Info(eqx.Module):
    """What a batch tells; an axis of batches leads where stacked."""

    mean: Float[Array, "*batches d"]  # before resampling
    covariance: Float[Array, "*batches d d"]  # of the weighted particles
    searching: Bool[Array, "*batches"]
    contrast: Float[Array, "*batches"]  # votes in units of chance's
    lag: Float[Array, "*batches"]  # s, how much older than the last event is what is seen
    evidence: Float[Array, "*batches"]  # log of the mean likelihood of the batch
    cloud: Float[Array, "*batches thinned d"]  # some particles, in proportion to weights


class Passed(eqx.Module):
    """A batch's times, and whether it holds an event."""

    elapsed: Float[Array, ""]
    history: Float[Array, ""]
    some: Bool[Array, ""]


class Told(eqx.Module):
    """What all events of a batch say: see `Score`."""

    log_likelihood: Float[Array, " N"]
    votes: Float[Array, ""]
    chance: Float[Array, ""]


class Weighed(eqx.Module):
    """Particles after a batch, and what becomes of the state and of what is told."""

    log_weights: Float[Array, " N"]
    mean: Float[Array, " d"]
    covariance: Float[Array, "d d"]
    contrast: Float[Array, ""]
    evidence: Float[Array, ""]
    sound: Bool[Array, ""]  # whether all numbers are finite
    lost: Bool[Array, ""]
    searching: Bool[Array, ""]  # as it is told
    searches: Bool[Array, ""]  # and as it goes on
    few: Bool[Array, ""]  # whether few particles are effective
    votes: Float[Array, ""]
    chance: Float[Array, ""]
    usual: Float[Array, ""]
    age: Float[Array, ""]


def draw(key: PRNGKeyArray | Array, batches: int, params: Params, model: Model) -> Noise:
    """The random numbers of so many batches, at once: one by one they cost more than all else.

    The same key gives the same numbers, in single or double precision as JAX is set.
    """
    one, two, three = jax.random.split(key, 3)
    N, real = params.particles, jnp.result_type(float)
    return Noise(
        jax.random.normal(one, (batches, N, model.dimension), real),
        jax.random.uniform(two, (batches,), real),
        jax.random.uniform(three, (N, model.dimension), real, -1, 1),
    )


def begin(params: Params, model: Model, noise: Noise) -> State:
    """Nothing known: particles everywhere."""
    state = around(params, anywhere(params, model, noise))
    return eqx.tree_at(lambda s: s.searching, state, jnp.asarray(params.likelihood != "literal"))


def around(params: Params, particles: Float[Array, "N d"]) -> State:
    """Particles that are about right."""
    N, zero = params.particles, jnp.zeros((), particles.dtype)
    even = jnp.full(N, -jnp.log(N), particles.dtype)
    return State(particles, even, jnp.asarray(False), zero, zero, zero, zero)


def anywhere(params: Params, model: Model, noise: Noise) -> Float[Array, "N d"]:
    """First particles."""
    return jax.vmap(functools.partial(model.first, params))(noise.cloud)


def resample(
    log_weights: Float[Array, " N"], uniform: Float[Array, ""]
) -> tuple[Int[Array, " N"], Float[Array, " N"]]:
    """Systematic resampling: whom each particle descends from, and the new log weights.

    The weights' gradient goes on: lw_new = -log N + (lw - stop_gradient(lw))[ancestor], whose value
    is 1/N and whose derivative is the ancestor's score (Scibior & Wood, "Differentiable Particle
    Filtering without Modifying the Forward Pass"). Without that the gradient is biased.
    """
    N = len(log_weights)
    ancestor = _drawn(jnp.exp(lax.stop_gradient(log_weights)), N, uniform)
    carried = log_weights - lax.stop_gradient(log_weights)
    return ancestor, carried[ancestor] - jnp.log(N).astype(log_weights.dtype)


def _drawn(
    weights: Float[Array, " N"], number: int, uniform: Float[Array, ""]
) -> Int[Array, " number"]:
    """Particles at even steps of their summed weights."""
    edges = jnp.cumsum(weights)
    points = (jnp.arange(number) + uniform) * (edges[-1] / number)
    return jnp.minimum((edges[None, :] <= points[:, None]).sum(1), len(weights) - 1)


def propagate(
    params: Params,
    model: Model,
    state: State,
    passed: Passed,
    normal: Float[Array, "N d"],
) -> tuple[Float[Array, "N d"], Float[Array, " N"]]:
    """Particles at a batch's end, before it is looked at, and their weights."""
    weights = jnp.exp(state.log_weights)
    mean = model.mean(state.particles, weights)
    apart = jax.vmap(model.apart, (0, None))
    fixed, far = lax.stop_gradient((weights, apart(state.particles, mean)))
    spread = model.spreads(_covariance(far, fixed))
    std = model.diffusion(params, mean) * jnp.sqrt(passed.elapsed)
    enough = _covered(params, model, passed) & passed.some
    jitter = JITTER * spread * enough * model.share(state.particles, fixed)
    noise = jnp.where(state.searching, jitter, std) * normal
    return jax.vmap(model.moved)(state.particles, noise), weights


def _covered(params: Params, model: Model, passed: Passed) -> Bool[Array, ""]:
    """With less history than slow hypotheses look at, only fast ones find candidates."""
    return passed.history >= 0.99 * lax.stop_gradient(model.oldest(params))


def weigh(
    params: Params,
    model: Model,
    state: State,
    passed: Passed,
    particles: Float[Array, "N d"],
    told: Told,
) -> Weighed:
    """What particles are worth after a batch; and whether the motion is found, or lost."""
    N, searching = params.particles, state.searching
    covered = _covered(params, model, passed)
    gain, fixed = told.log_likelihood, lax.stop_gradient(told.log_likelihood)
    deviation = jnp.sqrt(((fixed - fixed.sum() / N) ** 2).sum() / N + 1e-12)
    gain = gain * jnp.where(searching, jnp.minimum(1, STEP / deviation) * covered, 1)
    joint = state.log_weights + gain
    evidence = logsumexp(joint)
    log_weights = joint - evidence
    weights = jnp.exp(log_weights)
    mean = model.mean(particles, weights)
    apart = jax.vmap(model.apart, (0, None))
    covariance = _covariance(apart(particles, mean), weights)

    memory = jnp.exp(-1 / lax.stop_gradient(params.memory))
    votes, chance = memory * state.votes + told.votes, memory * state.chance + told.chance
    contrast = jnp.where(chance > 0, votes / jnp.where(chance > 0, chance, 1), 1)
    counted = told.chance > 0
    age = state.age + counted
    sound = jnp.isfinite(evidence) & jnp.isfinite(particles).all()
    searches = params.likelihood != "literal"
    certain = model.certain(*lax.stop_gradient((params, mean, covariance)))
    found = searching & covered & counted & certain
    forget = (1 - memory) / HISTORY
    usual = state.usual + jnp.where(counted, forget * (contrast - state.usual), 0)
    least = lax.stop_gradient(params.drop * usual)
    if not model.half_line:  # there chance's votes along a half-line are most of them
        least = jnp.maximum(lax.stop_gradient(params.contrast), least)
    poor = ~searching & (age > params.memory) & (contrast < least)
    lost = ~sound | (poor & searches)
    over = lost | found
    return Weighed(
        log_weights,
        mean,
        covariance,
        jnp.where(sound, contrast, 0),
        jnp.where(sound, evidence, 0),
        sound,
        lost,
        (searching & ~found) | lost,
        (searching & ~found) | (lost & searches),
        1 / (weights**2).sum() <= params.resample_below * N,
        *(jnp.where(over, 0, value) for value in (votes, chance, usual, age)),
    )


def restart(
    params: Params, model: Model, cloud: Float[Array, "N d"]
) -> tuple[Float[Array, "N d"], Float[Array, " d"], Float[Array, "d d"]]:
    """First particles of a search, from even numbers; their mean, and how wide they are."""
    anew = jax.vmap(functools.partial(model.first, params))(cloud)
    even = jnp.full(len(anew), 1 / params.particles, anew.dtype)
    return anew, model.mean(anew, even), jnp.eye(model.dimension) * model.extent(params) ** 2 / 3


def step(
    params: Params,
    model: Model,
    state: State,
    batch: Candidates,
    normal: Float[Array, "N d"],
    uniform: Float[Array, ""],
    cloud: Float[Array, "N d"],
    thinned: int = 0,
) -> tuple[State, Info]:
    """One batch: propagate, score, weigh, tell the mean, resample; search where it is lost.

    `cloud` are even numbers, of which a new search makes particles; `thinned` particles, drawn by
    weight, are told.
    """
    passed = Passed(*map(jnp.asarray, (batch.elapsed, batch.history, batch.valid.any())))
    particles, before = propagate(params, model, state, passed, normal)
    voted = score(params, model, batch, particles, before, state.searching)
    told = Told(voted.log_likelihood.sum(0), voted.votes, voted.chance)
    found = weigh(params, model, state, passed, particles, told)

    weights = jnp.exp(found.log_weights)
    shown = particles[_drawn(weights, thinned, jnp.asarray(0.5))] if thinned else particles[:0]
    ancestor, renewed = resample(found.log_weights, uniform)
    particles = jnp.where(found.few, particles[ancestor], particles)
    log_weights = jnp.where(found.few, renewed, found.log_weights)
    anew, middle, widest = restart(params, model, cloud)
    after = State(
        jnp.where(found.lost, anew, particles),
        jnp.where(found.lost, -jnp.log(params.particles), log_weights),
        found.searches,
        found.votes,
        found.chance,
        found.usual,
        found.age,
    )
    info = Info(
        jnp.where(found.sound, found.mean, middle),
        jnp.where(found.sound, found.covariance, widest),
        found.searching,
        found.contrast,
        voted.lag,
        found.evidence,
        jnp.where(found.sound, shown, 0),
    )
    return after, info


@full_precision
def _covariance(apart: Float[Array, "N d"], weights: Float[Array, " N"]) -> Float[Array, "d d"]:
    return (apart * weights[:, None]).T @ apart


def run(
    params: Params,
    model: Model,
    candidates: Candidates,
    noise: Noise,
    state: State | None = None,
    thinned: int = 0,
) -> tuple[State, Info]:
    """The filter over stacked batches: pure, differentiable, and vmap-able over all its arguments.

    Without `state` it begins with a wide cloud; `thinned` particles of each batch are told.
    Derivatives are those of weights and particles while the motion is followed; ranges of ages,
    when to resample and all that a search adds are held fixed.
    """
    state = begin(params, model, noise) if state is None else state

    def body(state, at):
        batch, normal, uniform = at
        return step(params, model, state, batch, normal, uniform, noise.cloud, thinned)

    batches = jax.tree.map(jnp.asarray, candidates)
    return lax.scan(body, state, (batches, noise.normal, noise.uniform))
