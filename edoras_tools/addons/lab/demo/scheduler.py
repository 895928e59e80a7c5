"""The thread that runs all nodes of a demo: it sleeps until a call is due or requested."""

from __future__ import annotations

import heapq
import threading
import time
from itertools import count
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Any, Final

from edoras_tools.units import SECOND

if TYPE_CHECKING:
    from collections.abc import Callable

_BEHIND_NS: Final = SECOND // 4
"""A periodic call that is later than this does not make up for the missed ones."""

if TYPE_CHECKING:
    Call = Callable[..., None]


class CallScheduler:
    """Makes calls when they are due or requested, one at a time, from ``start`` to ``close``."""

    def __init__(self) -> None:
        self._asked: SimpleQueue[tuple[Call, tuple[Any, ...]] | None] = SimpleQueue()
        self._due: list[tuple[int, int, int, Call]] = []
        self._numbers = count()
        self._thread = threading.Thread(target=self._run, name="demo nodes", daemon=True)

    def ask(self, call: Call, *arguments: Any) -> None:
        """Request a call as soon as possible; from any thread."""
        self._asked.put((call, arguments))

    def every(self, hertz: float, call: Call) -> None:
        """Make a call at a rate from now on; only from the scheduler's thread."""
        self._put(time.monotonic_ns(), int(SECOND / hertz), call)

    def at(self, due_ns: int, call: Call) -> None:
        """Make a call once, at a monotonic time; before ``start``, or from the scheduler's thread."""
        self._put(due_ns, 0, call)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def close(self) -> None:
        """End the thread; does nothing if it has not started or has ended."""
        if self._thread.ident is not None:
            self._asked.put(None)
            self._thread.join()

    def _put(self, due_ns: int, period_ns: int, call: Call) -> None:
        heapq.heappush(self._due, (due_ns, next(self._numbers), period_ns, call))

    def _run(self) -> None:
        while True:
            now = time.monotonic_ns()
            while self._due and self._due[0][0] <= now:
                due_ns, _, period_ns, call = heapq.heappop(self._due)
                if period_ns:
                    self._put(max(due_ns, now - _BEHIND_NS) + period_ns, period_ns, call)
                call()
            wait_s = max(self._due[0][0] - time.monotonic_ns(), 0) / 1e9 if self._due else None
            try:
                item = self._asked.get(timeout=wait_s)
            except Empty:
                continue
            if item is None:
                return
            call, arguments = item
            call(*arguments)
