"""The particle filter as a CPU kernel, which numba compiles from the filter's own functions.

Functions of one event and all particles (`likelihood`, `filtering`) are traced for any number of
particles, and become expressions (`jaxevent.codegen`), then the text of a module. One loop
(`engine_loop`), the same for all models, passes over batches, events and candidates, as
`filtering.run` does. That one is differentiated, and used wherever there is no kernel.

While the particles are narrow, the loop scores a few motions that span them, and interpolates
between these.
"""

import copy
import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from jaxevent.codegen.derivative import DerivativeDirections, with_derivatives
from jaxevent.codegen.graph import Graph, Level, Node, ParameterProgram, TranslationError
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
from jaxevent.egomotion.candidates import Candidates
from jaxevent.egomotion.models import Model
from jaxevent.egomotion.particle_filter import engine_loop, filtering, likelihood
from jaxevent.egomotion.particle_filter.engine_loop import (
    CELL_NAMES,
    MOTIONS_PER_BLOCK,
    BatchArrays,
    InfoArrays,
    Memory,
    ModelFunctions,
    RowIndices,
)
from jaxevent.egomotion.particle_filter.filtering import (
    BatchInfo,
    BatchLikelihood,
    BatchTiming,
    ParticleState,
    RandomNumbers,
)
from jaxevent.egomotion.particle_filter.likelihood import Event
from jaxevent.egomotion.particle_filter.params import Params

FUNCTION_TEXT = """@cfunc(types.void(CELLS, CELLS, NUMBERS, I), **OPTIONS)
def {name}(cells, work, numbers, count):
    zero = 0
{body}


"""
# Candidates fill their entries from the first. Groups of `size` blocks of motions have one range of
# ages.
EVENT_TEXT = """@cfunc(types.void(CELLS, CELLS, NUMBERS, CELLS, CELLS, WHOLE, I, I, I), **OPTIONS)
def {name}(cells, work, numbers, d, ages, chosen, count, first, most):
    zero, begin, end = 0, 0, count
{init}
    if cells[{counts}] == 0:
        return
    for row in ({votes_rows}):
        for i in range(count * {BLOCK}):
            work[row + i] = REAL(0)
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
{accumulate}
    begin, end = 0, count
{likelihood}


"""
PARTICLE_LOOP = ElementLoop("i", "count", ("work", "numbers", "count"))
LANE_LOOP = ElementLoop(
    "i",
    f"begin * {MOTIONS_PER_BLOCK}, end * {MOTIONS_PER_BLOCK}",
    ("work", "numbers", "begin", "end"),
)
MAX_OPERATIONS = 6000  # beyond, numba compiles longer than XLA's scan takes


@dataclasses.dataclass(frozen=True)
class Layout:
    """Positions of numbers by name: single ones in cells, those of all particles in rows."""

    cells: dict[str, int]
    rows: dict[str, int]
    booleans: frozenset[str]
    row_size: int

    def places(self) -> dict[str, Address]:
        """Return from where each number is read."""
        places = {name: ("work", "i", row * self.row_size) for name, row in self.rows.items()}
        return places | {name: ("cells", "zero", at) for name, at in self.cells.items()}

    def stores(self) -> dict[str, str]:
        """Return the text that writes each number."""
        stores = {
            name: f"work[i + {row * self.row_size}] = {{}}" for name, row in self.rows.items()
        }
        for name, at in self.cells.items():
            value = "REAL(1) if {} else REAL(0)" if name in self.booleans else "{}"
            stores[name] = f"cells[{at}] = {value}"
        return stores

    def rows_of(self, *names: str) -> NDArray[np.int64]:
        """Return the rows of arrays of all particles, one array behind the other."""
        return _list_places(self.rows, names)

    def cells_of(self, *names: str) -> NDArray[np.int64]:
        """Return the cells of arrays, one array behind the other."""
        return _list_places(self.cells, names)


def _list_places(places: dict[str, int], names: Sequence[str]) -> NDArray[np.int64]:
    """Return the places of all numbers of some arrays, "name.0" and on.

    Args:
        places: Places by the names of numbers.
        names: Names of arrays; those that are not there have no numbers.

    Returns:
        (numbers,) places.
    """
    numbers = (f"{name}.{k}" for name in names for k in range(len(places)))
    return np.array([places[number] for number in numbers if number in places], np.int64)


