"""A motion model from outside the package works wherever the package's own do.

`own_model.ZoomRoll` has two components and needs no camera; its truth is told by tables.
"""

import functools
import json

import jax
import numpy as np
import pandas as pd
import pytest
import scipy.linalg
from commands import fails
from own_model import Params, ZoomRoll
from points import HEIGHT, WIDTH, moved

import jaxevent
from jaxevent import cli
from jaxevent.egomotion import contrast, find_model, planes, voting
from jaxevent.egomotion.flow import flow

MODEL = "own_model:ZoomRoll"
TRUTH = np.array([1.2, 2.0])
MATRIX = np.array([[TRUTH[0], -TRUTH[1]], [TRUTH[1], TRUTH[0]]])
MIDDLE = np.array([(WIDTH - 1) / 2, (HEIGHT - 1) / 2])
SMALL = {"particles": 60, "candidates": 48, "radius": 6, "baseline": 4.5}


@functools.cache
def turning():
    return moved(lambda at: (at - MIDDLE) @ MATRIX.T, 0.25, 120, seed=1)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """turning.h5 and the table of its truth."""
    folder = tmp_path_factory.mktemp("own")
    jaxevent.save(turning(), folder / "turning.h5")
    table = {"t": [0.0, 0.1, 0.3], "zoom": TRUTH[0], "roll": TRUTH[1]}
    pd.DataFrame(table).to_csv(folder / "turning.csv", index=False)
    return folder


def off(mean):
    """The mean relative error."""
    return np.linalg.norm(mean - TRUTH, axis=1).mean() / np.linalg.norm(TRUTH)


def test_it_is_found_by_its_path():
    assert find_model(MODEL) is ZoomRoll and find_model(ZoomRoll) is ZoomRoll
    for path, said in (
        ("own_model:Zoom", "'own_model:Zoom' cannot be imported"),
        ("own_model:guess", "is a Guess, not a type"),
        ("own_model:Params", "is no motion model"),
    ):
        with pytest.raises(jaxevent.InputError, match=said):
            find_model(path)


@pytest.mark.slow
def test_methods_find_the_true_motion():
    recording, params = turning(), voting.Params(**SMALL)
    motion = voting.estimate(recording, params, model=MODEL, compiler="numba")
    assert motion.valid[motion.t > 170_000].all()
    assert off(motion.mean[motion.t > 170_000]) < 0.05
    mean, covariance, valid = motion(np.array([200_000]))
    assert mean.shape == (1, 2) and covariance.shape == (1, 2, 2) and valid.all()
    # The flow of events is that of the true motion, and with it events fall together.
    told = flow(recording, motion)
    late = told.valid & (recording.events.t > 200_000)
    at = np.stack([recording.events.x, recording.events.y], 1)[late] - MIDDLE
    error = np.linalg.norm(told.flow[late] - at @ MATRIX.T, axis=1)
    assert np.median(error) < 0.06 * np.median(np.linalg.norm(at @ MATRIX.T, axis=1))
    fast = contrast.Params(events=3000, duration=0.04, omega_max=3.0, starts=5, margin=8)
    motion = contrast.estimate(recording[0.1:0.2], fast, model=ZoomRoll)
    assert motion.valid.all() and off(motion.mean) < 0.05
    with pytest.raises(jaxevent.InputError, match="does not know zoom and roll but general"):
        jaxevent.METHODS["batch"].estimate(recording, model=ZoomRoll)
    assert planes.supports(ZoomRoll)


def test_the_package_supplies_how_places_move():
    xi, way = np.array([[30.0, -20.0], [-50.0, 5.0]]), np.array([[0.1, 0.2], [-0.05, 0.02]])
    back = ZoomRoll().warp(xi, way)
    for one, (zoom, roll), place in zip(back, way, xi, strict=True):
        matrix = scipy.linalg.expm(-np.array([[zoom, -roll], [roll, zoom]]))
        np.testing.assert_allclose(one, matrix @ place, atol=2e-3)
    np.testing.assert_allclose(ZoomRoll().pixel_scale(xi), [np.sqrt((xi**2).sum(1).mean())] * 2)


