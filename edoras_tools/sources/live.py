"""Live capture from a network interface."""

from __future__ import annotations

import socket
from typing import TYPE_CHECKING

from edoras_tools.errors import CaptureError
from edoras_tools.sources.device import DeviceSource
from edoras_tools.sources.interfaces import interfaces
from edoras_tools.sources.ring import Ring

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

__all__ = ["BACKENDS", "LiveSource", "interfaces", "open_live"]

BACKENDS = ("auto", "ring", "scapy")
"""How frames are captured: ``ring`` is Linux's own, ``scapy`` goes through scapy; ``auto`` chooses."""


class LiveSource(DeviceSource):
    """Datagrams from an interface, as they come, through a ring shared with the kernel (Linux).

    Args:
        interface: its name, or ``any``.
        ports: UDP ports to capture, source or destination; none for every UDP datagram.
        ready: called once when ``batches`` starts; nothing that arrives after construction is missed.
        immediate_ms: how long a packet may wait in the kernel for others to share its block.
        snap_length: bytes of a frame to keep.
        promiscuous: receive frames for other hosts as well, as on a mirror port.

    Raises:
        CaptureError: no such interface, it is down, the privilege is missing, or there are too many ports.
    """

    def __init__(
        self,
        interface: str,
        ports: Iterable[int] = (),
        *,
        ready: Callable[[], None] | None = None,
        immediate_ms: int = 20,
        snap_length: int = 262144,
        promiscuous: bool = True,
    ) -> None:
        ring = Ring(
            interface, ports, retire_ms=immediate_ms, snap_length=snap_length, promiscuous=promiscuous
        )
        super().__init__(ring, ready=ready)


def open_live(
    interface: str,
    ports: Iterable[int] = (),
    *,
    backend: str = "auto",
    ready: Callable[[], None] | None = None,
) -> DeviceSource:
    """Start capturing from an interface.

    Args:
        interface: its name, or ``any`` (ring only).
        ports: UDP ports to capture, source or destination; none for every UDP datagram.
        backend: one of ``BACKENDS``.
        ready: called once when ``batches`` starts.

    Raises:
        CaptureError: it cannot be captured from, or there is no such back end.
    """
    if backend not in BACKENDS:
        raise CaptureError(f"{backend}: no such capture back end; there are {', '.join(BACKENDS)}")
    if backend == "ring" or (backend == "auto" and hasattr(socket, "AF_PACKET")):
        return LiveSource(interface, ports, ready=ready)
    from edoras_tools.sources.scapy_backend import ScapySource

    return ScapySource(interface, ports, ready=ready)
