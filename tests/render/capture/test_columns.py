"""Rows of text in columns, as they come."""

from edoras_tools.render.capture.packet_list import ColumnLines
from edoras_tools.render.terminal.text import cells


def test_columns_grow_when_a_later_block_needs_it():
    table = ColumnLines(["number", "link"], [True, False])
    assert list(table.lines([["1", "22"], ["ci", "sbn"]])) == [
        "number  link",
        "     1  ci",
        "    22  sbn",
    ]
    assert list(table.lines([["12345678"], ["to"]])) == ["12345678  to"]
    assert list(table.lines([["1"], ["to"]])) == ["       1  to"]


def test_wide_characters_are_counted_in_cells():
    lines = list(ColumnLines(["a", "b"], [False, False]).lines([["日本", "x"], ["1", "2"]]))
    assert [cells(line) for line in lines] == [7, 7, 7]


def test_lines_fit_the_terminal():
    lines = list(ColumnLines(["text"], [False], width=10).lines([["x" * 50]]))
    assert lines == ["text", "x" * 9 + "…"]


def test_no_rows_still_have_a_head():
    assert list(ColumnLines(["a"], [False]).lines([[]])) == ["a"]
