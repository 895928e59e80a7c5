"""The ROS 2 graph as a bridge uses it: raw CDR in and out, one file or folder for each middleware."""

from edoras_tools.middleware.graph import Graph, Qos
from edoras_tools.middleware.opening import MIDDLEWARES, open_graph

__all__ = ["MIDDLEWARES", "Graph", "Qos", "open_graph"]
