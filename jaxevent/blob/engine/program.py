"""The functions of one track, traced to expressions and written as a module for numba."""

import collections
import dataclasses
import functools
import itertools
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from jaxevent.blob.engine import loop, smoother_loop
from jaxevent.blob.engine.loop import ROWS_PER_TRACK, TRACKS, TrackFunctions
from jaxevent.blob.engine.smoother_loop import ReadoutFunctions
from jaxevent.blob.filter import EventBatch, Filter
from jaxevent.blob.lifecycle import TrackEvidence, decide_track, predict_measurement
from jaxevent.blob.params import TrackerParams
from jaxevent.blob.track import (
    StepEvents,
    TrackBuffer,
    canonical_ellipse,
    coast_limits_us,
    initial_gate,
    is_static,
    predict,
    predict_and_gate,
    track_params,
    update_track,
)
from jaxevent.codegen.derivative import is_real
from jaxevent.codegen.graph import Graph, ParameterProgram, TranslationError, constant_value
from jaxevent.codegen.module import KernelCache
from jaxevent.codegen.trace import (
    ELEMENT_AXIS_LENGTH,
    TracedFunction,
    TracedProgram,
    named_leaves,
    number_names,
    translate_function,
)
from jaxevent.codegen.write import Address, ElementLoop, ModuleText, ModuleWriter

MAX_OPERATIONS = 4000  # of a module; beyond, numba compiles longer than XLA's scan takes

FUNCTION_TEXT = """@cfunc(types.void(CELLS, WHOLE, CELLS, WHOLE, NUMBERS, I, I, I, I), **OPTIONS)
def {name}(reals, integers, work, owners, numbers, target, row, size, count):
    of_reals, of_integers = target * {n_reals}, target * {n_integers}
{body}


"""
ALONE_TEXT = """@numba.njit(**LOOP_OPTIONS)
def alone_0(work, numbers, row, size, count):
    for i in range(count):
{body}


"""
LOOP_ARGUMENTS = ("work", "owners", "row", "size", "count")
EVENT_LOOP = ElementLoop("i", "count", LOOP_ARGUMENTS)
TRACK_LOOP = ElementLoop("k", "count", LOOP_ARGUMENTS)


@dataclasses.dataclass(frozen=True)
class Layout:
    """Columns of a track's numbers in its rows of `reals` and `integers`, by name."""

    reals: dict[str, int]
    integers: dict[str, int]

    def places(self) -> dict[str, Address]:
        """Return the places from which the numbers are read."""
        places = {name: ("reals", "of_reals", at) for name, at in self.reals.items()}
        return places | {
            name: ("integers", "of_integers", at) for name, at in self.integers.items()
        }

    def stores(self) -> dict[str, str]:
        """Return the texts that write the numbers."""
        stores = {name: f"reals[of_reals + {at}] = {{}}" for name, at in self.reals.items()}
        return stores | {
            name: f"integers[of_integers + {at}] = {{}}" for name, at in self.integers.items()
        }

    def function(self, name: str, lines: list[str]) -> str:
        """Return the text of a function with these lines."""
        return FUNCTION_TEXT.format(
            name=name,
            body="\n".join(lines),
            n_reals=len(self.reals),
            n_integers=len(self.integers),
        )


@dataclasses.dataclass(frozen=True)
class TrackProgram(TracedProgram):
    """The traced functions of a filter's track."""

    track: Any  # the shapes of one track
    single: bool  # whether a step has one event
    graph: Graph


# Several functions below call them: JAX traces them once.
_predict_and_gate, _update_track, _predict_measurement = (
    jax.jit(function, static_argnums=0)
    for function in (predict_and_gate, update_track, predict_measurement)
)


