"""A table's file: under its name when it is whole, and not before."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from tables import COLUMNS, HEAD, VALUES, written

from edoras_tools.errors import CaptureError
from edoras_tools.io.formats.columns import CsvWriter, JsonLinesWriter, TableFile, value_texts


def test_it_appears_when_it_is_whole(tmp_path):
    path = tmp_path / "a.csv"
    table = TableFile(path, CsvWriter, HEAD, COLUMNS)
    table.write(CsvWriter.piece(COLUMNS), 3)
    assert list(tmp_path.iterdir()) == []  # who is killed now leaves nothing
    table.complete()
    table.keep()
    assert [item.name for item in tmp_path.iterdir()] == ["a.csv"]
    assert table.rows == 3


class Full:
    """A writer whose disk fills with the second block."""

    def __init__(self, file, _head, _columns):
        self.file = file

    def write(self, _):
        if self.file.tell():
            raise OSError(28, "No space left on device")
        self.file.write(b"x")

    def close(self):
        """Nothing is left."""


def test_what_cannot_be_written_is_removed_and_what_was_there_stays(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("before")
    table = TableFile(path, Full, HEAD, COLUMNS)
    table.write(COLUMNS, 3)
    with pytest.raises(CaptureError, match=r"a\.csv: cannot be written: No space left on device"):
        table.write(COLUMNS, 3)
    assert [(item.name, item.read_text()) for item in tmp_path.iterdir()] == [("a.csv", "before")]


def test_a_folder_that_is_not_there(tmp_path):
    with pytest.raises(CaptureError, match="cannot be written: No such file"):
        written(tmp_path / "no/a.csv", CsvWriter, COLUMNS)


def test_what_is_no_file_is_written_at_once():
    table = TableFile(Path("/dev/null"), CsvWriter, HEAD, COLUMNS)
    table.write(CsvWriter.piece(COLUMNS), 3)
    table.complete()
    table.keep()


@pytest.mark.parametrize("column", COLUMNS, ids=lambda column: column.name)
def test_lists_lie_one_after_the_other(column):
    values, offsets = column.spread()
    assert len(values) == (len(column) if offsets is None else offsets[-1])
    assert offsets is None or (np.diff(offsets) >= 0).all()


def test_every_kind_of_column(tmp_path):
    written(tmp_path / "a.jsonl", JsonLinesWriter, COLUMNS, COLUMNS)
    rows = [json.loads(line) for line in (tmp_path / "a.jsonl").read_text(encoding="utf-8").splitlines()]
    assert rows[:3] == rows[3:]
    assert list(rows[0]) == [column.name for column in COLUMNS]
    found = {name: [row[name] for row in rows[:3]] for name in rows[0]}
    assert found["time"][1] == "2026-11-21T06:13:20.123456789Z"
    assert found["single"] == [0.1, "Infinity", "NaN"]
    assert found["double"] == [0.1, 1e300, "-Infinity"]
    for name in VALUES.keys() - {"double"}:
        assert found[name] == VALUES[name]


@pytest.mark.parametrize(("kind", "values"), [("u1", range(256)), ("i1", range(-128, 128))])
def test_every_number_of_one_byte(kind, values):
    assert value_texts(np.array(values, kind)) == [str(value) for value in values]


def test_every_kind_of_column_as_csv(tmp_path):
    written(tmp_path / "a.csv", CsvWriter, COLUMNS, COLUMNS)
    with (tmp_path / "a.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert rows[:3] == rows[3:]
    found = {name: [row[name] for row in rows[:3]] for name in rows[0]}
    assert found["time"][1] == "2026-11-21T06:13:20.123456789Z"
    assert found["single"] == ["0.1", "inf", "nan"]
    assert found["double"] == ["0.1", "1e+300", "-inf"]
    assert found["a.b"] == ["1", "", "3"]
    assert found["text"] == VALUES["text"]
    for name in ("ns", "whole", "yes", "fixed", "list", "words"):
        assert [json.loads(text) for text in found[name]] == VALUES[name]
