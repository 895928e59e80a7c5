"""A batch of datagrams into columns, without a step of Python per datagram.

Offsets and findings are the same as those that :mod:`edoras_tools.decode.stack` gives one by one.

The link of a datagram is, among the links that claim its port, the one with the best evidence. On the demos'
single host cpu2's CI port equals TO's destination port (both 1235): the port is not enough.
"""

from __future__ import annotations

from collections.abc import Collection
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from edoras_tools import model
from edoras_tools.cfs.software_bus import SOFTWARE_BUS_MAXIMUM
from edoras_tools.decode.spacecraft import FIRST_SPACECRAFT
from edoras_tools.decode.variants import Variants
from edoras_tools.links import table
from edoras_tools.structs.bindings import payloads
from edoras_tools.wire import arrays, ccsds, cfe
from edoras_tools.wire.envelope import (
    DEFAULT,
    ENVELOPE_FORMATS,
    ROUNDED,
    EnvelopeFormat,
    capacity_column,
    holds,
    intact_rows,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.decode.context import Context
    from edoras_tools.links.protocol import LinkProtocol
    from edoras_tools.wire.layout import Layout

_PACKET_WINDOW: Final = 24
"""First bytes of a space packet that contain all its headers."""
_BYTES: Final = np.array(
    [[getattr(item, name) for item in cfe.HEADERS] for name in ("command_bytes", "telemetry_bytes", "start")],
    np.uint8,
)
"""Header bytes of a command, of telemetry, and the start of that header, by ``Columns.headers``."""
_BLANK: Final = {
    "spacecraft": FIRST_SPACECRAFT,
    "sbn_msg_type": -1,
    "packet_offset": -1,
    "msg_id": model.NO_MSG_ID,
    "function_code": -1,
    "mission_time_ns": -1,
    "cdr_offset": -1,
    "route": model.NO_ROUTE,
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
    "headers",
    "route",
)
_TYPES: Final = {
    "link": "u1",
    "spacecraft": "u1",
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
    "headers": "u1",
    "cdr_offset": "i8",
    "cdr_length": "i4",
    "route": "i2",
    "findings": "u4",
}


class Begun(NamedTuple):
    """A batch that is decoded as far as its results depend on earlier batches.

    Attributes:
        link: link of each datagram, u8.
        start: start of the space packet in each datagram of a link, i32; -1 if there is none.
        out: columns of the datagrams of a link so far.
        part: batch of these datagrams; None: to be taken from the whole batch.
    """

    link: arrays.Octets
    start: NDArray[np.int32]
    out: dict[str, NDArray[Any]]
    part: model.PacketBatch | None = None


def recorded_columns(batch: model.PacketBatch, context: Context) -> model.Columns:
    """Return the columns of the messages of a recording without datagrams."""
    assert batch.recorded is not None, "they are messages"
    columns = blank_columns(len(batch))
    columns["route"] = batch.recorded["topic"].astype(np.int16)
    columns["sequence_count"] = batch.recorded["sequence"].astype(np.uint16)
    columns["cdr_offset"], columns["cdr_length"] = batch.offset.copy(), batch.length.copy()
    for place, rows in arrays.by_value(columns["route"]):
        topic = context.mission.recorded[place]
        if topic.unread or context.types is None:
            columns["cdr_offset"][rows], columns["cdr_length"][rows] = -1, 0
            continue
        valid = context.types.valid(topic.type, batch.data, batch.offset[rows], batch.length[rows])
        columns["findings"][rows[~valid]] |= np.uint32(model.Finding.CDR_INVALID)
    return model.Columns(**columns)


class ColumnDecoder:
    """Decodes batches, in the order they were captured.

    Args:
        context: shared with the :class:`~edoras_tools.decode.stack.Dissector` that reads single packets.
    """

    def __init__(self, context: Context) -> None:
        self.context = context
        self._variants = Variants(context)
        self._nothing = model.Columns(**blank_columns(0))

    def settle(self) -> None:
        """Detect nothing: headers and envelopes are the usual ones, or those of options and routes."""
        self._variants.settled = True

    def decode(self, batch: model.PacketBatch) -> model.Columns:
        """Read a batch; nothing in it can make this raise."""
        if not len(batch):  # live sources give many
            return self._nothing
        if batch.recorded is not None:
            return recorded_columns(batch, self.context)
        return self.finish(batch, self.begin(batch))

    def begin(self, batch: model.PacketBatch) -> Begun:
        """Decode the results that depend on earlier batches, of a batch with at least one row."""
        link = link_columns(batch, self.context)
        if not self._variants.settled:
            self._variants.examine(batch, link)
        rows = np.flatnonzero(link)
        part = batch if len(rows) == len(batch) else batch.take(rows)
        read = _Pass(self.context, part, blank_columns(len(part), leave_out=_PACKET_COLUMNS))
        read.out["link"] = link if part is batch else link[rows]
        read.out["findings"] = part.capture_findings.copy()
        start = read.begin()
        read.out["spacecraft"] = self.context.spacecraft.column(part, read.out["link"], start)
        return Begun(link, start, read.out, part)

    def finish(self, batch: model.PacketBatch, detected: Begun) -> model.Columns:
        """Decode the rest; ``detected`` is the result of ``begin``, possibly from another process."""
        link, start, out, part = detected
        rows = np.flatnonzero(link)
        if len(rows) == len(batch):
            return _Pass(self.context, batch, out).finish(start)
        columns = _Pass(self.context, part or batch.take(rows), out).finish(start)
        whole = blank_columns(len(batch))
        for name in model.Columns.__struct_fields__:
            whole[name][rows] = getattr(columns, name)
        outside = link == model.OTHER
        whole["findings"][outside] = batch.capture_findings[outside]
        return model.Columns(**whole)

    def learn(self, batch: model.PacketBatch, columns: model.Columns | None = None) -> None:
        """Learn the announcements in a batch that is not decoded here.

        Args:
            columns: columns of the same rows, if another process has decoded them.
        """
        for link in self.context.by_magic:
            among = np.arange(len(batch)) if columns is None else np.flatnonzero(columns.link == link)
            rows = beginning(batch, among, link.magic)
            if len(rows):
                link.locate(batch, rows, self.context)


def blank_columns(count: int, leave_out: Collection[str] = ()) -> dict[str, NDArray[Any]]:
    """Return the columns of datagrams without any layer, by name."""
    return {
        name: np.full(count, _BLANK.get(name, 0), dtype)
        for name, dtype in _TYPES.items()
        if name not in leave_out
    }


class _Pass:
    """Reads the layers of one batch; every array has the batch's length."""

    def __init__(self, context: Context, batch: model.PacketBatch, out: dict[str, NDArray[Any]]) -> None:
        self.context = context
        self.batch = batch
        self.out = out
        self.present: set[int] = set()
        """The links of the batch's datagrams."""

    def begin(self) -> NDArray[np.int32]:
        """Read the outer layers; return the result of ``locate``."""
        link, length = self.out["link"], self.batch.length
        self.present = set(np.flatnonzero(np.bincount(link)).tolist())
        for item in self.context.links:
            if item.receive_buffer and int(item) in self.present:
                over = np.flatnonzero((link == item) & (length > item.receive_buffer))
                if item.to_cfs:  # cFS uses the length in the header: bytes cut behind it are no loss
                    head = arrays.gather(self.batch.data, self.batch.offset[over], ccsds.PRIMARY.size)
                    size = ccsds.PRIMARY.column("packet_data_length", head).astype(np.int32)
                    over = over[size + ccsds.LENGTH_BIAS > item.receive_buffer]
                self.out["findings"][over] |= np.uint32(item.over_receive_buffer)
        return self.locate()

    def finish(self, start: NDArray[np.int32]) -> model.Columns:
        """Read the space packets and their contents."""
        self.space_packet(start)
        cut = (self.batch.capture_findings & np.uint32(model.Finding.CAPTURE_CUT)) != 0
        if np.count_nonzero(cut):
            self.out["findings"][cut] &= np.uint32(~model.UNKNOWABLE & 0xFFFFFFFF)
        return model.Columns(**self.out)

    def flag(self, finding: model.Finding, rows: arrays.Places, mask: arrays.Mask) -> None:
        """Set a finding's bit in those of ``rows`` that a mask selects."""
        if np.count_nonzero(mask):  # a third of the time of ``any``
            self.out["findings"][rows[mask]] |= np.uint32(finding)

    def mark(self, finding: model.Finding, mask: arrays.Mask) -> None:
        """Set a finding's bit in the rows of a mask over the whole batch."""
        if np.count_nonzero(mask):
            self.out["findings"] |= mask * np.uint32(finding)

    def locate(self) -> NDArray[np.int32]:
        """Read the links' own headers; return the start of each space packet, -1 if there is none."""
        start = np.zeros(len(self.batch), np.int32)
        for link in (link for link in self.context.with_headers if int(link) in self.present):
            rows = np.flatnonzero(self.out["link"] == link)
            located = link.locate(self.batch, rows, self.context)
            start[rows] = located.start
            self.out["findings"][rows] |= located.findings
            for name, values in located.columns.items():
                self.out[name][rows] = values
            if link.samples:
                self._samples(link, rows)
        return start

    def _samples(self, link: LinkProtocol, rows: arrays.Places) -> None:
        """Judge whether a link's samples are whole messages of their types."""
        context = self.context
        for item in link.sample_reader().known_samples(context.types, context.endpoints, self.batch, rows):
            self.flag(model.Finding.CDR_INVALID, item.row, ~item.valid)

    def space_packet(self, start: NDArray[np.int32]) -> None:
        """Read the primary header and everything behind it.

        Whole columns are read, for every row; rows without a packet are cleared afterwards.
        """
        length = self.batch.length - start
        packet = (start >= 0) & (length >= ccsds.PRIMARY.size)
        absent = np.flatnonzero(~packet)
        self.flag(model.Finding.TRUNCATED, absent, start[absent] >= 0)
        start[absent], length[absent] = 0, 0
        offset = self.batch.offset + start
        head = arrays.gather(self.batch.data, offset, _PACKET_WINDOW)
        total = ccsds.PRIMARY.column("packet_data_length", head).astype(np.int32) + ccsds.LENGTH_BIAS
        sequence = head[:, 2:4].view(">u2")[:, 0].astype(np.uint16)
        msg_ids = self.context.msg_ids
        msg_id = msg_ids.column(head, length)
        command = msg_ids.is_command(msg_id)
        link = self.out["link"]
        valid = (msg_id > 0) & (msg_id <= cfe.HIGHEST_MSG_ID)
        # Flat, because two indices take twice the time of one.
        against = self.context.against.take(command.view(np.uint8).astype(np.uint16) << 8 | link)
        row = self.context.route_row.take(link).astype(np.int32)
        routed = self.context.route_of.take((row << 16) + msg_id)
        self.mark(model.Finding.LENGTH_MISMATCH, packet & (total != length))
        self.mark(model.Finding.SEQUENCE_UNSET, packet & (sequence == 0))
        self.mark(model.Finding.OVER_SOFTWARE_BUS, packet & (total > SOFTWARE_BUS_MAXIMUM))
        self.mark(model.Finding.INVALID_MSG_ID, packet & ~valid)
        self.mark(model.Finding.UNKNOWN_MSG_ID, packet & valid & ~self.context.known.take(msg_id))
        self.mark(model.Finding.WRONG_DIRECTION, packet & against)
        self.out |= {
            "packet_offset": offset,
            "packet_length": length,
            "msg_id": msg_id,
            "sequence_flags": (sequence >> 14).astype(np.uint8),
            "sequence_count": sequence & np.uint16(0x3FFF),
            "route": routed,
        }
        build = self.context.builds.of_batch(self.batch, offset, length)
        self.out["headers"] = np.full(len(packet), build, np.uint8)
        self._secondary(packet, head, total, command, build)
        for name in _PACKET_COLUMNS if len(absent) else ():
            self.out[name][absent] = _BLANK.get(name, 0)
        if len(self.context.pdu_msg_ids):
            for item in self.context.in_packets:
                self._units(item)
        self._envelopes(packet)
        self._structs()

    def _secondary(
        self,
        packet: arrays.Mask,
        head: arrays.Octets,
        total: NDArray[np.int32],
        command: arrays.Mask,
        build: Any,
    ) -> None:
        """Read the cFE command and telemetry headers, with one build, or the own build of each packet."""
        length = self.out["packet_length"]
        as_command, as_telemetry, start = (column[build] for column in _BYTES)
        at = int(start) if not np.ndim(build) else 0
        if np.ndim(build):
            # Take the bytes behind the extended header, or behind the primary header if there is none.
            plain, extended = cfe.STANDARD.start, cfe.WITH_EXTENDED.start
            head = np.where(
                (start == extended)[:, None], head[:, extended:], head[:, plain : plain - extended]
            )
        bare = ~command & (length == as_command) & (total == length) & (as_command < as_telemetry)
        short = command | bare
        header = np.where(short, as_command, as_telemetry)
        whole = length >= header
        self.mark(model.Finding.HEADER_ONLY, packet & bare)
        self.mark(model.Finding.TRUNCATED, packet & ~whole)
        self.out["header_length"] = np.where(whole, header, np.uint8(ccsds.PRIMARY.size))

        layout = self.context.in_order(cfe.TELEMETRY)
        words = (layout.column(name, head, at).astype(np.int64) for name in ("seconds", "subseconds"))
        self.out["mission_time_ns"] = np.where(whole & ~short, self.context.time.ns(*words), -1)
        code = cfe.COMMAND.column("function_code", head, at).astype(np.int16)
        self.out["function_code"] = np.where(whole & short, code, np.int16(-1))

        rows = np.flatnonzero(packet & whole & command)
        length, total, present = length[rows], total[rows], head[rows, at + 1] != 0
        summed = arrays.xor_bytes(self.batch.data, self.out["packet_offset"][rows], np.minimum(length, total))
        bad = summed != cfe.CHECKSUM_SEED
        self.flag(model.Finding.CHECKSUM_BAD, rows, bad & present)
        self.flag(model.Finding.CHECKSUM_ABSENT, rows, bad & ~present)
        unknown, misfit = self.context.command_table.judge(
            self.out["msg_id"][rows],
            code[rows],
            length - np.broadcast_to(as_command, short.shape)[rows] + cfe.COMMAND_HEADER_BYTES,
        )
        self.flag(model.Finding.UNKNOWN_FUNCTION_CODE, rows, unknown)
        self.flag(model.Finding.COMMAND_LENGTH, rows, misfit)

    def _units(self, link: LinkProtocol) -> None:
        """Judge the protocol units in packets, for one link."""
        rows = np.flatnonzero(link.holds_units(self.out.__getitem__, self.context))
        header = self.out["header_length"][rows]
        offset, length = self.out["packet_offset"][rows] + header, self.out["packet_length"][rows] - header
        for finding, wrong in link.judge_units(self.batch.data, offset, length):
            self.flag(finding, rows, wrong)

    def _structs(self) -> None:
        """Judge whether packets have the length of their C structs."""
        structs = self.context.structs
        samples = payloads(structs, self.out.__getitem__, partial(getattr, self.batch), self.batch.data)
        for _, members, fits in structs.split(samples):
            if not fits.all():  # a command of a wrong length is flagged already
                rows = members.row[~fits]
                flagged = (self.out["findings"][rows] & np.uint32(model.Finding.COMMAND_LENGTH)) != 0
                self.flag(model.Finding.STRUCT_LENGTH, rows, ~flagged)
        if structs.dictionary is not None:
            self.flag(model.Finding.UNKNOWN_MSG_ID, samples.row, samples.key == structs.dictionary.unknown)
            self.flag(model.Finding.LENGTH_MISMATCH, samples.row, samples.key == structs.dictionary.odd)

    def _envelopes(self, packet: arrays.Mask) -> None:
        """Read the envelopes of the routes' packets, one route at a time."""
        exact = self.out["route"]
        route = np.where(exact == model.NO_ROUTE, self.context.any_route_of[self.out["msg_id"]], exact)
        unread = np.uint32(model.Finding.HEADER_ONLY | model.Finding.TRUNCATED)
        rows = np.flatnonzero(packet & (route != model.NO_ROUTE) & ((self.out["findings"] & unread) == 0))
        route = route[rows]
        bare = self.out["packet_length"][rows] == self.out["header_length"][rows]
        if bare.any():
            mismatched = (self.out["findings"][rows] & np.uint32(model.Finding.LENGTH_MISMATCH)) != 0
            quiet = self.out["function_code"][rows] == 0
            self.flag(model.Finding.HEADER_ONLY, rows, bare & ~quiet & ~mismatched)
            self.flag(model.Finding.TRUNCATED, rows, bare & mismatched)
            rows, route = rows[~bare], route[~bare]
        for index, picked in arrays.by_value(route):
            self._envelope(index, rows[picked])

    def _envelope(self, route: int, rows: arrays.Places) -> None:
        envelope = self.context.envelopes[route]
        offset = self.out["packet_offset"][rows] + self.out["header_length"][rows]
        have = self.out["packet_length"][rows] - self.out["header_length"][rows]
        head = arrays.gather(self.batch.data, offset, max(DEFAULT.size, envelope.size if envelope else 0) + 4)
        if envelope is not None:
            self._bodies(route, rows, offset, have, head, envelope)
            return
        rest = np.ones(len(rows), bool)
        for item in ENVELOPE_FORMATS:
            fits = rest & holds(head, have, item)
            self._bodies(route, rows[fits], offset[fits], have[fits], head[fits], item)
            rest &= ~fits
        self._bodies(route, rows[rest], offset[rest], have[rest], head[rest], DEFAULT)

    def _bodies(
        self,
        route: int,
        rows: arrays.Places,
        offset: arrays.Integers,
        have: NDArray[np.int32],
        head: arrays.Octets,
        envelope: EnvelopeFormat,
    ) -> None:
        """Read envelopes of one format, and judge the CDR in them.

        Args:
            route: index of the route, for the type of the CDR.
            rows: rows of the batch, (n,).
            offset: start of each envelope in the batch's data, (n,).
            have: bytes from there to the end of the packet, (n,).
            head: first of these bytes, (n, 20 or more).
        """
        size = envelope.size
        whole = have >= size
        self.flag(model.Finding.TRUNCATED, rows, ~whole)
        claimed = envelope.layout.column("buffer_length", head).astype(np.uint64)
        capacity = capacity_column(envelope, head, claimed)
        space = np.maximum(have - size - envelope.crc, 0).astype(np.uint64)
        over = claimed > space
        self.flag(model.Finding.ENVELOPE_OVERRUN, rows, whole & (over | (capacity < claimed)))
        self.flag(model.Finding.CDR_INVALID, rows, whole & ~over & (claimed < 4))
        read = whole & ~over & (claimed >= 4)
        if not read.all():
            rows, offset, head = rows[read], offset[read], head[read]
            claimed, space = claimed[read], space[read]
        start, offset = offset, offset + size
        length, space = claimed.astype(np.int32), space.astype(np.int32)
        self.out["cdr_offset"][rows] = offset
        self.out["cdr_length"][rows] = length
        plain = (head[:, size] == 0) & (head[:, size + 1] <= 1)
        valid = plain
        types, name = self.context.types, self.context.mission.routes[route].type
        if types is not None and types.has(name):
            trailing = types.trailing(name, self.batch.data, offset, length)
            valid = plain & (trailing >= 0)
            if (more := trailing > ROUNDED).any():
                over = trailing > types.most_trailing(name)
                self.flag(model.Finding.CDR_TRAILING, rows, more & ~over)
                self.flag(model.Finding.CDR_TOO_LONG, rows, over)
        self.flag(model.Finding.CDR_INVALID, rows, ~valid)
        self.flag(model.Finding.CDR_BIG_ENDIAN, rows, plain & (head[:, size + 1] == 0))
        if envelope.crc:
            self.flag(
                model.Finding.CHECKSUM_BAD, rows, ~intact_rows(self.batch.data, start, length, envelope)
            )
        stale = arrays.any_nonzero(self.batch.data, offset + length + envelope.crc, space - length)
        self.flag(model.Finding.STALE_TAIL, rows, stale)


class _Datagram:
    """One datagram as a :class:`~edoras_tools.links.protocol.Seen`."""

    def __init__(self, datagram: model.Datagram, context: Context) -> None:
        self._payload = datagram.payload
        self._have = len(datagram.payload)
        # Bytes that the capture cut off count.
        self.length = self._have + max(datagram.original_length - len(datagram.frame), 0)
        self.destination_port = datagram.destination.port
        self._context = context
        self.to_cfs = context.is_cfs(datagram.destination)
        self.from_cfs = context.is_cfs(datagram.source)

    @property
    def bound(self) -> Any:
        return self._context.structs.on_ports(self.destination_port, self.length)

    def field(self, layout: Layout, name: str, at: int = 0) -> Any:
        """Return a number of a header at byte ``at``; -1 if the payload ends before it."""
        slot = layout.by_name[name]
        return layout.read(slot, self._payload, at) if at + slot.end <= self._have else -1


class _Rows:
    """Some datagrams of a batch as a :class:`~edoras_tools.links.protocol.Seen`; each number is an array."""

    def __init__(self, batch: model.PacketBatch, rows: arrays.Places, context: Context) -> None:
        self._batch, self._rows, self._context = batch, rows, context
        self._fields: dict[tuple[str, str, int], NDArray[Any]] = {}
        self._have = batch.length[rows]
        self.length = self._have + np.maximum(batch.original_length[rows] - batch.frame_length[rows], 0)
        self.destination_port = batch.destination_port[rows]

    @cached_property
    def to_cfs(self) -> arrays.Mask:
        return self._is_cfs(self._batch.destination_address[self._rows])

    @cached_property
    def from_cfs(self) -> arrays.Mask:
        return self._is_cfs(self._batch.source_address[self._rows])

    @property
    def bound(self) -> Any:
        return self._context.structs.on_ports(self.destination_port, self.length)

    def _is_cfs(self, address: NDArray[np.uint32]) -> arrays.Mask:
        matches = np.zeros(len(address), bool)
        for cfs in self._context.cfs_addresses:
            matches |= address == cfs
        matches &= self._batch.ip_version[self._rows] == 4
        return matches

    def field(self, layout: Layout, name: str, at: int = 0) -> Any:
        """Return a number of a header at byte ``at`` of each payload; -1 if the payload ends before it."""
        key = layout.name, name, at
        if key not in self._fields:
            self._fields[key] = self._read(layout, name, at)
        return self._fields[key]

    def _read(self, layout: Layout, name: str, at: int) -> NDArray[Any]:
        slot = layout.by_name[name]
        offset = self._batch.offset[self._rows] + at + slot.start
        absent = self._have < at + slot.end
        if some := absent.any():
            offset[absent] = 0
        window = arrays.gather(self._batch.data, offset, slot.end - slot.start)
        values = layout.column(name, window, -slot.start)
        return np.where(absent, -1, values.astype(np.int64)) if some else values


def link_columns(batch: model.PacketBatch, context: Context) -> arrays.Octets:
    """Return the link of every datagram of a batch, u8 (n,); fragments without a payload have none."""
    claim = context.claim.take(batch.destination_port)
    link = context.decided.take(claim)
    undecided = np.flatnonzero(link == 0)
    for index, members in arrays.by_value(claim[undecided]):
        if context.claimants[index]:
            rows = undecided[members]
            facts, best = _Rows(batch, rows, context), np.zeros(len(rows), np.int8)
            for item in context.claimants[index]:
                sure = np.asarray(item.recognise(facts))
                better = (sure > 0) & (sure >= best)
                link[rows[better]] = item
                best[better] = sure[better]
    if context.frames:
        framed = np.flatnonzero((batch.original_length < 0) & (link == 0))
        link[framed] = context.framed_links[batch.source_port[framed]]
    if context.by_sender.any():
        unlinked = np.flatnonzero(link == 0)
        link[unlinked] = context.by_sender[context.claim[batch.source_port[unlinked]]]
    for item in context.by_magic:
        link[beginning(batch, np.flatnonzero(link == model.OTHER), item.magic)] = item
    if batch.streams is not None:
        _stream_links(batch, context, link)
    link[(batch.capture_findings & model.Finding.FRAGMENT) != 0] = model.OTHER
    if context.frames:
        for item in context.links:
            link[item.claimed(batch, context)] = item
    return link


def beginning(batch: model.PacketBatch, rows: arrays.Places, magic: bytes) -> arrays.Places:
    """Return those of some rows of a batch whose payloads begin with a magic number."""
    rows = rows[batch.length[rows] >= len(magic)]
    rows = rows[batch.data[batch.offset[rows]] == magic[0]]
    if len(rows):
        begins = arrays.gather(batch.data, batch.offset[rows], len(magic))
        return rows[np.all(begins == np.frombuffer(magic, np.uint8), axis=1)]
    return rows


def _stream_links(batch: model.PacketBatch, context: Context, link: arrays.Octets) -> None:
    """Set the link of TCP messages: by the port of either end, then by content if the link needs that."""
    assert batch.streams is not None
    streams = np.flatnonzero(batch.streams)
    claimed = context.stream_links[batch.destination_port[streams]]
    claimed = np.where(claimed == 0, context.stream_links[batch.source_port[streams]], claimed)
    link[streams] = claimed
    for item in context.links:
        if item.transport.tcp and not item.port_decides and len(rows := streams[claimed == item]):
            sure = np.broadcast_to(np.asarray(item.recognise(_Rows(batch, rows, context))), len(rows))
            link[rows[sure == 0]] = model.OTHER


def _stream_link(datagram: model.Datagram, context: Context) -> model.Link:
    """Return the link of one message of a TCP stream: the same answer as ``_stream_links``."""
    claimed = context.stream_links[datagram.destination.port] or context.stream_links[datagram.source.port]
    link = table.link(int(claimed))
    if link is model.OTHER:
        return link
    item = table.protocol(link)
    return link if item.port_decides or item.recognise(_Datagram(datagram, context)) else model.OTHER


def link_of(datagram: model.Datagram, context: Context) -> model.Link:
    """Return the link of one datagram: the same answer as :func:`link_columns`."""
    if model.Finding.FRAGMENT in datagram.findings:
        return model.OTHER
    for item in context.links if context.frames else ():
        if item.claims(datagram, context):
            return item
    if datagram.stream:
        return _stream_link(datagram, context)
    claim = context.claim[datagram.destination.port]
    link, best = table.link(context.decided[claim]), 0
    if link is model.OTHER and context.claimants[claim]:
        facts = _Datagram(datagram, context)
        for item in context.claimants[claim]:
            sure = int(item.recognise(facts))
            if sure and sure >= best:
                link, best = item, sure
    if link is model.OTHER and datagram.original_length < 0:
        link = table.link(context.framed_links[datagram.source.port])
    if link is model.OTHER:
        link = table.link(context.by_sender[context.claim[datagram.source.port]])
    if link is model.OTHER:
        link = next(
            (item for item in context.by_magic if datagram.payload.startswith(item.magic)), model.OTHER
        )
    return link
