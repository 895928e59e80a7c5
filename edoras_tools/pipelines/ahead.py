"""Reads and decodes a file in a second process, some batches ahead of the process that uses them.

Decoding depends on earlier batches. So one process reads the whole file in order, and batches arrive in
order. No results have to be joined, and all results are those of a single process. The rules:

1. The second process is at most ``_BATCHES`` batches ahead; then it waits. Memory does not grow with the
   file.
2. A batch is valid until the next one is requested. Its frames stay in the memory that the file was read
   into, which is used again only when no batch in it is in use (``io.processes``).
3. Notes and counts of the source arrive with the batch after which they are known.
4. If this process already waits for a batch, the second one only begins to decode it
   (``ColumnDecoder.begin``) and this process does the rest, so that both have the same amount of work.
"""

from __future__ import annotations

import pickle
from contextlib import closing
from typing import TYPE_CHECKING, Any, Final

from msgspec.structs import asdict

from edoras_tools.decode.columns import Begun
from edoras_tools.errors import CaptureError, EdorasError
from edoras_tools.io import Source, SourceOver
from edoras_tools.io.processes import Desk, Workers, portable
from edoras_tools.io.processors import jobs_for

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from edoras_tools.decode import ColumnDecoder
    from edoras_tools.model import Columns, PacketBatch

    _Answer = tuple[PacketBatch | None, Columns | Begun | None, bytes, Exception | None]
    """A batch, its columns, the state after it (pickled); at the end the error of the file, if any."""

_BATCHES: Final = 5
"""Batches that may be ahead, so that neither process waits if one batch takes longer than another."""


class Ahead(SourceOver):
    """A source that another process reads and decodes.

    Args:
        source: a file; closed at the end.
        decoder: decoder for the file. Its statistics are those of the batch that was yielded last.
    """

    section = 0

    def __init__(self, source: Source, decoder: ColumnDecoder) -> None:
        super().__init__(source)
        self._decoder = decoder
        self._workers: Workers | None = None
        self._decoded: tuple[PacketBatch, Columns | Begun] | None = None
        self._detected: tuple[Any, ...] | None = None
        """Detected properties of the second process at that batch, if they changed; else None."""
        self._notes = slice(0, 0)
        """Slice of the context's notes that came from the second process."""

    def batches(self) -> Iterator[PacketBatch]:
        """Yield all datagrams; see ``Source.batches``.

        Raises:
            CaptureError: the file cannot be read, or the second process was killed.
        """
        first = len(self._decoder.context.notes)
        self._notes = slice(first, first)
        workers = self._start()
        if workers is None:  # there is no second process: this one reads the file
            yield from self._source.batches()
            return
        with closing(workers):
            while True:
                while not workers.full:
                    workers.submit()
                answer: _Answer = workers.take()
                batch, columns, state, failure = answer
                self._adopt(state)
                if batch is None or columns is None:
                    break
                self._decoded = batch, columns
                yield batch
        if failure is not None:
            raise failure

    def decoded(self, batch: PacketBatch, decode: Callable[[PacketBatch], Columns]) -> Columns:
        """Return the columns of the batch that was yielded last; any other batch is decoded here."""
        if self._decoded is None or self._decoded[0] is not batch:
            return decode(batch)
        decoded = self._decoded[1]
        if not isinstance(decoded, Begun):
            self._decoder.learn(batch, decoded)
            return decoded
        if self._detected is not None:
            self._decoder.context.take_over(self._detected)
            self._detected = None
        columns = self._decoder.finish(batch, decoded)
        self._decoder.learn(batch, columns)
        return columns

    def close(self) -> None:
        """Close the file, and end the second process."""
        if self._workers is not None:
            self._workers.close()
        self._source.close()

    def _start(self) -> Workers | None:
        """Start the second process; None if it cannot be started."""
        killed = CaptureError(
            f"{self.info.name}: the process that read it was killed, perhaps because memory ran out; "
            "--jobs 1 reads it in one process"
        )
        reader = _Reader(self._source, self._decoder)
        try:
            self._workers = Workers(1, reader.next, killed, set_up=reader.set_up, tasks=_BATCHES)
        except OSError:
            return None
        self._workers.start()
        return None if self._workers.full else self._workers

    def _adopt(self, state: bytes) -> None:
        """Adopt the state of the second process: counts of the source, notes, and detected properties."""
        counts, notes, described, detected, self.section = pickle.loads(state)  # noqa: S301  from our own process
        self._detected = detected or self._detected
        for name, value in counts.items():
            setattr(self.statistics, name, value)
        context, first = self._decoder.context, self._notes.start
        context.notes[self._notes] = notes
        self._notes = slice(first, first + len(notes))
        context.described.clear()
        context.described.update(described)


class _Reader:
    """Work of the second process: it reads, decodes, and hands batches over."""

    def __init__(self, source: Source, decoder: ColumnDecoder) -> None:
        self._source, self._decoder = source, decoder
        self._notes = len(decoder.context.notes)
        self._detected = decoder.context.detected

    def set_up(self, desk: Desk) -> None:
        """Begin to read, into memory that the desk lends if the source supports this."""
        self._desk = desk
        self._source.borrow(desk.lend)
        self._batches = self._source.batches()

    def next(self) -> _Answer:
        """Return the next batch, or the end of the file."""
        failure: Exception | None = None
        try:
            for batch in self._batches:
                return batch, self._decode(batch), self._state(), None
        except EdorasError as error:
            failure = portable(error)
        except MemoryError:
            failure = CaptureError(f"{self._source.info.name}: memory ran out while it was read")
        return None, None, self._state(), failure

    def _decode(self, batch: PacketBatch) -> Columns | Begun:
        if not len(batch):
            return self._decoder.decode(batch)
        detected = self._decoder.begin(batch)
        return detected._replace(part=None) if self._desk.awaited else self._decoder.finish(batch, detected)

    def _state(self) -> bytes:
        """Return the present state, pickled because it is kept longer than the batch."""
        context, statistics = self._decoder.context, self._source.statistics
        notes = context.notes[self._notes :]  # all of them: a later batch may change one
        counts = asdict(statistics)
        detected = context.detected
        change = None if detected == self._detected else detected
        self._detected = detected
        return pickle.dumps((counts, notes, dict(context.described), change, self._source.section))


def read_ahead(source: Source, decoder: ColumnDecoder, jobs: int) -> Source:
    """Return a source that a second process reads and decodes, or the source itself if one process is enough.

    Args:
        jobs: number of processes that share the work on a large file; 0: one for each free processor core.
    """
    return Ahead(source, decoder) if jobs_for(source, jobs) > 1 else source
