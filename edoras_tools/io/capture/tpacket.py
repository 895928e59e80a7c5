"""Reads blocks of a TPACKET_V3 ring, in the kernel's layout, into frames.

A block starts with a descriptor, followed by a chain of packets, each with its own header
(``linux/if_packet.h``: ``tpacket_block_desc``, ``tpacket3_hdr``, ``sockaddr_ll``); all in native byte order::

    block:   0 version  4 offset_to_priv  8 block_status  12 num_pkts  16 offset_to_first_pkt  20 blk_len
    packet:  0 next_offset  4 sec  8 nsec  12 snaplen  16 len  20 status  24 mac(2)  26 net(2)
             28 rxhash  32 vlan_tci  36 vlan_tpid(2)  48 sockaddr_ll(20)  ... mac: the frame

There is space between the ``sockaddr_ll`` and the frame. A VLAN tag that the kernel removed, or a cooked
header that it did not write, is written there, so that frames need not be moved. (A cooked header has no
field for a tag, so the tag is left out.) A cooked header replaces an existing link layer header.

Frames that contain many UDP datagrams at once are cut into the frames that are sent on the wire. With UDP
segmentation offload a program passes many datagrams of one size to the kernel as one (``UDP_SEGMENT``), and a
capture on the sending machine sees them before they are separated: one frame, larger than any on the link.
The frame does not contain the size of its parts; the kernel reports it separately (``virtio_net_hdr``).
``cut`` does what the kernel does (``__udp_gso_segment``): each part has its own lengths, IPv4 identification
and checksums.
"""

from __future__ import annotations

import math
import struct
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from msgspec.structs import replace

from edoras_tools.io.capture.bpf import ETHERNET, LINUX_SLL2
from edoras_tools.io.frames.frame_batch import FrameBatch, internet_checksum, walk_records
from edoras_tools.io.frames.linklayer import demux, network_headers
from edoras_tools.model import Finding
from edoras_tools.wire.arrays import PADDING, Integers, Mask, Octets, read_at

if TYPE_CHECKING:
    from numpy.typing import NDArray


_UDP: Final = 17
_UDP_BYTES: Final = 8


def cut(frames: FrameBatch, size: NDArray[np.integer[Any]], header: NDArray[np.integer[Any]]) -> FrameBatch:
    """Return frames of one datagram each; numbers continue from the first frame's.

    Args:
        size: payload bytes of each part, integer (n,); 0 for a frame that is not cut.
        header: bytes from the IP header to the UDP header whose payload is cut, integer (n,); in a tunnel
            from the inner IP header, and the headers before it are repeated.
    """
    rows = np.flatnonzero(size)
    if not len(rows):
        return frames
    batch = demux(
        FrameBatch(
            frames.data,
            rows.astype(np.int64),  # frames without UDP are left out; the others are identified by their row
            frames.time_ns[rows],
            frames.link_type[rows],
            frames.offset[rows],
            frames.length[rows],
            frames.original_length[rows],
        )
    )
    headers = zip(
        batch.number.tolist(), network_headers(batch)[0].tolist(), batch.offset.tolist(), strict=True
    )
    parts: dict[int, list[tuple[bytes, int]]] = {}
    for (row, network, payload), findings in zip(headers, batch.capture_findings.tolist(), strict=True):
        if not findings & Finding.FRAGMENT and payload - _UDP_BYTES - network == header[row]:
            start, end = int(frames.offset[row]), int(frames.offset[row] + frames.length[row])
            whole = start + int(frames.original_length[row]) - payload
            frame = frames.data[start:end].tobytes()
            parts[row] = _parts(frame, network - start, payload - start, int(size[row]), whole)
    return _put(frames, {row: pieces for row, pieces in parts.items() if len(pieces) > 1})


def _parts(frame: bytes, network: int, payload: int, size: int, whole: int) -> list[tuple[bytes, int]]:
    """Return the frames into which a frame is cut, each with its captured bytes and its length on the wire.

    Args:
        frame: captured bytes.
        network: start of the IP header.
        payload: start of the UDP payload.
        size: payload bytes of a part.
        whole: payload bytes in total, captured or not.
    """
    pieces = []
    four = frame[network] >> 4 == 4
    addresses = frame[network + 12 : network + 20] if four else frame[network + 8 : network + 40]
    for number, at in enumerate(range(0, whole, size)):
        length = min(size, whole - at)
        body, header = frame[payload + at : payload + at + length], bytearray(frame[:payload])
        if four:
            (identification,) = struct.unpack_from(">H", frame, network + 4)
            struct.pack_into(
                ">HH", header, network + 2, payload - network + length, (identification + number) & 0xFFFF
            )
            struct.pack_into(">H", header, network + 10, 0)
            words = header[network : network + 4 * (frame[network] & 15)]
            struct.pack_into(">H", header, network + 10, _checksum(bytes(words)))
        else:
            struct.pack_into(">H", header, network + 4, payload - network - 40 + length)
        udp = payload - _UDP_BYTES
        struct.pack_into(">HH", header, udp + 4, _UDP_BYTES + length, 0)
        if len(body) == length:  # else the checksum is unknown; 0 means that there is none
            pseudo = addresses + struct.pack(">HH", _UDP, _UDP_BYTES + length)
            value = _checksum(pseudo + bytes(header[udp:]) + body) or 0xFFFF
            struct.pack_into(">H", header, udp + 6, value)
        pieces.append((bytes(header) + body, payload + length))
    return pieces


