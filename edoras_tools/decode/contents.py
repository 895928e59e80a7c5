"""Values derived from many packets: from their columns if these suffice, else from their layers.

The rules that this file keeps:

1. Both ways give the same value for every packet; ``tests/decode/test_agreement.py`` compares them.
2. Columns are used for packets that are decoded to their end. Other packets, with a finding that ends their
   decoding or without a space packet, are dissected unless the columns suffice for the value.
3. The value of a datagram without a space packet depends only on its bytes and is cached: heartbeats and
   subscriptions are repeated.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, Generic, NamedTuple, TypeVar

import numpy as np

from edoras_tools.decode.filters.layers import held_messages, structs_of
from edoras_tools.decode.stack import Dissector
from edoras_tools.links import table
from edoras_tools.model import NO_ROUTE, Decoded, Endpoint, Finding, Link
from edoras_tools.wire.arrays import Integers, Mask, Places, by_value, numbered

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from edoras_tools.decode.context import Context
    from edoras_tools.decode.filters.rows import ColumnRows
    from edoras_tools.ros.cdr.columns import MessageColumns
    from edoras_tools.ros.cdr.plan import CdrPlan
    from edoras_tools.structs.bindings import Bound

Content = TypeVar("Content")

_ENDING: Final = (
    Finding.TRUNCATED
    | Finding.ENVELOPE_OVERRUN
    | Finding.CDR_INVALID
    | Finding.HEADER_ONLY
    | Finding.STRUCT_LENGTH
    | Finding.SBN_LEGACY_HEADER
    | Finding.CAPTURE_CUT
)
"""Findings of packets that are not decoded to their end, or have other layers than usual."""
_MOST_KEPT: Final = 4096
_FEW: Final = 4
"""Packets for each MsgId (at least four are counted) below which dissection is faster than columns."""
_STRUCTS: Final = 64
"""Most MsgIds without a route that are counted: those without a C struct cost nothing."""


class Contents(Generic[Content]):
    """Derives a value from each of many packets.

    Args:
        context: shared with the decoder of the same stream.
        of_packet: returns the value of a dissected packet; without a space packet it depends only on the
            bytes.
        of_columns: returns the value of each row; None for a row that has to be dissected.
    """

    def __init__(
        self,
        context: Context,
        of_packet: Callable[[Decoded], Content],
        of_columns: Callable[[ColumnRows], list[Content | None]],
    ) -> None:
        self._dissector = Dissector(context, detail=False)
        self._of_packet = of_packet
        self._of_columns = of_columns
        self._kept: dict[tuple[int, int, int, bytes], Content] = {}

    def of(self, rows: ColumnRows) -> list[Content]:
        """Return the value of each row."""
        ids, routes = (len(set(column.tolist())) for column in (rows.column("msg_id"), rows.routes()))
        few = len(rows) < _FEW * max(4, min(ids, routes + _STRUCTS))
        contents: list[Content | None] = [None] * len(rows)
        for places, own in () if few else rows.by_spacecraft():
            for place, content in zip(places.tolist(), self._of_columns(own), strict=True):
                contents[place] = content
        bound = rows.context.structs.of_port(rows.datagram("destination_port")).tolist()
        return [
            self._dissected(rows, place, port) if content is None else content
            for place, port, content in zip(rows.indices().tolist(), bound, contents, strict=True)
        ]

    def _dissected(self, rows: ColumnRows, place: int, bound: int) -> Content:
        """Dissect one packet; if it has no space packet, equal bytes are dissected once.

        Args:
            bound: result of ``Structs.of_port`` for its destination port.
        """
        batch, columns = rows.batch, rows.columns
        if columns.packet_offset[place] >= 0 or batch.recorded is not None:
            return self._of_packet(self._dissector.dissect(batch[place]))
        start = int(batch.offset[place])
        payload = batch.data[start : start + int(batch.length[place])].tobytes()
        kind = int(columns.link[place]) << 8 | int(columns.spacecraft[place])
        key = kind, int(columns.findings[place]), bound, payload
        content = self._kept.get(key)
        if content is None:
            if len(self._kept) >= _MOST_KEPT:
                self._kept.clear()
            content = self._kept[key] = self._of_packet(self._dissector.dissect(batch[place]))
        return content


class MessageRows(NamedTuple):
    """The messages of some rows, all of one type.

    Attributes:
        owner: row of each message, i64 (n,).
        topic: their topic.
        type: their type, as the mission or the struct names it.
        columns: the messages.
        plan: CDR plan of the type.
        bound: C struct of the messages; None for messages of a route.
    """

    owner: Integers
    topic: str
    type: str
    columns: MessageColumns
    plan: CdrPlan
    bound: Bound | None


def read_whole(rows: ColumnRows) -> Mask:
    """Return which rows hold a packet, or a recorded message, that is decoded to its end."""
    if rows.batch.recorded is not None:
        read: Mask = rows.column("cdr_length") > 0
        read &= (rows.column("findings") & np.uint32(_ENDING)) == 0
        return read
    whole: Mask = (rows.column("packet_offset") >= 0) & (rows.column("header_length") > 0)
    whole &= (rows.column("findings") & np.uint32(_ENDING)) == 0
    return whole


def message_rows(rows: ColumnRows, whole: Mask, *, commands: bool = True) -> Iterator[MessageRows]:
    """Yield the messages of each topic and of each C struct; topics only for ``whole`` rows.

    Args:
        commands: whether to include those of the built-in commands.
    """
    context, routes = rows.context, rows.routes()
    offset, length = rows.column("cdr_offset"), rows.column("cdr_length")
    for index, owner in by_value(np.where(whole & (length > 0), routes, NO_ROUTE)):
        route = context.mission.routes[index] if index != NO_ROUTE else None
        types = context.types
        if route is None or types is None or not types.has(route.type):
            continue
        messages = types.columns(route.type, rows.batch.data, offset[owner], length[owner])
        yield MessageRows(owner, route.topic, route.type, messages, types.plan(route.type)[1], None)
    for bound in structs_of(rows):
        if bound.command and not commands:
            continue
        owner, messages = held_messages(bound, rows)
        plan = context.structs.types.plan(bound.type)[1]
        yield MessageRows(owner, bound.topic, bound.type, messages, plan, bound)


def links_of(rows: ColumnRows) -> dict[int, Link]:
    """Return the links of the rows by their code."""
    return {code: table.link(code) for code in set(rows.column("link").tolist())}


def endpoints(rows: ColumnRows) -> tuple[list[tuple[Endpoint, Endpoint]], Places]:
    """Return all pairs of source and destination of some rows, and the index of each row's pair."""
    names = ("source_address", "destination_address", "source_port", "destination_port", "ip_version")
    first, which = numbered(*(rows.datagram(name) for name in names))
    places = rows.indices()[first].tolist()
    return [(item.source, item.destination) for item in map(rows.batch.__getitem__, places)], which
