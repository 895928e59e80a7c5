"""Where entries lie: packed bit by bit as CCSDS 876.0 says, or as in the C structs of a machine."""

import struct

import pytest

from edoras_tools.addons.databases.eds.sheets import read_sheets
from edoras_tools.structs import Structs
from edoras_tools.structs.shapes import OPEN

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
