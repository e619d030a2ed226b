"""A method as scalar expressions: its functions traced for one pixel and the frames around it.

What a method says within a piece rests on three frames: the one whose left edge the piece counts
events from, the one before and the one after (`Clock.used`; windows rely on it too). So a piece is
a window of its own with three rows of tables, and where a point lies in it is known when the
program is written: one `Variant` for the beginning, and for every piece and frame after it.
"""

import dataclasses
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from jaxevent.kernels.expressions import Graph, Level, Node, Untranslatable, needed
from jaxevent.kernels.host import HostProgram
from jaxevent.kernels.translate import Known, OfParameters, Translation, Value
from jaxevent.reconstruction.features import FrameFeatures, ImagePoints, Segments

ROWS = 3
NO_WIDTH = 104_729  # one pixel is no image: a function that makes one of it fails
FIELDS = ("grey", "intensity", "certainty", "total")  # of frames, one number per pixel
PAIRS = ("span", "head", "tail")  # ... and ON and OFF


@runtime_checkable
class FilterMethod(Protocol):
    """What a kernel is made of; see `filtering.Filter`."""

    @property
    def name(self) -> str: ...

    def initial_state(self, params: Any, observer: Any, points: Any) -> Any: ...

    def at_pixel(
        self, params: Any, frame: Any, state: Any, since: Any, near: Any, polarity: Any
    ) -> tuple[Any, Any, Any]: ...


class Variant(NamedTuple):
    """Where points of a piece lie among the three frames; the first two have no frame before."""

    piece: int
    frame: int

    def starts(self, exposed: bool) -> bool:
        """Whether the first row is the recording's first frame, and there are but two."""
        return self.piece <= (2 if exposed else 1)


def variants(exposed: bool) -> list[Variant]:
    if exposed:
        return [Variant(*v) for v in ((0, 0), (1, 0), (2, 0), (3, 0), (3, 1), (4, 1))]
    return [Variant(*v) for v in ((0, 0), (1, 0), (2, 1))]


def pieces(exposed: bool) -> int:
    """How many pieces three frames make."""
    return 2 * ROWS + 1 if exposed else ROWS + 1


@dataclasses.dataclass(frozen=True)
class Traced:
    """The jaxpr of a method at one pixel."""

    closed: Any
    names: list[tuple[str, tuple[int, ...]]]  # of its arguments, with their shapes
    leaves: int  # of the state
    state: list[np.dtype]
    exposed: bool
    dtype: np.dtype


@dataclasses.dataclass(frozen=True)
class Point:
    """What a traced function knows of a point, by the names of the kernel's numbers."""

    weight: Any
    blend: Any
    on: Any
    off: Any
    piece: Any
    frame: Any

    def points(self, counted: bool) -> ImagePoints:
        none = jnp.zeros((1, 1), self.weight.dtype)
        return ImagePoints(
            self.weight[None, None],
            self.blend[None, None],
            self.on[None, None] if counted else none,
            self.off[None, None] if counted else none,
            self.piece[None],
            self.frame[None],
            jnp.zeros(1, self.weight.dtype),
        )


def _abstract(exposed: bool, dtype: np.dtype) -> dict[str, jax.ShapeDtypeStruct]:
    """The arguments of the traced function beside parameters and state."""
    whole = np.dtype(jnp.result_type(int))

    def array(*shape: int, kind: Any = dtype) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct(shape, kind)

    given = {name: array(ROWS, 1) for name in ("grey", "intensity", "certainty")}
    given |= {"response": array(256), "present": array(), "gain": array(ROWS)}
    given |= {"weight_rate": array(pieces(exposed)), "blend_rate": array(ROWS)}
    given |= {"span": array(2, ROWS, 1), "before": array(2, 1), "rows": array(3, kind=np.int32)}
    if exposed:
        given |= {"head": array(2, ROWS, 1), "tail": array(2, ROWS, 1)}
        given |= {name: array(1) for name in ("share", "edge", "segment_on", "segment_off")}
        given["segment_cell"] = array(1, kind=np.int32)
    given |= {name: array() for name in ("weight", "blend", "on", "off", "since", "near")}
    given |= {name: array(kind=whole) for name in ("piece", "frame", "polarity")}
    return given


