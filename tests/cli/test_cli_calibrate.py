"""The command calibrate, and what other commands take from a recording by themselves."""

import dataclasses
import json
import tomllib
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
from commands import described, fails
from estimates import NAMES, made_up, make_up
from PIL import Image

import jaxevent
from jaxevent import akf, aks, cli, events
from jaxevent.calibration import Fault
from jaxevent.errors import InputError
from jaxevent.recording import Frames
from jaxevent.runs.evaluate import evaluate
from jaxevent.runs.family import FitData
from jaxevent.runs.fit import calibrate_plan
from jaxevent.runs.fit_config import plan_of
from jaxevent.runs.protocols import held_out
from jaxevent.simulate.faults import add_hot_pixels, flicker_frames


@pytest.fixture(scope="module")
def recording():
    """The middle of a real recording."""
    whole = jaxevent.load(files("jaxevent") / "data/slider_depth_crop.h5")[0.6:0.95]
    return dataclasses.replace(events.crop(whole, 60, 45, 120, 90), name="part")


@pytest.fixture(scope="module")
def path(recording, tmp_path_factory):
    path = tmp_path_factory.mktemp("calibrate") / "part.h5"
    jaxevent.save(recording, path)
    return path


@pytest.fixture(scope="module")
def found(recording):
    return made_up(recording)


@pytest.fixture(autouse=True)
def made_up_values(monkeypatch, float32):
    make_up(monkeypatch)
    monkeypatch.setattr("jaxevent.cache.folder_for_calibrations", lambda: None)


def values_of(params) -> list[float]:
    return [float(getattr(params, name)) for name in NAMES]


def run(capsys, *words) -> tuple[str, str]:
    assert cli.main([str(word) for word in words]) == 0
    said = capsys.readouterr()
    return said.out, said.err


def test_table_file_and_picture(path, found, tmp_path, capsys):
    out, _ = run(capsys, "calibrate", path)
    for name in NAMES:
        assert f"{getattr(found, name).value:.4g}" in next(
            line for line in out.splitlines() if line.startswith(f"| {name} ")
        )
    folder = tmp_path / "both"
    out, _ = run(capsys, "calibrate", path, "--out", folder)
    assert out.endswith(f"written: {folder}/calibration.toml\nwritten: {folder}/calibration.png\n")
    with Image.open(folder / "calibration.png") as picture:
        assert picture.width > 1000
    tables = tomllib.loads((folder / "calibration.toml").read_text())
    assert list(tables) == ["calibration", "akf", "aks", "mc"] and "best for aks: clock" in out
    table = tables["calibration"]
    assert [table[name] for name in NAMES] == [getattr(found, name).value for name in NAMES]
    for name, (low, high) in table["intervals"].items():
        assert low <= table[name] <= high
    for suffix in ("toml", "png"):
        one = tmp_path / f"mine.{suffix}"
        run(capsys, "calibrate", path, "--out", one)
        assert one.read_bytes()[:8] == (folder / f"calibration.{suffix}").read_bytes()[:8]
    fails(capsys, ["calibrate", path, "--out", one], one, "--force")
    run(capsys, "calibrate", path, "--out", one, "--force")


def test_other_offsets_have_other_thresholds(path, recording, tmp_path, capsys):
    mine = tmp_path / "mine.toml"
    run(capsys, "calibrate", path, "--I0", 0.3, "--out", mine)
    table = tomllib.loads(mine.read_text())["calibration"]
    assert table["I0"] == 0.3 and table["c_on"] == made_up(recording, 0.3).c_on.value


def test_bad_input(path, recording, tmp_path, capsys):
    missing = tmp_path / "missing.h5"
    fails(capsys, ["calibrate", missing], missing)
    fails(capsys, ["calibrate", path, "--out", tmp_path / "a.txt"], "a.txt", ".toml")
    fails(capsys, ["calibrate", path, "--I0", "-1"], "I0")
    fails(capsys, ["calibrate", path, "--out", path, "--force"], path)
    bare = tmp_path / "bare.h5"
    jaxevent.save(dataclasses.replace(recording, frames=None), bare)
    out, _ = run(capsys, "calibrate", bare)
    assert "not identifiable" in next(line for line in out.splitlines() if "clock_offset" in line)


