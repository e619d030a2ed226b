"""Fits and scores of reconstruction methods.

They are fitted to images hidden from the method, or to the likelihood of the frames that it gets. A
recording is cut into time windows (or taken whole), each prepared once: a `RecordingWindow`.
`Problem` turns the windows of a method into the batches of `jaxevent.optimise`, `Objective` is its
loss.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import NDArray

from jaxevent.errors import InputError
from jaxevent.parameters import Parameters, check_choice
from jaxevent.processes import REMOTE_BATCH
from jaxevent.reconstruction.augment import FrameParams, calibrated_values
from jaxevent.reconstruction.estimator import ImageEstimator, PreparedImages
from jaxevent.reconstruction.features import Numeric
from jaxevent.recording import Frames, Recording
from jaxevent.runs.config import (
    NAME_CHECK,
    NOT_NEGATIVE_CHECK,
    POSITIVE_CHECK,
    is_number,
)
from jaxevent.runs.family import SPLIT_NAMES, Family, FitData, Goal, LastBatches, interleave
from jaxevent.runs.protocols import (
    DEFAULT_GAP_FRAMES,
    GAP_DOMAIN,
    PROTOCOLS,
    Reference,
    divide,
    frame_times,
    is_gap,
)
from jaxevent.runs.scores import HeldOut, ImageProtocol, score, subset
from jaxevent.show.tables import Column, Row, legend, markdown_table, results_table
from jaxevent.tuning import Batches

ERROR_KINDS = ("linear", "log", "nll")
REGION_NAMES = ("dark", "well", "bright")
LIKELIHOOD_COLUMNS: list[Column] = [("NLL", "nll", 1, 4)]


class TruthLimits(NamedTuple):
    """Range of intensity that true images show.

    Attributes:
        black: (images, 1) least intensity.
        white: (images, 1) greatest intensity.
        least_white: (images, 1) intensity from which a pixel may be white and noise.
    """

    black: Float[Numeric, "images 1"]
    white: Float[Numeric, "images 1"]
    least_white: Float[Numeric, "images 1"]


class ImageBatch(eqx.Module):
    """A batch: images as a function of parameters, the true images, and the weights of values."""

    prepared: PreparedImages
    truth: Float[Numeric, "times pixels"]  # intensity, 0 where unknown
    weights: Float[Numeric, "times #pixels"]  # 0 where there is no truth
    limits: TruthLimits
    weight: Float[Numeric, ""]  # of this batch's mean among those of other batches


class LikelihoodBatch(eqx.Module):
    """A batch for the likelihood of frames."""

    features: Any  # inputs of the method's `run`
    weight: Float[Numeric, ""]  # number of measured frame pixels


@dataclasses.dataclass(frozen=True)
class Objective:
    """The loss of a reconstruction method, a mean over pixels: `objective(params, batch)`.

    `error` compares images with the truth I: "linear" is the squared difference, "log" that of
    ln(I + dark_offset), "nll" the negative log likelihood of I if ln(I + I0) is Gaussian with the
    method's mean L and variance P. With `error` None the loss is minus the method's own log
    likelihood of the frames it was given, per frame and pixel. `clipped` says that the truth shows
    all beyond its limits as these.
    """

    method: ImageEstimator
    error: str | None = "linear"
    clipped: bool = True
    dark_offset: float | int = 0.003

    def __post_init__(self):
        if self.error is None:
            if not self.method.has_likelihood:
                raise InputError(
                    f"the method {self.method.name!r} has no likelihood; choose another loss or "
                    "the method 'aks' or 'events-only'"
                )
        elif self.error == "nll" and not self.method.has_covariance:
            raise InputError(
                f"the method {self.method.name!r} estimates no variance, which the error 'nll' "
                "needs; choose 'linear' or 'log'"
            )

    def __call__(self, params: FrameParams, batch: Any) -> Float[Array, ""]:
        if self.error is None:
            return self._of_frames(params, batch)
        counted, each = self._weighted_errors(params, batch)
        return counted.sum() / (batch.weights.sum() * each)

    @property
    def likelihood(self) -> bool:
        """True if it is the mean of -ln p over measurements."""
        return self.error in (None, "nll")

    def parts(
        self, params: FrameParams, batch: Any
    ) -> tuple[Float[Array, " parts"], Float[Array, " parts"]]:
        """Compute the loss and the weight of every image.

        Args:
            params: Parameters of the method.
            batch: `ImageBatch`, or for the likelihood `LikelihoodBatch`.

        Returns:
            Losses and weights, (images,) each; the likelihood of frames is one part.
        """
        if self.error is None:
            return self._of_frames(params, batch)[None], jnp.ones(1)
        counted, each = self._weighted_errors(params, batch)
        weights = batch.weights.sum(1) * each
        return counted.sum(1) / jnp.where(weights > 0, weights, 1), weights

    def _of_frames(self, params: FrameParams, batch: LikelihoodBatch) -> Array:
        """Compute -ln p of the frames given, per frame and pixel."""
        return -self.method.log_likelihood(params, batch.features) / batch.weight  # ty: ignore[missing-attribute]

    def _weighted_errors(self, params: FrameParams, batch: ImageBatch) -> tuple[Array, int]:
        """Compute the weighted errors of images.

        Args:
            params: Parameters of the method.
            batch: The images.

        Returns:
            (times, pixels) errors, and the number of pixels that share a weight.
        """
        surprising = self.error == "nll"
        image, variance, _ = batch.prepared(params, variance=surprising)
        if not self.method.is_absolute:
            image, variance = self._scale(params, image, variance, batch)
        if surprising:
            errors = self._negative_log_density(params, image, variance, batch)
        else:
            errors = self._difference(image, batch) ** 2
        counted = jnp.where(batch.weights > 0, batch.weights * errors, 0)
        return counted, batch.truth.shape[1] // batch.weights.shape[1]

    def _scale(
        self, params: FrameParams, image: Array, variance: Array, batch: ImageBatch
    ) -> tuple[Array, Array]:
        """Fit offset and factor of each log image to the truth, by least squares.

        Args:
            params: `I0`, the offset inside the logarithm.
            image: (times, pixels) intensities.
            variance: (times, pixels) variances, (ln I)^2.
            batch: Truth and weights.

        Returns:
            The scaled images and variances.
        """
        L, truth = jnp.log(image + params.I0), jnp.log(batch.truth + params.I0)
        weights = jnp.broadcast_to(batch.weights, L.shape)
        total = jnp.maximum(weights.sum(1, keepdims=True), 1)
        mean, level = ((weights * v).sum(1, keepdims=True) / total for v in (L, truth))
        spread = (weights * (L - mean) ** 2).sum(1, keepdims=True)
        factor = (weights * (L - mean) * (truth - level)).sum(1, keepdims=True)
        factor = factor / jnp.where(spread > 0, spread, 1)
        image = jnp.exp(level + factor * (L - mean)) - params.I0
        return image, factor**2 * variance

    def _difference(self, image: Array, batch: ImageBatch) -> Array:
        """Compute image minus truth, linear or logarithmic.

        Evaluation clips images to what the truth can show. Clipped, a pixel beyond white has no
        gradient, and as it is, a hot pixel's exp(L) outweighs all others. So intensity beyond white
        grows with its logarithm from there on, with the same slope at white. Where the truth itself
        is clipped, what lies beyond is no error; where it is white but for noise, no more than
        white is one. The result is never smaller than the evaluated error, equals it for images in
        [0, white], and has a slope wherever it is not 0, but for that.

        Args:
            image: (times, pixels) intensity.
            batch: The true images, and their limits.

        Returns:
            (times, pixels) intensity, or ln I.
        """
        black, white, least_white = batch.limits
        truth = batch.truth
        over = image > white
        beyond = jnp.log(jnp.where(over, image, white) / white)
        if self.clipped:
            beyond = jnp.where(truth >= least_white, 0, beyond)
        image = jnp.where(over, white * (1 + beyond), image)
        if self.error == "log":
            difference = self._log(image) - self._log(truth)
        else:
            difference = image - truth
        if self.clipped:
            difference = jnp.where(truth <= black, jnp.maximum(difference, 0), difference)
        return difference

    def _log(self, image: Array) -> Array:
        """Compute ln(I + dark_offset) - ln(dark_offset), continued below black as an odd function.

        exp(L) - I0 may be negative; the slope stays continuous and no value is -inf.
        """
        return jnp.sign(image) * jnp.log1p(jnp.abs(image) / self.dark_offset)

    def _negative_log_density(
        self, params: FrameParams, image: Array, variance: Array, batch: ImageBatch
    ) -> Array:
        """Compute -ln p(I) of the truth, p(I) = N(ln(I + I0); L, P) / (I + I0).

        The Jacobian 1 / (I + I0) makes values of different I0 comparable: without it, the best I0
        is infinite. A clipped truth counts with the probability of all that lies beyond it.

        Args:
            params: `I0`, the offset inside the logarithm.
            image: (times, pixels) intensities exp(L) - I0.
            variance: (times, pixels) P, (ln I)^2.
            batch: The true images, and their limits.

        Returns:
            (times, pixels).
        """
        truth, (black, _, least_white) = batch.truth, batch.limits
        L, seen = jnp.log(image + params.I0), jnp.log(truth + params.I0)
        z = (seen - L) / jnp.sqrt(variance)
        surprise = 0.5 * (z**2 + jnp.log(2 * math.pi * variance)) + seen
        if self.clipped:
            surprise = jnp.where(truth >= least_white, -jax.scipy.stats.norm.logcdf(-z), surprise)
            surprise = jnp.where(truth <= black, -jax.scipy.stats.norm.logcdf(z), surprise)
        return surprise


@dataclasses.dataclass(frozen=True)
class RecordingWindow:
    """A window of a recording: the method's input, and the true images in it."""

    recording: Recording
    truth: Frames  # of the whole recording
    rows: NDArray[np.int64]  # (images,), those of the truth in the window
    split: NDArray[np.int64]  # (images,), index in SPLIT_NAMES of each; -1: not used


