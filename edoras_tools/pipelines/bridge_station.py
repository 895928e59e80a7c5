"""One bridge at work: its socket towards cFS, its node in the ROS 2 graph, the state machine in between."""

from __future__ import annotations

import errno
import socket
import time
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from edoras_tools.errors import CaptureError, EdorasError, RouteError
from edoras_tools.mission import GroundLink
from edoras_tools.model import Endpoint
from edoras_tools.pipelines.bridge_plan import qos_of, sizes_of
from edoras_tools.pipelines.proxy_ways import Outlet, Way
from edoras_tools.sessions.bridge import CI_LARGEST, SBN_LARGEST, Bridge, Habits
from edoras_tools.sessions.bridge_flight import FlightSession
from edoras_tools.sessions.bridge_ground import GroundSession
from edoras_tools.sessions.bridge_packets import PacketWriter
from edoras_tools.sources.relay import ROOMS, SPARE, open_socket
from edoras_tools.sources.sockaddr import address_of, host_of
from edoras_tools.sources.udp import LINUX, bind_reason, kernel_drops
from edoras_tools.wire.sbn import Peer

if TYPE_CHECKING:
    from collections.abc import Callable

    from edoras_tools.middleware import Graph
    from edoras_tools.mission import Route
    from edoras_tools.pipelines.bridge_inbox import Heard, Inbox
    from edoras_tools.pipelines.bridge_plan import BridgePlan, StationPlan, Wishes
    from edoras_tools.pipelines.proxy_recorder import Recorder
    from edoras_tools.sessions.bridge import LinkSession
    from edoras_tools.sources.relay import Arena

_QUEUE_BYTES: Final = 4 << 20
_TURNS: Final = 4
"""How often a busy socket is read before others have their turn."""
_FOLD_NS: Final = 500_000_000
_ANY: Final = "0.0.0.0"  # noqa: S104  compared, not bound
_LOOPBACK: Final = "127.0.0.1"

if TYPE_CHECKING:
    Join = Callable[[str], Graph]


