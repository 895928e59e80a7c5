"""The rates of the packets that the list shows, as a graph."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from rich.text import Text

from edoras_tools.addons.tui.lists.lines import Lines, strip_of
from edoras_tools.render.plot.terminal import plot_lines

if TYPE_CHECKING:
    from textual.strip import Strip

    from edoras_tools.render.plot.figure import Figure

_AROUND: Final = 6
"""Lines of a graph besides its field: heading, legend, axis."""


class RateGraph(Lines):
    """A graph that fills its pane; nothing in it is selected.

    Attributes:
        empty: shown while there is no graph.
    """

    def __init__(self) -> None:
        super().__init__(id="rates")
        self.empty = "no packet"
        self._figure: Figure | None = None
        self._lines: list[Text] = []

    def show(self, figure: Figure | None) -> None:
        """Show a graph."""
        self._figure = figure
        self._lay_out()

    def rows(self) -> int:
        """Return how many lines there are."""
        return len(self._lines)

    def draw(self, row: int, width: int) -> Strip:
        """Return a line."""
        return strip_of(self._lines[row], self.app.console).crop(0, width)

    def row_style(self, row: int) -> str:
        """Return no style: no line is selected."""
        del row
        return ""

    def on_resize(self) -> None:
        """Draw it in another size."""
        self._lay_out()

    def _lay_out(self) -> None:
        if self._figure is None:
            self._lines = [Text(f"  {self.empty}", "dim")]
        else:
            rows = max(3, self.page - _AROUND)
            self._lines = plot_lines(self._figure, self.room, colour=True, rows=rows)
        self.recount()
