"""Space systems as a whole: which packets there are, what we wrote read again, and damaged files."""

import json
import random
import re
from functools import cache

import pytest
from effort import examples
from ground_packets import DRIVE, drive_payload, struct_bench
from hypothesis import given
from hypothesis import strategies as st
from places import SAMPLES
from xml_damage import damaged

from edoras_tools.addons.codegen.ground import struct_packet, xtce
from edoras_tools.addons.codegen.writing import describe_packets
from edoras_tools.addons.databases.xtce.systems import is_system, read_system, read_systems
from edoras_tools.errors import ConfigError
from edoras_tools.pipelines.workbench import Settings
from edoras_tools.structs import files as cfe_structs
from edoras_tools.structs.bindings import Bindings
from edoras_tools.structs.files import dumps, load_together, parse_layout, type_text
from edoras_tools.wire import cfe

TYPES = """<IntegerParameterType name="u3"><IntegerDataEncoding sizeInBits="3"/></IntegerParameterType>
<BooleanParameterType name="kind" zeroStringValue="TM" oneStringValue="TC">
<IntegerDataEncoding sizeInBits="1"/>
</BooleanParameterType><IntegerParameterType name="u11"><IntegerDataEncoding sizeInBits="11"/>
</IntegerParameterType>
<IntegerParameterType name="u16"><IntegerDataEncoding sizeInBits="16"/></IntegerParameterType>
<BinaryParameterType name="b6"><BinaryDataEncoding><SizeInBits><FixedValue>48</FixedValue></SizeInBits>
</BinaryDataEncoding></BinaryParameterType>
<AggregateParameterType name="id"><MemberList><Member name="version" typeRef="u3"/>
<Member name="type" typeRef="kind"/>
<Member name="secondary" typeRef="kind"/><Member name="apid" typeRef="u11"/></MemberList>
</AggregateParameterType>"""
PARAMETERS = "".join(
    f'<Parameter name="{name}" parameterTypeRef="{kind}"/>'
    for name, kind in (
        ("id", "id"),
        ("count", "u16"),
        ("length", "u16"),
        ("time", "b6"),
        ("a", "u16"),
        ("b", "u16"),
    )
)
"""Headers as ground systems have them: the first word an aggregate, flags with texts."""


def entries(*names):
    return (
        "<EntryList>"
        + "".join(f'<ParameterRefEntry parameterRef="{name}"/>' for name in names)
        + "</EntryList>"
    )


def container(name, base, conditions, *names, words=""):
    compared = "".join(f'<Comparison parameterRef="{item}" value="{value}"/>' for item, value in conditions)
    restricted = f"<RestrictionCriteria><ComparisonList>{compared}</ComparisonList></RestrictionCriteria>"
    based = f'<BaseContainer containerRef="{base}">{restricted}</BaseContainer>' * bool(base)
    return f'<SequenceContainer name="{name}" {words}>{entries(*names)}{based}</SequenceContainer>'


HEADERS = container("primary", "", [], "id", "count", "length", words='abstract="true"')
HEADERS += container("tlm", "primary", [("id/type", "TM")], "time", words='abstract="true"')


def system(containers, commands=""):
    return f"""<?xml version="1.0"?><x:SpaceSystem xmlns:x="http://www.omg.org/spec/XTCE/20180204" name="S">
<TelemetryMetaData><ParameterTypeSet>{TYPES}</ParameterTypeSet>
<ParameterSet>{PARAMETERS}</ParameterSet><ContainerSet>
{HEADERS}{containers}</ContainerSet></TelemetryMetaData><CommandMetaData>{commands}</CommandMetaData>
</x:SpaceSystem>""".encode()


def packets(layout):
    return {str(key): (name, layout.structs[name].size) for key, name in layout.bindings.items()}


NO_APID = "is bound to no packet: nothing says its APID"


