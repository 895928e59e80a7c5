"""The port filter: on an interpreter written here from the kernel's description, and in the kernel itself."""

from __future__ import annotations

import socket
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edoras_tools.errors import CaptureError
from edoras_tools.io.capture import bpf

SNAP = 262144


class StopError(Exception):
    """A load past the end: the kernel's verdict is 0."""


def run(program, packet, *, protocol=0, packet_type=0, interface=0, hardware_type=0, network=0):
    """Run a program on a packet whose network header starts at ``network``; return its verdict."""
    ancillary = {
        bpf.ANCILLARY_PROTOCOL: protocol,
        bpf.ANCILLARY_PACKET_TYPE: packet_type,
        bpf.ANCILLARY_INTERFACE: interface,
        bpf.ANCILLARY_HARDWARE_TYPE: hardware_type,
    }

    def load(at, size):
        if at >= bpf.NETWORK:
            at += network - bpf.NETWORK
        if at + size > len(packet):
            raise StopError
        return int.from_bytes(packet[at : at + size], "big")

    a = x = place = 0
    memory = [0] * 16
    try:
        while True:
            code, then, otherwise, k = program[place]
            place += 1
            match code:
                case bpf.LD_W if k in ancillary:
                    a = ancillary[k]
                case bpf.LD_H:
                    a = load(k, 2)
                case bpf.LD_B:
                    a = load(k, 1)
                case bpf.LD_W_X:
                    a = load(x + k, 4)
                case bpf.LD_H_X:
                    a = load(x + k, 2)
                case bpf.LD_B_X:
                    a = load(x + k, 1)
                case bpf.LD_MEM:
                    a = memory[k]
                case bpf.LDX_IMM:
                    x = k
                case bpf.ST:
                    memory[k] = a
                case bpf.ADD_K:
                    a += k
                case bpf.ADD_X:
                    a += x
                case bpf.AND_K:
                    a &= k
                case bpf.LSH_K:
                    a <<= k
                case bpf.TAX:
                    x = a
                case bpf.TXA:
                    a = x & 0xFFFFFFFF
                case bpf.JA:
                    place += k
                case bpf.JEQ:
                    place += then if a == k else otherwise
                case bpf.JGT:
                    place += then if a > k else otherwise
                case bpf.JGE:
                    place += then if a >= k else otherwise
                case bpf.JSET:
                    place += then if a & k else otherwise
                case bpf.RET:
                    return k
                case _:
                    raise AssertionError(f"instruction {code:#x} {k:#x}")
    except StopError:
        return 0


def wanted(link_type, packet, ports, protocol=0):
    """What the filter promises, said plainly; short packets raise IndexError."""

    def half(at):
        return packet[at] << 8 | packet[at + 1]

    if link_type == bpf.RAW:
        at = 0
        protocol = {4: 0x0800, 6: 0x86DD}.get(packet[0] >> 4, 0)
    else:
        at = 0
        if link_type == bpf.ETHERNET:
            at, protocol = 14, half(12)
        for _ in range(bpf.MAXIMUM_TAGS):
            if protocol in {0x8100, 0x88A8, 0x9100}:
                protocol = half(at + 2)
                at += 4
    if protocol == 0x0800:
        kind, place = packet[at + 9], half(at + 6) & 0x1FFF
        if kind not in {1, 17} or (kind == 1 and place):
            return False
        if place:
            return True
        at += 4 * (packet[at] & 15)
        if kind == 1:  # unreachable or time exceeded, and quotes UDP: no IP options, no later fragment
            if packet[at] not in {3, 11} or packet[at + 17] != 17:
                return False
            if packet[at + 8] != 0x45 or half(at + 14) & 0x1FFF:
                return False
            at += 28
    elif protocol == 0x86DD:
        following = packet[at + 6]
        at += 40
        if following == 58:
            if packet[at] not in {1, 2, 3} or packet[at + 8] >> 4 != 6 or packet[at + 14] != 17:
                return False
            at, following = at + 48, 17
        for _ in range(bpf.MAXIMUM_EXTENSIONS):
            if following == 44:
                if half(at + 2) & 0xFFF8:
                    return True
                following, at = packet[at], at + 8
            elif following in {0, 43, 60}:
                following, at = packet[at], at + 8 * (packet[at + 1] + 1)
        if following != 17:
            return False
    else:
        return False
    return not ports or half(at) in ports or half(at + 2) in ports


