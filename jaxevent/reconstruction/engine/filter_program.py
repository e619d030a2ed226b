"""Kernels of filters: functions of one pixel, traced, translated and written as a module.

What a method says within a piece rests on three frames: the one whose left edge the piece counts
events from, the one before and the one after (`FrameClock.frames_within`; windows rely on it too).
So a piece is a window of its own with three rows of tables, and where a point lies in it is known
when the program is written: one `Variant` for the beginning, and for every piece and frame after
it.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from jaxevent.codegen.derivative import (
    DerivativeDirections,
    Derivatives,
    collect_derivatives,
    derivative_name,
    parse_derivative,
    with_derivatives,
)
from jaxevent.codegen.graph import (
    Graph,
    Level,
    Node,
    ParameterProgram,
    TranslationError,
    constant_value,
    evaluate_nodes,
    find_dependencies,
)
from jaxevent.codegen.module import CompiledProgram, KernelCache
from jaxevent.codegen.trace import (
    KIND_BY_DTYPE,
    ConstantArray,
    JaxprTranslator,
    ParameterArray,
    TracedJaxpr,
    Value,
    trace_function,
)
from jaxevent.codegen.write import Address, ModuleText, ModuleWriter
from jaxevent.reconstruction.features import ExposureSegments, FrameFeatures, ImagePoints

N_PIECE_FRAMES = 3  # frames that a piece rests on
NO_IMAGE_WIDTH = 104_729  # one pixel is no image: a function that makes one of it fails
# Inputs of the traced functions. Counts are [ON and OFF, rows].
IMAGE_FIELDS = ("grey", "intensity", "certainty")
COUNT_FIELDS = ("span", "head", "tail")
GAP_FIELDS = ("span", "around")  # counted from each frame to the next
UNIFORM_INPUTS = ("gain", "weight_rate", "blend_rate")  # equal for all pixels
SEGMENT_INPUTS = ("segment_cell", "share", "edge", "segment_on", "segment_off")
POINT_INPUTS = ("weight", "blend", "on", "off", "piece", "frame")
EVENT_INPUTS = ("since", "near", "polarity")


@runtime_checkable
class FilterMethod(Protocol):
    """A method that a kernel is made of; see `filtering.Filter`."""

    @property
    def name(self) -> str: ...

    @property
    def has_covariance(self) -> bool: ...

    def frame_model(self, params: Any, frames: Any) -> Any: ...

    def init_from_frames(self, params: Any, frame_model: Any, points: Any) -> Any: ...

    def step_and_readout(
        self, params: Any, frame: Any, state: Any, since: Any, near: Any, polarity: Any
    ) -> tuple[Any, Any, Any]: ...


class FilterFunctions(NamedTuple):
    """Functions of a module, which `filter_loop` calls.

    Attributes:
        events: Pass over the events of a piece.
        images: Make an image.
        tables: Compute what is constant in a piece.
        image_tables: Compute what is constant in a piece for the variance of images.
        excess: Sum over the segments of an exposure.
    """

    events: Any
    images: Any
    tables: Any
    image_tables: Any
    excess: Any


class KernelKind(NamedTuple):
    """Properties on which a kernel depends beside the method and its parameters.

    Attributes:
        exposed: Whether exposures are known.
        dtype: Type of real numbers.
        stride: Pixels of a band, with its border.
        directions: Numbers by which derivatives are taken.
    """

    exposed: bool
    dtype: np.dtype
    stride: int
    directions: DerivativeDirections = DerivativeDirections()


class Variant(NamedTuple):
    """Position of a piece's points among the three frames; the first two have no frame before."""

    piece: int
    frame: int

    def is_first(self, exposed: bool) -> bool:
        """Return whether the first row is the recording's first frame, and there are but two."""
        return self.piece <= (2 if exposed else 1)


def variants(exposed: bool) -> list[Variant]:
    """Return all variants of a recording whose exposures are known or not."""
    if exposed:
        return [Variant(*v) for v in ((0, 0), (1, 0), (2, 0), (3, 0), (3, 1), (4, 1))]
    return [Variant(*v) for v in ((0, 0), (1, 0), (2, 1))]


def n_pieces(exposed: bool) -> int:
    """Return the number of pieces that three frames make."""
    return 2 * N_PIECE_FRAMES + 1 if exposed else N_PIECE_FRAMES + 1


