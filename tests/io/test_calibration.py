"""Calibrations in YAML: Kalibr's camchain, camera_info of ROS, for recordings and rigs."""

import pickle
import sys

import numpy as np
import pytest
from commands import described, fails
from refusals import refuses
from rigs import turned

import jaxevent
from jaxevent import cli
from jaxevent.camera import PinholeCamera
from jaxevent.cli import arguments
from jaxevent.errors import InputError, MissingExtra
from jaxevent.recording import Events, Recording
from jaxevent.register import Rig

pytest.importorskip("ruamel.yaml")

FIRST = PinholeCamera(60, 61, 7, 5, (-0.1, 0.02, 1e-4, 2e-4))
SECOND = PinholeCamera(50, 51, 9, 6, (0.1, 0.01, 0.0, 0.0), "equidistant")
STEP = np.eye(4)
STEP[:3, :3], STEP[:3, 3] = turned(0.1, -0.2, 0.3), [0.01, 0.02, -0.03]
LAST = np.eye(4)
LAST[:3, 3] = [1.0, 0, 0]
CHAIN = f"""
cam0:
  camera_model: pinhole
  distortion_coeffs: [-0.1, 0.02, 0.0001, 0.0002]
  distortion_model: radtan
  intrinsics: [60.0, 61.0, 7, 5]
  resolution: [14, 10]
  rostopic: /dvs/image_raw
cam1:
  T_cn_cnm1: {STEP.tolist()}
  camera_model: pinhole
  distortion_coeffs: [0.1, 0.01, 0.0, 0.0]
  distortion_model: equidistant
  intrinsics: [50.0, 51.0, 9, 6]
  resolution: [18, 12]
  timeshift_cam_imu: -0.0055
"""
THIRD = f"""
cam2:
  T_cn_cnm1: {LAST.tolist()}
  camera_model: pinhole
  distortion_coeffs: []
  distortion_model: none
  intrinsics: [40.0, 40.0, 9, 6]
  resolution: [18, 12]
"""
INFO = """
image_width: 14
image_height: 10
camera_name: dvs
camera_matrix:
  rows: 3
  cols: 3
  data: [60.0, 0, 7, 0, 61, 5, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [-0.1, 0.02, 0.0001, 0.0002, 0]}
"""


def recording(size=(14, 10)):
    t, at = np.arange(5) * 1000, np.arange(5, dtype=np.uint16)
    return Recording("a", *size, Events(t, at, at, at % 2 == 0))


@pytest.fixture
def stored(tmp_path):
    jaxevent.save(recording(), tmp_path / "a.h5")
    for name, text in {"chain": CHAIN, "three": CHAIN + THIRD, "info": INFO}.items():
        (tmp_path / f"{name}.yaml").write_text(text)
    return tmp_path


@pytest.mark.parametrize("in_memory", [True, False])
def test_a_recording_takes_a_camera_of_numbers(stored, in_memory):
    lens = PinholeCamera(40, 40, 9, 6)
    made = jaxevent.load(stored / "a.h5", camera=lens, in_memory=in_memory)
    assert made.camera == lens and pickle.loads(pickle.dumps(made)).camera == lens
    with pytest.raises(InputError, match="camera is a tuple; give .*PinholeCamera.fx"):
        jaxevent.load(stored / "a.h5", camera=(40, 40, 9, 6))
    bare = jaxevent.load(stored / "a.h5")
    with pytest.raises(InputError, match="needs; give camera=jaxevent.camera.PinholeCamera"):
        jaxevent.egomotion.contrast.estimate(bare, model="rotation")


