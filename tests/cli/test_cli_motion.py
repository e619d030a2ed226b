"""`jaxevent motion` and `simulate --motion`: what they write, its errors, and bad input."""

import csv
import dataclasses
import json
import sys
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pandas as pd
import pytest
from commands import described, fails
from PIL import Image
from scipy.spatial.transform import Rotation

import jaxevent
from jaxevent import cli, egomotion, methods
from jaxevent.camera import PinholeCamera
from jaxevent.cli import motion as command
from jaxevent.egomotion import batch, frames, model_selection, voting
from jaxevent.egomotion.estimator import AdaptedParams, MotionEstimator
from jaxevent.egomotion.models import MODELS, General, Planar
from jaxevent.egomotion.motion import MotionEstimate
from jaxevent.egomotion.particle_filter.estimator import VotingEstimator
from jaxevent.egomotion.patches import ImageSpeed
from jaxevent.egomotion.scores import score_motion
from jaxevent.egomotion.truth import KnownMotion
from jaxevent.errors import InputError, install_command
from jaxevent.estimator import Estimate
from jaxevent.parameters import read_toml
from jaxevent.recording import Events, Frames, Imu, Recording
from jaxevent.show import motion as pictures
from jaxevent.show.motion_figures import warped_events
from jaxevent.simulate import motion_scene

pytestmark = pytest.mark.slow

WIDTH, HEIGHT = 96, 72
SETTINGS = "particles = 100\ncandidates = 64\n"
SEEN: dict[str, Any] = {"size": (WIDTH, HEIGHT), "focal": 80.0}
SIMULATE = ["simulate", "--size", f"{WIDTH},{HEIGHT}", "--duration", "0.3", "--seed", "1"]


@pytest.fixture(autouse=True)
def precision(float32):
    """As users have it; kernels compute in single precision."""


@pytest.fixture(scope="module")
def stored(tmp_path_factory) -> Path:
    """planar.h5 and turn.h5 with tables of the truth, mine.toml."""
    folder = tmp_path_factory.mktemp("motion")
    for name, motion in (("planar", "planar"), ("turn", "rotation")):
        files = ["--truth", f"{folder / name}.csv", "--out", f"{folder / name}.h5"]
        assert cli.main([*SIMULATE, "--motion", motion, *files]) == 0
    (folder / "mine.toml").write_text(SETTINGS)
    return folder


@pytest.fixture
def folder(stored: Path, tmp_path: Path) -> Path:
    for path in stored.iterdir():
        (tmp_path / path.name).symlink_to(path)
    return tmp_path


def read_table(path: Path) -> tuple[list[str], np.ndarray]:
    with path.open() as file:
        lines = list(csv.reader(file))
    rows = [[float(cell or "nan") for cell in line] for line in lines[1:]]
    return lines[0], np.array(rows).reshape(-1, len(lines[0]))


def run(folder: Path, *words: object) -> None:
    argv = ["motion", *words, "--params", folder / "mine.toml", "--out", folder / "out"]
    assert cli.main([str(word) for word in argv]) == 0


def test_columns_are_exact():
    assert {name: model.components for name, model in MODELS.items()} == {
        "planar": ("vx", "vy"),
        "rotation": ("wx", "wy", "wz"),
        "general": ("tx", "ty", "tz", "wx", "wy", "wz"),
    }


def test_another_method_is_tried_where_the_usual_one_finds_nothing(folder, capsys, monkeypatch):
    monkeypatch.setattr(
        VotingEstimator, "estimate", lambda self, *_, model, **__: MotionEstimate.empty(model)
    )
    monkeypatch.setattr(Planar, "fallback_method", "planes")
    found, asked = ImageSpeed(9.0, 8.0, 10.0, ()), []

    def suit(self, _, params, speed=None, **__):
        asked.append(speed)
        return AdaptedParams(params, found, "the image moves at 9: px/s", "window = 2 s")

    monkeypatch.setattr(MotionEstimator, "adapt_params", suit)
    words = ["motion", str(folder / "planar.h5"), "--model", "planar", "--out", str(folder / "out")]
    assert cli.main(words) == 0
    printed = capsys.readouterr().out
    assert "voting found no motion, so planes is tried" in printed
    # How fast the image moves is said once, the windows of either method.
    assert asked == [None, found]  # measured once
    assert printed.count("moves at 9: px/s") == 1 and "\nplanes: window = 2 s\n" in printed
    assert "planar motion by planes" in printed and "never found" not in printed
    assert cli.main([*words[:-1], str(folder / "other"), "--method", "voting"]) == 0
    assert "never found" in capsys.readouterr().out  # a method that was asked for stays


