"""The MATLAB layout of the asynchronous Kalman filter and HDR recordings, v5 and v7.3:

    events      (N, 4)     t (us), x, y, p; x and y count from 1, p is 0/1 or -1/1; or (4, N)
    image       (H, W, K)  uint8, uint16 or floats in [0, 1]
    time_image  (K,)       mid-exposure times (us)
    exposure    (K,) or scalar  us; absent: unknown
    f_Q         (256,)     certainty of each grey level, see `Recording.response`
    ct          scalar     contrast threshold
    HDR_mat     (H, W) or (H, W, K), in colour (H, W, 3) or (H, W, 3, K)  HDR reference

Only `events` is required, and the size where there is no `image`. f_Q, ct, HDR_mat and every other
numeric variable are kept in `Recording.extra`, HDR_mat as [y, x] or [frames, y, x]. HDR_mat in
colour becomes the mean of its three channels, as in the authors' programs; (H, W, 3) is colour
unless there are three frames. MATLAB's rows and columns (1 x N) become vectors.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from jaxevent.errors import InputError
from jaxevent.io import checked_events, reading, sensor_size, times
from jaxevent.recording import Events, Frames, Recording


def read_v5(path: Path, size: tuple[int, int] | None) -> Recording:
    """Read a v5 file; `size` is (width, height). Raises `InputError` for bad input."""
    import scipy.io

    with reading(str(path)):
        variables = scipy.io.loadmat(path)
    return _recording(
        path, size, {name: v for name, v in variables.items() if not name.startswith("__")}
    )


def read_v73(path: Path, size: tuple[int, int] | None) -> Recording:
    """Read a v7.3 file; `size` is (width, height). Raises `InputError` for bad input."""
    import h5py

    variables = {}
    with reading(str(path)), h5py.File(path) as file:
        for name, dataset in file.items():
            if isinstance(dataset, h5py.Dataset) and dataset.dtype.kind in "biuf":
                with reading(f"{path}: {name}"):
                    # MATLAB stores the shape of an empty array as its data, and all axes reversed.
                    empty = "MATLAB_empty" in dataset.attrs and dataset.attrs["MATLAB_empty"]
                    stored = dataset[()]
                    variables[name] = np.zeros(stored.astype(int)) if empty else stored.T
    return _recording(path, size, variables)


def _recording(path: Path, size: tuple[int, int] | None, variables: dict) -> Recording:
    arrays: dict[str, NDArray] = {
        name: value
        for name, value in variables.items()
        if isinstance(value, np.ndarray) and value.dtype.kind in "biuf"
    }
    if "events" not in arrays:
        raise InputError(
            f"{path}: has no numeric variable events; store it as N x 4 (t in us, x, y, p)"
        )
    columns = arrays.pop("events")
    frames = _frames(path, arrays) if "image" in arrays else None
    otherwise = f"{path}: has no image to tell the sensor's size;"
    size = sensor_size(size, frames=frames, otherwise=otherwise)
    events = _events(path, columns, size)
    extra = {name: _squeeze(value) for name, value in arrays.items() if name != "HDR_mat"}
    if "HDR_mat" in arrays:
        number = 0 if frames is None else len(frames)
        extra["HDR_mat"] = _reference(arrays["HDR_mat"], number, f"{path}: HDR_mat")
    return Recording(path.stem, *size, events, frames, extra=extra)


def _events(path: Path, columns: NDArray, size: tuple[int, int]) -> Events:
    source = f"{path}: events"
    if columns.size == 0:
        return Events.empty()
    if columns.ndim != 2 or 4 not in columns.shape:
        raise InputError(
            f"{source} has shape {columns.shape}; store it as N x 4 (t in us, x, y, p)"
        )
    t, x, y, p = columns.T if columns.shape[1] == 4 else columns
    return checked_events(times(t, source, "event", scale=1.0), x, y, p, size, source, origin=1)


def _frames(path: Path, arrays: dict[str, NDArray]) -> Frames | None:
    images = arrays.pop("image")
    if images.size == 0:
        return None
    if images.dtype.kind == "f" and images.max() > 1:
        raise InputError(
            f"{path}: image is {images.dtype} with values up to {images.max():g}; store grey "
            "levels as uint8, or floats scaled to [0, 1]"
        )
    if images.ndim == 2:
        images = images[:, :, None]
    images = _frames_first(images, f"{path}: image")
    if "time_image" not in arrays:
        raise InputError(f"{path}: image has no times; add time_image, mid-exposure times in us")
    source = f"{path}: time_image"
    t = times(np.ravel(arrays.pop("time_image")), source, "image", scale=1.0)
    if "exposure" in arrays:
        source = f"{path}: exposure"
        exposure = times(np.ravel(arrays.pop("exposure")), source, "image", scale=1.0)
        if len(exposure) == 1:
            exposure = np.full_like(t, exposure[0])
    else:
        exposure = np.zeros_like(t)
    return Frames(t, images, exposure)


def _frames_first(images: NDArray, source: str) -> NDArray:
    """[y, x, frame] as contiguous [frame, y, x]; [y, x] as it is."""
    if images.ndim not in (2, 3):
        raise InputError(f"{source} has shape {images.shape}; store grey images as H x W x K")
    return np.ascontiguousarray(np.moveaxis(images, 2, 0) if images.ndim == 3 else images)


def _reference(images: NDArray, frames: int, source: str) -> NDArray:
    """HDR_mat as grey [frame, y, x] or [y, x]."""
    colour = images.ndim == 4 or (images.ndim == 3 and images.shape[2] == 3 and frames != 3)
    if colour and images.shape[2] != 3:
        raise InputError(
            f"{source} has shape {images.shape}; store it as H x W x K, or in colour as "
            "H x W x 3 x K"
        )
    return _frames_first(images.mean(axis=2) if colour else images, source)


def _squeeze(value: NDArray) -> NDArray:
    return np.squeeze(value) if value.size else value.reshape(0)
