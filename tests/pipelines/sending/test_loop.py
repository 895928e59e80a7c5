"""The sending loop in simulated time: against an emulated cFS, and against nobody."""

from __future__ import annotations

from collections import Counter
from itertools import chain

import numpy as np
import pytest
from msgspec.structs import replace
from places import SAMPLES

from edoras_tools.addons.lab.emulator import Simulation
from edoras_tools.cfs.profile import SimProfile
from edoras_tools.errors import CaptureError
from edoras_tools.io.net.transmit import Arrival, SendStatistics
from edoras_tools.links.bare import CI, TO
from edoras_tools.links.sbn import SBN
from edoras_tools.mission import Mission
from edoras_tools.model import Endpoint, Peer
from edoras_tools.pipelines.sending.loop import (
    Condition,
    Sending,
    SendReport,
    SendSchedule,
    conditions,
    count_known,
    enable_output,
    in_order,
)
from edoras_tools.pipelines.sending.options import Receiver, Role, SendOptions
from edoras_tools.pipelines.sending.replay import ReplaySelection, load_datagrams
from edoras_tools.pipelines.sending.responses import Responses
from edoras_tools.pipelines.workbench import Settings, open_files
from edoras_tools.sessions.outgoing import Changes, Outgoing, Packet, SequenceRule
from edoras_tools.sessions.pacing import Pacing
from edoras_tools.sessions.sbn import SbnConnection
from edoras_tools.units import MILLISECOND, SECOND
from edoras_tools.wire import cfe, sbn

SCHEDULED = ("changes", "passes", "paused", "linger_ns")
LOST = "CFE_SB 17: Msg Limit Err,MsgId 0x1827,pipe EDORAS_APP_PIPE,sender CI_LAB_APP"


class SimulatedWire:
    """An emulated cFS instead of sockets, its clock instead of the host's."""

    def __init__(self, simulation, target, links):
        self.simulation, self.target, self.links = simulation, target, links
        self.statistics = SendStatistics()
        self.sent = []
        self._arrived = []

    def now(self):
        return self.simulation.now

    def epoch_ns(self):
        return 0

    def wait(self, until_ns):
        for item in self.simulation.run(until_ns):
            link = self.links.get(item.destination.port)
            if link is not None:
                self._arrived.append(Arrival(link, item.payload, item.source, item.destination))
                return False
        return True

    def put(self, payload):
        self.sent.append((self.now(), payload))
        self.simulation.feed(self.now(), self.target, payload)
        self.statistics.sent += 1
        return True

    def send(self, out, first, last):
        return sum(self.put(out[index]) for index in range(first, last))

    def receive(self):
        arrived, self._arrived = self._arrived, []
        return arrived


class DeafWire(SimulatedWire):
    """Nobody there: time passes, and everything is taken."""

    def __init__(self, refuses=False):
        self.statistics = SendStatistics()
        self.sent, self.clock, self.refuses = [], 0, refuses

    def now(self):
        return self.clock

    def wait(self, until_ns):
        self.clock = max(self.clock, until_ns)
        return True

    def put(self, payload):
        self.sent.append((self.clock, payload))
        self.statistics.refused += self.refuses
        return True

    def receive(self):
        return []


@pytest.fixture(scope="module")
def rover():
    bench = Settings((SAMPLES / "missions/rover_ground.yaml",)).workbench()
    options = SendOptions().placed(bench.mission)
    source = open_files([SAMPLES / "captures/a_rover.pcap"])
    return load_datagrams(source, bench, options, ReplaySelection()).out, bench.mission


def run(wire, out, mission=None, pacing=None, **options):
    table = (pacing or Pacing()).timetable(out.time_ns, out.msg_id)
    report = SendReport(Responses(mission or Mission()), len(out), table.rate_hz)
    asked = options.pop("wait_for", ())
    timeout_ns = options.pop("timeout_ns", 10 * SECOND)
    given = {name: options.pop(name) for name in SCHEDULED if name in options}
    schedule = SendSchedule("there", in_order(out, table), table, **given)
    return Sending(wire, schedule, report, **options).run(asked, timeout_ns)


def booted(scenario, profile=None):
    return Simulation(profile, scenario=scenario, bridges=False).boot()


