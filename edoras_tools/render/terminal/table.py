"""A table that leaves columns out on narrow terminals, the least important first."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, Literal

import msgspec
from rich.table import Table
from rich.text import Text

from edoras_tools import words
from edoras_tools.render.terminal import palette
from edoras_tools.render.terminal.text import clean, clip_middle

_LEAST_NAME: Final = 16
"""Least width of the elastic column, if its content is that wide."""


class Column(msgspec.Struct, frozen=True):
    """One column.

    Attributes:
        title: title of the column.
        cell: function from a row to the text in the column.
        rank: 0 is always shown, 1 if there is room, 2 and up in this order after the elastic one has its
            width.
        justify: alignment.
        elastic: whether it is the one column that may be cut, in the middle.
    """

    title: str
    cell: Callable[[Any], Text]
    rank: int = 0
    justify: Literal["left", "right"] = "right"
    elastic: bool = False


def build(
    columns: Sequence[Column], rows: Sequence[Any], width: int, *, apart: Callable[[Any], Any] | None = None
) -> Table:
    """Return the rows as a table of at most ``width`` cells, as long as the columns of rank 0 fit.

    Args:
        columns: in the order shown; exactly one is elastic, of rank 0.
        rows: rows, as the columns' ``cell`` functions accept them.
        apart: function of a row; a blank line separates rows with different results.
    """
    gap = 2 if width >= 100 else 1
    cells = {column.title: [column.cell(row) for row in rows] for column in columns}
    need = {title: max([len(title), *(text.cell_len for text in texts)]) for title, texts in cells.items()}
    elastic = next(column for column in columns if column.elastic)
    visible, room = _fitting(columns, elastic, need, width, gap)
    table = Table(box=None, padding=(0, gap, 0, 0), pad_edge=False, header_style=palette.STRONG)
    for column in visible:
        table.add_column(column.title, justify=column.justify, no_wrap=True, overflow="ellipsis")
    groups = [apart(row) if apart else None for row in rows]
    for index, group in enumerate(groups):
        if index and group != groups[index - 1]:
            table.add_row()
        texts = [(column, cells[column.title][index]) for column in visible]
        table.add_row(*(_shorten(text, room) if column is elastic else text for column, text in texts))
    return table


def facts_grid() -> Table:
    """Return an empty table of facts: a name and a value in each row."""
    table = Table.grid(padding=(0, 2, 0, 0))
    table.add_column(style=palette.DIM, no_wrap=True)
    table.add_column(overflow="fold")
    return table


def plain(value: object, style: str = "") -> Text:
    """Return a value as clean text, never as markup."""
    return Text(clean(str(value)), style)


def one_line(text: Text) -> Text:
    """Return a text that is cut at the terminal's width, not wrapped."""
    text.no_wrap, text.overflow = True, "ellipsis"
    return text


def figure(name: str, style: str = "") -> Callable[[Mapping[str, Any]], Text]:
    """Return the cells of a column that counts; see ``count_cell``."""
    return lambda row: count_cell(row[name], style)


def count_cell(value: int | None, style: str = "") -> Text:
    """Return ``1,827``; 0 is dim, anything else in ``style``."""
    return Text(words.count(value), style if value else palette.DIM)


def _fitting(
    columns: Sequence[Column], elastic: Column, need: Mapping[str, int], width: int, gap: int
) -> tuple[list[Column], int]:
    """Return the columns that fit, and the cells of the elastic one.

    Args:
        elastic: one of the columns.
        need: cells that each column needs, by title.
        width: cells of all columns.
        gap: cells between two columns.
    """
    titles = {column.title for column in columns if column.rank == 0}
    room = min(need[elastic.title], _LEAST_NAME)
    fixed = sum(need[title] for title in titles if title != elastic.title)
    free = width - room - fixed - gap * (len(titles) - 1)
    for column in sorted((column for column in columns if column.rank), key=lambda item: item.rank):
        # The elastic column gets its full width before columns of rank 2 are shown.
        reserved = need[elastic.title] - room if column.rank > 1 else 0
        if need[column.title] + gap <= free - reserved:
            titles.add(column.title)
            free -= need[column.title] + gap
    room += max(0, min(free, need[elastic.title] - room))
    return [column for column in columns if column.title in titles], room


def _shorten(text: Text, room: int) -> Text:
    return Text(clip_middle(text.plain, room), text.style)
