"""Kernels with another numba than those that are known, and without numba."""

import gc
import subprocess
import sys

import pytest

from jaxevent.codegen import support

CALLS = """
import numpy as np
from jaxevent import codegen
from jaxevent.codegen import support

inside = codegen.njit_noalloc_inlined(lambda x: x + 1)
loose = codegen.njit_fastmath_inlined(lambda x: x * 2)

@codegen.njit_noalloc
def outside(values):
    total = 0.0
    for k in range(len(values)):
        total += inside(loose(values[k]))
    return total

print(support.HAS_NUMBA, support.HAS_INTERNALS, outside(np.arange(4.0)))
"""
UNKNOWN = "import numba; numba.__version__ = '9.0.0'\n"
NONE = "import sys; sys.modules['numba'] = None\n"

# Events, and frames of a ramp that becomes brighter.
IMAGES = """
import warnings
import numpy as np
with warnings.catch_warnings(record=True) as said:
    warnings.simplefilter("always")
    import jaxevent
    from jaxevent.recording import Events, Frames, Recording
    events = Events(
        np.arange(100, 9_100, 100), *np.random.default_rng(1).integers(0, 4, (2, 90), np.uint16),
        np.arange(90) % 3 > 0,
    )
    images = np.linspace(10, 200, 32).reshape(2, 4, 4).astype(np.uint8)
    frames = Frames(np.r_[0, 10_000], images, np.zeros(2, np.int64))
    recording = Recording("made", 4, 4, events, frames)
    times = np.r_[2_000, 8_000]
    mine, xla = (jaxevent.akf.estimate(recording, **o)(times) for o in ({}, {"compiler": "xla"}))
said = [str(one.message) for one in said if one.category is UserWarning]
print(len(said), said[0].partition(" (")[0])
np.testing.assert_array_equal(mine.mean, xla.mean)
print(np.isfinite(xla.mean).all())
try:
    jaxevent.akf.estimate(recording, compiler="numba")
except jaxevent.InputError as error:
    print(error)
"""


def printed(code: str) -> str:
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize(
    ("version", "known"),
    [
        ("0.60.0", False),
        ("0.61.0", True),
        ("0.68.1", True),
        ("0.69.0rc1", False),
        ("1.0", False),
        ("0+unknown", False),
    ],
)
def test_private_interfaces_are_those_of_known_releases(version, known):
    assert support.is_tested_release(version) == known


@pytest.mark.slow
def test_an_unknown_numba_compiles_by_public_interfaces(tmp_path):
    assert printed(UNKNOWN + CALLS) == "True False 16.0\n"
    assert printed("import warnings; warnings.simplefilter('ignore')\n" + NONE + CALLS) == (
        "False False 16.0\n"
    )


@pytest.mark.slow
def test_without_numba_xla_makes_the_images():
    count, finite, refused = printed(NONE + IMAGES).splitlines()
    assert count == "1 numba cannot be imported" and finite == "True"
    assert "numba has no kernel for the method 'akf'" in refused


@pytest.mark.skipif(not support.HAS_NUMBA, reason="needs numba")
def test_no_garbage_is_collected_while_numba_compiles():
    seen = []

    @support.intrinsic
    def watched(context, x):
        seen.append(gc.isenabled())
        return x(x), lambda context, builder, signature, arguments: arguments[0]

    one = support.numba.njit(lambda x: watched(x))
    two = support.numba.njit(lambda x: one(x) + watched(x))
    assert gc.isenabled() and two(1.0) == 2.0 and gc.isenabled()
    with pytest.raises(support.numba.TypingError):
        support.numba.njit(lambda x: x.unknown)(1.0)
    assert gc.isenabled()
    gc.disable()
    try:
        two(1)
        assert not gc.isenabled()
    finally:
        gc.enable()
    assert seen and not any(seen)
