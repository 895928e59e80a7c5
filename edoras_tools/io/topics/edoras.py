"""Messages that a recording adds to those of the links, on topics below ``/edoras/``.

``faults`` that the proxy or a replay made; ``events``, of cFE and of the capture, for Foxglove's log panel;
``software_bus`` housekeeping; ``link_statistics``, once a second; the kernel's counters in ``host``.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from msgspec.structs import asdict

from edoras_tools.cfs.executive_services import NAME
from edoras_tools.decode.spacecraft import FIRST_SPACECRAFT
from edoras_tools.errors import WireError
from edoras_tools.io.topics.messages import RECORD, Messages, bodies_of, no_messages, whole_messages
from edoras_tools.links import table
from edoras_tools.links.table import RESETS
from edoras_tools.model import Columns, HostCounters, PacketBatch, SocketCounters, SourceStatistics
from edoras_tools.sessions.sequence import SequenceCounts
from edoras_tools.units import SECOND
from edoras_tools.wire import cfe
from edoras_tools.wire.arrays import Integers, Octets, changes, copy_rows, distinct_rows, put_rows, read_at

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.mission import Mission
    from edoras_tools.model import InterfaceOutage
    from edoras_tools.ros import TypeStore
    from edoras_tools.sessions.faults.rules import Fault
    from edoras_tools.structs import Structs
    from edoras_tools.wire.layout import Layout

FAULTS_TOPIC: Final = "/edoras/faults"
FAULTS_TYPE: Final = "edoras_msgs/msg/Fault"

_FIXED: Final = struct.Struct("<iIiB?2x")
"""stamp, msg_id, link, to_cfs, and the padding before the length of the first string."""


def fault_messages(faults: Sequence[Fault], channel_id: int) -> Messages:
    """Return one message per fault, each in its own row.

    Args:
        faults: with times in ns since 1970.
    """
    return bodies_of([_body(fault) for fault in faults], [fault.time_ns for fault in faults], channel_id)


def _body(fault: Fault) -> bytes:
    """Return a message's CDR without its encapsulation."""
    seconds, rest = divmod(fault.time_ns, SECOND)
    body = bytearray(_FIXED.pack(seconds, rest, fault.msg_id, fault.link, fault.to_cfs))
    for text in (fault.kind, fault.detail, fault.rule):
        data = text.encode(errors="replace") + b"\0"
        body += bytes(-len(body) % 4) + struct.pack("<I", len(data)) + data
    body += bytes(-len(body) % 4) + struct.pack("<I", len(fault.original)) + fault.original
    return bytes(body)


def fault_of(cdr: bytes) -> Fault:
    """Return the fault in a message.

    Args:
        cdr: the message, encapsulation included, as ``fault_messages`` writes it.

    Raises:
        WireError: the message is not one of these.
    """
    from edoras_tools.sessions.faults.rules import Fault

    body = cdr[4:]
    try:
        seconds, rest, msg_id, link, to_cfs = _FIXED.unpack_from(body)
        at, parts = _FIXED.size, []
        for _ in range(4):
            at += -at % 4
            (length,) = struct.unpack_from("<I", body, at)
            parts.append(body[at + 4 : at + 4 + length])
            at += 4 + length
    except struct.error as error:
        raise WireError(f"{FAULTS_TOPIC}: a message of {len(cdr)} bytes ends too early") from error
    kind, detail, rule = (part.rstrip(b"\0").decode(errors="replace") for part in parts[:3])
    return Fault(seconds * SECOND + rest, kind, detail, parts[3], table.link(link), to_cfs, msg_id, rule)


def _payload(layout: Layout, **cut: int) -> np.dtype[np.void]:
    """Return a header as a record type with texts as bytes; ``cut`` names its last field and the size."""
    order = "<" if layout.byte_order == "little" else ">"
    fields: list[Any] = []
    for slot in layout.slots:
        name, size = slot.field.name, slot.end - slot.start
        if slot.field.kind == "uint":
            fields.append((name, f"{order}u{size}"))
        else:
            fields.append((name, "u1", cut.get(name, size)))
        if name in cut:
            break
    return np.dtype(fields)


