"""What is in a capture or a recording."""

from __future__ import annotations

from typing import TYPE_CHECKING

from edoras_tools.errors import EdorasError
from edoras_tools.pipelines.accounts import Ledger
from edoras_tools.pipelines.interrupt import interruptible
from edoras_tools.pipelines.record import Report
from edoras_tools.pipelines.selection import Selection

if TYPE_CHECKING:
    from edoras_tools.pipelines.record import Watcher
    from edoras_tools.pipelines.workbench import Workbench
    from edoras_tools.sources import Source


def inspect(
    source: Source, bench: Workbench, *, selection: Selection | None = None, watcher: Watcher | None = None
) -> Report:
    """Read a source to its end and count what is chosen; ``Report.failure`` says why it ended early.

    Raises:
        RouteError: the selection names a topic that is not configured.
        ConfigError: its filter has a mistake.
    """
    report = Report(Ledger(bench.mission), source)
    try:
        chosen = (selection or Selection()).over(bench)
    except EdorasError:
        source.close()
        raise
    try:
        with interruptible(source) as (batches, asked):
            for batch in batches:
                report.ledger.add(*chosen.apply(batch, bench.columns.decode(batch), bench.mission))
                if watcher is not None:
                    watcher.update(report)
            report.interrupted = asked.is_set()
    except EdorasError as error:
        report.failure = error
    finally:
        source.close()
    return report