def expect(link_type, packet, ports, protocol=0):
    try:
        return wanted(link_type, packet, ports, protocol)
    except IndexError:
        return False


def udp(source, destination, body=b"hello"):
    return struct.pack(">HHHH", source, destination, 8 + len(body), 0) + body


def ipv4(payload, *, protocol=17, flags=0, options=b""):
    header = struct.pack(
        ">BBHHHBBH4s4s",
        0x45 + len(options) // 4,
        0,
        20 + len(options) + len(payload),
        1,
        flags,
        64,
        protocol,
        0,
        b"\x7f\0\0\1",
        b"\x7f\0\0\1",
    )
    return header + options + payload


def ipv6(payload, following=17):
    return struct.pack(">IHBB", 0x60000000, len(payload), following, 64) + bytes(32) + payload


def extended(payload, headers):
    """An IPv6 packet with extension headers: (type, 8-byte units beyond the first, fragment offset)."""
    following = 17
    for kind, units, offset in reversed(headers):
        if kind == 44:
            payload = struct.pack(">BBHI", following, 0, offset << 3, 7) + payload
        else:
            payload = bytes([following, units]) + bytes(6 + 8 * units) + payload
        following = kind
    return ipv6(payload, following)


def ethernet(payload, kind=0x0800, tags=()):
    return (
        bytes(12) + b"".join(struct.pack(">HH", tag, 5) for tag in tags) + struct.pack(">H", kind) + payload
    )


def error(quoted, kind=3, code=3):
    return bytes([kind, code]) + bytes(6) + quoted


