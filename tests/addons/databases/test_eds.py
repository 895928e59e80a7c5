"""Design parameters and their arithmetic, against what Python makes of the same text."""

from __future__ import annotations

import random
import re
import struct

import pytest
from effort import examples
from hypothesis import given, settings
from hypothesis import strategies as st
from places import SAMPLES
from xml_damage import damaged

from edoras_tools.addons.databases.eds import Parameters, is_sheet, read_sheets
from edoras_tools.addons.databases.placement import SheetError
from edoras_tools.errors import ConfigError
from edoras_tools.structs import Structs
from edoras_tools.structs.bindings import Bindings
from edoras_tools.structs.files import dumps, load_layout, load_together, parse_layout
from edoras_tools.structs.shapes import OPEN
from edoras_tools.wire import cfe
from edoras_tools.wire.ccsds import VERSION_1

PARAMETERS = Parameters(
    {
        "A/ONE": "1",
        "A/SUM": "${ONE} + 1",
        "A/FAR": "${B/C/DEEP} * 2",
        "B/C/DEEP": " ${A/SUM} ",
        "A/HEADER": "SpacePacketBasic",
        "A/LOOP": "${B/LOOP}",
        "B/LOOP": "${A/LOOP} + 1",
        "A/B0": "x" * 100,
        **{f"A/B{level}": f"${{A/B{level - 1}}}" * 10 for level in range(1, 30)},
    }
)


@pytest.mark.parametrize(
    ("raw", "value"),
    [
        ("5", 5),
        ("0x1F", 31),
        ("${SUM} * 3", 6),
        ("${A/FAR} - 1", 3),
        ("2 ^ 3 ^ 2 - -1", 513),
        ("-2 ^ 2", -4),
        ("2 ^ ${A/ONE}", 2),
        ("(1 + 2) * 7 / 3", 7),
        ("7 / 2", 3.5),
        ("1e3", 1000),
        ("001 + 008", 9),
    ],
)
def test_a_number(raw, value):
    assert PARAMETERS.number(raw, "A") == value


def test_a_text_stands_for_itself():
    assert PARAMETERS.text("CCSDS/${A/HEADER}", "A") == "CCSDS/SpacePacketBasic"
    assert PARAMETERS.text("uint${SUM}", "A") == "uint2"


@pytest.mark.parametrize(
    ("raw", "why"),
    [
        ("${A/NONE}", "parameter A/NONE is in none of these files"),
        ("${LOOP}", "parameter A/LOOP contains itself"),
        ("${B29}", "stands for more than 1000 characters"),
        ("__import__('os').system('true')", "is no number"),
        ("1 +", "is no number"),
        ("1 2", "is no number"),
        ("", "is no number"),
        ("²", "is no number"),
        ("٣", "is no number"),
        ("(1", "a parenthesis is not closed"),
        ("1 / 0", "divides by 0"),
        ("2 ^ 65", "has no value here"),
        ("9 ^ 9 ^ 9 ^ 9", "has no value here"),
        ("0 ^ -1", "has no value here"),
        ("2 ^ 64 * 2", "is over 2^64"),
        ("1e400", "is over 2^64"),
        ("1e19 ^ 64", "is over 2^64"),
        ("(" * 40 + "1" + ")" * 40, "is nested too deeply"),
        ("-" * 900 + "1", "is nested too deeply"),
    ],
)
def test_what_is_no_number(raw, why):
    with pytest.raises(SheetError, match=why.replace("^", r"\^")):
        PARAMETERS.number(raw, "A")


def test_an_integer():
    with pytest.raises(SheetError, match=r"'7 / 2' is 3\.5, no integer"):
        PARAMETERS.integer("7 / 2", "A")
    assert PARAMETERS.integer("7 / 2 * 2", "A") == 7


@settings(max_examples=examples(2000))
@given(st.text("0123456789.x+-*/^() ${}AONE", max_size=40))
def test_any_text_is_a_number_as_python_has_it_or_refused(raw):
    try:
        value = PARAMETERS.number(raw, "A")
    except SheetError:
        return
    if "$" not in raw and "x" not in raw and not any(part.startswith("0") for part in raw.split()):
        try:
            expected = eval(raw.strip().replace("^", "**"))  # of the letters above
        except SyntaxError:  # a zero in front of a number, which Python does not read
            return
        assert value == pytest.approx(expected)


