"""What the demos are put together from."""

from __future__ import annotations

import threading
import time
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from waiting import PATIENCE_S, until

from edoras_tools.addons.lab.demo.local_graph import open_graph
from edoras_tools.addons.lab.demo.nodes import (
    CallScheduler,
    Leg,
    RobotState,
    Trace,
    commands,
    free_ports,
    lanes_of,
    profile,
    write_missions,
)
from edoras_tools.addons.lab.emulator import MISSIONS, WireDatagram
from edoras_tools.cfs.profile import Ports
from edoras_tools.errors import CaptureError
from edoras_tools.mission import load
from edoras_tools.model import Endpoint, Peer
from edoras_tools.ros import TypeStore
from edoras_tools.wire import cfe, envelope, sbn

PORTS = Ports(40001, 40002, 40003, 40004)
ANYWHERE = Endpoint("127.0.0.1", 1)
TYPES = TypeStore()
CDR = bytes.fromhex("00010000") + bytes(range(48))
PEER = Peer(0x42, 3)


def lanes(scenario, folder):
    return lanes_of(scenario, load(write_missions(scenario, folder, PORTS, 30)).bridges)


@pytest.mark.parametrize("scenario", MISSIONS)
def test_files_name_the_ports_and_loopback_only(scenario, tmp_path):
    mission = load(write_missions(scenario, tmp_path, PORTS, 12.5))
    ground, *flight = mission.links
    assert (ground.fsw_port, ground.bridge_port) == (PORTS.ci, PORTS.to)
    assert ground.telemetry_ip == ground.bridge_ip == ground.fsw_ip == "127.0.0.1"
    for link in flight:
        assert (link.peer_port, link.udp_receive_port) == (PORTS.sbn, PORTS.peer)
        assert link.udp_receive_ip == link.peer_ip == "127.0.0.1"
    limits = {
        route.handling.max_rate for bridge in mission.bridges[1:] for route in bridge.routes if route.to_cfs
    }
    assert limits == ({12.5} if flight else set())
    assert mission.warnings == ()


def test_without_a_limit_the_files_have_none(tmp_path):
    mission = load(write_missions("two-arms", tmp_path, PORTS, 0))
    assert {route.handling.max_rate for route in mission.routes} == {None}


def test_the_robots_are_those_of_the_paper(tmp_path):
    assert [lane.robot for lane in lanes("rover", tmp_path)] == ["rover"]
    big, little = lanes("two-arms", tmp_path)
    assert (big.robot, little.robot) == ("big_arm", "little_arm")
    assert little.command.topic == "/little_arm/ground/target"
    assert little.board_command.topic == "/little_arm/flight/target_pose"
    assert little.board_state.topic == "/little_arm/joint_states_throttled"
    assert little.state.topic == "/little_arm/ground/joint_states"


def test_ports_are_free_and_cfs_has_them():
    ports = free_ports()
    assert len({ports.ci, ports.to, ports.sbn, ports.peer}) == 4
    made = profile(ports, [0x0828])
    assert (made.ci_port, made.to_port, made.sbn_port, made.sbn_peers[0].port) == (
        ports.ci,
        ports.to,
        ports.sbn,
        ports.peer,
    )
    assert made.to_limits[0x0828] > made.to_limits[0x0827] == 4


def test_a_folder_that_cannot_be_written_is_told(tmp_path):
    with pytest.raises(CaptureError, match=r"none/rover_ground.yaml: cannot be written: No such file"):
        write_missions("rover", tmp_path / "none", PORTS, 0)


def test_time_inside_cfs_is_not_added():
    leg = Leg()
    leg.begin(CDR, 1_000)
    leg.enter(CDR, 21_000)
    leg.leave(CDR, 900_000)
    leg.arrive(CDR, 930_000)
    assert (leg.said, leg.entered, leg.arrived, leg.strange) == (1, 1, 1, 0)
    assert (leg.total.max_ns, leg.added.max_ns) == (929_000, 50_000)


def test_a_way_that_begins_or_ends_in_cfs_adds_what_lies_outside():
    leg = Leg()
    leg.begin(CDR, 1_000)
    leg.leave(CDR, 50_000)
    leg.arrive(CDR, 80_000)
    assert leg.added.max_ns == 30_000
    leg = Leg()
    leg.begin(CDR, 1_000)
    leg.enter(CDR, 50_000)
    leg.arrive(CDR, 900_000)
    assert leg.added.max_ns == 49_000


def test_what_was_not_said_is_strange_and_one_message_arrives_once():
    leg = Leg()
    leg.begin(CDR, 1)
    leg.arrive(CDR, 2)
    leg.arrive(CDR, 3)
    leg.arrive(CDR[:-1] + b"\xff", 4)
    assert (leg.arrived, leg.strange) == (1, 2)