_EVENT = _payload(cfe.EVENT, message=120)
"""An event, without the last 2 of 122 bytes of text, which some builds do not have."""
_RESET = _payload(cfe.RESET_ENTRY, description=80)
"""An entry of a reset log, up to its text."""
_HOUSEKEEPING = _payload(cfe.SOFTWARE_BUS_HOUSEKEEPING)
_BUS_COUNTERS = [
    slot.field.name
    for slot in cfe.SOFTWARE_BUS_HOUSEKEEPING.slots
    if slot.field.bits == 8 and slot.field.name != "spare"
]

_LEVELS = np.array([30, 10, 20, 40, 50], dtype=np.uint8)
"""rcl_interfaces/msg/Log level by EventType: unknown (as WARN), debug, info, error, critical."""

_SOFTWARE_BUS = np.dtype(
    [
        *RECORD,
        ("encapsulation", "<u4"),
        ("stamp_sec", "<i4"),
        ("stamp_nanosec", "<u4"),
        ("processor_id", "<u4"),
        ("memory_pool_handle", "<u4"),
        ("memory_in_use", "<u4"),
        ("unmarked_memory", "<u4"),
        ("pipe_overflow_error_counter", "<u2"),
        ("message_limit_error_counter", "<u2"),
        *((name, "u1") for name in _BUS_COUNTERS),
        ("link", "u1"),
    ]
)
"""``edoras_msgs/msg/SoftwareBusHousekeeping`` as a record."""

_LOG = np.dtype(
    [*RECORD, ("encapsulation", "<u4"), ("stamp_sec", "<i4"), ("stamp_nanosec", "<u4"), ("level", "u1")]
)
"""``rcl_interfaces/msg/Log`` as a record, up to its strings."""


def software_bus_messages(
    batch: PacketBatch, columns: Columns, channel_id: int, published: Integers, *, big_endian: bool = False
) -> Messages:
    """Return one ``edoras_msgs/msg/SoftwareBusHousekeeping`` for every complete 0x0803 packet.

    Args:
        published: publish time, i64, ns since 1970.
        big_endian: whether the counters are big-endian.
    """
    msg_id = cfe.SOFTWARE_BUS_HOUSEKEEPING_MSG_ID
    rows, payload = _telemetry(batch, columns, msg_id, _HOUSEKEEPING, big_endian=big_endian)
    if not len(rows):
        return no_messages(channel_id, _SOFTWARE_BUS)
    heads = np.zeros(len(rows), dtype=_SOFTWARE_BUS)
    stamp(heads, published[rows])
    heads["processor_id"] = columns.processor_id[rows]
    heads["link"] = columns.link[rows]
    for name in _HOUSEKEEPING.names or ():
        if name != "spare":
            heads[name] = payload[name]
    sequence, log_time = columns.sequence_count[rows], batch.time_ns[rows]
    return whole_messages(rows, heads, channel_id, sequence, log_time, published[rows])


def event_messages(
    batch: PacketBatch, columns: Columns, channel_id: int, published: Integers, *, big_endian: bool = False
) -> Messages:
    """Return one ``rcl_interfaces/msg/Log`` for every complete 0x0808 packet.

    ``name`` is the AppName, ``msg`` the text, ``function`` the sender as ``SPACECRAFT/PROCESSOR``,
    ``line`` the EventID, ``file`` empty.

    Args:
        published: publish time, i64, ns since 1970.
        big_endian: whether the numbers are big-endian.
    """
    rows, payload = _telemetry(batch, columns, cfe.EVENT_MSG_ID, _EVENT, big_endian=big_endian)
    if not len(rows):
        return no_messages(channel_id, _LOG)
    times = batch.time_ns[rows], published[rows]
    return _logs(rows, payload, channel_id, times, columns.sequence_count[rows])