def test_other_methods_are_advised_where_no_reason_is_known():
    times, reason = np.arange(3), "the camera seems to stand still while objects move"
    for warning in (None, "", reason):
        motion = dataclasses.replace(MotionEstimate.empty(Planar), warning=warning)
        found = motion(times, extrapolate=True)
        lines = pictures.WrittenMotion([], times, found, motion, None, None).summary()
        assert lines[0].endswith("never found") and (len(lines) == 1) == (warning == reason)


def test_frames_that_a_method_does_not_use_are_told(folder):
    recording = jaxevent.load(folder / "planar.h5")
    stamps = np.array([recording.start, recording.stop])
    images = np.zeros((2, recording.height, recording.width), np.uint8)
    framed = dataclasses.replace(recording, frames=Frames(stamps, images, np.zeros(2, np.int64)))
    without = dataclasses.replace(recording, frames=None)
    (line,) = command._frames_hint(framed, voting, voting.Params())
    assert line == "by the events alone, without the recording's 2 frames"
    assert command._frames_hint(without, voting, voting.Params()) == []
    assert command._frames_hint(framed, batch, batch.Params()) == []
    assert command._frames_hint(framed, batch, batch.Params(frames=False)) == [line]
    assert command._frames_hint(framed, frames, frames.Params()) == []


@pytest.mark.parametrize(
    ("first", "other", "taken"),
    [(0.4, 0.0, "voting"), (0.6, 0.0, "planes"), (0.6, None, "voting"), (None, None, "planes")],
)
def test_another_method_is_tried_where_the_usual_one_finds_nothing_soon(
    folder, capsys, monkeypatch, first, other, taken
):
    """By when in the recording either finds its only motion, None never."""
    recording = jaxevent.load(folder / "planar.h5")
    long = recording.stop - recording.start

    def estimate(estimator, *_):
        share = first if estimator.name == "voting" else other
        if share is None:
            return MotionEstimate.empty(Planar)
        t = recording.start + np.array([round(share * long)])
        return MotionEstimate.from_arrays(
            Planar, t, np.ones((1, 2)), np.eye(2)[None], np.array([True])
        )

    monkeypatch.setattr(command, "_estimate", estimate)
    monkeypatch.setattr(Planar, "fallback_method", "planes")
    suited = AdaptedParams(voting.Params(), None, "", "")
    monkeypatch.setattr(MotionEstimator, "adapt_params", lambda *_, **__: suited)
    used, seen, _ = command.estimate_or_fall_back(
        voting, recording, None, {"model": Planar}, None, True
    )
    assert used.name == taken and seen.valid.any() == (first is not None)
    late = " before the recording's middle" if first else ""
    said = f"voting found no motion{late}, so planes is tried"
    assert (said in capsys.readouterr().out) == (first != 0.4)


