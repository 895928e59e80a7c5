"""The links, one row each in the table below; see docs/links.md.

This file imports no link: help texts name the links, and ``edoras host`` their ports, without loading them.
The links themselves are in :mod:`edoras_tools.links.table`.
"""

from __future__ import annotations

from typing import Final

from edoras_tools.doors import addon_ports

ROWS: Final = {
    "ci": "edoras_tools.links.bare:CI",
    "to": "edoras_tools.links.bare:TO",
    "sbn": "edoras_tools.links.sbn:SBN",
    "robot": "edoras_tools.links.bare:ROBOT",
    "file": "edoras_tools.links.table:STORED",
    "reset": "edoras_tools.links.table:RESETS",
    "icmp": "edoras_tools.links.icmp:ICMP",
}
"""Locations of the built-in links; other packages add theirs by entry points."""

BRIDGE_PORT: Final = 2236
"""The port of the demos' flight bridge."""
CFS_PORT: Final = 8080
"""The port at which the EDORAS application hears its robot."""
ROBOT_PORT: Final = 8585
"""The port of the robot."""
PORTS: Final = {
    "ci": (1234, 1235, 1236, 1237),
    "to": (1235,),
    "sbn": (2234, 2235, BRIDGE_PORT),
    "robot": (CFS_PORT, ROBOT_PORT),
}
"""Usual UDP ports of the links; those of add-ons are in their table."""


def usual_ports() -> dict[int, str]:
    """Return the labels of the links that each UDP port has if nothing names another one, joined by ``/``."""
    labels: dict[int, list[str]] = {}
    for label, ports in (PORTS | addon_ports()).items():
        for port in ports:
            labels.setdefault(port, []).append(label)
    return {port: "/".join(labels[port]) for port in sorted(labels)}
