"""Folders of data sets, written as tests/formats.py has their layouts."""

import formats
import numpy as np
import pytest
import scipy.io
from refusals import refuses
from scipy.spatial.transform import Rotation

import jaxevent
from jaxevent import datasets, io
from jaxevent.errors import InputError
from jaxevent.runs.config import find_recordings

SIZE = (40, 30)
EVENTS = formats.events_of(3, 300, SIZE)
RANDOM = np.random.default_rng(8)
IMAGES = RANDOM.integers(0, 256, (2, 30, 40)).astype(np.uint8)
POSE_T = [10_000, 40_000, 90_000]
POSITIONS = RANDOM.normal(size=(3, 3))
QUATERNIONS = RANDOM.normal(size=(3, 4))
QUATERNIONS /= np.linalg.norm(QUATERNIONS, axis=1, keepdims=True)
QUATERNIONS *= np.sign(QUATERNIONS[:, 3:])
DEPTH = RANDOM.random((3, 30, 40)).astype(np.float32)
DISPARITY = RANDOM.integers(1, 2**16, (3, 30, 40)) / np.float32(256)
FLOW = (RANDOM.integers(-500, 500, (3, 2, 30, 40)) / 128).astype(np.float32)


def matrices():
    made = np.tile(np.eye(4), (3, 1, 1))
    made[:, :3, :3] = Rotation.from_quat(QUATERNIONS).as_matrix()
    made[:, :3, 3] = POSITIONS
    return made


def check_poses(poses):
    np.testing.assert_array_equal(poses.t, POSE_T)
    np.testing.assert_allclose(poses.position, POSITIONS, atol=1e-12)
    signs = np.sign(poses.quaternion[:, 3:])
    np.testing.assert_allclose(poses.quaternion * signs, QUATERNIONS, atol=1e-12)


def ijrr(root):
    for name in ("shapes_6dof", "part/boxes_6dof"):
        folder = root / name
        folder.mkdir(parents=True)
        text = formats.csv(EVENTS, SIZE, None, " ", seconds=True)
        (folder / "events.txt").write_bytes(b"40 30\n" + text)
        rows = np.column_stack([np.array(POSE_T) / 1e6, POSITIONS, QUATERNIONS])
        np.savetxt(folder / "groundtruth.txt", rows, fmt="%.17g")
    return ["part/boxes_6dof", "shapes_6dof"]


def mvsec(root):
    folder = root / "indoor_flying"
    folder.mkdir(parents=True)
    whole = formats.mvsec(EVENTS, SIZE, IMAGES, (20_000, 60_000), sides=("left", "right"))
    (folder / "indoor_flying1_data.hdf5").write_bytes(whole)
    truth = formats.mvsec_truth(matrices(), POSE_T, DEPTH, FLOW, POSE_T)
    (folder / "indoor_flying1_gt.hdf5").write_bytes(truth)
    return ["indoor_flying/indoor_flying1"]


def m3ed(root):
    folder = root / "car_urban_day_horse"
    folder.mkdir(parents=True)
    name = folder / "car_urban_day_horse"
    name.with_name(f"{name.name}_data.h5").write_bytes(formats.m3ed(EVENTS, SIZE))
    truth = formats.m3ed_truth(matrices(), POSE_T)
    name.with_name(f"{name.name}_pose_gt.h5").write_bytes(truth)
    truth = formats.m3ed_truth(matrices(), POSE_T, DEPTH)
    name.with_name(f"{name.name}_depth_gt.h5").write_bytes(truth)
    return ["car_urban_day_horse/car_urban_day_horse"]


def dsec(root):
    start = 50_000_000
    for name, place in (("thun_00_a", "events/left"), ("zurich_city_02_a", "events_left")):
        folder = root / name / place
        folder.mkdir(parents=True)
        (folder / "events.h5").write_bytes(formats.dsec(EVENTS, SIZE, start))
    t = [(start + a, start + a + 100_000) for a in (0, 100_000, 200_000)]
    formats.dsec_flow(root / "thun_00_a/flow", FLOW, t)
    formats.dsec_disparity(root / "thun_00_a/disparity", DISPARITY, [a for a, _ in t])
    return ["thun_00_a", "zurich_city_02_a"]


def hdr(root):
    root.mkdir(parents=True)
    columns = np.stack([EVENTS.t, EVENTS.x + 1, EVENTS.y + 1, EVENTS.p], 1).astype(float)
    arrays = {"events": columns, "image": np.moveaxis(IMAGES, 0, 2)}
    arrays |= {
        "time_image": np.array([20_000.0, 60_000.0]),
        "HDR_mat": np.moveaxis(DEPTH[:2], 0, 2),
    }
    scipy.io.savemat(root / "city_09d_150.mat", arrays)
    return ["city_09d_150"]


