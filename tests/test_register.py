"""Another camera's frames on the event camera's pixels and clock, against rendered truth."""

import dataclasses
import runpy
from pathlib import Path

import h5py
import numpy as np
import pytest
from commands import fails
from PIL import Image
from scipy.ndimage import gaussian_filter

import jaxevent
from jaxevent import cli, register
from jaxevent.camera import PinholeCamera
from jaxevent.errors import InputError
from jaxevent.recording import Events, Frames, Recording
from jaxevent.register import Registration, Rig, Warped
from jaxevent.simulate import SENSORS

RIGS = runpy.run_path(str(Path(__file__).parents[1] / "experiments" / "register.py"))
ONE = PinholeCamera(110.0, 111.0, 63.0, 48.5, (-0.2, 0.05, 1e-3, -5e-4, 0.0))
TWO = PinholeCamera(160.0, 158.0, 101.0, 74.0, (-0.15, 0.03, -1e-3, 1e-3, 0.01))
SIZE, OTHER = (128, 96), (200, 150)


def turned(x: float, y: float, z: float) -> np.ndarray:
    """Rodrigues' formula."""
    w = np.array([x, y, z])
    angle = np.linalg.norm(w)
    a, b, c = w / angle
    K = np.array([[0, -c, b], [c, 0, -a], [-b, a, 0]])
    return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K


RIG = Rig(ONE, TWO, turned(0.02, -0.03, 0.05), np.array([-0.1, 0.02, 0.01]))


def ramp(width: int, height: int) -> np.ndarray:
    """An image that tells its coordinates: x + 1000 y."""
    y, x = np.mgrid[:height, :width]
    return (x + 1000.0 * y)[None]


def events(t, x, y, p) -> Events:
    fields = (
        np.array(t, np.int64),
        np.array(x, np.uint16),
        np.array(y, np.uint16),
        np.array(p, bool),
    )
    return Events(*fields)


# Geometry


@pytest.mark.parametrize("plane", [(0.0, 0.0, 1.0, 2.0), (0.3, -0.2, 1.0, 1.5)])
def test_grid_of_a_plane_is_that_of_opencv(plane):
    cv2 = pytest.importorskip("cv2")
    grid = RIG.grid(SIZE, OTHER, plane=plane)
    seen = ~np.isnan(grid[..., 0])
    assert 0.5 < seen.mean() < 1
    y, x = np.nonzero(seen)
    matrix, other = (np.array([[c.fx, 0, c.cx], [0, c.fy, c.cy], [0, 0, 1]]) for c in (ONE, TWO))
    # The undistorted place, as a fixed point of OpenCV's distortion.
    ray = np.concatenate(
        [(np.stack([x, y], 1) - (ONE.cx, ONE.cy)) / (ONE.fx, ONE.fy)] + [np.ones((len(x), 1))], 1
    )
    none = np.zeros(3)
    for _ in range(60):
        bent, _ = cv2.projectPoints(ray, none, none, matrix, np.array(ONE.distortion))
        ray[:, :2] -= (bent[:, 0] - np.stack([x, y], 1)) / (ONE.fx, ONE.fy)
    X = ray * (plane[3] / (ray @ np.array(plane[:3])))[:, None]
    turn = cv2.Rodrigues(RIG.rotation)[0]
    places, _ = cv2.projectPoints(X, turn, RIG.translation, other, np.array(TWO.distortion))
    np.testing.assert_allclose(grid[y, x], places[:, 0], atol=1e-6)


