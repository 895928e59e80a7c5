"""The ring on real interfaces: loopback, and a tun and a tap device made for the test.

These need CAP_NET_RAW, the tun and tap ones CAP_NET_ADMIN; ``unshare -rn`` gives a user both.
"""

from __future__ import annotations

import contextlib
import fcntl
import itertools
import os
import platform
import select
import socket
import struct
import threading
import time

import numpy as np
import pytest
from waiting import PATIENCE_S, until

from edoras_tools.errors import CaptureError
from edoras_tools.io.capture import device
from edoras_tools.io.capture import live as module
from edoras_tools.io.capture.bpf import ETHERNET, LINUX_SLL2, RAW
from edoras_tools.io.capture.live import Ring, _marks_segments
from edoras_tools.io.frames.linklayer import demux

TUNSETIFF = 0x400454CA
SIOCGIFFLAGS, SIOCSIFFLAGS = 0x8913, 0x8914
IFF_UP, IFF_TUN, IFF_TAP, IFF_NO_PI = 1, 1, 2, 0x1000
names = (f"edt{os.getpid() % 100000}x{number}" for number in itertools.count())


class Wire:
    """An interface whose other end is held by the test."""

    def __init__(self, kind, name=None):
        self.name = name or next(names)
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

        def make(kind, *, up=True, name=None):
            made = Wire(kind, name)
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
def test_what_begins_so_is_seen_on_any_port(ring, pair, interface):
    sender, port = pair
    mark = f"R{port:x}"[:4].ljust(4, "_").encode()  # of this test alone: others send on loopback, too
    source = ring(interface, [1], begins=[mark])
    for body in (mark, b"RTP", b"other", mark + bytes(2000)):
        sender.send(body)
    assert payloads(take(source)) == [mark, mark + bytes(2000)]


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


@pytest.mark.parametrize(
    ("kind", "header"), [(IFF_TUN, ""), (IFF_TAP, "0800"), (IFF_TAP, "8100 0005 0800"), (IFF_TAP, "0806")]
)
def test_of_all_interfaces_each_has_its_own_header(ring, wire, kind, header):
    made, source = wire(kind), ring("any", [4321])
    addresses = bytes(12) if kind == IFF_TAP else b""
    made.put(addresses + bytes.fromhex(header) + ipv4(b"x" * 30, port=4321))
    assert payloads(take(source)) == ([] if header == "0806" else [b"x" * 30])


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


@pytest.mark.skipif(not _marks_segments(), reason="the kernel cannot tell: it is older than Linux 6.2")
@pytest.mark.parametrize("interface", ["lo", "any"])
def test_what_was_sent_as_one_is_captured_as_the_many_that_arrive(ring, pair, interface):
    """By UDP_SEGMENT: the kernel takes many datagrams as one, and parts them behind the capture."""
    sender, port = pair
    source = ring(interface, [port])
    sent = [bytes([number]) * 300 for number in range(40)] + [b"last"]
    sender.send(b"before")
    sender.setsockopt(socket.IPPROTO_UDP, 103, 300)
    sender.send(b"".join(sent))
    sender.setsockopt(socket.IPPROTO_UDP, 103, 0)
    sender.send(b"behind")
    batches = take(source)
    assert payloads(batches) == [b"before", *sent, b"behind"]
    assert np.concatenate([frames.number for frames in batches]).tolist() == list(range(1, 44))
    assert source.drops == 0


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


def test_a_quarter_of_a_ring_presses(ring, pair):
    sender, port = pair
    source = ring("lo", [port], block_size=1 << 17, blocks=8)
    assert not source.pressed()
    while not source.pressed():
        assert not source.drops
        sender.send(bytes(1000))
        source.count()
    assert sum(len(frames) for frames in iter(source.read, None)) * 1000 > 2 << 17
    assert not source.pressed()


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


def framed(payload):
    return bytes(12) + b"\x08\0" + ipv4(payload)


def read_until(source, count):
    """The payloads of so many datagrams, as they come; the source watches its interface meanwhile."""
    seen = []

    def there():
        assert source.failure() is None
        while (frames := source.read()) is not None:
            seen.extend(payloads([frames]))
        return len(seen) >= count

    until(there)
    return seen


