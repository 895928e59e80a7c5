"""Forked processes: results in order, failures told, nothing read that was written over."""

import fcntl
import os
import pickle
import signal
import socket
import struct
import subprocess
import sys
import termios
import threading
import time
from collections import deque
from contextlib import closing
from functools import cache, partial
from itertools import cycle, pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from unittest.mock import patch

import numpy as np
import pytest
from effort import examples, long_but
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from places import CAPTURES, MISSIONS
from waiting import until

from edoras_tools.decode import ColumnDecoder, Context
from edoras_tools.errors import CaptureError, WireError
from edoras_tools.io import RecordingOptions
from edoras_tools.io import processes as module
from edoras_tools.io.formats import capture_file
from edoras_tools.io.formats.mcap import writer
from edoras_tools.io.formats.mcap.writer import McapSink
from edoras_tools.io.formats.open import open_file
from edoras_tools.io.processes import InOrder, Workers, receive, send, writer_killed
from edoras_tools.mission import Mission
from edoras_tools.model import SourceStatistics
from edoras_tools.pipelines.workbench import Settings

# From Python 3.12 on forking beside threads, such as those of libraries that other tests use, is warned of.
pytestmark = pytest.mark.filterwarnings("ignore:.*multi-threaded, use of fork:DeprecationWarning")
GONE = writer_killed("a.mcap")
KILLED = "the process that wrote it was killed; `edoras recover"


def refuse(data):
    raise MemoryError(data)


def twice(data, slow=0.0):
    time.sleep(slow)
    return os.getpid(), data * 2


@pytest.fixture
def started():
    """Starts workers, and ends them."""
    made = []

    def start(work=twice, count=1):
        made.append(Workers(count, work, GONE))
        assert made[-1].full
        made[-1].start()
        made[-1].start()
        assert not made[-1].full
        return made[-1]

    yield start
    for item in made:
        item.close()
        assert not item.waiting


@pytest.mark.quick("1024-2", "1048576-1")
@pytest.mark.parametrize("count", [1, 2, 3])
@pytest.mark.parametrize("slot", [1 << 20, 1 << 10])  # some arrays do not fit and go through the socket
def test_results_come_in_order_and_nothing_is_written_over(started, monkeypatch, count, slot):
    monkeypatch.setattr(module, "SLOT_BYTES", slot)
    workers, left, taken, processes = started(count=count), list(range(12)), [], set()
    while left or workers.waiting:
        if left and not workers.full:
            data = np.full(100 * (1 + left[0] % 4), left[0])
            workers.submit(data, 0.02 * (left[0] % 3 == 0))
            data[:] = -1
            del left[0]
        else:
            process, result = workers.take()
            processes.add(process)
            assert len(result) == 100 * (1 + len(taken) % 4)
            taken += {*result.tolist()}
    assert taken == [2 * number for number in range(12)]
    assert len(processes) == count
    assert os.getpid() not in processes


def test_what_is_lent_is_not_copied(started):
    workers = started(lambda data: data.__array_interface__["data"][0])
    lent = [workers.lend(100) for _ in range(3)]
    assert len({item.__array_interface__["data"][0] for item in lent}) == len(lent)
    for item in lent[:2]:
        workers.submit(item)
    assert [workers.take() for _ in range(2)] == [item.__array_interface__["data"][0] for item in lent[:2]]
    assert workers.lend(1 << 30).base is None


def test_what_is_lent_is_not_lent_again_before_it_was_read(started):
    workers = started(lambda data: time.sleep(0.1) or int(data.sum()))
    lent = workers.lend(10)
    lent[:] = 1
    workers.submit(lent)
    for _ in range(4):
        workers.lend(10)[:] = 2
    assert workers.ready
    assert workers.take() == 10


class UnportableError(WireError):
    """An error that does not survive pickling, whatever other packages teach ``pickle``."""

    def __init__(self, text):
        super().__init__(text)
        self.why = lambda: text


