"""What a proxy records: what was sent, and what was done on purpose, each as what it is."""

from __future__ import annotations

import os
import signal
import time

import pytest
from children import children
from mcap.reader import make_reader
from waiting import HOST, arrived_at, receive, until

from edoras_tools.addons.proxy.plan import as_relayed
from edoras_tools.errors import CaptureError
from edoras_tools.io import Sink
from edoras_tools.links.bare import CI
from edoras_tools.model import Endpoint, SourceStatistics
from edoras_tools.pipelines import recorder as relay_recorder
from edoras_tools.pipelines.capture.record import Target
from edoras_tools.pipelines.recorder import Recorded, RelayRecorder, Tee
from edoras_tools.pipelines.workbench import Settings, open_files
from edoras_tools.ros import TypeStore
from edoras_tools.wire import cfe


def numbered(count, size=12):
    return [
        cfe.emit_command(0x1827, 1, number.to_bytes(4, "big") + bytes(size - 4)) for number in range(count)
    ]


# From Python 3.12 on forking beside threads is warned of.
pytestmark = pytest.mark.filterwarnings("ignore:.*multi-threaded, use of fork:DeprecationWarning")


def recorder(path, targets, **options):
    bench = as_relayed(Settings(), CI, Endpoint(*targets[0].getsockname())).workbench()
    return lambda: RelayRecorder(Target(path), bench, "test", **options)


def recorded(path, port):
    """Datagrams as payload, source port and destination port; and faults."""
    settings = as_relayed(Settings(), CI, Endpoint(HOST, port))
    source = open_files([path])
    datagrams = []
    for batch in source.batches():
        columns = settings.workbench().columns.decode(batch)
        for row in range(len(batch)):
            item = batch[row]
            datagrams.append((item.payload, item.source.port, item.destination.port, int(columns.link[row])))
    source.close()
    types = TypeStore()
    with path.open("rb") as file:
        faults = [
            types.decode(schema.name, message.data)
            for schema, _, message in make_reader(file).iter_messages(["/edoras/faults"])
        ]
    return datagrams, faults


@pytest.mark.each(2)
@pytest.mark.quick("plain-True", "vectors-False")
@pytest.mark.parametrize("apart", [False, True])
def test_a_recording_holds_what_was_sent_and_what_was_done_on_purpose(ends, tmp_path, arena, apart):
    target, path = ends.port(), tmp_path / "a.mcap"
    rules = ["drop:0.2", "corrupt:0.2", "duplicate:0.1"]
    proxy = ends.proxy(target, rules=rules, recorder=recorder(path, [target], apart=apart))
    client = ends.client(proxy)
    before, arrived = time.time_ns(), []
    for first in range(0, 600, 60):
        for datagram in numbered(600)[first : first + 60]:
            client.send(datagram)
        until(lambda first=first: proxy.to_target[0].received == first + 60)
        arrived += arrived_at(target)
    target.sendto(b"answer", next(iter(proxy.clients)).sockets[0].getsockname())
    client.recv(99)
    until(lambda: proxy.summary()["recorded"] > 100)  # also of a second process, while it writes
    proxy.end()
    arrived += arrived_at(target)
    ports = client.getsockname()[1], target.getsockname()[1]
    datagrams, faults = recorded(path, ports[1])
    assert datagrams[:-1] == [(data, *ports, CI) for data in arrived]
    assert datagrams[-1][:3] == (b"answer", *reversed(ports))
    kinds = [fault["kind"] for fault in faults]
    assert {kind: kinds.count(kind) for kind in ("drop", "corrupt", "duplicate")} == {
        rule.kind.name: struck for rule, struck in zip(proxy.machine.rules, proxy.machine.struck, strict=True)
    }
    # What was sent, with what was lost on purpose put back and what was done on purpose undone, is what came.
    changed = [bytes(fault["original"]) for fault in faults if fault["kind"] in {"drop", "corrupt"}]
    assert set(numbered(600)) <= {*arrived, *changed}
    stamps = [fault["stamp"]["sec"] * 10**9 + fault["stamp"]["nanosec"] for fault in faults]
    assert before <= min(stamps)
    assert max(stamps) <= time.time_ns()
    assert {fault["rule"] for fault in faults} == set(rules)
    assert proxy.summary()["recorded"] == len(datagrams)


