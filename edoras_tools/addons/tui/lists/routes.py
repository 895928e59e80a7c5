"""Routes and their rates, one line each; Enter filters for the route."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar, Final

from msgspec.structs import replace
from rich.segment import Segment
from rich.text import Text
from textual.binding import Binding
from textual.strip import Strip

from edoras_tools.addons.tui.lists.lines import Lines
from edoras_tools.render import units
from edoras_tools.render.capture.info import SPACECRAFT, departures, link_text, msg_id_text, route_text
from edoras_tools.render.terminal import palette
from edoras_tools.render.terminal.live_table import Rates
from edoras_tools.render.terminal.table import Column, build, figure, plain

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from edoras_tools.pipelines.capture.ledger import Ledger

_RATE: Final = "now_hz"
_GUTTER: Final = 2


def _rate(row: Mapping[str, Any], key: str) -> Text:
    value = row.get(key) if row["count"] > 1 else None
    return Text(units.rate(value or None), "" if value else palette.DIM)


_COLUMNS: Final = (
    Column("Link", link_text, justify="left"),
    Column("MsgId", msg_id_text, justify="left"),
    Column("Topic", route_text, justify="left", elastic=True),
    Column("Type", lambda row: plain(row.get("type") or "", palette.DIM), rank=6, justify="left"),
    Column("CPU", lambda row: plain(row.get("processor_id") or ""), rank=3),
    Column("Count", lambda row: Text(units.count(row["count"]), palette.STRONG)),
    Column("Now", lambda row: _rate(row, _RATE)),
    Column("Mean", lambda row: _rate(row, "rate_hz"), rank=1),
    Column("Jitter", lambda row: Text(units.milliseconds(row["jitter_ms"] or None)), rank=4),
    Column("Gaps", figure("gaps", "yellow"), rank=2),
    Column("Bytes", lambda row: Text(units.size(row["bytes"])), rank=5),
    Column("Findings", lambda row: departures(row["findings"]), rank=1, justify="left"),
)


_SORTS: Final[Mapping[str, Callable[[Mapping[str, Any]], Any]]] = {
    "Link": lambda row: row["link"],
    "MsgId": lambda row: row["msg_id"] or "",
    "Topic": lambda row: row["topic"] or row["name"] or "",
    "Count": lambda row: -row["count"],
    "Now": lambda row: -(row.get(_RATE) or 0),
    "Mean": lambda row: -(row["rate_hz"] or 0),
    "Jitter": lambda row: -(row["jitter_ms"] or 0),
    "Gaps": lambda row: -row["gaps"],
    "Bytes": lambda row: -row["bytes"],
}
"""Sort keys by column: texts from A to Z, numbers from the largest."""


class Routes(Lines):
    """The routes of a ledger.

    Args:
        live: whether packets arrive live, so that there is a current rate.

    Attributes:
        ledger: ledger with the routes.
    """

    BINDINGS: ClassVar[list[Any]] = [
        Binding("o", "sort", "Sort", show=False),
        Binding("O", "reverse", "Other way round", show=False),
    ]

    def __init__(self, ledger: Ledger, *, live: bool) -> None:
        super().__init__(id="routes")
        self.ledger = ledger
        self._columns = [column for column in _COLUMNS if live or column.title != "Now"]
        self._sorted = ""
        self._reverse = False
        self._rates = Rates()
        self._counted: list[dict[str, Any]] = []
        self._rows: list[dict[str, Any]] = []
        self._lines: list[list[Segment]] = [[]]

    def count(self, ledger: Ledger) -> None:
        """Show the routes of another ledger."""
        self.ledger, self._rates = ledger, Rates()

    def update_rates(self, now: float) -> None:
        """Update counts and rates.

        Args:
            now: monotonic time, s.
        """
        self._counted = self.ledger.routes()
        rates = self._rates.add(now, {_key(row): row["count"] for row in self._counted})
        for row in self._counted:
            row[_RATE] = rates[_key(row)]
        self._sort()

    def action_sort(self) -> None:
        """Sort by the next column; after the last one, in order of the first packets."""
        titles = ["", *(column.title for column in self._columns if column.title in _SORTS)]
        self._sorted = titles[(titles.index(self._sorted) + 1) % len(titles)]
        self._reverse = False
        self._sort()

    def action_reverse(self) -> None:
        """Reverse the order."""
        self._reverse = not self._reverse
        self._sort()

    def _sort(self) -> None:
        """Sort the rows; the cursor stays on its route."""
        at = _key(self._rows[self.cursor]) if self._rows else None
        self._rows = list(self._counted)
        if self._sorted:
            self._rows.sort(key=_SORTS[self._sorted])
        if self._reverse:
            self._rows.reverse()
        self._lay_out()
        self.cursor = next((place for place, row in enumerate(self._rows) if _key(row) == at), self.cursor)

    @property
    def filter(self) -> str:
        """The filter for the route under the cursor."""
        row = self._rows[self.cursor]
        words = [f"link == {row['link']}"]
        if row["msg_id"]:
            words.append(f"msg_id == {row['msg_id']}")
        elif (row["name"] or "").startswith("SBN_") and "0x" not in row["name"]:
            words.append(f"sbn.msg_type == {row['name'].removeprefix('SBN_')}")
        if row["processor_id"]:
            words.append(f"processor_id == {row['processor_id']}")
        if "spacecraft" in row:
            words.append(f"spacecraft == {row['spacecraft']}")
        return " and ".join(words)

    def header(self) -> Text:
        """Return the column titles."""
        return Text.assemble(" " * _GUTTER, *((part.text, part.style or "") for part in self._lines[0]))

    def rows(self) -> int:
        """Return the number of routes."""
        return len(self._lines) - 1

    def draw(self, row: int, width: int) -> Strip:
        """Return a route's line."""
        return Strip([Segment(" " * _GUTTER), *self._lines[row + 1]]).crop(0, width)

    def on_resize(self) -> None:
        """Lay out the columns for another width."""
        self._lay_out()

    def _lay_out(self) -> None:
        width = max(20, self.room - _GUTTER)
        console = self.app.console
        mark = "▲" if self._reverse else "▼"
        columns = [
            replace(item, title=f"{item.title} {mark}", rank=0) if item.title == self._sorted else item
            for item in (*self._columns, *[SPACECRAFT] * any("spacecraft" in row for row in self._rows))
        ]
        table = build(columns, self._rows, width)
        options = console.options.update(width=width, height=None)
        self._lines = console.render_lines(table, options) or [[]]
        self.recount()
        self.refresh_header()


def _key(row: Mapping[str, Any]) -> object:
    names = "link", "spacecraft", "processor_id", "msg_id", "name", "topic"
    return tuple(row.get(name) for name in names)
