"""Values over time, beside plain loops."""

import numpy as np
import pytest

from edoras_tools.addons.plot import series as lines
from edoras_tools.addons.plot.series import Values, numbers
from edoras_tools.io.formats.columns import TableColumn
from edoras_tools.ros.cdr.columns import Ragged

RAGGED = Ragged(np.array([1, 2, 3, 4, 5]), np.array([0, 2, 2, 5]))


@pytest.mark.parametrize(
    ("values", "there", "index", "found"),
    [
        (np.array([7, 8, 9]), None, None, {None: [(0, 7), (1, 8), (2, 9)]}),
        (np.array([7, 8, 9]), [True, False, True], None, {None: [(0, 7), (2, 9)]}),
        (np.array([[1, 2], [3, 4]]), None, None, {0: [(0, 1), (1, 3)], 1: [(0, 2), (1, 4)]}),
        (np.array([[1, 2], [3, 4]]), None, 1, {1: [(0, 2), (1, 4)]}),
        (RAGGED, None, None, {0: [(0, 1), (2, 3)], 1: [(0, 2), (2, 4)], 2: [(2, 5)]}),
        (RAGGED, None, 1, {1: [(0, 2), (2, 4)]}),
        (RAGGED, None, 9, {9: []}),
    ],
)
def test_numbers_of_columns_and_lists(values, there, index, found):
    column = TableColumn("x", values, None if there is None else np.array(there))
    read = {
        place: list(zip(rows.tolist(), items.tolist(), strict=True))
        for place, rows, items in numbers(column, index)
    }
    assert read == found


def test_values_come_in_the_order_of_time_and_nan_is_counted():
    made = Values()
    made.add(np.array([3.0, 1.0]), np.array([30.0, np.nan]))
    made.add(np.array([2.0, 0.5]), np.array([True, False]))
    line = made.line(1)
    assert (line.seconds.tolist(), line.values.tolist()) == ([0.5, 2.0, 3.0], [0.0, 1.0, 30.0])
    assert (line.read, line.not_finite, line.recording) == (3, 1, 1)


def test_long_lines_are_held_in_bounded_memory_and_keep_their_peaks(monkeypatch):
    monkeypatch.setattr(lines, "_MOST", 1000)
    monkeypatch.setattr(lines, "_COLUMNS", 50)
    made = Values()
    for start in range(0, 20_000, 500):
        values = np.zeros(500)
        values[77] = start
        made.add(np.arange(start, start + 500) / 100, values)
        assert made._count <= 1000
    line = made.line(0)
    assert line.read == 20_000
    assert line.values.max() == 19_500
