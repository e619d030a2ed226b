"""Straight lines of arithmetic as one operation, given to LLVM without numba's inference of types.

numba takes milliseconds for every operation of a function, LLVM a tenth of that. So `text` writes
operations as a block of lines, which numba sees as one with a tuple of results. A line is

    v7:f = mul v1 v2

with the kind of its result: f a real number, i an integer, b a truth value. Operands are names of
the block, or constants with their kind: `f:0.5`, `i:3`, `b:True`. `read cells z 3` is
`cells[z + 3]`. `number k` reads number k of the parameters, `entry k n v2` number v2 (between 0 and
n) of a table that begins at k.
"""

from collections.abc import Callable
from typing import Any

from jaxevent.codegen.support import intrinsic, ir, types

ORDERED = {"lt": "<", "le": "<=", "gt": ">", "ge": ">=", "eq": "=="}
CHOICES = {"max": ">", "min": "<"}
REAL = {"add": "fadd", "sub": "fsub", "mul": "fmul", "div": "fdiv", "neg": "fneg"}
WHOLE = ("add", "sub", "mul", "neg")
LIBRARY = {"abs": "fabs", "sqrt": "sqrt", "floor": "floor", "ceil": "ceil"}  # of LLVM
# Which operations there are, by the kind of what they are applied to.
OPERATIONS = {
    "f": {*ORDERED, *CHOICES, *REAL, *LIBRARY, "ne", "rsqrt", "is_finite", "to_f", "to_i", "to_b"},
    "i": {*ORDERED, *CHOICES, *WHOLE, "ne", "to_f", "to_i", "to_b"},
    "b": {"and", "or", "not", "eq", "ne", "select_n", "to_f", "to_i", "to_b"},
}


def block(real: Any, given: str, lines: str, results: str) -> Any:
    """An operation for numba: `v7, v9 = operation((numbers, v1, v2))`; of one result, that alone.

    Args:
        real: numba's type of real numbers.
        given: Names of arguments with their kinds; `numbers:p` is a pointer.
        lines: What is computed, in order.
        results: Names of what is returned.
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
        if op in ORDERED or op == "ne":
            return self._compare(ORDERED.get(op, "!="), *values)
        if op in CHOICES:
            return builder.select(self._compare(CHOICES[op], *values), *values)
        if values[0].type != self.real:
            return getattr(builder, op)(*values)
        return getattr(builder, REAL[op])(*values) if op in REAL else self._library(op, *values)

    def _compare(self, how: str, a: Any, b: Any) -> Any:
        if isinstance(a.type, ir.IntType):
            return self.builder.icmp_signed(how, a, b)
        kind = self.builder.fcmp_unordered if how == "!=" else self.builder.fcmp_ordered
        return kind(how, a, b)

    def _library(self, op: str, value: Any) -> Any:
        builder, name = self.builder, LIBRARY.get(op, "fabs" if op == "is_finite" else "sqrt")
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
