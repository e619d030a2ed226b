"""Parameters of voting fitted from wrong ones: is what comes out better on sequences not seen?

    python experiments/egomotion_tuning.py --out docs/results [--seeds 3] [--only soft]

The penalty of time r_t of the thesis' literal likelihood, by gradient against the true motion in
the formulations where it acts: planar with the predecessor when the hypothesis was one pixel back
("crossing") and at a fixed age ("fixed", that of a pixel at 200 px/s), and rotation, where it
compares with the last event at the same pixel. Each starts ten times above and ten times below the
best of a grid on the sequences fitted to; the loss over that grid is drawn (r_t.png). Planar ones
are of points that give an event at every pixel they enter, which is what the likelihood takes the
world for, 200 +- 100 px/s at 2 Hz; rotations of an ideal camera, varying about 2 rad/s.

The soft vote has no r_t: there, on an ideal camera with two textures, `noise` and `alpha` start
ten times too large and too small. The loss is that of `jaxevent.runs.egomotion`; errors are its
root, in % of the speed, of sequences of other seeds.
"""

import argparse
import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from bench import machine

from jaxevent.confidence import confidence_intervals
from jaxevent.egomotion import voting
from jaxevent.egomotion.models import Planar, Rotation
from jaxevent.egomotion.particle_filter.params import Params
from jaxevent.egomotion.truth import KnownMotion
from jaxevent.recording import Events, Recording
from jaxevent.runs.egomotion import MotionGoal, MotionLoss
from jaxevent.simulate import motion_scene
from jaxevent.tuning import Settings, evaluate_loss, optimise

GRID = 10.0 ** np.arange(1, 6.1, 0.5)  # px/s
RUNS, SETTLE, ITERATIONS = 2, 0.05, 20


@dataclasses.dataclass(frozen=True)
class Simulated(MotionGoal):
    """The goal of recordings whose truth is here instead of in a file."""

    truths: tuple[KnownMotion, ...] = ()

    def known(self, recording: Recording) -> KnownMotion:
        return self.truths[int(recording.name)]


def velocity(t: np.ndarray, angle: float) -> np.ndarray:
    """(times, 2) px/s."""
    speed = 200 + 100 * np.sin(2 * np.pi * 2 * t)
    return speed[:, None] * np.array([np.cos(angle), np.sin(angle)])


DT = 2e-4  # s, steps of points


def points(seed: int, size: tuple[int, int], seconds: float = 0.4) -> tuple[Recording, KnownMotion]:
    """Points, an event at every pixel that one enters."""
    angle = np.random.default_rng(seed).uniform(0, 2 * np.pi)
    return entering(seed, size, velocity(np.arange(0, seconds, DT), angle))


def drifting(
    seed: int, size: tuple[int, int], noise: float, seconds: float = 0.4
) -> tuple[Recording, KnownMotion]:
    """Points whose velocity wanders by `noise` of its speed per square root of a second."""
    rng = np.random.default_rng([seed, 5])
    angle = rng.uniform(0, 2 * np.pi)
    path = [200.0 * np.array([np.cos(angle), np.sin(angle)])]
    for step in rng.normal(size=(round(seconds / DT) - 1, 2)):
        path.append(path[-1] + noise * np.linalg.norm(path[-1]) * np.sqrt(DT) * step)
    return entering(seed, size, np.array(path))


def entering(
    seed: int, size: tuple[int, int], path: np.ndarray, number: int = 60
) -> tuple[Recording, KnownMotion]:
    """Points that move by a path of velocities (times, 2), `DT` apart, px/s."""
    rng = np.random.default_rng([seed, 1])
    at, sign = rng.uniform([0, 0], size, (number, 2)), rng.random(number) < 0.5
    cell, rows = np.floor(at), []
    times = DT * np.arange(len(path))
    for t, U in zip(times, path, strict=True):
        at = at + U * DT
        left = ((at < 0) | (at >= size)).any(1)
        at = np.where(left[:, None], np.mod(at, size), at)
        new = np.flatnonzero((np.floor(at) != cell).any(1) & ~left)
        cell = np.floor(at)
        rows.append(np.c_[1e6 * (t + DT * rng.random(len(new))), cell[new], sign[new]])
    table = np.concatenate(rows)
    t, x, y, p = table[np.argsort(table[:, 0], kind="stable")].T
    events = Events(t.astype(np.int64), x.astype(np.uint16), y.astype(np.uint16), p > 0)
    grid = np.rint(1e6 * times).astype(np.int64)
    return Recording("points", *size, events), KnownMotion(Planar, grid, path)


def wall(seed: int, size: tuple[int, int], seconds: float = 0.4) -> tuple[Recording, KnownMotion]:
    """An ideal camera before a textured wall."""
    texture = ("noise", "shapes")[seed % 2]
    recording, source = motion_scene(
        "planar", "varying", seed, size=size, duration=seconds, texture=texture
    )
    t = np.arange(0, round(seconds * 1e6) + 1, 1000)
    return recording, KnownMotion(Planar, t, source.velocity(t))


def turning(
    seed: int, size: tuple[int, int], seconds: float = 0.4
) -> tuple[Recording, KnownMotion]:
    """An ideal camera that turns."""
    recording, source = motion_scene("rotation", "varying", seed, size=size, duration=seconds)
    t = np.arange(0, round(seconds * 1e6) + 1, 1000)
    return recording, KnownMotion(Rotation, t, source.twist(t)[1])


