"""Text of a module of functions, from expressions; numba compiles it.

numba takes milliseconds for every operation of a function, LLVM a tenth of that. So straight lines
of arithmetic are written as an `arithmetic_block`: one operation for numba, with a tuple of
results, which gives its lines to LLVM without inference of types. A line of a block is

    v7:f = mul v1 v2

with the kind of its result: f a real number, i an integer, b a truth value. Operands are names of
the block, or constants with their kind: `f:0.5`, `i:3`, `b:True`. `read cells z 3` is
`cells[z + 3]`. `number k` reads number k of the parameters, `entry k n v2` number v2 (between 0 and
n) of a table that begins at k.
"""

import dataclasses
import re
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.codegen.graph import Level, Node, TranslationError, find_dependencies
from jaxevent.codegen.support import intrinsic, ir, types
from jaxevent.codegen.trace import ELEMENT_REDUCTIONS, TracedFunction

# Texts of operations that no block has.
PYTHON_EXPRESSIONS = {
    "pow": "{0} ** {1}",
    "rem": "np.fmod({0}, {1})",
    "sign": "np.sign({0})",
    "round": "np.rint({0})",
    "atan2": "np.arctan2({0}, {1})",
    **{name: f"np.{name}({{0}})" for name in ("abs", "expm1", "tanh")},
}
# Functions of `functions`.
CALLED_FUNCTION_NAMES = ("exp", "log", "log1p", "logistic", "sin", "cos", "erf", "erfc")

Address = tuple[str, str, int]  # pointer, index and offset: pointer[index + offset]

MODULE_HEAD_TEMPLATE = '''"""{about}"""

import numba
import numpy as np
from numba import types

from jaxevent.codegen.cache import cfunc
from jaxevent.codegen.derivative import make_vector_sums
from jaxevent.codegen.functions import {functions}
from jaxevent.codegen.write import arithmetic_block

REAL = np.{real}
I, D, F = types.int64, types.float64, types.{real}
CELLS, WHOLE, NUMBERS = types.CPointer(F), types.CPointer(I), types.CPointer(D)
MARKS = types.CPointer(types.uint8)
OPTIONS = {{"error_model": "numpy", "fastmath": {{"contract"}}}}
LOOP_OPTIONS = {{"error_model": "numpy", "fastmath": {{"contract", "reassoc", "nsz", "arcp"}}}}
{constants}


'''


@dataclasses.dataclass(frozen=True)
class ParameterLayout:
    """Places of parameters among the numbers that a module's functions take.

    Attributes:
        begins: Place of an element of a host value, or of all of it, by index and element.
        vectors: Place, and the index and element of a host value that is added there.
        size: Number of numbers.
        dtype: Type of the numbers.
    """

    begins: dict[tuple[int, int | None], int]
    vectors: list[tuple[int, int, int]]
    size: int
    dtype: np.dtype

    def gather(self, values: list[NDArray]) -> NDArray:
        """Gather the numbers that the functions take from the values of a `ParameterProgram`."""
        out = np.zeros(self.size, self.dtype)
        for (value, element), at in self.begins.items():
            if element is None:
                out[at : at + len(values[value])] = values[value]
            else:
                out[at] = np.ravel(values[value])[element]
        for at, value, element in self.vectors:
            out[at] += np.ravel(values[value])[element]
        return out


class ModuleText(NamedTuple):
    """The text of a module, with the places of its data.

    Attributes:
        text: The text.
        parameters: Places of parameters.
        places: Places where the functions find their data.
    """

    text: str
    parameters: ParameterLayout
    places: Any


@dataclasses.dataclass(frozen=True)
class ElementLoop:
    """Text of a loop over elements.

    Attributes:
        index: Name of the index.
        count: Number of elements, as text.
        arguments: Names of the arguments of the function with the loop.
    """

    index: str
    count: str
    arguments: tuple[str, ...]


