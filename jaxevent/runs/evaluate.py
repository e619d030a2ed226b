"""Methods compared with what is known, for every recording: images, motion or tracks.

    recordings = ["slider_depth.zip", "more/*.h5"]  # paths or globs; $NAME is expanded
    protocol = "held-out"                           # or "reference", "motion" or "tracks"
    size = [240, 180]                               # only for recordings that do not tell it
    metrics = ["lpips"]                             # of images; further ones, named in MEASURES

    [[method]]
    name = "akf"                                    # a key of jaxevent.METHODS, or of egomotion's
    params = { c_on = 0.08, clock_offset = 0.0075 } # or the path of a TOML file; omitted: defaults
                                                    # { file = "PATH", c_on = 0.08 }: both
    label = "akf, by hand"                          # in the table; omitted: the name
    grid = { c_on = [0.05, 0.1], kappa = [1, 2] }   # each combination, added to params and label
    normalise = "affine"                            # fit each image's brightness to the truth

The protocols "motion" and "tracks", with settings of their own beside it, are described in
`jaxevent.runs.egomotion_scores` and `jaxevent.runs.blob_scores`; the others ask for images.

A method of the name "external" scores images of another program: `jaxevent.runs.external`. Paths
are relative to the folder of this file. The protocol "held-out" gives the methods frames 0, 2, 4,
... and asks for images where frames 1, 3, 5, ... are, at their time stamps plus the method's
`clock_offset`. Images are clipped to [0, 1], the range of the truth, before they are scored.

The protocol "reference" gives the whole recording and compares with HDR images that it keeps in
`Recording.extra`, float linear intensities of which 1 is the frames' white, without clipping:

    hdr      (T, H, W)  with hdr_t (T,), sorted times (us) on the events' clock
    HDR_mat  (K, H, W)  of the AKF authors' .mat files, used where there is no hdr: at the time of
                        each of the K frames plus `clock_offset`; a single (H, W) image: of the last
    clip     (2,)       what the frames record from and to; absent: 0.01, 1

Pixels that are NaN in hdr have no reference. HDR_mat counts in the frames' grey levels (255 is
white where they are uint8) and is 0 where it has no reference, as the authors' programs have it. In
the measures of whole images such pixels count as right; regions and mean errors leave them out.

Each recording with each method is a task (`jaxevent.runs.tasks`). With a folder for the results,
what is finished stays in its folder tasks, under a key made of the content of the recording,
method, parameters, protocol and metrics: an evaluation that was stopped, or to which recordings or
methods were added, computes only what is missing. Remove the folder tasks to compute everything
again.
"""

import contextlib
import dataclasses
import glob
import hashlib
import importlib
import itertools
import json
import math
import os
import re
import shutil
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike, NDArray
from tqdm import tqdm

import jaxevent
from jaxevent.devices import local
from jaxevent.errors import InputError, require
from jaxevent.io import load
from jaxevent.io.output import complete
from jaxevent.metrics import (
    global_ssim,
    hdr_quality,
    log_display,
    log_mse,
    log_ssim,
    lpips,
    lpips_weights,
    mse,
    regions,
    ssim,
)
from jaxevent.parameters import Parameters, nearest, read_toml
from jaxevent.reconstruction import METHODS
from jaxevent.reconstruction.augment import FrameParams
from jaxevent.reconstruction.filtering import Estimator
from jaxevent.recording import Frames, Recording, microseconds
from jaxevent.runs.external import External, Normalise, check_normalise, fit_brightness
from jaxevent.runs.tasks import Outcome, Place, Task, run
from jaxevent.show.report import markdown_table, write_parquet

# Part of the keys of stored results: raised whenever the same recording, method and parameters give
# other results than before.
RESULTS_VERSION = 1

P = TypeVar("P", bound=Parameters)


def held_out(recording: Recording) -> tuple[Recording, Frames]:
    """The recording with every second frame, and the frames taken out of it.

    Raises `InputError` for fewer than 3 frames and for no events.
    """
    frames = recording.frames
    if frames is None or len(frames) < 3:
        raise InputError(
            f"{recording.name}: has {0 if frames is None else len(frames)} frames; hiding every "
            "second one needs at least 3, so choose a recording with more"
        )
    _need_events(recording)
    return recording.with_frames(slice(0, None, 2)), frames[1::2]


def _need_events(recording: Recording) -> None:
    if not len(recording.events):
        raise InputError(
            f"{recording.name}: holds no events, so there is nothing to reconstruct from; choose "
            "another recording"
        )


@dataclasses.dataclass(frozen=True)
class Reference(Frames):
    """HDR reference images, float intensities that may exceed 1; the exposure is not known.

    `timed` says that t is on the events' clock. `clip` is what the frames record from and to.
    `white` is the value of `images` that is intensity 1; None says so of 1, and NaN of pixels
    without reference, which are 0 otherwise.
    """

    timed: bool
    clip: tuple[float, float]
    white: float | None = None

    def truth(self, row: int) -> NDArray[np.float64]:
        """One image (height, width) of intensity, NaN where there is no reference."""
        image = np.asarray(self.images[row], np.float64)
        return image if self.white is None else np.where(image == 0, np.nan, image / self.white)


