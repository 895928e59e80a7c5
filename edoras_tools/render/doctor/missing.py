"""Beside a diagnosis: the messages that were lost."""

from __future__ import annotations

from itertools import groupby
from typing import TYPE_CHECKING, Any, Final

from rich.console import Group, RenderableType
from rich.text import Text

from edoras_tools.model import NO_MSG_ID
from edoras_tools.render import units
from edoras_tools.render.capture.tree import value_text
from edoras_tools.render.terminal import palette
from edoras_tools.render.terminal.table import Column, build, plain
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Sequence

    from edoras_tools.diagnosis.missing import Missing


_MOST_LINES: Final = 1000
"""Lines on a terminal; CSV and JSON have all."""


def missing_table(missing: Sequence[Missing], start_ns: int, width: int) -> RenderableType:
    """Return the table.

    Args:
        start_ns: time of the first datagram, zero of the times, ns since 1970.
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
    """Return the common values of messages that share a line; a message that is a packet has its own."""
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
