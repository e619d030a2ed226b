"""Speed of the smoother `aks`: its kernel, the scan, and a plain numba program beside them.

    python experiments/bench_smoother.py [--repeat N] [--exposed]

A stream of 5 M events at 346x260 (bench.py), 200 images in 2 s. The program passes forwards and
backwards over whole images, in double precision on one core, with the arithmetic of the smoother's
defaults: exposures not known (--exposed: the kernel and the scan deblur those of 10 ms, the program
does not), nothing clipped. The preset `hdr` spreads changes over time. Then the loss at 8 images of
the prepared recording, and it with its gradient by 8 parameters. CPU seconds of one process, minima
of repeats in turn.
"""

import argparse
import dataclasses
from typing import Any

import numba
import numpy as np
from bench import machine
from bench_images import losses, stream
from timing import least_cpu

import jaxevent
from jaxevent.recording import Recording

# The parameters that losses are differentiated by, and how they are called here.
OF_AKS = ("c_on", "c_off", "I0", "sigma_event", "sigma_bg", "sigma_frame", "sigma_floor", "share")
SHOWN = {
    "numba loss": "loss, kernel",
    "numba gradient": "loss and gradient, kernel",
    "xla loss": "loss, XLA",
    "xla gradient": "loss and gradient, XLA",
}


@numba.njit
def mixed(counts, share):
    """Event counts of which each pixel gives a part to its neighbours."""
    height, width = counts.shape
    out = np.empty((height, width))
    for y in range(height):
        for x in range(width):
            total, number = 0.0, 0
            for row in range(max(y - 1, 0), min(y + 2, height)):
                for column in range(max(x - 1, 0), min(x + 2, width)):
                    total += counts[row, column]
                    number += 1
            own = counts[y, x]
            out[y, x] = own + share * ((total - own) / 8 - (number - 1) / 8 * own)
    return out


@numba.njit
def program(t, x, y, p, image, certainty, mid, times, numbers):
    """Kalman filter over frames, information filter back, and images between them."""
    c_on, c_off, I0, sigma_event, sigma_bg, sigma_frame, floor, m0, P0, share = numbers
    frames, height, width = image.shape
    size = height, width
    m, P = np.full(size, m0), np.full(size, P0)
    past_m, past_P = np.empty(image.shape), np.empty(image.shape)
    h, J = np.empty(image.shape), np.empty(image.shape)
    moved = np.zeros((frames, 2, height, width))
    i = np.searchsorted(t, mid[0])
    for k in range(frames):
        z = np.log(image[k] + I0)
        said = 1 / ((sigma_frame / certainty[k] / (image[k] + I0)) ** 2 + floor**2)
        h[k], J[k] = said * z, said
        past_P[k] = P / (1 + P * said)
        past_m[k] = m + past_P[k] * (h[k] - said * m)
        if k + 1 < frames:
            counts = np.zeros((2, height, width))
            while i < len(t) and t[i] < mid[k + 1]:
                counts[0 if p[i] else 1, y[i], x[i]] += 1
                i += 1
            for polarity in range(2):
                moved[k, polarity] = mixed(counts[polarity], share)
            m = past_m[k] + c_on * moved[k, 0] - c_off * moved[k, 1]
            q = sigma_event**2 * (c_on**2 * moved[k, 0] + c_off**2 * moved[k, 1])
            P = past_P[k] + q + sigma_bg**2 * (mid[k + 1] - mid[k]) * 1e-6
    later_h, later_J = np.zeros(size), np.zeros(size)
    for k in range(frames - 1, -1, -1):
        own_h, own_J = h[k].copy(), J[k].copy()
        h[k], J[k] = later_h, later_J  # what is said at the next frame
        if k + 1 < frames:
            q = sigma_event**2 * (c_on**2 * moved[k, 0] + c_off**2 * moved[k, 1])
            q += sigma_bg**2 * (mid[k + 1] - mid[k]) * 1e-6
            fade = 1 / (1 + q * later_J)
            own_h += (later_h - later_J * (c_on * moved[k, 0] - c_off * moved[k, 1])) * fade
            own_J += later_J * fade
        later_h, later_J = own_h, own_J
    out = np.empty((2, len(times), height, width), np.float32)
    f, i = -1, 0
    counts = np.zeros((2, height, width))
    for n in range(len(times)):
        now = times[n]
        while f + 1 < frames and mid[f + 1] <= now:
            f += 1
            counts[:] = 0
            i = np.searchsorted(t, mid[f])
        while i < len(t) and t[i] <= now:
            counts[0 if p[i] else 1, y[i], x[i]] += 1
            i += 1
        on, off = mixed(counts[0], share), mixed(counts[1], share)
        elapsed = (now - mid[f]) * 1e-6
        left = (mid[f + 1] - now) * 1e-6 if f + 1 < frames else 0.0
        for row in range(height):
            for column in range(width):
                a, b = on[row, column], off[row, column]
                u, v = moved[f, 0, row, column] - a, moved[f, 1, row, column] - b
                mean = past_m[f, row, column] + c_on * a - c_off * b
                spread = sigma_event**2 * (c_on**2 * a + c_off**2 * b) + sigma_bg**2 * elapsed
                q = sigma_event**2 * (c_on**2 * u + c_off**2 * v) + sigma_bg**2 * left
                fade = 1 / (1 + q * J[f, row, column])
                told = (h[f, row, column] - J[f, row, column] * (c_on * u - c_off * v)) * fade
                weight = J[f, row, column] * fade
                V = 1 / (1 / (past_P[f, row, column] + spread) + weight)
                out[0, n, row, column] = np.exp(mean + V * (told - weight * mean)) - I0
                out[1, n, row, column] = V
    return out


