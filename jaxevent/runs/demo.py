"""The packaged recording reconstructed by every method: table, figures and videos."""

import dataclasses
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.errors import MissingExtra
from jaxevent.io import load
from jaxevent.methods import find, names
from jaxevent.recording import Frames, Recording
from jaxevent.runs.protocols import frame_times, held_out
from jaxevent.runs.results import check_folder, open_results, write_rows
from jaxevent.runs.scores import score
from jaxevent.show.export import default_tone, display_images, evenly_spaced_times
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
    with open_results(out) as write:
        rows, skipped = [], []
        for label, method, params in runs:
            try:
                row = score(
                    recording, method, params, normalise=_normalise(method), progress=progress
                )
            except MissingExtra as error:
                skipped.append(f"{label} is left out: {error}")
                continue
            rows.append({**row, "method": label})
        print(markdown_table(rows))
        print(
            "Every second frame was hidden and reconstructed; clock and thresholds are from the "
            "others\nand the events, unless not calibrated. Seconds include compiling. Images of "
            "events alone\nhave no brightness of their own: it is fitted to each hidden frame."
        )
        write_rows(rows, write)
        written = ["results.md", "results.json"]
        alone = _events_alone(recording, progress)
        for name, draw in (
            ("comparison.png", lambda path: _figure(recording, path)),
            ("events_only.png", lambda path: _figure_of_events(recording.name, alone, path)),
            ("events_only.mp4", lambda path: _video_of_events(alone, path)),
            ("video.mp4", lambda path: _video(recording, path, progress)),
        ):
            try:
                slower = draw(out / name)
                slow = "" if slower is None else f" ({slower:.0f} times slower than real time)"
                written.append(f"{name}{slow}")
            except MissingExtra as error:
                skipped.append(f"{name} is left out: {error}")
        print(*skipped, sep="\n")
    print(f"Written to {out}: {', '.join(written)}")


def _normalise(method: Any) -> Any:
    """Return how images are fitted to the truth: of events alone their scale is not known."""
    return "none" if method.fuses or method.needs_frames else "affine"


class _EventsAlone(NamedTuple):
    """Images of events without frames, (T, height, width), and the frames, which no method saw."""

    frames: Frames
    high_pass: NDArray[np.uint8]
    image: NDArray[np.uint8]
    doubt: NDArray[np.floating]  # standard deviation of ln I


def _events_alone(recording: Recording, progress: bool | None) -> _EventsAlone:
    """Reconstruct the recording without its frames, at every second one's time."""
    assert recording.frames is not None
    frames, given = recording.frames[2::2], dataclasses.replace(recording, frames=None)
    shown = []
    for name in ("high-pass", "events-only"):
        method = find(name)
        images, variance, _ = method.estimate(given, progress=progress)(frames.t)
        tone = default_tone(method.has_covariance, given)
        limits = display_limits(images, tone, variance)
        shown.append(tone_map(images, tone, limits, variance))
    return _EventsAlone(frames, *shown, np.sqrt(variance))


def _figure_of_events(name: str, alone: _EventsAlone, path: Path) -> None:
    """Draw one of the images of events alone, its uncertainty, and the frame."""
    middle = len(alone.image) // 2
    panels: list[tuple[str, Any, Kind]] = [
        ("high-pass filter of the events", alone.high_pass[middle] / 255, "image"),
        ("events-only", alone.image[middle] / 255, "image"),
        ("the frame, which no method was given", alone.frames.intensity[middle], "image"),
        ("events-only, standard deviation of ln I", alone.doubt[middle], "uncertainty"),
    ]
    seconds = alone.frames.t[middle] / 1e6
    comparison_figure(path, panels, f"{name} at {seconds:.3f} s, from events alone")


def _video_of_events(alone: _EventsAlone, path: Path) -> float:
    """Write the high-pass filter, `events-only` and frames side by side; return the slow-down."""
    t = alone.frames.t
    rate, fps = (len(t) - 1) * 1e6 / (t[-1] - t[0]), 6.0
    grey = tone_map(alone.frames.intensity)
    with video_writer(path, fps) as write:
        for images in zip(alone.high_pass, alone.image, grey, strict=True):
            write(np.hstack(images))
    return rate / fps


def _figure(recording: Recording, path: Path) -> None:
    """Draw the reconstructions of one hidden frame, and error and uncertainty of `mc`."""
    given, hidden = held_out(recording)
    middle = hidden[len(hidden) // 2 :][:1]
    assert given.frames is not None
    before = given.frames[int(np.searchsorted(given.frames.t, middle.t[0])) - 1 :][:1]
    truth = middle.intensity[0]
    ms = (middle.t[0] - before.t[0]) / 1000
    panels: list[tuple[str, Any, Kind]] = [
        (f"input: last frame given, {ms:.0f} ms old", before.intensity[0], "image")
    ]
    error = doubt = truth
    for name, label in (
        ("akf", "AKF"),
        ("aks", "smoother"),
        ("flow", "flow between frames"),
        ("mc", "mc, motion-compensated"),
    ):
        method: Any = find(name)
        try:
            values = method.usual_params(given)
            image, variance, _ = method.estimate(given, values)(frame_times(middle, values))
        except MissingExtra:
            continue
        panels.append((label, image[0], "image"))
        error, doubt = np.clip(image[0], 0, 1) - truth, np.sqrt(variance[0])
    panels.append(("truth: the hidden frame", truth, "image"))
    panels.append(("mc minus truth", error, "error"))
    panels.append(("mc, standard deviation of ln(I + 0.3)", doubt, "uncertainty"))
    comparison_figure(path, panels, f"{recording.name} at {middle.t[0] / 1e6:.3f} s")


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
