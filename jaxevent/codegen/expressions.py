"""Scalar expressions: what a traced function computes for one pixel, as a graph of numbers.

A `Node` is one number. Equal nodes are the same object, so what is computed twice is computed once,
and what does not reach a result is never written. Constants are folded as they appear.
"""

import dataclasses
import enum
import math
from collections.abc import Callable
from typing import Any

import numpy as np

# What a primitive computes, by its name: of any arrays, element by element.
ELEMENTWISE: dict[str, Callable[..., Any]] = {
    "add": np.add,
    "add_any": np.add,
    "sub": np.subtract,
    "mul": np.multiply,
    "max": np.maximum,
    "min": np.minimum,
    "pow": np.power,
    "rem": np.fmod,
    "neg": np.negative,
    "abs": np.abs,
    "sign": np.sign,
    "exp": np.exp,
    "log": np.log,
    "log1p": np.log1p,
    "expm1": np.expm1,
    "sqrt": np.sqrt,
    "rsqrt": lambda x: 1 / np.sqrt(x),
    "logistic": lambda x: 1 / (1 + np.exp(-x)),
    "tanh": np.tanh,
    "sin": np.sin,
    "cos": np.cos,
    "erf": np.vectorize(math.erf, otypes=[float]),
    "erfc": np.vectorize(math.erfc, otypes=[float]),
    "floor": np.floor,
    "ceil": np.ceil,
    "round": np.rint,
    "atan2": np.arctan2,
    "square": np.square,
    "is_finite": np.isfinite,
    "lt": np.less,
    "le": np.less_equal,
    "gt": np.greater,
    "ge": np.greater_equal,
    "eq": np.equal,
    "ne": np.not_equal,
    "lt_to": np.less,
    "le_to": np.less_equal,
    "and": np.logical_and,
    "or": np.logical_or,
    "not": np.logical_not,
    "stop_gradient": lambda x: x,
    "copy": lambda x: x,
    "copy_p": lambda x: x,
}
# Of what is made of constants alone.
COMPUTED: dict[str, Callable[..., Any]] = {
    **ELEMENTWISE,
    "div": lambda a, b: np.float64(a) / b,
    "to_f": float,
    "to_i": int,
    "to_b": bool,
}

COMPARED = ("lt", "le", "gt", "ge", "eq", "ne")


class Untranslatable(Exception):
    """A function uses what there is no translation for; the scan serves it."""


class Level(enum.IntEnum):
    """When a number is known: the later, the more often it is computed."""

    CONSTANT = 0  # when the program is written
    HOST = 1  # with the parameters
    PIECE = 2  # when a piece begins, equal for all pixels
    TABLE = 3  # when a piece begins, for each pixel
    POINT = 4  # at an event or image
    ELEMENT = 5  # for each element of the axis that a loop passes over


@dataclasses.dataclass(frozen=True, eq=False)
class Node:
    """One number: an operation on others, or an input with a name."""

    op: str  # the primitive's name, or "input", "number", "entry"
    args: tuple[Any, ...]
    kind: str  # "f", "i" or "b": a real number, an integer, a truth value
    level: Level
    number: int  # in order of creation; arguments come before what uses them


