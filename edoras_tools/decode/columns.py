"""A batch of datagrams into columns, without a step of Python per datagram.

Offsets and verdicts are the same as :mod:`edoras_tools.decode.stack` gives one by one.
"""

from __future__ import annotations

from dataclasses import fields
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from edoras_tools.decode.findings import UNKNOWABLE
from edoras_tools.decode.links import link_columns
from edoras_tools.model import NO_MSG_ID, NO_ROUTE, Columns, Finding, Link, PacketBatch
from edoras_tools.wire import ccsds, cfe, sbn
from edoras_tools.wire.envelope import DEFAULT, FORMATS, EnvelopeFormat
from edoras_tools.wire.limits import BRIDGE_BUFFER, BRIDGE_LENGTH_MODULUS, CI_BUFFER, SOFTWARE_BUS_MAXIMUM
from edoras_tools.wire.order import by_value
from edoras_tools.wire.window import any_nonzero, gather, xor_bytes

if TYPE_CHECKING:
    from collections.abc import Collection

    from numpy.typing import NDArray

    from edoras_tools.decode.context import Context

_SBN_WINDOW: Final = 64
"""Bytes that hold an SBN header, and a subscription's $Id and count."""
_PACKET_WINDOW: Final = 24
"""Bytes that hold every header of a space packet."""
_IDENT: Final = np.frombuffer(sbn.IDENT.encode().ljust(sbn.IDENT_BYTES, b"\0"), np.uint64)
_KNOWN_TYPES: Final = np.isin(np.arange(256), list(sbn.MsgType))
_BLANK: Final = {
    "sbn_msg_type": -1,
    "packet_offset": -1,
    "msg_id": NO_MSG_ID,
    "function_code": -1,
    "mission_time_ns": -1,
    "cdr_offset": -1,
    "route": NO_ROUTE,
}
_PACKET_COLUMNS: Final = (
    "packet_offset",
    "packet_length",
    "msg_id",
    "sequence_flags",
    "sequence_count",
    "function_code",
    "mission_time_ns",
    "header_length",
    "route",
)
_TYPES: Final = {
    "link": "u1",
    "sbn_msg_type": "i2",
    "processor_id": "u4",
    "spacecraft_id": "u4",
    "packet_offset": "i8",
    "packet_length": "i4",
    "msg_id": "i4",
    "sequence_flags": "u1",
    "sequence_count": "u2",
    "function_code": "i2",
    "mission_time_ns": "i8",
    "header_length": "u1",
    "cdr_offset": "i8",
    "cdr_length": "i4",
    "route": "i2",
    "findings": "u4",
}


class ColumnDecoder:
    """Decodes batches, in the order they were captured.

    Args:
        context: shared with the :class:`~edoras_tools.decode.stack.Dissector` that looks at single packets.
    """

    def __init__(self, context: Context) -> None:
        self.context = context

    def decode(self, batch: PacketBatch) -> Columns:
        """Read a batch; nothing in it can make this raise."""
        link = link_columns(batch, self.context)
        rows = np.flatnonzero(link)
        if len(rows) == len(batch):
            return _Pass(self.context, batch, link).columns()
        part = _Pass(self.context, batch.take(rows), link[rows]).columns()
        whole = _blank(len(batch))
        for item in fields(Columns):
            whole[item.name][rows] = getattr(part, item.name)
        outside = link == Link.OTHER
        whole["findings"][outside] = batch.capture_findings[outside]
        return Columns(**whole)


def _blank(count: int, leave_out: Collection[str] = ()) -> dict[str, NDArray[Any]]:
    return {
        name: np.full(count, _BLANK.get(name, 0), dtype)
        for name, dtype in _TYPES.items()
        if name not in leave_out
    }


