"""Plays a recording to Foxglove, which controls it: play, pause, seek, speed.

Keys of the terminal control it too, for clients without controls.

``live`` shows live traffic: of an interface, sockets, an emulated cFS. Two lines attach another pipeline::

    sink = attach(bench, source.info, statistics=source.statistics)
    record(source, bench, target, tap=sink.write)  # then sink.close(source.statistics)
"""

from __future__ import annotations

import re
import socket
import threading
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing
from typing import TYPE_CHECKING, Final

import msgspec
import numpy as np
from msgspec.structs import replace

from edoras_tools.addons.foxglove.server.page import OriginCheck
from edoras_tools.addons.foxglove.server.protocol import PlaybackRequest, PlaybackState, Player, Publisher
from edoras_tools.addons.foxglove.server.server import HERE, ServerOptions
from edoras_tools.addons.foxglove.server.sink import FoxgloveSink, LinkMonitor, RecordedSink, ServedSink
from edoras_tools.errors import CaptureError, EdorasError
from edoras_tools.io.formats.capture_file import SettledFile
from edoras_tools.io.net.sockets import is_loopback
from edoras_tools.links.table import LinkStates
from edoras_tools.pipelines.capture.record import CaptureReport, Target, pour, record
from edoras_tools.pipelines.doctor import Scope
from edoras_tools.pipelines.messages import open_inputs
from edoras_tools.pipelines.reading import Limits, RunCounter, on_interrupt, reading
from edoras_tools.pipelines.selection import Selection, outside
from edoras_tools.pipelines.workbench import Settings, Workbench, open_files
from edoras_tools.render.severity import EXPLANATIONS, Level
from edoras_tools.units import MILLISECOND, SECOND

if TYPE_CHECKING:
    from pathlib import Path

    from edoras_tools.io import Source
    from edoras_tools.links.doors import OwnRows
    from edoras_tools.model import Columns, Endpoint, PacketBatch, SourceInfo, SourceStatistics
    from edoras_tools.render.terminal.text import Progress, Watcher

HELP: Final = "space, ←→ 5 s, ↑↓ speed, Home, q"
_KEY: Final = re.compile(r"\x1b[\[o]\d*~?[a-z]?|.", re.DOTALL)
_STEPS_NS: Final = {"\x1b[c": 5 * SECOND, "\x1boc": 5 * SECOND, "\x1b[d": -5 * SECOND, "\x1bod": -5 * SECOND}
_FACTORS: Final = {"\x1b[a": 2.0, "\x1boa": 2.0, "+": 2.0, "\x1b[b": 0.5, "\x1bob": 0.5, "-": 0.5}
_HOME: Final = ("\x1b[h", "\x1boh", "\x1b[1~", "0")


def split_keys(text: str) -> Iterator[str]:
    """Yield the keys in a terminal's input, in lower case: characters, and sequences (``ESC [ a``)."""
    yield from _KEY.findall(text)


def request_of(key: str, state: PlaybackState, start_ns: int) -> PlaybackRequest | None:
    """Return the request of a key; None for a key without a meaning.

    Args:
        key: from ``split_keys``.
        start_ns: start of the recording, ns since 1970.
    """
    playing = state.status == "Playing"
    if key == " ":
        return PlaybackRequest(not playing, state.speed)
    if key in _STEPS_NS:
        return PlaybackRequest(playing, state.speed, max(state.time_ns + _STEPS_NS[key], start_ns))
    if key in _FACTORS:
        return PlaybackRequest(playing, state.speed * _FACTORS[key])
    if key in _HOME:
        return PlaybackRequest(playing, state.speed, start_ns)
    return None


_TICK_S: Final = 0.02
"""Interval at which messages are sent and requests are handled, s."""
_SETTLED_NS: Final = 300 * MILLISECOND
"""Time without a new subscription after which subscriptions are complete: clients send them one by one."""
_PATIENCE_NS: Final = 5 * SECOND
"""Time after which a client without subscriptions is taken to show only the list of topics."""
_SLOWEST: Final = 1e-3
_FASTEST: Final = 1e4

