"""What ROS calls the topics and types of DDS."""

from __future__ import annotations

from typing import Final

_TOPIC: Final = "rt/"
"""What ROS puts before the name of a topic; those of requests and replies keep theirs."""


def ros_topic(topic: str) -> str:
    """Return the ROS name of a topic of DDS; the name itself where it is of no ROS topic.

    https://design.ros2.org/articles/topic_and_service_names.html
    """
    return topic.removeprefix(_TOPIC[:-1]) if topic.startswith(_TOPIC) else topic


def ros_name(dds_type: str) -> str:
    """Return the ROS name of a DDS type; the name itself where it is of no ROS type."""
    parts = dds_type.split("::")
    is_ros = len(parts) == 4 and parts[2] == "dds_" and parts[3].endswith("_")
    return f"{parts[0]}/{parts[1]}/{parts[3].removesuffix('_')}" if is_ros else dds_type
