"""What the tracker is fitted to: the likelihood of events, or positions that are known.

Settings of the method "blob" in a configuration of `jaxevent.runs.fit`:

    loss = "likelihood"                 # of events, each predicted before it is used; or
                                        # "positions": distance from given ones
    events = "all"                      # or "associated"; see `tracker.negative_log_likelihood`
    seeds = [[30.0, 40.0, 8.0]]         # x, y, size in px (and s) of each target; omitted: those
                                        # of the positions, or without any, tracks are born
    positions = "*.csv"                 # beside each recording, * being its name without suffix

A method may have its own loss and events. Positions are a table with the columns t (s), x, y (px)
and, of more than one target, id, as `jaxevent track` and `jaxevent simulate --truth` write them;
further columns are left out. Targets by rising id are those of the seeds in their order.

A recording is cut into windows of `window` seconds. If neither validation nor test is given, they
are shared out: with `split` = [2, 1, 1], of every 4 windows in turn 2 are to fit, 1 to validate and
1 to test; then `window` is by default an eighth of the recording. In every window tracking begins
anew: with the seeds in a first one, and later where the positions are, or where tracks with the
parameters that the fit starts from are. So windows should be longer than tracks take to settle.

Results: `nll`, the mean over events of -ln p (1/px^2, as "all"), over the windows; of tracks of the
whole recording `rmse` and `median`, of the distances from the positions (px), and `covered`, the
share of the positions at which the track was alive.
"""

import dataclasses
import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
import pandas as pd
from jaxtyping import Array, Float
from numpy.typing import NDArray

from jaxevent.blob.prepare import Features
from jaxevent.blob.tracker import (
    Params,
    Positions,
    negative_log_likelihood,
    position_error,
    prepare,
    prepare_positions,
    track,
)
from jaxevent.devices import shared_out
from jaxevent.errors import InputError
from jaxevent.io.output import finite, values_of
from jaxevent.parameters import nearest
from jaxevent.recording import Recording
from jaxevent.runs.config import read_params
from jaxevent.show.report import aligned
from jaxevent.splits import SPLITS, windows

LOSSES = ("likelihood", "positions")
EVENTS = ("all", "associated")

# Parameters that act when events are packed, and those of decisions, which have no gradient.
PACKED = ("cycle", "prefilter_time")
DECISIVE = (
    "surround",
    *("gate", "gate_decay", "gate_min", "gate_max", "gate_position"),
    *("tau_birth", "n_birth", "n_confirm", "t_confirm", "t_tentative", "t_coast", "t_merge"),
    *("aspect_max", "sigma_max"),
)

Sources = Mapping[str, Sequence[tuple[str, Recording]]]
Share = tuple[int, ...] | None


class Batch(eqx.Module):
    """A window: packed events, with positions if the loss needs them."""

    features: Features | Positions
    weight: Float[np.ndarray | Array, ""]  # number of events or positions


@dataclasses.dataclass(frozen=True)
class Loss:
    """A mean over events (-ln p) or positions (px^2): `loss(params, batch)`."""

    name: str = "likelihood"
    events: str = "all"

    def __call__(self, params: Params, batch: Batch) -> Float[Array, ""]:
        if isinstance(batch.features, Positions):
            return position_error(params, batch.features)
        return negative_log_likelihood(params, batch.features, self.events)


@dataclasses.dataclass(frozen=True)
class Known:
    """Given positions: times (T,) us, xi (T, targets, 2) in px, NaN where not known."""

    t: NDArray[np.int64]
    xi: NDArray[np.float64]


class Part(NamedTuple):
    """A window of a recording, of times in us, and how tracking begins in it."""

    recording: Recording
    start: int
    stop: int
    seeds: list[tuple[float, float, float, int]] | None  # x, y, size; 0: lambda0, and time (us)
    known: Known | None  # of the targets of these seeds
    split: int  # the place in SPLITS


