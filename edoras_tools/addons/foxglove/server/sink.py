"""Shows live traffic or a recording in Foxglove: sends its topics to connected clients.

Beside the topics: findings as ``diagnostic_msgs/msg/DiagnosticArray``, once a second the state of each route
and link; and for the server's page the state of a link, its routes, rates, losses and last events.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from edoras_tools.addons.foxglove.server.server import FoxgloveServer, ServerOptions
from edoras_tools.cfs.names import message_name
from edoras_tools.io import Sink
from edoras_tools.io.topics.cfe import fault_messages
from edoras_tools.io.topics.recorded import RecordedStreams
from edoras_tools.io.topics.rows import Messages, bodies_of, lay_out
from edoras_tools.io.topics.streams import EVENTS_TOPIC, FAULTS, STATISTICS_TOPIC, TRANSFORMS, Streams, Topic
from edoras_tools.links import table
from edoras_tools.model import NO_MSG_ID, OTHER, Columns, Finding, PacketBatch, SourceStatistics
from edoras_tools.units import MILLISECOND, SECOND
from edoras_tools.wire.cdr import ENCAPSULATION

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from edoras_tools.links.site import Endpoints
    from edoras_tools.mission import Mission
    from edoras_tools.model import SourceInfo
    from edoras_tools.ros import TypeStore
    from edoras_tools.sessions.faults.fault import Fault
    from edoras_tools.structs import Structs


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
        findings = {Finding(1 << bit): int(counts[bit]) for bit in bits}
        level = max((self._levels.get(finding, WARN) for finding in findings), default=OK)
        worst = [item.labels[0] for item in findings if self._levels.get(item, WARN) == level]
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
                    **{item.labels[0]: count for item, count in findings.items()},
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
        events_now = self._log_entries(events, len(batch)) if any(map(len, events)) else []
        with self._lock:
            self._heard, self._time_ns = time.monotonic(), int(batch.time_ns[-1])
            self._events.extendleft(events_now)
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

    def _log_entries(self, events: Sequence[Messages], rows: int) -> list[dict[str, Any]]:
        records = lay_out(events, rows)
        entries = []
        for place in range(max(len(records) - _MOST_EVENTS, 0), len(records)):
            cdr = bytes(records.data[records.start[place] : records.end[place]])
            event = self._types.decode(_LOG, cdr)
            texts = {"level": event["level"], "app": event["name"], "text": event["msg"]}
            entries.append({"time_ns": int(records.log_time[place]), **texts})
        return entries

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
            status: Mapping[str, Any] = {}
            for name in (row["topic"], row["msg_id"] or "no MsgId"):  # structs have their own topics
                status = status or statuses.get(f"{row['link']}: {name}", {})
            row["level"], row["message"] = status.get("level", 0), status.get("message", "")


def _route(link: int, msg_id: int, topic: str) -> dict[str, Any]:
    return {
        "link": table.link(link).label if link >= 0 else "",
        "msg_id": f"0x{msg_id:04x}" if msg_id != NO_MSG_ID else None,
        "topic": topic if topic.startswith("/") and link >= 0 else None,
        "name": (message_name(msg_id) if msg_id != NO_MSG_ID else "") or None,
        **dict.fromkeys((*_SUMS, "largest"), 0),
    }


class ServedSink(Sink):
    """What is shown, or played, over the Foxglove WebSocket protocol: a ``Sink`` that clients cannot delay.

    Attributes:
        server: the server; it listens from construction on.
    """

    server: FoxgloveServer

    def write(self, batch: PacketBatch, columns: Columns) -> None:
        """Send a batch to clients."""
        raise NotImplementedError

    def show_time(self, time_ns: int) -> None:
        """Send a time for the clients' clocks, ns since 1970."""
        self.server.tell_time(time_ns)

    @property
    def addresses(self) -> tuple[str, str]:
        """See ``DisplaySink``."""
        return self.server.app_url, self.server.page_url

    def restart(self) -> None:
        """Reset the statistics, if there are any, because the following messages have other times."""

    def flush(self) -> None:
        """Do nothing: there is no buffer."""

    def close(self, statistics: SourceStatistics) -> None:  # noqa: ARG002  required by Sink
        """Close all clients."""
        self.server.close()

    def summary(self) -> dict[str, Any]:
        """Return counts of the messages; see ``FoxgloveServer.summary``."""
        return self.server.summary()


class RecordedSink(ServedSink):
    """Serves the messages of a recording.

    Args:
        types: provides the schemas that the recording does not hold.

    Raises:
        CaptureError: the address cannot be used.
        ConfigError: ``websockets`` is not installed.
    """

    def __init__(self, mission: Mission, types: TypeStore, info: SourceInfo, options: ServerOptions) -> None:
        self._streams = RecordedStreams(mission, types)
        self.server = FoxgloveServer(f"edoras: {info.name}", self._streams.topics, lambda _: "", options)

    def write(self, batch: PacketBatch, columns: Columns) -> None:
        """Send a batch to clients."""
        if len(batch) and self.server.clients:
            prepared = self._streams.prepare(batch, columns)
            self.server.publish(
                lay_out(self._streams.prepared_messages(batch, columns, prepared), len(batch))
            )
            self.show_time(int(batch.time_ns[-1]))


