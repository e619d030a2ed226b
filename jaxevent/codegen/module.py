"""Modules made of text, compiled by numba and cached with the programs that they were made of."""

import functools
import hashlib
import os
import sys
import tempfile
import threading
import warnings
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple, TypeVar

import jax
import numpy as np
from numpy.typing import NDArray

from jaxevent import cache, threads
from jaxevent.codegen.graph import TranslationError, find_dependencies
from jaxevent.codegen.support import compiler_lock, numba
from jaxevent.codegen.write import ModuleText
from jaxevent.errors import InputError, InputWarning

T = TypeVar("T")
IS_SYNCHRONOUS = threads.use_synchronous_dispatch()  # so that programs may call kernels
_lock = threading.RLock()  # held while what all threads use is made


def _wait_to_fork() -> None:
    _lock.acquire()
    compiler_lock.acquire()


def _go_on() -> None:
    compiler_lock.release()
    _lock.release()


# A thread that had them would keep them in the child for ever.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(before=_wait_to_fork, after_in_parent=_go_on, after_in_child=_go_on)


def get_or_make(known: dict[Any, T], key: Any, make: Callable[[], T]) -> T:
    """Return the value of a key; one thread makes it, while others wait.

    Args:
        known: Values by key, to which a new one is added.
        key: The key.
        make: Makes the value.
    """
    if key not in known:
        with _lock:
            if key not in known:
                known[key] = make()
    return known[key]


class CompiledProgram(NamedTuple):
    """A program's compiled functions, with the numbers of parameters.

    Attributes:
        program: The traced program.
        functions: The functions, a tuple of the engine.
        numbers: Numbers that the functions take.
        places: Places where the functions find their data.
        values: Values of the program's `host`.
    """

    program: Any
    functions: Any
    numbers: NDArray
    places: Any
    values: list[NDArray]


class KernelCache:
    """A family's programs, compiled: one for each way that conditions on parameters choose.

    Args:
        functions: A named tuple of the functions that a module has.
        write: Writes the module of a program.
        max_nodes: Nodes of a program: beyond, numba compiles longer than XLA's scan takes.
    """

    def __init__(
        self, functions: Any, write: Callable[..., ModuleText], max_nodes: int | None = None
    ) -> None:
        self.functions, self.write, self.max_nodes = functions, write, max_nodes
        self._programs: dict[Any, list[tuple[Any, dict]]] = {}  # with their modules

    def find_program(
        self, key: Any, params: Any, translate: Callable[[], Any]
    ) -> tuple[Any, dict, list[NDArray]]:
        """Find the program for some parameters, and translate it if there is none yet.

        Args:
            key: All that `translate` depends on beside `params`.
            params: Pytree of the numbers that the program's `host` begins with.
            translate: Makes the program; raises `TranslationError`.

        Returns:
            The program, its modules, and the values of its `host` for these parameters.
        """
        leaves, tree = jax.tree.flatten(params)
        inputs = [np.asarray(leaf) for leaf in leaves]
        shapes = tuple(array.shape for array in inputs)
        programs = get_or_make(self._programs, (key, tree, shapes), list)
        found = _match(programs, inputs)
        if found is None:
            with _lock:
                found = _match(programs, inputs)
                if found is None:
                    program = translate()
                    found = program, {}, program.host.values
                    programs.append(found[:2])
        return found

    def get(
        self, key: Any, params: Any, translate: Callable[[], Any], *layout: Any
    ) -> CompiledProgram:
        """Compile the program for some parameters, if it is not yet; see `find_program`.

        Args:
            key: All that `translate` depends on beside `params`.
            params: Pytree of the numbers that the program's `host` begins with.
            translate: Makes the program; raises `TranslationError`.
            layout: Further arguments of `write`.

        Raises:
            TranslationError: There is no kernel.
        """
        program, modules, values = self.find_program(key, params, translate)
        text, functions = get_or_make(modules, layout, lambda: self._compile(program, *layout))
        numbers = text.parameters.gather(values)
        return CompiledProgram(program, functions, numbers, text.places, values)

    def check(self, key: Any, params: Any, translate: Callable[[], Any]) -> None:
        """Raise `TranslationError` where there is no kernel.

        Args:
            key: See `find_program`.
            params: See `find_program`.
            translate: See `find_program`.
        """
        self._check_size(self.find_program(key, params, translate)[0])

    def _check_size(self, program: Any) -> None:
        if self.max_nodes is not None and count_nodes(program) > self.max_nodes:
            raise TranslationError(f"more than {self.max_nodes} operations")

    def _compile(self, program: Any, *layout: Any) -> tuple[ModuleText, Any]:
        self._check_size(program)
        text = self.write(program, *layout)
        module = compile_module(text.text)
        return text, self.functions(*(getattr(module, n) for n in self.functions._fields))


