"""Many datagrams at a time: received into the slots of a buffer, and sent from these slots without a copy.

Rules of a buffer:

1. ``receive`` fills the first ``SLOTS`` slots from 0 on. The ``SPARE`` slots after them are for datagrams
   made by the caller; ``receive`` does not touch them.
2. The results of ``receive`` (slots, lengths, senders, times) are valid until the next ``receive``.
3. Nothing blocks: for an empty socket the count is 0, for a full one ``SendResult.full`` is set.

On Linux the cost in Python is per system call, not per datagram or byte. Other systems use plain sockets, one
datagram per call.

``ReceiveMany`` and ``SendMany`` are ``recvmmsg`` and ``sendmmsg``: many datagrams in one system call, on
64-bit Linux. Their rules:

1. The headers (``struct mmsghdr``) and their vectors are made once. A call writes only what changes: the
   address of each datagram, its length, and its receiver.
2. Everything that a header points to is an array of the same object, or is in the caller's buffer, which
   must live until the call returns.
3. The lengths that the kernel writes into a header (of names and of control data) are reset before the next
   call.
4. A call that never blocks keeps the interpreter's lock: releasing it would take longer than the call. A
   call that may block releases it.
5. A refusal (ICMP port unreachable) answers an earlier datagram. The datagram at which it is reported was not
   sent, so it is sent again, up to ``MOST_REFUSALS`` times, because each try may report another refusal.

``UdpSource`` reads from plain UDP sockets: no privilege is needed, and this machine is the receiver.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import os
import socket
import struct
import time
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from edoras_tools.errors import CaptureError, OnFailure
from edoras_tools.io.capture.device import Device, DeviceSource
from edoras_tools.io.frames.frame_batch import ENDS, FrameBatch, FramePage
from edoras_tools.io.net import sockets
from edoras_tools.io.net.sockets import LINUX, kernel_drops, local_endpoint, open_bound, waiting_bytes
from edoras_tools.model import Endpoint, SourceInfo
from edoras_tools.units import SECOND

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.wire.arrays import Integers, Octets

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
        self._names = np.zeros((SLOTS, sockets.PACKED_BYTES // 8), np.uint64)
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
        own = sockets.address_of(opened.family, opened.getsockname()).ip
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

    def send(
        self, opened: socket.socket, slots: int | Integers, to: sockets.Address | None
    ) -> sockets.SendResult:
        """Send slots in order.

        Args:
            slots: the number of slots from 0 on, or slot numbers.
            to: the receiver; None for a connected socket.
        """
        accepted = refused = 0
        errors: dict[str, int] = {}
        for slot in range(slots) if isinstance(slots, int) else slots.tolist():
            sent = sockets.send_one(opened, self.slots[slot, : int(self.length[slot])].data, to)
            refused += sent.refused
            for reason in sent.errors:
                errors[reason] = errors.get(reason, 0) + 1
            if sent.full:
                return sockets.SendResult(accepted, refused, errors, full=True)
            accepted += 1
        return sockets.SendResult(accepted, refused, errors)

    def _pack(self, family: int, host: tuple[Any, ...]) -> NDArray[np.uint64]:
        if host not in self._packed:
            self._packed[host] = np.frombuffer(sockets.address_of(family, host).packed, np.uint64)
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

    def send(
        self, opened: socket.socket, slots: int | Integers, to: sockets.Address | None
    ) -> sockets.SendResult:
        """See ``DatagramBuffer``."""
        selection = slice(0, slots) if isinstance(slots, int) else slots
        return self._outgoing.send(opened, self._base[selection], self.length[selection], to)


def _read_ancillary(ancillary: list[tuple[int, int, bytes]]) -> tuple[int, bytes]:
    """Return a datagram's receive time in ns and its destination address, empty if the system gave none."""
    time_ns, destination = 0, b""
    for level, kind, value in ancillary:
        if level == socket.SOL_SOCKET and kind == sockets.SO_TIMESTAMPNS:
            seconds, rest = struct.unpack("@ll", value)
            time_ns = seconds * 1_000_000_000 + rest
        elif level == socket.IPPROTO_IP and kind == sockets.IP_PKTINFO:
            destination = value[8:12]
        elif level == socket.IPPROTO_IPV6 and kind == sockets.IPV6_PKTINFO:
            destination = value[:16]
    return time_ns or time.time_ns(), destination


_VECTOR: Final = np.dtype([("base", "u8"), ("length", "u8")])
_CONTROL: Final = np.dtype(
    [("time_head", "u8", 2), ("seconds", "i8"), ("ns", "i8"), ("info_head", "u8", 2), ("info", "V24")]
)
"""Two ``struct cmsghdr`` in Linux's order: the receive time (``struct timespec``), and, if requested, the
destination address (``struct in_pktinfo`` or ``in6_pktinfo``)."""
_HEADER: Final = np.dtype(
    {
        "names": ["name", "name_length", "vectors", "count", "control", "control_length", "length"],
        "formats": ["u8", "u4", "u8", "u8", "u8", "u8", "u4"],
        "offsets": [0, 8, 16, 24, 32, 40, 56],
        "itemsize": 64,
    }
)
"""``struct mmsghdr``."""
_POINTERS_OF_64_BITS: Final = ctypes.sizeof(ctypes.c_void_p) == ctypes.sizeof(ctypes.c_long) == 8


def usable() -> bool:
    """Return whether this system and its C library have these calls."""
    return sockets.LINUX and _POINTERS_OF_64_BITS and hasattr(ctypes.CDLL(None), "recvmmsg")


