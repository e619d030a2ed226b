"""Public names of the release before this one, which work with a `DeprecationWarning`.

`RENAMED` is the one table. A module or package that renamed something ends with
`__getattr__ = renamed_names(__name__)`; modules that moved are found by `RenamedModules`.
"""

import importlib
import importlib.abc
import importlib.machinery
import sys
import types
import warnings
from collections.abc import Callable, Sequence
from typing import Any

# The full name until this release, and the one from now on.
RENAMED: dict[str, str] = {
    "jaxevent.register.Warped": "jaxevent.register.ResampledImages",
    "jaxevent.register.by_triggers": "jaxevent.register.stamp_by_triggers",
    "jaxevent.register.registered": "jaxevent.register.apply_registration",
    "jaxevent.register.seen": "jaxevent.register.coverage",
}
# Modules that have another name or are part of another one.
MOVED_MODULES: dict[str, str] = {}


def warn_renamed(old: str, new: str) -> None:
    """Warn the caller's caller that a public name is deprecated.

    Args:
        old: The full name that was used.
        new: The full name to use.
    """
    warnings.warn(
        f"{old} is deprecated and goes with the next release: use {new}",
        DeprecationWarning,
        stacklevel=3,
    )


def renamed_names(module: str) -> Callable[[str], Any]:
    """Make the `__getattr__` of a module whose names changed.

    Args:
        module: Full name of the module.

    Returns:
        A function from an old name to the object that has a new one.
    """

    def __getattr__(name: str) -> Any:
        new = RENAMED.get(f"{module}.{name}")
        if new is None:
            raise AttributeError(f"module {module!r} has no attribute {name!r}")
        warn_renamed(f"{module}.{name}", new)
        home, _, attribute = new.rpartition(".")
        return getattr(importlib.import_module(home), attribute)

    return __getattr__


class RenamedAttribute:
    """An attribute that gives another one, with a warning: `old = RenamedAttribute("new")`."""

    def __init__(self, new: str):
        self.new = new

    def __set_name__(self, owner: type, name: str) -> None:
        self.old = name

    def __get__(self, instance: Any, owner: type) -> Any:
        warn_renamed(f"{owner.__name__}.{self.old}", f"{owner.__name__}.{self.new}")
        return getattr(owner if instance is None else instance, self.new)


class RenamedModules(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Finder of modules by their old names, which gives the modules that took their place."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: types.ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        """See `importlib.abc.MetaPathFinder.find_spec`."""
        known = fullname in MOVED_MODULES
        return importlib.machinery.ModuleSpec(fullname, self) if known else None

    def create_module(self, spec: importlib.machinery.ModuleSpec) -> types.ModuleType:
        """Make a module that reads all names from the one that took its place."""
        new = MOVED_MODULES[spec.name]
        warn_renamed(spec.name, new)
        module = types.ModuleType(spec.name, f"The old name of `{new}`.")
        vars(module)["__getattr__"] = lambda name: getattr(importlib.import_module(new), name)
        return module

    def exec_module(self, module: types.ModuleType) -> None:
        """Do nothing: names are read when they are used."""


def install() -> None:
    """Let imports find modules by their old names."""
    if not any(isinstance(finder, RenamedModules) for finder in sys.meta_path):
        sys.meta_path.append(RenamedModules())