def trace_filter(method: FilterMethod, known: tuple[Any, ...], kind: KernelKind) -> TracedJaxpr:
    """Trace a method at one pixel, between three frames.

    Args:
        method: The filter.
        known: See `DerivativeDirections.inputs`.
        kind: Properties of the recording, and derivatives that are wanted.

    Returns:
        The jaxpr of `start`, the state at the recording's start, of `state` after an event, and of
        `mean` and `variance` at its time without it.

    Raises:
        TranslationError: The functions fail for so little.
    """
    exposed, dtype, _, directions = kind

    def array(*shape: int, kind: Any = dtype) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct(shape, kind)

    whole = np.dtype(jnp.result_type(int))
    given: dict[str, Any] = {name: array(N_PIECE_FRAMES, 1) for name in IMAGE_FIELDS}
    given |= {"gain": array(N_PIECE_FRAMES), "weight_rate": array(n_pieces(exposed))}
    given |= {
        "blend_rate": array(N_PIECE_FRAMES),
        "before": array(2, 1),
        "rows": array(3, kind=np.int32),
    }
    given |= {"span": array(2, N_PIECE_FRAMES, 1), "around": array(N_PIECE_FRAMES, 1)}
    if exposed:
        given |= {"head": array(2, N_PIECE_FRAMES, 1), "tail": array(2, N_PIECE_FRAMES, 1)}
        given |= dict.fromkeys(SEGMENT_INPUTS[1:], array(1))
        given["segment_cell"] = array(1, kind=np.int32)
    given |= dict.fromkeys((*POINT_INPUTS, *EVENT_INPUTS), array())
    given |= {name: array(kind=whole) for name in ("piece", "frame", "polarity")}

    def frame_features(v: dict[str, Any]) -> FrameFeatures:
        segments = ExposureSegments(*(v[name] for name in SEGMENT_INPUTS)) if exposed else None
        made: dict[str, Any] = {f.name: v.get(f.name) for f in dataclasses.fields(FrameFeatures)}
        made |= {"segments": segments, "width": NO_IMAGE_WIDTH}
        for name in ("flicker", "movement"):  # which filters without a variance are not given
            made[name] = v.get(name, jnp.zeros((), dtype))
        return FrameFeatures(**made)

    def image_points(v: dict[str, Any], counted: bool) -> ImagePoints:
        weight, blend, on, off = (v[name][None, None] for name in POINT_INPUTS[:4])
        none = jnp.zeros((1, 1), weight.dtype)
        counts = (on, off) if counted else (none, none)
        return ImagePoints(weight, blend, *counts, v["piece"][None], v["frame"][None], none[0])

    def start(params: Any, frame_model: Any, v: dict[str, Any]) -> Any:
        state = method.init_from_frames(params, frame_model, image_points(v, False))
        return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (1,))[0], state)

    def at_start(known: tuple[Any, ...], v: dict[str, Any]) -> Any:
        v = known[1] | v
        return start(known[0], method.frame_model(known[0], frame_features(v)), v)

    def at_point(known: tuple[Any, Any], *, state: Any, **v: Any) -> dict[str, Any]:
        """Step a pixel's state by an event, and read it out.

        Args:
            known: Parameters of the method, and arrays that are known.
            state: State before the event.
            **v: Other inputs, by name.

        Returns:
            The state at the window's start and after the event, mean and variance.
        """
        params, v = known[0], known[1] | v
        frame_model = method.frame_model(params, frame_features(v))
        frame = jax.tree.map(
            lambda leaf: jnp.broadcast_to(leaf, (1, 1))[0, 0], frame_model(image_points(v, True))
        )
        first = start(params, frame_model, v)
        after, mean, variance = method.step_and_readout(
            params, frame, state, **{name: v[name] for name in EVENT_INPUTS}
        )
        return {"start": first, "state": after, "mean": mean, "variance": variance}

    try:
        given["state"] = jax.eval_shape(at_start, known, given)
    except Exception as error:  # whatever a method's functions raise
        about = f"its functions fail for one pixel and three frames: {error}"
        raise TranslationError(about.partition("\n")[0]) from error
    if not directions.numbers:
        return trace_function(at_point, known, given)
    given["sensitivities"] = directions.shapes({"state": given["state"]})
    return trace_function(with_derivatives(at_point, lambda made: made), known, given)