def count_nodes(program: Any) -> int:
    """Count the operations of a program's functions."""
    results = [n for f in program.functions.values() for n in f.results.values()]
    return len(find_dependencies(results))


def _match(
    programs: list[tuple[Any, dict]], inputs: list[NDArray]
) -> tuple[Any, dict, list[NDArray]] | None:
    """Find the program whose conditions on parameters hold.

    Args:
        programs: Programs, and their modules by layout.
        inputs: Leaves of the parameters.

    Returns:
        The program, its modules, and the values of its `host`; None if there is none.
    """
    for program, modules in list(programs):
        values = program.host.evaluate(inputs)
        if values is not None:
            return program, modules, values
    return None


def choose_backend(compiler: str | None, numba_serves: bool) -> str:
    """Choose the compiler of a method.

    Args:
        compiler: "numba" or "xla" if the user names one.
        numba_serves: Whether numba is the faster one here.

    Returns:
        "numba" or "xla".

    Raises:
        InputError: There is no such compiler.
    """
    if compiler not in (None, "numba", "xla"):
        raise InputError(f"there is no compiler {compiler!r}; give numba or xla, or none")
    return compiler or ("numba" if numba_serves else "xla")


def make_kernel(
    name: str, compiler: str | None, numba_serves: bool, make: Callable[[], T]
) -> T | None:
    """Make the kernel object of a method, or return None where XLA compiles the method.

    Args:
        name: Name of the method.
        compiler: "numba" or "xla" if the user names one.
        numba_serves: Whether numba is the faster one here.
        make: Makes it; raises `TranslationError` where there is no kernel.

    Raises:
        InputError: The user names numba, and there is no kernel.
    """
    if choose_backend(compiler, numba_serves) == "xla":
        return None
    try:
        return make()
    except TranslationError as reason:
        if compiler == "numba":
            raise InputError(
                f"numba has no kernel for the method {name!r} ({reason}); leave out the compiler"
            ) from reason
        return None


def programs_may_call(name: str, compiler: str | None) -> bool:
    """Return whether JAX's programs may call kernels; an `InputWarning` says why not.

    Args:
        name: Name of the method.
        compiler: "numba" or "xla" if the user names one.

    Raises:
        InputError: They may not, and the user names numba.
    """
    if IS_SYNCHRONOUS:
        return True
    reason = "JAX computed before jaxevent was imported; import jaxevent first"
    if compiler == "numba":
        raise InputError(f"no program may call the kernel of {name!r}, as {reason}")
    slow = f"a fit of {name!r} takes several times as long without a kernel"
    warnings.warn(f"{slow}: {reason}", InputWarning, stacklevel=4)
    return False


def compile_module(text: str) -> ModuleType:
    """Make a module from its text, in a file with its compiled functions beside it (`cache`).

    Raises:
        TranslationError: numba cannot be imported, or does not compile the module.
    """
    if numba is None:
        raise TranslationError("numba cannot be imported")
    about = f"{numba.__version__} {_hash_writer()}\n{text}"
    name = f"kernel_{hashlib.blake2b(about.encode(), digest_size=8).hexdigest()}"
    folder = cache.folder_for_compiled() or Path(_own_folder().name)
    path = folder / f"{name}.py"
    if _content(path) != text.encode():
        with tempfile.NamedTemporaryFile("wb", dir=folder, suffix=".py", delete=False) as file:
            file.write(text.encode())
        os.replace(file.name, path)
    module = ModuleType(name)
    module.__file__ = str(path)
    sys.modules[name] = module
    # Not by an import: Python keeps bytecode beside a file, and a part of that ends the process.
    try:
        exec(compile(text, path, "exec"), module.__dict__)
    except Exception as error:  # a release of numba may fail in any way
        reason = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        about = f"numba {numba.__version__} does not compile it: {reason}"
        warnings.warn(f"a kernel is left to XLA, which is slower, as {about}", stacklevel=2)
        raise TranslationError(about) from error
    return module


def _content(path: Path) -> bytes | None:
    try:
        return path.read_bytes()
    except OSError:
        return None


@functools.cache
def _hash_writer() -> str:
    """Hash the sources that kernels depend on beside their text."""
    names = ("write.py", "derivative.py", "functions.py")
    sources = (Path(__file__).with_name(name).read_bytes() for name in names)
    return hashlib.blake2b(b"".join(sources)).hexdigest()


@functools.cache
def _own_folder() -> "tempfile.TemporaryDirectory[str]":
    return tempfile.TemporaryDirectory(prefix="jaxevent")
