"""The balance of every route and hop, for people: a table whose rows add up."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from rich.text import Text

from edoras_tools.render import units
from edoras_tools.render.capture.info import msg_id_text, route_text
from edoras_tools.render.severity import Level
from edoras_tools.render.terminal import palette
from edoras_tools.render.terminal.table import Column, build, plain

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from rich.console import RenderableType

    from edoras_tools.diagnosis.examination import Diagnosis

CAUSES: Final = {
    "limit": "over a message limit",
    "overflow": "pipe full",
    "after": "behind cFS",
    "unknown": "where is not known",
    "network": "network before CI",
    "socket": "CI's socket full",
    "down": "cFS was down",
    "restart": "CI was restarted",
    "stopped": "application stopped",
    "away": "peer away",
    "sbn_socket": "SBN's socket full",
    "to_socket": "Telemetry Output's socket failed",
    "proxy": "dropped on purpose by the proxy",
}
"""Text for the cause of a loss; other causes are rules, and are shown by their ids."""
FIGURES: Final = ("in", "duplicated", "out", "lost", "superseded", "waiting", "not_captured", "unaccounted")
HEADS: Final = ("In", "Twice", "Out", "Lost", "Superseded", "Waiting", "Not seen", "Unaccounted")


def shown_rows(found: Diagnosis) -> list[dict[str, Any]]:
    """Return the rows to show: packets of cFS itself are one row if nothing is missing.

    Args:
        found: the diagnosis.
    """
    rows = [row.as_json(found.topics.get(row.route)) for row in found.balance]
    quiet = [row for row in rows if not row["topic"] and row["name"] and row["in"] == row["out"]]
    if len(quiet) < 2:
        return rows
    left_out = {id(row) for row in quiet}
    kept = [row for row in rows if id(row) not in left_out]
    first: dict[tuple[Any, ...], int] = {}
    for row in quiet:  # a message that crosses two hops is one message
        first.setdefault((row["link"], row["msg_id"], row["instance"]), row["in"])
    number = sum(first.values())
    others = {**quiet[0], **dict.fromkeys(FIGURES, 0), "in": number, "out": number, "lost_by": {}}
    name = f"{len(first)} others of cFS itself"
    return [*kept, {**others, "msg_id": None, "link": None, "instance": None, "name": name, "hop": "all"}]


def causes(row: Mapping[str, Any]) -> str:
    """Return why messages of a row were lost: ``92 over a message limit``."""
    return ", ".join(f"{number:,} {CAUSES.get(cause, cause)}" for cause, number in row["lost_by"].items())


def _figure(name: str) -> Any:
    style = Level.ERROR.style if name in {"lost", "unaccounted"} else ""

    def cell(row: Mapping[str, Any]) -> Text:
        always = name in {"in", "out", "lost"}
        told = units.count(row[name]) if row[name] or always else ""
        return Text(told, style if row[name] else palette.DIM if name == "lost" else "")

    return cell


def _msg_id(row: Mapping[str, Any]) -> Text:
    return msg_id_text(row) if row["msg_id"] else Text("")


_COLUMNS: Final = (
    Column("MsgId", _msg_id, justify="left"),
    Column("Topic", route_text, justify="left", elastic=True),
    Column("Hop", lambda row: plain(row["hop"]), justify="left"),
    *(
        Column(head, _figure(name), rank=0 if name in {"in", "out", "lost"} else 1)
        for head, name in zip(HEADS, FIGURES, strict=True)
    ),
    Column("Lost by", lambda row: plain(causes(row)), rank=2, justify="left"),
)


def balance_table(found: Diagnosis, width: int) -> RenderableType:
    """Return the table, without the columns that are empty in every row.

    Args:
        found: the diagnosis.
        width: of the terminal.
    """
    rows = shown_rows(found)
    empty = {head for head, name in zip(HEADS, FIGURES, strict=True) if not any(row[name] for row in rows)}
    columns = [column for column in _COLUMNS if column.title not in empty - {"Lost"}]
    return build(columns, rows, width, apart=lambda row: row["msg_id"])


def balance_lines(found: Diagnosis) -> Sequence[str]:
    """Return what happened to each route, one line each."""
    return [str(item) for item in found.headlines]
