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

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxevent.camera import PinholeCamera
from jaxevent.errors import InputError
from jaxevent.io import calibrated, open_archive, reading, sensor_size, times, vectors, whole_number
from jaxevent.io.decoded import DecodedImages, decoded
from jaxevent.io.images import grey_of_bgr
from jaxevent.io.numpy_files import events_decoder, open_events, read_header, read_member
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
    columns = open_events(*(path / f"dataset_events_{name}.npy" for name in ("t", "xy", "p")))
    unit = "s" if columns["t"].dtype.kind == "f" else "us"
    events = decoded(events_decoder(columns, unit, source), size, source, options)
    if frames is None and parts["classical"].names:
        left_out["frames"] = (
            f"the times of the {len(parts['classical'].names):,} images in dataset_classical.npz "
            "are pickled in dataset_info.npz; if you trust it, give its meta to "
            "jaxevent.io.evimo.read"
        )
    return Recording(
        path.name, *size, events, frames, camera, poses, samples, extra, left_out=left_out
    )


def _info(path: Path) -> Iterator[tuple[str, NDArray]]:
    """The arrays K and D of numbers; what is pickled is left alone, and named."""
    file = path / "dataset_info.npz"
    if not file.is_file():
        return
    with reading(str(file)), open_archive(file) as archive:
        for name in ("K", "D"):
            if f"{name}.npy" in archive.namelist():
                values = read_member(archive, f"{name}.npy", str(file))
                if values.dtype.kind not in "iuf" or not np.isfinite(values).all():
                    raise InputError(f"{file}: {name} must be finite numbers; correct it")
                yield name, values
        if "meta.npy" in archive.namelist():
            yield "arrays_left_out", np.array(["meta"])


class _Images:
    """The images of one kind, by number of their frame, in an archive that may lack or be empty."""

    def __init__(self, path: Path, kind: str):
        self.file, self.kind = path / f"dataset_{kind}.npz", kind
        self.shape: tuple[int, int] | None = None
        self.names: set[str] = set()
        if not self.file.is_file():
            return
        with reading(str(self.file)), open_archive(self.file) as archive:
            self.names = {name for name in archive.namelist() if name.startswith(f"{kind}_")}
            if self.names:
                first = min(self.names)
                with archive.open(first) as stream:
                    shape, _ = read_header(stream, f"{self.file}: {first}")
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
        with reading(str(self.file)), open_archive(self.file) as archive:
            for name in names:
                image = read_member(archive, name, str(self.file))
                if self.kind == "depth":
                    yield (image / 1000).astype(np.float32)
                elif image.ndim == 3:
                    yield grey_of_bgr(image)
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
