"""Public names of the release before this one, which work with a `DeprecationWarning`.

`RENAMED` is the one table. A module or package that renamed something ends with
`__getattr__ = renamed_names(__name__)`; modules that moved are found by `RenamedModules`.
"""
# ruff: noqa: E501, one entry of the table is one line

import functools
import importlib
import importlib.abc
import importlib.machinery
import sys
import types
import warnings
from collections.abc import Callable, Sequence
from typing import Any, TypeVar, cast

T = TypeVar("T")

# The full name until this release, and the one from now on.
RENAMED: dict[str, str] = {
    "jaxevent.blob.Found": "jaxevent.blob.TargetSearchResult",
    "jaxevent.blob.quantities.growth": "jaxevent.blob.quantities.inverse_ttc_from_size",
    "jaxevent.confidence.Finding": "jaxevent.confidence.ParameterInterval",
    "jaxevent.confidence.Findings": "jaxevent.confidence.FitIntervals",
    "jaxevent.confidence.Parted": "jaxevent.confidence.PartwiseLoss",
    "jaxevent.confidence.examine": "jaxevent.confidence.confidence_intervals",
    "jaxevent.egomotion.Known": "jaxevent.egomotion.truth.KnownMotion",
    "jaxevent.egomotion.Motion": "jaxevent.egomotion.motion.MotionEstimate",
    "jaxevent.egomotion.field": "jaxevent.egomotion.flow",
    "jaxevent.egomotion.flow.iterate": "jaxevent.egomotion.flow.iterate_flow",
    "jaxevent.egomotion.from_gyro": "jaxevent.egomotion.twists_from_gyro",
    "jaxevent.egomotion.from_poses": "jaxevent.egomotion.twists_from_poses",
    "jaxevent.egomotion.geometry.contrast": "jaxevent.egomotion.geometry.image_variance",
    "jaxevent.egomotion.geometry.energy": "jaxevent.egomotion.geometry.sum_of_squares",
    "jaxevent.egomotion.geometry.undistort": "jaxevent.egomotion.geometry.centred_coordinates",
    "jaxevent.egomotion.geometry.undistorted": "jaxevent.egomotion.geometry.centred_coordinates",
    "jaxevent.egomotion.model_selection.Choice": "jaxevent.egomotion.model_selection.ModelSelection",
    "jaxevent.egomotion.model_selection.choose": "jaxevent.egomotion.model_selection.select_model",
    "jaxevent.egomotion.model_selection.decide": "jaxevent.egomotion.model_selection.select_by_z",
    "jaxevent.egomotion.motion.Motion": "jaxevent.egomotion.motion.MotionEstimate",
    "jaxevent.egomotion.motion.decided": "jaxevent.egomotion.motion.is_observable",
    "jaxevent.egomotion.patches.Layers": "jaxevent.egomotion.patches.FlowConsistency",
    "jaxevent.egomotion.patches.Look": "jaxevent.egomotion.patches.PatchSharpness",
    "jaxevent.egomotion.patches.Speed": "jaxevent.egomotion.patches.ImageSpeed",
    "jaxevent.egomotion.patches.edges_with_events": "jaxevent.egomotion.patches.edge_event_fraction",
    "jaxevent.egomotion.patches.layers": "jaxevent.egomotion.patches.flow_consistency",
    "jaxevent.egomotion.patches.look": "jaxevent.egomotion.patches.measure_sharpness",
    "jaxevent.egomotion.patches.middles": "jaxevent.egomotion.patches.spread_times",
    "jaxevent.egomotion.patches.stands_still": "jaxevent.egomotion.patches.is_camera_static",
    "jaxevent.egomotion.patches.tried": "jaxevent.egomotion.patches.describe_windows",
    "jaxevent.egomotion.patches.usual_speed": "jaxevent.egomotion.patches.measure_image_speed",
    "jaxevent.egomotion.truth.Known": "jaxevent.egomotion.truth.KnownMotion",
    "jaxevent.egomotion.truth.constant_between": "jaxevent.egomotion.truth.fit_gyro_bias",
    "jaxevent.egomotion.truth.from_gyro": "jaxevent.egomotion.truth.twists_from_gyro",
    "jaxevent.egomotion.truth.from_poses": "jaxevent.egomotion.truth.twists_from_poses",
    "jaxevent.egomotion.truth.imu_rotation": "jaxevent.egomotion.truth.parse_imu_rotation",
    "jaxevent.egomotion.truth.known": "jaxevent.egomotion.truth.known_motion",
    "jaxevent.egomotion.truth.motion_of": "jaxevent.egomotion.truth.motion_from_table",
    "jaxevent.egomotion.truth.nearest_axes": "jaxevent.egomotion.truth.find_imu_axes",
    "jaxevent.egomotion.twists": "jaxevent.egomotion.truth",
    "jaxevent.events.filters.busiest_neighbour": "jaxevent.events.filters.max_neighbour_count",
    "jaxevent.io.aedat2.read": "jaxevent.io.aedat.read_aedat2",
    "jaxevent.io.aedat4.read": "jaxevent.io.aedat.read_aedat4",
    "jaxevent.io.calibrated": "jaxevent.io.checks.make_supported_camera",
    "jaxevent.io.check_unfolded": "jaxevent.io.checks.check_unfolded",
    "jaxevent.io.checked_events": "jaxevent.io.checks.check_events",
    "jaxevent.io.columns.find": "jaxevent.io.columns.find_fields",
    "jaxevent.io.columns.read_npy": "jaxevent.io.tables.read_npy",
    "jaxevent.io.columns.read_text": "jaxevent.io.tables.read_text",
    "jaxevent.io.ecf.FILTER": "jaxevent.io.ecf.HDF5_FILTER_ID",
    "jaxevent.io.ecf.MOST": "jaxevent.io.ecf.MAX_CHUNK_EVENTS",
    "jaxevent.io.ecf.RECORD": "jaxevent.io.ecf.EVENT_DTYPE",
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
    "jaxevent.metrics.checked": "jaxevent.metrics.check_images",
    "jaxevent.parameters.Share": "jaxevent.parameters.UnitInterval",
    "jaxevent.parameters.phrase": "jaxevent.parameters.describe_value_type",
    "jaxevent.reconstruction.compensated.MotionCompensated": "jaxevent.reconstruction.compensated.MotionCompensation",
    "jaxevent.reconstruction.compensated.estimator.MotionCompensated": "jaxevent.reconstruction.compensated.estimator.MotionCompensation",
    "jaxevent.reconstruction.compensated.mc_through_motion": "jaxevent.reconstruction.compensated.mc",
    "jaxevent.reconstruction.filtering.Observer": "jaxevent.reconstruction.filtering.FrameModel",
    "jaxevent.reconstruction.filtering.State": "jaxevent.reconstruction.filtering.PixelState",
    "jaxevent.register.Warped": "jaxevent.register.ResampledImages",
    "jaxevent.register.by_triggers": "jaxevent.register.stamp_by_triggers",
    "jaxevent.register.registered": "jaxevent.register.apply_registration",
    "jaxevent.register.seen": "jaxevent.register.coverage",
    "jaxevent.simulate.Approach": "jaxevent.simulate.ApproachMotion",
    "jaxevent.simulate.Circle": "jaxevent.simulate.CircularMotion",
    "jaxevent.simulate.Clip": "jaxevent.simulate.VideoClip",
    "jaxevent.simulate.FITTING": "jaxevent.simulate.FITTING_SCENES",
    "jaxevent.simulate.Line": "jaxevent.simulate.LinearMotion",
    "jaxevent.simulate.Lissajous": "jaxevent.simulate.LissajousMotion",
    "jaxevent.simulate.Motion": "jaxevent.simulate.TargetMotion",
    "jaxevent.simulate.Objects": "jaxevent.simulate.MovingObjects",
    "jaxevent.simulate.Patch": "jaxevent.simulate.FlatPatch",
    "jaxevent.simulate.Source": "jaxevent.simulate.IntensitySource",
    "jaxevent.simulate.TESTING": "jaxevent.simulate.TESTING_SCENES",
    "jaxevent.simulate.Truth": "jaxevent.simulate.BlobTruth",
    "jaxevent.simulate.World": "jaxevent.simulate.BoxWorld",
    "jaxevent.simulate.blobs.Approach": "jaxevent.simulate.blobs.ApproachMotion",
    "jaxevent.simulate.blobs.BACKGROUND": "jaxevent.simulate.blobs.BACKGROUND_SOURCE",
    "jaxevent.simulate.blobs.CARS": "jaxevent.simulate.blobs.CAR_MOTIONS",
    "jaxevent.simulate.blobs.Circle": "jaxevent.simulate.blobs.CircularMotion",
    "jaxevent.simulate.blobs.Line": "jaxevent.simulate.blobs.LinearMotion",
    "jaxevent.simulate.blobs.Lissajous": "jaxevent.simulate.blobs.LissajousMotion",
    "jaxevent.simulate.blobs.Motion": "jaxevent.simulate.blobs.TargetMotion",
    "jaxevent.simulate.blobs.Truth": "jaxevent.simulate.blobs.BlobTruth",
    "jaxevent.simulate.frame_events": "jaxevent.simulate.simulate_frame_events",
    "jaxevent.simulate.motion.Patch": "jaxevent.simulate.motion.FlatPatch",
    "jaxevent.simulate.motion.World": "jaxevent.simulate.motion.BoxWorld",
    "jaxevent.simulate.motion.frame_events": "jaxevent.simulate.motion.simulate_frame_events",
    "jaxevent.simulate.motion.texture_of": "jaxevent.simulate.motion.make_texture",
    "jaxevent.simulate.objects.Objects": "jaxevent.simulate.scenes.MovingObjects",
    "jaxevent.simulate.scenes.FITTING": "jaxevent.simulate.scenes.FITTING_SCENES",
    "jaxevent.simulate.scenes.Source": "jaxevent.simulate.scenes.IntensitySource",
    "jaxevent.simulate.scenes.TESTING": "jaxevent.simulate.scenes.TESTING_SCENES",
    "jaxevent.simulate.texture_of": "jaxevent.simulate.make_texture",
    "jaxevent.simulate.video.Clip": "jaxevent.simulate.video.VideoClip",
    "jaxevent.tuning.Fitted": "jaxevent.tuning.FitResult",
}
# Modules that have another name or are part of another one.
MOVED_MODULES: dict[str, str] = {
    "jaxevent.devices": "jaxevent.processes",
    "jaxevent.lenses": "jaxevent.camera",
    "jaxevent.runs.published": "jaxevent.runs.external",
    "jaxevent.simulate.objects": "jaxevent.simulate.scenes",
    "jaxevent.egomotion.choice": "jaxevent.egomotion.model_selection",
    "jaxevent.egomotion.field": "jaxevent.egomotion.flow",
    "jaxevent.egomotion.layers": "jaxevent.egomotion.patches",
    "jaxevent.egomotion.still": "jaxevent.egomotion.patches",
    "jaxevent.egomotion.twists": "jaxevent.egomotion.truth",
    "jaxevent.egomotion.warped": "jaxevent.egomotion.geometry",
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
    "jaxevent.show.notebook": "jaxevent.show.figures",
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


def renamed_fields(**names: str) -> Callable[[type[T]], type[T]]:
    """Make a decorator that lets a dataclass take and give fields by their old names too.

    Args:
        names: The new name of each field by its old one.

    Returns:
        The decorator of the dataclass.
    """

    def decorate(cls: Any) -> Any:
        init = cls.__init__

        @functools.wraps(init)
        def __init__(self: Any, *args: Any, **values: Any) -> None:
            for old, new in names.items():
                if old in values:
                    warn_renamed(f"{cls.__name__}.{old}", f"{cls.__name__}.{new}")
                    values[new] = values.pop(old)
            init(self, *args, **values)

        cls.__init__ = __init__
        for old, new in names.items():
            attribute = RenamedAttribute(new)
            attribute.__set_name__(cls, old)
            setattr(cls, old, attribute)
        return cls

    return decorate


def renamed_methods(**names: str) -> Callable[[type[T]], type[T]]:
    """Make a decorator that lets methods be called, and overridden in subclasses, by old names too.

    Args:
        names: The new name of each method or property by its old one.

    Returns:
        The decorator of the class.
    """

    def decorate(cls: Any) -> Any:
        def __init_subclass__(sub: type, **options: Any) -> None:
            super(cls, cast(Any, sub)).__init_subclass__(**options)
            for old, new in names.items():
                if old in vars(sub) and new not in vars(sub):
                    warn_renamed(f"{sub.__name__}.{old}", f"{sub.__name__}.{new}")
                    setattr(sub, new, vars(sub)[old])

        cls.__init_subclass__ = classmethod(__init_subclass__)
        for old, new in names.items():
            attribute = RenamedAttribute(new)
            attribute.__set_name__(cls, old)
            setattr(cls, old, attribute)
        return cls

    return decorate


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
