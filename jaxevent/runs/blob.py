"""Fits of trackers: to the likelihood of events, or to known positions.

Settings of trackers in a configuration of `jaxevent.runs.fit`:

    loss = "likelihood"                 # of events, each predicted before it is used; or
                                        # "positions": distance from given ones
    events = "all"                      # or "associated"; see `losses.negative_log_likelihood`
    seeds = [[30.0, 40.0, 8.0]]         # x, y, size in px (and s) of each target
    positions = "*.csv"                 # beside each recording, * being its name without suffix
    begin = "found"                     # without seeds tracks begin at the "positions", the default
                                        # where there are some, or else as in jaxevent track: at
                                        # targets that are "found", with the parameters that suit
                                        # them; or they are "born" of events that gather

A method may have its own loss and events. Positions are as in `jaxevent.runs.blob_scores`.

A recording is cut into windows of `window` seconds. If neither validation nor test is given, they
are shared out: with `split` = [2, 1, 1], of every 4 windows in turn 2 are to fit, 1 to validate and
1 to test; then `window` is by default an eighth of the recording. In every window tracking begins
anew: with the seeds in a first one, and later where the positions are, where found targets are, or
where tracks with the parameters that the fit starts from are. So windows should be longer than
tracks take to settle. Parameters of found targets differ between them, but for those that are
fitted: these have one value.

Results: `nll`, the mean over events of -ln p (1/px^2, as "all"), over the windows; of tracks of the
whole recording `rmse` and `median`, of the distances from the positions (px), and `covered`, the
share of the positions at which the track was alive.
"""

import dataclasses
import functools
import statistics
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import NDArray

from jaxevent.blob import (
    TargetSearchResult,
    Tracker,
    TrackerParams,
    find,
    negative_log_likelihood,
    position_error,
    prepare_positions,
)
from jaxevent.blob.losses import PositionBatch
from jaxevent.blob.owners import NO_OWNER_INDEX
from jaxevent.blob.prepare import Features, packing_key
from jaxevent.errors import InputError
from jaxevent.io.output import finite, values_of
from jaxevent.parameters import Parameters, check_choice
from jaxevent.recording import Recording
from jaxevent.runs.blob_scores import (
    TARGET_SETTINGS,
    TRACK_BEGINNINGS,
    KnownPositions,
    Targets,
    TrackProtocol,
    seed_from_positions,
)
from jaxevent.runs.config import NAME_CHECK
from jaxevent.runs.family import (
    SPLIT_NAMES,
    Family,
    FitData,
    Goal,
    LastBatches,
    batches_by_split,
    windows,
)
from jaxevent.show.tables import Row, legend, results_table
from jaxevent.tuning import Batches

LOSS_NAMES = ("likelihood", "positions")
EVENT_CHOICES = ("all", "associated")


class Batch(eqx.Module):
    """A window: packed events, with positions if the loss needs them."""

    features: Features | PositionBatch
    weight: Float[np.ndarray | Array, ""]  # number of events or positions


@dataclasses.dataclass(frozen=True)
class TrackLoss:
    """A mean over events (-ln p) or positions (px^2): `loss(params, batch)`."""

    tracker: Tracker
    name: str = "likelihood"
    events: str = "all"

    @property
    def likelihood(self) -> bool:
        """True if it is the mean of -ln p over events."""
        return self.name == "likelihood"

    def __call__(self, params: TrackerParams, batch: Batch) -> Float[Array, ""]:
        if isinstance(batch.features, PositionBatch):
            return position_error(self.tracker, params, batch.features)
        return negative_log_likelihood(self.tracker, params, batch.features, self.events)


class TrackWindow(NamedTuple):
    """A window of a recording, in us, and the start of tracking in it."""

    recording: Recording
    start: int
    stop: int
    seeds: list[tuple[float, float, float, int]] | None  # x, y, size; 0: lambda0, and time (us)
    known: KnownPositions | None  # of the targets of these seeds
    split: int  # index in SPLIT_NAMES
    found: TargetSearchResult | None = None  # in place of seeds