def evimo2(root):
    folder = root / "samsung_mono/imo/eval"
    folder.mkdir(parents=True)
    meta = formats.evimo_meta(POSE_T, SIZE)
    depths = {0: np.ones((30, 40), np.uint16)}
    formats.evimo(folder / "scene13_dyn_test_00_000000", EVENTS, meta, depths=depths)
    return ["samsung_mono/imo/eval/scene13_dyn_test_00_000000"]


SETS = {
    "ijrr": (ijrr, {"poses"}),
    "mvsec": (mvsec, {"poses", "depth", "flow"}),
    "m3ed": (m3ed, {"poses", "depth"}),
    "dsec": (dsec, {"disparity", "flow"}),
    "hdr": (hdr, {"HDR_mat"}),
    "ahdr": (hdr, {"HDR_mat"}),
    "evimo2": (evimo2, set()),
}


@pytest.mark.parametrize("name", datasets.LAYOUTS)
@pytest.mark.parametrize("in_memory", [True, False])
def test_a_folder_iterates_as_recordings_with_truth(name, in_memory, tmp_path):
    write, truth = SETS[name]
    names = write(tmp_path / "set")
    size = SIZE if name == "dsec" else None
    found = datasets.open(name, tmp_path / "set", size=size, in_memory=in_memory)
    assert found.names == tuple(names) and len(found) == len(names)
    for recording, expected in zip(found, names, strict=True):
        assert recording.name == expected
        first, last = recording.events[:1], recording.events[len(recording.events) - 1 :]
        offset = int(first.t[0] - EVENTS.t[0])
        assert last.t[0] == EVENTS.t[-1] + offset and len(recording.events) == len(EVENTS)
    recording = found[0]
    assert found[names[0]].name == recording.name
    if "poses" in truth:
        check_poses(recording.poses)
    if "depth" in truth:
        assert not isinstance(recording.extra["depth"], np.ndarray)  # it stays in its file
        np.testing.assert_array_equal(np.asarray(recording.extra["depth"]), DEPTH)
        np.testing.assert_array_equal(recording.extra["depth_t"], POSE_T)
    if name == "mvsec":  # from one time to the next
        np.testing.assert_array_equal(np.asarray(recording.extra["flow"]), FLOW[:2])
        np.testing.assert_array_equal(
            recording.extra["flow_t"], [[10_000, 40_000], [40_000, 90_000]]
        )
    if name == "dsec":
        start = 50_000_000
        np.testing.assert_array_equal(recording.extra["flow_t"][:, 0] - start, [0, 100000, 200000])
        assert recording.extra["flow"].shape == FLOW.shape
        np.testing.assert_array_equal(recording.extra["disparity_t"] - start, [0, 100000, 200000])
        assert recording.extra["disparity"].shape == DISPARITY.shape
        assert not {"disparity", "flow"} & set(found[1].extra)
    if "HDR_mat" in truth:
        np.testing.assert_array_equal(recording.extra["HDR_mat"], DEPTH[:2])


def test_flow_of_dsec_is_in_pixels(tmp_path):
    flow = FLOW.copy()
    flow[:, :, 3:5] = np.nan
    dsec(tmp_path / "set")
    formats.dsec_flow(
        tmp_path / "train_optical_flow/zurich_city_02_a/flow", flow, [(0, 1), (1, 2), (2, 3)]
    )
    (tmp_path / "set").rename(tmp_path / "train_events")
    found = datasets.open("dsec", tmp_path / "train_events", size=SIZE)
    np.testing.assert_array_equal(np.asarray(found["thun_00_a"].extra["flow"]), FLOW)
    np.testing.assert_array_equal(np.asarray(found["zurich_city_02_a"].extra["flow"]), flow)


