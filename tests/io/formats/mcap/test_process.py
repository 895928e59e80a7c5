"""A sink in a process of its own: the same output, every failure told, nothing read that was written over."""

import os
import signal
import subprocess
import sys
import threading
import time
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest
from effort import long_but
from mcap.reader import make_reader
from places import CAPTURES
from waiting import until

from edoras_tools.decode import ColumnDecoder, Context
from edoras_tools.errors import CaptureError, FieldError
from edoras_tools.io import forked
from edoras_tools.io.formats import stream
from edoras_tools.io.formats.mcap import process as apart
from edoras_tools.io.formats.mcap.process import Apart
from edoras_tools.io.formats.mcap.writer import McapSink
from edoras_tools.io.formats.open import open_file
from edoras_tools.mission import Mission
from edoras_tools.model import SourceStatistics

# From Python 3.12 on forking beside threads, such as those of pytest-xdist, is warned of.
pytestmark = pytest.mark.filterwarnings("ignore:.*multi-threaded, use of fork:DeprecationWarning")


class Noting:
    """A sink that notes what it is given in a file."""

    def __init__(self, path, *, fail=None, slow=0.0):
        self.paths = [path]
        self.statistics = SourceStatistics()
        self._fail, self._slow = fail, slow

    def _note(self, text):
        time.sleep(self._slow)
        with self.paths[0].open("a") as file:
            file.write(f"{text}\n")

    def write(self, batch, columns):
        if self._fail is not None:
            raise self._fail
        self._note(told(batch, columns, self.statistics))

    def flush(self):
        self._note("flushed")

    def abandon(self):
        pass

    def close(self, statistics):
        self._note(f"closed {statistics.skipped}")


def told(batch, columns, statistics):
    """What is noted of a batch."""
    return f"{int(batch.data.sum())} {int(columns.cdr_offset.sum())} {statistics.kernel_drops}"


def started(tmp_path, **keywords):
    """A noting sink in a process of its own, and where it notes."""
    path = tmp_path / "notes"
    sink = Noting(path, **keywords)
    return Apart(sink, sink.statistics, path), path, sink.statistics


def write_often(sink, batch):
    """Write so often that an answer must have come."""
    for _ in range(4):
        sink.write(*batch)


@pytest.mark.parametrize("slow", [0, 0.02])
def test_nothing_is_written_over_before_it_was_read(tmp_path, made_up, slow):
    sink, path, statistics = started(tmp_path, slow=slow)
    expected = []
    for seed in range(12):
        batch, columns = made_up(seed, [50 + seed] * (1 + 40 * (seed % 5)))
        statistics.kernel_drops = seed
        sink.write(batch, columns)
        expected.append(told(batch, columns, statistics))
        batch.data[:] = 0
        if seed == 7:
            sink.flush()
            expected.append("flushed")
            assert path.read_text().splitlines() == expected
    sink.close(SourceStatistics(skipped=3))
    sink.close(SourceStatistics(skipped=4))
    assert path.read_text().splitlines() == [*expected, "closed 3"]
    assert sink.paths == [path]


def recorded(path, types, capture, *, lent, separate):
    """Record a capture read in small windows; return the bytes of the recording."""
    with closing(open_file(CAPTURES / f"{capture}.pcap")) as source:
        sink = McapSink(path, Mission(), types, source.info, statistics=source.statistics)
        if separate:
            sink = Apart(sink, source.statistics, path)
            if lent:
                source.borrow(sink.lend)
        decoder = ColumnDecoder(Context())
        for batch in source.batches():
            sink.write(batch, decoder.decode(batch))
        sink.close(source.statistics)
        assert sink.paths == [path]
    return path.read_bytes()


@pytest.mark.parametrize("capture", long_but(["a_rover"], ["a_rover", "f_sbn"]))
@pytest.mark.parametrize(
    ("lent", "room", "slot"),
    [
        (False, 1 << 20, 1 << 20),
        (True, 1 << 20, 1 << 20),
        (True, 1 << 20, 1 << 10),  # columns do not fit and go through the socket
        (True, 1 << 12, 1 << 20),  # windows are too large to be lent
        (True, 1 << 12, 1 << 10),
    ],
)
def test_recordings_are_the_same(tmp_path, types, monkeypatch, capture, lent, room, slot):
    names = {path.stem for path in CAPTURES.glob("*.pcap")}
    name = next(item for item in sorted(names) if item.startswith(capture[:2]))
    monkeypatch.setattr(stream, "FIRST", 3 << 10)
    monkeypatch.setattr(stream, "SLICE", 8 << 10)
    together = recorded(tmp_path / "a.mcap", types, name, lent=False, separate=False)
    monkeypatch.setattr(apart, "_ROOM_BYTES", room)
    monkeypatch.setattr(apart, "_LENT", apart._ROOMS * room)
    monkeypatch.setattr(apart, "_SLOT_BYTES", slot)
    assert recorded(tmp_path / "b.mcap", types, name, lent=lent, separate=True) == together


def test_what_is_lent_is_not_copied(tmp_path, made_up):
    sink, path, _ = started(tmp_path)
    batch, columns = made_up(1, [100] * 20)
    lent = sink.lend(len(batch.data))
    lent[:] = batch.data
    sink.write(replace(batch, data=lent), columns)
    rooms = [sink.lend(10) for _ in range(apart._ROOMS)]
    addresses = {room.__array_interface__["data"][0] for room in rooms}
    assert len(addresses) == len(rooms)
    assert lent.__array_interface__["data"][0] in addresses
    assert sink.lend(1 << 30).base is None
    sink.close(SourceStatistics())
    assert path.read_text().split()[0] == str(int(batch.data.sum()))