@dataclasses.dataclass(frozen=True)
class TrackGoal(Goal):
    """The goal of a tracker."""

    tracker: Tracker
    start: TrackerParams
    loss: TrackLoss
    targets: Targets
    begin: str | None = None  # "found", "born" or None: where seeds or positions are
    fitted: tuple[str, ...] = ()  # names that are fitted or searched
    _searches: dict[int, TargetSearchResult] = dataclasses.field(
        default_factory=dict, compare=False, repr=False
    )
    # Kernels pass once for each number in either mode; XLA compiles the forward one sooner.
    forward = True

    @property
    def measure(self) -> str:
        """Key of the error in a row: "rmse" of positions, or "nll"."""
        return "rmse" if self.loss.name == "positions" else "nll"

    def files(self, recording: Path) -> list[Path]:
        return self.targets.files(recording)

    def calibrate(self, data: FitData, params: TrackerParams, names: Sequence[str]) -> Any:
        if not names:
            return params
        usual = self._usual_settings(data)
        return params.replace(**{name: usual[name] for name in names if name in usual})

    def problem(self, data: FitData) -> Callable[[TrackerParams], Batches]:
        found = [part for part in self._cut_windows(data) if part.split < 2]
        if self.loss.name == "positions":
            found = [p for p in found if p.known is not None and np.isfinite(p.known.xi).any()]
        usual = self._usual_settings(data)

        def make(params: TrackerParams) -> Batches:
            batches = self._pack(found, params, self.loss.name, usual)
            return batches_by_split(found, jax.device_put(batches))

        return LastBatches(packing_key, make)

    def score(
        self, data: FitData, params: TrackerParams, progress: bool | None
    ) -> Iterator[dict[str, Any]]:
        found = self._cut_windows(data)
        packed = self._pack(found, params, "likelihood", self._usual_settings(data))
        for place, given, recording in data:
            errors = self.targets.errors(recording, self.tracker, params, progress)
            of_this = [
                (part, batch)
                for part, batch in zip(found, packed, strict=True)
                if part.recording is recording and (data.split is not None or part.split == place)
            ]
            for k, name in enumerate(SPLIT_NAMES):
                mine = [(part, batch) for part, batch in of_this if part.split == k]
                if not mine:
                    continue
                weights = np.array([batch.weight for _, batch in mine])
                nll = [
                    float(_likelihood(self.tracker, params, batch.features)) for _, batch in mine
                ]
                row: dict[str, Any] = {
                    "recording": given,
                    "split": name,
                    "nll": finite(float(np.average(nll, weights=weights))),
                }
                if errors is not None:
                    t, distance = errors
                    inside = np.zeros(len(t), bool)
                    for part, _ in mine:
                        inside |= (part.start <= t) & (t < part.stop)
                    alive = distance[inside & np.isfinite(distance)]
                    row["rmse"] = finite(float(np.sqrt(np.mean(alive**2)))) if len(alive) else None
                    row["median"] = finite(float(np.median(alive))) if len(alive) else None
                    row["covered"] = len(alive) / inside.sum() if inside.any() else None
                row["windows"] = len(mine)
                row["events"] = int(weights.sum())
                yield {**row, "params": values_of(params)}

    def table(self, rows: Sequence[Row]) -> str:
        columns = [("NLL", "nll", 1, 4), ("windows", "windows", 1, 0), ("events", "events", 1, 0)]
        if any("rmse" in row for row in rows):
            columns[1:1] = [("RMSE px", "rmse", 1, 3), ("median px", "median", 1, 3)]
            columns[3:3] = [("covered", "covered", 1, 3)]
        return results_table(rows, columns) + legend(columns)

    def _cut_windows(self, data: FitData) -> list[TrackWindow]:
        """Cut all recordings into windows, and leave out those without events."""
        found = []
        for place, _, recording in data:
            known = self.targets.known(recording)
            first, last = recording.event_span()
            spans = windows(first, last + 1, data.window, data.split, place)
            cuts = self._seeds(recording, known, np.array([begin for begin, _, _ in spans]))
            for (begin, end, s), seeds in zip(spans, cuts, strict=True):
                index = recording.events.index
                if index(begin) == index(end):
                    continue
                part = _cut_window(recording, begin, end, seeds, known, s)
                if self.begin == "found":
                    part = part._replace(found=self._find(recording).crop(begin, end))
                if part.found is None or len(part.found):
                    found.append(part)
        return found

    def _find(self, recording: Recording) -> TargetSearchResult:
        """Find the targets of a recording, once.

        Raises:
            InputError: There is none.
        """
        if id(recording) not in self._searches:
            self._searches[id(recording)] = find(recording, progress=False)
        found = self._searches[id(recording)]
        if not len(found):
            raise InputError(
                f"{recording.name}: no target was found to fit to; give seeds, or positions, or "
                'begin = "born" for tracks that begin wherever events gather'
            )
        return found

    def _usual_settings(self, data: FitData) -> dict[str, Any]:
        """Return the settings that suit the found targets of the recordings to fit."""
        if self.begin != "found":
            return {}
        each = [self._find(recording).settings() for _, recording in data.sources["fit"]]
        return {name: statistics.median_low([one[name] for one in each]) for name in each[0]}

    def _seeds(
        self, recording: Recording, known: KnownPositions | None, begins: NDArray
    ) -> Sequence[list[tuple[float, float, float, int]] | None]:
        """Return the seeds of every window.

        Args:
            recording: The recording.
            known: True positions of the targets, or None.
            begins: (windows,) begins of the windows, us.

        Returns:
            For every window x and y (px; NaN where a target is absent), size (px; 0: lambda0) and
                time (us)
            of each target; None where targets are detected.
        """
        if self.targets.seeds is None and known is None:
            return [None] * len(begins)
        given = [
            (s[0], s[1], s[2], int(begins[0]) if len(s) < 4 else round(s[3] * 1e6))
            for s in self.targets.seeds or ()
        ]
        if known is not None:
            sizes = [s[2] for s in given] or [0.0] * known.xi.shape[1]
            cuts = [
                [seed_from_positions(known, k, int(begin), size) for k, size in enumerate(sizes)]
                for begin in begins
            ]
        elif all(s[3] >= begins[-1] for s in given):  # none begins before a window
            return [given for _ in begins]
        else:
            tracks = self.tracker.estimate(
                recording, self.start, seeds=self.targets.seeds, smooth=False, progress=False
            )
            means = tracks(begins).mean.tolist()
            cuts = [
                [(x, y, size, int(begin)) for x, y, _, _, size, *_ in rows]
                for begin, rows in zip(begins, means, strict=True)
            ]
        if not given:
            return cuts
        return [
            [g if g[3] >= begin else s for g, s in zip(given, cut, strict=True)]
            for begin, cut in zip(begins, cuts, strict=True)
        ]

    def _pack(
        self,
        found: Sequence[TrackWindow],
        params: TrackerParams,
        loss: str,
        usual: Mapping[str, Any],
    ) -> list[Batch]:
        """Pack the windows into batches of one shape, so that one program serves all.

        Args:
            found: The windows.
            params: Parameters of the tracker.
            loss: "likelihood" or "positions".
            usual: Settings of found targets; where the parameters have them, each target has its
                own.

        Returns:
            The batches.
        """
        batches, used = [], [1, 1, 0, 0]
        no_times = np.empty(0, np.int64)
        for part in found:
            seeds = part.seeds
            if seeds is not None:
                seeds = [(x, y, size or 1.0, at) for x, y, size, at in seeds]
            span: dict[str, Any] = {"start": part.start, "stop": part.stop}
            if loss == "positions":
                assert seeds is not None and part.known is not None
                batch = prepare_positions(
                    part.recording, params, seeds, part.known.t, part.known.xi, **span
                )
                features, times = batch.features, len(batch.time)
                weight = batch.known.sum()
            else:
                features, _ = self.tracker.prepare(
                    part.recording, no_times, params, seeds=seeds, found=part.found,
                    detect=True if self.begin == "born" else None, **span,
                )  # fmt: skip
                if part.found is not None:
                    own = part.found.per_target_values(params, usual)
                    own = {name: own[name] for name in own if name not in self.fitted}
                    features = dataclasses.replace(features, overrides=own)
                batch = features
                weight, times = features.valid.sum(), 0
            if seeds is not None and part.seeds is not None:
                # A size that is not given is lambda0, which can be fitted.
                order = np.argsort([s[3] for s in seeds], kind="stable")
                own = np.array([s[2] for s in part.seeds])[order]
                sizes = np.where(own == 0, 0, features.seed_size).astype(features.xi.dtype)
                features = dataclasses.replace(features, seed_size=sizes)
            cycles = np.flatnonzero(features.cycle)
            last = int(cycles[-1]) + 1 if len(cycles) else len(features.t)
            shape = last, features.t.shape[1], len(features.seed), times
            used = [max(pair) for pair in zip(used, shape, strict=True)]
            batches.append((batch, features, np.asarray(weight, features.xi.dtype)))
        return [Batch(_pad_batch(b, f, used), weight) for b, f, weight in batches]


