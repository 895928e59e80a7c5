"""Whatever is wrong, it ends in one clear line that says what and where, with 1 or 2, and no traceback."""

import json
import socket
import struct
from pathlib import Path

import pytest
from places import ROOT

BRIDGE = """\
bridge:
  ros__parameters:
    communication: {bridge_port: 1235, fsw_port: 1234, fsw_ip: 127.0.0.1, telemetry_ip: 127.0.0.1}
    command: [drive, stop]
    telemetry: []
"""
MAPPING = "    {key}: {{type: {type}, topic: {topic}, mid: {mid}}}\n"


def mission(*mappings):
    keys = ("drive", "stop")
    return BRIDGE + "".join(
        MAPPING.format(key=key, type=kind, topic=topic, mid=mid)
        for key, (kind, topic, mid) in zip(keys, mappings, strict=True)
    )


TWIST = "geometry_msgs/msg/Twist"
FILES = {
    "empty": b"",
    "text": b"The quick brown fox\n",
    "noise": bytes(range(128, 256)),
    "no_udp.pcap": struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 1)
    + struct.pack("<IIII", 1, 2, 20, 20)
    + bytes(12)
    + b"\x08\x06"
    + bytes(6),
    "only_header.pcap": struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 1),
    "absurd.pcap": struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 1)
    + struct.pack("<IIII", 1, 2, 0xFFFFFFF0, 0xFFFFFFF0)
    + bytes(100),
    "absurd.pcapng": struct.pack("<IIIHHqI", 0x0A0D0D0A, 28, 0x1A2B3C4D, 1, 0, -1, 28)
    + struct.pack("<II", 6, 0xFFFFFFF0)
    + bytes(100),
    "absurd.mcap": b"\x89MCAP0\r\n\x01" + struct.pack("<Q", 1 << 62) + bytes(100),
    "corrupt.gz": b"\x1f\x8b\x08\x00" + bytes(range(200)),
    "corrupt.zst": b"\x28\xb5\x2f\xfd" + bytes(range(200)),
    "no_type.yaml": mission(("geometry_msgs/msg/Twst", "a", "0x1827"), (TWIST, "b", "0x1828")).encode(),
    "one_mid.yaml": mission((TWIST, "a", "0x1827"), (TWIST, "b", "0x1827")).encode(),
    "wide_mid.yaml": mission((TWIST, "a", "0x11827"), (TWIST, "b", "0x1828")).encode(),
    "many.yaml": mission(("x/msg/Y", "a", "0x11827"), (TWIST, "b", "no")).encode(),
    "broken.yaml": b"a: [1, 2\nb: }",
}


@pytest.fixture
def place(tmp_path, monkeypatch, captures):
    """A folder with everything that can be wrong in it, and a sound capture; commands run there."""
    monkeypatch.chdir(tmp_path)
    for name, content in FILES.items():
        (tmp_path / name).write_bytes(content)
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder.mcap").mkdir()
    (tmp_path / "full").mkdir()
    (tmp_path / "full/x").write_text("x")
    for suffix in ("mcap", "pcap", "pcapng"):
        (tmp_path / f"full.{suffix}").symlink_to("/dev/full")
    (tmp_path / "ok.pcap").symlink_to(captures("a_rover"))
    return tmp_path


READS = [
    ("missing", 1, "missing: there is no such file"),
    ("folder", 1, "folder: is a directory"),
    ("ok.pcap/x", 1, "ok.pcap/x: cannot be opened: Not a directory"),
    ("empty", 1, "empty: is empty"),
    ("/dev/null", 1, "/dev/null: is empty"),
    ("text", 1, "text: looks like text"),
    ("noise", 1, "noise: is not a capture (it starts with 80 81 82"),
    ("only_header.pcap", 1, "only_header.pcap: no UDP datagram in it"),
    ("no_udp.pcap", 1, "no_udp.pcap: no UDP datagram in it (1 frames of other kinds)"),
    ("absurd.pcap", 1, "absurd.pcap: "),
    ("absurd.pcapng", 1, "absurd.pcapng: "),
    ("absurd.mcap", 1, "absurd.mcap: "),
    ("corrupt.gz", 1, "corrupt.gz: the gzip data is corrupt"),
    ("corrupt.zst", 1, "corrupt.zst: the zstd data is corrupt"),
]