class TrackVariant(NamedTuple):
    """Inputs and outputs of a track's functions beside those that all have.

    Attributes:
        overrides: Names of the parameters that differ between tracks.
        has_owners: Whether only some tracks may own an event.
        tangents: Whether the functions have tangents along a direction in the parameters.
    """

    overrides: tuple[str, ...] = ()
    has_owners: bool = False
    tangents: bool = False

    def known(self, params: TrackerParams, along: tuple[str, int] | None = None) -> Any:
        """Return the first argument of the functions: parameters, and with tangents a direction.

        The direction has all numbers that can move, so that one kernel serves every fit.

        Args:
            params: Parameters of the tracker.
            along: Name of the parameter that changes, and index in it; None: none does.

        Returns:
            The parameters, or a pair of them and of the direction.
        """
        if not self.tangents:
            return params
        stuck = params.names_without_gradient()
        raw = {name: np.asarray(leaf) for name, leaf in params.raw.items() if name not in stuck}
        direction = {n: np.zeros_like(leaf) for n, leaf in raw.items() if np.isfinite(leaf).all()}
        if along is not None and along[0] in direction:
            direction[along[0]].reshape(-1)[along[1]] = 1
        return params, direction


class _TrackSteps(NamedTuple):
    """Functions of one track to be traced: of parameters and of numbers by name."""

    filter: Filter
    single: bool

    def init(self, params: Any, track: Any, xi: Any, size: Any) -> dict[str, Any]:
        size = jnp.where(size > 0, size, params.lambda0).astype(xi.dtype)
        state = self.filter.init(track_params(params, track.overrides), xi, size)
        gate = initial_gate(params, size).astype(xi.dtype)
        return {"track.state": state, "track.gate": gate}

    def predict(self, params: Any, track: Any, limit: Any, events: Any) -> dict[str, Any]:
        events = self._zero_age(events)
        return {"prediction": _predict_and_gate(self.filter, params, track, limit, events)}

    def update(
        self, params: Any, track: Any, prediction: Any, events: Any, weight: Any
    ) -> dict[str, Any]:
        events = self._zero_age(events)
        return {"track": _update_track(self.filter, params, track, prediction, events, weight)}

    def step(self, params: Any, track: Any, limit: Any, events: Any) -> dict[str, Any]:
        events = self._zero_age(events)
        prediction = _predict_and_gate(self.filter, params, track, limit, events)
        weights = jax.vmap(functools.partial(self.filter.association_weights, params), 1, 1)
        weight = weights(prediction.inside[None], prediction.log_likelihood[None])[0]
        return {
            "track": _update_track(self.filter, params, track, prediction, events, weight),
            "prediction.near": prediction.near,
            "touched": (weight > 0).any(),
        }

    def limit(self, params: Any, track: Any) -> dict[str, Any]:
        return {"limit": coast_limits_us(params, track)}

    def measurement(self, params: Any, track: Any, stop: Any) -> dict[str, Any]:
        predicted = _predict_measurement(self.filter, params, track, stop)
        long = predicted.size.max()
        return {"evidence.predicted": predicted, "p": predicted.p, "long": long}

    def decide_track(
        self, params: Any, frame: Any, track: Any, evidence: Any, stop: Any
    ) -> dict[str, Any]:
        return {"decision": decide_track(params, frame, track, evidence, stop)}

    def weights(self, params: Any, inside: Any, log_likelihood: Any) -> dict[str, Any]:
        return {"weight": self.filter.association_weights(params, inside, log_likelihood)}

    def _zero_age(self, events: StepEvents) -> StepEvents:
        """Set a single event's age to 0 for the compiler too, as `track.run_steps` does."""
        if not self.single:
            return events
        batch = events.batch
        batch = EventBatch(batch.xi, jnp.zeros_like(batch.xi[:, 0]), batch.polarity)
        return dataclasses.replace(events, batch=batch)


