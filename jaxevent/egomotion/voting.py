"""Planar and rotational motion by voting: a particle filter whose likelihood asks the candidates.

After the thesis' chapters 5 and 6 (eqs 5.1 to 5.8, 6.9 to 6.16), with one deviation. There an event
votes with its single best candidate (a hard minimum), and on a grid of pixels that locks the motion
to whole pixels per candidate's age; `likelihood="literal"` does it, for comparison, and is biased.
By default all candidates vote, softly, over a baseline of several pixels:

    S = sum_c exp(-|d_c - U dt_c|^2 / (2 sigma_x^2)),  dt_c in [tau/2, tau],  tau = b / |U_mean|
    log w += alpha log(1 + S / s0)

A common tau serves only a motion that is about known. To find it, at the start and when it is lost,
every hypothesis is given the ages in which it crosses the baseline itself ("band"):

    dt_c in [b/2, b] / |U_i|,  log w += alpha log(1 + S |U_i| / (U_ref s0))

where |U_i| undoes that a fast hypothesis looks at fewer candidates, and U_ref is the mean of |U_i|.
The search starts when events have come for tau_max: before, only fast hypotheses have candidates,
and they win. It is annealed: a batch's log weights are scaled down to a small spread, sigma_x is
doubled and noise in proportion to the cloud's spread replaces the process noise.
Motion is the camera's: a camera that turns by Omega sees the flow B(x) Omega; planar motion is the
image velocity itself.
"""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.nn import logsumexp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray
from numpy.typing import NDArray
from tqdm import tqdm

from jaxevent.camera import PinholeCamera
from jaxevent.egomotion.candidates import Candidates, Gatherer
from jaxevent.egomotion.geometry import B
from jaxevent.egomotion.motion import Motion
from jaxevent.errors import InputError
from jaxevent.parameters import Choice, Count, Number, Parameters, Positive, nearest
from jaxevent.recording import Recording

CHUNK = 1024  # scored events after which the host looks where the motion is
MODELS = ("planar", "rotation")
LAG = 0.375  # of tau: candidates of ages tau/2 to tau see the flow of 3 tau / 8 ago
WIDER = 2.0  # sigma_x while searching, in sigma_x
LEAST = 0.2  # votes of chance per event; a point that moves alone gets about 1.5
HISTORY = 5.0  # over how many times `memory` it is learnt how many votes are usual
BLOCK = 8  # candidates per event that are scored together
JITTER = 0.1  # noise of particles while searching, per batch, in standard deviations of the cloud
STEP = 0.5  # largest standard deviation over particles of a batch's log weights while searching


class Params(Parameters):
    """Parameters of motion by voting: candidates, filter, likelihood."""

    likelihood = Choice(
        ("soft", "band", "literal"),
        "all candidates of a common range of ages; of each hypothesis' own; the thesis' (biased)",
    )
    undistort = Choice((True, False), "displacements in undistorted px, where there is a camera")

    radius = Count(6, "px", "candidates are so near, in x and y; baseline + 1.5 or more")
    per_pixel = Count(8, "", "latest events of a pixel that are candidates")
    candidates = Count(128, "", "most candidates of an event; of more, these many in even steps")
    every = Count(8, "", "one event in so many is scored; neighbours are correlated")
    batch = Count(64, "", "scored events per update of the weights; 1: one by one, as the thesis")
    longest = Positive(0.01, "s", "a batch with fewer events than that ends after this time")
    particles = Count(200, "", "")

    baseline = Positive(4.5, "px", "b: how far a point moves in the ages that are looked at")
    tau_max = Positive(0.1, "s", "oldest candidates; 2 b / (expected speed)")
    sigma_x = Positive(0.6, "px", "spread of a candidate; from 0.5 the pixel grid does not show")
    s0 = Positive(10.0, "", "score from which an event's vote grows like its logarithm")
    alpha = Positive(2.5, "", "weight of one event's vote; larger with larger `every`")
    noise = Positive(0.5, "1/sqrt(s)", "planar: change of the velocity, in shares of the speed")
    noise_rotation = Positive(3.0, "rad/s/sqrt(s)", "rotation: change of the angular velocity")
    resample_below = Number(0.5, "", "resample when so many of the particles are effective; 0: not")

    speed_max = Positive(600.0, "px/s", "planar: the first particles are in +- this")
    omega_max = Positive(4.0, "rad/s", "rotation: the first particles are in +- this")
    found = Positive(0.12, "", "search ends when each component's spread is this share of the mean")
    contrast = Positive(1.1, "", "search anew when votes are fewer than this, in chance's votes")
    drop = Positive(0.25, "", "or fewer than this share of what they were")
    memory = Positive(6.0, "", "batches over which votes are counted for that")

    alpha_literal = Positive(2.0, "1/px", "literal: decay of the likelihood (alpha_p)")
    r_t = Positive(1e4, "px/s", "literal: penalty of a wrong time")
    d_max = Positive(4.0, "px", "literal, planar: largest distance")
    V_max = Positive(3.0, "px", "literal, rotation: largest distance")
    horizon = Choice(
        ("crossing", "fixed"),
        "literal, planar: the predecessor was when the hypothesis was 1 px back, or at `past`",
    )
    past = Positive(50e-6, "s", "literal, planar: age of the predecessor, if fixed")


