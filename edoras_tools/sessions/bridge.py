"""A bridge between a ROS 2 graph and one cFS: messages, datagrams and times in, datagrams and messages out.

What is to be sent gathers in ``outbox``, in order; who owns the socket empties it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final, Protocol

from edoras_tools.sessions.bridge_limit import Limit, Limiter
from edoras_tools.sessions.bridge_packets import Envelope, PacketWriter, find_packet
from edoras_tools.wire import limits, sbn
from edoras_tools.wire.cdr import ENCAPSULATION
from edoras_tools.wire.envelope import EnvelopeFormat

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from edoras_tools.mission import Route

CI_LARGEST: Final = limits.CI_BUFFER
"""Command Ingest cuts a longer packet."""
_REASONS: Final = 16
SBN_LARGEST: Final = sbn.LARGEST_PAYLOAD


class LinkSession(Protocol):
    """What a bridge says to cFS beside its messages; time is an argument, in ns."""

    ready: bool
    """Whether messages may be sent."""
    notes: list[str]
    """What people should know; who reads it empties it."""
    refused: dict[str, int]
    """Datagrams that were not taken, by reason."""

    @property
    def next_ns(self) -> int | None:
        """When ``service`` is due; None when never."""
        ...

    def receive_datagram(self, data: bytes, *, now: int) -> tuple[int, list[bytes]]:
        """Take a datagram; return where its space packet starts, -1 for none, and what to answer."""
        ...

    def service(self, *, now: int) -> list[bytes]:
        """Return what is due."""
        ...

    def frame(self, packet: bytes) -> bytes:
        """Return the datagram that carries a packet."""
        ...

    def sent(self, *, now: int) -> None:
        """Take note that messages were sent."""
        ...

    def goodbye(self) -> list[bytes]:
        """Return what to send at the end."""
        ...

    def summary(self) -> dict[str, Any]:
        """Return its part of ``bridge --json``."""
        ...


@dataclass(frozen=True, slots=True)
class Habits:
    """How a bridge writes and reads packets.

    Attributes:
        telemetry_header: bytes of cFE's telemetry header.
        envelope: format where a route names none; ``auto`` tells it from the bytes.
        max_size: bytes of a packet that cFS takes.
        max_rate_total: messages a second to cFS at the most; None for any number.
    """

    telemetry_header: int = 16
    envelope: str = "8/8 le"
    max_size: int = SBN_LARGEST
    max_rate_total: float | None = None


@dataclass(slots=True)
class Traffic:
    """What became of the messages of one route.

    Attributes:
        taken: messages that came in.
        given: messages that went out.
        refused: messages that could not go out, by reason.
    """

    taken: int = 0
    given: int = 0
    refused: dict[str, int] = field(default_factory=dict)

    def refuse(self, reason: str) -> None:
        """Count one that goes no further; reasons that hold a message's own bytes are endless."""
        if reason not in self.refused and len(self.refused) >= _REASONS:
            reason = "other reasons"
        self.refused[reason] = self.refused.get(reason, 0) + 1


