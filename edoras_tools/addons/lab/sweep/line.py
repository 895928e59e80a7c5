"""A measuring line to cFS: sends evenly spaced messages, receives answers, waits for the last ones."""

from __future__ import annotations

from threading import Event
from typing import TYPE_CHECKING, Final

from edoras_tools.errors import CaptureError
from edoras_tools.units import MILLISECOND, SECOND
from edoras_tools.wire import cfe

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from edoras_tools.addons.lab.sweep.observer import Mark, Observer
    from edoras_tools.io.net.wire import Wire
    from edoras_tools.pipelines.sending.wait_for import Condition
    from edoras_tools.sessions.sbn.connection import SbnConnection

_ROUND_NS: Final = 20 * MILLISECOND
_FRESH_NS: Final = 1200 * MILLISECOND
"""Age of an event from which later housekeeping shows that cFS had processed it: CI wakes up within 500 ms,
and TO sends within another 500 ms."""
_PATIENCE_NS: Final = 60 * SECOND
_SILENCE_NS: Final = 8 * SECOND
COMMAND_NS: Final = 700 * MILLISECOND
"""Time in which cFS reads a command."""


class Line:
    """Sends and listens.

    Args:
        name: name of the other end, for the user.
        observer: recorder of all datagrams sent and received.
        session: the SBN session that the traffic belongs to.

    Attributes:
        stopped: set it to end the sweep soon.
    """

    def __init__(self, wire: Wire, name: str, observer: Observer, session: SbnConnection | None) -> None:
        self.stopped = Event()
        self._wire, self._name, self._observer, self._session = wire, name, observer, session
        self._epoch_ns = wire.epoch_ns()

    def now(self) -> int:
        """Return monotonic time, ns."""
        return self._wire.now()

    def epoch(self) -> int:
        """Return the time, ns since 1970."""
        return self._wire.now() + self._epoch_ns

    def listen(self, duration_ns: int) -> None:
        """Receive for this time."""
        self._until(self._wire.now() + duration_ns)

    def until(self, condition: Callable[[], bool], timeout_ns: int) -> bool:
        """Receive until a condition holds; return whether it did in time."""
        end = self._wire.now() + timeout_ns
        while not condition():
            now = self._receive()
            if now >= end or self.stopped.is_set():
                return condition()
            self._wire.wait(min(end, now + _ROUND_NS))
        return True

    def open(self, conditions: Iterable[Condition], timeout_ns: int) -> None:
        """Wait until the other end answers.

        Raises:
            CaptureError: it does not answer; the text says what was tried.
        """
        began = self._wire.now()
        for condition in conditions:
            ask_ns = began
            while not condition.met() and not self.stopped.is_set():
                now = self._receive()
                if now - began >= timeout_ns:
                    raise CaptureError(condition.explain((now - began) / SECOND))
                if now >= ask_ns:
                    condition.ask()
                    ask_ns = now + SECOND
                self._wire.wait(now + _ROUND_NS)

    def command(self, packet: bytes) -> None:
        """Send one of the sweep's own commands, and wait until cFS has read it."""
        if not self.stopped.is_set():
            self._put(packet)
            self.listen(COMMAND_NS)

    def close(self, packets: Iterable[bytes]) -> None:
        """Send the commands that restore the state of cFS, without waiting, and disconnect."""
        for packet in packets:
            self._put(packet)
        for data in self._session.goodbye() if self._session else ():
            self._transmit(data)

    def evenly(self, packet: bytes, rate_hz: float, count: int) -> int:
        """Send a packet ``count`` times, each at its own deadline; return how often it was sent."""
        start = self._wire.now()
        for index in range(count):
            self._until(start + round(index * SECOND / rate_hz))
            if self.stopped.is_set():
                return index
            self._put(packet)
        self._until(start + round(count * SECOND / rate_hz))
        return count

    def settle(self) -> Mark:
        """Wait until no message is in transit: until two successive new reports of every counter are equal.

        Raises:
            CaptureError: cFS stopped sending.
        """
        began = self._wire.now()
        self.listen(_FRESH_NS)
        mark = self._observer.mark()
        while not self.stopped.is_set():
            self._observer.quiet(self.epoch())
            before, mark = mark, self._next_report(mark)
            if mark.counters == before.counters or self._wire.now() - began > _PATIENCE_NS:
                break
        return mark

    def _next_report(self, last: Mark) -> Mark:
        """Wait for the next 0x803; continue without it if none ever came."""
        if self.until(lambda: self._observer.mark().reports > last.reports, _SILENCE_NS):
            return self._observer.mark()
        if last.reports and not self.stopped.is_set():
            raise CaptureError(
                f"{self._name} stopped sending: no housekeeping for {_SILENCE_NS // SECOND} s; cFS has "
                "stopped, or telemetry was enabled for another address (TO sends to one address at a time)"
            )
        return last

    def _until(self, until_ns: int) -> None:
        while (now := self._receive()) < until_ns and not self.stopped.is_set():
            self._wire.wait(min(until_ns, now + _ROUND_NS))

    def _put(self, packet: bytes) -> None:
        session = self._session
        if session is not None:
            packet = session.frame(packet)
            session.sent(now=self._wire.now())
        self._transmit(packet)

    def _transmit(self, data: bytes) -> None:
        self._observer.sent(data, self.epoch())
        self._wire.put(data)

    def _receive(self) -> int:
        """Handle what arrived and keep the session alive; return the time."""
        now = self._wire.now()
        session = self._session
        answers: list[bytes] = []
        for item in self._wire.receive():
            self._observer.received(item.link, item.payload, now + self._epoch_ns)
            if session is not None and item.link.peers:
                answers += session.receive_datagram(item.payload, now=now).datagrams
        if session is not None and now >= session.next_ns:
            answers += session.service(now=now).datagrams
        for data in answers:
            self._transmit(data)
        if self._wire.statistics.refused:
            raise CaptureError(
                f"{self._name} refuses: no program listens there (ICMP port unreachable); start cFS or "
                "edoras sim, name it with --target, or sweep an emulated one with --sim"
            )
        return now


def reset_filters(headers: cfe.Headers) -> bytes:
    """Return the command that resets the event filters: after 16 of a kind, the bus sends no more events."""
    return cfe.emit_command(headers.msg_ids.of_known(0x1801), 14, b"CFE_SB".ljust(20, b"\0"), headers=headers)
