"""The four ROS messages of the demos, to and from bytes, and the fixed-size structs of the flight apps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from math import cos, sin
from typing import TYPE_CHECKING, Any, Final

from edoras_tools.cfs import command_ingest
from edoras_tools.errors import FieldError, WireError
from edoras_tools.links.bare import ROBOT_COMMAND, ROBOT_POSE
from edoras_tools.ros import TypeStore
from edoras_tools.units import SECOND
from edoras_tools.wire import cfe, envelope

if TYPE_CHECKING:
    from edoras_tools.cfs.profile import SimProfile

TWIST: Final = "geometry_msgs/msg/Twist"
POSE: Final = "geometry_msgs/msg/Pose"
POSE_STAMPED: Final = "geometry_msgs/msg/PoseStamped"
JOINT_STATE: Final = "sensor_msgs/msg/JointState"


@cache
def _types() -> TypeStore:
    return TypeStore()


def from_link(packet: bytes, profile: SimProfile) -> bytes:
    """Return a packet of a link in its form on the bus, where headers are always the standard ones."""
    return cfe.with_headers(packet, profile.headers, cfe.STANDARD)


_NUMBERS: Final = cfe.PAYLOADS | {command_ingest.HOUSEKEEPING_MSG_ID: cfe.COMMAND_INGEST_HOUSEKEEPING}
"""Payloads with numbers longer than a byte that a link shows; in other payloads such counters are 0."""


def to_link(packet: bytes, profile: SimProfile) -> bytes:
    """Return a packet of the bus in its form on a link."""
    layout = _NUMBERS.get(cfe.msg_id_of(packet)) if profile.big_endian else None
    if layout is not None:
        data, at = bytearray(packet), cfe.TELEMETRY_HEADER_BYTES
        for slot in layout.slots:
            if slot.field.kind == "uint":
                data[at + slot.start : at + slot.end] = data[at + slot.start : at + slot.end][::-1]
        packet = bytes(data)
    packet = cfe.with_headers(packet, cfe.STANDARD, profile.headers)
    return packet if profile.time == cfe.MissionTime() else _retimed(packet, profile)


def _retimed(packet: bytes, profile: SimProfile) -> bytes:
    """Return a packet of a link with its mission time in the profile's format; a command is unchanged."""
    headers, time = profile.headers, profile.time
    if headers.msg_ids.is_command(headers.msg_ids.of(packet)) or len(packet) < headers.telemetry_bytes:
        return packet
    words = headers.telemetry.parse(packet, headers.start)
    words["subseconds"] = words["subseconds"] * (time.ticks or cfe.USUAL_TICKS) // cfe.USUAL_TICKS
    layout = time.layout(headers.telemetry)
    return packet[: headers.start] + layout.emit(words) + packet[headers.telemetry_bytes :]


def bus_id(msg_id: int, profile: SimProfile) -> int:
    """Return the MsgId on the bus for a MsgId on a link, or in a payload."""
    return profile.headers.msg_ids.standard(msg_id)


def link_id(msg_id: int, profile: SimProfile) -> int:
    """Return the MsgId on a link, and in payloads and events, for a MsgId on the bus."""
    return profile.headers.msg_ids.of_known(msg_id)


def command_length(size: int, profile: SimProfile) -> int:
    """Return the size on a link, as in events, of a command with ``size`` bytes on the bus."""
    return size + profile.headers.command_bytes - cfe.COMMAND_HEADER_BYTES


class FixedStruct:
    """A C struct that messages are copied into: after a shorter message, bytes of a longer one remain.

    Args:
        size: size in bytes; 0: it grows to the longest message so far.
        form: format of the envelope.

    Attributes:
        data: bytes of the whole struct.
    """

    def __init__(self, size: int, form: envelope.EnvelopeFormat = envelope.DEFAULT) -> None:
        self._bytes, self._form, self._grows = bytearray(size), form, not size

    @property
    def data(self) -> bytes:
        """The whole struct, stale bytes included."""
        return bytes(self._bytes)

    def put(self, cdr: bytes) -> None:
        """Copy a message into the struct, envelope first.

        Raises:
            FieldError: it is too long; flight code would write past the end.
        """
        content = self._form.emit(cdr)
        if self._grows:
            self._bytes.extend(bytes(max(0, len(content) - len(self._bytes))))
        if len(content) > len(self._bytes):
            raise FieldError("edoras", "data", f"{len(content)} bytes exceed the struct's {len(self._bytes)}")
        self._bytes[: len(content)] = content


def encode(type_name: str, values: Mapping[str, Any], store: TypeStore | None = None) -> bytes:
    """Return the CDR of a message, encapsulation included.

    Args:
        store: types, if it is not a type of the demos.
    """
    return (store or _types()).encode(type_name, values)


def decode_envelope(
    type_name: str,
    data: bytes,
    form: envelope.EnvelopeFormat = envelope.DEFAULT,
    store: TypeStore | None = None,
) -> Mapping[str, Any] | None:
    """Return the values of a message in its envelope; None if they cannot be decoded."""
    try:
        length, _ = form.parse(data)
        return (store or _types()).decode(type_name, data[form.size : form.size + length])
    except WireError:
        return None


def std_header(now: int, frame_id: str) -> dict[str, Any]:
    """Return a std_msgs/Header for a time in ns."""
    seconds, nanoseconds = divmod(now, SECOND)
    # Only 31 bits of seconds: a simulated clock may have any time.
    return {"stamp": {"sec": seconds & 0x7FFFFFFF, "nanosec": nanoseconds}, "frame_id": frame_id}


def pose(x: float, y: float, z: float = 0.0, qz: float = 0.0, qw: float = 1.0) -> dict[str, Any]:
    """Return a geometry_msgs/Pose with a rotation about z."""
    return {"position": {"x": x, "y": y, "z": z}, "orientation": {"x": 0.0, "y": 0.0, "z": qz, "w": qw}}


def pose_stamped(now: int, frame_id: str, x: float, y: float, heading: float) -> bytes:
    """Return the CDR of a PoseStamped in the plane."""
    turned = pose(x, y, 0.0, sin(heading / 2), cos(heading / 2))
    return encode(POSE_STAMPED, {"header": std_header(now, frame_id), "pose": turned})


def twist(linear: float, angular: float) -> bytes:
    """Return the CDR of a Twist in the plane."""
    flat = {"x": 0.0, "y": 0.0, "z": 0.0}
    return encode(TWIST, {"linear": flat | {"x": linear}, "angular": flat | {"z": angular}})


def joint_state(now: int, names: Sequence[str], positions: Sequence[float]) -> bytes:
    """Return the CDR of a JointState without velocities and efforts."""
    values = {
        "header": std_header(now, ""),
        "name": list(names),
        "position": list(positions),
        "velocity": [],
        "effort": [],
    }
    return encode(JOINT_STATE, values)


def robot_datagram(values: Mapping[str, Any]) -> bytes | None:
    """Return a Twist or a Pose as the public flight applications send it to their robot; else None."""
    for layout, names in ((ROBOT_COMMAND, ("linear", "angular")), (ROBOT_POSE, ("position", "orientation"))):
        if names[0] in values:
            return layout.emit(
                {f"{name}_{axis}": number for name in names for axis, number in values[name].items()}
            )
    return None


def whole_packet(packet: bytes) -> bytes:
    """Return the bytes that the length field states, padded with zeros if the buffer is shorter."""
    size = cfe.length_of(packet)
    return packet if len(packet) == size else packet[:size].ljust(size, b"\0")
