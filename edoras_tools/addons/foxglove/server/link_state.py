"""What the server's page shows of a link: its state, and the doctor's judgement, made beside a sink.

The state has routes with rates, losses and last values, and the last events. The doctor judges all messages
so far repeatedly, while somebody reads the result. Its rules:

1. Adding a batch never waits for a judgement: batches wait in a queue.
2. After a judgement it pauses 149 times as long as it judged; 9 times if no traffic arrives any more; not at
   all after the first one, which also loads modules. It does not judge while nobody asks, or nothing arrived.
3. If the queue grows beyond its limit, judging starts afresh from there, and ``since_ns`` has that time.
"""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from operator import itemgetter
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from edoras_tools.cfs.names import message_name
from edoras_tools.decode.spacecraft import FIRST_SPACECRAFT, split_topic
from edoras_tools.decode.summary import short_values
from edoras_tools.diagnosis.case import Capture
from edoras_tools.diagnosis.ledger import SEEN, Row
from edoras_tools.diagnosis.summary import Problem, summarize
from edoras_tools.diagnosis.verdict import Severity
from edoras_tools.errors import EdorasError
from edoras_tools.io.topics.messages import Messages, lay_out
from edoras_tools.links import table
from edoras_tools.links.table import link_of_label
from edoras_tools.model import NO_MSG_ID, Columns, Link, PacketBatch, SourceStatistics
from edoras_tools.pipelines.capture.record import ROW_BYTES, compact, join
from edoras_tools.units import MILLISECOND, SECOND

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.diagnosis.balance import WaySum
    from edoras_tools.diagnosis.examination import Diagnosis, Examination
    from edoras_tools.diagnosis.missing import Missing
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


_Key = tuple[int, int, int]
"""Spacecraft, link and MsgId."""


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
        self._routes: dict[_Key, dict[str, Any]] = {}
        self._last: dict[_Key, _LastPacket] = {}
        self._came: Counter[_Key] = Counter()
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
    ) -> tuple[dict[_Key, _LastPacket], dict[_Key, int]]:
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


_EVERY_S: Final = 1.0
_PAUSE: Final = 149
"""Pause after a judgement, as a multiple of its time."""
_QUIET_PAUSE: Final = 9
"""The multiple if nothing arrived for ``_QUIET_S``."""
_QUIET_S: Final = 2.0
_SHORT_PAUSE: Final = 3
"""The multiple if adding batches waits (``waits``)."""
_ASKED_S: Final = 10.0
"""Time after the last question until judging stops, s."""
_MOST_WAITING: Final = 64 << 20
"""Size of the queue from which judging starts afresh, bytes."""
_TOGETHER: Final = 8 << 20
"""Size from which the queue is taken, bytes: taking few datagrams costs almost as much as taking many."""
_MOST_LISTED: Final = 50
JUDGED_FIGURES: Final = "datagrams", "lost", "unaccounted", "uncertain", "messages_lost", "messages_uncertain"
"""Totals of a diagnosis."""
_HOP_SUMS: Final = "came", "out", "all_lost"
_FIGURES: Final = ("duplicated", "superseded", "waiting", "unaccounted", "uncertain")


