"""The state of a link on the server's page: routes with rates, losses and last values, and last events."""

from __future__ import annotations

import threading
import time
from collections import Counter
from operator import itemgetter
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from edoras_tools.cfs.names import message_name
from edoras_tools.decode.spacecraft import FIRST_SPACECRAFT, split_topic
from edoras_tools.decode.summary import short_values
from edoras_tools.errors import EdorasError
from edoras_tools.io.topics.rows import Messages, lay_out
from edoras_tools.links import table
from edoras_tools.model import NO_MSG_ID, Columns, PacketBatch, SourceStatistics
from edoras_tools.units import MILLISECOND, SECOND

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from numpy.typing import NDArray

    from edoras_tools.mission import Mission
    from edoras_tools.ros import TypeStore

_MOST_ROUTES: Final = 500
"""Most rows of routes: garbage may contain any number of MsgIds, and one row sums up the others."""
_MOST_EVENTS: Final = 40
_STALE_NS: Final = 2500 * MILLISECOND
"""Age of a count from which the rate is 0: a route is counted once in a second with traffic."""
_GATHERS_NS: Final = 2 * SECOND
_LOG: Final = "rcl_interfaces/msg/Log"
_SUMS: Final = ("count", "gaps", "bytes")
_BITS: Final = 32


class _LastPacket(NamedTuple):
    """The last packet of a route: its time, ns; its message as CDR, empty if there is none; its route."""

    time_ns: int
    cdr: bytes
    route: int


def route_keys(columns: Columns) -> NDArray[np.int64]:
    """Return spacecraft, link and MsgId of each row as one number, i64 (n,); see ``route_from_key``."""
    code = columns.spacecraft.astype(np.int64) << 8 | columns.link
    return code << _BITS | (columns.msg_id.astype(np.int64) + 1)


def route_from_key(key: int) -> tuple[int, int, int]:
    """Return spacecraft, link and MsgId of a number from ``route_keys``."""
    return key >> _BITS + 8, key >> _BITS & 0xFF, (key & (1 << _BITS) - 1) - 1


