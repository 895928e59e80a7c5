"""What did not arrive, one line each."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from rich.console import Group
from rich.text import Text

from edoras_tools.model import NO_MSG_ID
from edoras_tools.render import units
from edoras_tools.render.terminal import palette
from edoras_tools.render.terminal.table import Column, build, plain
from edoras_tools.render.values import value_text

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rich.console import RenderableType

    from edoras_tools.diagnosis.missing import Missing

_MOST_LINES: Final = 1000
"""Lines on a terminal; CSV and JSON have all."""


def missing_table(found: Sequence[Missing], start_ns: int, width: int) -> RenderableType:
    """Return the table.

    Args:
        found: what did not arrive.
        start_ns: the first datagram: times count from it.
        width: of the terminal.
    """
    rows = [
        {
            "when": f"{(item.time_ns - start_ns) / 1e9:.3f} s",
            "packet": units.count(item.number) if item.number is not None else "",
            "msg_id": "" if item.msg_id == NO_MSG_ID else f"0x{item.msg_id:04x}",
            "topic": item.topic or "",
            "count": units.count(item.count),
            "what": item.what if item.first is None else f"{item.what}, from count {item.first}",
            "values": value_text(item.message) if item.message else "",
        }
        for item in found[:_MOST_LINES]
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
    if len(found) > _MOST_LINES:
        parts.append(Text(f"and {len(found) - _MOST_LINES:,} more: --list-lost csv", palette.DIM))
    return Group(*parts)
