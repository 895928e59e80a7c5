"""CFDP over UDP, one protocol data unit a datagram: the files of EDORAS's ``data_transfer``.

Protocol data units (CCSDS 727.0-B-5, 5) are big-endian, and are read one by one, or many at once. A PDU is a
header of variable length, then a directive (its code and its parameters) or a piece of the file. With the
large-file flag, offsets and sizes have 64 bits instead of 32.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from enum import IntEnum
from typing import TYPE_CHECKING, Any, Final

import msgspec
import numpy as np

from edoras_tools.addons import LINK_PORTS
from edoras_tools.links.protocol import BY_CONTENT, BatchRows, LinkProtocol, LinkSending, Located, Seen
from edoras_tools.model import Decoded, Finding, LayerField, PacketBatch, Transport
from edoras_tools.wire import ccsds
from edoras_tools.wire.arrays import CRC16_BYTES, Integers, Mask, Octets, Places, crc16_rows, gather
from edoras_tools.wire.layout import Field, Layout

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.links.doors import LinkEvidence, OwnTopics, Reading, Site, TopicSpace


class Directive(IntEnum):
    """Kinds of PDUs: the directive code; 0 for ``FILE_DATA``, which has none."""

    FILE_DATA = 0
    EOF = 4
    FINISHED = 5
    ACK = 6
    METADATA = 7
    NAK = 8
    PROMPT = 9
    KEEP_ALIVE = 12


class ConditionCode(IntEnum):
    """Condition codes, 727.0-B 5.2.2."""

    NO_ERROR = 0
    POSITIVE_ACK_LIMIT_REACHED = 1
    KEEP_ALIVE_LIMIT_REACHED = 2
    INVALID_TRANSMISSION_MODE = 3
    FILESTORE_REJECTION = 4
    FILE_CHECKSUM_FAILURE = 5
    FILE_SIZE_ERROR = 6
    NAK_LIMIT_REACHED = 7
    INACTIVITY_DETECTED = 8
    INVALID_FILE_STRUCTURE = 9
    CHECK_LIMIT_REACHED = 10
    UNSUPPORTED_CHECKSUM_TYPE = 11
    SUSPEND_REQUEST_RECEIVED = 14
    CANCEL_REQUEST_RECEIVED = 15


class Checksum(IntEnum):
    """Checksum types that this package computes, from SANA's registry."""

    MODULAR = 0
    CRC_32C = 2
    CRC_32 = 3
    NULL = 15


def _words(names: type[IntEnum]) -> dict[int, str]:
    return {int(item): item.name.lower().replace("_", " ") for item in names}


DIRECTIVE_NAMES: Final = {
    code: name.title() if len(name) > 3 else name.upper() for code, name in _words(Directive).items()
}
CONDITION_NAMES: Final = _words(ConditionCode)
_CODES: Final = {code: name for code, name in DIRECTIVE_NAMES.items() if code}

PDU_HEADER: Final = Layout(
    "cfdp",
    "CFDP",
    Field("version", 3, "0 in issues 1 to 4 of the standard, 1 since", clause="727.0-B 5.1"),
    Field("pdu_type", 1, "what follows the header", names={0: "directive", 1: "file data"}),
    Field("direction", 1, "of travel", names={0: "toward receiver", 1: "toward sender"}),
    Field("transmission_mode", 1, "class 2 or 1", names={0: "acknowledged", 1: "unacknowledged"}),
    Field("crc_flag", 1, "a CRC-16 of the PDU ends it", clause="727.0-B 4.1"),
    Field("large_file_flag", 1, "offsets and sizes have 64 bits"),
    Field("pdu_data_field_length", 16, "bytes behind the header"),
    Field("segmentation_control", 1, "record boundaries are kept"),
    Field("entity_id_length", 3, "bytes of an entity ID, less 1"),
    Field("segment_metadata_flag", 1, "metadata is in front of each piece of the file"),
    Field("sequence_number_length", 3, "bytes of the transaction sequence number, less 1"),
)
"""Part of the header with a fixed length; the IDs and the sequence number follow."""
NEWEST_VERSION: Final = 1
DIRECTIVE: Final = Layout(
    "cfdp_directive", "CFDP Directive", Field("directive_code", 8, "what the PDU says", names=_CODES)
)
_CONDITION: Final = Field("condition_code", 4, "why", names=CONDITION_NAMES, clause="727.0-B 5.2.2")
_FILE: Final = {0: "discarded", 1: "rejected by the filestore", 2: "retained", 3: "not reported"}
_STATUS: Final = {0: "undefined", 1: "active", 2: "terminated", 3: "unrecognised"}


