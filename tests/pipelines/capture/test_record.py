"""Recording without a command line: limits, flushing, losses, and ends of every kind."""

from __future__ import annotations

import itertools
import os
import signal
import socket
import sys
import threading
import time
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import typer
from mcap.reader import make_reader
from msgspec.structs import replace
from places import ROOT

from edoras_tools.cli import output
from edoras_tools.cli.output import LOST
from edoras_tools.decode import Options
from edoras_tools.errors import CaptureError, ConfigError, InterruptError, RouteError
from edoras_tools.io import Sink
from edoras_tools.io.formats.mcap import writer
from edoras_tools.io.formats.mcap.writer import McapSink
from edoras_tools.io.net.buffer import UdpSource
from edoras_tools.mission import Mission
from edoras_tools.model import Columns, Endpoint
from edoras_tools.pipelines.capture import record as module
from edoras_tools.pipelines.capture.info import inspect
from edoras_tools.pipelines.capture.record import FLUSH_NS, Flushing, Target, Waiting, check_output, record
from edoras_tools.pipelines.reading import Limits
from edoras_tools.pipelines.selection import Selection
from edoras_tools.pipelines.workbench import Settings, open_files


class Kept(Sink):
    """Remembers what is done to it."""

    def __init__(self, fail_at=None):
        self.done = []
        self.paths, self.losses, self.keep = [Path("out.mcap")], [], None
        self._fail_at = fail_at

    def write(self, batch, columns):
        assert len(batch) == len(columns)
        if len(self.done) == self._fail_at:
            raise CaptureError("out.mcap: cannot be written: No space left on device")
        self.done.append(len(batch))

    def flush(self):
        self.done.append("flush")

    def close(self, statistics):
        self.done.append("close")
        self.statistics = statistics


@pytest.fixture
def sink(monkeypatch):
    """A function: a sink that is opened whatever the target says."""

    def make(**keywords):
        made = Kept(**keywords)
        monkeypatch.setattr(module, "open_sink", lambda *_, **__: made)
        return made

    return make


CAPTURE = ROOT / "samples/captures/a_rover.pcap"
TARGET = Target(Path("out.mcap"))
STILL = Limits(clock=lambda: 0)


def test_everything_in_order(bench, batches, made_up, sink):
    opened, source, tapped = sink(), made_up(batches), []
    report = record(
        source,
        bench,
        TARGET,
        limits=STILL,
        tap=lambda batch, columns: tapped.append((len(batch), len(columns))),
    )
    assert opened.done == [100] * 18 + ["close"]
    assert tapped == [(100, 100)] * 18
    assert (report.ledger.datagrams, report.failure) == (1800, None)
    assert opened.statistics is source.statistics
    assert source.closed


def test_flushed_at_least_once_a_second(bench, batches, made_up, sink):
    """What came is flushed at once where it is old; a killed recorder loses a second at most."""
    opened, times = sink(), itertools.count(0, 300_000_000)
    nothing = [batches[0].take(slice(0, 0))] * 9
    record(made_up(batches[4:11] + nothing), bench, TARGET, limits=Limits(clock=lambda: next(times)))
    assert opened.done[:14] == [100, "flush"] * 7
    assert opened.done[14:-1] == ["flush"] * 2  # and while nothing comes
    assert opened.done[-1] == "close"


@pytest.mark.parametrize(
    ("count", "written"), [(1, [1]), (100, [100]), (101, [100, 1]), (250, [100, 100, 50])]
)
def test_count(count, written, bench, batches, made_up, sink):
    opened = sink()
    report = record(made_up(batches), bench, TARGET, limits=replace(STILL, count=count))
    assert (opened.done, report.ledger.datagrams) == ([*written, "close"], count)


def test_duration_ends_a_source_that_never_does(bench, batches, made_up, sink):
    opened, times = sink(), itertools.count(0, 50_000_000)
    endless = made_up(itertools.repeat(batches[3]))
    record(endless, bench, TARGET, limits=Limits(0, 2_000_000_000, lambda: next(times)))
    assert opened.done.count("flush") == 2  # once a second
    assert endless.closed


