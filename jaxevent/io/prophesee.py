"""Recordings of Prophesee's cameras: RAW with EVT2, EVT2.1 or EVT3, and DAT.

All four begin with lines of text, "% key value". Times are us of the camera's clock; x and y count
from the top left already. The words of each format and how they are read:

    EVT2    32 bits  CD_OFF, CD_ON (6 low bits of the time, 11 of x, 11 of y), TIME_HIGH (28 bits)
    EVT2.1  64 bits  the same with a mask of 32 pixels of a row; either half of a word may be first
    EVT3    16 bits  y, x, vectors of x, 12 low and 12 high bits of the time, each only when changed
    DAT     64 bits  32 bits of time, then x (14), y (14) and polarity (4); event types 0 and 12.
                     Triggers, type 14: time, then edge (4), unused (22) and channel (6)

Times overflow after 2^34 us (EVT2), 2^24 us (EVT3: 16.8 s) or 2^32 us (DAT), and are continued
here. Events that come before the file's first time (or first row) cannot be placed: they are left
out and counted in `extra["events_without_time"]`, where there are any. External triggers are kept
in `Recording.triggers`, those before the first time counted as `triggers_without_time`. A DAT file
holds events or triggers: of NAME_cd.dat and NAME_td.dat, triggers are read from NAME_trigger.dat
where that is beside it, as Metavision's tools write them. Words of types that a format reserves are
skipped and counted in `extra["reserved_words"]`; many different ones mean damage.

Decoders. EVT2, EVT2.1 and DAT have words of one length and are decoded here by NumPy: EVT2 and DAT
at 56 million events/s, checks included. For EVT3 the package evt3 (MIT) is taken: 48 million
events/s, 17 million with the checks, where expelliarmus doubles the time, evutils drops vectors,
and both are GPL. It passes over undefined words silently, forgets rows and bases that come before
the first TIME_HIGH, so that the events after it fall into row or column 0, and misses an overflow
where the file holds no time near it; so every word is classified here first, what was forgotten or
missed is told, and the number of events compared. It then equals a decoder that follows the state
machine word by word on any words. EVT3 and DAT of the same recording (evt3.raw, gen4.dat) agree in
all 1,218,618 events but for a constant time, EVT2 with an unpacked copy (spinning_dot.npz) in all
539,481.
"""

import functools
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxevent.errors import InputError, require
from jaxevent.io import companions, reading
from jaxevent.io.decoded import BLOCK, Columns, Decoder, Tally, TriggerList, decoded
from jaxevent.io.options import ReadOptions
from jaxevent.recording import Recording

_LONGEST_HEADER = 1 << 16
_DAT_TRIGGERS = 14  # the type of a DAT file's records
_EVT2_TYPES = (0, 1, 8, 10, 14, 15)
_EVT3_TYPES = (0, 2, 3, 4, 5, 6, 7, 8, 10, 14, 15)
_MOST_RESERVED = 16  # different values of words of other types in a block
_SIZES = (  # of sensors whose files may not tell their size, by the name of Metavision's plugin
    ("gen31", (640, 480)),
    ("gen3", (640, 480)),
    ("gen41", (1280, 720)),
    ("gen4", (1280, 720)),
    ("imx636", (1280, 720)),
    ("genx320", (320, 320)),
)


def read(path: Path, options: ReadOptions) -> Recording:
    """Read a RAW or DAT file. Raises `InputError` for bad input."""
    with reading(str(path)):
        header, start = _header(path)
        stated = header.get("format", "").partition(";")[0].upper()
        version = stated or {"2.0": "EVT2", "2.1": "EVT21", "3.0": "EVT3"}.get(
            header.get("evt", ""), ""
        )
        length = path.stat().st_size
        found = Tally()
        triggers = TriggerList()
        if version == "EVT2":
            decode = functools.partial(_evt2, path, start, found, triggers)
            width = 4
        elif version == "EVT21":
            halves_swapped = _halves_swapped(path, start, header.get("format", ""))
            decode = functools.partial(_evt21, path, start, halves_swapped, found, triggers)
            width = 8
        elif version == "EVT3":
            words_from = functools.partial(_words_from, path, start)
            decode = functools.partial(evt3_events, str(path), words_from, found, triggers)
            width = 2
        elif not version and "version" in header:
            decode, start = _dat(path, start, header, triggers)
            width = 8
        else:
            raise InputError(
                f"{path}: has a header like a Prophesee recording's, but its format "
                f"{(version or header.get('evt', '?'))[:20]!r} is not EVT2, EVT2.1, EVT3 or DAT; "
                "convert it with Metavision's tools"
            )
        _whole_words(path, length - start, width)
        size = options.size or _size(header)
    if size is None:
        raise InputError(
            f"{path}: the header does not tell the sensor's size; give size=(width, height) or "
            "--size"
        )
    events = decoded(decode, size, str(path), options)
    return Recording(path.stem, *size, events, extra=found.arrays(), triggers=triggers.all())


