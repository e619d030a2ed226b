"""The text of a kernel: a method's expressions as functions that numba compiles."""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxevent.kernels.expressions import ELEMENTWISE, Level, Node, Untranslatable, needed, value_of
from jaxevent.kernels.text import FUNCTIONS, Numbers, Place, Writer
from jaxevent.reconstruction.fused.loop import Places
from jaxevent.reconstruction.fused.pixel import ROWS, PixelProgram, pieces

IMAGE_FIELDS = ("grey", "intensity", "certainty", "total")
COUNT_FIELDS = ("span_on", "span_off", "head_on", "head_off", "tail_on", "tail_off")


@dataclasses.dataclass(frozen=True)
class Fields:
    """Where a pixel's numbers lie in `loop.Memory`."""

    cells: dict[str, int]
    whole: dict[str, int]
    slots: dict[int, str]  # field of each slot that is stored
    stride: int
    exposed: bool

    def uniform(self, name: str) -> int | None:
        """The place of a number that is equal for all pixels in `loop.Line.uniform`."""
        offsets = {"gain": 0, "weight_rate": ROWS, "blend_rate": ROWS + pieces(self.exposed)}
        for kind, offset in offsets.items():
            if name.startswith(kind):
                return offset + int(name.removeprefix(kind))
        return None

    def places(self) -> Places:
        """The same for the loop."""

        def of(*names: str) -> NDArray[np.int64]:
            return np.array([self.cells.get(name, -1) for name in names], np.int64)

        def rows(name: str) -> NDArray[np.int64]:
            return of(*(f"{name}{row}" for row in range(ROWS)))

        image = np.stack([rows(name) for name in IMAGE_FIELDS[:3]])

        def pair(name: str) -> NDArray[np.int64]:
            return np.stack([rows(f"{name}_on"), rows(f"{name}_off")])

        span, head, tail = pair("span"), pair("head"), pair("tail")
        total = rows("total")
        every = np.concatenate([image, total[None], span, head, tail])
        order = np.stack([every[:, :-1].T, every[:, 1:].T], -1).reshape(-1, 2)
        shifted = order[(order >= 0).all(1)]
        before = of("before_on", "before_off")
        on, off = self.cells["on"], self.cells["off"]
        return Places(
            self.stride, self.exposed, on, off, before, image, total, span, head, tail, shifted
        )

    @classmethod
    def of(cls, program: PixelProgram, stride: int) -> "Fields":
        cells: dict[str, int] = {}
        whole: dict[str, int] = {}
        for k, kind in enumerate(program.traced.state):
            of_kind = cells if kind.kind == "f" else whole
            of_kind[f"state{k}"] = len(of_kind)
        for name in ("on", "off"):
            cells[name] = len(cells)
        slots, known = {}, {}
        for node in needed(results(program)):
            if node.op == "slot":
                k = node.args[0]
                what = tuple(table[k].number for table in program.tables)
                if node.kind != "f":
                    raise Untranslatable("a table that is not of real numbers")
                if what not in known:
                    known[what] = f"slot{k}"
                    cells[f"slot{k}"] = len(cells)
                slots[k] = known[what]
        wanted = set().union(*map(_inputs, program.start))
        for k in slots:
            wanted |= _inputs([table[k] for table in program.tables])
        names = [name for name in ("before_on", "before_off") if _any(wanted, "before")]
        for name in (*IMAGE_FIELDS, *COUNT_FIELDS):
            if _any(wanted, name.partition("_")[0]):
                rows = ROWS - 1 if name.startswith("span") else ROWS
                names += [f"{name}{row}" for row in range(rows)]
        cells |= {name: len(cells) + k for k, name in enumerate(names)}
        return cls(cells, whole, slots, stride, program.traced.exposed)


def results(program: PixelProgram) -> list[Node]:
    return [*program.after, program.image, program.variance]


def _any(names: set[str], beginning: str) -> bool:
    return any(name.startswith(beginning) for name in names)


def _inputs(nodes: list[Node]) -> set[str]:
    return {n.args[0] for n in needed(nodes) if n.op == "input"}


