"""The generated script: committed as generated, filters as written, sequence counts, preferences, copies."""

import math
import os
import re
import struct
import subprocess
from contextlib import closing
from itertools import zip_longest

import pytest
from effort import every, long_but
from made_system import write
from places import ROOT

from edoras_tools.addons.lab.emulator import WireDatagram
from edoras_tools.addons.wireshark.program import dissector
from edoras_tools.dissectors.lua import GUARD, own_digest
from edoras_tools.dissectors.lua_text import literal, quoted
from edoras_tools.io.formats.open import open_file
from edoras_tools.mission import load
from edoras_tools.model import Endpoint, Finding, Peer
from edoras_tools.pipelines.capture.ledger import Ledger
from edoras_tools.pipelines.capture.sniff import sniff
from edoras_tools.pipelines.selection import Selection
from edoras_tools.pipelines.workbench import Settings
from edoras_tools.ros import TypeStore
from edoras_tools.sessions.sequence import BOOT_APART_NS, REPEATED, WINDOW
from edoras_tools.units import SECOND
from edoras_tools.wire import cfe, sbn
from edoras_tools.wire.envelope import EnvelopeFormat

COMMITTED = ROOT / "dissectors/edoras.lua"
ROVER = ROOT / "samples/captures/a_rover.pcap"
ROVER_MISSION = ROOT / "samples/missions/rover_ground.yaml"


def test_the_committed_script_is_what_is_generated():
    assert dissector(Settings())[0] == COMMITTED.read_text(), "edoras wireshark print > dissectors/edoras.lua"


def test_a_script_bears_its_digest():
    text, again = (dissector(Settings((ROVER_MISSION,)))[0] for _ in range(2))
    assert text == again
    assert own_digest(text) != own_digest(COMMITTED.read_text())


@pytest.mark.parametrize(
    ("value", "lua"),
    [
        (None, "nil"),
        (True, "true"),
        (1.5, "1.5"),
        ('a"\\\n', '"a\\034\\092\\010"'),
        ("é", '"\\195\\169"'),
        ([1, "x"], '{1, "x"}'),
        ({2: "b", 1: "a"}, '{[1] = "a", [2] = "b"}'),
        ({"end": 1, "ok": 2, "gone": None}, '{["end"] = 1, ok = 2}'),
    ],
)
def test_values_as_lua(value, lua):
    assert literal(value) == lua


def test_text_is_safe_in_lua():
    assert re.fullmatch(r'"(\\\d{3}|[ !#-\[\]-~])*"', quoted("".join(map(chr, range(300)))))


FILTERS = {
    "edoras.msg_id == 0x0827 and ros2.geometry_msgs.PoseStamped.pose.position.x > 0": 63,
    "ros2.geometry_msgs.Twist": 600,
    'ros2.geometry_msgs.Twist.angular.z < 0 and edoras.link == "ci"': None,
    'cfe.event.message contains "Msg Limit"': None,
    "sbn.msg_type == 1": None,
    "edoras.finding.checksum_absent": None,
    'edoras.finding == "checksum_absent"': None,
    "_ws.expert.severity == note": None,
    "ccsds_sp.packet_type == 1 and cfe.command.function_code == 6": None,
    'edoras.topic == "/telemetry_pose"': 63,
    "ros2cdr": 663,
}


@pytest.fixture(scope="module")
def with_a_tree(tshark):
    """How many packets pass each filter where tshark builds the tree of each packet."""
    count = ",".join(["io", "stat", "0", *FILTERS])
    told = tshark(script=COMMITTED).run("-r", ROVER, "-T", "fields", "-e", "frame.number", "-z", count)
    (row,) = [line.split("|") for line in told.decode().splitlines() if "<>" in line]
    return dict(zip(FILTERS, map(int, row[2:-1:2]), strict=True))


@pytest.mark.long
@pytest.mark.parametrize("expression", long_but(list(FILTERS)[::3], FILTERS))
def test_filters_say_the_same_with_and_without_a_tree(expression, tshark, with_a_tree):
    shown = tshark(script=COMMITTED).run("-r", ROVER, "-Y", expression).splitlines()
    assert len(shown) == with_a_tree[expression] > 0
    assert FILTERS[expression] in {None, len(shown)}


def test_gaps_and_duplicates_are_those_of_the_accounts(tshark):
    for name in every(4, ("c1_tlm_rate_limit4", "a_rover", "d3_cpu1_cpu2", "e_ci_errors")):
        capture = next((ROOT / "samples/captures").glob(f"{name}.pcap*"))
        bench = Settings((ROVER_MISSION,)).workbench()
        ledger = Ledger(bench.mission)
        with closing(open_file(capture)) as source:
            for batch in source.batches():
                ledger.add(batch, bench.columns.decode(batch))
        accounts = ledger.accounts.values()
        columns = ["-T", "fields", "-e", "edoras.gap", "-e", "edoras.duplicate", "-e", "edoras.reordered"]
        told = tshark(ROVER_MISSION).run("-2", "-r", capture, "-Y", "edoras", *columns).decode().splitlines()
        gaps, duplicates, reordered = zip(*(line.split("\t") for line in told), strict=True)
        assert sum(int(item or 0) for item in gaps) == sum(account.gaps for account in accounts)
        assert len(list(filter(None, reordered))) == sum(account.reordered for account in accounts)
        assert len(list(filter(None, duplicates))) <= sum(account.duplicates for account in accounts)


