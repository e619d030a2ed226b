"""Files of dense optical flow: HDF5, PNG images of DSEC's kind, and a video in colours."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from jaxevent.errors import InputError
from jaxevent.event_flow import EventFlow
from jaxevent.io import png
from jaxevent.io.checks import reading
from jaxevent.io.output import CLOCK_UNIT, complete, complete_hdf5
from jaxevent.progress import bar
from jaxevent.recording import Times, microseconds
from jaxevent.show.images import video_writer

PNG_SCALE, PNG_ZERO = 128, 2**15  # of DSEC: the stored number of d px is d * 128 + 2^15
SPEED_PERCENTILE = 98  # of valid pixels; the speed that has full colour
N_LIMIT_TIMES = 8  # times at which that speed is measured

FlowWriter = Callable[[EventFlow, Times, Path, bool | None], None]


def flow_writer(out: Path) -> FlowWriter:
    """Return the function that writes flow to a file of some suffix.

    It is called as `flow_writer(out)(flow, times, out, progress)`, with sorted times, us or s.

    Args:
        out: File, or folder if it has no suffix.

    Returns:
        `write_flow_hdf5`, `write_flow_video` or `write_flow_images`.

    Raises:
        InputError: The suffix is not .h5, .hdf5, .mp4 or none.
    """
    kinds: dict[str, FlowWriter] = {
        ".h5": write_flow_hdf5,
        ".hdf5": write_flow_hdf5,
        ".mp4": write_flow_video,
        "": write_flow_images,
    }
    if out.suffix.lower() not in kinds or not out.name:
        raise InputError(
            f"{out}: flow cannot be stored as {out.suffix or 'a folder in use'}; end the name in "
            ".h5 or .mp4, or leave out the suffix for a new folder of PNG images"
        )
    return kinds[out.suffix.lower()]


def write_flow_hdf5(flow: EventFlow, times: Times, out: Path, progress: bool | None = None) -> None:
    """Write flow, its covariance and validity as HDF5.

    Args:
        flow: The flow.
        times: (T,) sorted times; integers are us, floats s.
        out: File to write.
        progress: Whether to show a progress bar; by default in a terminal.
    """
    us, (h, w) = _stamps(times), flow.shape
    fields = {
        "flow": ((h, w, 2), "f4", "px/s, along x and y"),
        "covariance": ((h, w, 2, 2), "f4", "(px/s)^2"),
        "valid": ((h, w), "?", "whether events determine the flow"),
    }
    with complete_hdf5(out, "flow_from_events", flow.params) as (file, check):
        file.attrs["recording"] = flow.recording.name
        file["t"] = us
        file["t"].attrs["unit"] = CLOCK_UNIT
        for name, (shape, kind, unit) in fields.items():
            stored = file.create_dataset(
                name, (len(us), *shape), kind, chunks=(1, *shape), compression="gzip",
                compression_opts=1, shuffle=True,
            )  # fmt: skip
            stored.attrs["unit"] = unit
        for row in bar(range(len(us)), desc="flow", unit="image", progress=progress):
            found = flow(us[row : row + 1], extrapolate=True)
            for name, values in zip(fields, found, strict=True):
                file[name][row] = values[0]
            check()


def write_flow_images(
    flow: EventFlow, times: Times, out: Path, progress: bool | None = None
) -> None:
    """Write displacements between consecutive times as PNG images of the kind of DSEC.

    Image k holds the displacements along x and y, px, from times[k] to times[k + 1] of the points
    that its pixels see at times[k], and which of them are valid; see `encode_flow`. The file
    forward_timestamps.txt has both times of each, in us.

    Args:
        flow: The flow.
        times: (T,) sorted times; integers are us, floats s.
        out: Folder to write.
        progress: Whether to show a progress bar; by default in a terminal.

    Raises:
        InputError: There are fewer than two times, or they do not rise.
    """
    us = _stamps(times)
    if (np.diff(us) <= 0).any():
        raise InputError(
            f"{out}: images show displacements from one time to a later; sort the times"
        )
    if len(us) < 2:
        raise InputError(
            f"{out}: images show displacements from one time to the next, of which there are "
            f"{len(us)}; give two or more, or write .h5"
        )
    y, x = (c.ravel() for c in np.mgrid[: flow.shape[0], : flow.shape[1]])
    with complete(out, directory=True) as partial:
        lines = ["# from_timestamp_us, to_timestamp_us\n"]
        for row in bar(range(len(us) - 1), desc="flow", unit="image", progress=progress):
            first, last = (int(t) for t in us[row : row + 2])
            there = flow.paths(first, last, last).carry(x, y, np.full(x.shape, first))
            d = np.stack([there[0] - x, there[1] - y], -1).reshape(*flow.shape, 2)
            valid = flow(us[row : row + 1], extrapolate=True)[2][0]
            (partial / f"{row:06d}.png").write_bytes(encode_flow(d, valid))
            lines.append(f"{first}, {last}\n")
        (partial / "forward_timestamps.txt").write_text("".join(lines))


def encode_flow(displacement: NDArray[np.floating], valid: NDArray[np.bool_]) -> bytes:
    """Encode a displacement as a PNG image of 16 bits, as the DSEC data set stores flow.

    Red and green are d * 128 + 2^15 for the displacement d along x and y in px, blue is 1 where it
    is valid. Displacements beyond 255 px are not valid.

    Args:
        displacement: (H, W, 2) px.
        valid: (H, W).

    Returns:
        The bytes of the file.
    """
    code = np.rint(displacement * PNG_SCALE + PNG_ZERO)
    known = valid & ((code >= 0) & (code < 2**16)).all(-1)
    planes = np.where(known[..., None], code, PNG_ZERO), known[..., None]
    return png.encode(np.concatenate(planes, -1).astype(np.uint16))


def decode_flow(image: bytes | str | Path) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Decode a PNG image of flow, of `write_flow_images` or of the DSEC data set.

    Pillow and imageio read 8 of its 16 bits.

    Args:
        image: Path of the file, or its bytes.

    Returns:
        Displacement (H, W, 2) along x and y in px, NaN where it is not valid, and validity (H, W).

    Raises:
        InputError: The file is missing, damaged or another image.
    """
    source = "the image" if isinstance(image, bytes) else str(image)
    with reading(source):
        data = image if isinstance(image, bytes) else Path(image).read_bytes()
    code = png.decode(data, source)
    if code is None or code.ndim != 3:
        raise InputError(
            f"{source}: is no PNG image of 16 bits in three colours; give one of flow, as "
            "`jaxevent flow --out FOLDER` and DSEC store it"
        )
    valid = code[..., 2] > 0
    displacement = (code[..., :2].astype(np.float32) - PNG_ZERO) / PNG_SCALE
    return np.where(valid[..., None], displacement, np.float32(np.nan)), valid


