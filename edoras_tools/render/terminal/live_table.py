"""Views that are redrawn on a terminal while a run continues.

The rules of all of them:

1. Only ``update`` draws, from the caller's thread: rich's own thread would read counts while they change.
2. It draws the first time at once, then four times a second at most.
3. Rates are those of the last two seconds.
4. If the console is not a terminal, nothing is drawn and nothing is computed.
5. Nobody waits for a terminal: while it takes nothing, nothing is drawn.
"""

from __future__ import annotations

import math
import time
from collections import deque
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Generic, Protocol, TypeVar

from rich.live import Live

from edoras_tools.render import units
from edoras_tools.render.severity import Level
from edoras_tools.render.terminal import palette
from edoras_tools.render.terminal.background import BackgroundStream, background
from edoras_tools.render.terminal.run import size_of
from edoras_tools.render.terminal.table import one_line, plain
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

    from rich.console import Console, RenderableType
    from rich.text import Text
    from typing_extensions import Self

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


@dataclass(frozen=True, slots=True)
class Moment:
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
