"""Rows of text in columns, as they come."""

from __future__ import annotations

from typing import TYPE_CHECKING

from edoras_tools.render.terminal import palette
from edoras_tools.render.terminal.text import cells, clip

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence


class ColumnLines:
    """Prints blocks of rows under one line of heads; a column grows when a later block needs it.

    Args:
        heads: titles of the columns.
        right: which columns are right-aligned.
        width: cells that no line exceeds; 0 for any.
        colour: whether to use ANSI styles.
    """

    def __init__(
        self, heads: Sequence[str], right: Sequence[bool], *, width: int = 0, colour: bool = False
    ) -> None:
        self._heads = heads
        self._right = right
        self._width = width
        self._paint = palette.Paint(colour)
        self._sizes: list[int] = []

    def lines(self, block: Sequence[Sequence[str]]) -> Iterator[str]:
        """Yield the lines of a block, the heads before the first.

        Args:
            block: a list of clean texts for every column.
        """
        needed = [max(map(cells, column), default=0) for column in block]
        first = not self._sizes
        before = self._sizes or [cells(head) for head in self._heads]
        self._sizes = [max(pair) for pair in zip(before, needed, strict=True)]
        if first:
            yield self._paint(self._line(self._heads), palette.STRONG)
        for row in zip(*block, strict=True):
            yield self._line(row)

    def _line(self, row: Sequence[str]) -> str:
        parts = []
        for text, size, right in zip(row, self._sizes, self._right, strict=True):
            space = " " * (size - cells(text))
            parts.append(space + text if right else text + space)
        line = "  ".join(parts).rstrip()
        return clip(line, self._width) if self._width else line
