"""``sniff``: what was done to a running cFS, told from the packets alone, and what the list looks like."""

import json
import random
import re
import struct

import mutations
import pytest
from effort import LONG
from places import ROOT
from rewriting import datagrams, write

NOTES = {"checksum_absent", "sequence_unset"}
"""What every command of a bridge shows."""

COMMANDS = [
    ("TO enable", 24, NOTES),
    ("good Twist, checksum 0 (as the bridge sends)", 76, NOTES),
    ("good Twist, right checksum, seq flags 11", 76, set()),
    ("wrong checksum", 76, {"checksum_bad"}),
    ("ES NOOP with wrong checksum", 8, {"checksum_bad"}),
    ("ES NOOP good", 8, set()),
    ("unknown function code 9 on 0x1827", 76, NOTES | {"unknown_function_code"}),
    ("NOOP cc 0 with wrong length (payload)", 76, NOTES | {"command_length"}),
    ("CI NOOP good", 8, set()),
    ("CI NOOP with 4 extra bytes", 12, {"command_length"}),
    ("ES NOOP with 4 extra bytes", 12, {"command_length"}),
    ("TO bad function code 77", 8, NOTES | {"unknown_function_code"}),
    ("unknown MID 0x18EE", 76, NOTES | {"unknown_msg_id"}),
    ("MID 0x0000", 76, {"sequence_unset", "invalid_msg_id", "wrong_direction"}),
    ("MID 0x1FFF (highest valid)", 76, NOTES | {"unknown_msg_id"}),
    ("MID 0x2827 (version/APID high bit)", 76, {"sequence_unset", "invalid_msg_id", "wrong_direction"}),
    ("MID 0xFFFF", 76, NOTES | {"invalid_msg_id"}),
    ("tlm MID 0x0827 sent as command", 76, {"sequence_unset", "wrong_direction", "envelope_overrun"}),
    ("truncated: header says 76 bytes, 40 sent", 40, NOTES | {"length_mismatch", "envelope_overrun"}),
    ("truncated to 8 bytes", 8, NOTES | {"length_mismatch", "truncated"}),
    ("7 bytes", 7, {"sequence_unset", "length_mismatch", "truncated"}),
    ("6 bytes", 6, {"sequence_unset", "length_mismatch", "truncated"}),
    ("1 byte", 1, {"truncated"}),
    ("0 bytes", 0, {"truncated"}),
    ("CCSDS length too small (1): header says 8, 76 sent", 76, NOTES | {"length_mismatch"}),
    ("CCSDS length larger than datagram: says 500", 76, NOTES | {"length_mismatch"}),
    ("CCSDS length 0xFFFF (65542) > 32768 max SB", 76, NOTES | {"length_mismatch", "over_software_bus"}),
    ("CCSDS length 2000 (> CI 768 buffer, < SB max)", 76, NOTES | {"length_mismatch"}),
    ("768 bytes (CI limit)", 768, NOTES | {"unknown_msg_id"}),
    ("769 bytes (over CI limit)", 769, NOTES | {"unknown_msg_id", "over_ci_buffer"}),
    ("1400 bytes oversize", 1400, NOTES | {"over_ci_buffer", "cdr_invalid"}),
    ("inner buffer_length 5000 in Twist", 76, NOTES | {"envelope_overrun"}),
    ("inner CDR big endian encapsulation 00 00", 76, NOTES | {"cdr_big_endian"}),
    ("EVS filter reset", 28, NOTES),
    ("TO enable, 20 byte string", 28, NOTES),
    ("TO enable with 4 byte payload", 12, NOTES | {"command_length"}),
    ("TO enable again 16 bytes", 24, NOTES),
    *((f"NOOP and requests, {number}", 8, set()) for number in range(9)),
    ("good Twist again", 76, NOTES),
]
"""What e_ci_errors.marks.txt says was sent, in order: its words, bytes, and what is to be found."""