def reference(recording: Recording) -> tuple[Recording, Reference]:
    """The recording itself, and the HDR images in its `extra`; the text of this module has more.

    Raises `InputError` for no or unusable images and for no events.
    """
    _need_events(recording)
    extra, name = recording.extra, recording.name
    size = (recording.height, recording.width)
    clip = np.asarray(extra.get("clip", (0.01, 1.0)))
    if clip.shape != (2,) or clip.dtype.kind not in "iuf" or not clip[0] < clip[1]:
        raise InputError(f"{name}: clip is {clip.tolist()}; store two intensities, low below high")
    if "hdr" in extra:
        images, what, white = extra["hdr"], "hdr", None
        if "hdr_t" not in extra:
            raise InputError(f"{name}: hdr has no times; add hdr_t, in us on the events' clock")
        t = np.atleast_1d(microseconds(extra["hdr_t"], f"{name}: hdr_t"))
        if t.ndim != 1 or (t[1:] <= t[:-1]).any():
            raise InputError(f"{name}: hdr_t is not sorted; sort hdr by time, each time once")
    elif "HDR_mat" in extra:
        images, what, frames = extra["HDR_mat"], "HDR_mat", recording.frames
        if frames is None:
            raise InputError(f"{name}: HDR_mat needs frames to tell its times; add frames")
        images, t = (images[None], frames.t[-1:]) if images.ndim == 2 else (images, frames.t)
        kind = frames.images.dtype
        white = 1.0 if kind.kind == "f" else float(np.iinfo(kind).max)
    else:
        raise InputError(
            f"{name}: holds no HDR reference; add hdr (T, H, W) and hdr_t, or choose the protocol "
            "'held-out'"
        )
    if images.shape != (len(t), *size) or not len(t):
        raise InputError(
            f"{name}: {what} has the shape {images.shape}; its {len(t)} times and the sensor need "
            f"({len(t)}, {size[0]}, {size[1]})"
        )
    if images.dtype.kind != "f" and white is None:
        raise InputError(
            f"{name}: {what} is {images.dtype}; store floats of which 1 is the frames' white"
        )
    for row in range(len(images)):
        if (images[row] < 0).any() or np.isinf(images[row]).any():
            raise InputError(
                f"{name}: {what} image {row} holds negative or infinite values; store linear "
                "intensities, NaN where there is none"
            )
    bounds = (float(clip[0]), float(clip[1]))
    none = np.zeros(len(t), np.int64)
    return recording, Reference(t, images, none, what == "hdr", bounds, white)


Protocol = Callable[[Recording], tuple[Recording, Frames]]
PROTOCOLS: dict[str, Protocol] = {"held-out": held_out, "reference": reference}

# Protocols of other things than images: where they are described and their rows made.
OTHERS = {"motion": "jaxevent.runs.egomotion_scores", "tracks": "jaxevent.runs.blob_scores"}


class Named(NamedTuple):
    """A method of another protocol."""

    name: str
    Params: type[Parameters]


# Further measures of an image and the truth, each a number per image. They cost more time, and the
# first two need an extra.
MEASURES: dict[str, Callable[..., NDArray[np.float64]]] = {
    "lpips": lpips,
    "hdr_quality": hdr_quality,
    "global_ssim": global_ssim,
}


def _check_measures(names: Iterable[str]) -> None:
    """Raise `InputError` for unknown measures and for those whose extra is missing."""
    for name in names:
        if name not in MEASURES:
            raise InputError(f"there is no metric {name!r}; {nearest(name, MEASURES)}")
        if name == "lpips":
            lpips_weights()
        if name == "hdr_quality":
            require("pycvvdp", "hdr")


def find_method(name: str) -> Estimator:
    """The method of that name; raises `InputError` naming the nearest."""
    if name not in METHODS:
        raise InputError(f"there is no method {name!r}; {nearest(name, METHODS)}")
    return METHODS[name]


def values_of(params: Parameters) -> dict[str, Any]:
    """The values as they were given: numbers to 6 digits, lists of them, text, true and false.

    None where JSON has no number.
    """

    def plain(value: Any) -> Any:
        if value is None or isinstance(value, str | bool | np.bool_):
            return bool(value) if isinstance(value, np.bool_) else value
        if np.ndim(value):
            return [plain(one) for one in value]
        return finite(float(f"{float(value):.6g}"))

    return {name: plain(value) for name, value in params.values().items()}


def frame_times(frames: Frames, params: FrameParams | External) -> np.ndarray:
    """When the frames were taken (us) on the events' clock: time stamps plus `clock_offset`.

    The times of a `Reference` on that clock as they are.
    """
    if isinstance(frames, Reference) and frames.timed:
        return frames.t
    return frames.t + round(float(params.clock_offset) * 1e6)


# The scores of one image; those of its regions are nested under "regions".
Scores = dict[str, float | dict[str, dict[str, float | int]]]


