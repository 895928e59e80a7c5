"""A demo in simulated time: the emulated cFS and, on request, the bridges, the operator and the robots.

``serve`` runs it on real sockets and in real time: the same core, driven by the host's clock. It is also a
source of datagrams and a wire, without sockets, in simulated or in real time.

SBN over TCP has connections, which the emulated cFS opens or waits for: as in SBN's TCP module, the peer with
the smaller ProcessorID connects, and tries again every few seconds. Any peer of the table may connect, and is
identified by its first message. Without a connection messages are dropped.
"""

from __future__ import annotations

import errno
import selectors
import socket
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from functools import partial
from importlib.resources import as_file, files
from itertools import chain
from threading import Event, Thread
from typing import TYPE_CHECKING, Final, NamedTuple, Protocol

from msgspec.structs import replace

from edoras_tools.addons.lab.emulator.apps import core, generator
from edoras_tools.addons.lab.emulator.apps.generator import Generator
from edoras_tools.addons.lab.emulator.apps.network_apps import CommandIngest, SbnApp, TelemetryOutput
from edoras_tools.addons.lab.emulator.bridges import FlightBridge, GroundBridge, robot_of
from edoras_tools.addons.lab.emulator.cfs import DEMO_ROUTES, Cfs, Scenario, SystemRoutes
from edoras_tools.addons.lab.emulator.scheduler import Scheduler
from edoras_tools.cfs import command_ingest, edoras_app, sbn, telemetry_output
from edoras_tools.cfs.profile import SimProfile
from edoras_tools.errors import CaptureError, ConfigError, EdorasError, OnFailure
from edoras_tools.io import SourceDefaults
from edoras_tools.io.frames.frame_batch import frames_of
from edoras_tools.io.frames.linklayer import Demux
from edoras_tools.io.net.sockets import bind, open_bound, received, resolve, send_one
from edoras_tools.io.net.transmit import Arrival, SendStatistics
from edoras_tools.links.sbn import SBN
from edoras_tools.model import Endpoint, Link, PacketBatch, Peer, SourceInfo, SourceStatistics
from edoras_tools.units import MICROSECOND, SECOND
from edoras_tools.wire.sbn import HEADER, MsgType, emit

if TYPE_CHECKING:
    from typing_extensions import Self

    from edoras_tools.pipelines.workbench import Settings, Workbench
    from edoras_tools.sessions.outgoing import Outgoing


class Apps:
    """The applications of one emulated cFS, for access to their state: those that run now, or ran last.

    Attributes:
        sbn: the Software Bus Network.
        ci: Command Ingest.
        edoras: the EDORAS application.
    """

    def __init__(self, cfs: Cfs, edoras: core.EdorasApp) -> None:
        self.sbn: SbnApp
        self.ci: CommandIngest
        self.edoras = edoras
        self._cfs = cfs
        cfs.begin = self._start
        cfs.boot()

    def _start(self) -> None:
        cfs = self._cfs
        core.start_core(cfs)
        for name, file, begin in (
            (sbn.NAME, "sbn", self._sbn),
            (command_ingest.NAME, "ci_lab", self._ci),
            (telemetry_output.NAME, "to_lab", lambda: TelemetryOutput(cfs, self.edoras.telemetry)),
            (edoras_app.NAME, "edoras_app", lambda: self.edoras.start(cfs)),
            *[(generator.NAME, "edoras_gen", lambda: Generator(cfs))] * bool(cfs.profile.generator_msg_id),
            (core.SCHEDULER, "sch_lab", lambda: core.start_scheduler(cfs, self.edoras)),
        ):
            cfs.executive.load(name, f"/cf/{file}.so", begin)

    def _sbn(self) -> None:
        self.sbn = SbnApp(self._cfs)

    def _ci(self) -> None:
        self.ci = CommandIngest(self._cfs)


SCENARIOS: Final[tuple[Scenario, ...]] = ("rover", "arm", "two-rovers", "two-arms")
MISSIONS: Final[Mapping[str, tuple[str, ...]]] = {
    "rover": ("rover_ground",),
    "arm": ("single_arm_ground",),
    "two-rovers": ("two_rovers_ground", "two_rovers_flight"),
    "two-arms": ("two_arms_ground", "two_arms_flight"),
}
"""The missions of a scenario, as files of ``samples/missions``."""
BOOT_NS: Final = 3 * SECOND
"""Time in which the emulated cFS boots and its bridges connect."""
_LOOPBACK_NS: Final = 20 * MICROSECOND