_Piece = tuple["PacketBatch", "Columns"]


class PlaybackOptions(msgspec.Struct, frozen=True):
    """Start and end of playback.

    Attributes:
        speed: initial speed, as a multiple of the recorded one.
        paused: whether to start paused.
        wait: whether to wait until the first client has subscribed, or has been connected for 5 s.
        loop: whether to start again at the end.
    """

    speed: float = 1.0
    paused: bool = False
    wait: bool = True
    loop: bool = False


class _Playback(msgspec.Struct):
    """The state of playback: it was at ``at_ns`` when the monotonic clock showed ``since_ns``.

    ``seek_ns`` is the time to seek to, until that is done; else None.
    """

    playing: bool
    speed: float
    at_ns: int
    since_ns: int
    seek_ns: int | None
    ended: bool = False


def open_recording(
    paths: Sequence[Path | SettledFile], settings: Settings
) -> tuple[SourceInfo, Workbench, Callable[[], Source]]:
    """Return information on files, their workbench, and a function that opens them, any number of times.

    Raises:
        CaptureError: a file cannot be opened, or only once.
        ConfigError: the mission has errors.
    """
    files = [path if isinstance(path, SettledFile) else _settled(path) for path in paths]
    source, bench = open_inputs([item.path for item in files], settings)
    source.close()
    info = replace(source.info, name=", ".join(item.name for item in files))

    def reopen() -> Source:  # its closure also keeps the temporary copies
        again = [item.path for item in files]
        return open_inputs(again, settings)[0] if bench.mission.recorded else open_files(again)

    return info, bench, reopen


def _settled(path: Path) -> SettledFile:
    if str(path) == "-" or path.is_fifo() or path.is_char_device():
        raise CaptureError(f"{path}: playback reads it several times; save it to a file first")
    return SettledFile(path, str(path))


