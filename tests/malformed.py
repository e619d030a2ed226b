"""Files whose container is right and whose structure is wrong, each made from a random generator.

Bytes changed at random hardly ever pass the checksums and tables of a container. These builders
write archives, HDF5 files, images and headers anew with a member, link, type or line that does not
belong there; `crafted` holds the files that were made to do harm. Each returns what was done and
the bytes of a file.
"""

import functools
import struct
import zipfile
import zlib
from io import BytesIO
from typing import Any

import formats
import h5py
import numpy as np
from PIL import Image

SIZE = (40, 30)
EVENTS = formats.events_of(0, 60, SIZE)
NUMBERS = (b"0", b"-1", b"1", b"65536", b"4294967296", b"9" * 25, b"1e400", b"nan", b"\xff", b"")


def _chosen(random, values):
    return values[random.integers(len(values))]


@functools.cache
def _zeros() -> bytes:
    return bytes(130 << 20)


def _archive(members, method=zipfile.ZIP_DEFLATED) -> bytes:
    held = BytesIO()
    with zipfile.ZipFile(held, "w") as archive:
        for name, content in members:
            archive.writestr(zipfile.ZipInfo(name), content, method)
    return held.getvalue()


def _text_events() -> bytes:
    return formats.csv(EVENTS, SIZE, None, " ", seconds=True)


def archives(random) -> tuple[str, bytes]:
    """Zips of text or arrays: other members, methods, names, sizes and flags."""
    if random.random() < 0.5:
        members = [("events.txt", _text_events()), ("calib.txt", b"1 1 1 1 0 0 0 0 0")]
    else:
        members = [(f"{n}.npy", formats.npy(EVENTS, SIZE, (n,), ("<i8",))) for n in "txyp"]
    at = int(random.integers(len(members)))
    name, content = members[at]
    method = zipfile.ZIP_DEFLATED
    kind = _chosen(random, ("name", "twice", "method", "content", "field", "bomb"))
    if kind == "name":
        others = (
            "../" + name,
            "/" + name,
            "a/" + name,
            name + "/",
            "",
            "\0",
            "images.txt",
            "a" * 999,
        )
        members[at] = (_chosen(random, others), content)
    elif kind == "twice":
        members.append((f"a/{name}", content[::-1]))
    elif kind == "method":
        method = _chosen(random, (zipfile.ZIP_STORED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA))
    elif kind == "content":
        members[at] = (name, _chosen(random, (b"", b"\0" * 50, content[:-3], content + b"9")))
    elif kind == "bomb" and random.random() < 0.05:
        members.append(("frames.npy", _zeros()))
    data = bytearray(_archive(members, method))
    if kind == "field":  # of the table at the end: flags, method, times, CRC, sizes, lengths
        entry = data.index(b"PK\x01\x02")
        where = entry + int(random.integers(6, 46))
        data[where] = _chosen(random, (0, 1, 0x7F, 0xFF))
    return kind, bytes(data)


def _virtual(group, name, of="events/x"):
    layout = h5py.VirtualLayout((len(EVENTS),), "i8")
    layout[:] = h5py.VirtualSource(".", of, (len(EVENTS),))
    group.create_virtual_dataset(name, layout)


def _linked(random, group, name) -> str:
    """Replace a dataset by a link or by one that is stored elsewhere."""
    kind = _chosen(random, ("soft", "external", "hard", "storage", "virtual", "gone"))
    del group[name]
    if kind == "soft":
        group[name] = h5py.SoftLink(_chosen(random, (group.name + "/" + name, "/nothing", "/")))
    elif kind == "external":
        group[name] = h5py.ExternalLink(_chosen(random, ("/dev/zero", "a.bin", ".")), "/events/x")
    elif kind == "hard":
        group[name] = _chosen(random, (group, group.file["/"]))
    elif kind == "storage":
        group.create_dataset(name, (len(EVENTS),), "u1", external=[("/dev/zero", 0, 480)])
    elif kind == "virtual":
        _virtual(group, name)
    return kind


def _retyped(random, group, name) -> str:
    """Replace a dataset by one of another type, shape or filter."""
    values, count = group[name][()], len(EVENTS)
    kind = _chosen(random, ("type", "shape", "empty", "filter"))
    del group[name]
    if kind == "type":
        other = _chosen(
            random, ("f2", "f8", ">i4", "c8", "?", "S3", "V4", "text", "ragged", "pair")
        )
        if other == "text":
            group[name] = [str(value) for value in values.tolist()]
        elif other == "ragged":
            group.create_dataset(name, (count,), h5py.vlen_dtype("i4"))
        elif other == "pair":
            group[name] = np.zeros(count, [("a", "i4"), ("b", "f4")])
        else:
            with np.errstate(over="ignore", invalid="ignore"):
                group[name] = np.zeros(count, other) if other == "V4" else values.astype(other)
    elif kind == "shape":
        others = (values[0], values[:, None], values[None], values[:-1], np.r_[values, values])
        group[name] = _chosen(random, others)
    elif kind == "empty":
        group[name] = _chosen(random, (h5py.Empty("i8"), np.empty(0, "i8"), np.empty((0, 4))))
    else:
        filters = (
            {"fletcher32": True},
            {"shuffle": True},
            {"scaleoffset": 3},
            {"compression": "lzf"},
        )
        values = values.astype(np.int64)
        group.create_dataset(name, data=values, chunks=(7,), **_chosen(random, filters))
    return kind


