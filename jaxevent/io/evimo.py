"""Recordings of EVIMO2 (Burner et al. 2022): a folder of NumPy files for each camera and sequence.

    dataset_events_t.npy   (events,) or (events, 1)  float seconds, sorted
    dataset_events_xy.npy  (events, 2)               x and y
    dataset_events_p.npy   (events,) or (events, 1)  0/1
    dataset_info.npz       K (3, 3), D (4,), index, discretization, and meta, a pickled dictionary
    dataset_classical.npz  classical_0000000000 and on, (height, width) or in colour
    dataset_depth.npz      depth_0000000000 and on, (height, width) in mm
    dataset_mask.npz       mask_0000000000 and on, (height, width), number of the object times 1000

The layout is that of the project better-flow/evimo, docs_sphinx/source/ground-truth-format.md,
"NPZ (EVIMO2v2)". Masks or depths tell the sensor's size.

Times of images, poses, the model of distortion and IMU samples are in `meta` alone. A pickle can
run any program when it is read, so `load` leaves it out, names it in `extra["arrays_left_out"]`,
and leaves out these parts with it. K and D are kept in `extra`, and make no calibration: D is k1 k2
k3 k4 whatever the model is, without p1 and p2. If you trust the file, read the pickle yourself and
give what is in it:

    with numpy.load(folder / "dataset_info.npz", allow_pickle=True) as info:
        recording = jaxevent.io.evimo.read(folder, meta=info["meta"].item())

Polarities are as stored. The layout's description says that those of the Samsung camera
(samsung_mono) are inverted.

Decoder. NumPy's own files, read here; checked against files written by the layout.
"""

import functools
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxevent.arrays import LUMA
from jaxevent.camera import PinholeCamera
from jaxevent.errors import InputError
from jaxevent.io import (
    calibrated,
    check_unfolded,
    reading,
    sensor_size,
    times,
    vectors,
    whole_number,
)
from jaxevent.io.decoded import BLOCK, Columns, DecodedImages, decoded
from jaxevent.io.options import ReadOptions
from jaxevent.lenses import LENSES, find_model
from jaxevent.recording import Frames, Imu, Poses, Recording


def knows(folder: Path) -> bool:
    """Whether a folder holds a sequence."""
    return (folder / "dataset_events_t.npy").is_file()


def read(
    path: Path,
    options: ReadOptions | None = None,
    meta: Mapping[str, Any] | None = None,
    imu: str | None = None,
) -> Recording:
    """Read a folder.

    With `meta`, the dictionary of dataset_info.npz, there are frames of the classical camera, the
    calibration, the poses of the camera in the world and, in `extra`, the ground truth: `depth`
    (n, height, width) in m, `mask`, and their times `depth_t` and `mask_t` (n,) in us. Depths and
    masks stay in their files until they are asked for. `imu` names one of the series of samples in
    `meta`.

    Raises `InputError` for bad input.
    """
    source = str(path)
    options = options or ReadOptions()
    meta = {} if meta is None else meta
    parts = {name: _Images(path, name) for name in ("classical", "depth", "mask")}
    extra: dict[str, Any] = dict(_info(path))
    if "arrays_left_out" in extra and meta:
        del extra["arrays_left_out"]
    with reading(f"{source}: meta"):
        camera, told, left_out = _camera(meta, source) if "meta" in meta else (None, None, {})
        poses = _poses(meta["full_trajectory"], source) if "full_trajectory" in meta else None
        samples = _imu(meta["imu"][imu], source) if imu is not None else None
        frames = None
        for name, part in parts.items():
            t, images = part.at(meta.get("frames", ()))
            if len(t) and name == "classical":
                images = np.asarray(images) if options.in_memory else images
                frames = Frames(t, images, np.zeros_like(t))
            elif len(t):
                extra |= {name: images, f"{name}_t": t}
    shapes = [part.shape for part in parts.values() if part.shape is not None]
    told = told or ((shapes[0][1], shapes[0][0]) if shapes else None)
    otherwise = f"{path}: no image tells the sensor's size;"
    size = sensor_size(options.size, told, frames=frames, otherwise=otherwise)
    events = decoded(_decoder(path), size, source, options)
    return Recording(
        path.name, *size, events, frames, camera, poses, samples, extra, left_out=left_out
    )


