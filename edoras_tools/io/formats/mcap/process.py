"""A sink in a second process, so that it does not share Python's lock with reading and decoding.

Two threads that work in numpy pass that lock to each other hundreds of times per batch; two processes do not.
The arrays of a batch are in shared memory, everything else is pickled through a socket. Every request is
answered when it is done, in order, with nothing or with an exception; after a failure only the request to
close is carried out.
"""

from __future__ import annotations

import ctypes
import gc
import mmap
import os
import pickle
import select
import signal
import socket
import sys
from contextlib import contextmanager, suppress
from dataclasses import fields
from typing import TYPE_CHECKING, Any, Final, NoReturn, Protocol

import numpy as np

from edoras_tools.errors import CaptureError, EdorasError
from edoras_tools.io import Sink
from edoras_tools.io.signals import ENDING

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from edoras_tools.io.formats.watched import Keep, OutputLoss
    from edoras_tools.model import Columns, PacketBatch, SourceStatistics

_SLOTS: Final = 2
"""Batches under way: the one that is handed over, and the one that is written."""
_SLOT_BYTES: Final = 32 << 20
"""Space for the arrays of one batch; the rest goes through the socket. Only pages in use need memory."""
_ROOMS: Final = 3
_ROOM_BYTES: Final = 9 << 20
"""Memory for a source to read into, which need not be copied: for the current batch, and one per slot."""
_LENT: Final = _ROOMS * _ROOM_BYTES
_ALIGNMENT: Final = 64
_LENGTH_BYTES: Final = 8
"""Bytes of the length before every message."""
_PR_SET_PDEATHSIG: Final = 1
"""prctl(2): the signal that a process gets when its parent ends."""


class Filing(Sink, Protocol):
    """A sink that writes files."""

    @property
    def paths(self) -> Sequence[Path]:
        """The files written."""
        ...

    def abandon(self) -> None:
        """Close the output in its present state."""


