"""The command `jaxevent calibrate`."""

from pathlib import Path
from typing import Any

from jaxevent.cli import arguments
from jaxevent.cli.arguments import command
from jaxevent.errors import InputError, MissingExtra

FILE_SUFFIXES = (".toml", ".png")


def add(commands: Any) -> None:
    one = command(
        commands,
        run,
        "Calibrate a recording by its own events and frames. It finds the frames' clock, contrast "
        "thresholds, noise, exposure and hot pixels. It prints each with a 95 % interval, or says "
        "that the recording does not determine it. Without suffix the output is a folder of "
        "calibration.toml, which --params of other commands takes, and calibration.png; with one "
        "it is the file of that kind. reconstruct, evaluate and fit calibrate by themselves.",
        "slider_depth.zip",
        "slider_depth.zip --out slider",
        "slider_depth.zip --out slider.toml",
    )
    one.add_argument("path", metavar="PATH", type=Path, help="a recording")
    one.add_argument(
        "--I0",
        metavar="I",
        type=float,
        default=1.0,
        help="offset inside the logarithm ln(I + I0) that thresholds hold for; default: "
        "%(default)s, that of most methods",
    )
    arguments.add_output(one, "--out", metavar="DIR_or_FILE", help="name in .toml, .png or none")
    arguments.add_reading(one)


def run(*, path: Path, I0: float | int, reading: dict[str, Any], out: Path | None) -> None:
    from jaxevent.calibration import calibrate, format_toml
    from jaxevent.io.output import complete
    from jaxevent.reconstruction.augment import FrameParams
    from jaxevent.show.calibration import calibration_table, plot_calibration

    if out is not None and out.suffix not in ("", *FILE_SUFFIXES):
        raise InputError(f"{out}: is neither .toml nor .png; give one of these, or a folder")
    FrameParams(I0=I0)  # checks it
    recording, _ = arguments.open_named(path, reading)
    recording.refuse_empty()
    calibration = calibrate(recording, I0)
    print(calibration_table(calibration), end="")
    if out is None:
        return
    contents: dict[str, Any] = {}
    if out.suffix != ".png":
        numbers = _numbers_of_methods(recording)
        contents["calibration.toml"] = format_toml(calibration, I0, str(path), numbers)
    if out.suffix != ".toml":
        try:
            contents["calibration.png"] = plot_calibration(calibration, recording, I0)
        except MissingExtra as error:
            if out.suffix:
                raise
            print(f"calibration.png is left out: {error}")
    if out.suffix:
        with complete(out) as partial:
            _write(partial, next(iter(contents.values())))
    else:
        with complete(out, directory=True) as partial:
            for name, content in contents.items():
                _write(partial / name, content)
    arguments.print_written(out, () if out.suffix else tuple(contents))


def _numbers_of_methods(recording: Any) -> dict[str, dict[str, float]]:
    """Return, by method, the numbers by which it predicts the recording's frames best; print them.

    Other methods take the calibration as it is.
    """
    from jaxevent.methods import find, names
    from jaxevent.reconstruction.augment import calibrated_values

    found: dict[str, dict[str, float]] = {}
    for name in names("reconstruction"):
        method: Any = find(name)
        if method.fuses and method.Params.predictor() is not None:
            values = calibrated_values(recording, method.Params(), method.names_left_open({}))
            if values.found:
                found[name] = values.found
                print(f"{'' if len(found) > 1 else chr(10)}best for {name}: {values}")
    return found


def _write(path: Path, content: Any) -> None:
    """Write a text or a figure.

    Args:
        path: File to write.
        content: The text, or a figure of matplotlib, which is stored as PNG.
    """
    if isinstance(content, str):
        path.write_text(content, encoding="utf-8")
    else:
        content.savefig(path, format="png", dpi=150)
