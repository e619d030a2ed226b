"""Measures of tracks on cases whose answers are known by hand."""

import numpy as np
import pytest
from scripts import FOLDER, script

from jaxevent.blob import constant_velocity
from jaxevent.blob.scores import HOTA_THRESHOLDS, score_tracks
from jaxevent.errors import InputError
from jaxevent.simulate import blob_scene

T = 10


def path(x, first=0, last=T):
    """A target or track at (x, 0) from one time to before another."""
    out = np.full((T, 2), np.nan)
    out[first:last] = x, 0
    return out


def scored(truth, tracks, reach=4.0, hidden=None):
    true, result = (np.stack(p, 1) if p else np.zeros((T, 0, 2)) for p in (truth, tracks))
    return score_tracks(true, result, reach, hidden)


def counts(result):
    names = ("targets", "tracks", "found", "missed", "false", "switches")
    return tuple(getattr(result, name) for name in names)


def test_right_tracks():
    result = scored([path(0), path(50)], [path(50), path(0)])
    assert counts(result) == (2, 2, 2, 0, 0, 0)
    assert (result.covered, result.mota, result.idf1, result.hota, result.rms) == (1, 1, 1, 1, 0)
    np.testing.assert_array_equal(result.match, np.tile([1, 0], (T, 1)))


def test_a_track_that_goes_over_to_another_target():
    """Two tracks that swap after four of ten times."""
    swapped = [np.r_[path(0)[:4], path(50)[4:]], np.r_[path(50)[:4], path(0)[4:]]]
    result = scored([path(0), path(50)], swapped)
    assert counts(result) == (2, 2, 2, 0, 0, 2)
    assert result.covered == 1 and result.mota == pytest.approx(1 - 2 / 20)
    assert result.idf1 == pytest.approx(2 * 12 / 40)
    # Each of 4 and 6 true positives of a pair: 4 / (10 + 10 - 4) and 6 / (10 + 10 - 6).
    assert result.deta == pytest.approx(1)
    assert result.assa == pytest.approx((8 * 4 / 16 + 12 * 6 / 14) / 20)
    assert result.hota == pytest.approx(np.sqrt(result.assa))


def test_missed_false_and_late():
    """One target without a track, one found late, and a track of nothing for six times."""
    result = scored([path(0), path(50)], [path(50, 3), path(99, 0, 6)])
    assert counts(result) == (2, 2, 1, 1, 1, 0)
    assert result.covered == 7 / 20
    assert result.mota == pytest.approx(1 - (13 + 6) / 20)
    assert result.idf1 == pytest.approx(2 * 7 / (20 + 13))
    assert result.deta == pytest.approx(7 / (20 + 13 - 7)) and result.assa == pytest.approx(0.7)


def test_distance():
    """2 px off at a reach of 4 px: a similarity of 3/4, which 15 of 19 thresholds allow."""
    result = scored([path(0)], [path(2)])
    assert result.rms == 2 and result.mota == result.idf1 == 1
    share = (HOTA_THRESHOLDS <= 0.75).mean()
    assert share == 15 / 19
    assert result.deta == result.assa == result.hota == pytest.approx(share)
    assert scored([path(0)], [path(4.1)]).covered == 0


def test_a_match_stays_while_it_may():
    """Another track that comes nearer for some times does not take the target over."""
    result = scored([path(0)], [path(2), path(1, 3, 7)])
    np.testing.assert_array_equal(result.match[:, 0], 0)
    assert result.switches == 0 and result.mota == pytest.approx(1 - 4 / 10)
    # Two that may follow one of two targets each are both matched, though one is further away.
    both = scored([path(0), path(3)], [path(2.5), path(6)], reach=3.0)
    assert both.covered == 1


def test_fragments():
    """A target whose track ends and begins anew: one switch, identity for six of ten times."""
    result = scored([path(0)], [path(0, 0, 4), path(0, 4)])
    assert counts(result) == (1, 2, 1, 0, 0, 1)
    assert result.idf1 == pytest.approx(2 * 6 / 20)


def test_hidden_targets():
    hidden = np.zeros((T, 1), bool)
    hidden[4:7] = True
    waiting, without = scored([path(0)], [path(1)], 4.0, hidden), scored([path(0)], [path(1, 0, 4)])
    assert waiting.mota == waiting.idf1 == waiting.covered == 1 and waiting.false == 0
    assert without.covered == 0.4
    gone = scored([path(0)], [path(1, 0, 4), path(1, 7)], 4.0, hidden)
    assert gone.covered == 1 and gone.switches == 1


def test_nothing():
    result = scored([], [])
    assert counts(result) == (0,) * 6
    assert result.idf1 == result.hota == result.mota == 1 and np.isnan(result.rms)
    assert scored([], [path(0)]).false == 1 and scored([path(0)], []).missed == 1
    assert scored([path(0)], []).hota == scored([], [path(0)]).hota == 0
    with pytest.raises(InputError, match="do not fit"):
        score_tracks(np.zeros((3, 1, 2)), np.zeros((4, 1, 2)), 1.0)


def test_settling_begins_with_the_recording(monkeypatch):
    """The first event is later than time 0, which no track can be asked for."""
    monkeypatch.syspath_prepend(str(FOLDER))
    recording, truth = blob_scene("walk", duration=0.05)
    assert recording.start > 0
    seeds = [(*truth(0.0)[0, 0, :2], 8.0)]
    tracks = constant_velocity.estimate(recording, seeds=seeds, start=0.0, smooth=False)
    assert script("blob_synthetic").settling_time(tracks, truth) == np.inf  # it has no sizes
