"""The ring on real interfaces: loopback, and a tun and a tap device made for the test.

These need CAP_NET_RAW, the tun and tap ones CAP_NET_ADMIN; ``unshare -rn`` gives a user both.
"""

from __future__ import annotations

import contextlib
import fcntl
import itertools
import os
import select
import socket
import struct
import time

import numpy as np
import pytest
from waiting import PATIENCE_S

from edoras_tools.errors import CaptureError
from edoras_tools.sources import interfaces
from edoras_tools.sources.bpf import ETHERNET, LINUX_SLL2, RAW
from edoras_tools.sources.linklayer import demux
from edoras_tools.sources.ring import Ring

TUNSETIFF = 0x400454CA
SIOCGIFFLAGS, SIOCSIFFLAGS = 0x8913, 0x8914
IFF_UP, IFF_TUN, IFF_TAP, IFF_NO_PI = 1, 1, 2, 0x1000
names = (f"edt{os.getpid() % 100000}x{number}" for number in itertools.count())


class Wire:
    """An interface whose other end is held by the test."""

    def __init__(self, kind):
        self.name = next(names)
        self.fd = os.open("/dev/net/tun", os.O_RDWR)
        fcntl.ioctl(self.fd, TUNSETIFF, struct.pack("16sH22x", self.name.encode(), kind | IFF_NO_PI))

    def switch(self, up):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as control:
            request = struct.pack("16sH22x", self.name.encode(), 0)
            flags = struct.unpack_from("16xH", fcntl.ioctl(control, SIOCGIFFLAGS, request))[0]
            flags = flags | IFF_UP if up else flags & ~IFF_UP
            fcntl.ioctl(control, SIOCSIFFLAGS, struct.pack("16sH22x", self.name.encode(), flags))

    def put(self, frame):
        os.write(self.fd, frame)

    def remove(self):
        if self.fd >= 0:
            os.close(self.fd)
            self.fd = -1


@pytest.fixture
def wire():
    with contextlib.ExitStack() as stack:

        def make(kind, *, up=True):
            made = Wire(kind)
            stack.callback(made.remove)
            if up:
                made.switch(up=True)
            return made

        yield make


@pytest.fixture
def ring():
    with contextlib.ExitStack() as stack:

        def make(*arguments, **options):
            made = Ring(*arguments, **options)
            stack.callback(made.close)
            return made

        yield make


@pytest.fixture
def pair():
    """A sender connected to a receiver on loopback."""
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
    ):
        receiver.bind(("127.0.0.1", 0))
        sender.connect(receiver.getsockname())
        yield sender, receiver.getsockname()[1]


def take(source):
    """All frames that have come to a ring: the batches up to the moment when nothing is left in it."""
    source.refuse()
    batches = []
    end = time.monotonic() + PATIENCE_S
    while time.monotonic() < end:
        while (frames := source.read()) is not None:
            batches.append(frames)
        if source.drained():
            return batches
        select.select(source.filenos(), [], [], 0.1)
    raise AssertionError("the ring did not give up what it holds in time")


def payloads(batches):
    return [
        packets[row].payload
        for frames in batches
        for packets in (demux(frames),)
        for row in range(len(packets))
    ]


def ipv4(payload, port=1234):
    udp = struct.pack(">HHHH", 9, port, 8 + len(payload), 0) + payload
    return (
        struct.pack(">BBHHHBBH4s4s", 0x45, 0, 20 + len(udp), 1, 0, 64, 17, 0, b"\x0a\0\0\1", b"\x0a\0\0\2")
        + udp
    )


@pytest.mark.parametrize("interface", ["lo", "any"])
def test_loopback_is_seen_once_with_its_time(ring, pair, interface):
    sender, port = pair
    source = ring(interface, [port])
    before = time.time_ns()
    for number in range(1000):
        sender.send(number.to_bytes(4, "big") * 50)
    after = time.time_ns()
    batches = take(source)
    assert payloads(batches) == [number.to_bytes(4, "big") * 50 for number in range(1000)]
    times = np.concatenate([frames.time_ns for frames in batches])
    assert before <= times[0] <= times[-1] <= after
    assert (np.diff(times) >= 0).all()
    assert np.concatenate([frames.number for frames in batches]).tolist() == list(range(1, 1001))
    assert set(batches[0].link_type.tolist()) == {LINUX_SLL2 if interface == "any" else ETHERNET}
    assert source.drops == 0


def test_cooked_headers_say_which_interface(ring, pair):
    sender, port = pair
    source = ring("any", [port])
    sender.send(b"x")
    (frames,) = take(source)
    header = demux(frames)[0].frame[:20]
    assert header == struct.pack(">HHIHBB8x", 0x0800, 0, socket.if_nametoindex("lo"), 772, 0, 6)


def test_other_ports_stay_out(ring, pair):
    sender, port = pair
    source = ring("lo", [port])
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        for _ in range(10):
            sender.sendto(b"foreign", other.getsockname())
        sender.send(b"wanted")
        assert payloads(take(source)) == [b"wanted"]


@pytest.mark.parametrize("size", [0, 1, 8, 1472, 9000, 65507])
def test_any_size_comes_whole(ring, pair, size):
    sender, port = pair
    source = ring("lo", [port])
    sender.send(b"\x5a" * size)
    (frames,) = take(source)
    assert payloads([frames]) == [b"\x5a" * size]
    assert frames.original_length.tolist() == frames.length.tolist() == [42 + size]


