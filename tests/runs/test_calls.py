"""Evaluations and fits of objects: as those of files, and metrics and methods of one's own."""

import dataclasses
import functools
import json
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from errands import log
from noise import ONE, small, write_config
from own_metric import grey, worst

import jaxevent
from jaxevent import cli, egomotion
from jaxevent.errors import InputError
from jaxevent.estimator import Estimate
from jaxevent.methods import METHODS
from jaxevent.metrics import mse
from jaxevent.recording import Events, Frames, Recording
from jaxevent.runs import contents
from jaxevent.runs.evaluate import evaluate
from jaxevent.runs.fit import fit
from jaxevent.runs.own import import_path
from jaxevent.simulate import blob_scene, motion_scene

blend, last_frame = METHODS["blend"], METHODS["last-frame"]


@pytest.fixture(autouse=True)
def precision(float32):
    """As users have it; kernels compute in single precision."""


def noisier(seed: int, **fields) -> Recording:
    """`small` with other images."""
    frames = small().frames
    assert isinstance(frames, Frames)
    images = np.random.default_rng(seed).integers(0, 256, frames.images.shape).astype(np.uint8)
    return small(frames=Frames(frames.t, images, frames.exposure), **fields)


def untimed(rows) -> list[dict]:
    return [{key: value for key, value in row.items() if key != "seconds"} for row in rows]


def test_objects_are_scored_as_files(tmp_path):
    jaxevent.save(small(), tmp_path / "small.h5")
    text = ONE + "params = { clock_offset = 0.001 }\n"
    of_file = evaluate(write_config(tmp_path, text))
    params = blend.Params(clock_offset=0.001)
    for recordings in (small(), [small()], tmp_path / "small.h5", {"small": small()}):
        for methods in ((blend, params), [("blend", {"clock_offset": 0.001})]):
            rows = evaluate(recordings, methods)
            assert untimed(rows)[0].items() >= {"mse": of_file[0]["mse"], "method": "blend"}.items()
            assert rows[0]["per_frame"] == of_file[0]["per_frame"]


def test_names_of_recordings_and_methods():
    rows = evaluate([small(), noisier(1), noisier(2)], ["blend", last_frame])
    names = ["small", "small (2)", "small (3)"]
    assert [row["recording"] for row in rows] == [name for name in names for _ in range(2)]
    assert len({row["mse"] for row in rows}) == 6
    one = small()
    assert len(evaluate([one, one], blend)) == 1  # the same object
    params = [blend.Params(clock_offset=offset) for offset in (0.001, 0.002)]
    rows = evaluate({"a": small(), "b": noisier(1)}, {"x": (blend, params[0]), "y": blend})
    assert [(row["recording"], row["method"]) for row in rows] == [
        (a, b) for a in "ab" for b in "xy"
    ]
    rows = evaluate(small(), [blend, *((blend, one) for one in params)], gap=3)
    assert [row["method"] for row in rows] == [
        f"blend{more}, gap 3" for more in ("", ", clock_offset 0.001", ", clock_offset 0.002")
    ]


def test_own_metric_is_the_mean_over_images(tmp_path):
    row = evaluate(small(), grey, metrics=["mse", worst])[0]
    hidden = small().frames[1::2].intensity
    each = [np.abs(0.5 - image).max() for image in hidden]
    np.testing.assert_allclose(row["per_frame"]["worst"], each, rtol=1e-6)
    assert row["worst"] == pytest.approx(np.mean(each))
    errors = [mse(np.full(image.shape, 0.5), image) for image in hidden]
    assert row["mse"] == pytest.approx(np.mean(errors))
    named = evaluate(small(), grey, metrics={"worse": functools.partial(worst)})[0]
    assert named["worse"] == row["worst"]
    pair = evaluate(small(), grey, metrics=[("again", lambda a, b: worst(a, b))])[0]
    assert pair["again"] == row["worst"]
    # The same in TOML.
    jaxevent.save(small(), tmp_path / "small.h5")
    metrics = 'metrics = ["mse", "own_metric:worst"]\n'
    text = metrics + ONE.replace('"blend"', '"own_metric:grey"')
    (of_file,) = evaluate(write_config(tmp_path, text), tmp_path / "out")
    assert of_file["worst"] == row["worst"] and of_file["method"] == "own_metric:grey"
    page = (tmp_path / "out" / "report.html").read_text()
    assert ">worst<" in page and f"{row['worst']:.4f}" in page
    assert "worst" in (tmp_path / "out" / "results.md").read_text()
    kept = json.loads((tmp_path / "out" / "results.json").read_text())["rows"]
    assert kept[0]["worst"] == row["worst"]


