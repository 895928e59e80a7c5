"""Views that are redrawn on a terminal while a run continues.

Rules for all of them:

1. Only ``update`` draws, from the caller's thread: rich's own thread would read counts while they change.
2. The first drawing comes at once, later ones at most four times a second.
3. Rates are those of the last two seconds.
4. If the console is not a terminal, nothing is drawn and nothing is computed.
5. The run never waits for a terminal: while the terminal accepts no output, nothing is drawn.
"""

from __future__ import annotations

import io
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from typing import IO, TYPE_CHECKING, Any, Final, Generic, NamedTuple, Protocol, TypeVar, cast

from rich.live import Live

from edoras_tools import words
from edoras_tools.render.severity import Level
from edoras_tools.render.terminal import palette
from edoras_tools.render.terminal.table import one_line, plain
from edoras_tools.render.terminal.text import size_of
from edoras_tools.words import plural

if TYPE_CHECKING:
    from pathlib import Path

    from rich.console import Console, RenderableType
    from rich.text import Text
    from typing_extensions import Self


_LAST_S: Final = 2.0
"""Time to wait at the end for a terminal that accepts no output, s."""


class BackgroundStream(io.TextIOBase):
    """A text stream whose writes are passed on to another stream by a thread.

    Args:
        stream: the other stream.
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
        """Encoding of the other stream."""
        return str(getattr(self._stream, "encoding", "utf-8"))

    def isatty(self) -> bool:
        """Return whether the other stream is a terminal."""
        return self._stream.isatty()

    def fileno(self) -> int:
        """Return the file descriptor of the other stream."""
        return self._stream.fileno()

    @property
    def idle(self) -> bool:
        """Whether all text is passed on."""
        return not (self._waiting or self._writing)

    def write(self, text: str) -> int:
        """Accept text.

        Raises:
            OSError: the other stream has failed.
        """
        if self._failure:
            raise self._failure
        self._parts.append(text)
        return len(text)

    def flush(self) -> None:
        """Let the thread pass the text on; do not wait for it."""
        if self._parts:
            with self._changed:
                self._waiting += "".join(self._parts)
                self._changed.notify_all()
            self._parts.clear()
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="terminal", daemon=True)
                self._thread.start()

    def finish(self) -> None:
        """Wait until all text is passed on, but only for a limited time."""
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
    """Write a console's terminal output in a thread; yield the stream, None if it is no terminal."""
    stream = console.file
    if not stream.isatty():
        yield None
        return
    background_stream = BackgroundStream(stream)
    console.file = cast("IO[str]", background_stream)  # it has the methods that rich uses
    try:
        yield background_stream
    finally:
        background_stream.finish()
        console.file = stream


_WINDOW_S: Final = 2.0
_REFRESH_S: Final = 0.25


class Rates:
    """Rates over the last two seconds, computed from growing counts."""

    def __init__(self) -> None:
        self._samples: deque[tuple[float, Mapping[object, int]]] = deque()

    def add(self, now: float, counts: Mapping[object, int]) -> dict[object, float]:
        """Add the counts at the time ``now``, s, and return the rate of every key per second."""
        while len(self._samples) > 1 and now - self._samples[1][0] >= _WINDOW_S:
            self._samples.popleft()
        then, before = self._samples[0] if self._samples else (now, counts)
        self._samples.append((now, counts))
        span = now - then
        return {
            key: (count - before.get(key, 0)) / span if span > 0 else 0.0 for key, count in counts.items()
        }


class LiveRun(Protocol):
    """A run in progress."""

    def summary(self) -> Mapping[str, Any]:
        """Return the results so far, in the shape of the command's ``--json``."""
        ...


_T = TypeVar("_T")
_R = TypeVar("_R", bound=LiveRun)


class Moment(NamedTuple):
    """A run at one moment, as a view shows it.

    Attributes:
        summary: results so far; empty for a run without counts.
        rates: rates per second, by the keys of the view's counts; None after the end.
        elapsed: time since the begin, s; None after the end.
        written: size of the growing output file, bytes; None if there is none.
        width: columns of the terminal.
        height: lines of the terminal.
    """

    summary: Mapping[str, Any]
    rates: Mapping[object, float] | None = None
    elapsed: float | None = None
    written: int | None = None
    width: int = 80
    height: int = 24


class LiveView(Generic[_T]):
    """Redraws a run over its last drawing; a context manager with an ``update`` that is cheap to call.

    Nothing more is drawn after the terminal was closed; the run continues.

    Args:
        show: function of the run and the time in s that returns the drawing.
        transient: whether the view disappears at the end, because a report follows; else its last state
            stays.
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
        self._live: Live | None = None
        if console.is_terminal:
            self._live = Live(console=console, auto_refresh=False, redirect_stdout=False, transient=transient)

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
        """Draw the run if the last drawing is old enough; call it from one thread only."""
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
    """Shows a run with its counts: a ``LiveView`` that computes rates, time and the size of the output.

    Args:
        show: function that draws a run at a moment.
        counts: function that returns, from a summary, the counts whose rates are shown, by any key.
        output: growing file or directory.
        transient: see ``LiveView``.
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
    """Return the first line of a live table: name of the run, time, output and losses."""
    line = plain(title, palette.STRONG)
    if moment.elapsed is not None:
        line.append(f"   {words.duration(moment.elapsed)}", palette.DIM)
    if moment.summary.get("recorded") is not None:
        line.append(f"   {plural(moment.summary['recorded'], 'datagram')} recorded", palette.DIM)
        line.append(f", {words.size(moment.written or 0)}", palette.DIM)
    if moment.summary.get("lost"):
        line.append(f"   {words.count(moment.summary['lost'])} lost", Level.ERROR.style)
    return one_line(line)
