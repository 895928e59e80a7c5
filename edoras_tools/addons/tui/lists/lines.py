"""A list with a cursor that draws only the lines on the screen, whatever its length.

One of these is the packet list; a packet is dissected when its line is drawn.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Final

import numpy as np
from rich.segment import Segment
from rich.style import Style
from rich.text import Text
from textual.binding import Binding
from textual.cache import LRUCache
from textual.geometry import Region, Size
from textual.message import Message
from textual.reactive import reactive
from textual.scroll_view import ScrollView
from textual.strip import Strip
from textual.widget import Widget

from edoras_tools.cfs.names import MSG_ID_NAMES
from edoras_tools.decode import Dissector
from edoras_tools.decode.filters.filter import fields
from edoras_tools.decode.filters.rows import ColumnRows
from edoras_tools.decode.lines import line_of
from edoras_tools.model import NO_FINDINGS, Finding
from edoras_tools.pipelines.capture.sniff import column_texts, is_number
from edoras_tools.render.capture.packet_list import COLUMNS, PacketList
from edoras_tools.render.severity import EXPLANATIONS, NOTABLE, Level
from edoras_tools.render.terminal.text import clean
from edoras_tools.words import TimeFormat

if TYPE_CHECKING:
    from rich.console import Console
    from textual import events

    from edoras_tools.addons.tui.store import Store
    from edoras_tools.decode.context import Context
    from edoras_tools.pipelines.capture.sniff import Column

_WHEEL_LINES = 3


class Lines(ScrollView, can_focus=True):
    """Rows of one line each; the subclass draws them.

    The keys are the arrows and those of vi; the mouse works too. Posts ``Moved`` when the cursor goes to
    another row, ``Chosen`` at Enter or a double click on a row.
    """

    COMPONENT_CLASSES: ClassVar[set[str]] = {"lines--cursor", "lines--plain"}
    BINDINGS: ClassVar[list[Any]] = [
        Binding("down,j", "move(1)", "Down", show=False),
        Binding("up,k", "move(-1)", "Up", show=False),
        Binding("pagedown,space,ctrl+f", "page(1)", "Page down", show=False),
        Binding("pageup,ctrl+b", "page(-1)", "Page up", show=False),
        Binding("ctrl+d", "page(0.5)", "Half a page down", show=False),
        Binding("ctrl+u", "page(-0.5)", "Half a page up", show=False),
        Binding("home,g", "jump(0)", "First", show=False),
        Binding("end,G", "jump(-1)", "Last", show=False),
        Binding("enter", "choose", "Choose", show=False),
    ]

    cursor: reactive[int] = reactive(0, repaint=False)

    class Moved(Message):
        """The cursor is on another row."""

        def __init__(self, lines: Lines) -> None:
            super().__init__()
            self.lines = lines

        @property
        def control(self) -> Lines:
            """Return the list that posted the message."""
            return self.lines

    class Chosen(Moved):
        """The row under the cursor is chosen."""

    def header(self) -> Text:
        """Return the line of column titles."""
        return Text()

    def rows(self) -> int:
        """Return the number of rows."""
        raise NotImplementedError

    def draw(self, row: int, width: int) -> Strip:
        """Return a row as a line of at most ``width`` cells."""
        raise NotImplementedError

    def row_style(self, row: int) -> str:
        """Return the component class of a row's background; empty for none."""
        return "lines--cursor" if row == self.cursor and self.rows() else ""

    @property
    def room(self) -> int:
        """Cells per line."""
        return max(1, self.scrollable_content_region.width)

    @property
    def page(self) -> int:
        """Rows on the screen."""
        return max(1, self.scrollable_content_region.height)

    def recount(self) -> None:
        """Update after rows were added or removed."""
        count = self.rows()
        if self.virtual_size.height != count:
            self.virtual_size = Size(1, count)
        if self.cursor >= count:
            self.cursor = max(0, count - 1)
        self.refresh()

    def refresh_header(self) -> None:
        """Redraw the column titles."""
        if self.is_attached:
            for heads in self.screen.query(HeaderLine):
                if heads.of == self.id:
                    heads.refresh()

    def go(self, row: int, *, centre: bool = False) -> None:
        """Put the cursor on a row and scroll to it.

        Args:
            row: a negative number counts from the end.
            centre: scroll it to the middle, unless it is already visible.
        """
        count = self.rows()
        row = max(0, min(count - 1, row if row >= 0 else count + row))
        top, page = round(self.scroll_y), self.page
        if row < top or row >= top + page:
            target = row - page // 2 if centre else row if row < top else row - page + 1
            self.scroll_to(y=max(0, target), animate=False, force=True, immediate=True)
        self.cursor = row

    def watch_cursor(self, before: int, after: int) -> None:
        """Redraw the two rows, and post ``Moved``."""
        top = round(self.scroll_y)
        for row in (before, after):
            self.redraw(row - top)
        self.post_message(self.Moved(self))

    def redraw(self, line: int) -> None:
        """Redraw one line of the screen."""
        if 0 <= line < self.page:
            self.refresh(Region(0, line, self.size.width, 1))

    def render_line(self, y: int) -> Strip:
        """Draw a line; see ``Widget.render_line``."""
        row = y + self.scroll_offset.y
        width = self.scrollable_content_region.width
        strip = self.draw(row, width) if 0 <= row < self.rows() else Strip.blank(width)
        # Textual caches the style of a component; it computes the widget's own style at each call.
        style = self.get_component_rich_style(self.row_style(row) or "lines--plain")
        return strip.adjust_cell_length(width).apply_style(style)

    def user_moved(self) -> None:
        """Called when the user has moved the cursor or scrolled."""

    def action_move(self, by: int) -> None:
        """Move the cursor by rows."""
        self.go(max(0, self.cursor + by))
        self.user_moved()

    def action_page(self, by: float) -> None:
        """Move cursor and view by pages."""
        step = round(by * max(1, self.page - 1)) or (1 if by > 0 else -1)
        self.scroll_to(y=max(0, round(self.scroll_y) + step), animate=False, force=True, immediate=True)
        self.go(max(0, self.cursor + step))
        self.user_moved()

    def action_jump(self, row: int) -> None:
        """Go to a row; a negative number counts from the end."""
        self.go(row)
        self.user_moved()

    def action_choose(self) -> None:
        """Post ``Chosen`` for the row under the cursor."""
        if self.rows():
            self.post_message(self.Chosen(self))

    def on_click(self, event: events.Click) -> None:
        """Put the cursor under the mouse; a double click chooses the row."""
        at = event.get_content_offset(self)
        if at is None or at.y >= self.page:
            return
        row = at.y + self.scroll_offset.y
        if row < self.rows():
            self.go(row)
            self.user_moved()
            self.clicked(row, at.x, again=event.chain > 1)

    def clicked(self, row: int, column: int, *, again: bool) -> None:
        """Handle a click on a row.

        Args:
            column: the cell, from the left.
            again: whether it is the second click of a double click.
        """
        if again:
            self.action_choose()

    def on_mouse_scroll_down(self, event: events.MouseScrollDown) -> None:
        """Scroll down."""
        self.scroll_relative(y=_WHEEL_LINES, animate=False, force=True, immediate=True)
        self.user_moved()
        event.stop()

    def on_mouse_scroll_up(self, event: events.MouseScrollUp) -> None:
        """Scroll up."""
        self.scroll_relative(y=-_WHEEL_LINES, animate=False, force=True, immediate=True)
        self.user_moved()
        event.stop()


class HeaderLine(Widget):
    """The line of column titles above a list.

    Args:
        of: the list's id.
    """

    DEFAULT_CSS = "HeaderLine { height: 1; }"

    def __init__(self, of: str) -> None:
        super().__init__(id=f"{of}-heads")
        self.of = of

    def render(self) -> Text:
        """Return the list's column titles."""
        text = self.screen.query_one(f"#{self.of}", Lines).header()
        text.no_wrap, text.overflow = True, "crop"
        return text


def strip_of(line: str | Text, console: Console) -> Strip:
    """Convert a line with ANSI styles, or a rich text, to Textual's strip."""
    text = Text.from_ansi(line) if isinstance(line, str) else line
    segments = [Segment(part.text, part.style) for part in text.render(console) if part.text]
    return Strip(segments, text.cell_len)


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