@dataclasses.dataclass(frozen=True)
class FilterProgram:
    """The expressions of a method at one pixel."""

    host: ParameterProgram
    dtype: np.dtype
    exposed: bool
    directions: DerivativeDirections
    tables: list[list[Node]]  # of each variant: what its slots hold
    start: list[dict[str, Node]]  # of each variant: the state at the start, by name
    state: dict[str, Node]  # after an event, by name
    mean: Node
    variance: Node
    excess: list[Node]  # what a segment of an exposure adds to the frame's totals
    derivatives: Derivatives | None  # of the state, "mean" and "variance"

    def factors(self, *names: str) -> list[Node]:
        """Return the factors of the derivatives of some results, each once."""
        return [] if self.derivatives is None else self.derivatives.factors_of(*names)

    def results(self) -> list[Node]:
        """Return the nodes that are computed at a point."""
        names = [] if self.derivatives is None else [*self.derivatives.factors]
        return [*self.state.values(), self.mean, self.variance, *self.factors(*names)]

    def table_derivatives(self, variant: int) -> list[tuple[int, int, Node]]:
        """Return the terms that a piece adds to derivatives: vector, direction, expression."""
        changes = [] if self.derivatives is None else self.derivatives.changes
        return [
            (k, lane, nodes[variant])
            for k, change in enumerate(changes)
            if change.kind == "table"
            for lane, nodes in change.nodes.items()
        ]

    def initial_state(self, variant: int, known: Any, values: list[NDArray]) -> dict[str, Any]:
        """Evaluate the state at the start for all pixels.

        Args:
            variant: Variant at the recording's start.
            known: Returns the array of an input by its name.
            values: Values of `host`.

        Returns:
            Arrays by the names of the state's numbers and of their derivatives.
        """
        start = self.start[variant]
        made = evaluate_nodes([*start.values()], known, values, self.dtype)
        return dict(zip(start, made, strict=True))


class PixelTranslator(JaxprTranslator):
    """Translation of functions of one pixel.

    Look-ups of tables at a point become nodes "slot", numbered in order; what they hold is
    collected in `slots`. Sums over segments (`segment_cell`) become inputs "total".
    """

    def __init__(self, graph: Graph, host: ParameterProgram):
        super().__init__(graph, host)
        self.slots: list[Node] = []
        self.excess: list[Node] = []  # what a segment adds to the sums

    def translate_special(self, eqn: Any, values: list[Value]) -> NDArray | None:
        return self._sum_over_segments(values) if eqn.primitive.name == "scatter-add" else None

    def _apply(self, eqn: Any, args: list[Node], kind: str) -> Node:
        # Kernels see events alone, and none of these has the polarity 0.
        polarity = args[0].op == "input" and args[0].args == ("polarity.0",)
        if polarity and eqn.primitive.name in ("eq", "ne") and constant_value(args[1]) == 0:
            return self.graph.constant(eqn.primitive.name == "ne")
        return super()._apply(eqn, args, kind)

    def translate_lookup(self, found: NDArray, kind: str) -> NDArray:
        """Make nodes "slot" of elements that are looked up at a point, and collect what these hold.

        Args:
            found: Nodes of the elements, of any shape.
            kind: Kind of number, as of `Node.kind`.

        Returns:
            The new nodes, of the same shape.
        """
        out = np.empty(found.shape, object)
        for place in np.ndindex(*found.shape):
            out[place] = self.graph.node("slot", (len(self.slots),), kind, Level.TABLE)
            node: Any = found[place]
            self.slots.append(node)
        return out

    def _sum_over_segments(self, values: list[Value]) -> NDArray:
        """Translate sums [..., cells] of updates [..., 1]."""
        start, cells, updates = values
        if not isinstance(start, ConstantArray) or start.value.any():
            raise TranslationError("a sum that begins with numbers")
        index, added = np.ravel(self.nodes(cells)), self.nodes(updates)
        ours = len(index) == 1 and index[0].args == ("segment_cell.0",) and added.shape[-1:] == (1,)
        if not ours or start.value.shape[:-1] != added.shape[:-1]:
            raise TranslationError("a sum other than that over an exposure's segments")
        out = np.empty(start.value.shape, object)
        for place in np.ndindex(*added.shape[:-1]):
            node: Any = added[(*place, 0)]
            if constant_value(node) != 0 and node not in self.excess:
                self.excess.append(node)
            for row in range(start.value.shape[-1]):
                out[(*place, row)] = self._total(node, row)
        return out

    def _total(self, node: Node, row: int) -> Node:
        if constant_value(node) == 0:
            return node
        return self.graph.input(f"total.{self.excess.index(node)}.{row}", "f", Level.TABLE)


