"""Counts the packets received during sending: events, counters, and telemetry of each kind.

A result may be expected after sending: an event, a packet, or a counter that grows.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Final

import msgspec

from edoras_tools.cfs import command_ingest
from edoras_tools.cfs.names import message_name
from edoras_tools.errors import ConfigError, TruncatedError
from edoras_tools.pipelines.selection import find_packets
from edoras_tools.structs.table import Structs
from edoras_tools.wire import cfe, sbn
from edoras_tools.words import did_you_mean

if TYPE_CHECKING:
    from edoras_tools.decode import Context
    from edoras_tools.mission import Mission
    from edoras_tools.model import Link

_STANDS_STILL: Final = 2
"""Reports equal to the one before them that make a count final."""


class IngestCount(msgspec.Struct):
    """Compares CI's count with the number of datagrams sent to it.

    Attributes:
        sent: datagrams sent to CI so far; updated by the sender.
        reports: number of CI's reports.
        is_known: whether the count before the first datagram is known exactly.
    """

    sent: int = 0
    reports: int = 0
    _base: tuple[int, int] | None = None
    is_known: bool = False
    _started: bool = False
    _last: tuple[int, int] | None = None
    _repeated: int = 0
    _restarted: bool = False

    def reported(self, count: int) -> None:
        """Process a report of CI.

        Args:
            count: datagrams that CI has read since it started.
        """
        now = count, self.sent
        self.reports += 1
        if self._last is not None and count < self._last[0]:
            self._restarted = self._started
            self._base = self._last = None
        self._repeated = self._repeated + 1 if now == self._last else 0
        self._last = now
        if not self._started or self._base is None:
            self._base = now
            self.is_known = not self._restarted and (
                not self.sent or (not self._started and self._repeated > 0)
            )

    def begin(self) -> None:
        """Record that the datagrams to be counted are sent from now on."""
        self._started = True

    @property
    def is_final(self) -> bool:
        """Whether the count has stopped growing, or shows that CI has read everything."""
        return self._repeated >= _STANDS_STILL or (self.is_counted and self.read >= self.expected)

    @property
    def expected(self) -> int:
        """Datagrams sent since the base."""
        return self.sent - (self._base[1] if self._base and self.is_known else 0)

    @property
    def read(self) -> int:
        """Datagrams that CI has certainly read since the base, including those of other senders."""
        return self._last[0] - self._base[0] if self._last and self._base else 0

    @property
    def missing(self) -> int:
        """Datagrams that certainly never reached CI."""
        return max(0, self.expected - self.read) if self.is_known and self.is_final else 0

    @property
    def is_counted(self) -> bool:
        """Whether CI has reported since the first datagram was sent."""
        return self._started and self._last is not None and self._last[1] > 0

    def summary(self) -> dict[str, Any]:
        """Return ``ingest`` of ``replay --json``."""
        if self._restarted:
            state = "restarted"
        elif not self.is_counted:
            state = "unknown"
        elif self.read > self.expected:
            state = "others"
        elif self.read == self.expected:
            state = "all"
        elif not self.is_known:
            state = "partly" if self.read else "unknown"
        else:
            state = "missing" if self.is_final else "waiting"
        decided = state in {"all", "missing", "waiting", "partly"}
        return {
            "state": state,
            "sent": self.expected,
            "read": self.read if decided else None,
            "missing": self.missing if state in {"all", "missing"} else None,
        }


LOSSES: Final = ("pipe_overflow_error_counter", "message_limit_error_counter")
"""The two counters of the software bus that count lost messages; always reported."""
_EVENT_TYPES: Final = {1: "debug", 2: "information", 3: "error", 4: "critical"}
_MOST_EVENTS: Final = 10_000
_MODULUS: Final = 1 << 16
_INGEST: Final = {
    cfe.TELEMETRY_HEADER_BYTES + layout.size: layout
    for layout in (cfe.COMMAND_INGEST_HOUSEKEEPING, cfe.COMMAND_INGEST_HOUSEKEEPING_7)
}
"""Layout of CI's housekeeping by the size of its packet in bytes."""
"""A packet of another size is not CI's: in that build its MsgId belongs to another application."""


