"""Views that are redrawn on a terminal while a run continues.

The rules of all of them:

1. Only ``update`` draws, from the caller's thread: rich's own thread would read counts while they change.
2. It draws the first time at once, then four times a second at most.
3. Rates are those of the last two seconds.
4. If the console is not a terminal, nothing is drawn and nothing is computed.
5. Nobody waits for a terminal: while it takes nothing, nothing is drawn.
"""

from __future__ import annotations

import io
import math
import threading
import time
from collections import deque
from contextlib import ExitStack, contextmanager, suppress
from typing import IO, TYPE_CHECKING, Any, Final, Generic, NamedTuple, Protocol, TypeVar, cast

from rich.live import Live

from edoras_tools.render import units
from edoras_tools.render.severity import Level
from edoras_tools.render.terminal import palette
from edoras_tools.render.terminal.table import one_line, plain
from edoras_tools.render.terminal.text import size_of
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping
    from pathlib import Path

    from rich.console import Console, RenderableType
    from rich.text import Text
    from typing_extensions import Self


_LAST_S: Final = 2.0
"""How long the end waits for a terminal that takes nothing."""


class BackgroundStream(io.TextIOBase):
    """A text stream whose writes a thread hands on to another one.

    Args:
        stream: the other one.
    """

    def __init__(self, stream: IO[str]) -> None:
        self._stream = stream
        self._parts: list[str] = []
        self._changed = threading.Condition()
        self._waiting = ""
        self._writing = False
        self._failure: OSError | None = None
        self._thread: threading.Thread | None = None

    @property
    def encoding(self) -> str:  # type: ignore[override]
        """That of the other stream."""
        return str(getattr(self._stream, "encoding", "utf-8"))

    def isatty(self) -> bool:
        """Tell whether the other stream is a terminal."""
        return self._stream.isatty()

    def fileno(self) -> int:
        """Return the file descriptor of the other stream."""
        return self._stream.fileno()

    @property
    def idle(self) -> bool:
        """Whether everything is handed on."""
        return not (self._waiting or self._writing)

    def write(self, text: str) -> int:
        """Take text.

        Raises:
            OSError: the other stream has failed.
        """
        if self._failure:
            raise self._failure
        self._parts.append(text)
        return len(text)

    def flush(self) -> None:
        """Have the thread hand on what was taken; do not wait for it."""
        if self._parts:
            with self._changed:
                self._waiting += "".join(self._parts)
                self._changed.notify_all()
            self._parts.clear()
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="terminal", daemon=True)
                self._thread.start()

    def finish(self) -> None:
        """Wait until all is handed on, but not for ever."""
        self.flush()
        with self._changed:
            self._changed.wait_for(lambda: self.idle, _LAST_S)

    def _run(self) -> None:
        while True:
            with self._changed:
                self._writing = False
                self._changed.notify_all()
                self._changed.wait_for(lambda: self._waiting)
                text, self._waiting, self._writing = self._waiting, "", True
            try:
                if not self._failure:
                    self._stream.write(text)
                    self._stream.flush()
            except OSError as error:
                self._failure = error


@contextmanager
def background(console: Console) -> Iterator[BackgroundStream | None]:
    """Have a console's terminal written to by a thread; yield what does, None where it is no terminal."""
    stream = console.file
    if not stream.isatty():
        yield None
        return
    background_stream = BackgroundStream(stream)
    console.file = cast("IO[str]", background_stream)  # all that rich needs of it
    try:
        yield background_stream
    finally:
        background_stream.finish()
        console.file = stream


_WINDOW_S: Final = 2.0
_REFRESH_S: Final = 0.25


class Rates:
    """Rates over the last two seconds, from counts that only grow."""

    def __init__(self) -> None:
        self._samples: deque[tuple[float, Mapping[object, int]]] = deque()

    def add(self, now: float, counts: Mapping[object, int]) -> dict[object, float]:
        """Take the counts of ``now``, in s, and return every key's rate per second."""
        while len(self._samples) > 1 and now - self._samples[1][0] >= _WINDOW_S:
            self._samples.popleft()
        then, before = self._samples[0] if self._samples else (now, counts)
        self._samples.append((now, counts))
        span = now - then
        return {
            key: (count - before.get(key, 0)) / span if span > 0 else 0.0 for key, count in counts.items()
        }