class LinkState:
    """Sums up the messages that a sink makes of each batch; any thread may read the sum.

    Args:
        statistics: statistics of the source, for losses of the capture itself; None: it has none.

    Attributes:
        clock: function that returns monotonic time, s.
        wall: function that returns the time, ns since 1970.
    """

    def __init__(self, mission: Mission, types: TypeStore, statistics: SourceStatistics | None) -> None:
        self._mission, self._types, self._statistics = mission, types, statistics
        self.clock: Callable[[], float] = time.monotonic
        self.wall: Callable[[], int] = time.time_ns
        self._lock = threading.Lock()
        self._routes: dict[tuple[int, int, int], dict[str, Any]] = {}
        self._last: dict[tuple[int, int, int], _LastPacket] = {}
        self._came: Counter[tuple[int, int, int]] = Counter()
        self._events: dict[tuple[Any, ...], dict[str, Any]] = {}
        self._time_ns, self._heard = 0, -1.0

    def add(
        self,
        batch: PacketBatch,
        columns: Columns,
        counts: Messages,
        events: Mapping[str, Sequence[Messages]],
        statuses: Mapping[str, Mapping[str, Any]],
    ) -> None:
        """Add a batch of at least one row.

        Args:
            counts: messages of the batch on ``/edoras/link_statistics``.
            events: messages of the batch on ``/edoras/events``: of cFE, of its reset log, of F Prime; by the
                topic prefix of their spacecraft.
            statuses: latest statuses of ``/diagnostics``, by name.
        """
        entries = [
            {**entry, "app": f"{prefix}/{entry['app']}" if prefix else entry["app"]}
            for prefix, own in events.items()
            if any(map(len, own))
            for entry in self._log_entries(own, len(batch))
        ]
        entries.sort(key=itemgetter("time_ns"))
        last, came = self._last_packets(batch, columns)
        with self._lock:
            self._time_ns = int(batch.time_ns[-1])
            age_ns = self.wall() - self._time_ns
            # Live datagrams are gathered for some time; those of a recording, or of another clock, count as
            # new.
            self._heard = self.clock() - (age_ns / SECOND if 0 < age_ns < _GATHERS_NS else 0)
            self._last.update(last)
            self._came.update(came)
            for entry in entries:
                self._add_event(entry)
            if len(counts):
                self._count(counts, statuses)

    def finish(self, counts: Messages) -> None:
        """Count the messages of an incomplete last second; rates are of complete seconds only."""
        with self._lock:
            self._count(counts, None)

    def summary(self) -> dict[str, Any]:
        """Return routes by topic, events by their last time, newest first, and sums.

        Rates are those of the last second; counts include all messages. ``age_s`` is the time since the last
        packet of a route.
        """
        with self._lock:
            silent = None if self._heard < 0 else self.clock() - self._heard
            since_ns = self._time_ns - _STALE_NS
            if silent is not None and silent * SECOND > _STALE_NS:
                since_ns = self._time_ns
            keyed = [
                ({**item, "count": self._came[key] or item["count"]}, self._last.get(key))
                for key, item in self._routes.items()
            ]
            events = [dict(item) for item in reversed(self._events.values())]
            now_ns, came = self._time_ns + int(SECOND * (silent or 0)), self._came.total()
        for item, last in keyed:
            if item["time_ns"] <= since_ns:
                item["rate_hz"] = 0.0
            item["age_s"] = max(0.0, (now_ns - (last.time_ns if last else item["time_ns"])) / SECOND)
            item["value"] = self._value(last) if last else None
        routes = [item for item, _ in keyed]
        routes.sort(key=lambda item: (not item["topic"], item["topic"] or item["msg_id"] or "~"))
        sums: dict[str, Any] = {name: sum(item[name] for item in routes) for name in _SUMS}
        moving = [item for item in routes if item["rate_hz"]]
        drops = self._statistics.kernel_drops if self._statistics else None
        return {
            "time_ns": self._time_ns,
            "silent_s": silent,
            "datagrams": came,
            "bytes": sums["bytes"],
            "gaps": sums["gaps"],
            "rate_hz": sum(item["rate_hz"] for item in moving),
            "bytes_per_s": sum(item["bytes_per_s"] for item in moving),
            "kernel_drops": drops,
            "routes": routes,
            "events": events,
        }

    def _value(self, last: _LastPacket) -> str | None:
        """Return a message in a few words; None if there is none, or if it is not of its route's type."""
        if not last.cdr:
            return None
        try:
            return short_values(self._types.decode(self._mission.routes[last.route].type, last.cdr))
        except EdorasError:
            return None

    @staticmethod
    def _last_packets(
        batch: PacketBatch, columns: Columns
    ) -> tuple[dict[tuple[int, int, int], _LastPacket], dict[tuple[int, int, int], int]]:
        """Return the last packet of each route in a batch, and the number of packets of each."""
        keys = route_keys(columns)
        own, behind, counts = np.unique(keys[::-1], return_index=True, return_counts=True)
        came = dict(zip(map(route_from_key, own.tolist()), counts.tolist(), strict=True))
        packets = {}
        for row in (len(keys) - 1 - behind[:_MOST_ROUTES]).tolist():
            start, route = int(columns.cdr_offset[row]), int(columns.route[row])
            cdr = b""
            if route >= 0 and columns.cdr_length[row] > 0:
                cdr = batch.data[start : start + int(columns.cdr_length[row])].tobytes()
            packets[route_from_key(int(keys[row]))] = _LastPacket(int(batch.time_ns[row]), cdr, route)
        return packets, came

    def _log_entries(self, events: Sequence[Messages], rows: int) -> list[dict[str, Any]]:
        records = lay_out(events, rows)
        entries = []
        for place in range(len(records)):
            cdr = bytes(records.data[records.start[place] : records.end[place]])
            event = self._types.decode(_LOG, cdr)
            texts = {"level": event["level"], "app": event["name"], "text": event["msg"]}
            entries.append({"time_ns": int(records.log_time[place]), **texts})
        return entries

    def _add_event(self, entry: dict[str, Any]) -> None:
        """Count an event under its application and text; the oldest entry of too many is dropped."""
        key = entry["app"], entry["level"], entry["text"]
        earlier = self._events.pop(key, {"count": 0})
        self._events[key] = {**entry, "count": earlier["count"] + 1}
        if len(self._events) > _MOST_EVENTS:
            del self._events[next(iter(self._events))]

    def _count(self, counts: Messages, statuses: Mapping[str, Mapping[str, Any]] | None) -> None:
        for place, head in enumerate(counts.heads(slice(0, len(counts)))):
            start = int(counts.offset[place])
            topic = bytes(counts.data[start : start + int(counts.length[place])]).rstrip(b"\0").decode()
            spacecraft = self._mission.number_of(split_topic(topic)[0]) or FIRST_SPACECRAFT
            key = spacecraft, int(head["link"]), int(head["msg_id"])
            if key not in self._routes and len(self._routes) >= _MOST_ROUTES:
                key = FIRST_SPACECRAFT, -1, NO_MSG_ID
            row = self._routes.setdefault(key, _route(*key, topic))
            for name in _SUMS:
                row[name] += int(head[name])
            row["largest"] = max(row["largest"], int(head["largest"]))
            if statuses is None:
                continue
            row["rate_hz"], row["bytes_per_s"] = float(head["rate_hz"]), int(head["bytes"])
            row["time_ns"] = int(counts.log_time[place])
            status: Mapping[str, Any] = {}
            for name in (row["topic"], row["msg_id"] or "no MsgId"):  # structs have their own topics
                status = status or statuses.get(f"{row['link']}: {name}", {})
            row["level"], row["message"] = status.get("level", 0), status.get("message", "")


def _route(spacecraft: int, link: int, msg_id: int, topic: str) -> dict[str, Any]:
    return {
        "spacecraft": spacecraft,
        "link": table.link(link).label if link >= 0 else "",
        "msg_id": f"0x{msg_id:04x}" if msg_id != NO_MSG_ID else None,
        "topic": topic if topic.startswith("/") and link >= 0 else None,
        "name": (message_name(msg_id) if msg_id != NO_MSG_ID else "") or None,
        **dict.fromkeys((*_SUMS, "largest", "time_ns", "bytes_per_s", "level"), 0),
        "rate_hz": 0.0,
        "message": "",
    }
