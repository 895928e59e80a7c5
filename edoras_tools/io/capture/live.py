"""Live capture from a network interface."""

from __future__ import annotations

import socket
from typing import TYPE_CHECKING

from edoras_tools.io.capture.device import DeviceSource
from edoras_tools.io.capture.ring import Ring
from edoras_tools.io.capture.scapy_backend import ScapySource

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from edoras_tools.model import InterfaceOutage


def open_live(
    interface: str,
    ports: Iterable[int] = (),
    *,
    streams: Iterable[int] = (),
    begins: Sequence[bytes] = (),
    ready: Callable[[], None] | None = None,
    on_outage: Callable[[InterfaceOutage], None] | None = None,
    wait: bool = False,
) -> DeviceSource:
    """Start capturing from an interface: through a ring shared with the kernel; without Linux, with scapy.

    Args:
        interface: its name, or ``any`` (ring only).
        ports: UDP ports to capture, source or destination; if empty, every UDP datagram.
        streams: TCP ports to capture; if empty, none.
        begins: see ``port_filter``.
        ready: called once when ``batches`` starts; nothing that arrives after construction is missed.
        on_outage: see ``DeviceSource``.
        wait: if the interface does not exist or is down, treat it as one that is away now (ring only).

    Raises:
        CaptureError: no such interface, it is down, a privilege is missing, or there are too many ports.
    """
    if hasattr(socket, "AF_PACKET"):
        ring = Ring(interface, ports, streams=streams, begins=begins, wait=wait)
        return DeviceSource(ring, ready=ready, on_outage=on_outage)
    return ScapySource(interface, ports, streams=streams, begins=begins, ready=ready)