def test_a_metric_cannot_change_what_others_see():
    def spoil(estimate, truth):
        estimate[:] = truth[:] = 0
        return 0.0

    alone = evaluate(small(), blend, metrics=[worst])[0]
    after = evaluate(small(), blend, metrics=[spoil, worst])[0]
    assert (after["worst"], after["mse"]) == (alone["worst"], alone["mse"])


def raises(estimate, truth):
    raise KeyError("mask")


@pytest.mark.parametrize(
    ("metric", "said"),
    [
        ([3], "the metric 3 is an int, which cannot be called"),
        (3, "metrics are an int; give a list of names or functions"),
        ("own_metric:not_a_metric", "'own_metric:not_a_metric' is an int, which cannot be called"),
        ("own_metric:missing", "the metric 'own_metric:missing' cannot be imported"),
        (lambda a, b: 0.0, "has no name; give metrics as a mapping"),
        (raises, r"small: the metric 'raises' raised KeyError \('mask'\)"),
        (
            {"m": lambda a, b: a},
            r"small: the metric 'm' returned float\d+ of shape \(20, 24\); ret",
        ),
        ({"m": lambda a, b: None}, "small: the metric 'm' returned None; return one number"),
        ({"m": lambda a, b: "much"}, "small: the metric 'm' returned 'much'; return one number"),
        ({"m": lambda a, b: np.nan}, "small: the metric 'm' returned nan, which has no mean"),
        ({"frames": worst}, "metric of your own is called 'frames', as results call something"),
        ({"ssim": worst}, "metric of your own is called 'ssim', as results call something else"),
        ([worst, ("worst", raises)], "two metrics are called 'worst'"),
        ("masked", "there is no metric 'masked'; did you mean 'masked_mse'"),
    ],
)
def test_metrics_that_cannot_be(metric, said):
    with pytest.raises(InputError, match=said):
        evaluate(small(), blend, metrics=metric)


@pytest.mark.parametrize(
    ("recordings", "methods", "settings", "said"),
    [
        (3, "blend", {}, "recordings are an int; give a list of recordings or paths"),
        ([3], "blend", {}, "recordings hold an int; give jaxevent.Recording objects or paths"),
        ([], "blend", {}, "recordings is missing"),
        (small(), None, {}, "no method is given; give a recording and methods"),
        (small(), 3, {}, "methods are an int; give a list of methods"),
        (small(), [3], {}, "the method 3 is an int, not an Estimator"),
        (small(), type(blend), {}, "is a class; give an object of it"),
        (small(), "blended", {}, "there is no method 'blended'; did you mean 'blend'"),
        (small(), [blend, blend], {}, "another one is labelled 'blend' too"),
        (small(), [(blend, 3)], {}, r"give a pair \(method, params\)"),
        (small(), [(blend, METHODS["akf"].Params())], {}, "not those of the method 'blend'"),
        (small(), [(grey, {"a": 1})], {}, "'grey' is a function and has no params"),
        (small(), blend, {"gapp": 3}, "there is no setting 'gapp'; did you mean 'gap'"),
        (small(), blend, {"protocol": "hidden"}, "no protocol 'hidden'"),
        (small(), [blend, "moment"], {}, "'moment' is of blob, not of reconstruction"),
        (small(), blend, {"cluster": 3}, "the cluster is an int; give the address"),
        ("none.h5", "blend", {}, "none.h5: there is no such file"),
        ("run.toml", None, {"gap": 4}, "run.toml: gap is no argument beside a configuration"),
        ("none.h5", None, {}, "none.h5: cannot be read .* give a method too: jaxevent.evaluate"),
    ],
)
def test_calls_that_cannot_be(recordings, methods, settings, said):
    with pytest.raises(InputError, match=said):
        evaluate(recordings, *([] if methods is None else [methods]), **settings)


