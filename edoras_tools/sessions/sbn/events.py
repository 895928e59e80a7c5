"""The states of an SBN connection, and its events, which its owner gets in order.

The diagram in ``docs/bridge.md`` is written from the table of transitions.
"""

from __future__ import annotations

from collections.abc import Sequence  # noqa: TC003  annotations of named tuples are read at run time
from enum import Enum
from typing import TYPE_CHECKING, Final, NamedTuple

from edoras_tools.model import Peer  # noqa: TC001  the same
from edoras_tools.wire import sbn

if TYPE_CHECKING:
    from collections.abc import Mapping


class ConnectionState(Enum):
    """Whether messages can be sent and received."""

    DISCONNECTED = "disconnected"
    CONNECTED = "connected"


class Trigger(Enum):
    """A cause of a change of state; the value is the text for people."""

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
"""Next state by state and trigger; any other pair changes nothing."""


class Refusal(Enum):
    """The reason why a datagram was refused; the value is the text for people."""

    SHORT = "shorter than an SBN header"
    OLD_HEADER = "SBN header of 7 bytes"
    NEGATIVE_SIZE = "SBN size below 0"
    OTHER_PEER = "another peer"
    CUT_SUBSCRIPTIONS = "subscriptions cut short"
    LENGTH = "length modulo 256 below an SBN header's"


class Connected(NamedTuple):
    """A connection was made."""

    peer: Peer


class Disconnected(NamedTuple):
    """The connection was lost; ``reason`` is ``DISCONNECT`` or ``TIMEOUT``."""

    reason: Trigger


class Version(NamedTuple):
    """A PROTO came; None where it names no version."""

    version: int | None


class Subscriptions(NamedTuple):
    """A SUB or an UNSUB came."""

    msg_type: int
    ident: str
    msg_ids: tuple[int, ...]


class AppMessage(NamedTuple):
    """An APP message came, in its whole datagram."""

    datagram: bytes

    @property
    def packet(self) -> bytes:
        """The space packet."""
        return self.datagram[sbn.HEADER.size :]


class UnknownType(NamedTuple):
    """A message of a type that SBN does not have came."""

    msg_type: int


class NotTaken(NamedTuple):
    """A datagram was refused; ``sender`` if it can be read."""

    reason: Refusal
    sender: Peer | None = None


ConnectionEvent = Connected | Disconnected | Version | Subscriptions | AppMessage | UnknownType | NotTaken


class Step(NamedTuple):
    """The result of one call.

    Attributes:
        events: events, in order.
        datagrams: datagrams to send to the peer, in order.
    """

    events: Sequence[ConnectionEvent] = ()
    datagrams: Sequence[bytes] = ()
