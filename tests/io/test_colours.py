"""Colours of frames are kept beside the grey ones that methods use."""

import dataclasses
from pathlib import Path

import formats
import numpy as np
import pytest
from noise import HEIGHT, STAMPS, WIDTH, small
from PIL import Image

import jaxevent
from jaxevent import register
from jaxevent.io import load

RGB = np.random.default_rng(1).integers(0, 256, (len(STAMPS), HEIGHT, WIDTH, 3)).astype(np.uint8)
LUMA = np.array([0.299, 0.587, 0.114])


def as_text(folder: Path, images: np.ndarray) -> Path:
    events = small().events
    rows = zip(events.t, events.x, events.y, events.p, strict=True)
    (folder / "events.txt").write_text(
        "".join(f"{t / 1e6:.6f} {x} {y} {p:d}\n" for t, x, y, p in rows)
    )
    lines = []
    for k, (t, image) in enumerate(zip(STAMPS, images, strict=True)):
        Image.fromarray(image).save(folder / f"{k}.png")
        lines.append(f"{t / 1e6:.6f} {k}.png\n")
    (folder / "images.txt").write_text("".join(lines))
    return folder


def as_ros1(folder: Path, images: np.ndarray) -> Path:
    pytest.importorskip("rosbags")
    formats.bag(folder / "one.bag", small().events, (WIDTH, HEIGHT), images, STAMPS)
    return folder / "one.bag"


@pytest.mark.parametrize("write", [as_text, as_ros1])
@pytest.mark.parametrize("in_memory", [True, False])
def test_colours_are_kept(write, in_memory, tmp_path):
    path = write(tmp_path, RGB)
    recording = load(path, in_memory=in_memory)
    np.testing.assert_array_equal(np.asarray(recording.extra["rgb"]), RGB)
    grey = np.asarray(recording.frames.images)
    assert np.abs(grey - RGB @ LUMA).max() <= 0.51
    part = recording.with_frames(slice(0, None, 2))
    np.testing.assert_array_equal(np.asarray(part.extra["rgb"]), RGB[::2])
    # Stored and read again; and the chrominance of a reconstruction.
    jaxevent.save(recording, tmp_path / "kept.h5")
    np.testing.assert_array_equal(load(tmp_path / "kept.h5").extra["rgb"], RGB)
    images = [
        jaxevent.colour.colour_video(jaxevent.blend.estimate(one), one)([int(STAMPS[2])])
        for one in (recording, dataclasses.replace(recording, extra={"rgb": RGB}))
    ]
    np.testing.assert_array_equal(*images)


@pytest.mark.parametrize("write", [as_text, as_ros1])
def test_grey_images_in_colour_files_are_grey(write, tmp_path):
    grey = np.repeat(RGB[..., :1], 3, -1)
    recording = load(write(tmp_path, grey))
    assert "rgb" not in recording.extra
    np.testing.assert_array_equal(recording.frames.images, RGB[..., 0])
    (tmp_path / "more").mkdir()
    assert "rgb" not in load(write(tmp_path / "more", RGB[..., 0])).extra


def test_colours_of_a_folder_of_images(tmp_path):
    for k, image in enumerate(RGB):
        Image.fromarray(image).save(tmp_path / f"{k}.png")
    stamps = "".join(f"{t} {k}.png\n" for k, t in enumerate(STAMPS))
    (tmp_path / "timestamps.txt").write_text(stamps)
    other = register.read_frames(tmp_path)
    np.testing.assert_array_equal(other.extra["rgb"], RGB)
    np.testing.assert_allclose(
        np.asarray(other.frames.images), RGB @ LUMA / 255, rtol=1e-6, atol=1e-7
    )
    assert "rgb" not in register.read_frames(tmp_path, reference=True).extra
    Image.fromarray(RGB[0, ..., 0]).save(tmp_path / "0.png")  # one that is grey
    assert "rgb" not in register.read_frames(tmp_path).extra
