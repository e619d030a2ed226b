"""Files made to hang, kill or bloat a reader, or to read what is not theirs.

Each builder writes one below a folder and returns what `load` is given.
"""

import bz2
import os
import struct
import zipfile
import zlib
from pathlib import Path

import formats
import h5py
import lz4.frame
import numpy as np
import scipy.io
from PIL import Image

SIZE = (40, 30)
EVENTS = formats.events_of(0, 400, SIZE)
ZEROS = bytes(1 << 20)
MOST = 160  # MB to which a bomb unfolds


def inside(folder: Path, **replaced) -> Path:
    """A file of DSEC's layout, with one dataset of events replaced by a function of its group."""
    path = folder / "a.h5"
    path.write_bytes(formats.dsec(EVENTS, SIZE))
    with h5py.File(path, "r+") as file:
        group = file["events"]
        assert isinstance(group, h5py.Group)
        for name, make in replaced.items():
            del group[name]
            make(group, name)
    return path


def hdf5_external_link(folder):
    os.mkfifo(folder / "pipe")
    link = h5py.ExternalLink(str(folder / "pipe"), "/t")
    return inside(folder, t=lambda group, name: group.__setitem__(name, link))


def hdf5_soft_link_to_an_external_one(folder):
    def make(group, name):
        group.file["other"] = h5py.ExternalLink("/dev/zero", "/t")
        group[name] = h5py.SoftLink("/other")

    return inside(folder, t=make)


def hdf5_external_storage(folder):
    """Any file that the reader's user may read."""
    (folder / "secret").write_bytes(bytes(400))
    files = [(str(folder / "secret"), 0, h5py.h5f.UNLIMITED)]
    return inside(
        folder, p=lambda group, name: group.create_dataset(name, (400,), "u1", external=files)
    )


def _virtual(of: str, at: str, count=400):
    def make(group, name):
        layout = h5py.VirtualLayout((count,), "i8")
        layout[:400] = h5py.VirtualSource(of, at, (400,))
        group.create_virtual_dataset(name, layout)

    return make


def hdf5_virtual_of_itself(folder):
    return inside(folder, t=_virtual(".", "events/t"))


def hdf5_virtual_of_a_pipe(folder):
    os.mkfifo(folder / "pipe")
    return inside(folder, t=_virtual(str(folder / "pipe"), "t"))


def hdf5_virtual_of_a_thousand_million(folder):
    return inside(folder, **{name: _virtual(".", "t", 10**9) for name in "txyp"})


def hdf5_virtual_events_in_four_columns(folder):
    with h5py.File(folder / "a.h5", "w") as file:
        layout = h5py.VirtualLayout((400, 4), "i8")
        layout[:] = h5py.VirtualSource(".", "events", (400, 4))
        file.create_virtual_dataset("events", layout)
    return folder / "a.h5"


def hdf5_chunk_of_gzip(folder):
    """One of 400 values that unfolds to 160 MB; libhdf5 has no bound."""

    def make(group, name):
        options = dict(chunks=(400,), compression="gzip")
        stored = group.create_dataset(name, (400,), "i8", **options)
        packer = zlib.compressobj(9)
        pieces = [packer.compress(stored[()].tobytes())]
        pieces += [packer.compress(ZEROS) for _ in range(MOST)]
        stored.id.write_direct_chunk((0,), b"".join(pieces) + packer.flush())

    return inside(folder, t=make)


def hdf5_data_of_gzip(folder):
    def make(group, name):
        count = MOST << 20
        group.create_dataset(name, (count,), "u1", chunks=(1 << 22,), compression="gzip", data=None)
        group[name][:: 1 << 22] = 0

    return inside(folder, p=make)


def hdf5_heaps_one_inside_the_other(folder):
    """65,536 of them, each of which says that all the others are its pieces."""

    def make(group, name):
        heap = b"GCOL\x01\0\0\0" + struct.pack("<Q", 1 << 20)
        pieces = (b"GCOL\x01\0\0\0" + struct.pack("<Q", 16)) * (1 << 16)
        group[name] = np.frombuffer(heap + pieces, "u1")

    return inside(folder, p=make)


def hdf5_string_of_gigabytes(folder):
    """It claims 4 GB, which libhdf5 takes before it looks; its space is damaged too."""
    path = folder / "a.h5"
    with h5py.File(path, "w") as file:
        file.attrs["format"] = "jaxevent"
    content = bytearray(path.read_bytes())
    length_and_heap = struct.pack("<IQ", len("jaxevent"), content.index(b"GCOL"))
    at = content.index(length_and_heap)
    content[at - 4 : at + 4] = b"\xff" * 8
    path.write_bytes(content)
    return path


