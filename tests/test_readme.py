"""What the README says about names is what the code has."""

import re
import runpy
from pathlib import Path

import jaxevent
from jaxevent.methods import names

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()


def test_table_of_parameters_is_that_of_the_code():
    page = runpy.run_path(str(ROOT / "experiments" / "parameters.py"))["page"]()
    assert (ROOT / "docs" / "parameters.md").read_text() == page
    kinds = [jaxevent.METHODS[name].Params for name in names()]
    for kind in kinds:
        for name in (*kind.numbers, *kind.choices):
            assert f"| `{name}` |" in page


def test_every_method_is_named():
    for name in names("reconstruction"):
        assert f"`{name}`" in README


def test_python_examples_run(tmp_path, monkeypatch):
    """The examples, with the recording they name replaced by the packaged crop."""
    crop = Path(jaxevent.__file__).parent / "data" / "slider_depth_crop.h5"
    recording = jaxevent.load(crop)[0.6:0.8]
    monkeypatch.chdir(tmp_path)
    jaxevent.save(recording, "slider_depth.zip")
    scope = {}
    for block in re.findall(r"```python\n(.*?)```", README, re.DOTALL):
        exec(block, scope)
    assert scope["image"].shape == scope["variance"].shape == (len(recording.frames), 180, 240)