class WireDatagram(NamedTuple):
    """A datagram on the wire."""

    time_ns: int
    source: Endpoint
    destination: Endpoint
    payload: bytes


class Simulation:
    """An emulated cFS with the EDORAS application of a demo.

    Attributes:
        scenario: name of the demo; ``mission`` for other messages.
        routes: messages.
        cfs: the flight side.
        apps: applications of ``cfs``.
        ground: emulated ground bridge; None if the caller replaces it.
        flight: emulated flight bridge; None if there is none, or if the caller replaces it.
        routed: whether datagrams between the parts are delivered here; with a server, sockets deliver them.
    """

    def __init__(
        self,
        profile: SimProfile | None = None,
        scenario: Scenario | SystemRoutes = "rover",
        *,
        start_ns: int = 0,
        bridges: bool = True,
        command_rate_hz: float = 5.0,
        command_count: int | None = None,
        state_rate_hz: float = 5.0,
        with_account: bool = False,
    ) -> None:
        """Boot at ``start_ns``.

        Args:
            scenario: demo, or messages of a system: ``rover`` and ``arm`` have the robot behind the
                application, the others have two robots on SBN.
            start_ns: time of the clock at the start, ns since 1970.
            command_rate_hz: commands per second and robot.
            command_count: commands per robot; None for no end.
            state_rate_hz: robot states per second and robot on the SBN link.
            with_account: whether to record the arrivals at pipes and sockets in ``cfs.account``.

        Raises:
            ConfigError: there is no such scenario, a rate is below 0, or the profile does not have the
            bridge's peer.
        """
        if not isinstance(scenario, SystemRoutes) and scenario not in SCENARIOS:
            raise ConfigError(f"scenario {scenario!r} is not known; there are {', '.join(SCENARIOS)}")
        if min(command_rate_hz, state_rate_hz) < 0:
            raise ConfigError("a rate is 0 Hz or more")
        profile = profile or SimProfile()
        routes = scenario if isinstance(scenario, SystemRoutes) else DEMO_ROUTES[scenario]
        self.scenario = "mission" if isinstance(scenario, SystemRoutes) else scenario
        self.routes = routes
        self.routed = True
        self._outbox: deque[WireDatagram] = deque()
        self._scheduler = Scheduler(profile, start_ns=start_ns)
        self.cfs = Cfs(profile, self._scheduler, self._send, with_account=with_account)
        self.cfs.routes = routes
        self.apps = Apps(self.cfs, _application(routes, start_ns))
        self.ground: GroundBridge | None = None
        self.flight: FlightBridge | None = None
        if bridges:
            self.connect(command_rate_hz, state_rate_hz, command_count)

    def connect(
        self,
        command_rate_hz: float,
        state_rate_hz: float = 5.0,
        command_count: int | None = None,
        after_ns: int = SECOND,
    ) -> None:
        """Start the bridges now; see ``__init__``.

        Args:
            after_ns: time until the first command, ns.
        """
        self.ground = GroundBridge(self.cfs, command_rate_hz, command_count, after_ns)
        if self.routes.flight:
            self.flight = FlightBridge(self.cfs, state_rate_hz)

    def boot(self) -> Self:
        """Let the first ``BOOT_NS`` pass, dropping its datagrams; return the simulation.

        If the clock starts at ``now - BOOT_NS``, cFS has booted at ``now``.
        """
        for _ in self.run(self.now + BOOT_NS):
            pass
        return self

    @property
    def now(self) -> int:
        """Time of the clock, ns."""
        return self._scheduler.now

    @property
    def next_ns(self) -> int | None:
        """Time of the next event, ns; None if there is none."""
        return self._scheduler.next_ns

    @property
    def endpoints(self) -> tuple[Endpoint, ...]:
        """Every socket of this simulation."""
        parts = [item.endpoint for item in (self.ground, self.flight) if item is not None]
        if parts and (port := self.cfs.profile.robot_port):
            parts.append(Endpoint(self.cfs.profile.address, port))
        return self.cfs.ci_endpoint, self.cfs.sbn_endpoint, self.cfs.to_endpoint, *parts

    def deliver(self, destination: Endpoint, data: bytes) -> None:
        """Pass a datagram now to the part that listens at a port."""
        for part in (self.ground, self.flight):
            if part is not None and part.endpoint == destination:
                part.receive_datagram(data)
                return
        self.cfs.receive_datagram(destination, data)

    def feed(self, time_ns: int, destination: Endpoint, data: bytes) -> None:
        """Let a datagram arrive from outside at a time that is not past."""
        self._scheduler.call_at(time_ns, self.deliver, destination, data)

    def call_at(self, time_ns: int, action: Callable[[], None]) -> None:
        """Call a function at a time that is not past."""
        self._scheduler.call_at(time_ns, action)

    def inject(self, time_ns: int, packet: bytes, sender: str) -> None:
        """Publish a packet on the software bus at a time, as if by application ``sender``."""
        self._scheduler.call_at(time_ns, partial(self.cfs.publish, packet, sender, stamp=False))

    def run(self, until_ns: int) -> Iterator[WireDatagram]:
        """Let time pass up to ``until_ns``; yield every datagram sent, in order of time.

        Time passes only as the iterator is advanced.
        """
        while (due := self._scheduler.next_ns) is not None and due <= until_ns:
            self._scheduler.run(due)
            while self._outbox:
                yield self._outbox.popleft()
        self._scheduler.run(until_ns)

    def _send(self, source: Endpoint, destination: Endpoint, payload: bytes) -> None:
        self._outbox.append(WireDatagram(self.now, source, destination, payload))
        if self.routed and destination in self.endpoints:
            self._scheduler.call_at(self.now + _LOOPBACK_NS, self.deliver, destination, payload)


