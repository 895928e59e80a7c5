"""Command Ingest: ground to cFS, one bare space packet a datagram."""

from __future__ import annotations

from typing import Final

from edoras_tools.cfs.limits import CI_BUFFER
from edoras_tools.links.protocol import LinkProtocol
from edoras_tools.model import Finding, Transport


class CommandIngestLink(LinkProtocol):
    """The link to CI_LAB.

    Its ports are 1234 + (CPU number - 1), so the port of cpu2 is also the one that TO_LAB sends to. The
    addresses of the mission decide between the two; without them, the packet's type bit does.
    """

    code = 1
    name = "CI"
    label = "ci"
    colour = "cyan"
    doc = "ground to cFS, one space packet a datagram (Command Ingest)"
    transport = Transport(ports=(1234, 1235, 1236, 1237))
    to_cfs = True
    packets = True
    bridge = "ground"
    bridge_ports = ("fsw_port",)
    receive_buffer = CI_BUFFER
    over_receive_buffer = Finding.OVER_CI_BUFFER


CI: Final = CommandIngestLink()
