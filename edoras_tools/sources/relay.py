"""What a relay moves datagrams with: many in one system call, and out again from where they lie.

An :class:`Arena` holds a room for each of a few hundred datagrams. ``receive`` fills rooms from a socket,
``send`` sends rooms through another: on Linux with ``recvmmsg`` and ``sendmmsg`` over headers that were made
once, so that Python's cost is one of system calls, not of datagrams or bytes. Elsewhere plain sockets do the
same, one at a time.
"""

from __future__ import annotations

import ctypes
import errno
import os
import socket
import time
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Protocol

import numpy as np

from edoras_tools.errors import CaptureError
from edoras_tools.sources.sockaddr import PACKED_BYTES, address_of, resolve
from edoras_tools.sources.udp import LINUX, bind_reason

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.model import Endpoint
    from edoras_tools.sources.sockaddr import Address

ROOMS: Final = 256
"""Datagrams that one ``receive`` takes at most."""
SPARE: Final = 256
"""Rooms for datagrams that were made on the way."""
LARGEST: Final = 65507
"""Bytes that UDP carries over IPv4; over IPv6 it is 20 more."""
_STRIDE: Final = 65536 + 64
"""From room to room: not a power of two, which would put all rooms into the same lines of the caches."""
_SO_RCVBUFFORCE: Final = 33
_SO_SNDBUFFORCE: Final = 32
_SO_TIMESTAMPNS: Final = 35
_BUFFER: Final = 32 << 20

_VECTOR: Final = np.dtype([("base", "u8"), ("length", "u8")])
_CONTROL: Final = np.dtype([("size", "u8"), ("level", "i4"), ("kind", "i4"), ("seconds", "i8"), ("ns", "i8")])
"""``struct cmsghdr`` and the ``struct timespec`` of a receive time."""
_HEADER: Final = np.dtype(
    {
        "names": ["name", "name_length", "vectors", "count", "control", "control_length", "length"],
        "formats": ["u8", "u4", "u8", "u8", "u8", "u8", "u4"],
        "offsets": [0, 8, 16, 24, 32, 40, 56],
        "itemsize": 64,
    }
)
"""``struct mmsghdr`` of 64-bit Linux."""


class Sent(NamedTuple):
    """What became of datagrams.

    Attributes:
        done: how many are dealt with, from the first on: sent, refused or failed.
        refused: answers that nobody listens (ICMP port unreachable); each tells of an earlier datagram.
        failed: how many the system would not send.
        reason: why, of the last.
        full: the socket takes no more now.
    """

    done: int
    refused: int = 0
    failed: int = 0
    reason: str = ""
    full: bool = False


class Arena(Protocol):
    """Rooms for datagrams.

    Attributes:
        rooms: u8 (``ROOMS + SPARE``, stride).
        length: u32, bytes in each room; of the first ``ROOMS`` what ``receive`` found.
    """

    rooms: NDArray[np.uint8]
    length: NDArray[np.uint32]

    def receive(self, opened: socket.socket) -> int:
        """Fill rooms from 0 on with what has arrived; never wait.

        Returns:
            how many; -1 where there was news of a refusal instead (ICMP port unreachable).
        """

    def senders(self, count: int) -> NDArray[np.uint64]:
        """Return the socket addresses that the last ``receive`` saw, u64 (count, 4)."""

    def times(self, count: int) -> NDArray[np.int64]:
        """Return when the kernel received them, ns since 1970."""

    def send(
        self, opened: socket.socket, rows: int | NDArray[np.int64], to: Address | None, first: int = 0
    ) -> Sent:
        """Send rooms in order; never wait.

        Args:
            opened: through which socket.
            rows: so many from room 0 on, or these.
            to: where; None through a connected socket.
            first: how many to leave out.
        """


def make_arena() -> Arena:
    """Return the fastest that this system has."""
    if LINUX and ctypes.sizeof(ctypes.c_void_p) == 8:
        with suppress(AttributeError, OSError):
            return VectorArena()
    return PlainArena()


def payload_of(arena: Arena, row: int) -> bytes:
    """Return a copy of what is in a room."""
    return arena.rooms[row, : int(arena.length[row])].tobytes()


def stage(arena: Arena, row: int, payload: bytes) -> None:
    """Put a datagram into a room."""
    arena.rooms[row, : len(payload)] = np.frombuffer(payload, np.uint8)
    arena.length[row] = len(payload)


