"""Process noises of the blob tracker found by the likelihood of the events alone.

    python experiments/blob_tuning.py [--iterations 30]

From process noises that are wrong by factors of 10 to 100 the mean negative log-likelihood of each
event, predicted before it is used, is minimised by `jaxevent.optimise` on two recordings.
The position's RMSE on other recordings stands beside that of the best point of a grid, which is
chosen by the true positions of those recordings themselves.
"""

import argparse
import dataclasses
import functools
import itertools
import time
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxevent.blob import (
    TrackerParams,
    moment,
    negative_log_likelihood,
    position_error,
    prepare_positions,
)
from jaxevent.simulate import blob_scene
from jaxevent.tuning import Settings, optimise

STEP: dict[str, Any] = {"events_per_step": 32}
# Process noises times these.
STARTS: dict[str, dict[str, float]] = {
    "stiff": {"Q_p": 10, "Q_v": 1e-2, "Q_lambda": 10, "Q_theta": 10},
    "loose": {"Q_p": 10, "Q_v": 1e2, "Q_lambda": 1e-1, "Q_theta": 1e-1},
}
GRID = {"Q_p": (0.1, 1.0, 10.0, 100.0), "Q_v": tuple(10.0 ** (k / 2) for k in range(8, 17))}
WALK = {"Q_p": 20.0, "Q_v": 1e6, "Q_lambda": 10.0, "Q_theta": 0.1, "Q_q": 50.0}
SETTINGS = Settings(iterations=30, learning_rate=0.5, rounds=2, every=10, patience=1000)
SCALE = 30.0  # px; the error is squared well below it


def recordings(
    scene: str, seeds: Sequence[int], params: TrackerParams, seconds: float, **settings: Any
):
    """For each seed the events, and those with true positions every ms after 0.1 s."""
    batches = []
    for seed in seeds:
        if scene == "walk":
            settings = {"walk_seed": seed, "duration": seconds, **WALK, **settings}
        recording, truth = blob_scene(scene, seed, **settings)
        xy = truth(0.0)[0, 0, :2] + 5 * np.random.default_rng([seed, 7]).normal(size=2)
        target, times = [(*xy, 20.0)], np.arange(0.1, seconds - 0.002, 1e-3)
        batches.append(
            prepare_positions(
                recording, params, target, times, truth(times)[:, :, :2], start=0.0, stop=seconds
            )
        )
    return batches


def rmse(params: TrackerParams, raw: Mapping[str, jax.Array], batches: Sequence[Any]) -> np.ndarray:
    """Return the error of the position, px, for every set of raw numbers (sets,)."""
    one = jax.vmap(lambda r, b: position_error(moment, params.with_raw(r), b, SCALE), (0, None))
    squares = [jax.jit(one)(raw, batch) for batch in batches]
    return np.sqrt(np.mean(squares, axis=0))


def tune_scene(
    scene: str,
    starts: Mapping[str, Mapping[str, float]],
    seeds: Sequence[int],
    held_out: Sequence[int],
    seconds: float = 0.4,
    settings: Settings = SETTINGS,
    grid: Mapping[str, Sequence[float]] = GRID,
    **scene_settings: Any,
) -> list[dict[str, Any]]:
    """One row for each start, its fit, and the best point of the grid."""
    base = moment.Params(**STEP)
    batches = [b.features for b in recordings(scene, seeds, base, seconds, **scene_settings)]
    test = recordings(scene, held_out, base, seconds, **scene_settings)
    names = list(next(iter(starts.values())))
    tried: list[tuple[str, TrackerParams, float]] = []
    for label, factors in starts.items():
        wrong: dict[str, Any] = {n: float(getattr(base, n)) * factors[n] for n in factors}
        start = moment.Params(**{**STEP, **wrong})
        begin = time.perf_counter()
        loss = functools.partial(negative_log_likelihood, moment)
        found = optimise(loss, start, names, batches, settings=settings, title=label)
        tried += [(f"{label}: start", start, 0.0)]
        tried += [("fitted", found.params, time.perf_counter() - begin)]
    for point in itertools.product(*grid.values()):
        values: dict[str, Any] = dict(zip(grid, point, strict=True))
        tried.append(("best of the grid", moment.Params(**{**STEP, **values}), 0.0))
    raw = {n: jnp.stack([p.raw[n] for _, p, _ in tried]) for n in {**dict.fromkeys(names), **grid}}
    errors = rmse(base, raw, test)
    first = 2 * len(starts)
    shown = [*range(first), first + int(np.nanargmin(errors[first:]))]
    rows = []
    for k in shown:
        label, params, seconds_taken = tried[k]
        told = names if k < first else grid
        values = {name: float(getattr(params, name)) for name in told}
        rows.append({"": label, **values, "rmse": float(errors[k]), "seconds": seconds_taken})
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--iterations", type=int, default=30)
    settings = dataclasses.replace(SETTINGS, iterations=parser.parse_args().iterations)
    for scene in ("lissajous", "walk"):
        rows = tune_scene(scene, STARTS, (1, 2), (1001, 1002, 1003), settings=settings)
        names = [name for name in rows[0] if name not in ("", "seconds")]
        print(f"\n| {scene} | " + " | ".join(names) + " px | s |\n|---" + "|---:" * 6 + "|")
        for row in rows:
            cells = [f"{row[n]:.3g}" if n in row else "" for n in names]
            taken = f"{row['seconds']:.0f}" if row.get("seconds") else ""
            print(f"| {row['']} | " + " | ".join(cells) + f" | {taken} |", flush=True)


if __name__ == "__main__":
    main()
