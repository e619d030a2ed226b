"""Expressions as lines of Python that numba compiles; arithmetic in blocks (`blocks`)."""

import dataclasses
import re
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxevent.codegen.blocks import OPERATIONS
from jaxevent.codegen.expressions import Node, Untranslatable, needed

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
FUNCTIONS = (
    "exp",
    "log",
    "log1p",
    "logistic",
    "sin",
    "cos",
    "erf",
    "erfc",
)  # of `numeric`, or the header
LIBRARY = ("expm1", "sqrt", "tanh", "floor", "ceil", "abs")
LEAST = 3  # operations that are worth a block
Place = tuple[str, str, int]  # pointer, index and offset: pointer[index + offset]


def import_functions(dtype: np.dtype) -> str:
    """The line that imports `FUNCTIONS` of a kind of number."""
    names = ", ".join(f"{name}{8 * dtype.itemsize} as {name}" for name in FUNCTIONS)
    return f"from jaxevent.codegen.numeric import {names}"


TABLES = re.compile(r"ENTRIES\d+")


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
    """Writes expressions. Families say where their inputs are (`place`, `input`)."""

    def __init__(self):
        self.constants: dict[str, str] = {}
        self.numbers: dict[tuple[int, int], int] = {}  # place of numbers of the host program
        self.entries: dict[int, str] = {}  # names of the arrays that are looked up
        self.arrays: list[tuple[int, int]] = []  # the numbers in order of their places
        self.blocks: list[str] = []  # their definitions, but for where tables begin

    def place(self, node: Node) -> Place | None:
        """Where a number lies that is read."""
        return None

    def input(self, node: Node) -> str:
        """The text of an input that has no such place."""
        raise Untranslatable(f"the use of {node.args[0]!r}")

    def lines(self, nodes: list[Node], indent: int, stop: set[Node] | None = None) -> list[str]:
        """Lines after which the nodes are known by their names; those of `stop` are already."""
        known = set() if stop is None else stop
        return self.assign([n for n in needed(nodes, stop) if n not in known], nodes, indent)

    def assign(self, nodes: Iterable[Node], wanted: Iterable[Node], indent: int) -> list[str]:
        """Lines that compute the nodes, all of which the wanted ones rest on that is not known.

        What is no plain arithmetic, such as a logarithm, is a line of its own between two blocks.
        """
        order = sorted((n for n in nodes if n.op != "constant"), key=lambda n: n.number)
        wanted = set(wanted)
        turn: dict[Node, int] = {}  # of lines, and of the block after them
        for node in order:
            before = [turn.get(a, 0) for a in node.args if isinstance(a, Node)]
            turn[node] = max(before, default=0) + (bool(before) and not self._in_block(node))
        last, out = max(turn.values(), default=0), []
        for now in range(last + 1):
            mine = [n for n in order if turn[n] == now]
            inside = [n for n in mine if self._in_block(n)]
            out += [self._line(n) for n in mine if not self._in_block(n)]
            later = {a for n in order if turn[n] > now for a in n.args if isinstance(a, Node)}
            found = [n for n in inside if n in later or n in wanted]
            if len(inside) < LEAST:
                out += [self._line(n) for n in inside]
            else:
                out.append(self._block(inside, found))
        return [f"{' ' * indent}{line}" for line in out]

    def _in_block(self, node: Node) -> bool:
        if node.op in ("number", "entry"):
            return True
        if self.place(node) is not None:
            return True
        of = [a for a in node.args if isinstance(a, Node)]
        return bool(of) and node.op in OPERATIONS[of[0].kind]

    def _line(self, node: Node) -> str:
        return f"{self.name(node)} = {self._expression(node)}"

    def _block(self, nodes: list[Node], results: list[Node]) -> str:
        """The line that calls the block of these nodes, which is written."""
        made, given, lines = set(nodes), dict[str, str](), []
        for node in nodes:
            what, place = [node.op], self.place(node)
            if place is not None:
                what = ["read", *map(str, place)]
                given |= {place[0]: "p", place[1]: "i"}
            elif node.op in ("number", "entry"):
                given["numbers"] = "p"
                number = node.op == "number"
                what.append(str(self._at(node.args)) if number else self._table(node.args[0]))
            if node.op != "number":
                for a in (a for a in node.args if isinstance(a, Node)):
                    constant = a.op == "constant"
                    what.append(f"{a.kind}:{a.args[0]}" if constant else self.name(a))
                    if a not in made and not constant:
                        given[self.name(a)] = a.kind
            lines.append(f"{self.name(node)}:{node.kind} = {' '.join(what)}")
        name, names = f"block{len(self.blocks)}", [self.name(n) for n in results]
        of = " ".join(f"{argument}:{kind}" for argument, kind in given.items())
        text = "\n".join(lines)
        self.blocks.append(f'{name} = block(F, "{of}", """\n{text}\n""", "{" ".join(names)}")')
        return f"{', '.join(names)} = {name}(({', '.join(given)},))"

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
        """What the numbers are, and the lines of constants and blocks."""
        lines = [f"{name} = REAL({_literal(text)})" for text, name in self.constants.items()]
        at, arrays, begins = len(self.arrays), [], dict[str, str]()
        for array, name in self.entries.items():
            arrays.append((array, at))
            lines.append(f"{name} = {at}, {len(values[array]) - 1}")
            begins[name] = f"{at} {len(values[array]) - 1}"
            at += len(values[array])
        lines += [TABLES.sub(lambda found: begins[found[0]], text) for text in self.blocks]
        return Numbers(self.arrays, arrays, at), lines

    def _expression(self, node: Node) -> str:
        op, place = node.op, self.place(node)
        if place is not None:
            text = f"{place[0]}[{place[1]} + {place[2]}]"
            return f"{text} != 0" if node.kind == "b" else text
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

    def _at(self, key: tuple[int, int]) -> int:
        """Where a number of the host program is among the kernel's."""
        if key not in self.numbers:
            self.numbers[key] = len(self.arrays)
            self.arrays.append(key)
        return self.numbers[key]

    def _table(self, array: int) -> str:
        """The name of where an array begins that is looked up, and of its last place."""
        return self.entries.setdefault(array, f"ENTRIES{len(self.entries)}")

    def _number(self, key: tuple[int, int], kind: str) -> str:
        text = f"numbers[{self._at(key)}]"
        return f"int({text})" if kind == "i" else text

    def _entry(self, node: Node) -> str:
        name, at = self._table(node.args[0]), self.name(node.args[1])
        return f"numbers[{name}[0] + min(max({at}, 0), {name}[1])]"


def _literal(text: str) -> str:
    return text if text not in ("inf", "-inf", "nan") else f"float('{text}')"
