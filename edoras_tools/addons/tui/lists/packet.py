"""The selected packet: its layers and fields as a tree, and its bytes: offset, hex, ASCII, with a cursor."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from typing import TYPE_CHECKING, Any, ClassVar, Final

from rich.segment import Segment
from rich.style import Style
from rich.text import Text
from textual.binding import Binding
from textual.message import Message
from textual.strip import Strip

from edoras_tools.addons.tui.lists.lines import Lines, strip_of
from edoras_tools.render.capture import tree
from edoras_tools.render.terminal import palette
from edoras_tools.render.terminal.text import clip, wrap

if TYPE_CHECKING:
    from edoras_tools.model import Decoded
    from edoras_tools.render.capture.tree import Base, TreeRow

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


_NARROW: Final = 64
"""Width below which the byte ranges are left out: the hex pane shows them."""
_LEAST: Final = 40
_MOST_LINES: Final = 6
"""Most lines of one value."""
_BRANCHES: Final = ("layer", "group")
_INSIDE: Final = ("field", *_BRANCHES)
_PAINT: Final = palette.Paint(colour=True)


class Layers(Lines):
    """The tree of one packet; one row may take several lines."""

    BINDINGS: ClassVar[list[Any]] = [
        Binding("right,l", "open(True)", "Open", show=False),
        Binding("left,h", "open(False)", "Close", show=False),
        Binding("enter,space", "toggle_branch", "Open or close", show=False),
        Binding("asterisk", "all(True)", "Open all", show=False),
        Binding("minus", "all(False)", "Close all", show=False),
    ]

    def __init__(self) -> None:
        super().__init__(id="layers")
        self._rows: list[TreeRow] = []
        self._above: list[list[int]] = []
        self._paths: list[str] = []
        self._shut: set[str] = set()
        self._lines: list[tuple[int, str]] = []
        self._strips: dict[int, Strip] = {}
        self._cut = 0

    def show(self, decoded: Decoded | None) -> None:
        """Show another packet; the cursor stays on the row of the same name, open branches stay open."""
        before = None if self.selected_place is None else self._paths[self.selected_place]
        self._rows = list(tree.rows(decoded)) if decoded else []
        self._above = _branches_above(self._rows)
        self._paths = [
            "\n".join(_name(self._rows[place], place) for place in (*above, row))
            for row, above in enumerate(self._above)
        ]
        same = next((row for row, path in enumerate(self._paths) if path == before), None)
        self._lay_out(same)

    @property
    def selected_place(self) -> int | None:
        """The row under the cursor, an index into the tree's rows."""
        return self._lines[self.cursor][0] if self.cursor < len(self._lines) else None

    @property
    def field(self) -> TreeRow | None:
        """The row under the cursor."""
        return None if self.selected_place is None else self._rows[self.selected_place]

    @property
    def field_name(self) -> str:
        """Name of the row under the cursor, with its groups: ``pose.position.x``."""
        if self.selected_place is None:
            return ""
        above = [self._rows[place] for place in self._above[self.selected_place]]
        groups = [row.label for row in above if row.role == "group"]
        return ".".join([*groups, self._rows[self.selected_place].label])

    def choose_byte(self, at: int) -> bool:
        """Put the cursor on the smallest field that contains a payload byte; False if there is none."""
        holding = [row for row, item in enumerate(self._rows) if item.start <= at < item.end]
        if not holding:
            return False
        best = min(
            holding, key=lambda row: (self._rows[row].end - self._rows[row].start, -self._rows[row].depth)
        )
        for above in self._above[best]:
            self._shut.discard(self._paths[above])
        self._lay_out(best, centre=True)
        return True

    def rows(self) -> int:
        """Return the number of lines of the open branches."""
        return len(self._lines)

    def draw(self, row: int, width: int) -> Strip:
        """Return a line."""
        if row not in self._strips:
            place, line = self._lines[row]
            text = Text.from_ansi(line)
            text = text[self._cut :] if self._rows[place].role in _BRANCHES else text
            self._strips[row] = strip_of(text, self.app.console)
        return self._strips[row]

    def row_style(self, row: int) -> str:
        """Return the cursor's style for every line of the chosen row."""
        return (
            "lines--cursor" if row < len(self._lines) and self._lines[row][0] == self.selected_place else ""
        )

    def watch_cursor(self, before: int, after: int) -> None:
        """Redraw the lines of both rows, and post ``Moved``."""
        self.refresh()
        super().watch_cursor(before, after)

    def action_move(self, by: int) -> None:
        """Move the cursor by rows; a row may take several lines."""
        starts = [
            line
            for line, (place, _) in enumerate(self._lines)
            if not line or self._lines[line - 1][0] != place
        ]
        if by > 0:
            self.go(next((line for line in starts if line > self.cursor), self.cursor))
        else:
            self.go(max((line for line in starts if line < self.cursor), default=self.cursor))

    def on_resize(self) -> None:
        """Lay out the lines for another width."""
        self._lay_out(self.selected_place)

    def clicked(self, row: int, column: int, *, again: bool) -> None:
        """Open or close a branch: a click on its arrow, or a double click."""
        item = self._rows[self._lines[row][0]]
        arrow = 2 * item.depth + (0 if self.room < _NARROW else tree.GUTTER)
        if item.role in _BRANCHES and (again or arrow <= column <= arrow + 1):
            self.action_toggle_branch()

    def action_toggle_branch(self) -> None:
        """Open or close the branch under the cursor."""
        if self.selected_place is not None and self._is_branch(self.selected_place):
            self._set(self.selected_place, open_=self._paths[self.selected_place] in self._shut)

    def action_open(self, open_: bool) -> None:
        """Open the branch under the cursor; or close it, or go to the branch that contains it."""
        if self.selected_place is None:
            return
        branch = self._is_branch(self.selected_place)
        if branch and (self._paths[self.selected_place] in self._shut) == open_:
            self._set(self.selected_place, open_=open_)
        elif not open_ and (above := self._above[self.selected_place]):
            self._lay_out(above[-1])
        elif open_ and branch:
            self.action_move(1)

    def action_all(self, open_: bool) -> None:
        """Open or close every branch."""
        self._shut = (
            set() if open_ else {self._paths[row] for row in range(len(self._rows)) if self._is_branch(row)}
        )
        above = self._above[self.selected_place] if self.selected_place is not None and not open_ else []
        self._lay_out(above[0] if above else self.selected_place)

    def _set(self, row: int, *, open_: bool) -> None:
        (self._shut.discard if open_ else self._shut.add)(self._paths[row])
        self._lay_out(row)

    def _is_branch(self, row: int) -> bool:
        # One of many equal layers (an SBN subscription) has no fields below it.
        return self._rows[row].role in _BRANCHES and not self._rows[row].value

    def _lay_out(self, place_now: int | None, *, centre: bool = False) -> None:
        width = self.room
        self._cut = tree.GUTTER if width < _NARROW else 0
        lines: list[tuple[int, str]] = []
        hidden: int | None = None
        for place, row in enumerate(self._rows):
            if hidden is not None and row.depth > hidden:
                continue
            closed = self._is_branch(place) and self._paths[place] in self._shut
            hidden = row.depth if closed else None
            lines += [(place, line) for line in _drawn(row, width, self._cut, closed=closed)]
        self._lines, self._strips = lines, {}
        self.recount()
        at = next((line for line, (place, _) in enumerate(lines) if place == place_now), None)
        self.go(0 if at is None else at, centre=centre)
        self.post_message(self.Moved(self))