def test_a_dataframe_has_the_columns_that_the_command_writes(tmp_path):
    t = np.array([1000, 3000, 6000])
    mean, covariance = np.arange(6.0).reshape(3, 2), np.tile(np.diag([4.0, 9.0]), (3, 1, 1))
    motion = MotionEstimate.from_arrays(
        "planar", t, mean, covariance, np.array([True, True, False])
    )
    motion = dataclasses.replace(motion, span=(0, 7000))
    table = motion.to_dataframe()
    times = np.arange(0, 7001, 500)
    pictures.write_motion_table(tmp_path / "motion.csv", "planar", times, motion(times))
    rows = pd.read_csv(tmp_path / "motion.csv")
    pd.testing.assert_frame_equal(motion.to_dataframe(times), rows)
    assert list(table) == ["t", "vx", "vy", "sigma_vx", "sigma_vy", "lost"]
    np.testing.assert_array_equal(table["t"], t / 1e6)
    np.testing.assert_array_equal(table["vy"], [1, 3, np.nan])
    np.testing.assert_array_equal(table["sigma_vy"], [3, 3, np.nan])
    assert table["lost"].tolist() == [0, 0, 1] and table.attrs["units"]["sigma_vx"] == "px/s"
    assert motion.to_dataframe(0.002)["vx"].tolist() == [1.0]
    with pytest.raises(InputError, match="times from 8000"):
        motion.to_dataframe(8000)


