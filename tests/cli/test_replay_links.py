"""What is sent of other links than cFS's own, and what is said of what is not."""

import struct

import pytest
from places import SAMPLES
from rewriting import Udp, datagrams, write
from waiting import HOST, Ear

FAST = ("--max", "-q")
ROVER = SAMPLES / "captures/a_rover.pcap"


@pytest.fixture
def ear():
    with Ear() as opened:
        yield opened


@pytest.fixture
def mixed(tmp_path):
    """Traffic of the bridges and of no link, and where it came from."""
    some = [item for item in datagrams(ROVER) if item.destination[1] in {1234, 1235, 8585}][:300]
    other = [
        Udp(item.time_ns + 1, item.source, (HOST, 40_404), b"plain %d" % at) for at, item in enumerate(some)
    ]
    return write(tmp_path / "mixed.pcap", sorted([*some, *other], key=lambda item: item.time_ns)), some, other


@pytest.mark.parametrize(("to", "port"), [("robot", 8585), ("robot:up", 8080)])
def test_a_robot_gets_its_commands_and_a_flight_app_its_states(to, port, call, ear):
    done = call("replay", ROVER, "--to", to, "--target", f"{HOST}:{ear.port}", *FAST)
    sizes = {8585: {48, 56}, 8080: {64}}[port]
    wanted = [item.payload for item in datagrams(ROVER) if item.destination[1] == port]
    assert done.code == 0, done.err
    assert ear.take() == [item for item in wanted if len(item) in sizes] != []


def test_payloads_of_no_link_go_anywhere(call, ear, mixed):
    path, _, other = mixed
    assert call("replay", path, "--to", f"udp:{HOST}:{ear.port}", *FAST).code == 0
    assert ear.take() == [item.payload for item in other]


def test_what_is_left_out_is_said_with_the_option_that_sends_it(call, mixed):
    path, some, _ = mixed
    counts = {port: sum(item.destination[1] == port for item in some) for port in (1234, 1235, 8585)}
    note = call("replay", path, "--to", "ci", "--dry-run", "--json").json()["notes"][-1]
    assert note == (
        f"left out: 300 of no link (--to udp:HOST:PORT), {counts[1235]} of TO (--to ground), "
        f"{counts[8585]} of ROBOT (--to robot)"
    )
    done = call("replay", path, "--to", "sbn", "--dry-run")
    assert done.code == 1
    assert "contains no SBN datagrams towards cFS; it has 300 of no link" in done.err[0]
    assert f"{counts[1234]} of CI (--to ci)" in done.err[0]


def test_the_other_direction_of_the_same_bridge_is_no_surprise(call, mixed, tmp_path):
    path = write(tmp_path / "ground.pcap", [item for item in mixed[1] if item.destination[1] < 8000])
    assert call("replay", path, "--to", "ci", "--dry-run", "--json").json()["notes"] == []


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--to", "robot", "--expect", "event:x"], "--expect is for ci, sbn, ground; not for --to robot"),
        (["--to", "robot", "--checksum", "fix"], "--checksum is for ci, sbn, ground"),
        (["--to", "icmp"], "--to: 'icmp' is not one of ci, sbn, ground, "),
        (["--to", "udp:nowhere"], "nowhere"),
    ],
)
def test_mistakes_are_one_line(words, said, call):
    done = call("replay", ROVER, *words, "--dry-run")
    assert (done.code, len(done.err)) == (2, 1)
    assert said in done.err[0]


def test_a_command_that_is_made_up_is_its_doubles(call):
    with Ear() as ear:
        words = ("--to", "robot", "--target", f"127.0.0.1:{ear.port}", "-q")
        done = call("inject", "robot_command", "{linear_x: 0.5, angular_z: -2}", *words)
        assert (done.code, ear.take()) == (0, [struct.pack("<6d", 0.5, 0, 0, 0, 0, -2)])
        wrong = call("inject", "robot_state", "{}", *words)
        text = call("inject", "robot_command", "{linear_x: fast}", *words)
    assert wrong.err == ["edoras: 'robot_state' does not go this way; there are robot_command, robot_pose"]
    assert text.err == ["edoras: robot_command takes numbers: {linear_x: 0.5}"]
