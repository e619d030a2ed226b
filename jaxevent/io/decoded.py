"""Events and images of a decoder that gives them block by block, in memory or left in the file.

A decoder is a generator function. Called with None it gives the blocks of a file in order, each
after the state that it was in before the block; called with one of these states it gives that
block and those after it. What a state is, is the decoder's own affair: an offset into the file and
the time base there, or, where packets can only be read in turn, the number of a packet. The first
pass over a file checks every event; a file that is left on disk is later decoded again where
events are asked for, at the memory of a few blocks.
"""

import dataclasses
import os
from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.errors import InputError, OrderError
from jaxevent.io import checked_events, disorder, reading
from jaxevent.io.options import ReadOptions
from jaxevent.io.reopening import EventsInFile, ImagesInFile
from jaxevent.locks import TurnLock, synchronized
from jaxevent.progress import bar
from jaxevent.recording import Events, EventSource, Triggers

BLOCK = 1 << 20  # events decoded together: 13 MB

Columns = disorder.Columns
Decoder = disorder.Decoder


class _Block(NamedTuple):
    state: Any
    row: int
    first: int
    last: int


def decoded(
    decode: Decoder,
    size: tuple[int, int],
    source: str,
    options: ReadOptions,
    origin: int = 0,
) -> EventSource:
    """All events of a decoder, checked: `Events` in memory, else `DecodedEvents`.

    The blocks hold t (int64 us), x, y and p as `checked_events` takes them. `size` is (width,
    height). Raises `InputError` for the first bad event and whatever the decoder finds wrong.
    """
    if options.repair is not None:
        decode = _with_repair(decode, source, options, options.repair)
    blocks: list[_Block] = []
    kept: list[Events] = []
    row = 0
    with (
        reading(source),
        bar(desc="decode", unit=" events", unit_scale=True, progress=options.progress) as shown,
    ):
        for state, (t, x, y, p) in decode(None):
            if not len(t):
                continue
            try:
                events = checked_events(t, x, y, p, size, source, first_row=row, origin=origin)
            except OrderError:
                raise _disorder(decode, source).explain(source) from None
            first, last = int(events.t[0]), int(events.t[-1])
            if blocks and first < blocks[-1].last:
                raise _disorder(decode, source).explain(source)
            blocks.append(_Block(state, row, first, last))
            if options.in_memory or len(kept) < 2:
                kept.append(events)
            else:
                kept[1] = events
            row += len(events)
            shown.update(len(events))
    if not blocks:
        return Events.empty()
    if options.in_memory or len(blocks) <= 2:
        return _joined(kept)
    return DecodedEvents(decode, blocks, row, (kept[0], kept[1]), size, source, origin)


def _with_repair(decode: Decoder, source: str, options: ReadOptions, asked: str) -> Decoder:
    """A decoder that makes the repairs asked for, with a note of them in the options."""
    repair = disorder.parse_repair(asked)
    found = _disorder(decode, source, repair.bound)
    found.refuse_rest(repair, source)
    options.notes.append(found.describe_repair(repair))
    return disorder.repaired(decode, found, repair)


def _disorder(decode: Decoder, source: str, bound: int = disorder.BOUND) -> disorder.Disorder:
    with reading(source):
        return disorder.examine((columns[0] for _, columns in decode(None)), bound, source)


def _joined(pieces: list[Events]) -> Events:
    if len(pieces) == 1:
        return pieces[0]
    columns = []
    for name in ("t", "x", "y", "p"):
        columns.append(np.concatenate([getattr(piece, name) for piece in pieces]))
    return Events.of_checked(*columns)


def from_columns(
    columns: Columns, size: tuple[int, int], source: str, options: ReadOptions, origin: int = 0
) -> Events:
    """The events of whole columns, checked and repaired as those of `decoded`."""
    whole = dataclasses.replace(options, in_memory=True, progress=False, notes=options.notes)
    return decoded(lambda _: iter([(None, columns)]), size, source, whole, origin)[:]


class Tally:
    """Counts of what a decoder meets on its first pass; later passes add nothing."""

    def __init__(self):
        self._counts: dict[str, int] = {}
        self._places: dict[str, int] = {}

    def add(self, name: str, number: int, place: int) -> None:
        """Count `number` more in the block at a place of the file, which rises block by block."""
        if number and place > self._places.get(name, -1):
            self._places[name] = place
            self._counts[name] = self._counts.get(name, 0) + number

    def arrays(self) -> dict[str, NDArray]:
        """The counts that are not 0, by name."""
        return {name: np.array(number) for name, number in sorted(self._counts.items())}


class TriggerList:
    """External triggers that a decoder meets on its first pass; later ones add none again."""

    def __init__(self):
        self._pieces: list[tuple[NDArray, NDArray, NDArray]] = []
        self._place = -1

    def add(self, place: int, t: NDArray, edge: NDArray | int, channel: NDArray | int) -> None:
        """Keep triggers of the block at a place of the file, which rises from block to block."""
        if place > self._place:
            self._place = place
            if len(t):
                edge, channel = np.broadcast_to(edge, len(t)), np.broadcast_to(channel, len(t))
                self._pieces.append((t, edge, channel))

    def all(self) -> Triggers | None:
        if not self._pieces:
            return None
        t, edge, channel = (np.concatenate(values) for values in zip(*self._pieces, strict=True))
        order = np.argsort(t, kind="stable")
        found = Triggers(t.astype(np.int64), edge.astype(np.int8), channel.astype(np.uint8))
        return found[order]


