"""Arguments, outputs and progress that commands share."""

import argparse
import contextlib
import dataclasses
import difflib
import re
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn

from jaxevent.display import format_count
from jaxevent.errors import InputError, InputWarning


class HelpFormatter(argparse.HelpFormatter):
    """Help with a usage of one line, that of required arguments, and examples line by line."""

    def add_usage(self, usage: Any, actions: Any, groups: Any, prefix: str | None = None) -> None:
        if usage is None:
            names = {a: " ".join([*a.option_strings[:1], *_metavars(a)]) for a in actions}
            parts: list[str] = ["%(prog)s" + " [options]" * any(a.option_strings for a in actions)]
            choices = [group._group_actions for group in groups if group.required]
            parts += [f"({' | '.join(names.pop(a) for a in group)})" for group in choices]
            parts += [
                name if action.required else f"[{name}]"
                for action, name in names.items()
                if action.required or not action.option_strings
            ]
            usage = " ".join(parts)
        super().add_usage(usage, actions, groups, prefix)

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        if "\n" in text:
            return "".join(indent + line for line in text.splitlines(keepends=True))
        return super()._fill_text(text, width, indent)


def _metavars(action: argparse.Action) -> tuple[str, ...]:
    """Return the names of the values that an argument takes."""
    if action.nargs == 0 or action.metavar is None:
        return ()
    return action.metavar if isinstance(action.metavar, tuple) else (action.metavar,)


