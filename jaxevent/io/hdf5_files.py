"""HDF5 files that need not be trusted: opened, and their datasets checked, before they are read.

Links to other files, datasets made of other files and heaps that libhdf5 would never leave are
refused, and so is a dataset that claims more values than its bytes can hold. Within `trusting`,
files may be made of others.
"""

import contextlib
import contextvars
import functools
import io
import math
import re
import struct
import time
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from jaxevent.errors import InputError, require
from jaxevent.io.checks import check_unfolded, damaged, max_unfolded, reading

_MAX_COMPRESSION_RATIO = 4096  # times smaller than in memory that any filter makes real events
_HEAP_SEARCH_BYTES = 1 << 24  # at either end of a file that are searched for heaps
_MAX_EXAMINED_OBJECTS = 1000  # of a file that are examined for images
_MAX_LISTED_NAMES = 4  # of images in a message
_COPY_REMEDY = (
    "only what a file itself holds is read, so copy all into one file: if you trust it, by "
    "jaxevent convert --trust"
)
_is_trusted = contextvars.ContextVar("is_trusted", default=False)
# An attribute that is one string: its type, its space, then its length, heap and place in that. The
# type and the space are padded in the older format, not in that of HDF5 1.8.
_STRING = re.compile(
    rb"\x19.[\x00\x01]\x00\x10\x00\x00\x00\x10.{11}(?:.{4})?(?:\x01\x00.{6}|\x02\x00.{2})(.{16})",
    re.DOTALL,
)
_HEAP = re.compile(rb"GCOL\x01\x00\x00\x00")  # `bytes.find` is slow among zeros
_HDF5_MAGIC = b"\x89HDF\r\n\x1a\n"
_BLOCK_BYTES = 1 << 18  # bytes that are searched at once
_MAX_MATCH_BYTES = 64  # bytes; more than either of the patterns has


@contextlib.contextmanager
def trusting() -> Iterator[None]:
    """Within the block, open files that are made of others: links, external storage, views."""
    token = _is_trusted.set(True)
    try:
        yield
    finally:
        _is_trusted.reset(token)


def open_file(path: Path) -> h5py.File:
    """Open a file, or raise `InputError`."""
    with reading(path):
        check_heaps(path)
        file = h5py.File(path)
        links: Any = getattr(h5py, "h5l")  # noqa: B009  (its stubs lack it)
        known = (links.TYPE_HARD, links.TYPE_SOFT)
        link = file.id.links.visit(
            lambda name, info: None if info.type in known else name, info=True
        )
        if link is not None and not _is_trusted.get():
            file.close()
            raise InputError(f"{path}: {link.decode()} is a link to another file; {_COPY_REMEDY}")
        return file


def describe_datasets(file: Any, most: int = 8) -> str:
    """Describe the datasets of a file for messages, as "a/t int64 (10,), a/x int16 (10,)".

    Args:
        file: The open file, of h5py.
        most: Number of datasets from which the others are counted only.

    Returns:
        Their names, types and shapes, or "no dataset".
    """
    found: list[str] = []

    def note(name: str, thing: Any) -> None:
        if isinstance(thing, h5py.Dataset):
            text = f"{name} {thing.dtype} {thing.shape}"
            found.append(" ".join(text.split())[:60])

    file.visititems(note)
    more = [f"{len(found) - most:,} more"] if len(found) > most else []
    return ", ".join(found[:most] + more) or "no dataset"


def attribute(of: Any, name: str) -> Any:
    """Read an attribute.

    Only numbers and strings are read: of a damaged type HDF5 2.0 reads memory that is not there.

    Args:
        of: File, group or dataset of h5py.
        name: Name of the attribute.

    Returns:
        A number, an array of numbers, or a text; None if there is no such attribute.

    Raises:
        ValueError: The attribute is of another type.
    """
    if name not in of.attrs:
        return None
    kind = of.attrs.get_id(name).get_type()
    if not isinstance(kind, h5py.h5t.TypeIntegerID | h5py.h5t.TypeFloatID | h5py.h5t.TypeStringID):
        raise ValueError(f"the attribute {name} is of an unknown type")
    value = of.attrs[name]
    return value.decode() if isinstance(value, bytes) else value


