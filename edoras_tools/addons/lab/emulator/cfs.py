"""An emulated cFS: one software bus, one event service, a clock and sockets, in simulated time.

It is not flight software. It emulates the mechanisms that decide which messages arrive, and when: wake-ups,
pipes, limits, two shared processors. ``docs/sim.md`` lists what is emulated and what is not.

Its messages (``SystemRoutes``) are those of a demo, or those in a mission file.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final, Literal

import msgspec
from msgspec.structs import replace

from edoras_tools.addons.lab.emulator.account import ArrivalAccount, socket
from edoras_tools.addons.lab.emulator.messages import JOINT_STATE, POSE, POSE_STAMPED, TWIST
from edoras_tools.addons.lab.emulator.services.applications import ExecutiveServices, LoadedApp, TableServices
from edoras_tools.addons.lab.emulator.services.clock import Clock
from edoras_tools.addons.lab.emulator.services.events import Event, EventServices
from edoras_tools.addons.lab.emulator.services.software_bus import Pipe, Publication, SoftwareBus
from edoras_tools.cfs.profile import FLIGHT_BRIDGE, TO_TABLE, SbnPeerConfig, SimProfile
from edoras_tools.cfs.queues import QueueEnd
from edoras_tools.errors import ConfigError
from edoras_tools.model import Endpoint, Peer
from edoras_tools.units import SECOND
from edoras_tools.wire import cfe
from edoras_tools.wire.envelope import DEFAULT, EnvelopeFormat

if TYPE_CHECKING:
    from edoras_tools.addons.lab.emulator.scheduler import Running, Scheduler, Task
    from edoras_tools.cfs.event_services import EventText
    from edoras_tools.mission import Bridge, Route
    from edoras_tools.pipelines.workbench import Workbench
    from edoras_tools.ros import TypeStore

Scenario = Literal["rover", "arm", "two-rovers", "two-arms"]


class SystemRoutes(msgspec.Struct, frozen=True):
    """MsgIds on the bus, with types and envelopes.

    Attributes:
        types: MsgId to ROS type.
        commands: MsgIds of commands from the ground; the first belongs to the application's own robot.
        telemetry: MsgIds of telemetry to the ground.
        states: MsgIds of the states of robots on SBN, in the order of ``telemetry``.
        flight: MsgIds of commands to robots on SBN, in the order of ``commands``.
        envelopes: MsgId to its envelope, if it is not the usual one.
        bridge: SBN identity of the flight bridge.
        store: types; None for those of the demos.
        state_bytes: size of the structs of states, bytes; 0 for as many as a state needs.
        command_bytes: size of the structs of commands to robots on SBN, likewise.
    """

    types: Mapping[int, str]
    commands: Sequence[int]
    telemetry: Sequence[int]
    states: Sequence[int] = ()
    flight: Sequence[int] = ()
    envelopes: Mapping[int, EnvelopeFormat] = msgspec.field(default_factory=dict)
    bridge: Peer = FLIGHT_BRIDGE
    store: TypeStore | None = None
    state_bytes: int = 0
    command_bytes: int = 0

    def envelope(self, msg_id: int) -> EnvelopeFormat:
        """Return the envelope of a MsgId."""
        return self.envelopes.get(msg_id, DEFAULT)


def _demo(command_type: str, state_type: str, state_bytes: int, command_bytes: int = 0) -> SystemRoutes:
    commands, telemetry, states, flight = [0x1827], [0x0827], list[int](), list[int]()
    if command_bytes:  # two robots, on SBN
        commands, telemetry = [0x1827, 0x1828], [0x0828, 0x0829]
        states, flight = [0x1829, 0x182A], [0x082A, 0x082B]
    types = dict.fromkeys([*commands, *flight], command_type) | dict.fromkeys(
        [*telemetry, *states], state_type
    )
    routes = SystemRoutes(types, commands, telemetry, states, flight)
    return replace(routes, state_bytes=state_bytes, command_bytes=command_bytes)


DEMO_ROUTES: Final[Mapping[Scenario, SystemRoutes]] = {
    "rover": _demo(TWIST, POSE_STAMPED, 100),
    "arm": _demo(POSE, JOINT_STATE, 260),
    "two-rovers": _demo(TWIST, POSE_STAMPED, 120, 80),
    "two-arms": _demo(POSE, JOINT_STATE, 300, 80),
}


def routes_of(bench: Workbench) -> SystemRoutes:
    """Return the messages of a mission: those of its first bridge of each kind.

    Raises:
        ConfigError: its ground bridge has no topic, or there is none.
    """
    mission, standard = bench.mission, bench.mission.msg_ids.standard
    groups = [
        routes_of_kind(mission.bridges, kind, to_cfs=to_cfs)
        for kind in ("ground", "flight")
        for to_cfs in (True, False)
    ]
    if not groups[0] and not groups[1]:
        raise ConfigError("the mission has no ground bridge with a topic: sim has nothing to emulate")
    routes = [item for group in groups for item in group]
    forms = dict(zip(mission.routes, bench.columns.context.envelopes, strict=True))
    ids = [[standard(item.msg_id) for item in group] for group in groups]
    return SystemRoutes(
        {standard(item.msg_id): item.type for item in routes},
        commands=ids[0],
        telemetry=ids[1],
        states=ids[2][: len(ids[1])],
        flight=ids[3][: len(ids[0])],
        envelopes={standard(item.msg_id): forms.get(item) or DEFAULT for item in routes},
        bridge=next((Peer(own.spacecraft_id, own.processor_id) for own in mission.flight), FLIGHT_BRIDGE),
        store=bench.types,
    )


def routes_of_kind(bridges: Sequence[Bridge], kind: str, *, to_cfs: bool) -> list[Route]:
    """Return the routes in one direction of the first bridge of a kind, ``ground`` or ``flight``."""
    bridge = next((item for item in bridges if item.link.kind == kind), None)
    return [item for item in bridge.routes if item.to_cfs == to_cfs] if bridge else []


def mission_profile(bench: Workbench) -> SimProfile:
    """Return the constants of a mission's cFS, with ports and SBN peers of the first bridge of each kind."""
    mission, profile = bench.mission, bench.mission.software.profile
    ports: dict[str, Any] = {}
    for ground in mission.ground[:1]:
        ports |= {"ci_port": ground.fsw_port, "to_port": ground.bridge_port}
    for flight in mission.flight[:1]:
        bridge = SbnPeerConfig(Peer(flight.spacecraft_id, flight.processor_id), flight.udp_receive_port)
        profile = replace(profile, sbn_peers=(bridge,))
        ports["sbn_port"] = flight.peer_port
    headers = bench.columns.context.headers
    return replace(
        profile,
        **{name: port for name, port in ports.items() if name not in profile.stated},
        headers=headers,
        time=bench.columns.context.time,
    )


