"""``edoras live``: a link, or a recording, in Foxglove."""

from __future__ import annotations

import sys
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from edoras_tools.cli import options, sending
from edoras_tools.cli.sim import Scenario

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from edoras_tools.errors import EdorasError
    from edoras_tools.model import Endpoint, SourceInfo, SourceStatistics
    from edoras_tools.pipelines.live_publish import Commands, Send
    from edoras_tools.pipelines.live_sim import RunningSimulation
    from edoras_tools.pipelines.orders import To
    from edoras_tools.pipelines.record import Report
    from edoras_tools.pipelines.selection import Selection
    from edoras_tools.pipelines.workbench import Settings, Workbench
    from edoras_tools.sinks.foxglove import FoxgloveSink
    from edoras_tools.sources.device import DeviceSource
    from edoras_tools.websocket import Guard
    from edoras_tools.wire.sbn import Peer

Show = Callable[["SourceInfo", "SourceStatistics"], "FoxgloveSink"]
"""Attaches Foxglove to what is about to run."""

_publishing = partial(typer.Option, rich_help_panel="Publishing")
_playback = partial(typer.Option, rich_help_panel="Playback")


def place(text: str) -> Endpoint:
    """Read ``[HOST:]PORT``; alone, a port is one of this machine's own address."""
    return sending.endpoint(text if ":" in text else f"127.0.0.1:{text}")


Shown = Annotated[
    Any,
    typer.Option(
        "--live",
        metavar="[HOST:]PORT",
        parser=place,
        help="Show it in Foxglove meanwhile, at 8765 or so; 0: any.",
    ),
]
"""An option of whatever can be looked at while it runs; ``showing`` makes of it what a recorder takes."""
Origins = Annotated[
    list[str] | None,
    typer.Option(
        "--allow-origin",
        metavar="ORIGIN",
        help="Foxglove: let in web pages from there too, as https://viz.example.org; repeatable.",
    ),
]


def showing(bench: Workbench, where: Endpoint | None, origins: Sequence[str] | None) -> Show | None:
    """Return what attaches Foxglove, and says where to look; None where nobody wants it."""
    if where is None:
        return None
    guard = _guard(origins)

    def show(info: SourceInfo, statistics: SourceStatistics) -> FoxgloveSink:
        from edoras_tools.pipelines.live import attach

        sink = attach(bench, info, listen=where, statistics=statistics, guard=guard)
        _say(info.name, sink)
        return sink

    return show


