"""Forward derivatives along several directions in the parameters, side by side.

JAX's forward mode makes a function of a function that is linear in the changes of the arguments.
The factor of each change in a result is found by going through the expressions backwards, once for
all directions. What is left for each direction is a sum of products, for all of them at once: the
change of a state is a sum of changes of the state before, of what the frames say, and of numbers,
each times a factor that is the same for all directions.
"""

import dataclasses
import functools
import re
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxevent.codegen.functions import make_intrinsic
from jaxevent.codegen.graph import Graph, Node, TranslationError, constant_value, find_dependencies
from jaxevent.codegen.support import ir, types
from jaxevent.errors import InputError


class DerivativeDirections(NamedTuple):
    """Numbers of the parameters by which derivatives are taken, and the outputs that have them.

    Attributes:
        numbers: Leaf of the parameters, and index in it, of each number.
        of: Names of the outputs.
    """

    numbers: tuple[tuple[int, int], ...] = ()
    of: tuple[str, ...] = ("mean", "variance")

    @property
    def lanes(self) -> int:
        """Numbers of a vector of derivatives: as many as processors take at once."""
        count = len(self.numbers)
        return -(-count // 8) * 8 if count > 4 else 4

    def seeds(self, params: Any) -> Any:
        """Return the directions in the parameters, each leaf with an axis of them in front."""
        leaves, tree = jax.tree.flatten(params)
        count = len(self.numbers)
        seeds = [np.zeros((count, *np.shape(leaf)), np.asarray(leaf).dtype) for leaf in leaves]
        for d, (leaf, number) in enumerate(self.numbers):
            seeds[leaf].reshape(count, -1)[d, number] = 1
        return jax.tree.unflatten(tree, seeds)

    def inputs(self, params: Any, fixed: Any) -> tuple[Any, ...]:
        """Return the numbers that a traced program begins with: the first argument of its steps.

        Args:
            params: Parameters.
            fixed: Further numbers that are known with them.

        Returns:
            Both, and the directions if there are any.
        """
        return (params, fixed, self.seeds(params)) if self.numbers else (params, fixed)

    def shapes(self, tree: Any) -> Any:
        """Return the shapes of the derivatives of a tree of shapes, along all directions."""
        real, count = eqx.filter(tree, is_real), len(self.numbers)
        return jax.tree.map(lambda v: jax.ShapeDtypeStruct((count, *v.shape), v.dtype), real)


def is_real(leaf: Any) -> bool:
    """Return whether an array, or its shape, is one of real numbers."""
    return jnp.issubdtype(leaf.dtype, jnp.inexact)


def with_derivatives(
    function: Callable[..., dict[str, Any]],
    select_outputs: Callable[[dict[str, Any]], dict[str, Any]],
) -> Callable[..., dict[str, Any]]:
    """Extend a function by the derivatives of its results along directions in the parameters.

    Args:
        function: A function of `(params, fixed)` and of named trees.
        select_outputs: Selects what has derivatives of the dict that the function returns.

    Returns:
        A function of `(params, fixed, seeds)`, of the named trees, and of `sensitivities`: the
        derivatives of some of them, by name. Seeds and derivatives have an axis of directions in
        front. The dict that the function returns has `sensitivities` beside the results.
    """

    def both(known: Any, sensitivities: dict[str, Any], **given: Any) -> dict[str, Any]:
        params, fixed, seeds = known
        moving = {name: given[name] for name in sensitivities}
        real, rest = eqx.partition(moving, is_real)

        def compute(params: Any, real: Any) -> tuple[Any, Any]:
            made = function((params, fixed), **{**given, **eqx.combine(real, rest)})
            return eqx.filter(select_outputs(made), is_real), made

        def push(seeds: Any, sensitivities: Any) -> Any:
            return jax.jvp(compute, (params, real), (seeds, sensitivities), has_aux=True)[1:]

        changes, made = jax.vmap(push, out_axes=(0, None))(seeds, sensitivities)
        return made | {"sensitivities": changes}

    return both


def derivative_name(name: str, direction: int) -> str:
    """Return the name of a single number's derivative: "sensitivities['a'].b.2" for "a.b.0".

    Args:
        name: Name of the number.
        direction: Place among the directions of derivatives.

    Returns:
        The name.
    """
    tree, rest = re.split(r"\b", name.removesuffix(".0"), maxsplit=2)[1:]
    return f"sensitivities['{tree}']{rest}.{direction}"


def parse_derivative(name: str) -> tuple[str, int] | None:
    """Return the number and the direction of a derivative's name; None for other names."""
    found = re.fullmatch(r"sensitivities\['(\w+)'\](.*)\.(\d+)", name)
    return None if found is None else (f"{found[1]}{found[2]}.0", int(found[3]))


def linear_factors(result: Node, changes: set[Node], graph: Graph) -> dict[Node, Node]:
    """Return the factor of each change in a sum of products.

    Args:
        result: The sum.
        changes: The changes.
        graph: Maker of nodes.

    Returns:
        Factors, by change.

    Raises:
        TranslationError: The result is no such sum.
    """
    nodes = find_dependencies([result], changes)
    moving = set(changes)
    for node in nodes:
        if any(a in moving for a in node.args if isinstance(a, Node)):
            moving.add(node)
    found: dict[Node, Node] = {}
    at: dict[Node, Node] = {result: graph.constant(1.0)} if result in moving else {}
    for node in reversed(nodes):
        if node not in at:
            continue
        if node in changes:
            found[node] = at[node]
            continue
        for argument, factor in _passed(node, at[node], moving, graph):
            before = at.get(argument)
            both = factor if before is None else graph.apply("add", (before, factor), "f")
            at[argument] = both
    return found


def _passed(node: Node, at: Node, moving: set[Node], graph: Graph) -> list[tuple[Node, Node]]:
    """Return the factors of a node's arguments, from the node's own.

    Args:
        node: The node.
        at: Factor of the node itself.
        moving: Nodes that depend on the changes.
        graph: Maker of nodes.

    Returns:
        Pairs of an argument that moves, and its factor.

    Raises:
        TranslationError: The node is no term of a sum of products.
    """
    apply, args = graph.apply, node.args
    minus = apply("neg", (at,), "f")
    if node.op in ("add", "sub"):
        parts = [(args[0], at), (args[1], at if node.op == "add" else minus)]
    elif node.op == "neg":
        parts = [(args[0], minus)]
    elif node.op == "mul":
        change, other = args if args[0] in moving else args[::-1]
        if other in moving:
            raise TranslationError("a product of derivatives")
        parts = [(change, apply("mul", (at, other), "f"))]
    elif node.op == "div" and args[1] not in moving:
        inverse = apply("div", (graph.constant(1.0), args[1]), "f")
        parts = [(args[0], apply("mul", (at, inverse), "f"))]
    elif node.op == "select_n" and args[0] not in moving:
        zero = graph.constant(0.0)
        parts = [
            (args[1], apply("select_n", (args[0], at, zero), "f")),
            (args[2], apply("select_n", (args[0], zero, at), "f")),
        ]
    else:
        raise TranslationError(f"the derivative of {node.op!r}")
    return [(argument, factor) for argument, factor in parts if argument in moving]


Term = tuple[int, bool, int]  # which factor; whether of numbers; where the vector begins
Sum = tuple[int, tuple[Term, ...]]  # where it is written to, and what is added up


def make_vector_sums(n_lanes: int, sums: tuple[Sum, ...]) -> Any:
    """Make a function for kernels: sums of products of numbers and vectors of `n_lanes` numbers.

    `function(out, to, cells, at, numbers, factors)` writes the sums behind the place `to` of `out`.
    Vectors lie in `cells` behind the place `at`, or in `numbers`. All are read before any is
    written.

    Args:
        n_lanes: Numbers of a vector.
        sums: For each sum where it goes, and its terms: which factor, whether the vector is of
            `numbers`, and where it begins.
    """

    # numba's typing context comes first of the arguments.
    @make_intrinsic
    def function(context: Any, out: Any, to: Any, cells: Any, at: Any, numbers: Any, factors: Any):
        def make(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            lines = _VectorInstructions(
                builder, context.get_value_type(signature.args[0].dtype), n_lanes
            )
            out, to, cells, at, numbers, factors = arguments
            totals = []
            for _, terms in sums:
                total = None
                for factor, of_numbers, offset in terms:
                    begin = None if of_numbers else at
                    vector = lines.load(numbers if of_numbers else cells, begin, offset)
                    product = lines.times(builder.extract_value(factors, factor), vector)
                    total = product if total is None else lines.plus(total, product)
                totals.append(total)
            for (place, _), total in zip(sums, totals, strict=True):
                lines.store(total, out, to, place)
            return context.get_dummy_value()

        return types.void(out, to, cells, at, numbers, factors), make

    return function


class _VectorInstructions:
    """Instructions of LLVM on vectors."""

    def __init__(self, builder: Any, real: Any, lanes: int):
        self.builder, self.lanes = builder, lanes
        self.kind = ir.VectorType(real, lanes)
        self.align = 4 if isinstance(real, ir.FloatType) else 8

    def _pointer(self, array: Any, begin: Any, offset: int) -> Any:
        """Return the address of a vector in an array.

        Args:
            array: Pointer to the array's first number.
            begin: Index of a record in the array; None: 0.
            offset: Index of the vector's first number from there.

        Returns:
            Pointer to the vector.
        """
        place = ir.Constant(ir.IntType(64), offset)
        if begin is not None:
            place = self.builder.add(begin, place)
        return self.builder.bitcast(self.builder.gep(array, [place]), self.kind.as_pointer())

    def load(self, array: Any, begin: Any, offset: int) -> Any:
        return self.builder.load(self._pointer(array, begin, offset), align=self.align)

    def store(self, vector: Any, array: Any, begin: Any, offset: int) -> None:
        vector = ir.Constant(self.kind, [0.0] * self.lanes) if vector is None else vector
        self.builder.store(vector, self._pointer(array, begin, offset), align=self.align)

    def times(self, number: Any, vector: Any) -> Any:
        nothing, whole = ir.Constant(self.kind, ir.Undefined), ir.IntType(32)
        one = self.builder.insert_element(nothing, number, ir.Constant(whole, 0))
        order = ir.Constant(ir.VectorType(whole, self.lanes), [0] * self.lanes)
        spread = self.builder.shuffle_vector(one, nothing, order)
        return self.builder.fmul(spread, vector, flags=("contract",))

    def plus(self, one: Any, other: Any) -> Any:
        return self.builder.fadd(one, other, flags=("contract",))


@dataclasses.dataclass(frozen=True)
class ChangeVector:
    """Vector of changes, 0 along directions that are not named."""

    kind: str  # of a "state", of a "table" (what frames say), or of a "number"
    state: str  # its name
    nodes: dict[int, list[Node]]  # numbers to add up; or what the table holds in each variant


@dataclasses.dataclass(frozen=True)
class Derivatives:
    """Derivatives of results, as sums of factors times vectors of changes.

    Attributes:
        changes: The vectors.
        factors: For each result by name, its factors and the indices of their vectors in `changes`.
    """

    changes: list[ChangeVector]
    factors: dict[str, list[tuple[Node, int]]]

    def factors_of(self, *names: str) -> list[Node]:
        """Return the factors of some results, each once."""
        return list(dict.fromkeys(node for name in names for node, _ in self.factors[name]))


def collect_derivatives(
    outs: dict[str, list[Node]],
    tables: list[list[Node]],
    excess: list[Node],
    moving: set[Node],
    graph: Graph,
) -> Derivatives:
    """Collect the derivatives of results.

    Args:
        outs: Derivatives of each result, by direction.
        tables: What the slots hold, for each variant.
        excess: What a segment adds to the sums "total.0", ...
        moving: Changes of numbers of the parameters.
        graph: Graph of the nodes.

    Returns:
        The derivatives, as sums of factors times vectors of changes.

    Raises:
        TranslationError: They are no such sums.
    """
    sums = {
        f"total.{k}." for k, node in enumerate(excess) if moving & set(find_dependencies([node]))
    }

    def changes(node: Node) -> bool:
        if node.op == "slot":
            below = find_dependencies([table[node.args[0]] for table in tables])
            return any(changes(n) for n in below)
        name = str(node.args[0]) if node.op == "input" else ""
        return name.startswith(("sensitivities[", *sums)) or node in moving

    every = find_dependencies([node for nodes in outs.values() for node in nodes])
    known = {node for node in every if changes(node)}
    # The factors of a change in all results: what has the same ones is one vector.
    found: dict[tuple[int, Node], dict[str, Node]] = {}
    for name, nodes in outs.items():
        for direction, node in enumerate(nodes):
            for change, factor in linear_factors(node, known, graph).items():
                found.setdefault((direction, change), {})[name] = factor
    vectors: dict[tuple[Any, ...], dict[int, list[Node]]] = {}
    alike: dict[tuple[Any, ...], dict[str, Node]] = {}
    for (direction, change), by_name in found.items():
        key = _kind(change)
        if key[0] == "state":
            alike.setdefault(key, {})
            if any(alike[key].setdefault(n, f) is not f for n, f in by_name.items()):
                raise TranslationError("derivatives whose factors differ between directions")
        else:
            key += tuple((n, f.number) for n, f in sorted(by_name.items()))
            alike[key] = by_name
        vectors.setdefault(key, {}).setdefault(direction, []).append(change)
    order = sorted(vectors, key=lambda key: ("state", "table", "number").index(key[0]))
    made: list[ChangeVector] = []
    terms: dict[str, dict[int, Node]] = {name: {} for name in outs}
    for key in order:
        kind, state = key[:2]
        change = ChangeVector(kind, state, _change_contents(kind, vectors[key], tables, graph))
        if change not in made:
            made.append(change)
        place = made.index(change)
        for name, factor in alike[key].items():
            before = terms[name].get(place, graph.constant(0.0))
            terms[name][place] = graph.apply("add", (before, factor), "f")
    sums = {
        name: [(factor, place) for place, factor in by_place.items() if constant_value(factor) != 0]
        for name, by_place in terms.items()
    }
    return Derivatives(made, sums)


def _change_contents(
    kind: str, changes: dict[int, list[Node]], tables: list[list[Node]], graph: Graph
) -> dict[int, list[Node]]:
    def total(nodes: list[Node]) -> Node:
        return functools.reduce(lambda a, b: graph.apply("add", (a, b), "f"), nodes)

    if kind == "state":
        return {}
    if kind == "number":
        return changes
    return {
        lane: [total([table[slot.args[0]] for slot in slots]) for table in tables]
        for lane, slots in changes.items()
    }


def _kind(change: Node) -> tuple[str, str]:
    found = parse_derivative(change.args[0]) if change.op == "input" else None
    if found is not None:
        return "state", found[0]
    if change.op not in ("number", "slot"):
        raise TranslationError(f"the derivative of {change.op!r} at a point")
    return "number" if change.op == "number" else "table", ""


def is_zero_tangent(tangent: Any) -> bool:
    """Return whether a tangent that a rule with `symbolic_zeros` is given is that of a constant."""
    return isinstance(tangent, jax.custom_derivatives.SymbolicZero)


def are_zero_tangents(tangents: Any) -> bool:
    """Return whether all tangents of a tree are those of constants."""
    return all(map(is_zero_tangent, jax.tree.leaves(tangents, is_leaf=is_zero_tangent)))


def moving_numbers(tangents: Any) -> tuple[tuple[tuple[int, int], ...], list[Any]]:
    """Find the numbers of parameters by which a rule with `symbolic_zeros` is to differentiate.

    Args:
        tangents: Tangents of the parameters.

    Returns:
        Leaf and place in it of each number, as in `DerivativeDirections`, and the tangents of these
        leaves.
    """
    changes = jax.tree.leaves(tangents, is_leaf=is_zero_tangent)
    moving = [k for k, change in enumerate(changes) if not is_zero_tangent(change)]
    numbers = tuple((k, place) for k in moving for place in range(changes[k].size))
    return numbers, [changes[k] for k in moving]


def zero_tangents(tree: Any) -> Any:
    """Return tangents of 0 for all arrays of a tree."""

    def zero(leaf: Any) -> Any:
        if is_real(leaf):
            return jnp.zeros(leaf.shape, leaf.dtype)
        return np.zeros(leaf.shape, jax.dtypes.float0)

    return jax.tree.map(zero, tree)


def refuse_second_derivatives(name: str, tangents: Any, remedy: str) -> None:
    """Raise `InputError` where first derivatives would be differentiated, which no kernel carries.

    Args:
        name: Name of the method.
        tangents: Changes of what the derivatives depend on; those of nothing are allowed.
        remedy: What to do in place of it.
    """
    if not are_zero_tangents(tangents):
        raise InputError(
            f"the kernel of the method {name!r} has first derivatives only; for second ones, as of "
            f"jax.hessian, give {remedy}"
        )
