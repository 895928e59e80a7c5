"""Classes made at run time are what others announce, and padding comes and goes without a trace."""

import importlib.util
from random import Random

import pytest
from hypothesis import given
from hypothesis import strategies as st
from places import SUPPORT

from edoras_tools.addons.dds.endpoints import DdsTypes, dds_name, is_little_endian, padded, rewritten, trimmed
from edoras_tools.errors import ConfigError, RouteError, WireError
from edoras_tools.pipelines.sending.inject import arbitrary
from edoras_tools.ros import TypeStore
from edoras_tools.ros.library import PRIMITIVES

TYPES = TypeStore()
NAMES = [name for name in TYPES.types() if TYPES.has(name)]
MADE = DdsTypes(TYPES)


@pytest.fixture(scope="module")
def peer():
    """The module of the other program, for its classes."""
    spec = importlib.util.spec_from_file_location("dds_peer", SUPPORT / "dds_peer.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def there_and_back(made, cdr):
    return made.__idl__.serialize(made.__idl__.deserialize(cdr))


@pytest.mark.each(5)
@pytest.mark.parametrize("name", NAMES)
def test_every_type_of_a_distribution_goes_there_and_back(name):
    made = MADE.of(name)
    assert made.__idl__.idl_transformed_typename == dds_name(name)
    for cdr in TYPES.encode(name, {}), TYPES.encode(name, arbitrary(TYPES, name, Random(name))):
        assert there_and_back(made, cdr) == cdr


@given(st.sampled_from(NAMES), st.integers(0, 2**64))
def test_values_go_there_and_back(name, seed):
    cdr = TYPES.encode(name, arbitrary(TYPES, name, Random(seed)))
    assert there_and_back(MADE.of(name), cdr) == cdr


BASES = st.one_of(
    st.sampled_from([*PRIMITIVES, "string", "pkg/Inner", "pkg/Empty", "geometry_msgs/Pose"]),
    st.integers(1, 400).map("string<={}".format),
)
SHAPES = st.one_of(
    st.just(""),
    st.just("[]"),
    st.integers(1, 9).map("[{}]".format),
    st.integers(1, 200_000).map("[<={}]".format),
)
WORDS = st.sampled_from(
    ["a", "from_", "class", "None_", "serialize", "deserialize", "values", "self_", "x_1", "y"]
)


@given(
    st.lists(st.tuples(BASES, SHAPES, WORDS), max_size=8, unique_by=lambda item: item[2]),
    st.integers(0, 2**64),
)
def test_any_definition_goes_there_and_back(fields, seed):
    text = "".join(f"{base}{shape} {word}\n" for base, shape, word in fields)
    types = TypeStore(
        definitions={"pkg/msg/Any": text, "pkg/msg/Inner": "int8 a\nstring[] b", "pkg/msg/Empty": ""}
    )
    made = DdsTypes(types).of("pkg/msg/Any")
    made.__idl__.fill_type_data()
    for values in {}, arbitrary(types, "pkg/msg/Any", Random(seed)):
        cdr = types.encode("pkg/msg/Any", values)
        assert there_and_back(made, cdr) == cdr


def test_the_type_is_the_one_that_others_announce(peer):
    humble = DdsTypes(TypeStore("humble"))  # whose identifiers have 24 bytes, as the peer's
    for made in peer.TYPES.values():
        package, kind, _, _ = made.__idl_typename__.split(".")
        ours = humble.of(f"{package}/{kind}/{made.__name__}").__idl__
        assert ours.get_type_id() == made.__idl__.get_type_id()
        assert ours.get_type_info() == made.__idl__.get_type_info()


def test_a_type_is_made_once():
    assert MADE.of("geometry_msgs/Twist") is MADE.of("geometry_msgs/msg/Twist")


def test_names_are_those_of_ros():
    assert dds_name("geometry_msgs/msg/Twist") == "geometry_msgs::msg::dds_::Twist_"
    assert dds_name("std_srvs/srv/Empty_Request") == "std_srvs::srv::dds_::Empty_Request_"


def test_what_cyclonedds_cannot_say_is_refused():
    types = DdsTypes(TypeStore(definitions={"pkg/msg/Wide": "wstring[] text"}))
    with pytest.raises(ConfigError, match=r"pkg/msg/Wide\.text: cyclonedds for Python knows no wstring"):
        types.of("pkg/msg/Wide")
    with pytest.raises(RouteError, match="type 'pkg/msg/None' is not known"):
        types.of("pkg/msg/None")


STRING = "std_msgs/msg/String"
HELLO = b"\0\1\0\0\x06\0\0\0hello\0"


@given(st.sampled_from(NAMES), st.integers(0, 2**64))
def test_padding_comes_and_goes(name, seed):
    cdr = TYPES.encode(name, arbitrary(TYPES, name, Random(seed)))
    there = padded(cdr)
    assert len(there) % 4 == 0
    assert len(there) - len(cdr) == there[3] < 4
    assert trimmed(TYPES, name, there) == cdr
    assert trimmed(TYPES, name, cdr + bytes(len(there) - len(cdr))) == cdr


def test_a_message_of_a_multiple_of_four_is_left_alone():
    cdr = TYPES.encode("geometry_msgs/msg/Twist", {})
    assert padded(cdr) is cdr
    assert trimmed(TYPES, "geometry_msgs/msg/Twist", cdr) is cdr


def test_the_options_tell_the_padding():
    assert padded(HELLO) == b"\0\1\0\2" + HELLO[4:] + b"\0\0"


def test_what_is_no_padding_stays():
    assert trimmed(TYPES, STRING, HELLO + bytes(4)) == HELLO + bytes(4)
    assert trimmed(TYPES, STRING, HELLO + b"\1") == HELLO + b"\1"


def test_which_byte_order():
    assert is_little_endian(HELLO)
    assert not is_little_endian(HELLO[:4])
    assert not is_little_endian(b"\0\0" + HELLO[2:])


def test_what_ros_would_write():
    assert rewritten(TYPES, STRING, TYPES.encode(STRING, {"data": "hello"}, big_endian=True)) == HELLO
    with pytest.raises(WireError, match=STRING):
        rewritten(TYPES, STRING, HELLO[:-1])