class DecodedEvents(EventsInFile):
    """Events left in a file that a decoder reads, an `EventSource`; see the module."""

    def __init__(
        self,
        decode: Decoder,
        blocks: list[_Block],
        count: int,
        ends: tuple[Events, Events],
        size: tuple[int, int],
        source: str,
        origin: int,
    ):
        self._decode = decode
        self._states = [block.state for block in blocks]
        self._rows = np.array([block.row for block in blocks] + [count])
        self._first = np.array([block.first for block in blocks])
        self._last = np.array([block.last for block in blocks])
        # A recording's start and stop are asked for often; neither may cost a pass over the file.
        self._ends = {0: ends[0], len(blocks) - 1: ends[1]}
        self._recent: dict[int, Events] = {}
        self._stream: Iterator[tuple[Any, Columns]] = iter(())
        self._next = -1
        self.checked_size, self._source, self._origin = size, source, origin
        self._turns, self._process = TurnLock(source), os.getpid()

    def __len__(self) -> int:
        return int(self._rows[-1])

    @synchronized
    def __getitem__(self, rows: slice) -> Events:
        """Decode the events of a range of rows; the file must not have changed since."""
        start, stop, step = rows.indices(len(self))
        if step != 1:
            raise ValueError("decoded events are read as a range of rows, events[i:j], step 1")
        if stop <= start:
            return Events.empty()
        block = int(np.searchsorted(self._rows, start, side="right")) - 1
        pieces = []
        while block < len(self._states) and self._rows[block] < stop:
            row = int(self._rows[block])
            pieces.append(self._block(block)[max(start - row, 0) : stop - row])
            block += 1
        return _joined(pieces)

    @synchronized
    def index(self, time: int) -> int:
        """The number of events earlier than `time` (us): at most one block is decoded."""
        block = int(np.searchsorted(self._first, time)) - 1
        if block < 0:
            return 0
        if self._last[block] < time:
            return int(self._rows[block + 1])
        return int(self._rows[block]) + self._block(block).index(time)

    def _block(self, number: int) -> Events:
        for held in (self._ends, self._recent):
            if number in held:
                return held[number]
        with reading(self._source):
            # Of a forked process the parent, too, would move the place in an open file.
            if number != self._next or self._process != os.getpid():
                self._process = os.getpid()
                self._stream = self._decode(self._states[number])
            columns = next((block for _, block in self._stream if len(block[0])), None)
        count = int(self._rows[number + 1] - self._rows[number])
        if columns is None or len(columns[0]) != count:
            raise InputError(
                f"{self._source}: no longer holds the events it held when it was opened; load it "
                "again"
            )
        events = checked_events(
            *columns,
            self.checked_size,
            self._source,
            first_row=int(self._rows[number]),
            origin=self._origin,
        )
        self._next = number + 1
        # Windows read in turn straddle two blocks and look back by one.
        self._recent = {n: b for n, b in self._recent.items() if n >= number - 1} | {number: events}
        if len(self._recent) > 3:
            self._recent = {number: events}
        return events


class DecodedImages(ImagesInFile):
    """Images (frames, height, width), or in colour (frames, height, width, 3), left in the file.

    `images(i)` decodes the images from number i on, in turn.
    """

    def __init__(
        self,
        images: Callable[[int], Iterable[NDArray]],
        shape: tuple[int, ...],
        dtype: np.dtype,
        source: str,
    ):
        self._reader = _ImageReader(images, shape[1:], dtype, source)
        self._rows = range(shape[0])

    @property
    def dtype(self) -> np.dtype:
        return self._reader.dtype

    @property
    def shape(self) -> tuple[int, ...]:
        return (len(self._rows), *self._reader.shape)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray:
        images = np.empty(self.shape, self.dtype)
        with self._reader.turns:
            for i, row in enumerate(self._rows):
                images[i] = self._reader.read(row)
        return np.asarray(images, dtype)


class _ImageReader:
    """The images of a file, read on from where it was left or else from anew."""

    def __init__(
        self,
        images: Callable[[int], Iterable[NDArray]],
        shape: tuple[int, ...],
        dtype: np.dtype,
        source: str,
    ):
        self.shape, self.dtype = shape, dtype
        self._images, self._source = images, source
        self.turns, self._process = TurnLock(source), os.getpid()
        self._stream: Iterator[NDArray] = iter(())
        self._next = -1

    def read(self, row: int) -> NDArray:
        with reading(self._source):
            if row != self._next or self._process != os.getpid():
                self._process = os.getpid()
                self._stream = iter(self._images(row))
            image = next(self._stream, None)
        if image is None or image.shape != self.shape or image.dtype != self.dtype:
            raise InputError(
                f"{self._source}: no longer holds the image it held when it was opened; load it "
                "again"
            )
        self._next = row + 1
        return image
