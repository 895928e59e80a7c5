"""The packet list; a packet is dissected when its line is drawn."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar, Final

import numpy as np
from rich.segment import Segment
from rich.style import Style
from rich.text import Text
from textual.cache import LRUCache
from textual.strip import Strip

from edoras_tools.addons.tui.lists.lines import Lines, strip_of
from edoras_tools.cfs.names import MSG_ID_NAMES
from edoras_tools.decode import Dissector
from edoras_tools.decode.filters.filter import fields
from edoras_tools.decode.filters.rows import ColumnRows
from edoras_tools.decode.lines import line_of
from edoras_tools.model import NO_FINDINGS, Finding
from edoras_tools.pipelines.capture.fields import column_texts, is_number
from edoras_tools.render.capture.packet_list import COLUMNS, PacketList
from edoras_tools.render.severity import EXPLANATIONS, NOTABLE, Level
from edoras_tools.render.terminal.text import clean
from edoras_tools.render.units import TimeFormat

if TYPE_CHECKING:
    from collections.abc import Sequence

    from edoras_tools.addons.tui.data.store import Store
    from edoras_tools.decode.context import Context
    from edoras_tools.pipelines.capture.fields import Column

_GUTTER: Final = 2
"""Cells at the left for marks."""
_KEPT: Final = 4096
"""Drawn lines that are cached."""
_ERRORS: Final = Finding(sum(item for item, entry in EXPLANATIONS.items() if entry.severity == Level.ERROR))


class Packets(Lines):
    """One line per packet.

    Args:
        verbose: whether to show notes, besides warnings and errors.

    Attributes:
        marks: numbers of the marked packets.
        references: zeros of relative times, ns since 1970, by number of the packet.
        follow: whether to stay at the end when packets arrive; set when the user goes to the end, cleared
            when the user leaves it.
        empty: text to show when there are no packets.
        drawn: cached lines, by packet number.
        columns: names of the columns besides number and message.
        sorted_by: name of the column that the list is sorted by; empty for the order of the capture.
        reverse: whether the order is reversed.
    """

    COMPONENT_CLASSES: ClassVar[set[str]] = {
        "lines--cursor",
        "lines--plain",
        "packets--error",
        "packets--warning",
        "packets--mark",
        "packets--marked",
    }

    def __init__(
        self, store: Store, context: Context, time_format: TimeFormat, *, verbose: bool = False
    ) -> None:
        super().__init__(id="packets")
        self.marks: set[int] = set()
        self.references: dict[int, int] = {}
        self.follow = False
        self.empty = ""
        self._store = store
        self._dissector = Dissector(context, detail=False)
        self._time_format = time_format
        self._verbose = verbose
        self.columns: Sequence[str] = COLUMNS
        self.sorted_by = ""
        self.reverse = False
        self._added: Sequence[Column] = ()
        self._view = self._make_view(80)
        self._views: dict[int, PacketList] = {}
        self.drawn: LRUCache[tuple[int, int], Strip] = LRUCache(_KEPT)

    @property
    def time_format(self) -> TimeFormat:
        """The format of the time column."""
        return self._time_format

    @time_format.setter
    def time_format(self, value: TimeFormat) -> None:
        self._time_format = value
        self.forget()

    def choose(self, names: Sequence[str]) -> None:
        """Show these columns: names in ``COLUMNS``, and fields of packets; without names the usual ones.

        Raises:
            WhereError: a name is neither.
        """
        added = [name for name in names if name not in COLUMNS]
        self._added = fields(",".join(added), self._dissector.context, "column") if added else ()
        self.columns = tuple(names) or COLUMNS
        self.forget()

    def forget(self) -> None:
        """Redraw every line, for another filter or time format."""
        self._view, self._views = self._make_view(self.room), {}
        self.drawn.clear()
        self.refresh()
        self.refresh_header()

    def arrived(self, dropped: int) -> None:
        """Update after packets arrived and ``dropped`` rows at the top were dropped."""
        if dropped:
            self.set_reactive(Packets.cursor, max(0, self.cursor - dropped))
            self.set_scroll(None, max(0, self.scroll_y - dropped))
        self.recount()
        if self.follow:
            self.go(-1)

    def user_moved(self) -> None:
        """Follow new packets if the cursor is at the end; else stop following."""
        last = self.rows() - 1
        self.follow = self.cursor >= last and round(self.scroll_y) + self.page >= last

    def render_line(self, y: int) -> Strip:
        """Draw a line, or the text for an empty list."""
        if self.rows() or y != 1:
            return super().render_line(y)
        line = strip_of(Text(f"{' ' * _GUTTER}{self.empty}", "dim"), self.app.console)
        return line.adjust_cell_length(self.room).apply_style(self.get_component_rich_style("lines--plain"))

    def header(self) -> Text:
        """Return the names of the columns."""
        return Text.assemble(" " * _GUTTER, Text.from_ansi(self._view.header()))

    def rows(self) -> int:
        """Return the number of packets that pass the filter."""
        return len(self._store)

    def draw(self, row: int, width: int) -> Strip:
        """Return a packet's line; it already has the list's width."""
        block, index = self._store.locate(row)
        number = int(block.batch.number[index])
        key = number, row if self._time_format is TimeFormat.DELTA else 0
        line = self.drawn.get(key)
        if line is None:
            decoded = self._dissector.dissect(block.batch[index])
            previous = self._store.time_ns(row - 1) if row else int(block.batch.time_ns[index])
            values: Sequence[str] = ()
            if self._added:
                one = ColumnRows(
                    self._dissector.context,
                    self._store.begin_ns or 0,
                    block.batch,
                    block.columns,
                    np.array([index]),
                )
                values = [texts[0] for texts in column_texts(one, self._added, clean)]
            view = self._counting_from(number)
            line = strip_of(view.line(line_of(decoded), previous, values), self.app.console)
            self.drawn[key] = line
        mark = ("◆" if number in self.marks else "") + ("⌖" if number in self.references else "")
        style = self.get_component_rich_style("packets--mark", partial=True) if mark else Style.null()
        return Strip([Segment(f"{mark:<{_GUTTER}}", style), *line], _GUTTER + line.cell_length)

    def _counting_from(self, number: int) -> PacketList:
        """Return the view whose zero of times is the last reference up to a packet."""
        at = max((item for item in self.references if item <= number), default=None)
        if at is None:
            return self._view
        if at not in self._views:
            self._views[at] = self._make_view(self.room, self.references[at])
        return self._views[at]

    def row_style(self, row: int) -> str:
        """Return the style of a line: cursor, mark, error or warning."""
        if row >= self.rows() or row == self.cursor:
            return super().row_style(row)
        block, index = self._store.locate(row)
        if int(block.batch.number[index]) in self.marks:
            return "packets--marked"
        findings = Finding(int(block.columns.findings[index])) & NOTABLE
        if findings == NO_FINDINGS:
            return ""
        return "packets--error" if findings & _ERRORS else "packets--warning"

    def on_resize(self) -> None:
        """Lay out the columns for another width; the cursor stays visible."""
        self.forget()
        self.go(self.cursor)

    def _make_view(self, width: int, begin_ns: int | None = None) -> PacketList:
        return PacketList(
            width - _GUTTER,
            colour=True,
            time_format=self._time_format,
            names=MSG_ID_NAMES,
            verbose=self._verbose,
            begin_ns=begin_ns or self._store.begin_ns,
            columns=[name for name in self.columns if name in COLUMNS],
            added=[(column[0], is_number(column)) for column in self._added],
        )
