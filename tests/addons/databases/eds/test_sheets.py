"""Sheets as a whole: the packets of their components, what is noted, and damaged ones."""

import random
import re
import struct

import pytest
from effort import examples
from places import SAMPLES
from xml_damage import damaged

from edoras_tools.addons.databases.eds.sheets import is_sheet, read_sheets
from edoras_tools.errors import ConfigError
from edoras_tools.structs.bindings import Bindings
from edoras_tools.structs.files import dumps, load_layout, load_together, parse_layout
from edoras_tools.wire import cfe
from edoras_tools.wire.msg_id import VERSION_1

ROVER = [SAMPLES / f"structs/rover_{name}.xml" for name in ("app", "topics")]
FILES = [(path.read_bytes(), path.name) for path in ROVER]
TYPES = """<IntegerDataType name="u8b"><IntegerDataEncoding sizeInBits="8"/></IntegerDataType>
<IntegerDataType name="u16b"><IntegerDataEncoding sizeInBits="16"/></IntegerDataType>
<ContainerDataType name="Id"><EntryList><Entry name="value" type="u16b"/></EntryList></ContainerDataType>"""
PAYLOAD = struct.pack(">BBHb3x20s8f", 7, 1, 200 << 6 | 1 << 5 | 3, -1, b"ada", *range(8))
"""200 of the battery, which charges; sensors 3; lost."""


def packets(layout):
    return {str(key): name for key, name in layout.bindings.items()}


def test_the_packets_of_a_component():
    layout = load_together(ROVER)
    assert packets(layout) == {
        "0x0890": "ROVER_HkTlm",
        "0x1890/0": "ROVER_NoopCmd",
        "0x1890/2": "ROVER_DriveCmd",
    }
    assert (layout.byte_order, layout.notes, layout.structs["ROVER_DriveCmd"].doc) == (
        "big",
        (),
        "drive to a place",
    )
    assert layout.enums["ROVER_Mode"].names == {0: "IDLE", 1: "DRIVING", -1: "LOST"}
    again = parse_layout(dumps(layout).encode(), "again")
    assert (again.structs, again.enums, again.bindings) == (layout.structs, layout.enums, layout.bindings)


def test_one_sheet_is_a_layout_file():
    layout = load_layout(ROVER[0])
    assert packets(layout) == {}
    assert layout.notes == tuple(
        f"{ROVER[0]}:{line}: topic of {name}: "
        f"parameter CFE_MISSION/ROVER_{name}_TOPICID is in none of these files"
        for line, name in ((72, "CMD"), (75, "HK_TLM"))
    )


def sheet(data_types, interfaces, topics=("0x90",), root="PackageFile"):
    """Return a sheet of package P, whose component has these interfaces, and so many topics."""
    variables = "".join(f'<Variable name="v{at}" initialValue="{topic}"/>' for at, topic in enumerate(topics))
    maps = "".join(
        f'<ParameterMap interface="i{at}" parameter="TopicId" variableRef="v{at}"/>'
        for at in range(len(topics))
    )
    named = "".join(
        f'<Interface name="i{at}"><GenericTypeMapSet><GenericTypeMap name="T" type="{kind}"/>'
        "</GenericTypeMapSet></Interface>"
        for at, kind in enumerate(interfaces)
    )
    return f"""<{root}><Package name="P"><DataTypeSet>{TYPES}{data_types}</DataTypeSet><ComponentSet>
    <Component name="A"><RequiredInterfaceSet>{named}</RequiredInterfaceSet><Implementation>
    <VariableSet>{variables}</VariableSet><ParameterMapSet>{maps}</ParameterMapSet></Implementation></Component>
    </ComponentSet></Package></{root}>""".encode()


BASES = ["-DTELECOMMAND_BASE_TOPICID=0", "-DTELEMETRY_BASE_TOPICID=256", "-DGLOBAL_CMD_BASE_TOPICID=-8"]
COMMAND = '<ContainerDataType name="{}" baseType="{}">{}</ContainerDataType>'
CODE = '<ConstraintSet><ValueConstraint entry="Sec.FunctionCode" value="{}"/></ConstraintSet>'
ENTRY = '<EntryList><Entry name="a" type="u16b"/></EntryList>'
TREE = (
    (
        COMMAND.format("Base", "CFE_HDR/CommandHeader", ENTRY)
        + COMMAND.format("Middle", "Base", CODE.format(4))
        + COMMAND.format("Leaf", "Middle", ENTRY.replace("a", "b"))
        + COMMAND.format("Tlm", "CFE_HDR/TelemetryHeader", ENTRY)
        + COMMAND.format("Bare", "CFE_HDR/CommandHeader", "")
        + COMMAND.format("Odd", "Base", CODE.format(400))
        + COMMAND.format("Free", "Base", ENTRY)
    )
    .replace('name="Base"', 'name="B"')
    .replace('Type="Base"', 'Type="B"')
)