def test_a_depth_map_is_the_plane_and_far_away_the_translation_does_not_matter():
    plane = (0.3, -0.2, 1.0, 1.5)
    ray = register._rays(ONE, SIZE)
    depth = (1.5 / (ray @ np.array(plane[:3]))).reshape(96, 128)
    of_map = RIG.grid(SIZE, OTHER, depth=depth)
    np.testing.assert_allclose(of_map, RIG.grid(SIZE, OTHER, plane=plane), atol=1e-9)
    part = depth.copy()
    part[10:20] = np.nan
    assert np.isnan(RIG.grid(SIZE, OTHER, depth=part)[10:20]).all()
    here = dataclasses.replace(RIG, translation=np.zeros(3))
    np.testing.assert_allclose(RIG.grid(SIZE, OTHER), here.grid(SIZE, OTHER, depth=3.0), atol=1e-9)
    assert np.nanmax(np.abs(RIG.grid(SIZE, OTHER) - RIG.grid(SIZE, OTHER, depth=2.0))) > 5


def test_what_is_behind_a_camera_or_outside_its_image_is_not_seen():
    back = dataclasses.replace(RIG, rotation=turned(0, np.pi, 0))
    assert np.isnan(back.grid(SIZE, OTHER)).all()
    # With k1 = -0.5 the lens's circle ends at r = 0.816: what lies beyond folds back inside.
    strong = PinholeCamera(40.0, 40.0, 50.0, 50.0, (-0.5, 0.0, 0.0, 0.0, 0.0))
    wide = Rig(PinholeCamera(20.0, 20.0, 63.5, 47.5), strong, np.eye(3), np.zeros(3))
    seen = ~np.isnan(wide.grid(SIZE, (101, 101))[..., 0])
    y, x = np.mgrid[:96, :128]
    np.testing.assert_array_equal(seen, np.hypot(x - 63.5, y - 47.5) / 20 < np.sqrt(2 / 3))


def test_the_homography_of_a_far_scene_is_that_of_its_calibration():
    K = [np.array([[c.fx, 0, c.cx], [0, c.fy, c.cy], [0, 0, 1]]) for c in (ONE, TWO)]
    H = K[1] @ RIG.rotation @ np.linalg.inv(K[0])
    grid = register.homography_grid(H, SIZE, OTHER, ONE, TWO)
    np.testing.assert_allclose(grid, RIG.grid(SIZE, OTHER), atol=1e-6)


# Images


def test_warped_ramps_are_the_grid():
    grid = RIG.grid(SIZE, OTHER, depth=2.0)
    inside = (grid > 2) & (grid < [197, 147])
    grid = np.where(np.all(inside, axis=-1, keepdims=True), grid, np.nan)
    image = np.asarray(Warped(ramp(*OTHER), grid, np.nan))[0]
    np.testing.assert_allclose(image, grid[..., 0] + 1000 * grid[..., 1], atol=1e-6)


def test_where_the_other_camera_resolves_more_pixels_are_means():
    rng = np.random.default_rng(0)
    fine = rng.random((1, 90, 120))
    grid = np.moveaxis(np.mgrid[:30, :40], 0, -1)[..., ::-1] * 3.0 + 1
    (image,) = np.asarray(Warped(fine, grid))
    means = fine[0].reshape(30, 3, 40, 3).mean((1, 3))
    np.testing.assert_allclose(image[1:-1, 1:-1], means[1:-1, 1:-1], atol=1e-9)


def test_clipped_pixels_stay_clipped_and_nothing_overshoots():
    image = np.full((1, 20, 20), 100, np.uint8)
    image[:, :, 10:] = 255
    grid = np.moveaxis(np.mgrid[:20, :19], 0, -1)[..., ::-1] + np.array([0.4, 0.0])
    grey = np.asarray(Warped(image, grid)).reshape(20, 19)
    assert grey.dtype == np.uint8
    # A tenth more of the neighbour than 0.4 by the cubic; the others are between 100 and 255.
    np.testing.assert_array_equal(np.unique(grey[:, :9]), [100])
    assert 150 < int(grey[0, 9]) < 170 and (grey[:, 10:] == 255).all()
    more = np.asarray(Warped(image, grid + np.array([0.2, 0.0])))[0]
    assert more[0, 9] == 255


