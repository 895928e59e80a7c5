from __future__ import annotations

import json
import socket
import struct
import threading
import time

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace
from places import MISSIONS
from waiting import PATIENCE_S

from edoras_tools.addons.foxglove import publish as live_publish
from edoras_tools.addons.foxglove.publish import CommandPublisher
from edoras_tools.errors import ConfigError, RouteError
from edoras_tools.model import Endpoint, Peer
from edoras_tools.pipelines.sending.options import Receiver, SendOptions
from edoras_tools.pipelines.workbench import Settings
from edoras_tools.wire import sbn

TWIST, POSE = "geometry_msgs/msg/Twist", "geometry_msgs/msg/PoseStamped"
CMD = "/robot_1/ground/cmd_vel"
CDR = bytes.fromhex("00010000") + struct.pack("<6d", 0.5, 0, 0, 0, 0, -1)
PACKET = struct.pack(">HHHBB", 0x1827, 0, 69, 1, 0) + struct.pack("<QQ", 52, 52) + CDR


@pytest.fixture(scope="module")
def bench():
    return Settings([MISSIONS / f"two_rovers_{side}.yaml" for side in ("ground", "flight")]).workbench()


@pytest.fixture
def taken(bench):
    """Commands that go nowhere: what was taken, and a function that makes them."""
    sent = []

    def make(*allow):
        def outlet(data, msg_id):
            sent.append((data, msg_id))
            return ""

        return CommandPublisher(bench, allow, outlets={Receiver.CI: outlet, Receiver.SBN: outlet})

    make.sent = sent
    return make


@pytest.mark.parametrize("pattern", [CMD, "/robot_1/*", "*cmd_vel", "0x1827", "twist_cmd_1"])
def test_a_message_becomes_the_bridges_packet(taken, pattern):
    assert taken(pattern).publish(CMD, TWIST, "cdr", CDR) == ""
    assert taken.sent == [(PACKET, 0x1827)]


def test_json_is_encoded(taken):
    values = {"linear": {"x": 0.5}, "angular": {"z": -1}}
    assert taken(CMD).publish(CMD, "geometry_msgs/Twist", "json", json.dumps(values).encode()) == ""
    assert taken.sent == [(PACKET, 0x1827)]


@pytest.mark.parametrize(
    ("message", "why"),
    [
        (
            ("/robot_2/ground/cmd_vel", TWIST, "cdr", CDR),
            f"may not be published; --allow allows {CMD}",
        ),
        (("/robot_1/ground/pose", POSE, "cdr", CDR), "may not be published"),
        (("/nowhere", TWIST, "cdr", CDR), "may not be published"),
        ((CMD, POSE, "cdr", CDR), f"has type {TWIST}, not {POSE}"),
        ((CMD, TWIST, "cdr", CDR[:-1]), "needs"),
        ((CMD, TWIST, "json", b'{"linear": {"x": "fast"}}'), "linear.x"),
    ],
)
def test_what_does_not_fit_is_refused_in_a_line(taken, message, why):
    told = taken(CMD).publish(*message)
    assert why in told
    assert "\n" not in told
    assert not taken.sent


@given(data=st.binary(max_size=200), encoding=st.sampled_from(["cdr", "json"]))
def test_anything_may_be_published_and_only_messages_are_sent(bench, data, encoding):
    sent = []
    commands = CommandPublisher(bench, [CMD], outlets={Receiver.CI: lambda data, _: sent.append(data) or ""})
    why = commands.publish(CMD, TWIST, encoding, data)
    assert bool(why) != bool(sent)


def test_patterns_that_fit_nothing_are_mistakes(bench):
    with pytest.raises(RouteError, match=r"'/robot_9/\*' matches no topic that goes to cFS: .*/cmd_vel"):
        CommandPublisher(bench, ["*", "/robot_9/*"])
    with pytest.raises(RouteError, match="none; name a mission with -c"):
        CommandPublisher(Settings().workbench(), ["*"])


