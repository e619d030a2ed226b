"""Events and images of a decoder that gives them block by block, in memory or left in the file.

A decoder is a generator function. Called with None it yields the blocks of a file in order, each
after the state that it was in before the block; called with one of these states it yields that
block and those after it. Each decoder chooses what its state is: an offset into the file and the
time base there, or the number of a packet where packets can only be read in turn. The first pass
over a file checks every event. A file that is left on disk is decoded again later, where events
are needed, at the memory of a few blocks.

Events and images that stay in files are pickled and copied by the arguments of `load` that opened
them: a copy opens the file again.
"""

import functools
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple, ParamSpec, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from jaxevent.errors import InputError, OrderError
from jaxevent.io import disorder
from jaxevent.io.checks import ReadOptions, check_events, reading
from jaxevent.progress import bar
from jaxevent.recording import Events, EventSource, Recording, Triggers, slice_bounds
from jaxevent.threads import TurnLock, synchronized

BLOCK_EVENTS = 1 << 20  # events decoded together: 13 MB

Columns = disorder.Columns
Decoder = disorder.Decoder
P = ParamSpec("P")
T = TypeVar("T")


class LoadCall:
    """The arguments of `load` by which a recording was opened."""

    def __init__(self, arguments: tuple[Any, ...], options: dict[str, Any]):
        self.arguments, self.options = arguments, options
        self._recording: Recording | None = None

    def __reduce__(self) -> tuple[Any, ...]:
        return LoadCall, (self.arguments, self.options)

    def find(self, name: str) -> Any:
        """Return a part of the recording by name, or None; the file is opened once for all."""
        if self._recording is None:
            from jaxevent.io import load

            self._recording = load(*self.arguments, **self.options)
        return _lazy_parts(self._recording).get(name)

    def error(self, name: str) -> InputError:
        """Return the error to raise if a part of the recording has changed since it was opened."""
        return InputError(
            f"{self.arguments[0]}: no longer holds the {name} that were pickled; load it again"
        )


class InFile:
    """A part of a recording that stays in a file.

    A pickle or copy opens the file again, by its absolute path. What `load` did not open is read,
    and held in memory.
    """

    opened: tuple[LoadCall, str] | None = None  # and the name of the part of the recording


class EventsInFile(InFile):
    """An `EventSource` that stays in a file."""

    def __reduce__(self) -> tuple[Any, ...]:
        it: Any = self
        if self.opened is None:
            return it[:].__reduce_ex__(2)
        return _reopen_events, (*self.opened, len(it))