def cut_windows(
    recording: Recording,
    protocol: str,
    split: Sequence[int] = (1, 0, 0),
    window: float | int | None = None,
    warm_up: float | int = 0.2,
    gap: int = DEFAULT_GAP_FRAMES,
) -> list[RecordingWindow]:
    """Cut a recording into windows.

    The true images are those that the protocol hides (`jaxevent.runs.protocols`), shared out by
    `interleave`. A window's images are those stamped in it. Windows without events or frames are
    left out.

    Args:
        recording: Events and frames.
        protocol: Name of the protocol.
        split: Shares of the images for fit, validation and test.
        window: Length of a window, s; None: one window, the whole recording.
        warm_up: Time that is prepared before and after a window, s: a filter needs it before, to
            forget its initial state, and the augmented frame and the smoother use frames after.
        gap: Every gap-th frame is given.

    Returns:
        The windows.

    Raises:
        InputError: The protocol cannot use the recording.
    """
    given, truth = divide(recording, protocol, gap)
    use = interleave(split, len(truth))
    if window is None:
        return [RecordingWindow(given, truth, np.arange(len(truth)), use)]
    length, margin = round(window * 1e6), round(warm_up * 1e6)
    found = []
    for t0 in range(recording.start, recording.stop + 1, length):
        rows = np.arange(*np.searchsorted(truth.t, [t0, t0 + length]))
        span = slice(t0 - margin, t0 + length + margin)
        if given.events.index(span.start) == given.events.index(span.stop):
            continue
        part = given[span]
        if part.frames is None and given.frames is not None:
            continue
        found.append(RecordingWindow(part, truth, rows, use[rows]))
    return found


