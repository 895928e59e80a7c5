"""Live capture from a network interface."""

from __future__ import annotations

import socket
from typing import TYPE_CHECKING

from edoras_tools.errors import CaptureError
from edoras_tools.io.capture.device import DeviceSource
from edoras_tools.io.capture.interfaces import interfaces
from edoras_tools.io.capture.ring import Ring
from edoras_tools.io.capture.scapy_backend import ScapySource

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from edoras_tools.model import InterfaceOutage

__all__ = ["BACKENDS", "LiveSource", "interfaces", "open_live"]

BACKENDS = ("auto", "ring", "scapy")
"""How frames are captured: ``ring`` is Linux's packet ring, ``scapy`` uses scapy; ``auto`` chooses."""


class LiveSource(DeviceSource):
    """Datagrams from an interface, live, through a ring shared with the kernel (Linux).

    Args:
        interface: its name, or ``any``.
        ports: UDP ports to capture, source or destination; if empty, every UDP datagram.
        streams: TCP ports to capture; if empty, none.
        begins: see ``port_filter``.
        ready: called once when ``batches`` starts; nothing that arrives after construction is missed.
        told: see ``DeviceSource``.
        wait: if the interface does not exist or is down, treat it as one that is away now.

    Raises:
        CaptureError: no such interface, it is down, a privilege is missing, or there are too many ports.
    """

    def __init__(
        self,
        interface: str,
        ports: Iterable[int] = (),
        *,
        streams: Iterable[int] = (),
        begins: Sequence[bytes] = (),
        ready: Callable[[], None] | None = None,
        told: Callable[[InterfaceOutage], None] | None = None,
        wait: bool = False,
    ) -> None:
        ring = Ring(interface, ports, streams=streams, begins=begins, wait=wait)
        super().__init__(ring, ready=ready, told=told)


def open_live(
    interface: str,
    ports: Iterable[int] = (),
    *,
    streams: Iterable[int] = (),
    begins: Sequence[bytes] = (),
    backend: str = "auto",
    ready: Callable[[], None] | None = None,
    told: Callable[[InterfaceOutage], None] | None = None,
    wait: bool = False,
) -> DeviceSource:
    """Start capturing from an interface.

    Args:
        interface: its name, or ``any`` (ring only).
        ports: UDP ports to capture, source or destination; if empty, every UDP datagram.
        streams: TCP ports to capture; if empty, none.
        begins: see ``port_filter``.
        backend: one of ``BACKENDS``.
        ready: called once when ``batches`` starts.
        told: see ``DeviceSource``.
        wait: if the interface does not exist or is down, treat it as one that is away now (ring only).

    Raises:
        CaptureError: the interface cannot be captured from, or there is no such back end.
    """
    if backend not in BACKENDS:
        raise CaptureError(f"{backend}: no such capture back end; there are {', '.join(BACKENDS)}")
    if backend == "ring" or (backend == "auto" and hasattr(socket, "AF_PACKET")):
        return LiveSource(interface, ports, streams=streams, begins=begins, ready=ready, told=told, wait=wait)

    return ScapySource(interface, ports, streams=streams, begins=begins, ready=ready)