class PixelWriter(Writer):
    """Writes expressions of a pixel whose numbers lie in `loop.Memory`."""

    def __init__(self, fields: Fields):
        super().__init__()
        self.fields = fields

    def place(self, node: Node) -> Place | None:
        fields = self.fields
        if node.op not in ("input", "slot"):
            return None
        name = fields.slots[node.args[0]] if node.op == "slot" else node.args[0]
        for pointer, known in (("cells", fields.cells), ("whole", fields.whole)):
            if name in known:
                return pointer, "z", known[name] * fields.stride
        uniform = fields.uniform(name)
        return None if uniform is None else ("uniform", "at", uniform)

    def input(self, node: Node) -> str:
        name = node.args[0]
        points = ("since", "near", "polarity", "weight", "blend", "share", "edge")
        if name in (*points, "segment_on", "segment_off"):
            return name.removeprefix("segment_")
        raise Untranslatable(f"the use of {name!r}")


@dataclasses.dataclass(frozen=True)
class Source:
    """A kernel's text, and what its numbers are."""

    text: str
    fields: Fields
    numbers: Numbers


HEAD = '''"""The functions of a kernel (`jaxevent.reconstruction.fused`)."""

import numpy as np
from numba import types

from jaxevent.kernels.blocks import block
from jaxevent.kernels.kept import callback
{imports}

REAL, STRIDE = np.{real}, {stride}
I, D, F = types.int64, types.float64, types.{real}
CELLS, WHOLE, TIMES = types.CPointer(F), types.CPointer(I), types.CPointer(D)
MARKS = types.CPointer(types.uint8)
HOW = {{"error_model": "numpy", "fastmath": {{"contract"}}}}
{constants}

'''

EVENTS = """
@callback(I(CELLS, WHOLE, TIMES, WHOLE, CELLS, I, I, I, I, I, I, I, D, D, D, D, CELLS), **HOW)
def events(
    cells, whole, last, stream, weights, weighted, i, end, till, first_own, last_own, padded,
    begin, rate, mid, blend_rate, numbers,
):
    while i < end:
        event = stream[i]
        now = event >> 17
        if now >= till:
            break
        z = (event >> 1) & 0xFFFF
        t = np.float64(now)
        if first_own <= z and z < last_own:
            # The last event of the 3x3 neighbourhood.
            a, b, c = last[z - padded - 1], last[z - padded], last[z - padded + 1]
            d, e, f = last[z - 1], last[z], last[z + 1]
            g, h, k = last[z + padded - 1], last[z + padded], last[z + padded + 1]
            a = a if a > b else b
            c = c if c > d else d
            g = g if g > h else h
            k = k if k > f else f
            a = a if a > c else c
            g = g if g > k else k
            a = a if a > g else g
            since = REAL((t - e) * 1e-6)
            near = REAL((t - (a if a > e else e)) * 1e-6)
            weight, blend = REAL((t - begin) * rate), REAL((t - mid) * blend_rate)
            up = event & 1
            polarity = 2 * up - 1
{step}
            one = weights[i] if weighted else REAL(1)
            cells[({off} + up * ({on} - {off})) * STRIDE + z] += one
        last[z] = t
        i += 1
    return i
"""

IMAGES = """
@callback(
    types.void(CELLS, WHOLE, TIMES, I, I, I, D, D, D, CELLS, CELLS, CELLS, MARKS, I), **HOW
)
def images(
    cells, whole, last, rows, width, padded, now, weight64, blend64, numbers, mean, variance, valid,
    at,
):
    weight, blend = REAL(weight64), REAL(blend64)
    for row in range(rows):
        for column in range(width):
            z = (row + 1) * padded + 1 + column
            t = now - last[z]
            since = REAL((t if t > 0 else 0.0) * 1e-6)
{show}
            mean[at + row * width + column] = {image}
            variance[at + row * width + column] = {variance}
            valid[at + row * width + column] = np.uint8(abs({image}) < REAL(np.inf))
"""

TABLES = """
@callback(types.void(I, CELLS, I, I, CELLS, CELLS, I), **HOW)
def tables(variant, cells, begin, end, numbers, uniform, at):
"""

EXCESS = """
@callback(F(D, D, F, F, CELLS), **HOW)
def excess(share64, edge64, on, off, numbers):
    share, edge = REAL(share64), REAL(edge64)
{lines}
    return {result}
"""


