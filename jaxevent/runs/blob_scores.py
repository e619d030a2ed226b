"""Scores of tracks against known targets, for `jaxevent evaluate`.

Settings beside `protocol = "tracks"`:

    positions = "*.csv"                 # beside each recording, * being its name without suffix
    begin = "positions"                 # tracks begin where the positions do, of the size lambda0;
                                        # "found": `blob.find` searches them, as `jaxevent track`
                                        # does; "born": they are born where events are many
    seeds = [[30.0, 40.0, 8.0]]         # x, y, size in px (and s) of each target, in place of those
                                        # of the positions
    smooth = true                       # states use all events, if the method can; false: only
                                        # events up to each time
    reach = 10.0                        # px, largest distance of a track from its target
    pairs = [[0, 1]]                    # ids of targets at one depth, for time to contact
    extent = 0.24                       # m, of the targets; with `focal` it gives their range
    focal = 1000.0                      # px
    metrics = ["mypackage.mymodule:function"]  # your own, see `jaxevent.runs.own`
    size_factor = 0.25                  # lambda over the diameter in the image; omitted: 0.354

With "found", numbers of `params` that differ from the defaults replace those that are found.

Positions are a table with the columns t (s), x, y (px) and, if there are several targets, id, as
`jaxevent track` and `jaxevent simulate --truth` write it. The columns vx, vy (px/s), lambda1,
lambda2 (px), theta (rad), inverse_ttc (1/s) and range (m) are optional, and empty where unknown;
further columns are ignored. Targets in the order of their ids correspond to the seeds in theirs.

A row has `rmse` and `median` of the distances from the positions (px), and `covered`, the share of
the positions with a track: the target's own track if tracks begin at the positions, else the track
matched to it. `tracks`, `missed`, `false`, `switches`, `mota`, `idf1` and `hota` are described in
`jaxevent.blob.scores`. For the track of each target, where the truth is known, there are root mean
square errors: `velocity` (px/s), of the vector; `size`, of ln lambda1 and ln lambda2; `theta`
(degrees), where lambda1 exceeds 1.15 lambda2; `inverse_ttc` (1/s), by pairs, and by growth for
other targets; `range`, relative. `per_time` lists t (us) and `distance` of all targets one after
another; None where there was no track.
"""

import dataclasses
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pandas as pd
from numpy.typing import NDArray

from jaxevent.blob import Tracker, TrackerParams, find
from jaxevent.blob.quantities import SIZE_FACTORS, inverse_ttc, inverse_ttc_from_size, size_range
from jaxevent.blob.scores import score_tracks
from jaxevent.blob.track import MIN_THETA_AXIS_RATIO
from jaxevent.blob.tracks import Tracks
from jaxevent.display import format_span
from jaxevent.errors import InputError
from jaxevent.io.tables import read_table
from jaxevent.recording import Recording
from jaxevent.runs.config import (
    FLAG_CHECK,
    METRICS_CHECK,
    POSITIVE_CHECK,
    Check,
    TruthTables,
    is_numbers,
    is_table,
    truth_files,
    truth_table,
)
from jaxevent.runs.family import Protocol
from jaxevent.runs.own import MethodFunction, find_metrics, own_names

TARGET_SETTINGS: Mapping[str, Check] = {
    "seeds": (
        lambda value: (
            isinstance(value, list)
            and len(value) > 0
            and all(is_numbers(one, 3, 4) and one[2] > 0 for one in value)
        ),
        "a list of [x, y, size], in px, or [x, y, size, t], t in s",
    ),
    "positions": (
        is_table,
        'the name of tables beside the recordings, as "*.csv"',
    ),
}


# Columns of true quantities beside x, y.
OPTIONAL_COLUMNS = ("vx", "vy", "lambda1", "lambda2", "theta", "inverse_ttc", "range")


@dataclasses.dataclass(frozen=True)
class KnownPositions:
    """True positions of targets.

    Attributes:
        t: (T,) times, us.
        xi: (T, targets, 2) positions, px, NaN where unknown.
        quantities: Columns of `OPTIONAL_COLUMNS` that are given, (T, targets) each.
        id: (targets,) ids of the targets.
    """

    t: NDArray[np.int64]
    xi: NDArray[np.float64]
    quantities: Mapping[str, NDArray[np.float64]] = dataclasses.field(default_factory=dict)
    id: NDArray[Any] = dataclasses.field(default_factory=lambda: np.zeros(1, np.int64))