def translate_filter(trace: TracedJaxpr, known: tuple[Any, ...], kind: KernelKind) -> FilterProgram:
    """Translate a traced method; see `trace_filter`.

    Args:
        trace: The traced method.
        known: See `DerivativeDirections.inputs`.
        kind: Properties of the recording, and derivatives that are wanted.

    Raises:
        TranslationError: There is no translation.
    """
    exposed, dtype, _, directions = kind
    graph, host = Graph(), ParameterProgram()
    count, first_seed = len(directions.numbers), len(jax.tree.leaves(known[:2]))
    moving = {leaf for leaf, _ in directions.numbers}
    values: list[Value] = []
    for k, leaf in enumerate(jax.tree.leaves(known)):
        number = host.add_input(np.asarray(leaf))
        values.append(ParameterArray(number, k not in moving, k >= first_seed))
    tables, starts, outs, excess, changes = [], [], None, [], set[Node]()
    for variant in variants(exposed):
        translation = PixelTranslator(graph, host)
        last = 1 if variant.is_first(exposed) else 2  # the row that is a frame and has none after
        inputs = [_input(graph, *item, variant, last) for item in trace.inputs.items()]
        results = trace.translate(translation, [*values, *inputs])
        start, rest = {}, {}
        for name, node in results.items():
            at_start = name.startswith(("start", "sensitivities['start']"))
            (start if at_start else rest)[name.replace("start", "state", 1)] = node
        starts.append(_fill_slots(start, translation.slots, graph))
        if outs is not None and (outs, excess) != (rest, translation.excess):
            raise TranslationError("functions of a point that differ between pieces")
        outs, excess = rest, translation.excess
        tables.append(translation.slots)
        changes |= translation.changes
    assert outs is not None
    outs = _drop_zeros(outs, tables, starts, graph)
    state = {name: node for name, node in outs.items() if name.startswith("state")}
    derivatives = None
    if count:
        real = [name for name in state if derivative_name(name, 0) in outs]
        made = {name: [outs[derivative_name(name, d)] for d in range(count)] for name in real}
        for name in directions.of:
            made[name] = [outs[derivative_name(f"{name}.0", d)] for d in range(count)]
        derivatives = collect_derivatives(made, tables, excess, changes, graph)
    mean, variance = outs["mean.0"], outs["variance.0"]
    return FilterProgram(
        host, dtype, exposed, directions, tables, starts, state, mean, variance, excess, derivatives
    )


def _input(
    graph: Graph, name: str, leaf: jax.ShapeDtypeStruct, variant: Variant, last: int
) -> Value:
    """Return an input of the traced function, an array of nodes.

    Args:
        graph: Graph of the nodes.
        name: Name of the input.
        leaf: Its shape and type.
        variant: Piece, and frame before, of the translation.
        last: Row of the last frame that a following frame may change.
    """
    if name in ("piece", "frame"):
        return ConstantArray(np.asarray(getattr(variant, name)), at_point=True)
    level = Level.POINT
    if name in (*IMAGE_FIELDS, *COUNT_FIELDS, *GAP_FIELDS, "before"):
        level = Level.TABLE
    elif name in UNIFORM_INPUTS:
        level = Level.PIECE
    out, kind = np.empty(leaf.shape, object), KIND_BY_DTYPE[leaf.dtype.kind]
    # What happens after the last frame is not known.
    counted = last if name in GAP_FIELDS else last + 1
    for number, place in enumerate(np.ndindex(*leaf.shape)):
        row = number % N_PIECE_FRAMES
        if name in IMAGE_FIELDS:
            number = min(row, last)
        if name in (*COUNT_FIELDS, *GAP_FIELDS) and row >= counted:
            out[place] = graph.constant(0.0)
        elif name == "gain" and row > last:
            out[place] = graph.constant(1.0)
        else:
            out[place] = graph.input(f"{name}.{number}", kind, level)
    return out


def _substitute(results: dict[str, Node], known: dict[Node, Node], graph: Graph) -> Any:
    """Replace some nodes by others, and simplify the nodes that use them."""
    new = dict(known)
    for node in find_dependencies([*results.values()]):
        arguments = [a for a in node.args if isinstance(a, Node)]
        if node not in new and any(new.get(a, a) is not a for a in arguments):
            args = tuple(new.get(a, a) if isinstance(a, Node) else a for a in node.args)
            new[node] = graph.apply(node.op, args, node.kind)
    return {name: new.get(node, node) for name, node in results.items()}


def _slots(results: dict[str, Node]) -> list[Node]:
    return [node for node in find_dependencies([*results.values()]) if node.op == "slot"]


def _fill_slots(results: dict[str, Node], table: list[Node], graph: Graph) -> dict[str, Node]:
    """Replace slots by the nodes that they hold."""
    while slots := _slots(results):
        results = _substitute(results, {slot: table[slot.args[0]] for slot in slots}, graph)
    return results


def _drop_zeros(
    outs: dict[str, Node], tables: list[list[Node]], starts: list[dict[str, Node]], graph: Graph
) -> dict[str, Node]:
    """Put 0 in place of slots and derivatives of the state that are always 0."""
    zero = graph.constant(0.0)

    def is_zero(node: Node) -> bool:
        return constant_value(node) == 0

    empty = {s: zero for s in _slots(outs) if all(is_zero(t[s.args[0]]) for t in tables)}
    outs = _substitute(outs, empty, graph)
    names = [name for name in starts[0] if parse_derivative(name)]
    inputs = {name: graph.input(name, "f", Level.POINT) for name in names}
    dead = {name for name in names if all(is_zero(start[name]) for start in starts)}
    while True:
        found = _substitute(outs, {inputs[name]: zero for name in dead}, graph)
        alive = {name for name in dead if not is_zero(found[name])}
        if not alive:
            return found
        dead -= alive


