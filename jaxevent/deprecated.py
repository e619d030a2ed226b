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
    "jaxevent.arrays.find": "jaxevent.arrays.find_fields",
    "jaxevent.arrays.grey_of": "jaxevent.arrays.to_grey",
    "jaxevent.confidence.Finding": "jaxevent.confidence.ParameterInterval",
    "jaxevent.confidence.Findings": "jaxevent.confidence.FitIntervals",
    "jaxevent.confidence.Parted": "jaxevent.confidence.PartwiseLoss",
    "jaxevent.confidence.examine": "jaxevent.confidence.confidence_intervals",
    "jaxevent.devices.ELSEWHERE": "jaxevent.devices.REMOTE",
    "jaxevent.devices.Elsewhere": "jaxevent.devices.RemoteBatch",
    "jaxevent.devices.accelerated": "jaxevent.devices.has_accelerator",
    "jaxevent.devices.along": "jaxevent.devices.shard",
    "jaxevent.devices.local": "jaxevent.devices.local_devices",
    "jaxevent.devices.mesh": "jaxevent.devices.make_mesh",
    "jaxevent.estimator.Described": "jaxevent.estimator.ShortRepr",
    "jaxevent.io.aedat2.read": "jaxevent.io.aedat.read_aedat2",
    "jaxevent.io.aedat4.read": "jaxevent.io.aedat.read_aedat4",
    "jaxevent.io.calibrated": "jaxevent.io.checks.make_supported_camera",
    "jaxevent.io.check_unfolded": "jaxevent.io.checks.check_unfolded",
    "jaxevent.io.columns.find": "jaxevent.io.columns.find_fields",
    "jaxevent.io.columns.read_npy": "jaxevent.io.tables.read_npy",
    "jaxevent.io.columns.read_text": "jaxevent.io.tables.read_text",
    "jaxevent.io.ecf.MOST": "jaxevent.io.ecf.MAX_EVENTS",
    "jaxevent.io.event_stream.read": "jaxevent.io.atis.read_event_stream",
    "jaxevent.io.evimo.read": "jaxevent.io.folders.read_evimo",
    "jaxevent.io.evreal.read": "jaxevent.io.folders.read_evreal",
    "jaxevent.io.find_event_texts": "jaxevent.io.text.find_event_texts",
    "jaxevent.io.most_unfolded": "jaxevent.io.checks.max_unfolded",
    "jaxevent.io.n_caltech.read": "jaxevent.io.atis.read_n_caltech",
    "jaxevent.io.npz.read": "jaxevent.io.tables.read_npz",
    "jaxevent.io.parquet.read": "jaxevent.io.tables.read_parquet",
    "jaxevent.io.pinhole": "jaxevent.io.checks.make_camera",
    "jaxevent.io.ros_events.event_topic": "jaxevent.io.ros.open_event_topic",
    "jaxevent.io.timelens.read": "jaxevent.io.folders.read_timelens",
    "jaxevent.io.whole_number": "jaxevent.io.checks.whole_number",
    "jaxevent.parameters.Share": "jaxevent.parameters.UnitInterval",
    "jaxevent.parameters.nearest": "jaxevent.parameters.suggest_name",
    "jaxevent.parameters.shown": "jaxevent.parameters.format_value",
    "jaxevent.tuning.Believed": "jaxevent.tuning.LossWithPrior",
    "jaxevent.tuning.Fitted": "jaxevent.tuning.FitResult",
    "jaxevent.tuning.Weighted": "jaxevent.tuning.WeightedBatch",
    "jaxevent.tuning.loss_of": "jaxevent.tuning.evaluate_loss",
    "jaxevent.tuning.slopes": "jaxevent.tuning.loss_and_grad",
}
# Modules that have another name or are part of another one.
MOVED_MODULES: dict[str, str] = {
    "jaxevent.io.aedat2": "jaxevent.io.aedat",
    "jaxevent.io.aedat4": "jaxevent.io.aedat",
    "jaxevent.io.event_stream": "jaxevent.io.atis",
    "jaxevent.io.evimo": "jaxevent.io.folders",
    "jaxevent.io.evreal": "jaxevent.io.folders",
    "jaxevent.io.exposures": "jaxevent.io.images",
    "jaxevent.io.n_caltech": "jaxevent.io.atis",
    "jaxevent.io.npz": "jaxevent.io.tables",
    "jaxevent.io.parquet": "jaxevent.io.tables",
    "jaxevent.io.ros_events": "jaxevent.io.ros",
    "jaxevent.io.timelens": "jaxevent.io.folders",
    "jaxevent.sharing": "jaxevent.locks",
    "jaxevent.shown": "jaxevent.display",
}


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
        renamed = renamed_names(spec.name)

        def __getattr__(name: str) -> Any:
            if f"{spec.name}.{name}" in RENAMED:
                return renamed(name)
            return getattr(importlib.import_module(new), name)

        vars(module)["__getattr__"] = __getattr__
        return module

    def exec_module(self, module: types.ModuleType) -> None:
        """Do nothing: names are read when they are used."""


def install() -> None:
    """Let imports find modules by their old names."""
    if not any(isinstance(finder, RenamedModules) for finder in sys.meta_path):
        sys.meta_path.append(RenamedModules())