def read_positions(path: str | Path) -> KnownPositions:
    """Read positions from the file of a table, which the text of this module describes.

    Raises `InputError` for a file that cannot be read and for missing columns or numbers.
    """
    table = read_table(Path(path), "give columns t, x, y")
    return positions_of(table, str(path), "line", 2)


def positions_of(
    table: pd.DataFrame, path: str, row_name: str = "row", first: int = 0
) -> KnownPositions:
    """Read positions from a table with the columns that the text of this module describes.

    Args:
        table: t (s), x, y (px), and further columns.
        path: Name of the table in messages.
        row_name: Word for a row in messages.
        first: Number of the first row in messages.

    Returns:
        The positions.

    Raises:
        InputError: Columns or numbers are missing.
    """
    missing = [name for name in ("t", "x", "y") if name not in table.columns]
    if missing:
        raise InputError(f"{path}: has no column {missing[0]!r}; give the columns t (s), x, y (px)")
    more = [name for name in OPTIONAL_COLUMNS if name in table.columns]
    for name in ("t", "x", "y", *(["id"] if "id" in table.columns else []), *more):
        numbers = np.asarray(pd.to_numeric(table[name], errors="coerce"), np.float64)
        good = np.isfinite(numbers)
        if name in more:
            good |= np.asarray(table[name].isna())
        if not good.all():
            row = int(np.argmin(good))
            raise InputError(
                f"{path}: {name} is {str(table[name][row])[:40]!r} in {row_name} {row + first}; "
                f"give a number, or leave the {row_name} out"
            )
    if not len(table):
        raise InputError(f"{path}: holds no positions; give lines of t, x, y")
    us = np.rint(table["t"].to_numpy(np.float64) * 1e6).astype(np.int64)
    number = table["id"].to_numpy() if "id" in table.columns else np.zeros(len(us), np.int64)
    t, row = np.unique(us, return_inverse=True)
    targets, column = np.unique(number, return_inverse=True)
    xi = np.full((len(t), len(targets), 2), np.nan)
    xi[row, column] = table[["x", "y"]].to_numpy(np.float64)
    values = {name: np.full((len(t), len(targets)), np.nan) for name in more}
    for name, value in values.items():
        value[row, column] = table[name].to_numpy(np.float64)
    return KnownPositions(t, xi, values, targets)


@dataclasses.dataclass(frozen=True)
class Targets:
    """Targets of a configuration: seeds, and tables of positions or the name of their files."""

    seeds: tuple[tuple[float, ...], ...] | None
    positions: str | TruthTables | None

    @classmethod
    def of(cls, given: Mapping[str, Any]) -> "Targets":
        """Make targets from the settings of a configuration that `TARGET_SETTINGS` names."""
        seeds = given.get("seeds")
        seeds = None if seeds is None else tuple(tuple(map(float, seed)) for seed in seeds)
        return cls(seeds, given.get("positions"))

    def files(self, recording: Path) -> list[Path]:
        """Return the files of positions that belong to a recording."""
        if self.positions is None:
            return []
        return truth_files(self.positions, str(recording))

    def known(self, recording: Recording) -> KnownPositions | None:
        """Return the known positions in a recording within the time span of its events."""
        if self.positions is None:
            return None
        table = truth_table(self.positions, recording.name)
        if isinstance(table, Path):
            path, known = str(table), read_positions(table)
        else:
            path = f"{recording.name}: positions"
            known = positions_of(table, path)
        targets = known.xi.shape[1]
        if self.seeds is not None and len(self.seeds) != targets:
            raise InputError(
                f"{path}: holds {targets} targets, but there are {len(self.seeds)} seeds; "
                "give one for each, by rising id, or leave out the seeds"
            )
        first, last = recording.event_span()
        inside = (first <= known.t) & (known.t <= last)
        if not inside.any():
            raise InputError(
                f"{path}: no position is within {format_span((first, last + 1))}, the "
                f"events' time in {recording.name}; times are seconds on its clock"
            )
        quantities = {name: value[inside] for name, value in known.quantities.items()}
        return KnownPositions(known.t[inside], known.xi[inside], quantities, known.id)

    def first_seeds(self, known: KnownPositions | None, params: TrackerParams) -> list[Any] | None:
        """Return one seed per target, at its first known position; None if nothing is known."""
        if self.seeds is not None:
            return [tuple(seed) for seed in self.seeds]
        if known is None:
            return None
        size = float(params.lambda0)
        first = int(known.t[0])
        return [seed_from_positions(known, k, first, size) for k in range(known.xi.shape[1])]

    def errors(
        self,
        recording: Recording,
        tracker: Tracker,
        params: TrackerParams,
        progress: bool | None,
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]] | None:
        """Return times (us) of all known positions, and distances (px) of the tracks from them.

        A distance is NaN where there is no track.
        """
        known = self.known(recording)
        if known is None:
            return None
        seeds = self.first_seeds(known, params)
        tracks = tracker.estimate(recording, params, seeds=seeds, smooth=False, progress=progress)
        found = [states.mean[..., :2] for _, states in tracks.batches(known.t)]
        distance = np.linalg.norm(np.concatenate(found) - known.xi, axis=2)
        given = np.isfinite(known.xi).all(2)
        return np.broadcast_to(known.t[:, None], given.shape)[given], distance[given]