def _measures(image: NDArray, truth: NDArray, names: Iterable[str]) -> Scores:
    """The scores of a hidden frame; intensities are clipped to [0, 1]."""
    image = np.clip(image, 0, 1)
    measures = {"mse": mse, "ssim": ssim, **{name: MEASURES[name] for name in names}}
    if not np.isfinite(image).all():
        return dict.fromkeys(measures, math.nan)
    return {name: float(measure(image, truth)) for name, measure in measures.items()}


def _hdr_measures(
    image: NDArray,
    variance: NDArray | None,
    truth: NDArray[np.float64],
    names: Iterable[str],
    clip: tuple[float, float],
    I0: float,
) -> Scores:
    """The scores of an image against an HDR reference, NaN where there is none."""
    known = np.isfinite(truth)
    covered = np.where(known, truth, 0)
    masks = {name: mask & known for name, mask in regions(covered, *clip).items()}
    # A hot pixel's events add up until exp(L) overflows; such a pixel is only very bright.
    shown = np.where(known, np.clip(image.astype(np.float64), -1e30, 1e30), 0)
    broken = not np.isfinite(shown).all()
    if broken:
        shown = np.zeros_like(shown)

    scores: Scores = {
        "mse": float(mse(shown, covered, known)),
        "ssim": float(ssim(shown, covered)),
        "log_mse": float(log_mse(shown, covered, where=known)),
        "log_ssim": float(log_ssim(shown, covered)),
    }
    for name in names:
        pair = (shown, covered)
        if name == "lpips":  # it looks at what a display shows
            pair = tuple(np.clip(part, 0, 1) for part in log_display(shown, covered))
        scores[name] = float(MEASURES[name](*pair))
    parts: dict[str, dict[str, float | int]] = {
        name: {
            "pixels": int(mask.sum()),
            "mse": float(mse(shown, covered, mask)),
            "log_mse": float(log_mse(shown, covered, where=mask)),
        }
        for name, mask in masks.items()
    }
    if variance is not None:
        # L = ln(I + I0) cannot be known better than I is rounded.
        least = max(float(np.finfo(image.dtype).eps) * I0, 1e-12)
        L, true_L = (np.log(np.maximum(part + I0, least)) for part in (shown, covered))
        usable = np.isfinite(variance) & (variance > 0)
        z2 = (L - true_L) ** 2 / np.where(usable, variance, 1).astype(np.float64)

        def over(mask: NDArray[np.bool_], mean: Callable[[NDArray], Any]) -> float:
            values = z2[mask & usable]
            return float(mean(values)) if len(values) else math.nan

        scores["z2"], scores["z2_median"] = over(known, np.mean), over(known, np.median)
        for name, mask in masks.items():
            parts[name]["z2"] = over(mask, np.mean)
    if broken:
        scores = dict.fromkeys(scores, math.nan)
        parts = {
            name: {**dict.fromkeys(part, math.nan), "pixels": part["pixels"]}
            for name, part in parts.items()
        }
    return {**scores, "regions": parts}


def _listed(scores: list[Scores]) -> dict[str, Any]:
    """One list per measure of the values of all images, None for what is not a number."""
    if not scores:
        return {}

    def gather(values: list[Any]) -> Any:
        if isinstance(values[0], dict):
            return {name: gather([value[name] for value in values]) for name in values[0]}
        return [finite(value) for value in values]

    return gather(scores)


def _means(per_frame: Mapping[str, Any]) -> dict[str, Any]:
    """The means over images of what `per_frame` lists; regions' over pixels."""

    def mean(values: list[float | None], weights: list[int] | None = None) -> float | None:
        numbers = np.array([math.nan if value is None else value for value in values])
        weight = np.ones(len(values)) if weights is None else np.array(weights)
        counted = weight > 0
        if not counted.any():
            return None
        return finite(float(np.average(numbers[counted], weights=weight[counted])))

    means: dict[str, Any] = {}
    for name, values in per_frame.items():
        if name == "regions":
            total = sum(sum(part["pixels"]) for part in values.values())
            means[name] = {
                region: {
                    "share": sum(part["pixels"]) / total if total else None,
                    **{k: mean(v, part["pixels"]) for k, v in part.items() if k != "pixels"},
                }
                for region, part in values.items()
            }
        elif name != "t":
            means[name] = mean(values)
    return means


def subset(row: Mapping[str, Any], frames: ArrayLike) -> dict[str, Any]:
    """The row of `score` had only some of its images been asked for; nothing is reconstructed.

    `frames` is a mask over the images, bool, or their numbers. `seconds` stays that of all. Raises
    `InputError` for numbers that there are not and for a mask of another length.
    """
    count = len(row["per_frame"]["t"])
    chosen = np.asarray(frames)
    try:
        rows = np.arange(count)[chosen if chosen.size or chosen.dtype == bool else []].ravel()
    except IndexError as error:
        raise InputError(
            f"the images of a row of {count} cannot be chosen by {chosen.dtype} of shape "
            f"{chosen.shape} ({error}); give a mask of that length or numbers below it"
        ) from None

    def cut(part: Any) -> Any:
        if isinstance(part, Mapping):
            return {name: cut(value) for name, value in part.items()}
        return [part[i] for i in rows]

    per_frame = cut(row["per_frame"])
    return {**row, **_means(per_frame), "frames": len(rows), "per_frame": per_frame}


