"""A node among those ROS 2 nodes that run on DDS (rmw_cyclonedds, rmw_fastrtps); see docs/dds.md."""

from __future__ import annotations

from importlib import import_module
from time import monotonic, sleep
from typing import TYPE_CHECKING, Final

from edoras_tools.errors import ConfigError
from edoras_tools.middleware.names import node_name

if TYPE_CHECKING:
    from collections.abc import Mapping

    from edoras_tools.middleware.dds.graph import DdsGraph
    from edoras_tools.ros import TypeStore

_PATIENCE_S: Final = 1.5
"""Discovery by multicast takes some tenths of a second."""
_STEP_S: Final = 0.05


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


def distro_of_peers(domain: int, options: Mapping[str, str] | None = None) -> str | None:
    """Return the distribution that the nodes of a domain tell; None where none is found in a short time.

    Raises:
        ConfigError: an option cannot be honoured, or Cyclone DDS refuses the domain.
        ImportError: cyclonedds is not installed.
    """
    from cyclonedds.core import DDSException
    from cyclonedds.domain import DomainParticipant

    from edoras_tools.middleware.dds import domain as dds_domain
    from edoras_tools.middleware.dds.peers import Discovered

    dds_domain.hold(domain, dds_domain.configuration(options or {}))
    try:
        participant = DomainParticipant(domain)
        peers = Discovered(participant)
        end = monotonic() + _PATIENCE_S
        while peers.distro is None and monotonic() < end:
            sleep(_STEP_S)
            peers.update()
        for entity in (*peers.entities, participant):  # as the graph leaves: cyclonedds deletes nothing else
            entity.__del__()
    except DDSException as error:
        raise ConfigError(f"dds: no participant in domain {domain}: {error}") from error
    finally:
        dds_domain.release(domain)
    return peers.distro
