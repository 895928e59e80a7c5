"""The messages of a batch in a recording: whole datagrams, the ROS messages and C structs in them, poses.

``/edoras/datagrams`` has every datagram whole. C structs have one topic each; events of a dictionary are log
messages. ``/tf`` has the poses of the mission as coordinate frames, so that a 3D view can follow one.

``Messages`` are those of one kind in columns, with the record headers from which chunks are made.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import msgspec
import numpy as np
from msgspec.structs import replace

from edoras_tools.model import Columns, Finding, PacketBatch
from edoras_tools.ros.library import full_name
from edoras_tools.structs.bindings import Held, payloads
from edoras_tools.units import SECOND
from edoras_tools.wire.arrays import Integers, Octets, by_value, copy_rows, put_rows
from edoras_tools.wire.envelope import ENCAPSULATION

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.mission import Mission, Route
    from edoras_tools.ros import TypeStore
    from edoras_tools.structs import Structs

MAGIC: Final = b"\x89MCAP0\r\n"
"""The first and last bytes of a file."""
RECORD_PREFIX_BYTES: Final = 9
"""Bytes of a record that its length field does not count: the opcode, and the field itself."""
DATAGRAMS_TOPIC: Final = "/edoras/datagrams"
OUTAGE_METADATA_NAME: Final = "edoras_outage"
"""Name of the metadata records that are written when an interface goes away and when it returns."""
COUNTS_METADATA_NAME: Final = "edoras_counts"
"""Name of the metadata with the counts for ``info``, the version, and the covered bytes with their CRC-32."""
APART: Final = "/dds"
"""Prefix of a DDS topic that the mission has too, or that has two types, so that messages are not mixed."""


RECORD = [
    ("opcode", "u1"),
    ("record_length", "<u8"),
    ("channel_id", "<u2"),
    ("sequence", "<u4"),
    ("log_time", "<u8"),
    ("publish_time", "<u8"),
]
"""An MCAP Message record up to its data."""
RECORD_BYTES = np.dtype(RECORD).itemsize
OPCODE_MESSAGE = 0x05
CDR_LE_WORD = 0x00000100
"""The CDR encapsulation ``00 01 00 00`` (little-endian CDR, no options) as a little-endian u32."""

_WHOLE = np.dtype([*RECORD, ("encapsulation", "<u4")])


class Messages(msgspec.Struct, frozen=True, eq=False):
    """Messages of one kind in columns: a fixed head, then bytes from a buffer.

    Attributes:
        rows: row of the batch that each message belongs to, i64, increasing.
        channel_id: MCAP channel, one for each message or one for all.
        log_time: log time, i64, ns since 1970.
        head_bytes: bytes of a head.
        heads: function that returns the heads of a slice of the messages: records that begin with ``RECORD``,
            then the fixed bytes at the start of the message data. They are valid until the next call.
        data: buffer that ``offset`` points into, u8.
        offset: start of the rest of the message data, i64.
        length: bytes of this rest, integer; may be 0.
        repeats: whether ``rows`` may contain a row more than once.
    """

    rows: Integers
    channel_id: NDArray[np.uint16] | int
    log_time: Integers
    head_bytes: int
    heads: Callable[[slice], NDArray[Any]]
    data: Octets
    offset: Integers
    length: NDArray[np.integer[Any]]
    repeats: bool = False

    def __len__(self) -> int:
        return len(self.rows)


def whole_messages(
    rows: Integers,
    heads: NDArray[Any],
    channel_id: NDArray[np.uint16] | int,
    sequence: NDArray[np.integer[Any]] | int,
    log_time: Integers,
    publish_time: NDArray[np.integer[Any]],
    rest: tuple[Octets, Integers, NDArray[np.integer[Any]]] | None = None,
    *,
    repeats: bool = False,
) -> Messages:
    """Return messages with these heads; record headers, and the encapsulation if any, are filled in here.

    Args:
        rows: see ``Messages``, as for ``channel_id``, ``log_time`` and ``repeats``.
        heads: records that begin with ``RECORD``.
        sequence: sequence number, u32.
        publish_time: publish time, ns since 1970.
        rest: bytes after the heads: a buffer, the start of each part in it, and its length; None: nothing.
    """
    if rest is None:
        nothing = np.zeros(len(rows), np.int64)
        rest = np.zeros(1, np.uint8), nothing, nothing
    data, offset, length = rest
    heads["opcode"] = OPCODE_MESSAGE
    heads["record_length"] = length + (heads.itemsize - RECORD_PREFIX_BYTES)
    heads["channel_id"] = channel_id
    heads["sequence"] = sequence
    heads["log_time"] = log_time
    heads["publish_time"] = publish_time
    if "encapsulation" in (heads.dtype.names or ()):
        heads["encapsulation"] = CDR_LE_WORD
    return Messages(
        rows, channel_id, log_time, heads.itemsize, heads.__getitem__, data, offset, length, repeats
    )


def bodies_of(
    bodies: Sequence[bytes],
    times_ns: Sequence[int],
    channel_id: int,
    rows: Integers | None = None,
    *,
    repeats: bool = False,
) -> Messages:
    """Return whole messages from their bodies.

    Args:
        bodies: CDR, little-endian, without the encapsulation.
        times_ns: log and publish time of each, ns since 1970.
        rows: rows that they belong to; by default 0, 1, 2 and so on.
        repeats: see ``Messages``.
    """
    length = np.array([len(body) for body in bodies], dtype=np.int64)
    heads = np.zeros(len(bodies), dtype=_WHOLE)
    time_ns = np.array(times_ns, dtype=np.int64)
    rest = np.frombuffer(b"".join(bodies), dtype=np.uint8), np.cumsum(length) - length, length
    rows = np.arange(len(bodies)) if rows is None else rows
    return whole_messages(rows, heads, channel_id, 0, time_ns, time_ns, rest, repeats=repeats)


def no_messages(channel_id: int, head: np.dtype[np.void]) -> Messages:
    """Return no messages: most small batches have none of most kinds.

    Args:
        head: record type with which each message would begin.
    """
    nowhere = np.zeros(0, np.int64)
    return whole_messages(nowhere, np.zeros(0, head), channel_id, 0, nowhere, nowhere)


class Records(msgspec.Struct, frozen=True, eq=False):
    """Messages in sequence; arrays have one element a message.

    Attributes:
        channel_id: MCAP channel, u16.
        log_time: log time, u64, ns since 1970.
        start: start of the message data in ``data``, i64.
        end: offset after its last byte, i64.
        data: complete MCAP Message records.
    """

    channel_id: NDArray[np.uint16]
    log_time: NDArray[np.uint64]
    start: Integers
    end: Integers
    data: bytes

    def __len__(self) -> int:
        return len(self.start)


def lay_out(streams: Sequence[Messages], rows: int) -> Records:
    """Put messages of a batch one after the other: row by row, within a row in the order of ``streams``."""
    streams = [stream for stream in streams if len(stream)]
    total = np.zeros(rows, dtype=np.int64)
    within = [within_rows(stream, total) for stream in streams]
    ends = np.cumsum(total)
    starts = ends - total
    data = np.empty(int(ends[-1]) if rows else 0, dtype=np.uint8)
    count = sum(map(len, streams))
    channel_id, log_time = np.empty(count, np.uint16), np.empty(count, np.uint64)
    first, last = np.empty(count, np.int64), np.empty(count, np.int64)
    at = 0
    for stream, inside in zip(streams, within, strict=True):
        position = starts[stream.rows] + inside
        put_rows(data, position, stream.heads(slice(0, len(stream))))
        copy_rows(data, position + stream.head_bytes, stream.data, stream.offset, stream.length)
        these = slice(at, at + len(stream))
        channel_id[these], log_time[these] = stream.channel_id, stream.log_time
        first[these] = position + RECORD_BYTES
        last[these] = position + stream.head_bytes + stream.length
        at += len(stream)
    order = np.argsort(first, kind="stable")
    return Records(channel_id[order], log_time[order], first[order], last[order], data.tobytes())


def within_rows(stream: Messages, total: Integers) -> Integers:
    """Return each message's start in its row, after ``total`` bytes there; add its bytes to ``total``."""
    size = stream.head_bytes + stream.length.astype(np.int64)
    rows = stream.rows
    if len(rows) == len(total) and not stream.repeats:
        inside = total.copy()
        total += size
    elif not stream.repeats:
        inside = total[rows]
        total[rows] += size
    else:
        before = np.cumsum(size) - size
        inside = total[rows] + before - before[np.searchsorted(rows, rows)]
        np.add.at(total, rows, size)
    return inside


