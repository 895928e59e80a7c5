"""Many datagrams at a time: received into the slots of a buffer, and sent from these slots without a copy.

Rules of a buffer:

1. ``receive`` fills the first ``SLOTS`` slots from 0 on. The ``SPARE`` slots after them are for datagrams
   made by the caller; ``receive`` does not touch them.
2. The results of ``receive`` (slots, lengths, senders, times) are valid until the next ``receive``.
3. Nothing blocks: for an empty socket the count is 0, for a full one ``SendResult.full`` is set.

On Linux the cost in Python is per system call, not per datagram or byte. Other systems use plain sockets,
one datagram per call.
"""

from __future__ import annotations

import socket
import struct
import time
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from edoras_tools.errors import CaptureError
from edoras_tools.io.net.address import PACKED_BYTES, Address, address_of
from edoras_tools.io.net.mmsg import ReceiveMany, SendMany, usable
from edoras_tools.io.net.sockets import IP_PKTINFO, IPV6_PKTINFO, SO_TIMESTAMPNS, SendResult, send_one

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.wire.arrays.order import Integers, Octets


SLOTS: Final = 256
"""Maximum number of datagrams in one ``receive``."""
SPARE: Final = 256
"""Slots for datagrams made by the caller."""
_STRIDE: Final = 65536 + 64
"""Bytes from slot to slot; not a power of two, which would map all slots to the same cache lines."""
_ANCILLARY: Final = 128
"""Bytes for a receive time and a destination address."""


def make_buffer() -> DatagramBuffer:
    """Return the fastest buffer that this system supports."""
    return VectorBuffer() if usable() else DatagramBuffer()


