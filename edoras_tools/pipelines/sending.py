"""The loop that sends: every datagram on its deadline, the session alive, and an ear on what comes back."""

from __future__ import annotations

from bisect import bisect_right
from contextlib import nullcontext
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final, Protocol

import numpy as np

from edoras_tools.errors import CaptureError
from edoras_tools.model import Link
from edoras_tools.pipelines.interrupt import on_interrupt
from edoras_tools.sessions.outgoing import Changes, Outgoing
from edoras_tools.sessions.pacing import Lateness, Timetable
from edoras_tools.sessions.profile import MILLISECOND, SECOND

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from edoras_tools.errors import EdorasError
    from edoras_tools.pipelines.gates import Gate
    from edoras_tools.pipelines.keys import Keys
    from edoras_tools.pipelines.seen import Seen
    from edoras_tools.sessions.faults import Delivery, Fault, FaultMachine
    from edoras_tools.sessions.sbn_client import Peering
    from edoras_tools.sinks.wire import Wire

_BLOCK: Final = 512
"""Datagrams that leave together, where that many are due."""
_ROUND_NS: Final = 20 * MILLISECOND
"""How often the loop looks around however busy it is; it also bounds how late Ctrl-C and keys are noticed."""
_BARREN_NS: Final = SECOND
"""A target that refuses within this time of the first datagram is not there at all."""
_LEAD_NS: Final = 2 * MILLISECOND
"""From "go" to the first deadline, so that the first datagram is not late."""


class Watcher(Protocol):
    """What looks on while a sending goes on."""

    def update(self, report: Report) -> None:
        """Show where things are; cheap enough to be called fifty times a second."""


@dataclass(slots=True)
class Report:
    """What was sent and what came of it.

    Attributes:
        sent: datagrams of the recording that left; at the end without those that were refused.
        total: that were to be sent; None for no end.
        send_errors: datagrams that could not leave, or were refused.
        errors: why, and how many.
        asked_hz: the rate asked for; None for as fast as it goes.
        first_ns: when the first left, monotonic.
        last_ns: when the last left.
        lateness: of each.
        seen: what came back.
        faults: injected faults by kind.
        interrupted: ended by Ctrl-C or the q key.
        failure: why it ended early.
        notes: one line each, for people.
    """

    seen: Seen
    total: int | None
    asked_hz: float | None
    sent: int = 0
    send_errors: int = 0
    errors: dict[str, int] = field(default_factory=dict)
    first_ns: int = 0
    last_ns: int = 0
    lateness: Lateness = field(default_factory=Lateness)
    faults: dict[str, int] = field(default_factory=dict)
    interrupted: bool = False
    failure: EdorasError | None = None
    notes: list[str] = field(default_factory=list)

    @property
    def achieved_hz(self) -> float | None:
        """Datagrams per second between the first and the last."""
        span = self.last_ns - self.first_ns
        return (self.sent - 1) * SECOND / span if self.sent > 1 and span > 0 else None

    def summary(self) -> dict[str, Any]:
        """Return the shape of ``replay --json``."""
        return {
            "sent": self.sent,
            "rate_asked_hz": _rounded(self.asked_hz),
            "rate_achieved_hz": _rounded(self.achieved_hz),
            "duration_s": round((self.last_ns - self.first_ns) / SECOND, 6),
            "lateness_us": self.lateness.summary(),
            "send_errors": self.send_errors,
            "errors": self.errors,
            "faults": self.faults,
            "interrupted": self.interrupted,
            "failure": str(self.failure) if self.failure else None,
            "notes": self.notes,
            "seen": self.seen.summary(),
        }


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 3)