def with_limit(profile: SimProfile, limit: int) -> SimProfile:
    """Return constants with ``limit`` for each MsgId at TO whose limit is the usual one and not stated."""
    usual = SimProfile().to_default_limit
    limits = {msg_id: limit if room == usual else room for msg_id, room in TO_TABLE.items()}
    limits |= {msg_id: room for msg_id, room in profile.to_limits.items() if msg_id in profile.stated}
    return replace(profile, to_default_limit=limit, to_limits=limits)


EMULATOR_VERSION: Final = "edoras-tools emulated cFS, not flight software"
_MANY: Final = 100
ANY_PORT: Final = 49152
"""Source port of telemetry in simulated time, where no operating system chooses a port."""


class Cfs:
    """One emulated instance.

    Attributes:
        profile: constants.
        scheduler: clock and tasks; several instances may share one.
        begin: function that starts all applications; called at each boot.
        boots: number of boots.
        bus: software bus.
        events: event services.
        executive: executive services, with the applications.
        clock: time services.
        routes: messages of its EDORAS application.
        account: arrivals at its pipes and sockets, with their ends.
        console: last lines, ``(time_ns, text)``, events as ``EVS Port1 66/1/APP ID: text``.
        listener: called with every line.
        muted: MsgIds of telemetry that its applications do not publish, because another source does.
    """

    def __init__(
        self,
        profile: SimProfile,
        scheduler: Scheduler,
        send: Callable[[Endpoint, Endpoint, bytes], None],
        *,
        with_account: bool = False,
    ) -> None:
        """Create it without applications: ``simulation.Apps`` starts them.

        Args:
            send: called with source, destination and payload of each datagram that leaves.
            with_account: whether to record the arrivals at pipes and sockets.
        """
        self.profile = profile
        self.scheduler = scheduler
        self.send = send
        self.boots = 0
        self.console: deque[tuple[int, str]] = deque(maxlen=10_000)
        self.listener: Callable[[int, str], None] | None = None
        self.muted: frozenset[int] = frozenset()
        self.begin: Callable[[], object] = lambda: None
        self._reporting: set[int] = set()
        self.routes = DEMO_ROUTES["rover"]
        self.ci_endpoint = Endpoint(profile.address, profile.ci_port)
        self.sbn_endpoint = Endpoint(profile.address, profile.sbn_port)
        self._to_sockets = -1
        self.to_endpoint = Endpoint(profile.address, profile.to_source_port or ANY_PORT)
        self._listening: dict[int, Callable[[bytes], object]] = {}
        self._tasks: list[Running] = []
        self.account = ArrivalAccount(lambda: scheduler.now, is_on=with_account)
        self._reset()

    def _reset(self) -> None:
        self.bus = SoftwareBus(self.profile, self.account)
        self.events = EventServices(self.profile)
        self.executive = ExecutiveServices(self)
        self.tables = TableServices(self.executive)
        self.clock = Clock(self.profile, self.scheduler.now)

    def boot(self) -> None:
        """Start all applications afresh, now; after ``halt``."""
        self.boots += 1
        self._reset()
        self.begin()

    def halt(self) -> None:
        """Stop everything, now: all waiting messages are lost, and no port is open."""
        for task in self._tasks:
            self.scheduler.end(task)
        for application in self.executive.applications.values():
            application.runs = False
        self._tasks.clear()
        self._listening.clear()
        self.account.close()

    def restart(self) -> None:
        """Restart the processor: halt, and boot again after ``boot_ns``."""
        self.halt()
        self.scheduler.call_at(self.scheduler.now + self.profile.boot_ns, self.boot)

    def clean_up(self, application: LoadedApp) -> None:
        """End the tasks of an application, and close its pipes and sockets with their contents."""
        for task in application.tasks:
            self.scheduler.end(task)
        for pipe in list(self.bus.pipes.values()):
            if pipe.name in application.pipes or pipe.ignores == application.name:
                self.bus.delete_pipe(pipe)
        for port in application.ports:
            self._listening.pop(port, None)
            self.account.close(socket(port))
        self.events.unregister(application.name)

    def open_telemetry_socket(self) -> None:
        """Choose the source port of telemetry: another one each time, unless the profile names it."""
        if not self.profile.to_source_port:
            self._to_sockets += 1
            self.to_endpoint = Endpoint(self.profile.address, ANY_PORT + self._to_sockets)

    def receive_datagram(self, destination: Endpoint, data: bytes) -> None:
        """Process a datagram now; it is dropped if no application listens on its port."""
        receive = self._listening.get(destination.port)
        if receive:
            receive(data)
        else:
            self.account.note(socket(destination.port), 0, QueueEnd.CLOSED)

    def is_listening(self, port: int) -> bool:
        """Return whether an application listens on a port."""
        return port in self._listening

    def listen(self, port: int, receive: Callable[[bytes], object]) -> None:
        """Pass the datagrams of a port to an application."""
        self._listening[port] = receive
        self.executive.owns(port=port)

    def mission_time(self) -> tuple[int, int]:
        """Return mission time as in telemetry headers: seconds, and subseconds of 1/65536 s."""
        seconds, rest = divmod(self.clock.time_ns(self.scheduler.now), SECOND)
        return seconds & 0xFFFFFFFF, (rest << 16) // SECOND

    def create_pipe(self, name: str, *msg_ids: int, limit: int | None = None) -> Pipe:
        """Create an application's pipe and subscribe it."""
        pipe = self.bus.create_pipe(name, self.profile.app_pipe_depth)
        self.executive.owns(pipe=name)
        for item in msg_ids:
            self.bus.subscribe(pipe, item, limit)
        return pipe

    def publish(self, packet: bytes, sender: str, *, stamp: bool = True) -> Publication:
        """Put a packet on the bus, wake the tasks that wait for it, and report the events of the bus."""
        publication = self.bus.publish(packet, sender, stamp=stamp)
        for pipe in publication.delivered:
            self.scheduler.notify(pipe)
        for event in publication.events:
            # As in cFE: the report of a bus error must not cause the same error again.
            if event.event_id not in self._reporting:
                self._reporting.add(event.event_id)
                self.report(event)
                self._reporting.discard(event.event_id)
        return publication

    def telemetry(self, msg_id: int, payload: bytes, sender: str) -> Publication:
        """Publish a telemetry packet with the present time."""
        if msg_id in self.muted:
            return Publication(payload)
        seconds, subseconds = self.mission_time()
        return self.publish(
            cfe.emit_telemetry(msg_id, payload, seconds=seconds, subseconds=subseconds), sender
        )

    def say(self, event: EventText, **values: object) -> None:
        """Report an event with its values."""
        self.report(Event.of(event, **values))

    def report(self, event: Event) -> None:
        """Report an event: unless it is filtered or squelched, it is printed and published."""
        for item in self.events.report(event, now=self.scheduler.now):
            self.print(f"EVS Port1 {self.profile.spacecraft_id}/{self.profile.processor_id}/{item}")
            self.telemetry(cfe.EVENT_MSG_ID, self.events.payload(item), item.app)

    def print(self, text: str) -> None:
        """Write a line to the console."""
        line = self.scheduler.now, text.rstrip()
        self.console.append(line)
        if self.listener:
            self.listener(*line)

    def spawn(self, steps: Task) -> None:
        """Start a task; it ends with its application."""
        task = self.scheduler.spawn(steps)
        if len(self._tasks) > _MANY:
            self._tasks = [item for item in self._tasks if not item.is_done]
        self._tasks.append(task)
        self.executive.owns(task=task)
