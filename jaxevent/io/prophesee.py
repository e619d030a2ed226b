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
where the file holds no time near it; so every word is classified here first, forgotten and missed
words are given to it, and the number of events compared. It then equals a decoder that follows the
state machine word by word on any words. EVT3 and DAT of the same recording (evt3.raw, gen4.dat)
agree in all 1,218,618 events but for a constant time, EVT2 with an unpacked copy (spinning_dot.npz)
in all 539,481.
"""

import functools
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.errors import InputError, require
from jaxevent.io import decoded
from jaxevent.io.checks import (
    ReadOptions,
    check_whole_records,
    damaged,
    reading,
    sensor_size,
    trigger_file,
)
from jaxevent.io.decoded import Columns, Decoder, FirstPass, read_events
from jaxevent.recording import Recording

_MAX_HEADER_BYTES = 1 << 16  # bytes
_TRIGGER_RECORD_TYPE = 14  # the type of a DAT file's records
_EVT2_TYPES = (0, 1, 8, 10, 14, 15)
_EVT3_TYPES = (0, 2, 3, 4, 5, 6, 7, 8, 10, 14, 15)
_MAX_RESERVED_VALUES = 16  # different values of words of other types in a block
_SENSOR_SIZES_PX = (  # where a file may not state it, by the name of Metavision's plugin
    ("gen31", (640, 480)),
    ("gen3", (640, 480)),
    ("gen41", (1280, 720)),
    ("gen4", (1280, 720)),
    ("imx636", (1280, 720)),
    ("genx320", (320, 320)),
)


def read(path: Path, options: ReadOptions) -> Recording:
    """Read a RAW or DAT file.

    Args:
        path: The file.
        options: Options of `jaxevent.io.load`.

    Returns:
        The recording; unless `options.in_memory`, events stay in the file.

    Raises:
        InputError: The file is damaged or of another format.
    """
    with reading(path):
        header, start = _read_header(path)
        stated = header.get("format", "").partition(";")[0].upper()
        version = stated or {"2.0": "EVT2", "2.1": "EVT21", "3.0": "EVT3"}.get(
            header.get("evt", ""), ""
        )
        first_pass = FirstPass()
        decode: Decoder
        if version in ("EVT2", "EVT21"):
            width = 4 if version == "EVT2" else 8
            is_swapped = width == 8 and _has_swapped_halves(path, start, header.get("format", ""))
            words = functools.partial(_evt2_words, path, start, width, is_swapped)
            decode = functools.partial(_decode_evt2, path, words, first_pass)
        elif version == "EVT3":
            width = 2
            words_from = functools.partial(_evt3_words, path, start)
            decode = functools.partial(decode_evt3, str(path), words_from, first_pass)
        elif not version and "version" in header:
            width = 8
            decode, start = _open_dat(path, start, header, first_pass)
        else:
            raise InputError(
                f"{path}: has a header like a Prophesee recording's, but its format "
                f"{(version or header.get('evt', '?'))[:20]!r} is not EVT2, EVT2.1, EVT3 or DAT; "
                "convert it with Metavision's tools"
            )
        check_whole_records(path, path.stat().st_size - start, width, "a word")
    otherwise = f"{path}: the header does not state the sensor's size"
    size = sensor_size(otherwise, options.size, _stated_size(header))
    events = read_events(decode, size, str(path), options)
    return Recording(
        path.stem,
        *size,
        events,
        extra=first_pass.counts(),
        triggers=first_pass.triggers(),
    )


def _read_header(path: Path) -> tuple[dict[str, str], int]:
    """Read the keys of the header, in lower case, and the offset of the data.

    Old files have no "% end", and their data may begin with the byte of "%", but hardly go on like
    a line of text.
    """
    with path.open("rb") as file:
        head = file.read(_MAX_HEADER_BYTES)
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


def _stated_size(header: dict[str, str]) -> tuple[int, int] | None:
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
    return next((size for name, size in _SENSOR_SIZES_PX if plugin.startswith(name)), None)


def _words(path: Path, offset: int, dtype: str, count: int) -> Iterator[tuple[int, Any]]:
    """Yield blocks of a file's words, each with its offset in bytes.

    Args:
        path: The file.
        offset: Offset of the first word, bytes.
        dtype: Type of a word.
        count: Number of words of a block.
    """
    with path.open("rb") as file:
        file.seek(offset)
        while len(words := np.fromfile(file, dtype, count)):
            yield offset, words
            offset += words.nbytes


def _evt3_words(path: Path, start: int, offset: int | None) -> Iterator[tuple[int, int, NDArray]]:
    """Yield blocks of a RAW file's EVT3 words from an offset on, as `decode_evt3` takes them."""
    for at, words in _words(path, start if offset is None else offset, "<u2", decoded.BLOCK_EVENTS):
        yield at, at, words


