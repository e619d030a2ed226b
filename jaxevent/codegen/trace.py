"""Functions traced by JAX, translated to scalar expressions.

Arrays of a few rows and one pixel become their numbers. Arrays that only move their elements
(slices, stacks, look-ups with a known index) vanish; what is computed element by element becomes
one node per element. Conditions on parameters alone choose their way here, so that a kernel holds
nothing that its parameters switch off.

A function may have one axis of elements, as the events of a step. It is traced with
`ELEMENT_AXIS_LENGTH` of them, whatever their number will be. What is computed element by element
becomes the body of a loop; sums and greatest values over the axis are reduced in it. What rests on
such a sum comes after the loop, and its elements are computed in a loop of their own, from the
inputs: that costs less than keeping them.
"""

import dataclasses
import types
from collections.abc import Callable, Collection, Mapping
from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray

from jaxevent.codegen.graph import (
    ELEMENTWISE_FUNCTIONS,
    Graph,
    Level,
    Node,
    ParameterProgram,
    TranslationError,
    called_jaxpr,
    evaluate_equation,
    find_dependencies,
    move_elements,
)

ELEMENT_AXIS_LENGTH = 7919  # elements in a trace: a prime that no other axis has
ELEMENT_REDUCTIONS = ("total", "largest", "place")  # operations over the axis
SHAPE_VALUED_PARAMETERS = ("shape", "new_sizes", "sizes", "limit_indices", "slice_sizes")
OPERATION_BY_REDUCTION = {
    "reduce_sum": "add", "reduce_max": "max", "reduce_min": "min", "reduce_or": "or",
    "reduce_and": "and",
}  # fmt: skip
KIND_BY_DTYPE = {"f": "f", "i": "i", "u": "i", "b": "b"}


@dataclasses.dataclass(frozen=True)
class ConstantArray:
    """Array that is known when the program is written.

    Attributes:
        value: The array.
        at_point: Whether it depends on the position of a point, which differs between variants.
    """

    value: NDArray
    at_point: bool = False


@dataclasses.dataclass(frozen=True)
class ParameterArray:
    """Array that is known with the parameters.

    Attributes:
        number: Index of the value in the `ParameterProgram`.
        sparse: Whether kernels leave out elements that are 0.
        change: Whether it is a derivative.
    """

    number: int
    sparse: bool = False
    change: bool = False


Value = ConstantArray | ParameterArray | NDArray  # an array of nodes


