"""What candidates say of hypotheses: the votes of an event for a motion, and what chance would.

The functions that are equations of the thesis are of one candidate, one event and one particle, in
scalars; `ask`, `add_votes` and `answer` map them over the particles of one event, and `score` over
events (`fused` makes loops of them). Shapes: K events, N particles, which are the last axis, C
candidates.
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
from jaxevent.egomotion.particle_filter.parameters import Params

WIDER = 2.0  # sigma_x while searching, in sigma_x
LEAST = 0.2  # votes of chance per event; a point that moves alone gets about 1.5
PAD = 2.0  # sigma_x, how far within the sensor an event must have come from to be asked
TIE = 1e-6  # of an age
BLOCK = 8  # candidates per event that are scored together


class Score(NamedTuple):
    """What a batch says: of every particle, and how much more than chance votes for them."""

    log_likelihood: Float[Array, "K N"]
    votes: Float[Array, ""]
    chance: Float[Array, ""]
    lag: Float[Array, ""]


class Event(eqx.Module):
    """One event, or K, but for candidates; see `Candidates`."""

    xi: Float[Array, "*K 2"]
    room: Float[Array, "*K 2 2"]
    valid: Bool[Array, "*K"]
    scale: Float[Array, "*K"]
    rate: Float[Array, "*K"]


class Common(eqx.Module):
    """What holds for an event, or K, whatever the particle."""

    tau: Float[Array, "*K"]  # s, age of the oldest candidates of a motion that is about known
    asked: Bool[Array, "*K"]  # whether it counts while the motion is followed
    searched: Bool[Array, "*K"]  # and where every hypothesis has ages of its own


class Ages(eqx.Module):
    """From which to which age (s) candidates are looked at."""

    youngest: Float[Array, "*K_N"]
    oldest: Float[Array, "*K_N"]


def common(params: Params, model: Model, event: Event, usual: Float[Array, "2"]) -> Common:
    """Of an event, where `usual` (px/s) is the cloud's mean flow.

    tau = b / |U_mean|. It is not asked if what it shows would have come from outside the sensor.
    """
    b = params.baseline
    # A little less: room is often in whole px, as b may be, but for rounding.
    everywhere = jnp.minimum(-event.room[0], event.room[1]).min() >= 0.99 * b
    if model.half_line:
        return Common(params.tau_general, event.valid & everywhere, event.valid & everywhere)
    tau = jnp.minimum(b / jnp.sqrt((usual**2).sum() + 1e-12), params.tau_max)
    pad, back = PAD * params.sigma_x, usual * tau
    there = ((back >= event.room[0] + pad) & (back <= event.room[1] - pad)).all()
    return Common(tau, event.valid & there, event.valid & everywhere)


def ages(
    params: Params, common: Common, speed: Float[Array, ""], band: Bool[Array, ""] | bool
) -> Ages:
    """dt_c in [0.7 tau, tau]; in a `band` [0.7 b, b] / |U_i| for a flow of that speed (px/s).

    Times are in whole microseconds, as the limits often are: rounding must not part them.
    """
    own = params.baseline / speed
    return Ages(
        (1 - TIE) * params.youngest * jnp.where(band, own, common.tau),
        (1 + TIE) * jnp.where(band, jnp.minimum(own, params.tau_max), common.tau),
    )


def vote(
    d: tuple[Float[Array, ""], Float[Array, ""]],
    dt: Float[Array, ""],
    U: Float[Array, "2"],
    line: Float[Array, "2"] | None,
    ages: Ages,
    exponent: Float[Array, ""],
    rho_max: Float[Array, ""],
) -> Float[Array, ""]:
    """exp(exponent r_c^2) of a candidate at d (px), of age dt (s); 0 of an age not asked for.

    r_c is the distance of d_c from U dt_c, or from the half-line that begins there.
    """
    x, y = d[0] - U[0] * dt, d[1] - U[1] * dt
    distance2 = x**2 + y**2
    if line is not None:
        s = x * line[0] + y * line[1]
        to = jnp.clip(s, 0, rho_max * dt)
        distance2 = distance2 + to * (to - 2 * s)
    inside = (dt >= ages.youngest) & (dt <= ages.oldest)
    return jnp.where(inside, jnp.exp(distance2 * exponent), 0)


def gain(
    params: Params, S: Float[Array, ""], rate: Float[Array, ""], seen: Bool[Array, ""]
) -> Float[Array, ""]:
    """log w += alpha log(1 + S / s0): of an event and a particle for which S candidates vote."""
    return jnp.where(seen, params.alpha * jnp.log1p(S * rate / params.s0), 0)


def chance(
    params: Params,
    model: Model,
    event: Event,
    tau: Float[Array, ""],
    sigma: Float[Array, ""],
    reach: int | Float[Array, ""],
) -> Float[Array, ""]:
    """How many votes an event would get of candidates without order.

    That of as many candidates of the common range of ages anywhere in the window: 2 pi sigma_x^2 /
    (2 R + 1)^2 each, and at least `LEAST`, so that a motion so fast that no candidate is young
    enough counts as one that explains nothing.
    """
    number = event.rate * (1 - params.youngest) * tau
    # The area of a vote, (px^2) over that of the window; of a half-line it is a strip's.
    area = jnp.sqrt(2 * jnp.pi) * sigma
    area = area * (area / 2 + reach if model.half_line else area)
    return jnp.maximum(number * (area / (2 * reach + 1) ** 2), LEAST)


class Asked(eqx.Module):
    """What an event, or K, ask of particles before candidates vote."""

    U: Float[Array, "*K 2 N"]
    line: Float[Array, "*K 2 N"] | None
    ages: Ages
    rate: Float[Array, "*K_N"]  # of votes, in a band; else 1
    seen: Bool[Array, "*K"]  # whether it counts
    tau: Float[Array, "*K"]


def ask(
    params: Params,
    model: Model,
    event: Event,
    particles: Float[Array, "N d"],
    weights: Float[Array, " N"],
    searching: Bool[Array, ""] | bool,
) -> Asked:
    """What one event asks of all particles."""
    U = jax.vmap(model.flow, (None, 0), -1)(event.xi, particles)
    line = jax.vmap(model.line, (None, 0), -1)(event.xi, particles) if model.half_line else None
    speed = jax.vmap(_speed, -1)(U)
    fixed, now, usual = lax.stop_gradient((params, speed, (U * weights).sum(-1)))
    shared = common(fixed, model, event, usual)
    band = _in_band(params, model, searching)
    looked = jax.vmap(functools.partial(ages, fixed, shared, band=band))(now)
    rate = jnp.where(band, speed / jnp.maximum((speed * weights).sum(), 1e-12), 1)
    seen = jnp.where(band, shared.searched, shared.asked)
    return Asked(U, line, looked, rate, seen, jnp.where(event.valid, shared.tau, 0))


def _in_band(
    params: Params, model: Model, searching: Bool[Array, ""] | bool
) -> Bool[Array, ""] | bool:
    """Whether every hypothesis has ages of its own."""
    if model.half_line:
        return False
    return True if params.likelihood == "band" else searching


def spread(params: Params, searching: Bool[Array, ""] | bool) -> Float[Array, ""]:
    """sigma_x of votes (px)."""
    return params.sigma_x * jnp.where(searching, WIDER, 1.0)


def add_votes(
    params: Params,
    d: Float[Array, "2"],
    dt: Float[Array, ""],
    asked: Asked,
    S: Float[Array, " N"],
    searching: Bool[Array, ""] | bool,
) -> Float[Array, " N"]:
    """S with the votes of one more candidate of an event."""
    exponent, rho_max = -0.5 / spread(params, searching) ** 2, lax.stop_gradient(params.rho_max)
    looked = jax.tree.map(lambda age: jnp.broadcast_to(age, S.shape), asked.ages)
    line = None if asked.line is None else 1
    over = jax.vmap(vote, (None, None, 1, line, 0, None, None))
    return S + over((d[0], d[1]), dt, asked.U, asked.line, looked, exponent, rho_max)


class Answer(NamedTuple):
    """What an event, or K, say of particles after its candidates have voted."""

    log_likelihood: Float[Array, "*K N"]
    votes: Float[Array, "*K"]
    chance: Float[Array, "*K"]


def answer(
    params: Params,
    model: Model,
    event: Event,
    asked: Asked,
    S: Float[Array, " N"],
    weights: Float[Array, " N"],
    searching: Bool[Array, ""] | bool,
    reach: int | Float[Array, ""],
) -> Answer:
    """Of one event, and a window that reaches so far (px)."""
    S = S * event.scale
    rate = jnp.broadcast_to(asked.rate, S.shape)
    log_likelihood = jax.vmap(functools.partial(gain, params), (0, 0, None))(S, rate, asked.seen)
    fixed, sigma = lax.stop_gradient((params, spread(params, searching)))
    by_chance = chance(fixed, model, event, asked.tau, sigma, reach)
    votes = (lax.stop_gradient(S) * lax.stop_gradient(weights)).sum()
    return Answer(
        log_likelihood, jnp.where(asked.seen, votes, 0), jnp.where(asked.seen, by_chance, 0)
    )


def lag(params: Params, tau: Float[Array, ""]) -> Float[Array, ""]:
    """Candidates of one age see the mean flow since then, that of half the age ago."""
    return (1 + lax.stop_gradient(params.youngest)) / 4 * tau


def score(
    params: Params,
    model: Model,
    batch: Candidates,
    particles: Float[Array, "N d"],
    weights: Float[Array, " N"],
    searching: Bool[Array, ""] | bool,
) -> Score:
    """What a batch says of all particles, and how much more than chance votes for them."""
    event = Event(*map(jnp.asarray, (batch.xi, batch.room, batch.valid, batch.scale, batch.rate)))
    asking = functools.partial(ask, params, model, weights=weights, searching=searching)
    asked = jax.vmap(asking, (0, None))(event, particles)
    number = jnp.maximum(event.valid.sum(), 1)
    seen_ago = lag(params, asked.tau.sum() / number)
    if params.likelihood == "literal":
        one = jnp.ones((), particles.dtype)
        return Score(_literal(params, model, batch, asked.U, asked.line), one, one, seen_ago)
    S = _sum(params, batch, asked, searching)
    answering = functools.partial(
        answer, params, model, weights=weights, searching=searching, reach=batch.reach
    )
    told = jax.vmap(answering)(event, asked, S)
    return Score(told.log_likelihood, told.votes.sum(), told.chance.sum(), seen_ago)


def _speed(U: Float[Array, "2"]) -> Float[Array, ""]:
    return jnp.sqrt((U**2).sum() + 1e-12)


def _sum(
    params: Params, batch: Candidates, asked: Asked, searching: Bool[Array, ""] | bool
) -> Float[Array, "K N"]:
    """S = sum_c `vote` over candidates of the ages asked for.

    Candidates fill their places from the first, so the later blocks of most batches hold none and
    are skipped: by a condition outside of the maps, within which both sides would be computed.
    """
    K, C = batch.age.shape
    pad = -C % BLOCK
    age = jnp.pad(jnp.asarray(batch.age), [(0, 0), (0, pad)]).T.reshape(-1, BLOCK, K)
    d = jnp.pad(jnp.asarray(batch.d), [(0, 0), (0, pad), (0, 0)])
    d = jnp.swapaxes(d, 0, 1).reshape(-1, BLOCK, K, 2)
    votes = jax.vmap(functools.partial(add_votes, params, searching=searching))

    def add(S, d, age):
        for c in range(BLOCK):
            S = votes(d[c], age[c], asked, S)
        return S

    def body(S, block):
        return lax.cond((block[1] > 0).any(), add, lambda S, *_: S, S, *block), None

    return lax.scan(body, jnp.zeros_like(asked.U[:, 0]), (d, age))[0]


def miss(
    params: Params,
    model: Model,
    d: Float[Array, "2"],
    age: Float[Array, ""],
    before: Float[Array, ""],
    U: Float[Array, "2"],
    line: Float[Array, "2"] | None,
    speed: Float[Array, ""],
) -> Float[Array, ""]:
    """How far (px) a candidate is off the one that a hypothesis expects, as the thesis has it.

    Of a uniform flow eqs 5.2, 5.3, 5.7, else 6.9 to 6.16, with distances in px. 6.12 is printed as
    a norm and squared, in px^2/s^2, and 6.9 is signed, in px^2/s; only px suit V_max = 2 to 3 and
    r_t in px/s. So 6.9 is taken as |F| dt / |A T|, the distance from the whole line of all depths,
    positive or not. The time penalty of 6.10 compares with the last event at the same pixel, whose
    age is `before`; where that is infinite, there is no penalty.
    """
    if model.uniform:
        past = 1 / speed if params.horizon == "crossing" else params.past
        ex, ey, late = d[0] - U[0] * past, d[1] - U[1] * past, age - past
    else:
        late = jnp.where(jnp.isfinite(before), age - before, 0)
        ex, ey = d[0] - U[0] * age, d[1] - U[1] * age
        if line is not None:
            ex, ey = ex * line[1] - ey * line[0], jnp.zeros_like(ex)
    return jnp.sqrt(ex**2 + ey**2 + 1e-12) + params.r_t * jnp.abs(late)


def along_edge(
    params: Params,
    d: Float[Array, "2 C"],
    age: Float[Array, " C"],
    last: Float[Array, ""],
) -> Bool[Array, " C"]:
    """Which candidates of an event fired along one edge with it, across the motion (6.6.5).

    Such a one is younger than `params.edge`, and the event before it at its pixel is as near in
    time to the one before at the event's own pixel, of age `last`. In the thesis' words both lie
    "within a very small time window", which it does not tell.
    """
    same = (d[:, :, None] == d[:, None, :]).all(0)
    before = jnp.where(same & (age[None] > age[:, None]), age[None], jnp.inf).min(1)
    together = jnp.isfinite(before) & (jnp.abs(before - last) <= params.edge)
    return (age > 0) & (age <= params.edge) & together


def _literal(
    params: Params,
    model: Model,
    batch: Candidates,
    U: Float[Array, "K 2 N"],
    line: Float[Array, "K 2 N"] | None,
) -> Float[Array, "K N"]:
    """-alpha_p times the least `miss` of an event's candidates, which is at most d_max or V_max.

    The last event at the same pixel is itself no candidate where the flow is not uniform: to a
    camera that does not move it would always be the best.
    """
    d, age = jnp.moveaxis(jnp.asarray(batch.d), -1, 0), jnp.asarray(batch.age).T
    d = jnp.swapaxes(d, 1, 2)
    there, before, most = age > 0, jnp.full_like(age[0], jnp.inf), params.d_max
    own = there & (d == 0).all(0)
    last = jnp.where(own, age, jnp.inf).min(0)
    edge = jax.vmap(functools.partial(along_edge, params), -1, -1)
    there &= ~lax.cond(params.edge > 0, edge, lambda d, age, last: age < 0, d, age, last)
    if not model.uniform:
        before, there, most = last, there & ~own, params.V_max
    of_particles = jax.vmap(functools.partial(miss, params, model), (*[None] * 3, -1, -1, -1))
    of_events = jax.vmap(of_particles, (-1, -1, 0, 0, 0, 0))
    speed = jnp.sqrt((U**2).sum(1) + 1e-12)
    misses = jax.vmap(lambda d, age: of_events(d, age, before, U, line, speed), (1, 0))
    least = jnp.where(there[..., None], misses(d, age), jnp.inf).min(0)
    loss = jnp.where(batch.valid[:, None], jnp.minimum(least, most), 0)
    return -params.alpha_literal * loss