NO_MESSAGE = Finding.CDR_INVALID | Finding.ENVELOPE_OVERRUN | Finding.TRUNCATED | Finding.CAPTURE_CUT
"""Findings of a datagram that contains no complete ROS message."""
_LONGER: Final = Finding.CDR_TRAILING | Finding.CDR_TOO_LONG

_MAPPED = 0xFFFF0000
"""Bytes 8 to 11 of an IPv4-mapped IPv6 address (RFC 4291 2.5.5.2), little-endian; all before are 0."""

DATAGRAM = np.dtype(
    [
        *RECORD,
        ("encapsulation", "<u4"),
        ("number", "<u8"),
        ("findings", "<u4"),
        ("original_length", "<u4"),
        ("msg_id", "<i4"),
        ("payload_offset", "<i4"),
        ("payload_length", "<u4"),
        ("link_type", "<u2"),
        ("source_port", "<u2"),
        ("destination_port", "<u2"),
        ("link", "u1"),
        ("ip_version", "u1"),
        ("source_zero", "<u8"),
        ("source_mapped", "<u4"),
        ("source_ipv4", ">u4"),
        ("destination_zero", "<u8"),
        ("destination_mapped", "<u4"),
        ("destination_ipv4", ">u4"),
        ("frame_length", "<u4"),
    ]
)
"""``edoras_msgs/msg/Datagram`` as a record, up to the bytes of its frame."""

