"""Sends files of CFDP again: each recorded transaction as a new one, of the same class.

The recorded PDUs of the file's sender get a new transaction sequence number. In class 2 the sender's
procedures are carried out: missing pieces are sent again, EOF is repeated until it is acknowledged, and
Finished is acknowledged.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Final

import msgspec
import numpy as np

from edoras_tools.addons.cfdp import link as cfdp
from edoras_tools.addons.cfdp.link import Directive, Pdus
from edoras_tools.links.protocol import LinkSending, SendingSession
from edoras_tools.units import SECOND
from edoras_tools.wire.arrays import CRC16_BYTES, Integers, Mask, crc16

if TYPE_CHECKING:
    from edoras_tools.model import Columns, Link, PacketBatch

_AGAIN_NS: Final = SECOND
"""Time after which EOF is sent again, until it is acknowledged."""
_MOST_TRIES: Final = 30
_OF_SENDER: Final = (Directive.FILE_DATA, Directive.METADATA, Directive.EOF)
_FINISHED_ACKNOWLEDGED: Final = bytes([Directive.ACK, Directive.FINISHED << 4 | 1, 2])
"""ACK of Finished, without error, for a terminated transaction."""


def _read(data: bytes) -> Pdus:
    return cfdp.read_pdus(np.frombuffer(data, np.uint8), np.array([0]), np.array([len(data)], np.int32))


class SentFile(msgspec.Struct):
    """A new transaction.

    Attributes:
        pieces: recorded pieces of the file, (first byte, one past the last, PDU).
        metadata: Metadata PDU; empty if the recording has none.
        eof: EOF PDU; empty if the recording has none.
        acknowledged: whether it is of class 2.
        due_ns: time when EOF is sent again; 0 before it was sent.
        tries: number of repetitions of EOF.
        state: last state from the receiver: ``open``, ``told`` (EOF was acknowledged), ``finished``.
        missing: number of requested bytes that the recording does not have.
    """

    pieces: list[tuple[int, int, bytes]] = msgspec.field(default_factory=list)
    metadata: bytes = b""
    eof: bytes = b""
    acknowledged: bool = False
    due_ns: int = 0
    tries: int = 0
    state: str = "open"
    missing: int = 0

    def again(self, requests: Iterable[Sequence[int]]) -> Iterator[bytes]:
        """Yield the PDUs with the requested pieces."""
        for first, last in requests:
            if (first, last) == (0, 0) and self.metadata:
                yield self.metadata
            pieces = [piece for piece in self.pieces if piece[0] < last and piece[1] > first]
            self.missing += 0 if pieces or first == last else last - first
            yield from (data for _, _, data in pieces)


class FileSender(SendingSession):
    """The sender's side of all transactions of class 2."""

    def __init__(self) -> None:
        self.files: dict[tuple[int, int], SentFile] = {}
        self._open: list[SentFile] = []

    @property
    def _waiting(self) -> list[SentFile]:
        return [item for item in self._open if item.state != "finished" and item.tries < _MOST_TRIES]

    @property
    def busy(self) -> bool:  # type: ignore[override]
        """Whether a receiver has not finished, for a limited time."""
        return bool(self._waiting)

    @property
    def next_ns(self) -> int:  # type: ignore[override]
        """Time when an EOF is due."""
        return min((item.due_ns for item in self._waiting if item.due_ns), default=SendingSession.next_ns)

    def begin(self, files: dict[tuple[int, int], SentFile]) -> None:
        """Store the transactions that are sent."""
        self.files = files
        self._open = [item for item in files.values() if item.acknowledged and item.eof]

    def sent(self, *, now: int) -> None:
        """Schedule the first EOF some time after the messages."""
        for item in self._open:
            if not item.tries:
                item.due_ns = now + _AGAIN_NS

    def due(self, *, now: int) -> Iterable[bytes]:
        """Return the EOFs that were not acknowledged."""
        late = [item for item in self._waiting if item.due_ns <= now]
        for item in late:
            item.due_ns, item.tries = now + _AGAIN_NS, item.tries + 1
        return [item.eof for item in late if item.state == "open"]

    def answer(self, data: bytes, *, now: int) -> Iterable[bytes]:
        """Process a PDU of the receiver."""
        pdus = _read(data)
        key = int(pdus.source_entity_id[0]), int(pdus.transaction_sequence_number[0])
        item, kind = self.files.get(key), int(pdus.kind[0])
        if item is None or kind < 0 or not pdus.toward_sender[0]:
            return ()
        values = cfdp.parameters(kind, int(pdus.large[0]), data[int(pdus.start[0]) : int(pdus.end[0])])
        of_eof = kind == Directive.ACK and values["acknowledged_directive"] == Directive.EOF
        if item.state == "open" and (of_eof or kind == Directive.NAK):
            item.state = "told"
        if kind == Directive.NAK:
            return [*item.again(values["segment_requests"])]
        if kind == Directive.FINISHED:
            item.state = "finished"
            return (_with_field(item.eof, _FINISHED_ACKNOWLEDGED),) if item.acknowledged else ()
        return ()

    def notes(self) -> Iterable[str]:
        """Return the number of files that arrived complete, and of requests that could not be met."""
        whole, missing = (
            sum(item.state == "finished" for item in self._open),
            sum(item.missing for item in self.files.values()),
        )
        if self._open:
            yield f"{whole:,} of {len(self._open):,} files of class 2 were acknowledged as finished"
        if missing:
            yield f"{missing:,} bytes that the receiver asked for are not in the recording"


