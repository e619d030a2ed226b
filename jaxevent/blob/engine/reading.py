"""What is read of one target, as expressions and as the text of a module."""

import itertools
from typing import NamedTuple

import jax
import numpy as np
from numpy.typing import NDArray

from jaxevent.blob.engine.replay import COVARIANCE, DT, MEAN, SILENCE, F, Functions, P, X
from jaxevent.blob.engine.target import FUNCTION, Kernel
from jaxevent.blob.params import TrackerParams
from jaxevent.blob.states import canonical
from jaxevent.blob.steps import Filter
from jaxevent.blob.targets import own_params, predict, stands_still
from jaxevent.codegen.graph import Graph, ParameterProgram, constant_value
from jaxevent.codegen.module import KernelCache
from jaxevent.codegen.trace import TracedProgram, translate_function
from jaxevent.codegen.write import ModuleText, Writer

OUT = {"x": X, "P": P, "F": F, "mean": MEAN, "covariance": COVARIANCE}  # places in `work`


class _Reading(NamedTuple):
    """What is told of one target, by names: functions of parameters and its numbers."""

    filter: Filter

    def moved(self, params, slot, dt, silence):
        own = own_params(params, slot.own)
        state = predict(self.filter, own, slot.state, dt, stands_still(own, silence))
        x, P = self.filter.moments(own, state)
        return {"x": x, "P": P}

    def passed(self, params, slot, dt, silence):
        if self.filter.transition is None:
            return {}
        own = own_params(params, slot.own)
        return {"F": self.filter.transition(own, dt, stands_still(own, silence))}

    def canonical(self, params, x, P):
        mean, covariance = canonical(x, P)
        return {"mean": mean, "covariance": covariance}


def program_of(filter: Filter, params: TrackerParams, of: Kernel, dtype: np.dtype) -> TracedProgram:
    """The functions, translated; raises `TranslationError`."""
    host, graph, reading = ParameterProgram(), Graph(), _Reading(filter)
    for leaf in jax.tree.leaves(params):
        host.add_input(np.asarray(leaf))

    def shape(*size: int) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct(size, dtype)

    at = {"slot": of.slot, "dt": shape(), "silence": shape()}
    functions = {
        "moved": (reading.moved, at),
        "passed": (reading.passed, at),
        "canonical": (reading.canonical, {"x": shape(8), "P": shape(8, 8)}),
    }
    made = {
        name: translate_function(function, params, given, graph, host, single=True)
        for name, (function, given) in functions.items()
    }
    return TracedProgram(made, host, of.layout, dtype)


def write(program: TracedProgram) -> ModuleText:
    """The text of a program's module."""
    work = {"dt.0": ("work", "row", DT), "silence.0": ("work", "row", SILENCE)}
    for name, size in (("x", 8), ("P", 64)):
        work |= {f"{name}.{k}": ("work", "row", OUT[name] + k) for k in range(size)}
    writer, out = Writer(program, program.layout.places() | work), []
    for name, function in program.functions.items():
        store = {}
        for key in function.results:
            what, number = key.split(".")
            store[key] = f"work[{OUT[what] + int(number)}] = {{}}"
        lines = writer.body(name, function, store)
        widths = len(program.layout.cells), len(program.layout.whole)
        out.append(
            FUNCTION.format(
                name=name, body="\n".join(lines), width=widths[0], whole_width=widths[1]
            )
        )
    return writer.module("What is read of a target (`jaxevent.blob.engine`).", out, program.layout)


def blocks_of(program: TracedProgram) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The 8 numbers of a target in an order, and where blocks of it begin.

    Numbers of two blocks have no covariance and do not pass into each other.
    """
    moved, passed = (program.functions[name].results for name in ("moved", "passed"))
    tied = np.eye(8, dtype=bool)
    for i, j in itertools.product(range(8), range(8)):
        entries = moved[f"P.{8 * i + j}"], passed.get(f"F.{8 * i + j}")
        tied[i, j] |= any(node is not None and constant_value(node) != 0 for node in entries)
    tied |= tied.T
    for k in range(8):
        tied |= tied[:, k, None] & tied[k]
    first = np.argmax(tied, axis=1)  # of each one's block
    order = np.argsort(first, kind="stable")
    begins = np.flatnonzero(np.diff(first[order], prepend=-1))
    return order, np.append(begins, 8)


_kernels = KernelCache(Functions, write, max_nodes=4000)


def functions_of(
    filter: Filter, params: TrackerParams, of: Kernel, dtype: np.dtype
) -> tuple[Functions, NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]:
    """The functions with their numbers, and `blocks_of`; raises `TranslationError`."""
    leaves, tree = jax.tree.flatten(params)
    own = tuple(name for name in of.layout.cells if name.startswith("slot.own"))
    key = filter, tree, tuple(np.shape(leaf) for leaf in leaves), own, dtype, len(of.layout.cells)
    made = _kernels.get(key, params, lambda: program_of(filter, params, of, dtype))
    return made.functions, made.numbers, *blocks_of(made.program)
