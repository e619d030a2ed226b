"""Bags of ROS 1, and of ROS 2 as a folder, .mcap or .db3, and the messages in them.

The package rosbags (Apache 2, no ROS) reads all of them. Its readers unfold a compressed chunk to
however much it holds; here neither a chunk nor all chunks of a file together, named by an index or
not, may unfold beyond `max_unfolded`. A database (.db3) may hold plain tables only, as a view or a
column made by a formula could take any time and memory. A folder whose files or messages rosbag2
compressed by itself is refused for the same reason.

Messages of events are read by the fields that their definitions list. The typed decoding of rosbags
makes an object of each element of an array and needs a class made of each definition; here NumPy
reads an array of elements of one size at once, for types of any name. ROS 1 packs fields without
gaps. CDR, of ROS 2, aligns each number to its size, counted from the fifth byte: an element of 13
bytes, x and y (uint16), time (2 x 32 bits) and polarity (uint8), has its first x at 0, the next at
14, then one every 16 bytes. From the second element on all are equally long: the number of the
largest alignment in the first one decides where its end lies.
"""

import contextlib
import functools
import importlib
import sqlite3
import struct
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxevent.errors import InputError, require
from jaxevent.io.checks import check_unfolded, max_unfolded

_PACKET_DEFINITION = """std_msgs/Header header
uint32 height
uint32 width
uint64 seq
uint64 time_base
string encoding
bool is_bigendian
uint8[] events
"""

# Definitions for bags that hold none, as rosbag2 wrote before 2023.
_EVENTS_DEFINITION = """std_msgs/Header header
uint32 height
uint32 width
{0}/Event[] events
================================================================================
MSG: {0}/Event
uint16 x
uint16 y
builtin_interfaces/Time ts
bool polarity
"""
_EVENT_PACKAGES = ("dvs_msgs", "prophesee_event_msgs", "dv_ros_msgs")

_MAX_DEFINITION_CHARS = 1 << 16  # characters of a definition that is parsed
_MCAP_CHUNK_KIND = 6  # kind of a record

_BASE_DTYPES = {
    "bool": "u1", "byte": "u1", "octet": "u1", "char": "u1",
    "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "int64": "i8", "uint64": "u8", "float32": "f4", "float64": "f8",
}  # fmt: skip
_MAX_ELEMENT_FIELDS = 64  # of an element of an array
_MAX_NESTING_DEPTH = 8  # parts within parts

Fields = list[tuple[str, Any]]  # of a type of message: names, and types as rosbags parses them
Place = tuple[int, int]  # a time of recording (ns), and the number of messages of it before


class Bag:
    """Topics and messages of a bag; every pass opens the file anew."""

    def __init__(self, path: Path):
        require("rosbags", "ros")
        self.path = path
        if path.is_dir():
            self._head = b""
        else:
            with path.open("rb") as file:
                self._head = file.read(16)
        self._is_database = self._head.startswith(b"SQLite")
        self.is_ros1 = self._head.startswith(b"#ROSBAG")
        if not self.is_ros1 and not self._is_database:
            for file in path.glob("*.mcap") if path.is_dir() else [path]:
                if file.is_file():
                    _check_chunks(file)
        with self._open() as reader:
            self._types = [(c.topic, c.msgtype, c.msgcount) for c in reader.connections]
            self._definitions = {c.msgtype: c.msgdef for c in reader.connections}

    def _open(self) -> Any:
        if self.is_ros1:
            return _open_ros1(self.path)
        from rosbags.rosbag2 import Reader

        if not self._head:
            _check_folder(self.path)
        elif self._is_database:
            _check_tables(self.path)
        _bound_chunks()
        kind = "dir" if not self._head else ".db3" if self._is_database else ".mcap"
        reader: Any = Reader.STORAGE_PLUGINS[kind](self.path)
        reader.open()
        try:
            for storage in getattr(reader, "storages", [reader]):
                unfolded = sum(chunk.uncompressed_size for chunk in getattr(storage, "chunks", ()))
                check_unfolded(unfolded, storage.path.stat().st_size, str(storage.path))
        except InputError:
            reader.close()
            raise
        return contextlib.closing(reader)

    def topics(self, *kinds: str) -> list[str]:
        """Return the topics that hold messages of some types, sorted."""
        return sorted({topic for topic, kind, count in self._types if kind in kinds and count})

    def kind(self, topic: str) -> str:
        """Return the type of a topic's messages."""
        return next(kind for name, kind, count in self._types if name == topic and count)

    def kinds(self) -> dict[str, str]:
        """Return the types of all topics that hold messages, by topic."""
        return {topic: kind for topic, kind, count in self._types if count}

    @functools.cached_property
    def fields(self) -> dict[str, Fields]:
        """Fields of every type of message, by the bag's definitions or else by known ones."""
        found = {name: fields for name, (_, fields) in _type_store(self.is_ros1).fielddefs.items()}
        for kind, definition in self._definitions.items():
            if kind not in found:
                found = _parse(kind, definition) | found
        return found

    def beside(self, events: str | None, several: list[str]) -> list[str]:
        """Select the topics that belong to the same camera as the events.

        Args:
            events: Topic of the events, if there is one.
            several: Topics of one kind.

        Returns:
            The only topic, or those under the events' own name.
        """
        if len(several) > 1 and events is not None:
            parent = events.rpartition("/")[0] + "/"
            several = [topic for topic in several if topic.startswith(parent)]
        return several

    def messages(self, topic: str, place: Place | None = None) -> Iterator[tuple[Place, bytes]]:
        """Iterate over the contents of a topic's messages.

        Args:
            topic: The topic.
            place: Place of the first message; None begins with the first of all.

        Yields:
            The place and the bytes of each message.
        """
        start, skip = place or (None, 0)
        here = (-1, 0)
        with self._open() as reader:
            connections = [c for c in reader.connections if c.topic == topic]
            for _, stamp, data in reader.messages(connections, start=start):
                here = (stamp, here[1] + 1 if stamp == here[0] else 0)
                if stamp != start or here[1] >= skip:
                    yield here, data

    def decoded(self, topic: str | None, place: Place | None = None) -> Iterator[tuple[Place, Any]]:
        """Iterate over the typed messages of a topic.

        Args:
            topic: The topic; None yields nothing.
            place: Place of the first message; None begins with the first of all.

        Yields:
            The place of each message, and the message.
        """
        if topic is None:
            return
        store, kind = _type_store(self.is_ros1), self.kind(topic)
        decode = store.deserialize_ros1 if self.is_ros1 else store.deserialize_cdr
        for here, data in self.messages(topic, place):
            yield here, decode(data, kind)


