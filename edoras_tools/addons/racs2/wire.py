"""RACS2: messages between ROS 2 and cFS as JAXA's public bridge sends them in WebSocket frames.

Taken from its sources (racs2_bridge 1.1, https://github.com/jaxa/racs2_bridge): a header of 32 bytes, then
the body. To ROS 2 the header is a topic's name; to cFS it starts with a MsgId. **The only length on the
wire** is that of the frame, and the cFS side always sends 128 bytes of body, with zeros behind the content.
The body can be anything; the public examples put a Protocol Buffers message of ``std_msgs`` there.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Any, Final

from edoras_tools.wire.layout import Field, Layout

if TYPE_CHECKING:
    from collections.abc import Iterator

BRIDGE_WEBSOCKET_PORT: Final = 8765
SUBPROTOCOL: Final = "example-protocol"
"""The subprotocol that the cFS side requests in the handshake; the public ROS side answers without one."""
BRIDGE_HEADER: Final = 32
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
_NAMES: Final = {
    1: "bool_data",
    2: "float_data",
    3: "double_data",
    4: "int32_data",
    5: "int64_data",
    6: "string_data",
    7: "uint32_data",
    8: "uint64_data",
    9: "float32_array_data",
    10: "float64_array_data",
    11: "int32_array_data",
    12: "int64_array_data",
    13: "uint32_array_data",
    14: "uint64_array_data",
}
"""The fields of ``RACS2Bridge_std_msgs.proto``, by number."""
_SIGNED: Final = (4, 5, 11, 12)
_FIXED: Final = {2: "<f", 3: "<d", 9: "<f", 10: "<d"}
_TEXT: Final = 6
BODY_KINDS: Final = {
    name: (
        number,
        {1: "bool", 2: "float", 3: "double", 6: "string", 9: "float", 10: "double"}.get(
            number, "int64" if number in _SIGNED else "uint64"
        ),
        number >= 9,
    )
    for number, name in _NAMES.items()
}
"""Number of each field, the kind of its values, and whether it is an array."""
_FIRST_ARRAY: Final = 9
_VARINT, _EIGHT, _BYTES, _FOUR = 0, 1, 2, 5


def std_msgs_values(body: bytes) -> dict[str, Any] | None:
    """Return the values of a body that is a ``RACS2Bridge_std_msgs``; None if it is something else.

    Zeros at its end are padding. Field names are those of the public ``.proto`` file.
    """
    values: dict[str, Any] = {}
    try:
        for number, value in _fields(body):
            if number >= _FIRST_ARRAY:
                values.setdefault(_NAMES[number], []).extend(_numbers(number, value))
            elif number == _TEXT:
                values[_NAMES[number]] = value.decode()
            else:
                (values[_NAMES[number]],) = _numbers(number, value)
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


def _numbers(number: int, value: Any) -> list[Any]:
    """Return the numbers of a field, packed or not."""
    if number in _FIXED:
        return [item for (item,) in struct.iter_unpack(_FIXED[number], value)]
    if isinstance(value, bytes):
        numbers, at = [], 0
        while at < len(value):
            item, at = _varint(value, at)
            numbers.append(item)
    else:
        numbers = [value]
    if number in _SIGNED:
        numbers = [item - (1 << 64) if item >> 63 else item for item in numbers]
    return [bool(item) for item in numbers] if _NAMES[number] == "bool_data" else numbers
