"""Live motion is that of the causal filter over a recording, however events are divided."""

import dataclasses

import numpy as np
import pytest
from points import HEIGHT, WIDTH, moved

from jaxevent.egomotion import voting
from jaxevent.errors import InputError
from jaxevent.recording import Events

PARAMS = voting.Params.of(
    {"every": 4, "candidates": 24, "particles": 60, "batch": 32, "tau_max": 0.06}
)


@pytest.mark.slow
def test_live_motion_equals_the_causal_filter():
    recording = moved(lambda at: np.array([180.0, -90.0]), 0.44, 100, seed=3)
    e = recording.events
    late = e.t + 500_000 * (e.t > 240_000)  # a pause
    recording = dataclasses.replace(recording, events=Events(late, e.x, e.y, e.p))
    options = {"seed": 2, "compiler": "xla"}
    whole = voting.estimate(recording, PARAMS, causal=True, **options)
    assert whole.valid.mean() > 0.2 and not whole(np.array([400_000])).valid.any()
    live, rng, row = voting.live((WIDTH, HEIGHT), PARAMS, **options), np.random.default_rng(0), 0
    with pytest.raises(InputError, match="nothing has been added"):
        _ = live.stop
    parts = []
    while row < len(e):
        number = int(rng.choice([0, 1, 40, 900]))
        parts.append(live.add(recording.events[row : row + number]))
        row += number
    parts.append(live.finish())
    for name in ("t", "mean", "covariance", "valid", "lag", "contrast"):
        joined = np.concatenate([getattr(part, name) for part in parts])
        np.testing.assert_array_equal(joined, getattr(whole, name))
    assert len(live.motion) == len(whole)
    np.testing.assert_array_equal(live(live.stop).mean, whole(live.stop).mean)
    silent = live(live.stop + round(1e6 * float(PARAMS.tau_max)) * np.array([0, 2]))
    assert silent.valid.tolist() == [True, False] and np.isnan(silent.mean[1]).all()
    with pytest.raises(InputError, match="finished"):
        live.add(recording.events[:1])
