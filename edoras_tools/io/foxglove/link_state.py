"""The state of a link for the server's page: its routes, rates and losses, and the last events."""

from __future__ import annotations

import threading
import time
from collections import deque
from typing import TYPE_CHECKING, Any, Final

from edoras_tools.cfs.names import message_name
from edoras_tools.io.topics.rows import Messages, lay_out
from edoras_tools.links import table
from edoras_tools.model import NO_MSG_ID, PacketBatch, SourceStatistics
from edoras_tools.units import MILLISECOND, SECOND

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from edoras_tools.ros import TypeStore

_MOST_ROUTES: Final = 500
"""Garbage may contain any number of MsgIds; those above this number are added up in one row."""
_MOST_EVENTS: Final = 40
_STALE_NS: Final = 2500 * MILLISECOND
"""A route is counted once in a second with traffic; without a count for this long its rate is 0."""
_LOG: Final = "rcl_interfaces/msg/Log"
_SUMS: Final = ("count", "gaps", "bytes")


class LinkState:
    """Adds up what a sink makes of each batch; any thread may ask for the sum.

    Args:
        statistics: of the source, for losses of the capture itself; None: it has no such counter.
    """

    def __init__(self, types: TypeStore, statistics: SourceStatistics | None) -> None:
        self._types, self._statistics = types, statistics
        self._lock = threading.Lock()
        self._routes: dict[tuple[int, int], dict[str, Any]] = {}
        self._events: deque[dict[str, Any]] = deque(maxlen=_MOST_EVENTS)
        self._time_ns, self._heard = 0, -1.0

    def add(
        self,
        batch: PacketBatch,
        counts: Messages,
        events: Sequence[Messages],
        statuses: Mapping[str, Mapping[str, Any]],
    ) -> None:
        """Add a batch of at least one row.

        Args:
            counts: its messages on ``/edoras/link_statistics``.
            events: its messages on ``/edoras/events``: of cFE, of its reset log, of F Prime.
            statuses: the latest of ``/diagnostics``, by name.
        """
        told = self._told(events, len(batch)) if any(map(len, events)) else []
        with self._lock:
            self._heard, self._time_ns = time.monotonic(), int(batch.time_ns[-1])
            self._events.extendleft(told)
            if len(counts):
                self._count(counts, statuses)

    def summary(self) -> dict[str, Any]:
        """Return routes by topic, the newest events first, and sums; rates are those of the last second."""
        with self._lock:
            silent = None if self._heard < 0 else time.monotonic() - self._heard
            since_ns = self._time_ns - _STALE_NS
            if silent is not None and silent * SECOND > _STALE_NS:
                since_ns = self._time_ns
            routes = [dict(item) for item in self._routes.values()]
            events = list(self._events)
        for item in routes:
            if item["time_ns"] <= since_ns:
                item["rate_hz"] = 0.0
        routes.sort(key=lambda item: (not item["topic"], item["topic"] or item["msg_id"] or "~"))
        sums: dict[str, Any] = {name: sum(item[name] for item in routes) for name in _SUMS}
        moving = [item for item in routes if item["rate_hz"]]
        drops = self._statistics.kernel_drops if self._statistics else None
        return {
            "time_ns": self._time_ns,
            "silent_s": silent,
            "datagrams": sums["count"],
            "bytes": sums["bytes"],
            "gaps": sums["gaps"],
            "rate_hz": sum(item["rate_hz"] for item in moving),
            "bytes_per_s": sum(item["bytes_per_s"] for item in moving),
            "kernel_drops": drops,
            "routes": routes,
            "events": events,
        }

    def _told(self, events: Sequence[Messages], rows: int) -> list[dict[str, Any]]:
        records = lay_out(events, rows)
        told = []
        for place in range(max(len(records) - _MOST_EVENTS, 0), len(records)):
            cdr = bytes(records.data[records.start[place] : records.end[place]])
            event = self._types.decode(_LOG, cdr)
            named = {"level": event["level"], "app": event["name"], "text": event["msg"]}
            told.append({"time_ns": int(records.log_time[place]), **named})
        return told

    def _count(self, counts: Messages, statuses: Mapping[str, Mapping[str, Any]]) -> None:
        for place, head in enumerate(counts.heads(slice(0, len(counts)))):
            key = int(head["link"]), int(head["msg_id"])
            if key not in self._routes and len(self._routes) >= _MOST_ROUTES:
                key = -1, NO_MSG_ID
            start = int(counts.offset[place])
            topic = bytes(counts.data[start : start + int(counts.length[place])]).rstrip(b"\0").decode()
            row = self._routes.setdefault(key, _route(*key, topic))
            for name in _SUMS:
                row[name] += int(head[name])
            row["rate_hz"], row["bytes_per_s"] = float(head["rate_hz"]), int(head["bytes"])
            row["largest"] = max(row["largest"], int(head["largest"]))
            row["time_ns"] = int(counts.log_time[place])
            status = statuses.get(f"{row['link']}: {row['topic'] or row['msg_id'] or 'no MsgId'}", {})
            row["level"], row["message"] = status.get("level", 0), status.get("message", "")


def _route(link: int, msg_id: int, topic: str) -> dict[str, Any]:
    return {
        "link": table.link(link).label if link >= 0 else "",
        "msg_id": f"0x{msg_id:04x}" if msg_id != NO_MSG_ID else None,
        "topic": topic if topic.startswith("/") and link >= 0 else None,
        "name": (message_name(msg_id) if msg_id != NO_MSG_ID else "") or None,
        **dict.fromkeys((*_SUMS, "largest"), 0),
    }
