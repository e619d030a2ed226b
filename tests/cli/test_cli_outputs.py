"""Where commands write: never onto an input, never unasked onto a file; what signals leave."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import fails
from noise import ONE, small, write_config

import jaxevent
from jaxevent import cli
from jaxevent.cli import arguments
from jaxevent.egomotion.truth import known_motion
from jaxevent.io import output
from jaxevent.register.geometry import read_homography
from jaxevent.runs import results
from jaxevent.runs.blob_scores import read_positions

RECONSTRUCT = "reconstruct {source} --method blend --rate 5 --out {out}"
COMMANDS = {
    "convert": "convert {source} {out}",
    "reconstruct": RECONSTRUCT,
    "track": "track {source} --out {out}",
    "motion": "motion {source} --model planar --out {out}",
    "motion's truth": "motion other.h5 --model planar --truth {source} --out {out}",
    "params": "reconstruct other.h5 --method blend --params {source} --out {out}",
    "simulate": "simulate {source} --out {out}",
    "register": "register {source} --frames other.h5 --out {out}",
    "frames": "register other.h5 --frames {source} --out {out}",
    "homography": "register other.h5 --frames other.h5 --homography {source} --out {out}",
    "calibration": "register other.h5 --frames other.h5 --calibration {source} --out {out}",
    "filter": "filter {source} {out}",
    "view": "view {source} --out {out}",
    "response": "camera attach other.h5 --response {source} --out {out}",
    "depth": "register other.h5 --frames other.h5 --depth {source} --out {out}",
}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch) -> Path:
    jaxevent.save(small(), tmp_path / "source.h5")
    os.symlink("source.h5", tmp_path / "symbolic.h5")
    os.link(tmp_path / "source.h5", tmp_path / "hard.h5")
    (tmp_path / "sub").mkdir()
    monkeypatch.chdir(tmp_path)
    return tmp_path


def state(folder: Path) -> dict[Path, bytes | None]:
    """All that is in a folder, to the byte."""
    return {
        path: path.read_bytes() if path.is_file() else None for path in sorted(folder.rglob("*"))
    }


@pytest.mark.parametrize("name", COMMANDS)
def test_no_command_writes_onto_its_input(name, folder, capsys):
    before = state(folder)
    for out in ("source.h5", "sub/../source.h5", "symbolic.h5", "hard.h5", folder / "source.h5"):
        for more in ([], ["--force"]):
            argv = [word.format(source="source.h5", out=out) for word in COMMANDS[name].split()]
            fails(capsys, [*argv, *more], out, "is an input too")
    assert state(folder) == before


@pytest.mark.parametrize(
    ("name", "other"),
    [
        ("a_cd.dat", "a_trigger.dat"),
        ("a_data.hdf5", "a_gt.hdf5"),
        ("a_data.h5", "a_depth_gt.h5"),
        ("a.h5", "rectify_map.h5"),
    ],
)
def test_what_is_read_beside_an_input_is_an_input_too(name, other, folder, capsys):
    for file in (name, other):
        (folder / file).write_bytes(b"kept")
    before = state(folder)
    fails(capsys, ["convert", name, other, "--force"], other, "is an input too")
    assert state(folder) == before


@pytest.mark.parametrize("name", ["reconstruct", "track", "motion"])
def test_no_folder_is_written_that_holds_an_input_or_is_a_part_of_it(name, folder, capsys):
    (folder / "sub" / "rec").mkdir()
    for file in ("images.txt", "events.txt"):
        (folder / "sub" / "rec" / file).write_text("0.1 3 4 1\n")
    before = state(folder)
    for source, out, said in (
        (folder / "source.h5", folder, "holds the input"),
        ("sub/rec/events.txt", "sub", "holds the input"),
        ("sub", "sub/rec", "is a part of the input"),
        ("sub", "sub", "is an input too"),
    ):
        argv = [word.format(source=source, out=out) for word in COMMANDS[name].split()]
        fails(capsys, [*argv, "--force"], out, said)
    fails(capsys, ["convert", "sub/rec", "sub/rec/events.txt", "--force"], "is a part of the input")
    assert state(folder) == before


@pytest.mark.parametrize("name", ["convert", "simulate", "register"])
def test_a_recording_is_not_stored_under_the_name_of_another_format(name, folder, capsys):
    words = COMMANDS[name].format(source="source.h5", out="new.npz").split()
    fails(capsys, words, "new.npz", "end the name in .h5")
    assert not Path("new.npz").exists()


def test_two_outputs_have_two_names(folder, capsys):
    before = state(folder)
    for table in ("z.h5", "sub/../z.h5"):
        words = f"simulate --blobs lissajous --duration 0.01 --truth {table} --out z.h5"
        fails(capsys, words.split(), "two outputs")
        words = f"simulate --motion planar --duration 0.01 --truth {table} --out z.h5 --force"
        fails(capsys, words.split(), "two outputs")
    assert state(folder) == before


def test_files_are_replaced_only_with_force(folder, capsys):
    for out in ("kept.h5", "kept.mp4"):
        (folder / out).write_text("mine")
        argv = RECONSTRUCT.format(source="source.h5", out=out).split()
        fails(capsys, argv, out, "--force")
        assert (folder / out).read_text() == "mine"
    fails(capsys, ["convert", "source.h5", "kept.h5"], "--force")
    (folder / "t.csv").write_text("mine")
    fails(capsys, "simulate --blobs disc --truth t.csv --out new.h5".split(), "t.csv", "--force")
    assert not (folder / "new.h5").exists() and (folder / "t.csv").read_text() == "mine"
    assert cli.main(["convert", "source.h5", "kept.h5", "--force"]) == 0
    assert len(jaxevent.load(folder / "kept.h5").events) == len(small().events)


@pytest.mark.slow
def test_in_a_folder_others_stay(folder, capsys):
    argv = ["reconstruct", "source.h5", "--method", "blend", "--out", "pictures", "--rate"]
    (folder / "pictures").mkdir()
    assert cli.main([*argv, "300"]) == 0  # an empty folder is one to write into
    (folder / "pictures" / "notes.txt").write_text("mine")
    (folder / "pictures" / "frame_1.png").write_text("mine too")
    many = len(list((folder / "pictures").glob("frame_*")))
    before = state(folder)
    capsys.readouterr()
    fails(capsys, [*argv, "100"], "pictures", "not empty", "--force")
    assert state(folder) == before
    assert cli.main([*argv, "100", "--force"]) == 0
    lines = (folder / "pictures" / "images.txt").read_text().splitlines()
    named = {line.split()[1] for line in lines}
    assert len(named) < many - 1
    there = {path.name for path in (folder / "pictures").iterdir()}
    assert there == named | {"images.txt", "notes.txt", "frame_1.png"}


@pytest.mark.slow
def test_folders_of_results(folder, capsys):
    """An evaluation goes on in its own folder, and replaces nobody's files."""
    config = write_config(folder, ONE.replace("small.h5", "source.h5"))
    evaluate = ["evaluate", config.name, "--out", "results"]
    (folder / "results").mkdir()
    (folder / "results" / "config.toml").write_text("mine")
    fails(capsys, evaluate, "results/config.toml", "--force")
    assert (folder / "results" / "config.toml").read_text() == "mine"
    assert cli.main([*evaluate, "--force"]) == 0
    assert cli.main(evaluate) == 0
    capsys.readouterr()
    fails(capsys, ["demo", "--out", "results"], "results/results.md", "--force")
    fit = ["fit", config.name, "--out", "results"]
    config.write_text(ONE.replace("small.h5", "source.h5") + 'fit = ["I0"]\n')
    fails(capsys, fit, "results/results.json", "--force")


