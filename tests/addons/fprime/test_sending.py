"""What a recording holds of F Prime reaches its ground system, and its commands flight software.

Commands that are made up are, byte for byte, those that F Prime's own ground system sends.
"""

import json
import socket

import pytest
from fprime_session import CAPTURE, DICTIONARY, HOME, SESSION, SUPPORT, ask, own, why_not
from msgspec.structs import replace
from rewriting import datagrams, write
from scapy.layers.inet import UDP
from scapy.utils import rdpcap
from waiting import HOST, Ear, Program, free_ports, until

UP = [item.payload for item in datagrams(CAPTURE) if item.payload[0] >> 4 == 2]


@pytest.mark.each(2)
@pytest.mark.skipif(bool(why_not()), reason=why_not() or "")
@pytest.mark.parametrize("framing", ["ccsds", "own"])
def test_its_ground_system_reads_every_event_and_channel(framing, call, tmp_path):
    path, port = CAPTURE, free_ports(1, socket.SOCK_STREAM)[0]
    if framing == "own":
        inside = [item for item in datagrams(CAPTURE) if item.payload not in UP]
        packets = [packet for item in inside for packet in packets_of(item.payload)]
        items = [replace(inside[0].at(at * 1000), payload=own(packet)) for at, packet in enumerate(packets)]
        path = write(tmp_path / "own.pcap", items)
    python = HOME / "bin/python"
    with Program(python, SUPPORT / "fprime_ground.py", DICTIONARY, port, framing) as ground:
        ground.line()
        done = call("replay", path, "--to", "fprime", "--target", f"{HOST}:{port}", "--json")
        read = json.loads(ground.line())
        ground.idle()
    assert done.code == 0, done.err
    pairs = zip(SESSION, ask(SESSION)["send"], strict=True)
    said = [(item, one) for item, sent in pairs for one in sent["read"]]
    assert read["events"] == [one[:2] for item, one in said if "event" in item]
    assert read["channels"] == [one for item, one in said if "event" not in item]
    assert [len(read[name]) for name in ("events", "channels")] == [7, 13]


def packets_of(frame):
    """Return the packets of F Prime in a TM frame of the sample, whose packets do not span frames."""
    at, found = 6, []
    while at < len(frame) - 2:
        size = int.from_bytes(frame[at + 4 : at + 6], "big") + 1
        if int.from_bytes(frame[at : at + 2], "big") & 0x7FF != 0x7FF:
            found.append(frame[at + 6 : at + 6 + size])
        at += 6 + size
    return found


def test_commands_go_up_as_the_ground_system_sent_them(call):
    with socket.create_server((HOST, 0)) as flight:
        flight.settimeout(60)
        port = flight.getsockname()[1]
        words = (
            "replay",
            CAPTURE,
            "--to",
            "fprime:up",
            "--target",
            f"{HOST}:{port}",
            "--linger",
            "0s",
            "--json",
        )
        done = call(*words)
        connection = flight.accept()[0]
        with connection:
            taken = b""
            while more := connection.recv(65536):
                taken += more
    assert done.json()["sent"] == len(UP) == 4
    assert taken == b"".join(UP)


def test_space_packets_without_a_frame_are_refused_with_the_reason(call, tmp_path):
    last = datagrams(CAPTURE)[-1]
    size = int.from_bytes(last.payload[10:12], "big") + 7
    alone = replace(last, payload=last.payload[6 : 6 + size])
    path = write(tmp_path / "bare.pcap", [*datagrams(CAPTURE), alone])
    notes = call("replay", path, "--to", "fprime", "--dry-run", "--json").json()["notes"]
    assert notes == ["1 are space packets without a frame: neither side takes these over TCP"]


def test_a_relay_drops_and_records_frames(command, tmp_path):
    frames = [item.payload for item in datagrams(CAPTURE)]
    near, record = free_ports(1)[0], tmp_path / "relayed.pcap"
    with Ear() as ear:
        ways = ("--listen", f"{HOST}:{near}", "--target", f"{HOST}:{ear.port}", "-o", record, "--json")
        with Program(command, "proxy", "fprime", *ways, "--fault", "drop:1,every=3") as proxy:
            assert proxy.line(proxy.err).startswith("relaying fprime")
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
                for item in frames:
                    sender.sendto(item, (HOST, near))
            left = len(frames) - len(frames) // 3
            got = []
            until(lambda: len(got.extend(ear.take()) or got) >= left)
            report = json.loads(proxy.end()[0])
    assert got == [item for place, item in enumerate(frames, 1) if place % 3]
    assert report["faults"][0]["struck"] == len(frames) // 3
    assert {bytes(item[UDP].payload) for item in rdpcap(str(record))} >= {*got}


