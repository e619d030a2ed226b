"""Kernels of smoothers: functions of one pixel, traced, translated and written as a module.

A smoother has functions of one pixel by name (`Smoother.pixel_functions`). They read and write the
pixel's numbers: those of the frame that a pass has come to (`WORK_FIELDS`), and those that are
stored for every frame (`ROW_FIELDS`, and what images need beside them).
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple, Protocol, runtime_checkable

import jax
import numpy as np
from numpy.typing import NDArray

from jaxevent.codegen.derivative import (
    DerivativeDirections,
    derivative_name,
    parse_derivative,
    with_derivatives,
)
from jaxevent.codegen.graph import (
    Graph,
    Node,
    ParameterProgram,
    TranslationError,
    constant_value,
    find_dependencies,
)
from jaxevent.codegen.module import CompiledProgram, KernelCache
from jaxevent.codegen.trace import TracedFunction, named_leaves, translate_function
from jaxevent.codegen.write import Address, ModuleText, ModuleWriter
from jaxevent.reconstruction.engine.filter_program import EXCESS_TEMPLATE, IMAGE_FIELDS, KernelKind
from jaxevent.reconstruction.video import ImageMethod

COUNT_FIELDS = ("on", "off", "around_on", "around_off", "given")
STATE_FIELDS, LATER_FIELDS = ("state.m", "state.P"), ("later.h", "later.J")
LINK_FIELDS = tuple(f"link.{name}" for name in "AbChJ")
WORK_FIELDS = (
    *IMAGE_FIELDS,
    "total",
    "inside",
    "side",
    *COUNT_FIELDS,
    *STATE_FIELDS,
    *LATER_FIELDS,
    *LINK_FIELDS,
)
ROW_FIELDS = ("moved_on", "moved_off", "past.m", "past.P", "message.h", "message.J")

# Trees of numbers that have derivatives by parameters.
DIFFERENTIATED_TREES = (
    "total",
    "state",
    "later",
    "moved_on",
    "moved_off",
    "past",
    "message",
    "info",
)
# Derivatives that do not depend on their own value before.
NEVER_CARRIED = tuple(
    f"sensitivities['{name}']" for name in ("total", "moved_on", "moved_off", "info")
)

# Numbers that are equal for all pixels, by function.
UNIFORM_INPUTS = {
    "frame": ("gain", "exists"),
    "clipped": ("gain", "exists"),
    "move": ("seconds",),
    "link": ("seconds",),
    "back": ("seconds",),
    "show": ("elapsed", "seconds", "here"),
    "before": ("seconds",),
}


@runtime_checkable
class SmoothingMethod(ImageMethod, Protocol):
    """A method that a kernel is made of; see `smoother.Smoother`."""

    adds_unseen_errors: ClassVar[bool]

    def pixel_state_spec(self, number: Any) -> dict[str, Any]: ...

    def apply_message_map(self, link: NDArray, later: NDArray) -> NDArray: ...

    def pixel_functions(self, exposed: bool) -> dict[str, Callable[..., dict[str, Any]]]: ...


class SmootherFunctions(NamedTuple):
    """Functions of a module, which `smoother_loop` calls for all pixels of a band.

    Attributes:
        start: Set the state at the recording's start.
        frame: Update the state by a frame.
        clipped: Update the state by a frame that is clipped somewhere.
        move: Predict the state to the next frame.
        link: Compose the map of messages through the segment with that of a frame.
        back: Pass the message of later frames back over a frame.
        show: Make an image after a frame.
        before: Make an image before the first frame.
        excess: Sum over the segments of an exposure.
    """

    start: Any
    frame: Any
    clipped: Any
    move: Any
    link: Any
    back: Any
    show: Any
    before: Any
    excess: Any


@dataclasses.dataclass(frozen=True)
class SmootherProgram:
    """The expressions of a smoother's functions."""

    functions: dict[str, TracedFunction]
    host: ParameterProgram
    work: tuple[str, ...]  # numbers of the frame that a pass has come to
    row: tuple[str, ...]  # numbers that are stored for every frame
    dtype: np.dtype
    directions: DerivativeDirections

    def derivatives(self, number: str) -> list[str]:
        """Return the names of a number's derivatives."""
        return [derivative_name(number, d) for d in range(len(self.directions.numbers))]

    def uses(self, number: str) -> bool:
        """Return whether the functions read a number."""
        nodes = [n for f in self.functions.values() for n in f.results.values()]
        return any(n.op == "input" and n.args == (number,) for n in find_dependencies(nodes))


