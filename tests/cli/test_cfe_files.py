"""Files of a real cFS, beside the capture of its run: event log, stored packets, resets, markers, a table."""

import json
import random
import re
import shutil
import struct
import subprocess

import pytest
from captures import read
from hypothesis import given
from hypothesis import strategies as st
from places import MISSIONS, ROOT
from rewriting import datagrams
from schema import check, published

from edoras_tools.cfs.profile import SbnPeerConfig
from edoras_tools.errors import CaptureError
from edoras_tools.io.formats.cfe import message_limits, network_peers, read_cfe_file
from edoras_tools.io.formats.open import is_cfe_file, open_file
from edoras_tools.model import Peer
from edoras_tools.wire import cfe
from edoras_tools.wire.cfe import CFE_MAGIC

FILES = ROOT / "samples/cfs_files"
EVENTS, STORED, RUN = FILES / "events.log", FILES / "stored_events.dat", FILES / "run.pcap"
RESETS = FILES / "resets.log"
MARKERS = FILES / "performance.dat"
HEADER = {
    "content_type": int.from_bytes(CFE_MAGIC, "big"),
    "header_length": 64,
    "spacecraft_id": 0x42,
    "processor_id": 1,
    "application_id": 0x110002,
    "seconds": 1000,
    "subseconds": 0,
    "description": "test",
}


def header(subtype):
    return cfe.FILE_HEADER.emit({**HEADER, "subtype": subtype})


def file_of(path, subtype, rest):
    path.write_bytes(header(subtype) + rest)
    return path


def telemetry(seconds, body=b"", *, spare=b"", stamp=0x8000):
    """Make a telemetry packet; ``spare`` goes between the primary header and the time."""
    data = spare + struct.pack(">IHI", seconds, stamp, 0) + body
    return struct.pack(">HHH", 0x0808, 0xC000, len(data) - 1) + data


def command(body=b"\0\0"):
    return struct.pack(">HHH", 0x1801, 0xC000, len(body) - 1) + body


def test_the_event_log_has_what_the_console_printed():
    rows, error = read(EVENTS)
    told = [cfe.EVENT.parse(row.payload, 16) for row in rows]
    assert error == ""
    assert [(item["app_name"], item["event_id"]) for item in told[:2]] == [("CFE_ES", 1), ("CFE_ES", 2)]
    assert told[-1]["message"] == "TO telemetry output enabled for IP 127.0.0.1"
    # The console: EVS Port1 1980-012-14:03:25.60820, of which 1/65536 s is kept
    assert rows[-1].time_ns == 316_533_805_608_200_073
    assert {(str(row.source), str(row.destination)) for row in rows} == {("0.0.0.0:0", "0.0.0.0:0")}


def test_stored_packets_are_those_that_the_wire_carried():
    crossed = {item.payload for item in datagrams(RUN)}
    rows, error = read(STORED)
    assert (len(rows), error) == (9, "")
    assert {row.payload for row in rows} <= crossed


def test_a_file_is_put_on_the_clock_of_a_capture(call):
    options = ("--msg-id", "EVS_LONG_EVENT", "--json")
    done = call("sniff", RUN, STORED, *options)
    packets = [json.loads(line) for line in done.out.splitlines()]
    place = {"to": {}, "file": {}}
    for item in packets:
        place[item["link"]].setdefault(item["layers"]["cfe_event"]["message"], item["time_ns"])
    late = [place["to"][text] - at for text, at in place["file"].items() if text in place["to"]]
    assert len(late) >= 7
    # An event waits in Telemetry Output's pipe for at most its round of 500 ms.
    assert max(late) - min(late) < 600_000_000
    assert all(abs(item) < 2_000_000_000 for item in late)


def test_the_doctor_judges_no_file(call):
    alone = call("doctor", EVENTS)
    assert (alone.code, alone.out) == (2, "")
    assert "no link carried its packets, so nothing is judged by them" in alone.err[0]
    both, without = call("doctor", RUN, EVENTS, "--json"), call("doctor", RUN, "--json")
    told, plain = json.loads(both.out), json.loads(without.out)
    assert both.code == without.code
    assert "no link carried its packets" in told.pop("warnings")[0]
    assert told == {name: value for name, value in plain.items() if name != "warnings"}


