"""The line of a packet in lists: from its layers, or for many packets from their columns.

Columns are used for packets whose message has single values and lists of them, and whose layers have no text
of their own, and for packets that end before their message; ``Contents`` decides which
of them are dissected, too.

Rules of all values that are derived from many packets:

1. Both ways give the same value for every packet; ``tests/decode/test_agreement.py`` compares them.
2. Columns are used for packets that are decoded to their end. Other packets, with a finding that ends their
   decoding or without a space packet, are dissected unless the columns suffice for the value.
3. The value of a datagram without a space packet depends only on its bytes and is cached: heartbeats and
   subscriptions are repeated.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any, Final, Generic, NamedTuple, TypeVar

import msgspec
import numpy as np

from edoras_tools.cfs.arguments import ARGUMENTS, argument_words
from edoras_tools.decode.filters.layers import held_messages, slot_values, structs_of
from edoras_tools.decode.stack import Dissector, recorded_topic
from edoras_tools.decode.summary import LAYER_TEXTS, message_texts, packet_text
from edoras_tools.errors import TruncatedError
from edoras_tools.links import table
from edoras_tools.links.table import among
from edoras_tools.model import NO_MSG_ID, NO_ROUTE, OTHER, Decoded, Endpoint, Finding, Link
from edoras_tools.wire import ccsds, cfe
from edoras_tools.wire.arrays import Integers, Mask, Places, by_value, gather, numbered
from edoras_tools.wire.ccsds import VERSION_1
from edoras_tools.wire.sbn import MSG_TYPE_NAMES

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.decode.context import Context
    from edoras_tools.decode.filters.rows import ColumnRows
    from edoras_tools.ros.cdr.bulk import MessageColumns
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
        whole: Mask = rows.column("cdr_length") > 0
    else:
        whole = (rows.column("packet_offset") >= 0) & (rows.column("header_length") > 0)
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
    for bound in (bound for bound in structs_of(rows) if commands or not bound.command):
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


_ENDED: Final = Finding.TRUNCATED | Finding.ENVELOPE_OVERRUN | Finding.CDR_INVALID | Finding.HEADER_ONLY
"""Findings of packets that may end before their message."""
_OTHERWISE: Final = Finding.CAPTURE_CUT | Finding.SBN_LEGACY_HEADER
"""Findings of packets whose columns do not show their content."""


class PacketLine(msgspec.Struct, frozen=True):
    """The contents of a packet's line.

    Attributes:
        number: place of its frame in the source, from 1.
        time_ns: capture time, ns since 1970.
        link: link of the packet.
        source: endpoint that sent it.
        destination: endpoint that it was sent to.
        length: captured bytes of the UDP payload.
        findings: findings of the decoder.
        kind: ``cmd``, ``tlm``, an SBN message type such as ``SUB`` or ``APP``, or empty.
        msg_id: MsgId of the space packet; ``NO_MSG_ID`` if there is none.
        name: topic, else the name of the MsgId, else empty.
        text: summary, or the reason why decoding ended.
        type: type of a message without a datagram; empty for packets.
    """

    number: int
    time_ns: int
    link: Link
    source: Endpoint
    destination: Endpoint
    length: int
    findings: Finding
    kind: str
    msg_id: int
    name: str
    text: str
    type: str = ""


class _Content(NamedTuple):
    """The end of a line, which describes a packet's content; see ``PacketLine``."""

    kind: str
    msg_id: int
    name: str
    text: str
    type: str = ""


def line_of(decoded: Decoded) -> PacketLine:
    """Return the line of a packet."""
    of, content = decoded.datagram, _content(decoded)
    length, findings = len(of.payload), decoded.findings
    return PacketLine(
        of.number, of.time_ns, decoded.link, of.source, of.destination, length, findings, *content
    )


class PacketLines:
    """Makes the lines of many packets.

    Args:
        context: shared with the decoder of the same stream.
    """

    def __init__(self, context: Context) -> None:
        self._contents = Contents(context, _content, _contents)

    def of(self, rows: ColumnRows) -> Iterator[PacketLine]:
        """Yield the line of each row, in order."""
        links = links_of(rows)
        flags = {bits: Finding(bits) for bits in set(rows.column("findings").tolist())}
        pairs, which = endpoints(rows)
        columns = zip(
            rows.datagram("number").tolist(),
            rows.datagram("time_ns").tolist(),
            rows.column("link").tolist(),
            which.tolist(),
            rows.datagram("length").tolist(),
            rows.column("findings").tolist(),
            self._contents.of(rows),
            strict=True,
        )
        for number, time_ns, code, pair, length, findings, content in columns:
            link, (source, destination) = links[code], pairs[pair]
            yield PacketLine(number, time_ns, link, source, destination, length, flags[findings], *content)


