"""Runs all bridges in one thread, which sleeps until a datagram, a message or a deadline comes.

A ``Station`` is one running bridge: its socket towards cFS, its node in the ROS 2 graph, the state machine in
between.

``Inbox`` is the queue from the threads of a middleware to the one thread that runs the bridges.
"""

from __future__ import annotations

import os
import select
import socket
import time
from collections import defaultdict, deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from itertools import islice
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec
import numpy as np

from edoras_tools.errors import CaptureError, EdorasError, OnFailure, RouteError
from edoras_tools.io.frames.frame_batch import ends_of
from edoras_tools.io.net.buffer import SLOTS, SPARE, DatagramBuffer, make_buffer
from edoras_tools.io.net.sockets import (
    ANY_ADDRESS,
    address_of,
    host_of,
    kernel_drops,
    local_endpoint,
    open_bound,
    own_address,
)
from edoras_tools.io.net.transmit import Direction, Outlet
from edoras_tools.middleware import Graph, Qos, open_graph
from edoras_tools.middleware.graph import TopicState
from edoras_tools.mission import GroundLink, Route
from edoras_tools.model import Endpoint, Peer
from edoras_tools.pipelines.bridge.plan import BridgePlan, BridgeRequest, StationPlan, qos_of, sizes_of
from edoras_tools.pipelines.reading import on_interrupt, threads_take_turns, watched
from edoras_tools.sessions import bridge
from edoras_tools.sessions.bridge import PacketWriter
from edoras_tools.wire import cfe
from edoras_tools.wire.arrays import by_key
from edoras_tools.wire.envelope import DEFAULT

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.pipelines.recorder import RelayRecorder
    from edoras_tools.render.terminal.text import Watcher

_QUEUE_BYTES: Final = 4 << 20
_TURNS: Final = 4
"""Times that a busy socket is read before the other bridges run."""
_COUNT_NS: Final = 500_000_000


class BridgeContext(msgspec.Struct, frozen=True):
    """Objects that all bridges of a process share.

    Attributes:
        plan: the plan of all bridges.
        request: settings from the command line.
        join: function that opens the graph for a node's name.
        inbox: the queue of messages from the graph.
        buffer: buffer for datagrams.
        say: called with each note for the user.
    """

    plan: BridgePlan
    request: BridgeRequest
    join: Callable[[str], Graph]
    inbox: Inbox
    buffer: DatagramBuffer
    say: Callable[[str], None]


