"""`jaxevent flow`: its files, and what it refuses."""

import dataclasses
import struct
import zlib
from pathlib import Path

import h5py
import numpy as np
import pytest
from commands import decoded, described, fails

import jaxevent
from jaxevent import cli
from jaxevent.event_flow import FlowParams, flow_from_events
from jaxevent.io import png
from jaxevent.recording import Events
from jaxevent.show.flow import decode_flow, encode_flow, flow_colours, write_flow_hdf5
from jaxevent.simulate import motion_scene


@pytest.fixture(scope="module")
def stored(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("flow") / "planar.h5"
    recording, _ = motion_scene("planar", size=(64, 48), focal=50.0, duration=0.12)
    jaxevent.save(recording, path)
    return path


def decode_png(data: bytes) -> np.ndarray:
    """Samples of a PNG image of 16 bits in three colours, whose rows have the filter 2."""
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    place, parts = 8, {}
    while place < len(data):
        (size,) = struct.unpack(">I", data[place : place + 4])
        kind, body = data[place + 4 : place + 8], data[place + 8 : place + 8 + size]
        assert struct.unpack(">I", data[place + 8 + size : place + 12 + size])[0] == zlib.crc32(
            kind + body
        )
        parts[kind] = body
        place += 12 + size
    width, height, *rest = struct.unpack(">IIBBBBB", parts[b"IHDR"])
    assert rest == [16, 2, 0, 0, 0]
    rows = np.frombuffer(zlib.decompress(parts[b"IDAT"]), np.uint8).reshape(height, -1)
    assert (rows[:, 0] == 2).all()
    plain = np.cumsum(rows[:, 1:], 0, dtype=np.uint8)
    return plain.view(">u2").reshape(height, width, 3).astype(int)


PNG = encode_flow(np.zeros((2, 2, 2)), np.ones((2, 2), bool))


def paeth(a: int, b: int, c: int) -> int:
    return min((a, b, c), key=lambda one: abs(a + b - c - one))


@pytest.mark.parametrize("channels", [1, 3])
def test_png_of_any_filter_is_decoded(channels):
    image = np.random.default_rng(0).integers(0, 2**16, (10, 6, channels)).astype(np.uint16)
    raw = image.astype(">u2").view(np.uint8).reshape(10, -1).astype(int)
    rows, step = [], 2 * channels
    for y in range(10):
        above = raw[y - 1] if y else np.zeros_like(raw[0])
        left = np.append(np.zeros(step, int), raw[y])[: raw.shape[1]]
        corner = np.append(np.zeros(step, int), above)[: raw.shape[1]]
        guess = [
            np.zeros_like(left), left, above, (left + above) // 2,
            np.array([paeth(*one) for one in zip(left, above, corner, strict=True)]),
        ][y % 5]  # fmt: skip
        rows.append(bytes([y % 5]) + ((raw[y] - guess) % 256).astype(np.uint8).tobytes())

    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + bytes(4)

    packed = zlib.compress(b"".join(rows))
    head = b"\x89PNG\r\n\x1a\n" + chunk(
        b"IHDR", struct.pack(">IIBBBBB", 6, 10, 16, {1: 0, 3: 2}[channels], 0, 0, 0)
    )
    parts = [chunk(b"IDAT", packed[:50]), chunk(b"IDAT", packed[50:]), chunk(b"IEND", b"")]
    found = png.decode(head + b"".join(parts), "a")
    assert np.array_equal(found, image if channels == 3 else image[..., 0])
    with pytest.raises(jaxevent.InputError, match="^a: its image .* fetch it again"):
        png.decode(head + parts[0], "a")


@pytest.mark.parametrize("data", [b"", b"GIF", PNG[:20], b"x" + PNG[1:]])
def test_what_is_no_image_of_flow_is_refused(data, tmp_path):
    with pytest.raises(jaxevent.InputError, match="no PNG image of 16 bits"):
        decode_flow(data)
    with pytest.raises(jaxevent.InputError, match="none.png: cannot be read"):
        decode_flow(tmp_path / "none.png")


def test_png_has_displacements_as_dsec_does(tmp_path):
    rng = np.random.default_rng(0)
    d = rng.normal(size=(7, 9, 2)) * 40
    d[0, 0] = 300
    valid = rng.random((7, 9)) < 0.7
    valid[0, 0] = True
    code = decode_png(encode_flow(d, valid))
    known = valid.copy()
    known[0, 0] = False
    assert np.array_equal(code[..., 2], known)
    assert np.abs((code[..., :2] - 2**15) / 128 - d)[known].max() <= 1 / 256
    (tmp_path / "mine.png").write_bytes(encode_flow(d, valid))
    for given in (encode_flow(d, valid), tmp_path / "mine.png", str(tmp_path / "mine.png")):
        read, read_valid = decode_flow(given)
        assert np.array_equal(read_valid, known) and np.isnan(read[~known]).all()
        assert np.abs(read - d)[known].max() <= 1 / 256
    cv2 = pytest.importorskip("cv2")
    (tmp_path / "one.png").write_bytes(encode_flow(d, valid))
    assert np.array_equal(cv2.imread(str(tmp_path / "one.png"), -1)[..., ::-1], code)


def test_files_hold_the_flow(stored, tmp_path, capsys):
    out = tmp_path / "flow.h5"
    argv = ["flow", str(stored), "--rate", "50", "--start", "0.02", "--stop", "0.1"]
    assert cli.main([*argv, "--out", str(out)]) == 0
    assert "4 times" in capsys.readouterr().out
    flow = flow_from_events(jaxevent.load(stored))
    with h5py.File(out) as file:
        times = file["t"][:]
        found = [file[name][:] for name in ("flow", "covariance", "valid")]
    for a, b in zip(found, flow(times), strict=True):
        assert np.array_equal(a, b)
    told = described(out)
    assert FlowParams(**told["params"]).values() == FlowParams().values()
    folder = tmp_path / "images"
    assert cli.main([*argv, "--out", str(folder)]) == 0
    listed = np.loadtxt(folder / "forward_timestamps.txt", delimiter=",", dtype=np.int64)
    assert np.array_equal(listed, np.stack([times[:-1], times[1:]], 1))
    code = decode_png((folder / "000000.png").read_bytes())
    d = (code[..., :2] - 2**15) / 128
    known = code[..., 2] == 1
    assert np.array_equal(known, found[2][0])
    expected = found[0][0][known] * (times[1] - times[0]) * 1e-6
    assert np.median(np.linalg.norm(d[known] - expected, axis=-1)) < 0.2


def test_times_of_python_are_us_or_s(tmp_path):
    events = jaxevent.Events(np.arange(4) * 20_000, *np.zeros((2, 4), np.uint16), np.ones(4, bool))
    flow = flow_from_events(jaxevent.Recording("few", 16, 12, events))
    for times in ([0.03, 0.05], np.array([30_000, 50_000], np.int32)):
        write_flow_hdf5(flow, times, tmp_path / "a.h5")
        with h5py.File(tmp_path / "a.h5") as file:
            assert file["t"][:].tolist() == [30_000, 50_000]
        (tmp_path / "a.h5").unlink()


def test_video_has_the_colours_of_directions(stored, tmp_path):
    out = tmp_path / "flow.mp4"
    assert cli.main(["flow", str(stored), "--rate", "40", "--out", str(out)]) == 0
    frames, _ = decoded(out, 48, 64, "rgb24")
    assert len(frames) == 5
    turn = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    colours = flow_colours(np.stack([np.cos(turn), np.sin(turn)], -1) * 3, 3.0)
    assert len(np.unique(colours, axis=0)) == 12 and tuple(colours[0]) == (255, 0, 0)
    assert (flow_colours(np.zeros((2, 2)), 3.0) == 255).all()


def test_what_cannot_be_is_refused(stored, tmp_path, capsys):
    fails(capsys, ["flow", stored, "--out", tmp_path / "flow.avi"], "flow.avi")
    fails(capsys, ["flow", stored, "--rate", "0", "--out", tmp_path / "a.h5"], "--rate")
    fails(capsys, ["flow", stored, "--start", "9", "--out", tmp_path / "a.h5"], "--start")
    one = tmp_path / "times.csv"
    one.write_text("0.05\n")
    fails(capsys, ["flow", stored, "--times", one, "--out", tmp_path / "b"], "two or more")
    (tmp_path / "mine.toml").write_text("speed = 3\n")
    wrong = ["flow", stored, "--params", tmp_path / "mine.toml", "--out", tmp_path / "c.h5"]
    fails(capsys, wrong, "speed")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mine.toml", "times.csv"]


@pytest.mark.parametrize("name", ["flow", "motion", "track"])
def test_events_at_one_time_are_refused(name, tmp_path, capsys):
    path, n = tmp_path / "once.npz", 300
    x, y = np.arange(n) % 20, np.arange(n) // 20
    np.savez(path, t=np.full(n, 1000), x=x, y=y, p=x % 2, width=20, height=15)
    out = ("--time-unit", "us", "--out", tmp_path / "out")
    fails(capsys, [name, path, *out], path, "all 300 events are at one time, 1000 us")


def test_times_are_those_of_the_events(stored, tmp_path, capsys):
    """Frames of another clock do not stretch the span, and a damaged time is no endless one."""
    recording = jaxevent.load(stored)
    frames = recording.frames
    late = dataclasses.replace(frames, t=frames.t + 10**15)
    jaxevent.save(dataclasses.replace(recording, frames=late), tmp_path / "late.h5")
    argv = f"flow {tmp_path}/late.h5 --rate 20 --out {tmp_path}/flow.h5"
    assert cli.main(argv.split()) == 0
    first, last = recording.event_span()
    with h5py.File(tmp_path / "flow.h5") as file:
        assert file["t"][0] == first and last - 50_000 < file["t"][-1] <= last
    jaxevent.save(dataclasses.replace(recording, events=Events.empty()), tmp_path / "none.h5")
    capsys.readouterr()
    fails(capsys, f"flow {tmp_path}/none.h5 --out {tmp_path}/n".split(), "none.h5: holds no events")
    t = recording.events.t.copy()
    t[-1] += 10**15
    broken = dataclasses.replace(recording.events[:], t=t)
    jaxevent.save(dataclasses.replace(recording, events=broken), tmp_path / "broken.h5")
    argv = f"flow {tmp_path}/broken.h5 --out {tmp_path}/broken"
    fails(capsys, argv.split(), "broken.h5", "to 1000000000", "--stop", "--rate")
