"""What the README says about names is what the code has."""

import re
from pathlib import Path

import jaxevent

README = (Path(__file__).parents[1] / "README.md").read_text()


def test_table_of_parameters_is_complete():
    table = README[README.index("| parameter |") :]
    rows = dict(re.findall(r"^\| `(\w+)` \| ([^|]+?) \|", table, re.MULTILINE))
    numbers, choices = {}, {}
    for method in jaxevent.METHODS.values():
        numbers |= method.Params.numbers
        choices |= method.Params.choices
    assert rows.keys() == numbers.keys() | choices.keys()
    for name, number in numbers.items():
        default = number.default if isinstance(number.default, tuple) else (number.default,)
        assert rows[name] == ", ".join(f"{value:.4g}" for value in default), name
    for name, choice in choices.items():
        assert rows[name] == " or ".join(str(option).lower() for option in choice.options)


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