@pytest.mark.parametrize(
    ("error", "kind", "words"),
    [
        (CaptureError("a.mcap: no"), CaptureError, "a.mcap: no"),
        (ValueError("no"), ValueError, "no"),
        (MemoryError("no"), MemoryError, "no"),
        (UnportableError("99999 does not fit"), CaptureError, "99999 does not fit"),
    ],
)
def test_what_the_function_raises_is_raised_here(started, error, kind, words):
    def fail(number):
        if number:
            raise error
        return number

    workers = started(fail)
    workers.submit(0)
    workers.submit(1)
    assert workers.take() == 0
    with pytest.raises(kind, match=words):
        workers.take()
    workers.submit(0)
    assert workers.take() == 0


@pytest.mark.parametrize("early", [True, False])
def test_a_process_that_was_killed(started, early):
    workers = started(count=2)
    if not early:
        workers.submit(1, 60)
        workers.submit(1)
    os.kill(workers.processes[0], signal.SIGKILL)
    if early:
        os.waitid(os.P_PID, workers.processes[0], os.WEXITED | os.WNOWAIT)
        workers.submit(workers.lend(10))
    for _ in range(5):
        workers.lend(10)  # a source that borrows is not told
    for _ in range(workers.waiting):
        with pytest.raises(CaptureError, match=f"a.mcap: {KILLED}"):
            workers.take()


@pytest.mark.long
@settings(max_examples=examples(15, 4))
@given(
    count=st.integers(1, 2),
    tasks=st.integers(1, 4),
    room=st.sampled_from([64, 4096]),
    slot=st.sampled_from([64, 4096]),
    steps=st.lists(st.tuples(st.booleans(), st.integers(0, 300), st.booleans()), max_size=40),
)
def test_each_answer_is_that_of_its_task(count, tasks, room, slot, steps):
    """Whatever is lent, too large for a room or a slot, or taken late."""
    with patch.multiple(module, ROOM_BYTES=room, SLOT_BYTES=slot):
        workers, expected = Workers(count, lambda data: data[::-1].copy(), GONE, tasks=tasks), deque()
        with closing(workers):
            workers.start()
            for number, (lends, size, takes) in enumerate(steps):
                while workers.full or (takes and workers.waiting):
                    assert workers.take().tolist() == expected.popleft()
                data = workers.lend(size) if lends else np.empty(size, np.uint8)
                data[:] = (np.arange(size) + number) % 251
                expected.append(data[::-1].tolist())
                workers.submit(data)
            while workers.waiting:
                assert workers.take().tolist() == expected.popleft()
        assert not expected


@pytest.mark.long
@settings(max_examples=examples(15, 4))
@given(
    tasks=st.integers(1, 4),
    room=st.sampled_from([64, 4096]),
    sizes=st.lists(st.integers(1, 300), min_size=1, max_size=30),
    late=st.sets(st.integers(0, 29)),
)
def test_what_a_process_reads_into_lent_memory_stays_until_the_next_task(tasks, room, sizes, late):
    """Each answer is where it was read, and shows the one before beside it."""

    class Reader:
        def set_up(self, desk):
            self.desk, self.number = desk, 0

        def next(self):
            data = self.desk.lend(sizes[self.number])
            data[:] = self.number % 251
            self.number = (self.number + 1) % len(sizes)
            return data, self.desk.awaited

    reader = Reader()
    with patch.multiple(module, ROOM_BYTES=room, SLOT_BYTES=1 << 12):
        workers = Workers(1, reader.next, GONE, set_up=reader.set_up, tasks=tasks)
        with closing(workers):
            workers.start()
            for number, size in enumerate(sizes):
                while not workers.full:
                    workers.submit()
                if number in late:
                    until(lambda: workers.ready)
                data, awaited = workers.take()
                assert data.tolist() == [number % 251] * size
                assert awaited in {True, False}
                lent = np.shares_memory(data, workers._memory._bytes[: workers._memory._rooms_end])
                assert lent == (size <= room)


