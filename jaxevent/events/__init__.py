"""Events cut, filtered and gathered into images: plain functions of `Events` or a `Recording`.

    recording = events.remove_hot_pixels(jaxevent.load("street.raw"))
    clean = events.filter_background(recording, 5_000)  # us; 0.005 would be seconds
    grid = events.voxel_grid(clean[1.0:1.1], 5)  # (5, height, width)

What changes events takes `Events` or a `Recording` and returns the same. Of a recording, frames,
camera and images among the further arrays change with the events. Events that were left in a file
are read block by block; those that remain are held in memory. `Events` alone do not tell the
sensor: where it counts, give `size=(width, height)`. Lengths of time are integers in us or floats
in s, as times are everywhere.

Images are arrays [..., y, x]. Those who gather them within `jax.jit` give `DeviceEvents`, made by
`to_device`, in place of events.
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
