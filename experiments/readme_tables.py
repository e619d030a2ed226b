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
    numbers, choices = {}, {}
    for method in jaxevent.METHODS.values():
        numbers |= method.Params.numbers
        choices |= method.Params.choices
    for name, number in numbers.items():
        default = number.default if isinstance(number.default, tuple) else (number.default,)
        text = ", ".join(f"{value:.4g}" for value in default)
        print(f"| `{name}` | {text} | {number.unit} | {number.meaning} |")
    for name, choice in choices.items():
        options = " or ".join(str(option).lower() for option in choice.options)
        print(f"| `{name}` | {options} | | {choice.meaning} |")


if __name__ == "__main__":
    main()