def test_warped_images_are_read_when_asked_for():
    images = np.random.default_rng(0).integers(0, 255, (5, 20, 30, 3), dtype=np.uint8)
    grid = np.full((4, 6, 2), np.nan)
    grid[:, :3] = 7.25
    lazy = Warped(images, grid, fill=9)
    assert lazy.shape == (5, 4, 6, 3) and lazy.dtype == np.uint8 and len(lazy) == 5
    whole = np.asarray(lazy)
    assert (whole[:, :, 3:] == 9).all()
    np.testing.assert_array_equal(np.asarray(lazy[3:]), whole[3:])
    np.testing.assert_array_equal(np.asarray(lazy[np.array([4, 0])]), whole[[4, 0]])
    with pytest.raises(IndexError):
        lazy[2]


def shifts(image: np.ndarray, truth: np.ndarray, block: int) -> list[np.ndarray]:
    """Of each block, how far the image is off the truth (px), by one Lucas-Kanade step."""
    image, truth = gaussian_filter(image, 1.0), gaussian_filter(truth, 1.0)
    down, across = (np.gradient((image + truth) / 2, axis=axis) for axis in (0, 1))
    found = []
    for top in range(0, truth.shape[0] - block + 1, block):
        for left in range(0, truth.shape[1] - block + 1, block):
            part = np.s_[top : top + block, left : left + block]
            if np.isfinite(image[part]).all():
                A = np.stack([across[part].ravel(), down[part].ravel(), np.ones(block * block)], 1)
                found.append(np.linalg.lstsq(A, (truth - image)[part].ravel())[0][:2])
    return found


@pytest.fixture(scope="module")
def near():
    return RIGS["near_rig"](0, 0.5, 1.5, 2)


def test_registered_views_are_the_rendered_ones(near):
    source, other, _, _, rig, _ = near
    grid = rig.grid(source.size, other.size, plane=(0, 0, 1, 2.0))
    worst = []
    for t in (0.1, 0.5):
        images = other.intensity(t)[None]
        (image,) = np.asarray(Warped(images, grid, np.nan))
        worst += shifts(np.log(image), np.log(source.intensity(t)), 24)
    assert len(worst) >= 8
    assert np.linalg.norm(worst, axis=1).max() < 0.1
    # The check sees what it is for: a wall 10 % farther away is off by half a pixel.
    grid = rig.grid(source.size, other.size, plane=(0, 0, 1, 2.2))
    (image,) = np.asarray(Warped(other.intensity(0.1)[None], grid, np.nan))
    off = shifts(np.log(image), np.log(source.intensity(0.1)), 24)
    assert np.linalg.norm(np.mean(off, 0)) > 0.3


# Estimates


@pytest.fixture(scope="module")
def far():
    sensor = dataclasses.replace(SENSORS["davis"], exposure_samples=2)
    return RIGS["far_rig"](0, "lake", "slow", (96, 72), (128, 96), 0.7, sensor)


def test_all_is_found_of_a_far_scene(far, tmp_path, capsys):
    pytest.importorskip("cv2")
    _, recording, other, H, offset = far
    jaxevent.save(recording, tmp_path / "events.h5")
    jaxevent.save(other, tmp_path / "frames.h5")
    command = ["register", tmp_path / "events.h5", "--frames", tmp_path / "frames.h5"]
    out = tmp_path / "both.h5"
    assert cli.main([str(word) for word in [*command, "--search", 0.4, "--out", out]]) == 0
    said = capsys.readouterr().out
    both = jaxevent.load(out)
    assert both.name == recording.name and len(both.events) == len(recording.events)
    assert abs(float(both.extra["register_offset"]) - offset) < 1e-3
    assert f"estimated: {float(both.extra['register_offset']):.6f} s" in said
    size = (recording.width, recording.height)
    true = register.homography_grid(H, size, (other.width, other.height))
    found = register.homography_grid(both.extra["homography"], size, (other.width, other.height))
    assert RIGS["grid_error"](found, true) < 0.15
    np.testing.assert_array_equal(both.extra["covered"], ~np.isnan(found[..., 0]))
    np.testing.assert_array_equal(both.extra["response"], other.extra["response"])
    shift = round(float(both.extra["register_offset"]) * 1e6)
    assert set(both.frames.t) <= set(other.frames.t + shift)
    assert (both.frames.exposure == other.frames.exposure[0]).all()
    assert (np.asarray(both.frames.images)[:, ~both.extra["covered"]] == 0).all()
    command = [
        "reconstruct",
        out,
        "--method",
        "last-frame",
        "--rate",
        "20",
        "--out",
        tmp_path / "r.h5",
    ]
    assert cli.main([str(word) for word in command]) == 0
    with h5py.File(tmp_path / "r.h5") as file:
        assert np.isfinite(np.array(file["image"])).all()


