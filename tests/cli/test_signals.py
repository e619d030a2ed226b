"""SIGINT and SIGTERM during commands: a quiet end, nothing incomplete, and a later run goes on."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from noise import ONE, small, write_config

import jaxevent
from jaxevent import cli

pytestmark = pytest.mark.slow

# The command in a process that sends itself the signal: at the n-th file that is being completed,
# or within the n-th write that libhdf5 asks for.
CODE = """
import contextlib, os, signal, sys
from jaxevent import cli
from jaxevent.io import output

where, number, nth = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
del sys.argv[1:4]
signal.signal(signal.SIGINT, signal.default_int_handler)
count = 0

def tick(here):
    global count
    count += here == where
    if here == where and count == nth:
        os.kill(os.getpid(), number)
        for _ in range(100):
            pass

locked = output.locked

@contextlib.contextmanager
def ticking(path):
    with locked(path) as holds:
        tick("file")
        yield holds

class Raw:
    def __init__(self, raw):
        self.raw = raw

    def __getattr__(self, name):
        return getattr(self.raw, name)

    def write(self, data):
        tick("write")
        return self.raw.write(data)

output.locked = ticking
made = output._NeverFailingFile.__init__
output._NeverFailingFile.__init__ = lambda file, raw: made(file, Raw(raw))
sys.exit(cli.main())
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    jaxevent.save(small(), tmp_path / "small.h5")
    write_config(tmp_path, ONE)
    fit = ONE.replace('"blend"', '"edi"') + 'fit = ["c_on"]\n'
    (tmp_path / "fit.toml").write_text("iterations = 1\nrounds = 1\nsplit = [1, 0, 1]\n" + fit)
    return tmp_path


COMMANDS = {
    "convert": ["convert", "small.h5", "out.h5"],
    "convert gzip": ["convert", "small.h5", "out.h5", "--compression", "gzip"],
    "track": ["track", "small.h5", "--out", "out", "--seed", "12,10,3"],
    "fit": ["fit", "fit.toml", "--out", "out"],
    "evaluate": ["evaluate", "run.toml", "--out", "out"],
}
PLACES = [
    ("convert", "write", 1, signal.SIGTERM),
    ("convert gzip", "write", 4, signal.SIGINT),
    ("track", "file", 3, signal.SIGTERM),
    ("fit", "file", 2, signal.SIGTERM),
    ("evaluate", "file", 2, signal.SIGINT),
]


@pytest.mark.parametrize(("command", "where", "nth", "number"), PLACES)
def test_a_signal_leaves_nothing_incomplete(command, where, nth, number, folder, monkeypatch):
    before = {path for path in folder.rglob("*")}
    env = {**os.environ, "PYTHONPATH": str(Path(jaxevent.__file__).parents[1])}
    env["JAX_ENABLE_X64"] = "1"  # as here, where the command goes on
    words = [sys.executable, "-c", CODE, where, str(int(number)), str(nth), *COMMANDS[command]]
    done = subprocess.run(words, env=env, cwd=folder, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (128 + number, "")
    left = {path for path in folder.rglob("*")} - before
    assert not [path for path in left if path.name.endswith((".part", ".new"))]
    if command not in ("fit", "evaluate"):  # these keep what is finished, to go on
        assert not left
    monkeypatch.chdir(folder)
    again = [*COMMANDS[command], *(["--resume"] if command == "fit" and left else [])]
    assert cli.main(again) == 0