def test_one_target_is_for_one_link(bench):
    target = Endpoint("127.0.0.1", 9)
    with pytest.raises(ConfigError, match="allow those of one link"):
        CommandPublisher(bench, ["*"], SendOptions(target=target))
    assert CommandPublisher(bench, [CMD], SendOptions(target=target)).options[Receiver.CI].target == target
    both = CommandPublisher(bench, ["*"]).options
    assert (both[Receiver.CI].target.port, both[Receiver.SBN].target.port) == (1234, 2234)


@pytest.fixture
def cfs():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as opened:
        opened.bind(("127.0.0.1", 0))
        opened.settimeout(PATIENCE_S)
        yield opened


def test_commands_arrive_at_command_ingest(bench, cfs):
    commands = CommandPublisher(bench, [CMD], SendOptions(target=Endpoint(*cfs.getsockname())))
    commands.open()
    try:
        assert commands.publish(CMD, TWIST, "cdr", CDR) == ""
        assert cfs.recv(4096) == PACKET
    finally:
        commands.close()
    commands.close()


def test_other_machines_are_not_flooded(bench, monkeypatch):
    now = [100.0]
    monkeypatch.setattr(live_publish.time, "monotonic", lambda: now[0])
    sent = []
    commands = CommandPublisher(bench, [CMD], outlets={Receiver.CI: lambda data, _: sent.append(data) or ""})
    commands.options[Receiver.CI] = replace(SendOptions(target=Endpoint("192.0.2.1", 1234)), max_rate_hz=10)
    told = [commands.publish(CMD, TWIST, "cdr", CDR) for _ in range(30)]
    assert len(sent) == told.count("") == 11
    assert told[-1] == "the rate to 192.0.2.1:1234 is limited to 10 messages per second"
    now[0] += 0.25
    assert [commands.publish(CMD, TWIST, "cdr", CDR) for _ in range(4)].count("") == 2


def test_on_the_bus_network_a_session_is_held(bench, cfs):
    """A peer that answers, subscribes, gets the message in SBN's header, and is told goodbye."""
    pose = "/robot_1/pose"
    us = Endpoint("127.0.0.1", 0)
    commands = CommandPublisher(bench, [pose], SendOptions(target=Endpoint(*cfs.getsockname()), listen=us))
    assert {*commands.options} == {Receiver.SBN}
    cdr = bench.types.encode(POSE, {"header": {"frame_id": "world"}})
    commands.open()
    try:
        assert "no SBN peer answers" in commands.publish(pose, POSE, "cdr", cdr)
        asked, address = cfs.recvfrom(4096)
        assert sbn.HEADER.parse(asked)["msg_type"] in {sbn.MsgType.PROTO, sbn.MsgType.SUB}
        route = next(item for item in bench.mission.routes if item.topic == pose)
        them = Peer(0x42, 1)
        wanted = sbn.emit_subscriptions([sbn.Subscription(route.msg_id)])
        end = time.monotonic() + PATIENCE_S
        while time.monotonic() < end:
            cfs.sendto(sbn.emit(sbn.MsgType.PROTO, them, sbn.emit_proto()), address)
            cfs.sendto(
                sbn.emit(sbn.MsgType.SUB, them, wanted),
                address,
            )
            why = commands.publish(pose, POSE, "cdr", cdr)
            if not why:
                break
            time.sleep(0.02)
        assert why == ""
        kinds, messages = set(), []
        while not messages:
            data = cfs.recv(4096)
            header = sbn.HEADER.parse(data)
            kinds.add(header["msg_type"])
            if header["msg_type"] == sbn.MsgType.APP:
                messages.append(data)
        assert messages[0].endswith(cdr)
        assert int.from_bytes(messages[0][sbn.HEADER.size :][:2], "big") == route.msg_id
    finally:
        commands.close()
    cfs.settimeout(PATIENCE_S)
    while sbn.HEADER.parse(cfs.recv(4096))["msg_type"] != sbn.MsgType.DISCONNECT:
        pass
    assert not [item for item in threading.enumerate() if item.name == "foxglove SBN"]
