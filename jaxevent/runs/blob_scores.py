"""Tracks compared with known positions, for `jaxevent evaluate`.

Settings beside `protocol = "tracks"`:

    positions = "*.csv"                 # beside each recording, * being its name without suffix
    seeds = [[30.0, 40.0, 8.0]]         # x, y, size in px (and s) of each target; omitted: where
                                        # the positions begin, of the size lambda0

The only method is "blob". Positions are as in `jaxevent.runs.blob`. A row has `rmse` and
`median`, of the distances from the positions (px), and `covered`, the share of the positions at
which the track was alive. `per_time` lists t (us) and `distance`, of all targets one after another;
None where no track was alive.
"""

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxevent.blob.tracker import Params
from jaxevent.errors import InputError
from jaxevent.parameters import Parameters, nearest
from jaxevent.recording import Recording
from jaxevent.runs import blob as objectives

SETTINGS: dict[str, tuple[Callable[[Any], bool], str]] = {
    name: objectives.BLOB.settings[name] for name in ("positions", "seeds")
}


def check(options: Mapping[str, Any]) -> None:
    """Raise `InputError` for settings that are missing."""
    if "positions" not in options:
        raise InputError(
            'the positions are not given; add positions = "*.csv", tables beside the recordings'
        )


def find(name: str, options: Mapping[str, Any]) -> type[Parameters]:
    """The parameters of a method; raises `InputError` naming the nearest."""
    if name != "blob":
        raise InputError(f"there is no method {name!r} of tracks; {nearest(name, ['blob'])}")
    return Params


def files(path: Path, options: Mapping[str, Any]) -> list[Path]:
    """Further files that a row of the recording depends on."""
    return _goal(Params.of({}), options).files(path)


def score(
    recording: Recording,
    name: str,
    params: Parameters,
    options: Mapping[str, Any],
    progress: bool = False,
) -> dict[str, Any]:
    """A row without the names; raises `InputError` where there are no positions or no events."""
    assert isinstance(params, Params)
    clock = time.perf_counter()
    told = _goal(params, options).errors(recording, params, progress)
    assert told is not None
    seconds = time.perf_counter() - clock
    t, distance = told
    alive = np.isfinite(distance)
    near = distance[alive]
    return {
        "rmse": float(np.sqrt(np.mean(near**2))) if len(near) else None,
        "median": float(np.median(near)) if len(near) else None,
        "covered": float(alive.mean()),
        "times": len(t),
        "events": len(recording.events),
        "seconds": seconds,
        "per_time": {
            "t": t.tolist(),
            "distance": [
                float(f"{d:.6g}") if ok else None for d, ok in zip(distance, alive, strict=True)
            ],
        },
    }


def _goal(params: Params, options: Mapping[str, Any]) -> objectives.Goal:
    return objectives.BLOB.goal("blob", params, options)
