"""Datagrams from plain UDP sockets: no privilege needed, and this machine is the receiver."""

from __future__ import annotations

import contextlib
import errno
import socket
import struct
import sys
import time
from bisect import bisect_right
from collections import defaultdict
from dataclasses import dataclass
from operator import attrgetter
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from edoras_tools.errors import CaptureError, ConfigError
from edoras_tools.model import Endpoint, SourceInfo
from edoras_tools.sources.bpf import RAW
from edoras_tools.sources.device import DeviceSource
from edoras_tools.sources.framing import PADDING
from edoras_tools.sources.linklayer import FrameBatch
from edoras_tools.sources.rawip import ROOM, write_headers

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from numpy.typing import NDArray

_SO_RCVBUFFORCE: Final = 33
_SO_TIMESTAMPNS: Final = 35
_SO_MEMINFO: Final = 55
_MEMINFO_DROPS: Final = 8  # SK_MEMINFO_DROPS
_IP_PKTINFO: Final = 8
_IPV6_PKTINFO: Final = 50
_IPV6_RECVPKTINFO: Final = 49
LINUX: Final = sys.platform.startswith("linux")

_LARGEST: Final = 65536
"""Bytes that hold any UDP payload."""
_STAGING: Final = 1 << 20
_ANCILLARY: Final = 128
"""Bytes for a receive time and a destination address."""


@dataclass(frozen=True, slots=True)
class _Bound:
    """A bound socket; ``address`` is its own, for systems that do not tell where a datagram was sent to."""

    socket: socket.socket
    version: int
    address: bytes
    port: int


class _Arrival(NamedTuple):
    """A datagram in the staging buffer; ``place`` is where its headers will start."""

    place: int
    length: int
    time_ns: int
    source: bytes
    source_port: int
    destination: bytes


