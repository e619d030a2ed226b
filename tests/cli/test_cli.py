"""The command line: what it writes, and that bad input is said in one line and leaves nothing."""

import argparse
import contextlib
import gc
import hashlib
import os
import re
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import h5py
import numpy as np
import pytest
from commands import decoded, described, fails
from noise import HEIGHT, ONE, STAMPS, WIDTH, small, write_config
from PIL import Image

import jaxevent
from jaxevent import cli
from jaxevent.cli import reconstruct
from jaxevent.methods import names
from jaxevent.recording import Events, Frames, Recording
from jaxevent.show import describe, export
from jaxevent.show.images import display_limits, tone_map
from jaxevent.simulate import SCENES, SENSORS, Pan, from_video, scene, simulate

pytestmark = pytest.mark.slow


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    jaxevent.save(small(), tmp_path / "small.h5")
    return tmp_path


def arrays(**changed) -> dict:
    """The arrays of an .npz like `small`; None leaves one out."""
    recording = small()
    assert recording.frames is not None and isinstance(recording.events, Events)
    fields = {name: getattr(recording.events, name) for name in "txyp"}
    fields.update(width=WIDTH, height=HEIGHT)
    fields.update(frames=recording.frames.images, frame_t=recording.frames.t)
    return {name: value for name, value in {**fields, **changed}.items() if value is not None}


def missing(path: Path) -> None:
    pass


def wrong_format(path: Path) -> None:
    path.write_text("t,x,y,p\n1,2,3,1\n")


def unsorted(path: Path) -> None:
    np.savez(path, **arrays(t=arrays()["t"][::-1]))


def unsorted_in_hdf5(path: Path) -> None:
    jaxevent.save(small(), path.with_name("good.h5"))
    path.with_name("good.h5").rename(path)
    with h5py.File(path, "r+") as file:
        events = file["events/t"]
        assert isinstance(events, h5py.Dataset)
        events[200] = 0


def outside(path: Path) -> None:
    np.savez(path, **arrays(width=12, frames=None, frame_t=None))


def nan_frames(path: Path) -> None:
    images = np.full((6, HEIGHT, WIDTH), 0.5)
    images[3, 2, 1] = np.nan
    np.savez(path, **arrays(frames=images))


def empty(path: Path) -> None:
    np.savez(path, **arrays(**{name: np.empty(0, int) for name in "txyp"}, frames=None))


def disagreeing_sizes(path: Path) -> None:
    np.savez(path, **arrays(frames=np.zeros((6, 10, 10), np.uint8)))


def damaged(path: Path) -> None:
    np.savez(path, **arrays())
    path.write_bytes(path.read_bytes()[:3000])


BAD = [
    missing,
    wrong_format,
    unsorted,
    unsorted_in_hdf5,
    outside,
    nan_frames,
    empty,
    disagreeing_sizes,
    damaged,
]


@pytest.mark.parametrize("make", BAD)
def test_bad_recordings(make, tmp_path, capsys):
    path = tmp_path / "bad.npz"
    make(path)
    out, video, table = tmp_path / "out.h5", tmp_path / "images", tmp_path / "results"
    config = write_config(tmp_path, ONE.replace("small.h5", "bad.npz"))
    for argv in (
        ["info", path],
        ["convert", path, out],
        ["reconstruct", path, "--method", "blend", "--rate", 200, "--out", out],
        ["reconstruct", path, "--method", "blend", "--out", video],
        ["evaluate", config, "--out", table],
    ):
        fails(capsys, argv, path)
    assert {file.name for file in tmp_path.iterdir()} <= {"bad.npz", "run.toml"}


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ('recordingz = ["small.h5"]\n', "recordings"),
        (ONE + "params = { c_one = 0.1 }\n", "c_on"),
        (ONE.replace("blend", "blends"), "'blend'"),
        (ONE + "params = { c_on = \n", "line 4"),
        (ONE.replace("small", "none-*"), "none-*.h5"),
    ],
)
def test_bad_configurations(text, named, folder, capsys):
    config = write_config(folder, text)
    fails(capsys, ["evaluate", config, "--out", folder / "results"], config, named)
    assert not (folder / "results").exists()


def test_unwritable_outputs(folder, capsys, monkeypatch):
    monkeypatch.setattr("jaxevent.simulate.scene", None)  # it is told before anything is simulated
    source = folder / "small.h5"
    config = write_config(folder, ONE)
    before = sorted(folder.rglob("*"))
    for parent in (folder / "missing", source):
        fails(capsys, ["simulate", "--scene", "lake", "--out", parent / "a.h5"], parent / "a.h5")
        for name in ("a.h5", "a.mp4", "a"):
            out = parent / name
            fails(capsys, ["reconstruct", source, "--method", "blend", "--out", out], out)
        fails(capsys, ["convert", source, parent / "a.h5"], parent / "a.h5")
        fails(capsys, ["evaluate", config, "--out", parent / "a"], parent / "a")
        fails(capsys, ["demo", "--out", parent / "a"], parent / "a")
    assert sorted(folder.rglob("*")) == before