class Station:
    """One bridge, its port bound and its topics joined when constructed.

    Args:
        number: how the inbox knows it.
        plan: what it is.
        whole: what it is part of.
        wishes: of the command line.
        join: opens the graph for a node's name.
        inbox: where messages of the graph come in.
        arena: rooms for datagrams, shared by all stations.
        say: takes a line that people should know.

    Attributes:
        plan: as given.
        machine: the state machine.
        socket: the port.
        endpoint: what is listened on.
        to_cfs: what is counted towards cFS.
        from_cfs: and from there.
        recorder: takes what crosses; None where nothing does.

    Raises:
        CaptureError: the port is in use.
        ConfigError: the graph cannot be joined.
        RouteError: it takes none of the topics; why is said.
    """

    def __init__(
        self,
        number: int,
        plan: StationPlan,
        whole: BridgePlan,
        wishes: Wishes,
        *,
        join: Join,
        inbox: Inbox,
        arena: Arena,
        say: Callable[[str], None],
    ) -> None:
        self.plan = plan
        self.recorder: Recorder | None = None
        self._arena, self._say = arena, say
        self._flat = arena.rooms.reshape(-1).data
        self._stride = arena.rooms.shape[1]
        self._times = np.zeros(ROOMS + SPARE, np.int64)
        self._heard: list[int] = []
        self._fold_ns = 0
        self._flows: dict[bytes, int] = {}
        self.to_cfs, self.from_cfs = Way("to cFS"), Way("from cFS")
        self.socket = _bind(plan)
        self.endpoint = address_of(self.socket.family, self.socket.getsockname()).endpoint
        try:
            target = address_of(socket.AF_INET, (plan.target.address, plan.target.port))
            self._outlet = Outlet(self.socket, target, self.to_cfs, _QUEUE_BYTES)
            self._graph = join(plan.node)
        except BaseException:
            self.socket.close()
            raise
        try:
            routes, self._publish = self._topics(number, inbox)
            self.machine = self._machine(routes, whole, wishes)
        except BaseException:
            self._graph.close()
            self.socket.close()
            raise

    @property
    def waits(self) -> bool:
        """Whether datagrams wait because the socket is full."""
        return self._outlet.waits

    @property
    def drops(self) -> int:
        """Datagrams that the kernel dropped because the receive buffer was full."""
        if LINUX and self.socket.fileno() >= 0:
            self.from_cfs.kernel_drops = kernel_drops(self.socket)
        return self.from_cfs.kernel_drops

    def hear(self, message: Heard, now: int) -> None:
        """Take a message of the graph."""
        if self.machine.hear(message.route, message.cdr, now=now):
            self._heard.append(message.time_ns)

    def receive(self) -> bool:
        """Take the datagrams that have arrived; tell whether there may be more."""
        arena, machine, flat, stride = self._arena, self.machine, self._flat, self._stride
        way, publish = self.from_cfs, self._publish
        for _ in range(_TURNS):
            count = arena.receive(self.socket)
            if count <= 0:
                return False
            self._times[:count] = arena.times(count)
            lengths = arena.length[:count].tolist()
            way.received += count
            way.received_bytes += sum(lengths)
            if self.recorder is not None:
                self._record(count)
            now, late = time.monotonic_ns(), []
            times = self._times[:count].tolist()
            for row, length in enumerate(lengths):
                start = row * stride
                found = machine.receive_datagram(bytes(flat[start : start + length]), now=now)
                if found is not None and self._give(publish, *found):
                    late.append(time.time_ns() - times[row])
            if late:
                way.sent += len(late)
                way.note(np.array(late, np.int64))
            if count < ROOMS:
                return False
        return True

    def service(self, now: int) -> None:
        """Do what is due."""
        for index, cdr in self.machine.service(now=now):
            self.from_cfs.sent += self._give(self._publish, index, cdr)

    def flush(self, now: int) -> None:
        """Send what is to be sent, and say what is to be said."""
        machine = self.machine
        if machine.outbox:
            datagrams, machine.outbox = machine.outbox, []
            for first in range(0, len(datagrams), SPARE):
                self._send(datagrams[first : first + SPARE])
            if self._heard:
                sent_ns = time.monotonic_ns()
                for first in range(0, len(self._heard), ROOMS):
                    self.to_cfs.note(sent_ns - np.array(self._heard[first : first + ROOMS], np.int64))
                self._heard.clear()
        elif self._outlet.waits:
            self._outlet.flush()
        if now >= self._fold_ns:
            self._fold_ns = now + _FOLD_NS
            self.fold()
            machine.link.notes += self._graph.notes()
        notes = machine.link.notes
        while notes:
            self._say(f"{self.plan.name}: {notes.pop(0)}")

    def leave(self) -> None:
        """Leave the graph: nothing is heard afterwards."""
        self._graph.close()

    def close(self) -> None:
        """Close the port; what still waits is lost."""
        self.drops  # noqa: B018  counted while the socket can still be asked
        self._outlet.close()
        self.socket.close()

    def fold(self) -> None:
        """Count latencies."""
        self.to_cfs.fold()
        self.from_cfs.fold()

    def summary(self) -> dict[str, Any]:
        """Return its part of ``bridge --json``."""
        return {
            **self.plan.summary(),
            "listen": str(self.endpoint),
            **self.machine.summary(),
            "to_cfs": _way(self.to_cfs),
            "from_cfs": {**_way(self.from_cfs), "kernel_drops": self.drops},
        }

    def _topics(self, number: int, inbox: Inbox) -> tuple[list[Route], list[Callable[[bytes], None]]]:
        """Join the topics; return the routes whose topics could be, and what publishes on each."""
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

    def _machine(self, routes: list[Route], whole: BridgePlan, wishes: Wishes) -> Bridge:
        bridge, options, now = self.plan.bridge, whole.settings.options, time.monotonic_ns()
        writer = PacketWriter(
            checksum=wishes.checksum, sequence=wishes.sequence, telemetry_header=options.telemetry_header
        )
        back = [route for route in routes if not route.to_cfs]
        link: LinkSession
        if isinstance(bridge.link, GroundLink):
            largest = CI_LARGEST
            add = {route.msg_id: route.handling.to_limit for route in back if route.handling.to_limit}
            address = _here(bridge.link) if wishes.enable else None
            link = GroundSession(writer, address, add, now=now)
        else:
            largest, far = SBN_LARGEST, bridge.link
            own = Peer(far.spacecraft_id, far.processor_id)
            peer = Peer(far.peer_spacecraft_id, far.peer_processor_id)
            link = FlightSession(own, peer, [route.msg_id for route in back], now=now)
        habits = Habits(
            options.telemetry_header, options.envelope, bridge.max_size or largest, bridge.max_rate_total
        )
        return Bridge(routes, link, writer, habits, sizes_of(whole.types, routes))

    def _give(self, publish: list[Callable[[bytes], None]], index: int, cdr: bytes) -> bool:
        try:
            publish[index](cdr)
        except Exception as error:  # noqa: BLE001  a middleware's own; the other topics go on
            self.machine.unpublished(index, f"not published: {error}".partition("\n")[0])
            return False
        return True

    def _send(self, datagrams: list[bytes]) -> None:
        arena, flat, stride = self._arena, self._flat, self._stride
        for row, data in enumerate(datagrams, ROOMS):
            start = row * stride
            flat[start : start + len(data)] = data
        rows = np.arange(ROOMS, ROOMS + len(datagrams))
        arena.length[rows] = [len(data) for data in datagrams]
        self.to_cfs.received += len(datagrams)
        self._outlet.send(arena, rows)
        if self.recorder is not None:
            self._times[rows] = time.time_ns()
            self.recorder.take(arena, rows, self._times, self._flow(b"", outward=True))

    def _record(self, count: int) -> None:
        assert self.recorder is not None
        senders = self._arena.senders(count)
        rows: dict[bytes, list[int]] = {}
        for row, packed in enumerate(senders.view("V32").ravel().tolist()):
            rows.setdefault(packed, []).append(row)
        for packed, places in rows.items():
            self.recorder.take(self._arena, np.array(places), self._times, self._flow(packed, outward=False))

    def _flow(self, packed: bytes, *, outward: bool) -> int:
        """Return the number that the recorder has for a direction."""
        if packed not in self._flows:
            assert self.recorder is not None
            own = self.endpoint
            if own.address == _ANY:
                own = Endpoint(_local(self.plan.target), own.port)
            ends = (own, self.plan.target) if outward else (host_of(packed).endpoint, own)
            self._flows[packed] = self.recorder.flow(*ends)
        return self._flows[packed]


