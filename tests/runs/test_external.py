"""Images of other programs: how they are found, read, matched in time and in brightness."""

import json
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from noise import HEIGHT, ONE, STAMPS, WIDTH, grey, hdr_recording, small, write_config
from numpy.typing import NDArray
from PIL import Image

import jaxevent
from jaxevent import cli
from jaxevent.methods import METHODS
from jaxevent.runs.evaluate import evaluate
from jaxevent.runs.external import ExternalImages, fit_brightness
from jaxevent.runs.scores import score, subset

HIDDEN = STAMPS[1::2]
EXTERNAL = """
recordings = ["small.h5"]
[[method]]
name = "external"
images = "e2vid/{recording}"
"""


def external(folder: Path, **settings) -> ExternalImages:
    return ExternalImages.of({"images": "e2vid/{recording}", **settings}, folder)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A recording, and an empty folder for images of it."""
    jaxevent.save(small(), tmp_path / "small.h5")
    (tmp_path / "e2vid" / "small").mkdir(parents=True)
    return tmp_path


def write_times(folder: Path, t: NDArray, name: str = "timestamps.txt", form: str = "s") -> None:
    lines = [f"{one / 1e6:.18f}\n" if form == "s" else f"{one}\n" for one in t]
    (folder / "e2vid" / "small" / name).write_text("".join(lines))


def write_images(folder: Path, images: NDArray, suffix: str = ".png") -> None:
    for row, image in enumerate(images):
        path = folder / "e2vid" / "small" / f"frame_{row:010d}{suffix}"
        if suffix == ".npy":
            np.save(path, image)
        else:
            Image.fromarray(image).save(path)


def bytes_of(images: NDArray) -> NDArray[np.uint8]:
    return np.rint(255 * images).astype(np.uint8)


def stored(kind: str) -> tuple[NDArray, dict]:
    """The frames, as a program may store them, and the settings that say so."""
    images = grey()
    return {
        "png": (bytes_of(images), {}),
        "rgb": (np.repeat(bytes_of(images)[..., None], 3, axis=3), {}),
        "rgba": (np.repeat(bytes_of(images)[..., None], 4, axis=3), {}),
        "16 bits": ((65535 * images).astype(np.uint16), {}),
        "12 bits": (np.rint(4095 * images).astype(np.uint16), {"white": 4095}),
        "gamma": (np.rint(65535 * images ** (1 / 2.2)).astype(np.uint16), {"gamma": 2.2}),
        "tiff": (images.astype(np.float32), {}),
        "255": ((255 * images).astype(np.float32), {"white": 255}),
        "npy": (images, {}),
        "int32": (np.rint(1e6 * images).astype(np.int32), {"white": 1e6}),
    }[kind]


@pytest.mark.parametrize(
    "kind",
    ["png", "rgb", "rgba", "16 bits", "12 bits", "gamma", "tiff", "255", "npy", "int32"],
)
def test_the_truth_itself_has_no_error(kind, folder):
    images, settings = stored(kind)
    floats = images.dtype.kind == "f"
    suffix = ".npy" if kind in ("npy", "int32") else ".tif" if floats else ".png"
    write_images(folder, images, suffix)
    write_times(folder, STAMPS)
    row = score(small(), external(folder, **settings))
    assert row["mse"] < 1e-7 and row["ssim"] > 0.9999
    assert (row["frames"], row["missing"], row["seconds"]) == (3, 0, None)
    assert row["per_frame"]["t"] == HIDDEN.tolist()
    assert row["params"]["images"] == "e2vid/{recording}"
    json.dumps(row, allow_nan=False)


def test_one_file_of_all_images(folder):
    np.save(folder / "e2vid" / "small.npy", grey())
    (folder / "e2vid" / "small.txt").write_text("\n".join(map(str, STAMPS)))
    row = score(small(), external(folder, images="e2vid/*.npy", timestamps="*.txt"))
    assert row["mse"] < 1e-9
    (folder / "small.txt").write_text("# t\n" + "\n".join(f"{t / 1e6}" for t in STAMPS))
    (folder / "e2vid" / "small.txt").unlink()
    assert row == score(small(), external(folder, images="e2vid/*.npy", timestamps="*.txt")) | {
        "params": row["params"]
    }


@pytest.mark.slow
def test_what_reconstruct_writes_scores_as_the_method_itself(folder, float32):
    """As HDF5, exactly; as PNG images of 8 bits, almost."""
    jaxevent.save(small().with_frames(slice(0, None, 2)), folder / "given.h5")
    row = subset(score(small(), METHODS["blend"]), [0, 1])  # the third is after the last frame
    base = ["reconstruct", str(folder / "given.h5"), "--method", "blend", "--rate", "1000"]
    assert cli.main([*base, "--out", str(folder / "small-images.h5")]) == 0
    assert cli.main([*base, "--out", str(folder / "small"), "--tone", "linear"]) == 0
    config = write_config(
        folder,
        EXTERNAL.replace("e2vid/{recording}", "{recording}-images.h5")
        + '[[method]]\nname = "external"\nlabel = "PNG"\nimages = "*"\n',
    )
    exact, rounded = evaluate(config)
    assert exact["per_frame"]["mse"] == pytest.approx(row["per_frame"]["mse"], rel=1e-6)
    assert exact["ssim"] == pytest.approx(row["ssim"], rel=1e-6)
    assert rounded["mse"] == pytest.approx(row["mse"], rel=1e-2)
    assert [exact["method"], rounded["method"]] == ["external", "PNG"]


@pytest.mark.parametrize("form", ["s", "us"])
def test_the_nearest_image_within_the_tolerance_counts(form, folder):
    """Of images 3 ms early, 1 ms late and 2 ms late, each of another brightness."""
    t = np.array([HIDDEN[0] - 3000, HIDDEN[0] + 1000, HIDDEN[1] + 2000])
    write_images(folder, bytes_of(np.ones((3, HEIGHT, WIDTH)) * [[[0.2]], [[0.4]], [[0.6]]]))
    write_times(folder, t, form=form)
    truth = grey()[1::2]

    def error(row: int, level: float) -> float:
        return float(np.mean((truth[row] - np.rint(255 * level) / 255) ** 2))

    row = score(small(), external(folder))  # 1 ms
    assert row["per_frame"]["mse"] == pytest.approx([error(0, 0.4)])
    assert (row["frames"], row["missing"], row["per_frame"]["t"]) == (1, 2, [HIDDEN[0]])
    row = score(small(), external(folder, tolerance=0.002))
    assert row["per_frame"]["mse"] == pytest.approx([error(0, 0.4), error(1, 0.6)])
    row = score(small(), external(folder, tolerance=1))
    assert row["per_frame"]["mse"] == pytest.approx([error(0, 0.4), error(1, 0.6), error(2, 0.6)])
    row = score(small(), external(folder, clock_offset=-0.003, tolerance=0))
    assert row["per_frame"]["mse"] == pytest.approx([error(0, 0.2)])
    with pytest.raises(
        jaxevent.InputError, match=r"no image of small is within 0 s .*0.001 s away"
    ):
        score(small(), external(folder, tolerance=0))
    (row,) = evaluate(write_config(folder, EXTERNAL), folder / "out")
    assert "| missing |" in (folder / "out" / "results.md").read_text()


def test_images_by_their_names(folder):
    order = [3, 1, 5, 0, 2, 4]
    write_images(folder, bytes_of(grey()[order]))
    lines = [f"{STAMPS[i] / 1e6:.6f} frame_{order.index(i):010d}.png\n" for i in range(6)]
    (folder / "e2vid" / "small" / "images.txt").write_text("".join(lines))
    assert score(small(), external(folder))["mse"] < 1e-9


def test_an_hdr_reference_is_compared_as_it_is(folder):
    write_images(folder, (4 * grey()).astype(np.float32), ".tif")
    write_times(folder, STAMPS)
    row = score(hdr_recording(), external(folder), protocol="reference")
    assert row["mse"] < 1e-9 and row["regions"]["bright"]["mse"] < 1e-9 and "z2" not in row
    assert score(hdr_recording(), external(folder, white=2), protocol="reference")["mse"] > 0.1


@pytest.mark.slow
def test_external_results_are_kept_until_their_files_change(folder):
    write_images(folder, bytes_of(grey()))
    write_times(folder, STAMPS)
    config = write_config(folder, EXTERNAL + 'label = "E2VID"\nnormalise = "affine"\n')
    rows = evaluate(config, folder / "out")
    assert rows[0]["method"] == "E2VID, brightness fitted" and rows[0]["normalise"] == "affine"
    assert evaluate(config, folder / "out") == rows
    tasks = folder / "out" / "tasks"
    assert len(list(tasks.glob("*.json"))) == 1
    write_times(folder, STAMPS + 500)
    evaluate(config, folder / "out")
    write_images(folder, bytes_of(1 - grey()))
    (row,) = evaluate(config, folder / "out")
    assert row["mse"] > rows[0]["mse"] + 0.01
    assert len(list(tasks.glob("*.json"))) == 3


@given(st.floats(0.01, 100), st.floats(-10, 10), st.integers(0, 2**32 - 1))
def test_any_brightness_is_fitted(gain, offset, seed):
    """Whatever the unit and the zero, where 2 % are hot and the truth of 10 % is saturated."""
    rng = np.random.default_rng(seed)
    truth = rng.random((30, 40))
    image = gain * truth + offset
    np.testing.assert_allclose(fit_brightness(image, truth), truth, atol=1e-4)
    hot, saturated = rng.random((2, *truth.shape)) < [[[0.02]], [[0.1]]]
    image[hot] += gain * rng.choice([5, 1e30], hot.sum())
    image[0, 0] = np.nan
    hot[0, 0] = True
    fitted = fit_brightness(image, np.where(saturated, 1, truth))
    assert np.abs(fitted - truth)[~hot].max() < 0.05
    unknown = np.where(rng.random(truth.shape) < 0.5, np.nan, truth)
    np.testing.assert_allclose(fit_brightness(2 * truth, unknown), truth, atol=1e-4)


def test_brightness_is_that_of_the_least_loss():
    """No other a >= 0 and b have a smaller sum of Huber's losses."""
    rng = np.random.default_rng(1)
    truth = rng.random((60, 80)) ** 3
    image = np.log(truth + 0.1) + 0.3 * rng.normal(size=truth.shape)
    fitted = fit_brightness(image, truth)
    a = (fitted[0, 1] - fitted[0, 0]) / (image[0, 1] - image[0, 0])
    b = fitted[0, 0] - a * image[0, 0]
    np.testing.assert_allclose(a * image + b, fitted, atol=1e-12)

    def loss(a: float, b: float) -> float:
        r = np.abs(a * image + b - truth)
        return float(np.where(r < 0.1, r**2, 0.2 * r - 0.01).sum())

    least = loss(a, b)
    for da, db in ((1e-3, 0), (-1e-3, 0), (0, 1e-3), (0, -1e-3), (1e-3, 1e-3)):
        assert loss(a + da, b + db) > least
    upside_down = fit_brightness(-truth, truth)
    assert np.ptp(upside_down) < 1e-6
    assert abs(upside_down.mean() - np.median(truth)) < 0.1
    flat = fit_brightness(np.full_like(truth, 3.0), truth)
    assert np.ptp(flat) == 0 and np.isfinite(flat).all()
    nothing = fit_brightness(np.full_like(truth, np.nan), truth)
    assert np.isnan(nothing).all()


