"""Kernels: a method's text compiled by numba, kept in the user's cache folder, with its numbers."""

import dataclasses
from types import ModuleType
from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray

from jaxevent.codegen.host import Programs, once
from jaxevent.codegen.modules import module_of
from jaxevent.reconstruction.engine.loop import Functions
from jaxevent.reconstruction.engine.pixel import (
    Directions,
    FilterMethod,
    PixelProgram,
    Traced,
    host_inputs,
    traced,
    translated,
)
from jaxevent.reconstruction.engine.source import Source, evaluate_arrays, write


@dataclasses.dataclass(frozen=True)
class Kernel:
    """A method compiled for the host, with the numbers of its parameters."""

    functions: Functions
    program: PixelProgram
    source: Source
    values: list[NDArray]  # of the host program
    numbers: NDArray  # what the loop takes

    def start(self, variant: int, known: Any) -> dict[str, NDArray]:
        """The state at the start, of arrays of inputs that `known(name)` gives."""
        start = self.program.start[variant]
        made = evaluate_arrays([*start.values()], known, self.values, self.program.traced.dtype)
        return dict(zip(start, made, strict=True))


# Of methods whose functions were traced once.
_programs: dict[Any, tuple[Traced, Programs]] = {}


def program_of(
    method: FilterMethod,
    frame_model: Any,
    params: Any,
    fixed: dict[str, NDArray],
    exposed: bool,
    dtype: np.dtype,
    directions: Directions = Directions(),  # noqa: B008
) -> tuple[PixelProgram, dict[int, tuple[Source, ModuleType]], list[NDArray]]:
    """A method's program, its modules by stride, and the numbers of its parameters.

    Its functions are traced once for parameters of a kind, translated once for every way that
    conditions on parameters can choose. Raises `Untranslatable`.
    """
    leaves, tree = jax.tree.flatten(params)
    key = (method, tree, tuple(np.shape(leaf) for leaf in leaves), exposed, dtype, directions)
    about, programs = once(
        _programs,
        key,
        lambda: (traced(method, frame_model, params, exposed, dtype, directions), Programs()),
    )
    given = [*host_inputs(about, params, fixed).values()]
    return programs.get(given, lambda: translated(about, params, fixed))


def kernel_of(
    method: FilterMethod,
    frame_model: Any,
    params: Any,
    fixed: dict[str, NDArray],
    exposed: bool,
    dtype: np.dtype,
    stride: int,
    directions: Directions = Directions(),  # noqa: B008
) -> Kernel:
    """The kernel of a method with its parameters and `fixed` numbers; raises `Untranslatable`.

    It is compiled once for a machine.
    """
    program, modules, values = program_of(
        method, frame_model, params, fixed, exposed, dtype, directions
    )

    def made() -> tuple[Source, ModuleType]:
        source = write(program, stride)
        return source, module_of(source.text)

    source, module = once(modules, stride, made)
    functions = Functions(module.events, module.images, module.tables, module.excess)
    numbers = source.values(values, dtype)
    return Kernel(functions, program, source, values, numbers)
