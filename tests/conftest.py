import os
from pathlib import Path

# Most of the suite's time is compilation. What one test, worker or command has compiled, the others
# take from here; the environment reaches the commands that tests start.
os.environ.setdefault(
    "JAX_COMPILATION_CACHE_DIR", str(Path(__file__).parents[1] / ".pytest_cache" / "jax")
)
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.1")

import hypothesis
import jax
import pytest

# jaxevent must not be imported here: the shape checker only sees what is imported after it.
jax.config.update("jax_enable_x64", True)

hypothesis.settings.register_profile("tests", deadline=None, derandomize=True, max_examples=25)
hypothesis.settings.load_profile("tests")


@pytest.fixture
def float32():
    """Run the test in single precision, as users do by default."""
    with jax.enable_x64(False):
        yield


@pytest.fixture(scope="session")
def golden() -> Path:
    return Path(__file__).parent / "golden"


@pytest.fixture(scope="session")
def data() -> Path:
    root = os.environ.get("JAXEVENT_DATA")
    if not root:
        pytest.skip("needs sample recordings: set JAXEVENT_DATA to the folder that holds data/")
    return Path(root) / "data"
