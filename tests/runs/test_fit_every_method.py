"""Every registered method takes a step of a fit from a tiny file, is searched, or says why not."""

import dataclasses
import json
from pathlib import Path

import jax
import numpy as np
import pytest
from texture import moving

import jaxevent
from jaxevent.errors import InputError
from jaxevent.methods import METHODS, names
from jaxevent.runs.family import FitData
from jaxevent.runs.fit_config import Task, read_plan
from jaxevent.simulate import CircularMotion, Target, motion_scene, simulate_blobs
from jaxevent.tuning import loss_and_grad, optimise

# Of each method a number whose gradient is not 0 in its recording; by default c_on.
FITTED = {"moving_moments": "tau_moments"}
IDLE = ("blend", "last-frame")  # images that depend on the frames' clock alone
SEARCHED = {"batch": "half_window", "contrast": "duration", "planes": "window", "frames": "returns"}
SMALL = {
    "blob": {"events_per_step": 16, "lambda0": 4.0},
    "contrast": {"duration": 0.05, "events": 500, "fewest": 50, "starts": 3, "steps": 3},
    "planes": {"constraints": 20},
    "frames": {"fewest": 3},
}
HEAD = {
    "reconstruction": 'split = [1, 0, 0]\nerror = "nll"\n',
    "blob": "window = 0.02\nsplit = [1, 0, 0]\nseeds = [[65.0, 45.0, 4.0]]\n",
    "egomotion": 'truth = "*.csv"\nruns = 1\nsettle = 0.0\nsplit = [1, 0, 0]\nwindow = 0.1\n',
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("methods")
    jaxevent.save(moving(), folder / "reconstruction.h5")
    circle = CircularMotion((60, 45), 5, 100.0, size=(4.0, 3.0))
    jaxevent.save(
        simulate_blobs([Target(circle, 2e4)], (120, 90), 0.02, 0.0, 0)[0], folder / "blob.h5"
    )
    recording, source = motion_scene("planar", "constant", 0, size=(48, 36), duration=0.1)
    t = np.arange(recording.start, recording.stop + 1, 5000)
    stamps = np.arange(recording.start, recording.stop, 20_000, dtype=np.int64)
    seen = np.stack([source.intensity(s * 1e-6) for s in stamps])
    images = np.clip(255 * seen / seen.max(), 0, 255).astype(np.uint8)
    frames = jaxevent.Frames(stamps, images, np.zeros(len(stamps), np.int64))
    recording = dataclasses.replace(recording, frames=frames).check()
    jaxevent.save(recording, folder / "egomotion.h5")
    lines = [f"{s * 1e-6},{u},{v}" for s, (u, v) in zip(t, source.velocity(t), strict=True)]
    (folder / "egomotion.csv").write_text("\n".join(["t,vx,vy", *lines]) + "\n")
    return folder


def task(folder: Path, name: str, what: str) -> Task:
    """A method read from the smallest configuration that fits it."""
    family = METHODS[name].family
    small = {**SMALL.get(family, {}), **SMALL.get(name, {})}
    given = ", ".join(f"{key} = {json.dumps(value)}" for key, value in small.items())
    head = HEAD[family]
    if not METHODS[name].has_covariance:
        head = head.replace('error = "nll"\n', "")
    text = f'recordings = ["{family}.h5"]\niterations = 1\nrounds = 1\n{head}'
    if name == "batch":
        text += 'model = "general"\n'
    text += f'[[method]]\nname = "{name}"\nparams = {{ {given} }}\n{what}\n'
    (folder / f"{name}.toml").write_text(text)
    return read_plan(folder / f"{name}.toml").tasks[0]


def number_of(name: str) -> str:
    return FITTED.get(name, {"blob": "Q_v"}.get(METHODS[name].family, "c_on"))


# Fits of these have tests of their own: test_fit, test_fit_blob, test_fit_motion.
ELSEWHERE = ("akf", "aks", "moment", "voting")
GRADIENT = [name for name in names() if METHODS[name].differentiable]
HOST = list(SEARCHED)


def test_every_method_is_in_one_of_the_lists():
    assert sorted([*GRADIENT, *HOST, "flow"]) == sorted(names())


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in GRADIENT if name not in ELSEWHERE])
def test_the_loss_has_a_slope(folder, name):
    """The first step of the fit: its loss is finite, its slope too, and not 0 if it can be."""
    with jax.enable_x64(name != "events-only"):  # its kernels serve other tests
        check_slope(folder, name)