class _Pass:
    """One batch on its way through the layers; every array has the batch's length."""

    def __init__(self, context: Context, batch: PacketBatch, link: NDArray[np.uint8]) -> None:
        self.context = context
        self.batch = batch
        self.out = _blank(len(batch), leave_out=_PACKET_COLUMNS)
        self.out["link"] = link
        self.out["findings"] = batch.capture_findings.copy()

    def columns(self) -> Columns:
        """Go through the layers, outermost first."""
        link, length = self.out["link"], self.batch.length
        self.mark(Finding.OVER_CI_BUFFER, (link == Link.CI) & (length > CI_BUFFER))
        self.mark(Finding.OVER_BRIDGE_BUFFER, (link == Link.TO) & (length > BRIDGE_BUFFER))
        self.space_packet(self.software_bus_network())
        cut = (self.batch.capture_findings & Finding.CAPTURE_CUT) != 0
        self.out["findings"][cut] &= np.uint32(~UNKNOWABLE & 0xFFFFFFFF)
        return Columns(**self.out)

    def flag(self, finding: Finding, rows: NDArray[np.intp], chosen: NDArray[np.bool_]) -> None:
        """Set a finding's bit in those of ``rows`` that are chosen."""
        if chosen.any():
            self.out["findings"][rows[chosen]] |= np.uint32(finding)

    def mark(self, finding: Finding, chosen: NDArray[np.bool_]) -> None:
        """Set a finding's bit where a mask over the whole batch says so."""
        if chosen.any():
            self.out["findings"] |= chosen * np.uint32(finding)

    def software_bus_network(self) -> NDArray[np.int32]:
        """Read SBN headers; return where in each datagram a space packet starts, -1 where none does."""
        start = np.zeros(len(self.batch), np.int32)
        rows = np.flatnonzero(self.out["link"] == Link.SBN)
        if not len(rows):
            return start
        start[rows] = -1
        length, head = self.batch.length[rows], gather(self.batch.data, self.batch.offset[rows], _SBN_WINDOW)
        legacy = self._legacy(head, length)
        header = np.where(legacy, sbn.LEGACY_HEADER.size, sbn.HEADER.size).astype(np.int32)
        whole = length >= header
        self.flag(Finding.TRUNCATED, rows, ~whole)
        self.flag(Finding.SBN_LEGACY_HEADER, rows, legacy)
        dropped = (length >= sbn.HEADER.size) & (length % BRIDGE_LENGTH_MODULUS < sbn.HEADER.size)
        dropped &= self.context.bridge_ports[self.batch.destination_port[rows]]
        self.flag(Finding.BRIDGE_DROPS_LENGTH, rows, dropped)

        if not whole.all():
            rows, head, length = rows[whole], head[whole], length[whole]
            header, legacy = header[whole], legacy[whole]
        kind = sbn.HEADER.column("msg_type", head)
        payload = length - header
        mismatch = sbn.HEADER.column("msg_size", head) != payload
        self.out["sbn_msg_type"][rows] = kind
        self.out["processor_id"][rows] = sbn.HEADER.column("processor_id", head)
        self.out["spacecraft_id"][rows] = np.where(legacy, 0, sbn.HEADER.column("spacecraft_id", head))
        self.flag(Finding.SBN_SIZE_MISMATCH, rows, mismatch)
        self.flag(Finding.SBN_UNKNOWN_TYPE, rows, ~_KNOWN_TYPES[kind])
        self.flag(Finding.SBN_NO_MESSAGE, rows, kind == sbn.MsgType.NO_MSG)
        self._identities(rows, trusted=_KNOWN_TYPES[kind] & ~mismatch)

        proto = kind == sbn.MsgType.PROTO
        version = np.where(legacy, head[:, sbn.LEGACY_HEADER.size], head[:, sbn.HEADER.size])
        told = payload >= sbn.PROTO.size
        self.flag(Finding.TRUNCATED, rows, proto & ~told)
        self.flag(Finding.SBN_VERSION_MISMATCH, rows, proto & told & (version != sbn.PROTOCOL_VERSION))
        listed = np.flatnonzero((kind == sbn.MsgType.SUB) | (kind == sbn.MsgType.UNSUB))
        self._subscriptions(rows[listed], head[listed], payload[listed], legacy[listed])
        app = kind == sbn.MsgType.APP
        start[rows[app]] = header[app]
        return start

    @staticmethod
    def _legacy(head: NDArray[np.uint8], length: NDArray[np.int32]) -> NDArray[np.bool_]:
        """Tell the older 7-byte header: its size fits, and so does what then follows it."""
        at = sbn.LEGACY_HEADER.size
        fits: NDArray[np.bool_] = (length >= at) & (sbn.HEADER.column("msg_size", head) == length - at)
        rows = np.flatnonzero(fits)
        if not len(rows):
            return fits
        head, length = head[rows], length[rows]
        kind = sbn.HEADER.column("msg_type", head)
        packet = ccsds.PRIMARY.column("packet_data_length", head, at).astype(np.int32) + ccsds.LENGTH_BIAS
        app = kind == sbn.MsgType.APP
        proto = kind == sbn.MsgType.PROTO
        listed = (kind == sbn.MsgType.SUB) | (kind == sbn.MsgType.UNSUB)
        follows = np.select(
            [app, proto, listed],
            [packet == length - at, length == at + sbn.PROTO.size, head[:, at] == ord("$")],
            length == at,
        )
        fits[rows] = _KNOWN_TYPES[kind] & follows
        return fits

    def _identities(self, rows: NDArray[np.intp], trusted: NDArray[np.bool_]) -> None:
        """Compare every sender's identity with the one its endpoint is known by."""
        batch, peers = self.batch, self.context.peers
        identity = self.out["spacecraft_id"][rows].astype(np.uint64) << 32 | self.out["processor_id"][rows]
        endpoint = (
            batch.source_address[rows].astype(np.uint64) << 24
            | batch.source_port[rows].astype(np.uint64) << 8
        )
        endpoint |= batch.ip_version[rows]
        foreign = np.zeros(len(rows), bool)
        for _, members in by_value(endpoint):
            first = int(rows[members[0]])
            key = (batch.address(int(batch.source_address[first]), first), int(batch.source_port[first]))
            known = peers.known(key, int(batch.number[first]))
            if known is None:
                # Nothing is foreign before someone has introduced himself.
                after = members[np.logical_or.accumulate(trusted[members])]
                if not len(after):
                    continue
                introduction = int(batch.number[rows[after[0]]])
                known = peers.introduce(key, divmod(int(identity[after[0]]), 1 << 32), introduction)
            else:
                after = members
            foreign[after] = identity[after] != np.uint64(known[0] << 32 | known[1])
        for spacecraft, processor in self.context.identities:
            foreign &= identity != np.uint64(spacecraft << 32 | processor)
        self.flag(Finding.SBN_ID_MISMATCH, rows, foreign)

    def _subscriptions(
        self,
        rows: NDArray[np.intp],
        head: NDArray[np.uint8],
        payload: NDArray[np.int32],
        legacy: NDArray[np.bool_],
    ) -> None:
        """Judge SUB and UNSUB: the $Id, and whether all entries are there."""
        whole = payload >= sbn.SUBSCRIPTIONS.size
        self.flag(Finding.TRUNCATED, rows, ~whole)
        for old, at in ((False, sbn.HEADER.size), (True, sbn.LEGACY_HEADER.size)):
            pick = whole & (legacy == old)
            if not pick.any():
                continue
            ident = np.ascontiguousarray(head[pick, at : at + sbn.IDENT_BYTES]).view(np.uint64)
            foreign = (ident != _IDENT).any(axis=1)
            self.flag(Finding.SBN_ID_MISMATCH, rows[pick], foreign)
            count = sbn.SUBSCRIPTIONS.column("count", head[pick], at).astype(np.int32)
            short = payload[pick] < sbn.SUBSCRIPTIONS.size + count * sbn.SUBSCRIPTION.size
            self.flag(Finding.TRUNCATED, rows[pick], short)

    def space_packet(self, start: NDArray[np.int32]) -> None:
        """Read the primary header, and all that lies behind it.

        Every row is read, whole columns at a time; those that hold no packet are blanked afterwards.
        """
        length = self.batch.length - start
        packet = (start >= 0) & (length >= ccsds.PRIMARY.size)
        absent = np.flatnonzero(~packet)
        self.flag(Finding.TRUNCATED, absent, start[absent] >= 0)
        start[absent], length[absent] = 0, 0
        offset = self.batch.offset + start
        head = gather(self.batch.data, offset, _PACKET_WINDOW)
        total = ccsds.PRIMARY.column("packet_data_length", head).astype(np.int32) + ccsds.LENGTH_BIAS
        word = head[:, :2].view(">u2")[:, 0].astype(np.int32)
        sequence = head[:, 2:4].view(">u2")[:, 0].astype(np.uint16)
        command = (word & cfe.COMMAND_BIT) != 0
        msg_id = self._msg_id(word, head, length)
        link = self.out["link"]
        valid = (msg_id > 0) & (msg_id <= cfe.HIGHEST_MSG_ID)
        against = ((link == Link.CI) & ~command) | ((link == Link.TO) & command)
        self.mark(Finding.LENGTH_MISMATCH, packet & (total != length))
        self.mark(Finding.SEQUENCE_UNSET, packet & (sequence == 0))
        self.mark(Finding.OVER_SOFTWARE_BUS, packet & (total > SOFTWARE_BUS_MAXIMUM))
        self.mark(Finding.INVALID_MSG_ID, packet & ~valid)
        self.mark(Finding.UNKNOWN_MSG_ID, packet & valid & ~self.context.known[msg_id])
        self.mark(Finding.WRONG_DIRECTION, packet & against)
        self.out |= {
            "packet_offset": offset,
            "packet_length": length,
            "msg_id": msg_id,
            "sequence_flags": (sequence >> 14).astype(np.uint8),
            "sequence_count": sequence & np.uint16(0x3FFF),
            "route": self.context.route_of[link, msg_id],
        }
        self._secondary(packet, head, total, command)
        for name in _PACKET_COLUMNS:
            self.out[name][absent] = _BLANK.get(name, 0)
        self._envelopes(packet)
        self._structs()

    def _msg_id(
        self, word: NDArray[np.int32], head: NDArray[np.uint8], length: NDArray[np.int32]
    ) -> NDArray[np.int32]:
        if not self.context.options.extended_header:
            return word
        subsystem = cfe.EXTENDED.column("subsystem_id", head, ccsds.PRIMARY.size).astype(np.int32)
        extended = (word & 0x7F) | (word >> 12 & 1) << 7 | (subsystem & 0xFF) << 8
        return np.where(length >= ccsds.PRIMARY.size + cfe.EXTENDED.size, extended, word)

    def _secondary(
        self,
        packet: NDArray[np.bool_],
        head: NDArray[np.uint8],
        total: NDArray[np.int32],
        command: NDArray[np.bool_],
    ) -> None:
        """Read the cFE command and telemetry headers."""
        length = self.out["packet_length"]
        extra = cfe.EXTENDED.size if self.context.options.extended_header else 0
        as_command = cfe.COMMAND_HEADER_BYTES + extra
        as_telemetry = self.context.options.telemetry_header + extra
        bare = ~command & (length == as_command) & (total == length)
        short = command | bare
        header = np.where(short, np.uint8(as_command), np.uint8(as_telemetry))
        whole = length >= header
        self.mark(Finding.HEADER_ONLY, packet & bare)
        self.mark(Finding.TRUNCATED, packet & ~whole)
        self.out["header_length"] = np.where(whole, header, np.uint8(ccsds.PRIMARY.size))

        at = ccsds.PRIMARY.size + extra
        seconds = cfe.TELEMETRY.column("seconds", head, at).astype(np.int64)
        subseconds = cfe.TELEMETRY.column("subseconds", head, at).astype(np.int64)
        time_ns = seconds * 1_000_000_000 + (subseconds * 1_000_000_000 >> 16)
        self.out["mission_time_ns"] = np.where(whole & ~short, time_ns, -1)
        code = cfe.COMMAND.column("function_code", head, at).astype(np.int16)
        self.out["function_code"] = np.where(whole & short, code, np.int16(-1))

        rows = np.flatnonzero(packet & whole & command)
        length, total, present = length[rows], total[rows], head[rows, at + 1] != 0
        summed = xor_bytes(self.batch.data, self.out["packet_offset"][rows], np.minimum(length, total))
        bad = summed != cfe.CHECKSUM_SEED
        self.flag(Finding.CHECKSUM_BAD, rows, bad & present)
        self.flag(Finding.CHECKSUM_ABSENT, rows, bad & ~present)
        unknown, misfit = self.context.command_table.judge(
            self.out["msg_id"][rows], code[rows], length - extra
        )
        self.flag(Finding.UNKNOWN_FUNCTION_CODE, rows, unknown)
        self.flag(Finding.COMMAND_LENGTH, rows, misfit)

    def _structs(self) -> None:
        """Judge whether packets are as long as the C structs they should hold."""
        rows = np.flatnonzero(self.context.structs.has[self.out["msg_id"]])
        if len(rows):
            for _, members, fits in self.context.structs.split(rows, self.out.__getitem__):
                self.flag(Finding.STRUCT_LENGTH, members, ~fits)

    def _envelopes(self, packet: NDArray[np.bool_]) -> None:
        """Read the envelopes of the routes' packets, a route at a time."""
        exact = self.out["route"]
        route = np.where(exact == NO_ROUTE, self.context.any_route_of[self.out["msg_id"]], exact)
        unread = np.uint32(Finding.HEADER_ONLY | Finding.TRUNCATED)
        rows = np.flatnonzero(packet & (route != NO_ROUTE) & ((self.out["findings"] & unread) == 0))
        route = route[rows]
        bare = self.out["packet_length"][rows] == self.out["header_length"][rows]
        if bare.any():
            mismatched = (self.out["findings"][rows] & np.uint32(Finding.LENGTH_MISMATCH)) != 0
            quiet = self.out["function_code"][rows] == 0
            self.flag(Finding.HEADER_ONLY, rows, bare & ~quiet & ~mismatched)
            self.flag(Finding.TRUNCATED, rows, bare & mismatched)
            rows, route = rows[~bare], route[~bare]
        for index, picked in by_value(route):
            self._envelope(index, rows[picked])

    def _envelope(self, route: int, rows: NDArray[np.intp]) -> None:
        chosen = self.context.envelopes[route]
        offset = self.out["packet_offset"][rows] + self.out["header_length"][rows]
        have = self.out["packet_length"][rows] - self.out["header_length"][rows]
        head = gather(self.batch.data, offset, DEFAULT.size + 4)
        if chosen is not None:
            self._bodies(route, rows, offset, have, head, chosen)
            return
        left = np.ones(len(rows), bool)
        for item in FORMATS:
            fits = left & _fits(head, have, item)
            self._bodies(route, rows[fits], offset[fits], have[fits], head[fits], item)
            left &= ~fits
        self._bodies(route, rows[left], offset[left], have[left], head[left], DEFAULT)

    def _bodies(
        self,
        route: int,
        rows: NDArray[np.intp],
        offset: NDArray[np.int64],
        have: NDArray[np.int32],
        head: NDArray[np.uint8],
        envelope: EnvelopeFormat,
    ) -> None:
        """Read envelopes of one format, and judge the CDR that they hold.

        Args:
            route: whose type the CDR has.
            rows: (n,) rows of the batch.
            offset: (n,) where the envelope starts in the batch's data.
            have: (n,) bytes from there to the end of the packet.
            head: (n, 20) those bytes.
            envelope: the format.
        """
        size = envelope.size
        whole = have >= size
        self.flag(Finding.TRUNCATED, rows, ~whole)
        claimed = envelope.layout.column("buffer_length", head).astype(np.uint64)
        capacity = envelope.layout.column("buffer_capacity", head).astype(np.uint64)
        space = np.maximum(have - size, 0).astype(np.uint64)
        over = claimed > space
        self.flag(Finding.ENVELOPE_OVERRUN, rows, whole & (over | (capacity < claimed)))
        self.flag(Finding.CDR_INVALID, rows, whole & ~over & (claimed < 4))
        read = whole & ~over & (claimed >= 4)
        rows, offset, head = rows[read], offset[read] + size, head[read]
        length, space = claimed[read].astype(np.int32), space[read].astype(np.int32)
        self.out["cdr_offset"][rows] = offset
        self.out["cdr_length"][rows] = length
        known = (head[:, size] == 0) & (head[:, size + 1] <= 1)
        valid = known
        types, name = self.context.types, self.context.mission.routes[route].type
        if types is not None and types.has(name):
            valid = known & types.valid(name, self.batch.data, offset, length)
        self.flag(Finding.CDR_INVALID, rows, ~valid)
        self.flag(Finding.CDR_BIG_ENDIAN, rows, known & (head[:, size + 1] == 0))
        stale = any_nonzero(self.batch.data, offset + length, space - length)
        self.flag(Finding.STALE_TAIL, rows, stale)


def _fits(head: NDArray[np.uint8], have: NDArray[np.int32], envelope: EnvelopeFormat) -> NDArray[np.bool_]:
    """Tell where an envelope of this format holds: as :func:`edoras_tools.wire.envelope.detect`, for many."""
    size = envelope.size
    length = envelope.layout.column("buffer_length", head).astype(np.uint64)
    capacity = envelope.layout.column("buffer_capacity", head).astype(np.uint64)
    space = np.maximum(have - size, 0).astype(np.uint64)
    start = head[:, size : size + 4]
    encapsulated = (start[:, 0] == 0) & (start[:, 1] <= 1) & (start[:, 2] == 0) & (start[:, 3] == 0)
    fits: NDArray[np.bool_] = (
        (have >= size + 4) & (length >= 4) & (length <= capacity) & (length <= space) & encapsulated
    )
    return fits
