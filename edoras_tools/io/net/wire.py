"""The network of a sender: datagrams are sent at their deadlines, and answers received meanwhile."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import select
import time
from typing import TYPE_CHECKING, Final, NamedTuple, Protocol

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from edoras_tools.io.net.transmit import Listener, SendStatistics, StreamTransmitter, Transmitter
    from edoras_tools.model import Endpoint, Link
    from edoras_tools.sessions.outgoing import Outgoing

SPIN_NS: Final = 200_000
"""Time before a deadline at which sleeping ends: waking a processor takes up to this long."""
_STILL_NS: Final = 10_000
"""Time before a deadline at which rehearsing ends: one rehearsal takes less, even with a cold cache."""
_SET_TIMER_SLACK: Final = 29  # PR_SET_TIMERSLACK


class Arrival(NamedTuple):
    """A datagram that was received.

    Attributes:
        link: the link of the socket that received it.
        payload: its bytes.
        source: its sender.
        destination: the address and port of that socket.
    """

    link: Link
    payload: bytes
    source: Endpoint
    destination: Endpoint


class Wire(Protocol):
    """A network to send to; time is monotonic, in ns."""

    @property
    def ends(self) -> tuple[Endpoint, Endpoint]:
        """The endpoints that datagrams are sent from and to."""

    @property
    def statistics(self) -> SendStatistics:
        """The counters of sent datagrams."""

    def now(self) -> int:
        """Return the time."""

    def epoch_ns(self) -> int:
        """Return the offset from this time to ns since 1970."""

    def wait(self, until_ns: int) -> bool:
        """Wait until ``until_ns``, or until something arrives; return whether the time was reached."""

    def send(self, out: Outgoing, first: int, last: int) -> int:
        """Send datagrams ``first`` up to ``last``, not included; return how many were sent."""

    def put(self, payload: bytes) -> bool:
        """Send one datagram of the caller's own; return whether it was sent."""

    def receive(self) -> list[Arrival]:
        """Return the datagrams that have arrived."""


class UdpWire:
    """Real sockets and the host's clock.

    Args:
        transmitter: socket that sends, and receives the answers.
        answers: link that these answers belong to.
        listeners: further sockets, each with its link.
        watched: further file descriptors that end a wait, e.g. of a keyboard.
    """

    def __init__(
        self,
        transmitter: Transmitter | StreamTransmitter,
        answers: Link,
        listeners: Sequence[tuple[Link, Listener]] = (),
        watched: Sequence[int] = (),
    ) -> None:
        self._transmitter = transmitter
        self._sockets: list[tuple[Link, Transmitter | StreamTransmitter | Listener]] = [
            (answers, transmitter),
            *listeners,
        ]
        self._watched = [*(item.fileno() for _, item in self._sockets), *watched]
        self._latest: tuple[Outgoing, int] | None = None
        self.now = time.monotonic_ns
        self.ends = transmitter.local, transmitter.target

    @property
    def statistics(self) -> SendStatistics:
        """The counters of sent datagrams."""
        return self._transmitter.statistics

    def epoch_ns(self) -> int:
        """Return the offset from this time to ns since 1970."""
        return time.time_ns() - time.monotonic_ns()

    def wait(self, until_ns: int) -> bool:
        """Sleep until just before a time, then rehearse and spin; return early when something arrives."""
        now = self.now
        while (remaining_ns := until_ns - now() - SPIN_NS) > 0:
            if select.select(self._watched, (), (), remaining_ns / 1e9)[0]:
                return False
        while self._latest and until_ns - now() > _STILL_NS:
            self._transmitter.rehearse(_one(*self._latest))
        while now() < until_ns:
            pass
        return True

    def send(self, out: Outgoing, first: int, last: int) -> int:
        """Send datagrams ``first`` up to ``last``, not included; return how many were sent."""
        if last - first == 1:
            self._latest = out, first
            return self._transmitter.send(_one(out, first))
        return self._transmitter.send_many(out.data, out.offset[first:last], out.length[first:last])

    def put(self, payload: bytes) -> bool:
        """Send one datagram of the caller's own; return whether it was sent."""
        return self._transmitter.send(payload)

    def receive(self) -> list[Arrival]:
        """Return the datagrams that have arrived."""
        return [
            Arrival(link, data, source, item.local)
            for link, item in self._sockets
            for data, source in item.receive()
        ]


def _one(out: Outgoing, index: int) -> memoryview:
    """Return the bytes of a datagram without a copy."""
    start = int(out.offset[index])
    return out.data.data[start : start + int(out.length[index])]


@contextlib.contextmanager
def precise_timing() -> Iterator[None]:
    """Wake this thread without timer slack, and keep the garbage collector from pausing it."""
    collecting = gc.isenabled()
    gc.disable()
    _timer_slack(1)
    try:
        yield
    finally:
        _timer_slack(0)  # 0 restores the default
        if collecting:
            gc.enable()


def _timer_slack(slack_ns: int) -> None:
    with contextlib.suppress(AttributeError, OSError):  # Linux only
        ctypes.CDLL(None).prctl(_SET_TIMER_SLACK, ctypes.c_ulong(slack_ns), 0, 0, 0)