def write(program: PixelProgram, stride: int) -> Source:
    """The kernel of a program, in which bands have room for `stride` pixels."""
    if any(n.level == Level.PIECE for n in needed(results(program))):
        raise Untranslatable("a number of the piece that is not looked up at a point")
    fields = Fields.of(program, stride)
    writer = PixelWriter(fields)
    cells = fields.cells
    parts = [
        EVENTS.format(step=_step(program, writer), on=cells["on"], off=cells["off"]),
        IMAGES.format(
            show=_text(writer.lines([program.image, program.variance], 12)),
            image=writer.name(program.image),
            variance=writer.name(program.variance),
        ),
        _tables(program, writer),
        _excess(program, writer),
    ]
    single = program.traced.dtype == np.float32
    module = "jaxevent.kernels.numeric"
    names = ", ".join(f"{n}{32 if single else 64} as {n}" for n in FUNCTIONS)
    numbers, constants = writer.finish(program.host.values)
    head = HEAD.format(
        imports=f"from {module} import {names}",
        real=program.traced.dtype.name,
        stride=stride,
        constants=_text(constants),
    )
    return Source("\n".join([head.rstrip(), "", *parts]), fields, numbers)


def _text(lines: list[str]) -> str:
    return "\n".join(lines)


def _step(program: PixelProgram, writer: PixelWriter) -> str:
    """The state of the pixel at z after an event."""
    fields, out = writer.fields, writer.lines(program.after, 12)
    for k, node in enumerate(program.after):
        if node.op == "input" and node.args == (f"state{k}",):
            continue
        array = "cells" if f"state{k}" in fields.cells else "whole"
        place = (fields.cells if array == "cells" else fields.whole)[f"state{k}"]
        out.append(f"            {array}[{place} * STRIDE + z] = {writer.name(node)}")
    return _text(out)


def _tables(program: PixelProgram, writer: PixelWriter) -> str:
    """What a piece says, for the pixels from begin to end."""
    fields = writer.fields
    kept = [k for k, name in fields.slots.items() if name == f"slot{k}"]
    out = [TABLES.rstrip()]
    for variant, table in enumerate(program.tables):
        out.append(f"    if variant == {variant}:")
        out.append("        for z in range(begin, end):")
        out += writer.lines([table[k] for k in kept], 12)
        for k in kept:
            place = fields.cells[f"slot{k}"]
            out.append(f"            cells[{place} * STRIDE + z] = {writer.name(table[k])}")
        out.append("            pass")
    return _text([*out, ""])


def _excess(program: PixelProgram, writer: PixelWriter) -> str:
    if program.excess is None:
        return EXCESS.format(lines="", result="share")
    node = program.excess
    return EXCESS.format(lines=_text(writer.lines([node], 4)), result=writer.name(node))


# The state at the start is found once, for all pixels, by the same operations of NumPy.
ARRAYS: dict[str, Callable[..., Any]] = {
    **ELEMENTWISE,
    "div": np.divide,
    "select_n": lambda c, a, b: np.where(c, b, a),
    "to_f": lambda x: np.asarray(x, float),
    "to_i": lambda x: np.asarray(x).astype(int),
    "to_b": lambda x: np.asarray(x) != 0,
}


def evaluate_arrays(
    nodes: list[Node], known: Callable[[str], Any], values: list[Any], dtype: np.dtype
) -> list[Any]:
    """Expressions for arrays in place of numbers; `known(name)` gives inputs."""
    found: dict[Node, Any] = {}
    with np.errstate(all="ignore"):
        for node in needed(nodes):
            if node.op == "constant":
                value = value_of(node)
            elif node.op == "input":
                value = known(node.args[0])
            elif node.op == "number":
                value = np.ravel(values[node.args[0]])[node.args[1]]
            elif node.op == "entry":
                array = values[node.args[0]]
                value = array[np.clip(found[node.args[1]], 0, len(array) - 1)]
            else:
                value = ARRAYS[node.op](*(found[a] for a in node.args))
            found[node] = np.asarray(value, dtype) if node.kind == "f" else np.asarray(value)
    return [found[node] for node in nodes]
