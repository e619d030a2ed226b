"""How much less certain and less near tracks are with the steps that an accuracy chooses.

    python experiments/blob_accuracy.py [--seeds 2]

A simulated target of (5, 4) px circles at 500 px/s with 40,000 events/s. Events per step are chosen
by `TargetSearchResult.settings(accuracy)`; standard deviation and rms error of the filtered
position, at times all over the steps, are divided by those of event by event, in one process. The
bound is for both.
"""

import argparse
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxevent.blob import TargetSearchResult, moment
from jaxevent.blob.search.paths import TargetPath, fit_velocity_noise
from jaxevent.recording import Recording
from jaxevent.simulate.blobs import CircularMotion, Target, simulate_blobs

WINDOW = 5000  # us
ACCURACIES = (0.02, 0.1, 0.5)


def known(recording: Recording, truth: Any) -> TargetSearchResult:
    """The target as a search in windows would find it, from its true path."""
    t = np.arange(WINDOW // 2, 1e6 * truth.duration, WINDOW).astype(np.int64)
    p, v = truth(t)[:, 0, :2], truth(t)[:, 0, 2:4]
    C = np.broadcast_to(np.diag([25.0, 16.0]), (len(t), 2, 2))
    noise = fit_velocity_noise(t * 1e-6, p, np.full(len(t), 25 / 200), 25 / (WINDOW * 1e-6) ** 3)
    path = TargetPath(t, p, v, C, np.full(len(t), 200.0), WINDOW, noise)
    return TargetSearchResult((path,), (), 0, 0.0, recording)


def told(
    found: TargetSearchResult, truth: Any, M: int, times: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Standard deviation (px) and rms error (px)."""
    settings: dict[str, Any] = found.settings() | {"events_per_step": M}
    params = moment.Params(**settings)
    tracks = moment.estimate(found.recording, params, found=found, smooth=False, progress=False)
    states = tracks(times)
    error = np.hypot(*(states.mean[:, 0, :2] - truth(times)[:, 0, :2]).T)
    sigma = np.sqrt(states.covariance[:, 0, 0, 0].mean())
    return np.array([sigma, np.sqrt((error**2).mean())])


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=2)
    args = parser.parse_args()
    times = np.arange(50_000, 245_000, 487)
    print("| seed | accuracy | events per step | sigma / M = 1 | rms / M = 1 |")
    print("|---|" + "---:|" * 4)
    for seed in range(args.seeds):
        circle = CircularMotion((64, 48), 25, 20.0, 0.3, size=(5.0, 4.0))
        recording, truth = simulate_blobs([Target(circle, 4e4)], (128, 96), 0.25, 2e3, seed)
        found = known(recording, truth)
        usual = told(found, truth, 1, times)
        for accuracy in ACCURACIES:
            M = found.settings(accuracy)["events_per_step"]
            sigma, rms = told(found, truth, M, times) / usual
            print(f"| {seed} | {accuracy:g} | {M} | {sigma:.3f} | {rms:.3f} |", flush=True)


if __name__ == "__main__":
    main()
