"""The command line: `jaxevent demo | info | convert | reconstruct | evaluate`.

What cannot be used is said in one line on stderr, exit status 2. The libraries are imported by the
command that needs them, so that help appears at once.
"""

import argparse
import contextlib
import dataclasses
import json
import math
import os
import sys
import textwrap
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jaxevent
from jaxevent.errors import InputError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from jaxevent.reconstruction.video import Video
    from jaxevent.recording import EventSource, Frames, Recording

# The thresholds of the demo's sensor and the lag of its frames' clock, set by hand.
BY_HAND = {"c_on": 0.083, "c_off": 0.059, "clock_offset": 0.0075}


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command line (default: the process's arguments); returns the exit status.

    0: done; 1: the output was not read to its end; 2: bad input or arguments (argparse exits with
    2 by itself); 130: interrupted.
    """
    arguments = vars(_parser().parse_args(argv))
    command = arguments.pop("command")
    try:
        command(**arguments)
        sys.stdout.flush()
    except InputError as error:
        print(f"jaxevent: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:
        # Python flushes stdout once more at exit, which must not fail again.
        with contextlib.suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="jaxevent",
        description="Video, of high rate and dynamic range, from event cameras.",
        epilog="example:\n  jaxevent demo",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"jaxevent {jaxevent.__version__}")
    commands = parser.add_subparsers(metavar="COMMAND", required=True)

    def add(command: Callable, description: str, *examples: str) -> argparse.ArgumentParser:
        name = command.__name__
        lines = "".join(f"\n  jaxevent {name} {example}".rstrip() for example in examples)
        one = commands.add_parser(
            name,
            help=description.partition(".")[0],
            description="\n".join(textwrap.wrap(description, 79)),
            epilog=f"example{'s' * (len(examples) > 1)}:{lines}",
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        one.set_defaults(command=command)
        return one

    def add_size(one: argparse.ArgumentParser) -> None:
        one.add_argument(
            "--size",
            metavar="W,H",
            type=_size,
            help="sensor size in pixels, for a recording that does not tell it",
        )

    one = add(
        demo,
        "Reconstruct a short recording with every method. It writes a table of errors, a figure "
        "and a slow-motion video, and prints the table.",
        "",
        "--out my-demo",
    )
    one.add_argument(
        "--out",
        metavar="DIR",
        type=Path,
        default=Path("jaxevent-demo"),
        help="default: %(default)s",
    )

    one = add(info, "Describe a recording.", "slider_depth.zip", "events.npz --size 240,180")
    one.add_argument("path", metavar="PATH", type=Path, help="a recording")
    add_size(one)

    one = add(
        convert,
        "Store a recording as HDF5. The file opens at once and need not fit in memory.",
        "slider_depth.zip slider_depth.h5",
        "slider_depth.zip small.h5 --compression gzip",
    )
    one.add_argument("source", metavar="SRC", type=Path, help="a recording")
    one.add_argument("target", metavar="DST", type=Path, help="the HDF5 file to write")
    one.add_argument("--compression", choices=["gzip"], help="smaller, but slower to read")
    add_size(one)

    one = add(
        reconstruct,
        "Make images of a recording. The name of the output tells its kind: .h5 holds times, "
        "linear intensity and its variance; .mp4 is a video; without suffix it is a folder of PNG "
        "images with images.txt.",
        "slider_depth.zip --method akf --rate 200 --out slider.mp4",
        "slider_depth.zip --method akf --at frames --params mine.toml --out slider.h5",
    )
    one.add_argument("path", metavar="PATH", type=Path, help="a recording")
    one.add_argument(
        "--method",
        metavar="NAME",
        required=True,
        help="akf, cf, cf-augmented, high-pass, edi, augmented, blend or last-frame",
    )
    when = one.add_mutually_exclusive_group()
    when.add_argument("--rate", metavar="HZ", type=float, help="images per second, evenly spaced")
    when.add_argument("--at", choices=["frames"], help="one image where each frame is")
    one.add_argument(
        "--params",
        metavar="FILE",
        type=Path,
        help="TOML file of name = value lines, e.g. c_on = 0.1",
    )
    one.add_argument(
        "--tone",
        choices=["linear", "log", "percentile", "clahe"],
        help="how intensity becomes grey in PNG and MP4; default: linear",
    )
    one.add_argument(
        "--out", metavar="DIR_or_FILE", type=Path, required=True, help="name in .h5, .mp4 or none"
    )
    add_size(one)

    one = add(
        evaluate,
        "Compare methods on recordings. It hides frames, reconstructs them and prints a table of "
        "the errors.",
        "configs/slider_depth.toml --out results",
    )
    one.add_argument("config", metavar="CONFIG.toml", type=Path, help="recordings and methods")
    one.add_argument("--out", metavar="DIR", type=Path, help="folder for results.json, results.md")
    return parser


def _size(text: str) -> tuple[int, int]:
    try:
        width, height = (int(number) for number in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not W,H, for example 240,180") from None
    return width, height


def _progress() -> bool:
    return sys.stderr.isatty()


def evaluate(config: Path, out: Path | None) -> None:
    from jaxevent.evaluate import evaluate as run
    from jaxevent.report import markdown_table

    print(markdown_table(run(config, out, progress=_progress())), end="")
    if out is not None:
        print(f"\nwritten to {out}: results.json, results.md, config.toml")


def convert(
    source: Path, target: Path, compression: str | None, size: tuple[int, int] | None
) -> None:
    from jaxevent.io import load, save

    recording = load(source, size, in_memory=False)
    save(recording, target, compression)
    frames = len(recording.frames) if recording.frames else 0
    size_mb = target.stat().st_size / 1e6
    print(f"{target}: {len(recording.events):,} events, {frames} frames, {size_mb:.1f} MB")


def info(path: Path, size: tuple[int, int] | None) -> None:
    from jaxevent.io import load

    recording = load(path, size, in_memory=False)
    lines = [
        ("file", str(path)),
        ("name", recording.name),
        ("sensor", f"{recording.width} x {recording.height} pixels"),
        (
            "time",
            f"{recording.start / 1e6:.6f} to {recording.stop / 1e6:.6f} s "
            f"({(recording.stop - recording.start) / 1e6:.3f} s)",
        ),
        *_about_events(recording.events, recording.width, recording.height),
        *_about_frames(recording.frames),
    ]
    if (camera := recording.camera) is not None:
        lines.append(
            (
                "calibration",
                f"fx {camera.fx:.2f}, fy {camera.fy:.2f}, cx {camera.cx:.2f}, cy {camera.cy:.2f}; "
                f"distortion {', '.join(f'{k:.4g}' for k in camera.distortion)}",
            )
        )
    for name, part in (("poses", recording.poses), ("IMU", recording.imu)):
        if part is not None and len(part):
            lines.append((name, f"{len(part):,}{_rate_of(part.t)}"))
    for name, values in recording.extra.items():
        lines.append((f"extra {name}", f"{values.dtype} of shape {values.shape}"))
    width = max(len(name) for name, _ in lines)
    for name, text in lines:
        print(f"{name:{width}}  {text}")


def _rate_of(t: "NDArray[np.int64]") -> str:
    return f", {(len(t) - 1) / ((t[-1] - t[0]) / 1e6):.1f} per s" if t[-1] > t[0] else ""


BLOCK = 1 << 20  # events looked at together: 13 MB
BIN = 10_000  # us over which the peak rate is taken


def _about_events(events: "EventSource", width: int, height: int) -> list[tuple[str, str]]:
    import numpy as np

    count = len(events)
    if not count:
        return [("events", "none")]
    at_pixel = np.zeros(width * height, np.int64)
    on = peak = carried = 0
    last_bin = None
    first = last = 0
    for row in range(0, count, BLOCK):
        block = events[row : row + BLOCK]
        first, last = first if row else int(block.t[0]), int(block.t[-1])
        on += int(block.p.sum())
        at_pixel += np.bincount(block.y.astype(np.int64) * width + block.x, minlength=len(at_pixel))
        # Sorted, so that only the first bin of a block can have begun in the one before it.
        bins, counts = np.unique((block.t - first) // BIN, return_counts=True)
        if last_bin == bins[0]:
            counts[0] += carried
        peak, last_bin, carried = max(peak, int(counts.max())), bins[-1], int(counts[-1])
    lines = [
        ("events", f"{count:,}, from {first / 1e6:.6f} to {last / 1e6:.6f} s"),
        ("polarity", f"{100 * on / count:.1f} % ON, {100 * (count - on) / count:.1f} % OFF"),
    ]
    # The last bin is rarely full, so a recording shorter than a bin has no rate.
    seconds = (last - first) / 1e6
    if last - first >= BIN:
        lines.append(
            (
                "event rate",
                f"mean {count / seconds:,.0f} per s, peak {peak / BIN * 1e6:,.0f} per s in "
                f"{BIN // 1000} ms",
            )
        )
    hottest = np.argsort(-at_pixel, kind="stable")[:3]
    shown = []
    for pixel in hottest[at_pixel[hottest] > 0]:
        n = int(at_pixel[pixel])
        rate = f", {n / seconds:,.0f} per s" if last - first >= BIN else ""
        shown.append(f"({pixel % width}, {pixel // width}) {n:,} events{rate}")
    lines.append(("hottest pixels", "; ".join(shown)))
    return lines


def _about_frames(frames: "Frames | None") -> list[tuple[str, str]]:
    import numpy as np

    if frames is None:
        return [("frames", "none")]
    height, width = frames.images.shape[1:]
    known = frames.exposure[frames.exposure > 0] / 1000
    if not len(known):
        exposure = "not known"
    elif known.min() == known.max():
        exposure = f"{known[0]:.3f} ms"
    else:
        exposure = f"{known.min():.3f} to {known.max():.3f} ms"
    if 0 < len(known) < len(frames):
        exposure += f", not known of {len(frames) - len(known)} frames"
    dark = bright = 0.0
    for row in range(len(frames)):
        grey = frames[row : row + 1].intensity
        dark += float(np.mean(grey < 0.02)) / len(frames)
        bright += float(np.mean(grey > 0.98)) / len(frames)
    return [
        (
            "frames",
            f"{len(frames):,} of {width} x {height}, {frames.images.dtype}{_rate_of(frames.t)}",
        ),
        ("exposure", exposure),
        (
            "grey levels",
            f"{100 * dark:.1f} % dark (< 0.02), {100 * bright:.1f} % saturated (> 0.98)",
        ),
    ]


def reconstruct(
    path: Path,
    method: str,
    rate: float | int | None,
    at: str | None,
    params: Path | None,
    size: tuple[int, int] | None,
    tone: str | None,
    out: Path,
) -> None:
    from jaxevent.evaluate import find_method, frame_times
    from jaxevent.io import load

    write = _writer(out)
    if tone is not None and write is _write_hdf5:
        raise InputError(f"{out}: --tone is for images to look at; HDF5 holds linear intensity")
    estimator = find_method(method)
    values = estimator.Params() if params is None else estimator.Params.load(params)
    recording = load(path, size, in_memory=False)
    name = recording.name
    recording = dataclasses.replace(recording, name=str(path))  # for messages
    if at == "frames" and recording.frames is None:
        raise InputError(f"{path}: holds no frames; give --rate instead of --at frames")
    if rate is None and recording.frames is not None:
        times = frame_times(recording.frames, values)
    else:
        times = _times(recording, 100.0 if rate is None else rate)
    clock = time.perf_counter()
    video = estimator.reconstruct(recording, values, progress=_progress())
    how = write(video, times, out, tone or "linear", name)
    seconds = time.perf_counter() - clock
    print(
        f"{out}: {len(times):,} images{how}, {seconds:.2f} s, "
        f"{len(recording.events) / seconds:,.0f} events/s"
    )


def _times(recording: "Recording", rate: float | int) -> "NDArray[np.int64]":
    """Times (us) at a rate (1/s) from the recording's start to its stop."""
    import numpy as np

    if not 0 < rate <= 1e6:
        raise InputError(
            f"{recording.name}: cannot be read at --rate {rate:g}; give a number of images per "
            "second above 0, up to 1e6"
        )
    count = math.floor((recording.stop - recording.start) * rate / 1e6 + 1e-9) + 1
    return recording.start + np.rint(np.arange(count) * (1e6 / rate)).astype(np.int64)


def _writer(out: Path) -> "Callable[[Video, NDArray, Path, str, str], str]":
    if not out.name:
        raise InputError(f"{out}: is a folder in use; give the name of a new file or folder")
    kinds = {".h5": _write_hdf5, ".hdf5": _write_hdf5, ".mp4": _write_video, "": _write_images}
    if out.suffix.lower() not in kinds:
        raise InputError(
            f"{out}: images cannot be stored as {out.suffix}; end the name in .h5 or .mp4, or "
            "leave out the suffix for a folder of PNG images"
        )
    return kinds[out.suffix.lower()]


def _write_hdf5(video: "Video", times: "NDArray", out: Path, tone: str, name: str) -> str:
    import h5py

    from jaxevent.evaluate import values_of
    from jaxevent.io.output import complete

    shape = (len(times), video.recording.height, video.recording.width)
    with complete(out) as partial, h5py.File(partial, "w") as file:
        file.attrs["method"] = video.estimator.name
        file.attrs["params"] = json.dumps(values_of(video.params), allow_nan=False)
        file.attrs["recording"] = name
        units = {
            "t": "us on the recording's clock",
            "image": "linear intensity: 0 is the frames' black, 1 their white",
            "variance": "(ln I)^2, of ln(intensity + I0); NaN: not estimated",
        }
        file["t"] = times.astype("i8")
        image, variance = (
            file.create_dataset(field, shape, "f4", chunks=(1, *shape[1:]))
            for field in ("image", "variance")
        )
        for field, unit in units.items():
            file[field].attrs["unit"] = unit
        row = 0
        for batch, images, variances in video.batches(times):
            rows = slice(row, row + len(batch))
            image[rows], variance[rows] = images, variances
            row += len(batch)
    return ""


def _write_video(video: "Video", times: "NDArray", out: Path, tone: str, name: str) -> str:
    from jaxevent.report import video_writer

    rate = (len(times) - 1) / ((times[-1] - times[0]) / 1e6) if len(times) > 1 else 25.0
    fps = min(rate, 60.0)
    with video_writer(out, fps) as write:
        for _, image in _shown(video, times, tone):
            write(image)
    return f", played at {fps:.4g} per s, {fps / rate:.3g} of real time"


def _write_images(video: "Video", times: "NDArray", out: Path, tone: str, name: str) -> str:
    from jaxevent.io.output import complete
    from jaxevent.report import write_png

    with complete(out, directory=True) as partial:
        lines = []
        for number, (at, image) in enumerate(_shown(video, times, tone)):
            file = f"frame_{number:08d}.png"
            write_png(partial / file, image)
            lines.append(f"{at / 1e6:.6f} {file}\n")
        (partial / "images.txt").write_text("".join(lines))
    return ""


def _shown(video: "Video", times: "NDArray", tone: str) -> "Iterator[tuple[int, NDArray]]":
    """Each time (us) and its image for the display, of limits common to all."""
    import numpy as np

    from jaxevent.report import display_limits, tone_map

    sample = times[np.unique(np.linspace(0, len(times) - 1, 16).round().astype(int))]
    if tone == "linear":  # the limits are those of any image
        sample = sample[:1]
    limits = display_limits(video(sample)[0], tone)
    for batch, images, _ in video.batches(times):
        shown = tone_map(images, tone, limits)
        for at, image in zip(batch, shown, strict=True):
            yield int(at), image


def demo(out: Path) -> None:
    from importlib import resources

    from jaxevent.evaluate import results, score, write_rows
    from jaxevent.io import load
    from jaxevent.reconstruction import METHODS
    from jaxevent.report import markdown_table

    with resources.as_file(resources.files("jaxevent") / "data/slider_depth_crop.h5") as path:
        recording = load(path)
    by_hand = {name: METHODS[name].Params.of(BY_HAND) for name in ("akf", "augmented", "cf")}
    runs: list[tuple[str, Any, Any]] = [
        *((name, method, method.Params()) for name, method in METHODS.items()),
        *(
            (f"{name}, thresholds and clock set by hand", METHODS[name], by_hand[name])
            for name in ("akf", "augmented")
        ),
    ]
    with results(out) as write:
        rows = [
            {**score(recording, method, params, progress=_progress()), "method": label}
            for label, method, params in runs
        ]
        print(markdown_table(rows))
        print("Every second frame was hidden and reconstructed; seconds include compiling.")
        _demo_figure(recording, by_hand, out / "comparison.png")
        slower = _demo_video(recording, by_hand["akf"], out / "video.mp4")
        write_rows(rows, write)
    print(
        f"Written to {out}: comparison.png, video.mp4 ({slower:.0f} times slower than real time), "
        "results.md, results.json"
    )


def _demo_figure(recording: "Recording", params: dict[str, Any], path: Path) -> None:
    """The AKF and a baseline, of equal thresholds, at one hidden frame in the middle."""
    import numpy as np

    from jaxevent.evaluate import frame_times, held_out
    from jaxevent.reconstruction import METHODS
    from jaxevent.report import comparison_figure

    given, hidden = held_out(recording)
    middle = hidden[len(hidden) // 2 :][:1]
    (image, variance), (baseline, _) = (
        METHODS[name].reconstruct(given, params[name])(frame_times(middle, params[name]))
        for name in ("akf", "cf")
    )
    assert given.frames is not None
    before = given.frames[int(np.searchsorted(given.frames.t, middle.t[0])) - 1 :][:1]
    truth = middle.intensity[0]
    ms = (middle.t[0] - before.t[0]) / 1000
    comparison_figure(
        path,
        [
            (f"input: last frame given, {ms:.0f} ms old", before.intensity[0], "image"),
            ("AKF", image[0], "image"),
            ("complementary filter", baseline[0], "image"),
            ("truth: the hidden frame", truth, "image"),
            ("AKF minus truth", np.clip(image[0], 0, 1) - truth, "error"),
            ("AKF standard deviation of ln(I + 1)", np.sqrt(variance[0]), "uncertainty"),
        ],
        f"{recording.name} at {middle.t[0] / 1e6:.3f} s, thresholds and clock set by hand",
    )


def _demo_video(recording: "Recording", params: Any, path: Path) -> float:
    """200 images per second of the recording's time, shown at 30; returns the slow-down."""
    import numpy as np

    from jaxevent.reconstruction import akf
    from jaxevent.report import video_writer

    rate, fps, longest = 200.0, 30.0, 180
    video = akf.reconstruct(recording, params, progress=_progress())
    zoom = 2 if recording.width < 480 else 1
    with video_writer(path, fps) as write:
        for _, image in _shown(video, _times(recording, rate)[:longest], "linear"):
            write(np.kron(image, np.ones((zoom, zoom), np.uint8)))
    return rate / fps


if __name__ == "__main__":
    sys.exit(main())
