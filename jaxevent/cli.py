"""The command line: `jaxevent demo | info | convert | reconstruct | evaluate`.

What cannot be used is said in one line on stderr, exit status 2. The libraries are imported by the
command that needs them, so that help appears at once.
"""

import argparse
import contextlib
import dataclasses
import os
import sys
import textwrap
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import jaxevent
from jaxevent.errors import InputError


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

    recording = load(source, size, in_memory=False, progress=_progress())
    save(recording, target, compression, progress=_progress())
    frames = len(recording.frames) if recording.frames else 0
    size_mb = target.stat().st_size / 1e6
    print(f"{target}: {len(recording.events):,} events, {frames} frames, {size_mb:.1f} MB")


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
    from jaxevent.export import evenly, write_hdf5, writer
    from jaxevent.io import load

    write = writer(out)
    if tone is not None and write is write_hdf5:
        raise InputError(f"{out}: --tone is for images to look at; HDF5 holds linear intensity")
    estimator = find_method(method)
    values = estimator.Params() if params is None else estimator.Params.load(params)
    recording = load(path, size, in_memory=False, progress=_progress())
    name = recording.name
    recording = dataclasses.replace(recording, name=str(path))  # for messages
    if at == "frames" and recording.frames is None:
        raise InputError(f"{path}: holds no frames; give --rate instead of --at frames")
    if rate is None and recording.frames is not None:
        times = frame_times(recording.frames, values)
    else:
        times = evenly(recording, 100.0 if rate is None else rate)
    clock = time.perf_counter()
    video = estimator.reconstruct(recording, values, progress=_progress())
    how = write(video, times, out, tone or "linear", name)
    seconds = time.perf_counter() - clock
    print(
        f"{out}: {len(times):,} images{how}, {seconds:.2f} s, "
        f"{len(recording.events) / seconds:,.0f} events/s"
    )


def info(path: Path, size: tuple[int, int] | None) -> None:
    from jaxevent.describe import describe
    from jaxevent.io import load

    recording = load(path, size, in_memory=False, progress=_progress())
    lines = [("file", str(path)), *describe(recording, progress=_progress())]
    width = max(len(name) for name, _ in lines)
    for name, text in lines:
        print(f"{name:{width}}  {text}")


def demo(out: Path) -> None:
    from jaxevent.demo import demo as run

    run(out, progress=_progress())


if __name__ == "__main__":
    sys.exit(main())