class Bridge:
    """The routes of one bridge, and its session with cFS.

    Args:
        routes: what crosses; commands go to cFS, telemetry comes from there.
        link: the session.
        writer: of packets; the session has the same.
        habits: of writing and reading.
        sizes: bytes of every message of a type, for the types that have a fixed one.

    Attributes:
        routes: as given; messages go by their places.
        link: as given.
        traffic: counts, one a route.
        limiter: what holds messages back, a lane a route.
        outbox: datagrams to send, in order.
        others: packets from cFS that no route claims.
        unreadable: datagrams from cFS without a whole packet.
    """

    def __init__(
        self,
        routes: Sequence[Route],
        link: LinkSession,
        writer: PacketWriter,
        habits: Habits | None = None,
        sizes: Mapping[str, int | None] | None = None,
    ) -> None:
        habits, sizes = habits or Habits(), sizes or {}
        self.routes, self.link = tuple(routes), link
        self.traffic = [Traffic() for _ in routes]
        self.outbox: list[bytes] = []
        self.others = self.unreadable = 0
        handlings = [route.handling for route in routes]
        # What comes from cFS does not burden it: the total is not asked.
        chosen = [Limit(item.max_rate, item.keep or "latest") for item in handlings]
        self.limiter: Limiter[bytes] = Limiter(
            chosen, habits.max_rate_total, [route.to_cfs for route in routes]
        )
        self._writer, self._telemetry_header = writer, habits.telemetry_header
        self._envelopes = [
            Envelope(_format(route.envelope or habits.envelope), sizes.get(route.type), route.type)
            for route in routes
        ]
        self._rooms = [
            min(envelope.most, habits.max_size - writer.overhead(route.msg_id) - envelope.size)
            for route, envelope in zip(routes, self._envelopes, strict=True)
        ]
        self._from_cfs = {route.msg_id: index for index, route in enumerate(routes) if not route.to_cfs}

    @property
    def next_ns(self) -> int | None:
        """When ``service`` is due; None when never."""
        first, second = self.link.next_ns, self.limiter.next_ns
        if first is None or second is None:
            return first if second is None else second
        return min(first, second)

    def hear(self, index: int, cdr: bytes, *, now: int) -> bool:
        """Take a message of the graph for cFS; tell whether it went into the outbox at once."""
        traffic = self.traffic[index]
        traffic.taken += 1
        if not self.link.ready:
            traffic.refuse("cFS is not connected")
        elif len(cdr) < ENCAPSULATION.size:
            traffic.refuse("no CDR")
        elif len(cdr) > self._rooms[index]:
            traffic.refuse(f"longer than the {self._rooms[index]} bytes of CDR that fit a packet")
        elif self.limiter.offer(index, cdr, now=now):
            self._emit(index, cdr, now)
            return True
        return False

    def receive_datagram(self, data: bytes, *, now: int) -> tuple[int, bytes] | None:
        """Take a datagram of cFS, any bytes; return a route's place and the message to publish, or None."""
        at, answers = self.link.receive_datagram(data, now=now)
        if answers:
            self.outbox += answers
        if at < 0:
            return None
        place = find_packet(data, at, self._telemetry_header)
        if place is None:
            self.unreadable += 1
            return None
        index = self._from_cfs.get(place.msg_id)
        if index is None:
            self.others += 1
            return None
        traffic = self.traffic[index]
        traffic.taken += 1
        cdr = self._envelopes[index].open(data, place.body, place.end)
        if isinstance(cdr, str):
            traffic.refuse(cdr)
        elif self.limiter.offer(index, cdr, now=now):
            traffic.given += 1
            return index, cdr
        return None

    def service(self, *, now: int) -> list[tuple[int, bytes]]:
        """Do what is due: the session, and what was held back; return what of it is to be published."""
        due = self.link.next_ns
        if due is not None and due <= now:
            self.outbox += self.link.service(now=now)
        publish = []
        for index, cdr in self.limiter.due(now=now):
            if not self.routes[index].to_cfs:
                self.traffic[index].given += 1
                publish.append((index, cdr))
            elif self.link.ready:
                self._emit(index, cdr, now)
            else:
                self.traffic[index].refuse("cFS is not connected")
        return publish

    def unpublished(self, index: int, reason: str) -> None:
        """Take note that a message could not be published after all."""
        self.traffic[index].given -= 1
        self.traffic[index].refuse(reason)

    def goodbye(self) -> None:
        """Put what ends the session into the outbox."""
        self.outbox += self.link.goodbye()

    def summary(self) -> dict[str, Any]:
        """Return its part of ``bridge --json``."""
        return {
            **self.link.summary(),
            "refused": dict(self.link.refused),
            "others": self.others,
            "unreadable": self.unreadable,
            "routes": [
                {
                    **describe(route),
                    "in": traffic.taken,
                    "out": traffic.given,
                    "held": self.limiter.held[index],
                    "waiting": int(self.limiter.waits(index)),
                    "refused": dict(traffic.refused),
                }
                for index, (route, traffic) in enumerate(zip(self.routes, self.traffic, strict=True))
            ],
        }

    def _emit(self, index: int, cdr: bytes, now: int) -> None:
        packet = self._writer.write(self.routes[index].msg_id, self._envelopes[index].wrap(cdr))
        self.outbox.append(self.link.frame(packet))
        self.link.sent(now=now)
        self.traffic[index].given += 1


def describe(route: Route) -> dict[str, Any]:
    """Return what ``bridge --json`` says of a route before anything crosses."""
    return {
        "topic": route.topic,
        "type": route.type,
        "msg_id": f"0x{route.msg_id:04x}",
        "direction": "to_cfs" if route.to_cfs else "from_cfs",
        "max_rate": route.handling.max_rate,
    }


def _format(name: str) -> EnvelopeFormat | None:
    return None if name == "auto" else EnvelopeFormat.named(name)
