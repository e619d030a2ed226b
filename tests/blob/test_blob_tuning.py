"""The likelihood of events finds process noises that track as well as the best of a grid."""

import dataclasses

import pytest
from scripts import script


@pytest.fixture(scope="module")
def tuning():
    return script("blob_tuning")


@pytest.mark.slow
def test_the_likelihood_finds_the_process_noise(tuning):
    """On other recordings; the true positions of those choose the point of the grid."""
    start, fitted, best = tuning.tune_scene(
        "lissajous",
        {"stiff": {"Q_v": 0.01}},
        (1,),
        (2,),
        seconds=0.4,
        settings=dataclasses.replace(tuning.SETTINGS, iterations=14),
        grid={"Q_v": [10.0**k for k in (5, 5.5, 6, 6.5, 7)]},
        rate=5e4,
    )
    assert start["rmse"] > 1.5 * best["rmse"]
    assert fitted["rmse"] < 1.05 * best["rmse"]
    assert 30 < fitted["Q_v"] / start["Q_v"] < 300