class FieldPlaces(NamedTuple):
    """Places of the fields of `cells`, in strides; -1 where a method needs none.

    Attributes:
        stride: Pixels of a band, with its border.
        factors: Factors of derivatives of images, for each pixel of a row.
        table_scratch: Numbers for derivatives of tables.
        on: ON events since the left edge of the piece's exposure.
        off: OFF events since the left edge of the piece's exposure.
        before: [2] ON and OFF events from the window's start to the end of the first exposure.
        image: [3, rows] grey value, intensity and certainty of each frame.
        total: [sums, rows] sums over the exposure of each frame.
        span: [2, rows] ON and OFF events from a frame's left edge to the right edge of the next
            one.
        head: [2, rows] ON and OFF events from a frame's left edge to its middle.
        tail: [2, rows] ON and OFF events from a frame's middle to its right edge.
        around: [rows] sum of the events of `span` over 3x3 pixels.
        shifted: [fields, 2] field to which one moves when a frame follows, and the field that
            moves.
    """

    stride: int
    factors: int
    table_scratch: int
    on: int
    off: int
    before: NDArray[np.int64]
    image: NDArray[np.int64]
    total: NDArray[np.int64]
    span: NDArray[np.int64]
    head: NDArray[np.int64]
    tail: NDArray[np.int64]
    around: NDArray[np.int64]
    shifted: NDArray[np.int64]


