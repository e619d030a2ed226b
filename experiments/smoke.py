"""A short use of each part of jaxevent with its core dependencies alone, for `versions.py`.

Prints one line of JSON: for each part None, or the reason why it failed.
"""

import importlib.metadata
import json
import subprocess
import sys
import tempfile
from collections.abc import Callable
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from versions import core_dependencies

import jaxevent
from jaxevent.recording import Frames, Recording

CROP = Path(str(files("jaxevent") / "data/slider_depth_crop.h5"))
COMPARE = """
recordings = [{crop}]
[[method]]
name = "akf"
"""
FIT = "iterations = 2\nrounds = 1" + COMPARE + 'fit = ["c_on"]'
REASON = 200  # characters of a reason that are printed


def load_crop() -> tuple[Recording, Frames]:
    """Load the packaged recording; returns it and its frames."""
    recording = jaxevent.load(CROP)
    assert recording.frames is not None
    return recording, recording.frames


def try_images() -> None:
    """Images between frames are near to the frames around, by a filter, a smoother and paths."""
    recording, frames = load_crop()
    times = frames.t[4:6] + 5_000
    for method in (jaxevent.akf, jaxevent.aks, jaxevent.mc):
        image, variance, valid = method.estimate(recording)(times)
        assert valid.mean() > 0.9 and (variance[valid] >= 0).all()
        error = np.abs(image - frames[4:6].intensity)[valid].mean()
        assert error < 0.1, f"images of {method.name} are {error:.3f} away from the frames"


def try_compilers() -> None:
    """Images by numba and by XLA are the same to rounding."""
    recording, frames = load_crop()
    times = frames.t[4:6] + 5_000
    numba, xla = (
        jaxevent.akf.estimate(recording, compiler=compiler)(times).mean
        for compiler in (None, "xla")
    )
    np.testing.assert_allclose(numba, xla, atol=1e-4)


def try_gradient() -> None:
    """The gradient of a loss of akf by kernels is that by XLA."""
    import jax

    recording, frames = load_crop()
    given, hidden = recording.with_frames(slice(0, None, 2)), frames[1:8:2]
    params = jaxevent.akf.Params(c_on=0.083, c_off=0.059)
    truth = hidden.intensity.reshape(len(hidden), -1)

    def slope(compiler: str | None) -> Any:
        images = jaxevent.akf.prepare_images(given, hidden.t, params, compiler=compiler)
        return jax.grad(lambda params: ((images(params).mean - truth) ** 2).mean())(params)

    kernel, xla = (
        np.hstack([np.ravel(leaf) for leaf in jax.tree.leaves(slope(compiler))])
        for compiler in (None, "xla")
    )
    assert np.abs(xla).max() > 0
    np.testing.assert_allclose(kernel, xla, rtol=1e-2, atol=1e-3 * np.abs(xla).max())


def try_track() -> None:
    """A simulated blob is found and followed."""
    from jaxevent.simulate.blobs import blob_scene

    recording, truth = blob_scene("lissajous", rate=2e4)
    tracks = jaxevent.blob.moment.estimate(recording[:150_000])
    times = np.arange(50_000, 140_000, 10_000)
    error = np.abs(tracks(times).mean[..., :2] - truth(times)[..., :2]).max()
    assert error < 2, f"the track is {error:.1f} px away from the blob"


def try_motion() -> None:
    """The motion of a simulated camera is found by voting."""
    from jaxevent.egomotion import voting
    from jaxevent.simulate.motion import motion_scene

    recording, source = motion_scene("planar", size=(80, 60), duration=0.2, seed=1)
    times = np.arange(120_000, 190_000, 10_000)
    found = voting.estimate(recording, model="planar")(times).mean
    error = np.linalg.norm(np.median(found, 0) - source.velocity(times)[0])
    assert error < 20, f"the motion is {error:.0f} px/s away from the camera's"


def try_commands() -> None:
    """Commands end well: what is in a file, images, a fit, and an evaluation."""
    with tempfile.TemporaryDirectory() as folder:
        fit, compare, out = (Path(folder) / name for name in ("fit.toml", "compare.toml", "a.h5"))
        for config, text in ((fit, FIT), (compare, COMPARE)):
            config.write_text(text.format(crop=json.dumps(str(CROP))))
        for words in (
            ["info", str(CROP)],
            ["reconstruct", str(CROP), "--method", "akf", "--rate", "50", "--out", str(out)],
            ["fit", str(fit), "--out", f"{folder}/fitted"],
            ["evaluate", str(compare), "--out", f"{folder}/results"],
        ):
            command = [sys.executable, "-m", "jaxevent", *words]
            done = subprocess.run(command, capture_output=True, text=True)
            assert done.returncode == 0, done.stderr[-REASON:]
        assert out.stat().st_size > 0


PARTS: dict[str, Callable[[], None]] = {
    "images": try_images,
    "compilers": try_compilers,
    "gradient": try_gradient,
    "track": try_track,
    "motion": try_motion,
    "commands": try_commands,
}


def main() -> None:
    results: dict[str, str | None] = {}
    for name, attempt in PARTS.items():
        try:
            attempt()
            results[name] = None
        except Exception as error:
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            results[name] = reason[:REASON]
    versions = {name: importlib.metadata.version(name) for name in core_dependencies()}
    print(json.dumps({"versions": versions, "results": results}))


if __name__ == "__main__":
    main()