@pytest.mark.parametrize("error", [CaptureError("a.mcap: cannot be written: No space"), ValueError("no")])
def test_what_the_sink_raises_is_raised_here(tmp_path, made_up, error):
    sink, path, _ = started(tmp_path, fail=error)
    batch = made_up(1, [100] * 20)
    with pytest.raises(type(error), match=str(error)):
        write_often(sink, batch)
    with pytest.raises(type(error), match=str(error)):
        sink.flush()
    sink.close(SourceStatistics())
    assert path.read_text() == "closed 0\n"


def test_a_failure_is_not_told_to_the_source_that_borrows(tmp_path, made_up):
    sink, _, _ = started(tmp_path, fail=CaptureError("a.mcap: cannot be written"))
    batch, columns = made_up(1, [100] * 20)
    lent = sink.lend(len(batch.data))
    sink.write(replace(batch, data=lent), columns)
    for _ in range(4):
        assert len(sink.lend(10)) == 10
    with pytest.raises(CaptureError, match="cannot be written"):
        sink.close(SourceStatistics())
    sink.close(SourceStatistics())


def test_an_exception_that_does_not_survive_the_way(tmp_path, made_up):
    sink, _, _ = started(tmp_path, fail=FieldError("ccsds", "apid", "99999 does not fit"))
    sink.write(*made_up(1, [100] * 20))
    with pytest.raises(CaptureError, match=r"ccsds.*99999 does not fit"):
        sink.flush()
    sink.close(SourceStatistics())


def test_what_could_not_be_asked_is_not_waited_for(tmp_path, made_up):
    sink, path, _ = started(tmp_path)
    batch, columns = made_up(1, [100] * 20)
    lent = sink.lend(len(batch.data))
    with pytest.raises(TypeError, match="pickle"):
        sink.write(replace(batch, data=lent, ipv6=threading.Lock()), columns)
    for _ in range(4):
        sink.lend(10)
    sink.write(batch, columns)
    sink.close(SourceStatistics())
    assert len(path.read_text().splitlines()) == 2


def test_where_nobody_waits_for_processes(tmp_path, made_up):
    before = signal.signal(signal.SIGCHLD, signal.SIG_IGN)
    try:
        sink, path, _ = started(tmp_path)
        sink.write(*made_up(1, [100] * 20))
        sink.close(SourceStatistics())
    finally:
        signal.signal(signal.SIGCHLD, before)
    assert len(path.read_text().splitlines()) == 2


def test_the_process_goes_with_the_one_that_started_it(tmp_path):
    code = f"""
import sys, time
sys.path[:0] = {[str(Path(__file__).parents[up] / name) for up, name in ((0, "."), (3, "support"))]!r}
from test_process import started
from pathlib import Path
sink, _, _ = started(Path({str(tmp_path)!r}), slow=60)
sink._ask("flush")
print(sink._process, flush=True)
time.sleep(60)
"""
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as starter:
        number = int(starter.stdout.readline())
        assert Path(f"/proc/{number}").exists()
        starter.kill()
    state = Path(f"/proc/{number}/stat")
    until(lambda: not state.exists() or state.read_text().split()[2] == "Z", "the process is still there")


def test_a_process_that_was_killed(tmp_path, made_up):
    sink, path, _ = started(tmp_path)
    os.kill(sink._process, signal.SIGKILL)
    batch = made_up(1, [100] * 20)
    words = rf"{path}: the process that wrote it was killed; `edoras recover"
    with pytest.raises(CaptureError, match=words):
        write_often(sink, batch)
    sink.close(SourceStatistics())


def test_a_process_that_was_killed_at_last(tmp_path, made_up):
    sink, _, _ = started(tmp_path)
    sink.write(*made_up(1, [100] * 20))
    os.kill(sink._process, signal.SIGKILL)
    with pytest.raises(CaptureError, match="was killed"):
        sink.close(SourceStatistics())
    sink.close(SourceStatistics())


def test_the_output_is_made_whole_when_nobody_asks_any_more(tmp_path, types, mission, info, made_up):
    path = tmp_path / "a.mcap"
    statistics = SourceStatistics()
    sink = Apart(McapSink(path, mission, types, info), statistics, path)
    sink.write(*made_up(7, [100] * 300))
    sink._link.close()
    os.waitpid(sink._process, 0)
    with path.open("rb") as file:
        found = [channel.topic for _, channel, _ in make_reader(file).iter_messages()]
    assert found.count("/edoras/datagrams") == 300


def test_ctrl_c_is_heeded_by_the_one_that_asks(tmp_path, made_up):
    sink, path, _ = started(tmp_path, slow=0.4)
    batch, columns = made_up(1, [100] * 20)
    sink.write(batch, columns)
    for number in (signal.SIGINT, signal.SIGTERM):
        os.kill(sink._process, number)
    threading.Timer(0.1, os.kill, (os.getpid(), signal.SIGINT)).start()
    with pytest.raises(KeyboardInterrupt):
        sink.flush()
    sink.write(batch, columns)  # the answer to the flush was taken: all goes on
    sink.close(SourceStatistics())
    assert path.read_text().splitlines()[3:] == ["closed 0"]


def test_where_no_process_can_be_had(tmp_path, monkeypatch):
    monkeypatch.setattr(forked.sys, "platform", "darwin")
    with pytest.raises(OSError, match="support fork"):
        started(tmp_path)
