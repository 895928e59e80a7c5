"""One datagram through every layer, for people: named fields with their bytes, findings, and the ROS message.

Decoding is lenient: only an impossible length stops it, and all that was read before is kept. Offsets and
findings are the same as those of :mod:`edoras_tools.decode.columns` for a batch.

A message of a recording without datagrams is a row whose route is its topic (``PacketBatch.recorded``): it
has no link and no MsgId, only a time, bytes and values.
"""

from __future__ import annotations

import json
from copy import copy
from typing import TYPE_CHECKING, Final

from msgspec.structs import replace

from edoras_tools import model
from edoras_tools.cfs.software_bus import SOFTWARE_BUS_MAXIMUM
from edoras_tools.decode.columns import link_of
from edoras_tools.decode.summary import leaves_of, short_values, summarise
from edoras_tools.errors import EdorasError, TruncatedError, WireError
from edoras_tools.links.doors import Endpoints, Peers, Reading
from edoras_tools.links.table import protocol
from edoras_tools.model import NO_FINDINGS, OTHER, Decoded, Finding, Layer, LayerField, RosMessage
from edoras_tools.structs.shapes import OWN_LAYERS
from edoras_tools.wire import ccsds, cfe
from edoras_tools.wire.envelope import CDR_BE, CDR_LE, DEFAULT, ENCAPSULATION, ROUNDED, detect

if TYPE_CHECKING:
    from edoras_tools.decode.context import Context
    from edoras_tools.mission import RecordedTopic
    from edoras_tools.model import Datagram
    from edoras_tools.ros import TypeStore


class Dissector:
    """Dissects datagrams one by one, in the order they were captured.

    Args:
        context: shared with the :class:`~edoras_tools.decode.columns.ColumnDecoder` of the same stream.
        detail: whether every ROS field gets its own bytes, for the tree and the hex view.
    """

    def __init__(self, context: Context, *, detail: bool = True) -> None:
        self.context = context
        self.detail = detail

    def dissect(self, datagram: model.Datagram) -> model.Decoded:
        """Read one datagram; nothing in it can make this raise."""
        if datagram.topic != model.NO_ROUTE:
            return dissect_recorded(datagram, self.context, detail=self.detail)
        link = link_of(datagram, self.context)
        context = self.context.of(self.context.spacecraft.of(datagram, link))
        work = _Dissection(context, datagram, link, detail=self.detail)
        stop: EdorasError | None = None
        if link is not model.OTHER:
            try:
                work.run()
            except WireError as error:
                stop = error
        findings = work.findings
        if model.Finding.CAPTURE_CUT in findings:
            findings &= ~model.UNKNOWABLE
        decoded = model.Decoded(
            datagram, link, tuple(work.layers), findings, work.message, stop, more=tuple(work.more)
        )
        decoded = summarise(decoded, self.context.msg_ids)
        return replace(decoded, summary=self._with_quote(decoded)) if link.quotes else decoded

    def _with_quote(self, decoded: model.Decoded) -> str:
        """Return the summary of a message, with a description of the datagram that it quotes."""
        quoted = protocol(decoded.link).quoted(decoded.datagram)
        context = copy(self.context)
        # Peers and endpoints are learnt only from datagrams that were captured themselves.
        context.peers, context.endpoints = Peers(), Endpoints()
        inside = Dissector(context, detail=False).dissect(quoted)
        if packet := inside.layer(ccsds.PRIMARY.name):
            text = packet.fields[0].text
        else:
            text = inside.summary if quoted.payload else f"{quoted.original_length} bytes"
        name = "" if inside.link is model.OTHER else f"{inside.link.name} "
        return f"{decoded.summary}: {quoted.destination} did not get {name}{text}"


