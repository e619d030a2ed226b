"""An HDR image registered to frames that were made of it by known homographies."""

import dataclasses

import numpy as np
import pytest
from scipy import ndimage

import jaxevent
from jaxevent import cli, register
from jaxevent.camera import SCurve
from jaxevent.errors import InputError
from jaxevent.recording import Events, Frames, Recording
from jaxevent.runs.protocols import reference

SIZE, FRAMES = (120, 90), 4


def scene() -> np.ndarray:
    """Intensities of 3 decades, of patches at several scales."""
    rng = np.random.default_rng(7)
    level = sum(
        2 * s**0.3 * np.kron(rng.normal(size=(240 // s, 320 // s)), np.ones((s, s)))
        for s in (4, 8, 16)
    )
    level = ndimage.gaussian_filter(level, 1.2)
    return np.exp(3.5 * (level - level.mean()) / np.ptp(level)).astype(np.float32)


def moving(image: np.ndarray) -> tuple[Recording, list[np.ndarray]]:
    """Frames of a camera that crops, and the homographies from their pixels to the image's."""
    y, x = np.mgrid[: SIZE[1], : SIZE[0]].reshape(2, -1)
    curve, frames, all_H = SCurve(50), [], []
    for k in range(FRAMES):
        turn = 0.04 * (k - 1.5)
        H = np.array(
            [
                [1.6 * np.cos(turn), -1.6 * np.sin(turn), 40 + 6.3 * k],
                [1.6 * np.sin(turn), 1.6 * np.cos(turn), 35 - 3.7 * k],
                [2e-4 * (k - 1), -1e-4, 1],
            ]
        )
        u, v, w = H @ np.stack([x, y, np.ones(len(x))])
        seen = ndimage.map_coordinates(image, [v / w, u / w], order=1, mode="nearest")
        frames.append(np.asarray(curve.grey(0.4 * seen)).reshape(SIZE[::-1]))
        all_H.append(H)
    grey = np.rint(255 * np.array(frames)).astype(np.uint8)
    stamps = 20_000 * np.arange(FRAMES) + 5_000
    told = Frames(stamps, grey, np.zeros(FRAMES, np.int64))
    one = Events(*(np.zeros(1, kind) for kind in (np.int64, np.uint16, np.uint16, bool)))
    extra = {"response": np.asarray(curve.table(), np.float64)}
    return Recording("moving", *SIZE, one, told, extra=extra), all_H


def test_the_reference_is_what_each_frame_saw(tmp_path, capsys):
    pytest.importorskip("cv2")
    image = scene()
    recording, all_H = moving(image)
    found, homographies, scale = register.register_still(recording, image)
    assert scale == pytest.approx(0.4, rel=0.02)
    y, x = np.mgrid[: SIZE[1], : SIZE[0]].reshape(2, -1)
    at = np.stack([x, y, np.ones(len(x))])
    for H, true in zip(homographies, all_H, strict=True):
        one, two = (part[:2] / part[2] for part in (np.asarray(H) @ at, true @ at))
        inside = (two >= 0).all(0) & (two < [[320], [240]]).all(0)
        off = np.linalg.norm(one - two, axis=0)[inside] / 1.6  # px of the frames
        assert np.sqrt(np.mean(off**2)) < 0.3
    # The protocol takes it, and unclipped pixels of the frames agree.
    _, truth = reference(found)
    true = np.asarray(truth.images)
    np.testing.assert_array_equal(truth.t, recording.frames.t)
    seen = np.asarray(recording.response.intensity(recording.frames.intensity))
    good = (seen > 0.1) & (seen < 0.9) & np.isfinite(true)
    assert good.mean() > 0.3
    assert np.median(np.abs(np.log(true[good] / seen[good]))) < 0.05
    assert (true[np.isfinite(true)] >= 0).all()

    jaxevent.save(recording, tmp_path / "moving.h5")
    np.save(tmp_path / "scene.npy", image)
    command = f"camera reference {tmp_path}/moving.h5 --image {tmp_path}/scene.npy --scale 0.4"
    assert cli.main([*command.split(), "--out", str(tmp_path / "truth.h5")]) == 0
    assert "registered to: 4 of 4" in capsys.readouterr().out
    stored = jaxevent.load(tmp_path / "truth.h5")
    np.testing.assert_allclose(stored.extra["hdr"] / 0.4, found.extra["hdr"] / scale, rtol=1e-5)


def test_what_does_not_match_has_no_reference():
    pytest.importorskip("cv2")
    image = scene()
    recording, _ = moving(image)
    grey = np.asarray(recording.frames.images).copy()
    grey[2] = np.random.default_rng(3).integers(0, 256, grey[2].shape)
    frames = dataclasses.replace(recording.frames, images=grey)
    found, homographies, _ = register.register_still(
        dataclasses.replace(recording, frames=frames), image
    )
    assert [H is not None for H in homographies] == [True, True, False, True]
    np.testing.assert_array_equal(found.extra["hdr_t"], recording.frames.t[[0, 1, 3]])
    with pytest.raises(InputError, match="moving: fewer than 15"):
        register.register_still(recording, scene()[::-1, ::-1].T[:60, :60])
    with pytest.raises(InputError, match="none negative"):
        register.register_still(recording, -image)
    with pytest.raises(InputError, match="no frames"):
        register.register_still(dataclasses.replace(recording, frames=None), image)
