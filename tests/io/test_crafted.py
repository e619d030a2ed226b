"""Files made to do harm are refused in a sentence, before they cost memory or time."""

import resource

import crafted
import pytest

from jaxevent import io
from jaxevent.errors import InputError

NEEDS = {"bag": "rosbags", "aedat4": "aedat"}


@pytest.mark.slow
@pytest.mark.parametrize("build", crafted.FILES, ids=lambda build: build.__name__)
def test_crafted_files_are_refused(build, tmp_path):
    pytest.importorskip(NEEDS.get(build.__name__.partition("_")[0], "numpy"))
    path = build(tmp_path)
    # Events are left in the file by HDF5 and by what is decoded; the others are read whole.
    whole = build.__name__.startswith(("text", "npz", "mat"))
    for in_memory in (True,) if whole else (True, False):
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        with pytest.raises(InputError, match=crafted.FILES[build]) as error:
            io.load(path, crafted.SIZE, in_memory)
        assert str(tmp_path) in str(error.value) and "\n" not in str(error.value)
        # A bag is unfolded up to the bound, 128 MB.
        grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1000
        assert grown < 300, f"{grown:.0f} MB"