class DatagramBuffer:
    """Slots for a few hundred datagrams, with plain sockets: one datagram per system call.

    Attributes:
        slots: bytes of the slots, u8 (``SLOTS + SPARE``, stride).
        length: bytes in each slot, u32.
        starts: start of each slot in the flat ``slots``, i64.
    """

    def __init__(self) -> None:
        self.slots = np.zeros((SLOTS + SPARE, _STRIDE), np.uint8)
        self.slots[:SLOTS, 0] = 0  # now, not at the first datagram: allocating the pages takes 20 to 40 ms
        self.length = np.zeros(SLOTS + SPARE, np.uint32)
        self.starts = np.arange(SLOTS + SPARE) * _STRIDE
        self._names = np.zeros((SLOTS, PACKED_BYTES // 8), np.uint64)
        self._times = np.zeros(SLOTS, np.int64)
        self._destinations = np.zeros((SLOTS, 16), np.uint8)
        self._packed: dict[tuple[Any, ...], NDArray[np.uint64]] = {}

    def payload(self, slot: int) -> bytes:
        """Return a copy of the datagram in a slot."""
        return self.slots[slot, : int(self.length[slot])].tobytes()

    def put(self, slot: int, payload: bytes) -> None:
        """Put a datagram into a slot."""
        self.slots[slot, : len(payload)] = np.frombuffer(payload, np.uint8)
        self.length[slot] = len(payload)

    def receive(self, opened: socket.socket) -> int:
        """Fill slots from 0 on with the datagrams that have arrived.

        Returns:
            The number of datagrams; -1 if there is a refusal (ICMP port unreachable) instead.

        Raises:
            CaptureError: the socket cannot be read.
        """
        own = address_of(opened.family, opened.getsockname()).ip
        for slot in range(SLOTS):
            try:
                count, ancillary, _, host = opened.recvmsg_into([self.slots[slot].data], _ANCILLARY)
            except (BlockingIOError, InterruptedError):
                return slot
            except ConnectionRefusedError:
                return slot or -1
            except OSError as error:
                raise CaptureError(f"the socket cannot be read: {error.strerror or error}") from error
            self.length[slot] = count
            self._names[slot] = self._pack(opened.family, host)
            self._times[slot], destination = _read_ancillary(ancillary)
            destination = destination or own
            self._destinations[slot, : len(destination)] = list(destination)
        return SLOTS

    def senders(self, count: int) -> NDArray[np.uint64]:
        """Return the socket addresses that the last ``receive`` saw, u64 (count, 4)."""
        return self._names[:count]

    def times(self, count: int) -> Integers:
        """Return when the kernel received the datagrams of the last ``receive``, i64, ns since 1970."""
        return self._times[:count].copy()

    def destinations(self, count: int, version: int) -> Octets:
        """Return the destination addresses of the datagrams of the last ``receive``, u8 (count, 4 or 16).

        Only for sockets that were opened with ``destinations``.
        """
        return self._destinations[:count, : 4 if version == 4 else 16]

    def send(self, opened: socket.socket, slots: int | Integers, to: Address | None) -> SendResult:
        """Send slots in order.

        Args:
            slots: the number of slots from 0 on, or slot numbers.
            to: the receiver; None for a connected socket.
        """
        accepted = refused = 0
        errors: dict[str, int] = {}
        for slot in range(slots) if isinstance(slots, int) else slots.tolist():
            sent = send_one(opened, self.slots[slot, : int(self.length[slot])].data, to)
            refused += sent.refused
            for reason in sent.errors:
                errors[reason] = errors.get(reason, 0) + 1
            if sent.full:
                return SendResult(accepted, refused, errors, full=True)
            accepted += 1
        return SendResult(accepted, refused, errors)

    def _pack(self, family: int, host: tuple[Any, ...]) -> NDArray[np.uint64]:
        if host not in self._packed:
            self._packed[host] = np.frombuffer(address_of(family, host).packed, np.uint64)
        return self._packed[host]


class VectorBuffer(DatagramBuffer):
    """``DatagramBuffer`` with ``recvmmsg`` and ``sendmmsg``, for systems where they are ``usable``."""

    def __init__(self) -> None:
        super().__init__()
        total = SLOTS + SPARE
        self._base = self.slots.ctypes.data + np.arange(total, dtype=np.uint64) * np.uint64(_STRIDE)
        self._incoming = ReceiveMany(self._base[:SLOTS], _STRIDE)
        self._outgoing = SendMany(total)

    def receive(self, opened: socket.socket) -> int:
        """See ``DatagramBuffer``."""
        count = self._incoming.receive(opened)
        if count > 0:
            self.length[:count] = self._incoming.length[:count]
        return count

    def senders(self, count: int) -> NDArray[np.uint64]:
        """See ``DatagramBuffer``."""
        return self._incoming.senders(count)

    def times(self, count: int) -> Integers:
        """See ``DatagramBuffer``."""
        return self._incoming.times(count)

    def destinations(self, count: int, version: int) -> Octets:
        """See ``DatagramBuffer``."""
        return self._incoming.destinations(count, version)

    def send(self, opened: socket.socket, slots: int | Integers, to: Address | None) -> SendResult:
        """See ``DatagramBuffer``."""
        selection = slice(0, slots) if isinstance(slots, int) else slots
        return self._outgoing.send(opened, self._base[selection], self.length[selection], to)


def _read_ancillary(ancillary: list[tuple[int, int, bytes]]) -> tuple[int, bytes]:
    """Return a datagram's receive time in ns and its destination address, empty if the system gave none."""
    time_ns, destination = 0, b""
    for level, kind, value in ancillary:
        if level == socket.SOL_SOCKET and kind == SO_TIMESTAMPNS:
            seconds, rest = struct.unpack("@ll", value)
            time_ns = seconds * 1_000_000_000 + rest
        elif level == socket.IPPROTO_IP and kind == IP_PKTINFO:
            destination = value[8:12]
        elif level == socket.IPPROTO_IPV6 and kind == IPV6_PKTINFO:
            destination = value[:16]
    return time_ns or time.time_ns(), destination