def _decoder(path: Path) -> Any:
    columns: dict[str, NDArray] = {}
    for name in ("t", "xy", "p"):
        file = path / f"dataset_events_{name}.npy"
        with reading(str(file)):
            stored = np.load(file, mmap_mode="r", allow_pickle=False)
        width = 2 if name == "xy" else 1
        if stored.shape not in ((len(stored), width), (len(stored),)[: 3 - width]):
            raise InputError(
                f"{file}: has shape {stored.shape}; it must be (events, {width}), one row per event"
            )
        columns[name] = stored.reshape(len(stored), width)
    lengths = [len(column) for column in columns.values()]
    if len(set(lengths)) != 1:
        raise InputError(
            f"{path}: t, xy and p have {lengths[0]}, {lengths[1]} and {lengths[2]} events; they "
            "must be equally long"
        )
    return functools.partial(_events, str(path), columns)


def _events(
    source: str, columns: Mapping[str, NDArray], state: int | None
) -> Iterator[tuple[int, Columns]]:
    for row in range(state or 0, len(columns["t"]), BLOCK):
        t, xy, p = (np.array(columns[name][row : row + BLOCK]) for name in ("t", "xy", "p"))
        in_seconds = times(t[:, 0], source, "event", first_row=row)
        yield row, (in_seconds, xy[:, 0].copy(), xy[:, 1].copy(), p[:, 0])


def _info(path: Path) -> Iterator[tuple[str, NDArray]]:
    """The arrays K and D of numbers; what is pickled is left alone, and named."""
    file = path / "dataset_info.npz"
    if not file.is_file():
        return
    with reading(str(file)), _archive(file) as archive:
        for name in ("K", "D"):
            if f"{name}.npy" in archive.namelist():
                values = _member(archive, f"{name}.npy", str(file))
                if values.dtype.kind not in "iuf" or not np.isfinite(values).all():
                    raise InputError(f"{file}: {name} must be finite numbers; correct it")
                yield name, values
        if "meta.npy" in archive.namelist():
            yield "arrays_left_out", np.array(["meta"])


def _archive(file: Path) -> zipfile.ZipFile:
    archive = zipfile.ZipFile(file)
    unfolded = sum(member.file_size for member in archive.infolist())
    check_unfolded(unfolded, file.stat().st_size, str(file))
    return archive


def _member(archive: zipfile.ZipFile, name: str, source: str) -> NDArray:
    """An array of numbers; `InputError` for objects, and for a shape that its bytes cannot fill."""
    with archive.open(name) as stream:
        shape, dtype = _header(stream, f"{source}: {name}")
        if shape is None or dtype is None:
            raise InputError(f"{source}: {name} is pickled, which is not read; store numbers")
        if int(np.prod(shape, dtype=object)) * dtype.itemsize > archive.getinfo(name).file_size:
            raise InputError(f"{source}: {name} is cut off; fetch the file again")
    with archive.open(name) as stream:
        return np.lib.format.read_array(stream, allow_pickle=False)


def _header(stream: Any, source: str) -> tuple[tuple[int, ...] | None, np.dtype | None]:
    """The shape and type of an array, both None of one that holds objects."""
    major, _ = np.lib.format.read_magic(stream)
    read_header = {
        1: np.lib.format.read_array_header_1_0,
        2: np.lib.format.read_array_header_2_0,
    }
    if major not in read_header:
        raise InputError(f"{source}: is an array of an unknown version; store it by numpy.save")
    shape, _, dtype = read_header[major](stream)
    return (None, None) if dtype.hasobject else (shape, dtype)


