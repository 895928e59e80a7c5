"""ROS 2 over Zenoh, compatible with rmw_zenoh."""

from __future__ import annotations

from typing import Final

from edoras_tools.middleware.graph import Middleware

ZENOH: Final = Middleware(
    f"{__name__}.graph:open_graph",
    "an extra ({why}): pip install 'edoras-tools[zenoh]'",
    implementation="rmw_zenoh_cpp",
)