def _header(path: Path) -> tuple[dict[str, str], int]:
    """The keys of the header in lower case, and where the data begin.

    Old files have no "% end", and their data may begin with the byte of "%", but hardly go on like
    a line of text.
    """
    with path.open("rb") as file:
        head = file.read(_LONGEST_HEADER)
    header: dict[str, str] = {}
    at = 0
    while head.startswith(b"%", at):
        stop = head.find(b"\n", at)
        line = head[at:stop]
        if stop < 0 or not re.fullmatch(rb"%[ -~\t]*\r?", line) or line[1:2] not in b" \r":
            break
        at = stop + 1
        key, _, value = line[1:].decode("ascii").strip().partition(" ")
        if key == "end" and not value:
            break
        header.setdefault(key.lower(), value.strip())
    return header, at


def _size(header: dict[str, str]) -> tuple[int, int] | None:
    width = height = ""
    if match := re.fullmatch(r"(\d{1,5})x(\d{1,5})", header.get("geometry", "")):
        width, height = match.groups()
    for pair in header.get("format", "").split(";")[1:]:
        key, _, value = pair.partition("=")
        width = value if key == "width" else width
        height = value if key == "height" else height
    width, height = header.get("width", width), header.get("height", height)
    if re.fullmatch(r"\d{1,5}", width) and re.fullmatch(r"\d{1,5}", height):
        if int(width) and int(height):
            return int(width), int(height)
    plugin = header.get("plugin_name", "").removeprefix("hal_plugin_")
    return next((size for name, size in _SIZES if plugin.startswith(name)), None)


def _whole_words(path: Path, length: int, width: int) -> None:
    if length % width:
        raise InputError(
            f"{path}: ends inside a word, {length % width} bytes after the last whole one of "
            f"{width} bytes; the recording was cut off, so fetch it again or drop these bytes: "
            f"truncate -s -{length % width} FILE"
        )


def _words(path: Path, offset: int, dtype: str, count: int) -> Iterator[tuple[int, Any]]:
    """Blocks of a file's words, each with its offset in bytes."""
    with path.open("rb") as file:
        file.seek(offset)
        while len(words := np.fromfile(file, dtype, count)):
            yield offset, words
            offset += words.nbytes


def _words_from(path: Path, start: int, offset: int | None) -> Iterator[tuple[int, int, NDArray]]:
    """Blocks of a RAW file's EVT3 words from an offset on, as `evt3_events` takes them."""
    for at, words in _words(path, start if offset is None else offset, "<u2", BLOCK):
        yield at, at, words


def _count_reserved(
    source: Path | str,
    words: NDArray,
    kind: NDArray[np.uint8],
    defined: tuple[int, ...],
    offset: int,
    found: Tally,
) -> None:
    """Count words of types that a format reserves, which decoders skip.

    Padding and what newer firmware adds repeat a few values, damaged bytes take any: raises
    `InputError` for more than `_MOST_RESERVED` of them. `offset` is that of the words in bytes.
    """
    known = np.zeros(16, bool)
    known[list(defined)] = True
    reserved = ~known[kind]
    if not reserved.any():
        return
    if len(np.unique(words[reserved])) > _MOST_RESERVED:
        row = int(np.argmax(reserved))
        raise InputError(
            f"{source}: the word at byte {offset + row * words.itemsize} has the type "
            f"{int(kind[row]):#x}, which the format reserves, and so have many others of different "
            "values; the file is damaged, so fetch it again"
        )
    found.add("reserved_words", int(np.count_nonzero(reserved)), offset)


def _continued(values: NDArray[np.int64], before: int | None, bits: int) -> NDArray[np.int64]:
    """Counter values continued over overflows: a fall by more than half the range is one.

    `before` is the continued value before them, None at the start. A counter that steps back over
    its start goes on below 0.
    """
    if before is None:
        before = int(values[0]) if len(values) else 0
    low = before & ((1 << bits) - 1)
    steps = np.diff(values, prepend=low)
    wraps = np.cumsum(steps < -(1 << (bits - 1))) - np.cumsum(steps > (1 << (bits - 1)))
    return values + (before - low) + (wraps << bits)


