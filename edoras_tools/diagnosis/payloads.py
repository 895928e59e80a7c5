"""The few packets that are read one by one: counters, events, subscriptions, commands to TO."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.errors import TruncatedError
from edoras_tools.model import Link
from edoras_tools.sessions import command_ingest, telemetry_output
from edoras_tools.wire import cfe, sbn

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.model import Columns, PacketBatch

_MOST: Final = 200_000
"""Of each kind; a link that sends more than this says nothing new with the rest."""
_CI_COUNTERS_AT: Final = 12


@dataclass(frozen=True, slots=True)
class Housekeeping:
    """One 0x803: what the software bus counted.

    Attributes:
        row: of the table.
        time_ns: capture time.
        pipe_overflows: 16 bits, wraps.
        msg_limits: 16 bits, wraps.
        no_subscribers: 8 bits, wraps.
        send_errors: 8 bits, wraps.
    """

    row: int
    time_ns: int
    pipe_overflows: int
    msg_limits: int
    no_subscribers: int
    send_errors: int


@dataclass(frozen=True, slots=True)
class IngestCount:
    """One 0x884: what Command Ingest counted."""

    row: int
    time_ns: int
    packets: int
    errors: int


@dataclass(frozen=True, slots=True)
class EventRecord:
    """One 0x808: what an application said.

    Attributes:
        row: of the table.
        number: place of the datagram in its source.
        time_ns: capture time.
        app: who said it.
        event_id: its number for it.
        event_type: 3 and 4 are errors.
        sender: spacecraft and processor, as ``66:1``.
        message: the text.
    """

    row: int
    number: int
    time_ns: int
    app: str
    event_id: int
    event_type: int
    sender: str
    message: str

    def __str__(self) -> str:
        return f"{self.app} {self.event_id}: {self.message}"


@dataclass(frozen=True, slots=True)
class Subscriptions:
    """One SUB or UNSUB.

    Attributes:
        row: of the table.
        wanted: MsgIds; empty where it could not be read.
        ident: the $Id it carries.
    """

    row: int
    wanted: tuple[int, ...]
    ident: str


@dataclass(frozen=True, slots=True)
class OutputCommand:
    """One command to Telemetry Output.

    Attributes:
        row: of the table.
        function_code: 6 enables, 4 removes a packet, 2 adds one.
        address: of an enable, as text.
        msg_id: of an add or remove; -1 else.
    """

    row: int
    function_code: int
    address: str = ""
    msg_id: int = -1


@dataclass(slots=True)
class Payloads:
    """All of them, in order of capture."""

    housekeeping: list[Housekeeping] = field(default_factory=list)
    ingest: list[IngestCount] = field(default_factory=list)
    events: list[EventRecord] = field(default_factory=list)
    subscriptions: list[Subscriptions] = field(default_factory=list)
    output: list[OutputCommand] = field(default_factory=list)

    def add(self, batch: PacketBatch, columns: Columns, base: int) -> None:
        """Read what a batch holds.

        Args:
            batch: the datagrams.
            columns: of the same rows.
            base: row of the table that the batch's first datagram has.
        """
        downward = (columns.link == Link.TO) | (columns.link == Link.SBN)
        for msg_id, read in (
            (cfe.SOFTWARE_BUS_HOUSEKEEPING_MSG_ID, self._housekeeping),
            (command_ingest.HOUSEKEEPING_MSG_ID, self._ingest),
            (cfe.EVENT_MSG_ID, self._event),
        ):
            for row in np.flatnonzero(downward & (columns.msg_id == msg_id)).tolist():
                read(batch, row, base, _payload(batch, columns, row))
        listed = (columns.sbn_msg_type == sbn.MsgType.SUB) | (columns.sbn_msg_type == sbn.MsgType.UNSUB)
        for row in np.flatnonzero(listed).tolist():
            self._subscriptions(batch, row, base)
        output = (columns.msg_id == telemetry_output.COMMAND_MSG_ID) & (columns.function_code >= 0)
        for row in np.flatnonzero(output & (columns.link != Link.TO)).tolist():
            self._output(int(columns.function_code[row]), row, base, _payload(batch, columns, row))

    def timed(self, time_ns: NDArray[np.int64]) -> Payloads:
        """Return them with other capture times, one a row of the table."""
        return replace(
            self,
            housekeeping=[replace(item, time_ns=int(time_ns[item.row])) for item in self.housekeeping],
            ingest=[replace(item, time_ns=int(time_ns[item.row])) for item in self.ingest],
            events=[replace(item, time_ns=int(time_ns[item.row])) for item in self.events],
        )

    def _housekeeping(self, batch: PacketBatch, row: int, base: int, payload: bytes) -> None:
        if len(payload) < cfe.SOFTWARE_BUS_HOUSEKEEPING.size or len(self.housekeeping) >= _MOST:
            return
        read = cfe.SOFTWARE_BUS_HOUSEKEEPING.parse(payload)
        self.housekeeping.append(
            Housekeeping(
                base + row,
                int(batch.time_ns[row]),
                read["pipe_overflow_error_counter"],
                read["message_limit_error_counter"],
                read["no_subscribers_counter"],
                read["message_send_error_counter"],
            )
        )

    def _ingest(self, batch: PacketBatch, row: int, base: int, payload: bytes) -> None:
        if len(payload) < _CI_COUNTERS_AT + 8 or len(self.ingest) >= _MOST:
            return
        packets, errors = (
            int.from_bytes(payload[at : at + 4], "little") for at in (_CI_COUNTERS_AT, _CI_COUNTERS_AT + 4)
        )
        self.ingest.append(IngestCount(base + row, int(batch.time_ns[row]), packets, errors))

    def _event(self, batch: PacketBatch, row: int, base: int, payload: bytes) -> None:
        if len(payload) < cfe.EVENT.size - 2 or len(self.events) >= _MOST:
            return
        read = cfe.EVENT.parse(payload.ljust(cfe.EVENT.size, b"\0"))
        self.events.append(
            EventRecord(
                base + row,
                int(batch.number[row]),
                int(batch.time_ns[row]),
                read["app_name"],
                read["event_id"],
                read["event_type"],
                f"{read['spacecraft_id']}:{read['processor_id']}",
                read["message"].strip(),
            )
        )

    def _subscriptions(self, batch: PacketBatch, row: int, base: int) -> None:
        if len(self.subscriptions) >= _MOST:
            return
        start = int(batch.offset[row]) + sbn.HEADER.size
        payload = batch.data[start : int(batch.offset[row]) + int(batch.length[row])].tobytes()
        try:
            ident, wanted = sbn.parse_subscriptions(payload)
        except TruncatedError:
            ident, wanted = payload[: sbn.IDENT_BYTES].split(b"\0")[0].decode("ascii", "replace"), ()
        self.subscriptions.append(Subscriptions(base + row, tuple(item.msg_id for item in wanted), ident))

    def _output(self, code: int, row: int, base: int, payload: bytes) -> None:
        if len(self.output) >= _MOST:
            return
        address = payload[:16].split(b"\0")[0].decode("ascii", "replace")
        edits = {telemetry_output.ADD_PACKET, telemetry_output.REMOVE_PACKET}
        wanted = int.from_bytes(payload[:4], "little") if code in edits and len(payload) >= 4 else -1
        self.output.append(
            OutputCommand(base + row, code, address if code == telemetry_output.ENABLE else "", wanted)
        )


def _payload(batch: PacketBatch, columns: Columns, row: int) -> bytes:
    """Return what lies behind a row's cFE header."""
    start = int(columns.packet_offset[row])
    at = start + int(columns.header_length[row])
    return batch.data[at : start + int(columns.packet_length[row])].tobytes() if start >= 0 else b""