class _Images:
    """The images of one kind, by number of their frame, in an archive that may lack or be empty."""

    def __init__(self, path: Path, kind: str):
        self.file, self.kind = path / f"dataset_{kind}.npz", kind
        self.shape: tuple[int, int] | None = None
        self.names: set[str] = set()
        if not self.file.is_file():
            return
        with reading(str(self.file)), _archive(self.file) as archive:
            self.names = {name for name in archive.namelist() if name.startswith(f"{kind}_")}
            if self.names:
                first = min(self.names)
                with archive.open(first) as stream:
                    shape, _ = _header(stream, f"{self.file}: {first}")
                if shape is None or len(shape) not in (2, 3):
                    raise InputError(f"{self.file}: {first} is no image (height, width)")
                self.shape = (shape[0], shape[1])

    def at(self, frames: Sequence[Mapping[str, Any]]) -> tuple[NDArray[np.int64], Any]:
        """Times and images of those frames of `meta` that have one."""
        held = [(frame["ts"], self._name(frame)) for frame in frames]
        held = [(stamp, name) for stamp, name in held if name in self.names]
        if not held or self.shape is None:
            return np.empty(0, np.int64), None
        t = times(np.array([stamp for stamp, _ in held], float), str(self.file), self.kind)
        names = [name for _, name in held]
        dtype = next(self._images(names[:1])).dtype
        images = DecodedImages(
            lambda row: self._images(names[row:]), (len(t), *self.shape), dtype, str(self.file)
        )
        return t, images

    def _name(self, frame: Mapping[str, Any]) -> str:
        return f"{self.kind}_{whole_number(frame['id'], str(self.file), 'id'):010d}.npy"

    def _images(self, names: Sequence[str]) -> Iterator[NDArray]:
        with reading(str(self.file)), _archive(self.file) as archive:
            for name in names:
                image = _member(archive, name, str(self.file))
                if self.kind == "depth":
                    yield (image / 1000).astype(np.float32)
                elif image.ndim == 3:  # of OpenCV: blue, green, red
                    yield np.rint(image[..., :3] @ LUMA[::-1]).astype(image.dtype)
                else:
                    yield image


def _camera(
    meta: Mapping[str, Any], source: str
) -> tuple[PinholeCamera | None, tuple[int, int], dict[str, str]]:
    """The calibration, (width, height), and what is left out."""
    about = meta["meta"]
    width, height = (whole_number(about[name], source, name) for name in ("res_x", "res_y"))
    model = str(about.get("dist_model"))
    lens = LENSES.get(find_model(model) or "")
    names = ("fx", "fy", "cx", "cy", *(lens.coefficients if lens else ()))
    values = np.array([float(about.get(name, 0.0)) for name in names])
    camera, left_out = calibrated(values[:4], model, values[4:], f"{source}: meta")
    return camera, (width, height), left_out


def _poses(trajectory: Sequence[Mapping[str, Any]], source: str) -> Poses | None:
    held = [(one["ts"], one["cam"]["pos"]) for one in trajectory if "cam" in one]
    if not held:
        return None
    t = times(np.array([stamp for stamp, _ in held], float), source, "pose")
    position = np.array([[pose["t"][axis] for axis in "xyz"] for _, pose in held], float)
    quaternion = np.array([[pose["q"][axis] for axis in "xyzw"] for _, pose in held], float)
    position = vectors(position, (len(t), 3), source, "positions")
    return Poses(t, position, vectors(quaternion, (len(t), 4), source, "quaternions"))


def _imu(samples: Sequence[Mapping[str, Any]], source: str) -> Imu:
    t = times(np.array([sample["ts"] for sample in samples], float), source, "IMU sample")
    gyro, acc = (
        np.array([[sample[name][axis] for axis in "xyz"] for sample in samples], float)
        for name in ("angular_velocity", "linear_acceleration")
    )
    shape = (len(t), 3)
    return Imu(t, vectors(gyro, shape, source, "gyro"), vectors(acc, shape, source, "acc"))