class Sockets:
    """Bound UDP sockets, read together.

    Args:
        endpoints: addresses and ports to bind; port 0 lets the system choose.
        receive_buffer: bytes to ask the kernel for, a socket; it gives what its limits allow.

    Attributes:
        info: what the source is.
        drops: datagrams that the kernel lost because a receive buffer was full.
        linger_s: how long to let datagrams gather, which is little enough for a small receive buffer.
        endpoints: what was bound.

    Raises:
        CaptureError: an endpoint cannot be bound, or there is none.
    """

    def __init__(self, endpoints: Iterable[Endpoint], receive_buffer: int = 16 << 20) -> None:
        self.drops = 0
        self.linger_s = 0.005
        self._bound: list[_Bound] = []
        self._packed: dict[str, bytes] = {}
        self._kept: defaultdict[_Bound, list[tuple[_Arrival, bytes]]] = defaultdict(list)
        self._number = 1
        try:
            self.endpoints = tuple(self._bind(endpoint, receive_buffer) for endpoint in endpoints)
        except CaptureError:
            self.close()
            raise
        if not self.endpoints:
            raise CaptureError("no endpoint to listen on: name one as HOST:PORT")
        beyond = len(self._bound) * (_LARGEST + max(ROOM.values()) + 1)  # each may pass its share by one
        self._staging = memoryview(bytearray(_STAGING + beyond))
        self.info = SourceInfo(", ".join(str(endpoint) for endpoint in self.endpoints), "udp")

    def _bind(self, endpoint: Endpoint, receive_buffer: int) -> Endpoint:
        if not 0 <= endpoint.port <= 0xFFFF:  # getaddrinfo takes some numbers beyond modulo 65536
            raise CaptureError(f"{endpoint}: {endpoint.port} is not a UDP port: 0 to 65535")
        try:
            family, _, _, _, wanted = socket.getaddrinfo(
                endpoint.address, endpoint.port, type=socket.SOCK_DGRAM, flags=socket.AI_PASSIVE
            )[0]
            version = 6 if family == socket.AF_INET6 else 4
            opened = socket.socket(family, socket.SOCK_DGRAM)
            try:
                opened.setblocking(False)
                _configure(opened, version, receive_buffer)
                opened.bind(wanted)
            except BaseException:
                opened.close()
                raise
        except (OSError, UnicodeError) as error:
            raise CaptureError(f"{endpoint}: {bind_reason(error, endpoint.port)}") from error
        address, port = opened.getsockname()[:2]
        self._bound.append(_Bound(opened, version, self._pack(version, address), port))
        return Endpoint(address, port)

    def _pack(self, version: int, address: str) -> bytes:
        """Return an address as bytes; the scope of a link-local one is not on the wire."""
        if address not in self._packed:
            family = socket.AF_INET6 if version == 6 else socket.AF_INET
            self._packed[address] = socket.inet_pton(family, address.partition("%")[0])
        return self._packed[address]

    def filenos(self) -> tuple[int, ...]:
        """Return the file descriptors that become readable when a datagram is there."""
        return tuple(bound.socket.fileno() for bound in self._bound)

    def read(self) -> FrameBatch | None:
        """Take the datagrams that are there, a MiB or so, in order of time; None when there are none."""
        groups, size = self._gather()
        if not groups:
            return None
        data = np.zeros(size + PADDING, dtype=np.uint8)
        data[:size] = np.frombuffer(self._staging[:size], dtype=np.uint8)
        columns = [_write(data, bound, arrivals) for bound, arrivals in groups]
        offset, length, time_ns = (np.concatenate(column) for column in zip(*columns, strict=True))
        order = np.argsort(time_ns, kind="stable")
        frames = FrameBatch(
            data=data,
            number=np.arange(self._number, self._number + len(order), dtype=np.int64),
            time_ns=time_ns[order],
            link_type=np.full(len(order), RAW, dtype=np.uint16),
            offset=offset[order],
            length=length[order],
            original_length=length[order],
        )
        self._number += len(frames)
        return frames

    def _gather(self) -> tuple[list[tuple[_Bound, list[_Arrival]]], int]:
        """Take what is there into the staging buffer, socket by socket; return it and its end.

        What came to one socket after another had been read stays for the next time, or the order of time
        would break between two reads.
        """
        while True:
            whole_ns = time.time_ns()  # nothing older will come any more
            groups: list[tuple[_Bound, list[_Arrival]]] = []
            place, fresh = 0, False
            for bound in self._bound:
                room = place + _STAGING // len(self._bound)
                arrivals, place = self._put_back(bound, place)
                kept = len(arrivals)
                place = self._receive(bound, arrivals, place, room)
                fresh |= len(arrivals) > kept
                if place >= room:
                    whole_ns = min(whole_ns, arrivals[-1].time_ns)
                if arrivals:
                    groups.append((bound, arrivals))
            if fresh and len(self._bound) > 1:
                groups = [
                    (bound, whole) for bound, some in groups if (whole := self._keep(bound, some, whole_ns))
                ]
            if groups or not fresh:
                return groups, place

    def _receive(self, bound: _Bound, arrivals: list[_Arrival], place: int, room: int) -> int:
        """Add a socket's datagrams, staged from ``place`` until ``room``; return their end."""
        staging, header = self._staging, ROOM[bound.version]
        while place < room:
            start = place + header
            try:
                length, ancillary, _, sender = bound.socket.recvmsg_into(
                    [staging[start : start + _LARGEST]], _ANCILLARY
                )
            except BlockingIOError:
                break
            except OSError as error:
                raise CaptureError(f"{self.info.name}: {error.strerror}") from error
            staging[start + length] = 0  # an odd last byte's partner in the checksum
            time_ns, destination = _told(ancillary)
            arrivals.append(
                _Arrival(
                    place,
                    length,
                    time_ns,
                    self._pack(bound.version, sender[0]),
                    sender[1],
                    destination or bound.address,
                )
            )
            place = (start + length + 2) & ~1
        return place

    def _keep(self, bound: _Bound, arrivals: list[_Arrival], until_ns: int) -> list[_Arrival]:
        """Return the datagrams up to a time; keep the others, which come next time."""
        count, header = bisect_right(arrivals, until_ns, key=attrgetter("time_ns")), ROOM[bound.version]
        for arrival in arrivals[count:]:
            start = arrival.place + header
            self._kept[bound].append((arrival, bytes(self._staging[start : start + arrival.length])))
        return arrivals[:count]

    def _put_back(self, bound: _Bound, place: int) -> tuple[list[_Arrival], int]:
        """Stage the datagrams that were kept from ``place``; return them and their end."""
        arrivals, header = [], ROOM[bound.version]
        for arrival, payload in self._kept.pop(bound, ()):
            start = place + header
            self._staging[start : start + len(payload) + 1] = payload + b"\0"
            arrivals.append(arrival._replace(place=place))
            place = (start + len(payload) + 2) & ~1
        return arrivals, place

    def count(self) -> None:
        """Ask the kernel what it dropped."""
        if LINUX:
            self.drops = sum(kernel_drops(bound.socket) for bound in self._bound)

    def refuse(self) -> None:
        """Let nothing more in: a connected socket hears its peer only, and each gets itself as peer."""
        for bound in self._bound:
            with contextlib.suppress(OSError):
                bound.socket.connect(bound.socket.getsockname())

    def drained(self) -> bool:
        """Tell that a read that found nothing has found everything."""
        return True

    def failure(self) -> str | None:
        """Return None: a UDP socket does not fail between reads."""
        return None

    def close(self) -> None:
        """Close the sockets."""
        for bound in self._bound:
            bound.socket.close()


