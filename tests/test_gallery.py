"""The notebooks of the gallery run as scripts, and show what their text says."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import jaxevent

FOLDER = Path(__file__).parents[1] / "docs" / "gallery"
NAMES = sorted(path.stem for path in FOLDER.glob("*.py"))


def run(name: str, monkeypatch: Any, tmp_path: Path) -> dict[str, Any]:
    """Run a notebook's code, and check that its plots have legends."""
    pytest.importorskip("matplotlib").use("Agg")
    import matplotlib.pyplot as plt

    monkeypatch.chdir(tmp_path)
    scope: dict[str, Any] = {"__name__": "notebook"}
    code = compile((FOLDER / f"{name}.py").read_text(), f"{name}.py", "exec")
    exec(code, scope)
    assert plt.get_fignums(), "a notebook shows a plot"
    assert all(axis.get_legend() for axis in plt.gcf().axes if axis.lines)
    plt.close("all")
    return scope


def check_own_data(scope):
    again, recording = scope["again"], scope["recording"]
    for name in "txyp":
        np.testing.assert_array_equal(getattr(again.events, name), getattr(recording.events, name))


def check_hdr_video(scope):
    mean = {name: values.mean() for name, values in scope["errors"].items()}
    assert mean["aks"] < mean["akf"] < 0.8 * mean["blend of frames"]


def check_events_only(scope):
    errors = {k: np.mean([e for _, e in pairs]) for k, pairs in scope["fitted"].items()}
    assert errors["events-only"] < 0.85 * min(errors["high-pass filter"], scope["constant"].mean())


def check_fit_noise(scope):
    for name, found, deviation in zip(
        scope["names"], scope["found"], scope["deviation"], strict=True
    ):
        assert abs(np.log(found / scope["TRUE"][name])) < 4 * deviation < 0.2


def check_vmap(scope):
    grid, params = np.asarray(scope["grid"]), jaxevent.akf.Params(
        c_on=float(scope["thresholds"][2]), c_off=float(scope["thresholds"][4]),
        clock_offset=scope["offset"],
    )  # fmt: skip
    video = jaxevent.akf.estimate(scope["given"], params)
    error = ((video(scope["times"]).mean - scope["truth"]) ** 2).mean(axis=(1, 2))
    np.testing.assert_allclose(grid[2, 4], error, rtol=1e-2)
    assert 0 < scope["on"] < 6 and 0 < scope["off"] < 6  # inside of the grid


def check_own_estimator(scope):
    error = {row["method"]: row["mse"] for row in scope["scores"]}
    assert error["akf"] != error["forgetful"] < error["integrate"] < error["blend"]


def check_blobs(scope):
    assert scope["table"]["id"].nunique() == 1
    error = scope["table"][["x", "y"]].to_numpy() - scope["true"]
    assert np.sqrt((error**2).mean()) < 0.6


def check_egomotion_gyro(scope):
    np.testing.assert_allclose(scope["bias"], scope["BIAS"], atol=0.08)
    assert scope["relative_error"](scope["truth"]) < 0.08


def check_data_set(scope):
    assert len(scope["table"]) == 18
    means = scope["scores"].means()["mse"]
    assert means["akf"] < means["blend"] < means["last-frame"]


def check_tonic_torch(scope):
    part, recording = scope["part"], scope["recording"]
    for name in "txyp":
        np.testing.assert_array_equal(getattr(recording.events, name), getattr(part.events, name))
        np.testing.assert_array_equal(scope["item"][0][name], getattr(part.events, name))
    assert np.asarray(scope["grid"]).sum() == pytest.approx(
        np.where(part.events.p, 1, -1).sum(), abs=1
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_notebook_runs(name, monkeypatch, tmp_path, float32):
    globals()[f"check_{name}"](run(name, monkeypatch, tmp_path))


def test_there_are_ten_notebooks_which_their_index_names():
    assert len(NAMES) == 10
    index = (FOLDER / "index.md").read_text()
    assert sorted(re.findall(r"\((\w+)\.md\)", index)) == NAMES
    for name in NAMES:
        assert (FOLDER / f"{name}.py").read_text().startswith("# %% [markdown]\n# # ")


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


def test_arrays_go_in_and_out_by_dlpack():
    t = np.arange(6) * 100
    columns = [Tensor(column) for column in (t, t % 4, t % 3, t % 200 // 100)]
    recording = jaxevent.Recording.from_arrays(*columns, width=4, height=3, time_unit="us")
    np.testing.assert_array_equal(recording.events.t, t)
    image = jaxevent.high_pass.estimate(recording)([3e-4]).mean
    np.testing.assert_array_equal(np.from_dlpack(image), np.asarray(image))