def _layouts(bits: int, prefix: str) -> dict[int, Layout]:
    """Return the layout of each kind's parameters; offsets and sizes have this number of bits."""
    parameters = {
        Directive.FILE_DATA: (Field("offset", bits, "place of the first byte in the file"),),
        Directive.EOF: (
            _CONDITION,
            Field("reserved", 4, "0"),
            Field("file_checksum", 32, "of the file, by the type that Metadata names", base=16),
            Field("file_size", bits, "bytes of the file"),
        ),
        Directive.FINISHED: (
            _CONDITION,
            Field("reserved", 1, "0"),
            Field("delivery_code", 1, "whether the file is there", names={0: "complete", 1: "incomplete"}),
            Field("file_status", 2, "what became of it", names=_FILE),
        ),
        Directive.ACK: (
            Field("acknowledged_directive", 4, "its code", names=_CODES),
            Field("directive_subtype_code", 4, "1 for Finished, else 0"),
            _CONDITION,
            Field("reserved", 2, "0"),
            Field("transaction_status", 2, "at the sender of this PDU", names=_STATUS),
        ),
        Directive.METADATA: (
            Field("reserved", 1, "0"),
            Field("closure_requested", 1, "in class 1 too, the receiver says when it has finished"),
            Field("reserved_2", 2, "0"),
            Field("checksum_type", 4, "of SANA's registry", names=_words(Checksum)),
            Field("file_size", bits, "bytes of the file; 0 where it is not known"),
        ),
        Directive.NAK: (
            Field("start_of_scope", bits, "first byte of the part that was looked at"),
            Field("end_of_scope", bits, "one past its last byte"),
        ),
        Directive.PROMPT: (
            Field("response_required", 1, "what to send", names={0: "NAK", 1: "Keep Alive"}),
            Field("reserved", 7, "0"),
        ),
        Directive.KEEP_ALIVE: (Field("progress", bits, "bytes that have come"),),
    }
    return {
        kind: Layout(f"{prefix}_{kind.name.lower()}", f"CFDP {DIRECTIVE_NAMES[kind]}", *items)
        for kind, items in parameters.items()
    }


_USUAL: Final = _layouts(32, "cfdp")
_LARGE: Final = {
    kind: _USUAL[kind] if layout.size == _USUAL[kind].size else layout
    for kind, layout in _layouts(64, "cfdp_large").items()
}
PDU_LAYOUTS: Final = _USUAL, _LARGE
"""Layouts of the parameters of each kind, by the large-file flag."""
EVERY_PDU_LAYOUT: Final = (
    PDU_HEADER,
    DIRECTIVE,
    *_USUAL.values(),
    *(layout for kind, layout in _LARGE.items() if layout is not _USUAL[kind]),
)
_SIZES: Final = np.array(
    [[layouts[kind].size if kind in layouts else -1 for kind in range(256)] for layouts in PDU_LAYOUTS],
    np.int16,
)
"""Size of the parameters by the large-file flag and the kind, bytes; -1 for kinds that do not exist."""
CONTENT_FIELDS: Final = {
    "data_length": "bytes of the piece",
    "source_file_name": "name at the sender",
    "destination_file_name": "name at the receiver",
    "segment_requests": "parts that are missing: first byte, and one past the last",
}
"""Fields behind the parameters of fixed size, as :func:`parameters` reads them."""
UNREAD: Final = -1
"""Value of ``Pdus.kind`` if the kind does not exist, or the PDU is cut."""


