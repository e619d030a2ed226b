"""Compiled programs are kept on disk, for later processes, and released where they are too many."""

import os
import subprocess
import sys

import pytest

from jaxevent import cache
from jaxevent.runs import tasks

pytestmark = pytest.mark.slow

THEIRS = ("JAX_COMPILATION_CACHE_DIR", "JAX_ENABLE_COMPILATION_CACHE")
LOOK = "; import jax; print(jax.config.jax_compilation_cache_dir)"


def told(code: str, **variables: object) -> str:
    """What the code prints with these variables, and none of JAX's own."""
    done = ran(code, **variables)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def ran(code: str, **variables: object) -> subprocess.CompletedProcess:
    kept = {k: v for k, v in os.environ.items() if k not in (*THEIRS, "JAXEVENT_CACHE")}
    env = {**kept, **{k: str(v) for k, v in variables.items()}}
    return subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True)


def test_programs_are_kept_in_the_users_folder(tmp_path):
    folder = told("import jaxevent" + LOOK, XDG_CACHE_HOME=tmp_path, HOME=tmp_path)
    assert folder.startswith(str(tmp_path)) and os.path.isdir(folder)
    # Also where JAX was imported before.
    assert told("import jax, jaxevent" + LOOK, XDG_CACHE_HOME=tmp_path, HOME=tmp_path) == folder


def test_the_user_decides(tmp_path, monkeypatch):
    def kept(**variables: object) -> object:
        """The folder of a process that begins with these variables, before it imports JAX."""
        with monkeypatch.context() as begun:
            begun.setattr(os, "environ", {k: str(v) for k, v in variables.items()})
            begun.delitem(sys.modules, "jax")
            return cache.keep_compiled()

    assert kept(JAXEVENT_CACHE=0) is None
    assert tmp_path / "mine" in kept(JAXEVENT_CACHE=tmp_path / "mine").parents
    for name in THEIRS:
        assert kept(JAXEVENT_CACHE=tmp_path / "mine", **{name: tmp_path / "jax"}) is None
    assert kept(JAXEVENT_CACHE="/dev/null/no") is None  # without a place everything works
    later = told("import jax, jaxevent" + LOOK, JAX_COMPILATION_CACHE_DIR=tmp_path / "jax")
    assert later == str(tmp_path / "jax")


def test_what_was_compiled_is_found_again(tmp_path):
    code = (
        "import jaxevent, jax; jax.config.update('jax_persistent_cache_min_compile_time_secs', 0)\n"
        "jax.jit(lambda x: x * 2)(1.0); import os\n"
        "print(len(os.listdir(jax.config.jax_compilation_cache_dir)))"
    )
    first = int(told(code, JAXEVENT_CACHE=tmp_path))
    assert first > 0 and int(told(code, JAXEVENT_CACHE=tmp_path)) == first


def test_many_programs_are_released():
    """Otherwise LLVM aborts a process that evaluates recordings of a hundred shapes."""
    code = (
        "import jax\nfrom jaxevent import cache\n"
        "twice = jax.jit(lambda x: x * 2)\nassert twice(1.0) == 2.0\n"
        "cache.release_compiled()\nassert twice._cache_size() == 1\n"  # there are not so many
        "cache.release_compiled(maps=0)\nprint(twice._cache_size(), twice(1.0))"
    )
    assert told(code) == ("0 2.0" if sys.platform == "linux" else "1 2.0")


def test_they_are_released_after_each_task(monkeypatch):
    released = []
    monkeypatch.setattr(cache, "release_compiled", lambda: released.append(True))
    assert tasks.attempt(dict, tasks.Task("done", {"a": 1}), None)["result"] == {"a": 1}
    with pytest.raises(TypeError):
        tasks.attempt(len, tasks.Task("failed", {}), None)
    assert len(released) == 2


def test_a_damaged_file_is_compiled_again(tmp_path):
    """Or one that another process is writing; also by a process that another of ours started."""
    code = (
        "import jaxevent, jax; jax.config.update('jax_persistent_cache_min_compile_time_secs', 0)\n"
        "print(jax.jit(lambda x: x * 2)(1.0))"
    )
    assert told(code, JAXEVENT_CACHE=tmp_path) == "2.0"
    kept = {path: path.read_bytes() for path in tmp_path.rglob("*-cache") if path.is_file()}
    ours = {"JAX_COMPILATION_CACHE_DIR": next(iter(kept)).parent}
    for spoilt, inherited in ((b"", {}), (b"foreign", ours), (None, ours), (None, {})):
        for path, content in kept.items():
            path.write_bytes(content[: len(content) // 2] if spoilt is None else spoilt)
        done = ran(code, JAXEVENT_CACHE=tmp_path, **inherited)
        assert (done.returncode, done.stdout, done.stderr) == (0, "2.0\n", "")