def _timed(
    is_high: NDArray[np.bool_], high: NDArray[np.int64], chosen: NDArray, before: int | None
) -> tuple[NDArray[np.int64], int]:
    """The continued TIME_HIGH that holds at each chosen word, and how many come before any."""
    number = np.cumsum(is_high)[chosen]
    untimed = int(np.count_nonzero(number == 0)) if before is None else 0
    values = np.concatenate([[0 if before is None else before], high])
    return values[number], untimed


def _evt2(
    path: Path, start: int, found: Tally, triggers: TriggerList, state: Any
) -> Iterator[tuple[Any, Columns]]:
    begin, before = state or (start, None)
    for offset, words in _words(path, begin, "<u4", BLOCK):
        state = (offset, before)
        kind = (words >> 28).astype(np.uint8)
        _count_reserved(path, words, kind, _EVT2_TYPES, offset, found)
        is_high = kind == 8
        high = _continued((words[is_high] & 0xFFFFFFF).astype(np.int64), before, 28)
        chosen = np.flatnonzero(kind <= 1)
        t, untimed = _timed(is_high, high, chosen, before)
        if untimed:
            found.add("events_without_time", untimed, offset)
            chosen, t = chosen[untimed:], t[untimed:]
        at = np.flatnonzero(kind == 10)
        when, early = _timed(is_high, high, at, before)
        found.add("triggers_without_time", early, offset)
        signals = words[at[early:]]
        when = when[early:] << 6 | (signals >> 22 & 0x3F).astype(np.int64)
        triggers.add(offset, when, signals & 1, signals >> 8 & 0x1F)
        before = int(high[-1]) if len(high) else before
        words = words[chosen]
        t = (t << 6) | (words >> 22 & 0x3F)
        x, y = words >> 11 & 0x7FF, words & 0x7FF
        yield state, (t, x, y, kind[chosen] == 1)


def _halves_swapped(path: Path, start: int, stated: str) -> bool:
    """Whether an EVT2.1 file has the high half of each word first, as the IMX636 sends it."""
    if "endianness=little" in stated:
        return False
    if "endianness=legacy" in stated:
        return True
    words = next((words for _, words in _words(path, start, "<u4", 1 << 15)), np.empty(0, "u4"))
    fits = []
    for half in (words[1::2], words[0::2]):
        kinds = set((half >> 28).tolist())
        fits.append(8 in kinds and kinds <= set(_EVT2_TYPES))
    if fits[0] == fits[1]:
        raise InputError(
            f"{path}: the order of the halves of its EVT2.1 words cannot be told; add "
            "';endianness=little' or ';endianness=legacy' to the line '% format EVT21'"
        )
    return fits[1]


