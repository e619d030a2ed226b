"""Tables as TOML, with all digits."""

import json
import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from jaxevent.parameters import Parameters


def parameters(params: Parameters) -> str:
    """Format parameters as lines `name = value` of physical values."""
    lines = []
    for name, value in params.values().items():
        if name in params.numbers:
            digits = np.asarray(getattr(params, name))
            value = np.array([float(str(n)) for n in digits.ravel()]).reshape(digits.shape).tolist()
        lines.append(f"{key(name)} = {text(value)}")
    return "\n".join(lines)


def dump(table: Mapping[str, Any]) -> str:
    """Format a configuration as TOML."""
    lines = [f"{key(k)} = {text(v)}" for k, v in table.items() if k != "method"]
    for entry in table.get("method", []):
        lines += ["", "[[method]]", *(f"{key(k)} = {text(v)}" for k, v in entry.items())]
    return "\n".join(lines) + "\n"


def key(name: str) -> str:
    """Format a key."""
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else text(name)


def text(value: Any) -> str:
    """Format a value."""
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{key(k)} = {text(v)}" for k, v in value.items()) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(map(text, value)) + "]"
    # JSON's text and numbers are TOML's, but for NaN and infinity, characters beyond 16 bits, which
    # JSON escapes as two halves, and DEL, which it does not escape.
    if isinstance(value, float):
        return repr(value)
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