@pytest.mark.parametrize(("name", "code", "words"), READS, ids=[case[0] for case in READS])
@pytest.mark.parametrize(
    "command", ["sniff -r", "sniff --json -r", "record -q -o out.mcap -r", "info", "info --json", "decode"]
)
def test_inputs(command, name, code, words, call, place):
    after = ["1"] if command == "decode" else []
    done = call(*command.split(), name, *after)
    assert done.code == code
    assert len(done.err) == 1
    if command == "decode" and "no UDP datagram" in words:
        words = f"{name}: packet 1 does not exist"
    if "--json" in command:
        error = json.loads(done.err[0])["error"]
        assert error["code"] == "capture"
        assert words in "; ".join(filter(None, (error["message"], error["hint"])))
    else:
        assert words in done.err[0]
        assert done.err[0].startswith("edoras: ")


def test_one_bad_input_of_several_does_not_lose_the_others(call, place, recording):
    (place / "cut.pcap").write_bytes((place / "ok.pcap").read_bytes()[:50_000])
    done = call("record", "-q", "-r", "cut.pcap", "-r", "ok.pcap", "-o", "out.mcap")
    assert (done.code, len(done.err)) == (1, 1)
    assert "cut.pcap: ends inside record" in done.err[0]
    before = int(done.err[0].rsplit("; ", 1)[1].split()[0])
    assert recording("out.mcap").counts["/edoras/datagrams"] == before + 1827


MISSIONS = [
    (
        "no_type.yaml",
        ["no_type.yaml:6: drive.type: type 'geometry_msgs/msg/Twst'", "did you mean geometry_msgs/msg/Twist"],
    ),
    ("one_mid.yaml", ["one_mid.yaml:7: stop.mid:", "0x1827", "one_mid.yaml:6"]),
    ("wide_mid.yaml", ["wide_mid.yaml:6: drive.mid: 0x11827 does not fit 16 bits"]),
    ("broken.yaml", ["broken.yaml:2"]),
    ("missing.yaml", ["missing.yaml: no such file"]),
    ("folder", ["folder: a folder without YAML files"]),
    ("noise", ["noise:1: not UTF-8"]),
    ("empty", ["empty"]),
]


@pytest.mark.parametrize(("name", "words"), MISSIONS, ids=[case[0] for case in MISSIONS])
@pytest.mark.parametrize("command", ["sniff -r ok.pcap", "record -o out.mcap -r ok.pcap", "info ok.pcap"])
def test_missions(command, name, words, call, place):
    done = call(*command.split(), "-c", name)
    assert done.code == 2
    assert len(done.err) == 1
    for word in words:
        assert word in done.err[0]
    assert not (place / "out.mcap").exists()


def test_all_mistakes_of_a_mission_at_once(call, place):
    done = call("info", "ok.pcap", "-c", "many.yaml")
    assert done.code == 2
    assert [line.split(": ")[2] for line in done.err] == ["drive.type", "drive.mid", "stop.mid"]
    assert [line.split(": ")[1] for line in done.err] == ["many.yaml:6", "many.yaml:6", "many.yaml:7"]


OUTPUTS = [
    ("-o /proc/x.mcap", 1, "/proc/x.mcap: cannot be created"),
    ("-o /proc/x.pcap", 1, "/proc/x.pcap: cannot be created"),
    ("-o /proc/x/y.mcap", 1, "/proc/x/y.mcap: cannot be created: No such file or directory"),
    ("-o ok.pcap/x.pcapng", 1, "ok.pcap/x.pcapng: cannot be created: Not a directory"),
    ("-o text", 2, "text: unknown suffix"),
    ("-o folder.mcap", 1, "folder.mcap: cannot be created: Is a directory"),
    ("-o ok.pcap/x.mcap", 1, "ok.pcap/x.mcap: cannot be created: Not a directory"),
    ("-o full.mcap", 1, "full.mcap: cannot be written: No space left on device"),
    ("-o full.pcap", 1, "full.pcap: cannot be written: No space left on device"),
    ("-o full.pcapng", 1, "full.pcapng: cannot be written: No space left on device"),
    ("-o x.wav", 2, "x.wav: unknown suffix"),
    ("-o x", 2, "x: unknown suffix"),
    ("-o x.pcap --keep 3", 2, "--keep deletes the oldest files: split too"),
    ("-o x.pcap --split-size 2M --keep-size 1M", 2, "--keep is smaller than --split"),
    ("-o x.mcap --split-count 0", 2, "0 is less than 1"),
    ("--rosbag2 -o full", 1, "full: is not empty"),
    ("--rosbag2 -o text", 1, "text: cannot be made a directory"),
    ("--rosbag2 -o /proc/x", 1, "/proc/x: cannot be made a directory"),
]