class Pdus(msgspec.Struct, frozen=True, eq=False):
    """PDUs in columns, one element each; positions are those in the data that was read.

    Attributes:
        kind: i16 (n,), a ``Directive``; ``UNREAD`` if it is none.
        truncated: bool (n,), whether it needs more bytes than exist.
        corrupt: bool (n,), whether the CRC at its end is wrong: its receiver drops it.
        directive: bool (n,), whether it has a directive code.
        toward_sender: bool (n,), whether it travels from the receiver to the sender of the file.
        acknowledged: bool (n,), whether it is of class 2.
        large: u8 (n,), large-file flag.
        source_entity_id: u64 (n,), entity ID of the sender of the file.
        transaction_sequence_number: u64 (n,), sequence number of the transaction.
        destination_entity_id: u64 (n,), entity ID of the receiver of the file.
        code: i64 (n,), position behind the header; for a cut header, the position where it would be.
        start: i64 (n,), position of the parameters.
        data: i64 (n,), position behind the parameters: of the piece of the file, of names, of requests.
        end: i64 (n,), one past the last byte, without a CRC.
        file_offset: u64 (n,), offset in the file; 0 for directives.
    """

    kind: NDArray[np.int16]
    truncated: Mask
    corrupt: Mask
    directive: Mask
    toward_sender: Mask
    acknowledged: Mask
    large: Octets
    source_entity_id: NDArray[np.uint64]
    transaction_sequence_number: NDArray[np.uint64]
    destination_entity_id: NDArray[np.uint64]
    code: Integers
    start: Integers
    data: Integers
    end: Integers
    file_offset: NDArray[np.uint64]


def read_pdus(data: Octets, offset: Integers, length: NDArray[np.int32]) -> Pdus:
    """Read many PDUs; no contents can raise an error.

    Args:
        data: u8, contiguous buffer.
        offset: i64 (n,), first byte of each.
        length: (n,), number of bytes that exist.
    """
    head = PDU_HEADER.columns(gather(data, offset, PDU_HEADER.size))
    ids = head["entity_id_length"].astype(np.int64) + 1
    counts = head["sequence_number_length"].astype(np.int64) + 1
    code = offset + PDU_HEADER.size + 2 * ids + counts
    limit = offset + length
    whole = (length >= PDU_HEADER.size) & (code <= limit)
    claimed = code + head["pdu_data_field_length"]
    end = np.minimum(claimed - CRC16_BYTES * head["crc_flag"], limit)
    # Positions beyond the data are not read: for a cut PDU those of its first byte are read instead.
    first = gather(data, np.where(whole, code, offset), 1)[:, 0]
    piece = head["pdu_type"] == 1
    metadata = np.where(head["segment_metadata_flag"] == 1, 1 + (first & 0x3F).astype(np.int64), 0)
    start = code + np.where(piece, metadata, DIRECTIVE.size)
    kind = np.where(piece, Directive.FILE_DATA, first).astype(np.int16)
    large = head["large_file_flag"]
    size = _SIZES[large, kind].astype(np.int64)
    behind = start + np.maximum(size, 0)
    cut = ~whole | (behind > end)
    kind[cut | (size < 0)] = UNREAD
    at = np.where(whole, offset + PDU_HEADER.size, offset)
    of_data = kind == Directive.FILE_DATA
    return Pdus(
        kind,
        cut,
        _corrupt(data, offset, claimed, whole & (head["crc_flag"] == 1) & (code <= end) & (claimed <= limit)),
        whole & ~piece & (start <= end),
        head["direction"] == 1,
        head["transmission_mode"] == 0,
        large,
        _numbers(data, at, ids),
        _numbers(data, at + ids * whole, counts),
        _numbers(data, at + (ids + counts) * whole, ids),
        code,
        start,
        behind,
        end,
        _numbers(data, np.where(of_data, start, offset), 4 + 4 * large) * of_data,
    )