@pytest.mark.parametrize(
    ("function", "said"),
    [
        (
            lambda r, t: np.zeros((len(t), 3)),
            r"returned float64 of shape \(3, 3\); return an array",
        ),
        (lambda r, t: None, "returned None; return an array"),
        (
            lambda r, t: 1 / 0,
            r"raised ZeroDivisionError \(division by zero\) at line \d+ of .*test_calls.py",
        ),
        (lambda r, t: np.zeros((3, 20, 24), np.uint8), "returned grey levels as uint8"),
        (lambda r, t: np.full((3, 20, 24), np.nan), "returned no finite number"),
        (lambda r, t: (grey(r, t), np.zeros(3)), r"returned variances of shape \(3,\)"),
    ],
)
def test_functions_that_are_no_methods(function, said):
    with pytest.raises(InputError, match=f"small: the method '<lambda>' {said}"):
        evaluate(small(), function)


def test_a_function_may_tell_a_variance():
    def certain(recording, times):
        image = grey(recording, times)
        return Estimate(image, np.full(image.shape, 0.04), np.ones(image.shape, bool))

    row = evaluate(small(), certain)[0]
    frames = small().frames[1::2]
    told = (np.asarray(frames.images) > 0) & (frames.intensity < 0.98)  # neither black nor white
    z2 = (np.log(0.5) - np.log(np.where(told, frames.intensity, 1))) ** 2 / 0.04
    assert row["z2"] == pytest.approx(np.mean([a[b].mean() for a, b in zip(z2, told, strict=True)]))


def test_means_of_each_method(tmp_path, capsys):
    rows = evaluate([small(), noisier(1)], ["blend", last_frame], metrics=worst)
    means = rows.means()
    for name in ("mse", "ssim", "worst"):
        mine = [row[name] for row in rows if row["method"] == "last-frame"]
        assert means.loc["last-frame", name] == pytest.approx(np.mean(mine))
    assert list(means["recordings"]) == [2, 2]
    table = rows.to_dataframe()
    assert list(table["worst"]) == [row["worst"] for row in rows]
    assert "params.clock_offset" in table and "per_frame" not in table
    said = f" {100 * means.loc['blend', 'mse']:.3f} |"
    assert said in repr(rows).split("mean of")[1]
    for number, recording in enumerate((small(), noisier(1))):
        jaxevent.save(recording, tmp_path / f"{number}.h5")
    assert cli.main(["evaluate", str(write_config(tmp_path, ONE.replace("small", "*")))]) == 0
    assert said in capsys.readouterr().out.split("mean of")[1]
    # A recording that a method fails on does not count.
    bare = dataclasses.replace(noisier(2), frames=None)
    rows = evaluate([small(), bare], "blend")
    assert "error" in rows[1] and rows.means().loc["blend", "recordings"] == 1
    assert "mean of" not in rows.table()


def test_content_decides_what_is_computed_again(tmp_path, monkeypatch):
    monkeypatch.setattr("jaxevent.show.page.page", lambda *arguments: "")
    out = tmp_path / "out"

    def computed(recordings, methods, **settings) -> int:
        tasks = out / "tasks"
        before = len(log(tasks, "started")) if tasks.exists() else 0
        evaluate(recordings, methods, out=out, **settings)
        return len(log(tasks, "started")) - before if (tasks / "log.txt").exists() else 0

    assert computed(small(), blend) == 1
    assert computed(small(name="another"), "blend") == 0
    assert computed(noisier(1), blend) == 1
    assert computed(small(extra={"gain": np.ones(6)}), blend) == 1
    assert computed(small(), blend, metrics=[worst]) == 1
    assert computed(small(), blend, metrics="own_metric:worst") == 0
    # The code of a module counts; what is made here may change, so it is never kept.
    source = tmp_path / "changing.py"
    monkeypatch.syspath_prepend(tmp_path)
    source.write_text("def m(a, b):\n    return 1.0\n")
    assert computed(small(), blend, metrics="changing:m") == 1
    assert computed(small(), blend, metrics="changing:m") == 0
    source.write_text("def m(a, b):\n    return 22.0\n")
    del sys.modules["changing"]
    rows = evaluate(small(), blend, metrics="changing:m", out=out)
    assert rows[0]["m"] == 22
    files = set((out / "tasks").glob("*.json"))
    evaluate(small(), blend, metrics={"mine": lambda a, b: 3.0}, out=out)
    assert set((out / "tasks").glob("*.json")) == files
    text = (out / "config.toml").read_text()
    assert 'recordings = ["small"]' in text and 'metrics = ["mine"]' in text