def test_the_doctor_says_of_several_captures_too_that_it_judges_no_file(call):
    told = call("doctor", RUN, RUN, STORED, "--json")
    warnings = json.loads(told.out)["warnings"]
    assert sum("no link carried its packets" in item for item in warnings) == 1


def test_events_of_a_log_are_exported(call, tmp_path):
    path = tmp_path / "events.jsonl"
    assert call("export", EVENTS, "--topic", "/edoras/events", "-o", path).code == 0
    rows = [json.loads(line) for line in path.read_text().splitlines()]
    assert len(rows) == 20
    assert rows[-1]["msg"] == "TO telemetry output enabled for IP 127.0.0.1"


def test_resets_are_on_the_time_line_of_a_capture_and_of_an_event_log(call):
    """The entry was made while cFE started: no event of that boot is older, and the first is soon after."""
    for beside in ([RUN, EVENTS], [EVENTS]):
        done = call("sniff", RESETS, *beside, "--json", "-n", "2")
        first, second = map(json.loads, done.out.splitlines())
        assert (first["link"], second["link"]) == ("reset", "file")
        assert first["layers"]["cfe_reset"]["description"].startswith("POWER ON RESET due to Power Cycle")
        assert second["layers"]["cfe_event"]["message"].startswith("cFE ES Initialized")
        assert 0 <= second["time_ns"] - first["time_ns"] < 600_000_000
        assert "its entries are put on the clock of" in done.err[-1]


@pytest.mark.long
def test_resets_of_another_cfs_or_of_one_that_was_started_twice_are_put_on_no_clock(call, tmp_path):
    other = tmp_path / "resets.log"
    data = bytearray(RESETS.read_bytes())
    data[19] = 9  # the processor
    other.write_bytes(data)
    done = call("sniff", RUN, other, "--link", "reset", "--time", "utc")
    assert "no packet of its cFS 66:9 with a time is there" in done.err[0]
    assert "1980-01-12" in done.out
    data[19] = 2
    other.write_bytes(data)
    done = call("sniff", ROOT / "samples/captures/d3_cpu1_cpu2.pcap.gz", other, "--link", "reset")
    assert "its cFS 66:2 was started 2 times there" in done.err[0]


def test_resets_are_exported_and_recorded_as_events(call, tmp_path):
    path, recording = tmp_path / "events.jsonl", tmp_path / "run.mcap"
    assert call("export", RESETS, EVENTS, RUN, "--topic", "/edoras/events", "-o", path).code == 0
    rows = [json.loads(line) for line in path.read_text().splitlines()]
    assert (rows[0]["name"], rows[0]["level"]) == ("CFE_ES", 30)
    assert rows[0]["msg"] == "POWER ON RESET due to Power Cycle (Power Cycle)"
    assert [row["time"] for row in rows] == sorted(row["time"] for row in rows)
    assert rows[0]["time"] < rows[1]["time"] < rows[-1]["time"]
    assert rows[0]["time"][:10] == rows[-1]["time"][:10] == "2026-11-23"
    assert call("record", RUN, RESETS, "-o", recording).code == 0
    again = call("sniff", recording, "--json", "-n", "1").out
    assert json.loads(again)["layers"]["cfe_reset"]["seconds"] == 1149


@pytest.mark.parametrize(
    ("data", "what"),
    [
        (header(cfe.RESET_LOG) + bytes(391), "ends inside entry 1 at byte 64"),
        (b"cFE1", "ends inside the cFE file header, at byte 4 of 64"),
        (header(cfe.EVENT_LOG)[:63], "ends inside the cFE file header, at byte 63 of 64"),
        (header(cfe.STORED_PACKETS) + bytes(75), "inside Data Storage's header, at byte 139 of 140"),
        (header(cfe.TABLE_IMAGE), "is a cFE table image, which has no packets; 'edoras info"),
        (header(999), "is a cFE file of subtype 999, which has no packets"),
        (header(cfe.EVENT_LOG) + telemetry(1) + telemetry(2)[:-1], "ends inside packet 2 at byte"),
    ],
)
def test_what_cannot_be_read_is_told(tmp_path, data, what):
    path = tmp_path / "file"
    path.write_bytes(data)
    assert is_cfe_file(path)
    with pytest.raises(CaptureError, match=what):
        list(open_file(path).batches())