def test_the_rover_s_commands_lose_as_many_as_the_real_one_did(rover, captured_commands):
    out, mission = rover
    simulation = booted("rover")
    wire = SimulatedWire(simulation, simulation.cfs.ci_endpoint, {1235: TO})
    report = run(wire, out, mission, linger_ns=3 * SECOND)
    assert [payload for _, payload in wire.sent] == captured_commands
    assert sum(payload[:2] == b"\x18\x27" for _, payload in wire.sent) == 600
    lost = 600 - simulation.apps.edoras.robot_commands
    assert 70 <= lost <= 120  # 92 in flight
    assert report.responses.lost == lost
    assert report.responses.summary()["counters"]["message_limit_error_counter"]["gained"] == lost
    assert report.responses.events[LOST].count == 16
    assert (report.sent, report.send_errors, report.failure) == (601, 0, None)
    assert report.lateness.max_ns == 0


def test_at_8_hz_none_is_lost(rover):
    out, mission = rover
    simulation = booted("rover")
    wire = SimulatedWire(simulation, simulation.cfs.ci_endpoint, {1235: TO})
    report = run(wire, out, mission, Pacing(rate_hz=8), linger_ns=3 * SECOND)
    assert simulation.apps.edoras.robot_commands == 600
    assert report.responses.lost == 0
    assert report.achieved_hz == pytest.approx(8, abs=1e-6)


@pytest.fixture(scope="module")
def captured_commands():
    """The payloads of a_rover towards port 1234, read without any of the code under test."""
    data, at, found = (SAMPLES / "captures/a_rover.pcap").read_bytes(), 24, []
    while at < len(data):
        length = int.from_bytes(data[at + 8 : at + 12], "little")
        frame = data[at + 16 : at + 16 + length]
        at += 16 + length
        if frame[36:38] == (1234).to_bytes(2, "big"):
            found.append(frame[42 : 42 + int.from_bytes(frame[38:40], "big") - 8])
    return found


def test_the_bridge_of_f_connects_times_out_and_comes_back_as_it_did():
    missions = [SAMPLES / f"missions/two_rovers_{side}.yaml" for side in ("ground", "flight")]
    bench = Settings(missions).workbench()
    options = SendOptions(to=Receiver.SBN, role=Role.CAPTURED).placed(bench.mission)
    out = load_datagrams(
        open_files([SAMPLES / "captures/f_sbn_disconnect.pcap"]), bench, options, ReplaySelection()
    ).out
    assert len(out) == 398  # everything from port 2236 to 2234, malformed ones too
    simulation = booted("two-rovers")
    before = len(simulation.cfs.console)
    wire = SimulatedWire(simulation, simulation.cfs.sbn_endpoint, {2236: SBN})
    report = run(wire, out, bench.mission, linger_ns=SECOND)
    begin = wire.sent[0][0] / SECOND
    told = [
        (time_ns / SECOND - begin, text.partition("66/1/SBN ")[2])
        for time_ns, text in list(simulation.cfs.console)[before:]
        if "connect" in text and "SBN" in text
    ]
    up = ["259: connecting to peer 66:3", "5: Peer 66:3 connected."]
    gone = ["259: disconnected peer 66:3", "5: Disconnected from peer 66:3."]
    assert [text for _, text in told] == [*up, *gone, *up, "5: Disconnected from peer 66:3.", *up]
    for seconds, flight in zip([told[0][0], told[2][0], told[4][0]], [0.0, 26.835, 31.602], strict=True):
        assert seconds == pytest.approx(flight, abs=0.3)  # the console of the real one, from its connect
    assert report.responses.network["PROTO"] == 3
    assert set(report.responses.network) == {"HEARTBEAT", "PROTO", "SUB"}


def test_a_session_shakes_hands_keeps_alive_and_says_goodbye():
    simulation = booted("two-rovers")
    wire = SimulatedWire(simulation, simulation.cfs.sbn_endpoint, {2236: SBN})
    peer = Peer(0x42, 3)
    packets = [Packet(cfe.emit_command(0x1829, 1, bytes(80)), time_ns=n * 20 * SECOND) for n in range(3)]
    out = Outgoing.packets(SBN, packets, sender=peer)
    session = SbnConnection(peer, [0x82A], now=wire.now())
    report = run(
        wire,
        out,
        session=session,
        wait_for=[Condition("peer", lambda: session.connected and 0x1829 in session.subscribed, str)],
    )
    kinds = [payload[2] for _, payload in wire.sent]
    assert kinds[:2] == [sbn.MsgType.PROTO, sbn.MsgType.SUB]
    assert kinds.index(sbn.MsgType.APP) >= 2
    assert kinds.count(sbn.MsgType.APP) == report.sent == 3
    assert kinds.count(sbn.MsgType.HEARTBEAT) >= 5  # 40 s, one every 6
    assert kinds[-1] == sbn.MsgType.DISCONNECT
    gaps = np.diff([time_ns for time_ns, _ in wire.sent])
    assert gaps.max() < 7 * SECOND
    told = [text for _, text in simulation.cfs.console if "onnected" in text and "66:3" in text]
    assert [text.partition("SBN ")[2] for text in told] == ["5: Peer 66:3 connected."]
    list(simulation.run(simulation.now + SECOND))
    assert any(text.endswith("SBN 5: Disconnected from peer 66:3.") for _, text in simulation.cfs.console)