def read_positions(path: str | Path) -> Known:
    """Positions from a table; see the text of this module.

    Raises `InputError` for a file that cannot be read and for missing columns or numbers.
    """
    path = Path(path)
    try:
        table = pd.read_csv(path)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the path") from None
    except ValueError as error:
        raise InputError(f"{path}: is no table ({error}); give columns t, x, y") from None
    missing = [name for name in ("t", "x", "y") if name not in table.columns]
    if missing:
        raise InputError(f"{path}: has no column {missing[0]!r}; give the columns t (s), x, y (px)")
    for name in ("t", "x", "y", *(["id"] if "id" in table.columns else [])):
        numbers = np.asarray(pd.to_numeric(table[name], errors="coerce"), np.float64)
        if not np.isfinite(numbers).all():
            row = int(np.argmin(np.isfinite(numbers)))
            raise InputError(
                f"{path}: {name} is {str(table[name][row])[:40]!r} in line {row + 2}; give a "
                "number, or leave the line out"
            )
    if not len(table):
        raise InputError(f"{path}: holds no positions; give lines of t, x, y")
    us = np.rint(table["t"].to_numpy(np.float64) * 1e6).astype(np.int64)
    number = table["id"].to_numpy() if "id" in table.columns else np.zeros(len(us), np.int64)
    t, row = np.unique(us, return_inverse=True)
    targets, column = np.unique(number, return_inverse=True)
    xi = np.full((len(t), len(targets), 2), np.nan)
    xi[row, column] = table[["x", "y"]].to_numpy(np.float64)
    return Known(t, xi)


