"""Known positions of targets, and tracks compared with them.

Positions are a table with the columns t (s), x, y (px) and, of more than one target, id, as
`jaxevent track` and `jaxevent simulate --truth` write them. The columns vx, vy (px/s), lambda1,
lambda2 (px), theta (rad), inverse_ttc (1/s) and range (m) may be added, empty where nothing is
known; further ones are left out. Targets by rising id are those of the seeds in their order.
"""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from jaxevent.blob import Tracker, TrackerParams
from jaxevent.errors import InputError
from jaxevent.recording import Recording
from jaxevent.runs.config import Check, TruthTables, is_table, truth_files, truth_table


def _is_seed(value: Any) -> bool:
    numbers = isinstance(value, list) and len(value) in (3, 4)
    return numbers and all(type(n) in (int, float) and np.isfinite(n) for n in value)


TARGET_SETTINGS: Mapping[str, Check] = {
    "seeds": (
        lambda value: (
            isinstance(value, list)
            and len(value) > 0
            and all(_is_seed(one) and one[2] > 0 for one in value)
        ),
        "a list of [x, y, size], in px, or [x, y, size, t], t in s",
    ),
    "positions": (
        is_table,
        'the name of tables beside the recordings, as "*.csv"',
    ),
}


OPTIONAL_COLUMNS = (
    "vx",
    "vy",
    "lambda1",
    "lambda2",
    "theta",
    "inverse_ttc",
    "range",
)  # columns beside x, y


@dataclasses.dataclass(frozen=True)
class KnownPositions:
    """Given positions: times (T,) us, xi (T, targets, 2) in px, NaN where unknown.

    `more` are further columns, of `OPTIONAL_COLUMNS`, (T, targets) each, and `id` the targets'
    numbers.
    """

    t: NDArray[np.int64]
    xi: NDArray[np.float64]
    more: Mapping[str, NDArray[np.float64]] = dataclasses.field(default_factory=dict)
    id: NDArray[Any] = dataclasses.field(default_factory=lambda: np.zeros(1, np.int64))


def read_positions(path: str | Path) -> KnownPositions:
    """Read positions from a table in a file; see the text of this module.

    Raises `InputError` for a file that cannot be read and for missing columns or numbers.
    """
    path = Path(path)
    try:
        table = pd.read_csv(path)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the path") from None
    except ValueError as error:
        raise InputError(f"{path}: is no table ({error}); give columns t, x, y") from None
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
    """Targets of a configuration: seeds, and the name of tables of positions."""

    seeds: tuple[tuple[float, ...], ...] | None
    positions: str | TruthTables | None

    @classmethod
    def of(cls, given: Mapping[str, Any]) -> "Targets":
        """Make them from settings of a configuration, those named in `TARGET_SETTINGS`."""
        seeds = given.get("seeds")
        seeds = None if seeds is None else tuple(tuple(map(float, seed)) for seed in seeds)
        return cls(seeds, given.get("positions"))

    def files(self, recording: Path) -> list[Path]:
        """Return the tables beside a recording."""
        if self.positions is None:
            return []
        return truth_files(self.positions, str(recording))

    def known(self, recording: Recording) -> KnownPositions | None:
        """Return the positions of a recording within the time of its events."""
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
        first, stop = event_time_span(recording)
        inside = (first <= known.t) & (known.t < stop)
        if not inside.any():
            raise InputError(
                f"{path}: no position is within {first * 1e-6:g} to {stop * 1e-6:g} s, the "
                f"events' time in {recording.name}; times are seconds on its clock"
            )
        more = {name: value[inside] for name, value in known.more.items()}
        return KnownPositions(known.t[inside], known.xi[inside], more, known.id)

    def first_seeds(self, known: KnownPositions | None, params: TrackerParams) -> list[Any] | None:
        """Return the seeds of a whole recording; None if tracks are born."""
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
        """Compute time (us) and distance (px) of all known positions.

        NaN where the track is not alive.
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


def event_time_span(recording: Recording) -> tuple[int, int]:
    """Return the time of the first event and the time after the last, us."""
    events, count = recording.events, len(recording.events)
    if not count:
        raise InputError(f"{recording.name}: holds no events; choose another recording")
    return int(events[:1].t[0]), int(events[count - 1 : count].t[0]) + 1


def seed_from_positions(
    known: KnownPositions, target: int, begin_us: int, size_px: float
) -> tuple[float, float, float, int]:
    """Make the seed of a target from a time on, or from its first position; NaN after the last."""
    seen = np.isfinite(known.xi[:, target]).all(1)
    t, xi = known.t[seen], known.xi[seen, target]
    if t[-1] < begin_us:
        return np.nan, np.nan, size_px, begin_us
    at = max(begin_us, int(t[0]))
    x, y = (float(np.interp(at, t, xi[:, axis])) for axis in (0, 1))
    return x, y, size_px, at
