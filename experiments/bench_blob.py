"""Speed of the tracker of blobs, as part of `bench.py`.

    python experiments/bench.py blob tracker

It runs on a simulated blob, beside the same filter as a numba loop and what its authors publish,
0.1 M updates/s.
"""

import functools

import jax
import numba
import numpy as np
from timing import cpu_seconds, least_cpu

from jaxevent.blob import find, moment
from jaxevent.blob.engine.runner import KernelRunner
from jaxevent.blob.filter import EventBatch
from jaxevent.blob.filters.motion import gated_moments
from jaxevent.blob.lifecycle import init_state as begin_state
from jaxevent.blob.prepare import ChunkPacker
from jaxevent.recording import Events, Recording
from jaxevent.simulate import LinearMotion, Target, blob_scene, simulate_blobs


@numba.njit
def blob_loop(t, x, y, start, size, Q, P0, kappa, fourth, limits):
    """The `moment` filter of jaxevent.blob event by event, double precision: the state after each.

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


def blob_steps(recording: Recording, M: int) -> tuple[np.ndarray, EventBatch]:
    """All events in steps of M: seconds between the steps, and the steps' batches."""
    e = recording.events
    assert isinstance(e, Events)
    n = len(e) // M * M
    t = e.t[:n].reshape(-1, M)
    dt = np.diff(t[:, -1], prepend=0) * 1e-6
    xi = np.stack([e.x[:n], e.y[:n]], 1).reshape(-1, M, 2)
    polarity = np.where(e.p[:n], 1.0, -1.0).reshape(-1, M)
    age = (t[:, -1:] - t) * 1e-6
    arrays = (jax.numpy.asarray(part, np.float32) for part in (xi, age, polarity))
    return dt.astype(np.float32), EventBatch(*arrays)


def blob_numbers() -> tuple:
    """What `blob_loop` takes of the parameters of `moment`."""
    p = moment.Params()
    numbers = ("p", "v", "lambda", "theta", "q")
    Q = np.array([float(getattr(p, f"Q_{name}")) for name in numbers])
    P0 = np.array([float(getattr(p, f"P0_{name}")) for name in numbers])
    P0[2] /= float(p.lambda0) ** 2
    limits = np.array([float(v) for v in (p.lambda_min, p.lambda_max, p.P_theta_max)])
    kappa, fourth = (float(v) for v in gated_moments(p))
    return 20.0, Q, P0, kappa, fourth, limits