@dataclasses.dataclass(frozen=True)
class Sample:
    """One of the images asked for, at `t` (us, as stamped), and the truth, NaN where unknown."""

    t: int
    image: NDArray[np.floating]
    truth: NDArray[np.floating]
    hdr: bool


def score(
    recording: Recording,
    method: Estimator | External,
    params: FrameParams | None = None,
    protocol: str = "held-out",
    *,
    metrics: Iterable[str] = (),
    normalise: Normalise = "none",
    progress: bool = False,
) -> dict[str, Any]:
    """Reconstruct the images that `protocol` asks for, and compare: one row of a table of results.

    Memory does not grow with the recording's length. With "held-out" intensities are clipped to
    [0, 1] before they are compared. `mse`, `ssim` and those of `metrics` (names in `MEASURES`) are
    means over the images. `seconds` is the time of reconstructing and reading images, with
    compilation but without scoring. What is not a number is None. `per_frame` lists t (us, as
    stamped) and every measure of every image.

    Rows of "reference" have also `log_mse` and `log_ssim`; `clip`, the bounds of the `regions`
    "bright", "dark" and "well"; and of each of those its `share` of all pixels and, over its pixels
    of all images, `mse` and `log_mse`. Where the method estimates a variance, `z2` is the mean of
    (error of ln(I + I0))^2 / variance, over all pixels and in each region, 1 for honest variances,
    and `z2_median` the mean over images of its median, then 0.45 if errors are Gaussian. "lpips" is
    that of ln(I + 0.003), clipped to the truth's range.

    With `normalise` "affine", which is then in the row, the brightness of each image is fitted to
    the truth first (`external.fit_brightness`), and no variance is judged. Of `External` images,
    taken for those of `recording.name`, `missing` is how many were asked for in vain, and `seconds`
    is None.

    Raises `InputError` for a recording that the protocol or the method cannot use, for unknown
    metrics and for those whose extra is missing.
    """
    check_normalise(normalise)
    return _score(recording, method, params, protocol, metrics, normalise, progress)[0]


def _score(
    recording: Recording,
    method: Estimator | External,
    params: FrameParams | None,
    protocol: str,
    metrics: Iterable[str],
    normalise: str,
    progress: bool,
    name: str | None = None,
) -> tuple[dict[str, Any], Sample | None]:
    """As `score`, with the middle one of the images; `name` is by which images are found."""
    if protocol not in PROTOCOLS:
        raise InputError(f"there is no protocol {protocol!r}; {nearest(protocol, PROTOCOLS)}")
    names = list(metrics)
    _check_measures(names)
    given, hidden = PROTOCOLS[protocol](recording)
    hdr = hidden if isinstance(hidden, Reference) else None
    clock = time.perf_counter()
    seconds, estimated = 0.0, False  # whether the method estimates a variance
    values: dict[str, Any]
    if isinstance(method, External):
        estimates = _external(given, hidden, method, name or recording.name)
        values, I0 = method.values(), 0.0
    else:
        chosen: FrameParams = params or method.Params()
        estimates = _estimates(given, hidden, method, chosen, progress)
        values, I0 = values_of(chosen), float(chosen.I0)
    scores: list[Scores] = []
    t: list[int] = []
    sample: Sample | None = None
    for first, images, variances in estimates:
        seconds += time.perf_counter() - clock
        if hdr is None:
            truths = hidden[first : first + len(images)].intensity
        else:
            truths = np.stack([hdr.truth(row) for row in range(first, first + len(images))])
            if not scores:
                estimated = normalise == "none" and not np.isnan(variances).all()
        for row, (image, variance, truth) in enumerate(
            zip(images, variances, truths, strict=True), first
        ):
            if normalise == "affine":
                image = fit_brightness(image, truth)
            if hdr is None:
                scores.append(_measures(image, truth, names))
            else:
                P = variance if estimated else None
                scores.append(_hdr_measures(image, P, truth, names, hdr.clip, I0))
            t.append(int(hidden.t[row]))
            if row == len(hidden) // 2:
                sample = Sample(t[-1], image, truth, hdr is not None)
        clock = time.perf_counter()
    external = isinstance(method, External)
    per_frame = {"t": t, **_listed(scores)}
    row = {
        "recording": recording.name,
        "method": method.name,
        **_means(per_frame),
        **({} if hdr is None else {"clip": list(hdr.clip)}),
        "frames": len(scores),
        **({"missing": len(hidden) - len(scores)} if external else {}),
        "events": len(recording.events),
        "seconds": None if external else seconds,
        **({} if normalise == "none" else {"normalise": normalise}),
        "params": values,
        "per_frame": per_frame,
    }
    return row, sample


