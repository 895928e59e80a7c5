"""The same datagrams on both sides of an address translation, as a Docker host or a router does it.

Rules:

1. Whoever only forwards a datagram keeps its bytes and its IP identification, and lowers its time to live.
   Whoever sends it anew, as a proxy, does not lower it: that is a hop of its own.
2. If nearly all datagrams of one conversation, and at least eight, come so within 20 ms in another one, the
   two are one conversation: its endpoints have two names. Of shorter conversations that is so if their
   addresses are known to be two names of one.
3. Each endpoint gets the name of the inner side: a source's before it is translated, a destination's behind
   it. Many may share the outer address.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.units import MILLISECOND

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from edoras_tools.diagnosis.evidence.table import Rows
    from edoras_tools.model import Endpoint

_WITHIN_NS: Final = 20 * MILLISECOND
_LEAST: Final = 8
_NEARLY_ALL: Final = 0.8
_MIX: Final = np.uint64(0x9E3779B97F4A7C15)


def one_name(rows: Rows, endpoints: Sequence[Endpoint]) -> NDArray[np.int32]:
    """Return the endpoint that each endpoint is counted as; mostly it is the same.

    Args:
        rows: in order of time.
        endpoints: what their ``source`` and ``destination`` index.
    """
    names = np.arange(len(endpoints), dtype=np.int32)
    same = _forwarded(rows, endpoints)
    if not same:
        return names
    outer = {other for _, other in same}

    def preferred(index: int) -> tuple[bool, str, int]:
        return index in outer, endpoints[index].address, endpoints[index].port

    changed = True
    while changed:
        changed = False
        for pair in same:
            best = min((int(names[index]) for index in pair), key=preferred)
            for index in pair:
                changed |= bool(names[index] != best)
                names[index] = best
    return names


def _forwarded(rows: Rows, endpoints: Sequence[Endpoint]) -> set[tuple[int, int]]:
    """Return the endpoints that are two names of one: the inner, then the outer."""
    if not len(rows) or rows.life.min() == rows.life.max():  # nothing was forwarded
        return set()
    pair = rows.source.astype(np.int64) << 32 | rows.destination
    key = rows.bytes_print ^ rows.identification.astype(np.uint64) * _MIX
    order = np.lexsort((rows.time_ns, key))
    near = (key[order][1:] == key[order][:-1]) & (np.diff(rows.time_ns[order]) <= _WITHIN_NS)
    early, late = order[:-1][near], order[1:][near]
    onward = (pair[early] != pair[late]) & (rows.life[late] < rows.life[early])
    if not onward.any():
        return set()
    ways, number = np.unique(np.stack((pair[early], pair[late]))[:, onward], axis=1, return_counts=True)
    there, sizes = np.unique(pair, return_counts=True)
    size = dict(zip(there.tolist(), sizes.tolist(), strict=True))
    likely = [
        (count, _ends(one, other))
        for (one, other), count in zip(ways.T.tolist(), number.tolist(), strict=True)
        if count >= _NEARLY_ALL * min(size[one], size[other])
    ]
    found = {ends for count, both in likely if count >= _LEAST for ends in both}
    known = {frozenset(endpoints[index].address for index in ends) for ends in found}
    for _, both in likely:
        if all(frozenset(endpoints[index].address for index in ends) in known for ends in both):
            found |= both
    return found


def _ends(one: int, other: int) -> set[tuple[int, int]]:
    """Return the endpoints of two ways that differ: the inner, then the outer.

    A source is translated on the way out, a destination on the way in.
    """
    source, destination = (one >> 32, other >> 32), (other & 0xFFFFFFFF, one & 0xFFFFFFFF)
    return {ends for ends in (source, destination) if ends[0] != ends[1]}
