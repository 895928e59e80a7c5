"""CFDP over UDP, one protocol data unit a datagram: the files of EDORAS's ``data_transfer``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np

from edoras_tools.addons.cfdp import wire as cfdp
from edoras_tools.links.protocol import BY_CONTENT, BatchRows, LinkProtocol, Located, Seen
from edoras_tools.model import Decoded, Finding, LayerField, PacketBatch, Transport
from edoras_tools.wire import ccsds
from edoras_tools.wire.arrays.crc import CRC16_BYTES

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from numpy.typing import NDArray

    from edoras_tools.links.doors import LinkEvidence, OwnTopics, TopicSpace
    from edoras_tools.links.reading import Reading
    from edoras_tools.links.sending import LinkSending
    from edoras_tools.links.site import Site
    from edoras_tools.wire.arrays.order import Integers, Mask, Octets, Places
    from edoras_tools.wire.layout import Layout

_SOURCE, _SEQUENCE = "source_entity_id", "transaction_sequence_number"
_IDS: Final = {
    _SOURCE: "of the sender of the file",
    _SEQUENCE: "tells the files of that sender apart",
    "destination_entity_id": "of the receiver of the file",
}
_TEXTS: Final = {
    "source_file_name": ", {} to {destination_file_name}",
    "acknowledged_directive": ", for directive {}",
    "data_length": ", {} bytes at {offset}",
    "segment_requests": ", missing {}",
    "file_size": ", {} bytes",
    "progress": ", {} bytes",
}


class FileDeliveryLink(LinkProtocol):
    """The link between CFDP entities; a datagram belongs to it only if its length fields are consistent."""

    code = 5
    name = "CFDP"
    label = "cfdp"
    colour = "bright_blue"
    doc = "between CFDP entities, one protocol data unit a datagram (file delivery)"
    transport = Transport(ports=(5111, 5222), first="either")
    to_cfs = True
    from_cfs = True
    bridge = "transfer"
    bridge_ports = ("port", "port_peer")
    layouts = cfdp.EVERY_PDU_LAYOUT
    wireshark = "cfdp"
    in_packets = True
    port_decides = False
    sends = True

    def recognise(self, facts: Seen) -> Any:
        """Recognise a header of a known version whose lengths add up to that of the datagram."""
        number = {
            slot.field.name: facts.field(cfdp.PDU_HEADER, slot.field.name) for slot in cfdp.PDU_HEADER.slots
        }
        header = 2 * number["entity_id_length"] + number["sequence_number_length"] + cfdp.PDU_HEADER.size + 3
        plausible = (number["version"] < cfdp.NEWEST_VERSION + 1) & (number["pdu_data_field_length"] > 0)
        return BY_CONTENT * (plausible & (header + number["pdu_data_field_length"] == facts.length))

    def send(self, site: Site, *, up: bool) -> LinkSending | None:
        """Return what sends files to the receiver's entity; ``--target`` determines the direction."""
        return None if up else self.part("sending:FileSending")(self)

    def locate(self, batch: PacketBatch, rows: Places, site: Site) -> Located:
        """Judge whether PDUs are complete; see :meth:`LinkProtocol.locate`."""
        located = Located(len(rows))
        for finding, wrong in self.judge_units(batch.data, batch.offset[rows], batch.length[rows]):
            located.flag(finding, wrong)
        return located

    def dissect(self, reading: Reading, site: Site) -> None:
        """Read one PDU."""
        self.read_unit(reading, 0)

    def places(self, layout: Layout, rows: BatchRows, field: str = "") -> tuple[Places, Integers]:
        """Find the header, the directive code, or the parameters of one kind."""
        owner, offset, length = _pdu_places(rows, self)
        if layout is cfdp.PDU_HEADER:
            present = length >= layout.size
            return owner[present], offset[present]
        pdus = cfdp.read_pdus(rows.batch.data, offset, length)
        if layout is cfdp.DIRECTIVE:
            return owner[pdus.directive], pdus.code[pdus.directive]
        present = np.zeros(len(owner), bool)
        for large, layouts in enumerate(cfdp.PDU_LAYOUTS):
            for kind, item in layouts.items():
                present |= (item is layout) & (pdus.kind == kind) & (pdus.large == large)
        return owner[present], pdus.start[present]

    def holds_units(self, column: Callable[[str], NDArray[Any]], site: Site) -> Mask:
        """Return which rows are space packets with a PDU behind their cFE header: bool (n,)."""
        return holds_pdu(column, site.pdu_msg_ids)

    def judge_units(
        self, data: Octets, offset: Integers, length: NDArray[np.int32]
    ) -> Iterator[tuple[Finding, Mask]]:
        """Yield whether PDUs are cut, or have a wrong CRC."""
        pdus = cfdp.read_pdus(data, offset, length)
        for name, finding in _FINDINGS.items():
            yield finding, getattr(pdus, name)

    def read_unit(self, reading: Reading, at: int) -> None:
        """Read the layers of the PDU from byte ``at`` of a datagram on.

        Raises:
            TruncatedError: it needs more bytes than exist.
        """
        data = reading.data
        head = reading.read(cfdp.PDU_HEADER, at)
        pdu = cfdp.read_pdus(np.frombuffer(data, np.uint8), np.array([at]), np.array([len(data) - at]))
        if pdu.corrupt[0]:
            reading.findings |= Finding.CHECKSUM_BAD
        code, start, behind, end = (int(item[0]) for item in (pdu.code, pdu.start, pdu.data, pdu.end))
        if code > len(data):
            reading.truncated(cfdp.PDU_HEADER.name, at, code - at)
        place, width = at + cfdp.PDU_HEADER.size, head["entity_id_length"] + 1
        sizes = width, head["sequence_number_length"] + 1, width
        for (name, doc), size in zip(_IDS.items(), sizes, strict=True):
            value = int(getattr(pdu, name)[0])
            reading.extend(LayerField(name, value, place, place + size, str(value), doc))
            place += size
        if not head["pdu_type"] and not pdu.directive[0]:
            reading.truncated(cfdp.DIRECTIVE.name, code, cfdp.DIRECTIVE.size)
        kind = 0 if head["pdu_type"] else reading.read(cfdp.DIRECTIVE, code)["directive_code"]
        layout = cfdp.PDU_LAYOUTS[head["large_file_flag"]].get(kind)
        if layout is None:
            return
        if pdu.truncated[0]:
            reading.truncated(layout.name, start, layout.size)
        reading.read(layout, start)
        values = cfdp.parameters(kind, head["large_file_flag"], data[start:end])
        for name, doc in cfdp.CONTENT_FIELDS.items():
            if name in values:
                reading.extend(LayerField(name, values[name], behind, end, str(values[name]), doc))
        last = min(end + CRC16_BYTES, len(data))
        if head["crc_flag"] and last - end == CRC16_BYTES:
            number = int.from_bytes(data[end:last], "big")
            text = f"0x{number:04x}" + (", which is wrong" if pdu.corrupt[0] else "")
            reading.extend(LayerField("crc", number, end, last, text, "CRC-16 of the PDU"))

    def topics(self, space: TopicSpace) -> OwnTopics | None:
        """Return the maker of messages of transferred files; None if the mission has no such topic."""
        return self.part("topics:FileTopics")(space) if space.mission.stored_topics else None

    def evidence(self, site: Site) -> LinkEvidence:
        """Return a follower of transactions."""
        return self.part("transactions:FileEvidence")(msg_ids=site.pdu_msg_ids)

    def summary(self, decoded: Decoded) -> str:
        """Return the contents of the PDU and its transaction in words; empty if it is cut."""
        head = decoded.layer(cfdp.PDU_HEADER.name)
        if head is None or decoded.stop:
            return ""
        last, ids = decoded.layers[-1], head.values()
        values = last.values()
        text = f"{last.title.removeprefix('CFDP ')} of {ids[_SOURCE]}:{ids[_SEQUENCE]}"
        for name, form in _TEXTS.items():
            text += form.format(values[name], **values) if name in values else ""
        condition = values.get("condition_code")
        return f"{text}, {cfdp.CONDITION_NAMES.get(condition, condition)}" if condition else text


