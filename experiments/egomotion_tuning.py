"""Parameters of voting fitted from wrong ones: is what comes out better on sequences not seen?

    python experiments/egomotion_tuning.py [--seeds 4] [--size 96 72]

Planar sequences of an ideal camera, 200 +- 100 px/s at 2 Hz, both textures. The thesis' literal
likelihood starts with `r_t` ten times what a grid finds best on the sequences fitted to, and a
tenth of it; the soft one with `noise` and `alpha` ten times too large and too small. The loss is
that of `jaxevent.egomotion.objectives`; errors are its root, in % of the speed, of sequences of
other seeds.
"""

import argparse
import dataclasses
import platform
from typing import Any

import jax
import numpy as np

from jaxevent import fit
from jaxevent.egomotion import voting
from jaxevent.egomotion.objectives import Goal, Loss
from jaxevent.egomotion.truth import Known
from jaxevent.recording import Recording
from jaxevent.simulate import motion_scene

GRID = 10.0 ** np.arange(1, 6.1, 0.5)  # px/s


@dataclasses.dataclass(frozen=True)
class Simulated(Goal):
    """The goal of recordings whose truth is here instead of in a file."""

    truths: tuple[Known, ...] = ()

    def known(self, recording: Recording) -> Known:
        return self.truths[int(recording.name)]


def sequences(seeds: range, size: tuple[int, int]) -> list[tuple[Recording, Known]]:
    made = []
    for seed in seeds:
        recording, source = motion_scene(
            "planar",
            "varying",
            seed,
            size=size,
            duration=0.4,
            texture=("noise", "shapes")[seed % 2],
        )
        t = np.arange(0, 400_001, 1000)
        made.append((recording, Known("planar", t, source.velocity(t))))
    return made


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--seeds", type=int, default=4, help="sequences to fit to, and to test on")
    parser.add_argument("--size", type=int, nargs=2, default=(96, 72), metavar=("W", "H"))
    arguments = parser.parse_args()
    size = tuple(arguments.size)
    mine, others = (sequences(range(s, s + arguments.seeds), size) for s in (0, 100))
    pairs = [*mine, *others]
    named = [dataclasses.replace(r, name=str(k)) for k, (r, _) in enumerate(pairs)]
    sources: Any = {
        "fit": [(r.name, r) for r in named[: len(mine)]],
        "validation": [(r.name, r) for r in named[len(mine) :]],
        "test": [],
    }
    truths = tuple(truth for _, truth in pairs)
    events = sum(len(r.events) for r in named)
    print(f"{platform.machine()}, {len(mine)} sequences each, {events:,} events\n")
    print("| | start | start's error % | fitted | error % |\n|---|---:|---:|---:|---:|")

    def errors(goal: Goal, params: voting.Params, batches: Any) -> float:
        losses = [float(value(goal.loss, params, batch)) for batch in batches]
        return 100 * float(np.sqrt(np.mean(losses)))

    def look(label: str, given: dict[str, Any], names: list[str]) -> None:
        params = voting.Params.of({"particles": 100, "batch": 32, **given})
        goal = Simulated(params, Loss(), "planar", "", 8, 0.05, (0.0, 0.0, 0.0), truths)
        fitted_to, unseen = goal.problem(sources, None, None)(params)
        settings = fit.Settings(
            iterations=40, learning_rate=0.3, rounds=1, every=40, patience=1000, forward=True
        )
        found = fit.optimise(goal.loss, params, names, fitted_to, fitted_to, settings)
        shown = [
            "; ".join(f"{n} {float(getattr(p, n)):.3g}" for n in names)
            for p in (params, found.params)
        ]
        before, after = (errors(goal, p, unseen) for p in (params, found.params))
        print(f"| {label} | {shown[0]} | {before:.2f} | {shown[1]} | {after:.2f} |", flush=True)

    value = jax.jit(lambda loss, params, batch: loss(params, batch), static_argnums=0)
    curve = []
    for r_t in GRID:
        params = voting.Params.of(
            {"particles": 100, "batch": 32, "likelihood": "literal", "r_t": float(r_t)}
        )
        goal = Simulated(params, Loss(), "planar", "", 8, 0.05, (0.0, 0.0, 0.0), truths)
        fitted_to, unseen = goal.problem(sources, None, None)(params)
        curve.append((errors(goal, params, fitted_to), errors(goal, params, unseen)))
    best = float(GRID[np.argmin([one for one, _ in curve])])
    for r_t, (seen, unseen) in zip(GRID, curve, strict=True):
        print(
            f"| literal, grid | r_t {r_t:.3g} | {unseen:.2f} (of those fitted to {seen:.2f}) | | |"
        )
    for factor in (10.0, 0.1):
        look(f"literal, r_t x {factor:g}", {"likelihood": "literal", "r_t": best * factor}, ["r_t"])
    default = voting.Params.of({})
    for factor in (10.0, 0.1):
        given = {name: factor * float(getattr(default, name)) for name in ("noise", "alpha")}
        look(f"soft, noise and alpha x {factor:g}", given, ["noise", "alpha"])


if __name__ == "__main__":
    main()
