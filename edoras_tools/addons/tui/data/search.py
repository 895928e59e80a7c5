"""Searching packets: by a filter, by text, or by bytes."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.decode.filters.filter import Where
from edoras_tools.decode.filters.syntax import Presence, WhereError, parse_filter
from edoras_tools.links import table
from edoras_tools.model import NO_MSG_ID, NO_ROUTE, OTHER, Finding
from edoras_tools.wire.arrays.order import by_value
from edoras_tools.wire.sbn import MSG_TYPE_NAMES

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from edoras_tools.addons.tui.data.store import PacketBlock, Part
    from edoras_tools.decode.context import Context

    Matcher = Callable[[PacketBlock], NDArray[np.bool_]]
    """Function from a block to a mask of the packets that match."""

_HEX: Final = re.compile(r"0x((?:[0-9a-fA-F]{2}[ :]?)+)")
_LOWER: Final = np.array([ord(chr(code).lower()) if code < 128 else code for code in range(256)], np.uint8)


def matcher(text: str, context: Context, begin_ns: int | None) -> Matcher:
    """Return the test for a search.

    Args:
        text: a comparison of the filter language; bytes, e.g. ``0x0b0c``; else a text to search in topics, in
            names of packets and findings, and in the packets' bytes, ignoring case.
        begin_ns: time of the first packet.
    """
    try:
        # A single word would also be a filter (packets that have that field); a search treats it as text.
        where = None if isinstance(parse_filter(text), Presence) else Where(text, context, begin_ns)
    except WhereError:
        where = None
    if where is not None:
        return lambda block: where.mask(block.batch, block.columns)
    digits = _HEX.fullmatch(text.strip())
    if digits:
        octets = bytes.fromhex(re.sub("[ :]", "", digits[1]))
        return lambda block: _holding(block, block.batch.data, octets)
    word = text.strip().lower()
    return lambda block: (
        _rows_named(block, word, context) | _holding(block, _LOWER[block.batch.data], word.encode())
    )


def next_number(
    parts: Sequence[Part],
    matches: Matcher,
    after: int,
    *,
    back: bool = False,
    given_up: Callable[[], bool] = lambda: False,
) -> int | None:
    """Return the number of the next packet that matches, continuing at the other end; None if none does.

    Args:
        parts: result of ``Store.parts``.
        matches: the test.
        after: the row to start after; it is tested last.
        given_up: called between blocks; the search ends when it returns true.
    """
    start = next(
        (place for place, (_, first, selection) in enumerate(parts) if first + len(selection) > after), 0
    )
    step = -1 if back else 1
    # The block in which the search starts is tested twice: first the rows ahead, at the end the others.
    for turn in range(len(parts) + 1 if parts else 0):
        if given_up():
            return None
        block, first, selection = parts[(start + step * turn) % len(parts)]
        candidates = np.asarray(selection)
        candidates = candidates[matches(block)[candidates]]
        if turn == 0:
            rows = first + np.searchsorted(np.asarray(selection), candidates)
            candidates = candidates[rows < after] if back else candidates[rows > after]
        if len(candidates):
            return int(block.batch.number[candidates[-1 if back else 0]])
    return None


def _holding(block: PacketBlock, data: NDArray[np.uint8], octets: bytes) -> NDArray[np.bool_]:
    """Return which payloads contain these bytes."""
    batch = block.batch
    hit = np.zeros(len(batch), bool)
    if not octets:
        return hit
    text = data.tobytes()
    places = []
    at = text.find(octets)
    while at >= 0:
        places.append(at)
        at = text.find(octets, at + 1)
    order = np.argsort(batch.offset, kind="stable")
    positions = np.array(places, np.int64)
    owner = np.searchsorted(batch.offset[order], positions, side="right") - 1
    positions, rows = positions[owner >= 0], order[owner[owner >= 0]]
    hit[rows[positions + len(octets) <= batch.offset[rows] + batch.length[rows]]] = True
    return hit


def _rows_named(block: PacketBlock, word: str, context: Context) -> NDArray[np.bool_]:
    """Return which packets have a name that contains a word."""
    columns = block.columns
    hit = np.isin(columns.link, [int(link) for link in (*table.links(), OTHER) if word in link.label])
    bits = sum(int(item) for item in Finding if word in item.label)
    if bits:
        hit |= (columns.findings & np.uint32(bits)) != 0
    kinds = [kind for kind, name in MSG_TYPE_NAMES.items() if word in name.lower()]
    hit |= np.isin(columns.sbn_msg_type, kinds)
    for number, rows in by_value(columns.spacecraft):
        own = columns.msg_id[rows]
        msg_ids = [item for item in np.unique(own).tolist() if item != NO_MSG_ID]
        hit[rows] |= np.isin(own, [item for item in msg_ids if word in _name(item, context.of(number))])
    return hit


def _name(msg_id: int, context: Context) -> str:
    route = int(context.any_route_of[msg_id])
    topic = f"{context.mission.routes[route].topic} {context.mission.routes[route].type}" * (
        route != NO_ROUTE
    )
    return f"0x{msg_id:04x} {context.name(msg_id)} {topic}".lower()
