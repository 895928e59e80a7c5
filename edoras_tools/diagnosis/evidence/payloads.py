"""Reads the payloads that a diagnosis needs: counters and subscriptions as columns, events, commands.

It also records the states of robots and the telemetry that carries them, for the age of a state when it
leaves cFS. A robot state begins with the seven doubles of the pose. The message that a flight application
makes of it ends with the same bytes, so a fingerprint of these bytes identifies both.
"""

from __future__ import annotations

from functools import partial
from itertools import islice
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec
import numpy as np
from msgspec.structs import replace

from edoras_tools.cfs import command_ingest, executive_services, telemetry_output
from edoras_tools.cfs.arguments import APPLICATIONS, ARGUMENTS, arguments_of, command_text
from edoras_tools.decode.filters.layers import field_series, held_messages, structs_of
from edoras_tools.diagnosis.evidence.fingerprint import latest_equal
from edoras_tools.errors import TruncatedError
from edoras_tools.links import CFS_PORT, bare
from edoras_tools.links.table import among
from edoras_tools.model import Columns, Finding, PacketBatch
from edoras_tools.wire import cfe, sbn
from edoras_tools.wire.arrays import Integers, Places, Prints, by_value, gather, numbered, of_bytes

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Mapping

    from numpy.typing import NDArray
    from typing_extensions import Self

    from edoras_tools.decode.filters.rows import ColumnRows
    from edoras_tools.structs.shapes import Member

_MOST: Final = 200_000
"""Largest number of events, and of commands, that are kept: further ones add nothing new."""
_AT_ONCE: Final = 4096
"""Number of events that are decoded at once."""
_BUS_COUNTERS: Final = (
    cfe.SOFTWARE_BUS_HOUSEKEEPING,
    (
        "pipe_overflow_error_counter",
        "message_limit_error_counter",
        "no_subscribers_counter",
        "message_send_error_counter",
    ),
)
_CI_COUNTERS: Final = cfe.COMMAND_INGEST_HOUSEKEEPING, ("ingest_packets", "ingest_errors")
_CI_7_COUNTERS: Final = cfe.COMMAND_INGEST_HOUSEKEEPING_7, _CI_COUNTERS[1]
_FEWER: Final = 4
"""Counters are byte-swapped if they change this many times less in the other byte order."""
_BIG_TYPES: Final = (1 << 8, 2 << 8, 3 << 8, 4 << 8)
"""Event types 1 to 4 as a big-endian cFS writes them, read as little-endian."""
_CHANGES: Final = np.isin(np.arange(1 << 16), list(APPLICATIONS))
_TO_COUNTERS: Final = cfe.TELEMETRY_OUTPUT_HOUSEKEEPING, ("command_counter", "command_error_counter")


class Samples(msgspec.Struct):
    """Columns with one element for each payload of a kind, such as the counters of each 0x803.

    They are collected batch by batch, and joined when a column is read.

    Attributes:
        names: names of the columns, all i64; the first two are ``row`` of the table and capture ``time_ns``.
    """

    names: tuple[str, ...]
    _parts: list[Integers] = msgspec.field(default_factory=list)

    @classmethod
    def of(cls, *names: str) -> Self:
        """Return empty samples with these columns behind ``row`` and ``time_ns``."""
        return cls(("row", "time_ns", *names))

    def __len__(self) -> int:
        return sum(part.shape[1] for part in self._parts)

    def __getitem__(self, name: str) -> Integers:
        """Return a column, i64 (samples,)."""
        return self._whole()[self.names.index(name)]

    def add(self, *columns: NDArray[Any]) -> None:
        """Add the samples of a batch; columns in the order of ``names``, all of one length."""
        if len(columns[0]):
            self._parts.append(np.stack([column.astype(np.int64) for column in columns]))

    def over(self, place: Integers) -> Self:
        """Return the samples that are in another table, in its order.

        Args:
            place: i64, new row of each old row; below 0 if it is not in the other table.
        """
        whole = self._whole().copy()
        whole[0] = place[whole[0]]
        whole = whole[:, whole[0] >= 0]
        return replace(self, _parts=[whole[:, np.argsort(whole[0], kind="stable")]])

    def timed(self, time_ns: Integers) -> Self:
        """Return the same with new capture times: i64 (rows of the table,)."""
        whole = self._whole().copy()
        whole[1] = time_ns[whole[0]]
        return replace(self, _parts=[whole])

    def ordered(self, size: int, *names: str) -> Self:
        """Return the samples with counters of ``size`` bytes in the byte order in which they change least."""
        whole = self._whole().copy()
        places = [self.names.index(name) for name in names]
        own = whole[places]
        other = own.astype(f"<u{size}").byteswap().astype(np.int64)
        steps, turned = (int(np.abs(np.diff(columns)).sum()) for columns in (own, other))
        if not steps or turned * _FEWER > steps:
            return self
        whole[places] = other
        return replace(self, _parts=[whole])

    def _whole(self) -> Integers:
        if len(self._parts) != 1:
            self._parts = [np.concatenate([np.zeros((len(self.names), 0), np.int64), *self._parts], axis=1)]
        return self._parts[0]