class Model(eqx.Module):
    """A motion of `dimension` components, linear in the flow it makes: U = basis(xi) @ motion.

    "planar": the image velocity (px/s). "rotation": the camera's angular velocity (rad/s), and the
    basis is `geometry.B`, eq 6.1 with its misprint mended.
    """

    name: str = eqx.field(static=True)
    f: float = eqx.field(static=True, default=1.0)  # px; "rotation"

    @property
    def dimension(self) -> int:
        return 2 if self.name == "planar" else 3

    def basis(self, xi: Float[Array, "K 2"]) -> Float[Array, "K 2 dimension"]:
        """How the components of the motion move the image at xi (px, from the principal point)."""
        if self.name == "planar":
            return jnp.broadcast_to(jnp.eye(2, dtype=xi.dtype), (len(xi), 2, 2))
        return B(xi[:, 0], xi[:, 1], jnp.asarray(self.f, xi.dtype))

    def extent(self, params: Params) -> Float[Array, ""]:
        """Half the width of the first cloud."""
        return params.speed_max if self.name == "planar" else params.omega_max

    def diffusion(
        self, params: Params, mean: Float[Array, " dimension"]
    ) -> Float[Array, ""]:  # fmt: skip
        """Process noise per sqrt(s). Planar: the share of a speed at least baseline / tau_max."""
        if self.name == "rotation":
            return params.noise_rotation
        return params.noise * jnp.sqrt((mean**2).sum() + (params.baseline / params.tau_max) ** 2)


class Noise(eqx.Module):
    """All random numbers of a stretch of batches."""

    normal: Float[Array, "batches N dimension"]
    uniform: Float[Array, " batches"]
    cloud: Float[Array, "N dimension"]  # in [-1, 1]; where a search begins in this stretch


class Carry(eqx.Module):
    particles: Float[Array, "N dimension"]
    log_weights: Float[Array, " N"]  # normalised
    searching: Bool[Array, ""]
    votes: Float[Array, ""]  # of the cloud, lately
    chance: Float[Array, ""]  # of candidates without order, lately
    usual: Float[Array, ""]  # what votes / chance has been since the motion was found
    age: Float[Array, ""]  # batches since then


class Told(eqx.Module):
    """What a batch tells; an axis of batches leads where stacked."""

    mean: Float[Array, "*batches dimension"]  # before resampling
    covariance: Float[Array, "*batches dimension dimension"]  # of the weighted particles
    searching: Bool[Array, "*batches"]
    contrast: Float[Array, "*batches"]  # votes in units of chance's
    lag: Float[
        Array, "*batches"
    ]  # s; so much earlier than the last event is the motion that is seen
    evidence: Float[Array, "*batches"]  # log of the mean likelihood of the batch


class Score(NamedTuple):
    log_likelihood: Float[Array, "K N"]
    votes: Float[Array, ""]
    chance: Float[Array, ""]
    lag: Float[Array, ""]


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