class Station:
    """One bridge; the constructor binds its port and joins its topics.

    Args:
        number: its number in the inbox.

    Attributes:
        plan: as given.
        machine: the state machine.
        socket: the port.
        endpoint: the address that it listens on.
        to_cfs: counters of the direction to cFS.
        from_cfs: counters of the direction from cFS.
        recorder: records the datagrams; None: they are not recorded.

    Raises:
        CaptureError: the port is in use.
        ConfigError: the graph cannot be joined.
        RouteError: the graph accepts none of the topics.
    """

    def __init__(self, number: int, plan: StationPlan, shared: BridgeContext) -> None:
        self.plan = plan
        self.recorder: RelayRecorder | None = None
        self._buffer, self._say = shared.buffer, shared.say
        self._flat = shared.buffer.slots.reshape(-1).data
        self._stride = shared.buffer.slots.shape[1]
        self._times = np.zeros(SLOTS + SPARE, np.int64)
        self._heard: list[int] = []
        self._count_ns = 0
        self._states: dict[str, TopicState] = {}
        self._dropped = 0
        self._ends: dict[bytes, NDArray[np.void]] = {}
        self.to_cfs, self.from_cfs = Direction("to cFS"), Direction("from cFS")
        self.socket = _bind(plan)
        self.endpoint = local_endpoint(self.socket)
        with OnFailure(self.socket.close):
            target = address_of(socket.AF_INET, (plan.target.address, plan.target.port))
            self._outlet = Outlet(self.socket, target, self.to_cfs, _QUEUE_BYTES)
            self._graph = shared.join(plan.node)
            with OnFailure(self._graph.close):
                routes, self._publish = self._topics(number, shared.inbox)
                self.machine = self._machine(routes, shared.plan, shared.request)

    @property
    def waits(self) -> bool:
        """Whether datagrams wait because the socket's buffer is full."""
        return self._outlet.waits

    @property
    def drops(self) -> int:
        """Datagrams that the kernel dropped because the receive buffer was full."""
        if self.socket.fileno() >= 0:
            self.from_cfs.kernel_drops = kernel_drops(self.socket)
        return self.from_cfs.kernel_drops

    def hear(self, message: GraphMessage, now: int) -> None:
        """Handle a message of the graph."""
        if self.machine.receive_message(message.route, message.cdr, now=now):
            self._heard.append(message.time_ns)

    def receive(self) -> bool:
        """Handle the datagrams that have arrived; return whether there may be more."""
        buffer, machine, flat, stride = self._buffer, self.machine, self._flat, self._stride
        direction, publish = self.from_cfs, self._publish
        for _ in range(_TURNS):
            count = buffer.receive(self.socket)
            if count <= 0:
                return False
            self._times[:count] = buffer.times(count)
            lengths = buffer.length[:count].tolist()
            direction.received += count
            direction.received_bytes += sum(lengths)
            if self.recorder is not None:
                self._record(count)
            now, late = time.monotonic_ns(), []
            times = self._times[:count].tolist()
            for slot, length in enumerate(lengths):
                start = slot * stride
                message = machine.receive_datagram(bytes(flat[start : start + length]), now=now)
                if message is not None and self._give(publish, *message):
                    late.append(time.time_ns() - times[slot])
            if late:
                direction.sent += len(late)
                direction.add_latencies(np.array(late, np.int64))
            if count < SLOTS:
                return False
        return True

    def service(self, now: int) -> None:
        """Handle everything that is due."""
        for index, cdr in self.machine.service(now=now):
            self.from_cfs.sent += self._give(self._publish, index, cdr)

    def flush(self, now: int) -> None:
        """Send the datagrams that are ready, and report notes."""
        machine = self.machine
        if machine.outbox:
            datagrams, machine.outbox = machine.outbox, []
            for first in range(0, len(datagrams), SPARE):
                self._send(datagrams[first : first + SPARE])
            if self._heard:
                sent_ns = time.monotonic_ns()
                for first in range(0, len(self._heard), SLOTS):
                    self.to_cfs.add_latencies(
                        sent_ns - np.array(self._heard[first : first + SLOTS], np.int64)
                    )
                self._heard.clear()
        elif self._outlet.waits:
            self._outlet.flush()
        if now >= self._count_ns:
            self._count_ns = now + _COUNT_NS
            self.count_latencies()
            self._look()
            machine.link.notes += self._graph.notes()
        notes = machine.link.notes
        while notes:
            self._say(f"{self.plan.name}: {notes.pop(0)}")

    def leave(self) -> None:
        """Leave the graph: no message is received afterwards."""
        self._look()
        self._graph.close()

    def close(self) -> None:
        """Close the port; datagrams that still wait are lost."""
        self.drops  # noqa: B018  read from the socket before it is closed
        self._outlet.close()
        self.socket.close()

    @property
    def overwritten(self) -> int:
        """Messages that were overwritten in the histories of its publishers."""
        return sum(item.overwritten for item in self._states.values())

    def _look(self) -> None:
        """Read how the topics are connected, and report each change once."""
        before, self._states = self._states, {**self._states, **self._graph.states()}
        drops, self._dropped = self._dropped, max(self._graph.dropped(), self._dropped)
        if self._dropped and not drops:
            self.machine.link.notes.append(
                "the sockets of ROS 2 were full: messages that publishers no longer keep are lost"
            )
        kinds: defaultdict[Qos, list[str]] = defaultdict(list)
        nothing = TopicState(())
        for route in self.machine.routes:
            new, old = (states.get(route.topic, nothing) for states in (self._states, before))
            request = qos_of(route)
            if None in (request.reliable, request.transient_local) and old.qos != new.qos:
                for qos in new.qos:
                    kinds[qos].append(route.topic)
            if any(new[1:]) and not any(old[1:]):
                self.machine.link.notes.append(f"{route.topic}: messages were overwritten in a history")
        for qos, topics in kinds.items():
            kind = "{reliability}, {durability}, depth {depth}".format(**qos.words())
            self.machine.link.notes.append(f"automatic quality of service {kind}: {', '.join(topics)}")

    def count_latencies(self) -> None:
        """Add the latencies measured so far to the histogram."""
        self.to_cfs.count_latencies()
        self.from_cfs.count_latencies()

    def summary(self) -> dict[str, Any]:
        """Return this bridge's part of ``bridge --json``."""
        return {
            **self.plan.summary(),
            "listen": str(self.endpoint),
            **self.machine.summary(),
            "routes": [self._connected(row) for row in self.machine.summary()["routes"]],
            "graph_drops": self._dropped,
            "to_cfs": _summary(self.to_cfs),
            "from_cfs": {**_summary(self.from_cfs), "kernel_drops": self.drops},
        }

    def _connected(self, row: dict[str, Any]) -> dict[str, Any]:
        """Return a route as JSON with how its topic is connected."""
        state = self._states.get(row["topic"], TopicState(()))
        qos = [item.words() for item in state.qos]
        return {**row, "qos": qos, "missed": state.missed, "overwritten": state.overwritten}

    def _topics(self, number: int, inbox: Inbox) -> tuple[list[Route], list[Callable[[bytes], None]]]:
        """Join the topics; return the routes that could be joined, and a publish function for each."""
        routes: list[Route] = []
        publish: list[Callable[[bytes], None]] = []
        failure: EdorasError | None = None
        for route in self.plan.bridge.routes:
            try:
                if route.to_cfs:
                    heard = inbox.slot(number, len(routes))
                    self._graph.subscribe(route.topic, route.type, qos_of(route), heard)
                    publish.append(_nowhere)
                else:
                    publish.append(self._graph.advertise(route.topic, route.type, qos_of(route)))
            except EdorasError as error:
                failure = error
                self._say(f"{self.plan.name}: {route.topic} is left out: {error}")
            else:
                routes.append(route)
        if failure is not None and not routes:
            raise RouteError(
                f"no topic of {self.plan.name} can be joined; the last one: {failure}"
            ) from failure
        return routes, publish

    def _machine(
        self, routes: list[Route], whole: BridgePlan, request: BridgeRequest
    ) -> bridge.BridgeSession:
        settings, options, now = self.plan.bridge, whole.settings.options, time.monotonic_ns()
        headers = options.headers or cfe.STANDARD
        writer = PacketWriter(checksum=request.checksum, sequence=request.sequence, headers=headers)
        back = [route for route in routes if not route.to_cfs]
        link: bridge.GroundSession | bridge.FlightSession
        if isinstance(settings.link, GroundLink):
            largest = bridge.CI_LARGEST
            add = {route.msg_id: route.handling.to_limit for route in back if route.handling.to_limit}
            address = _local_address(settings.link) if request.enable else None
            link = bridge.GroundSession(writer, address, add, now=now)
        else:
            largest, far = bridge.SBN_LARGEST, settings.link
            own = Peer(far.spacecraft_id, far.processor_id)
            peer = Peer(far.peer_spacecraft_id, far.peer_processor_id)
            link = bridge.FlightSession(own, peer, [route.msg_id for route in back], now=now, headers=headers)
        bridge_options = bridge.BridgeOptions(
            headers, options.envelope or str(DEFAULT), settings.max_size or largest, settings.max_rate_total
        )
        return bridge.BridgeSession(routes, link, writer, bridge_options, sizes_of(whole.types, routes))

    def _give(self, publish: list[Callable[[bytes], None]], index: int, cdr: bytes) -> bool:
        try:
            publish[index](cdr)
        except Exception as error:  # noqa: BLE001  errors of the middleware; the other topics continue
            self.machine.not_published(index, f"not published: {error}".partition("\n")[0])
            return False
        return True

    def _send(self, datagrams: list[bytes]) -> None:
        for slot, data in enumerate(datagrams, SLOTS):
            self._buffer.put(slot, data)
        slots = np.arange(SLOTS, SLOTS + len(datagrams))
        self.to_cfs.received += len(datagrams)
        self._outlet.send(self._buffer, slots)
        if self.recorder is not None:
            self._times[slots] = time.time_ns()
            self.recorder.take(self._buffer, slots, self._times, self._ends_with(None))

    def _record(self, count: int) -> None:
        assert self.recorder is not None
        senders: list[bytes] = self._buffer.senders(count).view("V32").ravel().tolist()
        for sender, slots in by_key(range(len(senders)), senders.__getitem__).items():
            self.recorder.take(self._buffer, np.array(slots), self._times, self._ends_with(sender))

    def _ends_with(self, sender: bytes | None) -> NDArray[np.void]:
        """Return the endpoints of a datagram: from a socket address to us; for None from us to the target."""
        key = sender or b""
        if key not in self._ends:
            own, target = self.endpoint, self.plan.target
            if own.address == ANY_ADDRESS:
                own = Endpoint(own_address(target), own.port)
            ends = (own, target) if sender is None else (host_of(sender).endpoint, own)
            self._ends[key] = ends_of(*ends)
        return self._ends[key]


