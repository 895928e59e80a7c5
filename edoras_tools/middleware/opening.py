"""Joining a ROS 2 graph through a middleware chosen by name; the others are not imported."""

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING, Any, Final

from edoras_tools import doors
from edoras_tools.errors import ConfigError
from edoras_tools.middleware import MOST_DOMAIN
from edoras_tools.middleware.graph import Graph, Middleware

if TYPE_CHECKING:
    from collections.abc import Mapping

    from edoras_tools.ros import TypeStore

_HERE: Final = "edoras_tools.middleware"
_PYTHON: Final = f"{sys.version_info.major}.{sys.version_info.minor}"
_OF_THE_CORE: Final = {
    "rclpy": Middleware(
        f"{_HERE}.rclpy:open_graph",
        f"a ROS 2 of Python {_PYTHON} ({{why}}); source its setup.bash, or: "
        "pip install ros-rclpy ros-rmw-fastrtps-cpp",
        open=True,
    )
}


def names() -> list[str]:
    """Return the names of all middlewares that ship."""
    return sorted([*doors.shipped("middleware"), *_OF_THE_CORE])


def middleware(ros: str) -> Middleware:
    """Return the middleware with a name.

    Raises:
        ConfigError: there is no such name, or its add-on was deleted.
    """
    if ros in _OF_THE_CORE:
        return _OF_THE_CORE[ros]
    item = doors.find("middleware", ros)
    if item is None:
        existing = [*names(), *(item.name for item in doors.installed("middleware"))]
        raise ConfigError(f"--ros {ros!r} is not known; there are {', '.join(existing)}")
    loaded = item.load()
    if not isinstance(loaded, Middleware):
        raise item.error(f"{item.place} is not an object of Middleware")
    return loaded


def usual(environ: Mapping[str, str] | None = None) -> str:
    """Return the middleware that the environment selects: DDS unless it names Zenoh.

    Raises:
        ConfigError: this installation does not have it.
    """
    rmw = (os.environ if environ is None else environ).get("RMW_IMPLEMENTATION", "")
    installed = {name: item.load() for name, item in doors.shipped("middleware").items() if not item.absent}
    for name, item in installed.items():
        if rmw and item.implementation == rmw:
            return name
    for name, item in installed.items():
        if item.usual:
            return name
    raise ConfigError(f"no middleware is usual in this installation; choose with --ros: {', '.join(names())}")


def usual_domain(environ: Mapping[str, str] | None = None) -> int:
    """Return ``ROS_DOMAIN_ID``, 0 if it is not set.

    Raises:
        ConfigError: it is not a number of a domain.
    """
    text = (os.environ if environ is None else environ).get("ROS_DOMAIN_ID", "").strip() or "0"
    if not text.isascii() or not text.isdecimal() or int(text) > MOST_DOMAIN:
        raise ConfigError(f"ROS_DOMAIN_ID {text!r} is not a domain; 0 to {MOST_DOMAIN}")
    return int(text)


def open_graph(
    ros: str, store: TypeStore, node: str, *, domain: int = 0, options: Mapping[str, str] = {}
) -> Graph:
    """Join a graph.

    Args:
        ros: name of a middleware.
        domain: ROS 2 domain.
        options: options of the middleware, by name.

    Raises:
        ConfigError: there is no such middleware, its library is not installed, or it refuses.
    """
    way = middleware(ros)
    try:
        graph: Graph = _imported(ros, way.place)(store, node, domain=domain, options=options)
    except ImportError as error:
        why = str(error).partition("\n")[0]
        raise ConfigError(f"--ros {ros} needs {way.needs.format(why=why)}") from error
    return graph


def distro_of_peers(ros: str, domain: int, options: Mapping[str, str] = {}) -> str | None:
    """Return the ROS 2 distribution that other nodes announce; None if no node does: only DDS can show it.

    Errors are ignored here: joining the graph reports them.
    """
    place = middleware(ros).peers
    if not place:
        return None
    try:
        distro: str | None = _imported(ros, place)(domain, options)
    except (ImportError, ConfigError):
        return None
    return distro


def _imported(ros: str, place: str) -> Any:
    """Import the object of a place.

    Raises:
        ConfigError: its library is installed, but does not load.
        ImportError: its library is not installed.
    """
    try:
        return doors.imported(place)
    except ImportError:
        raise
    except Exception as error:  # a library may raise anything while it looks for its own
        raise ConfigError(f"--ros {ros}: its library does not load: {error}") from error