def _evt21(
    path: Path, start: int, halves_swapped: bool, found: Tally, triggers: TriggerList, state: Any
) -> Iterator[tuple[Any, Columns]]:
    begin, before = state or (start, None)
    # A word may hold 32 events.
    for offset, words in _words(path, begin, "<u8", max(1, BLOCK // 4)):
        state = (offset, before)
        if halves_swapped:
            words = words << 32 | words >> 32
        kind = (words >> 60).astype(np.uint8)
        _count_reserved(path, words, kind, _EVT2_TYPES, offset, found)
        is_high = kind == 8
        high = _continued((words[is_high] >> 32 & 0xFFFFFFF).astype(np.int64), before, 28)
        chosen = np.flatnonzero(kind <= 1)
        t, untimed = _timed(is_high, high, chosen, before)
        mask = (words[chosen] & 0xFFFFFFFF).astype("<u4")
        if untimed:
            count = int(np.bitwise_count(mask[:untimed]).sum())
            found.add("events_without_time", count, offset)
            chosen, mask, t = chosen[untimed:], mask[untimed:], t[untimed:]
        at = np.flatnonzero(kind == 10)
        when, early = _timed(is_high, high, at, before)
        found.add("triggers_without_time", early, offset)
        signals = words[at[early:]]
        when = when[early:] << 6 | (signals >> 54 & 0x3F).astype(np.int64)
        triggers.add(offset, when, signals >> 32 & 1, signals >> 40 & 0x1F)
        before = int(high[-1]) if len(high) else before
        bits = np.unpackbits(mask.view(np.uint8).reshape(-1, 4), axis=1, bitorder="little")
        word, bit = np.nonzero(bits)
        words = words[chosen]
        t = (t << 6) | (words >> 54 & 0x3F).astype(np.int64)
        x = (words >> 43 & 0x7FF).astype(np.int64)[word] + bit
        y = (words >> 32 & 0x7FF).astype(np.int64)[word]
        yield state, (t[word], x, y, (kind[chosen] == 1)[word])


def _dat(
    path: Path, start: int, header: dict[str, str], triggers: TriggerList
) -> tuple[Decoder, int]:
    with path.open("rb") as file:
        file.seek(start)
        described = file.read(2)
    if described == bytes([_DAT_TRIGGERS, 8]):
        raise InputError(
            f"{path}: holds external triggers only; read the file of events, whose triggers these "
            "are where it is NAME_cd.dat or NAME_td.dat beside NAME_trigger.dat"
        )
    if len(described) != 2 or described[0] not in (0, 12) or described[1] != 8:
        raise InputError(
            f"{path}: holds DAT events of type {described[:1].hex() or '?'} and "
            f"{described[1] if len(described) > 1 else '?'} bytes; only 2-D change events (types "
            "00 and 0c, 8 bytes) can be read"
        )
    fields = (14, 14) if header["version"] != "1" else (9, 8)
    beside = companions.triggers(path)
    if beside is not None:
        _dat_triggers(beside, triggers)
    return functools.partial(_dat_events, path, start + 2, fields), start + 2


def _dat_events(
    path: Path, start: int, fields: tuple[int, int], state: Any
) -> Iterator[tuple[Any, Columns]]:
    begin, before = state or (start, None)
    for_x, for_y = fields
    for offset, words in _words(path, begin, "<u4", 2 * BLOCK):
        state = (offset, before)
        t, word = words[0::2].astype(np.int64), words[1::2]
        t = _continued(t, before, 32)
        before = int(t[-1])
        x = word & ((1 << for_x) - 1)
        y = word >> for_x & ((1 << for_y) - 1)
        # Version 1 has one bit of polarity, then others.
        p = word >> (for_x + for_y) & (0xF if for_x == 14 else 1)
        yield state, (t, x, y, p.astype(np.uint8))


def _dat_triggers(path: Path, triggers: TriggerList) -> None:
    """Keep the triggers of a DAT file of them. Raises `InputError` where it is none."""
    with reading(str(path)):
        _, start = _header(path)
        with path.open("rb") as file:
            file.seek(start)
            described = file.read(2)
    if described != bytes([_DAT_TRIGGERS, 8]):
        raise InputError(f"{path}: holds no external triggers (type 0e, 8 bytes); move it away")
    _whole_words(path, path.stat().st_size - start - 2, 8)
    before = None
    for offset, words in _words(path, start + 2, "<u4", 2 * BLOCK):
        t, signal = _continued(words[0::2].astype(np.int64), before, 32), words[1::2]
        before = int(t[-1])
        triggers.add(offset, t, signal & 0xF, signal >> 26)


def _add_triggers(
    triggers: TriggerList,
    offset: int,
    words: NDArray,
    kind: NDArray,
    told: dict[int, int],
    high: int | None,
) -> int | None:
    """Keep a block's triggers; `high` is the continued high time before it, returned after it."""
    is_high = kind == 8
    values = (words[is_high] & 0xFFF).astype(np.int64)
    if len(values):
        first = values[0] if high is None else high & 0xFFF
        wraps = np.cumsum(np.diff(values, prepend=first) < -0x800)
        values += (0 if high is None else high & ~0xFFF) + (wraps << 12)
    at = np.flatnonzero(kind == 10)
    when, early = _timed(is_high, values, at, high)
    # The low time that holds at each: of the last word of time before it, 0 after a high one.
    clock = np.flatnonzero((kind == 6) | is_high)
    low = np.where(kind[clock] == 6, words[clock] & 0xFFF, 0).astype(np.int64)
    low = np.concatenate([[told.get(6, 0) & 0xFFF], low])[np.searchsorted(clock, at)]
    when = (when << 12 | low)[early:]
    signals = words[at[early:]]
    triggers.add(offset, when, signals & 1, signals >> 8 & 0xF)
    return int(values[-1]) if len(values) else high


def _moved_base(base: int, kind: NDArray) -> int:
    """The word of a base of vectors after a block, with the x to which its vectors moved it."""
    since = np.flatnonzero(kind == 3)[-1] if (kind == 3).any() else 0
    steps = int(12 * np.sum(kind[since:] == 4) + 8 * np.sum(kind[since:] == 5))
    # Only a damaged vector, refused as outside the sensor, or the end of a row exceeds 0x7FF.
    return base & ~0x7FF | min((base & 0x7FF) + steps, 0x7FF)


def evt3_events(
    source: str,
    words_from: Callable[[Any], Iterator[tuple[int, Any, NDArray]]],
    found: Tally,
    triggers: TriggerList,
    state: Any,
) -> Iterator[tuple[Any, Columns]]:
    """Decode EVT3, wherever its words are stored: a `Decoder` but for its first arguments.

    `words_from(place)` iterates over the words (n,) uint16 from a place on, None is the start: the
    offset in bytes of a block of them, its place, the block. Events without a time are counted in
    `found`, triggers kept in `triggers`.
    """
    evt3: Any = require("evt3", "prophesee")

    # What an event needs to have been told before: the row 0, the base of a vector 3, the high time
    # 8. `last` holds the latest word of each, of the base the x to which vectors moved it, and the
    # low time 6 unless a high one, which sets it to 0, came after it.
    begin, last, first_t = state or (None, {}, None)
    last = dict(last)
    decoder = evt3.Decoder(2048, 2048)
    decoder.feed(np.array([last[key] for key in (8, 6, 0, 3) if key in last], "<u2").tobytes())
    shift, clock_high = 0, None
    for offset, place, words in words_from(begin):
        told = dict(last)
        kind = (words >> 12).astype(np.uint8)
        _count_reserved(source, words, kind, _EVT3_TYPES, offset, found)
        data = words & 0xFFF
        data[kind == 5] &= 0xFF
        numbers = np.where(kind == 2, 1, 0).astype(np.uint8)
        vectors = (kind == 4) | (kind == 5)
        numbers[vectors] = np.bitwise_count(data[vectors])
        unplaced = np.zeros(len(words), bool)
        for key, affected in ((8, numbers > 0), (0, numbers > 0), (3, vectors)):
            at = np.flatnonzero(kind == key)
            if key not in last:
                first = int(at[0]) if len(at) else len(words)
                unplaced[:first] |= affected[:first]
            if len(at):
                last[key] = int(words[at[-1]])
        clock = np.flatnonzero((kind == 6) | (kind == 8))
        if len(clock):
            last.pop(6, None)
            if kind[clock[-1]] == 6:
                last[6] = int(words[clock[-1]])
        if 3 in last:
            last[3] = _moved_base(last[3], kind)
        if unplaced.any():
            found.add("events_without_time", int(numbers[unplaced].sum()), offset)
            numbers[unplaced] = 0
            words = np.where(unplaced, np.uint16(0xE000), words)
        if state is None:
            clock_high = _add_triggers(triggers, offset, words, kind, told, clock_high)
        highs = np.flatnonzero(kind == 8)
        if len(highs):
            times = words[highs].astype(np.int64) & 0xFFF
            before = told[8] & 0xFFF if 8 in told else times[0]
            wraps = highs[np.diff(times, prepend=before) < -0x800]
            # The decoder takes a fall as an overflow only from nearly the highest to nearly the
            # lowest value; a file with few events may not hold these.
            words = np.insert(words, np.repeat(wraps, 2), np.tile([0x8FFF, 0x8000], len(wraps)))
        if 8 not in told and 8 in last:
            # What came before the first TIME_HIGH counts too, but the decoder forgets it.
            kept = [0x8000 | times[0], *(told[key] for key in (0, 3) if key in told)]
            words = np.concatenate([np.array(kept, "<u2"), words])
        events = decoder.feed(words.tobytes())
        if len(events.t) != int(numbers.sum(dtype=np.int64)):
            raise InputError(
                f"{source}: {int(numbers.sum(dtype=np.int64)):,} events stand in the words from "
                f"byte {offset} on but {len(events.t):,} were decoded; the file is damaged, so "
                "fetch it again"
            )
        t = events.t.astype(np.int64)
        if len(t) and first_t is not None:
            # The decoder has not seen the overflows before this block.
            shift, first_t = first_t - int(t[0]), None
        t += shift
        yield (place, told, int(t[0]) if len(t) else None), (t, events.x, events.y, events.p)
