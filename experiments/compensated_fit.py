"""`mc` fitted by gradients of its likelihood and of its error: configs/fit_mc.toml on a small part.

    python experiments/compensated_fit.py --out fitted

The part is 0.6 s of 80 x 64 pixels of the packaged recording, small so that a fit takes minutes of
a CPU. The folder then holds what `jaxevent fit` writes. What was found is scored on whole images of
the time that follows, every second frame of which is hidden, beside the defaults.
"""

import argparse
import dataclasses
import tomllib
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

import jaxevent
from jaxevent.runs.demo import RECORDING
from jaxevent.runs.fit import fit
from jaxevent.runs.scores import score

CONFIG = Path(__file__).parents[1] / "configs" / "fit_mc.toml"
LEFT, TOP, WIDTH, HEIGHT = 90, 80, 80, 64  # px
SECONDS, LATER = slice(0.5, 1.1), slice(1.1, None)


def part(recording: jaxevent.Recording) -> jaxevent.Recording:
    """A part of the image, for a part of the time, without the poses."""
    cut = recording[SECONDS]
    assert cut.frames is not None
    events = cut.events[:]
    x, y = events.x.astype(int) - LEFT, events.y.astype(int) - TOP
    inside = (x >= 0) & (x < WIDTH) & (y >= 0) & (y < HEIGHT)
    seen = jaxevent.Events(
        events.t[inside], x[inside].astype(np.uint16), y[inside].astype(np.uint16), events.p[inside]
    )
    images = np.asarray(cut.frames.images[:])[:, TOP : TOP + HEIGHT, LEFT : LEFT + WIDTH]
    frames = dataclasses.replace(cut.frames, images=images)
    return jaxevent.Recording("part", WIDTH, HEIGHT, seen, frames)


def scored(later: jaxevent.Recording, found: dict[str, dict[str, Any]]) -> None:
    """Prints errors at hidden frames, by label of the parameters."""
    for label, values in found.items():
        row = score(later, jaxevent.mc, jaxevent.mc.Params.of(values), progress=False)
        print(f"{label}: MSE {100 * row['mse']:.4f}e-2, SSIM {row['ssim']:.3f}, z2 {row['z2']:.2f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--out", type=Path, required=True, help="folder for everything made")
    out = parser.parse_args().out.absolute()
    out.mkdir(parents=True, exist_ok=True)
    with resources.as_file(RECORDING) as path:
        recording = jaxevent.load(path)
    jaxevent.save(part(recording), out / "part.h5")
    fit(CONFIG, out / "fitted", [out / "part.h5"])
    print((out / "fitted" / "results.md").read_text())
    found = tomllib.loads((out / "fitted" / "params.toml").read_text())
    scored(recording[LATER], {"defaults": {}, **found})


if __name__ == "__main__":
    main()
