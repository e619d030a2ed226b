"""The ten tasks of the page "Ten tasks in a notebook" run, and give what they should."""

import os
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from pages import run_page

import jaxevent
from jaxevent.metrics import mse

PAGE = Path(__file__).parents[1] / "docs" / "notebook.md"


@pytest.fixture(scope="module")
def scope(tmp_path_factory):
    pytest.importorskip("distributed", reason="needs the extra 'cluster'")
    import jax

    folder = tmp_path_factory.mktemp("notebook")
    with pytest.MonkeyPatch.context() as patch, jax.enable_x64(False):
        patch.chdir(folder)
        patch.setattr(os, "environ", os.environ.copy())
        scope = run_page(PAGE.read_text())
    return {**scope, "folder": folder}


def test_there_are_ten_tasks():
    assert [f"\n## {k} " in PAGE.read_text() for k in range(1, 12)] == [True] * 10 + [False]


@pytest.mark.slow
def test_arrays_in(scope):
    recording, corner = scope["recording"], scope["corner"]
    assert (recording.width, recording.height) == (40, 30)
    for name in "txyp":
        np.testing.assert_array_equal(getattr(recording.events, name), getattr(corner.events, name))
    expected = jaxevent.akf.estimate(corner)([0.7, 0.75]).mean
    np.testing.assert_allclose(scope["image"], expected, atol=1e-5)


@pytest.mark.slow
def test_fit_by_hand(scope):
    assert scope["history"][-1] < 0.95 * scope["history"][0]
    # Another way to the same loss: the video of the thresholds that were found.
    params = jaxevent.akf.Params(c_on=float(scope["c_on"]), c_off=float(scope["c_off"]))
    video = jaxevent.akf.estimate(scope["given"], params)
    found = video(scope["hidden"].t, extrapolate=True).mean
    error = ((found - scope["hidden"].intensity) ** 2).mean()
    assert error < scope["history"][0]
    assert error == pytest.approx(float(scope["loss"](scope["log_c"])[0]), rel=1e-3)


@pytest.mark.slow
def test_errors_of_many_parameters(scope):
    params = jaxevent.akf.Params(c_on=float(scope["best"]), c_off=float(scope["best"]))
    video = jaxevent.akf.estimate(scope["given"], params)
    found = video(scope["hidden"].t, extrapolate=True).mean
    error = ((found - scope["hidden"].intensity) ** 2).mean()
    assert float(scope["errors"].min()) == pytest.approx(error, rel=1e-3)
    assert len(set(np.asarray(scope["errors"]).tolist())) == 5


@pytest.mark.slow
def test_own_scan(scope):
    """A loop over the pixel's events gives what the scan gives."""
    params = scope["params"]
    state = jaxevent.akf.init(params, scope["level"])
    assert len(scope["L"]) == scope["here"].sum() > 10
    event = scope["Event"]
    for k, (since, polarity) in enumerate(zip(scope["since"], scope["polarity"], strict=True)):
        given = event(jnp.asarray(since), jnp.asarray(since), jnp.asarray(polarity), scope["frame"])
        state = jaxevent.akf.step(params, state, given)
        assert float(state.L) == pytest.approx(float(scope["L"][k]), abs=1e-4)


@pytest.mark.slow
def test_tables_of_tracks_and_motion(scope):
    table = scope["table"]
    truth = scope["true_state"](table["t"].to_numpy())[:, 0, :2]
    distance = np.hypot(*(table[["x", "y"]].to_numpy() - truth).T)
    assert np.median(distance) < 3
    assert scope["tracked"][0]["rmse"] < 3
    velocity, world = scope["velocity"], scope["world"]
    assert scope["valid"].all()
    true = world.velocity(scope["times"])
    assert (
        np.linalg.norm(velocity - true, axis=1).mean() < 0.1 * np.linalg.norm(true, axis=1).mean()
    )
    assert {"t", "vx", "vy", "lost"} <= set(scope["motions"].columns)
    assert scope["moved"][0]["AEE_rel"] < 10


@pytest.mark.slow
def test_own_metric(scope):
    scores, recording = scope["scores"], scope["recording"]
    assert [row["recording"] for row in scores] == ["early"] * 3 + ["late"] * 3
    part = recording[0.75:]
    given, hidden = part.with_frames(slice(0, None, 2)), part.frames[1::2]
    params = jaxevent.akf.Params.for_recording(given)
    times = hidden.t + round(1e6 * float(params.clock_offset))
    shown = np.clip(jaxevent.akf.estimate(given, params)(times, extrapolate=True).mean, 0, 1)
    each = [scope["edge_error"](a, b) for a, b in zip(shown, hidden.intensity, strict=True)]
    row = scores[4]
    assert (row["recording"], row["method"]) == ("late", "akf")
    assert row["edge_error"] == pytest.approx(np.mean(each), rel=1e-3)
    means = scores.means()
    assert means.loc["akf", "recordings"] == 2
    pair = [row["edge_error"] for row in scores if row["method"] == "akf"]
    assert means.loc["akf", "edge_error"] == pytest.approx(np.mean(pair))
    assert scores.to_dataframe().shape[0] == 6


@pytest.mark.slow
def test_tonic_and_torch(scope):
    for name in "txyp":
        expected = getattr(scope["recording"].events, name)
        np.testing.assert_array_equal(getattr(scope["again"].events, name), expected)
        np.testing.assert_array_equal(scope["records"][name], expected)
    assert scope["again"].extra["target"] == 3
    if scope["torch"] is not None:
        of_torch = scope["of_torch"]
        np.testing.assert_array_equal(of_torch.events.x, scope["recording"].events.x)
        assert tuple(scope["tensor"].shape) == (2, 30, 40)


class Tensor:
    """An array as PyTorch's tensors are seen by others: no NumPy array, but its protocols."""

    def __init__(self, values):
        self._values = np.array(values)

    def __dlpack__(self, **options):
        return self._values.__dlpack__(**options)

    def __dlpack_device__(self):
        return self._values.__dlpack_device__()

    def __len__(self):
        return len(self._values)


def test_arrays_of_other_libraries(scope):
    """By DLPack alone, as tensors come; and JAX arrays go out by it."""
    events = scope["recording"].events
    columns = [Tensor(getattr(events, name).astype(np.int64)) for name in "txyp"]
    recording = jaxevent.Recording.from_arrays(*columns, width=40, height=30, time_unit="us")
    for name in "txyp":
        np.testing.assert_array_equal(getattr(recording.events, name), getattr(events, name))
    image = jnp.asarray(scope["image"])
    np.testing.assert_array_equal(np.from_dlpack(image), np.asarray(image))


@pytest.mark.slow
def test_own_methods(scope):
    errors = {row["method"]: row["mse"] for row in scope["own"]}
    hidden = scope["recording"].frames[1::2].intensity
    grey = np.mean([mse(np.full(one.shape, 0.5), one) for one in hidden])
    assert errors["middle_grey"] == pytest.approx(grey, rel=1e-6)
    assert errors["akf"] != errors["forgetful"] < errors["middle_grey"]


@pytest.mark.slow
def test_dask(scope):
    assert [row["method"] for row in scope["far"]] == ["blend", "last-frame"]
    assert len(list((scope["folder"] / "compared" / "tasks").glob("*.json"))) == 2
    near = jaxevent.evaluate(scope["recording"], "blend")
    assert scope["far"][0]["mse"] == pytest.approx(near[0]["mse"], rel=1e-5)
    assert (scope["folder"] / "compared" / "results.md").read_text() == scope["far"].table()
