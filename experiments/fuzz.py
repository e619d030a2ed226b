"""Feed every reader truncated, changed and random files: a clear error or a valid recording.

    python experiments/fuzz.py --inputs 10000
    python experiments/fuzz.py --inputs 10000 --formats evt3 aedat4 --seed 7

The first line is the nightly form; tests/io/test_io_fuzz.py runs a few inputs of each format. The
last four formats are archives, HDF5 files, images and headers of wrong structure, built by
tests/malformed.py. Each format is read in a process of its own that may use --memory MB more than
at its start and 60 s for one file. An input is made from the number of its seed alone, so that one
printed here fails again with --inputs 1 --seed N. Exit status 1 where a reader failed.
"""

import argparse
import contextlib
import faulthandler
import importlib
import os
import resource
import subprocess
import sys
import tempfile
import time
import warnings
import zipfile
from collections import Counter
from io import BytesIO
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import scipy.io

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from jaxevent import io  # noqa: E402
from jaxevent.errors import InputError  # noqa: E402
from jaxevent.recording import Frames, Recording  # noqa: E402

formats: Any = importlib.import_module("formats")
malformed: Any = importlib.import_module("malformed")

SIZE = (40, 30)
EVENTS = formats.events_of(0, 400, SIZE)
IMAGES = np.random.default_rng(1).integers(0, 256, (2, 30, 40)).astype(np.uint8)
IMAGE_T = (20_000, 60_000)


def _bag() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.bag"
        formats.bag(path, EVENTS, SIZE, IMAGES, IMAGE_T)
        return path.read_bytes()


def _bag2(encoding: str, storage: str, suffix: str) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a"
        formats.bag2(path, EVENTS, SIZE, encoding, storage, IMAGES, IMAGE_T)
        return next(path.glob(f"*.{suffix}")).read_bytes()


def _v2e() -> bytes:
    held = BytesIO()
    columns = [EVENTS.t, EVENTS.x, EVENTS.y, EVENTS.p]
    with h5py.File(held, "w") as file:
        file["events"] = np.stack(columns, 1).astype(np.uint32)
    return held.getvalue()


def _ours() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.h5"
        frames = Frames(np.array(IMAGE_T), IMAGES, np.array([200, 200]))
        io.save(Recording("a", *SIZE, EVENTS, frames), path, "gzip")
        return path.read_bytes()


def _npz() -> bytes:
    held = BytesIO()
    arrays: dict[str, Any] = {name: getattr(EVENTS, name) for name in "txyp"}
    np.savez_compressed(held, **arrays, frames=IMAGES, frame_t=np.array(IMAGE_T))
    return held.getvalue()


def _mat() -> bytes:
    held = BytesIO()
    columns = [EVENTS.t, EVENTS.x + 1, EVENTS.y + 1, EVENTS.p]
    images = np.moveaxis(IMAGES, 0, 2)
    arrays = {"events": np.stack(columns, 1).astype(float), "image": images}
    scipy.io.savemat(held, arrays | {"time_image": np.array(IMAGE_T, float)})
    return held.getvalue()


def _mat73() -> bytes:
    held = BytesIO()
    columns = [EVENTS.t, EVENTS.x + 1, EVENTS.y + 1, EVENTS.p]
    with h5py.File(held, "w", userblock_size=512) as file:
        file["events"] = np.stack(columns).astype(float)
        file["image"] = np.swapaxes(IMAGES, 1, 2)
        file["time_image"] = np.array(IMAGE_T, float)[:, None]
        file["other"] = np.zeros(2, np.uint64)
        file["other"].attrs["MATLAB_empty"] = np.uint8(1)
    return b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM" + held.getvalue()[128:]