def _with_focal_length(model: Model, f: Any) -> Model:
    """Return the model with another focal length: an input, so that one program serves all.

    Args:
        model: The model.
        f: Focal length, px.

    Returns:
        The model.
    """
    model = copy.copy(model)
    object.__setattr__(model, "f", f)
    return model


def tangent_name(key: str, field: str | None = None) -> str:
    """Return the name of the derivatives of a tree, or of a field of it.

    Args:
        key: Name of the tree.
        field: Name of the field.

    Returns:
        The name.
    """
    return f"{key}.tangent" if field is None else f"{key}.{field}.tangent"


class FunctionTracer:
    """Tracer of functions, with the positions of their inputs and results."""

    def __init__(
        self, params: Params, model: Model, dtype: np.dtype, directions: DerivativeDirections
    ):
        self.params, self.model, self.dtype, self.directions = params, model, dtype, directions
        self.graph, self.host = Graph(), ParameterProgram()
        for leaf in jax.tree.leaves(directions.inputs(params, ())):
            self.host.add_input(np.asarray(leaf))
        self.cells = {name: at for at, name in enumerate(CELL_NAMES)}
        self.rows: dict[str, int] = {}
        self.booleans: set[str] = set()
        self.functions: dict[str, TracedFunction] = {}
        self.f = self.shape()

    def shape(self, *size: int, kind: Any = None) -> jax.ShapeDtypeStruct:
        """Return the shape of an array, by default of real numbers."""
        return jax.ShapeDtypeStruct(size, self.dtype if kind is None else kind)

    def add(
        self,
        name: str,
        function: Any,
        inputs: dict[str, Any],
        *,
        alias: bool = False,
        moving: Mapping[str, Sequence[str]] | None = None,
        moved: Mapping[str, Sequence[str]] | None = None,
    ) -> dict[str, Any]:
        """Translate `function(params, model, **inputs)`, which returns a dict.

        A result that is equal for all particles becomes one number for the functions that read it.
        With directions the function is translated with its derivatives: those of an input "S" are
        "S.tangent", and those of the field of an input "state.particles.tangent".

        Args:
            name: Name of the function.
            function: The function.
            inputs: Trees of shapes.
            alias: Whether results that are inputs stay where these are.
            moving: By name the fields of inputs that have derivatives; none: it has them itself.
            moved: The same of results.

        Returns:
            Trees of shapes of the results, to be inputs of other functions.
        """
        inputs, trees = {**inputs, "f": self.f}, {}
        of_inputs = self._tangent_names(moving, inputs)
        given = dict(inputs)
        for tangent, (key, field) in of_inputs.items():
            leaf = inputs[key] if field is None else getattr(inputs[key], field)
            given[tangent] = self.shape(len(self.directions.numbers), *leaf.shape)

        def compute(params: Any, f: Any, **values: Any) -> dict[str, Any]:
            return function(params, _with_focal_length(self.model, f), **values)

        def call(known: Any, **values: Any) -> dict[str, Any]:
            if not self.directions.numbers:
                results = compute(known[0], **values)
            else:
                results = self._differentiate(compute, known, values, of_inputs, moved or {})
            trees.update(jax.tree.map(lambda v: jax.ShapeDtypeStruct(v.shape, v.dtype), results))
            return results

        known = self.directions.inputs(self.params, ())
        translated = translate_function(call, known, given, self.graph, self.host)
        for key, tree in given.items():
            self._lay_out(key, tree)
        self.functions[name] = translated
        return {key: self._lay_out(key, tree, translated, alias) for key, tree in trees.items()}

    def _tangent_names(
        self, fields: Mapping[str, Sequence[str]] | None, trees: Mapping[str, Any]
    ) -> dict[str, tuple[str, str | None]]:
        """Name the derivatives of trees' fields; there are none without directions.

        Args:
            fields: By a tree's name the fields that have derivatives; none: the tree itself has.
            trees: The trees.

        Returns:
            For each name of a derivative the tree and the field, or None.
        """
        if not self.directions.numbers:
            return {}
        found: dict[str, tuple[str, str | None]] = {}
        for key, names in (fields or {}).items():
            for field in names or (None,):
                if field is None or getattr(trees[key], field) is not None:
                    found[tangent_name(key, field)] = (key, field)
        return found

    def _differentiate(
        self,
        function: Callable[..., dict[str, Any]],
        known: Any,
        values: dict[str, Any],
        of_inputs: dict[str, tuple[str, str | None]],
        moved: Mapping[str, Sequence[str]],
    ) -> dict[str, Any]:
        """Compute results, and the derivatives of some along all directions.

        Args:
            function: Function of the parameters and of named values.
            known: Parameters, nothing, and the directions.
            values: The values, with the derivatives of some.
            of_inputs: The derivatives among them, see `_tangent_names`.
            moved: Fields of results that have derivatives.

        Returns:
            The results, with derivatives.
        """
        plain = {key: value for key, value in values.items() if key not in of_inputs}
        at = {
            name: plain[key] if field is None else getattr(plain[key], field)
            for name, (key, field) in of_inputs.items()
        }
        # What is equal for all particles has derivatives that are.
        changes = {
            name: jnp.broadcast_to(
                values[name].reshape(values[name].shape + (1,) * (v.ndim + 1 - values[name].ndim)),
                (len(self.directions.numbers), *v.shape),
            )
            for name, v in at.items()
        }

        def compute(known: Any, **at: Any) -> dict[str, Any]:
            given = dict(plain)
            for name, (key, field) in of_inputs.items():
                given[key] = (
                    at[name]
                    if field is None
                    else dataclasses.replace(given[key], **{field: at[name]})
                )
            return function(known[0], **given)

        def select(made: dict[str, Any]) -> dict[str, Any]:
            return {
                name: made[key] if field is None else getattr(made[key], field)
                for name, (key, field) in self._tangent_names(moved, made).items()
            }

        made = with_derivatives(compute, select)(known, changes, **at)
        slopes = made.pop("sensitivities")
        return made | slopes

    def _lay_out(
        self, key: str, tree: Any, translated: TracedFunction | None = None, alias: bool = False
    ) -> Any:
        """Assign each number of a tree a cell or a row of the work memory.

        Args:
            key: Name of the tree.
            tree: Tree of shapes.
            translated: Function whose results the numbers are; None: inputs.
            alias: Whether results that are inputs stay where these are.

        Returns:
            The tree, with the shapes that later functions see.
        """
        leaves = []
        for name, leaf in named_leaves(key, tree).items():
            names = number_names(name, leaf)
            of_all = ELEMENT_AXIS_LENGTH in leaf.shape
            if translated is not None and of_all:
                nodes = [translated.results[number] for number in names]
                of_all = any(node.level == Level.ELEMENT for node in nodes)
                if of_all:
                    of_elements = map(self._of_all, nodes)
                    translated.results.update(zip(names, of_elements, strict=True))
            where = self.rows if of_all else self.cells
            for number in names:
                source = translated.results[number] if translated is not None else None
                if alias and of_all and source is not None and source.op == "input":
                    where.setdefault(number, where[source.args[0]])
                where.setdefault(number, len(set(where.values())))
                if leaf.dtype == bool:
                    self.booleans.add(number)
            leaves.append(leaf if of_all or ELEMENT_AXIS_LENGTH not in leaf.shape else self.shape())
        return jax.tree.unflatten(jax.tree.structure(tree), leaves)

    def _of_all(self, node: Node) -> Node:
        """Return a number of all particles, even where it is equal for all."""
        if node.level == Level.ELEMENT:
            return node
        return self.graph.node("max", (node, node), node.kind, Level.ELEMENT)


