"""Targets of real recordings that are changed in ways that change nothing: as many, as long.

    python experiments/blob_changed.py --out changed [--data DIR]

DIR holds the recordings, by default $JAXEVENT_DATA/data. Each is searched for targets (`find`, what
`jaxevent track FILE` begins with) as it is, ten times slower and faster, mirrored, transposed,
backwards, of half the width and height, with a third of its events, with twice its events of noise,
and in cuts. Told are targets that are seen for a fifth of the time, and the others. What the
recordings hold: `spinning_dot.npz` one dot, `davis346_street.npz` three cars, of which the third
comes after 0.6 s, `atis.es` one target. Makes table.md.
"""

import argparse
import os
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from jaxevent.blob import find
from jaxevent.io import load
from jaxevent.recording import Events, Recording

HELD = {"spinning_dot.npz": 1, "davis346_street.npz": 3, "atis.es": 1}
LONG = 0.2  # of the recording
Change = Callable[[Recording], Recording]


def changed(
    recording: Recording, t=None, x=None, y=None, keep=None, width=None, height=None
) -> Recording:
    """The recording with other columns of events, or some of them."""
    events = recording.events[:]
    t = events.t if t is None else t
    x = events.x if x is None else x
    y = events.y if y is None else y
    which = np.arange(len(t)) if keep is None else keep
    order = np.argsort(t[which], kind="stable")
    some = Events(t[which][order], x[which][order], y[which][order], events.p[which][order])
    return Recording(recording.name, width or recording.width, height or recording.height, some)


def noisy(recording: Recording) -> Recording:
    rng, e = np.random.default_rng(0), recording.events[:]
    more = 2 * len(e)
    t = np.concatenate([e.t, rng.integers(e.t[0], e.t[-1], more)])
    x = np.concatenate([e.x, rng.integers(0, recording.width, more).astype(e.x.dtype)])
    y = np.concatenate([e.y, rng.integers(0, recording.height, more).astype(e.y.dtype)])
    p = np.concatenate([e.p, rng.random(more) < 0.5])
    order = np.argsort(t, kind="stable")
    events = Events(t[order], x[order], y[order], p[order])
    return Recording(recording.name, recording.width, recording.height, events)


def cut(begin: float, end: float) -> Change:
    def of(recording: Recording) -> Recording:
        t = recording.events[:].t
        part = (t - t[0]) / (t[-1] - t[0])
        return changed(recording, keep=np.flatnonzero((part >= begin) & (part < end)))

    return of


def changes() -> Iterator[tuple[str, Change]]:
    yield "as it is", lambda r: r
    yield "ten times slower", lambda r: changed(r, t=10 * r.events[:].t)
    yield "ten times faster", lambda r: changed(r, t=r.events[:].t // 10)
    yield "mirrored", lambda r: changed(r, x=r.width - 1 - r.events[:].x)
    yield (
        "transposed",
        lambda r: changed(r, x=r.events[:].y, y=r.events[:].x, width=r.height, height=r.width),
    )
    yield "backwards", lambda r: changed(r, t=r.events[:].t[-1] - r.events[:].t)
    yield (
        "half the size",
        lambda r: changed(
            r, x=r.events[:].x // 2, y=r.events[:].y // 2, width=r.width // 2, height=r.height // 2
        ),
    )
    yield "a third of its events", lambda r: changed(r, keep=np.arange(0, len(r.events), 3))
    yield "thrice as many by noise", noisy
    for begin, end in ((0.3, 1.0), (0.5, 1.0), (0.7, 1.0), (0.2, 0.5), (0.5, 0.75)):
        yield f"cut from {begin:g} to {end:g}", cut(begin, end)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--data", type=Path)
    args = parser.parse_args()
    data = args.data or Path(os.environ["JAXEVENT_DATA"]) / "data"
    recordings = {name: load(data / name) for name in HELD}
    lines = ["| changed | " + " | ".join(f"{n} ({k})" for n, k in HELD.items()) + " |"]
    lines += ["|---|" + "---:|" * len(HELD)]
    for what, change in changes():
        cells = []
        for recording in recordings.values():
            one = change(recording)
            lives = np.array([p.end - p.begin for p in find(one, progress=False).paths])
            long = int((lives > LONG * (one.stop - one.start)).sum())
            cells.append(f"{long} + {len(lives) - long}")
        lines.append(f"| {what} | " + " | ".join(cells) + " |")
        print(lines[-1], flush=True)
    args.out.mkdir(parents=True, exist_ok=True)
    (args.out / "table.md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
