from random import Random

import numpy as np
import pytest

from edoras_tools.decode.summary import message_texts, short_values
from edoras_tools.pipelines.sending.inject import arbitrary
from edoras_tools.ros import TypeStore

TYPES = TypeStore()


def both(name, messages):
    """The texts of messages from columns, and from their values one by one."""
    data = [TYPES.encode(name, values) for values in messages]
    length = np.array([len(item) for item in data], np.int32)
    columns = TYPES.columns(
        name, np.frombuffer(b"".join(data), np.uint8), np.cumsum(length) - length.astype(np.int64), length
    )
    return message_texts(columns, TYPES.plan(name)[1]), [
        short_values(TYPES.decode(name, item)) for item in data
    ]


def test_every_type_gives_the_same_text_both_ways():
    """Of those that hold lists of messages with lists, columns give none: these are dissected."""
    nested = []
    for name in TYPES.types():
        dice = Random(name)
        made, expected = both(name, [{}, *(arbitrary(TYPES, name, dice) for _ in range(3)), {}])
        if made:
            assert made == expected, name
        else:
            nested.append(name)
    assert "trajectory_msgs/msg/JointTrajectory" in nested
    assert len(nested) < len(TYPES.types()) / 5


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({}, "all zero"),
        ({"linear": {"x": 0.5}}, "linear.x=0.5"),
        ({"linear": {"x": -0.0, "y": float("nan")}, "angular": {"z": 1e-9}}, "linear.y=nan angular.z=1e-09"),
    ],
)
def test_zeros_are_left_out(values, text):
    assert both("geometry_msgs/msg/Twist", [values]) == ([text], [text])


def test_long_lists_and_many_fields_are_cut():
    many = {"name": ["a", "b", "c", "d"], "position": [1.5], "velocity": [], "header": {"frame_id": "base"}}
    text = "name=[a, b, c, ... 4] position=[1.5] header.frame_id=base"
    assert both("sensor_msgs/msg/JointState", [many]) == ([text], [text])
    poses = {"poses": [{"position": {"x": float(number)}} for number in range(5)]}
    made, expected = both("geometry_msgs/msg/PoseArray", [poses, {}])
    assert made == expected
    assert made[0].startswith("poses=[{orientation.w=1}, {position.x=1 orientation.w=1},")