NUMBERS = "".join(
    f'<IntegerDataType name="u{bits}{order[0]}"><IntegerDataEncoding sizeInBits="{bits}" encoding="unsigned" '
    f'byteOrder="{order}Endian"/></IntegerDataType>'
    for bits in (3, 5, 8, 11, 13, 16, 24, 32, 64)
    for order in ("big", "little")
)
TYPES = f"""
{NUMBERS}
<IntegerDataType name="i11"><IntegerDataEncoding sizeInBits="11" encoding="twosComplement"/></IntegerDataType>
<IntegerDataType name="bcd"><IntegerDataEncoding sizeInBits="16" encoding="packedBCD"/></IntegerDataType>
<IntegerDataType name="free"><Range><MinMaxRange min="-5" max="3"/></Range></IntegerDataType>
<FloatDataType name="f64"><FloatDataEncoding sizeInBits="64" encodingAndPrecision="IEEE754_2008_double"/>
</FloatDataType>
<FloatDataType name="mil"><FloatDataEncoding sizeInBits="48" encodingAndPrecision="MILSTD_1750A_extended"/>
</FloatDataType>
<BooleanDataType name="bit"/>
<BooleanDataType name="inverted"><BooleanDataEncoding sizeInBits="8" falseValue="nonZeroIsFalse"/>
</BooleanDataType>
<BinaryDataType name="blob" sizeInBits="24"/>
<StringDataType name="text" length="2 * 3"/>
<EnumeratedDataType name="Color"><EnumerationList><Enumeration label="RED hot" value="0"/>
<Enumeration label="GREEN" value="1 + 0"/><Enumeration label="BLUE"/></EnumerationList></EnumeratedDataType>
<AliasDataType name="alias" type="u16b"/>
<SubRangeDataType name="percent" baseType="u8b" unit="%"><Range><MinMaxRange min="0" max="100"/></Range>
</SubRangeDataType>
<ArrayDataType name="bits" dataTypeRef="bit"><DimensionList><Dimension size="16"/></DimensionList>
</ArrayDataType>
<ArrayDataType name="grid" dataTypeRef="alias"><DimensionList><Dimension size="2"/><Dimension size="3"/>
</DimensionList></ArrayDataType>
<ArrayDataType name="by_color" dataTypeRef="text"><DimensionList><Dimension indexTypeRef="Color"/>
</DimensionList></ArrayDataType>
<ContainerDataType name="Id"><EntryList><Entry name="Value" type="u32b"/></EntryList></ContainerDataType>
<ContainerDataType name="Half"><EntryList><Entry name="a" type="u3b"/></EntryList></ContainerDataType>
<ContainerDataType name="Base"><EntryList><Entry name="first" type="u8b"/></EntryList>
<TrailerEntryList><Entry name="last" type="u16b"/></TrailerEntryList></ContainerDataType>
<ContainerDataType name="Again"><EntryList><Entry name="me" type="Again"/></EntryList></ContainerDataType>
<ContainerDataType name="Twice" baseType="Thrice"/><ContainerDataType name="Thrice" baseType="Twice"/>
"""


def laid(entries, *flags, base="", more=""):
    """Return the container ``P_C`` with these entries: its members, its size, and what was noted."""
    sheet = f"""<PackageFile><Package name="P"><DataTypeSet>{TYPES}{more}
    <ContainerDataType name="C" {base}><EntryList>{entries}</EntryList></ContainerDataType>
    </DataTypeSet></Package></PackageFile>"""
    layout = read_sheets([(sheet.encode(), "s.xml")], flags)
    made = layout.structs["P_C"]
    notes = [item.partition(": ")[2] for item in layout.notes if "P/C" in item]
    rows = []
    for member in made.members:
        place = f"@{member.offset}" + (f".{member.bit}:{member.bits}" if member.bits else "")
        dims = "".join(f"[{size or ''}]" for size in member.dims)
        rows.append(" ".join(filter(None, (member.name, f"{member.type}{dims}", member.order, place))))
    return rows, made.size, notes


def entry(*kinds):
    return "".join(f'<Entry name="e{place}" type="{kind}"/>' for place, kind in enumerate(kinds))


@pytest.mark.parametrize(
    ("kinds", "members", "size"),
    [
        (["u8b", "u16b", "u32b"], ["e0 uint8 @0", "e1 uint16 @1", "e2 uint32 @3"], 7),
        (
            ["u3b", "u13b", "i11", "u5b"],
            ["e0 uint8 @0.0:3", "e1 uint16 @0.3:13", "e2 int16 @2.0:11", "e3 uint8 @3.3:5"],
            4,
        ),
        (["bit", "u16b", "u3b"], ["e0 bool @0.0:1", "e1 uint16 @0.1:16", "e2 uint8 @2.1:3"], 3),
        (["u24b", "f64"], ["e0 uint32 @0.0:24", "e1 float64 @3"], 11),
        (["grid", "text", "by_color"], ["e0 uint16[2][3] @0", "e1 char[6] @12", "e2 char[3][6] @18"], 36),
        (["bits", "blob", "Color"], ["e0 byte[2] @0", "e1 byte[3] @2", "e2 P_Color @5.0:2"], 6),
        (["Id", "alias", "free"], ["e0 uint32 @0", "e1 uint16 @4", "e2 int8 @6.0:4"], 7),
        (["inverted"], ["e0 P_inverted @0"], 1),
    ],
)
def test_packed(kinds, members, size):
    assert laid(entry(*kinds)) == (members, size, [])