class LiveRun(Protocol):
    """What is under way."""

    def summary(self) -> Mapping[str, Any]:
        """Return what there is so far, in the shape of the command's ``--json``."""
        ...


_T = TypeVar("_T")
_R = TypeVar("_R", bound=LiveRun)


class Moment(NamedTuple):
    """A run at one moment, as a view shows it.

    Attributes:
        summary: what there is so far; empty for a run without counts.
        rates: per second, by the keys of the view's counts; None once the run is over.
        elapsed: s since it began; None once it is over.
        written: bytes of the file that grows; None where there is none.
        width: columns of the terminal.
        height: its lines.
    """

    summary: Mapping[str, Any]
    rates: Mapping[object, float] | None = None
    elapsed: float | None = None
    written: int | None = None
    width: int = 80
    height: int = 24


class LiveView(Generic[_T]):
    """Draws a run anew over its last drawing; a context manager with an ``update`` that is cheap to call.

    Nothing more is drawn after the terminal was closed; the run continues.

    Args:
        show: the run, and the time in s, to what is drawn.
        transient: whether the view goes away at the end, as where a report takes its place; else its last
            state stays.
        clock: monotonic time in s.
    """

    def __init__(
        self,
        show: Callable[[_T, float], RenderableType],
        console: Console,
        *,
        transient: bool = True,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.console = console
        self._show, self._transient, self._clock = show, transient, clock
        self._drawn = -math.inf
        self._last: _T | None = None
        self._stack = ExitStack()
        self._stream: BackgroundStream | None = None
        self._live = (
            Live(console=console, auto_refresh=False, redirect_stdout=False, transient=transient)
            if console.is_terminal
            else None
        )

    def __enter__(self) -> Self:
        if self._live:
            self._stream = self._stack.enter_context(background(self.console))
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._live and self._last is not None and not self._transient:
            self._draw(self._last, self._clock())
        if self._live:
            with suppress(OSError):
                self._live.stop()
        self._stack.close()

    def update(self, run: _T, /) -> None:
        """Draw, if the last drawing is long enough ago; from one thread only."""
        if self._live is None:
            return
        now, self._last = self._clock(), run
        if now - self._drawn >= _REFRESH_S and (self._stream is None or self._stream.idle):
            self._draw(run, now)

    def _draw(self, run: _T, now: float) -> None:
        assert self._live is not None
        self._drawn = now
        try:
            self._live.update(self._show(run, now), refresh=True)
        except OSError:
            with suppress(OSError):
                self._live.stop()
            self._live = None


class LiveTable(LiveView[_R]):
    """Shows a run with its counts: a ``LiveView`` that works out rates, time and the size of the output.

    Args:
        show: the view of a run at a moment.
        counts: a summary to the counts whose rates the view shows, by any key.
        output: the file or directory that grows.
        transient: as of ``LiveView``.
        clock: monotonic time in s.
    """

    def __init__(
        self,
        show: Callable[[_R, Moment], RenderableType],
        counts: Callable[[Mapping[str, Any]], Mapping[object, int]],
        console: Console,
        output: Path | None = None,
        *,
        transient: bool = True,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        super().__init__(self._at, console, transient=transient, clock=clock)
        self._table, self._counts, self._output = show, counts, output
        self._rates = Rates()
        self._began = clock()

    def _at(self, run: _R, now: float) -> RenderableType:
        summary = run.summary()
        moment = Moment(
            summary,
            self._rates.add(now, self._counts(summary)),
            now - self._began,
            size_of(self._output) if self._output else None,
            self.console.width,
            self.console.height,
        )
        return self._table(run, moment)


def title_line(title: str, moment: Moment) -> Text:
    """Return the first line of a live table: what runs, for how long, what is recorded, what was lost."""
    line = plain(title, palette.STRONG)
    if moment.elapsed is not None:
        line.append(f"   {units.duration(moment.elapsed)}", palette.DIM)
    if moment.summary.get("recorded") is not None:
        line.append(f"   {plural(moment.summary['recorded'], 'datagram')} recorded", palette.DIM)
        line.append(f", {units.size(moment.written or 0)}", palette.DIM)
    if moment.summary.get("lost"):
        line.append(f"   {units.count(moment.summary['lost'])} lost", Level.ERROR.style)
    return one_line(line)