def seed_from_positions(
    known: KnownPositions, target: int, begin_us: int, size_px: float
) -> tuple[float, float, float, int]:
    """Make the seed of a target at a time, or at its first known position if that is later.

    Args:
        known: Known positions.
        target: Index of the target.
        begin_us: Time from which the target is tracked, us.
        size_px: Initial size, px.

    Returns:
        Position x and y (px), NaN after the last known one, size (px) and time (us).
    """
    seen = np.isfinite(known.xi[:, target]).all(1)
    t, xi = known.t[seen], known.xi[seen, target]
    if t[-1] < begin_us:
        return np.nan, np.nan, size_px, begin_us
    at = max(begin_us, int(t[0]))
    x, y = (float(np.interp(at, t, xi[:, axis])) for axis in (0, 1))
    return x, y, size_px, at


# Measures of every row.
MEASURE_NAMES = (
    "rmse", "median", "covered", "tracks", "missed", "false", "switches", "mota", "idf1", "hota",
    "velocity", "size", "theta", "inverse_ttc", "range",
)  # fmt: skip
TRACK_BEGINNINGS = ("positions", "found", "born")
MATCH_DISTANCE_PX = 10.0  # px, default of `reach`


def _are_pairs(value: Any) -> bool:
    return isinstance(value, list) and all(
        isinstance(one, list) and len(one) == 2 and all(type(i) is int for i in one)
        and one[0] != one[1] for one in value
    )  # fmt: skip


class TrackProtocol(Protocol):
    """Protocol that compares tracks with known targets."""

    settings: Mapping[str, Check] = {
        **TARGET_SETTINGS,
        "begin": (lambda value: value in TRACK_BEGINNINGS, '"positions", "found" or "born"'),
        "smooth": FLAG_CHECK,
        "metrics": METRICS_CHECK,
        "pairs": (_are_pairs, "a list of [id, id], two targets each"),
        **dict.fromkeys(("reach", "extent", "focal", "size_factor"), POSITIVE_CHECK),
    }

    def check(self, options: Mapping[str, Any]) -> None:
        if "positions" not in options:
            raise InputError(
                "the positions are not given, which tracks are compared with; give tables, in a "
                'configuration by positions = "*.csv" for those beside the recordings'
            )
        find_metrics(options.get("metrics", ()), MEASURE_NAMES)
        if "seeds" in options and options.get("begin", "positions") != "positions":
            raise InputError(
                f"tracks begin at the seeds or are {options['begin']}; leave out one of them"
            )
        if ("extent" in options) != ("focal" in options):
            raise InputError("a range needs both extent (m) and focal (px); give the other too")
        if "size_factor" in options and "extent" not in options:
            raise InputError("size_factor is for a range; give extent and focal too")

    def files(self, path: Path, options: Mapping[str, Any]) -> list[Path]:
        return Targets.of(options).files(path)

    def score(
        self,
        recording: Recording,
        method: Tracker | MethodFunction,
        params: TrackerParams | None,
        options: Mapping[str, Any],
        progress: bool | None = None,
    ) -> dict[str, Any]:
        targets = Targets.of(options)
        known = targets.known(recording)
        assert known is not None
        begin = options.get("begin", "positions")
        clock = time.perf_counter()
        metrics = find_metrics(options.get("metrics", ()), MEASURE_NAMES)
        noise: dict[str, Any] = {}
        if isinstance(method, MethodFunction):
            mean, covariance = _estimate_by_function(recording, method, known.t)
        else:
            params = params or method.Params()
            tracks = _track(
                recording, method, params, begin=begin, targets=targets, known=known,
                options=options, progress=progress,
            )  # fmt: skip
            mean, covariance = _read_states(tracks, known.t)
            noise = {"Q_lambda": float(tracks.params.Q_lambda), "smoothed": tracks.smooth}
        seconds = time.perf_counter() - clock
        matched = score_tracks(known.xi, mean[..., :2], options.get("reach", MATCH_DISTANCE_PX))
        own = matched.match
        # A tracker that starts at the true positions keeps their order: track k is target k's.
        if begin == "positions" and not isinstance(method, MethodFunction):
            own = np.where(np.isfinite(mean[..., 0]), np.arange(mean.shape[1]), -1)
        given = np.isfinite(known.xi).all(2)
        mean, covariance = _select_matches(mean, own), _select_matches(covariance, own)
        xi = mean[..., :2]
        distance = np.linalg.norm(xi - known.xi, axis=2)[given]
        alive = np.isfinite(distance)
        names = ("tracks", "missed", "false", "switches", "mota", "idf1", "hota")
        return {
            "rmse": _rms(distance),
            "median": float(np.median(distance[alive])) if alive.any() else None,
            "covered": float(alive.mean()),
            **{name: getattr(matched, name) for name in names},
            **_quantity_errors(
                known, mean, covariance, options, noise=noise, recording=recording.name
            ),
            **{m.name: m(xi, known.xi, recording.name) for m in metrics},
            **own_names(metrics),
            "times": len(distance),
            "events": len(recording.events),
            "seconds": seconds,
            "per_time": {
                "t": np.broadcast_to(known.t[:, None], given.shape)[given].tolist(),
                "distance": [
                    float(f"{d:.6g}") if ok else None for d, ok in zip(distance, alive, strict=True)
                ],
            },
        }


