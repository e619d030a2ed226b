"""Recordings of EVREAL (Ercan et al., CVPRW 2023): a folder of NumPy arrays for each sequence.

    events_ts.npy            (events,) or (events, 1)   float seconds, sorted
    events_xy.npy            (events, 2)                x and y
    events_p.npy             (events,) or (events, 1)   bool or 0/1
    images.npy               (frames, height, width, 1), or without the last axis
    images_ts.npy            (frames,) or (frames, 1)   float seconds
    image_event_indices.npy  events before each image; not needed
    metadata.json            {"sensor_resolution": [height, width]}

The layout is that of the project ercanburak/EVREAL, dataset.py and tools/bag_to_npy.py. Only the
events are required. Where there is no metadata.json the images tell the sensor's size. Images of
three channels are taken as blue, green, red, OpenCV's order, and become grey (ITU-R 601 luma);
`extra["rgb"]` keeps their colours. Exposures are unknown: 0.

Decoder. NumPy's own files, read here; checked against files written by the layout.
"""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxevent.errors import InputError
from jaxevent.io import reading, sensor_size, whole_number
from jaxevent.io.columns import first_and_last
from jaxevent.io.decoded import DecodedImages, decoded
from jaxevent.io.images import grey_of_bgr
from jaxevent.io.numpy_files import events_decoder, open_events
from jaxevent.io.options import ReadOptions
from jaxevent.io.time_units import clock_of, infer_unit
from jaxevent.recording import Frames, Recording


def knows(folder: Path) -> bool:
    """Whether a folder holds a sequence."""
    return all((folder / f"events_{name}.npy").is_file() for name in ("ts", "xy", "p"))


def read(path: Path, options: ReadOptions) -> Recording:
    """Read a folder.

    Unless `options.in_memory`, events and images stay in their files. Raises `InputError` for bad
    input.
    """
    source = str(path)
    columns = open_events(*(path / f"events_{name}.npy" for name in ("ts", "xy", "p")))
    images, left_out = _open_images(path)
    told = _told_size(path)
    if told is None and images is not None:
        told = (images.shape[2], images.shape[1])
    otherwise = f"{path}: neither metadata.json nor an image tells the sensor's size;"
    size = sensor_size(options.size, told, frames=None, otherwise=otherwise)
    count = len(columns["t"])
    sample = first_and_last(lambda rows: {name: columns[name][rows] for name in "txy"}, count)
    usual = "s" if columns["t"].dtype.kind == "f" else "us"
    unit = infer_unit(sample, count, size, source, options, usual=usual)
    events = decoded(events_decoder(columns, unit.name, source), size, source, options)
    notes = list(unit.notes)
    frames, extra = None, {}
    if images is not None:
        with reading(str(path / "images_ts.npy")):
            stamps = np.load(path / "images_ts.npy", allow_pickle=False)
        if stamps.size != len(images) or stamps.ndim not in (1, 2):
            raise InputError(
                f"{path}: images.npy holds {len(images)} images, images_ts.npy times of shape "
                f"{stamps.shape}; there must be one time for each image"
            )
        ends = [*events[:1].t, *events[max(count - 1, 0) :].t]
        clock = clock_of(unit, sample["t"], ends)
        t = clock.read(stamps.ravel(), source, "image", notes)
        grey, rgb = _of_channels(images, source, notes)
        if len(t):
            grey, rgb = (_held(one, options.in_memory) for one in (grey, rgb))
            frames = Frames(t, grey, np.zeros_like(t))
            extra = {} if rgb is None else {"rgb": rgb}
    return Recording(
        path.name, *size, events, frames, extra=extra, notes=tuple(notes), left_out=left_out
    )


def _held(images: Any, in_memory: bool) -> Any:
    return np.asarray(images) if in_memory and images is not None else images


def _told_size(path: Path) -> tuple[int, int] | None:
    file = path / "metadata.json"
    if not file.is_file():
        return None
    with reading(str(file)):
        told = json.loads(file.read_text(encoding="utf-8-sig"))
    sides = told.get("sensor_resolution") if isinstance(told, dict) else None
    if sides is None:
        return None
    if not isinstance(sides, list) or len(sides) not in (2, 3):  # the third counts channels
        raise InputError(f"{file}: sensor_resolution must be [height, width], not {sides}")
    height, width = (whole_number(side, str(file), "a side of the size") for side in sides[:2])
    return width, height


def _open_images(path: Path) -> tuple[NDArray | None, dict[str, str]]:
    """Open the images, left in their file, or say why they are left out."""
    file = path / "images.npy"
    if not file.is_file():
        return None, {}
    if not (path / "images_ts.npy").is_file():
        return None, {"frames": "images.npy has no images_ts.npy with its times; add that"}
    with reading(str(file)):
        images = np.load(file, mmap_mode="r", allow_pickle=False)
    if images.ndim not in (3, 4) or (images.ndim == 4 and images.shape[3] not in (1, 3)):
        raise InputError(
            f"{file}: has shape {images.shape}; it must be (frames, height, width), with one or "
            "three channels behind these"
        )
    return images, {}


def _of_channels(images: NDArray, source: str, notes: list[str]) -> tuple[Any, Any]:
    """The images in grey, and in colour (frames, height, width, 3) or None; left in their file."""

    def left(of_one: Callable[[NDArray], NDArray], shape: tuple[int, ...]) -> DecodedImages:
        return DecodedImages(
            lambda row: (of_one(np.array(image)) for image in images[row:]),
            shape,
            images.dtype,
            f"{source}: images.npy",
        )

    shape = images.shape[:3]
    if images.ndim == 3:
        return left(lambda image: image, shape), None
    if images.shape[3] == 1:
        return left(lambda image: image[..., 0], shape), None
    notes.append("images of three channels are taken as blue, green, red")
    rgb = None
    if images.dtype == np.uint8:
        rgb = left(lambda image: image[..., ::-1], images.shape)
    return left(grey_of_bgr, shape), rgb
