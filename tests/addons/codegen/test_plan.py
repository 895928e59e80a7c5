"""The longest message, beside the longest of all messages there are."""

from __future__ import annotations

import re
from itertools import product

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edoras_tools.addons.codegen.generation import LibraryOrder, generate
from edoras_tools.addons.codegen.plan import BoundRule, Bounds
from edoras_tools.errors import ConfigError
from edoras_tools.ros import TypeStore
from edoras_tools.ros.library import PRIMITIVES, Shape

KINDS = ("uint8", "int16", "int32", "float64", "string", "wstring")


def _values(store, field, strings, sequences):
    """Values of a field of every size."""
    texts = ["x" * length for length in range((field.string_bound or strings) + 1)]
    one = texts if field.type in {"string", "wstring"} else [0]
    if "/" in field.type:
        one = list(_messages(store, field.type, strings, sequences))
    if field.shape is Shape.SCALAR:
        return one
    counts = [field.size] if field.shape is Shape.ARRAY else range((field.size or sequences) + 1)
    return [list(items) for count in counts for items in product(one, repeat=count)]


def _messages(store, name, strings, sequences):
    fields = store.fields(name)
    for values in product(*(_values(store, field, strings, sequences) for field in fields)):
        yield {field.name: value for field, value in zip(fields, values, strict=True)}


@pytest.mark.parametrize("distro", ["humble", "jazzy"])
@given(
    fields=st.lists(
        st.tuples(st.sampled_from(KINDS), st.sampled_from(["", "[]", "[2]", "[<=1]"])), min_size=1, max_size=3
    ),
    nested=st.lists(st.sampled_from(KINDS), min_size=1, max_size=2),
    strings=st.integers(1, 2),
)
def test_longest(distro, fields, nested, strings):
    inner = "".join(f"{kind} f{index}\n" for index, kind in enumerate(nested))
    outer = "".join(f"{kind}{shape} f{index}\n" for index, (kind, shape) in enumerate(fields))
    definitions = {"a/msg/Inner": inner, "a/msg/Outer": f"{outer}Inner last\nuint16 end\n"}
    store = TypeStore(distro, definitions=definitions)
    library = generate(store, LibraryOrder(("a/Outer",), Bounds(strings, 1))).library
    longest = max(len(store.encode("a/Outer", values)) for values in _messages(store, "a/Outer", strings, 1))
    assert library.requested[0].most_bytes == longest


@pytest.mark.parametrize("kind", PRIMITIVES)
def test_arrays_are_not_walked(kind):
    """An array of a million takes no longer than one of two."""
    store = TypeStore(definitions={"a/msg/A": f"uint8 a\n{kind}[1000003] b\nfloat64 c\n"})
    made = generate(store, LibraryOrder(("a/A",))).library.requested[0]
    assert made.most_bytes == store.fixed_size("a/A")


def test_sequences_in_sequences_do_not_overflow():
    definitions = {"a/msg/A": "uint8[<=16777216] a\n", "a/msg/B": "A[<=3] a\n", "a/msg/C": "B[<=1] b\n"}
    made = generate(TypeStore(definitions=definitions), LibraryOrder(("a/C",))).library.requested[0]
    assert made.most_bytes == 4 + 4 + 4 + 3 * (4 + (1 << 24))


DEFINITIONS = {
    "a_msgs/msg/A": "string<=10 word\nint32[<=4] few\nstring[] many\nstring[2] two\nfloat64[3] three\n"
    "int8 one\nstd_msgs/Header header\n",
    "a_msgs/msg/Long": "string text 'abcdef'\n",
    "a_msgs/msg/Many": "int8[] numbers [1, 2, 3]\n",
    "a_msgs/msg/Wide": "wstring[1] texts ['abc𝄞']\n",
}


def made(*rules, types=("a_msgs/A",), strings=64, sequences=32):
    bounds = Bounds(strings, sequences, tuple(map(BoundRule.read, rules)))
    return generate(TypeStore(definitions=DEFINITIONS), LibraryOrder(types, bounds))


def header(*rules, **options):
    return made(*rules, **options).files["edoras_msgs/a_msgs.h"]


def member(text, name):
    return re.search(rf"^ +(.*\b{name}\b.*?;)(?: /\*.*)?$", text, re.MULTILINE)[1]


