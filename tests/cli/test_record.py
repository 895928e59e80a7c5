"""The main job: captures into recordings and back, judged by readers that are not ours."""

import json
import signal
import socket
import struct
import subprocess

import pytest
import zstandard
from places import ROOT
from rewriting import Udp, write
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore
from waiting import Program

from edoras_tools.model import Peer
from edoras_tools.wire import cfe, envelope, sbn

ROVER = ("rover_ground",)
ALL = {
    "a_rover": ROVER,
    "b_arm_single": ("single_arm_ground",),
    "e_ci_errors": ROVER,
    "f_sbn_disconnect": ROVER,
    "c1_tlm_rate_limit4": ROVER,
    "d3_cpu1_cpu2": ("two_rovers_ground", "two_rovers_flight"),
}


def cdr(payload, header):
    """The CDR of a space packet, by WIRE: cFE header, two 8-byte lengths, CDR."""
    length, _ = struct.unpack_from("<QQ", payload, header)
    return payload[header + 16 : header + 16 + length]


@pytest.fixture(scope="module")
def rover(edoras, captures, missions, tmp_path_factory):
    """The recording that the README makes, by the real command."""
    path = tmp_path_factory.mktemp("rover") / "a.mcap"
    done = edoras("record", "-r", captures("a_rover"), *missions("rover_ground"), "-o", path)
    assert (done.returncode, done.stdout) == (0, b"")
    assert done.stderr.decode().startswith(f"{path}: 1,827 datagrams over 65.3 s, 663 messages on 2 topics")
    return path


def test_every_message_of_the_rover_is_recorded(rover, recording):
    counts = recording(rover).counts
    assert counts.pop("/edoras/link_statistics") > 0
    assert counts.pop("/edoras/software_bus") == counts.pop("/cfs/CFE_ES_HousekeepingTlm") == 63
    counts = {topic: count for topic, count in counts.items() if not topic.startswith("/cfs/")}
    assert counts == {"/cmd_vel": 600, "/telemetry_pose": 63, "/edoras/datagrams": 1827, "/edoras/events": 15}


def test_every_cdr_equals_the_captured_bytes(rover, recording, datagrams, captures):
    topics = recording(rover).topics
    sent = datagrams(captures("a_rover"))
    for topic, port, msg_id, header in (("/cmd_vel", 1234, 0x1827, 8), ("/telemetry_pose", 1235, 0x827, 16)):
        wanted = [
            (item.time_ns, cdr(item.payload, header))
            for item in sent
            if item.destination == port and struct.unpack(">H", item.payload[:2])[0] == msg_id
        ]
        assert [(message.log_time, message.data) for message in topics[topic]] == wanted


def first_messages(path, *topics):
    """The first message of each topic, as rosbags reads it, and how many there are."""
    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as bag:
        read = {}
        for connection, _, raw in bag.messages():
            if connection.topic in topics and connection.topic not in read:
                read[connection.topic] = bag.deserialize(raw, connection.msgtype)
        counts = {name: item.msgcount for name, item in bag.topics.items()}
    return *(read[topic] for topic in topics), counts


def test_values_as_rosbags_reads_them(rover):
    # What stands in the first packets of the capture, read with struct: 1827... and 0827...
    twist, pose, counts = first_messages(rover, "/cmd_vel", "/telemetry_pose")
    assert (twist.linear.x, twist.linear.y, twist.linear.z) == (0.5, 0.0, 0.0)
    assert (twist.angular.x, twist.angular.y, twist.angular.z) == (0.0, 0.0, 0.2)
    assert (pose.header.stamp.sec, pose.header.stamp.nanosec) == (1795241638, 635675430)
    assert pose.header.frame_id == "world"
    position, orientation = pose.pose.position, pose.pose.orientation
    assert (position.x, position.y, position.z) == (0.1, 0.5, 0.0)
    assert (orientation.x, orientation.y, orientation.z, orientation.w) == (0.0, 0.0, 0.0, 1.0)
    assert (counts["/cmd_vel"], counts["/telemetry_pose"]) == (600, 63)


