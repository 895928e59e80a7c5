"""The knowledge about the place of a capture: the mission, and the peers and endpoints in its datagrams."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, Protocol

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from collections.abc import Set as AbstractSet

    from numpy.typing import NDArray

    from edoras_tools.wire.arrays.order import Integers, Mask

MOST_ENDPOINTS: Final = 1 << 14
"""Most endpoints that are kept; others stay unknown."""
_MOST_HEARD: Final = 1 << 14


class Announced(Protocol):
    """The announcement of an endpoint."""

    @property
    def guid(self) -> bytes:
        """Its globally unique identifier."""

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
    """The identity of each endpoint: the first one that it sends.

    SBN distinguishes peers by identity, never by address. It reports a second identity from one endpoint as
    an unknown peer.
    """

    def __init__(self) -> None:
        self._first: dict[tuple[str, int], tuple[tuple[int, int], int]] = {}

    def introduce(self, endpoint: tuple[str, int], identity: tuple[int, int], number: int) -> tuple[int, int]:
        """Return the identity of an endpoint, which is this one if it has none yet.

        Args:
            endpoint: address as text, and port.
            identity: SpacecraftID and ProcessorID.
            number: number of the datagram that contains it.
        """
        return self._first.setdefault(endpoint, (identity, number))[0]

    def identity(self, endpoint: tuple[str, int], number: int) -> tuple[int, int] | None:
        """Return the identity that an endpoint had when a datagram came, or None.

        Messages of one TCP segment have one number: ask for the number before it, so that messages beside the
        first identity are not judged by it, whichever comes first.
        """
        identity, since = self._first.get(endpoint, ((0, 0), number + 1))
        return identity if since <= number else None


class Endpoints:
    """Writers, readers and participants, as they announce themselves.

    The first announcement of each counts, from its datagram on.

    Attributes:
        announced: announcement of each endpoint and the number of its datagram, by GUID.
    """

    def __init__(self) -> None:
        self.announced: dict[bytes, tuple[Announced, int]] = {}
        self._heard: set[bytes] = set()

    def is_new(self, payload: bytes) -> bool:
        """Return whether an announcement is new: announcements are repeated."""
        if payload in self._heard:
            return False
        if len(self._heard) >= _MOST_HEARD:
            self._heard.clear()
        self._heard.add(payload)
        return True

    def learn(self, announcement: Announced, number: int) -> None:
        """Add an announcement in a datagram."""
        entry = self.announced.get(announcement.guid)
        if entry is None and len(self.announced) < MOST_ENDPOINTS:
            self.announced[announcement.guid] = announcement, number
        elif entry is not None and number < entry[1]:
            self.announced[announcement.guid] = entry[0], number

    def topics(self) -> dict[str, str]:
        """Return the type of each announced topic, by ROS names."""
        return {item.ros_topic: item.ros_type for item, _ in self.announced.values() if item.topic}

    def find(self, guid: bytes, number: int | None = None) -> Announced | None:
        """Return the announcement of an endpoint before a datagram, or at any time; None: there is none."""
        entry = self.announced.get(guid)
        return entry[0] if entry and (number is None or entry[1] <= number) else None

    def since(self, guids: Sequence[bytes]) -> Integers:
        """Return the number of the first datagram from which the topic of each endpoint is known, i64.

        It is the largest i64 for an endpoint that is never known.
        """
        never = np.iinfo(np.int64).max
        entries = [self.announced.get(guid) for guid in guids]
        return np.array([item[1] if item and item[0].topic else never for item in entries], np.int64)


class Site(Protocol):
    """The knowledge about the place of a capture, from the mission and from its datagrams so far."""

    @property
    def bridge_ports(self) -> Mask:
        """Ports where flight bridges listen, bool (65536,)."""

    @property
    def identities(self) -> AbstractSet[tuple[int, int]]:
        """Pairs (SpacecraftID, ProcessorID) in the mission."""

    @property
    def peers(self) -> Peers:
        """Identities by endpoint; they grow as datagrams are read, in order."""

    @property
    def endpoints(self) -> Endpoints:
        """Writers and readers that announced themselves; they grow as datagrams are read, in order."""

    @property
    def types(self) -> Any:
        """The ROS types, a ``ros.TypeStore``; None if none are known."""

    @property
    def frames(self) -> Mapping[int, Any]:
        """Format of the frames that carry packets to a port, by port; see ``mission.FramedPort.format``."""

    @property
    def pdu_msg_ids(self) -> NDArray[np.int32]:
        """MsgIds of packets that each hold a unit of a link which is ``in_packets``, i32."""
