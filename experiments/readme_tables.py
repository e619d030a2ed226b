"""Print the README's tables of speed (from `bench.py --json FILE`) and of parameters.

python experiments/readme_tables.py bench.json
"""

import json
import sys
from pathlib import Path

import jaxevent


def main() -> None:
    bench = json.loads(Path(sys.argv[1]).read_text())
    print(bench["machine"])
    for name, value in bench["M events/s"].items():
        print(f"| {name} | {value:.1f} |")
    for name, value in bench["ratios"].items():
        print(f"{name}: {value:.2f}")
    print("\n| parameter | default | unit | |\n|---|---|---|---|")
    known = {}
    for method in jaxevent.METHODS.values():
        known |= method.Params.numbers
    for name, number in known.items():
        print(f"| `{name}` | {number.default:.4g} | {number.unit} | {number.meaning} |")


if __name__ == "__main__":
    main()