@pytest.mark.parametrize(("options", "code", "words"), OUTPUTS, ids=[case[0] for case in OUTPUTS])
def test_outputs(options, code, words, call, place):
    done = call("record", "-q", "-r", "ok.pcap", *options.split())
    assert done.code == code
    assert len(done.err) == 1
    assert words in done.err[0]


USAGE = [
    ("frobnicate", 2, "No such command 'frobnicate'; see edoras -h"),
    ("recrod", 2, "? See edoras -h"),
    ("sniff --frobnicate", 2, "No such option: --frobnicate"),
    ("sniff -r", 2, "Option '-r' requires an argument; see edoras sniff -h"),
    ("sniff", 2, "name one input: FILE..., -i IFACE, or --listen PORT"),
    ("record", 2, "name one input"),
    ("sniff -r ok.pcap -i lo", 2, "name one input"),
    ("record -r ok.pcap --listen 47900", 2, "name one input"),
    ("info", 2, "name the input to read: FILE..."),
    ("report", 2, "name the input to read: FILE..."),
    ("info --start 5 --end 4 ok.pcap", 2, "--end is not after --start"),
    ("sniff -r ok.pcap --msg-id SB_HKK", 1, "no configured topic matches 'SB_HKK'; did you mean SB_HK?"),
    ("sniff -r ok.pcap --msg-id zzz", 1, "no configured topic matches 'zzz'; name a mission with -c"),
    ("sniff -r ok.pcap --tz UTC", 2, "--tz is the zone of clock times"),
    ("sniff -r ok.pcap --start 25:00", 2, "'25:00' is not a time of the clock"),
    ("inject es-noop --expect foo:bar", 2, "--expect 'foo:bar' is not known"),
    ("inject es-noop --expect counter:TO_HK.comand_counter", 2, "did you mean command_counter?"),
    ("inject es-noop --expect counter:TO_HK", 2, "names no counter"),
    ("inject es-noop --expect SBN_PROTO", 2, "it has no MsgId"),
    ("inject es-noop --expect TO_HKK", 1, "did you mean TO_HK?"),
    ("inject es-noop --expect-within 5s", 2, "name what is expected"),
    ("inject es-noop --max-loss 1% --no-listen", 2, "need answers"),
    ("decode ok.pcap", 2, "name the file and the packet's number: edoras decode FILE N"),
    ("decode ok.pcap 99999", 1, "ok.pcap: packet 99999 does not exist: the last datagram is number 1827"),
    ("decode ok.pcap 0", 2, "0 is less than 1"),
    ("decode ok.pcap x", 2, "'x' is not a whole number"),
    ("decode ok.pcap 1 -l nothing", 2, "packet 1 has no layer 'nothing'; there are sbn, sbn_sub"),
    ("decode ok.pcap 1 -l sbn.nothing", 2, "nothing"),
    ("sniff -r ok.pcap -n 0", 2, "0 is less than 1"),
    ("sniff -r ok.pcap -n -3", 2, "-3 is less than 1"),
    ("sniff -r ok.pcap -n many", 2, "'many' is not a whole number"),
    ("sniff -r ok.pcap --duration 5", 2, "--duration ends live traffic; of a file, --end selects a part"),
    ("info ok.pcap --duration 5", 2, "--duration ends live traffic; of a file, --end selects a part"),
    ("record -r ok.pcap -o x.mcap --duration 5", 2, "--duration ends live traffic; of a file, --end selects"),
    ("record -r ok.pcap -o x.mcap -a", 2, "--all chooses what -i IFACE captures"),
    ("sniff -r ok.pcap --format csv", 2, "--format is the format of --fields"),
    ("sniff -r ok.pcap --fields number --time utc", 2, "--time has no effect with --fields"),
    ("sniff -r ok.pcap --stat sbn -v", 2, "-v has no effect with --stat"),
    ("info --verify ok.pcap --topic /x", 2, "--verify checks whole files"),
    ("info --verify ok.pcap -n 3", 2, "--verify checks whole files"),
    ("sniff -r ok.pcap --duration soon", 2, "'soon' is not a duration"),
    ("sniff -r ok.pcap --duration -1", 2, "'-1' is not a duration"),
    ("sniff -r ok.pcap --duration nan", 2, "'nan' is not a duration"),
    ("sniff -r ok.pcap --msg-id 0x10000", 2, "MsgId 0x10000 does not fit 16 bits"),
    ("sniff -r ok.pcap --msg-id -1", 2, "MsgId -1 does not fit 16 bits"),
    ("record ok.pcap --tf -o x.pcap", 2, "x.pcap: --tf writes a topic, and pcap has none: use .mcap"),
    ("sniff -r ok.pcap --link up", 2, "'up' is not a link; there are ci, to, sbn, robot, cfdp"),
    ("sniff -r ok.pcap --topic /nothing", 1, "no configured topic matches '/nothing'"),
    ("record -r ok.pcap -o x.mcap --topic /nothing", 1, "no configured topic matches '/nothing'"),
    ("sniff -r ok.pcap --time tomorrow", 2, "'tomorrow' is not one of"),
    ("sniff -r ok.pcap --port nonsense", 2, "'nonsense' is not LINK:PORT"),
    ("sniff -r ok.pcap --port ci:any", 2, "'ci:any' is not LINK:PORT"),
    ("sniff -r ok.pcap --port ci:0", 2, "'ci:0' is not LINK:PORT"),
    ("sniff -r ok.pcap --port ci:65536", 2, "'ci:65536' is not LINK:PORT"),
    ("sniff -r ok.pcap --port ci:\u00b2", 2, "is not LINK:PORT"),
    ("sniff -r ok.pcap --port other:5", 2, "'other:5' is not LINK:PORT"),
    ("sniff -r ok.pcap --envelope 3/3", 2, "envelope '3/3' is not known; there are 8/8 le"),
    ("sniff -r ok.pcap --telemetry-header 13", 2, "telemetry header of 13 bytes is not known"),
    ("sniff -r ok.pcap --distro bouncy", 2, "distro 'bouncy' is not a ROS 2 distribution; known:"),
    ("sniff -r ok.pcap --msg-path nowhere", 2, "msg-path nowhere: no such file or folder"),
    ("record -r ok.pcap --split-size none", 2, "'none' is not a size"),
    ("record -r ok.pcap --split-time none", 2, "'none' is not a duration"),
    ("sniff -i nothing0", 1, "nothing0: no such interface; there are lo"),
    ("record -i nothing0 -o x.mcap", 1, "nothing0: no such interface"),
    ("sniff --listen nonsense", 2, "--listen nonsense: not an endpoint"),
    ("sniff --listen 65536", 2, "--listen 65536: not an endpoint"),
    ("inject to-enable --target 10.9.0.2", 2, "Invalid value for '--target': 10.9.0.2: not an endpoint"),
    ("sniff --listen 192.0.2.1:47900", 1, "192.0.2.1:47900: cannot be bound: not an address of this machine"),
    (f"sniff -r {'a' * 300}", 1, f"edoras: {'a' * 300}: File name too long"),
    (f"record -r ok.pcap -o {'a' * 300}.mcap", 1, f"edoras: {'a' * 300}.mcap: File name too long"),
    ("recover missing.mcap", 1, "missing.mcap: there is no such file"),
    ("recover folder", 1, "folder: cannot be opened: Is a directory"),
    ("recover .", 1, ".: cannot be opened: Is a directory"),
    ("recover ok.pcap -o ok.pcap", 2, "ok.pcap: is the recording itself"),
    ("recover empty", 1, "empty: is not an MCAP file"),
    ("recover absurd.mcap", 1, "absurd.mcap: it contains nothing to recover"),
    ("sim nothing", 2, "'nothing' is not one of 'rover'"),
    ("sim --hz 0", 2, "--rate"),
    ("sim --rate fast", 2, "'fast' is not a number; see edoras sim -h"),
    ("inject to-add 0x0827 --limit all", 2, "'all' is not a whole number; see edoras inject -h"),
    ("samples ok.pcap", 1, "ok.pcap/README.md: cannot be written: Not a directory"),
    ("sim --host 192.0.2.1 --duration 1", 1, "192.0.2.1"),
    (
        "demo -o ok.pcap/x --duration 1",
        1,
        "ok.pcap/x/missions/rover_ground.yaml: cannot be written: Not a directory",
    ),
]


