"""Processes that work on batches while this one reads and decodes the next ones.

Arrays go through shared memory, everything else is pickled through a socket. The rules:

1. The processes take turns, so results come in the order of the tasks. Each has at most ``_SLOTS`` tasks
   whose results were not taken; whoever submits more takes the oldest first.
2. What is lent to a source to read into is not copied. It is lent again when the tasks that use it are done.
3. A process ends when the other end of its socket is closed.
"""

from __future__ import annotations

import os
import select
from collections import deque
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from edoras_tools.io.forked import await_end, fork, portable, receive, send, undisturbed
from edoras_tools.io.processors import spare_processors
from edoras_tools.io.shared import ROOM_BYTES, SLOT_BYTES, Packed, pickled, place, shared_memory, unpickled

if TYPE_CHECKING:
    import socket
    from collections.abc import Callable, Iterator

    from numpy.typing import NDArray

    from edoras_tools.errors import CaptureError

_SLOTS: Final = 3
"""Tasks of each process: the one that it works on, and others, so that it never waits for whoever submits."""
_STANDARD_ERROR: Final = 2


class Workers:
    """Forked processes that run a function; only on Linux.

    Args:
        count: how many, at least 1.
        work: what they run, as it is at ``start``; its arguments and its result are pickled.
        killed: what is raised where one of them was killed.
        yields: see ``crowded``.

    Raises:
        OSError: no memory.
    """

    def __init__(
        self, count: int, work: Callable[..., Any], killed: CaptureError, *, yields: bool = False
    ) -> None:
        self._killed, self._yields = killed, yields
        self._crowds = 0
        self._tasks = _SLOTS * count
        self._used = [0] * (self._tasks + 1)
        """The number of the last task that used each room, from 1."""
        self._lent = len(self._used) * ROOM_BYTES
        size = self._lent + 2 * self._tasks * SLOT_BYTES
        self._memory: NDArray[np.uint8] = shared_memory(size)
        self._room = 0
        self._asked = self._answered = 0
        self._results: deque[tuple[Exception | None, Any]] = deque()
        self._links: list[socket.socket] = []
        self._processes: list[int] = []
        self._count, self._work = count, work

    def start(self) -> None:
        """Fork the processes at the first call; the later that is, the more of what they need is made."""
        with suppress(OSError):  # then there are fewer, or none
            for _ in range(self._count):
                process, link = fork(partial(_serve, self._work, self._memory, self._lent))
                self._processes.append(process)
                self._links.append(link)
        self._count = 0

    def lend(self, size: int) -> NDArray[np.uint8]:
        """Return memory to read into: u8, ``size`` bytes; tasks that use it need not copy it.

        It belongs to the caller until this has been called as many times as there are rooms; the call waits
        until its former contents are no longer read.
        """
        if size > ROOM_BYTES:
            return np.empty(size, np.uint8)
        self._room = (self._room + 1) % len(self._used)
        self._await(self._used[self._room])
        begin = self._room * ROOM_BYTES
        return self._memory[begin : begin + size]

    @property
    def waiting(self) -> int:
        """How many results can be taken, now or later."""
        return self._asked - self._answered + len(self._results)

    @property
    def ready(self) -> bool:
        """Whether the oldest result can be taken without waiting."""
        if not self._results and self._answered < self._asked:
            return bool(select.select([self._next], [], [], 0)[0])
        return bool(self._results)

    def crowded(self) -> bool:
        """Look whether the processes yield, and others run on all processors: a task is done no sooner here.

        Something short may run just now: only a second look in a row that finds no processor tells so.
        """
        if not self._yields:
            return False
        works = self._answered < self._asked and not select.select([self._next], [], [], 0)[0]
        self._crowds = self._crowds + 1 if spare_processors() < (0 if works else 1) else 0
        return self._crowds > 1

    @property
    def _next(self) -> socket.socket:
        """Where the next answer comes from."""
        return self._links[self._answered % len(self._links)]

    @property
    def full(self) -> bool:
        """Whether a result must be taken before the next task, or there is no process."""
        return self.waiting >= _SLOTS * len(self._processes)

    def submit(self, *values: Any) -> None:
        """Hand over the arguments of a task; afterwards only lent memory is still read."""
        assert not self.full, "results must be taken first"
        rooms: set[int] = set()

        def lent(data: NDArray[np.uint8]) -> int | None:
            at = place(data, self._memory)
            if not 0 <= at < self._lent:
                return None
            rooms.add(at // ROOM_BYTES)
            return at

        slot = self._asked % self._tasks
        request = pickled(values, self._memory, self._lent + 2 * slot * SLOT_BYTES, lent, size=SLOT_BYTES)
        link = self._links[self._asked % len(self._links)]
        self._asked += 1
        with undisturbed():
            try:
                send(link, (slot, request))
            except OSError:
                self._gone()
        for room in rooms:
            self._used[room] = self._asked

    def take(self) -> Any:
        """Wait for the oldest result, and return it; its arrays are valid until ``submit``.

        Raises:
            CaptureError: a process was killed.
            Exception: what the function raised.
        """
        self._await(self._asked - self.waiting + 1)
        failure, result = self._results.popleft()
        if failure is not None:
            raise failure
        return result

    def dismiss(self) -> None:
        """Let the processes end; results that were not taken are lost."""
        self._answered = self._asked
        self._results.clear()
        for link in self._links:
            link.close()

    def close(self) -> None:
        """Dismiss the processes, and wait until they have ended. Closing twice does nothing."""
        self.dismiss()
        while self._processes:
            await_end(self._processes.pop())

    def _await(self, task: int) -> None:
        """Wait until a task is done, perhaps long ago."""
        while self._answered < task:
            link = self._next
            select.select([link], [], [])
            with undisturbed():
                try:
                    failure, answer = receive(link)
                except (OSError, EOFError):
                    self._gone()
                    return
                self._answered += 1
                self._results.append((failure, answer and unpickled(answer, self._memory)))

    def _gone(self) -> None:
        self._results += [(self._killed, None)] * (self._asked - self._answered)
        self._answered = self._asked


class InOrder:
    """Runs a function on batches, one after the other; their results come in the same order.

    Args:
        work: the function; what it returns must not depend on the process that runs it.
        workers: run it too, if there are any.
    """

    def __init__(self, work: Callable[..., Any], workers: Workers | None = None) -> None:
        self._work, self._workers = work, workers
        self._made: deque[tuple[Any] | None] = deque()
        """The results that were not taken; None where a worker makes one."""

    def add(self, *values: Any, here: bool = False) -> None:
        """Run the function on some values.

        It runs here if all workers are busy, if no processor is free for them, or if that is asked for, as
        where nothing else is left to be done.
        """
        workers = self._workers
        if workers is not None and (here or workers.crowded()):
            workers = None
        if workers is not None:
            workers.start()
        if workers is None or workers.full:
            self._made.append((self._work(*values),))
        else:
            workers.submit(*values)
            self._made.append(None)

    def results(self, most: int | None = None) -> Iterator[Any]:
        """Yield the results that are there, and wait while there are more than ``most`` others.

        The arrays of a result are valid until the next one is asked for, or more is added.
        """
        while self._made:
            made, workers = self._made[0], self._workers
            if made is None and workers is not None:
                if not workers.ready and (most is None or len(self._made) <= most):
                    return
                made = (workers.take(),)
            del self._made[0]
            assert made is not None
            yield made[0]


def _serve(work: Callable[..., Any], memory: NDArray[np.uint8], lent: int, link: socket.socket) -> None:
    """Do tasks in a forked process, until the other end is closed."""
    # The output stays locked, and other processes wait, as long as this one has their files open.
    for number in map(int, os.listdir("/proc/self/fd")):  # noqa: PTH208  numbers, not paths
        if number > _STANDARD_ERROR and number != link.fileno():
            with suppress(OSError):  # the folder itself
                os.close(number)
    while True:
        slot, request = receive(link)
        failure: Exception | None = None
        answer: Packed | None = None
        try:
            result = work(*unpickled(request, memory))
            answer = pickled(result, memory, lent + (2 * slot + 1) * SLOT_BYTES, size=SLOT_BYTES)
        except Exception as error:  # noqa: BLE001  the one who takes the result gets it
            failure = portable(error)
        send(link, (failure, answer))
