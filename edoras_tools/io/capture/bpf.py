"""The kernel's packet filter: classic BPF programs that keep UDP datagrams and TCP segments by port.

ICMP errors that quote such a datagram are kept, too.

A packet that the filter refuses never reaches the ring, so it costs neither memory nor a copy. The machine is
that of McCanne and Jacobson, "The BSD Packet Filter" (1993), with Linux's ancillary loads
(``Documentation/networking/filter.rst``): an accumulator A, an index register X, sixteen words of memory,
only forward jumps. A load past the end of the packet ends the program with "drop".
"""

from __future__ import annotations

import ctypes
import socket
import struct
from collections.abc import Iterable, Iterator, Sequence
from typing import Final, NamedTuple

from edoras_tools.errors import CaptureError
from edoras_tools.io.frames.frame_batch import LINKTYPE_RAW
from edoras_tools.links import icmp

ETHERNET: Final = 1
"""LINKTYPE_ETHERNET."""
RAW: Final = LINKTYPE_RAW
"""LINKTYPE_RAW: the packet starts with its IP header."""
LINUX_SLL2: Final = 276
"""LINKTYPE_LINUX_SLL2: frames of any interface, their own link layer header replaced by a cooked one."""

LD_W: Final = 0x20
LD_H: Final = 0x28
LD_W_X: Final = 0x40
LD_B_X: Final = 0x50
LD_H_X: Final = 0x48
LD_B: Final = 0x30
LD_MEM: Final = 0x60
LDX_IMM: Final = 0x01
ST: Final = 0x02
ADD_K: Final = 0x04
ADD_X: Final = 0x0C
AND_K: Final = 0x54
LSH_K: Final = 0x64
JA: Final = 0x05
JEQ: Final = 0x15
JGT: Final = 0x25
JGE: Final = 0x35
JSET: Final = 0x45
RET: Final = 0x06
TAX: Final = 0x07
TXA: Final = 0x87

ANCILLARY_PROTOCOL: Final = 0xFFFFF000
"""SKF_AD_OFF + SKF_AD_PROTOCOL: the packet's EtherType."""
ANCILLARY_PACKET_TYPE: Final = 0xFFFFF004
"""SKF_AD_OFF + SKF_AD_PKTTYPE: whom the packet is for."""
ANCILLARY_INTERFACE: Final = 0xFFFFF008
"""SKF_AD_OFF + SKF_AD_IFINDEX."""
ANCILLARY_HARDWARE_TYPE: Final = 0xFFFFF01C
"""SKF_AD_OFF + SKF_AD_HATYPE: the interface's ARPHRD type."""
NETWORK: Final = 0xFFF00000
"""SKF_NET_OFF: offsets from here on count from the network header, wherever that is."""
ETHERNET_TYPES: Final = (1, 772)
"""ARPHRD types with Ethernet headers: ETHER, LOOPBACK."""
PACKET_OUTGOING: Final = 4

MAXIMUM_INSTRUCTIONS: Final = 4096
"""BPF_MAXINSNS: the kernel's maximum."""
MAXIMUM_TAGS: Final = 2
"""VLAN tags that the filter skips."""
MAXIMUM_EXTENSIONS: Final = 4
"""IPv6 extension headers that the filter skips."""

_SO_ATTACH_FILTER: Final = 26
_VLAN_TYPES: Final = (0x8100, 0x88A8, 0x9100)
_IPV4, _IPV6 = 0x0800, 0x86DD
_UDP, _TCP, _FRAGMENT = 17, 6, 44
_UDP_BYTES: Final = 8
_EXTENSIONS: Final = (0, 43, 60)  # hop-by-hop options, routing, destination options (RFC 8200 section 4)


class Instruction(NamedTuple):
    """One ``struct sock_filter``.

    Attributes:
        code: the operation.
        then: instructions to skip if a test holds.
        otherwise: instructions to skip if it does not hold.
        k: the operand.
    """

    code: int
    then: int
    otherwise: int
    k: int


