"""Faults that the tests catch: each is put into a copy of the tree, where its tests must fail.

    python experiments/mutations.py [--only WORD] [--page docs/guards.md]

A mutation is one text replaced in one file, with the tests that guard it. A text that is not found
is an error, so the list cannot go stale. `--page` writes the table that docs/guards.md shows.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]


class Mutation(NamedTuple):
    """Fault: the text in a file, its replacement, the tests (pytest's words) that catch it."""

    fault: str
    file: str
    old: str
    new: str
    tests: str


CHAIN = "tests/reconstruction/test_reconstruction.py -k chain_equals_loop_over_events"
MUTATIONS = (
    Mutation(
        "AKF: the Riccati equation as the paper prints it, P' = P^2 / R + Q",
        "jaxevent/reconstruction/kalman.py",
        "gain = 1 / (1 + state.P * dt * rate)",
        "gain = 1 / (1 - state.P * dt * rate)",
        f"{CHAIN} -k akf",
    ),
    Mutation(
        "AKF: isolated noise grows with the pixel's own time",
        "jaxevent/reconstruction/kalman.py",
        "params.sigma_iso**2 * event.near",
        "params.sigma_iso**2 * event.since",
        f"{CHAIN} -k akf",
    ),
    Mutation(
        "AKF: the bound of the refractory period is left out",
        "jaxevent/reconstruction/kalman.py",
        "return Q_proc + Q_iso + params.sigma_ref**2 * refractory_indicator(params, event.since)",
        "return Q_proc + Q_iso",
        f"{CHAIN} -k akf",
    ),
    Mutation(
        "CF: the gain does not depend on the gap",
        "jaxevent/reconstruction/complementary.py",
        "decay = jnp.exp(-frame.rate * dt)",
        "decay = jnp.exp(-frame.rate * 1e-3)",
        f"{CHAIN} -k cf",
    ),
    Mutation(
        "OFF events count as ON",
        "jaxevent/reconstruction/augment.py",
        "return params.c_on * on - params.c_off * off",
        "return params.c_on * on + params.c_off * off",
        f"{CHAIN} -k cf",
    ),
    Mutation(
        "a dead time is not made good",
        "jaxevent/reconstruction/augment.py",
        "polarity < 0) * jnp.where(rho > 0, events, 1)",
        "polarity < 0)",
        f"{CHAIN} -k cf",
    ),
    Mutation(
        "the state's derivative forgets what parameters push",
        "jaxevent/reconstruction/filtering.py",
        "after.append(functools.reduce(jnp.add, [*terms, push]))",
        "after.append(functools.reduce(jnp.add, terms))",
        "tests/reconstruction/test_own_filter.py -k gradients",
    ),
    Mutation(
        "AKS: the likelihood forgets that the state is uncertain",
        "jaxevent/reconstruction/smoother.py",
        "s2 = state.P + row.r\n",
        "s2 = row.r\n",
        "tests/test_gallery.py -k fit_noise",
    ),
    Mutation(
        "threads read one video at the same time",
        "jaxevent/reconstruction/video.py",
        "self._turns.iterate(self._read(among_events))",
        "self._read(among_events)",
        "tests/test_threads.py -k shared_video",
    ),
    Mutation(
        "filtering taken up again at a window forgets its state",
        "jaxevent/reconstruction/video.py",
        "        state = begin.state\n",
        "        state = None\n",
        "tests/reconstruction/test_reconstruction.py -k windows_do_not_change",
    ),
    Mutation(
        "times outside the recording are answered",
        "jaxevent/recording.py",
        "if len(us) and (us.min() < start_us or us.max() > stop_us):",
        "if False:",
        "tests/test_notebook.py -k outside",
    ),
    Mutation(
        "steps lead prepared numbers away",
        "jaxevent/parameters.py",
        "return self.physical(jax.lax.stop_gradient(raw) if stops else raw)",
        "return self.physical(raw)",
        "tests/test_notebook.py -k all_leaves",
    ),
    Mutation(
        "a share above 1 is taken",
        "jaxevent/parameters.py",
        "if not 0 <= value < 1:",
        "if not 0 <= value:",
        "tests/test_parameters.py",
    ),
    Mutation(
        "a start whose loss is not a number wins",
        "jaxevent/tuning.py",
        "seen = jnp.where(jnp.isnan(seen), jnp.inf, seen)",
        "seen = seen",
        "tests/runs/test_fit.py -k not_finite",
    ),
    Mutation(
        "blob: a gap's process noise lacks the cubic term",
        "jaxevent/blob/filters/motion.py",
        "params.Q_v * dt**3 / 3",
        "params.Q_v * dt**3 / 2",
        "tests/blob/test_blob_filters.py -k dense_joint",
    ),
    Mutation(
        "blob: nearest association takes the farthest",
        "jaxevent/blob/filter.py",
        "jnp.argmax(value)",
        "jnp.argmin(value)",
        "tests/blob/test_blob_tracker.py -k plain_loop",
    ),
    Mutation(
        "blob: slopes of losses forget that the weights of events move",
        "jaxevent/blob/engine/program.py",
        "_push_forward(divide, known, log_likelihood, log_likelihood_tangent)",
        "_push_forward(divide, known, log_likelihood, 0 * log_likelihood_tangent)",
        "tests/blob/test_blob_fused.py -k slopes -k moment",
    ),
    Mutation(
        "voting: resampled particles lose the scores of their weights",
        "jaxevent/egomotion/particle_filter/engine_loop.py",
        "score if cells[LOST] == 0 else 0",
        "0 * score",
        "tests/egomotion/test_voting_engine.py -k slopes_of_the_kernel -k planar",
    ),
    Mutation(
        "intervals of rough losses are a parabola's, whether it fits or not",
        "jaxevent/confidence.py",
        "np.sqrt(np.mean(off**2)) > sample.quantile",
        "False",
        "tests/test_rough_losses.py -k wall_to",
    ),
    Mutation(
        "dead pixels are looked for among those that fire",
        "jaxevent/calibration/hot.py",
        "between |= pair",
        "between |= pair & (total > 0)",
        "tests/test_faults.py -k dead",
    ),
    Mutation(
        "conjugate gradients forget the direction before",
        "jaxevent/egomotion/bundle/cg.py",
        "share = new / max(size, 1e-30)",
        "share = 0.0",
        "tests/egomotion/test_photometric_equations.py -k gradients",
    ),
    Mutation(
        "a step that costs more is not damped",
        "jaxevent/egomotion/bundle/photometric_ba.py",
        "max(damping * DAMPING_GROWTH_FACTOR, INITIAL_DAMPING)",
        "damping",
        "tests/egomotion/test_gauss_newton.py -k accepted",
    ),
    Mutation(
        "rotation: the flow's first row has the other sign",
        "jaxevent/egomotion/geometry.py",
        "-(f + x * x / f)",
        "(f + x * x / f)",
        "tests/egomotion/test_egomotion_geometry.py",
    ),
    Mutation(
        "resampling drops the score",
        "jaxevent/egomotion/particle_filter/filtering.py",
        "return ancestor, carried[ancestor] - jnp.log(N)",
        "return ancestor, 0 * carried[ancestor] - jnp.log(N)",
        "tests/egomotion/test_egomotion_voting.py -k carries_the_score",
    ),
    Mutation(
        "a file of compiled code is unpickled whoever wrote it",
        "jaxevent/codegen/cache.py",
        "if not hmac.compare_digest(content[:_HASH], self._hash(key, payload)):",
        "if not content:",
        "tests/codegen/test_compiled_cache.py -k signed",
    ),
    Mutation(
        "a layer of the house imports upwards",
        "jaxevent/recording.py",
        "import numpy as np\n",
        "import numpy as np\n\nimport jaxevent.methods  # noqa\n",
        "tests/test_architecture.py",
    ),
)


def is_caught(mutation: Mutation, folder: Path) -> bool:
    """Return True if the tests fail in a copy of the tree that has the fault."""
    tree = folder / "tree"
    shutil.rmtree(tree, ignore_errors=True)
    leave_out = shutil.ignore_patterns(".git", ".venv", "__pycache__", "site", ".*_cache")
    shutil.copytree(ROOT, tree, ignore=leave_out)
    path = tree / mutation.file
    text = path.read_text()
    if mutation.old not in text:
        raise SystemExit(f"{mutation.file} does not hold {mutation.old!r}; mend the list")
    path.write_text(text.replace(mutation.old, mutation.new))
    words = ["-q", "-x", "-p", "no:cacheprovider", "--hypothesis-profile=any"]
    words += [*mutation.tests.split(" -k ", 1)[:1]]
    names = mutation.tests.split(" -k ")[1:]
    if names:
        words += ["-k", " and ".join(names)]
    done = subprocess.run(
        [sys.executable, "-m", "pytest", *words],
        cwd=tree,
        env={**os.environ, "PYTHONPATH": str(tree)},
        capture_output=True,
        text=True,
    )
    if done.returncode not in (0, 1, 2):
        raise SystemExit(f"{mutation.tests} ran no test:\n{done.stdout[-2000:]}")
    return done.returncode != 0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", default="", help="mutations whose fault or file has this word")
    parser.add_argument("--page", type=Path, help="write the table there")
    given = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for mutation in MUTATIONS:
            if given.only in mutation.fault + mutation.file:
                found = is_caught(mutation, Path(folder))
                rows.append((mutation, found))
                print("caught" if found else "MISSED", mutation.fault, flush=True)
    if given.page:
        lines = [
            "# Faults that the tests catch",
            "",
            "`python experiments/mutations.py --page docs/guards.md` puts each into a copy of the",
            "tree and runs the tests beside it.",
            "",
            "| fault | in | tests | |",
            "|---|---|---|---|",
        ]
        for one, found in rows:
            tests = one.tests.replace("|", "\\|")
            answer = "caught" if found else "missed"
            lines.append(f"| {one.fault} | `{one.file}` | `{tests}` | {answer} |")
        given.page.write_text("\n".join(lines) + "\n")
    if not all(found for _, found in rows):
        raise SystemExit(1)


if __name__ == "__main__":
    main()
