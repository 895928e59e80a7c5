"""Beside a diagnosis: results of a check, differences of two runs, and lost messages."""

from __future__ import annotations

from itertools import groupby
from typing import TYPE_CHECKING, Any, Final

from rich.console import Group, RenderableType
from rich.text import Text

from edoras_tools.model import NO_MSG_ID
from edoras_tools.render import units
from edoras_tools.render.capture.tree import value_text
from edoras_tools.render.severity import Level
from edoras_tools.render.terminal import palette
from edoras_tools.render.terminal.table import Column, build, plain
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from edoras_tools.diagnosis.missing import Missing
    from edoras_tools.diagnosis.runs import Run, RunDifference


def check_view(report: Mapping[str, Any]) -> RenderableType:
    """Return the view of a check.

    Args:
        report: the report, in the form of ``check --json``.
    """
    head = plain(report["source"], palette.STRONG)
    head.append(f"  {units.duration(report['seconds'])}", palette.DIM)
    parts: list[RenderableType] = [head, Text()]
    for item in report["results"]:
        mark, style = ("✓", "green") if item["passed"] else (Level.ERROR.mark, Level.ERROR.style)
        expected = "" if item["expected"] is None else f" {item['expected']}"
        line = Text.assemble((f"{mark} ", style), plain(f"{item['about']}  {item['expectation']}{expected}"))
        line.append_text(plain(f"  {item['found']}", palette.DIM if item["passed"] else style))
        parts.append(line)
    of = plural(len(report["results"]), "expectation")
    if report["failed"]:
        end = Text(f"{report['failed']:,} of {of} not met.", Level.ERROR.style)
    else:
        end = Text(f"{of} met.", "green")
    return Group(*parts, Text(), end)


def runs_view(good: Run, bad: Run, changes: Sequence[RunDifference]) -> RenderableType:
    """Return the view of a comparison."""
    parts: list[RenderableType] = [_head("good", good), _head("bad", bad), Text()]
    for item in changes:
        severity = Level.ERROR if item.worse else Level.NOTE
        parts.append(Text.assemble((f"{severity.mark} ", severity.style), plain(item.text)))
    if changes:
        parts.append(Text())
    worse = sum(item.worse for item in changes)
    if worse:
        parts.append(Text(f"The second run is worse in {plural(worse, 'point')}.", Level.ERROR.style))
    else:
        parts.append(Text("The second run is no worse.", "green"))
    return Group(*parts)


def _head(label: str, run: Run) -> Text:
    line = plain(f"{label:<5}{run.info['source']}", palette.STRONG)
    line.append(
        f"  {plural(run.info['datagrams'], 'datagram')} over {units.duration(run.seconds)}, "
        f"{units.count(run.doctor['lost'])} lost",
        palette.DIM,
    )
    return line


_MOST_LINES: Final = 1000
"""Lines on a terminal; CSV and JSON have all."""


def missing_table(missing: Sequence[Missing], start_ns: int, width: int) -> RenderableType:
    """Return the table.

    Args:
        start_ns: the first datagram: times count from it.
    """
    lines = [list(alike) for _, alike in groupby(missing, key=_same)]
    rows = [
        {
            "when": f"{(first.time_ns - start_ns) / 1e9:.3f} s",
            "packet": units.count(first.number) if first.number is not None else "",
            "msg_id": "" if first.msg_id == NO_MSG_ID else f"0x{first.msg_id:04x}",
            "topic": first.topic or "",
            "count": units.count(sum(item.count for item in alike)),
            "what": _message_text(alike),
            "values": value_text(first.message) if first.message else "",
        }
        for alike in lines[:_MOST_LINES]
        for first in alike[:1]
    ]
    columns = (
        Column("When", lambda row: plain(row["when"])),
        Column("Packet", lambda row: plain(row["packet"])),
        Column("MsgId", lambda row: plain(row["msg_id"]), justify="left"),
        Column("Topic", lambda row: plain(row["topic"]), justify="left", elastic=True),
        Column("Count", lambda row: plain(row["count"])),
        Column("What", lambda row: plain(row["what"]), justify="left"),
        Column("Values", lambda row: plain(row["values"]), justify="left", elastic=True, rank=1),
    )
    parts: list[RenderableType] = [build(columns, rows, width)]
    if rest := sum(item.count for alike in lines[_MOST_LINES:] for item in alike):
        parts.append(Text(f"and {rest:,} more: --list-lost csv", palette.DIM))
    parts.append(Text(f"{plural(sum(item.count for item in missing), 'message')} lost."))
    return Group(*parts)


def _same(item: Missing) -> tuple[Any, ...]:
    """Return what messages on one line have in common; one that is a packet has a line of its own."""
    has_number = item.first is not None
    return (
        item.number,
        item.time_ns,
        item.until_ns,
        item.msg_id,
        item.link,
        item.topic,
        item.what,
        item.one_of,
        has_number,
    )


def _message_text(alike: Sequence[Missing]) -> str:
    first, last = alike[0], alike[-1]
    if first.one_of is not None:
        return f"{first.what}; which of {first.one_of:,} is not known"
    if first.first is None or last.first is None:
        return first.what if first.number is not None else f"{first.what}; which is not known"
    counts = f"count {first.first}" if last is first else f"counts {first.first} to {last.first}"
    return f"{first.what}, {counts}"
