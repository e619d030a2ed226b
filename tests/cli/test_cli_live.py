"""`jaxevent motion --live`: rows as events come, from a recording or a pipe."""

import io
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from commands import fails
from points import HEIGHT, WIDTH, moved

import jaxevent
from jaxevent import cli
from jaxevent.egomotion import voting
from jaxevent.egomotion.particle_filter.estimator import VotingEstimator
from jaxevent.errors import InputError
from jaxevent.events.live import read_lines

SETTINGS = "particles = 60\ncandidates = 24\nbatch = 32\ntau_max = 0.06\n"


class Pipe(io.BytesIO):
    """Bytes that come a few at a time."""

    def read1(self, size=-1):
        return super().read1(min(size, 777))


@pytest.mark.slow
def test_live_rows_are_those_of_the_causal_estimate(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(VotingEstimator, "_kernel", lambda *_: None)
    recording = moved(lambda at: np.array([180.0, -90.0]), 0.3, 80, seed=3)
    path, params = tmp_path / "moved.h5", tmp_path / "mine.toml"
    jaxevent.save(recording, path)
    params.write_text(SETTINGS)
    words = ["--live", "--model", "planar", "--params", str(params), "--seed", "2"]
    assert cli.main(["motion", str(path), *words]) == 0
    printed = capsys.readouterr().out
    table = np.genfromtxt(io.StringIO(printed), delimiter=",", names=True)
    own = voting.Params.load(params, "voting")
    whole = voting.estimate(recording, own, model="planar", seed=2, causal=True)
    times = np.rint(1e6 * table["t"]).astype(np.int64)
    assert times[0] == recording.start and (np.diff(times) == 1000).all()
    assert whole.t[-1] - times[-1] < 1000
    mean, covariance, valid = whole(times)
    assert valid.mean() > 0.2 and ((table["lost"] == 0) == valid).all()
    np.testing.assert_array_equal(np.stack([table["vx"], table["vy"]], 1), mean)
    sigma = np.sqrt(covariance[:, 0, 0])[valid]
    np.testing.assert_allclose(table["sigma_vx"][valid], sigma, rtol=1e-6)
    e = recording.events[:]
    lines = "".join(
        f"{t} {x} {y} {int(p)}\n" for t, x, y, p in zip(e.t, e.x, e.y, e.p, strict=True)
    )
    pipe = SimpleNamespace(buffer=Pipe(lines.encode()), isatty=lambda: False)
    monkeypatch.setattr(sys, "stdin", pipe)
    size = ["--size", f"{WIDTH},{HEIGHT}"]
    assert cli.main(["motion", "-", *words, *size]) == 0
    assert capsys.readouterr().out == printed
    fails(capsys, ["motion", "-", *words], "--size")
    fails(capsys, ["motion", path, "--live"], "--model")
    fails(capsys, ["motion", path, *words, "--flow"], "--live", "--flow")
    fails(capsys, ["motion", path, "--model", "planar"], "--out")


def test_lines_tell_their_unit_and_are_checked():
    seconds = list(read_lines(Pipe(b"0.5 3 4 1\n0.500002 5 6 -1")))
    assert np.concatenate([e.t for e in seconds]).tolist() == [500_000, 500_002]
    assert np.concatenate([e.p for e in seconds]).tolist() == [True, False]
    (scientific,) = read_lines(Pipe(b"5e-1 3 4 1\n\n6e-1 5 6 -1\n"))
    assert scientific.t.tolist() == [500_000, 600_000]
    assert not list(read_lines(Pipe(b"\n")))
    wrong = (
        b"1 2 3\n", b"1 2 3 four\n", b"1 -2 3 1\n", b"1 70000 3 1\n", b"1 2.5 3 1\n",
        b"1 2 3\n4 5 6 1 0\n", b"1e30 2 3 1\n",
    )  # fmt: skip
    for text in wrong:
        with pytest.raises(InputError, match="line 1"):
            list(read_lines(io.BytesIO(text)))