@pytest.mark.parametrize(
    ("containers", "expected", "note"),
    [
        (container("A", "tlm", [("id/apid", 5)], "a", "b"), {"0x0805": ("A", 4)}, ""),
        (container("A", "tlm", [("id.apid", "0x90"), ("id/secondary", 1)], "a"), {"0x0890": ("A", 2)}, ""),
        (container("A", "tlm", [("id/apid", 5), ("id/secondary", "TM")], "a"), {}, "no secondary header"),
        (container("A", "tlm", [], "a"), {}, NO_APID),
        (container("A", "tlm", [("id/apid", 5), ("id/version", 1)], "a"), {}, NO_APID),
        (container("A", "primary", [("id/apid", 5)], "time", "a"), {"0x0805": ("A", 2)}, ""),
        (
            container("A", "tlm", [("id/apid", 5)], "a") + container("B", "A", [("a", 3)], "b"),
            {"0x0805": ("A", 2)},
            "/S/B holds under a condition on more than the MsgId",
        ),
        (
            container("A", "tlm", [("id/apid", 5)], "a") + container("B", "tlm", [("id/apid", 5)], "b"),
            {"0x0805": ("A", 2)},
            "0x0805 is A already, not B",
        ),
        (
            container("A", "B", []) + container("B", "A", []) + container("C", "", [], "a"),
            {},
            "it is based on itself",
        ),
        (
            container("A", "tlm", [("id/apid", "x")], "a") + container("C", "", [], "a"),
            {},
            "Comparison: 'x' is no number",
        ),
        (container("A", "tlm", [("id/apid", 5)], "a", "q"), {"0x0805": ("A", 2)}, "parameter q is in none"),
    ],
)
def test_which_packets_a_container_is(containers, expected, note):
    layout = read_system(system(containers), "s")
    assert packets(layout) == expected
    assert any(note in line for line in layout.notes) or not note
    assert all(line.startswith("s:") for line in layout.notes)


COMMANDS = """<ArgumentTypeSet><IntegerArgumentType name="u16"><IntegerDataEncoding sizeInBits="16"/>
</IntegerArgumentType>
<IntegerArgumentType name="u8"><IntegerDataEncoding/></IntegerArgumentType></ArgumentTypeSet><MetaCommandSet>
<MetaCommand name="Base" abstract="true"><ArgumentList><Argument name="id" argumentTypeRef="u16"/>
<Argument name="code" argumentTypeRef="u8"/></ArgumentList><CommandContainer name="c"><EntryList>
<ArgumentRefEntry argumentRef="id"/><FixedValueEntry binaryValue="C0000000" sizeInBits="32"/>
<ArgumentRefEntry argumentRef="code"/><FixedValueEntry binaryValue="00" sizeInBits="8"/></EntryList>
</CommandContainer>
</MetaCommand>{}</MetaCommandSet>"""


def command(name, assigned, *names):
    given = "".join(
        f'<ArgumentAssignment argumentName="{key}" argumentValue="{item}"/>' for key, item in assigned
    )
    listed = "".join(f'<Argument name="{item}" argumentTypeRef="u16"/>' for item in names)
    used = "".join(f'<ArgumentRefEntry argumentRef="{item}"/>' for item in names)
    return f"""<MetaCommand name="{name}"><BaseMetaCommand metaCommandRef="Base">
<ArgumentAssignmentList>{given}
</ArgumentAssignmentList></BaseMetaCommand><ArgumentList>{listed}</ArgumentList>
<CommandContainer name="{name}"><EntryList>
{used}</EntryList><BaseContainer containerRef="c"/></CommandContainer></MetaCommand>"""


@pytest.mark.parametrize(
    ("assigned", "expected"),
    [
        ([("id", "0x1890"), ("code", 2)], {"0x1890/2": ("Go", 4)}),
        ([("id", "0x1090"), ("code", 2)], {}),
        ([("id", "0x1890")], {}),
        ([("code", 2)], {}),
    ],
)
def test_which_packets_a_command_is(assigned, expected):
    layout = read_system(system("", COMMANDS.format(command("Go", assigned, "x", "y"))), "s")
    assert packets(layout) == expected
    assert [item.name for item in layout.structs["Go"].members][-2:] == ["x", "y"]


def test_entries_with_a_place_of_their_own():
    place = """<ParameterRefEntry parameterRef="b"><LocationInContainerInBits referenceLocation="{}">
<FixedValue>{}
</FixedValue></LocationInContainerInBits></ParameterRefEntry>"""
    for reference, bits, expected in (
        ("previousEntry", 8, [("a", 0), ("b", 3)]),
        ("containerStart", 128, [("a", 0), ("b", 4)]),
        ("containerStart", 96, [("a", 0)]),
        ("containerEnd", 0, [("a", 0), ("rest", 2)]),
    ):
        made = container("A", "tlm", [("id/apid", 5)], "a").replace(
            "</EntryList>", place.format(reference, bits) + "</EntryList>"
        )
        layout = read_system(system(made), "s")
        assert [(item.name, item.offset) for item in layout.structs["A"].members] == expected
        assert (layout.notes == ()) == (len(expected) == 2 and expected[1][0] == "b")