class Graph:
    """Makes nodes."""

    def __init__(self):
        self._known: dict[Any, Node] = {}

    def node(self, op: str, args: tuple[Any, ...], kind: str, level: Level) -> Node:
        key = (op, kind, level, *(a.number if isinstance(a, Node) else ("", a) for a in args))
        if key not in self._known:
            self._known[key] = Node(op, args, kind, level, len(self._known))
        return self._known[key]

    def input(self, name: str, kind: str, level: Level) -> Node:
        return self.node("input", (name,), kind, level)

    def constant(self, value: Any) -> Node:
        value = np.asarray(value)
        kind = {"f": "f", "i": "i", "u": "i", "b": "b"}.get(value.dtype.kind)
        if kind is None:
            raise Untranslatable(f"numbers of type {value.dtype}")
        text = {"f": float, "i": int, "b": bool}[kind](value)
        return self.node("constant", (repr(text),), kind, Level.CONSTANT)

    def apply(self, op: str, args: tuple[Any, ...], kind: str) -> Node:
        """An operation on nodes; further arguments are plain values."""
        simple = self._folded(op, args)
        if simple is not None:
            return simple
        level = max(a.level for a in args if isinstance(a, Node))
        return self.node(op, args, kind, level)

    def _folded(self, op: str, args: tuple[Any, ...]) -> Node | None:
        """The same in simpler form. Tables and parameters are taken to be finite."""
        value = [value_of(a) for a in args]
        if op in COMPUTED and all(v is not None for v in value):
            with np.errstate(all="ignore"):
                return self.constant(COMPUTED[op](*value))
        if op == "mul":
            for k in (0, 1):
                if value[k] == 1:
                    return args[1 - k]
                if value[k] == 0:
                    return args[k]
        if op == "add":
            for k in (0, 1):
                if value[k] == 0:
                    return args[1 - k]
        if op == "sub":
            if value[1] == 0:
                return args[0]
            if args[0] is args[1] and args[0].level <= Level.TABLE:
                return self.constant(0.0 if args[0].kind == "f" else 0)
        if op == "div" and (value[1] == 1 or value[0] == 0):
            return args[0]
        if op in ("and", "or"):
            for k in (0, 1):
                if value[k] is not None:
                    return args[1 - k] if value[k] == (op == "and") else args[k]
        if op == "select_n":
            if value[0] is not None:
                return args[1 + int(value[0])]
            return self._selected(*args)
        if op in COMPARED:
            return self._compared(op, args, value[1])
        return None

    def _selected(self, which: Node, no: Node, yes: Node) -> Node | None:
        """`select_n` in simpler form: a truth value as a number is known where it chooses."""
        number = self._number_of(which)
        if number is not None and number in (no, yes):
            no = self.constant(0.0) if no is number else no
            yes = self.constant(1.0) if yes is number else yes
            return self.apply("select_n", (which, no, yes), yes.kind)
        if (value_of(no), value_of(yes), yes.kind) == (0, 1, "f"):
            return self.apply("to_f", (which,), "f")
        return no if no is yes else None

    def _compared(self, op: str, args: tuple[Any, ...], bound: Any) -> Node | None:
        """A truth value as a number, compared with a constant: itself, or a constant."""
        number = args[0]
        if bound is None or number.op != "to_f" or number.args[0].kind != "b":
            return None
        no, yes = (bool(COMPUTED[op](float(b), bound)) for b in (False, True))
        if no == yes:
            return self.constant(yes)
        return number.args[0] if yes else self.apply("not", (number.args[0],), "b")

    def _number_of(self, truth: Node) -> Node | None:
        """The node that makes a number of a truth value, if there is one."""
        return self._known.get(("to_f", "f", truth.level, truth.number))

    def suppose(self, results: dict[str, Node], truth: Node, value: bool) -> dict[str, Node]:
        """The results where a truth value is known."""
        found = {truth: self.constant(value)}
        for node in needed([*results.values()], {truth}):
            if node not in found:
                args = tuple(found.get(a, a) if isinstance(a, Node) else a for a in node.args)
                found[node] = node if args == node.args else self.apply(node.op, args, node.kind)
        return {name: found[node] for name, node in results.items()}


def value_of(node: Any) -> Any:
    """The value of a constant, None of all others."""
    if not isinstance(node, Node) or node.op != "constant":
        return None
    if node.kind == "f":
        return float(node.args[0])
    return {"True": True, "False": False}[node.args[0]] if node.kind == "b" else int(node.args[0])


def needed(results: list[Node], stop: set[Node] | None = None) -> list[Node]:
    """The nodes that the results rest on, in order; `stop`: known, not looked behind."""
    found: dict[int, Node] = {}
    waiting = list(results)
    while waiting:
        node = waiting.pop()
        if node.number in found:
            continue
        found[node.number] = node
        if stop is None or node not in stop:
            waiting += [a for a in node.args if isinstance(a, Node)]
    return [found[number] for number in sorted(found)]