def test_the_demo_owns_its_folder_and_no_other(folder, monkeypatch):
    asked = []
    monkeypatch.setattr("jaxevent.runs.demo.demo", lambda out, **how: asked.append(how["replace"]))
    for words in (["demo"], ["demo", "--out", "mine"], ["demo", "--out", "mine", "--force"]):
        assert cli.main(words) == 0
    assert asked == [True, False, True]


@pytest.mark.parametrize("command", ["fit", "evaluate"])
def test_results_are_not_written_onto_what_the_configuration_names(command, folder, capsys):
    (folder / "results.json").write_text("I0 = 0.2\n")
    text = ONE.replace("small.h5", "source.h5") + 'params = "results.json"\n'
    more = 'fit = ["I0"]\n' if command == "fit" else ""
    config = write_config(folder, text + more)
    before = state(folder)
    fails(capsys, [command, config, "--out", folder, "--force"], "results.json", "an input too")
    (folder / "results.json").rename(folder / "start.toml")
    config.write_text(config.read_text().replace("results.json", "start.toml"))
    config.rename(folder / "config.toml")
    before = state(folder)
    argv = [command, "config.toml", "--out", ".", "--force"]
    fails(capsys, argv, "config.toml", "an input too")
    assert state(folder) == before


@pytest.mark.slow
def test_what_a_killed_process_left_is_removed(folder):
    code = """
import os, signal
from pathlib import Path
from jaxevent.io.output import complete
with complete(Path("a.h5")) as a, complete(Path("b"), directory=True) as b:
    (b / "x").touch()
    os.kill(os.getpid(), signal.SIGKILL)
"""
    subprocess.run([sys.executable, "-c", code], cwd=folder)
    left = sorted(folder.glob(".*.part"))
    assert len(left) == 2
    other = folder / ".a.h5.notes.part"  # not of ours
    other.touch()
    with output.complete(folder / "a.h5") as partial:
        assert not left[0].exists() and partial.exists() and left[1].exists()
        with output.complete(folder / "a.h5") as another:  # what is at work is left alone
            assert partial.exists() and another.exists()
    with output.complete(folder / "b", directory=True):
        assert not left[1].exists()
    assert sorted(folder.glob(".*")) == [other]


