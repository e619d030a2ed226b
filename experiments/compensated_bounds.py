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
                the fusion alone, and with the best ingredient at every pixel; the same of sensors
                whose pixels are alike; which part of the dark error of a pixel is that of all
                instants along its true trajectory. With --fitted that of the fit of
                experiments/ahdr.py, as it scores them
    bright      pans of HDR scenes: z2 of bright pixels that were within the range of some frame,
                and of those that never were; needs --fitted
    thresholds  fast pans of HDR scenes by sensors whose pixels' thresholds differ more and more:
                MSE of ln(I + I0) of bright pixels and of all, with and without learning these
    blurred     pans and objects at 300 px/s, exposures of 50 and 100 ms, as
                experiments/motion_compensated.py scores them: the motion found, the true one and
                the mean along it alone, as parts of the smoother's MSE; which part of the
                smoother's error is that of all instants along the true trajectories

Recordings are simulated into the folder. Sensors' common thresholds are given, nothing is fitted
but with --fitted.
"""

import argparse
import dataclasses
import functools
import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import ahdr
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
from scipy.ndimage import distance_transform_edt, map_coordinates

import jaxevent
from jaxevent.reconstruction.compensated import estimator, fusion, trajectories
from jaxevent.reconstruction.compensated.agreement import agree
from jaxevent.reconstruction.compensated.estimator import CompensatedVideo, Followed, place_of
from jaxevent.reconstruction.compensated.warping import Along, warp
from jaxevent.reconstruction.windows import WINDOW_EVENTS
from jaxevent.simulate import TESTING, Objects, Pan, Sensor, scene, simulate

RATE, IMAGES = 25.0, 6  # Hz; images per recording
EDGES = (2.0, 4.0)  # px from where surfaces meet
GROWN = (0.25, 0.5)  # px
MISMATCH, SEEDS = (0.03, 0.1, 0.15), (2, 3)
FAULTLESS: dict[str, Any] = dict(
    mismatch=0, refractory=0, background_rate=0, hot_fraction=0, read_noise=0
)
SENSORS: dict[str, dict[str, Any]] = {"": {}, ", pixels alike": {"mismatch": 0}}  # by label
mc = jaxevent.METHODS["mc"]


def truly_along(
    target: Followed, source: Objects, t: int, grown: float = 0.0
) -> tuple[Along, NDArray[np.bool_]]:
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
    return Along(*warped), hidden


def by_nodes(target: Followed, source: Objects, t: int) -> NDArray[np.float32]:
    """The paths of pixels where the true motion is the mean of 2 x 2 pixels at each node."""
    s = target.instants.s.astype(float)
    moved = np.stack(
        [source.displacement(t * 1e-6, float(at) * 1e-6)[0] for at in target.instants.t]
    )
    count, h, w, _ = moved.shape
    v, a = np.linalg.lstsq(np.stack([s, s**2], 1), moved.reshape(count, -1), rcond=None)[0]
    paths = np.concatenate([v.reshape(h, w, 2), a.reshape(h, w, 2)], -1)
    nodes = paths.reshape(h // 2, 2, w // 2, 2, 4).mean((1, 3)).astype(np.float32)
    return trajectories.spread(nodes, (h, w))


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


def object_images(
    video: CompensatedVideo, source: Objects, t: int, all_cases: bool
) -> dict[str, NDArray[np.floating]]:
    """Log intensities of the smoother and of `mc` with parts of it replaced by the truth."""
    target = video.follow(t)
    instants, L, V, clear, *_ = target
    place = place_of(instants, clear, len(instants))
    shown = L, V, np.asarray(clear, np.float32), instants.s
    true, hidden = truly_along(target, source, t)
    cases = {"`mc`, motion found": warp(*shown, target.paths)}
    if all_cases:
        cases["true motion, by nodes"] = warp(*shown, by_nodes(target, source, t))
        cases["true motion"] = true
    cases["true motion and visibility"] = true._replace(inside=true.inside * ~hidden)
    for grown in GROWN if all_cases else ():
        along, _ = truly_along(target, source, t, grown)
        cases[f"true motion, objects {grown:g} px larger"] = along
    images = {"smoother": L[instants.own]}
    for name, along in cases.items():
        told = fusion.compare(
            agree(video.params, L, along, place), fusion.views(L, V, along, place)
        )
        images[name] = np.asarray(fusion.decide(video.params, told).L)
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
            instants = video.follow(t).instants
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


def blurs(folder: Path) -> Iterator[str]:
    """The table, line by line."""
    params = mc.Params(c_on=0.2, c_off=0.18, I0=0.1, rho_ref=5e-4)
    names = ("`mc`", "motion found, not held", "true motion, not held", "mean along true motion")
    yield "| scene, exposure | smoother | " + " | ".join((*names, "common")) + " |"
    yield "|---|---:|" + "---:|" * (len(names) + 1)
    for cell, source, recording in blurred(folder):
        if cell["speed"] < 300 or cell["exposure_ms"] < 50:
            continue
        video = mc.estimate(recording, params, progress=False)
        errors: list[list[float]] = []
        for t in at_and_between(recording)[0].tolist():
            truth = source.intensity(t * 1e-6).clip(0, 1)
            target = video.follow(t)
            instants, L, V, clear, *_ = target
            place = place_of(instants, clear, len(instants))
            hidden = np.zeros(L.shape, bool)
            if isinstance(source, Pan):
                true = truly_panned(target, source, t)
            else:
                assert isinstance(source, Objects)
                true, hidden = truly_along(target, source, t)
            found = warp(L, V, np.asarray(clear, np.float32), instants.s, target.paths)
            images = [L[instants.own], np.log(video(np.array([t])).mean[0] + params.I0)]
            for along in (found, true):
                told = fusion.compare(
                    agree(params, L, along, place), fusion.views(L, V, along, place)
                )
                images.append(np.asarray(fusion.decide(params, told).L))
            images.append(np.asarray(told.ingredients[0]))
            shown = [(np.exp(image) - float(params.I0)).clip(0, 1) for image in images]
            wrong = true.L - np.log(truth + params.I0)
            wrong = np.where((true.inside > 0) & ~hidden, wrong, np.nan)
            common = np.nanmean(np.nanmean(wrong, 0) ** 2) / np.nanmean(wrong**2)
            errors.append([*(float(((i - truth) ** 2).mean()) for i in shown), float(common)])
        smoothed, *others, common = np.mean(errors, 0)
        cells = [f"{100 * smoothed:.4f}", *(f"{v / smoothed:.2f}" for v in others), f"{common:.2f}"]
        yield f"| {cell['scene']}, {cell['exposure_ms']:g} ms | " + " | ".join(cells) + " |"


def truly_panned(target: Followed, source: Pan, t: int) -> Along:
    """A target's images along the true trajectories of a pan."""
    instants, L, V, clear, *_ = target
    h, w = L.shape[1:]
    at = np.mgrid[:h, :w].astype(float) - np.array([(h - 1) / 2, (w - 1) / 2])[:, None, None]

    def turn(roll: float, x: NDArray, y: NDArray) -> tuple[NDArray, NDArray]:
        cos, sin = np.cos(roll), np.sin(roll)
        return cos * x - sin * y, sin * x + cos * y

    (x, y), roll, zoom = source.pose(t * 1e-6)
    right, down = turn(roll, zoom * at[1], zoom * at[0])
    warped = np.zeros((4, *L.shape), np.float32)
    for k, moment in enumerate(instants.t):
        (x1, y1), roll, zoom = source.pose(float(moment) * 1e-6)
        X, Y = turn(-roll, right + x - x1, down + y - y1)
        X, Y = X / zoom + (w - 1) / 2, Y / zoom + (h - 1) / 2
        for n, (image, order) in enumerate(((L[k], 3), (V[k], 1), (clear[k] * 1.0, 1))):
            warped[n, k] = map_coordinates(image, [Y, X], order=order, mode="nearest")
        warped[3, k] = (-0.5 <= X) & (w - 0.5 >= X) & (-0.5 <= Y) & (h - 0.5 >= Y)
    return Along(*warped)


