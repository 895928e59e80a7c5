"""A plot in terminal cells."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from edoras_tools.render.plot.figure import Figure, Panel, PlotLine
from edoras_tools.render.plot.terminal import plot_lines


def plotted(lines):
    return [text.plain for text in lines]


@pytest.mark.parametrize("width", [40, 80, 120])
@pytest.mark.parametrize("colour", [True, False])
def test_it_fits_and_names_what_it_shows(figure, width, colour):
    lines = plot_lines(figure, width, colour=colour)
    assert all(line.cell_len <= width for line in lines)
    text = " ".join(plotted(lines))
    assert "\x1b" not in text
    for words in (
        "/cmd_vel.linear.*",
        "rates",
        "messages/s",
        "3 events, 2 drawn",
        "✗",
        "seconds since",
        "a note",
    ):
        assert words in text
    assert "in each of" in text


def test_without_colour_each_line_has_its_own_panel(figure):
    dotted = [
        sum(
            any(0x2800 < ord(char) <= 0x28FF for char in line)
            for line in plotted(plot_lines(figure, 80, colour=colour))
        )
        for colour in (True, False)
    ]
    assert dotted[1] > dotted[0]


def test_a_straight_line_is_drawn_dot_by_dot():
    line = PlotLine("x", 0, np.array([0.0, 1.0]), np.array([0.0, 1.0]), 2)
    lines = plotted(plot_lines(Figure(["a"], [Panel("x", [line])], (0, 1)), 60, colour=True))
    rows = [text.partition("┤")[2] or text.partition("│")[2] for text in lines if "┤" in text or "│" in text]
    columns = [{place for place, char in enumerate(row) if 0x2800 < ord(char) <= 0x28FF} for row in rows]
    assert set().union(*columns) == set(range(max(map(max, filter(None, columns))) + 1)), "no gap"
    drawn = [min(row) for row in columns if row]
    assert drawn == sorted(drawn, reverse=True), "it rises"


@given(arrays(np.float64, st.integers(0, 50), elements=st.floats(-1e300, 1e300)))
def test_any_values_can_be_drawn(values):
    line = PlotLine("x", 0, np.linspace(0, 1, len(values)), values, len(values))
    assert plot_lines(Figure(["a"], [Panel("x", [line])], (0, 1)), 60, colour=True)