class EventRecord(NamedTuple):
    """One event (0x808) of an application.

    Attributes:
        row: row of the table of datagrams.
        number: place of the datagram in its source, from 1.
        time_ns: capture time.
        app: name of the application.
        event_id: number of the event in that application.
        event_type: type of the event; 3 and 4 are errors.
        sender: spacecraft and processor, as ``66:1``.
        message: text of the event.
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


class SubscriptionMessage(NamedTuple):
    """The content of a SUB or UNSUB.

    Attributes:
        wanted: MsgIds; empty if the message could not be read.
        ident: SBN's ``$Id`` string in the message.
    """

    wanted: tuple[int, ...]
    ident: str


class CommandRecord(NamedTuple):
    """One command that changes the behaviour of a cFS.

    Attributes:
        row: row of the table of datagrams.
        time_ns: capture time.
        msg_id: MsgId in message version 1.
        function_code: command code at the application that receives it.
        values: name of an argument to its value, as in ``cfs.arguments``, without those that were cut off.
        is_whole: whether the packet has all bytes of the arguments.
    """

    row: int
    time_ns: int
    msg_id: int
    function_code: int
    values: Mapping[str, Any]
    is_whole: bool = True

    @property
    def app(self) -> str:
        """Name of the application that the command is about; empty for none."""
        return str(self.values.get("application", ""))

    @property
    def address(self) -> str:
        """Address that Telemetry Output shall send to; empty for none."""
        return str(self.values.get("address", ""))

    @property
    def entry(self) -> int:
        """MsgId of the entry in Telemetry Output's table that the command is about; -1 for none or all."""
        return self.values["stream"] & 0xFFFF if "stream" in self.values else -1

    def __str__(self) -> str:
        return command_text(self.msg_id, self.function_code, self.values)


_SAMPLES: Final = ("housekeeping", "ingest", "commanded", "subscriptions", "beyond")
_RECORDS: Final = ("events", "commands")


