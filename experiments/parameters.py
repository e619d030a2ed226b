"""Print docs/parameters.md, all parameters of all methods: python experiments/parameters.py"""

from typing import Any

import jaxevent
from jaxevent.methods import HOMES
from jaxevent.parameters import Choice, Parameters, Share, shown

TITLES = {"reconstruction": "Reconstruction", "blob": "Tracking", "egomotion": "Egomotion"}


def cell(value: Any) -> str:
    """A value as TOML has it."""
    return str(value).lower() if isinstance(value, bool) else shown(value).replace("'", '"')


def rows(kind: type[Parameters]) -> list[str]:
    """A row for each setting of a class: name, default, unit, gradient, meaning."""
    lines = ["| parameter | default | unit | gradient | |", "|---|---|---|---|---|"]
    fixed = {**kind.choices, **kind().without_gradient()}
    for name, setting in kind.settings().items():
        meaning = setting.meaning
        if isinstance(setting, Share):
            meaning += "; in [0, 1)"
        if isinstance(setting, Choice):
            meaning += f"; one of {', '.join(map(cell, setting.options))}"
        gradient = "" if name in fixed else "yes"
        parts = (f"`{name}`", cell(setting.default), setting.unit, gradient, meaning)
        lines.append(f"| {' | '.join(part.replace('|', chr(92) + '|') for part in parts)} |")
    return lines


def presets(kind: type[Parameters]) -> list[str]:
    """A line for each preset: what it sets."""
    lines = []
    for name, values in kind.presets.items():
        parts = ", ".join(f"{key} = {cell(value)}" for key, value in values.items())
        lines.append(f'- `preset = "{name}"`: {parts or "the defaults"}')
    return lines


def page() -> str:
    parts = [
        "# Parameters",
        "Made by `python experiments/parameters.py`. Numbers with a gradient can be named under "
        "`fit` in a fit's configuration, the others under `search`. A positive number that is 0 "
        "stays 0: give it a value first. The column of gradients holds as the other parameters "
        "stand by default.",
    ]
    for family, homes in HOMES.items():
        parts.append(f"## {TITLES[family]}")
        for name in homes:
            kind = jaxevent.METHODS[name].Params
            parts += [f"### {name}", "\n".join(rows(kind))]
            if kind.presets:
                parts.append("\n".join(presets(kind)))
    return "\n\n".join(parts) + "\n"


if __name__ == "__main__":
    print(page(), end="")