def test_no_more_messages_are_remembered_than_a_bounded_number():
    leg = Leg()
    for number in range(10_000):
        leg.begin(number.to_bytes(4, "big"), number)
    assert len(leg._under_way) < 10_000 == leg.said


def test_datagrams_of_both_links_are_followed(tmp_path):
    trace = Trace(lanes("two-rovers", tmp_path))
    content = envelope.DEFAULT.emit(CDR)
    trace.received(ANYWHERE, cfe.emit_command(0x1828, 1, content))
    state = cfe.emit_command(0x1829, 1, content)
    trace.received(ANYWHERE, sbn.emit(sbn.MsgType.APP, PEER, state))
    trace.received(ANYWHERE, sbn.emit(sbn.MsgType.PROTO, PEER, sbn.emit_proto()))
    assert [leg.entered for leg in (*trace.commands, *trace.states)] == [0, 1, 1, 0]
    trace.states[1].begin(CDR, time.monotonic_ns())
    telemetry = cfe.emit_telemetry(0x0829, content + b"stale tail")
    trace.sent(WireDatagram(0, ANYWHERE, ANYWHERE, telemetry))
    trace.states[1].arrive(CDR, time.monotonic_ns())
    assert trace.states[1].added.max_ns < trace.states[1].total.max_ns


@given(st.binary(max_size=200))
def test_any_datagram_is_looked_at_without_harm(data):
    trace = Trace(())
    trace.received(ANYWHERE, data)
    trace.sent(WireDatagram(0, ANYWHERE, ANYWHERE, data))


def test_an_agenda_does_what_is_due_and_what_it_is_asked():
    scheduler, done, ended = CallScheduler(), [], threading.Event()
    scheduler.at(time.monotonic_ns() + 1, lambda: done.append("once"))
    scheduler.start()
    scheduler.ask(scheduler.every, 500, lambda: done.append("tick"))

    def finish():
        done.append("asked")
        ended.set()

    until(lambda: done.count("tick") >= 3)
    scheduler.ask(finish)
    assert ended.wait(PATIENCE_S)
    scheduler.close()
    scheduler.close()
    count = len(done)
    assert done.count("once") == 1
    assert len(done) == count


def test_an_agenda_that_never_began_is_closed():
    CallScheduler().close()


def test_the_ground_knows_how_far_robots_came():
    rover = RobotState()
    for x in (0.0, 3.0, 3.0):
        rover.take({"pose": {"position": {"x": x, "y": 4.0 * (x > 1)}, "orientation": {"z": 0.0, "w": 1.0}}})
    assert (rover.way, rover.start, rover.place) == (5.0, (0.0, 0.0, 0.0), (3.0, 4.0, 0.0))
    assert rover.track == [(0.0, 0.0), (3.0, 4.0)]
    arm = RobotState()
    arm.take({"position": [0.0, 0.0]})
    arm.take({"position": [0.3, -0.4]})
    arm.take({"position": [1.0]})
    assert (round(arm.way, 6), arm.place) == (0.5, (1.0,))


def test_a_track_stays_short():
    rover = RobotState()
    for number in range(3000):
        rover.take({"pose": {"position": {"x": number, "y": 0}, "orientation": {"z": 0.0, "w": 1.0}}})
    assert len(rover.track) <= 400
    assert (rover.track[0], rover.track[-1]) == ((0.0, 0.0), (2999.0, 0.0))


REFUSED = {
    ("/pose", "geometry_msgs/msg/Twist", "json"): "/pose is not a command topic; there are /cmd_vel",
    (
        "/cmd_vel",
        "geometry_msgs/msg/Pose",
        "json",
    ): "has type geometry_msgs/msg/Twist, not geometry_msgs/msg/Pose",
    ("/cmd_vel", "geometry_msgs/msg/Twist", "ros1"): "ros1 is not understood",
}


@pytest.fixture
def commander(tmp_path):
    graph = open_graph(TYPES, "test", domain=1999)
    yield commands(lanes("rover", Path(tmp_path)), TYPES, graph)
    graph.close()


@pytest.mark.parametrize("given", REFUSED)
def test_what_may_not_be_published_is_told(commander, given):
    assert REFUSED[given] in commander.refusal(*given)
    assert REFUSED[given] in commander.publish(*given, b"{}")


@pytest.mark.parametrize("data", [b"{", b"[]", b'{"linear": 1}', b'{"nothing": {}}', b"\xff"])
def test_what_is_no_message_is_told(commander, data):
    assert commander.publish("/cmd_vel", "geometry_msgs/msg/Twist", "json", data).startswith("/cmd_vel: ")
    assert commander.publish("/cmd_vel", "geometry_msgs/Twist", "cdr", data).startswith("/cmd_vel: ")
