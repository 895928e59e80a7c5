"""Shows live traffic or a recording in Foxglove: sends its topics to connected clients.

Besides the topics it sends findings as ``diagnostic_msgs/msg/DiagnosticArray``: once a second the state of
each route and link. The server's page gets the state of a link: its routes, rates, losses and last events.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from edoras_tools.addons.foxglove.server import link_state
from edoras_tools.addons.foxglove.server.server import FoxgloveServer, ServerOptions
from edoras_tools.decode.spacecraft import FIRST_SPACECRAFT
from edoras_tools.diagnosis.examination import Examination
from edoras_tools.io import Sink
from edoras_tools.io.topics.edoras import fault_messages
from edoras_tools.io.topics.messages import Messages, bodies_of, lay_out
from edoras_tools.io.topics.streams import (
    EVENTS_TOPIC,
    FAULTS,
    STATISTICS_TOPIC,
    TRANSFORMS,
    RecordedStreams,
    Streams,
    Topic,
)
from edoras_tools.links import table
from edoras_tools.model import NO_MSG_ID, OTHER, Columns, Finding, PacketBatch, SourceInfo, SourceStatistics
from edoras_tools.sessions.sequence import SequenceCounts
from edoras_tools.units import SECOND
from edoras_tools.wire.envelope import ENCAPSULATION

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.decode import Context
    from edoras_tools.mission import Mission
    from edoras_tools.ros import TypeStore
    from edoras_tools.sessions.faults.rules import Fault


DIAGNOSTICS: Final = Topic("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray")

OK: Final = 0
WARN: Final = 1
ERROR: Final = 2
_LEVELS: Final = {"warning": WARN, "error": ERROR}
"""Severities of the doctor that are not OK."""
_SAID: Final = "lost", "remedy", "promise"
_MOST: Final = 256
"""Most statuses: garbage may contain any number of MsgIds; further ones share one status."""
_BITS: Final = 32
_PROMPT_S: Final = 0.2
"""Time to gather datagrams if a client has subscribed to their topics, s."""
_CALM_S: Final = 0.95
"""The same time if only browsers read, once a second: a batch costs as much as 1000 datagrams."""
_ALL: Final = 0.95
"""Share of delivered messages above which the rates in front of and behind a route count as equal."""


class Diagnostics:
    """Counts the findings of batches; makes a message for each second of capture time that has traffic.

    A status is for a route, or for a MsgId of a link: its level is the worst finding of that second.

    Args:
        name: name of the source.
        levels: the level of each finding: OK, WARN or ERROR.
        statistics: statistics of the source, for losses of the capture itself.

    Attributes:
        latest: statuses of the last message, by name.
        judgement: judgement of ``LiveDiagnosis``; its problems become statuses too.
    """

    def __init__(
        self,
        mission: Mission,
        types: TypeStore,
        name: str,
        levels: Mapping[Finding, int],
        statistics: SourceStatistics | None = None,
    ) -> None:
        self._mission, self._mission_of = mission, cache(mission.of)
        self._routes = {(int(route.link), route.msg_id): place for place, route in enumerate(mission.routes)}
        self._types, self._name, self._levels, self._statistics = types, name, levels, statistics
        self._drops = (statistics.kernel_drops or 0) if statistics else 0
        self._counts: dict[tuple[int, int, int], NDArray[np.int64]] = {}
        self._until = 0
        self.latest: dict[str, dict[str, Any]] = {}
        self.judgement: Mapping[str, Any] | None = None

    def messages(
        self, batch: PacketBatch, columns: Columns, channel_id: int, *, wants: bool = True
    ) -> Messages:
        """Add a batch of at least one row; return the message of a second, if the batch completes one.

        Args:
            wants: whether a client receives it; else only ``latest`` is set.
        """
        end = int(batch.time_ns[-1])
        self._until = self._until or int(batch.time_ns[0]) + SECOND
        self._add(batch, columns)
        if end >= self._until:
            self._until = end + SECOND - (end - self._until) % SECOND
            statuses = self._statuses()
            self.latest = {item["name"]: item for item in statuses}
            if wants:
                return self._message(statuses, end, channel_id, len(batch) - 1)
        return bodies_of([], [], channel_id)

    def _add(self, batch: PacketBatch, columns: Columns) -> None:
        findings = columns.findings | batch.capture_findings
        keys, which = np.unique(link_state.route_keys(columns), return_inverse=True)
        table = np.zeros((len(keys), _BITS + 1), np.int64)
        table[:, _BITS] = np.bincount(which)
        for bit in np.flatnonzero(np.bitwise_or.reduce(findings) >> np.arange(_BITS) & 1).tolist():
            table[:, bit] = np.bincount(which[findings >> bit & 1 != 0], minlength=len(keys))
        for value, counts in zip(keys.tolist(), table, strict=True):
            owner = link_state.route_from_key(value)
            if owner not in self._counts and len(self._counts) >= _MOST:
                owner = (FIRST_SPACECRAFT, int(OTHER), NO_MSG_ID)
            self._counts[owner] = self._counts.get(owner, 0) + counts

    def _statuses(self) -> list[dict[str, Any]]:
        """Return the statuses of the second that ends, and begin the next."""
        statuses = [self._status(*owner, counts) for owner, counts in sorted(self._counts.items())]
        if self._statistics is not None:
            statuses.insert(0, self._capture(self._statistics))
        if self.judgement is not None:
            statuses[:0] = self._doctor_statuses(self.judgement)
        self._counts.clear()
        return statuses

    def _message(self, statuses: list[dict[str, Any]], time_ns: int, channel_id: int, row: int) -> Messages:
        stamp = dict(zip(("sec", "nanosec"), divmod(time_ns, SECOND), strict=True))
        values = {"header": {"stamp": stamp, "frame_id": ""}, "status": statuses}
        body = self._types.encode(DIAGNOSTICS.type, values)[ENCAPSULATION.size :]
        return bodies_of([body], [time_ns], channel_id, np.array([row]))

    def _entry(self, level: int, name: str, message: str, figures: Mapping[str, object]) -> dict[str, Any]:
        values = [{"key": key, "value": str(value)} for key, value in figures.items()]
        return {"level": level, "name": name, "message": message, "hardware_id": self._name, "values": values}

    def _status(self, spacecraft: int, link: int, msg_id: int, counts: NDArray[np.int64]) -> dict[str, Any]:
        label = table.link(link).label
        bits = np.flatnonzero(counts[:_BITS]).tolist()
        findings = {Finding(1 << bit): int(counts[bit]) for bit in bits}
        level = max((self._levels.get(finding, WARN) for finding in findings), default=OK)
        worst = [item.labels[0] for item in findings if self._levels.get(item, WARN) == level]
        place = self._routes.get((link, msg_id))
        name = f"0x{msg_id:04x}" if msg_id != NO_MSG_ID else "no MsgId"
        own = self._mission.own_name(f"{label}/{name}", spacecraft)
        topic = own if spacecraft != FIRST_SPACECRAFT else ""
        if place is not None:
            topic = self._mission_of(spacecraft).routes[place].topic
        own_counts = {item.labels[0]: count for item, count in findings.items()}
        figures = {"msg_id": name, "datagrams": int(counts[_BITS]), **own_counts}
        return self._entry(level, f"{label}: {topic or name}", ", ".join(worst) if level else "OK", figures)

    def _doctor_statuses(self, judgement: Mapping[str, Any]) -> list[dict[str, Any]]:
        """Return statuses for the doctor's total, and for each problem."""
        level = _LEVELS.get(judgement["worst"], OK)
        figures = {name: judgement[name] for name in link_state.JUDGED_FIGURES}
        statuses = [self._entry(level, "doctor", judgement["headline"], figures)]
        for place, item in enumerate(judgement["problems"], 1):
            name = f"doctor: {', '.join(item['rules']) or 'loss'} {place}"
            figures = {key: item[key] for key in _SAID if item[key] is not None}
            statuses.append(self._entry(_LEVELS.get(item["severity"], OK), name, item["text"], figures))
        return statuses

    def _capture(self, statistics: SourceStatistics) -> dict[str, Any]:
        drops = statistics.kernel_drops or 0
        lost, self._drops = drops - self._drops, drops
        shown_drops = "not told" if statistics.kernel_drops is None else drops
        figures = {"kernel_drops": shown_drops, "skipped": statistics.skipped}
        message = f"{lost} packets lost by the capture itself" if lost else "OK"
        return self._entry(ERROR if lost else OK, "capture", message, figures)


