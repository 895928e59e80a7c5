"""What is kept and written around triggers, beside a plain account of what was asked for."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace
from places import ROOT

from edoras_tools.addons.snapshot.sink import SnapshotSink, Triggers, record_snapshots
from edoras_tools.cli.record import SnapshotOptions
from edoras_tools.errors import ConfigError
from edoras_tools.io import Sink
from edoras_tools.io.formats.watched import Keep
from edoras_tools.model import Finding, SourceInfo, SourceStatistics
from edoras_tools.pipelines.capture.record import Target, check_output
from edoras_tools.pipelines.reading import Limits
from edoras_tools.pipelines.recorder import PushedSource
from edoras_tools.pipelines.workbench import Settings, open_files
from edoras_tools.units import SECOND

ZERO_NS = 1_700_000_000 * SECOND
BENCH = Settings().workbench()
CAPTURE = ROOT / "samples/captures/f_sbn_disconnect.pcap"
ONE = next(iter(open_files([CAPTURE]).batches())).take(np.array([0]))


def made(times):
    """A batch of equal datagrams; their numbers are their times in ns after the zero."""
    times = np.asarray(times, np.int64)
    batch = replace(ONE.take(np.zeros(len(times), np.int64)), time_ns=ZERO_NS + times, number=times)
    return batch, BENCH.columns.decode(batch)


class File(Sink):
    """A sink that remembers which datagrams it was given."""

    def __init__(self, path):
        self.path, self.numbers, self.closed, self.losses = path, [], 0, []
        path.write_bytes(bytes(100))

    def write(self, batch, _columns):
        assert not self.closed
        assert len(batch)
        self.numbers += batch.number.tolist()

    def flush(self):
        assert not self.closed

    def close(self, _statistics):
        self.closed += 1


class Recorder:
    """A snapshot sink over such files."""

    def __init__(self, folder, *, live=False, target=None, triggers=None, **options):
        self.files, self.said = [], []
        target = replace(target or Target(folder / "a.pcap"), on_warning=self.said.append)
        source = PushedSource(SourceInfo("", ""), SourceStatistics())
        self.sink = SnapshotSink(
            SnapshotOptions(**options), source, BENCH.columns.context, target, self.begin, triggers=triggers
        )
        self.sink._live = live

    def begin(self, path):
        self.files.append(File(path))
        return self.files[-1]

    def end(self):
        self.sink.close(SourceStatistics())
        assert [item.closed for item in self.files] == [1] * len(self.files)
        return [item.numbers for item in self.files]


@pytest.mark.quick("True")
@pytest.mark.parametrize("live", [False, True])
def test_every_datagram_from_30_s_before_to_10_s_after(live, tmp_path):
    times = np.arange(0, 60 * SECOND, SECOND // 1000)  # 1,000 per second, with a loss in the middle
    times = times[(times < 40 * SECOND) | (times >= 41 * SECOND)]
    recorder = Recorder(tmp_path, live=live)
    fired = 41 * SECOND
    for part in np.array_split(times, 300):
        if part[0] <= fired <= part[-1]:
            recorder.sink.fire(ZERO_NS + fired, "a loss")
        recorder.sink.write(*made(part))
    (written,) = recorder.end()
    assert written == times[(times >= fired - 30 * SECOND) & (times <= fired + 10 * SECOND)].tolist()
    (one,) = recorder.sink.snapshots
    assert (one.datagrams, one.before_ns, one.cut) == (len(written), 30 * SECOND, False)
    assert "from 30.0 s before to 10.0 s after: a loss" in recorder.said[-1]


@given(
    st.lists(st.lists(st.integers(0, 40), min_size=1, max_size=6), min_size=1, max_size=12),
    st.lists(st.integers(0, 80), max_size=6),
    st.integers(0, 20),
    st.integers(0, 20),
    st.booleans(),
)
def test_files_hold_what_triggers_asked_for(tmp_path_factory, steps, fired, before, after, live):
    folder = tmp_path_factory.mktemp("snapshots")
    ends = np.cumsum([item for step in steps for item in step])
    times = [part.tolist() for part in np.split(ends, np.cumsum([len(step) for step in steps])[:-1])]
    recorder = Recorder(folder, live=live, before=[("time", before)], after=after)
    asked = []
    for part in times:
        for time_ns in sorted(item for item in set(fired) if part[0] <= item <= part[-1]):
            recorder.sink.fire(ZERO_NS + time_ns, "because")
            if asked and time_ns <= asked[-1][1]:
                asked[-1][1] = max(asked[-1][1], time_ns + after)
            else:
                asked.append([time_ns - before, time_ns + after])
        recorder.sink.write(*made(part))
    flat = [item for part in times for item in part]
    wanted = [[item for item in flat if start <= item <= until] for start, until in asked]
    assert recorder.end() == [item for item in wanted if item]


def test_what_does_not_fit_is_dropped_oldest_first_and_said(tmp_path):
    recorder = Recorder(tmp_path, before_size=1_000_000)
    for second in range(100):
        recorder.sink.write(*made(second * SECOND + np.arange(0, SECOND, SECOND // 1000)))
        assert recorder.sink._size <= 1_000_000
    recorder.sink.fire(ZERO_NS + 99 * SECOND, "now")
    assert len([line for line in recorder.said if "older datagrams are dropped first" in line]) == 1
    (written,) = recorder.end()
    assert written == sorted(written)
    assert written[-1] == 99 * SECOND + 999 * SECOND // 1000
    (one,) = recorder.sink.snapshots
    assert one.cut
    assert 0 < one.before_ns < 30 * SECOND
    assert recorder.sink.dropped > 50_000
    assert "held no more of the 30 s" in recorder.said[-1]


def test_a_window_larger_than_the_memory_is_written_whole_once_it_was_asked_for(tmp_path):
    recorder = Recorder(
        tmp_path, live=True, before=[("size", 1_000_000), ("time", SECOND)], after=50 * SECOND
    )
    recorder.sink._clock = iter(
        range(0, 1 << 62, SECOND)
    ).__next__  # each look at the clock is a second later
    for second in range(60):
        recorder.sink.write(*made(second * SECOND + np.arange(0, SECOND, SECOND // 1000)))
        if second == 2:
            recorder.sink.fire(ZERO_NS + 2 * SECOND, "now")
    (written,) = recorder.end()
    assert len(written) == 51_001


def test_the_end_writes_what_has_come(tmp_path):
    recorder = Recorder(tmp_path)
    recorder.sink.write(*made([0, SECOND]))
    recorder.sink.fire(ZERO_NS + SECOND, "now")
    recorder.sink.write(*made([2 * SECOND]))
    assert recorder.end() == [[0, SECOND, 2 * SECOND]]


def test_no_trigger_no_file(tmp_path):
    recorder = Recorder(tmp_path)
    recorder.sink.write(*made([0]))
    assert recorder.end() == []
    assert not list(tmp_path.iterdir())


def test_names_are_free_and_only_so_many_are_kept(tmp_path):
    recorder = Recorder(
        tmp_path, target=Target(tmp_path / "a.pcap", keep_files=2), before=[("time", 0)], after=SECOND // 10
    )
    for tenth in range(0, 40, 5):
        recorder.sink.write(*made([tenth * SECOND // 10]))
        recorder.sink.fire(ZERO_NS + tenth * SECOND // 10, "now")
    assert [len(item) for item in recorder.end()] == [1] * 8
    assert len({item.path for item in recorder.files}) == 8
    there = sorted(tmp_path.iterdir())
    assert there == sorted(recorder.sink.paths)
    assert len(there) == 2
    assert recorder.sink.keep == Keep(2, 0, deleted=6, datagrams=6)


def test_a_quiet_link_ends_a_snapshot(tmp_path, monkeypatch):
    recorder = Recorder(tmp_path, live=True)
    now = [0]
    recorder.sink._clock = lambda: now[0]
    monkeypatch.setattr("edoras_tools.addons.snapshot.sink.time.time_ns", lambda: ZERO_NS + now[0])
    recorder.sink.write(*made([0]))
    recorder.sink.fire(ZERO_NS, "now")
    now[0] = 9 * SECOND
    recorder.sink.flush()
    assert recorder.files[0].closed == 0
    now[0] = 12 * SECOND
    recorder.sink.flush()
    assert recorder.files[0].closed == 1


def test_answers_are_given_when_the_file_is_begun(tmp_path):
    class Asked(Triggers):
        told = ()

        def fired(self):
            return [] if self.told else ["asked for on the socket"]

        def answer(self, text):
            self.told = (*self.told, text)

    triggers = Asked()
    recorder = Recorder(tmp_path, triggers=triggers)
    recorder.sink.write(*made([0]))
    assert [str(recorder.files[0].path) in text for text in triggers.told] == [True]
    assert recorder.end() == [[0]]


@pytest.mark.parametrize(
    ("trigger", "reason", "count"),
    [
        (("where", "sbn.msg_type == DISCONNECT"), "sbn.msg_type == DISCONNECT", 1),
        (("finding", "cdr_trailing"), "", 0),
        (("rule", "sbn_timeout"), "rule sbn_timeout: ", 1),
        (("rule", ""), "rule ", 1),
    ],
)
def test_what_fires(trigger, reason, count, tmp_path):
    said = []
    source = open_files([CAPTURE])
    target = Target(tmp_path / "a.mcap", on_warning=said.append)
    request = SnapshotOptions(trigger=[trigger])
    report, sink = record_snapshots(source, Settings().workbench(source.info), target, request)
    assert report.ledger.datagrams == 1544
    assert len(report.outputs) == len(sink.snapshots) == count
    for one in sink.snapshots:
        assert one.reasons[0].startswith(reason)
        kept = open_files([one.path])
        (times,) = (batch.time_ns for batch in kept.batches())
        kept.close()
        assert len(times) == one.datagrams
        assert one.start_ns <= times.min() <= times.max() <= one.until_ns


def test_findings_are_named(tmp_path):
    source = open_files([CAPTURE])
    bench = Settings().workbench(source.info)
    columns = bench.columns.decode(next(iter(open_files([CAPTURE]).batches())))
    rare = min(
        (bit for bit in range(32) if (columns.findings >> bit & 1).any()),
        key=lambda bit: (columns.findings >> bit & 1).sum(),
    )
    request = SnapshotOptions(
        before=[("time", SECOND)], after=SECOND, trigger=[("finding", Finding(1 << rare).label)]
    )
    _, sink = record_snapshots(source, bench, Target(tmp_path / "a.pcap"), request, limits=Limits())
    assert sink.snapshots
    assert all(one.reasons[0].startswith("finding ") for one in sink.snapshots)


def test_names_and_limits_of_the_target(tmp_path):
    (tmp_path / "a.pcap").write_bytes(b"x")
    check_output(Target(tmp_path / "a.pcap", keep_files=3), [], snapshots=True)
    with pytest.raises(ConfigError, match="unknown suffix"):
        check_output(Target(tmp_path / "a.txt"), [], snapshots=True)
