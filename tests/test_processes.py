"""Fits of two processes are those of one, and what processes say to each other."""

import json
import os
import pickle
import socket
import subprocess
import sys
import tomllib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from commands import fails

import jaxevent
from jaxevent import precision, processes
from jaxevent.errors import InputError
from jaxevent.methods import METHODS
from jaxevent.runs.fit import fit
from jaxevent.runs.reconstruction import Objective, Problem, cut_windows

# Four windows, so that each of two processes has several.
FIT = """
recordings = ["moving.h5"]
split = [1, 1, 0]
window = 0.126
warm_up = 0.03
iterations = 3
every = 2
rounds = 1
[[method]]
name = "edi"
params = { c_on = 0.03 }
fit = ["c_on", "c_off"]
search = { clock_offset = [0, 0.01, 3] }
"""


def started(argv: list[Any]) -> subprocess.Popen:
    return subprocess.Popen(
        [sys.executable, *map(str, argv)],
        env={**os.environ, "JAX_ENABLE_X64": "1"},
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


def ended(started: list[subprocess.Popen], seconds: float = 300) -> list[str]:
    """What they said; none outlives this."""
    try:
        said = [process.communicate(timeout=seconds) for process in started]
    finally:
        for process in started:
            process.kill()
    for process, (_, errors) in zip(started, said, strict=True):
        assert process.returncode == 0, errors
    return [out for out, _ in said]


def test_precision_and_device_of_a_thread_go_with_a_function():
    device = jax.local_devices()[0]

    def settings():
        found = jax.numpy.ones(1)
        return found.dtype, jax.config.jax_default_device

    with jax.enable_x64(not jax.config.jax_enable_x64), jax.default_device(device):
        given, expected = precision.with_own_settings(settings), settings()
    with ThreadPoolExecutor(1) as pool:
        assert pool.submit(given).result() == expected
        assert pool.submit(settings).result() != expected


def test_an_error_of_one_process_is_one_of_all(monkeypatch):
    def refuse():
        raise InputError("no such file")

    monkeypatch.setattr(jax, "process_count", lambda: 2)
    for index, mine in ((0, refuse), (1, lambda: 5)):
        monkeypatch.setattr(jax, "process_index", lambda index=index: index)
        monkeypatch.setattr(processes, "allgather", lambda said: ["no such file", None])
        with pytest.raises(InputError, match="no such file"):
            processes.on_all_processes(mine)
        monkeypatch.setattr(
            processes, "allgather", lambda said: [("error", "no such file"), ("", 0)]
        )
        with pytest.raises(InputError, match="no such file"):
            processes.on_process_zero(mine)
    monkeypatch.setattr(processes, "allgather", lambda said: [("value", 7), said])
    assert processes.on_process_zero(refuse) == 7  # what process 1 would say is not asked
    assert processes.partition_batches([10, 11, 12]) == [
        processes.REMOTE_BATCH,
        11,
        processes.REMOTE_BATCH,
    ]


class Trap:
    """Unpickling it would raise."""

    def __reduce__(self):
        return exec, ("raise SystemExit('unpickled')",)


def test_what_processes_say_is_kept_to_the_bit_and_never_run(monkeypatch):
    from jax.experimental import multihost_utils

    rng = np.random.default_rng(0)
    said: Any = {
        "3": (2.0, [rng.random(3), np.float32(0.1), {"c_on": np.zeros((0, 2), np.int64)}]),
        "rows": [{"mse": 1 / 3, "lost": float("nan"), "name": "\u00b5\n", "ok": True, "no": None}],
        "checkpoint": bytes(range(256)),
    }
    got = processes.deserialise(processes.serialise(said))
    jax.tree.map(np.testing.assert_array_equal, got, said)
    assert jax.tree.structure(got) == jax.tree.structure(said) and list(got) == list(said)
    assert processes.deserialise(processes.serialise({3: "a", "3": "b"})) == {3: "a", "3": "b"}
    assert got["3"][1][1].dtype == np.float32

    # Of two processes, a stranger in place of the other.
    monkeypatch.setattr(jax, "process_count", lambda: 2)
    for strange in (
        pickle.dumps(Trap()),
        b"",
        b"{}\n",
        b'{"run": 1}\n',
        b'{"array": null}\n',
        b'{"array": null}\n' + pickle.dumps(Trap()),
        b"[" * 100_000,
    ):
        messages = [processes.serialise("mine"), strange]
        room = max(1024, 1 << (max(map(len, messages)) - 1).bit_length())
        rows = [np.frombuffer(one.ljust(room, b"\0"), np.uint8) for one in messages]
        answers = iter([np.array([len(one) for one in messages]), np.stack(rows)])
        monkeypatch.setattr(multihost_utils, "process_allgather", lambda _: next(answers))  # noqa: B023
        with pytest.raises(InputError, match="cannot be read"):
            processes.allgather("mine")


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/net/tcp").exists(), reason="looks into /proc")
def test_the_coordinator_listens_where_it_is_told(tmp_path):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    program = f"""
from pathlib import Path
from jaxevent import precision, processes
processes.join("127.0.0.1:{port}", 1, 0)
for table in ("tcp", "tcp6"):
    for _, at, _, state, *_ in map(str.split, Path("/proc/net", table).read_text().splitlines()):
        if at.endswith(":{port:04X}") and state == "0A":
            print(at[-13:])
"""
    (said,) = ended([started(["-c", program])])
    assert said == f"0100007F:{port:04X}\n"  # the bytes of 127.0.0.1 backwards


@pytest.mark.slow
def test_each_process_prepares_its_own_windows(monkeypatch):
    from texture import moving

    windows = cut_windows(moving(), "held-out", (1, 1, 0), 0.126)
    edi = METHODS["edi"]
    monkeypatch.setattr(jax, "process_count", lambda: 3)
    owners: list[list[int]] = [[], []]
    for index in range(3):
        monkeypatch.setattr(jax, "process_index", lambda index=index: index)
        for s, batches in enumerate(Problem(Objective(edi), windows)(edi.Params())):
            owners[s] += [
                k for k, batch in enumerate(batches) if batch is not processes.REMOTE_BATCH
            ]
            assert len(batches) == 4
    assert [sorted(each) for each in owners] == [[0, 1, 2, 3]] * 2
    assert owners[0] == [0, 3, 1, 2]


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (["--coordinator", "here:1"], "--processes N"),
        (["--coordinator", "here", "--processes", "2", "--process", "0"], "HOST:PORT"),
        (["--coordinator", "here:1", "--processes", "2", "--process", "2"], "from 0 to 1"),
        (["--distributed", "--process", "0"], "one or the other"),
    ],
)
def test_processes_that_make_no_sense(given, said, tmp_path, capsys):
    fails(capsys, ["fit", "fit.toml", "--out", tmp_path / "out", *given], said)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_two_processes_fit_as_one(tmp_path):
    from texture import moving

    jaxevent.save(moving(), tmp_path / "moving.h5")
    (tmp_path / "fit.toml").write_text(FIT)
    fit(tmp_path / "fit.toml", tmp_path / "one")
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = free.getsockname()[1]
    program = "from jaxevent.cli import main; raise SystemExit(main())"
    argv = ["-c", program, "fit", tmp_path / "fit.toml", "--out", tmp_path / "two"]
    argv += ["--coordinator", f"localhost:{port}", "--processes", "2", "--process"]
    said = ended([started([*argv, k]) for k in (0, 1)])
    assert "edi" in said[0] and "edi" not in said[1]
    one, two = tmp_path / "one", tmp_path / "two"
    for name in ("params.toml", "loss.csv"):
        assert (two / name).read_text() == (one / name).read_text()
    found = tomllib.loads((two / "params.toml").read_text())["edi"]["c_on"]
    assert abs(found - 0.03) > 1e-3
    rows = [json.loads((at / "results.json").read_text())["rows"] for at in (one, two)]
    for row in [*rows[0], *rows[1]]:
        row.pop("seconds")
    assert rows[0] == rows[1]
