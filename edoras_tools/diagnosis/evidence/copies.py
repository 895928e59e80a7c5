"""Datagrams that are in the capture more than once: captured twice, or doubled by the network.

One datagram keeps its IP identification and its bytes wherever it is captured, and a sender gives the next
one another identification. So:

1. Equal bytes between the same ports, with one identification that is not 0, within 20 ms: one datagram.
   Where it was captured at two places (another link layer header, interface or time to live), or four of
   five datagrams of the conversation are doubled, the capture did it: a *copy*, counted once. Else it is a
   *duplicate*: the network's, which its receiver gets twice, as far as ``doubled`` cannot tell otherwise.
2. Where the identification is 0 (it may be, where fragmenting is forbidden) equal bytes are a copy only
   where they were captured at two places, or the whole conversation comes steadily in twos: at least eight
   groups of equal datagrams within 5 ms, nearly all of exactly two. A burst of 50 equal datagrams is one
   group, and stays 50.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from edoras_tools.io.frames.linklayer import network_headers
from edoras_tools.model import OTHER, Columns, PacketBatch
from edoras_tools.units import MILLISECOND
from edoras_tools.wire.arrays.fingerprint import of_bytes
from edoras_tools.wire.arrays.order import by_value
from edoras_tools.wire.arrays.window import gather

if TYPE_CHECKING:
    from numpy.typing import NDArray


_WITHIN_NS: Final = 20 * MILLISECOND
_UNNUMBERED_NS: Final = 5 * MILLISECOND
_STEADY: Final = 0.8
_NEARLY_ALL: Final = 0.95
_LEAST_GROUPS: Final = 8
_LEAST_BYTES: Final = 16
_PLACES: Final = 18
"""Bits of a table that what is there once is told by."""
_MIX: Final = np.uint64(0x9E3779B97F4A7C15)


@dataclass(frozen=True, slots=True)
class Copies:
    """What is there more than once.

    Attributes:
        copy: bool (n,), captured before: not to be counted.
        duplicate: bool (n,), captured before as well, at one place.
        at_once: bool (n,), at the same time as the one before it that is equal.
    """

    copy: NDArray[np.bool_]
    duplicate: NDArray[np.bool_]
    at_once: NDArray[np.bool_]


def find_copies(
    time_ns: NDArray[np.int64],
    identification: NDArray[np.uint16],
    conversation: NDArray[np.integer[Any]],
    tap: NDArray[np.uint64],
    prints: NDArray[np.uint64],
) -> Copies:
    """Find the datagrams that are there more than once; the first of each stays.

    Args:
        time_ns: capture times, in order.
        identification: of the IPv4 packets, 0 where there is none.
        conversation: a number for each pair of endpoints.
        tap: where it was captured, as ``Rows.tap``.
        prints: fingerprints of the datagrams.
    """
    count = len(time_ns)
    out = Copies(*(np.zeros(count, bool) for _ in range(3)))
    if count < 2:
        return out
    key = (prints ^ conversation.astype(np.uint64) * _MIX) * _MIX ^ identification
    order = np.lexsort((np.arange(count), key))
    key, when, numbered = key[order], time_ns[order], identification[order] != 0
    step = np.abs(np.diff(when))
    near = (key[1:] == key[:-1]) & (step <= np.where(numbered[1:], _WITHIN_NS, _UNNUMBERED_NS))
    if not near.any():
        return out
    # A group is a run of equal ones, each near the one before it.
    group = np.concatenate(([0], np.cumsum(~near)))
    again = order[1:][near]
    out.at_once[order[1:]] = near & (step == 0)
    elsewhere = np.zeros(count, bool)
    elsewhere[order[1:]] = near & (tap[order][1:] != tap[order][:-1])
    repeated = np.zeros(count, bool)
    repeated[again] = True
    size = np.bincount(group)
    group_size = np.zeros(count, np.int64)
    group_size[order] = size[group]
    first = np.zeros(count, bool)
    first[order[np.concatenate(([True], ~near))]] = True
    for _, rows in by_value(conversation.astype(np.int64)):
        if not repeated[rows].any():
            continue
        for known in (True, False):
            mine = rows[(identification[rows] != 0) == known]
            twice = mine[repeated[mine]]
            if not len(twice):
                continue
            sizes = group_size[mine[first[mine]]]
            steady = float((sizes > 1).mean()) >= _STEADY and len(sizes) >= _LEAST_GROUPS
            if not known:
                steady = len(sizes) >= _LEAST_GROUPS and float((sizes == 2).mean()) >= _NEARLY_ALL
            copied = np.ones(len(twice), bool) if steady else elsewhere[twice]
            out.copy[twice[copied]] = True
            if known:
                out.duplicate[twice[~copied]] = True
    return out


class Once:
    """Takes batch after batch, and tells which datagrams were captured before.

    Attributes:
        copies: how many were, so far.
    """

    def __init__(self) -> None:
        self.copies = 0
        self._last: tuple[NDArray[Any], ...] = ()

    def keep(self, batch: PacketBatch, columns: Columns) -> NDArray[np.bool_]:
        """Return which datagrams of a batch are to be counted; those of no link all are."""
        kept = np.ones(len(batch), bool)
        rows = np.flatnonzero(columns.link != OTHER)
        if len(rows) < len(batch):
            batch = batch.take(rows)
        network, identification, life = network_headers(batch)
        ends = batch.source_address.astype(np.uint64) << np.uint64(32) | batch.destination_address
        ports = batch.source_port.astype(np.uint64) << np.uint64(16) | batch.destination_port
        conversation = ((ends * _MIX ^ ports) >> np.uint64(1)).astype(np.int64)
        short = _glance(batch) ^ conversation.astype(np.uint64) * _MIX ^ identification
        told: tuple[NDArray[Any], ...] = batch.time_ns, identification, conversation

        def whole(chosen: NDArray[np.intp] | slice) -> tuple[NDArray[Any], ...]:
            """Return what ``find_copies`` asks for, of some datagrams."""
            frame = batch.frame_offset[chosen]
            tap = of_bytes(batch.data, frame, network[chosen] - frame) + life[chosen]
            prints = of_bytes(batch.data, batch.offset[chosen], batch.length[chosen])
            return *(column[chosen] for column in told), tap, prints, short[chosen]

        last = self._last or whole(slice(0))
        if _perhaps_again(np.append(last[-1], short), np.append(last[0], batch.time_ns)):
            asked = [np.concatenate(pair) for pair in zip(last, whole(slice(None)), strict=True)]
            copy = find_copies(*asked[:-1]).copy[len(last[0]) :]
            kept[rows[copy]] = False
            self.copies += int(copy.sum())
        late = batch.time_ns > batch.time_ns.max(initial=0) - _WITHIN_NS
        self._last = whole(np.flatnonzero(late))
        return kept

    def notes(self) -> list[str]:
        """Return a line where there were any."""
        return [f"{self.copies:,} datagrams were captured twice, and are counted once"] * bool(self.copies)


def _glance(batch: PacketBatch) -> NDArray[np.uint64]:
    """Return a number for each datagram by its length and 16 of its bytes: equal ones have the same."""
    long = batch.length >= _LEAST_BYTES
    offset = np.where(long, batch.offset, 0)
    early = gather(batch.data, offset + long * 8, 8).view(np.uint64)[:, 0]
    late = gather(batch.data, offset + long * (batch.length - 8), 8).view(np.uint64)[:, 0]
    total = early * _MIX ^ late
    stirred = np.where(long, (total ^ total >> np.uint64(29)) * _MIX, np.uint64(0))
    return np.asarray(stirred ^ batch.length.astype(np.uint64), np.uint64)


def _perhaps_again(number: NDArray[np.uint64], time_ns: NDArray[np.int64]) -> bool:
    """Tell whether two datagrams within 20 ms may be equal, by the numbers that equal ones share."""
    table = np.empty(1 << _PLACES, np.int32)
    for shift in (0, _WITHIN_NS):  # two within 20 ms are in one window of 40 ms, of these or of those between
        window = ((time_ns + shift) // (2 * _WITHIN_NS)).astype(np.uint64)
        place = (((number ^ window) * _MIX) >> np.uint64(64 - _PLACES)).view(np.int64)
        rows = np.arange(len(number), dtype=np.int32)
        while len(rows):
            table[place] = rows
            last = table[place]
            others = np.flatnonzero(last != rows)  # few: most have a place of their own
            rows, place, last = rows[others], place[others], last[others]
            if (number[rows] == number[last]).any():
                return True
    return False
