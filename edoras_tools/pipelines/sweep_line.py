"""A line to cFS that measures: evenly spaced messages out, an ear on what comes back, and waits for quiet."""

from __future__ import annotations

from threading import Event
from typing import TYPE_CHECKING, Final

from edoras_tools.errors import CaptureError
from edoras_tools.model import Link
from edoras_tools.sessions.profile import MILLISECOND, SECOND
from edoras_tools.wire import cfe, sbn

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from edoras_tools.pipelines.gates import Gate
    from edoras_tools.pipelines.sweep_evidence import Hearing, Mark
    from edoras_tools.sessions.sbn_client import Peering
    from edoras_tools.sinks.wire import Wire

_ROUND_NS: Final = 20 * MILLISECOND
_FRESH_NS: Final = 1200 * MILLISECOND
"""Housekeeping that is heard so long after something happened was made after cFS had taken it in: CI wakes up
within 500 ms, and TO sends within another 500 ms."""
_PATIENCE_NS: Final = 60 * SECOND
_SILENCE_NS: Final = 8 * SECOND
COMMAND_NS: Final = 700 * MILLISECOND
"""A command has been read by then."""


class Line:
    """Sends and listens.

    Args:
        wire: sockets, or an emulated cFS.
        name: how people call the other end.
        hearing: takes in what comes.
        session: the SBN session that all of this is part of.

    Attributes:
        stopped: set to end everything soon.
        sent: datagrams so far.
    """

    def __init__(self, wire: Wire, name: str, hearing: Hearing, session: Peering | None) -> None:
        self.stopped = Event()
        self.sent = 0
        self._wire, self._name, self._hearing, self._session = wire, name, hearing, session
        self._epoch_ns = wire.epoch_ns()

    def now(self) -> int:
        """Return the time, monotonic, ns."""
        return self._wire.now()

    def listen(self, duration_ns: int) -> None:
        """Let time pass with open ears."""
        self._until(self._wire.now() + duration_ns)

    def until(self, condition: Callable[[], bool], timeout_ns: int) -> bool:
        """Listen until something is so; tell whether it came to be."""
        end = self._wire.now() + timeout_ns
        while not condition():
            now = self._look_around()
            if now >= end or self.stopped.is_set():
                return condition()
            self._wire.wait(min(end, now + _ROUND_NS))
        return True

    def open(self, gates: Iterable[Gate], timeout_ns: int) -> None:
        """Wait until the other end answers.

        Raises:
            CaptureError: it does not; says what was tried.
        """
        began = self._wire.now()
        for gate in gates:
            ask_ns = began
            while not gate.open() and not self.stopped.is_set():
                now = self._look_around()
                if now - began >= timeout_ns:
                    raise CaptureError(gate.explain((now - began) / SECOND))
                if now >= ask_ns:
                    gate.ask()
                    ask_ns = now + SECOND
                self._wire.wait(now + _ROUND_NS)

    def command(self, packet: bytes) -> None:
        """Send a command of our own, and give cFS the time to take it."""
        if not self.stopped.is_set():
            self._put(packet)
            self.listen(COMMAND_NS)

    def last_words(self, packets: Iterable[bytes]) -> None:
        """Send what leaves cFS as it was found, without waiting, and say goodbye."""
        for packet in packets:
            self._put(packet)
        for data in self._session.goodbye() if self._session else ():
            self._wire.put(data)

    def evenly(self, packet: bytes, rate_hz: float, count: int) -> int:
        """Send a packet so often, each on its own deadline; return how often it was."""
        start = self._wire.now()
        for index in range(count):
            self._until(start + round(index * SECOND / rate_hz))
            if self.stopped.is_set():
                return index
            self._put(packet)
        self._until(start + round(count * SECOND / rate_hz))
        return count

    def settle(self) -> Mark:
        """Wait until nothing is on its way any more: two fresh, equal reports of every counter.

        Raises:
            CaptureError: cFS fell silent.
        """
        began = self._wire.now()
        self.listen(_FRESH_NS)
        mark = self._hearing.mark()
        while not self.stopped.is_set():
            before, mark = mark, self._next_report(mark)
            same = (mark.lost, mark.ingested) == (before.lost, before.ingested)
            if same or self._wire.now() - began > _PATIENCE_NS:
                break
        return mark

    def _next_report(self, last: Mark) -> Mark:
        """Wait for the next 0x803; where none ever came, do without."""
        if self.until(lambda: self._hearing.mark().heard > last.heard, _SILENCE_NS):
            return self._hearing.mark()
        if last.heard and not self.stopped.is_set():
            raise CaptureError(
                f"{self._name} fell silent: no housekeeping for {_SILENCE_NS // SECOND} s; it has stopped, "
                "or somebody enabled telemetry elsewhere (TO sends to one address at a time)"
            )
        return last

    def _until(self, until_ns: int) -> None:
        while (now := self._look_around()) < until_ns and not self.stopped.is_set():
            self._wire.wait(min(until_ns, now + _ROUND_NS))

    def _put(self, packet: bytes) -> None:
        session = self._session
        if session is not None:
            packet = sbn.emit(sbn.MsgType.APP, session.peer, packet)
            session.sent(now=self._wire.now())
        self._wire.put(packet)
        self.sent += 1

    def _look_around(self) -> int:
        """Take what came in and keep the session alive; return the time."""
        now = self._wire.now()
        session = self._session
        answers: list[bytes] = []
        for item in self._wire.receive():
            self._hearing.add(item.link, item.payload, now + self._epoch_ns)
            if session is not None and item.link is Link.SBN:
                answers += session.receive_datagram(item.payload, now=now)
        if session is not None and now >= session.next_ns:
            answers += session.service(now=now)
        for data in answers:
            self._wire.put(data)
        if self._wire.statistics.refused:
            raise CaptureError(
                f"{self._name} refuses: nobody listens there (ICMP port unreachable); start cFS or "
                "edoras sim, name it with --target, or sweep an emulated one with --sim"
            )
        return now


def reset_filters() -> bytes:
    """Return the command that has the software bus report losses anew: its events stop after 16 of a kind."""
    return cfe.emit_command(0x1801, 14, b"CFE_SB".ljust(20, b"\0"))