class Payloads(msgspec.Struct):
    """The payloads that a diagnosis needs, in order of capture.

    Attributes:
        housekeeping: samples of the software bus counters (0x803), which wrap at 16 bits, the last two at 8.
        ingest: samples of Command Ingest's counters (0x884).
        commanded: samples of Telemetry Output's command counters (0x880): accepted and refused commands.
        subscriptions: SUB and UNSUB messages; ``said`` is an index of ``contents``.
        contents: different contents of these messages.
        events: events of applications (0x808).
        commands: commands that change the behaviour of a cFS, except those that cFS sends itself.
        beyond: values outside limits; ``field`` is a number in ``limited``, ``value`` the bits of a float64.
        limited: ``struct.path`` of each field with limits to its number and member.
    """

    housekeeping: Samples = msgspec.field(
        default_factory=lambda: Samples.of("pipe_overflows", "msg_limits", "no_subscribers", "send_errors")
    )
    ingest: Samples = msgspec.field(default_factory=lambda: Samples.of("packets", "errors"))
    commanded: Samples = msgspec.field(default_factory=lambda: Samples.of("taken", "refused"))
    subscriptions: Samples = msgspec.field(default_factory=lambda: Samples.of("said"))
    contents: list[SubscriptionMessage] = msgspec.field(default_factory=list)
    events: list[EventRecord] = msgspec.field(default_factory=list)
    commands: list[CommandRecord] = msgspec.field(default_factory=list)
    beyond: Samples = msgspec.field(default_factory=lambda: Samples.of("field", "value", "red"))
    limited: dict[str, tuple[int, Member]] = msgspec.field(default_factory=dict)
    _content: dict[int, int] = msgspec.field(default_factory=dict)

    def add(self, batch: PacketBatch, columns: Columns, base: int) -> None:
        """Read the payloads of a batch.

        Args:
            batch: datagrams.
            columns: decoded columns of these.
            base: row of the table for the first datagram of the batch.
        """
        downward = among(columns.link, lambda link: link.from_cfs and link.packets)
        ids = cfe.known_ids(columns.msg_id, columns.headers)
        for samples, msg_id, layout, names in (
            (self.housekeeping, cfe.SOFTWARE_BUS_HOUSEKEEPING_MSG_ID, *_BUS_COUNTERS),
            (self.ingest, command_ingest.HOUSEKEEPING_MSG_ID, *_CI_COUNTERS),
            (self.ingest, command_ingest.HOUSEKEEPING_MSG_ID, *_CI_7_COUNTERS),
            (self.commanded, telemetry_output.HOUSEKEEPING_MSG_ID, *_TO_COUNTERS),
        ):
            rows = np.flatnonzero(downward & (ids == msg_id))
            # Bytes behind the counters are not needed: the capture may have cut them off.
            size = max(layout.by_name[name].end for name in names)
            have = columns.packet_length[rows] - columns.header_length[rows]
            fits = have >= size
            if layout is cfe.COMMAND_INGEST_HOUSEKEEPING_7:
                fits = (have == size) & ((columns.findings[rows] & np.uint32(Finding.CAPTURE_CUT)) == 0)
            rows = rows[(columns.packet_offset[rows] >= 0) & fits]
            payload = gather(batch.data, columns.packet_offset[rows] + columns.header_length[rows], size)
            own: Any = slice(None)
            if layout is cfe.SOFTWARE_BUS_HOUSEKEEPING:  # an overwritten payload has no 0 in the spare byte
                own = layout.column("spare", payload) == 0
            counters = [layout.column(name, payload)[own] for name in names]
            samples.add((base + rows)[own], batch.time_ns[rows][own], *counters)
        self.events += islice(events_in(batch, columns, base), max(0, _MOST - len(self.events)))
        listed = (columns.sbn_msg_type == sbn.MsgType.SUB) | (columns.sbn_msg_type == sbn.MsgType.UNSUB)
        listed &= (columns.findings & np.uint32(Finding.CAPTURE_CUT)) == 0
        self._subscribe(batch, np.flatnonzero(listed), base)
        changes = _CHANGES.take(ids, mode="clip") & ~among(columns.link, lambda link: link.only_from_cfs)
        changes &= columns.function_code > 0
        for row in np.flatnonzero(changes).tolist()[: max(0, _MOST - len(self.commands))]:
            key = int(ids[row]), int(columns.function_code[row])
            content = _payload(batch, columns, row)
            cut = bool(columns.findings[row] & np.uint32(Finding.CAPTURE_CUT))
            if (values := arguments_of(*key, content, cut=cut)) is not None:
                is_whole = len(content) >= ARGUMENTS[key].size
                when = int(batch.time_ns[row])
                self.commands.append(CommandRecord(base + row, when, *key, values, is_whole))

    def add_limits(self, packets: ColumnRows, base: int) -> None:
        """Read the values of a batch that are outside their limits; ``base`` is as in ``add``."""
        for bound in structs_of(packets):
            for path, member in bound.limited.items():
                series = field_series(partial(held_messages, bound), path, None, packets)
                value = member.calibrated(series.values.astype(np.float64))
                yellow, red = member.beyond(value)
                out, number = np.flatnonzero(yellow | red), len(self.limited)
                at = np.asarray(series.owner)[out]
                field = np.full(len(at), self.limited.setdefault(f"{bound.name}.{path}", (number, member))[0])
                self.beyond.add(base + at, packets.batch.time_ns[at], field, value[out].view("i8"), red[out])

    def outputs(self, *codes: int) -> list[CommandRecord]:
        """Return the commands to Telemetry Output with some function codes."""
        return self._of(telemetry_output.COMMAND_MSG_ID, codes)

    def about_apps(self, *codes: int) -> list[CommandRecord]:
        """Return the commands to Executive Services with some function codes.

        Without codes: those that start, stop, restart or reload an application.
        """
        every = executive_services.START_APP, *executive_services.ENDS_APP
        return self._of(executive_services.COMMAND_MSG_ID, codes or every)

    def _of(self, msg_id: int, codes: Collection[int]) -> list[CommandRecord]:
        return [item for item in self.commands if item.msg_id == msg_id and item.function_code in codes]

    def over(self, rows: Places, count: int) -> Payloads:
        """Return the payloads for a new table that has only some rows of the old one.

        Args:
            rows: old row of each new row; -1 for a row whose payload shall not count.
            count: number of rows of the old table.
        """
        place = np.full(count + 1, -1, np.int64)
        place[rows] = np.arange(len(rows))
        place[-1] = -1

        def moved(items: list[Any]) -> Any:
            own = place[np.array([item.row for item in items], np.intp)]
            order = np.argsort(own, kind="stable")[np.count_nonzero(own < 0) :]
            pairs = zip(order.tolist(), own[order].tolist(), strict=True)
            return [type(items[at])(row, *items[at][1:]) for at, row in pairs]

        columns: dict[str, Any] = {name: getattr(self, name).over(place) for name in _SAMPLES}
        return replace(self, **columns, **{name: moved(getattr(self, name)) for name in _RECORDS})

    def ordered(self) -> Payloads:
        """Return the payloads with counters in the byte order of their cFS, which their growth shows."""
        return replace(
            self,
            housekeeping=self.housekeeping.ordered(2, "pipe_overflows", "msg_limits"),
            ingest=self.ingest.ordered(4, "packets", "errors"),
        )

    def timed(self, time_ns: Integers) -> Payloads:
        """Return the same with new capture times: i64 (rows of the table,)."""
        columns: dict[str, Any] = {name: getattr(self, name).timed(time_ns) for name in _SAMPLES}
        for name in _RECORDS:
            columns[name] = [item._replace(time_ns=int(time_ns[item.row])) for item in getattr(self, name)]
        return replace(self, **columns)

    def _subscribe(self, batch: PacketBatch, rows: Places, base: int) -> None:
        """Read SUB and UNSUB messages; equal ones are parsed once: bridges repeat them twice a second."""
        start = batch.offset[rows] + sbn.HEADER.size
        length = batch.length[rows] - sbn.HEADER.size
        prints = of_bytes(batch.data, start, length)
        first, which = numbered(prints)
        places = np.zeros(len(first), np.int64)
        for number, at in enumerate(first.tolist()):
            index = self._content.setdefault(int(prints[at]), len(self.contents))
            if index == len(self.contents):
                end = int(start[at]) + max(0, int(length[at]))
                self.contents.append(_subscriptions(batch.data[int(start[at]) : end].tobytes()))
            places[number] = index
        self.subscriptions.add(base + rows, batch.time_ns[rows], places[which])