def test_what_another_process_writes_is_refused(folder, capsys):
    before = state(folder)
    with output.complete(folder / "a.h5"):
        fails(capsys, ["convert", "source.h5", "a.h5", "--force"], "another process")
    assert state(folder).keys() == before.keys() | {folder / "a.h5"}
    assert not output.partials(folder / "a.h5")


@pytest.mark.parametrize("name", COMMANDS)
def test_a_missing_folder_is_told_before_anything_is_read(name, folder, capsys, monkeypatch):
    def read(*_: Any, **__: Any) -> None:
        raise AssertionError("the command has begun its work")

    monkeypatch.setattr(arguments, "open_recording", read)
    argv = COMMANDS[name].format(source="source.h5", out="missing/a.h5").split()
    fails(capsys, argv, "missing/a.h5: cannot be written (No such file or directory)")


def test_names_that_no_file_can_have_are_told(folder, capsys):
    before = state(folder)
    fails(capsys, ["convert", "source.h5", "x" * 300 + ".h5"], "File name too long")
    fails(capsys, ["info", "x" * 300 + ".h5"], "File name too long")
    use = ["reconstruct", "source.h5", "--method", "akf", "--out", "a.h5"]
    fails(capsys, [*use, "--params", "."], ".: cannot be read (Is a directory)")
    fails(
        capsys,
        [*use, "--times", "nofile"],
        "nofile: cannot be read (No such file",
        "check the path",
    )
    assert state(folder) == before


def test_a_link_to_nothing_is_kept(folder, capsys):
    (folder / "a.h5").symlink_to("nothing.h5")
    fails(capsys, ["convert", "source.h5", "a.h5"], "a.h5: exists")
    assert (folder / "a.h5").is_symlink()
    assert cli.main(["convert", "source.h5", "a.h5", "--force"]) == 0


def test_a_working_folder_that_is_gone_is_told(folder, capsys, monkeypatch):
    (folder / "gone").mkdir()
    monkeypatch.chdir(folder / "gone")
    (folder / "gone").rmdir()
    fails(capsys, ["convert", folder / "source.h5", "a.h5"], "working folder is no longer there")


@pytest.mark.parametrize("more", [[], ["--force"]])
def test_an_output_is_claimed_before_the_work_begins(more, folder, capsys, monkeypatch):
    """A command that begins while another one reads its input does not write the same output."""
    argv, read = ["convert", "source.h5", "a.h5"], arguments.open_recording

    def read_meanwhile(*given, **options):
        monkeypatch.setattr(arguments, "open_recording", read)
        fails(capsys, [*argv, *more], "a.h5: is being written by another process")
        return read(*given, **options)

    monkeypatch.setattr(arguments, "open_recording", read_meanwhile)
    before = state(folder)
    assert cli.main(argv) == 0
    assert state(folder).keys() == before.keys() | {folder / "a.h5"}


