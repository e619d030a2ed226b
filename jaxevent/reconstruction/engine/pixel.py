"""A method as scalar expressions: its functions traced for one pixel and the frames around it.

What a method says within a piece rests on three frames: the one whose left edge the piece counts
events from, the one before and the one after (`Clock.used`; windows rely on it too). So a piece is
a window of its own with three rows of tables, and where a point lies in it is known when the
program is written: one `Variant` for the beginning, and for every piece and frame after it.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from jaxevent.codegen.derivative import Slopes, slopes_of
from jaxevent.codegen.graph import (
    Graph,
    Level,
    Node,
    ParameterProgram,
    TranslationError,
    constant_value,
    dependencies,
)
from jaxevent.codegen.trace import Constant, ParameterValue, Translation, Value
from jaxevent.reconstruction.features import FrameFeatures, ImagePoints, Segments

ROWS = 3
NO_WIDTH = 104_729  # one pixel is no image: a function that makes one of it fails
PAIRS = ("span", "head", "tail")  # ... and ON and OFF


@runtime_checkable
class FilterMethod(Protocol):
    """What a kernel is made of; see `filtering.Filter`."""

    @property
    def name(self) -> str: ...

    def init_from_frames(self, params: Any, frame_model: Any, points: Any) -> Any: ...

    def step_and_readout(
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


class Directions(NamedTuple):
    """By what derivatives are taken, and of which of "mean" and "variance"."""

    numbers: tuple[tuple[int, int], ...] = ()  # leaf of the parameters, number in it
    of: tuple[str, ...] = ("mean", "variance")

    @property
    def lanes(self) -> int:
        """The numbers of a vector of derivatives: as many as processors take at once."""
        count = len(self.numbers)
        return -(-count // 8) * 8 if count > 4 else 4

    def seeds(self, params: Any) -> Any:
        """The directions in the parameters, each leaf with an axis of directions in front."""
        leaves, tree = jax.tree.flatten(params)
        count = len(self.numbers)
        seeds = [np.zeros((count, *np.shape(leaf)), np.asarray(leaf).dtype) for leaf in leaves]
        for d, (leaf, number) in enumerate(self.numbers):
            seeds[leaf].reshape(count, -1)[d, number] = 1
        return jax.tree.unflatten(tree, seeds)


@dataclasses.dataclass(frozen=True)
class Traced:
    """The jaxpr of a method at one pixel, and of its derivatives along some directions."""

    closed: Any
    names: list[tuple[str, tuple[int, ...]]]  # of its arguments, with their shapes
    state: list[np.dtype]  # of its leaves
    exposed: bool
    dtype: np.dtype
    directions: Directions

    @property
    def followed(self) -> list[int]:
        """The leaves of the state that have derivatives."""
        return [k for k, kind in enumerate(self.state) if kind.kind == "f"]


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
    given["clock_offset"] = array()
    given |= {"weight_rate": array(pieces(exposed)), "blend_rate": array(ROWS)}
    given |= {"span": array(2, ROWS, 1), "before": array(2, 1), "rows": array(3, kind=np.int32)}
    if exposed:
        given |= {"head": array(2, ROWS, 1), "tail": array(2, ROWS, 1)}
        given |= {name: array(1) for name in ("share", "edge", "segment_on", "segment_off")}
        given["segment_cell"] = array(1, kind=np.int32)
    given |= {name: array() for name in ("weight", "blend", "on", "off", "since", "near")}
    given |= {name: array(kind=whole) for name in ("piece", "frame", "polarity")}
    return given


def traced(
    method: FilterMethod,
    frame_model: Any,
    params: Any,
    exposed: bool,
    dtype: Any,
    directions: Directions = Directions(),  # noqa: B008
) -> Traced:
    """Trace a method; raises `TranslationError` if its functions fail for so little."""
    given = _abstract(exposed, dtype)

    def frames_of(v: dict[str, Any]) -> FrameFeatures:
        segments = None
        if exposed:
            names = ("segment_cell", "share", "edge", "segment_on", "segment_off")
            segments = Segments(*(v[name] for name in names))
        given: dict[str, Any] = {f.name: v.get(f.name) for f in dataclasses.fields(FrameFeatures)}
        given |= {"segments": segments, "width": NO_WIDTH}
        return FrameFeatures(**given)

    def scalar(leaf: Any) -> Any:
        return jnp.broadcast_to(leaf, (1, 1))[0, 0]

    def observed(params: Any, v: dict[str, Any]) -> tuple[Any, Point]:
        point = Point(*(v[f.name] for f in dataclasses.fields(Point)))
        return frame_model(params, frames_of(v)), point

    def begun(params: Any, frame_model: Any, point: Point) -> Any:
        state = method.init_from_frames(params, frame_model, point.points(False))
        return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (1,))[0], state)

    def start(params: Any, v: dict[str, Any]) -> Any:
        return begun(params, *observed(params, v))

    def at_point(params: Any, v: dict[str, Any], state: Any) -> Any:
        frame_model, point = observed(params, v)
        frame = jax.tree.map(scalar, frame_model(point.points(True)))
        event = {name: v[name] for name in ("since", "near", "polarity")}
        first = begun(params, frame_model, point)
        return first, *method.step_and_readout(params, frame, state, **event)

    try:
        state = jax.eval_shape(start, params, given)
        arguments: list[Any] = [params, given, state]
        if directions.numbers:
            arguments += _abstract_slopes(params, state, len(directions.numbers))
        function = with_slopes(at_point) if directions.numbers else at_point
        closed = jax.make_jaxpr(function)(*arguments)
    except Exception as error:  # whatever a method's functions raise
        about = f"its functions fail for one pixel and three frames: {error}"
        raise TranslationError(about.partition("\n")[0]) from error
    names = [(f"parameter{k}", np.shape(p)) for k, p in enumerate(jax.tree.leaves(params))]
    names += [(name, given[name].shape) for name in sorted(given)]
    kinds = [np.dtype(leaf.dtype) for leaf in jax.tree.leaves(state)]
    names += [(f"state{k}", ()) for k in range(len(kinds))]
    if directions.numbers:
        seeds, slopes = arguments[3:]
        names += [(f"seed{k}", seed.shape) for k, seed in enumerate(seeds)]
        followed = [k for k, kind in enumerate(kinds) if kind.kind == "f"]
        names += [(f"slope{k}", slope.shape) for k, slope in zip(followed, slopes, strict=True)]
    assert len(names) == len(closed.in_avals)
    return Traced(closed, names, kinds, exposed, np.dtype(dtype), directions)


def _real(tree: Any) -> list[Any]:
    return [leaf for leaf in jax.tree.leaves(tree) if jnp.issubdtype(leaf.dtype, jnp.inexact)]


def _abstract_slopes(params: Any, state: Any, directions: int) -> list[Any]:
    """Directions in the parameters, and derivatives of the state along them, [directions, ...]."""

    def along(leaf: Any) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct((directions, *leaf.shape), leaf.dtype)

    return [[along(leaf) for leaf in _real(part)] for part in (params, state)]


def with_slopes(at_point: Callable[..., Any]) -> Callable[..., Any]:
    """The same with the derivatives of its results along directions in the parameters."""

    def function(params: Any, v: Any, state: Any, seeds: Any, slopes: Any) -> Any:
        def of(*numbers: Any) -> tuple[list[Any], Any]:
            results = at_point(*_replaced((params, state), numbers, v))
            return _real(results), results

        def along(seeds: Any, slopes: Any) -> Any:
            numbers = _real((params, state))
            return jax.jvp(of, numbers, [*seeds, *slopes], has_aux=True)[1:]

        changes, results = jax.vmap(along, out_axes=(0, None))(seeds, slopes)
        return results, changes

    return function


def _replaced(trees: tuple[Any, Any], numbers: Any, v: Any) -> tuple[Any, Any, Any]:
    """Parameters and state with their real leaves replaced, as arguments of `at_point`."""
    leaves, tree = jax.tree.flatten(trees)
    following = iter(numbers)
    leaves = [next(following) if _real(leaf) else leaf for leaf in leaves]
    params, state = jax.tree.unflatten(tree, leaves)
    return params, v, state


@dataclasses.dataclass(frozen=True)
class PixelProgram:
    """All that a method computes at one pixel."""

    host: ParameterProgram
    traced: Traced
    tables: list[list[Node]]  # of each variant: what its slots hold
    start: list[dict[str, Node]]  # of each variant: the state at the start, by name
    after: list[Node]  # the state after an event
    image: Node
    variance: Node
    excess: list[Node]  # what a segment of an exposure adds to the frame's totals
    slopes: Slopes | None  # of "state0", ..., "mean" and "variance"

    @property
    def dtype(self) -> np.dtype:
        """Kind of real numbers."""
        return self.traced.dtype


class PixelTranslation(Translation):
    """Translates what is said of one pixel.

    Look-ups of tables at a place become nodes "slot", numbered in order; what they hold is
    collected in `slots`. Sums over segments (`segment_cells`) become inputs "total".
    """

    def __init__(self, graph: Graph, host: ParameterProgram):
        super().__init__(graph, host)
        self.slots: list[Node] = []
        self.excess: list[Node] = []  # what a segment adds to the sums

    def translate_special(self, eqn: Any, values: list[Value]) -> NDArray | None:
        return self._sum_over_segments(values) if eqn.primitive.name == "scatter-add" else None

    def _apply(self, eqn: Any, args: list[Node], kind: str) -> Node:
        # Kernels see events alone, and none of these has the polarity 0.
        polarity = args[0].op == "input" and args[0].args == ("polarity",)
        if polarity and eqn.primitive.name in ("eq", "ne") and constant_value(args[1]) == 0:
            return self.graph.constant(eqn.primitive.name == "ne")
        return super()._apply(eqn, args, kind)

    def translate_lookup(self, found: NDArray, kind: str) -> NDArray:
        """What is looked up where points lie: known when the piece begins."""
        out = np.empty(found.shape, object)
        for place in np.ndindex(*found.shape):
            out[place] = self.graph.node("slot", (len(self.slots),), kind, Level.TABLE)
            node: Any = found[place]
            self.slots.append(node)
        return out

    def _sum_over_segments(self, values: list[Value]) -> NDArray:
        """Sums [..., cells] of updates [..., 1]."""
        start, cells, updates = values
        if not isinstance(start, Constant) or start.value.any():
            raise TranslationError("a sum that begins with numbers")
        index, added = np.ravel(self.nodes(cells)), self.nodes(updates)
        ours = len(index) == 1 and index[0].args == ("segment_cell",) and added.shape[-1:] == (1,)
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
        return self.graph.input(f"total{row}_{self.excess.index(node)}", "f", Level.TABLE)


def _substituted(results: dict[str, Node], known: dict[Node, Node], graph: Graph) -> Any:
    """The same results with other nodes in place of some, in their simplest form."""
    new = dict(known)
    for node in dependencies([*results.values()]):
        if node not in new and any(new.get(a, a) is not a for a in node.args if _is_node(a)):
            args = tuple(new.get(a, a) if _is_node(a) else a for a in node.args)
            new[node] = graph.apply(node.op, args, node.kind)
    return {name: new.get(node, node) for name, node in results.items()}


def _is_node(value: Any) -> bool:
    return isinstance(value, Node)


def _slots(results: dict[str, Node]) -> list[Node]:
    return [node for node in dependencies([*results.values()]) if node.op == "slot"]


def _unfolded(results: dict[str, Node], table: list[Node], graph: Graph) -> dict[str, Node]:
    """The same results with what slots hold in place of the slots."""
    while slots := _slots(results):
        results = _substituted(results, {slot: table[slot.args[0]] for slot in slots}, graph)
    return results


def translated(traced: Traced, params: Any, fixed: dict[str, NDArray]) -> PixelProgram:
    """The program of a traced method; raises `TranslationError`.

    `fixed` are further numbers known with the parameters.
    """
    graph, host = Graph(), ParameterProgram()
    moving = {f"parameter{leaf}" for leaf, _ in traced.directions.numbers}
    known: dict[str, Value] = {}
    for name, value in sorted(host_inputs(params, fixed, traced.directions).items()):
        change = name.startswith("seed")
        known[name] = ParameterValue(host.add_input(value), name not in moving, change)
    tables, starts, outs, excess, changes = [], [], None, [], set()
    for variant in variants(traced.exposed):
        translation = PixelTranslation(graph, host)
        made = translation.run(traced.closed, _inputs(graph, traced, variant, known))
        start, rest = _named(traced, [translation.nodes(v) for v in made])
        starts.append(_unfolded(start, translation.slots, graph))
        if outs is not None and (outs, excess) != (rest, translation.excess):
            raise TranslationError("functions of a point that differ between pieces")
        outs, excess = rest, translation.excess
        tables.append(translation.slots)
        changes |= translation.changes
    assert outs is not None
    outs = _without_zeros(outs, tables, starts, graph)
    after = [outs[f"state{k}"] for k in range(len(traced.state))]
    slopes = None
    count = len(traced.directions.numbers)
    if count:
        names = [*(f"state{k}" for k in traced.followed), *traced.directions.of]
        of = {n: [outs[_slope(n, d)] for d in range(count)] for n in names}
        slopes = slopes_of(of, tables, excess, changes, graph)
    image, variance = outs["mean"], outs["variance"]
    return PixelProgram(host, traced, tables, starts, after, image, variance, excess, slopes)


def host_inputs(
    params: Any, fixed: dict[str, NDArray], directions: Directions
) -> dict[str, NDArray]:
    """The numbers that a host program begins with."""
    leaves = {f"parameter{k}": np.asarray(p) for k, p in enumerate(jax.tree.leaves(params))}
    seeds = jax.tree.leaves(directions.seeds(params)) if directions.numbers else []
    return {**leaves, **fixed, **{f"seed{k}": seed for k, seed in enumerate(seeds)}}


def _named(traced: Traced, made: list[NDArray]) -> tuple[dict[str, Node], dict[str, Node]]:
    """The results of a traced function by name: the state at the start, and all others."""
    start = [f"state{k}" for k in range(len(traced.state))]
    rest = [*start, "mean", "variance"]
    slopes = [f"state{k}" for k in traced.followed] if traced.directions.numbers else []
    lists = start, rest, slopes, [*slopes, "mean", "variance"] if slopes else []
    following = iter(made)
    found: list[dict[str, Node]] = [{}, {}]
    for k, names in enumerate(lists):
        for name in names:
            nodes = np.ravel(next(following))
            if k < 2:
                found[k][name] = nodes[0]
            else:
                found[k - 2] |= {_slope(name, d): node for d, node in enumerate(nodes)}
    return found[0], found[1]


def _without_zeros(
    outs: dict[str, Node], tables: list[list[Node]], starts: list[dict[str, Node]], graph: Graph
) -> dict[str, Node]:
    """The same results without slots and derivatives of the state that are always 0."""
    zero = graph.constant(0.0)

    def nothing(node: Node) -> bool:
        return constant_value(node) == 0

    empty = {s: zero for s in _slots(outs) if all(nothing(t[s.args[0]]) for t in tables)}
    outs = _substituted(outs, empty, graph)
    slopes = {n: graph.input(n, "f", Level.POINT) for n in outs if n.startswith("slope")}
    dead = {name for name in slopes if all(nothing(start[name]) for start in starts)}
    while True:
        found = _substituted(outs, {slopes[name]: zero for name in dead}, graph)
        alive = {name for name in dead if not nothing(found[name])}
        if not alive:
            return found
        dead -= alive


def _slope(result: str, direction: int) -> str:
    """The name of a result's derivative; those of states are inputs too."""
    return f"{result.replace('state', 'slope')}_{direction}"


