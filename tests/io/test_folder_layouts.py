"""Published layouts of events and images in several files, written here as their projects do."""

import json
import zipfile

import h5py
import numpy as np
import pytest
from commands import fails
from formats import events_of
from PIL import Image
from refusals import refuses

import jaxevent
from jaxevent import aks, cli

SIZE = (40, 30)
EVENTS = events_of(3, 600, SIZE, span=200_000)
RANDOM = np.random.default_rng(5)
GREY = RANDOM.integers(0, 256, (3, 30, 40)).astype(np.uint8)
COLOUR = RANDOM.integers(0, 256, (3, 30, 40, 3)).astype(np.uint8)
STAMPS = np.array([0, 90_000, 180_000])


def check_events(events, expected=EVENTS):
    read = events[:]
    for name in "txyp":
        np.testing.assert_array_equal(getattr(read, name), getattr(expected, name))


def luma(colours):
    """ITU-R 601 luma of red, green, blue, within the rounding of Pillow."""
    return colours @ np.array([299, 587, 114]) / 1000


def save_events(file, events, scale=1, **names):
    """The events of one file of TimeLens, under the names of BS-ERGB unless others are given."""
    file.parent.mkdir(parents=True, exist_ok=True)
    columns = {
        "x": (events.x * scale).astype(np.uint16),
        "y": (events.y * scale).astype(np.uint16),
        names.get("t", "timestamp"): events.t,
        names.get("p", "polarity"): events.p.astype(np.uint8),
    }
    np.savez_compressed(file, **columns)


def timelens(folder, images=GREY, stamps=STAMPS, scale=1, names=("events", "images"), **columns):
    rows = np.searchsorted(EVENTS.t, STAMPS)
    for number, (row, end) in enumerate(zip(rows, [*rows[1:], len(EVENTS)], strict=True)):
        file = folder / names[0] / f"{number:06d}.npz"
        save_events(file, EVENTS[row:end], scale, **columns)
    (folder / names[1]).mkdir()
    for number, image in enumerate(images):
        Image.fromarray(image).save(folder / names[1] / f"{number:06d}.png")
    (folder / names[1] / "timestamp.txt").write_text("".join(f"{one}\n" for one in stamps))
    return folder


@pytest.mark.parametrize("in_memory", [True, False])
def test_a_folder_of_timelens(tmp_path, in_memory):
    recording = jaxevent.load(timelens(tmp_path / "coke"), in_memory=in_memory)
    assert (recording.name, recording.width, recording.height) == ("coke", *SIZE)
    check_events(recording.events)
    np.testing.assert_array_equal(recording.frames.t, STAMPS)
    np.testing.assert_array_equal(recording.frames.images, GREY)
    np.testing.assert_array_equal(recording.frames.exposure, [0, 0, 0])
    assert recording.extra == {} and recording.notes == ()
    assert isinstance(recording.frames.images, np.ndarray) == in_memory
    part = recording[90_000:150_000]
    check_events(part.events, EVENTS[slice(*np.searchsorted(EVENTS.t, [90_000, 150_000]))])


@pytest.mark.parametrize("in_memory", [True, False])
def test_colours_of_timelens(tmp_path, in_memory):
    names = ("events_aligned", "images_corrected")
    folder = timelens(tmp_path / "a", COLOUR, names=names, t="t", p="p")
    recording = jaxevent.load(folder, in_memory=in_memory)
    check_events(recording.events)
    np.testing.assert_array_equal(recording.extra["rgb"], COLOUR)
    np.testing.assert_allclose(np.asarray(recording.frames.images), luma(COLOUR), atol=1)


def test_remapped_coordinates_of_timelens(tmp_path):
    folder = timelens(tmp_path / "a", scale=32)
    file = folder / "events" / "000001.npz"
    held = dict(np.load(file))
    # A sixteenth of a pixel beside the pixel, and three events outside the images.
    held["x"][0] += 2
    held["x"][1:3], held["y"][3] = (40 * 32, 65_000), 30 * 32
    np.savez(file, **held)
    first = int(np.searchsorted(EVENTS.t, STAMPS[1]))
    left = np.delete(np.arange(len(EVENTS)), first + np.arange(1, 4))
    for in_memory in (True, False):
        recording = jaxevent.load(folder, in_memory=in_memory)
        check_events(recording.events, EVENTS[left])
        note = "coordinates are in 1/32 pixel; 3 events outside the images are left out"
        assert recording.notes == (note,)


