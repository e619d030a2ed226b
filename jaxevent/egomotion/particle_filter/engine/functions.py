"""The functions of voting, as expressions and as the text of a module."""

import copy
import dataclasses
from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray

from jaxevent.codegen.graph import Graph, Level, Node, ParameterProgram, TranslationError
from jaxevent.codegen.module import KernelCache
from jaxevent.codegen.trace import (
    ELEMENTS,
    TracedFunction,
    TracedProgram,
    name_leaves,
    name_numbers,
    translate_function,
)
from jaxevent.codegen.write import Address, ElementLoop, ModuleText, Writer
from jaxevent.egomotion.models import Model
from jaxevent.egomotion.particle_filter import filtering, likelihood
from jaxevent.egomotion.particle_filter.engine.loop import BLOCK, CELLS, Functions
from jaxevent.egomotion.particle_filter.filtering import Passed, State, Told
from jaxevent.egomotion.particle_filter.likelihood import Event
from jaxevent.egomotion.particle_filter.parameters import Params

FUNCTION = """@cfunc(types.void(CELLS, CELLS, NUMBERS, I), **OPTIONS)
def {name}(cells, work, numbers, count):
    zero = 0
{body}


"""
# Candidates fill their places from the first. `blocks` of `size` motions have ages in common.
EVENT = """@cfunc(types.void(CELLS, CELLS, NUMBERS, CELLS, CELLS, WHOLE, I, I, I), **OPTIONS)
def {name}(cells, work, numbers, d, ages, chosen, count, first, most):
    zero, begin, end = 0, 0, count
{ask}
    if cells[{seen}] == 0:
        return
    for i in range(count * {BLOCK}):
        work[{votes_row} + i] = REAL(0)
    size = {size}
    for begin in range(0, count, size):
        end = begin + size
{span}
        youngest, oldest = cells[{youngest}], cells[{oldest}]
        number = 0
        for c in range(first, first + most):
            age = ages[c]
            if age <= 0:
                break
            chosen[number] = c
            number += 1 if (age >= youngest) & (age <= oldest) else 0
        for k in range(number):
            c = chosen[k]
            cells[{dx}] = d[2 * c]
            cells[{dy}] = d[2 * c + 1]
            cells[{dt}] = ages[c]
{vote}
    begin, end = 0, count
{answer}


"""
PARTICLES = ElementLoop("i", "count", ("work", "numbers", "count"))
LANES = ElementLoop("i", f"begin * {BLOCK}, end * {BLOCK}", ("work", "numbers", "begin", "end"))


@dataclasses.dataclass(frozen=True)
class Layout:
    """Where numbers lie: single ones in cells, those of all particles in rows, by name."""

    cells: dict[str, int]
    rows: dict[str, int]
    truths: frozenset[str]
    room: int  # of a row

    def places(self) -> dict[str, Address]:
        """Where the numbers are read."""
        places = {name: ("work", "i", row * self.room) for name, row in self.rows.items()}
        return places | {name: ("cells", "zero", at) for name, at in self.cells.items()}

    def stores(self) -> dict[str, str]:
        """Texts that write them."""
        stores = {name: f"work[i + {row * self.room}] = {{}}" for name, row in self.rows.items()}
        for name, at in self.cells.items():
            value = "REAL(1) if {} else REAL(0)" if name in self.truths else "{}"
            stores[name] = f"cells[{at}] = {value}"
        return stores

    def rows_of(self, name: str) -> NDArray[np.int64]:
        """The rows of an array of all particles."""
        found = {n: row for n, row in self.rows.items() if n.rpartition(".")[0] == name}
        return np.array([found[f"{name}.{k}"] for k in range(len(found))], np.int64)


def _with_f(model: Model, f: Any) -> Model:
    """The model with another focal length, which is an input, so that one program serves all."""
    model = copy.copy(model)
    object.__setattr__(model, "f", f)
    return model


