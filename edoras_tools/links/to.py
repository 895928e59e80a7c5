"""Telemetry Output: cFS to ground, one bare space packet a datagram."""

from __future__ import annotations

from typing import Final

from edoras_tools.cfs.limits import BRIDGE_BUFFER
from edoras_tools.links.protocol import LinkProtocol
from edoras_tools.model import Finding, Transport


class TelemetryOutputLink(LinkProtocol):
    """The link from TO_LAB, which sends to one address at a time once it is enabled."""

    code = 2
    name = "TO"
    label = "to"
    colour = "green"
    doc = "cFS to ground, one space packet a datagram (Telemetry Output)"
    transport = Transport(ports=(1235,), first="server")
    from_cfs = True
    packets = True
    bridge = "ground"
    bridge_ports = ("bridge_port",)
    receive_buffer = BRIDGE_BUFFER
    over_receive_buffer = Finding.OVER_BRIDGE_BUFFER


TO: Final = TelemetryOutputLink()
