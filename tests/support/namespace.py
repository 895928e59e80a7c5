"""Network namespaces: one for a process, one of a test's own, with a cable in it: two ends of a veth pair."""

import ctypes
import socket
import struct
import subprocess
import threading
from pathlib import Path

from with_raw_sockets import bring_up_loopback

CLONE_NEWNET = 0x40000000
OUTSIDE = Path("/proc/self/ns/net").readlink()
ADDRESSES, IPV4 = bytes.fromhex("020000000001 020000000002"), b"\x08\x00"


def enter():
    """Take this thread, and what it starts, into a new one, in which only a loopback interface is.

    Raises:
        OSError: it may not; it is where it was.
    """
    library = ctypes.CDLL(None, use_errno=True)
    with Path("/proc/thread-self/ns/net").open() as before:
        if library.unshare(CLONE_NEWNET) != 0:
            raise OSError(ctypes.get_errno(), "a namespace needs CAP_SYS_ADMIN")
        try:
            bring_up_loopback()
        except OSError:  # it has not CAP_NET_ADMIN
            library.setns(before.fileno(), CLONE_NEWNET)
            raise


def entered():
    """Tell whether this process is in a namespace that ``enter`` made."""
    return Path("/proc/self/ns/net").readlink() != OUTSIDE


def inside(work):
    """Run a function in a thread that is in a new namespace, with its sockets and programs; return its value.

    A network namespace belongs to a thread, so the test's other threads stay where they are.
    """
    given = []

    def run():
        try:
            enter()
            given.append((work(), None))
        except BaseException as error:  # noqa: BLE001  it belongs to the test's thread
            given.append((None, error))

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    ((value, error),) = given
    if error is not None:
        raise error
    return value


def ip(*words):
    """Run ``ip``."""
    subprocess.run(["ip", *words], check=True)


class Cable:
    """A veth pair: what ``send`` puts in at the far end comes out of the interface ``name``."""

    def __init__(self, name):
        self.name, self.far = name, f"{name}far"

    def lay(self):
        """Make it, both ends up."""
        ip("link", "add", self.name, "type", "veth", "peer", "name", self.far)
        for end in (self.far, self.name):
            self.switch("up", end)

    def remove(self):
        """Delete it."""
        ip("link", "del", self.name)

    def switch(self, how, end=None):
        """Set an end up or down."""
        ip("link", "set", end or self.name, how)

    def send(self, payload, port=1234, tags=b""):
        """Put a UDP datagram in at the far end, after VLAN tags."""
        udp = struct.pack(">HHHH", 9, port, 8 + len(payload), 0) + payload
        head = struct.pack(">BBHHHBBH", 0x45, 0, 20 + len(udp), 1, 0, 64, 17, 0)
        with socket.socket(socket.AF_PACKET, socket.SOCK_RAW) as raw:
            raw.bind((self.far, 0))
            raw.send(ADDRESSES + tags + IPV4 + head + bytes([10, 0, 0, 2, 10, 0, 0, 1]) + udp)
