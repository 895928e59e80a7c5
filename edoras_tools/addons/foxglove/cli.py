"""``edoras live``: shows a link or a recording in Foxglove."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from shutil import get_terminal_size
from time import monotonic_ns
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

from msgspec.structs import replace
from typer import Option

from edoras_tools import doors
from edoras_tools.cli import options, recordings, sending
from edoras_tools.cli.inputs import InputOptions, open_input
from edoras_tools.cli.options import grouped, headed
from edoras_tools.cli.output import (
    Metrics,
    address,
    end,
    file_progress,
    finish,
    measured,
    place,
    print_json,
    say,
    tell,
    tell_reach,
    watcher,
)
from edoras_tools.cli.relays import Origins, Token
from edoras_tools.errors import ConfigError, EdorasError
from edoras_tools.words import plural

if TYPE_CHECKING:
    from edoras_tools.addons.foxglove.player import RecordingPlayer
    from edoras_tools.addons.foxglove.publish import CommandPublisher, Send
    from edoras_tools.addons.foxglove.server.page import OriginCheck
    from edoras_tools.addons.foxglove.server.protocol import PlaybackState
    from edoras_tools.addons.foxglove.server.sink import FoxgloveSink, ServedSink
    from edoras_tools.io import Source
    from edoras_tools.io.formats.capture_file import SettledFile
    from edoras_tools.model import Endpoint, SourceInfo, SourceStatistics
    from edoras_tools.pipelines.reading import Limits
    from edoras_tools.pipelines.selection import Selection
    from edoras_tools.pipelines.sending.options import Receiver
    from edoras_tools.pipelines.workbench import Settings, Workbench


class SourceOptions(NamedTuple):
    """The source."""

    inputs: InputOptions = InputOptions()
    sim: Annotated[options.Scenario | None, Option(help="An emulated cFS, its bridges and robots.")] = None


class OutputOptions(NamedTuple):
    """The server and the recording."""

    live: Annotated[Any, Option(parser=place, metavar="[HOST:]PORT", help="For Foxglove; 0: free.")] = "8765"
    host: Annotated[str | None, Option(hidden=True)] = None
    ws_port: Annotated[int | None, Option(min=0, max=65535, hidden=True)] = None
    allow_origin: Origins = None
    token: Token = None
    output: recordings.Output = None
    force: recordings.Force = False
    metrics: Metrics = None

    def endpoint(self) -> Endpoint:
        """Return the address for Foxglove."""
        base: Endpoint = self.live
        port = base.port if self.ws_port is None else self.ws_port
        return replace(base, address=self.host or base.address, port=port)


@headed("Playback")
class PlaybackOptions(NamedTuple):
    """Settings of playback."""

    speed: Annotated[float | None, Option(parser=sending.factor, help="Factor; default 1.")] = None
    paused: Annotated[bool, Option("--paused", help="Start paused; play in Foxglove, or space here.")] = False
    loop: Annotated[bool, Option("--loop", help="Start again at the end.")] = False
    wait: Annotated[bool, Option(" /--no-wait", help="Do not wait for the first client.")] = True


@headed("Publishing")
class PublishingOptions(NamedTuple):
    """Topics that Foxglove may publish, and their receiver."""

    allow: Annotated[list[str] | None, Option(help="Topics that Foxglove may send to cFS.")] = None
    target: Annotated[Any, Option(parser=address, help="Where cFS is; default: this machine.")] = None
    sender: Annotated[Any, Option("--as", parser=sending.peer, help="SBN: send as this peer.")] = None
    yes: sending.Yes = False

    def commands(self, bench: Workbench, outlets: Mapping[Receiver, Send]) -> CommandPublisher | None:
        """Return a publisher of Foxglove's messages after the target is confirmed; None if not allowed."""
        if not self.allow:
            return None
        from edoras_tools.addons.foxglove.publish import CommandPublisher
        from edoras_tools.pipelines.sending.options import SendOptions

        where = SendOptions(target=self.target, sender=self.sender)
        commands = CommandPublisher(bench, self.allow, where, outlets=outlets)
        for send_options in commands.options.values():
            assert send_options.target is not None
            sending.confirm_targets(send_options.target, confirmed=self.yes)
        return commands


class StopOptions(NamedTuple):
    """Limits of live traffic, and of the time that a source is shown."""

    limits: options.PartOptions
    every: Annotated[bool, Option("--all", "-a", hidden=True)] = False


