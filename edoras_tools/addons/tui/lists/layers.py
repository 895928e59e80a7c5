"""The layers and fields of the selected packet, as a tree whose branches open and close."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar, Final

from rich.text import Text
from textual.binding import Binding

from edoras_tools.addons.tui.lists.lines import Lines, strip_of
from edoras_tools.render.capture import tree
from edoras_tools.render.terminal import palette
from edoras_tools.render.terminal.text import clip, wrap

if TYPE_CHECKING:
    from collections.abc import Sequence

    from textual.strip import Strip

    from edoras_tools.model import Decoded
    from edoras_tools.render.capture.tree import TreeRow

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
