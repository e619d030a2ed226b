"""Events in the messages of ROS, whatever their type is called: arrays of events, and packets.

    array   header, height, width, events of x and y, a time (seconds, nanoseconds) and a polarity:
            EventArray of dvs_msgs, prophesee_event_msgs, dv_ros_msgs
    packet  header, height, width, time base, encoding, encoded bytes: EventPacket of
            event_camera_msgs, EventArray of event_array_msgs

A topic holds events where its messages have these fields, in any order and beside any others; see
`ros_messages`. Where a message tells no size, frames or the caller do.

The encodings of event_camera_msgs/EventPacket that are read:

    mono  64-bit words: 32 bits of nanoseconds since the packet's time base, 16 of x, 15 of y, 1 of
          polarity
    evt3  the camera's EVT3 words, see `prophesee`; the time base is not used

Times in packets are the camera's. One constant is added, so that the time base of the first packet
(mono) or the first event (evt3) is at the time of the first packet's header. Frames of another
topic are then on the same clock, but for the drift of the camera's.
"""

import dataclasses
import functools
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.errors import InputError, require
from jaxevent.io.bags import Bag, Place
from jaxevent.io.decoded import BLOCK, Columns, Decoder, Tally, TriggerList
from jaxevent.io.prophesee import evt3_events
from jaxevent.io.ros_messages import Layout
from jaxevent.recording import Triggers

_TIMES = ("ts", "t", "time", "stamp", "timestamp")
_POLARITIES = ("polarity", "p", "pol", "on")


class _Names(NamedTuple):
    """The names of the fields of an array: of the array itself, and of an event's numbers."""

    array: str
    sec: str
    nanosec: str
    x: str
    y: str
    p: str


def _names(layout: Layout) -> _Names | None:
    """The names of a message that is an array of events; None of others."""
    for field, type_ in layout.fields.items():
        members = [name for name, _ in layout.members(type_) or ()]
        lower = {name.lower(): name for name in members}
        t = next((name for name in _TIMES if f"{name}.nanosec" in lower), None)
        p = next((name for name in _POLARITIES if name in lower), None)
        if t is not None and p is not None and {"x", "y", f"{t}.sec"} <= set(lower):
            wanted = (f"{t}.sec", f"{t}.nanosec", "x", "y", p)
            return _Names(field, *(lower[name] for name in wanted))
    return None


def _is_packet(layout: Layout) -> bool:
    fields = layout.fields
    wanted = {"header", "time_base", "encoding", "events"}
    return wanted <= set(fields) and layout.members(fields["events"]) == [("", "u1")]


def _layout(bag: Bag, kind: str) -> Layout:
    return Layout(bag.fields, kind, bag.is_ros1)


def event_topics(bag: Bag) -> list[str]:
    """The topics whose messages are events by their fields, sorted."""
    layouts = {kind: _layout(bag, kind) for kind in set(bag.kinds().values())}
    held = {kind for kind, one in layouts.items() if _is_packet(one) or _names(one) is not None}
    return sorted(topic for topic, kind in bag.kinds().items() if kind in held)


@dataclasses.dataclass(frozen=True)
class EventTopic:
    """The events of a topic: their decoder, the size (width, height) they tell or None.

    `untimed` (how many events and triggers come before any time) and `triggers()` are filled by the
    decoder's first pass.
    """

    decode: Decoder
    size: tuple[int, int] | None
    untimed: Tally
    triggers: Callable[[], Triggers | None]


