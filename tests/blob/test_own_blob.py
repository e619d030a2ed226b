"""A tracker defined outside the package is evaluated, fitted and run from the command line."""

import json

import jax
import numpy as np
import own_blob
import pytest

import jaxevent
from jaxevent import cli
from jaxevent.estimator import Estimator
from jaxevent.methods import find, names
from jaxevent.runs.evaluate import evaluate
from jaxevent.runs.fit import fit
from jaxevent.simulate import LinearMotion, Target, simulate_blobs

METHOD = "own_blob:student"
PARAMS = {"events_per_step": 8, "lambda0": 4.0, "Q_v": 1e4, "P0_v": 1e4}
TABLE = ", ".join(f"{name} = {value}" for name, value in PARAMS.items())


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A blob that moves along a line for 0.02 s, 800 events, and its path."""
    folder = tmp_path_factory.mktemp("own")
    line = LinearMotion((20, 20), (500, 100), size=(3.0, 3.0))
    recording, truth = simulate_blobs([Target(line, 4e4)], (60, 40), 0.02, seed=3)
    jaxevent.save(recording, folder / "a.h5")
    times = np.arange(1000, 19_000, 1000)
    rows = [f"{t / 1e6},{x},{y}" for t, (x, y) in zip(times, truth(times)[:, 0, :2], strict=True)]
    (folder / "a.csv").write_text("\n".join(["t,x,y", *rows]) + "\n")
    return folder


@pytest.mark.slow
def test_it_obeys_the_contract(folder):
    """In three steps as in one: states before, between and after the events.

    In two parts, of which the second goes on from the first one's end.
    """
    student = find(METHOD, "blob")
    assert isinstance(student, Estimator) and METHOD not in names()
    recording = jaxevent.load(folder / "a.h5")
    params = student.Params(nu=3.0, **PARAMS)
    seeds = [(50.0, 5.0, 4.0, 0.005), (20.0, 20.0, 4.0)]  # no events near the first
    times = np.arange(recording.start, recording.stop, 1500)
    tracks = student.estimate(recording, params, seeds=seeds, progress=False)
    assert tracks.smooth
    expected = tracks.filtered(times)
    assert not expected.valid.all() and expected.valid.any()

    run, read = jax.jit(student.run), jax.jit(student.read)
    middle, state = recording.start + 10_000, None
    for part, mine, order, span in (
        (times < middle, seeds, [0, 1], {"stop": middle}),
        (times >= middle, [], [1, 0], {"start": middle}),  # not seeds: in the order they began
    ):
        features, out = student.prepare(recording, times, params, seeds=mine, **span)
        trajectory, state = run(params, features, state)
        states = read(params, trajectory, out)
        whole = [result[part][:, order] for result in (*expected, expected.idle)]
        mean, covariance, valid = (np.asarray(result)[part] for result in states)
        assert np.array_equal(valid, whole[2])
        np.testing.assert_allclose(mean, whole[0], rtol=1e-9)
        np.testing.assert_allclose(covariance, whole[1], rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(states.idle[part], whole[3], atol=1e-12)
        last = np.flatnonzero(part)[-1]
        assert np.array_equal(states.id[last], np.where(states.valid[last], [0, 1], -1))
    assert not states.valid[times < middle].any()

    with pytest.raises(jaxevent.InputError, match="extrapolate=True"):
        tracks(recording.stop + 1)
    assert not tracks(recording.stop + 1, extrapolate=True).valid.any()


@pytest.mark.slow
def test_it_is_evaluated(folder):
    config = folder / "evaluate.toml"
    config.write_text(
        'recordings = ["a.h5"]\nprotocol = "tracks"\npositions = "*.csv"\n'
        f'[[method]]\nname = "{METHOD}"\nparams = {{ nu = 3.0, {TABLE} }}\n'
        f'[[method]]\nname = "constant_velocity"\nparams = {{ {TABLE} }}\n'
    )
    own, package = evaluate(config, progress=False)
    assert own["method"] == METHOD and own["params"]["nu"] == pytest.approx(3.0)
    assert own["covered"] == package["covered"] == 1
    assert own["rmse"] < 1 and own["rmse"] != package["rmse"]


@pytest.mark.slow
def test_its_own_number_is_fitted(folder, capsys):
    config, out = folder / "fit.toml", folder / "fitted"
    config.write_text(
        'recordings = ["a.h5"]\nvalidation = []\nsplit = [1, 0, 0]\nwindow = 1.0\n'
        'positions = "*.csv"\niterations = 4\nlearning_rate = 0.5\nrounds = 1\n'
        f'[[method]]\nname = "{METHOD}"\nlabel = "mine"\n'
        f'params = {{ nu = 1.0, {TABLE} }}\nfit = ["nu"]\n'
    )
    before, after = fit(config, out, progress=False)
    assert after["nll"] < before["nll"] and after["params"]["nu"] > 1.5
    assert json.loads((out / "results.json").read_text())["rows"] == [before, after]

    # What was fitted is what the command takes.
    table = own_blob.Params.load(out / "params.toml", "mine").values()
    mine = folder / "mine.toml"
    mine.write_text("".join(f"{k} = {json.dumps(v)}\n" for k, v in table.items()))
    argv = ["track", folder / "a.h5", "--method", METHOD, "--params", mine, "--seed=20,20,4"]
    assert cli.main([*map(str, argv), "--out", str(folder / "a.tracks.csv")]) == 0
    assert "1 track, " in capsys.readouterr().out
    x = np.genfromtxt(folder / "a.tracks.csv", delimiter=",", names=True)["x"]
    assert abs(x[-1] - 29.5) < 1
