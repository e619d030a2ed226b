"""A smoother as the text of functions of one pixel: translated, written and compiled.

A smoother says what it does at one pixel in functions by name (`Smoother.of_pixel`). They read and
write the pixel's numbers: those of the frame that a pass has come to (`WORK`), and those that are
kept of every frame (`ROW`, and what images need beside them).
"""

import dataclasses
import functools
from collections.abc import Callable
from types import ModuleType
from typing import Any, Protocol, runtime_checkable

import jax
import numpy as np
from numpy.typing import NDArray

from jaxevent.kernels.expressions import Graph, Node, Untranslatable, needed
from jaxevent.kernels.host import HostProgram
from jaxevent.kernels.loops import Function, leaves_of, translate
from jaxevent.kernels.modules import module_of
from jaxevent.kernels.text import FUNCTIONS, Numbers, Place, Writer
from jaxevent.reconstruction.fused.frame_loop import FrameFunctions
from jaxevent.reconstruction.video import ImageMethod

COUNTS = ("on", "off", "around_on", "around_off", "given")
STATE, LATER = ("state.m", "state.P"), ("later.h", "later.J")
LINK = tuple(f"link.{name}" for name in "AbChJ")
WORK = ("grey", "intensity", "certainty", "total", "inside", "side", *COUNTS, *STATE, *LATER, *LINK)
ROW = ("moved_on", "moved_off", "past.m", "past.P", "said.h", "said.J")

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

    def held_by_pixel(self, number: Any) -> dict[str, Any]: ...

    def through(self, link: NDArray, later: NDArray) -> NDArray: ...

    def of_pixel(self, exposed: bool) -> dict[str, Callable[..., dict[str, Any]]]: ...


HEAD = '''"""The functions of a smoother (`jaxevent.reconstruction.fused.smoothing`)."""

import numpy as np
from numba import types

from jaxevent.kernels.blocks import block
from jaxevent.kernels.kept import callback
from jaxevent.kernels.numeric import {imports}

REAL, STRIDE = np.{real}, {stride}
I, D, F = types.int64, types.float64, types.{real}
CELLS, MARKS = types.CPointer(F), types.CPointer(types.uint8)
HOW = {{"error_model": "numpy", "fastmath": {{"contract"}}}}
{constants}
'''

PIXELS = """

@callback(types.void(CELLS, CELLS, I, I, I, D, D, D), **HOW)
def {name}(cells, numbers, row, begin, end, a, b, c):
    u0, u1, u2 = REAL(a), REAL(b), REAL(c)
    for z in range(begin, end):
        k = row + z
{lines}
"""

IMAGES = """

@callback(types.void(CELLS, CELLS, I, I, I, I, D, D, D, CELLS, CELLS, MARKS, I), **HOW)
def {name}(cells, numbers, row, rows, width, padded, a, b, c, mean, variance, valid, at):
    u0, u1, u2 = REAL(a), REAL(b), REAL(c)
    for line in range(rows):
        for column in range(width):
            z = (line + 1) * padded + 1 + column
            k = row + z
{lines}
            mean[at + line * width + column] = {mean}
            variance[at + line * width + column] = {variance}
            valid[at + line * width + column] = np.uint8({valid})
"""

EXCESS = """

@callback(types.void(D, D, F, F, CELLS, CELLS), **HOW)
def excess(share64, edge64, on, off, numbers, out):
    share = REAL(share64)
{lines}
    out[0] = {excess}
"""


@dataclasses.dataclass(frozen=True)
class FrameProgram:
    """A smoother's functions as expressions."""

    functions: dict[str, Function]
    host: HostProgram
    row: tuple[str, ...]  # names of the numbers that are kept of every frame
    dtype: np.dtype

    def uses(self, name: str) -> bool:
        """Whether the functions read a number."""
        nodes = [n for f in self.functions.values() for n in f.results.values()]
        return any(n.op == "input" and n.args == (f"{name}.0",) for n in needed(nodes))


@dataclasses.dataclass(frozen=True)
class FrameKernel:
    """A smoother compiled for the host, with the numbers of its parameters."""

    functions: FrameFunctions
    program: FrameProgram
    numbers: NDArray


class FrameWriter(Writer):
    """Writes functions whose numbers lie where `places` says, or are read by its texts."""

    def __init__(self, places: dict[str, Place]):
        super().__init__()
        self.places, self.texts = places, dict[str, str]()

    def place(self, node: Node) -> Place | None:
        if node.op != "input" or node.args[0] in self.texts:
            return None
        return self.places.get(node.args[0])

    def input(self, node: Node) -> str:
        text = self.texts.get(node.args[0])
        return super().input(node) if text is None else text


