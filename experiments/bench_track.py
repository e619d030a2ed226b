"""What `jaxevent track` spends its time on: finding, following, reading, tables and the video.

    python experiments/bench_track.py --data DIR [--only NAME ...] [--find]

`simulated` is a target of a million events/s for four seconds, `long` for ten. With `--find` the
parts of finding alone. CPU seconds of this process and of ffmpeg, of the second of two runs in one
process, so without compilation; the video's time is what a folder with it takes more than one
without. Makes no file.
"""

import argparse
import contextlib
import resource
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

from blob_scenes import drifting

from jaxevent.blob import find, moment
from jaxevent.blob.search import search
from jaxevent.blob.search.stream import Stream
from jaxevent.io import load
from jaxevent.recording import Recording
from jaxevent.show.tracks import Output

PARTS = {  # of finding: where they are
    "background": (search, "measure_background"),
    "scale": (search, "select_scale"),
    "camera": (search, "find_moving_background"),
    "tracker": (search.WindowTracker, "run"),
    "beginnings": (search, "_extend_backwards"),
    "parts": (search, "merge_parts"),
    "taken away": (Stream, "without"),
    "polarity": (search, "prefer_sharper"),
}
SIMULATED = {"simulated": 4.0, "long": 10.0}  # s
NAMES = ("spinning_dot.npz", "davis346_street.npz", "atis.es")


def cpu() -> float:
    """Of this process and of those it waited for, s."""
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime


def timed(work: Callable[[], Any]) -> tuple[float, Any]:
    begin = cpu()
    told = work()
    return cpu() - begin, told


def recording_of(path: Path) -> Recording:
    if path.name in SIMULATED:
        return drifting(1, 1e6, 1e3, 10, SIMULATED[path.name], 2e4, 5)[0]
    return load(path, in_memory=False)


def parts_of(recording: Recording, folder: Path) -> list[float]:
    found_in, found = timed(lambda: find(recording, progress=False))
    params = moment.Params(**found.settings())

    def follow() -> Any:
        return moment.estimate(recording, params, found=found, progress=False)

    followed_in, _ = timed(follow)
    table, _ = timed(lambda: Output(folder / "t.csv").write(follow(), False))
    video, _ = timed(lambda: Output(folder / "t.mp4").write(follow(), False))
    events = len(recording.events) / (found_in + followed_in) * 1e-6
    return [found_in, followed_in, table - followed_in, video - followed_in, events]


def parts_of_finding(recording: Recording) -> list[float]:
    """CPU seconds of all, of each of `PARTS`, and M events/s."""
    spent = dict.fromkeys(PARTS, 0.0)

    def watched(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any, **options: Any) -> Any:
            seconds, told = timed(lambda: function(*args, **options))
            spent[name] += seconds
            return told

        return call

    with contextlib.ExitStack() as stack:
        for name, (place, function) in PARTS.items():
            call = watched(name, getattr(place, function))
            stack.enter_context(mock.patch.object(place, function, call))
        seconds, _ = timed(lambda: find(recording, progress=False))
    return [seconds, *spent.values(), len(recording.events) / seconds * 1e-6]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--only", nargs="+", default=NAMES)
    parser.add_argument("--find", action="store_true")
    args = parser.parse_args()
    columns = ["find s", "follow s", "table s", "video s", "find and follow, M events/s"]
    if args.find:
        columns = ["find s", *PARTS, "M events/s"]
    print(f"| recording | {' | '.join(columns)} |")
    print("|---|" + "---:|" * len(columns))
    for name in args.only:
        with tempfile.TemporaryDirectory() as folder:
            recording = recording_of(args.data / name)
            for _ in range(2):
                if args.find:
                    told = parts_of_finding(recording)
                else:
                    told = parts_of(recording, Path(folder))
        print(f"| {name} | " + " | ".join(f"{one:.2f}" for one in told) + " |", flush=True)


if __name__ == "__main__":
    main()