@pytest.mark.parametrize(
    ("kinds", "members", "size"),
    [
        (["u8b", "u16b", "u8b", "f64"], ["e0 uint8 @0", "e1 uint16 @2", "e2 uint8 @4", "e3 float64 @8"], 16),
        (["u8b", "bcd", "Base", "u8b"], ["e0 uint8 @0", "e1 byte[2] @2", "e2 P_Base @4", "e3 uint8 @8"], 10),
        (["u3b", "u5b", "u16b"], ["e0 uint8 @0.0:3", "e1 uint8 @0.3:5", "e2 uint16 @2"], 4),
    ],
)
def test_as_in_c(kinds, members, size):
    assert laid(entry(*kinds), "-mlittle-endian")[:2] == (members, size)


def test_little_endian_numbers_where_most_are():
    rows, size, notes = laid(entry("u16l", "u32l", "u3b", "u5b", "u24l", "u16b", "u16l", "u16l"))
    assert rows[:4] == ["e0 uint16 @0", "e1 uint32 @2", "e2 uint8 @6.5:3", "e3 uint8 @6.0:5"]
    assert rows[4:6] == ["e4 uint32 @7.0:24", "e5 uint16 big @10"]
    assert (size, notes) == (16, [])


@pytest.mark.parametrize(
    ("kinds", "members", "note"),
    [
        (["bcd", "u8b"], ["e0 byte[2] @0", "e1 uint8 @2"], "encoding packedBCD; it is shown as bytes"),
        (
            ["mil", "u8b"],
            ["e0 byte[6] @0", "e1 uint8 @6"],
            "encoding MILSTD_1750A_extended of 48 bits; it is shown",
        ),
        (
            ["bit", "text", "u3b"],
            ["e0 bool @0.0:1", "e2 uint8 @6.1:3"],
            "it does not begin and end with a byte",
        ),
        (
            ["bit", "u64b", "u3b"],
            ["e0 bool @0.0:1", "e2 uint8 @8.1:3"],
            "it does not begin and end with a byte",
        ),
        (["u8b", "Half", "u5b"], ["e0 uint8 @0", "e2 uint8 @1.3:5"], "it does not begin and end with a byte"),
        (
            ["u8b", "none"],
            ["e0 uint8 @0", "rest byte[] @1"],
            "type P/none is in none of these files; P/C from there",
        ),
        (["u8b", "Again"], ["e0 uint8 @0", "e1 P_Again @1"], None),
        (["u8b", "Twice"], ["e0 uint8 @0", "rest byte[] @1"], "P/Twice is based on itself"),
    ],
)
def test_what_cannot_be_read_leaves_the_rest(kinds, members, note):
    rows, _, notes = laid(entry(*kinds))
    assert rows[: len(members)] == members
    assert (note is None and notes == []) or note in notes[0]


def test_bases_and_trailers():
    rows, size, _ = laid(entry("u8b"), base='baseType="Base"')
    assert (rows, size) == (["first uint8 @0", "e0 uint8 @1", "last uint16 @2"], 4)


@pytest.mark.parametrize(
    ("tail", "last", "note"),
    [
        ('<ListEntry name="list" type="u16b" listLengthField="e0"/>', "list uint16[] @1", []),
        ('<ListEntry name="list" type="Base" listLengthField="e0"/>', "list P_Base[] @1", []),
        (
            '<ListEntry name="list" type="u3b" listLengthField="e0"/>',
            "list byte[] @1",
            ["P/C.list: its elements are not alike, or of other than whole bytes; it is shown as bytes"],
        ),
        (
            '<Entry name="maybe" type="u8b"><PresentWhen><ValueConstraint/></PresentWhen></Entry>',
            "rest byte[] @1",
            ["P/C.maybe is there only sometimes; P/C from there on is shown as bytes"],
        ),
        (
            '<Surprise name="x" type="u8b"/>',
            "rest byte[] @1",
            ["Surprise is no entry; P/C from there on is shown as bytes"],
        ),
    ],
)
def test_what_reaches_to_the_end(tail, last, note):
    rows, size, notes = laid(entry("u8b") + tail)
    assert (rows, size, notes) == (["e0 uint8 @0", last], 1, note)


def test_a_part_whose_length_varies_ends_what_is_known():
    more = f"""<ContainerDataType name="V"><EntryList>{entry("u8b")}
    <ListEntry name="list" type="u8b" listLengthField="e0"/></EntryList></ContainerDataType>"""
    assert laid(entry("V"), more=more)[0] == ["e0 P_V @0"]
    assert laid(entry("u8b", "V", "u8b"), more=more)[0] == ["e0 uint8 @0", "e1 P_V @1", "rest byte[] @2"]