def _count_reserved(
    source: Path | str,
    words: NDArray,
    kind: NDArray[np.uint8],
    defined: tuple[int, ...],
    offset: int,
    first_pass: FirstPass,
) -> None:
    """Count words of types that a format reserves, which decoders skip.

    Padding and additions of newer firmware repeat a few values, damaged bytes take any.

    Args:
        source: Name of the file for messages.
        words: (n,) words of a block.
        kind: (n,) their types.
        defined: Types that the format defines.
        offset: Offset of the block in bytes.
        first_pass: Counts of the file.

    Raises:
        InputError: Reserved words have more than `_MAX_RESERVED_VALUES` values.
    """
    known = np.zeros(16, bool)
    known[list(defined)] = True
    reserved = ~known[kind]
    if not reserved.any():
        return
    if len(np.unique(words[reserved])) > _MAX_RESERVED_VALUES:
        row = int(np.argmax(reserved))
        raise damaged(
            f"{source}: the word at byte {offset + row * words.itemsize} has the type "
            f"{int(kind[row]):#x}, which the format reserves, and so have many others of different "
            "values"
        )
    first_pass.count("reserved_words", int(np.count_nonzero(reserved)), offset)


def _continued(values: NDArray[np.int64], before: int | None, bits: int) -> NDArray[np.int64]:
    """Continue the values of a counter over overflows: falls by more than half its range.

    A counter that steps back over its start goes on below 0.

    Args:
        values: (n,) values as stored.
        before: Continued value before them; None at the start.
        bits: Number of bits of the counter.

    Returns:
        (n,) continued values.
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
    """Find the high time of chosen words.

    Args:
        is_high: (n,) whether a word holds a high time.
        high: Continued values of these high times.
        chosen: Indices of the chosen words, or (n,) booleans.
        before: Continued high time before the block; None if there is none.

    Returns:
        The high time at each chosen word, and the number of chosen words before any high time.
    """
    number = np.cumsum(is_high)[chosen]
    untimed = int(np.count_nonzero(number == 0)) if before is None else 0
    values = np.concatenate([[0 if before is None else before], high])
    return values[number], untimed


class _Evt2Words(NamedTuple):
    """A block of EVT2 or EVT2.1 words.

    Attributes:
        offset: Offset of the block in bytes.
        words: (n,) words as they are counted.
        heads: (n,) high half of each word, which is all of an EVT2 word.
        masks: (n,) pixels of a row that have an event; None of EVT2.
    """

    offset: int
    words: NDArray
    heads: NDArray[np.uint32]
    masks: NDArray[np.uint32] | None


def _evt2_words(
    path: Path, start: int, width: int, is_swapped: bool, offset: int | None
) -> Iterator[_Evt2Words]:
    # A word with a mask may hold 32 events.
    count = decoded.BLOCK_EVENTS if width == 4 else max(1, decoded.BLOCK_EVENTS // 4)
    for at, words in _words(path, start if offset is None else offset, f"<u{width}", count):
        if width == 4:
            yield _Evt2Words(at, words, words, None)
            continue
        words = words << 32 | words >> 32 if is_swapped else words
        high, low = (words >> 32).astype("<u4"), (words & 0xFFFFFFFF).astype("<u4")
        yield _Evt2Words(at, words, high, low)


def _decode_evt2(
    path: Path,
    words_from: Callable[[int | None], Iterator[_Evt2Words]],
    first_pass: FirstPass,
    state: Any,
) -> Iterator[tuple[Any, Columns]]:
    begin, before = state or (None, None)
    for offset, words, heads, masks in words_from(begin):
        state = (offset, before)
        kind = (heads >> 28).astype(np.uint8)
        _count_reserved(path, words, kind, _EVT2_TYPES, offset, first_pass)
        is_high = kind == 8
        high = _continued((heads[is_high] & 0xFFFFFFF).astype(np.int64), before, 28)
        at = np.flatnonzero(kind == 10)
        when, early = _timed(is_high, high, at, before)
        first_pass.count("triggers_without_time", early, offset)
        signals = heads[at[early:]]
        when = when[early:] << 6 | (signals >> 22 & 0x3F).astype(np.int64)
        first_pass.add_triggers(offset, when, signals & 1, signals >> 8 & 0x1F)
        chosen = np.flatnonzero(kind <= 1)
        t, untimed = _timed(is_high, high, chosen, before)
        before = int(high[-1]) if len(high) else before
        lost = untimed if masks is None else np.bitwise_count(masks[chosen[:untimed]]).sum()
        first_pass.count("events_without_time", int(lost), offset)
        chosen, t = chosen[untimed:], t[untimed:]
        is_on, heads = kind[chosen] == 1, heads[chosen]
        t = t << 6 | (heads >> 22 & 0x3F)
        x, y = heads >> 11 & 0x7FF, heads & 0x7FF
        if masks is not None:
            pixels = masks[chosen].view(np.uint8).reshape(-1, 4)
            word, bit = np.nonzero(np.unpackbits(pixels, axis=1, bitorder="little"))
            t, x, y, is_on = t[word], x[word] + bit, y[word], is_on[word]
        yield state, (t, x, y, is_on)


def _has_swapped_halves(path: Path, start: int, stated: str) -> bool:
    """Return whether each EVT2.1 word has its high half first, as the IMX636 sends it.

    Args:
        path: The file.
        start: Offset of the first word, bytes.
        stated: Text of the header that may state the order.

    Raises:
        InputError: The order is not known.
    """
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
            f"{path}: the order of the halves of its EVT2.1 words is not known; add "
            "';endianness=little' or ';endianness=legacy' to the line '% format EVT21'"
        )
    return fits[1]


def _open_dat(
    path: Path, start: int, header: dict[str, str], first_pass: FirstPass
) -> tuple[Decoder, int]:
    with path.open("rb") as file:
        file.seek(start)
        described = file.read(2)
    if described == bytes([_TRIGGER_RECORD_TYPE, 8]):
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
    beside = trigger_file(path)
    if beside is not None:
        _read_dat_triggers(beside, first_pass)
    return functools.partial(_decode_dat, path, start + 2, fields), start + 2


def _decode_dat(
    path: Path, start: int, fields: tuple[int, int], state: Any
) -> Iterator[tuple[Any, Columns]]:
    begin, before = state or (start, None)
    for_x, for_y = fields
    for offset, words in _words(path, begin, "<u4", 2 * decoded.BLOCK_EVENTS):
        state = (offset, before)
        t, word = words[0::2].astype(np.int64), words[1::2]
        t = _continued(t, before, 32)
        before = int(t[-1])
        x = word & ((1 << for_x) - 1)
        y = word >> for_x & ((1 << for_y) - 1)
        # Version 1 has one bit of polarity, then others.
        p = word >> (for_x + for_y) & (0xF if for_x == 14 else 1)
        yield state, (t, x, y, p.astype(np.uint8))


def _read_dat_triggers(path: Path, first_pass: FirstPass) -> None:
    """Keep the triggers of a DAT file of triggers, or raise `InputError` if it is none."""
    with reading(path):
        _, start = _read_header(path)
        with path.open("rb") as file:
            file.seek(start)
            described = file.read(2)
    if described != bytes([_TRIGGER_RECORD_TYPE, 8]):
        raise InputError(f"{path}: holds no external triggers (type 0e, 8 bytes); move it away")
    check_whole_records(path, path.stat().st_size - start - 2, 8, "a word")
    before = None
    for offset, words in _words(path, start + 2, "<u4", 2 * decoded.BLOCK_EVENTS):
        t, signal = _continued(words[0::2].astype(np.int64), before, 32), words[1::2]
        before = int(t[-1])
        first_pass.add_triggers(offset, t, signal & 0xF, signal >> 26)


def _add_evt3_triggers(
    first_pass: FirstPass,
    offset: int,
    words: NDArray,
    kind: NDArray,
    last: dict[int, int],
    high: int | None,
) -> int | None:
    """Keep the triggers of a block of EVT3 words.

    Args:
        first_pass: Triggers of the file.
        offset: Offset of the block in bytes.
        words: (n,) words.
        kind: (n,) their types.
        last: Latest word of each type before the block.
        high: Continued high time before the block.

    Returns:
        The continued high time after the block.
    """
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
    low = np.concatenate([[last.get(6, 0) & 0xFFF], low])[np.searchsorted(clock, at)]
    when = (when << 12 | low)[early:]
    signals = words[at[early:]]
    first_pass.add_triggers(offset, when, signals & 1, signals >> 8 & 0xF)
    return int(values[-1]) if len(values) else high


def _moved_base(base: int, kind: NDArray) -> int:
    """Return the word of a base of vectors after a block, whose vectors have moved its x.

    Args:
        base: The block's last word of a base, or the one before the block.
        kind: (n,) types of the block's words.
    """
    since = np.flatnonzero(kind == 3)[-1] if (kind == 3).any() else 0
    steps = int(12 * np.sum(kind[since:] == 4) + 8 * np.sum(kind[since:] == 5))
    # Only a damaged vector, refused as outside the sensor, or the end of a row exceeds 0x7FF.
    return base & ~0x7FF | min((base & 0x7FF) + steps, 0x7FF)


def decode_evt3(
    source: str,
    words_from: Callable[[Any], Iterator[tuple[int, Any, NDArray]]],
    first_pass: FirstPass,
    state: Any,
) -> Iterator[tuple[Any, Columns]]:
    """Decode EVT3 of any container: a `Decoder` but for its first arguments.

    Args:
        source: Name of the file for messages.
        words_from: Function from a place, None at the start, to an iterator over blocks of words:
            offset in bytes, place, and words (n,) uint16 of each block.
        first_pass: Triggers, and counts of events and triggers without a time.
        state: State before the first block; None at the start.

    Yields:
        The state before each block, and its columns.

    Raises:
        InputError: The words are damaged.
    """
    evt3: Any = require("evt3", "prophesee")

    # An event needs earlier words: the row 0, the base of a vector 3, the high time 8. `last` holds
    # the latest word of each, of the base the x to which vectors moved it, and the low time 6
    # unless a high one, which sets it to 0, came after it.
    begin, last, first_t = state or (None, {}, None)
    last = dict(last)
    decoder = evt3.Decoder(2048, 2048)
    decoder.feed(np.array([last[key] for key in (8, 6, 0, 3) if key in last], "<u2").tobytes())
    shift, clock_high = 0, None
    for offset, place, words in words_from(begin):
        known = dict(last)
        kind = (words >> 12).astype(np.uint8)
        _count_reserved(source, words, kind, _EVT3_TYPES, offset, first_pass)
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
            first_pass.count("events_without_time", int(numbers[unplaced].sum()), offset)
            numbers[unplaced] = 0
            words = np.where(unplaced, np.uint16(0xE000), words)
        if state is None:
            clock_high = _add_evt3_triggers(first_pass, offset, words, kind, known, clock_high)
        highs = np.flatnonzero(kind == 8)
        if len(highs):
            times = words[highs].astype(np.int64) & 0xFFF
            before = known[8] & 0xFFF if 8 in known else times[0]
            wraps = highs[np.diff(times, prepend=before) < -0x800]
            # The decoder takes a fall as an overflow only from nearly the highest to nearly the
            # lowest value; a file with few events may not hold these.
            words = np.insert(words, np.repeat(wraps, 2), np.tile([0x8FFF, 0x8000], len(wraps)))
        if 8 not in known and 8 in last:
            # What came before the first TIME_HIGH counts too, but the decoder forgets it.
            kept = [0x8000 | times[0], *(known[key] for key in (0, 3) if key in known)]
            words = np.concatenate([np.array(kept, "<u2"), words])
        events = decoder.feed(words.tobytes())
        if len(events.t) != int(numbers.sum(dtype=np.int64)):
            raise damaged(
                f"{source}: {int(numbers.sum(dtype=np.int64)):,} events stand in the words from "
                f"byte {offset} on but {len(events.t):,} were decoded"
            )
        t = events.t.astype(np.int64)
        if len(t) and first_t is not None:
            # The decoder has not seen the overflows before this block.
            shift, first_t = first_t - int(t[0]), None
        t += shift
        yield (place, known, int(t[0]) if len(t) else None), (t, events.x, events.y, events.p)
