"""ICMP errors about datagrams, made by scapy."""

from scapy.layers.inet import ICMP, IP, UDP
from scapy.layers.inet6 import ICMPv6DestUnreach, ICMPv6PacketTooBig, ICMPv6TimeExceeded, IPv6
from scapy.layers.l2 import Ether
from scapy.packet import Raw


def datagram(payload, source, destination, **fields):
    """Return an IP packet with a datagram between two endpoints, address and port each."""
    internet = IPv6 if ":" in source[0] else IP
    ends = {"src": source[0], "dst": destination[0]}
    return internet(**ends, **fields) / UDP(sport=source[1], dport=destination[1]) / Raw(payload)


SIX = {1: ICMPv6DestUnreach, 2: ICMPv6PacketTooBig, 3: ICMPv6TimeExceeded}
"""The errors of ICMPv6 by type."""


def error_about(packet, *, kind=None, code=None, most=548, reporter=None):
    """Return the error that a host sends about an IP packet to its sender.

    Args:
        packet: as ``datagram`` returns it.
        kind: type of the error; by default destination unreachable.
        code: why; by default a closed port.
        most: bytes of the packet that are quoted.
        reporter: address of the host; by default whom the packet was for.
    """
    six = isinstance(packet, IPv6)
    ends = {"src": reporter or packet.dst, "dst": packet.src}
    if six:
        head = IPv6(**ends) / SIX[kind or 1](code=4 if code is None else code)
    else:
        head = IP(**ends, tos=0xC0) / ICMP(type=kind or 3, code=3 if code is None else code)
    return head / Raw(bytes(packet)[:most])


def frame(packet):
    """Return an Ethernet frame with an IP packet, as bytes."""
    return bytes(Ether(src="02:00:00:00:00:01", dst="02:00:00:00:00:02") / packet)
