"""The processors of this machine: the number of free ones, and a real-time priority for one thread.

A program that shares work uses only free processors, and leaves the others to other programs.

On a busy machine a thread that wakes up waits milliseconds for a processor. Root, or a program with
CAP_SYS_NICE, may have a real-time priority (``sched(7)``, SCHED_FIFO): such a thread does not wait.

Rules of this priority:

1. A thread that uses much of a processor loses the priority until it uses little: other programs must run.
2. No priority is requested on a machine with one processor.
3. Threads and processes started meanwhile have the usual priority (SCHED_RESET_ON_FORK).
4. If the priority is not allowed, everything works without it.
"""

from __future__ import annotations

import os
import sys
import time
from contextlib import suppress
from pathlib import Path
from time import sleep
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from types import TracebackType

    from typing_extensions import Self

    from edoras_tools.io import Source


_LOAD: Final = Path("/proc/loadavg")


def spare_processors() -> int:
    """Return the number of further processes that have a processor now; below 0 if some wait for one.

    Running processes are counted on the whole machine, including this one (proc(5), ``loadavg``). If the
    count is not available, no other process is assumed to run.
    """
    processors = os.cpu_count() or 1
    if sys.platform != "linux":
        return processors - 1
    try:
        running = int(_LOAD.read_text().split()[3].partition("/")[0])
    except (OSError, ValueError, IndexError):
        return processors - 1
    return processors - max(running, 1)


_LEAST: Final = 1
"""The lowest real-time priority, which precedes all of normal priority."""
_LITTLE, _MUCH = 0.5, 0.7
"""Shares of a processor: below the first, the priority is given; above the second, it is taken."""
_LOOK_NS: Final = 20_000_000


class Precedence:
    """The real-time priority of the thread that enters this context; entering again restarts it."""

    def __init__(self) -> None:
        self._possible = hasattr(os, "sched_setscheduler") and len(os.sched_getaffinity(0)) > 1
        self._inside = self._first = False
        self._then = self._busy = 0

    def __enter__(self) -> Self:
        """Request the priority."""
        self._then, self._busy = time.monotonic_ns(), time.thread_time_ns()
        self._inside = True
        self._set(first=True)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Give the priority back."""
        self._inside = False
        self._set(first=False)

    def look(self) -> None:
        """Give or take the priority by the processor time since the last call; call it often."""
        now = time.monotonic_ns()
        if not (self._possible and self._inside) or now - self._then < _LOOK_NS:
            return
        busy = time.thread_time_ns()
        share = (busy - self._busy) / (now - self._then)
        self._then, self._busy = now, busy
        if self._first and share > _MUCH:
            self._set(first=False)
        elif not self._first and share < _LITTLE:
            self._set(first=True)

    def _set(self, *, first: bool) -> None:
        if not self._possible or first == self._first:
            return
        policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK if first else os.SCHED_OTHER
        try:
            os.sched_setscheduler(0, policy, os.sched_param(_LEAST if first else 0))
        except OSError:  # not allowed
            self._possible = False
        else:
            self._first = first


def run_soon() -> None:
    """Let the calling thread, which works little, wait less for a busy processor, if that is allowed."""
    with suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, 0, -10)


_LARGE: Final = 32 << 20
"""Smallest file, in bytes, that is worth several processes."""
_MOST_JOBS: Final = 3
"""Most processes: one reads and decodes; two others do the rest as fast as the first does its part."""
_LOOKS: Final = 5
_LOOK_S: Final = 0.002
"""Time between two looks at the free processors: a short program may just run at the first."""


def jobs_for(source: Source, number: int, *, fixed: bool = True) -> int:
    """Return how many processes share the work on a source.

    Args:
        source: source to read; a live one, a pipe or a small file is for one process.
        number: requested number; 0: the number of processor cores, at most three.
        fixed: whether the number stays, so that with 0 only the cores count that are free now.
    """
    if source.statistics.total_bytes < _LARGE:
        return 1
    if number:
        return number
    cores = len(os.sched_getaffinity(0)) if sys.platform == "linux" else 1
    others = min(_MOST_JOBS, cores) - 1
    return 1 + (_spare(others) if fixed else others)


def _spare(most: int) -> int:
    """Return the number of free processors, at most ``most``."""
    count = 0
    for look in range(_LOOKS if most else 0):
        if look:
            sleep(_LOOK_S)
        count = max(count, min(most, spare_processors()))
        if count == most:
            break
    return count
