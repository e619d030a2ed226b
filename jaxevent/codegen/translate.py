"""From a jaxpr to scalar expressions: arrays of a few rows and one pixel become their numbers.

Arrays that only move their elements (slices, stacks, look-ups with a known index) vanish; what is
computed element by element becomes one node per element. Conditions on parameters alone choose
their way here, so that a kernel holds nothing that its parameters switch off.
"""

import dataclasses
import types
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxevent.codegen.expressions import ELEMENTWISE, Graph, Level, Node, Untranslatable
from jaxevent.codegen.host import (
    HostProgram,
    evaluate,
    inner,
    rearranged,
)

FOLDS = {"reduce_sum": "add", "reduce_max": "max", "reduce_min": "min", "reduce_or": "or",
         "reduce_and": "and"}  # fmt: skip
KINDS = {"f": "f", "i": "i", "u": "i", "b": "b"}


@dataclasses.dataclass(frozen=True)
class Known:
    """An array known when the program is written; `placed`: it tells where a point lies."""

    value: NDArray
    placed: bool = False


@dataclasses.dataclass(frozen=True)
class OfParameters:
    """An array known with the parameters: a value of the `HostProgram`.

    Kernels leave out what is 0 in `sparse` ones. `change`: it is a derivative.
    """

    number: int
    sparse: bool = False
    change: bool = False


Value = Known | OfParameters | NDArray  # an array of nodes


