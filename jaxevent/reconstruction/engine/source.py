"""The text of a kernel: a method's expressions as functions that numba compiles."""

import dataclasses
import functools
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxevent.codegen.graph import (
    Level,
    Node,
    TranslationError,
    dependencies,
)
from jaxevent.codegen.write import Address, ModuleText, Writer
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
    states: dict[int, int]  # places of vectors in the record, by the leaf of the state
    outputs: tuple[str, ...]  # of "mean" and "variance", of which there are derivatives
    lanes: int  # numbers of a vector
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

    def of_bands(self, name: str, cells: NDArray, whole: NDArray) -> NDArray:
        """A field's numbers in `loop.Memory`, [bands, stride]."""
        array, place = (whole, self.whole) if name in self.whole else (cells, self.cells)
        return array[:, place[name] * self.stride : (place[name] + 1) * self.stride]

    def records(self, cells: NDArray) -> NDArray:
        """The pixels' records in `loop.Memory`, [bands, stride, record]."""
        return cells[:, len(self.cells) * self.stride :].reshape(len(cells), self.stride, -1)

    def text(self, name: str) -> str:
        """Return the text of a field of the pixel z."""
        array, place = ("whole", self.whole) if name in self.whole else ("cells", self.cells)
        return f"{array}[{place[name]} * STRIDE + z]"

    def addresses(self) -> dict[Any, str | Address]:
        """Return where the inputs of a pixel lie, or texts that read them, by name."""
        uniform = [("gain", ROWS), ("weight_rate", pieces(self.exposed)), ("blend_rate", ROWS)]
        names = [f"{name}{k}" for name, count in uniform for k in range(count)]
        found: dict[Any, str | Address] = {n: ("uniform", "at", k) for k, n in enumerate(names)}
        found |= {name: ("cells", "z", at * self.stride) for name, at in self.cells.items()}
        found |= {name: ("whole", "z", at * self.stride) for name, at in self.whole.items()}
        found |= {slot: found[name] for slot, name in self.slots.items()}
        points = ("since", "near", "polarity", "weight", "blend", "share", "edge")
        found |= {name: name for name in points}
        return found | {"segment_on": "on", "segment_off": "off"}

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
        for node in dependencies(results(program)):
            if node.op == "slot":
                k = node.args[0]
                what = tuple(table[k].number for table in program.tables)
                if node.kind != "f":
                    raise TranslationError("a table that is not of real numbers")
                if what not in known:
                    known[what] = f"slot{k}"
                    cells[f"slot{k}"] = len(cells)
                slots[k] = known[what]
        directions = program.traced.directions
        lanes, slopes = directions.lanes, program.slopes
        changes = [] if slopes is None else slopes.changes
        moved = [k for k, change in enumerate(changes) if change.kind != "number"]
        vectors = {k: i * lanes for i, k in enumerate(moved)}
        states = {changes[k].state: at for k, at in vectors.items() if changes[k].kind == "state"}
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
        outputs = () if slopes is None else directions.of
        factors = [] if slopes is None else slopes.factors_of(*outputs)
        return cls(
            cells, whole, slots, vectors, states, outputs, lanes, len(vectors) * lanes,
            len(factors), len(table_changes(program, 0)), sums, stride, program.traced.exposed,
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
    return {n.args[0] for n in dependencies(nodes) if n.op == "input"}


EVENTS = """
@cfunc(I(CELLS, WHOLE, NUMBERS, WHOLE, CELLS, I, I, I, I, I, I, I, D, D, D, D, CELLS), **OPTIONS)
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
@cfunc(
    types.void(
        CELLS, WHOLE, NUMBERS, I, I, I, D, D, D, CELLS, CELLS, CELLS, MARKS, CELLS, CELLS, I, I
    ),
    **OPTIONS
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
@cfunc(types.void(I, CELLS, I, I, CELLS, CELLS, I, CELLS), **OPTIONS)
def tables(variant, cells, begin, end, numbers, uniform, at, room):
    for first in range(begin, end, 256):
        pixels = min(end - first, 256)
"""
BLOCK = 256  # pixels whose derivatives are computed side by side before they go into records

EXCESS = """
@cfunc(types.void(D, D, F, F, CELLS, CELLS), **OPTIONS)
def excess(share64, edge64, on, off, numbers, out):
    share, edge = REAL(share64), REAL(edge64)
{lines}
"""


def write(program: PixelProgram, stride: int) -> ModuleText:
    """Write the module of a program, in which bands have room for `stride` pixels."""
    if any(n.level == Level.PIECE for n in dependencies(results(program))):
        raise TranslationError("a number of the piece that is not looked up at a point")
    fields = Fields.of(program, stride)
    writer = Writer(program, fields.addresses())
    size = len(fields.cells) * stride
    writer.constants = [f"STRIDE, RECORDS, RECORD = {stride}, {size}, {fields.record}"]
    _define_sums(program, writer, fields)
    parts = [
        write_part(program, writer, fields)
        for write_part in (_write_events, _write_images, _write_tables)
    ]
    parts.append(_write_excess(program, writer))
    about = "The functions of a filter (`jaxevent.reconstruction.engine`)."
    return writer.module(about, parts, fields, program.dtype)


def _define_sums(program: PixelProgram, writer: Writer, fields: Fields) -> None:
    """Define the sums of vectors by which derivatives follow events and make images."""
    slopes, lanes = program.slopes, fields.lanes
    if slopes is None:
        return
    numbers = {
        k: writer.add_vector(lanes, change.nodes)
        for k, change in enumerate(slopes.changes)
        if change.kind == "number"
    }
    out = {
        "follow": {f"state{leaf}": place for leaf, place in fields.states.items()},
        "show": {name: k * lanes for k, name in enumerate(fields.outputs)},
    }
    for function, places in out.items():
        order = {node: k for k, node in enumerate(slopes.factors_of(*places))}
        sums = []
        for name, place in places.items():
            terms = tuple(
                (order[node], k in numbers, numbers[k] if k in numbers else fields.vectors[k])
                for node, k in slopes.factors[name]
            )
            sums.append((place, terms))
        writer.constants.append(f"{function} = vector_sums({lanes}, {tuple(sums)})")


def _write_events(program: PixelProgram, writer: Writer, fields: Fields) -> str:
    states = [f"state{leaf}" for leaf in fields.states]
    factors = [] if program.slopes is None else program.slopes.factors_of(*states)
    out = writer.lines([*program.after, *factors], 12)
    for k, node in enumerate(program.after):
        if node.op != "input" or node.args != (f"state{k}",):
            out.append(f"            {fields.text(f'state{k}')} = {writer.name(node)}")
    if states:
        given = "".join(f"{writer.name(node)}, " for node in factors)
        out.append("            record = RECORDS + z * RECORD")
        out.append(f"            follow(cells, record, cells, record, numbers, ({given}))")
    return EVENTS.format(step="\n".join(out), on=fields.cells["on"], off=fields.cells["off"])


def _write_images(program: PixelProgram, writer: Writer, fields: Fields) -> str:
    """Write images, and row by row, after the factors of their derivatives, these."""
    factors, slopes = [], []
    if program.slopes is not None:
        factors = program.slopes.factors_of(*fields.outputs)
    lines = writer.lines([program.image, program.variance, *factors], 12)
    if fields.outputs:
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
        show="\n".join(lines),
        image=writer.name(program.image),
        variance=writer.name(program.variance),
        slopes="\n".join(slopes),
    )


