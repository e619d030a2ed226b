"""Motion by voting: a particle filter whose likelihood asks the candidates.

After the thesis' chapters 5 and 6 (eqs 5.1 to 5.8, 6.9 to 6.16), with one deviation. There an event
votes with its single best candidate (a hard minimum), and on a grid of pixels that locks the motion
to whole pixels per candidate's age; `likelihood="literal"` does it, for comparison, and is biased.
By default all candidates vote, softly, over a baseline of several pixels:

    S = sum_c exp(-r_c^2 / (2 sigma_x^2)),  dt_c in [0.7 tau, tau],  tau = b / |U_mean|
    r_c = |d_c - U dt_c|,  log w += alpha log(1 + S / s0)

Candidates of that narrow range tell as much as those from tau/2 on, with 60 % of the work. An event
that would have come from outside the sensor is not asked: it lacks the candidates of fast
hypotheses, and that made motion 1.1 % too slow on 160 x 120 pixels instead of 0.3 %.

A common tau serves only a motion that is about known. To find it, at the start and when it is lost,
every hypothesis is given the ages in which it crosses the baseline itself ("band"):

    dt_c in [0.7 b, b] / |U_i|,  log w += alpha log(1 + S |U_i| / (U_ref s0))

where |U_i| undoes that a fast hypothesis looks at fewer candidates, and U_ref is the mean of |U_i|.
The search starts when events have come for tau_max: before, only fast hypotheses have candidates,
and they win. It is annealed: a batch's log weights are scaled down to a small spread, sigma_x is
doubled and noise in proportion to the cloud's spread replaces the process noise.

Motion is the camera's: a camera that turns by Omega sees the flow B(x) Omega; planar motion is the
image velocity itself. General motion, a heading and Omega, is here as the thesis has it, for
comparison: every event for itself, of unknown depth, with tau fixed and r_c the distance from a
half-line. Straight edges then fit almost any heading, and it does not work well: `batch` does.

What is told lags: candidates show the mean flow since then, and the filter answers to a change with
delay. `Motion.lag` is the first of these; `smoothed` takes away both, after the recording.
"""

import abc
import dataclasses
from collections.abc import Mapping
from typing import ClassVar, NamedTuple

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
from jaxevent.egomotion.candidates import Candidates, Expected, Gatherer, Numeric
from jaxevent.egomotion.geometry import A, B
from jaxevent.egomotion.motion import COMPONENTS, Motion
from jaxevent.errors import InputError
from jaxevent.parameters import Choice, Count, Number, Parameters, Positive, nearest
from jaxevent.recording import Recording

CHUNK = 1024  # scored events after which the host looks where the motion is
SPAN = 0.1  # of tau_max, or after so long
CHANGE = 1.2  # factor by which speeds are expected to change until then
GATE = 3.5  # sigma_x, how far from the flow of the mean candidates are still looked at, at least
CELL = 16  # px: which candidates are looked at is chosen for parts of the sensor of about this size
WIDER = 2.0  # sigma_x while searching, in sigma_x
LEAST = 0.2  # votes of chance per event; a point that moves alone gets about 1.5
HISTORY = 5.0  # over how many times `memory` it is learnt how many votes are usual
PAD = 2.0  # sigma_x, how far within the sensor an event must have come from to be asked
BLOCK = 8  # candidates per event that are scored together
SLOWEST = 0.3  # baseline / tau_max, the slowest of the first planar hypotheses
JITTER = 0.1  # noise of particles while searching, per batch, in standard deviations of the cloud
STEP = 0.5  # largest standard deviation over particles of a batch's log weights while searching