def _put(frames: FrameBatch, parts: dict[int, list[tuple[bytes, int]]]) -> FrameBatch:
    """Replace frames by their parts."""
    count = np.ones(len(frames), np.int64)
    count[list(parts)] = [len(pieces) for pieces in parts.values()]
    row = np.repeat(np.arange(len(frames)), count)
    first = np.cumsum(count) - count
    offset, length, original = frames.offset[row], frames.length[row], frames.original_length[row]
    data, used = [frames.data], frames.data.size
    for place, pieces in parts.items():
        span = slice(int(first[place]), int(first[place]) + len(pieces))
        length[span] = [len(frame) for frame, _ in pieces]
        original[span] = [wire for _, wire in pieces]
        offset[span] = used + np.cumsum(length[span]) - length[span]
        used += int(length[span].sum())
        data += [np.frombuffer(frame, np.uint8) for frame, _ in pieces]
    return replace(
        frames,
        data=np.concatenate([*data, np.zeros(PADDING, np.uint8)]),
        number=frames.number[0] + np.arange(len(row)) if len(row) else frames.number,
        time_ns=frames.time_ns[row],
        link_type=frames.link_type[row],
        offset=offset,
        length=length,
        original_length=original,
    )


def _checksum(octets: bytes) -> int:
    words = np.frombuffer(octets + bytes(len(octets) % 2), ">u2")
    return int(internet_checksum(words.sum(dtype=np.int64)))


BLOCK_HEADER: Final = 48
"""Bytes of a block's descriptor."""
ALIGNMENT: Final = 8
"""V3_ALIGNMENT: packets start at multiples of this."""

VNET_HEADER: Final = np.dtype(
    [
        ("flags", "u1"),
        ("gso_type", "u1"),
        ("hdr_len", "u2"),
        ("gso_size", "u2"),
        ("csum_start", "u2"),
        ("csum_offset", "u2"),
    ]
)
"""``virtio_net_hdr``, directly before the frame, in native byte order."""
_UDP_SEGMENTS: Final = 5
"""VIRTIO_NET_HDR_GSO_UDP_L4."""
_VLAN_VALID: Final = 1 << 4
_VLAN_TPID_VALID: Final = 1 << 6
_DOT1Q: Final = 0x8100
_TAG_TYPES: Final = (_DOT1Q, 0x88A8, 0x9100)
_TAG: Final = 4
_ADDRESSES: Final = 12
_SOCKADDR: Final = 48
_SLL2_LENGTH: Final = 20
_ETHERNET_LENGTH: Final = 14
_STEPS: Final = 12
"""Most packets between two seeds; the parts of the chain between seeds are walked side by side."""
# Offset of each byte of an SLL2 header in a little-endian sockaddr_ll: protocol, 2 reserved bytes,
# interface index, ARPHRD type, packet type, address length, address; _NOTHING means 0.
_NOTHING: Final = 255
_LITTLE: Final = (2, 3, _NOTHING, _NOTHING, 7, 6, 5, 4, 9, 8, 10, 11, 12, 13, 14, 15, 16, 17, 18, 19)
_BIG: Final = (2, 3, _NOTHING, _NOTHING, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16, 17, 18, 19)


class PacketRun(NamedTuple):
    """Consecutive packets of one block, as copied from the ring.

    Attributes:
        first: offset of the first packet's header, a multiple of ``ALIGNMENT``.
        end: one past the last byte copied; it may be beyond the last packet.
        packets: number of packets.
    """

    first: int
    end: int
    packets: int