class ImagesInFile(InFile):
    """An `ImageSource` of some images of a file; subclasses read them.

    Attributes:
        dtype: Type of the pixels.
    """

    def __init__(self, shape: tuple[int, ...], dtype: np.dtype):
        self._rows: Sequence[int] = range(shape[0])
        self._image_shape, self.dtype = tuple(shape[1:]), dtype

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the images, (images, height, width) or with further axes."""
        return (len(self._rows), *self._image_shape)

    def __len__(self) -> int:
        return len(self._rows)

    def __getitem__(self, rows: slice | NDArray) -> Self:
        if isinstance(rows, slice):
            return self.select(self._rows[rows])
        return self.select([self._rows[i] for i in np.arange(len(self))[rows].tolist()])

    def select(self, rows: Sequence[int]) -> Self:
        """Return the images of the file with the numbers `rows`."""
        part = object.__new__(type(self))
        vars(part).update(vars(self), _rows=rows)
        return part

    def read(self, rows: Sequence[int]) -> NDArray:
        """Read images of the file by their numbers."""
        raise NotImplementedError

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray:
        return np.asarray(self.read(self._rows), dtype)

    def __reduce__(self) -> tuple[Any, ...]:
        if self.opened is None:
            return np.asarray, (np.asarray(self),)
        return _reopen_images, (*self.opened, self._rows, self._image_shape, self.dtype)


def _lazy_parts(recording: Recording) -> dict[str, Any]:
    """Return all parts of a recording that may stay in a file, by name."""
    frames = recording.frames
    images = {} if frames is None else {"frames": frames.images}
    return {"events": recording.events, **images, **recording.extra}


def _reopen_events(call: LoadCall, name: str, count: int) -> Any:
    found: Any = call.find(name)
    if not isinstance(found, EventsInFile) or len(found) != count:
        raise call.error(name)
    return found


def _reopen_images(
    call: LoadCall, name: str, rows: Sequence[int], shape: tuple[int, ...], dtype: np.dtype
) -> Any:
    found: Any = call.find(name)
    if isinstance(found, ImagesInFile) and set(rows) <= set(found._rows):
        part: Any = found.select(rows)
        if (part.shape[1:], part.dtype) == (shape, dtype):
            return part
    raise call.error(name)


def remember_call(load: Callable[P, Recording]) -> Callable[P, Recording]:
    """Decorate a function like `load`: parts left in a file keep the call that opened them."""

    @functools.wraps(load)
    def loaded(*arguments: P.args, **options: P.kwargs) -> Recording:
        recording = load(*arguments, **options)
        parts = {n: one for n, one in _lazy_parts(recording).items() if isinstance(one, InFile)}
        if parts:
            path: Any = options.pop("path") if "path" in options else arguments[0]
            call = LoadCall((os.path.abspath(path), *arguments[1:]), dict(options))
            for name, one in parts.items():
                one.opened = call, name
        return recording

    return loaded


class _Block(NamedTuple):
    """A block of a file.

    Attributes:
        state: State of the decoder before it.
        row: Row of its first event.
        first: Its first time, us.
        last: Its last time, us.
    """

    state: Any
    row: int
    first: int
    last: int


def read_events(
    decode: Decoder,
    size: tuple[int, int],
    source: str,
    options: ReadOptions,
    origin: int = 0,
) -> EventSource:
    """Read all events of a decoder and check them.

    Args:
        decode: The decoder; its blocks hold t (int64 us), x, y and p as `check_events` takes them.
        size: (width, height) of the sensor in px.
        source: Name of the file for messages.
        options: Options of `jaxevent.io.load`.
        origin: Number of the first column and row of the sensor, 0 or 1.

    Returns:
        `Events` in memory, else `DecodedEvents`.

    Raises:
        InputError: An event is not valid, or the decoder finds a fault.
    """
    if options.repair is not None:
        decode = _with_repair(decode, source, options, options.repair)
    blocks: list[_Block] = []
    pieces: list[Events] = []
    row = 0
    with (
        reading(source),
        bar(desc="decode", unit=" events", unit_scale=True, progress=options.progress) as shown,
    ):
        for state, columns in decode(None):
            if not len(columns[0]):
                continue
            try:
                events = check_events(*columns, size, source, first_row=row, origin=origin)
            except OrderError:
                raise _find_disorder(decode, source).explain(source) from None
            first, last = int(events.t[0]), int(events.t[-1])
            if blocks and first < blocks[-1].last:
                raise _find_disorder(decode, source).explain(source)
            blocks.append(_Block(state, row, first, last))
            if options.in_memory or len(pieces) < 2:
                pieces.append(events)
            else:
                pieces[1] = events
            row += len(events)
            shown.update(len(events))
    if not blocks:
        return Events.empty()
    if options.in_memory or len(blocks) <= 2:
        return _concatenate_events(pieces)
    return DecodedEvents(decode, blocks, row, (pieces[0], pieces[1]), size, source, origin=origin)


def _with_repair(decode: Decoder, source: str, options: ReadOptions, words: str) -> Decoder:
    """Return a decoder that makes repairs, with a note of them in the options."""
    repair = disorder.parse_repair(words)
    found = _find_disorder(decode, source, repair.bound)
    found.refuse_rest(repair, source)
    options.notes.append(found.describe_repair(repair))
    return disorder.repair_decoder(decode, found, repair)


def _find_disorder(
    decode: Decoder, source: str, bound: int = disorder.DEFAULT_MAX_LATE_US
) -> disorder.Disorder:
    with reading(source):
        return disorder.find_disorder((columns[0] for _, columns in decode(None)), bound, source)


def _concatenate_events(pieces: list[Events]) -> Events:
    if len(pieces) == 1:
        return pieces[0]
    columns = []
    for name in ("t", "x", "y", "p"):
        columns.append(np.concatenate([getattr(piece, name) for piece in pieces]))
    return Events.of_checked(*columns)


class FirstPass:
    """Counts and external triggers that a decoder meets on its first pass over a file.

    A place in the file rises from block to block; a place that was met before adds nothing.
    """

    def __init__(self):
        self._counts: dict[str, int] = {}
        self._last_places: dict[str, int] = {}
        self._triggers: list[tuple[NDArray, NDArray, NDArray]] = []

    def _is_new(self, name: str, place: int) -> bool:
        is_new = place > self._last_places.get(name, -1)
        self._last_places[name] = max(place, self._last_places.get(name, -1))
        return is_new

    def count(self, name: str, number: int, place: int) -> None:
        """Add to a count.

        Args:
            name: Name of the count.
            number: Number to add.
            place: Place of the block in the file.
        """
        if number and self._is_new(name, place):
            self._counts[name] = self._counts.get(name, 0) + number

    def counts(self) -> dict[str, NDArray]:
        """Return the counts that are not 0, by name, as `Recording.extra` keeps them."""
        return {name: np.array(number) for name, number in sorted(self._counts.items())}

    def add_triggers(
        self, place: int, t: NDArray, edge: NDArray | int, channel: NDArray | int
    ) -> None:
        """Keep the triggers of a block.

        Args:
            place: Place of the block in the file.
            t: (n,) times in us.
            edge: 1 rising, 0 falling, -1 unknown, one for all or (n,).
            channel: Number of the input, one for all or (n,).
        """
        if self._is_new("triggers", place) and len(t):
            edge, channel = np.broadcast_to(edge, len(t)), np.broadcast_to(channel, len(t))
            self._triggers.append((t, edge, channel))

    def triggers(self) -> Triggers | None:
        """Return all triggers in the order of their times; None if there are none."""
        if not self._triggers:
            return None
        t, edge, channel = (np.concatenate(one) for one in zip(*self._triggers, strict=True))
        order = np.argsort(t, kind="stable")
        found = Triggers(t.astype(np.int64), edge.astype(np.int8), channel.astype(np.uint8))
        return found[order]


def gather_pieces(
    pieces: Iterable[tuple[Any, int, T]], count: int | None = None
) -> Iterator[tuple[Any, list[T]]]:
    """Gather small pieces of a file, as packets, into blocks.

    Args:
        pieces: State of the decoder before each piece, size of the piece, and the piece.
        count: Size of a block; None takes `BLOCK_EVENTS`.

    Yields:
        The state before each block, and its pieces.
    """
    first, held, size = None, [], 0
    for state, number, piece in pieces:
        first = first if held else state
        held.append(piece)
        size += number
        if size >= (count or BLOCK_EVENTS):
            yield first, held
            held, size = [], 0
    if held:
        yield first, held


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
        *,
        origin: int,
    ):
        self._decode = decode
        self._states = [block.state for block in blocks]
        self._rows = np.array([block.row for block in blocks] + [count])
        self._first = np.array([block.first for block in blocks])
        self._last = np.array([block.last for block in blocks])
        # A recording's start and stop are needed often; neither may cost a pass over the file.
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
        start, stop = slice_bounds(rows, len(self))
        if stop <= start:
            return Events.empty()
        block = int(np.searchsorted(self._rows, start, side="right")) - 1
        pieces = []
        while block < len(self._states) and self._rows[block] < stop:
            row = int(self._rows[block])
            pieces.append(self._block(block)[max(start - row, 0) : stop - row])
            block += 1
        return _concatenate_events(pieces)

    @synchronized
    def index(self, time: int) -> int:
        """Count the events earlier than `time` (us): at most one block is decoded."""
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
            raise _changed_file_error(self._source, "events")
        events = check_events(
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


def _changed_file_error(source: str, what: str) -> InputError:
    return InputError(
        f"{source}: no longer holds the {what} it held when it was opened; load it again"
    )


class DecodedImages(ImagesInFile):
    """Images (frames, height, width), or in colour (frames, height, width, 3), left in the file."""

    def __init__(
        self,
        images: Callable[[int], Iterable[NDArray]],
        shape: tuple[int, ...],
        dtype: np.dtype,
        source: str,
    ):
        """Describe the images without decoding them.

        Args:
            images: Decoder: `images(i)` yields the images from number i on, in turn.
            shape: Shape of all images.
            dtype: Type of the pixels.
            source: Name of the file for messages.
        """
        super().__init__(shape, dtype)
        self._stream = _ImageStream(images, source)

    def read(self, rows: Sequence[int]) -> NDArray:
        """Read images of the file by their numbers."""
        out = np.empty((len(rows), *self._image_shape), self.dtype)
        with self._stream.turns:
            for i, row in enumerate(rows):
                image = self._stream.read(row)
                if image is None or (image.shape, image.dtype) != (out.shape[1:], self.dtype):
                    raise _changed_file_error(self._stream.source, "image")
                out[i] = image
        return out


class _ImageStream:
    """The decoder of images, which goes on from its last place or begins anew."""

    def __init__(self, images: Callable[[int], Iterable[NDArray]], source: str):
        self._images, self.source = images, source
        self.turns, self._process = TurnLock(source), os.getpid()
        self._stream: Iterator[NDArray] = iter(())
        self._next = -1

    def read(self, row: int) -> NDArray | None:
        with reading(self.source):
            if row != self._next or self._process != os.getpid():
                self._process = os.getpid()
                self._stream = iter(self._images(row))
            image, self._next = next(self._stream, None), row + 1
        return image
