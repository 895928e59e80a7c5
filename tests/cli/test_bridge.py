"""``edoras bridge`` as a shell runs it: what it prints, what it returns, and how it ends."""

import json
import re
import signal
import socket
import sys
from contextlib import ExitStack
from types import SimpleNamespace

import pytest
from places import MISSIONS
from schema import held
from waiting import HOST, PATIENCE_S, Program, free_ports

from edoras_tools.ros import TypeStore
from edoras_tools.wire import cfe, envelope


@pytest.fixture
def ci():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as opened:
        opened.bind((HOST, 0))
        opened.settimeout(PATIENCE_S)
        yield opened


@pytest.fixture
def mission(tmp_path, ci):
    """The rover's ground mission on ports of this test; its bridge's port is ``port``."""
    (port,) = free_ports(1)
    ours = {"1235": str(port), "1234": str(ci.getsockname()[1])}
    text = (MISSIONS / "rover_ground.yaml").read_text()
    path = tmp_path / "rover.yaml"
    path.write_text(re.sub("|".join(map(re.escape, ours)), lambda found: ours[found[0]], text))
    return SimpleNamespace(path=path, port=port)


@pytest.fixture
def started(command, mission):
    """A function: start the bridge of the mission; return it once it has its port."""
    with ExitStack() as running:

        def start(*arguments):
            words = ["bridge", "ground", "-c", mission.path, "--ros", "local", *arguments]
            bridge = running.enter_context(Program(command, *words))
            told = bridge.line(bridge.err)
            assert told.startswith("bridging 2 topics through local: conversion_node, ground, "), told
            return bridge

        yield start


def test_it_enables_telemetry_takes_it_and_reports_as_json(started, ci, mission, tmp_path, recording):
    path = tmp_path / "a.mcap"
    process = started("--json", "--checksum", "-o", path)
    enable, bridge = ci.recvfrom(99)
    assert bridge == (HOST, mission.port)
    assert (enable[:2].hex(), enable[6], enable[8:17], cfe.checksum(enable)) == ("1880", 6, b"127.0.0.1", 0)
    cdr = TypeStore().encode("geometry_msgs/msg/PoseStamped", {"header": {"frame_id": "map"}})
    for count in range(5):
        ci.sendto(cfe.emit_telemetry(0x0827, envelope.DEFAULT.emit(cdr), sequence_count=count), bridge)
    ci.sendto(cfe.emit_telemetry(0x0827, envelope.DEFAULT.emit(cdr)[:-1]), bridge)
    ci.sendto(cfe.emit_telemetry(0x0880, bytes(4)), bridge)
    while (told := process.line(process.err)) != "edoras: conversion_node: telemetry arrives\n":
        assert "no telemetry" in told  # as yet, on a slow machine
    out, err = process.end()
    report = held(json.loads(out), ["bridge", "--json"])
    (bridge,) = report["bridges"]
    order, state = bridge["routes"]
    assert (order["topic"], order["direction"], order["in"]) == ("/cmd_vel", "to_cfs", 0)
    assert (state["msg_id"], state["in"], state["out"]) == ("0x0827", 6, 5)
    assert state["refused"] == {"the envelope's length exceeds the packet": 1}
    assert "/telemetry_pose: 1 message refused: the envelope's length exceeds the packet" in err
    assert (bridge["others"], bridge["connected"], report["lost"]) == (1, True, 0)
    assert report["recorded"] == 7 + bridge["asked"]
    assert recording(path).counts["/telemetry_pose"] == 5
    assert "rover.yaml" in recording(path).attachments


def test_a_report_for_people(started, ci):
    process = started()
    ci.recv(99)
    out, err = process.end(signal.SIGTERM)
    assert out == ""
    assert "1 bridge, ROS 2 through local" in err
    assert "no telemetry" in err
    assert "/telemetry_pose" in err


def test_a_duration_ends_it_and_quiet_says_nothing_more(started):
    process = started("--duration", "50ms", "-q")
    assert process.end(None) == ("", "")