def event_topic(bag: Bag, topic: str) -> EventTopic:
    """Read what is needed before the events of a topic. Raises `InputError` for bad messages."""
    found, layout = Tally(), _layout(bag, bag.kind(topic))
    names = _names(layout)
    messages = (message for _, message in _messages(bag, topic, layout))
    if names is not None:
        decode = functools.partial(_arrays, bag, topic, layout, names)
        return EventTopic(decode, _size(next(messages)), found, lambda: None)
    packet = next(messages)
    size, encoding = _size(packet), packet["encoding"]
    stamp = packet["header"]["stamp"]
    stamp = stamp["sec"] * 10**9 + stamp["nanosec"]
    packets = functools.partial(_packets, bag, topic, layout)
    if encoding == "mono":
        shift = stamp - packet["time_base"]
        return EventTopic(functools.partial(_mono, packets, shift), size, found, lambda: None)
    if encoding != "evt3":
        raise InputError(
            f"{bag.path}: the packets of {topic} are encoded as {encoding[:20]!r}; only "
            "mono and evt3 can be read, so record the events as one of these"
        )
    require("evt3", "prophesee")
    words = _Evt3Packets(f"{bag.path}: {topic}", packets, stamp // 1000, found)
    return EventTopic(words.decode, size, found, words.triggers)


def _messages(
    bag: Bag, topic: str, layout: Layout, place: Place | None = None
) -> Iterator[tuple[Place, dict[str, Any]]]:
    """The messages of a topic, each with its place, from a place on."""
    for here, data in bag.messages(topic, place):
        try:
            yield here, layout.read(data)
        except ValueError as error:
            raise InputError(
                f"{bag.path}: a message of {topic} has {error}; the bag is damaged, so fetch it "
                "again"
            ) from None


def _size(message: Mapping[str, Any]) -> tuple[int, int] | None:
    width, height = (message.get(name) for name in ("width", "height"))
    return (width, height) if width and height else None


def _arrays(
    bag: Bag, topic: str, layout: Layout, names: _Names, state: Place | None
) -> Iterator[tuple[Place, Columns]]:
    held: list[NDArray] = []
    first, count = None, 0
    for place, message in _messages(bag, topic, layout, state):
        first = first or place
        pieces = message[names.array]
        held += pieces
        count += sum(map(len, pieces))
        if count >= BLOCK:
            yield first, _columns(bag, topic, names, held)
            held, first, count = [], None, 0
    if first is not None:
        yield first, _columns(bag, topic, names, held)


def _columns(bag: Bag, topic: str, names: _Names, pieces: list[NDArray]) -> Columns:
    s, ns, x, y, p = (
        np.concatenate([piece[name] for piece in pieces])
        for name in (names.sec, names.nanosec, names.x, names.y, names.p)
    )
    if len(ns) and ns.max() >= 10**9:
        raise InputError(
            f"{bag.path}: an event of {topic} has more than 10^9 nanoseconds; the bag is damaged, "
            "so fetch it again"
        )
    # Seconds are unsigned in ROS 1, and in ROS 2 not below 0; rosbags declares both as int32.
    s = s.view(np.uint32) if s.dtype == np.int32 else s
    return s * np.int64(1_000_000) + ns // 1000, x, y, p


def _packets(
    bag: Bag, topic: str, layout: Layout, encoding: str, width: int, place: Place | None
) -> Iterator[tuple[Place, Any, NDArray[np.uint8]]]:
    """A topic's packets, each with its place and its whole words of `width` bytes."""
    for here, packet in _messages(bag, topic, layout, place):
        is_bigendian = packet.get("is_bigendian", False)
        if packet["encoding"] != encoding or (is_bigendian and width == 8):
            raise InputError(
                f"{bag.path}: {topic} has packets of {packet['encoding'][:20]!r} "
                f"{'in big-endian words ' if is_bigendian else ''}after packets of "
                f"{encoding!r}; record them as one encoding, in little-endian words"
            )
        content = np.concatenate([piece["value"] for piece in packet["events"]])
        if len(content) % width:
            raise InputError(
                f"{bag.path}: a packet of {topic} has {len(content)} bytes, which are not "
                f"whole words of {width}; the bag is damaged, so fetch it again"
            )
        yield here, packet, content


Packets = Callable[[str, int, Any], Iterator[tuple[Place, Any, NDArray[np.uint8]]]]


def _mono(packets: Packets, shift: int, state: Place | None) -> Iterator[tuple[Place, Columns]]:
    """Decode packets of words; `shift` (ns) leads from time bases to the clock of headers."""
    held: list[tuple[NDArray, NDArray]] = []
    first = None
    for place, packet, content in packets("mono", 8, state):
        first = first or place
        words = content.view("<u8")
        held.append((words, (words & 0xFFFFFFFF).astype(np.int64) + (packet["time_base"] + shift)))
        if sum(len(words) for words, _ in held) >= BLOCK:
            yield first, _mono_columns(held)
            held, first = [], None
    if first is not None:
        yield first, _mono_columns(held)


def _mono_columns(held: list[tuple[NDArray, NDArray]]) -> Columns:
    words, t = (np.concatenate(column) for column in zip(*held, strict=True))
    x, y = words >> 32 & 0xFFFF, words >> 48 & 0x7FFF
    return t // 1000, x.astype(np.uint16), y.astype(np.uint16), words >> 63 == 1


class _Evt3Packets:
    """The words of evt3 packets, one after the other, on the clock of the first header (us)."""

    def __init__(self, source: str, packets: Packets, stamp: int, found: Tally):
        self._source, self._packets, self._stamp, self._found = source, packets, stamp, found
        self._list = TriggerList()
        self._shift: int | None = None

    def decode(self, state: Any) -> Iterator[tuple[Any, Columns]]:
        blocks = evt3_events(self._source, self._words, self._found, self._list, state)
        for here, (t, x, y, p) in blocks:
            if self._shift is None and len(t):
                self._shift = self._stamp - int(t[0])
            yield here, (t + (self._shift or 0), x, y, p)

    def triggers(self) -> Triggers | None:
        held = self._list.all()
        return held and dataclasses.replace(held, t=held.t + (self._shift or 0))

    def _words(self, place: tuple[int, Place] | None) -> Iterator[tuple[int, Any, NDArray]]:
        offset, at = place or (0, None)
        held: list[NDArray] = []
        first, count = None, 0
        for here, _, content in self._packets("evt3", 2, at):
            first = first or here
            held.append(content)
            count += len(content)
            if count >= 2 * BLOCK:
                yield offset, (offset, first), np.concatenate(held).view("<u2")
                offset += count
                held, first, count = [], None, 0
        if count:
            yield offset, (offset, first), np.concatenate(held).view("<u2")
