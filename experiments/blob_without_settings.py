"""Tracking of real recordings without settings, beside settings by hand and a moving mean.

    python experiments/blob_without_settings.py --out real [--data DIR] [--cuts]

DIR holds the recordings, by default $JAXEVENT_DATA/data. Each is tracked by
`moment.estimate(recording)`, which is what `jaxevent track FILE` does; beside it by the filter of
the same targets, by `moment` with settings that were chosen by hand for the recording
(`blob_real.py`), and by `moving_mean` from each target's true start, with the window and the reach
that were found: of the last events and, centred, of those around each time. No reference uses a
tracker: the two dots go on circles fitted to centroids, the cars are found in the frames, the sky's
stars go along the one drift that makes its events sharpest. In the others the camera moves: nothing
in them goes its own way; `--cuts` looks at short parts of these instead. Makes table.md and
results.json.
"""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from blob_real import (
    DOT_FOUND,
    SKY,
    STREET,
    CircularPath,
    away,
    find_cars,
    find_stars,
    fit_circular_path,
    sharpest_drift,
)
from common import command_line
from numpy.typing import NDArray

from jaxevent.blob import TargetSearchResult, Tracks, find, moment
from jaxevent.io import load
from jaxevent.recording import Recording

TIMES = 400
CUTS, PLACES = (0.05, 0.1, 0.2, 0.5), 5  # s, and how many of each a recording gives
LONG = 0.2  # of the recording: shorter tracks are counted apart
ATIS_HZ, ATIS_WINDOW = 1.0, 4e-3  # s
CAMERA = (
    "slider_depth.zip", "rotating_disk_imu.npz", "evbench_seq3_calibrated.npz",
    "tubrip_boxes_rotation.npz", "tubrip_shapes_rotation.npz",
)  # fmt: skip
Paths = NDArray[np.float64]  # (times, targets, 2) px, NaN where it is not


