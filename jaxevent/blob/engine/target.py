"""The functions of one target, as expressions and as the text of a module."""

import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from jaxevent.blob.association import share
from jaxevent.blob.engine.loop import (
    AGE,
    CELLS,
    DENSITY,
    HELD,
    NEAR,
    POLARITY,
    ROWS,
    TARGETS,
    VALID,
    WEIGHT,
    WHOLE,
    Functions,
    X,
    Y,
)
from jaxevent.blob.lifecycle import expect, judge
from jaxevent.blob.params import TrackerParams
from jaxevent.blob.steps import Batch, Filter
from jaxevent.blob.targets import (
    Slots,
    look_ahead,
    own_params,
    silence_limits,
    start_gate,
    update_slot,
)
from jaxevent.codegen.graph import Graph, ParameterProgram, TranslationError
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

FUNCTION = """@cfunc(types.void(CELLS, WHOLE, CELLS, WHOLE, NUMBERS, I, I, I, I), **OPTIONS)
def {name}(cells, whole, work, marks, numbers, target, row, room, count):
    of_cells, of_whole = target * {width}, target * {whole_width}
{body}


"""
ALONE = """@numba.njit(**LOOP_OPTIONS)
def alone_0(work, numbers, row, room, count):
    for i in range(count):
{body}


"""
EVENTS = ElementLoop("i", "count", ("work", "marks", "row", "room", "count"))
TARGETS_OF_EVENT = ElementLoop("k", "count", ("work", "marks", "row", "room", "count"))


@dataclasses.dataclass(frozen=True)
class Layout:
    """Where a target's numbers lie in its rows of `cells` and `whole`, by name."""

    cells: dict[str, int]
    whole: dict[str, int]

    def places(self) -> dict[str, Address]:
        """Where the numbers are read."""
        places = {name: ("cells", "of_cells", at) for name, at in self.cells.items()}
        return places | {name: ("whole", "of_whole", at) for name, at in self.whole.items()}

    def stores(self) -> dict[str, str]:
        """Texts that write them."""
        stores = {name: f"cells[of_cells + {at}] = {{}}" for name, at in self.cells.items()}
        return stores | {name: f"whole[of_whole + {at}] = {{}}" for name, at in self.whole.items()}


@dataclasses.dataclass(frozen=True)
class TargetProgram(TracedProgram):
    """The functions of a filter's target."""

    slot: Any  # the shapes of one target
    single: bool
    graph: Graph


class _Target(NamedTuple):
    """What becomes of one target, by names: functions of parameters and its numbers."""

    filter: Filter
    single: bool  # whether a step has one event

    def begin(self, params: Any, own: Any, xi: Any, size: Any) -> Any:
        return self.filter.start(own_params(params, own), xi, size)

    def start(self, params: Any, slot: Any, xi: Any, size: Any) -> dict[str, Any]:
        gate = start_gate(params, size).astype(xi.dtype)
        return {"slot.state": self.begin(params, slot.own, xi, size), "slot.gate": gate}

    def slot(self, params: Any, own: Any, xi: Any, size: Any, time: Any, known: Any) -> Slots:
        state = self.begin(params, own, xi, size)
        return Slots(state, size, size, time, time, time, time, time, known, own)

    def ahead(self, params, slot, limit, time, batch, valid, owner):
        batch = _aged(batch, self.single)
        return {"ahead": look_ahead(self.filter, params, slot, limit, time, batch, valid, owner)}

    def update(self, params, slot, ahead, time, batch, weight):
        batch = _aged(batch, self.single)
        return {"slot": update_slot(self.filter, params, slot, ahead, time, batch, weight)}

    def solo(self, params, slot, limit, time, batch, valid, owner):
        """A step of one event and of the one target that is alive."""
        batch = _aged(batch, self.single)
        seen = look_ahead(self.filter, params, slot, limit, time, batch, valid, owner)
        shares = jax.vmap(functools.partial(self.filter.share, params), 1, 1)
        weight = shares(seen.inside[None], seen.density[None])[0]
        return {
            "slot": update_slot(self.filter, params, slot, seen, time, batch, weight),
            "ahead.near": seen.near,
            "touched": (weight > 0).any(),
        }

    def limit(self, params, slot):
        return {"limit": silence_limits(params, slot)}

    def expected(self, params, slot, stop):
        now = expect(self.filter, params, slot, stop)
        return {"now": now, "p": now.p, "long": now.size.max()}

    def verdict(self, params, frame, slot, now, inside, found, stop):
        return {"verdict": judge(params, frame, slot, now, inside, found, stop)}

    def shared(self, params, held, density):
        return {"weight": self.filter.share(params, held, density)}