class UdpSource(DeviceSource):
    """Datagrams that are sent to this process, received on plain UDP sockets.

    IPv6 sockets take IPv6 only, so that ``0.0.0.0`` and ``::`` can be listened on together.

    Args:
        endpoints: addresses and ports to bind; port 0 lets the system choose.
        ready: called once when ``batches`` starts; nothing that arrives after construction is missed.
        receive_buffer: bytes to ask the kernel for, a socket; it gives what its limits allow.

    Attributes:
        endpoints: what was bound.

    Raises:
        CaptureError: an endpoint cannot be bound, or there is none.
    """

    def __init__(
        self,
        endpoints: Iterable[Endpoint],
        *,
        ready: Callable[[], None] | None = None,
        receive_buffer: int = 16 << 20,
    ) -> None:
        sockets = Sockets(endpoints, receive_buffer)
        self.endpoints = sockets.endpoints
        super().__init__(sockets, ready=ready)


def parse_endpoint(text: str) -> Endpoint:
    """Read ``HOST:PORT``, ``[IPV6]:PORT``, or ``PORT`` alone for every IPv4 address of this machine.

    Raises:
        ConfigError: it is none of them.
    """
    host, _, number = text.rpartition(":")
    try:
        port = int(number, 0)
    except ValueError:
        port = -1
    bare = ":" in host and not (host.startswith("[") and host.endswith("]"))
    if bare or not 0 <= port <= 0xFFFF or (":" in text and not host):
        raise ConfigError(
            f"--listen {text}: not an endpoint: HOST:PORT, [IPV6]:PORT or PORT, from 0 to 65535"
        )
    return Endpoint(host.strip("[]") or "0.0.0.0", port)  # noqa: S104  what PORT alone promises


def _configure(opened: socket.socket, version: int, receive_buffer: int) -> None:
    """Ask for room, receive times and the address that each datagram was sent to."""
    if version == 6:
        opened.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
    with contextlib.suppress(OSError):  # some systems refuse more than their limit, others cut it
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive_buffer)
    if not LINUX:
        return
    with contextlib.suppress(PermissionError):  # past the limit for those who may
        opened.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, receive_buffer)
    opened.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
    if version == 6:
        opened.setsockopt(socket.IPPROTO_IPV6, _IPV6_RECVPKTINFO, 1)
    else:
        opened.setsockopt(socket.IPPROTO_IP, _IP_PKTINFO, 1)


def _told(ancillary: list[tuple[int, int, bytes]]) -> tuple[int, bytes]:
    """Return a datagram's receive time in ns and its destination address, empty if the system did not say."""
    time_ns, destination = 0, b""
    for level, kind, value in ancillary:
        if level == socket.SOL_SOCKET and kind == _SO_TIMESTAMPNS:
            seconds, rest = struct.unpack("@ll", value)
            time_ns = seconds * 1_000_000_000 + rest
        elif level == socket.IPPROTO_IP and kind == _IP_PKTINFO:
            destination = value[8:12]
        elif level == socket.IPPROTO_IPV6 and kind == _IPV6_PKTINFO:
            destination = value[:16]
    return time_ns or time.time_ns(), destination


def _write(
    data: NDArray[np.uint8], bound: _Bound, arrivals: list[_Arrival]
) -> tuple[NDArray[np.int64], NDArray[np.int32], NDArray[np.int64]]:
    """Give a socket's datagrams their headers; return offset, length and time of the frames."""
    places, lengths, times, sources, source_ports, destinations = zip(*arrivals, strict=True)
    offset, length = np.array(places, dtype=np.int64), np.array(lengths, dtype=np.int32)
    write_headers(
        data,
        bound.version,
        offset,
        length,
        (_addresses(sources), np.array(source_ports, dtype=np.uint16)),
        (_addresses(destinations), np.full(len(offset), bound.port, dtype=np.uint16)),
    )
    return offset, length + np.int32(ROOM[bound.version]), np.array(times, dtype=np.int64)


def _addresses(packed: tuple[bytes, ...]) -> NDArray[np.uint8]:
    return np.frombuffer(b"".join(packed), dtype=np.uint8).reshape(len(packed), -1)


def kernel_drops(opened: socket.socket) -> int:
    """Return what the kernel dropped at a socket since it was opened."""
    information = opened.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, 4 * (_MEMINFO_DROPS + 1))
    return int(struct.unpack_from("=I", information, 4 * _MEMINFO_DROPS)[0])


def bind_reason(error: Exception, port: int) -> str:
    """Say why an endpoint could not be bound, and what to do."""
    if isinstance(error, (socket.gaierror, UnicodeError)):
        return "neither an address nor the name of a host that is known: use an address of this machine"
    match getattr(error, "errno", None):
        case errno.EADDRINUSE:
            return (
                f"another program has port {port} (a bridge?): stop it, or capture from the interface "
                "with -i, which sees its datagrams without taking the port"
            )
        case errno.EADDRNOTAVAIL:
            return "not an address of this machine: use one of its own, or 0.0.0.0 for all of them"
        case errno.EACCES:
            return f"port {port} needs privileges: use one from 1024 up"
        case _:
            return str(getattr(error, "strerror", None) or error)