def program_of(
    params: Params, model: Model, dtype: np.dtype, directions: DerivativeDirections
) -> TracedProgram:
    """Translate the functions of the filter.

    Args:
        params: The parameters.
        model: Motion model.
        dtype: Type of real numbers.
        directions: Numbers of the parameters by which the motion is differentiated.

    Returns:
        The program.

    Raises:
        TranslationError: A function has no translation.
    """
    if params.likelihood == "literal":
        raise TranslationError('likelihood = "literal"')
    tracer = FunctionTracer(params, model, dtype, directions)
    shape, d = tracer.shape, model.dimension
    cloud, each, flag = shape(ELEMENT_AXIS_LENGTH, d), shape(ELEMENT_AXIS_LENGTH), shape(kind=bool)
    # Classes that check their fields take shapes in a trace.
    state, timing, event, of_batch = jax.eval_shape(
        lambda cloud, each, flag, one, two, four: (
            ParticleState(cloud, each, flag, one, one, one, one),
            BatchTiming(one, one, flag),
            Event(two, four, flag, one, one),
            BatchLikelihood(each, one, one),
        ),
        *(cloud, each, flag, shape(), shape(2), shape(2, 2)),
    )

    def predict(params, model, state, timing, normal):
        predicted, weights = filtering.predict(params, model, state, timing, normal)
        return {"predicted": predicted, "weights": weights}

    def reweight(params, model, state, timing, predicted, likelihood):
        found = filtering.reweight(params, model, state, timing, predicted, likelihood)
        return {"found": found}

    def restart(params, model, cloud):
        restarted, middle, widest = filtering.restart(params, model, cloud)
        return {"restarted": restarted, "middle": middle, "widest": widest}

    tracer.add(
        "predict",
        predict,
        {"state": state, "timing": timing, "normal": cloud},
        moving={"state": ("particles", "log_weights")},
        moved={"predicted": (), "weights": ()},
    )
    for name, searching in (("track", False), ("search", True)):
        _add_event(tracer, name, searching, event, cloud, each)
    tracer.add(
        "reweight",
        reweight,
        {"state": state, "timing": timing, "predicted": cloud, "likelihood": of_batch},
        moving={"state": ("log_weights",), "predicted": (), "likelihood": ("log_likelihood",)},
        moved={"found": ("log_weights", "mean")},
    )
    tracer.add("restart", restart, {"cloud": cloud})
    row_size = MOTIONS_PER_BLOCK * -(-params.particles // MOTIONS_PER_BLOCK)
    layout = Layout(tracer.cells, tracer.rows, frozenset(tracer.booleans), row_size)
    return TracedProgram(tracer.functions, tracer.host, layout, dtype)


def _add_event(
    tracer: FunctionTracer, name: str, searching: bool, event: Any, cloud: Any, each: Any
) -> None:
    """Translate the steps of one event: before, for and after its candidates, and of their ages.

    Args:
        tracer: Tracer, to which functions are added.
        name: Beginning of their names.
        searching: Whether the motion is searched for.
        event: An event without candidates.
        cloud: Shapes of the motions that are scored.
        each: Shapes of their weights.
    """
    key, shape = f"{name}_votes", tracer.shape
    expected = ("U", "line", "rate")  # what moves with the particles

    def init(params, model, event, motions, motion_weights):
        votes = likelihood.init_votes(params, model, event, motions, motion_weights, searching)
        lag = likelihood.candidate_lag(params, votes.tau)
        return {key: votes, "counts": votes.counts, "lag": lag}

    def span(params, model, **votes):
        ages = votes[key].ages
        return {"youngest": ages.youngest.min(), "oldest": ages.oldest.max()}

    def accumulate(params, model, d, dt, S, **votes):
        return {"S": likelihood.accumulate_votes(params, d, dt, votes[key], S, searching)}

    def finish(params, model, *, event, S, motion_weights, radius, total, **votes):
        found = likelihood.event_log_likelihood(
            params, model, event, votes[key], S, motion_weights, searching=searching, radius=radius
        )
        return {"total": total + found.log_likelihood, "votes": found.votes, "chance": found.chance}

    inputs = {"event": event, "motions": cloud, "motion_weights": each}
    votes = {
        key: tracer.add(
            f"{name}_init",
            init,
            inputs,
            alias=True,
            moving={"motions": (), "motion_weights": ()},
            moved={key: expected},
        )[key]
    }
    tracer.add(f"{name}_span", span, votes)
    tracer.add(
        f"{name}_accumulate",
        accumulate,
        {"d": shape(2), "dt": shape(), "S": each, **votes},
        moving={"S": (), key: expected},
        moved={"S": ()},
    )
    inputs = {"event": event, "S": each, "motion_weights": each, "radius": shape(), "total": each}
    tracer.add(
        f"{name}_likelihood",
        finish,
        {**inputs, **votes},
        moving={"S": (), "total": (), key: expected},
        moved={"total": ()},
    )


def write(program: TracedProgram) -> ModuleText:
    """Write the text of a program's module."""
    layout = program.layout
    places, stores = layout.places(), layout.stores()
    writer, out = ModuleWriter(program, places), []

    def body(name: str, indent: int = 4, loop: ElementLoop = LANE_LOOP) -> str:
        function = program.functions[name]
        changed = {
            key: stores[key]
            for key, node in function.results.items()
            if node.op != "input" or places[node.args[0]] != places[key]
        }
        return "\n".join(writer.write_body(name, function, changed, loop, indent))

    for name in ("predict", "reweight", "restart"):
        out.append(FUNCTION_TEXT.format(name=name, body=body(name, loop=PARTICLE_LOOP)))
    at = {key.partition(".")[0]: n for key, n in layout.cells.items()}
    for name in ("track", "search"):
        has_own_ages = any(key.startswith(f"{name}_votes.ages") for key in layout.rows)
        out.append(
            EVENT_TEXT.format(
                name=name,
                BLOCK=MOTIONS_PER_BLOCK,
                size="1" if has_own_ages else "count",
                init=body(f"{name}_init"),
                span=body(f"{name}_span", 8),
                accumulate=body(f"{name}_accumulate", 12),
                likelihood=body(f"{name}_likelihood"),
                votes_rows="".join(
                    f"{row * layout.row_size}, " for row in layout.rows_of("S", tangent_name("S"))
                ),
                dx=layout.cells["d.0"],
                dy=layout.cells["d.1"],
                **{key: at[key] for key in ("counts", "youngest", "oldest", "dt")},
            )
        )
    about = "The functions of voting (`jaxevent.egomotion.particle_filter.engine`)."
    return writer.write_module(about, out, layout)


_kernels = KernelCache(ModelFunctions, write, max_nodes=MAX_OPERATIONS)
_tangent_kernels = KernelCache(ModelFunctions, write, max_nodes=4 * MAX_OPERATIONS)


def _request_of(
    params: Params, model: Model, directions: DerivativeDirections
) -> tuple[KernelCache, Any, Any, Callable[[], TracedProgram]]:
    """Return the cache of a filter's kernels, and the arguments of its `get`.

    Args:
        params: The parameters.
        model: Motion model.
        directions: Numbers of the parameters by which the mean motion is differentiated.

    Raises:
        TranslationError: There is no kernel.
    """
    dtype, count = np.dtype(jnp.result_type(float)), len(directions.numbers)
    fields, kind = jax.tree.flatten(_with_focal_length(model, 1.0))
    if fields:
        raise TranslationError("numbers that the model holds")
    return (
        _tangent_kernels if count else _kernels,
        (kind, jax.tree.structure(params), dtype, count),
        directions.inputs(params, ()),
        lambda: program_of(params, model, dtype, directions),
    )


def check_filter(params: Params, model: Model) -> bool:
    """Return true, or raise `TranslationError` unless the filter has kernels, with derivatives too.

    Args:
        params: The parameters.
        model: Motion model.
    """
    for numbers in ((), ((0, 0),)):
        kernels, *about = _request_of(params, model, DerivativeDirections(numbers))
        kernels.check(*about)
    return True


class FilterRun(NamedTuple):
    """Results of a filter's kernel, on the host.

    Attributes:
        particles: (N, d) at the end.
        log_weights: (N,) at the end.
        cells: Single numbers of the state at the end, by name.
        out: Reports of the batches.
    """

    particles: NDArray
    log_weights: NDArray
    cells: dict[str, Any]
    out: InfoArrays


class CompiledFilter:
    """The filter as a kernel, called as `filtering.run`.

    Args:
        params: The parameters.
        model: Motion model.
        directions: Numbers of the parameters by which the mean motion is differentiated.

    Raises:
        TranslationError: There is no kernel.
    """

    def __init__(
        self,
        params: Params,
        model: Model,
        directions: DerivativeDirections = DerivativeDirections(),  # noqa: B008
    ):
        self.dtype, count = np.dtype(jnp.result_type(float)), len(directions.numbers)
        kernels, *about = _request_of(params, model, directions)
        kernel = kernels.get(*about)
        self._functions, self._numbers = kernel.functions, kernel.numbers
        self._layout, self._count, self._model = kernel.places, params.particles, model
        of, rows, d = self._layout.rows_of, self._layout.rows, model.dimension

        def with_tangents(*place: str) -> NDArray[np.int64]:
            return of(".".join(place), tangent_name(*place))

        self._rows = RowIndices(
            particles=with_tangents("state", "particles"),
            normal=of("normal"),
            predicted=with_tangents("predicted"),
            motions=with_tangents("motions"),
            cloud=of("cloud"),
            restarted=of("restarted"),
            log_weights=with_tangents("state", "log_weights"),
            weights=with_tangents("weights"),
            motion_weights=with_tangents("motion_weights"),
            total=with_tangents("total"),
            log_likelihood=with_tangents("likelihood", "log_likelihood"),
            new_log_weights=with_tangents("found", "log_weights"),
            youngest=rows.get("search_votes.ages.youngest.0", -1),
            mean=self._layout.cells_of("found.mean", "found.covariance"),
            mean_tangents=self._layout.cells_of(tangent_name("found", "mean")),
            widest=self._layout.cells_of("middle", "widest"),
        )
        self._nodes = engine_loop.init_interpolation(
            float(params.off), self._count, d, self.dtype, has_tangents=count > 0
        )

    @property
    def n_interpolated(self) -> int:
        """Number of batches whose log-likelihoods have been interpolated."""
        return int(self._nodes.counters[engine_loop.INTERPOLATED_COUNTER])

    def __call__(
        self, candidates: Candidates, noise: RandomNumbers, state: ParticleState, n_cloud: int = 0
    ) -> tuple[ParticleState, BatchInfo]:
        """Run the filter over stacked batches, on the host.

        Args:
            candidates: Stacked batches.
            noise: Random numbers.
            state: State at the start.
            n_cloud: Number of particles to report for each batch.

        Returns:
            The state at the end, and the stacked reports.
        """
        made = self.run(candidates, noise, state, n_cloud)
        after = made.particles, made.log_weights, *made.cells.values()
        reports = (getattr(made.out, field.name) for field in dataclasses.fields(BatchInfo))
        return ParticleState(*map(jnp.asarray, after)), BatchInfo(*map(jnp.asarray, reports))

    def run(
        self, candidates: Candidates, noise: RandomNumbers, state: ParticleState, n_cloud: int = 0
    ) -> FilterRun:
        """Run the filter over stacked batches, without JAX, as a program's callback must.

        Args:
            candidates: Stacked batches.
            noise: Random numbers.
            state: State at the start, which does not depend on the parameters.
            n_cloud: Number of particles to report for each batch.

        Returns:
            The state at the end, and the reports.
        """
        layout, rows, count = self._layout, self._rows, self._count
        cells = np.zeros(len(layout.cells), self.dtype)
        work = np.zeros((1 + max(layout.rows.values()), layout.row_size), self.dtype)
        n, d, real = len(candidates.elapsed), self._model.dimension, self.dtype
        work[rows.particles[:d], :count] = np.asarray(state.particles).T
        work[rows.log_weights[0], :count] = state.log_weights
        names = ("searching", "votes", "chance", "mean_contrast", "age")
        for name in names:
            cells[layout.cells[f"state.{name}.0"]] = getattr(state, name)
        cells[layout.cells["f.0"]], cells[engine_loop.RADIUS] = self._model.f, candidates.radius
        batches = BatchArrays(
            *(np.asarray(getattr(candidates, name)) for name in BatchArrays._fields[:9]),
            *map(np.asarray, (noise.normal, noise.uniform, noise.cloud)),
        )
        out = InfoArrays(
            mean=np.zeros((n, d), real),
            covariance=np.zeros((n, d, d), real),
            searching=np.zeros(n, bool),
            contrast=np.zeros(n, real),
            lag=np.zeros(n, real),
            evidence=np.zeros(n, real),
            cloud=np.zeros((n, n_cloud, d), real),
            mean_tangents=np.zeros((n, len(rows.mean_tangents)), real),
        )
        memory = Memory(cells, work, self._numbers)
        engine_loop.run(self._functions, memory, rows, batches, out, self._nodes)
        last: dict[str, Any] = {name: cells[layout.cells[f"state.{name}.0"]] for name in names}
        last["searching"] = last["searching"] != 0
        return FilterRun(
            work[rows.particles[:d], :count].T.copy(),
            work[rows.log_weights[0], :count].copy(),
            last,
            out,
        )
