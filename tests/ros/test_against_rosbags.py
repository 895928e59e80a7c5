"""Byte for byte and value for value against an independent implementation."""

from __future__ import annotations

import pytest
from effort import every, examples
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from edoras_tools.ros import TypeStore

PACKAGES = ("geometry_msgs", "sensor_msgs", "std_msgs", "nav_msgs", "builtin_interfaces", "rcl_interfaces")
ALL = sorted(get_typestore(Stores.ROS2_JAZZY).fielddefs)
TYPES = [name for name in ALL if name.split("/")[0] in PACKAGES]


def test_the_packages_are_there():
    assert len(TYPES) > 90
    assert {name.split("/")[0] for name in TYPES} == set(PACKAGES)


@pytest.mark.each(11)
@pytest.mark.parametrize("name", every(2, TYPES))
@settings(max_examples=examples(25, least=3), deadline=None, suppress_health_check=list(HealthCheck))
@given(data=st.data(), little=st.booleans())
def test_both_directions(store, rosbags_store, tools, name, data, little):
    values = data.draw(tools.messages(store, name))
    theirs = rosbags_store.serialize_cdr(
        tools.to_rosbags(rosbags_store, name, values), name, little_endian=little
    )
    ours = store.encode(name, values, big_endian=not little)
    assert ours == bytes(theirs)
    expected = tools.from_rosbags(rosbags_store, name, rosbags_store.deserialize_cdr(ours, name))
    assert tools.exact(store.decode(name, ours)) == tools.exact(expected)
    assert tools.exact(store.decode(name, store.encode(name, expected))) == tools.exact(expected)


@pytest.mark.each(5)
@pytest.mark.parametrize("name", every(2, TYPES))
@settings(max_examples=examples(15, least=3), deadline=None, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_what_rosbags_reads_is_valid(store, rosbags_store, tools, name, data):
    cdr = bytearray(store.encode(name, data.draw(tools.messages(store, name))))
    for _ in range(data.draw(st.integers(1, 3))):
        cdr[data.draw(st.integers(4, len(cdr) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    try:
        rosbags_store.deserialize_cdr(bytes(cdr), name)
    except Exception:  # noqa: BLE001  whatever it raises: rosbags refuses it
        return
    store.decode(name, bytes(cdr))


def test_rosbags_refuses_what_every_receiver_ignores(store, rosbags_store):
    cdr = store.encode("geometry_msgs/msg/Twist", {})
    for padding in range(4):
        rosbags_store.deserialize_cdr(cdr + bytes(padding), "geometry_msgs/msg/Twist")
    for padding in range(60):
        store.decode("geometry_msgs/msg/Twist", cdr + bytes(padding))
    with pytest.raises(Exception, match="size mismatch"):
        rosbags_store.deserialize_cdr(cdr + bytes(4), "geometry_msgs/msg/Twist")


@pytest.mark.each(5)
@pytest.mark.parametrize("name", ALL)
def test_rosbags_reads_our_definitions(store, rosbags_store, name):
    types = get_types_from_msg(store.definition(name), name)
    expected = dict(rosbags_store.fielddefs)
    assert name in types
    for found, (constants, fields) in types.items():
        assert constants == [tuple(item) for item in expected[found][0]]
        assert fields == [
            item for item in expected[found][1] if item[0] != "structure_needs_at_least_one_member"
        ]


@pytest.mark.each(5)
@pytest.mark.parametrize("name", ALL)
def test_our_definitions_read_back_the_same(store, name):
    text = store.definition(name)
    assert TypeStore(definitions={name: text}).definition(name) == text


@pytest.mark.parametrize(
    "distro", ["foxy", "galactic", "humble", "iron", "jazzy", "kilted", "latest", "rolling"]
)
def test_every_type_of_every_distribution_is_usable(distro):
    types = TypeStore(distro)
    assert [types.check(name) for name in types.types() if types.check(name)] == []
    assert types.has("sensor_msgs/msg/JointState")