class _TangentSteps(NamedTuple):
    """Functions of one track with tangents: derivatives along one direction in the parameters.

    `known` holds the parameters, and the direction: by name the changes of those that move.
    `tangent` is that of the track's state, `predicted` that of the predicted one.
    """

    steps: _TrackSteps

    def init(self, known: Any, track: Any, xi: Any, size: Any) -> dict[str, Any]:
        made, tangents = _push_forward(
            lambda params, _: self.steps.init(params, track, xi, size), known, (), ()
        )
        return {**made, "tangent": tangents["track.state"]}

    def predict(
        self, known: Any, track: Any, tangent: Any, limit: Any, events: Any
    ) -> dict[str, Any]:
        def predict(params: Any, state: Any) -> Any:
            moved = dataclasses.replace(track, state=state)
            return self.steps.predict(params, moved, limit, events)["prediction"]

        made, tangents = _push_forward(predict, known, track.state, tangent)
        return {
            "prediction": made,
            "predicted": tangents.state,
            "log_likelihood_tangent": tangents.log_likelihood,
        }

    # A function of a module has all its inputs as arguments.
    def update(
        self,
        known: Any,
        *,
        track: Any,
        tangent: Any,
        prediction: Any,
        predicted: Any,
        events: Any,
        weight: Any,
        weight_tangent: Any,
    ) -> dict[str, Any]:
        def update(params: Any, moving: Any) -> Any:
            before, state, weight = moving
            moved = dataclasses.replace(track, state=before)
            ahead = dataclasses.replace(prediction, state=state)
            return self.steps.update(params, moved, ahead, events, weight)["track"]

        moving = track.state, prediction.state, weight
        made, tangents = _push_forward(update, known, moving, (tangent, predicted, weight_tangent))
        return {"track": made, "tangent": tangents.state}

    def weights(
        self, known: Any, inside: Any, log_likelihood: Any, log_likelihood_tangent: Any
    ) -> dict[str, Any]:
        def divide(params: Any, log_likelihood: Any) -> Any:
            return self.steps.weights(params, inside, log_likelihood)["weight"]

        made, tangent = _push_forward(divide, known, log_likelihood, log_likelihood_tangent)
        return {"weight": made, "weight_tangent": tangent}


def _push_forward(
    function: Callable[[Any, Any], Any], known: Any, moving: Any, tangents: Any
) -> tuple[Any, Any]:
    """Compute a function, and its derivative along a direction.

    Args:
        function: A function of parameters and of a tree.
        known: The parameters, and by name the changes of those that move.
        moving: The tree.
        tangents: Changes of its real numbers.

    Returns:
        The function's result, and the change of its real numbers.
    """
    params, direction = known
    real, rest = eqx.partition(moving, is_real)

    def compute(raw: Any, real: Any) -> tuple[Any, Any]:
        made = function(params.with_raw(raw), eqx.combine(real, rest))
        return eqx.filter(made, is_real), made

    raw = {name: params.raw[name] for name in direction}
    _, changes, made = jax.jvp(compute, (raw, real), (direction, tangents), has_aux=True)
    return made, changes


class _ReadoutSteps(NamedTuple):
    """Functions of the readout to be traced."""

    filter: Filter

    def predict(self, params: Any, track: Any, dt: Any, silence: Any) -> dict[str, Any]:
        own = track_params(params, track.overrides)
        state = predict(self.filter, own, track.state, dt, is_static(own, silence))
        x, P = self.filter.readout(own, state)
        return {"x": x, "P": P}

    def transition(self, params: Any, track: Any, dt: Any, silence: Any) -> dict[str, Any]:
        if self.filter.transition is None:
            return {}
        own = track_params(params, track.overrides)
        return {"F": self.filter.transition(own, dt, is_static(own, silence))}

    def canonical(self, params: Any, x: Any, P: Any) -> dict[str, Any]:
        mean, covariance = canonical_ellipse(x, P)
        return {"mean": mean, "covariance": covariance}


class _Shapes(NamedTuple):
    """Shapes of arrays of one real type."""

    dtype: np.dtype

    def __call__(self, *size: int, kind: Any = None) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct(size, self.dtype if kind is None else kind)


def _host_program(known: Any) -> ParameterProgram:
    host = ParameterProgram()
    for leaf in jax.tree.leaves(known):
        host.add_input(np.asarray(leaf))
    return host


