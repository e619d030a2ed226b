"""The same on one device, on two, and in two processes. Run as a program, it has two.

Each device compiles what it runs: more of them test the same and take as much longer.
"""

import dataclasses
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
from jaxevent import devices
from jaxevent.errors import InputError
from jaxevent.methods import METHODS
from jaxevent.runs import egomotion
from jaxevent.runs.evaluate import evaluate
from jaxevent.runs.family import FitData
from jaxevent.runs.fit import fit
from jaxevent.runs.reconstruction import Objective, Problem, cut_windows

TWO = "--xla_force_host_platform_device_count=2"

# Four windows, so that each of two devices, or of two processes, has several.
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
EVALUATION = """
recordings = ["moving.h5"]
[[method]]
name = "blend"
[[method]]
name = "last-frame"
[[method]]
name = "blend"
label = "I0 of a half"
params = { I0 = 0.5 }
"""
VOTES = {"particles": 20, "batch": 8, "every": 8, "tau_max": 0.03, "candidates": 16}
SOURCE = "planar.h5"


def written(folder: Path) -> None:
    from points import moved
    from texture import moving

    jaxevent.save(moving(), folder / "moving.h5")
    (folder / "fit.toml").write_text(FIT)
    (folder / "evaluation.toml").write_text(EVALUATION)
    velocity = (150.0, 80.0)
    turning = moved(lambda at: np.broadcast_to(velocity, at.shape), 0.1, 40, 0)
    jaxevent.save(turning, folder / SOURCE)
    (folder / "planar.csv").write_text("t,vx,vy\n0,150,80\n0.3,150,80\n")


def reconstructions(folder: Path) -> dict[str, Any]:
    """Images of a filter, its loss and gradients."""
    recording = jaxevent.load(folder / "moving.h5")
    found: dict[str, Any] = {}
    method = METHODS["edi"]
    params = method.Params(c_on=0.02, c_off=0.013)
    objective = Objective(method)
    batch = Problem(objective, cut_windows(recording, "held-out"))(params)[0][0]
    batch = batch if devices.is_single_device() else batch.over(devices.local_devices())
    found["shared out"] = batch.truth.sharding.num_devices

    def loss(params):
        return objective(params, batch), batch.prepared(params).mean

    (value, images), slope = jax.jit(jax.value_and_grad(loss, has_aux=True))(params)
    found["edi"] = images
    found["loss"] = value, *(slope.raw[name] for name in ("c_on", "c_off", "I0"))

    # The smoother looks at neighbours too.
    aks = METHODS["aks"]
    features, out = aks.prepare(recording, np.linspace(0.05, 0.45, 5))
    if not devices.is_single_device():
        features, out = (part.over(devices.local_devices()) for part in (features, out))
    params = aks.Params()
    found["aks"] = jax.jit(lambda f, out: aks.read(params, aks.run(params, f)[0], out))(
        features, out
    )
    return found


def video(folder: Path) -> dict[str, Any]:
    """Images of windows one after another."""
    recording = jaxevent.load(folder / "moving.h5")
    cf = METHODS["cf"].estimate(recording, window_events=4000, devices=devices.local_devices())
    return {"windows": cf(np.linspace(0.05, 0.45, 5))}


def motions(folder: Path) -> dict[str, Any]:
    """The loss of voting, of a number of runs that two does not divide, but it does particles."""
    recording = dataclasses.replace(jaxevent.load(folder / SOURCE), name=str(folder / SOURCE))
    params = METHODS["voting"].Params.of(VOTES)
    goal = egomotion.FAMILY.goal(
        METHODS["voting"], params, {"truth": "*.csv", "runs": 4, "settle": 0.02}
    )
    problem = goal.problem(FitData({"fit": [("", recording)], "validation": [], "test": []}))
    four = problem(params)[0][0]
    three = dataclasses.replace(four, noise=jax.tree.map(lambda leaf: leaf[:3], four.noise))
    if not devices.is_single_device():
        four, three = (batch.over(devices.local_devices()) for batch in (four, three))
    return {
        "4 runs": four.noise.normal.addressable_shards[0].data.shape,
        "3 runs": three.noise.normal.addressable_shards[0].data.shape,
        "votes": jax.jit(goal.loss)(params, three),
    }


