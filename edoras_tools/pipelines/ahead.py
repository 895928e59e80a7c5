"""Reads and decodes a file in another process, some batches ahead of what this one does with them.

What depends on earlier batches keeps its one order: the file is read from its beginning to its end, by one
process, and batches arrive one after the other. So nothing has to be put together, and all that is worked out
is as with one process. The rules:

1. The other process is at most ``_SLOTS`` batches ahead; then it waits. Memory does not grow with the file.
2. A batch is valid until the next one is asked for. Its frames are in the memory that the file was read into,
   which is used again only when no batch there is in use.
3. What decoding tells (notes, the counts of the source) arrives with the batch after which it is known.
4. The other process only begins to decode a batch (``ColumnDecoder.begin``) that would be waited for: what
   follows from the batch alone is then done here, so that both have as much to do.
5. The other process ends when the socket to it is closed.
"""

from __future__ import annotations

import os
import select
from contextlib import suppress
from dataclasses import fields
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from edoras_tools.decode.columns import Begun
from edoras_tools.errors import CaptureError, EdorasError
from edoras_tools.io.forked import await_end, fork, portable, receive, send, undisturbed
from edoras_tools.io.formats.merge import follow_streams, recorded_faults, recorded_host
from edoras_tools.io.shared import ROOM_BYTES, SLOT_BYTES, pickled, place, shared_memory, unpickled
from edoras_tools.model import Columns, HostCounters, PacketBatch, SourceInfo, SourceStatistics
from edoras_tools.pipelines.jobs import jobs_for

if TYPE_CHECKING:
    import socket
    from collections.abc import Callable, Iterator, Mapping

    from numpy.typing import NDArray

    from edoras_tools.decode import ColumnDecoder
    from edoras_tools.io import Source
    from edoras_tools.links.framing import Framing

    _Told = tuple[dict[str, Any], list[str], dict[str, str], tuple[Any, ...] | None]
    from edoras_tools.sessions.faults.fault import Fault

_SLOTS: Final = 4
"""Batches that are ahead, so that neither waits where one batch takes longer than another."""
_ROOMS: Final = _SLOTS + 2
_TAKEN: Final = b"\0"
"""One byte for each batch that is not used any more."""


class Ahead:
    """A source that another process reads and decodes.

    Args:
        source: a file; it is closed.
        decoder: decodes it; only the other process's changes.

    Attributes:
        info: the source's.
        statistics: the source's, as of the batch that was yielded last.
    """

    def __init__(self, source: Source, decoder: ColumnDecoder) -> None:
        self.info: SourceInfo = source.info
        self.statistics = source.statistics
        self._source, self._decoder = source, decoder
        self._process = 0
        self._link: socket.socket | None = None
        self._decoded: tuple[PacketBatch, Columns | Begun] | None = None
        self._detected: tuple[Any, ...] | None = None
        """As the other process had it at that batch."""
        self._notes = slice(0, 0)
        """Which of the decoder's notes are the other process's."""

    def batches(self) -> Iterator[PacketBatch]:
        """Yield all datagrams; see ``Source.batches``.

        Raises:
            CaptureError: also where the other process was killed.
        """
        try:
            memory = shared_memory(_ROOMS * ROOM_BYTES + _SLOTS * SLOT_BYTES)
            first = len(self._decoder.context.notes)
            self._notes = slice(first, first)
            self._process, link = fork(_Reader(self._source, self._decoder, memory).serve)
        except OSError:  # then this process reads it
            link = None
        if link is None:
            yield from self._source.batches()
            return
        self._link = link
        try:
            while True:
                select.select([link], [], [])
                with undisturbed():
                    packed, told, failure = self._receive(link)
                self._take(told)
                if packed is None:
                    break
                self._decoded = unpickled(packed, memory)
                yield self._decoded[0]
                with suppress(OSError):  # it has ended: what it sent last comes next
                    link.send(_TAKEN)
        finally:
            self._end()
        if failure is not None:
            raise failure

    def decode(self, batch: PacketBatch) -> Columns:
        """Return the columns of the batch that was yielded last; what else it is given is decoded here."""
        if self._decoded is None or self._decoded[0] is not batch:
            return self._decoder.decode(batch)
        found = self._decoded[1]
        if not isinstance(found, Begun):
            self._decoder.learn(batch, found)
            return found
        if self._detected is not None:
            self._decoder.context.take_over(self._detected)
            self._detected = None
        columns = self._decoder.finish(batch, found)
        self._decoder.learn(batch, columns)
        return columns

    def follow(self, framings: Mapping[int, Framing]) -> None:
        """See ``follow_streams``."""
        follow_streams(self._source, framings)

    def faults(self) -> list[Fault]:
        """Return the faults in the source, if it has any."""
        return recorded_faults(self._source)

    def host(self) -> list[HostCounters]:
        """Return the counters of the recording host, if the source has them."""
        return recorded_host(self._source)

    def close(self) -> None:
        """Close the file, and end the other process."""
        self._end()
        self._source.close()

    def _receive(self, link: socket.socket) -> tuple[Any, Any, Exception | None]:
        try:
            packed, told, failure = receive(link)
        except (OSError, EOFError):
            name = self.info.name
            killed = CaptureError(
                f"{name}: the process that read it was killed, perhaps because memory ran out; "
                "--jobs 1 reads it in one process"
            )
            return None, None, killed
        return packed, told, failure

    def _take(self, told: _Told | None) -> None:
        """Take over what the other process knows of the source, and what decoding told."""
        if told is None:
            return
        counts, notes, described, detected = told
        self._detected = detected or self._detected
        for name, value in counts.items():
            setattr(self.statistics, name, value)
        context, first = self._decoder.context, self._notes.start
        context.notes[self._notes] = notes
        self._notes = slice(first, first + len(notes))
        context.described.clear()
        context.described.update(described)

    def _end(self) -> None:
        if self._link is not None:
            self._link.close()
            self._link = None
            await_end(self._process)