def _nowhere(_cdr: bytes) -> None:
    """Ignore a message: on this topic the bridge only subscribes."""


def _summary(direction: Direction) -> dict[str, Any]:
    return {
        "datagrams": direction.received,
        "sent": direction.sent,
        "queued": direction.queued,
        "failed": direction.failed,
        "reason": direction.reason or None,
        "overflowed": direction.overflowed,
        "latency_us": direction.latency.summary(),
    }


def _bind(plan: StationPlan) -> socket.socket:
    link, key = plan.bridge.link, "bridge_port" if plan.kind == "ground" else "udp_receive_port"
    return open_bound(plan.listen, f"{link.file}:{link.line}: UDP {plan.listen}", f"choose another {key}")


def _local_address(link: GroundLink) -> str:
    """Return the address of this machine that Telemetry Output sends to."""
    if link.bridge_ip is not None:
        return link.bridge_ip
    return link.telemetry_ip if link.telemetry_ip != ANY_ADDRESS else own_address(link.command_ingest)


_MOST_WAITING: Final = 1 << 17
"""Maximum messages that wait; further ones are lost, and counted."""


class GraphMessage(NamedTuple):
    """One message.

    Attributes:
        station: number of the bridge that receives it.
        route: index into the bridge's routes.
        cdr: the message.
        time_ns: when it arrived, monotonic.
    """

    station: int
    route: int
    cdr: bytes
    time_ns: int