def test_coordinates_of_timelens_with_decimals(tmp_path):
    folder = timelens(tmp_path / "a")
    for file in (folder / "events").iterdir():
        held = dict(np.load(file))
        np.savez(file, **{**held, "x": held["x"] + np.float32(0.25)})
    recording = jaxevent.load(folder)
    check_events(recording.events)
    assert recording.notes == ("coordinates are in fractions of a pixel",)


def test_times_of_timelens_in_seconds(tmp_path):
    folder = timelens(tmp_path / "a", stamps=STAMPS * 1e-6)
    for file in (folder / "events").iterdir():
        held = dict(np.load(file))
        np.savez(file, **{**held, "timestamp": held["timestamp"] * 1e-6})
    recording = jaxevent.load(folder)
    check_events(recording.events)
    np.testing.assert_array_equal(recording.frames.t, STAMPS)
    # Text of whole microseconds with decimals, as numpy.savetxt writes it.
    folder = timelens(tmp_path / "b", stamps=[f"{one:.6e}" for one in STAMPS])
    np.testing.assert_array_equal(jaxevent.load(folder).frames.t, STAMPS)


def test_images_and_times_of_timelens_that_do_not_fit(tmp_path, capsys):
    folder = timelens(tmp_path / "more", stamps=STAMPS[:2])
    recording = jaxevent.load(folder)
    np.testing.assert_array_equal(recording.frames.images, GREY[:2])
    assert recording.notes == ("1 images beyond the last time are left out",)
    folder = timelens(tmp_path / "fewer", stamps=[*STAMPS, 200_000])
    fails(capsys, ["info", folder], "timestamp.txt: has 4 times for 3 images")
    folder = timelens(tmp_path / "none")
    (folder / "images" / "timestamp.txt").unlink()
    fails(capsys, ["info", folder], "no image in images shows the sensor's size", "--size")
    recording = jaxevent.load(folder, size=SIZE)
    assert recording.frames is None
    assert "3 images without their times" in recording.left_out["frames"]
    refuses("holds no frames.*3 images without their times; add time", aks.estimate, recording)
    folder = timelens(tmp_path / "words", stamps=["now", "then", "soon"])
    fails(capsys, ["info", folder], "timestamp.txt: holds something else than times")
    folder = timelens(tmp_path / "sizes", images=[GREY[0], GREY[1, :20], GREY[2]])
    fails(capsys, ["info", folder], "000001.png: is 40x20 uint8 but the first image is 40x30")
    folder = timelens(tmp_path / "fields", t="when")
    fails(capsys, ["info", folder], "000000.npz: holds x, y, when, polarity; store x, y, timestamp")


def evreal(folder, **changed):
    arrays = {
        "events_ts": EVENTS.t * 1e-6,
        "events_xy": np.stack([EVENTS.x, EVENTS.y], 1).astype(np.int16),
        "events_p": EVENTS.p,
        "images": GREY[..., None],
        "images_ts": STAMPS[:, None] * 1e-6,
        "image_event_indices": np.searchsorted(EVENTS.t, STAMPS)[:, None],
        **changed,
    }
    folder.mkdir()
    for name, values in arrays.items():
        if values is not None:
            np.save(folder / f"{name}.npy", values)
    (folder / "metadata.json").write_text(json.dumps({"sensor_resolution": [SIZE[1], SIZE[0]]}))
    return folder


