"""Cameras of calibration files in YAML: Kalibr's camchain, camera_info of ROS, OpenCV's.

Kalibr (camchain-NAME.yaml) lists cam0, cam1 and on, each with

    camera_model          pinhole
    intrinsics            fx, fy, cx, cy in px
    distortion_model      radtan, equidistant or none
    distortion_coeffs     its numbers, see `jaxevent.camera`
    resolution            width, height in px
    T_cn_cnm1             4 x 4, takes places (m) from the axes of the camera before to its own

and further fields that are passed over, timeshift_cam_imu among them. ROS (camera_info_manager)
writes a single camera, with image_width, image_height, camera_matrix, distortion_model and
distortion_coefficients; its name is camera_name. OpenCV's program of calibration writes these too,
with fisheye_model instead of a name, and its matrices under a tag of its own.
"""

import dataclasses
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxevent.camera import PinholeCamera
from jaxevent.errors import InputError, require
from jaxevent.io.checks import make_supported_camera, reading, whole_size

CALIBRATION_SUFFIXES = (".yaml", ".yml")
_OPENCV_WORDS = re.compile(r"\A%YAML:1\.0[^\n]*|!!opencv-matrix\b")  # no YAML by its own rules
_MAX_FILE_BYTES = 1 << 20  # of a file of a few cameras


@dataclasses.dataclass(frozen=True)
class CalibratedCamera:
    """A camera of a calibration file.

    Attributes:
        lens: Focal lengths, centre and distortion; None where they are not supported.
        left_out: The reason why they are not supported, a sentence without a full stop.
        size: (width, height) in px, None where the file does not state them.
        transform: (4, 4), takes places in m from the axes of the first camera of the file to those
            of this camera.
    """

    lens: PinholeCamera | None
    left_out: str
    size: tuple[int, int] | None
    transform: NDArray[np.float64]


def read_cameras(path: Path) -> dict[str, CalibratedCamera]:
    """Read the cameras of a YAML file, by name, in their order.

    Raises `InputError` for a file that cannot be read, holds no camera or bad numbers.
    """
    require("ruamel.yaml", "ros")
    from ruamel.yaml import YAML

    source = str(path)
    if not path.is_file():
        raise InputError(f"{path}: there is no such file; correct the path")
    with reading(path):
        if path.stat().st_size > _MAX_FILE_BYTES:
            raise InputError(f"{path}: is too large for a calibration; give the YAML of cameras")
        text = _OPENCV_WORDS.sub("", path.read_text(encoding="utf-8-sig"))
        table: Any = YAML(typ="safe", pure=True).load(text)
    if isinstance(table, Mapping):
        if "camera_matrix" in table:
            return {str(table.get("camera_name") or "camera"): _read_camera_info(table, source)}
        names = [name for name in table if str(name).startswith("cam")]
        if names and all(isinstance(table[name], Mapping) for name in names):
            return _read_chain({str(name): table[name] for name in names}, source)
    raise InputError(
        f"{path}: holds no camera; give a camchain of Kalibr (cam0: intrinsics, ...) or "
        "camera_info of ROS or OpenCV (camera_matrix, ...)"
    )


def split_name(source: str | os.PathLike[str]) -> tuple[Path, str | None]:
    """Split FILE:NAME, a camera of a file, into both; the name is None where there is none."""
    text = os.fspath(source)
    path, separator, name = text.rpartition(":")
    return (Path(path), name) if separator and not Path(text).exists() else (Path(text), None)


def read_camera(source: str | os.PathLike[str], size: tuple[int, int]) -> PinholeCamera:
    """Read one camera of a YAML file.

    Args:
        source: The file, or FILE:NAME, as camchain.yaml:cam0.
        size: (width, height) in px of the images that it is for. Without a name the camera of this
            size is taken.

    Returns:
        The camera.

    Raises:
        InputError: The file holds no such camera, several, one of another size, or one whose lens
            is not supported.
    """
    path, name = split_name(source)
    cameras = read_cameras(path)
    if name is not None and name not in cameras:
        raise InputError(f"{path}: has no camera {name!r}; give one of {', '.join(cameras)}")
    names = [name] if name is not None else list(cameras)
    fitting = [one for one in names if cameras[one].size in (None, size)]
    if not fitting:
        held = ", ".join("{} of {}x{}".format(one, *(cameras[one].size or ())) for one in names)
        raise InputError(
            f"{path}: holds {held} pixels, but the recording has {size[0]}x{size[1]}; give the "
            "calibration of its camera"
        )
    if len(fitting) > 1:
        raise InputError(
            f"{path}: holds {', '.join(fitting)} of {size[0]}x{size[1]} pixels; name one of them, "
            f"as in {path.name}:{fitting[0]}"
        )
    return lens_of(cameras, fitting[0], path)