def _translated(
    method: SmoothingMethod, params: Any, fixed: dict[str, Any], exposed: bool, dtype: np.dtype
) -> FrameProgram:
    graph, host, known = Graph(), HostProgram(), (params, fixed)
    for leaf in jax.tree.leaves(known):
        host.add_input(np.asarray(leaf))
    shape = jax.ShapeDtypeStruct((1, 1), dtype)
    functions, of = method.of_pixel(exposed), dict[str, Function]()

    def tree(names: tuple[str, ...]) -> dict[str, Any]:
        return dict.fromkeys(names, shape)

    image, counts = tree(("grey", "intensity", "certainty")), tree(COUNTS)
    moved, seconds = tree(("moved_on", "moved_off")), tree(("seconds",))
    given: dict[str, Any] = {**image, **tree(("gain", "exists", "total", "inside"))}
    held = jax.eval_shape(method.held_by_pixel, shape)
    state, said = held["state"], held["said"]
    try:
        frame = functools.partial(functions["frame"], known)
        kept = jax.eval_shape(lambda v: frame(**v), given | {"state": state})["kept"]
    except Exception as error:  # whatever a method's functions raise
        about = f"its functions fail for one pixel: {error}"
        raise Untranslatable(about.partition("\n")[0]) from error
    wanted = {
        "start": {},
        "frame": {**given, "state": state},
        "clipped": {**given, "state": state},
        "move": {"past": state, **counts, **seconds},
        "link": {"link": held["link"], "said": said, **moved, **seconds},
        "back": {"later": said, "said": said, **moved, **seconds},
        "show": {"past": state, "said": said, **moved, "kept": kept, **counts, **seconds,
                 "elapsed": shape, "here": jax.ShapeDtypeStruct((1, 1), bool)},
        "before": {"later": said, "kept": kept, **counts, **seconds},
        "excess": tree(("share", "on", "off")),
    }  # fmt: skip
    for name, values in wanted.items():
        of[name] = translate(functions[name], known, values, graph, host, single=True)
    row = (*ROW, *(leaf for leaf in leaves_of("kept", kept)))
    return FrameProgram(of, host, row, dtype)


def _write(program: FrameProgram, stride: int) -> tuple[str, Numbers]:
    """The text of a program's module, for bands of `stride` pixels."""
    places: dict[str, Place] = {f"{n}.0": ("cells", "z", i * stride) for i, n in enumerate(WORK)}
    places |= {f"{n}.0": ("cells", "k", i * stride) for i, n in enumerate(program.row)}
    writer, parts = FrameWriter(places), list[str]()
    for name, function in program.functions.items():
        uniform = {f"{n}.0": f"u{i}" for i, n in enumerate(UNIFORM.get(name, ()))}
        if "here.0" in uniform:
            uniform["here.0"] += " != 0"
        of_segment = {"share.0": "share", "on.0": "on", "off.0": "off"}
        writer.texts = of_segment if name == "excess" else uniform
        results = function.results
        stored = {key: node for key, node in results.items() if key in places}
        if name in ("show", "before"):
            images = dict(zip(("mean", "variance", "valid"), results.values(), strict=True))
            lines = writer.lines([*images.values()], 12)
            texts = {key: writer.name(node) for key, node in images.items()}
            parts.append(IMAGES.format(name=name, lines="\n".join(lines), **texts))
        elif name == "excess":
            lines = writer.lines([*results.values()], 4)
            excess = writer.name(results["excess.0"])
            parts.append(EXCESS.format(lines="\n".join(lines), excess=excess))
        else:
            lines = writer.lines([*stored.values()], 8)
            for key, node in stored.items():
                array, index, offset = places[key]
                lines.append(f"        {array}[{index} + {offset}] = {writer.name(node)}")
            parts.append(PIXELS.format(name=name, lines="\n".join(lines)))
    numbers, constants = writer.finish(program.host.values)
    single = program.dtype == np.float32
    head = HEAD.format(
        imports=", ".join(f"{n}{32 if single else 64} as {n}" for n in FUNCTIONS),
        real=program.dtype.name,
        stride=stride,
        constants="\n".join(constants),
    )
    return head + "".join(parts), numbers


# What has been made of methods: programs, each for a way that conditions on parameters chose, with
# their modules by stride.
_made: dict[Any, list[tuple[FrameProgram, dict[int, tuple[Numbers, ModuleType]]]]] = {}


def smoother_kernel(
    method: SmoothingMethod,
    params: Any,
    fixed: dict[str, Any],
    exposed: bool,
    dtype: np.dtype,
    stride: int,
) -> FrameKernel:
    """The kernel of a smoother with its parameters and `fixed` numbers; raises `Untranslatable`."""
    leaves, tree = jax.tree.flatten((params, fixed))
    key = method, tree, tuple(np.shape(leaf) for leaf in leaves), exposed, dtype
    made, given = _made.setdefault(key, []), [np.asarray(leaf) for leaf in leaves]
    again = ((known, known[0].host.again(given)) for known in made)
    found = next(((known, values) for known, values in again if values is not None), None)
    if found is None:
        program = _translated(method, params, fixed, exposed, dtype)
        found = (program, {}), program.host.values
        made.append(found[0])
    (program, modules), values = found
    if stride not in modules:
        text, numbers = _write(program, stride)
        modules[stride] = numbers, module_of(text)
    numbers, module = modules[stride]
    functions = FrameFunctions(*(getattr(module, name) for name in FrameFunctions._fields))
    return FrameKernel(functions, program, numbers.of(values, dtype))