COUNTED = [
    # The counts of a sender, what is told of each, and what where the end is known.
    ([5, 6, 7], ["", "", ""], None),
    ([16382, 16383, 0], ["", "", ""], None),
    ([5, 6, 9, 9, 10], ["", "", 2, "duplicate", ""], None),
    ([5, 9, 7, 10], ["", 3, "reordered", ""], ["", 2, "reordered", ""]),
    ([5, 5, 5], ["", "", ""], None),
    ([100, 5000, 101, 5001, 102], ["", 4899, "", "", ""], ["", "", "", "", ""]),
    ([9000, 3, 4], ["", "", ""], None),
    ([3, 9000, 4], ["", "", ""], None),
]


@pytest.mark.long
def test_what_a_sequence_count_says(tshark, write_pcap, tmp_path):
    """In turns, so that between two counts of a sender there are those of others."""
    turns = zip_longest(*(enumerate(counts) for counts, _, _ in COUNTED))
    order = [(sender, at[1]) for turn in turns for sender, at in enumerate(turn) if at is not None]
    rows = [
        (40000 + sender, 1235, cfe.emit_telemetry(0x0800, b"x", sequence_count=count))
        for sender, count in order
    ]
    capture = write_pcap(tmp_path / "counts.pcap", rows)
    for options, column in ((), 1), (("-2",), 2):
        frames = tshark(script=COMMITTED).frames(capture, *options)
        seen = [[] for _ in COUNTED]
        for (sender, _), frame in zip(order, frames.values(), strict=True):
            gap = [int(shown) for shown, _ in frame.fields.get("edoras.gap", [])]
            kinds = [name for name in ("duplicate", "reordered") if f"edoras.{name}" in frame.fields]
            seen[sender].append((gap + kinds + [""])[0])
            for name in kinds or (["gap"] if gap else []):
                assert f"edoras.analysis.{name}" in frame.fields
                assert frame.info.endswith(f"[gap of {gap[0]}]" if gap else f"[{name}]")
        assert seen == [case[column] or case[1] for case in COUNTED], options


def test_sequence_counts_are_followed_within_the_same_limits():
    limits = f"WINDOW, REPEATED, BOOT_APART = {WINDOW}, {REPEATED}, {BOOT_APART_NS // SECOND} "
    assert limits in COMMITTED.read_text()


@pytest.mark.long
def test_preferences_add_ports_and_headers(tshark, write_pcap, tmp_path):
    packet = bytes.fromhex("1827c000000b") + bytes.fromhex("00000000") + bytes([6, 0]) + bytes(6)
    beat = sbn.emit(sbn.MsgType.HEARTBEAT, Peer(66, 3))
    capture = write_pcap(tmp_path / "ports.pcap", [(5000, 6010, packet), (5000, 6020, beat)])
    chosen = ["-o", "edoras.ci_ports:6000-6010", "-o", "edoras.sbn_ports:6020"]
    program = tshark(script=COMMITTED)
    assert not any(frame.fields for frame in program.frames(capture).values())
    frames = program.frames(capture, *chosen)
    assert frames[1].fields["edoras.link"][0][0] == "ci"
    assert frames[2].info.startswith("HEARTBEAT  from 66:3")
    extended = program.frames(capture, *chosen, "-o", "edoras.extended_header:TRUE")
    assert extended[1].fields["cfe.command.function_code"][0][0] == "6"
    decoded_as = program.frames(capture, "-d", "udp.port==6010,edoras")
    assert decoded_as[1].fields["edoras.link"][0][0] == "ci"


@pytest.mark.long
def test_what_is_of_the_robot_is_told_by_its_doubles(tshark, write_pcap, tmp_path):
    numbers = (0.5, 0, -0.0, 3e-322, 1e19, 1.9e19, -1e20, 1e-77, 8e-78, 1e-100, math.nan, math.inf)
    payloads = [
        struct.pack(f"{order}7d", 0.5, *[0] * (5 - at), number, *[1] * at)
        for order in "<>"
        for number in numbers
        for at in (0, 5)
    ]
    payloads += [payload[8:] for payload in payloads] + [payload + bytes(8) for payload in payloads]
    payloads += [b"text".ljust(size, b"!") for size in (48, 56, 64)]
    sent = [(40000, port, payload) for port in (8080, 8585) for payload in payloads]
    frames = tshark(script=COMMITTED).frames(write_pcap(tmp_path / "robot.pcap", sent))
    told = dict.fromkeys(("robot", "other"), 0)
    with closing(open_file(tmp_path / "robot.pcap")) as source:
        for packet in sniff(source, Settings().workbench(), selection=Selection()):
            fields = frames[packet.datagram.number].fields
            assert fields.get("edoras.link", [("other", "")])[0][0] == packet.link.label
            assert (packet.summary in frames[packet.datagram.number].info) == bool(packet.layers)
            told[packet.link.label] += 1
    assert min(told.values()) > 50


