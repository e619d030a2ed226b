"""What bounds `mc`: objects with parts of it replaced by the truth, and pixels that are not alike.

    python experiments/compensated_bounds.py --out bounds

Tables:

    objects     simulated objects, 25 Hz, halfway between frames, of the seeds that
                experiments/motion_compensated.py scores: the motion found, the true one as means
                of 2 x 2 pixels, the true one of pixels, and the true visibility beside it; the
                true one of objects that reach farther than they do, by parts of a pixel; the same
                of a sensor without noise, dead time or mismatch; all errors, as part of those of
                `flow` (pip install '.[vision]'), and what parts of the image add to them: pixels
                that an edge covers in part, others that are hidden in a frame next to the target,
                and the rest by how far away surfaces meet
    pans        fast pans of HDR scenes: MSE of I, and of ln(I + I0) of all, dark, well-exposed and
                bright pixels, of the smoother, of `mc` with the motion found and the true one, of
                the fusion alone, and with the best ingredient at every pixel, or of the pixels
                around it; the same of sensors whose pixels are alike; which part of the dark error
                of a pixel is that of all instants along its true trajectory. With --fitted that of
                the fit of experiments/ahdr.py, as it scores them
    bright      pans of HDR scenes: z2 of bright pixels that were within the range of some frame,
                and of those that never were; needs --fitted
    thresholds  fast pans of HDR scenes by sensors whose pixels' thresholds differ more and more:
                MSE of ln(I + I0) of bright pixels and of all, with and without learning these
    blurred     pans and objects at 300 px/s, exposures of 50 and 100 ms, or those of --speeds and
                --exposures, as experiments/motion_compensated.py scores them, MSE as part of the
                smoother's: the motion found; the true one as parabolas of time, and as it is,
                before and after the image is held to the exposures; the mean along the true one;
                the same of a sensor without noise, dead time or mismatch, and of frames that are
                sharp; which part of the smoother's error is that of all instants along the true
                trajectories; how far points move to the frames next to them, and by how much the
                motion found misses (px, medians): by `mc`, by images between the frames alone, and
                by these without their mean over time, of which events tell all

Recordings are simulated into the folder. Sensors' common thresholds are given, nothing is fitted
but with --fitted.
"""

import argparse
import dataclasses
import functools
import itertools
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import ahdr
import jax.numpy as jnp
import numpy as np
from motion_compensated import (
    SCORING,
    at_and_between,
    blurred,
    halfway,
    objects_at,
    recorded,
    sensor,
)
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, map_coordinates, uniform_filter

import jaxevent
from jaxevent.reconstruction.compensated import fusion, trajectories
from jaxevent.reconstruction.compensated.estimator import (
    PYRAMID_VARIANCE_FACTOR,
    CompensatedVideo,
    TrajectoryEstimate,
    fuse_target,
    make_layout,
)
from jaxevent.reconstruction.compensated.exposures import (
    AdjacentFrames,
    ExposureModel,
    constrain_image,
)
from jaxevent.reconstruction.compensated.images import InstantImages
from jaxevent.reconstruction.compensated.normal_equations import CostParams
from jaxevent.reconstruction.compensated.robust_mean import robust_mean
from jaxevent.reconstruction.compensated.warp import (
    WarpedImages,
    displacements,
    interpolate_paths,
    warp,
)
from jaxevent.reconstruction.frames import FrameImages
from jaxevent.reconstruction.windows import WINDOW_EVENTS
from jaxevent.simulate import TESTING, Objects, Pan, Sensor, scene, simulate

RATE, IMAGES = 25.0, 6  # Hz; images per recording
EDGES = (2.0, 4.0)  # px from where surfaces meet
GROWN = (0.25, 0.5)  # px
MISMATCH, SEEDS = (0.03, 0.1, 0.15), (2, 3)
FAULTLESS: dict[str, Any] = dict(
    mismatch=0, refractory=0, background_rate=0, hot_fraction=0, read_noise=0
)
LONG, FAST = (50.0, 100.0), (300.0,)  # ms; px/s
BLUR_SENSORS: dict[str, dict[str, Any]] = {
    "": {}, "_faultless": FAULTLESS, "_sharp": {"exposure": 5e-4},
}  # by label  # fmt: skip
POOLED = {"": 1, " of 5 x 5 pixels": 5, " of 9 x 9 pixels": 9}  # px, by label
SENSORS: dict[str, dict[str, Any]] = {"": {}, ", pixels alike": {"mismatch": 0}}  # by label
mc = jaxevent.METHODS["mc"]