def test_a_process_does_what_is_due_while_it_waits_and_at_the_end(tmp_path):
    class Keeper:
        def set_up(self, desk):
            self.idle_count = 0
            desk.idle, desk.end = self.idle, (tmp_path / "end").touch

        def idle(self):
            self.idle_count += 1
            (tmp_path / f"idle_{self.idle_count}").touch()
            return 0.01 if self.idle_count < 5 else None

        def count(self):
            return self.idle_count

    keeper = Keeper()
    with closing(Workers(1, keeper.count, GONE, set_up=keeper.set_up, tasks=1)) as workers:
        workers.start()
        until((tmp_path / "idle_5").exists)
        workers.submit()
        assert workers.take() == 5
        until((tmp_path / "idle_6").exists)
        assert not (tmp_path / "end").exists()
    assert (tmp_path / "end").exists()


def test_they_go_with_the_one_that_started_them():
    code = f"""
import sys, time
sys.path[:0] = {[str(Path(__file__).parents[up] / name) for up, name in ((0, "."), (1, "support"))]!r}
from test_processes import GONE, Workers, twice
workers = Workers(2, twice, GONE)
workers.start()
workers.submit(1, 60)
print(*workers.processes, flush=True)
time.sleep(60)
"""
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as starter:
        states = [Path(f"/proc/{number}/stat") for number in starter.stdout.readline().split()]
        assert len(states) == 2
        assert all(state.exists() for state in states)
        starter.kill()
    until(
        lambda: all(not state.exists() or state.read_text().split()[2] == "Z" for state in states),
        "a process is still there",
    )


def test_ctrl_c_is_heeded_by_the_one_that_asks(started, tmp_path):
    workers = started(lambda path: until(path.exists))
    workers.submit(tmp_path / "go on")
    for number in (signal.SIGINT, signal.SIGTERM):
        os.kill(workers.processes[0], number)

    def interrupted():
        threading.Timer(0.1, os.kill, (os.getpid(), signal.SIGINT)).start()
        workers.take()

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    (tmp_path / "go on").touch()
    assert workers.take()


def test_where_nobody_waits_for_processes(started):
    before = signal.signal(signal.SIGCHLD, signal.SIG_IGN)
    try:
        workers = started()
        workers.submit(1)
        assert workers.take()[1] == 2
        workers.close()
    finally:
        signal.signal(signal.SIGCHLD, before)


def test_files_of_the_one_that_started_them_are_not_kept_open(started):
    read, write = os.pipe()
    started(count=2)
    os.close(write)
    assert os.read(read, 1) == b""
    os.close(read)


def test_a_process_that_is_set_up_keeps_open_what_it_reads_and_not_what_others_write(tmp_path):
    (tmp_path / "in").write_bytes(b"data")
    with (tmp_path / "in").open("rb") as source, (tmp_path / "out").open("wb") as output:
        fcntl.flock(output, fcntl.LOCK_EX)
        read = partial(os.read, source.fileno(), 4)
        with closing(Workers(1, read, GONE, set_up=lambda _: None)) as workers:
            workers.start()
            workers.submit()
            assert workers.take() == b"data"
            output.close()
            with (tmp_path / "out").open("wb") as again:
                fcntl.flock(again, fcntl.LOCK_EX | fcntl.LOCK_NB)


def test_where_no_process_can_be_had(monkeypatch):
    monkeypatch.setattr(module.sys, "platform", "darwin")
    workers = Workers(1, twice, GONE)
    workers.start()
    assert workers.full
    workers.close()


def recorded(path, types, capture, jobs):
    """Record a capture read in small windows; return the bytes of the recording."""
    with closing(open_file(CAPTURES / f"{capture}.pcap")) as source:
        options = RecordingOptions(jobs=jobs)
        sink = McapSink(path, Mission(), types, source.info, options, statistics=source.statistics)
        assert (sink.room is None) == (jobs == 1)
        if sink.room:
            source.borrow(sink.room)
        decoder = ColumnDecoder(Context())
        for batch in source.batches():
            sink.write(batch, decoder.decode(batch))
        sink.close(source.statistics)
    return path.read_bytes()