MALFORMED = {
    1197: ("SUB with a wrong $Id", {"sbn_id_mismatch"}),
    1227: ("PROTO with version 10", {"sbn_version_mismatch"}),
    1253: ("unknown SBN type 0x07", {"sbn_unknown_type"}),
    1279: ("SBN type 0x00 NO_MSG", {"sbn_no_message"}),
    1291: ("unknown peer (processor 9)", {"sbn_id_mismatch"}),
    1321: ("short datagram: 5 bytes", {"truncated"}),
    1347: ("MsgSz says 500, 20 bytes carried", {"sbn_size_mismatch"}),
    1371: ("MsgSz > 32767", {"sbn_size_mismatch"}),
}
"""The eight malformed datagrams of f_sbn_disconnect.marks.txt by frame number."""


@pytest.fixture
def packets(call, captures, missions):
    def sniff(name, *options, mission="rover_ground"):
        done = call("sniff", "-r", captures(name), *missions(mission), "--json", *options)
        assert (done.code, done.err) == (0, [])
        return done.lines()

    return sniff


def test_every_bad_command_carries_its_finding(packets, datagrams, captures):
    sent = [item.payload for item in datagrams(captures("e_ci_errors")) if item.destination == 1234]
    read = packets("e_ci_errors", "--link", "ci")
    assert [item["length"] for item in read] == [len(payload) for payload in sent]
    assert [
        (name, item["length"], set(item["findings"])) for (name, *_), item in zip(COMMANDS, read, strict=True)
    ] == (COMMANDS)


def test_every_malformed_sbn_datagram_carries_its_finding(packets):
    usual = NOTES | {"unknown_msg_id"}
    read = {
        item["number"]: set(item["findings"]) - usual for item in packets("f_sbn_disconnect", "--link", "sbn")
    }
    assert {number: findings for number, findings in read.items() if findings} == {
        number: findings for number, (_, findings) in MALFORMED.items()
    }


@pytest.mark.parametrize("option", ["-v", "--tree"])
def test_what_its_receiver_drops_for_a_checksum_says_so(call, tmp_path, option):
    """Of a datagram on loopback the sum of the pseudo-header alone is there: nobody finds that wrong."""
    items = mutations.frames(ROOT / "tests/captures/a_rover.pcap.zst")
    own = next(item for item in items if mutations.is_to(item.data, 1234))
    whole = mutations.summed(own.data)
    frames = [
        own.data,
        bytes(whole),
        bytes(whole[:-1]) + b"\xff",
        bytes(whole[:22]) + b"\1" + bytes(whole[23:]),
    ]
    path = mutations.write(tmp_path / "x.pcap", [own._replace(data=data) for data in frames])
    out = call("sniff", "-r", path, option).out
    assert re.findall(r"✗ (UDP|IPv4) checksum wrong", out) == ["UDP", "IPv4"]


@pytest.mark.long
def test_wake_up_packets_are_named_for_what_they_are(call, captures, missions, datagrams):
    path, count = captures("d3_cpu1_cpu2"), 12282 if LONG else 4001
    words = *missions("two_rovers_ground", "two_rovers_flight"), "--json", "--all", "-n", count
    done = call("sniff", "-r", path, *words)
    assert done.code == 0
    read, sent = done.lines(), datagrams(path)[:count]
    assert [item["number"] for item in read] == list(range(1, count + 1))
    short = 0
    for item, datagram in zip(read, sent, strict=True):
        packet = datagram.payload[11:] if item["link"] == "sbn" else datagram.payload
        if len(packet) == 8 and item["msg_id"] in {"0x0827", "0x0828"}:
            short += 1
            assert "header_only" in item["findings"]
            assert not {"truncated", "envelope_overrun", "cdr_invalid"} & set(item["findings"])
            assert item["message"] is None
    assert short > 1000


@pytest.mark.quick("b_arm_single")
@pytest.mark.parametrize("name", ["a_rover", "b_arm_single", "e_ci_errors", "f_sbn_disconnect"])
def test_all_shows_every_datagram(name, packets, datagrams, captures):
    sent = datagrams(captures(name))
    read = packets(name, "--all")
    assert [item["time_ns"] for item in read] == [item.time_ns for item in sent]
    assert [item["length"] for item in read] == [len(item.payload) for item in sent]
    assert [item["source"] for item in read] == [f"127.0.0.1:{item.source}" for item in sent]
    assert [item["destination"] for item in read] == [f"127.0.0.1:{item.destination}" for item in sent]