def _content(decoded: Decoded) -> _Content:
    kind, name, type_, msg_id = "", "", "", NO_MSG_ID
    if (peer := decoded.layer("sbn")) and "msg_type" in (values := peer.values()):
        kind = _peer_kind(values["msg_type"])
    if (packet := decoded.layer("ccsds")) and "packet_type" in (values := packet.values()):
        first = packet.fields[0]  # the dissection puts the MsgId in front
        msg_id, name = first.value, first.text.partition(" ")[2]
        kind = kind or ("cmd" if values["packet_type"] else "tlm")
    if decoded.datagram.topic != NO_ROUTE:
        name, type_ = recorded_topic(decoded)
    elif decoded.message and (
        not name or decoded.layer("edoras") or (kind == "cmd" and not decoded.message.shipped)
    ):
        name = decoded.message.topic  # for a C struct the packet's own name is as clear, and shorter
    text = decoded.summary or (str(decoded.stop) if decoded.stop else "")
    return _Content(kind, msg_id, name, text, type_)


def _peer_kind(msg_type: int) -> str:
    return MSG_TYPE_NAMES.get(msg_type, f"0x{msg_type:02x}")


def _contents(rows: ColumnRows) -> list[_Content | None]:
    """Return the contents of packets whose columns are enough; None for the others."""
    out: list[_Content | None] = [None] * len(rows)
    msg_id, context = rows.column("msg_id"), rows.context
    easy = read_whole(rows)
    if rows.batch.recorded is not None:
        for owner, topic, kind, texts in _messages(rows, easy):
            for row, text in zip(owner.tolist(), texts, strict=True):
                out[row] = _Content("", NO_MSG_ID, topic, text, kind) if easy[row] else None
        return out
    contents: dict[int, tuple[str, str]] = {}
    for owner, topic, _, texts in _messages(rows, easy):
        contents.update(zip(owner.tolist(), ((topic, text) for text in texts), strict=True))
    commands = dict(_commands(rows, easy))
    kinds, codes = _kinds(rows), rows.column("function_code").tolist()
    ids, lengths = msg_id.tolist(), rows.datagram("length").tolist()
    header = rows.column("header_length").tolist()
    names_of = {value: context.name(value) for value in set(msg_id[easy].tolist())}
    routed = (rows.routes() != NO_ROUTE).tolist()
    for row in np.flatnonzero(easy).tolist():
        value = ids[row]
        name = names_of[value]
        if row in contents:
            topic, text = contents[row]
            if routed[row] or not name or context.msg_ids.is_command(value):
                name = topic
        elif row in commands:
            text = commands[row]
        else:
            code = codes[row] if context.msg_ids.is_command(value) else None
            text = packet_text(context.msg_ids.standard(value), code)
        out[row] = _Content(kinds[row], value, name, text)
    for row in np.flatnonzero(_without_message(rows)).tolist():
        value = ids[row]
        command = context.msg_ids.is_command(value)
        headless = header[row] == ccsds.PRIMARY.size
        text = packet_text(context.msg_ids.standard(value), codes[row] if command and not headless else None)
        text = text or (_cut_header(rows, row, command=command) if headless else "")
        if text:  # else the text is the reason why decoding ended
            out[row] = _Content(kinds[row], value, context.name(value), text)
    for row in np.flatnonzero(rows.column("link") == OTHER).tolist():
        out[row] = _Content("", NO_MSG_ID, "", f"{lengths[row]} bytes")
    return out


def _cut_header(rows: ColumnRows, row: int, *, command: bool) -> str:
    """Return the error that ends the dissection of a packet with an incomplete cFE header."""
    headers = cfe.HEADERS[int(rows.column("headers")[row])]
    whole = headers.command_bytes if command else headers.telemetry_bytes
    at = int(rows.column("packet_offset")[row] - rows.datagram("offset")[row]) + ccsds.PRIMARY.size
    have = int(rows.datagram("length")[row]) - at
    layer = "cfe_command" if command else "cfe_telemetry"
    return str(TruncatedError(layer, at, whole - ccsds.PRIMARY.size, have))