def test_snap_length_cuts_and_says_so(ring, pair):
    sender, port = pair
    source = ring("lo", [port], snap_length=60)
    sender.send(bytes(200))
    (frames,) = take(source)
    assert (frames.length.tolist(), frames.original_length.tolist()) == ([60], [242])
    assert source.info.snap_length == 60


def test_what_does_not_fit_is_counted(ring, pair):
    sender, port = pair
    source = ring("lo", [port], block_size=1 << 17, blocks=2)
    for _ in range(3000):
        sender.send(bytes(1000))
    batches = take(source)
    seen = sum(len(frames) for frames in batches)
    assert 0 < seen < 3000
    assert seen + source.drops == 3000
    assert source.failure() is None


def test_many_blocks_keep_the_order(ring, pair):
    sender, port = pair
    source = ring("lo", [port], block_size=1 << 17, blocks=8)
    seen = []
    for number in range(4000):
        sender.send(number.to_bytes(4, "big") + bytes(number % 1400))
        if number % 100 == 0:
            while (frames := source.read()) is not None:
                seen += payloads([frames])
    seen += payloads(take(source))
    assert source.drops == 0
    assert [int.from_bytes(payload[:4], "big") for payload in seen] == list(range(4000))
    assert [len(payload) for payload in seen] == [4 + number % 1400 for number in range(4000)]


def test_a_tun_gives_raw_ip(ring, wire):
    tun = wire(IFF_TUN)
    source = ring(tun.name, [1234])
    tun.put(ipv4(b"from a tunnel"))
    tun.put(ipv4(b"other", port=4321))
    (frames,) = take(source)
    assert frames.link_type.tolist() == [RAW]
    assert demux(frames)[0].frame == ipv4(b"from a tunnel")


def test_tags_that_the_kernel_took_out_are_back(ring, wire):
    tap = wire(IFF_TAP)
    source = ring(tap.name, [1234])
    ends = bytes.fromhex("ffffffffffff 020000000001")
    wanted = [
        ends + b"\x08\0" + ipv4(b"untagged"),
        ends + b"\x81\0\x20\x05" + b"\x08\0" + ipv4(b"tagged"),
        ends + b"\x88\xa8\0\x07" + b"\x81\0\x20\x05" + b"\x08\0" + ipv4(b"tagged twice"),
    ]
    for frame in wanted:
        tap.put(frame)
    tap.put(ends + b"\x81\0\x20\x05" + b"\x08\0" + ipv4(b"other", port=4321))
    batches = take(source)
    seen = [packets[row] for frames in batches for packets in (demux(frames),) for row in range(len(packets))]
    assert [datagram.frame for datagram in seen] == wanted
    assert [datagram.payload for datagram in seen] == [b"untagged", b"tagged", b"tagged twice"]
    assert [datagram.original_length for datagram in seen] == [len(frame) for frame in wanted]


@pytest.mark.parametrize("how", ["down", "gone"])
def test_an_interface_that_goes_away(ring, wire, how):
    tap = wire(IFF_TAP)
    source = ring(tap.name, [1234])
    assert source.failure() is None
    tap.put(bytes(12) + b"\x08\0" + ipv4(b"before"))
    if how == "down":
        tap.switch(up=False)
    else:
        tap.remove()
    assert source.failure() == f"{tap.name} went down; what came before is kept. Capture again when it is up"
    assert payloads(take(source)) == [b"before"]


def test_an_interface_that_is_down(ring, wire):
    tap = wire(IFF_TAP, up=False)
    with pytest.raises(CaptureError, match=rf"^{tap.name} is down: .*ip link set {tap.name} up"):
        ring(tap.name)


@pytest.mark.parametrize("name", ["nonesuch0", "", "far-too-long-for-an-interface", "a/b", "lo\n"])
def test_an_interface_that_is_not_there(ring, name):
    with pytest.raises(CaptureError, match=r"no such interface; there are .*lo.*any"):
        ring(name)


def test_missing_privilege_names_the_remedies(ring, monkeypatch):
    opened = socket.socket

    def refuse(family=socket.AF_INET, *arguments, **options):
        if family == socket.AF_PACKET:
            raise PermissionError(1, "Operation not permitted")
        return opened(family, *arguments, **options)

    monkeypatch.setattr("socket.socket", refuse)
    with pytest.raises(CaptureError) as caught:
        ring("lo")
    for remedy in ("CAP_NET_RAW", "sudo", "setcap", "--cap-add NET_RAW", "--listen"):
        assert remedy in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_kernel_short_of_memory_gives_a_smaller_ring(ring, pair, monkeypatch):
    asked = []

    class Short(socket.socket):
        def setsockopt(self, level, option, value):
            if (level, option) == (263, 5) and value[:4] != bytes(4):
                asked.append(struct.unpack("=7I", value)[1])
                if asked[-1] > 4:
                    raise OSError(12, "Cannot allocate memory")
            super().setsockopt(level, option, value)

    monkeypatch.setattr("edoras_tools.sources.ring.socket.socket", Short)
    sender, port = pair
    source = ring("lo", [port])
    assert asked == [64, 32, 16, 8, 4]
    sender.send(b"still works")
    assert payloads(take(source)) == [b"still works"]


def test_a_system_without_packet_sockets(monkeypatch):
    monkeypatch.delattr("socket.AF_PACKET")
    with pytest.raises(CaptureError, match="scapy"):
        Ring("lo")


def test_interfaces_are_listed():
    assert "lo" in interfaces.interfaces()
    assert interfaces.loopback_index() == socket.if_nametoindex("lo")
    assert interfaces.find("lo").loopback
