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
    "jaxevent.arrays.LUMA": "jaxevent.arrays.LUMA_WEIGHTS",
    "jaxevent.arrays.MAX_PIXELS": "jaxevent.arrays.MAX_SIDE_PX",
    "jaxevent.arrays.NAMES": "jaxevent.arrays.FIELD_ALIASES",
    "jaxevent.arrays.SCALES": "jaxevent.arrays.US_PER_UNIT",
    "jaxevent.arrays.brief": "jaxevent.arrays.shorten_value",
    "jaxevent.arrays.find": "jaxevent.arrays.find_fields",
    "jaxevent.arrays.grey_of": "jaxevent.arrays.to_grey",
    "jaxevent.blob.Found": "jaxevent.blob.TargetSearchResult",
    "jaxevent.blob.filter.Batch": "jaxevent.blob.filter.EventBatch",
    "jaxevent.blob.filter.Expected": "jaxevent.blob.filter.PredictedMeasurement",
    "jaxevent.blob.filter.choose": "jaxevent.blob.filter.where_tree",
    "jaxevent.blob.losses.Positions": "jaxevent.blob.losses.PositionBatch",
    "jaxevent.blob.tracks.Events": "jaxevent.blob.tracks.AssociatedEvents",
    "jaxevent.confidence.Finding": "jaxevent.confidence.ParameterInterval",
    "jaxevent.confidence.Findings": "jaxevent.confidence.FitIntervals",
    "jaxevent.confidence.Parted": "jaxevent.confidence.PartwiseLoss",
    "jaxevent.confidence.examine": "jaxevent.confidence.confidence_intervals",
    "jaxevent.devices.AXIS": "jaxevent.devices.DEVICE_AXIS",
    "jaxevent.devices.ELSEWHERE": "jaxevent.devices.REMOTE_BATCH",
    "jaxevent.devices.Elsewhere": "jaxevent.devices.RemoteBatch",
    "jaxevent.devices.accelerated": "jaxevent.devices.has_accelerator",
    "jaxevent.devices.along": "jaxevent.devices.shard",
    "jaxevent.devices.local": "jaxevent.devices.local_devices",
    "jaxevent.devices.mesh": "jaxevent.devices.make_mesh",
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
    "jaxevent.egomotion.model_selection.Choice": "jaxevent.egomotion.model_selection.ModelSelection",
    "jaxevent.egomotion.model_selection.choose": "jaxevent.egomotion.model_selection.select_model",
    "jaxevent.egomotion.model_selection.decide": "jaxevent.egomotion.model_selection.select_by_z",
    "jaxevent.egomotion.motion.Calibration": "jaxevent.egomotion.motion.CovarianceCalibration",
    "jaxevent.egomotion.motion.Motion": "jaxevent.egomotion.motion.MotionEstimate",
    "jaxevent.egomotion.motion.decided": "jaxevent.egomotion.motion.is_observable",
    "jaxevent.egomotion.motion.left_by_lens": "jaxevent.egomotion.motion.lens_error",
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
    "jaxevent.egomotion.truth.known": "jaxevent.egomotion.truth.known_motion",
    "jaxevent.egomotion.truth.motion_of": "jaxevent.egomotion.truth.motion_from_table",
    "jaxevent.egomotion.truth.nearest_axes": "jaxevent.egomotion.truth.find_imu_axes",
    "jaxevent.egomotion.twists": "jaxevent.egomotion.truth",
    "jaxevent.estimator.CHECKED": "jaxevent.estimator.CHECKED_METHODS",
    "jaxevent.estimator.DEVICES": "jaxevent.estimator.DEVICE_LIST",
    "jaxevent.estimator.Described": "jaxevent.estimator.ShortRepr",
    "jaxevent.estimator.FLAG": "jaxevent.estimator.OPTIONAL_FLAG",
    "jaxevent.estimator.ROWS": "jaxevent.estimator.OPTIONAL_ROWS",
    "jaxevent.estimator.TIME": "jaxevent.estimator.OPTIONAL_TIME",
    "jaxevent.estimator.imported": "jaxevent.estimator.import_object",
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
    "jaxevent.parameters.LARGEST": "jaxevent.parameters.MAX_VALUE",
    "jaxevent.parameters.NO_GRADIENT": "jaxevent.parameters.NO_GRADIENT_REASON",
    "jaxevent.parameters.Share": "jaxevent.parameters.UnitInterval",
    "jaxevent.parameters.nearest": "jaxevent.parameters.suggest_name",
    "jaxevent.parameters.shown": "jaxevent.parameters.format_value",
    "jaxevent.reconstruction.augment.Augmented": "jaxevent.reconstruction.augment.AugmentedFrame",
    "jaxevent.reconstruction.augment.BetweenFrames": "jaxevent.reconstruction.augment.FrameInterpolation",
    "jaxevent.reconstruction.augment.Blended": "jaxevent.reconstruction.augment.LinearBlend",
    "jaxevent.reconstruction.augment.Greys": "jaxevent.reconstruction.augment.GreyFrames",
    "jaxevent.reconstruction.augment.Held": "jaxevent.reconstruction.augment.ZeroOrderHold",
    "jaxevent.reconstruction.augment.Level": "jaxevent.reconstruction.augment.LogIntensityModel",
    "jaxevent.reconstruction.augment.Nothing": "jaxevent.reconstruction.augment.NoFrames",
    "jaxevent.reconstruction.augment.belief": "jaxevent.reconstruction.augment.effective_certainty",
    "jaxevent.reconstruction.augment.believed_rate": "jaxevent.reconstruction.augment.frame_information",
    "jaxevent.reconstruction.augment.bounded_ratio": "jaxevent.reconstruction.augment.bound_ratio",
    "jaxevent.reconstruction.augment.brightness": "jaxevent.reconstruction.augment.integrate_counts",
    "jaxevent.reconstruction.augment.deblurred": "jaxevent.reconstruction.augment.deblur_level",
    "jaxevent.reconstruction.augment.unclipped": "jaxevent.reconstruction.augment.unclipped_weight",
    "jaxevent.reconstruction.colour.PATTERNS": "jaxevent.io.images.BAYER_PATTERNS",
    "jaxevent.reconstruction.colour.REC709": "jaxevent.reconstruction.colour.REC709_LUMINANCE",
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
    "jaxevent.reconstruction.compensated.estimator.schedule_of": "jaxevent.reconstruction.compensated.estimator.make_instant_schedule",
    "jaxevent.reconstruction.compensated.estimator.smoothed_back": "jaxevent.reconstruction.compensated.estimator.add_smooth_part",
    "jaxevent.reconstruction.compensated.fusion.Comparison": "jaxevent.reconstruction.compensated.fusion.FusionFeatures",
    "jaxevent.reconstruction.compensated.fusion.Fused": "jaxevent.reconstruction.compensated.fusion.FusedImage",
    "jaxevent.reconstruction.compensated.fusion.SOURCES": "jaxevent.reconstruction.compensated.fusion.SOURCE_NAMES",
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
    "jaxevent.reconstruction.compensated.normal_equations.imbalance": "jaxevent.reconstruction.compensated.normal_equations.normal_equation_residual",
    "jaxevent.reconstruction.compensated.robust_mean.Agreement": "jaxevent.reconstruction.compensated.robust_mean.RobustMean",
    "jaxevent.reconstruction.compensated.robust_mean.Place": "jaxevent.reconstruction.compensated.robust_mean.InstantLayout",
    "jaxevent.reconstruction.compensated.robust_mean.across": "jaxevent.reconstruction.compensated.robust_mean.blur_along_x",
    "jaxevent.reconstruction.compensated.robust_mean.agree": "jaxevent.reconstruction.compensated.robust_mean.robust_mean",
    "jaxevent.reconstruction.compensated.robust_mean.agree_purely": "jaxevent.reconstruction.compensated.robust_mean.robust_mean_jax",
    "jaxevent.reconstruction.compensated.robust_mean.blur": "jaxevent.reconstruction.compensated.robust_mean.blur_jax",
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
    "jaxevent.reconstruction.compensated.trajectories.Stage": "jaxevent.reconstruction.compensated.trajectories.RefinementStage",
    "jaxevent.reconstruction.compensated.trajectories.advect": "jaxevent.reconstruction.compensated.trajectories.advect_nodes",
    "jaxevent.reconstruction.compensated.trajectories.around": "jaxevent.reconstruction.compensated.warp.bilinear_cell",
    "jaxevent.reconstruction.compensated.trajectories.between": "jaxevent.reconstruction.compensated.warp.interpolate_path",
    "jaxevent.reconstruction.compensated.trajectories.by_clock": "jaxevent.reconstruction.compensated.trajectories.change_clock",
    "jaxevent.reconstruction.compensated.trajectories.choose": "jaxevent.reconstruction.compensated.trajectories.select_paths",
    "jaxevent.reconstruction.compensated.trajectories.follow": "jaxevent.reconstruction.compensated.trajectories.estimate_trajectories",
    "jaxevent.reconstruction.compensated.trajectories.halve": "jaxevent.reconstruction.compensated.trajectories.halve_resolution",
    "jaxevent.reconstruction.compensated.trajectories.locate": "jaxevent.reconstruction.compensated.warp.locate_points",
    "jaxevent.reconstruction.compensated.trajectories.misfit": "jaxevent.reconstruction.compensated.trajectories.robust_cost",
    "jaxevent.reconstruction.compensated.trajectories.nodes": "jaxevent.reconstruction.compensated.trajectories.node_shape",
    "jaxevent.reconstruction.compensated.trajectories.pack": "jaxevent.reconstruction.compensated.trajectories.pack_images",
    "jaxevent.reconstruction.compensated.trajectories.resize": "jaxevent.reconstruction.compensated.warp.resize_nodes",
    "jaxevent.reconstruction.compensated.trajectories.spread": "jaxevent.reconstruction.compensated.warp.interpolate_paths",
    "jaxevent.reconstruction.compensated.trajectories.stages": "jaxevent.reconstruction.compensated.trajectories.plan_stages",
    "jaxevent.reconstruction.compensated.trajectories.step": "jaxevent.reconstruction.compensated.trajectories.gauss_newton_step",
    "jaxevent.reconstruction.compensated.trajectories.weigh": "jaxevent.reconstruction.compensated.normal_equations.fill_information",
    "jaxevent.reconstruction.complementary.Pull": "jaxevent.reconstruction.complementary.ConstantRateModel",
    "jaxevent.reconstruction.complementary.advance": "jaxevent.reconstruction.complementary.predict",
    "jaxevent.reconstruction.complementary.jump": "jaxevent.reconstruction.complementary.event_update",
    "jaxevent.reconstruction.direct.Direct": "jaxevent.reconstruction.direct.DirectFrameModel",
    "jaxevent.reconstruction.direct.advance": "jaxevent.reconstruction.direct.predict",
    "jaxevent.reconstruction.engine.images.FusedImages": "jaxevent.reconstruction.engine.images.KernelImages",
    "jaxevent.reconstruction.engine.images.FusedVideo": "jaxevent.reconstruction.engine.images.FilterVideo",
    "jaxevent.reconstruction.engine.images.SmoothedVideo": "jaxevent.reconstruction.engine.images.SmootherVideo",
    "jaxevent.reconstruction.filtering.Observer": "jaxevent.reconstruction.filtering.FrameModel",
    "jaxevent.reconstruction.filtering.Place": "jaxevent.reconstruction.filtering.LaneBlock",
    "jaxevent.reconstruction.filtering.State": "jaxevent.reconstruction.filtering.PixelState",
    "jaxevent.reconstruction.filtering.Trajectory": "jaxevent.reconstruction.filtering.FilteredTrajectory",
    "jaxevent.reconstruction.filtering.log_intensity": "jaxevent.reconstruction.filtering.readout_log_intensity",
    "jaxevent.reconstruction.filtering.without_variance": "jaxevent.reconstruction.filtering.init_without_variance",
    "jaxevent.reconstruction.kalman.Augmentation": "jaxevent.reconstruction.kalman.AugmentedFrameModel",
    "jaxevent.reconstruction.kalman.advance": "jaxevent.reconstruction.kalman.predict",
    "jaxevent.reconstruction.kalman.initial": "jaxevent.reconstruction.kalman.init",
    "jaxevent.reconstruction.kalman.jump": "jaxevent.reconstruction.kalman.event_update",
    "jaxevent.reconstruction.kalman.noise": "jaxevent.reconstruction.kalman.process_noise",
    "jaxevent.reconstruction.kalman.within": "jaxevent.reconstruction.kalman.refractory_indicator",
    "jaxevent.reconstruction.optical_flow.Flows": "jaxevent.reconstruction.optical_flow.FlowTrajectory",
    "jaxevent.reconstruction.optical_flow.Moments": "jaxevent.reconstruction.optical_flow.ImageTimes",
    "jaxevent.reconstruction.optical_flow.Pair": "jaxevent.reconstruction.optical_flow.FramePair",
    "jaxevent.reconstruction.optical_flow.make_pair": "jaxevent.reconstruction.optical_flow.make_frame_pair",
    "jaxevent.reconstruction.smoother.Link": "jaxevent.reconstruction.smoother.MessageMap",
    "jaxevent.reconstruction.smoother.Measured": "jaxevent.reconstruction.smoother.FrameMeasurements",
    "jaxevent.reconstruction.smoother.Passage": "jaxevent.reconstruction.smoother.SmoothedWindow",
    "jaxevent.reconstruction.smoother.Rows": "jaxevent.reconstruction.smoother.FrameSteps",
    "jaxevent.reconstruction.smoother.Sided": "jaxevent.reconstruction.smoother.CensoredPixels",
    "jaxevent.reconstruction.smoother.compose_links": "jaxevent.reconstruction.smoother.compose_message_maps",
    "jaxevent.reconstruction.smoother.counts_around": "jaxevent.reconstruction.smoother.adjacent_counts",
    "jaxevent.reconstruction.smoother.information": "jaxevent.reconstruction.smoother.state_to_message",
    "jaxevent.reconstruction.smoother.initial": "jaxevent.reconstruction.smoother.init",
    "jaxevent.reconstruction.smoother.join": "jaxevent.reconstruction.smoother.combine_messages",
    "jaxevent.reconstruction.smoother.make_rows": "jaxevent.reconstruction.smoother.make_frame_steps",
    "jaxevent.reconstruction.smoother.measure": "jaxevent.reconstruction.smoother.frame_update",
    "jaxevent.reconstruction.smoother.one_pixel": "jaxevent.reconstruction.smoother.single_pixel_frame",
    "jaxevent.reconstruction.smoother.share_events": "jaxevent.reconstruction.smoother.redistribute_counts",
    "jaxevent.reconstruction.smoother.shared": "jaxevent.reconstruction.smoother.redistribute_events",
    "jaxevent.reconstruction.smoother.step_between": "jaxevent.reconstruction.smoother.predict_change",
    "jaxevent.reconstruction.video.Begin": "jaxevent.reconstruction.video.WindowStart",
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
    "jaxevent.simulate.hybrid.response_of": "jaxevent.simulate.hybrid.sensor_response",
    "jaxevent.simulate.motion.Patch": "jaxevent.simulate.motion.FlatPatch",
    "jaxevent.simulate.motion.World": "jaxevent.simulate.motion.BoxWorld",
    "jaxevent.simulate.motion.frame_events": "jaxevent.simulate.motion.simulate_frame_events",
    "jaxevent.simulate.motion.texture_of": "jaxevent.simulate.motion.make_texture",
    "jaxevent.simulate.objects.Objects": "jaxevent.simulate.objects.MovingObjects",
    "jaxevent.simulate.objects.Surface": "jaxevent.simulate.objects.MovingSurface",
    "jaxevent.simulate.scenes.FITTING": "jaxevent.simulate.scenes.FITTING_SCENES",
    "jaxevent.simulate.scenes.SPEEDS": "jaxevent.simulate.scenes.PAN_SPEEDS_PX_S",
    "jaxevent.simulate.scenes.Source": "jaxevent.simulate.scenes.IntensitySource",
    "jaxevent.simulate.scenes.TESTING": "jaxevent.simulate.scenes.TESTING_SCENES",
    "jaxevent.simulate.texture_of": "jaxevent.simulate.make_texture",
    "jaxevent.tuning.ADAM": "jaxevent.tuning.ADAM_TRANSFORM",
    "jaxevent.simulate.video.Clip": "jaxevent.simulate.video.VideoClip",
    "jaxevent.tuning.Believed": "jaxevent.tuning.LossWithPrior",
    "jaxevent.tuning.Fitted": "jaxevent.tuning.FitResult",
    "jaxevent.tuning.Weighted": "jaxevent.tuning.WeightedBatch",
    "jaxevent.tuning.loss_of": "jaxevent.tuning.evaluate_loss",
    "jaxevent.tuning.slopes": "jaxevent.tuning.loss_and_grad",
}
# Modules that have another name or are part of another one.
MOVED_MODULES: dict[str, str] = {
    "jaxevent.blob.association": "jaxevent.blob.filter",
    "jaxevent.blob.filters.ellipse": "jaxevent.blob.filters.motion",
    "jaxevent.blob.states": "jaxevent.blob.track",
    "jaxevent.blob.steps": "jaxevent.blob.filter",
    "jaxevent.blob.tables": "jaxevent.blob.tracks",
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
    "jaxevent.reconstruction.clock": "jaxevent.reconstruction.frames",
    "jaxevent.reconstruction.compensated.agreement": "jaxevent.reconstruction.compensated.robust_mean",
    "jaxevent.reconstruction.compensated.borders": "jaxevent.reconstruction.compensated.trajectories",
    "jaxevent.reconstruction.compensated.implicit": "jaxevent.reconstruction.compensated.normal_equations",
    "jaxevent.reconstruction.compensated.parameters": "jaxevent.reconstruction.compensated.params",
    "jaxevent.reconstruction.fused": "jaxevent.reconstruction.engine",
    "jaxevent.reconstruction.fused.images": "jaxevent.reconstruction.engine.images",
    "jaxevent.reconstruction.fused.video": "jaxevent.reconstruction.engine.images",
    "jaxevent.reconstruction.prepared": "jaxevent.reconstruction.estimator",
    "jaxevent.sharing": "jaxevent.locks",
    "jaxevent.show.motion_pictures": "jaxevent.show.motion_figures",
    "jaxevent.show.notebook": "jaxevent.show.figures",
    "jaxevent.show.report": "jaxevent.show.tables",
    "jaxevent.show.track_pictures": "jaxevent.show.track_figures",
    "jaxevent.show.track_plots": "jaxevent.show.track_figures",
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
