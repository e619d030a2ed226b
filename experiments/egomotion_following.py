"""Windows of slider_depth that follow the one before: by the stages they pass, and by all of them.

    python experiments/egomotion_following.py --data FOLDER [--turned 3 [--exact]]

At three times a window of 300 ms is fitted from the path 0.1 s before, once through all stages of a
window that starts from nothing and once through those of a predicted path. Prints the error of the
heading (degrees; truth is T to the right), |Omega| (degrees/s; truth 0), the cost per event and
CPU seconds.

With `--turned` windows at 0.5 s begin from a camera that turns about the vertical by so many
degrees/s, one way and the other, before depths that make the same flow in the middle of the image.
With `--exact` they go on at one sigma of misfits by steps of Gauss and Newton, which are solved as
in the library, or by so many steps of conjugate gradients that they are about exact. Prints where
the turn goes, and what is minimised (half a squared misfit by its variance is 1).
"""

import argparse
import functools
import time
from pathlib import Path as Place

import numpy as np

import jaxevent
from jaxevent.egomotion.bundle import hypotheses, normal_equations, photometric_ba
from jaxevent.egomotion.bundle.hypotheses import Hypothesis, WindowFitter
from jaxevent.egomotion.bundle.warp import Path, predict_path
from jaxevent.egomotion.bundle.windows import Params

CENTRES = 700_000, 1_500_000, 2_500_000  # us
BEFORE = 100_000
TURNED = 500_000  # us
USUAL = 0.43  # 1/m in units of 1/|T|, the depth there
ALL = hypotheses.COARSE_TO_FINE_STAGES, hypotheses.FINAL_STAGES[:-1], hypotheses.FINAL_STAGES[-1:]
FEW = (
    hypotheses.PREDICTED_COARSE_TO_FINE_STAGES,
    hypotheses.PREDICTED_STAGES,
    hypotheses.PREDICTED_FINAL_STAGES,
)


SIGMA, STEPS = 0.1, 12  # C; of Gauss and Newton
EARLY, EXACT = (
    (normal_equations.MAX_CG_STEPS, normal_equations.CG_TOLERANCE),
    (640, 1e-4),
)  # of conjugate gradients


def begun(windows: WindowFitter, rate: float) -> Hypothesis:
    """A window that follows a turn (degrees/s) about the vertical."""
    half, turn = float(windows.params.half_window), np.radians(rate)
    nodes = np.prod(windows.series(TURNED, half, 2000).nodes)
    level = np.full(nodes, np.log(USUAL - turn), windows.real)
    path = Path.constant_twist(np.array([1.0, 0, 0]), np.array([0, turn, 0]), level)
    return windows.refine_from(TURNED, path)


def exact(windows: WindowFitter, rate: float) -> None:
    """Where the turn goes by solutions that are stopped early, and by others."""
    (normal_equations.MAX_CG_STEPS, left), half = EARLY, float(windows.params.half_window)
    photometric_ba.solve = functools.partial(normal_equations.solve, tolerance=left)  # ty: ignore[invalid-assignment]
    scene, _ = begun(windows, rate)
    series = windows.series(TURNED, half, windows.params.events)
    prior = windows.prior(TURNED, half)
    problem, begun_with = photometric_ba.init_problem(series, scene, prior, SIGMA, False)
    for normal_equations.MAX_CG_STEPS, left in (EARLY, EXACT):
        photometric_ba.solve = functools.partial(normal_equations.solve, tolerance=left)  # ty: ignore[invalid-assignment]
        kept, told = begun_with, [begun_with]
        for _ in range(STEPS):
            kept = normal_equations.evaluate(
                problem, photometric_ba.gauss_newton_step(problem, kept, 0.0, False), kept.weight
            )
            told.append(kept)
        turns = [np.degrees(one.scene.path.twist(0.0)[1][0, 1]) for one in told]
        print(
            f"from {rate:+.1f} deg/s, at most {normal_equations.MAX_CG_STEPS} steps of conjugate "
            f"gradients: wy {' '.join(f'{turn:+.2f}' for turn in turns)}, of energy "
            f"{' '.join(f'{one.objective:.0f}' for one in told[1:])}",
            flush=True,
        )


def turned(windows: WindowFitter, rate: float) -> None:
    """Where a window ends that begins from a turn (degrees/s) about the vertical."""
    fit = windows.refine_final(TURNED, [begun(windows, rate)])
    assert fit is not None
    heading, Omega = (part[0] for part in fit.path.twist(0.0))
    print(
        f"from {rate:+.1f} deg/s: wy {np.degrees(Omega[1]):+.2f}, its sigma "
        f"{np.degrees(np.sqrt(fit.covariance[4, 4])):.2f}, heading "
        f"{np.degrees(np.arccos(heading[0])):.2f}, events explained {fit.agreement:.2f}, sigma of "
        f"misfits at least {windows.sigma_floor[TURNED]:.2f} C",
        flush=True,
    )


def use(stages: tuple[tuple[hypotheses.Stage, ...], ...]) -> None:
    """Let predicted paths pass these stages."""
    setattr(hypotheses, "PREDICTED_COARSE_TO_FINE_STAGES", stages[0])  # noqa: B010
    setattr(hypotheses, "PREDICTED_STAGES", stages[1])  # noqa: B010


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--data", type=Place, required=True, help="folder of slider_depth.zip")
    parser.add_argument("--turned", type=float, help="degrees/s that windows begin with")
    parser.add_argument("--exact", action="store_true", help="by exact steps from there")
    arguments = parser.parse_args()
    recording = jaxevent.load(arguments.data / "slider_depth.zip")
    assert recording.camera is not None
    windows = WindowFitter(recording, Params.of({}), recording.camera)
    if arguments.turned is not None:
        for rate in (0.0, arguments.turned, -arguments.turned):
            (exact if arguments.exact else turned)(windows, rate)
        return
    half = float(windows.params.half_window)
    for centre in CENTRES:
        nodes = np.prod(windows.series(centre - BEFORE, half, 2000).nodes)
        level = np.full(nodes, np.log(0.5), windows.real)
        use(ALL)
        begun = Path.constant_twist(np.array([1.0, 0, 0]), np.zeros(3), level)
        path = windows.refine_from(centre - BEFORE, begun)[0].path
        warm = predict_path(path, BEFORE * 1e-6, half)
        for name, stages in (("all", ALL), ("few", FEW)):
            use(stages)
            clock = time.process_time()
            rival = windows.refine_from(centre, warm)
            stages_s = time.process_time() - clock
            fit = windows.refine_final(centre, [rival], stages[2])
            seconds = time.process_time() - clock
            assert fit is not None
            heading, turn = (part[0] for part in fit.path.twist(0.0))
            print(
                f"{centre * 1e-6:.1f} s, {name}: heading {np.degrees(np.arccos(heading[0])):.2f}, "
                f"|Omega| {np.degrees(np.linalg.norm(turn)):.2f}, cost {fit.cost:.2e}, "
                f"{stages_s:.1f} s of {seconds:.1f} s",
                flush=True,
            )


if __name__ == "__main__":
    main()