def plain(count, step_ns=10 * MILLISECOND):
    return Outgoing.packets(
        CI, [Packet(cfe.emit_command(0x1827, n % 128), time_ns=n * step_ns) for n in range(count)]
    )


def codes(wire):
    return [payload[6] for _, payload in wire.sent]


def test_deadlines_are_absolute_and_passes_follow_on():
    wire = DeafWire()
    report = run(wire, plain(4), pacing=Pacing(speed=2), passes=3)
    times = [time_ns for time_ns, _ in wire.sent]
    assert np.diff(times).tolist() == [5 * MILLISECOND] * 11
    assert codes(wire) == [0, 1, 2, 3] * 3
    assert (report.sent, report.achieved_hz, report.lateness.count) == (12, 200.0, 12)


def test_counts_go_on_over_passes_and_stamps_are_new():
    wire = DeafWire()
    run(wire, plain(2), passes=3, changes=Changes(sequence=SequenceRule.COUNT))
    assert [int.from_bytes(payload[2:4], "big") & 0x3FFF for _, payload in wire.sent] == list(range(6))


def test_as_fast_as_it_goes_nothing_is_waited_for_and_nothing_is_late():
    wire = DeafWire()
    report = run(wire, plain(2000), pacing=Pacing(unpaced=True))
    assert len(wire.sent) == 2000
    assert wire.sent[-1][0] == wire.sent[0][0]
    assert report.lateness.count == 0
    assert report.asked_hz is None


def test_what_is_overdue_leaves_at_once_and_is_late():
    class Sleepy(DeafWire):
        def wait(self, until_ns):
            self.clock = max(self.clock, until_ns) + 35 * MILLISECOND
            return True

    wire = Sleepy()
    report = run(wire, plain(8))
    assert codes(wire) == list(range(8))
    assert report.lateness.count == 8
    assert report.lateness.max_ns >= 35 * MILLISECOND


class Keyboard:
    """Keys that are pressed at times of the wire's clock."""

    def __init__(self, wire, script):
        self.wire, self.script = wire, list(script)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def pressed(self):
        keys = "".join(key for when, key in self.script if when <= self.wire.clock)
        self.script = [item for item in self.script if item[0] > self.wire.clock]
        return keys


def test_step_by_step_until_space_lets_it_run():
    wire = DeafWire()
    keys = Keyboard(wire, [(SECOND, "n"), (2 * SECOND, "n"), (3 * SECOND, " ")])
    run(wire, plain(6), keys=keys, paused=True)
    times = [time_ns for time_ns, _ in wire.sent]
    assert codes(wire) == list(range(6))
    for place, second in ((0, 1), (1, 2), (2, 3)):
        assert times[place] == pytest.approx(second * SECOND, abs=25 * MILLISECOND)
    assert np.diff(times[2:]).tolist() == [10 * MILLISECOND] * 3


def test_q_ends_it_and_the_report_is_there():
    wire = DeafWire()
    report = run(wire, plain(1000), keys=Keyboard(wire, [(SECOND, "q")]))
    assert 90 <= report.sent <= 110
    assert report.interrupted
    assert report.failure is None


def test_a_target_that_refuses_at_the_start_is_not_there():
    wire = DeafWire(refuses=True)
    report = run(wire, plain(1000))
    assert isinstance(report.failure, CaptureError)
    assert "there refuses: no program listens there" in str(report.failure)
    assert report.sent == 0
    assert report.errors == {"Connection refused": len(wire.sent)}
    assert 0 < report.send_errors < 10