def test_disparity_of_dsec_is_in_pixels(tmp_path):
    unknown = DISPARITY.copy()
    unknown[:, 3:5] = np.nan
    dsec(tmp_path / "set")
    formats.dsec_disparity(
        tmp_path / "train_disparity/zurich_city_02_a/disparity", unknown, [7, 8, 9]
    )
    (tmp_path / "set").rename(tmp_path / "train_events")
    found = datasets.open("dsec", tmp_path / "train_events", size=SIZE)
    np.testing.assert_array_equal(np.asarray(found["thun_00_a"].extra["disparity"]), DISPARITY)
    extra = found["zurich_city_02_a"].extra
    np.testing.assert_array_equal(np.asarray(extra["disparity"]), unknown)
    np.testing.assert_array_equal(extra["disparity_t"], [7, 8, 9])
    folder = tmp_path / "train_events/thun_00_a/disparity"
    (folder / "event/000002.png").write_bytes(formats.png16(DISPARITY[0, :4].astype(np.uint16)))
    refuses(
        r"000002.png: is no such image; store 40x30 pixels of 16",
        np.asarray,
        found["thun_00_a"].extra["disparity"],
    )
    (folder / "timestamps.txt").write_text("1\n2\n")
    with pytest.raises(InputError, match=r"timestamps.txt: holds times of shape \(2,\)"):
        found["thun_00_a"]


def test_poses_are_read_beside_a_file_of_any_command(tmp_path):
    (name,) = mvsec(tmp_path / "set")
    recording = io.load(tmp_path / f"set/{name}_data.hdf5", stream="left")
    check_poses(recording.poses)
    assert io.load(tmp_path / f"set/{name}_data.hdf5", stream="right").poses is None


def test_configurations_name_a_data_set(tmp_path, monkeypatch):
    names = ijrr(tmp_path / "set")
    monkeypatch.setenv("SETS", str(tmp_path))
    found = find_recordings(["ijrr:$SETS/set"], tmp_path)
    assert found == [(f"ijrr:{name}", tmp_path / "set" / name) for name in names]
    assert find_recordings(["ijrr:set"], tmp_path) == found
    refuses("no recording of mvsec", find_recordings, ["mvsec:set"], tmp_path)


@pytest.mark.parametrize(
    ("name", "side", "match"),
    [
        ("mvsecc", "left", "did you mean 'mvsec'"),
        ("mvsec", "top", "give left or right"),
        ("m3ed", "left", r"no recording of m3ed, no \*_data.h5"),
    ],
)
def test_what_is_not_there_is_said(name, side, match, tmp_path):
    mvsec(tmp_path / "set")
    refuses(match, datasets.open, name, tmp_path / "set", side)
    with pytest.raises(InputError, match="no recording 'indoor'"):
        datasets.open("mvsec", tmp_path / "set")["indoor"]


def spoilt_truth(folder, how):
    if how == "shape":
        (folder / "a_gt.hdf5").write_bytes(
            formats.mvsec_truth(matrices()[:, :3], POSE_T, DEPTH, FLOW, POSE_T)
        )
    elif how == "not finite":
        made = matrices()
        made[1, 0, 3] = np.nan
        (folder / "a_gt.hdf5").write_bytes(formats.mvsec_truth(made, POSE_T, DEPTH, FLOW, POSE_T))
    elif how == "damaged":
        (folder / "a_gt.hdf5").write_bytes(b"\x89HDF\r\n\x1a\n and no more")


@pytest.mark.parametrize("how", ["shape", "not finite", "damaged"])
def test_damaged_truth_is_refused(how, tmp_path):
    whole = formats.mvsec(EVENTS, SIZE, IMAGES, (20_000, 60_000))
    (tmp_path / "a_data.hdf5").write_bytes(whole)
    spoilt_truth(tmp_path, how)
    refuses("a_gt.hdf5", io.load, tmp_path / "a_data.hdf5")


@pytest.mark.slow
def test_a_data_set_is_evaluated_and_fitted(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    images = RANDOM.integers(0, 256, (8, 30, 40)).astype(np.uint8)
    whole = formats.mvsec(
        EVENTS, SIZE, images, range(5_000, 85_000, 10_000), sides=("left", "right")
    )
    (tmp_path / "set").mkdir()
    (tmp_path / "set/a_data.hdf5").write_bytes(whole)
    text = 'recordings = ["mvsec:set"]\n{}[[method]]\nname = "blend"\n'
    config = tmp_path / "run.toml"
    config.write_text(text.format(""))
    refuses("2 cameras, left, right; choose one", jaxevent.evaluate, config)
    config.write_text(text.format('stream = "left"\n'))
    (row,) = jaxevent.evaluate(config, tmp_path / "out")
    assert row["recording"] == "mvsec:a" and np.isfinite(row["mse"])
    text = text.format('stream = "left"\niterations = 2\n')
    config.write_text(text + "search = { I0 = [1, 2, 3] }\n")
    jaxevent.fit(config, tmp_path / "fitted", ["mvsec:set"])
    assert (tmp_path / "fitted/params.toml").is_file()
