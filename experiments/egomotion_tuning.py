"""Parameters of voting fitted from wrong ones: is what comes out better on sequences not seen?

    python experiments/egomotion_tuning.py [--seeds 4] [--size 96 72]

Planar sequences, 200 +- 100 px/s at 2 Hz. The thesis' literal likelihood is fitted on points that
give an event at every pixel they enter, which is what it takes the world for: on an ideal camera,
whose edges give several events at once, it is locked (35 to 50 % at every r_t from 10 to 1e6). It
starts with `r_t` ten times what a grid finds best on the sequences fitted to, and a tenth of it;
the soft vote, on an ideal camera with both textures, with `noise` and `alpha` ten times too large
and too small. The loss is that of `jaxevent.runs.egomotion`; errors are its root, in % of the
speed, of sequences of other seeds.
"""

import argparse
import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from bench import machine

from jaxevent.egomotion import voting
from jaxevent.egomotion.models import Planar
from jaxevent.egomotion.particle_filter.parameters import Params
from jaxevent.egomotion.truth import Known
from jaxevent.recording import Events, Recording
from jaxevent.runs.egomotion import Goal, Loss
from jaxevent.simulate import motion_scene
from jaxevent.tuning import Settings, optimise

GRID = 10.0 ** np.arange(1, 6.1, 0.5)  # px/s


@dataclasses.dataclass(frozen=True)
class Simulated(Goal):
    """The goal of recordings whose truth is here instead of in a file."""

    truths: tuple[Known, ...] = ()

    def known(self, recording: Recording) -> Known:
        return self.truths[int(recording.name)]


def velocity(t: np.ndarray, angle: float) -> np.ndarray:
    """(times, 2) px/s."""
    speed = 200 + 100 * np.sin(2 * np.pi * 2 * t)
    return speed[:, None] * np.array([np.cos(angle), np.sin(angle)])


def points(seed: int, size: tuple[int, int], seconds: float = 0.4) -> tuple[Recording, Known]:
    """Points, an event at every pixel that one enters."""
    rng = np.random.default_rng(seed)
    angle, dt, number = rng.uniform(0, 2 * np.pi), 2e-4, 60
    at, sign = rng.uniform([0, 0], size, (number, 2)), rng.random(number) < 0.5
    cell, rows = np.floor(at), []
    times = np.arange(0, seconds, dt)
    for t, U in zip(times, velocity(times, angle), strict=True):
        at = at + U * dt
        left = ((at < 0) | (at >= size)).any(1)
        at = np.where(left[:, None], np.mod(at, size), at)
        new = np.flatnonzero((np.floor(at) != cell).any(1) & ~left)
        cell = np.floor(at)
        rows.append(np.c_[1e6 * (t + dt * rng.random(len(new))), cell[new], sign[new]])
    table = np.concatenate(rows)
    t, x, y, p = table[np.argsort(table[:, 0], kind="stable")].T
    events = Events(t.astype(np.int64), x.astype(np.uint16), y.astype(np.uint16), p > 0)
    grid = np.arange(0, round(seconds * 1e6) + 1, 1000)
    known = Known(Planar, grid, velocity(grid * 1e-6, angle))
    return Recording("points", *size, events), known


def wall(seed: int, size: tuple[int, int], seconds: float = 0.4) -> tuple[Recording, Known]:
    """An ideal camera before a textured wall."""
    texture = ("noise", "shapes")[seed % 2]
    recording, source = motion_scene(
        "planar", "varying", seed, size=size, duration=seconds, texture=texture
    )
    t = np.arange(0, round(seconds * 1e6) + 1, 1000)
    return recording, Known(Planar, t, source.velocity(t))


class Problem:
    """Sequences of one kind: those fitted to (seeds from 0), and unseen ones (from 100)."""

    def __init__(self, make: Callable, number: int, size: tuple[int, int]):
        pairs = [make(seed, size) for first in (0, 100) for seed in range(first, first + number)]
        named = [dataclasses.replace(r, name=str(k)) for k, (r, _) in enumerate(pairs)]
        self.truths = tuple(truth for _, truth in pairs)
        self.sources: Any = {
            "fit": [(r.name, r) for r in named[:number]],
            "validation": [(r.name, r) for r in named[number:]],
            "test": [],
        }

    def __call__(self, params: Params) -> tuple[Loss, list, list]:
        """The loss, and windows to fit to and unseen ones."""
        goal = Simulated(voting, Loss(), "planar", "", 8, 0.05, (0.0, 0.0, 0.0), self.truths)
        return goal.loss, *goal.problem(self.sources, None, None)(params)


value = jax.jit(lambda loss, params, batch: loss(params, batch), static_argnums=0)


def error(loss: Loss, params: Params, batches: list) -> float:
    """%, over all windows."""
    return 100 * float(np.sqrt(np.mean([float(value(loss, params, b)) for b in batches])))


def fitted(problem: Problem, label: str, given: dict[str, Any], names: list[str]) -> None:
    """Print a line of the table."""
    params = Params.of({"particles": 100, "batch": 32, **given})
    loss, mine, unseen = problem(params)
    settings = Settings(
        iterations=40, learning_rate=0.3, rounds=1, every=40, patience=1000, forward=True
    )
    found = optimise(loss, params, names, mine, mine, settings)
    shown = [
        "; ".join(f"{n} {float(getattr(p, n)):.3g}" for n in names) for p in (params, found.params)
    ]
    before, after = (error(loss, p, unseen) for p in (params, found.params))
    print(f"| {label} | {shown[0]} | {before:.2f} | {shown[1]} | {after:.2f} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--seeds", type=int, default=4, help="sequences to fit to, and to test on")
    parser.add_argument("--size", type=int, nargs=2, default=(96, 72), metavar=("W", "H"))
    arguments = parser.parse_args()
    size = tuple(arguments.size)
    print(f"{machine()}; {arguments.seeds} sequences to fit to, as many unseen\n")
    print("| | start | start's error % | fitted | error % |\n|---|---:|---:|---:|---:|")
    literal: dict[str, Any] = {"likelihood": "literal"}
    problem, curve = Problem(points, arguments.seeds, size), []
    for r_t in GRID:
        params = Params.of({"particles": 100, "batch": 32, **literal, "r_t": float(r_t)})
        loss, mine, unseen = problem(params)
        curve.append(error(loss, params, mine))
        told = f"{error(loss, params, unseen):.2f} (of those fitted to {curve[-1]:.2f})"
        print(f"| literal, grid | r_t {r_t:.3g} | {told} | | |", flush=True)
    best = float(GRID[np.argmin(curve)])
    for factor in (10.0, 0.1):
        fitted(problem, f"literal, r_t x {factor:g}", {**literal, "r_t": best * factor}, ["r_t"])
    problem, default = Problem(wall, arguments.seeds, size), Params.of({})
    for factor in (10.0, 0.1):
        given = {name: factor * float(getattr(default, name)) for name in ("noise", "alpha")}
        fitted(problem, f"soft, noise and alpha x {factor:g}", given, ["noise", "alpha"])


if __name__ == "__main__":
    main()