def events_in(batch: PacketBatch, columns: Columns, base: int = 0) -> Iterator[EventRecord]:
    """Yield the events in a batch.

    Args:
        batch: datagrams.
        columns: decoded columns of these.
        base: row of the table for the first datagram of the batch.
    """
    ids = cfe.known_ids(columns.msg_id, columns.headers)
    rows = np.flatnonzero((ids == cfe.EVENT_MSG_ID) & (columns.packet_offset >= 0))
    have = columns.packet_length[rows] - columns.header_length[rows]
    downward = among(columns.link[rows], lambda link: link.from_cfs and link.packets)
    sound = downward & (have >= cfe.EVENT.size - 2)  # some builds leave out the last two bytes
    rows, have = rows[sound], have[sound]
    for first in range(0, len(rows), _AT_ONCE):
        some = slice(first, first + _AT_ONCE)
        yield from _events(batch, columns, rows[some], have[some], base)


def _events(
    batch: PacketBatch, columns: Columns, rows: Places, have: NDArray[np.int32], base: int
) -> Iterator[EventRecord]:
    """Yield the events of some rows, of which ``have`` payload bytes were captured."""
    payload = gather(batch.data, columns.packet_offset[rows] + columns.header_length[rows], cfe.EVENT.size)
    payload[np.arange(cfe.EVENT.size) >= have[:, None]] = 0
    names = "event_id", "event_type", "spacecraft_id", "processor_id"
    read = [cfe.EVENT.column(name, payload) for name in names]
    turned = np.isin(read[1], _BIG_TYPES)
    numbers = [np.where(turned, column.byteswap(), column).tolist() for column in read]
    texts = []
    for name, strip in (("app_name", str), ("message", str.strip)):
        slot = cfe.EVENT.by_name[name]
        column = np.ascontiguousarray(payload[:, slot.start : slot.end]).view(f"S{slot.end - slot.start}")
        raw = column[:, 0].tolist()  # most texts repeat
        unlike = {text: strip(text.split(b"\0", 1)[0].decode("utf-8", "replace")) for text in set(raw)}
        texts.append([unlike[text] for text in raw])
    where = (column.tolist() for column in (base + rows, batch.number[rows], batch.time_ns[rows]))
    senders = [f"{spacecraft}:{processor}" for spacecraft, processor in zip(*numbers[2:], strict=True)]
    yield from map(EventRecord, *where, texts[0], *numbers[:2], senders, texts[1])


