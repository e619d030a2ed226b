"""Modules made of text, kept in the user's cache folder with what numba compiled of them."""

import functools
import hashlib
import os
import sys
import tempfile
from pathlib import Path
from types import ModuleType

from jaxevent import cache
from jaxevent.codegen import blocks, linear, numeric
from jaxevent.codegen.expressions import Untranslatable
from jaxevent.codegen.support import numba


def module_of(text: str) -> ModuleType:
    """The module of a text, from a file with its compiled functions beside it (`kept`).

    Raises `Untranslatable` where numba cannot be imported.
    """
    if numba is None:
        raise Untranslatable("numba cannot be imported")
    about = f"{numba.__version__} {_shared()}\n{text}"
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
    exec(compile(text, path, "exec"), module.__dict__)
    return module


def _content(path: Path) -> bytes | None:
    try:
        return path.read_bytes()
    except OSError:
        return None


@functools.cache
def _shared() -> str:
    """What kernels are made of beside their text."""
    sources = (Path(str(module.__file__)).read_bytes() for module in (blocks, linear, numeric))
    return hashlib.blake2b(b"".join(sources)).hexdigest()


@functools.cache
def _own_folder() -> "tempfile.TemporaryDirectory[str]":
    return tempfile.TemporaryDirectory(prefix="jaxevent")