def test_a_recording_takes_the_camera_of_its_size(stored, capsys):
    path = stored / "a.h5"
    for name in ("chain.yaml", "three.yaml", "three.yaml:cam0", "info.yaml"):
        assert jaxevent.load(path, camera=stored / name).camera == FIRST
    bare = jaxevent.load(path, size=(18, 12), camera=f"{stored / 'three.yaml'}:cam2").camera
    assert bare == PinholeCamera(40, 40, 9, 6)
    out = stored / "out.h5"
    words = ["convert", path, out, "--camera", stored / "chain.yaml"]
    assert cli.main([str(word) for word in words]) == 0
    assert jaxevent.load(out).camera == FIRST
    assert described(out)["inputs"].keys() == {str(path), str(stored / "chain.yaml")}
    capsys.readouterr()
    for name, *named in (
        ("three.yaml:cam2", "cam2 of 18x12", "14x10"),
        ("chain.yaml:cam7", "'cam7'", "cam0, cam1"),
        ("missing.yaml", "missing.yaml"),
    ):
        fails(capsys, ["info", path, "--camera", stored / name], *named)
    fails(
        capsys,
        ["info", path, "--size", "18,12", "--camera", stored / "three.yaml"],
        "three.yaml:cam1",
    )


@pytest.mark.parametrize(
    ("text", "lens"),
    [
        ("60,61,7.5,5", PinholeCamera(60, 61, 7.5, 5)),
        ("60, 61, 7, 5, -0.1,2e-2", PinholeCamera(60, 61, 7, 5, (-0.1, 0.02))),
        (
            "60,61,7,5,0.1,0,0,0,0,0.2,0,0",
            PinholeCamera(60, 61, 7, 5, (0.1, 0, 0, 0, 0, 0.2, 0, 0), "rational"),
        ),
        ("60,61,7,5,0.1,0.01,fisheye", PinholeCamera(60, 61, 7, 5, (0.1, 0.01), "equidistant")),
    ],
)
def test_the_command_line_takes_a_camera_of_numbers(stored, text, lens):
    out = stored / "out.h5"
    words = ["convert", stored / "a.h5", out, "--camera", text]
    assert cli.main([str(word) for word in words]) == 0
    assert jaxevent.load(out).camera == lens
    assert described(out)["inputs"].keys() == {str(stored / "a.h5")}
    live, _ = arguments.open_live("-", {"size": (14, 10), "camera": arguments.lens(text)})
    assert live.camera == lens


def test_numbers_that_are_no_camera_are_refused(stored, capsys):
    for text, *named in (
        ("60,61,7", "neither a file nor FX,FY,CX,CY", "200,200"),
        ("60,61,7,five,0", "neither a file nor FX,FY,CX,CY"),
        ("-60,61,7,5", "focal lengths -60.0 and 61.0 px", "give"),
        ("60,61,7,5,1,2,3,4,5,fisheye", "has 5 coefficients", "at most 4"),
        ("60,61,7,5,1,fov", "'fov'", "give one of"),
    ):
        with pytest.raises(SystemExit) as end:
            cli.main(["info", str(stored / "a.h5"), f"--camera={text}"])
        said = capsys.readouterr().err
        assert end.value.code == 2 and all(part in said for part in (*named, "--camera")), said
    fails(
        capsys, ["info", stored / "a.h5", "--camera", "60,61,2e3,5"], "a: a camera with cx = 2000.0"
    )
    # A file may have such a name.
    (stored / "60,61,7,5").write_text(CHAIN)
    assert arguments.lens(str(stored / "60,61,7,5")) == str(stored / "60,61,7,5")


OF_OPENCV = """%YAML:1.0
---
image_width: 14
image_height: 10
fisheye_model: 1
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 60., 0., 7., 0., 61., 5., 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 4
   cols: 1
   dt: d
   data: [ 0.1, 0.01, 0., 0. ]
"""


def test_a_file_of_opencv_is_read(stored):
    path = stored / "opencv.yaml"
    path.write_text(OF_OPENCV)
    want = PinholeCamera(60, 61, 7, 5, (0.1, 0.01), "equidistant")
    assert jaxevent.load(stored / "a.h5", camera=path).camera == want
    path.write_text(OF_OPENCV.replace("fisheye_model: 1", "fisheye_model: 0"))
    want = PinholeCamera(60, 61, 7, 5, (0.1, 0.01))
    assert jaxevent.load(stored / "a.h5", camera=path).camera == want


