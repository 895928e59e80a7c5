from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edoras_tools.errors import ConfigError
from edoras_tools.ros.library import (
    Constant,
    Definition,
    MessageField,
    Shape,
    complete_text,
    parse_definition,
    sections,
)

OWNER = "my_msgs/msg/Thing"

FIELDS = [
    ("int32 x", MessageField("x", "int32")),
    ("  float64\ty  # metres", MessageField("y", "float64")),
    ("int32 x -5", MessageField("x", "int32", default=-5)),
    ("uint8 x 0x1F", MessageField("x", "uint8", default=31)),
    ("uint8 x 0b101", MessageField("x", "uint8", default=5)),
    ("uint8 x 010", MessageField("x", "uint8", default=10)),
    ("bool b True", MessageField("b", "bool", default=True)),
    ("bool b 0", MessageField("b", "bool", default=False)),
    ("float32 f 1e3", MessageField("f", "float32", default=1000.0)),
    ("float64 f -.5", MessageField("f", "float64", default=-0.5)),
    ("string s", MessageField("s", "string")),
    ("string s 'a # b'  # no", MessageField("s", "string", default="a # b")),
    ('string s "it\'s"', MessageField("s", "string", default="it's")),
    ('string s "say \\"hi\\""', MessageField("s", "string", default='say "hi"')),
    ("string s bare words", MessageField("s", "string", default="bare words")),
    ('string s "a=b"', MessageField("s", "string", default="a=b")),
    ("string<=5 s", MessageField("s", "string", 5)),
    ("wstring<=5 s", MessageField("s", "wstring", 5)),
    ("string<=5[<=2] s", MessageField("s", "string", 5, Shape.SEQUENCE, 2)),
    ("float64[36] c", MessageField("c", "float64", 0, Shape.ARRAY, 36)),
    ("float64[] c", MessageField("c", "float64", 0, Shape.SEQUENCE)),
    ("int8[3] v [1, -2, 3]", MessageField("v", "int8", 0, Shape.ARRAY, 3, [1, -2, 3])),
    ("string[] v ['a, b', c]", MessageField("v", "string", 0, Shape.SEQUENCE, 0, ["a, b", "c"])),
    ("int8[] v []", MessageField("v", "int8", 0, Shape.SEQUENCE, 0, [])),
    ("Other o", MessageField("o", "my_msgs/msg/Other")),
    ("std_msgs/Header h", MessageField("h", "std_msgs/msg/Header")),
    ("std_msgs/msg/Header h", MessageField("h", "std_msgs/msg/Header")),
    ("Other[<=4] o", MessageField("o", "my_msgs/msg/Other", 0, Shape.SEQUENCE, 4)),
]
CONSTANTS = [
    ("uint8 LOW=1", Constant("LOW", "uint8", 1)),
    ("uint8 LOW = 1 # one", Constant("LOW", "uint8", 1)),
    ("float32 HALF=0.5", Constant("HALF", "float32", 0.5)),
    ("string NAME=some text", Constant("NAME", "string", "some text")),
    ('string NAME="x # y"', Constant("NAME", "string", "x # y")),
    ("bool YES=true", Constant("YES", "bool", True)),
]
MISTAKES = [
    ("int32", "'int32' is not a field; write TYPE NAME"),
    ("int32 9x", "'9x' is not a field name"),
    ("int32 a-b", "'a-b' is not a field name"),
    ("int32 x\nint32 x", "file.msg:2: x: the name is taken"),
    ("\n# c\nuint8 x 256", "file.msg:3: x: '256' is not a valid uint8"),
    ("uint8 x 1.5", "x: '1.5' is not a valid uint8"),
    ("bool x maybe", "x: 'maybe' is not a valid bool"),
    ("float32 x 1e39", "x: '1e39' is not a valid float32"),
    ("int32<=5 x", "only a string takes a bound"),
    ("string<=0 x", "only a string takes a bound, of at least 1"),
    ("int32[0] x", "an array holds 1 to 4294967295 elements"),
    ("int32[<=] x", "an array holds 1 to"),
    ("int32[5000000000] x", "an array holds 1 to"),
    ("int8[2] v [1]", "the default holds 1 values, 2 are declared"),
    ("int8[2] v 1, 2", "the default of an array is"),
    ("Other o 5", "a field of a message type takes no default"),
    ("a/b/c/d o", "'a/b/c/d' is not a type name"),
    ("Other X=5", "a constant is of a primitive type"),
    ("uint8[] X=5", "a constant is of a primitive type"),
    ("../../etc/passwd x", "is not a field"),
]