def test_a_folder_of_everything(folder, capsys):
    path, table_path = folder / "planar.h5", folder / "planar.csv"
    words = ("--model", "planar", "--truth", table_path, "--flow", "--seed", 3, "--stop", 0.2)
    run(folder, path, *words)
    said, out = capsys.readouterr().out, folder / "out"
    names = [
        *("errors.csv", "errors.json", "flow.h5", "flow.png"),
        *("motion.csv", "motion.h5", "motion.png", "warped.png"),
    ]
    assert sorted(one.name for one in out.iterdir()) == names
    assert all(name in said for name in names) and "planar motion by voting" in said

    recording = jaxevent.load(path)[:0.2]
    given = read_toml(folder / "mine.toml")
    suited = voting.adapt_params(recording, voting.Params.of(given), given=given)
    params = suited.params
    assert "px/s" in suited.message and suited.message in said
    motion, _ = voting.estimate(recording, params, seed=3, cloud=64).with_flow_consistency(
        recording
    )
    header, table = read_table(out / "motion.csv")
    assert header == ["t", "vx", "vy", "sigma_vx", "sigma_vy", "lost"]
    events = recording.events
    times = events.t[0] + 1000 * np.arange(1 + (events.t[-1] - events.t[0]) // 1000)
    states = motion(times)
    assert np.array_equal(table[:, 0], times / 1e6)
    found = states.valid
    np.testing.assert_allclose(table[found, 1:3], states.mean[found], rtol=1e-12)
    variance = np.diagonal(states.covariance, axis1=1, axis2=2)
    np.testing.assert_allclose(table[found, 3:5] ** 2, variance[found], rtol=1e-9)
    assert np.isnan(table[~found, 1:5]).all() and not found.all()
    assert np.array_equal(table[:, 5], ~states.valid)
    with h5py.File(out / "motion.h5") as file:
        for name in ("t", "mean", "covariance", "lag", "contrast", "evidence", "cloud"):
            assert np.array_equal(file[name], getattr(motion, name))
        assert np.array_equal(file["lost"], ~motion.valid)
        about = dict(file.attrs)
    assert (about["model"], about["method"], about["seed"]) == ("planar", "voting", 3)
    assert list(about["components"]) == ["vx", "vy"] and list(about["units"]) == ["px/s"] * 2
    assert about["recording"] == str(path)
    about, of_flow = described(out / "motion.h5"), described(out / "flow.h5")
    told, wanted = voting.Params.of(about["params"]).values(), params.values()
    exact = {name: pytest.approx(wanted[name], rel=1e-12) for name in params.numbers}
    assert told == {**wanted, **exact}
    assert of_flow["command"] == about["command"] and str(table_path) in about["command"]
    assert set(about["inputs"]) == {str(one) for one in (path, table_path, folder / "mine.toml")}
    assert of_flow["params"].keys() == egomotion.flow.Params().values().keys()
    assert params.particles == 100

    # The errors by hand.
    _, truth = read_table(folder / "planar.csv")
    true = np.stack([np.interp(times / 1e6, truth[:, 0], column) for column in truth.T[1:]], 1)
    first = int(np.argmax(states.valid))
    keep = states.valid & (times <= 1e6 * truth[-1, 0])
    far = np.linalg.norm(states.mean - true, axis=1)[keep]
    with (out / "errors.csv").open() as file:
        figures = {
            row["figure"]: (float(row["value"]), row["unit"]) for row in csv.DictReader(file)
        }
    np.testing.assert_allclose(figures["AEE"][0], far.mean(), rtol=1e-9)
    relative = 100 * (far / np.linalg.norm(true, axis=1)[keep]).mean()
    np.testing.assert_allclose(figures["AEE_rel"][0], relative, rtol=1e-9)
    assert 0 < relative < 15 and f"{relative:.4g} %" in said
    np.testing.assert_allclose(figures["startup"][0], (times[first] - times[0]) * 1e-6)
    assert 0.05 < figures["startup"][0] < 0.2 and f"{figures['startup'][0]:.3f} s" in said
    with (out / "errors.json").open() as file:
        told = json.load(file)
    assert told["times"] == keep.sum() and told["truth"] == str(folder / "planar.csv")
    assert {name: (f["value"], f["unit"]) for name, f in told["figures"].items()} == figures

    flow = egomotion.flow.flow(recording, motion)
    with h5py.File(out / "flow.h5") as file:
        for i, name in enumerate("uv"):
            np.testing.assert_array_equal(file[name], flow.flow[:, i])
        assert np.array_equal(file["valid"], flow.valid) and np.array_equal(file["t"], events.t)
        assert file.attrs["outliers"] == pytest.approx(flow.outlier_percentage())
    for name in ("motion.png", "warped.png", "flow.png"):
        with Image.open(out / name) as figure:
            assert figure.width > 800 and figure.height > 500


def test_a_rotation_against_poses_and_gyro(folder, capsys):
    words = ("--model", "rotation", "--start", 0.02, "--stop", 0.18, "--rate", 500)
    run(folder, folder / "turn.h5", *words, "--truth", "--centred", "--smooth")
    said, out = capsys.readouterr().out, folder / "out"
    header, table = read_table(out / "motion.csv")
    assert header == ["t", "wx", "wy", "wz", "sigma_wx", "sigma_wy", "sigma_wz", "lost"]
    assert 0.02 <= table[0, 0] < 0.021 and 0.176 < table[-1, 0] < 0.18
    np.testing.assert_allclose(np.diff(table[:, 0]), 0.002, atol=1e-9)
    assert "against poses" in said and "vector_error" in said and "add --truth" not in said
    found = table[:, -1] == 0
    truth = read_table(folder / "turn.csv")[1][0, 1:]  # constant
    assert np.linalg.norm(table[found, 1:4].mean(0) - truth) < 0.03 * np.linalg.norm(truth)
    with (out / "errors.json").open() as file:
        from_poses = json.load(file)["figures"]["vector_error"]["value"]
    assert from_poses < 8
    assert not (out / "flow.h5").exists()
    with h5py.File(out / "motion.h5") as file:
        assert not np.asarray(file["lag"]).any() and file.attrs["smooth"]  # smoothed

    # A gyro that adds a bias, which it shows while the camera is still before the recording.
    recording, bias = jaxevent.load(folder / "turn.h5"), np.array([0.3, -0.2, 0.5])
    t = np.arange(-200_000, 300_001, 1000)
    gyro = np.where(t[:, None] < 0, 0, truth) + bias
    imu = Imu(t, gyro, np.zeros_like(gyro))
    bare = dataclasses.replace(recording, poses=None, imu=imu, camera=None)
    jaxevent.save(bare, folder / "imu.h5")
    for path in out.iterdir():
        path.unlink()
    words = (*words, "--truth", "--centred", "--smooth", "--still=-0.2,0", "--focal", 80)
    run(folder, folder / "imu.h5", *words)
    assert "against the gyro" in capsys.readouterr().out
    with (out / "errors.json").open() as file:
        error = json.load(file)["figures"]["vector_error"]["value"]
    assert error == pytest.approx(from_poses, rel=0.02)  # without --still it is some 30 %


def test_a_gyro_helps_a_method_that_takes_one(folder, monkeypatch):
    recording, t = jaxevent.load(folder / "planar.h5"), np.arange(-100_000, 300_001, 50_000)
    gyro = np.where(t[:, None] < 0, 0, [1.0, 2.0, 3.0]) + [0.1, 0.2, 0.3]
    imu = Imu(t, gyro, np.zeros_like(gyro))
    jaxevent.save(dataclasses.replace(recording, imu=imu), folder / "imu.h5")
    given = []

    class WithGyro(VotingEstimator):
        def estimate(self, recording, params, *, model, seed, progress, gyro):
            given.append((len(recording.events), seed, gyro))
            return MotionEstimate.empty(model)

    mine = WithGyro("voting", voting.Params, options=frozenset({"gyro"}))
    monkeypatch.setattr("jaxevent.egomotion.particle_filter.estimator.voting", mine)
    monkeypatch.setattr(methods, "_load", methods._load.__wrapped__)
    words = ("--model", "planar", "--imu", "--still=-0.1,0", "--seed", 7, "--stop", 0.1)
    run(folder, folder / "imu.h5", *words)
    [(events, seed, told)] = given
    assert (events, seed) == (len(recording[:0.1].events), 7)
    np.testing.assert_allclose(told(t[t >= 0])[1], np.tile([1.0, 2.0, 3.0], (7, 1)))


def known_general(source, span=(0, 250_000)):
    t = np.arange(span[0], span[1] + 1, 5_000)
    T, Omega = source.twist(t)
    T = T / np.linalg.norm(T, axis=1, keepdims=True)
    return KnownMotion(General, t, np.concatenate([T, Omega], 1))


def motion_of(known: KnownMotion, valid=None) -> MotionEstimate:
    n = known.values.shape[1]
    covariance = np.broadcast_to(0.0025 * np.eye(n), (len(known.t), n, n))
    return MotionEstimate.from_arrays(known.model, known.t, known.values, covariance, valid)


def test_general_motion_is_written_too(tmp_path):
    recording, source = motion_scene("shapes", **SEEN, duration=0.25)
    known = known_general(source)
    lost = (known.t < 50_000) | (known.t == 200_000)
    motion = dataclasses.replace(
        motion_of(known, ~lost), cloud=np.zeros((len(known.t), 3, 6)) + known.values[:, None]
    )
    output = pictures.Output(tmp_path / "out")
    written = output.write(
        recording, motion, {}, lambda _: pictures.ReferenceMotion(known, "itself")
    )
    header, table = read_table(tmp_path / "out" / "motion.csv")
    names = ["tx", "ty", "tz", "wx", "wy", "wz"]
    assert header == ["t", *names, *(f"sigma_{name}" for name in names), "lost"]
    np.testing.assert_allclose(table[table[:, -1] == 0, 7:13], 0.05)
    assert np.isnan(table[table[:, -1] == 1, 1:13]).all()
    error = written.errors
    assert error is not None
    for name in ("AAE_T", "AAE_Omega", "AME", "vector_error"):
        assert error.figures[name] < 1e-4  # deg, %
    start = recording.events.t[0]
    t = start + 1000 * np.arange(len(table))
    searched = (t < 50_000) | ((t > 195_000) & (t < 205_000))
    assert error.count == (~searched).sum()
    first = int(np.argmin(searched))
    assert error.startup == pytest.approx((t[first] - start) * 1e-6)
    assert error.lost == pytest.approx(searched[first:].mean())
    assert f"{100 * error.lost:.2f} % lost" in "\n".join(written.summary())


def test_events_moved_back_fall_together():
    """Events of points that follow a known motion exactly, against where the points are."""
    rng = np.random.default_rng(0)
    camera = PinholeCamera(80.0, 80.0, 47.5, 35.5)
    Omega, number = np.array([1.0, -1.5, 3.0]), 4000
    P = np.c_[rng.uniform(-0.5, 0.5, (number, 2)), np.ones(number)]
    t = np.sort(rng.integers(0, 60_000, number))
    # The camera's pose is exp(Omega t); what it sees of the world's P is its inverse times P.
    seen = Rotation.from_rotvec(-Omega * (t[:, None] - 30_000) * 1e-6).apply(P)
    at = 80 * seen[:, :2] / seen[:, 2:] + (47.5, 35.5)
    inside = (at > 0).all(1) & (np.rint(at) < (WIDTH, HEIGHT)).all(1)
    x, y = np.rint(at[inside]).astype(np.uint16).T
    events = Events(t[inside], x, y, np.ones(inside.sum(), bool))
    recording = Recording("points", WIDTH, HEIGHT, events, camera=camera)
    known = KnownMotion(MODELS["rotation"], np.array([0, 60_000]), np.stack([Omega, Omega]))
    back = warped_events(recording, motion_of(known), events, 30_000)
    middle = (80 * P[:, :2] / P[:, 2:] + (47.5, 35.5))[inside]
    assert np.abs(back - middle).max() < 0.75  # half a pixel, and what the turn makes of it
    assert np.abs(at[inside] - middle).max() > 4

    # Planar, of changing speed: U = (0, 1000 + 1e5 t) moves by 1000 t + 5e4 t^2.
    t = np.array([0, 10_000, 40_000])
    flat = KnownMotion(Planar, np.array([0, 50_000]), np.array([[0.0, 1000.0], [0.0, 6000.0]]))
    x = np.array([5, 6, 7], np.uint16)
    part = Events(t, x, x, np.ones(3, bool))
    back = warped_events(recording, motion_of(flat), part, 10_000)
    way = 1000 * t * 1e-6 + 5e4 * (t * 1e-6) ** 2
    np.testing.assert_allclose(back, np.c_[x, x - (way - way[1])], atol=0.02)


def test_errors_of_centred_estimates():
    """What was 20 ms ago, told 20 ms late, is right when centred."""
    t = np.arange(0, 300_001, 10_000)
    truth = KnownMotion(Planar, t, np.c_[1e-3 * t, 300 - 1e-3 * t])
    late = dataclasses.replace(motion_of(truth), t=t + 20_000, lag=np.full(len(t), 0.02))
    times = np.arange(40_000, 280_000, 1000)
    told = score_motion(late, truth, times)
    assert told.figures["AEE"] < 1e-9 and told.count == len(times) and told.startup == 0
    told = score_motion(late, truth, times, start=30_000, centred=False)
    assert told.figures["AEE"] == pytest.approx(20 * np.sqrt(2)) and told.startup == 0.01


def test_velocity_of_poses_at_the_depth_that_fits():
    recording, source = motion_scene("planar", "varying", size=(8, 6), focal=80.0, duration=0.3)
    t = np.arange(0, 300_001, 1000)
    motion = motion_of(KnownMotion(Planar, t, 1.02 * source.velocity(t)))
    told = pictures.motion_at_fitted_depth(recording, motion)
    np.testing.assert_allclose(told.values, 1.02 * source.velocity(told.t), rtol=0.02)
    for missing in ("poses", "camera"):
        with pytest.raises(InputError, match="which determine an image velocity"):
            pictures.motion_at_fitted_depth(
                dataclasses.replace(recording, **{missing: None}), motion
            )


def test_nothing_found_is_said(tmp_path, capsys, monkeypatch):
    t = np.arange(0, 60_000, 3_000)
    x, y = (37 * np.arange(20)) % WIDTH, (23 * np.arange(20)) % HEIGHT
    events = Events(t, x.astype(np.uint16), y.astype(np.uint16), x % 2 == 0)
    jaxevent.save(Recording("stray", WIDTH, HEIGHT, events), tmp_path / "stray.h5")
    (tmp_path / "mine.toml").write_text(SETTINGS)
    pictures.write_known_motion(tmp_path / "true.csv", "planar", t, np.ones((len(t), 2)))
    truth = ["--truth", tmp_path / "true.csv"]
    # Without --model it is chosen; nothing is seen to move here.
    fails(capsys, ["motion", tmp_path / "stray.h5", "--out", tmp_path / "out"], "stray.h5", "move")
    chosen = model_selection.ModelSelection(Planar, ("planar explains it",), {})
    monkeypatch.setattr(model_selection, "select_model", lambda recording: chosen)
    run(tmp_path, tmp_path / "stray.h5", "--flow", *truth)
    said = capsys.readouterr().out
    assert said.startswith("planar explains it\n") and "never found" in said
    with (tmp_path / "out" / "errors.json").open() as file:
        figures = json.load(file)["figures"]
    assert set(figures) == {"lost", "startup"} and figures["lost"]["value"] == 100
    with h5py.File(tmp_path / "out" / "flow.h5") as file:
        valid = np.asarray(file["valid"])
    assert len(valid) == 20 and not valid.any()


def test_bad_input_is_said_before_the_work(folder, capsys):
    planar, turn, out = folder / "planar.h5", folder / "turn.h5", folder / "out"
    recording = jaxevent.load(planar)
    frames = Frames(np.array([0]), np.zeros((1, HEIGHT, WIDTH), np.uint8), np.array([0]))
    empty = Recording("empty", WIDTH, HEIGHT, Events.empty(), frames)
    jaxevent.save(empty, folder / "empty.h5")
    bare = dataclasses.replace(recording, camera=None, poses=None)
    jaxevent.save(bare, folder / "bare.h5")
    (folder / "wrong.toml").write_text("particle = 3\n")
    (folder / "other.toml").write_text("[blob]\ngate = 3\n")
    (folder / "short.csv").write_text("t,vx\n0,1\n")
    (folder / "full").mkdir()
    (folder / "full" / "a").touch()
    before = sorted(folder.rglob("*"))
    model, to = ["--model", "planar"], ["--out", out]
    fails(capsys, ["motion", folder / "none.h5", *model, *to], "none.h5")
    fails(capsys, ["motion", folder / "empty.h5", *model, *to], "empty.h5", "no events")
    fails(capsys, ["motion", planar, "--model", "planer", *to], "did you mean 'planar'")
    for given in (model, []):
        fails(capsys, ["motion", planar, *given, "--method", "vote", *to], "'vote'", "voting")
    general = ["--model", "general", "--method", "planes"]
    fails(capsys, ["motion", planar, *general, *to], "'planes'", "planar and rotation")
    fails(capsys, ["motion", folder / "bare.h5", "--model", "rotation", *to], "no calibration")
    for focal, said in ((0, "--focal 0"), (80, "leave out --focal")):
        fails(capsys, ["motion", planar, *model, "--focal", focal, *to], said)
    for name, said in (
        ("wrong.toml", "did you mean 'particles'"),
        ("other.toml", "none of voting"),
        ("none.toml", "cannot be read"),
    ):
        fails(capsys, ["motion", planar, *model, "--params", folder / name, *to], name, said)
    fails(capsys, ["motion", folder / "bare.h5", *model, *to, "--truth"], "bare.h5")
    for name, said in (("none.csv", "cannot be read"), ("short.csv", "no column 'vy'")):
        fails(capsys, ["motion", planar, *model, "--truth", folder / name, *to], name, said)
    fails(capsys, ["motion", planar, *model, "--truth", folder / "turn.csv", *to], "'vx'")
    fails(capsys, ["motion", turn, *model, "--imu", *to], "--imu", "voting")
    fails(capsys, ["motion", turn, *model, "--still", "0,1", *to], "no IMU", "--still")
    fails(capsys, ["motion", turn, *model, "--seed", -1, *to], "--seed -1")
    fails(capsys, ["motion", turn, *model, "--start", 3, *to], "reaches from")
    for rate in ("0", "-1", "nan", "1e7"):
        fails(capsys, ["motion", turn, *model, f"--rate={rate}", *to], "--rate")
    for name in ("full", "missing/a", "a.csv", "turn.h5"):
        fails(capsys, ["motion", planar, *model, "--out", folder / name], folder / name)
    fails(capsys, ["motion", planar, *model, "--out", "."])
    assert sorted(folder.rglob("*")) == before


def test_without_matplotlib_the_tables_are_written(folder, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    run(folder, folder / "planar.h5", "--model", "planar", "--flow", "--seed", 3, "--stop", 0.1)
    names = sorted(one.name for one in (folder / "out").iterdir())
    assert names == ["flow.h5", "motion.csv", "motion.h5"]
    said = capsys.readouterr().out
    assert "pictures are left out: this needs the package 'matplotlib'" in said
    assert install_command("plot") in said and "planar motion by voting" in said


def test_simulated_motion_and_its_truth(folder, capsys):
    recording, source = motion_scene("planar", seed=1, **SEEN, duration=0.3)
    loaded = jaxevent.load(folder / "planar.h5")
    assert np.array_equal(loaded.events[:].t, recording.events[:].t)
    assert loaded.camera == source.camera
    header, table = read_table(folder / "planar.csv")
    assert header == ["t", "vx", "vy"]
    np.testing.assert_allclose(table[:, 0], np.arange(301) / 1000)
    np.testing.assert_allclose(table[:, 1:], source.velocity(np.arange(301) * 1000))
    header, table = read_table(folder / "turn.csv")
    assert header == ["t", "wx", "wy", "wz"]
    np.testing.assert_allclose(np.linalg.norm(table[:, 1:], axis=1), 2)

    argv = [*SIMULATE, "--motion", "wall", "--change", "varying", "--duration", "0.05"]
    files = ["--truth", str(folder / "wall.csv"), "--out", str(folder / "wall.h5")]
    assert cli.main([*argv, *files]) == 0
    assert f"{folder / 'wall.h5'}: " in capsys.readouterr().out
    _, source = motion_scene("wall", "varying", 1, **SEEN, duration=0.05)
    header, table = read_table(folder / "wall.csv")
    assert header == ["t", *General.components]
    T, Omega = source.twist(np.arange(51) * 1000)
    np.testing.assert_allclose(np.linalg.norm(table[:, 1:4], axis=1), 1)
    np.testing.assert_allclose(table[:, 1:4] * np.linalg.norm(T, axis=1)[:, None], T, rtol=1e-9)
    np.testing.assert_allclose(table[:, 4:], Omega, rtol=1e-9)

    before = sorted(folder.iterdir())
    for options, said in (
        ("--motion wal", "did you mean 'wall'"),
        ("--motion wall --change slow", "'slow'"),
        ("--motion wall --speed fast", "--speed fast"),
        ("--motion wall --cut 9", "--cut is not for the motion"),
        ("--motion wall --size 0,9", "--size 0,9"),
        ("--motion wall --truth no/a.csv", "no/a.csv"),
        ("--blobs disc --change linear", "--change is not for blobs"),
        ("--scene lake --change linear", "--change is for --motion"),
    ):
        fails(capsys, ["simulate", *options.split(), "--out", folder / "b.h5"], said)
    assert sorted(folder.iterdir()) == before


def test_a_table_of_states_is_exact(tmp_path):
    states = Estimate(
        np.array([[1.5, -2.0]] * 2), np.array([[[4.0, 1.0], [1.0, 9.0]]] * 2),
        np.array([True, False]),
    )  # fmt: skip
    times = np.array([1_500_000, 2_500_000])
    pictures.write_motion_table(tmp_path / "a.csv", "planar", times, states)
    lines = (tmp_path / "a.csv").read_text().splitlines()
    assert lines == ["t,vx,vy,sigma_vx,sigma_vy,lost", "1.5,1.5,-2.0,2.0,3.0,0", "2.5,,,,,1"]
    known = egomotion.truth.read_motion(tmp_path / "a.csv", "planar")  # the row that is found
    assert known.t.tolist() == [1_500_000] and known.values.tolist() == [[1.5, -2.0]]


@pytest.mark.parametrize("lines", ["t,vx,vy\n", "t,vx,vy,lost\n1.5,,,1\n"])
def test_a_table_without_motion_says_so(tmp_path, lines):
    (tmp_path / "a.csv").write_text(lines)
    with pytest.raises(InputError, match="a.csv: holds no motion; give a line for each time"):
        egomotion.truth.read_motion(tmp_path / "a.csv", "planar")