def test_what_a_recording_says_of_itself(rover, recording):
    read = recording(rover)
    channel = next(item for item in read.summary.channels.values() if item.topic == "/telemetry_pose")
    assert channel.message_encoding == "cdr"
    told = {"link": "to", "msg_id": "0x0827", "direction": "telemetry"}
    assert channel.metadata.items() >= told.items()
    schema = read.summary.schemas[channel.schema_id]
    assert (schema.name, schema.encoding) == ("geometry_msgs/msg/PoseStamped", "ros2msg")
    assert b"MSG: builtin_interfaces/Time" in schema.data
    assert read.attachments == {
        "rover_ground.yaml": (ROOT / "samples/missions/rover_ground.yaml").read_bytes()
    }
    assert read.metadata["edoras"]["datagrams"] == "1827"


@pytest.mark.each(2)
@pytest.mark.long("d3_cpu1_cpu2", "c1_tlm_rate_limit4")
@pytest.mark.parametrize("name", ALL)
def test_every_datagram_is_accounted_for(name, call, captures, missions, frames, recording, tmp_path):
    path = captures(name)
    done = call("record", "--json", "-r", path, *missions(*ALL[name]), "-o", tmp_path / "x.mcap")
    total = len(frames(path))
    report = done.json()
    assert (done.code, done.err) == (0, [])
    assert report["datagrams"] == total
    assert report["skipped"] == 0
    assert sum(row["count"] for row in report["routes"]) == total
    read = recording(tmp_path / "x.mcap")
    assert read.counts["/edoras/datagrams"] == total
    for row in report["routes"]:
        if row["topic"] and not row["findings"]:
            assert read.counts[row["topic"]] == row["count"]


ERRORS = "q25_robot_off_then_bridge_off"
"""A capture with 209 ICMP errors among its datagrams."""


@pytest.mark.each(3)
@pytest.mark.long("d3_cpu1_cpu2", "c1_tlm_rate_limit4")
@pytest.mark.parametrize("name", [*ALL, ERRORS])
def test_a_capture_comes_back_bit_for_bit(name, call, captures, tmp_path):
    if name == ERRORS:
        path = tmp_path / "whole.pcap"
        packed = ROOT / f"tests/captures/season3/{name}.pcap.zst"
        path.write_bytes(zstandard.decompress(packed.read_bytes()))
    else:
        path = captures(name)
    chain = ["a.mcap", "b.mcap", "c.pcapng", "d.mcap", "e.pcap"]
    source = path
    for step in chain:
        assert call("record", "-q", "-r", source, "-o", tmp_path / step).code == 0
        source = tmp_path / step
    assert source.read_bytes() == path.read_bytes()


def test_a_recording_brings_its_own_mission(call, rover, recording, tmp_path):
    done = call("record", "-r", rover, "-o", tmp_path / "again.mcap")
    assert done.code == 0
    first, again = recording(rover), recording(tmp_path / "again.mcap")
    assert again.counts == first.counts
    assert again.attachments == first.attachments
    assert [item.data for item in again.topics["/cmd_vel"]] == [
        item.data for item in first.topics["/cmd_vel"]
    ]


def test_several_inputs_become_one_in_time_order(call, captures, frames, write_pcap, tmp_path):
    """Two halves, the later one named first, one of them a recording, and a third capture of later times."""
    rover, later = captures("a_rover"), captures("f_sbn_disconnect")
    even = write_pcap(tmp_path / "even.pcap", frames(rover)[::2])
    odd = write_pcap(tmp_path / "odd.pcap", frames(rover)[1::2])
    assert call("record", "-q", "-r", odd, "-o", tmp_path / "odd.mcap").code == 0
    inputs = [word for item in (later, tmp_path / "odd.mcap", even) for word in ("-r", item)]
    assert call("record", *inputs, "-o", tmp_path / "all.pcap").code == 0
    assert frames(tmp_path / "all.pcap") == frames(rover) + frames(later)