@grouped
def live(
    source: SourceOptions,
    outputs: OutputOptions,
    playback: PlaybackOptions,
    publishing: PublishingOptions,
    stop: StopOptions,
    printing: options.PrintOptions,
    filters: options.SelectionOptions,
    decoding: options.DecodingOptions,
) -> None:
    """Show a link or a recording in Foxglove.

    For example: edoras live --sim two-rovers; or edoras live -i lo -c rover.yaml
    """
    from edoras_tools.addons.foxglove.player import attach, attach_player
    from edoras_tools.addons.foxglove.player import live as run
    from edoras_tools.pipelines.reading import on_interrupt

    (_, live_options), sim = source
    (json, quiet), limits = printing, stop.limits.limits()
    if sum(map(bool, (source.inputs.paths, live_options.interface, live_options.listen, sim))) != 1:
        raise ConfigError("name one source: FILE, -i IFACE, --listen PORT or --sim DEMO")
    files, stream = _piped(source.inputs.paths)
    if files and (
        publishing.allow or outputs.output or outputs.metrics or stop.every or stop.limits.datagrams
    ):
        raise ConfigError(
            "--allow, -o, --metrics, -a and -n can only be used with live traffic, not with a recording"
        )
    if not files and playback != PlaybackOptions():
        raise ConfigError(
            "--speed, --paused, --loop and --no-wait can only be used with a recording, not with live traffic"
        )
    if playback.paused and not playback.wait:
        raise ConfigError("--no-wait starts at once, and --paused does not start: use one of them")
    goal = recordings.recording_target(outputs.output, force=outputs.force)
    settings, selection = decoding.settings(), filters.selection()
    serving: dict[str, Any] = {
        "listen": outputs.endpoint(),
        "origins": _origin_check(outputs.allow_origin),
        "token": outputs.token or "",
    }
    report = failure = None
    if files:
        serve = partial(attach_player, **serving)
        summary, failure = _play(files, settings, selection, serve, playback, limits, quiet=quiet or json)
    else:
        with ExitStack() as stack:
            traffic, bench, outlets = _traffic(source, stream, settings, outputs.output, every=stop.every)
            stack.callback(traffic.close)
            commands = publishing.commands(bench, outlets)
            if commands:
                stack.callback(commands.close)
                commands.open()
            shown = watcher(traffic, goal.path if goal else None, quiet=quiet or json, live=True)
            shown = measured(shown, outputs.metrics)
            sink = attach(bench, traffic.info, statistics=traffic.statistics, publisher=commands, **serving)
            with on_interrupt(traffic.stop), shown as watch:
                _say(traffic.info.name, sink, commands.topics if commands else ())
                report = run(
                    traffic, bench, sink, selection=selection, target=goal, limits=limits, watcher=watch
                )
            summary = {**report.summary(), "foxglove": sink.summary()}
    if json:
        print_json(summary)
    elif not quiet:
        say(*served(summary["foxglove"]))
    end(failure=failure)
    if report is not None:
        finish(report, live=True)


def _piped(paths: Sequence[Path]) -> tuple[Sequence[Path | SettledFile], Source | None]:
    """Return the recordings to play, or a live capture: standard input and a named pipe may be either."""
    if len(paths) != 1 or not (str(paths[0]) == "-" or paths[0].is_fifo()):
        return paths, None
    from edoras_tools.io.formats.capture_file import SettledFile
    from edoras_tools.io.formats.open import kept_recording

    opened = kept_recording(paths[0])
    return ([opened], None) if isinstance(opened, SettledFile) else ((), opened)


def _play(
    files: Sequence[Path | SettledFile],
    settings: Settings,
    selection: Selection,
    serve: Callable[..., ServedSink],
    playback: PlaybackOptions,
    limits: Limits,
    *,
    quiet: bool,
) -> tuple[dict[str, Any], EdorasError | None]:
    """Play a recording; return a summary, and the error if the recording is cut off."""
    from edoras_tools import words
    from edoras_tools.addons.foxglove import player as playing
    from edoras_tools.pipelines.doctor import Scope
    from edoras_tools.pipelines.reading import on_interrupt

    info, bench, reopen = playing.open_recording(files, settings)
    how = playing.PlaybackOptions(playback.speed or 1.0, playback.paused, playback.wait, playback.loop)
    scope = Scope(selection, limits.period)
    with file_progress([info.name], quiet=quiet) as bar:
        player = playing.RecordingPlayer(
            reopen, bench, clock=monotonic_ns, scope=scope, options=how, progress=bar
        )
    start_ns, end_ns = player.range_ns
    sink = serve(bench, info, player)
    with on_interrupt(player.stop):
        _say(info.name, sink)
        if not quiet:
            begins = "when play is pressed" if playback.paused else "when a client has subscribed"
            begins = begins if playback.wait else "now"
            say(f"plays {words.duration((end_ns - start_ns) / 1e9)} {begins}; Ctrl-C ends")
        with _keyboard(player, sink, quiet=quiet) as (keys, show):
            player.run(sink, duration_ns=limits.duration_ns, keys=keys, show=show)
    summary = {"source": info.name, "kind": info.kind, "start_ns": start_ns, "end_ns": end_ns}
    return {**summary, "foxglove": sink.summary()}, player.failure