class JaxprTranslator:
    """Translator of jaxprs into one graph.

    Families override `translate_special` and `translate_lookup`.
    """

    def __init__(self, graph: Graph, host: ParameterProgram):
        self.graph, self.host = graph, host
        self.changes: set[Node] = set()  # numbers that are derivatives

    def translate_special(self, eqn: Any, values: list[Value]) -> NDArray | None:
        """Translate an equation in a family's own way; return None to translate it as usual."""
        return None

    def translate_lookup(self, found: NDArray, kind: str) -> NDArray:
        """Translate elements that were looked up by a `ConstantArray` at a point.

        Args:
            found: Nodes of the elements, of any shape.
            kind: Kind of number, as of `Node.kind`.

        Returns:
            Nodes, of the same shape.

        Raises:
            TranslationError: The family has no such look-ups.
        """
        raise TranslationError("a look-up at a place")

    def run(self, closed: Any, values: list[Value]) -> list[Value]:
        """Translate a closed jaxpr.

        Args:
            closed: The jaxpr.
            values: Values of its arguments.

        Returns:
            Values of its results.

        Raises:
            TranslationError: An operation cannot be translated.
        """
        jaxpr = closed.jaxpr
        known: dict[Any, Value] = dict(zip(jaxpr.invars, values, strict=True))
        for var, const in zip(jaxpr.constvars, closed.consts, strict=True):
            known[var] = ConstantArray(np.asarray(const))

        def of(atom: Any) -> Value:
            return ConstantArray(np.asarray(atom.val)) if hasattr(atom, "val") else known[atom]

        for eqn in jaxpr.eqns:
            made = self._equation(eqn, [of(a) for a in eqn.invars])
            known |= dict(zip(eqn.outvars, made, strict=True))
        return [of(a) for a in jaxpr.outvars]

    def nodes(self, value: Value) -> NDArray:
        """Return a value as an array of nodes."""
        if isinstance(value, np.ndarray):
            return value
        number = value.number if isinstance(value, ParameterArray) else None
        array = value.value if isinstance(value, ConstantArray) else self.host.values[value.number]
        out = np.empty(array.shape, object)
        sparse = isinstance(value, ParameterArray) and value.sparse
        if number is not None and sparse:
            self.host.zeros[number] = array == 0
        for flat, place in enumerate(np.ndindex(*array.shape)):
            if number is None or (sparse and array[place] == 0):
                out[place] = self.graph.constant(array[place])
            else:
                kind = KIND_BY_DTYPE[array.dtype.kind]
                node = self.graph.node("number", (number, flat), kind, Level.HOST)
                if isinstance(value, ParameterArray) and value.change:
                    self.changes.add(node)
                out[place] = node
        return out

    def _equation(self, eqn: Any, values: list[Value]) -> list[Value]:
        called = called_jaxpr(eqn)
        chosen = values[0] if eqn.primitive.name == "cond" else None
        if isinstance(chosen, ConstantArray):
            called, values = eqn.params["branches"][int(chosen.value)], values[1:]
        if called is not None:
            return self.run(called, values)
        if all(isinstance(v, ConstantArray) for v in values):
            at_point = any(v.at_point for v in values if isinstance(v, ConstantArray))
            arrays = [v.value for v in values if isinstance(v, ConstantArray)]
            return [ConstantArray(made, at_point) for made in evaluate_equation(eqn, arrays)]
        if all(isinstance(v, ConstantArray | ParameterArray) for v in values):
            if not any(isinstance(v, ConstantArray) and v.at_point for v in values):
                return self._of_parameters(eqn, values)
        if eqn.primitive.name in ("split", "unstack"):
            return self.split_array(eqn, values[0])
        return [self._symbolic(eqn, values)]

    def split_array(self, eqn: Any, value: Value) -> list[Value]:
        """Split an array along an axis.

        Args:
            eqn: The equation, with the axis and the sizes.
            value: The array.

        Returns:
            The parts.
        """
        sizes = eqn.params.get("sizes", [1] * len(eqn.outvars))
        parts = np.split(self.nodes(value), np.cumsum(sizes)[:-1], eqn.params["axis"])
        return [part.reshape(var.aval.shape) for part, var in zip(parts, eqn.outvars, strict=True)]

    def _of_parameters(self, eqn: Any, values: list[Any]) -> list[Value]:
        arguments = [v.number if isinstance(v, ParameterArray) else v.value for v in values]
        numbers = self.host.add(eqn, arguments)
        known = [v for v in values if isinstance(v, ParameterArray)]
        sparse, change = any(v.sparse for v in known), any(v.change for v in known)
        out: list[Value] = []
        for number in numbers:
            if self.host.values[number].dtype == bool:
                self.host.conditions.append(number)
                out.append(ConstantArray(self.host.values[number]))
            else:
                real = self.host.values[number].dtype.kind == "f"  # places have no derivatives
                out.append(ParameterArray(number, sparse, change and real))
        return out

    def _symbolic(self, eqn: Any, values: list[Value]) -> NDArray:
        name = eqn.primitive.name
        kind = KIND_BY_DTYPE.get(eqn.outvars[0].aval.dtype.kind)
        if kind is None or len(eqn.outvars) > 1:
            raise TranslationError(f"the operation {name!r}")
        own = self.translate_special(eqn, values)
        if own is not None:
            return own
        if name in ("gather", "dynamic_slice"):
            return self._lookup(eqn, values, kind)
        if name == "scatter":
            return self._set(eqn, values)
        moved = move_elements(eqn, [self.nodes(v) for v in values])
        if moved is not None:
            return moved
        if name in OPERATION_BY_REDUCTION:
            return self.reduce_axes(
                OPERATION_BY_REDUCTION[name],
                self.nodes(values[0]),
                list(map(int, eqn.params["axes"])),
            )
        if name == "argmax":
            return self._argmax(self.nodes(values[0]), int(eqn.params["axes"][0]))
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
        if name in ELEMENTWISE_FUNCTIONS:
            return apply(name.removesuffix("_any"), tuple(args), kind)
        raise TranslationError(f"the operation {name!r}")

    def _power(self, base: Node, exponent: int) -> Node:
        one = self.graph.constant(1.0)
        if exponent < 0:
            base = self.graph.apply("div", (one, base), "f")
        power = base if exponent else one
        for _ in range(abs(exponent) - 1):
            power = self.graph.apply("mul", (power, base), "f")
        return power

    def reduce_axes(self, op: str, array: NDArray, axes: list[int]) -> NDArray:
        """Reduce axes of an array by an operation on two nodes.

        Args:
            op: Name of the operation, such as "add".
            array: Array of nodes.
            axes: The axes.

        Returns:
            Array of nodes, without these axes.
        """
        for axis in sorted(axes, reverse=True):
            parts = np.moveaxis(array, axis, 0)
            total = parts[0]
            for part in parts[1:]:
                pairs = zip(np.ravel(total), np.ravel(part), strict=True)
                folded = [self.graph.apply(op, pair, pair[0].kind) for pair in pairs]
                total = np.array(folded, object).reshape(np.shape(part))
            array = np.asarray(total, object)
        return array

    def _argmax(self, array: NDArray, axis: int) -> NDArray:
        """Return the index of the largest element along an axis, the first of equal ones.

        Args:
            array: Array of nodes.
            axis: The axis.

        Returns:
            Array of nodes of integers, without the axis.
        """
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
        """Multiply two arrays, and sum over the axes that both share.

        Args:
            eqn: Equation of the primitive dot_general.
            left: Array of nodes.
            right: Array of nodes.

        Returns:
            Array of nodes: the free axes of `left`, then those of `right`.
        """
        ((of_left, of_right), (batch_left, batch_right)) = eqn.params["dimension_numbers"]
        if batch_left or batch_right:
            raise TranslationError("a product of batches of matrices")
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
        return self.reduce_axes("add", out, list(range(len(shared))))

    def _set(self, eqn: Any, values: list[Value]) -> NDArray:
        """Replace single elements of an array, at known places.

        Args:
            eqn: The equation.
            values: The array, the places and the new elements.

        Returns:
            The nodes of the new array.

        Raises:
            TranslationError: The places depend on data.
        """
        numbers, places = eqn.params["dimension_numbers"], values[1]
        if not isinstance(places, ConstantArray) or numbers.update_window_dims or places.at_point:
            raise TranslationError("elements set at places of data")
        out, new = self.nodes(values[0]).copy(), self.nodes(values[2])
        order = numbers.scatter_dims_to_operand_dims
        for place in np.ndindex(*new.shape):
            out[tuple(int(places.value[place][order.index(k)]) for k in range(out.ndim))] = new[
                place
            ]
        return out

    def _lookup(self, eqn: Any, values: list[Value], kind: str) -> NDArray:
        table, *places = values
        if all(isinstance(p, ConstantArray) for p in places):
            entries = [p.value for p in places if isinstance(p, ConstantArray)]
            found = move_elements(eqn, [self.nodes(table), *entries])
            assert found is not None
            if not any(p.at_point for p in places if isinstance(p, ConstantArray)):
                return found
            return self.translate_lookup(found, kind)
        if eqn.primitive.name == "gather" and isinstance(table, ParameterArray):
            index, sizes = self.nodes(places[0]), eqn.params["slice_sizes"]
            size = self.host.values[table.number].shape[-1]
            if index.shape[-1:] == (1,) and sizes == (1,):
                return self._table_entries(table, index[..., 0], kind)
            numbers = eqn.params["dimension_numbers"]
            whole = sizes[1:] == (1,) and numbers.start_index_map == (1,)
            if index.shape[-1:] == (1,) and whole and len(numbers.offset_dims) == 1:
                rows = [self._table_row(table, k, size) for k in range(sizes[0])]
                found = [self._table_entries(row, index[..., 0], kind) for row in rows]
                return np.stack(found, numbers.offset_dims[0])
        raise TranslationError("a look-up with an index of data")

    def _table_entries(self, table: ParameterArray, index: NDArray, kind: str) -> NDArray:
        """Look up entries of a table of one axis by an index of data.

        Args:
            table: The table.
            index: Array of nodes.
            kind: Type of the entries.

        Returns:
            Array of nodes, in the shape of `index`.
        """
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

    def _table_row(self, table: ParameterArray, row: int, size: int) -> ParameterArray:
        """Cut a row out of a table.

        Args:
            table: Two-dimensional value of the host.
            row: Number of the row.
            size: Length of a row.

        Returns:
            The row, a further value of the host.
        """
        out = [types.SimpleNamespace(aval=self.host.values[table.number])]
        cut = {"start_indices": (row, 0), "limit_indices": (row + 1, size), "strides": None}
        number = table.number
        for name, params in (("slice", cut), ("reshape", {"new_sizes": (size,)})):
            what = types.SimpleNamespace(name=name)
            eqn = types.SimpleNamespace(primitive=what, params=params, outvars=out)
            (number,) = self.host.add(eqn, [number])
        return dataclasses.replace(table, number=number)