def _cut_window(
    recording: Recording,
    start: int,
    stop: int,
    seeds: Any,
    known: KnownPositions | None,
    split: int,
) -> TrackWindow:
    """Cut a window, with the seeds that begin in it on the sensor.

    Args:
        recording: The recording.
        start: Begin of the window, us.
        stop: Its end, us.
        seeds: x, y, size (px) and time (us) of each target; None where targets are detected.
        known: True positions of the targets, or None.
        split: Index in `SPLIT_NAMES`.

    Returns:
        The window.
    """
    if seeds is None:
        return TrackWindow(recording, start, stop, None, None, split)
    right, low = recording.width - 0.5, recording.height - 0.5
    here = [
        k
        for k, (x, y, _, at) in enumerate(seeds)
        if -0.5 <= x <= right and -0.5 <= y <= low and start <= at < stop
    ]
    chosen = [seeds[k] for k in here]
    if known is not None:
        rows = slice(*np.searchsorted(known.t, [start, stop]))
        t, xi = known.t[rows], known.xi[rows][:, here].copy()
        for k, seed in enumerate(chosen):
            xi[t < seed[3], k] = np.nan
        known = KnownPositions(t, xi)
    return TrackWindow(recording, start, stop, chosen, known, split)


def _pad_batch(batch: Features | PositionBatch, f: Features, used: Sequence[int]) -> Any:
    """Pad a batch with chunks, steps, seeds and times that do not count.

    Args:
        batch: The batch.
        f: Its features.
        used: Numbers of chunks, steps, seeds and times after padding.

    Returns:
        The padded batch.
    """
    chunks, steps, seeds, times = used

    def fill(array: Any, *sizes: int, value: Any = 0) -> NDArray:
        array = np.asarray(array)[: sizes[0]]
        ends = [(0, size - n) for size, n in zip(sizes, array.shape, strict=False)]
        rest = [(0, 0)] * (array.ndim - len(sizes))
        return np.pad(array, [*ends, *rest], constant_values=value)

    fields: dict[str, Any] = {
        name: fill(getattr(f, name), chunks, steps) for name in ("t", "xi", "polarity", "valid")
    }
    fields |= {name: fill(getattr(f, name), chunks) for name in ("elapsed", "stop", "cycle")}
    fields |= {name: fill(getattr(f, name), seeds) for name in ("seed_xi", "seed_size")}
    fields["overrides"] = {name: fill(values, seeds) for name, values in f.overrides.items()}
    if f.owner is not None:
        fields["owner"] = fill(f.owner, chunks, steps, value=NO_OWNER_INDEX)
    features = dataclasses.replace(f, seed=fill(f.seed, seeds, value=-1), **fields)
    if isinstance(batch, Features):
        return features
    one = {name: fill(getattr(batch, name), times) for name in ("chunk", "step", "time")}
    two = {name: fill(getattr(batch, name), times, seeds) for name in ("xi", "known")}
    return PositionBatch(features, **one, **two)


