"""What tells of loss while a link is swept (counters, events, sequence counts, echoes), and whose it is."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

from edoras_tools.model import Link
from edoras_tools.pipelines.seen import LOSSES, Seen
from edoras_tools.sessions import command_ingest, software_bus
from edoras_tools.sessions.sequence import FORWARD, MODULUS
from edoras_tools.wire import cfe, sbn

if TYPE_CHECKING:
    from collections.abc import Mapping

    from edoras_tools.mission import Mission

_COUNTER: Final = 1 << 16
_FILTER: Final = 16
"""How often the software bus reports a loss of a kind before its filter stops that."""
_INGESTED_AT: Final = cfe.TELEMETRY_HEADER_BYTES + 12
_TEXTS: Final = {
    software_bus.MSG_LIMIT: re.compile(r"Msg Limit Err,MsgId 0x([0-9a-fA-F]+),pipe (.+?),sender (.*)"),
    software_bus.PIPE_OVERFLOW: re.compile(r"Pipe Overflow,MsgId 0x([0-9a-fA-F]+),pipe (.+?),sender (.*)"),
    software_bus.NO_SUBSCRIBERS: re.compile(r"No subscribers for MsgId 0x([0-9a-fA-F]+)(),sender (.*)"),
    software_bus.MSG_TOO_BIG: re.compile(r"Send Err:Msg Too Big MsgId=0x([0-9a-fA-F]+)(),app=([^,]*)"),
}


@dataclass(frozen=True, slots=True)
class Culprit:
    """Whom an event of the software bus names.

    Attributes:
        event_id: 17 for a message limit, 25 for a full pipe, 14 for no subscribers, 15 for too big.
        msg_id: which message.
        pipe: where it did not fit; empty where the event names none.
        sender: who sent it, without its task.
    """

    event_id: int
    msg_id: int
    pipe: str
    sender: str


@dataclass(frozen=True, slots=True)
class Mark:
    """What was known at a moment.

    Attributes:
        arrived: messages of the route that came from cFS.
        whole: of those, the ones that were as expected.
        gaps: messages that their sequence counts say are missing.
        lost: what the two loss counters of the software bus grew by; None before the first 0x803.
        overflows: the part of it that found a pipe full.
        ingested: datagrams that Command Ingest handed on; None before the first 0x884.
        heard: 0x803 packets so far.
        named: events of the software bus, by whom they name.
        differs_at: first byte at which something that came was not as expected; None where nothing was.
    """

    arrived: int = 0
    whole: int = 0
    gaps: int = 0
    lost: int | None = None
    overflows: int = 0
    ingested: int | None = None
    heard: int = 0
    named: Counter[Culprit] = field(default_factory=Counter)
    differs_at: int | None = None


class Hearing:
    """Takes in what comes from cFS, and remembers what tells of loss.

    Args:
        mission: gives MsgIds their topics.
        msg_id: of the route that is swept.

    Attributes:
        seen: everything that came, counted.
        expected: what a message of the route has to be, byte for byte; None for anything.
        expected_size: how long it has to be; 0 for any.
        largest: bytes of the longest one that came.
    """

    def __init__(self, mission: Mission, msg_id: int) -> None:
        self.seen = Seen(mission)
        self.expected: bytes | None = None
        self.expected_size = 0
        self.largest = 0
        self._msg_id = msg_id
        self._arrived = self._whole = self._gaps = 0
        self._last: int | None = None
        self._ingested: int | None = None
        self._lost: Counter[str] | None = None
        self._counters: Mapping[str, int] = {}
        self._differs_at: int | None = None

    def add(self, link: Link, data: bytes, now: int) -> None:
        """Take a datagram, any bytes.

        Args:
            link: where it came from.
            data: its payload.
            now: ns since 1970.
        """
        self.seen.add(link, data, now)
        if link is Link.SBN:
            if data[2:3] != bytes([sbn.MsgType.APP]):
                return
            data = data[sbn.HEADER.size :]
        if len(data) < cfe.COMMAND_HEADER_BYTES:
            return
        msg_id = software_bus.msg_id(data)
        if msg_id == self._msg_id:
            self._take(data)
        if msg_id == cfe.SOFTWARE_BUS_HOUSEKEEPING_MSG_ID and self.seen.counters:
            self._count(self.seen.counters[1])
        if msg_id == command_ingest.HOUSEKEEPING_MSG_ID and len(data) >= _INGESTED_AT + 4:
            self._ingested = int.from_bytes(data[_INGESTED_AT : _INGESTED_AT + 4], "little")

    def _take(self, data: bytes) -> None:
        self._arrived += 1
        self.largest = max(self.largest, len(data))
        sequence = int.from_bytes(data[2:4], "big") % MODULUS
        if self._last is not None:
            gap = (sequence - self._last - 1) % MODULUS
            # A count that steps back is late, or is none at all.
            self._gaps += gap if gap < FORWARD else 0
        self._last = sequence
        if self.expected is not None and data != self.expected:
            pairs = zip(data, self.expected, strict=False)
            same = next((at for at, (a, b) in enumerate(pairs) if a != b), min(len(data), len(self.expected)))
            self._differs_at = same if self._differs_at is None else min(self._differs_at, same)
        elif not self.expected_size or len(data) == self.expected_size:
            self._whole += 1

    def _count(self, counters: Mapping[str, int]) -> None:
        before = self._counters or counters
        self._lost = self._lost or Counter()
        for name in LOSSES:
            self._lost[name] += (counters[name] - before[name]) % _COUNTER
        self._counters = counters

    def begin(self) -> None:
        """Begin a step: what was expected before, and the sequence before, no longer count."""
        self._last = self._differs_at = None

    def mark(self) -> Mark:
        """Return what is known now."""
        heard = sum(
            count
            for (_, msg_id), count in self.seen.counts.items()
            if msg_id == cfe.SOFTWARE_BUS_HOUSEKEEPING_MSG_ID
        )
        return Mark(
            arrived=self._arrived,
            whole=self._whole,
            gaps=self._gaps,
            lost=None if self._lost is None else self._lost.total(),
            overflows=self._lost[LOSSES[0]] if self._lost else 0,
            ingested=self._ingested,
            heard=heard,
            named=self._named(),
            differs_at=self._differs_at,
        )

    def _named(self) -> Counter[Culprit]:
        named: Counter[Culprit] = Counter()
        for told in self.seen.events.values():
            pattern = _TEXTS.get(told.event_id) if told.app == software_bus.SOFTWARE_BUS else None
            found = pattern.match(told.message) if pattern else None
            if found:
                sender = found[3].partition(".")[0]
                named[Culprit(told.event_id, int(found[1], 16), found[2], sender)] += told.count
        return named


@dataclass(frozen=True, slots=True)
class Account:
    """What became of the messages of a step.

    Attributes:
        sent: to cFS, or published by it.
        delivered: got through.
        lost: did not.
        bus: lost by the software bus, by its counters and events.
        overflows: whatever was lost because a pipe was full.
        gaps: missing by their sequence counts.
        not_ingested: left the ground, and Command Ingest did not read them.
        altered: did not come back as they were sent.
        unseen: asked for and never published, or lost without any trace.
        differs_at: first byte of those that did not come back as sent.
        culprit: whom most events about the route name.
        others: events about other routes, by whom they name.
    """

    sent: int
    delivered: int
    lost: int
    bus: int = 0
    overflows: int = 0
    gaps: int = 0
    not_ingested: int = 0
    altered: int = 0
    unseen: int = 0
    differs_at: int | None = None
    culprit: Culprit | None = None
    others: Mapping[Culprit, int] = field(default_factory=dict)

    def as_json(self) -> dict[str, Any]:
        """Return the evidence in the shape of ``sweep --json``."""
        return {
            "software_bus": self.bus,
            "sequence_gaps": self.gaps,
            "not_ingested": self.not_ingested,
            "altered": self.altered,
            "without_trace": self.unseen,
        }


def _bus(before: Mark, after: Mark, msg_id: int) -> tuple[int, Culprit | None, Counter[Culprit]]:
    """Return how many messages of a route the bus lost, whom that is laid to, and who else lost some."""
    named = after.named - before.named
    losses = {item for item in named if item.event_id in {software_bus.MSG_LIMIT, software_bus.PIPE_OVERFLOW}}
    ours = Counter({item: named[item] for item in named if item.msg_id == msg_id})
    others = Counter({item: named[item] for item in losses if item.msg_id != msg_id})
    culprit = ours.most_common(1)[0][0] if ours else None
    told = sum(count for item, count in ours.items() if item in losses)
    # Who is named until the events' filter stops them has lost any number more.
    if after.lost is None or (others and not told) or max(others.values(), default=0) >= _FILTER:
        return told, culprit, others
    counted = after.lost - (before.lost or 0)
    return max(counted - others.total(), told), culprit, others


def commands(before: Mark, after: Mark, msg_id: int, sent: int, through_ci: int) -> Account:
    """Account for commands.

    Args:
        before: when the step began.
        after: when all was quiet again.
        msg_id: of the route.
        sent: messages of it.
        through_ci: datagrams of any kind that Command Ingest should have read; 0 where they went elsewhere.
    """
    bus, culprit, others = _bus(before, after, msg_id)
    not_ingested = 0
    if before.ingested is not None and after.ingested is not None:
        not_ingested = max(0, through_ci - (after.ingested - before.ingested))
    altered = (after.arrived - before.arrived) - (after.whole - before.whole)
    if culprit and culprit.event_id in {software_bus.NO_SUBSCRIBERS, software_bus.MSG_TOO_BIG}:
        bus = sent
    lost = min(sent, bus + not_ingested + altered)
    return Account(
        sent,
        sent - lost,
        lost,
        bus=bus,
        not_ingested=not_ingested,
        altered=altered,
        differs_at=after.differs_at,
        culprit=culprit,
        others=others,
    )


def telemetry(before: Mark, after: Mark, msg_id: int, least: int, asked: int) -> Account:
    """Account for telemetry.

    Args:
        before: when the step began.
        after: when all was quiet again.
        msg_id: of the route.
        least: messages that must have been published in that time.
        asked: messages that should have been.
    """
    bus, culprit, others = _bus(before, after, msg_id)
    gaps = after.gaps - before.gaps
    delivered = after.whole - before.whole
    altered = after.arrived - before.arrived - delivered
    lost = max(gaps, bus if culprit else 0) + altered
    unseen = asked - delivered - lost if delivered + lost < least else 0
    lost += unseen
    return Account(
        delivered + lost,
        delivered,
        lost,
        bus=bus,
        overflows=after.overflows - before.overflows,
        gaps=gaps,
        altered=altered,
        unseen=unseen,
        culprit=culprit,
        others=others,
    )


def watched(before: Mark, after: Mark, msg_id: int) -> Account:
    """Account for telemetry that goes on all the time: by sequence counts, since counters come later."""
    bus, culprit, others = _bus(before, after, msg_id)
    delivered, gaps = after.arrived - before.arrived, after.gaps - before.gaps
    return Account(
        delivered + gaps,
        delivered,
        gaps,
        bus=bus,
        overflows=after.overflows - before.overflows,
        gaps=gaps,
        culprit=culprit,
        others=others,
    )
