"""The loop that reads: what it hands on, and what ends it."""

from __future__ import annotations

import itertools
import os
import signal

import numpy as np
import pytest
from msgspec.structs import replace
from places import MISSIONS, ROOT
from rewriting import datagrams, write
from waiting import until

from edoras_tools.errors import CaptureError, ConfigError, InterruptError
from edoras_tools.pipelines.capture.info import inspect
from edoras_tools.pipelines.clocks import open_aligned
from edoras_tools.pipelines.doctor import examine
from edoras_tools.pipelines.reading import Limits, reading
from edoras_tools.pipelines.selection import Period, Selection
from edoras_tools.pipelines.workbench import Settings, open_files


def counts(source, bench, *options, **keywords):
    with reading(source, bench, *options, **keywords) as loop:
        return [len(rows) for rows in loop], loop


def test_chosen_rows_of_every_batch_also_of_empty_ones(bench, batches, made_up):
    given = [batches[0], batches[0].take(slice(0, 0)), batches[1]]
    source = made_up(given)
    with reading(source, bench, Selection(msg_ids=(0x1880,))) as loop:
        for batch, rows in zip(given, loop, strict=True):
            own, columns = rows.alone()
            assert rows.batch is batch
            assert len(rows) == len(own) == len(columns) == (rows.columns.msg_id == 0x1880).sum()
            assert rows.begin_ns == int(batches[0].time_ns[0])
    assert source.closed
    assert (loop.failure, loop.interrupted) == (None, False)


@pytest.mark.parametrize(("count", "taken"), [(0, [100, 100]), (1, [1]), (100, [100]), (101, [100, 1])])
def test_count(count, taken, bench, batches, made_up):
    assert counts(made_up(batches[:2]), bench, None, Limits(count))[0] == taken


def test_duration(bench, batches, made_up):
    times = itertools.count()
    limits = Limits(duration_ns=3, clock=lambda: next(times))
    assert counts(made_up(itertools.repeat(batches[0])), bench, None, limits)[0] == [100] * 3


def test_a_duration_of_a_live_source_ends_after_what_has_arrived(bench, batches, made_up):
    """A consumer that is too slow is behind when the time is over: it gets the rest."""

    class Live(made_up):
        live, stops = True, 0

        def stop(self):
            self.stops += 1

        def batches(self):
            yield from batches[:5]
            assert self.stops  # else it would go on without end

    times = itertools.count()
    source = Live([])
    limits = Limits(duration_ns=2, clock=lambda: next(times))
    assert counts(source, bench, None, limits)[0] == [len(item) for item in batches[:5]]
    assert source.closed


def test_what_is_not_read_is_not_decoded_either(bench, batches, made_up):
    times = batches[0].time_ns
    with reading(made_up(batches[:1]), bench, examined=Period(0, int(times[7] - times[0]))) as loop:
        (rows,) = loop
    assert len(rows) == len(rows.batch) == len(rows.columns) == 7
    assert (loop.begin_ns, loop.last_ns, loop.outside) == (times[0], times.max(), 93)


@pytest.mark.parametrize("period", [Period(), Period(20), Period(0, 20), Period(10, 20)])
def test_a_period_holds_one_time_as_it_holds_many(period):
    times = [-5, 0, 9, 10, 19, 20]
    after, before = period.start_ns or -10, period.end_ns or 100
    expected = [after <= time < before for time in times]
    assert period.holds(np.array(times)).tolist() == expected
    assert [period.holds(time) for time in times] == expected


def test_a_failure_comes_after_what_was_read_and_is_raised_or_kept(bench, batches, made_up):
    broken = [batches[0], CaptureError("x.pcap: ends inside record 101")]
    taken, loop = counts(made_up(broken), bench, keeps_failure=True)
    assert taken == [100]
    assert "record 101" in str(loop.failure)
    seen, source = [], made_up(broken)
    with pytest.raises(CaptureError, match="record 101"), reading(source, bench) as loop:
        seen += map(len, loop)
    assert source.closed


def test_a_failure_of_the_work_is_never_kept(bench, batches, made_up):
    source = made_up(batches)
    loop = None

    def work():
        nonlocal loop
        with reading(source, bench, keeps_failure=True) as loop:
            for _ in loop:
                raise CaptureError("disk full")

    with pytest.raises(CaptureError, match="disk full"):
        work()
    assert loop.failure is None
    assert source.closed


def test_a_mistake_in_the_selection_closes_the_source(bench, batches, made_up):
    source = made_up(batches)
    with pytest.raises(ConfigError, match="nothing"), reading(source, bench, Selection(where="nothing == 1")):
        pass
    assert source.closed


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_ctrl_c_ends_it_after_the_batch_at_hand(number, bench, batches, made_up):
    before, taken = signal.getsignal(number), []
    with reading(made_up(batches), bench, keeps_failure=True) as loop:
        for rows in loop:
            taken.append(len(rows))
            os.kill(os.getpid(), number)
    assert (taken, loop.interrupted) == ([100], True)
    assert isinstance(loop.failure, InterruptError)
    assert str(loop.failure) == "made up: interrupted; everything before was read"
    assert signal.getsignal(number) is before


def test_after_ctrl_c_a_live_list_ends_soon_and_says_what_it_does_not_show(bench, batches, made_up):
    class Live(made_up):
        live = True

        def stop(self):
            pass

        def discard(self):
            return 1000

    now = [0]
    with reading(Live(batches), bench, None, Limits(clock=lambda: now[0])) as loop:
        assert not loop.stops_early(5)
        os.kill(os.getpid(), signal.SIGINT)
        until(lambda: loop.interrupted)
        assert not loop.stops_early(5)
        now[0] += 10**9
        assert loop.stops_early(5)
    assert bench.columns.context.notes == ["not shown: 1,005 packets that had arrived before Ctrl-C"]


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
    monkeypatch.setattr("edoras_tools.pipelines.capture.info.jobs_for", lambda *_: 2)
    assert counted(paths, jobs=2) == counted(paths)