_ADDRESS_BYTES = 16


class DatagramWriter:
    """Makes one ``edoras_msgs/msg/Datagram`` for every row."""

    def __init__(self, channel_id: int) -> None:
        self._channel_id = channel_id
        self._heads = self._blank(0)

    def messages(self, batch: PacketBatch, columns: Columns, published: Integers) -> Messages:
        """Return the messages of a batch; their heads are made when they are requested.

        Args:
            published: i64, publish time, ns since 1970.
        """
        rows = np.arange(len(batch))
        if (batch.original_length < 0).any():  # packets from inside of frames: only the frames are written
            rows = np.flatnonzero(batch.original_length >= 0)
            batch, columns, published = batch.take(rows), columns.take(rows), published[rows]

        def heads(part: slice) -> NDArray[Any]:
            return self._fill(batch.take(part), columns.take(part), published[part])

        return Messages(
            rows,
            self._channel_id,
            batch.time_ns,
            DATAGRAM.itemsize,
            heads,
            batch.data,
            batch.frame_offset,
            batch.frame_length,
        )

    def _blank(self, count: int) -> NDArray[Any]:
        """Return heads with the constant values; they are reused, so they stay in the processor's cache."""
        heads = np.zeros(count, dtype=DATAGRAM)
        heads["opcode"] = OPCODE_MESSAGE
        heads["channel_id"] = self._channel_id
        heads["encapsulation"] = CDR_LE_WORD
        heads["source_mapped"] = heads["destination_mapped"] = _MAPPED
        return heads

    def _fill(self, batch: PacketBatch, columns: Columns, published: Integers) -> NDArray[Any]:
        if len(self._heads) < len(batch):
            self._heads = self._blank(len(batch))
        heads = self._heads[: len(batch)]
        heads["record_length"] = batch.frame_length + np.int64(DATAGRAM.itemsize - RECORD_PREFIX_BYTES)
        heads["sequence"] = columns.sequence_count
        heads["log_time"] = batch.time_ns
        heads["publish_time"] = published
        heads["number"] = batch.number
        heads["findings"] = columns.findings | batch.capture_findings
        heads["original_length"] = batch.original_length
        heads["msg_id"] = columns.msg_id
        start = batch.offset - batch.frame_offset
        inside = (start >= 0) & (start + batch.length <= batch.frame_length)
        heads["payload_offset"] = np.where(inside, start, -1)
        heads["payload_length"] = batch.length
        heads["link_type"] = batch.link_type
        heads["source_port"] = batch.source_port
        heads["destination_port"] = batch.destination_port
        heads["link"] = columns.link
        heads["ip_version"] = batch.ip_version
        heads["frame_length"] = batch.frame_length
        heads["source_ipv4"] = batch.source_address
        heads["destination_ipv4"] = batch.destination_address
        rows = np.flatnonzero(batch.ip_version == 6)
        if len(rows):
            self._fill_ipv6(heads, batch, rows)
        return heads

    def _fill_ipv6(self, heads: NDArray[Any], batch: PacketBatch, rows: Integers) -> None:
        table = np.frombuffer(b"".join(batch.ipv6), dtype=f"V{_ADDRESS_BYTES}")
        places: Any = DATAGRAM.fields
        addresses = {"source_zero": batch.source_address, "destination_zero": batch.destination_address}
        for name, address in addresses.items():
            whole = heads.getfield(f"V{_ADDRESS_BYTES}", places[name][1])
            whole[rows] = table[address[rows]]
        # These values are no longer constant.
        self._heads = self._heads[:0]


