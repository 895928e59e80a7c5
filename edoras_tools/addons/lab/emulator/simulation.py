"""A demo in simulated time: the emulated cFS and, on request, the bridges, the operator and the robots."""

from __future__ import annotations

from collections import deque
from functools import partial
from typing import TYPE_CHECKING, Final, NamedTuple

from edoras_tools.addons.lab.emulator.apps import core, generator
from edoras_tools.addons.lab.emulator.apps.generator import Generator
from edoras_tools.addons.lab.emulator.apps.ground_apps import CommandIngest, TelemetryOutput
from edoras_tools.addons.lab.emulator.apps.sbn_node import SbnApp
from edoras_tools.addons.lab.emulator.bridges import FlightBridge, GroundBridge, robot_of
from edoras_tools.addons.lab.emulator.cfs import DEMO_ROUTES, Cfs, Scenario, SystemRoutes
from edoras_tools.addons.lab.emulator.scheduler import Scheduler
from edoras_tools.cfs import command_ingest, edoras_app, sbn, telemetry_output
from edoras_tools.cfs.profile import SimProfile
from edoras_tools.errors import ConfigError
from edoras_tools.model import Endpoint
from edoras_tools.units import MICROSECOND, SECOND

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from typing_extensions import Self


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
        self.apps = Apps(self.cfs, _application(routes, self.scenario, start_ns))
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


_STRUCT_BYTES: Final[Mapping[str, tuple[int, ...]]] = {
    "rover": (100,),
    "arm": (260,),
    "two-rovers": (120, 80),
    "two-arms": (300, 80),
}
"""Sizes of the structs of the demos' applications, bytes: those of states, and of commands to the robots."""


def _application(routes: SystemRoutes, scenario: str, now: int) -> core.EdorasApp:
    sizes = _STRUCT_BYTES.get(scenario, ())
    if routes.flight:
        return core.TwoRobotApp(routes, *sizes)
    command, state = (
        routes.types[items[0]] if items else "" for items in (routes.commands, routes.telemetry)
    )
    return core.SingleRobotApp(robot_of(command, state, routes.store, now=now), routes, *sizes)