class Apart:
    """A ``Sink`` that forwards to a sink in a forked process; only on Linux.

    Args:
        sink: open, with nothing written yet; from now on the other process owns it.
        statistics: of the source; the sink sees the values at the time when a batch was handed over.
        path: the file that is written, for errors.

    Attributes:
        paths: the files written; set by ``close``.
        losses: files that were removed; set by ``close``.
        keep: what was deleted, see ``WatchedSink``; set by ``close``.

    Raises:
        CaptureError: from ``write``, ``flush`` and ``close``: the process has ended. Exceptions of the sink
        are
            also raised, perhaps some calls later; ``close`` does not raise what was already raised.
        OSError: no process can be forked.
    """

    def __init__(self, sink: Filing, statistics: SourceStatistics, path: Path) -> None:
        if sys.platform != "linux":
            raise OSError("on other systems, libraries do not support fork")
        self.paths: list[Path] = []
        self.losses: list[OutputLoss] = []
        self.keep: Keep | None = None
        self._path = path
        self._statistics = statistics
        self._memory = np.frombuffer(mmap.mmap(-1, _LENT + _SLOTS * _SLOT_BYTES), np.uint8)
        self._asked = self._answered = 0
        self._failure: Exception | None = None
        self._told = False
        self._slot = self._room = 0
        self._used = [0] * _ROOMS
        """The last request that used each room."""
        self._link, there = socket.socketpair()
        starter = os.getpid()
        with there, _undisturbed():
            try:
                self._process = os.fork()
            except OSError:
                self._link.close()
                raise
            if not self._process:
                self._link.close()
                _serve(sink, statistics, self._memory, there, starter)
        sink.abandon()

    def lend(self, size: int) -> NDArray[np.uint8]:
        """Return memory to read into: u8, ``size`` bytes; data written from it need not be copied.

        It belongs to the caller until this has been called as many times as there are rooms; the call waits
        until its former contents are no longer read.
        """
        if size > _ROOM_BYTES:
            return np.empty(size, np.uint8)
        self._room = (self._room + 1) % _ROOMS
        self._await(self._used[self._room])
        begin = self._room * _ROOM_BYTES
        return self._memory[begin : begin + size]

    def write(self, batch: PacketBatch, columns: Columns) -> None:
        """Hand a batch over; afterwards only lent memory is still read."""
        self._await(self._asked - _SLOTS + 1)
        self._tell()
        at = _LENT + self._slot * _SLOT_BYTES
        end = at + _SLOT_BYTES
        places: list[tuple[int, int]] = []
        rooms: set[int] = set()

        def inside(buffer: pickle.PickleBuffer) -> bool:
            """Put an array into shared memory; return True if it has to stay in the pickle."""
            nonlocal at
            data = np.frombuffer(buffer.raw(), np.uint8)
            lent = _address(data) - _address(self._memory)
            if 0 <= lent < _LENT:
                rooms.add(lent // _ROOM_BYTES)
                places.append((lent, lent + len(data)))
                return False
            if at + len(data) > end:
                return True
            self._memory[at : at + len(data)] = data
            places.append((at, at + len(data)))
            at += -(-len(data) // _ALIGNMENT) * _ALIGNMENT
            return False

        body = pickle.dumps((batch, columns), protocol=5, buffer_callback=inside)
        number = self._ask("write", body, places, self._statistics)
        self._slot = (self._slot + 1) % _SLOTS
        for room in rooms:
            self._used[room] = number

    def flush(self) -> None:
        """Write everything received so far to the file."""
        self._await(self._ask("flush"))
        self._tell()

    def close(self, statistics: SourceStatistics) -> None:
        """Complete the output, and end the process; closing twice does nothing."""
        if not self._process:
            return
        process, self._process = self._process, 0
        try:
            closed = self._await(self._ask("close", statistics))
            if closed:
                paths, self.losses, self.keep = closed
                self.paths = list(paths)
        finally:
            self._link.close()
            with suppress(ChildProcessError):  # no child is left if SIGCHLD is ignored
                os.waitpid(process, 0)
        if not self._told:
            self._tell()

    def _ask(self, *request: Any) -> int:
        """Send a request; return its number."""
        self._asked += 1
        with _undisturbed():
            try:
                _send(self._link, (self._asked, *request))
            except OSError:
                self._gone()
        return self._asked

    def _await(self, request: int) -> Any:
        """Wait until a request is answered, perhaps long ago; return the answer if it is new."""
        answer = None
        while self._answered < request:
            select.select([self._link], [], [])
            with _undisturbed():
                try:
                    self._answered, failure, answer = _receive(self._link)
                except (OSError, EOFError):
                    self._gone()
                    return None
                self._failure = self._failure or failure
        return answer

    def _gone(self) -> None:
        self._answered = self._asked
        self._failure = self._failure or CaptureError(
            f"{self._path}: the process that wrote it was killed; "
            f"`edoras recover {self._path}` repairs the file"
        )

    def _tell(self) -> None:
        if self._failure is not None:
            self._told = True
            raise self._failure


@contextmanager
def _undisturbed() -> Iterator[None]:
    """Delay Ctrl-C: after half a request or answer, the connection could not be used any more."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, ())
    try:  # a pending signal raises in the call that blocks, after it has blocked
        signal.pthread_sigmask(signal.SIG_BLOCK, ENDING)
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _send(link: socket.socket, value: Any) -> None:
    data = pickle.dumps(value, protocol=5)
    link.sendall(len(data).to_bytes(_LENGTH_BYTES, "big") + data)


def _receive(link: socket.socket) -> Any:
    """Return a message from the other process.

    Raises:
        EOFError: the process has ended.
    """
    length = link.recv(_LENGTH_BYTES, socket.MSG_WAITALL)
    size = int.from_bytes(length, "big")
    data = link.recv(size, socket.MSG_WAITALL) if len(length) == _LENGTH_BYTES else b""
    if not data or len(data) < size:
        raise EOFError
    return pickle.loads(data)  # noqa: S301  from our own process


def _address(data: NDArray[np.uint8]) -> int:
    place: int = data.__array_interface__["data"][0]
    return place


def _serve(
    sink: Filing,
    statistics: SourceStatistics,
    memory: NDArray[np.uint8],
    link: socket.socket,
    starter: int,
) -> NoReturn:
    """Run in the forked process: serve requests until one asks to close, or the parent process has ended.

    It is killed when its parent ends, so that no process keeps writing after its parent died. The signals
    that end a program stay blocked as during the fork: the parent handles them.
    """
    with suppress(BaseException):
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != starter:  # the parent had already ended
            os._exit(1)
        gc.freeze()  # a collection would write to all shared pages, and so copy them
        failed = False
        kind = ""
        while kind != "close":
            try:
                number, kind, *values = _receive(link)
            except (OSError, EOFError):
                number, kind, values = 0, "close", [statistics]
            failure: Exception | None = None
            try:
                if kind == "close":
                    sink.close(*values)
                elif failed:
                    pass
                elif kind == "write":
                    _write(sink, statistics, memory, *values)
                else:
                    sink.flush()
            except Exception as error:  # noqa: BLE001  the caller in the other process gets it
                failed, failure = True, _portable(error)
            with suppress(OSError):  # the other process has ended: the next read shows it
                closed = (sink.paths, getattr(sink, "losses", []), getattr(sink, "keep", None))
                _send(link, (number, failure, closed if kind == "close" else None))
    os._exit(0)


def _portable(error: Exception) -> Exception:
    """Return an exception that can be pickled; if needed, another one with the same text."""
    try:
        pickle.loads(pickle.dumps(error))  # noqa: S301  our own data
    except Exception:  # noqa: BLE001  unpickling may fail in any way
        return CaptureError(
            str(error) if isinstance(error, EdorasError) else f"{type(error).__name__}: {error}"
        )
    return error


def _write(
    sink: Filing,
    statistics: SourceStatistics,
    memory: NDArray[np.uint8],
    body: bytes,
    places: list[tuple[int, int]],
    counted: SourceStatistics,
) -> None:
    for item in fields(statistics):
        setattr(statistics, item.name, getattr(counted, item.name))
    sink.write(*pickle.loads(body, buffers=[memory[first:end] for first, end in places]))  # noqa: S301
