# SPDX-License-Identifier: GPL-2.0-only
"""Capture through scapy, for systems without Linux packet sockets.

scapy is GPL-2.0-only, so this file is too; the project is MIT. It is imported when a source is made.
Slower than the ring by far: every packet passes through Python.
"""

from __future__ import annotations

import socket
import struct
import time
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from edoras_tools.errors import CaptureError
from edoras_tools.model import Finding, SourceInfo
from edoras_tools.sources.bpf import ETHERNET, LINUX_SLL2, NOTHING, RAW, attach
from edoras_tools.sources.device import DeviceSource
from edoras_tools.sources.framing import PADDING
from edoras_tools.sources.interfaces import denied, find, interfaces, missing
from edoras_tools.sources.linklayer import FrameBatch

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from edoras_tools.model import PacketBatch

_LINK_TYPES: Final = {
    "Ether": ETHERNET,
    "Loopback": 0,
    "IP": RAW,
    "IPv6": RAW,
    "CookedLinux": 113,
    "CookedLinuxV2": LINUX_SLL2,
}
"""LINKTYPE by the scapy class that would dissect the frame."""
_SOL_PACKET: Final = 263
_PACKET_STATISTICS: Final = 6
_PACKET_IGNORE_OUTGOING: Final = 23
_LINUX: Final = hasattr(socket, "AF_PACKET")
_LARGEST: Final = 65600
_RECEIVE_BUFFER: Final = 16 << 20
_AT_ONCE: Final = 4096
"""Frames that one read takes at most."""


