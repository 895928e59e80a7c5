"""The permission to open raw sockets, CAP_NET_RAW: asked for, and what is said where it is missing."""

from __future__ import annotations

import ctypes
import os
import sys
from typing import Final

from edoras_tools.errors import CaptureError

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
