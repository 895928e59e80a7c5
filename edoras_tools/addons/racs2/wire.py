"""RACS2: messages between ROS 2 and cFS as JAXA's public bridge sends them in WebSocket frames.

Taken from its sources (racs2_bridge 1.1, https://github.com/jaxa/racs2_bridge): a header of 32 bytes, then
the body. To ROS 2 the header is a topic's name; to cFS it starts with a MsgId. **The only length on the
wire** is that of the frame, and the cFS side always sends 128 bytes of body, with zeros behind the content.
The body can be anything; the public examples put a Protocol Buffers message of ``std_msgs`` there.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple

from edoras_tools.wire.layout import Field, Layout

if TYPE_CHECKING:
    from collections.abc import Iterator

BRIDGE_WEBSOCKET_PORT: Final = 8765
SUBPROTOCOL: Final = "example-protocol"
"""The subprotocol that the cFS side requests in the handshake; the public ROS side answers without one."""
BRIDGE_HEADER: Final = 32
LARGEST_MESSAGE: Final = 1 << 20
"""Bytes of the longest message that is read, its WebSocket header included."""
LARGEST_BODY: Final = 128
"""Size in bytes of the cFS side's buffer for a body; it copies longer ones beyond the buffer's end."""
TO_ROS: Final = Layout(
    "racs2_topic",
    "RACS2 to ROS 2",
    Field("topic_name", 8 * BRIDGE_HEADER, "the topic that the body is published on", kind="text"),
)
TO_CFS: Final = Layout(
    "racs2_message",
    "RACS2 to cFS",
    Field("msg_id", 16, "the MsgId that the body is sent with on the software bus", base=16),
    Field("rest", 8 * (BRIDGE_HEADER - 2), "not used, zeros", kind="bytes"),
)


class BodyField(NamedTuple):
    """A field of ``RACS2Bridge_std_msgs.proto``.

    Attributes:
        number: number of the field.
        kind: how its values are written: ``int64`` is a varint with a sign, ``uint64`` one without.
        type: type of ``std_msgs`` that the public ``.proto`` file names.
    """

    number: int
    kind: Literal["bool", "float", "double", "int64", "uint64", "string"]
    type: str

    @property
    def is_array(self) -> bool:
        """Whether it has several values."""
        return self.type.endswith("MultiArray")


BODY_FIELDS: Final = {
    "bool_data": BodyField(1, "bool", "Bool"),
    "float_data": BodyField(2, "float", "Float32"),
    "double_data": BodyField(3, "double", "Float64"),
    "int32_data": BodyField(4, "int64", "Int32"),
    "int64_data": BodyField(5, "int64", "Int64"),
    "string_data": BodyField(6, "string", "String"),
    "uint32_data": BodyField(7, "uint64", "UInt32"),
    "uint64_data": BodyField(8, "uint64", "UInt64"),
    "float32_array_data": BodyField(9, "float", "Float32MultiArray"),
    "float64_array_data": BodyField(10, "double", "Float64MultiArray"),
    "int32_array_data": BodyField(11, "int64", "Int32MultiArray"),
    "int64_array_data": BodyField(12, "int64", "Int64MultiArray"),
    "uint32_array_data": BodyField(13, "uint64", "UInt32MultiArray"),
    "uint64_array_data": BodyField(14, "uint64", "UInt64MultiArray"),
}
"""The fields of a body by name."""
_NAMES: Final = {field.number: name for name, field in BODY_FIELDS.items()}
_FIXED: Final = {"float": "<f", "double": "<d"}
_VARINT, _EIGHT, _BYTES, _FOUR = 0, 1, 2, 5


def std_msgs_values(body: bytes) -> dict[str, Any] | None:
    """Return the values of a body that is a ``RACS2Bridge_std_msgs``; None if it is something else.

    Zeros at its end are padding. Field names are those of the public ``.proto`` file.
    """
    values: dict[str, Any] = {}
    try:
        for number, raw in _fields(body):
            name = _NAMES[number]
            field = BODY_FIELDS[name]
            if field.is_array:
                values.setdefault(name, []).extend(_numbers(field.kind, raw))
            elif field.kind == "string":
                values[name] = raw.decode()
            else:
                (values[name],) = _numbers(field.kind, raw)
    except (KeyError, ValueError, struct.error, AttributeError, TypeError):
        return None
    return values or None


def _fields(body: bytes) -> Iterator[tuple[int, Any]]:
    """Yield the number and the content of each field: an int, or bytes.

    Raises:
        ValueError: the body is no Protocol Buffers message.
    """
    at = 0
    while at < len(body) and any(body[at:]):
        key, at = _varint(body, at)
        number, kind = key >> 3, key & 7
        if kind == _VARINT:
            value, at = _varint(body, at)
            yield number, value
            continue
        size, at = _varint(body, at) if kind == _BYTES else ({_EIGHT: 8, _FOUR: 4}[kind], at)
        if at + size > len(body):
            raise ValueError("it ends inside a field")
        yield number, body[at : at + size]
        at += size


def _varint(body: bytes, at: int) -> tuple[int, int]:
    value = 0
    for shift in range(0, 70, 7):
        if at >= len(body):
            raise ValueError("it ends inside a number")
        value |= (body[at] & 0x7F) << shift
        at += 1
        if body[at - 1] < 0x80:
            return value, at
    raise ValueError("a number is too long")


def _numbers(kind: str, raw: Any) -> list[Any]:
    """Return the numbers of a field, packed or not."""
    if kind in _FIXED:
        return [item for (item,) in struct.iter_unpack(_FIXED[kind], raw)]
    numbers = [] if isinstance(raw, bytes) else [raw]
    at = 0
    while isinstance(raw, bytes) and at < len(raw):
        item, at = _varint(raw, at)
        numbers.append(item)
    if kind == "int64":
        return [item - (1 << 64) if item >> 63 else item for item in numbers]
    return [bool(item) for item in numbers] if kind == "bool" else numbers
