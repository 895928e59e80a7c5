"""A sink in a process of its own, so that it does not share Python's lock with what reads and decodes.

Two threads that work in numpy hand that lock to each other hundreds of times a batch; two processes need not.
The arrays of a batch lie in memory that both have, everything else is pickled through a socket. Every request
is answered once it was done, in order, by nothing or by what was raised; after a failure nothing is done any
more but closing.
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
from edoras_tools.sinks import Sink

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from numpy.typing import NDArray

    from edoras_tools.model import Columns, PacketBatch, SourceStatistics

_SLOTS: Final = 2
"""Batches under way: the one being handed over, and the one that is written."""
_SLOT_BYTES: Final = 32 << 20
"""Room for the arrays of one; what does not fit goes through the socket. Only what is used becomes memory."""
_ROOMS: Final = 3
_ROOM_BYTES: Final = 9 << 20
"""Memory lent to a source to read into, which need not be copied then: what it is at, and one a slot."""
_LENT: Final = _ROOMS * _ROOM_BYTES
_ALIGNMENT: Final = 64
_SIGNALS: Final = (signal.SIGINT, signal.SIGTERM)
_LENGTH_BYTES: Final = 8
"""In front of everything sent: how long it is."""
_PR_SET_PDEATHSIG: Final = 1
"""prctl(2): the signal that a process gets when the one that forked it ends."""


class Filing(Sink, Protocol):
    """A sink that writes files."""

    @property
    def paths(self) -> list[Path]:
        """The files written."""
        ...

    def abandon(self) -> None:
        """Let go of the output as it is."""


class Apart:
    """A ``Sink`` that hands on to one in a forked process; on Linux only.

    Args:
        sink: open, and nothing written yet; it belongs to the other process from now on.
        statistics: of the source; the sink sees them as they were when a batch was handed over.
        path: what is written, for errors.

    Attributes:
        paths: the files written, once closed.

    Raises:
        CaptureError: from ``write``, ``flush`` and ``close``: the process is gone. So does whatever the sink
            raised, perhaps some calls later; ``close`` is silent about what was told before.
        OSError: no process can be forked.
    """

    def __init__(self, sink: Filing, statistics: SourceStatistics, path: Path) -> None:
        if sys.platform != "linux":
            raise OSError("elsewhere libraries do not expect to be forked")
        self.paths: list[Path] = []
        self._path = path
        self._statistics = statistics
        self._memory = np.frombuffer(mmap.mmap(-1, _LENT + _SLOTS * _SLOT_BYTES), np.uint8)
        self._asked = self._answered = 0
        self._failure: Exception | None = None
        self._told = False
        self._slot = self._room = 0
        self._used = [0] * _ROOMS
        """Of each room, which request was the last to name it."""
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
        """Return memory to read into, u8 of so many bytes; what is written from it need not be copied.

        It is the caller's until this has been called as often again as there are rooms; it waits until what
        was written from there before is no longer read.
        """
        if size > _ROOM_BYTES:
            return np.empty(size, np.uint8)
        self._room = (self._room + 1) % _ROOMS
        self._await(self._used[self._room])
        begin = self._room * _ROOM_BYTES
        return self._memory[begin : begin + size]

    def write(self, batch: PacketBatch, columns: Columns) -> None:
        """Hand a batch over; afterwards only what was lent is still read."""
        self._await(self._asked - _SLOTS + 1)
        self._tell()
        at = _LENT + self._slot * _SLOT_BYTES
        end = at + _SLOT_BYTES
        places: list[tuple[int, int]] = []
        rooms: set[int] = set()

        def inside(buffer: pickle.PickleBuffer) -> bool:
            """Place an array in shared memory; tell whether it has to stay in the pickle instead."""
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
        """Get everything taken so far to the file."""
        self._await(self._ask("flush"))
        self._tell()

    def close(self, statistics: SourceStatistics) -> None:
        """Make the output whole, and end the process; closing twice does nothing."""
        if not self._process:
            return
        process, self._process = self._process, 0
        try:
            self.paths = self._await(self._ask("close", statistics)) or []
        finally:
            self._link.close()
            with suppress(ChildProcessError):  # nobody has to wait where SIGCHLD is ignored
                os.waitpid(process, 0)
        if not self._told:
            self._tell()

    def _ask(self, *request: Any) -> int:
        """Make a request; return its number."""
        self._asked += 1
        with _undisturbed():
            try:
                _send(self._link, (self._asked, *request))
            except OSError:
                self._gone()
        return self._asked

    def _await(self, request: int) -> Any:
        """Wait until a request is answered, which may have been long ago; return the answer if it is new."""
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
            f"`edoras recover {self._path}` makes whole what is there"
        )

    def _tell(self) -> None:
        if self._failure is not None:
            self._told = True
            raise self._failure


@contextmanager
def _undisturbed() -> Iterator[None]:
    """Have Ctrl-C wait: a request or an answer that is cut in two would be the last."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, ())
    try:  # what is due already is raised by the call that blocks, when it has blocked
        signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS)
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _send(link: socket.socket, value: Any) -> None:
    data = pickle.dumps(value, protocol=5)
    link.sendall(len(data).to_bytes(_LENGTH_BYTES) + data)


def _receive(link: socket.socket) -> Any:
    """Return what the other process sent.

    Raises:
        EOFError: it is gone.
    """
    length = link.recv(_LENGTH_BYTES, socket.MSG_WAITALL)
    data = link.recv(int.from_bytes(length), socket.MSG_WAITALL) if len(length) == _LENGTH_BYTES else b""
    if not data or len(data) < int.from_bytes(length):
        raise EOFError
    return pickle.loads(data)  # noqa: S301  from a process of our own


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
    """Live the life of the forked process: do what is asked until it is to close, or nobody asks any more.

    It is killed when the one that asks ends, so that nobody writes on who is thought to be dead. Ctrl-C and
    SIGTERM stay blocked as they were for the fork: the one that asks heeds them.
    """
    with suppress(BaseException):
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != starter:  # it was gone before that
            os._exit(1)
        gc.freeze()  # a collection would write to all the memory that is still shared
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
            except Exception as error:  # noqa: BLE001  all of them are for the one that asked
                failed, failure = True, _portable(error)
            with suppress(OSError):  # nobody there: that is read next
                _send(link, (number, failure, sink.paths if kind == "close" else None))
    os._exit(0)


def _portable(error: Exception) -> Exception:
    """Return an exception that survives the way, if need be another one of the same words."""
    try:
        pickle.loads(pickle.dumps(error))  # noqa: S301  just made
    except Exception:  # noqa: BLE001  it may have any needs
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