def test_the_end_of_a_cut_source_is_told_after_all_was_written(bench, batches, made_up, sink):
    opened = sink()
    broken = made_up([*batches[:2], CaptureError("x.pcap: ends inside record 201")])
    report = record(broken, bench, TARGET, limits=STILL)
    assert opened.done == [100, 100, "close"]
    assert str(report.failure) == "x.pcap: ends inside record 201"
    with pytest.raises(CaptureError, match="record 201"):
        output.finish(report, live=False)


def test_an_output_that_fails_ends_the_recording(bench, batches, made_up, sink):
    opened, source = sink(fail_at=2), made_up(batches)
    with pytest.raises(CaptureError, match="No space left"):
        record(source, bench, TARGET, limits=STILL)
    assert opened.done == [100, 100, "close"]
    assert source.closed


def test_losses_are_exit_code_3(bench, batches, made_up, sink, capsys):
    sink()
    report = record(made_up(batches, kernel_drops=1234), bench, TARGET, limits=STILL)
    assert (report.lost, report.summary()["capture_drops"]) == (1234, 1234)
    with pytest.raises(typer.Exit) as ending:
        output.finish(report, live=True)
    assert ending.value.exit_code == LOST == 3
    assert (
        capsys.readouterr().err == "edoras: the capture itself lost 1,234 packets; it was too slow for them\n"
    )


@pytest.mark.skipif(sys.platform != "linux", reason="there is one process elsewhere")
def test_files_are_watched_with_several_processes_too(bench, made_up, tmp_path, monkeypatch):
    monkeypatch.setattr("edoras_tools.io.processes._LARGE", 1)
    path, beside, told = tmp_path / "x.mcap", tmp_path / "x_1.mcap", tmp_path / "told"
    with closing(open_files([CAPTURE])) as opened:
        (batch,) = opened.batches()

    def endless():
        """Batches until somebody has noticed."""
        yield batch
        path.unlink()
        while not beside.exists():
            yield batch.take(slice(0, 10))
            time.sleep(0.01)
        yield batch

    source = made_up(endless(), total_bytes=1)
    target = Target(path, on_warning=told.write_text, jobs=2)
    report = record(source, bench, target, limits=STILL)
    (loss,) = report.losses
    assert (loss.path, loss.fate, loss.recoverable) == (path, "was deleted", False)
    assert loss.datagrams >= len(batch)
    assert report.outputs == [beside]
    assert told.read_text() == f"{loss}; continuing in {beside}"
    with closing(open_files([beside])) as opened:
        kept = sum(len(item) for item in opened.batches())
    assert kept == report.summary()["datagrams"] >= len(batch)


def test_an_unknown_topic_is_told_before_anything_is_written(bench, batches, made_up, tmp_path):
    source, target = made_up(batches), Target(tmp_path / "x.mcap")
    with pytest.raises(RouteError, match="no configured topic matches 'nothing'"):
        record(source, bench, target, selection=Selection(topics=["nothing"]))
    assert not target.path.exists()
    assert source.closed


def test_an_output_that_cannot_be_opened_closes_the_source(bench, batches, made_up, tmp_path):
    source = made_up(batches)
    with pytest.raises(CaptureError, match="cannot be created"):
        record(source, bench, Target(Path("/proc/nowhere/x.mcap")))
    assert source.closed


def test_ctrl_c_while_it_waits_for_a_pipe(bench, batches, made_up, sink):
    """The signal comes inside the source, as while reading a pipe that says nothing."""
    opened = sink()
    before = signal.getsignal(signal.SIGINT)
    source = made_up([batches[0], lambda: os.kill(os.getpid(), signal.SIGINT), batches[1]])
    report = record(source, bench, TARGET, limits=STILL)
    assert opened.done == [100, "close"]
    assert isinstance(report.failure, InterruptError)
    assert signal.getsignal(signal.SIGINT) is before


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_ctrl_c_while_it_writes_loses_nothing(number, bench, batches, made_up, sink):
    opened = sink()
    report = record(
        made_up(batches), bench, TARGET, limits=STILL, tap=lambda *_: os.kill(os.getpid(), number)
    )
    assert opened.done == [100, "close"]
    assert (type(report.failure), report.ledger.datagrams) == (InterruptError, 100)


