"""Folders of published data sets, as recordings with their ground truth.

    recordings = jaxevent.datasets.open("mvsec", "/data/mvsec")
    recordings.names                         # ('indoor_flying1', 'indoor_flying2', ...)
    recordings["indoor_flying1"].poses       # loaded when needed
    for recording in recordings:
        ...

Nothing is downloaded. A recording is found in any folder below, at the places that `LAYOUTS` lists:

    name     files                                  ground truth
    ijrr     folders with events.txt, *.zip         poses, IMU
    dsec     events/left/events.h5, events_left     `disparity`, `flow`
    mvsec    *_data.hdf5                            poses, IMU, `depth`, `flow`
    m3ed     *_data.h5                              poses, `depth`
    hdr      *.mat of the AKF's authors             `HDR_mat`, where it is there
    ahdr     the same                               `HDR_mat`
    evimo2   folders with dataset_events_t.npy      none: see `jaxevent.io.folders`

`depth`, `disparity` and `flow` are in `Recording.extra`, as `jaxevent.io.truth` describes, with the
layouts' sources; the readers of `jaxevent.io` describe the recordings' own. In configurations of
`fit` and `evaluate`, "mvsec:/data/mvsec" stands for all recordings of a folder.
"""

import dataclasses
import os
from collections.abc import Iterator
from pathlib import Path

from jaxevent.errors import InputError
from jaxevent.io import load, truth
from jaxevent.io.checks import reading
from jaxevent.parameters import check_choice
from jaxevent.recording import Recording


@dataclasses.dataclass(frozen=True)
class Layout:
    """Layout of the recordings of a data set in a folder.

    Attributes:
        pattern: Glob of a recording's file, in which {side} is the camera.
        up: Number of levels above the file of the folder that names a recording; 0: the file does.
        end: End of the name that is left out.
        loads_folder: Whether the file's folder is loaded, not the file.
        has_sides: Whether a file holds two cameras, left and right.
        size: (width, height) in px, where files do not state it.
    """

    pattern: str
    up: int = 0
    end: str = ""
    loads_folder: bool = False  # the file's folder is what is loaded
    has_sides: bool = False  # a file holds two cameras, left and right
    size: tuple[int, int] | None = None  # (width, height), where files do not state it


LAYOUTS: dict[str, tuple[Layout, ...]] = {
    "ijrr": (
        Layout("events.txt", up=1, loads_folder=True),
        Layout("*.zip", end=".zip"),
    ),
    "dsec": (
        Layout("events/{side}/events.h5", up=3, size=(640, 480)),
        Layout("events_{side}/events.h5", up=2, size=(640, 480)),
    ),
    "mvsec": (Layout("*_data.hdf5", end="_data.hdf5", has_sides=True),),
    "m3ed": (Layout("*_data.h5", end="_data.h5", has_sides=True),),
    "hdr": (Layout("*.mat", end=".mat"),),
    "ahdr": (Layout("*.mat", end=".mat"),),
    "evimo2": (Layout("dataset_events_t.npy", up=1, loads_folder=True),),
}


@dataclasses.dataclass(frozen=True)
class Dataset:
    """Recordings of a folder, in the order of their names, each loaded when it is needed.

    Attributes:
        paths: Paths by name, as `jaxevent.load` takes them.
        side: Camera, "left" or "right".
        has_sides: Whether a file holds two cameras.
        size: (width, height) in px, where files do not state it.
        in_memory: Whether events and images are read into memory.
    """

    paths: dict[str, Path]
    side: str
    has_sides: bool
    size: tuple[int, int] | None
    in_memory: bool

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the recordings."""
        return tuple(self.paths)

    def __len__(self) -> int:
        return len(self.paths)

    def __iter__(self) -> Iterator[Recording]:
        return (self[name] for name in self.paths)

    def __getitem__(self, which: str | int) -> Recording:
        """Load a recording by its name, or by its number in `names`."""
        if isinstance(which, int):
            which = self.names[which]
        check_choice(which, "recording", self.paths)
        path, stream = self.paths[which], self.side if self.has_sides else None
        recording = load(path, self.size, self.in_memory, stream=stream)
        extra = {**recording.extra, **truth.read_images(path, self.side)}
        return dataclasses.replace(recording, name=which, extra=extra)


def open(
    name: str,
    folder: str | os.PathLike[str],
    side: str = "left",
    size: tuple[int, int] | None = None,
    in_memory: bool = False,
) -> Dataset:
    """Find the recordings of a data set below a folder.

    Args:
        name: A key of `LAYOUTS`.
        folder: The data set, or a part of it, as it was downloaded and unpacked.
        side: Camera, of files that hold two, "left" or "right".
        size: (width, height) in px, where files do not state it.
        in_memory: Whether events and images are read into memory; depth and flow stay in their
            files in any case.

    Returns:
        The recordings, not loaded yet.

    Raises:
        InputError: There is no such data set, or none of its recordings below the folder.
    """
    folder = Path(folder)
    check_choice(name, "data set", LAYOUTS)
    if side not in ("left", "right"):
        raise InputError(f"side is {side!r}; give left or right")
    found: dict[str, Path] = {}
    layouts = LAYOUTS[name]
    with reading(str(folder)):
        for layout in layouts:
            for file in folder.rglob(layout.pattern.format(side=side)):
                path = file.parent if layout.loads_folder else file
                found.setdefault(_name(file, folder, layout), path)
    if not found:
        patterns = " and no ".join(layout.pattern.format(side=side) for layout in layouts)
        raise InputError(
            f"{folder}: has no recording of {name}, no {patterns}; give the folder to which the "
            "data set was unpacked"
        )
    return Dataset(
        dict(sorted(found.items())), side, layouts[0].has_sides, size or layouts[0].size, in_memory
    )


def _name(file: Path, folder: Path, layout: Layout) -> str:
    """Return the name of a recording: its path below the folder, without the common parts."""
    named = file.parents[layout.up - 1] if layout.up else file
    text = named.resolve().name if named == folder else named.relative_to(folder).as_posix()
    return text.removesuffix(layout.end)