def trace_track(
    filter: Filter,
    known: Any,
    variant: TrackVariant,
    dtype: np.dtype,
) -> TrackProgram:
    """Trace the functions of one track.

    Args:
        filter: Filter of the track.
        known: Parameters of the tracker, and with tangents the direction, see `TrackVariant.known`.
        variant: Inputs and outputs of the functions.
        dtype: Type of real numbers.

    Raises:
        TranslationError: A function has no translation.
    """
    params = known[0] if variant.tangents else known
    single = params.events_per_step == 1
    graph, steps, shape = Graph(), _TrackSteps(filter, single), _Shapes(dtype)
    host = _host_program(known)
    time, flag = shape(kind=np.int32), shape(kind=bool)

    def make_track(params: Any, own: Any, xi: Any, size: Any, time: Any, flag: Any) -> TrackBuffer:
        state = filter.init(track_params(params, own), xi, size)
        return TrackBuffer(state, size, size, time, time, time, time, time, flag, own)

    own = {name: shape() for name in variant.overrides}
    track = jax.eval_shape(make_track, params, own, shape(2), shape(), time, flag)
    M = 1 if single else ELEMENT_AXIS_LENGTH
    batch = jax.eval_shape(EventBatch, shape(M, 2), shape(M), shape(M))
    owner = shape(M, 2, kind=np.int32) if variant.has_owners else None
    events = jax.eval_shape(StepEvents, time, batch, shape(M, kind=bool), owner)
    gated = {"track": track, "limit": time, "events": events}
    at_stop = {"track": track, "stop": time}
    prediction = jax.eval_shape(steps.predict, params, **gated)["prediction"]
    predicted = jax.eval_shape(steps.measurement, params, **at_stop)["evidence.predicted"]
    evidence = jax.eval_shape(TrackEvidence, predicted, flag, flag)
    update = {"track": track, "events": events, "prediction": prediction, "weight": shape(M)}
    weights = {
        "inside": shape(ELEMENT_AXIS_LENGTH, kind=bool),
        "log_likelihood": shape(ELEMENT_AXIS_LENGTH),
    }
    decide = {**at_stop, "frame": shape(2), "evidence": evidence}
    functions = {
        "init": (steps.init, {"track": track, "xi": shape(2), "size": shape()}, True),
        "step": (steps.step, gated, single),
        "predict": (steps.predict, gated, single),
        "weights_alone": (steps.weights, weights, True),
        "weights": (steps.weights, weights, False),
        "update": (steps.update, update, single),
        "limit": (steps.limit, {"track": track}, True),
        "measurement": (steps.measurement, at_stop, True),
        "decide": (steps.decide_track, decide, True),
    }
    columns = {"track": track, "prediction": prediction, "evidence": evidence}
    if variant.tangents:
        state = eqx.filter(track.state, is_real)
        columns |= {"tangent": state, "predicted": state}
        functions = _with_tangents(functions, _TangentSteps(steps), state)
    traced = {
        name: translate_function(function, known, values, graph, host, single=alone)
        for name, (function, values, alone) in functions.items()
    }
    layout = _make_layout(columns)
    return TrackProgram(traced, host, layout, dtype, track, single, graph)


def _with_tangents(
    functions: dict[str, tuple[Any, dict[str, Any], bool]], steps: _TangentSteps, state: Any
) -> dict[str, tuple[Any, dict[str, Any], bool]]:
    """Replace functions of a track by those with tangents.

    Args:
        functions: Functions to be traced, each with its inputs and whether it is of one element.
        steps: Those with tangents.
        state: Shapes of the real numbers of a state.

    Returns:
        The functions; a step in one call has none.
    """

    def ignore_direction(function: Any) -> Any:
        return lambda known, **given: function(known[0], **given)

    new: dict[str, tuple[Any, dict[str, Any]]] = {
        "init": (steps.init, {}),
        "predict": (steps.predict, {"tangent": state}),
        "update": (steps.update, {"tangent": state, "predicted": state}),
        "weights": (steps.weights, {}),
        "weights_alone": (steps.weights, {}),
    }
    out = {}
    for name, (function, given, alone) in functions.items():
        of_events = {
            f"{key}_tangent": given[key] for key in ("weight", "log_likelihood") if key in given
        }
        if name in new:
            out[name] = new[name][0], {**given, **new[name][1], **of_events}, alone
        elif name != "step":
            out[name] = ignore_direction(function), given, alone
    return out