@pytest.mark.parametrize(("line", "field"), FIELDS)
def test_fields(line, field):
    assert parse_definition(OWNER, line, "f").fields == (field,)


@pytest.mark.parametrize(("line", "constant"), CONSTANTS)
def test_constants(line, constant):
    assert parse_definition(OWNER, line, "f").constants == (constant,)


def test_text_reads_back():
    fields = {item.name: item for _, item in FIELDS}.values()
    constants = {item.name: item for _, item in CONSTANTS}.values()
    definition = Definition(OWNER, tuple(fields), tuple(constants))
    again = parse_definition(OWNER, definition.text, "f")
    assert again.constants == definition.constants
    assert again.fields == tuple(
        item if item.default != [] else MessageField("v", "int8", 0, Shape.SEQUENCE) for item in fields
    )


@given(text=st.text(st.characters(exclude_categories=["Cc", "Cs", "Zl", "Zp"]), min_size=1))
def test_any_string_survives(text):
    definition = Definition(
        OWNER, (MessageField("s", "string", default=text),), (Constant("S", "string", text),)
    )
    assert parse_definition(OWNER, definition.text, "f") == definition


@pytest.mark.parametrize(("text", "message"), MISTAKES)
def test_mistakes(text, message):
    with pytest.raises(ConfigError) as caught:
        parse_definition(OWNER, text, "file.msg")
    assert message in str(caught.value)
    assert str(caught.value).startswith("file.msg:")


def test_all_mistakes_at_once():
    with pytest.raises(ConfigError) as caught:
        parse_definition(OWNER, "int32\nuint8 fine\nuint8 x -1\n", "file.msg", 11)
    assert [mistake.split(" ")[0] for mistake in caught.value.mistakes] == ["file.msg:11:", "file.msg:13:"]


def test_a_joined_text_comes_apart_again():
    parts = [Definition("a_msgs/msg/A", (MessageField("b", "b_msgs/msg/B"),)), Definition("b_msgs/msg/B", ())]
    found = list(sections("a_msgs/msg/A", complete_text(parts)))
    assert [(item.name, item.line) for item in found] == [("a_msgs/msg/A", 1), ("b_msgs/msg/B", 4)]
    assert [parse_definition(item.name, item.text, "f") for item in found] == parts


def test_a_joined_text_of_windows():
    found = list(sections("a/A", "int32 x\r\n" + "=" * 80 + "\r\nMSG: b/B\r\nint32 y\r\n"))
    assert [parse_definition(item.name, item.text, "f").fields[0].name for item in found] == ["x", "y"]


TOKENS = st.sampled_from(
    [
        "int32",
        "string",
        "<=",
        "5",
        "[",
        "]",
        " ",
        "\t",
        "\n",
        "#",
        "'",
        '"',
        "=",
        "x",
        "Y",
        "/",
        "a_msgs",
        ",",
        "\\",
        "-",
    ]
)


@given(text=st.text() | st.lists(TOKENS, max_size=30).map("".join))
def test_garbage(text):
    for item in sections(OWNER, text):
        mistakes = []
        try:
            parse_definition(item.name, item.text, "f")
        except ConfigError as error:
            mistakes = error.mistakes
        assert all(mistake.startswith("f:") for mistake in mistakes)
