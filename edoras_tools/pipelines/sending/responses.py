"""What is received while sending: events, counters, and how much telemetry of each kind."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from edoras_tools.cfs import command_ingest
from edoras_tools.cfs.names import message_name
from edoras_tools.errors import TruncatedError
from edoras_tools.pipelines.sending.expect import AwaitedResults
from edoras_tools.pipelines.sending.ingest import IngestCount
from edoras_tools.wire import cfe, sbn

if TYPE_CHECKING:
    from edoras_tools.mission import Mission
    from edoras_tools.model import Link

LOSSES: Final = ("pipe_overflow_error_counter", "message_limit_error_counter")
"""The two counters of the software bus that count lost messages; always reported."""
_EVENT_TYPES: Final = {1: "debug", 2: "information", 3: "error", 4: "critical"}
_MOST_EVENTS: Final = 10_000
_MODULUS: Final = 1 << 16
_INGEST: Final = {
    cfe.TELEMETRY_HEADER_BYTES + layout.size: layout
    for layout in (cfe.COMMAND_INGEST_HOUSEKEEPING, cfe.COMMAND_INGEST_HOUSEKEEPING_7)
}
"""CI's housekeeping by the bytes of its packet."""
"""A packet of another length is not CI's: this build gives its MsgId to another application."""


@dataclass(slots=True)
class ReceivedEvent:
    """One event, with the number of times that it came."""

    app: str
    event_id: int
    event_type: int
    message: str
    first_ns: int
    count: int = 0


class Responses:
    """Counts what is received.

    Args:
        mission: provides the topics of MsgIds.
        expected: what has to come; it is told of every packet.

    Attributes:
        events: by text, in order of their first occurrence.
        counters: of the software bus, the first and the last received.
        counts: packets by link and MsgId.
        network: SBN messages by type, other than application messages.
        ingest: what CI's own count shows of what was sent to it.
        expected: as given.
    """

    def __init__(self, mission: Mission, expected: AwaitedResults | None = None) -> None:
        self.events: dict[str, ReceivedEvent] = {}
        self.counters: tuple[dict[str, int], dict[str, int]] | None = None
        self.counts: dict[tuple[Link, int], int] = {}
        self.network: dict[str, int] = {}
        self.ingest = IngestCount()
        self.expected = expected or AwaitedResults()
        self._mission = mission

    def add(self, link: Link, data: bytes, now: int) -> None:
        """Count a datagram; any bytes are accepted.

        Args:
            link: the link that it came from.
            data: its payload.
            now: ns since 1970.
        """
        if link.peers:
            if len(data) < sbn.HEADER.size:
                return
            kind = data[2]
            if kind != sbn.MsgType.APP:
                name = sbn.MSG_TYPE_NAMES.get(kind, f"0x{kind:02x}")
                self.network[name] = self.network.get(name, 0) + 1
                return
            data = data[sbn.HEADER.size :]
        if len(data) < 2:
            return
        msg_id = self._mission.msg_ids.of(data)
        self.counts[link, msg_id] = self.counts.get((link, msg_id), 0) + 1
        self.expected.take(data)
        try:
            known = self._mission.msg_ids.known(msg_id)
            if known == cfe.EVENT_MSG_ID:
                self._event(data, now)
            elif known == cfe.SOFTWARE_BUS_HOUSEKEEPING_MSG_ID:
                self._bus(data)
            elif known == command_ingest.HOUSEKEEPING_MSG_ID and len(data) in _INGEST:
                values = _INGEST[len(data)].parse(data, cfe.TELEMETRY_HEADER_BYTES)
                self.ingest.reported(values["ingest_packets"] + values["ingest_errors"])
        except TruncatedError:
            pass  # it is counted, and nothing more can be read from it

    def _event(self, data: bytes, now: int) -> None:
        values = cfe.EVENT.parse(data, cfe.TELEMETRY_HEADER_BYTES)
        text = f"{values['app_name']} {values['event_id']}: {values['message'].strip()}"
        if text not in self.events and len(self.events) < _MOST_EVENTS:
            self.events[text] = ReceivedEvent(
                values["app_name"], values["event_id"], values["event_type"], values["message"].strip(), now
            )
        if text in self.events:
            self.events[text].count += 1

    def _bus(self, data: bytes) -> None:
        values = cfe.SOFTWARE_BUS_HOUSEKEEPING.parse(data, cfe.TELEMETRY_HEADER_BYTES)
        heard = {name: value for name, value in values.items() if name.endswith("_counter")}
        self.counters = (self.counters[0] if self.counters else heard, heard)

    def says(self, text: str) -> bool:
        """Return whether an event contains a text."""
        return any(text in event for event in self.events)

    @property
    def telemetry(self) -> int:
        """Packets that Telemetry Output sent."""
        return sum(count for (link, _), count in self.counts.items() if link.only_from_cfs)

    @property
    def counted(self) -> bool:
        """Whether the software bus told its counters."""
        return self.counters is not None

    @property
    def lost(self) -> int:
        """Messages that the software bus lost while sending, by its own counters."""
        return sum(row["gained"] for name, row in self._counters().items() if name in LOSSES)

    def summary(self) -> dict[str, Any]:
        """Return ``seen`` of ``replay --json``."""
        routes = {(route.link, route.msg_id): route.topic for route in self._mission.routes}
        return {
            "events": [
                {
                    "time_ns": event.first_ns,
                    "app": event.app,
                    "event_id": event.event_id,
                    "event_type": _EVENT_TYPES.get(event.event_type, str(event.event_type)),
                    "message": event.message,
                    "count": event.count,
                }
                for event in self.events.values()
            ],
            "counters": self._counters(),
            "telemetry": [
                {
                    "link": link.label,
                    "msg_id": f"0x{msg_id:04x}",
                    "topic": routes.get((link, msg_id)),
                    "name": message_name(self._mission.msg_ids.known(msg_id)) or None,
                    "count": count,
                }
                for (link, msg_id), count in sorted(self.counts.items())
            ],
            "sbn": dict(sorted(self.network.items())),
        }

    def _counters(self) -> dict[str, dict[str, int]]:
        if self.counters is None:
            return {}
        first, last = self.counters
        return {
            name: {
                "first": first[name],
                "last": value,
                # A counter with a lower value was reset, or has wrapped around.
                "gained": value - first[name] if value >= first[name] else (value - first[name]) % _MODULUS,
            }
            for name, value in last.items()
            if name in LOSSES or value != first[name]
        }