def without_trailing(
    batch: PacketBatch, columns: Columns, types: TypeStore, routes: Sequence[Route]
) -> Columns:
    """Return the columns with CDR lengths that end at the message's last field.

    C++ and JavaScript readers ignore bytes after that field; rosbags rejects more than 3.
    """
    rows = np.flatnonzero((columns.route >= 0) & (columns.findings & np.uint32(_LONGER) != 0))
    if not len(rows):
        return columns
    length = columns.cdr_length.copy()
    for route, picked in by_value(columns.route[rows]):
        at = rows[picked]
        trailing = types.trailing(routes[route].type, batch.data, columns.cdr_offset[at], length[at])
        length[at] -= np.maximum(trailing, 0)
    return replace(columns, cdr_length=length)


def ros_messages(
    batch: PacketBatch, columns: Columns, channel_ids: NDArray[np.uint16], published: Integers
) -> Messages:
    """Return the ROS message of every row with a complete one on a configured topic, CDR as captured.

    Args:
        channel_ids: u16, MCAP channel of each of ``Mission.routes``.
        published: i64, publish time, ns since 1970.
    """
    findings = columns.findings | batch.capture_findings
    rows = np.flatnonzero(
        (columns.route >= 0) & (columns.cdr_length > 0) & (findings & np.uint32(NO_MESSAGE) == 0)
    )
    heads = np.empty(len(rows), dtype=np.dtype(RECORD))
    channel_id: NDArray[np.uint16] | int = channel_ids[columns.route[rows]] if len(rows) else 0
    rest = batch.data, columns.cdr_offset[rows], columns.cdr_length[rows]
    sequence, log_time = columns.sequence_count[rows], batch.time_ns[rows]
    return whole_messages(rows, heads, channel_id, sequence, log_time, published[rows], rest)


assert DATAGRAM.itemsize == RECORD_BYTES + 4 + 72


_FEW: Final = 1024
"""Messages of a struct in a batch below which they are joined with others: one call for all is faster."""


