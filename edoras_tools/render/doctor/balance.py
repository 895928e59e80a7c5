"""The balance of every route and hop, for people: a table whose rows add up; and the lost messages."""

from __future__ import annotations

from itertools import groupby
from operator import attrgetter, itemgetter
from typing import TYPE_CHECKING, Any, Final

from rich.console import Group, RenderableType
from rich.text import Text

from edoras_tools.cfs.names import MSG_ID_NAMES
from edoras_tools.diagnosis.balance import PEER_TO_ROBOT, Chain
from edoras_tools.diagnosis.ledger import cause_text
from edoras_tools.render import units
from edoras_tools.render.capture.info import msg_id_text, route_text
from edoras_tools.render.capture.tree import value_text
from edoras_tools.render.severity import Level
from edoras_tools.render.terminal import palette
from edoras_tools.render.terminal.table import Column, build, plain
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Mapping, Sequence

    from edoras_tools.diagnosis.examination import Diagnosis
    from edoras_tools.diagnosis.missing import Missing

FIGURES: Final = {
    "in": "In",
    "duplicated": "Twice",
    "late": "Late",
    "out_of_order": "Out of order",
    "out": "Out",
    "lost": "Lost",
    "superseded": "Superseded",
    "waiting": "Waiting",
    "not_captured": "Not seen",
    "unaccounted": "Unaccounted",
}
"""Name of each figure to its column title."""
_ALWAYS: Final = frozenset({"in", "out", "lost"})


def shown_rows(result: Diagnosis) -> list[dict[str, Any]]:
    """Return the rows to show: packets of cFS itself are joined to one row if none is missing."""
    balance = [row.as_json(result.topics.get(row.route)) for row in result.balance]
    for item, row_json in zip(result.balance, balance, strict=True):
        if not item.observed:
            row_json.update(lost=None, not_counted=item.counted["lost"])
    rows = _with_ends(result, balance)
    own = MSG_ID_NAMES.values()
    quiet = [row for row in rows if not row["topic"] and row["name"] in own and row["in"] == row["out"]]
    if len(quiet) < 2:
        return rows
    left_out = {id(row) for row in quiet}
    rest = [row for row in rows if id(row) not in left_out]
    first: dict[tuple[Any, ...], int] = {}
    for row in quiet:  # count a message that crosses two hops once
        first.setdefault((row["link"], row["msg_id"], row["instance"]), row["in"])
    number = sum(first.values())
    others = {**quiet[0], **dict.fromkeys(FIGURES, 0), "in": number, "out": number, "lost_by": {}}
    name = f"{plural(len(first), 'other')} of cFS itself"
    return [*rest, {**others, "msg_id": None, "link": None, "instance": None, "name": name, "hop": "all"}]


def _with_ends(result: Diagnosis, rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the rows of a table, with the uncounted hops in front of and behind each command's rows."""
    before: dict[int, dict[str, Any]] = {}
    behind: dict[int, dict[str, Any]] = {}
    for chain in result.chains:
        key = ("ci", f"0x{chain.msg_id:04x}", chain.instance)
        own = [at for at, row in enumerate(rows) if (row["link"], row["msg_id"], row["instance"]) == key]
        for ends, hop, at in ((before, chain.hops[0], own[0]), (behind, chain.hops[-1], own[-1])):
            if not hop.observed and hop.hop != PEER_TO_ROBOT:
                ends[at] = {**rows[at], **dict.fromkeys(FIGURES), **hop.as_json(), "lost_by": {}}
                ends[at]["not_counted"] = hop.counted
    return [
        item
        for at, row in enumerate(rows)
        for item in (before.get(at), row, behind.get(at))
        if item is not None
    ]


def causes(row: Mapping[str, Any]) -> str:
    """Return the causes of a row's losses: ``92 over a message limit``; else where they would be counted."""
    if row.get("lost", 0) is None:
        return str(row["not_counted"])
    return ", ".join(f"{number:,} {cause_text(cause)}" for cause, number in row["lost_by"].items())


def figure_text(value: int | None) -> str:
    """Return a figure as text; empty if it was not counted."""
    return "" if value is None else units.count(value)


def _figure(name: str) -> Any:
    style = Level.ERROR.style if name in {"lost", "unaccounted"} else ""

    def cell(row: Mapping[str, Any]) -> Text:
        text = figure_text(row.get(name)) if row.get(name) or name in _ALWAYS else ""
        return Text(text, style if row.get(name) else palette.DIM if name == "lost" else "")

    return cell


def balance_table(result: Diagnosis, width: int) -> RenderableType:
    """Return the balance as a table, without columns that are empty in every row."""
    last = "Lost by", causes
    return _table(shown_rows(result), FIGURES, {"lost"}, last, width, lambda row: row["msg_id"])


def chain_table(chains: Sequence[Chain], width: int) -> RenderableType:
    """Return the ways of the commands, one row for each hop."""
    rows = [
        {**hop.as_json(), "msg_id": f"0x{item.msg_id:04x}", "topic": item.topic, "name": item.instance}
        for item in chains
        for hop in item.hops
    ]
    figures = {"in": "In", "entered": "Entered", **FIGURES}
    last = "Counted", itemgetter("counted")
    return _table(rows, figures, _ALWAYS, last, width, itemgetter("msg_id", "name"))


def _table(
    rows: Sequence[dict[str, Any]],
    figures: Mapping[str, str],
    always: Collection[str],
    last: tuple[str, Callable[[Any], Any]],
    width: int,
    apart: Callable[[Any], Any],
) -> RenderableType:
    """Return a table of hops.

    Args:
        figures: name of each figure to its column title.
        always: figures with a column even if it is empty in every row.
        last: title of the last column, and the function that gives its text.
        apart: argument of ``build``.
    """
    columns = [
        Column("MsgId", lambda row: msg_id_text(row) if row["msg_id"] else Text(""), justify="left"),
        Column("Topic", route_text, justify="left", elastic=True),
        Column("Hop", lambda row: plain(row["hop"]), justify="left"),
        *(
            Column(head, _figure(name), rank=0 if name in _ALWAYS else 1)
            for name, head in figures.items()
            if name in always or any(row.get(name) for row in rows)
        ),
        Column(last[0], lambda row: plain(last[1](row)), rank=2, justify="left"),
    ]
    return build(columns, rows, width, apart=apart)


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
