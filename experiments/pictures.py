"""The pictures of README, start page and results: reconstruction, tracks and motion.

    python experiments/pictures.py --out docs [--only reconstruction tracks motion]

They show the packaged recording and simulated scenes. Nothing is fitted.
"""

from pathlib import Path

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
from common import command_line

import jaxevent
from jaxevent import aks, blend, blob, egomotion, flow, mc, simulate
from jaxevent.metrics import mse
from jaxevent.show.images import tone_map

RECORDING = Path(jaxevent.__file__).parent / "data" / "slider_depth_crop.h5"
GAP = 8  # every so many frames one is given


def draw_reconstruction(path: Path) -> None:
    """Draw a hidden frame as several methods reconstruct it, with the uncertainty of `mc`."""
    recording = jaxevent.load(RECORDING)
    given = recording.with_frames(slice(0, None, GAP))
    assert recording.frames is not None and given.frames is not None
    hidden = recording.frames[GAP + GAP // 2 :][:1]
    params = aks.Params.for_recording(given)
    times = hidden.t + round(1e6 * float(params.clock_offset))
    estimates = {
        "blend of frames": blend.estimate(given)(times),
        "optical flow": flow.estimate(given)(times),
        "aks": aks.estimate(given, params)(times),
        "mc": mc.estimate(given)(times),
    }
    truth = hidden.intensity[0]
    nearest = given.frames[1:2].intensity[0]
    panels = {"nearest frame given": nearest}
    panels |= {name: np.asarray(e.mean)[0] for name, e in estimates.items()}
    panels["hidden frame"] = truth
    limits = tuple(np.quantile(truth, [0.005, 0.995]))
    figure, axes = plt.subplots(2, 3, figsize=(10, 5.6), layout="constrained")
    for axis, (name, image) in zip(axes.flat, panels.items(), strict=True):
        axis.imshow(tone_map(image, "percentile", limits), cmap="gray", vmin=0, vmax=255)
        error = 100 * float(mse(np.clip(image, 0, 1), truth))
        axis.set_title(name if image is truth else f"{name}: 100 MSE {error:.2f}", fontsize=11)
        axis.set(xticks=[], yticks=[])
    figure.savefig(path, dpi=90)


def draw_tracks(path: Path) -> None:
    """Draw tracks over their events, and the error of one within its standard deviation."""
    scene, truth = simulate.blob_scene("flock", seed=100)
    recording = scene[:2.0]
    tracks = blob.moment.estimate(recording)
    table = tracks.to_dataframe()
    figure, axes = plt.subplots(1, 2, figsize=(10, 3.9), layout="constrained")
    events = recording.events[:: max(len(recording.events) // 20_000, 1)]
    axes[0].plot(events.x, events.y, ",", color="0.6", label="events")
    for k, (_, track) in enumerate(table.groupby("id")):
        label = "tracks" if k == 0 else None
        axes[0].plot(track["x"], track["y"], color=f"C{k % 10}", label=label)
    axes[0].set(xlabel="x (px)", ylabel="y (px)", aspect="equal")
    axes[0].invert_yaxis()
    axes[0].legend(loc="center")
    track = table[table["id"] == table["id"].iloc[0]]
    true = np.asarray(truth(np.rint(1e6 * track["t"].to_numpy()).astype(np.int64)))[..., :2]
    place = track[["x", "y"]].to_numpy()[:, None]
    target = np.nanargmin(np.nanmean(np.linalg.norm(true - place, axis=-1), axis=0))
    error = place[:, 0] - true[:, target]
    for k, name in enumerate("xy"):
        axes[1].plot(track["t"], error[:, k], f"C{k}", label=f"error of {name}")
        deviation = 2 * track[f"sigma_{name}"]
        axes[1].plot(track["t"], deviation, f"C{k}:", label=f"2 sigma of {name}, reported")
        axes[1].plot(track["t"], -deviation, f"C{k}:")
    axes[1].set(xlabel="time (s)", ylabel="px")
    axes[1].legend(ncols=2, fontsize=9)
    figure.savefig(path, dpi=90)


def draw_motion(path: Path) -> None:
    """Draw an estimated rotation with its deviation against the truth."""
    recording, camera = simulate.motion_scene(
        "rotation", "varying", 100, size=(160, 120), focal=130.0, duration=0.6
    )
    motion = egomotion.contrast.estimate(recording, model="rotation")
    times = np.arange(0.05, 0.5, 0.01)
    estimate, covariance, _ = motion(times)
    deviation = 2 * np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    true = np.asarray(camera.twist(np.rint(times * 1e6).astype(np.int64))[1])
    figure, axes = plt.subplots(1, 2, figsize=(10, 3.6), layout="constrained")
    for k, name in enumerate(("x", "y", "z")):
        low, high = estimate[:, k] - deviation[:, k], estimate[:, k] + deviation[:, k]
        axes[0].plot(times, estimate[:, k], f"C{k}", label=f"about {name}")
        axes[0].fill_between(times, low, high, color=f"C{k}", alpha=0.25)
        axes[0].plot(times, true[:, k], "k:", label="truth" if k == 2 else None)
        axes[1].plot(times, estimate[:, k] - true[:, k], f"C{k}", label=f"error about {name}")
        axes[1].fill_between(times, -deviation[:, k], deviation[:, k], color=f"C{k}", alpha=0.15)
    axes[1].fill_between([], [], color="0.5", alpha=0.3, label="2 standard deviations")
    axes[0].set(xlabel="time (s)", ylabel="angular velocity (rad/s)")
    axes[1].set(xlabel="time (s)", ylabel="rad/s")
    axes[0].legend(fontsize=9)
    axes[1].legend(fontsize=9)
    figure.savefig(path, dpi=90)


PICTURES = {"reconstruction": draw_reconstruction, "tracks": draw_tracks, "motion": draw_motion}


def main() -> None:
    options = command_line(__doc__, out=True, parts=PICTURES).parse_args()
    matplotlib.use("Agg")
    for name in options.only:
        PICTURES[name](options.out / f"{name}.png")


if __name__ == "__main__":
    main()