class Problem:
    """The batches of a method's fit and of its validation: `problem(params)`.

    Of several processes each prepares its own parts; in place of the others' batches are
    `processes.REMOTE_BATCH`.

    They are prepared when first asked for and again for params that differ in what preparation
    fixes (`ImageEstimator.preparation_key`). `weights` are those of dark, well exposed and bright
    pixels of HDR references, told apart by their `clip`; omitted, 1.
    """

    def __init__(
        self,
        objective: Objective,
        fit: Iterable[RecordingWindow],
        validation: Iterable[RecordingWindow] = (),
        weights: Mapping[str, float | int] | None = None,
    ):
        self.objective, self.weights = objective, weights
        # Parts of the fitted recordings also hold the images set apart for validation.
        self._jobs = [(part, (0, 1)) for part in fit] + [
            (dataclasses.replace(part, split=np.where(part.split == 0, 1, -1)), (1,))
            for part in validation
        ]
        # One number of images for all windows of a split, so that one shape is compiled.
        self._rooms = [
            max([int((part.split == s).sum()) for part, _ in self._jobs], default=0) for s in (0, 1)
        ]
        self._last = LastBatches(objective.method.preparation_key, self._prepare)

    def __call__(self, params: FrameParams) -> Batches:
        """Return the batches to fit to, and those to validate on."""
        return self._last(params)

    def _prepare(self, params: FrameParams) -> Batches:
        batches: tuple[list[Any], list[Any]] = ([], [])
        for number, (part, splits) in enumerate(self._jobs):
            used = self._used(part, splits)
            mine = number % jax.process_count() == jax.process_index()
            made = self._batches(part, used, params) if mine and used else []
            for s, batch in made if mine else [(s, REMOTE_BATCH) for s in used]:
                batches[s].append(batch)
        return batches

    def _used(self, part: RecordingWindow, splits: Sequence[int]) -> Sequence[int]:
        """Return the splits that have a batch of the window."""
        if self.objective.error is None:
            # Only the frames given are measured, whatever the hidden ones are for.
            return splits[: 1 if part.recording.frames else 0]
        return [s for s in splits if (part.split == s).any()]

    def _batches(
        self, part: RecordingWindow, splits: Sequence[int], params: FrameParams
    ) -> list[tuple[int, Any]]:
        method, dtype = self.objective.method, np.dtype(jnp.result_type(float))
        if self.objective.error is None:
            features, _ = method.prepare(part.recording, np.empty(0, np.int64), params)
            assert part.recording.frames is not None
            frames = len(part.recording.frames)
            count = np.asarray(frames * part.recording.width * part.recording.height, dtype)
            return [(splits[0], LikelihoodBatch(features, count))]
        times = frame_times(part.truth, params)[part.rows]
        prepared = method.prepare_images(part.recording, times, params, extrapolate=True)
        found = []
        for s in splits:
            places = np.flatnonzero(part.split == s)
            padded = np.resize(places, self._rooms[s])  # repeated images count nothing
            truth = _intensity(part.truth, part.rows[places]).astype(dtype)
            weights = self._weigh(part, truth)
            limits = [
                np.resize(one, (len(padded), 1)).astype(dtype)
                for one in _limits(part.truth, part.rows[places], truth)
            ]
            spare = [(0, len(padded) - len(places)), (0, 0)]
            batch = ImageBatch(
                prepared.take(padded),
                np.pad(np.nan_to_num(truth), spare),
                np.pad(weights, spare),
                TruthLimits(*limits),
                np.asarray(weights.sum(dtype=float) * truth.shape[1] / weights.shape[1], dtype),
            )
            found.append((s, jax.device_put(batch)))
        return found

    def _weigh(self, part: RecordingWindow, truth: NDArray) -> NDArray:
        """Weigh the pixels of images.

        Args:
            part: The window of the images.
            truth: (images, pixels) intensity, NaN where there is no truth.

        Returns:
            (images, 1) of 1, or (images, pixels) weights by region, 0 where there is no truth.
        """
        if not isinstance(part.truth, Reference):
            return np.ones((len(truth), 1), truth.dtype)
        low, high = part.truth.clip
        region = (truth >= low).astype(int) + (truth > high)
        weights = [
            1 if self.weights is None else self.weights.get(name, 1) for name in REGION_NAMES
        ]
        return np.where(np.isnan(truth), 0, np.array(weights, truth.dtype)[region])


