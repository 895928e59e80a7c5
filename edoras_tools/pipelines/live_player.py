"""A recording played back to Foxglove, and steered from there: play, pause, seek, rate."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.errors import CaptureError
from edoras_tools.pipelines.interrupt import on_interrupt
from edoras_tools.pipelines.selection import Selection
from edoras_tools.pipelines.workbench import open_files
from edoras_tools.sinks.foxglove_offer import PlaybackState

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Sequence
    from pathlib import Path

    from edoras_tools.errors import EdorasError
    from edoras_tools.model import Columns, PacketBatch, SourceInfo
    from edoras_tools.pipelines.workbench import Settings, Workbench
    from edoras_tools.sinks.foxglove import FoxgloveSink
    from edoras_tools.sinks.foxglove_offer import PlaybackRequest
    from edoras_tools.sources import Source

_TICK_S: Final = 0.02
"""Messages go out so often, and what is asked is done so soon."""
_SLOWEST: Final = 1e-3
_FASTEST: Final = 1e4

_Piece = tuple["PacketBatch", "Columns"]


@dataclass(slots=True)
class _Course:
    """Where playback is: ``at_ns`` at ``since_ns`` of the monotonic clock, and on from there.

    ``seek_ns`` is where it has jumped to, until that is done.
    """

    playing: bool
    speed: float
    at_ns: int
    since_ns: int
    seek_ns: int | None
    ended: bool = False


def look_into(
    paths: Sequence[Path], settings: Settings
) -> tuple[SourceInfo, Workbench, Callable[[], Source]]:
    """Return what files are, what reads them, and what opens them, as often as it is asked.

    Raises:
        CaptureError: one cannot be opened, or not more than once.
        ConfigError: the mission has mistakes.
    """
    for path in paths:
        if str(path) == "-" or path.is_fifo() or path.is_char_device():
            raise CaptureError(f"{path}: cannot be read twice, as playback does; save it to a file first")
    source = open_files(paths)
    try:
        return source.info, settings.workbench(source.info), partial(open_files, paths)
    finally:
        source.close()


class RecordingPlayer:
    """Plays what a source holds, by its own times.

    The recording is read again from its start wherever playback jumps to: nothing of it is kept in memory.

    Args:
        reopen: opens the source; called for every jump, and once here to learn how long it is.
        bench: mission, types and decoders.
        clock: monotonic time in ns.
        selection: which datagrams; all by default.
        speed: times the recorded speed, at first.
        paused: begin paused; else it begins when the first client comes.

    Attributes:
        range_ns: when the recording starts and ends, ns since 1970.
        failure: why it is not whole, if it is not; what could be read is played.

    Raises:
        CaptureError: it holds no datagram that is chosen.
        ConfigError: the filter has a mistake.
        RouteError: the selection names a topic that is not configured.
    """

    def __init__(
        self,
        reopen: Callable[[], Source],
        bench: Workbench,
        *,
        clock: Callable[[], int],
        selection: Selection | None = None,
        speed: float = 1.0,
        paused: bool = False,
    ) -> None:
        self._reopen, self._bench, self._clock = reopen, bench, clock
        self._selection = (selection or Selection()).over(bench)
        self.failure: EdorasError | None = None
        self.range_ns = self._measure()
        self._lock = threading.Lock()
        self._wake = threading.Event()
        self._stopping = False
        self._course = _Course(not paused, speed, self.range_ns[0], clock(), self.range_ns[0])
        self._held = not paused

    @property
    def state(self) -> PlaybackState:
        """Where it is."""
        with self._lock:
            return self._state(self._clock())

    def control(self, request: PlaybackRequest) -> PlaybackState:
        """Do what is wanted soon; return where it will be."""
        with self._lock:
            now, course = self._clock(), self._course
            course.at_ns, course.since_ns = self._position(now), now
            if _SLOWEST <= request.speed <= _FASTEST:  # a client may ask for anything
                course.speed = float(request.speed)
            start, end = self.range_ns
            seek_ns = request.seek_ns
            if seek_ns is None and request.playing and course.ended:
                seek_ns = start  # play again
            if seek_ns is not None:
                course.at_ns = course.seek_ns = min(max(seek_ns, start), end)
                course.ended = False
            course.playing, self._held = request.playing, False
            self._wake.set()
            return self._state(now, seeked=seek_ns is not None)

    def stop(self) -> None:
        """End ``run``; for any thread or signal handler."""
        self._stopping = True
        self._wake.set()

    def run(self, sink: FoxgloveSink, *, duration_ns: int = 0) -> bool:
        """Play until ``stop``, Ctrl-C, or for so long; tell whether it was Ctrl-C. The sink is closed.

        Args:
            sink: from ``attach``, with this as its player.
            duration_ns: how long, by the clock; 0 for no end.
        """
        until = self._clock() + duration_ns if duration_ns else 1 << 63
        pieces, piece = self._read(0, sink), None
        try:
            with on_interrupt(self.stop) as asked:
                while not self._stopping and self._clock() < until:
                    with self._lock:
                        now, course = self._clock(), self._course
                        if self._held:
                            self._held, course.since_ns = not sink.server.visitors, now
                        position, seek_ns, course.seek_ns = self._position(now), course.seek_ns, None
                    if seek_ns is not None:
                        pieces.close()
                        sink.restart()
                        pieces, piece = self._read(seek_ns, sink), None
                    piece = self._play(sink, pieces, piece, position)
                    self._tell(sink, position, over=piece is None)
                    self._wake.wait(_TICK_S)
                    self._wake.clear()
        finally:
            pieces.close()
            sink.server.close()
        return asked.is_set()

    def _play(
        self, sink: FoxgloveSink, pieces: Generator[_Piece], piece: _Piece | None, position: int
    ) -> _Piece | None:
        """Give out what is due; return what comes next, None at the end."""
        piece = piece or next(pieces, None)
        while piece is not None and self._course.seek_ns is None and not self._stopping:
            batch, columns = piece
            due = int(np.searchsorted(np.maximum.accumulate(batch.time_ns), position, side="right"))
            if due:
                sink.write(batch.take(slice(0, due)), columns.take(slice(0, due)))
            if due < len(batch):
                return batch.take(slice(due, None)), columns.take(slice(due, None))
            piece = next(pieces, None)
        return piece

    def _tell(self, sink: FoxgloveSink, position: int, *, over: bool) -> None:
        with self._lock:
            course = self._course
            ends = over and course.seek_ns is None and position >= self.range_ns[1] and not course.ended
            if ends:
                course.ended, course.playing, course.at_ns = True, False, self.range_ns[1]
            state = self._state(self._clock())
        sink.show_time(state.time_ns)
        sink.server.tell_state(state, newcomers=not ends)

    def _position(self, now: int) -> int:
        course = self._course
        moved = int((now - course.since_ns) * course.speed) if course.playing and not self._held else 0
        return min(course.at_ns + moved, self.range_ns[1])

    def _state(self, now: int, *, seeked: bool = False) -> PlaybackState:
        course = self._course
        status = "Ended" if course.ended else "Playing" if course.playing else "Paused"
        return PlaybackState(status, self._position(now), course.speed, seeked)

    def _measure(self) -> tuple[int, int]:
        """Read it once: when it starts, when it ends, and whether it is whole."""
        source = self._reopen()
        first, last = 1 << 63, -1
        try:
            for batch in source.batches():
                times = self._chosen(batch)[0].time_ns
                if len(times):
                    first, last = min(first, int(times.min())), max(last, int(times.max()))
        except CaptureError as error:
            self.failure = error
        finally:
            source.close()
        if last < 0:
            raise self.failure or CaptureError(f"{source.info.name}: no datagram that was chosen in it")
        return first, last

    def _chosen(self, batch: PacketBatch) -> _Piece:
        return self._selection.apply(batch, self._bench.columns.decode(batch), self._bench.mission)

    def _read(self, start_ns: int, sink: FoxgloveSink) -> Generator[_Piece]:
        """Yield what comes from a time on; before that show the last of each topic, as it stands then."""
        source = self._reopen()
        latest: dict[int, _Piece] = {}
        before = True
        try:
            for whole in source.batches():
                batch, columns = self._chosen(whole)
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
        except CaptureError as error:
            self.failure = error
        finally:
            source.close()


def _show(latest: dict[int, _Piece], sink: FoxgloveSink) -> None:
    for batch, columns in sorted(latest.values(), key=lambda piece: int(piece[0].time_ns[0])):
        sink.write(batch, columns)
    if latest:
        sink.restart()  # they are no part of the statistics of what follows