def described(layout):
    """Return the packets of a layout as ground systems are told of them, if they are."""
    made = [struct_packet(item) for item in Bindings([layout]).all if item.key.port is None]
    return {
        (item.msg_id, item.function_code): item for item in made if item.whole or not item.msg_id & 0x1000
    }


def values(packet):
    """Return each value of a packet: name, place, bytes, and what it means; padding left out."""
    found, bit = [], 0
    for item in packet.items:
        name = re.sub(r"[\W_]+", "_", item.name).strip("_")
        meaning = item.member and (
            item.member.unit,
            item.member.polynomial,
            item.member.yellow,
            item.member.red,
        )
        enum = item.enum and (item.enum.names, item.enum.basic)
        order = item.little or item.bits <= 8 or item.encoding in {"bytes", "text"}
        if name:
            found.append((name, bit, item.encoding, item.bits, order, enum, meaning))
        bit += item.bits
    return found


def again(layout, headers=cfe.STANDARD):
    """Return what was written of a layout, and the layout that is read from it."""
    made = described(layout)
    kinds = [[item for key, item in made.items() if bool(key[0] & 0x1000) is kind] for kind in (False, True)]
    text = xtce("s", *kinds, headers)
    return text, read_system(text, "again.xml")


@pytest.mark.quick("cfe-16*", "rover-12*", "rover-extended*")
@pytest.mark.parametrize("headers", cfe.DETECTABLE, ids=lambda item: item.name)
@pytest.mark.parametrize("name", ["cfe", "rover"])
def test_what_we_wrote_is_read_as_it_was(name, headers):
    rover = [SAMPLES / f"structs/rover_{item}.xml" for item in ("app", "topics")]
    layout = cfe_structs.shipped_layout() if name == "cfe" else load_together(rover)
    _, read = again(layout, headers)
    before, after = described(layout), described(read)
    assert {key: values(item) for key, item in before.items()} == {
        key: values(item) for key, item in after.items()
    }
    assert {key: item.doc for key, item in before.items() if item.doc != item.name}.keys() <= after.keys()
    assert (read.notes, read.byte_order) == ((), layout.byte_order)
    assert len(after) == (118 if name == "cfe" else 3)
    second, twice = again(read, headers)
    assert again(twice, headers)[0] == second
    stored = parse_layout(dumps(read).encode(), "stored")
    assert (stored.structs, stored.enums, stored.bindings) == (read.structs, read.enums, read.bindings)


SCALARS = ("uint8", "int16", "uint32", "int64", "float32", "float64", "Mode", "char[5]", "uint16[3]")
SCALARS += ("uint16 big", "float64 little", "Mode big", "int32[2] little")
MEMBER = st.fixed_dictionaries(
    {"type": st.sampled_from(SCALARS)},
    optional={
        "unit": st.sampled_from(["V", "m/s", "deg C"]),
        "polynomial": st.lists(st.integers(-9, 9) | st.floats(-1e9, 1e9), min_size=1, max_size=3),
        "yellow": st.tuples(st.integers(-9, 9) | st.none(), st.floats(0, 99)).map(list),
        "red": st.tuples(st.none(), st.integers(0, 99)).map(list),
    },
)


@given(members=st.lists(MEMBER, min_size=1, max_size=8), order=st.sampled_from(["little", "big"]))
def test_any_struct_that_we_wrote_is_read_as_it_was(members, order):
    plain = {"type", "unit"}  # texts and enumerations have no limits, in XTCE neither a unit
    listed = {
        f"m{place}x": {
            key: value for key, value in item.items() if key in plain or item["type"][0] not in "Mc"
        }
        for place, item in enumerate(members)
    }
    for item in listed.values():
        if item["type"][0] in "Mc":
            item.pop("unit", None)
    raw = {
        "byte_order": order,
        "bind": {"0x0890": "A"},
        "enums": {"Mode": {"type": "uint16", "values": {"IDLE": 0, "DRIVING": 7}}},
        "structs": {"A": {"members": listed}},
    }
    layout = parse_layout(json.dumps(raw).encode(), "raw")
    read = again(layout)[1]
    assert {key: values(item) for key, item in described(read).items()} == {
        key: values(item) for key, item in described(layout).items()
    }