@functools.cache
def _type_store(is_ros1: bool) -> Any:
    """Make the known types of messages, once, as it takes longer than to read a small bag."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(_PACKET_DEFINITION, "event_camera_msgs/msg/EventPacket"))
    return store


def _parse(kind: str, definition: Any) -> dict[str, Fields]:
    """Parse the definition of a type and its parts.

    Args:
        kind: Name of the type.
        definition: Its definition, as rosbags reads it.

    Returns:
        Fields by the names of the types; none if the definition is damaged.
    """
    from rosbags.interfaces import MessageDefinitionFormat
    from rosbags.typesys import get_types_from_idl, get_types_from_msg

    package = kind.partition("/")[0]
    text, is_idl = definition.data, definition.format == MessageDefinitionFormat.IDL
    if definition.format == MessageDefinitionFormat.NONE:
        is_array = package in _EVENT_PACKAGES and kind.endswith("/EventArray")
        text = _EVENTS_DEFINITION.format(package) if is_array else ""
    parsed: dict[str, Any] = {}
    if len(text) > _MAX_DEFINITION_CHARS:
        return parsed
    with contextlib.suppress(Exception):  # of any kind: the parser follows the text of the file
        parsed = get_types_from_idl(text) if is_idl else get_types_from_msg(text, kind)
    return {name: fields for name, (_, fields) in parsed.items()}


def _open_ros1(path: Path) -> Any:
    from rosbags.rosbag1 import Reader
    from rosbags.rosbag1.reader import decompressors

    reader = Reader(path)
    reader.open()
    for place, chunk in reader.chunks.items():
        if chunk.decompressor is not decompressors["none"]:
            unfold = functools.partial(_unfold, path)
            reader.chunks[place] = chunk._replace(decompressor=unfold)
    return contextlib.closing(reader)


def _unfold(path: Path, data: bytes) -> bytes:
    """Unfold a chunk, bz2 or LZ4, within bounds, which rosbags does not check."""
    import bz2

    import lz4.frame

    length = path.stat().st_size
    is_bz2 = data.startswith(b"BZh")
    decompressor: Any = bz2.BZ2Decompressor() if is_bz2 else lz4.frame.LZ4FrameDecompressor()
    unfolded = decompressor.decompress(data, max_length=max_unfolded(length) + 1)
    check_unfolded(len(unfolded), length, str(path))
    return unfolded


def _check_chunks(path: Path) -> None:
    """Raise `InputError` if the chunks of an MCAP together claim too much.

    Without an index rosbags finds them one after another; each could claim the most for itself.
    """
    length, at, unfolded = path.stat().st_size, 8, 0
    with path.open("rb") as file:
        while at + 9 <= length:
            file.seek(at)
            kind, size = struct.unpack("<BQ", file.read(9))
            if kind == _MCAP_CHUNK_KIND and len(head := file.read(24)) == 24:
                unfolded += struct.unpack("<16xQ", head)[0]
            at += 9 + size
    check_unfolded(unfolded, length, str(path))


def _check_chunk(size: int, data: bytes) -> None:
    """Raise `ValueError` for a chunk that claims too much; the caller names the file."""
    if size > max_unfolded(len(data)):
        raise ValueError(f"a chunk of {len(data):,} bytes claims to hold {size:,}")


@functools.cache
def _bound_chunks() -> None:
    """Let rosbags unfold a chunk of MCAP to the size that it claims, within bounds, no further."""
    import lz4.frame

    storage_mcap: Any = importlib.import_module("rosbags.rosbag2.storage_mcap")

    def lz4_chunk(data: bytes, size: int) -> bytes:
        _check_chunk(size, data)
        return lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size + 1)

    def zstd_chunk(data: bytes, size: int) -> bytes:
        _check_chunk(size, data)
        return storage_mcap.zstd.ZstdDecompressor().decompress(data, max_length=size + 1)

    storage_mcap.DECOMPRESSORS.update({"lz4": lz4_chunk, "zstd": zstd_chunk})


def _check_folder(path: Path) -> None:
    """Raise `InputError` for what must not be opened: pipes, missing files, compressed files."""
    from ruamel.yaml import YAML

    described: Any = YAML(typ="safe").load((path / "metadata.yaml").read_text())
    bag = described["rosbag2_bagfile_information"]
    mode = str(bag.get("compression_mode") or "none").lower()
    if mode != "none":
        raise InputError(
            f"{path}: rosbag2 compressed its {mode}s; write the bag without that, with "
            "ros2 bag convert, or as MCAP, which compresses its chunks"
        )
    for name in bag["relative_file_paths"]:
        file = path / Path(name).name
        if not file.is_file():
            raise InputError(
                f"{path}: metadata.yaml names {str(name)[:100]!r}, which is no file of this "
                "folder; fetch the whole bag again"
            )
        if bag["storage_identifier"] == "sqlite3":
            _check_tables(file)


def _check_tables(path: Path) -> None:
    """Raise `InputError` for a database with views, virtual tables or columns of formulas."""
    with contextlib.closing(
        sqlite3.connect(f"{path.absolute().as_uri()}?immutable=1", uri=True)
    ) as database:
        held = database.execute("SELECT type, name, rootpage FROM sqlite_master").fetchall()
        plain = all(kind == "index" or (kind == "table" and root) for kind, _, root in held)
        for _, name, _ in held if plain else ():
            columns = database.execute("SELECT hidden FROM pragma_table_xinfo(?)", (name,))
            plain &= not any(hidden for (hidden,) in columns)
    if not plain:
        raise InputError(
            f"{path}: the database holds more than plain tables, so it is not a bag as ROS 2 "
            "writes them; record it again"
        )


class MessageLayout:
    """The fields of a type of message."""

    def __init__(self, types: Mapping[str, Fields], kind: str, is_ros1: bool):
        """Take the fields of every type by its name, and the name of the message's type."""
        self._types, self._kind, self._is_ros1 = types, kind, is_ros1
        self._known: dict[Any, tuple[tuple[str, str], ...] | None] = {}

    @property
    def fields(self) -> dict[str, Any]:
        """Types of the message's own fields, by name; none of an unknown type."""
        return dict(self._types.get(self._kind, ()))

    def members(self, type_: Any) -> list[tuple[str, str]] | None:
        """Find the names and NumPy types of the numbers of an element of an array.

        Numbers of a part have its name before theirs, as in `ts.sec`. Returns None of other fields.
        """
        node, detail = type_
        return _members(self._types, detail[0], "") if node.name == "SEQUENCE" else None

    def read(self, data: bytes) -> dict[str, Any]:
        """Read the values of a message, by name.

        Parts are dictionaries, texts str. An array of elements of one size is a list of NumPy
        arrays, to be taken one after the other, whose fields are named as by `members`; of bare
        numbers the field is `value`. Raises `ValueError` where the bytes do not fit the definition.
        """
        order = "<" if self._is_ros1 or data[1] & 1 else ">"
        reader = _MessageReader(self._types, data, order, self._is_ros1, self._known)
        values = reader.read_part(self._kind)
        # A writer of CDR may fill up to a multiple of 4 bytes.
        if not 0 <= len(data) - reader.at <= (0 if self._is_ros1 else 3):
            raise ValueError(f"{len(data)} bytes, of which the fields take {reader.at}")
        return values


