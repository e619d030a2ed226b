"""Programs of JAX run in turn, so that kernels called by them may use JAX."""

import subprocess
import sys

import pytest

AFTER = "import jax.numpy; jax.numpy.ones(3); import jaxevent; jaxevent.akf"
BEFORE = "import jax, jaxevent; jax.numpy.ones(3); jaxevent.akf"
LOOK = "; from jaxevent.reconstruction.fused import images; print(images.IN_TURN)"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("program", "said"),
    [(BEFORE, "True"), (AFTER, "False")],
)
def test_programs_run_in_turn_unless_jax_computed_before(program, said):
    done = subprocess.run([sys.executable, "-c", program + LOOK], capture_output=True, text=True)
    assert done.stdout.strip() == said, done.stderr