def test_nothing_arrived_where_the_kernel_kept_one_refusal_of_many():
    class BurstWire(DeafWire):
        """ICMP errors of datagrams that leave together overwrite each other."""

        def send(self, out, first, last):
            sent = super().send(out, first, last)
            self.statistics.refused = 1
            return sent

    wire = BurstWire()
    report = run(wire, plain(1000), pacing=Pacing(unpaced=True))
    assert report.failure is not None
    assert (report.sent, report.errors) == (0, {"Connection refused": len(wire.sent)})
    assert len(wire.sent) > 1


def test_what_is_refused_later_on_is_not_sent():
    class LeftWire(DeafWire):
        """Who receives goes after five seconds."""

        def put(self, payload):
            self.refuses = self.clock > 5 * SECOND
            return super().put(payload)

    wire = LeftWire()
    report = run(wire, plain(1000))
    assert report.failure is None
    assert 490 <= report.sent <= 510
    assert report.sent + report.send_errors == len(wire.sent) == 1000


def test_a_condition_that_is_not_met_says_what_was_tried():
    asked = []
    condition = Condition(
        "never", lambda: False, lambda seconds: f"not within {seconds:.0f} s", lambda: asked.append(1)
    )
    wire = DeafWire()
    report = run(wire, plain(3), wait_for=[condition], timeout_ns=5 * SECOND)
    assert str(report.failure) == "not within 5 s"
    assert (report.sent, wire.sent, len(asked)) == (0, [], 5)


@pytest.mark.parametrize("wanted", [("to-enabled",), ("to-enabled", "event:telemetry output enabled")])
def test_telemetry_is_enabled_before_the_first_command(wanted, rover):
    simulation = booted("rover")
    wire = SimulatedWire(simulation, simulation.cfs.ci_endpoint, {1235: TO})
    options = SendOptions(wait_for=wanted).placed(Mission())
    out = plain(1)
    seen = Responses(Mission())
    report = SendReport(seen, 1, None)
    table = Pacing().timetable(out.time_ns)
    opened = conditions(
        out, options, Mission(), responses=seen, session=None, wire=wire, local=Endpoint("127.0.0.1", 1235)
    )
    Sending(wire, SendSchedule("there", out, table), report).run(opened)
    first = wire.sent[0][1]
    assert (first[:2], first[6], first[8:17]) == (b"\x18\x80", 6, b"127.0.0.1")
    assert wire.sent[-1][1] == out[0]
    assert seen.says("telemetry output enabled")


def follow(simulation, out, **options):
    """Send into an emulated CI, as fast as possible, and follow its count."""
    wire = SimulatedWire(simulation, simulation.cfs.ci_endpoint, {1235: TO})
    options = SendOptions(**options).placed(Mission())
    table = Pacing(unpaced=True).timetable(out.time_ns)
    report = SendReport(Responses(Mission()), len(out), None, to_ci=options.follows_ci)
    opened = conditions(
        out,
        options,
        Mission(),
        responses=report.responses,
        session=None,
        wire=wire,
        local=Endpoint("127.0.0.1", 1235),
    )
    schedule = SendSchedule("there", out, table, linger_ns=options.linger_ns, follow_ns=options.follow_ns)
    return Sending(wire, schedule, report).run(
        chain(opened, count_known(out, options, report.responses, wire))
    )


def test_listening_goes_on_until_ci_has_read_everything():
    simulation = booted("rover")
    report = follow(simulation, plain(100), wait_for=("to-enabled",))
    assert simulation.apps.ci.socket_drops == 0
    assert len(simulation.apps.ci.queue) == 0
    assert report.responses.ingest.summary() == {"state": "all", "sent": 100, "read": 100, "missing": 0}
    assert 4 * SECOND < simulation.now - report.last_ns < 8 * SECOND  # 100 at 11 each half second


def test_ci_may_report_each_four_seconds_as_cfs_comes():
    simulation = booted("rover", replace(SimProfile(), housekeeping_ns=4 * SECOND))
    for wait_for in (("to-enabled",), ()):
        report = follow(simulation, plain(20), wait_for=wait_for)
        assert report.responses.ingest.summary() == {"state": "all", "sent": 20, "read": 20, "missing": 0}


def test_what_never_came_to_ci_is_counted():
    simulation = booted("rover")
    report = follow(simulation, plain(400), wait_for=("to-enabled",))
    dropped = simulation.apps.ci.socket_drops
    assert dropped > 100
    summary = report.responses.ingest.summary()
    assert summary == {"state": "missing", "sent": 400, "read": 400 - dropped, "missing": dropped}
    assert report.lost == dropped + report.responses.lost


