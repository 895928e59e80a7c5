"""JSON Lines as Python's own reader reads them."""

from __future__ import annotations

import csv
import json

import numpy as np
import pytest
from tables import COLUMNS, VALUES, written

from edoras_tools.io.formats.text import CsvWriter, JsonLinesWriter, value_texts


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
