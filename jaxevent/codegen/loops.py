"""Functions of scalars and of one axis of elements, compiled as loops over that axis.

A function is traced with `MARK` elements, whatever their number will be. What is computed element
by element becomes the body of a loop; sums and greatest values over the axis are gathered in it.
What rests on such a sum comes after the loop, and its elements are computed in a loop of their own,
from the inputs: that costs less than keeping them.
"""

import dataclasses
import types
from collections.abc import Callable, Collection, Mapping
from typing import Any, NamedTuple

import jax
import numpy as np
from numpy.typing import NDArray

from jaxevent.codegen.expressions import Graph, Level, Node, Untranslatable, needed
from jaxevent.codegen.host import HostProgram, Programs, once
from jaxevent.codegen.modules import module_of
from jaxevent.codegen.text import Numbers, Place, Writer, import_functions
from jaxevent.codegen.translate import FOLDS, KINDS, Known, OfParameters, Translation, Value

MARK = 7919  # elements in a trace: a prime that no other axis has
GATHERED = ("total", "largest", "place")  # operations over the axis
SHAPES = ("shape", "new_sizes", "sizes", "limit_indices", "slice_sizes")

HEAD = '''"""{about}"""

import numba
import numpy as np
from numba import types

from jaxevent.codegen.blocks import block
from jaxevent.codegen.kept import callback
{imports}

REAL = np.{real}
I, F = types.int64, types.{real}
CELLS, WHOLE, NUMBERS = types.CPointer(F), types.CPointer(I), types.CPointer(types.float64)
HOW = {{"error_model": "numpy", "fastmath": {{"contract"}}}}
LOOP = {{"error_model": "numpy", "fastmath": {{"contract", "reassoc", "nsz", "arcp"}}}}
{constants}


'''


class LoopTranslation(Translation):
    """Translates functions with one axis of elements; with `single`, of one element only."""

    def __init__(self, graph: Graph, host: HostProgram, single: bool):
        super().__init__(graph, host)
        self.single = single

    def _equation(self, eqn: Any, values: list[Value]) -> list[Value]:
        name = eqn.primitive.name
        if any(isinstance(v, Known) and MARK in v.value.shape for v in values):
            raise Untranslatable("a table of elements")
        marked = [MARK in np.shape(v.aval) for v in (*eqn.invars, *eqn.outvars)]
        if name in ("split", "unstack") and any(marked):
            raise Untranslatable("a split of elements")
        if name == "iota" and any(marked) and not self.single:
            return [self._numbers(eqn)]
        return super()._equation(_without_mark(eqn) if any(marked) else eqn, values)

    def _numbers(self, eqn: Any) -> NDArray:
        """The elements' own numbers, from 0 on."""
        shape, along = eqn.params["shape"], eqn.params["dimension"]
        if shape[along] != MARK:
            raise Untranslatable("a table of elements")
        number = self.graph.input("element", "i", Level.ELEMENT)
        return np.full([1 if size == MARK else size for size in shape], number, object)

    def special(self, eqn: Any, values: list[Value]) -> NDArray | None:
        name = eqn.primitive.name
        along = getattr(eqn, "along", ())
        if not along:
            return None
        if name == "dot_general":
            return self._gathered_product(eqn, values)
        if name not in (*FOLDS, "argmax"):
            raise Untranslatable(f"the operation {name!r} over elements")
        array = self.nodes(values[0])
        if not self.single:
            out = np.empty(array.shape, object)
            for place in np.ndindex(*array.shape):
                out[place] = self._gather(name, array[place])
            array = out
        elif name == "argmax":
            array = np.full(array.shape, self.graph.constant(0), object)
        axes = [int(a) for a in eqn.params["axes"] if a not in along]
        if axes:
            array = self.fold(FOLDS[name], array, axes)
            along = [a - sum(b < a for b in axes) for a in along]
        return array.squeeze(tuple(along))

    def _gathered_product(self, eqn: Any, values: list[Value]) -> NDArray:
        """A matrix product that sums over elements."""
        product = self._dot(eqn, *(self.nodes(v) for v in values))
        if self.single:
            return product
        out = np.empty(product.shape, object)
        for place in np.ndindex(*product.shape):
            out[place] = self._gather("reduce_sum", product[place])
        return out

    def _gather(self, name: str, node: Node) -> Node:
        """A node that says something of all elements."""
        apply = self.graph.apply
        if name in ("reduce_max", "reduce_min") and node.level < Level.ELEMENT:
            return node
        if name == "reduce_sum":
            factor, rest = self._factors(node)
            if rest is None:
                factor, rest = None, node
            total = self._reduced("total", rest)
            return total if factor is None else apply("mul", (factor, total), node.kind)
        if name == "reduce_max":
            return self._reduced("largest", node)
        if name == "reduce_min":
            return apply("neg", (self._reduced("largest", apply("neg", (node,), node.kind)),), "f")
        if name == "argmax":
            return self._reduced("place", node)
        one = node if name == "reduce_or" else apply("not", (node,), "b")
        count = self._reduced("total", apply("to_f", (one,), "f"))
        how = "ne" if name == "reduce_or" else "eq"
        return apply(how, (count, self.graph.constant(0.0)), "b")

    def _reduced(self, op: str, node: Node) -> Node:
        kind = "i" if op == "place" else node.kind
        return self.graph.node(op, (node,), kind, Level.POINT)

    def _factors(self, node: Node) -> tuple[Node | None, Node | None]:
        """A product as that of its scalar factors and that of the others, which are summed."""
        apply = self.graph.apply
        if node.level < Level.ELEMENT:
            return node, None
        if node.op == "mul":
            (a, left), (b, right) = (self._factors(part) for part in node.args)
            return self._times(a, b), self._times(left, right)
        if node.op == "div" and node.args[1].level < Level.ELEMENT:
            factor, rest = self._factors(node.args[0])
            one = self.graph.constant(1.0) if factor is None else factor
            return apply("div", (one, node.args[1]), "f"), rest
        return None, node

    def _times(self, a: Node | None, b: Node | None) -> Node | None:
        if a is None or b is None:
            return b if a is None else a
        return self.graph.apply("mul", (a, b), a.kind)