def _nowhere(_cdr: bytes) -> None:
    """Publish on a topic that is only heard."""


def _way(way: Way) -> dict[str, Any]:
    return {
        "datagrams": way.received,
        "sent": way.sent,
        "queued": way.queued,
        "failed": way.failed,
        "reason": way.reason or None,
        "overflowed": way.overflowed,
        "latency_us": way.latency.summary(),
    }


def _bind(plan: StationPlan) -> socket.socket:
    opened = open_socket(socket.AF_INET)
    try:
        opened.bind((plan.listen.address, plan.listen.port))
    except OSError as error:
        opened.close()
        key = "bridge_port" if plan.kind == "ground" else "udp_receive_port"
        why = (
            f"another program has that port (a bridge?); stop it, or choose another {key}"
            if error.errno == errno.EADDRINUSE
            else bind_reason(error, plan.listen.port)
        )
        link = plan.bridge.link
        raise CaptureError(f"{link.file}:{link.line}: UDP {plan.listen}: {why}") from error
    return opened


def _here(link: GroundLink) -> str:
    """Return the address of this machine that Telemetry Output can send to."""
    if link.bridge_ip is not None:
        return link.bridge_ip
    return link.telemetry_ip if link.telemetry_ip != _ANY else _local(link.command_ingest)


def _local(target: Endpoint) -> str:
    """Return our address on the way to a target."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect((target.address, target.port))  # sends nothing
            return str(probe.getsockname()[0])
        except OSError:
            return _LOOPBACK
