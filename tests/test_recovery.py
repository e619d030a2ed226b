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
def test_the_likelihood_finds_what_the_data_were_drawn_with(recovery):
    for name, (true, found) in recovery.model_recovery(100).items():
        assert abs(found / true - 1) < 0.1, (name, true, found)