_likelihood = jax.jit(
    functools.partial(negative_log_likelihood, events="all"), static_argnames="tracker"
)


class Blobs(Family):
    """The trackers of blobs."""

    protocols = {"tracks": TrackProtocol()}

    fit_settings = {
        "loss": NAME_CHECK,
        "events": (lambda value: value in EVENT_CHOICES, '"all" or "associated"'),
        **TARGET_SETTINGS,
        "begin": (lambda value: value in TRACK_BEGINNINGS, '"positions", "found" or "born"'),
    }
    own = ("loss", "events")

    def goal(self, method: Tracker, params: Parameters, settings: Mapping[str, Any]) -> TrackGoal:
        assert isinstance(params, TrackerParams)
        loss = settings.get("loss", "likelihood")
        check_choice(loss, "loss", LOSS_NAMES)
        if loss == "positions" and settings.get("positions") is None:
            raise InputError(
                "the loss 'positions' needs tables of them; give their name beside the "
                'recordings, as positions = "*.csv"'
            )
        given = "seeds" in settings or "positions" in settings
        begin = settings.get("begin", "positions" if given else "found")
        if (begin == "positions") != given:
            raise InputError(
                "tracks begin where seeds or positions are given, or else are found or born; "
                f"begin = {begin!r} needs {'none of them' if given else 'one of them'}"
            )
        one = TrackLoss(method, loss, settings.get("events", "all"))
        fitted = (*settings.get("fit", ()), *settings.get("search", ()))
        begin = None if begin == "positions" else begin
        return TrackGoal(method, params, one, Targets.of(settings), begin, fitted)


FAMILY = Blobs()