@pytest.mark.slow
def test_reconstruct_calibrates(path, recording, tmp_path, capsys):
    out = tmp_path / "out.h5"
    words = ("reconstruct", path, "--method", "akf", "--at", "frames", "--out", out, "--force")
    said, _ = run(capsys, *words)
    clock, on, off = values_of(akf.Params.for_recording(recording))
    line = f"calibrated: clock {1e3 * clock:+.1f} ms, c_on {on:.3g}, c_off {off:.3g} (jaxevent "
    assert said.startswith(line + "calibrate shows more; --no-calibrate turns it off)\n")
    told = described(out)["params"]
    np.testing.assert_allclose([told[name] for name in NAMES], [clock, on, off], rtol=1e-6)
    said, _ = run(capsys, *words, "--no-calibrate")
    told = described(out)["params"]
    assert "calibrated" not in said and [told[name] for name in NAMES] == pytest.approx(
        [0, 0.1, 0.1]
    )
    mine = tmp_path / "mine.toml"
    mine.write_text("c_on = 0.3\n")
    said, _ = run(capsys, *words, "--params", mine)
    values = akf.Params.for_recording(recording, c_on=0.3)
    clock, off = 1e3 * float(values.clock_offset), float(values.c_off)
    assert said.startswith(f"calibrated: clock {clock:+.1f} ms, c_off {off:.3g} (")
    assert described(out)["params"]["c_on"] == pytest.approx(0.3)
    said, _ = run(capsys, *words, "--params", mine, "--no-calibrate")
    told = described(out)["params"]
    assert [told[name] for name in NAMES] == pytest.approx([0, 0.3, 0.1])


def test_methods_that_need_no_calibration_get_none(path, tmp_path, capsys):
    for method in ("high-pass", "last-frame"):
        out = tmp_path / f"{method}.h5"
        said, _ = run(capsys, "reconstruct", path, "--method", method, "--rate", 20, "--out", out)
        assert "calibrated" not in said


