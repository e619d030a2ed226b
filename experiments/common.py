"""Parts that the scripts of this folder share: command lines, tables, the machine, CPU seconds."""

import argparse
import os
import platform
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxevent.io.output import complete


def make_folder(name: str) -> Path:
    """Return a folder, which is made if there is none."""
    path = Path(name)
    path.mkdir(parents=True, exist_ok=True)
    return path


def command_line(
    description: str | None, *, out: bool = False, data: bool = False, parts: Iterable[str] = ()
) -> argparse.ArgumentParser:
    """Return a parser with the options that scripts share.

    Args:
        description: Docstring of the script, whose first line is shown.
        out: Add --out, the folder for everything made.
        data: Add --data, the folder of recordings, by default $JAXEVENT_DATA/data.
        parts: Names that --only chooses from; all by default.
    """
    parser = argparse.ArgumentParser(description=(description or "").partition("\n")[0])
    if out:
        parser.add_argument("--out", type=make_folder, required=True, help="folder for results")
    if data:
        root = os.environ.get("JAXEVENT_DATA")
        default = Path(root) / "data" if root else None
        parser.add_argument(
            "--data", type=Path, default=default, required=default is None,
            help="folder of recordings; default: $JAXEVENT_DATA/data",
        )  # fmt: skip
    if parts := list(parts):
        parser.add_argument("--only", nargs="+", choices=parts, default=parts, metavar="PART",
                            help=f"some of {', '.join(parts)}")  # fmt: skip
    return parser


def machine() -> str:
    """Return the processor, the number of cores, and the versions of Python and JAX."""
    import jax

    model = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        lines = [v for v in cpuinfo.read_text().splitlines() if v.startswith("model name")]
        model = lines[0].partition(":")[2].strip() if lines else model
    return (
        f"{model}, {os.cpu_count()} cores, Python {platform.python_version()}, jax "
        f"{jax.__version__}, float32"
    )


def format_cell(value: Any) -> str:
    """Return a number with three digits, anything else as it is."""
    return f"{value:.3g}" if isinstance(value, float | np.floating) else str(value)


def markdown_table(header: Sequence[str], rows: Iterable[Sequence[Any]], text_columns=1) -> str:
    """Return a Markdown table, whose first `text_columns` columns are aligned to the left."""
    header = list(header)
    rule = ["---"] * text_columns + ["---:"] * (len(header) - text_columns)
    lines = [header, rule, *([format_cell(value) for value in row] for row in rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def table_of_rows(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return a Markdown table of rows by column, with "-" where a row has no value."""
    names = list(dict.fromkeys(name for row in rows for name in row))
    return markdown_table(names, ([row.get(name, "-") for name in names] for row in rows))


def write_text(path: Path, text: str) -> None:
    """Write a file, which appears when it is complete."""
    with complete(path) as partial:
        partial.write_text(text)


def least_cpu(tasks: Mapping[str, Callable[[], object]], repeat: int = 3) -> dict[str, float]:
    """Return the least CPU seconds of each task, of `repeat` turns after one that compiles.

    CPU seconds of this process change less than a clock when other programs run. In every turn each
    task runs once, so that all meet the same neighbours.
    """
    least = dict.fromkeys(tasks, np.inf)
    for turn in range(repeat + 1):
        for name, task in tasks.items():
            start = time.process_time()
            task()
            if turn:
                least[name] = min(least[name], time.process_time() - start)
    return least


def cpu_seconds(task: Callable[[], object], repeat: int = 5) -> float:
    """Return the least CPU seconds of one task."""
    return least_cpu({"": task}, repeat)[""]