class Params(Parameters):
    """Parameters of motion by voting: candidates, filter, likelihood."""

    presets = {
        # The thesis' generator: steps of 50 us, about a pixel each.
        "frames": {
            "every": 1,
            "batch": 32,
            "longest": 2e-4,
            "speed_max": 5e4,
            "tau_max": 8e-4,
            "noise": 1.2,
        },
        # As the thesis has it: the single best of 5 x 5 pixels' events. Of the latest ones, for
        # rotation and general motion: among all there is one for every slow motion.
        "literal": {
            "likelihood": "literal",
            "radius": 2,
            "tau_max": 0.05,
            "every": 16,
            "candidates": 96,
            "noise": 1.0,
        },
        "literal_latest": {
            "likelihood": "literal",
            "radius": 2,
            "tau_max": 0.05,
            "every": 16,
            "per_pixel": 1,
            "candidates": 25,
        },
        "general": {"particles": 500, "every": 16, "alpha": 1.0},
    }

    likelihood = Choice(
        ("soft", "band", "literal"),
        "all candidates of a common range of ages; of each hypothesis' own; the thesis' (biased)",
    )
    undistort = Choice((True, False), "displacements in undistorted px, where there is a camera")

    radius = Count(8, "px", "candidates are so near, in x and y; baseline + 1.5 or more")
    per_pixel = Count(8, "", "latest events of a pixel that are candidates")
    candidates = Count(128, "", "most candidates of an event; of more, these many in even steps")
    every = Count(4, "", "one event in so many is scored; neighbours are correlated")
    batch = Count(64, "", "scored events per update of the weights; 1: one by one, as the thesis")
    longest = Positive(0.01, "s", "a batch with fewer events than that ends after this time")
    particles = Count(200, "", "100 are enough for planar motion, 500 for general motion")

    baseline = Positive(6.5, "px", "b: how far a point moves in the ages that are looked at")
    youngest = Positive(0.7, "", "youngest candidates that are looked at, in oldest ones' ages")
    tau_max = Positive(0.1, "s", "oldest candidates; 2 b / (expected speed)")
    sigma_x = Positive(0.6, "px", "spread of a candidate; from 0.5 the pixel grid does not show")
    s0 = Positive(10.0, "", "score from which an event's vote grows like its logarithm")
    alpha = Positive(5.0, "", "weight of one event's vote; larger with larger `every`")
    noise = Positive(0.2, "1/sqrt(s)", "planar: change of the velocity, in shares of the speed")
    noise_rotation = Positive(1.0, "rad/s/sqrt(s)", "change of the angular velocity")
    noise_heading = Positive(1.0, "1/sqrt(s)", "general: change of the heading")
    resample_below = Number(0.5, "", "resample when so many of the particles are effective; 0: not")

    speed_max = Positive(600.0, "px/s", "planar: the first particles are no faster than this")
    omega_max = Positive(4.0, "rad/s", "first angular velocities are in +- this, in each component")
    tau_general = Positive(0.02, "s", "general: oldest candidates, as depth is not known")
    rho_max = Positive(150.0, "px/s", "general: fastest flow due to translation")
    found = Positive(0.12, "", "search ends when each component's spread is this share of the mean")
    found_heading = Positive(0.3, "", "general: is so many rad, and this share of omega_max")
    contrast = Positive(1.1, "", "search anew when votes are fewer than this, in chance's votes")
    drop = Positive(0.25, "", "or fewer than this share of what they were")
    memory = Positive(6.0, "", "batches over which votes are counted for that")

    alpha_literal = Positive(2.0, "1/px", "literal: decay of the likelihood (alpha_p)")
    r_t = Positive(1e4, "px/s", "literal: penalty of a wrong time")
    d_max = Positive(4.0, "px", "literal, planar: largest distance")
    V_max = Positive(3.0, "px", "literal, rotation and general: largest distance")
    horizon = Choice(
        ("crossing", "fixed"),
        "literal, planar: the predecessor was when the hypothesis was 1 px back, or at `past`",
    )
    past = Positive(50e-6, "s", "literal, planar: age of the predecessor, if fixed")


