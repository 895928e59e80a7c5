"""Layout files: what can be written, and what is said of mistakes."""

import json
from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edoras_tools.errors import ConfigError
from edoras_tools.structs.files import dumps, load_layout, parse_key, parse_layout
from edoras_tools.structs.shapes import BASIC, Key, Member

ROVER = """
byte_order: big
package: rover_msgs
bind: {0x0890: Hk, 0x1890/2: Drive, '2193': Hk}
enums:
  Mode: {type: uint8, values: {IDLE: 0, DRIVE: 1}}
structs:
  Drive:
    packed: true
    members: {speed: float32, name: 'char[3]', more: uint16}
  Point: {members: {x: uint8, y: float64}}
  Hk:
    header: 16
    members:
      telemetry_header: byte[16]
      mode: Mode
      low: uint32:3
      high: {type: uint32:13 hex, doc: what it is}
      way: Point[2]
      rest: uint16[]
"""


def test_offsets_are_those_of_a_compiler():
    made = parse_layout(ROVER.encode(), "rover.yaml")
    assert made.bindings == {Key(0x890): "Hk", Key(0x1890, 2): "Drive", Key(0x891): "Hk"}
    assert [item.offset for item in made.structs["Drive"].members] == [0, 4, 7]
    hk = made.structs["Hk"]
    assert [(item.name, item.offset, item.bit) for item in hk.members] == [
        ("telemetry_header", 0, 0),
        ("mode", 16, 0),
        ("low", 17, 0),
        ("high", 17, 3),
        ("way", 24, 0),
        ("rest", 56, 0),
    ]
    assert (hk.size, hk.header, made.byte_order, made.structs["Point"].size) == (56, 16, "big", 16)
    assert hk.members[3] == Member("high", BASIC["uint32"], 17, (), bits=13, bit=3, base=16, doc="what it is")


def test_json_does_as_well(tmp_path):
    file = tmp_path / "structs.yaml"
    file.write_text(json.dumps({"structs": {"A": {"members": {"a": "uint8", "b": "uint32 @2"}}}}))
    assert load_layout(tmp_path).structs == load_layout(file).structs
    assert load_layout(file).structs["A"].size == 8


def test_what_is_written_reads_the_same():
    made = parse_layout(ROVER.encode(), "rover.yaml")
    again = parse_layout(dumps(made).encode(), "rover.yaml")
    assert (again.structs, again.enums, again.bindings) == (made.structs, made.enums, made.bindings)
    assert (again.package, again.byte_order) == (made.package, made.byte_order)


def test_units_calibrations_and_limits():
    text = """
    structs: {A: {members: {x: {type: uint8, unit: degC, polynomial: [-40, 0.5, 1e-05], yellow: [0, 50.5],
      red: [null, 60]}, y: {type: 'uint8[3]', red: [1, null]}}}}
    """
    made = parse_layout(text.encode(), "x")
    x, y = made.structs["A"].members
    assert (x.unit, x.polynomial, x.yellow, x.red) == ("degC", (-40, 0.5, 1e-05), (0, 50.5), (None, 60))
    assert (x.limits, y.limits) == ("yellow 0 to 50.5, red any to 60", "red 1 to any")
    assert (x.calibrated(100), y.calibrated(7)) == (pytest.approx(10.1), 7)
    assert [x.beyond(value) for value in (-1, 50, 55, 61)] == [
        *((True, False), (False, False), (True, False), (True, True)),
    ]
    assert parse_layout(dumps(made).encode(), "x").structs == made.structs


