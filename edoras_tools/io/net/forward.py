"""Forwarded datagrams: the counters of each direction, and sockets that send, with bounded queues."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, Final

import msgspec
import numpy as np

from edoras_tools.io.net.buffer import SLOTS, SPARE, DatagramBuffer
from edoras_tools.io.net.sockets import Address, SendResult, send_one
from edoras_tools.sessions.pacing import Lateness

if TYPE_CHECKING:
    import socket

    from edoras_tools.wire.arrays import Integers

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
