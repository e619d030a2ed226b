"""Published data: tables that fill where the files are, beside the printed numbers."""

import dataclasses
import json
import runpy
import zipfile
from pathlib import Path

import numpy as np
import pytest
import scipy.io
from noise import HEIGHT, ONE, STAMPS, WIDTH, small, write_config
from PIL import Image

import jaxevent
import jaxevent.runs.scores
from jaxevent import cli, metrics
from jaxevent.camera import SCurve
from jaxevent.runs.evaluate import evaluate

ROOT = Path(__file__).parents[2]
SCRIPT = runpy.run_path(str(ROOT / "experiments" / "published.py"))


def as_text(path: Path) -> None:
    """The zip of text of `small`."""
    recording = small()
    with zipfile.ZipFile(path, "w") as archive:
        events = recording.events
        rows = zip(events.t, events.x, events.y, events.p, strict=True)
        archive.writestr(
            "events.txt", "".join(f"{t / 1e6:.6f} {x} {y} {p:d}\n" for t, x, y, p in rows)
        )
        lines = []
        for number, (t, image) in enumerate(
            zip(STAMPS, np.asarray(recording.frames.images), strict=True)
        ):
            name = f"images/frame_{number:08d}.png"
            lines.append(f"{t / 1e6:.6f} {name}\n")
            with archive.open(name, "w") as file:
                Image.fromarray(image).save(file, format="PNG")
        archive.writestr("images.txt", "".join(lines))


def as_mat(path: Path, **more: np.ndarray) -> None:
    events = small().events
    columns = [events.t, events.x + 1.0, events.y + 1.0, events.p]
    scipy.io.savemat(path, {"events": np.stack(columns, 1), "time_image": STAMPS, **more})


@pytest.mark.slow
def test_the_ijrr_table_fills_where_files_are(tmp_path, monkeypatch, capsys, float32):
    monkeypatch.setenv("IJRR", str(tmp_path))
    monkeypatch.setitem(jaxevent.runs.scores.MEASURE_FUNCTIONS, "lpips", metrics.mse)
    monkeypatch.setattr(jaxevent.runs.scores, "lpips_weights", lambda: None)
    as_text(tmp_path / "slider_depth.zip")
    out = tmp_path / "out"
    assert cli.main(["evaluate", str(ROOT / "configs" / "ijrr.toml"), "--out", str(out)]) == 0
    rows = json.loads((out / "results.json").read_text())["rows"]
    table = {(Path(row["recording"]).stem, row["method"]): row for row in rows}
    printed = table["boxes_6dof", "AKF, printed"]
    assert (printed["mse"], printed["ssim"], printed["lpips"]) == (0.0026, 0.80, 0.26)
    assert "no such file" in table["boxes_6dof", "akf"]["error"]
    ours = table["slider_depth", "akf"]
    assert ours["frames"] == 3 and ours["lpips"] == pytest.approx(ours["mse"], rel=1e-5)
    assert {name for name, _ in table} == set(
        table["boxes_6dof", "CF, printed"]["params"]["values"]
    )
    lines = (out / "results.md").read_text().splitlines()
    (line,) = [line for line in lines if "slider_depth" in line and "AKF, printed" in line]
    assert [cell.strip() for cell in line.split("|")][3:5] == ["0.180", "0.860"]
    assert "All images" in (out / "report.html").read_text()


def without_the_smoother(name: str, folder: Path) -> Path:
    """The configuration without its last two methods, which take longest to compile."""
    text = (ROOT / "configs" / name).read_text()
    kept, _, rest = text.partition('[[method]]\nname = "akf"\nlabel')
    assert rest.count("[[method]]") == 1 and 'name = "aks"' in rest
    return write_config(folder, kept)