class ModuleWriter:
    """Writer of the functions of one module.

    Args:
        program: A traced program: its `host` has the values of parameters, its `dtype` is that of
            real numbers.
        addresses: Where each input lies, or a text that reads it, by its name.
    """

    def __init__(self, program: Any, addresses: Mapping[Any, str | Address]):
        self.program, self.addresses = program, addresses
        self.loops: list[str] = []  # functions of one loop each
        self.constants: list[str] = []  # lines that define what functions use
        self._blocks: list[str] = []
        self._begins: dict[tuple[int, int | None], int] = {}
        self._vectors: list[tuple[int, int, int]] = []
        self._size = 0

    def write_lines(
        self, nodes: list[Node], indent: int, known: set[Node] | None = None
    ) -> list[str]:
        """Write the lines that compute nodes.

        Args:
            nodes: The nodes, which are known by their names afterwards.
            indent: Spaces before each line.
            known: Nodes that are known by their names before.

        Returns:
            The lines.
        """
        known = set() if known is None else known
        return self.write_assignments(
            [n for n in find_dependencies(nodes, known) if n not in known], nodes, indent
        )

    def write_assignments(
        self, nodes: Iterable[Node], wanted: Iterable[Node], indent: int
    ) -> list[str]:
        """Write the lines that compute some nodes.

        An operation that is no plain arithmetic, such as a logarithm, is a line of its own between
        two blocks.

        Args:
            nodes: All nodes that the wanted ones depend on and that are not known.
            wanted: Nodes that are used afterwards.
            indent: Spaces before each line.

        Returns:
            The lines.
        """
        order = sorted((n for n in nodes if n.op != "constant"), key=lambda n: n.number)
        wanted = set(wanted)
        turn: dict[Node, int] = {}  # of lines, and of the block after them
        for node in order:
            before = [turn.get(a, 0) for a in node.args if isinstance(a, Node)]
            turn[node] = max(before, default=0) + (bool(before) and not self._is_in_block(node))
        last, out = max(turn.values(), default=0), []
        for now in range(last + 1):
            mine = [n for n in order if turn[n] == now]
            inside = [n for n in mine if self._is_in_block(n)]
            outside = [n for n in mine if not self._is_in_block(n)]
            out += [f"{self.node_name(n)} = {self._text(n)}" for n in outside]
            later = {a for n in order if turn[n] > now for a in n.args if isinstance(a, Node)}
            if inside:
                out.append(self._block(inside, [n for n in inside if n in later or n in wanted]))
        return [f"{' ' * indent}{line}" for line in out]

    def node_name(self, node: Node) -> str:
        """Return the name of a node in the text; of a constant, its value."""
        if node.op != "constant":
            return f"v{node.number}"
        text = node.args[0]
        special = {"inf": "np.inf", "-inf": "-np.inf", "nan": "np.nan"}
        return text if node.kind != "f" else f"REAL({special.get(text, text)})"

    def write_body(
        self,
        name: str,
        function: TracedFunction,
        store: Mapping[str, str],
        loop: ElementLoop | None = None,
        indent: int = 4,
    ) -> list[str]:
        """Write the lines of a function.

        Args:
            name: Name of the function, with which those of its loops begin.
            function: The function; results that are not stored are not computed.
            store: Texts "target = {}" by the results' names.
            loop: How its loops over elements are written.
            indent: Spaces before each line.

        Returns:
            The lines.
        """
        wanted = {key: node for key, node in function.results.items() if key in store}
        # An element may have a result that is the same for all.
        index = None if loop is None else re.compile(rf"\b{loop.index}\b")
        per_element = {key for key in wanted if index is not None and index.search(store[key])}
        phases = TracedFunction(wanted).phases()
        last = max((phases[n] for n in wanted.values()), default=0)
        scalars = [n for n in phases if n.level < Level.ELEMENT and n.op not in ELEMENT_REDUCTIONS]
        out, known = [], set[Node]()
        for phase in range(last + 1):
            now = [n for n in scalars if phases[n] <= phase and n not in known]
            used = {a for n in phases if n not in now for a in n.args if isinstance(a, Node)}
            out += self.write_assignments(now, used | {*wanted.values()}, indent)
            known |= set(now)
            reduced = [n for n in phases if n.op in ELEMENT_REDUCTIONS and phases[n] == phase + 1]
            elements = {}
            if phase == last:
                elements = {store[key]: wanted[key] for key in wanted if key in per_element}
            if reduced or elements:
                assert loop is not None
                call = self._loop(f"{name}_{phase}", reduced, elements, known, loop)
                out.append(" " * indent + call)
                known |= set(reduced)
        for key, node in wanted.items():
            if key not in per_element:
                out.append(f"{' ' * indent}{store[key].format(self.node_name(node))}")
        return out

    def write_branches(
        self,
        first: Node,
        cases: list[tuple[str, dict[str, Node]]],
        store: Mapping[str, str],
        indent: int = 4,
    ) -> list[str]:
        """Write the lines of a function without loops, some results of which depend on the case.

        Args:
            first: What decides between the cases.
            cases: Lines such as "if {}:", which may name `first`, and what is computed then.
            store: Texts "target = {}" by the results' names.
            indent: Spaces before each line.
        """
        known = set(find_dependencies([first]))
        used = {node for _, case in cases for node in find_dependencies([*case.values()], known)}
        out, margin = self.write_assignments(known, {first} | (known & used), indent), " " * indent
        for line, case in cases:
            out.append(margin + line.format(self.node_name(first)))
            out += self.write_lines([*case.values()], indent + 4, set(known))
            for key, node in case.items():
                out.append(f"{margin}    {store[key].format(self.node_name(node))}")
        return out

    def add_vector(self, lanes: int, elements: Mapping[int, list[Node]]) -> int:
        """Add a vector of numbers of parameters, and return where it begins.

        Args:
            lanes: Numbers of the vector.
            elements: Nodes "number" by the lane in which they are added up.
        """
        begin, self._size = self._size, self._size + lanes
        for lane, nodes in elements.items():
            self._vectors += [(begin + lane, *node.args) for node in nodes]
        return begin

    def write_module(
        self, about: str, functions: list[str], places: Any, numbers: Any = np.float64
    ) -> ModuleText:
        """Write the module of some functions.

        Args:
            about: The module's docstring.
            functions: The texts of the functions.
            places: Where the functions find their data.
            numbers: Kind of the numbers of parameters.
        """
        dtype = self.program.dtype
        head = MODULE_HEAD_TEMPLATE.format(
            about=about,
            functions=", ".join(
                f"{name}{8 * dtype.itemsize} as {name}" for name in CALLED_FUNCTION_NAMES
            ),
            real=dtype.name,
            constants="\n".join([*self._blocks, *self.constants]),
        )
        layout = ParameterLayout(self._begins, self._vectors, self._size, np.dtype(numbers))
        return ModuleText(head + "".join([*self.loops, *functions]), layout, places)

    def _address(self, node: Node) -> Address | None:
        """Return where an input lies; None for all that is no input or is read by a text."""
        found = self.addresses.get(node.args[0]) if node.op in ("input", "slot") else None
        return None if isinstance(found, str) else found

    def _is_in_block(self, node: Node) -> bool:
        if node.op in ("number", "entry") or self._address(node) is not None:
            return True
        operands = [a for a in node.args if isinstance(a, Node)]
        return bool(operands) and node.op in BLOCK_OPERATIONS[operands[0].kind]

    def _block(self, nodes: list[Node], results: list[Node]) -> str:
        """Define the block of some nodes, and write the line that calls it.

        Args:
            nodes: The nodes.
            results: Those that are used outside the block.

        Returns:
            The line.
        """
        made, given, lines = set(nodes), dict[str, str](), []
        for node in nodes:
            what, address = [node.op], self._address(node)
            if address is not None:
                what = ["read", *map(str, address)]
                given |= {address[0]: "p", address[1]: "i"}
            elif node.op in ("number", "entry"):
                given["numbers"] = "p"
                what += map(str, self._parameter(node))
            for a in (a for a in node.args if isinstance(a, Node)):
                constant = a.op == "constant"
                what.append(f"{a.kind}:{a.args[0]}" if constant else self.node_name(a))
                if a not in made and not constant:
                    given[self.node_name(a)] = a.kind
            lines.append(f"{self.node_name(node)}:{node.kind} = {' '.join(what)}")
        name, names = f"block{len(self._blocks)}", [self.node_name(n) for n in results]
        arguments = " ".join(f"{argument}:{kind}" for argument, kind in given.items())
        text = "\n".join(lines)
        self._blocks.append(
            f'{name} = arithmetic_block(F, "{arguments}", """\n{text}\n""", "{" ".join(names)}")'
        )
        return f"{', '.join(names)} = {name}(({', '.join(given)},))"

    def _parameter(self, node: Node) -> tuple[int, ...]:
        """Return the place of a number of parameters; of a table, where it begins, and its last."""
        value, element = node.args[0], node.args[1] if node.op == "number" else None
        count = 1 if node.op == "number" else len(self.program.host.values[value])
        if (value, element) not in self._begins:
            self._begins[value, element] = self._size
            self._size += count
        begin = self._begins[value, element]
        return (begin,) if node.op == "number" else (begin, count - 1)

    def _text(self, node: Node) -> str:
        """Return the lines of the nodes that no block computes."""
        found = self.addresses.get(node.args[0]) if node.op == "input" else None
        if isinstance(found, str):
            return found
        names = [self.node_name(a) for a in node.args if isinstance(a, Node)]
        if node.op in CALLED_FUNCTION_NAMES:
            return f"{node.op}({names[0]})"
        if node.op in PYTHON_EXPRESSIONS:
            return PYTHON_EXPRESSIONS[node.op].format(*names)
        about = f"use of {node.args[0]!r}" if node.op == "input" else f"operation {node.op!r}"
        raise TranslationError(f"the {about}")

    def _loop(
        self,
        name: str,
        reduced: list[Node],
        elements: dict[str, Node],
        known: set[Node],
        loop: ElementLoop,
    ) -> str:
        """Define a function of one loop, and write the line that calls it."""
        results = [n.args[0] for n in reduced] + [*elements.values()]
        rest = find_dependencies(results, known)
        given = [n for n in rest if n in known and n.op != "constant"]
        arguments = ", ".join([*loop.arguments, *(self.node_name(n) for n in given)])
        out = ["@numba.njit(**LOOP_OPTIONS)", f"def {name}({arguments}):"]
        for node in reduced:
            start = {"total": "REAL(0)", "largest": "-REAL(np.inf)", "place": "0"}[node.op]
            out.append(f"    r{node.number} = {start}")
            if node.op == "place":
                out.append(f"    m{node.number} = -REAL(np.inf)")
        out.append(f"    for {loop.index} in range({loop.count}):")
        out += self.write_assignments([n for n in rest if n not in known], results, 8)
        for node in reduced:
            value, r = self.node_name(node.args[0]), f"r{node.number}"
            if node.op == "total":
                out.append(f"        {r} += {value}")
            elif node.op == "largest":
                out.append(f"        {r} = {value} if {value} > {r} else {r}")
            else:
                m = f"m{node.number}"
                out.append(f"        {r} = {loop.index} if {value} > {m} else {r}")
                out.append(f"        {m} = {value} if {value} > {m} else {m}")
        out += [f"        {text.format(self.node_name(node))}" for text, node in elements.items()]
        names = ", ".join(f"r{n.number}" for n in reduced)
        if names:
            out.append(f"    return {names}")
        self.loops.append("\n".join([*out, "", ""]) + "\n")
        targets = ", ".join(self.node_name(n) for n in reduced)
        return f"{targets + ' = ' if names else ''}{name}({arguments})"