class ElementTranslator(JaxprTranslator):
    """Translator of functions with one axis of elements; with `single`, of one element only."""

    def __init__(self, graph: Graph, host: ParameterProgram, single: bool):
        super().__init__(graph, host)
        self.single = single

    def _equation(self, eqn: Any, values: list[Value]) -> list[Value]:
        name = eqn.primitive.name
        if any(
            isinstance(v, ConstantArray) and ELEMENT_AXIS_LENGTH in v.value.shape for v in values
        ):
            raise TranslationError("a table of elements")
        marked = [ELEMENT_AXIS_LENGTH in np.shape(v.aval) for v in (*eqn.invars, *eqn.outvars)]
        if name in ("split", "unstack") and any(marked):
            raise TranslationError("a split of elements")
        if name == "iota" and any(marked) and not self.single:
            return [self._element_numbers(eqn)]
        return super()._equation(_with_one_element(eqn) if any(marked) else eqn, values)

    def _element_numbers(self, eqn: Any) -> NDArray:
        """Return the elements' own numbers, from 0 on."""
        shape, along = eqn.params["shape"], eqn.params["dimension"]
        if shape[along] != ELEMENT_AXIS_LENGTH:
            raise TranslationError("a table of elements")
        number = self.graph.input("element", "i", Level.ELEMENT)
        return np.full(
            [1 if size == ELEMENT_AXIS_LENGTH else size for size in shape], number, object
        )

    def translate_special(self, eqn: Any, values: list[Value]) -> NDArray | None:
        name = eqn.primitive.name
        along = getattr(eqn, "along", ())
        if not along:
            return None
        if name == "dot_general":
            return self._reduce_product(eqn, values)
        if name not in (*OPERATION_BY_REDUCTION, "argmax"):
            raise TranslationError(f"the operation {name!r} over elements")
        array = self.nodes(values[0])
        if not self.single:
            out = np.empty(array.shape, object)
            for place in np.ndindex(*array.shape):
                out[place] = self._reduce(name, array[place])
            array = out
        elif name == "argmax":
            array = np.full(array.shape, self.graph.constant(0), object)
        axes = [int(a) for a in eqn.params["axes"] if a not in along]
        if axes:
            array = self.reduce_axes(OPERATION_BY_REDUCTION[name], array, axes)
            along = [a - sum(b < a for b in axes) for a in along]
        return array.squeeze(tuple(along))

    def _reduce_product(self, eqn: Any, values: list[Value]) -> NDArray:
        """Translate a matrix product that sums over elements.

        Args:
            eqn: The equation.
            values: Both matrices.

        Returns:
            The nodes of the product.
        """
        product = self._dot(eqn, *(self.nodes(v) for v in values))
        if self.single:
            return product
        out = np.empty(product.shape, object)
        for place in np.ndindex(*product.shape):
            out[place] = self._reduce("reduce_sum", product[place])
        return out

    def _reduce(self, name: str, node: Node) -> Node:
        """Return a node for a reduction over all elements."""
        apply = self.graph.apply
        if name in ("reduce_max", "reduce_min") and node.level < Level.ELEMENT:
            return node
        if name == "reduce_sum":
            factor, rest = self._split_factors(node)
            if rest is None:
                factor, rest = None, node
            total = self._reduction("total", rest)
            return total if factor is None else apply("mul", (factor, total), node.kind)
        if name == "reduce_max":
            return self._reduction("largest", node)
        if name == "reduce_min":
            return apply(
                "neg", (self._reduction("largest", apply("neg", (node,), node.kind)),), "f"
            )
        if name == "argmax":
            return self._reduction("place", node)
        one = node if name == "reduce_or" else apply("not", (node,), "b")
        count = self._reduction("total", apply("to_f", (one,), "f"))
        how = "ne" if name == "reduce_or" else "eq"
        return apply(how, (count, self.graph.constant(0.0)), "b")

    def _reduction(self, op: str, node: Node) -> Node:
        kind = "i" if op == "place" else node.kind
        return self.graph.node(op, (node,), kind, Level.POINT)

    def _split_factors(self, node: Node) -> tuple[Node | None, Node | None]:
        """Split a product into its scalar factors and the others, which are summed."""
        apply = self.graph.apply
        if node.level < Level.ELEMENT:
            return node, None
        if node.op == "mul":
            (a, left), (b, right) = (self._split_factors(part) for part in node.args)
            return self._multiply(a, b), self._multiply(left, right)
        if node.op == "div" and node.args[1].level < Level.ELEMENT:
            factor, rest = self._split_factors(node.args[0])
            one = self.graph.constant(1.0) if factor is None else factor
            return apply("div", (one, node.args[1]), "f"), rest
        return None, node

    def _multiply(self, a: Node | None, b: Node | None) -> Node | None:
        if a is None or b is None:
            return b if a is None else a
        return self.graph.apply("mul", (a, b), a.kind)


