"""A thread for all nodes of a demo: it sleeps until something is due or somebody asks."""

from __future__ import annotations

import heapq
import threading
import time
from itertools import count
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Any, Final

from edoras_tools.sessions.profile import SECOND

if TYPE_CHECKING:
    from collections.abc import Callable

_BEHIND_NS: Final = SECOND // 4
"""Who is later than this does not make up for what was missed."""

if TYPE_CHECKING:
    Call = Callable[..., None]


class Agenda:
    """Does what is due and what it is asked, one after the other, from ``start`` to ``close``."""

    def __init__(self) -> None:
        self._asked: SimpleQueue[tuple[Call, tuple[Any, ...]] | None] = SimpleQueue()
        self._due: list[tuple[int, int, int, Call]] = []
        self._numbers = count()
        self._thread = threading.Thread(target=self._run, name="demo nodes", daemon=True)

    def ask(self, call: Call, *arguments: Any) -> None:
        """Have something done soon; for any thread."""
        self._asked.put((call, arguments))

    def every(self, hertz: float, call: Call) -> None:
        """Have something done at a rate from now on; on the agenda's own thread."""
        self._put(time.monotonic_ns(), int(SECOND / hertz), call)

    def at(self, due_ns: int, call: Call) -> None:
        """Have something done once, at a time of the monotonic clock; before ``start``, or on its thread."""
        self._put(due_ns, 0, call)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def close(self) -> None:
        """End; calling it again, or before it began, does nothing."""
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
