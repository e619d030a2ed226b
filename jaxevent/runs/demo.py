"""The packaged recording reconstructed by every method: table, figures and videos."""

import dataclasses
import pickle
import tempfile
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.codegen import N_THREADS
from jaxevent.errors import InputError, MissingExtra
from jaxevent.estimator import Estimate
from jaxevent.io import load
from jaxevent.methods import find, names
from jaxevent.recording import Recording
from jaxevent.runs.own import MethodFunction
from jaxevent.runs.protocols import held_out
from jaxevent.runs.results import check_folder, open_results, write_rows
from jaxevent.runs.scores import Sample, ScoringOptions, score_and_sample
from jaxevent.runs.tasks import ComputeResources, Task, run
from jaxevent.show.export import display_images, image_times
from jaxevent.show.images import (
    Kind,
    comparison_figure,
    display_limits,
    tone_map,
    video_writer,
)
from jaxevent.show.tables import markdown_table

RECORDING_FILE = resources.files("jaxevent") / "data/slider_depth_crop.h5"
VIDEO = "video.mp4"
EVENT_FIGURE, EVENT_VIDEO = "events_only.png", "events_only.mp4"  # of events alone
RESULT_FILES = ("comparison.png", EVENT_FIGURE, EVENT_VIDEO, VIDEO, "results.md", "results.json")
NOT_CALIBRATED = ", not calibrated"
SLOWEST = ("mc", "events-only")  # methods, by the time that they take to compile


def demo(out: Path, progress: bool | None = None, replace: bool = True) -> None:
    """Score every method on the packaged recording; prints the table, writes all to a folder.

    Methods do not need each other: two processes share them, where there are two cores.

    Args:
        out: The folder, made if missing.
        progress: Whether a bar is shown; None: where somebody looks on.
        replace: Whether files of these names are replaced.

    Raises:
        InputError: The folder cannot be written, or holds files of these names and `replace` is
            False. Without the extras "plot" and "video" pictures and videos are only left out.
    """
    check_folder(out, RESULT_FILES, replace=replace)
    with (
        resources.as_file(RECORDING_FILE) as path,
        tempfile.TemporaryDirectory(prefix="jaxevent") as folder,
        open_results(out) as write,
    ):
        results = Path(folder)
        labels = [
            *names("reconstruction"),
            *(f"{name}{NOT_CALIBRATED}" for name in ("akf", "augmented")),
        ]
        # Those that take longest to compile come first, one to each process.
        started = sorted(labels, key=lambda label: SLOWEST.index(label) if label in SLOWEST else 9)
        common = {"path": path, "results": results, "out": out}
        # Pictures come last: one process draws while the other one still computes.
        files = [VIDEO, EVENT_FIGURE, EVENT_VIDEO]
        tasks = [Task(label, {"label": label, **common}) for label in [*started, *files]]
        place = ComputeResources(workers=2) if N_THREADS > 1 else None
        outcomes = run(_run_part, tasks, place=place, retries=0, progress=progress)
        found = {task.name: outcome for task, outcome in zip(tasks, outcomes, strict=True)}
        for label, outcome in found.items():
            if outcome.error is not None and not outcome.skipped:
                raise InputError(f"{label}: {outcome.error}")
        skipped = [
            f"{label} is left out: {found[label].error}"
            for label in [*labels, *files]
            if found[label].skipped
        ]
        done = [label for label in labels if not found[label].skipped]
        rows = [found[label].result for label in done]
        print(markdown_table(rows))
        print(
            "Every second frame was hidden and reconstructed; clock and thresholds are from the "
            "others\nand the events, unless not calibrated. Seconds include compiling. Images of "
            "events alone\nhave no brightness of their own: it is fitted to each hidden frame."
        )
        write_rows(rows, write)
        written = ["results.md", "results.json"]
        parts: dict[str, Part] = {
            label: pickle.loads((results / label).read_bytes()) for label in done
        }
        recording = load(path)
        samples = {label: part.sample for label, part in parts.items()}

        def draw(name: str) -> float | None:
            """Draw a file, unless a task has; return how much slower than life it plays."""
            if name == "comparison.png":
                return _figure(recording.name, samples, out / name)
            drawn = found[name].result or _draw_events(name, recording, results, out / name)
            assert drawn is not None  # all methods have run
            return drawn["slower"]

        for name in ("comparison.png", EVENT_FIGURE, EVENT_VIDEO, VIDEO):
            if name in found and found[name].skipped:
                continue
            try:
                slower = draw(name)
                slow = "" if slower is None else f" ({slower:.0f} times slower than real time)"
                written.append(f"{name}{slow}")
            except MissingExtra as error:
                skipped.append(f"{name} is left out: {error}")
        print(*skipped, sep="\n")
    print(*(f"written: {out / name}" for name in written), sep="\n")


