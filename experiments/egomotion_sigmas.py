"""Predicted errors of egomotion against the errors that are made.

    python experiments/egomotion_sigmas.py --out sigmas [--seeds 300 301 302] [--data FOLDER]
        [--methods contrast planes]

For every method and scene: the mean squared standardised error of each component, (estimate -
truth)^2 / variance, over estimates and seeds, 1 where sigmas are right; and the mean relative
error, %. They are taken at the estimates: between two of them both are averaged. Scenes are
an ideal camera of 160x120, f = 200 px: planar motion and rotation, constant and varying, and of
each with contrast a cut of 100 ms, which is a single window. With --data FOLDER also
slider_depth.zip (planar, against its poses at the depth that fits best) and rotating_disk_imu.npz
(roll against its gyro's mean over an estimate's window), with the parameters that suit them.
Without seeds these alone. Constants were chosen on seeds 300 and 301 of the simulated scenes, those
of contrast on 710 to 713.
"""

import argparse
import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

import jaxevent
from jaxevent.camera import PinholeCamera
from jaxevent.egomotion import contrast, planes, voting
from jaxevent.egomotion.estimator import MotionEstimator
from jaxevent.egomotion.motion import MotionEstimate
from jaxevent.show.motion import fitted_velocity
from jaxevent.simulate import motion_scene

SETTLE = 200_000  # us, of voting
CUT = 0.2, 0.3  # s, a single window of contrast
METHODS: dict[str, MotionEstimator[Any]] = {
    "voting": voting,
    "contrast": contrast,
    "planes": planes,
}


def shown(motion: MotionEstimate, first: int, last: int) -> np.ndarray:
    """Times (us) within bounds that the estimates show."""
    t = motion.t - np.rint(1e6 * motion.lag).astype(np.int64)
    return t[(t >= first) & (t <= last)]


def standardised(
    name: str, motion: MotionEstimate, t: np.ndarray, true: np.ndarray
) -> dict[str, Any]:
    mean, covariance, valid = motion(t, centred=True, extrapolate=True)
    valid &= np.isfinite(true).all(1)
    row: dict[str, Any] = {"scene": name, "lost %": 100 * (~valid).mean()}
    if not valid.any():
        return row
    d, size = (mean - true)[valid], np.linalg.norm(true[valid], axis=1)
    row["error %"] = 100 * (np.linalg.norm(d, axis=1) / size).mean()
    variance = np.diagonal(covariance[valid], axis1=1, axis2=2)
    for i, component in enumerate(motion.model.components):
        row[component] = (d[:, i] ** 2 / variance[:, i]).mean()
        row[f"sigma {component} %"] = 100 * np.sqrt(variance[:, i].mean()) / size.mean()
    return row


def scenes(seed: int) -> Iterator[tuple[str, str, Any, Any]]:
    size: dict[str, Any] = {"size": (160, 120), "duration": 0.5}
    for texture in ("noise", "shapes"):
        for motion in ("constant", "varying"):
            made = motion_scene("planar", motion, seed, texture=texture, speed=200.0, **size)
            yield f"planar {texture} {motion}", "planar", *made
    for motion in ("constant", "varying"):
        yield f"rotation {motion}", "rotation", *motion_scene("rotation", motion, seed, **size)


def real(data: Path, methods: Sequence[str]) -> Iterator[dict[str, Any]]:
    recording = jaxevent.load(data / "slider_depth.zip")
    t = np.arange(recording.start + 400_000, 3_100_000, 20_000)
    for name in methods:
        method = METHODS[name]
        motion, _ = method.estimate(recording, model="planar").with_flow_consistency(recording)
        true = fitted_velocity(recording, motion)
        yield {"method": name, **standardised("slider_depth, planar", motion, t, true(t))}
    disk = jaxevent.load(data / "rotating_disk_imu.npz")
    camera = PinholeCamera(200.0, 200.0, (disk.width - 1) / 2, (disk.height - 1) / 2)
    disk = dataclasses.replace(disk, camera=camera)
    t = np.arange(disk.start + 300_000, disk.stop - 200_000, 20_000)
    imu = disk.imu
    assert imu is not None
    for name in methods:
        method = METHODS[name]
        params = method.suit(disk, method.Params.of({})).params
        half = 5e5 * float(getattr(params, "duration", 0.03))  # us
        # y-up axes; wx and wy, which the unknown lens makes, are not compared.
        roll = []
        for at in t:
            # The slope of an angle in a window is such a mean of its rate.
            weight = np.maximum(1 - ((imu.t - at) / half) ** 2, 0)
            roll.append([0, 0, -np.average(imu.gyro[:, 2], weights=weight)])
        motion = method.estimate(disk, params, model="rotation")
        yield {"method": name, **standardised("disk", motion, t, np.array(roll))}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--out", type=Path, required=True, help="folder for the table")
    parser.add_argument("--seeds", type=int, nargs="*", default=[300, 301, 302])
    parser.add_argument("--data", type=Path, help="folder of real recordings")
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS))
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    rows = []
    for seed in arguments.seeds:
        for scene, model, recording, source in scenes(seed):
            for name in arguments.methods:
                parts = [(scene, recording, SETTLE, 450_000)]
                if name == "contrast":
                    parts.append((f"{scene}, one window", recording[slice(*CUT)], 240_000, 260_000))
                for title, part, first, last in parts:
                    motion, _ = (
                        METHODS[name].estimate(part, model=model).with_flow_consistency(part)
                    )
                    t = shown(motion, first, last)
                    true = source.velocity(t) if model == "planar" else source.twist(t)[1]
                    rows.append({"method": name, **standardised(title, motion, t, true)})
    if arguments.data:
        rows += list(real(arguments.data, arguments.methods))
    told = pd.DataFrame(rows)
    table = pd.DataFrame(told.groupby(["method", "scene"], sort=False).mean())
    table.to_csv(arguments.out / "sigmas.csv")
    print(table.to_string(na_rep="", float_format="%.2f"))


if __name__ == "__main__":
    main()
