"""The table of datagrams of a diagnosis: 160 bytes for each datagram, whatever its size."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import msgspec
import numpy as np

from edoras_tools.cfs.names import MSG_ID_NAMES
from edoras_tools.decode.conversations import Conversations
from edoras_tools.decode.filters.rows import ColumnRows
from edoras_tools.diagnosis.evidence import fingerprint
from edoras_tools.diagnosis.evidence.payloads import Payloads, StateRecorder
from edoras_tools.diagnosis.evidence.port_errors import ErrorRecorder
from edoras_tools.io.frames.linklayer import network_headers
from edoras_tools.io.frames.network import wrong_checksums
from edoras_tools.links.table import among
from edoras_tools.model import NO_ROUTE, OTHER, Columns, Endpoint, Finding, Link, PacketBatch, Peer
from edoras_tools.sessions.sequence import SequenceCounts, SequenceRows
from edoras_tools.wire import cfe
from edoras_tools.wire.arrays import (
    Integers,
    Mask,
    Places,
    Prints,
    distinct,
    gather,
    groups,
    numbered,
    of_bytes,
)
from edoras_tools.wire.ccsds import VERSION_1
from edoras_tools.wire.envelope import DEFAULT, capacity_column

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray
    from typing_extensions import Self

    from edoras_tools.decode import Context

SCATTERED: Final = 20
"""A capture is out of order if at least one record in this many has an earlier time than the one before."""
_SAMPLES: Final = 4
_ENCAPSULATION: Final = 4
_KEPT: Final = 54
"""Least bytes of a datagram that a capture keeps if it cuts Ethernet frames at 96."""
_HEAD: Final = 7
"""First bytes of a message's body that are then here on each link: what is on some alone shows too little."""