def test_large_images_are_fitted_by_a_part_of_their_pixels():
    y, x = np.mgrid[:512, :512]
    truth = 0.5 + 0.4 * np.sin(x / 7) * np.cos(y / 31)
    truth[:, ::32] = 0  # columns that a regular choice of pixels might take alone
    np.testing.assert_allclose(fit_brightness(7 * truth - 1, truth), truth, atol=1e-4)


def test_brightness_of_every_method_can_be_fitted(folder):
    """Events alone tell no brightness: fitted, the high-pass filter gains."""
    text = ONE.replace("blend", "high-pass")
    rows = evaluate(
        write_config(folder, text + '[[method]]\nname = "high-pass"\nnormalise = "affine"\n')
    )
    assert [row["method"] for row in rows] == ["high-pass", "high-pass, brightness fitted"]
    assert "normalise" not in rows[0] and rows[1]["normalise"] == "affine"
    assert rows[1]["mse"] < np.var(grey()) * 1.05 < rows[0]["mse"]
    hdr = score(hdr_recording(), METHODS["akf"], protocol="reference", normalise="affine")
    assert "z2" not in hdr


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ("", "no images are given"),
        ("images = 3", "images is 3; give a path"),
        ('images = "x"\ntimestamps = ""', "timestamps is ''; give a path"),
        ('images = "x"\ngama = 2', "no setting 'gama'; did you mean 'gamma'"),
        ('images = "x"\ngamma = 0', "gamma is 0; give a positive number"),
        ('images = "x"\nwhite = true', "white is True"),
        ('images = "x"\ntolerance = -1', "tolerance is -1"),
        ('images = "x"\nclock_offset = nan', "clock_offset is nan"),
        ('images = "x"\nparams = {}', "no setting 'params'"),
    ],
)
def test_settings_that_cannot_be(settings, said, tmp_path):
    text = 'recordings = ["small.h5"]\n[[method]]\nname = "external"\n' + settings
    with pytest.raises(jaxevent.InputError, match=f"run.toml: method 1: .*{said}"):
        evaluate(write_config(tmp_path, text))