@pytest.mark.slow
def test_the_authors_files(tmp_path, monkeypatch):
    monkeypatch.setenv("AKF_HDR", str(tmp_path))
    monkeypatch.setenv("AHDR", str(tmp_path))
    images = np.moveaxis(small().frames.images, 0, -1)
    as_mat(tmp_path / "tree3.mat", image=images, HDR_mat=3.0 * images, f_Q=np.hanning(258)[1:-1])
    rows = evaluate(without_the_smoother("hdr_mat.toml", tmp_path), tmp_path / "hdr")
    ours = [row for row in rows if row["method"] == "akf" and "tree3" in row["recording"]]
    assert ours[0]["params"]["kappa"] == 7e7 and ours[0]["masked_mse"] > 0

    colour = np.random.default_rng(2).integers(0, 256, (HEIGHT, WIDTH, 3, len(STAMPS)))
    (tmp_path / "raw").mkdir()
    as_mat(tmp_path / "raw" / "lake_fast.mat", img_color=colour.astype(np.uint8), exposure=1000.0)
    recording = SCRIPT["artificial"](tmp_path / "raw" / "lake_fast.mat", 50)
    level = np.moveaxis(0.299 * colour[..., 0, :] + 0.587 * colour[..., 1, :], -1, 0)
    level = np.maximum(level + 0.114 * np.moveaxis(colour[..., 2, :], -1, 0) - 14, 0)
    np.testing.assert_allclose(recording.extra["hdr"], level / 205, rtol=1e-6)
    # Where the camera resolves, its response gives the reference back to half a grey level.
    inside = (level > 60) & (level < 195)
    seen = np.asarray(recording.response.intensity(recording.frames.intensity))
    step = np.gradient(np.asarray(recording.response.levels)).max()
    assert np.abs(seen - level / 205)[inside].max() < step
    assert (recording.frames.images[level < 50] == 0).all()
    assert (recording.frames.images[level > 205] == 255).all()
    assert (
        np.asarray(SCurve(50).scene(50.0)) == 0 and recording.frames.exposure.tolist() == [1000] * 6
    )
    jaxevent.save(recording, tmp_path / "lake_fast.h5")
    rows = evaluate(without_the_smoother("ahdr_mat.toml", tmp_path))
    done = [row["method"] for row in rows if "lake_fast" in row["recording"] and "error" not in row]
    assert done == ["CF, printed", "cf", "AKF, printed", "akf"]


@pytest.mark.slow
def test_rigs_are_registered_and_evaluated(tmp_path, monkeypatch, float32):
    """The same camera twice: the identity brings its frames onto the events' pixels."""
    for name in ("plain", "hdr"):
        folder = tmp_path / "recorded" / name
        folder.mkdir(parents=True)
        jaxevent.save(dataclasses.replace(small(), frames=None), folder / "events.h5")
        lag = 0.002
        frames = dataclasses.replace(small().frames, t=STAMPS + 500_000)
        jaxevent.save(dataclasses.replace(small(), frames=frames), folder / "frames.h5")
        np.savetxt(folder / "homography.csv", np.eye(3), delimiter=",")
        (folder / "offset.txt").write_text(str(lag - 0.5))
    (tmp_path / "recorded" / "hdr" / "hdr").mkdir()
    stamps = "".join(f"{t + 500_000} {k}.npy\n" for k, t in enumerate(STAMPS))
    (tmp_path / "recorded" / "hdr" / "hdr" / "timestamps.txt").write_text(stamps)
    for k, image in enumerate(small().frames.intensity):
        np.save(tmp_path / "recorded" / "hdr" / "hdr" / f"{k}.npy", 2 * image)
    words = ["published.py", "rigs", str(tmp_path / "recorded"), "--out", str(tmp_path / "made")]
    monkeypatch.setattr("sys.argv", words)
    SCRIPT["main"]()
    made = jaxevent.load(tmp_path / "made" / "plain.h5")
    np.testing.assert_array_equal(made.frames.images, small().frames.images)
    np.testing.assert_array_equal(made.frames.t, STAMPS + 2_000)
    monkeypatch.setenv("RIGS", str(tmp_path / "made"))
    assert len(evaluate(ROOT / "configs" / "rigs.toml")) == 5
    monkeypatch.setenv("RIGS", str(tmp_path / "made" / "hdr"))
    rows = evaluate(ROOT / "configs" / "rigs_hdr.toml")
    assert len(rows) == 4 and all("error" not in row for row in rows)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "measures is missing"),
        ('measures = ["mse"]', "values is missing"),
        ('measures = ["sim"]\n[method.values]\na = [1]', "did you mean 'ssim'"),
        ('measures = ["mse"]\n[method.values]\na = [1, 2]', "values of a"),
        ('measures = ["mse"]\n[method.values]\na = ["x"]', "values of a"),
        ('measures = ["mse"]\nmse = 3', "no setting 'mse'"),
    ],
)
def test_published_numbers_are_checked(text, said, tmp_path):
    config = write_config(tmp_path, f'{ONE}\n[[method]]\nname = "published"\n{text}\n')
    with pytest.raises(jaxevent.InputError, match="method 2") as told:
        evaluate(config)
    assert said in str(told.value)


def test_optional_metrics_are_left_out_without_their_extra(tmp_path, monkeypatch):
    def without() -> None:
        raise jaxevent.InputError("not there")

    jaxevent.save(small(), tmp_path / "small.h5")
    monkeypatch.setattr(jaxevent.runs.scores, "lpips_weights", without)
    text = 'optional_metrics = ["lpips", "global_ssim"]\n' + ONE
    (row,) = evaluate(write_config(tmp_path, text))
    assert "global_ssim" in row and "lpips" not in row
    with pytest.raises(jaxevent.InputError, match="did you mean 'lpips'"):
        evaluate(write_config(tmp_path, text.replace("lpips", "lpip")))
