# SPDX-License-Identifier: GPL-2.0-only
"""Capture through scapy, for systems without Linux packet sockets.

scapy is GPL-2.0-only, so this file is too; the project is MIT. It is imported only when it is used.
It is much slower than the ring: every packet is handled in Python.
"""

from __future__ import annotations

import socket
import struct
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Final

import numpy as np

from edoras_tools.decode.columns import beginning
from edoras_tools.errors import CaptureError
from edoras_tools.io.capture import device
from edoras_tools.io.capture.bpf import ETHERNET, LINUX_SLL2, NOTHING, RAW, attach_program
from edoras_tools.io.frames.frame_batch import FrameBatch
from edoras_tools.io.frames.network import error_rows, quoted_ports
from edoras_tools.model import Finding, PacketBatch, SourceInfo
from edoras_tools.wire.arrays import PADDING

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
"""Maximum frames of one read."""


class Sniffer(device.Device):
    """A scapy listening socket on one interface.

    Args:
        expression: the kernel's filter, if scapy can compile it; None for none.
        snap_length: bytes of a frame to keep.

    Attributes:
        drops: number of frames that the kernel lost, on Linux; scapy does not know it on other systems.
        outages: always empty: if the interface goes away, the capture ends.

    Raises:
        CaptureError: no such interface, or it may not be opened.
    """

    def __init__(self, interface: str, expression: str | None, snap_length: int) -> None:
        if interface not in device.interfaces():
            raise device.missing_interface(interface)
        super().__init__(linger_s=0.02, look_s=0.1)
        self.info = SourceInfo(interface, "live", time_resolution_ns=1000, snap_length=snap_length)
        self._number = 1
        self._failure: str | None = None
        self._socket = _listen(interface, expression)
        inner = getattr(self._socket, "ins", None)
        self._packet_socket = inner if _LINUX and isinstance(inner, socket.socket) else None
        if self._packet_socket is not None:
            self._packet_socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER)
            if device.find_interface(
                interface
            ).loopback:  # a packet would come twice: when sent, and when received
                self._packet_socket.setsockopt(_SOL_PACKET, _PACKET_IGNORE_OUTGOING, 1)
            self.count()
            self.drops = 0  # drops from before the filter was set do not count

    def filenos(self) -> tuple[int, ...]:
        """Return the file descriptor that becomes readable when a frame has arrived."""
        return (self._socket.fileno(),)

    def read(self) -> FrameBatch | None:
        """Return the frames that have arrived; None if there are none."""
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
            self._failure = f"{self.info.name}: {error.strerror}; frames captured before are kept"
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
        """Read the kernel's drop counter, if possible."""
        if self._packet_socket is not None:
            counters = self._packet_socket.getsockopt(_SOL_PACKET, _PACKET_STATISTICS, 8)
            self.drops += struct.unpack("=2I", counters)[1]

    def refuse(self) -> None:
        """Drop every packet from now on, if possible."""
        if self._packet_socket is not None:
            attach_program(self._packet_socket, NOTHING)

    def failure(self) -> str | None:
        """Return why no more frames will come, or None."""
        return self._failure

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class ScapySource(device.DeviceSource):
    """Datagrams from an interface, captured through scapy.

    Args:
        ports: UDP ports to capture, source or destination; if empty, every UDP datagram.
        streams: TCP ports to capture; if empty, none.
        begins: see ``port_filter``.
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
        streams: Iterable[int] = (),
        begins: Sequence[bytes] = (),
        ready: Callable[[], None] | None = None,
        snap_length: int = 262144,
    ) -> None:
        self._ports = np.array(sorted(set(ports)), dtype=np.int64)
        self._begins = begins
        expression = _expression(self._ports.tolist(), streams, begins)
        super().__init__(Sniffer(interface, expression, snap_length), ready=ready)
        if not _LINUX:
            self.statistics.warnings.append(
                "scapy does not know how many frames this system dropped: 0 drops may be wrong"
            )

    def _demuxed(self, frames: FrameBatch) -> PacketBatch:
        """Leave out other ports, for kernels without a filter; fragments may have no ports and are kept."""
        batch = super()._demuxed(frames)
        if not len(self._ports):
            return batch
        keep = np.isin(batch.source_port, self._ports) | np.isin(batch.destination_port, self._ports)
        for word in self._begins:
            keep[beginning(batch, np.arange(len(batch)), word)] = True
        keep |= (batch.capture_findings & Finding.FRAGMENT) != 0
        errors = np.flatnonzero(error_rows(batch))
        keep[errors] |= np.isin(quoted_ports(batch, errors), self._ports).any(axis=1)
        if batch.streams is not None:
            keep |= batch.streams
        remaining = batch.take(keep)
        self.statistics.datagrams += len(remaining) - len(batch)
        return remaining


def _expression(
    ports: Iterable[int], streams: Iterable[int] = (), begins: Sequence[bytes] = ()
) -> str | None:
    """Return the port filter in libpcap's language; in later fragments and tagged frames it sees no ports."""
    expression = " or ".join(f"udp port {port}" for port in ports)
    others = [f"tcp port {port}" for port in streams]
    for number in (int.from_bytes(word, "big") for word in begins):
        others += [f"udp[8:4] = {number}", f"(ip6[6] == 17 and ip6[48:4] = {number})"]
    if not expression:
        return None
    others += ["icmp[0] = 3", "icmp[0] = 11", "(ip6[6] == 58 and ip6[40] >= 1 and ip6[40] <= 3)"]
    return " or ".join([expression, *others, "(ip[6:2] & 0x1fff != 0)", "ip6[6] == 44", "vlan"])


def _listen(
    interface: str, expression: str | None
) -> Any:  # scapy's sockets have no common type worth naming
    """Open scapy's listening socket, without a filter if none can be compiled."""
    import scapy.arch
    import scapy.layers.inet
    import scapy.layers.inet6  # noqa: F401  the layers that frames are named after
    from scapy.config import conf
    from scapy.error import Scapy_Exception

    for attempt in dict.fromkeys((expression, None)):
        try:
            return conf.L2listen(iface=interface, filter=attempt)
        except PermissionError:
            raise device.denied(interface) from None
        except Scapy_Exception as error:
            if attempt is None:
                raise CaptureError(f"{interface}: {error}") from error
        except (OSError, ValueError) as error:
            raise CaptureError(f"{interface}: {error}") from error
    raise AssertionError("the last attempt returns or raises")