def begin(params: Params, model: Model, noise: Noise) -> Carry:
    """Nothing known: particles everywhere."""
    cloud = noise.cloud * lax.stop_gradient(model.extent(params))
    N, zero = params.particles, jnp.zeros((), cloud.dtype)
    searching = jnp.asarray(params.likelihood != "literal")
    return Carry(cloud, jnp.full(N, -jnp.log(N), cloud.dtype), searching, zero, zero, zero, zero)


def score(
    params: Params,
    model: Model,
    batch: Candidates,
    particles: Float[Array, "N dimension"],
    weights: Float[Array, " N"],
    searching: Bool[Array, ""] | bool,
) -> Score:
    """Log-likelihoods of events for all particles, and how much more than chance votes for them.

    Chance's votes are those that as many candidates of the common range of ages would have anywhere
    in the window: 2 pi sigma_x^2 / (2 R + 1)^2 each, and per event at least `LEAST`, so that a
    motion so fast that no candidate is young enough counts as one that explains nothing.
    """
    basis = model.basis(jnp.asarray(batch.xi))
    U = jnp.einsum("kid,nd->ikn", basis, particles)
    speed = jnp.sqrt((U**2).sum(0) + 1e-12)  # K N
    fixed, now, usual = lax.stop_gradient((params, speed, U @ weights))
    usual = jnp.sqrt((usual**2).sum(0) + 1e-12)[:, None]  # K 1
    b = fixed.baseline
    tau = jnp.minimum(b / usual, fixed.tau_max)
    number = jnp.maximum(batch.valid.sum(), 1)
    lag = LAG * jnp.where(batch.valid, tau[:, 0], 0).sum() / number
    if params.likelihood == "literal":
        return _literal(params, model, batch, U, speed, lag)
    band = jnp.asarray(searching) | (params.likelihood == "band")
    youngest = jnp.where(band, b / (2 * now), tau / 2)
    oldest = jnp.where(band, jnp.minimum(b / now, fixed.tau_max), tau)
    sigma = params.sigma_x * jnp.where(searching, WIDER, 1.0)
    S = _sum(batch, U, youngest, oldest, -0.5 / sigma**2) * batch.scale[:, None]
    rate = jnp.where(band, speed / jnp.maximum(speed @ weights, 1e-12)[:, None], 1)
    gain = params.alpha * jnp.log1p(S * rate / params.s0)
    gain = jnp.where(batch.valid[:, None], gain, 0)
    ages = jnp.asarray(batch.age)
    common = ((ages >= tau[:, 0] / 2) & (ages <= tau[:, 0])).sum(0) * batch.scale
    density = 2 * jnp.pi * lax.stop_gradient(sigma) ** 2 / (2 * batch.reach + 1) ** 2
    chance = jnp.where(batch.valid, jnp.maximum(common * density, LEAST), 0).sum()
    votes = jnp.where(batch.valid, lax.stop_gradient(S) @ lax.stop_gradient(weights), 0).sum()
    return Score(gain, votes, chance, lag)


def _sum(
    batch: Candidates, U: Array, youngest: Array, oldest: Array, exponent: Array
) -> Float[Array, "K N"]:
    """sum_c exp(exponent |d_c - U dt_c|^2) over candidates of the ages asked for.

    Candidates fill their places from the first, so the later blocks of most batches hold none and
    are skipped. Particles are the last axis, along which everything is vectors.
    """
    C, K = batch.age.shape
    pad = -C % BLOCK
    age = jnp.pad(jnp.asarray(batch.age), [(0, pad), (0, 0)]).reshape(-1, BLOCK, K)
    d = jnp.pad(jnp.asarray(batch.d), [(0, 0), (0, pad), (0, 0)]).reshape(2, -1, BLOCK, K)

    def add(S, dx, dy, age):
        for c in range(BLOCK):
            dt = age[c, :, None]
            distance2 = (dx[c, :, None] - U[0] * dt) ** 2 + (dy[c, :, None] - U[1] * dt) ** 2
            inside = (dt >= youngest) & (dt <= oldest)
            S = S + jnp.where(inside, jnp.exp(distance2 * exponent), 0)
        return S

    def body(S, block):
        return lax.cond((block[2] > 0).any(), add, lambda S, *_: S, S, *block), None

    return lax.scan(body, jnp.zeros_like(U[0]), (d[0], d[1], age))[0]


