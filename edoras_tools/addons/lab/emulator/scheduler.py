"""Tasks on a few processors, in simulated time: they make messages wait, so that some are lost.

A task is a generator that yields requests to wait, similar to flight code's calls of the operating system::

    def ci_lab():
        while True:
            packet = yield Receive(pipe, timeout_ns=500_000_000)
            ...
            yield Work(8_000)

Rules:

1. A task that may run first waits for its latency, then in a queue for a processor.
2. After each ``Work`` it goes to the end of that queue.
3. Latencies come from a seeded generator: the same seed gives the same run.
4. Only ``Work`` takes processor time; code between two yields takes none.
"""

from __future__ import annotations

import heapq
import random
from collections import deque
from collections.abc import Callable, Generator
from typing import TYPE_CHECKING, Any, Protocol

import msgspec

if TYPE_CHECKING:
    from edoras_tools.cfs.profile import SimProfile

    Task = Generator["Receive | Sleep | SleepUntil | Work", Any, None]


class Waitable(Protocol):
    """An object that a task can wait for: a pipe, a socket."""

    def get(self) -> Any:
        """Remove and return the oldest item; None if there is none."""

    def __len__(self) -> int: ...


class Receive(msgspec.Struct, frozen=True):
    """Wait for an item; the ``yield`` returns it, or None after the time-out."""

    queue: Waitable
    timeout_ns: int | None = None


class Sleep(msgspec.Struct, frozen=True):
    """Wait for a duration in ns (``OS_TaskDelay``): a loop with it drifts by the time that its body takes."""

    ns: int


class SleepUntil(msgspec.Struct, frozen=True):
    """Wait until a time (a timer): a loop with it keeps an exact period."""

    time_ns: int


class Work(msgspec.Struct, frozen=True):
    """Use a processor for about this many ns, then let other tasks run."""

    ns: int


class Running(msgspec.Struct, eq=False):
    """A task and its request to wait. A time-out whose ``ticket`` is old is ignored."""

    steps: Task
    waits_on: Waitable | None = None
    ticket: int = 0
    value: Any = None
    is_done: bool = False


class Scheduler:
    """The clock, the processors and the tasks.

    Attributes:
        now: time, ns; never goes back.
    """

    def __init__(self, profile: SimProfile, *, start_ns: int) -> None:
        self.now = start_ns
        self._random = random.Random(profile.seed)  # noqa: S311  repeatable latencies, not secrets
        self._latency = profile.latency_ns
        self._jitter = profile.work_jitter
        self._free = profile.cores
        self._ready: deque[Running] = deque()
        self._waiting: dict[int, Running] = {}
        self._agenda: list[tuple[int, int, Callable[..., object], tuple[Any, ...]]] = []
        self._count = 0

    def spawn(self, steps: Task) -> Running:
        """Start a task now; return it, so that it can be ended."""
        task = Running(steps)
        self.call_at(self.now, self._enqueue, task)
        return task

    def end(self, task: Running) -> None:
        """End a task now, wherever it is."""
        task.steps = (_ for _ in ())
        next(task.steps, None)  # it is over, and takes any value of a request that it made before
        self._stop_waiting(task)
        task.value = None

    def call_at(self, time_ns: int, call: Callable[..., object], *arguments: Any) -> None:
        """Call a function that takes no processor time: the outside world, an interrupt."""
        self._count += 1
        heapq.heappush(self._agenda, (max(time_ns, self.now), self._count, call, arguments))

    def notify(self, queue: Waitable) -> None:
        """Wake the task that waits for a queue, after an item was put into it; it runs after its latency."""
        task = self._waiting.get(id(queue))
        if task is not None:
            self._stop_waiting(task)
            task.value = queue
            self._wake(task, self.now)

    @property
    def next_ns(self) -> int | None:
        """Time of the next event, ns; None if there is none."""
        return self._agenda[0][0] if self._agenda else None

    def run(self, until_ns: int) -> None:
        """Let time pass up to and including ``until_ns``."""
        agenda = self._agenda
        while agenda and agenda[0][0] <= until_ns:
            self.now, _, call, arguments = heapq.heappop(agenda)
            call(*arguments)
        self.now = max(self.now, until_ns)

    def _wake(self, task: Running, at_ns: int) -> None:
        self.call_at(at_ns + self._random.randint(*self._latency), self._enqueue, task)

    def _enqueue(self, task: Running) -> None:
        self._ready.append(task)
        self._dispatch()

    def _dispatch(self) -> None:
        while self._free and self._ready:
            self._free -= 1
            self._step(self._ready.popleft())

    def _timeout(self, task: Running, ticket: int) -> None:
        if task.ticket == ticket and task.waits_on is not None:
            self._stop_waiting(task)
            self._wake(task, self.now)

    def _stop_waiting(self, task: Running) -> None:
        self._waiting.pop(id(task.waits_on), None)
        task.waits_on = None
        task.ticket += 1

    def _work_done(self, task: Running) -> None:
        self._free += 1
        self._ready.append(task)
        self._dispatch()

    def _step(self, task: Running) -> None:
        """Run a task on its processor up to its next request to wait."""
        value, task.value = task.value, None
        if value is not None:
            value = value.get()
        while True:
            try:
                wish = task.steps.send(value)
            except StopIteration:
                task.is_done = True
                break
            value = None
            if isinstance(wish, Work):
                spread = int(wish.ns * self._jitter)
                took = wish.ns + (self._random.randint(-spread, spread) if spread else 0)
                self.call_at(self.now + took, self._work_done, task)
                return
            if isinstance(wish, Receive):
                if len(wish.queue):
                    value = wish.queue.get()
                    continue
                task.waits_on = wish.queue
                self._waiting[id(wish.queue)] = task
                if wish.timeout_ns is not None:
                    self.call_at(self.now + wish.timeout_ns, self._timeout, task, task.ticket)
                break
            at_ns = wish.time_ns if isinstance(wish, SleepUntil) else self.now + wish.ns
            self._wake(task, max(at_ns, self.now))
            break
        self._free += 1
