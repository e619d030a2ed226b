"""Functions that compiled functions alone call.

numba makes machine code of every function, and of what calls it once more, with the function
inside. Here the first is left out: a fifth to a quarter of the time of compilation.
"""

import inspect
from collections.abc import Callable
from typing import Any

import numba
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler


class _Library(JITCodeLibrary):
    """Code to link into that of callers; no machine code is made of it."""

    def finalize(self) -> None:
        self._raise_if_finalized()
        for library in dict.fromkeys(self._linking_libraries):
            self._reload_init.update(library._reload_init)
            self._final_module.link_in(library._get_module_for_linking(), preserve=True)
        self._final_module.verify()
        self._finalize_dynamic_globals()
        self._finalized = True

    def get_pointer_to_function(self, name: str) -> int:
        self._ensure_finalized()
        return 0

    @property
    def codegen(self) -> Any:
        return _NoEnvironment(self._codegen)


class _NoEnvironment:
    """A code generator that does not store what Python objects a function knows: it knows none."""

    def __init__(self, codegen: Any):
        self._codegen = codegen

    def __getattr__(self, name: str) -> Any:
        return getattr(self._codegen, name)

    def set_env(self, name: str, environment: Any) -> None:
        pass


class _Compiler(Compiler):
    def __init__(self, typing: Any, target: Any, library: Any, *rest: Any):
        library = _Library(target.codegen(), "part") if library is None else library
        super().__init__(typing, target, library, *rest)


def part_of_others(function: Callable, **options: Any) -> Any:
    """`numba.njit` with these options; called from Python it raises `TypeError`.

    It may neither make arrays nor print, nor raise with anything but constants.
    """
    bare = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True, "pipeline_class": _Compiler}
    made: Any = numba.njit(**bare, **options)(inspect.unwrap(function))  # ty: ignore[no-matching-overload]
    made._insert, made._compile_for_args = _ignore, _refuse
    return made


def _ignore(*_: Any) -> None:
    """Do not note for Python what was compiled: it would call nothing, and the process end."""


def _refuse(*_: Any, **named: Any) -> None:
    raise TypeError("this is for compiled functions to call, not for Python")