def _make_layout(trees: Mapping[str, Any]) -> Layout:
    """Lay out the loop's own numbers first, then all others of one track."""
    reals = {name: k for k, name in enumerate(loop.REAL_NAMES)}
    integers = {name: k for k, name in enumerate(loop.INTEGER_NAMES)}
    for name, tree in trees.items():
        for leaf_name, leaf in named_leaves(name, tree).items():
            if ELEMENT_AXIS_LENGTH in leaf.shape:
                continue
            columns = reals if leaf.dtype.kind == "f" else integers
            for number in number_names(leaf_name, leaf):
                columns.setdefault(number, len(columns))
    return Layout(reals, integers)


def _event_texts(single: bool) -> tuple[dict[str, str], dict[str, str]]:
    """Return texts that read and write the numbers of an event, in the loop over events."""
    i = "0" if single else "i"

    def of_track(row: int) -> str:
        return f"work[(row + {row}) * size + {i}]"

    read = {
        "events.batch.xi.0": f"work[{loop.X} * size + {i}]",
        "events.batch.xi.1": f"work[{loop.Y} * size + {i}]",
        "events.batch.age.0": f"work[{loop.AGE} * size + {i}]",
        "events.batch.polarity.0": f"work[{loop.POLARITY} * size + {i}]",
        "events.valid.0": f"work[{loop.VALID} * size + {i}] != 0",
        "events.owner.0": f"owners[{i}]",
        "events.owner.1": f"owners[size + {i}]",
        "prediction.inside.0": f"{of_track(loop.INSIDE)} != 0",
        "prediction.near.0": f"{of_track(loop.NEAR)} != 0",
        "prediction.log_likelihood.0": of_track(loop.LOG_LIKELIHOOD),
        "log_likelihood_tangent.0": of_track(loop.LOG_LIKELIHOOD_TANGENT),
        "weight.0": of_track(loop.WEIGHT),
        "weight_tangent.0": of_track(loop.WEIGHT_TANGENT),
    }
    truth = " = REAL(1) if {} else REAL(0)"
    write = {
        "prediction.inside.0": of_track(loop.INSIDE) + truth,
        "prediction.near.0": of_track(loop.NEAR) + truth,
        "prediction.log_likelihood.0": of_track(loop.LOG_LIKELIHOOD) + " = {}",
        "log_likelihood_tangent.0": of_track(loop.LOG_LIKELIHOOD_TANGENT) + " = {}",
    }
    return read, write


def _weight_texts(row: str, i: str) -> tuple[dict[str, str], dict[str, str]]:
    """Return texts that read and write the numbers of an event for a track."""

    def of_track(at: int) -> str:
        return f"work[({row} + {at}) * size + {i}]"

    read = {
        "inside.0": of_track(loop.INSIDE) + " != 0",
        "log_likelihood.0": of_track(loop.LOG_LIKELIHOOD),
        "log_likelihood_tangent.0": of_track(loop.LOG_LIKELIHOOD_TANGENT),
        "element": "k",
    }
    write = {
        "weight.0": of_track(loop.WEIGHT) + " = {}",
        "weight_tangent.0": of_track(loop.WEIGHT_TANGENT) + " = {}",
    }
    return read, write