def write_flow_video(
    flow: EventFlow, times: Times, out: Path, progress: bool | None = None
) -> None:
    """Write flow as a video in colours, see `flow_colours`; what is not valid is black.

    Args:
        flow: The flow.
        times: (T,) sorted times; integers are us, floats s.
        out: File to write.
        progress: Whether to show a progress bar; by default in a terminal.
    """
    us = _stamps(times)
    some = us[np.unique(np.linspace(0, len(us) - 1, N_LIMIT_TIMES).round().astype(int))]
    speeds = []
    for t in some:
        mean, _, valid = flow([t], extrapolate=True)
        speeds.append(np.linalg.norm(mean[valid], axis=-1))
    fastest = float(np.percentile(np.concatenate([*speeds, [0.0]]), SPEED_PERCENTILE))
    spacing = np.median(np.diff(us)) if len(us) > 1 else 40_000
    with video_writer(out, min(1e6 / float(spacing), 60.0)) as write:
        for t in bar(us, desc="flow", unit="image", progress=progress):
            mean, _, valid = flow([t], extrapolate=True)
            write(np.where(valid[0][..., None], flow_colours(mean[0], fastest), 0))


def _stamps(times: Times) -> NDArray[np.int64]:
    """Convert times of any kind to a row of us."""
    return np.atleast_1d(microseconds(times))


def flow_colours(flow: NDArray[np.floating], fastest: float | int) -> NDArray[np.uint8]:
    """Colour a flow: the hue is the direction, and the paler the slower.

    Right is red, down is yellow-green, left is cyan, up is violet.

    Args:
        flow: (..., 2) px/s.
        fastest: Speed of full colour, px/s.

    Returns:
        (..., 3) colours.
    """
    turn = np.arctan2(flow[..., 1], flow[..., 0])[..., None]
    phase = turn - np.arange(3) * 2 * np.pi / 3
    hue = np.clip(0.5 + np.cos(phase), 0, 1)
    strength = np.clip(np.linalg.norm(flow, axis=-1, keepdims=True) / max(fastest, 1e-9), 0, 1)
    return np.rint(255 * (1 - strength * (1 - hue))).astype(np.uint8)