@dataclasses.dataclass(frozen=True)
class PixelFields:
    """Places of a pixel's numbers in `filter_loop.BandMemory`.

    Behind the fields of all pixels each pixel has a record of the vectors of its derivatives.
    """

    cells: dict[str, int]
    whole: dict[str, int]
    slots: dict[int, str]  # field of each slot that is stored
    vectors: dict[int, int]  # which of `Derivatives.changes` lie in the record, and where
    states: dict[str, int]  # places of vectors in the record, by the number of the state
    outputs: tuple[str, ...]  # of "mean" and "variance", of which there are derivatives
    lanes: int  # numbers of a vector
    factors: int  # of derivatives of images
    table_scratch: int  # numbers
    sums: int  # over segments of exposures
    stride: int
    exposed: bool

    @classmethod
    def of(cls, program: FilterProgram, stride: int) -> "PixelFields":
        """Lay out the numbers of a program.

        Args:
            program: The program.
            stride: Pixels of a band, with its border.

        Returns:
            The layout.

        Raises:
            TranslationError: A table is not of real numbers.
        """
        cells: dict[str, int] = {}
        whole: dict[str, int] = {}
        for name, node in program.state.items():
            of_kind = cells if node.kind == "f" else whole
            of_kind[name] = len(of_kind)
        cells |= {"on.0": len(cells), "off.0": len(cells) + 1}
        slots, known = {}, dict[Any, str]()
        for node in find_dependencies(program.results()):
            if node.op == "slot":
                if node.kind != "f":
                    raise TranslationError("a table that is not of real numbers")
                k = node.args[0]
                name = known.setdefault(tuple(table[k] for table in program.tables), f"slot{k}")
                cells.setdefault(name, len(cells))
                slots[k] = name
        wanted = [node for start in program.start for node in start.values()]
        for variant, table in enumerate(program.tables):
            wanted += [table[k] for k in slots]
            wanted += [node for *_, node in program.table_derivatives(variant)]
        used = {n.args[0].partition(".")[0] for n in find_dependencies(wanted) if n.op == "input"}
        names = ["before.0", "before.1"] if "before" in used else []
        for name in IMAGE_FIELDS:
            names += [f"{name}.{row}" for row in range(N_PIECE_FRAMES) if name in used]
        for name in COUNT_FIELDS:
            n_rows = N_PIECE_FRAMES - 1 if name == "span" else N_PIECE_FRAMES
            rows = [p * N_PIECE_FRAMES + row for p in range(2) for row in range(n_rows)]
            names += [f"{name}.{row}" for row in rows if name in used]
        names += [f"around.{row}" for row in range(N_PIECE_FRAMES - 1) if "around" in used]
        sums = len(program.excess)
        names += [f"total.{k}.{row}" for k in range(sums) for row in range(N_PIECE_FRAMES)]
        cells |= {name: len(cells) + k for k, name in enumerate(names)}
        changes = [] if program.derivatives is None else program.derivatives.changes
        lanes = program.directions.lanes
        moved = [k for k, change in enumerate(changes) if change.kind != "number"]
        vectors = {k: i * lanes for i, k in enumerate(moved)}
        states = {changes[k].state: at for k, at in vectors.items() if changes[k].kind == "state"}
        outputs = () if program.derivatives is None else program.directions.of
        return cls(
            cells, whole, slots, vectors, states, outputs, lanes, len(program.factors(*outputs)),
            len(program.table_derivatives(0)) * TABLE_PIXELS, sums, stride, program.exposed,
        )  # fmt: skip

    @property
    def record(self) -> int:
        """Numbers of a pixel's record."""
        return len(self.vectors) * self.lanes

    @property
    def size(self) -> int:
        """Numbers of all pixels of a band."""
        return (len(self.cells) + self.record) * self.stride

    def of_bands(self, name: str, cells: NDArray, whole: NDArray) -> NDArray:
        """Return one field of all bands.

        Args:
            name: Name of the field.
            cells: Real numbers of `BandMemory`.
            whole: Whole numbers of `BandMemory`.

        Returns:
            (bands, stride) view.
        """
        array, place = (whole, self.whole) if name in self.whole else (cells, self.cells)
        return array[:, place[name] * self.stride : (place[name] + 1) * self.stride]

    def records(self, cells: NDArray) -> NDArray:
        """Return the pixels' records in `BandMemory`, [bands, stride, record]."""
        return cells[:, len(self.cells) * self.stride :].reshape(len(cells), self.stride, -1)

    def addresses(self) -> dict[Any, str | Address]:
        """Return the addresses of a pixel's inputs, or texts that read them, by name."""
        sizes = zip(
            UNIFORM_INPUTS, (N_PIECE_FRAMES, n_pieces(self.exposed), N_PIECE_FRAMES), strict=True
        )
        uniform = [f"{name}.{k}" for name, size in sizes for k in range(size)]
        found: dict[Any, str | Address] = {n: ("uniform", "at", k) for k, n in enumerate(uniform)}
        found |= {name: ("cells", "z", at * self.stride) for name, at in self.cells.items()}
        found |= {name: ("whole", "z", at * self.stride) for name, at in self.whole.items()}
        found |= {slot: found[name] for slot, name in self.slots.items()}
        for name in (*SEGMENT_INPUTS[1:], *EVENT_INPUTS, "weight", "blend"):
            found[f"{name}.0"] = name.removeprefix("segment_")
        return found

    @functools.cached_property
    def places(self) -> FieldPlaces:
        """Places of the fields that the loop fills."""

        def of(*names: str) -> NDArray[np.int64]:
            return np.array([self.cells.get(name, -1) for name in names], np.int64)

        def rows(name: str, first: int = 0) -> NDArray[np.int64]:
            return of(*(f"{name}.{first + row}" for row in range(N_PIECE_FRAMES)))

        image = np.stack([rows(name) for name in IMAGE_FIELDS])
        span, head, tail = (np.stack([rows(n), rows(n, N_PIECE_FRAMES)]) for n in COUNT_FIELDS)
        total = np.full((self.sums, N_PIECE_FRAMES), -1)
        for k in range(self.sums):
            total[k] = rows(f"total.{k}")
        around = rows("around")
        every = np.concatenate([image, total, span, head, tail, around[None]])
        order = np.stack([every[:, :-1].T, every[:, 1:].T], -1).reshape(-1, 2)
        return FieldPlaces(
            self.stride, self.factors, self.table_scratch, self.cells["on.0"], self.cells["off.0"],
            of("before.0", "before.1"), image, total, span, head, tail, around,
            order[(order >= 0).all(1)],
        )  # fmt: skip


EVENTS_TEMPLATE = """
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

IMAGES_TEMPLATE = """
@cfunc(
    types.void(
        CELLS, WHOLE, NUMBERS, I, I, I, D, D, D, CELLS, CELLS, CELLS, MARKS, CELLS, CELLS, I, I
    ),
    **OPTIONS
)
def images(
    cells, whole, last, rows, width, padded, now, weight64, blend64, numbers, mean, variance, valid,
    derivatives, scratch, size, at,
):
    weight, blend = REAL(weight64), REAL(blend64)
    for row in range(rows):
        # A loop of its own, so that the next one takes twice as many numbers at once.
        for column in range(width):
            t = now - last[(row + 1) * padded + 1 + column]
            scratch[{since} * width + column] = REAL((t if t > 0 else 0.0) * 1e-6)
        for column in range(width):
            z = (row + 1) * padded + 1 + column
            since = scratch[{since} * width + column]
{show}
            mean[at + row * width + column] = {mean}
            variance[at + row * width + column] = {variance}
            valid[at + row * width + column] = np.uint8(abs({mean}) < REAL(np.inf))
{derivatives}
"""

TABLE_PIXELS = 256  # whose derivatives are computed side by side before they go into records
TABLES_TEMPLATE = f"""
@cfunc(types.void(I, CELLS, I, I, CELLS, CELLS, I, CELLS), **OPTIONS)
def {{name}}(variant, cells, begin, end, numbers, uniform, at, scratch):
    for first in range(begin, end, {TABLE_PIXELS}):
        pixels = min(end - first, {TABLE_PIXELS})
