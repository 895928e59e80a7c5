"""A sink in a second process, so that it does not share Python's lock with reading and decoding.

The arrays of a batch are in shared memory, everything else is pickled through a socket. Every request is
answered when it is done, in order, with nothing or with an exception; after a failure only the request to
close is carried out.
"""

from __future__ import annotations

import mmap
import os
import pickle
import select
from contextlib import suppress
from dataclasses import fields
from functools import partial
from typing import TYPE_CHECKING, Any, Final, Protocol

import numpy as np

from edoras_tools.io import Sink
from edoras_tools.io.forked import fork, killed, portable, receive, send, undisturbed

if TYPE_CHECKING:
    import socket
    from collections.abc import Sequence
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
        self._process, self._link = fork(partial(_serve, sink, statistics, self._memory))
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
        with undisturbed():
            try:
                send(self._link, (self._asked, *request))
            except OSError:
                self._gone()
        return self._asked

    def _await(self, request: int) -> Any:
        """Wait until a request is answered, perhaps long ago; return the answer if it is new."""
        answer = None
        while self._answered < request:
            select.select([self._link], [], [])
            with undisturbed():
                try:
                    self._answered, failure, answer = receive(self._link)
                except (OSError, EOFError):
                    self._gone()
                    return None
                self._failure = self._failure or failure
        return answer

    def _gone(self) -> None:
        self._answered = self._asked
        self._failure = self._failure or killed(self._path)

    def _tell(self) -> None:
        if self._failure is not None:
            self._told = True
            raise self._failure


def _address(data: NDArray[np.uint8]) -> int:
    place: int = data.__array_interface__["data"][0]
    return place


def _serve(
    sink: Filing, statistics: SourceStatistics, memory: NDArray[np.uint8], link: socket.socket
) -> None:
    """Serve requests in the forked process until one asks to close, or the parent process has ended."""
    failed = False
    kind = ""
    while kind != "close":
        try:
            number, kind, *values = receive(link)
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
            failed, failure = True, portable(error)
        with suppress(OSError):  # the other process has ended: the next read shows it
            closed = (sink.paths, getattr(sink, "losses", []), getattr(sink, "keep", None))
            send(link, (number, failure, closed if kind == "close" else None))


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