CFDP: Final = FileDeliveryLink()
_FINDINGS: Final = {"truncated": Finding.TRUNCATED, "corrupt": Finding.CHECKSUM_BAD}
"""Columns of ``Pdus`` to their findings."""
_NO_PDU: Final = np.uint32(Finding.HEADER_ONLY)


def _pdu_places(rows: BatchRows, link: FileDeliveryLink) -> tuple[Places, Integers, NDArray[np.int32]]:
    """Return the rows with a PDU, the start of each, and the number of bytes that exist."""
    own = rows.column("link") == link
    offset = rows.datagram("offset").astype(np.int64)
    length = rows.datagram("length")
    if len(rows.context.pdu_msg_ids):
        inside, header = holds_pdu(rows.column, rows.context.pdu_msg_ids), rows.column("header_length")
        offset = np.where(inside, rows.column("packet_offset") + header, offset)
        length = np.where(inside, rows.column("packet_length") - header, length).astype(np.int32)
        own |= inside
    owner = np.flatnonzero(own)
    return owner, offset[owner], length[owner]


def holds_pdu(column: Callable[[str], NDArray[Any]], msg_ids: NDArray[np.int32]) -> Mask:
    """Return which rows are space packets with a PDU behind their cFE header: bool (n,).

    Args:
        column: returns a column of ``Columns`` by its name.
        msg_ids: MsgIds of such packets.
    """
    present: Mask = np.isin(column("msg_id"), msg_ids)
    present &= (column("header_length") > ccsds.PRIMARY.size) & ((column("findings") & _NO_PDU) == 0)
    return present