class FileSending(LinkSending):
    """The PDUs of files' senders, in new transactions."""

    renews = True
    instead = "edoras replay --to cfdp sends recorded files; a new file is sent by a CFDP entity"
    port = 5222

    def __init__(self, link: Link) -> None:
        super().__init__(link)
        self.session: FileSender = FileSender()

    def outgoing_rows(self, batch: PacketBatch, columns: Columns) -> Mask:
        """Return which PDUs are pieces, Metadata and EOF, as they were sent: bool (n,)."""
        own = super().outgoing_rows(batch, columns)
        rows = np.flatnonzero(own)
        pdus = cfdp.read_pdus(batch.data, batch.offset[rows], batch.length[rows])
        own[rows] = np.isin(pdus.kind, _OF_SENDER) & ~pdus.toward_sender & ~pdus.corrupt
        return own

    def renew(self, messages: Sequence[bytes], time_ns: Integers) -> tuple[list[bytes], Integers]:
        """Give the transactions new numbers, which start at the recording's time: no receiver knows them."""
        numbers: dict[tuple[int, int], int] = {}
        files: dict[tuple[int, int], SentFile] = {}
        renewed = []
        for data in messages:
            pdus = _read(data)
            source, old = int(pdus.source_entity_id[0]), int(pdus.transaction_sequence_number[0])
            width = 8 * ((data[3] & 7) + 1)
            number = numbers.setdefault((source, old), (old + (1 << width - 1) + len(numbers)) % (1 << width))
            new = _numbered(data, number)
            item = files.setdefault((source, number), SentFile(acknowledged=bool(pdus.acknowledged[0])))
            first = int(pdus.file_offset[0])
            if pdus.kind[0] == Directive.FILE_DATA:
                item.pieces.append((first, first + int(pdus.end[0] - pdus.data[0]), new))
            elif pdus.kind[0] == Directive.METADATA:
                item.metadata = new
            else:
                item.eof = new
            renewed.append(new)
        self.session.begin(files)
        return renewed, time_ns


def _numbered(data: bytes, number: int) -> bytes:
    """Return a PDU with another transaction sequence number, and a new CRC if it has one."""
    ids, count = (data[3] >> 4 & 7) + 1, (data[3] & 7) + 1
    at = cfdp.PDU_HEADER.size + ids
    return _checked(data[:at] + number.to_bytes(count, "big") + data[at + count :])


def _with_field(like: bytes, content: bytes) -> bytes:
    """Return a PDU with the header of another one and another data field."""
    ids, count = (like[3] >> 4 & 7) + 1, (like[3] & 7) + 1
    crc = bytes(CRC16_BYTES * (like[0] >> 1 & 1))
    size = (len(content) + len(crc)).to_bytes(2, "big")
    return _checked(like[:1] + size + like[3 : cfdp.PDU_HEADER.size + 2 * ids + count] + content + crc)


def _checked(pdu: bytes) -> bytes:
    if not pdu[0] >> 1 & 1:
        return pdu
    return pdu[:-CRC16_BYTES] + crc16(pdu[:-CRC16_BYTES]).to_bytes(CRC16_BYTES, "big")