class CommandParser(argparse.ArgumentParser):
    """A parser whose errors suggest names, and show the usage of the command that was meant."""

    def error(self, message: str) -> NoReturn:
        """Print usage and error, and exit with 2; a wrong choice comes with the nearest one."""
        wrong = re.search(r"invalid choice: '(.*?)' \(choose from (.*)\)", message)
        if wrong is not None:
            from jaxevent.parameters import suggest_name

            known = [name.strip(" '") for name in wrong[2].split(",")]
            name = message[: wrong.start()] + f"{wrong[1]!r} is not possible"
            message = f"{name}; {suggest_name(wrong[1], known)}"
        super().error(message)

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse as argparse does; a command refuses what it does not know itself.

        Args:
            args: Words of the command line; None: the program's own.
            namespace: Object that gets the options; None: a new one.

        Returns:
            The options, and the words that the parser left.
        """
        found, unknown = super().parse_known_args(args, namespace)
        if unknown and self._subparsers is None:
            options = [name for name in self._option_string_actions if name.startswith("--")]
            name = unknown[0].partition("=")[0]
            near = difflib.get_close_matches(name, options, 1)
            advice = f"; did you mean {near[0]}?" if name.startswith("-") and near else ""
            if name.replace(".", "").isdigit():
                advice = "; several values of an option are one list, such as 1.0,1.5"
            self.error(f"unrecognized arguments: {' '.join(unknown)}{advice}")
        return found, unknown


def command(
    commands: Any, run: Callable, description: str, *examples: str, part: str = ""
) -> argparse.ArgumentParser:
    """Add a command, named by the module of `run`.

    Args:
        commands: The subparsers of `argparse` that get the command.
        run: Function that takes the parsed options by name.
        description: Text of its help; the first sentence is its line in the list of commands.
        examples: Arguments of examples, shown below the help.
        part: Name of a subcommand, as in `jaxevent camera merge`; "" for a command.

    Returns:
        Parser of the command, to which options are added.
    """
    name = run.__module__.rpartition(".")[2] + f" {part}" * bool(part)
    lines = "".join(f"\n  jaxevent {name} {example}".rstrip() for example in examples)
    one = commands.add_parser(
        part or name,
        help=description.partition(".")[0],
        description=description,
        epilog=f"example{'s' * (len(examples) > 1)}:{lines}",
        formatter_class=HelpFormatter,
    )
    one.set_defaults(command=run)
    return one


def add_size(one: Any) -> None:
    one.add_argument(
        "--size",
        metavar="W,H",
        type=size,
        help="sensor size in pixels, for a recording that does not state it",
    )


def add_reading(one: argparse.ArgumentParser, frames: bool = True) -> None:
    """Add the options of `jaxevent.load`; `run` takes them as `reading`, for `open_recording`.

    Without `frames` there is no option that chooses the frames.
    """
    group = one.add_argument_group("reading the recording")
    add_size(group)
    group.add_argument(
        "--stream",
        metavar="NAME",
        help="which camera of a file: a topic, left, right or a number; none: images alone",
    )
    group.add_argument(
        "--camera",
        metavar="FILE",
        type=lens,
        help="calibration of the camera instead of the recording's: camchain.yaml of Kalibr or "
        "camera_info of ROS or OpenCV, FILE:NAME of several; or fx,fy,cx,cy in px, followed by "
        "k1,k2,p1,p2,k3 or k1,k2,k3,k4,fisheye",
    )
    group.add_argument(
        "--time-unit",
        metavar="UNIT",
        choices=("s", "ms", "us", "ns"),
        help="s, ms, us or ns: unit of the event times of a table; default: inferred",
    )
    if frames:
        add_frames(group, "--frames", "a file")
    one.set_defaults(
        reading=("size", "stream", "camera", "time_unit", *(("frames",) if frames else ()))
    )


def add_live(one: argparse.ArgumentParser, printed: str) -> None:
    """Add the option --live, by which a command prints estimates as events come."""
    one.add_argument(
        "--live",
        action="store_true",
        help=f"print {printed} as events come, instead of writing --out; PATH may be -, for "
        "lines t x y p on standard input, t in us, or in s with a decimal point; needs --size then",
    )


def refuse_with_live(given: Mapping[str, bool]) -> None:
    """Raise `InputError` for the first option that was given and is not for --live."""
    for name, is_given in given.items():
        if is_given:
            raise InputError(f"--live is not for {name}; leave out one of the two")


def open_live(path: Path, reading: dict[str, Any]) -> tuple[Any, Iterator[Any]]:
    """Open the input of --live.

    Args:
        path: The recording; "-" is standard input.
        reading: Options of `add_reading`; of standard input `size` must be known.

    Returns:
        A recording that describes the sensor, and an iterator over chunks of events.

    Raises:
        InputError: The events come from standard input, and --size is missing.
    """
    from jaxevent.events import live

    if str(path) != "-":
        recording = open_recording(path, reading)
        return recording, live.divide(recording)
    from jaxevent.io.calibration import read_camera
    from jaxevent.recording import Events, Recording

    if reading["size"] is None:
        raise InputError("standard input: does not state the sensor's size; give --size W,H")
    camera = reading["camera"]
    if isinstance(camera, str):
        camera = read_camera(camera, reading["size"])
    width, height = reading["size"]
    recording = Recording("standard input", width, height, Events.empty(), camera=camera)
    return recording, live.read_lines(sys.stdin.buffer)


def add_frames(one: Any, name: str, source: str) -> None:
    """Add the option that chooses the frames of a recording.

    Args:
        one: Parser of a command.
        name: Name of the option.
        source: Name of the recording in the help.
    """
    one.add_argument(
        name,
        metavar="NAME",
        help=f"which images of {source} are the frames: a topic or a number; none: no frames",
    )


def add_span(one: argparse.ArgumentParser) -> None:
    """Add the options --start and --stop, a part of the recording."""
    for name in ("start", "stop"):
        end = "end" if name == "stop" else name
        one.add_argument(
            f"--{name}", metavar="S", type=float, help=f"{end} time, in s on the recording's clock"
        )


def add_no_calibrate(one: argparse.ArgumentParser) -> None:
    one.add_argument(
        "--no-calibrate",
        dest="calibrate",
        action="store_false",
        help="leave clock and thresholds that are not given at the defaults, instead of taking "
        "them from the recording",
    )


def describe_calibration(values: Any) -> str:
    """Describe the `CalibratedValues` that a command takes from a recording, in one line."""
    notes: dict[str, list[str]] = {}
    for name, note in values.missing.items():
        notes.setdefault(note, []).append("clock" if name == "clock_offset" else name)
    parts = [f"calibrated: {values}" if values.found else "not calibrated"]
    parts += [f"{', '.join(names)} by default ({note})" for note, names in notes.items()]
    return f"{'; '.join(parts)} (jaxevent calibrate shows more; --no-calibrate turns it off)"


def open_recording(path: Path, reading: dict[str, Any], **more: Any) -> Any:
    """Open a recording with the options of `add_reading`; events and images stay in its file.

    Args:
        path: The recording.
        reading: Options of `add_reading`, arguments of `jaxevent.load`.
        more: Further arguments of `jaxevent.load`.

    Returns:
        The recording.
    """
    from jaxevent.io import load

    return load(path, in_memory=False, progress=show_progress(), **reading, **more)


def open_named(path: Path, reading: dict[str, Any]) -> tuple[Any, str]:
    """Open a recording as `open_recording` does, and name it by its path for messages.

    Args:
        path: The recording.
        reading: Options of `add_reading`.

    Returns:
        The recording, whose name is its path, and its own name.
    """
    recording = open_recording(path, reading)
    return dataclasses.replace(recording, name=str(path)), recording.name


def warn_of_faults(recording: Any, sample: Any = None, *, frames: bool = True) -> None:
    """Warn of each fault of events, frames and clocks, with its statistic and the remedy.

    Args:
        recording: The recording.
        sample: A sample of it, if there is one.
        frames: Whether to warn of faults of frames and clocks, too.
    """
    from jaxevent.calibration import check_consistency
    from jaxevent.calibration.faults import EVENT_FAULTS

    for fault in check_consistency(recording, sample):
        # `check_clocks` judges clocks, at the offset that is used.
        if fault.name in EVENT_FAULTS or (frames and fault.name != "disjoint clocks"):
            warnings.warn(f"{recording.name}: {fault}", InputWarning, stacklevel=2)


def add_output(
    one: argparse.ArgumentParser, *names: str, shared: bool = False, **more: Any
) -> None:
    """Add an option for a file or folder to write, and --force; `guard_outputs` knows it by this.

    A `shared` folder may hold other files. `run` then takes `force` and sees to its files itself,
    by `jaxevent.runs.results.check_folder`, which knows their names.
    """
    outputs = one.get_default("outputs") or {}
    if not outputs:
        one.add_argument(
            "--force",
            action="store_true",
            help="replace existing files; others in a folder stay",
        )
    added = one.add_argument(*names, type=Path, **more)
    one.set_defaults(outputs={**outputs, added.dest: shared})


@contextlib.contextmanager
def guard_outputs(options: dict[str, Any], words: Sequence[str]) -> Iterator[dict[str, Any]]:
    """Check the outputs of a command, and yield the options that its `run` takes.

    Within the block, written files record the command line and the inputs they were made from.

    Args:
        options: Options of the command by name. Those that `options["outputs"]` names are outputs,
            all other paths are inputs.
        words: Words of the command line, which written files record.

    Yields:
        The options without `outputs`, with those of `add_reading` as one, `reading`.

    Raises:
        InputError: As `jaxevent.io.output.check_outputs` does.
    """
    outputs = options.get("outputs", {})
    force = options.get("force", False)
    taken = {name: value for name, value in options.items() if name not in ("outputs", "force")}
    if "reading" in taken:
        taken["reading"] = {name: taken.pop(name) for name in taken["reading"]}
    if any(outputs.values()):
        yield {**taken, "force": force}
    elif outputs:
        from jaxevent.io.calibration import split_name
        from jaxevent.io.checks import companions
        from jaxevent.io.output import (
            Command,
            allow_writing_into_folders,
            check_outputs,
            claim_outputs,
            running,
            unwritable,
        )

        named = [path for name in outputs if (path := taken[name]) is not None]
        inputs = [
            one
            for name, value in taken.items()
            if name not in outputs
            for one in (value if isinstance(value, list) else [value])
            if isinstance(one, Path)
        ]
        camera = taken.get("reading", {}).get("camera")
        if isinstance(camera, str):
            inputs.append(split_name(camera)[0])
        read = [file for path in inputs for file in (path, *companions(path))]
        with claim_outputs(named) as claims:
            held = [claim for _, claim in claims if isinstance(claim, Path)]
            check_outputs(named, inputs, force=force, claims=held)
            for out, claim in claims:
                if isinstance(claim, OSError):  # told before the work begins
                    raise unwritable(out, claim)
            with allow_writing_into_folders(force), running(Command(words, read)):
                yield taken
    else:
        yield taken


def size(text: str) -> tuple[int, int]:
    try:
        width, height = (int(number) for number in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not W,H, for example 240,180") from None
    return width, height


def lens(text: str) -> Any:
    """Return the camera of numbers with commas between, or else the text, a file's name."""
    values = text.split(",")
    model = values.pop().strip() if len(values) > 4 and not _is_number(values[-1]) else ""
    if len(values) < 2 or not _is_number(values[0]) or Path(text).exists():
        return text
    if len(values) < 4 or not all(map(_is_number, values)):
        raise argparse.ArgumentTypeError(
            f"{text!r} is neither a file nor FX,FY,CX,CY, for example 200,200,119.5,89.5"
        )
    from jaxevent.camera import LENS_MODELS, PinholeCamera

    fx, fy, cx, cy, *k = map(float, values)
    if not model and len(k) > len(LENS_MODELS["radtan"].coefficients):
        model = "rational"
    try:
        return PinholeCamera(fx, fy, cx, cy, tuple(k), model)
    except InputError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def number_or_path(text: str) -> float | Path:
    try:
        return float(text)
    except ValueError:
        return Path(text)


