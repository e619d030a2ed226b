"""Print docs/parameters.md, the table of all parameters: python experiments/parameters.py"""

from collections.abc import Iterable

import jaxevent
from jaxevent.methods import names
from jaxevent.parameters import Choice, Number, Parameters


def rows(kinds: Iterable[type[Parameters]]) -> list[str]:
    """One row for each parameter of some classes: name, default or options, unit, meaning."""
    numbers: dict[str, Number] = {}
    choices = {}
    for kind in kinds:
        numbers |= kind.numbers
        choices |= kind.choices
    lines = ["| parameter | default | unit | |", "|---|---|---|---|"]
    for name, number in numbers.items():
        default = number.default if isinstance(number.default, tuple) else (number.default,)
        text = ", ".join(f"{value:.4g}" for value in default)
        lines.append(f"| `{name}` | {text} | {number.unit} | {number.meaning} |")
    for name, choice in choices.items():
        if isinstance(choice, Choice):
            options = " or ".join(str(option).lower() for option in choice.options)
            lines.append(f"| `{name}` | {options} | | {choice.meaning} |")
        else:
            lines.append(f"| `{name}` | {choice.default} | {choice.unit} | {choice.meaning} |")
    return lines


def page() -> str:
    methods = (jaxevent.METHODS[name].Params for name in names("reconstruction"))
    trackers = [jaxevent.METHODS[name].Params for name in names("blob")]
    parts = [
        "# Parameters",
        "Made by `python experiments/parameters.py`. Of several options the first is the default. "
        "Numbers with a gradient can be named under `fit` in a fit's configuration.",
        "## Reconstruction",
        "A method has those of them that it uses: `jaxevent.akf.Params.numbers`, `.choices`. "
        "Presets of `akf`: `paper`, `hdr`; of `aks`: `hdr`.",
        "\n".join(rows(methods)),
        "## Blob tracking",
        "A tracker has those of them that it uses: `jaxevent.blob.moment.Params.numbers`, "
        "`.choices`. Presets: `slow`, `fast`, `ttc`; of `chi2` also `authors`.",
        "\n".join(rows(trackers)),
        "## Egomotion",
        "Each method of `jaxevent.METHODS` for egomotion has its own `Params`.",
    ]
    for name in names("egomotion"):
        parts += [f"### {name}", "\n".join(rows([jaxevent.METHODS[name].Params]))]
    return "\n\n".join(parts) + "\n"


if __name__ == "__main__":
    print(page(), end="")
