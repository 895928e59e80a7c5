"""Files are one run or several, whatever command reads them."""

import pytest
from msgspec.structs import replace
from places import MISSIONS, ROOT
from rewriting import datagrams, write

from edoras_tools.pipelines.capture.info import inspect
from edoras_tools.pipelines.clocks import open_aligned
from edoras_tools.pipelines.doctor.doctor import examine
from edoras_tools.pipelines.workbench import Settings, open_files

SECOND = 10**9
SETTINGS = Settings([MISSIONS / "rover_ground.yaml"])
ROVER = [replace(item, identification=0) for item in datagrams(ROOT / "samples/captures/a_rover.pcap")[:400]]
"""What Linux sends from sockets that are not connected: no identification tells two packets apart."""
LATER = [item.at(3600 * SECOND) for item in ROVER]


def halves(items, at):
    middle = items[0].time_ns + int(at * SECOND)
    return [[item for item in items if (item.time_ns < middle) == first] for first in (True, False)]


def counted(paths, jobs=1):
    source = open_files(paths)
    report = inspect(source, SETTINGS.workbench(source.info), jobs=jobs)
    return {row["topic"] or row["msg_id"]: row for row in report.summary()["routes"]}, report.notes


def judged(paths):
    source, notes = open_aligned(paths, SETTINGS)
    bench = SETTINGS.workbench(source.info)
    diagnosis = examine(source, bench).diagnosis
    return (diagnosis.lost, diagnosis.unaccounted, diagnosis.datagrams), [
        *notes,
        *bench.columns.context.notes,
    ]


@pytest.fixture(scope="module")
def one(tmp_path_factory):
    path = write(tmp_path_factory.mktemp("one") / "one.pcap", ROVER)
    return path, counted([path])[0], judged([path])[0]


@pytest.mark.quick("-1")
@pytest.mark.parametrize("order", [1, -1])
def test_two_boots_that_do_not_overlap_are_two_runs(tmp_path, one, order):
    path, rows, totals = one
    paths = [path, write(tmp_path / "later.pcap", LATER)][::order]
    twice, notes = judged(paths)
    assert twice == tuple(2 * count for count in totals)
    assert [note[:7] for note in notes] == ["2 runs:"]
    both, notes = counted(paths)
    assert [note[:7] for note in notes] == ["2 runs:"]
    for name, row in rows.items():
        assert both[name]["count"] == 2 * row["count"]
        for figure in ("rate_hz", "jitter_ms"):
            assert both[name][figure] == pytest.approx(row[figure], rel=0.01, abs=0.001)
        assert both[name]["gaps"] == 2 * row["gaps"]


def test_a_run_that_is_captured_late_has_no_gap_to_the_one_before(tmp_path, one):
    path, rows, _ = one
    late = halves(LATER, 8)[1]
    both, _ = counted([path, write(tmp_path / "late.pcap", late)])
    assert both["/telemetry_pose"]["gaps"] == rows["/telemetry_pose"]["gaps"] == 0


@pytest.mark.quick("6-4")
@pytest.mark.parametrize(("seconds", "away"), [(8, 0), (6, 4)])
def test_parts_of_one_recording_are_one_run(tmp_path, one, seconds, away):
    """Also where nothing was captured for a time: it is the same boot."""
    first, second = halves(ROVER, seconds)
    second = [item for item in second if item.time_ns >= ROVER[0].time_ns + (seconds + away) * SECOND]
    whole = write(tmp_path / "whole.pcap", [*first, *second])
    paths = [write(tmp_path / f"{place}.pcap", part) for place, part in enumerate((first, second))]
    assert counted(paths) == counted([whole])
    assert judged(paths) == judged([whole])


@pytest.mark.quick("telemetry")
@pytest.mark.parametrize(
    "keep",
    [lambda item: item.destination[1] == 1234, lambda item: item.destination[1] == 1235],
    ids=["commands", "telemetry"],
)
def test_what_is_sent_twice_is_not_one_capture_by_two_clocks(tmp_path, keep):
    parts = [[item for item in items if keep(item)] for items in (ROVER, LATER)]
    paths = [write(tmp_path / f"{place}.pcap", part) for place, part in enumerate(parts)]
    (_, _, count), notes = judged(paths)
    assert count == sum(map(len, parts))
    assert not any("its clock" in note for note in notes)


def test_identifications_show_that_it_is_one_capture_by_two_clocks(tmp_path, one):
    items = [replace(item, identification=1 + place) for place, item in enumerate(ROVER)]
    paths = [write(tmp_path / f"{at}.pcap", [item.at(at * SECOND) for item in items]) for at in (0, 3600)]
    (_, _, count), (note,) = judged(paths)
    assert count == one[2][2]
    assert "ahead of that of" in note
    assert "3600.000 s" in note


def test_another_process_that_reads_tells_the_runs_too(tmp_path, one, monkeypatch):
    paths = [one[0], write(tmp_path / "later.pcap", LATER)]
    monkeypatch.setattr("edoras_tools.pipelines.ahead.jobs_for", lambda *_: 2)
    assert counted(paths, jobs=2) == counted(paths)
