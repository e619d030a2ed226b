"""The command `jaxevent register`: files of frames, calibrations and what is refused."""

import dataclasses

import numpy as np
from commands import described, fails
from PIL import Image
from rigs import small

import jaxevent
from jaxevent import cli


def test_an_hdr_reference_from_a_folder(tmp_path, capsys):
    recording, _ = small()
    jaxevent.save(recording, tmp_path / "own.h5")
    folder = tmp_path / "hdr"
    folder.mkdir()
    for k in range(3):
        np.save(folder / f"{k}.npy", np.full((12, 16), 10.0 * (k + 1), np.float32))
    (folder / "timestamps.txt").write_text("1.00\n1.04\n1.08\n")
    (tmp_path / "H.csv").write_text("2,0,-4\n0,2,0.5\n0,0,1\n")
    out = tmp_path / "truth.h5"
    command = ["register", tmp_path / "own.h5", "--reference", folder, "--homography"]
    command += [tmp_path / "H.csv", "--offset", -1, "--white", 2.0, "--out", out]
    assert cli.main([str(word) for word in command]) == 0
    assert "offset added to the other camera's time stamps, given: -1.0" in capsys.readouterr().out
    both = jaxevent.load(out)
    names = {str(tmp_path / "own.h5"), str(folder), str(tmp_path / "H.csv")}
    assert described(out, "extra/kept")["inputs"].keys() == names
    np.testing.assert_array_equal(both.extra["hdr_t"], [0, 40_000, 80_000])
    assert np.isnan(both.extra["hdr"][:, :, :2]).all()
    seen = both.extra["hdr"][:, :5, 2:]
    np.testing.assert_allclose(seen, np.array([5.0, 10, 15])[:, None, None] + 0 * seen)
    assert len(both.frames) == 2  # its own


def test_a_folder_of_images_and_a_calibration(tmp_path):
    recording, _ = small()
    jaxevent.save(recording, tmp_path / "own.h5")
    folder = tmp_path / "camera"
    folder.mkdir()
    for k in range(4):
        Image.fromarray(np.full((6, 8), 51 * k, np.uint8)).save(folder / f"{k}.png")
    (folder / "timestamps.txt").write_text("0\n30000\n60000\n90000\n")
    (tmp_path / "rig.toml").write_text(
        "[frames]\ncamera = [9, 9, 4, 3]\n"
        "transform = [[1, 0, 0, 0.5], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]\n"
    )
    np.save(tmp_path / "depth.npy", np.full((6, 8), 4.5))
    command = ["register", tmp_path / "own.h5", "--frames", folder, "--calibration"]
    command += [tmp_path / "rig.toml", "--offset", 0, "--exposure", 0.002]
    stored = []
    for k, far in enumerate(
        (["--depth", 4.5], ["--depth", tmp_path / "depth.npy"], ["--plane", "0,0,2,9"])
    ):
        out = tmp_path / f"{k}.h5"
        assert cli.main([str(word) for word in [*command, *far, "--out", out]]) == 0
        described(out, "extra/kept")
        stored.append(jaxevent.load(out))
        # 0.5 m at 4.5 m and 9 px: a pixel to the right, so that the last column is not seen.
        assert stored[k].extra["covered"].sum(0).tolist() == [6] * 7 + [0]
    images = np.asarray(stored[0].frames.images)
    np.testing.assert_allclose(images[:, 2, 3], [0, 0.2, 0.4, 0.6], atol=1e-6)
    assert (stored[0].frames.exposure == 2_000).all()
    np.testing.assert_array_equal(images, np.asarray(stored[2].frames.images))


def test_bad_input_is_said_in_a_line(tmp_path, capsys):
    recording, other = small()
    own, frames, out = tmp_path / "own.h5", tmp_path / "frames.h5", tmp_path / "out.h5"
    jaxevent.save(recording, own)
    jaxevent.save(other, frames)
    jaxevent.save(dataclasses.replace(recording, frames=None, extra={}), tmp_path / "none.h5")
    texts = {
        "two.csv": "1 2\n3 4\n",
        "flat.csv": "1,2,3\n2,4,6\n0,0,1\n",
        "words.csv": "a,b,c\n",
        "alone.toml": "[events]\ncamera = [9, 9, 4, 3]\n",
        "more.toml": "[frames]\ncamera = [9, 9, 4, 3]\nlens = 1\n",
        "short.toml": "[frames]\ncamera = [9, 9]\n",
        "mirror.toml": "[frames]\ncamera = [9, 9, 4, 3]\n"
        "transform = [[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]\n",
        "good.toml": "[frames]\ncamera = [9, 9, 4, 3]\n",
    }
    for name, text in texts.items():
        (tmp_path / name).write_text(text)
    np.save(tmp_path / "depth.npy", np.ones((3, 3)))

    def bad(*words, named=()):
        fails(capsys, ["register", own, *words, "--out", out], *named)
        assert not out.exists()

    for name in ("two", "flat", "words"):
        bad("--frames", frames, "--homography", tmp_path / f"{name}.csv", named=(f"{name}.csv",))
    for name in ("alone", "more", "short", "mirror"):
        bad("--frames", frames, "--calibration", tmp_path / f"{name}.toml", named=(f"{name}.toml",))
    good = ("--frames", frames, "--calibration", tmp_path / "good.toml")
    bad(*good, "--depth", tmp_path / "depth.npy", "--offset", -5, named=("depth.npy", "(3, 3)"))
    bad(*good, "--depth", "-2", "--offset", -5, named=("above 0",))
    bad(*good, "--plane", "0,0,0,1", "--offset", -5, named=("plane",))
    bad(*good, "--depth", "2", "--plane", "0,0,1,1", named=("--plane",))
    bad(*good, "--homography", tmp_path / "flat.csv", named=("--homography",))
    bad("--frames", frames, "--depth", "2", named=("--calibration",))
    bad(*good, "--offset", 1, "--search", 1, named=("--search",))
    bad(*good, "--offset", "nan", named=("offset",))
    bad(*good, "--search", "-1", named=("search",))
    bad(*good, "--offset", "77", named=("frames.h5", "77"))
    bad(*good, "--exposure", 0.01, named=("frames.h5", "exposure"))
    bad("--frames", tmp_path / "none.h5", named=("none.h5", "no frames"))
    bad("--frames", tmp_path / "missing", named=("missing",))
    bad("--reference", frames, "--crop", named=("--crop",))
