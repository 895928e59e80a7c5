"""One datagram through every layer, for people: named fields with their bytes, findings, and the ROS message.

Decoding is lenient: only an impossible length stops it, and what was read before stays. Offsets and findings
are the same as :mod:`edoras_tools.decode.columns` gives for a batch.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from edoras_tools.decode.findings import UNKNOWABLE
from edoras_tools.decode.links import link_of
from edoras_tools.decode.summary import summarise
from edoras_tools.errors import EdorasError, TruncatedError, WireError
from edoras_tools.model import NO_ROUTE, Datagram, Decoded, Finding, Layer, LayerField, Link, RosMessage
from edoras_tools.wire import ccsds, cfe, names, sbn
from edoras_tools.wire.cdr import CDR_BE, CDR_LE, ENCAPSULATION
from edoras_tools.wire.envelope import DEFAULT, detect
from edoras_tools.wire.limits import BRIDGE_BUFFER, BRIDGE_LENGTH_MODULUS, CI_BUFFER, SOFTWARE_BUS_MAXIMUM

if TYPE_CHECKING:
    from edoras_tools.decode.context import Context
    from edoras_tools.wire.layout import Layout

_OWN_LAYERS: Final = frozenset({cfe.EVENT.name, cfe.SOFTWARE_BUS_HOUSEKEEPING.name})
"""Layers that show a struct already."""


class Dissector:
    """Dissects datagrams one by one, in the order they were captured.

    Args:
        context: shared with the :class:`~edoras_tools.decode.columns.ColumnDecoder` of the same stream.
        detail: give every ROS field its own bytes, for the tree and the hex view.
    """

    def __init__(self, context: Context, *, detail: bool = True) -> None:
        self.context = context
        self.detail = detail

    def dissect(self, datagram: Datagram) -> Decoded:
        """Read one datagram; nothing in it can make this raise."""
        link = link_of(datagram, self.context)
        work = _Dissection(self.context, datagram, link, detail=self.detail)
        stop: EdorasError | None = None
        if link is not Link.OTHER:
            try:
                work.run()
            except WireError as error:
                stop = error
        findings = work.findings
        if Finding.CAPTURE_CUT in findings:
            findings &= ~UNKNOWABLE
        decoded = Decoded(datagram, link, tuple(work.layers), findings, work.message, stop)
        return summarise(decoded)


class _Dissection:
    """The state of one dissection: what was read so far."""

    def __init__(self, context: Context, datagram: Datagram, link: Link, *, detail: bool) -> None:
        self.context = context
        self.datagram = datagram
        self.data = datagram.payload
        self.link = link
        self.detail = detail
        self.findings = datagram.findings
        self.layers: list[Layer] = []
        self.message: RosMessage | None = None

    def run(self) -> None:
        """Go through the layers, outermost first."""
        length = len(self.data)
        if self.link is Link.CI and length > CI_BUFFER:
            self.findings |= Finding.OVER_CI_BUFFER
        if self.link is Link.TO and length > BRIDGE_BUFFER:
            self.findings |= Finding.OVER_BRIDGE_BUFFER
        if self.link is not Link.SBN:
            self.space_packet(0)
            return
        start = self.software_bus_network()
        if start is not None:
            self.space_packet(start)

    def read(self, layout: Layout, at: int, *, extra: tuple[LayerField, ...] = ()) -> dict[str, Any]:
        """Read a header, add its layer and return its values.

        Raises:
            TruncatedError: it is not whole; ``TRUNCATED`` is noted.
        """
        if len(self.data) - at < layout.size:
            self.truncated(layout.name, at, layout.size)
        values = layout.parse(self.data, at)
        fields = tuple(
            LayerField(
                slot.field.name,
                values[slot.field.name],
                at + slot.start,
                at + slot.end,
                slot.field.text(values[slot.field.name]),
                slot.field.doc,
            )
            for slot in layout.slots
        )
        self.layers.append(Layer(layout.name, layout.title, at, at + layout.size, extra + fields))
        return values

    def truncated(self, layer: str, at: int, need: int) -> None:
        """Note that a layer is cut, and stop.

        Raises:
            TruncatedError: always.
        """
        self.findings |= Finding.TRUNCATED
        raise TruncatedError(layer, at, need, max(0, len(self.data) - at))

    def software_bus_network(self) -> int | None:
        """Read the SBN header and what is its own; return where a space packet starts, if one does."""
        length = len(self.data)
        layout = sbn.LEGACY_HEADER if self._legacy() else sbn.HEADER
        if layout is sbn.LEGACY_HEADER:
            self.findings |= Finding.SBN_LEGACY_HEADER
        if (
            length >= sbn.HEADER.size
            and length % BRIDGE_LENGTH_MODULUS < sbn.HEADER.size
            and self.context.bridge_ports[self.datagram.destination.port]
        ):
            self.findings |= Finding.BRIDGE_DROPS_LENGTH
        head = self.read(layout, 0)
        payload = length - layout.size
        known = head["msg_type"] in sbn.MSG_TYPE_NAMES
        if head["msg_size"] != payload:
            self.findings |= Finding.SBN_SIZE_MISMATCH
        if not known:
            self.findings |= Finding.SBN_UNKNOWN_TYPE
        if head["msg_type"] == sbn.MsgType.NO_MSG:
            self.findings |= Finding.SBN_NO_MESSAGE
        self._identity(
            (head.get("spacecraft_id", 0), head["processor_id"]),
            trusted=known and head["msg_size"] == payload,
        )
        if head["msg_type"] in {sbn.MsgType.SUB, sbn.MsgType.UNSUB}:
            self._subscriptions(layout.size)
        elif head["msg_type"] == sbn.MsgType.PROTO:
            version = self.read(sbn.PROTO, layout.size)["protocol_version"]
            if version != sbn.PROTOCOL_VERSION:
                self.findings |= Finding.SBN_VERSION_MISMATCH
        return layout.size if head["msg_type"] == sbn.MsgType.APP else None

    def _legacy(self) -> bool:
        data, at = self.data, sbn.LEGACY_HEADER.size
        if len(data) < at:
            return False
        size, kind = int.from_bytes(data[:2], "big", signed=True), data[2]
        if size != len(data) - at or kind not in sbn.MSG_TYPE_NAMES:
            return False
        if kind == sbn.MsgType.APP:
            return (
                int.from_bytes(data[at + 4 : at + 6], "big") + ccsds.LENGTH_BIAS == size
                and size >= ccsds.PRIMARY.size
            )
        if kind == sbn.MsgType.PROTO:
            return size == sbn.PROTO.size
        if kind in {sbn.MsgType.SUB, sbn.MsgType.UNSUB}:
            return data[at : at + 1] == b"$"
        return size == 0

    def _identity(self, identity: tuple[int, int], *, trusted: bool) -> None:
        source = (self.datagram.source.address, self.datagram.source.port)
        peers, number = self.context.peers, self.datagram.number
        if trusted:
            peers.introduce(source, identity, number)
        known = peers.known(source, number)
        if known is not None and known != identity and identity not in self.context.identities:
            self.findings |= Finding.SBN_ID_MISMATCH

    def _subscriptions(self, at: int) -> None:
        head = self.read(sbn.SUBSCRIPTIONS, at)
        if self.data[at : at + sbn.IDENT_BYTES] != sbn.IDENT.encode().ljust(sbn.IDENT_BYTES, b"\0"):
            self.findings |= Finding.SBN_ID_MISMATCH
        first, need = at + sbn.SUBSCRIPTIONS.size, head["count"] * sbn.SUBSCRIPTION.size
        whole = min(head["count"], (len(self.data) - first) // sbn.SUBSCRIPTION.size)
        entries = [
            sbn.SUBSCRIPTION.parse(self.data, first + index * sbn.SUBSCRIPTION.size) for index in range(whole)
        ]
        end = first + whole * sbn.SUBSCRIPTION.size
        wanted = [entry["msg_id"] for entry in entries]
        text = ", ".join(f"0x{item:04x}" for item in wanted)
        doc = "the MsgIds wanted, or no longer wanted"
        listed = LayerField("msg_ids", wanted, first, end, text, doc)
        layer = self.layers[-1]
        self.layers[-1] = Layer(layer.name, layer.title, layer.start, end, (*layer.fields, listed))
        if len(self.data) - first < need:
            self.truncated("sbn_subscription", first, need)

    def space_packet(self, start: int) -> None:
        """Read the primary header, and all that lies behind it."""
        data = self.data
        length = len(data) - start
        if length < ccsds.PRIMARY.size:
            self.truncated("ccsds", start, ccsds.PRIMARY.size)
        word = int.from_bytes(data[start : start + 2], "big")
        extra = cfe.EXTENDED.size if self.context.options.extended_header else 0
        msg_id = self._msg_id(word, start)
        name = self._name(msg_id)
        self.read(
            ccsds.PRIMARY,
            start,
            extra=(
                LayerField(
                    "msg_id",
                    msg_id,
                    start,
                    start + 2,
                    f"0x{msg_id:04x} {name}".strip(),
                    "cFE's key: the first word",
                ),
            ),
        )
        total = int.from_bytes(data[start + 4 : start + 6], "big") + ccsds.LENGTH_BIAS
        command = bool(word & cfe.COMMAND_BIT)
        if total != length:
            self.findings |= Finding.LENGTH_MISMATCH
        if data[start + 2 : start + 4] == b"\0\0":
            self.findings |= Finding.SEQUENCE_UNSET
        if total > SOFTWARE_BUS_MAXIMUM:
            self.findings |= Finding.OVER_SOFTWARE_BUS
        if not 0 < msg_id <= cfe.HIGHEST_MSG_ID:
            self.findings |= Finding.INVALID_MSG_ID
        elif not self.context.known[msg_id]:
            self.findings |= Finding.UNKNOWN_MSG_ID
        if (self.link is Link.CI and not command) or (self.link is Link.TO and command):
            self.findings |= Finding.WRONG_DIRECTION

        as_command = cfe.COMMAND_HEADER_BYTES + extra
        bare = not command and length == as_command == total
        header = as_command if command or bare else self.context.options.telemetry_header + extra
        if bare:
            self.findings |= Finding.HEADER_ONLY
        if extra and length >= ccsds.PRIMARY.size + extra:
            self.read(cfe.EXTENDED, start + ccsds.PRIMARY.size)
        if length < header:
            self.truncated(
                "cfe_command" if command else "cfe_telemetry", start + ccsds.PRIMARY.size, header - 6
            )
        at = start + ccsds.PRIMARY.size + extra
        if command or bare:
            code = self.read(cfe.COMMAND, at)["function_code"]
        else:
            code = None
            short = self.context.options.telemetry_header == 12
            self.read(cfe.TELEMETRY_SHORT if short else cfe.TELEMETRY, at)
        if command:
            self._command(msg_id, code or 0, start, min(length, total), extra)
        if bare:
            self._struct(msg_id, start, header, code)
            return
        self._payload(msg_id, start, header, code)

    def _msg_id(self, word: int, start: int) -> int:
        after = start + ccsds.PRIMARY.size
        if not self.context.options.extended_header or len(self.data) < after + cfe.EXTENDED.size:
            return word
        subsystem = cfe.EXTENDED.parse(self.data, after)["subsystem_id"]
        return cfe.extended_msg_id(word & 0x7FF, word >> 12 & 1, subsystem)

    def _name(self, msg_id: int) -> str:
        route = int(self.context.any_route_of[msg_id])
        if route != NO_ROUTE:
            return names.message_name(msg_id) or self.context.mission.routes[route].topic
        return names.message_name(msg_id) or self.context.structs.name(msg_id)

    def _command(self, msg_id: int, code: int, start: int, length: int, extra: int) -> None:
        """Judge a command's checksum and function code."""
        packet = self.data[start : start + length]
        if cfe.checksum(packet) != 0:
            absent = self.data[start + ccsds.PRIMARY.size + extra + 1] == 0
            self.findings |= Finding.CHECKSUM_ABSENT if absent else Finding.CHECKSUM_BAD
        commands = self.context.commands(msg_id)
        if commands is None:
            return
        command = commands.get(code)
        if command is None:
            self.findings |= Finding.UNKNOWN_FUNCTION_CODE
        elif command.lengths and len(self.data) - start - extra not in command.lengths:
            self.findings |= Finding.COMMAND_LENGTH

    def _payload(self, msg_id: int, start: int, header: int, code: int | None) -> None:
        """Read what lies behind the cFE header: an event, housekeeping, or a route's envelope."""
        at, length = start + header, len(self.data) - start
        exact = int(self.context.route_of[self.link, msg_id])
        route = exact if exact != NO_ROUTE else int(self.context.any_route_of[msg_id])
        if route == NO_ROUTE:
            for known, layout in (
                (cfe.EVENT_MSG_ID, cfe.EVENT),
                (cfe.SOFTWARE_BUS_HOUSEKEEPING_MSG_ID, cfe.SOFTWARE_BUS_HOUSEKEEPING),
            ):
                if msg_id == known and len(self.data) - at >= layout.size:
                    self.read(layout, at)
            self._struct(msg_id, start, header, code)
            return
        if length == header:
            if Finding.LENGTH_MISMATCH in self.findings:
                self.truncated("edoras", at, 1)
            if code != 0:
                self.findings |= Finding.HEADER_ONLY
            return
        self._envelope(route, at)

    def _struct(self, msg_id: int, start: int, header: int, code: int | None) -> None:
        """Read the C struct that a packet without a route holds, as a message."""
        length = len(self.data) - start - header
        bound = self.context.structs.find(msg_id, code, length)
        if bound is None:
            return
        if not bound.fits(length):
            self.findings |= Finding.STRUCT_LENGTH
            return
        peer = self.layers[0].values() if self.link is Link.SBN else {}
        sequence = ccsds.PRIMARY.parse(self.data, start)["packet_sequence_count"]
        origin = (peer.get("processor_id", 0), msg_id, sequence, code or 0, self.link)
        cdr = bound.encode_one(self.data[start + header :], origin)
        values = self.context.structs.types.decode(bound.type, cdr)
        self.message = RosMessage(bound.type, bound.topic, values, cdr)
        if self.detail and not any(layer.name in _OWN_LAYERS for layer in self.layers):
            fields = tuple(
                LayerField(
                    path,
                    value,
                    start + header + low,
                    start + header + high,
                    bound.text(member, value),
                    member.doc,
                )
                for path, value, low, high, member in bound.spans(values, length)
            )
            title = f"{bound.name}: {bound.struct.doc}" if bound.struct.doc else bound.name
            self.layers.append(Layer("cfs", title, start + header, len(self.data), fields))

    def _envelope(self, route: int, at: int) -> None:
        envelope = self.context.envelopes[route] or detect(self.data, at) or DEFAULT
        values = self.read(envelope.layout, at)
        start, claimed = at + envelope.size, values["buffer_length"]
        space = len(self.data) - start
        if claimed > space or values["buffer_capacity"] < claimed:
            self.findings |= Finding.ENVELOPE_OVERRUN
        if claimed > space:
            raise TruncatedError("cdr", start, claimed, space)
        if claimed < ENCAPSULATION.size:
            self.findings |= Finding.CDR_INVALID
            raise TruncatedError("cdr", start, ENCAPSULATION.size, claimed)
        end = start + claimed
        if any(self.data[end:]):
            self.findings |= Finding.STALE_TAIL
        representation = self.read(ENCAPSULATION, start)["representation"]
        if representation == CDR_BE:
            self.findings |= Finding.CDR_BIG_ENDIAN
        try:
            self._body(route, start, end, representation)
        except WireError:
            self.findings |= Finding.CDR_INVALID
            raise
        finally:
            if end < len(self.data):
                self._padding(end)

    def _body(self, route: int, start: int, end: int, representation: int) -> None:
        if representation not in {CDR_BE, CDR_LE}:
            why = f"cdr at byte {start} has representation 0x{representation:04x}; CDR is 0x0000 or 0x0001"
            raise WireError(why)
        name, topic = self.context.mission.routes[route].type, self.context.mission.routes[route].topic
        types = self.context.types
        if types is None or not types.has(name):
            return
        cdr = self.data[start:end]
        self.message = RosMessage(name, topic, types.decode(name, cdr), cdr)
        if self.detail:
            fields = tuple(
                LayerField(path, value, start + low, start + high)
                for path, value, low, high in types.spans(name, cdr)
            )
            self.layers.append(Layer("ros", name, start + ENCAPSULATION.size, end, fields))

    def _padding(self, start: int) -> None:
        tail = self.data[start:]
        doc = "after the CDR: the flight app sends a struct of fixed size"
        field = LayerField("length", len(tail), start, len(self.data), f"{len(tail)} bytes", doc)
        stale = any(tail)
        text = "yes: bytes of an earlier, longer message" if stale else "no: zeros"
        fields = (field, LayerField("stale", stale, start, len(self.data), text))
        self.layers.append(Layer("padding", "Padding", start, len(self.data), fields))
