"""The thesis' objective over velocities and over the penalty of time r_t (figures 5.3 to 5.8).

    python experiments/egomotion_landscape.py --out docs/results [--seeds 3]

Events of the thesis' generator (32x32 pixels, 50 us a frame) that moves by (0.8, 0) and by
(0.8, 0.6) px/frame. The objective is the mean over events of the least distance, in space and with
r_t in time, of a candidate from where a velocity would have had it (5.2, 5.3, 5.7), at most 4 px;
the predecessor was one frame ago, as the thesis' generator has it ("fixed"), or when the point was
one pixel back ("crossing"). Beside it the soft vote: minus what an event adds to a particle's log
weight. Prints where each has its least over velocities from -1 to 3 px/frame in steps of 0.1, and
how far that is from the truth, the mean over seeds and the largest; draws the first seed.
"""

import argparse
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from egomotion_voting import LITERAL_FRAMES, STEP
from numpy.typing import NDArray

from jaxevent.egomotion import voting
from jaxevent.egomotion.particle_filter.likelihood import score_batch
from jaxevent.egomotion.particle_filter.params import Params
from jaxevent.simulate.motion import frame_events

TRUTHS = ((0.8, 0.0), (0.8, 0.6))
FRAMES = 40
PENALTIES = (0.0, 2e3, 1e4, 2e4)
ALONG = np.arange(-10, 31) / 10  # px/frame
WAYS: dict[str, dict[str, Any]] = {
    "fixed": {"horizon": "fixed", "past": STEP},
    "crossing": {"horizon": "crossing"},
}


def objective(params: Params, flow: tuple[float, float], seed: int) -> NDArray[np.float64]:
    """Over velocities, (v, u): px of the literal likelihood; of the soft vote, of log weight."""
    recording, _ = frame_events(np.tile(flow, (FRAMES, 1)), seed=seed)
    model, sampler = voting.sampler(recording, params, "planar")
    made = sampler.sample_all(0.0, float(params.tau_max)).candidates
    grid = np.stack(np.meshgrid(ALONG, ALONG), -1).reshape(-1, 2) / STEP
    true = np.asarray(flow) / STEP
    # Of the soft vote, ages are those of the motion that the cloud is about: the true one.
    near = np.exp(-0.5 * ((grid - true) ** 2).sum(1) / (0.05 / STEP) ** 2)
    weights = jnp.asarray(near / near.sum())
    total, count = np.zeros(len(grid)), 0

    @jax.jit
    def add(batch):
        return score_batch(
            params, model, batch, jnp.asarray(grid), weights, False
        ).log_likelihood.sum(0)

    for k in range(len(made.elapsed)):
        batch = jax.tree.map(lambda leaf, k=k: jnp.asarray(leaf[k]), made)
        total -= np.asarray(add(batch), np.float64)
        count += int(np.asarray(batch.valid).sum())
    scale = float(params.alpha_literal) if params.likelihood == "literal" else 1.0
    return (total / (scale * max(count, 1))).reshape(len(ALONG), len(ALONG))


def least(surface: NDArray[np.float64]) -> tuple[float, float]:
    """The velocity (u, v) where it is least."""
    row, column = np.unravel_index(np.argmin(surface), surface.shape)
    return float(ALONG[column]) + 0.0, float(ALONG[row]) + 0.0


def draw(surfaces: dict[tuple[str, tuple[float, float]], NDArray[np.float64]], path: Path) -> None:
    """A row for each true velocity, a column for each objective."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    titles = list(dict.fromkeys(title for title, _ in surfaces))
    figure, axes = plt.subplots(
        len(TRUTHS), len(titles), figsize=(2.4 * len(titles), 5.2), layout="constrained"
    )
    for (title, truth), surface in surfaces.items():
        axis = axes[TRUTHS.index(truth), titles.index(title)]
        edges = (ALONG[0], ALONG[-1], ALONG[0], ALONG[-1])
        axis.imshow(surface, origin="lower", extent=edges, cmap="viridis")
        axis.plot(*truth, "w+", markersize=12, label="true")
        axis.plot(*least(surface), "r.", label="least")
        axis.set_title(title, fontsize=9)
        axis.set_xlabel("u, px/frame", fontsize=8)
    axes[0, 0].legend(fontsize=8)
    figure.savefig(path, dpi=100)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--out", type=Path, required=True, help="folder for landscape.png")
    parser.add_argument("--seeds", type=int, default=3)
    arguments = parser.parse_args()
    choices = {
        f"{way}, r_t = {r_t:g}": Params.of({**LITERAL_FRAMES, **settings, "r_t": r_t})
        for way, settings in WAYS.items()
        for r_t in PENALTIES
    }
    choices["soft vote"] = Params.of({"preset": "frames"})
    surfaces = {}
    head = " | ".join(f"true {truth}: least at | off, px/frame | worst" for truth in TRUTHS)
    print(f"| objective | {head} |\n|---|" + "---|---:|---:|" * len(TRUTHS))
    for title, params in choices.items():
        cells = []
        for truth in TRUTHS:
            found = []
            for seed in range(arguments.seeds):
                surface = objective(params, truth, seed)
                surfaces.setdefault((title, truth), surface)
                found.append(least(surface))
            off = np.linalg.norm(np.array(found) - truth, axis=1)
            cells.append(f"({found[0][0]:g}, {found[0][1]:g}) | {off.mean():.2f} | {off.max():.2f}")
        print(f"| {title} | {' | '.join(cells)} |", flush=True)
    shown = [f"fixed, r_t = {r_t:g}" for r_t in (0.0, 2e3, 1e4, 2e4)]
    shown += [f"crossing, r_t = {1e4:g}", "soft vote"]
    draw(
        {pair: surfaces[pair] for pair in surfaces if pair[0] in shown},
        arguments.out / "landscape.png",
    )


if __name__ == "__main__":
    main()