def test_ctrl_c_while_it_reads_a_file_leaves_the_older_recording(bench, tmp_path):
    path, told = tmp_path / "x.pcap", []
    path.write_bytes(b"precious")
    report = record(
        open_files([CAPTURE]),
        bench,
        Target(path, replace=True, on_warning=told.append),
        tap=lambda *_: os.kill(os.getpid(), signal.SIGINT),
    )
    assert isinstance(report.failure, InterruptError)
    assert path.read_bytes() == b"precious"
    assert report.outputs == [tmp_path / "x_1.pcap"]
    assert told == [f"{path} is as it was; the new recording is {tmp_path / 'x_1.pcap'}"]
    with closing(open_files(report.outputs)) as source:
        assert sum(map(len, source.batches())) == report.ledger.datagrams > 0


def test_ctrl_c_of_a_live_source_takes_what_arrived(bench, batches, made_up, sink):
    """A live source is told to stop, and goes on until it has handed over everything."""
    opened, source = sink(), made_up([])
    stopped = threading.Event()
    source.live, source.stop = True, stopped.set

    def given():
        yield batches[0]
        os.kill(os.getpid(), signal.SIGINT)
        assert stopped.wait(60)
        yield batches[1]
        yield batches[2]

    source.batches = given
    report = record(source, bench, TARGET, limits=STILL)
    assert opened.done == [100, 100, 100, "close"]
    assert report.failure is None


def test_a_second_ctrl_c_does_not_wait(bench, batches, made_up, sink):
    """For a sink that hangs; what it has is still closed."""
    opened, source = sink(), made_up([])
    source.live, source.stop = True, lambda: None

    def given():
        yield batches[0]
        os.kill(os.getpid(), signal.SIGINT)
        os.kill(os.getpid(), signal.SIGINT)
        yield batches[1]

    source.batches = given
    with pytest.raises(KeyboardInterrupt):
        record(source, bench, TARGET, limits=STILL)
    assert opened.done == [100, "close"]
    assert source.closed


def test_signals_are_left_alone_outside_the_main_thread(bench, batches, made_up, sink):
    opened = sink()
    thread = threading.Thread(target=record, args=(made_up(batches), bench, TARGET), kwargs={"limits": STILL})
    thread.start()
    thread.join()
    assert opened.done == [100] * 18 + ["close"]


TARGETS = [
    (Target("x.mcap"), None),
    (Target("x.MCAP", split_bytes=5), None),
    (Target("x", rosbag2=True), None),
    (Target("x", rosbag2=True, split_ns=5), None),
    (Target("x.pcap"), None),
    (Target("x.pcapng"), None),
    (Target("x.pcap", split_ns=5), None),
    (Target("x.pcap", split_count=5, keep_files=2), None),
    (Target("x.mcap", split_bytes=5, keep_bytes=50), None),
    (Target("x.mcap", keep_files=2), "--keep deletes the oldest files: split too"),
    (Target("x.mcap", keep_bytes=2), "--keep deletes the oldest files: split too"),
    (Target("x.mcap", split_bytes=5, keep_bytes=4), "--keep is smaller than --split"),
    (Target("x.txt"), "unknown suffix"),
    (Target("x.mcap.gz"), "unknown suffix"),
    (Target("x"), "unknown suffix"),
]


@pytest.mark.parametrize(("target", "words"), TARGETS)
def test_targets(target, words, tmp_path):
    target = replace(target, path=tmp_path / target.path)
    if words is None:
        check_output(target, [])
        return
    with pytest.raises(ConfigError, match=words):
        check_output(target, [])


@pytest.mark.long
def test_batches_of_one_make_the_same_recording(bench, batches, made_up, tmp_path):
    singles = [batches[0].take(slice(index, index + 1)) for index in range(100)]
    contents = []
    for name, given in (("one.mcap", batches[:1]), ("many.mcap", singles)):
        record(made_up(given), bench, Target(tmp_path / name), limits=STILL)
        with (tmp_path / name).open("rb") as file:
            contents.append(
                [
                    (channel.topic, message.log_time, message.publish_time, message.data)
                    for _, channel, message in make_reader(file).iter_messages(["/edoras/datagrams"])
                ]
            )
    assert contents[0] == contents[1]
    assert len(contents[0]) == 100
    assert bench.mission == Mission()


KEPT = {"split_count": 200, "keep_files": 3}


