"""The particle filter: propagate, score, weigh, tell the mean, resample, batch after batch."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.nn import logsumexp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

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
    N, searching = params.particles, state.searching
    weights = jnp.exp(state.log_weights)
    mean = model.mean(state.particles, weights)
    apart = jax.vmap(model.apart, (0, None))
    fixed, far = lax.stop_gradient((weights, apart(state.particles, mean)))
    spread = model.spreads(_covariance(far, fixed))
    std = model.diffusion(params, mean) * jnp.sqrt(batch.elapsed)
    # With less history than slow hypotheses look at, only fast ones find candidates.
    covered = batch.history >= 0.99 * lax.stop_gradient(model.oldest(params))
    jitter = JITTER * spread * (covered & batch.valid.any()) * model.share(state.particles, fixed)
    noise = jnp.where(searching, jitter, std) * normal
    particles = jax.vmap(model.moved)(state.particles, noise)

    voted = score(params, model, batch, particles, weights, searching)
    gain = voted.log_likelihood.sum(0)
    deviation = jnp.sqrt(lax.stop_gradient(gain).var() + 1e-12)
    gain = gain * jnp.where(searching, jnp.minimum(1, STEP / deviation) * covered, 1)
    joint = state.log_weights + gain
    evidence = logsumexp(joint)
    log_weights = joint - evidence
    weights = jnp.exp(log_weights)
    mean = model.mean(particles, weights)
    covariance = _covariance(apart(particles, mean), weights)

    memory = jnp.exp(-1 / lax.stop_gradient(params.memory))
    votes, chance = memory * state.votes + voted.votes, memory * state.chance + voted.chance
    contrast = jnp.where(chance > 0, votes / jnp.where(chance > 0, chance, 1), 1)
    counted = voted.chance > 0
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

    few = 1 / (weights**2).sum() <= params.resample_below * N
    shown = particles[_drawn(weights, thinned, jnp.asarray(0.5))] if thinned else particles[:0]
    ancestor, renewed = resample(log_weights, uniform)
    particles = jnp.where(few, particles[ancestor], particles)
    log_weights = jnp.where(few, renewed, log_weights)

    anew = jax.vmap(functools.partial(model.first, params))(cloud)
    over = lost | found
    after = State(
        jnp.where(lost, anew, particles),
        jnp.where(lost, -jnp.log(N), log_weights),
        (searching & ~found) | (lost & searches),
        jnp.where(over, 0, votes),
        jnp.where(over, 0, chance),
        jnp.where(over, 0, usual),
        jnp.where(over, 0, age),
    )
    info = Info(
        jnp.where(sound, mean, model.mean(anew, jnp.full(N, 1 / N, anew.dtype))),
        jnp.where(sound, covariance, jnp.eye(model.dimension) * model.extent(params) ** 2 / 3),
        (searching & ~found) | lost,
        jnp.where(sound, contrast, 0),
        voted.lag,
        jnp.where(sound, evidence, 0),
        jnp.where(sound, shown, 0),
    )
    return after, info


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