def test_a_time_to_listen_that_is_named_is_kept_and_what_is_unread_is_said():
    simulation = booted("rover")
    report = follow(simulation, plain(100), wait_for=("to-enabled",), linger_ns=2 * SECOND)
    summary = report.responses.ingest.summary()
    assert summary["state"] == "waiting"
    assert 0 < summary["read"] < 100
    assert summary["missing"] is None
    assert simulation.now - report.last_ns < 2 * SECOND + 100 * MILLISECOND


def test_without_telemetry_it_waits_for_one_report_and_says_nothing_of_ci():
    simulation = booted("rover")
    began = simulation.now
    report = follow(simulation, plain(3))
    assert 4 * SECOND < report.first_ns - began < 5 * SECOND
    assert report.responses.ingest.summary()["state"] == "unknown"
    assert simulation.now - report.last_ns < 2 * SECOND + 100 * MILLISECOND
    simulation = booted("rover")
    began = simulation.now
    assert follow(simulation, plain(3), wait_for=("nothing",)).first_ns - began < 100 * MILLISECOND


@pytest.mark.parametrize(
    ("packets", "options", "least_s"),
    [
        ([enable_output("127.0.0.1")], {}, 0),
        ([enable_output("127.0.0.1")] * 2, {}, 4),
        ([cfe.emit_command(0x1880, 0)], {}, 0),
        ([cfe.emit_command(0x1827, 6)], {}, 0),
        ([cfe.emit_command(0x1827, 6)], {"max_loss": 0.0}, 4),
        ([cfe.emit_command(0x1827, 6)], {"expect": ("event:X",)}, 4),
    ],
    ids=["enables", "twice", "other command", "message", "judged", "expected"],
)
def test_without_telemetry_only_what_is_judged_waits_for_a_count(packets, options, least_s):
    simulation = booted("rover")
    began = simulation.now
    report = follow(simulation, Outgoing.packets(CI, [Packet(packet) for packet in packets]), **options)
    assert least_s * SECOND < report.first_ns - began < (least_s + 0.5) * SECOND
    assert report.responses.ingest.summary()["state"] == "unknown"


def test_a_single_datagram_leaves_at_once_and_is_followed_if_it_is_judged():
    simulation = booted("rover", replace(SimProfile(), housekeeping_ns=SECOND))
    follow(simulation, plain(1), wait_for=("to-enabled",))
    began = simulation.now
    assert follow(simulation, plain(1)).first_ns - began < 100 * MILLISECOND
    report = follow(simulation, plain(1), max_loss=0.0)
    assert report.responses.ingest.summary() == {"state": "all", "sent": 1, "read": 1, "missing": 0}


class Scripted:
    """A fault machine: drops the second of three, holds the third back."""

    def __init__(self):
        self.count, self.held = 0, []

    @property
    def next_ns(self):
        return min((due for due, _ in self.held), default=None)

    def due(self, now):
        ready = [item for item in self.held if item[0] <= now]
        self.held = [item for item in self.held if item[0] > now]
        return [Delivery(*item) for item in ready]

    def apply(self, payload, *, link, to_cfs, now):
        assert (link, to_cfs) == (CI, True)
        self.count += 1
        if self.count % 3 == 2:
            return [], [Named("drop")]
        if self.count % 3 == 0:
            self.held.append((now + 25 * MILLISECOND, payload))
            return [], [Named("delay")]
        return [Delivery(now, payload)], []


class Named:
    def __init__(self, kind):
        self.kind = kind


class Delivery:
    def __init__(self, due_ns, payload):
        self.due_ns, self.payload = due_ns, payload


def test_faults_drop_and_delay_what_is_sent():
    wire = DeafWire()
    report = run(wire, plain(6), faults=Scripted())
    assert codes(wire) == [0, 3, 2, 5]
    start = wire.sent[0][0]
    assert [(time_ns - start) // MILLISECOND for time_ns, _ in wire.sent] == [0, 30, 45, 75]
    assert (report.sent, report.faults) == (4, {"drop": 2, "delay": 2})


def test_rows_go_in_the_order_of_their_deadlines():
    out = plain(3)
    table = Pacing().timetable(out.time_ns)._replace(order=np.array([2, 0, 1]))
    assert [in_order(out, table)[row][6] for row in range(3)] == [2, 0, 1]
    assert Counter(out.msg_id.tolist()) == {0x1827: 3}
