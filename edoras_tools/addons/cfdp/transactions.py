"""CFDP transactions, followed in a capture: received and missing pieces, the end, and messages from files.

Rules:

1. A transaction is identified by the sender's entity ID, its sequence number and the two endpoints: on both
   sides of a relay it is two. Metadata after its end begins another one: the numbers of a sender start again.
2. Only the first copy of a byte counts, and is passed on. A piece of the file without a new byte was sent
   again; one with new bytes in front of the last known one was lost before, or overtaken.
3. Memory does not grow with files: bytes are passed on, not kept. The numbers of transactions, and of known
   ranges of a file, are limited; everything beyond is left out, and the file stays incomplete.
4. A PDU with a wrong CRC is counted and ignored: its receiver drops it, and its IDs may be wrong, too.
5. PDUs in space packets travel on one link, and back on another: so their endpoints are the addresses without
   ports.

``data_transfer`` sends files that are each a ROS message in an EDORAS envelope:

1. A file belongs to the topic whose ``store_filename`` ends with the same name. It becomes a message when its
   transaction has finished, with that time, if every byte was captured and its checksum is not wrong.
2. It is a message only if it is an envelope with a complete message of the topic's type.
3. At most ``MOST_BYTES`` of unfinished files are kept; further files are left out.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from functools import partial
from typing import TYPE_CHECKING, Any, Final, TypeAlias

import msgspec
import numpy as np

from edoras_tools.addons.cfdp import link as cfdp
from edoras_tools.addons.cfdp.link import CFDP, holds_pdu
from edoras_tools.io.topics.messages import RECORD, Messages, whole_messages
from edoras_tools.links.doors import LinkEvidence, TopicSpace
from edoras_tools.sessions.ranges import KnownRanges
from edoras_tools.wire.arrays import PADDING, FileCrc, Integers, Octets, Places, copy_rows, numbered
from edoras_tools.wire.envelope import detect

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.mission import Mission, StoredTopic
    from edoras_tools.model import Columns, PacketBatch

    Keep: TypeAlias = "Callable[[Transaction, int, bytes], None]"

MOST_TRANSACTIONS: Final = 1 << 14
LARGEST_OFFSET: Final = 1 << 40
"""Largest offset in a file; pieces beyond are left out."""


class Transaction(msgspec.Struct, eq=False):
    """The transfer of one file; a value of None was not captured.

    Attributes:
        source_entity_id: entity ID of the sender of the file.
        transaction_sequence_number: sequence number of the sender.
        destination_entity_id: entity ID of the receiver of the file.
        acknowledged: whether it is of class 2: missing pieces are requested.
        first_ns: time of its first PDU, ns since 1970.
        last_ns: time of its last PDU, ns since 1970.
        silence_ns: longest time between two of its PDUs, ns.
        source_file_name: name in Metadata.
        destination_file_name: name in Metadata.
        checksum_type: type in Metadata.
        file_size: size in EOF, or in Metadata before it, bytes.
        file_checksum: checksum in EOF.
        received: ranges of captured bytes.
        sums: checksums of these bytes by type: of every type, until Metadata gives the type.
        segments: number of pieces of the file.
        resent: number of pieces without a new byte.
        filled: number of pieces with new bytes in front of the last known one.
        naks: number of NAKs with requests.
        eof: condition code of EOF.
        finished: condition code of Finished.
        incomplete: whether Finished states that the receiver does not have the whole file.
        finished_ns: time of the PDU with which it was ``finished``, ns since 1970.
    """

    source_entity_id: int
    transaction_sequence_number: int
    destination_entity_id: int
    acknowledged: bool
    first_ns: int
    last_ns: int
    silence_ns: int = 0
    source_file_name: str | None = None
    destination_file_name: str | None = None
    checksum_type: int | None = None
    file_size: int | None = None
    file_checksum: int | None = None
    received: KnownRanges = msgspec.field(default_factory=KnownRanges)
    sums: dict[int, cfdp.ModularSum | FileCrc] = msgspec.field(
        default_factory=lambda: {
            cfdp.Checksum.MODULAR: cfdp.ModularSum(),
            cfdp.Checksum.CRC_32: FileCrc(),
            cfdp.Checksum.CRC_32C: FileCrc(castagnoli=True),
        }
    )
    segments: int = 0
    resent: int = 0
    filled: int = 0
    naks: int = 0
    eof: int | None = None
    finished: int | None = None
    incomplete: bool = False
    finished_ns: int | None = None

    @property
    def name(self) -> str:
        """Name: ``SOURCE:NUMBER``."""
        return f"{self.source_entity_id}:{self.transaction_sequence_number}"

    @property
    def title(self) -> str:
        """Title for people: the file's name, as far as known, and the transaction."""
        name = self.destination_file_name or self.source_file_name or "a file"
        return f"{name} (CFDP {self.name})"

    @property
    def hop(self) -> str:
        """Sending and receiving entity, as text."""
        return f"CFDP entity {self.source_entity_id} to {self.destination_entity_id}"

    @property
    def complete(self) -> bool:
        """Whether every byte of the file was captured."""
        return self.eof is not None and self.file_size is not None and not self.holes

    @property
    def holes(self) -> list[tuple[int, int]]:
        """The parts of the file that were not captured."""
        return self.received.missing(0, self.file_size or 0)

    @property
    def checksum_right(self) -> bool | None:
        """Whether the checksum is that of EOF; None: its type is null or not known, or bytes are missing."""
        sums = None if self.checksum_type is None else self.sums.get(self.checksum_type)
        if sums is None or not self.complete:
            return None
        return sums.of_file(self.file_size or 0) == self.file_checksum

    @property
    def condition(self) -> int:
        """Condition code of the end; 0 for none."""
        return self.finished or self.eof or 0

    @property
    def state(self) -> str:
        """State at the end: ``finished``, ``cancelled``, another condition's name, or ``not finished``."""
        if self.condition:
            cancelled = self.condition == cfdp.ConditionCode.CANCEL_REQUEST_RECEIVED
            return "cancelled" if cancelled else cfdp.CONDITION_NAMES.get(self.condition, str(self.condition))
        over = self.finished is not None and not self.incomplete
        return "finished" if over or (not self.acknowledged and self.complete) else "not finished"