def change(folder: Path, what: str) -> ExternalImages:
    """Spoil the images in one way."""
    here = folder / "e2vid" / "small"
    settings = {}
    if what == "none":
        settings = {"images": "ecnn/*"}
    elif what == "no times":
        (here / "timestamps.txt").unlink()
    elif what == "other times":
        settings = {"timestamps": "stamps.txt"}
    elif what == "few times":
        write_times(folder, STAMPS[1:])
    elif what == "no images":
        for path in here.glob("*.png"):
            path.unlink()
        write_times(folder, STAMPS[:0])
    elif what == "unsorted":
        write_times(folder, STAMPS[::-1])
    elif what == "words":
        (here / "timestamps.txt").write_text("0.1\nsoon\n")
    elif what == "far":
        (here / "timestamps.txt").write_text("1e300\n" * 6)
    elif what == "index":
        (here / "timestamps.txt").write_text("".join(f"{i} {t}\n" for i, t in enumerate(STAMPS)))
    elif what == "ragged":
        (here / "timestamps.txt").write_text("0.1\n0.2 a.png\n")
    elif what == "names":
        (here / "timestamps.txt").write_text("".join(f"{t} none.png\n" for t in STAMPS))
    elif what == "size":
        write_images(folder, bytes_of(grey()[:, 1:]))
    elif what == "broken":
        for path in here.glob("*.png"):
            path.write_bytes(b"no image")
    elif what == "kind":
        write_images(folder, np.zeros((6, HEIGHT, WIDTH), np.int64), ".npy")
        for path in here.glob("*.png"):
            path.unlink()
    elif what == "channels":
        write_images(folder, np.zeros((6, HEIGHT, WIDTH, 2)), ".npy")
        for path in here.glob("*.png"):
            path.unlink()
    elif what == "pages":
        pages = [Image.fromarray(image) for image in bytes_of(grey())]
        for path in here.glob("*.png"):
            path.unlink()
            pages[0].save(path.with_suffix(".tif"), save_all=True, append_images=pages[1:])
    else:
        settings = {"images": "small-images.h5"}
        with h5py.File(folder / "small-images.h5", "w") as file:
            file["image"] = np.zeros((2, HEIGHT, WIDTH))
            if what == "HDF5 times":
                file["t"] = np.zeros(3, np.int64)
    return external(folder, **settings)


