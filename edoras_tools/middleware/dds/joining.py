"""A node among those ROS 2 nodes that run on DDS (rmw_cyclonedds, rmw_fastrtps); see docs/dds.md."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from edoras_tools.errors import ConfigError
from edoras_tools.middleware.names import node_name

if TYPE_CHECKING:
    from collections.abc import Mapping

    from edoras_tools.middleware.dds.graph import DdsGraph
    from edoras_tools.ros import TypeStore


def open_graph(
    store: TypeStore, node: str, *, domain: int = 0, options: Mapping[str, str] | None = None
) -> DdsGraph:
    """Join the graph as a node.

    Args:
        store: has the types of all topics.
        node: name of the node, or ``/namespace/name``.
        domain: ``ROS_DOMAIN_ID``.
        options: see docs/dds.md: ``interface``, ``peers``, ``multicast``.

    Raises:
        ConfigError: an option cannot be honoured, or Cyclone DDS refuses the domain.
        ImportError: cyclonedds is not installed.
    """
    name = node_name(node)
    try:
        import_module("cyclonedds.internal")
    except ImportError:
        raise
    except Exception as error:
        raise ConfigError(f"dds: cyclonedds does not load: {error}") from error
    from edoras_tools.middleware.dds.domain import configuration
    from edoras_tools.middleware.dds.graph import DdsGraph

    return DdsGraph(store, name, domain, configuration(options or {}))
