"""What a recording holds of F Prime reaches its ground system, and its commands flight software."""

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
