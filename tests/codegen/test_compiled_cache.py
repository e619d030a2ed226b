"""Compiled functions in files: two processes at once, damaged and foreign files."""

import importlib
import os
import pickle
import subprocess
import sys
from pathlib import Path

import numba
import numpy as np
import pytest
from numba.core import types

from jaxevent import cache, codegen
from jaxevent.codegen import cache as kernel_cache
from jaxevent.codegen import module as kernel_module
from jaxevent.codegen.graph import TranslationError


@pytest.fixture
def half(tmp_path, monkeypatch):
    """Makes new dispatchers of a function in a file of its own, as new processes would."""
    monkeypatch.setenv("JAXEVENT_CACHE", str(tmp_path / "kept"))

    def fresh(folder=tmp_path):
        (folder / "halves.py").write_text("def half(x):\n    return x / 2\n")
        with monkeypatch.context() as there:
            there.syspath_prepend(folder)
            there.delitem(sys.modules, "halves", raising=False)
            return kernel_cache.njit_cached(importlib.import_module("halves").half)

    return fresh


def files_of(folder: Path) -> list[Path]:
    return sorted(folder.rglob("*.nbc"))


CALLER = """
from parts import CONFIG, RATE, third
def share(x):
    return third(x) * RATE * CONFIG.gain
"""
PARTS = """
import typing
import numba
RATE = {rate}
class Config(typing.NamedTuple):
    gain: float
CONFIG = Config({gain})
@numba.njit
def third(x):
    return x / {by}
"""


@pytest.mark.parametrize("changed", [{"by": 6}, {"rate": 2}, {"gain": 2}])
def test_what_a_function_calls_or_reads_may_change(changed, tmp_path, monkeypatch):
    monkeypatch.setenv("JAXEVENT_CACHE", str(tmp_path / "kept"))
    (tmp_path / "caller.py").write_text(CALLER)
    monkeypatch.syspath_prepend(tmp_path)

    def fresh(by=3, rate=1, gain=1):
        (tmp_path / "parts.py").write_text(PARTS.format(by=by, rate=rate, gain=gain))
        for name in ("caller", "parts"):
            monkeypatch.delitem(sys.modules, name, raising=False)
        monkeypatch.setattr(sys, "dont_write_bytecode", True)
        kernel_cache._content.cache_clear()
        importlib.invalidate_caches()
        return kernel_cache.njit_cached(importlib.import_module("caller").share)

    assert fresh()(12.0) == 4
    again = fresh()
    assert again(12.0) == 4 and sum(again.stats.cache_hits.values()) == 1
    other = {"by": 3, "rate": 1, "gain": 1} | changed
    assert fresh(**changed)(12.0) == 12.0 / other["by"] * other["rate"] * other["gain"]


def test_signatures_compiled_at_the_same_time_keep_apart(half, tmp_path, monkeypatch):
    # Whenever one process has written a file and is about to name it, another one compiles.
    replace, others = os.replace, [half(), half()]

    def interrupted(*names):
        if others:
            others.pop()(np.float32(3))
        replace(*names)

    monkeypatch.setattr(os, "replace", interrupted)
    assert half()(3) == 1.5
    monkeypatch.setattr(os, "replace", replace)
    assert not others
    for value in (3, np.float32(3)):
        later = half()
        assert later(value) == 1.5
        assert sum(later.stats.cache_hits.values()) == 1 and len(later.nopython_signatures) == 1
        assert later.nopython_signatures[0].args == (numba.typeof(value),)


def spoil(path: Path, how: str) -> None:
    content = path.read_bytes()
    if how == "a folder":
        path.unlink()
        path.mkdir()
        return
    changed = {
        "empty": b"",
        "cut in the hash": content[:20],
        "one bit": content[:-1] + bytes([content[-1] ^ 1]),
        "a pickle": b"cos\nsystem\n(S'exit 1'\ntR.",
    }
    path.write_bytes(changed[how])


def test_installations_share_what_is_the_same_in_both(half, tmp_path):
    (tmp_path / "other").mkdir()
    assert half()(5) == 2.5
    there = half(tmp_path / "other")
    assert there(5) == 2.5 and sum(there.stats.cache_hits.values()) == 1


HOW = ("empty", "cut in the hash", "one bit", "a pickle", "a folder")


@pytest.mark.parametrize("how", HOW)
def test_a_damaged_file_is_compiled_again(how, half, tmp_path):
    assert half()(5) == 2.5
    (kept_file,) = files_of(tmp_path)
    spoil(kept_file, how)
    again = half()
    assert again(5) == 2.5 and not again.stats.cache_hits
    if how != "a folder":  # what was damaged is whole again
        later = half()
        assert later(5) == 2.5 and len(later.stats.cache_hits) == 1


