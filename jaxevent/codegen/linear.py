"""Derivatives along several directions at once: linear programs transposed, and sums of vectors.

JAX's forward mode makes a function of a function that is linear in the changes of the arguments.
The factor of each change in a result is found by going through the expressions backwards, once for
all directions. What is left for each direction is a sum of products, for all of them side by side.
"""

from typing import Any

from jaxevent.codegen.expressions import Graph, Node, Untranslatable, needed
from jaxevent.codegen.numeric import operation
from jaxevent.codegen.support import ir, types


def factors(result: Node, changes: set[Node], graph: Graph) -> dict[Node, Node]:
    """The factors of the changes in a sum of products; raises `Untranslatable` for what is none."""
    nodes = needed([result], changes)
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
    """The factors of a node's arguments, of its own."""
    apply, args = graph.apply, node.args
    minus = apply("neg", (at,), "f")
    if node.op in ("add", "sub"):
        parts = [(args[0], at), (args[1], at if node.op == "add" else minus)]
    elif node.op == "neg":
        parts = [(args[0], minus)]
    elif node.op == "mul":
        change, other = args if args[0] in moving else args[::-1]
        if other in moving:
            raise Untranslatable("a product of derivatives")
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
        raise Untranslatable(f"the derivative of {node.op!r}")
    return [(argument, factor) for argument, factor in parts if argument in moving]


Term = tuple[int, bool, int]  # which factor; whether of numbers; where the vector begins
Sum = tuple[int, tuple[Term, ...]]  # where it is written to, and what is added up


def vector_sums(lanes: int, sums: tuple[Sum, ...]) -> Any:
    """A function for kernels: sums of products of numbers and vectors of `lanes` numbers.

    `function(out, to, cells, at, numbers, factors)` writes the sums behind the place `to` of `out`.
    Vectors lie in `cells` behind the place `at`, or in `numbers`. All are read before any is
    written.
    """

    @operation
    def function(context: Any, out: Any, to: Any, cells: Any, at: Any, numbers: Any, factors: Any):
        def make(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            lines = _Vectors(builder, context.get_value_type(signature.args[0].dtype), lanes)
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


class _Vectors:
    """Operations on vectors, in the compiler's language."""

    def __init__(self, builder: Any, real: Any, lanes: int):
        self.builder, self.lanes = builder, lanes
        self.kind = ir.VectorType(real, lanes)
        self.align = 4 if isinstance(real, ir.FloatType) else 8

    def _pointer(self, array: Any, begin: Any, offset: int) -> Any:
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