class Sending:
    """One run.

    Args:
        wire: where to.
        name: how people call that.
        out: what, in the order of the timetable.
        table: when.
        report: where the outcome is written, as it happens.
        changes: what is changed in each pass.
        passes: how often; 0 until it is stopped.
        session: the SBN session that this is part of.
        faults: what spoils datagrams on purpose.
        note: told of each fault.
        keys: the keyboard.
        paused: begin in single steps.
        linger_ns: how long to listen after the last datagram.
        watcher: looks on.
    """

    def __init__(
        self,
        wire: Wire,
        name: str,
        out: Outgoing,
        table: Timetable,
        report: Report,
        *,
        changes: Changes | None = None,
        passes: int = 1,
        session: Peering | None = None,
        faults: FaultMachine | None = None,
        note: Callable[[Sequence[Fault]], None] = lambda _: None,
        keys: Keys | None = None,
        paused: bool = False,
        linger_ns: int = 0,
        watcher: Watcher | None = None,
    ) -> None:
        self.report = report
        self.stopped = False
        self._wire, self._name, self._out, self._table = wire, name, out, table
        self._changes = changes or Changes()
        self._passes = passes
        self._session, self._faults, self._keys, self._watcher = session, faults, keys, watcher
        self._note = note
        self._paused = paused
        self._steps = 0
        self._linger_ns = linger_ns
        self._due = table.due_ns.data
        self._epoch_ns = wire.epoch_ns()
        self._round_ns = 0
        self._refused = 0

    def stop(self) -> None:
        """End as soon as possible."""
        self.stopped = True

    def run(self, gates: Iterable[Gate] = (), timeout_ns: int = 10 * SECOND) -> Report:
        """Wait for the gates, send, listen for a while, say goodbye.

        Whatever goes wrong on the way is in ``Report.failure``.
        """
        report = self.report
        with on_interrupt(self.stop), self._keys or nullcontext():
            try:
                self._wait_for(gates, timeout_ns)
                if not self.stopped:
                    self._send_all()
                    self._listen(self._linger_ns)
            except CaptureError as error:
                report.failure = error
            except KeyboardInterrupt:  # the second Ctrl-C
                self.stopped = True
            report.interrupted = self.stopped and report.failure is None
            for data in self._session.goodbye() if self._session else ():
                self._wire.put(data)
        statistics = self._wire.statistics
        report.errors = dict(statistics.errors)
        if refused := statistics.refused - self._refused:
            report.errors["Connection refused"] = refused
            # An answer to one that had left: it went nowhere. Some answer those of the session.
            report.sent = max(0, report.sent - refused)
        report.send_errors = sum(report.errors.values())
        return report

    def _wait_for(self, gates: Iterable[Gate], timeout_ns: int) -> None:
        began = self._wire.now()
        for gate in gates:
            ask_ns = self._wire.now()
            while not self.stopped:
                now = self._look_around()
                if gate.open():
                    break
                if now - began >= timeout_ns:
                    raise CaptureError(gate.explain((now - began) / SECOND))
                if now >= ask_ns:
                    gate.ask()
                    ask_ns = now + SECOND
                self._wire.wait(min(now + _ROUND_NS, began + timeout_ns))

    def _send_all(self) -> None:
        out, changes = self._out, self._changes
        self._refused = self._wire.statistics.refused
        start = self._wire.now() + _LEAD_NS
        done = 0
        while not self.stopped and (not self._passes or done < self._passes):
            batch = (
                changes.each(out, sent=done, start_ns=start + self._epoch_ns, due_ns=self._table.due_ns)
                if changes.differ
                else out
            )
            start = self._one_pass(batch, start) + self._table.period_ns
            done += 1
        while not self.stopped and (held_ns := self._held_ns()) is not None:
            self._pass_time(held_ns)

    def _one_pass(self, out: Outgoing, start: int) -> int:
        """Send all datagrams once; return when the pass began, pauses left out."""
        wire, due, count = self._wire, self._due, len(out)
        report, at = self.report, 0
        while at < count and not self.stopped:
            now = wire.now()
            if now >= self._round_ns:
                now = self._look_around()
            if self._paused:
                if not self._steps:
                    if not wire.wait(now + _ROUND_NS):
                        self._round_ns = 0
                    start = wire.now() - due[at]
                    continue
                self._steps -= 1
                start = now - due[at]
            target = start + due[at]
            if target > now:
                self._pass_time(target)
                if (now := wire.now()) < target:
                    continue
            last = at + 1
            if last < count and start + due[last] <= now and not self._paused:
                last = bisect_right(due, now - start, last, min(count, at + _BLOCK))
            if self._faults is None:
                report.sent += wire.send(out, at, last)
            else:
                self._spoil(out, at, last, now)
            report.last_ns = now
            report.first_ns = report.first_ns or now
            if self._table.period_ns:
                if last - at == 1:
                    report.lateness.add(now - target)
                else:
                    report.lateness.add_all(now - start - self._table.due_ns[at:last])
            at = last
        return start

    def _pass_time(self, until_ns: int) -> None:
        """Wait until a time, a round, or something that comes in."""
        held_ns = self._held_ns()
        if not self._wire.wait(min(until_ns, self._round_ns, until_ns if held_ns is None else held_ns)):
            self._round_ns = 0
        now = self._wire.now()
        if now >= self._round_ns:
            self._look_around()
        if self._faults and held_ns is not None and now >= held_ns:
            self._deliver(self._faults.due(now + self._epoch_ns), now)

    def _held_ns(self) -> int | None:
        """Return when a datagram that a fault holds back is due; faults tell time since 1970."""
        held_ns = self._faults.next_ns if self._faults else None
        return None if held_ns is None else held_ns - self._epoch_ns

    def _look_around(self) -> int:
        """Take what came in, keep the session alive, obey the keyboard; return the time."""
        now = self._wire.now()
        session = self._session
        for item in self._wire.receive():
            self.report.seen.add(item.link, item.payload, now + self._epoch_ns)
            if session is not None and item.link is Link.SBN:
                self._put(session.receive_datagram(item.payload, now=now))
        if session is not None:
            if now - self.report.last_ns < _ROUND_NS:
                session.sent(now=now)
            if now >= session.next_ns:
                self._put(session.service(now=now))
        self._refusals(now)
        for key in self._keys.pressed() if self._keys else "":
            self._obey(key)
        if self._watcher is not None:
            self._watcher.update(self.report)
        self._round_ns = now + _ROUND_NS
        return now

    def _put(self, datagrams: Iterable[bytes]) -> None:
        for data in datagrams:
            self._wire.put(data)

    def _refusals(self, now: int) -> None:
        refused = self._wire.statistics.refused > self._refused
        if refused and self.report.first_ns and now - self.report.first_ns < _BARREN_NS:
            raise CaptureError(
                f"{self._name} refuses: nobody listens there (ICMP port unreachable); start what shall "
                "receive, or say where it is with --target"
            )

    def _obey(self, key: str) -> None:
        if key == "q":
            self.stop()
        elif key == " ":
            self._paused = not self._paused
        elif key in "n\n":
            self._steps += self._paused

    def _listen(self, linger_ns: int) -> None:
        until = self._wire.now() + linger_ns
        while (now := self._look_around()) < until and not self.stopped:
            self._wire.wait(min(now + _ROUND_NS, until))

    def _spoil(self, out: Outgoing, first: int, last: int, now: int) -> None:
        assert self._faults is not None
        to_cfs = out.link is not Link.TO
        for index in range(first, last):
            deliveries, faults = self._faults.apply(
                out[index], link=out.link, to_cfs=to_cfs, now=now + self._epoch_ns
            )
            for fault in faults:
                self.report.faults[fault.kind] = self.report.faults.get(fault.kind, 0) + 1
            if faults:
                self._note(faults)
            self._deliver(deliveries, now)

    def _deliver(self, deliveries: Iterable[Delivery], now: int) -> None:
        for item in deliveries:
            self.report.sent += self._wire.put(item.payload)
            self.report.last_ns = now


def in_order(out: Outgoing, table: Timetable) -> Outgoing:
    """Return datagrams in the order of their timetable."""
    same = np.array_equal(table.order, np.arange(len(table.order)))
    return out if same else out.take(table.order)
