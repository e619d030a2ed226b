"""`jaxevent camera`: stacks of a simulated camera, whose response and scene are known."""

from pathlib import Path

import numpy as np
import pytest
from commands import fails
from noise import small
from numpy.typing import NDArray
from PIL import Image

import jaxevent
from jaxevent import cli
from jaxevent.camera import TableResponse, estimate_response, merge_exposures
from jaxevent.io.images import read_intensity, read_response

SECONDS = 0.002 * 2.0 ** np.arange(7)
CAMERA = TableResponse(np.linspace(0, 1, 1001) ** 2.2)


@pytest.fixture
def stack(tmp_path: Path) -> tuple[Path, NDArray, NDArray]:
    """A folder of images, the images, and the intensity at 8 ms."""
    rng = np.random.default_rng(1)
    scene = np.exp(rng.uniform(-5.0, 1.5, (60, 80)))
    grey = np.stack([np.asarray(CAMERA.grey(scene * s / SECONDS[2])) for s in SECONDS])
    images = np.rint(255 * grey).clip(0, 255).astype(np.uint8)
    folder = tmp_path / "stack"
    folder.mkdir()
    for k, image in enumerate(images):
        Image.fromarray(image).save(folder / f"{k}.png")
    return folder, images, scene


def run(*words: object) -> int:
    return cli.main(["camera", *(str(word) for word in words)])


@pytest.mark.slow
def test_response_merge_and_attach(stack, tmp_path, capsys):
    folder, images, scene = stack
    assert run("response", folder, "--exposures", *SECONDS, "--out", tmp_path / "r.csv") == 0
    assert "response of 7 images" in capsys.readouterr().out
    found = read_response(tmp_path / "r.csv")
    expected = estimate_response(images, SECONDS)
    np.testing.assert_allclose(found.levels, expected.levels, rtol=1e-8, atol=1e-12)
    np.testing.assert_allclose(found.weights, expected.weights, rtol=1e-8)

    # The file of exposures names images in any order.
    lines = [f"{s} {k}.png\n" for k, s in enumerate(SECONDS)]
    (folder / "exposures.txt").write_text("# s name\n" + "".join(lines[::-1]))
    for name in ("scene.npy", "scene.tif"):
        command = ["merge", folder, "--response", tmp_path / "r.csv", "--white", 0.008]
        assert run(*command, "--out", tmp_path / name) == 0
    merged = read_intensity(tmp_path / "scene.npy")
    np.testing.assert_array_equal(merged, read_intensity(tmp_path / "scene.tif"))
    known, variance = merge_exposures(images, SECONDS, found, reference=0.008)
    np.testing.assert_allclose(merged, known, rtol=1e-6)
    good = variance < np.median(variance)
    scale = np.median(merged[good] / scene[good])  # the response's unit is its own
    np.testing.assert_allclose(merged[good] / scale, scene[good], rtol=0.08)
    assert (
        run("merge", folder, "--out", tmp_path / "own.npy") == 0
    )  # its own response, the first line
    np.testing.assert_allclose(
        read_intensity(tmp_path / "own.npy"), merged * SECONDS[-1] / 0.008, rtol=1e-5
    )

    jaxevent.save(small(), tmp_path / "small.h5")
    assert (
        run(
            "attach",
            tmp_path / "small.h5",
            "--response",
            tmp_path / "r.csv",
            "--out",
            tmp_path / "a.h5",
        )
        == 0
    )
    attached = jaxevent.load(tmp_path / "a.h5")
    np.testing.assert_array_equal(attached.response.levels, found.levels)
    np.testing.assert_allclose(attached.response.weights, found.weights, rtol=1e-12)
    np.testing.assert_array_equal(attached.events.t, small().events.t)


def test_exposures_of_photographs(stack, tmp_path):
    folder, images, _ = stack
    for k, (image, seconds) in enumerate(zip(images, SECONDS, strict=True)):
        exif = Image.Exif()
        exif[0x8769] = {0x829A: float(seconds)}
        Image.fromarray(image).save(folder / f"{k}.png", exif=exif)
    assert run("response", folder, "--out", tmp_path / "r.csv") == 0
    expected = estimate_response(images, SECONDS)
    np.testing.assert_allclose(
        read_response(tmp_path / "r.csv").levels, expected.levels, rtol=1e-6, atol=1e-9
    )


def test_bad_input_is_said_in_a_line(stack, tmp_path, capsys):
    folder, images, _ = stack
    out = tmp_path / "out.csv"

    def bad(*words, named=()):
        fails(capsys, ["camera", *words], *named)
        assert not out.exists()

    bad("response", folder, "--out", out, named=("0.png", "--exposures"))
    bad("response", folder, "--exposures", 1, 2, "--out", out, named=(folder, "7 images", "2"))
    bad("response", folder, "--exposures", 1, 1, 1, 1, 1, 1, -1, "--out", out, named=("positive",))
    bad("response", folder, "--exposures", *[1] * 7, "--out", out, named=("one exposure time",))
    bad("response", tmp_path / "none", "--out", out, named=("none", "not a folder"))
    (folder / "exposures.txt").write_text("0.1 0.png\n0.2 9.png\n")
    bad("response", folder, "--out", out, named=("exposures.txt", "line 2"))
    (folder / "exposures.txt").write_text("fast 0.png\n")
    bad("merge", folder, "--out", tmp_path / "out.npy", named=("exposures.txt", "line 1"))
    (folder / "exposures.txt").unlink()
    stacked = ["merge", folder, "--exposures", *range(1, 8)]
    bad(*stacked, "--out", tmp_path / "out.jpg", named=("out.jpg", ".npy"))
    Image.fromarray(images[0][:9]).save(folder / "7.png")
    bad("response", folder, "--out", out, named=("7.png", "one size"))

    jaxevent.save(small(frames=None), tmp_path / "bare.h5")
    tables = {
        "empty": "",
        "names": "level,intensity,certainty\n0,0,1\n",
        "words": "grey,intensity,certainty\n0,a,1\n",
        "uneven": "grey,intensity,certainty\n0,0,1\n0.2,0.5,1\n1,1,1\n",
        "falls": "grey,intensity,certainty\n0,0,1\n0.5,0.7,1\n1,0.6,1\n",
    }
    for name, text in tables.items():
        (tmp_path / f"{name}.csv").write_text(text)
        table = ["--response", tmp_path / f"{name}.csv", "--out", tmp_path / "out.h5"]
        bad("attach", tmp_path / "bare.h5", *table, named=(f"{name}.csv",))
    (tmp_path / "good.csv").write_text("grey,intensity,certainty\n0,0,1\n0.5,0.5,1\n1,1,1\n")
    table = ["--response", tmp_path / "good.csv", "--out", tmp_path / "out.h5"]
    bad("attach", tmp_path / "bare.h5", *table, named=("bare.h5", "no frames"))
    image = ["--image", folder / "0.png", "--out", tmp_path / "out.h5"]
    bad("reference", tmp_path / "bare.h5", *image, named=("0.png", "floats"))
    assert not list(tmp_path.glob("out.*"))