def test_what_could_not_be_recorded_is_counted_and_relayed_all_the_same(ends, tmp_path, monkeypatch):
    monkeypatch.setattr(relay_recorder, "_QUEUE_BYTES", -1)
    target = ends.port()
    proxy = ends.proxy(target, recorder=recorder(tmp_path / "a.mcap", [target]))
    client = ends.client(proxy)
    for datagram in numbered(10):
        client.send(datagram)
    assert receive(target, 10) == numbered(10)
    proxy.end()
    assert proxy.summary()["unrecorded"] == proxy.lost == 10


@pytest.mark.parametrize(
    ("failure", "told"),
    [
        (CaptureError("a.mcap: no space left"), "a.mcap: no space left"),
        (KeyError("x"), "{path}: the recording ended by an internal error: KeyError('x')"),
    ],
)
def test_a_recording_that_fails_is_told_and_the_relay_goes_on(ends, tmp_path, monkeypatch, failure, told):
    target = ends.port()
    proxy = ends.proxy(target, recorder=recorder(tmp_path / "a.mcap", [target]))

    def fail(*_):
        raise failure

    monkeypatch.setattr(proxy.recorder._writer._sink, "write", fail)
    client = ends.client(proxy)
    for _ in range(2):
        client.send(b"x" * 8)
        assert target.recv(99) == b"x" * 8
        until(lambda: proxy.recorder.failure is not None)
    proxy.end()
    assert str(proxy.recorder.failure) == told.format(path=tmp_path / "a.mcap")


def test_a_second_process_that_is_killed_is_told_and_the_relay_goes_on(ends, tmp_path):
    target = ends.port()
    proxy = ends.proxy(target, recorder=recorder(tmp_path / "a.mcap", [target], apart=True))
    os.kill(proxy.recorder._writer._workers.processes[0], signal.SIGKILL)
    client = ends.client(proxy)
    for _ in range(2):
        client.send(b"x" * 8)
        assert target.recv(99) == b"x" * 8
        until(lambda: proxy.recorder.failure is not None)
    proxy.end()
    assert "the process that wrote it was killed" in str(proxy.recorder.failure)
    assert proxy.summary()["recorded"] == 0


def test_what_a_second_process_cannot_write_is_told_at_once(ends, tmp_path):
    (tmp_path / "file").touch()
    before = children()
    with pytest.raises(CaptureError, match="cannot be created"):
        ends.proxy(ends.port(), recorder=recorder(tmp_path / "file" / "a.mcap", [ends.port()], apart=True))
    assert children() <= before


def test_a_second_process_that_cannot_flush_writes_no_more_and_closes(tmp_path):
    class Full:
        wait_s, recorded = 0.01, Recorded(7)

        def flush_if_due(self):
            (tmp_path / "look").touch()
            raise CaptureError("a.mcap: no space left")

        def write(self, _):
            (tmp_path / "write").touch()

        def close(self, kernel_drops):
            (tmp_path / "close").write_text(str(kernel_drops))

    before = children()
    writer = relay_recorder._WriterApart(Full, tmp_path / "a.mcap")
    until((tmp_path / "look").exists)
    for work in (lambda: writer.write(relay_recorder._Page()), lambda: writer.close(3)):
        with pytest.raises(CaptureError, match=r"^a.mcap: no space left$"):
            work()
    assert writer.recorded == Recorded(7)
    assert (tmp_path / "close").read_text() == "3"
    assert not (tmp_path / "write").exists()
    assert children() <= before


class Written(Sink):
    def __init__(self, failure=None):
        self.calls = []
        self._failure = failure

    def write(self, batch, columns):
        self.calls.append(("write", batch, columns))

    def flush(self):
        self.calls.append("flush")

    def close(self, statistics):
        self.calls.append(("close", statistics))
        if self._failure:
            raise self._failure


class Faulty(Written):
    def write_faults(self, faults):
        self.calls.append(("faults", faults))


def test_all_get_everything_that_they_can_hold():
    plain, faulty, statistics = Written(), Faulty(), SourceStatistics()
    tee = Tee([plain, faulty])
    tee.write("batch", "columns")
    tee.write_faults(["fault"])
    tee.flush()
    tee.close(statistics)
    common = [("write", "batch", "columns"), "flush", ("close", statistics)]
    assert plain.calls == common
    assert faulty.calls == [common[0], ("faults", ["fault"]), *common[1:]]


def test_all_are_closed_whatever_becomes_of_one():
    one, other = Written(CaptureError("full")), Written(CaptureError("gone"))
    with pytest.raises(CaptureError):
        Tee([one, other]).close(SourceStatistics())
    assert one.calls
    assert other.calls
