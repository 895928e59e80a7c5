"""A UDP socket that sends: one datagram on its deadline, or thousands with few system calls."""

from __future__ import annotations

import contextlib
import ctypes
import errno
import os
import socket
import sys
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, Self

import numpy as np

from edoras_tools.errors import CaptureError
from edoras_tools.model import Endpoint

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

_LARGEST: Final = 65536
_MANY: Final = 512
"""Datagrams handed to the kernel at once."""
_PATIENCE: Final = 8
"""Refusals in a row of one and the same datagram; each tells of an earlier one."""
_SEND_BUFFER: Final = 4 << 20
_IOVEC: Final = np.dtype([("base", "u8"), ("length", "u8")])
_HEADER: Final = np.dtype(
    {
        "names": ["vectors", "count"],
        "formats": ["u8", "u8"],
        "offsets": [16, 24],
        "itemsize": 64,
    }
)
"""``struct mmsghdr`` of 64-bit Linux: of a connected socket only ``msg_iov`` and ``msg_iovlen`` are set."""


@dataclass(slots=True)
class SendStatistics:
    """What became of datagrams.

    Attributes:
        sent: taken by the kernel.
        refused: answers that nobody listens there (ICMP port unreachable).
        errors: why the kernel did not take others, and how many.
    """

    sent: int = 0
    refused: int = 0
    errors: dict[str, int] = field(default_factory=dict)

    @property
    def failed(self) -> int:
        """Datagrams that surely did not arrive."""
        return self.refused + sum(self.errors.values())


class Transmitter:
    """A connected socket, so that the kernel tells of refusals.

    Args:
        target: where everything goes.
        bind: address and port to send from, and to be answered at; any by default.

    Attributes:
        target: as resolved.
        local: what it is bound to.
        statistics: counted as it goes.

    Raises:
        CaptureError: the target is not known or cannot be reached, or the port is in use.
    """

    def __init__(self, target: Endpoint, bind: Endpoint | None = None) -> None:
        self.statistics = SendStatistics()
        with _told(target, "cannot be sent to"):
            found = socket.getaddrinfo(target.address, target.port, type=socket.SOCK_DGRAM)[0]
        family, address = found[0], found[4]
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        try:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)
            if bind is not None:
                with _told(bind, "cannot be bound"):
                    self._socket.bind((bind.address, bind.port))
            with _told(target, "cannot be sent to"):
                self._socket.connect(address)
        except BaseException:
            self._socket.close()
            raise
        self.target = Endpoint(str(address[0]), int(address[1]))
        self.local = Endpoint(*self._socket.getsockname()[:2])
        self._vectors = _Vectors(self._socket.fileno()) if _Vectors.usable else None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def fileno(self) -> int:
        """Return the descriptor, which becomes readable when an answer comes."""
        return self._socket.fileno()

    def send(self, payload: bytes | memoryview) -> bool:
        """Send one datagram; tell whether the kernel took it."""
        for _ in range(_PATIENCE):
            try:
                self._socket.send(payload)
            except ConnectionRefusedError:
                self.statistics.refused += 1
            except OSError as error:
                self._note(error.errno or 0)
                return False
            else:
                self.statistics.sent += 1
                return True
        return False

    def send_many(self, data: NDArray[np.uint8], offset: NDArray[np.int64], length: NDArray[np.int32]) -> int:
        """Send datagrams in order, as fast as it goes; return how many the kernel took.

        Args:
            data: u8, the buffer that holds them.
            offset: i64 (n,), where each starts.
            length: i32 (n,), its bytes.
        """
        if self._vectors is None:
            view = data.data
            ends = (offset + length).tolist()
            return sum(self.send(view[a:b]) for a, b in zip(offset.tolist(), ends, strict=True))
        taken = at = stuck = 0
        while at < len(offset):
            part = slice(at, at + _MANY)
            count, failure = self._vectors.send(data, offset[part], length[part])
            taken += count
            at += count
            stuck = 0 if count else stuck + 1
            if failure == errno.ECONNREFUSED and stuck < _PATIENCE:
                self.statistics.refused += 1
            elif failure:
                self._note(failure)
                at, stuck = at + 1, 0
        self.statistics.sent += taken
        return taken

    def receive(self, most: int = 256) -> list[tuple[bytes, Endpoint]]:
        """Return the datagrams that the target has answered, ``most`` at most, and where they come from."""
        found: list[tuple[bytes, Endpoint]] = []
        while len(found) < most:
            try:
                found.append((self._socket.recv(_LARGEST, socket.MSG_DONTWAIT), self.target))
            except BlockingIOError:
                break
            except ConnectionRefusedError:
                self.statistics.refused += 1
            except OSError as error:
                self._note(error.errno or 0)
                break
        return found

    def _note(self, number: int) -> None:
        reason = os.strerror(number)
        self.statistics.errors[reason] = self.statistics.errors.get(reason, 0) + 1

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class _Vectors:
    """The argument of ``sendmmsg``, made once and filled for each call."""

    usable = (
        sys.platform.startswith("linux")
        and ctypes.sizeof(ctypes.c_void_p) == ctypes.sizeof(ctypes.c_long) == 8
    )

    def __init__(self, fileno: int) -> None:
        self._call = ctypes.CDLL(None, use_errno=True).sendmmsg
        self._fileno = fileno
        self._vectors = np.zeros(_MANY, _IOVEC)
        self._headers = np.zeros(_MANY, _HEADER)
        self._headers["vectors"] = self._vectors.ctypes.data + np.arange(_MANY) * _IOVEC.itemsize
        self._headers["count"] = 1
        self._argument = ctypes.c_void_p(self._headers.ctypes.data)

    def send(
        self, data: NDArray[np.uint8], offset: NDArray[np.int64], length: NDArray[np.int32]
    ) -> tuple[int, int]:
        """Return how many the kernel took, and the error number of the next where it took none."""
        count = len(offset)
        self._vectors["base"][:count] = offset + data.ctypes.data
        self._vectors["length"][:count] = length
        while (taken := self._call(self._fileno, self._argument, count, 0)) < 0:
            number = ctypes.get_errno()
            if number != errno.EINTR:
                return 0, number
        return taken, 0


