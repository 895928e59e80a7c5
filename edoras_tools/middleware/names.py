"""Names of nodes and topics in ROS, names of types in DDS, and names of a middleware's options.

The rules: https://design.ros2.org/articles/topic_and_service_names.html
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final

from edoras_tools.errors import ConfigError
from edoras_tools.ros.types.schema import full_name

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

_NAME: Final = re.compile(r"(?:/[A-Za-z_][A-Za-z0-9_]*)+")


def check_name(name: str, noun: str) -> str:
    """Return a fully qualified ROS name.

    Args:
        noun: noun for errors, ``topic`` or ``node``.

    Raises:
        ConfigError: it is not a valid name.
    """
    if not _NAME.fullmatch(name):
        raise ConfigError(
            f"{noun} {name!r} is not a ROS name; write /NAME/NAME, of letters, digits and _, no digit first"
        )
    return name


def node_name(node: str) -> tuple[str, str]:
    """Return the namespace, ``/`` or ``/robot``, and the name of a node from ``NAME`` or ``/robot/NAME``.

    Raises:
        ConfigError: it is not a valid name of a node.
    """
    full = check_name(node if node.startswith("/") else "/" + node, "node")
    namespace, _, name = full.rpartition("/")
    return namespace or "/", name


def dds_name(type_name: str) -> str:
    """Return the DDS name of a ROS type: ``geometry_msgs::msg::dds_::Twist_``."""
    package, kind, name = full_name(type_name).split("/")
    return f"{package}::{kind}::dds_::{name}_"


def ros_name(dds_type: str) -> str:
    """Return the ROS name of a DDS type; the DDS name itself if it is not a ROS type."""
    parts = dds_type.split("::")
    is_ros = len(parts) == 4 and parts[2] == "dds_" and parts[3].endswith("_")
    return f"{parts[0]}/{parts[1]}/{parts[3].removesuffix('_')}" if is_ros else dds_type


def unknown_options(ros: str, options: Iterable[str], existing: Sequence[str]) -> list[str]:
    """Return a line for each option that a middleware does not have.

    Args:
        options: names of the given options.
        existing: names of the options that exist.
    """
    hint = f"there are {', '.join(existing)}" if existing else "leave it out"
    return [f"--ros {ros} has no option {name!r}; {hint}" for name in options if name not in existing]
