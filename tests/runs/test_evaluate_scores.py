"""Evaluations of motion and tracks: rows against what the estimators give, keys, bad settings."""

import base64
import io
import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from PIL import Image

import jaxevent
from jaxevent import blob, egomotion
from jaxevent.egomotion.scores import endpoint_error
from jaxevent.egomotion.truth import read_motion
from jaxevent.errors import InputError
from jaxevent.runs import evaluate
from jaxevent.runs.blob_scores import read_positions
from jaxevent.runs.scores import Sample
from jaxevent.show.page import page, picture
from jaxevent.show.tables import markdown_table, short_names
from jaxevent.simulate import blob_scene, motion_scene
from jaxevent.simulate.blobs import ApproachMotion, Target, simulate_blobs


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A planar motion and a blob, each with its table."""
    folder = tmp_path_factory.mktemp("known")
    recording, source = motion_scene("planar", "constant", 3, size=(64, 48), duration=0.2)
    jaxevent.save(recording, folder / "wall.h5")
    t = np.arange(0, 0.2, 0.001)
    vx, vy = source.velocity(t).T
    pd.DataFrame({"t": t, "vx": vx, "vy": vy}).to_csv(folder / "wall.csv", index=False)
    moving, truth = blob_scene("disc", seed=1)
    jaxevent.save(moving[:0.1], folder / "dot.h5")
    t = np.arange(0.005, 0.095, 0.001)
    x, y = truth(t)[:, 0, :2].T
    pd.DataFrame({"t": t, "x": x, "y": y}).to_csv(folder / "dot.csv", index=False)
    return folder


def configured(folder: Path, name: str, text: str) -> Path:
    path = folder / f"{name}.toml"
    path.write_text(text)
    return path


MOTION = """
recordings = ["wall.h5"]
protocol = "motion"
truth = "*.csv"
settle = 0.1
[[method]]
name = "planes"
[[method]]
name = "planes"
label = "coarse"
params = { step = 0.04 }
"""
TRACKS = """
recordings = ["dot.h5"]
protocol = "tracks"
positions = "*.csv"
[[method]]
name = "moment"
grid = { lambda0 = [4.0, 8.0] }
"""


@pytest.mark.slow
def test_motion(folder, tmp_path):
    config = configured(folder, "motion", MOTION)
    rows = evaluate.evaluate(config, tmp_path / "out")
    assert [row["method"] for row in rows] == ["planes", "coarse"]
    recording = jaxevent.load(folder / "wall.h5")
    truth = read_motion(folder / "wall.csv", "planar")
    for row, settings in zip(rows, ({}, {"step": 0.04}), strict=True):
        params = egomotion.planes.Params.of(settings)
        motion = egomotion.planes.estimate(recording, params)
        times = np.array(row["per_time"]["t"])
        assert times[0] >= 100_000 and set(np.diff(times)) == {5000}
        mean, _, valid = motion(times)
        assert row["lost"] == 0 and valid.all() and row["times"] == len(times)
        np.testing.assert_allclose(row["AEE"], endpoint_error(mean, truth(times)).mean())
        speed = np.linalg.norm(truth(times), axis=1)
        each = 100 * np.linalg.norm(mean - truth(times), axis=1) / speed
        np.testing.assert_allclose(row["per_time"]["error"], each, rtol=1e-5)
        np.testing.assert_allclose(row["AEE_rel"], each.mean())
    assert rows[0]["AEE"] != rows[1]["AEE"]
    said = markdown_table(rows)
    assert "AEE %" in said and "MSE" not in said
    assert "<h2>Pictures" not in page(rows, [None, None], "motion", "", [], "a")

    # Nothing is computed again but what depends on a changed truth.
    kept = {path: path.stat().st_mtime_ns for path in (tmp_path / "out" / "tasks").glob("*.json")}
    assert len(kept) == 2
    assert json.dumps(evaluate.evaluate(config, tmp_path / "out")) == json.dumps(rows)
    assert {path: path.stat().st_mtime_ns for path in kept} == kept
    table = pd.read_csv(folder / "wall.csv")
    other = configured(folder, "other", MOTION.replace("*.csv", "twice.csv"))
    table.assign(vx=2 * table.vx, vy=2 * table.vy).to_csv(folder / "twice.csv", index=False)
    far = evaluate.evaluate(other, tmp_path / "out")
    assert 40 < far[0]["AEE_rel"] < 60


@pytest.mark.slow
def test_tracks(folder):
    rows = evaluate.evaluate(configured(folder, "tracks", TRACKS))
    recording = jaxevent.load(folder / "dot.h5")
    known = read_positions(folder / "dot.csv")
    for row, size in zip(rows, (4.0, 8.0), strict=True):
        x, y = known.xi[0, 0]
        params = blob.moment.Params(lambda0=size)
        tracks = blob.moment.estimate(
            recording, params, seeds=[(x, y, size, int(known.t[0]) / 1e6)]
        )
        told = tracks(known.t)
        distance = np.linalg.norm(told.mean[:, 0, :2] - known.xi[:, 0], axis=1)
        alive = np.isfinite(distance)
        assert alive.mean() > 0.9
        np.testing.assert_allclose(row["rmse"], np.sqrt((distance[alive] ** 2).mean()))
        np.testing.assert_allclose(row["median"], np.median(distance[alive]))
        assert row["covered"] == alive.mean() and row["times"] == len(known.t)


LIGHTS = """
recordings = ["cars.h5"]
protocol = "tracks"
positions = "cars.csv"
pairs = [[0, 1]]
extent = 0.2
focal = 1000.0
size_factor = 0.25
smooth = SMOOTH
begin = "BEGIN"
[[method]]
name = "moment"
params = { preset = "ttc", lambda0 = 6.0, events_per_step = 16, n_confirm = 60, tau_birth = 0.01 }
"""


@pytest.fixture(scope="module")
def cars(tmp_path_factory):
    """Two lights of one car, and all that is known of them."""
    folder = tmp_path_factory.mktemp("cars")
    lights = [
        Target(ApproachMotion((x, 0.3), 14.0, 3.5, (0.2, 0.15), centre=(160, 100)), 1e4)
        for x in (-0.7, 0.7)
    ]
    recording, truth = simulate_blobs(lights, (320, 240), 0.4, 4e3, 3)
    jaxevent.save(recording, folder / "cars.h5")
    t = np.arange(0.05, 0.4, 0.005)
    depth = 14.0 - 3.5 * t
    tables = []
    for k in (0, 1):
        names = ["x", "y", "vx", "vy", "lambda1", "lambda2", "theta", "q"]
        table = pd.DataFrame(truth(t)[:, k], columns=names)
        tables.append(table.assign(t=t, id=k, range=depth, inverse_ttc=3.5 / depth))
    pd.concat(tables).to_csv(folder / "cars.csv", index=False)
    return folder


@pytest.mark.slow
def test_what_is_known_beside_positions(cars):
    rows = {}
    for smooth in ("true", "false"):
        text = LIGHTS.replace("SMOOTH", smooth).replace("BEGIN", "positions")
        (rows[smooth],) = evaluate.evaluate(configured(cars, f"positions-{smooth}", text))
    row = rows["true"]
    assert (row["tracks"], row["missed"], row["false"], row["switches"]) == (2, 0, 0, 0)
    assert min(row["mota"], row["idf1"], row["hota"]) > 0.8 and row["covered"] > 0.9
    assert row["rmse"] < 1 and row["velocity"] < 20 and row["size"] < 0.1 and row["range"] < 0.15
    assert row["theta"] < 10 and row["inverse_ttc"] < 0.15
    assert row["velocity"] < rows["false"]["velocity"]  # smoothing helps
    said = markdown_table([row])
    assert all(name in said for name in ("HOTA", "switches", "1/TTC 1/s", "range %"))


@pytest.mark.slow
def test_targets_are_searched_for(cars):
    text = LIGHTS.replace("SMOOTH", "false").replace("BEGIN", "found")
    (row,) = evaluate.evaluate(configured(cars, "found", text))
    assert (row["tracks"], row["missed"], row["false"]) == (2, 0, 0)
    assert row["covered"] == 1 and row["mota"] == 1 and row["idf1"] == 1
    assert row["rmse"] < 1 and row["inverse_ttc"] < 0.15


@pytest.mark.slow
def test_of_a_pair_without_tracks_no_contact_is_told(cars):
    text = LIGHTS.replace("SMOOTH", "false").replace("BEGIN", "born")
    text = text.replace("n_confirm = 60", "n_confirm = 1e6")
    (row,) = evaluate.evaluate(configured(cars, "none", text))
    assert (row["tracks"], row["missed"], row["covered"]) == (0, 2, 0)
    assert row["inverse_ttc"] is None


@pytest.mark.parametrize(
    ("text", "named"),
    [
        (TRACKS.replace('"*.csv"', '"*.csv"\nbegin = "truth"'), '"found"'),
        (TRACKS.replace('"*.csv"', '"*.csv"\nextent = 0.2'), "focal"),
        (TRACKS.replace('"*.csv"', '"*.csv"\npairs = [[1, 1]]'), "id, id"),
        (MOTION.replace('truth = "*.csv"', ""), "true motion is not given"),
        (MOTION.replace('truth = "*.csv"', 'truth = "*.csv"\nmodel = "planer"'), "planar"),
        (MOTION.replace("settle = 0.1", "settle = -1"), "settle is '-1'"),
        (MOTION.replace("settle = 0.1", "metrics = ['lpips']"), "there is no metric 'lpips'"),
        (MOTION.replace("planes", "akf", 1), "'akf' is of reconstruction"),
        (MOTION.replace("*.csv", "*.txt"), "wall.txt: cannot be read"),
        (MOTION.replace("*.csv", "poses"), "neither from poses"),
        (MOTION.replace('label = "coarse"', "normalise = 'affine'"), "no setting 'normalise'"),
        (MOTION.replace('"motion"', '"motions"'), "did you mean 'motion'"),
        (TRACKS.replace('positions = "*.csv"', ""), "positions are not given"),
        (TRACKS.replace('"moment"', '"akf"'), "is of reconstruction, not of blob"),
        (TRACKS.replace('"*.csv"', '"none.csv"'), "none.csv: cannot be read"),
    ],
)
def test_bad_settings(text, named, folder):
    with pytest.raises(InputError, match=named.replace(".", r"\.")):
        evaluate.evaluate(configured(folder, "bad", text))


def test_recordings_are_called_by_name_where_that_tells_them_apart():
    paths = ["a/one.h5", "b/one.h5", "b/two.h5"]
    assert short_names(paths) == {
        "a/one.h5": "a/one.h5",
        "b/one.h5": "b/one.h5",
        "b/two.h5": "two.h5",
    }


def test_a_picture_shows_the_frame_before_and_the_uncertainty():
    truth = np.full((4, 6), 0.2)
    truth[0, 0] = 0.4
    deviation = np.full((4, 6), 0.01)
    deviation[1, 2], deviation[1, 3] = 7.0, 1e-4
    sample = Sample(5, truth, truth, False, deviation, truth / 2)
    shown = {
        name: np.asarray(Image.open(io.BytesIO(base64.b64decode(png))).convert("L"))
        for name, png in picture(sample).items()
        if name != "t"
    }
    # White is the truth's brightest 0.5 %, for all alike; an uncertainty of 0.1 is white, of 0.001
    # black and of 0.01 in the middle.
    assert shown["truth"][0, 0] == 255 and 186 < shown["truth"][2, 2] < 200
    np.testing.assert_array_equal(shown["image"], shown["truth"])
    linear = [(int(shown[name][2, 2]) / 255 + 0.055) ** 2.4 for name in ("given", "truth")]
    assert linear[0] / linear[1] == pytest.approx(0.5, rel=0.05)  # of the sRGB curve
    assert shown["deviation"][1, 2] == 255 and shown["deviation"][1, 3] == 0
    assert shown["deviation"][0, 0] in (127, 128)