class Model(eqx.Module):
    """A motion of `dimension` components whose flow is linear in them: U = basis(xi) @ motion."""

    f: float = eqx.field(static=True, default=1.0)  # px
    name: ClassVar[str]

    @property
    def dimension(self) -> int:
        return len(COMPONENTS[self.name])

    @abc.abstractmethod
    def basis(self, xi: Float[Numeric, "*places 2"]) -> Float[Array, "*places 2 dimension"]:
        """How the components of the motion move the image at xi (px, from the principal point)."""

    @abc.abstractmethod
    def extent(self, params: Params) -> Float[Array, ""]:
        """The largest first motion."""

    def oldest(self, params: Params) -> Float[Array, ""]:
        """The age (s) of the oldest candidates that a search looks at."""
        return params.tau_max

    @abc.abstractmethod
    def diffusion(
        self, params: Params, mean: Float[Array, " dimension"]
    ) -> Float[Array, " dimension"]:
        """Process noise per sqrt(s)."""

    def first(
        self, params: Params, cloud: Float[Array, "N dimension"]
    ) -> Float[Array, "N dimension"]:
        """Particles everywhere, of even numbers in [-1, 1]."""
        return cloud * lax.stop_gradient(self.extent(params))

    def flow(
        self, xi: Float[Array, "K 2"], particles: Float[Array, "N dimension"]
    ) -> tuple[Float[Array, "2 K N"], Float[Array, "2 K N"] | None]:
        """Flows (px/s), and unit vectors along which they are drawn out if depth is not known."""
        return jnp.einsum("kid,nd->ikn", self.basis(xi), particles), None

    def moved(
        self, particles: Float[Array, "N dimension"], steps: Float[Array, "N dimension"]
    ) -> Float[Array, "N dimension"]:
        """Particles after random steps."""
        return particles + steps

    def share(
        self, particles: Float[Array, "N dimension"], weights: Float[Array, " N"]
    ) -> Float[Array, "N 1"]:
        """The size of each motion, in what is usual among them."""
        size2 = lax.stop_gradient((particles**2).sum(1, keepdims=True))
        return jnp.sqrt((size2 + 1e-12) / (weights @ size2 + 1e-12))

    def mean(
        self, particles: Float[Array, "N dimension"], weights: Float[Array, " N"]
    ) -> Float[Array, " dimension"]:
        """The weighted mean."""
        return weights @ particles

    def apart(
        self, particles: Float[Array, "N dimension"], mean: Float[Array, " dimension"]
    ) -> Float[Array, "N dimension"]:
        """How far particles are from the mean, as the covariance counts it."""
        return particles - mean

    def spreads(
        self, covariance: Float[Array, "dimension dimension"]
    ) -> Float[Array, " dimension"]:
        """The standard deviation of a component, the same for all that have one unit."""
        variance = jnp.diagonal(covariance)
        return jnp.broadcast_to(jnp.sqrt(variance.mean()), variance.shape)

    def certain(
        self,
        params: Params,
        mean: Float[Array, " dimension"],
        covariance: Float[Array, "dimension dimension"],
    ) -> Bool[Array, ""]:
        """Whether the cloud is narrow enough for a search to end."""
        return self.spreads(covariance)[0] < params.found * jnp.sqrt((mean**2).sum())


class Planar(Model):
    """The image velocity (px/s), the same everywhere."""

    name = "planar"

    def basis(self, xi):
        xi = jnp.asarray(xi)
        return jnp.broadcast_to(jnp.eye(2, dtype=xi.dtype), (*xi.shape[:-1], 2, 2))

    def extent(self, params):
        return params.speed_max

    def diffusion(self, params, mean):
        """A share of the speed, which counts as at least baseline / tau_max."""
        slowest = params.baseline / params.tau_max
        return jnp.broadcast_to(params.noise * jnp.sqrt((mean**2).sum() + slowest**2), (2,))

    def first(self, params, cloud):
        """Even in direction and in the logarithm of speed: a search has to come within a share."""
        fastest = lax.stop_gradient(self.extent(params))
        slowest = lax.stop_gradient(SLOWEST * params.baseline / params.tau_max)
        speed = fastest * (slowest / fastest) ** ((1 + cloud[:, :1]) / 2)
        azimuth = jnp.pi * cloud[:, 1:]
        return speed * jnp.concatenate([jnp.cos(azimuth), jnp.sin(azimuth)], 1)


class Rotation(Model):
    """The camera's angular velocity (rad/s): U = B Omega, eq 6.1 with its misprint mended."""

    name = "rotation"

    def basis(self, xi):
        xi = jnp.asarray(xi)
        return B(xi[..., 0], xi[..., 1], jnp.asarray(self.f, xi.dtype))

    def extent(self, params):
        return params.omega_max

    def diffusion(self, params, mean):
        return jnp.broadcast_to(params.noise_rotation, (3,))