def reset_messages(batch: PacketBatch, columns: Columns, channel_id: int) -> Messages:
    """Return one ``rcl_interfaces/msg/Log`` for every entry of an exception and reset log.

    ``name`` is ``CFE_ES``, ``msg`` the description, ``function`` ``0/0`` and ``line`` 0: an entry names no
    sender and no event. It has no severity either, so the level is WARN.
    """
    rows = np.flatnonzero(columns.link == RESETS)
    entries = read_at(batch.data, batch.offset[rows], _RESET)
    payload = np.zeros(len(rows), dtype=_EVENT)
    payload["app_name"][:, : len(NAME)] = np.frombuffer(NAME.encode(), np.uint8)
    width = min(payload["message"].shape[1], entries["description"].shape[1])
    payload["message"][:, :width] = entries["description"][:, :width]
    log_time = batch.time_ns[rows]
    return _logs(rows, payload, channel_id, (log_time, log_time))


def outage_messages(outages: Sequence[InterfaceOutage], channel_id: int) -> Messages:
    """Return one ``rcl_interfaces/msg/Log`` for each outage, so that a log panel shows gaps of the capture.

    ``name`` is ``edoras``, ``msg`` the event, at the time when the interface went away or returned.

    Args:
        outages: outages that began, and those that ended.
    """
    payload = np.zeros(len(outages), dtype=_EVENT)
    for row, outage in zip(payload, outages, strict=True):
        seconds = (outage.end_ns - outage.start_ns) / 1e9
        state = f"was {outage.why} for {seconds:.1f} s" if outage.end_ns else f"is {outage.why} now"
        for name, words in (("app_name", "edoras"), ("message", f"{outage.interface} {state}")):
            text = np.frombuffer(words.encode("ascii", "replace")[: row[name].size - 1], np.uint8)
            row[name][: len(text)] = text
    time_ns = np.array([outage.end_ns or outage.start_ns for outage in outages], dtype=np.int64)
    return _logs(np.arange(len(outages)), payload, channel_id, (time_ns, time_ns))


def stamp(heads: NDArray[np.void], time_ns: Integers) -> None:
    """Write the ``builtin_interfaces/msg/Time`` columns ``stamp_sec`` and ``stamp_nanosec``."""
    heads["stamp_sec"], heads["stamp_nanosec"] = np.divmod(time_ns, SECOND)


def _logs(
    rows: Integers,
    payload: NDArray[np.void],
    channel_id: int,
    times: tuple[Integers, Integers],
    sequence: NDArray[np.uint16] | int = 0,
) -> Messages:
    """Return one ``rcl_interfaces/msg/Log`` for each event.

    Args:
        payload: events; an unknown ``event_type`` gets the level of 0.
        times: capture time of each event, and its stamp; i64, ns since 1970.
    """
    heads = np.zeros(len(rows), dtype=_LOG)
    kinds = payload["event_type"]
    heads["level"] = _LEVELS[np.where(kinds < len(_LEVELS), kinds, 0)]
    stamp(heads, times[1])
    return whole_messages(rows, heads, channel_id, sequence, *times, _log_strings(payload, heads.itemsize))


def _telemetry(
    batch: PacketBatch, columns: Columns, msg_id: int, payload: np.dtype[np.void], *, big_endian: bool
) -> tuple[Integers, NDArray[np.void]]:
    """Find cFE telemetry of one MsgId that is long enough, and gather its payloads."""
    payload = payload.newbyteorder(">") if big_endian else payload
    rows = np.flatnonzero(cfe.known_ids(columns.msg_id, columns.headers) == msg_id)
    if not len(rows):
        return rows, np.zeros(0, payload)
    link, header = columns.link[rows], columns.header_length[rows].astype(np.int64)
    rows = rows[
        table.among(link, lambda item: item.from_cfs and item.packets)
        & (header > 0)
        & (columns.packet_length[rows] >= header + payload.itemsize)
    ]
    return rows, read_at(batch.data, columns.packet_offset[rows] + columns.header_length[rows], payload)