def _application(routes: SystemRoutes, now: int) -> core.EdorasApp:
    if routes.flight:
        return core.TwoRobotApp(routes)
    command, state = (
        routes.types[items[0]] if items else "" for items in (routes.commands, routes.telemetry)
    )
    return core.SingleRobotApp(robot_of(command, state, routes.store, now=now), routes)


_LONGEST_WAIT_S: Final = 0.1
"""Longest time until a stop takes effect, s."""


class Watch(Protocol):
    """An observer of a simulation on sockets."""

    def received(self, endpoint: Endpoint, data: bytes, /) -> None:
        """Process a datagram that a socket has just received."""

    def sent(self, sent: WireDatagram, /) -> None:
        """Process a datagram that is sent now."""


def serve(
    simulation: Simulation,
    host: str = "127.0.0.1",
    duration: float | None = None,
    stop: Event | None = None,
    ready: Callable[[], None] | None = None,
    watch: Watch | None = None,
) -> int:
    """Run a simulation on UDP sockets, and SBN's TCP connections, until it is stopped.

    Args:
        simulation: simulation to run; its clock continues.
        host: address to bind every socket to; loopback by default.
        duration: duration, s; None for no end.
        stop: event that ends it.
        ready: called once all sockets are bound, before the first datagram leaves.

    Returns:
        The number of datagrams sent.

    Raises:
        CaptureError: a port is in use, or may not be bound.
    """
    simulation.routed, cfs, stop = False, simulation.cfs, stop or Event()
    with ExitStack() as stack:
        selector = stack.enter_context(selectors.DefaultSelector())
        sockets: dict[Endpoint, socket.socket] = {}

        def open_socket(endpoint: Endpoint) -> None:
            # The operating system chooses the port of telemetry's source, unless it is set.
            is_free = endpoint == cfs.to_endpoint and not cfs.profile.to_source_port
            place = Endpoint(host, 0 if is_free else endpoint.port)
            opened = stack.enter_context(
                open_bound(place, f"UDP {place}", "choose another host, as 127.0.0.2")
            )
            sockets[endpoint] = opened
            selector.register(opened, selectors.EVENT_READ, partial(take, endpoint, opened))

        def take(endpoint: Endpoint, opened: socket.socket, now: int) -> None:
            for data in _waiting(opened):
                if watch:
                    watch.received(endpoint, data)
                # Queued, not delivered: the simulation's clock still has the time of its last run.
                simulation.feed(now, endpoint, data)

        streams: PeerStreams | None = None
        if cfs.profile.sbn_tcp:
            streams = PeerStreams(simulation, host, selector)
            stack.callback(streams.close)
        for endpoint in simulation.endpoints:
            if streams is None or endpoint != cfs.sbn_endpoint:
                open_socket(endpoint)
        if ready:
            ready()
        # The simulation's clock counts from its start, the host's from now.
        offset = simulation.now - time.monotonic_ns()
        end_ns = None if duration is None else simulation.now + int(duration * SECOND)
        sent = 0
        while not stop.is_set():
            now = time.monotonic_ns() + offset
            if end_ns is not None and now >= end_ns:
                break
            for item in simulation.run(now):
                if watch:
                    watch.sent(item)
                if streams and item.source == cfs.sbn_endpoint:
                    sent += streams.send(item)
                    continue
                if item.source not in sockets:  # Telemetry Output restarted, with another socket
                    open_socket(item.source)
                sent += _send(sockets[item.source], item)
            if streams:
                streams.connect(now)
            for key, _ in selector.select(_wait_s(simulation, time.monotonic_ns() + offset)):
                key.data(time.monotonic_ns() + offset)
        return sent