def test_packets_read_with_what_we_wrote(tmp_path):
    """The values of C structs are the same, and a topic of a mission is there as its first fields."""
    bench = struct_bench(tmp_path, "little")
    path = tmp_path / "own.xml"
    path.write_bytes(describe_packets(bench).text)
    structs = Settings([], structs=[path]).workbench().columns.context.structs
    bound = structs.find(0x1890, 2, len(drive_payload("little")))
    message = structs.types.decode(
        bound.type, bound.encode_one(drive_payload("little"), (0, 0x1890, 0, 2, 0))
    )
    assert {name: message[name] for name in DRIVE} == DRIVE
    assert structs.name(0x0827) == "telemetry_pose"


def test_structs_of_another_byte_order_than_cfe_are_read(tmp_path):
    """The packets of cFE itself are left to the built-in structs then."""
    struct_bench(tmp_path, "big")
    bench = Settings([], structs=[tmp_path / "own.yaml"]).workbench()
    layout = read_system(describe_packets(bench).text, "s")
    own = {item: layout.structs[item] for item in ("Health", "Drive_0x1890_2", "Drive_0x1890_3")}
    assert layout.byte_order == "big"
    names = [item.name for struct in own.values() for item in struct.members if str(item.type) == "byte"]
    assert names == ["word"] * 3
    assert "0x0803" not in packets(layout)
    assert any(
        "has another byte order: left to the built-in struct of 0x0803" in line for line in layout.notes
    )


@pytest.mark.parametrize(
    ("bits", "members", "note"),
    [
        (16, ["uint16 little"], []),
        (32, ["uint32 little"], []),
        (24, ["byte[3]"], ["l: its little-endian bits are beside big-endian numbers; it is shown as bytes"]),
    ],
)
def test_numbers_of_the_rarer_byte_order_have_their_own(bits, members, note):
    little = f'<IntegerParameterType name="l16"><IntegerDataEncoding sizeInBits="{bits}" '
    little += 'byteOrder="leastSignificantByteFirst"/></IntegerParameterType>'
    data = system(container("A", "tlm", [("id/apid", 0x90)], "a", "b", "l"))
    data = data.replace(b"</ParameterTypeSet>", little.encode() + b"</ParameterTypeSet>")
    data = data.replace(b"</ParameterSet>", b'<Parameter name="l" parameterTypeRef="l16"/></ParameterSet>')
    layout = read_system(data, "s")
    assert [type_text(item) for item in layout.structs["A"].members[-1:]] == members
    assert [line.partition("S/A.")[2] for line in layout.notes] == note
    again = parse_layout(dumps(layout).encode(), "again")
    assert again.structs == layout.structs


def test_files_that_are_none(tmp_path, call):
    assert is_system(system(""))
    assert is_system(b"\xef\xbb\xbf" + system(""))
    assert not is_system(b"structs: {}  # <SpaceSystem>")
    with pytest.raises(ConfigError, match="--cflag: '-mbig-endian' says nothing of XTCE; leave it out"):
        read_systems([(system(""), "s")], ["-mbig-endian"])
    empty = b'<SpaceSystem name="A"/>'
    with pytest.raises(ConfigError, match="s: no container and no command in it"):
        read_system(empty, "s")
    (tmp_path / "a.xml").write_bytes(system(container("A", "tlm", [("id/apid", 5)], "a")))
    (tmp_path / "b.xml").write_bytes(b"<Other/>")
    done = call("structs", tmp_path / "a.xml", tmp_path / "b.xml")
    assert (done.code, "A " in done.out) == (0, True)
    assert done.err == [f"edoras: {tmp_path}/b.xml:1: Other is no space system"]


@cache
def whole_files():
    return [
        system(
            container("A", "tlm", [("id/apid", 5)], "a", "b"),
            COMMANDS.format(command("Go", [("id", "0x1890"), ("code", 2)], "x")),
        ),
        again(load_together([SAMPLES / f"structs/rover_{item}.xml" for item in ("app", "topics")]))[0],
    ]


@pytest.mark.parametrize("seed", range(examples(300, part=12)))
def test_a_damaged_file_is_read_or_refused_in_a_line(seed):
    draw = random.Random(seed)
    try:
        layout = read_system(damaged(draw.choice(whole_files()), draw), "s.xml")
    except ConfigError as error:
        layout, lines = None, str(error).splitlines()
    else:
        lines = layout.notes
    assert [line for line in lines if not re.match(r"s\.xml(:\d+)?: ", line)] == []
    if layout:
        Bindings([layout])
        assert parse_layout(dumps(layout).encode(), "again").structs == layout.structs