@pytest.mark.slow
def test_a_run_is_pure():
    """Prepare, run, read; over seeds and parameters in one program, with a gradient."""
    recording = turning()[0.0:0.1]
    params = voting.Params(**SMALL)
    times = np.array([60_000, 90_000])
    features, out = voting.prepare(recording, times, params, model=MODEL, seed=3)

    @jax.jit
    @jax.value_and_grad
    def size(params):
        trajectory, state = voting.run(params, features)
        mean, covariance, valid = voting.read(params, trajectory, out)
        assert mean.shape == (2, 2) and covariance.shape == (2, 2, 2) and valid.shape == (2,)
        return (mean**2).sum()

    value, slope = size(params)
    assert np.isfinite(value) and np.isfinite(slope.raw["alpha"])
    for name in params.names_without_gradient():
        assert slope.raw[name] == 0, name
    with pytest.raises(jaxevent.InputError, match="extrapolate=True"):
        voting.prepare(recording, np.array([2_000_000]), params, model=MODEL)


@pytest.mark.slow
def test_it_is_evaluated(folder, capsys):
    settings = ", ".join(f"{k} = {v}" for k, v in SMALL.items())
    config = folder / "run.toml"
    config.write_text(
        f'recordings = ["turning.h5"]\nprotocol = "motion"\nmodel = "{MODEL}"\n'
        f'truth = "*.csv"\nsettle = 0.17\n[[method]]\nname = "voting"\n'
        f'params = {{ {settings} }}\n[[method]]\nname = "own_model:guess"\nlabel = "guess"\n'
    )
    assert cli.main(["evaluate", str(config), "--out", str(folder / "out")]) == 0
    rows = json.loads((folder / "out" / "results.json").read_text())["rows"]
    assert [row["method"] for row in rows] == ["voting", "guess"]
    assert rows[0]["model"] == MODEL and rows[0]["vector_error"] < 5 and rows[0]["lost"] == 0
    wrong = 100 * np.linalg.norm([0.5, 1.0] - TRUTH) / np.linalg.norm(TRUTH)
    assert rows[1]["vector_error"] == pytest.approx(wrong)
    assert "guess" in capsys.readouterr().out


@pytest.mark.slow
def test_it_is_fitted(folder, capsys):
    settings = ", ".join(f"{k} = {v}" for k, v in SMALL.items())
    config = folder / "fit.toml"
    config.write_text(
        f'recordings = ["turning.h5"]\nmodel = "{MODEL}"\ntruth = "*.csv"\nsplit = [1, 1, 1]\n'
        "window = 0.08\nruns = 2\niterations = 3\nrounds = 1\nevery = 1\n"
        f'[[method]]\nname = "voting"\nparams = {{ {settings}, noise_rotation = 9.0 }}\n'
        'fit = ["noise_rotation"]\n'
        '[[method]]\nname = "own_model:guess"\nlabel = "guess"\nfit = ["zoom", "roll"]\n'
        "iterations = 60\nlearning_rate = 0.1\n"
    )
    assert cli.main(["fit", str(config), "--out", str(folder / "fitted")]) == 0
    fitted = folder / "fitted" / "params.toml"
    assert float(voting.Params.load(fitted, "voting").noise_rotation) < 9
    guessed = Params.load(fitted, "guess")
    np.testing.assert_allclose([guessed.zoom, guessed.roll], TRUTH, rtol=0.05)
    assert "error %" in capsys.readouterr().out
    config.write_text(config.read_text().replace('["noise_rotation"]', '["r_t"]'))
    fails(capsys, ["fit", config, "--out", folder / "no"], "r_t does nothing with likelihood")


@pytest.mark.slow
def test_it_is_on_the_command_line(folder, capsys):
    (folder / "mine.toml").write_text("".join(f"{k} = {v}\n" for k, v in SMALL.items()))
    argv = ["motion", folder / "turning.h5", "--model", MODEL, "--method", "voting", "--params",
            folder / "mine.toml", "--truth", folder / "turning.csv", "--out", folder / "told",
            "--start", 0.17]  # fmt: skip
    assert cli.main([str(word) for word in [*argv[:-2]]]) == 0
    said = capsys.readouterr().out
    assert "zoom and roll by voting" in said and "vector_error" in said
    table = pd.read_csv(folder / "told" / "motion.csv")
    assert list(table.columns) == ["t", "zoom", "roll", "sigma_zoom", "sigma_roll", "lost"]
    late = table[(table.t > 0.17) & (table.lost == 0)]
    assert len(late) > 50 and off(late[["zoom", "roll"]].to_numpy()) < 0.05
    fails(capsys, [*argv[:-4], "--out", folder / "no", "--truth"], "rates is known neither")
