"""What the types of XTCE are: bytes, texts for values, units, calibrations, limits."""

from __future__ import annotations

import pytest

from edoras_tools.addons.databases.placement import Notes, SheetError, parse_document
from edoras_tools.addons.databases.xtce.systems import read_systems
from edoras_tools.addons.databases.xtce.types import Declarations, number
from edoras_tools.structs.files import type_text

SYSTEM = """<SpaceSystem name="S"><TelemetryMetaData><ParameterTypeSet>{}</ParameterTypeSet><ParameterSet>
<Parameter name="v" parameterTypeRef="t"/></ParameterSet><ContainerSet><SequenceContainer name="c"><EntryList>
<ParameterRefEntry parameterRef="v"/></EntryList></SequenceContainer>
</ContainerSet></TelemetryMetaData>
</SpaceSystem>"""
U8 = '<IntegerParameterType name="u8"><IntegerDataEncoding/></IntegerParameterType>'
COORDINATES = f"""{U8}<AggregateParameterType name="xy"><MemberList><Member name="x" typeRef="u8"/>
<Member name="y"
typeRef="u8"/></MemberList></AggregateParameterType>"""


def read(types):
    return read_systems([(SYSTEM.format(types).encode(), "s")])


def of(kind, encoding, more="", attributes=""):
    return f'<{kind}ParameterType name="t" {attributes}>{encoding}{more}</{kind}ParameterType>'


def integer(bits, words="", inside=""):
    return f'<IntegerDataEncoding sizeInBits="{bits}" {words}>{inside}</IntegerDataEncoding>'


FIVE = """<DimensionList><Dimension><StartingIndex><FixedValue>0</FixedValue></StartingIndex><EndingIndex>
<FixedValue>4</FixedValue></EndingIndex></Dimension></DimensionList>"""
LITTLE = 'byteOrder="leastSignificantByteFirst"'


@pytest.mark.parametrize(
    ("types", "expected"),
    [
        (of("Integer", "<IntegerDataEncoding/>"), "uint8"),
        (of("Integer", integer(16, 'encoding="twosComplement"')), "int16"),
        (of("Integer", integer(12)), "uint16:12"),
        (of("Integer", integer(32, LITTLE)), "uint32"),
        (of("Float", "<FloatDataEncoding/>"), "float32"),
        (of("Float", '<FloatDataEncoding sizeInBits="64" encoding="IEEE754"/>'), "float64"),
        (of("Float", integer(16)), "uint16"),
        (of("Boolean", integer(1)), "bool:1"),
        (of("Boolean", integer(8), attributes='zeroStringValue="OFF" oneStringValue="ON"'), "t"),
        (
            of(
                "Enumerated",
                integer(8),
                '<EnumerationList><Enumeration value="2" label="A B"/></EnumerationList>',
            ),
            "t",
        ),
        (
            of(
                "String",
                "<StringDataEncoding><SizeInBits><Fixed><FixedValue>64</FixedValue></Fixed></SizeInBits>"
                "</StringDataEncoding>",
            ),
            "char[8]",
        ),
        (
            of(
                "Binary",
                "<BinaryDataEncoding><SizeInBits><FixedValue>24</FixedValue></SizeInBits>"
                "</BinaryDataEncoding>",
            ),
            "byte[3]",
        ),
        (of("AbsoluteTime", f"<Encoding>{integer(32)}</Encoding>"), "uint32"),
        (COORDINATES + of("Array", FIVE, attributes='arrayTypeRef="xy"'), "xy[5]"),
        (f'{U8}<IntegerParameterType name="t" baseType="u8"/>', "uint8"),
    ],
)
def test_what_a_type_is(types, expected):
    layout = read(types)
    (member,) = layout.structs["c"].members
    assert type_text(member) == expected
    assert [note for note in layout.notes if "c.v" in note or ": /S/c: " in note] == []
    assert layout.byte_order == ("little" if LITTLE in types else "big")


@pytest.mark.parametrize(
    ("types", "note"),
    [
        (
            of("Integer", integer(16, 'encoding="onesComplement"')),
            "encoding onesComplement of 16 bits; it is shown",
        ),
        (
            of("Float", '<FloatDataEncoding sizeInBits="48"/>'),
            "encoding IEEE754_1985 of 48 bits; it is shown",
        ),
        (of("Integer", integer(128)), "128 bits; it is shown"),
        (
            of(
                "String",
                '<StringDataEncoding encoding="UTF-16"><SizeInBits><Fixed><FixedValue>64</FixedValue></Fixed>'
                "</SizeInBits></StringDataEncoding>",
            ),
            "encoding UTF-16; it is shown",
        ),
        (of("Integer", integer(16, 'byteOrder="2,1"')), "byte order 2,1; it is shown"),
        (of("Integer", ""), "type /S/t has no encoding, so its value is in no packet; /S/c from there on"),
        (of("Array", "", attributes='arrayTypeRef="t"'), "type /S/t contains itself"),
        (of("Integer", "", attributes='baseType="t"'), "type /S/t is based on itself"),
        (of("Integer", integer(10**9)), "is no number of bits"),
        ("", "parameter type t is in none of these files"),
    ],
)
def test_what_cannot_be_read_is_noted_and_shown_as_bytes(types, note):
    layout = read(types)
    assert [line for line in layout.notes if note in line], layout.notes
    (member,) = layout.structs["c"].members
    assert type_text(member).startswith("byte[")


