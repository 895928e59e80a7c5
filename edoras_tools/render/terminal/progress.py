"""A progress bar for work on files: bytes, packets per second, time left."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, Final

from rich.progress import BarColumn, Progress, TextColumn

from edoras_tools import words
from edoras_tools.render.terminal import palette
from edoras_tools.render.terminal.text import ReadingRun, clean, clip_left

if TYPE_CHECKING:
    from rich.console import Console

    from edoras_tools.io import Source
    from edoras_tools.model import SourceStatistics

_REFRESH_S: Final = 0.1
_PATIENCE_S: Final = 0.3
"""Time from which work shows a bar, s."""
_LABEL: Final = 32


class FileProgress(AbstractContextManager["FileProgress"]):
    """Shows the progress of reading and judging; a context manager whose methods are cheap to call.

    It draws from the caller's thread, at most ten times a second, and nothing if the console is no terminal
    or if the work is short. The bar disappears at the end.

    Args:
        label: name of the input, such as a file's name.
        quiet: draw nothing.
        clock: monotonic time in s.
    """

    def __init__(
        self,
        label: str,
        *,
        console: Console,
        quiet: bool = False,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._clock = clock
        self._began = self._drawn = self._since = clock()
        self._source: Source | None = None
        self._progress: Progress | None = None
        if not quiet and console.is_terminal:
            self._progress = Progress(
                TextColumn("{task.description}", markup=False),
                BarColumn(None, complete_style="cyan", finished_style="green"),
                TextColumn("{task.fields[figures]}", style=palette.DIM, markup=False),
                console=console,
                auto_refresh=False,
                transient=True,
                redirect_stdout=False,
                expand=True,
            )
            label = clip_left(clean(label), min(_LABEL, console.width // 4))
            self._task = self._progress.add_task(label, total=None, figures="")

    def __exit__(self, *_: object) -> None:
        if self._progress:
            self._progress.stop()

    def update(self, report: ReadingRun) -> None:
        """Draw the progress of reading a run's source."""
        self.read(report.source)

    def read(self, source: Source) -> None:
        """Draw the progress of reading a source, if the last drawing is old enough."""
        statistics = source.statistics
        if self._source not in (None, source):
            self._since = self._clock()  # the next of several sources
        self._source = source
        total = statistics.total_bytes
        position = min(statistics.position, total) if total else 0
        self._draw(
            lambda now: figures(statistics, max(now - self._since, _REFRESH_S)), position, total or None
        )

    def step(self, activity: str, count: int, of: int, number_text: Callable[[int], str] = str) -> None:
        """Draw the progress of other work, if the last drawing is old enough."""
        self._draw(lambda _: f"{activity}, {number_text(count)} of {number_text(of)}", count, of)

    def _draw(self, text: Callable[[float], str], position: int, of: int | None) -> None:
        now = self._clock()
        if self._progress is None or now - self._drawn < _REFRESH_S or now - self._began < _PATIENCE_S:
            return
        self._drawn = now
        self._progress.update(self._task, total=of, completed=position, figures=text(now))
        self._progress.start()
        self._progress.refresh()


def figures(statistics: SourceStatistics, elapsed: float) -> str:
    """Return ``41%  12.4 MiB  310,000 packets/s  3.2 s left``, as far as known.

    Args:
        elapsed: s since reading began, more than 0.
    """
    position, total = statistics.position, statistics.total_bytes
    parts = [words.size(position or statistics.bytes), f"{statistics.datagrams / elapsed:,.0f} packets/s"]
    if total:
        parts.insert(0, f"{100 * min(position, total) / total:.0f}%")
        if position:
            parts.append(f"{words.duration(max(0, total - position) * elapsed / position)} left")
    return "  ".join(parts)