class Served:
    """A simulation on its sockets, in its own thread, during a ``with`` block.

    Raises:
        CaptureError: a port is in use, or may not be bound; on entering.
    """

    def __init__(self, simulation: Simulation, watch: Watch | None = None) -> None:
        self._simulation, self._watch = simulation, watch
        self._stop, self._ready = Event(), Event()
        self._failure: EdorasError | None = None
        self._thread = Thread(target=self._run, name="emulated cFS", daemon=True)

    def _run(self) -> None:
        try:
            serve(self._simulation, stop=self._stop, ready=self._ready.set, watch=self._watch)
        except EdorasError as error:
            self._failure = error
        finally:
            self._ready.set()

    def __enter__(self) -> Self:
        self._thread.start()
        self._ready.wait()
        if self._failure:
            raise self._failure
        return self

    def __exit__(self, *_error: object) -> None:
        self._stop.set()
        self._thread.join()


def _waiting(opened: socket.socket) -> Iterator[bytes]:
    with suppress(OSError):  # the error of an earlier datagram
        for data, _ in received(opened):
            yield data


def _send(source: socket.socket, item: WireDatagram) -> int:
    try:
        to = resolve(item.destination)[1]
    except CaptureError:
        return 0  # telemetry can be enabled towards any text
    return send_one(source, item.payload, to).accepted


def _wait_s(simulation: Simulation, now: int) -> float:
    due = simulation.next_ns
    return _LONGEST_WAIT_S if due is None else min(max(due - now, 0) / SECOND, _LONGEST_WAIT_S)


_CONNECT_NS: Final = 6 * SECOND
_AT_ONCE: Final = 1 << 16
_STALLED_S: Final = 1.0
"""Time without reading after which a peer loses its connection, s."""