class _Dissection(Reading):
    """The state of one dissection: the layers so far."""

    def __init__(self, context: Context, datagram: model.Datagram, link: model.Link, *, detail: bool) -> None:
        super().__init__(datagram)
        self.context = context
        self.link = link
        self.detail = detail
        self.message: model.RosMessage | None = None
        self.more: list[model.RosMessage] = []
        self.headers = context.headers

    def run(self) -> None:
        """Go through the layers, outermost first."""
        room = self.link.receive_buffer
        # cFS uses the length in the header: bytes cut after it are no loss.
        if room and len(self.data) > room and not (self.link.to_cfs and cfe.length_of(self.data) <= room):
            self.findings |= self.link.over_receive_buffer
        start = protocol(self.link).dissect(self, self.context)
        if start is not None:
            self.space_packet(start)
        elif self.link.last_hop:
            key = int(self.context.structs.of_port(self.datagram.destination.port))
            self._struct(key, len(self.data), 0, (0, 0, 0, 0, self.link))

    def space_packet(self, start: int) -> None:
        """Read the primary header and everything after it."""
        data = self.data
        length = len(data) - start
        if length < ccsds.PRIMARY.size:
            self.truncated("ccsds", start, ccsds.PRIMARY.size)
        packet = data[start:]
        headers = self.headers = self.context.builds.of_packet(self.datagram, packet)
        msg_ids = self.context.msg_ids
        msg_id = msg_ids.of(packet)
        name = self.context.name(msg_id)
        self.read(
            ccsds.PRIMARY,
            start,
            extra=(
                model.LayerField(
                    "msg_id",
                    msg_id,
                    start,
                    start + 2,
                    f"0x{msg_id:04x} {name}".strip(),
                    f"cFE's key: {msg_ids.made_of}",
                ),
            ),
        )
        total = cfe.length_of(packet)
        command = msg_ids.is_command(msg_id)
        if total != length:
            self.findings |= model.Finding.LENGTH_MISMATCH
        if data[start + 2 : start + 4] == b"\0\0":
            self.findings |= model.Finding.SEQUENCE_UNSET
        if total > SOFTWARE_BUS_MAXIMUM:
            self.findings |= model.Finding.OVER_SOFTWARE_BUS
        if not 0 < msg_id <= cfe.HIGHEST_MSG_ID:
            self.findings |= model.Finding.INVALID_MSG_ID
        elif not self.context.known[msg_id]:
            self.findings |= model.Finding.UNKNOWN_MSG_ID
        if self.context.against[int(command), self.link]:
            self.findings |= model.Finding.WRONG_DIRECTION

        as_command = headers.command_bytes
        bare = not command and length == as_command == total and as_command < headers.telemetry_bytes
        header = as_command if command or bare else headers.telemetry_bytes
        if bare:
            self.findings |= model.Finding.HEADER_ONLY
        if headers.extended and length >= headers.start:
            self.read(cfe.EXTENDED, start + ccsds.PRIMARY.size)
        if length < header:
            self.truncated(
                "cfe_command" if command else "cfe_telemetry", start + ccsds.PRIMARY.size, header - 6
            )
        at = start + headers.start
        if command or bare:
            code = self.read(headers.command, at)["function_code"]
        else:
            code = None
            self.read(self.context.in_order(headers.telemetry), at)
        if command:
            self._command(msg_id, code or 0, start, min(length, total))
        if bare:
            self._packet_struct(msg_id, start, header, code)
            return
        self._payload(msg_id, start, header, code)

    def _command(self, msg_id: int, code: int, start: int, length: int) -> None:
        """Judge a command's checksum and function code."""
        packet = self.data[start : start + length]
        if cfe.checksum(packet) != 0:
            absent = self.data[start + self.headers.start + 1] == 0
            self.findings |= model.Finding.CHECKSUM_ABSENT if absent else model.Finding.CHECKSUM_BAD
        commands = self.context.commands(msg_id)
        if commands is None:
            return
        command = commands.get(code)
        # Its lengths are those with the usual header.
        length = len(self.data) - start - self.headers.command_bytes + cfe.COMMAND_HEADER_BYTES
        if command is None:
            self.findings |= model.Finding.UNKNOWN_FUNCTION_CODE
        elif command.lengths and length not in command.lengths:
            self.findings |= model.Finding.COMMAND_LENGTH

    def _payload(self, msg_id: int, start: int, header: int, code: int | None) -> None:
        """Read the payload after the cFE header: an event, housekeeping, or a route's envelope."""
        at, length = start + header, len(self.data) - start
        if msg_id in self.context.pdu_msg_ids:
            for link in self.context.in_packets:
                link.read_unit(self, at)
            return
        exact = int(self.context.routes_on(self.link)[msg_id])
        route = exact if exact != model.NO_ROUTE else int(self.context.any_route_of[msg_id])
        if route == model.NO_ROUTE:
            layout = cfe.PAYLOADS.get(self.context.msg_ids.standard(msg_id))
            if layout is not None and len(self.data) - at >= layout.size:
                self.read(self.context.in_order(layout), at)
            self._packet_struct(msg_id, start, header, code)
            return
        if length == header:
            if model.Finding.LENGTH_MISMATCH in self.findings:
                self.truncated("edoras", at, 1)
            if code != 0:
                self.findings |= model.Finding.HEADER_ONLY
            return
        self._envelope(route, at)

    def _packet_struct(self, msg_id: int, start: int, header: int, code: int | None) -> None:
        """Read the C struct in a packet without a route."""
        peer = self.layers[0].values() if self.link.peers else {}
        sequence = ccsds.PRIMARY.parse(self.data, start)["packet_sequence_count"]
        origin = (peer.get("processor_id", 0), msg_id, sequence, code or 0, self.link)
        self._struct(msg_id, code, start + header, origin)

    def _struct(self, key: int, code: int | None, at: int, origin: tuple[int, ...]) -> None:
        """Read a C struct to the end of the datagram, as a message; key and code are those of ``Key``."""
        length = len(self.data) - at
        bound = self.context.structs.find(key, code, length)
        if bound is None:
            return
        if not bound.fits(length):
            if model.Finding.COMMAND_LENGTH not in self.findings:  # that finding is enough
                self.findings |= model.Finding.STRUCT_LENGTH
            return
        cdr = bound.encode_one(self.data[at:], origin)
        values = self.context.structs.types.decode(bound.type, cdr)
        self.message = model.RosMessage(bound.type, bound.topic, values, cdr, bound.shipped)
        dissected = bound.shipped and any(layer.name in OWN_LAYERS for layer in self.layers)
        if self.detail and not dissected:
            fields = tuple(
                model.LayerField(path, value, at + low, at + high, bound.text(member, value), member.doc)
                for path, value, low, high, member in bound.spans(values, length)
            )
            title = f"{bound.name}: {bound.struct.doc}" if bound.struct.doc else bound.name
            self.layers.append(model.Layer("cfs", title, at, len(self.data), fields))

    def described(self, kind: int, at: int, end: int) -> bool:
        """Read the content of a packet by a dictionary; see :meth:`Reading.described`."""
        table = self.context.structs.dictionary
        return table is not None and table.read(self, kind, at, end)

    def sample(self, topic: str, type_name: str, at: int, end: int) -> None:
        """Read a sample of DDS as a message; see :meth:`Reading.sample`."""
        types = self.context.types
        if types is None or not types.has(type_name) or end - at < ENCAPSULATION.size:
            return
        if self.read(ENCAPSULATION, at)["representation"] not in {CDR_BE, CDR_LE}:
            return
        try:
            values = types.decode(type_name, self.data[at:end])
        except WireError:
            self.findings |= model.Finding.CDR_INVALID
            return
        cdr = self.data[at : at + types.extent(type_name, self.data[at:end])]
        self.add(model.RosMessage(type_name, topic, values, cdr))
        self._detail(types, type_name, cdr, at, end)

    def _detail(self, types: TypeStore, name: str, cdr: bytes, at: int, end: int) -> None:
        """Add a layer with the fields of a message that begins at a byte, if details are requested."""
        if self.detail:
            spans = types.spans(name, cdr)
            fields = tuple(
                model.LayerField(path, value, at + low, at + high) for path, value, low, high in spans
            )
            self.layers.append(model.Layer("ros", name, at + ENCAPSULATION.size, end, fields))

    def add(self, message: model.RosMessage, *layers: model.Layer) -> None:
        """Add a message after those read before; see :meth:`Reading.add`."""
        self.layers += layers
        if self.message is None:
            self.message = message
        else:
            self.more.append(message)

    def _envelope(self, route: int, at: int) -> None:
        envelope = self.context.envelopes[route] or detect(self.data, at) or DEFAULT
        values = self.read(envelope.layout, at)
        start, claimed = at + envelope.size, values["buffer_length"]
        space = max(0, len(self.data) - start - envelope.crc)
        if claimed > space or values.get("buffer_capacity", claimed) < claimed:
            self.findings |= model.Finding.ENVELOPE_OVERRUN
        if claimed > space:
            raise TruncatedError("cdr", start, claimed, space)
        if claimed < ENCAPSULATION.size:
            self.findings |= model.Finding.CDR_INVALID
            raise TruncatedError("cdr", start, ENCAPSULATION.size, claimed)
        end = start + claimed
        if not envelope.intact(self.data, at, claimed):
            self.findings |= model.Finding.CHECKSUM_BAD
        rest = end + envelope.crc
        if any(self.data[rest:]):
            self.findings |= model.Finding.STALE_TAIL
        representation = self.read(ENCAPSULATION, start)["representation"]
        if representation == CDR_BE:
            self.findings |= model.Finding.CDR_BIG_ENDIAN
        try:
            self._body(route, start, end, representation)
        except WireError:
            self.findings |= model.Finding.CDR_INVALID
            raise
        finally:
            if envelope.trailer is not None:
                self.read(envelope.trailer, end)
            if rest < len(self.data):
                self._padding(rest)

    def _body(self, route: int, start: int, end: int, representation: int) -> None:
        if representation not in {CDR_BE, CDR_LE}:
            why = f"cdr at byte {start} has representation 0x{representation:04x}; CDR is 0x0000 or 0x0001"
            raise WireError(why)
        name, topic = self.context.mission.routes[route].type, self.context.mission.routes[route].topic
        types = self.context.types
        if types is None or not types.has(name):
            return
        cdr = self.data[start:end]
        self.message = model.RosMessage(name, topic, types.decode(name, cdr), cdr)
        trailing = len(cdr) - types.extent(name, cdr)
        if trailing > types.most_trailing(name):
            self.findings |= model.Finding.CDR_TOO_LONG
        elif trailing > ROUNDED:
            self.findings |= model.Finding.CDR_TRAILING
        self._detail(types, name, cdr, start, end)

    def _padding(self, start: int) -> None:
        tail = self.data[start:]
        doc = "after the CDR: the flight app sends a struct of fixed size"
        field = model.LayerField("length", len(tail), start, len(self.data), f"{len(tail)} bytes", doc)
        stale = any(tail)
        text = "yes: bytes of an earlier, longer message" if stale else "no: zeros"
        fields = (field, model.LayerField("stale", stale, start, len(self.data), text))
        self.layers.append(model.Layer("padding", "Padding", start, len(self.data), fields))


