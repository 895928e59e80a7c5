"""Tables of an index for people."""

from __future__ import annotations

from decimal import Decimal
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from edoras_tools.decode.spacecraft import FIRST_SPACECRAFT
from edoras_tools.io.formats.columns import json_value
from edoras_tools.render import units
from edoras_tools.render.severity import Level
from edoras_tools.render.terminal import palette
from edoras_tools.render.terminal.table import Column, build, figure, plain
from edoras_tools.render.terminal.text import cells
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence


_LOST: Final = Level.ERROR.style
_WIDEST: Final = 40
"""Maximum width of a column of an answer, in cells."""
_MOST_LINES: Final = 1000
"""Maximum number of rows of an answer in a table; CSV and JSON have all."""


def update_lines(summary: Mapping[str, Any], index: str) -> Iterator[str]:
    """Yield lines on an update, from the shape of ``archive --json``."""
    parts = [f"{summary['read']:,} read", f"{summary['unchanged']:,} unchanged"]
    parts += [f"{summary[name]:,} {words}" for name, words in _RARE.items() if summary[name]]
    yield f"{index}: {plural(summary['found'], 'capture')}: {', '.join(parts)}"


_RARE: Final = {
    "same": "with a new date and the same contents",
    "gone": "no longer there",
    "left": "not read yet",
}


def captures_table(rows: Sequence[Mapping[str, Any]], width: int) -> RenderableType:
    """Return captures as a table, and below it the reasons why some are incomplete.

    Args:
        rows: rows in the shape of ``archive list --json``.
    """
    columns = (
        Column("Began (UTC)", lambda row: plain(_when(row["start_ns"])), justify="left"),
        Column("Capture", lambda row: plain(short(row["capture"])), justify="left", elastic=True),
        Column("Length", lambda row: plain(_length(row["seconds"])), rank=1),
        Column("Datagrams", figure("datagrams")),
        Column("Lost", figure("lost", _LOST)),
        Column("Unaccounted", figure("unaccounted", _LOST), rank=2),
        Column("Worst", lambda row: plain(row["worst"] or ""), justify="left", rank=1),
        Column("State", lambda row: plain("gone" if row["gone"] else row["state"]), justify="left"),
    )
    errors = [plain(row["error"]) for row in rows if row["error"]]
    return Group(build(columns, rows, width), *errors, Text(f"{plural(len(rows), 'capture')}."))


def losses_table(rows: Sequence[Mapping[str, Any]], width: int) -> RenderableType:
    """Return losses as a table.

    Args:
        rows: rows in the shape of ``archive losses --json``.
    """
    columns = (
        Column("Began (UTC)", lambda row: plain(_when(row["start_ns"])), justify="left"),
        Column("Capture", lambda row: plain(short(row["capture"])), justify="left", elastic=True),
        Column("Link", lambda row: plain((row["link"] or "").upper()), justify="left", rank=1),
        Column("Topic", lambda row: plain(_route(row)), justify="left"),
        Column("Sent", figure("sent")),
        Column("Lost", figure("lost", _LOST)),
        Column("Unaccounted", figure("unaccounted", _LOST), rank=1),
        Column("Share", lambda row: plain(_percent(row["share"]))),
        Column("By", lambda row: plain(", ".join(row["causes"])), justify="left", rank=2),
    )
    lost, unaccounted = (sum(row[name] for row in rows) for name in ("lost", "unaccounted"))
    captures = plural(len({row["capture"] for row in rows}), "capture")
    total = f"{lost:,} lost, {unaccounted:,} unaccounted for, in {captures}."
    return Group(build(columns, rows, width), Text(total))


def _route(row: Mapping[str, Any]) -> str:
    whose = f"sc_{row['spacecraft']} " if (row["spacecraft"] or 0) > FIRST_SPACECRAFT else ""
    return row["topic"] or f"{whose}{row['name'] or row['msg_id'] or '?'}"


ROW_TABLES: Final = {"captures": captures_table, "losses": losses_table}
"""Tables by the name of their rows in JSON."""


def answer_table(names: Sequence[str], rows: Iterable[Sequence[Any]], width: int) -> RenderableType:
    """Return the answer to a query as a table, numbers on the right; below it, a note on what is left out."""
    some = iter(rows)
    first_rows = list(islice(some, _MOST_LINES))
    rest = sum(1 for _ in some)
    texts = [
        [plain(_cell(value), palette.DIM if value is None else "") for value in row] for row in first_rows
    ]
    table = Table(box=None, padding=(0, 2, 0, 0), pad_edge=False, header_style=palette.STRONG)
    hidden = []
    for place, name in enumerate(names):
        column = [row[place] for row in texts]
        room = min(_WIDEST, max([cells(name), *(text.cell_len for text in column)]))
        if place and room > width:
            hidden.append(name)
            continue
        width -= room + 2
        right = any(isinstance(row[place], int | float) for row in first_rows)
        for text in column:
            text.truncate(room, overflow="ellipsis")
        table.add_column(plain(name), justify="right" if right else "left", no_wrap=True, overflow="ellipsis")
    places = [place for place, name in enumerate(names) if name not in hidden]
    for row in texts:
        table.add_row(*(row[place] for place in places))
    lines = [f"and {plural(rest, 'row')} more: --format csv"] * bool(rest)
    if hidden:
        columns = plural(len(hidden), "column")
        lines.append(
            f"{columns} of {len(names)} not shown: {', '.join(hidden)}; SELECT some, or --format csv"
        )
    return Group(table, *(Text(line, palette.DIM) for line in lines))


def short(capture: str) -> str:
    """Return a short name of a capture for people: its URL without the common folder."""
    path, folder = Path(capture), Path.cwd()
    return str(path.relative_to(folder)) if path.is_relative_to(folder) else capture


def json_rows(rows: Iterable[Sequence[Any]]) -> list[list[Any]]:
    """Return the rows of an answer as JSON values: times and the like become texts."""
    return [[_plain(value) for value in row] for row in rows]


def _plain(value: Any) -> Any:
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, dict):
        return {str(name): _plain(item) for name, item in value.items()}
    if isinstance(value, Decimal):
        value = float(value)
    if isinstance(value, bytes):
        return value.hex()
    return json_value(value) if value is None or isinstance(value, bool | int | float) else str(value)


def _cell(value: Any) -> str:
    if value is None:
        return units.NONE
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _when(time_ns: int | None) -> str:
    return units.NONE if time_ns is None else units.utc(time_ns, digits=0)


def _length(seconds: float | None) -> str:
    return units.NONE if seconds is None else units.duration(seconds)


def _percent(share: float | None) -> str:
    return units.NONE if share is None else f"{100 * share:.3g} %"
