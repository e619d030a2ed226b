"""Messages of ROS 1 and of ROS 2 (CDR), read by the fields that their definitions list.

The typed decoding of rosbags makes an object of each element of an array and needs a class made of
each definition; here an array of elements of one size is read at once, by NumPy, and whatever the
type is called.

ROS 1 packs fields without gaps. CDR aligns each number to its size, counted from the fifth byte:
an element of 13 bytes, x and y (uint16), time (2 x 32 bits) and polarity (uint8), has its first x
at 0, the next at 14, then one every 16 bytes. From the second element on all are equally long: the
number of the largest alignment in the first one decides where its end lies.
"""

import functools
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxevent.io.bags import Fields

_BASES = {
    "bool": "u1", "byte": "u1", "octet": "u1", "char": "u1",
    "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "int64": "i8", "uint64": "u8", "float32": "f4", "float64": "f8",
}  # fmt: skip
_FORMATS = {
    "u1": "B", "i1": "b", "u2": "H", "i2": "h", "u4": "I", "i4": "i", "u8": "Q", "i8": "q",
    "f4": "f", "f8": "d",
}  # fmt: skip
_MOST_FIELDS = 64  # of an element of an array
_DEEPEST = 8  # parts within parts


class Layout:
    """The fields of a type of message; `types` holds those of every type, by its name."""

    def __init__(self, types: Mapping[str, Fields], kind: str, is_ros1: bool):
        self._types, self._kind, self._is_ros1 = types, kind, is_ros1
        self._known: dict[Any, tuple[tuple[str, str], ...] | None] = {}

    @property
    def fields(self) -> dict[str, Any]:
        """The types of the message's own fields, by name; none of an unknown type."""
        return dict(self._types.get(self._kind, ()))

    def members(self, type_: Any) -> list[tuple[str, str]] | None:
        """Names and NumPy types of the numbers of an element of an array; None of other fields.

        Numbers of a part have its name before theirs, as in `ts.sec`.
        """
        node, detail = type_
        return _members(self._types, detail[0], "") if node.name == "SEQUENCE" else None

    def read(self, data: bytes) -> dict[str, Any]:
        """The values of a message, by name.

        Parts are dictionaries, texts str. An array of elements of one size is a list of NumPy
        arrays, to be taken one after the other, whose fields are named as by `members`; of bare
        numbers the field is `value`. Raises `ValueError` where the bytes do not fit the definition.
        """
        order = "<" if self._is_ros1 or data[1] & 1 else ">"
        reader = _Reader(self._types, data, order, self._is_ros1, self._known)
        values = reader.part(self._kind)
        # A writer of CDR may fill up to a multiple of 4 bytes.
        if not 0 <= len(data) - reader.at <= (0 if self._is_ros1 else 3):
            raise ValueError(f"{len(data)} bytes, of which the fields take {reader.at}")
        return values


def _members(
    types: Mapping[str, Fields], type_: Any, name: str, depth: int = 0
) -> list[tuple[str, str]] | None:
    node, detail = type_
    if node.name == "BASE":
        return [(name, _BASES[detail[0]])] if detail[0] in _BASES else None
    if node.name == "ARRAY":
        inner, count = detail
        parts = [(f"{name}[{i}]", inner) for i in range(count if count <= _MOST_FIELDS else 0)]
    else:
        fields = types.get(detail, ()) if node.name == "NAME" and depth < _DEEPEST else ()
        parts = [(f"{name}.{field}".lstrip("."), inner) for field, inner in fields]
    found: list[tuple[str, str]] = []
    for part, inner in parts:
        more = _members(types, inner, part, depth + 1)
        if more is None or len(found) + len(more) > _MOST_FIELDS:
            return None
        found += more
    return found or None


class _Reader:
    """A place in the bytes of a message, and what is read there.

    `known` keeps the members of the arrays' elements from message to message.
    """

    def __init__(
        self, types: Mapping[str, Fields], data: bytes, order: str, is_ros1: bool, known: dict
    ):
        self.types, self.data, self.order, self.is_ros1 = types, data, order, is_ros1
        self.known = known
        self.at = 0 if is_ros1 else 4
        # Parts without fields take no bytes, so that these alone would not bound the work.
        self.parts_left = len(data) + _MOST_FIELDS

    def part(self, kind: str, depth: int = 0) -> dict[str, Any]:
        self.parts_left -= 1
        if kind not in self.types or depth > _DEEPEST or self.parts_left < 0:
            raise ValueError(f"a part {kind[:60]!r} without a usable definition")
        return {name: self.value(type_, depth) for name, type_ in self.types[kind]}

    def value(self, type_: Any, depth: int) -> Any:
        node, detail = type_
        if node.name == "NAME":
            return self.part(detail, depth + 1)
        if node.name == "BASE":
            return self.text() if "string" in detail[0] else self.number(_BASES[detail[0]])
        inner, count = detail
        if node.name == "SEQUENCE":
            count = self.number("u4")
        if inner not in self.known:
            found = _members(self.types, inner, "")
            self.known[inner] = None if found is None else tuple(found)
        members = self.known[inner]
        if members is None:
            if count > len(self.data):
                raise ValueError(f"an array claims {count} elements")
            return [self.value(inner, depth) for _ in range(count)]
        return self.elements(members, count)

    def number(self, kind: str) -> Any:
        size = int(kind[1])
        if not self.is_ros1:
            self.at += -(self.at - 4) % size
        if size > len(self.data) - self.at:
            raise ValueError(f"{len(self.data)} bytes, too few for its fields")
        (value,) = struct.unpack_from(self.order + _FORMATS[kind], self.data, self.at)
        self.at += size
        return value

    def text(self) -> str:
        length = self.number("u4")
        text = self.data[self.at : self.at + length]
        self.at += length
        return text.rstrip(b"\0").decode(errors="replace")

    def elements(self, members: tuple[tuple[str, str], ...], count: int) -> list[NDArray]:
        pieces = []
        for some in (count,) if self.is_ros1 else (min(count, 1), max(0, count - 1)):
            alignment = 0 if self.is_ros1 else (self.at - 4) % 8
            dtype = _element(members, self.order, alignment, self.is_ros1)
            size = some * dtype.itemsize
            if size > len(self.data) - self.at:
                raise ValueError(
                    f"{len(self.data) - self.at} bytes for {some} elements, not {size}"
                )
            pieces.append(np.frombuffer(self.data, dtype, some, self.at))
            self.at += size
        return pieces


@functools.cache
def _element(
    members: tuple[tuple[str, str], ...], order: str, start: int, is_ros1: bool
) -> np.dtype:
    """The bytes of an element that begins at `start` modulo 8, from there."""
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