def _with_one_element(eqn: Any) -> Any:
    """Return an equation with one element for `ELEMENT_AXIS_LENGTH`.

    `along` are the axes that it reduces.
    """
    name, p = eqn.primitive.name, dict(eqn.params)
    shapes = [np.shape(v.aval) for v in eqn.invars]
    if name == "slice":
        for axis, size in enumerate(shapes[0]):
            given = p["start_indices"][axis], p["limit_indices"][axis]
            if size == ELEMENT_AXIS_LENGTH and (
                given != (0, ELEMENT_AXIS_LENGTH) or (p["strides"] or [1] * 9)[axis] != 1
            ):
                raise TranslationError("single elements")
    if name == "concatenate" and any(
        shape[p["dimension"]] == ELEMENT_AXIS_LENGTH for shape in shapes
    ):
        raise TranslationError("elements joined to others")
    if name in ("gather", "scatter", "dynamic_slice", "rev", "pad", "sort"):
        table = shapes[0] if name != "gather" else ()
        if any(ELEMENT_AXIS_LENGTH in shape for shape in (table, *shapes[1:])):
            raise TranslationError(f"the operation {name!r} over elements")
    if name == "dot_general" and np.shape(eqn.outvars[0].aval).count(ELEMENT_AXIS_LENGTH) > 1:
        raise TranslationError("a matrix product of elements with elements")
    for key in SHAPE_VALUED_PARAMETERS:
        if key in p and p[key] is not None:
            p[key] = tuple(1 if size == ELEMENT_AXIS_LENGTH else size for size in p[key])
    axes = p["dimension_numbers"][0][0] if name == "dot_general" else p.get("axes", ())
    along = [int(a) for a in axes if shapes and shapes[0][a] == ELEMENT_AXIS_LENGTH]
    outs = [
        types.SimpleNamespace(
            aval=types.SimpleNamespace(
                shape=tuple(1 if size == ELEMENT_AXIS_LENGTH else size for size in v.aval.shape),
                dtype=v.aval.dtype,
            )
        )
        for v in eqn.outvars
    ]
    return types.SimpleNamespace(
        primitive=eqn.primitive, params=p, invars=eqn.invars, outvars=outs, along=along
    )


