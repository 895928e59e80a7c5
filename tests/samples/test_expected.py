"""Today's decode is the expected one, and the expected one is what the bytes say."""

from __future__ import annotations

import json
import struct
from collections import Counter
from decimal import Decimal

import pytest
from places import SAMPLES
from rosbags.typesys import Stores, get_typestore

CAPTURES = ("a_rover", "b_arm_single", "e_ci_errors", "f_sbn_disconnect")


def without_floats(info):
    rows = [{key: value for key, value in row.items() if key != "jitter_ms"} for row in info["routes"]]
    return {**info, "routes": rows}


@pytest.mark.quick("f_sbn*")
@pytest.mark.parametrize("capture", CAPTURES)
def test_the_decode_is_as_expected(capture, expected, make_expected):
    wanted, got = expected[capture], json.loads(make_expected.text(make_expected.expected(capture)))
    assert without_floats(got["info"]) == without_floats(wanted["info"])
    for one, other in zip(got["info"]["routes"], wanted["info"]["routes"], strict=True):
        assert one["jitter_ms"] == pytest.approx(other["jitter_ms"], abs=0.002)
    assert got["notable"] == wanted["notable"]
    assert len(got["packets"]) == len(wanted["packets"])
    for one, other in zip(got["packets"], wanted["packets"], strict=True):
        assert one == other


@pytest.mark.quick("b_arm*")
@pytest.mark.parametrize("capture", CAPTURES)
def test_numbers_times_ends_and_lengths_are_those_of_scapy(capture, expected, captures):
    from scapy.layers.inet import IP, UDP
    from scapy.utils import PcapReader

    wanted = {packet["number"]: packet for packet in expected[capture]["packets"]}
    with PcapReader(str(SAMPLES / f"captures/{capture}.pcap")) as reader:
        frames = list(reader)
    assert len(frames) == expected[capture]["info"]["datagrams"] == len(captures[capture])
    for number, packet in wanted.items():
        frame = frames[number - 1]
        assert packet["time_ns"] == Decimal(frame.time) * 1_000_000_000
        assert packet["source"] == f"{frame[IP].src}:{frame[UDP].sport}"
        assert packet["destination"] == f"{frame[IP].dst}:{frame[UDP].dport}"
        assert packet["length"] == frame[UDP].len - 8


@pytest.mark.parametrize("capture", CAPTURES)
def test_headers_are_what_struct_reads(capture, expected, captures):
    for packet in expected[capture]["packets"]:
        payload, layers = captures[capture][packet["number"]].payload, packet["layers"]
        if "sbn" in layers:
            size, kind, processor, spacecraft = struct.unpack_from(">hBII", payload)
            assert layers["sbn"] == {
                "msg_size": size,
                "msg_type": kind,
                "processor_id": processor,
                "spacecraft_id": spacecraft,
            }
            payload = payload[11:]
        if "sbn_sub" in layers:
            assert layers["sbn_sub"]["ident"] == payload[:48].rstrip(b"\0").decode()
            count = int.from_bytes(payload[48:50], "big")
            ids = [struct.unpack_from(">I", payload, 50 + 6 * index)[0] for index in range(count)]
            assert (layers["sbn_sub"]["count"], layers["sbn_sub"]["msg_ids"]) == (count, ids)
        if "ccsds" in layers:
            word, sequence, length = struct.unpack_from(">3H", payload)
            assert packet["msg_id"] == f"0x{word:04x}"
            assert layers["ccsds"]["apid"] == word & 0x7FF
            assert layers["ccsds"]["packet_type"] == word >> 12 & 1
            assert layers["ccsds"]["packet_version_number"] == word >> 13
            assert layers["ccsds"]["sequence_flags"] == sequence >> 14
            assert layers["ccsds"]["packet_sequence_count"] == sequence & 0x3FFF
            assert layers["ccsds"]["packet_data_length"] == length
        if "cfe_command" in layers:
            assert layers["cfe_command"] == {
                "reserved": payload[6] >> 7,
                "function_code": payload[6] & 0x7F,
                "checksum": payload[7],
            }
        if "cfe_telemetry" in layers:
            seconds, subseconds = struct.unpack_from(">IH", payload, 6)
            assert layers["cfe_telemetry"]["seconds"] == seconds
            assert layers["cfe_telemetry"]["subseconds"] == subseconds
        header = 8 if "cfe_command" in layers else 16
        if "edoras" in layers:
            length, capacity = struct.unpack_from("<QQ", payload, header)
            assert layers["edoras"] == {"buffer_length": length, "buffer_capacity": capacity}
        if "cfe_event" in layers:
            app, number, kind, spacecraft, processor, text = struct.unpack_from("<20s2H2I122s", payload, 16)
            event = layers["cfe_event"]
            assert event["app_name"] == app.partition(b"\0")[0].decode()
            assert (event["event_id"], event["event_type"]) == (number, kind)
            assert (event["spacecraft_id"], event["processor_id"]) == (spacecraft, processor) == (66, 1)
            assert event["message"] == text.partition(b"\0")[0].decode()
        if "cfe_software_bus" in layers:
            bus = layers["cfe_software_bus"]
            overflow, limit = struct.unpack_from("<2H", payload, 28)
            assert bus["pipe_overflow_error_counter"] == overflow
            assert bus["message_limit_error_counter"] == limit