def _select_moving(made: dict[str, Any]) -> dict[str, Any]:
    """Select the results of a function that have derivatives."""
    moving = {key: tree for key, tree in made.items() if key in DIFFERENTIATED_TREES}
    if "image" in made:
        moving |= {"mean": made["image"].mean, "variance": made["image"].covariance}
    return moving


def translate_smoother(
    method: SmoothingMethod, known: tuple[Any, ...], kind: KernelKind
) -> SmootherProgram:
    """Trace and translate the functions of a smoother.

    Args:
        method: The smoother.
        known: See `DerivativeDirections.inputs`.
        kind: Properties of the recording, and derivatives that are wanted.

    Raises:
        TranslationError: There is no translation.
    """
    graph, host, directions = Graph(), ParameterProgram(), kind.directions
    for leaf in jax.tree.leaves(known):
        host.add_input(np.asarray(leaf))
    shape = jax.ShapeDtypeStruct((1, 1), kind.dtype)
    functions, made = method.pixel_functions(kind.exposed), dict[str, TracedFunction]()

    def tree(*names: str) -> dict[str, Any]:
        return dict.fromkeys(names, shape)

    counts, moved, seconds = tree(*COUNT_FIELDS), tree("moved_on", "moved_off"), tree("seconds")
    given: dict[str, Any] = tree(*IMAGE_FIELDS, "gain", "exists", "total", "inside")
    held = jax.eval_shape(method.pixel_state_spec, shape)
    state, message = held["state"], held["message"]
    try:
        frame = functools.partial(functions["frame"], known[:2])
        info = jax.eval_shape(lambda v: frame(**v), given | {"state": state})["info"]
    except Exception as error:  # whatever a method's functions raise
        about = f"its functions fail for one pixel: {error}"
        raise TranslationError(about.partition("\n")[0]) from error
    # In an order in which it is known which derivatives are always 0 (`dead`).
    wanted = {
        "excess": tree("share", "edge", "on", "off"),
        "move": {"past": state, **counts, **seconds},
        "start": {},
        "frame": {**given, "state": state},
        "clipped": {**given, "state": state},
        "link": {"link": held["link"], "message": message, **moved, **seconds},
        "back": {"later": message, "message": message, **moved, **seconds},
        "show": {"past": state, "message": message, **moved, "info": info, **counts, **seconds,
                 "elapsed": shape, "here": jax.ShapeDtypeStruct((1, 1), bool)},
        "before": {"later": message, "info": info, **counts, **seconds},
    }  # fmt: skip
    dead, seeds = set[str](), len(jax.tree.leaves(known[2:]))
    for name, values in wanted.items():
        function = functions[name]
        if directions.numbers:
            moving = {key: tree for key, tree in values.items() if key in DIFFERENTIATED_TREES}
            function = with_derivatives(function, _select_moving)
            values = {**values, "sensitivities": directions.shapes(moving)}
        made[name] = translate_function(
            function, known, values, graph, host, single=True, seeds=seeds, zeros=dead
        )
        if name in ("excess", "move", "clipped"):
            results = made[name].results.items()
            zeros = {key for key, node in results if constant_value(node) == 0}
            dead |= {key for key in zeros if key.startswith(NEVER_CARRIED)}
    work = tuple(f"{name}.0" for name in WORK_FIELDS)
    row = tuple(f"{name}.0" for name in (*ROW_FIELDS, *named_leaves("info", info)))
    program = SmootherProgram(made, host, work, row, kind.dtype, directions)
    moving = [n for n in work if n.partition(".")[0] in DIFFERENTIATED_TREES]
    work_derivatives = [s for n in moving for s in program.derivatives(n)]
    row_derivatives = [s for n in row for s in program.derivatives(n) if s not in dead]
    return dataclasses.replace(
        program, work=(*work, *work_derivatives), row=(*row, *row_derivatives)
    )


PIXELS_TEMPLATE = """

@cfunc(types.void(CELLS, CELLS, I, I, I, D, D, D), **OPTIONS)
def {name}(cells, numbers, row, begin, end, a, b, c):
    u0, u1, u2 = REAL(a), REAL(b), REAL(c)
{loops}
"""
PIXELS_LOOP_TEMPLATE = """    for z in range(begin, end):
        k = row + z
{lines}"""

IMAGES_TEMPLATE = """

@cfunc(
    types.void(CELLS, CELLS, I, I, I, I, D, D, D, CELLS, CELLS, MARKS, CELLS, I, I), **OPTIONS
)
def {name}(
    cells, numbers, row, rows, width, padded, a, b, c, mean, variance, valid, derivatives, size, at,
):
    u0, u1, u2 = REAL(a), REAL(b), REAL(c)
    for line in range(rows):
        first = at + line * width
{loops}
"""
IMAGES_LOOP_TEMPLATE = """        for column in range(width):
            z = (line + 1) * padded + 1 + column
            k = row + z
{lines}"""


