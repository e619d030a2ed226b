"""Programs of JAX run in turn, so that kernels may use JAX, and on a platform that there is."""

import os
import subprocess
import sys

import jax
import pytest
import texture

import jaxevent
from jaxevent import threads
from jaxevent.codegen import module
from jaxevent.errors import InputError, InputWarning
from jaxevent.reconstruction.estimator import ScannedImages

AFTER = "import jax.numpy; jax.numpy.ones(3); import jaxevent; jaxevent.akf"
BEFORE = "import jax, jaxevent; jax.numpy.ones(3); jaxevent.akf"
# As commands do, which count processes before they load a filter.
LATER = "import jaxevent; import jax; jax.process_count(); jaxevent.akf"
LOOK = "; from jaxevent.codegen import module; print(module.IS_SYNCHRONOUS)"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("program", "said"),
    [(BEFORE, "True"), (LATER, "True"), (AFTER, "False")],
)
def test_programs_run_in_turn_unless_jax_computed_before(program, said):
    done = subprocess.run([sys.executable, "-c", program + LOOK], capture_output=True, text=True)
    assert done.stdout.strip() == said, done.stderr


def test_a_fit_without_its_kernel_is_told(float32, monkeypatch):
    monkeypatch.setattr(module, "IS_SYNCHRONOUS", False)
    recording, akf = texture.moving(), jaxevent.akf
    with pytest.warns(InputWarning, match="'akf' takes several times as long.* import jaxevent f"):
        prepared = akf.prepare_images(recording, [0.1])
    assert isinstance(prepared, ScannedImages)
    with pytest.raises(InputError, match="no program may call the kernel of 'akf'"):
        akf.prepare_images(recording, [0.1], compiler="numba")


@pytest.mark.parametrize(
    "error", [AssertionError(), RuntimeError("Unable to initialize backend 'cuda': none.")]
)
def test_a_platform_that_is_not_there_is_refused(error, monkeypatch):
    def absent():
        raise error

    monkeypatch.setattr(jax, "default_backend", absent)
    threads.check_platform_available.cache_clear()
    with pytest.raises(InputError, match="JAX_PLATFORMS is .*; unset it") as refused:
        jaxevent.akf.Params()
    assert str(error).removesuffix(".") in str(refused.value)
    assert "\n" not in str(refused.value)
    monkeypatch.undo()
    jaxevent.akf.Params()


@pytest.mark.slow
def test_a_command_says_so_in_a_line(tmp_path):
    crop = os.path.join(jaxevent.__path__[0], "data/slider_depth_crop.h5")
    words = ["reconstruct", crop, "--method", "akf", "--out", str(tmp_path / "a.h5")]
    done = subprocess.run(
        [sys.executable, "-m", "jaxevent", *words],
        env={**os.environ, "JAX_PLATFORMS": "abacus"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 2 and done.stdout == ""
    assert done.stderr.startswith("jaxevent: JAX_PLATFORMS is 'abacus'")
    assert done.stderr.count("\n") == 1 and not list(tmp_path.iterdir())


@pytest.mark.parametrize(("given", "kept"), [({}, "cpu"), ({"JAX_PLATFORMS": "cuda"}, "cuda")])
def test_commands_compute_on_the_cpu_unless_told(given, kept):
    program = """
import atexit, os, sys
from jaxevent.cli import main
atexit.register(lambda: print(os.environ["JAX_PLATFORMS"], file=sys.stderr))
sys.argv = ["jaxevent", "--version"]
main()
"""
    others = {k: v for k, v in os.environ.items() if k != "JAX_PLATFORMS"}
    done = subprocess.run(
        [sys.executable, "-c", program], env=others | given, capture_output=True, text=True
    )
    assert (done.returncode, done.stderr.strip()) == (0, kept)
