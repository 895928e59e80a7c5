"""JSON Lines as Python's own reader reads them."""

import json

from tables import COLUMNS, VALUES, written

from edoras_tools.io.formats.jsonl.writer import JsonLinesWriter


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