def check_slope(folder: Path, name: str) -> None:
    number = number_of(name)
    one = task(folder, name, f'fit = ["{number}"]')
    path = folder / f"{METHODS[name].family}.h5"
    recording = dataclasses.replace(jaxevent.load(path), name=str(path))
    sources = {"fit": [(path.name, recording)], "validation": [], "test": []}
    problem = one.goal.problem(FitData(sources, (1, 0, 0), 0.1))
    (batch, *_), _ = problem(one.params)
    raw = {number: one.params.raw[number][None]}
    forward = one.settings.forward is not False
    loss, slope = loss_and_grad(one.goal.loss, forward, one.params, raw, batch)
    assert np.isfinite(loss).all() and np.isfinite(slope[number]).all()
    acts = abs(float(slope[number][0])) > 1e-7 * abs(float(loss[0]))
    assert acts == (name not in IDLE)


@pytest.mark.parametrize("name", HOST)
def test_a_method_on_the_host_is_searched_and_not_fitted(folder, name):
    number = SEARCHED[name]
    with pytest.raises(InputError, match="no gradient to follow; search its numbers: search ="):
        task(folder, name, f'fit = ["{number}"]')
    assert list(task(folder, name, f"search = {{ {number} = [0.1, 0.2, 3] }}").search) == [number]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["planes", "frames"])
def test_a_search_ends_at_the_least_loss_of_what_the_method_tells(folder, name):
    if name == "frames":
        pytest.importorskip("cv2")
    number = SEARCHED[name]
    start = float(getattr(METHODS[name].Params(**SMALL.get(name, {})), number))
    points = [0.5 * start, start, 2 * start]
    one = task(folder, name, f"search = {{ {number} = [{points[0]}, {points[2]}, 4] }}")
    path = folder / "egomotion.h5"
    recording = dataclasses.replace(jaxevent.load(path), name=str(path))
    sources = {"fit": [(path.name, recording)], "validation": [], "test": []}
    problem = one.goal.problem(FitData(sources, (1, 0, 0), 1.0))
    losses = {}
    for value in points:
        params = one.params.replace(**{number: value})
        (batch,), _ = problem(params)
        losses[value] = float(one.goal.loss(params, batch))
        told = METHODS[name].estimate(recording, params, model="planar", seed=0)(
            batch_times(batch, recording), extrapolate=True
        )
        mean = np.where(told.valid[:, None], told.mean, 0)
        truth = np.array([np.interp(batch.time, batch.grid, c) for c in batch.truth.T]).T
        mine = ((mean - truth) ** 2).sum(1)[batch.counted > 0].mean()
        scale = (truth**2).sum(1)[batch.counted > 0].mean()
        assert losses[value] == pytest.approx(mine / scale, rel=5e-3)
    fitted = optimise(one.goal.loss, one.params, (), problem, (), one.settings, one.search)
    assert fitted.loss <= min(losses.values()) * 1.0001


def batch_times(batch, recording) -> np.ndarray:
    return np.rint(recording.start + 1e6 * batch.time).astype(np.int64)


@pytest.mark.slow
def test_flow_says_why_it_is_not_fitted(folder):
    with pytest.raises(InputError, match="cannot be fitted; fit another, or compare"):
        task(folder, "flow", "search = { clock_offset = [-0.01, 0.01, 3] }")