def test_code_of_a_module_that_is_gone_is_compiled_again(half, tmp_path):
    """In a process that cannot import the module of which another one compiled a function."""
    (tmp_path / "elsewhere").mkdir()
    half(tmp_path / "elsewhere")(3.0)
    script = f"""
import types
from jaxevent.codegen import cache
path = {str(tmp_path / "elsewhere" / "halves.py")!r}
module = types.ModuleType("halves")
exec(compile(open(path).read(), path, "exec"), module.__dict__)
made = cache.njit_cached(module.half)
print(made(3.0), len(made.stats.cache_hits))
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.stdout.split() == ["1.5", "0"], done.stderr
    assert len(files_of(tmp_path / "kept")) == 1


def test_another_signature_in_the_place_of_a_file_is_not_run(half, tmp_path):
    half()(5)
    (whole,) = files_of(tmp_path)
    half()(np.float32(5))
    (real,) = set(files_of(tmp_path)) - {whole}
    real.write_bytes(whole.read_bytes())
    later = half()
    assert later(np.float32(5)) == 2.5 and not later.stats.cache_hits


def test_what_cannot_be_written_is_compiled_alone(half, tmp_path, monkeypatch):
    def full(*names):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    assert half()(5) == 2.5
    left = [p.name for p in (tmp_path / "kept").rglob("*") if p.is_file()]
    assert left == ["key"]


def test_nothing_is_kept_where_the_user_wants_it_so(half, tmp_path, monkeypatch):
    monkeypatch.setenv("JAXEVENT_CACHE", "0")
    assert half()(5) == 2.5
    assert not files_of(tmp_path) and not (tmp_path / "kept").exists()


class Intruder:
    """Makes a file when it is unpickled."""

    def __init__(self, path: Path):
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


def test_a_file_that_another_user_signed_is_not_unpickled(half, tmp_path, monkeypatch):
    """Its hash is right, but for the key."""
    assert half()(5) == 2.5
    (path,) = files_of(tmp_path)
    mark = tmp_path / "ran"
    seen = []
    hash_of = kernel_cache.SignatureFiles._hash
    with monkeypatch.context() as watched:
        watched.setattr(
            kernel_cache.SignatureFiles, "_hash", lambda *a: (seen.append(a), hash_of(*a))[1]
        )
        assert half()(5) == 2.5
    files, key, _ = seen[-1]
    forged = pickle.dumps(Intruder(mark))
    own = hash_of(files, key, forged)
    with monkeypatch.context() as another:
        another.setattr(cache, "secret_key", lambda folder: b"another" * 4)
        foreign = hash_of(files, key, forged)
    path.write_bytes(foreign + forged)
    assert half()(5) == 2.5 and not mark.exists()
    # With the user's own key it is: the mark tells.
    path.write_bytes(own + forged)
    files.load(key)
    assert mark.exists()


def test_what_depends_on_addresses_is_not_kept(half, tmp_path):
    apply = kernel_cache.njit_cached(lambda f, x: f(x))
    files = apply._cache._files
    key = (types.Dispatcher(half()), "x")
    files.save(key, "data")
    assert files.load(key) is None


TEXT = """
import numpy as np
from numba import types

from jaxevent.codegen.cache import cfunc

@cfunc(types.float64(types.float64), error_model="numpy")
def third(x):
    return x / 3 + {number}
"""


def test_a_module_of_text_is_made_again_from_damaged_files(tmp_path, monkeypatch):
    monkeypatch.setenv("JAXEVENT_CACHE", str(tmp_path))
    text = TEXT.format(number=0.25)
    module = kernel_module.compile_module(text)
    assert module.third.ctypes(6) == 2.25
    path = Path(module.__file__)
    (compiled,) = files_of(path.parent)
    content = path.read_bytes(), compiled.read_bytes()
    assert kernel_module.compile_module(text).third.cache_hits == 1
    for spoilt in (path, compiled):
        spoilt.write_bytes(spoilt.read_bytes()[:100])
    assert kernel_module.compile_module(text).third.ctypes(6) == 2.25
    assert path.read_bytes() == content[0]
    assert kernel_module.compile_module(text).third.cache_hits == 1


def test_what_numba_does_not_compile_is_left_to_xla(tmp_path, monkeypatch):
    monkeypatch.setenv("JAXEVENT_CACHE", str(tmp_path))
    text = TEXT.format(number="new_in_no_release")
    with pytest.warns(UserWarning, match="left to XLA"), pytest.raises(TranslationError):
        kernel_module.compile_module(text)


def _double(x):
    return 2 * x


def test_what_is_compiled_may_be_called_from_python():
    """Parts too: without numba's wrapper the process ends. Lean ones, which have none, refuse."""
    for make in (codegen.njit, codegen.njit_inlined, codegen.njit_noalloc, codegen.njit_fastmath):
        assert make(_double)(1.5) == 3
    inside = codegen.njit_noalloc_inlined(_double)

    @codegen.njit_noalloc
    def outside(x):
        return inside(x)

    assert outside(1.5) == 3
    for x in (1.5, 1):
        with pytest.raises(TypeError, match="not for Python"):
            inside(x)