@pytest.mark.parametrize(
    ("interfaces", "topics", "found", "notes"),
    [
        (["Tlm"], ["0x190"], {"0x0890": "P_Tlm"}, []),
        (["Bare"], ["0x90"], {"0x1890/0": "P_Bare"}, []),
        (["Leaf"], ["-7"], {"0x1861": "P_Leaf"}, []),
        (["Middle"], ["0x90"], {"0x1890/4": "P_Leaf"}, []),
        (["Tlm", "Tlm"], ["300", "300"], {"0x082c": "P_Tlm"}, []),
        (["Tlm", "Bare"], ["300", "30"], {"0x082c": "P_Tlm", "0x181e/0": "P_Bare"}, []),
        (["Tlm"], ["30"], {}, ["A.i0 of P: topic 30 is not one of telemetry"]),
        (["Tlm"], ["9 +"], {}, ["topic of i0: '9 +' is no number"]),
        (
            ["Id"],
            ["30"],
            {},
            ["A.i0 of P: P/Id is based on none of CFE_HDR/CommandHeader, CFE_HDR/TelemetryHeader"],
        ),
        (["B"], ["30"], {"0x181e/4": "P_Middle"}, ["function code 400 of P/Odd is not 0 to 127"]),
    ],
)
def test_topics_and_function_codes(interfaces, topics, found, notes):
    layout = read_sheets([(sheet(TREE, interfaces, topics), "s")], [*BASES, "-DGLOBAL_TLM_BASE_TOPICID=900"])
    assert packets(layout).items() >= found.items()
    assert [note for note in notes if not any(note in line for line in layout.notes)] == []


def test_what_is_there_twice():
    tlm = COMMAND.format("T2", "CFE_HDR/TelemetryHeader", ENTRY)
    files = [
        (sheet(TREE + tlm, ["Tlm", "T2"], ["300", "300"]), "a"),
        (sheet("", []), "b"),
        (
            b'<DesignParameters><Package name="P"><Define name="X" value="1"/></Package></DesignParameters>',
            "c",
        ),
        (
            b'<DesignParameters><Package name="P"><Define name="X" value="2"/></Package></DesignParameters>',
            "d",
        ),
        (b"<Telemetry/>", "e"),
    ]
    notes = read_sheets(files, BASES).notes
    for text in (
        ": 0x082c is P_Tlm already, not P_T2",
        ": type P/Id is declared in a:",
        "d:1: parameter P/X has another value in an earlier file, which holds",
        "e:1: Telemetry is no data sheet",
    ):
        assert any(text in line for line in notes), text


def test_what_is_not_read_is_noted_once_with_its_line():
    more = (
        '<ContainerDataType name="C"><EntryList><Entry name="a" type="u8b"><SplineCalibrator><SplinePoint/>\n'
    )
    more += '</SplineCalibrator></Entry>\n<Entry name="b" type="u8b"><SplineCalibrator/></Entry></EntryList>'
    more += "</ContainerDataType>"
    layout = read_sheets([(sheet(more, []), "s")])
    (note,) = [line for line in layout.notes if "Spline" in line]
    assert re.fullmatch(r"s:\d+: SplineCalibrator is not read", note)
    assert len(layout.structs["P_C"].members) == 2


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (
            ["-O2"],
            "--cflag: '-O2' says nothing of data sheets; there are -DPACKAGE/NAME=VALUE, -mlittle-endian and",
        ),
        (["-DX"], "--cflag: '-DX' says nothing of data sheets"),
    ],
)
def test_flags_that_say_nothing(flags, message):
    with pytest.raises(ConfigError, match=re.escape(message)):
        read_sheets(FILES, flags)


def test_a_flag_comes_before_what_sheets_say():
    layout = read_sheets(
        FILES, ["-DROVER_CMD_TOPICID=10", "-DCFE_MISSION/ROVER_HK_TLM_TOPICID=265", "-mlittle-endian"]
    )
    assert sorted(packets(layout)) == ["0x0800", "0x1801/0", "0x1801/2"]
    assert layout.byte_order == "little"


def test_files_that_are_no_sheets(tmp_path):
    assert is_sheet(FILES[0][0])
    assert is_sheet(b"\xef\xbb\xbf" + FILES[1][0])
    assert not is_sheet(b"structs: {}  # <PackageFile>")
    (tmp_path / "a.yaml").write_text("structs: {A: {members: {x: uint8}}}")
    with pytest.raises(ConfigError, match="a second file, which only data sheets have; name one"):
        load_together([tmp_path / "a.yaml", ROVER[0]])
    with pytest.raises(ConfigError, match="no container in it; name the sheets of packages, too"):
        load_together([ROVER[1]])