def test_names_that_yaml_would_take_for_something_else():
    text = """
    bind: {0x890: 'null'}
    enums: {'true': {values: {'no': 0}}}
    structs: {'null': {members: {'y': uint8, 'NO': uint8, 'null': uint8, 'true': 'true'}}}
    """
    made = parse_layout(text.encode(), "x")
    assert parse_layout(dumps(made).encode(), "x").structs == made.structs


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "f: no layout file: it has no 'structs'"),
        ("structs: [", "f:1: is not YAML: "),
        ('{"structs": ', "f:1: is not JSON: "),
        ("\xff", "f: no layout file: it is not text"),
        ("edoras_structs: 2\nstructs: {}", "f: edoras_structs 2 is not known; this version reads 1"),
        ("structs: {}\nbyte_order: middle", "f: byte_order: 'middle' is neither little nor big"),
        ("structs: {}\npackage: X-1", "f: package: 'X-1' is not a name of a ROS package"),
        ("structs: {}\nsizes: 1", "f: 'sizes' means nothing here; there are bind,"),
        ("structs: {A: 1}", "f: structs.A: expected members: {NAME: TYPE}"),
        ("structs: {A: {members: {x: int}}}", "f: structs.A.x: there is no type 'int'"),
        ("structs: {A: {members: {x: 1}}}", "f: structs.A.x: 1 is not TYPE, TYPE[N]"),
        ("structs: {A: {members: {1: uint8}}}", "f: structs.A: 1 is not a name in C"),
        ("structs: {A: {members: {x: 'uint8[a]'}}}", "f: structs.A.x: 'uint8[a]': a dimension and"),
        ("structs: {A: {members: {x: 'uint8[2][0]'}}}", "f: structs.A.x: 'uint8[2][0]': only the first"),
        ("structs: {A: {members: {x: 'uint8[]', y: uint8}}}", "f: structs.A.x: only the last member"),
        ("structs: {A: {members: {x: 'uint8:9'}}}", "f: structs.A.x: 'uint8:9': a bit-field is of an"),
        ("structs: {A: {members: {x: 'uint8 @1.3'}}}", "f: structs.A.x: 'uint8 @1.3': the bit behind"),
        ("structs: {A: {members: {x: A}}}", "f: structs.A.x: A contains itself"),
        ("structs: {A: {size: 2, members: {x: uint32}}}", "f: structs.A: its members take 4 bytes, more"),
        ("structs: {A: {header: 9, members: {x: uint32}}}", "f: structs.A.header: 9 is not a number of 0 to"),
        ("structs: {uint8: {members: {}}}", "f: structs.uint8: another type has this name"),
        ("structs: {}\nenums: {E: {type: float32}}", "f: enums.E: 'float32' is not an integer"),
        ("structs: {}\nenums: {E: {values: {A: b}}}", "f: enums.E: A: 'b' is not a number"),
        ("structs: {}\nbind: {0x1: B}", "f: bind.0x0001: there is no struct 'B'"),
        ("structs: {B: {members: {}}}\nbind: {0x12345: B}", "f: bind: 74565 is not a MsgId as 0x0801"),
        ("structs: {}\nbyte_order: [big]", "f: byte_order: ['big'] is neither little nor big"),
        ("structs: {}\npackage: a__b", "f: package: 'a__b' is not a name of a ROS package"),
        ("structs: {}\npackage: " + 900 * "X", "f: package: 'XXXXXXXXXX"),
        ("structs: {}\nedoras_structs: '1'", "f: edoras_structs '1' is not known"),
        ("structs: {A: {union: 'no', members: {}}}", "f: structs.A: union: 'no' is neither true nor false"),
        ("structs: {A: {packed: [], members: {}}}", "f: structs.A: packed: [] is neither true nor false"),
        ("structs: {A: {doc: {a: b}, members: {}}}", "f: structs.A: doc: {'a': 'b'} is not text"),
        ("structs: {A: {members: {x: {type: uint8, doc: 1}}}}", "f: structs.A.x: doc: 1 is not text"),
        ("structs: {A: {members: {x: {type: uint8, unit: [V]}}}}", "f: structs.A.x: unit: ['V'] is not text"),
        (
            "structs: {A: {members: {x: {type: uint8, polynomial: [1, null]}}}}",
            "f: structs.A.x: polynomial: [1, None] is not a list of numbers",
        ),
        (
            "structs: {A: {members: {x: {type: uint8, yellow: [.nan, 1]}}}}",
            "f: structs.A.x: yellow: [nan, 1] is not [LOW, HIGH], null for no end",
        ),
        ("structs: {A: {members: {x: {type: uint8, red: [1]}}}}", "f: structs.A.x: red: [1] is not [LOW,"),
        (
            "structs: {A: {members: {x: {type: uint8, red: [1, " + "9" * 400 + "]}}}}",
            "f: structs.A.x: red: [1, 99",
        ),
        ("structs: {A: {members: {\xe9: uint8}}}", "f: no layout file: it is not text"),
        ("structs: {'A\\u00e9': {members: {}}}", "f: structs: 'A\\\\u00e9' is not a name in C"),
        (
            "structs: {A: {size: big, members: {x: uint8}}}",
            "f: structs.A.size: 'big' is not a number of 0 to",
        ),
        ("structs: {A: {header: 4, members: {x: uint64}}}", "f: structs.A.x: the header of 4 bytes ends"),
        ("structs: {}\nenums: {E: {type: uint8, values: {A: 256}}}", "f: enums.E: A: 256 does not fit uint8"),
        ("structs: {}\nenums: {E: {type: [int8]}}", "f: enums.E: ['int8'] is not an integer"),
        ("structs: {}\nenums: {int8: {type: int8}}", "f: enums.int8: another type has this name"),
        ("structs: {B: {members: {}}}\nbind: {1: B, '0x1': B}", "f: bind.0x0001: it is bound twice"),
        ("structs: {B: {members: {}}}\nbind: {0x890/1: B}", "f: bind: '0x890/1': telemetry has no function"),
        ('{"structs": {}, "structs": {}}', "f: is not YAML: 'structs' is there twice"),
    ],
)
def test_mistakes_are_named(text, said):
    with pytest.raises(ConfigError) as error:
        parse_layout(text.encode("latin-1"), "f")
    assert str(error.value).startswith(said)
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 200


