"""UDP sockets for senders with deadlines: one sends to one target, one only listens; the network around them.

Rules of a transmitter:

1. Its socket is connected, so that the kernel reports refusals, and blocks while it is full: nothing is lost
   on this machine.
2. A single datagram, which has a deadline, is sent by one system call without a copy. Many are sent by few
   system calls.
3. Each datagram is counted once, as sent or under its system error. A refusal is counted in addition: it
   answers a datagram that was sent.

``StreamTransmitter`` is one TCP connection that messages are sent on, with the interface of ``Transmitter``.
Rules that it keeps:

1. Each message is sent at once and whole. If the target reads slowly, sending waits for a limited time.
2. Bytes from the target are cut into messages as the link's ``Framing`` says.
3. A connection that is refused, breaks or ends is one error that names the target.

A ``Wire`` is the network of a sender: datagrams are sent at their deadlines, and answers received meanwhile.

``Outlet`` is a socket for forwarded datagrams, with a bounded queue; ``Direction`` has the counters of a way.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import gc
import os
import select
import socket
import time
from collections import Counter, deque
from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Protocol

import msgspec
import numpy as np

from edoras_tools.errors import CaptureError, OnFailure
from edoras_tools.io.net import sockets
from edoras_tools.io.net.buffer import SLOTS, SPARE, DatagramBuffer, SendMany, usable
from edoras_tools.io.net.sockets import Address, SendResult, resolve, send_one
from edoras_tools.sessions.pacing import Lateness

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from typing_extensions import Self

    from edoras_tools.links.doors import Framing
    from edoras_tools.model import Endpoint, Link
    from edoras_tools.sessions.outgoing import Outgoing
    from edoras_tools.wire.arrays import Integers, Octets

_MANY: Final = 512
"""Datagrams passed to the kernel at once."""
_BUFFER_BYTES: Final = 4 << 20
_MSG_PROBE: Final = 16
"""Flag of Linux with which ``send`` does everything except create the datagram."""
_INSTEAD: Final = "choose another with --listen"
_OR_NONE: Final = f"{_INSTEAD}, or receive no answers: --no-listen (edoras sim: --no-bridges)"


class SendStatistics(msgspec.Struct):
    """Counters of sent datagrams.

    Attributes:
        sent: number of datagrams that the kernel accepted.
        refused: number of answers that nothing listens there (ICMP port unreachable).
        errors: number of datagrams that failed, by system error.
    """

    sent: int = 0
    refused: int = 0
    errors: Counter[str] = msgspec.field(default_factory=Counter)

    def add(self, sent: sockets.SendResult) -> None:
        """Add the result of sending some datagrams."""
        self.sent += sent.accepted
        self.refused += sent.refused
        self.errors.update(sent.errors)


class _Port:
    """A socket that belongs to a context manager.

    Attributes:
        local: the address and port it is bound to.
    """

    def __init__(self, opened: socket.socket) -> None:
        self._socket = opened
        self.local = sockets.local_endpoint(opened)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def fileno(self) -> int:
        """Return the file descriptor, which becomes readable when something arrives."""
        return self._socket.fileno()

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class Transmitter(_Port):
    """A connected socket.

    Args:
        target: receiver of all datagrams.
        source: address and port to send from, where answers arrive; by default the system chooses.

    Attributes:
        target: resolved address.
        local: address and port that the socket is bound to.
        statistics: counters of sent datagrams.

    Raises:
        CaptureError: the target is unknown or cannot be reached, or the port is in use.
    """

    def __init__(self, target: Endpoint, source: Endpoint | None = None) -> None:
        self.statistics = SendStatistics()
        family, address = resolve(target, f"UDP {target}")
        opened = sockets.open_socket(family, _BUFFER_BYTES)
        with OnFailure(opened.close):
            opened.setblocking(True)
            if source is not None:
                sockets.bind(opened, resolve(source, f"UDP {source}")[1], f"UDP {source}", _INSTEAD)
            sockets.connect(opened, address, f"UDP {target}")
        super().__init__(opened)
        self.target = address.endpoint
        self._many = SendMany(_MANY, waits=True) if usable() else None
        self._rehearses = _probes()

    def send(self, payload: bytes | memoryview) -> bool:
        """Send one datagram; return whether the kernel accepted it."""
        sent = _full_as_error(sockets.send_one(self._socket, payload))
        self.statistics.add(sent)
        return not sent.errors

    def rehearse(self, payload: bytes | memoryview) -> None:
        """Do the same as ``send`` up to the kernel's checks, without sending, to fill the processor's caches.

        After a sleep the caches are cold, and the next datagram would leave up to 10 us later.
        """
        if self._rehearses:
            sockets.send_one(self._socket, payload, flags=_MSG_PROBE)

    def send_many(self, data: Octets, offset: Integers, length: NDArray[np.int32]) -> int:
        """Send datagrams in order, as fast as possible; return how many the kernel accepted.

        Args:
            data: buffer that contains the datagrams, u8.
            offset: start of each, i64 (n,).
            length: bytes of each, i32 (n,).
        """
        if self._many is None:
            view, ends = data.data, (offset + length).tolist()
            return sum(self.send(view[a:b]) for a, b in zip(offset.tolist(), ends, strict=True))
        before, at = self.statistics.sent, 0
        base = offset.astype(np.uint64) + np.uint64(data.ctypes.data)
        while at < len(base):
            part = slice(at, at + _MANY)
            sent = _full_as_error(self._many.send(self._socket, base[part], length[part]))
            self.statistics.add(sent)
            at += sent.sent
        return self.statistics.sent - before

    def receive(self, most: int = 256) -> list[tuple[bytes, Endpoint]]:
        """Return the answers of the target, at most ``most`` datagrams, with their senders."""
        answers: list[tuple[bytes, Endpoint]] = []
        while True:
            try:
                answers.extend(sockets.received(self._socket, most - len(answers)))
            except ConnectionRefusedError:
                self.statistics.refused += 1
            except OSError as error:
                self.statistics.add(sockets.SendResult(1, errors={error.strerror or str(error): 1}))
                return answers
            else:
                return answers


class Listener(_Port):
    """A bound socket that only listens.

    Args:
        endpoint: address and port; with port 0 the system chooses one.

    Raises:
        CaptureError: it cannot be bound.
    """

    def __init__(self, endpoint: Endpoint) -> None:
        super().__init__(
            sockets.open_bound(endpoint, f"UDP {endpoint}", _OR_NONE, buffer_bytes=_BUFFER_BYTES)
        )

    def receive(self, most: int = 256) -> list[tuple[bytes, Endpoint]]:
        """Return the datagrams that have arrived, at most ``most``, with their senders."""
        return list(sockets.received(self._socket, most))


def _probes() -> bool:
    """Return whether this system supports ``_MSG_PROBE``; others would send the rehearsed datagram."""
    if not sockets.LINUX:
        return False
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as own:
        own.setblocking(False)
        try:
            own.bind(("127.0.0.1", 0))
            own.connect(own.getsockname())
            own.send(b"", _MSG_PROBE)
            own.recv(1)
        except BlockingIOError:  # nothing came
            return True
        except OSError:
            pass
    return False


def _full_as_error(sent: sockets.SendResult) -> sockets.SendResult:
    """Return the result for a blocking socket: one that accepts no more shows that memory is out."""
    if not sent.full:
        return sent
    reason = os.strerror(errno.ENOBUFS)
    return sent._replace(sent=sent.sent + 1, errors={**sent.errors, reason: sent.errors.get(reason, 0) + 1})


ANSWER_WITHIN_S: Final = 5.0
"""Longest wait for a connection, or for a target that does not read."""
_AT_ONCE: Final = 1 << 16


class StreamTransmitter(_Port):
    """A TCP connection on which messages are sent.

    Args:
        target: address that listens for the connection.

    Attributes:
        target: resolved address.
        local: address and port of this end.
        statistics: counters of messages.

    Raises:
        CaptureError: the target is unknown, refuses, or does not answer.
    """

    def __init__(self, target: Endpoint, framing: Framing) -> None:
        self.statistics = SendStatistics()
        self._framing, self._name, self._rest = framing, f"TCP {target}", b""
        family, address = resolve(target, self._name)
        opened = socket.socket(family, socket.SOCK_STREAM)
        try:
            opened.settimeout(ANSWER_WITHIN_S)
            opened.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            opened.connect(address.host)
        except OSError as error:
            opened.close()
            raise CaptureError(f"{self._name}: {_refusal(error)}") from error
        super().__init__(opened)
        self.target = address.endpoint

    def send(self, payload: bytes | memoryview) -> bool:
        """Send one message.

        Raises:
            CaptureError: the connection is broken, or the target does not read.
        """
        return bool(self._send(payload, 1))

    def rehearse(self, payload: bytes | memoryview) -> None:
        """Do nothing: TCP has no send that delivers nothing; see ``Transmitter.rehearse``."""

    def send_many(self, data: Octets, offset: Integers, length: NDArray[np.int32]) -> int:
        """Send messages one after the other; return their number; see ``Transmitter.send_many``.

        Raises:
            CaptureError: the connection is broken, or the target does not read.
        """
        view, ends = data.data, (offset + length).tolist()
        joined = b"".join(view[start:end] for start, end in zip(offset.tolist(), ends, strict=True))
        return self._send(joined, len(offset))

    def receive(self) -> list[tuple[bytes, Endpoint]]:
        """Return the messages that have arrived completely, with the target as their sender.

        Raises:
            CaptureError: the target closed the connection, or sends another protocol.
        """
        if not select.select([self._socket], (), (), 0)[0]:  # recv would block, up to the timeout of sends
            return []
        try:
            more = self._socket.recv(_AT_ONCE)
        except OSError as error:
            raise self._broken(error) from error
        if not more:
            raise CaptureError(f"{self._name}: closed the connection after {self.statistics.sent:,} messages")
        messages, self._rest, is_foreign = self._framing.cut(self._rest + more)
        if is_foreign:
            raise CaptureError(f"{self._name}: sends another protocol; name the target with --target")
        return [(message, self.target) for message in messages]

    def _send(self, octets: bytes | memoryview, count: int) -> int:
        try:
            self._socket.sendall(octets)
        except OSError as error:
            raise self._broken(error) from error
        self.statistics.sent += count
        return count

    def _broken(self, error: OSError) -> CaptureError:
        why = error.strerror or error
        if isinstance(error, TimeoutError):
            why = f"takes nothing for {ANSWER_WITHIN_S:g} s"
        return CaptureError(
            f"{self._name}: the connection broke after {self.statistics.sent:,} messages: {why}"
        )


def _refusal(error: OSError) -> str:
    if isinstance(error, ConnectionRefusedError):
        return "refuses the connection: no program listens there; start it, or name its address with --target"
    if isinstance(error, TimeoutError):
        return f"does not answer within {ANSWER_WITHIN_S:g} s; name another address with --target"
    return f"cannot be connected to: {error.strerror or error}; name another address with --target"


_SPIN_NS: Final = 200_000
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


class HostClock:
    """The host's clock for a ``Wire``.

    Args:
        watched: file descriptors that end a sleep, e.g. of a keyboard.

    Attributes:
        now: function that returns the time, monotonic, ns.
    """

    def __init__(self, watched: Sequence[int]) -> None:
        self.now = time.monotonic_ns
        self._watched = watched

    def epoch_ns(self) -> int:
        """Return the offset from this time to ns since 1970."""
        return time.time_ns() - time.monotonic_ns()

    def sleep(self, until_ns: int) -> bool:
        """Sleep until just before a time; return False, earlier, when something can be read."""
        while (remaining_ns := until_ns - self.now() - _SPIN_NS) > 0:
            if select.select(self._watched, (), (), remaining_ns / 1e9)[0]:
                return False
        return True


class UdpWire(HostClock):
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
        super().__init__([*(item.fileno() for _, item in self._sockets), *watched])
        self._latest: tuple[Outgoing, int] | None = None
        self.ends = transmitter.local, transmitter.target
        self.statistics, self.put = transmitter.statistics, transmitter.send

    def wait(self, until_ns: int) -> bool:
        """Sleep until just before a time, then rehearse and spin; return early when something arrives."""
        if not self.sleep(until_ns):
            return False
        now = self.now
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


_LATENCIES: Final = 4096
"""Most latencies that are collected before they are counted together, which is faster."""
assert _LATENCIES >= SLOTS + SPARE


class Direction(msgspec.Struct):
    """Counters of one direction.

    Attributes:
        name: name for the user, e.g. ``to 127.0.0.1:1234``.
        received: number of datagrams that came in.
        received_bytes: bytes of their payloads.
        sent: number of datagrams that the system accepted, including those made by the proxy.
        refused: number of answers that nothing listens there (ICMP port unreachable).
        failed: number of datagrams that the system did not send.
        reason: text of the last error.
        queued: number of datagrams that wait because a socket is full.
        overflowed: number of datagrams lost because the queue was full.
        kernel_drops: number of datagrams lost because the receive buffer was full.
        unclaimed: number of datagrams that came before any client was known.
        latency: time from the kernel's receipt until the datagram was sent.
    """

    name: str
    received: int = 0
    received_bytes: int = 0
    sent: int = 0
    refused: int = 0
    failed: int = 0
    reason: str = ""
    queued: int = 0
    overflowed: int = 0
    kernel_drops: int = 0
    unclaimed: int = 0
    latency: Lateness = msgspec.field(default_factory=Lateness)
    _latencies: Integers = msgspec.field(default_factory=lambda: np.empty(_LATENCIES, np.int64))
    _waiting_latencies: int = 0

    def add_latencies(self, latency_ns: Integers) -> None:
        """Add the latencies of some datagrams; ``count_latencies`` counts them."""
        count = len(latency_ns)
        if self._waiting_latencies + count > _LATENCIES:
            self.count_latencies()
        self._latencies[self._waiting_latencies : self._waiting_latencies + count] = latency_ns
        self._waiting_latencies += count

    def count_latencies(self) -> None:
        """Count the latencies added so far."""
        self.latency.add_all(self._latencies[: self._waiting_latencies])
        self._waiting_latencies = 0

    def count(self, sent: SendResult) -> None:
        """Count the outcome of sending datagrams."""
        self.sent += sent.accepted
        self.refused += sent.refused
        self.failed += sent.failed
        self.reason = ", ".join(sent.errors) or self.reason

    def summary(self) -> dict[str, Any]:
        """Return the counts in the form of ``proxy --json``."""
        return {
            "name": self.name,
            "received": self.received,
            "bytes": self.received_bytes,
            "sent": self.sent,
            "queued": self.queued,
            "refused": self.refused,
            "failed": self.failed,
            "reason": self.reason or None,
            "unclaimed": self.unclaimed,
            "kernel_drops": self.kernel_drops,
            "overflowed": self.overflowed,
            "latency_us": self.latency.summary(),
        }


class Outlet:
    """A sender: a socket, an address, and a bounded queue for when the socket is full.

    While datagrams are queued, later ones are queued after them, so the order is kept.


    Args:
        to: the receiver; None if the socket is connected.
        queue_bytes: maximum size of the queue.
    """

    def __init__(
        self, opened: socket.socket, to: Address | None, direction: Direction, queue_bytes: int
    ) -> None:
        self.socket = opened
        self.direction = direction
        self._to = to
        self._free_bytes = queue_bytes
        self._waiting: deque[bytes] = deque()

    @property
    def waits(self) -> bool:
        """Whether datagrams are queued."""
        return bool(self._waiting)

    def send(self, buffer: DatagramBuffer, slots: int | Integers) -> None:
        """Send slots of a buffer: their number from 0 on, or slot numbers."""
        first = 0
        if not self._waiting:
            sent = buffer.send(self.socket, slots, self._to)
            self.direction.count(sent)
            if not sent.full:
                return
            first = sent.sent
        rest = (range(slots) if isinstance(slots, int) else slots.tolist())[first:]
        self._queue(buffer.payload(slot) for slot in rest)
        self.flush()

    def flush(self) -> None:
        """Send queued datagrams until the socket is full."""
        while self._waiting:
            sent = send_one(self.socket, self._waiting[0], self._to)
            self.direction.count(sent)
            if sent.full:
                return
            self._free_bytes += len(self._waiting.popleft())
            self.direction.queued -= 1

    def close(self) -> None:
        """Count queued datagrams as lost."""
        self.direction.queued -= len(self._waiting)
        self.direction.overflowed += len(self._waiting)
        self._waiting.clear()

    def _queue(self, payloads: Iterable[bytes]) -> None:
        for payload in payloads:
            if len(payload) > self._free_bytes:
                self.direction.overflowed += 1
            else:
                self._free_bytes -= len(payload)
                self._waiting.append(payload)
                self.direction.queued += 1
