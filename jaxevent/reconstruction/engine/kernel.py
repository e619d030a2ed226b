"""Kernels: a method's text compiled by numba, kept in the user's cache folder, with its numbers."""

from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray

from jaxevent.codegen.module import CompiledProgram, KernelCache
from jaxevent.reconstruction.engine.loop import Functions
from jaxevent.reconstruction.engine.pixel import (
    Directions,
    host_inputs,
    traced,
    translated,
)
from jaxevent.reconstruction.engine.source import write

_kernels = KernelCache(Functions, write)


def kernel_of(
    method: Any,
    params: Any,
    fixed: dict[str, NDArray],
    layout: tuple[bool, np.dtype, int],
    directions: Directions = Directions(),  # noqa: B008
    compiled: bool = True,
) -> CompiledProgram | None:
    """The kernel of a method with its parameters and `fixed` numbers; raises `TranslationError`.

    `layout`: whether exposures are known, kind of numbers, stride.
    """
    exposed, dtype, stride = layout
    leaves, tree = jax.tree.flatten(params)
    shapes = tuple(np.shape(leaf) for leaf in leaves)
    key = (method, tree, shapes, exposed, dtype, directions)
    inputs = host_inputs(params, fixed, directions)

    def translate() -> Any:
        about = traced(method, method.frame_model, params, exposed, dtype, directions)
        return translated(about, params, fixed)

    if not compiled:
        _kernels.find_program(key, inputs, translate)
        return None
    return _kernels.get(key, inputs, translate, stride)
