"""Images compared with the truth: `score` makes one row of a table of results."""

import contextlib
import dataclasses
import functools
import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxevent.errors import InputError, require
from jaxevent.io.output import finite, values_of
from jaxevent.metrics import (
    global_ssim,
    hdr_quality,
    log_display,
    log_mse,
    log_ssim,
    lpips,
    lpips_weights,
    masked_mse,
    matlab_ssim,
    mse,
    psnr,
    regions,
    ssim,
)
from jaxevent.parameters import check_choice
from jaxevent.reconstruction.augment import FrameParams, calibrated_values
from jaxevent.reconstruction.estimator import ImageEstimator
from jaxevent.recording import LEAST_WHITE_GREY, Frames, Recording
from jaxevent.runs.config import (
    CALIBRATE_CHECK,
    FLAG_CHECK,
    METRICS_CHECK,
    external_name,
    is_texts,
)
from jaxevent.runs.external import (
    ExternalImages,
    Normalise,
    PublishedResults,
    check_normalise,
    fit_brightness,
)
from jaxevent.runs.family import Protocol
from jaxevent.runs.own import MethodFunction, Metric, find_metrics, own_names
from jaxevent.runs.protocols import (
    DEFAULT_GAP_FRAMES,
    GAP_DOMAIN,
    Reference,
    divide,
    frame_times,
    frames_around,
    is_gap,
)
from jaxevent.show.page import spread_rows

# Further measures of an image and the truth, each a number per image; the first two need an extra.
# Where an HDR reference has no value both images are 0, which is all that the authors' error needs.
MEASURE_FUNCTIONS: dict[str, Callable[..., NDArray[np.float64]]] = {
    "psnr": psnr,
    "lpips": lpips,
    "hdr_quality": hdr_quality,
    "global_ssim": global_ssim,
    "authors_ssim": functools.partial(global_ssim, by_column=True),
    "matlab_ssim": matlab_ssim,
    "masked_mse": lambda image, truth: masked_mse(image, truth, np.ones(truth.shape, bool)),
}


# Those that every image has, of a protocol by its name.
DEFAULT_MEASURES = {
    "held-out": ("mse", "ssim"),
    "reference": ("mse", "ssim", "log_mse", "log_ssim"),
}


class Measures(NamedTuple):
    """Measures beyond those of `DEFAULT_MEASURES`: of `MEASURE_FUNCTIONS`, and the user's own."""

    names: tuple[str, ...]
    own: tuple[Metric, ...]

    @classmethod
    def of(cls, given: Iterable[str | Metric | Callable], protocol: str) -> "Measures":
        """Find the measures that are given.

        Raise `InputError` for unknown ones and missing extras.
        """
        given, always = list(given), DEFAULT_MEASURES.get(protocol, ())
        own = find_metrics(given, [*MEASURE_FUNCTIONS, *always])
        names = [one for one in given if isinstance(one, str) and one in MEASURE_FUNCTIONS]
        check_extras(names)
        return cls(tuple(dict.fromkeys(names)), tuple(own))

    def of_own(self, image: NDArray, truth: NDArray, recording: str) -> dict[str, float]:
        """Compute the user's own metrics.

        Args:
            image: (H, W) intensity.
            truth: (H, W) intensity.
            recording: Name of the recording, for messages.

        Returns:
            Numbers, by the metrics' names.
        """
        return {metric.name: metric(image, truth, recording) for metric in self.own}


NO_FURTHER_MEASURES = Measures((), ())


def check_extras(names: Iterable[str]) -> None:
    """Raise `InputError` for measures whose extra is missing."""
    for name in names:
        if name == "lpips":
            lpips_weights()
        if name == "hdr_quality":
            require("pycvvdp", "hdr")


MAX_SAMPLES = 5  # images of a recording that a report shows
MIN_MOTION_CHANGE = 0.05  # of white, by which frames differ where something moves

# The scores of one image; those of parts of it are nested under "regions" and "moving".
Scores = dict[str, Any]


