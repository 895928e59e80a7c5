"""Traffic live in Foxglove: of an interface, of sockets, of an emulated cFS; or beside any other pipeline.

What runs already is attached in two lines::

    sink = attach(bench, source.info, statistics=source.statistics)
    record(source, bench, target, clock=clock, tap=sink.write)  # then sink.close(source.statistics)
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from edoras_tools.errors import EdorasError
from edoras_tools.model import Endpoint
from edoras_tools.pipelines.accounts import Ledger
from edoras_tools.pipelines.record import Report, pour, record
from edoras_tools.pipelines.selection import Selection
from edoras_tools.render.severity import EXPLANATIONS, Severity
from edoras_tools.sinks.foxglove import PORT, FoxgloveSink
from edoras_tools.websocket import Guard

if TYPE_CHECKING:
    from collections.abc import Callable

    from edoras_tools.model import SourceInfo, SourceStatistics
    from edoras_tools.pipelines.record import Target, Watcher
    from edoras_tools.pipelines.workbench import Workbench
    from edoras_tools.sinks.foxglove_offer import Player, Publisher
    from edoras_tools.sources import Source

HERE: Final = Endpoint("127.0.0.1", PORT)
"""Where Foxglove looks for a server unless told otherwise; nobody outside this machine can reach it."""
LEVELS: Final = {finding: max(item.severity - Severity.NOTE, 0) for finding, item in EXPLANATIONS.items()}
"""Findings by the levels of ``diagnostic_msgs/msg/DiagnosticStatus``: notes are fine."""


def attach(
    bench: Workbench,
    info: SourceInfo,
    *,
    listen: Endpoint = HERE,
    statistics: SourceStatistics | None = None,
    publisher: Publisher | None = None,
    player: Player | None = None,
    guard: Guard = Guard(),  # noqa: B008  frozen
) -> FoxgloveSink:
    """Begin to serve; every batch that is given to ``write`` of what is returned is shown.

    Args:
        bench: mission and types.
        info: names the server.
        listen: address and port; port 0 is the system's choice, ``server.endpoint`` says which.
        statistics: of the source, for what the capture itself loses.
        publisher: takes what clients publish; None: they may not.
        player: plays a recording back; None: the traffic is live.
        guard: who may connect; programs, Foxglove and this machine's own pages by default.

    Raises:
        CaptureError: the address cannot be listened on.
        ConfigError: the SDK is not installed.
    """
    return FoxgloveSink(
        bench.mission,
        bench.types,
        info,
        listen=listen,
        levels=LEVELS,
        statistics=statistics,
        publisher=publisher,
        player=player,
        structs=bench.columns.context.structs,
        guard=guard,
    )


def live(
    source: Source,
    bench: Workbench,
    sink: FoxgloveSink,
    *,
    selection: Selection | None = None,
    target: Target | None = None,
    clock: Callable[[], int],
    duration_ns: int = 0,
    count: int = 0,
    watcher: Watcher | None = None,
) -> Report:
    """Show everything that a live source gives until it ends, Ctrl-C, or a limit.

    Args:
        source: where datagrams come from; it is closed.
        bench: mission, types and decoders.
        sink: from ``attach``; it is closed.
        selection: which datagrams; all by default.
        target: what to record at the same time.
        clock: monotonic time in ns.
        duration_ns: stop after so long; 0 never.
        count: stop after so many datagrams; 0 never.
        watcher: shown the report after every batch.

    Raises:
        CaptureError: the recording cannot be written.
        RouteError: the selection names a topic that is not configured.
        ConfigError: its filter has a mistake.
    """
    try:
        if target is not None:
            return record(
                source,
                bench,
                target,
                selection=selection,
                clock=clock,
                duration_ns=duration_ns,
                count=count,
                watcher=watcher,
                tap=sink.write,
            )
        report = Report(Ledger(bench.mission), source)
        try:
            chosen = (selection or Selection()).over(bench)
        except EdorasError:
            source.close()
            raise
        pour(
            source,
            bench,
            sink,
            report,
            selection=chosen,
            clock=clock,
            duration_ns=duration_ns,
            count=count,
            watcher=watcher,
        )
        return report
    finally:
        sink.close(source.statistics)