class Tracing:
    """Traces functions, and remembers where what they take and make lies."""

    def __init__(self, params: Params, model: Model, dtype: np.dtype):
        self.params, self.model, self.dtype = params, model, dtype
        self.graph, self.host = Graph(), ParameterProgram()
        for leaf in jax.tree.leaves(params):
            self.host.add_input(np.asarray(leaf))
        self.cells = {name: at for at, name in enumerate(CELLS)}
        self.rows: dict[str, int] = {}
        self.truths: set[str] = set()
        self.functions: dict[str, TracedFunction] = {}
        self.f = self.shape()

    def shape(self, *size: int, kind: Any = None) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct(size, self.dtype if kind is None else kind)

    def add(
        self, name: str, function: Any, given: dict[str, Any], alias: bool = False
    ) -> dict[str, Any]:
        """Translate `function(params, model, **given)`; what it makes, as it is given to others.

        What is the same for all particles is one number for the functions that take it. With
        `alias` results that are inputs are where these are.
        """
        given, trees = {**given, "f": self.f}, {}

        def call(params: Any, f: Any, **given: Any) -> dict[str, Any]:
            made = function(params, _with_f(self.model, f), **given)
            shapes = jax.tree.map(lambda v: jax.ShapeDtypeStruct(v.shape, v.dtype), made)
            trees.update(shapes)
            return made

        made = translate_function(call, self.params, given, self.graph, self.host)
        for key, tree in given.items():
            self._lay_out(key, tree)
        self.functions[name] = made
        return {key: self._lay_out(key, tree, made, alias) for key, tree in trees.items()}

    def _lay_out(
        self, key: str, tree: Any, made: TracedFunction | None = None, alias: bool = False
    ) -> Any:
        leaves = []
        for name, leaf in name_leaves(key, tree).items():
            names = name_numbers(name, leaf)
            of_all = ELEMENTS in leaf.shape
            if made is not None and of_all:
                nodes = [made.results[number] for number in names]
                of_all = any(node.level == Level.ELEMENT for node in nodes)
                if of_all:
                    made.results.update(zip(names, map(self._of_all, nodes), strict=True))
            where = self.rows if of_all else self.cells
            for number in names:
                source = made.results[number] if made is not None else None
                if alias and of_all and source is not None and source.op == "input":
                    where.setdefault(number, where[source.args[0]])
                where.setdefault(number, len(set(where.values())))
                if leaf.dtype == bool:
                    self.truths.add(number)
            leaves.append(leaf if of_all or ELEMENTS not in leaf.shape else self.shape())
        return jax.tree.unflatten(jax.tree.structure(tree), leaves)

    def _of_all(self, node: Node) -> Node:
        """A number of all particles, even where it is the same for all."""
        if node.level == Level.ELEMENT:
            return node
        return self.graph.node("max", (node, node), node.kind, Level.ELEMENT)


