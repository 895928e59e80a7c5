"""``recvmmsg`` and ``sendmmsg``: many datagrams in one system call, on 64-bit Linux; used only here.

Rules of this file:

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
"""

from __future__ import annotations

import ctypes
import errno
import os
import socket
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from edoras_tools.errors import CaptureError
from edoras_tools.io.net.address import PACKED_BYTES, Address
from edoras_tools.io.net.sockets import LINUX, MOST_REFUSALS, SendResult

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.wire.arrays.order import Integers, Octets


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
    return LINUX and _POINTERS_OF_64_BITS and hasattr(ctypes.CDLL(None), "recvmmsg")


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
        self._names = np.zeros((len(base), PACKED_BYTES // 8), np.uint64)
        self._control = np.zeros(len(base), _CONTROL)
        self._vectors = np.zeros(len(base), _VECTOR)
        self._vectors["base"], self._vectors["length"] = base, size
        self._headers = _headers(self._vectors)
        self._headers["name"] = self._names.ctypes.data + np.arange(len(base)) * PACKED_BYTES
        self._headers["control"] = self._control.ctypes.data + np.arange(len(base)) * _CONTROL.itemsize
        self._name_length, self._control_length = (
            self._headers["name_length"],
            self._headers["control_length"],
        )
        self._name_length[:], self._control_length[:] = PACKED_BYTES, _CONTROL.itemsize
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
            self._name_length[:used], self._control_length[:used] = PACKED_BYTES, _CONTROL.itemsize
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
        self._name = np.zeros(PACKED_BYTES, np.uint8)
        self._first = self._headers.ctypes.data
        self._start = ctypes.c_void_p(self._first)
        self._to: Address | None = None

    def send(
        self,
        opened: socket.socket,
        base: NDArray[np.uint64],
        length: NDArray[np.integer[Any]],
        to: Address | None = None,
    ) -> SendResult:
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
            if number == errno.ECONNREFUSED and again < MOST_REFUSALS:
                refused, again = refused + 1, again + 1
            elif number in {errno.EAGAIN, errno.ENOBUFS}:
                return SendResult(sent, refused, errors, full=True)
            elif number != errno.EINTR:
                reason = os.strerror(number)
                errors[reason] = errors.get(reason, 0) + 1
                sent, again = sent + 1, 0
        return SendResult(sent, refused, errors)

    def _address(self, to: Address | None) -> None:
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
