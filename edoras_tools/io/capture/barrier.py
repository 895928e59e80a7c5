"""Waits until the kernel has finished every packet that it had begun to write at the time of the call.

``membarrier(2)`` with ``MEMBARRIER_CMD_GLOBAL`` is a ``synchronize_rcu()`` (``kernel/sched/membarrier.c``).
The kernel delivers packets to sockets inside RCU read sections. If a thread saw a part of what a section
wrote before that call, it sees everything that the section wrote after it. The call takes some 10 ms and no
CPU time; where the processors are busy it takes up to seconds, so ``Barrier`` has a thread for it.
"""

from __future__ import annotations

import ctypes
import os
import platform
import threading
from functools import cache
from pathlib import Path
from queue import SimpleQueue
from typing import Final

_NUMBERS: Final = {"x86_64": 324, "aarch64": 283, "riscv64": 283, "armv7l": 389, "ppc64le": 365, "s390x": 356}
"""Number of the system call, by machine; the C library has no name for it."""
_QUERY: Final = 0
_GLOBAL: Final = 1 << 0
_REAL_TIME: Final = Path("/sys/kernel/realtime")


@cache
def available() -> bool:
    """Return whether this system has the call, and the call waits for sections.

    It is not available if processors run without a timer tick (``nohz_full``). A real-time kernel may
    interrupt a section to run a program, and on a single processor the call does not wait.
    """
    number = _NUMBERS.get(platform.machine())
    if number is None or ctypes.sizeof(ctypes.c_void_p) != ctypes.sizeof(ctypes.c_long):
        return False
    commands = _call(_QUERY)
    return commands > 0 and bool(commands & _GLOBAL) and not _REAL_TIME.exists()


def wait() -> bool:
    """Wait until every packet that the kernel has begun is complete; return whether it succeeded."""
    return _call(_GLOBAL) == 0


class Barrier:
    """Waits in a thread of its own. One ``ask`` at a time: the next one after its answer."""

    def __init__(self) -> None:
        self._asks: SimpleQueue[bool] = SimpleQueue()
        self._event = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._succeeded = False
        self._thread = threading.Thread(target=self._run, name="capture barrier", daemon=True)
        self._thread.start()

    def fileno(self) -> int:
        """Return a file descriptor that becomes readable with the answer."""
        return self._event

    def ask(self) -> None:
        """Begin to wait."""
        self._asks.put(True)

    def answer(self) -> bool | None:
        """Return whether waiting succeeded, once; None while it lasts."""
        try:
            os.eventfd_read(self._event)
        except BlockingIOError:
            return None
        return self._succeeded

    def close(self) -> None:
        """End the thread."""
        self._asks.put(False)
        self._thread.join()
        os.close(self._event)

    def _run(self) -> None:
        while self._asks.get():
            self._succeeded = wait()
            os.eventfd_write(self._event, 1)


def _call(command: int) -> int:
    return int(_syscall()(_NUMBERS[platform.machine()], command, 0, 0))


@cache
def _syscall() -> ctypes._NamedFuncPointer:
    return ctypes.CDLL(None, use_errno=True).syscall
