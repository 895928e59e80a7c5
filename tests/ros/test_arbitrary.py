from __future__ import annotations

from random import Random

import pytest

from edoras_tools.ros import TypeStore
from edoras_tools.ros.arbitrary import arbitrary

STORE = TypeStore()
NAMES = [
    "geometry_msgs/msg/Twist",
    "sensor_msgs/msg/JointState",
    "sensor_msgs/msg/Imu",
    "nav_msgs/msg/Odometry",
    "sensor_msgs/msg/PointCloud2",
    "std_msgs/msg/Empty",
    "rcl_interfaces/msg/Log",
]


@pytest.mark.parametrize("name", [*NAMES, *STORE.types()[::40]])
def test_values_encode_and_come_back(name):
    if not STORE.has(name):
        pytest.skip("its definition is not complete")
    values = arbitrary(STORE, name, Random(1))
    assert set(values) == {field.name for field in STORE.fields(name)}
    assert STORE.decode(name, STORE.encode(name, values)) == values


def test_a_seed_gives_the_same_message_and_another_seed_another():
    one, same, other = (arbitrary(STORE, NAMES[1], Random(seed)) for seed in (1, 1, 2))
    assert one == same != other
    assert all(one[name] for name in ("name", "position", "velocity", "effort"))