def _without_message(rows: ColumnRows) -> Mask:
    """Return which rows hold a packet that ends, or is wrong, before its message: only a header is shown."""
    findings, context = rows.column("findings"), rows.context
    headless = rows.column("header_length") == ccsds.PRIMARY.size
    invalid = (findings & np.uint32(Finding.CDR_INVALID)) != 0
    unread = (rows.routes() != NO_ROUTE) & ((rows.column("cdr_length") == 0) | invalid)
    if context.msg_ids is VERSION_1:
        unread |= headless
    else:
        unread &= ~headless
    # Telemetry of the length of a command may be a struct without members.
    command = context.msg_ids.is_command(rows.column("msg_id"))
    unread &= command | ((findings & np.uint32(Finding.HEADER_ONLY)) == 0)
    unread &= ~among(rows.column("link"), lambda link: link.dictionary)
    unread &= (rows.column("packet_offset") >= 0) & ((findings & np.uint32(_OTHERWISE)) == 0)
    return np.asarray(unread & ((findings & np.uint32(_ENDED)) != 0))


def _commands(rows: ColumnRows, easy: Mask) -> Iterator[tuple[int, str]]:
    """Yield the rows that hold a command of the built-in table, and its text."""
    for bound, packets in structs_of(rows).items():
        if not bound.command:
            continue
        owner = packets.rows[easy[packets.rows]]
        key = rows.context.msg_ids.standard(bound.key.msg_id), bound.key.function_code or 0
        layout, header = rows.context.in_order(ARGUMENTS[key]), rows.column("header_length")[owner]
        payloads = gather(rows.batch.data, rows.column("packet_offset")[owner] + header, layout.size)
        words = [[layout.title] * len(owner)]
        for slot, word in argument_words(*key):
            raw = payloads[:, slot.start : slot.end]
            if slot.field.kind == "text":
                raw = np.where(raw < 0x80, raw, np.uint8(ord("?")))  # as in ROS's strings
            words.append(_worded(slot_values(layout, slot, raw), word))
        yield from zip(owner.tolist(), map("".join, zip(*words, strict=True)), strict=True)


def _worded(values: list[Any] | NDArray[Any], word: Callable[[Any], str]) -> list[str]:
    """Return each value in words; equal values are converted once."""
    every = values if isinstance(values, list) else values.tolist()
    unlike = {value: word(value) for value in set(every)}
    return [unlike[value] for value in every]


def _kinds(rows: ColumnRows) -> list[str]:
    command = rows.context.msg_ids.is_command(rows.column("msg_id"))
    kinds: list[str] = np.where(command, "cmd", "tlm").tolist()
    peers = rows.column("sbn_msg_type")
    for value, members in by_value(peers):
        if value >= 0:
            name = _peer_kind(value)
            for row in members.tolist():
                kinds[row] = name
    return kinds


def _messages(rows: ColumnRows, easy: Mask) -> Iterator[tuple[Integers, str, str, list[str]]]:
    """Yield the rows of each topic with messages, the topic, its type, and the text of each message.

    ``easy`` is cleared for messages that have to be dissected.
    """
    routes = rows.routes()
    for owner, topic, kind, messages, plan, bound in message_rows(rows, easy.copy(), commands=False):
        layer = cfe.PAYLOADS.get(rows.context.msg_ids.standard(bound.key.msg_id)) if bound else None
        plain = messages.valid
        if bound:
            plain = plain & (routes[owner] == NO_ROUTE)
        if layer is None:
            texts = message_texts(messages, plan, leave_out="header." if bound else " ")
        elif bound and bound.shipped:
            fields, form = LAYER_TEXTS[layer.name]
            values = [np.asarray(messages.fields[name]).tolist() for name in fields]
            texts = list(map(form.format, *values))
            # In ROS's strings a byte that is not ASCII is a question mark.
            plain &= np.array(["?" not in text for text in texts], np.bool_)
            plain &= rows.column("packet_length")[owner] - rows.column("header_length")[owner] >= layer.size
        else:
            texts = []
        easy[owner[~plain] if texts else owner] = False
        if texts:
            yield owner, topic, kind, texts