def _log_strings(payload: NDArray[np.void], head_bytes: int) -> tuple[Octets, Integers, Integers]:
    """Write the fields after ``level`` in a Log: name, msg, file, function, line, as aligned CDR strings."""
    count = len(payload)
    senders = payload["spacecraft_id"].astype(np.uint64) << np.uint64(32) | payload["processor_id"]
    distinct, _, which = distinct_rows(senders)
    functions = [f"{sender >> 32}/{sender & 0xFFFFFFFF}".encode() for sender in distinct.tolist()]
    function_pool = np.frombuffer(b"".join(functions) or b"\0", dtype=np.uint8)
    function_length = np.array([len(text) for text in functions], dtype=np.int64)
    function_start = np.cumsum(function_length) - function_length
    texts = (
        _text(payload["app_name"]),
        _text(payload["message"]),
        (function_pool, np.zeros(count, dtype=np.int64), np.zeros(count, dtype=np.int64)),
        (function_pool, function_start[which], function_length[which]),
    )
    # CDR alignment counts from the end of the encapsulation.
    start = head_bytes - np.dtype(RECORD).itemsize - 4
    cursor = np.full(count, start, dtype=np.int64)
    places = []
    for _, _, length in texts:
        cursor += -cursor % 4
        places.append(cursor.copy())
        cursor += 4 + length + 1
    cursor += -cursor % 4
    size = cursor + 4 - start
    base = np.cumsum(size) - size - start
    out = np.zeros(int(size.sum()), dtype=np.uint8)
    for (pool, offset, length), place in zip(texts, places, strict=True):
        put_rows(out, base + place, (length + 1).astype("<u4"))
        copy_rows(out, base + place + 4, pool, offset, length)
    put_rows(out, base + cursor, payload["event_id"].astype("<u4"))
    return out, base + start, size


def _text(field: Octets) -> tuple[Octets, Integers, Integers]:
    """Return a pool, offsets and lengths of NUL-terminated text; bytes that are not ASCII become ``?``."""
    count, width = field.shape
    pool = np.where(field < 0x80, field, np.uint8(ord("?")))
    ended = np.concatenate((pool == 0, np.ones((count, 1), dtype=np.bool_)), axis=1)
    return pool.ravel(), np.arange(count) * width, ended.argmax(axis=1)


_GROUP = np.dtype(
    [("second", "i8"), ("flow", "i8"), ("count", "i8"), ("gaps", "i8"), ("bytes", "i8"), ("largest", "i8")]
)
"""The counters of one flow (a MsgId on a link of a spacecraft) in one second."""

_MSG_ID_BITS = 17
"""Bits of a flow number for MsgId + 1 (so that MsgId -1 is 0); above them 8 bits of link, then spacecraft."""

_MSG_ID_MASK = (1 << _MSG_ID_BITS) - 1

_LINK_STATISTICS = np.dtype(
    [
        *RECORD,
        ("encapsulation", "<u4"),
        ("stamp_sec", "<i4"),
        ("stamp_nanosec", "<u4"),
        ("rate_hz", "<f8"),
        ("bytes", "<u8"),
        ("kernel_drops", "<u8"),
        ("count", "<u4"),
        ("gaps", "<u4"),
        ("largest", "<u4"),
        ("msg_id", "<i4"),
        ("link", "u1"),
        ("padding", "V3"),
        ("topic_length", "<u4"),
    ]
)
"""``edoras_msgs/msg/LinkStatistics`` as a record, up to the bytes of its topic."""