def struct_messages(
    batch: PacketBatch,
    columns: Columns,
    structs: Structs,
    channel_ids: Mapping[str, int],
    published: Integers,
) -> Iterator[Messages]:
    """Yield the messages of every struct in a batch.

    Args:
        published: i64, publish time, ns since 1970.
    """

    def column(name: str) -> NDArray[np.generic]:
        return getattr(columns, name)

    samples = payloads(structs, column, partial(getattr, batch), batch.data)
    some: list[Held] = []
    for payload in structs.payloads_of(samples, column, batch.data):
        if len(payload.rows) < _FEW and not payload.repeats:
            some.append(payload)
        else:
            yield _messages(payload, batch, columns, channel_ids[payload.bound.topic], published)
    if some:
        yield _joined(some, batch, columns, channel_ids, published)


def _joined(
    some: list[Held], batch: PacketBatch, columns: Columns, ids: Mapping[str, int], published: Integers
) -> Messages:
    """Return the messages of several structs, each of which is at most once in a row."""
    encoded = [payload.encode() for payload in some]
    channels = np.array([ids[payload.bound.topic] for payload in some], np.uint16)
    rows = np.concatenate([payload.rows for payload in some])
    order = np.argsort(rows, kind="stable")
    base = np.cumsum([0, *(len(item.data) for item in encoded)])
    start = np.concatenate([item.start + at for item, at in zip(encoded, base.tolist(), strict=False)])
    size = np.concatenate([item.size for item in encoded])
    channels = np.repeat(channels, [len(payload.rows) for payload in some])
    rest = np.concatenate([item.data for item in encoded]), start[order], size[order]
    rows, heads = rows[order], np.empty(len(rows), RECORD)
    times = batch.time_ns[rows], published[rows]
    return whole_messages(rows, heads, channels[order], columns.sequence_count[rows], *times, rest)


def _messages(
    payload: Held, batch: PacketBatch, columns: Columns, channel_id: int, published: Integers
) -> Messages:
    """Return the messages of one struct."""
    rows = payload.rows
    encoded = None if payload.size else payload.encode()
    # Messages of the same length become part of their heads, and are copied with them.
    width = encoded.width if encoded else payload.size
    heads = np.zeros(len(rows), [*RECORD, ("message", f"V{width}")])
    if encoded is None:
        payload.fill(heads.view(np.uint8).reshape(len(rows), -1)[:, RECORD_BYTES:])
    elif width:
        heads["message"] = encoded.data.view(f"V{width}")
    rest = (encoded.data, encoded.start, encoded.size) if encoded and not width else None
    times = batch.time_ns[rows], published[rows]
    sequence = columns.sequence_count[rows]
    return whole_messages(rows, heads, channel_id, sequence, *times, rest, repeats=payload.repeats)


def log_messages(
    batch: PacketBatch, columns: Columns, structs: Structs, types: TypeStore, channel_id: int
) -> Messages:
    """Return one ``rcl_interfaces/msg/Log`` for every event of a dictionary, stamped with the capture time.

    Args:
        structs: structs with a dictionary.
        types: types that include the Log message.
    """
    table = structs.dictionary
    assert table is not None, "called with one"
    samples = payloads(structs, partial(getattr, columns), partial(getattr, batch), batch.data)
    logs: list[tuple[int, int, bytes]] = []
    for row, at, fields in table.logs(samples, batch.data):
        seconds, rest = divmod(int(batch.time_ns[row]), SECOND)
        log = {"stamp": {"sec": seconds, "nanosec": rest}, **fields}
        logs.append((row, at, types.encode("rcl_interfaces/msg/Log", log)[ENCAPSULATION.size :]))
    logs.sort()
    rows = np.array([row for row, _, _ in logs], np.int64)
    bodies = [body for _, _, body in logs]
    return bodies_of(bodies, batch.time_ns[rows].tolist(), channel_id, rows, repeats=True)