def test_bad_ways_to_reconstruct(folder, capsys):
    path, bare, out = folder / "small.h5", folder / "bare.h5", folder / "out.h5"
    jaxevent.save(small(frames=None), bare)
    (folder / "mine.toml").write_text("alpha = 3\n")
    (folder / "broken.toml").write_text("alpha = \n")
    (folder / "other.toml").write_text("[akf]\nc_on = 0.2\n")
    before = sorted(folder.rglob("*"))
    blend = ["--method", "blend", "--out", out]
    for rate in ("0", "-1", "nan", "inf", "1e7"):
        fails(capsys, ["reconstruct", path, *blend, f"--rate={rate}"], path, "--rate")
    fails(capsys, ["reconstruct", bare, *blend], bare, "no frames")
    fails(capsys, ["reconstruct", bare, "--method", "akf", "--at", "frames", "--out", out], bare)
    fails(capsys, ["reconstruct", path, *blend, "--tone", "log"], out, "--tone")
    for name in ("mine.toml", "broken.toml", "other.toml", "none.toml"):
        fails(capsys, ["reconstruct", path, *blend, "--params", folder / name], folder / name)
    mine = folder / "other.toml"
    fails(capsys, ["reconstruct", path, "--params", mine, "--out", out], mine, "--method")
    fails(capsys, ["reconstruct", path, "--method", "akff", "--out", out], "'akf'")
    for name in ("out.h5", "out.mp4", "out"):
        argv = ["reconstruct", path, *blend[:2], "--colour", "--out", folder / name]
        fails(capsys, argv, path, "no colour frames")
    for name in ("out.avi", "out.h5.gz"):
        fails(capsys, ["reconstruct", path, *blend[:2], "--out", folder / name], folder / name)
    for bound in ("--start", "--stop"):
        fails(capsys, ["reconstruct", path, *blend, bound, "nan"], f"{bound} is nan; give one")
    fails(capsys, ["reconstruct", path, *blend[:2], "--out", "."])
    fails(capsys, ["reconstruct", path, *blend[:2], "--out", folder], folder, "holds the input")
    assert sorted(folder.rglob("*")) == before


@pytest.mark.parametrize(
    "argv",
    [
        [],
        ["unknown"],
        ["info"],
        ["info", "a", "--size", "240"],
        ["reconstruct", "a", "--method", "akf"],
        ["reconstruct", "a", "--method", "akf", "--out", "b", "--rate", "9", "--at", "frames"],
        ["convert", "a", "b", "--compression", "best"],
        ["simulate", "--out", "b"],
        ["simulate", "a.mp4", "--scene", "lake", "--out", "b"],
        ["simulate", "--scene", "lake"],
        ["motion", "a", "--model", "planar", "--out", "b", "--still", "1"],
        ["motion", "a", "--model", "planar", "--out", "b", "--seed", "x"],
        ["simulate", "--motion", "wall", "--scene", "lake", "--out", "b"],
        ["track"],
        ["track", "a", "--out", "b", "--seed", "1,2"],
        ["track", "a", "--out", "b", "--seed", "1,2,x"],
        ["track", "a", "--out", "b", "--pair", "1"],
        ["track", "a", "--out", "b", "--pair", "1,2.5"],
        ["track", "a", "--out", "b", "--rate", "9", "--at", "events"],
        ["track", "a", "--out", "b", "--at", "frames"],
        ["track", "a", "--out", "b", "--background", "black"],
        ["simulate", "--blobs", "disc", "--scene", "lake", "--out", "b"],
    ],
)
def test_bad_arguments(argv, capsys):
    with pytest.raises(SystemExit) as stop:
        cli.main(argv)
    assert stop.value.code == 2
    assert capsys.readouterr().err.startswith("usage: jaxevent")


@pytest.mark.parametrize(
    ("argv", "usage", "said"),
    [
        ("reconstuct a.h5", "jaxevent [options] COMMAND", "did you mean 'reconstruct'?"),
        ("camera mrge", "jaxevent camera [options]", "did you mean 'merge'?"),
        ("track a.h5 --modl x", "jaxevent track [options]", "did you mean --method?"),
        ("track a.h5 b.h5", "jaxevent track [options]", "unrecognized arguments: b.h5\n"),
        ("flow a.h5 --out f --times 1 2", "jaxevent flow [options]", "are one list, such as 1.0,"),
    ],
)
def test_wrong_names_are_told_by_the_command_that_was_meant(argv, usage, said, capsys):
    with pytest.raises(SystemExit, match="2"):
        cli.main(argv.split())
    told = capsys.readouterr().err
    assert usage in told and said in told


@pytest.mark.parametrize("command", ["motion", "track"])
def test_help_has_examples(command, capsys):
    with pytest.raises(SystemExit) as stop:
        cli.main([command, "--help"])
    assert stop.value.code == 0 and f"\nexamples:\n  jaxevent {command}" in capsys.readouterr().out


def test_help_and_version(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "500")  # names are not broken at their hyphens
    with pytest.raises(SystemExit) as stop:
        cli.main(["--version"])
    assert stop.value.code == 0
    assert capsys.readouterr().out == f"jaxevent {jaxevent.__version__}\n"
    named = {"reconstruct": tuple(names("reconstruction")), "simulate": (*SCENES, *SENSORS)}
    for command in (
        "demo",
        "info",
        "calibrate",
        "convert",
        "reconstruct",
        "evaluate",
        "fit",
        "simulate",
    ):
        with pytest.raises(SystemExit) as stop:
            cli.main([command, "--help"])
        assert stop.value.code == 0
        assert re.search(rf"\nexamples?:\n  jaxevent {command}", text := capsys.readouterr().out)
        assert set(named.get(command, ())) <= set(re.findall(r"[\w-]+", text))