def hdf5_one_image_many_times(folder):
    path = folder / "a.h5"
    path.write_bytes(formats.event_utils(EVENTS, SIZE))
    with h5py.File(path, "r+") as file:
        image = file.create_dataset("images/image000000000", (1000, 1000), "u1", compression="gzip")
        image.attrs["timestamp"] = 0.1
        image[()] = 0
        for i in range(1, MOST):
            file[f"images/image{i:09d}"] = image
    return path


def text_zip(folder):
    with zipfile.ZipFile(folder / "a.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        with archive.open("events.txt", "w", force_zip64=True) as file:
            for _ in range(MOST):
                file.write(b"0.5 1 1 1\n" * (len(ZEROS) // 10))
    return folder / "a.zip"


def text_images_named_many_times(folder):
    Image.fromarray(np.zeros((3000, 4000), np.uint8)).save(folder / "a.png")
    (folder / "events.txt").write_text("0.5 1 1 1\n")
    (folder / "images.txt").write_text("".join(f"{i / 10} a.png\n" for i in range(70)))
    return folder


def npz_of_zeros(folder):
    arrays = {name: getattr(EVENTS, name) for name in "txyp"}
    np.savez_compressed(folder / "a.npz", **arrays, note=np.zeros(MOST << 20, "u1"))
    return folder / "a.npz"


def npz_of_no_array(folder):
    arrays = {name: getattr(EVENTS, name) for name in "txyp"}
    np.savez(folder / "a.npz", **arrays)
    with zipfile.ZipFile(folder / "a.npz", "a") as archive:
        archive.writestr("frames.npy", b"not an array")
    return folder / "a.npz"


def npz_of_columns_for_polarity(folder):
    arrays = {name: getattr(EVENTS, name) for name in "txy"}
    np.savez(folder / "a.npz", **arrays, p=EVENTS.p[:, None])
    return folder / "a.npz"


def mat_of_zeros(folder):
    arrays = {"events": np.ones((4, 4)), "note": np.zeros((MOST << 20, 1), np.uint8)}
    scipy.io.savemat(folder / "a.mat", arrays, do_compression=True)
    return folder / "a.mat"


def mat_of_an_empty_array_with_a_size(folder):
    with h5py.File(folder / "a.mat", "w", userblock_size=512) as file:
        file["events"] = np.array([1 << 20, 1 << 20], np.uint64)
        file["events"].attrs["MATLAB_empty"] = np.uint8(1)
    with open(folder / "a.mat", "r+b") as stored:
        stored.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")
    return folder / "a.mat"


def bag_with_a_chunk_of_bz2(folder):
    path = folder / "a.bag"
    formats.bag(path, EVENTS, SIZE)
    content = path.read_bytes()
    at = content.index(b"op=\x05\x0f\0\0\0compression=lz4") - 8  # the header's length
    (head,) = struct.unpack_from("<I", content, at)
    (length,) = struct.unpack_from("<I", content, at + 4 + head)
    packer = bz2.BZ2Compressor()
    packed = b"".join([packer.compress(ZEROS) for _ in range(MOST)]) + packer.flush()
    assert len(packed) <= length
    head_bytes = content[at : at + 8 + head].replace(b"compression=lz4", b"compression=bz2")
    rest = content[at + 8 + head + length :]
    path.write_bytes(content[:at] + head_bytes + packed.ljust(length, b"\0") + rest)
    return path


def bag_of_mcap_without_an_index(folder):
    """One chunk that is unfolded to find out what it holds."""
    block = ((1 << 17) << 3 | 1 << 1).to_bytes(3, "little") + b"\0"
    packed = b"\x28\xb5\x2f\xfd\0\x58" + block * (MOST * 8)
    chunk = struct.pack("<3QII", 0, 0, MOST << 20, 0, 4) + b"zstd" + struct.pack("<Q", len(packed))
    header = struct.pack("<I", 4) + b"ros2" + struct.pack("<I", 0)
    records = ((1, header), (6, chunk + packed), (2, bytes(20)))
    stored = b"".join(struct.pack("<BQ", kind, len(held)) + held for kind, held in records)
    (folder / "a.mcap").write_bytes(b"\x89MCAP0\r\n" + stored + b"\x89MCAP0\r\n")
    return folder / "a.mcap"


def bag_of_mcap_with_many_chunks_without_an_index(folder):
    """Each chunk may unfold so far, all of them may not."""
    block = ((1 << 17) << 3 | 1 << 1).to_bytes(3, "little") + b"\0"
    each = MOST // 4
    packed = b"\x28\xb5\x2f\xfd\0\x58" + block * (each * 8)
    chunk = struct.pack("<3QII", 0, 0, each << 20, 0, 4) + b"zstd" + struct.pack("<Q", len(packed))
    header = struct.pack("<I", 4) + b"ros2" + struct.pack("<I", 0)
    records = ((1, header), *[(6, chunk + packed)] * 4, (2, bytes(20)))
    stored = b"".join(struct.pack("<BQ", kind, len(held)) + held for kind, held in records)
    (folder / "a.mcap").write_bytes(b"\x89MCAP0\r\n" + stored + b"\x89MCAP0\r\n")
    return folder / "a.mcap"


def aedat4_with_a_packet_of_lz4(folder):
    content = formats.aedat4(EVENTS[:0], SIZE).replace(b"NONE", b"LZ4 ")
    packed = lz4.frame.compress(ZEROS * MOST)
    (folder / "a.aedat4").write_bytes(content + struct.pack("<2i", 0, len(packed)) + packed)
    return folder / "a.aedat4"


def aedat4_with_a_packet_of_zstandard(folder):
    """Blocks that say: 128 KiB of one byte."""
    content = formats.aedat4(EVENTS[:0], SIZE)
    block = ((1 << 17) << 3 | 1 << 1).to_bytes(3, "little") + b"\0"
    packed = b"\x28\xb5\x2f\xfd\0\x58" + block * (MOST * 8)
    (folder / "a.aedat4").write_bytes(content + struct.pack("<2i", 0, len(packed)) + packed)
    return folder / "a.aedat4"


def aedat4_with_entities_in_its_header(folder):
    content = formats.aedat4(EVENTS, SIZE)
    text = b'<dv version="2.0">'
    (folder / "a.aedat4").write_bytes(content.replace(text, b"<!DOCTYPE a>".ljust(len(text))))
    return folder / "a.aedat4"


def pipe(folder):
    os.mkfifo(folder / "a.raw")
    return folder / "a.raw"


def device(folder):
    (folder / "a.raw").symlink_to("/dev/zero")
    return folder / "a.raw"


FILES = {  # what the refusal says
    hdf5_external_link: "events/t is a link to another file; only what a file itself holds",
    hdf5_soft_link_to_an_external_one: "other is a link to another file",
    hdf5_external_storage: "events/p is made of other data sets or files",
    hdf5_virtual_of_itself: "events/t is made of other data sets or files",
    hdf5_virtual_of_a_pipe: "events/t is made of other data sets or files",
    hdf5_virtual_of_a_thousand_million: "is made of other data sets or files",
    hdf5_virtual_events_in_four_columns: "events is made of other data sets or files",
    hdf5_chunk_of_gzip: "events/t: the chunk at .0,. unfolds to more than a chunk",
    hdf5_data_of_gzip: "claim to hold 167,772,160, over 100 times",
    hdf5_heaps_one_inside_the_other: "p have shapes|is damaged",
    hdf5_string_of_gigabytes: "a string or its heap is not valid",
    hdf5_one_image_many_times: "images: .* over 100 times",
    text_zip: "over 100 times",
    text_images_named_many_times: "images.txt: .* over 100 times",
    npz_of_zeros: "over 100 times",
    npz_of_no_array: "frames is not a NumPy array",
    npz_of_columns_for_polarity: r"p has shape \(400, 1\)",
    mat_of_zeros: "over 100 times",
    mat_of_an_empty_array_with_a_size: "events is marked as empty but has a size",
    bag_with_a_chunk_of_bz2: "over 100 times",
    bag_of_mcap_without_an_index: "claim to hold 167,772,160, over 100 times",
    bag_of_mcap_with_many_chunks_without_an_index: "claim to hold 167,772,160, over 100 times",
    aedat4_with_a_packet_of_lz4: "over 100 times",
    aedat4_with_a_packet_of_zstandard: "over 100 times",
    aedat4_with_entities_in_its_header: "header is not valid",
    pipe: "is a device or pipe; copy what it holds into a file",
    device: "is a device or pipe",
}