NOTHING: Final = (Instruction(RET, 0, 0, 0),)
"""The program that drops every packet."""


class Assembler:
    """Builds a program with labels for jumps."""

    def __init__(self) -> None:
        self._lines: list[tuple[int, int, str, str]] = []
        self._labels: dict[str, int] = {}

    def emit(self, code: int, k: int = 0) -> None:
        """Append an instruction without a jump."""
        self._lines.append((code, k, "", ""))

    def test(self, code: int, k: int, then: str = "", otherwise: str = "") -> None:
        """Append a jump; an empty label means the next instruction; ``JA`` jumps to ``then``."""
        self._lines.append((code, k, then, otherwise))

    def label(self, name: str) -> None:
        """Name the next instruction."""
        self._labels[name] = len(self._lines)

    def assemble(self) -> tuple[Instruction, ...]:
        """Return the program, with labels resolved.

        Raises:
            CaptureError: it has more instructions than the kernel accepts.
        """
        if len(self._lines) > MAXIMUM_INSTRUCTIONS:
            raise CaptureError(
                f"the port filter needs {len(self._lines)} instructions and the kernel accepts "
                f"{MAXIMUM_INSTRUCTIONS}: name fewer ports, or none to capture every UDP datagram"
            )
        return tuple(self._resolve())

    def _resolve(self) -> Iterator[Instruction]:
        for place, (code, k, then, otherwise) in enumerate(self._lines, 1):
            skips = [self._labels[name] - place if name else 0 for name in (then, otherwise)]
            if code == JA:
                yield Instruction(code, 0, 0, skips[0])
            else:
                assert all(0 <= skip < 256 for skip in skips), "a conditional jump reaches 255 instructions"
                yield Instruction(code, skips[0], skips[1], k)


def port_filter(
    link_type: int,
    ports: Iterable[int] = (),
    *,
    streams: Iterable[int] = (),
    begins: Sequence[bytes] = (),
    snap_length: int = 262144,
    loopback: int | None = None,
    whole: bool = False,
) -> tuple[Instruction, ...]:
    """Build the program that keeps UDP datagrams, and TCP segments, from or to some ports.

    It keeps UDP over IPv4 or IPv6, after at most ``MAXIMUM_TAGS`` VLAN tags and ``MAXIMUM_EXTENSIONS`` IPv6
    extension headers, if the source or destination port is in the set. A first fragment is judged by its
    ports; later fragments have none and are kept. ICMP errors are judged by the datagram that they quote.

    Args:
        link_type: ``ETHERNET``, ``RAW`` or ``LINUX_SLL2``.
        ports: UDP ports; if empty, every UDP datagram is kept.
        streams: TCP ports; if empty, no TCP segment is kept.
        begins: datagrams that begin with these four bytes are kept on any port.
        snap_length: bytes of each packet to capture.
        loopback: index of the loopback interface; its outgoing packets are dropped, because they come in
            again.
        whole: ``LINUX_SLL2``: the socket gives frames with their link layer headers.

    Raises:
        CaptureError: a port is not a UDP or TCP port, or there are too many of them.
    """
    program = Assembler()
    if loopback is not None:
        program.emit(LD_W, ANCILLARY_PACKET_TYPE)
        program.test(JEQ, PACKET_OUTGOING, otherwise="link")
        program.emit(LD_W, ANCILLARY_INTERFACE)
        program.test(JEQ, loopback, otherwise="link")
        program.emit(RET, 0)
        program.label("link")
    if link_type == ETHERNET:
        program.emit(LD_H, 12)
        _ethertype(program, 14)
    elif link_type == LINUX_SLL2:
        if whole:
            program.emit(LD_W, ANCILLARY_HARDWARE_TYPE)
            for kind in ETHERNET_TYPES:
                program.test(JEQ, kind, then="ethernet")
        program.emit(LD_W, ANCILLARY_PROTOCOL)
        _ethertype(program, NETWORK if whole else 0)
        if whole:
            program.label("ethernet")
            program.emit(LD_H, 12)
            _ethertype(program, 14, "ethernet ")
    else:
        program.emit(LDX_IMM, 0)
        program.emit(LD_B, 0)
        program.emit(AND_K, 0xF0)
        program.test(JEQ, 0x40, then="ipv4")
        program.test(JEQ, 0x60, then="ipv6")
        program.emit(RET, 0)
    segments = sorted(set(streams))
    protocols = (_UDP, _TCP) if segments else (_UDP,)
    _ipv4(program, snap_length, protocols)
    _ipv6(program, snap_length, protocols)
    program.label("transport")
    program.emit(LD_MEM, 0)
    for form in icmp.FORMS:
        program.test(JEQ, form.protocol, then=f"error {form.version}")
    if segments:
        program.test(JEQ, _TCP, then="tcp")
    program.test(JA, 0, then="udp")
    for form in icmp.FORMS:
        _quote(program, form)
    if segments:
        program.label("tcp")
        _ports(program, segments, snap_length, "tcp ")
    program.label("udp")
    _ports(program, sorted(set(ports)), snap_length, begins=begins)
    return program.assemble()