def check_heaps(path: Path) -> None:
    """Raise `InputError` for a global heap (of strings) whose end libhdf5 would never find.

    HDF5 2.0 goes on by the size of each piece, and stays where that is 0 or overflows; for a heap
    that an attribute puts past the end of the file it takes gigabytes of memory first. The heaps
    of a file's attributes lie near its start or, if written late, its end: `_HEAP_SEARCH_BYTES`
    bytes of both are searched, once for a file as it is.
    """
    about = path.stat()
    state = about.st_dev, about.st_ino, about.st_size, about.st_mtime_ns
    # Of a file written just now another write might leave the same time.
    settled = abs(time.time_ns() - about.st_mtime_ns) > 2_000_000_000
    (search_heaps if settled else search_heaps.__wrapped__)(path, state)


@functools.lru_cache(maxsize=16)
def search_heaps(path: Path, state: tuple[int, ...]) -> None:
    """Check the heaps of a file, once for each state of it."""
    wrong = damaged(f"{path}: a string or its heap is not valid")
    with path.open("rb", buffering=0) as file:
        length = file.seek(0, 2)
        strings = set[bytes]()
        for begin, end in (
            (0, min(_HEAP_SEARCH_BYTES, length)),
            (max(_HEAP_SEARCH_BYTES, length - _HEAP_SEARCH_BYTES), length),
        ):
            heaps: list[int] = []
            for place, block in _blocks(file, begin, end):
                strings |= {match[1] for match in _STRING.finditer(block)}
                heaps += [place + match.start() for match in _HEAP.finditer(block)]
            if not _all_heaps_end(file, heaps, end):
                raise wrong
        base = _find_start(file, length)
        for count, heap, _ in (struct.unpack("<IQI", string) for string in strings):
            if count and (
                heap >= length or count > length or _read_at(file, heap + base, 4) != b"GCOL"
            ):
                raise wrong


def _blocks(file: io.FileIO, begin: int, end: int) -> Iterator[tuple[int, memoryview]]:
    """Yield blocks of a file from begin to end with their offsets; blocks overlap a little.

    Blocks are overwritten: fresh memory for all of them takes longer than the search.
    """
    scratch = memoryview(bytearray(_BLOCK_BYTES))
    for place in range(begin, end, _BLOCK_BYTES - _MAX_MATCH_BYTES):
        file.seek(place)
        yield place, scratch[: file.readinto(scratch[: end - place])]


def _read_at(file: io.FileIO, place: int, count: int) -> bytes:
    file.seek(place)
    return file.read(count) or b""


def _find_start(file: io.FileIO, length: int) -> int:
    """Find the offset of HDF5 in a file: its start, or a power of two from 512 on."""
    places = [0, *(512 << k for k in range(max(length.bit_length() - 9, 0)))]
    return next(
        (place for place in places if _read_at(file, place, len(_HDF5_MAGIC)) == _HDF5_MAGIC), 0
    )


def _all_heaps_end(file: io.FileIO, heaps: list[int], end: int) -> bool:
    """Return whether each heap of strings comes to its end, or goes on beyond `end`.

    Every place is visited once, as a file of 1 MB can hold 65,536 heaps one inside the other: where
    one comes to a place of another, it goes on from the place at which that one stopped.

    Args:
        file: The file.
        heaps: Offsets of the heaps.
        end: Offset at which the search ends.
    """
    walks: dict[int, int] = {}  # number of the heap that came by, by place
    ends: list[int] = []
    for at in heaps:
        if at + 16 > end:
            continue
        (size,) = struct.unpack("<Q", _read_at(file, at + 8, 8))
        here, stop = at + 16, at + size
        while here + 16 <= min(stop, end):
            before = walks.setdefault(here, len(ends))
            if before < len(ends):
                here = ends[before]
                continue
            index, held = struct.unpack("<H6xQ", _read_at(file, here, 16))
            need = held if index == 0 else 16 + held + -held % 8
            if not 16 <= need <= stop - here:
                return False
            here += need
        ends.append(here)
    return True


def filter_ids(stored: h5py.Dataset) -> list[int]:
    """Return the numbers of the filters that the chunks of a dataset have gone through."""
    properties = stored.id.get_create_plist()
    return [properties.get_filter(i)[0] for i in range(properties.get_nfilters())]