TF_TOPIC: Final = "/tf"
TF_TYPE: Final = "tf2_msgs/msg/TFMessage"
_POSES: Final = {
    "geometry_msgs/msg/PoseStamped": "pose",
    "geometry_msgs/msg/PoseWithCovarianceStamped": "pose.pose",
    "nav_msgs/msg/Odometry": "pose.pose",
}
"""Types with a pose in the frame of their header, and the field that has it."""
_VALUES: Final = (*(f"position.{axis}" for axis in "xyz"), *(f"orientation.{axis}" for axis in "xyzw"))
_WORD: Final = 4
_BEFORE_NAMES: Final = 16
"""Bytes of the CDR before the characters of the first frame name."""
_DOUBLE: Final = 8


class Transforms:
    """Makes a transform from each message with a pose: from its header's frame to one named like its topic.

    Args:
        mission: mission whose routes with poses are used; none if ``/tf`` is a route itself.

    Attributes:
        frames: frame name of each such route, by the route's index: its topic without the leading ``/``.
    """

    def __init__(self, mission: Mission, types: TypeStore) -> None:
        self._types, self._mission = types, mission
        routes = mission.routes
        has_tf = any(route.topic == TF_TOPIC for route in routes)
        self.frames = {
            place: route.topic.strip("/")
            for place, route in enumerate(routes)
            if full_name(route.type) in _POSES and not has_tf
        }

    def are_in(self, columns: Columns) -> bool:
        """Return whether any row may have a pose."""
        return bool(self.frames) and bool(np.isin(columns.route, list(self.frames)).any())

    def messages(self, batch: PacketBatch, columns: Columns, channel_id: int) -> Iterator[Messages]:
        """Yield the transforms of a batch, for each route and frame; poses without a frame are left out."""
        for place, child in self.frames.items():
            rows = np.flatnonzero((columns.route == place) & (columns.cdr_length > 0))
            if not len(rows):
                continue
            type_name = full_name(self._mission.routes[place].type)
            offset, length = columns.cdr_offset[rows], columns.cdr_length[rows]
            read = self._types.columns(type_name, batch.data, offset, length)
            names = np.asarray(read.fields["header.frame_id"])
            for frame in sorted({*names[read.valid].tolist()} - {"", child}):
                these = np.flatnonzero(read.valid & (names == frame))
                heads = np.zeros(len(these), _record(frame.encode(), child.encode()))
                heads["count"] = 1
                for name in ("sec", "nanosec"):
                    heads[name] = np.asarray(read.fields[f"header.stamp.{name}"])[these]
                for name, text in (("frame", frame.encode()), ("child", child.encode())):
                    heads[f"{name}_length"], heads[name] = len(text) + 1, text
                for index, name in enumerate(_VALUES):
                    field = f"{_POSES[type_name]}.{name}"
                    heads["values"][:, index] = np.asarray(read.fields[field])[these]
                own = rows[these]
                sequence, log_time = columns.sequence_count[own], batch.time_ns[own]
                yield whole_messages(own, heads, channel_id, sequence, log_time, log_time)


def _record(frame: bytes, child: bytes) -> np.dtype[np.void]:
    """Return the record of a transform between two frames: CDR names end with NUL and are padded."""
    first = _up(len(frame) + 1, _WORD)
    second_at = _BEFORE_NAMES + first + _WORD
    second = _up(second_at + len(child) + 1, _DOUBLE) - second_at
    return np.dtype(
        [
            *RECORD,
            ("encapsulation", "<u4"),
            ("count", "<u4"),
            ("sec", "<i4"),
            ("nanosec", "<u4"),
            ("frame_length", "<u4"),
            ("frame", f"S{first}"),
            ("child_length", "<u4"),
            ("child", f"S{second}"),
            ("values", "<f8", (len(_VALUES),)),
        ]
    )


def _up(size: int, to: int) -> int:
    return -(-size // to) * to