def program_of(
    filter: Filter, params: TrackerParams, own: dict[str, Any], owned: bool, dtype: np.dtype
) -> TargetProgram:
    """The functions of one target, translated; raises `TranslationError`.

    `own` are a target's own numbers, `owned` says whether events have owners.
    """
    single = params.events_per_step == 1
    host, graph, target = ParameterProgram(), Graph(), _Target(filter, single)
    for leaf in jax.tree.leaves(params):
        host.add_input(np.asarray(leaf))

    def shape(*size: int, kind: Any = dtype) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct(size, kind)

    owns = {name: shape() for name in own}
    times, flag = shape(kind=np.int32), shape(kind=bool)
    slot = jax.eval_shape(target.slot, params, owns, shape(2), shape(), times, flag)
    events = ELEMENTS if not single else 1
    batch = jax.eval_shape(Batch, shape(events, 2), shape(events), shape(events))
    owner = shape(events, 2, kind=np.int32) if owned else None
    valid = shape(events, kind=bool)
    given = {"slot": slot, "time": times, "batch": batch}
    seen = {**given, "limit": times, "valid": valid, "owner": owner}
    looked = jax.eval_shape(lambda p, v: target.ahead(p, **v)["ahead"], params, seen)
    now = jax.eval_shape(lambda p, v: target.expected(p, **v)["now"], params,
        {"slot": slot, "stop": times})  # fmt: skip
    shared = {"held": shape(ELEMENTS, kind=bool), "density": shape(ELEMENTS)}
    functions = {
        "start": (target.start, {"slot": slot, "xi": shape(2), "size": shape()}, True),
        "solo": (target.solo, seen, single),
        "ahead": (target.ahead, seen, single),
        "alone": (target.shared, shared, True),
        "share": (target.shared, shared, False),
        "update": (target.update, {**given, "ahead": looked, "weight": shape(events)}, single),
        "limit": (target.limit, {"slot": slot}, True),
        "expected": (target.expected, {"slot": slot, "stop": times}, True),
        "verdict": (
            target.verdict,
            {"frame": shape(2), "slot": slot, "now": now, "inside": flag, "found": flag,
             "stop": times},
            True,
        ),
    }  # fmt: skip
    made = {
        name: translate_function(function, params, values, graph, host, single=alone)
        for name, (function, values, alone) in functions.items()
    }
    layout = _layout({"slot": slot, "ahead": looked, "now": now})
    return TargetProgram(made, host, layout, dtype, slot, single, graph)


def _aged(batch: Batch, single: bool) -> Batch:
    """A single event's age is 0 for the compiler too, as in `targets.step`."""
    return Batch(batch.xi, jnp.zeros_like(batch.xi[:, 0]), batch.polarity) if single else batch


def _layout(trees: dict[str, Any]) -> Layout:
    """The driver's own numbers first, then all others of one target."""
    cells, whole = ({name: k for k, name in enumerate(names)} for names in (CELLS, WHOLE))
    for name, tree in trees.items():
        for leaf_name, leaf in name_leaves(name, tree).items():
            if ELEMENTS in leaf.shape:
                continue
            real = leaf.dtype.kind == "f"
            for number in name_numbers(leaf_name, leaf):
                (cells if real else whole).setdefault(number, len(cells if real else whole))
    return Layout(cells, whole)


def _elements(single: bool) -> tuple[dict[str, str], dict[str, str]]:
    """Texts that read and write the numbers of an event, in the loop over a step's events."""
    i = "0" if single else "i"
    read = {
        "batch.xi.0": f"work[{X} * room + {i}]",
        "batch.xi.1": f"work[{Y} * room + {i}]",
        "batch.age.0": f"work[{AGE} * room + {i}]",
        "batch.polarity.0": f"work[{POLARITY} * room + {i}]",
        "valid.0": f"work[{VALID} * room + {i}] != 0",
        "owner.0": f"marks[{i}]",
        "owner.1": f"marks[room + {i}]",
        "ahead.inside.0": f"work[(row + {HELD}) * room + {i}] != 0",
        "ahead.near.0": f"work[(row + {NEAR}) * room + {i}] != 0",
        "ahead.density.0": f"work[(row + {DENSITY}) * room + {i}]",
        "weight.0": f"work[(row + {WEIGHT}) * room + {i}]",
    }
    truth = "work[(row + {at}) * room + {i}] = REAL(1) if {{}} else REAL(0)"
    write = {
        "ahead.inside.0": truth.format(at=HELD, i=i),
        "ahead.near.0": truth.format(at=NEAR, i=i),
        "ahead.density.0": f"work[(row + {DENSITY}) * room + {i}] = {{}}",
    }
    return read, write