class LinkStatistics:
    """Adds up batches and returns one message a second for every flow seen in that second.

    Seconds are counted from the first datagram. If time goes back, datagrams stay in the current second.

    Args:
        statistics: counts of the source, for its kernel drops; None if it has no such counter.
        sequences: sequence counts shared with other users of the same batches; by default own ones.
        structs: structs whose topics name packets without a route.
    """

    def __init__(
        self,
        mission: Mission,
        statistics: SourceStatistics | None,
        sequences: SequenceCounts | None = None,
        structs: Structs | None = None,
    ) -> None:
        self._structs = structs
        self._mission = mission
        self._topics = {(int(route.link), route.msg_id): route.topic for route in mission.routes}
        self._statistics = statistics
        self._sequences = sequences or SequenceCounts()
        self._origin = -1
        self._second = 0
        self._end_ns = 0
        self._open = np.zeros(0, dtype=_GROUP)
        self._total: Counter[int] = Counter()

    @property
    def flows(self) -> dict[str, int]:
        """The number of datagrams of each flow so far, by ``LINK/MSG_ID``."""
        return {self._flow_name(flow): count for flow, count in self._total.items()}

    def messages(self, batch: PacketBatch, columns: Columns, channel_id: int) -> Messages:
        """Add a batch of at least one row; return the messages of the seconds that have ended.

        Each message belongs to the first row after its second, and comes before the other messages of that
        row.
        """
        if self._origin < 0:
            self._origin = int(batch.time_ns[0])
        second = (batch.time_ns - self._origin) // SECOND
        second = np.maximum(np.maximum.accumulate(second), self._second)
        self._second, self._end_ns = int(second[-1]), int(batch.time_ns[-1])
        groups = _merge(np.concatenate((self._open, self._count(batch, columns, second))))
        ended = groups["second"] < self._second
        self._open = groups[~ended]
        rows = np.searchsorted(second, groups["second"][ended], side="right")
        time_ns = self._origin + (groups["second"][ended] + 1) * SECOND
        return self._write(groups[ended], rows, time_ns, channel_id)

    def finish(self, channel_id: int) -> Messages:
        """Return the messages of the current second, and start again; all belong to row 0."""
        groups, self._open = self._open, np.zeros(0, dtype=_GROUP)
        rows = np.zeros(len(groups), dtype=np.int64)
        return self._write(groups, rows, rows + self._end_ns, channel_id)

    def _count(self, batch: PacketBatch, columns: Columns, second: Integers) -> NDArray[np.void]:
        order, fresh = self._sequences.order(batch, columns)
        length = batch.length[order]
        starts = np.flatnonzero(fresh | changes(order, second))
        groups = np.zeros(len(starts), dtype=_GROUP)
        first = order[starts]
        groups["second"] = second[first]
        link = (columns.spacecraft[first].astype(np.int64) - FIRST_SPACECRAFT) << 8 | columns.link[first]
        groups["flow"] = link << _MSG_ID_BITS | (columns.msg_id[first] + 1)
        groups["count"] = np.diff(np.append(starts, len(order)))
        groups["bytes"] = np.add.reduceat(length, starts, dtype=np.int64)
        groups["largest"] = np.maximum.reduceat(length, starts)
        result = self._sequences.follow(batch, columns)
        if result.missing.any() or result.refilled.any():
            groups["gaps"] = np.add.reduceat((result.missing - result.refilled)[order], starts)
        return groups

    def _write(
        self, groups: NDArray[np.void], rows: Integers, time_ns: Integers, channel_id: int
    ) -> Messages:
        if not len(groups):
            return no_messages(channel_id, _LINK_STATISTICS)
        flows, _, which = distinct_rows(groups["flow"])
        names = [self._name(flow) for flow in flows.tolist()]
        for flow, count in zip(flows.tolist(), np.bincount(which, groups["count"]).tolist(), strict=True):
            self._total[flow] += int(count)
        length = np.array([len(name) for name in names], dtype=np.int64)
        offset = (np.cumsum(length) - length)[which]
        heads = np.zeros(len(groups), dtype=_LINK_STATISTICS)
        stamp(heads, time_ns)
        heads["rate_hz"] = groups["count"]
        heads["kernel_drops"] = (self._statistics.kernel_drops or 0) if self._statistics else 0
        for name in ("bytes", "count", "largest"):
            heads[name] = groups[name]
        heads["gaps"] = np.maximum(groups["gaps"], 0)
        heads["link"] = groups["flow"] >> _MSG_ID_BITS & 0xFF
        heads["msg_id"] = (groups["flow"] & _MSG_ID_MASK) - 1
        heads["topic_length"] = length[which]
        rest = np.frombuffer(b"".join(names) or b"\0", dtype=np.uint8), offset, length[which]
        return whole_messages(rows, heads, channel_id, 0, time_ns, time_ns, rest, repeats=True)

    def _name(self, flow: int) -> bytes:
        """Return the topic of a route or a struct, or ``LINK/MSG_ID``, NUL-terminated like CDR strings."""
        code, msg_id = flow >> _MSG_ID_BITS & 0xFF, (flow & _MSG_ID_MASK) - 1
        own = self._structs.own(msg_id) if self._structs and msg_id >= 0 else ()
        plain = self._flow_name(flow & (1 << _MSG_ID_BITS + 8) - 1)
        other = own[0].topic if len(own) == 1 else plain if msg_id >= 0 else table.link(code).label
        topic, first = self._topics.get((code, msg_id), other), self._mission.prefix(1)
        if number := flow >> _MSG_ID_BITS + 8:
            topic = f"{self._mission.prefix(number + 1)}/{topic.removeprefix(first).removeprefix('/')}"
        return topic.encode() + b"\0"

    def _flow_name(self, flow: int) -> str:
        craft = self._mission.prefix((flow >> _MSG_ID_BITS + 8) + 1)
        name = f"{table.link(flow >> _MSG_ID_BITS & 0xFF).label}/{(flow & _MSG_ID_MASK) - 1:#06x}"
        return f"{craft}/{name}".removeprefix("/")