def _write_tables(program: PixelProgram, writer: Writer, fields: Fields) -> str:
    """Write what a piece says, for the pixels from begin to end."""
    stored = [k for k, name in fields.slots.items() if name == f"slot{k}"]
    out, changes = list[str](), []
    for variant, table in enumerate(program.tables):
        changes = table_changes(program, variant)
        out.append(f"        if variant == {variant}:")
        out += ["            for i in range(pixels):", "                z = first + i"]
        out += writer.lines([*(table[k] for k in stored), *(node for *_, node in changes)], 16)
        for k in stored:
            out.append(f"                {fields.text(f'slot{k}')} = {writer.name(table[k])}")
        for j, (*_, node) in enumerate(changes):
            out.append(f"                room[{j * BLOCK} + i] = {writer.name(node)}")
    if changes:
        out.append("        for i in range(pixels):")
        out.append("            record = RECORDS + (first + i) * RECORD")
    for j, (k, lane, _) in enumerate(changes):
        place = f"record + {fields.vectors[k] + lane}"
        out.append(f"            cells[{place}] = room[{j * BLOCK} + i]")
    return TABLES + "\n".join([*out, ""])


def _write_excess(program: PixelProgram, writer: Writer) -> str:
    lines = writer.lines(program.excess, 4)
    lines += [f"    out[{k}] = {writer.name(node)}" for k, node in enumerate(program.excess)]
    return EXCESS.format(lines="\n".join(lines))
