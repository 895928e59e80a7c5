"""Messages sent once a second: ``/edoras/link_statistics``, and ``/edoras/host`` with kernel counters."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Final

import numpy as np
from msgspec.structs import asdict

from edoras_tools.decode.spacecraft import FIRST_SPACECRAFT
from edoras_tools.io.topics.cfe import stamp
from edoras_tools.io.topics.rows import RECORD, Messages, bodies_of, no_messages, whole_messages
from edoras_tools.links import table
from edoras_tools.model import Columns, HostCounters, PacketBatch, SocketCounters, SourceStatistics
from edoras_tools.sessions.sequence import SequenceCounts
from edoras_tools.units import SECOND
from edoras_tools.wire.arrays.order import Integers, changes, distinct_rows

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.mission import Mission
    from edoras_tools.ros import TypeStore
    from edoras_tools.structs import Structs

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
