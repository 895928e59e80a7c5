"""The read loop: takes a batch, decodes it, selects rows, yields them; until the end, a limit or Ctrl-C.

A failure of the source comes after everything that could be read before it. ``reading`` raises it then, or
keeps it for callers that report on what was read.
"""

from __future__ import annotations

from contextlib import closing, contextmanager
from dataclasses import dataclass
from time import monotonic_ns
from typing import TYPE_CHECKING

from edoras_tools.decode.conversations import Conversations
from edoras_tools.decode.filters.rows import ColumnRows
from edoras_tools.errors import CaptureError
from edoras_tools.pipelines.interrupt import interruptible
from edoras_tools.pipelines.selection import Selection

if TYPE_CHECKING:
    import threading
    from collections.abc import Callable, Iterator

    import numpy as np
    from numpy.typing import NDArray

    from edoras_tools.io import Source
    from edoras_tools.model import PacketBatch
    from edoras_tools.pipelines.workbench import Workbench


@dataclass(frozen=True, slots=True)
class Limits:
    """Which part of a source is read.

    Attributes:
        count: maximum number of selected datagrams; 0 for all.
        duration_ns: how long to read; 0: to the end.
        start_ns: datagrams before this time after the first one are left out.
        end_ns: datagrams from this time after the first one on are left out; 0 for none.
        clock: monotonic time in ns.
    """

    count: int = 0
    duration_ns: int = 0
    clock: Callable[[], int] = monotonic_ns
    start_ns: int = 0
    end_ns: int = 0

    def within(self, since_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return which times, in ns since the first datagram, are between start and end."""
        return (since_ns >= (self.start_ns or since_ns)) & (since_ns < (self.end_ns or since_ns + 1))


@dataclass(slots=True, eq=False)
class ReadLoop:
    """A source that is being read; can be iterated once.

    Attributes:
        source: where datagrams come from.
        bench: mission, types and decoders.
        selection: which datagrams; already prepared for the bench.
        limits: when to end.
        within: which part of a batch is read at all; the rest is not even decoded.
        keeps_failure: keep the error that ended the source in ``failure``, instead of raising it.
        conversations: of all that was read, if they are followed; a batch is added before it is yielded.
        failure: why the source ended early, if it did.
    """

    source: Source
    bench: Workbench
    selection: Selection
    limits: Limits
    within: Callable[[PacketBatch], PacketBatch] | None
    keeps_failure: bool
    conversations: Conversations
    _conversing: bool
    _batches: Iterator[PacketBatch]
    _asked: threading.Event
    failure: CaptureError | None = None

    @property
    def interrupted(self) -> bool:
        """Whether Ctrl-C, SIGTERM or SIGHUP has come."""
        return self._asked.is_set()

    def __iter__(self) -> Iterator[ColumnRows]:
        """Yield the selected rows of every batch, even if there are none: live sources give empty batches.

        Raises:
            CaptureError: the source ended early, and ``keeps_failure`` is not set.
        """
        limits, bench = self.limits, self.bench
        left, began, begin_ns = limits.count, limits.clock(), None
        for whole in self._until_failure():
            batch = self.within(whole) if self.within else whole
            if begin_ns is None and len(whole):
                begin_ns = int(whole.time_ns[0])
            columns = bench.columns.decode(batch)
            if self._conversing:
                self.conversations.add(batch, columns)
            rows = self.selection.rows(batch, columns, bench.mission)
            if limits.start_ns or limits.end_ns:
                rows = rows[limits.within(batch.time_ns[rows] - (begin_ns or 0))]
            if limits.count:
                rows = rows[:left]
                left -= len(rows)
            yield ColumnRows(bench.columns.context, begin_ns or 0, batch, columns, rows)
            if limits.count and not left:
                return
            if limits.duration_ns and limits.clock() - began >= limits.duration_ns:
                return

    def _until_failure(self) -> Iterator[PacketBatch]:
        try:
            yield from self._batches
        except CaptureError as error:
            if not self.keeps_failure:
                raise
            self.failure = error


@contextmanager
def reading(
    source: Source,
    bench: Workbench,
    selection: Selection | None = None,
    limits: Limits = Limits(),
    *,
    within: Callable[[PacketBatch], PacketBatch] | None = None,
    keeps_failure: bool = False,
    conversing: bool = False,
    patient: bool = False,
) -> Iterator[ReadLoop]:
    """Read a source: iterate over the loop that this yields. The source is closed at the end.

    Ctrl-C and SIGTERM end the loop: for a live source after all that has arrived, for a file or pipe at once.
    Outside the main thread, signals are not handled.

    Args:
        source: where datagrams come from.
        bench: mission, types and decoders.
        selection: which datagrams; all by default.
        limits: when to end; never by default.
        within: see ``ReadLoop``.
        keeps_failure: see ``ReadLoop``.
        conversing: follow conversations; see ``ReadLoop``.
        patient: see ``on_interrupt``.

    Raises:
        RouteError: the selection names a topic that is not configured.
        ConfigError: its filter has an error.
    """
    with closing(source):
        ready = (selection or Selection()).over(bench)
        with interruptible(source, patient=patient) as (batches, asked):
            spoken = Conversations(bench.columns.context)
            yield ReadLoop(
                source, bench, ready, limits, within, keeps_failure, spoken, conversing, batches, asked
            )


def chosen(
    source: Source,
    bench: Workbench,
    *,
    selection: Selection,
    limits: Limits = Limits(),
) -> Iterator[ColumnRows]:
    """Yield the selected rows of every batch that has any; the source is closed at the end.

    Args:
        source: where datagrams come from.
        bench: mission, types and decoders.
        selection: which datagrams.
        limits: when to end; never by default.

    Raises:
        CaptureError: the source ended early; everything before was yielded.
        RouteError: the selection names a topic that is not configured.
        ConfigError: its filter has an error.
    """
    with reading(source, bench, selection, limits) as loop:
        yield from filter(len, loop)