def program_images(recording: Recording, times: np.ndarray) -> np.ndarray:
    frames, v = recording.frames, jaxevent.aks.Params().values()
    assert frames is not None
    grey = np.asarray(frames.images)
    table = np.arange(256) / 255
    certain = np.maximum(np.asarray(recording.response.certainty(table)), v["w_min"])
    image = np.asarray(recording.response.intensity(table))[grey]
    names = ("c_on", "c_off", "I0", "sigma_event", "sigma_bg", "sigma_frame", "sigma_floor")
    numbers = [v[name] for name in names] + [np.log(v["start"] + v["I0"]), v["P_start"], v["share"]]
    e = recording.events[:]
    return program(e.t, e.x, e.y, e.p, image, certain[grey], frames.t, times,
                   tuple(float(n) for n in numbers))  # fmt: skip


def images_by(
    recording: Recording, times: np.ndarray, compiler: str, preset: str | None = None
) -> np.ndarray:
    params = jaxevent.aks.Params(preset=preset)
    made = jaxevent.aks.estimate(recording, params, compiler=compiler, progress=False)
    return np.concatenate([np.asarray(part.mean) for _, part in made.batches(times)])


def smoother_bench(
    repeat: int = 3, exposed: bool = False
) -> tuple[dict[str, float], dict[str, float]]:
    """M events per CPU second, and ratios."""
    recording = stream(5_000_000, 2.0, 0)
    frames = recording.frames
    assert frames is not None
    if exposed:
        exposure = np.full(len(frames.t), 10_000)
        frames = dataclasses.replace(frames, exposure=exposure)
        recording = dataclasses.replace(recording, frames=frames)
    times = np.arange(frames.t[0], recording.stop, 10_000)
    ways: dict[str, Any] = {
        "numba program": lambda: program_images(recording, times)[0],
        "kernel": lambda: images_by(recording, times, "numba"),
        "compiled by XLA": lambda: images_by(recording, times, "xla"),
        "kernel, one image": lambda: images_by(recording, times[:1], "numba"),
        "kernel, preset hdr": lambda: images_by(recording, times, "numba", "hdr"),
        "preset hdr, compiled by XLA": lambda: images_by(recording, times, "xla", "hdr"),
    }
    if not exposed:
        worst = abs(ways["kernel"]() - ways["numba program"]()).max()
        assert worst < 1e-4, worst
    of_losses = losses(recording, jaxevent.aks, jaxevent.aks.Params(), OF_AKS)
    ways |= {shown: of_losses[name] for name, shown in SHOWN.items()}
    least = least_cpu(ways, repeat)
    speed = {f"smoother, {n}": len(recording.events) / 1e6 / cpu for n, cpu in least.items()}
    whole, gradient = least["numba program"], "loss and gradient, kernel"
    ratio = {
        "smoother / numba program": whole / least["kernel"],
        "smoother, one image / numba program": whole / least["kernel, one image"],
        "smoother / the same compiled by XLA": least["compiled by XLA"] / least["kernel"],
        "smoother, preset hdr / the same compiled by XLA": least["preset hdr, compiled by XLA"]
        / least["kernel, preset hdr"],
        "smoother: loss and 8 gradients / loss": least[gradient] / least["loss, kernel"],
    }
    return speed, ratio


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--exposed", action="store_true")
    arguments = parser.parse_args()
    speed, ratio = smoother_bench(arguments.repeat, arguments.exposed)
    print(f"{machine()}; M events per CPU second, and ratios")
    for name, value in (speed | ratio).items():
        print(f"{name:45} {value:7.2f}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