def _intensity(truth: Frames, rows: NDArray[np.int64]) -> NDArray:
    """Read some of the true images.

    Args:
        truth: The true images.
        rows: (images,) rows of those wanted.

    Returns:
        (images, pixels) intensity, NaN where there is no truth.
    """
    if isinstance(truth, Reference):
        return np.stack([truth.truth(int(row)).ravel() for row in rows])
    return truth[rows].intensity.reshape(len(rows), -1)


def _limits(truth: Frames, rows: NDArray[np.int64], intensity: NDArray) -> TruthLimits:
    """Return the range of intensity that true images show.

    Args:
        truth: The true images.
        rows: (images,) rows of those wanted.
        intensity: (images, pixels) their intensity.

    Returns:
        The limits; of references from 0 to the brightest pixel of all, at least 1.
    """
    if isinstance(truth, Reference):
        white = np.full((len(rows), 1), max(1.0, float(np.nanmax(intensity, initial=0))))
        return TruthLimits(0 * white, white, white)
    black, white = truth.limits[rows].T[:, :, None]
    return TruthLimits(black, white, truth.least_white[rows, None])


@dataclasses.dataclass(frozen=True)
class ImageGoal(Goal):
    """The goal of a method of reconstruction."""

    method: ImageEstimator
    loss: Objective
    protocol: str
    warm_up: float | int  # s, prepared before and after a window
    weights: Mapping[str, float | int] | None  # of `REGION_NAMES`, without unit
    gap: int = DEFAULT_GAP_FRAMES

    @property
    def part_name(self) -> str:
        return "window" if self.loss.error is None else "image"

    @property
    def measure(self) -> str:
        if self.loss.error == "nll":
            return "nll"
        return "log_mse" if self.loss.error == "log" and self.protocol == "reference" else "mse"

    def calibrate(self, data: FitData, params: FrameParams, names: Sequence[str]) -> FrameParams:
        found: dict[str, list[float]] = {}
        for _, recording in data.sources["fit"] if names else ():
            given, _ = divide(recording, self.protocol, self.gap)
            for name, value in calibrated_values(given, params, names).found.items():
                found.setdefault(name, []).append(value)
        return params.replace(**{name: float(np.median(one)) for name, one in found.items()})

    def problem(self, data: FitData) -> Problem:
        cut = functools.partial(
            cut_windows,
            protocol=self.protocol,
            split=data.split or (1, 0, 0),
            window=data.window,
            warm_up=self.warm_up,
            gap=self.gap,
        )
        found: dict[str, list] = {}
        for name in ("fit", "validation"):
            found[name] = []
            for _, recording in data.sources[name]:
                self.method.check(recording)
                found[name] += cut(recording)
        return Problem(self.loss, found["fit"], found["validation"], self.weights)

    def score(
        self, data: FitData, params: FrameParams, progress: bool | None
    ) -> Iterator[dict[str, Any]]:
        for whole, given, recording in data:
            row = score(
                recording, self.method, params, self.protocol, gap=self.gap, progress=progress
            )
            row["recording"] = given
            if data.split is None:
                yield {**row, "split": SPLIT_NAMES[whole]}
                continue
            shared = interleave(data.split, row["frames"])
            if self.loss.error is None:  # no image was looked at
                shared[:] = SPLIT_NAMES.index("test")
            for place, name in enumerate(SPLIT_NAMES):
                if (shared == place).any():
                    yield {**subset(row, np.flatnonzero(shared == place)), "split": name}

    def table(self, rows: Sequence[Row]) -> str:
        return markdown_table(rows, LIKELIHOOD_COLUMNS)