def _name(row: TreeRow, place: int) -> str:
    # The rows of the packet itself contain its number.
    return str(place) if row.role == "packet" else row.label


def _branches_above(rows: Sequence[TreeRow]) -> list[list[int]]:
    """Return for every row the branches that contain it, outermost first."""
    branches: list[list[int]] = []
    open_: list[int] = []
    for place, row in enumerate(rows):
        while open_ and (rows[open_[-1]].depth >= row.depth or row.role not in _INSIDE):
            open_.pop()
        branches.append(list(open_))
        if row.role in _BRANCHES:
            open_.append(place)
    return branches


def _drawn(row: TreeRow, width: int, cut: int, *, closed: bool) -> list[str]:
    """Return the lines of a row; ``cut``: columns of the byte ranges, which the caller removes."""
    if cut and row.role not in _BRANCHES:
        return _narrow(row, width)
    return tree.row_lines(row, max(_LEAST, width + cut), _PAINT, closed=closed)


def _narrow(row: TreeRow, width: int) -> list[str]:
    """Return a row for narrow terminals: the value directly after the name, further lines below."""
    indent = " " * (2 * row.depth)
    if row.role == "packet":
        # The title shows the rest; this row has the time, source and destination.
        return [clip(row.value.partition("  ")[0] if row.label else row.value.rpartition("  ")[2], width)]
    field = row.role == "field"
    label = f"{row.label}{':' if field else ' '} "
    first, *rest = wrap(f"{label}{row.value}", max(8, width - len(indent)))
    label_end = min(len(label), len(first))
    head = indent + _PAINT(first[:label_end], palette.DIM if field else row.style) + first[label_end:]
    more = wrap(" ".join(rest), max(8, width - len(indent) - 2)) if rest else []
    return [head, *(f"{indent}  {line}" for line in more)][: _MOST_LINES if field else None]