def hidden_scores(
    image: NDArray,
    variance: NDArray | None,
    truth: Frames,
    I0: float,
    moving: NDArray[np.bool_] | None,
    *,
    measures: Measures = NO_FURTHER_MEASURES,
    recording: str = "",
) -> Scores:
    """Score an image in the place of a hidden frame; see `score`.

    Args:
        image: (height, width) intensity.
        variance: (height, width) variance of ln(I + I0); None to leave it out.
        truth: The hidden frame, a `Frames` of one.
        I0: Offset inside the logarithm.
        moving: (height, width) mask of moving pixels; None to leave them out.
        measures: Further measures.
        recording: Name of the recording for messages.

    Returns:
        The scores by name.
    """
    shown, true = np.clip(image, *truth.limits[0]), truth.intensity[0]
    known = {"mse": mse, "ssim": ssim, **{name: MEASURE_FUNCTIONS[name] for name in measures.names}}
    broken = not np.isfinite(shown).all()
    scores: Scores = {
        name: math.nan if broken else float(measure(shown, true)) for name, measure in known.items()
    }
    scores |= (
        {metric.name: math.nan for metric in measures.own}
        if broken
        else measures.of_own(shown, true, recording)
    )
    if variance is not None:
        # A black or clipped pixel tells a bound of the intensity, not the intensity.
        grey = np.asarray(truth.images)[0]
        white = 1 if grey.dtype.kind == "f" else np.iinfo(grey.dtype).max
        unclipped = (grey > 0) & (grey < LEAST_WHITE_GREY * white)
        judged = _judge_variance(image.astype(np.float64), variance, true.astype(np.float64), I0)
        judged_scores = judged.scores(unclipped)
        scores |= dict.fromkeys(judged_scores, math.nan) if broken else judged_scores
    if moving is not None:
        scores["moving"] = {
            "share": float(moving.mean()),
            "mse": math.nan if broken else float(mse(shown, true, moving)),
        }
    return scores


class _JudgedVariance(NamedTuple):
    """Errors of an image beside its variance.

    Attributes:
        z2: (height, width) squared errors of ln(I + I0) over the predicted variance.
        nll: (height, width) -ln p(I) of the true intensity, nats.
        usable: (height, width) mask of known variances.
    """

    z2: NDArray[np.float64]
    nll: NDArray[np.float64]
    usable: NDArray[np.bool_]

    def scores(self, mask: NDArray[np.bool_]) -> Scores:
        """Compute the scores of the variance over a mask (height, width)."""
        where = mask & self.usable
        return {
            "z2": _mean_over(self.z2, where, np.mean),
            "z2_median": _mean_over(self.z2, where, np.median),
            "nll": _mean_over(self.nll, where, np.mean),
        }


def _judge_variance(
    image: NDArray[np.float64],
    variance: NDArray[np.floating],
    truth: NDArray[np.float64],
    I0: float,
) -> _JudgedVariance:
    """Compare the errors of ln(I + I0) with the predicted variance.

    Args:
        image: (height, width) intensity.
        variance: (height, width) variance, of the type that the image was computed in.
        truth: (height, width) true intensity.
        I0: Offset inside the logarithm.

    Returns:
        The errors.
    """
    # L = ln(I + I0) cannot be known better than I is rounded.
    least = max(float(np.finfo(variance.dtype).eps) * I0, 1e-12)
    L, true_L = (np.log(np.maximum(part + I0, least)) for part in (image, truth))
    usable = np.isfinite(variance) & (variance > 0)
    P = np.where(usable, variance, 1).astype(np.float64)
    z2 = (L - true_L) ** 2 / P
    # p(I) = N(ln(I + I0); L, P) / (I + I0)
    return _JudgedVariance(z2, 0.5 * (z2 + np.log(2 * math.pi * P)) + true_L, usable)


def _mean_over(values: NDArray, mask: NDArray[np.bool_], mean: Callable[[NDArray], Any]) -> float:
    """Average values over a mask.

    Args:
        values: Values of any shape.
        mask: Truth values of that shape.
        mean: Function of (n,) values that returns their average.

    Returns:
        The average; NaN over an empty mask.
    """
    return float(mean(values[mask])) if mask.any() else math.nan


