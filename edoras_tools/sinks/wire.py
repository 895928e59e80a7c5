"""The wire as a sender sees it: datagrams out on their deadlines, and whatever comes back meanwhile."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import select
import time
from typing import TYPE_CHECKING, Final, NamedTuple, Protocol

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from edoras_tools.model import Endpoint, Link
    from edoras_tools.sessions.outgoing import Outgoing
    from edoras_tools.sinks.transmit import Listener, SendStatistics, Transmitter

SPIN_NS: Final = 200_000
"""How long before a deadline sleeping ends: a processor takes up to that long to wake up."""
_SET_TIMER_SLACK: Final = 29  # PR_SET_TIMERSLACK


class Arrival(NamedTuple):
    """A datagram that came back.

    Attributes:
        link: it belongs to, by the socket that it came to.
        payload: its bytes.
        source: who sent it.
        destination: where it came to.
    """

    link: Link
    payload: bytes
    source: Endpoint
    destination: Endpoint


class Wire(Protocol):
    """Where datagrams go; time is monotonic, in ns."""

    @property
    def ends(self) -> tuple[Endpoint, Endpoint]:
        """Where datagrams are sent from, and where to."""
        ...

    @property
    def statistics(self) -> SendStatistics:
        """What became of the datagrams."""
        ...

    def now(self) -> int:
        """Return the time."""
        ...

    def epoch_ns(self) -> int:
        """Return what to add to the time to have it since 1970."""
        ...

    def wait(self, until_ns: int) -> bool:
        """Let time pass; tell whether ``until_ns`` has come. It returns early when something arrives."""
        ...

    def send(self, out: Outgoing, first: int, last: int) -> int:
        """Send datagrams ``first`` up to ``last``, not included; return how many left."""
        ...

    def put(self, payload: bytes) -> bool:
        """Send one datagram of the caller's own; tell whether it left."""
        ...

    def receive(self) -> list[Arrival]:
        """Return what has arrived."""
        ...


class UdpWire:
    """Real sockets and the host's clock.

    Args:
        transmitter: sends, and receives what is answered to it.
        answers: the link that such answers belong to.
        listeners: further sockets, each with its link.
        watched: further descriptors that end a wait, as a keyboard's.
    """

    def __init__(
        self,
        transmitter: Transmitter,
        answers: Link,
        listeners: Sequence[tuple[Link, Listener]] = (),
        watched: Sequence[int] = (),
    ) -> None:
        self._transmitter = transmitter
        self._sockets: list[tuple[Link, Transmitter | Listener]] = [(answers, transmitter), *listeners]
        self._watched = [*(item.fileno() for _, item in self._sockets), *watched]
        self.now = time.monotonic_ns
        self.ends = transmitter.local, transmitter.target

    @property
    def statistics(self) -> SendStatistics:
        """What became of the datagrams."""
        return self._transmitter.statistics

    def epoch_ns(self) -> int:
        """Return what to add to the time to have it since 1970."""
        return time.time_ns() - time.monotonic_ns()

    def wait(self, until_ns: int) -> bool:
        """Sleep until just before a time, then spin; return early when something arrives."""
        now = self.now
        while (left := until_ns - now() - SPIN_NS) > 0:
            if select.select(self._watched, (), (), left / 1e9)[0]:
                return False
        while now() < until_ns:
            pass
        return True

    def send(self, out: Outgoing, first: int, last: int) -> int:
        """Send datagrams ``first`` up to ``last``, not included; return how many left."""
        if last - first == 1:
            start = int(out.offset[first])
            return self._transmitter.send(out.data.data[start : start + int(out.length[first])])
        return self._transmitter.send_many(out.data, out.offset[first:last], out.length[first:last])

    def put(self, payload: bytes) -> bool:
        """Send one datagram of the caller's own; tell whether it left."""
        return self._transmitter.send(payload)

    def receive(self) -> list[Arrival]:
        """Return what has arrived."""
        return [
            Arrival(link, data, source, item.local)
            for link, item in self._sockets
            for data, source in item.receive()
        ]


@contextlib.contextmanager
def precise_timing() -> Iterator[None]:
    """Have this thread woken when it asked for it, and not stopped by the garbage collector."""
    collecting = gc.isenabled()
    gc.disable()
    _timer_slack(1)
    try:
        yield
    finally:
        _timer_slack(0)  # the kernel's word for: as it was
        if collecting:
            gc.enable()


def _timer_slack(slack_ns: int) -> None:
    with contextlib.suppress(AttributeError, OSError):  # Linux only
        ctypes.CDLL(None).prctl(_SET_TIMER_SLACK, ctypes.c_ulong(slack_ns), 0, 0, 0)