def moving_mean(
    recording: Recording, start: NDArray, times: NDArray, window: int, reach: float, lag: int
) -> NDArray[np.float64]:
    """Return the mean of the last window's (us) events within `reach` px of the mean before.

    It is told `lag` us early: half a window makes it a mean of the events around each time.
    """
    t0, p = times[0] - 2 * window, start.copy()
    path = []
    events = recording.events
    for t in np.arange(t0, times[-1] + window // 2 + lag, window // 2):
        part = events[events.index(int(t) - window) : events.index(int(t))]
        near = np.hypot(part.x - p[0], part.y - p[1]) < reach
        if near.sum() >= 3:
            p = np.array([part.x[near].mean(), part.y[near].mean()])
        path.append((t - lag, *p))
    t, x, y = np.array(path).T
    return np.stack([np.interp(times, t, x), np.interp(times, t, y)], 1)


def positions(tracks: Tracks, times: NDArray[np.int64], filtered: bool = False) -> Paths:
    states = (tracks.filtered if filtered else tracks)(times)
    return np.where(states.valid[..., None], states.mean[..., :2], np.nan)


def score(paths: Paths, truth: Paths, reach: NDArray | float) -> dict[str, Any]:
    """Score the nearest track within `reach` of each target, and tracks near none."""
    far = np.linalg.norm(paths[:, None] - truth[:, :, None], axis=-1)  # times, targets, tracks
    far = np.where(np.isfinite(far), far, np.inf)
    limit = np.broadcast_to(np.asarray(reach, float), (truth.shape[1],))[None, :, None]
    near = far < limit
    there = np.isfinite(truth[..., 0])
    one = near.sum(0) >= 0.5 * there.sum(0)[:, None]  # a track that has half of a target's life
    nearest = np.min(np.where(near, far, np.inf), 2, initial=np.inf)
    alive = np.isfinite(paths[..., 0])
    stray = alive.any(0) & (near.any(1).sum(0) < 0.5 * alive.sum(0))
    with_track = np.isfinite(nearest)
    return {
        "targets": int(there.any(0).sum()),
        "found": int(one.any(1).sum()),
        "covered": float(with_track[there].mean()) if there.any() else 0.0,
        "rms": float(np.sqrt((nearest[with_track] ** 2).mean())) if with_track.any() else np.nan,
        "median": float(np.median(nearest[with_track])) if with_track.any() else np.nan,
        "stray": int(stray.sum()),
        "distance": nearest,
    }


def circling(recording: Recording, path: CircularPath, times: NDArray) -> tuple[Paths, float]:
    return path(times * 1e-6)[0][:, None], 2 * float(path.size[0])


def dot(recording: Recording, times: NDArray) -> tuple[Paths, NDArray | float]:
    return circling(recording, fit_circular_path(recording), times)


def atis(recording: Recording, times: NDArray) -> tuple[Paths, NDArray | float]:
    return circling(recording, fit_circular_path(recording, ATIS_HZ, ATIS_WINDOW), times)


def street(recording: Recording, times: NDArray) -> tuple[Paths, NDArray | float]:
    assert recording.frames is not None
    cars = find_cars(np.asarray(recording.frames.images))
    truth = np.full((len(times), len(cars), 2), np.nan)
    for k, car in enumerate(cars):
        t = recording.frames.t[car.frame]
        now = (times >= t[0]) & (times <= t[-1])
        truth[now, k] = np.stack(
            [np.interp(times[now], t, car.centre[:, axis]) for axis in range(2)], 1
        )
    return truth, np.array([car.length / 2 for car in cars])


def sky(recording: Recording, times: NDArray) -> tuple[Paths, NDArray | float]:
    drift = sharpest_drift(recording)
    stars = find_stars(recording, drift)
    return stars + ((times - recording.start) * 1e-6)[:, None, None] * drift, 5.0


KNOWN: dict[str, tuple[Callable, dict[str, Any]]] = {
    "spinning_dot.npz": (dot, {"preset": "fast"} | DOT_FOUND),
    "davis346_street.npz": (street, STREET),
    "atis.es": (atis, {}),
    "gen4.dat": (sky, SKY),
}


def track_by_means(
    recording: Recording, found: TargetSearchResult, truth: Paths, times: NDArray, centred: bool
) -> Paths:
    out = np.full(truth.shape, np.nan)
    longest = max(found.paths, key=lambda path: path.n.sum())
    for k in range(truth.shape[1]):
        now = np.isfinite(truth[:, k, 0])
        end = [
            path
            for path in found.paths
            if np.hypot(*(path.at(times[now][:1])[0] - truth[now, k][0])) < 50
        ]
        path = max(end, key=lambda path: path.n.sum(), default=longest)
        reach = 3 * float(np.median(path.size[:, 0]))
        lag = path.window // 2 if centred else 0
        out[now, k] = moving_mean(recording, truth[now, k][0], times[now], path.window, reach, lag)
    return out


def track_counts(tracks: Tracks) -> dict[str, int]:
    life = tracks.death - tracks.birth
    return {"tracks": len(tracks), "long": int((life > LONG * (tracks.stop - tracks.start)).sum())}


def score_recording(name: str, recording: Recording) -> dict[str, dict[str, Any]]:
    reference, by_hand = KNOWN[name]
    times = np.linspace(recording.start, recording.stop, TIMES + 12)[10:-2].astype(np.int64)
    truth, reach = reference(recording, times)
    keep = away if name == "gen4.dat" else None

    def scored(paths: Paths) -> dict[str, Any]:
        if keep is not None:  # the planet's glare is no star
            paths = np.where(keep(paths)[..., None], paths, np.nan)
        return score(paths, truth, reach)

    found = find(recording, progress=False)
    print(name, found.summary(), flush=True)
    tracks = moment.estimate(recording, found=found, progress=False,
        params=moment.Params(**found.settings()))  # fmt: skip
    rows: dict[str, dict[str, Any]] = {
        "without settings": track_counts(tracks) | scored(positions(tracks, times)),
        "filtered": track_counts(tracks) | scored(positions(tracks, times, filtered=True)),
    }
    if by_hand:
        chosen = moment.estimate(
            recording, moment.Params(**by_hand), detect=True, smooth=False, progress=False
        )
        rows["by hand, filtered"] = track_counts(chosen) | scored(positions(chosen, times))
    for label, centred in (("moving mean", False), ("centred mean", True)):
        means = track_by_means(recording, found, truth, times, centred)
        rows[label] = {"tracks": truth.shape[1], "long": truth.shape[1]} | scored(means)
    distances = [row.pop("distance") for row in rows.values()]
    all_near = np.isfinite(distances).all(0)
    for row, distance in zip(rows.values(), distances, strict=True):
        row["alike"] = float(np.median(distance[all_near])) if all_near.any() else np.nan
    return rows


def cut_lines(data: Path) -> list[str]:
    """Return lines with the number of tracks in parts of recordings of a camera that moves."""
    lines = ["| recording | s | parts | told that it moves | tracks |", "|---|---:|---:|---:|---:|"]
    for name in CAMERA:
        recording = load(data / name)
        for seconds in CUTS:
            room = recording.stop - recording.start - round(1e6 * seconds)
            if room < 0:
                continue
            begins = recording.start + np.linspace(0, room, PLACES).astype(int)
            found = [
                find(recording, int(t), int(t) + round(1e6 * seconds), progress=False)
                for t in begins
            ]
            told = sum(one.camera_moves for one in found)
            tracks = ", ".join(str(len(one)) for one in found)
            lines.append(f"| {name} | {seconds} | {PLACES} | {told} | {tracks} |")
            print(lines[-1], flush=True)
    return lines


def main() -> None:
    parser = command_line(__doc__, out=True, data=True)
    parser.add_argument("--only", nargs="+", default=[*KNOWN, *CAMERA])
    parser.add_argument("--cuts", action="store_true")
    args = parser.parse_args()
    data = args.data
    if args.cuts:
        (args.out / "table.md").write_text("\n".join(cut_lines(data)) + "\n")
        return
    results: dict[str, Any] = {}
    lines = [
        "| recording | tracker | targets found | tracks (of a fifth of the time) | on no target | "
        "covered | median px | rms px | median px where all are near |",
        "|---|---|" + "---:|" * 7,
    ]
    for name in args.only:
        recording = load(data / name)
        if name in KNOWN:
            results[name] = score_recording(name, recording)
            for tracker, r in results[name].items():
                lines.append(
                    f"| {name} | {tracker} | {r['found']} of {r['targets']} | {r['tracks']} "
                    f"({r['long']}) | {r['stray']} | {100 * r['covered']:.0f} % | "
                    f"{r['median']:.2f} | {r['rms']:.2f} | {r['alike']:.2f} |"
                )
        else:
            found = find(recording, progress=False)
            results[name] = {"without settings": {"tracks": len(found)}}
            lines.append(
                f"| {name} | without settings | 0 of 0 | {len(found)} | - | - | - | - | - |"
            )
        print("\n".join(lines[-len(results[name]) :]), flush=True)
    (args.out / "results.json").write_text(json.dumps(results, indent=1))
    (args.out / "table.md").write_text("\n".join(lines) + "\n")
    print("\n".join(lines))


if __name__ == "__main__":
    main()
