"""Real recordings made brighter until frames are clipped: what events say beyond white.

    python experiments/clipped.py --out clipped [--data DIR]

DIR holds the recordings, by default $JAXEVENT_DATA/data. Intensities are multiplied by 2 to 5
and clipped at white, every second frame is given, and 8 of the hidden ones are the truth, which is
not clipped. Of pixels above white: mean squared error and mean error of ln(I + 0.003), z2 of
ln(I + I0); below white: MSE. "integrated" adds events to the pixel's last unclipped value, by the
thresholds that the recording shows. Methods calibrate themselves by the frames given. Makes
table.md, and a picture of each recording in logarithmic tone.
"""

import dataclasses
from typing import Any

import matplotlib as mpl
import numpy as np
from common import command_line, markdown_table
from motion_compensated import choose_evenly
from numpy.typing import NDArray

import jaxevent
from jaxevent.recording import Frames, Recording
from jaxevent.runs.protocols import held_out

CASES = (
    ("slider_depth.zip", (3, 5)),
    ("davis346_street.npz", (2, 3, 5)),
)
METHODS = ("last-frame", "blend", "flow", "integrated", "akf", "aks", "mc")
IMAGES = 8
NOISE = 0.004  # of the truth


def make_brighter(recording: Recording, factor: float) -> tuple[Recording, Frames, NDArray]:
    """Return the recording that is given, hidden frames and their true intensities.

    Where the sensor itself was white the truth is not known, and NaN.
    """
    frames = recording.frames
    assert frames is not None
    bright = np.minimum(np.rint(factor * 255 * frames.intensity), 255).astype(np.uint8)
    clipped = dataclasses.replace(
        recording, frames=Frames(frames.t, bright, frames.exposure), name=recording.name
    )
    given, _ = held_out(clipped, 2)
    rows = choose_evenly(np.arange(1, len(frames) - 1, 2), IMAGES)
    light = frames[rows].intensity
    return given, frames[rows], np.where(light > 0.99, np.nan, factor * light)


def integrate(given: Recording, t: NDArray[np.int64]) -> NDArray[np.floating]:
    """Add events to the last unclipped value of each pixel, ln(I + 1)."""
    params, frames = jaxevent.akf.Params.for_recording(given), given.frames
    assert frames is not None
    late = round(1e6 * float(params.frame_delay))
    events, pixels = given.events[:], given.width * given.height
    step = np.where(events.p, float(params.c_on), -float(params.c_off))
    place = events.y.astype(np.int64) * given.width + events.x
    levels = np.log1p(frames.intensity.reshape(len(frames), -1).astype(float))
    clear = np.asarray(frames.images).reshape(len(frames), -1) < 253
    out, level, done, k = [], levels[0], 0, 0
    for now in (t + late).tolist():
        while k < len(frames) and frames.t[k] + late <= now:
            end = int(np.searchsorted(events.t, frames.t[k] + late))
            level = level + np.bincount(place[done:end], step[done:end], pixels)
            level, done, k = np.where(clear[k], levels[k], level), end, k + 1
        end = int(np.searchsorted(events.t, now))
        out.append(np.expm1(level + np.bincount(place[done:end], step[done:end], pixels)))
    return np.stack(out).reshape(len(t), given.height, given.width)


def reconstruct(name: str, given: Recording, t: NDArray[np.int64]) -> tuple[Any, Any, float]:
    """Return images, their variance or None, and I0."""
    if name == "integrated":
        return integrate(given, t), None, 1.0
    method: Any = jaxevent.METHODS[name]
    params = method.usual_params(given)
    late = round(1e6 * float(params.clock_offset)) if method.has_covariance else 0
    images, P, _ = method.estimate(given, params, progress=False)(t + late, extrapolate=True)
    return images, P if method.has_covariance else None, float(params.I0)


def row(images: NDArray, P: Any, truth: NDArray, I0: float) -> list[str]:
    above, below = truth > 1, truth <= 1
    error = np.log((np.maximum(images, 0) + 0.003) / (truth + 0.003))[above]
    z2 = "-"
    if P is not None:
        squares = np.log((np.maximum(images, 0) + I0) / (truth + I0)) ** 2
        z2 = f"{np.nanmean((squares / (P + (NOISE / (truth + I0)) ** 2))[above]):.2f}"
    under = 100 * ((images.clip(0, 1) - truth)[below] ** 2).mean()
    return [f"{np.mean(error**2):.4f}", f"{error.mean():+.3f}", z2, f"{under:.4f}"]


def main() -> None:
    arguments = command_line(__doc__, out=True, data=True).parse_args()
    mpl.use("agg")
    import matplotlib.pyplot as plt

    lines = []
    for name, factors in CASES:
        recording = jaxevent.load(arguments.data / name)
        for factor in factors:
            given, hidden, truth = make_brighter(recording, factor)
            shown = {"truth": truth, "clipped": np.minimum(truth, 1)}
            share = 100 * np.nanmean(np.where(np.isnan(truth), np.nan, truth > 1))
            for method in METHODS:
                images, P, I0 = reconstruct(method, given, hidden.t)
                label = f"{recording.name} x {factor}, {share:.0f} %"
                lines.append([label, method, *row(np.asarray(images), P, truth, I0)])
                print(*lines[-1], flush=True)
                shown[method] = images
            chosen = ("truth", "clipped", "flow", "akf", "aks", "mc")
            _, axes = plt.subplots(2, 3, figsize=(12, 6.5))
            for axis, label in zip(axes.ravel(), chosen, strict=True):
                image = np.log(np.maximum(shown[label][IMAGES // 2], 0.02))
                axis.imshow(image, cmap="gray", vmin=np.log(0.05), vmax=np.log(factor))
                axis.set(title=label, xticks=[], yticks=[])
            plt.tight_layout()
            plt.savefig(arguments.out / f"{recording.name}_{factor}.png", dpi=70)
            plt.close()
    head = ["recording, pixels above white", "method", "log MSE", "bias", "z2", "MSE x 1e-2 below"]
    (arguments.out / "table.md").write_text(markdown_table(head, lines, 2) + "\n")


if __name__ == "__main__":
    main()