class FoxgloveSink(ServedSink):
    """Serves batches over the Foxglove WebSocket protocol: a ``Sink`` that clients cannot delay.

    Topics, types and messages are those of a recording, plus ``/diagnostics`` and ``/tf``. All are
    offered from the start, also those that a recording has only with their first message, and those of DDS
    once they are announced: who subscribes to what is offered misses nothing. Whole datagrams and ``/tf`` are
    only made for clients that subscribed.

    Args:
        mission: its routes become topics.
        info: of the source; gives the server its name.
        levels: the level of each finding in the diagnostics: 0 OK, 1 warning, 2 error.
        statistics: the source's, for losses of the capture itself.
        structs: C structs in packets; None: only cFE's own.
        endpoints: of DDS, as the decoder learns them; None: their samples are not sent.

    Raises:
        CaptureError: the address cannot be used.
        ConfigError: ``websockets`` is not installed.
        RouteError: a route's type is unknown.
    """

    def __init__(
        self,
        mission: Mission,
        types: TypeStore,
        info: SourceInfo,
        options: ServerOptions = ServerOptions(),  # noqa: B008  frozen
        *,
        levels: Mapping[Finding, int] | None = None,
        statistics: SourceStatistics | None = None,
        structs: Structs | None = None,
        endpoints: Endpoints | None = None,
    ) -> None:
        self._mission, self._types, self._info = mission, types, info
        self._levels, self._counted = levels or {}, statistics
        self._structs, self._endpoints = structs, endpoints
        self._begin()
        bound = [Topic(item.topic, item.type, item.metadata) for item in self._streams.structs.all]
        own = [DIAGNOSTICS, FAULTS]
        if all(topic.name != TRANSFORMS.name for topic in self._streams.topics):
            own.append(TRANSFORMS)
        topics = [*self._streams.topics, *own, *bound]
        self._places = {topic.name: place for place, topic in enumerate(topics)}
        definitions = {
            **self._streams.definitions,
            **{item.type: types.definition(item.type) for item in (DIAGNOSTICS, FAULTS, TRANSFORMS)},
            **{
                item.type: self._streams.structs.types.definition(item.type)
                for item in self._streams.structs.all
            },
        }
        self.server = FoxgloveServer(
            f"edoras: {info.name}",
            topics,
            lambda name: definitions.get(name) or types.definition(name),
            options,
        )
        self._streams.offer()
        self.server.link_state = lambda: self._link.summary()  # noqa: PLW0108  there is a new one after a jump

    def write(self, batch: PacketBatch, columns: Columns) -> None:
        """Send a batch to clients."""
        if not len(batch):
            return
        self._streams.offer()
        # Whole datagrams are the first topic, and the most expensive.
        streams = self._streams.messages(
            batch,
            columns,
            datagrams=self.server.has_subscribers(0),
            transforms=self.server.has_subscribers(self._places[TRANSFORMS.name]),
        )
        own: dict[int, list[Messages]] = {}
        for item in streams:
            if isinstance(item.channel_id, int):
                own.setdefault(item.channel_id, []).append(item)
        streams.append(self._diagnostics.messages(batch, columns, self._places[DIAGNOSTICS.name]))
        counts, events = (own[self._places[name]] for name in (STATISTICS_TOPIC, EVENTS_TOPIC))
        self._link.add(batch, counts[-1], events, self._diagnostics.latest)
        if self.server.clients:
            self.server.publish(lay_out(streams, len(batch)))
            self.show_time(int(batch.time_ns[-1]))

    def write_faults(self, faults: Sequence[Fault]) -> None:
        """Send injected faults, with times in ns since 1970."""
        if self.server.clients:
            self.server.publish(lay_out([fault_messages(faults, self._places[FAULTS.name])], len(faults)))

    def restart(self) -> None:
        """Reset the statistics, because the following messages have other times."""
        self._begin()

    def _offer(self, topic: Topic) -> int:
        """Return the place of a topic; of one that only the content names, after it is offered to clients."""
        if topic.name not in self._places:
            self._places[topic.name] = self.server.add(topic)
        return self._places[topic.name]

    def _begin(self) -> None:
        self._streams = Streams(
            self._mission,
            self._types,
            self._counted,
            structs=self._structs,
            add=self._offer,
            transforms=True,
        )
        self._streams.endpoints = self._endpoints
        self._link = LinkState(self._types, self._counted)
        self._diagnostics = Diagnostics(
            self._mission, self._types, self._info.name, self._levels, self._counted
        )
