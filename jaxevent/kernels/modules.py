"""Modules made of text, kept in the user's cache folder with what numba compiled of them."""

import functools
import hashlib
import importlib.util
import os
import sys
import tempfile
from pathlib import Path
from types import ModuleType

import numba

from jaxevent import cache
from jaxevent.kernels import numeric


def module_of(text: str) -> ModuleType:
    """The module of a text, from a file that numba keeps compiled functions beside."""
    about = f"{numba.__version__} {_shared()}\n{text}"
    name = f"kernel_{hashlib.blake2b(about.encode(), digest_size=8).hexdigest()}"
    folder = cache.folder_for_compiled() or Path(_own_folder().name)
    path = folder / f"{name}.py"
    if not path.exists():  # numba looks at its time: it is written once
        with tempfile.NamedTemporaryFile("w", dir=folder, suffix=".py", delete=False) as file:
            file.write(text)
        os.replace(file.name, path)
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


@functools.cache
def _shared() -> str:
    """What kernels are made of beside their text."""
    return hashlib.blake2b(Path(numeric.__file__).read_bytes()).hexdigest()


@functools.cache
def _own_folder() -> "tempfile.TemporaryDirectory[str]":
    return tempfile.TemporaryDirectory(prefix="jaxevent")
