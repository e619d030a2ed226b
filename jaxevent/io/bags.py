"""The containers of ROS messages: bags of ROS 1, and of ROS 2 as a folder, .mcap or .db3.

The package rosbags (Apache 2, no ROS) reads all of them. Its readers unfold a compressed chunk to
however much it holds; here neither a chunk nor all chunks of a file together, named by an index or
not, may unfold beyond `most_unfolded`. A database (.db3)
may hold plain tables only, as a view or a column made by a formula could take any time and memory.
A folder whose files or messages rosbag2 compressed by itself is refused for the same reason.
"""

import contextlib
import functools
import importlib
import sqlite3
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from jaxevent.errors import InputError, require
from jaxevent.io import check_unfolded, most_unfolded

_PACKET = """std_msgs/Header header
uint32 height
uint32 width
uint64 seq
uint64 time_base
string encoding
bool is_bigendian
uint8[] events
"""

# Definitions for bags that hold none, as rosbag2 wrote before 2023.
_EVENTS = """std_msgs/Header header
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

_LONGEST = 1 << 16  # characters of a definition that is parsed
_CHUNK = 6  # records of MCAP

Fields = list[tuple[str, Any]]  # of a type of message: names, and types as rosbags parses them
Place = tuple[int, int]  # a time of recording (ns), and how many messages of it come before


class Bag:
    """A bag's topics and messages; every pass opens the file anew."""

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
        return sorted({topic for topic, kind, count in self._types if kind in kinds and count})

    def kind(self, topic: str) -> str:
        """The type of a topic's messages."""
        return next(kind for name, kind, count in self._types if name == topic and count)

    def kinds(self) -> dict[str, str]:
        """The types of all topics that hold messages, by topic."""
        return {topic: kind for topic, kind, count in self._types if count}

    @functools.cached_property
    def fields(self) -> dict[str, Fields]:
        """The fields of every type of message, by the definitions that the bag holds, or else
        that are known; of a type without a definition there are none."""
        found = {name: fields for name, (_, fields) in _types(self.is_ros1).fielddefs.items()}
        for kind, definition in self._definitions.items():
            if kind not in found:
                found = _parse(kind, definition) | found
        return found

    def beside(self, events: str | None, several: list[str]) -> list[str]:
        """The topics that belong to the same camera as the events: the only one, or those of the
        events' own name."""
        if len(several) > 1 and events is not None:
            parent = events.rpartition("/")[0] + "/"
            several = [topic for topic in several if topic.startswith(parent)]
        return several

    def messages(self, topic: str, place: Place | None = None) -> Iterator[tuple[Place, bytes]]:
        """Contents of a topic's messages, each with its place, from a place on."""
        start, skip = place or (None, 0)
        here = (-1, 0)
        with self._open() as reader:
            connections = [c for c in reader.connections if c.topic == topic]
            for _, stamp, data in reader.messages(connections, start=start):
                here = (stamp, here[1] + 1 if stamp == here[0] else 0)
                if stamp != start or here[1] >= skip:
                    yield here, data

    def decoded(self, topic: str | None, place: Place | None = None) -> Iterator[tuple[Place, Any]]:
        """Typed messages of a topic, each with its place, from a place on; None: no topic."""
        if topic is None:
            return
        store, kind = _types(self.is_ros1), self.kind(topic)
        decode = store.deserialize_ros1 if self.is_ros1 else store.deserialize_cdr
        for here, data in self.messages(topic, place):
            yield here, decode(data, kind)


@functools.cache
def _types(is_ros1: bool) -> Any:
    """What the messages of a ROS hold; made once, as it takes longer than a small bag."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(_PACKET, "event_camera_msgs/msg/EventPacket"))
    return store


def _parse(kind: str, definition: Any) -> dict[str, Fields]:
    """The fields of a type and of those that it holds; none where its definition is damaged."""
    from rosbags.interfaces import MessageDefinitionFormat
    from rosbags.typesys import get_types_from_idl, get_types_from_msg

    package = kind.partition("/")[0]
    text, is_idl = definition.data, definition.format == MessageDefinitionFormat.IDL
    if definition.format == MessageDefinitionFormat.NONE:
        is_array = package in _EVENT_PACKAGES and kind.endswith("/EventArray")
        text = _EVENTS.format(package) if is_array else ""
    parsed: dict[str, Any] = {}
    if len(text) > _LONGEST:
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
            unfold = functools.partial(_unfolded, path)
            reader.chunks[place] = chunk._replace(decompressor=unfold)
    return contextlib.closing(reader)


def _unfolded(path: Path, data: bytes) -> bytes:
    """A chunk without its compression, bz2 or LZ4; rosbags takes however much it unfolds to."""
    import bz2

    import lz4.frame

    length = path.stat().st_size
    is_bz2 = data.startswith(b"BZh")
    decompressor: Any = bz2.BZ2Decompressor() if is_bz2 else lz4.frame.LZ4FrameDecompressor()
    unfolded = decompressor.decompress(data, max_length=most_unfolded(length) + 1)
    check_unfolded(len(unfolded), length, str(path))
    return unfolded


def _check_chunks(path: Path) -> None:
    """Raise `InputError` where the chunks of an MCAP together claim too much.

    Without an index rosbags finds them one after another; each could claim the most for itself.
    """
    length, at, unfolded = path.stat().st_size, 8, 0
    with path.open("rb") as file:
        while at + 9 <= length:
            file.seek(at)
            kind, size = struct.unpack("<BQ", file.read(9))
            if kind == _CHUNK and len(head := file.read(24)) == 24:
                unfolded += struct.unpack("<16xQ", head)[0]
            at += 9 + size
    check_unfolded(unfolded, length, str(path))


def _check_chunk(size: int, data: bytes) -> None:
    """Raise `ValueError` for a chunk that claims too much; who reads the file names it."""
    if size > most_unfolded(len(data)):
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