COMMANDS = [item for item in SESSION if "command" in item]
MOVE = "Rover.drive.MOVE"
GOOD = {"distance": 1.5, "mode": "DRIVING", "careful": True}
LEG = {"to": {"x": 1, "y": 2, "heading": 0}, "speeds": [1, 2, 3], "label": "dock", "mode": "DRIVING"}
DESCRIBED = ("--set", f"structs={DICTIONARY}")


def sent(call, *words):
    """Return what ``inject`` sends to flight software's server."""
    with socket.create_server((HOST, 0)) as flight:
        flight.settimeout(60)
        where = ("--target", f"{HOST}:{flight.getsockname()[1]}", "--linger", "0s", "-q")
        done = call("inject", *words, "--to", "fprime:up", *where, *DESCRIBED)
        assert done.code == 0, done.err
        connection = flight.accept()[0]
        with connection:
            data = b""
            while more := connection.recv(65536):
                data += more
    return data


@pytest.mark.each(3)
@pytest.mark.skipif(bool(why_not()), reason=why_not() or "")
@pytest.mark.parametrize("item", COMMANDS, ids=[item["command"] for item in COMMANDS])
def test_a_command_is_what_its_ground_system_sends(item, call):
    ((one),) = ask([item])["send"]
    assert sent(call, item["command"], json.dumps(item["args"])) == bytes.fromhex(one["frames"]["ccsds"])


@pytest.mark.skipif(bool(why_not()), reason=why_not() or "")
def test_each_of_several_has_the_next_count(call):
    item = {"command": MOVE, "args": [1.5, "DRIVING", True]}
    frames = [bytes.fromhex(one["frames"]["ccsds"]) for one in ask([item] * 3)["send"]]
    assert sent(call, MOVE, json.dumps(GOOD), "-n", "3", "--rate", "50") == b"".join(frames)


def test_the_sample_has_the_same_frame(call):
    """The session of the sample began with this command."""
    assert sent(call, "Rover.cmdDisp.CMD_NO_OP") == datagrams(CAPTURE)[0].payload


@pytest.mark.parametrize(
    ("what", "values", "words"),
    [
        ("Rover.drive.MOV", GOOD, "is no command of the dictionary; did you mean Rover.drive.MOVE"),
        (MOVE, {"mode": 1}, "takes distance, mode, careful: distance is not there"),
        (MOVE, GOOD | {"speed": 1}, "takes distance, mode, careful: speed is none of them"),
        (MOVE, [1.5], "takes distance, mode, careful; not [1.5]"),
        (MOVE, GOOD | {"distance": "far"}, "MOVE.distance takes a number, not 'far'"),
        (MOVE, GOOD | {"distance": 1e300}, "MOVE.distance: 1e+300 does not fit float32"),
        (MOVE, GOOD | {"mode": "FLYING"}, "MOVE.mode takes "),
        (MOVE, GOOD | {"mode": [1]}, "MOVE.mode takes "),
        (MOVE, GOOD | {"careful": 1}, "MOVE.careful takes true or false, not 1"),
        ("Rover.cmdDisp.CMD_NO_OP", [1], "takes no argument; not [1]"),
        ("Rover.cmdDisp.CMD_NO_OP_STRING", ["x" * 999], "takes a text of at most"),
        ("Rover.drive.FOLLOW", [[LEG], "a", 1], "takes a list of 2, not [{"),
        (
            "Rover.drive.FOLLOW",
            [[LEG, LEG | {"speeds": [1, 2, -1]}], "a", 1],
            "speeds: -1 does not fit uint16",
        ),
    ],
)
def test_what_does_not_fit_is_one_line(what, values, words, call):
    done = call("inject", what, json.dumps(values), "--to", "fprime:up", "--dry-run", *DESCRIBED)
    assert (done.code, len(done.err)) == (2, 1)
    assert words in done.err[0]


def test_what_is_needed_is_said(call):
    assert "--set structs=FILE.json" in call("inject", MOVE, "--to", "fprime:up", "--dry-run").err[0]
    assert "--to fprime:up" in call("inject", MOVE, "--to", "fprime", "--dry-run", *DESCRIBED).err[0]
