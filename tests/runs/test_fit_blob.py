"""The tracker fitted through the common loop: to events, and to given positions."""

import dataclasses
import functools
import json
import tomllib
from pathlib import Path

import jax
import numpy as np
import pytest
from commands import fails

import jaxevent
import jaxevent.runs.fit
from jaxevent import cli
from jaxevent.blob import constant_velocity as tracker
from jaxevent.blob import find, negative_log_likelihood, prepare_positions
from jaxevent.errors import InputError
from jaxevent.recording import Events, Recording
from jaxevent.runs.blob import FAMILY
from jaxevent.runs.blob_scores import read_positions
from jaxevent.runs.family import FitData
from jaxevent.runs.fit import fit
from jaxevent.simulate import CircularMotion, Target, simulate_blobs

SPEED = 900.0  # px/s
# A filter that compiles fast.
START = {
    "events_per_step": 16,
    "lambda0": 4.0,
    "Q_v": 1e3,
    "P0_v": 1e6,
}


@functools.cache
def simulated(seed: int) -> tuple[Recording, np.ndarray]:
    """A blob on a circle for 0.08 s, 8,000 events; and its path, t, x and y in steps of 1 ms."""
    circle = CircularMotion((60, 45), 25, SPEED / 25, size=(4.0, 3.0))
    recording, truth = simulate_blobs([Target(circle, 1e5)], (120, 90), 0.08, 1e3, seed)
    t = np.arange(1, 80) * 1e-3
    return recording, np.c_[t, truth(t)[:, 0, :2]]


def store(folder: Path, name: str, seed: int) -> None:
    recording, path = simulated(seed)
    jaxevent.save(recording, folder / f"{name}.h5")
    lines = [f"{t:.6f},{x:.6f},{y:.6f}" for t, x, y in path]
    (folder / f"{name}.csv").write_text("\n".join(["t,x,y", *lines]) + "\n")


CONFIG = """
recordings = ["a.h5"]
test = ["b.h5"]
window = 0.04
positions = "*.csv"
iterations = 12
learning_rate = 0.5
every = 4
rounds = 1
[[method]]
name = "constant_velocity"
label = "mine"
params = "start.toml"
fit = ["Q_v", "Q_p"]
"""


def write(folder: Path, text: str, name: str = "fit.toml") -> Path:
    (folder / name).write_text(text)
    return folder / name


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    store(tmp_path, "a", 0)
    store(tmp_path, "b", 1)
    text = "".join(f"{name} = {json.dumps(value)}\n" for name, value in START.items())
    write(tmp_path, text, "start.toml")
    return tmp_path


def goal(**given):
    return FAMILY.goal(tracker, tracker.Params(**START), {"loss": "likelihood", **given})


