"""The network interfaces of this machine."""

from __future__ import annotations

import contextlib
import os
import socket
import struct
import sys
from dataclasses import dataclass
from typing import Final

from edoras_tools.errors import CaptureError

ANY: Final = "any"
"""The name that stands for every interface at once."""

_SIOCGIFFLAGS: Final = 0x8913
_SIOCGIFHWADDR: Final = 0x8927
_IFF_UP: Final = 1 << 0
_IFF_LOOPBACK: Final = 1 << 3
_NAME_LENGTH: Final = 16  # IFNAMSIZ


@dataclass(frozen=True, slots=True)
class Interface:
    """One interface, or all of them.

    Attributes:
        name: as the system calls it, or ``any``.
        index: number of the interface; 0 for ``any``.
        hardware_type: ARPHRD number, which says how its frames start.
        up: whether it is switched on.
        loopback: whether what it sends comes in again.
    """

    name: str
    index: int
    hardware_type: int
    up: bool
    loopback: bool


def interfaces() -> tuple[str, ...]:
    """Return the names of the interfaces there are, without ``any``."""
    return tuple(name for _, name in socket.if_nameindex())


def find(name: str) -> Interface:
    """Look an interface up.

    Raises:
        CaptureError: there is none of that name; the message lists those there are.
    """
    if name == ANY:
        return Interface(name, index=0, hardware_type=-1, up=True, loopback=False)
    try:
        index = socket.if_nametoindex(name)
        return Interface(
            name,
            index,
            hardware_type=_ask(name, _SIOCGIFHWADDR),
            up=bool(_ask(name, _SIOCGIFFLAGS) & _IFF_UP),
            loopback=bool(_ask(name, _SIOCGIFFLAGS) & _IFF_LOOPBACK),
        )
    except (OSError, ValueError):
        raise missing(name) from None


def missing(name: str) -> CaptureError:
    """Return the error for an interface that is not there."""
    return CaptureError(f"{name}: no such interface; there are {', '.join((*interfaces(), ANY))}")


def denied(name: str) -> CaptureError:
    """Return the error for an interface that may not be opened."""
    return CaptureError(
        f"{name}: capturing needs CAP_NET_RAW: run it with sudo; "
        f"or once 'sudo setcap cap_net_raw+ep {os.path.realpath(sys.executable)}'; "
        "or 'docker run --cap-add NET_RAW'; "
        "or receive the datagrams on a plain UDP socket with --listen, which needs no privilege"
    )


def loopback_index() -> int | None:
    """Return the index of the loopback interface, None where there is none."""
    for name in interfaces():
        with contextlib.suppress(CaptureError):  # an interface may go away while they are listed
            interface = find(name)
            if interface.loopback:
                return interface.index
    return None


def _ask(name: str, request: int) -> int:
    """Return the 16-bit answer of an interface ``ioctl`` (``struct ifreq``)."""
    import fcntl

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
        answer = fcntl.ioctl(any_socket, request, struct.pack("256s", name.encode()[: _NAME_LENGTH - 1]))
    return int(struct.unpack_from("=H", answer, _NAME_LENGTH)[0])
