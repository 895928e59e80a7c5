"""Joining a ROS 2 graph through a middleware chosen by name; nothing of the others is imported."""

from __future__ import annotations

import os
import sys
from importlib import import_module
from typing import TYPE_CHECKING, Final

from edoras_tools.errors import ConfigError
from edoras_tools.middleware.graph import MOST_DOMAIN, Graph

if TYPE_CHECKING:
    from collections.abc import Mapping

    from edoras_tools.ros import TypeStore

MIDDLEWARES: Final = {
    "zenoh": "zenoh.graph",
    "dds": "dds.joining",
    "rclpy": "rclpy",
    "foxglove": "foxglove",
    "local": "local",
}
"""Name to the module of this folder that has its ``open_graph``."""
_EXTRAS: Final = {"zenoh": "zenoh", "dds": "dds", "foxglove": "live"}
_BY_RMW: Final = {"rmw_zenoh_cpp": "zenoh"}


def usual(environ: Mapping[str, str] | None = None) -> str:
    """Return the middleware that the environment selects: DDS unless it names Zenoh."""
    environ = os.environ if environ is None else environ
    return _BY_RMW.get(environ.get("RMW_IMPLEMENTATION", ""), "dds")


def usual_domain(environ: Mapping[str, str] | None = None) -> int:
    """Return ``ROS_DOMAIN_ID``, 0 where it is not set.

    Raises:
        ConfigError: it is not a domain.
    """
    text = (os.environ if environ is None else environ).get("ROS_DOMAIN_ID", "").strip() or "0"
    if not text.isascii() or not text.isdecimal() or int(text) > MOST_DOMAIN:
        raise ConfigError(f"ROS_DOMAIN_ID {text!r} is not a domain; 0 to {MOST_DOMAIN}")
    return int(text)


def open_graph(
    ros: str,
    store: TypeStore,
    node: str,
    *,
    domain: int = 0,
    options: Mapping[str, str] = {},
) -> Graph:
    """Join a graph.

    Args:
        ros: one of ``MIDDLEWARES``.
        domain: ROS 2 domain.
        options: of the middleware, by name.

    Raises:
        ConfigError: there is no such middleware, its library is not installed, or it refuses.
    """
    if ros not in MIDDLEWARES:
        raise ConfigError(f"--ros {ros!r} is not known; there are {', '.join(MIDDLEWARES)}")
    try:
        module = import_module(f"edoras_tools.middleware.{MIDDLEWARES[ros]}")
        graph: Graph = module.open_graph(store, node, domain=domain, options=options)
    except ImportError as error:
        raise ConfigError(_absent(ros, error)) from error
    return graph


def distro_of_peers(ros: str, domain: int, options: Mapping[str, str] = {}) -> str | None:
    """Return the ROS 2 distribution that other nodes tell; None where nobody does: only nodes on DDS can.

    What prevents it is told when the graph is joined.
    """
    if ros != "dds":
        return None
    try:
        told: str | None = import_module("edoras_tools.middleware.dds.peers").distro_seen(domain, options)
    except (ImportError, ConfigError):
        return None
    return told


def _absent(ros: str, error: ImportError) -> str:
    extra, why = _EXTRAS.get(ros), str(error).partition("\n")[0]
    if extra is None:
        python = f"{sys.version_info.major}.{sys.version_info.minor}"
        return (
            f"--ros {ros} needs a ROS 2 of Python {python} ({why}); source its setup.bash, or: "
            "pip install ros-rclpy ros-rmw-fastrtps-cpp"
        )
    return f"--ros {ros} needs an extra ({why}): pip install 'edoras-tools[{extra}]'"