class General(Model):
    """The camera's heading, a unit vector, and its angular velocity (rad/s).

    The flow is on a half-line, see `geometry.half_line_residual`: B Omega + rho a, a = A T / |A T|,
    with rho from 0 on, as depth is not known.
    """

    name = "general"

    def basis(self, xi):
        """That of Omega."""
        return Rotation.basis(self, xi)  # type: ignore[arg-type]

    def extent(self, params):
        return params.omega_max

    def oldest(self, params):
        return params.tau_general

    def diffusion(self, params, mean):
        return _six(params.noise_heading, params.noise_rotation)

    def first(self, params, cloud):
        """Headings all over the sphere."""
        z, azimuth = cloud[:, 0], jnp.pi * cloud[:, 1]
        ring = jnp.sqrt(1 - z**2)
        heading = jnp.stack([ring * jnp.cos(azimuth), ring * jnp.sin(azimuth), z], 1)
        turning = cloud[:, 3:] * lax.stop_gradient(self.extent(params))
        return jnp.concatenate([heading, turning], 1)

    def flow(self, xi, particles):
        """The unit vectors are 0 in the focus of expansion."""
        T, Omega = particles[:, :3], particles[:, 3:]
        translation = A(xi[:, 0], xi[:, 1], jnp.asarray(self.f, xi.dtype))
        along = jnp.einsum("kid,nd->ikn", translation, T)
        size = jnp.sqrt(jnp.maximum((along**2).sum(0), 1e-12))
        return jnp.einsum("kid,nd->ikn", self.basis(xi), Omega), along / size

    def moved(self, particles, steps):
        """Those of headings across them."""
        T, step = particles[:, :3], steps[:, :3]
        T = _unit(T + step - T * (T * step).sum(-1, keepdims=True))
        return jnp.concatenate([T, particles[:, 3:] + steps[:, 3:]], 1)

    def share(self, particles, weights):
        """1: a heading has no size."""
        return jnp.ones_like(particles[:, :1])

    def mean(self, particles, weights):
        """Of headings the direction of the mean vector."""
        mean = weights @ particles
        return jnp.concatenate([_unit(mean[:3]), mean[3:]])

    def apart(self, particles, mean):
        """Of headings across the mean."""
        T, apart = mean[:3], particles - mean
        across = apart[:, :3] - (apart[:, :3] @ T)[:, None] * T
        return jnp.concatenate([across, apart[:, 3:]], 1)

    def spreads(self, covariance):
        variance = jnp.diagonal(covariance)
        return _six(jnp.sqrt(variance[:3].sum() / 2), jnp.sqrt(variance[3:].mean()))

    def certain(self, params, mean, covariance):
        heading, *_, turning = self.spreads(covariance)
        limit = params.found_heading
        return (heading < limit) & (turning < limit * self.extent(params))


MODELS: Mapping[str, type[Model]] = {model.name: model for model in (Planar, Rotation, General)}


def _six(heading: Array, turning: Array) -> Float[Array, "6"]:
    return jnp.concatenate([jnp.broadcast_to(v, (3,)) for v in (heading, turning)])


