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
def test_intervals_hold_what_the_data_were_drawn_with(recovery, optimised):
    """Of the smoother; of the other methods the script says it."""
    true, told = recovery.model_recovery(0, size=(28, 24))
    for name, value in true.items():
        one = told[name]
        assert one.holds(value) and not one.holds(one.start), (name, value, one)
        assert 0.5 * value < one.low < one.high < 2 * value
