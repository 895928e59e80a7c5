"""Datagrams to send, in columns, and the changes of their headers before they are sent.

Rules that it keeps:

1. Columns only: each change works on all datagrams at once, on a copy.
2. Changes act in this order: headers, MsgId and sender, time stamps, sequence counts, checksums.
3. Changes that are the same in every pass are made once (``Changes.once``), the others each time (``each``).
4. A datagram without the field in question stays as it is.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

import msgspec
import numpy as np
from msgspec.structs import replace

from edoras_tools.cfs import edoras_app
from edoras_tools.model import NO_MSG_ID, NO_ROUTE, Columns, Link, PacketBatch, Peer
from edoras_tools.older import StrEnum
from edoras_tools.units import SECOND
from edoras_tools.wire import arrays, ccsds, cfe, sbn
from edoras_tools.wire.ccsds import MSG_ID_BYTES, VERSION_1, VERSION_2

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from typing_extensions import Self

    from edoras_tools.wire.layout import Layout

_COUNTS: Final = 1 << 14
_UNSEGMENTED: Final = ccsds.UNSEGMENTED << 14
_SIZES: Final = np.array(
    [[item.command_bytes for item in cfe.HEADERS], [item.telemetry_bytes for item in cfe.HEADERS]]
)
"""Header bytes of commands and of telemetry, by ``Outgoing.headers``."""
_STARTS: Final = np.array([item.start for item in cfe.HEADERS])
_STAMP_AT: Final = 4
"""Offset of the time in a message that starts with a ``std_msgs/Header``, after the encapsulation."""


class SequenceRule(StrEnum):
    """The treatment of sequence words."""

    KEEP = "keep"
    COUNT = "count"
    ZERO = "zero"


class ChecksumRule(StrEnum):
    """The treatment of the checksums of commands."""

    KEEP = "keep"
    FIX = "fix"
    ZERO = "zero"
    WRONG = "wrong"


class Outgoing(msgspec.Struct, frozen=True):
    """Datagrams in sending order; offsets point into ``data``, arrays have one element a datagram.

    Attributes:
        link: link that they go to.
        data: payloads, without anything else, u8.
        offset: start of the datagram, i64.
        length: bytes of the datagram, i32.
        time_ns: time of recording, i64.
        packet_offset: start of the space packet, i64; -1 if there is none.
        packet_length: bytes of the space packet, i32.
        header_length: bytes of the cFE headers, u8.
        headers: index in ``cfe.HEADERS`` of the packet's headers, u8.
        msg_id: MsgId, i32; ``NO_MSG_ID`` if there is none.
        cdr_offset: start of the CDR, i64; -1 if there is none.
        route: index into the mission's routes, or ``NO_ROUTE``, i16.
    """

    link: Link
    data: arrays.Octets
    offset: arrays.Integers
    length: NDArray[np.int32]
    time_ns: arrays.Integers
    packet_offset: arrays.Integers
    packet_length: NDArray[np.int32]
    header_length: arrays.Octets
    headers: arrays.Octets
    msg_id: NDArray[np.int32]
    cdr_offset: arrays.Integers
    route: NDArray[np.int16]

    def __len__(self) -> int:
        return len(self.offset)

    def __getitem__(self, index: int) -> bytes:
        start = int(self.offset[index])
        return self.data[start : start + int(self.length[index])].tobytes()

    def take(self, rows: NDArray[Any] | slice) -> Self:
        """Return selected rows over the same buffer."""
        return replace(self, **{name: getattr(self, name)[rows] for name in _COLUMNS})

    def copy(self) -> Self:
        """Return the same datagrams over a buffer of their own."""
        return replace(self, data=self.data.copy())

    @classmethod
    def bare(cls, link: Link, messages: Sequence[bytes], time_ns: arrays.Integers) -> Outgoing:
        """Lay out messages without packets."""
        length = np.array([len(item) for item in messages], np.int32)
        none, nothing = np.full(len(messages), -1, np.int64), np.zeros(len(messages), np.uint8)
        return cls(
            link=link,
            data=np.frombuffer(bytearray(b"".join(messages)), np.uint8),
            offset=np.cumsum(length, dtype=np.int64) - length,
            length=length,
            time_ns=time_ns,
            packet_offset=none,
            packet_length=np.zeros(len(messages), np.int32),
            header_length=nothing,
            headers=nothing,
            msg_id=np.full(len(messages), NO_MSG_ID, np.int32),
            cdr_offset=none,
            route=np.full(len(messages), NO_ROUTE, np.int16),
        )

    @classmethod
    def of(cls, link: Link, batch: PacketBatch, columns: Columns, *, packets: bool = False) -> Outgoing:
        """Take the payloads of a batch out of their frames; or their space packets."""
        start = columns.packet_offset if packets else batch.offset
        length = columns.packet_length if packets else batch.length
        offset = np.cumsum(length, dtype=np.int64) - length
        shift = offset - start
        data = np.empty(int(length.sum()), np.uint8)
        arrays.copy_rows(data, offset, batch.data, start, length)
        return cls(
            link=link,
            data=data,
            offset=offset,
            length=length,
            time_ns=batch.time_ns,
            packet_offset=_moved(columns.packet_offset, shift),
            packet_length=columns.packet_length,
            header_length=columns.header_length,
            headers=columns.headers,
            msg_id=columns.msg_id,
            cdr_offset=_moved(columns.cdr_offset, shift),
            route=columns.route,
        )

    @classmethod
    def packets(
        cls,
        link: Link,
        rows: Sequence[Packet],
        *,
        sender: Peer | None = None,
        headers: cfe.Headers | None = None,
    ) -> Outgoing:
        """Lay out space packets, one a datagram.

        Args:
            link: link that they go to.
            rows: the packets.
            sender: identity of the sender, needed for the SBN link.
            headers: headers of their cFE; None for the usual ones.
        """
        before = [
            sbn.emit(sbn.MsgType.APP, sender, row.packet)[: sbn.HEADER.size] if sender else b""
            for row in rows
        ]
        data = np.frombuffer(
            b"".join(part for head, row in zip(before, rows, strict=True) for part in (head, row.packet)),
            np.uint8,
        ).copy()
        packet_length = np.array([len(row.packet) for row in rows], np.int32)
        headers = headers or cfe.STANDARD
        extra = sbn.HEADER.size if sender else 0
        length = packet_length + np.int32(extra)
        offset = np.cumsum(length, dtype=np.int64) - length
        cdr = np.array([row.cdr_at for row in rows], np.int64)
        msg_id = np.array([headers.msg_ids.of(row.packet) for row in rows], np.int32)
        command = headers.msg_ids.is_command(msg_id)
        header = np.where(command, headers.command_bytes, headers.telemetry_bytes)
        return cls(
            link=link,
            data=data,
            offset=offset,
            length=length,
            time_ns=np.array([row.time_ns for row in rows], np.int64),
            packet_offset=offset + extra,
            packet_length=packet_length,
            header_length=header.astype(np.uint8),
            headers=np.full(len(rows), cfe.HEADERS.index(headers), np.uint8),
            msg_id=msg_id,
            cdr_offset=np.where(cdr < 0, -1, offset + extra + cdr),
            route=np.array([row.route for row in rows], np.int16),
        )

    @property
    def command(self) -> arrays.Mask:
        """Which datagrams are commands, bool; also True without a MsgId."""
        return VERSION_1.is_command(cfe.known_ids(self.msg_id, self.headers))

    def with_headers(self, new: cfe.Headers) -> Outgoing:
        """Return the datagrams with the headers of another build, like ``cfe.with_headers`` for one packet.

        The size in the SBN header changes, too. Packets shorter than their headers stay unchanged.
        """
        number, command = cfe.HEADERS.index(new), self.command
        size = np.where(command, *_SIZES[:, self.headers])
        new_size = np.where(command, new.command_bytes, new.telemetry_bytes)
        changed = (self.msg_id != NO_MSG_ID) & (self.headers != number) & (self.packet_length >= size)
        grown = np.where(changed, new_size - size, 0).astype(np.int32)
        length, before = self.length + grown, np.where(changed, self.packet_offset - self.offset, self.length)
        offset = np.cumsum(length, dtype=np.int64) - length
        shift, rows = offset - self.offset, np.flatnonzero(changed)
        old, at, own = self.packet_offset[rows], (offset + before)[rows], self.headers[rows]
        data = np.zeros(int(length.sum()), np.uint8)
        arrays.copy_rows(data, offset, self.data, self.offset, before)
        arrays.copy_rows(data, at, self.data, old, np.full(len(rows), ccsds.PRIMARY.size))
        both = np.array([item.extended and new.extended for item in cfe.HEADERS])[own]
        behind = ccsds.PRIMARY.size
        arrays.copy_rows(data, at + behind, self.data, old + behind, both * cfe.EXTENDED.size)
        shared = np.where(command[rows], cfe.COMMAND.size, cfe.TELEMETRY_SHORT.size)
        arrays.copy_rows(data, at + new.start, self.data, old + _STARTS[own], shared)
        rest = (self.offset + self.length)[rows] - old - size[rows]
        arrays.copy_rows(data, at + new_size[rows], self.data, old + size[rows], rest)
        result = replace(
            self,
            data=data,
            offset=offset,
            length=length,
            packet_offset=_moved(self.packet_offset, shift),
            packet_length=self.packet_length + grown,
            header_length=np.where(changed, new_size, self.header_length).astype(np.uint8),
            headers=np.where(changed, number, self.headers).astype(np.uint8),
            msg_id=self.msg_id.copy(),
            cdr_offset=_moved(self.cdr_offset, shift + grown),
        )
        standard = cfe.known_ids(self.msg_id, self.headers)[rows]
        _put_msg_ids(result, rows, new.msg_ids.of_known(standard))
        _grow(data, at, ccsds.PRIMARY, "packet_data_length", grown[rows])
        if self.link.peers:
            _grow(data, offset[rows], sbn.HEADER, "msg_size", grown[rows])
        right = arrays.xor_bytes(self.data, old, self.packet_length[rows]) == cfe.CHECKSUM_SEED
        _check(result, ChecksumRule.FIX, rows[right & command[rows]])
        return result


class Packet(msgspec.Struct, frozen=True):
    """A space packet to lay out.

    Attributes:
        packet: bytes of the packet, at least a primary header.
        time_ns: time at which it was recorded, or is due.
        route: index into the mission's routes.
        cdr_at: start of the CDR in the packet; -1 if there is none.
    """

    packet: bytes
    time_ns: int = 0
    route: int = NO_ROUTE
    cdr_at: int = -1


_COLUMNS: Final = tuple(name for name in Outgoing.__struct_fields__ if name not in {"link", "data"})


def _moved(place: arrays.Integers, shift: arrays.Integers) -> arrays.Integers:
    return np.where(place < 0, -1, place + shift)


def join_datagrams(parts: Sequence[Outgoing]) -> Outgoing:
    """Concatenate datagrams; at least one part."""
    if len(parts) == 1:
        return parts[0]
    starts = np.cumsum([0, *(len(part.data) for part in parts[:-1])])
    columns: dict[str, Any] = {}
    for name in _COLUMNS:
        values = [getattr(part, name) for part in parts]
        if name.endswith("offset"):
            values = [
                np.where(value < 0, -1, value + start) for value, start in zip(values, starts, strict=True)
            ]
        columns[name] = np.concatenate(values)
    return Outgoing(link=parts[0].link, data=np.concatenate([part.data for part in parts]), **columns)


class Changes(msgspec.Struct, frozen=True):
    """Changes of the datagrams before they are sent; nothing by default.

    Attributes:
        headers: headers of the receiving cFE, which all packets get; None keeps the captured ones.
        msg_ids: replacement of each MsgId; it may be of another type (command, telemetry) only if all packets
            have extended headers, whose lengths are equal: the function code is then 1, the time 0.
        sequence: treatment of the sequence word of every space packet.
        checksum: treatment of the checksum of every command, after all other changes.
        restamp: routes whose messages start with a ``std_msgs/Header``, bool (routes,): its stamp becomes the
            time of sending; None changes no stamp.
        sender: identity in every SBN header; None keeps the captured ones.
    """

    msg_ids: Mapping[int, int] = msgspec.field(default_factory=dict)
    sequence: SequenceRule = SequenceRule.KEEP
    checksum: ChecksumRule = ChecksumRule.KEEP
    restamp: arrays.Mask | None = None
    sender: Peer | None = None
    headers: cfe.Headers | None = None

    @property
    def differ(self) -> bool:
        """Whether the changes differ from pass to pass."""
        return self.sequence is SequenceRule.COUNT or self.restamp is not None

    def once(self, out: Outgoing) -> Outgoing:
        """Return the datagrams with the changes that are the same in every pass."""
        if not self.msg_ids and self.sender is None and self.headers is None:
            return out if self.differ else self.each(out)
        old_ids = out.msg_id
        out = out.copy() if self.headers is None else out.with_headers(self.headers)
        if self.sender is not None and out.link.peers:
            self._write_sender(out, self.sender)
        if self.msg_ids:
            out = replace(out, msg_id=out.msg_id.copy())
            for old, new in self.msg_ids.items():
                rows = np.flatnonzero(old_ids == old)
                before = out.command[rows]
                _put_msg_ids(out, rows, np.full(len(rows), new, np.int32))
                other = rows[out.command[rows] != before]
                _put_other_header(out, other[out.packet_length[other] >= out.header_length[other]])
        return out if self.differ else self.each(out)

    def each(self, out: Outgoing, *, sent: int = 0, start_ns: int = 0, due_ns: Any = 0) -> Outgoing:
        """Return the datagrams for one pass.

        Args:
            out: result of ``once``.
            sent: number of passes before this one.
            start_ns: start of this pass, ns since 1970.
            due_ns: deadlines from then, i64 (n,).
        """
        if self.sequence is SequenceRule.KEEP and self.checksum is ChecksumRule.KEEP and self.restamp is None:
            return out
        out = out.copy()
        if self.restamp is not None:
            rows = np.flatnonzero((out.cdr_offset >= 0) & (out.route != NO_ROUTE))
            rows = rows[self.restamp[out.route[rows]]]
            _stamp(out, rows, (start_ns + np.broadcast_to(due_ns, len(out)))[rows])
        if self.sequence is not SequenceRule.KEEP:
            _number(out, self.sequence, sent)
        if self.checksum is not ChecksumRule.KEEP:
            _check(out, self.checksum)
        return out

    @staticmethod
    def _write_sender(out: Outgoing, sender: Peer) -> None:
        """Write the sender into every complete SBN header."""
        whole = out.offset[out.length >= sbn.HEADER.size]
        slot = sbn.HEADER.by_name["processor_id"]
        identity = np.array([sender.processor_id, sender.spacecraft_id], ">u4").view("V8")
        arrays.put_rows(out.data, whole + slot.start, np.repeat(identity, len(whole)))


def _put_msg_ids(out: Outgoing, rows: arrays.Places, msg_id: NDArray[np.int32]) -> None:
    """Write MsgIds into packets, in the version of their headers."""
    out.msg_id[rows] = msg_id
    for number, members in arrays.by_value(out.headers[rows]):
        headers, at = cfe.HEADERS[number], out.packet_offset[rows[members]]
        word, subsystem = headers.msg_ids.words(msg_id[members])
        arrays.put_rows(out.data, at, word.astype(">u2"))
        if headers.msg_ids is VERSION_2:
            whole = out.packet_length[rows[members]] >= MSG_ID_BYTES
            out.data[at[whole] + MSG_ID_BYTES - 1] = np.broadcast_to(subsystem, len(at))[whole]


def _put_other_header(out: Outgoing, rows: arrays.Places) -> None:
    """Replace command headers by telemetry headers or the reverse, after extended headers."""
    headers = cfe.WITH_EXTENDED
    for command in (False, True):
        selection = rows[out.command[rows] == command]
        layout = headers.command if command else headers.telemetry
        header = layout.emit({"function_code": edoras_app.SET} if command else {})
        arrays.put_rows(
            out.data,
            out.packet_offset[selection] + headers.start,
            np.full(len(selection), np.void(header), f"V{len(header)}"),
        )


def _grow(data: arrays.Octets, at: arrays.Integers, layout: Layout, name: str, by: NDArray[np.int32]) -> None:
    """Add to a 16-bit size in headers of a layout."""
    at = at + layout.by_name[name].start
    arrays.put_rows(data, at, (arrays.read_at(data, at, ">u2").astype(np.int32) + by).astype(">u2"))


def _stamp(out: Outgoing, rows: arrays.Places, time_ns: arrays.Integers) -> None:
    little = (out.data[out.cdr_offset[rows] + 1] & 1) != 0
    for order, selection in (("<", little), (">", ~little)):
        picked = rows[selection]
        times = np.stack(np.divmod(time_ns[selection], SECOND), axis=1).astype(f"{order}u4").view("V8")
        arrays.put_rows(out.data, out.cdr_offset[picked] + _STAMP_AT, times[:, 0])


def _number(out: Outgoing, rule: SequenceRule, sent: int) -> None:
    rows = np.flatnonzero(out.msg_id != NO_MSG_ID)
    word = np.zeros(len(rows), ">u2")
    if rule is SequenceRule.COUNT:
        for _, picked in arrays.by_value(out.msg_id[rows]):
            count = np.arange(sent * len(picked), (sent + 1) * len(picked)) % _COUNTS
            word[picked] = _UNSEGMENTED | count
    arrays.put_rows(out.data, out.packet_offset[rows] + 2, word)


def _check(out: Outgoing, rule: ChecksumRule, rows: arrays.Places | None = None) -> None:
    if rows is None:
        whole = out.packet_length >= out.header_length
        rows = np.flatnonzero((out.msg_id != NO_MSG_ID) & out.command & whole)
    at = out.packet_offset[rows] + _STARTS[out.headers[rows]] + cfe.CHECKSUM_BYTE
    out.data[at] = 0
    if rule is not ChecksumRule.ZERO:
        right = arrays.xor_bytes(out.data, out.packet_offset[rows], out.packet_length[rows]) ^ np.uint8(
            cfe.CHECKSUM_SEED
        )
        out.data[at] = right if rule is ChecksumRule.FIX else ~right
