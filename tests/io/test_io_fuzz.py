"""Damaged files of every format: a clear error or a valid recording, as experiments/fuzz.py asks.

The files are made from numbers alone, so that those that once failed stay here.
"""

import contextlib
import os

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scripts import script

pytestmark = pytest.mark.slow

NEEDS = {"evt3": "evt3", "aedat4": "aedat", "bag": "rosbags", "mcap": "rosbags", "db3": "rosbags"}
fuzz = script("fuzz")


@pytest.mark.filterwarnings("ignore::jaxevent.InputWarning")  # of damaged times
@pytest.mark.parametrize("name", fuzz.FORMATS)
@given(seed=st.integers(0, 2**31 - 1))
@settings(max_examples=50)
@example(seed=123)  # aedat: not UTF-8 in the header, which aborts the decoder
@example(seed=92)  # mat: an unknown type, which SciPy takes as an index
@example(seed=14)  # m3ed: a damaged group where a name is looked for
@example(seed=3282)  # hdf5: the size of a string in its heap, from which libhdf5 goes on for ever
@example(seed=1300)  # hdf5: free space of size 0 in the heap of strings
@example(seed=3637)  # hdf5: a string's heap far past the end, for which libhdf5 takes 4 GB
@example(seed=3205)  # hdf5: the same, and the attribute's space is damaged
@example(seed=1442)  # hdf5: an attribute of a type that is none
@example(seed=2163)  # mat: complex, without imaginary numbers
@example(seed=20261929)  # aedat4: a line break for the version
@example(seed=34)  # zip: a long name in the reason
def test_damaged_files_are_refused_or_read(name, seed, tmp_path_factory):
    pytest.importorskip(NEEDS.get(name, "numpy"))
    path = tmp_path_factory.getbasetemp() / f"fuzz-{os.getpid()}.bin"
    with open(os.devnull, "w") as null, contextlib.redirect_stderr(null):
        assert fuzz.read_damaged(name, seed, path) in ("read", "refused")
