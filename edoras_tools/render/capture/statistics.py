"""Tables of what ``sniff --stat`` counted."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from rich.text import Text

from edoras_tools.render import units
from edoras_tools.render.capture import info
from edoras_tools.render.terminal import palette
from edoras_tools.render.terminal.table import Column, build, plain

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from rich.table import Table

STATISTICS: Final = ("routes", "sbn", "sizes", "findings")

_SIZES: Final = (
    Column("Link", info.link_text, justify="left"),
    Column("MsgId", info.msg_id_text, justify="left"),
    Column("Topic", info.route_text, justify="left", elastic=True),
    Column("Count", lambda row: Text(units.count(row["count"]), palette.STRONG)),
    Column("Least", lambda row: Text(units.count(row["bytes_min"]))),
    Column("Mean", lambda row: Text(f"{row['bytes'] / row['count']:,.1f}")),
    Column("Most", lambda row: Text(units.count(row["bytes_max"]))),
    Column("Total", lambda row: Text(units.size(row["bytes"])), rank=1),
)
_NETWORK: Final = (
    Column("From", lambda row: plain(row["source"], palette.STRONG), justify="left"),
    Column("To", lambda row: plain(row["destination"]), justify="left"),
    Column("Message", lambda row: plain(row["message"]), justify="left", elastic=True),
    Column("Count", lambda row: Text(units.count(row["count"]), palette.STRONG)),
    Column("Every", lambda row: Text(units.milliseconds(row["period_ms"]))),
    Column("First", lambda row: Text(f"{row['first_ns'] / 1e9:.3f} s"), rank=1),
    Column("Last", lambda row: Text(f"{row['last_ns'] / 1e9:.3f} s"), rank=1),
    Column("Runs", lambda row: Text(units.count(row["runs"])), rank=2),
)


def statistics(kind: str, figures: Any, datagrams: int, width: int) -> Table:
    """Return one table.

    Args:
        kind: one of ``STATISTICS``.
        figures: rows, or counts by label for ``findings``, as the pipeline gives them.
    """
    if kind == "routes":
        return info.routes(figures, width)
    if kind == "findings":
        return info.findings(figures, datagrams)
    rows: Sequence[Mapping[str, Any]] = figures
    return build(_SIZES if kind == "sizes" else _NETWORK, rows, width)
