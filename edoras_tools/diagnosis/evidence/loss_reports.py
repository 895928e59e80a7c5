"""What cFS itself says of losses: the counters of its software bus over time, and its events."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from functools import cached_property
from typing import TYPE_CHECKING, Final, Literal, NamedTuple

import msgspec
import numpy as np

from edoras_tools.cfs import sbn, software_bus, telemetry_output
from edoras_tools.diagnosis.evidence.instances import NOBODY, Instances
from edoras_tools.sessions.sequence import MODULUS
from edoras_tools.wire.arrays.order import Integers, Places, numbered

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from typing_extensions import Self

    from edoras_tools.diagnosis.evidence.payloads import EventRecord, Payloads, Samples
    from edoras_tools.diagnosis.evidence.table import Rows


_BYTE: Final = 1 << 8
_LEAST_IDLE: Final = 3
_WIDTHS: Final = {"pipe_overflows": 16, "msg_limits": 16, "no_subscribers": 8, "send_errors": 8}


class Track(msgspec.Struct):
    """The counters of one instance, growing from 0 at its first 0x803 here.

    Attributes:
        times: when each sample was made, capture time.
        totals: counter to its growth up to each sample.
        older: counter to what the first sample already showed: lost before it.
        set_back: steps between two samples in which a counter was set back: nobody has what it had last.
    """

    times: list[int] = msgspec.field(default_factory=list)
    totals: dict[str, list[int]] = msgspec.field(default_factory=dict)
    older: dict[str, int] = msgspec.field(default_factory=dict)
    set_back: list[int] = msgspec.field(default_factory=list)

    def growth(self, name: str, start_ns: int | None = None, end_ns: int | None = None) -> int:
        """Return by how much a counter grew between two times.

        Counted from the last sample before ``start_ns`` to the first after ``end_ns``: what happened in
        between is in it.
        """
        if not self.times:
            return 0
        last, totals = len(self.times) - 1, self.totals[name]
        low = 0 if start_ns is None else max(bisect_right(self.times, start_ns) - 1, 0)
        high = last if end_ns is None else min(bisect_left(self.times, end_ns), last)
        return max(0, totals[high] - totals[low])

    def beyond_steady(self, name: str, sent_ns: Integers, late_ns: int) -> tuple[Integers, int]:
        """Return a counter's growth less what it grows by evenly while none of some messages can be counted.

        Args:
            sent_ns: when they were sent, in order.
            late_ns: they are counted so long after at the most.

        Returns:
            growth up to each sample, and by how much a step of it differs while none of them can be counted.
        """
        times, totals = np.array(self.times), np.array(self.totals[name])
        free = np.searchsorted(sent_ns, times[1:]) == np.searchsorted(sent_ns, times[:-1] - late_ns)
        idle = np.diff(totals)[free]
        if len(idle) < _LEAST_IDLE:
            return totals, 0
        return totals - int(np.median(idle)) * np.arange(len(totals)), int(np.ptp(idle))

    def watches(self, time_ns: int) -> bool:
        """Tell whether samples lie on both sides of a time."""
        return bool(self.times) and self.times[0] <= time_ns <= self.times[-1]

    @classmethod
    def of(cls, made_ns: Integers, counters: Mapping[str, Integers]) -> Self:
        """Follow samples of the counters, each made at another time and later than the one before."""
        track, set_back = cls(made_ns.tolist()), np.zeros(max(len(made_ns) - 1, 0), bool)
        for name, values in counters.items():
            modulus = 1 << _WIDTHS[name]
            steps = np.diff(values) % modulus
            # Down by a little is no wrap: the counters were reset. Eight bits wrap too soon to tell.
            reset = (np.diff(values) < 0) & (steps > modulus // 2)
            set_back |= reset & (modulus > _BYTE)
            grown = np.cumsum(np.where(reset, values[1:], steps))
            track.older[name] = int(values[0])
            track.totals[name] = [0, *grown.tolist()]
        track.set_back = np.flatnonzero(set_back).tolist()
        return track


def tracks(rows: Rows, payloads: Payloads, instances: Instances) -> dict[int, Track]:
    """Return a track for every instance whose 0x803 is here.

    An instance's housekeeping may arrive over several links; the one that brings the most is read.
    """
    samples = payloads.housekeeping
    instance = instances.of_row[samples["row"]]
    source = rows.source[samples["row"]]
    for port in np.unique(source).tolist():
        source[source == port] = instances.output(port)
    way = rows.link[samples["row"]].astype(np.int64) << 32 | source
    by_instance = {}
    for index in np.unique(instance[instance != NOBODY]).tolist():
        own = np.flatnonzero(instance == index)
        first, which = numbered(way[own])
        sizes = np.bincount(which, minlength=len(first))
        for number in np.argsort(-sizes, kind="stable").tolist():
            made_ns, values = _in_order(samples, own[which == number], instances, rows)
            if not _returns(values):
                by_instance[index] = Track.of(made_ns, dict(zip(_WIDTHS, values, strict=True)))
                break
    return by_instance


def _in_order(samples: Samples, some: Places, instances: Instances, rows: Rows) -> tuple[Integers, Integers]:
    """Return when each of some samples was made, and its counters, a row each."""
    made_ns = instances.made_ns[samples["row"][some]]
    order = np.argsort(made_ns, kind="stable")
    # Of one time there is one sample: what comes again is the same.
    order = order[np.diff(made_ns[order], prepend=made_ns[order[:1]] - 1) > 0]
    # One whose count is not between those of its neighbours is of another cFS; so is one that counts more
    # than the next one, which the one before it does not.
    count = rows.sequence_count[samples["row"][some[order]]].astype(np.int64)
    mine, next_ = (count[1:-1] - count[:-2]) % MODULUS, (count[2:] - count[:-2]) % MODULUS
    values = np.array([samples[name][some[order]] for name in _WIDTHS], np.int64)
    before, own, behind = values[:2, :-2], values[:2, 1:-1], values[:2, 2:]
    astray = (next_ < MODULUS // 2) & (mine > next_) | ((before <= behind) & (behind < own)).any(axis=0)
    fits = ~np.concatenate(([False], astray, [False]))[: len(order)]
    return made_ns[order[fits]], values[:, fits]


def _returns(values: Integers) -> bool:
    """Tell whether counters are those of two instances: all that they fell by comes back in one step."""
    steps, wide = np.diff(values), np.array(list(_WIDTHS.values())) > 8  # eight bits wrap too soon to tell
    falls = np.flatnonzero((steps[wide] < 0).any(axis=0)).tolist()
    least = (np.maximum(values[:, at + 1 : -1] - steps[:, at, None], values[:, at, None]) for at in falls)
    return any((values[:, at + 2 :] >= item).all(axis=0).any() for at, item in zip(falls, least, strict=True))


PipeKind = Literal["limit", "overflow"]
LossEventKind = PipeKind | Literal["no_subscriber", "invalid", "too_big"]

_KINDS: Final[dict[int, LossEventKind]] = {
    software_bus.MSG_LIMIT: "limit",
    software_bus.PIPE_OVERFLOW: "overflow",
    software_bus.NO_SUBSCRIBERS: "no_subscriber",
    software_bus.INVALID_MSG_ID: "invalid",
    software_bus.MSG_TOO_BIG: "too_big",
}


class ReportedLoss(NamedTuple):
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
    def at_pipe(self) -> PipeKind | None:
        """How a pipe did not take the message; None where the event is not about a pipe."""
        return self.kind if self.kind in ("limit", "overflow") else None

    @property
    def at_output(self) -> bool:
        """Whether it is Telemetry Output's pipe."""
        return self.pipe == telemetry_output.PIPE

    @property
    def at_peer(self) -> bool:
        """Whether it is the pipe of an SBN peer."""
        return bool(sbn.PEER_PIPE.fullmatch(self.pipe))


