"""The live table of a run on a terminal: its routes, with their counts and rates."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from rich.console import Console, Group, RenderableType
from rich.text import Text

from edoras_tools.render import units
from edoras_tools.render.capture.info import departures, link_text, msg_id_text, route_text
from edoras_tools.render.severity import Level
from edoras_tools.render.terminal import palette
from edoras_tools.render.terminal.live_table import LiveRun, LiveTable, Moment, title_line
from edoras_tools.render.terminal.table import Column, build, count_cell, one_line, plain
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path


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
