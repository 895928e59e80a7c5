"""Datagrams from plain UDP sockets: no privilege is needed, and this machine is the receiver."""

from __future__ import annotations

import contextlib
import socket
import time
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from edoras_tools.errors import CaptureError, OnFailure
from edoras_tools.io.capture.device import Device, DeviceSource
from edoras_tools.io.frames.frame_batch import ENDS, FrameBatch, FramePage
from edoras_tools.io.net.buffer import SLOTS, make_buffer
from edoras_tools.io.net.sockets import LINUX, kernel_drops, local_endpoint, open_bound, waiting_bytes
from edoras_tools.model import Endpoint, SourceInfo
from edoras_tools.units import SECOND

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable


_READ_BYTES: Final = 1 << 20
"""Approximate bytes of payloads per read, divided among the sockets."""
_RECEIVE_BUFFER: Final = 64 << 20
"""Receive buffer to request, in bytes: a second of 100,000 small datagrams, as the kernel counts them. A
recorder without the privilege to exceed the system's limit gets less; it is used only while it is behind."""
_LINGER_S, _BUSY_LINGER_S = 0.4 if LINUX else 0.05, 0.01
_LOOK_S: Final = 1.0
"""Longest time between two reads; a socket reports every datagram by itself, so it can be long."""
_FULL: Final = 16
"""Part of a receive buffer that may fill, at the present rate, before it is read: one 16th."""
_CHARGED: Final = 600
"""Bytes that the kernel counts for a datagram besides its payload."""
_FILL_RATE: Final = 40_000_000
"""Bytes per second, as the kernel counts them (about 800 for a small datagram), that buffers must hold."""
_PORT: Final = slice(2, 4)
_ADDRESS: Final = {4: slice(4, 8), 6: slice(8, 24)}
"""Position of port and IP address in a socket address, by IP version."""


class _Bound(NamedTuple):
    socket: socket.socket
    version: int
    port: int