class Sniffer:
    """A scapy listening socket on one interface.

    Args:
        interface: its name.
        ports: UDP ports to ask the kernel for, where scapy can compile a filter.
        snap_length: bytes of a frame to keep.

    Attributes:
        info: what the source is.
        drops: frames that the kernel lost, on Linux; elsewhere scapy cannot say.
        linger_s: how long to let frames gather.

    Raises:
        CaptureError: no such interface, or it may not be opened.
    """

    def __init__(self, interface: str, ports: Iterable[int], snap_length: int) -> None:
        if interface not in interfaces():
            raise missing(interface)
        self.info = SourceInfo(interface, "live", time_resolution_ns=1000, snap_length=snap_length)
        self.drops = 0
        self.linger_s = 0.02
        self._number = 1
        self._failure: str | None = None
        self._socket = _listen(interface, _expression(ports))
        inner = getattr(self._socket, "ins", None)
        self._packet_socket = inner if _LINUX and isinstance(inner, socket.socket) else None
        if self._packet_socket is not None:
            self._packet_socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER)
            if find(interface).loopback:  # a packet would come twice: on its way out, and in
                self._packet_socket.setsockopt(_SOL_PACKET, _PACKET_IGNORE_OUTGOING, 1)
            self.count()
            self.drops = 0  # what there was no room for before the filter was there

    def filenos(self) -> tuple[int, ...]:
        """Return the file descriptor that becomes readable when a frame is there."""
        return (self._socket.fileno(),)

    def read(self) -> FrameBatch | None:
        """Take the frames that are there; None when there are none."""
        frames: list[bytes] = []
        lengths: list[int] = []
        types: list[int] = []
        times: list[int] = []
        try:
            while len(frames) < _AT_ONCE and self._socket.select([self._socket], 0):
                layer, frame, seconds = self._socket.recv_raw(_LARGEST)
                if not frame:
                    break
                if layer.__name__ not in _LINK_TYPES:
                    self._failure = (
                        f"{self.info.name}: {layer.__name__} frames cannot be read: use another interface"
                    )
                    break
                frames.append(frame[: self.info.snap_length])
                lengths.append(len(frame))
                types.append(_LINK_TYPES[layer.__name__])
                times.append(round(seconds * 1e6) * 1000 if seconds else time.time_ns())
        except OSError as error:
            self._failure = f"{self.info.name}: {error.strerror}; what came before is kept"
        if not frames:
            return None
        length = np.array([len(frame) for frame in frames], dtype=np.int32)
        batch = FrameBatch(
            data=np.frombuffer(b"".join((*frames, bytes(PADDING))), dtype=np.uint8),
            number=np.arange(self._number, self._number + len(frames), dtype=np.int64),
            time_ns=np.array(times, dtype=np.int64),
            link_type=np.array(types, dtype=np.uint16),
            offset=np.cumsum(length, dtype=np.int64) - length,
            length=length,
            original_length=np.array(lengths, dtype=np.int32),
        )
        self._number += len(batch)
        return batch

    def count(self) -> None:
        """Ask the kernel what it dropped, where there is a way."""
        if self._packet_socket is not None:
            counters = self._packet_socket.getsockopt(_SOL_PACKET, _PACKET_STATISTICS, 8)
            self.drops += struct.unpack("=2I", counters)[1]

    def refuse(self) -> None:
        """Let nothing more in, where there is a way."""
        if self._packet_socket is not None:
            attach(self._packet_socket, NOTHING)

    def drained(self) -> bool:
        """Tell that a read that found nothing has found everything."""
        return True

    def failure(self) -> str | None:
        """Return why no frame will come any more, None while all is well."""
        return self._failure

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class ScapySource(DeviceSource):
    """Datagrams from an interface, captured through scapy.

    Args:
        interface: its name.
        ports: UDP ports to capture, source or destination; none for every UDP datagram.
        ready: called once when ``batches`` starts; nothing that arrives after construction is missed.
        snap_length: bytes of a frame to keep.

    Raises:
        CaptureError: no such interface, or it may not be opened.
    """

    def __init__(
        self,
        interface: str,
        ports: Iterable[int] = (),
        *,
        ready: Callable[[], None] | None = None,
        snap_length: int = 262144,
    ) -> None:
        self._ports = np.array(sorted(set(ports)), dtype=np.int64)
        super().__init__(Sniffer(interface, self._ports.tolist(), snap_length), ready=ready)
        if not _LINUX:
            self.statistics.warnings.append(
                "scapy cannot say how many frames this system dropped: 0 drops is not a promise"
            )

    def _hand_over(self, frames: FrameBatch) -> PacketBatch:
        """Leave out what a kernel without a filter let through; fragments may have no ports and stay."""
        batch = super()._hand_over(frames)
        if not len(self._ports):
            return batch
        wanted = np.isin(batch.source_port, self._ports) | np.isin(batch.destination_port, self._ports)
        wanted |= (batch.capture_findings & Finding.FRAGMENT) != 0
        kept = batch.take(wanted)
        self.statistics.datagrams += len(kept) - len(batch)
        return kept


def _expression(ports: Iterable[int]) -> str | None:
    """Write the port filter in libpcap's language; later fragments and tagged frames show no ports to it."""
    wanted = " or ".join(f"udp port {port}" for port in ports)
    return f"{wanted} or (ip[6:2] & 0x1fff != 0) or ip6[6] == 44 or vlan" if wanted else None


def _listen(
    interface: str, expression: str | None
) -> Any:  # scapy's sockets have no common type worth naming
    """Open scapy's listening socket, without a filter where none can be compiled."""
    import scapy.arch
    import scapy.layers.inet
    import scapy.layers.inet6  # noqa: F401  the layers that frames are named after
    from scapy.config import conf
    from scapy.error import Scapy_Exception

    for attempt in dict.fromkeys((expression, None)):
        try:
            return conf.L2listen(iface=interface, filter=attempt)
        except PermissionError:
            raise denied(interface) from None
        except Scapy_Exception as error:
            if attempt is None:
                raise CaptureError(f"{interface}: {error}") from error
        except (OSError, ValueError) as error:
            raise CaptureError(f"{interface}: {error}") from error
    raise AssertionError("the last attempt returns or raises")
