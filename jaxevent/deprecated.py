"""Public names of the release before this one, which work with a `DeprecationWarning`.

`RENAMED` is the one table. A module or package that renamed something ends with
`__getattr__ = renamed_names(__name__)`; modules that moved are found by `RenamedModules`.
"""
# ruff: noqa: E501, one entry of the table is one line

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
    "jaxevent.blob.Found": "jaxevent.blob.TargetSearchResult",
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
    "jaxevent.parameters.Share": "jaxevent.parameters.UnitInterval",
    "jaxevent.parameters.nearest": "jaxevent.parameters.suggest_name",
    "jaxevent.parameters.shown": "jaxevent.parameters.format_value",
    "jaxevent.reconstruction.compensated.MotionCompensated": "jaxevent.reconstruction.compensated.MotionCompensation",
    "jaxevent.reconstruction.compensated.estimator.Followed": "jaxevent.reconstruction.compensated.estimator.TrajectoryEstimate",
    "jaxevent.reconstruction.compensated.estimator.Follower": "jaxevent.reconstruction.compensated.estimator.TrajectoryEstimator",
    "jaxevent.reconstruction.compensated.estimator.Images": "jaxevent.reconstruction.compensated.images.InstantImages",
    "jaxevent.reconstruction.compensated.estimator.MotionCompensated": "jaxevent.reconstruction.compensated.estimator.MotionCompensation",
    "jaxevent.reconstruction.compensated.estimator.Moving": "jaxevent.reconstruction.compensated.estimator.FlowSource",
    "jaxevent.reconstruction.compensated.estimator.Shutter": "jaxevent.reconstruction.compensated.exposures.FrameExposures",
    "jaxevent.reconstruction.compensated.estimator.Start": "jaxevent.reconstruction.compensated.estimator.InitialMotion",
    "jaxevent.reconstruction.compensated.estimator.Targets": "jaxevent.reconstruction.compensated.estimator.PreparedTargets",
    "jaxevent.reconstruction.compensated.estimator.evidence": "jaxevent.reconstruction.compensated.images.instant_smoother",
    "jaxevent.reconstruction.compensated.estimator.follower_of": "jaxevent.reconstruction.compensated.estimator.make_trajectory_estimator",
    "jaxevent.reconstruction.compensated.estimator.fuse_images": "jaxevent.reconstruction.compensated.estimator.fuse_target",
    "jaxevent.reconstruction.compensated.estimator.look": "jaxevent.reconstruction.compensated.estimator.compare_images",
    "jaxevent.reconstruction.compensated.estimator.schedule_of": "jaxevent.reconstruction.compensated.estimator.make_schedule",
    "jaxevent.reconstruction.compensated.estimator.smoothed_back": "jaxevent.reconstruction.compensated.estimator.add_smooth_part",
    "jaxevent.reconstruction.compensated.fusion.Comparison": "jaxevent.reconstruction.compensated.fusion.FusionFeatures",
    "jaxevent.reconstruction.compensated.fusion.Fused": "jaxevent.reconstruction.compensated.fusion.FusedImage",
    "jaxevent.reconstruction.compensated.fusion.Views": "jaxevent.reconstruction.compensated.fusion.ReferenceImages",
    "jaxevent.reconstruction.compensated.fusion.compare": "jaxevent.reconstruction.compensated.fusion.fusion_features",
    "jaxevent.reconstruction.compensated.fusion.decide": "jaxevent.reconstruction.compensated.fusion.fuse_candidates",
    "jaxevent.reconstruction.compensated.fusion.signs_of_doubt": "jaxevent.reconstruction.compensated.fusion.variance_features",
    "jaxevent.reconstruction.compensated.fusion.views": "jaxevent.reconstruction.compensated.fusion.reference_images",
    "jaxevent.reconstruction.compensated.fusion.weight_after": "jaxevent.reconstruction.compensated.fusion.after_weight",
    "jaxevent.reconstruction.compensated.normal_equations.Equations": "jaxevent.reconstruction.compensated.normal_equations.NormalEquations",
    "jaxevent.reconstruction.compensated.normal_equations.Numbers": "jaxevent.reconstruction.compensated.normal_equations.CostParams",
    "jaxevent.reconstruction.compensated.normal_equations.Seen": "jaxevent.reconstruction.compensated.normal_equations.MotionImages",
    "jaxevent.reconstruction.compensated.normal_equations.depending": "jaxevent.reconstruction.compensated.normal_equations.implicit_trajectories",
    "jaxevent.reconstruction.compensated.normal_equations.equations": "jaxevent.reconstruction.compensated.normal_equations.linearise_jax",
    "jaxevent.reconstruction.compensated.normal_equations.imbalance": "jaxevent.reconstruction.compensated.normal_equations.residual",
    "jaxevent.reconstruction.compensated.robust_mean.Agreement": "jaxevent.reconstruction.compensated.robust_mean.RobustMean",
    "jaxevent.reconstruction.compensated.robust_mean.Place": "jaxevent.reconstruction.compensated.robust_mean.InstantLayout",
    "jaxevent.reconstruction.compensated.robust_mean.across": "jaxevent.reconstruction.compensated.robust_mean.blur_along_x",
    "jaxevent.reconstruction.compensated.robust_mean.agree": "jaxevent.reconstruction.compensated.robust_mean.robust_mean",
    "jaxevent.reconstruction.compensated.robust_mean.agree_purely": "jaxevent.reconstruction.compensated.robust_mean.robust_mean_jax",
    "jaxevent.reconstruction.compensated.robust_mean.blur": "jaxevent.reconstruction.compensated.robust_mean.blur_jax",
    "jaxevent.reconstruction.compensated.robust_mean.blurred": "jaxevent.reconstruction.compensated.robust_mean.blur_image",
    "jaxevent.reconstruction.compensated.robust_mean.down": "jaxevent.reconstruction.compensated.robust_mean.blur_along_y",
    "jaxevent.reconstruction.compensated.robust_mean.place_of": "jaxevent.reconstruction.compensated.robust_mean.make_layout",
    "jaxevent.reconstruction.compensated.robust_mean.shown": "jaxevent.reconstruction.compensated.robust_mean.visibility",
    "jaxevent.reconstruction.compensated.robust_mean.steepness": "jaxevent.reconstruction.compensated.robust_mean.squared_gradient",
    "jaxevent.reconstruction.compensated.robust_mean.stretch": "jaxevent.reconstruction.compensated.robust_mean.activity_range",
    "jaxevent.reconstruction.compensated.robust_mean.taps_of": "jaxevent.reconstruction.compensated.robust_mean.gaussian_taps",
    "jaxevent.reconstruction.compensated.trajectories.Motion": "jaxevent.reconstruction.compensated.trajectories.NodeTrajectories",
    "jaxevent.reconstruction.compensated.trajectories.Pyramid": "jaxevent.reconstruction.compensated.trajectories.ImagePyramid",
    "jaxevent.reconstruction.compensated.trajectories.Row": "jaxevent.reconstruction.compensated.warp.RowScratch",
    "jaxevent.reconstruction.compensated.trajectories.Smoothness": "jaxevent.reconstruction.compensated.normal_equations.CostParams",
    "jaxevent.reconstruction.compensated.trajectories.around": "jaxevent.reconstruction.compensated.warp.bilinear_cell",
    "jaxevent.reconstruction.compensated.trajectories.between": "jaxevent.reconstruction.compensated.warp.interpolate_path",
    "jaxevent.reconstruction.compensated.trajectories.by_clock": "jaxevent.reconstruction.compensated.trajectories.change_clock",
    "jaxevent.reconstruction.compensated.trajectories.choose": "jaxevent.reconstruction.compensated.trajectories.select_paths",
    "jaxevent.reconstruction.compensated.trajectories.fetch": "jaxevent.reconstruction.compensated.normal_equations.sample_trajectories",
    "jaxevent.reconstruction.compensated.trajectories.follow": "jaxevent.reconstruction.compensated.trajectories.estimate_trajectories",
    "jaxevent.reconstruction.compensated.trajectories.locate": "jaxevent.reconstruction.compensated.warp.locate_points",
    "jaxevent.reconstruction.compensated.trajectories.misfit": "jaxevent.reconstruction.compensated.trajectories.robust_cost",
    "jaxevent.reconstruction.compensated.trajectories.nodes": "jaxevent.reconstruction.compensated.trajectories.node_shape",
    "jaxevent.reconstruction.compensated.trajectories.pack": "jaxevent.reconstruction.compensated.trajectories.pack_images",
    "jaxevent.reconstruction.compensated.trajectories.refine": "jaxevent.reconstruction.compensated.trajectories.refine_paths",
    "jaxevent.reconstruction.compensated.trajectories.resize": "jaxevent.reconstruction.compensated.warp.resize_nodes",
    "jaxevent.reconstruction.compensated.trajectories.spread": "jaxevent.reconstruction.compensated.warp.interpolate_paths",
    "jaxevent.reconstruction.compensated.trajectories.stages": "jaxevent.reconstruction.compensated.trajectories.plan_stages",
    "jaxevent.reconstruction.compensated.trajectories.step": "jaxevent.reconstruction.compensated.trajectories.gauss_newton_step",
    "jaxevent.reconstruction.compensated.trajectories.weigh": "jaxevent.reconstruction.compensated.normal_equations.fill_information",
    "jaxevent.reconstruction.engine.images.FusedImages": "jaxevent.reconstruction.engine.images.KernelImages",
    "jaxevent.reconstruction.engine.images.FusedVideo": "jaxevent.reconstruction.engine.images.FilterVideo",
    "jaxevent.reconstruction.engine.images.SmoothedVideo": "jaxevent.reconstruction.engine.images.SmootherVideo",
    "jaxevent.tuning.Believed": "jaxevent.tuning.LossWithPrior",
    "jaxevent.tuning.Fitted": "jaxevent.tuning.FitResult",
    "jaxevent.tuning.Weighted": "jaxevent.tuning.WeightedBatch",
    "jaxevent.tuning.loss_of": "jaxevent.tuning.evaluate_loss",
    "jaxevent.tuning.slopes": "jaxevent.tuning.loss_and_grad",
}
# Modules that have another name or are part of another one.
MOVED_MODULES: dict[str, str] = {
    "jaxevent.reconstruction.compensated.agreement": "jaxevent.reconstruction.compensated.robust_mean",
    "jaxevent.reconstruction.compensated.borders": "jaxevent.reconstruction.compensated.trajectories",
    "jaxevent.reconstruction.compensated.implicit": "jaxevent.reconstruction.compensated.normal_equations",
    "jaxevent.reconstruction.compensated.parameters": "jaxevent.reconstruction.compensated.params",
    "jaxevent.reconstruction.fused": "jaxevent.reconstruction.engine",
    "jaxevent.reconstruction.fused.images": "jaxevent.reconstruction.engine.images",
    "jaxevent.reconstruction.fused.video": "jaxevent.reconstruction.engine.images",
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
        vars(module)["__getattr__"] = lambda name: getattr(importlib.import_module(new), name)
        return module

    def exec_module(self, module: types.ModuleType) -> None:
        """Do nothing: names are read when they are used."""


def install() -> None:
    """Let imports find modules by their old names."""
    if not any(isinstance(finder, RenamedModules) for finder in sys.meta_path):
        sys.meta_path.append(RenamedModules())
