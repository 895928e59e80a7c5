"""Messages on their way from the threads of a middleware to the one thread that bridges."""

from __future__ import annotations

import os
import time
from collections import deque
from contextlib import suppress
from itertools import islice
from typing import TYPE_CHECKING, Final, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Callable

MOST: Final = 1 << 17
"""Messages that wait at the most; what is more is lost, and counted."""


class Heard(NamedTuple):
    """One message.

    Attributes:
        station: number of the bridge that it is for.
        route: its place in the bridge's routes.
        cdr: the message.
        time_ns: when it was heard, monotonic.
    """

    station: int
    route: int
    cdr: bytes
    time_ns: int


class Inbox:
    """A queue that wakes up who waits for its descriptor.

    Attributes:
        overflowed: messages lost because ``MOST`` waited.
    """

    def __init__(self) -> None:
        self.overflowed = 0
        self._items: deque[Heard] = deque()
        self._fileno = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._rung = False

    def __len__(self) -> int:
        return len(self._items)

    def fileno(self) -> int:
        """Return the descriptor, which is readable when something waits."""
        return self._fileno

    def ring(self) -> None:
        """Wake up who waits; for any thread or signal handler, and for nothing once it is closed."""
        if self._fileno >= 0:
            os.eventfd_write(self._fileno, 1)

    def slot(self, station: int, route: int) -> Callable[[bytes], None]:
        """Return what takes the messages of a route, from any thread; it does not block."""
        items, now = self._items, time.monotonic_ns

        def heard(cdr: bytes) -> None:
            if len(items) >= MOST:
                self.overflowed += 1
                return
            items.append(Heard(station, route, cdr, now()))
            if not self._rung:  # many messages, one system call
                self._rung = True
                self.ring()

        return heard

    def take(self, most: int) -> list[Heard]:
        """Return what waits, the oldest first."""
        items = self._items
        return [items.popleft() for _ in islice(range(len(items)), most)]

    def quiet(self) -> None:
        """Stop being readable until the next message; call it before ``take``."""
        with suppress(BlockingIOError):
            os.eventfd_read(self._fileno)
        # In this order: what comes in between is taken without a ring, what comes later rings again.
        self._rung = False

    def close(self) -> None:
        """Give the descriptor back."""
        fileno, self._fileno = self._fileno, -1
        if fileno >= 0:
            os.close(fileno)
