"""Files made to do harm are refused in a sentence, before they cost memory or time."""

import resource

import crafted
import h5py
import numpy as np
import pytest
from refusals import refuses

from jaxevent import cli, io
from jaxevent.io import hdf5_files

NEEDS = {"bag": "rosbags", "aedat4": "aedat"}


@pytest.mark.parametrize("name", ["link", "storage", "virtual"])
def test_what_is_trusted_may_be_made_of_other_files(name, tmp_path, capsys):
    other = tmp_path / "other.h5"
    p = crafted.EVENTS.p.astype("u1")
    with h5py.File(other, "w") as file:
        file["p"] = p
    p.tofile(tmp_path / "p.bin")
    layout = h5py.VirtualLayout(p.shape, "u1")
    layout[:] = h5py.VirtualSource(str(other), "p", p.shape)
    make = {
        "link": lambda group, name: group.__setitem__(name, h5py.ExternalLink(str(other), "/p")),
        "storage": lambda group, name: group.create_dataset(
            name, p.shape, "u1", external=[(str(tmp_path / "p.bin"), 0, p.size)]
        ),
        "virtual": lambda group, name: group.create_virtual_dataset(name, layout),
    }[name]
    path, out = crafted.inside(tmp_path, p=make), tmp_path / "out.h5"
    words = ["convert", str(path), str(out), "--size", "40,30"]
    assert cli.main(words) == 2 and "jaxevent convert --trust" in capsys.readouterr().err
    assert cli.main([*words, "--trust"]) == 0
    np.testing.assert_array_equal(io.load(out).events.p, crafted.EVENTS.p)


def test_strings_are_found_wherever_blocks_of_the_search_end(tmp_path, monkeypatch):
    # The string's attribute or the heap's end lie across an end of a block for some of these.
    good = tmp_path / "good.h5"
    with h5py.File(good, "w") as file:
        file.attrs["format"] = "jaxevent"
    content = bytearray(good.read_bytes())
    at = content.index(b"GCOL") + 16
    content[at + 8 : at + 16] = (1 << 40).to_bytes(8, "little")  # the string's size in its heap
    endless = tmp_path / "endless.h5"
    endless.write_bytes(content)
    bad = endless, crafted.hdf5_string_of_gigabytes(tmp_path)
    for block in range(65, 200, 5):
        monkeypatch.setattr(hdf5_files, "_BLOCK_BYTES", block)
        hdf5_files.search_heaps.__wrapped__(good, ())
        for path in bad:
            refuses(
                "a string or its heap is not valid", hdf5_files.search_heaps.__wrapped__, path, ()
            )


@pytest.mark.slow
@pytest.mark.parametrize("build", crafted.FILES, ids=lambda build: build.__name__)
def test_crafted_files_are_refused(build, tmp_path):
    pytest.importorskip(NEEDS.get(build.__name__.partition("_")[0], "numpy"))
    path = build(tmp_path)
    # Events are left in the file by HDF5 and by what is decoded; the others are read whole.
    whole = build.__name__.startswith(("text", "npz", "mat"))
    for in_memory in (True,) if whole else (True, False):
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        said = refuses(crafted.FILES[build], io.load, path, crafted.SIZE, in_memory)
        assert str(tmp_path) in said
        # A bag is unfolded up to the bound, 128 MB.
        grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1000
        assert grown < 300, f"{grown:.0f} MB"