@pytest.mark.each(3)
@pytest.mark.filterwarnings("ignore:.*multi-threaded, use of fork:DeprecationWarning")
@pytest.mark.parametrize("limits", [{}, {"split_bytes": 60_000}, {"split_ns": 20_000_000_000}, KEPT])
def test_several_processes_make_the_same_recording(bench, captures, tmp_path, monkeypatch, limits):
    monkeypatch.setattr("edoras_tools.io.processes._LARGE", 0)
    monkeypatch.setattr(writer, "_LARGE", 1)
    contents = []
    for jobs in (1, 3):
        report = record(
            open_files([captures("a_rover")]),
            bench,
            Target(tmp_path / "a.mcap", jobs=jobs, **limits),
            limits=replace(STILL, count=1500),
        )
        assert report.ledger.datagrams == 1500
        assert len(report.outputs) == 1 or limits
        contents.append({path.name: path.read_bytes() for path in report.outputs})
        assert {path.name for path in tmp_path.iterdir()} == contents[-1].keys()
        deleted = (5, 1000) if limits is KEPT else (0, 0)
        assert (report.keep.deleted, report.keep.datagrams) == deleted
        for path in report.outputs:
            path.unlink()
    assert contents[0] == contents[1]


def test_where_no_process_can_be_forked_it_records_all_the_same(bench, captures, tmp_path, monkeypatch):
    def none(*_):
        raise BlockingIOError("Resource temporarily unavailable")

    monkeypatch.setattr("edoras_tools.io.processes._LARGE", 0)
    monkeypatch.setattr("os.fork", none)
    source = open_files([captures("a_rover")])
    report = record(source, bench, Target(tmp_path / "a.mcap", jobs=2), limits=STILL)
    assert report.ledger.datagrams == 1827
    with (tmp_path / "a.mcap").open("rb") as file:
        assert sum(1 for _ in make_reader(file).iter_messages(["/edoras/datagrams"])) == 1827


@pytest.mark.parametrize("suffix", ["mcap", "pcapng"])
@pytest.mark.parametrize("listened", [(), (39555,)])
def test_a_recording_remembers_the_ports_that_were_listened_on(listened, suffix, made_up, batches, tmp_path):
    to_ci = batches[0].take(np.flatnonzero(batches[0].destination_port == 1234))
    ports = np.full(len(to_ci), 39555, np.uint16)
    moved = replace(to_ci, source_port=ports, destination_port=ports, data=to_ci.data.copy())
    heads = moved.offset[:, None] - 8 + np.arange(4)  # both ports, in front of length and checksum
    moved.data[heads] = np.frombuffer((39555).to_bytes(2, "big") * 2, np.uint8)
    bench = Settings(options=Options(listened=listened)).workbench()
    path = tmp_path / f"a.{suffix}"
    record(made_up([moved]), bench, Target(path))
    source = open_files([path])
    report = inspect(source, Settings().workbench(source.info))
    assert report.ledger.datagrams == len(moved)
    assert any("look like" in note for note in report.notes)
    assert bool(report.unnamed) is not bool(listened)


def test_times_before_and_after_the_year_2000_are_told(made_up, batches, bench, tmp_path):
    unset = replace(batches[0], time_ns=batches[0].time_ns % 10**12)
    report = record(made_up([unset, batches[1]]), bench, Target(tmp_path / "a.mcap"))
    assert [note for note in report.notes if "a clock was not set" in note]
    assert report.ledger.datagrams == len(unset) + len(batches[1])


@pytest.mark.parametrize(("given", "waits"), [({}, True), ({"tap": lambda *_: None}, False)])
def test_small_batches_wait_for_each_other_where_nobody_watches(given, waits, bench, tmp_path, monkeypatch):
    """They are decoded when they come, and written as one; nothing is lost, nothing out of order."""
    written = []
    taking = McapSink.write

    def write(self, batch, columns):
        written.append(batch.number.tolist())
        taking(self, batch, columns)

    monkeypatch.setattr(McapSink, "write", write)
    source = UdpSource([Endpoint("127.0.0.1", 0)])
    now, sent = [0], socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    decoded, decode = [], bench.columns.decode

    def count(batch):
        decoded.append(len(batch))
        sent.sendto(b"x" * len(decoded), ("127.0.0.1", source.endpoints[0].port))
        now[0] += 10**8
        if sum(decoded) >= 6:
            source.stop()
        return decode(batch)

    monkeypatch.setattr(bench.columns, "decode", count)
    with sent:
        report = record(
            source, bench, Target(tmp_path / "a.mcap"), limits=Limits(clock=lambda: now[0]), **given
        )
    assert report.ledger.datagrams == sum(decoded) >= 6
    assert [number for part in written for number in part] == list(range(1, sum(decoded) + 1))
    assert (len(written) < len([size for size in decoded if size])) is waits