def pack(program: Iterable[Instruction]) -> bytes:
    """Return the program as an array of ``struct sock_filter``, in native byte order."""
    return b"".join(struct.pack("=HBBI", *instruction) for instruction in program)


def attach_program(target: socket.socket, program: Sequence[Instruction]) -> None:
    """Attach a program to a socket; it replaces the one that is attached.

    Raises:
        OSError: the kernel does not accept it.
    """
    packed = pack(program)
    # struct sock_fprog contains an address, which the socket module cannot pass.
    buffer = ctypes.create_string_buffer(packed, len(packed))
    argument = struct.pack("HP", len(program), ctypes.addressof(buffer))
    target.setsockopt(socket.SOL_SOCKET, _SO_ATTACH_FILTER, argument)


def _ethertype(program: Assembler, end: int, prefix: str = "") -> None:
    """Jump to the IP header by the EtherType in A; ``end`` is where the link layer header ends.

    ``prefix`` distinguishes the labels of two such parts.
    """
    for tags in range(MAXIMUM_TAGS + 1):
        program.emit(LDX_IMM, end + 4 * tags)
        program.test(JEQ, _IPV4, then="ipv4")
        program.test(JEQ, _IPV6, then="ipv6")
        if tags < MAXIMUM_TAGS:
            for tag in _VLAN_TYPES:
                program.test(JEQ, tag, then=f"{prefix}tag {tags}")
        program.emit(RET, 0)
        if tags < MAXIMUM_TAGS:
            program.label(f"{prefix}tag {tags}")
            program.emit(LD_H, end + 4 * tags + 2)


def _quote(program: Assembler, form: icmp.ErrorForm) -> None:
    """Move X from an ICMP message to the UDP header that it quotes; drop it if it quotes none."""
    program.label(f"error {form.version}")
    for layout, name, values in form.conditions():
        slot = layout.by_name[name]
        program.emit(LD_H_X if slot.end - slot.start == 2 else LD_B_X, form.start(layout) + slot.start)
        program.emit(AND_K, slot.mask << slot.shift)
        matched = f"quote {form.version} {name}"
        for value in values:
            program.test(JEQ, value << slot.shift, then=matched)
        program.emit(RET, 0)
        program.label(matched)
    program.emit(TXA)
    program.emit(ADD_K, form.start(icmp.QUOTED_UDP))
    program.emit(TAX)
    program.test(JA, 0, then="udp")