def test_from_sheets_to_a_recording_and_the_doctor(call, tmp_path, write_pcap):
    """List and filters name the values, and the doctor says which are outside limits."""
    done = call("structs", *ROVER, "-o", tmp_path / "rover")
    assert (done.code, done.err) == (0, [])
    low = PAYLOAD[:2] + struct.pack(">H", 100 << 6) + PAYLOAD[4:]
    drive = cfe.emit_command(0x1890, 2, struct.pack(">ffH", 3, 4, 500))
    sent = [cfe.emit_telemetry(0x0890, PAYLOAD), cfe.emit_telemetry(0x0890, low, sequence_count=1), drive]
    sent.append(cfe.emit_command(0x1890, 0))
    capture = write_pcap(
        tmp_path / "a.pcap",
        [(place * 10**9, _frame(item), len(_frame(item))) for place, item in enumerate(sent)],
    )
    read = ("--structs", tmp_path / "rover")
    first, _, last, bare = call("sniff", "-r", capture, *read, "--json").lines()
    assert (first["topic"], first["message"]["driver"], first["message"]["mode"]) == (
        "/cfs/ROVER_HkTlm",
        "ada",
        -1,
    )
    assert (first["message"]["battery"], first["message"]["charging"], first["message"]["sensors"]) == (
        200,
        True,
        3,
    )
    assert (last["topic"], last["message"]["target"], last["message"]["speed"]) == (
        *("/cfs/ROVER_DriveCmd", {"x": 3.0, "y": 4.0}, 500),
    )
    assert (bare["topic"], [*bare["message"]]) == ("/cfs/ROVER_NoopCmd", ["header"])
    lines = call("sniff", "-r", capture, *read).out.splitlines()[1:]
    names = [line.split("  ") for line in lines]
    assert [[item.strip() for item in words if "ROVER" in item] for words in names] == [
        *(["ROVER_HkTlm"], ["ROVER_HkTlm"], ["/cfs/ROVER_DriveCmd"], ["/cfs/ROVER_NoopCmd"]),
    ]
    listed = call("sniff", "-r", capture, *read, "--where", "mode == LOST and battery > 150", "-V").out
    assert "11 V (200)" in listed
    assert "of the main bus" in listed
    verdicts = call("doctor", capture, *read, "--json").json()["verdicts"]
    (limits,) = [item for item in verdicts if item["rule"] == "value_limits"]
    assert limits["reason"] == "ROVER_HkTlm.battery: 2 values outside its limits, 1 outside the red ones"
    assert (limits["msg_id"], limits["severity"]) == ("0x0890", "warning")
    assert "lowest 10 V, highest 11 V; limits: yellow 11.5 to 16.8, red 10.5 to any" in limits["evidence"]
    rows = call("info", capture, *read, "--json").json()["routes"]
    assert [(row["topic"], row["type"], row["name"], row.get("topics")) for row in rows] == [
        ("/cfs/ROVER_HkTlm", "cfs_msgs/msg/RoverHkTlm", None, None),
        (*(None, None), "ROVER_NoopCmd, ROVER_DriveCmd", {"/cfs/ROVER_NoopCmd": 1, "/cfs/ROVER_DriveCmd": 1}),
    ]
    report = call("doctor", capture, *read, "--json").json()
    assert {(row["msg_id"], row["topic"], row["type"], row["name"]) for row in report["routes"]} == {
        ("0x0890", "/cfs/ROVER_HkTlm", "cfs_msgs/msg/RoverHkTlm", "ROVER_HkTlm"),
        ("0x1890", None, None, "ROVER_NoopCmd, ROVER_DriveCmd"),
    }
    assert {row["topic"] for row in report["balance"] if row["msg_id"] == "0x0890"} == {"/cfs/ROVER_HkTlm"}
    done = call("record", "-r", capture, *read, "-o", tmp_path / "a.mcap")
    assert "4 messages on 3 topics" in done.err[-1]
    assert [item["topic"] for item in call("sniff", "-r", tmp_path / "a.mcap", "--json").lines()] == [
        *("/cfs/ROVER_HkTlm", "/cfs/ROVER_HkTlm", "/cfs/ROVER_DriveCmd", "/cfs/ROVER_NoopCmd"),
    ]


def _frame(packet):
    port = 1234 if VERSION_1.is_command(packet[0] << 8) else 1235
    udp = struct.pack(">HHHH", 40000, port, 8 + len(packet), 0) + packet
    host = bytes((127, 0, 0, 1))
    return (
        bytes(12)
        + b"\x08\0"
        + struct.pack(">BBHHHBBH", 0x45, 0, 20 + len(udp), 0, 0, 64, 17, 0)
        + 2 * host
        + udp
    )


@pytest.mark.parametrize("seed", range(examples(300, part=8)))
def test_a_damaged_sheet_is_read_or_refused_in_a_line(seed):
    draw = random.Random(seed)
    files = list(FILES)
    at = draw.randrange(8) == 0
    files[at] = damaged(files[at][0], draw), files[at][1]
    try:
        layout = read_sheets(files)
    except ConfigError as error:
        layout, lines = None, str(error).splitlines()
    else:
        lines = layout.notes
    assert [line for line in lines if not re.match(r"rover_\w+\.xml(:\d+)?: ", line)] == []
    if layout:
        Bindings([layout])
        assert parse_layout(dumps(layout).encode(), "again").structs == layout.structs