def _unit(v: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3"]:
    square = (v**2).sum(-1, keepdims=True)
    return jnp.where(square > 0, v / jnp.sqrt(jnp.where(square > 0, square, 1)), v)


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
    lag: Float[Array, "*batches"]  # s, how much older than the last event is what is seen
    evidence: Float[Array, "*batches"]  # log of the mean likelihood of the batch
    cloud: Float[Array, "*batches thinned dimension"]  # some particles, in proportion to weights


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
    particles = model.first(params, noise.cloud)
    N, zero = params.particles, jnp.zeros((), particles.dtype)
    searching = jnp.asarray(params.likelihood != "literal")
    even = jnp.full(N, -jnp.log(N), particles.dtype)
    return Carry(particles, even, searching, zero, zero, zero, zero)


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
    U, along = model.flow(jnp.asarray(batch.xi), particles)
    speed = jnp.sqrt((U**2).sum(0) + 1e-12)  # K N
    fixed, now, usual = lax.stop_gradient((params, speed, U @ weights))
    b, room, valid = fixed.baseline, jnp.asarray(batch.room), jnp.asarray(batch.valid)
    # A little less: room is often in whole px, as b may be, but for rounding.
    everywhere = jnp.minimum(-room[0], room[1]).min(0) >= 0.99 * b
    if along is None:
        tau = jnp.minimum(b / jnp.sqrt((usual**2).sum(0) + 1e-12), fixed.tau_max)[:, None]  # K 1
        pad, back = PAD * fixed.sigma_x, usual * tau[:, 0]
        there = ((back >= room[0] + pad) & (back <= room[1] - pad)).all(0)
    else:
        tau = jnp.broadcast_to(fixed.tau_general, (batch.valid.shape[0], 1))
        there = everywhere
    number = jnp.maximum(valid.sum(), 1)
    # Candidates of one age see the mean flow since then, that of half the age ago.
    lag = (1 + fixed.youngest) / 4 * jnp.where(valid, tau[:, 0], 0).sum() / number
    if params.likelihood == "literal":
        return _literal(params, model, batch, U, along, speed, lag)
    band = jnp.asarray(searching) | (params.likelihood == "band")
    band = band & (along is None)
    youngest = fixed.youngest * jnp.where(band, b / now, tau)
    oldest = jnp.where(band, jnp.minimum(b / now, fixed.tau_max), tau)
    sigma = params.sigma_x * jnp.where(searching, WIDER, 1.0)
    S = _sum(batch, U, along, youngest, oldest, -0.5 / sigma**2, fixed.rho_max)
    S = S * batch.scale[:, None]
    rate = jnp.where(band, speed / jnp.maximum(speed @ weights, 1e-12)[:, None], 1)
    gain = params.alpha * jnp.log1p(S * rate / params.s0)
    seen = valid & jnp.where(band, everywhere, there)
    gain = jnp.where(seen[:, None], gain, 0)
    common = batch.rate * (1 - fixed.youngest) * tau[:, 0]
    # The area of a vote, (px^2) over that of the window; of a half-line it is a strip's.
    area = jnp.sqrt(2 * jnp.pi) * lax.stop_gradient(sigma)
    area = area * (area if along is None else area / 2 + batch.reach)
    density = area / (2 * batch.reach + 1) ** 2
    chance = jnp.where(seen, jnp.maximum(common * density, LEAST), 0).sum()
    votes = jnp.where(seen, lax.stop_gradient(S) @ lax.stop_gradient(weights), 0).sum()
    return Score(gain, votes, chance, lag)


def _sum(
    batch: Candidates,
    U: Array,
    along: Array | None,
    youngest: Array,
    oldest: Array,
    exponent: Array,
    rho_max: Array,
) -> Float[Array, "K N"]:
    """sum_c exp(exponent r_c^2) over candidates of the ages asked for.

    r_c is the distance of d_c from U dt_c, or from the half-line that begins there. Candidates fill
    their places from the first, so the later blocks of most batches hold none and are skipped.
    Particles are the last axis, along which everything is vectors.
    """
    C, K = batch.age.shape
    pad = -C % BLOCK
    age = jnp.pad(jnp.asarray(batch.age), [(0, pad), (0, 0)]).reshape(-1, BLOCK, K)
    d = jnp.pad(jnp.asarray(batch.d), [(0, 0), (0, pad), (0, 0)]).reshape(2, -1, BLOCK, K)

    def add(S, dx, dy, age):
        for c in range(BLOCK):
            dt = age[c, :, None]
            x, y = dx[c, :, None] - U[0] * dt, dy[c, :, None] - U[1] * dt
            distance2 = x**2 + y**2
            if along is not None:
                s = x * along[0] + y * along[1]
                to = jnp.clip(s, 0, rho_max * dt)
                distance2 = distance2 + to * (to - 2 * s)
            inside = (dt >= youngest) & (dt <= oldest)
            S = S + jnp.where(inside, jnp.exp(distance2 * exponent), 0)
        return S

    def body(S, block):
        return lax.cond((block[2] > 0).any(), add, lambda S, *_: S, S, *block), None

    return lax.scan(body, jnp.zeros_like(U[0]), (d[0], d[1], age))[0]


def _literal(
    params: Params,
    model: Model,
    batch: Candidates,
    U: Array,
    along: Array | None,
    speed: Array,
    lag: Array,
) -> Score:
    """Planar: eqs 5.2, 5.3, 5.7; else 6.9 to 6.16, with distances in px.

    6.12 is printed as a norm and squared, in px^2/s^2, and 6.9 is signed, in px^2/s; only px suit
    V_max = 2 to 3 and r_t in px/s. So 6.9 is taken as |F| dt / |A T|, the distance from the whole
    line of all depths, positive or not. The time penalty of 6.10 compares with the last event at
    the same pixel; where there is none among the candidates, there is no penalty. That event is
    itself no candidate: to a camera that does not move it would always be the best.
    """
    d, age = jnp.asarray(batch.d)[..., None], jnp.asarray(batch.age)[..., None]
    there = age > 0
    if model.name == "planar":
        past = 1 / speed if params.horizon == "crossing" else params.past
        ex, ey, late, most = d[0] - U[0] * past, d[1] - U[1] * past, age - past, params.d_max
    else:
        own = there & (d == 0).all(0)
        before = jnp.where(own, age, jnp.inf).min(0)
        late, there = jnp.where(jnp.isfinite(before), age - before, 0), there & ~own
        ex, ey, most = d[0] - U[0] * age, d[1] - U[1] * age, params.V_max
        if along is not None:
            ex, ey = ex * along[1] - ey * along[0], jnp.zeros_like(ex)
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
    carry: Carry,
    batch: Candidates,
    normal: Float[Array, "N dimension"],
    uniform: Float[Array, ""],
    cloud: Float[Array, "N dimension"],
    thinned: int = 0,
) -> tuple[Carry, Told]:
    """One batch: propagate, score, weigh, tell the mean, resample; search where it is lost.

    `thinned` particles, drawn by weight, are told.
    """
    N, searching = params.particles, carry.searching
    weights = jnp.exp(carry.log_weights)
    mean = model.mean(carry.particles, weights)
    fixed, apart = lax.stop_gradient((weights, model.apart(carry.particles, mean)))
    spread = model.spreads((apart * fixed[:, None]).T @ apart)
    std = model.diffusion(params, mean) * jnp.sqrt(batch.elapsed)
    # With less history than slow hypotheses look at, only fast ones find candidates.
    covered = batch.history >= 0.99 * lax.stop_gradient(model.oldest(params))
    jitter = JITTER * spread * (covered & batch.valid.any()) * model.share(carry.particles, fixed)
    particles = model.moved(carry.particles, jnp.where(searching, jitter, std) * normal)

    voted = score(params, model, batch, particles, weights, searching)
    gain = voted.log_likelihood.sum(0)
    deviation = jnp.sqrt(lax.stop_gradient(gain).var() + 1e-12)
    gain = gain * jnp.where(searching, jnp.minimum(1, STEP / deviation) * covered, 1)
    joint = carry.log_weights + gain
    evidence = logsumexp(joint)
    log_weights = joint - evidence
    weights = jnp.exp(log_weights)
    mean = model.mean(particles, weights)
    apart = model.apart(particles, mean)
    covariance = (apart * weights[:, None]).T @ apart

    memory = jnp.exp(-1 / lax.stop_gradient(params.memory))
    votes, chance = memory * carry.votes + voted.votes, memory * carry.chance + voted.chance
    contrast = jnp.where(chance > 0, votes / jnp.where(chance > 0, chance, 1), 1)
    counted = voted.chance > 0
    age = carry.age + counted
    sound = jnp.isfinite(evidence) & jnp.isfinite(particles).all()
    searches = params.likelihood != "literal"
    certain = model.certain(*lax.stop_gradient((params, mean, covariance)))
    found = searching & covered & counted & certain
    forget = (1 - memory) / HISTORY
    usual = carry.usual + jnp.where(counted, forget * (contrast - carry.usual), 0)
    least = lax.stop_gradient(params.drop * usual)
    if model.name != "general":  # there chance's votes along a half-line are most of them
        least = jnp.maximum(lax.stop_gradient(params.contrast), least)
    poor = ~searching & (age > params.memory) & (contrast < least)
    lost = ~sound | (poor & searches)

    few = 1 / (weights**2).sum() <= params.resample_below * N
    shown = particles[_drawn(weights, thinned, jnp.asarray(0.5))] if thinned else particles[:0]
    ancestor, renewed = resample(log_weights, uniform)
    particles = jnp.where(few, particles[ancestor], particles)
    log_weights = jnp.where(few, renewed, log_weights)

    anew = model.first(params, cloud)
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
        jnp.where(sound, mean, model.mean(anew, jnp.full(N, 1 / N, anew.dtype))),
        jnp.where(sound, covariance, jnp.eye(model.dimension) * model.extent(params) ** 2 / 3),
        (searching & ~found) | lost,
        jnp.where(sound, contrast, 0),
        voted.lag,
        jnp.where(sound, evidence, 0),
        jnp.where(sound, shown, 0),
    )
    return after, told


