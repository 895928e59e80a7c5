"""Datagrams that were captured in front of a proxy that also recorded them: the same messages again.

A proxy's recording contains what it sent on, and in ``/edoras/faults`` what it dropped. A capture in front
of the proxy contains both. Therefore:

1. If the proxy dropped a datagram and the capture has it, it was captured in front of the proxy.
2. If most of what was dropped in one direction is in the capture, the conversations that contain it are in
   front of the proxy. They are left out, and what was dropped is counted once, at the proxy.
3. If the conversation has the same endpoints behind the proxy, only what was dropped is left out: the others
   are copies, which are counted once anyway.
4. Bytes that are sent again and again prove nothing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.links.table import among
from edoras_tools.units import MILLISECOND
from edoras_tools.wire.arrays.fingerprint import of_bytes
from edoras_tools.wire.arrays.window import PADDING

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from edoras_tools.diagnosis.evidence.relays.proxied import Proxied, RouteWay
    from edoras_tools.diagnosis.evidence.table import Rows

_WITHIN_NS: Final = 20 * MILLISECOND
_LEAST: Final = 0.8
"""Of what was dropped, so much is there; and of its bytes so much differ."""


def before_proxy(rows: Rows, proxied: Mapping[RouteWay, Proxied]) -> NDArray[np.bool_]:
    """Return which rows were captured in front of a proxy."""
    out = np.zeros(len(rows), bool)
    pair = rows.source.astype(np.int64) << 32 | rows.destination
    for (link, _, msg_id), item in proxied.items():
        own = np.flatnonzero((rows.link == link) & (rows.msg_id == msg_id))
        prints = _prints([data for _, data in item.dropped])
        if not len(own) or len(np.unique(prints)) < max(1, _LEAST * len(prints)):
            continue
        found = _there(rows, own, prints, np.array([when for when, _ in item.dropped], np.int64))
        if len(found) < _LEAST * len(prints):
            continue
        ways = np.unique(pair[found])
        in_front = np.isin(pair, ways) & among(rows.link, lambda kind: kind.packets)
        if (~in_front[own]).any():
            out |= in_front
        else:
            out[found] = True
    return out


def _there(
    rows: Rows, own: NDArray[np.intp], prints: NDArray[np.uint64], times: NDArray[np.int64]
) -> NDArray[np.intp]:
    """Return the rows that are, by their bytes and time, one of some datagrams."""
    order = np.lexsort((times, prints))
    prints, times = prints[order], times[order]
    there = own[np.isin(rows.bytes_print[own], prints)]
    first = np.searchsorted(prints, rows.bytes_print[there])
    last = np.searchsorted(prints, rows.bytes_print[there], "right")
    near = [
        bool((np.abs(times[low:high] - when) <= _WITHIN_NS).any())
        for low, high, when in zip(first.tolist(), last.tolist(), rows.time_ns[there].tolist(), strict=True)
    ]
    return np.asarray(there[np.array(near, bool)])


def _prints(datagrams: Sequence[bytes]) -> NDArray[np.uint64]:
    length = np.array([len(data) for data in datagrams], np.int64)
    data = np.frombuffer(b"".join(datagrams) + bytes(PADDING), np.uint8)
    return of_bytes(data, np.cumsum(length) - length, length)