class Problem:
    """Sequences of one kind: those fitted to (seeds from 0), and unseen ones (from 100)."""

    def __init__(self, make: Callable, number: int, size: tuple[int, int], model: str = "planar"):
        pairs = [make(seed, size) for first in (0, 100) for seed in range(first, first + number)]
        named = [dataclasses.replace(r, name=str(k)) for k, (r, _) in enumerate(pairs)]
        self.model = model
        self.truths = tuple(truth for _, truth in pairs)
        self.sources: Any = {
            "fit": [(r.name, r) for r in named[:number]],
            "validation": [(r.name, r) for r in named[number:]],
            "test": [],
        }

    def __call__(self, params: Params) -> tuple[MotionLoss, Sequence[Any], Sequence[Any]]:
        """The loss, and windows to fit to and unseen ones."""
        goal = Simulated(voting, MotionLoss(), self.model, "", RUNS, SETTLE, {}, self.truths)
        return goal.loss, *goal.problem(self.sources, None, None)(params)


SMALL: dict[str, Any] = {"particles": 64, "batch": 32}
WAYS: dict[str, tuple[Callable, str, dict[str, Any]]] = {
    "planar, crossing": (points, "planar", {"likelihood": "literal"}),
    "planar, fixed": (
        points,
        "planar",
        {"likelihood": "literal", "horizon": "fixed", "past": 1 / 200},
    ),
    "rotation": (turning, "rotation", {"preset": "literal_latest", "every": 4}),
}


def percent(loss: MotionLoss, params: Params, batches: Sequence[Any]) -> float:
    """The root of the loss over all windows, in %."""
    return 100 * float(np.sqrt(np.mean([float(evaluate_loss(loss, params, b)) for b in batches])))


def fitted(problem: Problem, label: str, given: dict[str, Any], names: list[str]) -> None:
    """Print a line of the table."""
    params = Params.of({**SMALL, **given})
    loss, mine, unseen = problem(params)
    settings = Settings(
        iterations=ITERATIONS, learning_rate=0.3, rounds=1, every=5, patience=1000, forward=True
    )
    found = optimise(loss, params, names, mine, (), settings)
    told = confidence_intervals(loss, params, found.params, names, mine, None, True)
    before, after = (percent(loss, p, unseen) for p in (params, found.params))
    for name in names:
        one = told[name]
        cells = (f"`{name}` {one.start:.3g}", f"{one.value:.3g}", one.interval, one.remark)
        print(f"| {label} | {' | '.join(cells)} | {before:.1f} | {after:.1f} |", flush=True)


def curve(problem: Problem, given: dict[str, Any]) -> tuple[list[float], list[float]]:
    """Errors over the grid of r_t, in %, of sequences fitted to and of unseen ones."""
    errors: tuple[list[float], list[float]] = ([], [])
    for r_t in GRID:
        params = Params.of({**SMALL, **given, "r_t": float(r_t)})
        loss, *both = problem(params)
        for told, batches in zip(errors, both, strict=True):
            told.append(percent(loss, params, batches))
    return errors


def draw(curves: dict[str, tuple[list[float], list[float]]], path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axis = plt.subplots(figsize=(6, 3.6), layout="constrained")
    for k, (label, (mine, unseen)) in enumerate(curves.items()):
        axis.loglog(GRID, mine, f"C{k}-", label=label)
        axis.loglog(GRID, unseen, f"C{k}--")
    axis.set_xlabel("r_t, px/s")
    axis.set_ylabel("error, % (dashed: unseen)")
    axis.legend()
    figure.savefig(path, dpi=100)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--out", type=Path, required=True, help="folder for r_t.png")
    parser.add_argument("--seeds", type=int, default=3, help="sequences to fit to, and to test on")
    parser.add_argument("--size", type=int, nargs=2, default=(64, 48), metavar=("W", "H"))
    parser.add_argument("--only", choices=("literal", "soft"), help="one of the two votes")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    size = tuple(arguments.size)
    print(f"{machine()}; {arguments.seeds} sequences to fit to, as many unseen\n")
    print("| | start | found | 95 % interval | | error before, % | after |")
    print("|---|---|---:|---:|---|---:|---:|")
    if arguments.only != "soft":
        fit_literal(arguments.seeds, size, arguments.out)
    if arguments.only != "literal":
        fit_soft(arguments.seeds, size)


def fit_literal(seeds: int, size: tuple[int, int], out: Path) -> None:
    """Rows and curves of `r_t`."""
    curves = {}
    for label, (make, model, given) in WAYS.items():
        problem = Problem(make, seeds, size, model)
        curves[label] = curve(problem, given)
        best = float(GRID[np.argmin(curves[label][0])])
        told = f"{min(curves[label][0]):.1f} fitted to, "
        told += f"{curves[label][1][int(np.argmin(curves[label][0]))]:.1f} unseen"
        print(f"| {label}, best of the grid | | {best:.3g} | | {told} | | |", flush=True)
        for factor in (10.0, 0.1):
            fitted(problem, label, {**given, "r_t": best * factor}, ["r_t"])
    draw(curves, out / "r_t.png")


def fit_soft(seeds: int, size: tuple[int, int]) -> None:
    """Rows of the soft vote's numbers."""
    problem, default = Problem(wall, seeds, size), Params.of({})
    params = Params.of(SMALL)
    loss, _, unseen = problem(params)
    print(f"| soft vote, defaults | | | | | {percent(loss, params, unseen):.1f} | |", flush=True)
    for factor in (10.0, 0.1):
        given = {name: factor * float(getattr(default, name)) for name in ("noise", "alpha")}
        fitted(problem, f"soft vote, x {factor:g}", given, ["noise", "alpha"])


if __name__ == "__main__":
    main()