class FileEvidence(LinkEvidence):
    """Follows all transactions.

    Args:
        keep: called once with each byte of each file: the transaction, the offset in the file, the bytes.
        msg_ids: MsgIds of space packets that contain a PDU.

    Attributes:
        transactions: transactions in order of their first PDU.
        datagrams: number of PDUs in datagrams of their own.
        pdus: number of all PDUs.
        packets: number of PDUs in space packets.
        corrupt: number of PDUs with a wrong CRC.
        corrupt_ns: times of the first and the last of these, ns since 1970.
        left_out: number of PDUs of transactions beyond the limit.
    """

    def __init__(self, keep: Keep | None = None, msg_ids: Collection[int] = ()) -> None:
        self.transactions: list[Transaction] = []
        self.pdus = self.packets = self.corrupt = self.left_out = 0
        self.corrupt_ns = 0, 0
        self._keep = keep
        self._msg_ids = np.array([*msg_ids], np.int32)
        self._open: dict[tuple[int, ...], Transaction] = {}

    def add(self, batch: PacketBatch, columns: Columns) -> None:
        """Add all PDUs of a batch: those of the CFDP link, and those in space packets."""
        self.take(batch, np.flatnonzero(columns.link == CFDP))
        if len(self._msg_ids):
            rows = np.flatnonzero(holds_pdu(partial(getattr, columns), self._msg_ids))
            header = columns.header_length[rows]
            place = columns.packet_offset[rows] + header, columns.packet_length[rows] - header
            before = self.pdus
            self.take(batch, rows, place)
            self.packets += self.pdus - before
        self.datagrams = self.pdus - self.packets

    def spans(self) -> list[tuple[int, int]]:
        """Return the first and last time of each transaction."""
        return [(item.first_ns, item.last_ns) for item in self.transactions]

    def take(
        self, batch: PacketBatch, rows: Places, place: tuple[Integers, NDArray[np.int32]] | None = None
    ) -> None:
        """Add the PDUs in some rows of a batch, in order; no contents can raise an error.

        Args:
            rows: indices of rows with a PDU.
            place: start of each PDU in a space packet, and number of bytes that exist (rule 5); None for
                datagrams that are PDUs.
        """
        if not len(rows):
            return
        self.pdus += len(rows)
        offset, length = place or (batch.offset[rows], batch.length[rows])
        pdus = cfdp.read_pdus(batch.data, offset, length)
        if pdus.corrupt.any():
            times = batch.time_ns[rows[pdus.corrupt]]
            first_ns = self.corrupt_ns[0] if self.corrupt else int(times[0])
            self.corrupt += len(times)
            self.corrupt_ns = first_ns, int(times[-1])
        source, destination = (
            getattr(batch, f"{end}_address")[rows].astype(np.uint64) << np.uint64(16)
            | (getattr(batch, f"{end}_port")[rows] if place is None else np.uint64(0))
            for end in ("source", "destination")
        )
        ends = (
            np.where(pdus.toward_sender, destination, source),
            np.where(pdus.toward_sender, source, destination),
        )
        keys = pdus.source_entity_id, pdus.transaction_sequence_number, *ends
        _, which = numbered(*keys)
        for first, last in _runs(pdus, which):
            if pdus.kind[first] == cfdp.UNREAD or pdus.corrupt[first]:
                continue
            key = tuple(int(item[first]) for item in keys)
            time_ns = batch.time_ns[rows[first:last]]
            transaction = self._open.get(key) or self._begin(key, pdus, first, int(time_ns[0]))
            if transaction is None:
                self.left_out += last - first
                continue
            silences = np.diff(time_ns, prepend=transaction.last_ns)
            transaction.silence_ns = max(transaction.silence_ns, int(silences.max()))
            transaction.last_ns = max(transaction.last_ns, int(time_ns[-1]))
            if pdus.kind[first] == cfdp.Directive.FILE_DATA:
                self._file_data(transaction, batch.data, pdus, slice(first, last))
            else:
                body = batch.data[pdus.start[first] : pdus.end[first]].tobytes()
                kind = int(pdus.kind[first])
                fields = cfdp.parameters(kind, int(pdus.large[first]), body)
                if kind == cfdp.Directive.METADATA and transaction.finished is not None:
                    del self._open[key]
                    transaction = self._begin(key, pdus, first, int(time_ns[0])) or transaction
                _directive(transaction, kind, fields)
            if (
                transaction.finished_ns is None
                and transaction.eof is not None
                and transaction.state == "finished"
            ):
                transaction.finished_ns = int(time_ns[-1])

    def _begin(self, key: tuple[int, ...], pdus: cfdp.Pdus, row: int, time_ns: int) -> Transaction | None:
        if len(self.transactions) >= MOST_TRANSACTIONS:
            return None
        receiver, acknowledged = int(pdus.destination_entity_id[row]), bool(pdus.acknowledged[row])
        transaction = self._open[key] = Transaction(key[0], key[1], receiver, acknowledged, time_ns, time_ns)
        self.transactions.append(transaction)
        return transaction

    def _file_data(self, transaction: Transaction, data: Octets, pdus: cfdp.Pdus, rows: slice) -> None:
        """Add pieces that follow each other in the file."""
        offset, begin = pdus.file_offset[rows].tolist(), pdus.data[rows]
        sizes = pdus.end[rows] - begin
        start, end = offset[0], offset[-1] + int(sizes[-1])
        if end > LARGEST_OFFSET:
            return
        new = transaction.received.missing(start, end)
        if new != [(start, end)] and len(offset) > 1:
            for row in range(rows.start, rows.stop):
                self._file_data(transaction, data, pdus, slice(row, row + 1))
            return
        transaction.segments += len(offset)
        transaction.resent += not new
        transaction.filled += len(offset) if new and start < transaction.received.end else 0
        if not new or not transaction.received.add(start, end):
            return
        pieces = np.empty(end - start, np.uint8)
        copy_rows(pieces, np.cumsum(sizes) - sizes, data, begin, sizes)
        for first, last in new:
            piece = pieces[first - start : last - start].tobytes()
            for item in transaction.sums.values():
                item.add(piece, first)
            if self._keep:
                self._keep(transaction, first, piece)


