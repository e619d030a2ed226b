"""The text of a kernel: a method's expressions as functions that numba compiles."""

import dataclasses
import functools
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxevent.codegen.expressions import ELEMENTWISE, Level, Node, Untranslatable, needed, value_of
from jaxevent.codegen.text import Numbers, Place, Writer, import_functions
from jaxevent.reconstruction.engine.entering import Places
from jaxevent.reconstruction.engine.pixel import ROWS, PixelProgram, pieces

IMAGE_FIELDS = ("grey", "intensity", "certainty")
COUNT_FIELDS = ("span_on", "span_off", "head_on", "head_off", "tail_on", "tail_off")


@dataclasses.dataclass(frozen=True)
class Fields:
    """Where a pixel's numbers lie in `loop.Memory`.

    Behind the fields of all pixels each pixel has a record of the vectors of its derivatives.
    """

    cells: dict[str, int]
    whole: dict[str, int]
    slots: dict[int, str]  # field of each slot that is stored
    vectors: dict[int, int]  # which of `Slopes.changes` lie in the record, and where
    record: int  # numbers
    factors: int  # of derivatives of images
    changes: int  # numbers that tables write into records
    sums: int  # over segments of exposures
    stride: int
    exposed: bool

    @property
    def size(self) -> int:
        """The numbers of all pixels of a band."""
        return (len(self.cells) + self.record) * self.stride

    def text(self, name: str) -> str:
        """Where a field of the pixel z lies."""
        array, place = ("whole", self.whole) if name in self.whole else ("cells", self.cells)
        return f"{array}[{place[name]} * STRIDE + z]"

    def of_bands(self, name: str, cells: NDArray, whole: NDArray) -> NDArray:
        """A field's numbers in `loop.Memory`, [bands, stride]."""
        array, place = (whole, self.whole) if name in self.whole else (cells, self.cells)
        return array[:, place[name] * self.stride : (place[name] + 1) * self.stride]

    def records(self, cells: NDArray) -> NDArray:
        """The pixels' records in `loop.Memory`, [bands, stride, record]."""
        return cells[:, len(self.cells) * self.stride :].reshape(len(cells), self.stride, -1)

    def uniform(self, name: str) -> int | None:
        """The place of a number that is equal for all pixels in `loop.Line.uniform`."""
        offsets = {"gain": 0, "weight_rate": ROWS, "blend_rate": ROWS + pieces(self.exposed)}
        for kind, offset in offsets.items():
            if name.startswith(kind):
                return offset + int(name.removeprefix(kind))
        return None

    @functools.cached_property
    def places(self) -> Places:
        """The same for the loop."""

        def of(*names: str) -> NDArray[np.int64]:
            return np.array([self.cells.get(name, -1) for name in names], np.int64)

        def rows(name: str, end: str = "") -> NDArray[np.int64]:
            return of(*(f"{name}{row}{end}" for row in range(ROWS)))

        image = np.stack([rows(name) for name in IMAGE_FIELDS])

        def pair(name: str) -> NDArray[np.int64]:
            return np.stack([rows(f"{name}_on"), rows(f"{name}_off")])

        span, head, tail = pair("span"), pair("head"), pair("tail")
        total = np.full((self.sums, ROWS), -1)
        for k in range(self.sums):
            total[k] = rows("total", f"_{k}")
        every = np.concatenate([image, total, span, head, tail])
        order = np.stack([every[:, :-1].T, every[:, 1:].T], -1).reshape(-1, 2)
        shifted = order[(order >= 0).all(1)]
        before = of("before_on", "before_off")
        on, off = self.cells["on"], self.cells["off"]
        return Places(
            self.stride,
            self.factors,
            self.changes * BLOCK,
            on,
            off,
            before,
            image,
            total,
            span,
            head,
            tail,
            shifted,
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
        vectors, directions = {}, program.traced.directions
        lanes = directions.lanes
        if program.slopes is not None:
            kinds = [change.kind for change in program.slopes.changes]
            for k in (k for k, kind in enumerate(kinds) if kind != "number"):
                vectors[k] = len(vectors) * lanes
        wanted = set().union(*(_inputs([*start.values()]) for start in program.start))
        for variant, table in enumerate(program.tables):
            wanted |= _inputs([table[k] for k in slots])
            wanted |= _inputs([node for *_, node in table_changes(program, variant)])
        names = [name for name in ("before_on", "before_off") if _any(wanted, "before")]
        for name in (*IMAGE_FIELDS, *COUNT_FIELDS):
            if _any(wanted, name.partition("_")[0]):
                rows = ROWS - 1 if name.startswith("span") else ROWS
                names += [f"{name}{row}" for row in range(rows)]
        sums = len(program.excess)
        names += [f"total{row}_{k}" for k in range(sums) for row in range(ROWS)]
        cells |= {name: len(cells) + k for k, name in enumerate(names)}
        factors = [] if program.slopes is None else program.slopes.factors_of(*directions.of)
        return cls(
            cells, whole, slots, vectors, len(vectors) * lanes, len(factors),
            len(table_changes(program, 0)), sums, stride, program.traced.exposed,
        )  # fmt: skip


def results(program: PixelProgram) -> list[Node]:
    """What is computed at a point."""
    slopes = program.slopes
    factors = [] if slopes is None else slopes.factors_of(*slopes.factors)
    return [*program.after, program.image, program.variance, *factors]


def table_changes(program: PixelProgram, variant: int) -> list[tuple[int, int, Node]]:
    """What a piece tells of derivatives: places in `Slopes.changes`, directions, expressions."""
    changes = [] if program.slopes is None else program.slopes.changes
    return [
        (k, lane, nodes[variant])
        for k, change in enumerate(changes)
        if change.kind == "table"
        for lane, nodes in change.nodes.items()
    ]


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
    vectors: dict[int, list[tuple[int, int, int]]]  # value, place in it, lane; by where they begin
    lanes: int
    outputs: tuple[str, ...]  # of "mean" and "variance", of which there are derivatives
    states: dict[int, int]  # places of vectors in the record, by the leaf of the state

    def values(self, values: list[NDArray], dtype: np.dtype) -> NDArray:
        """The numbers that the text's functions take, from the values of a host program."""
        out = np.zeros(self.numbers.size + len(self.vectors) * self.lanes, dtype)
        out[: self.numbers.size] = self.numbers.of(values, dtype)
        for at, parts in self.vectors.items():
            for number, place, lane in parts:
                out[at + lane] += np.ravel(values[number])[place]
        return out


HEAD = '''"""The functions of a kernel (`jaxevent.reconstruction.engine`)."""

import numpy as np
from numba import types

from jaxevent.codegen.blocks import block
from jaxevent.codegen.kept import callback
{imports}
from jaxevent.codegen.linear import vector_sums

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
    types.void(
        CELLS, WHOLE, TIMES, I, I, I, D, D, D, CELLS, CELLS, CELLS, MARKS, CELLS, CELLS, I, I
    ),
    **HOW
)
def images(
    cells, whole, last, rows, width, padded, now, weight64, blend64, numbers, mean, variance, valid,
    slopes, room, size, at,
):
    weight, blend = REAL(weight64), REAL(blend64)
    for row in range(rows):
        # A loop of its own, so that the next one takes twice as many numbers at once.
        for column in range(width):
            t = now - last[(row + 1) * padded + 1 + column]
            room[{since} * width + column] = REAL((t if t > 0 else 0.0) * 1e-6)
        for column in range(width):
            z = (row + 1) * padded + 1 + column
            since = room[{since} * width + column]
{show}
            mean[at + row * width + column] = {image}
            variance[at + row * width + column] = {variance}
            valid[at + row * width + column] = np.uint8(abs({image}) < REAL(np.inf))
{slopes}
"""

TABLES = """
@callback(types.void(I, CELLS, I, I, CELLS, CELLS, I, CELLS), **HOW)
def tables(variant, cells, begin, end, numbers, uniform, at, room):
"""
BLOCK = 256  # pixels whose derivatives are computed side by side before they go into records

EXCESS = """
@callback(types.void(D, D, F, F, CELLS, CELLS), **HOW)
def excess(share64, edge64, on, off, numbers, out):
    share, edge = REAL(share64), REAL(edge64)
{lines}
"""


def write(program: PixelProgram, stride: int) -> Source:
    """The kernel of a program, in which bands have room for `stride` pixels."""
    if any(n.level == Level.PIECE for n in needed(results(program))):
        raise Untranslatable("a number of the piece that is not looked up at a point")
    fields = Fields.of(program, stride)
    writer = PixelWriter(fields)
    sums = _Sums(program, writer)
    parts = [_events(program, writer, sums), _images(program, writer, sums)]
    parts += [_tables(program, writer), _excess(program, writer)]
    numbers, constants = writer.finish(program.host.values)
    constants += sums.lines(numbers.size)
    head = HEAD.format(
        imports=import_functions(program.traced.dtype),
        real=program.traced.dtype.name,
        stride=stride,
        constants=_text(constants),
    )
    text = "\n".join([head.rstrip(), "", *parts])
    states = {int(name[5:]): fields.vectors[k] for name, k in sums.states.items()}
    vectors = sums.vectors(numbers.size)
    return Source(text, fields, numbers, vectors, sums.lanes, sums.outputs, states)


def _text(lines: list[str]) -> str:
    return "\n".join(lines)


class _Sums:
    """The sums of vectors by which derivatives follow events, and of which images are made."""

    def __init__(self, program: PixelProgram, writer: PixelWriter):
        self.slopes, self.writer, self.vectors_at = program.slopes, writer, writer.fields.vectors
        self.lanes = program.traced.directions.lanes
        changes = [] if self.slopes is None else self.slopes.changes
        self.states = {f"state{c.state}": k for k, c in enumerate(changes) if c.kind == "state"}
        self.numbers = [k for k, change in enumerate(changes) if change.kind == "number"]
        self.outputs = () if self.slopes is None else program.traced.directions.of

    def factors(self, names: Iterable[str]) -> list[Node]:
        """The factors of some results, each once."""
        return [] if self.slopes is None else self.slopes.factors_of(*names)

    def lines(self, numbers: int) -> list[str]:
        """What the text says of them; vectors of numbers lie behind the `numbers`."""
        if self.slopes is None:
            return []
        fields, slopes, out = self.writer.fields, self.slopes, []
        beside = {k: numbers + i * self.lanes for i, k in enumerate(self.numbers)}
        out.append(f"RECORDS, RECORD = {len(fields.cells)} * STRIDE, {fields.record}")
        stores = {
            "follow": {name: fields.vectors[k] for name, k in self.states.items()},
            "show": {name: k * self.lanes for k, name in enumerate(self.outputs)},
        }
        for function, places in stores.items():
            order = {node: k for k, node in enumerate(self.factors(places))}
            sums = []
            for name, place in places.items():
                terms = tuple(
                    (order[node], k in beside, beside.get(k, fields.vectors.get(k)))
                    for node, k in slopes.factors[name]
                )
                sums.append((place, terms))
            out.append(f"{function} = vector_sums({self.lanes}, {tuple(sums)})")
        return out

    def vectors(self, numbers: int) -> dict[int, list[tuple[int, int, int]]]:
        """What the vectors of numbers hold, by where they begin."""
        found = {}
        for i, k in enumerate(self.numbers):
            assert self.slopes is not None
            found[numbers + i * self.lanes] = [
                (*node.args, lane)
                for lane, nodes in self.slopes.changes[k].nodes.items()
                for node in nodes
            ]
        return found


def _events(program: PixelProgram, writer: PixelWriter, sums: _Sums) -> str:
    fields, factors = writer.fields, sums.factors(sums.states)
    out = writer.lines([*program.after, *factors], 12)
    for k, node in enumerate(program.after):
        if node.op != "input" or node.args != (f"state{k}",):
            out.append(f"            {fields.text(f'state{k}')} = {writer.name(node)}")
    if sums.states:
        given = "".join(f"{writer.name(node)}, " for node in factors)
        out.append("            record = RECORDS + z * RECORD")
        out.append(f"            follow(cells, record, cells, record, numbers, ({given}))")
    return EVENTS.format(step=_text(out), on=fields.cells["on"], off=fields.cells["off"])


def _images(program: PixelProgram, writer: PixelWriter, sums: _Sums) -> str:
    """Images, and row by row, after the factors of their derivatives, these."""
    factors, slopes = sums.factors(sums.outputs), []
    lines = writer.lines([program.image, program.variance, *factors], 12)
    if sums.outputs:
        lines += [
            f"            room[{k} * width + column] = {writer.name(node)}"
            for k, node in enumerate(factors)
        ]
        given = "".join(f"room[{k} * width + column], " for k in range(len(factors)))
        slopes = [
            "        for column in range(width):",
            "            record = RECORDS + ((row + 1) * padded + 1 + column) * RECORD",
            "            place = (at + row * width + column) * size",
            f"            show(slopes, place, cells, record, numbers, ({given}))",
        ]
    return IMAGES.format(
        since=len(factors),
        show=_text(lines),
        image=writer.name(program.image),
        variance=writer.name(program.variance),
        slopes=_text(slopes),
    )


def _tables(program: PixelProgram, writer: PixelWriter) -> str:
    """What a piece says, for the pixels from begin to end."""
    fields = writer.fields
    kept = [k for k, name in fields.slots.items() if name == f"slot{k}"]
    out = [TABLES.rstrip(), f"    for first in range(begin, end, {BLOCK}):"]
    out.append(f"        pixels = min(end - first, {BLOCK})")
    for variant, table in enumerate(program.tables):
        changes = table_changes(program, variant)
        out.append(f"        if variant == {variant}:")
        out += ["            for i in range(pixels):", "                z = first + i"]
        out += writer.lines([*(table[k] for k in kept), *(node for *_, node in changes)], 16)
        for k in kept:
            out.append(f"                {fields.text(f'slot{k}')} = {writer.name(table[k])}")
        for j, (*_, node) in enumerate(changes):
            out.append(f"                room[{j * BLOCK} + i] = {writer.name(node)}")
    if changes:
        out.append("        for i in range(pixels):")
        out.append("            record = RECORDS + (first + i) * RECORD")
    for j, (k, lane, _) in enumerate(changes):
        place = f"record + {fields.vectors[k] + lane}"
        out.append(f"            cells[{place}] = room[{j * BLOCK} + i]")
    return _text([*out, ""])


def _excess(program: PixelProgram, writer: PixelWriter) -> str:
    lines = writer.lines(program.excess, 4)
    lines += [f"    out[{k}] = {writer.name(node)}" for k, node in enumerate(program.excess)]
    return EXCESS.format(lines=_text(lines))


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
