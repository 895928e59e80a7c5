"""Beside a diagnosis: the messages that were lost."""

from __future__ import annotations

from itertools import groupby
from operator import attrgetter
from typing import TYPE_CHECKING, Final

from rich.console import Group, RenderableType
from rich.text import Text

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
_SAME: Final = attrgetter("number", "time_ns", "until_ns", "msg_id", "link", "topic", "what", "one_of")
"""The common values of messages that share a line; a message that is a packet has its own."""


def missing_table(missing: Sequence[Missing], start_ns: int, width: int) -> RenderableType:
    """Return the table.

    Args:
        start_ns: time of the first datagram, zero of the times, ns since 1970.
    """
    lines = [list(alike) for _, alike in groupby(missing, lambda item: (_SAME(item), item.first is None))]
    columns = (
        Column("When", lambda row: plain(f"{(row[0].time_ns - start_ns) / 1e9:.3f} s")),
        Column("Packet", lambda row: plain("" if row[0].number is None else units.count(row[0].number))),
        Column("MsgId", lambda row: plain(row[0].as_json()["msg_id"] or ""), justify="left"),
        Column("Topic", lambda row: plain(row[0].topic or ""), justify="left", elastic=True),
        Column("Count", lambda row: plain(units.count(sum(item.count for item in row)))),
        Column("What", lambda row: plain(_message_text(row)), justify="left"),
        Column(
            "Values",
            lambda row: plain(value_text(row[0].message) if row[0].message else ""),
            justify="left",
            rank=1,
        ),
    )
    parts: list[RenderableType] = [build(columns, lines[:_MOST_LINES], width)]
    if rest := sum(item.count for alike in lines[_MOST_LINES:] for item in alike):
        parts.append(Text(f"and {rest:,} more: --list-lost csv", palette.DIM))
    parts.append(Text(f"{plural(sum(item.count for item in missing), 'message')} lost."))
    return Group(*parts)


def _message_text(alike: Sequence[Missing]) -> str:
    first, last = alike[0], alike[-1]
    if first.one_of is not None:
        return f"{first.what}; which of {first.one_of:,} is not known"
    if first.first is None or last.first is None:
        return first.what if first.number is not None else f"{first.what}; which is not known"
    counts = f"count {first.first}" if last is first else f"counts {first.first} to {last.first}"
    return f"{first.what}, {counts}"