def as_process(*arguments: object, env: dict[str, str] | None = None) -> subprocess.Popen:
    root = str(Path(jaxevent.__file__).parents[1])
    # Jobs in the background of a shell inherit that interrupts are ignored.
    code = "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler); "
    code += "from jaxevent import cli; sys.exit(cli.main())"
    return subprocess.Popen(
        [sys.executable, "-c", code, *map(str, arguments)],
        env={**(os.environ if env is None else env), "PYTHONPATH": root},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def test_garbage_is_collected_as_before():
    """A command collects seldom, and tells Python to leave all as it is where the process ends."""
    known, frozen = gc.get_threshold(), gc.get_freeze_count()
    assert cli.main(["info", "none.h5"]) == 2
    assert gc.get_threshold() == known and gc.get_freeze_count() <= frozen
    code = "import gc, sys; from jaxevent import cli; sys.argv = ['jaxevent', 'info', 'none.h5']; "
    code += "cli.main(); sys.exit(gc.get_freeze_count() > 0)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True).returncode == 1


def test_as_a_process(tmp_path):
    process = as_process("convert", tmp_path / "none.npz", tmp_path / "out.h5")
    out, error = process.communicate()
    assert (process.returncode, out) == (2, "")
    assert re.fullmatch(r"jaxevent: .*none\.npz: .*\n", error)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("error", "status"), [(KeyboardInterrupt, 130), (BrokenPipeError, 141)])
def test_interrupted_and_broken_pipe(error, status, monkeypatch, capsys):
    def load(*arguments, **options):
        raise error

    monkeypatch.setattr("jaxevent.io.load", load)
    assert cli.main(["info", "a"]) == status
    assert capsys.readouterr().err == ""


def test_interrupted_while_it_writes(folder):
    """Between images; see test_signals.py."""
    number = signal.SIGTERM
    out = folder / "out"
    out.mkdir()
    words = ("--method", "last-frame", "--rate", 2e5, "--out", out / "images.h5")
    process = as_process("reconstruct", folder / "small.h5", *words)
    while not any(path.stat().st_size > 1e5 for path in out.glob("*.part")):
        assert process.poll() is None
        time.sleep(0.02)
    process.send_signal(number)
    assert process.communicate() == ("", "")
    assert process.returncode == 128 + number
    assert not list(out.iterdir())


def test_a_signal_is_not_lost_in_a_callback(tmp_path):
    """Python drops what is raised there; JAX has a callback in garbage collection."""
    number = signal.SIGINT
    code = """
import gc, os, signal, sys, time
import jaxevent.io
from jaxevent import cli
from jaxevent.cli import reconstruct
signal.signal(signal.SIGINT, signal.default_int_handler)

def callback(phase, about, first=[1]):
    if first:
        first.clear()
        os.kill(os.getpid(), int(sys.argv[-1]))
        for _ in range(100):
            pass

def load(*words, **options):
    gc.callbacks.append(callback)
    gc.collect()
    time.sleep(20)

jaxevent.io.load = load
sys.exit(cli.main(["info", "a"]))
"""
    done = subprocess.run([sys.executable, "-c", code, str(int(number))], capture_output=True)
    assert (done.returncode, done.stdout, done.stderr) == (128 + number, b"", b"")


def test_a_signal_waits_for_an_import_and_outlives_who_drops_it(tmp_path):
    """Compiled modules crash, or are left half made, by what is raised while they are imported."""
    number = signal.SIGTERM
    (tmp_path / "compiled.py").write_text(
        "import os, sys, time\nos.kill(os.getpid(), int(sys.argv[-1]))\n"
        "for _ in range(100): pass\nprint('imported')\n"
    )
    code = f"""
import signal, sys, time
import jaxevent.io
from jaxevent import cli
from jaxevent.cli import reconstruct
signal.signal(signal.SIGINT, signal.default_int_handler)
sys.path.insert(0, {str(tmp_path)!r})

def load(*words, **options):
    import compiled
    try:
        time.sleep(20)
    except BaseException:
        print("dropped")
    time.sleep(20)

jaxevent.io.load = load
sys.exit(cli.main(["info", "a"]))
"""
    done = subprocess.run([sys.executable, "-c", code, str(int(number))], capture_output=True)
    assert (done.returncode, done.stderr) == (128 + number, b"")
    assert done.stdout.split() == [b"imported", b"dropped"]


@contextlib.contextmanager
def room(size: int):
    """Files cannot grow beyond so many bytes."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


@pytest.mark.parametrize("size", [100, 3000])
@pytest.mark.parametrize("name", ["images.h5", "images.mp4", "images", "recording.h5"])
def test_full_disk(name, size, folder, capsys):
    out = folder / "out"
    out.mkdir()
    words = ["reconstruct", folder / "small.h5", "--method", "blend", "--rate", 3000, "--out"]
    if name == "recording.h5":
        words = ["convert", folder / "small.h5"]
    elif name == "images":
        size //= 20
    with room(size):
        fails(capsys, [*words, out / name], out / name)
    assert not list(out.iterdir())


def test_full_disk_is_no_crash_at_exit(tmp_path):
    """HDF5's own flush at exit crashes where it fails."""
    code = """
import resource, sys
from pathlib import Path
import numpy as np
from jaxevent.errors import InputError
from jaxevent.io.output import complete_hdf5
resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, resource.RLIM_INFINITY))
try:
    with complete_hdf5(Path(sys.argv[1])) as (file, check):
        stored = file.create_dataset("a", (100, 1000), "f4", chunks=(1, 1000))
        for row in range(100):
            stored[row] = 1
            if sys.argv[2]:
                check()
except InputError as error:
    sys.exit(f"said: {error}")
"""
    for how in ("", "early"):
        words = [sys.executable, "-c", code, tmp_path / "a.h5", how]
        done = subprocess.run(words, capture_output=True)
        assert (done.returncode, done.stderr[:5]) == (1, b"said:")
        assert not list(tmp_path.iterdir())


