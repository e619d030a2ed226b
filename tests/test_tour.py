"""The notebook of the tour runs from beginning to end."""

import json
from pathlib import Path

import pytest

TOUR = Path(__file__).parents[1] / "experiments" / "tour.ipynb"


@pytest.mark.slow
def test_the_tour_runs(float32):
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("Agg")
    cells = json.loads(TOUR.read_text())["cells"]
    code = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
    assert sum(bool(line.strip()) for cell in code for line in cell.splitlines()) < 40
    scope: dict = {}
    for cell in code:
        exec(cell, scope)
    assert scope["fitted"].loss < 0.9 * scope["before"]
    matplotlib.pyplot.close("all")