# The number of the first image, and some images with their variances, each (images, height, width).
Estimates = Iterator[tuple[int, NDArray[np.floating], NDArray[np.floating]]]


def _estimates(
    given: Recording, hidden: Frames, method: Estimator, params: FrameParams, progress: bool
) -> Estimates:
    video = method.reconstruct(given, params, progress=progress, devices=local())
    first = 0
    for _, images, variances in video.batches(frame_times(hidden, params)):
        yield first, images, variances
        first += len(images)


def _external(given: Recording, hidden: Frames, method: External, name: str) -> Estimates:
    series = method.find(name)
    times = frame_times(hidden, method)
    shape = (given.height, given.width)
    found = False
    for row, place in method.nearest(series, times):
        image = series.read(place)
        if image.shape != shape:
            raise InputError(
                f"{method.images}: the image at {series.t[place]} us of {name} has the size "
                f"{image.shape[1]}x{image.shape[0]}; the sensor has {shape[1]}x{shape[0]} pixels"
            )
        found = True
        yield row, image[None], np.full((1, *shape), np.nan)
    if not found:
        after = np.searchsorted(series.t, times)
        gap = min(
            int(np.abs(series.t[(after - back).clip(0, len(series.t) - 1)] - times).min())
            for back in (0, 1)
        )
        raise InputError(
            f"{method.images}: no image of {name} is within {method.tolerance:g} s of those asked "
            f"for (the nearest is {gap / 1e6:g} s away); correct the times or raise tolerance"
        )


def evaluate(
    config: str | Path,
    out: str | Path | None = None,
    progress: bool = False,
    *,
    workers: int | None = None,
    cluster: str | None = None,
    scheduler_file: str | Path | None = None,
    retries: int = 2,
) -> list[dict[str, Any]]:
    """Run an evaluation that a TOML file describes: a row per recording and method, as of `score`.

    The file's layout is in the text of this module. In a row, `recording` is the path as the file
    gives it and `method` is the label. Where a method cannot be run on a recording, the row has
    only those, `params` and `error`, a sentence. Rows do not depend on where they are computed, but
    for `seconds`.

    Args:
        config: The TOML file.
        out: A folder for results.json ({"rows": [...]}), results.md (the table), report.html (one
            page that opens anywhere), results.parquet (a line per row; only where the extra
            "parquet" is installed), config.toml (the file as it was run) and tasks (finished rows,
            which are not computed again); made if missing. Existing results are replaced at the
            end.
        progress: Show bars on stderr.
        workers: Compute in so many processes instead of this one.
        cluster: Compute on the Dask cluster whose scheduler has this address. Its workers need the
            same version of jaxevent, and to find recordings by the same paths; those with one
            thread each serve best.
        scheduler_file: The same, of the scheduler that wrote this file.
        retries: How often a task is tried again whose process dies or that fails for another reason
            than bad input.

    Raises:
        InputError: The file or a parameter cannot be used, `out` not be written, the cluster not be
            reached; or not a single row could be computed.
    """
    plan = read_plan(Path(config))
    place = Place(workers, cluster, None if scheduler_file is None else Path(scheduler_file))
    with contextlib.ExitStack() as stack:
        text = Path(config).read_bytes()
        write = None if out is None else stack.enter_context(results(Path(out)))
        folder = None if out is None else Path(out) / "tasks"
        stack.callback(_opened.clear)
        tasks = _tasks(plan, folder, progress, place == Place())
        outcomes = run(_compute, tasks, folder, place, retries=retries, progress=progress)
        rows = _rows(plan, outcomes)
        if write is not None and out is not None:
            from jaxevent.show.page import page

            write("config.toml", text)
            write_rows(rows, write)
            pictures = [(o.result or {}).get("picture") for o in outcomes]
            hosts = sorted({o.host for o in outcomes if o.host})
            html = page(rows, pictures, plan.protocol, text.decode(), hosts, Path(config).name)
            write("report.html", html.encode())
            write_parquet(Path(out) / "results.parquet", rows)
    return rows


def _rows(plan: "Plan", outcomes: list[Outcome]) -> list[dict[str, Any]]:
    """The rows, named as the configuration does; raises `InputError` if all are errors."""
    rows: list[dict[str, Any]] = []
    pairs = itertools.product(plan.recordings, plan.methods)
    for ((given, _), entry), outcome in zip(pairs, outcomes, strict=True):
        named = {"recording": given, "method": entry.label}
        if outcome.error is None:
            rows.append({**outcome.result["row"], **named})
        else:
            rows.append({**named, "params": entry.shown(), "error": outcome.error})
    errors = list(dict.fromkeys(row["error"] for row in rows if "error" in row))
    if all("error" in row for row in rows):
        more = f" (and {len(errors) - 1} further errors)" if len(errors) > 1 else ""
        raise InputError(f"{errors[0]}{more}")
    return rows


