"""Events in which cFS reports a loss, parsed from their texts."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Final, Literal

import numpy as np

from edoras_tools.cfs import sbn, software_bus, telemetry_output
from edoras_tools.diagnosis.evidence.instances import NOBODY

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

    from edoras_tools.diagnosis.evidence.instances import Instances
    from edoras_tools.diagnosis.evidence.payloads import EventRecord

LossEventKind = Literal["limit", "overflow", "no_subscriber", "invalid", "too_big"]

_KINDS: Final[dict[int, LossEventKind]] = {
    software_bus.MSG_LIMIT: "limit",
    software_bus.PIPE_OVERFLOW: "overflow",
    software_bus.NO_SUBSCRIBERS: "no_subscriber",
    software_bus.INVALID_MSG_ID: "invalid",
    software_bus.MSG_TOO_BIG: "too_big",
}


@dataclass(frozen=True, slots=True)
class ReportedLoss:
    """What an event about a loss names.

    Attributes:
        kind: what happened.
        instance: on which cFS.
        msg_id: which message.
        pipe: where it did not fit; empty if the event names none.
        sender: who sent it.
    """

    kind: LossEventKind
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
        return bool(sbn.PEER_PIPE.fullmatch(self.pipe))


@dataclass
class LossEvents:
    """The events about one loss, in order: how many, and when.

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
        times = self._times
        return int(np.count_nonzero((times >= start_ns) & (times <= end_ns)))

    @cached_property
    def _times(self) -> NDArray[np.int64]:
        return np.array([item.time_ns for item in self.records], np.int64)


def parse_loss_event(record: EventRecord, instance: int = NOBODY) -> ReportedLoss | None:
    """Return what an event names; None if it is not about a loss."""
    kind = _KINDS.get(record.event_id) if record.app == software_bus.NAME else None
    found = software_bus.EVENTS[record.event_id].pattern.match(record.message) if kind else None
    if kind is None or found is None:
        return None
    parts = found.groupdict()
    return ReportedLoss(kind, instance, int(parts["msg_id"], 16), parts.get("pipe", ""), parts["sender"])


def reported_losses(events: Iterable[EventRecord], instances: Instances) -> dict[ReportedLoss, LossEvents]:
    """Return everything that events name, with the events."""
    found: dict[ReportedLoss, LossEvents] = {}
    for record in events:
        reported = parse_loss_event(record, instances.saying(record))
        if reported:
            found.setdefault(reported, LossEvents()).records.append(record)
    return found


def repeats(events: Iterable[EventRecord]) -> Counter[tuple[str, str, int]]:
    """Return how often each (instance, app, event number) was seen."""
    return Counter((record.sender, record.app, record.event_id) for record in events)
