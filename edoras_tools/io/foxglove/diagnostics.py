"""Findings as ``diagnostic_msgs/msg/DiagnosticArray``: once a second, the state of each route and link."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np

from edoras_tools.io.topics.rows import Messages, bodies_of
from edoras_tools.io.topics.streams import Topic
from edoras_tools.links import table
from edoras_tools.model import NO_MSG_ID, OTHER, Columns, Finding, PacketBatch, SourceStatistics
from edoras_tools.units import SECOND
from edoras_tools.wire.cdr import ENCAPSULATION

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from edoras_tools.mission import Mission
    from edoras_tools.ros import TypeStore

DIAGNOSTICS: Final = Topic("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray")

OK: Final = 0
WARN: Final = 1
ERROR: Final = 2
_MOST: Final = 256
"""Garbage may contain any number of MsgIds; those above this number share one status."""
_BITS: Final = 32


class Diagnostics:
    """Counts the findings of batches; makes a message for each second of capture time that has traffic.

    A status is for a route, or for a MsgId of a link: its level is the worst finding of that second.

    Args:
        name: of the source that is diagnosed.
        levels: the level of each finding: OK, WARN or ERROR.
        statistics: of the source, for losses of the capture itself.

    Attributes:
        latest: the statuses of the last message, by name.
    """

    def __init__(
        self,
        mission: Mission,
        types: TypeStore,
        name: str,
        levels: Mapping[Finding, int],
        statistics: SourceStatistics | None = None,
    ) -> None:
        self._topics = {(route.link, route.msg_id): route.topic for route in mission.routes}
        self._types, self._name, self._levels, self._statistics = types, name, levels, statistics
        self._drops = (statistics.kernel_drops or 0) if statistics else 0
        self._counts: dict[tuple[int, int], NDArray[np.int64]] = {}
        self._until = 0
        self.latest: dict[str, dict[str, Any]] = {}

    def messages(self, batch: PacketBatch, columns: Columns, channel_id: int) -> Messages:
        """Add a batch of at least one row; return the message of a second, if the batch completes one."""
        end = int(batch.time_ns[-1])
        self._until = self._until or int(batch.time_ns[0]) + SECOND
        self._add(batch, columns)
        if end < self._until:
            return bodies_of([], [], channel_id)
        self._until = end + SECOND - (end - self._until) % SECOND
        return self._message(end, channel_id, len(batch) - 1)

    def _add(self, batch: PacketBatch, columns: Columns) -> None:
        findings = columns.findings | batch.capture_findings
        key = (columns.link.astype(np.int64) << _BITS) | (columns.msg_id.astype(np.int64) + 1)
        keys, which = np.unique(key, return_inverse=True)
        bits = np.unpackbits(
            np.ascontiguousarray(findings).astype("<u4").view(np.uint8).reshape(-1, 4),
            axis=1,
            bitorder="little",
        )
        for place, value in enumerate(keys.tolist()):
            rows = which == place
            owner = (value >> _BITS, (value & ((1 << _BITS) - 1)) - 1)
            if owner not in self._counts and len(self._counts) >= _MOST:
                owner = (int(OTHER), NO_MSG_ID)
            counts = self._counts.setdefault(owner, np.zeros(_BITS + 1, np.int64))
            counts[:_BITS] += bits[rows].sum(axis=0, dtype=np.int64)
            counts[_BITS] += int(rows.sum())

    def _message(self, time_ns: int, channel_id: int, row: int) -> Messages:
        seconds, rest = divmod(time_ns, SECOND)
        statuses = [self._status(*owner, counts) for owner, counts in sorted(self._counts.items())]
        if self._statistics is not None:
            statuses.insert(0, self._capture(self._statistics))
        self._counts.clear()
        self.latest = {item["name"]: item for item in statuses}
        values = {
            "header": {"stamp": {"sec": seconds, "nanosec": rest}, "frame_id": ""},
            "status": statuses,
        }
        body = self._types.encode(DIAGNOSTICS.type, values)[ENCAPSULATION.size :]
        return bodies_of([body], [time_ns], channel_id, np.array([row]))

    def _status(self, link: int, msg_id: int, counts: NDArray[np.int64]) -> dict[str, Any]:
        label = table.link(link).label
        bits = np.flatnonzero(counts[:_BITS]).tolist()
        found = {Finding(1 << bit): int(counts[bit]) for bit in bits}
        level = max((self._levels.get(finding, WARN) for finding in found), default=OK)
        worst = [item.labels[0] for item in found if self._levels.get(item, WARN) == level]
        topic = self._topics.get((table.link(link), msg_id), "")
        name = f"0x{msg_id:04x}" if msg_id != NO_MSG_ID else "no MsgId"
        return {
            "level": level,
            "name": f"{label}: {topic or name}",
            "message": ", ".join(worst) if level else "OK",
            "hardware_id": self._name,
            "values": [
                {"key": key, "value": str(value)}
                for key, value in {
                    "msg_id": name,
                    "datagrams": int(counts[_BITS]),
                    **{item.labels[0]: count for item, count in found.items()},
                }.items()
            ],
        }

    def _capture(self, statistics: SourceStatistics) -> dict[str, Any]:
        drops = statistics.kernel_drops or 0
        lost, self._drops = drops - self._drops, drops
        return {
            "level": ERROR if lost else OK,
            "name": "capture",
            "message": f"{lost} packets lost by the capture itself" if lost else "OK",
            "hardware_id": self._name,
            "values": [
                {
                    "key": "kernel_drops",
                    "value": "not told" if statistics.kernel_drops is None else str(drops),
                },
                {"key": "skipped", "value": str(statistics.skipped)},
            ],
        }