def _subscriptions(payload: bytes) -> SubscriptionMessage:
    try:
        ident, items = sbn.parse_subscriptions(payload)
    except TruncatedError:
        ident, items = payload[: sbn.IDENT_BYTES].split(b"\0")[0].decode("ascii", "replace"), ()
    return SubscriptionMessage(tuple(item.msg_id for item in items), ident)


def _payload(batch: PacketBatch, columns: Columns, row: int) -> bytes:
    """Return the bytes behind a row's cFE header."""
    start = int(columns.packet_offset[row])
    at = start + int(columns.header_length[row])
    return batch.data[at : start + int(columns.packet_length[row])].tobytes() if start >= 0 else b""


_LEAST_PASSED: Final = 3


class PassedStates(NamedTuple):
    """Robot states that left cFS as messages of one MsgId.

    Attributes:
        msg_id: cFE MsgId of the messages.
        number: i64 (n,), place of each packet in its source.
        time_ns: i64 (n,), capture time at which each left cFS.
        age_ns: i64 (n,), time since the robot had sent the state.
        sent_ns: i64 (states,), capture times of all states that the robot sent.
    """

    msg_id: int
    number: Integers
    time_ns: Integers
    age_ns: Integers
    sent_ns: Integers


class StateRecorder:
    """Records the states of robots, and, from the first state on, the telemetry that may carry one."""

    def __init__(self) -> None:
        self._sent: list[tuple[Integers, Prints]] = []
        self._passed: list[tuple[Integers, ...]] = []

    def add_states(self, batch: PacketBatch) -> None:
        """Record the robot states among some datagrams without packets."""
        size = bare.ROBOT_STATE.size
        own = np.flatnonzero((batch.length == size) & (batch.destination_port == CFS_PORT))
        if len(own):
            length = np.full(len(own), bare.ROBOT_POSE.size, np.int32)
            self._sent.append((batch.time_ns[own], of_bytes(batch.data, batch.offset[own], length)))

    def add_messages(
        self, batch: PacketBatch, columns: Columns, offset: Integers, length: NDArray[np.int32]
    ) -> None:
        """Record the telemetry that may carry robot states.

        Args:
            batch: datagrams with packets.
            columns: decoded columns of these.
            offset: i64 (n,), first byte of each message; -1 for none.
            length: i32 (n,), bytes of each message.
        """
        size = bare.ROBOT_POSE.size
        if not self._sent:
            return
        down = among(columns.link, lambda link: link.only_from_cfs)
        own = np.flatnonzero(down & (offset >= 0) & (length > size))
        prints = of_bytes(batch.data, offset[own] + length[own] - size, np.full(len(own), size, np.int32))
        msg_id = columns.msg_id[own].astype(np.int64)
        self._passed.append((msg_id, batch.number[own], batch.time_ns[own], prints.view(np.int64)))

    def passed(self) -> Iterator[PassedStates]:
        """Yield the states that left cFS, for each MsgId that carries states."""
        if not self._sent or not self._passed:
            return
        sent_ns, states = (np.concatenate(parts) for parts in zip(*self._sent, strict=True))
        columns = [np.concatenate(parts) for parts in zip(*self._passed, strict=True)]
        for msg_id, rows in by_value(columns[0]):
            number, time_ns, prints = (column[rows] for column in columns[1:])
            at = latest_equal(states, sent_ns, prints.view(np.uint64), time_ns)
            is_state = at >= 0
            is_state &= np.isin(np.arange(len(at)), np.unique(at, return_index=True)[1])  # first ones
            if is_state.sum() >= _LEAST_PASSED:
                age_ns = time_ns[is_state] - sent_ns[at[is_state]]
                yield PassedStates(msg_id, number[is_state], time_ns[is_state], age_ns, sent_ns)