def test_import_is_lazy():
    """Nothing is loaded or computed before it is used; no device is opened by any import."""
    code = """
import importlib, pkgutil, sys
import jaxevent
assert not {"jax", "numba", "pandas", "scipy", "h5py"} & sys.modules.keys()
for module in pkgutil.walk_packages(jaxevent.__path__, "jaxevent."):
    importlib.import_module(module.name)
from jax._src import xla_bridge
assert not xla_bridge.backends_are_initialized()
"""
    subprocess.run([sys.executable, "-c", code], check=True)


def test_info(tmp_path, capsys, monkeypatch):
    """In blocks as at once, of a file whose events can be counted by hand."""
    t = np.r_[0, 5_000, 5_001, 9_999, 10_000, 100_000]
    x, y, p = np.r_[3, 4, 4, 4, 3, 1], np.r_[7, 2, 2, 2, 7, 0], np.r_[1, 0, 0, 1, 1, 0]
    images = np.zeros((2, HEIGHT, WIDTH))
    images[0, :5], images[1] = 1, 0.5
    path = tmp_path / "known.npz"
    np.savez(
        path,
        **arrays(t=t, x=x, y=y, p=p, frames=images, frame_t=None),
        exp_start=np.r_[0, 40_000],
        exp_end=np.r_[3_000, 44_000],
        imu_t=np.r_[0, 1_000],
        gyro=np.zeros((2, 3)),
        acc=np.zeros((2, 3)),
        calib=1 + np.arange(9.0),
        threshold=np.r_[0.1, 0.2],
    )
    assert cli.main(["convert", str(path), str(tmp_path / "known.h5")]) == 0
    assert re.search(r"known\.h5: 6 events, 2 frames, 0\.\d MB\n", capsys.readouterr().out)
    assert cli.main(["info", str(path)]) == 0
    first = capsys.readouterr().out
    monkeypatch.setattr(describe, "BLOCK_EVENTS", 2)
    assert cli.main(["info", str(tmp_path / "known.h5")]) == 0
    assert capsys.readouterr().out.splitlines()[1:] == first.splitlines()[1:]
    lines = dict(re.split(r"  +", line, maxsplit=1) for line in first.splitlines())
    assert lines.pop("fault").startswith("clipped frames: 12.5 % of the frames' pixels are white")
    assert lines == {
        "file": str(path),
        "name": "known",
        "sensor": "24 x 20 pixels",
        "time": "0.000000 to 0.100000 s (0.100 s)",
        "events": "6, from 0.000000 to 0.100000 s",
        "polarity": "50.0 % ON, 50.0 % OFF",
        "event rate": "mean 60 per s, peak 400 per s in 10 ms",
        "rate over time": "400, 100, 0, 0, 0, 0, 0, 0, 0, 100 per s, in tenths of 0.01 s",
        "gaps": "longest 90.000 ms, after 0.010000 s",
        "hot pixels": "none",
        "hottest pixels": "(4, 2) 3 events, 30 per s; (3, 7) 2 events, 20 per s; "
        "(1, 0) 1 events, 10 per s",
        "frames": "2 of 24 x 20, float64, 24.7 per s",
        "exposure": "3.000 to 4.000 ms",
        "grey levels": "37.5 % dark (< 0.02), 12.5 % saturated (> 0.98)",
        "calibration": "fx 1.00, fy 2.00, cx 3.00, cy 4.00; distortion 5, 6, 7, 8, 9",
        "IMU": "2, 1000.0 per s",
        "ground truth": "none",
        "extra threshold": "float64 of shape (2,)",
    }


def test_one_event_is_enough(tmp_path, capsys):
    path = tmp_path / "one.npz"
    one: dict = {name: np.array([value]) for name, value in zip("txyp", (7, 3, 4, 1), strict=True)}
    np.savez(path, **one)
    fails(capsys, ["info", path], path, "--size")
    size = ["--size", f"{WIDTH},{HEIGHT}"]
    assert cli.main(["info", str(path), *size]) == 0
    assert "1, from 0.000007 to 0.000007 s" in capsys.readouterr().out
    assert cli.main(["convert", str(path), str(tmp_path / "one.h5"), *size]) == 0
    out = tmp_path / "images.h5"
    assert cli.main(["reconstruct", str(path), "--method", "akf", "--out", str(out), *size]) == 0
    with h5py.File(out) as file:
        assert np.asarray(file["t"]).tolist() == [7]
        image, mask = (np.asarray(file[name])[0] for name in ("image", "valid"))
    expected = np.full((HEIGHT, WIDTH), 0.5)  # without frames the AKF begins with mid-grey
    valid = np.zeros((HEIGHT, WIDTH), bool)
    expected[4, 3], valid[4, 3] = 1.5 * np.exp(0.1) - 1, True
    np.testing.assert_array_equal(mask, valid)
    np.testing.assert_allclose(image, expected, rtol=1e-6)
    assert "rests on data" not in capsys.readouterr().err
    argv = ["reconstruct", str(path), "--method", "events-only", *size]
    for name in ("grey.h5", "grey"):
        assert cli.main([*argv, "--out", str(tmp_path / name)]) == 0
        assert capsys.readouterr().err.count("no pixel of the images rests on data") == 1