@dataclasses.dataclass(frozen=True)
class TracedFunction:
    """Expressions of a function: its results by name."""

    results: dict[str, Node]

    def phases(self) -> dict[Node, int]:
        """Return the number of loops after which each node is known."""
        found: dict[Node, int] = {}
        for node in find_dependencies([*self.results.values()]):
            arguments = [found[a] for a in node.args if isinstance(a, Node)]
            found[node] = max(arguments, default=0) + (node.op in ELEMENT_REDUCTIONS)
        return found


@dataclasses.dataclass(frozen=True)
class TracedProgram:
    """Expressions of the functions of a family, and the places of their numbers.

    Attributes:
        functions: The functions by name.
        host: Numbers that are known with the parameters.
        layout: Places of the numbers.
        dtype: Type of real numbers.
    """

    functions: dict[str, TracedFunction]
    host: ParameterProgram
    layout: Any
    dtype: np.dtype


def named_leaves(name: str, tree: Any) -> dict[str, Any]:
    """Return the leaves of a tree of arrays or shapes, by their names in kernels.

    Args:
        name: Name of the tree.
        tree: The tree.

    Returns:
        The leaves, by name.
    """
    found = jax.tree_util.tree_flatten_with_path(tree)[0]
    return {name + jax.tree_util.keystr(path): leaf for path, leaf in found}