def _track(
    recording: Recording,
    method: Tracker,
    params: TrackerParams,
    *,
    begin: str,
    targets: Targets,
    known: KnownPositions,
    options: Mapping[str, Any],
    progress: bool | None,
) -> Tracks:
    """Track the targets of a recording from the beginning that the protocol states.

    Args:
        recording: The recording.
        method: The tracker.
        params: Parameters of the tracker.
        begin: "positions" for known positions, "born" for detection, "found" for a search.
        targets: Seeds of the configuration.
        known: True positions of the targets.
        options: Settings of the protocol.
        progress: Whether to show progress.

    Returns:
        The tracks.
    """
    settings: dict[str, Any] = {"smooth": None if options.get("smooth", True) else False}
    if begin == "born":
        settings["detect"] = True
    elif begin == "found":
        found = settings["found"] = find(recording, progress=progress)
        usual = method.Params().values()
        changed = {name: v for name, v in params.values().items() if v != usual[name]}
        params = method.Params(**{**found.settings(), **changed})
    else:
        settings["seeds"] = targets.first_seeds(known, params)
    return method.estimate(recording, params, **settings, progress=progress)


def _read_states(tracks: Tracks, t: NDArray[np.int64]) -> tuple[NDArray, NDArray]:
    """Read the states of tracks at times.

    Args:
        tracks: The tracks.
        t: (times,) sorted, us.

    Returns:
        Means (times, tracks, 8) and covariances (times, tracks, 8, 8), NaN where not valid.
    """
    parts = [states for _, states in tracks.batches(t)]
    mean, covariance, valid = (
        np.concatenate([np.asarray(getattr(part, name)) for part in parts])
        for name in ("mean", "covariance", "valid")
    )
    mean, covariance = np.asarray(mean, np.float64), np.asarray(covariance, np.float64)
    return (
        np.where(valid[..., None], mean, np.nan),
        np.where(valid[..., None, None], covariance, np.nan),
    )


def _select_matches(values: NDArray, match: NDArray[np.int64]) -> NDArray[np.float64]:
    """Select the values of the track that is matched to each target.

    Args:
        values: (times, tracks, ...).
        match: (times, targets) index of the track of each target, -1 for none.

    Returns:
        (times, targets, ...), NaN where there is no track.
    """
    none = np.full((len(values), 1, *values.shape[2:]), np.nan)
    values = np.concatenate([values, none], 1)
    index = match.reshape(*match.shape, *[1] * (values.ndim - 2))
    return np.take_along_axis(values, np.where(index < 0, values.shape[1] - 1, index), 1)


def _rms(error: NDArray) -> float | None:
    known = error[np.isfinite(error)]
    return float(np.sqrt(np.mean(known**2))) if len(known) else None


