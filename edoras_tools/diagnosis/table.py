"""All that a diagnosis keeps of each datagram: 90 bytes in columns, whatever the datagram's size."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, Final, Self

import numpy as np

from edoras_tools.diagnosis import fingerprint
from edoras_tools.diagnosis.payloads import Payloads
from edoras_tools.model import NO_ROUTE, Endpoint, Finding, Link
from edoras_tools.wire.envelope import DEFAULT
from edoras_tools.wire.names import MSG_ID_NAMES
from edoras_tools.wire.window import gather

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.decode import Context
    from edoras_tools.model import Columns, PacketBatch

_SAMPLES: Final = 4
_ENCAPSULATION: Final = 4


@dataclass(frozen=True, slots=True)
class Rows:
    """Columns of one length, one element a datagram, in order of capture.

    ``source`` and ``destination`` index ``Recorder.endpoints``. The rest is as in ``PacketBatch`` and
    ``Columns``, and:

    Attributes:
        number: i64, place in the source, from 1.
        time_ns: i64, capture time.
        length: i32, bytes of the UDP payload.
        space: i32, bytes of a packet behind the envelope, padding included; 0 where there is no envelope.
        claimed: i32, bytes of CDR that an envelope claims and its packet does not hold; 0 elsewhere.
        packet_print: u64, fingerprint of the whole space packet.
        value_print: u64, fingerprint of the message's values but its time stamps.
        stamped_print: u64, fingerprint of the message's values.
    """

    number: NDArray[np.int64]
    time_ns: NDArray[np.int64]
    link: NDArray[np.uint8]
    source: NDArray[np.int32]
    destination: NDArray[np.int32]
    sbn_msg_type: NDArray[np.int16]
    processor_id: NDArray[np.uint32]
    spacecraft_id: NDArray[np.uint32]
    msg_id: NDArray[np.int32]
    sequence_count: NDArray[np.uint16]
    function_code: NDArray[np.int16]
    mission_time_ns: NDArray[np.int64]
    length: NDArray[np.int32]
    packet_length: NDArray[np.int32]
    header_length: NDArray[np.uint8]
    cdr_length: NDArray[np.int32]
    space: NDArray[np.int32]
    claimed: NDArray[np.int32]
    route: NDArray[np.int16]
    findings: NDArray[np.uint32]
    packet_print: NDArray[np.uint64]
    value_print: NDArray[np.uint64]
    stamped_print: NDArray[np.uint64]

    def __len__(self) -> int:
        return len(self.time_ns)

    def take(self, rows: NDArray[Any] | slice) -> Self:
        """Return the rows that an index array, a mask or a slice chooses."""
        return type(self)(**{item.name: getattr(self, item.name)[rows] for item in fields(self)})

    def has(self, finding: Finding) -> NDArray[np.bool_]:
        """Tell which rows have one of these findings."""
        return np.asarray((self.findings & np.uint32(finding)) != 0)


class Recorder:
    """Takes batches and keeps what a diagnosis needs of them.

    Attributes:
        endpoints: the addresses and ports seen, in the order first seen.
        payloads: counters, events and the like.
        samples: (link, MsgId) to a few CDR messages, shortest and longest among them.
    """

    def __init__(self, context: Context) -> None:
        self.context = context
        self.endpoints: list[Endpoint] = []
        self.payloads = Payloads()
        self.samples: dict[tuple[int, int], dict[int, bytes]] = {}
        self._index: dict[tuple[int, str, int], int] = {}
        self._parts: list[Rows] = []
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def add(self, batch: PacketBatch, columns: Columns) -> None:
        """Take a batch; datagrams that belong to no link are left out."""
        chosen = np.flatnonzero(columns.link != Link.OTHER)
        if not len(chosen):
            return
        if len(chosen) < len(batch):
            batch, columns = batch.take(chosen), columns.take(chosen)
        self.payloads.add(batch, columns, self._count)
        offset, length, space, claimed = self._messages(batch, columns)
        plain, stamped = self._fingerprints(batch, columns, offset, length)
        there = columns.packet_offset >= 0
        self._parts.append(
            Rows(
                number=batch.number,
                time_ns=batch.time_ns,
                link=columns.link,
                source=self._endpoints(batch, batch.source_address, batch.source_port),
                destination=self._endpoints(batch, batch.destination_address, batch.destination_port),
                sbn_msg_type=columns.sbn_msg_type,
                processor_id=columns.processor_id,
                spacecraft_id=columns.spacecraft_id,
                msg_id=columns.msg_id,
                sequence_count=columns.sequence_count,
                function_code=columns.function_code,
                mission_time_ns=columns.mission_time_ns,
                length=batch.length,
                packet_length=columns.packet_length,
                header_length=columns.header_length,
                cdr_length=length,
                space=space,
                claimed=claimed,
                route=columns.route,
                findings=columns.findings,
                packet_print=fingerprint.of_bytes(
                    batch.data, np.where(there, columns.packet_offset, 0), columns.packet_length
                ),
                value_print=plain,
                stamped_print=stamped,
            )
        )
        self._sample(batch, columns, offset, length)
        self._count += len(batch)

    def rows(self) -> Rows:
        """Return all rows so far."""
        if not self._parts:
            return _none()
        if len(self._parts) > 1:
            self._parts = [
                Rows(
                    **{
                        item.name: np.concatenate([getattr(part, item.name) for part in self._parts])
                        for item in fields(Rows)
                    }
                )
            ]
        return self._parts[0]

    def _endpoints(
        self, batch: PacketBatch, address: NDArray[np.uint32], port: NDArray[np.uint16]
    ) -> NDArray[np.int32]:
        """Number the endpoints of a batch; few are new."""
        key = address.astype(np.uint64) << 24 | port.astype(np.uint64) << 8 | batch.ip_version
        distinct, first, which = np.unique(key, return_index=True, return_inverse=True)
        numbers = np.zeros(len(distinct), np.int32)
        for place, row in enumerate(first.tolist()):
            text, at = batch.address(int(address[row]), row), int(port[row])
            index = self._index.setdefault((int(batch.ip_version[row]), text, at), len(self.endpoints))
            if index == len(self.endpoints):
                self.endpoints.append(Endpoint(text, at))
            numbers[place] = index
        return numbers[which].astype(np.int32)

    def _messages(
        self, batch: PacketBatch, columns: Columns
    ) -> tuple[NDArray[np.int64], NDArray[np.int32], NDArray[np.int32], NDArray[np.int32]]:
        """Find where messages lie: as decoded, and behind an envelope that no configured route explains.

        Returns:
            offset and length of each CDR, the space behind its envelope, and what an envelope claims in vain.
        """
        offset, length = columns.cdr_offset.copy(), columns.cdr_length.copy()
        payload = columns.packet_offset + columns.header_length
        end = columns.packet_offset + columns.packet_length
        behind = (end - payload - DEFAULT.size).astype(np.int32)
        space = np.where(offset >= 0, (end - offset), 0).astype(np.int32)
        vain = np.zeros(len(batch), np.int32)
        open_ = (offset < 0) & (columns.packet_offset >= 0) & ~np.isin(columns.msg_id, list(MSG_ID_NAMES))
        rows = np.flatnonzero(open_ & (behind >= _ENCAPSULATION))
        if len(rows):
            head = gather(batch.data, payload[rows], DEFAULT.size + _ENCAPSULATION)
            claimed = DEFAULT.layout.column("buffer_length", head)
            capacity = DEFAULT.layout.column("buffer_capacity", head)
            start = head[:, DEFAULT.size :]
            shaped = (start[:, 0] == 0) & (start[:, 1] <= 1) & (start[:, 2] == 0) & (start[:, 3] == 0)
            shaped &= (claimed >= _ENCAPSULATION) & (claimed < 1 << 31)
            # A route's envelope is one whatever it looks like; elsewhere its shape has to tell.
            routed = (columns.findings[rows] & np.uint32(Finding.ENVELOPE_OVERRUN)) != 0
            over = claimed > behind[rows].astype(np.uint64)
            told = (over & shaped & (claimed <= capacity)) | routed
            space[rows[told]] = behind[rows[told]]
            vain[rows[told]] = np.minimum(claimed[told], (1 << 31) - 1).astype(np.int32)
            fits = shaped & ~over & (claimed <= capacity) & (columns.route[rows] == NO_ROUTE)
            offset[rows[fits]] = payload[rows[fits]] + DEFAULT.size
            length[rows[fits]] = claimed[fits].astype(np.int32)
            space[rows[fits]] = behind[rows[fits]]
        return offset, length, space, vain

    def _fingerprints(
        self,
        batch: PacketBatch,
        columns: Columns,
        offset: NDArray[np.int64],
        length: NDArray[np.int32],
    ) -> tuple[NDArray[np.uint64], NDArray[np.uint64]]:
        plain, stamped = (np.zeros(len(batch), np.uint64) for _ in range(2))
        types, routes = self.context.types, self.context.mission.routes
        there = offset >= 0
        for index in np.unique(columns.route[there]).tolist():
            rows = np.flatnonzero(there & (columns.route == index))
            name = routes[index].type if index != NO_ROUTE else ""
            if name and types is not None and types.has(name):
                plain[rows], stamped[rows] = fingerprint.of_values(
                    types, name, batch.data, offset[rows], length[rows]
                )
            else:
                body = fingerprint.of_bytes(
                    batch.data, offset[rows] + _ENCAPSULATION, length[rows] - _ENCAPSULATION
                )
                plain[rows] = stamped[rows] = body
        return plain, stamped

    def _sample(
        self, batch: PacketBatch, columns: Columns, offset: NDArray[np.int64], length: NDArray[np.int32]
    ) -> None:
        rows = np.flatnonzero(offset >= 0)
        key = columns.link[rows].astype(np.int64) << 48 | columns.msg_id[rows].astype(np.int64) << 32
        _, first = np.unique(key | length[rows], return_index=True)
        for row in rows[first].tolist():
            known = self.samples.setdefault((int(columns.link[row]), int(columns.msg_id[row])), {})
            size = int(length[row])
            if len(known) < _SAMPLES and size not in known:
                known[size] = batch.data[offset[row] : offset[row] + size].tobytes()


def _none() -> Rows:
    kinds = {"link": "u1", "header_length": "u1", "sequence_count": "u2", "findings": "u4"}
    kinds |= dict.fromkeys(("processor_id", "spacecraft_id"), "u4")
    kinds |= dict.fromkeys(("packet_print", "value_print", "stamped_print"), "u8")
    return Rows(**{item.name: np.zeros(0, kinds.get(item.name, "i8")) for item in fields(Rows)})