def _without_mark(eqn: Any) -> Any:
    """The equation with one element in place of `MARK`; `along` are the axes it folds them on."""
    name, p = eqn.primitive.name, dict(eqn.params)
    shapes = [np.shape(v.aval) for v in eqn.invars]
    if name == "slice":
        for axis, size in enumerate(shapes[0]):
            given = p["start_indices"][axis], p["limit_indices"][axis]
            if size == MARK and (given != (0, MARK) or (p["strides"] or [1] * 9)[axis] != 1):
                raise Untranslatable("single elements")
    if name == "concatenate" and any(shape[p["dimension"]] == MARK for shape in shapes):
        raise Untranslatable("elements joined to others")
    if name in ("gather", "scatter", "dynamic_slice", "rev", "pad", "sort"):
        table = shapes[0] if name != "gather" else ()
        if any(MARK in shape for shape in (table, *shapes[1:])):
            raise Untranslatable(f"the operation {name!r} over elements")
    if name == "dot_general" and np.shape(eqn.outvars[0].aval).count(MARK) > 1:
        raise Untranslatable("a matrix product of elements with elements")
    for key in SHAPES:
        if key in p and p[key] is not None:
            p[key] = tuple(1 if size == MARK else size for size in p[key])
    axes = p["dimension_numbers"][0][0] if name == "dot_general" else p.get("axes", ())
    along = [int(a) for a in axes if shapes and shapes[0][a] == MARK]
    outs = [
        types.SimpleNamespace(
            aval=types.SimpleNamespace(
                shape=tuple(1 if size == MARK else size for size in v.aval.shape),
                dtype=v.aval.dtype,
            )
        )
        for v in eqn.outvars
    ]
    return types.SimpleNamespace(
        primitive=eqn.primitive, params=p, invars=eqn.invars, outvars=outs, along=along
    )


@dataclasses.dataclass(frozen=True)
class Function:
    """A function as expressions: its results by name."""

    results: dict[str, Node]

    def phases(self) -> dict[Node, int]:
        """After how many loops each node is known."""
        found: dict[Node, int] = {}
        for node in needed([*self.results.values()]):
            arguments = [found[a] for a in node.args if isinstance(a, Node)]
            found[node] = max(arguments, default=0) + (node.op in GATHERED)
        return found


@dataclasses.dataclass(frozen=True)
class Program:
    """The functions of a family: expressions, and what their numbers are."""

    functions: dict[str, Function]
    host: HostProgram
    layout: Any  # where the numbers lie
    dtype: np.dtype


def leaves_of(name: str, tree: Any) -> dict[str, Any]:
    """The leaves of a tree of arrays or shapes, by the names that kernels know them by."""
    found = jax.tree_util.tree_flatten_with_path(tree)[0]
    return {name + jax.tree_util.keystr(path): leaf for path, leaf in found}


def numbers_of(name: str, leaf: Any, elements: bool = True) -> list[str]:
    """The names of a leaf's single numbers; an axis of elements counts once."""
    shape = [1 if size == MARK and elements else size for size in np.shape(leaf)]
    return [f"{name}.{k}" for k in range(int(np.prod(shape)))]


