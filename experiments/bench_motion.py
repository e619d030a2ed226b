"""Speed of egomotion, as part of `bench.py`: events scored per second, and seconds per window.

    python experiments/bench.py voting
    python experiments/bench.py motion

Filters run over prepared candidates of simulated scenes, one event in 8, neighbours up to R px
away, by the kernel that `estimate` uses; beside them by XLA, and the same sums over candidates and
particles as a numba loop on one core, all in CPU seconds. A third to a half of the batches are of a
search, which asks more of an event than the loop does. The thesis publishes 100,000 events/s with
N = 100 (GPU and CPU). Of the batch fit, seconds per window, and what most of them go into, J' W J v
some tens of times a step, beside the same as a plain loop.
"""

import math
import time
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numba
import numpy as np

from jaxevent.egomotion import voting
from jaxevent.egomotion.bundle import photometric_ba
from jaxevent.egomotion.bundle.hypotheses import MAX_SCORED_EVENTS, WindowFit, WindowFitter
from jaxevent.egomotion.bundle.normal_equations import N_PATH_UNKNOWNS, Unknowns, linearise
from jaxevent.egomotion.bundle.residuals import Scene, subtract_mean
from jaxevent.egomotion.bundle.warp import N_COEFFICIENT_ROWS, Path, predict_path
from jaxevent.egomotion.bundle.windows import Params as BatchParams
from jaxevent.egomotion.candidates import Candidates
from jaxevent.egomotion.models import Model
from jaxevent.egomotion.particle_filter import filtering
from jaxevent.egomotion.particle_filter.engine import CompiledFilter
from jaxevent.egomotion.particle_filter.params import Params
from jaxevent.simulate import motion_scene

PUBLISHED = 0.1  # M events/s, N = 100
SIZE, RADIUS, BASELINE = (160, 120), 6, 4.5
CASES = (("planar", "planar", 200), ("rotation", "rotation", 200), ("general", "texture", 500))


@numba.njit(cache=True, fastmath=True)
def votes(dx, dy, age, count, xi, scale, particles, model, f, tau, exponent, rho, s0, alpha):
    """The log-likelihood of every particle: what `likelihood.score` adds up, in float32."""
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


def timed(function: Any, repeat: int = 3, clock: Any = time.perf_counter) -> float:
    """The least of some times, after one call that compiles."""
    jax.block_until_ready(function())
    seconds = []
    for _ in range(repeat):
        begin = clock()
        jax.block_until_ready(function())
        seconds.append(clock() - begin)
    return min(seconds)


def cpu_timed(function: Any, repeat: int = 5) -> float:
    """The same in CPU seconds, which other programs on the machine change less."""
    return timed(function, repeat, time.process_time)


def loop_seconds(
    made: Candidates, particles: np.ndarray, kind: Model, params: Params, tau: float
) -> tuple[float, np.ndarray]:
    """Seconds of the numba loop over candidates of ages in [youngest tau, tau], and its sums."""
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
    return speed, ratio


