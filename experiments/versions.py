"""Try the oldest and the newest versions of the dependencies, each in an environment of its own.

    python experiments/versions.py                        # as `make versions` does
    python experiments/versions.py --page docs/versions.md   # and writes the table into the page
    python experiments/versions.py 3.13 --end oldest

For each Python and each end of the range uv makes an environment with jaxevent and its core
dependencies alone, in a temporary folder, and `smoke.py` runs there. Pythons that this machine does
not have are left out. Needs uv, on the path or beside this Python, and an index of packages.
"""

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parent.parent
PYTHONS = ("3.11", "3.12", "3.13")
# The oldest versions are of what pyproject.toml names; what those need in turn is the newest.
RESOLUTIONS = {"oldest": "lowest-direct", "newest": "highest"}
BEGIN, END = "<!-- table: begin -->\n", "<!-- table: end -->\n"


def core_dependencies() -> list[str]:
    """Return the names of the core dependencies, in the order of pyproject.toml."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    return [re.split(r"[^\w-]", line)[0] for line in project["dependencies"]]


def find_uv() -> str:
    """Return the path of uv; ends the program where there is none."""
    beside = Path(sys.executable).with_name("uv")
    found = str(beside) if beside.exists() else shutil.which("uv")
    if found is None:
        sys.exit("uv is not installed: pip install uv")
    return found


def find_python(uv: str, version: str) -> str | None:
    """Return an interpreter of this version that runs, of those that uv finds; None without one."""
    words = [uv, "python", "list", "--only-installed", "--no-python-downloads", "--output-format"]
    listed = subprocess.run([*words, "json", version], capture_output=True, text=True, cwd=ROOT)
    found = [one["path"] for one in json.loads(listed.stdout or "[]")]
    managed = sorted(Path.home().glob(f".pyenv/versions/{version}.*/bin/python"))
    for path in [*map(str, managed), *found]:
        test = f"import ensurepip, sys; assert sys.version.startswith('{version}.')"
        if path and subprocess.run([path, "-c", test], capture_output=True).returncode == 0:
            return path
    return None


def attempt(uv: str, python: str, resolution: str, folder: Path) -> dict[str, Any]:
    """Install and run the smoke test; returns its report, or the reason why there is none."""
    bin = folder / ("Scripts" if os.name == "nt" else "bin") / "python"
    environment = {
        name: value
        for name, value in os.environ.items()
        if name not in ("PYTHONPATH", "VIRTUAL_ENV", "UV_CONSTRAINT", "PIP_CONSTRAINT")
    }
    environment["JAXEVENT_CACHE"] = str(folder / "compiled")
    environment["JAX_DISABLE_MOST_OPTIMIZATIONS"] = "1"  # compiling is most of the time
    install = [uv, "pip", "install", "--quiet", "--python", str(bin), "--resolution", resolution]
    for words in (
        [uv, "venv", "--quiet", "--python", python, str(folder)],
        [*install, str(ROOT)],
        [str(bin), str(ROOT / "experiments/smoke.py")],
    ):
        # Not in the checkout: jaxevent is what was installed.
        done = subprocess.run(
            words, capture_output=True, text=True, env=environment, cwd=folder.parent
        )
        if done.returncode != 0:
            lines = (done.stderr.strip() or "no reason").splitlines()
            return {"failed": f"{Path(words[0]).name} {words[1]}: {lines[-1]}"}
    return json.loads(done.stdout.splitlines()[-1])


def run_all(pythons: list[str], ends: list[str]) -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Try each Python with each end of the range, and yield the reports."""
    uv = find_uv()
    for version in pythons:
        python = find_python(uv, version)
        if python is None:
            print(f"Python {version} is not on this machine and is left out", file=sys.stderr)
            continue
        for end in ends:
            print(f"Python {version}, {end} versions ...", file=sys.stderr, flush=True)
            with tempfile.TemporaryDirectory() as folder:
                yield version, end, attempt(uv, python, RESOLUTIONS[end], Path(folder) / "venv")


def outcome(report: dict[str, Any]) -> str:
    """Return a report's result in words: that all parts work, or the reasons of those that fail."""
    if "failed" in report:
        return report["failed"]
    failed = {name: reason for name, reason in report["results"].items() if reason}
    if failed:
        return "; ".join(f"{name}: {reason}" for name, reason in failed.items())
    return f"all {len(report['results'])} parts work"


def table(reports: list[tuple[str, str, dict[str, Any]]]) -> str:
    """Return a table in Markdown: a column for each environment, a row for each dependency."""
    rows = [
        ["", *(f"{end}, Python {version}" for version, end, _ in reports)],
        ["---"] * (len(reports) + 1),
    ]
    for name in core_dependencies():
        found = [report.get("versions", {}).get(name, "") for *_, report in reports]
        rows.append([name, *found])
    rows.append(["result", *(outcome(report) for *_, report in reports)])
    return "".join(f"| {' | '.join(cell.replace('|', '/') for cell in row)} |\n" for row in rows)


def write_into(page: Path, made: str) -> None:
    """Replace the table of a page, between its two marks."""
    before, _, rest = page.read_text().partition(BEGIN)
    _, _, after = rest.partition(END)
    page.write_text(f"{before}{BEGIN}\n{made}\n{END}{after}")


def main() -> None:
    parser = argparse.ArgumentParser(description="Try the oldest and newest dependencies.")
    parser.add_argument("pythons", nargs="*", default=list(PYTHONS), metavar="PYTHON")
    parser.add_argument("--end", choices=list(RESOLUTIONS), action="append")
    parser.add_argument("--page", type=Path, help="a page whose table is replaced")
    options = parser.parse_args()
    reports = list(run_all(options.pythons, options.end or list(RESOLUTIONS)))
    made = table(reports)
    print(made, end="")
    if options.page is not None:
        write_into(options.page, made)
    if not reports or any(not outcome(report).startswith("all ") for *_, report in reports):
        sys.exit(1)


if __name__ == "__main__":
    main()
