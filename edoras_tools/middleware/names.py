"""What a node and a topic may be called, and what DDS calls a type; the options of a middleware.

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
        noun: what an error calls it, ``topic`` or ``node``.

    Raises:
        ConfigError: it is none.
    """
    if not _NAME.fullmatch(name):
        raise ConfigError(
            f"{noun} {name!r} is not a ROS name; write /NAME/NAME, of letters, digits and _, no digit first"
        )
    return name


def node_name(node: str) -> tuple[str, str]:
    """Return the namespace, ``/`` or ``/robot``, and the name of a node given as ``NAME`` or ``/robot/NAME``.

    Raises:
        ConfigError: it is not a name for a node.
    """
    full = check_name(node if node.startswith("/") else "/" + node, "node")
    namespace, _, name = full.rpartition("/")
    return namespace or "/", name


def dds_name(type_name: str) -> str:
    """Return the DDS name of a ROS type: ``geometry_msgs::msg::dds_::Twist_``."""
    package, kind, name = full_name(type_name).split("/")
    return f"{package}::{kind}::dds_::{name}_"


def ros_name(dds_type: str) -> str:
    """Return the ROS name of a DDS type; the name itself where it is of no ROS type."""
    parts = dds_type.split("::")
    is_ros = len(parts) == 4 and parts[2] == "dds_" and parts[3].endswith("_")
    return f"{parts[0]}/{parts[1]}/{parts[3].removesuffix('_')}" if is_ros else dds_type


def unknown_options(ros: str, options: Iterable[str], existing: Sequence[str]) -> list[str]:
    """Return a line for each option that a middleware does not have.

    Args:
        options: names of those given.
        existing: names of those that there are.
    """
    hint = f"there are {', '.join(existing)}" if existing else "leave it out"
    return [f"--ros {ros} has no option {name!r}; {hint}" for name in options if name not in existing]