def _step_lines(
    writer: ModuleWriter, program: TrackProgram, function: TracedFunction, stores: dict[str, str]
) -> list[str]:
    """Write a step of one event, which updates the track or leaves it unchanged.

    Whether it is near the track is stored where `count` is not 0.
    """
    truth, cases = function.results["touched.0"], []
    for line, value in (("if {}:", True), ("else:", False)):
        case = program.graph.assume_truth(function.results, truth, value)
        changed = {k: n for k, n in case.items() if k.startswith("track.") and n.args != (k,)}
        if value:
            changed["touched.0"] = program.graph.constant(True)
        if changed:
            cases.append((line, changed))
    cases.append(("if count:", {"prediction.near.0": function.results["prediction.near.0"]}))
    return writer.write_branches(truth, cases, stores)


def write_track(program: TrackProgram) -> ModuleText:
    """Write the module of a track's functions."""
    read, write = _event_texts(program.single)
    places, stores = program.layout.places() | read, program.layout.stores() | write
    writer, texts = ModuleWriter(program, places), []
    for name, function in program.functions.items():
        results = function.results
        if name == "weights_alone":
            writer.addresses, to = _weight_texts("row", "i")
            lines = writer.write_lines([*results.values()], 8)
            lines += [f"        {to[k].format(writer.node_name(n))}" for k, n in results.items()]
            writer.loops.append(ALONE_TEXT.format(body="\n".join(lines)))
            lines = ["    alone_0(work, numbers, row, size, count)"]
        elif name == "weights":
            writer.addresses, to = _weight_texts(f"{TRACKS} + {ROWS_PER_TRACK} * k", "row")
            lines = writer.write_body(name, function, to, TRACK_LOOP)
        elif name == "step" and program.single:
            writer.addresses = places
            lines = _step_lines(writer, program, function, stores)
        else:
            writer.addresses = places
            changed = {
                key: text
                for key, text in stores.items()
                if key in results and results[key].args != (key,)
            }
            lines = writer.write_body(name, function, changed, EVENT_LOOP)
        texts.append(program.layout.function(name, lines))
    return writer.write_module(
        "Functions of one track (`jaxevent.blob.engine`).", texts, program.layout
    )


def trace_readout(
    filter: Filter, params: TrackerParams, track: Any, layout: Layout, dtype: np.dtype
) -> TracedProgram:
    """Trace the functions of the readout.

    Args:
        filter: Filter of the track.
        params: Parameters of the tracker.
        track: Shapes of one track.
        layout: Places of a track's numbers, see `trace_track`.
        dtype: Type of real numbers.

    Returns:
        The program.

    Raises:
        TranslationError: A function does what cannot be translated.
    """
    host, graph, steps, shape = (
        _host_program(params),
        Graph(),
        _ReadoutSteps(filter),
        _Shapes(dtype),
    )
    values = {"track": track, "dt": shape(), "silence": shape()}
    functions = {
        "predict": (steps.predict, values),
        "transition": (steps.transition, values),
        "canonical": (steps.canonical, {"x": shape(8), "P": shape(8, 8)}),
    }
    traced = {
        name: translate_function(function, params, given, graph, host, single=True)
        for name, (function, given) in functions.items()
    }
    return TracedProgram(traced, host, layout, dtype)


def write_readout(program: TracedProgram) -> ModuleText:
    """Write the module of the readout's functions."""
    m = smoother_loop
    outputs = {"x": m.X, "P": m.P, "F": m.F, "mean": m.MEAN, "covariance": m.COVARIANCE}
    work = {"dt.0": ("work", "row", m.DT), "silence.0": ("work", "row", m.SILENCE)}
    for name, size in (("x", 8), ("P", 64)):
        work |= {f"{name}.{k}": ("work", "row", outputs[name] + k) for k in range(size)}
    writer, texts = ModuleWriter(program, program.layout.places() | work), []
    for name, function in program.functions.items():
        store = {}
        for key in function.results:
            what, number = key.split(".")
            store[key] = f"work[{outputs[what] + int(number)}] = {{}}"
        texts.append(program.layout.function(name, writer.write_body(name, function, store)))
    return writer.write_module(
        "Readout of a track (`jaxevent.blob.engine`).", texts, program.layout
    )