def plain(value):
    """Return a rosbags message as plain values."""
    if hasattr(value, "__dataclass_fields__"):
        return {
            name: plain(getattr(value, name)) for name in value.__dataclass_fields__ if name != "__msgtype__"
        }
    return value.tolist() if hasattr(value, "tolist") else value


@pytest.mark.parametrize("capture", CAPTURES)
def test_messages_are_what_rosbags_reads(capture, expected, captures):
    store, read = get_typestore(Stores.ROS2_HUMBLE), 0
    for packet in expected[capture]["packets"]:
        if packet["message"] is None or packet["topic"].startswith("/cfs/"):
            continue
        payload = captures[capture][packet["number"]].payload
        start = (11 if packet["link"] == "sbn" else 0) + (8 if "cfe_command" in packet["layers"] else 16)
        length = int.from_bytes(payload[start : start + 8], "little")
        cdr = payload[start + 16 : start + 16 + length]
        assert plain(store.deserialize_cdr(cdr, packet["type"])) == packet["message"]
        read += 1
    assert read >= 2


HOUSEKEEPING = {
    0x0800: ("<2BH12B4I2I4I5I3I", ("command_counter", "command_error_counter", "cfe_checksum", "cfe_major")),
    0x0801: ("<8B2HB3xI", ("command_counter", "command_error_counter", "message_format")),
    0x0803: ("<11Bx2H3I", ("command_counter", "command_error_counter", "no_subscribers_counter")),
    0x0804: ("<2B3HIi", ("command_counter", "command_error_counter", "tables", "loads_pending")),
    0x0805: (
        "<2BHhh6I",
        ("command_counter", "command_error_counter", "clock_state_flags", "clock_state", "leap_seconds"),
    ),
    0x0808: ("<20x2H2I", ("event_id", "event_type", "spacecraft_id", "processor_id")),
}
"""What the first bytes of cFE's own telemetry are, by hand."""


@pytest.mark.parametrize("capture", CAPTURES)
def test_housekeeping_is_what_its_bytes_say(capture, expected, captures):
    read = set()
    for packet in expected[capture]["packets"]:
        if packet["link"] != "to" or int(packet["msg_id"] or "0", 16) not in HOUSEKEEPING:
            continue
        form, names = HOUSEKEEPING[int(packet["msg_id"], 16)]
        values = struct.unpack_from(form, captures[capture][packet["number"]].payload, 16)
        assert tuple(packet["message"][name] for name in names) == values[: len(names)]
        assert all(str(item).isprintable() for item in packet["message"].values())
        read.add(packet["msg_id"])
    assert len(read) == len(HOUSEKEEPING)


def test_the_counts_are_those_of_the_bytes(captures, expected):
    """Every datagram is sorted by hand, by ports and first word, and counted."""
    for capture, packets in captures.items():
        counts = Counter()
        for packet in packets.values():
            source, destination = (int(end.rpartition(":")[2]) for end in (packet.source, packet.destination))
            if {source, destination} & {2234, 2235, 2236}:
                app = len(packet.payload) > 16 and packet.payload[2] == 3
                word = packet.payload[11:13].hex() if app else None
                counts["sbn", word and f"0x{word}"] += 1
            elif destination in {1234, 1235}:
                word = packet.payload[:2].hex()
                counts[
                    "ci" if destination == 1234 else "to", f"0x{word}" if len(packet.payload) > 5 else None
                ] += 1
            else:
                robot = (destination, len(packet.payload)) in {(8585, 48), (8585, 56), (8080, 64)}
                counts["robot" if robot else "other", None] += 1
        told = Counter()
        for row in expected[capture]["info"]["routes"]:
            told[row["link"], row["msg_id"]] += row["count"]
        assert told == counts


def test_the_figures_that_were_written_down_when_it_was_recorded(expected):
    routes = {row["topic"]: row["count"] for row in expected["a_rover"]["info"]["routes"] if row["topic"]}
    assert routes == {"/cmd_vel": 600, "/telemetry_pose": 63}
    routes = {
        row["topic"]: row["count"] for row in expected["b_arm_single"]["info"]["routes"] if row["topic"]
    }
    assert routes == {"/command_pose": 120, "/telemetry_joint_state": 63}
    counts = {name: value["info"]["datagrams"] for name, value in expected.items()}
    assert counts == {"a_rover": 1827, "b_arm_single": 944, "e_ci_errors": 1377, "f_sbn_disconnect": 1544}


def test_the_loss_counter_grew_by_the_92_lost_commands(captures):
    """Of 600 Twists the robot got 508; the four counted before are events of the boot, says the console."""
    packets = captures["a_rover"].values()
    counts = [
        struct.unpack_from("<2H", item.payload, 28) for item in packets if item.payload[:2] == b"\x08\x03"
    ]
    assert (counts[0], counts[-1]) == ((0, 4), (0, 96))
