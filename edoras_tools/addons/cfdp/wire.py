"""CFDP protocol data units (CCSDS 727.0-B-5, 5), big-endian: one by one, and many at once.

A PDU is a header of variable length, then a directive (its code and its parameters) or a piece of the file.
With the large-file flag, offsets and sizes have 64 bits instead of 32.
"""

from __future__ import annotations

from enum import IntEnum
from typing import TYPE_CHECKING, Any, Final

import msgspec
import numpy as np

from edoras_tools.wire.arrays.crc import CRC16_BYTES, crc16_rows
from edoras_tools.wire.arrays.window import gather
from edoras_tools.wire.layout import Field, Layout

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.wire.arrays.order import Integers, Mask, Octets


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