def translate(
    function: Callable,
    params: Any,
    given: Mapping[str, Any],
    graph: Graph,
    host: HostProgram,
    single: bool = False,
    seeds: int = 0,
    zeros: Collection[str] = (),
) -> Function:
    """`function(params, **given)`, which returns a dict; raises `Untranslatable`.

    `given` are trees of shapes by name. Arrays with an axis of `MARK` are elements. `host` has the
    leaves of the parameters as its inputs; the last `seeds` are derivatives, mostly 0.
    `zeros` are names of single numbers that are always 0.
    """
    try:
        call = lambda p, v: function(p, **v)  # noqa: E731
        closed, shape = jax.make_jaxpr(call, return_shape=True)(params, dict(given))
    except Exception as error:  # whatever a function raises
        about = f"its functions fail in a trace: {error}"
        raise Untranslatable(about.partition("\n")[0]) from error
    known = len(jax.tree.leaves(params))
    values: list[Value] = [OfParameters(k, k >= known - seeds) for k in range(known)]
    for name in sorted(given):
        for leaf_name, leaf in leaves_of(name, given[name]).items():
            values.append(_inputs(graph, leaf_name, leaf, single, zeros))
    translation = LoopTranslation(graph, host, single)
    made = iter(translation.run(closed, values))
    results: dict[str, Node] = {}
    for name in sorted(shape):
        for leaf_name, leaf in leaves_of(name, shape[name]).items():
            nodes = np.ravel(translation.nodes(next(made)))
            results |= dict(zip(numbers_of(leaf_name, leaf), nodes, strict=True))
    return Function(results)


def _inputs(graph: Graph, name: str, leaf: Any, single: bool, zeros: Collection[str]) -> Value:
    shape = tuple(1 if size == MARK else size for size in leaf.shape)
    elements = MARK in leaf.shape and not single
    level = Level.ELEMENT if elements else Level.POINT
    out = np.empty(shape, object)
    names = iter(numbers_of(name, leaf))
    for place in np.ndindex(*shape):
        number = next(names)
        none = number in zeros
        kind = KINDS[leaf.dtype.kind]
        out[place] = graph.constant(0.0) if none else graph.input(number, kind, level)
    return out