class Inbox:
    """A queue with a file descriptor: a thread that polls the descriptor wakes up when a message comes.

    Attributes:
        overflowed: messages lost because ``_MOST_WAITING`` messages were in the queue.
    """

    def __init__(self) -> None:
        self.overflowed = 0
        self._items: deque[GraphMessage] = deque()
        self._fileno = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._rung = False

    def __len__(self) -> int:
        return len(self._items)

    def fileno(self) -> int:
        """Return the descriptor, which is readable when messages are in the queue."""
        return self._fileno

    def ring(self) -> None:
        """Wake the thread that polls; for any thread or signal handler; no effect after ``close``."""
        if self._fileno >= 0:
            os.eventfd_write(self._fileno, 1)

    def slot(self, station: int, route: int) -> Callable[[bytes], None]:
        """Return a function that queues messages of a route; for any thread; it does not block."""
        items, now = self._items, time.monotonic_ns

        def heard(cdr: bytes) -> None:
            if len(items) >= _MOST_WAITING:
                self.overflowed += 1
                return
            items.append(GraphMessage(station, route, cdr, now()))
            if not self._rung:  # many messages, one system call
                self._rung = True
                self.ring()

        return heard

    def take(self, most: int) -> list[GraphMessage]:
        """Return messages from the queue, the oldest first, at most ``most``."""
        items = self._items
        return [items.popleft() for _ in islice(range(len(items)), most)]

    def reset_signal(self) -> None:
        """Make the descriptor unreadable until the next message; call it before ``take``."""
        with suppress(BlockingIOError):
            os.eventfd_read(self._fileno)
        # In this order: messages that arrive in between are taken without a wake-up, later ones wake again.
        self._rung = False

    def close(self) -> None:
        """Close the descriptor."""
        fileno, self._fileno = self._fileno, -1
        if fileno >= 0:
            os.close(fileno)


