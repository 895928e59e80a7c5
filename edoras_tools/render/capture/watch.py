"""The view of a run on standard error, and the line printed at its end."""

from __future__ import annotations

import sys
from contextlib import contextmanager
from time import monotonic
from typing import TYPE_CHECKING, Any, Final, TypeVar

from rich.console import Console, Group, RenderableType
from rich.text import Text

from edoras_tools.io import Source, SourceOver
from edoras_tools.io.outputs import output_name
from edoras_tools.render import units
from edoras_tools.render.capture.info import departures, link_text, msg_id_text, route_text
from edoras_tools.render.severity import Level
from edoras_tools.render.terminal import palette
from edoras_tools.render.terminal.live_table import LiveRun, LiveTable, Moment, title_line
from edoras_tools.render.terminal.table import Column, build, count_cell, one_line, plain
from edoras_tools.render.terminal.terminal import detect_terminal
from edoras_tools.render.terminal.text import clean, size_of
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Sized
    from pathlib import Path

    from edoras_tools.io.formats.watched import Keep
    from edoras_tools.model import PacketBatch
    from edoras_tools.render.terminal.progress import FileProgress


def live_table(title: str, console: Console, output: Path | None = None) -> LiveTable[LiveRun]:
    """Return the live table of a run; its last state stays on the screen.

    Args:
        title: name of the run, as ``eth0 → a.mcap``.
        output: file or directory whose size is shown.
    """
    return LiveTable(lambda _, moment: view(title, moment), _counts, console, output, transient=False)


def _counts(summary: Mapping[str, Any]) -> dict[object, int]:
    counts: dict[object, int] = {_key(row): row.get("count", 0) for row in summary.get("routes", ())}
    return {**counts, None: summary.get("datagrams", 0)}


def view(title: str, moment: Moment) -> Group:
    """Return the content of the live table; routes that do not fit are only counted."""
    rates = moment.rates or {}
    parts: list[RenderableType] = [title_line(title, moment), one_line(_totals(moment, rates))]
    rows = list(moment.summary.get("routes", ()))
    room = max(1, moment.height - 6)
    if not rows:
        return Group(*parts, Text("waiting for the first packet ... Ctrl-C ends", palette.DIM))

    def now(row: Mapping[str, Any]) -> Text:
        rate = rates.get(_key(row))
        return Text(units.rate(rate), "" if rate else palette.DIM)

    columns = (*_COLUMNS[:3], Column("Now", now), *_COLUMNS[3:])
    parts += [Text(), build(columns, rows[:room], moment.width)]
    if len(rows) > room:
        parts.append(Text(f"and {len(rows) - room:,} more routes", palette.DIM))
    return Group(*parts)


def _totals(moment: Moment, rates: Mapping[object, float]) -> Text:
    count, drops = moment.summary.get("datagrams", 0), moment.summary.get("capture_drops")
    line = Text(plural(count, "packet"), palette.STRONG)
    line.append(f"   {units.rate(rates.get(None)).replace('Hz', 'packets/s')}", palette.DIM)
    if drops:
        line.append(f"   {units.count(drops)} dropped", Level.ERROR.style)
    elif drops is not None:
        line.append("   no drops", palette.DIM)
    if moment.written is not None:
        line.append(f"   {units.size(moment.written)} written", palette.DIM)
    return line


_COLUMNS: Final = (
    Column("Link", link_text, justify="left"),
    Column("MsgId", msg_id_text, justify="left"),
    Column("Topic", route_text, justify="left", elastic=True),
    Column("CPU", lambda row: plain(row.get("processor_id") or ""), rank=2),
    Column("Count", lambda row: Text(units.count(row.get("count")), palette.STRONG)),
    Column("Mean", lambda row: Text(units.rate(row.get("rate_hz") or None), palette.DIM), rank=3),
    Column("Gaps", lambda row: count_cell(row.get("gaps")), rank=2),
    Column("Largest", lambda row: Text(units.count(row.get("bytes_max"))), rank=4),
    Column("Findings", lambda row: departures(row.get("findings") or {}), rank=1, justify="left"),
)


def _key(row: Mapping[str, Any]) -> object:
    return row.get("link"), row.get("processor_id"), row.get("msg_id"), row.get("name"), row.get("topic")


_Printed = TypeVar("_Printed", bound="Sized")
_PATIENCE_S: Final = 0.3
"""Time from which work shows a bar, s."""


class Followed(SourceOver):
    """A source that shows the progress of reading on a terminal, if reading takes long."""

    def __init__(self, source: Source, *, quiet: bool) -> None:
        super().__init__(source)
        self._shows = not quiet and detect_terminal(sys.stderr).interactive
        self._since = monotonic()
        self._bar: FileProgress | None = None

    def batches(self) -> Iterator[PacketBatch]:
        """Yield the source's batches; the bar vanishes at their end."""
        try:
            for batch in self._source.batches():
                if self._shows and monotonic() - self._since > _PATIENCE_S:
                    self._read()
                yield batch
        finally:
            self._clear()

    def printed(self, blocks: Iterable[_Printed]) -> Iterator[_Printed]:
        """Yield blocks to print; the bar disappears before each, and waits again."""
        for block in blocks:
            if len(block):
                self._clear()
            yield block

    def _read(self) -> None:
        from edoras_tools.render.terminal.progress import FileProgress
        from edoras_tools.render.terminal.terminal import error_console

        self._bar = self._bar or FileProgress(self._source.info.name, console=error_console())
        self._bar.read(self._source)

    def _clear(self) -> None:
        if self._bar is not None:
            self._bar.__exit__()
        self._bar, self._since = None, monotonic()


@contextmanager
def byte_progress(path: Path, *, quiet: bool) -> Iterator[Callable[[int, int], None]]:
    """Show the checked bytes of a file on standard error; yield a function of checked and all bytes."""
    if quiet or not detect_terminal(sys.stderr).interactive:
        yield lambda _count, _all: None
        return
    from edoras_tools.render.terminal.progress import FileProgress
    from edoras_tools.render.terminal.terminal import error_console

    with FileProgress(path.name, console=error_console()) as bar:
        yield lambda count, of: bar.step("checking", count, of, units.size)


def recorded(summary: Mapping[str, Any], outputs: Sequence[Path], keep: Keep | None = None) -> str:
    """Return the line about the contents of a recording.

    Args:
        summary: in the shape of ``info --json``.
        outputs: written files, or the directory; at least one.
        keep: deleted parts of it.
    """
    rows = summary.get("routes", ())
    topics = [row.get("count", 0) for row in rows if row.get("topic")]
    topics += [count for row in rows for count in row.get("topics", {}).values()]
    messages = sum(topics)
    total = summary.get("messages") or summary.get("datagrams")
    over = f" over {units.duration((summary['end_ns'] - summary['start_ns']) / 1e9)}" if total else ""
    on = f"{plural(messages, 'message')} on {plural(len(topics), 'topic')}"
    if samples := summary.get("samples"):
        on += f", {plural(sum(row['count'] for row in samples), 'sample')} of DDS"
    if "messages" in summary:  # a recording without datagrams
        noun, words = "message", [on + over]
    else:
        noun, words = "datagram", [plural(summary.get("datagrams", 0), "datagram"), on]
        words[0] += over
    if written := sum(map(size_of, outputs)):
        words.append(units.size(written))
    if keep and keep.deleted:
        words.append(f"{plural(keep.deleted, 'older file')} with {plural(keep.datagrams, noun)} deleted")
    name = output_name(outputs[0]) if len(outputs) == 1 else f"{outputs[0]} to {outputs[-1].name}"
    return f"{clean(name)}: {', '.join(words)}"
