"""The command `jaxevent evaluate`."""

import sys
from pathlib import Path
from typing import Any

from jaxevent.cli import arguments
from jaxevent.cli.arguments import command, show_progress


def add(commands: Any) -> None:
    one = command(
        commands,
        run,
        "Compare methods on recordings. It hides frames, reconstructs them and prints a table of "
        "the errors. With --out, what is finished is kept: the same again goes on where it was "
        "stopped, and computes only what is new. A recording or method that fails, or for which an "
        "extra is missing, is said, and the others go on; the exit status is 2 only if all fail.",
        "configs/slider_depth.toml --out results",
        "mine.toml --metrics authors_ssim masked_mse --out results --workers 8",
        "mine.toml --out results --cluster tcp://10.0.0.1:8786",
    )
    one.add_argument("config", metavar="CONFIG.toml", type=Path, help="recordings and methods")
    arguments.add_output(
        one,
        "--out",
        shared=True,
        metavar="DIR",
        help="folder for report.html, results.json and others",
    )
    one.add_argument(
        "--metrics",
        metavar="NAME",
        nargs="+",
        default=[],
        help="metrics in addition to the file's: for images psnr, lpips, hdr_quality, global_ssim, "
        "matlab_ssim (MATLAB's), authors_ssim and masked_mse (of the AKF's authors), or "
        "your own: package.module:function",
    )
    arguments.add_no_calibrate(one)
    where = one.add_mutually_exclusive_group()
    where.add_argument(
        "--workers", metavar="N", type=int, help="compute in N processes instead of one"
    )
    where.add_argument(
        "--cluster", metavar="ADDRESS", help="compute on the Dask cluster with this scheduler"
    )
    where.add_argument(
        "--scheduler-file",
        metavar="FILE",
        type=Path,
        help="compute on the Dask cluster whose scheduler wrote this file",
    )
    one.add_argument(
        "--retries",
        metavar="K",
        type=int,
        default=2,
        help="further attempts where a worker dies or fails; default: %(default)s",
    )


def _calibrated_lines(rows: list[dict[str, Any]]) -> list[str]:
    """Describe what the recordings determined, in one line for all methods with the same values."""
    from jaxevent.calibration.result import format_calibrated

    methods: dict[tuple[str, str], list[str]] = {}
    for row in rows:
        if "calibrated" in row:
            values = [format_calibrated(name, row["params"][name]) for name in row["calibrated"]]
            methods.setdefault((row["recording"], ", ".join(values)), []).append(row["method"])
    return [
        f"{recording}: calibrated for {', '.join(names)}: {values}"
        for (recording, values), names in methods.items()
    ]


def run(
    *,
    config: Path,
    out: Path | None,
    metrics: list[str],
    calibrate: bool,
    workers: int | None,
    cluster: str | None,
    scheduler_file: Path | None,
    retries: int,
    force: bool,
) -> None:
    from jaxevent.errors import install_command
    from jaxevent.runs.evaluate import RESULT_FILES, evaluate
    from jaxevent.show.tables import markdown_table

    rows = evaluate(
        config,
        out,
        progress=show_progress(),
        workers=workers,
        cluster=cluster,
        scheduler_file=scheduler_file,
        retries=retries,
        replace=force,
        metrics=metrics,
        calibrate=None if calibrate else False,
    )
    print(markdown_table(rows), end="")
    for line in _calibrated_lines(rows):
        print(line)
    if out is not None:
        files = [name for name in RESULT_FILES if (out / name).exists()]
        if "results.parquet" not in files:
            print(f"results.parquet is left out: it needs {install_command('parquet')}")
        arguments.print_written(out, files)
    skipped = [f"{row['method']} is skipped: {row['error']}" for row in rows if "skipped" in row]
    for sentence in dict.fromkeys(skipped):
        print(f"jaxevent: {sentence}", file=sys.stderr)
    failed = sum("error" in row and "skipped" not in row for row in rows)
    if failed:
        print(f"jaxevent: {failed} of {len(rows)} rows failed, see below them", file=sys.stderr)
