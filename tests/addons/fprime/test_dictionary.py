"""Dictionaries of F Prime: what is read from them, and what is said of their mistakes."""

import copy
import json
from contextlib import suppress

import pytest
from effort import examples
from fprime_session import DICTIONARY
from hypothesis import given, settings
from hypothesis import strategies as st

from edoras_tools.addons.fprime.table import EventSeverity
from edoras_tools.errors import ConfigError
from edoras_tools.structs import Structs
from edoras_tools.structs.files import load_layout, parse_layout

ROVER = json.loads(DICTIONARY.read_text())


def read(raw):
    return parse_layout(json.dumps(raw).encode(), "Rover.json")


def test_every_entry_is_a_struct_with_the_time_in_front():
    structs = Structs([load_layout(DICTIONARY)])
    members = {
        item.name: [(member.name, str(member.type), member.dims) for member in item.struct.members]
        for item in structs.all
    }
    assert members["Rover.cmdDisp.CMD_NO_OP"] == []
    assert members["Rover.drive.FOLLOW"] == [
        ("route", "Rover_Leg", (2,)),
        ("note", "char", (20,)),
        ("repeat", "uint8", ()),
    ]
    assert members["Rover.drive.Wheels"] == [("time", "FprimeTime", ()), ("value", "float32", (4,))]
    assert members["Motion"][1:] == [
        ("Rover_drive_Mode", "Rover_Mode", ()),
        ("Rover_drive_Odometer", "float64", ()),
        ("Rover_drive_Wheels", "float32", (4,)),
    ]
    (layout,) = structs.layouts
    assert [member.name for member in layout.structs["Rover_Pose"].members] == ["x", "y", "heading"]
    assert layout.enums["Rover_Mode"].names == {0: "IDLE", 1: "DRIVING", 255: "LOST"}
    assert len(structs.all) == len(layout.entries) == 19
    assert all(structs.dictionary[item.key.msg_id] is item for item in structs.all)


def changed(*path, to):
    """Return the dictionary with one value changed, or left out where it is None."""
    raw = copy.deepcopy(ROVER)
    here = raw
    for part in path[:-1]:
        here = here[part]
    if to is None:
        del here[path[-1]]
    else:
        here[path[-1]] = to
    return raw


def type_of(name):
    return next(index for index, item in enumerate(ROVER["typeDefinitions"]) if item["qualifiedName"] == name)