def write_smoother(program: SmootherProgram, stride: int) -> ModuleText:
    """Write the module of a program.

    Args:
        program: The program.
        stride: Pixels of a band, with its border.

    Returns:
        The text.
    """
    addresses: dict[str, Address] = {
        name: ("cells", index, i * stride)
        for index, names in (("z", program.work), ("k", program.row))
        for i, name in enumerate(names)
    }
    writer, parts = ModuleWriter(program, addresses), list[str]()
    for name, function in program.functions.items():
        uniform = {f"{n}.0": f"u{i}" for i, n in enumerate(UNIFORM_INPUTS.get(name, ()))}
        if "here.0" in uniform:
            uniform["here.0"] += " != 0"
        segment = {f"{n}.0": n for n in ("share", "edge", "on", "off")}
        writer.addresses = {**addresses, **(segment if name == "excess" else uniform)}
        results = function.results
        if name in ("show", "before"):
            parts.append(_write_images(name, program, writer))
        elif name == "excess":
            totals = [results[n] for n in ("total.0", *program.derivatives("total.0"))]
            lines = writer.write_lines(totals, 4)
            lines += [f"    out[{k}] = {writer.node_name(node)}" for k, node in enumerate(totals)]
            parts.append(EXCESS_TEMPLATE.format(lines="\n".join(lines)))
        else:
            stored = {n: addresses[n] for n in results if n in addresses}
            targets = {n: "{}[{} + {}]".format(*address) for n, address in stored.items()}
            loops = _write_loops(results, targets, writer, PIXELS_LOOP_TEMPLATE, 8)
            parts.append(PIXELS_TEMPLATE.format(name=name, loops=loops))
    about = "The functions of a smoother (`jaxevent.reconstruction.engine`)."
    return writer.write_module(about, parts, None, program.dtype)


def _write_images(name: str, program: SmootherProgram, writer: ModuleWriter) -> str:
    """Write a function of images, and of their derivatives."""
    results, directions = program.functions[name].results, program.directions
    arrays = {"mean": "mean", "covariance": "variance", "valid": "valid"}
    targets = {f"image.{n}.0": f"{array}[first + column]" for n, array in arrays.items()}
    for k, output in enumerate(directions.of if directions.numbers else ()):
        for d, derivative in enumerate(program.derivatives(f"{output}.0")):
            place = k * directions.lanes + d
            targets[derivative] = f"derivatives[(first + column) * size + {place}]"
    return IMAGES_TEMPLATE.format(
        name=name, loops=_write_loops(results, targets, writer, IMAGES_LOOP_TEMPLATE, 12)
    )


def _write_loops(
    results: dict[str, Node], targets: dict[str, str], writer: ModuleWriter, loop: str, indent: int
) -> str:
    """Write loops over pixels that store results: derivatives, one direction each, then the rest.

    LLVM computes several pixels at once only where loops read and write few fields: that is worth
    computing factors again. Derivatives rest on numbers that the last loop may write.

    Args:
        results: Nodes of the results by name.
        targets: Texts of the places where results are stored, by name.
        writer: Writer of the module.
        loop: Template of a loop, with `lines`.
        indent: Number of spaces before these lines.

    Returns:
        The text.
    """
    groups: dict[int, list[str]] = {}
    for key in targets:
        derivative = parse_derivative(key)
        groups.setdefault(derivative[1] if derivative else len(targets), []).append(key)
    out = []
    for _, keys in sorted(groups.items()):
        lines = writer.write_lines([results[key] for key in keys], indent)
        for key in keys:
            value = writer.node_name(results[key])
            value = f"np.uint8({value})" if results[key].kind == "b" else value
            lines.append(f"{' ' * indent}{targets[key]} = {value}")
        out.append(loop.format(lines="\n".join(lines)))
    return "\n".join(out)


_kernels = KernelCache(SmootherFunctions, write_smoother)


def smoother_kernel(
    method: SmoothingMethod, params: Any, fixed: dict[str, Any], kind: KernelKind
) -> CompiledProgram:
    """Make the kernel of a smoother; its functions are `SmootherFunctions`.

    Args:
        method: The smoother.
        params: Its parameters.
        fixed: Further numbers that are known with the parameters.
        kind: Properties of the recording, and derivatives that are wanted.

    Raises:
        TranslationError: There is no kernel.
    """
    known = kind.directions.inputs(params, fixed)
    return _kernels.get(
        (method, kind.exposed, kind.dtype, kind.directions),
        known,
        lambda: translate_smoother(method, known, kind),
        kind.stride,
    )