def traced(method: FilterMethod, observe: Any, params: Any, exposed: bool, dtype: Any) -> Traced:
    """Trace a method; raises `Untranslatable` if its functions fail for so little."""
    given = _abstract(exposed, dtype)

    def frames_of(params: Any, v: dict[str, Any]) -> FrameFeatures:
        segments = None
        if exposed:
            names = ("segment_cell", "share", "edge", "segment_on", "segment_off")
            segments = Segments(*(v[name] for name in names))
        # Prepared for the parameters' own clock: the lag is exactly 0.
        offset = params.clock_offset
        given: dict[str, Any] = {f.name: v.get(f.name) for f in dataclasses.fields(FrameFeatures)}
        given |= {"segments": segments, "clock_offset": offset, "width": NO_WIDTH}
        return FrameFeatures(**given)

    def scalar(leaf: Any) -> Any:
        return jnp.broadcast_to(leaf, (1, 1))[0, 0]

    def start(params: Any, v: dict[str, Any]) -> Any:
        observer = observe(params, frames_of(params, v))
        point = Point(*(v[f.name] for f in dataclasses.fields(Point)))
        state = method.initial_state(params, observer, point.points(False))
        return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (1,))[0], state)

    def at_point(params: Any, v: dict[str, Any], state: Any) -> Any:
        observer = observe(params, frames_of(params, v))
        point = Point(*(v[f.name] for f in dataclasses.fields(Point)))
        frame = jax.tree.map(scalar, observer(point.points(True)))
        event = {name: v[name] for name in ("since", "near", "polarity")}
        return start(params, v), method.at_pixel(params, frame, state, **event)

    try:
        state = jax.eval_shape(start, params, given)
        closed = jax.make_jaxpr(at_point)(params, given, state)
    except Exception as error:  # whatever a method's functions raise
        about = f"its functions fail for one pixel and three frames: {error}"
        raise Untranslatable(about.partition("\n")[0]) from error
    names = [(f"parameter{k}", np.shape(p)) for k, p in enumerate(jax.tree.leaves(params))]
    names += [(name, given[name].shape) for name in sorted(given)]
    leaves = jax.tree.leaves(state)
    names += [(f"state{k}", ()) for k in range(len(leaves))]
    assert len(names) == len(closed.in_avals)
    kinds = [np.dtype(leaf.dtype) for leaf in leaves]
    return Traced(closed, names, len(leaves), kinds, exposed, np.dtype(dtype))


@dataclasses.dataclass(frozen=True)
class PixelProgram:
    """All that a method computes at one pixel."""

    host: HostProgram
    traced: Traced
    tables: list[list[Node]]  # of each variant: what its slots hold
    start: list[list[Node]]  # of each variant: the state at the start, of its slots
    after: list[Node]  # the state after an event
    image: Node
    variance: Node
    excess: Node | None  # what a segment of an exposure adds to the frame's total


class PixelTranslation(Translation):
    """Translates what is said of one pixel.

    Look-ups of tables at a place become nodes "slot", numbered in order; what they hold is
    collected in `slots`. Sums over segments (`segment_cells`) become inputs "total".
    """

    def __init__(self, graph: Graph, host: HostProgram):
        super().__init__(graph, host)
        self.slots: list[Node] = []
        self.excess: Node | None = None  # what a segment adds to the sum

    def special(self, eqn: Any, values: list[Value]) -> NDArray | None:
        return self._sum_over_segments(values) if eqn.primitive.name == "scatter-add" else None

    def placed(self, found: NDArray, kind: str) -> NDArray:
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


