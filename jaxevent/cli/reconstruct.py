"""The command `jaxevent reconstruct`."""

import dataclasses
import time
from pathlib import Path
from typing import Any

from jaxevent.cli import arguments
from jaxevent.cli.arguments import command, show_progress
from jaxevent.display import format_count
from jaxevent.errors import InputError


def add(commands: Any) -> None:
    one = command(
        commands,
        run,
        "Make images of a recording. The name of the output tells its kind: .h5 holds times, "
        "linear intensity and its variance; .mp4 is a video; without suffix it is a folder of PNG "
        "images with images.txt. Recordings are read and images written a part at a time, so that "
        "memory does not grow with their length (.npz, .mat and folders of text are read whole).",
        "slider_depth.zip --out slider.mp4",
        "slider_depth.zip --method akf --rate 200 --out slider.mp4",
        "slider_depth.zip --method akf --at frames --params mine.toml --out slider.h5",
        "bike.h5 --method akf --colour --tone log --out bike",
        "drone.raw --method high-pass --times wanted.csv --start 2 --stop 3 --out drone.h5",
    )
    one.add_argument("path", metavar="PATH", type=Path, help="a recording")
    one.add_argument(
        "--method",
        metavar="NAME",
        help="mc, akf, aks, cf, cf-augmented, high-pass, events-only, edi, augmented, flow, blend, "
        "last-frame, or package.module:object of your own; default: mc, the best, or aks where mc "
        "would take over ten minutes; where there are no frames events-only, or else high-pass",
    )
    when = one.add_mutually_exclusive_group()
    when.add_argument("--rate", metavar="HZ", type=float, help="images per second, evenly spaced")
    when.add_argument("--at", choices=["frames"], help="one image where each frame is")
    when.add_argument(
        "--times",
        metavar="FILE_or_LIST",
        type=Path,
        help="one image at each time of a list 0.5,0.6 or of a text or CSV file: one in each "
        "line, or its column t; whole numbers are microseconds, others seconds",
    )
    one.add_argument(
        "--start",
        metavar="S",
        type=float,
        help="first time of images, in s on the recording's clock; earlier events are still "
        "processed (to discard them use jaxevent filter)",
    )
    one.add_argument(
        "--stop",
        metavar="S",
        type=float,
        help="end of the images, exclusive, in s on the recording's clock",
    )
    one.add_argument(
        "--params",
        metavar="FILE",
        type=Path,
        help="TOML file of name = value lines, e.g. c_on = 0.1, params.toml of a fit, or "
        "calibration.toml of jaxevent calibrate; what it does not set of clock and thresholds is "
        "calibrated",
    )
    arguments.add_no_calibrate(one)
    one.add_argument(
        "--tone",
        choices=["display", "linear", "log", "percentile", "clahe", "changes", "relative"],
        metavar="TONE",
        help="brightness of PNG and MP4: display (default), white is the brightest 0.5 %% of the "
        "frames, encoded as screens expect; linear, intensity as the frames have it; log, all of a "
        "high dynamic range; percentile, 99 %% of the intensities; clahe, log with even contrast; "
        "relative (default without frames), log that fades to grey where nothing is known; changes "
        "(default of high-pass then), grey where nothing changed",
    )
    one.add_argument(
        "--colour",
        action="store_true",
        help="reconstruct colours, for a recording that holds extra/rgb; an .h5 output then "
        "has red, green and blue images without variance",
    )
    arguments.add_output(
        one, "--out", metavar="DIR_or_FILE", required=True, help="name in .h5, .mp4 or none"
    )
    arguments.add_reading(one)


_MC_SECONDS_PER_PIXEL = 5e-6  # s of a core that `mc` takes for a pixel of an image: 0.2 for 240x180
_EVENTS_ONLY_SECONDS_PER_PIXEL = 10e-6  # s, of `events-only`: 0.4 for 240x180
_MAX_SECONDS = 600.0  # s


def _choose_method(has_frames: bool, pixels: int, missing: str = "") -> str:
    """Choose the method where none is named, and print the reason.

    Args:
        has_frames: Whether the recording has frames.
        pixels: Number of pixels of all images together.
        missing: Words for the reason why frames are missing.

    Returns:
        The method's name.
    """
    each = _MC_SECONDS_PER_PIXEL if has_frames else _EVENTS_ONLY_SECONDS_PER_PIXEL
    seconds = each * pixels
    late = f"would take {seconds / 60:.0f} minutes of a core"
    if not has_frames and seconds > _MAX_SECONDS:
        method, why = "high-pass", f"there are no frames{missing}, and events-only {late}"
    elif not has_frames:
        method, why = "events-only", f"there are no frames{missing}, so the scale is unknown"
    elif seconds > _MAX_SECONDS:
        method, why = "aks", f"mc, the best, {late}"
    else:
        method, why = "mc", "the best where there are frames"
    print(f"method {method}: {why}; choose another with --method")
    return method