@pytest.mark.each(3)
@pytest.mark.parametrize(
    ("options", "wanted"),
    [
        (["--msg-id", "0x827"], lambda item: item.payload[:2] == b"\x08\x27" and item.destination == 1235),
        (["--msg-id", "2087"], lambda item: item.payload[:2] == b"\x08\x27" and item.destination == 1235),
        (["--topic", "/cmd_*"], lambda item: item.payload[:2] == b"\x18\x27" and item.destination == 1234),
        (["--topic", "cmd_vel"], lambda item: item.payload[:2] == b"\x18\x27" and item.destination == 1234),
        (["--link", "ci"], lambda item: item.destination == 1234),
        (["--link", "ci", "--link", "TO"], lambda item: item.destination == 1234 or item.source > 40000),
    ],
)
def test_selection(options, wanted, call, captures, missions, datagrams, tmp_path):
    path = captures("a_rover")
    done = call("record", "-r", path, *missions("rover_ground"), *options, "-o", tmp_path / "x.pcap")
    chosen = [item.payload for item in datagrams(path) if wanted(item)]
    assert done.code == 0
    assert 0 < len(chosen) < 1827
    assert [item.payload for item in datagrams(tmp_path / "x.pcap")] == chosen


def test_a_selection_is_told_in_the_recording(call, captures, recording, tmp_path):
    call("record", "-r", captures("a_rover"), "--link", "ci", "--msg-id", "0x1827", "-o", tmp_path / "x.mcap")
    assert recording(tmp_path / "x.mcap").metadata["edoras"]["filter"] == "link=ci msg_id=0x1827"


def test_count_ends_the_recording(call, captures, frames, tmp_path):
    done = call("record", "--json", "-r", captures("a_rover"), "-n", "0x10", "-o", tmp_path / "x.pcap")
    assert (done.code, done.json()["datagrams"]) == (0, 16)
    assert frames(tmp_path / "x.pcap") == frames(captures("a_rover"))[:16]


def test_count_counts_what_was_chosen(call, captures, datagrams, tmp_path):
    options = ["--msg-id", "0x827", "-n", "5"]
    assert call("record", "-r", captures("a_rover"), *options, "-o", tmp_path / "x.pcap").code == 0
    assert [item.payload[:2] for item in datagrams(tmp_path / "x.pcap")] == [b"\x08\x27"] * 5


def test_rosbag2_directory_read_by_rosbags(call, captures, missions, tmp_path):
    bag = tmp_path / "bag"
    done = call("record", "-r", captures("a_rover"), *missions("rover_ground"), "--rosbag2", "-o", bag)
    assert done.code == 0
    twist, counts = first_messages(bag, "/cmd_vel")
    assert (twist.linear.x, twist.angular.z) == (0.5, 0.2)
    assert (counts["/cmd_vel"], counts["/telemetry_pose"], counts["/edoras/datagrams"]) == (600, 63, 1827)