class Sockets(Device):
    """Bound UDP sockets that are read together.

    Args:
        endpoints: addresses and ports to bind; with port 0 the system chooses one.
        receive_buffer: bytes to request for each socket; the kernel may limit it.

    Attributes:
        linger_s: time for which datagrams may gather without filling the receive buffers.
        outages: always empty.
        endpoints: the addresses and ports that were bound.

    Raises:
        CaptureError: an endpoint cannot be bound, or there is none.
    """

    def __init__(self, endpoints: Iterable[Endpoint], receive_buffer: int = _RECEIVE_BUFFER) -> None:
        super().__init__(_LINGER_S, _LOOK_S)
        self._bound: list[_Bound] = []
        self._buffer = make_buffer()
        self._page = FramePage()
        self._number = 1
        self._smallest = 1 << 62
        self._emptied = False
        with OnFailure(self.close):
            self.endpoints = tuple(self._bind(endpoint, receive_buffer) for endpoint in endpoints)
        if not self.endpoints:
            raise CaptureError("no endpoint to listen on: name one as HOST:PORT")
        self.info = SourceInfo(", ".join(str(endpoint) for endpoint in self.endpoints), "udp")

    def _bind(self, endpoint: Endpoint, receive_buffer: int) -> Endpoint:
        instead = "capture from the interface with -i, which sees its datagrams without taking the port"
        opened = open_bound(endpoint, instead=instead, buffer_bytes=receive_buffer, destinations=True)
        local = local_endpoint(opened)
        self._smallest = min(self._smallest, opened.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF))
        self._bound.append(_Bound(opened, 6 if opened.family == socket.AF_INET6 else 4, local.port))
        return local

    def filenos(self) -> tuple[int, ...]:
        """Return the file descriptors that become readable when a datagram arrives."""
        return tuple(bound.socket.fileno() for bound in self._bound)

    def read(self) -> FrameBatch | None:
        """Return the datagrams that have arrived, about a MiB at most, in order of time; None if none.

        It is also None once after a read that emptied all sockets. Datagrams that came to one socket after
        another one had been read are kept for the next read; otherwise times could go back between two reads.
        """
        if self._emptied:
            self._emptied = False
            return None
        page = self._page
        while True:
            rows, used = page.rows, page.used
            now_ns = whole_ns = time.time_ns()  # later datagrams have later times
            emptied = True
            for bound in self._bound:
                if not self._drain(bound, page):
                    emptied = False
                    whole_ns = min(whole_ns, int(page.time_ns[page.rows - 1]))
            fresh = page.rows > rows
            if fresh:
                filled = (page.rows - rows) * _CHARGED + page.used - used
                within_s = (now_ns - int(page.time_ns[rows : page.rows].min())) / SECOND
                longest_s = min(_LINGER_S, self._smallest / _FILL_RATE)
                part_s = self._smallest / _FULL / filled * within_s
                self.linger_s = min(longest_s, max(part_s, _BUSY_LINGER_S))
            order = np.argsort(page.time_ns[: page.rows], kind="stable")
            count = len(order)
            if fresh and len(self._bound) > 1:
                count = int(np.searchsorted(page.time_ns[order], whole_ns, "right"))
            if count or not fresh:
                break
        if not count:
            return None
        frames = page.frames(self._number, order[:count])
        self._number += count
        self._page = page.part(order[count:])
        self._emptied = emptied and count == len(order)
        return frames

    def _drain(self, bound: _Bound, page: FramePage) -> bool:
        """Add a socket's datagrams to a page, up to its share; return whether the socket is empty."""
        buffer, share = self._buffer, page.used + _READ_BYTES // len(self._bound)
        while page.used < share:
            count = buffer.receive(bound.socket)
            if count <= 0:
                return True
            senders = buffer.senders(count).view(np.uint8).reshape(count, -1)
            ends = np.zeros(count, ENDS)
            width = 4 if bound.version == 4 else 16
            ends["version"], ends["destination_port"] = bound.version, bound.port
            ends["source"][:, :width] = senders[:, _ADDRESS[bound.version]]
            ends["source_port"] = np.ascontiguousarray(senders[:, _PORT]).view(">u2")[:, 0]
            ends["destination"][:, :width] = buffer.destinations(count, bound.version)
            page.add(
                buffer.slots.reshape(-1),
                buffer.starts[:count],
                buffer.length[:count],
                buffer.times(count),
                ends,
            )
            if count < SLOTS:
                return True
        return False

    def count(self) -> None:
        """Read the kernel's drop counters."""
        self.drops = sum(kernel_drops(bound.socket) for bound in self._bound)

    def pressed(self) -> bool:
        """Return whether a buffer is fuller than ``_FULL`` allows."""
        return any(waiting_bytes(bound.socket) > self._smallest // _FULL for bound in self._bound)

    def refuse(self) -> None:
        """Receive nothing from now on: each socket is connected to itself, so no other sender is accepted."""
        self._emptied = False
        for bound in self._bound:
            with contextlib.suppress(OSError):
                bound.socket.connect(bound.socket.getsockname())

    def close(self) -> None:
        """Close the sockets."""
        for bound in self._bound:
            bound.socket.close()


class UdpSource(DeviceSource):
    """Datagrams that are sent to this process, received on plain UDP sockets.

    IPv6 sockets take only IPv6, so that ``0.0.0.0`` and ``::`` can be used together.

    Args:
        endpoints: addresses and ports to bind; with port 0 the system chooses one.
        ready: called once when ``batches`` starts; nothing that arrives after construction is missed.

    Attributes:
        endpoints: the addresses and ports that were bound.

    Raises:
        CaptureError: an endpoint cannot be bound, or there is none.
    """

    def __init__(self, endpoints: Iterable[Endpoint], *, ready: Callable[[], None] | None = None) -> None:
        sockets = Sockets(endpoints)
        self.endpoints = sockets.endpoints
        super().__init__(sockets, ready=ready)