JSON_ENCODING: Final = "json"
RECORDED_LAYER: Final = "recorded"
"""Name of the layer with the recording's fields of a message."""


def dissect_recorded(datagram: Datagram, context: Context, *, detail: bool) -> Decoded:
    """Return the complete decoding of one message; see ``Dissector``."""
    topic, route = context.mission.recorded[datagram.topic], context.mission.routes[datagram.topic]
    data, findings = datagram.payload, NO_FINDINGS
    about = {"topic": route.topic, "type": topic.type, "encoding": topic.encoding}
    fields = tuple(LayerField(name, text, 0, 0) for name, text in about.items())
    layers: tuple[Layer, ...] = (Layer(RECORDED_LAYER, "Recorded message", 0, len(data), fields),)
    message: RosMessage | None = None
    stop: EdorasError | None = None
    if topic.encoding == JSON_ENCODING:
        message, stop = _json(topic, route.topic, data)
        if detail and message:
            leaves = tuple(LayerField(path, value, 0, len(data)) for path, value in leaves_of(message.values))
            layers += (Layer("ros", topic.type or JSON_ENCODING, 0, len(data), leaves),)
    elif topic.unread or context.types is None:
        stop = WireError(topic.unread)
    else:
        try:
            message = RosMessage(topic.type, route.topic, context.types.decode(topic.type, data), data)
            if detail:
                layers += _values(topic.type, data, context)
        except WireError as error:
            findings, stop = Finding.CDR_INVALID, error
    summary = short_values(message.values) if message else str(stop)
    return Decoded(datagram, OTHER, layers, findings, message, stop, summary)


def recorded_topic(decoded: Decoded) -> tuple[str, str]:
    """Return topic and type of a message that ``dissect_recorded`` read, or could not read."""
    layer = decoded.layer(RECORDED_LAYER)
    assert layer is not None, "it is a message of a recording"
    values = layer.values()
    return values["topic"], values["type"]


def _json(topic: RecordedTopic, name: str, data: bytes) -> tuple[RosMessage | None, EdorasError | None]:
    try:
        values = json.loads(data)
    except (ValueError, RecursionError) as error:
        return None, WireError(f"is not JSON: {str(error).partition(chr(10))[0]}")
    values = values if isinstance(values, dict) else {"value": values}
    return RosMessage(topic.type, name, values, data), None


def _values(kind: str, data: bytes, context: Context) -> tuple[Layer, ...]:
    assert context.types is not None, "the type is known"
    spans = context.types.spans(kind, data)
    values = tuple(LayerField(path, value, low, high) for path, value, low, high in spans)
    return (Layer("ros", kind, ENCAPSULATION.size, len(data), values),)
