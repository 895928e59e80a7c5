"""How many bytes writers of ROS 2 leave behind the last field of a type."""

import numpy as np
import pytest

from edoras_tools.ros import TypeStore
from edoras_tools.ros.cdr.plan import ROUNDING, UNLIMITED

DEFINITIONS = {
    "odd_msgs/msg/Bounded": "float64[<=3] x\nuint8 y\n",
    "odd_msgs/msg/Many": "Bounded[4] parts\n",
    "odd_msgs/msg/Any": "Bounded[] parts\n",
    "odd_msgs/msg/Truth": "bool[<=3] flags\n",
    "odd_msgs/msg/Wide": "wstring[2] names\nfloat64 x\n",
}
TYPES = TypeStore("jazzy", definitions=DEFINITIONS)
EXCESS = [
    ("geometry_msgs/msg/Twist", 0),
    ("nav_msgs/msg/Path", 0),
    ("sensor_msgs/msg/PointCloud2", 0),
    ("sensor_msgs/msg/LaserScan", 0),
    ("std_msgs/msg/Float64MultiArray", 4),
    ("sensor_msgs/msg/JointState", 12),
    ("rcl_interfaces/msg/ParameterEvent", UNLIMITED),
    ("odd_msgs/msg/Bounded", 4),
    ("odd_msgs/msg/Many", 16),
    ("odd_msgs/msg/Any", UNLIMITED),
    ("odd_msgs/msg/Truth", 61),
    ("odd_msgs/msg/Wide", 8),
]


@pytest.mark.parametrize(("name", "excess"), EXCESS)
def test_what_rmw_serialize_overestimates(name, excess):
    assert TYPES.plan(name)[1].excess == excess
    assert TYPES.most_trailing(name) == ROUNDING + excess


REAL = [
    "00010000 00000000 00000000 01000000 006f7369 00000000 00000000 00000000 00000000 61737472 7470735f",
    "000100000000000000000000010000000012728001000000020000006100000001000000000000000000f03f0000000000000000f57f0000f039fe7b",
]
"""JointStates from rclpy.serialization of Jazzy and Kilted: 8 bytes follow their last field."""


@pytest.mark.parametrize("text", REAL)
def test_what_rclpy_writes(text):
    left = 8
    name, cdr = "sensor_msgs/msg/JointState", bytes.fromhex(text)
    assert len(cdr) - TYPES.extent(name, cdr) == left <= TYPES.most_trailing(name)
    assert TYPES.encode(name, TYPES.decode(name, cdr))[4:8] == cdr[4:8]
    data = np.frombuffer(cdr * 40, np.uint8)
    offset = np.arange(40) * len(cdr)
    found = TYPES.trailing(name, data, offset, np.full(40, len(cdr), np.int32))
    assert found.tolist() == [left] * 40
    short = TYPES.trailing(name, data, offset, np.full(40, len(cdr) - left - 1, np.int32))
    assert short.tolist() == [-1] * 40


MANY = {
    "at the threshold": ("int32 f{}\n", 59, 7),
    "above it": ("int32 f{}\n", 60, 7),
    "of two kinds": ("string f{}\n", 61, "x"),
    "sequences": ("float64[] f{}\n", 61, [0.5]),
    "fixed arrays": ("int16[2] f{}\n", 61, [1, -1]),
    "messages of one field": ("std_msgs/Int8 f{}\n", 61, {"data": 3}),
}


@pytest.mark.parametrize(("line", "count", "value"), MANY.values(), ids=MANY)
def test_a_type_of_many_fields(line, count, value):
    one = "".join(line.format(index) for index in range(count))
    inner, outer = "odd_msgs/msg/Inner", "odd_msgs/msg/Outer"
    types = TypeStore(definitions={inner: f"uint8 first\n{one}", outer: "Inner a\nInner[] b\nInner c\n"})
    values = {"first": 9} | {f"f{index}": value for index in range(count)}
    every = {"a": values, "b": [values, values], "c": values | {"first": 8}}
    for big in (False, True):
        assert types.decode(outer, types.encode(outer, every, big_endian=big)) == every