def truly_along(
    target: TrajectoryEstimate, source: Objects, t: int, grown: float = 0.0
) -> tuple[WarpedImages, NDArray[np.bool_]]:
    """A target's images along the true trajectories, and where the points are hidden.

    The trajectories of pixels within `grown` (px) of an object are that object's.
    """
    instants, L, V, clear, *_ = target
    count, h, w = L.shape
    y, x = np.mgrid[:h, :w].astype(float)
    warped, hidden = np.zeros((4, count, h, w), np.float32), np.zeros((count, h, w), bool)
    whose = np.zeros((h, w), int)
    for k, surface in enumerate(source.surfaces):
        if surface.distance is not None:
            px, py = surface.place(t * 1e-6)
            whose[surface.distance(x - px, y - py, surface.radius) < grown] = k
    for k, at in enumerate(instants.t):
        _, hidden[k] = source.displacement(t * 1e-6, float(at) * 1e-6)
        gone = [one.place(float(at) * 1e-6) - one.place(t * 1e-6) for one in source.surfaces]
        moved = np.array(gone)[whose]
        Y, X = y + moved[..., 1], x + moved[..., 0]
        for n, (image, order) in enumerate(((L[k], 3), (V[k], 1), (clear[k] * 1.0, 1))):
            warped[n, k] = map_coordinates(image, [Y, X], order=order, mode="nearest")
        warped[3, k] = (-0.5 <= X) & (w - 0.5 >= X) & (-0.5 <= Y) & (h - 0.5 >= Y)
    return WarpedImages(*warped), hidden


