"""Parameters that data were drawn with are found by the likelihood alone."""

import importlib.util
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[1] / "experiments" / "recovery.py"


@pytest.fixture(scope="module")
def recovery():
    spec = importlib.util.spec_from_file_location("recovery", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.slow
@pytest.mark.parametrize("part, few", [("model", {}), ("akf", {"size": (40, 32)})])
def test_intervals_hold_what_the_data_were_drawn_with(recovery, part, few, optimised):
    true, told = getattr(recovery, f"{part}_recovery")(0, **few)
    for name, value in true.items():
        one = told[name]
        assert one.holds(value) and not one.holds(one.start), (name, value, one)
        assert 0.5 * value < one.low < one.high < 2 * value
