"""Imports go one way, those that are written as text too."""

import ast
import re
import subprocess
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]
CONTRACTS = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]
LAYERS = [
    {name.strip() for name in layer.split("|")}
    for layer in next(one for one in CONTRACTS["contracts"] if one["type"] == "layers")["layers"]
]
RANK = {name: rank for rank, layer in enumerate(LAYERS) for name in layer}
# The ways up: the package's face, which nothing in the package uses, and the table of old names,
# which is read for users alone.
WAYS_UP = {ROOT / "jaxevent" / name for name in ("__init__.py", "deprecated.py")}


def test_contracts_are_kept():
    lint = [Path(sys.executable).with_name("lint-imports"), "--no-cache"]
    done = subprocess.run(lint, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout


def named_modules(tree: ast.AST) -> list[str]:
    """Modules of the package that are named in strings, as "jaxevent.io.text:read"."""
    strings = [n.value for n in ast.walk(tree) if isinstance(n, ast.Constant)]
    found = [re.fullmatch(r"(jaxevent(?:\.\w+)+)(?::\w+)?", s) for s in strings if type(s) is str]
    return [match[1] for match in found if match]


def test_names_in_strings_go_the_same_way():
    seen = 0
    for path in (ROOT / "jaxevent").rglob("*.py"):
        if path in WAYS_UP:
            continue
        here = path.relative_to(ROOT / "jaxevent").parts[0].removesuffix(".py")
        for module in named_modules(ast.parse(path.read_text())):
            there, seen = module.split(".")[1], seen + 1
            assert here == there or RANK[here] < RANK[there], (path, module)
    assert seen > 15


def test_every_module_of_the_package_has_its_place():
    tops = {p.name.removesuffix(".py") for p in (ROOT / "jaxevent").iterdir()}
    tops -= {"__init__", "__pycache__", "data", "py.typed"}
    assert tops == set(RANK)
