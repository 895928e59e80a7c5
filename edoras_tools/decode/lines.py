"""What a line shows of a packet: from its layers, or of many packets from their columns.

The rules that this file keeps:

1. Both ways give the same lines; ``tests/decode/test_lines.py`` compares them.
2. From columns come sound packets whose message has single values and lists of them. A packet of another
   kind is dissected: one with a finding that ends its decoding, without a space packet, or with a layer
   that has a text of its own.
3. The text of a datagram without a space packet depends on its bytes alone and is kept: heartbeats and
   subscriptions come again and again.
"""

from __future__ import annotations

from functools import reduce
from operator import or_
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from edoras_tools.decode.filters.messages import held_messages, structs_of
from edoras_tools.decode.stack import Dissector
from edoras_tools.decode.summary import LAYER_TEXTS, message_texts, packet_text
from edoras_tools.links import table
from edoras_tools.model import NO_MSG_ID, NO_ROUTE, Finding
from edoras_tools.wire import cfe
from edoras_tools.wire.order import by_value, numbered
from edoras_tools.wire.sbn import MSG_TYPE_NAMES

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from edoras_tools.decode.context import Context
    from edoras_tools.decode.filters.rows import ColumnRows
    from edoras_tools.model import Decoded, Endpoint, Layer, Link

_ALL_READ: Final = reduce(
    or_,
    (
        Finding.CHECKSUM_BAD,
        Finding.CHECKSUM_ABSENT,
        Finding.SEQUENCE_UNSET,
        Finding.STALE_TAIL,
        Finding.UNKNOWN_MSG_ID,
        Finding.WRONG_DIRECTION,
        Finding.UNKNOWN_FUNCTION_CODE,
        Finding.COMMAND_LENGTH,
        Finding.OVER_SOFTWARE_BUS,
        Finding.CDR_BIG_ENDIAN,
        Finding.CDR_TRAILING,
    ),
)
"""Findings of packets that are read to their end."""
_LAYERS: Final = {
    cfe.EVENT_MSG_ID: cfe.EVENT,
    cfe.SOFTWARE_BUS_HOUSEKEEPING_MSG_ID: cfe.SOFTWARE_BUS_HOUSEKEEPING,
}
"""Packets whose layer has a text of its own."""
_MOST_KEPT: Final = 4096
_FEW: Final = 16
"""Fewer packets than these are dissected sooner than columns are made of them."""


class PacketLine(NamedTuple):
    """What a line shows of a packet.

    Attributes:
        number: place of its frame in the source, from 1.
        time_ns: capture time, ns since 1970.
        link: which link.
        source: from where.
        destination: to where.
        kind: ``cmd``, ``tlm``, an SBN message type as ``SUB`` or ``APP``, or nothing.
        msg_id: the space packet's MsgId; ``NO_MSG_ID`` where there is none.
        name: the topic, else what the MsgId is called, else nothing.
        length: bytes of the UDP payload that were captured.
        findings: what is remarkable.
        text: the summary, or why decoding ended.
    """

    number: int
    time_ns: int
    link: Link
    source: Endpoint
    destination: Endpoint
    kind: str
    msg_id: int
    name: str
    length: int
    findings: Finding
    text: str


class _Content(NamedTuple):
    """What a line says of a packet's content; see ``PacketLine``."""

    kind: str
    msg_id: int
    name: str
    text: str


def line_of(decoded: Decoded) -> PacketLine:
    """Return the line of a packet."""
    datagram, content = decoded.datagram, _content(decoded)
    return PacketLine(
        datagram.number,
        datagram.time_ns,
        decoded.link,
        datagram.source,
        datagram.destination,
        *content[:3],
        len(datagram.payload),
        decoded.findings,
        content.text,
    )


class PacketLines:
    """Makes the lines of many packets.

    Args:
        context: shared with the decoder of the same stream.
    """

    def __init__(self, context: Context) -> None:
        self._dissector = Dissector(context, detail=False)
        self._kept: dict[tuple[Link, int, bytes], _Content] = {}

    def of(self, rows: ColumnRows) -> Iterator[PacketLine]:
        """Yield the line of each row, in order."""
        if len(rows) < _FEW:
            yield from (line_of(self._dissector.dissect(rows.batch[row])) for row in rows.indices().tolist())
            return
        links = {code: table.link(code) for code in set(rows.column("link").tolist())}
        found = {bits: Finding(bits) for bits in set(rows.column("findings").tolist())}
        columns = zip(
            rows.indices().tolist(),
            rows.datagram("number").tolist(),
            rows.datagram("time_ns").tolist(),
            rows.column("link").tolist(),
            rows.datagram("length").tolist(),
            rows.column("findings").tolist(),
            _endpoints(rows),
            _contents(rows),
            strict=True,
        )
        for place, number, time_ns, code, length, findings, (source, destination), known in columns:
            link = links[code]
            content = known or self._dissected(rows, place, link, findings)
            yield PacketLine(
                number,
                time_ns,
                link,
                source,
                destination,
                content.kind,
                content.msg_id,
                content.name,
                length,
                found[findings],
                content.text,
            )

    def _dissected(self, rows: ColumnRows, place: int, link: Link, findings: int) -> _Content:
        """Dissect one packet; where it has no space packet, the same bytes are dissected once."""
        batch = rows.batch
        if rows.columns.packet_offset[place] >= 0:
            return _content(self._dissector.dissect(batch[place]))
        start = int(batch.offset[place])
        key = link, findings, batch.data[start : start + int(batch.length[place])].tobytes()
        content = self._kept.get(key)
        if content is None:
            if len(self._kept) >= _MOST_KEPT:
                self._kept.clear()
            content = self._kept[key] = _content(self._dissector.dissect(batch[place]))
        return content