def _runs(pdus: cfdp.Pdus, which: NDArray[np.integer[Any]]) -> Iterator[tuple[int, int]]:
    """Yield directives one by one, and pieces of a file in runs that follow each other."""
    end = pdus.file_offset + (pdus.end - pdus.data).astype(np.uint64)
    follows = (pdus.kind[1:] == cfdp.Directive.FILE_DATA) & (pdus.kind[:-1] == cfdp.Directive.FILE_DATA)
    follows &= ~(pdus.corrupt[1:] | pdus.corrupt[:-1])
    follows &= (which[1:] == which[:-1]) & (pdus.file_offset[1:] == end[:-1])
    begins = np.flatnonzero(np.concatenate([np.ones(min(len(which), 1), bool), ~follows])).tolist()
    return zip(begins, [*begins[1:], len(which)], strict=True)


def _directive(transaction: Transaction, kind: int, fields: dict[str, Any]) -> None:
    if kind == cfdp.Directive.METADATA:
        transaction.source_file_name = fields["source_file_name"]
        transaction.destination_file_name = fields["destination_file_name"]
        kind = transaction.checksum_type = fields["checksum_type"]
        transaction.sums = {kind: transaction.sums[kind]} if kind in transaction.sums else {}
        if transaction.eof is None:
            transaction.file_size = fields["file_size"]
    elif kind == cfdp.Directive.EOF:
        transaction.eof, transaction.file_size = fields["condition_code"], fields["file_size"]
        transaction.file_checksum = fields["file_checksum"]
    elif kind == cfdp.Directive.FINISHED:
        transaction.finished, transaction.incomplete = fields["condition_code"], bool(fields["delivery_code"])
    elif kind == cfdp.Directive.NAK:
        transaction.naks += bool(fields["segment_requests"])