class VectorArena:
    """Rooms that ``recvmmsg`` and ``sendmmsg`` work on (64-bit Linux).

    Attributes:
        rooms: see ``Arena``.
        length: see ``Arena``.

    Raises:
        AttributeError: the C library lacks the calls.
    """

    def __init__(self) -> None:
        # Calls that never wait keep the interpreter's lock: giving it up costs more than they take.
        library = ctypes.PyDLL(None, use_errno=True)
        self._recvmmsg, self._sendmmsg = library.recvmmsg, library.sendmmsg
        total = ROOMS + SPARE
        self.rooms = np.zeros((total, _STRIDE), np.uint8)
        self._base = self.rooms.ctypes.data + np.arange(total, dtype=np.uint64) * np.uint64(_STRIDE)
        self.length = np.zeros(total, np.uint32)
        self._names = np.zeros((ROOMS, PACKED_BYTES // 8), np.uint64)
        self._control = np.zeros(ROOMS, _CONTROL)
        self._vectors = np.zeros(ROOMS, _VECTOR)
        self._vectors["base"], self._vectors["length"] = self._base[:ROOMS], _STRIDE
        self._headers = _headers(ROOMS, self._vectors)
        self._headers["name"] = self._names.ctypes.data + np.arange(ROOMS) * PACKED_BYTES
        self._headers["control"] = self._control.ctypes.data + np.arange(ROOMS) * _CONTROL.itemsize
        self._name_length, self._control_length = (
            self._headers["name_length"],
            self._headers["control_length"],
        )
        self._name_length[:], self._control_length[:] = PACKED_BYTES, _CONTROL.itemsize
        self._found = self._headers["length"]
        self._at = ctypes.c_void_p(self._headers.ctypes.data)
        self._used = 0
        self._outgoing = _Outgoing(total)

    def receive(self, opened: socket.socket) -> int:
        """See ``Arena``."""
        used = self._used
        if used:
            self._name_length[:used], self._control_length[:used] = PACKED_BYTES, _CONTROL.itemsize
            self._used = 0
        count = self._recvmmsg(opened.fileno(), self._at, ROOMS, socket.MSG_DONTWAIT, None)
        if count > 0:
            self._used = count
            self.length[:count] = self._found[:count]
            return int(count)
        number = ctypes.get_errno()
        if number == errno.ECONNREFUSED:
            return -1
        if number not in {errno.EAGAIN, errno.EINTR}:
            raise CaptureError(f"the socket cannot be read: {os.strerror(number)}")
        return 0

    def senders(self, count: int) -> NDArray[np.uint64]:
        """See ``Arena``."""
        return self._names[:count]

    def times(self, count: int) -> NDArray[np.int64]:
        """See ``Arena``."""
        control = self._control[:count]
        times: NDArray[np.int64] = control["seconds"] * 1_000_000_000 + control["ns"]
        return times

    def send(
        self, opened: socket.socket, rows: int | NDArray[np.int64], to: Address | None, first: int = 0
    ) -> Sent:
        """See ``Arena``."""
        if isinstance(rows, int):
            total = rows
            where, length = self._base[first:rows], self.length[first:rows]
        else:
            total = len(rows)
            where, length = self._base[rows[first:]], self.length[rows[first:]]
        outgoing = self._outgoing
        outgoing.fill(where, length, to)
        fileno, done, end = opened.fileno(), 0, total - first
        refused = failed = 0
        reason = ""
        while done < end:
            count = self._sendmmsg(fileno, outgoing.at(done), end - done, socket.MSG_DONTWAIT)
            if count > 0:
                done += count
                continue
            number = ctypes.get_errno()
            if number == errno.ECONNREFUSED and refused < 2 * end:
                refused += 1
            elif number in {errno.EAGAIN, errno.ENOBUFS}:
                return Sent(done, refused, failed, reason, full=True)
            elif number != errno.EINTR:
                done, failed, reason = done + 1, failed + 1, os.strerror(number)
        return Sent(done, refused, failed, reason)


class _Outgoing:
    """The argument of ``sendmmsg``."""

    def __init__(self, total: int) -> None:
        self._vectors = np.zeros(total, _VECTOR)
        self._headers = _headers(total, self._vectors)
        self._where, self._length = self._vectors["base"], self._vectors["length"]
        self._name = np.zeros(PACKED_BYTES, np.uint8)
        self._first = self._headers.ctypes.data
        self._start = ctypes.c_void_p(self._first)
        self._to: Address | None = None

    def fill(self, where: NDArray[np.uint64], length: NDArray[np.uint32], to: Address | None) -> None:
        """Say what to send, and where."""
        count = len(where)
        self._where[:count] = where
        self._length[:count] = length
        if to is not self._to:
            self._to = to
            self._headers["name"] = 0 if to is None else self._name.ctypes.data
            self._headers["name_length"] = 0 if to is None else to.length
            if to is not None:
                self._name[:] = np.frombuffer(to.packed, np.uint8)

    def at(self, index: int) -> ctypes.c_void_p:
        """Return the address of a header."""
        return ctypes.c_void_p(self._first + index * _HEADER.itemsize) if index else self._start


def _headers(count: int, vectors: NDArray[Any]) -> NDArray[Any]:
    """Return headers of one vector each."""
    headers = np.zeros(count, _HEADER)
    headers["vectors"] = vectors.ctypes.data + np.arange(count) * _VECTOR.itemsize
    headers["count"] = 1
    return headers


class PlainArena:
    """Rooms that plain sockets work on, one datagram a call: everywhere.

    Attributes:
        rooms: see ``Arena``.
        length: see ``Arena``.
    """

    def __init__(self) -> None:
        self.rooms = np.zeros((ROOMS + SPARE, _STRIDE), np.uint8)
        self.length = np.zeros(ROOMS + SPARE, np.uint32)
        self._names = np.zeros((ROOMS, PACKED_BYTES // 8), np.uint64)
        self._times = np.zeros(ROOMS, np.int64)
        self._packed: dict[tuple[Any, ...], NDArray[np.uint64]] = {}

    def receive(self, opened: socket.socket) -> int:
        """See ``Arena``."""
        for row in range(ROOMS):
            try:
                count, host = opened.recvfrom_into(self.rooms[row].data)
            except (BlockingIOError, InterruptedError):
                return row
            except ConnectionRefusedError:
                return row or -1
            except OSError as error:
                raise CaptureError(f"the socket cannot be read: {error.strerror or error}") from error
            self._times[row] = time.time_ns()
            self.length[row] = count
            if host not in self._packed:
                self._packed[host] = np.frombuffer(address_of(opened.family, host).packed, np.uint64)
            self._names[row] = self._packed[host]
        return ROOMS

    def senders(self, count: int) -> NDArray[np.uint64]:
        """See ``Arena``."""
        return self._names[:count]

    def times(self, count: int) -> NDArray[np.int64]:
        """See ``Arena``."""
        return self._times[:count].copy()

    def send(
        self, opened: socket.socket, rows: int | NDArray[np.int64], to: Address | None, first: int = 0
    ) -> Sent:
        """See ``Arena``."""
        chosen = range(first, rows) if isinstance(rows, int) else rows[first:].tolist()
        done = refused = failed = 0
        reason = ""
        for row in chosen:
            sent = send_one(opened, self.rooms[row, : int(self.length[row])].data, to)
            refused, failed = refused + sent.refused, failed + sent.failed
            reason = sent.reason or reason
            if sent.full:
                return Sent(done, refused, failed, reason, full=True)
            done += 1
        return Sent(done, refused, failed, reason)


def send_one(opened: socket.socket, payload: bytes | memoryview, to: Address | None) -> Sent:
    """Send one datagram; never wait."""
    refused = 0
    while True:
        try:
            if to is None:
                opened.send(payload)
            else:
                opened.sendto(payload, to.host)
        except (BlockingIOError, InterruptedError):
            return Sent(0, refused, full=True)
        except ConnectionRefusedError:  # of an earlier one: this one was not sent
            refused += 1
            if refused > 2:
                return Sent(1, refused)
        except OSError as error:
            if error.errno == errno.ENOBUFS:
                return Sent(0, refused, full=True)
            return Sent(1, refused, 1, error.strerror or str(error))
        else:
            return Sent(1, refused)


def open_port(endpoint: Endpoint) -> socket.socket:
    """Bind a port with large buffers and receive times.

    Raises:
        CaptureError: it cannot be bound.
    """
    family, address = resolve(endpoint, "--listen")
    opened = open_socket(family)
    try:
        opened.bind(address.host)
    except OSError as error:
        opened.close()
        raise CaptureError(f"--listen {endpoint}: {bind_reason(error, endpoint.port)}") from error
    return opened


def open_socket(family: int) -> socket.socket:
    """Open a UDP socket with large buffers and receive times."""
    opened = socket.socket(family, socket.SOCK_DGRAM)
    opened.setblocking(False)
    for option, forced in ((socket.SO_RCVBUF, _SO_RCVBUFFORCE), (socket.SO_SNDBUF, _SO_SNDBUFFORCE)):
        with suppress(OSError):
            opened.setsockopt(socket.SOL_SOCKET, option, _BUFFER)
        if LINUX:
            with suppress(OSError):
                opened.setsockopt(socket.SOL_SOCKET, forced, _BUFFER)
    if LINUX:
        opened.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
    return opened