def links(random) -> tuple[str, bytes]:
    """HDF5 of several layouts whose datasets are links, of other types, shapes and filters."""
    images, image_t = np.zeros((2, 30, 40), np.uint8), (20_000, 60_000)
    files = (
        lambda: formats.dsec(EVENTS, SIZE),
        lambda: formats.rvt(EVENTS, SIZE),
        lambda: formats.event_utils(EVENTS, SIZE, images, image_t),
        lambda: formats.mvsec(EVENTS, SIZE, images, image_t),
        lambda: formats.metavision(EVENTS, SIZE),
    )
    held = BytesIO(_chosen(random, files)())
    with h5py.File(held, "r+") as file:
        names: list[str] = []
        file.visititems(
            lambda name, item: names.append(name) if isinstance(item, h5py.Dataset) else None
        )
        path, _, name = _chosen(random, names).rpartition("/")
        group: Any = file[path or "/"]
        simple = group[name].ndim == 1 and group[name].dtype.kind in "iub"
        change = _retyped if simple and len(group[name]) == len(EVENTS) else _linked
        kind = (change if random.random() < 0.6 else _linked)(random, group, name)
    return kind, held.getvalue()


def _png(image) -> bytes:
    held = BytesIO()
    Image.fromarray(image).save(held, "PNG")
    return held.getvalue()


def _resized(png: bytes, width: int, height: int) -> bytes:
    """A PNG whose header tells another size, with a right checksum."""
    head = b"IHDR" + struct.pack(">2I", width, height) + png[24:29]
    return png[:12] + head + struct.pack(">I", zlib.crc32(head)) + png[33:]


def images(random) -> tuple[str, bytes]:
    """Zips of text with images of other sizes, depths, formats and names."""
    grey = random.integers(0, 256, (30, 40)).astype(np.uint8)
    good = _png(grey)
    kind = _chosen(random, ("size", "depth", "format", "header", "cut", "name", "times"))
    name, content, times = "b.png", good, (b"0.02", b"0.06")
    if kind == "size":
        content = _png(grey[: random.integers(1, 30)])
    elif kind == "depth":
        held = BytesIO()
        mode = _chosen(random, ("1", "P", "LA", "RGB", "RGBA", "I;16"))
        Image.fromarray(grey).convert(mode).save(held, "PNG")
        content = held.getvalue()
    elif kind == "format":
        held = BytesIO()
        Image.fromarray(grey).save(
            held, _chosen(random, ("BMP", "JPEG", "GIF", "TIFF", "PPM", "PDF"))
        )
        content = held.getvalue()
    elif kind == "header":
        sizes = ((0, 0), (40, 31), (1 << 16, 1 << 16), (1 << 31, 30), (2**32 - 1, 2**32 - 1))
        content = _resized(good, *_chosen(random, sizes))
    elif kind == "cut":
        content = good[: random.integers(len(good))]
        kind = "cut image"
    elif kind == "name":
        name = _chosen(
            random, ("../b.png", "/dev/zero", "a.png", "", "images.txt", "b\0.png", "é.png")
        )
    else:
        times = (_chosen(random, NUMBERS), b"0.06")
    listed = b"%s a.png\n%s %s\n" % (*times, name.encode())
    members = [("events.txt", _text_events()), ("a.png", good), ("images.txt", listed)]
    if name not in ("", "a.png", "images.txt"):
        members.append((name, content))
    return kind, _archive(members)


def headers(random) -> tuple[str, bytes]:
    """Headers of text with a line removed, repeated or moved, or another number or word in it."""
    files = (
        lambda: formats.evt2(EVENTS, SIZE),
        lambda: formats.evt21(EVENTS, SIZE),
        lambda: formats.evt3(EVENTS, SIZE),
        lambda: formats.dat(EVENTS, SIZE),
        lambda: formats.npy(EVENTS, SIZE),
        lambda: formats.csv(EVENTS, SIZE),
        lambda: formats.dvs128(EVENTS),
    )
    data = _chosen(random, files)()
    separator = b", " if data.startswith(b"\x93NUMPY") else b"\n"
    lines = data.split(separator)
    # The lines of a header, or of a table its first ones.
    count = sum(line.startswith((b"%", b"#", b"\x93", b"'", b"(")) for line in lines[:8]) or 3
    at = int(random.integers(count))
    kind = _chosen(random, ("removed", "repeated", "moved", "number", "word"))
    if kind == "removed":
        del lines[at]
    elif kind == "repeated":
        lines.insert(int(random.integers(count)), lines[at])
    elif kind == "moved":
        lines.insert(int(random.integers(count)), lines.pop(at))
    elif kind == "number":
        digits = [place for place, byte in enumerate(lines[at]) if 48 <= byte < 58]
        if digits:
            place = int(_chosen(random, digits))
            lines[at] = lines[at][:place] + _chosen(random, NUMBERS) + lines[at][place + 1 :]
    else:
        words = lines[at].split(b" ")
        words[random.integers(len(words))] = _chosen(random, (*NUMBERS, b"EVT3", b"x" * 300))
        lines[at] = b" ".join(words)
    return kind, separator.join(lines)


BUILDERS = {"archives": archives, "links": links, "images": images, "headers": headers}
