"""``/edoras/host``: what the kernel of the recording host counted, once a second."""

from __future__ import annotations

from dataclasses import asdict, fields
from typing import TYPE_CHECKING, Final

from edoras_tools.io.topics.rows import bodies_of
from edoras_tools.model import HostCounters, SocketCounters
from edoras_tools.units import SECOND

if TYPE_CHECKING:
    from edoras_tools.io.topics.rows import Messages
    from edoras_tools.ros import TypeStore

HOST_TOPIC: Final = "/edoras/host"
HOST_TYPE: Final = "edoras_msgs/msg/HostStatistics"
_COUNTERS: Final = tuple(
    item.name for item in fields(HostCounters) if item.name not in {"time_ns", "sockets"}
)
_UNKNOWN: Final = -1


def host_messages(host: HostCounters, channel_id: int, types: TypeStore) -> Messages:
    """Return the message of one reading, in row 0."""
    seconds, rest = divmod(host.time_ns, SECOND)
    counted = {name: getattr(host, name) for name in _COUNTERS}
    values = {
        "stamp": {"sec": seconds, "nanosec": rest},
        "sockets": [asdict(item) for item in host.sockets],
        **{name: _UNKNOWN if value is None else value for name, value in counted.items()},
    }
    return bodies_of([types.encode(HOST_TYPE, values)[4:]], [host.time_ns], channel_id)


def host_counters_of(cdr: bytes, types: TypeStore) -> HostCounters:
    """Return the reading in a message.

    Raises:
        WireError: the message is not one of these.
    """
    values = types.decode(HOST_TYPE, cdr)
    counted = {name: values[name] if values[name] != _UNKNOWN else None for name in _COUNTERS}
    sockets = tuple(SocketCounters(**item) for item in values["sockets"])
    return HostCounters(values["stamp"]["sec"] * SECOND + values["stamp"]["nanosec"], sockets, **counted)
