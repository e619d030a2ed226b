"""The packaged recording reconstructed by every method: table, figures and videos."""

import dataclasses
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxevent.errors import MissingExtra
from jaxevent.estimator import Estimate
from jaxevent.io import load
from jaxevent.methods import find, names
from jaxevent.recording import Recording
from jaxevent.runs.own import MethodFunction
from jaxevent.runs.protocols import held_out
from jaxevent.runs.results import check_folder, open_results, write_rows
from jaxevent.runs.scores import Sample, ScoringOptions, score_and_sample
from jaxevent.show.export import display_images, evenly_spaced_times
from jaxevent.show.images import (
    Kind,
    comparison_figure,
    display_limits,
    tone_map,
    video_writer,
)
from jaxevent.show.tables import markdown_table

RECORDING_FILE = resources.files("jaxevent") / "data/slider_depth_crop.h5"
RESULT_FILES = (
    *("comparison.png", "events_only.png", "events_only.mp4", "video.mp4"),
    *("results.md", "results.json"),
)


def demo(out: Path, progress: bool | None = None, replace: bool = True) -> None:
    """Score every method on the packaged recording; prints the table, writes all to a folder.

    Without the extras "plot" and "video" the picture and the video are left out. Raises
    `InputError` if the folder cannot be written, or holds files of these names and `replace` is
    False.
    """
    check_folder(out, RESULT_FILES, replace=replace)
    with resources.as_file(RECORDING_FILE) as path:
        recording = load(path)
    runs: list[tuple[str, Any, Any]] = [
        *((name, find(name), None) for name in names("reconstruction")),
        *(
            (f"{name}, not calibrated", find(name), find(name).Params())
            for name in ("akf", "augmented")
        ),
    ]
    samples: dict[str, Sample] = {}  # of the hidden frame in the middle, by label
    alone: dict[str, Estimate] = {}  # of events alone, at all hidden frames
    with open_results(out) as write:
        rows, skipped = [], []
        for label, method, params in runs:
            fused = method.fuses or method.needs_frames
            # The scale of images from events alone is not known, so it is fitted to the truth.
            asked = ScoringOptions(normalise="none" if fused else "affine")
            scored = method if fused else _remembered(method, alone, progress)
            try:
                row, some = score_and_sample(recording, scored, params, asked, progress)
            except MissingExtra as error:
                skipped.append(f"{label} is left out: {error}")
                continue
            rows.append({**row, "method": label})
            samples[label] = some[len(some) // 2]
        print(markdown_table(rows))
        print(
            "Every second frame was hidden and reconstructed; clock and thresholds are from the "
            "others\nand the events, unless not calibrated. Seconds include compiling. Images of "
            "events alone\nhave no brightness of their own: it is fitted to each hidden frame."
        )
        write_rows(rows, write)
        written = ["results.md", "results.json"]
        _, hidden = held_out(recording)
        toned = [_toned(alone["high-pass"], "changes"), _toned(alone["events-only"], "relative")]
        toned.append(tone_map(hidden.intensity, "display"))
        doubt = np.sqrt(np.asarray(alone["events-only"].covariance))
        for name, draw in (
            ("comparison.png", lambda path: _figure(recording.name, samples, path)),
            ("events_only.png", lambda path: _figure_of_events(recording.name, toned, doubt, path)),
            ("events_only.mp4", lambda path: _video_of_events(toned, hidden.t, path)),
            ("video.mp4", lambda path: _video(recording, path, progress)),
        ):
            try:
                slower = draw(out / name)
                slow = "" if slower is None else f" ({slower:.0f} times slower than real time)"
                written.append(f"{name}{slow}")
            except MissingExtra as error:
                skipped.append(f"{name} is left out: {error}")
        print(*skipped, sep="\n")
    print(*(f"written: {out / name}" for name in written), sep="\n")


def _remembered(
    method: Any, estimates: dict[str, Estimate], progress: bool | None
) -> MethodFunction:
    """Return a method of events alone that keeps what it estimates, by its name."""

    def estimate(given: Recording, times: NDArray[np.int64]) -> Estimate:
        alone = dataclasses.replace(given, frames=None)
        estimates[method.name] = method.estimate(alone, progress=progress)(times)
        return estimates[method.name]

    return MethodFunction(method.name, estimate)


def _toned(estimate: Estimate, tone: str) -> NDArray[np.uint8]:
    """Show images (T, height, width) with limits of their own."""
    limits = display_limits(estimate.mean, tone, estimate.covariance)
    return tone_map(estimate.mean, tone, limits, estimate.covariance)


def _figure_of_events(
    name: str, toned: Sequence[NDArray[np.uint8]], doubt: NDArray[np.floating], path: Path
) -> None:
    """Draw one of the images of events alone, its uncertainty, and the frame."""
    middle = len(doubt) // 2
    labels = "high-pass filter of the events", "events-only", "the frame, which no method was given"
    panels: list[tuple[str, Any, Kind]] = [
        (label, images[middle] / 255, "image") for label, images in zip(labels, toned, strict=True)
    ]
    panels.append(("events-only, standard deviation of ln I", doubt[middle], "uncertainty"))
    comparison_figure(path, panels, f"{name}, from events alone")


def _video_of_events(toned: Sequence[NDArray[np.uint8]], t: NDArray[np.int64], path: Path) -> float:
    """Write the high-pass filter, `events-only` and frames side by side; return the slow-down."""
    rate, fps = (len(t) - 1) * 1e6 / (t[-1] - t[0]), 6.0
    with video_writer(path, fps) as write:
        for images in zip(*toned, strict=True):
            write(np.hstack(images))
    return rate / fps


def _figure(name: str, samples: Mapping[str, Sample], path: Path) -> None:
    """Draw the reconstructions of one hidden frame, and error and uncertainty of `mc`."""
    best = samples["mc"]
    limits = display_limits(best.truth, "display")
    images = {
        "input: the last frame given": best.given,
        "AKF": samples["akf"].image,
        "smoother": samples["aks"].image,
        "flow between frames": samples["flow"].image if "flow" in samples else None,
        "mc, motion-compensated": best.image,
        "truth: the hidden frame": best.truth,
    }
    panels: list[tuple[str, Any, Kind]] = [
        (label, tone_map(image, "display", limits) / 255, "image")
        for label, image in images.items()
        if image is not None
    ]
    panels.append(("mc minus truth", np.clip(best.image, 0, 1) - best.truth, "error"))
    panels.append(("mc, standard deviation of ln(I + 0.3)", best.deviation, "uncertainty"))
    comparison_figure(path, panels, f"{name} at {best.t / 1e6:.3f} s")


def _video(recording: Recording, path: Path, progress: bool | None) -> float:
    """Write 200 images per second of the recording, shown at 30; return the slow-down."""
    rate, fps, longest = 200.0, 30.0, 180
    video = find("akf").estimate(recording, progress=progress)
    zoom = 2 if recording.width < 480 else 1
    with video_writer(path, fps) as write:
        for _, image in display_images(
            video, evenly_spaced_times(recording, rate)[:longest], "display"
        ):
            write(np.kron(image, np.ones((zoom, zoom), np.uint8)))
    return rate / fps