def test_texts_for_values():
    listed = "".join(
        f'<Enumeration value="{value}" label="{label}"/>'
        for value, label in ((0, "OFF"), (-1, "?"), ("x", "y"))
    )
    layout = read(
        of(
            "Enumerated",
            integer(8, 'encoding="twosComplement"'),
            f"<EnumerationList>{listed}</EnumerationList>",
        )
    )
    assert (layout.enums["t"].names, str(layout.enums["t"].basic)) == ({0: "OFF", -1: "_"}, "int8")
    assert "s:1: Enumeration: 'x' is no number" in layout.notes


def test_a_text_for_a_value_that_the_number_cannot_hold_takes_no_name():
    listed = '<Enumeration value="300" label="A B"/><Enumeration value="1" label="A-B"/>'
    layout = read(of("Enumerated", integer(8), f"<EnumerationList>{listed}</EnumerationList>"))
    assert layout.enums["t"].names == {1: "A_B"}


def test_unit_calibration_and_limits():
    calibrator = "<DefaultCalibrator><PolynomialCalibrator>{}</PolynomialCalibrator></DefaultCalibrator>"
    terms = '<Term exponent="0" coefficient="-40"/><Term exponent="2" coefficient="0.5"/>'
    alarms = '<WarningRange minInclusive="-10" maxExclusive="30"/><CriticalRange maxInclusive="4.5e1"/>'
    more = f"<DefaultAlarm><StaticAlarmRanges>{alarms}</StaticAlarmRanges></DefaultAlarm>"
    unit = "<UnitSet><Unit>deg\n C</Unit></UnitSet>"
    layout = read(of("Float", unit + integer(8, "", calibrator.format(terms)), more))
    (member,) = layout.structs["c"].members
    assert (member.unit, member.polynomial) == ("deg C", (-40, 0.0, 0.5))
    assert (member.yellow, member.red) == ((-10, 29), (None, 45.0))
    assert layout.notes == ("s:3: /S/c is bound to no packet: nothing says its APID",)


@pytest.mark.parametrize(
    ("inside", "note"),
    [
        (
            "<DefaultCalibrator><SplineCalibrator/></DefaultCalibrator>",
            "SplineCalibrator is not read: the number is",
        ),
        ("<ContextCalibratorList/>", "ContextCalibratorList is not read"),
    ],
)
def test_another_calibration_leaves_the_number(inside, note):
    layout = read(of("Float", integer(8, "", inside)))
    assert type_text(layout.structs["c"].members[0]) == "uint8"
    assert any(note in line for line in layout.notes)


@pytest.mark.parametrize(
    ("text", "value"), [("12", 12), ("0x1F", 31), ("-3", -3), ("2.50", 2.5), ("1e3", 1000.0)]
)
def test_a_number(text, value):
    assert (number(parse_document(b"<A/>", "a"), text), type(number(parse_document(b"<A/>", "a"), text))) == (
        value,
        type(value),
    )


@pytest.mark.parametrize("text", ["", "x", "nan", "inf", "1e301", "0x", "1_0", "--1"])
def test_what_is_no_number(text):
    with pytest.raises(SheetError, match="is no number"):
        number(parse_document(b"<A/>", "a"), text)


TREE = b"""<SpaceSystem name="A"><TelemetryMetaData><ParameterSet><Parameter name="x"/><Parameter name="x"/>
</ParameterSet></TelemetryMetaData><SpaceSystem name="B"><TelemetryMetaData><ParameterSet>
<Parameter name="x"/>
<Parameter name="y"/></ParameterSet></TelemetryMetaData></SpaceSystem></SpaceSystem>"""
OTHER = b"""<SpaceSystem name="C"><TelemetryMetaData><ParameterSet><Parameter name="z"/></ParameterSet>
</TelemetryMetaData></SpaceSystem>"""


@pytest.fixture
def names():
    notes = Notes()
    names = Declarations([parse_document(TREE, "a"), parse_document(OTHER, "c")], notes)
    assert notes.lines() == ("a:1: parameter /A/x is declared twice; the first holds",)
    return names


@pytest.mark.parametrize(
    ("name", "system", "path"),
    [
        ("x", "/A/B", "/A/B/x"),
        ("x", "/A", "/A/x"),
        ("../x", "/A/B", "/A/x"),
        ("B/y", "/A", "/A/B/y"),
        ("/A/B/y", "/C", "/A/B/y"),
        ("A/x", "/A/B", "/A/x"),
        ("/elsewhere/z", "/A", "/C/z"),
        ("../D/y", "/C", "/A/B/y"),
    ],
)
def test_a_name_is_looked_for_outwards(names, name, system, path):
    assert names.find("parameter", name, system).path == path


@pytest.mark.parametrize("name", ["q", "/D/x", "", "/", "//", ".."])
def test_what_nothing_or_more_than_one_has(names, name):
    with pytest.raises(SheetError, match="is in none of these files"):
        names.find("parameter", name, "/C")


@pytest.mark.parametrize(
    ("name", "path", "member"),
    [("x/a/b", "/A/x", "/a/b"), ("x.a", "/A/x", "/a"), ("x", "/A/x", ""), ("B/y.m", "/A/B/y", "/m")],
)
def test_a_member_of_a_parameter(names, name, path, member):
    item, rest = names.find_member(name, "/A")
    assert (item.path, rest) == (path, member)


def test_a_member_of_nothing(names):
    with pytest.raises(SheetError, match=r"parameter q\.a is in none"):
        names.find_member("q.a", "/A")