class Translation:
    """Translates jaxprs into one graph. Families add what is their own (`special`, `placed`)."""

    def __init__(self, graph: Graph, host: HostProgram):
        self.graph, self.host = graph, host
        self.changes: set[Node] = set()  # numbers that are derivatives

    def special(self, eqn: Any, values: list[Value]) -> NDArray | None:
        """What an equation of a family's own makes; None for all others."""
        return None

    def placed(self, found: NDArray, kind: str) -> NDArray:
        """What is looked up where points lie (`Known.placed`)."""
        raise Untranslatable("a look-up at a place")

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
        sparse = isinstance(value, OfParameters) and value.sparse
        if number is not None and sparse:
            self.host.zeros[number] = array == 0
        for flat, place in enumerate(np.ndindex(*array.shape)):
            if number is None or (sparse and array[place] == 0):
                out[place] = self.graph.constant(array[place])
            else:
                kind = KINDS[array.dtype.kind]
                node = self.graph.node("number", (number, flat), kind, Level.HOST)
                if isinstance(value, OfParameters) and value.change:
                    self.changes.add(node)
                out[place] = node
        return out

    def _equation(self, eqn: Any, values: list[Value]) -> list[Value]:
        called = inner(eqn)
        chosen = values[0] if eqn.primitive.name == "cond" else None
        if isinstance(chosen, Known):
            called, values = eqn.params["branches"][int(chosen.value)], values[1:]
        if called is not None:
            return self.run(called, values)
        if all(isinstance(v, Known) for v in values):
            placed = any(v.placed for v in values if isinstance(v, Known))
            arrays = [v.value for v in values if isinstance(v, Known)]
            return [Known(made, placed) for made in evaluate(eqn, arrays)]
        if all(isinstance(v, Known | OfParameters) for v in values):
            if not any(isinstance(v, Known) and v.placed for v in values):
                return self._of_parameters(eqn, values)
        if eqn.primitive.name in ("split", "unstack"):
            return self.parts(eqn, values[0])
        return [self._symbolic(eqn, values)]

    def parts(self, eqn: Any, value: Value) -> list[Value]:
        """What an array is taken apart into, along an axis."""
        sizes = eqn.params.get("sizes", [1] * len(eqn.outvars))
        parts = np.split(self.nodes(value), np.cumsum(sizes)[:-1], eqn.params["axis"])
        return [part.reshape(var.aval.shape) for part, var in zip(parts, eqn.outvars, strict=True)]

    def _of_parameters(self, eqn: Any, values: list[Any]) -> list[Value]:
        arguments = [v.number if isinstance(v, OfParameters) else v.value for v in values]
        numbers = self.host.add(eqn, arguments)
        known = [v for v in values if isinstance(v, OfParameters)]
        sparse, change = any(v.sparse for v in known), any(v.change for v in known)
        out: list[Value] = []
        for number in numbers:
            if self.host.values[number].dtype == bool:
                self.host.decided.append(number)
                out.append(Known(self.host.values[number]))
            else:
                real = self.host.values[number].dtype.kind == "f"  # places have no derivatives
                out.append(OfParameters(number, sparse, change and real))
        return out

    def _symbolic(self, eqn: Any, values: list[Value]) -> NDArray:
        name = eqn.primitive.name
        kind = KINDS.get(eqn.outvars[0].aval.dtype.kind)
        if kind is None or len(eqn.outvars) > 1:
            raise Untranslatable(f"the operation {name!r}")
        own = self.special(eqn, values)
        if own is not None:
            return own
        if name in ("gather", "dynamic_slice"):
            return self._look_up(eqn, values, kind)
        if name == "scatter":
            return self._set(eqn, values)
        moved = rearranged(eqn, [self.nodes(v) for v in values])
        if moved is not None:
            return moved
        if name in FOLDS:
            return self.fold(FOLDS[name], self.nodes(values[0]), list(map(int, eqn.params["axes"])))
        if name == "argmax":
            return self._first_largest(self.nodes(values[0]), int(eqn.params["axes"][0]))
        if name == "dot_general":
            return self._dot(eqn, self.nodes(values[0]), self.nodes(values[1]))
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
        if name == "select_n":
            return self._select(args, kind)
        if name == "div" and kind == "f":
            return apply(name, tuple(args), kind)
        if name in ELEMENTWISE:
            return apply(name.removesuffix("_any"), tuple(args), kind)
        raise Untranslatable(f"the operation {name!r}")

    def _power(self, base: Node, exponent: int) -> Node:
        one = self.graph.constant(1.0)
        if exponent < 0:
            base = self.graph.apply("div", (one, base), "f")
        power = base if exponent else one
        for _ in range(abs(exponent) - 1):
            power = self.graph.apply("mul", (power, base), "f")
        return power

    def fold(self, op: str, array: NDArray, axes: list[int]) -> NDArray:
        """An array folded by an operation, along axes."""
        for axis in sorted(axes, reverse=True):
            parts = np.moveaxis(array, axis, 0)
            total = parts[0]
            for part in parts[1:]:
                pairs = zip(np.ravel(total), np.ravel(part), strict=True)
                folded = [self.graph.apply(op, pair, pair[0].kind) for pair in pairs]
                total = np.array(folded, object).reshape(np.shape(part))
            array = np.asarray(total, object)
        return array

    def _first_largest(self, array: NDArray, axis: int) -> NDArray:
        """The place of the largest along an axis, the first of equal ones."""
        apply, parts = self.graph.apply, np.moveaxis(array, axis, 0)
        out = np.empty(parts.shape[1:], object)
        for place in np.ndindex(*out.shape):
            best, at = parts[(0, *place)], self.graph.constant(0)
            for k in range(1, len(parts)):
                one = parts[(k, *place)]
                if one.kind == "b":
                    larger = apply("and", (one, apply("not", (best,), "b")), "b")
                else:
                    larger = apply("gt", (one, best), "b")
                at = apply("select_n", (larger, at, self.graph.constant(k)), "i")
                best = apply("select_n", (larger, best, one), one.kind)
            out[place] = at
        return out

    def _select(self, args: list[Node], kind: str) -> Node:
        which, *cases = args
        if which.kind == "b":
            return self.graph.apply("select_n", tuple(args), kind)
        out = cases[-1]
        for k in reversed(range(len(cases) - 1)):
            here = self.graph.apply("eq", (which, self.graph.constant(k)), "b")
            out = self.graph.apply("select_n", (here, out, cases[k]), kind)
        return out

    def _dot(self, eqn: Any, left: NDArray, right: NDArray) -> NDArray:
        """Products summed over the axes that both arrays share."""
        ((of_left, of_right), (batch_left, batch_right)) = eqn.params["dimension_numbers"]
        if batch_left or batch_right:
            raise Untranslatable("a product of batches of matrices")
        left = np.moveaxis(left, of_left, range(len(of_left)))
        right = np.moveaxis(right, of_right, range(len(of_right)))
        shared = left.shape[: len(of_left)]
        free = left.shape[len(shared) :], right.shape[len(shared) :]
        left = left.reshape(*shared, *free[0], *[1] * len(free[1]))
        right = right.reshape(*shared, *[1] * len(free[0]), *free[1])
        pairs = np.broadcast_arrays(left, right)
        out = np.empty(pairs[0].shape, object)
        for place in np.ndindex(*out.shape):
            args: Any = (pairs[0][place], pairs[1][place])
            out[place] = self.graph.apply("mul", args, args[0].kind)
        return self.fold("add", out, list(range(len(shared))))

    def _set(self, eqn: Any, values: list[Value]) -> NDArray:
        """An array with single elements replaced, at known places."""
        numbers, places = eqn.params["dimension_numbers"], values[1]
        if not isinstance(places, Known) or numbers.update_window_dims or places.placed:
            raise Untranslatable("elements set at places of data")
        out, new = self.nodes(values[0]).copy(), self.nodes(values[2])
        order = numbers.scatter_dims_to_operand_dims
        for place in np.ndindex(*new.shape):
            out[tuple(int(places.value[place][order.index(k)]) for k in range(out.ndim))] = new[
                place
            ]
        return out

    def _look_up(self, eqn: Any, values: list[Value], kind: str) -> NDArray:
        table, *places = values
        if all(isinstance(p, Known) for p in places):
            entries = [p.value for p in places if isinstance(p, Known)]
            found = rearranged(eqn, [self.nodes(table), *entries])
            assert found is not None
            if not any(p.placed for p in places if isinstance(p, Known)):
                return found
            return self.placed(found, kind)
        if eqn.primitive.name == "gather" and isinstance(table, OfParameters):
            index, sizes = self.nodes(places[0]), eqn.params["slice_sizes"]
            size = self.host.values[table.number].shape[-1]
            if index.shape[-1:] == (1,) and sizes == (1,):
                return self._entries(table, index[..., 0], kind)
            numbers = eqn.params["dimension_numbers"]
            whole = sizes[1:] == (1,) and numbers.start_index_map == (1,)
            if index.shape[-1:] == (1,) and whole and len(numbers.offset_dims) == 1:
                rows = [self._row(table, k, size) for k in range(sizes[0])]
                found = [self._entries(row, index[..., 0], kind) for row in rows]
                return np.stack(found, numbers.offset_dims[0])
        raise Untranslatable("a look-up with an index of data")

    def _entries(self, table: OfParameters, index: NDArray, kind: str) -> NDArray:
        """What stands at places of data in a table of one axis."""
        out, array = np.empty(index.shape, object), self.host.values[table.number]
        if table.sparse or table.change:
            self.host.zeros[table.number] = array == 0
            if not array.any():
                out.fill(self.graph.constant(0.0))
                return out
        for place in np.ndindex(*out.shape):
            node = self.graph.apply("entry", (table.number, index[place]), kind)
            if table.change:
                self.changes.add(node)
            out[place] = node
        return out

    def _row(self, table: OfParameters, row: int, size: int) -> OfParameters:
        """A row of a table."""
        out = [types.SimpleNamespace(aval=self.host.values[table.number])]
        cut = {"start_indices": (row, 0), "limit_indices": (row + 1, size), "strides": None}
        number = table.number
        for name, params in (("slice", cut), ("reshape", {"new_sizes": (size,)})):
            what = types.SimpleNamespace(name=name)
            eqn = types.SimpleNamespace(primitive=what, params=params, outvars=out)
            (number,) = self.host.add(eqn, [number])
        return dataclasses.replace(table, number=number)