def _corrupt(data: Octets, offset: Integers, end: Integers, ended: Mask) -> Mask:
    """Return which PDUs have a wrong CRC, among those that are complete and ``ended`` by one: bool (n,)."""
    rows = np.flatnonzero(ended)
    if len(rows):
        size = (end[rows] - offset[rows]).astype(np.int32)
        ended = ended.copy()
        ended[rows] = crc16_rows(data, offset[rows], size) != 0
    return ended


def _numbers(data: Octets, at: Integers, width: NDArray[np.integer[Any]]) -> NDArray[np.uint64]:
    """Read unsigned numbers of 1 to 8 bytes."""
    word = gather(data, at, 8).view(">u8")[:, 0].astype(np.uint64)
    return word >> (64 - 8 * width).astype(np.uint64)


def parameters(kind: int, large: int, data: bytes) -> dict[str, Any]:
    """Read the parameters of a PDU leniently: later ones are read as far as possible.

    Args:
        kind: a ``Directive``.
        data: bytes from the first parameter to the end of the PDU.

    Returns:
        The fields of its layout, and those of ``CONTENT_FIELDS`` that the kind has.

    Raises:
        TruncatedError: the fields of the layout are incomplete.
    """
    layout = PDU_LAYOUTS[large][kind]
    values = layout.parse(data)
    rest = data[layout.size :]
    if kind == Directive.FILE_DATA:
        values["data_length"] = len(rest)
    elif kind == Directive.METADATA:
        for name in ("source_file_name", "destination_file_name"):
            size = rest[0] if rest else 0
            values[name], rest = rest[1 : 1 + size].decode("utf-8", "replace"), rest[1 + size :]
    elif kind == Directive.NAK:
        width = layout.size // 2
        ends = [  # without a request that is cut
            int.from_bytes(rest[at : at + width], "big")
            for at in range(0, len(rest) // layout.size * layout.size, width)
        ]
        values["segment_requests"] = [list(pair) for pair in zip(ends[::2], ends[1::2], strict=True)]
    return values


class ModularSum:
    """The modular checksum of a file whose pieces come in any order, each byte once."""

    def __init__(self) -> None:
        self._sum = 0

    def add(self, piece: bytes, offset: int) -> None:
        """Add a piece that begins at an offset of the file."""
        self._sum = (self._sum + modular_checksum(piece, offset)) & 0xFFFFFFFF

    def of_file(self, size: int) -> int:
        """Return the checksum of the whole file, after all its bytes were added."""
        return self._sum


def modular_checksum(piece: bytes, offset: int) -> int:
    """Return the contribution of a piece to the modular checksum of its file (727.0-B 4.2.2), modulo 2^32.

    Args:
        piece: bytes of the piece.
        offset: offset of the first byte in the file.
    """
    front = offset % 4
    words = np.frombuffer(bytes(front) + piece + bytes(-(front + len(piece)) % 4), ">u4")
    return int(words.sum(dtype=np.uint64)) & 0xFFFFFFFF


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
    transport = Transport(ports=LINK_PORTS["cfdp"], first="either")
    to_cfs = True
    from_cfs = True
    bridge = "transfer"
    bridge_ports = ("port", "port_peer")
    layouts = EVERY_PDU_LAYOUT
    wireshark = "cfdp"
    in_packets = True
    port_decides = False
    sends = True

    def recognise(self, facts: Seen) -> Any:
        """Recognise a header of a known version whose lengths add up to that of the datagram."""
        number = {slot.field.name: facts.field(PDU_HEADER, slot.field.name) for slot in PDU_HEADER.slots}
        header = 2 * number["entity_id_length"] + number["sequence_number_length"] + PDU_HEADER.size + 3
        plausible = (number["version"] < NEWEST_VERSION + 1) & (number["pdu_data_field_length"] > 0)
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
        if layout is PDU_HEADER:
            present = length >= layout.size
            return owner[present], offset[present]
        pdus = read_pdus(rows.batch.data, offset, length)
        if layout is DIRECTIVE:
            return owner[pdus.directive], pdus.code[pdus.directive]
        present = np.zeros(len(owner), bool)
        for large, layouts in enumerate(PDU_LAYOUTS):
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
        pdus = read_pdus(data, offset, length)
        for name, finding in _FINDINGS.items():
            yield finding, getattr(pdus, name)

    def read_unit(self, reading: Reading, at: int) -> None:
        """Read the layers of the PDU from byte ``at`` of a datagram on.

        Raises:
            TruncatedError: it needs more bytes than exist.
        """
        data = reading.data
        head = reading.read(PDU_HEADER, at)
        pdu = read_pdus(np.frombuffer(data, np.uint8), np.array([at]), np.array([len(data) - at]))
        if pdu.corrupt[0]:
            reading.findings |= Finding.CHECKSUM_BAD
        code, start, behind, end = (int(item[0]) for item in (pdu.code, pdu.start, pdu.data, pdu.end))
        if code > len(data):
            reading.truncated(PDU_HEADER.name, at, code - at)
        place, width = at + PDU_HEADER.size, head["entity_id_length"] + 1
        sizes = width, head["sequence_number_length"] + 1, width
        for (name, doc), size in zip(_IDS.items(), sizes, strict=True):
            value = int(getattr(pdu, name)[0])
            reading.extend(LayerField(name, value, place, place + size, str(value), doc))
            place += size
        if not head["pdu_type"] and not pdu.directive[0]:
            reading.truncated(DIRECTIVE.name, code, DIRECTIVE.size)
        kind = 0 if head["pdu_type"] else reading.read(DIRECTIVE, code)["directive_code"]
        layout = PDU_LAYOUTS[head["large_file_flag"]].get(kind)
        if layout is None:
            return
        if pdu.truncated[0]:
            reading.truncated(layout.name, start, layout.size)
        reading.read(layout, start)
        values = parameters(kind, head["large_file_flag"], data[start:end])
        for name, doc in CONTENT_FIELDS.items():
            if name in values:
                reading.extend(LayerField(name, values[name], behind, end, str(values[name]), doc))
        last = min(end + CRC16_BYTES, len(data))
        if head["crc_flag"] and last - end == CRC16_BYTES:
            number = int.from_bytes(data[end:last], "big")
            text = f"0x{number:04x}" + (", which is wrong" if pdu.corrupt[0] else "")
            reading.extend(LayerField("crc", number, end, last, text, "CRC-16 of the PDU"))

    def topics(self, space: TopicSpace) -> OwnTopics | None:
        """Return the maker of messages of transferred files; None if the mission has no such topic."""
        return self.part("transactions:FileTopics")(space) if space.mission.stored_topics else None

    def evidence(self, site: Site) -> LinkEvidence:
        """Return a follower of transactions."""
        return self.part("transactions:FileEvidence")(msg_ids=site.pdu_msg_ids)

    def summary(self, decoded: Decoded) -> str:
        """Return the contents of the PDU and its transaction in words; empty if it is cut."""
        head = decoded.layer(PDU_HEADER.name)
        if head is None or decoded.stop:
            return ""
        last, ids = decoded.layers[-1], head.values()
        values = last.values()
        text = f"{last.title.removeprefix('CFDP ')} of {ids[_SOURCE]}:{ids[_SEQUENCE]}"
        for name, form in _TEXTS.items():
            text += form.format(values[name], **values) if name in values else ""
        condition = values.get("condition_code")
        return f"{text}, {CONDITION_NAMES.get(condition, condition)}" if condition else text


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