"""

EXCESS_TEMPLATE = """
@cfunc(types.void(D, D, F, F, CELLS, CELLS), **OPTIONS)
def excess(share64, edge64, on, off, numbers, out):
    share, edge = REAL(share64), REAL(edge64)
{lines}
"""


def write_filter(program: FilterProgram, stride: int) -> ModuleText:
    """Write the module of a program.

    Args:
        program: The program.
        stride: Pixels of a band, with its border.

    Returns:
        The text, with the places of the fields.

    Raises:
        TranslationError: A number of the piece is not looked up at a point.
    """
    if any(n.level == Level.PIECE for n in find_dependencies(program.results())):
        raise TranslationError("a number of the piece that is not looked up at a point")
    fields = PixelFields.of(program, stride)
    writer = ModuleWriter(program, fields.addresses())
    size = len(fields.cells) * stride
    writer.constants = [f"STRIDE, RECORDS, RECORD = {stride}, {size}, {fields.record}"]
    _define_sums(program, writer, fields)
    parts = [
        write(program, writer, fields)
        for write in (_write_events, _write_images, _write_tables, _write_image_tables)
    ]
    lines = writer.write_lines(program.excess, 4)
    lines += [f"    out[{k}] = {writer.node_name(node)}" for k, node in enumerate(program.excess)]
    parts.append(EXCESS_TEMPLATE.format(lines="\n".join(lines)))
    about = "The functions of a filter (`jaxevent.reconstruction.engine`)."
    return writer.write_module(about, parts, fields, program.dtype)


def _define_sums(program: FilterProgram, writer: ModuleWriter, fields: PixelFields) -> None:
    """Define the sums of vectors by which derivatives follow events and make images."""
    derivatives, lanes = program.derivatives, fields.lanes
    if derivatives is None:
        return
    numbers = {
        k: writer.add_vector(lanes, change.nodes)
        for k, change in enumerate(derivatives.changes)
        if change.kind == "number"
    }
    out = {"follow": fields.states, "show": {n: k * lanes for k, n in enumerate(fields.outputs)}}
    for function, places in out.items():
        order = {node: k for k, node in enumerate(derivatives.factors_of(*places))}
        sums = []
        for name, place in places.items():
            terms = tuple(
                (order[node], k in numbers, numbers[k] if k in numbers else fields.vectors[k])
                for node, k in derivatives.factors[name]
            )
            sums.append((place, terms))
        writer.constants.append(f"{function} = make_vector_sums({lanes}, {tuple(sums)})")


def _write_events(program: FilterProgram, writer: ModuleWriter, fields: PixelFields) -> str:
    addresses, factors = fields.addresses(), program.factors(*fields.states)
    out = writer.write_lines([*program.state.values(), *factors], 12)
    for name, node in program.state.items():
        if node.op != "input" or node.args != (name,):
            pointer, _, offset = addresses[name]
            out.append(f"            {pointer}[{offset} + z] = {writer.node_name(node)}")
    if fields.states:
        given = "".join(f"{writer.node_name(node)}, " for node in factors)
        out.append("            record = RECORDS + z * RECORD")
        out.append(f"            follow(cells, record, cells, record, numbers, ({given}))")
    return EVENTS_TEMPLATE.format(
        step="\n".join(out), on=fields.cells["on.0"], off=fields.cells["off.0"]
    )


def _write_images(program: FilterProgram, writer: ModuleWriter, fields: PixelFields) -> str:
    """Write images, and row by row, after the factors of their derivatives, these."""
    factors, derivatives = program.factors(*fields.outputs), []
    lines = writer.write_lines([program.mean, program.variance, *factors], 12)
    if fields.outputs:
        lines += [
            f"            scratch[{k} * width + column] = {writer.node_name(node)}"
            for k, node in enumerate(factors)
        ]
        given = "".join(f"scratch[{k} * width + column], " for k in range(len(factors)))
        derivatives = [
            "        for column in range(width):",
            "            record = RECORDS + ((row + 1) * padded + 1 + column) * RECORD",
            "            place = (at + row * width + column) * size",
            f"            show(derivatives, place, cells, record, numbers, ({given}))",
        ]
    return IMAGES_TEMPLATE.format(
        since=len(factors),
        show="\n".join(lines),
        mean=writer.node_name(program.mean),
        variance=writer.node_name(program.variance),
        derivatives="\n".join(derivatives),
    )


def _write_tables(program: FilterProgram, writer: ModuleWriter, fields: PixelFields) -> str:
    """Write the function that computes what is constant in a piece, for some pixels."""
    stored = _stored_slots(program, fields, False)
    out, changes = list[str](), []
    for variant, table in enumerate(program.tables):
        changes = program.table_derivatives(variant)
        out.append(f"        if variant == {variant}:")
        out += ["            for i in range(pixels):", "                z = first + i"]
        out += writer.write_lines(
            [*(table[k] for k in stored), *(node for *_, node in changes)], 16
        )
        for k, at in stored.items():
            out.append(f"                cells[{at} * STRIDE + z] = {writer.node_name(table[k])}")
        for j, (*_, node) in enumerate(changes):
            out.append(
                f"                scratch[{j * TABLE_PIXELS} + i] = {writer.node_name(node)}"
            )
    if changes:
        out.append("        for i in range(pixels):")
        out.append("            record = RECORDS + (first + i) * RECORD")
    for j, (k, lane, _) in enumerate(changes):
        place = f"record + {fields.vectors[k] + lane}"
        out.append(f"            cells[{place}] = scratch[{j * TABLE_PIXELS} + i]")
    return TABLES_TEMPLATE.format(name="tables") + "\n".join([*out, ""])


def _write_image_tables(program: FilterProgram, writer: ModuleWriter, fields: PixelFields) -> str:
    """Write the function that computes what is constant in a piece for the variance of images."""
    stored, out = _stored_slots(program, fields, True), ["        pass"]
    for variant, table in enumerate(program.tables if stored else ()):
        out.append(f"        if variant == {variant}:")
        out += ["            for i in range(pixels):", "                z = first + i"]
        out += writer.write_lines([table[k] for k in stored], 16)
        for k, at in stored.items():
            out.append(f"                cells[{at} * STRIDE + z] = {writer.node_name(table[k])}")
    return TABLES_TEMPLATE.format(name="image_tables") + "\n".join([*out, ""])


def _stored_slots(program: FilterProgram, fields: PixelFields, of_variance: bool) -> dict[int, int]:
    """Return the fields in which slots are stored.

    Slots that derivatives of the variance need are among those for all else.

    Args:
        program: The program.
        fields: Its layout.
        of_variance: Whether slots for the variance of images alone are wanted, or all others.

    Returns:
        Fields by the number of the slot.
    """
    rest = {**program.state, "mean": program.mean}
    needed = _slots(
        rest | {str(k): node for k, node in enumerate(program.factors(*fields.outputs))}
    )
    others = {fields.slots[node.args[0]] for node in needed}
    return {
        k: fields.cells[name]
        for k, name in fields.slots.items()
        if name == f"slot{k}" and (name not in others) == of_variance
    }


_kernels = KernelCache(FilterFunctions, write_filter)


def filter_kernel(
    method: FilterMethod, params: Any, fixed: dict[str, NDArray], kind: KernelKind
) -> CompiledProgram:
    """Make the kernel of a filter; its functions are `FilterFunctions`, its places `PixelFields`.

    Args:
        method: The filter.
        params: Its parameters.
        fixed: Further numbers that are known with the parameters.
        kind: Properties of the recording, and derivatives that are wanted.

    Raises:
        TranslationError: There is no kernel.
    """
    return _kernels.get(*_request(method, params, fixed, kind), kind.stride)


def check_filter_kernel(
    method: FilterMethod, params: Any, fixed: dict[str, NDArray], kind: KernelKind
) -> None:
    """Check that `filter_kernel` can make a kernel of these arguments.

    Args:
        method: The filter.
        params: Its parameters.
        fixed: Further numbers that are known with the parameters.
        kind: Other properties of the kernel.

    Raises:
        TranslationError: It can make none.
    """
    _kernels.find_program(*_request(method, params, fixed, kind))


def _request(
    method: FilterMethod, params: Any, fixed: dict[str, NDArray], kind: KernelKind
) -> tuple[Any, Any, Callable[[], FilterProgram]]:
    """Return the arguments of `KernelCache.find_program`.

    Args:
        method: The filter.
        params: Its parameters.
        fixed: Further numbers that are known with the parameters.
        kind: Other properties of the kernel.

    Returns:
        The key of the program, the arrays that it is made with, and the function that makes it.
    """
    exposed, dtype, _, directions = kind
    known = directions.inputs(params, fixed)

    def translate() -> FilterProgram:
        return translate_filter(trace_filter(method, known, kind), known, kind)

    return (method, exposed, dtype, directions), known, translate