@pytest.mark.parametrize("in_memory", [True, False])
@pytest.mark.parametrize("columns", [True, False])
def test_a_folder_of_evreal(tmp_path, in_memory, columns):
    shapes = {} if not columns else {
        "events_ts": EVENTS.t[:, None] * 1e-6, "events_p": EVENTS.p[:, None], "images": GREY,
        "images_ts": STAMPS * 1e-6,
    }  # fmt: skip
    recording = jaxevent.load(evreal(tmp_path / "boxes", **shapes), in_memory=in_memory)
    assert (recording.name, recording.width, recording.height) == ("boxes", *SIZE)
    check_events(recording.events)
    np.testing.assert_array_equal(recording.frames.t, STAMPS)
    np.testing.assert_array_equal(recording.frames.images, GREY)
    assert isinstance(recording.frames.images, np.ndarray) == in_memory


def test_parts_of_evreal(tmp_path, capsys):
    folder = evreal(tmp_path / "bgr", images=COLOUR[..., ::-1])
    (folder / "metadata.json").unlink()
    recording = jaxevent.load(folder, in_memory=False)
    assert (recording.width, recording.height) == SIZE
    np.testing.assert_array_equal(recording.extra["rgb"], COLOUR)
    np.testing.assert_allclose(np.asarray(recording.frames.images), luma(COLOUR), atol=0.51)
    assert recording.notes == ("images of three channels are taken as blue, green, red",)
    recording = jaxevent.load(evreal(tmp_path / "events", images=None))
    assert recording.frames is None and recording.left_out == {}
    folder = evreal(tmp_path / "untimed", images_ts=None)
    fails(
        capsys,
        ["reconstruct", folder, "--method", "akf", "--at", "frames", "--out", tmp_path / "o.h5"],
        "holds no frames (images.npy has no images_ts.npy with its times; add that); give --rate",
    )
    folder = evreal(tmp_path / "few", images_ts=STAMPS[:2] * 1e-6)
    fails(capsys, ["info", folder], "images.npy holds 3 images, images_ts.npy times of shape (2,)")
    folder = evreal(tmp_path / "short", events_p=EVENTS.p[1:])
    fails(capsys, ["info", folder], "t, xy and p have 600, 600 and 599 events")
    folder = evreal(tmp_path / "size")
    (folder / "metadata.json").write_text('{"sensor_resolution": 30}')
    fails(capsys, ["info", folder], "sensor_resolution must be [height, width], not 30")


def test_a_zip_of_one_text_of_any_name(tmp_path, capsys):
    text = "40 30\n" + "".join(
        f"{t * 1e-6:.6f} {x} {y} {p:d}\n"
        for t, x, y, p in zip(EVENTS.t, EVENTS.x, EVENTS.y, EVENTS.p, strict=True)
    )
    for name in ("dynamic_6dof.txt", "data/dynamic_6dof.txt"):
        path = tmp_path / "dynamic.zip"
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr(name, text)
        recording = jaxevent.load(path)
        assert (recording.name, recording.width, recording.height) == ("dynamic", *SIZE)
        check_events(recording.events)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a.txt", text.replace("40 30\n", "40 30\n0.0 1 2\n"))
    fails(capsys, ["info", path], "a.txt", "t x y p")
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a.txt", text)
        archive.writestr("b.txt", text)
    fails(capsys, ["info", path], "neither events.txt nor .npy arrays")


def v2e(path, **changed):
    arrays = {
        "events": np.stack([EVENTS.t, EVENTS.x, EVENTS.y, EVENTS.p], 1).astype(np.uint32),
        "frame": GREY,
        "frame_ts": STAMPS.astype(np.uint32),
        "frame_idx": np.searchsorted(EVENTS.t, STAMPS).astype(np.uint64),
        **changed,
    }
    with h5py.File(path, "w") as file:
        for name, values in arrays.items():
            if values is not None:
                file.create_dataset(name, data=values, compression="gzip")
    return path


@pytest.mark.parametrize("in_memory", [True, False])
def test_frames_of_v2e(tmp_path, in_memory):
    recording = jaxevent.load(v2e(tmp_path / "a.h5"), in_memory=in_memory)
    assert (recording.width, recording.height) == SIZE
    check_events(recording.events)
    np.testing.assert_array_equal(recording.frames.t, STAMPS)
    np.testing.assert_array_equal(recording.frames.images, GREY)


