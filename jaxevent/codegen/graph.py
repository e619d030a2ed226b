"""Scalar expressions of a traced function, as a graph of numbers, and their evaluation by NumPy.

A `Node` is one number. Equal nodes are the same object, so what is computed twice is computed once,
and what does not reach a result is never written. Constants are folded as they appear.

What depends on parameters alone is computed by NumPy, and again for others: XLA would compile a few
hundred operations on single numbers longer than they take.
"""

import dataclasses
import enum
import math
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr
from numpy.typing import NDArray

# Primitives that act element by element, by name.
ELEMENTWISE_FUNCTIONS: dict[str, Callable[..., Any]] = {
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
# Operations that are folded where all operands are constants.
FOLDABLE_FUNCTIONS: dict[str, Callable[..., Any]] = {
    **ELEMENTWISE_FUNCTIONS,
    "div": lambda a, b: np.float64(a) / b,
    "to_f": float,
    "to_i": int,
    "to_b": bool,
}

COMPARISON_NAMES = ("lt", "le", "gt", "ge", "eq", "ne")


class TranslationError(Exception):
    """A function uses something that has no translation; XLA compiles it instead."""


class Level(enum.IntEnum):
    """Time at which a number is known: the later, the more often it is computed."""

    CONSTANT = 0  # when the program is written
    HOST = 1  # with the parameters
    PIECE = 2  # when a piece begins, equal for all pixels
    TABLE = 3  # when a piece begins, for each pixel
    POINT = 4  # at an event or image
    ELEMENT = 5  # for each element of the axis that a loop passes over


@dataclasses.dataclass(frozen=True, eq=False)
class Node:
    """One number: an operation on others, or an input with a name.

    Attributes:
        op: Name of the primitive, or "input", "number", "entry".
        args: Other nodes, or what names the input.
        kind: "f", "i" or "b": a real number, an integer, a truth value.
        level: Time at which the number is known.
        number: Number in order of creation; arguments come before what uses them.
    """

    op: str
    args: tuple[Any, ...]
    kind: str
    level: Level
    number: int


class Graph:
    """Maker of nodes."""

    def __init__(self):
        self._known: dict[Any, Node] = {}

    def node(self, op: str, args: tuple[Any, ...], kind: str, level: Level) -> Node:
        """Return the node of an operation, always the same object.

        Args:
            op: Name of the operation.
            args: Nodes, and plain values.
            kind: Type of the result: "f", "i" or "b".
            level: What the result depends on.
        """
        key = (op, kind, level, *(a.number if isinstance(a, Node) else ("", a) for a in args))
        if key not in self._known:
            self._known[key] = Node(op, args, kind, level, len(self._known))
        return self._known[key]

    def input(self, name: str, kind: str, level: Level) -> Node:
        """Return the node of an input.

        Args:
            name: Name of the input.
            kind: Kind of number, as of `Node.kind`.
            level: Time at which it is known.

        Returns:
            The node.
        """
        return self.node("input", (name,), kind, level)

    def constant(self, value: Any) -> Node:
        """Return the node of a constant."""
        value = np.asarray(value)
        kind = {"f": "f", "i": "i", "u": "i", "b": "b"}.get(value.dtype.kind)
        if kind is None:
            raise TranslationError(f"numbers of type {value.dtype}")
        text = {"f": float, "i": int, "b": bool}[kind](value)
        return self.node("constant", (repr(text),), kind, Level.CONSTANT)

    def apply(self, op: str, args: tuple[Any, ...], kind: str) -> Node:
        """Apply an operation to nodes, and simplify it.

        Args:
            op: Name of the operation.
            args: Nodes, and plain values.
            kind: Type of the result: "f", "i" or "b".

        Returns:
            The node of the result.
        """
        simple = self._folded(op, args)
        if simple is not None:
            return simple
        level = max(a.level for a in args if isinstance(a, Node))
        return self.node(op, args, kind, level)

    def _folded(self, op: str, args: tuple[Any, ...]) -> Node | None:
        """Return an operation in simpler form, or None.

        Tables and parameters are taken to be finite.

        Args:
            op: Name of the operation.
            args: Its arguments.

        Returns:
            The simpler node; None: there is none.
        """
        value = [constant_value(a) for a in args]
        if op in FOLDABLE_FUNCTIONS and all(v is not None for v in value):
            with np.errstate(all="ignore"):
                return self.constant(FOLDABLE_FUNCTIONS[op](*value))
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
        if op in COMPARISON_NAMES:
            return self._compared(op, args, value[1])
        return None

    def _selected(self, which: Node, no: Node, yes: Node) -> Node | None:
        """Simplify `select_n`: a truth value as a number is known where it chooses.

        Args:
            which: Truth value.
            no: Result where it is false.
            yes: Result where it is true.

        Returns:
            The simpler node; None: there is none.
        """
        number = self._number_of(which)
        if number is not None and number in (no, yes):
            no = self.constant(0.0) if no is number else no
            yes = self.constant(1.0) if yes is number else yes
            return self.apply("select_n", (which, no, yes), yes.kind)
        if (constant_value(no), constant_value(yes), yes.kind) == (0, 1, "f"):
            return self.apply("to_f", (which,), "f")
        return no if no is yes else None

    def _compared(self, op: str, args: tuple[Any, ...], bound: Any) -> Node | None:
        """Simplify the comparison of a truth value as a number with a constant.

        Args:
            op: Name of the comparison.
            args: Its two arguments, of which the first may be such a number.
            bound: Value of the second one; None: it is no constant.

        Returns:
            The simpler node; None: there is none.
        """
        number = args[0]
        if bound is None or number.op != "to_f" or number.args[0].kind != "b":
            return None
        no, yes = (bool(FOLDABLE_FUNCTIONS[op](float(b), bound)) for b in (False, True))
        if no == yes:
            return self.constant(yes)
        return number.args[0] if yes else self.apply("not", (number.args[0],), "b")

    def _number_of(self, truth: Node) -> Node | None:
        """Return the node that makes a number of a truth value, if there is one."""
        return self._known.get(("to_f", "f", truth.level, truth.number))

    def assume_truth(self, results: dict[str, Node], truth: Node, value: bool) -> dict[str, Node]:
        """Simplify results where a truth value is known.

        Args:
            results: Results by name.
            truth: The truth value.
            value: Its value.

        Returns:
            The results, by name.
        """
        found = {truth: self.constant(value)}
        for node in find_dependencies([*results.values()], {truth}):
            if node not in found:
                args = tuple(found.get(a, a) if isinstance(a, Node) else a for a in node.args)
                found[node] = node if args == node.args else self.apply(node.op, args, node.kind)
        return {name: found[node] for name, node in results.items()}


def constant_value(node: Any) -> Any:
    """Return the value of a constant, or None for all other nodes."""
    if not isinstance(node, Node) or node.op != "constant":
        return None
    if node.kind == "f":
        return float(node.args[0])
    return {"True": True, "False": False}[node.args[0]] if node.kind == "b" else int(node.args[0])


def find_dependencies(results: list[Node], stop: set[Node] | None = None) -> list[Node]:
    """Return the nodes that results depend on, in order of creation.

    Args:
        results: The results, which are among the nodes.
        stop: Nodes whose arguments are not followed; None: there are none.

    Returns:
        The nodes.
    """
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


# Operations on arrays in place of numbers.
ARRAY_FUNCTIONS: dict[str, Callable[..., Any]] = {
    **ELEMENTWISE_FUNCTIONS,
    "div": np.divide,
    "select_n": lambda c, a, b: np.where(c, b, a),
    "to_f": lambda x: np.asarray(x, float),
    "to_i": lambda x: np.asarray(x).astype(int),
    "to_b": lambda x: np.asarray(x) != 0,
}


def evaluate_nodes(
    nodes: list[Node], read_input: Callable[[Any], Any], values: list[Any], dtype: np.dtype
) -> list[Any]:
    """Evaluate expressions for arrays in place of numbers.

    Args:
        nodes: The expressions.
        read_input: Returns the array of an input by its name, or of a slot by its number.
        values: Values of the `ParameterProgram`.
        dtype: Kind of real numbers.

    Returns:
        An array for each expression.
    """
    found: dict[Node, Any] = {}
    with np.errstate(all="ignore"):
        for node in find_dependencies(nodes):
            if node.op == "constant":
                value = constant_value(node)
            elif node.op in ("input", "slot"):
                value = read_input(node.args[0])
            elif node.op == "number":
                value = np.ravel(values[node.args[0]])[node.args[1]]
            elif node.op == "entry":
                array = values[node.args[0]]
                value = array[np.clip(found[node.args[1]], 0, len(array) - 1)]
            else:
                value = ARRAY_FUNCTIONS[node.op](*(found[a] for a in node.args))
            found[node] = np.asarray(value, dtype) if node.kind == "f" else np.asarray(value)
    return [found[node] for node in nodes]


JAXPR_PARAMETERS = ("jaxpr", "call_jaxpr", "fun_jaxpr")


def called_jaxpr(eqn: Any) -> Any | None:
    """Return the closed jaxpr that an equation only calls; None where it does more."""
    if eqn.primitive.name in ("scan", "while", "cond"):
        return None
    for name in JAXPR_PARAMETERS:
        if name in eqn.params:
            called = eqn.params[name]
            return called if hasattr(called, "consts") else ClosedJaxpr(called, [])
    return None


def move_elements(eqn: Any, values: list[Any]) -> NDArray | None:
    """Evaluate a primitive that only moves elements, whatever their kind.

    Args:
        eqn: Equation of a jaxpr.
        values: Its arguments: arrays of any kind, and indices that are known numbers.

    Returns:
        The result; None for other primitives.
    """
    name, p = eqn.primitive.name, eqn.params
    x = np.asarray(values[0]) if values else None
    if name == "iota":
        shape = [1] * len(p["shape"])
        shape[p["dimension"]] = -1
        count = np.arange(p["shape"][p["dimension"]], dtype=p["dtype"])
        return np.broadcast_to(count.reshape(shape), p["shape"])
    if x is None:
        return None
    if name == "broadcast_in_dim":
        shape = [1] * len(p["shape"])
        for axis, size in zip(p["broadcast_dimensions"], x.shape, strict=True):
            shape[axis] = size
        return np.broadcast_to(x.reshape(shape), p["shape"])
    if name == "reshape":
        return x.reshape(p["new_sizes"])
    if name in ("squeeze", "expand_dims"):
        return x.reshape(eqn.outvars[0].aval.shape)
    if name == "transpose":
        return x.transpose(p["permutation"])
    if name == "rev":
        return np.flip(x, p["dimensions"])
    if name == "slice":
        steps = p["strides"] or [1] * x.ndim
        bounds = zip(p["start_indices"], p["limit_indices"], steps, strict=True)
        return x[tuple(slice(*bound) for bound in bounds)]
    if name == "concatenate":
        return np.concatenate([np.asarray(v) for v in values], p["dimension"])
    if name == "stack":
        return np.stack([np.asarray(v) for v in values], p["axis"])
    if name == "pad" and all(size >= 0 for sizes in p["padding_config"] for size in sizes):
        out = np.full(eqn.outvars[0].aval.shape, np.asarray(values[1]).item(), x.dtype)
        steps = zip(p["padding_config"], x.shape, strict=True)
        within = (slice(low, low + n + max(n - 1, 0) * gap, gap + 1) for (low, _, gap), n in steps)
        out[tuple(within)] = x
        return out
    if name == "dynamic_slice":
        starts = [
            int(np.clip(int(start), 0, n - size))
            for start, n, size in zip(values[1:], x.shape, p["slice_sizes"], strict=True)
        ]
        return x[tuple(slice(s, s + n) for s, n in zip(starts, p["slice_sizes"], strict=True))]
    if name == "gather":
        return _gather(eqn, x, np.asarray(values[1]))
    return None


def _gather(eqn: Any, x: NDArray, indices: NDArray) -> NDArray:
    """Evaluate the primitive gather, without batch dimensions.

    Args:
        eqn: Equation of a jaxpr.
        x: Array of any kind.
        indices: (..., axes) indices of the first elements of slices.

    Returns:
        The slices.

    Raises:
        TranslationError: There are batch dimensions.
    """
    numbers, sizes = eqn.params["dimension_numbers"], eqn.params["slice_sizes"]
    if numbers.operand_batching_dims or numbers.start_indices_batching_dims:
        raise TranslationError("a gather with batch dimensions")
    batch = indices.shape[:-1]
    kept = [size for axis, size in enumerate(sizes) if axis not in numbers.collapsed_slice_dims]
    start = [np.zeros(batch, np.int64)] * x.ndim
    for axis, values in zip(numbers.start_index_map, np.moveaxis(indices, -1, 0), strict=True):
        start[axis] = np.clip(values.astype(np.int64), 0, x.shape[axis] - sizes[axis])
    within = np.ogrid[tuple(slice(size) for size in sizes)]
    along = tuple(s.reshape(*batch, *[1] * x.ndim) + w for s, w in zip(start, within, strict=True))
    out = x[along].reshape(*batch, *kept)
    axes = list(range(len(batch), out.ndim))
    order = [0] * out.ndim
    at_offset, rest = iter(axes), iter(range(len(batch)))
    for axis in range(out.ndim):
        order[axis] = next(at_offset) if axis in numbers.offset_dims else next(rest)
    return out.transpose(order)


def evaluate_equation(eqn: Any, values: list[NDArray]) -> list[NDArray]:
    """Evaluate an equation of a jaxpr by NumPy, or by JAX where NumPy has no such function.

    Args:
        eqn: The equation.
        values: Arrays for its arguments.

    Returns:
        Arrays for its results.
    """
    name = eqn.primitive.name
    known = ELEMENTWISE_FUNCTIONS.get(name)
    called = called_jaxpr(eqn) if known is None else None
    if called is not None:
        return evaluate_jaxpr(called, values)
    if name == "scan":
        return _scan(eqn, values)
    with np.errstate(all="ignore"):
        made = move_elements(eqn, values) if known is None else known(*values)
        if made is None and name == "div":
            whole = np.asarray(values[0]).dtype.kind in "iu"
            made = values[0] // values[1] if whole else values[0] / values[1]
        elif made is None and name == "integer_pow":
            made = np.power(np.asarray(values[0]), float(eqn.params["y"]))
        elif made is None and name == "select_n" and len(values) == 3:
            made = np.where(values[0], values[2], values[1])
        elif made is None and name == "convert_element_type":
            made = np.asarray(values[0]).astype(eqn.params["new_dtype"])
    if made is None:
        with jax.ensure_compile_time_eval():  # not as part of a program that is traced meanwhile
            made = eqn.primitive.bind(*values, **eqn.params)
        many = made if eqn.primitive.multiple_results else [made]
        return [np.asarray(v) for v in many]
    return [np.asarray(made, eqn.outvars[0].aval.dtype)]


def evaluate_jaxpr(closed_jaxpr: Any, values: list[NDArray]) -> list[NDArray]:
    """Evaluate a closed jaxpr equation by equation.

    Args:
        closed_jaxpr: The jaxpr.
        values: Arrays for its arguments.

    Returns:
        Arrays for its results.
    """
    known: dict[Any, NDArray] = dict(zip(closed_jaxpr.jaxpr.invars, values, strict=True))
    known |= dict(
        zip(closed_jaxpr.jaxpr.constvars, map(np.asarray, closed_jaxpr.consts), strict=True)
    )

    def of(atom: Any) -> NDArray:
        return np.asarray(atom.val) if hasattr(atom, "val") else known[atom]

    for eqn in closed_jaxpr.jaxpr.eqns:
        made = evaluate_equation(eqn, [of(a) for a in eqn.invars])
        known |= dict(zip(eqn.outvars, made, strict=True))
    return [of(a) for a in closed_jaxpr.jaxpr.outvars]


def evaluate_function(function: Callable[..., Any], *arrays: NDArray) -> NDArray:
    """Evaluate a function of arrays that returns one array; JAX traces it, and compiles nothing."""
    closed = jax.make_jaxpr(function)(*arrays)
    given = [np.asarray(a, v.aval.dtype) for a, v in zip(arrays, closed.jaxpr.invars, strict=True)]
    (made,) = evaluate_jaxpr(closed, given)
    return made


def _scan(eqn: Any, values: list[NDArray]) -> list[NDArray]:
    """Evaluate a scan step by step.

    By JAX where the steps take slices, or their results are stacked.

    Args:
        eqn: Equation of a jaxpr, a scan.
        values: Its inputs.

    Returns:
        Its outputs.
    """
    p = eqn.params
    body = p["jaxpr"].jaxpr
    ends = zip([*eqn.invars, *eqn.outvars], [*body.invars, *body.outvars], strict=True)
    if any(whole.aval.ndim != part.aval.ndim for whole, part in ends):
        with jax.ensure_compile_time_eval():
            made = eqn.primitive.bind(*values, **p)
        return [np.asarray(v) for v in made]
    fixed = len(values) - len(eqn.outvars)
    carry = values[fixed:]
    for _ in range(p["length"]):
        carry = evaluate_jaxpr(p["jaxpr"], [*values[:fixed], *carry])
    return carry


@dataclasses.dataclass
class ParameterProgram:
    """Numbers that are known with the parameters.

    Attributes:
        values: Their values: of the inputs, then of the results of equations.
        n_inputs: Number of inputs.
        steps: Equations, each with its arguments and the indices of its results.
        conditions: Indices of truth values that chose a branch.
        zeros: Elements whose values must be 0, by index.
        _known: Indices of the results of equations, by these and their arguments.
    """

    values: list[NDArray] = dataclasses.field(default_factory=list)
    n_inputs: int = 0
    steps: list[tuple[Any, list[Any], list[int]]] = dataclasses.field(default_factory=list)
    conditions: list[int] = dataclasses.field(default_factory=list)
    zeros: dict[int, NDArray] = dataclasses.field(default_factory=dict)
    _known: dict[Any, list[int]] = dataclasses.field(default_factory=dict)

    def add_input(self, value: NDArray) -> int:
        """Add an input, and return its number among the values."""
        assert not self.steps
        self.values.append(np.asarray(value))
        self.n_inputs += 1
        return len(self.values) - 1

    def add(self, eqn: Any, arguments: list[Any]) -> list[int]:
        """Add an equation, unless an equal one was added before.

        Args:
            eqn: Equation of a jaxpr.
            arguments: Numbers of values (int), or arrays.

        Returns:
            The numbers of its results among the values.
        """
        what = eqn.primitive.name, str(eqn.params)
        key = (what, *(a if isinstance(a, int) else (a.tobytes(), a.shape) for a in arguments))
        if key in self._known:
            return self._known[key]
        made = evaluate_equation(
            eqn, [self.values[a] if isinstance(a, int) else a for a in arguments]
        )
        first = len(self.values)
        self.values += made
        numbers = list(range(first, first + len(made)))
        self.steps.append((eqn, arguments, numbers))
        self._known[key] = numbers
        return numbers

    def evaluate(self, inputs: list[NDArray]) -> list[NDArray] | None:
        """Compute all values for other inputs; return None where a condition is another."""
        values: list[NDArray] = [*inputs]
        for eqn, arguments, _ in self.steps:
            values += evaluate_equation(
                eqn, [values[a] if isinstance(a, int) else a for a in arguments]
            )
        same = all(np.array_equal(values[n], self.values[n]) for n in self.conditions)
        same = same and all(np.array_equal(values[n] == 0, z) for n, z in self.zeros.items())
        return values if same else None
