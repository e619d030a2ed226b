"""Events cut, filtered and gathered into images: plain functions of `Events` or a `Recording`.

    recording = events.remove_hot_pixels(jaxevent.load("street.raw"))
    clean = events.filter_background(recording, 5_000)  # us; 0.005 would be seconds
    grid = events.voxel_grid(clean[1.0:1.1], 5)  # (5, height, width)

Functions that change events take `Events` or a `Recording` and return the same type. Frames, camera
and images among the further arrays of a recording change with the events. Events in a file are read
block by block; the result is held in memory. `Events` have no sensor: where it matters, give
`size=(width, height)`. Lengths of time are integers in us or floats in s, as times are everywhere.

Images are arrays [..., y, x]. Within `jax.jit` they are made of `DeviceEvents`, the result of
`to_device`.
"""

from jaxevent.events.filters import (
    crop_time,
    filter_background,
    filter_refractory,
    find_hot_pixels,
    is_hot,
    remove_hot_pixels,
    select_polarity,
)
from jaxevent.events.images import (
    DeviceEvents,
    count_events,
    count_frames,
    event_image,
    time_surface,
    to_device,
    voxel_grid,
)
from jaxevent.events.pixels import crop, downsample, undistort

__all__ = [
    "DeviceEvents",
    "count_events",
    "count_frames",
    "crop",
    "crop_time",
    "downsample",
    "event_image",
    "filter_background",
    "filter_refractory",
    "find_hot_pixels",
    "is_hot",
    "remove_hot_pixels",
    "select_polarity",
    "time_surface",
    "to_device",
    "undistort",
    "voxel_grid",
]