def test_images_in_hdf5_that_are_not_read(tmp_path, capsys):
    path = v2e(tmp_path / "few.h5", frame_ts=STAMPS[:2])
    fails(capsys, ["info", path], "frame holds 3 images, frame_ts 2 times")
    path = v2e(tmp_path / "untimed.h5", frame_ts=None)
    recording = jaxevent.load(path, size=SIZE)
    assert recording.frames is None
    assert recording.left_out["frames"].startswith("frame may be images")
    assert cli.main(["info", str(path), "--size", "40,30"]) == 0
    said = capsys.readouterr().out
    assert "none (frame may be images, of another layout or camera; store" in said


def test_images_of_dsec_beside_the_events(tmp_path):
    folder = tmp_path / "zurich"
    (folder / "events" / "left").mkdir(parents=True)
    (folder / "images" / "left" / "rectified").mkdir(parents=True)
    with h5py.File(folder / "events" / "left" / "events.h5", "w") as file:
        for name in "txyp":
            file[f"events/{name}"] = getattr(EVENTS, name).astype(np.uint32)
    recording = jaxevent.load(folder / "events" / "left" / "events.h5", size=SIZE)
    assert recording.left_out["frames"] == (
        f"{folder}/images/left/rectified holds those of another camera; bring them onto the "
        "events' pixels by jaxevent register"
    )


# Files of exposures


def pictures(folder):
    folder.mkdir(parents=True)
    for number, image in enumerate(GREY):
        Image.fromarray(image).save(folder / f"{number:06d}.png")
    return folder


HEADER = "# exposure_start_timestamp_us, exposure_end_timestamp_us\n"
EXPOSED = HEADER + "1000, 9000\n51000, 59003\n101000, 109000\n"
MIDDLES, LENGTHS = [5_000, 55_001, 105_000], [8_000, 8_003, 8_000]


@pytest.mark.parametrize(
    ("images", "times"),
    [
        ("cam", "cam/timestamps.txt"),
        ("images/left/rectified", "images/left/exposure_timestamps.txt"),
        ("images/left", "images/left/zurich_image_exposure_timestamps_left.txt"),
    ],
)
def test_starts_and_ends_of_exposures(tmp_path, images, times):
    from jaxevent.register import read_frames

    folder = pictures(tmp_path / images)
    (tmp_path / times).write_text(EXPOSED)
    recording = read_frames(folder)
    np.testing.assert_array_equal(recording.frames.t, MIDDLES)
    np.testing.assert_array_equal(recording.frames.exposure, LENGTHS)
    refuses(
        "its timestamps hold the exposures; leave out exposure", read_frames, folder, exposure=0.002
    )


def test_the_side_of_dsec_and_its_times_without_exposures(tmp_path):
    from jaxevent.register import read_frames

    folder = pictures(tmp_path / "images" / "left" / "rectified")
    (tmp_path / "images" / "timestamps.txt").write_text("7\n8\n9\n")
    np.testing.assert_array_equal(read_frames(folder).frames.t, [7, 8, 9])
    for side, text in (("left", EXPOSED), ("right", HEADER + "1, 2\n3, 4\n5, 6\n")):
        (folder.parent / f"exposure_timestamps_{side}.txt").write_text(text)
    np.testing.assert_array_equal(read_frames(folder).frames.t, MIDDLES)


@pytest.mark.parametrize("text", ["0 0\n1 50000\n2 100000\n", "5 9\n8 12\n20 21\n", "9 1\n12 2\n"])
def test_two_columns_that_are_no_exposures(tmp_path, text):
    from jaxevent.register import read_frames

    (pictures(tmp_path / "cam") / "timestamps.txt").write_text(text)
    refuses("two columns of numbers; keep the times only, or the st", read_frames, tmp_path / "cam")


def test_exposures_of_a_stack(tmp_path):
    from jaxevent.io.images import read_stack

    folder = pictures(tmp_path / "stack")
    (folder / "timestamps.txt").write_text(EXPOSED)
    _, seconds = read_stack(folder)
    np.testing.assert_allclose(seconds, [0.008, 0.008003, 0.008])
    (folder / "timestamps.txt").write_text("1\n2\n3\n")
    refuses("does not state its exposure time", read_stack, folder)