def run(
    params: Params,
    model: Model,
    candidates: Candidates,
    noise: Noise,
    carry: Carry | None = None,
    thinned: int = 0,
) -> tuple[Carry, Told]:
    """The filter over stacked batches: pure, differentiable, and vmap-able over all its arguments.

    Without `carry` it begins with a wide cloud; `thinned` particles of each batch are told.
    Derivatives are those of weights and particles while the motion is followed; ranges of ages,
    when to resample and all that a search adds are held fixed.
    """
    carry = begin(params, model, noise) if carry is None else carry

    def body(carry, at):
        batch, normal, uniform = at
        return step(params, model, carry, batch, normal, uniform, noise.cloud, thinned)

    batches = jax.tree.map(jnp.asarray, candidates)
    return lax.scan(body, carry, (batches, noise.normal, noise.uniform))


_run, _begin, _draw = eqx.filter_jit(run), eqx.filter_jit(begin), eqx.filter_jit(draw)
_diffusions = eqx.filter_jit(
    lambda model, params, means: jax.vmap(model.diffusion, (None, 0))(params, means)
)


def _default(model: str) -> Params:
    return Params.of({"preset": "general"} if model == "general" else {})


def prepare(
    recording: Recording,
    params: Params | None = None,
    model: str = "planar",
    camera: PinholeCamera | None = None,
) -> tuple[Model, Gatherer]:
    """What `run` needs: the model, and the candidates: `prepare(...)[1].whole(youngest, oldest)`.

    `camera` is by default the recording's. Raises `InputError` for an unknown model and for
    rotation or general motion without a camera.
    """
    params = params or _default(model)
    camera = camera or recording.camera
    if model not in MODELS:
        raise InputError(f"there is no motion model {model!r}; {nearest(model, MODELS)}")
    if model != "planar" and camera is None:
        raise InputError(
            f"{recording.name}: has no calibration, which {model} motion needs; give a camera"
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
    return MODELS[model](gatherer.f), gatherer


def _corners(model: Model, gatherer: Gatherer) -> NDArray[np.floating]:
    """The model's basis (rows, columns, 2, dimension) at the corners of equal parts of the sensor.

    Planar motion needs one part.
    """
    parts = (1, 1)
    if model.name == "rotation":
        parts = tuple(max(1, n // CELL) for n in gatherer.xi.shape[:2])
    lines, columns = (
        np.rint(np.linspace(0, n - 1, k + 1)).astype(int)
        for n, k in zip(gatherer.xi.shape[:2], parts, strict=True)
    )
    xi = gatherer.xi[np.ix_(lines, columns)]
    return np.asarray(model.basis(xi.astype(np.dtype(jnp.result_type(float)))))


class Looked(NamedTuple):
    """At which candidates the next batches can need to look; see `Gatherer.gather`."""

    youngest: float | NDArray[np.floating]
    oldest: float | NDArray[np.floating]
    expected: Expected | None


def _looked(params: Params, model: Model, corners: NDArray, carry: Carry) -> Looked:
    """By parts of the sensor: those whose flow is about what the mean makes there.

    While the motion is searched for and in the literal likelihood: all.
    """
    tau_max, b, share = (float(v) for v in (params.tau_max, params.baseline, params.youngest))
    if params.likelihood == "literal":
        return Looked(0.0, tau_max, None)
    if model.name == "general":
        tau = float(params.tau_general)
        return Looked(share * tau, tau, None)
    if params.likelihood == "band" or bool(carry.searching):
        widest = np.full(model.dimension, float(model.extent(params)))
        fastest = float(np.sqrt(((np.abs(corners) @ widest) ** 2).sum(-1)).max())
        return Looked(share * min(b / fastest, tau_max / 2), tau_max, None)
    particles, weights = np.asarray(carry.particles), np.exp(np.asarray(carry.log_weights))
    mean = weights @ particles
    spread = np.sqrt(weights @ (particles - mean) ** 2)
    U, wider = corners @ mean, np.sqrt(((corners**2) @ spread**2).sum(-1)).max()
    four = np.stack([U[:-1, :-1], U[1:, :-1], U[:-1, 1:], U[1:, 1:]])
    # All flows of a part are about within a circle that holds those of its corners.
    centre = four.mean(0)
    radius = np.sqrt(((four - centre) ** 2).sum(-1)).max(0)
    speed = np.sqrt((centre**2).sum(-1))
    fastest, slowest = CHANGE * (speed + radius), np.maximum(speed - radius, 0) / CHANGE
    young = np.minimum(b / np.maximum(fastest, 1e-9), tau_max)
    old = np.minimum(b / np.maximum(slowest, 1e-9), tau_max)
    slack = radius + 3 * wider + (CHANGE - 1) * (speed + radius)
    expected = Expected(np.moveaxis(centre, -1, 0), slack, GATE * float(params.sigma_x))
    return Looked(share * young, old, expected)


def estimate(
    recording: Recording,
    params: Params | None = None,
    *,
    model: str = "planar",
    camera: PinholeCamera | None = None,
    seed: int = 0,
    progress: bool = False,
    smooth: bool = False,
    cloud: int = 0,
) -> Motion:
    """The motion of a camera, batch by batch, as events arrive.

    Args:
        recording: Events; nothing else is looked at but the calibration.
        params: See `Params`; by default as they are there, and for general motion the preset
            "general".
        model: "planar": image velocity (vx, vy) in px/s, the same everywhere; "rotation": the
            camera's angular velocity (wx, wy, wz) in rad/s, x right, y down, z forward; "general":
            its heading, a unit vector, and its angular velocity, for comparison with `batch`.
        camera: The calibration, by default the recording's.
        seed: Of the particles; the same seed gives the same motion.
        progress: Show a bar on stderr.
        smooth: `smoothed` by later events, for use after the recording.
        cloud: So many particles of each batch, drawn by weight, are the motion's `cloud`.

    Raises:
        InputError: The model is unknown, or another than planar motion is asked for without a
            camera.
    """
    params = params or _default(model)
    kind, gatherer = prepare(recording, params, model, camera)
    batches = -(-CHUNK // params.batch)
    key, corners = jax.random.key(seed), _corners(kind, gatherer)
    carry, parts, number, span = None, [], 0, SPAN * float(params.tau_max)
    with tqdm(
        total=len(recording.events), unit="event", unit_scale=True,
        delay=2, disable=not progress, leave=False,
    ) as bar:  # fmt: skip
        while not gatherer.done:
            noise = _draw(jax.random.fold_in(key, number), batches, params, kind)
            if carry is None:
                carry = _begin(params, kind, noise)
            looked = _looked(params, kind, corners, carry)
            made = gatherer.gather(batches, looked.youngest, looked.oldest, span, looked.expected)
            carry, told = _run(params, kind, made.candidates, noise, carry, cloud)
            used = int((made.row >= 0).any(1).sum())
            parts.append((made.t[:used], jax.tree.map(lambda a, n=used: np.asarray(a)[:n], told)))
            bar.update(int(made.row.max(initial=0)) + 1 - bar.n)
            number += 1

    def whole(name: str) -> NDArray:
        return np.concatenate([getattr(told, name) for _, told in parts])

    if not parts:
        return Motion.nothing(model)
    motion = Motion(
        model,
        np.concatenate([t for t, _ in parts]),
        whole("mean"),
        whole("covariance"),
        whole("searching"),
        whole("lag"),
        whole("contrast"),
        whole("evidence"),
        whole("cloud") if cloud else None,
    )
    return smoothed(motion, params) if smooth else motion


def smoothed(motion: Motion, params: Params | None = None) -> Motion:
    """A motion in the light of later events too, and at the times that its events show.

    The filter's means and covariances, taken for those of a Kalman filter with the process noise of
    `params`, are passed backwards as by Rauch, Tung and Striebel: with G = P (P + Q)^-1,

        m_s = m + G (m_s' - m),  P_s = P + G (P_s' - P - Q) G',

    where ' is the next batch. That halves the variance and takes away the delay with which the
    filter answers to a change; `lag`, by which candidates are older, is taken off `t`. A stretch in
    which the motion is searched for separates what is before from what is after.
    """
    params = params or _default(motion.model)
    kind = MODELS[motion.model]()
    if not len(motion):
        return motion
    m, P = motion.mean.astype(float), motion.covariance.astype(float)
    padded = np.zeros((1 << (len(m) - 1).bit_length(), kind.dimension))  # compiles for few sizes
    padded[: len(m)] = m
    noise = np.asarray(_diffusions(kind, params, jnp.asarray(padded)))[: len(m)]
    dt = np.diff(motion.t, append=motion.t[-1]) * 1e-6
    Q = np.eye(kind.dimension) * (noise**2 * dt[:, None])[:, None, :]
    # Covariances of headings have no spread along them, and those of few particles none at all.
    tiny = 1e-9 * np.trace(P, axis1=1, axis2=2)[:, None, None] + 1e-12
    G = np.linalg.solve(P + Q + tiny * np.eye(kind.dimension), P).transpose(0, 2, 1)
    for k in range(len(m) - 2, -1, -1):
        if motion.lost[k] or motion.lost[k + 1]:
            continue
        m[k] += G[k] @ (m[k + 1] - m[k])
        P[k] += G[k] @ (P[k + 1] - P[k] - Q[k]) @ G[k].T
        if kind.name == "general":
            m[k, :3] /= np.linalg.norm(m[k, :3])
    lag = np.rint(1e6 * motion.lag).astype(np.int64)
    t = np.maximum.accumulate(motion.t - lag)
    return dataclasses.replace(
        motion,
        t=t,
        mean=m.astype(motion.mean.dtype),
        covariance=P.astype(motion.mean.dtype),
        lag=np.zeros_like(motion.lag),
    )