def test_reconstruct_to_hdf5(folder, capsys):
    mine = "c_on = 0.2\nclock_offset = 0.0025\n"
    (folder / "a.toml").write_text(mine)
    (folder / "b.toml").write_text(f"[cf]\nc_on = 0.3\n[akf]\n{mine}")
    contents = []
    for name in ("a.h5", "b.hdf5"):
        params = (folder / name).with_suffix(".toml")
        argv = f"reconstruct {folder}/small.h5 --method akf --params {params} --out"
        assert cli.main([*argv.split(), str(folder / name)]) == 0
        said = capsys.readouterr().out
        calibrated, written = said.splitlines()
        assert calibrated.startswith("not calibrated; c_off by default (not identifiable: ")
        assert written.startswith(f"{folder / name}: 6 images")
        with h5py.File(folder / name) as file:
            fields = ("t", "image", "variance", "valid")
            contents.append({key: np.asarray(file[key]) for key in fields})
            # An image is read by itself, and by every HDF5 library.
            image = file["image"]
            assert image.chunks == (1, HEIGHT, WIDTH) and image.compression == "gzip"
        told = described(folder / name)
        assert told["method"] == "akf" and told["recording"] == "small"
        assert told["command"] == f"jaxevent {argv} {folder / name}"
        digests = {
            str(one): hashlib.sha256(one.read_bytes()).hexdigest()
            for one in (folder / "small.h5", params)
        }
        assert {one: about["sha256"] for one, about in told["inputs"].items()} == digests
        given = {"c_on": 0.2, "c_off": 0.1, "clock_offset": 0.0025}
        assert {key: told["params"][key] for key in given} == pytest.approx(given, rel=1e-12)
    assert all(contents[0][key].tobytes() == contents[1][key].tobytes() for key in contents[0])

    params = jaxevent.akf.Params.of({"c_on": 0.2, "clock_offset": 0.0025})
    video = jaxevent.akf.estimate(small(), params)
    image, variance, valid = video(STAMPS + 2_500)
    assert contents[0]["valid"].dtype == bool and 0 < valid.sum()
    np.testing.assert_array_equal(contents[0]["valid"], valid)
    assert contents[0]["t"].dtype == np.int64 and contents[0]["image"].dtype == np.float32
    np.testing.assert_array_equal(contents[0]["t"], STAMPS + 2_500)
    np.testing.assert_array_equal(contents[0]["image"], image.astype(np.float32))
    np.testing.assert_array_equal(contents[0]["variance"], variance.astype(np.float32))


def test_the_usual_method(folder, capsys, monkeypatch):
    assert reconstruct._choose_method(True, 2800 * 240 * 180) == "aks"  # ten minutes of a core
    assert reconstruct._choose_method(True, 2700 * 240 * 180) == "mc"
    assert reconstruct._choose_method(False, 1400 * 240 * 180) == "high-pass"
    capsys.readouterr()
    bare = folder / "bare.h5"
    jaxevent.save(small(frames=None), bare)
    for patience, path, method in ((1e-9, "small.h5", "aks"), (1e9, bare, "events-only")):
        monkeypatch.setattr("jaxevent.cli.reconstruct._MAX_SECONDS", patience)
        for name, more in (("usual.h5", []), ("named.h5", ["--method", method])):
            argv = ["reconstruct", folder / path, "--rate", 100, "--out", folder / name, *more]
            assert cli.main([*map(str, argv), "--force"]) == 0
            assert capsys.readouterr().out.startswith(f"method {method}: ") == (not more)
        assert described(folder / "usual.h5")["method"] == method
        images = []
        for name in ("usual.h5", "named.h5"):
            with h5py.File(folder / name) as file:
                images.append(np.asarray(file["image"]).tobytes())
        assert images[0] == images[1]