def _estimate_by_function(
    recording: Recording, method: MethodFunction, times: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Estimate states by a user's function.

    Args:
        recording: The recording.
        method: The function.
        times: (T,) us.

    Returns:
        States (T, tracks, 8) and covariances (T, tracks, 8, 8), NaN where unknown.
    """
    mean, covariance, _ = method.estimate(recording, times, [(-1, 2), (-1, 8)])
    states = np.full((*mean.shape[:2], 8), np.nan)
    states[..., : mean.shape[2]] = mean
    full = np.full((*mean.shape[:2], 8, 8), np.nan)
    if covariance is not None and covariance.shape == full.shape:
        full = covariance
    return states, full


def _quantity_errors(
    known: KnownPositions,
    mean: NDArray[np.float64],
    covariance: NDArray[np.float64],
    options: Mapping[str, Any],
    *,
    noise: Mapping[str, Any],
    recording: str,
) -> dict[str, float | None]:
    """Compute the errors of all quantities, other than positions, whose truth is known.

    Args:
        known: True quantities of the targets.
        mean: (times, targets, 8) states of the targets' tracks.
        covariance: (times, targets, 8, 8).
        options: Settings of the protocol.
        noise: Settings of `inverse_ttc_from_size` that describe the errors of sizes; empty where
            they are not known.
        recording: Name of the recording for messages.

    Returns:
        Root mean square errors by name: velocity in px/s, size in ln px, theta in degrees, range
        relative, inverse_ttc in 1/s.
    """
    more, out = known.quantities, {}
    if {"vx", "vy"} <= more.keys():
        out["velocity"] = _rms(np.hypot(mean[..., 2] - more["vx"], mean[..., 3] - more["vy"]))
    if {"lambda1", "lambda2"} <= more.keys():
        sizes = np.stack([more["lambda1"], more["lambda2"]], -1)
        out["size"] = _rms(np.log(mean[..., 4:6]) - np.log(np.sort(sizes)[..., ::-1]))
        if "theta" in more:
            swapped = np.where(sizes[..., 1] > sizes[..., 0], np.pi / 2, 0)
            turn = np.mod(mean[..., 6] - more["theta"] - swapped + np.pi / 2, np.pi) - np.pi / 2
            long = sizes.max(-1) > MIN_THETA_AXIS_RATIO * sizes.min(-1)
            out["theta"] = _rms(np.degrees(np.where(long, turn, np.nan)))
    if "range" in more and "extent" in options:
        factor = options.get("size_factor", SIZE_FACTORS["ring"])
        value, _ = size_range(
            jnp.asarray(mean), jnp.asarray(covariance), options["extent"], options["focal"], factor
        )
        out["range"] = _rms(np.asarray(value) / more["range"] - 1)
    if "inverse_ttc" in more:
        out["inverse_ttc"] = _rms(
            _inverse_ttc_errors(known, mean, covariance, options, noise=noise, recording=recording)
        )
    return out


def _inverse_ttc_errors(
    known: KnownPositions,
    mean: NDArray[np.float64],
    covariance: NDArray[np.float64],
    options: Mapping[str, Any],
    *,
    noise: Mapping[str, Any],
    recording: str,
) -> NDArray[np.float64]:
    """Compute the errors of 1 / TTC, from pairs of targets and from the growth of the others.

    Args:
        known: True quantities of the targets.
        mean: (times, targets, 8) states of the targets' tracks.
        covariance: (times, targets, 8, 8).
        options: Settings of the protocol, with the pairs.
        noise: Settings of `inverse_ttc_from_size`; without any, growth is left out.
        recording: Name of the recording for messages.

    Returns:
        Errors of all pairs and targets at all times, 1/s, NaN where unknown.

    Raises:
        InputError: A pair is not two of the targets.
    """
    truth, errors, ids = known.quantities["inverse_ttc"], [], known.id.tolist()
    x, P = jnp.asarray(mean), jnp.asarray(covariance)
    paired: set[int] = set()
    for pair in options.get("pairs", []):
        if not set(pair) <= set(ids):
            raise InputError(
                f"{recording}: the pair {pair} is not two of the targets known, "
                f"{', '.join(map(str, ids))}"
            )
        a, b = (ids.index(one) for one in pair)
        value, _ = inverse_ttc(x[:, a], P[:, a], x[:, b], P[:, b])
        seen = np.isfinite(mean[:, [a, b], 0]).all(1)
        errors.append(np.where(seen, np.asarray(value), np.nan) - truth[:, [a, b]].mean(1))
        paired |= {a, b}
    since = jnp.asarray((known.t - known.t[0]) * 1e-6)
    for k in set(range(len(ids))) - paired if noise else ():
        seen = np.isfinite(mean[:, k, 0])
        if seen.any():
            value, _ = inverse_ttc_from_size(since, x[:, k], P[:, k], jnp.asarray(seen), **noise)
            errors.append(np.where(seen, np.asarray(value), np.nan) - truth[:, k])
    return np.concatenate([np.zeros(0), *errors])