def packet_heads(data: Octets, runs: Sequence[PacketRun]) -> Integers:
    """Return the offsets of the headers of all packets of some runs, in order.

    Args:
        data: the buffer of the runs, with at least ``framing.PADDING`` bytes after them.
        runs: at least one.
    """
    words, halves = data.view(np.uint32), data.view(np.uint16)
    head, end = runs[0].first, runs[-1].end
    firsts = np.array([run.first for run in runs])
    beyond = np.append(firsts[1:], end)  # all runs form one chain, whose parts are walked side by side

    def successor(at: Integers) -> Integers:
        following = words[at // 4]
        after: Integers = at + following
        if not following.all():  # the last packet of a closed block has no next
            last = np.flatnonzero(following == 0)
            after[last] = beyond[np.searchsorted(firsts, at[last], "right") - 1]
        return after

    def step(at: int) -> int:
        following = int(words[at // 4])
        return at + following if following else int(beyond[np.searchsorted(firsts, at, "right") - 1])

    # The distance from header to frame is equal for nearly all packets, so it is a good sign of a header.
    signs = halves[head // 2 + 12 : end // 2 : ALIGNMENT // 2]
    alike = np.flatnonzero(signs == signs[:1])
    count = sum(run.packets for run in runs)
    seeds = head + alike[:: max(1, min(math.isqrt(count), _STEPS))] * ALIGNMENT
    return walk_records(head, end, seeds, successor, step)[0][:count]


def behind(data: Octets, head: int) -> int:
    """Return the distance from this packet's header to the next one; 0 for the last of a closed block."""
    return int(data.view(np.uint32)[head // 4])


def frames(
    data: Octets, heads: Integers, link_type: int, number: int, *, described: bool = False
) -> FrameBatch:
    """Read packets into frames.

    Args:
        data: the bytes copied from the ring; tags and cooked headers are written into it.
        heads: offsets of the packets' headers.
        link_type: LINKTYPE of the frames; ``LINUX_SLL2`` for a socket of all interfaces.
        number: number of the first frame.
        described: whether the kernel describes each packet (``PACKET_VNET_HDR``): one that contains several
            datagrams is split into them.

    Returns:
        The frames, over ``data`` except for those that were split.
    """
    # Headers are aligned, so every field is an element of a view on the whole buffer.
    words, halves = data.view(np.uint32), data.view(np.uint16)
    word, half = heads // 4, heads // 2
    offset = heads + halves[half + 12]
    captured = words[word + 3].astype(np.int32)
    original = words[word + 4].astype(np.int32)
    status = words[word + 5]
    time_ns = words[word + 1] * np.int64(1_000_000_000) + words[word + 2]
    link_bytes = halves[half + 13].astype(np.int64) - halves[half + 12]
    added = np.zeros(len(heads), dtype=np.int32)
    beside = read_at(data, offset - VNET_HEADER.itemsize, VNET_HEADER) if described else None
    if link_type == ETHERNET:
        rows = np.flatnonzero(status & _VLAN_VALID)
        if len(rows):
            _insert_tags(data, words, halves, heads[rows], offset[rows], status[rows])
            added[rows] = _TAG
    elif link_type == LINUX_SLL2:
        _insert_cooked(data, heads, offset + link_bytes, tagged=link_bytes > _ETHERNET_LENGTH)
        added = (_SLL2_LENGTH - link_bytes).astype(np.int32)
    batch = FrameBatch(
        data=data,
        number=np.arange(number, number + len(heads), dtype=np.int64),
        time_ns=time_ns,
        link_type=np.full(len(heads), link_type, dtype=np.uint16),
        offset=offset - added,
        length=np.maximum(captured + added, 0),
        original_length=original + added,
    )
    if beside is None or not (many := beside["gso_type"] == _UDP_SEGMENTS).any():
        return batch
    return cut(batch, beside["gso_size"] * many, beside["csum_start"] - link_bytes)


def _insert_tags(
    data: Octets,
    words: NDArray[np.uint32],
    halves: NDArray[np.uint16],
    heads: Integers,
    offset: Integers,
    status: NDArray[np.uint32],
) -> None:
    """Put the VLAN tags back to their place on the wire, after the addresses (IEEE 802.1Q clause 9)."""
    tag = np.empty((len(heads), 2), dtype=">u2")
    tag[:, 0] = np.where(status & _VLAN_TPID_VALID, halves[heads // 2 + 18], _DOT1Q)
    tag[:, 1] = words[heads // 4 + 8]
    addresses = data[offset[:, None] + np.arange(_ADDRESSES)]
    start = (offset - _TAG)[:, None]
    data[start + np.arange(_ADDRESSES)] = addresses
    data[start + np.arange(_ADDRESSES, _ADDRESSES + _TAG)] = tag.view(np.uint8)


def _insert_cooked(data: Octets, heads: Integers, offset: Integers, *, tagged: Mask) -> None:
    """Write LINKTYPE_LINUX_SLL2 headers before the packets, from the address that the kernel stored.

    Args:
        data: written into.
        heads: offsets of the packets' headers.
        offset: offsets of their network headers.
        tagged: whether a link layer header has VLAN tags, which are removed with it: the type is
            the one after them.
    """
    places = np.array(_LITTLE if sys.byteorder == "little" else _BIG)
    headers = data[heads[:, None] + _SOCKADDR + np.minimum(places, _SLL2_LENGTH - 1)]
    headers[:, places == _NOTHING] = 0
    rows = np.flatnonzero(tagged & np.isin(headers[:, 0] * np.uint16(256) + headers[:, 1], _TAG_TYPES))
    headers[rows, :2] = data[offset[rows, None] + np.array([-2, -1])]
    data[(offset - _SLL2_LENGTH)[:, None] + np.arange(_SLL2_LENGTH)] = headers