class LossEvents(msgspec.Struct, dict=True):
    """The events about one loss, in order: how many, and when.

    Attributes:
        records: the events, in order.
    """

    records: list[EventRecord] = msgspec.field(default_factory=list)

    @property
    def count(self) -> int:
        """How many."""
        return len(self.records)

    def text(self, number: int) -> str:
        """Say what so many of them are, with the words of the first."""
        return f"event CFE_SB {self.records[0].event_id} x{number}: {self.records[0].message}"

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
    def _times(self) -> Integers:
        return np.array([item.time_ns for item in self.records], np.int64)


def parse_loss_event(record: EventRecord, instance: int = NOBODY) -> ReportedLoss | None:
    """Return what an event names; None if it is not about a loss."""
    kind = _KINDS.get(record.event_id) if record.app == software_bus.NAME else None
    match = software_bus.EVENTS[record.event_id].pattern.match(record.message) if kind else None
    if kind is None or match is None:
        return None
    parts = match.groupdict()
    return ReportedLoss(kind, instance, int(parts["msg_id"], 16), parts.get("pipe", ""), parts["sender"])


def reported_losses(events: Iterable[EventRecord], instances: Instances) -> dict[ReportedLoss, LossEvents]:
    """Return everything that events name, with the events."""
    reports: dict[ReportedLoss, LossEvents] = {}
    for record in (item for item in events if item.app == software_bus.NAME):
        if reported := parse_loss_event(record, instances.saying(record)):
            reports.setdefault(reported, LossEvents()).records.append(record)
    return reports
