import subprocess
import sys

import h5py
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from refusals import refuses

from jaxevent import io
from jaxevent.errors import InputError
from jaxevent.io import disorder
from jaxevent.recording import Events, Recording

WIDTH, HEIGHT = 64, 48


def clean_times(number=4000, seed=0, start=5_000_000):
    return start + np.cumsum(np.random.default_rng(seed).integers(0, 100, number))


def columns_of(t, seed=1):
    rng = np.random.default_rng(seed)
    x, y = rng.integers(0, WIDTH, len(t)), rng.integers(0, HEIGHT, len(t))
    return t, x.astype(np.uint16), y.astype(np.uint16), rng.integers(0, 2, len(t)).astype(bool)


def examined(t, pieces=1, **options):
    return disorder.find_disorder(np.array_split(np.asarray(t, np.int64), pieces), **options)


def mended(t, how, pieces=1):
    """Times, and the rows of the events in `t`, after a repair of blocks of events."""
    repair = disorder.parse_repair(how)
    found = examined(t, pieces, max_late_us=repair.bound)
    found.refuse_rest(repair, "here")
    rows = np.arange(len(t))
    blocks = [
        (k, (t[part], part, part, part)) for k, part in enumerate(np.array_split(rows, pieces))
    ]

    def decode(state):
        yield from blocks[state or 0 :]

    again = disorder.repair_decoder(decode, found, repair)
    out = list(again(None))
    for state, (times, row, *_) in out:  # each block can be decoded by itself
        _, (same, same_row, *_) = next(again(state))
        np.testing.assert_array_equal(times, same)
        np.testing.assert_array_equal(row, same_row)
    return tuple(np.concatenate([block[k] for _, block in out]) for k in (0, 1))


@pytest.mark.parametrize("pieces", [1, 7, 400])
def test_jitter_is_sorted(pieces):
    t = clean_times()
    rng = np.random.default_rng(2)
    late = rng.random(len(t)) < 0.1
    jittered = t - late * rng.integers(1, 5000, len(t))
    found = examined(jittered, pieces)
    assert not (found.outliers or found.wraps or found.resets)
    reached = np.maximum.accumulate(jittered)
    assert found.late == np.count_nonzero(jittered < reached)
    assert found.latest == (reached - jittered).max()
    times, rows = mended(jittered, "sort", pieces)
    np.testing.assert_array_equal(rows, np.argsort(jittered, kind="stable"))
    np.testing.assert_array_equal(times, np.sort(jittered))


@pytest.mark.parametrize("pieces", [1, 7, 400])
@pytest.mark.parametrize("far", [-99_000, 3_000_000_000])
def test_outliers_are_dropped(far, pieces):
    t = clean_times()
    bad = np.array([0, 1, 700, 1500, 1501, 1502, 3998, 3999])
    wrong = t.copy()
    wrong[bad] += far
    found = examined(wrong, pieces)
    assert not (found.wraps or found.resets)
    # Events at the very end that are far ahead are in order, as those at the start far behind.
    in_order = {-99_000: [0, 1], 3_000_000_000: [3998, 3999]}[far]
    dropped = [row for row in bad if row not in in_order]
    times, rows = mended(wrong, "drop", pieces)
    np.testing.assert_array_equal(rows, np.delete(np.arange(len(t)), dropped))
    np.testing.assert_array_equal(times, np.delete(wrong, dropped))
    assert found.dropped == len(dropped)


@pytest.mark.parametrize("pieces", [1, 7, 400])
@pytest.mark.parametrize("period", [2**32, 2**24, 2**32 / 1000])
def test_wraps_are_continued(period, pieces):
    t = clean_times(start=int(3 * period) - 70_000)
    # Events that are late by a little fall on the other side of the wrap, too.
    t[1000::500] -= 40
    counter = np.rint(t - np.floor(t / period) * period).astype(np.int64)
    found = examined(counter, pieces)
    assert not (found.outliers or found.resets)
    assert sum(np.sign(size) for _, size in found.wraps) == 1
    times, _ = mended(counter, "unwrap,sort", pieces)
    np.testing.assert_allclose(times - times[0], np.sort(t) - t.min(), atol=1)


def test_resets_leave_parts():
    first, second, third = clean_times(700, 1), clean_times(2000, 2), clean_times(900, 3, 4_990_000)
    t = np.concatenate([first, second, third])
    for pieces in (1, 7, 400):
        found = examined(t, pieces)
        assert found.parts == [(0, 700), (700, 2700), (2700, 3600)]
        assert not (found.outliers or found.wraps or found.late)
        np.testing.assert_array_equal(mended(t, "part", pieces)[0], second)
        np.testing.assert_array_equal(mended(t, "part:3", pieces)[0], third)
    refuses(r"has no part 4.*from 1 to 3", mended, t, "part:4")
    refuses("set back 2 times, at event 700.*repair='part'", mended, t, "sort")


