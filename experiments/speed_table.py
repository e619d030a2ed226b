"""Print the table of docs/results/speed.md: python experiments/speed_table.py bench.json

bench.json is what `bench.py --json bench.json` writes.
"""

import json
import sys
from pathlib import Path


def main() -> None:
    bench = json.loads(Path(sys.argv[1]).read_text())
    print(bench["machine"])
    for name, value in bench["M events per CPU second"].items():
        print(f"| {name} | {value:.1f} |")
    for name, value in bench["ratios"].items():
        print(f"{name}: {value:.2f}")


if __name__ == "__main__":
    main()