def computed(folder: Path, out: Path) -> dict[str, Any]:
    """All that is compared, in NumPy."""
    out.mkdir()
    found = {**reconstructions(folder), **video(folder), **motions(folder)}
    fit(folder / "fit.toml", out / "fitted")
    found["fit"] = (out / "fitted" / "params.toml").read_text()
    found["history"] = (out / "fitted" / "loss.csv").read_text()
    rows = evaluate(folder / "evaluation.toml", out / "evaluated")
    found["rows"] = [{k: v for k, v in row.items() if k != "seconds"} for row in rows]
    return jax.device_get(found)


def started(argv: list[Any], flags: str = "") -> subprocess.Popen:
    flags = f"{os.environ['XLA_FLAGS']} {flags}"
    usual = {"JAX_ENABLE_X64": "1", "JAX_PLATFORMS": "cpu", "XLA_FLAGS": flags}
    return subprocess.Popen(
        [sys.executable, *map(str, argv)],
        env={**os.environ, **usual},
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


def ended(processes: list[subprocess.Popen], seconds: float = 300) -> list[str]:
    """What they said; none outlives this."""
    try:
        said = [process.communicate(timeout=seconds) for process in processes]
    finally:
        for process in processes:
            process.kill()
    for process, (_, errors) in zip(processes, said, strict=True):
        assert process.returncode == 0, errors
    return [out for out, _ in said]


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("devices")
    written(folder)
    return folder


@pytest.fixture(scope="module")
def both(folder) -> tuple[dict[str, Any], dict[str, Any]]:
    """What one device computes, and what two do."""
    ended([started([__file__, folder], TWO)])
    return pickle.loads((folder / "found").read_bytes())


@pytest.mark.slow
def test_pixels_are_the_same_on_two_devices(both):
    one, two = both
    assert (one["shared out"], two["shared out"]) == (1, 2)
    for name in ("edi", "windows", "aks"):
        # How the compiler contracts a b + c depends on what it fuses: the last bit or two.
        for a, b in zip(one[name], two[name], strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-14, atol=1e-15)
    np.testing.assert_allclose(one["loss"], two["loss"], rtol=1e-12)


@pytest.mark.slow
def test_runs_or_particles_are_shared_out(both):
    one, two = both
    assert (one["4 runs"][0], two["4 runs"][0]) == (4, 2)
    assert (one["3 runs"][2], two["3 runs"][2]) == (VOTES["particles"], VOTES["particles"] // 2)
    np.testing.assert_allclose(one["votes"], two["votes"], rtol=1e-12)


@pytest.mark.slow
def test_fits_on_two_devices_end_the_same(both):
    one, two = both
    # Windows, of which each device had its own, are added in the same order.
    assert one["fit"] == two["fit"] and one["history"] == two["history"]


@pytest.mark.slow
def test_evaluation_on_two_devices_has_the_same_rows(both):
    one, two = both
    assert one["rows"] == two["rows"]


class Placed:
    """A batch that tells where it was put."""

    def over(self, places):
        return len(places)


def test_few_batches_are_spread_and_many_are_shared_out(monkeypatch):
    monkeypatch.setattr(devices, "local_devices", lambda: ["a", "b", "c"])
    monkeypatch.setattr(jax, "device_put", lambda batch, device: device)
    batches: list[Any] = [Placed() for _ in range(5)]
    assert devices.BatchPlacement(None)(batches) == ["a", "b", "c", "a", "b"]
    assert devices.BatchPlacement(2)(batches) == [3] * 5  # two at a time
    assert devices.BatchPlacement(None)(batches[:2]) == [3, 3]
    assert devices.BatchPlacement(None)([0, 1]) == ["a", "b"]  # these cannot be spread
    there = devices.REMOTE_BATCH
    mine: list[Any] = [there, batches[0], there, batches[1], there, batches[2]]
    assert devices.BatchPlacement(None)(mine) == [there, "a", there, "b", there, "c"]
    assert devices.BatchPlacement(4)(mine) == [there, 3, there, 3, there, 3]
    places = devices.BatchPlacement(None)
    assert places(mine) is places(mine)


def test_meshes_take_as_many_devices_as_divide():
    for places, sizes in (("abcd", [4, 3, 3, None]), ("a", [None] * 4)):
        meshes = [devices.make_mesh(list(places), n) for n in (64, 6, 9, 7)]
        assert [mesh and mesh.size for mesh in meshes] == sizes


def test_precision_and_device_of_a_thread_go_with_a_function():
    device = jax.local_devices()[0]

    def settings():
        found = jax.numpy.ones(1)
        return found.dtype, jax.config.jax_default_device

    with jax.enable_x64(not jax.config.jax_enable_x64), jax.default_device(device):
        given, expected = devices.with_own_settings(settings), settings()
    with ThreadPoolExecutor(1) as pool:
        assert pool.submit(given).result() == expected
        assert pool.submit(settings).result() != expected


def test_an_error_of_one_process_is_one_of_all(monkeypatch):
    def refuse():
        raise InputError("no such file")

    monkeypatch.setattr(jax, "process_count", lambda: 2)
    for index, mine in ((0, refuse), (1, lambda: 5)):
        monkeypatch.setattr(jax, "process_index", lambda index=index: index)
        monkeypatch.setattr(devices, "allgather", lambda said: ["no such file", None])
        with pytest.raises(InputError, match="no such file"):
            devices.on_all_processes(mine)
        monkeypatch.setattr(devices, "allgather", lambda said: [("error", "no such file"), ("", 0)])
        with pytest.raises(InputError, match="no such file"):
            devices.on_process_zero(mine)
    monkeypatch.setattr(devices, "allgather", lambda said: [("value", 7), said])
    assert devices.on_process_zero(refuse) == 7  # what process 1 would say is not asked
    assert devices.partition_batches([10, 11, 12]) == [
        devices.REMOTE_BATCH,
        11,
        devices.REMOTE_BATCH,
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
    got = devices.deserialise(devices.serialise(said))
    jax.tree.map(np.testing.assert_array_equal, got, said)
    assert jax.tree.structure(got) == jax.tree.structure(said) and list(got) == list(said)
    assert devices.deserialise(devices.serialise({3: "a", "3": "b"})) == {3: "a", "3": "b"}
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
        messages = [devices.serialise("mine"), strange]
        room = max(1024, 1 << (max(map(len, messages)) - 1).bit_length())
        rows = [np.frombuffer(one.ljust(room, b"\0"), np.uint8) for one in messages]
        answers = iter([np.array([len(one) for one in messages]), np.stack(rows)])
        monkeypatch.setattr(multihost_utils, "process_allgather", lambda _: next(answers))  # noqa: B023
        with pytest.raises(InputError, match="cannot be read"):
            devices.allgather("mine")


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/net/tcp").exists(), reason="looks into /proc")
def test_the_coordinator_listens_where_it_is_told(tmp_path):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    program = f"""
from pathlib import Path
from jaxevent import devices
devices.join("127.0.0.1:{port}", 1, 0)
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
            owners[s] += [k for k, batch in enumerate(batches) if batch is not devices.REMOTE_BATCH]
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
def test_two_processes_fit_as_one(folder, both):
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = free.getsockname()[1]
    program = "from jaxevent.cli import main; raise SystemExit(main())"
    out = folder / "processes"
    argv = ["-c", program, "fit", folder / "fit.toml", "--out", out]
    argv += ["--coordinator", f"localhost:{port}", "--processes", "2", "--process"]
    said = ended([started([*argv, k]) for k in (0, 1)])
    assert "edi" in said[0] and "edi" not in said[1]
    one = folder / "one" / "fitted"
    for name in ("params.toml", "loss.csv"):
        assert (out / name).read_text() == (one / name).read_text()
    a, b = (tomllib.loads((at / "params.toml").read_text())["edi"]["c_on"] for at in (one, out))
    assert a == pytest.approx(b, rel=1e-6) and abs(a - 0.03) > 1e-3
    rows = [json.loads((at / "results.json").read_text())["rows"] for at in (one, out)]
    for row in [*rows[0], *rows[1]]:
        row.pop("seconds")
    assert rows[0] == rows[1]


if __name__ == "__main__":
    place = Path(sys.argv[1])
    with jax.default_device(jax.devices()[0]):
        one = computed(place, place / "one")
    two = computed(place, place / "two")
    (place / "found").write_bytes(pickle.dumps((one, two)))
