"""The preset "authors" against what the authors' program told, from raw events on.

The golden files hold all events, whose each is, and states after some of them: of the program with
its polarity offset (upd10) and without (upd8). Pixels count from 1 there.
"""

import functools
import re

import jax
import numpy as np
import pandas as pd
import pytest

import jaxevent
from jaxevent.blob import chi2, negative_log_likelihood
from jaxevent.blob.authors import MAX_PENDING_EVENTS
from jaxevent.cli import main
from jaxevent.errors import InputError
from jaxevent.recording import Events, Recording
from jaxevent.runs.evaluate import evaluate
from jaxevent.simulate import CircularMotion, Target, simulate_blobs


@functools.cache
def golden_of(folder, name):
    """A recording, its seeds, and the file's tables."""
    with np.load(folder / f"aeb_{name}.npz") as file:
        tables = {key: file[key] for key in file.files}
    config = str(tables["config_yaml"])

    def setting(key):
        found = re.search(rf"^{key}\s*: *\[?([^\]\n#]*)", config, re.MULTILINE)
        return [float(part) for part in found[1].split(",")]

    raw = tables["events_x_y_p_tus"][int(setting("event_num_start")[0]) :].astype(np.int64)
    x, y, p, t = raw.T
    events = Events(t, x.astype(np.uint16), y.astype(np.uint16), p > 0)
    width, height = (int(setting(key)[0]) for key in ("width", "height"))
    starts = zip(setting("position_x_init"), setting("position_y_init"), strict=True)
    seeds = [(x - 1, y - 1, setting("lambda_init")[0]) for x, y in starts]
    return Recording(name, width, height, events), seeds, tables


run = jax.jit(chi2.run)


def followed(recording, seeds, **values):
    """Targets after each event: a pytree whose arrays begin with (events, targets)."""
    params = chi2.Params(preset="authors", **values)
    features, _ = chi2.prepare(recording, [], params, seeds=seeds)
    tracks, _ = run(params, features)
    valid = np.asarray(features.valid)[..., 0]
    return jax.tree.map(lambda a: np.asarray(a)[:, 1:][valid], tracks)


CASES = [("lights_mini", True), ("ties_mini", False)]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "offset"), CASES)
def test_the_authors_program(golden, name, offset):
    recording, seeds, tables = golden_of(golden, name)
    tracks = followed(recording, seeds, polarity_offset=offset)
    key, columns = "upd10" if offset else "upd8", list(tables["columns"])
    count = len(tables["events_x_y_p_tus"]) - len(recording.events)  # events left out before

    # Which events move which target.
    changed = (np.diff(tracks.state.x, axis=0, prepend=np.nan) != 0).any(-1)
    changed[0] = tracks.hits[0] > 0
    wanted = np.zeros_like(changed)
    event, target = tables[f"{key}_event_target"].T
    wanted[event - 1 - count, target] = True
    last = event[-1] - count
    np.testing.assert_array_equal(changed[:last], wanted[:last])

    # And where to.
    d, rows = 10 if offset else 8, tables[key]
    event = rows[:, columns.index("event_id")].astype(int) - 1 - count
    target = rows[:, columns.index("target")].astype(int)
    x = tracks.state.x[event, target] + np.pad([1.0, 1.0], (0, d - 2))
    i = columns.index("px")
    np.testing.assert_allclose(x, rows[:, i : i + d], 1e-9, 1e-9)
    P = np.diagonal(tracks.state.P, axis1=-2, axis2=-1)[event, target]
    i = columns.index("P_px")
    np.testing.assert_allclose(P, rows[:, i : i + d], 1e-9, 1e-9)
    radius = rows[:, columns.index("dist_threshold")]
    np.testing.assert_allclose(tracks.gate[event, target], radius, 1e-9, 1e-9)
    if name != "lights_mini":  # it ends before the gate adapts
        assert (rows[:, 0] > 0.026).sum() > 20 and radius[-1] > 10.001


def stream(t, xi, p):
    x, y = np.asarray(xi).T.astype(np.uint16)
    made = Events(np.asarray(t, np.int64), x, y, np.asarray(p, bool))
    return Recording("ties", 64, 48, made)


@pytest.mark.slow
@pytest.mark.parametrize("waiting", [20, MAX_PENDING_EVENTS + 5])
def test_events_of_one_time_are_replayed(waiting):
    """They act as if they had come one after the other until the next event, in its place."""
    rng, most = np.random.default_rng(waiting), min(waiting, MAX_PENDING_EVENTS)
    few = rng.integers(20, 28, (5, 2))
    tied, n = rng.integers(20, 28, (waiting, 2)), len(few)
    t, gap = 100 + 50 * np.arange(n), 3 * most  # us
    t = np.r_[t, np.full(waiting, t[-1]), t[-1] + gap, t[-1] + gap + 70]
    ends = [[24, 25], [23, 22]]
    xi = np.concatenate([few, tied, ends])
    p = np.r_[rng.random(n + waiting) < 0.5, True, False]
    apart = np.r_[t[:n], t[n - 1] + 3 * np.arange(1, most + 1), t[-1]]
    kept = np.concatenate([few, tied[:most], ends[1:]])
    signs = np.r_[p[:n], np.ones(most), False]
    seeds = [(24.0, 24.0, 10.0), (60.0, 40.0, 10.0)]
    one = followed(stream(t, xi, p), seeds)
    other = followed(stream(apart, kept, signs), seeds)
    np.testing.assert_allclose(one.state.x[-1], other.state.x[-1], 1e-12, 1e-12)
    np.testing.assert_allclose(one.state.P[-1], other.state.P[-1], 1e-12, 1e-12)
    assert one.hits[-1, 0] == len(t) and (one.state.x[n - 1] == one.state.x[n + waiting - 1]).all()


