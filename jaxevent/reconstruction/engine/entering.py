"""What bands do where a stretch of time begins, step by step: the same for all of them.

A piece of another frame needs other images, sums over exposures and counts of events. Which, only
times and places of fields tell, so it is decided here; `loop` takes the steps in order.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.reconstruction.engine.loop import (
    COUNT,
    FILL,
    LOAD,
    MOVE,
    SUM,
    FrameRows,
    Line,
    Steps,
)

Step = tuple[int, ...]  # its kind and what it is given

NO_FRAME = -9


class Places(NamedTuple):
    """Where the fields of `cells` lie, in strides; -1 where a method needs none."""

    stride: int
    factors: int  # of derivatives of images, for each pixel of a row
    room: int  # for derivatives of tables
    on: int
    off: int
    before: NDArray[np.int64]  # [2], ON and OFF
    image: NDArray[np.int64]  # [3, rows]: grey value, intensity, certainty
    total: NDArray[np.int64]  # [sums, rows]
    span: NDArray[np.int64]  # [2, rows]
    head: NDArray[np.int64]
    tail: NDArray[np.int64]
    # To where a field moves when a frame follows, and from: [fields, 2].
    shifted: NDArray[np.int64]


def steps_of(places: Places, line: Line, frames: FrameRows, enter: tuple[int, int]) -> Steps:
    """The steps at the beginning of each stretch of a window.

    It is entered at the time `enter[1]` (us since the recording's start), in the stretch
    `enter[0]`, with no frame known; that of the stretches before is not asked for.
    """
    first, now = enter
    ends, before, found = np.zeros(len(line.start) + 1, np.int64), NO_FRAME, list[Step]()
    writer = _Writer(places, line, frames)
    for stretch in range(first, len(line.start)):
        frame = int(line.frame[stretch])
        if frame != before:
            time = now if stretch == first else int(line.start[stretch])
            found += writer.at(frame, before, time)
        before, ends[stretch + 1] = frame, len(found)
    steps = np.zeros((len(found), 5), np.int64)
    for row, step in enumerate(found):
        steps[row, : len(step)] = step
    return Steps(steps, ends)


class _Writer:
    def __init__(self, places: Places, line: Line, frames: FrameRows):
        self.places, self.frames, self.opening = places, frames, line.opening
        # Events earlier than these whole numbers of us are before the time.
        edges = (frames.left, frames.mid, frames.right)
        self.left, self.mid, self.right = (np.ceil(e).astype(int).tolist() for e in edges)

    def at(self, frame: int, before: int, now: int) -> Iterator[Step]:
        """The steps where pieces of `frame` follow those of the frame `before`."""
        places, number = self.places, self.frames.number
        count = len(self.left) + number
        base = max(frame - 1, 0)
        rows = min(count, max(frame, 0) + 2) - base
        follows = frame == before + 1
        if follows and frame >= 2:
            for to, of in places.shifted.tolist():
                yield MOVE, to * places.stride, of * places.stride
        fresh = 0 if not follows else 3 if frame == 0 else 2
        for row in range(fresh, 3):
            yield from self._images(base + row - number, row, rows)
        for row in range(fresh, 3):
            left = mid = right = 0
            if row < rows:
                k = base + row - number
                left, mid, right = self.left[k], self.mid[k], self.right[k]
            yield from self._count(places.head[:, row], left, mid)
            yield from self._count(places.tail[:, row], mid, right)
        for row in range(0 if not follows else 2 if frame == 0 else 1, 2):
            left = right = 0
            if row + 1 < rows:  # another frame follows
                k = base + row - number
                left, right = self.left[k], self.right[k + 1]
            yield from self._count(places.span[:, row], left, right)
        # The piece counts from its exposure's left edge, before the first from the window's start.
        begin = self.left[frame - number] if frame >= 0 else now
        yield from self._count(np.array([places.on, places.off]), begin, now)
        if frame < 0 and count > 0:
            yield from self._count(places.before, self.opening, self.right[0])

    def _images(self, k: int, row: int, rows: int) -> Iterator[Step]:
        """Grey values, intensities and certainties of a row, and sums over its exposure."""
        places, stride = self.places, self.places.stride
        for kind in range(3):
            field = int(places.image[kind, row]) * stride
            if field >= 0 and row < rows:
                yield LOAD, field, kind, k
            elif field >= 0 and rows > 0:
                yield MOVE, field, int(places.image[kind, row - 1]) * stride
            elif field >= 0:
                yield FILL, field, int(kind < 2)
        for total in places.total[:, row].tolist():
            yield FILL, total * stride, 0
        if len(places.total) and row < rows:
            yield SUM, row, k

    def _count(self, fields: NDArray[np.int64], left: int, right: int) -> Iterator[Step]:
        """Count ON and OFF events with left <= t < right."""
        if fields[0] >= 0:
            on, off = (fields * self.places.stride).tolist()
            yield COUNT, on, off, left, right