def lens_of(cameras: Mapping[str, CalibratedCamera], name: str, path: Path) -> PinholeCamera:
    """Return the lens of a camera of a file.

    Args:
        cameras: Cameras of the file by name, as of `read_cameras`.
        name: Name of the camera.
        path: The file, for messages.

    Returns:
        The lens.

    Raises:
        InputError: The lens is not supported.
    """
    lens = cameras[name].lens
    if lens is None:
        raise InputError(f"{cameras[name].left_out}; calibrate {name} of {path.name} with another")
    return lens


def _read_chain(table: Mapping[str, Any], path: str) -> dict[str, CalibratedCamera]:
    found: dict[str, CalibratedCamera] = {}
    transform = np.eye(4)
    for name, one in table.items():
        source = f"{path}: {name}"
        if "T_cn_cnm1" in one:
            step = _matrix(one["T_cn_cnm1"], f"{source}: T_cn_cnm1")
            transform = step @ transform
        elif found:
            raise InputError(
                f"{source}: has no T_cn_cnm1, its place among the cameras; add it, 4 x 4"
            )
        size = None
        if "resolution" in one:
            size = whole_size(*_numbers(one["resolution"], 2, f"{source}: resolution"), source)
        model = str(one.get("camera_model", "pinhole"))
        if model != "pinhole":
            why = f"{source}: the camera model {model[:40]!r} is not supported, pinhole is"
            found[name] = CalibratedCamera(None, why, size, transform)
            continue
        numbers = _numbers(one.get("intrinsics"), 4, f"{source}: intrinsics")
        lens = str(one.get("distortion_model") or "none")
        k = one.get("distortion_coeffs") or []
        found[name] = _make_camera(
            numbers, "" if lens == "none" else lens, k, source, (size, transform)
        )
    return found


def _read_camera_info(table: Mapping[str, Any], source: str) -> CalibratedCamera:
    size = None
    if {"image_width", "image_height"} <= set(table):
        size = whole_size(table["image_width"], table["image_height"], source)
    matrix = _numbers(_data(table["camera_matrix"]), 9, f"{source}: camera_matrix: data")
    k = _data(table.get("distortion_coefficients")) or []
    fisheye = "equidistant" if table.get("fisheye_model") else ""
    model = str(table.get("distortion_model") or fisheye)
    return _make_camera(matrix[[0, 4, 2, 5]], model, k, source, (size, np.eye(4)))


def _make_camera(
    intrinsics: NDArray[np.float64],
    model: str,
    coefficients: Any,
    source: str,
    size_and_pose: tuple[tuple[int, int] | None, NDArray[np.float64]],
) -> CalibratedCamera:
    """Make a camera of a calibration file's numbers.

    Args:
        intrinsics: (4,) fx, fy, cx and cy, px.
        model: Name of the distortion model; "": none.
        coefficients: List of its coefficients.
        source: Name of the file and camera, for messages.
        size_and_pose: (width, height), px, or None, and the transform (4, 4) from the first camera.

    Returns:
        The camera.

    Raises:
        InputError: A number is not possible.
    """
    count = len(coefficients) if isinstance(coefficients, list) else 0
    k = _numbers(coefficients, count, f"{source}: the distortion")
    if not (intrinsics[:2] > 0).all():
        raise InputError(
            f"{source}: has the focal lengths {intrinsics[0]:g} and {intrinsics[1]:g} px; give "
            "positive ones"
        )
    lens, left_out = make_supported_camera(intrinsics, model, k, source)
    return CalibratedCamera(lens, left_out.get("camera", ""), *size_and_pose)


def _data(part: Any) -> Any:
    return part.get("data") if isinstance(part, Mapping) else part


def _matrix(values: Any, where: str) -> NDArray[np.float64]:
    """Convert four lists of four numbers to a matrix.

    Args:
        values: The lists, as read.
        where: Name of their place, for messages.

    Returns:
        (4, 4).

    Raises:
        InputError: They are none.
    """
    if not isinstance(values, list) or len(values) != 4:
        raise InputError(f"{where} must be four rows of four numbers; correct it")
    return np.stack([_numbers(row, 4, where) for row in values])


def _numbers(values: Any, count: int, where: str) -> NDArray[np.float64]:
    """Convert a list of finite numbers to an array.

    Lists may hold themselves.

    Args:
        values: The list, as read.
        count: Number of numbers.
        where: Name of its place, for messages.

    Returns:
        (count,).

    Raises:
        InputError: It is none.
    """
    held = values if isinstance(values, list) else []
    are_numbers = all(isinstance(value, int | float) for value in held)
    if len(held) != count or not are_numbers or not all(abs(value) < 1e300 for value in held):
        raise InputError(f"{where} must be {count} finite numbers; correct it")
    return np.array(held, np.float64)