def program_of(params: Params, model: Model, dtype: np.dtype) -> TracedProgram:
    """Voting's functions, translated; raises `TranslationError`."""
    if params.likelihood == "literal":
        raise TranslationError('likelihood = "literal"')
    trace = Tracing(params, model, dtype)
    shape, d = trace.shape, model.dimension
    cloud, each, flag = shape(ELEMENTS, d), shape(ELEMENTS), shape(kind=bool)
    # Classes that check what they are given take shapes in a trace.
    state, passed, event, told = jax.eval_shape(
        lambda cloud, each, flag, one, two, four: (
            State(cloud, each, flag, one, one, one, one),
            Passed(one, one, flag),
            Event(two, four, flag, one, one),
            Told(each, one, one),
        ),
        *(cloud, each, flag, shape(), shape(2), shape(2, 2)),
    )

    def propagate(params, model, state, passed, normal):
        moved, weights = filtering.propagate(params, model, state, passed, normal)
        return {"moved": moved, "weights": weights}

    trace.add("propagate", propagate, {"state": state, "passed": passed, "normal": cloud})
    for name, searching in (("follow", False), ("search", True)):
        _add_event(trace, name, searching, event, cloud, each)

    def weigh(params, model, state, passed, moved, told):
        return {"found": filtering.weigh(params, model, state, passed, moved, told)}

    trace.add("weigh", weigh, {"state": state, "passed": passed, "moved": cloud, "told": told})

    def restart(params, model, cloud):
        anew, middle, widest = filtering.restart(params, model, cloud)
        return {"anew": anew, "middle": middle, "widest": widest}

    trace.add("restart", restart, {"cloud": cloud})
    room = BLOCK * -(-params.particles // BLOCK)
    layout = Layout(trace.cells, trace.rows, frozenset(trace.truths), room)
    return TracedProgram(trace.functions, trace.host, layout, dtype)


def _add_event(
    trace: Tracing, name: str, searching: bool, event: Any, cloud: Any, each: Any
) -> None:
    """What an event says: functions before, of and after its candidates, and of their ages."""
    key, shape = f"{name}_asked", trace.shape

    def ask(params, model, event, at, share):
        asked = likelihood.ask(params, model, event, at, share, searching)
        return {key: asked, "seen": asked.seen, "lag": likelihood.lag(params, asked.tau)}

    def span(params, model, **asked):
        looked = asked[key].ages
        return {"youngest": looked.youngest.min(), "oldest": looked.oldest.max()}

    def vote(params, model, d, dt, S, **asked):
        return {"S": likelihood.add_votes(params, d, dt, asked[key], S, searching)}

    def answer(params, model, event, S, share, reach, total, **asked):
        told = likelihood.answer(
            params, model, event, asked[key], S, share, searching, reach
        )  # fmt: skip
        return {"total": total + told.log_likelihood, "votes": told.votes, "chance": told.chance}

    given = {"event": event, "at": cloud, "share": each}
    asked = {key: trace.add(f"{name}_ask", ask, given, alias=True)[key]}
    trace.add(f"{name}_span", span, asked)
    trace.add(f"{name}_vote", vote, {"d": shape(2), "dt": shape(), "S": each, **asked})
    given = {"event": event, "S": each, "share": each, "reach": shape(), "total": each, **asked}
    trace.add(f"{name}_answer", answer, given)


def write(program: TracedProgram) -> ModuleText:
    """The text of a program's module."""
    layout = program.layout
    places, stores = layout.places(), layout.stores()
    writer, out = Writer(program, places), []

    def body(name: str, indent: int = 4, loop: ElementLoop = LANES) -> str:
        function = program.functions[name]
        changed = {
            key: stores[key]
            for key, node in function.results.items()
            if node.op != "input" or places[node.args[0]] != places[key]
        }
        return "\n".join(writer.body(name, function, changed, loop, indent))

    for name in ("propagate", "weigh", "restart"):
        out.append(FUNCTION.format(name=name, body=body(name, loop=PARTICLES)))
    at = {key.partition(".")[0]: n for key, n in layout.cells.items()}
    for name in ("follow", "search"):
        apart = any(key.startswith(f"{name}_asked.ages") for key in layout.rows)
        out.append(
            EVENT.format(
                name=name,
                BLOCK=BLOCK,
                size="1" if apart else "count",
                ask=body(f"{name}_ask"),
                span=body(f"{name}_span", 8),
                vote=body(f"{name}_vote", 12),
                answer=body(f"{name}_answer"),
                votes_row=layout.rows["S.0"] * layout.room,
                dx=layout.cells["d.0"],
                dy=layout.cells["d.1"],
                **{key: at[key] for key in ("seen", "youngest", "oldest", "dt")},
            )
        )
    about = "The functions of voting (`jaxevent.egomotion.particle_filter.engine`)."
    return writer.module(about, out, layout)


@dataclasses.dataclass(frozen=True)
class Kernel:
    """Voting compiled for the host, with the numbers of its parameters."""

    functions: Functions
    layout: Layout
    numbers: NDArray[np.float64]


_kernels = KernelCache(Functions, write, max_nodes=6000)


def kernel_of(params: Params, model: Model, dtype: np.dtype) -> Kernel:
    """The kernel of a model with its parameters; raises `TranslationError`."""
    tree = jax.tree.structure(params)
    own, kind = jax.tree.flatten(_with_f(model, 1.0))
    if own:
        raise TranslationError("numbers that the model holds")
    made = _kernels.get((kind, tree, dtype), params, lambda: program_of(params, model, dtype))
    return Kernel(made.functions, made.places, made.numbers)