@given(st.integers(0, 2**31), st.integers(1, 60))
def test_all_faults_together(seed, pieces):
    rng = np.random.default_rng(seed)
    t = clean_times(3000, seed, start=2**32 - 75_000)
    late = np.maximum(t - (rng.random(len(t)) < 0.05) * rng.integers(0, 3000, len(t)), t[0])
    wrong = late.copy()
    bad = rng.choice(np.arange(5, 2990), rng.integers(0, 5), replace=False)
    wrong[bad] += rng.choice([-50_000_000, 70_000_000, 900_000_000], len(bad))
    wrong %= 2**32
    times, rows = mended(wrong, "sort,drop,unwrap", pieces)
    kept = np.delete(np.arange(len(t)), bad)
    order = np.argsort(late[kept], kind="stable")
    np.testing.assert_array_equal(rows, kept[order])
    np.testing.assert_array_equal(times, late[kept][order])


def test_times_in_order_have_no_faults():
    t = clean_times()
    t[2000:] += 2**32  # a pause as long as the period of a counter
    found = examined(t, 9)
    assert found.first is None
    assert not (found.outliers or found.wraps or found.resets or found.late)
    assert found.describe_repair(disorder.parse_repair("sort")).endswith("none went back")


def test_times_in_no_order_are_told():
    t = clean_times(20_000) * 100
    refuses(
        "^here: .*in no order; sort the events",
        examined,
        np.random.default_rng(0).permutation(t),
        source="here",
    )


@pytest.mark.parametrize("how", ["", "sorted", "sort:", "sort:-1", "drop:3", "part:0", "sort;drop"])
def test_unknown_repairs_are_told(how, tmp_path):
    refuses("repair = .*; give sort .*, drop .*, unwrap .* and part", disorder.parse_repair, how)
    refuses("there is no such file|repair = ", io.load, tmp_path / "none.h5", repair=how)


def stored(path, t, x, y, p):
    if path.suffix == ".npz":
        np.savez(path, t=t, x=x, y=y, p=p, width=WIDTH, height=HEIGHT)
    elif path.suffix == ".npy":
        np.save(path, np.stack([t, x, y, p], 1).astype(np.int64))
    elif path.suffix == ".csv":
        rows = "\n".join(
            ",".join(map(str, row)) for row in zip(t, x, y, p.astype(int), strict=True)
        )
        path.write_text(f"t,x,y,p\n{rows}\n")
    elif path.suffix == ".mat":
        import scipy.io

        scipy.io.savemat(path, {"events": np.stack([t, x + 1, y + 1, p], 1).astype(float)})
    else:
        with h5py.File(path, "w") as file:
            for name, values in zip("txyp", (t, x, y, p.astype(np.uint8)), strict=True):
                file[f"events/{name}"] = values
    return path


@pytest.mark.parametrize("in_memory", [True, False])
@pytest.mark.parametrize("suffix", [".npz", ".npy", ".csv", ".mat", ".h5"])
def test_every_reader_repairs(suffix, in_memory, tmp_path):
    t, x, y, p = columns_of(clean_times(3000))
    wrong = t.copy()
    wrong[100] -= 300_000
    wrong[2000] = wrong[1999] - 5
    wrong[2001:] = np.maximum(wrong[2001:], wrong[1999])
    path = stored(tmp_path / f"a{suffix}", wrong, x, y, p)
    size = (WIDTH, HEIGHT)
    with pytest.raises(InputError, match="event 100 is at .*1 event far from .*late by at most"):
        io.load(path, size, in_memory)[:].events[:]
    with pytest.raises(InputError, match="late by at most"):
        io.load(path, size, in_memory, repair="sort").events[:]
    recording = io.load(path, size, in_memory, repair="drop,sort")
    (note,) = recording.notes
    assert "1 outlier dropped, 1 late event sorted" in note
    kept = np.delete(np.arange(len(t)), 100)
    order = kept[np.argsort(wrong[kept], kind="stable")]
    got = recording.events[:]
    np.testing.assert_array_equal(got.t, wrong[order])
    for values, want in zip((got.x, got.y, got.p), (x, y, p), strict=True):
        np.testing.assert_array_equal(values, want[order])


def test_convert_repairs(tmp_path):
    t, x, y, p = columns_of(clean_times(500))
    path = stored(tmp_path / "a.h5", np.concatenate([t[:300], t[300:] - 60_000_000]), x, y, p)
    command = [sys.executable, "-m", "jaxevent", "convert", str(path), str(tmp_path / "b.h5")]
    command += ["--size", f"{WIDTH},{HEIGHT}"]
    refused = subprocess.run(command, capture_output=True, text=True)
    assert refused.returncode == 2
    assert "the clock is set back once, at event 300" in refused.stderr
    assert "parts of 300, 200 events; mend this with repair='part'" in refused.stderr
    done = subprocess.run([*command, "--repair", "part"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "200 events of other parts dropped (events 0 to 299 stay)" in done.stdout
    np.testing.assert_array_equal(io.load(tmp_path / "b.h5").events[:].t, t[:300])


def test_recordings_in_order_are_unchanged_by_repairs(tmp_path):
    events = Events(*columns_of(clean_times(300)))
    io.save(Recording("a", WIDTH, HEIGHT, events), tmp_path / "a.h5")
    for in_memory in (True, False):
        got = io.load(tmp_path / "a.h5", in_memory=in_memory, repair="sort,drop,unwrap,part")
        for name in "txyp":
            np.testing.assert_array_equal(getattr(got.events[:], name), getattr(events, name))