_BATCH: Final = 512
"""Messages of the graph that are handled before the sockets are read again."""
_PAGE_NS: Final = 40_000_000
_NOTES: Final = 200
_NEVER: Final = 1 << 63
_SERVERS: Final = frozenset({"foxglove"})
"""Middlewares where clients connect to a port: all bridges share one node."""


class Bridges:
    """All bridges of one process.

    Args:
        domain: ROS 2 domain.
        recorder: called once the ports are bound; returns the recorder of the bridged datagrams.
        say: called with each note for the user.

    Attributes:
        plan: as given.
        stations: the bridges that run.
        notes: notes for the user.
        recorder: the recorder, or None.
        interrupted: whether Ctrl-C ended the run.

    Raises:
        CaptureError: no bridge could bind its port.
        RouteError: the middleware accepts no topic of any bridge.
        ConfigError: the middleware is not installed or refuses.
    """

    def __init__(
        self,
        plan: BridgePlan,
        request: BridgeRequest | None = None,
        *,
        ros: str = "local",
        domain: int = 0,
        options: Mapping[str, str] | None = None,
        recorder: Callable[[], RelayRecorder] | None = None,
        say: Callable[[str], None] | None = None,
    ) -> None:
        self.plan, self.ros = plan, ros
        self.recorder: RelayRecorder | None = None
        self.interrupted = False
        self.notes: list[str] = []
        self.stations: list[Station] = []
        self._said = say
        self._inbox = Inbox()
        self._stopping = self._closed = False
        self._page_ns = _NEVER
        self._full: set[int] = set()
        for note in plan.notes:
            self._say(note)

        server: list[Graph] = []

        def node(name: str) -> Graph:
            if server:
                return server[0]
            graph = open_graph(ros, plan.types, name, domain=domain, options=options or {})
            if ros in _SERVERS:
                server.append(graph)
            return graph

        shared = BridgeContext(plan, request or BridgeRequest(), node, self._inbox, make_buffer(), self._say)
        with OnFailure(self.close):
            for item in plan.stations:
                try:
                    self.stations.append(Station(len(self.stations), item, shared))
                except (CaptureError, RouteError) as error:
                    if item is plan.stations[-1] and not self.stations:
                        raise
                    self._say(f"{item.name} is left out: {error}")
            if recorder is not None:
                self.recorder = recorder()
                for station in self.stations:
                    station.recorder = self.recorder

    @property
    def lost(self) -> int:
        """Messages and datagrams that the bridges themselves lost, including those not recorded."""
        missed = self.recorder.missed if self.recorder else 0
        links = sum(item.drops + item.to_cfs.overflowed + item.overwritten for item in self.stations)
        return links + self._inbox.overflowed + missed

    def stop(self) -> None:
        """End ``run``; for any thread or signal handler."""
        self._stopping = True
        self._inbox.ring()

    def run(self, *, duration_ns: int = 0, watcher: Watcher[Bridges] | None = None) -> None:
        """Run until ``stop``, Ctrl-C, or the end of the duration; then disconnect from cFS.

        Raises:
            CaptureError: a socket failed.
        """
        end = time.monotonic_ns() + duration_ns if duration_ns else _NEVER
        by_fileno = {item.socket.fileno(): item for item in self.stations}
        with (
            select.epoll() as poll,
            on_interrupt(self.stop) as interrupt,
            watched(self, watcher),
            threads_take_turns(),
        ):
            poll.register(self._inbox.fileno(), select.EPOLLIN)
            for fileno in by_fileno:
                poll.register(fileno, select.EPOLLIN)
            more = True
            while not self._stopping and (now := time.monotonic_ns()) < end:
                more = self._turn(poll, by_fileno, 0 if more else self._wait_ns(now, end))
            self.interrupted = interrupt.is_set()
            self._turn(poll, by_fileno, 0)
            for station in self.stations:
                station.machine.goodbye()
                station.flush(time.monotonic_ns())

    def close(self) -> None:
        """Leave the graph, close the ports and the recording; may be called twice."""
        if self._closed:
            return
        self._closed = True
        for station in self.stations:
            station.leave()
        for station in self.stations:
            station.close()
            station.count_latencies()
        self._inbox.close()
        if self.recorder is not None:
            self.recorder.close(sum(item.drops for item in self.stations))

    def summary(self) -> dict[str, Any]:
        """Return the shape of ``bridge --json``."""
        recorded = self.recorder.recorded.datagrams if self.recorder else None
        return {
            "ros": self.ros,
            "bridges": [item.summary() for item in self.stations],
            "inbox_overflowed": self._inbox.overflowed,
            "recorded": recorded,
            "unrecorded": self.recorder.missed if self.recorder else 0,
            "lost": self.lost,
            "notes": list(self.notes),
        }

    def _turn(self, poll: select.epoll, by_fileno: dict[int, Station], wait_ns: int) -> bool:
        """Wait for events, then handle all that is due; return whether more can be done at once."""
        more = False
        for fileno, events in poll.poll(wait_ns / 1e9 if wait_ns >= 0 else None):
            station = by_fileno.get(fileno)
            if station is None:
                self._inbox.reset_signal()
            elif events & ~select.EPOLLOUT:
                more |= station.receive()
        heard = self._inbox.take(_BATCH)
        now = time.monotonic_ns()
        for message in heard:
            self.stations[message.station].hear(message, now)
        for station in self.stations:
            due = station.machine.next_ns
            if due is not None and due <= now:
                station.service(now)
            station.flush(now)
            self._watch_room(poll, station)
        if self.recorder is not None:
            self._turn_page(now)
        return more or len(self._inbox) > 0

    def _wait_ns(self, now: int, end: int) -> int:
        """Return the time until something is due; -1 for ever."""
        due = min(end, self._page_ns)
        for station in self.stations:
            next_ns = station.machine.next_ns
            if next_ns is not None and next_ns < due:
                due = next_ns
        return -1 if due == _NEVER else max(due - now, 0)

    def _watch_room(self, poll: select.epoll, station: Station) -> None:
        """Poll for space in a full socket's buffer."""
        fileno = station.socket.fileno()
        if station.waits != (fileno in self._full):
            self._full ^= {fileno}
            poll.modify(fileno, select.EPOLLIN | (select.EPOLLOUT if station.waits else 0))

    def _turn_page(self, now: int) -> None:
        """Hand recorded datagrams over to the recorder at short intervals."""
        assert self.recorder is not None
        if self._page_ns == _NEVER:
            if self.recorder.pending:
                self._page_ns = now + _PAGE_NS
        elif now >= self._page_ns:
            self.recorder.turn()
            self._page_ns = _NEVER

    def _say(self, text: str) -> None:
        if len(self.notes) < _NOTES:
            self.notes.append(text)
        if self._said is not None:
            self._said(text)
