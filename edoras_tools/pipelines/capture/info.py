"""What is in a capture or a recording."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from edoras_tools.diagnosis.evidence.copies import Once
from edoras_tools.pipelines.ahead import read_ahead
from edoras_tools.pipelines.capture.ledger import Ledger
from edoras_tools.pipelines.capture.record import CaptureReport
from edoras_tools.pipelines.names import fits_topic
from edoras_tools.pipelines.reading import Limits, ReadLoop, reading, reads_by_heads
from edoras_tools.structs.payloads import payloads
from edoras_tools.wire.arrays.order import by_value

if TYPE_CHECKING:
    from edoras_tools.decode.filters.rows import ColumnRows
    from edoras_tools.io import Source
    from edoras_tools.pipelines.selection import Selection
    from edoras_tools.pipelines.workbench import Workbench
    from edoras_tools.render.terminal.text import Watcher


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
