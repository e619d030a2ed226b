"""The packaged recording reconstructed by every method: table, figure and video."""

from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from jaxevent.errors import MissingExtra
from jaxevent.io import load
from jaxevent.methods import find, names
from jaxevent.recording import Recording
from jaxevent.runs.protocols import frame_times, held_out
from jaxevent.runs.results import check_folder, open_results, write_rows
from jaxevent.runs.scores import score
from jaxevent.show.export import display_images, evenly_spaced_times
from jaxevent.show.images import Kind, comparison_figure, video_writer
from jaxevent.show.tables import markdown_table

RECORDING_FILE = resources.files("jaxevent") / "data/slider_depth_crop.h5"
RESULT_FILES = ("comparison.png", "video.mp4", "results.md", "results.json")


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
                row = score(recording, method, params, progress=progress)
            except MissingExtra as error:
                skipped.append(f"{label} is left out: {error}")
                continue
            rows.append({**row, "method": label})
        print(markdown_table(rows))
        print(
            "Every second frame was hidden and reconstructed; clock and thresholds are from the "
            "others\nand the events, unless not calibrated. Seconds include compiling."
        )
        write_rows(rows, write)
        written = ["results.md", "results.json"]
        try:
            _figure(recording, out / "comparison.png")
            written.append("comparison.png")
        except MissingExtra as error:
            skipped.append(f"comparison.png is left out: {error}")
        try:
            slower = _video(recording, out / "video.mp4", progress)
            written.append(f"video.mp4 ({slower:.0f} times slower than real time)")
        except MissingExtra as error:
            skipped.append(f"video.mp4 is left out: {error}")
        print(*skipped, sep="\n")
    print(f"Written to {out}: {', '.join(written)}")


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
            video, evenly_spaced_times(recording, rate)[:longest], "linear"
        ):
            write(np.kron(image, np.ones((zoom, zoom), np.uint8)))
    return rate / fps