@pytest.mark.quick("kind0")
@pytest.mark.parametrize("kind", [["-o", "x.mcap"], ["--rosbag2", "-o", "bag"]])
def test_split_by_time(kind, call, captures, missions, recording, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    done = call("record", "-r", captures("a_rover"), *missions("rover_ground"), "--split-time", "20s", *kind)
    assert done.code == 0
    parts = sorted(tmp_path.glob("**/*.mcap"))
    assert len(parts) == 4  # 65.3 s
    reads = [recording(part) for part in parts]
    for read in reads:
        times = [item.log_time for item in read.topics["/edoras/datagrams"]]
        assert max(times) - min(times) < 20e9
        assert set(read.attachments) == {"rover_ground.yaml"}
    assert sum(read.counts["/cmd_vel"] for read in reads) == 600
    assert sum(read.counts["/edoras/datagrams"] for read in reads) == 1827


def test_split_by_size(call, captures, recording, tmp_path):
    done = call("record", "-r", captures("a_rover"), "--split-size", "40k", "-o", tmp_path / "x.mcap")
    assert done.code == 0
    parts = sorted(tmp_path.glob("x_*.mcap"))
    assert len(parts) > 1
    # Each also has its summary, the definitions of its topics, and the name of what it was made from.
    assert all(part.stat().st_size < 56_000 for part in parts)
    assert sum(recording(part).counts["/edoras/datagrams"] for part in parts) == 1827


def test_without_a_name_the_output_is_named_by_the_clock(call, captures, recording, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert call("record", "-r", captures("a_rover")).code == 0
    (made,) = tmp_path.iterdir()
    assert made.match("edoras_20*_*.mcap")
    assert recording(made).counts["/edoras/datagrams"] == 1827


def test_the_kind_is_told_by_the_suffix(call, captures, tmp_path):
    starts = {"x.mcap": b"\x89MCAP0\r\n", "x.pcap": b"\xd4\xc3\xb2\xa1", "X.PCAPNG": b"\x0a\x0d\x0d\x0a"}
    for name, start in starts.items():
        assert call("record", "-r", captures("a_rover"), "-n", "3", "-o", tmp_path / name).code == 0
        assert (tmp_path / name).read_bytes().startswith(start)


@pytest.mark.parametrize("link", [False, True])
def test_an_input_is_never_overwritten(link, call, captures, tmp_path):
    source = target = tmp_path / "x.pcap"
    source.write_bytes(captures("a_rover").read_bytes())
    if link:
        target = tmp_path / "y.pcap"
        target.symlink_to(source)
    done = call("record", "-r", captures("e_ci_errors"), "-r", source, "-o", target)
    assert (done.code, len(done.err)) == (2, 1)
    assert "would overwrite its own input" in done.err[0]
    assert source.read_bytes() == captures("a_rover").read_bytes()


def test_quiet_says_nothing(call, captures, tmp_path):
    done = call("record", "-q", "-r", captures("a_rover"), "-o", tmp_path / "x.mcap")
    assert (done.code, done.out, done.err) == (0, "", [])


@pytest.mark.long
def test_programs_of_one_command(captures, command, tmp_path):
    """``edoras-record`` and ``edoras-sniff`` are the commands themselves."""
    target = tmp_path / "x.pcap"
    recorded = subprocess.run(
        [f"{command}-record", "-q", "-r", captures("a_rover"), "-o", target], check=False
    )
    sniffed = subprocess.run(
        [f"{command}-sniff", "-r", target, "-n", "1", "--json"], check=False, capture_output=True
    )
    assert (recorded.returncode, sniffed.returncode) == (0, 0)
    assert target.read_bytes() == captures("a_rover").read_bytes()
    assert sniffed.stdout.startswith(b'{"schema":1,"number":1,')


@pytest.mark.long
def test_a_recording_brings_its_own_types(call, captures, recording, tmp_path):
    """Types from a folder are in the recording; read on a machine without the folder it is the same."""
    (tmp_path / "types/my_msgs/msg").mkdir(parents=True)
    (tmp_path / "types/my_msgs/msg/Six.msg").write_text("float64[6] numbers\n")
    mission = tmp_path / "mission.yaml"
    text = (ROOT / "samples/missions/rover_ground.yaml").read_text(encoding="utf-8")
    mission.write_text(text.replace("geometry_msgs/msg/Twist", "my_msgs/msg/Six"), encoding="utf-8")
    first, again = tmp_path / "first.mcap", tmp_path / "again.mcap"
    options = ["-c", mission, "--msg-path", tmp_path / "types"]
    assert call("record", "-q", "-r", captures("a_rover"), *options, "-o", first).code == 0
    assert call("record", "-q", "-r", first, "-o", again).code == 0
    assert recording(again).counts == recording(first).counts
    shown = call("sniff", "-r", again, "-r", first, "--topic", "/cmd_vel", "-n", "1", "--json").lines()
    assert shown[0]["message"] == {"numbers": [0.5, 0.0, 0.0, 0.0, 0.0, 0.2]}
    assert call("info", captures("a_rover"), "-c", mission).code == 2


RCLPY_JOINTS = bytes.fromhex(
    "00010000 00000000 00000000 01000000 00127280 01000000 02000000 61000000 01000000 00000000 0000f03f"
    "00000000 00000000 f57f0000 f039fe7b"
)
"""A JointState without velocity and effort from rclpy.serialization: 8 bytes follow its last field."""


def test_bytes_that_rmw_leaves_behind_a_message_are_a_note(edoras, missions, recording, tmp_path):
    packet = cfe.emit_command(0x1829, 1, envelope.DEFAULT.emit(RCLPY_JOINTS), sequence_flags=0)
    sent = sbn.emit(sbn.MsgType.APP, Peer(0x42, 3), packet)
    local = "127.0.0.1"
    items = [Udp(10**18 + index * 10**8, (local, 2236), (local, 2234), sent) for index in range(50)]
    pcap, path = write(tmp_path / "a.pcap", items), tmp_path / "a.mcap"
    mission = missions("two_arms_flight")
    told = json.loads(edoras("info", "--json", pcap, *mission).stdout)
    assert told["findings"]["cdr_trailing"] == 50
    assert not {"cdr_invalid", "cdr_too_long"} & told["findings"].keys()
    assert edoras("record", "-r", pcap, *mission, "-o", path).returncode == 0
    assert recording(path).counts["/big_arm/joint_states_throttled"] == 50
    with AnyReader([path]) as reader:  # refuses a message with bytes behind it
        own = [item for item in reader.connections if item.topic == "/big_arm/joint_states_throttled"]
        for connection, _, raw in reader.messages(own):
            message = reader.deserialize(raw, connection.msgtype)
            assert (message.name, list(message.position), list(message.velocity)) == (["a"], [1.0], [])
    verdicts = json.loads(edoras("doctor", "--json", pcap, *mission).stdout)["verdicts"]
    assert not {"wrong_type", "bad_command"} & {item["rule"] for item in verdicts}


@pytest.mark.each(3)
@pytest.mark.parametrize("kind", ["mcap", "pcapng", "pcap"])
def test_standard_output_gets_what_a_file_does(kind, call, edoras, captures, missions, tmp_path):
    words = ["record", "-q", captures("a_rover"), *missions("rover_ground"), "-o"]
    assert call(*words, tmp_path / f"x.{kind}").code == 0
    done = edoras(*words, "-", *(["--format", kind] if kind != "mcap" else []))
    assert (done.returncode, done.stderr) == (0, b"")
    assert done.stdout == (tmp_path / f"x.{kind}").read_bytes()
    read = edoras("info", "-", "--json", input=done.stdout)
    assert json.loads(read.stdout)["datagrams"] == 1827
    if kind == "pcap":
        assert done.stdout == captures("a_rover").read_bytes()


def test_standard_input_may_be_a_file(call, edoras, captures, tmp_path):
    path = tmp_path / "x.mcap"
    assert call("record", "-q", captures("a_rover"), "-o", path).code == 0
    with path.open("rb") as file:
        assert json.loads(edoras("info", "-", "--json", stdin=file).stdout)["datagrams"] == 1827


@pytest.mark.quick("INT-pcap")
@pytest.mark.parametrize("kind", ["mcap", "pcap"])
@pytest.mark.parametrize("how", ["INT", "KILL"])
def test_a_live_stream_on_standard_output(kind, how, command, edoras, missions, tmp_path):
    """What a reader gets of a recorder that is killed is as readable as a killed file."""
    path = tmp_path / "stream"
    packet = bytes.fromhex("1827 0000 0045 01 00") + struct.pack("<QQ", 52, 52)
    packet += bytes.fromhex("00010000") + bytes(48)
    words = ["record", "--listen", "127.0.0.1:0", *missions("rover_ground"), "-o", "-", "--format", kind]
    with Program("sh", "-c", 'exec "$@" >"$0"', path, command, *words) as program:
        port = int(program.line(program.err).split()[2].rstrip(";").rpartition(":")[2])
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            for _ in range(3):
                before = path.stat().st_size
                sender.sendto(packet, ("127.0.0.1", port))
                program.until(lambda at=before: path.stat().st_size > at)
        number = getattr(signal, f"SIG{how}")
        program.end(number, code=-number if how == "KILL" else 0)
    read = edoras("info", "-", "--json", "--port", f"ci:{port}", input=path.read_bytes())
    assert read.returncode == (1 if how == "KILL" and kind == "mcap" else 0)
    assert json.loads(read.stdout)["datagrams"] == 3


@pytest.mark.long
def test_a_reader_that_ends_is_told(command, captures, tmp_path):
    words = f"{command} record -q {captures('a_rover')} -o - | head -c 1000 >{tmp_path}/head"
    done = subprocess.run(
        ["bash", "-c", f"set -o pipefail; {words}"], capture_output=True, text=True, check=False
    )
    told = "edoras: standard output: cannot be written: Broken pipe; what was written can be read\n"
    assert (done.returncode, done.stderr) == (1, told)
    assert (tmp_path / "head").stat().st_size == 1000


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["-o", "-", "--json"], "-o - writes the recording where --json prints its report"),
        (["-o", "-", "--force"], "leave the options about files out"),
        (["-o", "-", "--split-time", "1m"], "leave the options about files out"),
        (["-o", "-", "--rosbag2"], "leave the options about files out"),
        (["-o", "-", "--sync=1s"], "leave the options about files out"),
        (["-o", "-", "--format", "csv"], "'csv' is not a format of recordings; use mcap, pcapng, pcap, "),
        (["-o", "x.mcap", "--format", "pcap"], "--format is for -o -"),
    ],
)
def test_options_that_standard_output_does_not_take(words, told, call, captures, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = call("record", captures("a_rover"), *words)
    (line,) = [json.loads(result.err[0])["error"]["message"]] if "--json" in words else result.err
    assert result.code == 2
    assert told in line
    assert list(tmp_path.iterdir()) == []


def test_a_terminal_gets_no_recording(call, captures, monkeypatch):
    monkeypatch.setattr("sys.stdout.isatty", lambda: True, raising=False)
    result = call("record", captures("a_rover"), "-o", "-")
    assert (result.code, result.out) == (2, "")
    assert "this is a terminal" in result.err[0]


def test_no_mission_names_what_was_recorded(call, captures, tmp_path):
    done = call("record", captures("a_rover"), "-o", tmp_path / "a.mcap")
    assert done.err[-1] == (
        "edoras: no mission names 0x1827, 0x0827: name its file with -c, or draft one: "
        f"edoras mission draft {tmp_path / 'a.mcap'} -o mission.yaml"
    )


def test_an_output_that_is_named_as_an_input_gets_the_line_that_writes_it(call, captures, tmp_path):
    output = tmp_path / "b.pcapng"
    done = call("record", captures("a_rover"), output)
    line = f"edoras record {captures('a_rover')} -o {output}"
    assert done.err == [f"edoras: {output}: there is no such file; to write it: {line}"]
    assert done.code == 2


def test_convert_is_record(call, captures, tmp_path, frames):
    output = tmp_path / "b.pcap"
    assert call("convert", captures("a_rover"), output, "-q").code == 0
    assert frames(output) == frames(captures("a_rover"))


def test_a_msg_id_in_decimal_that_looks_like_hex(call, captures):
    for text, value in (("1827", "0x0723"), ("0827", "0x033b")):
        done = call("sniff", captures("a_rover"), "--msg-id", text)
        assert done.code == 2
        assert f"{text} is decimal, {value}; did you mean 0x{text}?" in done.err[0]
    assert call("sniff", captures("a_rover"), "--msg-id", "6183", "-n", 1).code == 0