def _content(decoded: Decoded) -> _Content:
    payload = decoded.datagram.payload
    kind, name, msg_id = "", "", NO_MSG_ID
    for layer in decoded.layers:
        if layer.name == "ccsds":
            word = int.from_bytes(payload[layer.start : layer.start + 2], "big")
            kind = kind or ("cmd" if cfe.is_command(word) else "tlm")
            msg_id, name = _msg_id(layer, word)
            break
        if layer.name == "sbn":
            octet = int.from_bytes(payload[layer.start + 2 : layer.start + 3], "big")
            kind = MSG_TYPE_NAMES.get(octet, f"0x{octet:02x}")
    if decoded.message and (not name or decoded.layer("edoras")):
        name = decoded.message.topic  # of a C struct the packet's name says as much, and is shorter
    return _Content(kind, msg_id, name, decoded.summary or (str(decoded.stop) if decoded.stop else ""))


def _msg_id(layer: Layer, word: int) -> tuple[int, str]:
    """Return the MsgId and what follows it in its text: the name of the packet."""
    for item in layer.fields:
        if item.name == "msg_id":
            return item.value, item.text.partition(" ")[2]
    return word, ""


def _endpoints(rows: ColumnRows) -> Iterator[tuple[Endpoint, Endpoint]]:
    """Yield where each row comes from, and where it goes."""
    names = ("source_address", "destination_address", "source_port", "destination_port", "ip_version")
    first, which = numbered(*(rows.datagram(name) for name in names))
    places = rows.indices()[first].tolist()
    pairs = [(item.source, item.destination) for item in map(rows.batch.__getitem__, places)]
    return (pairs[at] for at in which.tolist())


def _contents(rows: ColumnRows) -> list[_Content | None]:
    """Return what is said of the packets that columns tell everything of; None for the others."""
    out: list[_Content | None] = [None] * len(rows)
    msg_id, context = rows.column("msg_id"), rows.context
    easy = (rows.column("packet_offset") >= 0) & (rows.column("header_length") > 0)
    easy &= (rows.column("findings") & np.uint32(~_ALL_READ & 0xFFFFFFFF)) == 0
    told: dict[int, tuple[str, str]] = {}
    for owner, topic, texts in _messages(rows, easy):
        told.update(zip(owner.tolist(), ((topic, text) for text in texts), strict=True))
    kinds, codes = _kinds(rows), rows.column("function_code").tolist()
    ids = msg_id.tolist()
    names_of = {value: context.name(value) for value in set(msg_id[easy].tolist())}
    routed = (rows.routes() != NO_ROUTE).tolist()
    for row in np.flatnonzero(easy).tolist():
        value = ids[row]
        name = names_of[value]
        if row in told:
            topic, text = told[row]
            if routed[row] or not name:
                name = topic
        else:
            text = packet_text(value, codes[row] if value & cfe.COMMAND_BIT else None)
        out[row] = _Content(kinds[row], value, name, text)
    return out


def _kinds(rows: ColumnRows) -> list[str]:
    kinds: list[str] = np.where((rows.column("msg_id") & cfe.COMMAND_BIT) != 0, "cmd", "tlm").tolist()
    peers = rows.column("sbn_msg_type")
    for value, members in by_value(peers):
        if value >= 0:
            name = MSG_TYPE_NAMES.get(value, f"0x{value:02x}")
            for row in members.tolist():
                kinds[row] = name
    return kinds


def _messages(
    rows: ColumnRows, easy: NDArray[np.bool_]
) -> Iterator[tuple[NDArray[np.int64], str, list[str]]]:
    """Yield the rows of each topic that hold messages, the topic, and the text of each.

    ``easy`` is cleared where a message has to be dissected.
    """
    context, routes = rows.context, rows.routes()
    offset, length = rows.column("cdr_offset"), rows.column("cdr_length")
    for index, owner in by_value(np.where(easy & (length > 0), routes, NO_ROUTE)):
        route = context.mission.routes[index] if index != NO_ROUTE else None
        types = context.types
        if route is None or types is None or not types.has(route.type):
            continue
        messages = types.columns(route.type, rows.batch.data, offset[owner], length[owner])
        texts = message_texts(messages, types.plan(route.type)[1])
        easy[owner[~messages.valid] if texts else owner] = False
        if texts:
            yield owner, route.topic, texts
    for bound in structs_of(rows):
        owner, messages = held_messages(bound, rows)
        layer = _LAYERS.get(bound.key.msg_id)
        plain = (routes[owner] == NO_ROUTE) & messages.valid
        if layer is None:
            texts = message_texts(messages, context.structs.types.plan(bound.type)[1], leave_out="header.")
        elif bound.shipped:
            fields, form = LAYER_TEXTS[layer.name]
            values = [np.asarray(messages.fields[name]).tolist() for name in fields]
            texts = list(map(form.format, *values))
            plain &= rows.column("packet_length")[owner] - rows.column("header_length")[owner] >= layer.size
        else:
            texts = []
        easy[owner[~plain] if texts else owner] = False
        if texts:
            yield owner, bound.topic, texts