KEPT = {
    "error": ethernet(ipv4(error(ipv4(udp(9, 1234))), protocol=1)),
    "error, answered": ethernet(ipv4(error(ipv4(udp(1235, 9))), protocol=1)),
    "error, no host": ethernet(ipv4(error(ipv4(udp(9, 1234)), code=1), protocol=1)),
    "error behind options": ethernet(ipv4(error(ipv4(udp(9, 1234))), protocol=1, options=bytes(8))),
    "error about 8 bytes": ethernet(ipv4(error(ipv4(udp(9, 1234))[:28]), protocol=1)),
    "error about a first fragment": ethernet(ipv4(error(ipv4(udp(9, 1234), flags=0x2000)), protocol=1)),
    "tagged error": ethernet(ipv4(error(ipv4(udp(9, 1234))), protocol=1), tags=[0x8100]),
    "time exceeded": ethernet(ipv4(error(ipv4(udp(9, 1234)), 11, 1), protocol=1)),
    "v6 too big": ethernet(ipv6(error(ipv6(udp(9, 1234)), 2, 0), 58), 0x86DD),
    "v6 time exceeded": ethernet(ipv6(error(ipv6(udp(9, 1234)), 3, 1), 58), 0x86DD),
    "v6 error": ethernet(ipv6(error(ipv6(udp(9, 1234)), 1, 4), 58), 0x86DD),
    "destination": ethernet(ipv4(udp(9, 1234))),
    "source": ethernet(ipv4(udp(1234, 9))),
    "options": ethernet(ipv4(udp(9, 1235), options=bytes(8))),
    "in a range": ethernet(ipv4(udp(2235, 9))),
    "first fragment": ethernet(ipv4(udp(9, 1234), flags=0x2000)),
    "later fragment": ethernet(ipv4(b"anything", flags=0x00B9)),
    "one tag": ethernet(ipv4(udp(9, 1234)), tags=[0x8100]),
    "two tags": ethernet(ipv4(udp(9, 1234)), tags=[0x88A8, 0x8100]),
    "tagged v6": ethernet(ipv6(udp(9, 1234)), 0x86DD, tags=[0x8100]),
    "v6": ethernet(ipv6(udp(9, 1234)), 0x86DD),
    "v6 options": ethernet(extended(udp(9, 1234), [(0, 0, 0), (60, 2, 0), (43, 1, 0)]), 0x86DD),
    "v6 first fragment": ethernet(extended(udp(9, 1234), [(44, 0, 0)]), 0x86DD),
    "v6 later fragment": ethernet(extended(b"x", [(44, 0, 185)]), 0x86DD),
}
DROPPED = {
    "other ports": ethernet(ipv4(udp(9, 10))),
    "echo": ethernet(ipv4(error(ipv4(udp(9, 1234)), 8), protocol=1)),
    "redirect": ethernet(ipv4(error(ipv4(udp(9, 1234)), 5), protocol=1)),
    "error about tcp": ethernet(ipv4(error(ipv4(udp(9, 1234), protocol=6)), protocol=1)),
    "error about a later fragment": ethernet(ipv4(error(ipv4(udp(9, 1234), flags=0xB9)), protocol=1)),
    "error about options": ethernet(ipv4(error(ipv4(udp(9, 1234), options=bytes(4))), protocol=1)),
    "error cut before the ports": ethernet(ipv4(error(ipv4(udp(9, 1234))[:20]), protocol=1)),
    "later fragment of an error": ethernet(ipv4(error(ipv4(udp(9, 1234))), protocol=1, flags=0xB9)),
    "v6 error, other kind": ethernet(ipv6(error(ipv6(udp(9, 1234)), 4), 58), 0x86DD),
    "v6 error about tcp": ethernet(ipv6(error(ipv6(udp(9, 1234), 6), 1), 58), 0x86DD),
    "v4 error in v6": ethernet(ipv6(error(ipv4(udp(9, 1234))), 1), 0x86DD),
    "tcp": ethernet(ipv4(udp(1234, 1234), protocol=6)),
    "tcp fragment": ethernet(ipv4(b"anything", protocol=6, flags=0x00B9)),
    "arp": ethernet(bytes(28), 0x0806),
    "three tags": ethernet(ipv4(udp(9, 1234)), tags=[0x8100] * 3),
    "v6 tcp": ethernet(ipv6(udp(1234, 1234), 6), 0x86DD),
    "v6 five extensions": ethernet(extended(udp(9, 1234), [(60, 0, 0)] * 5), 0x86DD),
    "v6 first fragment, other port": ethernet(extended(udp(9, 10), [(44, 0, 0)]), 0x86DD),
    "cut before the ports": ethernet(ipv4(b"\x04")),
    "empty": b"",
}
PORTS = {1234, 1235, 2234, 2235, 2236}


@pytest.mark.parametrize("name", KEPT)
def test_what_is_kept(name):
    assert expect(bpf.ETHERNET, KEPT[name], PORTS)
    assert run(bpf.port_filter(bpf.ETHERNET, PORTS), KEPT[name]) == SNAP
    assert run(bpf.port_filter(bpf.ETHERNET), KEPT[name]) == SNAP


@pytest.mark.parametrize("name", DROPPED)
def test_what_is_dropped(name):
    assert not expect(bpf.ETHERNET, DROPPED[name], PORTS)
    assert run(bpf.port_filter(bpf.ETHERNET, PORTS), DROPPED[name]) == 0


@pytest.mark.parametrize("link_type", [bpf.ETHERNET, bpf.RAW])
def test_what_begins_so_is_kept_on_any_port(link_type):
    program = bpf.port_filter(link_type, PORTS, streams=[80], begins=[b"RTPS"])
    for internet, kind in ((ipv4, 0x0800), (ipv6, 0x86DD)):
        for port, body, kept in (
            (7, b"RTPS", True),
            (7, b"RTPS and more", True),
            (7, b"RTPX and more", False),
            (7, b"RTP", False),
            (7, b" RTPS", False),
            (1234, b"", True),
        ):
            packet = internet(udp(9, port, body))
            frame = ethernet(packet, kind) if link_type == bpf.ETHERNET else packet
            assert run(program, frame) == (SNAP if kept else 0)
        segment = internet(udp(9, 7, b"RTPS"), protocol=6) if kind == 0x0800 else ipv6(udp(9, 7, b"RTPS"), 6)
        assert run(program, ethernet(segment, kind) if link_type == bpf.ETHERNET else segment) == 0