def dataset(file: h5py.File, name: str, source: str, undone: Sequence[int] = ()) -> h5py.Dataset:
    """Open a dataset that can be read and is not larger than its bytes allow.

    Args:
        file: The open file.
        name: Name of the dataset.
        source: Name of the file for messages.
        undone: Filters that the caller undoes itself, if they are all.

    Returns:
        The dataset.

    Raises:
        InputError: There is no such dataset, or it cannot be read safely.
    """
    with reading(f"{source}: {name}"):
        found = file.get(name)
        if not isinstance(found, h5py.Dataset):
            raise InputError(f"{source}: has no dataset {name}; add it or save the recording again")
        if found.dtype.hasobject and h5py.check_string_dtype(found.dtype) is None:
            raise InputError(f"{source}: {name} holds {found.dtype}; store numbers")
        properties = found.id.get_create_plist()
        layout = properties.get_layout()
        if layout == h5py.h5d.VIRTUAL or properties.get_external_count():
            if _is_trusted.get():
                return found
            raise InputError(
                f"{source}: {name} is made of other data sets or files; {_COPY_REMEDY}"
            )
        filters = filter_ids(found)
        stored = found.id.get_storage_size()
        count = found.size or 0
        for code in filters:
            if filters != list(undone) and not h5py.h5z.filter_avail(code):
                _load_filter(code, f"{source}: {name}")
        if filters:
            chunk = math.prod(found.chunks or ())
            size = max(count, chunk) * found.dtype.itemsize
            check_unfolded(size, found.file.id.get_filesize(), f"{source}: {name}")
            if h5py.h5z.FILTER_DEFLATE in filters:
                _check_deflated(found, f"{source}: {name}")
        held = stored * (_MAX_COMPRESSION_RATIO if filters else 1)
        if count * found.dtype.itemsize > held:
            raise damaged(f"{source}: {name} claims {count} values but holds {stored} bytes")
    return found


def find_images(file: h5py.File) -> list[str]:
    """Return the names of datasets that look like images: three or four axes, of 8 or 16 bits.

    Links to other files are not followed, and of large files the first objects are examined.
    """
    found: list[str] = []
    seen = 0

    def visit(name: str, item: h5py.Dataset | h5py.Group) -> bool | None:
        nonlocal seen
        seen += 1
        if isinstance(item, h5py.Dataset) and not name.startswith("extra/"):
            # Of a virtual dataset the shape cannot be read without following it.
            is_virtual = item.id.get_create_plist().get_layout() == h5py.h5d.VIRTUAL
            if not is_virtual and item.dtype in (np.uint8, np.uint16) and item.ndim in (3, 4):
                found.append(name)
        return True if seen >= _MAX_EXAMINED_OBJECTS else None

    file.visititems(visit)
    return found


def describe_images(file: h5py.File) -> dict[str, str]:
    """Return the entry of `Recording.left_out` for images in a file whose frames are not read."""
    names = find_images(file)
    if not names:
        return {}
    listed = ", ".join(names[:_MAX_LISTED_NAMES]) + (
        ", ..." if len(names) > _MAX_LISTED_NAMES else ""
    )
    return {
        "frames": (
            f"{listed} may be images, of another layout or camera; store them as images with times "
            "in a folder or as t and image in HDF5, and add them by jaxevent register"
        )
    }


def _check_deflated(stored: h5py.Dataset, source: str) -> None:
    """Raise `InputError` for a chunk of gzip that unfolds to more than a chunk.

    libhdf5 unfolds all there is, up to 1032 times its bytes; so chunks that could exceed the
    bound are tried here first.
    """
    whole = math.prod(stored.chunks or ()) * stored.dtype.itemsize
    length = stored.file.id.get_filesize()
    large: list[tuple[int, ...]] = []

    def note(chunk: Any) -> None:
        if 1032 * chunk.size > max_unfolded(length):
            large.append(chunk.chunk_offset)

    stored.id.chunk_iter(note)
    for place in large:
        _, data = stored.id.read_direct_chunk(place)
        if len(zlib.decompressobj().decompress(data, whole + 1)) > whole:
            raise damaged(f"{source}: the chunk at {place} unfolds to more than a chunk")


def _load_filter(code: int, source: str) -> None:
    """Make the filter of this number known to HDF5, or raise `InputError`."""
    try:
        require("hdf5plugin", "dsec")
    except InputError as error:
        raise InputError(f"{source} is compressed with a filter of its own; {error}") from error
    if not h5py.h5z.filter_avail(code):
        raise InputError(
            f"{source} is compressed with HDF5 filter {code}, which hdf5plugin does not have; "
            "store it with gzip instead"
        )


def array(file: h5py.File, name: str, source: str) -> NDArray:
    """Read a whole dataset.

    Args:
        file: The open file.
        name: Name of the dataset.
        source: Name of the file for messages.

    Returns:
        The values.

    Raises:
        InputError: There is no such dataset, or it cannot be read safely.
    """
    found = dataset(file, name, source)
    with reading(f"{source}: {name}"):
        return np.asarray(found[()])
