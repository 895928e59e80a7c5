"""The queue from the threads of a middleware to the one thread that runs the bridges."""

from __future__ import annotations

import os
import time
from collections import deque
from contextlib import suppress
from itertools import islice
from typing import TYPE_CHECKING, Final, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Callable

_MOST_WAITING: Final = 1 << 17
"""Maximum messages that wait; further ones are lost, and counted."""


class GraphMessage(NamedTuple):
    """One message.

    Attributes:
        station: number of the bridge that receives it.
        route: index into the bridge's routes.
        cdr: the message.
        time_ns: when it arrived, monotonic.
    """

    station: int
    route: int
    cdr: bytes
    time_ns: int


class Inbox:
    """A queue with a file descriptor: a thread that polls the descriptor wakes up when a message comes.

    Attributes:
        overflowed: messages lost because ``_MOST_WAITING`` messages were in the queue.
    """

    def __init__(self) -> None:
        self.overflowed = 0
        self._items: deque[GraphMessage] = deque()
        self._fileno = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._rung = False

    def __len__(self) -> int:
        return len(self._items)

    def fileno(self) -> int:
        """Return the descriptor, which is readable when messages are in the queue."""
        return self._fileno

    def ring(self) -> None:
        """Wake the thread that polls; for any thread or signal handler; no effect after ``close``."""
        if self._fileno >= 0:
            os.eventfd_write(self._fileno, 1)

    def slot(self, station: int, route: int) -> Callable[[bytes], None]:
        """Return a function that queues messages of a route; for any thread; it does not block."""
        items, now = self._items, time.monotonic_ns

        def heard(cdr: bytes) -> None:
            if len(items) >= _MOST_WAITING:
                self.overflowed += 1
                return
            items.append(GraphMessage(station, route, cdr, now()))
            if not self._rung:  # many messages, one system call
                self._rung = True
                self.ring()

        return heard

    def take(self, most: int) -> list[GraphMessage]:
        """Return messages from the queue, the oldest first, at most ``most``."""
        items = self._items
        return [items.popleft() for _ in islice(range(len(items)), most)]

    def reset_signal(self) -> None:
        """Make the descriptor unreadable until the next message; call it before ``take``."""
        with suppress(BlockingIOError):
            os.eventfd_read(self._fileno)
        # In this order: messages that arrive in between are taken without a wake-up, later ones wake again.
        self._rung = False

    def close(self) -> None:
        """Close the descriptor."""
        fileno, self._fileno = self._fileno, -1
        if fileno >= 0:
            os.close(fileno)