def test_a_calibration_serves_any_method(path, found, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("jaxevent.cli.reconstruct._MAX_SECONDS", 0)  # aks is the usual method
    mine, out = tmp_path / "mine.toml", tmp_path / "out.h5"
    run(capsys, "calibrate", path, "--out", mine)
    words = ("reconstruct", path, "--out", out, "--params", mine, "--rate", 20)
    said, _ = run(capsys, *words)
    assert "method aks" in said and "calibrated:" not in said
    assert described(out)["method"] == "aks"
    told = described(out)["params"]
    expected = values_of(found.params(aks.Params))
    np.testing.assert_allclose([told[name] for name in NAMES], expected, rtol=1e-6)


def test_faults_are_reported(path, tmp_path, capsys, monkeypatch):
    faults = [
        Fault("inverted polarity", -0.76, -0.3, "ON and OFF are exchanged", "invert the polarity"),
        Fault("missing events", 900.0, 50.0, "50 ms hold no event", "leave that part out"),
    ]
    monkeypatch.setattr(
        "jaxevent.calibration.check_consistency", lambda recording, sample=None: faults
    )
    out = tmp_path / "out.h5"
    words = ("reconstruct", path, "--method", "high-pass", "--rate", 20, "--out", out)
    _, error = run(capsys, *words)
    assert error.splitlines() == [f"jaxevent: warning: {path}: {fault}" for fault in faults]


@pytest.mark.parametrize(
    ("command", "work"),
    [
        ("track", "jaxevent.blob.find"),
        ("motion", "jaxevent.egomotion.model_selection.select_model"),
        ("flow", "jaxevent.event_flow.flow_from_events"),
    ],
)
def test_faults_of_events_are_told_before_the_work(
    command, work, recording, tmp_path, capsys, monkeypatch
):
    def stop(*_, **__):
        raise InputError("the work begins")

    monkeypatch.setattr(work, stop)
    # What is wrong with frames alone does not matter here.
    path = tmp_path / "faulty.h5"
    jaxevent.save(flicker_frames(add_hot_pixels(recording)), path)
    assert cli.main([command, str(path), "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err.splitlines()
    assert [line.split(": ")[1:4] for line in error[:-1]] == [["warning", str(path), "hot pixels"]]
    assert error[-1] == "jaxevent: the work begins"


@pytest.mark.slow
def test_evaluations_calibrate_by_the_frames_given(path, recording, tmp_path, capsys):
    config = tmp_path / "run.toml"
    config.write_text(
        f"""
        recordings = ["{path}"]
        [[method]]
        name = "akf"
        [[method]]
        name = "akf"
        label = "c_on"
        params = {{ c_on = 0.3 }}
        [[method]]
        name = "akf"
        label = "defaults"
        calibrate = false
        [[method]]
        name = "last-frame"
        """
    )
    said, _ = run(capsys, "evaluate", config, "--out", tmp_path / "out")
    akf_row, one, defaults, last = json.loads((tmp_path / "out/results.json").read_bytes())["rows"]
    given, _ = held_out(recording)
    clock, on, off = values_of(akf.Params.for_recording(given))
    for row, names, values in (
        (akf_row, list(NAMES), (clock, on, off)),
        (one, ["clock_offset", "c_off"], (clock, 0.3, off)),
        (defaults, None, (0, 0.1, 0.1)),
        (last, None, (0, 0.1, 0.1)),
    ):
        assert row.get("calibrated") == names
        np.testing.assert_allclose([row["params"][n] for n in NAMES], values, rtol=1e-5)
    assert f"{path}: calibrated for akf: clock {1e3 * clock:+.1f} ms, c_on {on:.3g}" in said
    said, _ = run(capsys, "evaluate", config, "--no-calibrate")
    assert "calibrated" not in said

    # What is hidden changes nothing that the method is given.
    frames = recording.frames
    images = np.array(frames.images)
    images[1::2] = 255 - images[1::2]
    other = dataclasses.replace(recording, frames=Frames(frames.t, images, frames.exposure))
    (row,) = evaluate(other, akf)
    assert row["params"] == akf_row["params"] and row["mse"] > 2 * akf_row["mse"]
    (row,) = evaluate(recording, akf, calibrate=False)
    assert row["mse"] == pytest.approx(defaults["mse"]) and "calibrated" not in row
    (row,) = evaluate(recording, [(akf, akf.Params())])
    assert row["mse"] == pytest.approx(defaults["mse"])


def test_fits_start_from_the_median_of_recordings(recording):
    other = dataclasses.replace(recording.with_frames(slice(0, -1)), name="other")
    starts = [values_of(akf.Params.for_recording(held_out(r)[0])) for r in (recording, other)]
    clock, on, off = np.median(starts, axis=0)
    methods = [
        {"name": "akf", "fit": ["kappa"]},
        {"name": "akf", "label": "c_on", "fit": ["kappa"], "params": {"c_on": 0.3}},
        {"name": "akf", "label": "defaults", "fit": ["kappa"], "calibrate": False},
        {"name": "akf", "label": "object", "fit": ["kappa"], "params": akf.Params(kappa=1.0)},
    ]
    plan = plan_of({"recordings": [recording, other], "method": methods}, Path(), None, b"")
    sources = {"fit": [("part", recording), ("other", other)], "validation": [], "test": []}
    started = calibrate_plan(plan, FitData(sources))
    for task, expected in zip(
        started.tasks,
        [(clock, on, off), (clock, 0.3, off), (0, 0.1, 0.1), (0, 0.1, 0.1)],
        strict=True,
    ):
        np.testing.assert_allclose(values_of(task.params), expected, rtol=1e-6)
