import gc
import os
from collections.abc import Callable
from importlib import metadata
from pathlib import Path

import platformdirs

# Nearly all of the suite's time is compilation, and the tests run small arrays. Without most
# optimisations compiling takes half as long, running 1.4 times as long; `optimised` undoes it.
os.environ.setdefault("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")
# The older code generator of XLA, not in jaxlib 0.11, takes a fifth less of the time again: 42 s in
# place of 52. Programs in parts for several cores take more to compile, and all cores have tests
# of their own.
os.environ.setdefault(
    "XLA_FLAGS",
    "--xla_cpu_parallel_codegen_split_count=1"
    + " --xla_cpu_use_fusion_emitters=false" * metadata.version("jaxlib").startswith("0.10."),
)
# What one test, worker or command has compiled, the others take from the user's cache folder, and
# so does the next run. The environment reaches the commands that tests start.
os.environ.setdefault(
    "JAXEVENT_CACHE", str(platformdirs.user_cache_path("jaxevent", appauthor=False) / "tests")
)
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
# Where in the source each operation is from takes 3 % of the time of tests that compile much.
os.environ.setdefault("JAX_TRACEBACK_IN_LOCATIONS_LIMIT", "0")
# Colours of numba's messages, made whether one is shown or not, take 2 % of its time.
os.environ.setdefault("NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING", "1")

import checked
import hypothesis
import jax
import jaxtyping
import pytest
from _pytest import runner

# jaxevent must not be imported here: the shape checker only sees what is imported after it.
jaxtyping.jaxtyped = checked.jaxtyped
jax.config.update("jax_enable_x64", True)

# Tracing makes many objects and little garbage: looking for it as often as usual costs 2 %.
gc.set_threshold(50_000, 20, 50)

hypothesis.settings.register_profile("tests", deadline=None, derandomize=True, max_examples=25)
hypothesis.settings.load_profile("tests")
# For experiments/mutations.py, which asks whether a test fails, not where it fails most simply.
hypothesis.settings.register_profile(
    "any", hypothesis.settings.get_profile("tests"), phases=(hypothesis.Phase.generate,)
)

# They take about 20 s of CPU each with nothing kept. Begun first, they leave no worker waiting for
# another at the end.
LONGEST = (
    "test_batch_evaluate.py",
    "test_blob_filters.py",
    "test_blob_fused.py",
    "test_blob_tracker.py",
    "test_cli_motion.py",
    "test_compensated.py",
    "test_processes.py",
    "test_docs.py",
    "test_egomotion_batch.py",
    "test_egomotion_flow.py",
    "test_egomotion_patches.py",
    "test_egomotion_voting.py",
    "test_evaluate.py",
    "test_evaluate_scores.py",
    "test_events_only.py",
    "test_extremes.py",
    "test_fit.py",
    "test_fit_blob.py",
    "test_fit_every_method.py",
    "test_fit_motion.py",
    "test_fused.py",
    "test_gallery.py",
    "test_own_blob.py",
    "test_readme.py",
    "test_reconstruction.py",
    "test_recovery.py",
    "test_smoother.py",
    "test_threads.py",
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    items.sort(key=lambda item: item.path.name not in LONGEST)


def with_room(function: Callable, *args: object) -> object:
    """Call a function with room for the frames of those that it calls, thousands deep."""
    return function(*args)


# Python takes memory for frames from the system in pieces of 16 kB, and gives each back when the
# last call in it returns: where a loop calls a function at the edge of one, it does so every time.
# That took 15 % of the time of tests that compile much. This frame takes a piece of 4 MB, and the
# calls below it the rest of that.
with_room.__code__ = with_room.__code__.replace(co_stacksize=2**18)


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_protocol(item: pytest.Item, nextitem: pytest.Item | None) -> object:
    return with_room(runner.pytest_runtest_protocol, item, nextitem)


@pytest.fixture(scope="module", autouse=True)
def few_maps():
    """Release compiled programs before the process has too many of them.

    The system allows 65,530 maps, three a program. To release n programs takes 0.6 n + 0.0004 n^2
    ms, 1 s for a thousand, 46 s for ten. What stays is not looked at again for garbage until then,
    which took a tenth of the time of tests that came after others.
    """
    yield
    from jaxevent.cache import release_compiled  # not above: see there

    if release_compiled(6_000):
        gc.unfreeze()
    gc.collect()
    gc.freeze()


@pytest.fixture
def float32():
    """Run the test in single precision, as users do by default."""
    with jax.enable_x64(False):
        yield


@pytest.fixture
def optimised():
    """Compile with all optimisations: for a test that computes longer than it compiles."""
    jax.config.update("jax_disable_most_optimizations", False)
    yield
    usual = os.environ["JAX_DISABLE_MOST_OPTIMIZATIONS"] != "0"
    jax.config.update("jax_disable_most_optimizations", usual)


@pytest.fixture(scope="session")
def golden() -> Path:
    return Path(__file__).parent / "golden"


@pytest.fixture(scope="session")
def data() -> Path:
    root = os.environ.get("JAXEVENT_DATA")
    if not root:
        pytest.skip("needs sample recordings: set JAXEVENT_DATA to the folder that holds data/")
    return Path(root) / "data"
