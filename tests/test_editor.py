"""Editors and type checkers tell wrong calls from right ones before they run."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

START = """\
from typing import Any
import jax.numpy as jnp
import jaxevent
from jaxevent.blob import moment
from jaxevent.egomotion import voting

recording = jaxevent.load("a.h5")
values: dict[str, Any] = {"c_on": 0.1}
"""
WRONG = [
    "jaxevent.akf.Params(c_onn=0.1)",
    'jaxevent.akf.Params(c_on="0.1")',
    "jaxevent.aks.Params(0.1)",
    "jaxevent.mc.Params(deblur=0.5)",
    "moment.Params(events_per_step=2.5)",
    "voting.Params(particels=400)",
    "jaxevent.akf.Params.for_recording()",
    'jaxevent.load("a.h5", sizes=(240, 180))',
    "jaxevent.evaluate()",
    "recording.framez",
    "jaxevent.Recording.from_arrays([1], [2], [3], [0], widht=4)",
    "jaxevent.akf.estimate(recording, jaxevent.aks.Params())",
]
RIGHT = [
    "jaxevent.akf.Params()",
    "jaxevent.akf.Params(c_on=0.1, kappa=1, certainty=[0.5, 1.0], deblur=False)",
    "jaxevent.aks.Params(frame_noise=0.02, c_on=jnp.asarray(0.1))",
    'moment.Params(preset="slow", events_per_step=4)',
    "voting.Params(particles=400)",
    "jaxevent.akf.Params(**values).c_on + 1",
    "jaxevent.akf.Params.for_recording(recording, c_on=0.1).replace(c_off=0.2)",
    'jaxevent.load("a.h5", size=(240, 180))',
    'jaxevent.evaluate(recording, ["akf", (jaxevent.aks, jaxevent.aks.Params())], gap=4)',
    "jaxevent.akf.estimate(recording, jaxevent.akf.Params())([0.5]).mean",
    "jaxevent.Recording.from_arrays([1], [2], [3], [0], width=4, height=4)",
    "jaxevent.akf.Params.c_on.unit.upper()",
]


def test_wrong_calls_are_flagged_and_right_ones_are_not(tmp_path):
    pytest.importorskip("ty")
    (tmp_path / "calls.py").write_text(START + "\n".join([*WRONG, *RIGHT]) + "\n")
    command = [sys.executable, "-m", "ty", "check", "--output-format", "concise", "--python"]
    root = str(Path(__file__).parents[1])
    checked = subprocess.run(
        [*command, sys.executable, "--extra-search-path", root, "calls.py"],
        cwd=tmp_path, capture_output=True, text=True,
    )  # fmt: skip
    first = START.count("\n") + 1
    lines = {int(number) for number in re.findall(r"^calls\.py:(\d+):", checked.stdout, re.M)}
    flagged = [call for number, call in enumerate([*WRONG, *RIGHT], first) if number in lines]
    assert flagged == WRONG, checked.stdout + checked.stderr