@contextlib.contextmanager
def _told(endpoint: Endpoint, what: str) -> Iterator[None]:
    """Turn what the system says of an endpoint into one clear line."""
    if not 0 <= endpoint.port <= 0xFFFF:  # getaddrinfo takes some numbers beyond modulo 65536
        raise CaptureError(f"UDP {endpoint} {what}: {endpoint.port} is no UDP port: 0 to 65535")
    try:
        yield
    except (OSError, UnicodeError) as error:
        number = getattr(error, "errno", None)
        if isinstance(error, socket.gaierror | UnicodeError):
            why = f"{endpoint.address!r} is neither an address nor a host that is known"
        elif number == errno.EADDRINUSE:
            why = "another program has that port (a bridge?); stop it, or choose another with --listen"
        elif number == errno.EADDRNOTAVAIL:
            why = "not an address of this machine"
        elif number in {errno.ENETUNREACH, errno.EHOSTUNREACH}:
            why = "there is no route to it"
        else:
            why = getattr(error, "strerror", None) or str(error)
        raise CaptureError(f"UDP {endpoint} {what}: {why}") from None


class Listener:
    """A bound socket that only listens.

    Args:
        endpoint: where; port 0 lets the system choose.

    Attributes:
        local: what it is bound to.

    Raises:
        CaptureError: it cannot be bound.
    """

    def __init__(self, endpoint: Endpoint) -> None:
        with _told(endpoint, "cannot be bound"):
            found = socket.getaddrinfo(endpoint.address, endpoint.port, type=socket.SOCK_DGRAM)[0]
        self._socket = socket.socket(found[0], socket.SOCK_DGRAM)
        try:
            with _told(endpoint, "cannot be bound"):
                self._socket.bind(found[4])
        except BaseException:
            self._socket.close()
            raise
        self.local = Endpoint(*self._socket.getsockname()[:2])

    def fileno(self) -> int:
        """Return the descriptor, which becomes readable when something comes."""
        return self._socket.fileno()

    def receive(self, most: int = 256) -> list[tuple[bytes, Endpoint]]:
        """Return the datagrams that have arrived, ``most`` at most, and where they come from."""
        found: list[tuple[bytes, Endpoint]] = []
        with contextlib.suppress(OSError):
            while len(found) < most:
                data, sender = self._socket.recvfrom(_LARGEST, socket.MSG_DONTWAIT)
                found.append((data, Endpoint(*sender[:2])))
        return found

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()
