"""The arrivals at the pipes and sockets of an emulated cFS: where and when each one ended.

The emulator keeps this account in addition to cFS's own counters. A diagnosis of the same traffic is judged
by it. Rules:

1. An arrival is a packet at one pipe, or a datagram at one socket: a packet at two pipes is two arrivals.
2. It waits until its pipe or socket is read or closed; a queue is read in the order of arrival.
3. The account ends there: it does not contain what the reader does with the packet.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
from functools import partial
from typing import Final, Generic, TypeVar

import msgspec

from edoras_tools.cfs.queues import NO_LIMIT, QueueEnd, admission

_Message = TypeVar("_Message")
LOST: Final = frozenset({QueueEnd.MSG_LIMIT, QueueEnd.PIPE_OVERFLOW, QueueEnd.SOCKET_FULL, QueueEnd.CLOSED})


def _ignore(_msg_id: int, _end: QueueEnd) -> None:
    """Do nothing."""


class Fifo(msgspec.Struct, Generic[_Message], eq=False):
    """A first-in, first-out queue with message limits.

    Attributes:
        depth: messages that fit.
        limits: MsgId to the number of its messages that may wait; a MsgId that is absent has no limit.
        messages: MsgId and message of each waiting message, oldest first.
        waiting: MsgId to the number of its waiting messages.
        on_change: called with a MsgId and ``WAITING`` for a message that enters, ``DELIVERED`` for one that
            is read, ``CLOSED`` for one in the queue when it was cleared, else the reason of the refusal.
    """

    depth: int
    limits: dict[int, int] = msgspec.field(default_factory=dict)
    messages: deque[tuple[int, _Message]] = msgspec.field(default_factory=deque)
    waiting: Counter[int] = msgspec.field(default_factory=Counter)
    on_change: Callable[[int, QueueEnd], object] = _ignore

    def put(self, message: _Message, msg_id: int = 0) -> QueueEnd:
        """Add a message if ``admission`` accepts it; return the result of ``admission``."""
        limit = self.limits.get(msg_id, NO_LIMIT)
        outcome = admission(self.waiting[msg_id], limit, len(self.messages), self.depth)
        if outcome is QueueEnd.WAITING:
            self.messages.append((msg_id, message))
            self.waiting[msg_id] += 1
        self.on_change(msg_id, outcome)
        return outcome

    def get(self) -> _Message | None:
        """Remove and return the oldest message; None if there is none."""
        if not self.messages:
            return None
        msg_id, message = self.messages.popleft()
        self.waiting[msg_id] -= 1
        self.on_change(msg_id, QueueEnd.DELIVERED)
        return message

    def clear(self) -> None:
        """Drop all waiting messages."""
        for msg_id, _ in self.messages:
            self.on_change(msg_id, QueueEnd.CLOSED)
        self.messages.clear()
        self.waiting.clear()

    def __len__(self) -> int:
        return len(self.messages)


class QueueArrival(msgspec.Struct):
    """A packet or datagram at one pipe or socket.

    Attributes:
        hop: name of the pipe, or ``socket PORT``.
        msg_id: MsgId on the bus; 0 at a socket, which does not read it.
        begin_ns: time of arrival, ns.
        end: end of the arrival; ``WAITING`` as long as it waits.
        end_ns: time of the end, ns; -1 as long as it waits.
    """

    hop: str
    msg_id: int
    begin_ns: int
    end: QueueEnd = QueueEnd.WAITING
    end_ns: int = -1


class ArrivalAccount:
    """All arrivals in an emulated cFS, over all its boots.

    Args:
        now: function that returns the time, ns.
        is_on: whether arrivals are recorded; a simulation without end would fill the memory.

    Attributes:
        arrivals: arrivals in order of time.
    """

    def __init__(self, now: Callable[[], int], *, is_on: bool) -> None:
        self._is_on = is_on
        self.arrivals: list[QueueArrival] = []
        self._now = now
        self._waiting: dict[str, deque[QueueArrival]] = {}

    def watch(self, queue: Fifo[_Message], hop: str) -> Fifo[_Message]:
        """Record the arrivals at a queue from now on; return the queue."""
        if self._is_on:
            queue.on_change = partial(self.note, hop)
        return queue

    def note(self, hop: str, msg_id: int, outcome: QueueEnd) -> None:
        """Record that a message entered a queue, left it, or was refused."""
        if not self._is_on:
            return
        now, waiting = self._now(), self._waiting.setdefault(hop, deque())
        if waiting and outcome in {QueueEnd.DELIVERED, QueueEnd.CLOSED}:
            arrival = waiting.popleft()
        else:
            arrival = QueueArrival(hop, msg_id, now)
            self.arrivals.append(arrival)
        if outcome is QueueEnd.WAITING:
            waiting.append(arrival)
        else:
            arrival.end, arrival.end_ns = outcome, now

    def close(self, *hops: str) -> None:
        """Record that queues were closed with their contents; all queues, if none is named."""
        for hop in hops or list(self._waiting):
            for arrival in self._waiting.pop(hop, ()):
                arrival.end, arrival.end_ns = QueueEnd.CLOSED, self._now()

    def losses(self, start_ns: int = 0) -> Counter[tuple[str, int, QueueEnd]]:
        """Return the number of arrivals lost since a time, by hop, MsgId and end."""
        return Counter(
            (item.hop, item.msg_id, item.end)
            for item in self.arrivals
            if item.end in LOST and item.end_ns >= start_ns
        )


def socket(port: int) -> str:
    """Return the name of a UDP port as a hop."""
    return f"socket {port}"
