"""Numbers of the variance of `akf` and `aks`, fitted to simulated scenes by likelihood.

    python experiments/variance_fit.py

Twelve scenes of seeds 9000 to 9011: objects before a background that rests or moves, and pans, of
three sensors with 0.4 to 2 grey levels of noise. Every 2nd or 8th frame is given; thresholds are
the default ones, and others that are about right; frame_noise is that of the scene. The variance is
linear in the squares of error_event, error_still and error_change, so four images of each tell it
for all. Strata (no events in the 3x3 pixels around, of neighbours alone, of the pixel's own) count
alike.
"""

import dataclasses
from collections.abc import Iterator
from typing import Any

import numpy as np
from frames_without_settings import strata_of
from motion_compensated import choose_evenly
from numpy.typing import NDArray
from scipy.optimize import minimize

import jaxevent
from jaxevent.camera import UnknownResponse
from jaxevent.recording import Frames, Recording
from jaxevent.runs.protocols import frame_times, held_out
from jaxevent.simulate import SENSORS, MovingObjects, Pan, scene, simulate

NAMES = ("error_event", "error_still", "error_change")
SENSOR_NAMES, SCENES = ("good", "davis", "poor"), ("mountain", "room", "forest", "lake")
THRESHOLDS = (0.1, 0.06)  # ln(I + 1): the default, and about that of these sensors
SIZE, SECONDS, IMAGES = (120, 90), 1.3, 4


def simulated(k: int) -> tuple[MovingObjects | Pan, Recording, float]:
    """Return a scene, its recording, and the noise of its frames."""
    rng, seed = np.random.default_rng(9000 + k), 9000 + k
    noise = float(rng.uniform(0.4, 2.0))
    camera = dataclasses.replace(
        SENSORS[SENSOR_NAMES[k % 3]], frame_rate=25.0, exposure=5e-4, exposure_samples=2,
        response=UnknownResponse(), read_noise=noise,
    )  # fmt: skip
    common: dict[str, Any] = {"size": SIZE, "duration": SECONDS, "seed": seed}
    if k % 4 < 2:
        source = MovingObjects(speed=rng.uniform(40, 150), background=0.5 * (k % 4), **common)
    else:
        light = scene(SCENES[k // 4], decades=1.0)
        light *= 0.9 / np.quantile(light, 0.9999)
        source = Pan(light, speed=float(rng.uniform(20, 150)), **common)
    return source, simulate(source, camera, seed), (noise**2 + 1 / 12) ** 0.5 / 255


def samples() -> Iterator[tuple[str, NDArray, NDArray]]:
    """Iterate over strata: method, squared errors (n,), and the variances' four parts (4, n)."""
    for k in range(12):
        source, recording, noise = simulated(k)
        for gap in (2, 8):
            given, hidden = held_out(recording, gap)
            assert given.frames is not None
            last = int(np.searchsorted(hidden.t, given.frames.t[-1]))
            seen = hidden[choose_evenly(np.arange(last), IMAGES)]
            images = np.stack([source.intensity(t * 1e-6) for t in seen.t.tolist()])
            truth = Frames(seen.t, images.clip(0, 1).astype(np.float32), np.zeros_like(seen.t))
            methods: tuple[Any, ...] = (jaxevent.akf, jaxevent.aks)
            for method in methods:
                for c in THRESHOLDS:
                    none: dict[str, Any] = dict.fromkeys(NAMES, 0.0)
                    params = method.Params(c_on=c, c_off=c, frame_noise=noise, **none)
                    times, parts = frame_times(truth, params), []
                    for name in ("", *NAMES):
                        one = params.replace(**{name: 1.0}) if name else params
                        made = method.estimate(given, one, progress=False)(times, extrapolate=True)
                        parts.append(made.covariance - (parts[0] if parts else 0))
                    error = np.log((made.mean.clip(0, 1) + 1) / (truth.intensity + 1)) ** 2
                    strata = strata_of(given, truth, times)
                    for where in (strata[n] for n in ("still", "around", "own")):
                        if where.sum() > 200:
                            yield method.name, error[where], np.stack(parts)[:, where]


def main() -> None:
    found = list(samples())
    for methods in (("akf",), ("aks",), ("akf", "aks")):

        def loss(logs: NDArray, methods: tuple[str, ...] = methods) -> float:
            weights, total = np.concatenate([[1.0], np.exp(2 * logs)]), 0.0
            for name, error, parts in found:
                V = weights @ parts
                total += float((np.log(V) + error / V).mean()) if name in methods else 0.0
            return total

        best = minimize(
            loss, np.log([0.3, 0.1, 0.35]), method="Nelder-Mead", options={"fatol": 0.1}
        )
        numbers = ", ".join(f"{n} {v:.3f}" for n, v in zip(NAMES, np.exp(best.x), strict=True))
        print(f"{' and '.join(methods)}: {numbers}")


if __name__ == "__main__":
    main()