def _inputs(graph: Graph, traced: Traced, variant: Variant, fixed: dict[str, Value]) -> list[Value]:
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
            return Constant(np.asarray(getattr(variant, name)), at_point=True)
        if name in PAIRS:
            return nodes(shape, counts(name))
        if name in ("grey", "intensity", "certainty"):
            return nodes(shape, lambda r, _: node(f"{name}{min(r, last)}", Level.TABLE))
        if name == "before":
            return nodes(shape, lambda p, _: node(f"before_{'off' if p else 'on'}", Level.TABLE))
        if name == "gain":
            one = graph.constant(1.0)
            return nodes(shape, lambda r: node(f"gain{r}", Level.PIECE) if r <= last else one)
        if name in ("weight_rate", "blend_rate"):
            return nodes(shape, lambda k: node(f"{name}{k}", Level.PIECE))
        if name.startswith("slope"):
            return nodes(shape, lambda d: node(f"{name}_{d}", Level.POINT))
        if name.startswith("state"):
            kind = traced.state[int(name.removeprefix("state"))].kind
            return nodes(shape, lambda: graph.input(name, kind, Level.POINT))
        kind = "i" if name in ("rows", "segment_cell", "polarity") else "f"
        return nodes(shape, lambda *_: graph.input(name, kind, Level.POINT))

    return [of(name, shape) for name, shape in traced.names]
