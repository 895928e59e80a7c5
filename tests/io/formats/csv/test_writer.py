"""CSV as Python's own reader reads it."""

import csv
import json

from tables import COLUMNS, VALUES, written

from edoras_tools.io.formats.csv.writer import CsvWriter


def test_every_kind_of_column(tmp_path):
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
