"""The ROS 2 graph as a bridge uses it: raw CDR in and out, one file or add-on for each middleware."""

from typing import TYPE_CHECKING, Final

from edoras_tools.doors import later

if TYPE_CHECKING:
    from edoras_tools.middleware.graph import Graph, Qos, open_graph

__all__ = ["MOST_DOMAIN", "Graph", "Qos", "open_graph"]

MOST_DOMAIN: Final = 232
"""The highest ROS_DOMAIN_ID: DDS has no ports for more (RTPS 9.6.1.1)."""

__getattr__ = later(__name__, graph="Graph Qos open_graph")
