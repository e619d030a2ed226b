"""A smoother as the text of functions of one pixel: translated, written and compiled.

A smoother consists of functions of one pixel, by name (`Smoother.pixel_functions`). They read and
write the pixel's numbers: those of the frame that a pass has come to (`WORK`), and those that are
kept of every frame (`ROW`, and what images need beside them).
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import jax
import numpy as np
from numpy.typing import NDArray

from jaxevent.codegen.graph import (
    Graph,
    Node,
    ParameterProgram,
    TranslationError,
    constant_value,
    dependencies,
)
from jaxevent.codegen.module import CompiledProgram, KernelCache
from jaxevent.codegen.trace import TracedFunction, name_leaves, translate_function
from jaxevent.codegen.write import Address, ModuleText, Writer
from jaxevent.reconstruction.engine.frame_loop import FrameFunctions
from jaxevent.reconstruction.engine.pixel import Directions
from jaxevent.reconstruction.video import ImageMethod

COUNTS = ("on", "off", "around_on", "around_off", "given")
STATE, LATER = ("state.m", "state.P"), ("later.h", "later.J")
LINK = tuple(f"link.{name}" for name in "AbChJ")
WORK = ("grey", "intensity", "certainty", "total", "inside", "side", *COUNTS, *STATE, *LATER, *LINK)
ROW = ("moved_on", "moved_off", "past.m", "past.P", "said.h", "said.J")

# What has derivatives by parameters.
MOVING = ("total", "state", "later", "moved_on", "moved_off", "past", "said", "kept")

# Of these, what does not rest on its own value before.
NEVER_CARRIED = tuple(f"slopes['{name}']" for name in ("total", "moved_on", "moved_off", "kept"))

# Numbers that are equal for all pixels, by function.
UNIFORM = {
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
    """What such a kernel is made of; see `smoother.Smoother`."""

    def pixel_state_spec(self, number: Any) -> dict[str, Any]: ...

    def apply_message_map(self, link: NDArray, later: NDArray) -> NDArray: ...

    def pixel_functions(self, exposed: bool) -> dict[str, Callable[..., dict[str, Any]]]: ...


PIXELS = """

@cfunc(types.void(CELLS, CELLS, I, I, I, D, D, D), **OPTIONS)
def {name}(cells, numbers, row, begin, end, a, b, c):
    u0, u1, u2 = REAL(a), REAL(b), REAL(c)
{loops}
"""
PIXELS_LOOP = """    for z in range(begin, end):
        k = row + z
{lines}"""

IMAGES = """

@cfunc(
    types.void(CELLS, CELLS, I, I, I, I, D, D, D, CELLS, CELLS, MARKS, CELLS, I, I), **OPTIONS
)
def {name}(
    cells, numbers, row, rows, width, padded, a, b, c, mean, variance, valid, slopes, size, at,
):
    u0, u1, u2 = REAL(a), REAL(b), REAL(c)
    for line in range(rows):
        first = at + line * width
{loops}
"""
IMAGES_LOOP = """        for column in range(width):
            z = (line + 1) * padded + 1 + column
            k = row + z
{lines}"""

EXCESS = """

@cfunc(types.void(D, D, F, F, CELLS, CELLS), **OPTIONS)
def excess(share64, edge64, on, off, numbers, out):
    share, edge = REAL(share64), REAL(edge64)
{lines}
"""


@dataclasses.dataclass(frozen=True)
class FrameProgram:
    """A smoother's functions as expressions."""

    functions: dict[str, TracedFunction]
    host: ParameterProgram
    work: tuple[str, ...]  # names of the numbers of the frame that a pass has come to
    row: tuple[str, ...]  # names of the numbers that are kept of every frame
    dtype: np.dtype
    directions: Directions

    def slopes(self, name: str) -> list[str]:
        """The names of a number's derivatives."""
        return [slope_of(name, d) for d in range(len(self.directions.numbers))]

    def uses(self, name: str) -> bool:
        """Whether the functions read a number."""
        nodes = [n for f in self.functions.values() for n in f.results.values()]
        return any(n.op == "input" and n.args == (f"{name}.0",) for n in dependencies(nodes))


def slope_of(name: str, direction: int) -> str:
    """The name of a number's derivative."""
    tree, dot, leaf = name.partition(".")
    tree, bracket, rest = tree.partition("[")
    return f"slopes['{tree}']{bracket}{rest}{dot}{leaf}:{direction}"


