"""Verdicts and losses as tables say what the doctor says."""

import json

import pytest
from places import CAPTURES, MISSIONS

import edoras_tools
from edoras_tools.diagnosis.examination import Examination
from edoras_tools.pipelines.doctor import examine, list_missing
from edoras_tools.pipelines.export.sources import JUDGED, open_topics
from edoras_tools.pipelines.workbench import Settings, open_files

PATHS = [CAPTURES / "f_sbn_disconnect.pcap"]
SETTINGS = Settings([MISSIONS / f"two_rovers_{side}.yaml" for side in ("ground", "flight")])


@pytest.fixture(scope="module")
def tables():
    return edoras_tools.read(PATHS, settings=SETTINGS)


@pytest.fixture(scope="module")
def diagnosis():
    source = open_files(PATHS)
    bench = SETTINGS.workbench(source.info)
    examination = Examination(bench.columns.context)
    examination.listing = True
    return examine(source, bench, examination=examination).diagnosis


def rows_of(table):
    columns = {item.name: item for item in table.columns}
    for row in range(len(table)):
        yield {
            name: None if item.present is not None and not item.present[row] else item.values[row]
            for name, item in columns.items()
        }


def test_verdicts(tables, diagnosis):
    rows = list(rows_of(tables.verdicts))
    assert len(rows) == len(diagnosis.verdicts) > 0
    for row, verdict in zip(rows, diagnosis.verdicts, strict=True):
        told = verdict.as_json()
        assert int(row.pop("time").astype("i8")) == told.pop("start_ns")
        assert row.pop("evidence").tolist() == list(told.pop("evidence"))
        assert row == told


def test_lost(tables, diagnosis):
    source = open_files(PATHS)
    found = list_missing(diagnosis, source, SETTINGS.workbench(source.info))
    rows = list(rows_of(tables.lost))
    assert len(rows) == len(found) > 0
    for row, item in zip(rows, found, strict=True):
        told = item.as_json()
        assert int(row.pop("time").astype("i8")) == told.pop("time_ns")
        message = row.pop("message")
        assert (message and json.loads(message)) == told.pop("message")
        assert row == told


def test_they_are_there_for_captures_that_can_be_read_again(tmp_path):
    source = open_topics(PATHS, SETTINGS)
    source.close()
    assert set(source.topics) >= JUDGED
    assert len(source.empty("/edoras/lost")) == 0


def test_no_doctor_is_asked_where_nobody_names_it(tables, monkeypatch):
    monkeypatch.setattr("edoras_tools.pipelines.export.sources.examine", None)
    with pytest.warns(UserWarning, match="3 messages are incomplete"):
        topics = tables.topics
    assert topics["/edoras/events"] == 79
    assert not set(topics) & JUDGED
