"""ROS 2 over DDS, compatible with rmw_cyclonedds and rmw_fastrtps."""

from __future__ import annotations

from typing import Final

from edoras_tools.middleware.graph import Middleware

DDS: Final = Middleware(
    f"{__name__}.graph:open_graph",
    "an extra ({why}): pip install 'edoras-tools[dds]'",
    usual=True,
    open=True,
    peers=f"{__name__}.graph:distro_seen",
)