@pytest.mark.parametrize("name", ["error", "v6 error"])
def test_errors_beside_streams(name):
    program = bpf.port_filter(bpf.ETHERNET, PORTS, streams=[80])
    assert run(program, KEPT[name]) == SNAP
    assert run(program, DROPPED["error about tcp"]) == 0
    assert run(bpf.port_filter(bpf.ETHERNET, [7], streams=[1234]), KEPT[name]) == 0


def test_no_ports_is_every_datagram():
    program = bpf.port_filter(bpf.ETHERNET)
    assert run(program, DROPPED["other ports"]) == SNAP
    assert run(program, DROPPED["tcp"]) == 0


def test_raw_and_cooked_look_at_the_ip_header_first():
    for packet, protocol in ((ipv4(udp(9, 1234)), 0x0800), (ipv6(udp(9, 1234)), 0x86DD)):
        assert run(bpf.port_filter(bpf.RAW, PORTS), packet) == SNAP
        assert run(bpf.port_filter(bpf.LINUX_SLL2, PORTS), packet, protocol=protocol) == SNAP
        assert run(bpf.port_filter(bpf.LINUX_SLL2, PORTS), packet, protocol=0x0806) == 0
    inner = struct.pack(">HH", 5, 0x0800) + ipv4(udp(9, 1234))
    assert run(bpf.port_filter(bpf.LINUX_SLL2, PORTS), inner, protocol=0x8100) == SNAP


@pytest.mark.parametrize("hardware_type", bpf.ETHERNET_TYPES)
@pytest.mark.parametrize("name", [*KEPT, *DROPPED])
def test_of_all_interfaces_with_their_headers_ethernet(name, hardware_type):
    """Tags that stand in the frame are looked behind; the protocol is the one in the frame."""
    program, packet = bpf.port_filter(bpf.LINUX_SLL2, PORTS, whole=True), (KEPT | DROPPED)[name]
    assert run(program, packet, hardware_type=hardware_type) == (SNAP if name in KEPT else 0)


@pytest.mark.parametrize("network", [0, 4, 16])
def test_of_all_interfaces_with_their_headers_others(network):
    program = bpf.port_filter(bpf.LINUX_SLL2, PORTS, whole=True)
    for packet, protocol in ((ipv4(udp(9, 1234)), 0x0800), (extended(udp(9, 1234), [(60, 1, 0)]), 0x86DD)):
        given = {"hardware_type": 512, "network": network, "protocol": protocol}
        assert run(program, bytes(network) + packet, **given) == SNAP
        assert run(program, bytes(network) + packet, **given | {"protocol": 0x0806}) == 0
    other = bytes(network) + ipv4(udp(9, 10))
    assert run(program, other, hardware_type=512, network=network, protocol=0x0800) == 0


def test_snap_length_is_the_verdict():
    assert run(bpf.port_filter(bpf.ETHERNET, PORTS, snap_length=96), KEPT["destination"]) == 96


@pytest.mark.parametrize(("packet_type", "interface", "kept"), [(4, 1, False), (0, 1, True), (4, 2, True)])
def test_loopback_is_seen_once(packet_type, interface, kept):
    program = bpf.port_filter(bpf.LINUX_SLL2, PORTS, loopback=1)
    packet = ipv4(udp(9, 1234))
    verdict = run(program, packet, protocol=0x0800, packet_type=packet_type, interface=interface)
    assert bool(verdict) is kept


@pytest.mark.parametrize("port", [-1, 65536, 70000])
def test_a_number_that_is_no_port(port):
    with pytest.raises(CaptureError, match=f"{port} is not a UDP or TCP port"):
        bpf.port_filter(bpf.ETHERNET, [1234, port])