MS = 1_000_000


class Clocks:
    """Monotonic and wall time, moved by hand, and a sink that notes when it is flushed."""

    def __init__(self):
        self.now, self.offset, self.flushed = 0, 10**18, []
        self.flushing = Flushing(self, lambda: self.now, lambda: self.now + self.offset)

    def flush(self):
        self.flushed.append(self.now // MS)

    def take(self, age_ms=0, size=100):
        length = np.array([size], np.int32)
        times = np.array([self.now + self.offset - age_ms * MS])
        self.flushing.took(_Batch(time_ns=times, frame_length=length))
        self.flushing.flush_if_due()


class _Batch(SimpleNamespace):
    def __len__(self):
        return len(self.time_ns)


@pytest.fixture
def clocks():
    return Clocks()


def test_what_comes_in_time_is_flushed_together(clocks):
    for clocks.now in range(0, 1001 * MS, 10 * MS):
        clocks.take()
    assert clocks.flushed == [200, 410, 620, 830]


@pytest.mark.parametrize("behind_ms", [200, 900, 60_000])
def test_who_is_behind_flushes_every_batch(clocks, behind_ms):
    for clocks.now in range(100 * MS, 400 * MS, 100 * MS):
        clocks.take(behind_ms)
    assert clocks.flushed == [100, 200, 300]


def test_age_and_wait_together_are_bounded(clocks):
    clocks.take(150)
    for clocks.now in range(0, 100 * MS, 10 * MS):
        clocks.flushing.flush_if_due()
    assert clocks.flushed == [50]


def test_a_clock_set_back_delays_nothing(clocks):
    clocks.offset -= 3600 * 10**9
    clocks.take(-3600 * 1000)
    clocks.now = FLUSH_NS
    clocks.flushing.flush_if_due()
    assert clocks.flushed == [200]


def test_it_is_flushed_with_nothing_to_write_too(clocks):
    for clocks.now in range(0, 2550 * MS, 50 * MS):
        clocks.flushing.flush_if_due()
    assert clocks.flushed == [200, 1200, 2200]


def test_what_has_no_packets_is_flushed_as_soon(clocks):
    clocks.now = 200 * MS
    clocks.flushing.flush_if_due()
    for clocks.now in range(250 * MS, 1000 * MS, 50 * MS):
        if clocks.now == 300 * MS:
            clocks.flushing.noted()
        clocks.flushing.flush_if_due()
    assert clocks.flushed == [200, 500]


def test_swift_traffic_fills_chunks_by_itself(clocks):
    for clocks.now in range(0, 500 * MS, 10 * MS):
        clocks.take(size=1 << 20)
    assert clocks.flushed == []


def test_of_files_no_age_is_taken(clocks):
    clocks.flushing = Flushing(clocks, lambda: clocks.now, None)
    clocks.take(10**9)
    assert clocks.flushed == []
    assert clocks.flushing.wait_s == 0.2


@pytest.mark.parametrize(
    ("patient", "step_ms", "size", "written"),
    [
        (True, 200, 10, [3, 3]),
        (True, 100, 10, [5]),
        (True, 200, 300_000, [1] * 8),
        (False, 200, 10, [1] * 8),
    ],
    ids=["quiet", "quick", "much", "watched"],
)
def test_small_batches_wait_for_each_other(patient, step_ms, size, written, batches):
    """For 0.35 s from the first on; none is older than a second when the next one is written."""
    now, taken = 0, []
    waiting = Waiting(patient=patient, clock=lambda: now)
    one = batches[0].take(slice(0, 2))
    one = replace(one, data=np.zeros(size, np.uint8))
    for _ in range(8):
        waiting.add(one, Columns(**{name: np.zeros(2, int) for name in Columns.__struct_fields__}))
        if not waiting.waits:
            taken.append(len(waiting.take()[0]) // 2)
        now += step_ms * MS
    assert taken == written
    left = waiting.take()
    assert (len(left[0]) // 2 if left else 0) == 8 - sum(written)
    assert waiting.take() is None