class Part(NamedTuple):
    """Images of one method that the pictures show."""

    sample: Sample  # of the hidden frame in the middle
    estimate: Any  # of a method of events alone, at all hidden frames; else None


def _run_part(label: str, path: Path, results: Path, out: Path) -> dict[str, Any] | None:
    """Score one method, whose `Part` goes to a file of its name, or write a picture or video."""
    recording = load(path)
    if label == VIDEO:
        return {"slower": _video(recording, out / label)}
    if label in (EVENT_FIGURE, EVENT_VIDEO):
        return _draw_events(label, recording, results, out / label)
    name = label.removesuffix(NOT_CALIBRATED)
    method: Any = find(name)
    params = None if name == label else method.Params()
    kept: list[Estimate] = []

    def estimate(given: Recording, times: NDArray[np.int64]) -> Estimate:
        kept.append(method.estimate(dataclasses.replace(given, frames=None), progress=False)(times))
        return kept[0]

    fused = method.fuses or method.needs_frames
    # The scale of images from events alone is not known, so it is fitted to the truth.
    options = ScoringOptions(normalise="none" if fused else "affine")
    scored = method if fused else MethodFunction(name, estimate)
    row, some = score_and_sample(recording, scored, params, options, False)
    part = Part(some[len(some) // 2], kept[0] if kept else None)
    unfinished = results / f"{label}.part"
    unfinished.write_bytes(pickle.dumps(part))
    unfinished.rename(results / label)
    return {**row, "method": label}


def _draw_events(
    name: str, recording: Recording, results: Path, path: Path
) -> dict[str, float | None] | None:
    """Draw the figure or the video of events alone; return None while its methods still run."""
    sources = [results / "high-pass", results / "events-only"]
    if not all(source.exists() for source in sources):
        return None
    changes, alone = (pickle.loads(source.read_bytes()).estimate for source in sources)
    _, hidden = held_out(recording)
    toned = [_tone_images(changes, "changes"), _tone_images(alone, "relative")]
    toned.append(tone_map(hidden.intensity, "display"))
    if name == EVENT_VIDEO:
        return {"slower": _video_of_events(toned, hidden.t, path)}
    _figure_of_events(recording.name, toned, np.sqrt(np.asarray(alone.covariance)), path)
    return {"slower": None}


def _tone_images(estimate: Estimate, tone: str) -> NDArray[np.uint8]:
    """Show images (T, height, width) with limits of their own."""
    limits = display_limits(estimate.mean, tone, estimate.covariance)
    return tone_map(estimate.mean, tone, limits, estimate.covariance)


def _figure_of_events(
    name: str, toned: Sequence[NDArray[np.uint8]], doubt: NDArray[np.floating], path: Path
) -> None:
    """Draw one of the images of events alone, its uncertainty, and the frame.

    Args:
        name: Title.
        toned: (T, H, W) images for the display: high-pass filter, `events-only`, frames.
        doubt: (T, H, W) standard deviation of ln I of `events-only`.
        path: File to write.
    """
    middle = len(doubt) // 2
    labels = "high-pass filter of the events", "events-only", "the frame, which no method was given"
    panels: list[tuple[str, Any, Kind]] = [
        (label, images[middle] / 255, "image") for label, images in zip(labels, toned, strict=True)
    ]
    panels.append(("events-only, standard deviation of ln I", doubt[middle], "uncertainty"))
    comparison_figure(path, panels, f"{name}, from events alone")


def _video_of_events(toned: Sequence[NDArray[np.uint8]], t: NDArray[np.int64], path: Path) -> float:
    """Write the high-pass filter, `events-only` and frames side by side.

    Args:
        toned: (T, H, W) images for the display of each.
        t: (T,) times, us.
        path: File to write.

    Returns:
        By how much the video is slower than real time.
    """
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


def _video(recording: Recording, path: Path) -> float:
    """Write 200 images per second of the recording, shown at 30; return the slow-down."""
    rate, fps, longest = 200.0, 30.0, 180
    method: Any = find("akf")
    params = method.Params.for_recording(held_out(recording)[0])  # those of the table
    video = method.estimate(recording, params, progress=False)
    zoom = 2 if recording.width < 480 else 1
    with video_writer(path, fps) as write:
        for _, image in display_images(video, image_times(recording, rate)[:longest], "display"):
            write(np.kron(image, np.ones((zoom, zoom), np.uint8)))
    return rate / fps