@pytest.mark.long
@pytest.mark.parametrize("capture", long_but(["a_rover"], ["a_rover", "f_sbn"]))
@pytest.mark.parametrize(
    ("room", "slot", "large"),
    [
        (1 << 20, 1 << 20, 1),
        (1 << 20, 1 << 10, 1),  # columns do not fit and go through the socket
        (1 << 12, 1 << 20, 1),  # windows are too large to be lent
        (1 << 20, 1 << 20, 7 << 10),  # some batches are too small to be compressed on their own
    ],
)
def test_recordings_are_the_same(tmp_path, types, monkeypatch, capture, room, slot, large):
    names = {path.stem for path in CAPTURES.glob("*.pcap")}
    name = next(item for item in sorted(names) if item.startswith(capture[:2]))
    monkeypatch.setattr(capture_file, "FIRST", 3 << 10)
    monkeypatch.setattr(capture_file, "SLICE", 16 << 10)
    monkeypatch.setattr(writer, "_LARGE", large)
    monkeypatch.setattr(module, "ROOM_BYTES", room)
    monkeypatch.setattr(module, "SLOT_BYTES", slot)
    alone = recorded(tmp_path / "a.mcap", types, name, jobs=1)
    assert recorded(tmp_path / "b.mcap", types, name, jobs=3) == alone


def test_what_fails_is_not_waited_for_again(started):
    tasks = InOrder(refuse, started(refuse))
    tasks.add(1)
    with pytest.raises(MemoryError):
        list(tasks.results(0))
    assert list(tasks.results(0)) == []


@cache
def whole():
    """A capture in one batch, its columns, and how it was read."""
    bench = Settings([MISSIONS / "rover_ground.yaml"]).workbench()
    with closing(open_file(next(CAPTURES.glob("a_rover*.pcap")))) as source:
        batches = list(source.batches())
    assert len(batches) == 1
    return bench, source.info, batches[0], bench.columns.decode(batches[0])


def messages_of(cuts, *, large=1 << 30, jobs=1):
    """What a recording of it holds, in the order of the file, where it is written in pieces."""
    bench, info, batch, columns = whole()
    edges = [0, *sorted({cut for cut in cuts if cut < len(batch)}), len(batch)]
    with TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        patch.setattr(writer, "_LARGE", large)
        path = Path(folder) / "a.mcap"
        sink = McapSink(path, bench.mission, bench.types, info, RecordingOptions(jobs=jobs))
        for first, last in pairwise(edges):
            rows = slice(first, last)
            sink.write(batch.take(rows), columns.take(rows))
        sink.close(SourceStatistics())
        with path.open("rb") as file:
            return [
                (channel.topic, message.sequence, message.log_time, message.publish_time, message.data)
                for _, channel, message in make_reader(file).iter_messages(log_time_order=False)
            ]


@pytest.mark.long
@settings(max_examples=examples(10, part=3))
@given(st.lists(st.integers(1, 2000), max_size=9), st.sampled_from([1, 30_000]), st.sampled_from([1, 2, 3]))
def test_neither_cuts_nor_workers_change_a_message(cuts, large, jobs):
    assert messages_of(cuts, large=large, jobs=jobs) == uncut()


@cache
def uncut():
    return messages_of([])


def test_a_recording_whose_worker_was_killed_says_how_to_repair_it(
    tmp_path, types, mission, info, made_up, monkeypatch
):
    monkeypatch.setattr(writer, "_LARGE", 1)
    path = tmp_path / "a.mcap"
    sink = McapSink(path, mission, types, info, RecordingOptions(jobs=2))
    sink.write(*made_up(7, [100] * 300))
    sink.flush()
    os.kill(sink._workers.processes[0], signal.SIGKILL)

    def go_on():
        sink.write(*made_up(7, [100] * 300))
        sink.flush()

    with pytest.raises(CaptureError, match=f"{path}: {KILLED} {path}`"):
        go_on()
    sink.close(SourceStatistics())
    assert path.stat().st_size > 1000


