"""Tracks compared with known targets, for `jaxevent evaluate`.

Settings beside `protocol = "tracks"`:

    positions = "*.csv"                 # beside each recording, * being its name without suffix
    begin = "positions"                 # tracks begin where the positions do, of the size lambda0;
                                        # "found": `blob.find` searches them, as `jaxevent track`
                                        # does; "born": they are born where events are many
    seeds = [[30.0, 40.0, 8.0]]         # x, y, size in px (and s) of each target, in place of those
                                        # of the positions
    smooth = true                       # states rest on all events, where the method can; false: on
                                        # those up to each time
    reach = 10.0                        # px up to which a track may be a target
    pairs = [[0, 1]]                    # ids of targets at one depth, which tell time to contact
    extent = 0.24                       # m, of the targets; with `focal` it tells their range
    focal = 1000.0                      # px
    metrics = ["mypackage.mymodule:function"]  # of one's own: `jaxevent.runs.own`
    size_factor = 0.25                  # lambda over the diameter in the image; omitted: 0.354

Positions are as in `jaxevent.runs.blob_positions`. With "found", numbers of `params` that are not
the defaults win over what is found.

A row has `rmse` and `median`, of the distances from the positions (px), and `covered`, the share of
the positions at which a track was there: the target's own where tracks begin at the positions, else
the one that is taken for it. Then, as `jaxevent.blob.scores` says, `tracks`, `missed`, `false`,
`switches`, `mota`, `idf1` and `hota`. Of the track that is taken for each target, where the truth
is known: `velocity` (px/s), root of the mean square of the difference's length; `size`, that of ln
lambda1 and ln lambda2; `theta` (degrees), where lambda1 is larger than 1.15 lambda2; `inverse_ttc`
(1/s), of pairs, of other targets of their growth; `range`, that of the ratio to the truth less 1.
`per_time` lists t (us) and `distance`, of all targets one after another; None where no track was.
"""

import math
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from jaxevent.blob import Tracker, TrackerParams, find
from jaxevent.blob.quantities import SIZE_FACTORS, growth, inverse_ttc, size_range
from jaxevent.blob.scores import score_tracks
from jaxevent.blob.track import MIN_THETA_AXIS_RATIO
from jaxevent.blob.tracks import Tracks
from jaxevent.errors import InputError
from jaxevent.recording import Recording
from jaxevent.runs.blob_positions import TARGET_SETTINGS, KnownPositions, Targets
from jaxevent.runs.config import METRICS_CHECK, Check
from jaxevent.runs.family import Protocol
from jaxevent.runs.own import MethodFunction, find_metrics, own_names

# Measures that rows have in any case.
MEASURE_NAMES = (
    "rmse", "median", "covered", "tracks", "missed", "false", "switches", "mota", "idf1", "hota",
    "velocity", "size", "theta", "inverse_ttc", "range",
)  # fmt: skip
TRACK_BEGINNINGS = ("positions", "found", "born")
MATCH_DISTANCE_PX = 10.0  # px


def _above_0(value: Any) -> bool:
    return type(value) in (int, float) and 0 < value < math.inf


def _are_pairs(value: Any) -> bool:
    return isinstance(value, list) and all(
        isinstance(one, list) and len(one) == 2 and all(type(i) is int for i in one)
        and one[0] != one[1] for one in value
    )  # fmt: skip


