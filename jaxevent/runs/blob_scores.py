"""Tracks compared with known positions, for `jaxevent evaluate`.

Settings beside `protocol = "tracks"`:

    positions = "*.csv"                 # beside each recording, * being its name without suffix
    seeds = [[30.0, 40.0, 8.0]]         # x, y, size in px (and s) of each target; omitted: where
                                        # the positions begin, of the size lambda0

Positions are as in `jaxevent.runs.blob_positions`. A row has `rmse` and `median`, of the distances
from the positions (px), and `covered`, the share of the positions at which the track was alive.
`per_time` lists t (us) and `distance`, of all targets one after another; None where no track was
alive.
"""

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxevent.blob import Tracker, TrackerParams
from jaxevent.errors import InputError
from jaxevent.recording import Recording
from jaxevent.runs.blob_positions import SETTINGS, Targets
from jaxevent.runs.family import Protocol


class TrackProtocol(Protocol):
    """Distances of tracks from known positions."""

    settings = SETTINGS

    def check(self, options: Mapping[str, Any]) -> None:
        if "positions" not in options:
            raise InputError(
                'the positions are not given; add positions = "*.csv", tables beside the recordings'
            )

    def files(self, path: Path, options: Mapping[str, Any]) -> list[Path]:
        return Targets.of(options).files(path)

    def score(
        self,
        recording: Recording,
        method: Tracker,
        params: TrackerParams,
        options: Mapping[str, Any],
        progress: bool | None = None,
    ) -> dict[str, Any]:
        clock = time.perf_counter()
        told = Targets.of(options).errors(recording, method, params, progress)
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
