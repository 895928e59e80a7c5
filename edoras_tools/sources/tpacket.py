"""Blocks of a TPACKET_V3 ring, as the kernel lays them out, read into frames.

A block starts with a descriptor and holds a chain of packets, each under a header of its own
(``linux/if_packet.h``: ``tpacket_block_desc``, ``tpacket3_hdr``, ``sockaddr_ll``); all in native byte order::

    block:   0 version  4 offset_to_priv  8 block_status  12 num_pkts  16 offset_to_first_pkt  20 blk_len
    packet:  0 next_offset  4 sec  8 nsec  12 snaplen  16 len  20 status  24 mac(2)  26 net(2)
             28 rxhash  32 vlan_tci  36 vlan_tpid(2)  48 sockaddr_ll(20)  ... mac: the frame

Between the ``sockaddr_ll`` and the frame there is room. A VLAN tag that the kernel took out, or a cooked
header that it never wrote, goes there, so that frames need not be moved. (A cooked header has no place for a
tag: there it is left out.)
"""

from __future__ import annotations

import math
import sys
from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.sources.bpf import ETHERNET, LINUX_SLL2
from edoras_tools.sources.framing import walk
from edoras_tools.sources.linklayer import FrameBatch

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

BLOCK_HEADER: Final = 48
"""Bytes of a block's descriptor."""
ALIGNMENT: Final = 8
"""V3_ALIGNMENT: packets start at multiples of this."""

_VLAN_VALID: Final = 1 << 4
_VLAN_TPID_VALID: Final = 1 << 6
_DOT1Q: Final = 0x8100
_TAG: Final = 4
_ADDRESSES: Final = 12
_SOCKADDR: Final = 48
_SLL2_LENGTH: Final = 20
# Where each byte of an SLL2 header is found in a little-endian sockaddr_ll: protocol, 2 reserved,
# interface index, ARPHRD type, packet type, address length, address; _NOTHING stands for 0.
_NOTHING: Final = 255
_LITTLE: Final = (2, 3, _NOTHING, _NOTHING, 7, 6, 5, 4, 9, 8, 10, 11, 12, 13, 14, 15, 16, 17, 18, 19)
_BIG: Final = (2, 3, _NOTHING, _NOTHING, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16, 17, 18, 19)


def frames(
    data: NDArray[np.uint8], blocks: Sequence[tuple[int, int]], link_type: int, number: int
) -> FrameBatch:
    """Read every packet of some blocks.

    Args:
        data: the blocks as copied out of the ring, each at a multiple of ``ALIGNMENT``, and at least
            ``framing.PADDING`` bytes behind them. Tags and cooked headers are written into it.
        blocks: where each block starts and how many bytes it has.
        link_type: LINKTYPE of the frames; ``LINUX_SLL2`` for a socket that gives packets without header.
        number: of the first frame.

    Returns:
        The frames, over ``data``.
    """
    # Headers are aligned, so every field is an element of a view on the whole buffer.
    words, halves = data.view(np.uint32), data.view(np.uint16)
    heads = np.concatenate([_packets(words, halves, start, length) for start, length in blocks])
    word, half = heads // 4, heads // 2
    offset = heads + halves[half + 12]
    captured = words[word + 3].astype(np.int32)
    original = words[word + 4].astype(np.int32)
    status = words[word + 5]
    time_ns = words[word + 1] * np.int64(1_000_000_000) + words[word + 2]
    added = np.zeros(len(heads), dtype=np.int32)
    if link_type == ETHERNET:
        rows = np.flatnonzero(status & _VLAN_VALID)
        if len(rows):
            _insert_tags(data, words, halves, heads[rows], offset[rows], status[rows])
            added[rows] = _TAG
    elif link_type == LINUX_SLL2:
        _insert_cooked(data, heads, offset)
        added[:] = _SLL2_LENGTH
    return FrameBatch(
        data=data,
        number=np.arange(number, number + len(heads), dtype=np.int64),
        time_ns=time_ns,
        link_type=np.full(len(heads), link_type, dtype=np.uint16),
        offset=offset - added,
        length=captured + added,
        original_length=original + added,
    )


def _packets(
    words: NDArray[np.uint32], halves: NDArray[np.uint16], start: int, length: int
) -> NDArray[np.int64]:
    """Find the headers of a block's packets; the last one names no next."""
    count, first = int(words[start // 4 + 3]), int(words[start // 4 + 4])
    head, end = start + first, start + length

    def successor(at: NDArray[np.int64]) -> NDArray[np.int64]:
        following = words[at // 4]
        return np.where(following == 0, end, at + following)

    def step(at: int) -> int:
        following = int(words[at // 4])
        return at + following if following else end

    # The distance of the frame from its header is the same for nearly all packets: a good sign of a header.
    signs = halves[head // 2 + 12 : end // 2 : ALIGNMENT // 2]
    alike = np.flatnonzero(signs == signs[:1])
    seeds = head + alike[:: max(1, math.isqrt(count))] * ALIGNMENT
    return walk(head, end, seeds, successor, step)[0][:count]


def _insert_tags(
    data: NDArray[np.uint8],
    words: NDArray[np.uint32],
    halves: NDArray[np.uint16],
    heads: NDArray[np.int64],
    offset: NDArray[np.int64],
    status: NDArray[np.uint32],
) -> None:
    """Put the VLAN tags back where they were on the wire, behind the addresses (IEEE 802.1Q clause 9)."""
    tag = np.empty((len(heads), 2), dtype=">u2")
    tag[:, 0] = np.where(status & _VLAN_TPID_VALID, halves[heads // 2 + 18], _DOT1Q)
    tag[:, 1] = words[heads // 4 + 8]
    addresses = data[offset[:, None] + np.arange(_ADDRESSES)]
    start = (offset - _TAG)[:, None]
    data[start + np.arange(_ADDRESSES)] = addresses
    data[start + np.arange(_ADDRESSES, _ADDRESSES + _TAG)] = tag.view(np.uint8)


def _insert_cooked(data: NDArray[np.uint8], heads: NDArray[np.int64], offset: NDArray[np.int64]) -> None:
    """Write LINKTYPE_LINUX_SLL2 headers before the packets, from the address the kernel gave with each."""
    places = np.array(_LITTLE if sys.byteorder == "little" else _BIG)
    headers = data[heads[:, None] + _SOCKADDR + np.minimum(places, _SLL2_LENGTH - 1)]
    headers[:, places == _NOTHING] = 0
    data[(offset - _SLL2_LENGTH)[:, None] + np.arange(_SLL2_LENGTH)] = headers