class LiveDiagnosis:
    """Judges everything added so far; any thread may add and ask.

    Args:
        begin: function that makes an examination.
        statistics: statistics of the source, for losses of the capture itself.

    Attributes:
        waits: whether adding a batch waits for a judgement, in place of rules 1 and 3, and judging takes up
            to a quarter of the time: for a single local user without a server.
    """

    waits = False

    def __init__(self, begin: Callable[[], Examination], statistics: SourceStatistics | None = None) -> None:
        self._news = True
        self._begin, self._statistics = begin, statistics
        self._examination = self._fresh()
        self._judging, self._state = threading.Lock(), threading.Lock()
        self._queue: list[tuple[PacketBatch, Columns]] = []
        self._queue_bytes = 0
        self._thread: threading.Thread | None = None
        self._stop = threading.Event()
        self._last_question = self._added = 0.0
        self._since_ns: int | None = None
        self._latest: dict[str, Any] | None = None
        self._before: tuple[int, Mapping[Any, int]] = 0, {}

    def add(self, batch: PacketBatch, columns: Columns) -> None:
        """Add a batch of at least one row; it must not be changed afterwards."""
        part = compact(batch, columns)
        with self._state:
            self._added = time.monotonic()
            self._queue.append(part)
            self._queue_bytes += len(part[0].data) + ROW_BYTES * len(batch)
            enough = self._queue_bytes >= _TOGETHER
        if enough and self._judging.acquire(blocking=self.waits):
            try:
                self._take_queue()
            finally:
                self._judging.release()

    def ask(self) -> dict[str, Any] | None:
        """Return the latest judgement for the page, None before the first; keep judging for some time."""
        with self._state:
            self._last_question = time.monotonic()
            if self._thread is None and not self._stop.is_set():
                self._thread = threading.Thread(target=self._run, name="doctor", daemon=True)
                self._thread.start()
            return self._latest

    def close(self) -> None:
        """Stop judging."""
        self._stop.set()
        with self._state:
            thread = self._thread
        if thread is not None:
            thread.join()

    def _fresh(self) -> Examination:
        examination = self._begin()
        examination.listing, examination.latest, examination.accounting = True, _MOST_LISTED, False
        return examination

    def _run(self) -> None:
        wait = ended = cost = 0.0
        while not self._stop.wait(wait):
            wait, now = _EVERY_S, time.monotonic()
            with self._state:
                if now - self._last_question > _ASKED_S:
                    self._thread = None
                    return
                usual = _QUIET_PAUSE if now - self._added > _QUIET_S else _PAUSE
            if now - ended < cost * (_SHORT_PAUSE if self.waits else usual):
                continue
            began, first = time.thread_time(), self._latest is None
            with self._judging:
                self._take_queue()
                came, self._news = self._news, False
                diagnosis = self._examination.diagnose(self._capture()) if came else None
            if diagnosis is not None and diagnosis.datagrams:
                latest = {"since_ns": self._since_ns, **_page_values(diagnosis)}
                self._add_rates(latest)
                with self._state:
                    self._latest = latest
            ended, cost = time.monotonic(), 0.0 if first else time.thread_time() - began

    def _add_rates(self, latest: dict[str, Any]) -> None:
        """Add the rate of each hop's output since the previous judgement, per second."""
        until_ns, before = self._before
        passed, outs = (latest["until_ns"] - until_ns) / SECOND, {}
        for flow in latest["flows"]:
            way = flow["spacecraft"], flow["link"], *(hop["hop"] for hop in flow["hops"])
            for place, hop in enumerate(flow["hops"]):
                outs[key := (*way, place)] = hop["out"]
                has_rate = key in before and passed > 0
                hop["rate_hz"] = max(0.0, (hop["out"] - before[key]) / passed) if has_rate else None
        self._before = latest["until_ns"], outs

    def _take_queue(self) -> None:
        """Take the queue, as one batch."""
        with self._state:
            parts, size = self._queue, self._queue_bytes
            self._queue, self._queue_bytes = [], 0
        if size > _MOST_WAITING:
            parts = parts[-1:]
            self._examination = self._fresh()
            self._since_ns = int(parts[0][0].time_ns[0])
        if parts:
            self._news = True
            self._examination.add(*join(parts))

    def _capture(self) -> Capture:
        if (source := self._statistics) is None:
            return Capture()
        outages = tuple(source.outages)
        return Capture(source.kernel_drops, tuple(source.warnings), None, source.passed_over, outages)


def _page_values(diagnosis: Diagnosis) -> dict[str, Any]:
    """Return a diagnosis in the shape of the page; figures are ledger sums, as in ``doctor --json``."""
    summary = summarize(diagnosis)
    return {
        "until_ns": diagnosis.end_ns,
        **{name: getattr(diagnosis, name) for name in JUDGED_FIGURES},
        "worst": diagnosis.worst.label,
        "headline": summary.headline,
        "fine": summary.fine,
        "problems": [_problem(item, diagnosis) for item in summary.problems if item.severity > Severity.NOTE],
        "flows": _flows(diagnosis.ways, diagnosis.topics),
        "routes": _routes(diagnosis.ways),
    }