COMPARISON_SIGNS = {"lt": "<", "le": "<=", "gt": ">", "ge": ">=", "eq": "=="}
EXTREMUM_SIGNS = {"max": ">", "min": "<"}
REAL_INSTRUCTIONS = {"add": "fadd", "sub": "fsub", "mul": "fmul", "div": "fdiv", "neg": "fneg"}
INTEGER_INSTRUCTIONS = ("add", "sub", "mul", "neg")
LLVM_INTRINSICS = {"abs": "fabs", "sqrt": "sqrt", "floor": "floor", "ceil": "ceil"}  # of LLVM
# Which operations there are, by the kind of what they are applied to.
BLOCK_OPERATIONS = {
    "f": {
        *COMPARISON_SIGNS,
        *EXTREMUM_SIGNS,
        *REAL_INSTRUCTIONS,
        *LLVM_INTRINSICS,
        "ne",
        "rsqrt",
        "is_finite",
        "to_f",
        "to_i",
        "to_b",
    },
    "i": {*COMPARISON_SIGNS, *EXTREMUM_SIGNS, *INTEGER_INSTRUCTIONS, "ne", "to_f", "to_i", "to_b"},
    "b": {"and", "or", "not", "eq", "ne", "select_n", "to_f", "to_i", "to_b"},
}