def test_digest_of_what_is_the_same(tmp_path):
    jaxevent.save(small(), tmp_path / "small.h5")
    lazy = jaxevent.load(tmp_path / "small.h5", in_memory=False)
    assert not isinstance(lazy.events, Events)
    assert contents.digest(lazy) == contents.digest(jaxevent.load(tmp_path / "small.h5"))
    found = {
        contents.digest(one) for one in (small(), noisier(1), small(frames=None), [1, 2], [12])
    }
    assert len(found) == 5
    with pytest.raises(InputError, match="an object in a recording"):
        contents.digest(small(extra={"what": object()}))


def test_import_paths():
    assert import_path(blend) == "blend"
    assert import_path(worst) == "own_metric:worst"
    assert import_path(dataclasses.replace(blend)) is None
    assert import_path(lambda a, b: 0) is None


def test_what_other_processes_cannot_have():
    with pytest.raises(InputError, match="cannot be sent to other processes"):
        evaluate(small(), lambda r, t: grey(r, t), workers=1)


@pytest.mark.slow
def test_objects_in_other_processes(monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[1]), prepend=":")
    here = evaluate([small(), noisier(1)], [blend, grey], metrics=[worst])
    there = evaluate([small(), noisier(1)], [blend, grey], metrics=[worst], workers=1)
    assert untimed(here) == untimed(there)


@pytest.fixture(scope="module")
def dot() -> tuple[Recording, pd.DataFrame]:
    recording, truth = blob_scene("disc", seed=1)
    t = np.arange(0.005, 0.045, 0.001)
    x, y = truth(t)[:, 0, :2].T
    return recording[:0.05], pd.DataFrame({"t": t, "x": x, "y": y})


@pytest.mark.slow
def test_tracks_of_objects(dot, tmp_path):
    recording, table = dot

    def behind(recording, times):
        at = np.interp(times * 1e-6, table.t, table.x), np.interp(times * 1e-6, table.t, table.y)
        return np.stack(at, -1)[:, None] + [3.0, 4.0]

    rows = evaluate(recording, ["moment", behind], positions=table, metrics=[worst])
    assert rows[1]["rmse"] == pytest.approx(5) and rows[1]["worst"] == pytest.approx(4)
    assert rows[1]["covered"] == 1 and rows[0]["rmse"] < 1
    jaxevent.save(recording, tmp_path / "dot.h5")
    table.to_csv(tmp_path / "dot.csv", index=False)
    text = """
    recordings = ["dot.h5"]
    protocol = "tracks"
    positions = "*.csv"
    metrics = ["own_metric:worst"]
    [[method]]
    name = "moment"
    """
    (of_file,) = evaluate(write_config(tmp_path, text))
    for name in ("rmse", "covered", "worst", "per_time"):
        assert of_file[name] == rows[0][name]
    by_name = evaluate({"a": recording}, "moment", positions={"a": tmp_path / "dot.csv"})
    assert by_name[0]["rmse"] == rows[0]["rmse"]
    for positions, said in (
        ({"b": table}, "a: no table of the ground truth has this name; known: b"),
        (table.drop(columns="x"), "a: positions: has no column 'x'"),
        (table.assign(x="much"), "x is 'much' in row 0; give a number, or leave the row out"),
        (3, "the ground truth is an int that is no table"),
    ):
        with pytest.raises(InputError, match=said):
            evaluate({"a": recording}, "moment", positions=positions)


