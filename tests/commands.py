"""What tests of commands share."""

import subprocess
import tomllib
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
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
    imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="needs the extra 'video'")
    program = imageio_ffmpeg.get_ffmpeg_exe()
    decode = [program, "-i", path, "-f", "rawvideo", "-pix_fmt", pixels, "pipe:1"]
    done = subprocess.run(decode, capture_output=True, check=True)
    shape = (-1, height, width) if pixels == "gray" else (-1, height, width, 3)
    return np.frombuffer(done.stdout, np.uint8).reshape(shape), done.stderr.decode()


def described(path: Path, *unknown: str) -> dict[str, Any]:
    """What an HDF5 file says of itself, its TOML read; all datasets but `unknown` have a unit."""
    with h5py.File(path) as file:

        def look(name: str, one: Any) -> None:
            if isinstance(one, h5py.Dataset) and name not in unknown:
                assert isinstance(one.attrs["unit"], str), name

        file.visititems(look)
        told = dict(file.attrs)
    for name in {"inputs", "params"} & set(told):
        told[name] = tomllib.loads(told[name])
    return told