class ReceivedEvent(msgspec.Struct):
    """One event, with the number of times that it came."""

    app: str
    event_id: int
    event_type: int
    message: str
    first_ns: int
    count: int = 0


class Responses:
    """Counts the received packets.

    Args:
        mission: provides the topics of MsgIds.
        expected: expected results; it gets every packet.

    Attributes:
        events: events by text, in order of their first occurrence.
        counters: first and last received counters of the software bus.
        counts: packets by link and MsgId.
        network: SBN messages by type, other than application messages.
        answers: messages of a link without space packets.
        ingest: comparison of CI's own count with the datagrams sent to it.
        expected: see the argument.
    """

    def __init__(self, mission: Mission, expected: AwaitedResults | None = None) -> None:
        self.events: dict[str, ReceivedEvent] = {}
        self.counters: tuple[dict[str, int], dict[str, int]] | None = None
        self.counts: dict[tuple[Link, int], int] = {}
        self.network: dict[str, int] = {}
        self.answers = 0
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
        elif not link.packets:
            self.answers += 1
            return
        if len(data) < 2:
            return
        msg_id = self._mission.msg_ids.of(data)
        self.counts[link, msg_id] = self.counts.get((link, msg_id), 0) + 1
        self.expected.take(data)
        with suppress(TruncatedError):  # it is counted, but cannot be decoded
            standard = self._mission.msg_ids.standard(msg_id)
            if standard == cfe.EVENT_MSG_ID:
                self._event(data, now)
            elif standard == cfe.SOFTWARE_BUS_HOUSEKEEPING_MSG_ID:
                self._bus(data)
            elif standard == command_ingest.HOUSEKEEPING_MSG_ID and len(data) in _INGEST:
                values = _INGEST[len(data)].parse(data, cfe.TELEMETRY_HEADER_BYTES)
                self.ingest.reported(values["ingest_packets"] + values["ingest_errors"])

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
                    "name": message_name(self._mission.msg_ids.standard(msg_id)) or None,
                    "count": count,
                }
                for (link, msg_id), count in sorted(self.counts.items())
            ],
            "sbn": dict(sorted(self.network.items())),
            "answers": self.answers,
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


_NOBODY: Final = (0, 0, 0, 0, 0)
"""Origin of a packet whose origin does not matter."""


class Expectation(msgspec.Struct):
    """One expected result.

    Attributes:
        words: expectation as it was written.
        msg_ids: MsgIds of packets that can show the result.
        text: expected part of an event's text; empty if no event is expected.
        field: path of a counter; empty if no counter is expected to grow.
        growth: least growth of the counter.
        met: whether the result has come.
        outcome: text on what has come.
    """

    words: str
    msg_ids: frozenset[int]
    text: str = ""
    field: str = ""
    growth: int = 1
    met: bool = False
    outcome: str = "nothing came"
    _count: int = 0
    _base: int | None = None

    def take(self, data: bytes, structs: Structs, *, counts: bool) -> None:
        """Process a packet with one of the MsgIds.

        Args:
            data: a telemetry packet.
            structs: structs of the counters.
            counts: whether sending has begun; before that, counters only get their base value.
        """
        if self.text:
            self._event(data, counts=counts)
        elif self.field:
            self._counter(data, structs, counts=counts)
        elif counts:
            self._count += 1
            self.met = True
            self.outcome = f"came {self._count:,} times" if self._count > 1 else "came once"

    def _event(self, data: bytes, *, counts: bool) -> None:
        if not counts or self.met:
            return
        values = cfe.EVENT.parse(data, cfe.TELEMETRY_HEADER_BYTES)
        text = f"{values['app_name']} {values['event_id']}: {values['message'].strip()}"
        self._count += 1
        self.met = self.text in text
        self.outcome = text if self.met else f"other events came: {self._count:,}"

    def _counter(self, data: bytes, structs: Structs, *, counts: bool) -> None:
        body = data[cfe.TELEMETRY_HEADER_BYTES :]
        bound = structs.find(structs.msg_ids.of(data), None, len(body))
        if bound is None or not bound.fits(len(body)):
            return
        values: Any = structs.types.decode(bound.type, bound.encode_one(body, _NOBODY))
        for name in self.field.split("."):
            values = values[name]
        value = int(values)
        if not counts or self._base is None:
            self._base = value
        self.outcome = f"{self._base} → {value}"
        self.met = self.met or (counts and value - self._base >= self.growth)


