"""What the mean error of the log of noisy frames, equation 6 of the AKF paper, is worth.

    python experiments/log_bias.py                  # some minutes on two shared cores

Scenes of `jaxevent.simulate`, 96x72 pixels, panned slowly and fast, recorded by a DAVIS whose
frames have little and much read noise. The AKF with the sensor's thresholds, with `log_bias` 0
(none), -1 (subtracted, as (6) prints it) and the frame rate (what makes it good), by the paper's
constants and by `preset = "hdr"`; and by the paper's with `kappa` such that 1 / (kappa w) times the
frame rate is the variance of the read noise. Geometric means over scenes and seeds.
"""

import argparse
import dataclasses

import numpy as np

import jaxevent
from jaxevent.runs.scores import score
from jaxevent.simulate import SENSORS, Pan, scene, simulate
from jaxevent.simulate.scenes import Speed

SCENES: tuple[tuple[str, Speed], ...] = (("lake", "slow"), ("room", "fast"), ("forest", "slow"))
NOISES = (0.7, 6.0)  # grey levels
RATE = 50.0  # frames per second
SIZE = (96, 72)


def measures(row: dict) -> list[float]:
    regions = row["regions"]
    return [row["mse"], row["log_mse"], regions["dark"]["log_mse"], regions["well"]["log_mse"]]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--seeds", type=int, default=1)
    seeds = range(parser.parse_args().seeds)
    print("| constants | read noise | log_bias | MSE | log MSE | dark | well-exposed |")
    print("|---|---:|---:|---:|---:|---:|---:|")
    for noise in NOISES:
        sensor = dataclasses.replace(SENSORS["davis"], read_noise=noise, exposure_samples=2)
        recordings = [
            simulate(Pan(scene(name), SIZE, 0.6, speed, seed), sensor, seed)
            for seed in seeds
            for name, speed in SCENES
        ]
        # Var of grey is (noise / 255)^2; of intensity, at full certainty, about the same.
        matched = RATE / (noise / 255) ** 2
        for label, about in (
            ("paper", {"preset": "paper"}),
            ("paper, kappa of the noise", {"preset": "paper", "kappa": matched}),
            ("hdr", {"preset": "hdr"}),
        ):
            for bias in (0.0, -1.0, RATE):
                params = jaxevent.akf.Params.of(
                    {"c_on": 0.2, "c_off": 0.18, "log_bias": bias, **about}
                )
                rows = [measures(score(r, jaxevent.akf, params, "reference")) for r in recordings]
                means = np.exp(np.mean(np.log(rows), 0))
                cells = " | ".join(f"{value:.4g}" for value in means)
                print(f"| {label} | {noise:g} | {bias:g} | {cells} |", flush=True)


if __name__ == "__main__":
    main()