MOST_BYTES: Final = 64 << 20


class FileTopics:
    """Follows CFDP transactions, and makes messages of their files.

    Args:
        space: topic space whose mission assigns files to topics.
    """

    def __init__(self, space: TopicSpace) -> None:
        mission: Mission = space.mission
        self._space = space
        self._topics = {item.file_name: item for item in reversed(mission.stored_topics)}
        self._follower = FileEvidence(self._keep, mission.pdu_msg_ids)
        self._open: dict[Transaction, bytearray] = {}
        self._bytes = 0
        self._finished: list[tuple[Transaction, StoredTopic, bytes]] = []
        self._left_out: set[Transaction] = set()

    def _topic(self, item: Transaction) -> StoredTopic | None:
        names = (item.destination_file_name, item.source_file_name)
        topics = (self._topics.get(name.rpartition("/")[2]) for name in names if name)
        return next((topic for topic in topics if topic), None)

    def _keep(self, item: Transaction, offset: int, piece: bytes) -> None:
        if item in self._left_out:
            return
        content = self._open.setdefault(item, bytearray())
        more = max(offset + len(piece) - len(content), 0)
        if self._bytes + more > MOST_BYTES:
            self._finish()
        if self._bytes + more > MOST_BYTES:
            self._bytes -= len(self._open.pop(item))
            self._left_out.add(item)
            return
        self._bytes += more
        content.extend(bytes(more))
        content[offset : offset + len(piece)] = piece

    def _finish(self) -> None:
        """Remove finished transactions from those that are kept."""
        for item in [item for item in self._open if item.finished_ns is not None]:
            content = bytes(self._open.pop(item))
            self._bytes -= len(content)
            self._left_out.add(item)
            topic, envelope = self._topic(item), detect(content)
            if topic and envelope and item.complete and item.checksum_right is not False:
                cdr = content[envelope.size : envelope.size + envelope.parse(content)[0]]
                self._finished.append((item, topic, cdr))

    def offer(self) -> None:
        """Do nothing: a topic is added with its first file."""

    def messages(self, batch: PacketBatch, columns: Columns) -> list[Messages]:
        """Add a batch; return the messages of the files whose transactions finished in it."""
        self._follower.add(batch, columns)
        self._finish()
        finished, self._finished = self._finished, []
        by_topic: dict[StoredTopic, list[tuple[Transaction, bytes]]] = {}
        for item, topic, cdr in sorted(finished, key=lambda item: item[0].finished_ns or 0):
            by_topic.setdefault(topic, []).append((item, cdr))
        messages = (self._of_topic(batch, topic, items) for topic, items in by_topic.items())
        return [item for item in messages if item is not None]

    def _of_topic(
        self, batch: PacketBatch, topic: StoredTopic, items: list[tuple[Transaction, bytes]]
    ) -> Messages | None:
        """Return the messages in one topic's files; None if no file contains one."""
        data = np.frombuffer(b"".join(cdr for _, cdr in items) + bytes(PADDING), np.uint8)
        length = np.array([len(cdr) for _, cdr in items], np.int32)
        offset = np.cumsum(length, dtype=np.int64) - length
        trailing = self._space.types.trailing(topic.type, data, offset, length)
        whole = trailing >= 0
        if not whole.any():
            return None
        size, offset = (length - trailing)[whole], offset[whole]
        whole_items = [item for (item, _), good in zip(items, whole.tolist(), strict=True) if good]
        time_ns = np.array([item.finished_ns for item in whole_items], np.int64)
        count = np.array([item.transaction_sequence_number & 0xFFFFFFFF for item in whole_items])
        row = np.minimum(np.searchsorted(batch.time_ns, time_ns), len(batch) - 1)
        heads = np.empty(len(whole_items), np.dtype(RECORD))
        number = self._space.place(topic.topic, topic.type, {"link": CFDP.label, "file": topic.file_name})
        return whole_messages(row, heads, number, count, time_ns, time_ns, (data, offset, size), repeats=True)
