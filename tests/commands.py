"""What tests of commands share."""

import subprocess
from pathlib import Path

import imageio_ffmpeg
import numpy as np
from numpy.typing import NDArray

from jaxevent import cli


def fails(capsys, argv: list, *named: object) -> None:
    """The command says one line that names things, on stderr only, and exits with status 2."""
    assert cli.main([str(word) for word in argv]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.startswith("jaxevent: ") and said.err.count("\n") == 1
    for name in named:
        assert str(name) in said.err


def decoded(path: Path, height: int, width: int, pixels: str = "gray") -> tuple[NDArray, str]:
    """The grey images (T, H, W) of a video, in "rgb24" (T, H, W, 3), and what ffmpeg says of it."""
    # Not by the reader of imageio, which forks; JAX warns that this may deadlock.
    program = imageio_ffmpeg.get_ffmpeg_exe()
    decode = [program, "-i", path, "-f", "rawvideo", "-pix_fmt", pixels, "pipe:1"]
    done = subprocess.run(decode, capture_output=True, check=True)
    shape = (-1, height, width) if pixels == "gray" else (-1, height, width, 3)
    return np.frombuffer(done.stdout, np.uint8).reshape(shape), done.stderr.decode()