def _hdr_measures(
    image: NDArray,
    variance: NDArray | None,
    truth: NDArray[np.float64],
    clip: tuple[float, float],
    I0: float,
    *,
    measures: Measures,
    recording: str,
) -> Scores:
    """Score an image against an HDR reference.

    Args:
        image: (height, width) intensity.
        variance: (height, width) variance of ln(I + I0); None to leave it out.
        truth: (height, width) intensity, NaN where there is none.
        clip: Intensities below and above which frames clip.
        I0: Offset inside the logarithm.
        measures: Further measures.
        recording: Name of the recording for messages.

    Returns:
        The scores by name, NaN where they are not known.
    """
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
    for name in measures.names:
        pair = (shown, covered)
        if name == "lpips":  # it looks at what a display shows
            pair = tuple(np.clip(part, 0, 1) for part in log_display(shown, covered))
        scores[name] = float(MEASURE_FUNCTIONS[name](*pair))
    if not broken:
        scores |= measures.of_own(shown, covered, recording)
    else:
        scores |= {metric.name: math.nan for metric in measures.own}
    parts: dict[str, dict[str, float | int]] = {
        name: {
            "pixels": int(mask.sum()),
            "mse": float(mse(shown, covered, mask)),
            "log_mse": float(log_mse(shown, covered, where=mask)),
        }
        for name, mask in masks.items()
    }
    if variance is not None:
        judged = _judge_variance(shown, variance, covered, I0)
        scores |= judged.scores(known)
        for name, mask in masks.items():
            parts[name]["z2"] = judged.scores(mask)["z2"]
    if broken:
        scores = dict.fromkeys(scores, math.nan)
        parts = {
            name: {**dict.fromkeys(part, math.nan), "pixels": part["pixels"]}
            for name, part in parts.items()
        }
    return {**scores, "regions": parts}


def _as_list(scores: list[Scores]) -> dict[str, Any]:
    """Collect the values of all images, one list per measure; None where not a number."""
    if not scores:
        return {}

    def gather(values: list[Any]) -> Any:
        if isinstance(values[0], dict):
            return {name: gather([value[name] for value in values]) for name in values[0]}
        return [finite(value) for value in values]

    return gather(scores)


def _average_frames(per_frame: Mapping[str, Any]) -> dict[str, Any]:
    """Average the lists in `per_frame` over images; those of regions over pixels."""

    def mean(values: list[float | None], weights: list[Any] | None = None) -> float | None:
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
        elif name == "moving":
            means[name] = {
                "share": mean(values["share"]),
                "mse": mean(values["mse"], values["share"]),
            }
        elif name != "t":
            means[name] = mean(values)
    return means


