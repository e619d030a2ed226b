"""What the README says about names is what the code has."""

import re
from pathlib import Path

import jaxevent

README = (Path(__file__).parents[1] / "README.md").read_text()


def test_table_of_parameters_is_complete():
    table = README[README.index("| parameter |") :]
    rows = dict(re.findall(r"^\| `(\w+)` \| ([^|]+?) \|", table, re.MULTILINE))
    known = {}
    for method in jaxevent.METHODS.values():
        known |= method.Params.numbers
    assert rows.keys() == known.keys()
    for name, number in known.items():
        assert float(rows[name]) == float(f"{number.default:.4g}"), name


def test_every_method_is_named():
    for name in jaxevent.METHODS:
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
