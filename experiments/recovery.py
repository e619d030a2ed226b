"""Parameters used to simulate are found again by the likelihood of the frames alone.

    python experiments/recovery.py

Once with data drawn from the smoother's own model, where all its noises have true values, once with
a simulated sensor, where the thresholds, the dark offset and the frames' clock have.
"""

import numpy as np

import jaxevent
from jaxevent.recording import Events, Frames, Recording
from jaxevent.runs.reconstruction import Objective, Part, Problem
from jaxevent.simulate import Pan, Sensor, scene, simulate
from jaxevent.tuning import Settings, optimise

TRUE = {
    "c_on": 0.12,
    "c_off": 0.09,
    "sigma_event": 0.2,
    "sigma_bg": 0.3,
    "sigma_frame": 0.012,
}


def from_model(seed: int = 0, size: tuple[int, int] = (32, 24), frames: int = 40) -> Recording:
    """Draw a recording from the smoother's model with the true values; I0 = 0.2.

    Events come at random; their polarity pulls their own sum back to the middle, so that frames are
    rarely near black or white. (It must not depend on the noise: the likelihood is of the frames,
    given the events.)
    """
    rng = np.random.default_rng(seed)
    width, height = size
    pixels, gap = width * height, 20_000
    I0, middle = 0.2, np.log(0.3 + 0.2)
    x = middle + rng.normal(0, 0.2, pixels)
    total = np.zeros(pixels)
    t, where, up, images = [], [], [], []
    for k in range(frames):
        noise = rng.normal(0, TRUE["sigma_frame"], pixels)
        images.append(np.clip(np.exp(x) - I0 + noise, 0.001, 0.999))
        count = rng.poisson(4, pixels)
        for pixel in range(pixels):
            times = np.sort(rng.integers(1, gap, count[pixel])) + k * gap
            for time in times:
                on = rng.random() < 1 / (1 + np.exp(6 * total[pixel]))
                c = TRUE["c_on"] if on else TRUE["c_off"]
                total[pixel] += c if on else -c
                x[pixel] += (c if on else -c) + rng.normal(0, TRUE["sigma_event"] * c)
                t.append(time)
                where.append(pixel)
                up.append(on)
        x += rng.normal(0, TRUE["sigma_bg"] * np.sqrt(gap * 1e-6), pixels)
    order = np.argsort(t, kind="stable")
    y, column = np.divmod(np.array(where)[order], width)
    events = Events(
        np.array(t, np.int64)[order], column.astype(np.uint16), y.astype(np.uint16),
        np.array(up)[order],
    )  # fmt: skip
    stack = np.array(images, np.float32).reshape(frames, height, width)
    stamps = np.arange(frames, dtype=np.int64) * gap
    return Recording(
        "model", width, height, events, Frames(stamps, stack, np.zeros(frames, np.int64))
    ).check()


def fitted(recording: Recording, start, names, search, iterations: int):
    """The parameters that maximise the likelihood."""
    assert recording.frames is not None
    part = Part(recording, recording.frames, np.arange(0), np.arange(0))
    problem = Problem(Objective(jaxevent.aks, None), [part])
    settings = Settings(iterations=iterations, learning_rate=0.1, rounds=2)
    return optimise(
        problem.objective, start, names, problem, settings=settings, search=search
    ).params


def model_recovery(iterations: int = 100) -> dict[str, tuple[float, float]]:
    """True and found values, from a start that is wrong by a factor of 2 or so."""
    start = jaxevent.aks.Params(
        c_on=0.2, c_off=0.2, I0=0.2, sigma_event=0.1, sigma_bg=0.1, sigma_frame=0.03,
        sigma_floor=1e-4, w_min=1.0, share=0.0,
    )  # fmt: skip
    params = fitted(from_model(), start, list(TRUE), None, iterations)
    return {name: (value, float(getattr(params, name))) for name, value in TRUE.items()}


def sensor_recovery(seed: int = 0) -> dict[str, tuple[float, float]]:
    """The same for a simulated sensor: a slow pan, 2 s, all noise of a DAVIS.

    Events lag the intensity: on average it has moved half a threshold on since the last one. The
    offset found for the frames' clock contains that lag, half the time between a pixel's events.
    """
    sensor = Sensor(c_on=0.22, c_off=0.16, clock_offset=0.004, refractory=1e-3)
    pan = Pan(scene("forest"), speed="slow", duration=2.0, seed=seed)
    recording = simulate(pan, sensor, seed)
    start = jaxevent.aks.Params(preset="hdr", c_on=0.3, c_off=0.3, sigma_event=0.3)
    names = ["c_on", "c_off", "sigma_event", "sigma_bg", "sigma_frame", "sigma_floor"]
    search = {"clock_offset": (-0.012, 0.012, 9), "rho_ref": (0.0, 0.003, 7)}
    params = fitted(recording, start, names, search, 60)
    true = {"c_on": 0.22, "c_off": 0.16, "clock_offset": 0.004, "rho_ref": 1e-3}
    return {name: (value, float(getattr(params, name))) for name, value in true.items()}


def main() -> None:
    for title, found in (("model", model_recovery()), ("sensor", sensor_recovery())):
        print(f"\n| {title} | true | found | error |\n|---|---:|---:|---:|")
        for name, (true, value) in found.items():
            print(f"| `{name}` | {true:.4g} | {value:.4g} | {100 * (value / true - 1):+.1f} % |")


if __name__ == "__main__":
    main()