@dataclasses.dataclass(frozen=True)
class Goal:
    """How the tracker is fitted and scored; `jaxevent.runs.fit.Goal` describes the methods."""

    start: Params
    loss: Loss
    seeds: tuple[tuple[float, ...], ...] | None
    positions: str | None
    prepared = (*PACKED, *DECISIVE)
    # Loss and gradient by 2 numbers of 4,000 events in steps of 16: forwards 37 ms, in reverse 310.
    forward = True

    def files(self, recording: Path) -> list[Path]:
        if self.positions is None:
            return []
        name = recording.name if recording.is_dir() else recording.stem
        return [recording.with_name(self.positions.replace("*", name))]

    def problem(
        self, sources: Sources, split: Share, window: float | int | None
    ) -> Callable[[Params], tuple[list[Batch], list[Batch]]]:
        found = [part for part in self._parts(sources, split, window) if part.split < 2]
        if self.loss.name == "positions":
            found = [p for p in found if p.known is not None and np.isfinite(p.known.xi).any()]
        prepared: tuple[Any, Any] = (None, None)

        def batches(params: Params) -> tuple[list[Batch], list[Batch]]:
            nonlocal prepared
            fixed = tuple(float(getattr(params, name)) for name in PACKED)
            if prepared[0] != fixed:
                prepared = (None, None)  # so that two are never held at once
                packed = jax.device_put(self._packed(found, params, self.loss.name))
                pairs = list(zip(found, packed, strict=True))
                by_split = tuple(
                    shared_out([b for part, b in pairs if part.split == s]) for s in (0, 1)
                )
                prepared = fixed, by_split
            return prepared[1]

        return batches

    def score(
        self,
        sources: Sources,
        split: Share,
        window: float | int | None,
        params: Params,
        progress: bool,
    ) -> Iterator[dict[str, Any]]:
        found = self._parts(sources, split, window)
        packed = self._packed(found, params, "likelihood")
        for place, (given, recording) in (
            (place, source) for place, name in enumerate(SPLITS) for source in sources[name]
        ):
            errors = self.errors(recording, params, progress)
            of_this = [
                (part, batch)
                for part, batch in zip(found, packed, strict=True)
                if part.recording is recording and (split is not None or part.split == place)
            ]
            for k, name in enumerate(SPLITS):
                mine = [(part, batch) for part, batch in of_this if part.split == k]
                if not mine:
                    continue
                weights = np.array([batch.weight for _, batch in mine])
                nll = [float(_likelihood(params, batch.features)) for _, batch in mine]
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

    def table(self, rows: Sequence[Mapping[str, Any]]) -> str:
        columns = [("NLL", "nll", 1, 4), ("windows", "windows", 1, 0), ("events", "events", 1, 0)]
        if any("rmse" in row for row in rows):
            columns[1:1] = [("RMSE px", "rmse", 1, 3), ("median px", "median", 1, 3)]
            columns[3:3] = [("covered", "covered", 1, 3)]
        return aligned(rows, columns)

    def _known(self, recording: Recording) -> Known | None:
        """The positions of a recording, those in the time of its events."""
        for path in self.files(Path(recording.name)):
            known = read_positions(path)
            targets = known.xi.shape[1]
            if self.seeds is not None and len(self.seeds) != targets:
                raise InputError(
                    f"{path}: holds {targets} targets, but there are {len(self.seeds)} seeds; "
                    "give one for each, by rising id, or leave out the seeds"
                )
            first, stop = _reach(recording)
            inside = (first <= known.t) & (known.t < stop)
            if not inside.any():
                raise InputError(
                    f"{path}: no position is within {first * 1e-6:g} to {stop * 1e-6:g} s, the "
                    f"events' time in {recording.name}; times are seconds on its clock"
                )
            return Known(known.t[inside], known.xi[inside])
        return None

    def errors(
        self, recording: Recording, params: Params, progress: bool
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]] | None:
        """Time (us) and distance (px) of all known positions; NaN where the track is not alive."""
        known = self._known(recording)
        if known is None:
            return None
        seeds = self._first_seeds(known, params)
        tracks = track(recording, params, seeds, progress=progress)
        found = [states.mean[..., :2] for _, states in tracks.batches(known.t)]
        distance = np.linalg.norm(np.concatenate(found) - known.xi, axis=2)
        given = np.isfinite(known.xi).all(2)
        return np.broadcast_to(known.t[:, None], given.shape)[given], distance[given]

    def _first_seeds(self, known: Known | None, params: Params) -> list[Any] | None:
        """Where tracking of a whole recording begins; None: tracks are born."""
        if self.seeds is not None:
            return [tuple(seed) for seed in self.seeds]
        if known is None:
            return None
        size = float(params.lambda0)
        first = int(known.t[0])
        return [_at(known, k, first, size) for k in range(known.xi.shape[1])]

    def _parts(self, sources: Sources, split: Share, window: float | int | None) -> list[Part]:
        """The windows of all recordings, those without events left out."""
        found = []
        for place, (_, recording) in (
            (place, source) for place, name in enumerate(SPLITS) for source in sources[name]
        ):
            known = self._known(recording)
            first, stop = _reach(recording)
            spans = windows(first, stop, window, split, place)
            cuts = self._seeds(recording, known, np.array([begin for begin, _, _ in spans]))
            for (begin, end, s), seeds in zip(spans, cuts, strict=True):
                index = recording.events.index
                if index(begin) < index(end):
                    found.append(_part(recording, begin, end, seeds, known, s))
        return found

    def _seeds(
        self, recording: Recording, known: Known | None, begins: NDArray
    ) -> Sequence[list[tuple[float, float, float, int]] | None]:
        """Of every window: for each target x, y, size (0: lambda0) and time; NaN: not there."""
        if self.seeds is None and known is None:
            return [None] * len(begins)
        first = int(begins[0])
        if known is not None:
            sizes = [0.0] * known.xi.shape[1] if self.seeds is None else [s[2] for s in self.seeds]
            cuts = [
                [_at(known, k, int(begin), size) for k, size in enumerate(sizes)]
                for begin in begins
            ]
        else:
            assert self.seeds is not None
            tracks = track(recording, self.start, list(self.seeds))
            means = tracks(begins).mean.tolist()
            cuts = [
                [(x, y, size, int(begin)) for x, y, _, _, size, *_ in rows]
                for begin, rows in zip(begins, means, strict=True)
            ]
        if self.seeds is not None:
            given = [
                (s[0], s[1], s[2], first if len(s) < 4 else round(s[3] * 1e6)) for s in self.seeds
            ]
            cuts = [
                [g if g[3] >= begin else s for g, s in zip(given, cut, strict=True)]
                for begin, cut in zip(begins, cuts, strict=True)
            ]
        return cuts

    def _packed(self, found: Sequence[Part], params: Params, loss: str) -> list[Batch]:
        """Batches of one shape, so that one program serves all."""
        batches, used = [], [1, 1, 0, 0]
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
                batch = features = prepare(part.recording, params, seeds, **span)
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
        return [Batch(_filled(b, f, used), weight) for b, f, weight in batches]