def number_names(name: str, leaf: Any, elements: bool = True) -> list[str]:
    """Return the names of a leaf's single numbers.

    Args:
        name: Name of the leaf.
        leaf: Array, or shape.
        elements: Whether an axis of elements counts once.
    """
    shape = [1 if size == ELEMENT_AXIS_LENGTH and elements else size for size in np.shape(leaf)]
    return [f"{name}.{k}" for k in range(int(np.prod(shape)))]


@dataclasses.dataclass(frozen=True)
class TracedJaxpr:
    """Jaxpr of a function of parameters and named inputs.

    Attributes:
        jaxpr: The jaxpr.
        inputs: Shapes of the inputs beside the parameters, by name.
        outputs: Shapes of the outputs, by name.
    """

    jaxpr: Any
    inputs: dict[str, jax.ShapeDtypeStruct]
    outputs: dict[str, jax.ShapeDtypeStruct]

    def translate(self, translation: JaxprTranslator, values: list[Value]) -> dict[str, Node]:
        """Translate the function for values of its parameters and inputs: results by name."""
        made = iter(translation.run(self.jaxpr, values))
        results: dict[str, Node] = {}
        for name, leaf in self.outputs.items():
            nodes = np.ravel(translation.nodes(next(made)))
            results |= dict(zip(number_names(name, leaf), nodes, strict=True))
        return results


def trace_function(function: Callable, params: Any, input_trees: Mapping[str, Any]) -> TracedJaxpr:
    """Trace `function(params, **given)`, which returns a dict.

    Args:
        function: A function of pytrees.
        params: Its parameters.
        input_trees: Trees of shapes, by the names of the other arguments.

    Raises:
        TranslationError: The function fails, whatever it raises.
    """
    try:
        call = lambda p, v: function(p, **v)  # noqa: E731
        closed, shapes = jax.make_jaxpr(call, return_shape=True)(params, dict(input_trees))
    except Exception as error:
        about = f"its functions fail for one pixel or target: {error}"
        raise TranslationError(about.partition("\n")[0]) from error
    inputs, outputs = (
        {leaf: v for name in sorted(trees) for leaf, v in named_leaves(name, trees[name]).items()}
        for trees in (input_trees, shapes)
    )
    return TracedJaxpr(closed, inputs, outputs)


def translate_function(
    function: Callable,
    params: Any,
    input_trees: Mapping[str, Any],
    graph: Graph,
    host: ParameterProgram,
    *,
    single: bool = False,
    seeds: int = 0,
    zeros: Collection[str] = (),
) -> TracedFunction:
    """Translate `function(params, **given)`, which returns a dict.

    Args:
        function: A function of pytrees.
        params: Its parameters.
        input_trees: Trees of shapes, by the names of the other arguments; an axis of
            `ELEMENT_AXIS_LENGTH` has elements.
        graph: Graph to which the expressions are added.
        host: Program whose inputs are the leaves of the parameters.
        single: Whether there is one element only.
        seeds: Number of the last leaves of the parameters that are derivatives, mostly 0.
        zeros: Names of single numbers that are always 0.

    Raises:
        TranslationError: There is no translation.
    """
    trace, known = trace_function(function, params, input_trees), len(jax.tree.leaves(params))
    values: list[Value] = [ParameterArray(k, k >= known - seeds) for k in range(known)]
    values += [_inputs(graph, n, leaf, single, zeros) for n, leaf in trace.inputs.items()]
    return TracedFunction(trace.translate(ElementTranslator(graph, host, single), values))


def _inputs(graph: Graph, name: str, leaf: Any, single: bool, zeros: Collection[str]) -> Value:
    shape = tuple(1 if size == ELEMENT_AXIS_LENGTH else size for size in leaf.shape)
    elements = ELEMENT_AXIS_LENGTH in leaf.shape and not single
    level = Level.ELEMENT if elements else Level.POINT
    out = np.empty(shape, object)
    names = iter(number_names(name, leaf))
    for place in np.ndindex(*shape):
        number = next(names)
        none = number in zeros
        kind = KIND_BY_DTYPE[leaf.dtype.kind]
        out[place] = graph.constant(0.0) if none else graph.input(number, kind, level)
    return out