def test_a_fit_has_its_folder_alone(folder, capsys):
    config = write_config(folder, ONE.replace("small.h5", "source.h5") + 'fit = ["I0"]\n')
    (folder / "fitted").mkdir()
    with results.lock_folder(folder / "fitted"):
        for more in ([], ["--resume"], ["--force"]):
            argv = ["fit", config, "--out", "fitted", *more]
            fails(capsys, argv, "fitted: another process writes there")
    assert not list((folder / "fitted").iterdir())


def as_process(*words: object, **how: Any) -> subprocess.CompletedProcess:
    env = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    env["PYTHONPATH"] = str(Path(jaxevent.__file__).parents[1])
    env.update(how.pop("env", {}))
    return subprocess.run([sys.executable, "-m", "jaxevent", *map(str, words)], env=env, **how)


@pytest.mark.slow
@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_what_cannot_be_printed(folder):
    """One sentence or, where stderr is lost as well, none; a reader that left is no fault."""
    sentence = b"jaxevent: what was to be printed cannot be written (No space left on device)\n"
    with open("/dev/full", "wb") as full:
        for words in (["info", "source.h5"], ["info", "--help"]):
            done = as_process(*words, stdout=full, stderr=subprocess.PIPE)
            assert (done.returncode, done.stderr) == (2, sentence)
        done = as_process("info", "none.h5", stdout=subprocess.PIPE, stderr=full)
        assert (done.returncode, done.stdout) == (2, b"")
    read, write = os.pipe()
    os.close(read)
    done = as_process("info", "source.h5", stdout=write, stderr=subprocess.PIPE)
    os.close(write)
    assert (done.returncode, done.stderr) == (141, b"")
    for closed, said in ((1, "Bad file descriptor"), (2, "")):
        done = subprocess.run(
            ["sh", "-c", f'exec "$@" {closed}>&-', "sh", sys.executable, "-m", "jaxevent"]
            + ["convert", "source.h5", f"{closed}.h5"],
            env={**os.environ, "PYTHONPATH": str(Path(jaxevent.__file__).parents[1])},
            capture_output=True,
            text=True,
        )
        assert done.returncode == (2 if closed == 1 else 0)
        assert said in done.stderr and done.stderr.count("\n") == bool(said)
        assert len(jaxevent.load(folder / f"{closed}.h5").events) == len(small().events)


@pytest.mark.slow
def test_a_terminal_without_other_letters(folder):
    (folder / "source.h5").rename(folder / "\u00b5.h5")
    ascii = {"LC_ALL": "C", "PYTHONIOENCODING": "ascii", "PYTHONUTF8": "0"}
    done = as_process("info", "\u00b5.h5", capture_output=True, env=ascii | {"PYTHONUTF8": "1"})
    assert (done.returncode, done.stderr) == (0, b"")
    assert done.stdout.startswith(b"file           ") and b"\\xb5.h5" in done.stdout
    done = as_process("info", "\u00e9.h5", capture_output=True, env=ascii)
    assert done.returncode == 2 and done.stderr.startswith(b"jaxevent: ")
    assert done.stderr.count(b"\n") == 1


def test_a_byte_order_mark_is_no_reason_to_refuse(folder):
    mark = b"\xef\xbb\xbf"
    place = folder / "sub"
    for name, text in (
        ("events.csv", "t,x,y,p\n1,2,3,1\n5,2,3,0\n"),
        ("events.txt", "# t x y p\n0.1 2 3 1\n0.5 2 3 0\n"),
        ("params.toml", "c_on = 0.25\n"),
        ("motion.csv", "t,vx,vy\n0,1,2\n1,1,2\n"),
        ("positions.csv", "t,x,y\n0,1,2\n1,1,2\n"),
        ("homography.csv", "1,0,0\n0,1,0\n0,0,1\n"),
    ):
        (place / name).write_bytes(mark + text.encode())
    events = jaxevent.load(place / "events.csv", (10, 10)).events
    assert (events[:].t.tolist(), events[:].x.tolist()) == ([1, 5], [2, 2])
    recording = jaxevent.load(place, (10, 10))
    assert recording.events[:].t.tolist() == [100_000, 500_000]
    assert float(jaxevent.akf.Params.load(place / "params.toml").c_on) == pytest.approx(0.25)
    assert known_motion(recording, "planar", place / "motion.csv").t.tolist() == [0, 1_000_000]
    assert len(read_positions(place / "positions.csv").t) == 2
    assert read_homography(place / "homography.csv").tolist() == np.eye(3).tolist()