def test_a_dry_run_says_what_would_be_and_opens_nothing(call, mission):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind((HOST, mission.port))
        result = call(
            "bridge", "-c", mission.path, "--max-rate", "/cmd_vel=10", "--ros", "zenoh", "--dry-run"
        )
        assert result.code == 0
        assert result.out.splitlines()[0] == "would bridge to ROS 2 through zenoh; nothing was opened"
        assert "10.0 Hz" in result.out
        found = call("bridge", "-c", mission.path, "--dry-run", "--json", "--ros", "dds").json()
    assert found["ros"] == "dds"
    assert [row["topic"] for row in found["bridges"][0]["routes"]] == ["/cmd_vel", "/telemetry_pose"]
    assert found["bridges"][0]["listen"] == f"{HOST}:{mission.port}"


def test_the_environment_names_the_middleware(call, mission, monkeypatch):
    monkeypatch.setenv("RMW_IMPLEMENTATION", "rmw_zenoh_cpp")
    assert call("bridge", "-c", mission.path, "--dry-run", "--json").json()["ros"] == "zenoh"


def test_an_unknown_type_is_told_and_the_rest_goes_on(call, mission):
    mission.path.write_text(mission.path.read_text().replace("msg/Twist", "msg/Twister"))
    result = call("bridge", "-c", mission.path, "--ros", "local", "--duration", "20ms", "--json")
    assert result.code == 0
    assert "type 'geometry_msgs/msg/Twister' is not known" in result.err[0]
    assert result.err[0].endswith("; /cmd_vel is left out")
    assert [row["topic"] for row in result.json()["bridges"][0]["routes"]] == ["/telemetry_pose"]


WRONG = {
    ("ground",): (2, "a bridge needs a mission file"),
    ("flight", "-c", "MISSION"): (2, "no flight bridge in"),
    ("-c", "MISSION", "--max-rate", "fast"): (2, "--max-rate fast: write 30"),
    ("-c", "MISSION", "--max-rate", "/pose=3"): (1, "/pose is not bridged; there are /cmd_vel, "),
    ("-c", "MISSION", "--ros-option", "x"): (2, "'x' is not NAME=VALUE"),
    ("-c", "MISSION", "--ros-option", "x=1"): (2, "--ros local has no option 'x'"),
    ("-c", "MISSION", "-o", "a.txt"): (2, "unknown suffix"),
    ("-c", "MISSION", "-o", "/proc/no/where.mcap"): (1, "/proc/no/where.mcap"),
    ("air", "-c", "MISSION"): (2, "air"),
}


@pytest.mark.parametrize("arguments", WRONG, ids=range(len(WRONG)))
def test_what_is_wrong_is_one_line(call, mission, tmp_path, monkeypatch, arguments):
    monkeypatch.chdir(tmp_path)
    words = [str(mission.path) if word == "MISSION" else word for word in arguments]
    result = call("bridge", *words, "--ros", "local", "--duration", "50ms")
    code, part = WRONG[arguments]
    assert (result.code, result.out) == (code, "")
    assert len(result.err) == 1, result.err
    assert result.err[0].startswith("edoras: ")
    assert part in result.err[0]


def test_a_port_in_use_is_told_before_a_recording_is_begun(call, mission, tmp_path):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind((HOST, mission.port))
        result = call("bridge", "-c", mission.path, "--ros", "local", "-o", tmp_path / "a.mcap")
    assert result.code == 1
    (line,) = result.err
    assert "another program has port" in line
    assert not (tmp_path / "a.mcap").exists()


def test_an_absent_library_is_told_with_what_to_install(call, mission, monkeypatch):
    monkeypatch.setitem(sys.modules, "zenoh", None)
    for name in ("config", "graph"):  # as in a process that has not joined a graph yet
        monkeypatch.delitem(sys.modules, f"edoras_tools.addons.zenoh.{name}", raising=False)
    result = call("bridge", "-c", mission.path, "--ros", "zenoh", "--duration", "50ms")
    assert result.code == 2
    (line,) = result.err
    assert "pip install 'edoras-tools[zenoh]'" in line