def test_only_the_links_show_unless_asked(call):
    """CI is at another port in this capture."""

    def links(*options):
        done = call("sniff", "-r", ROOT / "tests/captures/n10_uplink_loss.pcap.zst", "--json", *options)
        return {item["link"] for item in done.lines()}

    assert links() == {"to", "sbn"}
    assert links("-a") == {"to", "sbn", "other"}
    assert links("--link", "other") == {"other"}
    assert links("--port", "ci:5234") == {"ci", "to", "sbn"}


def test_findings_leave_the_notes_out(packets):
    """What every command of the bridge shows is a note: the shown ones have more."""
    read = packets("e_ci_errors", "--findings", "--link", "ci")
    bad = [findings for _, _, findings in COMMANDS if findings - NOTES - {"cdr_big_endian"}]
    assert [set(item["findings"]) for item in read] == bad


def test_a_message_by_value(packets):
    first = packets("a_rover", "--topic", "/cmd_vel", "-n", "1")[0]
    vector = {"x": 0.0, "y": 0.0, "z": 0.0}
    assert first["message"] == {"linear": {**vector, "x": 0.5}, "angular": {**vector, "z": 0.2}}
    assert (first["msg_id"], first["topic"], first["type"]) == (
        "0x1827",
        "/cmd_vel",
        "geometry_msgs/msg/Twist",
    )
    assert first["layers"]["ccsds"]["apid"] == 0x27
    assert first["layers"]["cfe_command"]["function_code"] == 1
    assert first["layers"]["edoras"]["buffer_length"] == 52


def test_one_line_a_packet(call, captures, missions):
    done = call("sniff", "-r", captures("a_rover"), *missions("rover_ground"), "--link", "ci", "-n", "3")
    assert (done.code, done.err) == (0, [])
    header, *lines = done.out.splitlines()
    assert " ".join(header.split()) == "No. Time Source → Destination Packet MsgId Topic Bytes Message"
    assert len(lines) == 3
    assert "/cmd_vel" in lines[1]
    assert "0x1827" in lines[1]


@pytest.mark.parametrize(
    ("choice", "wanted"),
    [
        ("relative", "0.000000"),
        ("delta", "0.000000"),
        ("epoch", "1795241636.850346"),
        ("utc", "06:13:56.850346"),
    ],
)
def test_time(choice, wanted, call, captures):
    done = call("sniff", "-r", captures("a_rover"), "-n", "1", "-t", choice)
    assert wanted in done.out.splitlines()[1]


def test_tree_and_bytes(call, captures, missions):
    options = ["-r", captures("a_rover"), *missions("rover_ground"), "--topic", "/cmd_vel", "-n", "2"]
    tree, dump = call("sniff", "-V", *options).out, call("sniff", "-x", *options).out
    assert tree.count("geometry_msgs/msg/Twist") == 2
    assert "packet_sequence_count" in tree or "Packet sequence count" in tree
    assert dump.count("18 27 00 00 00 45 01 00") == 2


def test_not_a_number_is_still_json(call, captures, missions, frames, write_pcap, tmp_path):
    """A Twist of NaN and infinities, made from a captured one."""
    time_ns, frame, original = next(
        item for item in frames(captures("a_rover")) if item[1][42:44] == b"\x18\x27"
    )
    odd = struct.pack("<6d", float("nan"), float("inf"), float("-inf"), -0.0, 5e-324, 1.5)
    path = write_pcap(tmp_path / "x.pcap", [(time_ns, frame[: 42 + 28] + odd, original)])
    done = call("sniff", "-r", path, *missions("rover_ground"), "--json")

    def refuse(word):
        raise AssertionError(word)

    message = json.loads(done.out, parse_constant=refuse)["message"]
    assert message["linear"] == {"x": "NaN", "y": "Infinity", "z": "-Infinity"}
    assert message["angular"] == {"x": -0.0, "y": 5e-324, "z": 1.5}


