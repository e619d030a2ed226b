"""The evaluation against hand computations, what it hides, and its configuration."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import jaxevent
import jaxevent.evaluate
from jaxevent import metrics
from jaxevent.evaluate import evaluate, score
from jaxevent.reconstruction import METHODS
from jaxevent.reconstruction.estimator import State
from jaxevent.recording import Events, Frames, Recording

WIDTH, HEIGHT = 24, 20
STAMPS = np.array([0, 9_000, 21_000, 30_000, 41_000, 52_000])


def small(**fields) -> Recording:
    """A recording of 400 events and 6 frames of noise, 24x20 pixels."""
    rng = np.random.default_rng(5)
    t = np.sort(rng.integers(1_000, 50_000, 400))
    x, y = rng.integers(0, WIDTH, 400), rng.integers(0, HEIGHT, 400)
    events = Events(t, x.astype(np.uint16), y.astype(np.uint16), rng.random(400) < 0.5)
    images = rng.integers(0, 256, (len(STAMPS), HEIGHT, WIDTH)).astype(np.uint8)
    frames = Frames(STAMPS, images, np.zeros_like(STAMPS))
    return dataclasses.replace(Recording("small", WIDTH, HEIGHT, events, frames), **fields)


def write_config(folder: Path, text: str) -> Path:
    path = folder / "run.toml"
    path.write_text(text)
    return path


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    jaxevent.save(small(), tmp_path / "small.h5")
    return tmp_path


def blended_by_hand() -> tuple[NDArray, NDArray]:
    """The hidden frames, and what lies linearly between the given ones; the last one is held."""
    grey = small().frames.images / 255  # type: ignore[reportOptionalMemberAccess]
    u, v = 9 / 21, 9 / 20
    between = [(1 - u) * grey[0] + u * grey[2], (1 - v) * grey[2] + v * grey[4], grey[4]]
    return grey[1::2], np.array(between)


@pytest.mark.parametrize("offset", [0.0, 0.004, -0.004])
def test_blend_is_scored_as_by_hand(offset):
    truth, between = blended_by_hand()
    params = METHODS["blend"].Params.of({"clock_offset": offset})
    row = score(small(), METHODS["blend"], params)
    errors = ((between - truth) ** 2).mean((1, 2))
    assert row["per_frame"]["t"] == [9_000, 30_000, 52_000]
    np.testing.assert_allclose(row["per_frame"]["mse"], errors, rtol=1e-6)
    np.testing.assert_allclose(row["per_frame"]["ssim"], metrics.ssim(between, truth), atol=1e-6)
    assert row["mse"] == pytest.approx(errors.mean(), rel=1e-6)
    assert row["ssim"] == pytest.approx(np.mean(row["per_frame"]["ssim"]))
    assert (row["frames"], row["events"]) == (3, 400)
    assert row["seconds"] > 0
    assert row["params"] == {"c_on": 0.1, "c_off": 0.1, "I0": 1.0, "clock_offset": offset}


def test_hidden_frames_are_never_seen(monkeypatch):
    frames = small().frames
    assert frames is not None
    images = frames.images.copy()
    images[1::2] = 255 - images[1::2]
    other = small(frames=dataclasses.replace(frames, images=images))
    seen: list[list[NDArray]] = []

    def record(image, truth):
        seen[-1].append(image)
        return metrics.mse(image, truth)

    monkeypatch.setattr(jaxevent.evaluate, "mse", record)
    rows = []
    for recording in (small(), other):
        seen.append([])
        rows.append(score(recording, METHODS["akf"]))
    assert len(seen[0]) == 3
    np.testing.assert_array_equal(seen[0], seen[1])
    assert rows[0]["mse"] != rows[1]["mse"]
    assert np.max(seen) <= 1 and np.min(seen) >= 0


def test_what_is_not_a_number_is_none():
    def broken(params, state, dt, frame):
        return State(frame.level * np.nan, frame.level)

    row = score(small(), dataclasses.replace(METHODS["blend"], advance=broken))
    assert row["mse"] is None and row["ssim"] is None
    assert row["per_frame"]["mse"] == [None] * 3
    json.dumps(row, allow_nan=False)


@pytest.mark.parametrize(
    ("recording", "said"),
    [
        (small().with_frames(slice(0, 2)), "has 2 frames"),
        (small(frames=None), "has 0 frames"),
        (small(events=Events.empty()), "holds no events"),
    ],
)
def test_recordings_that_cannot_be_scored(recording, said):
    with pytest.raises(jaxevent.InputError, match=f"small: {said}"):
        score(recording, METHODS["blend"])
    with pytest.raises(jaxevent.InputError, match="did you mean 'held-out'"):
        score(recording, METHODS["blend"], protocol="heldout")


def test_results_of_a_configuration(folder, monkeypatch):
    (folder / "sub").mkdir()
    jaxevent.save(small(name="b"), folder / "sub" / "b.h5")
    jaxevent.save(small(name="a"), folder / "sub" / "a.h5")
    (folder / "mine.toml").write_text("I0 = 2\n")
    monkeypatch.setenv("SMALL", str(folder))
    config = write_config(
        folder,
        """
        recordings = ["sub/*.h5", "$SMALL/small.h5", "sub/a.h5"]
        size = [24, 20]
        [[method]]
        name = "blend"
        [[method]]
        name = "blend"
        label = "mine"
        params = "mine.toml"
        [[method]]
        name = "last-frame"
        params = { clock_offset = 0.001 }
        """,
    )
    out = folder / "results"
    rows = evaluate(config, out)
    labels = ["blend", "mine", "last-frame"]
    recordings = ["sub/a.h5", "sub/b.h5", "$SMALL/small.h5"]
    assert [(row["recording"], row["method"]) for row in rows] == [
        (recording, label) for recording in recordings for label in labels
    ]
    assert rows[1]["params"]["I0"] == 2
    assert rows[2]["params"]["clock_offset"] == 0.001
    assert json.loads((out / "results.json").read_text()) == {"rows": rows}
    keys = "recording method mse ssim frames events seconds params per_frame".split()
    assert list(rows[0]) == keys
    assert list(rows[0]["per_frame"]) == ["t", "mse", "ssim"]
    assert (out / "results.md").read_text().count("\n") == 2 + len(rows)
    assert (out / "config.toml").read_bytes() == config.read_bytes()

    again = evaluate(config, out)  # replaces the results
    assert [row["mse"] for row in again] == [row["mse"] for row in rows]
    assert sorted(path.name for path in out.iterdir()) == [
        "config.toml",
        "results.json",
        "results.md",
    ]


ONE = 'recordings = ["small.h5"]\n[[method]]\nname = "blend"\n'


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('recording = ["small.h5"]', "no setting 'recording'; did you mean 'recordings'"),
        ("", "recordings is missing"),
        ('recordings = "small.h5"', "recordings is missing or not a list"),
        ('recordings = ["small.h5"]', "no method is given"),
        ('recordings = ["small.h5"]\n[method]\nname = "akf"', "no method is given"),
        ('protocol = "held_out"\n' + ONE, "no protocol 'held_out'; did you mean 'held-out'"),
        ("protocol = 3\n" + ONE, "no protocol 3"),
        ("size = [24]\n" + ONE, "size is"),
        ("size = [24, 2.0]\n" + ONE, "size is"),
        (ONE + 'lable = "x"', "method 1: .*did you mean 'label'"),
        (ONE + "label = 3", "name and label must be text"),
        (ONE + "params = 3", "params is 3"),
        (ONE + 'params = "none.toml"', "method 1: .*none.toml: cannot be read"),
        (ONE + "params = { c_onn = 0.1 }", "method 1: .*'c_onn'; did you mean 'c_on'"),
        (ONE + 'params = { response = "srgb" }', "no parameter 'response'"),
        (ONE + 'params = { c_on = "much" }', "c_on is much"),
        (ONE + "params = { c_on = true }", "c_on is True"),
        (ONE + "params = { c_on = nan }", "c_on is nan"),
        (ONE + "params = { c_on = -1 }", "c_on is -1"),
        (ONE + '[[method]]\nname = "bland"', "method 2: .*'bland'; did you mean 'blend'"),
        (ONE.replace("small", "*"), "no recording matches '.*npz'"),
        (ONE.replace("small", "$NOT_SET/a"), "needs the variable NOT_SET, which is not set"),
        (ONE.replace("small", "${NOT_SET}/a"), "needs the variable NOT_SET, which is not set"),
        ("recordings = [", "is not TOML"),
    ],
)
def test_configurations_are_refused(folder, text, said):
    config = write_config(folder, text.replace("*.h5", "*.npz"))
    with pytest.raises(jaxevent.InputError, match=said) as error:
        evaluate(config, folder / "out")
    assert str(error.value).startswith(f"{config}: ")
    assert not (folder / "out").exists()


def test_a_failure_leaves_earlier_results(folder):
    out = folder / "out"
    evaluate(write_config(folder, ONE), out)
    before = {path: path.read_bytes() for path in out.iterdir()}
    with pytest.raises(jaxevent.InputError, match="nothing.h5"):
        evaluate(write_config(folder, ONE.replace("small", "nothing")), out)
    assert {path: path.read_bytes() for path in out.iterdir()} == before


def test_real_recording(data, float32, monkeypatch):
    """The table of slider_depth, and that thresholds and clock by hand make the AKF better."""
    monkeypatch.setenv("JAXEVENT_DATA", str(data.parent))
    configs = Path(__file__).parents[1] / "configs"
    errors = {row["method"]: 100 * row["mse"] for row in evaluate(configs / "slider_depth.toml")}
    expected = {"akf": 0.196, "augmented": 0.189, "cf": 0.274, "cf-augmented": 0.222}
    for method, error in {**expected, "blend": 0.291}.items():
        assert errors[method] == pytest.approx(error, rel=0.1), method
    assert errors["akf, by hand"] <= 0.15