@pytest.mark.parametrize(
    ("rules", "name", "declared"),
    [
        ((), "word", "struct { uint32_t size; char data[11]; } word;"),
        ((), "few", "struct { uint32_t size; int32_t data[4]; } few;"),
        ((), "many", "struct { uint32_t size; struct { uint32_t size; char data[65]; } data[32]; } many;"),
        ((), "two", "struct { uint32_t size; char data[65]; } two[2];"),
        ((), "three", "double three[3];"),
        (("a_msgs/msg/A.word=3",), "word", "struct { uint32_t size; char data[4]; } word;"),
        (("a_msgs/A.few = 0x2",), "few", "struct { uint32_t size; int32_t data[2]; } few;"),
        (("a_msgs/A.two[]=5",), "two", "struct { uint32_t size; char data[6]; } two[2];"),
        (
            ("a_msgs/A.many=7", "a_msgs/A.many[]=8"),
            "many",
            "struct { uint32_t size; struct { uint32_t size; char data[9]; } data[7]; } many;",
        ),
    ],
)
def test_what_a_bound_makes(rules, name, declared):
    assert member(header(*rules), name) == declared


def test_defaults_hold_for_what_nothing_bounds():
    text = header(strings=5, sequences=6)
    assert (
        member(text, "many")
        == "struct { uint32_t size; struct { uint32_t size; char data[6]; } data[6]; } many;"
    )
    assert member(text, "word") == "struct { uint32_t size; char data[11]; } word;"


def test_a_rule_holds_wherever_its_type_is_nested():
    files = made("std_msgs/Header.frame_id=12").files
    assert "char data[13]; } frame_id;" in files["edoras_msgs/std_msgs.h"]


@pytest.mark.parametrize("text", ["", "x", "A.few=1", "a_msgs/A.few=0", "a_msgs/A.few=-1", "a_msgs/A.few=x"])
@pytest.mark.parametrize("suffix", ["", "="])
def test_no_rules(text, suffix):
    if "/" in text or text == "A.few=1":
        text += suffix
    if text == "A.few=1":
        with pytest.raises(ConfigError, match="A is in none of the types"):
            made(text)
        return
    with pytest.raises(
        ConfigError, match=r"--bound: .* is not TYPE\.FIELD=MOST with MOST from 1 to 16777216"
    ):
        BoundRule.read(text)


@pytest.mark.parametrize(
    ("rule", "why"),
    [
        ("a_msgs/A.word=11", "its definition says at most 10"),
        ("a_msgs/A.few=5", "its definition says at most 4"),
        ("a_msgs/A.one=5", "int8 takes no bound"),
        ("a_msgs/A.header=5", "std_msgs/Header takes no bound"),
        ("a_msgs/A.three=2", "float64[3] always holds 3 elements"),
        ("a_msgs/A.few[]=2", "int32[<=4] holds no strings; write a_msgs/msg/A.few=2"),
        ("a_msgs/A.word[]=2", "string<=10 holds no strings; write a_msgs/msg/A.word=2"),
        ("a_msgs/A.no=2", "a_msgs/msg/A has no field no"),
        ("b_msgs/B.no=2", "b_msgs/msg/B is in none of the types"),
    ],
)
def test_rules_that_cannot_be_followed(rule, why):
    with pytest.raises(ConfigError) as error:
        made(rule)
    assert str(error.value) == f"--bound: {rule}: {why}"


def test_all_mistakes_at_once():
    with pytest.raises(ConfigError) as error:
        made("a_msgs/A.word=11", "a_msgs/A.one=5")
    assert len(error.value.mistakes) == 2


@pytest.mark.parametrize(
    ("types", "options", "why"),
    [
        ("a_msgs/Long", {"strings": 5}, "a_msgs/msg/Long.text: its default has 6 characters, its bound is 5"),
        (
            "a_msgs/Many",
            {"sequences": 2},
            "a_msgs/msg/Many.numbers: its default has 3 elements, its bound is 2",
        ),
        (
            "a_msgs/Wide",
            {"strings": 4},
            "a_msgs/msg/Wide.texts: its default has 5 characters, its bound is 4",
        ),
        ("nav_msgs/Path", {"sequences": 1_000_000}, "bytes at these bounds, 67,108,864 are the most; lower"),
    ],
)
def test_what_does_not_fit(types, options, why):
    with pytest.raises(ConfigError) as error:
        made(types=(types,), **options)
    assert why in str(error.value)
    assert made(types=(types,))