class PeerStreams:
    """The TCP connections between SBN and its peers.

    Args:
        host: address to listen at.
        selector: gets every socket; its data is a function of the simulation's time to call when one is
            ready.

    Raises:
        CaptureError: the port is in use, or may not be bound.
    """

    def __init__(self, simulation: Simulation, host: str, selector: selectors.BaseSelector) -> None:
        self._simulation, self._selector = simulation, selector
        self._open: dict[Peer, socket.socket] = {}
        self._begun: dict[Peer, socket.socket] = {}
        self._rest: dict[socket.socket, bytes] = {}
        self._due_ns = 0
        profile = simulation.cfs.profile
        listens = Endpoint(host, profile.sbn_port)
        family, address = resolve(listens)
        self._listener = socket.socket(family, socket.SOCK_STREAM)
        self._listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        with OnFailure(self._listener.close):
            bind(self._listener, address, f"TCP {listens}", "choose another host, as 127.0.0.2")
        self._port, self._is_listening = profile.sbn_port, False
        self._peers = {config.peer: Endpoint(config.address, config.port) for config in profile.sbn_peers}
        self._by_place = {place: peer for peer, place in self._peers.items()}

    def close(self) -> None:
        """Close every socket."""
        for opened in (self._listener, *self._begun.values(), *self._rest):
            opened.close()

    def connect(self, now: int) -> None:
        """Connect to the peers of larger ProcessorIDs that have no connection, every few seconds.

        Without the application, as before it starts, there are no connections, and no port is open.
        """
        if not self._simulation.cfs.is_listening(self._port):
            for opened in list(self._rest):
                self._close(opened, now)
            return
        if not self._is_listening:
            self._is_listening = True
            self._listener.listen()
            self._selector.register(self._listener, selectors.EVENT_READ, self._accept)
        if now < self._due_ns:
            return
        self._due_ns = now + _CONNECT_NS
        own = self._simulation.cfs.profile.processor_id
        for peer, place in self._peers.items():
            if peer.processor_id <= own or peer in self._open or peer in self._begun:
                continue
            family, address = resolve(place)
            self._begun[peer] = opened = socket.socket(family, socket.SOCK_STREAM)
            opened.setblocking(False)
            if opened.connect_ex(address.host) not in {0, errno.EINPROGRESS}:
                self._begun.pop(peer).close()
                continue
            self._selector.register(opened, selectors.EVENT_WRITE, partial(self._connected, opened, peer))

    def send(self, item: WireDatagram) -> int:
        """Send a message to its peer; return 1, or 0 if there is no connection."""
        peer = self._by_place.get(item.destination)
        opened = self._open.get(peer) if peer else None
        if opened is None:
            return 0
        try:
            opened.sendall(item.payload)
        except OSError:
            self._close(opened, item.time_ns)
            return 0
        return 1

    def _accept(self, now: int) -> None:
        self._read_from(self._listener.accept()[0], None)

    def _connected(self, opened: socket.socket, peer: Peer, now: int) -> None:
        self._selector.unregister(opened)
        del self._begun[peer]
        if opened.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR):
            opened.close()
            return
        self._open[peer] = opened
        self._read_from(opened, peer)
        self._simulation.call_at(now, partial(self._simulation.apps.sbn.node.opened, peer))

    def _read_from(self, opened: socket.socket, peer: Peer | None) -> None:
        opened.settimeout(_STALLED_S)
        opened.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._rest[opened] = b""
        self._selector.register(opened, selectors.EVENT_READ, partial(self._receive, opened, peer))

    def _receive(self, opened: socket.socket, peer: Peer | None, now: int) -> None:
        try:
            more = opened.recv(_AT_ONCE)
        except OSError:
            more = b""
        messages, self._rest[opened], is_foreign = SBN.framing.cut(self._rest[opened] + more)
        for message in messages:
            if peer is None:
                peer = self._introduce(opened, message)
            self._simulation.feed(now, self._simulation.cfs.sbn_endpoint, message)
        if is_foreign or not more:
            self._close(opened, now)

    def _introduce(self, opened: socket.socket, message: bytes) -> Peer:
        """Identify the peer of a connection by its first message; the latest connection of a peer is used."""
        header = HEADER.parse(message)
        peer = Peer(header["spacecraft_id"], header["processor_id"])
        self._open[peer] = opened
        self._selector.modify(opened, selectors.EVENT_READ, partial(self._receive, opened, peer))
        return peer

    def _close(self, opened: socket.socket, now: int) -> None:
        self._selector.unregister(opened)
        del self._rest[opened]
        opened.close()
        for peer in [item for item, own in self._open.items() if own is opened]:
            del self._open[peer]
            if peer in self._peers:  # call it after the earlier messages, as the end of a stream is read last
                end = emit(MsgType.DISCONNECT, peer)
                self._simulation.feed(now, self._simulation.cfs.sbn_endpoint, end)


_TICK_S: Final = 0.02
_COMMAND_SENDER: Final = Endpoint("127.0.0.1", 50000)
"""Source of the user's commands: a port that no other part of the simulation uses."""


class SimulationSource(SourceDefaults):
    """A ``Source`` over the datagrams of a simulation.

    Args:
        simulation: simulation that sends them.
        pieces: the datagrams of each batch, in order of time; empty ones are passed over.

    Attributes:
        info: description of the source.
        statistics: counts so far.
    """

    def __init__(self, simulation: Simulation, pieces: Iterable[Sequence[WireDatagram]]) -> None:
        self.info = SourceInfo(name=f"emulated {simulation.scenario}", kind="sim", time_resolution_ns=1)
        self.statistics = SourceStatistics()
        self._pieces = pieces
        self._demux = Demux()

    def close(self) -> None:
        """Close nothing: a simulation has no handle."""

    def batches(self) -> Iterator[PacketBatch]:
        """Yield a batch for each piece."""
        for sent in filter(None, self._pieces):
            frames = frames_of(sent, self.statistics.frames + 1)
            self.statistics.frames += len(frames)
            self.statistics.datagrams += len(frames)
            self.statistics.bytes += int(frames.length.sum())
            yield self._demux.demux(frames)


class SimulatedSource(SimulationSource):
    """A ``Source`` over a simulation in simulated time: one batch for every second of it.

    Args:
        simulation: simulation to run; its clock continues.
    """

    def __init__(self, simulation: Simulation, duration_ns: int) -> None:
        begin_ns, end_ns = simulation.now, simulation.now + duration_ns
        times = chain(range(begin_ns + SECOND, end_ns, SECOND), [end_ns])
        super().__init__(simulation, (list(simulation.run(until_ns)) for until_ns in times))