@pytest.mark.parametrize("walks", [True, False])
@pytest.mark.parametrize("how", ["down", "not there"])
def test_an_interface_that_goes_away_and_comes_back(ring, wire, monkeypatch, how, walks):
    """The same socket goes on, bound again where the interface was made anew."""
    monkeypatch.setattr("edoras_tools.io.capture.live.available", lambda: walks)
    tap = wire(IFF_TAP)
    source = ring(tap.name, [1234])
    handle = source.filenos()
    for turn in range(3):
        assert len(source.outages) == turn
        tap.put(framed(b"before"))
        went_ns = time.time_ns()
        if how == "down":
            tap.switch(up=False)
        else:
            tap.remove()
        until(lambda: source.failure() or (source.outages and not source.outages[-1].end_ns))
        assert read_until(source, 1) == [b"before"]
        if how == "down":
            tap.switch(up=True)
        else:
            tap = wire(IFF_TAP, name=tap.name)
        until(lambda: source.failure() or source.outages[-1].end_ns)
        outage = source.outages[-1]
        assert (outage.interface, outage.why) == (tap.name, how)
        assert went_ns <= outage.start_ns <= outage.end_ns <= time.time_ns()
        tap.put(framed(b"after"))
        assert read_until(source, 1) == [b"after"]
    assert source.filenos() == handle
    assert source.drops == 0


def test_the_outage_ends_where_the_first_frame_came(ring, wire):
    """Nobody looked in between: the interface was back before that was seen."""
    tap = wire(IFF_TAP)
    source = ring(tap.name, [1234])
    tap.switch(up=False)
    until(lambda: source.failure() or source.outages)
    tap.switch(up=True)
    tap.put(framed(b"after"))
    came_ns = time.time_ns()
    (frames,) = take(source)
    until(lambda: source.failure() or source.outages[-1].end_ns)
    assert source.outages[-1].end_ns == frames.time_ns[0] <= came_ns


def test_down_and_up_between_two_looks_is_told(ring, wire):
    tap = wire(IFF_TAP)
    source = ring(tap.name, [1234])
    tap.switch(up=False)
    tap.switch(up=True)
    until(lambda: source.failure() or source.outages)
    (outage,) = source.outages
    assert (outage.why, outage.start_ns) == ("down", outage.end_ns)


@pytest.mark.parametrize(
    ("kind", "frame", "link_type"), [(IFF_TAP, framed(b"x"), ETHERNET), (IFF_TUN, ipv4(b"x"), RAW)]
)
def test_an_interface_that_is_waited_for(ring, wire, kind, frame, link_type):
    """What kind it is shows when it is there; who waits for the descriptor need not know."""
    name = next(names)
    source = ring(name, [1234], wait=True)
    assert source.outages[-1].why == "not there"
    handle = source.filenos()
    made = wire(kind, up=False, name=name)
    assert source.failure() is None
    made.switch(up=True)
    until(lambda: source.failure() or source.outages[-1].end_ns)
    made.put(frame)
    assert read_until(source, 1) == [b"x"]
    assert source.filenos() == handle
    made.put(frame)
    (frames,) = take(source)
    assert frames.link_type.tolist() == [link_type]
    assert frames.number.tolist() == [2]


def test_waiting_for_an_interface_that_is_down(ring, wire):
    tap = wire(IFF_TAP, up=False)
    source = ring(tap.name, [1234], wait=True)
    assert source.outages[-1].why == "down"
    tap.switch(up=True)
    tap.put(framed(b"at once"))
    assert read_until(source, 1) == [b"at once"]
    assert source.outages[-1].end_ns


@pytest.mark.parametrize("name", ["", "far-too-long-for-an-interface", "a/b", "lo\n", ".."])
def test_no_interface_of_an_impossible_name_is_waited_for(ring, name):
    with pytest.raises(CaptureError, match="no such interface"):
        ring(name, wait=True)


def test_the_open_block_is_read(ring, pair, monkeypatch):
    """Nothing waits for a block to be full or old, and reading it closes none."""
    monkeypatch.setattr("edoras_tools.io.capture.live._RETIRE_MS", 60_000)
    sender, port = pair
    source = ring("lo", [port])
    for number in range(50):
        sender.send(b"%d" % number)
        assert read_until(source, 1) == [b"%d" % number]
    assert source._next == 0  # still the first one, where all fifty are
    assert not source._headers[0, 2]


