"""Every command and example of the README works, in the order printed."""

import importlib.util
import json
import os
import re
from pathlib import Path

import pytest
from commands import decoded
from pages import run_page, shortened
from PIL import Image

from jaxevent.methods import names

README = (Path(__file__).parents[1] / "README.md").read_text()


@pytest.mark.slow
def test_examples_run_in_order(tmp_path, monkeypatch, capsys, float32):
    pytest.importorskip("matplotlib").use("Agg")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(os, "environ", os.environ.copy())
    monkeypatch.setattr("jaxevent.runs.demo.RECORDING_FILE", tmp_path / "short.h5")
    scope = run_page(shortened(README, tmp_path / "short.h5"))
    recording = scope["recording"]
    assert scope["image"].shape == (len(recording.frames), 120, 160)
    assert scope["gradient"].raw["c_on"] != 0
    for name in ("jaxevent-demo", "slider.mp4", "dot", "moved", "fitted/params.toml"):
        assert (tmp_path / name).exists()
    check_demo(tmp_path / "jaxevent-demo", capsys.readouterr().out)


def check_demo(out: Path, said: str) -> None:
    """What `jaxevent demo` writes and prints."""
    assert (
        out / "results.md"
    ).read_text() in said and f"written: {out.name}/comparison.png\n" in said
    rows = json.loads((out / "results.json").read_text())["rows"]
    errors = {row["method"]: row["mse"] for row in rows}
    known = names("reconstruction")
    if importlib.util.find_spec("cv2") is None:
        known.remove("flow")
        assert "flow is left out" in said
    assert list(errors)[: len(known)] == known
    assert len(errors) == len(known) + 2
    assert errors["akf"] < errors["akf, not calibrated"] < errors["last-frame"]
    with Image.open(out / "comparison.png") as figure:
        assert figure.width > 1000
    images, about = decoded(out / "video.mp4", 240, 320)
    assert len(images) == 80 and " 30 fps" in about


def test_the_fit_sees_no_frame_that_the_filter_was_given():
    """A filter reproduces the frames that it is given, whatever its thresholds are."""
    recipe = re.findall(r"```python\n(.*?)```", README, re.DOTALL)[-1]
    assert "given = recording.with_frames" in recipe and "prepare_images(given, hidden.t" in recipe


def test_every_method_is_named():
    for name in names():
        assert f"`{name}`" in README


def test_links_work_on_the_package_index():
    """There, links relative to the repository lead nowhere."""
    assert len(README.splitlines()) < 150
    links = re.findall(r"\]\((.*?)\)", README)
    assert links and all(link.startswith("https://") for link in links)
    for link in links:
        place = re.match(r"https://\S+?/jaxevent/jaxevent/(?:blob/)?main/(.*)", link)
        assert place and (Path(__file__).parents[1] / place[1]).exists(), link
