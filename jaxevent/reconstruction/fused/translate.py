"""From a jaxpr to scalar expressions: arrays of a few rows and one pixel become their numbers.

Arrays that only move their elements (slices, stacks, look-ups with a known index) vanish; what is
computed element by element becomes one node per element. Conditions on parameters alone choose
their way here, so that a kernel holds nothing that its parameters switch off.
"""

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxevent.reconstruction.fused.expressions import Graph, Level, Node, Untranslatable
from jaxevent.reconstruction.fused.host import (
    ELEMENTWISE,
    HostProgram,
    evaluate,
    inner,
    rearranged,
)

KINDS = {"f": "f", "i": "i", "u": "i", "b": "b"}


@dataclasses.dataclass(frozen=True)
class Known:
    """An array known when the program is written; `placed`: it tells where a point lies."""

    value: NDArray
    placed: bool = False


@dataclasses.dataclass(frozen=True)
class OfParameters:
    """An array known with the parameters: a value of the `HostProgram`."""

    number: int


Value = Known | OfParameters | NDArray  # an array of nodes


class Translation:
    """Translates jaxprs into one graph.

    Look-ups of tables at a place (`Known.placed`) become nodes "slot", numbered in order; what they
    hold is collected in `slots`. Sums over segments (`segment_cells`) become inputs "total".
    """

    def __init__(self, graph: Graph, host: HostProgram):
        self.graph, self.host = graph, host
        self.slots: list[Node] = []
        self.excess: Node | None = None  # what a segment adds to the sum

    def run(self, closed: Any, values: list[Value]) -> list[Value]:
        jaxpr = closed.jaxpr
        known: dict[Any, Value] = dict(zip(jaxpr.invars, values, strict=True))
        for var, const in zip(jaxpr.constvars, closed.consts, strict=True):
            known[var] = Known(np.asarray(const))

        def of(atom: Any) -> Value:
            return Known(np.asarray(atom.val)) if hasattr(atom, "val") else known[atom]

        for eqn in jaxpr.eqns:
            made = self._equation(eqn, [of(a) for a in eqn.invars])
            known |= dict(zip(eqn.outvars, made, strict=True))
        return [of(a) for a in jaxpr.outvars]

    def nodes(self, value: Value) -> NDArray:
        """The value as an array of nodes."""
        if isinstance(value, np.ndarray):
            return value
        number = value.number if isinstance(value, OfParameters) else None
        array = value.value if isinstance(value, Known) else self.host.values[value.number]
        out = np.empty(array.shape, object)
        for flat, place in enumerate(np.ndindex(*array.shape)):
            if number is None:
                out[place] = self.graph.constant(array[place])
            else:
                kind = KINDS[array.dtype.kind]
                out[place] = self.graph.node("number", (number, flat), kind, Level.HOST)
        return out

    def _equation(self, eqn: Any, values: list[Value]) -> list[Value]:
        called = inner(eqn)
        if called is not None:
            return self.run(called, values)
        if all(isinstance(v, Known) for v in values):
            placed = any(v.placed for v in values if isinstance(v, Known))
            arrays = [v.value for v in values if isinstance(v, Known)]
            return [Known(made, placed) for made in evaluate(eqn, arrays)]
        if all(isinstance(v, Known | OfParameters) for v in values):
            if not any(isinstance(v, Known) and v.placed for v in values):
                return self._of_parameters(eqn, values)
        return [self._symbolic(eqn, values)]

    def _of_parameters(self, eqn: Any, values: list[Any]) -> list[Value]:
        arguments = [v.number if isinstance(v, OfParameters) else v.value for v in values]
        numbers = self.host.add(eqn, arguments)
        out: list[Value] = []
        for number in numbers:
            if self.host.values[number].dtype == bool:
                self.host.decided.append(number)
                out.append(Known(self.host.values[number]))
            else:
                out.append(OfParameters(number))
        return out

    def _symbolic(self, eqn: Any, values: list[Value]) -> NDArray:
        name = eqn.primitive.name
        kind = KINDS.get(eqn.outvars[0].aval.dtype.kind)
        if kind is None or len(eqn.outvars) > 1:
            raise Untranslatable(f"the operation {name!r}")
        if name == "scatter-add":
            return self._sum_over_segments(values)
        if name in ("gather", "dynamic_slice"):
            return self._look_up(eqn, values, kind)
        moved = rearranged(eqn, [self.nodes(v) for v in values])
        if moved is not None:
            return moved
        if name == "reduce_sum":
            return self._sum(eqn, self.nodes(values[0]))
        arrays = np.broadcast_arrays(*(self.nodes(v) for v in values))
        out = np.empty(arrays[0].shape, object)
        for place in np.ndindex(*out.shape):
            args: list[Any] = [a[place] for a in arrays]
            out[place] = self._apply(eqn, args, kind)
        return out

    def _apply(self, eqn: Any, args: list[Node], kind: str) -> Node:
        name, apply = eqn.primitive.name, self.graph.apply
        if name in ("stop_gradient", "copy", "copy_p"):
            return args[0]
        if name == "convert_element_type":
            return args[0] if args[0].kind == kind else apply(f"to_{kind}", tuple(args), kind)
        if name == "square":
            return apply("mul", (args[0], args[0]), kind)
        if name == "integer_pow":
            return self._power(args[0], eqn.params["y"])
        if name == "clamp":
            return apply("min", (apply("max", (args[1], args[0]), kind), args[2]), kind)
        if name == "select_n" and len(args) == 3 and args[0].kind == "b":
            return apply(name, tuple(args), kind)
        if name == "div" and kind == "f":
            return apply(name, tuple(args), kind)
        if name in ELEMENTWISE:
            return apply(name.removesuffix("_any"), tuple(args), kind)
        raise Untranslatable(f"the operation {name!r}")

    def _power(self, base: Node, exponent: int) -> Node:
        power = base
        for _ in range(abs(exponent) - 1):
            power = self.graph.apply("mul", (power, base), "f")
        if exponent < 0:
            power = self.graph.apply("div", (self.graph.constant(1.0), power), "f")
        return power if exponent else self.graph.constant(1.0)

    def _sum(self, eqn: Any, array: NDArray) -> NDArray:
        for axis in sorted(eqn.params["axes"], reverse=True):
            parts = np.moveaxis(array, axis, 0)
            total = parts[0]
            for part in parts[1:]:
                pairs = zip(np.ravel(total), np.ravel(part), strict=True)
                added = [self.graph.apply("add", pair, pair[0].kind) for pair in pairs]
                total = np.array(added, object).reshape(np.shape(part))
            array = np.asarray(total, object)
        return array

    def _look_up(self, eqn: Any, values: list[Value], kind: str) -> NDArray:
        table, *places = values
        if all(isinstance(p, Known) for p in places):
            entries = [p.value for p in places if isinstance(p, Known)]
            found = rearranged(eqn, [self.nodes(table), *entries])
            assert found is not None
            if not any(p.placed for p in places if isinstance(p, Known)):
                return found
            return self._cut(found, kind)
        if eqn.primitive.name == "gather" and isinstance(table, OfParameters):
            index = self.nodes(places[0])
            one = self.host.values[table.number].ndim == 1 and index.shape[-1:] == (1,)
            if one and eqn.params["slice_sizes"] == (1,):
                out = np.empty(index.shape[:-1], object)
                for place in np.ndindex(*out.shape):
                    arguments = (table.number, index[place][0])
                    out[place] = self.graph.apply("entry", arguments, kind)
                return out
        raise Untranslatable("a look-up with an index of data")

    def _cut(self, found: NDArray, kind: str) -> NDArray:
        """What is looked up where points lie: known when the piece begins."""
        out = np.empty(found.shape, object)
        for place in np.ndindex(*found.shape):
            out[place] = self.graph.node("slot", (len(self.slots),), kind, Level.TABLE)
            node: Any = found[place]
            self.slots.append(node)
        return out

    def _sum_over_segments(self, values: list[Value]) -> NDArray:
        start, cells, updates = values
        zero = isinstance(start, Known) and start.value.ndim == 1 and not start.value.any()
        index, added = np.ravel(self.nodes(cells)), np.ravel(self.nodes(updates))
        ours = len(index) == len(added) == 1 and index[0].args == ("segment_cell",)
        if not (zero and ours) or self.excess not in (None, added[0]):
            raise Untranslatable("a sum other than that over an exposure's segments")
        self.excess = added[0]
        assert isinstance(start, Known)
        rows = [self.graph.input(f"total{r}", "f", Level.TABLE) for r in range(len(start.value))]
        return np.array(rows, object)