@contextmanager
def _keyboard(
    player: RecordingPlayer, sink: ServedSink, *, quiet: bool
) -> Iterator[tuple[Callable[[], str], Callable[[PlaybackState], None]]]:
    """Give the functions that read keys and show the state; without a terminal they do nothing."""
    tty = sys.stdin.isatty() and sys.stderr.isatty()
    if quiet or not tty or os.tcgetpgrp(sys.stdin.fileno()) != os.getpgrp():  # not a job in the background
        yield str, lambda _: None
        return
    from edoras_tools.addons.foxglove.player import HELP
    from edoras_tools.pipelines.reading import Keys

    def show(state: PlaybackState) -> None:
        line = playback_line(state, player.range_ns, len(sink.server.clients), waiting=player.waiting)
        now = line, monotonic_ns() // 1_000_000_000  # repeat it each second: a message may have replaced it
        if now not in latest:
            latest[:] = [now]
            sys.stderr.write(f"\x1b[K{line}  {HELP}"[: get_terminal_size().columns + 2] + "\r")
            sys.stderr.flush()

    latest: list[tuple[str, int]] = []
    with Keys() as keyboard:
        yield keyboard.pressed, show
    sys.stderr.write("\x1b[K")


def _traffic(
    request: SourceOptions, stream: Source | None, settings: Settings, output: Path | None, *, every: bool
) -> tuple[Source, Workbench, Mapping[Receiver, Send]]:
    """Open the live source; return it, its workbench, and functions that send commands without a socket."""
    if request.sim is not None:
        from edoras_tools.pipelines.sending.options import Receiver

        running, bench = doors.part("simulation")(request.sim.value, settings, monotonic_ns)
        return running, bench, {Receiver.CI: running.command}
    if stream is not None:
        return stream, settings.workbench(stream.info), {}
    source, bench = open_input(request.inputs, settings, every_port=every, output=output)
    return source, bench, {}


def server(
    bench: Workbench, listen: Endpoint, origins: Sequence[str] | None, token: str | None
) -> Callable[[SourceInfo, SourceStatistics], FoxgloveSink]:
    """Return a function that starts a server for a command that relays traffic, and prints its address.

    Raises:
        ConfigError: an origin is not valid.
    """
    from edoras_tools.addons.foxglove.player import attach

    check, word = _origin_check(origins), token or ""

    def start(info: SourceInfo, statistics: SourceStatistics) -> FoxgloveSink:
        sink = attach(bench, info, listen=listen, statistics=statistics, origins=check, token=word)
        _say(info.name, sink)
        return sink

    return start


def _origin_check(origins: Sequence[str] | None) -> OriginCheck:
    from edoras_tools.addons.foxglove.server.page import OriginCheck

    return OriginCheck(tuple(origins or ()), tell)


def _say(name: str, sink: ServedSink, publishes: Sequence[str] = ()) -> None:
    """Print the address first, because scripts wait for this line; then our own page, and who may connect."""
    server, may = sink.server, "watch"
    if publishes:
        may += f" and publish {', '.join(publishes)} into cFS"
    if server.asks_token:
        say(f"{name} in Foxglove: open a connection to {server.url}/?token=... with your token")
        say(f"or in a browser: {server.page_url}?token=...")
        tell_reach(server.endpoint, may, who="every client that can reach it and has the token")
    else:
        say(f"{name} in Foxglove: {server.app_url}")
        say(f"or in a browser: {server.page_url}")
        tell_reach(server.endpoint, may, instead="with --token, clients must give a token")


def served(summary: Mapping[str, Any]) -> Iterator[str]:
    """Yield one line for all clients, and one for each client that was too slow.

    Args:
        summary: result of ``FoxgloveServer.summary``.
    """
    clients = summary["clients"]
    parts = [
        f"Foxglove: {plural(summary['connections'], 'client')}",
        f"{plural(summary['sent'], 'message')} sent",
    ]
    if summary["published"] or summary["refused"]:
        parts.append(f"{summary['published']:,} taken from them, {summary['refused']:,} refused")
    yield ", ".join(parts)
    for client in clients:
        if client["dropped"]:
            of = client["dropped"] + client["sent"] + client["waiting"]
            yield f"{client['address']} was too slow for {client['dropped']:,} of {of:,} messages"


def playback_line(state: PlaybackState, range_ns: tuple[int, int], clients: int, *, waiting: bool) -> str:
    """Return a line such as ``playing 0:12.3 of 1:40.0, 2x, 1 client``.

    Args:
        range_ns: start and end of the recording, ns since 1970.
        waiting: whether it waits for the first client.
    """
    start, end = range_ns
    status = "waits for a client at" if waiting else state.status.lower()
    return (
        f"{status} {_clock(state.time_ns - start)} of {_clock(end - start)}, {state.speed:g}x, "
        f"{plural(clients, 'client')}"
    )


def _clock(time_ns: int) -> str:
    tenths = time_ns // 100_000_000
    return f"{tenths // 600}:{tenths % 600 / 10:04.1f}"