def _of_targets(row: str, i: str) -> tuple[dict[str, str], dict[str, str]]:
    """The same for what targets say of an event."""
    read = {
        "held.0": f"work[({row} + {HELD}) * room + {i}] != 0",
        "density.0": f"work[({row} + {DENSITY}) * room + {i}]",
        "element": "k",
    }
    return read, {"weight.0": f"work[({row} + {WEIGHT}) * room + {i}] = {{}}"}


def _branches(
    writer: Writer, program: TargetProgram, function: TracedFunction, stores: dict[str, str]
) -> list[str]:
    """The lines of a step of one event, which is the target's or leaves it as it is.

    Whether it is near the target is told where `count` is not 0.
    """
    truth, cases = function.results["touched.0"], []
    for line, value in (("if {}:", True), ("else:", False)):
        case = program.graph.suppose(function.results, truth, value)
        changed = {k: n for k, n in case.items() if k.startswith("slot") and n.args != (k,)}
        if value:
            changed["touched.0"] = program.graph.constant(True)
        if changed:
            cases.append((line, changed))
    cases.append(("if count:", {"ahead.near.0": function.results["ahead.near.0"]}))
    return writer.branches(truth, cases, stores)


def write(program: TargetProgram) -> ModuleText:
    """The text of a program's module."""
    read, store = _elements(program.single)
    places, stores = program.layout.places(), program.layout.stores()
    writer = Writer(program, places | read)
    out = []
    for name, function in program.functions.items():
        if name == "alone":
            writer.addresses, to = _of_targets("row", "i")
            lines = writer.lines([*function.results.values()], 8)
            for key, node in function.results.items():
                lines.append(f"        {to[key].format(writer.name(node))}")
            writer.loops.append(ALONE.format(body="\n".join(lines)))
            lines = ["    alone_0(work, numbers, row, room, count)"]
        elif name == "share":
            writer.addresses, to = _of_targets(f"{TARGETS} + {ROWS} * k", "row")
            lines = writer.body(name, function, to, TARGETS_OF_EVENT)
        else:
            writer.addresses = places | read
            changed = {
                key: text
                for key, text in (stores | store).items()
                if key in function.results and function.results[key].args != (key,)
            }
            truth = function.results.get("touched.0")
            if program.single and truth is not None:
                lines = _branches(writer, program, function, stores | store)
            else:
                lines = writer.body(name, function, changed, EVENTS)
        out.append(
            FUNCTION.format(
                name=name,
                body="\n".join(lines),
                width=len(program.layout.cells),
                whole_width=len(program.layout.whole),
            )
        )
    return writer.module(
        "The functions of one target (`jaxevent.blob.engine`).", out, program.layout
    )


@dataclasses.dataclass(frozen=True)
class Kernel:
    """A filter compiled for the host, with the numbers of its parameters."""

    functions: Functions
    layout: Layout
    numbers: NDArray[np.float64]
    slot: Any  # the shapes of one target


_kernels = KernelCache(Functions, write, max_nodes=4000)


def kernel_of(
    filter: Filter, params: TrackerParams, own: dict[str, Any], owned: bool, dtype: np.dtype
) -> Kernel:
    """The kernel of a filter with its parameters; raises `TranslationError`."""
    if params.association == "authors":
        raise TranslationError('association = "authors"')
    leaves, tree = jax.tree.flatten(params)
    key = filter, tree, tuple(np.shape(leaf) for leaf in leaves), tuple(own), owned, dtype
    made = _kernels.get(key, params, lambda: program_of(filter, params, own, owned, dtype))
    return Kernel(made.functions, made.places, made.numbers, made.program.slot)


def shares_apart(filter: Filter) -> bool:
    """Whether an event that one gate alone holds is weighed by that target alone."""
    return filter.share is share