def test_many_ports():
    apart = set(range(1, 1800, 2))
    program = bpf.port_filter(bpf.ETHERNET, apart)
    assert len(program) <= bpf.MAXIMUM_INSTRUCTIONS
    for port in (1, 2, 999, 1000, 1799, 1800):
        assert bool(run(program, ethernet(ipv4(udp(60000, port))))) is (port in apart)
    with pytest.raises(CaptureError, match="name fewer ports"):
        bpf.port_filter(bpf.ETHERNET, range(1, 4000, 2))
    assert len(bpf.port_filter(bpf.ETHERNET, range(65536))) < 200


LINK_TYPES = st.sampled_from([bpf.ETHERNET, bpf.RAW, bpf.LINUX_SLL2])
PROTOCOLS = st.sampled_from([0x0800, 0x86DD, 0x8100, 0x88A8, 0x0806])
PORT_SETS = st.sets(st.integers(0, 65535) | st.integers(1230, 1240), max_size=12)
PORT = st.integers(1230, 1240) | st.integers(0, 65535)
EXTENSIONS = st.lists(
    st.tuples(st.sampled_from([0, 43, 44, 60]), st.integers(0, 3), st.sampled_from([0, 0, 0, 1, 185])),
    max_size=6,
)


@st.composite
def packets(draw):
    datagram = udp(draw(PORT), draw(PORT))
    about = draw(st.sampled_from([None, None, ipv4, ipv6]))
    if about is not None:
        quoted = about(
            datagram, **({"flags": draw(st.sampled_from([0, 0x2000, 1]))} if about is ipv4 else {})
        )
        datagram = error(quoted, draw(st.sampled_from([1, 2, 3, 3, 8, 11])), draw(st.integers(0, 4)))
    if about is ipv6:
        kind, packet = 0x86DD, ipv6(datagram, draw(st.sampled_from([58, 58, 1])))
    elif about is ipv4 or draw(st.booleans()):
        kind, packet = (
            0x0800,
            ipv4(
                datagram,
                protocol=draw(st.sampled_from([17, 17, 6] if about is None else [1, 1, 58])),
                flags=draw(st.sampled_from([0, 0x4000, 0x2000, 1, 0x20B9])),
                options=bytes(4 * draw(st.integers(0, 10))),
            ),
        )
    else:
        kind, packet = 0x86DD, extended(datagram, draw(EXTENSIONS))
    tags = draw(st.lists(st.sampled_from([0x8100, 0x88A8, 0x9100]), max_size=3))
    packet = ethernet(packet, kind, tags)
    return packet[: draw(st.integers(0, len(packet)))] if draw(st.booleans()) else packet


@given(packets(), PORT_SETS)
def test_the_program_does_what_it_promises(packet, ports):
    assert bool(run(bpf.port_filter(bpf.ETHERNET, ports), packet)) is expect(bpf.ETHERNET, packet, ports)


@given(LINK_TYPES, st.binary(max_size=120), PORT_SETS, PROTOCOLS)
def test_garbage_has_a_verdict(link_type, packet, ports, protocol):
    program = bpf.port_filter(link_type, ports)
    verdict = run(program, packet, protocol=protocol)
    assert bool(verdict) is expect(link_type, packet, ports, protocol)


@given(LINK_TYPES, PORT_SETS, st.none() | st.just(1))
def test_the_kernel_takes_the_program(link_type, ports, loopback):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
        bpf.attach_program(any_socket, bpf.port_filter(link_type, ports, loopback=loopback))


@pytest.fixture(scope="module")
def pair():
    left, right = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    right.setblocking(False)
    with left, right:
        yield left, right


@given(packets(), PORT_SETS)
def test_the_kernel_agrees(pair, packet, ports):
    # A Unix datagram socket runs its filter on exactly the bytes that were sent.
    left, right = pair
    bpf.attach_program(right, bpf.port_filter(bpf.ETHERNET, ports))
    left.send(packet)
    try:
        seen = right.recv(65536)
    except BlockingIOError:
        seen = None
    assert (seen is not None) is expect(bpf.ETHERNET, packet, ports)
    assert seen in {None, packet}
