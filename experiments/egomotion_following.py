"""Windows of slider_depth that follow the one before: by the stages they pass, and by all of them.

    python experiments/egomotion_following.py --data FOLDER

At three times a window of 300 ms is fitted from the path 0.1 s before, once through all stages of a
window that starts from nothing and once through those of `windows.FOLLOWING`. Prints the error of
the heading (degrees; truth is T to the right), |Omega| (degrees/s; truth 0), the cost per event and
CPU seconds.
"""

import argparse
import time
from pathlib import Path as Place

import numpy as np

import jaxevent
from jaxevent.egomotion.batch_fit import windows as batch
from jaxevent.egomotion.batch_fit.path import Path, advanced

CENTRES = 700_000, 1_500_000, 2_500_000  # us
BEFORE = 100_000
ALL = batch.ROUNDS, batch.FINAL[:-1]
FEW = batch.FOLLOWING


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--data", type=Place, required=True, help="folder of slider_depth.zip")
    recording = jaxevent.load(parser.parse_args().data / "slider_depth.zip")
    assert recording.camera is not None
    windows = batch.Windows(recording, batch.Params.of({}), recording.camera)
    half = float(windows.params.half_window)
    for centre in CENTRES:
        nodes = np.prod(windows.tracks(centre - BEFORE, half, 2000).nodes)
        level = np.full(nodes, np.log(0.5), windows.real)
        batch.FOLLOWING = ALL
        begun = Path.constant(np.array([1.0, 0, 0]), np.zeros(3), level)
        path = windows.followed(centre - BEFORE, begun)[0].path
        warm = advanced(path, BEFORE * 1e-6, half)
        for name, stages in (("all", ALL), ("few", FEW)):
            batch.FOLLOWING, clock = stages, time.process_time()
            rival = windows.followed(centre, warm)
            stages_s = time.process_time() - clock
            fit = windows.ended(centre, [rival])
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