def find_blocks(program: TracedProgram) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Find blocks of the 8 components that neither correlate nor pass into each other.

    Returns:
        The components in an order, and where blocks of it begin, with 8 at the end.
    """
    predict, transition = (program.functions[name].results for name in ("predict", "transition"))
    tied = np.eye(8, dtype=bool)
    for i, j in itertools.product(range(8), range(8)):
        entries = predict[f"P.{8 * i + j}"], transition.get(f"F.{8 * i + j}")
        tied[i, j] |= any(node is not None and constant_value(node) != 0 for node in entries)
    tied |= tied.T
    for k in range(8):
        tied |= tied[:, k, None] & tied[k]
    first = np.argmax(tied, axis=1)  # of each one's block
    order = np.argsort(first, kind="stable")
    begins = np.flatnonzero(np.diff(first[order], prepend=-1))
    return order, np.append(begins, 8)


# With tangents there is no step in one call.
TangentFunctions = collections.namedtuple(
    "TangentFunctions", [name for name in TrackFunctions._fields if name != "step"]
)
_track_kernels = KernelCache(TrackFunctions, write_track, max_nodes=MAX_OPERATIONS)
_tangent_kernels = KernelCache(TangentFunctions, write_track, max_nodes=2 * MAX_OPERATIONS)
_readout_kernels = KernelCache(ReadoutFunctions, write_readout, max_nodes=MAX_OPERATIONS)


def check_track(
    filter: Filter, params: TrackerParams, variant: TrackVariant, dtype: np.dtype
) -> None:
    """Raise `TranslationError` unless the functions of a filter's track have translations.

    Args:
        filter: Filter of the track.
        params: Parameters of the tracker.
        variant: Inputs and outputs of the functions.
        dtype: Type of real numbers.
    """
    kernels, key = _kernels_of(filter, params, variant, dtype)
    known = variant.known(params)
    kernels.check(key, known, lambda: trace_track(filter, known, variant, dtype))


def _kernels_of(
    filter: Filter, params: TrackerParams, variant: TrackVariant, dtype: np.dtype
) -> tuple[KernelCache, Any]:
    """Return the cache of a track's functions, and their key in it; see `check_track`."""
    if params.association == "authors":
        raise TranslationError('association = "authors"')
    leaves, tree = jax.tree.flatten(params)
    shapes = tuple(np.shape(leaf) for leaf in leaves)
    kernels = _tangent_kernels if variant.tangents else _track_kernels
    return kernels, (filter, tree, shapes, variant, dtype)


class TrackCompiler:
    """Compiled functions of a filter's track, those of the readout on request.

    Args:
        filter: Filter of the track.
        params: Parameters of the tracker.
        variant: Inputs and outputs of the functions.
        dtype: Type of real numbers.
        along: Name of the parameter, and index in it, along which tangents are.

    Raises:
        TranslationError: A function has no translation.
    """

    def __init__(
        self,
        filter: Filter,
        params: TrackerParams,
        variant: TrackVariant,
        dtype: np.dtype,
        along: tuple[str, int] | None = None,
    ):
        self._filter, self._params, self._dtype = filter, params, dtype
        kernels, self._key = _kernels_of(filter, params, variant, dtype)
        known = variant.known(params, along)
        compiled = kernels.get(self._key, known, lambda: trace_track(filter, known, variant, dtype))
        self.functions, self.numbers = compiled.functions, compiled.numbers
        if variant.tangents:
            functions = self.functions._asdict()
            self.functions = TrackFunctions(step=functions["predict"], **functions)
        self.layout, self.track = compiled.places, compiled.program.track

    def readout(self) -> smoother_loop.ReadoutKernel:
        """Compile the functions of the readout."""
        filter, params, dtype = self._filter, self._params, self._dtype
        compiled = _readout_kernels.get(
            self._key, params, lambda: trace_readout(filter, params, self.track, self.layout, dtype)
        )
        blocks, smallest = find_blocks(compiled.program), 4 * float(np.finfo(dtype).eps)
        return smoother_loop.ReadoutKernel(compiled.functions, compiled.numbers, *blocks, smallest)
