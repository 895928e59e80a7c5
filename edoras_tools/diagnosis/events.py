"""What cFS says about loss in its events, word for word, as values."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, Literal

from edoras_tools.diagnosis.instances import NOBODY
from edoras_tools.sessions import telemetry_output

if TYPE_CHECKING:
    from collections.abc import Iterable

    from edoras_tools.diagnosis.instances import Instances
    from edoras_tools.diagnosis.payloads import EventRecord

Kind = Literal["limit", "overflow", "no_subscriber", "invalid", "too_big"]

STOPS_AFTER: Final = 16
"""How often cFS repeats a loss event before its filter stops it."""
_TEXTS: Final = {
    ("CFE_SB", 17): (
        "limit",
        re.compile(
            r"Msg Limit Err,MsgId 0x(?P<msg_id>[0-9a-fA-F]+),pipe (?P<pipe>.+?),sender (?P<sender>.*)"
        ),
    ),
    ("CFE_SB", 25): (
        "overflow",
        re.compile(
            r"Pipe Overflow,MsgId 0x(?P<msg_id>[0-9a-fA-F]+),pipe (?P<pipe>.+?),sender (?P<sender>.*)"
        ),
    ),
    ("CFE_SB", 14): (
        "no_subscriber",
        re.compile(r"No subscribers for MsgId 0x(?P<msg_id>[0-9a-fA-F]+),sender (?P<sender>.*)"),
    ),
    ("CFE_SB", 21): (
        "invalid",
        re.compile(r"Send Err:Invalid MsgId\(0x(?P<msg_id>[0-9a-fA-F]+)\)in msg,App (?P<sender>.*)"),
    ),
    ("CFE_SB", 15): (
        "too_big",
        re.compile(r"Send Err:Msg Too Big MsgId=0x(?P<msg_id>[0-9a-fA-F]+),app=(?P<sender>[^,]*)"),
    ),
}


@dataclass(frozen=True, slots=True)
class Culprit:
    """Whom an event about loss names.

    Attributes:
        kind: what happened.
        instance: on which cFS.
        msg_id: which message.
        pipe: where it did not fit; empty where the event names none.
        sender: who sent it.
    """

    kind: Kind
    instance: int
    msg_id: int
    pipe: str
    sender: str

    @property
    def at_pipe(self) -> bool:
        """Whether it is about a pipe that did not take a message."""
        return self.kind in {"limit", "overflow"}

    @property
    def at_output(self) -> bool:
        """Whether it is Telemetry Output's pipe."""
        return self.pipe == telemetry_output.PIPE

    @property
    def at_peer(self) -> bool:
        """Whether it is the pipe of an SBN peer."""
        return bool(re.fullmatch(r"SBN_\d+_\d+_Pipe", self.pipe))


@dataclass(slots=True)
class Said:
    """How often an event was seen, and when.

    Attributes:
        records: the events, in order.
    """

    records: list[EventRecord] = field(default_factory=list)

    @property
    def count(self) -> int:
        """How many."""
        return len(self.records)

    @property
    def first_ns(self) -> int:
        """Capture time of the first."""
        return self.records[0].time_ns

    @property
    def last_ns(self) -> int:
        """Capture time of the last."""
        return self.records[-1].time_ns

    def within(self, start_ns: int, end_ns: int) -> int:
        """Return how many came in a span of time."""
        return sum(start_ns <= item.time_ns <= end_ns for item in self.records)


def parse(record: EventRecord, instance: int = NOBODY) -> Culprit | None:
    """Return whom an event names, or None where it is not about loss."""
    kind, pattern = _TEXTS.get((record.app, record.event_id), (None, None))
    found = pattern.match(record.message) if pattern else None
    if kind is None or found is None:
        return None
    parts = found.groupdict()
    return Culprit(kind, instance, int(parts["msg_id"], 16), parts.get("pipe", ""), parts["sender"])  # type: ignore[arg-type]


def culprits(events: Iterable[EventRecord], instances: Instances) -> dict[Culprit, Said]:
    """Return everyone that events name, with the events."""
    found: dict[Culprit, Said] = {}
    for record in events:
        instance = int(instances.of_row[record.row])
        if instance == NOBODY:
            instance = instances.named(record.sender, record.time_ns)
        culprit = parse(record, instance)
        if culprit:
            found.setdefault(culprit, Said()).records.append(record)
    return found


def repeats(events: Iterable[EventRecord]) -> Counter[tuple[str, str, int]]:
    """Return how often each (instance, app, event number) was seen."""
    return Counter((record.sender, record.app, record.event_id) for record in events)