def with_slopes(function: Callable[..., dict[str, Any]]) -> Callable[..., dict[str, Any]]:
    """The same with the derivatives of its results along directions in the parameters.

    `known` ends with directions in the parameters, `slopes` are derivatives of inputs along them,
    both with an axis of directions in front.
    """

    def both(known: Any, slopes: dict[str, Any], **given: Any) -> dict[str, Any]:
        params, fixed, seeds = known

        def of(params: Any, moving: dict[str, Any]) -> tuple[Any, Any]:
            made = function((params, fixed), **{**given, **moving})
            told = {key: tree for key, tree in made.items() if key in MOVING}
            if "image" in made:
                told |= {"mean": made["image"].mean, "variance": made["image"].covariance}
            return told, made

        def along(seeds: Any, slopes: Any) -> Any:
            moving = {name: given[name] for name in slopes}
            return jax.jvp(of, (params, moving), (seeds, slopes), has_aux=True)[1:]

        changes, made = jax.vmap(along, out_axes=(0, None))(seeds, slopes)
        return made | {"slopes": changes}

    return both


def _known(params: Any, fixed: dict[str, Any], directions: Directions) -> Any:
    return (params, fixed, directions.seeds(params)) if directions.numbers else (params, fixed)


def _translated(
    method: SmoothingMethod,
    params: Any,
    fixed: dict[str, Any],
    exposed: bool,
    dtype: np.dtype,
    directions: Directions,
) -> FrameProgram:
    graph, host, known = Graph(), ParameterProgram(), _known(params, fixed, directions)
    for leaf in jax.tree.leaves(known):
        host.add_input(np.asarray(leaf))
    shape = jax.ShapeDtypeStruct((1, 1), dtype)
    functions, of = method.pixel_functions(exposed), dict[str, TracedFunction]()

    def tree(names: tuple[str, ...]) -> dict[str, Any]:
        return dict.fromkeys(names, shape)

    image, counts = tree(("grey", "intensity", "certainty")), tree(COUNTS)
    moved, seconds = tree(("moved_on", "moved_off")), tree(("seconds",))
    given: dict[str, Any] = {**image, **tree(("gain", "exists", "total", "inside"))}
    held = jax.eval_shape(method.pixel_state_spec, shape)
    state, said = held["state"], held["said"]
    try:
        frame = functools.partial(functions["frame"], known[:2])
        kept = jax.eval_shape(lambda v: frame(**v), given | {"state": state})["kept"]
    except Exception as error:  # whatever a method's functions raise
        about = f"its functions fail for one pixel: {error}"
        raise TranslationError(about.partition("\n")[0]) from error
    # In an order in which it is known which derivatives are always 0 (`dead`).
    wanted = {
        "excess": tree(("share", "edge", "on", "off")),
        "move": {"past": state, **counts, **seconds},
        "start": {},
        "frame": {**given, "state": state},
        "clipped": {**given, "state": state},
        "link": {"link": held["link"], "said": said, **moved, **seconds},
        "back": {"later": said, "said": said, **moved, **seconds},
        "show": {"past": state, "said": said, **moved, "kept": kept, **counts, **seconds,
                 "elapsed": shape, "here": jax.ShapeDtypeStruct((1, 1), bool)},
        "before": {"later": said, "kept": kept, **counts, **seconds},
    }  # fmt: skip
    count, dead = len(directions.numbers), set[str]()
    seeds = len(jax.tree.leaves(known[2:]))
    for name, values in wanted.items():
        function = functions[name]
        if count:
            moving = {key: tree for key, tree in values.items() if key in MOVING}
            slopes = jax.tree.map(lambda v: jax.ShapeDtypeStruct((count, 1, 1), v.dtype), moving)
            function, values = with_slopes(function), {**values, "slopes": slopes}
        of[name] = translate_function(
            function, known, values, graph, host, single=True, seeds=seeds, zeros=dead
        )
        if name in ("excess", "move", "clipped"):
            dead |= {
                key
                for key, node in of[name].results.items()
                if constant_value(node) == 0 and key.startswith(NEVER_CARRIED)
            }
    row = (*ROW, *(leaf for leaf in name_leaves("kept", kept)))
    program = FrameProgram(of, host, WORK, row, dtype, directions)
    work = [s for n in WORK if n.partition(".")[0] in MOVING for s in program.slopes(n)]
    row_slopes = [s for n in row for s in program.slopes(n) if _number(s) not in dead]
    return dataclasses.replace(program, work=(*WORK, *work), row=(*row, *row_slopes))