def test_reconstruct_some_times(folder, capsys):
    """Images of a part are those of the whole, at the times asked for."""

    def images(name: str, *options: str) -> tuple[np.ndarray, np.ndarray]:
        out = folder / name
        argv = ["reconstruct", folder / "small.h5", "--method", "akf", "--out", out, *options]
        assert cli.main([str(word) for word in argv]) == 0
        with h5py.File(out) as file:
            return np.asarray(file["t"]), np.asarray(file["image"])

    video = jaxevent.akf.estimate(small())
    (folder / "wanted.csv").write_text("n,t,why\n1,0.0105,a\n2,0.02,b\n3,0.0315,c\n")
    (folder / "wanted.txt").write_text("# us\n10500\n20000\n31500\n")
    for name in ("wanted.csv", "wanted.txt"):
        t, image = images(f"{name}.h5", "--times", folder / name)
        np.testing.assert_array_equal(t, [10_500, 20_000, 31_500])
        np.testing.assert_array_equal(image, video(t).mean.astype(np.float32))
    t, image = images("part.h5", "--rate", "500", "--start", "0.0201", "--stop", "0.0301")
    np.testing.assert_array_equal(t, 20_100 + np.arange(5) * 2_000)
    np.testing.assert_array_equal(image, video(t).mean.astype(np.float32))
    assert images("frames.h5", "--start", "0.009", "--stop", "0.03")[0].tolist() == [9_000, 21_000]
    t, _ = images("both.h5", "--times", folder / "wanted.csv", "--stop", "0.0315")
    assert t.tolist() == [10_500, 20_000]
    capsys.readouterr()

    blend = ["reconstruct", folder / "small.h5", "--method", "blend", "--out", folder / "no.h5"]
    for *options, name, value in (
        ["--start", "1"],
        ["--stop", "0"],
        ["--rate", "10", "--start", "1"],
    ):
        fails(capsys, [*blend, *options, name, value], "small.h5", f"{name} {value} s")
    fails(capsys, [*blend, "--stop", "nan"], "--stop")
    (folder / "far.txt").write_text("0.01\n0.2\n")
    fails(capsys, [*blend, "--times", folder / "far.txt"], "small.h5", "200000")
    fails(capsys, [*blend, "--stream", "1"], "small.h5", "--stream")


def parsers(parser, words=("jaxevent",)):
    """Yield every command's words and parser, those of parts too."""
    yield words, parser
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for name, one in action.choices.items():
                yield from parsers(one, (*words, name))


def test_help_fits_two_screens_and_ends_with_an_example(monkeypatch):
    monkeypatch.setenv("COLUMNS", "100")
    known = list(parsers(cli._parser()))
    assert len(known) == 1 + len(cli.COMMANDS) + 4  # four parts of camera
    for words, parser in known:
        lines = parser.format_help().splitlines()
        name = " ".join(words)
        assert lines[0].startswith(f"usage: {name} ") and lines[1] == "", name
        assert len(lines) <= 60 and max(map(len, lines)) <= 130, name
        examples = lines[[*map(str.strip, lines)].index("") :]
        examples = [line for line in examples if line.startswith("  jaxevent ")]
        assert examples and lines[-1] == examples[-1], name
        for line in examples if len(words) > 1 else []:
            assert line.strip().startswith(name), line
            parser.parse_args(line.split()[len(words) :])


def test_reconstruct_to_images(folder):
    stored = []
    for name in ("a", "b"):
        argv = f"reconstruct {folder}/small.h5 --method blend --rate 300 --out {folder}/{name}"
        assert cli.main(argv.split()) == 0
        stored.append({file.name: file.read_bytes() for file in (folder / name).iterdir()})
    assert stored[0] == stored[1]
    times = np.rint(np.arange(16) / 300 * 1e6).astype(np.int64)  # until 50 of 52 ms
    names = [f"frame_{number:08d}.png" for number in range(len(times))]
    assert sorted(stored[0]) == [*names, "images.txt"]
    lines = [f"{t / 1e6:.6f} {name}\n" for t, name in zip(times, names, strict=True)]
    assert (folder / "a" / "images.txt").read_text() == "".join(lines)
    images, _, _ = jaxevent.blend.estimate(small())(times)
    limits = display_limits(small().frames.intensity, "display")
    for name, image in zip(names, tone_map(images, "display", limits), strict=True):
        with Image.open(folder / "a" / name) as stored_image:
            np.testing.assert_array_equal(np.asarray(stored_image), image)


def test_images_are_as_bright_as_frames(folder, capsys):
    """Linear images at frames are these frames, grey for grey; what is cut off is said."""
    ramp = np.arange(WIDTH * HEIGHT).reshape(HEIGHT, WIDTH) % 122
    frames = {
        "dark": ramp.astype(np.uint8),
        "bright": np.where(ramp > 100, 255, ramp).astype(np.uint8),
    }
    for name, greys in frames.items():
        images = np.broadcast_to(greys, (6, HEIGHT, WIDTH))
        recording = small(frames=Frames(STAMPS, images, np.zeros_like(STAMPS)))
        jaxevent.save(recording, folder / "small.h5")
        argv = f"reconstruct {folder}/small.h5 --method blend --at frames --out {folder}/{name}"
        assert cli.main(f"{argv} --tone linear".split()) == 0
        assert ("--tone log" in capsys.readouterr().out) == (name == "bright")
        with Image.open(folder / name / "frame_00000002.png") as image:
            np.testing.assert_array_equal(np.asarray(image), greys)


def test_dark_frames_are_shown_as_screens_expect(folder):
    """White is the brightest 0.5 % of the frames, half of its light grey 188 of sRGB."""
    greys = np.where(np.arange(WIDTH * HEIGHT).reshape(HEIGHT, WIDTH) % 3, 40, 20).astype(np.uint8)
    images = np.broadcast_to(greys, (6, HEIGHT, WIDTH))
    recording = small(frames=Frames(STAMPS, images, np.zeros_like(STAMPS)))
    jaxevent.save(recording, folder / "small.h5")
    argv = f"reconstruct {folder}/small.h5 --method blend --at frames --out {folder}/a"
    assert cli.main(argv.split()) == 0
    with Image.open(folder / "a" / "frame_00000002.png") as image:
        np.testing.assert_array_equal(np.asarray(image), np.where(greys == 40, 255, 188))