class Rows(msgspec.Struct, frozen=True):
    """Columns (rows,) with one element for each datagram, in order of capture.

    ``source`` and ``destination`` index ``Recorder.endpoints``. Columns that are not described here are as in
    ``PacketBatch`` and ``Columns``.

    Attributes:
        number: i64, place of the datagram in its source, from 1.
        time_ns: i64, capture time.
        length: i32, bytes of the UDP payload.
        known_id: i32, MsgId in message version 1, in which cFS facts are written.
        space: i32, bytes of a packet behind its envelope, including padding; 0 without an envelope.
        claimed: i32, bytes of CDR that an envelope claims, if its packet is too short for them; else 0. It is
            negative if nothing but a mission says that an envelope is there.
        identification: u16, identification of the IPv4 packet; 0 for IPv6.
        tap: u64, fingerprint of the frame in front of the IP header, plus the time to live: it differs
            between two places of capture.
        life: u8, time to live, or hop limit.
        streamed: bool, the packet came over TCP.
        undelivered: bool, its receiver did not get it because of a wrong checksum. After preparation: it did
            not reach the next capture on its path.
        bytes_print: u64, fingerprint of the whole datagram.
        counted: bool, the packet has a sequence count, and its sender counts.
        missing: i32, sequence counts missing directly in front of the packet. This and the next three are as
            in ``SequenceRows``, and 0 if the packet is not counted.
        duplicates: i32, 1 if the packet repeats another one.
        reordered: i32, 1 if the packet came after a later one; below 0 to correct an earlier row.
        restarts: i32, 1 if the count restarted here; below 0 to correct an earlier row.
        packet_print: u64, fingerprint of the whole space packet.
        body_print: u64, fingerprint of the message's bytes behind its encapsulation.
        head_print: u64, fingerprint of the first of them; 0 if nothing near was cut by the capture.
        value_print: u64, fingerprint of the message's values without time stamps.
        stamped_print: u64, fingerprint of the message's values with time stamps.
        shared_print: u64, fingerprint of the values that a command and a robot's struct share; 0 for none.
    """

    number: Integers
    time_ns: Integers
    link: NDArray[np.uint8]
    source: NDArray[np.int32]
    destination: NDArray[np.int32]
    sbn_msg_type: NDArray[np.int16]
    processor_id: NDArray[np.uint32]
    spacecraft_id: NDArray[np.uint32]
    msg_id: NDArray[np.int32]
    known_id: NDArray[np.int32]
    sequence_count: NDArray[np.uint16]
    function_code: NDArray[np.int16]
    mission_time_ns: Integers
    length: NDArray[np.int32]
    packet_length: NDArray[np.int32]
    header_length: NDArray[np.uint8]
    cdr_length: NDArray[np.int32]
    space: NDArray[np.int32]
    claimed: NDArray[np.int32]
    route: NDArray[np.int16]
    findings: NDArray[np.uint32]
    identification: NDArray[np.uint16]
    tap: Prints
    life: NDArray[np.uint8]
    streamed: Mask
    undelivered: Mask
    bytes_print: Prints
    counted: Mask
    missing: NDArray[np.int32]
    duplicates: NDArray[np.int32]
    reordered: NDArray[np.int32]
    restarts: NDArray[np.int32]
    packet_print: Prints
    body_print: Prints
    head_print: Prints
    value_print: Prints
    stamped_print: Prints
    shared_print: Prints

    def __len__(self) -> int:
        return len(self.time_ns)

    @classmethod
    def of(cls, tables: Sequence[Any], **columns: NDArray[Any]) -> Self:
        """Return rows with the named columns; the others come from the last of ``tables`` that has them."""
        rest = [name for name in cls.__struct_fields__ if name not in columns]
        own = {name: getattr(table, name) for name in rest for table in tables if hasattr(table, name)}
        return cls(**own, **columns)

    @classmethod
    def of_messages(cls, **columns: NDArray[Any]) -> Self:
        """Return rows of messages without packets: other columns are 0, and no sequence count is valid."""
        count, empty = len(columns["time_ns"]), _none()
        values = {"findings": np.full(count, Finding.SEQUENCE_UNSET, np.uint32), **columns}
        kinds = {name: getattr(empty, name).dtype for name in cls.__struct_fields__}
        return cls(**{name: values.get(name, np.zeros(count, kind)) for name, kind in kinds.items()})

    def take(self, rows: NDArray[Any] | slice) -> Self:
        """Return the rows that an index array, a mask or a slice selects."""
        return type(self)(**{name: getattr(self, name)[rows] for name in self.__struct_fields__})

    def way(self, rows: NDArray[Any] | slice = slice(None)) -> Integers:
        """Return the direction of some rows, i64: source << 32 | destination."""
        return self.source[rows].astype(np.int64) << 32 | self.destination[rows]

    def on(self, accepts: Callable[[Link], bool], rows: NDArray[Any] | slice = slice(None)) -> Mask:
        """Return which rows are on links that a test accepts, bool: ``rows.on(lambda link: link.to_cfs)``."""
        return among(self.link[rows], accepts)

    @property
    def timed(self) -> Mask:
        """The packets from cFS that have a mission time: bool (rows,)."""
        return (self.mission_time_ns > 0) & self.on(lambda link: link.from_cfs and link.packets)

    def delay_ns(self, rows: NDArray[Any] | slice = slice(None)) -> Integers:
        """Return the capture time minus the mission time of some rows: i64, ns."""
        return np.asarray(self.time_ns[rows] - self.mission_time_ns[rows])

    def sbn_sender(self, rows: NDArray[Any] | slice = slice(None)) -> Prints:
        """Return the SBN identity of the sender of some rows, u64; ``peer_of`` converts one to a peer."""
        return self.spacecraft_id[rows].astype(np.uint64) << np.uint64(32) | self.processor_id[rows]

    def usual_sender(self, rows: Places) -> tuple[str, int]:
        """Return the SBN identity that most of some rows have, as ``66:1``, and the number of these rows."""
        values, counts = np.unique(self.sbn_sender(rows), return_counts=True)
        return str(peer_of(int(values[counts.argmax()]))), int(counts.max())

    def has(self, finding: Finding, rows: NDArray[Any] | slice = slice(None)) -> Mask:
        """Return which of some rows have at least one of these findings: bool."""
        return np.asarray((self.findings[rows] & np.uint32(finding)) != 0)


def peer_of(number: int) -> Peer:
    """Return the peer of a number from ``Rows.sbn_sender``."""
    return Peer(number >> 32, number & 0xFFFFFFFF)


def number_hosts(endpoints: Sequence[Endpoint]) -> NDArray[np.int32]:
    """Return the number of the address of each endpoint, i32 (endpoints,), in order of first appearance."""
    numbers: dict[str, int] = {}
    return np.array([numbers.setdefault(item.address, len(numbers)) for item in endpoints], np.int32)


PRINTS: Final = tuple(name for name in Rows.__struct_fields__ if name.endswith("_print"))
"""Columns with fingerprints; the first one is of whole datagrams, the others of packets and messages."""


