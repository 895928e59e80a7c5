"""A list with a cursor that draws only the lines in sight, however many there are."""

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
    """Rows of one line each; what they are is for the subclass to say.

    One moves about by arrows, as in vi, and by mouse. Posts ``Moved`` when the cursor goes to another row,
    ``Chosen`` at Enter or a second click on a row.
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
            """Return whose cursor."""
            return self.lines

    class Chosen(Moved):
        """The row under the cursor is chosen."""

    def header(self) -> Text:
        """Return what stands over the columns."""
        return Text()

    def rows(self) -> int:
        """Return how many rows there are."""
        raise NotImplementedError

    def draw(self, row: int, width: int) -> Strip:
        """Return a row as a line of at most that many cells."""
        raise NotImplementedError

    def tint(self, row: int) -> str:
        """Return the component class that lies under a row, or nothing."""
        return "lines--cursor" if row == self.cursor and self.rows() else ""

    @property
    def room(self) -> int:
        """Cells that a line may take."""
        return max(1, self.scrollable_content_region.width)

    @property
    def page(self) -> int:
        """Rows in sight."""
        return max(1, self.scrollable_content_region.height)

    def recount(self) -> None:
        """Take note that there are more or fewer rows."""
        count = self.rows()
        if self.virtual_size.height != count:
            self.virtual_size = Size(1, count)
        if self.cursor >= count:
            self.cursor = max(0, count - 1)
        self.refresh()

    def refresh_heads(self) -> None:
        """Draw what stands over the columns anew."""
        if self.is_attached:
            for heads in self.screen.query(Heads):
                if heads.of == self.id:
                    heads.refresh()

    def go(self, row: int, *, centre: bool = False) -> None:
        """Put the cursor on a row and bring it into sight.

        Args:
            row: counted from the end where it is negative.
            centre: in the middle, unless it is in sight already.
        """
        count = self.rows()
        row = max(0, min(count - 1, row if row >= 0 else count + row))
        top, page = round(self.scroll_y), self.page
        if row < top or row >= top + page:
            wanted = row - page // 2 if centre else row if row < top else row - page + 1
            self.scroll_to(y=max(0, wanted), animate=False, force=True, immediate=True)
        self.cursor = row

    def watch_cursor(self, before: int, after: int) -> None:
        """Draw the two rows anew and tell."""
        top = round(self.scroll_y)
        for row in (before, after):
            self.redraw(row - top)
        self.post_message(self.Moved(self))

    def redraw(self, line: int) -> None:
        """Draw one line in sight anew."""
        if 0 <= line < self.page:
            self.refresh(Region(0, line, self.size.width, 1))

    def render_line(self, y: int) -> Strip:
        """Draw a line; see ``Widget.render_line``."""
        row = y + self.scroll_offset.y
        width = self.scrollable_content_region.width
        strip = self.draw(row, width) if 0 <= row < self.rows() else Strip.blank(width)
        # A component's style is kept, the widget's own is put together each time it is asked for.
        style = self.get_component_rich_style(self.tint(row) or "lines--plain")
        return strip.adjust_cell_length(width).apply_style(style)

    def touched(self) -> None:
        """Take note that the user moved about, by key or mouse."""

    def action_move(self, by: int) -> None:
        """Move the cursor by rows."""
        self.go(max(0, self.cursor + by))
        self.touched()

    def action_page(self, by: float) -> None:
        """Move the cursor by pages, and the page with it."""
        step = round(by * max(1, self.page - 1)) or (1 if by > 0 else -1)
        self.scroll_to(y=max(0, round(self.scroll_y) + step), animate=False, force=True, immediate=True)
        self.go(max(0, self.cursor + step))
        self.touched()

    def action_jump(self, row: int) -> None:
        """Go to a row, counted from the end where it is negative."""
        self.go(row)
        self.touched()

    def action_choose(self) -> None:
        """Choose the row under the cursor."""
        if self.rows():
            self.post_message(self.Chosen(self))

    def on_click(self, event: events.Click) -> None:
        """Put the cursor where the mouse is; a second click chooses."""
        at = event.get_content_offset(self)
        if at is None or at.y >= self.page:
            return
        row = at.y + self.scroll_offset.y
        if row < self.rows():
            self.go(row)
            self.touched()
            self.clicked(row, at.x, again=event.chain > 1)

    def clicked(self, row: int, column: int, *, again: bool) -> None:
        """Take note of a click on a row.

        Args:
            row: which.
            column: the cell, from the left.
            again: it follows another on the same place.
        """
        del row, column
        if again:
            self.action_choose()

    def on_mouse_scroll_down(self, event: events.MouseScrollDown) -> None:
        """Scroll by the wheel."""
        self.scroll_relative(y=_WHEEL_LINES, animate=False, force=True, immediate=True)
        self.touched()
        event.stop()

    def on_mouse_scroll_up(self, event: events.MouseScrollUp) -> None:
        """Scroll by the wheel."""
        self.scroll_relative(y=-_WHEEL_LINES, animate=False, force=True, immediate=True)
        self.touched()
        event.stop()


class Heads(Widget):
    """The line over a list that says what its columns are.

    Args:
        of: the list's id.
    """

    DEFAULT_CSS = "Heads { height: 1; }"

    def __init__(self, of: str) -> None:
        super().__init__(id=f"{of}-heads")
        self.of = of

    def render(self) -> Text:
        """Return what the list says."""
        text = self.screen.query_one(f"#{self.of}", Lines).header()
        text.no_wrap, text.overflow = True, "crop"
        return text


def strip_of(line: str | Text, console: Console) -> Strip:
    """Return a line with ANSI styles, or a rich text, as what widgets draw."""
    text = Text.from_ansi(line) if isinstance(line, str) else line
    segments = [Segment(part.text, part.style) for part in text.render(console) if part.text]
    return Strip(segments, text.cell_len)
