"""Which types some messages could be: always their own, and never one that ends elsewhere."""

import pytest

from edoras_tools.ros import TypeStore
from edoras_tools.ros.fitting import USUAL, types_that_fit

STORE = TypeStore()
JOINTS = {"name": ["a", "bc"], "position": [1.0, 2.0], "velocity": [], "effort": []}


@pytest.mark.parametrize("name", USUAL)
def test_a_message_fits_its_own_type_first(name):
    values = JOINTS if name.endswith("JointState") else {}
    assert types_that_fit(STORE, [STORE.encode(name, values)])[0] == name


def test_all_samples_must_fit():
    twist, pose = (STORE.encode(f"geometry_msgs/msg/{name}", {}) for name in ("Twist", "Pose"))
    assert "geometry_msgs/msg/Wrench" in types_that_fit(STORE, [twist])
    assert types_that_fit(STORE, [twist, pose]) == []
    assert types_that_fit(STORE, []) == []


def test_own_types_are_tried_too_and_come_first():
    cdr = STORE.encode("geometry_msgs/msg/Twist", {})
    assert types_that_fit(STORE, [cdr], ["geometry_msgs/msg/Wrench"])[0] == "geometry_msgs/msg/Wrench"
    log = STORE.encode("rcl_interfaces/msg/Log", {"name": "node", "msg": "text", "line": 7})
    assert "rcl_interfaces/msg/Log" in types_that_fit(STORE, [log], ["rcl_interfaces/msg/Log"])
    assert "rcl_interfaces/msg/Log" not in types_that_fit(STORE, [log])
