"""Shows live traffic in Foxglove: of an interface, sockets, an emulated cFS, or any other pipeline.

Two lines attach it to any pipeline::

    sink = attach(bench, source.info, statistics=source.statistics)
    record(source, bench, target, tap=sink.write)  # then sink.close(source.statistics)
"""

from __future__ import annotations

import socket
from typing import TYPE_CHECKING, Final

from msgspec.structs import replace

from edoras_tools.addons.foxglove.server.page import OriginCheck
from edoras_tools.addons.foxglove.server.protocol import Player, Publisher
from edoras_tools.addons.foxglove.server.server import HERE, ServerOptions
from edoras_tools.addons.foxglove.server.sink import FoxgloveSink, LinkMonitor, RecordedSink, ServedSink
from edoras_tools.io.net.sockets import is_loopback
from edoras_tools.pipelines.capture.record import CaptureReport, Target, pour, record
from edoras_tools.pipelines.reading import Limits, reading
from edoras_tools.render.severity import EXPLANATIONS, Level

if TYPE_CHECKING:
    from edoras_tools.io import Source
    from edoras_tools.model import Endpoint, SourceInfo, SourceStatistics
    from edoras_tools.pipelines.selection import Selection
    from edoras_tools.pipelines.workbench import Workbench
    from edoras_tools.render.terminal.text import Watcher

__all__ = ["Publisher", "attach", "attach_player", "live", "monitor", "usual_address"]

LEVELS: Final = {finding: max(item.severity - Level.NOTE, 0) for finding, item in EXPLANATIONS.items()}
"""Level of each finding in ``diagnostic_msgs/msg/DiagnosticStatus``; notes are OK."""


def usual_address(port: int | None = None) -> Endpoint:
    """Return the address for Foxglove: the named port, else the usual port or any free port."""
    if port is None:
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            port = HERE.port
            try:
                probe.bind((HERE.address, port))
            except OSError:
                port = 0
    return replace(HERE, port=port)


def attach(
    bench: Workbench,
    info: SourceInfo,
    *,
    listen: Endpoint = HERE,
    statistics: SourceStatistics | None = None,
    publisher: Publisher | None = None,
    player: Player | None = None,
    origins: OriginCheck = OriginCheck(),  # noqa: B008  frozen
    token: str = "",
) -> FoxgloveSink:
    """Start a server; it shows batches that are passed to the sink's ``write``.

    Args:
        listen: address and port; with port 0 the system chooses, see ``server.endpoint``.
        statistics: statistics of the source, for losses of the capture itself.
        publisher: handles messages that clients publish; None: clients may not publish.
        player: plays a recording; None: the traffic is live.
        origins: web pages that may connect; by default those of Foxglove and of this machine.
        token: token that clients must have; see ``ServerOptions``.

    Raises:
        CaptureError: the address cannot be used.
        ConfigError: ``websockets`` is not installed.
    """
    options = ServerOptions(listen, origins, publisher, player, token)
    sink = FoxgloveSink(
        bench.columns.context, bench.types, info, options, levels=LEVELS, statistics=statistics
    )
    endpoint = sink.server.endpoint
    if info.kind == "live" and (info.name in {"lo", "any"} or not is_loopback(endpoint.address)):
        bench.columns.context.framings.pop(endpoint.port, None)  # the traffic of its page belongs to no link
    return sink


def monitor(bench: Workbench, info: SourceInfo, statistics: SourceStatistics, *, live: bool) -> LinkMonitor:
    """Return a monitor that judges and counts a link as the server's page shows it, without a server.

    Args:
        statistics: statistics of the source, for losses of the capture itself.
        live: see ``LinkMonitor``.
    """
    return LinkMonitor(bench.columns.context, bench.types, info.name, LEVELS, statistics, live=live)


def attach_player(
    bench: Workbench,
    info: SourceInfo,
    player: Player,
    *,
    listen: Endpoint = HERE,
    origins: OriginCheck = OriginCheck(),  # noqa: B008  frozen
    token: str = "",
) -> ServedSink:
    """Start a server for a recording that is played; see ``attach``.

    Raises:
        CaptureError: the address cannot be used.
        ConfigError: ``websockets`` is not installed.
    """
    if not bench.mission.recorded:
        return attach(bench, info, listen=listen, player=player, origins=origins, token=token)
    options = ServerOptions(listen, origins, None, player, token)
    return RecordedSink(bench.mission, bench.types, info, options)


def live(
    source: Source,
    bench: Workbench,
    sink: FoxgloveSink,
    *,
    selection: Selection | None = None,
    target: Target | None = None,
    limits: Limits = Limits(),  # noqa: B008  frozen
    watcher: Watcher[CaptureReport] | None = None,
) -> CaptureReport:
    """Show everything from a live source until it ends, Ctrl-C, or a limit.

    Args:
        source: source of the datagrams; it is closed.
        sink: from ``attach``; it is closed.
        selection: selection of datagrams; all by default.
        target: target of a recording at the same time.
        limits: conditions of the end; never by default.
        watcher: called with the report after every batch.

    Raises:
        CaptureError: the recording cannot be written.
        RouteError: the selection names a topic that is not configured.
        ConfigError: its filter has an error.
    """
    try:
        if target is not None:
            return record(
                source, bench, target, selection=selection, limits=limits, watcher=watcher, tap=sink.write
            )
        with reading(source, bench, selection, limits, keeps_failure=True) as loop:
            if source.on_this_host:
                sink.pace = lambda gather_s: source.pace(gather_s, gather_s)
            return pour(loop, sink, watcher=watcher, sequences=sink.sequences)
    finally:
        sink.close(source.statistics)