def pan_images(
    video: CompensatedVideo, source: Pan, t: int, level: NDArray
) -> tuple[dict[str, NDArray[np.floating]], Along]:
    """Log intensities of the smoother, of `mc`, and of the best ingredients; the true paths."""
    target = video.follow(t)
    instants, L, V, clear, *_ = target
    place = place_of(instants, clear, len(instants))
    true = truly_panned(target, source, t)
    images = {"smoother": L[instants.own]}
    found = warp(L, V, np.asarray(clear, np.float32), instants.s, target.paths)
    for motion, along in {"found": found, "true": true}.items():
        told = fusion.compare(
            agree(video.params, L, along, place), fusion.views(L, V, along, place)
        )
        ingredients = np.asarray(told.ingredients)
        images[f"`mc`, {motion} motion"] = np.asarray(fusion.decide(video.params, told).L)
        images[f"fusion alone, {motion} motion"] = ingredients[0]
        best = np.abs(ingredients - level).argmin(0)[None]
        images[f"best ingredient, {motion} motion"] = np.take_along_axis(ingredients, best, 0)[0]
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
        _, _, clear = estimator.Images(recording, params, WINDOW_EVENTS)(recording.frames.t)
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
                        counts.append(video.follow.images.factors is not None)
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
    arguments = parser.parse_args()
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