def test_motion_of_objects(tmp_path):
    recording, source = motion_scene("planar", "constant", 3, size=(64, 48), duration=0.1)
    t = np.arange(0, 0.1, 0.001)
    table = pd.DataFrame(source.velocity(t), columns=["vx", "vy"]).assign(t=t)

    def slower(recording, times):
        return np.where(times[:, None] < 20_000, np.nan, 0.5 * source.velocity(times))

    rows = evaluate({"wall": recording}, [egomotion.planes, slower], truth=table, metrics=worst)
    assert rows[1]["AEE_rel"] == pytest.approx(50) and rows[1]["lost"] == 0
    assert rows[1]["startup"] == pytest.approx(0.02, abs=0.005)
    expected = 0.5 * np.abs(source.velocity(t[20:])).max()
    assert rows[1]["worst"] == pytest.approx(expected, rel=1e-3)
    jaxevent.save(recording, tmp_path / "wall.h5")
    table.to_csv(tmp_path / "wall.csv", index=False)
    text = """
    recordings = ["wall.h5"]
    protocol = "motion"
    truth = "*.csv"
    [[method]]
    name = "planes"
    """
    (of_file,) = evaluate(write_config(tmp_path, text))
    assert of_file["AEE"] == pytest.approx(rows[0]["AEE"], rel=1e-6)
    with pytest.raises(InputError, match="the true motion: the time in row 1 does not rise"):
        evaluate({"wall": recording}, "planes", truth=table.assign(t=0.0))


FIT = """
recordings = ["small.h5"]
calibrate = false
iterations = 2
[[method]]
name = "edi"
fit = ["c_on"]
params = { c_off = 0.2 }
"""


@pytest.mark.slow
def test_fits_of_objects(tmp_path):
    edi = METHODS["edi"]
    jaxevent.save(small(), tmp_path / "small.h5")
    of_file = fit(write_config(tmp_path, FIT), tmp_path / "out")
    fitted = fit(small(), edi, fit=["c_on"], params=edi.Params(c_off=0.2), iterations=2)
    assert fitted.params.values() == of_file.params.values()
    assert float(fitted.params.c_on) != 0.1 and fitted.found[0]["parameter"] == "c_on"
    kept = edi.Params.load(tmp_path / "out" / "params.toml", "edi")
    assert float(kept.c_on) == pytest.approx(float(fitted.params.c_on), rel=1e-6)
    assert [row["mse"] for row in fitted] == [row["mse"] for row in of_file]
    assert repr(of_file) == (tmp_path / "out" / "results.md").read_text()

    settings = {"fit": ["c_on"], "iterations": 2, "out": tmp_path / "objects"}
    rows = fit(small(), "edi", test=noisier(1), **settings)
    assert {(row["recording"], row["split"]) for row in rows} == {
        ("small", "fit"), ("small", "test"),
    }  # fmt: skip
    again = fit(small(), "edi", test=noisier(1), resume=True, **settings)
    assert again == rows and again.params.values() == rows.params.values()
    with pytest.raises(InputError, match="holds results of another run"):
        fit(small(), "edi", test=noisier(2), resume=True, **settings)


@pytest.mark.parametrize(
    ("recordings", "method", "settings", "said"),
    [
        (small(), None, {}, "no method is given; give a recording and one"),
        ("run.toml", None, {"fit": ["c_on"]}, "fit is no argument beside a configuration"),
        ("run.toml", None, {}, "run.toml: out is missing; give the folder"),
        (small(), "edi", {}, "nothing is to be fitted"),
        (small(), "edi", {"fit": "c_on"}, "fit is 'c_on'; give a list of names"),
        (small(), "edi", {"fit": ["con"]}, "there is no parameter 'con'; did you mean 'c_on'"),
        (small(), "edi", {"fit": ["c_on"], "iteration": 3}, "did you mean 'iterations'"),
        (small(), grey, {"fit": ["c_on"]}, "'grey' is a function and has no parameters to fit"),
        (small(), ["edi"], {"fit": ["c_on"]}, "the method is a list; give one Estimator"),
        (small(), "edi", {"fit": ["c_on"], "resume": True}, "resume goes on from .* give out"),
        ("none.h5", "edi", {"fit": ["c_on"]}, "none.h5: there is no such file"),
        (None, "edi", {"fit": ["c_on"]}, "recordings are None; give a list"),
    ],
)
def test_fits_that_cannot_be(recordings, method, settings, said):
    with pytest.raises(InputError, match=said):
        fit(recordings, *([] if method is None else [method]), **settings)


def test_tables_of_what_is_true_reach_fits(dot):
    recording, table = dot
    settings = {"fit": ["lambda0"], "loss": "positions"}
    with pytest.raises(InputError, match="disc: positions: has no column 'x'"):
        fit(recording, "moment", positions=table.drop(columns="x"), **settings)
    with pytest.raises(InputError, match="the true motion: has no column 'vx'"):
        fit(recording, "planes", truth=table, search={"step": (0.02, 0.04, 3)})