def _tasks(plan: "Plan", folder: Path | None, progress: bool, here: bool) -> list[Task]:
    """A task for each recording and method; with a folder, keyed by all that its row depends on.

    Tasks that are run `here` show a bar of their own.
    """
    contents = None if folder is None else _Contents(folder / "contents", progress)
    double = jnp.result_type(float) == jnp.float64
    tasks: list[Task] = []
    for (given, path), entry in itertools.product(plan.recordings, plan.methods):
        path = path.absolute()
        about = {
            "method": entry.method.name,
            "params": entry.settings(),
            "protocol": plan.protocol,
            "metrics": list(plan.metrics),
            "normalise": entry.normalise,
            "size": plan.size,
            "double": double,
            "version": f"{jaxevent.__version__}, results {RESULTS_VERSION}",
            **({} if plan.other is None else {"options": plan.options}),
        }
        key = None
        if contents is not None:
            # What cannot be read has no key; computing it says why.
            with contextlib.suppress(OSError, InputError):
                read = contents.of(path)
                whole = {**about, "content": read}
                if isinstance(entry.method, External):
                    files = entry.method.find(_name(path)).files
                    whole["images"] = [contents.of(file) for file in files]
                    whole["params"] = entry.method.values()
                elif plan.other is not None:
                    truths = plan.other.files(path, plan.options)
                    whole["truths"] = [contents.of(file) for file in truths]
                text = json.dumps(whole, sort_keys=True)
                key = hashlib.blake2b(text.encode(), digest_size=16).hexdigest()
        arguments = {"path": str(path), **about, "progress": progress and here}
        tasks.append(Task(f"{given}, {entry.label}", arguments, key))
    if contents is not None:
        contents.save()
    return tasks


def _compute(
    path: str,
    method: str,
    params: dict[str, Any],
    protocol: str,
    metrics: list[str],
    normalise: str,
    size: tuple[int, int] | None,
    double: bool,
    version: str,
    progress: bool,
    options: dict[str, Any] | None = None,
) -> dict[str, Any]:
    """The task: {"row", "picture"} of a recording and a method, on whichever machine."""
    from jaxevent.show.page import picture

    mine = f"{jaxevent.__version__}, results {RESULTS_VERSION}"
    if version != mine:
        raise InputError(
            f"{path}: this worker has jaxevent {mine}, not {version}; install the same everywhere"
        )
    with jax.enable_x64(double):
        recording = _opened.load(Path(path), size, progress)
        if options is not None:
            kind = other(protocol)
            assert kind is not None
            chosen = kind.find(method, options).of(params)
            scores = kind.score(recording, method, chosen, options, progress)
            about = {"recording": recording.name, "method": method}
            return {"row": {**about, **scores, "params": values_of(chosen)}, "picture": None}
        source = External(**params) if method == "external" else find_method(method)
        values = None if isinstance(source, External) else source.Params.of(params)
        name = _name(Path(path))
        row, sample = _score(
            recording, source, values, protocol, metrics, normalise, progress, name
        )
    return {"row": row, "picture": None if sample is None else picture(sample)}


def _name(path: Path) -> str:
    """How other programs' results call a recording: its name without suffix."""
    return path.name if path.is_dir() else path.stem


class _Opened(threading.local):
    """The recording last loaded: methods are run on it one after another."""

    def __init__(self):
        self.clear()

    def clear(self) -> None:
        self._last: tuple[Any, Recording | InputError | None] = (None, None)

    def load(self, path: Path, size: tuple[int, int] | None, progress: bool) -> Recording:
        size = None if size is None else (size[0], size[1])
        what = (path, size, [_stamp(file) for file in _files(path)])
        before, loaded = self._last
        if loaded is None or before != what:
            self.clear()
            try:
                loaded = load(path, size, in_memory=False, progress=progress)
                loaded = dataclasses.replace(loaded, name=str(path))  # for messages
            except InputError as error:
                loaded = error
            self._last = what, loaded
        if isinstance(loaded, InputError):
            raise InputError(str(loaded))
        return loaded


_opened = _Opened()


def _files(path: Path) -> list[Path]:
    return sorted(file for file in path.rglob("*") if file.is_file()) if path.is_dir() else [path]


def _stamp(file: Path) -> tuple[str, int, int]:
    try:
        about = file.stat()
    except OSError:
        return str(file), -1, 0
    return str(file), about.st_size, about.st_mtime_ns


