"""What crosses a wire ends up in a recording, faults beside it."""

from __future__ import annotations

import contextlib
from pathlib import Path

import pytest
from mcap.reader import make_reader
from places import SAMPLES

from edoras_tools.errors import CaptureError
from edoras_tools.io.net.transmit import Arrival, SendStatistics
from edoras_tools.links.bare import CI, TO
from edoras_tools.mission import Mission
from edoras_tools.model import Endpoint
from edoras_tools.pipelines.capture.record import Target
from edoras_tools.pipelines.sending.loop import Sending, SendReport, SendSchedule
from edoras_tools.pipelines.sending.responses import Responses
from edoras_tools.pipelines.sending.run import SentRecording
from edoras_tools.pipelines.workbench import Settings, open_files
from edoras_tools.sessions.faults.rules import Fault
from edoras_tools.sessions.outgoing import Outgoing, Packet
from edoras_tools.sessions.pacing import Pacing
from edoras_tools.wire import cfe

HERE, THERE, TELEMETRY = (Endpoint("127.0.0.1", port) for port in (40000, 1234, 1235))
START_NS = 1_795_241_636_000_000_000
MS = 1_000_000
COMMANDS = [cfe.emit_command(0x1827, 1, bytes([index])) for index in range(5)]


class FakeWire:
    """Takes everything, and gives back what it was given."""

    def __init__(self, ends=(HERE, THERE)):
        self.ends, self.clock, self.sent, self.arrivals = ends, 0, [], []
        self.statistics = SendStatistics()

    def now(self):
        return self.clock

    def epoch_ns(self):
        return START_NS

    def wait(self, until_ns):
        self.clock = until_ns
        return True

    def send(self, out, first, last):
        self.sent += [out[index] for index in range(first, last)]
        return last - first

    def put(self, payload):
        self.sent.append(payload)
        return True

    def receive(self):
        arrived, self.arrivals = self.arrivals, []
        return arrived


@pytest.fixture
def bench():
    mission = SAMPLES / "missions/rover_ground.yaml"
    return Settings([mission]).workbench()


def recorded(path):
    source = open_files([path])
    found = []
    with contextlib.closing(source):
        for batch in source.batches():
            found += [batch[row] for row in range(len(batch))]
    return [(item.time_ns - START_NS, item.source, item.destination, item.payload) for item in found]


@pytest.mark.each(3)
@pytest.mark.parametrize("name", ["x.mcap", "x.pcapng", "x.pcap"])
def test_what_goes_out_and_what_comes_in_is_recorded(name, bench, tmp_path):
    wire = FakeWire()
    recording = SentRecording(wire, Target(tmp_path / name), bench)
    out = Outgoing.packets(CI, [Packet(item) for item in COMMANDS])
    assert recording.send(out, 0, 2) == 2
    recording.wait(10 * MS)
    assert recording.put(b"own session")
    answer = cfe.emit_telemetry(0x827, bytes(20))
    wire.arrivals = [Arrival(TO, answer, THERE, TELEMETRY)]
    assert recording.receive() == [(TO, answer, THERE, TELEMETRY)]
    recording.wait(500 * MS)
    recording.send(out, 2, 3)
    recording.close()
    assert wire.sent == [*COMMANDS[:2], b"own session", COMMANDS[2]]
    assert recorded(tmp_path / name) == [
        (0, HERE, THERE, COMMANDS[0]),
        (0, HERE, THERE, COMMANDS[1]),
        (10 * MS, HERE, THERE, b"own session"),
        (10 * MS, THERE, TELEMETRY, answer),
        (500 * MS, HERE, THERE, COMMANDS[2]),
    ]


def test_faults_are_recorded_as_what_they_are(bench, tmp_path):
    recording = SentRecording(FakeWire(), Target(tmp_path / "x.mcap"), bench)
    recording.note([Fault(START_NS, "drop", "dropped", COMMANDS[0], CI, to_cfs=True, msg_id=0x1827)])
    recording.put(COMMANDS[1])
    recording.close()
    with (tmp_path / "x.mcap").open("rb") as file:
        counts = [channel.topic for _, channel, _ in make_reader(file).iter_messages()]
    assert counts.count("/edoras/faults") == 1
    assert counts.count("/edoras/datagrams") == 1


def test_much_is_written_before_the_end(bench, tmp_path, monkeypatch):
    monkeypatch.setattr("edoras_tools.pipelines.sending.run._MOST", 3)
    recording = SentRecording(FakeWire(), Target(tmp_path / "x.pcap"), bench)
    for payload in COMMANDS:
        recording.put(payload)
    recording.close()
    assert [payload for *_, payload in recorded(tmp_path / "x.pcap")] == COMMANDS


class LookingWire(FakeWire):
    """Looks into the file at each datagram, as if the program was killed then: how old is what is missing?"""

    path, worst_ns, each_ns = None, 0, 0

    def wait(self, until_ns):
        self.clock = max(self.clock, until_ns)
        return True

    def send(self, out, first, last):
        self.clock += self.each_ns * (last - first)
        times = [time_ns for time_ns, *_ in recorded(self.path)] if self.path.stat().st_size > 24 else []
        if len(times) < len(self.sent):
            self.worst_ns = max(self.worst_ns, self.clock - self.sent[len(times)])
        self.sent += [self.clock] * (last - first)
        return last - first


@pytest.mark.long
@pytest.mark.parametrize(
    ("pacing", "count"),
    [
        (Pacing(rate_hz=5), 20),
        (Pacing(rate_hz=30), 60),
        (Pacing(rate_hz=400), 400),
        (Pacing(unpaced=True), 8000),
    ],
)
def test_what_was_sent_is_in_the_file_within_a_second_at_any_rate(pacing, count, bench, tmp_path):
    """A replay that is killed loses what is not in the file: there too where something is always due."""
    wire = LookingWire()
    wire.path, wire.each_ns = tmp_path / "x.pcap", MS // 10 if pacing.unpaced else 0
    recording = SentRecording(wire, Target(wire.path), bench)
    out = Outgoing.packets(CI, [Packet(COMMANDS[0])] * count)
    table = pacing.timetable(out.time_ns, out.msg_id)
    report = SendReport(Responses(Mission()), count, table.rate_hz)
    Sending(recording, SendSchedule("there", out, table), report).run()
    recording.close()
    assert (report.failure, report.sent, len(recorded(wire.path))) == (None, count, count)
    assert wire.worst_ns <= 250 * MS


def test_what_cannot_be_recorded_is_said_first(bench, tmp_path):
    with pytest.raises(CaptureError, match="No such file"):
        SentRecording(FakeWire(), Target(Path("/proc/no/where.pcap")), bench)


def test_ipv6_is_recorded_too(bench, tmp_path):
    ends = Endpoint("::1", 1), Endpoint("::1", 2)
    recording = SentRecording(FakeWire(ends), Target(tmp_path / "x.pcap"), bench)
    recording.put(COMMANDS[0])
    recording.close()
    assert recorded(tmp_path / "x.pcap") == [(0, *ends, COMMANDS[0])]
