"""Private interfaces of numba that kernels use, with the releases that `support` names.

numba makes machine code of every function, and of what calls it once more, with the function
inside. For a part, which compiled functions alone call, the first is left out: a fifth to a quarter
of the time of compilation.

What is compiled can be kept: a `SignatureCache` takes the place of numba's own cache, which keeps
an index of a function's signatures in a folder that others may write to.
"""

import hashlib
import inspect
from collections.abc import Callable
from typing import Any

import numba
from numba.core import sigutils
from numba.core.ccallback import CFunc
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler, CompileResult
from numba.core.runtime.nrt import rtsys
from numba.core.serialize import dumps
from numba.cpython import hashing  # noqa: F401  (its symbols: loaded code may refer to them)
from numba.experimental import function_type  # noqa: F401  (the type of kernels as arguments)


class _Library(JITCodeLibrary):
    """Code to link into that of callers; no machine code is made of it."""

    def finalize(self) -> None:
        self._raise_if_finalized()
        for library in dict.fromkeys(self._linking_libraries):
            if hasattr(library, "_reload_init"):  # since numba 0.62
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
    """A code generator that stores no Python objects: the functions refer to none."""

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


def njit_linked(function: Callable, **options: Any) -> Any:
    """Compile by `numba.njit` with these options; called from Python it raises `TypeError`.

    The function may neither make arrays nor print, nor raise with anything but constants.
    """
    bare = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True, "pipeline_class": _Compiler}
    made: Any = numba.njit(**bare, **options)(inspect.unwrap(function))  # ty: ignore[no-matching-overload]
    made._insert, made._compile_for_args = _ignore, _refuse
    return made


def _ignore(*_: Any) -> None:
    """Do not tell Python what was compiled: a call would call nothing, and end the process."""


def _refuse(*_: Any, **named: Any) -> None:
    raise TypeError("this is for compiled functions to call, not for Python")


class SignatureCache:
    """A cache for a function's compiled signatures, as numba's dispatchers use one.

    `files` has the methods `load(key)`, `save(key, data)` and `flush()`; see
    `cache.SignatureFiles`.
    """

    def __init__(self, function: Any, files: Any):
        self._function, self._files = function, files
        self._enabled = True

    @property
    def cache_path(self) -> str:
        return str(self._files.folder)

    def enable(self) -> None:
        self._enabled = True

    def disable(self) -> None:
        self._enabled = False

    def flush(self) -> None:
        self._files.flush()

    def load_overload(self, signature: Any, target: Any) -> Any:
        """Load the machine code of a signature, or return None.

        numba refreshes the target first, for what only compiling needs: imports that take half a
        second.

        Args:
            signature: Types of the arguments.
            target: Context of the machine.
        """
        if not self._enabled:
            return None
        rtsys.initialize(target)
        kept = self._files.load(self._key(signature, target.codegen()))
        return None if kept is None else CompileResult._rebuild(target, *kept)

    def save_overload(self, signature: Any, made: Any) -> None:
        """Store the machine code of a signature, unless it holds addresses of this process.

        Args:
            signature: Types of the arguments.
            made: numba's result of compiling it.
        """
        if self._enabled and not made.lifted and not made.library.has_dynamic_globals:
            self._files.save(self._key(signature, made.codegen), made._reduce())

    def _key(self, signature: Any, codegen: Any) -> Any:
        cells = tuple(cell.cell_contents for cell in self._function.__closure__ or ())
        about = self._function.__code__.co_code + (dumps(cells) if cells else b"")
        return signature, codegen.magic_tuple(), hashlib.blake2b(about).hexdigest()


def use_signature_cache(dispatcher: Any, files: Any) -> Any:
    """Make a dispatcher of `numba.njit` cache its signatures in files, and return it.

    Args:
        dispatcher: The dispatcher, which is changed.
        files: `cache.SignatureFiles`.
    """
    dispatcher._cache = SignatureCache(dispatcher.py_func, files)
    return dispatcher


def cached_cfunc(function: Callable, signature: Any, options: dict[str, Any], files: Any) -> CFunc:
    """Compile a function as `numba.cfunc` does, cached in files.

    Args:
        function: The function.
        signature: Types of its result and arguments.
        options: Options of `numba.cfunc`.
        files: `cache.SignatureFiles`.
    """
    made: Any = CFunc(function, sigutils.normalize_signature(signature), {}, options)
    made._cache = SignatureCache(function, files)
    made.compile()
    return made