@pytest.mark.slow
def test_the_nearest_target_alone_may_take_an_event():
    seeds = [(10.0, 10.0, 4.0), (40.0, 10.0, 4.0)]
    xi = [[10, 10], [10, 30], [22, 10], [41, 10], [31, 10]]
    tracks = followed(stream(10 * np.arange(5), xi, [1, 1, 1, 0, 0]), seeds)
    np.testing.assert_array_equal(tracks.hits, [[1, 0], [1, 0], [1, 0], [1, 1], [1, 2]])
    assert (np.diff(tracks.state.x[:4, 0], axis=0) == 0).all()
    np.testing.assert_array_equal(
        tracks.reference.last_nearest[-1] - tracks.reference.last_event[-1], [-20, 0]
    )


@pytest.mark.slow
def test_track_and_evaluate(golden, tmp_path):
    """The commands tell the program's states; they are the truth that `evaluate` compares with."""
    recording, seeds, tables = golden_of(golden, "blob_mini")
    jaxevent.save(recording, tmp_path / "blob.h5")
    (tmp_path / "authors.toml").write_text('preset = "authors"\n')
    seed = ",".join(map(str, seeds[0]))
    given = ["--method", "chi2", "--params", tmp_path / "authors.toml", "--filtered"]
    given += ["--seed", seed, "--at", "events", "--out", tmp_path / "out.csv"]
    assert main(list(map(str, ["track", tmp_path / "blob.h5", *given]))) == 0
    found = pd.read_csv(tmp_path / "out.csv", comment="#")
    wanted = pd.DataFrame(tables["upd10"], columns=list(tables["columns"]))
    wanted[["px", "py"]] -= 1  # pixels from 0
    rows = np.abs(found["t"].to_numpy() - wanted["ts_s"].to_numpy()[:, None]).argmin(1)
    for name, other in {"x": "px", "y": "py", "vx": "vx", "vy": "vy"}.items():
        np.testing.assert_allclose(found[name][rows], wanted[other], 1e-9, 1e-9)
    sizes = np.sort(found[["lambda1", "lambda2"]].to_numpy()[rows])
    np.testing.assert_allclose(sizes, np.sort(wanted[["lam1", "lam2"]]), 1e-9)

    truth = wanted.rename(columns={"ts_s": "t", "px": "x", "py": "y"})[["t", "x", "y"]]
    truth.to_csv(tmp_path / "blob.csv", index=False)
    (tmp_path / "evaluate.toml").write_text(
        f"""
        recordings = ["blob.h5"]
        protocol = "tracks"
        positions = "*.csv"
        seeds = [{list(seeds[0])}]
        smooth = false
        [[method]]
        name = "chi2"
        params = {{ preset = "authors" }}
        """
    )
    (row,) = evaluate(tmp_path / "evaluate.toml", tmp_path / "scores")
    assert row["rmse"] < 1e-6 and row["covered"] == 1


@pytest.mark.slow
def test_the_likelihood_has_its_gradient(golden):
    """Through gates and ties, by differences."""
    recording, seeds, _ = golden_of(golden, "ties_mini")
    params = chi2.Params(preset="authors")
    features, _ = chi2.prepare(recording, [], params, seeds=seeds)

    def loss(raw):
        return negative_log_likelihood(chi2, params.with_raw(raw), features)

    loss, raw, h = jax.jit(loss), {k: params.raw[k] for k in ("Q_p", "Q_lambda")}, 1e-4
    for name, slope in jax.jacfwd(loss)(raw).items():
        ends = (loss({**raw, name: raw[name] + sign * h}) for sign in (1, -1))
        np.testing.assert_allclose(slope, -np.diff([*map(float, ends)])[0] / (2 * h), 1e-5)


@pytest.mark.slow
def test_targets_may_be_born_too():
    """Two dots, found on the grid and followed in single steps until the events end."""
    circles = [CircularMotion((x, 32.0), 4.0, 10.0, size=(2.0, 2.0)) for x in (24.0, 72.0)]
    dots = [Target(circle, 2e4) for circle in circles]
    recording, truth = simulate_blobs(dots, (96, 64), 0.06, 0, 2)
    small = {"lambda0": 5.0, "gate_min": 8.0, "n_birth": 10.0}
    params = chi2.Params(preset="authors", **small)
    tracks = chi2.estimate(recording, params, smooth=False)
    assert len(tracks) == 2 and tracks.ended == ("end", "end")
    result, true = tracks([0.05]).mean[0, :, :2], truth(np.array([0.05]))[0, :, :2]
    order = np.argsort(result[:, 0])
    np.testing.assert_allclose(result[order], true, atol=1.5)


def test_steps_of_several_events_are_refused(golden):
    recording, seeds, _ = golden_of(golden, "blob_mini")
    params = chi2.Params(preset="authors", events_per_step=4)
    with pytest.raises(InputError, match="events_per_step is 4; omit it"):
        chi2.estimate(recording, params, seeds=seeds)