def _unfolded(results: list[Node], table: list[Node], graph: Graph) -> list[Node]:
    """The same results with what slots hold in place of the slots."""
    while any(node.op == "slot" for node in needed(results)):
        new: dict[Node, Node] = {}
        for node in needed(results):
            if node.op == "slot":
                new[node] = table[node.args[0]]
            elif any(new.get(a, a) is not a for a in node.args if isinstance(a, Node)):
                args = tuple(new.get(a, a) if isinstance(a, Node) else a for a in node.args)
                new[node] = graph.apply(node.op, args, node.kind)
        results = [new.get(node, node) for node in results]
    return results


def translated(traced: Traced, params: Any, response: NDArray, present: float) -> PixelProgram:
    """The program of a traced method; raises `Untranslatable`."""
    graph, host = Graph(), HostProgram()
    leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(params)]
    fixed = {f"parameter{k}": OfParameters(host.add_input(v)) for k, v in enumerate(leaves)}
    fixed["response"] = OfParameters(host.add_input(np.asarray(response, traced.dtype)))
    fixed["present"] = OfParameters(host.add_input(np.asarray(present, traced.dtype)))
    tables, starts, outs, translation = [], [], None, None
    for variant in variants(traced.exposed):
        translation = PixelTranslation(graph, host)
        inputs = _inputs(graph, traced, variant, fixed)
        made = translation.run(traced.closed, inputs)
        results = [translation.nodes(v).item() for v in made]
        tables.append(translation.slots)
        starts.append(_unfolded(results[: traced.leaves], translation.slots, graph))
        rest = results[traced.leaves :]
        if outs is not None and outs != rest:
            raise Untranslatable("functions of a point that differ between pieces")
        outs = rest
    assert outs is not None and translation is not None
    *after, image, variance = outs
    return PixelProgram(host, traced, tables, starts, after, image, variance, translation.excess)


def _inputs(
    graph: Graph, traced: Traced, variant: Variant, fixed: dict[str, OfParameters]
) -> list[Value]:
    """The arguments of the traced function as values of a translation."""
    starts = variant.starts(traced.exposed)
    last = 1 if starts else 2  # the row that is a frame and has none after it

    def node(name: str, level: Level) -> Node:
        return graph.input(name, "f", level)

    def nodes(shape: tuple[int, ...], make: Any) -> NDArray:
        out = np.empty(shape, object)
        for place in np.ndindex(*shape):
            out[place] = make(*place)
        return out

    zero = graph.constant(0.0)

    def counts(name: str) -> Any:
        until = last if name == "span" else last + 1  # what happens after the last is not known

        def make(polarity: int, row: int, _: int) -> Node:
            known = row < until
            return (
                node(f"{name}_{'on' if polarity == 0 else 'off'}{row}", Level.TABLE)
                if known
                else zero
            )

        return make

    def of(name: str, shape: tuple[int, ...]) -> Value:
        if name in fixed:
            return fixed[name]
        if name in ("piece", "frame"):
            return Known(np.asarray(getattr(variant, name)), placed=True)
        if name in PAIRS:
            return nodes(shape, counts(name))
        if name in FIELDS:
            return nodes(shape, lambda r, _: node(f"{name}{min(r, last)}", Level.TABLE))
        if name == "before":
            return nodes(shape, lambda p, _: node(f"before_{'off' if p else 'on'}", Level.TABLE))
        if name == "gain":
            one = graph.constant(1.0)
            return nodes(shape, lambda r: node(f"gain{r}", Level.PIECE) if r <= last else one)
        if name in ("weight_rate", "blend_rate"):
            return nodes(shape, lambda k: node(f"{name}{k}", Level.PIECE))
        if name.startswith("state"):
            kind = traced.state[int(name.removeprefix("state"))].kind
            return nodes(shape, lambda: graph.input(name, kind, Level.POINT))
        kind = "i" if name in ("rows", "segment_cell", "polarity") else "f"
        return nodes(shape, lambda *_: graph.input(name, kind, Level.POINT))

    return [of(name, shape) for name, shape in traced.names]