def _routes(ways: Iterable[WaySum]) -> list[dict[str, Any]]:
    """Return the figures of each route, summed over all runs of its cFS."""
    routes: dict[tuple[int, str, int | None], Counter[str]] = {}
    for way in ways:
        first, values = way.hops[0], way.as_json(None)
        figures = {name: value for name, value in values.items() if isinstance(value, int)}
        key = first.spacecraft or FIRST_SPACECRAFT, first.link, first.msg_id
        routes.setdefault(key, Counter()).update(figures, seen_going_in=first.counted.get("in") == SEEN)
    return [
        {
            **figures,
            "spacecraft": spacecraft,
            "link": link,
            "msg_id": None if msg_id is None else f"0x{msg_id:04x}",
        }
        for (spacecraft, link, msg_id), figures in routes.items()
    ]


def _problem(problem: Problem, diagnosis: Diagnosis) -> dict[str, Any]:
    """Return a problem with the latest of the messages that it lost."""
    about = {(item.link, item.msg_id) for item in problem.verdicts if item.msg_id is not None}
    every = diagnosis.parts.get(problem.spacecraft, diagnosis).missing if problem.lost else ()
    shared = (item for item in problem.verdicts if item.lost and item.msg_id is None)
    spans = [(item.link or "", item.start_ns, item.end_ns) for item in shared]

    def tells(item: Missing) -> bool:
        times = (link == item.link and at <= item.until_ns and item.time_ns <= end for link, at, end in spans)
        return (item.link, item.msg_id) in about or any(times)

    lost = [*filter(tells, every)]
    return {
        **problem.as_json(),
        "promise": problem.promise or None,
        "since_ns": min((item.start_ns for item in problem.verdicts), default=None),
        "until_ns": max((item.end_ns for item in problem.verdicts), default=None),
        "evidence": list(dict.fromkeys(line for item in problem.verdicts for line in item.evidence))[:12],
        "messages": [item.as_json() for item in lost[-_MOST_LISTED:]],
    }


def _flows(ways: Iterable[WaySum], topics: Mapping[int, str]) -> list[dict[str, Any]]:
    """Return the traffic through the same hops, summed up hop by hop: losses first, then uplinks."""
    groups: dict[tuple[int, str, tuple[str, ...]], list[tuple[Row, ...]]] = {}
    for way in ways:
        first = way.hops[0]
        key = first.spacecraft or FIRST_SPACECRAFT, first.link, tuple(row.hop for row in way.hops)
        groups.setdefault(key, []).append(way.hops)
    flows = []
    for (spacecraft, link, hops), members in groups.items():
        names = {topics.get(first.route) or first.topic or first.name for first, *_ in members}
        ids = {own for first, *_ in members for own in (first.msg_id, *(item[1] for item in first.among))}
        names = names if any(names) else {f"0x{own:04x}" for own in ids if own is not None}
        columns = zip(*members, strict=True)
        rows = [_hop(hop, rows) for hop, rows in zip(hops, columns, strict=True)]
        ends = _ends(link_of_label(link), hops[0]) if link else ("", "")  # rows of a shared counter have none
        facts = {"spacecraft": spacecraft, "link": link, "names": sorted(filter(None, names)), "ends": ends}
        flows.append({**facts, "hops": rows})
    return sorted(flows, key=lambda item: (-sum(hop["lost"] for hop in item["hops"]), item["link"]))


def _ends(link: Link, first: str) -> tuple[str, str]:
    """Return the names of the ends before the first hop and behind the last one, if the link has them."""
    if link.only_to_cfs:
        return "ground", ""
    if link.only_from_cfs:
        return "", "ground"
    peer = f"{link.name} peer" if link.peers else ""
    return ("", peer) if first.startswith(link.name) else (peer, "")


def _hop(hop: str, rows: Iterable[Row]) -> dict[str, Any]:
    rows = list(rows)
    came, out, lost, *rest = (sum(getattr(row, name) for row in rows) for name in (*_HOP_SUMS, *_FIGURES))
    return {"hop": hop, "in": came, "out": out, "lost": lost, **dict(zip(_FIGURES, rest, strict=True))}
