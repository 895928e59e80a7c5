"""The chosen datagrams of a source, a batch at a time, for what looks at many of them at once."""

from __future__ import annotations

from typing import TYPE_CHECKING

from edoras_tools.decode.where_rows import ColumnRows
from edoras_tools.pipelines.interrupt import interruptible

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from edoras_tools.pipelines.selection import Selection
    from edoras_tools.pipelines.workbench import Workbench
    from edoras_tools.sources import Source


def chosen(
    source: Source,
    bench: Workbench,
    *,
    selection: Selection,
    count: int = 0,
    clock: Callable[[], int],
    duration_ns: int = 0,
) -> Iterator[ColumnRows]:
    """Yield the chosen rows of every batch that has any; the source is closed at the end.

    Args:
        source: where datagrams come from.
        bench: mission, types and decoders.
        selection: which datagrams.
        count: stop after so many; 0 never.
        clock: monotonic time in ns.
        duration_ns: stop after so long; 0 never.

    Raises:
        CaptureError: the source ended early; everything before was yielded.
        RouteError: the selection names a topic that is not configured.
        ConfigError: its filter has a mistake.
    """
    left, began, begin_ns = count, clock(), None
    try:
        ready = selection.over(bench)
        with interruptible(source) as (batches, _):
            for batch in batches:
                if begin_ns is None and len(batch):
                    begin_ns = int(batch.time_ns[0])
                columns = bench.columns.decode(batch)
                rows = ready.rows(batch, columns, bench.mission)[: left or None]
                if len(rows):
                    yield ColumnRows(bench.columns.context, begin_ns or 0, batch, columns, rows)
                left -= len(rows) if count else 0
                if (count and not left) or (duration_ns and clock() - began >= duration_ns):
                    return
    finally:
        source.close()