def tracker_bench() -> tuple[dict[str, float], dict[str, float]]:
    """The tracker by both compilers, in CPU seconds, which other work on the machine spares.

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
    least = least_cpu(tasks)
    speed = {name: events[name] / 1e6 / least[name] for name in tasks}
    base = speed[loop]
    ratio = {
        f"{name} / numba loop": v / base for name, v in speed.items() if name.startswith("tracker")
    }
    return speed, ratio


def blob_bench() -> tuple[dict[str, float], dict[str, float]]:
    """Filters alone and the tracker, on a blob of 100,000 events/s at up to 2014 px/s."""
    recording, truth = blob_scene("lissajous", 0)
    e = recording.events
    assert isinstance(e, Events)
    start, count, shift = truth(0.0)[0, 0, :2] + (3.0, -3.0), 6144, np.arange(64, dtype=np.float32)

    def scan(length, params, start, dt, batch):
        """Position and sizes after every step; or the last state, by loops of `length` steps.

        XLA makes one function of a short loop over little data, as the tracker has it: 0.5 instead
        of 0.25 M steps/s of one blob.
        """
        blob = moment.filter

        def step(state, part):
            dt, batch = part
            weight = jax.numpy.ones(len(batch.age), dt.dtype)
            if len(weight) == 1:  # as the tracker does
                batch = EventBatch(batch.xi, 0 * weight, batch.polarity)
            state = blob.update(params, blob.predict(params, state, dt), batch, weight)
            now = blob.predicted_measurement(params, state)
            return state, None if length else jax.numpy.concatenate([now.p, now.size])

        begin = blob.init(params, start.astype(dt.dtype), jax.numpy.full((), 20.0, dt.dtype))
        if not length:
            return jax.lax.scan(step, begin, (dt, batch))[1]
        parts = jax.tree.map(lambda a: a.reshape(-1, length, *a.shape[1:]), (dt, batch))
        return jax.lax.scan(lambda s, part: jax.lax.scan(step, s, part), begin, parts)[0]

    def seconds(function, given, repeat=15):
        return cpu_seconds(lambda: jax.block_until_ready(function(*given)), repeat)

    info = jax.jit(functools.partial(scan, 0))
    targets = {
        length: jax.jit(jax.vmap(functools.partial(scan, length), (None, 0, None, 0)))
        for length in (64, 256)
    }
    speed, rmse, whole = {}, {}, {}
    for M in (1, 32):
        params = moment.Params(events_per_step=M)
        given = jax.device_put((params, start, *blob_steps(recording, M)))
        states = np.asarray(info(*given), float)
        t = e.t[M - 1 :: M][: len(states)]
        error = (states[:, :2] - truth(t)[:, 0, :2])[t > 100_000]
        rmse[M] = float(np.sqrt((error**2).sum(1).mean()))
        if M == 1:
            by_event = states
        dt, batch = jax.tree.map(lambda part, k=count // M: part[:k], blob_steps(recording, M))
        # As the tracker runs it, for a batch of targets.
        single = params, start[None], dt, jax.tree.map(lambda part: part[None], batch)
        speed[M] = len(dt) * M / 1e6 / seconds(targets[64], single)
    # 64 blobs whose events come at the same times, each at its own place.
    dt, batch = blob_steps(recording, 1)
    batch = jax.tree.map(
        lambda part: jax.numpy.broadcast_to(part[:2048], (64, *part[:2048].shape)), batch
    )
    batch = EventBatch(batch.xi + shift[:, None, None, None], batch.age, batch.polarity)
    given = jax.device_put((moment.Params(), start + shift[:, None], dt[:2048], batch))
    many = 64 * 2048 / 1e6 / seconds(targets[256], given, 40)

    arguments = start, *blob_numbers()
    same = blob_loop(e.t, e.x, e.y, *arguments)
    # But for rounding to single precision.
    assert np.abs(same - by_event).max() < 0.05, "the loop is another filter"
    part = e[: count * 4]
    loop = count * 4 / 1e6 / cpu_seconds(lambda: blob_loop(part.t, part.x, part.y, *arguments), 15)

    for M in (1, 32):
        params = moment.Params(events_per_step=M)
        stream, _ = blob_scene("lissajous", 0, rate=1e6 if M > 1 else 1e5)
        run = functools.partial(moment.estimate, stream, params, seeds=[(*start, 20.0)])
        whole[M] = len(stream.events) / 1e6 / cpu_seconds(run, 10)
    print(
        f"\nblob: RMSE {rmse[1]:.4f} px event by event, {rmse[32]:.4f} px in steps of 32 "
        f"({rmse[32] - rmse[1]:+.4f})"
    )
    names = {
        "blob filter, event by event": speed[1],
        "blob filter, 32 events per step": speed[32],
        "blob filter, 64 blobs vmapped, in all": many,
        "blob filter as a numba loop": loop,
        "blob.track, event by event": whole[1],
        "blob.track, 32 events per step": whole[32],
    }
    ratio = {
        "blob filter, event by event / numba loop": speed[1] / loop,
        "blob filter, 32 events per step / numba loop": speed[32] / loop,
        "blob filter, 64 blobs vmapped / numba loop": many / loop,
        "blob.track, 32 events per step / numba loop": whole[32] / loop,
        "blob filter, event by event / authors' 0.1 M": speed[1] / 0.1,
        "blob.track, event by event / authors' 0.1 M": whole[1] / 0.1,
        "blob.track, 32 events per step / authors' 0.1 M": whole[32] / 0.1,
        "blob: RMSE of 32 events per step / event by event": rmse[32] / rmse[1],
    }
    return names, ratio