def _members(
    types: Mapping[str, Fields], type_: Any, name: str, depth: int = 0
) -> list[tuple[str, str]] | None:
    node, detail = type_
    if node.name == "BASE":
        return [(name, _BASE_DTYPES[detail[0]])] if detail[0] in _BASE_DTYPES else None
    if node.name == "ARRAY":
        inner, count = detail
        parts = [
            (f"{name}[{i}]", inner) for i in range(count if count <= _MAX_ELEMENT_FIELDS else 0)
        ]
    else:
        fields = types.get(detail, ()) if node.name == "NAME" and depth < _MAX_NESTING_DEPTH else ()
        parts = [(f"{name}.{field}".lstrip("."), inner) for field, inner in fields]
    found: list[tuple[str, str]] = []
    for part, inner in parts:
        more = _members(types, inner, part, depth + 1)
        if more is None or len(found) + len(more) > _MAX_ELEMENT_FIELDS:
            return None
        found += more
    return found or None


class _MessageReader:
    """Reader of the bytes of a message from front to back.

    Attributes:
        types: Fields of every type, by its name.
        data: Bytes of the message.
        order: "<" or ">", as NumPy writes the order of bytes.
        is_ros1: Whether fields are packed without gaps.
        known: Members of the arrays' elements, kept from message to message.
        at: Offset of the next byte.
    """

    def __init__(
        self, types: Mapping[str, Fields], data: bytes, order: str, is_ros1: bool, known: dict
    ):
        self.types, self.data, self.order, self.is_ros1 = types, data, order, is_ros1
        self.known = known
        self.at = 0 if is_ros1 else 4
        # Parts without fields take no bytes, so that these alone would not bound the work.
        self.parts_left = len(data) + _MAX_ELEMENT_FIELDS

    def read_part(self, kind: str, depth: int = 0) -> dict[str, Any]:
        self.parts_left -= 1
        if kind not in self.types or depth > _MAX_NESTING_DEPTH or self.parts_left < 0:
            raise ValueError(f"a part {kind[:60]!r} without a usable definition")
        return {name: self.read_value(type_, depth) for name, type_ in self.types[kind]}

    def read_value(self, type_: Any, depth: int) -> Any:
        node, detail = type_
        if node.name == "NAME":
            return self.read_part(detail, depth + 1)
        if node.name == "BASE":
            return (
                self.read_text()
                if "string" in detail[0]
                else self.read_number(_BASE_DTYPES[detail[0]])
            )
        inner, count = detail
        if node.name == "SEQUENCE":
            count = self.read_number("u4")
        if inner not in self.known:
            found = _members(self.types, inner, "")
            self.known[inner] = None if found is None else tuple(found)
        members = self.known[inner]
        if members is None:
            if count > len(self.data):
                raise ValueError(f"an array claims {count} elements")
            return [self.read_value(inner, depth) for _ in range(count)]
        return self.read_elements(members, count)

    def read_number(self, kind: str) -> Any:
        size = int(kind[1])
        if not self.is_ros1:
            self.at += -(self.at - 4) % size
        if size > len(self.data) - self.at:
            raise ValueError(f"{len(self.data)} bytes, too few for its fields")
        value = np.frombuffer(self.data, self.order + kind, 1, self.at).item()
        self.at += size
        return value

    def read_text(self) -> str:
        length = self.read_number("u4")
        text = self.data[self.at : self.at + length]
        self.at += length
        return text.rstrip(b"\0").decode(errors="replace")

    def read_elements(self, members: tuple[tuple[str, str], ...], count: int) -> list[NDArray]:
        pieces = []
        for some in (count,) if self.is_ros1 else (min(count, 1), max(0, count - 1)):
            alignment = 0 if self.is_ros1 else (self.at - 4) % 8
            dtype = _element_type(members, self.order, alignment, self.is_ros1)
            size = some * dtype.itemsize
            if size > len(self.data) - self.at:
                raise ValueError(
                    f"{len(self.data) - self.at} bytes for {some} elements, not {size}"
                )
            pieces.append(np.frombuffer(self.data, dtype, some, self.at))
            self.at += size
        return pieces


@functools.cache
def _element_type(
    members: tuple[tuple[str, str], ...], order: str, start: int, is_ros1: bool
) -> np.dtype:
    """Return the NumPy type of an array's element.

    Args:
        members: Names of its members, and kinds such as "u4".
        order: "<" or ">".
        start: Offset at which the element begins, modulo 8: CDR aligns members.
        is_ros1: Whether members are packed without gaps.
    """
    at, offsets = start, []
    for _, kind in members:
        size = np.dtype(kind).itemsize
        at += 0 if is_ros1 else -at % size
        offsets.append(at - start)
        at += size
    names = [name or "value" for name, _ in members]
    formats = [order + kind for _, kind in members]
    return np.dtype(
        {"names": names, "formats": formats, "offsets": offsets, "itemsize": at - start}
    )