@dataclasses.dataclass(frozen=True)
class EventGoal(Goal):
    """The goal of a method of reconstruction that predicts events by others; no truth is needed."""

    method: ImageEstimator
    loss: Objective
    measure: ClassVar[str] = "nll"

    def problem(self, data: FitData) -> Callable[[FrameParams], Batches]:
        def prepare(params: FrameParams) -> Batches:
            batches: tuple[list[Any], list[Any]] = ([], [])
            for name, shares in (("fit", data.split), ("validation", (0, 1, 0))):
                for _, recording in data.sources[name]:
                    for s, times in _window_times(recording, shares or (1, 0, 0), data.window):
                        if s < len(batches):
                            batches[s].append(self._batch(recording, times, params))
            return batches

        return LastBatches(self.method.preparation_key, prepare)

    def _batch(
        self, recording: Recording, times: NDArray[np.int64], params: FrameParams
    ) -> LikelihoodBatch:
        features = self.method.prepare_likelihood(recording, times, params)  # ty: ignore[missing-attribute]
        count = np.asarray(features.count, np.dtype(jnp.result_type(float)))
        return jax.device_put(LikelihoodBatch(features, count))

    def score(
        self, data: FitData, params: FrameParams, progress: bool | None
    ) -> Iterator[dict[str, Any]]:
        for whole, given, recording in data:
            shares = tuple(int(s == whole) for s in range(len(SPLIT_NAMES)))
            for s, times in _window_times(recording, data.split or shares, data.window):
                batch = self._batch(recording, times, params)
                nll = float(jax.jit(self.loss)(params, batch))
                yield {
                    "recording": given,
                    "split": SPLIT_NAMES[s],
                    "windows": len(times),
                    "events": int(batch.weight),
                    "nll": nll,
                }

    def table(self, rows: Sequence[Row]) -> str:
        columns = [*LIKELIHOOD_COLUMNS, ("windows", "windows", 1, 0), ("events", "events", 1, 0)]
        return results_table(rows, columns) + legend(columns)


