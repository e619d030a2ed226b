"""Code blocks of Markdown pages, run in the order printed.

- `python` runs, in one scope per page.
- `sh` runs line by line: `jaxevent ...` in this process, `export NAME=...` in a shell. Lines that
  begin with `pip install` are left out.
- `toml` whose first line is a comment of a file's name, `# fit.toml`, is written to that file.
- `shell`, `text` and other `toml` are only shown.
"""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import jaxevent
from jaxevent import cli, events

PACKAGED = "data/slider_depth_crop.h5"
BLOCK = re.compile(r"^```(\w*)[^\n]*\n(.*?)^```$", re.DOTALL | re.MULTILINE)
SHOWN = ("shell", "text", "toml")


def shortened(text: str, path: Path) -> str:
    """The page about a sixth of the packaged recording, written to a file, and of shorter scenes.

    What is absolute replaces all before it: `files("jaxevent") / "/..."`.
    """
    whole = jaxevent.load(Path(jaxevent.__file__).parent / PACKAGED)
    jaxevent.save(events.crop(whole[0.6:1.0], 40, 30, 160, 120), path)
    assert f'"{PACKAGED}"' in text
    text = re.sub(r"^export crop=.*$", f"export crop=$(echo {path})", text, flags=re.MULTILINE)
    for long, short in (
        (f'"{PACKAGED}"', f'"{path}"'),
        ("--duration 0.1", "--duration 0.04"),
        ("--duration 0.3", "--duration 0.2"),
        ("dot[:0.1]", "dot[:0.06]"),
        ("duration=0.3", "duration=0.26"),
        ("iterations = 60", "iterations = 5"),
    ):
        text = text.replace(long, short)
    return text


def run_page(text: str) -> dict[str, Any]:
    """Run a page's blocks in the working directory; returns the scope of its Python."""
    scope: dict[str, Any] = {"__name__": "page"}
    for language, code in BLOCK.findall(text):
        named = re.match(r"# (\S+\.toml)\n", code)
        if language == "python":
            exec(compile(code, "page", "exec"), scope)
        elif language == "sh":
            for line in code.replace("\\\n", " ").splitlines():
                run_line(line)
        elif language == "toml" and named:
            Path(named[1]).write_text(code)
        else:
            assert language in SHOWN, f"a block {language!r} neither runs nor says that it is shown"
    return scope


def run_line(line: str) -> None:
    """Run one line of a shell block."""
    words = shlex.split(line, comments=True)
    if not words or words[:2] == ["pip", "install"]:
        return
    if words[0] == "export":
        name = words[1].partition("=")[0]
        here = {**os.environ, "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
        script = f'{line}\nprintf %s "${name}"'
        done = subprocess.run(
            ["sh", "-ec", script], env=here, capture_output=True, text=True, check=True
        )
        os.environ[name] = done.stdout
        return
    assert words[0] == "jaxevent", f"the tests do not know how to run {line!r}"
    assert cli.main([os.path.expandvars(word) for word in words[1:]]) == 0, line