@pytest.mark.parametrize(
    ("what", "said"),
    [
        ("none", "ecnn/small: there are no images of small here; correct images"),
        ("no times", "there is no timestamps.txt or images.txt or timestamp.txt with the"),
        ("other times", "there is no stamps.txt with"),
        ("few times", "holds 6 images, timestamps.txt 5 times"),
        ("no images", "e2vid/small: holds no images"),
        ("unsorted", "image 1 at 41000 us is earlier than the one before"),
        ("words", "timestamps.txt: line 1 of numbers starts with 'soon', not a time"),
        ("far", "line 0 of numbers starts with '1e300', not a time"),
        ("index", "two columns of numbers; keep the times only"),
        ("ragged", "some lines have a name and some have none"),
        ("names", "image 1: cannot be read .*none.png"),
        ("size", r"the image at 9000 us of small has the size 24x19; the sensor has 24x20"),
        ("broken", "image 1: cannot be read"),
        ("kind", "image 1: holds int64; give white"),
        ("channels", "image 1: has 2 channels"),
        ("pages", "holds several images; store each as a file"),
        ("HDF5", "small-images.h5: has no datasets t and image"),
        ("HDF5 times", r"image has the shape \(2, 20, 24\) and t \(3,\)"),
    ],
)
def test_images_that_cannot_be_used(what, said, folder):
    write_images(folder, bytes_of(grey()))
    write_times(folder, STAMPS)
    method = change(folder, what)
    with pytest.raises(jaxevent.InputError, match=said):
        score(small(), method)
