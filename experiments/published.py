"""Data that others published, made ready for the configurations that evaluate them.

    python experiments/published.py ahdr DOWNLOADED --out ahdr
    AHDR=ahdr jaxevent evaluate configs/ahdr_mat.toml --out results

makes recordings of the AKF authors' AHDR files, .mat of events, time_image and the colour images
img_color (H, W, 3, K). As their page describes, grey levels less 14 go through a camera that crops
`--cut` levels at either end; which curve theirs is, is not printed, here it is `camera.SCurve`. The
levels themselves are the reference, the camera's white is intensity 1.

    python experiments/published.py rigs RECORDED --out registered
    RIGS=registered jaxevent evaluate configs/rigs.toml --out results

registers rigs of two cameras, a folder each:

    RECORDED/NAME/events.*           the event camera's recording
    RECORDED/NAME/frames or frames.* the other camera's: a recording, or images with timestamps.txt
    RECORDED/NAME/rig.toml           calibration (`jaxevent.register.Rig.read`), or homography.csv;
                                     without either a homography is estimated
    RECORDED/NAME/offset.txt         s, added to the other camera's stamps; absent: estimated
    RECORDED/NAME/hdr                HDR references: images with timestamps.txt, as `frames` lie

Recordings with references are made for configs/rigs_hdr.toml, RIGS=registered/hdr. With --triggers
the frames' stamps are taken from the event camera's external triggers. IJRR and HDR files need no
preparation: configs/ijrr.toml, configs/hdr_mat.toml.
"""

import argparse
import dataclasses
from pathlib import Path

import h5py
import numpy as np
import scipy.io

import jaxevent
from jaxevent import register
from jaxevent.arrays import LUMA_WEIGHTS
from jaxevent.camera import SCurve
from jaxevent.errors import InputError
from jaxevent.recording import Frames, Recording

BLACK = 14  # grey level of the authors' camera that is no light


def image_size(path: Path) -> tuple[int, int]:
    """(width, height) of the colour images of a .mat file."""
    if h5py.is_hdf5(path):
        with h5py.File(path) as file:  # axes are reversed
            stored = file["img_color"]
            assert isinstance(stored, h5py.Dataset)
            return int(stored.shape[-2]), int(stored.shape[-1])
    shapes = {name: shape for name, shape, _ in scipy.io.whosmat(path)}
    return int(shapes["img_color"][1]), int(shapes["img_color"][0])


def artificial(path: Path, cut: float = 80) -> Recording:
    """Return a recording of a camera that crops, of colour images and events in a .mat file."""
    recording = jaxevent.load(path, size=image_size(path))
    extra = dict(recording.extra)
    if "img_color" not in extra or "time_image" not in extra:
        raise InputError(f"{path}: has no img_color and time_image; give a file of AHDR data")
    colour = np.moveaxis(extra.pop("img_color"), -1, 0)  # [frame, y, x, channel]
    level = np.maximum(colour @ LUMA_WEIGHTS - BLACK, 0)
    curve = SCurve(cut)
    # Intensity 1 is the level 255 - cut; what the camera resolves begins at `dark`.
    white = 255 - cut
    dark, greys = cut / white, np.linspace(0, 1, 256)
    images = np.rint(255 * np.asarray(curve.grey(curve.scene(level)))).astype(np.uint8)
    t = np.ravel(extra.pop("time_image")).astype(np.int64)
    exposure = np.broadcast_to(np.ravel(extra.pop("exposure", 0)).astype(np.int64), t.shape)
    told = {
        "hdr": (level / white).astype(np.float32),
        "hdr_t": t,
        "response": dark + (1 - dark) * np.asarray(curve.intensity(greys), np.float64),
        "certainty": np.asarray(curve.certainty(greys), np.float64),
        "clip": np.array([dark, 1.0]),
    }
    frames = Frames(t, images, exposure.copy())
    return dataclasses.replace(recording, frames=frames, extra={**extra, **told}).check()


def beside(folder: Path, name: str) -> Path | None:
    """Return the file or folder NAME or NAME.* in a folder, but timestamps."""
    found = sorted(one for one in folder.iterdir() if one.stem == name)
    return found[0] if found else None


def rig(folder: Path, triggers: bool) -> tuple[Recording, bool]:
    """Return the registered recording of a rig, and True if it has a reference."""
    events, frames = beside(folder, "events"), beside(folder, "frames")
    if events is None or frames is None:
        raise InputError(f"{folder}: holds no events.* or no frames; add both")
    recording = jaxevent.load(events, in_memory=False)
    other = register.read_frames(frames)
    offset = None
    grid, H = None, None
    if (folder / "rig.toml").exists():
        known = register.Rig.read(folder / "rig.toml", recording.camera)
        recording = dataclasses.replace(recording, camera=known.events)
        grid = known.grid((recording.width, recording.height), (other.width, other.height))
    elif (folder / "homography.csv").exists():
        H = register.read_homography(folder / "homography.csv")
    if (folder / "offset.txt").exists():
        offset = float((folder / "offset.txt").read_text())
    found = register.estimate(recording, other, grid, homography=H, offset=offset)
    if triggers:
        other, found = register.stamp_by_triggers(recording, other, found)
    print(f"{folder.name}: offset {found.offset:.6f} s, {register.coverage(found.grid):.1%} seen")
    both = register.apply_registration(recording, other, found)
    images = beside(folder, "hdr")
    if images is not None:
        reference = register.read_frames(images, reference=True)
        both = register.apply_registration(both, reference, found, reference=True)
    return dataclasses.replace(both, name=folder.name), images is not None


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("what", choices=["ahdr", "rigs"])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--cut", type=float, default=80)
    parser.add_argument("--triggers", action="store_true")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    if given.what == "ahdr":
        for path in sorted(given.folder.glob("*.mat")):
            jaxevent.save(artificial(path, given.cut), given.out / f"{path.stem}.h5")
    else:
        for folder in sorted(one for one in given.folder.iterdir() if one.is_dir()):
            both, has_reference = rig(folder, given.triggers)
            place = given.out / "hdr" if has_reference else given.out
            place.mkdir(exist_ok=True)
            jaxevent.save(both, place / f"{folder.name}.h5")


if __name__ == "__main__":
    main()
