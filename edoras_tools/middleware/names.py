"""What a node and a topic may be called.

The rules: https://design.ros2.org/articles/topic_and_service_names.html
"""

from __future__ import annotations

import re
from typing import Final

from edoras_tools.errors import ConfigError

_NAME: Final = re.compile(r"(?:/[A-Za-z_][A-Za-z0-9_]*)+")


def check_name(name: str, what: str) -> str:
    """Return a fully qualified ROS name.

    Args:
        name: as given.
        what: what an error calls it, ``topic`` or ``node``.

    Raises:
        ConfigError: it is none.
    """
    if not _NAME.fullmatch(name) or "__" in name:
        raise ConfigError(
            f"{what} {name!r} is no ROS name; write /NAME/NAME, of letters, digits and single _, "
            "no digit first"
        )
    return name


def node_name(node: str) -> tuple[str, str]:
    """Return the namespace, ``/`` or ``/robot``, and the name of a node given as ``NAME`` or ``/robot/NAME``.

    Raises:
        ConfigError: it is no name for a node.
    """
    full = check_name(node if node.startswith("/") else "/" + node, "node")
    namespace, _, name = full.rpartition("/")
    return namespace or "/", name
