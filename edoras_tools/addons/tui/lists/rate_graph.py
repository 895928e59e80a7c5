"""What is drawn below the list: the rates of the packets that it shows, or the way of one of them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from rich.text import Text

from edoras_tools.addons.tui.lists.lines import Lines, strip_of
from edoras_tools.render.plot.terminal import plot_lines

if TYPE_CHECKING:
    from collections.abc import Callable

    from textual.strip import Strip

    from edoras_tools.render.plot.figure import Figure

_AROUND: Final = 6
"""Lines of a graph besides its field: heading, legend, axis."""


class Drawing(Lines):
    """A drawing that fills its pane; nothing in it is selected.

    Attributes:
        empty: shown while there is no drawing.
    """

    def __init__(self, name: str) -> None:
        super().__init__(id=name)
        self.empty = "no packet"
        self._draw: Callable[[int], list[Text]] | None = None
        self._lines: list[Text] = []

    def show(self, draw: Callable[[int], list[Text]] | None) -> None:
        """Show a drawing, which is made for a width."""
        self._draw = draw
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
        self._lines = self._draw(self.room) if self._draw else [Text(f"  {self.empty}", "dim")]
        self.recount()


class RateGraph(Drawing):
    """A graph of rates, as high as its pane."""

    _figure: Figure | None = None

    def plot(self, figure: Figure | None) -> None:
        """Show a graph."""
        self._figure = figure
        self.show(self._plotted if figure else None)

    def _plotted(self, width: int) -> list[Text]:
        assert self._figure is not None
        return plot_lines(self._figure, width, colour=True, rows=max(3, self.page - _AROUND))
