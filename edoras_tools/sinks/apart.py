"""A sink in a process of its own, so that it does not share Python's lock with what reads and decodes.

Two threads that work in numpy hand that lock to each other hundreds of times a batch; two processes need not.
The arrays of a batch lie in memory that both have, everything else is pickled through a socket. Every request
is answered once it was done, in order, by nothing or by what was raised.
"""

from __future__ import annotations

import gc
import mmap
import os
import pickle
import signal
import socket
import sys
from contextlib import contextmanager, suppress
from dataclasses import fields
from typing import TYPE_CHECKING, Any, Final, NoReturn, Protocol

import numpy as np

from edoras_tools.errors import CaptureError
from edoras_tools.sinks import Sink

if TYPE_CHECKING:
    from collections.abc import Iterator
    from io import BufferedRWPair
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
        CaptureError: from every method: what the sink raised, perhaps one call later; or its process is gone.
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
        self._failed = False
        self._slot = self._room = 0
        self._used = [0] * _ROOMS
        """Of each room, which request was the last to name it."""
        here, there = socket.socketpair()
        with here, there, _undisturbed():
            self._process = os.fork()
            if not self._process:
                here.close()
                _serve(sink, statistics, self._memory, there.makefile("rwb"))
            self._link: BufferedRWPair = here.makefile("rwb")
        sink.abandon()

    def lend(self, size: int) -> NDArray[np.uint8]:
        """Return memory to read into, u8 of so many bytes; what is written from it need not be copied.

        It is the caller's until this has been called as often again as there are rooms.
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
        at = _LENT + self._slot * _SLOT_BYTES
        end = at + _SLOT_BYTES
        self._slot = (self._slot + 1) % _SLOTS
        places: list[tuple[int, int]] = []

        def inside(buffer: pickle.PickleBuffer) -> bool:
            """Place an array in shared memory; tell whether it has to stay in the pickle instead."""
            nonlocal at
            data = np.frombuffer(buffer.raw(), np.uint8)
            lent = _address(data) - _address(self._memory)
            if 0 <= lent < _LENT:
                self._used[lent // _ROOM_BYTES] = self._asked + 1
                places.append((lent, lent + len(data)))
                return False
            if at + len(data) > end:
                return True
            self._memory[at : at + len(data)] = data
            places.append((at, at + len(data)))
            at += -(-len(data) // _ALIGNMENT) * _ALIGNMENT
            return False

        body = pickle.dumps((batch, columns), protocol=5, buffer_callback=inside)
        self._ask("write", body, places, self._statistics)

    def flush(self) -> None:
        """Get everything taken so far to the file."""
        self._await(self._ask("flush"))

    def close(self, statistics: SourceStatistics) -> None:
        """Make the output whole, and end the process; after a failure that was told only end it."""
        if not self._process:
            return
        process, self._process = self._process, 0
        told = self._failed
        try:
            self.paths = self._await(self._ask("close", statistics))
        except Exception:
            if not told:
                raise
        finally:
            with suppress(OSError):
                self._link.close()
            os.waitpid(process, 0)

    def _ask(self, *request: Any) -> int:
        """Make a request; return its number."""
        self._asked += 1
        with _undisturbed():
            try:
                pickle.dump((self._asked, *request), self._link, protocol=5)
                self._link.flush()
            except OSError:
                raise self._gone() from None
        return self._asked

    def _await(self, request: int) -> Any:
        """Wait until a request is answered, which may have been long ago; return the answer if it is new."""
        answer = None
        while self._answered < request:
            with _undisturbed():
                try:
                    self._answered, answer = pickle.load(self._link)  # noqa: S301  from a process of our own
                except (OSError, EOFError):
                    raise self._gone() from None
            if isinstance(answer, Exception):
                self._failed = True
                raise answer
        return answer

    def _gone(self) -> CaptureError:
        self._failed = True
        return CaptureError(
            f"{self._path}: the process that wrote it was killed; "
            f"`edoras recover {self._path}` makes whole what is there"
        )


@contextmanager
def _undisturbed() -> Iterator[None]:
    """Have Ctrl-C wait: a request or an answer that is cut in two would be the last."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _address(data: NDArray[np.uint8]) -> int:
    place: int = data.__array_interface__["data"][0]
    return place


def _serve(
    sink: Filing, statistics: SourceStatistics, memory: NDArray[np.uint8], link: BufferedRWPair
) -> NoReturn:
    """Live the life of the forked process: do what is asked until it is to close, or nobody asks any more.

    Signals stay blocked as they were for the fork: the one that asks heeds them.
    """
    with suppress(BaseException):
        gc.freeze()  # a collection would write to all the memory that is still shared
        kind = ""
        while kind != "close":
            try:
                number, kind, *values = pickle.load(link)  # noqa: S301  from the process that forked this one
            except (OSError, EOFError, pickle.UnpicklingError):
                number, kind, values = 0, "close", [statistics]
            answer: Any = None
            try:
                if kind == "write":
                    _write(sink, statistics, memory, *values)
                elif kind == "flush":
                    sink.flush()
                else:
                    sink.close(*values)
                    answer = sink.paths
            except Exception as error:  # noqa: BLE001  all of them are for the one that asked
                answer = error
            with suppress(OSError):  # nobody there: the end of the requests is read next
                pickle.dump((number, answer), link, protocol=5)
                link.flush()
    os._exit(0)


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