def _ipv4(program: Assembler, keep: int, protocols: Sequence[int]) -> None:
    """Move X from an IPv4 header to the transport header (RFC 791 section 3.1), its protocol to memory."""
    program.label("ipv4")
    program.emit(LD_B_X, 9)
    program.emit(ST, 0)
    for protocol in protocols:
        program.test(JEQ, protocol, then="ipv4 known")
    program.test(JEQ, icmp.FORMS[0].protocol, then="ipv4 error")
    program.emit(RET, 0)
    program.label("ipv4 error")
    program.emit(LD_H_X, 6)
    program.test(JSET, 0x1FFF, otherwise="ipv4 whole")
    program.emit(RET, 0)
    program.label("ipv4 known")
    program.emit(LD_H_X, 6)
    program.test(JSET, 0x1FFF, otherwise="ipv4 whole")
    program.emit(RET, keep)
    program.label("ipv4 whole")
    program.emit(LD_B_X, 0)
    program.emit(AND_K, 0x0F)
    program.emit(LSH_K, 2)
    program.emit(ADD_X)
    program.emit(TAX)
    program.test(JA, 0, then="transport")


def _ipv6(program: Assembler, keep: int, protocols: Sequence[int]) -> None:
    """Move X from an IPv6 header, over its extension headers, to the transport header (RFC 8200, 4)."""
    program.label("ipv6")
    program.emit(LD_B_X, 6)
    program.emit(ST, 0)
    program.emit(TXA)
    program.emit(ADD_K, 40)
    program.emit(TAX)
    program.emit(LD_MEM, 0)
    program.test(JEQ, icmp.FORMS[1].protocol, then="transport")
    for count in range(MAXIMUM_EXTENSIONS):
        for protocol in protocols:
            program.test(JEQ, protocol, then="transport")
        program.test(JEQ, _FRAGMENT, then=f"fragment {count}")
        for extension in _EXTENSIONS:
            program.test(JEQ, extension, then=f"extension {count}")
        program.emit(RET, 0)
        program.label(f"fragment {count}")
        program.emit(LD_H_X, 2)
        program.test(JSET, 0xFFF8, otherwise=f"first {count}")
        program.emit(RET, keep)
        program.label(f"first {count}")
        program.emit(LD_B_X, 0)
        program.emit(ST, 0)
        program.emit(TXA)
        program.emit(ADD_K, 8)
        program.test(JA, 0, then=f"next {count}")
        program.label(f"extension {count}")
        program.emit(LD_B_X, 0)
        program.emit(ST, 0)
        program.emit(LD_B_X, 1)
        program.emit(ADD_K, 1)
        program.emit(LSH_K, 3)
        program.emit(ADD_X)
        program.label(f"next {count}")
        program.emit(TAX)
        program.emit(LD_MEM, 0)
    for protocol in protocols:
        program.test(JEQ, protocol, then="transport")
    program.emit(RET, 0)


def _ports(
    program: Assembler, ports: list[int], keep: int, prefix: str = "", begins: Sequence[bytes] = ()
) -> None:
    """Return the verdict for the UDP or TCP header at X, which both begin with the ports.

    ``prefix`` distinguishes the labels of two such parts. A datagram that is too short for what it might
    begin with is dropped by the load itself, so that comes last.
    """
    if not ports:
        program.emit(RET, keep)
        return
    if not 0 <= ports[0] <= ports[-1] <= 0xFFFF:
        wrong = ports[0] if ports[0] < 0 else ports[-1]
        raise CaptureError(f"{wrong} is not a UDP or TCP port: 0 to 65535")
    for field in (0, 2):
        program.emit(LD_H_X, field)
        for first, last in _ranges(ports):
            # Each test has its own verdict: with many ports, a jump to a common one would be too long.
            name = f"{prefix}{field} {first}"
            if first == last:
                program.test(JEQ, first, otherwise=name)
            else:
                program.test(JGE, first, otherwise=name)
                program.test(JGT, last, then=name)
            program.emit(RET, keep)
            program.label(name)
    for word in begins:
        program.emit(LD_W_X, _UDP_BYTES)
        program.test(JEQ, int.from_bytes(word, "big"), otherwise=f"not {word!r}")
        program.emit(RET, keep)
        program.label(f"not {word!r}")
    program.emit(RET, 0)


def _ranges(ports: list[int]) -> Iterator[tuple[int, int]]:
    """Join sorted ports that are consecutive."""
    first = last = ports[0]
    for port in ports[1:]:
        if port != last + 1:
            yield first, last
            first = port
        last = port
    yield first, last