def path_or_auto(text: str) -> Path | str:
    return text if text == "auto" else Path(text)


def seed(text: str) -> tuple[float, ...]:
    return _numbers(text, (3, 4), float, "X,Y,SIZE or X,Y,SIZE,T, for example 120,90,8")


def pair(text: str) -> tuple[int, ...]:
    return _numbers(text, (2,), int, "ID,ID, for example 0,1")


def names(text: str) -> tuple[str, ...]:
    found = tuple(name.strip() for name in text.split(","))
    if len(found) != 2 or not all(found):
        raise argparse.ArgumentTypeError(f"{text!r} is not NAME,NAME, for example cam1,cam0")
    return found


def plane(text: str) -> tuple[float, ...]:
    return _numbers(text, (4,), float, "A,B,C,D, for example 0,0,1,2.5")


def span(text: str) -> tuple[float, ...]:
    return _numbers(text, (2,), float, "START,STOP in seconds, for example 0,0.5")


def _numbers(text: str, counts: tuple[int, ...], kind: Callable, meant: str) -> tuple:
    try:
        numbers = tuple(kind(number) for number in text.split(","))
    except ValueError:
        numbers = ()
    if len(numbers) not in counts:
        raise argparse.ArgumentTypeError(f"{text!r} is not {meant}")
    return numbers


def show_progress() -> bool:
    return sys.stderr.isatty()


def print_written(out: Path, names: Sequence[str] = ()) -> None:
    """Print the files that were written: `out`, or those of these names in it, one line each."""
    print("", *(f"written: {path}" for path in [out / name for name in names] or [out]), sep="\n")


def describe_speed(events: int, seconds: float) -> str:
    return f"{seconds:.2f} s, {events / seconds:,.0f} events/s"


def check_seed(number: int) -> None:
    if number < 0:
        raise InputError(f"--seed {number} is not possible; give a whole number from 0")


def print_stored(recording: Any, path: Path) -> None:
    events = format_count(len(recording.events), "event")
    frames = format_count(len(recording.frames) if recording.frames else 0, "frame")
    print(f"{path}: {events}, {frames}, {path.stat().st_size / 1e6:.1f} MB")