def _read_table(params: Path | None, estimator: Any, method: str | None) -> dict[str, Any]:
    """Read the settings of --params; without a method the file must be a calibration.

    Args:
        params: File of --params, or None.
        estimator: The method.
        method: Name of the method if the user gave one, else None.

    Returns:
        Settings by name; empty without a file.

    Raises:
        InputError: No method is named, and the file holds parameters of one.
    """
    from jaxevent.parameters import CALIBRATION_TABLE, read_toml

    if params is None:
        return {}
    if method is None and CALIBRATION_TABLE not in read_toml(params):
        raise InputError(f"{params}: parameters are of one method; name it with --method")
    return estimator.Params.load_table(params, method)


def _default_times(
    recording: Any,
    estimator: Any,
    values: Any,
    rate: float | int | None,
    start: float | int | None,
    stop: float | int | None,
) -> Any:
    """Return the times of images where no file gives them.

    Args:
        recording: The recording.
        estimator: The method.
        values: Parameters of the method.
        rate: Images per second; None: at the frames if there are any, else 100.
        start: Time of the first image, s on the clock of the recording; None: its start.
        stop: Time of the last image, s, likewise; None: its stop.

    Returns:
        (images,) times, us.
    """
    from jaxevent.events.clocks import check_clocks, compare_clocks
    from jaxevent.runs.protocols import frame_times
    from jaxevent.show.export import image_times

    if rate is None and recording.frames is not None:
        if not estimator.needs_frames:
            check_clocks(recording, values.clock_offset)
        return frame_times(recording.frames, values)
    spanned = recording
    if getattr(estimator, "fuses", True) or estimator.needs_frames:
        check_clocks(recording, values.clock_offset)
    elif compare_clocks(recording, values.clock_offset) is not None:
        spanned = dataclasses.replace(recording, frames=None)
    return image_times(spanned, 100.0 if rate is None else rate, start, stop)


def run(
    *,
    path: Path,
    method: str | None,
    rate: float | int | None,
    at: str | None,
    times: Path | None,
    start: float | int | None,
    stop: float | int | None,
    params: Path | None,
    calibrate: bool,
    reading: dict[str, Any],
    tone: str | None,
    colour: bool,
    out: Path,
) -> None:
    from jaxevent.calibration.sampling import take_sample
    from jaxevent.events.clocks import check_clocks
    from jaxevent.io.images import read_times
    from jaxevent.methods import find
    from jaxevent.reconstruction.augment import calibrated_values
    from jaxevent.show.export import ExportOptions, default_tone, within, write_hdf5, writer

    write = writer(out)
    if tone is not None and write is write_hdf5:
        raise InputError(f"{out}: --tone is for images to look at; HDF5 holds linear intensity")
    estimator = find(method or "mc", "reconstruction")
    table = _read_table(params, estimator, method)
    recording, name = arguments.open_named(path, reading)
    file_times = None if times is None else read_times(times, (recording.start, recording.stop))
    if at == "frames" and recording.frames is None:
        missing = recording.describe_left_out("frames")
        raise InputError(f"{path}: holds no frames{missing}; give --rate instead of --at frames")

    def choose_times(values: Any) -> Any:
        wanted = file_times
        if wanted is None:
            wanted = _default_times(recording, estimator, values, rate, start, stop)
        return within(wanted, start, stop, str(path))

    values = estimator.Params.of(table)
    chosen = choose_times(values)
    if method is None:
        pixels = len(chosen) * recording.width * recording.height
        missing = recording.describe_left_out("frames")
        chosen_method = _choose_method(recording.frames is not None, pixels, missing)
        estimator = find(chosen_method, "reconstruction")
        table = _read_table(params, estimator, chosen_method)
        values = estimator.Params.of(table)
    names = estimator.names_left_open(table) if calibrate else ()
    if names:
        check_clocks(recording, values.clock_offset)
    clock = time.perf_counter()
    sample = take_sample(recording)
    arguments.warn_of_faults(recording, sample)
    found = calibrated_values(recording, values, names, sample)
    del sample  # before images need the memory
    if found.found or found.missing:
        print(arguments.describe_calibration(found))
    values = values.replace(**found.found)
    chosen = choose_times(values)
    video = estimator.estimate(recording, values, progress=show_progress())
    colours = None
    if colour:
        from jaxevent.reconstruction.colour import colour_video

        colours = colour_video(video, recording)
    shown = tone or default_tone(estimator.has_covariance, recording)
    how = write(video, chosen, out, ExportOptions(shown, name, colours))
    seconds = time.perf_counter() - clock
    print(
        f"{out}: {format_count(len(chosen), 'image')}{how}, "
        f"{arguments.describe_speed(len(recording.events), seconds)}"
    )