def test_a_rig_is_two_cameras_of_a_chain(stored):
    def assert_rig(rig, lenses, transform):
        assert (rig.events, rig.frames) == lenses
        np.testing.assert_allclose(rig.rotation, transform[:3, :3], atol=1e-12)
        np.testing.assert_allclose(rig.translation, transform[:3, 3], atol=1e-12)

    path, sizes = stored / "chain.yaml", ((18, 12), (14, 10))
    assert_rig(Rig.read(path), (FIRST, SECOND), STEP)
    assert_rig(Rig.read(path, sizes=sizes), (SECOND, FIRST), np.linalg.inv(STEP))
    three = stored / "three.yaml"
    bare = PinholeCamera(40, 40, 9, 6)
    assert_rig(Rig.read(three, cameras=("cam0", "cam2")), (FIRST, bare), LAST @ STEP)
    assert_rig(Rig.read(three, cameras=("cam2", "cam1")), (bare, SECOND), np.linalg.inv(LAST))
    for match, more in (
        ("cam0, cam1, cam2; name the event camera", {}),
        ("no camera 'cam9'", {"cameras": ("cam0", "cam9")}),
        ("not of the sizes", {"sizes": ((14, 10), (3, 3))}),
    ):
        refuses(match, Rig.read, three, **more)
    refuses("holds one camera, dvs", Rig.read, stored / "info.yaml")


def test_register_takes_a_chain(stored, capsys):
    other = stored / "other"
    other.mkdir()
    for number in range(3):
        np.save(other / f"{number}.npy", np.full((12, 18), 0.25 * number, np.float32))
    (other / "timestamps.txt").write_text("0\n2000\n4000\n")
    out = stored / "both.h5"
    words = ["register", stored / "a.h5", "--frames", other, "--offset", 0, "--out", out]
    words += ["--calibration", stored / "chain.yaml"]
    assert cli.main([str(word) for word in words]) == 0
    both = jaxevent.load(out)
    assert both.camera == FIRST and len(both.frames) == 3
    grid = Rig.read(stored / "chain.yaml").grid((14, 10), (18, 12))
    assert both.extra["covered"].sum() == np.isfinite(grid).all(-1).sum() > 0
    capsys.readouterr()
    swapped = [*words, "--cameras", "cam1,cam9", "--force"]
    fails(capsys, swapped, "chain.yaml", "'cam9'")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("[60.0, 61.0, 7, 5]", "[60.0, 61.0, 7]", "cam0: intrinsics must be 4 finite numbers"),
        ("[60.0, 61.0, 7, 5]", "[60.0, .nan, 7, 5]", "cam0: intrinsics must be 4 finite"),
        ("[60.0, 61.0, 7, 5]", "[-60.0, 61.0, 7, 5]", "focal lengths -60 and 61 px"),
        ("[60.0, 61.0, 7, 5]", "&a [*a, *a, *a, *a]", "cam0: intrinsics must be 4 finite"),
        ("T_cn_cnm1", "T", "cam1: has no T_cn_cnm1"),
        ("[14, 10]", "[14, 1.5]", "height must be one whole number"),
        ("radtan", "fov", "lens model 'fov', which is not supported"),
        ("camera_model: pinhole", "camera_model: omni", "camera model 'omni' is not supported"),
        ("cam0:", "cam0: [", "cannot be read"),
        ("cam", "lens", "holds no camera; give a camchain of Kalibr"),
    ],
)
def test_what_cannot_be_used_is_named(old, new, message, stored):
    bad = stored / "bad.yaml"
    bad.write_text(CHAIN.replace(old, new))
    with pytest.raises(InputError, match=message) as refused:
        jaxevent.load(stored / "a.h5", camera=bad)
    assert "bad.yaml" in str(refused.value)
    refuses(message, Rig.read, bad)


def test_the_parser_is_of_an_extra(stored, monkeypatch):
    monkeypatch.setitem(sys.modules, "ruamel.yaml", None)
    with pytest.raises(MissingExtra, match="'ruamel'.*ros"):
        jaxevent.load(stored / "a.h5", camera=stored / "chain.yaml")