def batch_bench() -> tuple[dict[str, float], dict[str, float]]:
    """CPU seconds of one window of 300 ms with more than 100,000 events, of which 60,000 are used.

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


@numba.njit(cache=True, fastmath=True)
def normal_loop(
    v_map, v_path, v_depth, first, steps, share, node, node_steps, node_share, by_path, by_depth,
    weight, pixel, total,
):  # fmt: skip
    """J' W J v, J of differences to the mean over each pixel's events, event by event."""
    value, sums = np.zeros(len(first), np.float32), np.zeros(len(total), np.float32)
    for e in range(len(first)):
        one, depth = np.float32(0), np.float32(0)
        for k in range(len(steps)):
            one += v_map[first[e] + steps[k]] * share[e, k]
        for k in range(len(v_path)):
            one += v_path[k] * by_path[e, k]
        for k in range(len(node_steps)):
            depth += v_depth[node[e] + node_steps[k]] * node_share[e, k]
        value[e] = one + by_depth[e] * depth
        sums[pixel[e]] += weight[e] * value[e]
    to_map, to_path, to_depth = np.zeros_like(v_map), np.zeros_like(v_path), np.zeros_like(v_depth)
    for e in range(len(first)):
        z = weight[e] * (value[e] - sums[pixel[e]] / total[pixel[e]])
        for k in range(len(steps)):
            to_map[first[e] + steps[k]] += z * share[e, k]
        for k in range(len(v_path)):
            to_path[k] += z * by_path[e, k]
        z *= by_depth[e]
        for k in range(len(node_steps)):
            to_depth[node[e] + node_steps[k]] += z * node_share[e, k]
    return to_map, to_path, to_depth


def normal_bench() -> tuple[dict[str, float], dict[str, float]]:
    """One J' W J v of the batch fit, of 60,000 events where they are, beside a drawn map."""
    recording, truth = motion_scene("texture", "varying", 200, duration=0.4)
    assert recording.camera is not None
    windows = WindowFitter(recording, BatchParams.of({}), recording.camera)
    series, prior = windows.series(200_000, 0.15, MAX_SCORED_EVENTS), windows.prior(200_000, 0.15)
    T, Omega = (part[0] for part in truth.twist(np.array([0.2])))
    rng, real = np.random.default_rng(0), series.x.dtype
    depths = np.full(math.prod(series.nodes), np.log(np.linalg.norm(T)), real)
    path = Path.constant_twist(T / np.linalg.norm(T), Omega, depths)
    scene = Scene(path, rng.normal(size=series.shape).astype(real), 0.0)
    made = linearise(
        *photometric_ba.init_problem(series, scene, prior, 1.0, plane=False), map_only=False
    )
    jacobian, weight = made.jacobian, made.evaluation.weight
    E, n = len(weight), N_PATH_UNKNOWNS + len(jacobian.more)
    v = rng.normal(size=series.shape), rng.normal(size=n), rng.normal(size=len(depths))
    v = v[0].astype(real), np.append(v[1], np.zeros(N_PATH_UNKNOWNS + 4 - n)), v[2].astype(real)

    def product() -> Unknowns:
        value = made.jacobian_product(v)
        subtract_mean(value, weight, series.begin)
        value *= weight
        return made.transpose_product(value)

    powers = jacobian.tau[:, None] ** np.arange(1, N_COEFFICIENT_ROWS + 1)
    by_path = (jacobian.base.T[:, :, None] * powers[:, None]).reshape(
        E, -1
    ) @ made.coefficient_jacobian
    across, down = (
        np.stack([(0.5 - t) ** 2 / 2, 0.75 - t**2, (0.5 + t) ** 2 / 2], 1)
        for t in (jacobian.u, jacobian.v)
    )
    share = (down[:, :, None] * across[:, None]).reshape(E, 9)
    right, low = (np.stack([1 - t, t], 1) for t in (jacobian.across, jacobian.down))
    node_share = (low[:, :, None] * right[:, None]).reshape(E, 4)
    steps = (series.shape[1] * np.arange(3)[:, None] + np.arange(3)).ravel()
    node_steps = (series.nodes[1] * np.arange(2)[:, None] + np.arange(2)).ravel()
    pixel = np.repeat(np.arange(len(series.begin) - 1), np.diff(series.begin))
    total = np.maximum(np.bincount(pixel, weight), 1e-3)
    given = v[0].ravel(), v[1][:n], v[2], share, node_share, weight, total
    v_map, v_path, v_depth, share, node_share, own, total = (x.astype(np.float32) for x in given)
    by_path = np.concatenate([by_path, jacobian.more.T], 1).astype(np.float32)
    arguments = (
        v_map, v_path, v_depth, jacobian.first, steps, share, jacobian.node, node_steps, node_share,
        by_path, jacobian.by_depth, own, pixel, total,
    )  # fmt: skip
    for ours, its in zip(product(), normal_loop(*arguments), strict=True):
        ours = ours.ravel()[: its.size]
        np.testing.assert_allclose(ours, its.ravel(), rtol=0, atol=1e-3 * np.abs(its).max())
    seconds, slow = timed(product, 100), timed(lambda: normal_loop(*arguments), 100)
    name = "batch general motion, one J' W J v"
    speed = {name: E / seconds / 1e6, f"{name}, as a numba loop": E / slow / 1e6}
    return speed, {f"{name} / numba loop": slow / seconds}


def motion_bench() -> tuple[dict[str, float], dict[str, float]]:
    speed, ratio = {}, {}
    for part in (voting_bench, normal_bench, batch_bench):
        more, ratios = part()
        speed, ratio = speed | more, ratio | ratios
    return speed, ratio