def test_all_mistakes_at_once():
    with pytest.raises(ConfigError) as error:
        parse_layout(b"structs: {A: {members: {x: int, y: long}}}\nbind: {0x1: B}", "f")
    assert str(error.value).count("\n") == 2


def test_files_that_are_none(tmp_path):
    (tmp_path / "a.o").write_bytes(b"\x7fELF....")
    for path, said in (
        (tmp_path / "b", "cannot be read (No such file"),
        (tmp_path / "a.o", "a program, not"),
    ):
        with pytest.raises(ConfigError, match=said.replace("(", r"\(")):
            load_layout(path)


def test_what_is_said_of_a_member_stays_on_one_line():
    made = parse_layout(
        b'structs: {A: {doc: "b\\nuint8 c", members: {x: {type: uint8, doc: "a\\n\\nb"}}}}', "f"
    )
    assert (made.structs["A"].doc, made.structs["A"].members[0].doc) == ("b uint8 c", "a b")


@pytest.mark.parametrize("text", ["", "x", "0x1880/", "0x1880/200", "-1", "0", "0x2000", "0xffff", "1/2/3"])
def test_keys_that_are_none(text):
    with pytest.raises(ConfigError, match="is not a MsgId"):
        parse_key(text)


def test_keys():
    assert [str(parse_key(text)) for text in ("0x801", "2049", "0x1880/6")] == [
        "0x0801",
        "0x0801",
        "0x1880/6",
    ]


KEYS = st.sampled_from(["A", "x", "members", "size", "type", "values", "header", "doc"])


@given(
    st.recursive(
        st.none()
        | st.booleans()
        | st.integers()
        | st.text(max_size=9)
        | st.sampled_from(["uint8", "A", "x[2]"]),
        lambda inner: (
            st.lists(inner, max_size=3)
            | st.dictionaries(
                st.sampled_from(["A", "x", "members", "size", "type", "values"]), inner, max_size=3
            )
        ),
        max_leaves=9,
    )
)
def test_anything_in_a_file_is_a_layout_or_a_mistake(value):
    for text in (json.dumps({"structs": value}), json.dumps({"structs": {}, "enums": value, "bind": value})):
        with suppress(ConfigError):
            parse_layout(text.encode(), "f")


@given(st.binary(max_size=60))
def test_any_bytes(data):
    with suppress(ConfigError):
        parse_layout(data, "f")