@pytest.mark.parametrize(("line", "code", "words"), USAGE, ids=[case[0] for case in USAGE])
def test_usage(line, code, words, call, place):
    done = call(*line.split())
    assert done.code == code
    *setup, told = done.err
    assert bool(setup) == line.endswith(" -v"), "which says first what it works with"
    assert words in told
    assert told.startswith("edoras: ")
    assert not (place / "x.mcap").exists()


@pytest.mark.parametrize(
    "line",
    [
        "codegen std_msgs/msg/Bool -o -",
        "structs samples/structs/edoras_app.yaml -o -",
        "samples -",
        "files samples/cfs_files/cf_transfer.pcap -o -",
        "help --man -",
    ],
)
def test_no_folder_is_called_as_standard_output_is(line, call, place):
    before = sorted(item.name for item in place.iterdir())
    done = call(*line.replace("samples/", f"{ROOT}/samples/").split())
    assert (done.code, done.out) == (2, "")
    assert done.err == ["edoras: -: several files are not written to standard output; name a folder"]
    assert sorted(item.name for item in place.iterdir()) == before


@pytest.mark.parametrize(
    "line",
    [
        "mission draft ok.pcap",
        "check --init ok.pcap",
        "xtce -c samples/missions/rover_ground.yaml",
        "report ok.pcap",
        "sweep 0x827 --dry-run --svg -",
    ],
)
def test_no_file_is_called_as_standard_output_is(line, call, place):
    before = sorted(item.name for item in place.iterdir())
    done = call(
        *line.replace("samples", str(ROOT / "samples")).split(), *["-o", "-"] * ("-" not in line.split())
    )
    assert sorted(item.name for item in place.iterdir()) == before
    if line.startswith(("report", "sweep")):
        assert (done.code, done.out) == (2, "")
        assert "-: this is not written to standard output; name a file" in done.err[-1]
    else:
        assert done.out.startswith(("# ", "<?xml"))