def arithmetic_block(real: Any, given: str, lines: str, results: str) -> Any:
    """Make an operation for numba: `v7, v9 = operation((numbers, v1, v2))`.

    Args:
        real: numba's type of real numbers.
        given: Names of arguments with their kinds; `numbers:p` is a pointer.
        lines: What is computed, in order.
        results: Names of what is returned; a single one is returned by itself.

    Returns:
        The operation, which compiled functions call.
    """
    arguments = dict(argument.split(":") for argument in given.split())
    program = [line.split(" = ") for line in lines.strip().splitlines()]
    kinds = arguments | dict(place.split(":") for place, _ in program)
    typed = {"f": real, "i": types.int64, "b": types.boolean}
    returned = [typed[kinds[name]] for name in results.split()]
    result = returned[0] if len(returned) == 1 else types.Tuple(returned)

    def make(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        machine = _Machine(context, builder, real)
        stated = signature.args[0]
        for k, (name, kind) in enumerate(arguments.items()):
            value, goal = builder.extract_value(values[0], k), typed.get(kind, stated[k])
            machine.known[name] = context.cast(builder, value, stated[k], goal)
            if kind == "p":
                machine.stored[name] = context.get_value_type(goal.dtype)
        for place, what in program:
            name, kind = place.split(":")
            machine.known[name] = machine.compute(kind, *what.split())
        found = [machine.known[name] for name in results.split()]
        return found[0] if len(found) == 1 else context.make_tuple(builder, result, found)

    @intrinsic
    def operation(context: Any, given: Any) -> tuple[Any, Callable]:
        return result(given), make

    return operation


class _Machine:
    """Makes instructions of LLVM; its methods return values."""

    def __init__(self, context: Any, builder: Any, real: Any):
        self.builder, self.known = builder, dict[str, Any]()
        self.real, self.whole = (context.get_value_type(kind) for kind in (real, types.int64))
        self.truth = context.get_value_type(types.boolean)
        self.stored: dict[str, Any] = {}  # the types of what pointers point to

    def operand(self, text: str) -> Any:
        kind, colon, value = text.partition(":")
        if not colon:
            return self.known[text]
        if kind == "f":
            return ir.Constant(self.real, float(value))
        return ir.Constant(
            *((self.truth, value == "True") if kind == "b" else (self.whole, int(value)))
        )

    def compute(self, kind: str, op: str, *operands: str) -> Any:
        builder = self.builder
        if op == "read":
            at = builder.add(self.operand(operands[1]), ir.Constant(self.whole, int(operands[2])))
            return self._read(operands[0], at, kind)
        if op == "number":
            return self._read("numbers", ir.Constant(self.whole, int(operands[0])), kind)
        if op == "entry":
            return self._entry(int(operands[0]), int(operands[1]), self.operand(operands[2]))
        values = [self.operand(text) for text in operands]
        if op == "select_n":
            return builder.select(values[0], values[2], values[1])
        if op in ("and", "or"):
            return getattr(builder, f"{op}_")(*values)
        if op == "not":
            return builder.not_(values[0])
        if op in ("to_f", "to_i", "to_b"):
            return self._cast(op[-1], values[0])
        if op in COMPARISON_SIGNS or op == "ne":
            return self._compare(COMPARISON_SIGNS.get(op, "!="), *values)
        if op in EXTREMUM_SIGNS:
            return builder.select(self._compare(EXTREMUM_SIGNS[op], *values), *values)
        if values[0].type != self.real:
            return getattr(builder, op)(*values)
        return (
            getattr(builder, REAL_INSTRUCTIONS[op])(*values)
            if op in REAL_INSTRUCTIONS
            else self._library(op, *values)
        )

    def _compare(self, how: str, a: Any, b: Any) -> Any:
        if isinstance(a.type, ir.IntType):
            return self.builder.icmp_signed(how, a, b)
        kind = self.builder.fcmp_unordered if how == "!=" else self.builder.fcmp_ordered
        return kind(how, a, b)

    def _library(self, op: str, value: Any) -> Any:
        builder, name = (
            self.builder,
            LLVM_INTRINSICS.get(op, "fabs" if op == "is_finite" else "sqrt"),
        )
        function = builder.module.declare_intrinsic(f"llvm.{name}", [self.real])
        found = builder.call(function, [value])
        if op == "rsqrt":
            return builder.fdiv(ir.Constant(self.real, 1.0), found)
        if op == "is_finite":
            return builder.fcmp_ordered("<", found, ir.Constant(self.real, float("inf")))
        return found

    def _cast(self, kind: str, value: Any) -> Any:
        builder = self.builder
        goal = {"f": self.real, "i": self.whole, "b": self.truth}[kind]
        if value.type == goal:
            return value
        if kind == "b":
            return self._compare("!=", value, ir.Constant(value.type, 0))
        if kind == "f":
            return (builder.uitofp if value.type == self.truth else builder.sitofp)(value, goal)
        if value.type == self.real:
            return builder.fptosi(value, goal)
        wide = isinstance(value.type, ir.IntType) and value.type.width > 8  # else a truth value
        return (builder.sext if wide else builder.zext)(value, goal)

    def _read(self, pointer: str, at: Any, kind: str) -> Any:
        builder, stored = self.builder, self.stored[pointer]
        place = builder.gep(self.known[pointer], [at], source_etype=stored)
        value = builder.load(place, typ=stored)
        if kind != "f":
            return self._cast(kind, value)
        if stored == self.real:
            return value
        narrower = isinstance(self.real, ir.FloatType)
        return (builder.fptrunc if narrower else builder.fpext)(value, self.real)

    def _entry(self, begin: int, last: int, at: Any) -> Any:
        zero, end = ir.Constant(self.whole, 0), ir.Constant(self.whole, last)
        for how, bound in ((">", zero), ("<", end)):
            at = self.builder.select(self.builder.icmp_signed(how, at, bound), at, bound)
        at = self.builder.add(at, ir.Constant(self.whole, begin))
        return self._read("numbers", at, "f")