MODE, LEG, POSE, APID = map(type_of, ("Rover.Mode", "Rover.Leg", "Rover.Pose", "ComCfg.Apid"))
WHEELS, ID, OPCODE = map(type_of, ("Rover.Wheels", "FwIdType", "FwOpcodeType"))
TAKEN = "is that of Rover.cmdDisp.CommandsDispatched, too"
ONLY = "only 1, the default, can be read"
MISTAKES = {
    "a section that is no list": (changed("events", to=7), "events: 7 is not a list"),
    "an item that is no object": (changed("commands", 0, to="x"), "commands[0]: 'x' is not an object"),
    "no name": (changed("commands", 0, "name", to=None), "commands[0]: name is missing"),
    "a name that is none": (
        changed("events", 0, "name", to="a/../b"),
        "events[0]: name 'a/../b' is not a name",
    ),
    "no opcode": (
        changed("commands", 0, "opcode", to=None),
        "commands[0]: opcode is missing; expected a number of 0 to 4294967295",
    ),
    "an ID that is too large": (
        changed("events", 1, "id", to=1 << 32),
        "events[1]: id 4294967296; expected a number of 0 to 4294967295",
    ),
    "an ID that is text": (
        changed("events", 1, "id", to="1"),
        "events[1]: id '1'; expected a number of 0 to 4294967295",
    ),
    "an ID of a packet that is too large": (
        changed("telemetryPacketSets", 0, "members", 0, "id", to=1 << 16),
        "telemetryPacketSets[0].members[0]: id 65536; expected a number of 0 to 65535",
    ),
    "an ID that is taken": (
        changed("telemetryChannels", 1, "id", to=0x1000000),
        f"telemetryChannels[1]: id 0x1000000 of Rover.drive.Wheels {TAKEN}",
    ),
    "a severity that there is not": (
        changed("events", 0, "severity", to="LOUD"),
        f"events[0]: severity 'LOUD' is not one of {', '.join(EventSeverity.__members__)}",
    ),
    "a format that is no text": (changed("events", 0, "format", to=5), "events[0]: format 5 is not text"),
    "no type": (
        changed("telemetryChannels", 0, "type", to=None),
        "telemetryChannels[0].type: None is not a type as {'name': 'U32', ...}",
    ),
    "a type that there is not": (
        changed("telemetryChannels", 0, "type", "name", to="Rover.Ghost"),
        "telemetryChannels[0].type: there is no type 'Rover.Ghost' in typeDefinitions",
    ),
    "a text without a size": (
        changed("telemetryChannels", 6, "type", "size", to=None),
        "telemetryChannels[6].type: size is missing; expected a number of 1 to 65536",
    ),
    "a type of no kind": (
        changed("typeDefinitions", MODE, "kind", to="union"),
        f"typeDefinitions[{MODE}]: kind 'union' is not alias, array, enum or struct",
    ),
    "an enumeration of reals": (
        changed("typeDefinitions", MODE, "representationType", "name", to="F32"),
        f"typeDefinitions[{MODE}]: Rover.Mode is not represented by an integer",
    ),
    "a value that does not fit": (
        changed("typeDefinitions", MODE, "enumeratedConstants", 0, "value", to=256),
        f"typeDefinitions[{MODE}].enumeratedConstants[0]: value 256 does not fit uint8",
    ),
    "a type that contains itself": (
        changed("typeDefinitions", LEG, "members", "to", "type", "name", to="Rover.Route"),
        f"typeDefinitions[{type_of('Rover.Route')}]: Rover.Route contains itself",
    ),
    "an array that is too large": (
        changed("typeDefinitions", WHEELS, "size", to=20000),
        f"typeDefinitions[{WHEELS}]: 80000 bytes are more than any packet holds",
    ),
    "no members": (
        changed("typeDefinitions", POSE, "members", to=[]),
        f"typeDefinitions[{POSE}]: members of Rover.Pose: expected {{NAME: {{type: ..., index: ...}}}}",
    ),
    "an index twice": (
        changed("typeDefinitions", POSE, "members", "y", "index", to=0),
        f"typeDefinitions[{POSE}].members.x: index 0 is there twice",
    ),
    "a channel that there is not": (
        changed("telemetryPacketSets", 0, "members", 0, "members", 0, to="Rover.ghost"),
        "telemetryPacketSets[0].members[0]: there is no channel 'Rover.ghost'",
    ),
    "another width": (
        changed("typeDefinitions", ID, "underlyingType", "name", to="U16"),
        f"typeDefinitions[{OPCODE}]: FwOpcodeType is U16; only U32, the default, can be read",
    ),
    "a width that is no name": (
        changed("typeDefinitions", ID, "underlyingType", "name", to=["U32"]),
        f"typeDefinitions[{OPCODE}]: FwOpcodeType is ['U32']; only U32, the default, can be read",
    ),
    "another packet type": (
        changed("typeDefinitions", APID, "enumeratedConstants", 1, "value", to=9),
        f"typeDefinitions[{APID}].enumeratedConstants[1]: FW_PACKET_TELEM is 9; {ONLY}",
    ),
}


@pytest.mark.parametrize("what", MISTAKES)
def test_a_mistake_is_a_line_that_says_where(what):
    raw, line = MISTAKES[what]
    with pytest.raises(ConfigError) as caught:
        read(raw)
    assert f"Rover.json: {line}" in str(caught.value).splitlines()


def test_a_second_dictionary_is_one_too_many():
    with pytest.raises(ConfigError, match="a second dictionary, beside"):
        assert Structs([load_layout(DICTIONARY), load_layout(DICTIONARY)]).dictionary


def places(raw, here=()):
    """Yield the path of every value."""
    yield here
    items = raw.items() if isinstance(raw, dict) else enumerate(raw) if isinstance(raw, list) else ()
    for key, value in items:
        yield from places(value, (*here, key))


VALUES = st.none() | st.booleans() | st.integers(-9, 1 << 40) | st.text(max_size=5) | st.floats()
ANYTHING = st.recursive(
    VALUES,
    lambda inner: st.lists(inner, max_size=2) | st.dictionaries(st.text(max_size=5), inner, max_size=2),
    max_leaves=4,
)


@settings(max_examples=examples(150))
@given(path=st.sampled_from([path for path in places(ROVER) if path]), value=ANYTHING)
def test_any_value_anywhere_is_read_or_refused(path, value):
    with suppress(ConfigError):
        assert Structs([read(changed(*path, to=value))]).all
