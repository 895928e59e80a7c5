"""A table that follows a live capture or recording: counts, rates now, drops, file size."""

from __future__ import annotations

import time
from collections import deque
from typing import TYPE_CHECKING, Any, Final, Self

from rich.console import Console, Group
from rich.live import Live
from rich.text import Text

from edoras_tools.render import palette, units
from edoras_tools.render.info import departures, link_of, msg_id_of, name_of
from edoras_tools.render.severity import Severity
from edoras_tools.render.table import Column, build, plain
from edoras_tools.render.watch import size_of

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

    from rich.console import ConsoleOptions, RenderResult

    from edoras_tools.render.watch import Report

_WINDOW_S: Final = 2.0
"""Rates are counted over so long."""
_REFRESH_S: Final = 0.2


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


class LiveTable:
    """Shows a run while it goes on; a context manager with an ``update`` that is cheap to call.

    It draws from the caller's thread, at most five times a second, and nothing at all where the console is no
    terminal.

    Args:
        title: what is going on, as ``recording eth0 to a.mcap``.
        console: where to draw; standard error by default.
        output: the file or directory that grows.
        clock: monotonic time in s.
    """

    def __init__(
        self,
        title: str,
        *,
        console: Console | None = None,
        output: Path | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._title = title
        self._console = console or Console(stderr=True)
        self._output = output
        self._clock = clock
        self._rates = Rates()
        self._began = self._drawn = clock()
        self._last: Report | None = None
        # Only update() draws: rich's own thread would read the counts while they change.
        self._live = (
            Live(console=self._console, auto_refresh=False, redirect_stdout=False)
            if self._console.is_terminal
            else None
        )

    def __enter__(self) -> Self:
        if self._live:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._live:
            if self._last is not None:
                self._draw(self._last, self._clock())
            self._live.stop()

    def update(self, report: Report) -> None:
        """Draw the report, if the last drawing is long enough ago."""
        if self._live is None:
            return
        now = self._clock()
        first, self._last = self._last is None, report
        if first or now - self._drawn >= _REFRESH_S:
            self._draw(report, now)

    def _draw(self, report: Report, now: float) -> None:
        assert self._live is not None
        self._drawn = now
        summary = report.summary()
        counts: dict[object, int] = {_key(row): row.get("count", 0) for row in summary.get("routes", ())}
        counts[None] = summary.get("datagrams", 0)
        rates = self._rates.add(now, counts)
        size = size_of(self._output) if self._output else None
        view = Snapshot(self._title, summary, rates, now - self._began, size, self._console.height)
        self._live.update(view, refresh=True)


class Snapshot:
    """What the live table shows at one moment.

    Args:
        title: what is going on.
        summary: the counts so far, in the shape of ``info --json``.
        rates: per second and route, and of all under None.
        elapsed: s.
        size: bytes of the file that grows.
        height: lines that the view may take; routes that do not fit are counted.
    """

    def __init__(
        self,
        title: str,
        summary: Mapping[str, Any],
        rates: Mapping[object, float],
        elapsed: float,
        size: int | None,
        height: int,
    ) -> None:
        self._title = title
        self._summary = summary
        self._rates = rates
        self._elapsed = elapsed
        self._size = size
        self._height = height

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Yield the head line and the table."""
        head = plain(self._title, palette.STRONG)
        head.append(f"   {units.duration(self._elapsed)}", palette.DIM)
        yield _one_line(head)
        yield _one_line(self._totals())
        rows = list(self._summary.get("routes", ()))
        room = max(1, self._height - 6)
        if not rows:
            yield Text("waiting for the first packet ... Ctrl-C ends", palette.DIM)
            return
        columns = (*_COLUMNS[:3], Column("Now", self._now), *_COLUMNS[3:])
        table = build(columns, rows[:room], options.max_width)
        yield Group(Text(), table)
        if len(rows) > room:
            yield Text(f"and {len(rows) - room:,} more routes", palette.DIM)

    def _totals(self) -> Text:
        count, drops = self._summary.get("datagrams", 0), self._summary.get("capture_drops", 0)
        line = Text(units.plural(count, "packet"), palette.STRONG)
        line.append(f"   {units.rate(self._rates.get(None)).replace('Hz', 'packets/s')}", palette.DIM)
        if drops:
            line.append(f"   {units.count(drops)} dropped", Severity.ERROR.style)
        else:
            line.append("   no drops", palette.DIM)
        if self._size is not None:
            line.append(f"   {units.size(self._size)} written", palette.DIM)
        return line

    def _now(self, row: Mapping[str, Any]) -> Text:
        rate = self._rates.get(_key(row))
        return Text(units.rate(rate), "" if rate else palette.DIM)


_COLUMNS: Final = (
    Column("Link", link_of, justify="left"),
    Column("MsgId", msg_id_of, justify="left"),
    Column("Topic", name_of, justify="left", elastic=True),
    Column("CPU", lambda row: plain(row.get("processor_id") or ""), rank=2),
    Column("Count", lambda row: Text(units.count(row.get("count")), palette.STRONG)),
    Column("Mean", lambda row: Text(units.rate(row.get("rate_hz") or None), palette.DIM), rank=3),
    Column(
        "Gaps", lambda row: Text(units.count(row.get("gaps")), "" if row.get("gaps") else palette.DIM), rank=2
    ),
    Column("Largest", lambda row: Text(units.count(row.get("bytes_max"))), rank=4),
    Column("Findings", lambda row: departures(row.get("findings") or {}), rank=1, justify="left"),
)


def _key(row: Mapping[str, Any]) -> object:
    return row.get("link"), row.get("processor_id"), row.get("msg_id"), row.get("name"), row.get("topic")


def _one_line(text: Text) -> Text:
    text.no_wrap, text.overflow = True, "ellipsis"
    return text
