"""The ROS 2 graph as a bridge uses it: raw CDR in and out, one file or add-on for each middleware."""

from edoras_tools.middleware.graph import Graph, Qos
from edoras_tools.middleware.opening import open_graph

__all__ = ["Graph", "Qos", "open_graph"]