def _literal(
    params: Params, model: Model, batch: Candidates, U: Array, speed: Array, lag: Array
) -> Score:
    """Planar: eqs 5.2, 5.3, 5.7; rotation: 6.9, 6.10, 6.13, 6.16 with distances in px.

    6.12 is printed as a norm and squared, in px^2/s^2; only px suit V_max = 2 to 3 and r_t in px/s.
    The time penalty of 6.10 compares with the last event at the same pixel; where there is none
    among the candidates, there is no penalty.
    """
    d, age = jnp.asarray(batch.d)[..., None], jnp.asarray(batch.age)[..., None]
    there = age > 0
    if model.name == "planar":
        past = 1 / speed if params.horizon == "crossing" else params.past
        ex, ey, late, most = d[0] - U[0] * past, d[1] - U[1] * past, age - past, params.d_max
    else:
        own = there & (d == 0).all(0)
        before = jnp.where(own, age, jnp.inf).min(0)
        late = jnp.where(jnp.isfinite(before), age - before, 0)
        ex, ey, most = d[0] - U[0] * age, d[1] - U[1] * age, params.V_max
    distance = jnp.sqrt(ex**2 + ey**2 + 1e-12) + params.r_t * jnp.abs(late)
    least = jnp.where(there, distance, jnp.inf).min(0)
    loss = jnp.where(batch.valid[:, None], jnp.minimum(least, most), 0)
    one = jnp.ones((), loss.dtype)
    return Score(-params.alpha_literal * loss, one, one, lag)


def resample(
    log_weights: Float[Array, " N"], uniform: Float[Array, ""]
) -> tuple[Int[Array, " N"], Float[Array, " N"]]:
    """Systematic resampling: whom each particle descends from, and the new log weights.

    The weights' gradient goes on: lw_new = -log N + (lw - stop_gradient(lw))[ancestor], whose value
    is 1/N and whose derivative is the ancestor's score (Scibior & Wood, "Differentiable Particle
    Filtering without Modifying the Forward Pass"). Without that the gradient is biased.
    """
    N = len(log_weights)
    edges = jnp.cumsum(jnp.exp(lax.stop_gradient(log_weights)))
    points = (jnp.arange(N) + uniform) * (edges[-1] / N)
    ancestor = jnp.minimum((edges[None, :] <= points[:, None]).sum(1), N - 1)
    carried = log_weights - lax.stop_gradient(log_weights)
    return ancestor, carried[ancestor] - jnp.log(N).astype(log_weights.dtype)