def test_units_calibrations_and_limits():
    entries = """<Entry name="t" type="percent" unit="degC" shortDescription="of the motor">
    <PolynomialCalibrator><Term coefficient="-40" exponent="0"/><Term coefficient="1 / 2" exponent="2"/>
    </PolynomialCalibrator>
    <NominalRangeSet><MinMaxRange min="0" max="50" rangeType="inclusiveMinExclusiveMax"/>
    </NominalRangeSet></Entry>
    <LengthEntry name="l" type="u16b"><PolynomialCalibrator><Term coefficient="7" exponent="0"/>
    </PolynomialCalibrator></LengthEntry><Entry name="p" type="percent"/><Entry name="u" type="u8b"/>"""
    sheet = f"""<PackageFile><Package name="P"><DataTypeSet>{TYPES}<ContainerDataType name="C">
    <EntryList>{entries}</EntryList></ContainerDataType></DataTypeSet></Package></PackageFile>"""
    motor, length, percent, plain = read_sheets([(sheet.encode(), "s")]).structs["P_C"].members
    assert (motor.unit, motor.doc, motor.polynomial) == ("degC", "of the motor", (-40.0, 0.0, 0.5))
    assert (motor.yellow, motor.red, percent.unit, percent.red) == ((0, 49), (0, 100), "%", (0, 100))
    assert (length.polynomial, plain.red) == ((), None)
    assert motor.calibrated(10) == 10


def test_a_label_without_a_value_follows_the_one_before():
    sheet = f'<PackageFile><Package name="P"><DataTypeSet>{TYPES}</DataTypeSet></Package></PackageFile>'
    layout = read_sheets([(sheet.encode(), "s")])
    assert layout.enums["P_Color"].names == {0: "RED_hot", 1: "GREEN", 2: "BLUE"}


def test_the_values_of_packed_bits(structs_decode):
    """Bits, a text, an array and an enumeration, beside what ``struct`` packs."""
    head = 0b101_0000000010011_1 << 7  # 3, 13 and 1 bits
    payload = head.to_bytes(3, "big") + struct.pack(">6s3H", b"abc", 1, 2, 3)
    values = structs_decode(
        entry("u3b", "u13b", "bit") + '<PaddingEntry sizeInBits="7"/>' + entry("text").replace("e0", "t"),
        payload,
        '<ListEntry name="n" type="u16b" listLengthField="e0"/>',
    )
    assert (values["e0"], values["e1"], values["e2"], values["t"]) == (5, 19, True, "abc")
    assert list(values["n"]) == [1, 2, 3]


@pytest.fixture
def structs_decode():
    """A function: the values of a packet 0x0890 that holds these entries."""

    def decode(entries, payload, tail=""):
        sheet = f"""<PackageFile><Package name="P"><DataTypeSet>{TYPES}
        <ContainerDataType name="C" baseType="CFE_HDR/TelemetryHeader"><EntryList>{entries}{tail}</EntryList>
        </ContainerDataType></DataTypeSet><ComponentSet><Component name="A"><RequiredInterfaceSet>
        <Interface name="I"><GenericTypeMapSet><GenericTypeMap name="T" type="C"/></GenericTypeMapSet>
        </Interface></RequiredInterfaceSet><Implementation>
        <VariableSet><Variable name="v" initialValue="0x90"/></VariableSet><ParameterMapSet>
        <ParameterMap interface="I" parameter="TopicId" variableRef="v"/></ParameterMapSet>
        </Implementation></Component></ComponentSet></Package></PackageFile>"""
        structs = Structs([read_sheets([(sheet.encode(), "s")], ["-DTELEMETRY_BASE_TOPICID=0"])])
        bound = structs.find(0x0890, None, len(payload))
        assert bound.fits(len(payload))
        return structs.types.decode(bound.type, bound.encode_one(payload, (0, 0x0890, 0, 0, 0)))

    return decode


def test_an_array_without_an_end_is_the_last_member():
    assert OPEN == 0, "a dimension of 0 in a sheet must not become one"
    more = '<ArrayDataType name="no" dataTypeRef="u8b"><DimensionList><Dimension size="0"/></DimensionList>'
    more += "</ArrayDataType>"
    assert laid(entry("no", "u8b"), more=more)[0] == ["e1 uint8 @0"]


ROVER = [SAMPLES / f"structs/rover_{name}.xml" for name in ("app", "topics")]
FILES = [(path.read_bytes(), path.name) for path in ROVER]
SHEET_TYPES = """<IntegerDataType name="u8b"><IntegerDataEncoding sizeInBits="8"/></IntegerDataType>
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
    return f"""<{root}><Package name="P"><DataTypeSet>{SHEET_TYPES}{data_types}</DataTypeSet><ComponentSet>
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
