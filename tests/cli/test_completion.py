"""Completion of words in a shell is made by shtab, where it is installed."""

import subprocess
import sys
import types

import pytest

from jaxevent import cli
from jaxevent.errors import install_command


def test_the_script_is_that_of_shtab(capsys, monkeypatch):
    made = types.ModuleType("shtab")
    made.complete = lambda parser, shell: f"{parser.prog} for {shell}"
    made.FILE = {}
    monkeypatch.setitem(sys.modules, "shtab", made)
    with pytest.raises(SystemExit) as stop:
        cli.main(["--print-completion", "zsh"])
    assert not stop.value.code and capsys.readouterr().out == "jaxevent for zsh\n"
    monkeypatch.setitem(sys.modules, "shtab", None)
    with pytest.raises(SystemExit) as stop:
        cli.main(["--print-completion", "zsh"])
    assert stop.value.code == 2 and install_command("completion") in capsys.readouterr().err


def test_bash_completes_options(tmp_path):
    pytest.importorskip("shtab", reason="needs the extra completion")
    command = [sys.executable, "-m", "jaxevent", "--print-completion", "bash"]
    script = tmp_path / "completion.bash"
    script.write_text(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
    (tmp_path / "street.aedat4").touch()
    for words, number, expected in (
        ("jaxevent filter --back", 2, "--background"),
        ("jaxevent info str", 2, "street.aedat4"),
    ):
        ask = f"source {script}; COMP_WORDS=({words}); COMP_CWORD={number}; _shtab_jaxevent"
        done = subprocess.run(
            ["bash", "-c", f"{ask}; echo ${{COMPREPLY[@]}}"],
            capture_output=True, text=True, check=True, cwd=tmp_path,
        )  # fmt: skip
        assert expected in done.stdout.split()