class AwaitedResults(msgspec.Struct):
    """All expected results, and the time to wait for them.

    Attributes:
        items: expected results.
        within_ns: time to wait after the last datagram, ns.
    """

    items: Sequence[Expectation] = ()
    within_ns: int = 0
    _structs: Structs = msgspec.field(default_factory=Structs)
    _running: bool = False

    @classmethod
    def of(cls, texts: Sequence[str], within_ns: int, context: Context) -> AwaitedResults:
        """Read expectations: ``event:TEXT``, ``counter:NAME.FIELD[+N]``, or a name that tables show.

        Raises:
            ConfigError: one is not of these forms, or there is no such counter.
            RouteError: a name has no packets.
        """
        return cls([_read(text, context) for text in texts], within_ns, context.structs)

    @property
    def missing(self) -> list[Expectation]:
        """Expected results that have not come."""
        return [item for item in self.items if not item.met]

    def begin(self) -> None:
        """Record that sending begins."""
        self._running = True

    def take(self, data: bytes) -> None:
        """Process a received packet; any bytes are accepted."""
        msg_id = self._structs.msg_ids.of(data)
        for item in self.items:
            if msg_id in item.msg_ids:
                with suppress(TruncatedError):
                    item.take(data, self._structs, counts=self._running)

    def as_json(self) -> list[dict[str, Any]]:
        """Return ``expected`` of ``replay --json``."""
        return [{"expect": item.words, "met": item.met, "found": item.outcome} for item in self.items]


def _read(words: str, context: Context) -> Expectation:
    kind, colon, rest = words.partition(":")
    if kind == "event" and rest:
        return Expectation(words, frozenset({context.msg_ids.of_known(cfe.EVENT_MSG_ID)}), text=rest)
    if kind == "counter" and rest:
        return _counter(words, rest, context)
    if colon or not words:
        raise ConfigError(
            f"--expect {words!r} is not known; there are event:TEXT, counter:NAME.FIELD[+N], "
            "and topics, MsgIds and names that tables show"
        )
    kinds = find_packets(words, context)
    ids = frozenset(kinds.msg_ids(context.mission))
    if not ids:
        raise ConfigError(f"--expect {words!r}: it has no MsgId, so nothing that is received can show it")
    return Expectation(words, ids)


def _counter(words: str, text: str, context: Context) -> Expectation:
    path, plus, number = text.partition("+")
    name, dot, member = path.partition(".")
    form = "write counter:TO_HK.command_counter, or +3 behind it"
    if not (dot and member) or (plus and not number.isdecimal()):
        raise ConfigError(f"--expect {words!r} names no counter: {form}")
    ids = frozenset(find_packets(name, context).msg_ids(context.mission))
    bound = next((item for item in context.structs.all if item.key.msg_id in ids), None)
    if bound is None:
        raise ConfigError(
            f"--expect {words!r}: no C struct is known for {name}; name its layout with --set structs"
        )
    values = context.structs.types.decode(bound.type, bound.encode_one(bytes(bound.size), _NOBODY))
    fields = [path for path, value, *_ in bound.spans(values, bound.size) if isinstance(value, int)]
    if member not in fields:
        hint = did_you_mean(member, fields, 1) or f"there are {', '.join(fields)}"
        raise ConfigError(f"--expect {words!r}: {member!r} is no counter of {bound.name}; {hint}")
    return Expectation(words, ids, field=member, growth=int(number or 1))