class _Contents:
    """Hashes of what files and folders hold, kept in a file as long as size and time agree."""

    # A file changed again within the clock's tick (s) after it was read would look unchanged.
    TICK = 2

    def __init__(self, cache: Path, progress: bool):
        self.cache, self.progress = cache, progress
        self.known: dict[str, list] = {}
        with contextlib.suppress(OSError, ValueError):
            self.known = dict(json.loads(cache.read_bytes()))
        self.used: dict[str, list] = {}
        self.now: dict[Path, str] = {}

    def of(self, path: Path) -> str:
        """The hash of a file, or of all names and files in a folder; raises OSError."""
        if path not in self.now:
            files = _files(path)
            hashes = [self._of_file(file) for file in files]
            if path.is_dir():
                names = [str(file.relative_to(path)) for file in files]
                text = json.dumps(list(zip(names, hashes, strict=True)))
                self.now[path] = hashlib.blake2b(text.encode(), digest_size=16).hexdigest()
            else:
                self.now[path] = hashes[0]
        return self.now[path]

    def _of_file(self, file: Path) -> str:
        name, size, changed = _stamp(file)
        known = self.known.get(name)
        if isinstance(known, list) and known[:2] == [size, changed]:
            self.used[name] = known
            return known[2]
        digest = hashlib.blake2b(digest_size=16)
        with (
            file.open("rb") as opened,
            tqdm(
                desc=f"reading {file.name}",
                total=size,
                unit="B",
                unit_scale=True,
                delay=2,
                disable=not self.progress,
                leave=False,
            ) as bar,
        ):
            while block := opened.read(1 << 22):
                digest.update(block)
                bar.update(len(block))
        if time.time_ns() - changed > self.TICK * 10**9:
            self.used[name] = [size, changed, digest.hexdigest()]
        return digest.hexdigest()

    def save(self) -> None:
        known = {**self.known, **self.used}
        if known != self.known:
            self.cache.parent.mkdir(exist_ok=True)
            with complete(self.cache) as partial:
                partial.write_text(json.dumps(known))


Write = Callable[[str, bytes], None]


def write_rows(
    rows: Iterable[dict[str, Any]],
    write: Write,
    table: Callable[[list[dict[str, Any]]], str] = markdown_table,
) -> None:
    """Write results.json and results.md by a function that `results` gives."""
    rows = list(rows)
    text = json.dumps({"rows": rows}, indent=1, allow_nan=False) + "\n"
    write("results.json", text.encode())
    write("results.md", table(rows).encode())


@contextlib.contextmanager
def results(folder: Path) -> Iterator[Write]:
    """Open a folder for results, made if missing; gives the function `write(name, content)`.

    A folder made here is removed again if the block raises, unless it holds finished tasks. Raises
    `InputError` if the folder cannot be made.
    """
    made = not folder.exists()
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise InputError(
            f"{folder}: the folder cannot be made ({error.strerror}); choose a place for a new "
            "folder in an existing, writable one"
        ) from None

    def write(name: str, content: bytes) -> None:
        with complete(folder / name) as partial:
            partial.write_bytes(content)

    try:
        if not os.access(folder, os.W_OK):  # before hours of computing
            raise InputError(f"{folder}: is not writable; choose another folder")
        yield write
    except BaseException:
        if made and not any(folder.glob("tasks/*.json")):
            shutil.rmtree(folder, ignore_errors=True)
        raise


@dataclasses.dataclass(frozen=True)
class Plan:
    """A checked configuration: recordings (as given, path) and methods."""

    recordings: list[tuple[str, Path]]
    methods: list["Entry"]
    protocol: str
    size: tuple[int, int] | None
    metrics: tuple[str, ...] = ()
    options: dict[str, Any] = dataclasses.field(default_factory=dict)  # of another protocol

    @property
    def other(self) -> ModuleType | None:
        """Of a protocol of other things than images."""
        return other(self.protocol)


def other(protocol: str) -> ModuleType | None:
    """The module of a protocol of other things than images."""
    return importlib.import_module(OTHERS[protocol]) if protocol in OTHERS else None


@dataclasses.dataclass(frozen=True)
class Entry:
    """A method of a configuration with one set of parameters; `External` has none."""

    label: str
    method: Estimator | External | Named
    params: Parameters | None
    normalise: str

    def settings(self) -> dict[str, Any]:
        """What `_compute` makes it from again."""
        if isinstance(self.method, External):
            return dict(vars(self.method))
        assert self.params is not None
        return self.params.values()

    def shown(self) -> dict[str, Any]:
        """The parameters as a row shows them."""
        if isinstance(self.method, External):
            return self.method.values()
        assert self.params is not None
        return values_of(self.params)


def read_plan(config: Path) -> Plan:
    """Read and check a configuration; raises `InputError` naming the file and the setting."""
    table = read_toml(config)
    try:
        protocol = table.get("protocol", "held-out")
        if protocol not in (every := [*PROTOCOLS, *OTHERS]):
            near = nearest(str(protocol), every)
            raise InputError(f"there is no protocol {protocol!r}; {near}")
        kind = other(protocol)
        own = ("metrics",) if kind is None else tuple(kind.SETTINGS)
        _refuse_unknown(table, ("recordings", "protocol", "size", "method", *own))
        options = {name: table[name] for name in own if name in table and kind is not None}
        if kind is not None:
            for name, value in options.items():
                fits, what = kind.SETTINGS[name]
                if not fits(value):
                    raise InputError(f"{name} is {value!r}; give {what}")
            kind.check(options)
        size = table.get("size")
        if size is not None and not (
            isinstance(size, list) and len(size) == 2 and all(type(n) is int for n in size)
        ):
            raise InputError(f"size is {size!r}; give [width, height] in pixels")
        metrics = table.get("metrics", [])
        if not (isinstance(metrics, list) and all(isinstance(name, str) for name in metrics)):
            raise InputError(f'metrics is {metrics!r}; give a list of names, as ["lpips"]')
        _check_measures(metrics)
        recordings = find_recordings(table.get("recordings"), config.parent)
        return Plan(
            recordings,
            _methods(table.get("method"), config.parent, kind, options),
            protocol,
            None if size is None else (size[0], size[1]),
            tuple(metrics),
            options,
        )
    except InputError as error:
        raise InputError(f"{config}: {error}") from None


