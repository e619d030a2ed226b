"""The page of all parameters of all methods, made from the code when the site is built.

`python experiments/parameters.py` prints it; `on_files` is a hook of MkDocs (`mkdocs.yml`).
"""

from typing import Any

import jaxevent
from jaxevent.estimator import Estimator
from jaxevent.methods import METHOD_HOMES
from jaxevent.parameters import Choice, Parameters, UnitInterval, format_value

TITLES = {"reconstruction": "Reconstruction", "blob": "Tracking", "egomotion": "Egomotion"}


def cell(value: Any) -> str:
    """Format a value as TOML."""
    return str(value).lower() if isinstance(value, bool) else format_value(value).replace("'", '"')


def rows(method: Estimator) -> list[str]:
    """Return a row for each setting of a method: name, default, unit, gradient, meaning."""
    kind = method.Params
    lines = ["| parameter | default | unit | gradient | |", "|---|---|---|---|---|"]
    fixed = {**kind.choices, **kind().without_gradient()}
    if not method.differentiable:
        fixed = kind.settings()
    for name, setting in kind.settings().items():
        meaning = setting.meaning
        if isinstance(setting, UnitInterval):
            meaning += "; in [0, 1)"
        if isinstance(setting, Choice):
            meaning += f"; one of {', '.join(map(cell, setting.options))}"
        gradient = "" if name in fixed else "yes"
        parts = (f"`{name}`", cell(setting.default), setting.unit, gradient, meaning)
        lines.append(f"| {' | '.join(part.replace('|', chr(92) + '|') for part in parts)} |")
    return lines


def presets(kind: type[Parameters]) -> list[str]:
    """Return a line for each preset and its values."""
    lines = []
    for name, values in kind.presets.items():
        parts = ", ".join(f"{key} = {cell(value)}" for key, value in values.items())
        lines.append(f'- `preset = "{name}"`: {parts or "the defaults"}')
    return lines


def page() -> str:
    """Return the page as Markdown."""
    parts = [
        "# Parameters",
        "Numbers with a gradient can be named under "
        "`fit` in a fit's configuration, other numbers under `search`. A method without any "
        "gradient computes on the host: its numbers are searched. A positive number that is 0 "
        "stays 0: give it a value first. The column of gradients holds as the other parameters "
        "stand by default.",
    ]
    for family, homes in METHOD_HOMES.items():
        parts.append(f"## {TITLES[family]}")
        for name in homes:
            method = jaxevent.METHODS[name]
            kind = method.Params
            parts += [f"### {name}", "\n".join(rows(method))]
            if kind.presets:
                parts.append("\n".join(presets(kind)))
    return "\n\n".join(parts) + "\n"


def on_files(files: Any, config: Any) -> Any:
    """Add the page to the files that MkDocs builds."""
    from mkdocs.structure.files import File

    files.append(File.generated(config, "parameters.md", content=page()))
    return files


if __name__ == "__main__":
    print(page(), end="")