def test_the_clock_of_a_calibrated_rig_is_found(near):
    _, _, recording, other, rig, offset = near
    size, seen = (recording.width, recording.height), (other.width, other.height)
    candidates = register.clock_offsets(recording, other)
    assert abs(candidates[0] - offset) < 0.012
    grid = rig.grid(size, seen, plane=(0, 0, 1, 2.0))
    found = register.refine(recording, other, candidates[0], grid)
    assert abs(found.offset - offset) < 1e-3 and (found.agreement or 0) > 0.8
    assert found.grid is grid and found.homography is None
    later = dataclasses.replace(other.frames, t=other.frames.t + 50_000_000)
    later = dataclasses.replace(other, frames=later)
    again = register.clock_offsets(recording, later)
    assert again[0] == pytest.approx(candidates[0] - 50, abs=2e-3)
    with pytest.raises(InputError, match="no offset of its clock"):
        register.clock_offsets(recording, later, search=1.0)


def test_what_is_given_is_kept(near):
    _, _, recording, other, rig, _ = near
    size, seen = (recording.width, recording.height), (other.width, other.height)
    grid = rig.grid(size, seen, depth=2.0)
    found = register.estimate(recording, other, grid, offset=0.25)
    assert found.offset == 0.25 and found.grid is grid and found.agreement is None
    H = np.array([[1.5, 0, 3], [0, 1.5, 4], [0, 0, 1]])
    found = register.estimate(recording, other, homography=H, offset=-0.1)
    assert found.offset == -0.1
    np.testing.assert_array_equal(found.homography, H)


def test_frames_of_another_scene_are_refused(near):
    _, _, recording, other, rig, _ = near
    noise = np.random.default_rng(0).integers(60, 190, other.frames.images.shape, dtype=np.uint8)
    wrong = dataclasses.replace(
        other, name="noise", frames=dataclasses.replace(other.frames, images=noise)
    )
    size = (recording.width, recording.height)
    grid = rig.grid(size, (other.width, other.height), depth=2.0)
    with pytest.raises(InputError, match="noise: .* do not agree"):
        register.estimate(recording, wrong, grid, search=0.02)


def test_too_few_matches_are_refused(far):
    pytest.importorskip("cv2")
    _, recording, other, _, _ = far
    even = np.full((len(other.frames), 96, 128), 120, np.uint8)
    even[::2] += 10
    blank = dataclasses.replace(other, frames=dataclasses.replace(other.frames, images=even))
    with pytest.raises(InputError, match="only 0 features"):
        register.estimate(recording, blank, offset=0.0)


# The registered recording