def _zip() -> bytes:
    held = BytesIO()
    with zipfile.ZipFile(held, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("events.txt", formats.csv(EVENTS, SIZE, None, " ", seconds=True))
    return held.getvalue()


# Their order goes into the inputs of a seed: add others at the end.
FORMATS = {
    "evt2": lambda: formats.evt2(EVENTS, SIZE),
    "evt21": lambda: formats.evt21(EVENTS, SIZE),
    "evt3": lambda: formats.evt3(EVENTS, SIZE),
    "dat": lambda: formats.dat(EVENTS, SIZE),
    "es-dvs": lambda: formats.es(EVENTS, SIZE),
    "es-atis": lambda: formats.es(EVENTS, SIZE, np.arange(len(EVENTS)) % 3 == 0),
    "aedat2": lambda: formats.aedat2(
        EVENTS, SIZE, IMAGES.astype(int), IMAGE_T, imu=[(100 * i, range(7)) for i in range(20)]
    ),
    "aedat4": lambda: formats.aedat4(EVENTS, SIZE, IMAGES, IMAGE_T),
    "bag": _bag,
    "hdf5": _ours,
    "dsec": lambda: formats.dsec(EVENTS, SIZE, filters={"compression": "gzip"}),
    "event_utils": lambda: formats.event_utils(EVENTS, SIZE, IMAGES, IMAGE_T),
    "mvsec": lambda: formats.mvsec(EVENTS, SIZE, IMAGES, IMAGE_T),
    "m3ed": lambda: formats.m3ed(EVENTS, SIZE, sides=("left",)),
    "metavision": lambda: formats.metavision(EVENTS, SIZE),
    "npy": lambda: formats.npy(EVENTS, SIZE),
    "npz": _npz,
    "mat": _mat,
    "text": _zip,
    "csv": lambda: formats.csv(EVENTS, SIZE),
    "mat73": _mat73,
    "n_caltech": lambda: formats.n_caltech(EVENTS),
    "dvs128": lambda: formats.dvs128(EVENTS),
    "v2e": _v2e,
    "mcap": lambda: _bag2("mono", "mcap", "mcap"),
    "db3": lambda: _bag2("dvs_msgs", "sqlite3", "db3"),
    "archives": _zip,
    "links": lambda: formats.dsec(EVENTS, SIZE),
    "images": _zip,
    "headers": lambda: formats.evt2(EVENTS, SIZE),
}
_WHOLE: dict[str, bytes] = {}


def make_whole(name: str) -> bytes:
    """Return the undamaged file of a format, made once."""
    if name not in _WHOLE:
        _WHOLE[name] = FORMATS[name]()
    return _WHOLE[name]


def damage(name: str, seed: int) -> tuple[str, bytes]:
    """Return the kind of damage and the bytes of a file, from a seed alone."""
    random = np.random.default_rng([seed, list(FORMATS).index(name)])
    if name in malformed.BUILDERS:
        return malformed.BUILDERS[name](random)
    data = bytearray(make_whole(name))
    kind = ("cut", "bits", "bytes", "header", "numbers", "moved", "random")[random.integers(7)]

    def place(most: int | None = None) -> int:
        return int(random.integers(min(most or len(data), len(data))))

    if kind == "cut":
        del data[place() :]
    elif kind == "bits":
        for _ in range(random.integers(1, 9)):
            data[place()] ^= 1 << int(random.integers(8))
    elif kind == "bytes":
        for _ in range(random.integers(1, 9)):
            data[place()] = int(random.integers(256))
    elif kind == "header":
        for _ in range(random.integers(1, 5)):
            data[place(512)] = int(random.integers(256))
    elif kind == "numbers":  # as counts, offsets and times: -1, 2^31 - 1, 2^60, ...
        for _ in range(random.integers(1, 4)):
            at = place(4096 if random.random() < 0.5 else None)
            big = (b"\xff" * 4, b"\xff\xff\xff\x7f", b"\xff" * 8, b"\0" * 7 + b"\x10", b"\0" * 8)
            value = big[random.integers(len(big))]
            data[at : at + len(value)] = value
    elif kind == "moved":
        a, b, at = sorted((place(), place())) + [place()]
        piece = data[a : min(b, a + 2000)]
        if random.random() < 0.5:
            del data[a : a + len(piece)]
        else:
            data[at:at] = piece
    else:
        keep = place(64)
        data = data[:keep] + bytearray(random.bytes(int(random.integers(2000))))
    return kind, bytes(data)


def read_damaged(name: str, seed: int, path: Path) -> str:
    """Read one damaged file both ways; return the outcome. Raises AssertionError for a fault.

    A file that could be read in memory gives the same events when it is left on disk; one that
    lost its end gives those that came before, and none of them changed.
    """
    kind, data = damage(name, seed)
    path.write_bytes(data)
    # AEDAT 2 tells the chip, which has more pixels than these events' sensor.
    size = None if name == "dvs128" else SIZE if seed % 4 or name == "aedat2" else None
    try:
        recording = io.load(path, size)
        recording.check()
    except InputError as error:
        text = str(error)
        assert str(path) in text and "\n" not in text and len(text) < 1500, text
        assert not _read_from_disk(path, size), f"in memory refused ({text}), on disk read"
        return "refused"
    events = recording.events
    left = io.load(path, size, in_memory=False)
    assert len(left.events) == len(events)
    both = left.events[:]
    for field in ("t", "x", "y", "p"):
        np.testing.assert_array_equal(getattr(both, field), getattr(events, field))
    if len(events):
        middle = int(events[len(events) // 2 : len(events) // 2 + 1].t[0])
        with contextlib.suppress(InputError):  # a damaged table of milliseconds says so
            assert left.events.index(middle) == events.index(middle)
    if kind == "cut":
        before = EVENTS[: len(events)]
        for field in ("x", "y", "p"):
            np.testing.assert_array_equal(getattr(events[:], field), getattr(before, field))
    return "read"


def _read_from_disk(path: Path, size: tuple[int, int] | None) -> bool:
    """Return True if a file left on disk can be read whole; bad events are refused when read."""
    with contextlib.suppress(InputError):
        left = io.load(path, size, in_memory=False)
        left.events[:]
        if left.frames is not None:
            np.asarray(left.frames.images)
            left.check()
        return True
    return False


def _one_format(name: str, inputs: int, seed: int, memory: int) -> None:
    warnings.simplefilter("error")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.bin"
        path.write_bytes(make_whole(name))
        io.load(path, None if name == "dvs128" else SIZE)
        used = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        counts: Counter[str] = Counter()
        more, slowest, began = 0, 0.0, time.perf_counter()
        for number in range(seed, seed + inputs):
            print(number, file=sys.stderr)
            faulthandler.dump_traceback_later(60, exit=True)
            start = time.perf_counter()
            counts[read_damaged(name, number, path)] += 1
            slowest = max(slowest, time.perf_counter() - start)
            faulthandler.cancel_dump_traceback_later()
            more = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - used) // 1000
            if more > memory:
                sys.exit(f"{name} used {more} MB more than at its start, over {memory}")
        took = time.perf_counter() - began
    text = ", ".join(f"{number} {what}" for what, number in sorted(counts.items()))
    print(
        f"{name:12} {text}; {took:.0f} s, the slowest {slowest:.2f} s, {more} MB more at the peak"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--inputs", metavar="N", type=int, default=1000, help="default: 1000")
    parser.add_argument(
        "--formats", metavar="NAME", nargs="+", choices=FORMATS, help="default: all"
    )
    parser.add_argument("--seed", metavar="N", type=int, default=0, help="of the first input")
    parser.add_argument("--memory", metavar="MB", type=int, default=500, help="default: 500")
    parser.add_argument("--here", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args()
    failed = []
    for name in args.formats or FORMATS:
        if args.here:
            _one_format(name, args.inputs, args.seed, args.memory)
            continue
        command = [sys.executable, __file__, "--here", "--formats", name]
        command += ["--inputs", str(args.inputs), "--seed", str(args.seed)]
        command += ["--memory", str(args.memory)]
        done = subprocess.run(
            command, stderr=subprocess.PIPE, text=True, env={**os.environ, "RUST_BACKTRACE": "0"}
        )
        if done.returncode:
            failed.append(name)
            lines = done.stderr.splitlines()
            last = next((line for line in reversed(lines) if line.isdigit()), "?")
            print(f"{name}: failed at seed {last}, status {done.returncode}", flush=True)
            print("\n".join(lines[-15:]), flush=True)
    sys.exit(bool(failed))


if __name__ == "__main__":
    main()