class RecordingPlayer:
    """Plays a source at its own times.

    At every seek the recording is read again from its start: none of it is kept in memory.

    Args:
        reopen: opens the source; called for every seek, and once in the constructor to read its duration.
        clock: function that returns monotonic time, ns.
        scope: datagrams and period; all by default.

    Attributes:
        range_ns: start and end of the recording, ns since 1970.
        failure: error if it is cut off; everything readable is played.

    Raises:
        CaptureError: the recording has no selected datagram.
        ConfigError: the filter has an error.
        RouteError: the selection names a topic that is not configured.
    """

    def __init__(
        self,
        reopen: Callable[[], Source],
        bench: Workbench,
        *,
        clock: Callable[[], int],
        scope: Scope | None = None,
        options: PlaybackOptions = PlaybackOptions(),  # noqa: B008  frozen
        progress: Progress | None = None,
    ) -> None:
        self._reopen, self._bench, self._clock, self._options = reopen, bench, clock, options
        scope = scope or Scope()
        self._selection, self._period = scope.selection.over(bench), scope.period
        self._begin_ns: int | None = None
        self.failure: EdorasError | None = None
        self.range_ns = self._measure(progress)
        self._lock = threading.Lock()
        self._wake = threading.Event()
        self._stopping = False
        start_ns = self.range_ns[0]
        self._playback = _Playback(not options.paused, options.speed, start_ns, clock(), start_ns)
        self._held = options.wait or options.paused  # nothing is played, not even the first message

    @property
    def state(self) -> PlaybackState:
        """The present state of playback."""
        with self._lock:
            return self._state(self._clock())

    @property
    def waiting(self) -> bool:
        """Whether it waits for the first client."""
        return self._held and self._playback.playing

    def control(self, request: PlaybackRequest) -> PlaybackState:
        """Apply a client's request; return the state after it."""
        with self._lock:
            now, playback = self._clock(), self._playback
            playback.at_ns, playback.since_ns = self._position(now), now
            if _SLOWEST <= request.speed <= _FASTEST:  # a client may send any value
                playback.speed = float(request.speed)
            start, end = self.range_ns
            seek_ns = request.seek_ns
            if seek_ns is None and request.playing and playback.ended:
                seek_ns = start  # play again
            if seek_ns is not None:
                playback.at_ns = playback.seek_ns = min(max(seek_ns, start), end)
                playback.ended = False
            playback.playing, self._held = request.playing, False
            self._wake.set()
            return self._state(now, seeked=seek_ns is not None)

    def stop(self) -> None:
        """End ``run``; for any thread or signal handler."""
        self._stopping = True
        self._wake.set()

    def run(
        self,
        sink: ServedSink,
        *,
        duration_ns: int = 0,
        keys: Callable[[], str] = str,
        show: Callable[[PlaybackState], None] = lambda _: None,
    ) -> bool:
        """Play until ``stop``, Ctrl-C or the duration; return whether it was Ctrl-C. The sink is closed.

        Args:
            sink: from ``attach``, with this as its player.
            duration_ns: stop after this time by the clock; 0: never.
            keys: returns the keys pressed since the last call, in lower case.
            show: called with the state several times a second.
        """
        until = self._clock() + duration_ns if duration_ns else 1 << 63
        pieces, piece = self._read(0, sink), None
        before, settled_ns = (0, 0), 0
        try:
            with on_interrupt(self.stop) as interrupt:
                while not self._stopping and self._clock() < until:
                    came = len(sink.server.clients), sink.server.subscriptions
                    with self._lock:
                        now, playback = self._clock(), self._playback
                        if self._held and playback.playing:
                            playback.since_ns = now
                            if came != before:
                                before, settled_ns = came, now + (_SETTLED_NS if came[1] else _PATIENCE_NS)
                            self._held = not came[0] or now < settled_ns
                        paused, position, seek_ns = self._held, self._position(now), playback.seek_ns
                        playback.seek_ns = None
                    if seek_ns is not None:
                        pieces.close()
                        sink.restart()
                        pieces, piece = self._read(seek_ns, sink), None
                    if not paused:
                        piece = self._play(sink, pieces, piece, position)
                    self._tell(sink, position, over=not paused and piece is None)
                    for key in split_keys(keys()):
                        self._press(key, sink)
                    show(self.state)
                    self._wake.wait(_TICK_S)
                    self._wake.clear()
        finally:
            pieces.close()
            sink.server.close()
        return interrupt.is_set()

    def _press(self, key: str, sink: ServedSink) -> None:
        """Apply the request of a key, and send the state to the clients."""
        request = request_of(key, self.state, self.range_ns[0])
        if request is not None:
            sink.server.tell_state(self.control(request))
        elif key == "q":
            self.stop()

    def _play(
        self, sink: ServedSink, pieces: Generator[_Piece], piece: _Piece | None, position: int
    ) -> _Piece | None:
        """Write the messages that are due to the sink; return the next piece, None at the end."""
        piece = piece or next(pieces, None)
        while piece is not None and self._playback.seek_ns is None and not self._stopping:
            batch, columns = piece
            due = int(np.searchsorted(np.maximum.accumulate(batch.time_ns), position, side="right"))
            if due:
                sink.write(batch.take(slice(0, due)), columns.take(slice(0, due)))
            if due < len(batch):
                return batch.take(slice(due, None)), columns.take(slice(due, None))
            piece = next(pieces, None)
        return piece

    def _tell(self, sink: ServedSink, position: int, *, over: bool) -> None:
        with self._lock:
            playback = self._playback
            ends = over and playback.seek_ns is None and position >= self.range_ns[1] and not playback.ended
            if ends and self._options.loop:
                playback.at_ns = playback.seek_ns = self.range_ns[0]
                playback.since_ns = self._clock()
            elif ends:
                playback.ended, playback.playing, playback.at_ns = True, False, self.range_ns[1]
            state = self._state(self._clock())
        sink.show_time(state.time_ns)
        if ends:
            sink.server.tell_state(state)

    def _position(self, now: int) -> int:
        playback = self._playback
        moved = int((now - playback.since_ns) * playback.speed) if playback.playing and not self._held else 0
        return min(playback.at_ns + moved, self.range_ns[1])

    def _state(self, now: int, *, seeked: bool = False) -> PlaybackState:
        playback = self._playback
        status = "Ended" if playback.ended else "Playing" if playback.playing else "Paused"
        return PlaybackState(status, self._position(now), playback.speed, seeked)

    def _measure(self, progress: Progress | None) -> tuple[int, int]:
        """Read the recording once; return its start and end."""
        source = self._reopen()
        first, last, last_ns = 1 << 63, -1, -1
        for batch in self._batches(source):
            if progress is not None:
                progress.read(source)
            if len(batch):
                last_ns = max(last_ns, int(batch.time_ns.max()))
            if len(batch) and self._begin_ns is None:
                self._begin_ns = int(batch.time_ns[0])
                self._period = self._period.since(self._begin_ns)
            times = self._selected(batch)[0].time_ns
            if len(times):
                first, last = min(first, int(times.min())), max(last, int(times.max()))
        if last < 0 and self._period and self._begin_ns is not None and self.failure is None:
            raise outside(source.info.name, self._begin_ns, last_ns)
        if last < 0:
            unit = "message" if self._bench.mission.recorded else "datagram"
            raise self.failure or CaptureError(f"{source.info.name}: it contains no selected {unit}")
        return first, last

    def _batches(self, source: Source) -> Generator[PacketBatch]:
        """Yield the batches of a recording, as far as it can be read; the source is closed."""
        source.follow(self._bench.columns.context.framings)
        try:
            yield from source.batches()
        except CaptureError as error:
            self.failure = error
        finally:
            source.close()

    def _selected(self, batch: PacketBatch, own_rows: LinkStates[OwnRows] | None = None) -> _Piece:
        decode = self._bench.columns.decode
        columns = decode(batch)
        for own in own_rows.of(columns) if own_rows is not None else ():
            batch, columns = own.take(batch, columns, decode)
        batch, columns = self._selection.apply(batch, columns)
        if not self._period or self._begin_ns is None:
            return batch, columns
        rows = np.flatnonzero(self._period.holds(batch.time_ns - self._begin_ns))
        return batch.take(rows), columns.take(rows)

    def _read(self, start_ns: int, sink: ServedSink) -> Generator[_Piece]:
        """Yield the messages from a time on; before them, the last earlier message of each topic."""
        source, latest = self._reopen(), dict[int, _Piece]()
        context = self._bench.columns.context
        own_rows: LinkStates[OwnRows] = LinkStates(lambda link: link.rows(context))
        before, runs, part = True, RunCounter(source), 0
        with closing(self._batches(source)) as batches:
            for whole in batches:
                batch, columns = self._selected(whole, own_rows)
                if source.files and (now := runs.add(batch, columns)) != part:
                    part = now
                    self._pass_over(int(batch.time_ns[0]))
                first = int(np.searchsorted(np.maximum.accumulate(batch.time_ns), start_ns)) if before else 0
                routes, places = np.unique(columns.route[:first][::-1], return_index=True)
                for route, place in zip(routes.tolist(), places.tolist(), strict=True):
                    if route >= 0:
                        row = slice(first - 1 - place, first - place)
                        latest[route] = batch.take(row), columns.take(row)
                if first == len(batch):
                    continue
                if before:
                    before = False
                    _show(latest, sink)
                yield batch.take(slice(first, None)), columns.take(slice(first, None))

    def _pass_over(self, begin_ns: int) -> None:
        """Continue at the begin of another run, after everything before it is played."""
        with self._lock:
            now, playback = self._clock(), self._playback
            if playback.seek_ns is None and begin_ns > self._position(now):
                playback.at_ns, playback.since_ns = begin_ns, now


def _show(latest: dict[int, _Piece], sink: ServedSink) -> None:
    for batch, columns in sorted(latest.values(), key=lambda piece: int(piece[0].time_ns[0])):
        sink.write(batch, columns)
    if latest:
        sink.restart()  # these messages are not part of the later statistics


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
