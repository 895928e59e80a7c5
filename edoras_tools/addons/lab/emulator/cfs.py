"""An emulated cFS: one software bus, one event service, a clock and sockets, in simulated time.

It is not flight software. It emulates the mechanisms that decide which messages arrive, and when: wake-ups,
pipes, limits, two shared processors. ``docs/sim.md`` lists what is emulated and what is not.
"""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Final

from edoras_tools.addons.lab.emulator.account import ArrivalAccount, socket
from edoras_tools.addons.lab.emulator.routes import DEMO_ROUTES
from edoras_tools.addons.lab.emulator.services.applications import (
    ExecutiveServices,
    LoadedApp,
    TableServices,
)
from edoras_tools.addons.lab.emulator.services.clock import Clock
from edoras_tools.addons.lab.emulator.services.events import Event, EventServices
from edoras_tools.addons.lab.emulator.services.software_bus import Pipe, Publication, SoftwareBus
from edoras_tools.cfs.queues import QueueEnd
from edoras_tools.model import Endpoint
from edoras_tools.units import SECOND
from edoras_tools.wire import cfe

if TYPE_CHECKING:
    from collections.abc import Callable

    from edoras_tools.addons.lab.emulator.scheduler import Running, Scheduler, Task
    from edoras_tools.cfs.event_services import EventText
    from edoras_tools.cfs.profile import SimProfile

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