def test_a_link_without_traffic_has_a_headline(call):
    done = call("doctor", "--listen", "127.0.0.1:0", "--duration", "100ms")
    assert (done.code, done.out) == (3, "No cFS here: nothing of CI, TO or SBN was examined.\n")


def test_a_port_in_use(call):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        port = taken.getsockname()[1]
        done = call("sniff", "--listen", f"127.0.0.1:{port}")
    assert (done.code, len(done.err)) == (1, 1)
    assert f"another program has port {port}" in done.err[0]


def test_recover_never_overwrites_its_input(call, place, captures):
    assert call("record", "-q", "-r", captures("a_rover"), "-o", "whole.mcap").code == 0
    cut = (place / "whole.mcap").read_bytes()[:-500]
    (place / "cut.mcap").write_bytes(cut)
    done = call("recover", "cut.mcap", "-o", "cut.mcap")
    assert (done.code, len(done.err)) == (2, 1)
    assert "cut.mcap: is the recording itself" in done.err[0]
    assert (place / "cut.mcap").read_bytes() == cut


def test_the_shell_sees_the_same(edoras, place):
    """One case of each kind as a shell runs it: no traceback at exit either."""
    for line, code in (("info text", 1), ("sniff --port x", 2), ("info ok.pcap -c many.yaml", 2)):
        done = edoras(*line.split(), cwd=place)
        assert (done.returncode, done.stdout) == (code, b"")
        assert all(item.startswith(b"edoras: ") for item in done.stderr.splitlines())


MIXED = ("report", "doctor", "info", "record", "export", "plot", "check", "check --init", "compare")


@pytest.mark.quick("doctor", "record", "check")
@pytest.mark.parametrize("name", MIXED)
def test_mixed_clocks_are_told(name, call, tmp_path, monkeypatch, captures, missions, frames, write_pcap):
    """A third of the capture has times since power-up: one line, by every command that looks at its times."""
    monkeypatch.chdir(tmp_path)
    there = frames(captures("a_rover"))
    early = [(time_ns - there[0][0] + 5 * 10**9, *rest) for time_ns, *rest in there[: len(there) // 3]]
    write_pcap("mixed.pcap", early + there[len(early) :])
    more = {
        "report": ["-o", "new.html"],
        "record": ["-o", "new.mcap"],
        "export": ["-o", "new.csv", "--topic", "/cmd_vel"],
        "plot": ["/cmd_vel.linear.x", "-o", "new.svg"],
        "check": [ROOT / "samples/expectations/rover.yaml"],
        "compare": [captures("a_rover")],
    }
    result = call(*name.split(), "mixed.pcap", *more.get(name, ()), *missions("rover_ground"))
    assert result.code in {0, 3}
    told = [line for line in result.err if "some times are before the year 2000 and others are not" in line]
    assert len(told) == 1
    if name == "report":
        assert "some times are before the year 2000" in Path("new.html").read_text()
