"""A forked process that answers requests through a socket, one at a time and in order; only on Linux.

Two threads that work in numpy pass Python's lock to each other hundreds of times per batch; two processes do
not.
"""

from __future__ import annotations

import ctypes
import gc
import os
import pickle
import signal
import socket
import sys
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any, Final

from edoras_tools.errors import CaptureError, EdorasError
from edoras_tools.io.signals import ENDING

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

_LENGTH_BYTES: Final = 8
"""Bytes of the length before every message."""
_PR_SET_PDEATHSIG: Final = 1
"""prctl(2): the signal that a process gets when its parent ends."""


def fork(serve: Callable[[socket.socket], None]) -> tuple[int, socket.socket]:
    """Run a function in a forked process; return its process id, and the socket to it.

    It is killed when its parent ends, so that no process keeps writing after its parent died. The signals
    that end a program stay blocked as during the fork: the parent handles them.

    Args:
        serve: called in the other process with its end of the socket; the process ends with it.

    Raises:
        OSError: no process can be forked.
    """
    if sys.platform != "linux":
        raise OSError("on other systems, libraries do not support fork")
    link, there = socket.socketpair()
    starter = os.getpid()
    with there, undisturbed():
        try:
            process = os.fork()
        except OSError:
            link.close()
            raise
        if not process:
            link.close()
            with suppress(BaseException):
                ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
                if os.getppid() != starter:  # the parent had already ended
                    os._exit(1)
                gc.freeze()  # a collection would write to all shared pages, and so copy them
                serve(there)
            os._exit(0)
    return process, link


def await_end(process: int) -> None:
    """Return when a forked process has ended."""
    with suppress(ChildProcessError):  # no child is left if SIGCHLD is ignored
        os.waitpid(process, 0)


@contextmanager
def undisturbed() -> Iterator[None]:
    """Delay Ctrl-C: after half a request or answer, the connection could not be used any more."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, ())
    try:  # a pending signal raises in the call that blocks, after it has blocked
        signal.pthread_sigmask(signal.SIG_BLOCK, ENDING)
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def send(link: socket.socket, value: Any) -> None:
    """Send a value to the other process.

    Raises:
        OSError: the process has ended.
    """
    data = pickle.dumps(value, protocol=5)
    link.sendall(len(data).to_bytes(_LENGTH_BYTES, "big") + data)


def receive(link: socket.socket) -> Any:
    """Return a value from the other process.

    Raises:
        OSError: the process has ended.
        EOFError: likewise.
    """
    size = int.from_bytes(_received(link, _LENGTH_BYTES), "big")
    return pickle.loads(_received(link, size))  # noqa: S301  from our own process


def _received(link: socket.socket, size: int) -> bytes:
    """Return so many bytes; where the process is stopped and goes on (Ctrl-Z), they come in parts."""
    parts = []
    while size:
        part = link.recv(size, socket.MSG_WAITALL)
        if not part:
            raise EOFError
        parts.append(part)
        size -= len(part)
    return b"".join(parts)


def portable(error: Exception) -> Exception:
    """Return an exception that can be pickled; if needed, another one with the same text."""
    try:
        pickle.loads(pickle.dumps(error))  # noqa: S301  our own data
    except Exception:  # noqa: BLE001  unpickling may fail in any way
        return CaptureError(
            str(error) if isinstance(error, EdorasError) else f"{type(error).__name__}: {error}"
        )
    return error


def killed(path: object) -> CaptureError:
    """Return the error for a process that was killed while it wrote a file."""
    return CaptureError(
        f"{path}: the process that wrote it was killed; `edoras recover {path}` repairs the file"
    )
