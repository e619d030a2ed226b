"""Speed of egomotion, as part of `bench.py`: events scored per second, and seconds per window.

    python experiments/bench.py voting
    python experiments/bench.py motion

Filters run over prepared candidates of simulated scenes, one event in 8, neighbours up to R px
away, by the kernel that `estimate` uses; beside them by XLA, and the same sums over candidates and
particles as a numba loop on one core, all in CPU seconds. A third to a half of the batches are of a
search, which asks more of an event than the loop does. The thesis publishes 100,000 events/s with
N = 100 (GPU and CPU). Of the batch fit,
CPU seconds per window.
"""

import time
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numba
import numpy as np
from common import cpu_seconds

from jaxevent.egomotion import voting
from jaxevent.egomotion.bundle.hypotheses import WindowFit, WindowFitter
from jaxevent.egomotion.bundle.warp import predict_path
from jaxevent.egomotion.bundle.windows import Params as BatchParams
from jaxevent.egomotion.candidates import Candidates
from jaxevent.egomotion.estimator import TrainingSegment
from jaxevent.egomotion.models import Model, find_model
from jaxevent.egomotion.particle_filter import filtering
from jaxevent.egomotion.particle_filter.engine import CompiledFilter
from jaxevent.egomotion.particle_filter.params import Params
from jaxevent.egomotion.truth import KnownMotion
from jaxevent.runs.egomotion import MotionLoss
from jaxevent.simulate import motion_scene
from jaxevent.tuning import evaluate_loss, loss_and_grad

PUBLISHED = 0.1  # M events/s, N = 100
SIZE, RADIUS, BASELINE = (160, 120), 6, 4.5
CASES = (("planar", "planar", 200), ("rotation", "rotation", 200), ("general", "texture", 500))


@numba.njit(cache=True, fastmath=True)
def votes(dx, dy, age, count, xi, scale, particles, model, f, tau, exponent, rho, s0, alpha):
    """Return the log-likelihood of every particle, as `likelihood.score` does, in float32."""
    total = np.zeros(len(particles), np.float32)
    one = np.float32(1)
    for e in range(len(count)):
        x, y = xi[e, 0], xi[e, 1]
        for n in range(len(particles)):
            ax, ay = np.float32(0), np.float32(0)
            if model == 0:
                ux, uy = particles[n, 0], particles[n, 1]
            else:
                first = 3 if model == 2 else 0
                wx, wy, wz = particles[n, first], particles[n, first + 1], particles[n, first + 2]
                ux = x * y / f * wx - (f + x * x / f) * wy + y * wz
                uy = (f + y * y / f) * wx - x * y / f * wy - x * wz
                if model == 2:
                    ax = x * particles[n, 2] - f * particles[n, 0]
                    ay = y * particles[n, 2] - f * particles[n, 1]
                    size = np.float32(np.sqrt(max(ax * ax + ay * ay, np.float32(1e-12))))
                    ax, ay = ax / size, ay / size
            S = np.float32(0)
            for c in range(count[e]):
                dt = age[e, c]
                qx, qy = dx[e, c] - ux * dt, dy[e, c] - uy * dt
                if model == 2:
                    s = min(max(qx * ax + qy * ay, np.float32(0)), rho * dt)
                    qx, qy = qx - s * ax, qy - s * ay
                S += np.exp((qx * qx + qy * qy) * exponent)
            total[n] += alpha * np.log(one + S * scale[e] / s0)
    return total


def cpu_timed(function: Any, repeat: int = 5) -> float:
    """Return the least CPU seconds, after one call that compiles, until results are there."""
    return cpu_seconds(lambda: jax.block_until_ready(function()), repeat)


def loop_seconds(
    made: Candidates, particles: np.ndarray, kind: Model, params: Params, tau: float
) -> tuple[float, np.ndarray]:
    """Return seconds and sums of the numba loop over ages in [youngest tau, tau]."""
    age = np.asarray(made.age).reshape(-1, made.age.shape[2])
    d = np.moveaxis(np.asarray(made.d), -1, 0).reshape(2, *age.shape)
    keep = (age >= np.float32(float(params.youngest) * tau)) & (age <= np.float32(tau))
    keep &= np.asarray(made.valid).reshape(-1, 1)
    order = np.argsort(~keep, 1, kind="stable")
    dx, dy, age = (np.take_along_axis(part, order, 1) for part in (d[0], d[1], age))
    count = keep.sum(1)
    xi, scale = np.asarray(made.xi).reshape(-1, 2), np.asarray(made.scale).ravel()
    number = {"planar": 0, "rotation": 1, "general": 2}[kind.name]
    rest = (
        np.float32(kind.f), tau, np.float32(-0.5 / float(params.sigma_x) ** 2),
        np.float32(params.rho_max), np.float32(params.s0), np.float32(params.alpha),
    )  # fmt: skip
    arguments = (dx, dy, age, count, xi, scale, particles, number, *rest)
    return cpu_timed(lambda: votes(*arguments)), votes(*arguments)