class SimulatedWire:
    """A ``Wire`` to an emulated cFS; its clock is the simulation's.

    Args:
        simulation: simulation without bridges, which the wire replaces.
        target: destination of the datagrams.
        own: address that receives answers.
        link: the link of the answers.

    Attributes:
        carried: all datagrams, if ``keeps_all``, including those between other parts.
    """

    def __init__(
        self, simulation: Simulation, target: Endpoint, own: Endpoint, link: Link, *, keeps_all: bool = False
    ) -> None:
        self.carried: list[WireDatagram] = []
        self._keeps_all = keeps_all
        self.statistics = SendStatistics()
        self._simulation, self._target, self._own, self._link = simulation, target, own, link
        self.ends = own, target
        self._arrived: list[Arrival] = []

    def now(self) -> int:
        """Return the simulation's time in ns."""
        return self._simulation.now

    def epoch_ns(self) -> int:
        """Return 0: the simulation's time is ns since 1970."""
        return 0

    def wait(self, until_ns: int) -> bool:
        """Run the simulation until a time."""
        for item in self._simulation.run(until_ns):
            if self._keeps_all:
                self.carried.append(item)
            if item.destination == self._own:
                self._arrived.append(Arrival(self._link, item.payload, item.source, item.destination))
        return True

    def put(self, payload: bytes) -> bool:
        """Deliver a datagram to the simulation now."""
        self._simulation.feed(self._simulation.now, self._target, payload)
        if self._keeps_all:
            self.carried.append(WireDatagram(self._simulation.now, self._own, self._target, payload))
        self.statistics.sent += 1
        return True

    def send(self, out: Outgoing, first: int, last: int) -> int:
        """Deliver datagrams ``first`` up to ``last``, not included, now."""
        return sum(self.put(out[index]) for index in range(first, last))

    def receive(self) -> list[Arrival]:
        """Return the arrived datagrams."""
        arrived, self._arrived = self._arrived, []
        return arrived


class RealTimeSource(SimulationSource):
    """A ``Source`` over a simulation in real time by the host's clock, without sockets.

    Args:
        simulation: simulation to run; its clock continues.
        clock: function that returns monotonic time, ns.
    """

    live = True

    def __init__(self, simulation: Simulation, clock: Callable[[], int]) -> None:
        super().__init__(simulation, self._run(simulation, clock))
        self._commands: deque[bytes] = deque()
        self._stop = Event()

    def command(self, data: bytes, _msg_id: int) -> str:
        """Send a command to Command Ingest, from any thread; it is never refused."""
        self._commands.append(data)
        return ""

    def stop(self) -> None:
        """End the batches; for any thread or signal handler."""
        self._stop.set()

    def _run(self, simulation: Simulation, clock: Callable[[], int]) -> Iterator[list[WireDatagram]]:
        """Run the simulation, and yield the datagrams since the last ones."""
        offset = simulation.now - clock()
        while not self._stop.wait(_TICK_S):
            commands = list(self._commanded(simulation))
            yield [*commands, *simulation.run(clock() + offset)]

    def _commanded(self, simulation: Simulation) -> Iterator[WireDatagram]:
        while self._commands:
            data = self._commands.popleft()
            simulation.deliver(simulation.cfs.ci_endpoint, data)
            yield WireDatagram(simulation.now, _COMMAND_SENDER, simulation.cfs.ci_endpoint, data)


def demo_bench(scenario: str, settings: Settings) -> Workbench:
    """Return the workbench of settings, with the missions of a demo if they name none.

    Raises:
        ConfigError: a mission has errors.
    """
    with as_file(files("edoras_tools.samples")) as samples:
        paths = [samples / f"missions/{name}.yaml" for name in MISSIONS.get(scenario, ())]
        return replace(settings, configs=settings.configs or paths).workbench()


def start_simulation(
    scenario: Scenario, settings: Settings, clock: Callable[[], int]
) -> tuple[RealTimeSource, Workbench]:
    """Boot an emulated cFS with its bridges and robots.

    Args:
        settings: missions and types; if no mission is named, the demo's own are used.
        clock: function that returns monotonic time, ns.

    Raises:
        ConfigError: a mission has errors.
    """
    simulation = Simulation(scenario=scenario, start_ns=time.time_ns() - BOOT_NS).boot()
    return RealTimeSource(simulation, clock), demo_bench(scenario, settings)