def test_every_finding_has_its_expert_information():
    text = COMMITTED.read_text()
    for finding in Finding:
        assert f'label = "{finding.label}"' in text


@pytest.mark.long
def test_what_an_icmp_error_quotes_is_not_counted(tshark, tmp_path, write_pcap):
    inner = write_pcap(tmp_path / "inner.pcap", [(1235, 1234, cfe.emit_command(0x1806, 0))]).read_bytes()[40:]
    icmp = bytes.fromhex("0303000000000000") + inner
    outer = inner[:2] + (20 + len(icmp)).to_bytes(2, "big") + inner[4:9] + b"\x01" + inner[10:20] + icmp
    head = (tmp_path / "inner.pcap").read_bytes()[:24] + bytes(8) + len(outer).to_bytes(4, "little") * 2
    (tmp_path / "icmp.pcap").write_bytes(head + outer)
    frames = tshark(script=COMMITTED).frames(tmp_path / "icmp.pcap")
    assert not frames[1].fields
    assert frames[1].protocol == "ICMP"


@pytest.mark.long
def test_two_copies_are_one(tshark, tmp_path):
    """Wireshark's folder and -X at once: the second gives way, and a chosen one makes others give way."""
    plugins = tmp_path / ".local/lib/wireshark/plugins"
    plugins.mkdir(parents=True)
    (plugins / "edoras.lua").write_text(COMMITTED.read_text())
    mine = tmp_path / "mine.lua"
    mine.write_text(dissector(Settings((ROVER_MISSION,)))[0])
    command = ["tshark", "-n", "-X", f"lua_script:{mine}", "-r", ROVER, "-Y", "ros2.sensor_msgs.JointState"]

    def said(**environment):
        done = subprocess.run(
            command,
            env=os.environ | {"HOME": str(tmp_path), "XDG_CONFIG_HOME": str(tmp_path)} | environment,
            capture_output=True,
            text=True,
            check=False,
        )
        assert "Lua" not in done.stderr
        return "is neither a field nor a protocol" in done.stderr

    assert not said()  # the installed one came first, and knows all the demos
    assert said(**{GUARD: own_digest(mine.read_text())})  # this one only knows the rover


@pytest.mark.long
def test_an_unknown_type_leaves_all_else(tshark, tmp_path):
    mission = tmp_path / "bad.yaml"
    mission.write_text(ROVER_MISSION.read_text().replace("geometry_msgs/msg/Twist", "nope_msgs/msg/Twist"))
    warnings = dissector(Settings((mission,)))[1]
    assert len(warnings) == 1
    assert "nope_msgs/msg/Twist is left as bytes" in warnings[0]
    frames = tshark(mission).frames(ROVER)
    commands = [frame for frame in frames.values() if frame.fields.get("edoras.msg_id") == [("0x1827", "")]]
    assert len(commands) == 600
    assert all("ros2cdr.body" in frame.fields for frame in commands)
    assert sum("ros2.geometry_msgs.PoseStamped" in frame.fields for frame in frames.values()) == 63
    assert load([mission]).routes[0].type == "nope_msgs/msg/Twist"


def test_an_envelope_of_its_own_is_read_and_its_crc_checked(tshark, tmp_path):
    """Both CRCs and byte orders; of the second packet of each a byte of the CDR is another one."""
    for words, spare in (
        ("length: u16be, spare: u16be, crc: crc16be", "0x0000000000000000"),
        ("length: u32le, capacity: u32le, crc: crc32le", ""),
    ):
        form = EnvelopeFormat.of_name(words)
        mission = tmp_path / "rover.yaml"
        text = ROVER_MISSION.read_text(encoding="utf-8")
        mission.write_text(text.replace("mid: 0x1827", f'mid: 0x1827\n      envelope: "{words}"'))
        cdr = TypeStore().encode("geometry_msgs/msg/Twist", {"linear": {"x": 1.5}})
        whole = form.emit(cdr)
        broken = whole[:-10] + bytes([whole[-10] ^ 0x20]) + whole[-9:]
        ends = Endpoint("127.0.0.1", 50000), Endpoint("127.0.0.1", 1234)
        sent = [
            WireDatagram(at, *ends, cfe.emit_command(0x1827, 1, data))
            for at, data in enumerate((whole, broken))
        ]
        capture = write(sent, tmp_path / "own.pcap")
        names = ("buffer_length", "spare", "crc", "finding")
        fields = [item for name in names for item in ("-e", f"edoras.{name}")]
        fields += ["-e", "ros2.geometry_msgs.Twist.linear.x"]
        told = tshark(mission).run("-r", capture, "-T", "fields", *fields).decode().splitlines()
        crc = f"0x{form.check(whole[: -form.crc]):08x}"
        rows = [line.split("\t") for line in told]
        assert [row[:3] for row in rows] == [[str(len(cdr)), spare, crc]] * 2, words
        assert ["checksum_bad" in row[3] for row in rows] == [False, True]
        assert float(rows[0][4]) == 1.5
