"""Expressions as lines of Python that numba compiles."""

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxevent.kernels.expressions import Node, Untranslatable, needed

INFIX = {
    "add": "+", "sub": "-", "mul": "*", "div": "/", "lt": "<", "le": "<=", "gt": ">", "ge": ">=",
    "eq": "==", "ne": "!=", "and": "&", "or": "|",
}  # fmt: skip
FORMS = {
    "neg": "-{0}",
    "not": "(not {0})",
    "max": "{0} if {0} > {1} else {1}",
    "min": "{0} if {0} < {1} else {1}",
    "select_n": "{2} if {0} else {1}",
    "to_f": "REAL(1) if {0} else REAL(0)",
    "to_i": "int({0})",
    "to_b": "{0} != 0",
    "pow": "{0} ** {1}",
    "rem": "np.fmod({0}, {1})",
    "rsqrt": "REAL(1) / np.sqrt({0})",
    "is_finite": "np.isfinite({0})",
    "sign": "np.sign({0})",
    "round": "np.rint({0})",
    "atan2": "np.arctan2({0}, {1})",
}
FUNCTIONS = ("exp", "log", "log1p", "logistic", "sin", "cos")  # of `numeric`, or the header
LIBRARY = ("expm1", "sqrt", "tanh", "floor", "ceil", "abs")


@dataclasses.dataclass(frozen=True)
class Numbers:
    """Where a text's numbers of parameters come from."""

    single: list[tuple[int, int]]  # value of the host program, and place in it
    arrays: list[tuple[int, int]]  # arrays that are looked up: value, and where it begins
    size: int

    def of(self, values: list[NDArray], dtype: np.dtype) -> NDArray:
        """The numbers that the text's functions take, from the values of a host program."""
        out = np.zeros(self.size, dtype)
        out[: len(self.single)] = [np.ravel(values[n])[k] for n, k in self.single]
        for n, at in self.arrays:
            out[at : at + len(values[n])] = values[n]
        return out


class Writer:
    """Writes expressions. Families say where their inputs are (`input`, `special`)."""

    def __init__(self):
        self.constants: dict[str, str] = {}
        self.numbers: dict[tuple[int, int], int] = {}  # place of numbers of the host program
        self.entries: dict[int, str] = {}  # names of the arrays that are looked up
        self.arrays: list[tuple[int, int]] = []  # the numbers in order of their places

    def input(self, node: Node) -> str:
        raise Untranslatable(f"the use of {node.args[0]!r}")

    def special(self, node: Node) -> str | None:
        """The text of an operation that is a family's own."""
        return None

    def lines(self, nodes: list[Node], indent: int, stop: set[Node] | None = None) -> list[str]:
        """Assignments to a variable for each node that the nodes rest on."""
        out = []
        for node in needed(nodes, stop):
            if node.op != "constant":
                out.append(f"{' ' * indent}{self.name(node)} = {self._expression(node)}")
        return out

    def name(self, node: Node) -> str:
        if node.op != "constant":
            return f"v{node.number}"
        text = node.args[0]
        if node.kind != "f":
            return text
        if text not in self.constants:
            self.constants[text] = f"K{len(self.constants)}"
        return self.constants[text]

    def finish(self, values: list[Any]) -> tuple[Numbers, list[str]]:
        """What the numbers are, and the constants' lines."""
        lines = [f"{name} = REAL({_literal(text)})" for text, name in self.constants.items()]
        at, arrays = len(self.arrays), []
        for array, name in self.entries.items():
            arrays.append((array, at))
            lines.append(f"{name} = {at}, {len(values[array]) - 1}")
            at += len(values[array])
        return Numbers(self.arrays, arrays, at), lines

    def _expression(self, node: Node) -> str:
        op, own = node.op, self.special(node)
        if own is not None:
            return own
        if op == "input":
            return self.input(node)
        if op == "number":
            return self._number(node.args, node.kind)
        if op == "entry":
            return self._entry(node)
        names = [self.name(a) for a in node.args]
        if op in INFIX:
            return f"{names[0]} {INFIX[op]} {names[1]}"
        if op == "to_f" and node.args[0].kind == "i":
            return f"REAL({names[0]})"
        if op in FORMS:
            return FORMS[op].format(*names)
        if op in FUNCTIONS:
            return f"{op}({names[0]})"
        if op in LIBRARY:
            return f"np.{op}({names[0]})"
        raise Untranslatable(f"the operation {op!r}")

    def _number(self, key: tuple[int, int], kind: str) -> str:
        if key not in self.numbers:
            self.numbers[key] = len(self.arrays)
            self.arrays.append(key)
        text = f"numbers[{self.numbers[key]}]"
        return f"int({text})" if kind == "i" else text

    def _entry(self, node: Node) -> str:
        array, index = node.args
        if array not in self.entries:
            self.entries[array] = f"ENTRIES{len(self.entries)}"
        name, at = self.entries[array], self.name(index)
        return f"numbers[{name}[0] + min(max({at}, 0), {name}[1])]"


def _literal(text: str) -> str:
    return text if text not in ("inf", "-inf", "nan") else f"float('{text}')"