class ReceiveMany:
    """The argument of ``recvmmsg``.

    Args:
        base: memory address of each slot for a datagram, u64.
        size: bytes of each slot.

    Attributes:
        length: bytes of each datagram of the last call, u32.
    """

    def __init__(self, base: NDArray[np.uint64], size: int) -> None:
        self._call = ctypes.PyDLL(None, use_errno=True).recvmmsg
        self._names = np.zeros((len(base), sockets.PACKED_BYTES // 8), np.uint64)
        self._control = np.zeros(len(base), _CONTROL)
        self._vectors = np.zeros(len(base), _VECTOR)
        self._vectors["base"], self._vectors["length"] = base, size
        self._headers = _headers(self._vectors)
        self._headers["name"] = self._names.ctypes.data + np.arange(len(base)) * sockets.PACKED_BYTES
        self._headers["control"] = self._control.ctypes.data + np.arange(len(base)) * _CONTROL.itemsize
        self._name_length = self._headers["name_length"]
        self._control_length = self._headers["control_length"]
        self._name_length[:], self._control_length[:] = sockets.PACKED_BYTES, _CONTROL.itemsize
        self.length = self._headers["length"]
        self._start = ctypes.c_void_p(self._headers.ctypes.data)
        self._used = 0

    def receive(self, opened: socket.socket) -> int:
        """Receive the datagrams that have arrived, without waiting.

        Returns:
            The number of datagrams; -1 if there is a refusal instead.

        Raises:
            CaptureError: the socket cannot be read.
        """
        used = self._used
        if used:
            self._name_length[:used], self._control_length[:used] = sockets.PACKED_BYTES, _CONTROL.itemsize
            self._used = 0
        count: int = self._call(opened.fileno(), self._start, len(self._headers), socket.MSG_DONTWAIT, None)
        if count > 0:
            self._used = count
            return count
        number = ctypes.get_errno()
        if number == errno.ECONNREFUSED:
            return -1
        if number not in {errno.EAGAIN, errno.EINTR}:
            raise CaptureError(f"the socket cannot be read: {os.strerror(number)}")
        return 0

    def senders(self, count: int) -> NDArray[np.uint64]:
        """Return the socket addresses of the senders of the first datagrams, u64 (count, 4)."""
        return self._names[:count]

    def times(self, count: int) -> Integers:
        """Return when the kernel received the first datagrams, i64, ns since 1970."""
        control = self._control[:count]
        return control["seconds"] * 1_000_000_000 + control["ns"]

    def destinations(self, count: int, version: int) -> Octets:
        """Return the addresses that the first datagrams were sent to, u8 (count, 4 or 16)."""
        info = self._control["info"][:count].copy().view(np.uint8).reshape(count, -1)
        return info[:, 8:12] if version == 4 else info[:, :16]


class SendMany:
    """The argument of ``sendmmsg``.

    Args:
        most: maximum number of datagrams per call.
        waits: whether a call waits while the socket is full.
    """

    def __init__(self, most: int, *, waits: bool = False) -> None:
        library = ctypes.CDLL(None, use_errno=True) if waits else ctypes.PyDLL(None, use_errno=True)
        self._call, self._flags = library.sendmmsg, 0 if waits else socket.MSG_DONTWAIT
        self._vectors = np.zeros(most, _VECTOR)
        self._headers = _headers(self._vectors)
        self._base, self._length = self._vectors["base"], self._vectors["length"]
        self._name = np.zeros(sockets.PACKED_BYTES, np.uint8)
        self._first = self._headers.ctypes.data
        self._start = ctypes.c_void_p(self._first)
        self._to: sockets.Address | None = None

    def send(
        self,
        opened: socket.socket,
        base: NDArray[np.uint64],
        length: NDArray[np.integer[Any]],
        to: sockets.Address | None = None,
    ) -> sockets.SendResult:
        """Send datagrams in order.

        Args:
            base: memory address of each datagram, u64.
            length: bytes of each datagram.
            to: the receiver; None for a connected socket.
        """
        end = len(base)
        self._base[:end], self._length[:end] = base, length
        if to is not self._to:
            self._address(to)
        fileno, sent, refused, again = opened.fileno(), 0, 0, 0
        errors: dict[str, int] = {}
        while sent < end:
            start = ctypes.c_void_p(self._first + sent * _HEADER.itemsize) if sent else self._start
            count = self._call(fileno, start, end - sent, self._flags)
            if count > 0:
                sent, again = sent + count, 0
                continue
            number = ctypes.get_errno()
            if number == errno.ECONNREFUSED and again < sockets.MOST_REFUSALS:
                refused, again = refused + 1, again + 1
            elif number in {errno.EAGAIN, errno.ENOBUFS}:
                return sockets.SendResult(sent, refused, errors, full=True)
            elif number != errno.EINTR:
                reason = os.strerror(number)
                errors[reason] = errors.get(reason, 0) + 1
                sent, again = sent + 1, 0
        return sockets.SendResult(sent, refused, errors)

    def _address(self, to: sockets.Address | None) -> None:
        self._to = to
        self._headers["name"] = 0 if to is None else self._name.ctypes.data
        self._headers["name_length"] = 0 if to is None else to.length
        if to is not None:
            self._name[:] = np.frombuffer(to.packed, np.uint8)


def _headers(vectors: NDArray[Any]) -> NDArray[Any]:
    """Return one header per vector."""
    headers = np.zeros(len(vectors), _HEADER)
    headers["vectors"] = vectors.ctypes.data + np.arange(len(vectors)) * _VECTOR.itemsize
    headers["count"] = 1
    return headers


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
            start, length = buffer.starts[:count], buffer.length[:count]
            page.add(buffer.slots.reshape(-1), start, length, buffer.times(count), ends)
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
