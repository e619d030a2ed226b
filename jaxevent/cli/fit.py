"""The command `jaxevent fit`."""

from pathlib import Path
from typing import Any

from jaxevent.cli import arguments
from jaxevent.cli.arguments import command, show_progress
from jaxevent.errors import InputError


def add(commands: Any) -> None:
    one = command(
        commands,
        run,
        "Fit parameters of methods to recordings. It writes them with tables of the errors before "
        "and after, and prints the errors of images that it did not use, every number that it "
        "found with its start and a confidence interval, and what ran to a bound or away. An "
        "interrupted fit goes on with --resume. Where steps lead away, it writes the best "
        "parameters seen; the exit status is 2 then. Several processes, on one machine or many, "
        "fit together: each is given the same arguments and its number.",
        "configs/fit_slider_depth.toml --out fitted",
        "configs/fit_slider_depth.toml --recording mine.h5 --out mine --resume",
        "mine.toml --out fitted --coordinator host1:4321 --processes 2 --process 0",
    )
    one.add_argument("config", metavar="CONFIG.toml", type=Path, help="configuration of the fit")
    arguments.add_output(
        one,
        "--out",
        shared=True,
        metavar="DIR",
        required=True,
        help="folder for params.toml, results.md",
    )
    one.add_argument(
        "--recording",
        metavar="PATH",
        dest="recordings",
        action="append",
        help="recording to fit to, instead of those in the file: a path, a pattern, or "
        "NAME:FOLDER for a whole data set; may be repeated",
    )
    arguments.add_no_calibrate(one)
    one.add_argument("--resume", action="store_true", help="continue from the checkpoint in DIR")
    one.add_argument(
        "--coordinator", metavar="HOST:PORT", help="a free port of the machine of process 0"
    )
    one.add_argument(
        "--processes", metavar="N", type=int, help="number of processes that fit together"
    )
    one.add_argument("--process", metavar="I", type=int, help="number of this process, from 0")
    one.add_argument(
        "--distributed",
        action="store_true",
        help="let JAX find coordinator and processes: under SLURM, Open MPI, Kubernetes",
    )


def run(
    *,
    config: Path,
    out: Path,
    recordings: list[str] | None,
    calibrate: bool,
    resume: bool,
    coordinator: str | None,
    processes: int | None,
    process: int | None,
    distributed: bool,
    force: bool,
) -> None:
    from jaxevent.errors import install_command
    from jaxevent.processes import is_process_zero, join

    parts = (coordinator, processes, process)
    if distributed and parts != (None, None, None):
        raise InputError(
            "--distributed finds the coordinator and the processes itself; give one or the other"
        )
    if distributed or parts != (None, None, None):
        join(*parts)

    from jaxevent.runs.fit import RESULT_FILES, fit

    use = None if calibrate else False
    rows = fit(config, out, recordings, resume, show_progress(), replace=force, calibrate=use)
    if not is_process_zero():
        return
    print((out / "results.md").read_text(encoding="utf-8"), end="")
    files = [name for name in RESULT_FILES if (out / name).exists()]
    if "loss.png" not in files:
        print(f"\nloss.png is left out: it needs {install_command('plot')}")
    arguments.print_written(out, files)
    warnings = dict.fromkeys(row["warning"] for row in rows if "warning" in row)
    if warnings:
        raise InputError(f"{config}: {'; '.join(warnings)}")
