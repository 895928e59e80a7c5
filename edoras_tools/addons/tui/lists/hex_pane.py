"""The bytes of the selected packet: offset, hex, ASCII, with a cursor and one range highlighted."""

from __future__ import annotations

from itertools import groupby
from typing import TYPE_CHECKING, Any, ClassVar, Final

from rich.segment import Segment
from rich.style import Style
from textual.binding import Binding
from textual.message import Message
from textual.strip import Strip

from edoras_tools.addons.tui.lists.lines import Lines
from edoras_tools.render.capture import tree
from edoras_tools.render.terminal import palette

if TYPE_CHECKING:
    from edoras_tools.model import Decoded
    from edoras_tools.render.capture.tree import Base

WIDE: Final = 72
"""Cells of a line with 16 bytes."""
_DIGITS: Final = 4
"""Digits of the offset: a datagram holds less than 64 KiB."""


class HexPane(Lines):
    """The bytes of one packet; a row is a line of 16 bytes, or of 8 if the pane is narrow.

    Posts ``Pointed`` when the user puts the cursor on a byte.
    """

    COMPONENT_CLASSES: ClassVar[set[str]] = {
        "lines--cursor",
        "lines--plain",
        "hex-pane--field",
        "hex-pane--byte",
    }
    BINDINGS: ClassVar[list[Any]] = [
        Binding("right,l", "step(1)", "Right", show=False),
        Binding("left,h", "step(-1)", "Left", show=False),
        Binding("down,j", "line(1)", "Down", show=False),
        Binding("up,k", "line(-1)", "Up", show=False),
        Binding("home,g", "byte(0)", "First", show=False),
        Binding("end,G", "byte(-1)", "Last", show=False),
    ]

    class Pointed(Message):
        """The user put the cursor on a byte; ``at`` counts from the start of the UDP payload."""

        def __init__(self, at: int) -> None:
            super().__init__()
            self.at = at

    def __init__(self) -> None:
        super().__init__(id="hex-pane")
        self.base: Base = "payload"
        self.field = (0, 0)
        self.at = 0
        self._decoded: Decoded | None = None
        self._data = b""
        self._styles: list[str] = []

    def show(self, decoded: Decoded | None) -> None:
        """Show another packet, without a highlight."""
        self._decoded = decoded
        self.field = (0, 0)
        datagram = decoded.datagram if decoded else None
        self._data = (
            b"" if datagram is None else datagram.payload if self.base == "payload" else datagram.frame
        )
        self._styles = [palette.DIM] * len(self._data)
        for region in tree.regions(decoded, self.base) if decoded else ():
            for place in range(max(0, region.start), min(len(self._data), region.end)):
                self._styles[place] = region.style
        self.at = min(self.at, max(0, len(self._data) - 1))
        self.recount()

    def set_base(self, base: Base) -> None:
        """Switch to the UDP payload, or to the whole frame."""
        field, at, before = self.field, self.at, self.shift
        self.base = base
        self.show(self._decoded)
        self.point(field[0] - before, field[1] - before, at - before)

    def point(self, start: int, end: int, at: int | None = None) -> None:
        """Highlight bytes of the payload and scroll to them.

        Args:
            start: the first byte, counted from the start of the payload.
            end: one past the last.
            at: byte for the cursor; None: the first byte, unless the cursor is already in the range.
        """
        shift = self.shift
        self.field = (start + shift, end + shift) if end > start and shift >= 0 else (0, 0)
        if self.field[1]:
            low, high = self.field
            at = None if at is None else at + shift
            self.at = (self.at if low <= self.at < high else low) if at is None else at
            # First scroll to the end, then to the start, because the start must be visible.
            self.go((min(high, len(self._data)) - 1) // self.per_line)
            self.go(low // self.per_line)
            self.go(self.at // self.per_line)
        self.refresh()

    @property
    def title(self) -> str:
        """Title of the pane: ``UDP payload, 76 bytes``."""
        name = "UDP payload" if self.base == "payload" else "Frame"
        return f"{name}, {len(self._data):,} bytes"

    @property
    def per_line(self) -> int:
        """Bytes per line."""
        return 16 if self.room >= WIDE else 8

    def rows(self) -> int:
        """Return the number of lines of the bytes."""
        return -(-len(self._data) // self.per_line)

    def draw(self, row: int, width: int) -> Strip:
        """Return a line; the highlight is one block without gaps."""
        first = row * self.per_line
        places = range(first, min(first + self.per_line, len(self._data)))
        segments = [Segment(f"{first:0{_DIGITS}x} ", Style.parse(palette.DIM))]
        text: list[Segment] = []
        for kind, run in groupby(places, key=self._kind):
            inside = list(run)
            style = self._style(kind)
            for place in inside:
                gap = " " if place % 16 != 8 or self.per_line == 8 else "  "
                # The gap in front of a byte belongs to the field if the byte before it does.
                joined = kind[1] and place > first and place > self.field[0]
                segments += [
                    Segment(gap, self._style((palette.DIM, True, False)) if joined else Style.null()),
                    Segment(f"{self._data[place]:02x}", style),
                ]
            text.append(Segment("".join(_printable(self._data[place]) for place in inside), style))
        missing = self.per_line - len(places)
        blank = 3 * missing + (1 if self.per_line == 16 and missing >= 8 else 0) + 2
        return Strip([*segments, Segment(" " * blank), *text]).crop(0, width)

    def row_style(self, row: int) -> str:
        """Return no style: this pane highlights bytes, not lines."""
        return ""

    def on_resize(self) -> None:
        """Lay out the bytes for another width."""
        self.recount()
        self.go(self.at // self.per_line)

    def action_step(self, by: int) -> None:
        """Move the cursor by bytes."""
        self.action_byte(max(0, self.at + by))

    def action_line(self, by: int) -> None:
        """Move the cursor by lines."""
        target = self.at + by * self.per_line
        if 0 <= target < len(self._data):
            self.action_byte(target)

    def action_page(self, by: float) -> None:
        """Move the cursor by pages."""
        step = round(by * max(1, self.page - 1)) * self.per_line
        self.action_byte(max(0, min(len(self._data) - 1, self.at + step)))

    def action_byte(self, at: int) -> None:
        """Put the cursor on a byte; a negative number counts from the end."""
        if not self._data:
            return
        self.at = min(at, len(self._data) - 1) if at >= 0 else len(self._data) + at
        self.go(self.at // self.per_line)
        self.refresh()
        self.post_message(self.Pointed(self.at - max(0, self.shift)))

    def clicked(self, row: int, column: int, *, again: bool) -> None:
        """Select the byte under the mouse, in hex or in ASCII."""
        place = self._place(column)
        at = row * self.per_line + place
        if 0 <= place < self.per_line and at < len(self._data):
            self.action_byte(at)

    @property
    def shift(self) -> int:
        """Offset of the payload in the shown bytes; -1 if it is not among them."""
        if self.base == "payload" or self._decoded is None:
            return 0
        return self._decoded.datagram.payload_offset

    def _place(self, column: int) -> int:
        """Return the byte of the line at a cell; -1 for none."""
        wide = self.per_line == 16
        ascii_at = _DIGITS + 1 + 3 * self.per_line + (1 if wide else 0) + 2
        if column >= ascii_at:
            return column - ascii_at
        cell = column - _DIGITS - 1
        if wide and cell > 24:
            cell -= 1
        return (cell - 1) // 3 if cell >= 1 else -1

    def _kind(self, place: int) -> tuple[str, bool, bool]:
        """Return the look of a byte: its layer's style, whether highlighted, whether under the cursor."""
        low, high = self.field
        return self._styles[place], low <= place < high, place == self.at and self.has_focus

    def _style(self, kind: tuple[str, bool, bool]) -> Style:
        name, pointed, cursor = kind
        style = Style.parse(name)
        if cursor:
            return style + self.get_component_rich_style("hex-pane--byte")
        return self.get_component_rich_style("hex-pane--field") if pointed else style


def _printable(byte: int) -> str:
    return chr(byte) if 32 <= byte < 127 else "·"
