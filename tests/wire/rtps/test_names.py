"""Names of ROS on DDS, both ways."""

import pytest

from edoras_tools.middleware.names import dds_name
from edoras_tools.ros import TypeStore
from edoras_tools.wire.rtps.names import ros_name, ros_topic


@pytest.mark.parametrize(
    ("dds", "ros"),
    [
        ("rt/cmd_vel", "/cmd_vel"),
        ("rt/rover_1/pose", "/rover_1/pose"),
        ("rq/add_two_intsRequest", "rq/add_two_intsRequest"),
        ("ros_discovery_info", "ros_discovery_info"),
        ("rtx/a", "rtx/a"),
        ("", ""),
    ],
)
def test_topics(dds, ros):
    assert ros_topic(dds) == ros


def test_types():
    for name in TypeStore().types():
        assert ros_name(dds_name(name)) == name
    assert ros_name("HelloWorld") == "HelloWorld"
    assert ros_name("a::b::dds_::C") == "a::b::dds_::C"