def _write(program: FrameProgram, stride: int) -> ModuleText:
    """Write the module of a program, for bands of `stride` pixels."""
    places: dict[str, Address] = {
        _number(n): ("cells", index, i * stride)
        for index, names in (("z", program.work), ("k", program.row))
        for i, n in enumerate(names)
    }
    writer, parts = Writer(program, places), list[str]()
    for name, function in program.functions.items():
        uniform = {f"{n}.0": f"u{i}" for i, n in enumerate(UNIFORM.get(name, ()))}
        if "here.0" in uniform:
            uniform["here.0"] += " != 0"
        of_segment = {f"{n}.0": n for n in ("share", "edge", "on", "off")}
        writer.addresses = {**places, **(of_segment if name == "excess" else uniform)}
        results = function.results
        stored = {key: node for key, node in results.items() if key in places}
        if name in ("show", "before"):
            parts.append(_images(name, program, writer))
        elif name == "excess":
            totals = [results[_number(n)] for n in ("total", *program.slopes("total"))]
            lines = writer.lines(totals, 4)
            lines += [f"    out[{k}] = {writer.name(node)}" for k, node in enumerate(totals)]
            parts.append(EXCESS.format(lines="\n".join(lines)))
        else:
            texts = {key: "{}[{} + {}]".format(*places[key]) for key in stored}
            loops = _loops(stored, texts, writer, PIXELS_LOOP, 8)
            parts.append(PIXELS.format(name=name, loops=loops))
    about = "The functions of a smoother (`jaxevent.reconstruction.engine`)."
    return writer.module(about, parts, None, program.dtype)


def _number(name: str) -> str:
    """The name of a single number as `loops.translate_function` gives it."""
    leaf, _, direction = name.partition(":")
    return f"{leaf}.{direction or 0}"


def _images(name: str, program: FrameProgram, writer: Writer) -> str:
    """A function of images, and of their derivatives."""
    results, directions = program.functions[name].results, program.directions
    images = {n: results[f"image.{n}.0"] for n in ("mean", "covariance", "valid")}
    outputs = directions.of if directions.numbers else ()
    slopes = {
        (k, d): results[_number(slope)]
        for k, output in enumerate(outputs)
        for d, slope in enumerate(program.slopes(output))
    }
    texts = dict(zip(images, ("mean", "variance", "valid"), strict=True))
    texts = {key: f"{array}[first + column]" for key, array in texts.items()}
    wanted: dict[str, Node] = {**images}
    for (k, d), node in slopes.items():
        key = f"slopes {k}.{d}"
        wanted[key] = node
        texts[key] = f"slopes[(first + column) * size + {k * directions.lanes + d}]"
    return IMAGES.format(name=name, loops=_loops(wanted, texts, writer, IMAGES_LOOP, 12))


def _loops(
    wanted: dict[str, Node], texts: dict[str, str], writer: Writer, loop: str, indent: int
) -> str:
    """Loops over pixels that store results: derivatives, one direction each, then the rest.

    LLVM computes several pixels at once only where loops read and write few fields: that is worth
    computing factors again. Derivatives rest on numbers that the last loop may write.
    """
    groups: dict[int, list[str]] = {}
    for key in wanted:
        slope = key.startswith("slopes")
        group = int(key.rpartition(".")[2]) if slope else len(wanted)
        groups.setdefault(group, []).append(key)
    out = []
    for _, keys in sorted(groups.items()):
        lines = writer.lines([wanted[key] for key in keys], indent)
        for key in keys:
            value = writer.name(wanted[key])
            value = f"np.uint8({value})" if wanted[key].kind == "b" else value
            lines.append(f"{' ' * indent}{texts[key]} = {value}")
        out.append(loop.format(lines="\n".join(lines)))
    return "\n".join(out)


_kernels = KernelCache(FrameFunctions, _write)


def smoother_kernel(
    method: SmoothingMethod,
    params: Any,
    fixed: dict[str, Any],
    layout: tuple[bool, np.dtype, int],
    directions: Directions = Directions(),  # noqa: B008
) -> CompiledProgram:
    """The kernel of a smoother with its parameters and `fixed` numbers; raises `TranslationError`.

    `layout`: whether exposures are known, kind of numbers, stride.
    """
    exposed, dtype, stride = layout
    known = _known(params, fixed, directions)
    leaves, tree = jax.tree.flatten(known)
    key = method, tree, tuple(np.shape(leaf) for leaf in leaves), exposed, dtype, directions
    return _kernels.get(
        key, known, lambda: _translated(method, params, fixed, exposed, dtype, directions), stride
    )
