"""The packet list, over columns: a packet is dissected when its line comes into sight."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar, Final

from rich.segment import Segment
from rich.style import Style
from rich.text import Text
from textual.cache import LRUCache
from textual.strip import Strip

from edoras_tools.decode import Dissector
from edoras_tools.model import NO_FINDINGS, Finding
from edoras_tools.render.packet_list import PacketList, TimeFormat
from edoras_tools.render.severity import EXPLANATIONS, NOTABLE, Severity
from edoras_tools.tui.lines import Lines, strip_of
from edoras_tools.wire.names import MSG_ID_NAMES

if TYPE_CHECKING:
    from edoras_tools.decode.context import Context
    from edoras_tools.tui.store import Store

_GUTTER: Final = 2
"""Cells at the left, for marks."""
_KEPT: Final = 4096
"""Lines that need not be drawn again."""
_ERRORS: Final = Finding(sum(item for item, told in EXPLANATIONS.items() if told.severity == Severity.ERROR))


class Packets(Lines):
    """One line a packet.

    Args:
        store: the packets.
        context: what they were decoded with.
        time_format: how to tell time.
        verbose: show notes too, not only warnings and errors.

    Attributes:
        marks: numbers of the packets that are marked.
        follow: stay at the end as packets come: from when the user goes to the end until he leaves it.
        empty: what is said where there is no packet.
        drawn: lines that need not be drawn again, by packet number.
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
        self.follow = False
        self.empty = ""
        self._store = store
        self._dissector = Dissector(context, detail=False)
        self._time_format = time_format
        self._verbose = verbose
        self._view = self._make_view(80)
        self.drawn: LRUCache[tuple[int, int], Strip] = LRUCache(_KEPT)

    @property
    def time_format(self) -> TimeFormat:
        """How time is told."""
        return self._time_format

    @time_format.setter
    def time_format(self, value: TimeFormat) -> None:
        self._time_format = value
        self.forget()

    def forget(self) -> None:
        """Draw every line anew: another filter, or another way to tell time."""
        self._view = self._make_view(self.room)
        self.drawn.clear()
        self.refresh()
        self.refresh_heads()

    def arrived(self, gone: int) -> None:
        """Take note of packets that came, and of so many rows at the top that had to go."""
        if gone:
            self.set_reactive(Packets.cursor, max(0, self.cursor - gone))
            self.set_scroll(None, max(0, self.scroll_y - gone))
        self.recount()
        if self.follow:
            self.go(-1)

    def touched(self) -> None:
        """Follow from the end, and stop following elsewhere."""
        last = self.rows() - 1
        self.follow = self.cursor >= last and round(self.scroll_y) + self.page >= last

    def render_line(self, y: int) -> Strip:
        """Draw a line, or say why there are none."""
        if self.rows() or y != 1:
            return super().render_line(y)
        line = strip_of(Text(f"{' ' * _GUTTER}{self.empty}", "dim"), self.app.console)
        return line.adjust_cell_length(self.room).apply_style(self.get_component_rich_style("lines--plain"))

    def header(self) -> Text:
        """Return the names of the columns."""
        return Text.assemble(" " * _GUTTER, Text.from_ansi(self._view.header()))

    def rows(self) -> int:
        """Return how many packets the filter lets pass."""
        return len(self._store)

    def draw(self, row: int, width: int) -> Strip:
        """Return a packet's line; it is laid out for the list's width already."""
        del width
        block, index = self._store.locate(row)
        number = int(block.batch.number[index])
        key = number, row if self._time_format is TimeFormat.DELTA else 0
        line = self.drawn.get(key)
        if line is None:
            decoded = self._dissector.dissect(block.batch[index])
            previous = self._store.time_ns(row - 1) if row else int(block.batch.time_ns[index])
            line = strip_of(self._view.line(decoded, previous), self.app.console)
            self.drawn[key] = line
        marked = number in self.marks
        style = self.get_component_rich_style("packets--mark", partial=True) if marked else Style.null()
        return Strip([Segment("◆ " if marked else "  ", style), *line], _GUTTER + line.cell_length)

    def tint(self, row: int) -> str:
        """Return what lies under a line: the cursor, a mark, an error or a warning."""
        if row >= self.rows() or row == self.cursor:
            return super().tint(row)
        block, index = self._store.locate(row)
        if int(block.batch.number[index]) in self.marks:
            return "packets--marked"
        findings = Finding(int(block.columns.findings[index])) & NOTABLE
        if findings == NO_FINDINGS:
            return ""
        return "packets--error" if findings & _ERRORS else "packets--warning"

    def on_resize(self) -> None:
        """Lay the columns out for another width; the cursor stays in sight."""
        self.forget()
        self.go(self.cursor)

    def _make_view(self, width: int) -> PacketList:
        return PacketList(
            width - _GUTTER,
            colour=True,
            time_format=self._time_format,
            names=MSG_ID_NAMES,
            verbose=self._verbose,
            begin_ns=self._store.begin_ns,
        )