def small(frames: int = 6) -> tuple[Recording, Recording]:
    t = np.arange(0, 100_000, 500)
    own = events(t, t // 500 % 8, t // 500 % 6, t % 1000 == 0)
    extra = {"gain": np.full(2, 2.0), "hot": np.zeros((1, 2)), "hdr": np.ones((1, 6, 8)), "kept": t}
    old = Frames(np.array([0, 9]), np.zeros((2, 6, 8), np.uint8), np.zeros(2, np.int64))
    recording = Recording("own", 8, 6, own, old, PinholeCamera(9.0, 9.0, 4.0, 3.0), extra=extra)
    images = np.full((frames, 6, 8), 100, np.uint8)
    rgb = np.full((frames, 6, 8, 3), 50, np.uint8)
    stamps = np.arange(frames) * 20_000 + 5_000_000
    other = Recording(
        "other", 8, 6, Events.empty(), Frames(stamps, images, np.full(frames, 3_000)),
        extra={"rgb": rgb, "gain": np.arange(1.0, frames + 1)},
    )  # fmt: skip
    return recording, other


def part_grid() -> np.ndarray:
    grid = np.moveaxis(np.mgrid[:6, :8], 0, -1)[..., ::-1].astype(float)
    grid[:, :2] = np.nan
    grid[0, 5] = np.nan
    return grid


def test_registered_frames_have_the_events_clock():
    recording, other = small(9)
    both = register.registered(recording, other, Registration(part_grid(), -5.0 - 0.04)).check()
    # Those more than a frame away are left out: of -40, -20, ..., 120 ms the first.
    np.testing.assert_array_equal(both.frames.t, np.arange(-20_000, 120_001, 20_000)[:-1])
    assert (both.frames.exposure == 3_000).all()
    np.testing.assert_array_equal(both.gain, np.arange(2.0, 9.0))
    assert both.extra["rgb"].shape == (7, 6, 8, 3) and both.camera == recording.camera
    assert (both.extra["rgb"][:, 1, :2] == 0).all() and (both.extra["rgb"][:, 1, 3] == 50).all()
    assert np.asarray(both.frames.images)[:, 0].tolist() == [[0, 0, 100, 100, 100, 0, 100, 100]] * 7
    assert both.extra["kept"] is recording.extra["kept"]
    with pytest.raises(InputError, match="give the offset"):
        register.registered(recording, other, Registration(part_grid(), 1.0))
    with pytest.raises(InputError, match="nothing that the event camera sees"):
        register.registered(recording, other, Registration(part_grid() * np.nan, -5.0))


def test_a_crop_is_a_smaller_recording():
    recording, other = small()
    H = np.array([[1.0, 0.1, 2], [0, 1, 3], [0, 0, 1]])
    both = register.registered(recording, other, Registration(part_grid(), -5.0, H), crop=True)
    both.check()
    assert (both.width, both.height) == (6, 5)
    assert (both.camera.cx, both.camera.cy) == (2.0, 2.0)
    inside = (recording.events.x >= 2) & (recording.events.y >= 1)
    np.testing.assert_array_equal(both.events.t, recording.events.t[inside])
    np.testing.assert_array_equal(both.events.x, recording.events.x[inside] - 2)
    np.testing.assert_array_equal(both.events.y, recording.events.y[inside] - 1)
    assert both.extra["covered"].all() and both.extra["hdr"].shape == (1, 5, 6)
    assert both.extra["rgb"].shape == (6, 5, 6, 3)
    np.testing.assert_allclose(both.extra["homography"] @ [1, 1, 1], H @ [3, 2, 1])


def test_the_largest_rectangle():
    rng = np.random.default_rng(0)
    for _ in range(20):
        mask = rng.random((6, 7)) < 0.8
        left, top, right, bottom = register._rectangle(mask)
        areas = [
            (y1 - y0) * (x1 - x0)
            for y0 in range(6) for y1 in range(y0 + 1, 7)
            for x0 in range(7) for x1 in range(x0 + 1, 8)
            if mask[y0:y1, x0:x1].all()
        ]  # fmt: skip
        assert mask[top:bottom, left:right].all()
        assert (bottom - top) * (right - left) == max(areas)


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


def test_opencv_is_asked_for_by_name(near, monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "cv2", None)
    _, _, recording, other, _, _ = near
    with pytest.raises(InputError, match=r"jaxevent\[vision\]"):
        register.estimate(recording, other, offset=0.0)