def test_nothing_chosen_is_said(call, captures):
    done = call("sniff", "-r", captures("a_rover"), "--msg-id", "0x0999")
    assert (done.code, done.out) == (0, "")
    assert done.err == ["edoras: none of the 1,827 datagrams was selected; -a shows every link"]
    done = call("sniff", "-a", captures("a_rover"), "--msg-id", "0x0999")
    assert done.err == ["edoras: none of the 1,827 datagrams was selected"]


def test_statistics_of_records_out_of_order_say_so(call, tmp_path):
    traffic = datagrams(ROOT / "tests/captures/a_rover.pcap.zst")
    plain = call("sniff", "-r", write(tmp_path / "a.pcap", traffic), "--stat", "routes")
    assert "times run back" not in "".join(plain.err)
    shuffled = write(tmp_path / "b.pcap", random.Random(1).sample(traffic, len(traffic)))
    (line,) = [item for item in call("sniff", "-r", shuffled, "--stat", "routes").err if "times" in item]
    assert "counted in the file's order" in line


VIEWS = ["", "-V", "--json", "--fields number", "--stat routes", "--sequence mermaid"]


@pytest.mark.each(3)
@pytest.mark.long("sniff -V")
@pytest.mark.parametrize("command", [*(f"sniff {view}" for view in VIEWS), "info", "info --json"])
def test_a_port_that_looks_like_a_link_is_told_as_in_the_doctor(command, call):
    path = ROOT / "tests/captures/n10_uplink_loss.pcap.zst"
    told = (
        "226 datagrams on port 5234 look like CI traffic and were left out: "
        "name the port with --set port=ci:5234"
    )
    done = call(*command.split(), path)
    assert (done.code, done.err) == (3, [f"edoras: {told}"])
    done = call(*command.split(), path, "--port", "ci:5234")
    assert (done.code, done.err) == (0, [])


@pytest.mark.each(2)
@pytest.mark.parametrize("command", ["export -o a/", "plot", "report -o a.html", "check --init"])
def test_a_table_a_plot_a_page_and_a_draft_say_it_too(command, call, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = ROOT / "tests/captures/n10_uplink_loss.pcap.zst"
    done = call(*command.split(), path)
    assert (done.code, sum("name the port with --set port=ci:5234" in line for line in done.err)) == (3, 1)
    done = call(*command.split(), path, "--port", "ci:5234", *["--force"] * command.startswith("export"))
    assert not any("look like" in line for line in done.err)


def test_a_recorder_says_what_it_records_without_messages(call, tmp_path):
    path = ROOT / "tests/captures/n10_uplink_loss.pcap.zst"
    done = call("record", "-q", path, "-o", tmp_path / "a.mcap")
    told = "226 datagrams on port 5234 look like CI traffic, recorded without messages"
    assert (done.code, done.err) == (0, [f"edoras: {told}: name the port with --set port=ci:5234"])
    assert call("record", "-q", path, "--port", "ci:5234", "-o", tmp_path / "b.mcap").err == []


def test_what_is_shown_is_not_left_out(call):
    assert call("sniff", "-a", ROOT / "tests/captures/n10_uplink_loss.pcap.zst").code == 0


@pytest.mark.each(3)
@pytest.mark.long("sniff --fields*", "sniff -V*")
@pytest.mark.parametrize(
    "command",
    ["sniff {}", "sniff -V -n 300 {}", "sniff --fields number,summary {}", "decode {} 105", "info {}"],
)
def test_nothing_is_cut_in_a_pipe(command, call, captures, monkeypatch):
    monkeypatch.delenv("COLUMNS", raising=False)
    whole = call(*command.format(captures("a_rover")).split()).out
    assert all(re.search(r" \u2026 \(\d+ bytes\)", line) for line in whole.splitlines() if "\u2026" in line)
    monkeypatch.setenv("COLUMNS", "80")
    assert max(map(len, whole.splitlines())) > 80
    if "fields" not in command:
        assert max(map(len, call(*command.format(captures("a_rover")).split()).out.splitlines())) <= 80