class Recorder:
    """Records the columns and payloads of batches that a diagnosis needs.

    Args:
        context: mission, types and options.
        conversations: conversations of an earlier recorder, which this one continues.
        apart: function that keeps the datagrams with a packet instead of ``keep``; this recorder still counts
            them.

    Attributes:
        conversations: all datagrams of any port, by source and destination.
        endpoints: endpoints, in order of first appearance.
        payloads: counters, events and commands.
        errors: recorder of ICMP errors.
        states: recorder of robot states, and of the telemetry that carries them.
        samples: (link, MsgId) to length and bytes of a few CDR messages of different lengths.
        left_out: number of datagrams that belong to no link.
        ends: whether ``rows`` is called only once, and nothing is added after it: then memory is freed.
    """

    def __init__(
        self,
        context: Context,
        conversations: Conversations | None = None,
        apart: Callable[[PacketBatch, Columns], None] | None = None,
    ) -> None:
        self.context = context
        self._apart = apart
        self.conversations = conversations or Conversations(context)
        self.endpoints: list[Endpoint] = []
        self.payloads = Payloads()
        self.errors = ErrorRecorder(self._ends)
        self.states = StateRecorder()
        self.samples: dict[tuple[int, int], dict[int, bytes]] = {}
        self._index: dict[tuple[int, str, int], int] = {}
        self._shared = fingerprint.SharedFields(context)
        self._times: list[Integers] = []
        self._parts: list[Rows] = []
        self._sequences = SequenceCounts()
        self._told: list[SequenceRows] = []
        self._count = self._kept = 0
        self.left_out = 0
        self.ends = False

    def __len__(self) -> int:
        return self._count

    @property
    def last_ns(self) -> int:
        """Capture time of the last datagram with a packet, ns; 0 without any."""
        return int(self._times[-1][-1]) if self._times else 0

    @property
    def scattered(self) -> bool:
        """Whether records are so out of order that no part of the capture can be examined alone."""
        times = np.concatenate(self._times)
        first, last = times[: len(times) // 4], times[-len(times) // 4 :]
        back = int((np.diff(times) < 0).sum())
        return bool(back * SCATTERED > len(times) and len(first) and last.min() < first.max())

    def add(self, batch: PacketBatch, columns: Columns) -> None:
        """Record a batch; datagrams without a packet are left out, except commands to a robot."""
        columns = fingerprint.with_garbled(columns, batch)
        self.conversations.add(batch, columns)
        commands = fingerprint.robot_commands(columns, batch, self.context.structs)
        own = np.flatnonzero(among(columns.link, lambda link: link.packets) | commands)
        beside = among(columns.link, lambda link: link.quotes)
        self.left_out += len(batch) - len(own) - int(beside.sum())
        beside |= among(columns.link, lambda link: link.last_hop) & ~commands
        beside |= self.errors.about(batch, columns)
        for rows in (np.flatnonzero(beside), own):  # states before the telemetry that carries them
            if len(rows):
                whole = len(rows) == len(batch)
                part = (batch, columns) if whole else (batch.take(rows), columns.take(rows))
                (self._apart or self.keep)(*part)
        if len(own):
            self._count += len(own)
            self._times.append(batch.time_ns[own])

    def keep(self, batch: PacketBatch, columns: Columns) -> None:
        """Record the columns and payloads of a batch.

        Either all of its datagrams hold a packet or a command, or all are errors or other datagrams.
        """
        beside = among(columns.link, lambda link: link.quotes or link.last_hop) | (columns.link == OTHER)
        if beside.all() and not fingerprint.robot_commands(columns, batch, self.context.structs).any():
            self.errors.add(batch, columns)
            self.states.add_states(batch)
            return
        self.payloads.add(batch, columns, self._kept)
        if self.context.structs.limited:
            self.payloads.add_limits(ColumnRows(self.context, 0, batch, columns), self._kept)
        offset, length, space, claimed, start = self._messages(batch, columns)
        self.states.add_messages(batch, columns, offset, length)
        body, plain, stamped = self._fingerprints(batch, columns, offset, length)
        head = np.zeros(len(batch), np.uint64)
        if (start != offset).any():  # those that were cut are compared with whole ones, too
            own = np.flatnonzero(start >= 0)
            head[own] = of_bytes(batch.data, start[own] + _ENCAPSULATION, np.full(len(own), _HEAD, np.int32))
        whole = of_bytes(batch.data, batch.offset, batch.length)
        # Most datagrams are a packet and nothing else.
        packet, at, size = whole.copy(), columns.packet_offset, columns.packet_length
        rest = np.flatnonzero((at != batch.offset) | (size != batch.length))
        packet[rest] = of_bytes(batch.data, np.maximum(at[rest], 0), size[rest])
        network, identification, life = network_headers(batch)
        if batch.streams is not None:
            # Messages of one TCP segment share its identification: number them, as no message comes twice.
            identification = np.where(batch.streams, np.arange(len(batch)) % 0xFFFF + 1, identification)
            identification = identification.astype(np.uint16)
        tap = fingerprint.of_tap(batch, network, slice(None))
        source, destination = self._ends(batch)
        sequences = self._sequences.follow(batch, columns)
        self._told.append(sequences)
        in_fragments = np.where(batch.length > batch.frame_length, np.uint32(Finding.FRAGMENT), np.uint32(0))
        self._parts.append(
            Rows.of(
                (batch, columns, sequences),
                findings=columns.findings | in_fragments,
                source=source,
                destination=destination,
                known_id=cfe.known_ids(columns.msg_id, columns.headers),
                cdr_length=length,
                space=space,
                claimed=claimed,
                identification=identification,
                tap=tap + life,
                life=life,
                streamed=np.zeros(len(batch), bool) if batch.streams is None else batch.streams,
                undelivered=wrong_checksums(batch, network) > 0,
                bytes_print=whole,
                counted=sequences.stream >= 0,
                packet_print=packet,
                body_print=body,
                head_print=head,
                value_print=plain,
                stamped_print=stamped,
                shared_print=self._shared.fingerprints(batch, columns, offset, length),
            )
        )
        self._sample(batch, columns, offset, length)
        self._kept += len(batch)

    def rows(self) -> Rows:
        """Return all rows so far; only once if ``ends``."""
        if not self._parts:
            return _none()
        if len(self._parts) > 1:
            parts = {name: [getattr(part, name) for part in self._parts] for name in Rows.__struct_fields__}
            self._parts.clear()  # so that memory holds only one column twice
            self._parts.append(Rows(**{name: np.concatenate(parts.pop(name)) for name in list(parts)}))
        whole = self._parts[0], self._sequences.whole(self._told)
        if self.ends:
            self._parts, self._told = [], []
        return _counting(*whole)

    def _ends(self, batch: PacketBatch) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """Return the endpoint numbers of source and destination of each datagram: i32 (n,) each."""
        source = self._endpoints(batch, batch.source_address, batch.source_port)
        return source, self._endpoints(batch, batch.destination_address, batch.destination_port)

    def _endpoints(
        self, batch: PacketBatch, address: NDArray[np.uint32], port: NDArray[np.uint16]
    ) -> NDArray[np.int32]:
        """Return the endpoint number of each address and port, i32 (n,); new endpoints are added."""
        key = address.astype(np.uint64) << 24 | port.astype(np.uint64) << 8 | batch.ip_version
        first, which = numbered(key)
        numbers = np.zeros(len(first), np.int32)
        for place, row in enumerate(first.tolist()):
            text, at = batch.address(int(address[row]), row), int(port[row])
            index = self._index.setdefault((int(batch.ip_version[row]), text, at), len(self.endpoints))
            if index == len(self.endpoints):
                self.endpoints.append(Endpoint(text, at))
            numbers[place] = index
        return numbers[which]

    def _messages(
        self, batch: PacketBatch, columns: Columns
    ) -> tuple[Integers, NDArray[np.int32], NDArray[np.int32], NDArray[np.int32], Integers]:
        """Find the CDR messages: as decoded, and behind envelopes without a configured route.

        Returns:
            offset (i64) and length (i32) of each CDR, and the columns ``space`` and ``claimed`` of ``Rows``;
            the offset is negative if there is no message. Last the offset also of messages that were cut.
        """
        offset, length = columns.cdr_offset.copy(), columns.cdr_length.copy()
        payload = columns.packet_offset + columns.header_length
        end = columns.packet_offset + columns.packet_length
        space = np.where(offset >= 0, (end - offset), 0).astype(np.int32)
        vain, heads = np.zeros(len(batch), np.int32), np.full(len(batch), -1)
        ids = cfe.known_ids(columns.msg_id, columns.headers)
        open_ = (offset < 0) & (columns.packet_offset >= 0) & ~np.isin(ids, list(MSG_ID_NAMES))
        which = np.where(columns.route == NO_ROUTE, -1 - VERSION_1.is_command(ids), columns.route)
        for number, some in groups(which, np.flatnonzero(open_)):
            envelope = (*self.context.envelopes, *reversed(self.context.unrouted))[number] or DEFAULT
            behind = (end - payload - envelope.size).astype(np.int32)
            rows = some[behind[some] >= _ENCAPSULATION]
            head = gather(batch.data, payload[rows], envelope.size + _ENCAPSULATION)
            claimed = envelope.layout.column("buffer_length", head).astype(np.uint64)
            capacity = capacity_column(envelope, head, claimed)
            start = head[:, envelope.size :]
            shaped = (start[:, 0] == 0) & (start[:, 1] <= 1) & (start[:, 2] == 0) & (start[:, 3] == 0)
            shaped &= (claimed >= _ENCAPSULATION) & (claimed < 1 << 31) & (claimed <= capacity)
            routed = (columns.findings[rows] & np.uint32(Finding.ENVELOPE_OVERRUN)) != 0
            over = claimed > behind[rows].astype(np.uint64)
            is_cut = (columns.findings[rows] & np.uint32(Finding.CAPTURE_CUT)) != 0
            starts = rows[is_cut & over & shaped & (batch.length[rows] >= _KEPT)]
            heads[starts] = payload[starts] + envelope.size
            valid = ((over & shaped) | routed) & ~is_cut
            sign = np.where(shaped[valid], 1, -1)
            vain[rows[valid]] = sign * np.minimum(claimed[valid], (1 << 31) - 1).astype(np.int32)
            fits = shaped & ~over & (columns.route[rows] == NO_ROUTE)
            offset[rows[fits]] = payload[rows[fits]] + envelope.size
            length[rows[fits]] = claimed[fits].astype(np.int32)
            space[rows[valid | fits]] = behind[rows[valid | fits]]
        return offset, length, space, vain, np.maximum(offset, heads)

    def _fingerprints(
        self, batch: PacketBatch, columns: Columns, offset: Integers, length: NDArray[np.int32]
    ) -> tuple[Prints, Prints, Prints]:
        """Return three fingerprints of each message, u64 (n,): bytes, values, values with time stamps."""
        body = np.zeros(len(batch), np.uint64)
        types, routes = self.context.types, self.context.mission.routes
        own = np.flatnonzero(offset >= 0)
        body[own] = of_bytes(batch.data, offset[own] + _ENCAPSULATION, length[own] - _ENCAPSULATION)
        plain, stamped = body.copy(), body.copy()
        for index in distinct(columns.route[own]).tolist():
            name = routes[index].type if index != NO_ROUTE else ""
            if name and types is not None and types.has(name):
                rows = own[columns.route[own] == index]
                plain[rows], stamped[rows] = fingerprint.of_values(
                    types, name, batch.data, offset[rows], length[rows]
                )
        robot = np.flatnonzero(among(columns.link, lambda item: item.last_hop))
        if len(robot):
            body[robot], stamped[robot] = fingerprint.robot_prints(batch, robot, types)
            plain[robot] = body[robot]
        return body, plain, stamped

    def _sample(
        self, batch: PacketBatch, columns: Columns, offset: Integers, length: NDArray[np.int32]
    ) -> None:
        rows = np.flatnonzero(offset >= 0)
        first, _ = numbered(columns.link[rows], columns.msg_id[rows], length[rows])
        for row in rows[first].tolist():
            sizes = self.samples.setdefault((int(columns.link[row]), int(columns.msg_id[row])), {})
            size = int(length[row])
            if len(sizes) < _SAMPLES and size not in sizes:
                sizes[size] = batch.data[offset[row] : offset[row] + size].tobytes()


def followed(rows: Rows) -> Rows:
    """Return the rows with their sequence counts followed again, in the present order of the rows.

    The bytes are gone, so the batch to follow has fingerprints as packets and numbers as addresses.
    """
    absent, size = np.zeros(len(rows), np.uint16), rows.packet_print.itemsize

    def make(kind: type[Any], **more: Any) -> Any:
        return kind(**{name: getattr(rows, name, absent) for name in kind.__struct_fields__} | more)

    batch = make(
        PacketBatch,
        data=rows.packet_print.view(np.uint8),
        source_address=rows.source,
        destination_address=rows.destination,
        ipv6=(),
    )
    columns = make(Columns, packet_offset=np.arange(len(rows)) * size, packet_length=np.full(len(rows), size))
    sequences = SequenceCounts()
    return _counting(rows, sequences.whole([sequences.follow(batch, columns)]))


def _counting(rows: Rows, sequences: SequenceRows) -> Rows:
    """Return the rows with the columns of ``SequenceRows``."""
    return Rows.of((rows, sequences), counted=sequences.stream >= 0)


def _none() -> Rows:
    kinds = {"link": "u1", "header_length": "u1", "sequence_count": "u2", "findings": "u4"}
    kinds |= dict.fromkeys(("processor_id", "spacecraft_id"), "u4")
    kinds |= {"identification": "u2", "life": "u1", "counted": "?", "streamed": "?", "undelivered": "?"}
    kinds |= dict.fromkeys(("tap", *PRINTS), "u8")
    return Rows(**{name: np.zeros(0, kinds.get(name, "i8")) for name in Rows.__struct_fields__})