def by_nodes(target: TrajectoryEstimate, source: Objects, t: int) -> NDArray[np.float32]:
    """The paths of pixels where the true motion is the mean of 2 x 2 pixels at each node."""
    s = target.instants.s.astype(float)
    moved = np.stack(
        [source.displacement(t * 1e-6, float(at) * 1e-6)[0] for at in target.instants.t]
    )
    count, h, w, _ = moved.shape
    v, a = np.linalg.lstsq(np.stack([s, s**2], 1), moved.reshape(count, -1), rcond=None)[0]
    paths = np.concatenate([v.reshape(h, w, 2), a.reshape(h, w, 2)], -1)
    nodes = paths.reshape(h // 2, 2, w // 2, 2, 4).mean((1, 3)).astype(np.float32)
    return interpolate_paths(nodes, (h, w))


def regions(source: Objects, t: int, frames: NDArray[np.int64]) -> dict[str, NDArray[np.bool_]]:
    """Parts of the image at a time (us) that errors are told of; `frames` are times next to it."""
    seen, (h, w) = source.visible(t * 1e-6), source.size[::-1]
    y, x = np.mgrid[:h, :w].astype(float)
    partly = np.zeros((h, w), bool)
    for surface in source.surfaces:
        if surface.distance is not None:
            px, py = surface.place(t * 1e-6)
            distance = surface.distance(x - px, y - py, surface.radius)
            partly = (partly & (distance > -0.5)) | (abs(distance) < 0.5)
    hidden = np.zeros((h, w), bool)
    for frame in frames.tolist():
        hidden |= source.displacement(t * 1e-6, frame * 1e-6)[1]
    meet = np.zeros((h, w), bool)
    meet[:, 1:] |= seen[:, 1:] != seen[:, :-1]
    meet[1:] |= seen[1:] != seen[:-1]
    away, (near, far) = np.asarray(distance_transform_edt(~meet)), EDGES
    rest = ~partly & ~hidden
    return {
        "covered in part": partly,
        "hidden at a frame": hidden & ~partly,
        f"within {near:g} px": rest & (away < near),
        f"{near:g} to {far:g} px": rest & (away >= near) & (away < far),
        "farther": rest & (away >= far),
    }


def along_paths(target: TrajectoryEstimate, paths: NDArray[np.float32]) -> WarpedImages:
    """A target's images along paths (h, w, 4)."""
    clear = np.asarray(target.clear, np.float32)
    return warp(target.L, target.V, clear, target.instants.s, paths)


def fused_along(
    params: Any, target: TrajectoryEstimate, along: WarpedImages
) -> tuple[fusion.FusedImage, NDArray]:
    """What is made of a target's images along trajectories, and the ingredients (3, h, w)."""
    layout = make_layout(target.instants, target.clear, len(target.instants))
    given = fusion.fusion_features(
        robust_mean(params, target.L, along, layout),
        fusion.reference_images(target.L, target.V, along, layout),
    )
    return fusion.fuse_candidates(params, given), np.asarray(given.candidates)


def object_images(
    video: CompensatedVideo, source: Objects, t: int, all_cases: bool
) -> dict[str, NDArray[np.floating]]:
    """Log intensities of the smoother and of `mc` with parts of it replaced by the truth."""
    target = video.trajectories(t)
    true, hidden = truly_along(target, source, t)
    cases = {"`mc`, motion found": along_paths(target, target.paths)}
    if all_cases:
        cases["true motion, by nodes"] = along_paths(target, by_nodes(target, source, t))
        cases["true motion"] = true
    cases["true motion and visibility"] = true._replace(inside=true.inside * ~hidden)
    for grown in GROWN if all_cases else ():
        along, _ = truly_along(target, source, t, grown)
        cases[f"true motion, objects {grown:g} px larger"] = along
    images = {"smoother": target.L[target.instants.target]}
    for name, along in cases.items():
        images[name] = np.asarray(fused_along(video.params, target, along)[0].L)
    return images


def objects(folder: Path) -> Iterator[str]:
    """The table, line by line: of each region how much of the mean over the image it adds."""
    params = mc.Params(c_on=0.2, c_off=0.18, I0=0.1, rho_ref=5e-4)
    found: dict[str, list] = {}
    shares, where = [], {}
    for seed in SCORING:
        source, recording = objects_at(folder, RATE, seed)
        file = folder / "recordings" / f"objects_faultless_{seed}.h5"
        faultless = recorded(file, source, dataclasses.replace(sensor(RATE), **FAULTLESS), seed)
        video = mc.estimate(recording, params, progress=False)
        other = mc.estimate(faultless, params.replace(rho_ref=0.0), progress=False)
        times = halfway(recording, IMAGES)
        flow = jaxevent.METHODS["flow"].estimate(recording, progress=False)(times).mean
        for t, frames_alone in zip(times.tolist(), flow, strict=True):
            truth = source.intensity(t * 1e-6).clip(0, 1)
            images = object_images(video, source, t, True)
            for name, image in object_images(other, source, t, False).items():
                images[f"{name}, faultless sensor"] = image
            instants = video.trajectories(t).instants
            where = regions(source, t, instants.t[[instants.before, instants.after]])
            images = {n: np.exp(image) - float(params.I0) for n, image in images.items()}
            for name, image in {"`flow`": frames_alone, **images}.items():
                error = (image.clip(0, 1) - truth) ** 2
                parts = [(error * part).mean() for part in where.values()]
                found.setdefault(name, []).append([error.mean(), *parts])
            shares.append([part.mean() for part in where.values()])
    yield "| MSE x 1e-2 | of `flow` | all | " + " | ".join(where) + " |"
    yield "|---|---:|---:|" + "---:|" * len(where)
    yield "| share of pixels | | | " + " | ".join(f"{v:.0%}" for v in np.mean(shares, 0)) + " |"
    most = np.mean(found["`flow`"], 0)[0]
    for name, rows in found.items():
        cells = np.mean(rows, 0)
        text = " | ".join(f"{100 * v:.4f}" for v in cells)
        yield f"| {name} | {cells[0] / most:.2f} | {text} |"


def truly_moved(target: TrajectoryEstimate, source: Pan | Objects, t: int) -> NDArray[np.float64]:
    """How far points go from a target to each of its instants, (K, h, w, 2)."""
    times = [float(at) * 1e-6 for at in target.instants.t]
    if isinstance(source, Pan):
        h, w = target.L.shape[1:]
        y, x = np.mgrid[:h, :w]
        X, Y = panned(source, (h, w), t * 1e-6, times)
        return np.stack([X - x, Y - y], -1)
    return np.array([source.displacement(t * 1e-6, at)[0] for at in times], float)


def as_parabolas(target: TrajectoryEstimate, moved: NDArray[np.float64]) -> NDArray[np.float32]:
    """Paths (h, w, 4) of what `truly_moved` tells; instants near the target decide."""
    s = target.instants.s.astype(float)
    count, h, w, _ = moved.shape
    near = np.exp(-4 * s**2)
    v, a = np.linalg.lstsq(
        near[:, None] * np.stack([s, s**2], 1),
        (near[:, None, None, None] * moved).reshape(count, -1),
        rcond=None,
    )[0]
    return np.concatenate([v.reshape(h, w, 2), a.reshape(h, w, 2)], -1).astype(np.float32)


def ladder(
    video: CompensatedVideo, source: Pan | Objects, t: int, all_cases: bool
) -> tuple[dict[str, NDArray], float]:
    """Log intensities of a target with parts of `mc` replaced by the truth, and `common`."""
    target, params = video.trajectories(t), video.params
    paths = as_parabolas(target, truly_moved(target, source, t))
    hidden: NDArray[np.bool_] = np.zeros(target.L.shape, bool)
    if isinstance(source, Pan):
        true = truly_panned(target, source, t)
    else:
        true, hidden = truly_along(target, source, t)
    by_parabolas, _ = fused_along(params, target, along_paths(target, paths))
    exactly, ingredients = fused_along(params, target, true)
    own = target.instants.target
    base = np.float32(0) if target.smooth is None else target.smooth[own]
    images = {
        "smoother": target.L[own],
        "`mc`": np.log(video(np.array([t])).mean[0] + params.I0) - base,
        "motion found, not held": fuse_target(params, target).L,
        "true motion as parabolas": held(video, target, by_parabolas, paths, t),
        "true motion, not held": exactly.L,
        "true motion": held(video, target, exactly, paths, t),
        "mean along true motion, not held": ingredients[0],
    }
    chosen = images if all_cases else ("`mc`", "true motion")
    wrong = true.L - np.log(source.intensity(t * 1e-6).clip(0, 1) + params.I0)
    wrong = np.where((true.inside > 0) & ~hidden, wrong, np.nan)
    shown = {name: np.asarray(images[name]) + base for name in chosen}
    return shown, float(np.nanmean(np.nanmean(wrong, 0) ** 2) / np.nanmean(wrong**2))


def held(
    video: CompensatedVideo,
    target: TrajectoryEstimate,
    fused: fusion.FusedImage,
    paths: NDArray[np.float32],
    t: int,
) -> NDArray:
    """What is fused, held to the exposures along paths (h, w, 4) where frames are steady."""
    exposures = video.trajectories.exposures
    if exposures.samples is None or target.smooth is not None:
        return np.asarray(fused.L)
    adjacent = exposures(t, target.instants)
    frames = FrameImages(video.recording, np.dtype(np.float32))
    low, high = int(adjacent.frame.min()), int(adjacent.frame.max()) + 1
    grey, intensity, _, gain = frames.read(slice(low, high), high - low)
    rows = adjacent.frame - low
    images = AdjacentFrames(grey[rows], intensity[rows], frames.response(), gain[rows])
    model = ExposureModel(adjacent, images, paths)
    return np.asarray(constrain_image(video.params, fused, model, exposures.samples).L)


def misses(
    video: CompensatedVideo, source: Pan | Objects, t: int
) -> tuple[float, float, float, float]:
    """How far points go to the frames next to a target, and end-point errors there; medians, px.

    Of `mc`; of images between the frames alone; of these without their mean over time.
    """
    target, p = video.trajectories(t), video.params
    instants, L, V, *_ = target
    order = np.arange(len(instants))
    beside = [instants.before, instants.after]
    inner = (order > instants.before) & (order < instants.after)
    moved = truly_moved(target, source, t)[beside]
    s = instants.s[inner]

    def found(images: NDArray) -> NDArray:
        variance = float(p.caution) * V[inner]
        pyramid = trajectories.ImagePyramid(images, variance, PYRAMID_VARIANCE_FACTOR)
        plan = trajectories.plan_stages(s, instants.first_horizon)
        motion = trajectories.estimate_trajectories(pyramid, s, plan, CostParams.of(p))
        return interpolate_paths(motion.at_level(0, L.shape[1:]).p, L.shape[1:])

    seen = L[inner]
    each = (target.paths, found(seen), found(seen - seen.mean(0)))
    at = jnp.asarray(instants.s[beside])
    ends = [moved - np.asarray(displacements(jnp.asarray(path), at)) for path in each]
    medians = [float(np.median(np.linalg.norm(one, axis=-1))) for one in (moved, *ends)]
    return medians[0], medians[1], medians[2], medians[3]


def blurs(
    folder: Path, exposures: tuple[float, ...] = LONG, speeds: tuple[float, ...] = FAST
) -> Iterator[str]:
    """The table, line by line: steps of the ladder, and a column for each recording.

    Exposures are in ms, speeds in px/s.
    """
    chosen = tuple(1e-3 * exposure for exposure in exposures), speeds
    cells: dict[str, dict[str, float]] = {}
    common, ends = {}, {}
    for label, other in BLUR_SENSORS.items():
        for cell, source, recording in blurred(folder, chosen, label, **other):
            assert isinstance(source, Pan | Objects)
            params = mc.Params(c_on=0.2, c_off=0.18, I0=0.1, rho_ref=5e-4)
            params = params.replace(rho_ref=0.0) if "refractory" in other else params
            video = mc.estimate(recording, params, progress=False)
            times = at_and_between(recording)[0].tolist()
            errors: dict[str, list[float]] = {}
            shares = []
            for t in times:
                truth = source.intensity(t * 1e-6).clip(0, 1)
                images, share = ladder(video, source, t, not label)
                shares.append(share)
                for name, image in images.items():
                    shown = (np.exp(image) - float(params.I0)).clip(0, 1)
                    errors.setdefault(name + label.replace("_", ", "), []).append(
                        ((shown - truth) ** 2).mean()
                    )
            head = f"{cell['scene']}, {cell['exposure_ms']:g} ms, {cell['speed']:g} px/s"
            found = {name: float(np.mean(values)) for name, values in errors.items()}
            cells.setdefault(head, {}).update(found)
            if not label:
                common[head] = np.mean(shares)
                between = halfway(recording, 3).tolist()
                ends[head] = np.mean([misses(video, source, t) for t in between], 0)
    yield "| | " + " | ".join(cells) + " |"
    yield "|---|" + "---:|" * len(cells)

    def line(name: str, values: Iterable[float], digits: int = 2) -> str:
        return f"| {name} | " + " | ".join(f"{v:.{digits}f}" for v in values) + " |"

    yield line("smoother x 1e-2", (100 * c["smoother"] for c in cells.values()), 4)
    for name in list(next(iter(cells.values())))[1:]:
        yield line(name, (c[name] / c["smoother"] for c in cells.values()))
    yield line("common", common.values())
    yield line("px to the frames next to it", (v[0] for v in ends.values()), 1)
    for k, name in enumerate(
        ("`mc`", "images between the frames", "the same without their mean"), 1
    ):
        yield line(f"ends beside, {name}", (v[k] for v in ends.values()))


def panned(
    source: Pan, size: tuple[int, int], t: float, times: list[float]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Where the points of a pan's pixels at t (s) are at others: x and y, (K, h, w)."""
    h, w = size
    at = np.mgrid[:h, :w].astype(float) - np.array([(h - 1) / 2, (w - 1) / 2])[:, None, None]

    def turn(roll: float, x: NDArray, y: NDArray) -> tuple[NDArray, NDArray]:
        cos, sin = np.cos(roll), np.sin(roll)
        return cos * x - sin * y, sin * x + cos * y

    (x, y), roll, zoom = source.pose(t)
    right, down = turn(roll, zoom * at[1], zoom * at[0])
    found = []
    for moment in times:
        (x1, y1), roll, zoom = source.pose(moment)
        X, Y = turn(-roll, right + x - x1, down + y - y1)
        found.append((X / zoom + (w - 1) / 2, Y / zoom + (h - 1) / 2))
    X, Y = (np.stack(part) for part in zip(*found, strict=True))
    return X, Y


def truly_panned(target: TrajectoryEstimate, source: Pan, t: int) -> WarpedImages:
    """A target's images along the true trajectories of a pan."""
    instants, L, V, clear, *_ = target
    h, w = L.shape[1:]
    warped = np.zeros((4, *L.shape), np.float32)
    places = panned(source, (h, w), t * 1e-6, [float(at) * 1e-6 for at in instants.t])
    for k, (X, Y) in enumerate(zip(*places, strict=True)):
        for n, (image, order) in enumerate(((L[k], 3), (V[k], 1), (clear[k] * 1.0, 1))):
            warped[n, k] = map_coordinates(image, [Y, X], order=order, mode="nearest")
        warped[3, k] = (-0.5 <= X) & (w - 0.5 >= X) & (-0.5 <= Y) & (h - 0.5 >= Y)
    return WarpedImages(*warped)


def pan_images(
    video: CompensatedVideo, source: Pan, t: int, level: NDArray
) -> tuple[dict[str, NDArray[np.floating]], WarpedImages]:
    """Log intensities of the smoother, of `mc`, and of the best ingredients; the true paths."""
    target = video.trajectories(t)
    true = truly_panned(target, source, t)
    images = {"smoother": target.L[target.instants.target]}
    found = along_paths(target, target.paths)
    for motion, along in {"found": found, "true": true}.items():
        fused, ingredients = fused_along(video.params, target, along)
        images[f"`mc`, {motion} motion"] = np.asarray(fused.L)
        images[f"fusion alone, {motion} motion"] = ingredients[0]
        squares = (ingredients - level) ** 2
        for label, size in POOLED.items():
            best = np.stack([uniform_filter(square, size) for square in squares]).argmin(0)[None]
            chosen = np.take_along_axis(ingredients, best, 0)[0]
            images[f"best ingredient{label}, {motion} motion"] = chosen
    return images, true


def fitted_params(fitted: Path | None) -> Any:
    """Those of experiments/ahdr.py, or the sensor's thresholds."""
    if fitted is None:
        return mc.Params(preset="hdr", c_on=0.2, c_off=0.18, rho_ref=5e-4)
    [(_, _, params)] = ahdr.choose(["mc"], fitted)
    return params


def pans(folder: Path, fitted: Path | None = None) -> Iterator[str]:
    """The table, line by line: geometric means over recordings."""
    params = fitted_params(fitted)
    found: dict[str, list] = {}
    common = []
    for (kind, faults), name in itertools.product(SENSORS.items(), TESTING):
        source = Pan(scene(name), speed="fast", duration=0.5, seed=SEEDS[0])
        recording = simulate(source, dataclasses.replace(Sensor(), **faults), SEEDS[0], name)
        video = mc.estimate(recording, params, progress=False)
        times, truths = recording.extra["hdr_t"], recording.extra["hdr"]
        errors: dict[str, list] = {}
        for row in np.unique(np.linspace(2, len(times) - 3, 4).round().astype(int)):
            truth, t = np.asarray(truths[row]), int(times[row])
            level = np.log(truth + params.I0)
            low, high = recording.extra.get("clip", (0.01, 1.0))
            dark, bright = truth < low, truth > high
            regions = (np.ones_like(dark), dark, ~dark & ~bright, bright)
            images, true = pan_images(video, source, t, level)
            for label, image in images.items():
                linear = ((np.exp(image) - params.I0 - truth) ** 2).mean()
                squares = [((image - level) ** 2)[r].mean() for r in regions]
                errors.setdefault(label + kind, []).append([linear, *squares])
            inside = np.where(true.inside > 0, true.L - level, np.nan)[:, dark]
            if not kind:
                common.append(np.nanmean(np.nanmean(inside, 0) ** 2) / np.nanmean(inside**2))
        for label, values in errors.items():
            found.setdefault(label, []).append(np.nanmean(values, 0))
    yield "| | MSE | log MSE | dark | well-exposed | bright |"
    yield "|---|" + "---:|" * 5
    means = {n: np.exp(np.nanmean(np.log(v), 0)) for n, v in found.items()}
    for label, mean in means.items():
        parts = mean / means["smoother"]
        cells = " | ".join(f"{v:.3g} ({p:.2f})" for v, p in zip(mean, parts, strict=True))
        yield f"| {label} | {cells} |"
    yield f"\nOf the dark error {100 * np.mean(common):.0f} % is common to all instants."


def brights(folder: Path, fitted: Path | None = None) -> Iterator[str]:
    """The table, line by line."""
    params = fitted_params(fitted)
    yield "| scene | bright pixels that never were in range | z2 of others | z2 of these |"
    yield "|---|---:|---:|---:|"
    paths = ahdr.record(folder / "test", TESTING, range(SEEDS[0], SEEDS[0] + 1), "davis")
    for path in sorted(paths):
        recording = jaxevent.load(path)
        assert recording.frames is not None
        times, truths = recording.extra["hdr_t"], recording.extra["hdr"]
        _, high = recording.extra.get("clip", (0.01, 1.0))
        _, _, clear = InstantImages(recording, params, WINDOW_EVENTS)(recording.frames.t)
        never = ~(clear > 0).any(0)
        rows = np.unique(np.linspace(2, len(times) - 3, 4).round().astype(int))
        image, P, _ = mc.estimate(recording, params, progress=False)(times[rows])
        I0, truth = float(params.I0), np.asarray(truths[rows])
        squares = np.log((np.maximum(image, 0) + I0) / (truth + I0)) ** 2 / P
        bright = truth > high
        parts = [squares[bright & seen].mean() for seen in (~never, never)]
        share = (bright & never).sum() / bright.sum()
        name = path.stem.rpartition("_")[0].replace("_", ", ")
        yield f"| {name} | {share:.0%} | {parts[0]:.2g} | {parts[1]:.2g} |"


def thresholds(folder: Path) -> Iterator[str]:
    """The table, line by line: geometric means over recordings."""
    yield "| mismatch | alike: bright, all | learned: bright, all | learned in |"
    yield "|---|---:|---:|---:|"
    for mismatch in MISMATCH:
        errors: dict[bool, list] = {False: [], True: []}
        counts = []
        for name in TESTING:
            for seed in SEEDS:
                sensor = dataclasses.replace(Sensor(), mismatch=mismatch)
                source = Pan(scene(name), speed="fast", duration=0.5, seed=seed)
                recording = simulate(source, sensor, seed, name)
                times, truths = recording.extra["hdr_t"], recording.extra["hdr"]
                rows = np.unique(np.linspace(2, len(times) - 3, 4).round().astype(int))
                for learn in errors:
                    params = mc.Params(
                        preset="hdr", c_on=0.2, c_off=0.18, rho_ref=5e-4, learn=learn
                    )
                    video = mc.estimate(recording, params, progress=False)
                    image, truth, I0 = video(times[rows]).mean, truths[rows], float(params.I0)
                    square = (np.log(np.maximum(image, 0) + I0) - np.log(truth + I0)) ** 2
                    bright = square[truth > 1].mean() if (truth > 1).any() else np.nan
                    errors[learn].append((bright, square.mean()))
                    if learn:
                        counts.append(video.trajectories.images.factors is not None)
        cells = [np.exp(np.nanmean(np.log(errors[learn]), 0)) for learn in (False, True)]
        text = " | ".join(", ".join(f"{v:.4f}" for v in cell) for cell in cells)
        yield f"| {mismatch:g} | {text} | {sum(counts)} of {len(counts)} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    tables = {
        "objects": objects, "pans": pans, "bright": brights, "thresholds": thresholds,
        "blurred": blurs,
    }  # fmt: skip
    parser.add_argument("--tables", nargs="+", default=list(tables), choices=tables)
    parser.add_argument("--out", type=Path, required=True, help="folder for everything made")
    parser.add_argument("--fitted", type=Path, help="params.toml of experiments/ahdr.py, for HDR")
    parser.add_argument("--exposures", type=float, nargs="+", default=LONG, help="of blurred, ms")
    parser.add_argument("--speeds", type=float, nargs="+", default=FAST, help="of blurred, px/s")
    arguments = parser.parse_args()
    tables["blurred"] = functools.partial(
        blurs, exposures=tuple(arguments.exposures), speeds=tuple(arguments.speeds)
    )
    for name in ("pans", "bright"):
        tables[name] = functools.partial(tables[name], fitted=arguments.fitted)
    out = arguments.out.absolute()
    out.mkdir(parents=True, exist_ok=True)
    for name in arguments.tables:
        lines = []
        for line in tables[name](out):
            lines.append(line)
            print(line, flush=True)
        (out / f"{name}.md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
