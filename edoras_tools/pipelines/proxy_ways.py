"""The ways through a proxy: who talks to whom, where it goes out, and what is counted on the way."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from edoras_tools.sessions.pacing import Lateness
from edoras_tools.sources.relay import ROOMS, SPARE, payload_of, send_one

if TYPE_CHECKING:
    import socket
    from collections.abc import Iterable

    from numpy.typing import NDArray

    from edoras_tools.sources.relay import Arena, Sent
    from edoras_tools.sources.sockaddr import Address

_LATE: Final = 4096
"""Latencies that wait to be counted: one by one it would cost more than the rest."""
assert _LATE >= ROOMS + SPARE


@dataclass(slots=True)
class Way:
    """One direction, as it is counted.

    Attributes:
        name: for people, as ``to 127.0.0.1:1234``.
        received: datagrams that came in.
        received_bytes: of their payloads.
        sent: datagrams that the system took, those made on the way included.
        refused: answers that nobody listens there (ICMP port unreachable).
        failed: datagrams that the system would not send.
        reason: why, of the last of them.
        queued: datagrams that wait because a socket is full.
        overflowed: datagrams lost because more waited than there is room for.
        kernel_drops: datagrams lost because the receive buffer was full.
        unclaimed: datagrams that came when there was no client to give them to.
        latency: from the kernel's receive time until the datagram was sent.
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
    latency: Lateness = field(default_factory=Lateness)
    _late: NDArray[np.int64] = field(default_factory=lambda: np.empty(_LATE, np.int64), repr=False)
    _lates: int = 0

    def note(self, late_ns: NDArray[np.int64]) -> None:
        """Take the latencies of some datagrams; ``fold`` counts them."""
        count = len(late_ns)
        if self._lates + count > _LATE:
            self.fold()
        self._late[self._lates : self._lates + count] = late_ns
        self._lates += count

    def fold(self) -> None:
        """Count the latencies taken so far."""
        self.latency.add_all(self._late[: self._lates])
        self._lates = 0

    def count(self, sent: Sent) -> None:
        """Note what became of datagrams."""
        self.sent += sent.done - sent.failed
        self.refused += sent.refused
        self.failed += sent.failed
        self.reason = sent.reason or self.reason

    def summary(self) -> dict[str, Any]:
        """Return the counts in the shape of ``proxy --json``."""
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
    """Where datagrams go out: a socket, an address, and a bounded queue for when the socket is full.

    Args:
        opened: the socket.
        to: where; None where it is connected.
        way: what is counted.
        queue_bytes: what may wait.
    """

    def __init__(self, opened: socket.socket, to: Address | None, way: Way, queue_bytes: int) -> None:
        self.socket = opened
        self.way = way
        self._to = to
        self._room = queue_bytes
        self._waiting: deque[bytes] = deque()

    @property
    def waits(self) -> bool:
        """Whether datagrams wait."""
        return bool(self._waiting)

    def send(self, arena: Arena, rows: int | NDArray[np.int64]) -> None:
        """Send rooms of the arena: so many from 0 on, or these."""
        first = 0
        if not self._waiting:
            sent = arena.send(self.socket, rows, self._to)
            self.way.count(sent)
            if not sent.full:
                return
            first = sent.done
        self._queue(
            payload_of(arena, row) for row in (range(rows) if isinstance(rows, int) else rows)[first:]
        )
        self.flush()

    def flush(self) -> None:
        """Send what waits, as far as the socket takes it."""
        while self._waiting:
            sent = send_one(self.socket, self._waiting[0], self._to)
            self.way.count(sent)
            if sent.full:
                return
            self._room += len(self._waiting.popleft())
            self.way.queued -= 1

    def close(self) -> None:
        """Give up what waits: it is lost."""
        self.way.queued -= len(self._waiting)
        self.way.overflowed += len(self._waiting)
        self._waiting.clear()

    def _queue(self, payloads: Iterable[bytes]) -> None:
        for payload in payloads:
            if len(payload) > self._room:
                self.way.overflowed += 1
            else:
                self._room -= len(payload)
                self._waiting.append(payload)
                self.way.queued += 1
