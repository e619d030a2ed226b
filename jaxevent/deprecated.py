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
    "jaxevent.egomotion.Known": "jaxevent.egomotion.truth.KnownMotion",
    "jaxevent.egomotion.Motion": "jaxevent.egomotion.motion.MotionEstimate",
    "jaxevent.egomotion.candidates.Batches": "jaxevent.egomotion.candidates.CandidateBatches",
    "jaxevent.egomotion.candidates.Expected": "jaxevent.egomotion.candidates.ExpectedFlow",
    "jaxevent.egomotion.candidates.Gatherer": "jaxevent.egomotion.candidates.CandidateSampler",
    "jaxevent.egomotion.candidates.coordinates": "jaxevent.egomotion.candidates.pixel_coordinates",
    "jaxevent.egomotion.field": "jaxevent.egomotion.flow",
    "jaxevent.egomotion.flow.iterate": "jaxevent.egomotion.flow.iterate_flow",
    "jaxevent.egomotion.geometry.contrast": "jaxevent.egomotion.geometry.image_variance",
    "jaxevent.egomotion.geometry.energy": "jaxevent.egomotion.geometry.sum_of_squares",
    "jaxevent.egomotion.geometry.undistorted": "jaxevent.egomotion.geometry.undistort",
    "jaxevent.egomotion.model_selection.Choice": (
        "jaxevent.egomotion.model_selection.ModelSelection"
    ),
    "jaxevent.egomotion.model_selection.Layers": (
        "jaxevent.egomotion.model_selection.FlowConsistency"
    ),
    "jaxevent.egomotion.model_selection.choose": "jaxevent.egomotion.model_selection.select_model",
    "jaxevent.egomotion.model_selection.decide": "jaxevent.egomotion.model_selection.select_by_z",
    "jaxevent.egomotion.model_selection.layers": (
        "jaxevent.egomotion.model_selection.flow_consistency"
    ),
    "jaxevent.egomotion.motion.Calibration": "jaxevent.egomotion.motion.CovarianceCalibration",
    "jaxevent.egomotion.motion.Motion": "jaxevent.egomotion.motion.MotionEstimate",
    "jaxevent.egomotion.motion.decided": "jaxevent.egomotion.motion.is_observable",
    "jaxevent.egomotion.motion.left_by_lens": "jaxevent.egomotion.motion.lens_error",
    "jaxevent.egomotion.patches.Look": "jaxevent.egomotion.patches.PatchSharpness",
    "jaxevent.egomotion.patches.Speed": "jaxevent.egomotion.patches.ImageSpeed",
    "jaxevent.egomotion.patches.edges_with_events": (
        "jaxevent.egomotion.patches.edge_event_fraction"
    ),
    "jaxevent.egomotion.patches.look": "jaxevent.egomotion.patches.measure_sharpness",
    "jaxevent.egomotion.patches.middles": "jaxevent.egomotion.patches.spread_times",
    "jaxevent.egomotion.patches.stands_still": "jaxevent.egomotion.patches.is_camera_static",
    "jaxevent.egomotion.patches.tried": "jaxevent.egomotion.patches.describe_windows",
    "jaxevent.egomotion.patches.usual_speed": "jaxevent.egomotion.patches.measure_image_speed",
    "jaxevent.egomotion.truth.Known": "jaxevent.egomotion.truth.KnownMotion",
    "jaxevent.egomotion.truth.constant_between": "jaxevent.egomotion.truth.fit_gyro_bias",
    "jaxevent.egomotion.truth.known": "jaxevent.egomotion.truth.known_motion",
    "jaxevent.egomotion.truth.motion_of": "jaxevent.egomotion.truth.motion_from_table",
    "jaxevent.egomotion.truth.nearest_axes": "jaxevent.egomotion.truth.find_imu_axes",
    "jaxevent.egomotion.twists": "jaxevent.egomotion.truth",
}
# Modules that have another name or are part of another one.
MOVED_MODULES: dict[str, str] = {
    "jaxevent.egomotion.choice": "jaxevent.egomotion.model_selection",
    "jaxevent.egomotion.field": "jaxevent.egomotion.flow",
    "jaxevent.egomotion.layers": "jaxevent.egomotion.model_selection",
    "jaxevent.egomotion.still": "jaxevent.egomotion.patches",
    "jaxevent.egomotion.twists": "jaxevent.egomotion.truth",
    "jaxevent.egomotion.warped": "jaxevent.egomotion.geometry",
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

    def __init__(self, new: str, old: str = ""):
        self.new, self.old = new, old  # a NamedTuple does not set the old name

    def __set_name__(self, owner: type, name: str) -> None:
        self.old = name

    def __get__(self, instance: Any, owner: type) -> Any:
        warn_renamed(f"{owner.__name__}.{self.old}", f"{owner.__name__}.{self.new}")
        return getattr(owner if instance is None else instance, self.new)


def adopt_old_overrides(cls: type) -> None:
    """Let a user's subclass override methods and attributes by their old names.

    A base class calls it in `__init_subclass__`; its old names are `RenamedAttribute`s.

    Args:
        cls: The subclass.
    """
    bases = cls.__mro__[1:]
    for old, value in list(vars(cls).items()):
        renamed = next((vars(base)[old] for base in bases if old in vars(base)), None)
        if isinstance(renamed, RenamedAttribute) and not isinstance(value, RenamedAttribute):
            warn_renamed(f"{cls.__name__}.{old}", f"{cls.__name__}.{renamed.new}")
            delattr(cls, old)
            setattr(cls, renamed.new, value)


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
