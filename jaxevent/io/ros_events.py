"""Events in the messages of ROS: EventArray of dvs_msgs and prophesee_event_msgs, EventPacket.

    EventArray   header, height, width, events of x and y (uint16), time (2 x 32 bits), polarity
    EventPacket  header, height, width, number, time base, encoding, byte order, encoded bytes

An event of an EventArray takes 13 bytes in ROS 1. In ROS 2 (CDR) each number is aligned to its
size: the first event is at 0, the next at 14, then one every 16 bytes. The typed decoding of
rosbags makes an object of each event; NumPy reads them all at once.

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
import struct
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxevent.errors import InputError, require
from jaxevent.io.bags import Bag, Place
from jaxevent.io.decoded import BLOCK, Columns, Decoder, Tally, TriggerList
from jaxevent.io.prophesee import evt3_events
from jaxevent.recording import Triggers

ARRAYS = ("dvs_msgs/msg/EventArray", "prophesee_event_msgs/msg/EventArray")
PACKET = "event_camera_msgs/msg/EventPacket"
_ROS1_EVENT = np.dtype([("x", "<u2"), ("y", "<u2"), ("s", "<u4"), ("ns", "<u4"), ("p", "u1")])


def _aligned_event(offsets: list[int]) -> np.dtype:
    return np.dtype(
        {
            "names": ["x", "y", "s", "ns", "p"],
            "formats": ["<u2", "<u2", "<u4", "<u4", "u1"],
            "offsets": offsets,
            "itemsize": 16,
        }
    )


# From the end of the event before, 13, the next x is at 14; the time after it at 20.
_FIRST_EVENT, _NEXT_EVENT = _aligned_event([0, 2, 4, 8, 12]), _aligned_event([0, 2, 6, 10, 14])


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
    found = Tally()
    if bag.kind(topic) != PACKET:
        decode = functools.partial(_arrays, bag, topic)
        return EventTopic(decode, _size(bag, topic), found, lambda: None)
    packet = next(packet for _, packet in bag.decoded(topic))
    size = (packet.width, packet.height) if packet.width and packet.height else None
    stamp = packet.header.stamp.sec * 10**9 + packet.header.stamp.nanosec
    if packet.encoding == "mono":
        shift = stamp - packet.time_base
        return EventTopic(functools.partial(_mono, bag, topic, shift), size, found, lambda: None)
    if packet.encoding != "evt3":
        raise InputError(
            f"{bag.path}: the packets of {topic} are encoded as {packet.encoding[:20]!r}; only "
            "mono and evt3 can be read, so record the events as one of these"
        )
    require("evt3", "prophesee")
    packets = _Evt3Packets(bag, topic, stamp // 1000, found)
    return EventTopic(packets.decode, size, found, packets.triggers)


def _arrays(bag: Bag, topic: str, state: Place | None) -> Iterator[tuple[Place, Columns]]:
    held: list[NDArray] = []
    first, count = None, 0
    for place, data in bag.messages(topic, state):
        first = first or place
        pieces = _array(bag, topic, data)[1]
        held += pieces
        count += sum(map(len, pieces))
        if count >= BLOCK:
            yield first, _columns(bag, topic, held)
            held, first, count = [], None, 0
    if first is not None:
        yield first, _columns(bag, topic, held)


def _array(bag: Bag, topic: str, data: bytes) -> tuple[tuple[int, int], list[NDArray]]:
    """The size (width, height) that an EventArray tells, and its events in one or two pieces."""
    # The header's time, and before it its number in ROS 1, 4 bytes of the order of bytes in ROS 2.
    order = "<" if bag.is_ros1 or data[1] & 1 else ">"
    at = 16 + struct.unpack_from(f"{order}I", data, 12)[0]
    at += 0 if bag.is_ros1 else -at % 4
    height, width, count = struct.unpack_from(f"{order}3I", data, at)
    at += 12
    size = _ROS1_EVENT.itemsize * count if bag.is_ros1 else max(0, 16 * count - 3)
    # A writer of CDR may fill up to a multiple of 4 bytes.
    if not at + size <= len(data) <= at + size + (0 if bag.is_ros1 else 3):
        raise InputError(
            f"{bag.path}: a message of {topic} has {len(data) - at} bytes for {count} events, not "
            f"{size}; the bag is damaged, so fetch it again"
        )
    if bag.is_ros1:
        return (width, height), [np.frombuffer(data, _ROS1_EVENT, count, at)]
    padded = data + bytes(16)
    first = np.frombuffer(padded, _FIRST_EVENT.newbyteorder(order), min(count, 1), at)
    others = np.frombuffer(padded, _NEXT_EVENT.newbyteorder(order), max(0, count - 1), at + 14)
    return (width, height), [first, others]


def _size(bag: Bag, topic: str) -> tuple[int, int] | None:
    for _, data in bag.messages(topic):
        width, height = _array(bag, topic, data)[0]
        return (width, height) if width and height else None
    return None


def _columns(bag: Bag, topic: str, pieces: list[NDArray]) -> Columns:
    s, ns, x, y, p = (
        np.concatenate([piece[name] for piece in pieces]) for name in ("s", "ns", "x", "y", "p")
    )
    if len(ns) and ns.max() >= 10**9:
        raise InputError(
            f"{bag.path}: an event of {topic} has more than 10^9 nanoseconds; the bag is damaged, "
            "so fetch it again"
        )
    return s * np.int64(1_000_000) + ns // 1000, x, y, p


def _packets(
    bag: Bag, topic: str, encoding: str, width: int, place: Place | None
) -> Iterator[tuple[Place, Any, NDArray[np.uint8]]]:
    """A topic's packets, each with its place and its whole words of `width` bytes."""
    for here, packet in bag.decoded(topic, place):
        if packet.encoding != encoding or (packet.is_bigendian and width == 8):
            raise InputError(
                f"{bag.path}: {topic} has packets of {packet.encoding[:20]!r} "
                f"{'in big-endian words ' if packet.is_bigendian else ''}after packets of "
                f"{encoding!r}; record them as one encoding, in little-endian words"
            )
        if len(packet.events) % width:
            raise InputError(
                f"{bag.path}: a packet of {topic} has {len(packet.events)} bytes, which are not "
                f"whole words of {width}; the bag is damaged, so fetch it again"
            )
        yield here, packet, packet.events


def _mono(bag: Bag, topic: str, shift: int, state: Place | None) -> Iterator[tuple[Place, Columns]]:
    """Decode packets of words; `shift` (ns) leads from time bases to the clock of headers."""
    held: list[tuple[NDArray, NDArray]] = []
    first = None
    for place, packet, content in _packets(bag, topic, "mono", 8, state):
        first = first or place
        words = content.view("<u8")
        held.append((words, (words & 0xFFFFFFFF).astype(np.int64) + (packet.time_base + shift)))
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

    def __init__(self, bag: Bag, topic: str, stamp: int, found: Tally):
        self._bag, self._topic, self._stamp, self._found = bag, topic, stamp, found
        self._list = TriggerList()
        self._shift: int | None = None

    def decode(self, state: Any) -> Iterator[tuple[Any, Columns]]:
        source = f"{self._bag.path}: {self._topic}"
        blocks = evt3_events(source, self._words, self._found, self._list, state)
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
        for here, _, content in _packets(self._bag, self._topic, "evt3", 2, at):
            first = first or here
            held.append(content)
            count += len(content)
            if count >= 2 * BLOCK:
                yield offset, (offset, first), np.concatenate(held).view("<u2")
                offset += count
                held, first, count = [], None, 0
        if count:
            yield offset, (offset, first), np.concatenate(held).view("<u2")