@pytest.mark.parametrize(
    ("yields", "works", "spare", "crowded"),
    [
        (False, False, -5, False),
        (False, True, -5, False),
        (True, False, 1, False),
        (True, False, 0, True),  # it would be one more than there are processors
        (True, True, 0, False),  # it runs already
        (True, True, -1, True),
    ],
)
def test_processors_are_left_to_others(monkeypatch, yields, works, spare, crowded):
    monkeypatch.setattr(module, "spare_processors", lambda: spare)
    with closing(Workers(1, twice, GONE, yields=yields)) as workers:
        workers.start()
        (process,) = workers.processes
        os.kill(process, signal.SIGSTOP)  # so that it is not done too soon
        if works:
            workers.submit(1)
        assert not workers.crowded()
        assert workers.crowded() is crowded
        monkeypatch.setattr(module, "spare_processors", lambda: 1)
        assert not workers.crowded()
        monkeypatch.setattr(module, "spare_processors", lambda: spare)
        assert not workers.crowded()
        os.kill(process, signal.SIGCONT)


@pytest.mark.long
@pytest.mark.parametrize("spare", [[-1, -1, -1, -1], [1, -1, -1, 1], [1, 1, 1, 1]])
def test_a_recording_is_the_same_whether_it_yields(tmp_path, monkeypatch, spare):
    told = cycle(spare)
    monkeypatch.setattr(module, "spare_processors", lambda: next(told))
    for name in ("FIRST", "_SECOND_WINDOW", "SLICE"):
        monkeypatch.setattr(capture_file, name, 16 << 10)
    given = []
    submit = Workers.submit
    monkeypatch.setattr(Workers, "submit", lambda self, *values: given.append(1) or submit(self, *values))
    monkeypatch.setattr(writer, "_LARGE", 1)
    made, count = [], 0
    bench = Settings().workbench()
    for jobs in (1, 2):
        path = tmp_path / f"{jobs}.mcap"
        source = open_file(CAPTURES / "a_rover.pcap")
        options = RecordingOptions(jobs=jobs, yields=True)
        with closing(source):
            sink = McapSink(path, bench.mission, bench.types, source.info, options)
            for batch in source.batches():
                sink.write(batch, bench.columns.decode(batch))
                count += jobs > 1
            sink.close(SourceStatistics())
        made.append(path.read_bytes())
    assert made[0] == made[1]
    assert count > 10
    assert (len(given) > 1) == (max(spare) > 0)
    assert len(given) <= count - (min(spare) < 0)


def unread(link):
    return struct.unpack("i", fcntl.ioctl(link, termios.TIOCOUTQ, bytes(4)))[0]


@pytest.mark.parametrize("first", [3, 8, 500])
def test_a_value_that_a_signal_divides_is_whole(first):
    """As where the process is stopped and goes on: what came until then is returned at once."""
    here, there = socket.socketpair()
    value = list(range(1000))
    data = pickle.dumps(value, protocol=5)
    data = len(data).to_bytes(8, "big") + data
    handled, main = threading.Event(), threading.get_ident()

    def sender():
        there.sendall(data[:first])
        until(lambda: not unread(there), "the first part is taken")
        signal.pthread_kill(main, signal.SIGUSR1)
        assert handled.wait(20)
        there.sendall(data[first:])

    before = signal.signal(signal.SIGUSR1, lambda *_: handled.set())
    thread = threading.Thread(target=sender)
    try:
        with here, there:
            thread.start()
            found = receive(here)
            thread.join()
    finally:
        signal.signal(signal.SIGUSR1, before)
    assert handled.is_set()
    assert found == value


@pytest.mark.parametrize("kept", [0, 5, 8, 20])
def test_one_that_ends_early_is_told(kept):
    here, there = socket.socketpair()
    with here:
        with there:
            send(there, "a value")
        data = here.recv(100)
    here, there = socket.socketpair()
    with here:
        with there:
            there.sendall(data[:kept])
        with pytest.raises(EOFError):
            receive(here)