class LinkMonitor:
    """The live view of a link: its topics, its state, and the doctor's judgement.

    Topics, types and messages are those of a recording, plus ``/diagnostics`` and ``/tf``; topics of DDS are
    added when they are announced.

    Args:
        context: context of the decoder; the routes of its mission become topics.
        name: name of the source.
        levels: level of each finding in the diagnostics: 0 OK, 1 warning, 2 error.
        statistics: statistics of the source, for losses of the capture itself.
        offer: offers another topic to clients, and returns its index; by default it gets the next one, and
            adding batches waits for judgements.
        live: whether time goes on without traffic; else ages are those at the end of a capture.

    Attributes:
        topics: topics that exist from the start.
        sequences: sequence counts of everything added since the last ``restart``.
        definitions: complete texts of types that are not in ``types``.

    Raises:
        RouteError: a route's type is unknown.
    """

    def __init__(
        self,
        context: Context,
        types: TypeStore,
        name: str,
        levels: Mapping[Finding, int],
        statistics: SourceStatistics | None,
        offer: Callable[[Topic], int] | None = None,
        *,
        live: bool = True,
    ) -> None:
        self._context, self._types, self._name = context, types, name
        self._levels, self._counted = levels, statistics
        self._alone, self._add = offer is None, offer or (lambda _: len(self._places))
        self._live = live
        self._begin()
        bound = self._streams.structs.all
        own = [DIAGNOSTICS, FAULTS]
        if all(topic.name != TRANSFORMS.name for topic in self._streams.topics):
            own.append(TRANSFORMS)
        own += [Topic(item.topic, item.type, item.metadata) for item in bound]
        self.topics = [*self._streams.topics, *own]
        self.definitions = {
            **self._streams.definitions,
            **{item.type: self._streams.structs.text(item.type) or "" for item in bound},
        }
        self._places = {topic.name: place for place, topic in enumerate(self.topics)}

    def place(self, topic: Topic) -> int:
        """Return the index of a topic; a topic that only the content names is offered first."""
        if topic.name not in self._places:
            self._places[topic.name] = self._add(topic)
        return self._places[topic.name]

    def offer(self) -> None:
        """Offer the topics that the content has named so far."""
        self._streams.offer()

    def add(
        self, batch: PacketBatch, columns: Columns, wants: Callable[[int], bool] = lambda _: False
    ) -> list[Messages]:
        """Add a batch of at least one row; return its messages.

        Args:
            wants: whether a client receives the topic of an index. Whole datagrams, which are the first
                topic and the most expensive, and ``/tf`` are only made for clients; without any client, only
                the messages that are counted here.
        """
        self.offer()
        self._streams.all_wanted = any(map(wants, self._places.values()))
        moves = wants(self._places[TRANSFORMS.name])
        streams = self._streams.messages(batch, columns, datagrams=wants(0), transforms=moves)
        own: dict[int, list[Messages]] = {}
        for item in streams:
            if isinstance(item.channel_id, int):
                own.setdefault(item.channel_id, []).append(item)
        self._doctor.add(batch, columns)
        diagnostics = self._places[DIAGNOSTICS.name]
        if diagnoses := wants(diagnostics):
            self._diagnostics.judgement = self._doctor.ask()
        streams.append(self._diagnostics.messages(batch, columns, diagnostics, wants=diagnoses))
        logs = {name: own.get(place) for name, place in self._places.items() if name.endswith(EVENTS_TOPIC)}
        events = {name.removesuffix(EVENTS_TOPIC): items for name, items in logs.items() if items}
        counts = own[self._places[STATISTICS_TOPIC]][-1]
        self._link.add(batch, columns, counts, events, self._diagnostics.latest)
        return streams

    def finish(self) -> None:
        """Count the messages of the last second, which no other second follows."""
        self._link.finish(self._streams.finish())

    def state(self) -> dict[str, Any]:
        """Return the state for people: ``LinkState.summary``, with the doctor's figures for the routes.

        ``passed_hz`` of a route is the rate that passes on, if it is lower; ``sent_hz``, for a route that is
        captured at its output, is the rate of publishing.
        """
        state, doctor = self._link.summary(), self._doctor.ask()
        fates = {_route_key(item): item for item in (doctor or {}).get("routes", ())}
        for item in state["routes"]:
            fate = fates.get(_route_key(item))
            item["lost"] = fate["lost"] + fate["unaccounted"] if fate else item["gaps"]
            item["uncertain"] = fate["uncertain"] if fate else 0
            item["sent_hz"] = item["passed_hz"] = None
            share = fate["out"] / fate["in"] if fate and fate["in"] else 1.0
            if fate and 0 < share <= _ALL and item["rate_hz"]:
                name, factor = ("passed_hz", share) if fate["seen_going_in"] else ("sent_hz", 1 / share)
                item[name] = item["rate_hz"] * factor
        return {**state, "doctor": doctor}

    def restart(self) -> None:
        """Start afresh, because the following messages have other times."""
        self._doctor.close()
        self._begin()

    def close(self) -> None:
        """Stop judging."""
        self._doctor.close()

    def _begin(self) -> None:
        context, counters = self._context, self._counted
        self.sequences = SequenceCounts()
        own: dict[str, Any] = {"structs": context.structs, "add": self.place, "sequences": self.sequences}
        self._streams = Streams(context.mission, self._types, counters, transforms=True, **own)
        self._streams.endpoints = context.endpoints
        self._link = link_state.LinkState(context.mission, self._types, counters)
        if not self._live:
            self._link.clock = lambda: 0.0
        self._diagnostics = Diagnostics(context.mission, self._types, self._name, self._levels, counters)
        self._doctor = link_state.LiveDiagnosis(partial(Examination, context), counters)
        self._doctor.waits = self._alone