@pytest.mark.parametrize(
    ("rate", "fps", "factor"), [("500", 60, "0.12"), ("40", 40, "1")], ids=["slow", "real time"]
)
def test_reconstruct_to_video(rate, fps, factor, folder, capsys):
    ramp = 60 + 2 * np.arange(WIDTH) + 3 * np.arange(6)[:, None, None]  # 60 to 121 of 255
    images = np.broadcast_to(ramp, (6, HEIGHT, WIDTH)).astype(np.uint8)
    recording = small(frames=Frames(STAMPS, images, np.zeros_like(STAMPS)))
    jaxevent.save(recording, folder / "small.h5")
    path = folder / "out.mp4"
    argv = f"reconstruct {folder}/small.h5 --method blend --rate {rate} --tone percentile"
    assert cli.main([*argv.split(), "--out", str(path)]) == 0
    assert f"played at {fps} per s, {factor} of real time" in capsys.readouterr().out
    images, about = decoded(path, HEIGHT, WIDTH)
    times = np.arange(0, 52_001, 1_000_000 // int(rate))
    assert len(images) == len(times)
    assert f" {WIDTH}x{HEIGHT}" in about and f" {fps} fps" in about
    sample = times[np.unique(np.linspace(0, len(times) - 1, 16).round().astype(int))]
    video = jaxevent.blend.estimate(recording)
    limits = tuple(np.percentile(video(sample).mean, [0.5, 99.5]).tolist())
    shown = tone_map(video(times).mean, "percentile", limits).astype(float)
    assert np.abs(images - shown).mean() < 3


@pytest.mark.parametrize(
    ("method", "tone"), [("high-pass", "changes"), ("events-only", "relative")]
)
def test_without_frames_images_have_a_tone_of_their_own(folder, capsys, method, tone):
    recording = small(frames=None)
    jaxevent.save(recording, folder / "bare.h5")
    argv = f"reconstruct {folder}/bare.h5 --method {method} --rate 300 --out {folder}/{tone}"
    assert cli.main(argv.split()) == 0
    assert "frames," not in capsys.readouterr().out.partition("\n")[2]
    times = export.image_times(recording, 300)
    images, variance, _ = jaxevent.METHODS[method].estimate(recording)(times)
    shown = [np.asarray(Image.open(p)) for p in sorted((folder / tone).glob("*.png"))]
    limits = display_limits(images, tone, variance)
    np.testing.assert_array_equal(np.stack(shown), tone_map(images, tone, limits, variance))


def test_reconstruct_in_colour(folder):
    """Two colours side by side, far from black and white, on frames of their own brightness."""
    ramp = 60 + 2 * np.arange(WIDTH) + 3 * np.arange(6)[:, None, None]
    images = np.broadcast_to(ramp, (6, HEIGHT, WIDTH)).astype(np.uint8)
    rgb = np.empty((6, HEIGHT, WIDTH, 3), np.uint8)
    rgb[:, :, :10], rgb[:, :, 10:] = (140, 90, 60), (60, 100, 120)
    frames = Frames(STAMPS, images, np.zeros_like(STAMPS))
    recording = small(frames=frames, extra={"rgb": rgb})
    jaxevent.save(recording, folder / "small.h5")
    outs = {"a.h5": [], "b": ["--tone", "percentile"], "c.mp4": ["--tone", "linear"]}
    for name, tone in outs.items():
        argv = f"reconstruct {folder}/small.h5 --method blend --rate 300 --colour --out"
        assert cli.main([*argv.split(), str(folder / name), *tone]) == 0

    times = np.rint(np.arange(16) / 300 * 1e6).astype(np.int64)
    grey = jaxevent.blend.estimate(recording)(times).mean
    colour = rgb[0].astype(float)
    ratio = colour / (colour @ [0.2126, 0.7152, 0.0722])[..., None]
    with h5py.File(folder / "a.h5") as file:
        assert set(file) == {"t", "image"}
        np.testing.assert_array_equal(np.asarray(file["t"]), times)
        np.testing.assert_allclose(np.asarray(file["image"]), grey[..., None] * ratio, rtol=1e-5)

    low, high = np.percentile(grey, [0.5, 99.5])  # there are no more than 16 images to sample
    toned = np.rint(255 * ((grey - low) / (high - low)).clip(0, 1))
    expected = (toned[..., None] * ratio).clip(0, 255)
    for number, image in enumerate(expected):
        with Image.open(folder / "b" / f"frame_{number:08d}.png") as stored:
            assert np.abs(np.asarray(stored) - image).max() <= 2
    images, _ = decoded(folder / "c.mp4", HEIGHT, WIDTH, "rgb24")
    assert np.abs(images - 255 * grey[..., None] * ratio).mean() < 5


def test_a_pixel_without_bound_is_white_in_colour():
    """Pure red has no green; infinity times 0 is no number."""
    times = np.array([0])
    red = np.full((1, HEIGHT, WIDTH, 3), np.array([0.5, 0, 0]), np.float32)
    red[0, 3, 4] = (np.inf, np.nan, np.nan)
    video = jaxevent.blend.estimate(small())
    ((_, image),) = export.display_images(video, times, "linear", lambda _: red)
    assert image[3, 4].tolist() == [255, 255, 255]
    assert image[0, 0].tolist() == [127, 0, 0]


def equal(one: Recording, other: Recording) -> None:
    assert (one.name, one.width, one.height) == (other.name, other.width, other.height)
    assert isinstance(one.events, Events) and one.frames and other.frames
    for part, same in ((one.events, other.events), (one.frames, other.frames)):
        for name, values in vars(part).items():
            np.testing.assert_array_equal(values, getattr(same, name), name)
    assert set(one.extra) == set(other.extra)
    for name, values in one.extra.items():
        np.testing.assert_array_equal(values, other.extra[name], name)


def test_simulate_a_scene(tmp_path, capsys):
    out = tmp_path / "night.h5"
    argv = "simulate --scene night --speed fast --sensor poor --seed 3 --duration 0.3 --size 24,20"
    assert cli.main([*argv.split(), "--out", str(out)]) == 0
    source = Pan(scene("night"), (24, 20), 0.3, "fast", 3)
    recording = simulate(source, SENSORS["poor"], 3, "night-fast")
    equal(jaxevent.load(out), recording)
    assert described(out)["command"].startswith(f"jaxevent {argv}") and not described(out)["inputs"]
    said = capsys.readouterr().out
    assert said.startswith(f"{out}: {len(recording.events):,} events, 15 frames, 0.")
    assert said.count("\n") == 1 and [file.name for file in tmp_path.iterdir()] == ["night.h5"]


def test_what_is_simulated_by_default(tmp_path, monkeypatch):
    asked = []

    def record(*settings):
        asked.append(settings)
        return small()

    monkeypatch.setattr("jaxevent.simulate.simulate", record)
    assert cli.main(["simulate", "--scene", "7", "--out", str(tmp_path / "a.h5")]) == 0
    ((source, sensor, seed, name),) = asked
    assert (source.size, source.duration, source.speed, source.seed) == ((128, 96), 1.5, "slow", 0)
    np.testing.assert_array_equal(source.panorama, scene(7))
    assert (sensor, seed, name) == (SENSORS["davis"], 0, "7-slow")


@pytest.fixture
def film(tmp_path: Path) -> Path:
    """A folder of 12 colour images, 32x24: stripes that move 2 pixels from each to the next."""
    film = tmp_path / "film"
    film.mkdir()
    x = np.arange(32)
    for k in range(12):
        wave = 150 + 60 * np.sin((x - 2 * k) / 3)
        image = np.empty((24, 32, 3), np.uint8)
        image[:] = wave[:, None] * [1, 0.9, 0.8]
        Image.fromarray(image).save(film / f"{k}.png")
    return film


def test_simulate_a_video(film, capsys):
    part = "--start 0.1 --duration 0.2 --max-size 16"
    for out, options, settings in (
        ("a.h5", "", {}),
        ("b.h5", part, {"start": 0.1, "stop": 0.1 + 0.2, "max_size": 16}),
    ):
        argv = f"simulate {film} --sensor ideal --cut 30 --speed 0.5 --seed 2 {options} --out"
        assert cli.main([*argv.split(), str(film.parent / out)]) == 0
        recording = from_video(film, SENSORS["ideal"], cut=30, speed=0.5, seed=2, **settings)
        assert recording.frames is not None
        equal(jaxevent.load(film.parent / out), recording)
        assert described(film.parent / out)["inputs"][str(film)]["files"] == 12
        said = f"{out}: {len(recording.events):,} events, {len(recording.frames)} frames, "
        assert said in capsys.readouterr().out
    argv = f"reconstruct {film.parent}/b.h5 --method blend --rate 10 --colour --out {film}/c"
    assert cli.main(argv.split()) == 0
    with Image.open(film / "c" / "frame_00000000.png") as image:
        assert (image.mode, image.size) == ("RGB", (16, 12))


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ("--scene lakes", "'lakes'"),
        ("--scene lake --speed 2", "--speed 2"),
        ("--scene lake --sensor davi", "did you mean 'davis'"),
        ("--scene lake --seed -1", "--seed -1"),
        ("--scene lake --duration 0", "--duration 0"),
        ("--scene lake --duration inf", "--duration inf"),
        ("--scene lake --duration 0.01", "fewer than two frames"),
        ("--scene lake --size 0,9", "--size 0,9"),
        ("--scene lake --cut 50", "--cut is for a video"),
        ("--scene lake --max-size 50", "--max-size is for a video"),
        ("film --size 9,9", "--size is for a scene"),
        ("film --speed slow", "--speed slow is for a scene"),
        ("film --speed 0", "speed = 0"),
        ("film --cut 200", "200"),
        ("film --start 5", "film"),
        ("film --max-size 3", "max_size = 3"),
        ("none.mp4", "none.mp4: there is no such video or folder"),
        ("lake", "give a scene by --scene"),
    ],
)
def test_bad_ways_to_simulate(options, said, film, capsys, monkeypatch):
    monkeypatch.chdir(film.parent)
    fails(capsys, ["simulate", *options.split(), "--out", "out.h5"], said)
    assert [file.name for file in film.parent.iterdir()] == ["film"]


def test_evaluate(folder, capsys):
    config = write_config(folder, ONE)
    assert cli.main(["evaluate", str(config), "--out", str(folder / "results")]) == 0
    said = capsys.readouterr().out
    assert said.startswith((folder / "results" / "results.md").read_text())
    assert str(folder / "results") in said
    assert "| small.h5  | blend" in said
