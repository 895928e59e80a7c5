"""A list with a cursor that draws only the lines on the screen, whatever its length."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

from rich.segment import Segment
from rich.text import Text
from textual.binding import Binding
from textual.geometry import Region, Size
from textual.message import Message
from textual.reactive import reactive
from textual.scroll_view import ScrollView
from textual.strip import Strip
from textual.widget import Widget

if TYPE_CHECKING:
    from rich.console import Console
    from textual import events

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
