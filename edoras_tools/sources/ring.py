"""Linux packet sockets with a TPACKET_V3 ring: frames come by the block, in memory shared with the kernel.

``linux/if_packet.h`` and ``Documentation/networking/packet_mmap.rst`` are the reference. The kernel fills a
block with packets and hands it over when it is full or ``retire_ms`` old; the block is copied out in one go
and given back at once.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import mmap
import os
import socket
import struct
from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.errors import CaptureError
from edoras_tools.model import SourceInfo
from edoras_tools.sources import tpacket
from edoras_tools.sources.bpf import ETHERNET, LINUX_SLL2, NOTHING, RAW, Instruction, attach, port_filter
from edoras_tools.sources.framing import PADDING
from edoras_tools.sources.interfaces import ANY, Interface, denied, find, loopback_index

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from edoras_tools.sources.linklayer import FrameBatch

_SOL_PACKET: Final = 263
_PACKET_ADD_MEMBERSHIP: Final = 1
_PACKET_RX_RING: Final = 5
_PACKET_STATISTICS: Final = 6
_PACKET_VERSION: Final = 10
_PACKET_IGNORE_OUTGOING: Final = 23
_PACKET_MR_PROMISC: Final = 1
_TPACKET_V3: Final = 2
_ETH_P_ALL: Final = 3
_STATUS_USER: Final = 1
_STATUS_KERNEL: Final = 0

_LINK_TYPES: Final = {1: ETHERNET, 772: ETHERNET, 519: RAW, 65534: RAW}
"""By ARPHRD type: ETHER, LOOPBACK, RAWIP, NONE (a tun); frames of others are taken without their header."""
_FRAME_SIZE: Final = 2048  # only has to divide the block: V3 packs packets of any size
_AT_ONCE: Final = 4 << 20
"""Bytes that one read copies out at most, unless a single block is larger."""


class Ring:
    """A packet socket on one interface, or on all, that receives through a ring.

    From the end of construction on, no packet is missed silently: what does not fit is in ``drops``.

    Args:
        interface: its name, or ``any``.
        ports: UDP ports to capture, source or destination; none for every UDP datagram.
        block_size: bytes of a block; a multiple of the page size that holds the largest frame.
        blocks: how many of them; halved until the kernel can spare the memory.
        retire_ms: age at which a block is handed over though it is not full.
        snap_length: bytes of a frame to keep.
        promiscuous: receive frames for other hosts as well, as on a mirror port.

    Attributes:
        info: what the source is.
        drops: frames that the kernel lost because the ring was full; brought up to date by ``count``.
        linger_s: 0; the kernel lets frames gather in a block.

    Raises:
        CaptureError: no such interface, it is down, the privilege is missing, or there are too many ports.
    """

    def __init__(
        self,
        interface: str,
        ports: Iterable[int] = (),
        *,
        block_size: int = 1 << 19,
        blocks: int = 64,
        retire_ms: int = 20,
        snap_length: int = 262144,
        promiscuous: bool = True,
    ) -> None:
        if not hasattr(socket, "AF_PACKET"):
            raise CaptureError("packet rings are a Linux feature: use the scapy back end on this system")
        found = find(interface)
        if not found.up:
            raise CaptureError(f"{interface} is down: switch it on with 'ip link set {interface} up'")
        link_type = _LINK_TYPES.get(found.hardware_type, LINUX_SLL2)
        program = port_filter(
            link_type,
            ports,
            snap_length=snap_length,
            loopback=found.index if found.loopback else loopback_index() if interface == ANY else None,
        )
        self.info = SourceInfo(interface, "live", snap_length=snap_length)
        self.drops = 0
        self.linger_s = 0.0
        self._link_type = link_type
        self._block_size = block_size
        self._delivered = 0
        self._read = 0
        self._next = 0
        self._socket = _open(interface, cooked=link_type == LINUX_SLL2)
        try:
            self._start(found, program, blocks, retire_ms, promiscuous=promiscuous)
        except OSError as error:
            self._socket.close()
            raise CaptureError(f"{interface}: {error.strerror}") from error

    def _start(
        self,
        interface: Interface,
        program: Sequence[Instruction],
        blocks: int,
        retire_ms: int,
        *,
        promiscuous: bool,
    ) -> None:
        """Filter, ring, bind: in that order, so that the first packet in the ring is already a wanted one."""
        attach(self._socket, program)
        self._socket.setsockopt(_SOL_PACKET, _PACKET_VERSION, _TPACKET_V3)
        blocks = self._allocate(blocks, retire_ms)
        self._map = mmap.mmap(self._socket.fileno(), blocks * self._block_size)
        self._ring = np.frombuffer(self._map, dtype=np.uint8).reshape(blocks, self._block_size)
        self._headers = self._ring[:, : tpacket.BLOCK_HEADER].view(np.uint32)
        if interface.loopback:
            with contextlib.suppress(OSError):  # before Linux 4.20 the filter alone does it
                self._socket.setsockopt(_SOL_PACKET, _PACKET_IGNORE_OUTGOING, 1)
        elif promiscuous and interface.index:
            member = struct.pack("=iHH8s", interface.index, _PACKET_MR_PROMISC, 0, b"")
            self._socket.setsockopt(_SOL_PACKET, _PACKET_ADD_MEMBERSHIP, member)
        if interface.index:
            self._socket.bind((interface.name, _ETH_P_ALL))
        else:
            self._bind_all()

    def _bind_all(self) -> None:
        """Bind to interface number 0, which is all of them and has no name for the socket module."""
        address = struct.pack("=HHiHBB8x", socket.AF_PACKET, socket.htons(_ETH_P_ALL), 0, 0, 0, 0)
        library = ctypes.CDLL(None, use_errno=True)
        if library.bind(self._socket.fileno(), address, len(address)) != 0:
            code = ctypes.get_errno()
            raise OSError(code, os.strerror(code))

    def _allocate(self, blocks: int, retire_ms: int) -> int:
        """Ask for a ring, for half of it when the kernel has no such memory; return the number of blocks."""
        while True:
            frames = blocks * self._block_size // _FRAME_SIZE
            request = struct.pack("=7I", self._block_size, blocks, _FRAME_SIZE, frames, retire_ms, 0, 0)
            try:
                self._socket.setsockopt(_SOL_PACKET, _PACKET_RX_RING, request)
            except OSError as error:
                if error.errno != errno.ENOMEM or blocks == 1:
                    raise
                blocks //= 2
            else:
                return blocks

    def filenos(self) -> tuple[int, ...]:
        """Return the file descriptors that become readable when a block is there."""
        return (self._socket.fileno(),)

    def read(self) -> FrameBatch | None:
        """Take the blocks that the kernel has handed over, a few MiB at most.

        Returns:
            Their frames; None when no block is there.
        """
        blocks: list[tuple[int, int]] = []
        taken = 0
        first = self._next
        while len(blocks) < len(self._ring):
            status, _, _, length = (int(value) for value in self._headers[self._next, 2:6])
            if not status & _STATUS_USER or (blocks and taken + length > _AT_ONCE):
                break
            blocks.append((taken, length))
            taken += -(-length // tpacket.ALIGNMENT) * tpacket.ALIGNMENT
            self._next = (self._next + 1) % len(self._ring)
        if not blocks:
            return None
        data = np.empty(taken + PADDING, dtype=np.uint8)
        data[taken:] = 0
        for place, (start, length) in enumerate(blocks, first):
            block = place % len(self._ring)
            data[start : start + length] = self._ring[block, :length]
            self._headers[block, 2] = _STATUS_KERNEL
        frames = tpacket.frames(data, blocks, self._link_type, self._read + 1)
        self._read += len(frames)
        return frames

    def count(self) -> None:
        """Ask the kernel for its counters, which it then sets to zero."""
        packets, drops, _ = struct.unpack("=3I", self._socket.getsockopt(_SOL_PACKET, _PACKET_STATISTICS, 12))
        self._delivered += packets - drops
        self.drops += drops

    def refuse(self) -> None:
        """Let no further packet in; what is in the ring stays."""
        attach(self._socket, NOTHING)

    def drained(self) -> bool:
        """Tell whether all that the kernel put into the ring has been read."""
        self.count()
        return self._read >= self._delivered

    def failure(self) -> str | None:
        """Return why no packet will come any more, None while all is well."""
        error = self._socket.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
        if error == 0:
            return None
        name = self.info.name
        if error == errno.ENETDOWN:
            return f"{name} went down; what came before is kept. Capture again when it is up"
        return f"{name}: {os.strerror(error)}"

    def close(self) -> None:
        """Give socket and memory back."""
        self._socket.close()
        del self._headers, self._ring
        self._map.close()


def _open(interface: str, *, cooked: bool) -> socket.socket:
    """Open a packet socket that receives nothing until it is bound."""
    try:
        return socket.socket(socket.AF_PACKET, socket.SOCK_DGRAM if cooked else socket.SOCK_RAW, 0)
    except PermissionError:
        raise denied(interface) from None
