"""CPU seconds of a short `jaxevent reconstruct` in a fresh process, with cold and warm caches.

    python experiments/bench_start.py [--methods akf aks] [--turns 3]

The packaged crop at 200 images per second, to HDF5. Cold: nothing that numba and XLA compile is
kept; Python's own bytecode is. Each line is the least of the turns, those of all methods taken in
turns, so that all meet the same neighbours.
"""

import argparse
import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path

import jaxevent

CROP = Path(jaxevent.__file__).parent / "data" / "slider_depth_crop.h5"
PROGRAM = "import sys; from jaxevent.cli import main; sys.exit(main())"
COMMAND = (sys.executable, "-c", PROGRAM, "reconstruct", str(CROP), "--rate", "200")


def seconds(method: str, caches: Path, out: Path) -> float:
    """Of one process."""
    folders = {"JAXEVENT_CACHE": str(caches)}
    kept = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    words = (*COMMAND, "--method", method, "--out", str(out))
    subprocess.run(words, env={**kept, **folders}, check=True, capture_output=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    out.unlink()
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--methods", nargs="+", default=["akf", "aks"], metavar="NAME")
    parser.add_argument("--turns", type=int, default=3)
    arguments = parser.parse_args()
    least: dict[tuple[str, str], float] = {}
    for _ in range(arguments.turns):
        for method in arguments.methods:
            with tempfile.TemporaryDirectory() as folder:
                for state in ("cold", "warm"):
                    found = seconds(method, Path(folder), Path(folder) / "images.h5")
                    key = method, state
                    least[key] = min(least.get(key, float("inf")), found)
    print("| method | cold | warm |\n|---|---:|---:|")
    for method in arguments.methods:
        print(f"| `{method}` | {least[method, 'cold']:.1f} | {least[method, 'warm']:.1f} |")


if __name__ == "__main__":
    main()
