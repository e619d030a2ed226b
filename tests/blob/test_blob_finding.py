"""The centred mean that `moment` is held against begins where each target is first seen."""

import numpy as np
import pytest
from scripts import script

from jaxevent.blob import find
from jaxevent.simulate.blobs import LinearMotion, Target, simulate_blobs

SIZE = 200, 100


@pytest.fixture(scope="module")
def finding():
    return script("blob_finding")


def test_the_centred_mean_waits_for_a_target_that_comes_later(finding):
    """One that has stood outside until then would have met no event of it."""
    still = LinearMotion((30, 20), (0, 20), size=(3, 3))
    late = LinearMotion((-80, 50), (200, 0), size=(3, 3))
    recording, truth = simulate_blobs([Target(m, 5e3) for m in (still, late)], SIZE, 1.0, 100, 0)
    times = np.linspace(10_000, 990_000, 50).astype(np.int64)
    paths = finding.track_by_means(recording, find(recording, progress=False), truth, times)
    true = truth(times)[..., :2]
    inside = (true >= 0).all(-1) & (true < SIZE).all(-1)
    assert not np.isfinite(paths[times < 400_000, 1]).any()
    assert np.linalg.norm(paths - true, axis=-1)[:-2][inside[:-2]].max() < 3
