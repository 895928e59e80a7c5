"""The states of an SBN connection. The diagram in ``docs/bridge.md`` is written from this table."""

from __future__ import annotations

from enum import Enum
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Mapping


class ConnectionState(Enum):
    """Whether messages cross."""

    DISCONNECTED = "disconnected"
    CONNECTED = "connected"


class Trigger(Enum):
    """What changes the state; the value is the text for people."""

    HEARD = "any datagram of the peer but DISCONNECT"
    DISCONNECT = "DISCONNECT"
    TIMEOUT = "nothing from the peer for 11 s"
    RESTART = "PROTO again, 1 s or more after the last SUB"


TRANSITIONS: Final[Mapping[tuple[ConnectionState, Trigger], ConnectionState]] = {
    (ConnectionState.DISCONNECTED, Trigger.HEARD): ConnectionState.CONNECTED,
    (ConnectionState.CONNECTED, Trigger.DISCONNECT): ConnectionState.DISCONNECTED,
    (ConnectionState.CONNECTED, Trigger.TIMEOUT): ConnectionState.DISCONNECTED,
    (ConnectionState.CONNECTED, Trigger.RESTART): ConnectionState.CONNECTED,
}
"""State and trigger to the next state. What is not listed changes nothing."""
