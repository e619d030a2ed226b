"""`jaxevent track --live`: rows as events come, from a recording or a pipe."""

import io
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from commands import fails
from test_cli_track import HEIGHT, METHOD, WIDTH, two

import jaxevent
from jaxevent import cli
from jaxevent.blob import constant_velocity
from jaxevent.blob.engine.runner import KernelRunner
from jaxevent.blob.live import CHUNKS_PER_RUN, STEPS_PER_CHUNK
from jaxevent.blob.prepare import ChunkPacker
from jaxevent.blob.tracks import Tracks, evenly_spaced_times

SETTINGS = "Q_v = 1e4\nP0_v = 1e4\nn_birth = 8.0\nn_confirm = 20.0\nlambda0 = 5.0\n"


class Pipe(io.BytesIO):
    """Bytes that come a few at a time."""

    def read1(self, size=-1):
        return super().read1(min(size, 999))


@pytest.mark.slow
def test_live_rows_are_those_of_the_causal_tracks(tmp_path, capsys, monkeypatch):
    recording = two()[:0.03]
    path, params = tmp_path / "two.h5", tmp_path / "mine.toml"
    jaxevent.save(recording, path)
    params.write_text(SETTINGS)
    words = [*METHOD, "--live", "--params", str(params), "--rate", "1900", "--seed", "30,30,6"]
    words += ["--detect"]
    assert cli.main(["track", str(path), *words]) == 0
    printed = capsys.readouterr().out
    table = np.genfromtxt(io.StringIO(printed), delimiter=",", names=True)
    own = constant_velocity.Params.load(params, "constant_velocity")
    packer = ChunkPacker(
        recording, own, [(30, 30, 6)], detect=True, steps=STEPS_PER_CHUNK, chunks=CHUNKS_PER_RUN
    )
    whole = Tracks(KernelRunner(constant_velocity.filter, own, detect=packer.detect), packer)
    times = evenly_spaced_times(whole.start, whole.stop, 1900.0)
    states = whole(times)
    shown = states.valid & (whole.confirmed <= times[:, None])
    assert len(whole) == 2 and shown[:, 0].all() and 0 < shown[:, 1].sum() < len(times)
    row, place = np.nonzero(shown)
    assert np.rint(1e6 * table["t"]).astype(np.int64).tolist() == times[row].tolist()
    assert table["id"].tolist() == whole.id[place].tolist()
    mean, P = states.mean[row, place], states.covariance[row, place]
    for k, name in enumerate(("x", "y", "vx", "vy")):
        np.testing.assert_allclose(table[name], mean[:, k], rtol=1e-7, atol=1e-7)
        sigma = np.sqrt(P[:, k, k])
        np.testing.assert_allclose(table[f"sigma_{name}"], sigma, rtol=1e-7, atol=1e-7)
    e = recording.events[:]
    lines = "".join(
        f"{t} {x} {y} {int(p)}\n" for t, x, y, p in zip(e.t, e.x, e.y, e.p, strict=True)
    )
    pipe = SimpleNamespace(buffer=Pipe(lines.encode()), isatty=lambda: False)
    monkeypatch.setattr(sys, "stdin", pipe)
    assert cli.main(["track", "-", *words, "--size", f"{WIDTH},{HEIGHT}"]) == 0
    assert capsys.readouterr().out == printed


def test_bad_ways_to_track_live(tmp_path, capsys):
    path = tmp_path / "two.h5"
    jaxevent.save(two(), path)
    fails(capsys, ["track", path, "--live"], "--seed or --detect")
    fails(capsys, ["track", path, "--detect"], "--out")
    fails(capsys, ["track", path, "--live", "--detect", "--stop", 1], "--live", "--stop")
    fails(capsys, ["track", path, "--live", "--detect", "--rate=0"], "--rate")
    fails(capsys, ["track", "-", "--live", "--detect"], "--size")
