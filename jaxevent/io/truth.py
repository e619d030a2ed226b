"""Ground truth that data sets keep in files beside a recording.

    MVSEC   NAME_gt.hdf5 beside NAME_data.hdf5: /davis/{left, right}/pose (n, 4, 4), from the camera
            to the world; depth_image_raw (n, H, W) in m, NaN where unknown; flow_dist (n, 2, H, W)
            in px from one of its times to the next; each with its times in s, NAME_ts
    M3ED    NAME_pose_gt.h5 beside NAME_data.h5: Cn_T_C0 (n, 4, 4), from the first left camera to
            the n-th; ts in us. NAME_depth_gt.h5: depth/prophesee/left (n, H, W) in m, infinite
            where unknown; ts
    DSEC    SEQUENCE/flow beside SEQUENCE/events/left/events.h5: forward_timestamps.txt, two times
            in us a line, and forward/*.png of 16 bits: x and y as 2^15 + 128 px, and 1 where known.
            In place of SEQUENCE/flow also train_optical_flow/SEQUENCE/flow, as it is downloaded.
            SEQUENCE/disparity, or train_disparity/SEQUENCE/disparity: timestamps.txt, a time in us
            a line, and event/*.png of 16 bits, 256 times the disparity in px, 0 where unknown

`load` takes poses from these files, as `Recording.poses`. `read_images` gives, by name as
`Recording.extra` keeps them, `depth` (n, H, W) in m with its times `depth_t` (n,), `disparity`
(n, H, W) in px with `disparity_t` (n,), and `flow` (n, 2, H, W), x and y in px, with `flow_t`
(n, 2), from when to when. All times are us. Images stay in their files until they are needed.
DSEC's disparity and flow are those of the rectified image, see `rectify_map`, and NaN where
unknown; what else is unknown is as stored.

Sources: daniilidis-group/mvsec, website/content/data_format/index.md, and readers of its HDF5
files; daniilidis-group/m3ed, build_system/lidar_depth/fasterlio_gt.py; uzh-rpg/DSEC and its page
dsec.ifi.uzh.ch/data-format. Checked against files written by these layouts.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxevent.arrays import times
from jaxevent.errors import InputError
from jaxevent.io import png
from jaxevent.io.checks import reading, truth_files
from jaxevent.io.decoded import DecodedImages
from jaxevent.io.hdf5 import StoredImages
from jaxevent.io.hdf5_files import array, dataset, open_file
from jaxevent.recording import Poses


def read_poses(path: Path, camera: str) -> Poses | None:
    """Read the poses of a camera in the world from a file beside a recording.

    Args:
        path: File of the recording.
        camera: Group of the camera in that file, as "davis/left".

    Returns:
        The poses; None if there is no such file.

    Raises:
        InputError: The file is damaged.
    """
    for file in truth_files(path):
        with reading(file):
            if file.name.endswith("_gt.hdf5"):
                return _read_poses_mvsec(file, camera)
            if file.name.endswith("_pose_gt.h5") and camera == "prophesee/left":
                return _read_poses_m3ed(file)
    return None


def read_images(path: Path, side: str = "left") -> dict[str, Any]:
    """Read depth, disparity and flow of a camera from files beside a recording.

    Args:
        path: File of the recording.
        side: "left" or "right".

    Returns:
        Images and their times by name; empty if there are none.

    Raises:
        InputError: A file is damaged.
    """
    found: dict[str, Any] = {}
    for file in truth_files(path):
        with reading(file):
            if file.name.endswith("_gt.hdf5"):
                found |= _open_images_mvsec(file, f"davis/{side}")
            elif file.name.endswith("_depth_gt.h5"):
                found |= _open_depth_m3ed(file, side)
            elif file.name == "forward_timestamps.txt" and side == "left":
                found |= _open_flow_dsec(file)
            elif file.name == "timestamps.txt" and side == "left":
                found |= _open_disparity_dsec(file)
    return found


def _read_poses_mvsec(file: Path, camera: str) -> Poses | None:
    with open_file(file) as opened:
        if f"{camera}/pose" not in opened:
            return None
        t = times(array(opened, f"{camera}/pose_ts", str(file)), str(file), "pose")
        return _make_poses(t, array(opened, f"{camera}/pose", str(file)), f"{file}: {camera}/pose")


def _read_poses_m3ed(file: Path) -> Poses:
    with open_file(file) as opened:
        stamps = array(opened, "ts", str(file))
        matrices = array(opened, "Cn_T_C0", str(file))
    t = times(stamps, str(file), "pose", us_per_unit=1.0)
    if matrices.shape[1:] == (4, 4):
        matrices = np.linalg.inv(matrices.astype(float))
    return _make_poses(t, matrices, f"{file}: Cn_T_C0")


def _make_poses(t: NDArray[np.int64], matrices: NDArray, source: str) -> Poses:
    """Make poses of matrices.

    Args:
        t: (n,) times, us.
        matrices: (n, 4, 4) poses of the camera, m.
        source: Name of the file for messages.

    Returns:
        The poses.

    Raises:
        InputError: Shapes differ, or a number is not finite.
    """
    from scipy.spatial.transform import Rotation

    if matrices.shape != (len(t), 4, 4) or not np.isfinite(matrices).all():
        raise InputError(
            f"{source} has shape {matrices.shape}; it must be {len(t)} finite 4 x 4 matrices, one "
            "for each time"
        )
    quaternion = Rotation.from_matrix(matrices[:, :3, :3]).as_quat()
    return Poses(t, matrices[:, :3, 3].astype(float), quaternion)


def _open_images(opened: Any, name: str, axes: int, count: int, file: Path) -> StoredImages:
    """Open images of a file, which are read when needed.

    Args:
        opened: The open HDF5 file.
        name: Name of the dataset.
        axes: Number of its axes.
        count: Number of images.
        file: The file, for messages.

    Returns:
        The images.

    Raises:
        InputError: The dataset has another shape or type.
    """
    images = dataset(opened, name, str(file))
    if images.ndim != axes or len(images) != count or images.dtype.kind not in "iuf":
        raise InputError(
            f"{file}: {name} has shape {images.shape}; it must have {axes} axes, and one image for "
            f"each of {count} times"
        )
    return StoredImages(images, f"{file}: {name}")


def _open_images_mvsec(file: Path, camera: str) -> dict[str, Any]:
    opened = open_file(file)
    found: dict[str, Any] = {}
    for name, axes, key in (("depth_image_raw", 3, "depth"), ("flow_dist", 4, "flow")):
        if f"{camera}/{name}" in opened:
            t = times(array(opened, f"{camera}/{name}_ts", str(file)), str(file), key)
            found[key] = _open_images(opened, f"{camera}/{name}", axes, len(t), file)
            found[f"{key}_t"] = t
    if "flow" in found:
        t = found["flow_t"]
        found["flow"] = found["flow"][: max(len(t) - 1, 0)]
        found["flow_t"] = np.stack([t[:-1], t[1:]], axis=1)
    return found


def _open_depth_m3ed(file: Path, side: str) -> dict[str, Any]:
    opened = open_file(file)
    name = f"depth/prophesee/{side}"
    if name not in opened:
        return {}
    t = times(array(opened, "ts", str(file)), str(file), "depth", us_per_unit=1.0)
    return {"depth": _open_images(opened, name, 3, len(t), file), "depth_t": t}


def _open_flow_dsec(stamps: Path) -> dict[str, Any]:
    t = np.loadtxt(stamps, np.int64, delimiter=",", ndmin=2)
    flow = _open_images_dsec(stamps, "forward", t, (2,), _flow_of)
    return {} if flow is None else {"flow": flow, "flow_t": t}


def _open_disparity_dsec(stamps: Path) -> dict[str, Any]:
    t = np.loadtxt(stamps, np.int64, ndmin=1)
    disparity = _open_images_dsec(stamps, "event", t, (), _disparity_of)
    return {} if disparity is None else {"disparity": disparity, "disparity_t": t}


def _flow_of(stored: NDArray[np.float32]) -> NDArray[np.float32]:
    x, y, known = np.moveaxis(stored, 2, 0)
    return np.where(known == 1, (np.stack([x, y]) - 2**15) / 128, np.nan)


def _disparity_of(stored: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.where(stored > 0, stored / 256, np.nan)


def _open_images_dsec(
    stamps: Path,
    name: str,
    t: NDArray[np.int64],
    parts: tuple[int, ...],
    value: Callable[[NDArray[np.float32]], NDArray[np.float32]],
) -> DecodedImages | None:
    """Open the images of a folder beside their times.

    Args:
        stamps: File of the times.
        name: Name of the folder.
        t: (n,) times, us, or (n, 2) with `parts`.
        parts: Axes of channels before those of pixels; none: grey.
        value: Function of stored images (H, W[, 3]) that returns values (*parts, H, W).

    Returns:
        (n, *parts, H, W); None if the folder has no images.

    Raises:
        InputError: There are not as many times as images.
    """
    from PIL import Image

    folder = stamps.parent / name
    images = sorted(folder.glob("*.png"))
    expected = (len(images), 2) if parts else (len(images),)
    if t.shape != expected:
        raise InputError(
            f"{stamps}: holds times of shape {t.shape} but {folder} has {len(images)} images; each "
            f"image needs a line of {'two times' if parts else 'one time'}"
        )
    if not images:
        return None
    with Image.open(images[0]) as first:
        width, height = first.size
    shape = (height, width, 3) if parts else (height, width)
    return DecodedImages(
        lambda row: (value(_read_png(image, shape)).astype(np.float32) for image in images[row:]),
        (len(images), *parts, height, width),
        np.dtype(np.float32),
        str(folder),
    )


def _read_png(image: Path, shape: tuple[int, ...]) -> NDArray[np.float32]:
    stored = png.decode(image.read_bytes(), str(image))
    if stored is None or stored.shape != shape:
        bits = "3 x 16" if len(shape) == 3 else "16"
        raise InputError(
            f"{image}: is no such image; store {shape[1]}x{shape[0]} pixels of {bits} bits"
        )
    return stored.astype(np.float32)