def voting_bench() -> tuple[dict[str, float], dict[str, float]]:
    speed, ratio = {}, {}
    for model, scene, N in CASES:
        recording, truth = motion_scene(scene, "constant", 200, size=SIZE, duration=0.3)
        params = Params(radius=RADIUS, baseline=BASELINE, particles=N)
        kind, sampler = voting.sampler(recording, params, model)
        rng = np.random.default_rng(0)
        at = np.array([0.2])
        middle = kind.from_scene(truth, at)[0]
        particles = middle + 0.02 * np.abs(middle).max() * rng.normal(size=(N, len(middle)))
        particles = particles.astype(np.float32)
        oldest = float(kind.max_age(params))
        made = jax.device_put(sampler.sample_all(0.2 * oldest, oldest).candidates)
        events = int(np.asarray(made.valid).sum())
        noise = filtering.draw(jax.random.key(0), len(made.elapsed), params, kind)
        start = filtering.init(params, kind, noise)
        start = eqx.tree_at(
            lambda c: (c.particles, c.searching),
            start,
            (jnp.asarray(particles), jnp.asarray(False)),
        )
        scan, kernel = eqx.filter_jit(filtering.run), CompiledFilter(params, kind)
        seconds = cpu_timed(lambda a=(kernel, made, noise, start): a[0](*a[1:])[1].mean)
        by_xla = cpu_timed(lambda a=(scan, params, kind, made, noise, start): a[0](*a[1:])[1].mean)
        # The loop's ages: those that the filter has for planar motion; there one tau is all.
        tau = oldest
        if kind.uniform:
            tau = min(BASELINE / float(np.linalg.norm(middle)), oldest)
        slow, _ = loop_seconds(made, particles, kind, params, tau)
        whole = cpu_timed(
            lambda a=(recording, params, model): (
                voting.estimate(a[0], a[1], model=a[2], compiler="numba").mean
            ),
            2,
        )
        name = f"{model} voting, N = {N}"
        speed[name] = events / seconds / 1e6
        speed[f"{name}, compiled by XLA"] = events / by_xla / 1e6
        speed[f"{name}, as a numba loop"] = events / slow / 1e6
        speed[f"{name}, `estimate` in all, events of the recording"] = (
            len(recording.events) / whole / 1e6
        )
        ratio[f"{name} / numba loop"] = slow / seconds
        ratio[f"{name} / compiled by XLA"] = by_xla / seconds
        ratio[f"{name} / thesis' 0.1 M"] = speed[name] / PUBLISHED
    loss, gradient, by_xla = fit_seconds()
    ratio["planar voting: loss and 3 gradients / loss"] = gradient / loss
    ratio["planar voting: loss and 3 gradients by numba / by XLA"] = by_xla / gradient
    return speed, ratio


def fit_seconds() -> tuple[float, float, float]:
    """CPU seconds of a fit's loss, of loss and 3 gradients, and of these by XLA: two runs."""
    recording, truth = motion_scene("planar", "constant", 200, size=SIZE, duration=0.3)
    params = Params(radius=RADIUS, baseline=BASELINE)
    model, t = find_model("planar"), np.arange(0, 300_000, 1000)
    known = KnownMotion(model, t, model().from_scene(truth, t * 1e-6))
    segment = TrainingSegment(recording, 150_000, 250_000, known, 0)
    raw = {name: params.raw[name][None] for name in ("noise", "alpha", "sigma_x")}
    found, loss = [], MotionLoss()
    for compiler, names in (("numba", ()), ("numba", tuple(raw)), ("xla", tuple(raw))):
        (batch,) = voting.training_runs([segment], params, model, 2, 0.0, compiler=compiler)
        some = {name: raw[name] for name in names}

        def task(batch: Any = batch, some: Any = some) -> Any:
            if not some:
                return evaluate_loss(loss, params, batch)
            return loss_and_grad(loss, True, params, some, batch)[0]

        found.append(cpu_timed(task, 3))
    return found[0], found[1], found[2]


def batch_bench() -> tuple[dict[str, float], dict[str, float]]:
    """Measure one window of 300 ms with more than 100,000 events, of which 60,000 are used.

    From nothing, all starts included, and following the window before.
    """
    recording, _ = motion_scene("texture", "varying", 200, duration=0.5)
    assert recording.camera is not None
    windows = WindowFitter(recording, BatchParams.of({}), recording.camera)
    first, last = windows.event_range(250_000, 0.15)
    assert last - first > 100_000

    def whole() -> WindowFit:
        fit = windows.fit(250_000)
        assert fit is not None
        return fit

    warm = predict_path(whole().path, 0.0, 0.15)

    def follow() -> WindowFit | None:
        return windows.refine_final(250_000, [windows.refine_from(250_000, warm)])

    name = "batch general motion, CPU s per window"
    begin = time.process_time()  # once: it takes long
    whole()
    speed = {f"{name}, from nothing": time.process_time() - begin}
    speed[f"{name}, following"] = cpu_timed(follow, 1)
    return speed, {}


def motion_bench() -> tuple[dict[str, float], dict[str, float]]:
    speed, ratio = {}, {}
    for part in (voting_bench, batch_bench):
        more, ratios = part()
        speed, ratio = speed | more, ratio | ratios
    return speed, ratio
