"""Speed of the tracker of blobs, as part of `bench.py`.

    python experiments/bench.py tracker

It runs on a simulated blob, beside the same filter as a numba loop.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import numba
import numpy as np
from common import least_cpu

from jaxevent.blob import find, moment, negative_log_likelihood
from jaxevent.blob.engine.runner import KernelRunner
from jaxevent.blob.filters.motion import gated_moments
from jaxevent.blob.lifecycle import init_state as begin_state
from jaxevent.blob.prepare import ChunkPacker
from jaxevent.simulate import LinearMotion, Target, blob_scene, simulate_blobs

GRADIENT = "loss and 3 gradients"
SCANNED_GRADIENT = "loss and 3 gradients by XLA"


@numba.njit
def blob_loop(t, x, y, start, size, Q, P0, kappa, fourth, limits):
    """Run the `moment` filter event by event in double precision; return the state after each.

    Q and P0 are of (p, v, lambda, theta, q), P0 of log lambda; limits are lambda_min, lambda_max
    and P_theta_max.
    """
    px, py, vx, vy = start[0], start[1], 0.0, 0.0
    theta, q = 0.0, 0.0
    log1 = log2 = np.log(size)
    pxx, pxy, pyy = P0[0], 0.0, P0[0]
    axx, axy, ayx, ayy = 0.0, 0.0, 0.0, 0.0  # of position and velocity
    vxx, vxy, vyy = P0[1], 0.0, P0[1]
    P1 = P2 = P0[2]
    tt, tq, qq = P0[3], 0.0, P0[4]
    variance = 3 * fourth - kappa**2
    low, high = np.log(limits[0]), np.log(limits[1])
    out = np.empty((len(t), 4))
    last = 0
    for i in range(len(t)):
        dt = (t[i] - last) * 1e-6
        last = t[i]
        px, py = px + dt * vx, py + dt * vy
        more = Q[0] * dt + Q[1] * dt**3 / 3
        pxx += 2 * dt * axx + dt**2 * vxx + more
        pyy += 2 * dt * ayy + dt**2 * vyy + more
        pxy += dt * (axy + ayx) + dt**2 * vxy
        axx, ayy = axx + dt * vxx + Q[1] * dt**2 / 2, ayy + dt * vyy + Q[1] * dt**2 / 2
        axy, ayx = axy + dt * vxy, ayx + dt * vxy
        vxx, vyy = vxx + Q[1] * dt, vyy + Q[1] * dt
        P1, P2 = P1 + Q[2] * dt * np.exp(-2 * log1), P2 + Q[2] * dt * np.exp(-2 * log2)
        theta += dt * q
        tt += 2 * dt * tq + dt**2 * qq + Q[3] * dt + Q[4] * dt**3 / 3
        tq += dt * qq + Q[4] * dt**2 / 2
        qq += Q[4] * dt

        ex, ey = x[i] - px, y[i] - py
        c, s = np.cos(theta), np.sin(theta)
        l1, l2 = np.exp(log1), np.exp(log2)
        u1, u2 = c * ex + s * ey, c * ey - s * ex
        r1 = pxx * c * c + 2 * pxy * c * s + pyy * s * s
        r2 = pxx * s * s - 2 * pxy * c * s + pyy * c * c
        cross = (pyy - pxx) * c * s + pxy * (c * c - s * s)
        V1, V2 = kappa * l1**2 + r1, kappa * l2**2 + r2

        S11 = pxx + l1**2 * c * c + l2**2 * s * s
        S22 = pyy + l1**2 * s * s + l2**2 * c * c
        S12 = pxy + (l1**2 - l2**2) * c * s
        det = S11 * S22 - S12 * S12
        i11, i12, i22 = S22 / det, -S12 / det, S11 / det
        k11, k12 = pxx * i11 + pxy * i12, pxx * i12 + pxy * i22
        k21, k22 = pxy * i11 + pyy * i12, pxy * i12 + pyy * i22
        k31, k32 = axx * i11 + ayx * i12, axx * i12 + ayx * i22
        k41, k42 = axy * i11 + ayy * i12, axy * i12 + ayy * i22
        px, py = px + k11 * ex + k12 * ey, py + k21 * ex + k22 * ey
        vx, vy = vx + k31 * ex + k32 * ey, vy + k41 * ex + k42 * ey
        vxx, vxy, vyy = (
            vxx - k31 * axx - k32 * ayx,
            vxy - k31 * axy - k32 * ayy,
            vyy - k41 * axy - k42 * ayy,
        )
        axx, axy, ayx, ayy = (
            axx - k11 * axx - k12 * ayx,
            axy - k11 * axy - k12 * ayy,
            ayx - k21 * axx - k22 * ayx,
            ayy - k21 * axy - k22 * ayy,
        )
        pxx, pxy, pyy = (
            pxx - k11 * pxx - k12 * pxy,
            pxy - k11 * pxy - k12 * pyy,
            pyy - k21 * pxy - k22 * pyy,
        )

        a1, a2, b1, b2, b12 = l1**2 / V1, l2**2 / V2, r1 / V1, r2 / V2, cross / np.sqrt(V1 * V2)
        P1, P2 = min(P1, 1.0), min(P2, 1.0)
        slope, noise = variance * a1, variance * a1**2 + 4 * kappa * a1 * b1 + 2 * b1**2
        total = slope**2 * P1 + noise
        log1 += np.log1p(slope**2 * P1 / total * (u1**2 / V1 - 1)) / slope
        log1 = min(max(log1, low), high)
        P1 *= noise / total
        slope, noise = variance * a2, variance * a2**2 + 4 * kappa * a2 * b2 + 2 * b2**2
        total = slope**2 * P2 + noise
        log2 += np.log1p(slope**2 * P2 / total * (u2**2 / V2 - 1)) / slope
        log2 = min(max(log2, low), high)
        P2 *= noise / total

        slope = fourth * (l1**2 - l2**2) / np.sqrt(V1 * V2)
        noise = fourth * a1 * a2 + kappa * (a1 * b2 + a2 * b1) + b1 * b2 + b12**2
        if tt > limits[2]:
            tq *= limits[2] / tt
            tt = limits[2]
        total = slope**2 * tt + noise
        gain = slope / total * (u1 * u2 / np.sqrt(V1 * V2) - b12)
        theta, q = theta + gain * tt, q + gain * tq
        theta -= 2 * np.pi * np.round(theta / (2 * np.pi))
        inner = slope**2 * max(tt * qq - tq**2, 0.0)
        tt, tq, qq = tt * noise / total, tq * noise / total, (qq * noise + inner) / total
        out[i, 0], out[i, 1], out[i, 2], out[i, 3] = px, py, np.exp(log1), np.exp(log2)
    return out


def blob_numbers() -> tuple:
    """Return the arguments of `blob_loop` for the default parameters of `moment`."""
    p = moment.Params()
    numbers = ("p", "v", "lambda", "theta", "q")
    Q = np.array([float(getattr(p, f"Q_{name}")) for name in numbers])
    P0 = np.array([float(getattr(p, f"P0_{name}")) for name in numbers])
    P0[2] /= float(p.lambda0) ** 2
    limits = np.array([float(v) for v in (p.lambda_min, p.lambda_max, p.P_theta_max)])
    kappa, fourth = (float(v) for v in gated_moments(p))
    return 20.0, Q, P0, kappa, fourth, limits


def tracker_bench() -> tuple[dict[str, float], dict[str, float]]:
    """Measure the tracker by both compilers, in CPU seconds.

    One target, from a seed. The loop over packed events, and `estimate` in all. Interleaved, the
    least of each, beside `blob_loop`, which neither gates nor tells of births and deaths.
    """
    speed, tasks, events = {}, {}, {}
    recording, truth = blob_scene("lissajous", 0)
    start, e = truth(0.0)[0, 0, :2] + (3.0, -3.0), recording.events[:24_576]
    loop, numbers = "blob filter as a numba loop", blob_numbers()
    tasks[loop] = lambda: blob_loop(e.t, e.x, e.y, start, *numbers)
    events[loop] = len(e)
    for M in (1, 32):
        params, seeds = moment.Params(events_per_step=M), [(*start, 20.0)]
        many, _ = blob_scene("lissajous", 0, rate=3e6 if M > 1 else 3e5)
        packing = ChunkPacker(
            many, params, seeds, events_per_segment=KernelRunner.events_per_segment
        )
        segment = packing.pack(packing.first)
        state = begin_state(moment.filter, params, segment.features)
        kernel = KernelRunner(moment.filter, params)
        name = f"tracker, M = {M}, loop over packed events"
        tasks[name] = functools.partial(kernel.run, state, segment.features)
        events[name] = int(np.count_nonzero(segment.features.valid))
        for compiler in ("numba", "xla"):
            name = f"tracker, M = {M}, `estimate` by {compiler}"
            tasks[name] = functools.partial(
                moment.estimate, many, params, seeds=seeds, compiler=compiler, progress=False
            )
            events[name] = len(many.events)
    paths = ((200, 300), (600, 50)), ((900, 400), (-500, 100)), ((600, 150), (0, 300))
    lines = [LinearMotion(at, velocity, size=(8.0, 8.0)) for at, velocity in paths]
    scene, _ = simulate_blobs([Target(line, 2.5e5) for line in lines], (1280, 720), 0.6, 2.5e5)
    found = "`find` at 1280x720"
    tasks[found] = functools.partial(find, scene, progress=False)
    events[found] = len(scene.events)
    for name, count in (("loss", 2e5), (GRADIENT, 2e5), (SCANNED_GRADIENT, 2e4)):
        tasks[f"tracker, M = 1: {name}"], events[f"tracker, M = 1: {name}"] = fit_task(name, count)
    least = least_cpu(tasks)
    speed = {name: events[name] / 1e6 / least[name] for name in tasks}
    base = speed[loop]
    ratio = {
        f"{name} / numba loop": v / base
        for name, v in speed.items()
        if name.startswith("tracker") and ": " not in name
    }
    loss, kernel, scan = (
        speed[f"tracker, M = 1: {name}"] for name in ("loss", GRADIENT, SCANNED_GRADIENT)
    )
    ratio["tracker, M = 1: loss and 3 gradients / loss"] = loss / kernel
    ratio["tracker, M = 1: loss and 3 gradients by numba / by XLA"] = kernel / scan
    return speed, ratio


def fit_task(name: str, rate: float) -> tuple[Callable[[], Any], int]:
    """Make the loss of a tracker, or the loss with gradients by three numbers.

    Args:
        name: "loss", `GRADIENT` or `SCANNED_GRADIENT`.
        rate: Events per second of the simulated blob.

    Returns:
        The task, compiled when it is first called, and its number of events.
    """
    recording, truth = blob_scene("lissajous", 0, rate=rate)
    params, seeds = moment.Params(), [(*truth(0.0)[0, 0, :2], 20.0)]
    features, _ = moment.prepare(recording, np.empty(0), params, seeds=seeds)
    raw = {n: params.raw[n] for n in ("Q_p", "Q_v", "Q_lambda")}
    compiler = "xla" if name == SCANNED_GRADIENT else "numba"

    def loss(raw: Any, features: Any) -> Any:
        moved = params.with_raw(raw)
        return negative_log_likelihood(moment, moved, features, "all", compiler)

    compute = jax.jit(loss if name == "loss" else jax.jacfwd(loss))
    features = jax.device_put(features)
    return lambda: jax.block_until_ready(compute(raw, features)), len(recording.events)