def _reach(recording: Recording) -> tuple[int, int]:
    """The first event's time and that after the last, us."""
    events, count = recording.events, len(recording.events)
    if not count:
        raise InputError(f"{recording.name}: holds no events; choose another recording")
    return int(events[:1].t[0]), int(events[count - 1 : count].t[0]) + 1


def _at(known: Known, target: int, begin: int, size: float) -> tuple[float, float, float, int]:
    """The seed of a target from a time on: there, or where it is seen first; NaN after the last."""
    seen = np.isfinite(known.xi[:, target]).all(1)
    t, xi = known.t[seen], known.xi[seen, target]
    if t[-1] < begin:
        return np.nan, np.nan, size, begin
    at = max(begin, int(t[0]))
    x, y = (float(np.interp(at, t, xi[:, axis])) for axis in (0, 1))
    return x, y, size, at


def _part(
    recording: Recording, start: int, stop: int, seeds: Any, known: Known | None, split: int
) -> Part:
    """A window with the seeds that begin in it on the sensor, and their positions since then."""
    if seeds is None:
        return Part(recording, start, stop, None, None, split)
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
        known = Known(t, xi)
    return Part(recording, start, stop, chosen, known, split)


def _filled(batch: Features | Positions, f: Features, used: Sequence[int]) -> Any:
    """The batch with `f` in it, with chunks, steps, seeds and times that do not count."""
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
    features = dataclasses.replace(f, seed=fill(f.seed, seeds, value=-1), **fields)
    if isinstance(batch, Features):
        return features
    one = {name: fill(getattr(batch, name), times) for name in ("chunk", "step", "time")}
    two = {name: fill(getattr(batch, name), times, seeds) for name in ("xi", "known")}
    return Positions(features, **one, **two)


_likelihood = jax.jit(functools.partial(negative_log_likelihood, events="all"))


def _is_seed(value: Any) -> bool:
    numbers = isinstance(value, list) and len(value) in (3, 4)
    return numbers and all(type(n) in (int, float) and np.isfinite(n) for n in value)


class _Blobs:
    """The system of the method "blob", for `jaxevent.runs.fit`."""

    settings: dict[str, tuple[Callable[[Any], bool], str]] = {
        "loss": (lambda value: isinstance(value, str), "text"),
        "events": (lambda value: value in EVENTS, '"all" or "associated"'),
        "seeds": (
            lambda value: (
                isinstance(value, list)
                and len(value) > 0
                and all(_is_seed(one) and one[2] > 0 for one in value)
            ),
            "a list of [x, y, size], in px, or [x, y, size, t], t in s",
        ),
        "positions": (
            lambda value: isinstance(value, str) and value != "",
            'the name of tables beside the recordings, as "*.csv"',
        ),
    }
    own = ("loss", "events")

    def start(self, name: str, given: Any, folder: Path) -> Params:
        return read_params(Params, name, given, folder)

    def goal(self, name: str, params: Any, given: Mapping[str, Any]) -> Goal:
        loss = given.get("loss", "likelihood")
        if loss not in LOSSES:
            raise InputError(f"there is no loss {loss!r}; {nearest(loss, LOSSES)}")
        positions = given.get("positions")
        if loss == "positions" and positions is None:
            raise InputError(
                "the loss 'positions' needs tables of them; give their name beside the "
                'recordings, as positions = "*.csv"'
            )
        seeds = given.get("seeds")
        return Goal(
            params,
            Loss(loss, given.get("events", "all")),
            None if seeds is None else tuple(tuple(map(float, seed)) for seed in seeds),
            positions,
        )


BLOB = _Blobs()