class _Reader:
    """The other process: reads, decodes, and hands over.

    Args:
        memory: rooms to read into, then slots for columns.
    """

    def __init__(self, source: Source, decoder: ColumnDecoder, memory: NDArray[np.uint8]) -> None:
        self._source, self._decoder, self._memory = source, decoder, memory
        self._notes = len(decoder.context.notes)
        self._detected = decoder.context.detected
        self._given = self._taken = 0
        self._room = 0
        self._used = [0] * _ROOMS
        """How many batches must be taken until a room is free."""

    def serve(self, link: socket.socket) -> None:
        """Read to the end, or until the socket is closed."""
        self._link = link
        borrow: Callable[[Any], None] | None = getattr(self._source, "borrow", None)
        if borrow is not None:
            borrow(self._lend)
        failure: Exception | None = None
        try:
            for batch in self._source.batches():
                self._hand_over(batch)
        except EdorasError as error:
            failure = portable(error)
        except MemoryError:
            failure = CaptureError(f"{self._source.info.name}: memory ran out while it was read")
        send(link, (None, self._told(), failure))

    def _hand_over(self, batch: PacketBatch) -> None:
        decoded: Columns | Begun
        if len(batch):
            begun = self._decoder.begin(batch)
            # The last one that was given is worked on, or is waited for.
            waited_for = self._given - self._taken_now() <= 1
            decoded = begun._replace(part=None) if waited_for else self._decoder.finish(batch, begun)
        else:
            decoded = self._decoder.decode(batch)
        self._await(self._given - _SLOTS + 1)
        rooms: set[int] = set()

        def lent(data: NDArray[np.uint8]) -> int | None:
            at = place(data, self._memory)
            if not 0 <= at < _ROOMS * ROOM_BYTES:
                return None
            rooms.add(at // ROOM_BYTES)
            return at

        slot = _ROOMS * ROOM_BYTES + self._given % _SLOTS * SLOT_BYTES
        packed = pickled((batch, decoded), self._memory, slot, lent, size=SLOT_BYTES)
        self._given += 1
        for room in rooms:
            self._used[room] = self._given
        send(self._link, (packed, self._told(), None))

    def _lend(self, size: int) -> NDArray[np.uint8]:
        """Return memory to read into: u8, ``size`` bytes."""
        if size > ROOM_BYTES:
            return np.empty(size, np.uint8)
        self._room = (self._room + 1) % _ROOMS
        self._await(self._used[self._room])
        begin = self._room * ROOM_BYTES
        return self._memory[begin : begin + size]

    def _await(self, batches: int) -> None:
        """Wait until so many batches were taken."""
        while self._taken < batches:
            taken = len(self._link.recv(_SLOTS))
            if not taken:
                os._exit(0)  # the process that asked has ended
            self._taken += taken

    def _taken_now(self) -> int:
        """Return how many batches were taken, without waiting."""
        while select.select([self._link], [], [], 0)[0]:
            self._await(self._taken + 1)
        return self._taken

    def _told(self) -> _Told:
        context, statistics = self._decoder.context, self._source.statistics
        notes = context.notes[self._notes :]  # all: what comes later may change one
        counts = {item.name: getattr(statistics, item.name) for item in fields(SourceStatistics)}
        detected = context.detected
        fresh = None if detected == self._detected else detected
        self._detected = detected
        return counts, notes, dict(context.described), fresh


def read_ahead(source: Source, decoder: ColumnDecoder, jobs: int) -> Source:
    """Return a source that another process reads and decodes, or the source itself where one process does it.

    Args:
        jobs: how many processes share the work on a large file; 0: as many as there are free processor cores.
    """
    return Ahead(source, decoder) if jobs_for(source, jobs) > 1 else source
