"""Losses that cFS itself reports: the counters of its software bus over time, and its events."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from functools import cached_property
from typing import TYPE_CHECKING, Final, Literal, NamedTuple

import msgspec
import numpy as np

from edoras_tools.cfs import sbn, software_bus, telemetry_output
from edoras_tools.diagnosis.evidence.instances import NOBODY, Instances
from edoras_tools.sessions.sequence import MODULUS
from edoras_tools.units import MILLISECOND
from edoras_tools.wire.arrays import Integers, Mask, Places, distinct, numbered

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from edoras_tools.diagnosis.evidence.payloads import EventRecord, Payloads, Samples
    from edoras_tools.diagnosis.evidence.table import Rows


_APART_NS: Final = 100 * MILLISECOND
"""Of samples that are closer together the last is enough: no loss is known to so exact a time."""
_BYTE: Final = 1 << 8
_LEAST_IDLE: Final = 3
_WIDTHS: Final = {"pipe_overflows": 16, "msg_limits": 16, "no_subscribers": 8, "send_errors": 8}


class Track:
    """The bus counters of one instance, from its first captured 0x803 on.

    Args:
        made_ns: i64 (n,), times at which the samples were made, strictly increasing; at least one.
        counters: name of a counter to its values, i64 (n,).
        restarted: bool (n - 1,), cFS was started again since the sample before.

    Attributes:
        times: capture times, ns, at which the samples were made.
        totals: name of a counter to its growth from the first sample up to each sample.
        older: name of a counter to its value in the first sample: losses before it.
        set_back: indices of the steps between two samples in which a counter was reset: its last growth is
            unknown.
    """

    def __init__(self, made_ns: Integers, counters: Mapping[str, Integers], restarted: Mask) -> None:
        at = distinct(np.array([0, *np.flatnonzero(np.diff(made_ns // _APART_NS)), len(made_ns) - 1]))
        set_back = restarted.copy()
        self.times: list[int] = made_ns[at].tolist()
        self.totals: dict[str, list[int]] = {}
        self.older: dict[str, int] = {}
        for name, values in counters.items():
            modulus = 1 << _WIDTHS[name]
            steps = np.diff(values) % modulus
            # A step down by little is a reset, and no wrap. Counters of 8 bits wrap too often to decide.
            reset = (np.diff(values) < 0) & (steps > modulus // 2) | restarted
            set_back |= reset & (modulus > _BYTE)
            grown = np.cumsum(np.where(reset, values[1:], steps))
            self.older[name] = int(values[0])
            self.totals[name] = np.append(0, grown)[at].tolist()
        places = np.searchsorted(at, np.flatnonzero(set_back), "right") - 1
        self.set_back: list[int] = distinct(places).tolist()

    def growth(self, name: str, start_ns: int | None = None, end_ns: int | None = None) -> int:
        """Return by how much a counter grew between two times.

        The growth is that from the last sample before ``start_ns`` to the first one after ``end_ns``. So it
        includes all losses in between.
        """
        last, totals = len(self.times) - 1, self.totals[name]
        low = 0 if start_ns is None else max(bisect_right(self.times, start_ns) - 1, 0)
        high = last if end_ns is None else min(bisect_left(self.times, end_ns), last)
        return max(0, totals[high] - totals[low])

    def beyond_steady(self, name: str, sent_ns: Integers, late_ns: int) -> tuple[Integers, int]:
        """Return a counter's growth without the steady growth that other traffic causes.

        The steady growth is the median step of samples that can count none of the messages.

        Args:
            name: name of the counter.
            sent_ns: i64, times at which the messages were sent, in order.
            late_ns: longest time from a message to the sample that counts it.

        Returns:
            growth up to each sample, i64, and the range of the steps that can count none of the messages.
        """
        times, totals = np.array(self.times), np.array(self.totals[name])
        free = np.searchsorted(sent_ns, times[1:]) == np.searchsorted(sent_ns, times[:-1] - late_ns)
        idle = np.diff(totals)[free]
        if len(idle) < _LEAST_IDLE:
            return totals, 0
        return totals - int(np.median(idle)) * np.arange(len(totals)), int(np.ptp(idle))

    def watches(self, time_ns: int) -> bool:
        """Return whether a time lies between the first and the last sample."""
        return self.times[0] <= time_ns <= self.times[-1]


def tracks(
    rows: Rows, payloads: Payloads, instances: Instances, resets: Iterable[tuple[int, int, int]]
) -> dict[int, Track]:
    """Return instance to the history of its bus counters, for each instance with a 0x803 in the capture.

    Housekeeping may arrive over several links; the link with most samples is used.

    Args:
        rows: all datagrams.
        payloads: contents of packets of cFS itself.
        instances: senders of packets.
        resets: restarts of a cFS whose clock went on: instance, earliest and latest time in ns.
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
            at, values = _in_order(samples, own[which == number], instances, rows)
            if not _returns(values):
                seen_ns, restarted = rows.time_ns[at], np.zeros(max(len(at) - 1, 0), bool)
                for start_ns, end_ns in (item[1:] for item in resets if item[0] == index):
                    restarted |= (seen_ns[:-1] <= start_ns) & (end_ns <= seen_ns[1:])
                counters = dict(zip(_WIDTHS, values, strict=True))
                by_instance[index] = Track(instances.made_ns[at], counters, restarted)
                break
    return by_instance