def step(
    params: Params,
    model: Model,
    carry: Carry,
    batch: Candidates,
    normal: Float[Array, "N dimension"],
    uniform: Float[Array, ""],
    cloud: Float[Array, "N dimension"],
) -> tuple[Carry, Told]:
    """One batch: propagate, score, weigh, tell the mean, resample; search where it is lost."""
    N, searching = params.particles, carry.searching
    weights = jnp.exp(carry.log_weights)
    mean = weights @ carry.particles
    spread = jnp.sqrt(lax.stop_gradient(weights @ (carry.particles - mean) ** 2).mean())
    std = model.diffusion(params, mean) * jnp.sqrt(batch.elapsed)
    # With less history than slow hypotheses look at, only fast ones find candidates.
    covered = batch.history >= lax.stop_gradient(params.tau_max)
    std = jnp.where(searching, JITTER * spread * (covered & batch.valid.any()), std)
    particles = carry.particles + std * normal

    voted = score(params, model, batch, particles, weights, searching)
    gain = voted.log_likelihood.sum(0)
    deviation = jnp.sqrt(lax.stop_gradient(gain).var() + 1e-12)
    gain = gain * jnp.where(searching, jnp.minimum(1, STEP / deviation) * covered, 1)
    joint = carry.log_weights + gain
    evidence = logsumexp(joint)
    log_weights = joint - evidence
    weights = jnp.exp(log_weights)
    mean = weights @ particles
    apart = particles - mean
    covariance = (apart * weights[:, None]).T @ apart

    memory = jnp.exp(-1 / lax.stop_gradient(params.memory))
    votes, chance = memory * carry.votes + voted.votes, memory * carry.chance + voted.chance
    contrast = jnp.where(chance > 0, votes / jnp.where(chance > 0, chance, 1), 1)
    size = jnp.sqrt(lax.stop_gradient((mean**2).sum()))
    width = jnp.sqrt(lax.stop_gradient(jnp.trace(covariance)) / model.dimension)
    counted = voted.chance > 0
    age = carry.age + counted
    sound = jnp.isfinite(evidence) & jnp.isfinite(particles).all()
    searches = params.likelihood != "literal"
    found = searching & covered & counted & (width < params.found * size)
    forget = (1 - memory) / HISTORY
    usual = carry.usual + jnp.where(counted, forget * (contrast - carry.usual), 0)
    least = lax.stop_gradient(jnp.maximum(params.contrast, params.drop * usual))
    poor = ~searching & (age > params.memory) & (contrast < least)
    lost = ~sound | (poor & searches)

    few = 1 / (weights**2).sum() <= params.resample_below * N
    ancestor, renewed = resample(log_weights, uniform)
    particles = jnp.where(few, particles[ancestor], particles)
    log_weights = jnp.where(few, renewed, log_weights)

    anew = cloud * lax.stop_gradient(model.extent(params))
    over = lost | found
    after = Carry(
        jnp.where(lost, anew, particles),
        jnp.where(lost, -jnp.log(N), log_weights),
        (searching & ~found) | (lost & searches),
        jnp.where(over, 0, votes),
        jnp.where(over, 0, chance),
        jnp.where(over, 0, usual),
        jnp.where(over, 0, age),
    )
    told = Told(
        jnp.where(sound, mean, 0),
        jnp.where(sound, covariance, jnp.eye(model.dimension) * model.extent(params) ** 2 / 3),
        (searching & ~found) | lost,
        jnp.where(sound, contrast, 0),
        voted.lag,
        jnp.where(sound, evidence, 0),
    )
    return after, told


def run(
    params: Params,
    model: Model,
    candidates: Candidates,
    noise: Noise,
    carry: Carry | None = None,
) -> tuple[Carry, Told]:
    """The filter over stacked batches: pure, differentiable, and vmap-able over all its arguments.

    Without `carry` it begins with a wide cloud. Derivatives are those of weights and particles
    while the motion is followed; ranges of ages, when to resample and all that a search adds are
    held fixed.
    """
    carry = begin(params, model, noise) if carry is None else carry

    def body(carry, at):
        batch, normal, uniform = at
        return step(params, model, carry, batch, normal, uniform, noise.cloud)

    batches = jax.tree.map(jnp.asarray, candidates)
    return lax.scan(body, carry, (batches, noise.normal, noise.uniform))


_run, _begin, _draw = eqx.filter_jit(run), eqx.filter_jit(begin), eqx.filter_jit(draw)


def prepare(
    recording: Recording,
    params: Params | None = None,
    model: str = "planar",
    camera: PinholeCamera | None = None,
) -> tuple[Model, Gatherer]:
    """What `run` needs: the model, and the candidates: `prepare(...)[1].whole(youngest, oldest)`.

    `camera` is by default the recording's. Raises `InputError` for an unknown model and for
    rotation without a camera.
    """
    params = params or Params.of({})
    camera = camera or recording.camera
    if model not in MODELS:
        raise InputError(f"there is no motion model {model!r}; {nearest(model, MODELS)}")
    if model == "rotation" and camera is None:
        raise InputError(
            f"{recording.name}: has no calibration, which rotation needs; give a camera"
        )
    if params.undistort is False and camera is not None:
        camera = dataclasses.replace(camera, distortion=(0.0, 0.0, 0.0, 0.0, 0.0))
    gatherer = Gatherer(
        recording,
        camera,
        radius=params.radius,
        per_pixel=params.per_pixel,
        most=params.candidates,
        every=params.every,
        batch=params.batch,
        longest=float(params.longest),
        silence=float(params.tau_max),
    )
    return Model(model, gatherer.f if model == "rotation" else 1.0), gatherer