def subset(row: Mapping[str, Any], frames: ArrayLike) -> dict[str, Any]:
    """Return the row of `score` for some of its images, without reconstructing any.

    Args:
        row: The row of all images.
        frames: Mask over the images, bool, or their numbers.

    Returns:
        The row; `seconds` stays that of all images.

    Raises:
        InputError: There is no image of a number, or a mask has another length.
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
    return {**row, **_average_frames(per_frame), "frames": len(rows), "per_frame": per_frame}


@dataclasses.dataclass(frozen=True)
class Sample:
    """An image of those requested, at `t` (us, as stamped), and the truth, NaN where unknown."""

    t: int
    image: NDArray[np.floating]
    truth: NDArray[np.floating]
    hdr: bool
    deviation: NDArray[np.floating] | None = None  # of log intensity, where it is estimated
    given: NDArray[np.floating] | None = None  # the last frame before


def _frame_before(given: Recording, t: int) -> NDArray[np.float32] | None:
    """Return the last given frame up to a time.

    Args:
        given: The recording.
        t: Time, us, as frames are stamped.

    Returns:
        (H, W) intensity; None if there is no such frame.
    """
    if given.frames is None:
        return None
    row = int(np.searchsorted(given.frames.t, t, "right")) - 1
    return given.linear_frames[row : row + 1].intensity[0] if row >= 0 else None


def score(
    recording: Recording,
    method: ImageEstimator | ExternalImages | MethodFunction,
    params: FrameParams | None = None,
    protocol: str = "held-out",
    *,
    metrics: Iterable[str | Metric | Callable] = (),
    normalise: Normalise = "none",
    gap: int = DEFAULT_GAP_FRAMES,
    moving: bool = False,
    progress: bool | None = None,
) -> dict[str, Any]:
    """Reconstruct the images that `protocol` asks for, and compare: one row of a table of results.

    Memory does not grow with the recording's length. With "held-out" intensities are clipped to
    [0, 1] before they are compared. `mse`, `ssim` and those of `metrics` (names in
    `MEASURE_FUNCTIONS`, or functions of one's own: see `jaxevent.runs.own`) are means over the
    images. `seconds` is the time of reconstructing and reading images, with compilation but
    without scoring. What is not a number is None. `per_frame` lists t (us, as stamped) and every
    measure of every image.
    "authors_ssim" and "masked_mse" are what the programs of the AKF's authors compute (Wang et
    al., TPAMI 2023: the whole image as one window; pixels without reference count as right),
    "matlab_ssim" is MATLAB's `ssim`.

    With "held-out" every `gap`-th frame is given and all others are hidden; a gap other than 2 is
    in the row. Without `params` clock and thresholds are calibrated from the frames and events
    given, where the method combines them; `calibrated` in the row names those found. With `moving`
    rows have also `moving`: the `share` of pixels where something moves, and the `mse` over these.
    There the given frames before and after differ by more than 0.05 of white. Nothing is known to
    move after the last frame given.

    Where the method estimates a variance, `z2` is the mean of (error of ln(I + I0))^2 / variance,
    over all pixels, 1 for honest variances, and `z2_median` the mean over images of its median,
    then 0.45 if errors are Gaussian. `nll` is the mean of -ln p of the true intensities, if
    ln(I + I0) is Gaussian. Pixels of hidden frames that are black, or white but
    for noise, do not count.

    Rows of "reference" have also `log_mse` and `log_ssim`; `clip`, the bounds of the `regions`
    "bright", "dark" and "well"; and of each of those its `share` of all pixels and, over its pixels
    of all images, `mse`, `log_mse` and, where there is a variance, `z2`. "lpips" is that of
    ln(I + 0.003), clipped to the truth's range.

    With `normalise` "affine", which is then in the row, the brightness of each image is fitted to
    the truth first (`external.fit_brightness`), and no variance is judged. Of `ExternalImages`
    images, taken for those of `recording.name`, `missing` is how many were asked for in vain, and
    `seconds` is None.

    Raises `InputError` for a recording that the protocol or the method cannot use, for unknown
    metrics and for those whose extra is missing.
    """
    options = ScoringOptions(protocol, tuple(metrics), normalise, gap, moving)
    return score_and_sample(recording, method, params, options, progress)[0]


@dataclasses.dataclass(frozen=True)
class ScoringOptions:
    """The images requested from a method, and their scoring; see `score`."""

    protocol: str = "held-out"
    metrics: tuple[str | Metric | Callable, ...] = ()
    normalise: str = "none"
    gap: int = DEFAULT_GAP_FRAMES
    moving: bool = False
    # Names of parameters that are calibrated; None: where no parameters are given, those left open.
    calibrate: tuple[str, ...] | None = None
    measures: Measures = dataclasses.field(init=False)

    def __post_init__(self):
        check_normalise(self.normalise)
        if self.moving and self.protocol != "held-out":
            raise InputError(f"the protocol {self.protocol!r} gives all frames; omit moving")
        object.__setattr__(self, "measures", Measures.of(self.metrics, self.protocol))


class ImageProtocol(Protocol):
    """A protocol that asks for images; its name is a key of `protocols.PROTOCOLS`."""

    settings = {
        "metrics": METRICS_CHECK,
        "optional_metrics": (is_texts, 'a list of names, as ["lpips"]'),
        "calibrate": CALIBRATE_CHECK,
    }
    own = {
        "normalise": (lambda value: value in get_args(Normalise), "'none' or 'affine'"),
        "calibrate": CALIBRATE_CHECK,
    }
    sources = {ExternalImages.name: ExternalImages, PublishedResults.name: PublishedResults}

    def __init__(self, name: str):
        self.name = name

    def check(self, options: Mapping[str, Any]) -> None:
        Measures.of(options.get("metrics", ()), self.name)
        for name in options.get("optional_metrics", ()):
            check_choice(name, "metric", list(MEASURE_FUNCTIONS))

    def available(self, options: Mapping[str, Any]) -> dict[str, Any]:
        found = dict(options)
        names = list(found.get("metrics", ()))
        for name in found.pop("optional_metrics", ()):
            with contextlib.suppress(InputError):
                check_extras([name])
                names.append(name)
        return {**found, "metrics": list(dict.fromkeys(names))} if names else found

    def label(self, options: Mapping[str, Any]) -> str:
        gap = options.get("gap", DEFAULT_GAP_FRAMES)
        hidden = "" if gap == DEFAULT_GAP_FRAMES else f", gap {gap}"
        fitted = "" if options.get("normalise", "none") == "none" else ", brightness fitted"
        return hidden + fitted

    def score(
        self,
        recording: Recording,
        method: ImageEstimator | ExternalImages | MethodFunction,
        params: FrameParams | None,
        options: Mapping[str, Any],
        progress: bool | None = None,
    ) -> dict[str, Any]:
        row, samples = score_and_sample(
            recording,
            method,
            params,
            ScoringOptions(
                self.name,
                tuple(options.get("metrics", ())),
                options.get("normalise", "none"),
                options.get("gap", DEFAULT_GAP_FRAMES),
                options.get("moving", False),
                tuple(options.get("calibrate", ())),
            ),
            progress,
            external_name(Path(recording.name)),
        )
        return {**row, "samples": samples}


class HeldOut(ImageProtocol):
    """The protocol that hides frames; `gap` and `moving` as in `score`."""

    settings = {
        **ImageProtocol.settings,
        "gap": (is_gap, GAP_DOMAIN),
        "moving": FLAG_CHECK,
    }


def score_and_sample(
    recording: Recording,
    method: ImageEstimator | ExternalImages | MethodFunction,
    params: FrameParams | None,
    options: ScoringOptions,
    progress: bool | None,
    name: str | None = None,
) -> tuple[dict[str, Any], list[Sample]]:
    """Score a method as `score` does, and return some images too.

    `name` finds external images.
    """
    given, hidden = divide(recording, options.protocol, options.gap)
    measures, normalise = options.measures, options.normalise
    named: dict[str, Any] = {"measures": measures, "recording": recording.name}
    hdr = hidden if isinstance(hidden, Reference) else None
    seconds, estimated = 0.0, False  # whether the method estimates a variance
    values: dict[str, Any]
    calibrated: list[str] = []
    if isinstance(method, ExternalImages):
        estimates = _read_external_images(given, hidden, method, name or recording.name)
        values, I0 = method.values(), 0.0
    elif isinstance(method, MethodFunction):
        estimates = _estimate_by_function(given, hidden, method)
        values, I0 = {}, 0.0
    else:
        chosen, calibrated = _calibrate(given, method, params, options.calibrate)
        estimates = _estimate_hidden_images(given, hidden, method, chosen, progress)
        values, I0 = values_of(chosen), float(chosen.I0)
    scores: list[Scores] = []
    t: list[int] = []
    samples: list[Sample] = []
    chosen_rows = spread_rows(len(hidden), MAX_SAMPLES)
    clock = time.perf_counter()  # after calibration, which costs the first method alone
    for first, images, variances in estimates:
        seconds += time.perf_counter() - clock
        if not scores:
            estimated = normalise == "none" and not np.isnan(variances).all()
        for row, (image, variance) in enumerate(zip(images, variances, strict=True), first):
            frame = hidden[row : row + 1]
            truth = frame.intensity[0] if hdr is None else hdr.truth(row)
            if normalise == "affine":
                image = fit_brightness(image, truth)
            P = variance if estimated else None
            if hdr is None:
                where = moving_pixels(given, row, options.gap) if options.moving else None
                scores.append(hidden_scores(image, P, frame, I0, where, **named))
            else:
                scores.append(_hdr_measures(image, P, truth, hdr.clip, I0, **named))
            t.append(int(hidden.t[row]))
            if row in chosen_rows:
                deviation = None if P is None else np.sqrt(P)
                before = _frame_before(given, t[-1])
                samples.append(
                    Sample(t[-1], image.copy(), truth, hdr is not None, deviation, before)
                )
        clock = time.perf_counter()
    external = isinstance(method, ExternalImages)
    per_frame = {"t": t, **_as_list(scores)}
    row = {
        "recording": recording.name,
        "method": method.name,
        **_average_frames(per_frame),
        **({} if hdr is None else {"clip": list(hdr.clip)}),
        "frames": len(scores),
        **({"missing": len(hidden) - len(scores)} if external else {}),
        "events": len(recording.events),
        "seconds": None if external else seconds,
        **({} if normalise == "none" else {"normalise": normalise}),
        **({} if options.gap == DEFAULT_GAP_FRAMES else {"gap": options.gap}),
        **own_names(measures.own),
        **({"calibrated": calibrated} if calibrated else {}),
        "params": values,
        "per_frame": per_frame,
    }
    return row, samples


def _calibrate(
    given: Recording,
    method: ImageEstimator,
    params: FrameParams | None,
    names: Sequence[str] | None,
) -> tuple[FrameParams, list[str]]:
    """Return the parameters of a method on a recording, and the names that it determined."""
    if names is None:
        names = method.names_left_open({}) if params is None else ()
    params = params or method.Params()
    found = calibrated_values(given, params, names).found
    return params.replace(**found), list(found)


def moving_pixels(given_recording: Recording, frame_row: int, gap_frames: int) -> NDArray[np.bool_]:
    """Find the pixels in which the given frames around a hidden one differ.

    Args:
        given_recording: A recording with all its frames.
        frame_row: Row of the hidden frame.
        gap_frames: As of `frames_around`.

    Returns:
        (H, W) mask; false where no given frame follows.
    """
    assert given_recording.frames is not None
    around = frames_around(given_recording.frames, frame_row, gap_frames)
    if around is None:
        return np.zeros((given_recording.height, given_recording.width), bool)
    before, after = given_recording.linear_frames[around[0] : around[1] + 1].intensity
    return np.abs(after - before) > MIN_MOTION_CHANGE


# The number of the first image, and some images with their variances, each (images, height, width).
Estimates = Iterator[tuple[int, NDArray[np.floating], NDArray[np.floating]]]


def _estimate_hidden_images(
    given: Recording,
    hidden: Frames,
    method: ImageEstimator,
    params: FrameParams,
    progress: bool | None,
) -> Estimates:
    video = method.estimate(given, params, progress=progress)
    first = 0
    for times, estimate in video.batches(frame_times(hidden, params), extrapolate=True):
        yield first, estimate.mean, estimate.covariance
        first += len(times)


def _estimate_by_function(given: Recording, hidden: Frames, method: MethodFunction) -> Estimates:
    shape = (given.height, given.width)
    found = method.estimate(given, hidden.t, [shape], intensity=True)
    variance = found.covariance
    if variance is None:
        variance = np.full(found.mean.shape, np.nan)
    elif variance.shape != found.mean.shape:
        raise InputError(
            f"{given.name}: the method {method.name!r} returned variances of shape "
            f"{variance.shape}; return those of all pixels, {found.mean.shape}"
        )
    yield 0, found.mean, variance


def _read_external_images(
    given: Recording, hidden: Frames, method: ExternalImages, name: str
) -> Estimates:
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
