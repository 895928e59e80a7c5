"""What is in a capture or a recording.

A file is read and decoded in a second process, some batches ahead of the process that uses them
(``read_ahead``). Decoding depends on earlier batches. So one process reads the whole file in order, and
batches arrive in order. No results have to be joined, and all results are those of a single process. The
rules:

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
from collections.abc import Callable, Iterator
from contextlib import closing
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from msgspec.structs import asdict

from edoras_tools.decode.columns import Begun
from edoras_tools.diagnosis.evidence.copies import Once
from edoras_tools.errors import CaptureError, EdorasError
from edoras_tools.io import Source, SourceOver
from edoras_tools.io.processes import Desk, Workers, jobs_for, portable
from edoras_tools.pipelines.capture.ledger import Ledger
from edoras_tools.pipelines.capture.record import CaptureReport
from edoras_tools.pipelines.reading import Limits, ReadLoop, reading, reads_by_heads
from edoras_tools.pipelines.selection import Selection, fits_topic
from edoras_tools.structs.bindings import payloads
from edoras_tools.wire.arrays import by_value

if TYPE_CHECKING:
    from edoras_tools.decode import ColumnDecoder
    from edoras_tools.decode.filters.rows import ColumnRows
    from edoras_tools.model import Columns, PacketBatch
    from edoras_tools.pipelines.workbench import Workbench
    from edoras_tools.render.terminal.text import Watcher

    _Answer = tuple[PacketBatch | None, Columns | Begun | None, bytes, Exception | None]
    """A batch, its columns, the state after it (pickled); at the end the error of the file, if any."""


class Counting:
    """Counts the datagrams of a loop: only traffic of cFS, and each datagram once.

    Attributes:
        report: the counts so far.
    """

    def __init__(self, source: Source, bench: Workbench) -> None:
        context = self._context = bench.columns.context
        self.report = CaptureReport(
            Ledger(bench.mission, context, structs=context.structs), source, notes=context.notes
        )
        self._once = Once()
        self._part = 0
        self._structs = bench.columns.context.structs

    def add(self, rows: ColumnRows, loop: ReadLoop) -> ColumnRows:
        """Add the chosen rows of a batch, and return those that count; the loop must follow conversations."""
        if loop.part != self._part:
            self._part = loop.part
            self.report.ledger.separate()
        if rows.batch.recorded is not None:
            self.report.ledger.add(*rows.alone())
            return rows
        keep = self._once.keep(rows.batch, rows.columns)
        keep[loop.conversations.left_out()] = False
        own = rows.take(np.flatnonzero(keep[rows.selection]))
        self.report.ledger.add(*own.alone())
        table = self._structs.dictionary
        if table is not None:
            entries = table.whole(payloads(self._structs, own.column, own.datagram, own.batch.data))
            for key, members in by_value(entries.key):
                self.report.entries[table.entry(key)] += len(members)
        return own

    def end(self, loop: ReadLoop) -> CaptureReport:
        """Return the counts, and how the loop ended."""
        self.report.failure = loop.failure
        self.report.unnamed = loop.conversations.unnamed
        time = self._context.options.time
        note = [f"telemetry has mission time as {time}, as the mission or the recording says"] if time else []
        self.report.notes = [*self.report.notes, *note, *loop.conversations.notes(), *self._once.notes()]
        return self.report


def _recorded_counts(source: Source, bench: Workbench) -> CaptureReport | None:
    """Return the counts that the recorder saved, if ``Counting`` would count the same; else None."""
    context = bench.columns.context
    if context.structs.dictionary is not None or not (reads_by_heads(source, bench) and source.info.sound):
        return None
    report = CaptureReport(
        Ledger(bench.mission, context, structs=context.structs), source, notes=context.notes
    )
    if not report.ledger.adopt(source.recorder_counts()):
        return None
    source.statistics.datagrams = report.ledger.datagrams
    source.close()
    return report


def inspect(
    source: Source,
    bench: Workbench,
    *,
    selection: Selection | None = None,
    limits: Limits = Limits(),  # noqa: B008  frozen
    watcher: Watcher[CaptureReport] | None = None,
    jobs: int = 1,
) -> CaptureReport:
    """Read a source to its end and count the selected datagrams; ``failure`` says why it ended early.

    Args:
        source: source of the datagrams; it is closed.
        selection: selected datagrams; all by default.
        watcher: called with the report after every batch.
        jobs: number of processes that share the work, see ``read_ahead``; the selection is applied in one.

    Raises:
        RouteError: the selection names a topic that is not configured.
        ConfigError: its filter has an error.
    """
    if not selection and limits == Limits() and (report := _recorded_counts(source, bench)) is not None:
        return report
    if not selection and not bench.mission.recorded:
        source = read_ahead(source, bench.columns, jobs)
    counting = Counting(source, bench)
    if bench.mission.recorded:
        patterns = selection.topics if selection else ()
        counting.report.ledger.listed = [
            place
            for place, route in enumerate(bench.mission.routes)
            if not patterns or any(fits_topic(route.topic, item) for item in patterns)
        ]
    with reading(source, bench, selection, limits, keeps_failure=True, conversing=True) as loop:
        for rows in loop:
            counting.add(rows, loop)
            if watcher is not None:
                watcher.update(counting.report)
    return counting.end(loop)


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
