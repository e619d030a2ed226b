"""Pages and tables made from the code when the site is built: parameters, measures, methods.

`python experiments/generated_pages.py` prints the parameters. Functions named `on_...` are
hooks of MkDocs (`mkdocs.yml`). The changelog and the security page are those of the repository.
"""

import re
from pathlib import Path
from typing import Any

import jaxevent
from jaxevent.estimator import Estimator
from jaxevent.methods import METHOD_HOMES
from jaxevent.metrics import MEASURE_MEANINGS
from jaxevent.parameters import Choice, Parameters, UnitInterval, format_value
from jaxevent.show.tables import COLUMNS

ROOT = Path(__file__).parents[1]

TITLES = {"reconstruction": "Reconstruction", "blob": "Tracking", "egomotion": "Egomotion"}


def cell(value: Any) -> str:
    """Format a value as TOML."""
    return str(value).lower() if isinstance(value, bool) else format_value(value).replace("'", '"')


def rows(method: Estimator) -> list[str]:
    """Return a row for each setting of a method: name, default, unit, gradient, meaning."""
    kind = method.Params
    lines = ["| parameter | default | unit | gradient | |", "|---|---|---|---|---|"]
    fixed = {**kind.choices, **kind().names_without_gradient()}
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


def parameters_page() -> str:
    """Return the page of all parameters of all methods as Markdown."""
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


def measures_page() -> str:
    """Return the page of all measures as Markdown."""
    titles = {place: title for title, place, _, _ in COLUMNS}
    lines = [
        "# Measures",
        "",
        'Intensity is 0 at black and 1 at the frames\' white. A title with "x 1e-2" gives a number '
        "times 100. Names are those of `results.json` and `errors.json`.",
        "",
        "| name | column | meaning |",
        "|---|---|---|",
    ]
    for name, meaning in MEASURE_MEANINGS.items():
        text = meaning.replace("|", r"\|")
        lines.append(f"| `{name}` | {titles.get(name, '')} | {text} |")
    return "\n".join(lines) + "\n"


def methods_table(family: str) -> str:
    """Return a table of a family's methods, with links to their parameters."""
    lines = ["| method | | variance | gradient |", "|---|---|---|---|"]
    for name in METHOD_HOMES[family]:
        method = jaxevent.METHODS[name]
        about = ". ".join(re.split(r"(?<!al)\. ", method.about)[:2]).rstrip(".")
        yes = ["yes" if flag else "" for flag in (method.has_covariance, method.differentiable)]
        lines.append(f"| [`{name}`](../parameters.md#{name}) | {about} | {' | '.join(yes)} |")
    return "\n".join(lines)


def on_files(files: Any, config: Any) -> Any:
    """Add the pages to the files that MkDocs builds."""
    from mkdocs.structure.files import File

    pages = {
        "parameters.md": parameters_page(),
        "measures.md": measures_page(),
        "changelog.md": (ROOT / "CHANGELOG.md").read_text(),
        "security.md": (ROOT / "SECURITY.md").read_text(),
    }
    for name, content in pages.items():
        files.append(File.generated(config, name, content=content))
    return files


def on_page_markdown(markdown: str, **context: Any) -> str:
    """Fill in the tables of methods."""
    for family in METHOD_HOMES:
        markdown = markdown.replace(f"<!-- methods: {family} -->", methods_table(family))
    return markdown


def on_post_page(output: str, **context: Any) -> str:
    """Keep pages from asking GitHub for the number of stars, as the theme does otherwise."""
    return output.replace(' data-md-component="source"', "")


on_post_template = on_post_page  # of the page of missing pages


if __name__ == "__main__":
    print(parameters_page(), end="")