@pytest.mark.parametrize("spare", [b"", b"\0\0\0\0"])
def test_times_are_found_behind_an_extended_header_too(tmp_path, spare):
    path = tmp_path / "file"
    file_of(path, cfe.EVENT_LOG, b"".join(telemetry(at, spare=spare) for at in (998, 1001)))
    assert [row.time_ns % 10**13 for row in read(path)[0]] == [3_798_500_000_000, 3_801_500_000_000]


@given(
    st.lists(st.one_of(st.none(), st.tuples(st.integers(0, 2**32 - 1), st.binary(max_size=60))), max_size=30)
)
def test_any_packets_come_out_as_they_went_in(tmp_path_factory, items):
    path = tmp_path_factory.mktemp("files") / "file"
    packets = [command() if item is None else telemetry(*item) for item in items]
    file_of(path, cfe.STORED_PACKETS, bytes(76) + b"".join(packets))
    rows, error = read(path)
    assert ([row.payload for row in rows], error) == (packets, "")
    known = [at for at in (item and item[0] for item in items) if at is not None]
    whole = [(row.time_ns - 315_532_800 * 10**9) // 10**9 for row in rows]
    assert [at for at, item in zip(whole, items, strict=True) if item] == known


@given(st.binary(max_size=400))
def test_any_bytes_end_in_one_line(tmp_path_factory, rest):
    path = tmp_path_factory.mktemp("files") / "file"
    file_of(path, cfe.EVENT_LOG, rest)
    rows, error = read(path)
    assert sum(len(row.payload) for row in rows) <= len(rest)
    assert bool(error) == (sum(len(row.payload) for row in rows) < len(rest))


def told(call, path):
    done = call("info", path)
    value = json.loads(call("info", path, "--json").out)
    check(value, published("cfe_file"))
    assert done.code == 0
    return value, done.out


def test_the_reset_log(call):
    value, text = told(call, FILES / "resets.log")
    assert [item["description"] for item in value["entries"]] == [
        "POWER ON RESET due to Power Cycle (Power Cycle)"
    ]
    assert value["entries"][0]["time_ns"] == 315_533_949_902_810_800
    assert "1980-01-01 00:19:09.902810  core (1)    power on (2)" in text


def test_the_performance_log(call):
    """Counted with ``struct`` alone: markers by number, and their pairs in order."""
    data = MARKERS.read_bytes()[64 + 44 + 32 :]
    markers = list(struct.iter_unpack("<III", data))
    value, _ = told(call, MARKERS)
    assert {item["marker"]: item["times"] for item in value["entries"]} == {
        number: sum(item[0] & 0x7FFFFFFF == number for item in markers)
        for number in {item[0] & 0x7FFFFFFF for item in markers}
    }
    began, total = {}, {}
    for word, upper, lower in markers:
        number, at = word & 0x7FFFFFFF, upper * 1_000_000_000 + lower
        if word >> 31 and number in began:
            total[number] = total.get(number, 0) + at - began.pop(number)
        elif not word >> 31:
            began[number] = at
    assert {item["marker"]: item["total_ns"] for item in value["entries"] if item["total_ns"]} == total


def test_the_table_of_telemetry_output_is_what_predict_reads(call):
    path = FILES / "to_lab_sub.tbl"
    value, text = told(call, path)
    assert value["table_name"] == "TO_LAB.TO_LAB_Subs"
    assert value["entries"][11] == {"msg_id": "0x0808", "priority": 0, "reliability": 0, "message_limit": 16}
    assert "0x0808  0         0            16" in text
    limits = message_limits(path)
    assert (len(limits), limits[0x0808], limits[0x08C2]) == (20, 16, 5)


def test_a_table_sets_the_limits_of_a_prediction(call, tmp_path):
    entries = struct.pack("<IBBHIBBHI", 0x0828, 0, 0, 2, 0x0829, 0, 0, 7, 0) + bytes(4)
    head = cfe.TABLE_HEADER.emit(
        {"reserved": 0, "load_offset": 0, "load_bytes": len(entries), "table_name": "TO_LAB_APP.TO_LAB_Subs"}
    )
    path = file_of(tmp_path / "to.tbl", cfe.TABLE_IMAGE, head + entries)
    done = call(
        "doctor",
        "--predict",
        "--set",
        f"to_limits={path}",
        "-c",
        MISSIONS / "two_rovers_ground.yaml",
        "--json",
    )
    rates = {item["msg_id"]: item["limit_hz"] for item in json.loads(done.out)["routes"]}
    assert (rates["0x0828"], rates["0x0829"]) == (4.0, 14.0)
    for wrong in (FILES / "resets.log", tmp_path / "none"):
        done = call(
            "doctor", "--predict", "--set", f"to_limits={wrong}", "-c", MISSIONS / "rover_ground.yaml"
        )
        assert (done.code, len(done.err)) == (1, 1)
        assert str(wrong) in done.err[0]


NETWORK = """
#include <stdint.h>
#include <stdio.h>
typedef enum { POLL = 0, SEND = 1, RECEIVE = 2, BOTH = 3 } tasks;
typedef struct { char name[16], file[64], symbol[20]; uint16_t base; } module;
typedef struct {
    uint32_t processor, spacecraft; uint8_t net; char protocol[16], filters[8][16]; uint8_t address[48];
    tasks own;
} peer;
typedef struct {
    module protocols[8]; uint8_t protocol_count; module filters[8]; uint8_t filter_count;
    peer peers[16]; uint16_t peer_count;
} table;
static const table made = {
    {{"UDP", "/cf/sbn_udp.so", "SBN_UDP_Ops", 256}}, 1,
    {{"Remap", "/cf/sbn_f_remap.so", "SBN_F_Remap", 4096}}, 1,
    {{1, 0x42, 0, "UDP", {"Remap"}, "127.0.0.1:2234", BOTH},
     {2, 0x42, 0, "UDP", {"Remap", "Swap"}, "127.0.0.1:2235"},
     {3, 0x42, 1, "UDP", {""}, "127.0.0.1:2236", SEND}}, 3};
int main(void) { return fwrite(&made, sizeof made, 1, stdout) != 1; }
"""
"""SBN's table as its header declares it, for the compiler to lay out."""


def network_table(image):
    told = {"reserved": 0, "load_offset": 0, "load_bytes": len(image), "table_name": "SBN.SBN_ConfTbl"}
    return cfe.TABLE_HEADER.emit(told) + image


@pytest.fixture(scope="module")
def network(tmp_path_factory):
    """An image of SBN's table that a compiler laid out, as a file."""
    compiler = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    if compiler is None:
        pytest.skip("no C compiler: apt install gcc")
    folder = tmp_path_factory.mktemp("network")
    (folder / "table.c").write_text(NETWORK)
    subprocess.run([compiler, "-o", folder / "table", folder / "table.c"], check=True)
    image = subprocess.run([folder / "table"], capture_output=True, check=True).stdout
    return file_of(folder / "sbn_conf_tbl.tbl", cfe.TABLE_IMAGE, network_table(image))


def test_the_table_of_sbn_is_as_the_compiler_lays_it_out(call, network):
    value, text = told(call, network)
    assert (value["protocols"], value["filters"]) == ("UDP", "Remap")
    assert [(item["spacecraft_id"], item["processor_id"], item["address"]) for item in value["entries"]] == [
        (0x42, 1, "127.0.0.1:2234"),
        (0x42, 2, "127.0.0.1:2235"),
        (0x42, 3, "127.0.0.1:2236"),
    ]
    assert [item["net"] for item in value["entries"]] == [0, 0, 1]
    assert [item["filters"] for item in value["entries"]] == ["Remap", "Remap, Swap", ""]
    assert [item["tasks"] for item in value["entries"]] == [
        "to send and receive (3)",
        "none (0)",
        "to send (1)",
    ]
    assert "127.0.0.1:2236" in text
    assert network_peers(network)[2] == SbnPeerConfig(Peer(0x42, 3), 2236)


def test_a_table_that_was_built_with_cfs_has_what_its_source_says(call):
    """The source: SBN's own table, with its TCP module instead of UDP."""
    value, _ = told(call, FILES / "sbn_conf_tbl.tbl")
    assert (value["protocols"], value["filters"], value["load_bytes"]) == ("TCP", "Remap", 4968)
    same = {"spacecraft_id": 0x42, "protocol": "TCP", "net": 0, "filters": "Remap", "tasks": "none (0)"}
    assert value["entries"] == [
        {"processor_id": number, "address": f"127.0.0.1:{2233 + number}", **same} for number in (1, 2, 3)
    ]


@pytest.mark.parametrize(
    ("old", "new", "trap"),
    [
        ("", "", ""),
        (
            "processor_id: 3",
            "processor_id: 4",
            "SBN's table has no peer 66:4: cFS refuses what the bridge sends",
        ),
        ("receive_port: 2236", "receive_port: 2237", "has 66:3 at 127.0.0.1:2236, and the bridge listens at"),
    ],
)
def test_a_prediction_compares_a_flight_bridge_with_the_table_of_sbn(call, network, tmp_path, old, new, trap):
    text = (MISSIONS / "two_rovers_flight.yaml").read_text()
    assert old in text
    (tmp_path / "flight.yaml").write_text(re.sub(f"(?<!peer_){old}", new, text) if old else text)
    missions = ("-c", tmp_path / "flight.yaml", "-c", MISSIONS / "two_rovers_ground.yaml")
    done = call("doctor", "--predict", "--set", f"sbn_table={network}", *missions, "--json")
    for route in done.json()["routes"]:
        told = [item for item in route["traps"] if "SBN's table" in item]
        assert bool(told) == bool(trap and route["link"] == "sbn")
        assert all(trap in item for item in told)


@pytest.mark.long
def test_the_doctor_compares_who_speaks_with_the_table_of_sbn(call, network):
    """In this capture are 66:1 and 66:2, nobody else."""
    capture = ROOT / "samples/captures/d3_cpu1_cpu2.pcap.gz"
    found = call("doctor", capture, "--set", f"sbn_table={network}", "--json").json()["verdicts"]
    (verdict,) = (item for item in found if item["rule"] == "sbn_table")
    assert verdict["severity"] == "note"
    assert verdict["reason"].startswith(
        "66:3, which the table that was given names at 127.0.0.1:2236, sends nothing"
    )
    plain = call("doctor", capture, "--json").json()["verdicts"]
    assert [item for item in found if item is not verdict] == plain


@pytest.mark.parametrize(
    ("image", "what"),
    [
        (bytes(4964) + b"\x00\x03\0\0", "names 768 peers, and the table has room for 16"),
        (bytes(100), "is not an image of SBN's table, of 4968 bytes"),
    ],
)
def test_what_is_no_table_of_sbn_is_refused(call, tmp_path, image, what):
    path = file_of(tmp_path / "x.tbl", cfe.TABLE_IMAGE, network_table(image))
    done = call("doctor", RUN, "--set", f"sbn_table={path}")
    assert (done.code, len(done.err)) == (1, 1)
    assert what in done.err[0]


def test_a_system_log_is_lines(call, tmp_path):
    path = file_of(tmp_path / "log", cfe.SYSTEM_LOG, b"one\ntwo \x1b[31m\n\0\0")
    value, text = told(call, path)
    assert [item["text"] for item in value["entries"]] == ["one", "two \x1b[31m"]
    assert "\x1b" not in text


def test_captures_beside_it_are_shown_too(call):
    done = call("info", FILES / "resets.log", FILES / "run.pcap")
    assert (done.code, "reset log" in done.out, "EVS_LONG_EVENT" in done.out) == (0, True, True)


@pytest.mark.parametrize(
    ("subtype", "rest", "what"),
    [
        (cfe.RESET_LOG, bytes(391), "its 391 bytes are no whole number of entries of 392 bytes"),
        (cfe.PERFORMANCE_LOG, bytes(43), "ends inside the cFE Performance Log, at byte 107 of 108"),
        (cfe.PERFORMANCE_LOG, bytes(44), "not that of a performance log of a little-endian processor"),
        (cfe.TABLE_IMAGE, bytes(51), "ends inside the cFE Table Header, at byte 115 of 116"),
        (cfe.TABLE_IMAGE, bytes(11) + b"\x08" + bytes(47), "ends after 7 of the table's 8 bytes"),
    ],
)
def test_what_is_cut_is_told(call, tmp_path, subtype, rest, what):
    path = file_of(tmp_path / "file", subtype, rest)
    with pytest.raises(CaptureError, match=what):
        read_cfe_file(path)
    done = call("info", path)
    assert (done.code, done.out, len(done.err)) == (1, "", 1)


@given(st.sampled_from([1, 2, 3, 4, 8, 77]), st.binary(max_size=900))
def test_any_other_bytes_are_read_or_refused(tmp_path_factory, subtype, rest):
    path = file_of(tmp_path_factory.mktemp("files") / "file", subtype, rest)
    error = ""
    try:
        json.dumps(read_cfe_file(path).summary())
    except CaptureError as caught:
        error = str(caught)
    assert not error or error.startswith(str(path))


@given(st.integers(0, 2**32), st.integers(0, 17))
def test_any_table_of_sbn_is_read_or_refused(tmp_path_factory, seed, count):
    image = random.Random(seed).randbytes(4964) + struct.pack("<HH", count, 0)
    path = file_of(tmp_path_factory.mktemp("files") / "file", cfe.TABLE_IMAGE, network_table(image))
    if count > 16:
        with pytest.raises(CaptureError, match="names 17 peers"):
            read_cfe_file(path)
    else:
        assert len(read_cfe_file(path).summary()["entries"]) == len(network_peers(path)) == count


def test_a_trace_has_every_span_once(call, tmp_path):
    path = tmp_path / "new/trace.json"
    done = call("export", MARKERS, "-o", path, "--json")
    assert (done.code, done.json()["files"][0]["rows"], done.json()["left_out"]) == (0, 173, 2)
    events = json.loads(path.read_text())["traceEvents"]
    spans = [item for item in events if item["ph"] == "X"]
    named = {item["tid"]: item["args"]["name"] for item in events if item["ph"] == "M"}
    markers = read_cfe_file(MARKERS).markers
    assert (len(spans), len(markers)) == (173, 348)
    assert {item["tid"] for item in spans} == set(named)
    assert named[11] == "CFE_TIME tone task"
    assert all(item["dur"] >= 0 and item["ts"] >= 0 for item in spans)
    # Spans of one marker follow each other: none begins before the one before it ended.
    ends = {}
    for item in spans:
        assert item["ts"] >= ends.get(item["tid"], 0)
        ends[item["tid"]] = item["ts"] + item["dur"]


def test_the_output_is_a_new_json_file(call, tmp_path):
    assert "use .json" in call("export", MARKERS, "-o", tmp_path / "a.csv").err[0]
    path = tmp_path / "a.json"
    path.write_text("before")
    done = call("export", MARKERS, "-o", path)
    assert (done.code, path.read_text()) == (2, "before")
    assert call("export", MARKERS, "-o", path, "--force").code == 0


def test_files_that_the_cf_app_sent(call, tmp_path):
    """A file of 9 PDUs came whole; of one of 19 the last 9 were lost at TO's pipe, as the console says."""
    given = (FILES / "cf_transfer.pcap", "-c", FILES / "cf.yaml")
    done = call("files", *given, "-o", tmp_path / "out", "--json")
    whole, cut = done.json()["transactions"]
    assert (whole["state"], cut["state"], done.code) == ("finished", "not finished", 3)
    (taken,) = (tmp_path / "out").glob("*evs.log")
    assert taken.read_bytes() == (FILES / "cf_events.log").read_bytes()


def test_losses_behind_the_last_message_are_those_that_events_name(call):
    done = call("doctor", FILES / "cf_transfer.pcap", "-c", FILES / "cf.yaml", "--json").json()
    (route,) = (item for item in done["routes"] if item["msg_id"] == "0x08c2")
    assert (route["sent"], route["seen"], route["lost"]) == (29, 20, 9)
    assert {item["rule"]: item["lost"] for item in done["verdicts"] if item["lost"]} == {
        "to_message_limit": 9
    }


def test_the_layout_of_cfs_7_fits_a_cfs_7(call):
    """Its console: version 7.0.1, and 8 no-ops of SAMPLE_APP; CI then had 3 packets that it dropped."""
    options = ("--structs", ROOT / "samples/structs/cfs_7.yaml", "--json")
    done = call("sniff", ROOT / "samples/cfs_files/ci_errors.pcap.gz", *options)
    said = [json.loads(line) for line in done.out.splitlines()]
    last = {item["msg_id"]: item["message"] for item in said if item["message"]}
    assert not any("struct_length" in item["findings"] for item in said)
    core = last["0x0800"]
    assert [core[name] for name in ("cfe_major", "cfe_minor", "cfe_revision", "registered_core_apps")] == [
        7,
        0,
        1,
        5,
    ]
    assert (core["system_log_size"], core["perf_filter_mask"], core["max_processor_resets"]) == (
        3072,
        [15, 0, 0, 0],
        2,
    )
    assert (last["0x0883"]["command_counter"], last["0x0883"]["command_error_counter"]) == (8, 0)
    assert (last["0x0884"]["ingest_packets"], last["0x0884"]["ingest_errors"]) == (18, 3)