class LoopWriter(Writer):
    """Writes functions whose inputs a family knows by their names.

    Numbers of parameters are in double precision.

    Args:
        places: Where an input lies, or a text that reads it.
    """

    def __init__(self, places: Mapping[str, str | Place]):
        super().__init__()
        self.places = places
        self.loops: list[str] = []  # functions of one loop each

    def place(self, node: Node) -> Place | None:
        found = self.places.get(node.args[0]) if node.op == "input" else None
        return None if isinstance(found, str) else found

    def _number(self, key: tuple[int, int], kind: str) -> str:
        text = super()._number(key, kind)
        return f"REAL({text})" if kind == "f" else text

    def input(self, node: Node) -> str:
        found = self.places.get(node.args[0])
        return found if isinstance(found, str) else super().input(node)

    def body(
        self,
        name: str,
        function: Function,
        store: Mapping[str, str],
        loop: "Loop",
        indent: int = 4,
    ) -> list[str]:
        """The lines of a function; `store` are texts "target = {}" by the results' names."""
        wanted = {key: node for key, node in function.results.items() if key in store}
        phases = Function(wanted).phases()
        last = max((phases[n] for n in wanted.values()), default=0)
        scalars = [n for n in phases if n.level < Level.ELEMENT and n.op not in GATHERED]
        out, known = [], set[Node]()
        for phase in range(last + 1):
            now = [n for n in scalars if phases[n] <= phase and n not in known]
            used = {a for n in phases if n not in now for a in n.args if isinstance(a, Node)}
            out += self.assign(now, used | {*wanted.values()}, indent)
            known |= set(now)
            gathered = [n for n in phases if n.op in GATHERED and phases[n] == phase + 1]
            elements = {}
            if phase == last:
                elements = {store[key]: n for key, n in wanted.items() if n.level == Level.ELEMENT}
            if gathered or elements:
                out += self._loop(f"{name}_{phase}", gathered, elements, known, loop, indent)
                known |= set(gathered)
        for key, node in wanted.items():
            if node.level < Level.ELEMENT:
                out.append(f"{' ' * indent}{store[key].format(self.name(node))}")
        return out

    def branches(
        self,
        first: Node,
        cases: list[tuple[str, dict[str, Node]]],
        store: Mapping[str, str],
        indent: int = 4,
    ) -> list[str]:
        """The lines of a function without loops, some results of which are computed in some cases.

        `cases` are lines such as "if {}:", which may name `first`, and what is computed then.
        """
        known = set(needed([first]))
        used = {node for _, case in cases for node in needed([*case.values()], known)}
        out, margin = self.assign(known, {first} | (known & used), indent), " " * indent
        for line, case in cases:
            out.append(margin + line.format(self.name(first)))
            out += self.lines([*case.values()], indent + 4, set(known))
            for key, node in case.items():
                out.append(f"{margin}    {store[key].format(self.name(node))}")
        return out

    def _loop(
        self,
        name: str,
        gathered: list[Node],
        elements: dict[str, Node],
        known: set[Node],
        loop: "Loop",
        indent: int,
    ) -> list[str]:
        """A function of one loop, and the line that calls it."""
        results = [n.args[0] for n in gathered] + [*elements.values()]
        rest = needed(results, known)
        given = [n for n in rest if n in known and n.op != "constant"]
        arguments = ", ".join([*loop.arguments, *(self.name(n) for n in given)])
        out = ["@numba.njit(**LOOP)", f"def {name}({arguments}):"]
        for node in gathered:
            start = {"total": "REAL(0)", "largest": "-REAL(np.inf)", "place": "0"}[node.op]
            out.append(f"    r{node.number} = {start}")
            if node.op == "place":
                out.append(f"    m{node.number} = -REAL(np.inf)")
        out.append(f"    for {loop.index} in range({loop.count}):")
        out += self.assign([n for n in rest if n not in known], results, 8)
        for node in gathered:
            value, r = self.name(node.args[0]), f"r{node.number}"
            if node.op == "total":
                out.append(f"        {r} += {value}")
            elif node.op == "largest":
                out.append(f"        {r} = {value} if {value} > {r} else {r}")
            else:
                m = f"m{node.number}"
                out.append(f"        {r} = {loop.index} if {value} > {m} else {r}")
                out.append(f"        {m} = {value} if {value} > {m} else {m}")
        out += [f"        {text.format(self.name(node))}" for text, node in elements.items()]
        names = [f"r{n.number}" for n in gathered]
        if names:
            out.append(f"    return {', '.join(names)}")
        self.loops.append("\n".join([*out, "", ""]))
        call = f"{name}({arguments})"
        targets = ", ".join(self.name(n) for n in gathered)
        return [f"{' ' * indent}{targets + ' = ' if names else ''}{call}"]

    def module(self, about: str, program: Program, functions: list[str]) -> tuple[str, Numbers]:
        """The text of a module of functions, and what its numbers are."""
        numbers, constants = self.finish(program.host.values)
        head = HEAD.format(
            about=about,
            imports=import_functions(program.dtype),
            real=program.dtype.name,
            constants="\n".join(constants),
        )
        return head + "".join([*self.loops, *functions]), numbers


@dataclasses.dataclass(frozen=True)
class Loop:
    """How a loop over elements is written."""

    index: str
    count: str
    arguments: tuple[str, ...]  # of the function that holds it


class Compiled(NamedTuple):
    """A program's compiled functions, with the numbers of parameters."""

    program: Any
    functions: Any
    numbers: NDArray[np.float64]


class Kernels:
    """A family's compiled programs: one for each way that conditions on parameters choose.

    Args:
        functions: A named tuple of the functions that a module has.
        write: Writes the text of a program's module.
        most: Nodes of a program: beyond, numba compiles longer than XLA's scan takes.
    """

    def __init__(
        self, functions: Any, write: Callable[[Any], tuple[str, Numbers]], most: int
    ) -> None:
        self.functions, self.write, self.most = functions, write, most
        self._made: dict[Any, Programs] = {}

    def get(self, key: Any, params: Any, translate: Callable[[], Any]) -> Compiled:
        """What is compiled for parameters; `key` names all that `translate` rests on beside them.

        Raises `Untranslatable`.
        """
        given = [np.asarray(leaf) for leaf in jax.tree.leaves(params)]
        programs = once(self._made, key, Programs)
        program, (numbers, functions), values = programs.get(given, translate, self._compile)
        return Compiled(program, functions, numbers.of(values, np.dtype(float)))

    def _compile(self, program: Any) -> tuple[Numbers, Any]:
        nodes = needed([n for f in program.functions.values() for n in f.results.values()])
        if len(nodes) > self.most:
            raise Untranslatable(f"more than {self.most} operations")
        text, numbers = self.write(program)
        module = module_of(text)
        names = self.functions._fields
        return numbers, self.functions(*(getattr(module, name) for name in names))