def test_the_open_block_at_every_turn(ring, pair, monkeypatch):
    """Read as often as can be, across many ends of blocks."""
    monkeypatch.setattr("edoras_tools.io.capture.live.FRESH_S", 0)
    sender, port = pair
    source = ring("lo", [port], block_size=1 << 16, blocks=4)
    seen = []
    for number in range(600):
        sender.send(number.to_bytes(4, "big") + bytes(number * 37 % 3000))
        if number % 7 == 0:
            while (frames := source.read()) is not None:
                seen += payloads([frames])
    seen += payloads(take(source))
    assert source.drops == 0
    assert [int.from_bytes(payload[:4], "big") for payload in seen] == list(range(600))
    assert [len(payload) for payload in seen] == [4 + number * 37 % 3000 for number in range(600)]


@pytest.mark.parametrize("early", [False, True])
def test_a_wait_for_the_kernel_holds_nothing_up(ring, pair, monkeypatch, early):
    """Where processors are busy it takes seconds: what came is read when its block is closed by its age."""
    end = threading.Event()
    monkeypatch.setattr("edoras_tools.io.capture.live.wait", end.wait)
    sender, port = pair
    source = ring("lo", [port])
    try:
        sender.send(b"first")
        assert read_until(source, 1) == [b"first"]
        assert source._next == 1
        sender.send(b"second")
        if early:  # an answer about the block before says nothing of this one
            end.set()
        assert read_until(source, 1) == [b"second"]
    finally:
        end.set()


def test_a_ring_that_nobody_empties_holds_what_its_bytes_hold(ring, pair, monkeypatch):
    """Blocks are closed by fill: time costs no room."""
    monkeypatch.setattr("edoras_tools.io.capture.live._RETIRE_MS", 60_000)
    sender, port = pair
    source = ring("lo", [port], block_size=1 << 16, blocks=2)
    for number in range(20):
        sender.send(b"%d" % number)
        time.sleep(0.03)  # more than FRESH_S
    assert payloads(take(source)) == [b"%d" % number for number in range(20)]
    assert source.drops == 0


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

    monkeypatch.setattr("edoras_tools.io.capture.live.socket.socket", Short)
    sender, port = pair
    source = ring("lo", [port])
    assert asked[0] > 4
    assert asked == [asked[0] >> halved for halved in range(len(asked))]
    assert asked[-1] <= 4
    sender.send(b"still works")
    assert payloads(take(source)) == [b"still works"]


def test_a_system_without_packet_sockets(monkeypatch):
    monkeypatch.delattr("socket.AF_PACKET")
    with pytest.raises(CaptureError, match="scapy"):
        Ring("lo")


def test_interfaces_are_listed():
    assert "lo" in device.interfaces()
    assert device.loopback_index() == socket.if_nametoindex("lo")
    assert device.find_interface("lo").loopback


@pytest.fixture(autouse=True)
def fresh():
    module.available.cache_clear()
    yield
    module.available.cache_clear()


def test_it_waits_where_it_says_so():
    assert module.available() == module.wait() or not module.available()


@pytest.mark.parametrize("known", [-1, 0, 0b110])
def test_a_kernel_without_the_call(monkeypatch, known):
    monkeypatch.setattr(module, "_call", lambda _: known)
    assert not module.available()


def test_an_unknown_machine(monkeypatch):
    monkeypatch.setattr(platform, "machine", lambda: "abacus")
    assert not module.available()


def test_a_real_time_kernel(monkeypatch, tmp_path):
    monkeypatch.setattr(module, "_REAL_TIME", tmp_path)
    assert not module.available()


@pytest.mark.parametrize("succeeds", [True, False])
def test_a_thread_waits_and_answers_once(monkeypatch, succeeds):
    end = threading.Event()
    monkeypatch.setattr(module, "wait", lambda: end.wait() and succeeds)
    one = module.Barrier()
    try:
        for _ in range(2):
            one.ask()
            assert one.answer() is None
            end.set()
            select.select([one.fileno()], [], [], PATIENCE_S)
            end.clear()
            assert [one.answer(), one.answer()] == [succeeds, None]
    finally:
        end.set()
        one.close()
    assert not one._thread.is_alive()