def _merge(groups: NDArray[np.void]) -> NDArray[np.void]:
    """Add up groups of the same second and flow; the result is sorted by both."""
    groups = groups[np.lexsort((groups["flow"], groups["second"]))]
    second, flow = groups["second"], groups["flow"]
    starts = np.append(0, np.flatnonzero((second[1:] != second[:-1]) | (flow[1:] != flow[:-1])) + 1)
    merged: NDArray[np.void] = groups[starts]
    for name in ("count", "gaps", "bytes"):
        merged[name] = np.add.reduceat(groups[name], starts)
    merged["largest"] = np.maximum.reduceat(groups["largest"], starts)
    return merged


HOST_TOPIC: Final = "/edoras/host"
HOST_TYPE: Final = "edoras_msgs/msg/HostStatistics"
_COUNTERS: Final = tuple(
    name for name in HostCounters.__struct_fields__ if name not in {"time_ns", "sockets"}
)
_UNKNOWN: Final = -1


def host_messages(host: HostCounters, channel_id: int, types: TypeStore) -> Messages:
    """Return the message of one reading of the counters, in row 0."""
    seconds, rest = divmod(host.time_ns, SECOND)
    counters = {name: getattr(host, name) for name in _COUNTERS}
    values = {
        "stamp": {"sec": seconds, "nanosec": rest},
        "sockets": [asdict(item) for item in host.sockets],
        **{name: _UNKNOWN if value is None else value for name, value in counters.items()},
    }
    return bodies_of([types.encode(HOST_TYPE, values)[4:]], [host.time_ns], channel_id)


def host_counters_of(cdr: bytes, types: TypeStore) -> HostCounters:
    """Return the counters in a message.

    Raises:
        WireError: the message is not one of these.
    """
    values = types.decode(HOST_TYPE, cdr)
    counters = {name: values[name] if values[name] != _UNKNOWN else None for name in _COUNTERS}
    sockets = tuple(SocketCounters(**item) for item in values["sockets"])
    return HostCounters(values["stamp"]["sec"] * SECOND + values["stamp"]["nanosec"], sockets, **counters)
