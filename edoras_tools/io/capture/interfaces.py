"""Network interfaces: which there are, and whether one may capture from them."""

from __future__ import annotations

import contextlib
import ctypes
import os
import socket
import struct
import sys
from typing import Final

import msgspec

from edoras_tools.errors import CaptureError

ANY_INTERFACE: Final = "any"
"""The name that means every interface."""

_SIOCGIFFLAGS: Final = 0x8913
_SIOCGIFHWADDR: Final = 0x8927
_IFF_UP: Final = 1 << 0
_IFF_LOOPBACK: Final = 1 << 3
_IFF_RUNNING: Final = 1 << 6
_NAME_LENGTH: Final = 16  # IFNAMSIZ


class Interface(msgspec.Struct, frozen=True):
    """One interface, or all of them.

    Attributes:
        name: the system's name, or ``any``.
        index: number of the interface; 0 for ``any``.
        hardware_type: ARPHRD number, which says how its frames start.
        up: whether it is up.
        loopback: whether what it sends comes in again.
        carrier: whether it has a carrier, as far as the system knows.
    """

    name: str
    index: int
    hardware_type: int
    up: bool
    loopback: bool
    carrier: bool = True


def interfaces() -> tuple[str, ...]:
    """Return the names of the interfaces, without ``any``."""
    return tuple(name for _, name in socket.if_nameindex())


def find_interface(name: str) -> Interface:
    """Look an interface up.

    Raises:
        CaptureError: there is no interface of that name; the message lists all names.
    """
    if name == ANY_INTERFACE:
        return Interface(name, index=0, hardware_type=-1, up=True, loopback=False)
    try:
        index, flags = socket.if_nametoindex(name), _ask(name, _SIOCGIFFLAGS)
        return Interface(
            name,
            index,
            hardware_type=_ask(name, _SIOCGIFHWADDR),
            up=bool(flags & _IFF_UP),
            loopback=bool(flags & _IFF_LOOPBACK),
            carrier=bool(flags & _IFF_RUNNING),
        )
    except (OSError, ValueError):
        raise missing_interface(name) from None


def possible(name: str) -> bool:
    """Return whether an interface may have that name (the kernel's ``dev_valid_name``)."""
    short = 0 < len(name.encode(errors="surrogateescape")) < _NAME_LENGTH
    return (
        short and name not in {".", ".."} and not any(letter in "/:" or letter.isspace() for letter in name)
    )


def missing_interface(name: str) -> CaptureError:
    """Return the error for an interface that does not exist."""
    return CaptureError(f"{name}: no such interface; there are {', '.join((*interfaces(), ANY_INTERFACE))}")


def loopback_index() -> int | None:
    """Return the index of the loopback interface, or None."""
    for name in interfaces():
        with contextlib.suppress(CaptureError):  # an interface may go away while they are listed
            interface = find_interface(name)
            if interface.loopback:
                return interface.index
    return None


def _ask(name: str, request: int) -> int:
    """Return the 16-bit answer of an interface ``ioctl`` (``struct ifreq``)."""
    import fcntl

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
        answer = fcntl.ioctl(any_socket, request, struct.pack("256s", name.encode()[: _NAME_LENGTH - 1]))
    return int(struct.unpack_from("=H", answer, _NAME_LENGTH)[0])


_CAP_NET_RAW: Final = 13
_CAPABILITY_VERSION: Final = 0x20080522
"""``_LINUX_CAPABILITY_VERSION_3``: header (version, process); effective, permitted, inheritable, twice."""


def claim_raw_sockets() -> None:
    """Let this thread open raw sockets, if the process is permitted to: CAP_NET_RAW becomes effective.

    A file capability that is only permitted (``cap_net_raw+p``) does not keep the program from starting in a
    container that lacks it, as an effective one (``+ep``) does; but the program has to ask for it.
    """
    header = (ctypes.c_uint32 * 2)(_CAPABILITY_VERSION, 0)
    values = (ctypes.c_uint32 * 6)()
    system = ctypes.CDLL(None)
    if system.capget(header, values) == 0:
        values[0] |= values[1] & 1 << _CAP_NET_RAW
        system.capset(header, values)


def denied(name: str) -> CaptureError:
    """Return the error for an interface that may not be opened."""
    return CaptureError(
        f"{name}: capturing needs CAP_NET_RAW: run it with sudo; "
        f"or once 'sudo setcap cap_net_raw+p {os.path.realpath(sys.executable)}'; "
        "or 'docker run --cap-add NET_RAW'; "
        "or receive the datagrams on a UDP socket with --listen, which needs no privilege"
    )