def _in_order(samples: Samples, some: Places, instances: Instances, rows: Rows) -> tuple[Places, Integers]:
    """Return the rows of samples in the order in which they were made, and their counters: (counters, n)."""
    made_ns = instances.made_ns[samples["row"][some]]
    order = np.argsort(made_ns, kind="stable")
    # Samples of equal times are copies: one is kept.
    order = order[np.diff(made_ns[order], prepend=made_ns[order[:1]] - 1) > 0]
    # A sample is from another cFS if its counters exceed those of the next although the one before does not;
    # up to two are if their sequence counts are not between those around them.
    count = rows.sequence_count[samples["row"][some[order]]].astype(np.int64)
    values = np.array([samples[name][some[order]] for name in _WIDTHS], np.int64)
    before, own, behind = values[:2, :-2], values[:2, 1:-1], values[:2, 2:]
    fits = np.ones(len(order), bool)
    fits[1:-1] = ~((before <= behind) & (behind < own)).any(axis=0)
    for number, place in ((1, 1), (2, 1), (2, 2)):
        end = max(0, len(order) - number - 1)
        inside = slice(place, place + end)
        mine, next_ = ((count[part] - count[:end]) % MODULUS for part in (inside, slice(number + 1, None)))
        fits[inside] &= (next_ >= MODULUS // 2) | (mine <= next_)
    return samples["row"][some[order[fits]]], values[:, fits]


def _returns(values: Integers) -> bool:
    """Return whether the counters mix two instances: they fall, and later rise by as much in one step."""
    steps, wide = np.diff(values), np.array(list(_WIDTHS.values())) > 8  # 8 bits wrap too often to decide
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
    """The loss that an event of the software bus reports.

    Attributes:
        kind: kind of the loss.
        instance: index of the instance that reports it.
        msg_id: MsgId of the lost message.
        pipe: name of the pipe that did not take it; empty if the event names none.
        sender: name of the application that sent it.
    """

    kind: LossEventKind
    instance: int
    msg_id: int
    pipe: str
    sender: str

    @property
    def at_pipe(self) -> PipeKind | None:
        """The kind of loss, if the event is about a pipe; else None."""
        return self.kind if self.kind in ("limit", "overflow") else None

    @property
    def at_output(self) -> bool:
        """Whether the pipe is Telemetry Output's."""
        return self.pipe == telemetry_output.PIPE

    @property
    def at_peer(self) -> bool:
        """Whether the pipe is that of an SBN peer."""
        return bool(sbn.PEER_PIPE.fullmatch(self.pipe))


class LossEvents(msgspec.Struct, dict=True):
    """The events that report one loss.

    Attributes:
        records: events, in order of capture.
    """

    records: list[EventRecord] = msgspec.field(default_factory=list)

    @property
    def count(self) -> int:
        """Number of events."""
        return len(self.records)

    def text(self, number: int) -> str:
        """Return a sentence for ``number`` of the events, with the message of the first."""
        return f"event CFE_SB {self.records[0].event_id} x{number}: {self.records[0].message}"

    @property
    def first_ns(self) -> int:
        """Capture time of the first event, ns."""
        return self.records[0].time_ns

    @property
    def last_ns(self) -> int:
        """Capture time of the last event, ns."""
        return self.records[-1].time_ns

    def within(self, start_ns: int, end_ns: int) -> int:
        """Return the number of events in a span of time."""
        times = self._times
        return int(np.count_nonzero((times >= start_ns) & (times <= end_ns)))

    @cached_property
    def _times(self) -> Integers:
        return np.array([item.time_ns for item in self.records], np.int64)


def parse_loss_event(record: EventRecord, instance: int = NOBODY) -> ReportedLoss | None:
    """Return the loss that an event reports; None if it reports none."""
    kind = _KINDS.get(record.event_id) if record.app == software_bus.NAME else None
    match = software_bus.EVENTS[record.event_id].pattern.match(record.message) if kind else None
    if kind is None or match is None:
        return None
    parts = match.groupdict()
    return ReportedLoss(kind, instance, int(parts["msg_id"], 16), parts.get("pipe", ""), parts["sender"])


def reported_losses(events: Iterable[EventRecord], instances: Instances) -> dict[ReportedLoss, LossEvents]:
    """Return each loss that events report, with these events."""
    reports: dict[ReportedLoss, LossEvents] = {}
    for record in (item for item in events if item.app == software_bus.NAME):
        if reported := parse_loss_event(record, instances.saying(record)):
            reports.setdefault(reported, LossEvents()).records.append(record)
    return reports
