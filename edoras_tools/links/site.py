"""What is known of the place of a capture: what the mission says, and who announced or named itself."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, Protocol

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from collections.abc import Set as AbstractSet

    from numpy.typing import NDArray

    from edoras_tools.wire.arrays.order import Integers, Mask

MOST_ENDPOINTS: Final = 1 << 14
"""Endpoints that are kept; those beyond stay unknown."""
_MOST_HEARD: Final = 1 << 14


class Announced(Protocol):
    """What an endpoint announced of itself."""

    @property
    def guid(self) -> bytes:
        """What tells it from all others."""

    @property
    def topic(self) -> str:
        """The topic's name on the wire; empty for a participant."""

    @property
    def ros_topic(self) -> str:
        """The topic's ROS name."""

    @property
    def ros_type(self) -> str:
        """The topic's ROS type."""


class Peers:
    """The identity of each endpoint: the first one that it sends is taken as its own.

    SBN tells peers apart by identity, never by address. It reports a second identity from one endpoint as an
    unknown peer.
    """

    def __init__(self) -> None:
        self._first: dict[tuple[str, int], tuple[tuple[int, int], int]] = {}

    def introduce(self, endpoint: tuple[str, int], identity: tuple[int, int], number: int) -> tuple[int, int]:
        """Return the identity an endpoint is known by, which is this one if it has none yet.

        Args:
            endpoint: address as text and port.
            identity: SpacecraftID and ProcessorID.
            number: of the datagram that gives it.
        """
        return self._first.setdefault(endpoint, (identity, number))[0]

    def identity(self, endpoint: tuple[str, int], number: int) -> tuple[int, int] | None:
        """Return the identity an endpoint was known by when a datagram came, or None.

        Messages of one TCP segment have one number: ask for the number before it, so that what is beside the
        first identity is not judged by it, whichever comes first.
        """
        identity, since = self._first.get(endpoint, ((0, 0), number + 1))
        return identity if since <= number else None


class Endpoints:
    """Writers, readers and participants, as they announce themselves.

    The first announcement of each counts, from the datagram on that has it.

    Attributes:
        announced: by GUID what was announced, and the number of the datagram.
    """

    def __init__(self) -> None:
        self.announced: dict[bytes, tuple[Announced, int]] = {}
        self._heard: set[bytes] = set()

    def is_new(self, payload: bytes) -> bool:
        """Tell whether an announcement was not heard before: they come again and again."""
        if payload in self._heard:
            return False
        if len(self._heard) >= _MOST_HEARD:
            self._heard.clear()
        self._heard.add(payload)
        return True

    def learn(self, announcement: Announced, number: int) -> None:
        """Take an announcement of a datagram."""
        entry = self.announced.get(announcement.guid)
        if entry is None and len(self.announced) < MOST_ENDPOINTS:
            self.announced[announcement.guid] = announcement, number
        elif entry is not None and number < entry[1]:
            self.announced[announcement.guid] = entry[0], number

    def topics(self) -> dict[str, str]:
        """Return the ROS names of all topics that were announced, each with its type."""
        return {item.ros_topic: item.ros_type for item, _ in self.announced.values() if item.topic}

    def find(self, guid: bytes, number: int | None = None) -> Announced | None:
        """Return what an endpoint announced before a datagram came, or at any time; None: nothing."""
        entry = self.announced.get(guid)
        return entry[0] if entry and (number is None or entry[1] <= number) else None

    def since(self, guids: Sequence[bytes]) -> Integers:
        """Return from which datagram on the topic of each endpoint is known, i64; the largest where never."""
        never = np.iinfo(np.int64).max
        entries = [self.announced.get(guid) for guid in guids]
        return np.array([item[1] if item and item[0].topic else never for item in entries], np.int64)


class Site(Protocol):
    """What the mission says of the place of a capture, and what was learnt from its datagrams so far."""

    @property
    def bridge_ports(self) -> Mask:
        """(65536,), ports where flight bridges listen."""

    @property
    def identities(self) -> AbstractSet[tuple[int, int]]:
        """(SpacecraftID, ProcessorID) that missions name."""

    @property
    def peers(self) -> Peers:
        """Identities by endpoint; grows as datagrams are read, in order."""

    @property
    def endpoints(self) -> Endpoints:
        """Writers and readers that announced themselves; grows as datagrams are read, in order."""

    @property
    def types(self) -> Any:
        """The ROS types, a ``ros.TypeStore``; None where none are known."""

    @property
    def frames(self) -> Mapping[int, Any]:
        """How packets are framed that come to a port, by port, as ``mission.FramedPort.format`` says it."""

    @property
    def pdu_msg_ids(self) -> NDArray[np.int32]:
        """MsgIds of packets that hold a unit of a link which is ``in_packets`` each, i32."""