@options.takes_decoding
@options.takes_choice
def live(
    settings: Settings,
    selection: Selection,
    files: Annotated[
        list[Path] | None,
        typer.Argument(metavar="[FILE]...", help="A recording or capture to play back; several are one."),
    ] = None,
    interface: options.Interface = None,
    listen: options.Listen = None,
    sim: Annotated[
        Scenario | None, typer.Option("--sim", help="An emulated cFS, and its bridges and robots.")
    ] = None,
    host: Annotated[
        str, typer.Option(metavar="ADDRESS", help="Where Foxglove connects to; this machine only.")
    ] = "127.0.0.1",
    ws_port: Annotated[
        int,
        typer.Option(
            "--ws-port", metavar="PORT", min=0, max=65535, help="And at which port; 0 for any that is free."
        ),
    ] = 8765,
    allow_origin: Origins = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="FILE", help="Record at the same time, as record does."),
    ] = None,
    speed: Annotated[
        float | None,
        _playback(metavar="X", parser=sending.positive, help="Times the recorded speed, at first."),
    ] = None,
    paused: Annotated[bool, _playback("--paused", help="Begin paused: play is pressed in Foxglove.")] = False,
    allow_publish: Annotated[
        list[str] | None,
        _publishing(metavar="PATTERN", help="Foxglove may send topics that fit into cFS; repeatable."),
    ] = None,
    target: Annotated[
        Any,
        _publishing(
            "--target",
            metavar="HOST:PORT",
            parser=sending.endpoint,
            help="Where cFS is; this machine unless it is named.",
        ),
    ] = None,
    sender: Annotated[
        Any, _publishing("--as", metavar="SC:CPU", parser=sending.peer, help="SBN: send as this peer.")
    ] = None,
    yes: sending.Yes = False,
    count: options.Count = None,
    duration: options.Duration = None,
    every: Annotated[
        bool, typer.Option("--all", "-a", help="Live: also UDP that belongs to no link.")
    ] = False,
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Show a link, or a recording, in Foxglove: topics, events, statistics, diagnostics.

    For example: edoras live -i lo -c rover.yaml; or edoras live --sim two-rovers
    """
    from edoras_tools.cli.output import print_json
    from edoras_tools.errors import ConfigError
    from edoras_tools.model import Endpoint
    from edoras_tools.pipelines.live import attach
    from edoras_tools.render.foxglove import served

    if sum(map(bool, (files, interface, listen, sim))) != 1:
        raise ConfigError("name one source: FILE, -i IFACE, --listen PORT or --sim DEMO")
    if files and (allow_publish or output or every or count):
        raise ConfigError("a recording is played back: --allow-publish, -o, -a and -n go with live traffic")
    if not files and (paused or speed):
        raise ConfigError("live traffic has its own speed: --speed and --paused go with a recording")
    serve = partial(attach, listen=Endpoint(host, ws_port), guard=_guard(allow_origin))
    report = None
    if files:
        summary, failure = _play(
            files, settings, selection, serve, speed or 1.0, duration, paused=paused, quiet=quiet or json
        )
    else:
        failure = None
        with ExitStack() as stack:
            source, bench, outlets = _source(interface, listen, sim, settings, every=every)
            stack.callback(source.close)
            commands = _commands(bench, allow_publish, target, sender, outlets, yes=yes)
            if commands:
                stack.callback(commands.close)
                commands.open()
            summary, report = _show(
                source, bench, selection, serve, commands, output, duration, count, quiet=quiet or json
            )
    if json:
        print_json(summary)
    elif not quiet:
        sys.stderr.write("".join(f"{line}\n" for line in served(summary["foxglove"])))
    if failure is not None:
        raise failure
    if report is not None:
        from edoras_tools.cli.endings import finish

        finish(report, live=True)


def _play(
    files: Sequence[Path],
    settings: Settings,
    selection: Selection,
    serve: Callable[..., FoxgloveSink],
    speed: float,
    duration: int | None,
    *,
    paused: bool,
    quiet: bool,
) -> tuple[dict[str, Any], EdorasError | None]:
    """Play a recording back; return what became of it, and what was wrong with it."""
    from time import monotonic_ns

    from edoras_tools.pipelines.interrupt import on_interrupt
    from edoras_tools.pipelines.live_player import RecordingPlayer, look_into
    from edoras_tools.render import units

    info, bench, reopen = look_into(files, settings)
    player = RecordingPlayer(
        reopen, bench, clock=monotonic_ns, selection=selection, speed=speed, paused=paused
    )
    start_ns, end_ns = player.range_ns
    sink = serve(bench, info, player=player)
    with on_interrupt(player.stop):
        _say(info.name, sink)
        if not quiet:
            begins = "Play is pressed there" if paused else "somebody looks"
            _write(f"plays {units.duration((end_ns - start_ns) / 1e9)} once {begins}; Ctrl-C ends")
        player.run(sink, duration_ns=duration or 0)
    summary = {"source": info.name, "kind": info.kind, "start_ns": start_ns, "end_ns": end_ns}
    return {**summary, "foxglove": sink.summary()}, player.failure


def _show(
    source: DeviceSource | RunningSimulation,
    bench: Workbench,
    selection: Selection,
    serve: Callable[..., FoxgloveSink],
    commands: Commands | None,
    output: Path | None,
    duration: int | None,
    count: int | None,
    *,
    quiet: bool,
) -> tuple[dict[str, Any], Report]:
    """Show live traffic; return what became of it."""
    from time import monotonic_ns

    from edoras_tools.pipelines.interrupt import on_interrupt
    from edoras_tools.pipelines.live import live as run
    from edoras_tools.pipelines.record import Target, check_target
    from edoras_tools.render.watch import watcher

    goal = Target(output) if output else None
    if goal:
        check_target(goal, ())
    sink = serve(bench, source.info, statistics=source.statistics, publisher=commands)
    with on_interrupt(source.stop), watcher(source, output, quiet=quiet, live=True) as watch:
        _say(source.info.name, sink)
        report = run(
            source,
            bench,
            sink,
            selection=selection,
            target=goal,
            clock=monotonic_ns,
            duration_ns=duration or 0,
            count=count or 0,
            watcher=watch,
        )
    return {**report.summary(), "foxglove": sink.summary()}, report


def _source(
    interface: str | None,
    listen: list[str] | None,
    sim: Scenario | None,
    settings: Settings,
    *,
    every: bool,
) -> tuple[DeviceSource | RunningSimulation, Workbench, Mapping[To, Send]]:
    """Open live traffic; return with it what sends commands there without a socket."""
    if sim is not None:
        from time import monotonic_ns

        from edoras_tools.pipelines.live_sim import start
        from edoras_tools.pipelines.orders import To

        running, bench = start(sim.value, settings, monotonic_ns)
        return running, bench, {To.CI: running.command}
    from edoras_tools.cli.inputs import open_input
    from edoras_tools.sources.device import DeviceSource

    source, bench = open_input(None, interface, listen, settings, every_port=every)
    assert isinstance(source, DeviceSource)
    return source, bench, {}


def _commands(
    bench: Workbench,
    allow: list[str] | None,
    target: Endpoint | None,
    sender: Peer | None,
    outlets: Mapping[To, Send],
    *,
    yes: bool,
) -> Commands | None:
    """Make what takes messages from Foxglove, once it is sure where they would go."""
    if not allow:
        return None
    from edoras_tools.pipelines.live_publish import Commands
    from edoras_tools.pipelines.orders import Orders
    from edoras_tools.pipelines.safety import check_target

    commands = Commands(bench, allow, Orders(target=target, sender=sender), outlets=outlets)
    asks = sys.stdin is not None and sys.stdin.isatty() and sys.stderr.isatty()
    for orders in commands.orders.values():
        assert orders.target is not None
        check_target(orders.target, yes=yes, confirm=partial(typer.confirm, err=True) if asks else None)
    return commands


def _guard(origins: Sequence[str] | None) -> Guard:
    from edoras_tools.websocket import Guard

    return Guard(tuple(origins or ()), lambda text: _write(f"edoras: {text}"))


def _write(line: str) -> None:
    sys.stderr.write(f"{line}\n")
    sys.stderr.flush()


def _say(name: str, sink: FoxgloveSink) -> None:
    """Say where to look, before anything else: scripts wait for it."""
    _write(f"{name} in Foxglove: {sink.server.app_url}")