@pytest.mark.slow
def test_a_fit_improves_what_it_has_not_seen(folder, capsys):
    config, out = write(folder, CONFIG), folder / "out"
    assert cli.main(["fit", str(config), "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert said.startswith((out / "results.md").read_text())
    assert "NLL" in said and "RMSE px" in said and "SSIM" not in said
    rows = json.loads((out / "results.json").read_text())["rows"]
    assert [(row["method"], row["recording"], row["split"]) for row in rows] == [
        (method, name, split)
        for method in ("mine, before", "mine")
        for name, split in (("a.h5", "fit"), ("b.h5", "test"))
    ]
    before, after = rows[1], rows[3]
    assert after["nll"] < before["nll"] - 0.01 and after["rmse"] < 0.6 * before["rmse"]
    assert after["covered"] == 1 and after["windows"] == 2
    assert after["events"] == len(simulated(1)[0].events)
    assert "b.h5" in said and "a.h5" not in said and f"{after['rmse']:.3f}" in said

    # The parameters are those that `jaxevent track` loads, and do what the table says.
    params = tracker.Params.load(out / "params.toml", "mine")
    assert params.events_per_step == 16 and float(params.Q_v) > 2e3
    recording, path = simulated(1)
    times = np.rint(1e6 * path[:, 0]).astype(np.int64)
    seed = (*path[0, 1:], float(params.lambda0), int(times[0]))
    error = (
        tracker.estimate(recording, params, seeds=[seed]).filtered(times).mean[:, 0, :2]
        - path[:, 1:]
    )
    assert after["rmse"] == pytest.approx(np.sqrt((error**2).sum(1).mean()), rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("loss", ["likelihood", "positions"])
def test_batches_are_their_windows_filled_up_to_one_shape(loss, folder):
    """Against windows packed alone; the second one is shorter."""
    recording, path = simulated(0)
    source = dataclasses.replace(recording, name=str(folder / "a.h5"))
    mine = goal(loss=loss, positions="*.csv", seeds=[[85.0, 45.0, 6.0]])
    params = tracker.Params(**START)
    sources = {"fit": [("a.h5", source)], "validation": [], "test": []}
    fitted, validation = mine.problem(FitData(sources, None, 0.05))(params)
    assert len(fitted) == 2 and not validation
    shapes = [jax.tree.map(np.shape, batch) for batch in fitted]
    assert shapes[0] == shapes[1]
    times = np.rint(1e6 * path[:, 0]).astype(np.int64)
    first = recording.start
    for batch, start, stop in zip(
        fitted, (first, first + 50_000), (first + 50_000, recording.stop + 1), strict=True
    ):
        place = [np.interp(start, times, path[:, axis]) for axis in (1, 2)]
        seed = (85.0, 45.0, 6.0) if start == first else (*place, 6.0)
        span = {"start": start, "stop": stop}
        inside = (start <= times) & (times < stop)
        if loss == "positions":
            truth = path[inside, None, 1:]
            packed = prepare_positions(recording, params, [seed], times[inside], truth, **span)
            count, features = inside.sum(), packed.features
            for name in ("chunk", "step", "time", "known"):
                alone, filled = (np.asarray(getattr(one, name)) for one in (packed, batch.features))
                assert (
                    np.array_equal(filled[: len(alone)], alone) and not filled[len(alone) :].any()
                )
            np.testing.assert_allclose(batch.features.xi[: len(truth)], truth, atol=1e-6)
            batch = dataclasses.replace(batch, features=batch.features.features)
        else:
            features, _ = tracker.prepare(recording, np.empty(0), params, seeds=[seed], **span)
            count = features.valid.sum()
        assert float(batch.weight) == count
        # What is cut off or added of chunks and steps holds no events and ends no cycle.
        for name in ("t", "xi", "valid", "polarity", "cycle", "stop", "elapsed"):
            alone, filled = (np.asarray(getattr(one, name)) for one in (features, batch.features))
            rows = slice(0, min(len(alone), len(filled)))
            steps = slice(0, min((*alone.shape[1:2], *filled.shape[1:2]), default=0))
            both = (rows, steps) if alone.ndim > 1 else rows
            assert np.array_equal(alone[both], filled[both]), name
            if name in ("valid", "cycle"):
                assert alone.sum() == filled.sum()
        np.testing.assert_allclose(batch.features.seed_xi, features.seed_xi, atol=1e-5)
        assert np.array_equal(batch.features.seed, features.seed)
    value = jax.jit(mine.loss)(params, fitted[1])
    if loss == "likelihood":
        alone = functools.partial(negative_log_likelihood, tracker, events="all")
        expected = jax.jit(alone)(params, features)
        assert float(value) == pytest.approx(float(expected), rel=1e-6)  # digits of the CSV
    else:
        assert 0 < float(value) < 200


@pytest.mark.slow
def test_windows_are_shared_out_and_begin_where_tracks_are():
    recording, _ = simulated(0)
    sources = {"fit": [("a", recording)], "validation": [], "test": []}
    mine = goal(seeds=[[85.0, 45.0, 6.0]])
    tracks = tracker.estimate(
        recording, tracker.Params(**START), seeds=[(85.0, 45.0, 6.0)]
    ).filtered
    parts = mine._cut_windows(FitData(sources, (2, 1, 1), None))
    assert [part.split for part in parts] == [0, 1, 0, 2, 0, 1, 0, 2]
    assert parts[0].start == recording.start and parts[-1].stop == recording.stop + 1
    assert all(a.stop == b.start for a, b in zip(parts, parts[1:], strict=False))
    assert parts[0].seeds == [(85.0, 45.0, 6.0, recording.start)]
    for part in parts[1:]:
        assert part.seeds is not None
        ((x, y, size, at),) = part.seeds
        mean = tracks(part.start).mean[0, 0]
        np.testing.assert_allclose((x, y, size), mean[[0, 1, 4]], rtol=1e-12)
        assert at == part.start
    # Tracks may be born in every window.
    born = goal(begin="born")._cut_windows(FitData(sources, None, 0.05))
    assert all(part.seeds is None and part.found is None for part in born)


@pytest.mark.slow
def test_without_seeds_targets_are_found():
    """As in `jaxevent track`: with the parameters that suit them, but for those that are fitted."""
    recording, path = simulated(0)
    sources = {"fit": [("a", recording)], "validation": [], "test": []}
    data, found = FitData(sources, (2, 1, 1), None), find(recording, progress=False)
    mine, settings = goal(fit=["Q_v"]), found.settings()
    given = {"Q_p": 3.0, "events_per_step": 8}
    names = tracker.names_left_open(given)
    params = mine.calibrate(data, tracker.Params(**given), names)
    for name, value in {**settings, **given}.items():
        assert float(getattr(params, name)) == pytest.approx(value, rel=1e-6), name
    assert mine.calibrate(data, params, ()) is params
    parts = mine._cut_windows(data)
    packed = mine._pack(parts, params, "likelihood", mine._usual_settings(data))
    assert len(parts) == 8 and [part.split for part in parts] == [0, 1, 0, 2, 0, 1, 0, 2]
    for part, batch in zip(parts, packed, strict=True):
        features = batch.features
        at = (part.start - recording.start) * 1e-6
        true = [np.interp(at, path[:, 0], path[:, k]) for k in (1, 2)]
        np.testing.assert_allclose(features.seed_xi[0], true, atol=3)
        # One value of what is fitted and of what the user gave, the target's own of the rest.
        assert not {"Q_v", "Q_p"} & features.overrides.keys() and "P0_v" in features.overrides
        rows = (recording.events.index(at) for at in (part.start, part.stop))
        inside = recording.events[slice(*rows)]
        assert 0.7 * len(inside) < float(batch.weight) < len(inside)
    one, slope = jax.value_and_grad(lambda p: mine.loss(p, packed[0]))(params)
    assert np.isfinite(one) and float(slope.raw["Q_v"]) != 0

    with pytest.raises(InputError, match="begin = 'born' needs none of them"):
        goal(begin="born", seeds=[[1.0, 2.0, 3.0]])
    rng = np.random.default_rng(3)
    x, y = rng.integers(0, 120, 3000), rng.integers(0, 90, 3000)
    stray = Events(np.sort(rng.integers(0, 80_000, 3000)), x, y, rng.random(3000) < 0.5)
    empty = Recording("stray", 120, 90, stray)
    with pytest.raises(InputError, match="no target was found to fit to"):
        mine._cut_windows(FitData({**sources, "fit": [("b", empty)]}, None, None))


def test_sizes_that_are_not_given_can_be_fitted(folder):
    recording = dataclasses.replace(simulated(0)[0], name=str(folder / "a.h5"))
    sources = {"fit": [("a", recording)], "validation": [], "test": []}
    for seeds, size in ((None, 0.0), ([[85.0, 45.0, 6.0]], 6.0)):
        mine = goal(positions="*.csv", **({} if seeds is None else {"seeds": seeds}))
        (batch,) = mine.problem(FitData(sources))(tracker.Params(**START))[0]
        assert batch.features.seed_size.tolist() == [size]


def test_positions_of_several_targets(tmp_path):
    path = tmp_path / "p.csv"
    path.write_text("t,id,x,y,vx\n0.001,7,1,2,0\n0.001,3,4,5,0\n0.002,3,6,7,0\n")
    known = read_positions(path)
    assert known.t.tolist() == [1000, 2000]
    np.testing.assert_array_equal(known.xi, [[[4, 5], [1, 2]], [[6, 7], [np.nan, np.nan]]])
    for text, said in (
        ("t,x\n1,2\n", "no column 'y'"),
        ("t,x,y\n", "holds no positions"),
        ("t,x,y\n0,1,2\n0.1,a,2\n", "x is 'a' in line 3"),
        ("t,x,y\n0,1,2\n0.1,,2\n", "x is 'nan' in line 3"),
        ("", "is no table"),
    ):
        path.write_text(text)
        with pytest.raises(jaxevent.InputError, match=said):
            read_positions(path)


class Killed(BaseException):
    pass


@pytest.mark.slow
def test_an_interrupted_fit_goes_on(folder, monkeypatch, capsys):
    monkeypatch.setattr(jaxevent.runs.fit, "CHECKPOINT_PERIOD_S", 0.0)
    text = CONFIG.replace("iterations = 12", "iterations = 3").replace("every = 4", "every = 1")
    config, out = write(folder, text), folder / "out"
    fit(config, folder / "whole")
    save, count = jaxevent.runs.fit.save_checkpoint, 0

    def dying(*arguments):
        nonlocal count
        if count == 2:
            raise Killed
        count += 1
        save(*arguments)

    with monkeypatch.context() as patch, pytest.raises(Killed):
        patch.setattr(jaxevent.runs.fit, "save_checkpoint", dying)
        fit(config, out)
    assert [path.name for path in out.iterdir()] == ["checkpoint"]
    kept = (folder / "a.csv").read_bytes()
    (folder / "a.csv").write_bytes(kept.replace(b"0.010000,", b"0.010100,"))
    fails(capsys, ["fit", config, "--out", out, "--resume"], out, "other recordings")
    (folder / "a.csv").write_bytes(kept)
    rows = fit(config, out, resume=True)
    for name in ("params.toml", "loss.csv"):
        assert (out / name).read_bytes() == (folder / "whole" / name).read_bytes()
    assert fit(config, out, resume=True) == rows


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (CONFIG.replace("_velocity", "_velocit"), "did you mean 'constant_velocity'"),
        (CONFIG + 'loss = "held-out"', "no loss 'held-out'; known: likelihood, positions"),
        (CONFIG + 'events = "some"', "events is"),
        (CONFIG + 'error = "log"', "method 1: there is no setting 'error'"),
        ('protocol = "held-out"' + CONFIG, "protocol is a setting of none of these methods"),
        ("seeds = [[1, 2]]" + CONFIG, "seeds is"),
        ("seeds = [[1, 2, 0]]" + CONFIG, "seeds is"),
        ("seeds = [[1, 2, 3], [4, 5, 6]]" + CONFIG, "holds 1 targets, but there are 2 seeds"),
        (CONFIG.replace('"*.csv"', "3"), "positions is"),
        (CONFIG.replace('"*.csv"', '"*.txt"'), "a.txt: cannot be read"),
        (
            CONFIG.replace('positions = "*.csv"', "") + 'loss = "positions"',
            "needs tables of them",
        ),
        (CONFIG.replace('"Q_v"', '"Q_vv"'), "'Q_vv'; did you mean 'Q_v'"),
        (CONFIG.replace('"Q_v"', '"gate"'), "search = { gate = [from, to"),
        (CONFIG.replace('"Q_v"', '"n"'), "there is no parameter 'n'"),
        (CONFIG.replace('"start.toml"', "{ association = 3 }"), "the parameter association is"),
    ],
)
def test_bad_configurations(text, said, folder, capsys):
    config = write(folder, text)
    before = sorted(folder.rglob("*"))
    fails(capsys, ["fit", config, "--out", folder / "out"], config, said)
    assert sorted(folder.rglob("*")) == before


def test_both_systems_in_one_file(folder):
    text = CONFIG + '[[method]]\nname = "akf"\nloss = "reference"\nfit = ["c_on"]\n'
    plan = jaxevent.runs.fit.read_plan(write(folder, text))
    assert [task.label for task in plan.tasks] == ["mine", "akf"] and plan.split is None


def test_the_example_is_read():
    config = Path(__file__).parents[2] / "configs" / "fit_blob.toml"
    plan = jaxevent.runs.fit.read_plan(config)
    assert {task.goal.loss.name for task in plan.tasks} == {"likelihood", "positions"}
    assert tomllib.loads(config.read_text())["recordings"] == ["lissajous.h5"]
