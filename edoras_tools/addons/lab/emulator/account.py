"""What became of everything in an emulated cFS: each arrival at a pipe or socket, where and when it ended.

The emulator keeps it beside what cFS counts itself. It is the whole truth that a diagnosis of the same
traffic is judged by. Its rules:

1. An arrival is a packet at one pipe, or a datagram at one socket: two pipes have two.
2. It waits until its pipe or socket is read or closed; a queue is read in the order of arrival.
3. What its reader does with it afterwards is not told here.
"""

from __future__ import annotations

from collections import Counter, deque
from functools import partial
from typing import TYPE_CHECKING, Final, Generic, TypeVar

import msgspec

from edoras_tools.cfs.queues import NO_LIMIT, QueueEnd, admission

if TYPE_CHECKING:
    from collections.abc import Callable

_Message = TypeVar("_Message")
LOST: Final = frozenset({QueueEnd.MSG_LIMIT, QueueEnd.PIPE_OVERFLOW, QueueEnd.SOCKET_FULL, QueueEnd.CLOSED})


class Fifo(msgspec.Struct, Generic[_Message], eq=False):
    """A queue that messages enter and leave one at a time.

    Attributes:
        depth: messages that fit.
        limits: MsgId to the messages of it that may wait; one that is not here has no limit.
        messages: MsgId and message of those that wait, oldest first.
        waiting: MsgId to how many of it wait.
        on_change: called with MsgId and ``WAITING`` of a message that enters, ``DELIVERED`` of one that is
            read, ``CLOSED`` of one that was in a queue when it was cleared, else why it was not let in.
    """

    depth: int
    limits: dict[int, int] = msgspec.field(default_factory=dict)
    messages: deque[tuple[int, _Message]] = msgspec.field(default_factory=deque)
    waiting: Counter[int] = msgspec.field(default_factory=Counter)
    on_change: Callable[[int, QueueEnd], object] | None = None

    def put(self, message: _Message, msg_id: int = 0) -> QueueEnd:
        """Add a message where ``admission`` lets it in; return what it said."""
        limit = self.limits.get(msg_id, NO_LIMIT)
        outcome = admission(self.waiting[msg_id], limit, len(self.messages), self.depth)
        if outcome is QueueEnd.WAITING:
            self.messages.append((msg_id, message))
            self.waiting[msg_id] += 1
        if self.on_change:
            self.on_change(msg_id, outcome)
        return outcome

    def get(self) -> _Message | None:
        """Take the oldest message, or None."""
        if not self.messages:
            return None
        msg_id, message = self.messages.popleft()
        self.waiting[msg_id] -= 1
        if self.on_change:
            self.on_change(msg_id, QueueEnd.DELIVERED)
        return message

    def clear(self) -> None:
        """Drop what waits."""
        if self.on_change:
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
        msg_id: as on the bus; 0 at a socket, which knows none.
        begin_ns: time of its coming.
        end: ``WAITING`` as long as it waits.
        end_ns: time of its end; -1 as long as it waits.
    """

    hop: str
    msg_id: int
    begin_ns: int
    end: QueueEnd = QueueEnd.WAITING
    end_ns: int = -1


class ArrivalAccount:
    """Every arrival in an emulated cFS, over all its boots.

    Args:
        now: returns the time in ns.
        is_on: whether anything is noted; a simulation without end would fill the memory.

    Attributes:
        arrivals: in order of their coming.
    """

    def __init__(self, now: Callable[[], int], *, is_on: bool) -> None:
        self._is_on = is_on
        self.arrivals: list[QueueArrival] = []
        self._now = now
        self._waiting: dict[str, deque[QueueArrival]] = {}

    def watch(self, queue: Fifo[_Message], hop: str) -> Fifo[_Message]:
        """Note from now on what becomes of everything in a queue; return it."""
        if self._is_on:
            queue.on_change = partial(self.note, hop)
        return queue

    def note(self, hop: str, msg_id: int, outcome: QueueEnd) -> None:
        """Note that something entered a queue, left it, or was not let in."""
        if not self._is_on:
            return
        now, waiting = self._now(), self._waiting.setdefault(hop, deque())
        if waiting and outcome in {QueueEnd.DELIVERED, QueueEnd.CLOSED}:
            arrival = waiting.popleft()
            arrival.end, arrival.end_ns = outcome, now
            return
        arrival = QueueArrival(hop, msg_id, now)
        self.arrivals.append(arrival)
        if outcome is QueueEnd.WAITING:
            waiting.append(arrival)
        else:
            arrival.end, arrival.end_ns = outcome, now

    def close(self, *hops: str) -> None:
        """Note that queues are gone with what is in them; all, where none is named."""
        for hop in hops or list(self._waiting):
            for arrival in self._waiting.pop(hop, ()):
                arrival.end, arrival.end_ns = QueueEnd.CLOSED, self._now()

    def losses(self, start_ns: int = 0) -> Counter[tuple[str, int, QueueEnd]]:
        """Return how many arrivals were lost since a time, by hop, MsgId and end."""
        return Counter(
            (item.hop, item.msg_id, item.end)
            for item in self.arrivals
            if item.end in LOST and item.end_ns >= start_ns
        )


def socket(port: int) -> str:
    """Return the hop that a UDP port is."""
    return f"socket {port}"