def find_recordings(given: Any, folder: Path) -> list[tuple[str, Path]]:
    if not (isinstance(given, list) and given and all(isinstance(one, str) for one in given)):
        raise InputError('recordings is missing or not a list; give recordings = ["file.zip", ...]')
    found: dict[Path, str] = {}
    for text in given:
        expanded = os.path.expanduser(os.path.expandvars(text))
        unset = re.search(r"\$(\w+|\{[^}]*\})", expanded)
        if unset and not (folder / expanded).exists():
            name = unset.group(1).strip("{}")
            raise InputError(f"the recording {text!r} needs the variable {name}, which is not set")
        if not glob.has_magic(expanded) or (folder / expanded).exists():
            found.setdefault(folder / expanded, text)
            continue
        matches = sorted(glob.glob(expanded, root_dir=folder, recursive=True))
        if not matches:
            raise InputError(f"no recording matches {text!r} in {folder}; correct the pattern")
        for match in matches:
            found.setdefault(folder / match, match)
    return [(text, path) for path, text in found.items()]


def _methods(
    given: Any, folder: Path, kind: ModuleType | None, options: Mapping[str, Any]
) -> list[Entry]:
    if not (isinstance(given, list) and given and all(isinstance(one, dict) for one in given)):
        raise InputError('no method is given; add [[method]] with name = "akf"')
    entries: list[Entry] = []
    for number, table in enumerate(given, 1):
        try:
            for entry in _entries(table, folder, kind, options):
                if any(entry.label == other.label for other in entries):
                    raise InputError(f"another one is labelled {entry.label!r} too; add a label")
                entries.append(entry)
        except InputError as error:
            raise InputError(f"method {number}: {error}") from None
    return entries


def _entries(
    table: Mapping[str, Any], folder: Path, kind: ModuleType | None, options: Mapping[str, Any]
) -> Iterator[Entry]:
    """The method of one table, once for each combination of its grid."""
    own = dict(table)
    name = own.pop("name", None)
    normalise = own.pop("normalise", "none") if kind is None else "none"
    label = own.pop("label", name)
    if not isinstance(name, str) or not isinstance(label, str):
        raise InputError('name and label must be text; give name = "akf"')
    check_normalise(normalise)
    fitted = "" if normalise == "none" else ", brightness fitted"
    if name == External.name and kind is None:
        yield Entry(label + fitted, External.of(own, folder.absolute()), None, normalise)
        return
    _refuse_unknown(own, ("name", "params", "label", "grid", *(["normalise"] * (kind is None))))
    method = find_method(name) if kind is None else Named(name, kind.find(name, options))
    params = read_params(method.Params, method.name, own.get("params", {}), folder)
    grid = own.get("grid", {})
    if not isinstance(grid, dict) or not all(isinstance(v, list) and v for v in grid.values()):
        raise InputError(f"grid is {grid!r}; give a table of lists, as {{ c_on = [0.05, 0.1] }}")
    if "preset" in grid:
        raise InputError("a preset cannot be in a grid; add a [[method]] for each preset")
    for values in itertools.product(*grid.values()):
        point = dict(zip(grid, values, strict=True))
        said = "".join(
            f", {key} {value:g}"
            if isinstance(value, int | float) and not isinstance(value, bool)
            else f", {key} {value}"
            for key, value in point.items()
        )
        chosen = method.Params.of({**params.values(), **point}) if point else params
        yield Entry(f"{label}{said}{fitted}", method, chosen, normalise)


def read_params(kind: type[P], name: str, given: Any, folder: Path) -> P:
    """Params of a method as a configuration gives them: a table, a TOML file's path, or both.

    Paths are relative to `folder`. Raises `InputError` for anything else and naming a bad setting.
    """

    def load_file(path: str) -> P:
        return kind.load(folder / os.path.expandvars(path), name)

    if isinstance(given, str):
        return load_file(given)
    if not isinstance(given, dict):
        raise InputError(f"params is {given!r}; give a table or the path of a TOML file")
    values = dict(given)
    file = values.pop("file", None)
    if file is None:
        return kind.of(values)
    if not isinstance(file, str):
        raise InputError(f"file is {file!r}; give the path of a TOML file")
    return kind.of({**load_file(file).values(), **values})


def _refuse_unknown(table: Mapping[str, Any], known: tuple[str, ...]) -> None:
    for name in table:
        if name not in known:
            raise InputError(f"there is no setting {name!r}; {nearest(name, known)}")


def finite(value: float | int) -> float | int | None:
    """The value, None where JSON has no number."""
    return value if math.isfinite(value) else None