def _flows(model: Model, gatherer: Gatherer) -> NDArray[np.floating]:
    """The model's basis (places, 2, dimension) at places all over the sensor."""
    height, width = gatherer.xi.shape[:2]
    lines, columns = (np.unique(np.linspace(0, n - 1, 9).astype(int)) for n in (height, width))
    xi = gatherer.xi[np.ix_(lines, columns)].reshape(-1, 2)
    return np.asarray(jax.jit(model.basis)(xi.astype(np.dtype(jnp.result_type(float)))))


def _ages(params: Params, model: Model, basis: NDArray, carry: Carry) -> tuple[float, float]:
    """Youngest and oldest candidates (s) that the next batches can need.

    While the motion is searched for and in the literal likelihood: all. Else those of half to
    double the speeds that the mean makes anywhere on the sensor.
    """
    tau_max, b = float(params.tau_max), float(params.baseline)
    if params.likelihood == "literal":
        return 0.0, tau_max
    if params.likelihood == "band" or bool(carry.searching):
        corner = np.full(model.dimension, float(model.extent(params)))
        fastest = float(np.sqrt(((np.abs(basis) @ corner) ** 2).sum(-1)).max())
        return min(b / (2 * fastest), tau_max / 4), tau_max
    mean = np.exp(np.asarray(carry.log_weights)) @ np.asarray(carry.particles)
    speeds = np.sqrt(((basis @ mean) ** 2).sum(-1))
    fastest, slowest = (max(float(v), 1e-9) for v in (speeds.max(), speeds.min()))
    return min(b / fastest, tau_max) / 4, min(2 * b / slowest, tau_max)


def estimate(
    recording: Recording,
    params: Params | None = None,
    *,
    model: str = "planar",
    camera: PinholeCamera | None = None,
    seed: int = 0,
    progress: bool = False,
) -> Motion:
    """The motion of a camera, batch by batch, as events arrive.

    Args:
        recording: Events; nothing else is looked at but the calibration.
        params: See `Params`.
        model: "planar": image velocity (vx, vy) in px/s, the same everywhere; "rotation": the
            camera's angular velocity (wx, wy, wz) in rad/s, x right, y down, z forward.
        camera: The calibration, by default the recording's.
        seed: Of the particles; the same seed gives the same motion.
        progress: Show a bar on stderr.

    Raises:
        InputError: The model is unknown, or rotation is asked for without a camera.
    """
    params = params or Params.of({})
    kind, gatherer = prepare(recording, params, model, camera)
    batches = -(-CHUNK // params.batch)
    key, basis = jax.random.key(seed), _flows(kind, gatherer)
    carry, parts, number = None, [], 0
    with tqdm(
        total=len(recording.events), unit="event", unit_scale=True,
        delay=2, disable=not progress, leave=False,
    ) as bar:  # fmt: skip
        while not gatherer.done:
            noise = _draw(jax.random.fold_in(key, number), batches, params, kind)
            if carry is None:
                carry = _begin(params, kind, noise)
            made = gatherer.gather(batches, *_ages(params, kind, basis, carry))
            carry, told = _run(params, kind, made.candidates, noise, carry)
            used = int((made.row >= 0).any(1).sum())
            parts.append((made.t[:used], jax.tree.map(lambda a, n=used: np.asarray(a)[:n], told)))
            bar.update(int(made.row.max(initial=0)) + 1 - bar.n)
            number += 1

    def whole(name: str) -> NDArray:
        return np.concatenate([getattr(told, name) for _, told in parts])

    if not parts:
        return Motion.nothing(model)
    return Motion(
        model,
        np.concatenate([t for t, _ in parts]),
        whole("mean"),
        whole("covariance"),
        whole("searching"),
        whole("lag"),
        whole("contrast"),
        whole("evidence"),
    )