class TrackProtocol(Protocol):
    """Tracks and known targets."""

    settings: Mapping[str, Check] = {
        **TARGET_SETTINGS,
        "begin": (lambda value: value in TRACK_BEGINNINGS, '"positions", "found" or "born"'),
        "smooth": (lambda value: type(value) is bool, "true or false"),
        "metrics": METRICS_CHECK,
        "pairs": (_are_pairs, "a list of [id, id], two targets each"),
        **{
            name: (_above_0, "a number above 0")
            for name in ("reach", "extent", "focal", "size_factor")
        },
    }

    def check(self, options: Mapping[str, Any]) -> None:
        if "positions" not in options:
            raise InputError(
                'the positions are not given; add positions = "*.csv", tables beside the recordings'
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
        noise = None
        if isinstance(method, MethodFunction):
            mean, covariance = _of_function(recording, method, known.t)
        else:
            params = params or method.Params()
            tracks = _track(
                recording, method, params, begin=begin, targets=targets, known=known,
                options=options, progress=progress,
            )  # fmt: skip
            mean, covariance = _states(tracks, known.t)
            noise = float(tracks.params.Q_lambda)
        seconds = time.perf_counter() - clock
        told = score_tracks(known.xi, mean[..., :2], options.get("reach", MATCH_DISTANCE_PX))
        own = told.match
        if begin == "positions" and not isinstance(
            method, MethodFunction
        ):  # whose a track is needs no matching
            own = np.where(np.isfinite(mean[..., 0]), np.arange(mean.shape[1]), -1)
        given = np.isfinite(known.xi).all(2)
        distance = np.linalg.norm(_taken(mean, own)[..., :2] - known.xi, axis=2)[given]
        alive = np.isfinite(distance)
        names = ("tracks", "missed", "false", "switches", "mota", "idf1", "hota")
        return {
            "rmse": _rms(distance),
            "median": float(np.median(distance[alive])) if alive.any() else None,
            "covered": float(alive.mean()),
            **{name: getattr(told, name) for name in names},
            **_errors(
                known,
                _taken(mean, own),
                _taken(covariance, own),
                options,
                noise=noise,
                recording=recording.name,
            ),
            **{m.name: m(_taken(mean, own)[..., :2], known.xi, recording.name) for m in metrics},
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


def _states(tracks: Tracks, t: NDArray[np.int64]) -> tuple[NDArray, NDArray]:
    """Return means (times, tracks, 8) and covariances (times, tracks, 8, 8).

    NaN where not valid.
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


def _taken(values: NDArray, match: NDArray[np.int64]) -> NDArray[np.float64]:
    """Select from (times, tracks, ...) the row of each target's track, (times, targets, ...)."""
    none = np.full((len(values), 1, *values.shape[2:]), np.nan)
    values = np.concatenate([values, none], 1)
    index = match.reshape(*match.shape, *[1] * (values.ndim - 2))
    return np.take_along_axis(values, np.where(index < 0, values.shape[1] - 1, index), 1)


def _rms(error: NDArray) -> float | None:
    known = error[np.isfinite(error)]
    return float(np.sqrt(np.mean(known**2))) if len(known) else None


def _of_function(
    recording: Recording, method: MethodFunction, times: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return states that a function estimates, and their covariances; NaN where unknown."""
    mean, covariance, _ = method.estimate(recording, times, [(-1, 2), (-1, 8)])
    states = np.full((*mean.shape[:2], 8), np.nan)
    states[..., : mean.shape[2]] = mean
    full = np.full((*mean.shape[:2], 8, 8), np.nan)
    if covariance is not None and covariance.shape == full.shape:
        full = covariance
    return states, full


def _errors(
    known: KnownPositions,
    mean: NDArray[np.float64],
    covariance: NDArray[np.float64],
    options: Mapping[str, Any],
    *,
    noise: float | None,
    recording: str,
) -> dict[str, float | None]:
    """Errors of what is known beside positions.

    `mean` (times, targets, 8) is that of targets' tracks; `noise` is Q_lambda, None where the
    method has none.
    """
    more, out = known.more, {}
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
            _closing(known, mean, covariance, options, noise=noise, recording=recording)
        )
    return out


def _closing(
    known: KnownPositions,
    mean: NDArray[np.float64],
    covariance: NDArray[np.float64],
    options: Mapping[str, Any],
    *,
    noise: float | None,
    recording: str,
) -> NDArray[np.float64]:
    """Errors of 1 / TTC, of pairs and of the other targets' growth."""
    truth, errors, ids = known.more["inverse_ttc"], [], known.id.tolist()
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
    for k in set(range(len(ids))) - paired if noise is not None else ():
        seen = np.isfinite(mean[:, k, 0])
        if seen.any():
            value, _ = growth(since, x[:, k], P[:, k], jnp.asarray(seen), Q_lambda=noise)
            errors.append(np.where(seen, np.asarray(value), np.nan) - truth[:, k])
    return np.concatenate([np.zeros(0), *errors])