N_LIKELIHOOD_WINDOWS = 8  # of a recording, where their distance is not given


def _window_times(
    recording: Recording, split: Sequence[int], window: float | int | None
) -> Iterator[tuple[int, NDArray[np.int64]]]:
    """Spread windows evenly over a recording.

    Args:
        recording: The recording.
        split: Shares of the windows for fit, validation and test.
        window: Distance of the windows, s; None: `N_LIKELIHOOD_WINDOWS` of them.

    Yields:
        The index in `SPLIT_NAMES` and the times of its windows, us, of each split that has any.
    """
    span = recording.stop - recording.start
    count = N_LIKELIHOOD_WINDOWS if window is None else max(round(span / (window * 1e6)), 1)
    times = recording.start + (np.arange(count) + 0.5) * (span / count)
    shared = interleave(split, count)
    for s in range(len(SPLIT_NAMES)):
        if (shared == s).any():
            yield s, times[shared == s].astype(np.int64)


class Reconstruction(Family):
    """The methods that make images."""

    protocols = {"held-out": HeldOut("held-out"), "reference": ImageProtocol("reference")}

    fit_settings = {
        "loss": NAME_CHECK,
        "protocol": NAME_CHECK,
        "error": NAME_CHECK,
        "dark_offset": POSITIVE_CHECK,
        "weights": (
            lambda value: (
                isinstance(value, dict)
                and set(value) <= set(REGION_NAMES)
                and all(is_number(n) and n >= 0 for n in value.values())
            ),
            "a table of numbers named dark, well, bright",
        ),
        "warm_up": NOT_NEGATIVE_CHECK,
        "gap": (is_gap, GAP_DOMAIN),
    }
    own = ("loss", "error")

    def goal(self, method: ImageEstimator, params: Parameters, settings: Mapping[str, Any]) -> Goal:
        if not method.differentiable:
            raise InputError(
                f"the method {method.name!r} has no gradients and cannot be fitted; fit another, "
                "or compare its settings by a grid in an evaluation"
            )
        loss = check_choice(settings.get("loss", "held-out"), "loss", [*PROTOCOLS, "likelihood"])
        protocol = loss
        if loss == "likelihood" and method.measures_events:
            if "protocol" in settings:
                raise InputError("the likelihood of events compares with no images; omit protocol")
            return EventGoal(method, Objective(method, None))
        if loss == "likelihood":
            protocol = check_choice(
                settings.get("protocol", "held-out"), "protocol", list(PROTOCOLS)
            )
        elif settings.get("protocol", loss) != loss:
            raise InputError(f"the loss {loss!r} has the protocol of that name; omit protocol")
        error = check_choice(settings.get("error", "linear"), "error", ERROR_KINDS)
        weights, gap = settings.get("weights"), settings.get("gap", DEFAULT_GAP_FRAMES)
        if "gap" in settings and protocol != "held-out":
            raise InputError("gap is for frames that are hidden, the protocol 'held-out'; omit it")
        if weights is not None and protocol != "reference":
            raise InputError("weights are for HDR references, the loss 'reference'; omit them")
        objective = Objective(
            method,
            None if loss == "likelihood" else error,
            protocol == "held-out",
            settings.get("dark_offset", 0.003),
        )
        return ImageGoal(method, objective, protocol, settings.get("warm_up", 0.2), weights, gap)


FAMILY = Reconstruction()