def _route_key(row: Mapping[str, Any]) -> tuple[Any, ...]:
    return row["spacecraft"], row["link"], row["msg_id"]


class ServedSink(Sink):
    """A ``Sink`` that shows or plays traffic over the Foxglove WebSocket protocol; clients cannot delay it.

    Attributes:
        server: the server; it listens from construction on.
    """

    server: FoxgloveServer

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

    def close(self, statistics: SourceStatistics) -> None:
        """Close all clients."""
        self.server.close()

    def summary(self) -> dict[str, Any]:
        """Return counts of the messages; see ``FoxgloveServer.summary``."""
        return self.server.summary()


class RecordedSink(ServedSink):
    """Serves the messages of a recording.

    Args:
        types: schemas that the recording does not contain.

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
            messages = self._streams.prepared_messages(batch, columns, self._streams.prepare(batch, columns))
            self.server.publish(lay_out(messages, len(batch)))
            self.show_time(int(batch.time_ns[-1]))


class FoxgloveSink(ServedSink):
    """Serves batches over the Foxglove WebSocket protocol: a ``Sink`` that clients cannot delay.

    The topics are those of ``LinkMonitor``. All are offered from the start, including those that a recording
    has only from their first message on: a client that subscribes to an offered topic misses nothing.

    Args:
        context: see ``LinkMonitor``.
        info: info of the source; it gives the server its name.
        levels: see ``LinkMonitor``.
        statistics: see ``LinkMonitor``.

    Attributes:
        pace: called with the time that datagrams may be gathered from now on, s.

    Raises:
        CaptureError: the address cannot be used.
        ConfigError: ``websockets`` is not installed.
        RouteError: a route's type is unknown.
    """

    def __init__(
        self,
        context: Context,
        types: TypeStore,
        info: SourceInfo,
        options: ServerOptions = ServerOptions(),  # noqa: B008  frozen
        *,
        levels: Mapping[Finding, int] | None = None,
        statistics: SourceStatistics | None = None,
    ) -> None:
        def offer(topic: Topic) -> int:
            return self.server.add(topic)

        self._monitor = LinkMonitor(context, types, info.name, levels or {}, statistics, offer)
        self.sequences = self._monitor.sequences
        self.pace: Callable[[float], None] = lambda _: None
        definitions = self._monitor.definitions
        self.server = FoxgloveServer(
            f"edoras: {info.name}",
            self._monitor.topics,
            lambda name: definitions[name] if name in definitions else types.definition(name),
            options,
        )
        self._monitor.offer()
        self.server.link_state = self._monitor.state

    def write(self, batch: PacketBatch, columns: Columns) -> None:
        """Send a batch to clients."""
        if not len(batch):
            return
        self.pace(_PROMPT_S if self.server.subscriptions else _CALM_S)
        streams = self._monitor.add(batch, columns, self.server.has_subscribers)
        self.server.changed()
        if self.server.clients:
            self.server.publish(lay_out(streams, len(batch)))
            self.show_time(int(batch.time_ns[-1]))

    def write_faults(self, faults: Sequence[Fault]) -> None:
        """Send injected faults, with times in ns since 1970."""
        if self.server.clients:
            place = self._monitor.place(FAULTS)
            self.server.publish(lay_out([fault_messages(faults, place)], len(faults)))

    def restart(self) -> None:
        """Reset the statistics, because the following messages have other times."""
        self._monitor.restart()

    def close(self, statistics: SourceStatistics) -> None:
        """Close all clients, and stop judging."""
        super().close(statistics)
        self._monitor.close()
