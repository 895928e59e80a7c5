"""Run a command where raw sockets may be opened: here, if that is so, else in a user and network namespace.

The live-capture tests need CAP_NET_RAW. Nobody has to be root for it: in a namespace of one's own, where
only a loopback interface is, everyone has it. Where neither works, the command runs as it is, and the tests
that need it fail with the reason.

Run: python with_raw_sockets.py COMMAND [ARGUMENT ...]
"""

from __future__ import annotations

import fcntl
import os
import shutil
import socket
import struct
import subprocess
import sys

_SIOCSIFFLAGS = 0x8914
_IFF_UP = 1


def may_capture() -> bool:
    """Tell whether a raw socket opens."""
    try:
        socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0).close()
    except OSError:
        return False
    return True


def bring_up_loopback() -> None:
    """Bring up ``lo``, which is down in a new network namespace."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
        fcntl.ioctl(any_socket, _SIOCSIFFLAGS, struct.pack("16sH14x", b"lo", _IFF_UP))


def main() -> None:
    """Become the command."""
    command = sys.argv[1:]
    if command[:1] == ["--in-namespace"]:
        bring_up_loopback()
        command = command[1:]
    elif not may_capture() and shutil.which("unshare"):
        enter = ["unshare", "--map-root-user", "--net"]
        if subprocess.run([*enter, "true"], check=False, capture_output=True).returncode == 0:  # noqa: S603
            command = [*enter, sys.executable, __file__, "--in-namespace", *command]
    os.execvp(command[0], command)  # noqa: S606


if __name__ == "__main__":
    main()
