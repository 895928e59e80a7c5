"""An emulated cFS: one software bus, one event service, a clock and sockets, in simulated time.

It is not flight software. It emulates what decides which messages arrive, and when: wake-ups, pipes,
limits, two shared processors. ``docs/sim.md`` lists what is emulated and what is not.
"""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Final

from edoras_tools.emulator.services.events import Event, EventServices
from edoras_tools.emulator.services.software_bus import Pipe, Publication, SoftwareBus
from edoras_tools.model import Endpoint
from edoras_tools.units import SECOND
from edoras_tools.wire import cfe

if TYPE_CHECKING:
    from collections.abc import Callable

    from edoras_tools.cfs.event_services import EventText
    from edoras_tools.cfs.profile import SimProfile
    from edoras_tools.emulator.scheduler import Scheduler, Task

EMULATOR_VERSION: Final = "edoras-tools emulated cFS, not flight software"
ANY_PORT: Final = 49152
"""Source port of telemetry in simulated time, where no operating system chooses one."""


class Cfs:
    """One emulated instance.

    Attributes:
        profile: its constants.
        scheduler: its clock and its tasks; several instances may share one.
        bus: its software bus.
        events: its event services.
        console: its last lines, ``(time_ns, text)``, events as ``EVS Port1 66/1/APP ID: text``.
        listener: called with every line.
    """

    def __init__(
        self,
        profile: SimProfile,
        scheduler: Scheduler,
        send: Callable[[Endpoint, Endpoint, bytes], None],
    ) -> None:
        """Start, now, without any application: :func:`edoras_tools.emulator.boot.boot` starts those.

        Args:
            profile: its constants.
            scheduler: its clock and its tasks.
            send: called with source, destination and payload of each datagram that leaves.
        """
        self.profile = profile
        self.scheduler = scheduler
        self.send = send
        self.bus = SoftwareBus(profile)
        self.events = EventServices(profile)
        self.console: deque[tuple[int, str]] = deque(maxlen=10_000)
        self.listener: Callable[[int, str], None] | None = None
        self._boot_ns = scheduler.now
        self._reporting: set[int] = set()
        self.ci_endpoint = Endpoint(profile.address, profile.ci_port)
        self.sbn_endpoint = Endpoint(profile.address, profile.sbn_port)
        self.to_endpoint = Endpoint(profile.address, profile.to_source_port or ANY_PORT)
        self._listening: dict[int, Callable[[bytes], object]] = {}

    @property
    def endpoints(self) -> tuple[Endpoint, ...]:
        """The sockets: Command Ingest, SBN, and the one that telemetry leaves by."""
        return self.ci_endpoint, self.sbn_endpoint, self.to_endpoint

    def receive_datagram(self, destination: Endpoint, data: bytes) -> None:
        """Take a datagram, now; it is dropped where nothing listens on its port."""
        receive = self._listening.get(destination.port)
        if receive:
            receive(data)

    def listen(self, port: int, receive: Callable[[bytes], object]) -> None:
        """Have the datagrams of a port handed to an application."""
        self._listening[port] = receive

    def mission_time(self) -> tuple[int, int]:
        """Return mission time as telemetry headers hold it: seconds, and subseconds of 1/65536 s."""
        elapsed = self.scheduler.now - self._boot_ns
        seconds, rest = divmod(elapsed, SECOND)
        return self.profile.epoch_offset_s + self.profile.boot_met_s + seconds, (rest << 16) // SECOND

    def met_ns(self) -> int:
        """Return mission elapsed time in ns."""
        return self.profile.boot_met_s * SECOND + self.scheduler.now - self._boot_ns

    def create_pipe(self, name: str, *msg_ids: int, limit: int | None = None) -> Pipe:
        """Make an application's pipe and subscribe it."""
        pipe = self.bus.create_pipe(name, self.profile.app_pipe_depth)
        for item in msg_ids:
            self.bus.subscribe(pipe, item, limit)
        return pipe

    def publish(self, packet: bytes, sender: str, *, stamp: bool = True) -> Publication:
        """Put a packet on the bus, wake the tasks that wait for it, report the events of the bus."""
        publication = self.bus.publish(packet, sender, stamp=stamp)
        for pipe in publication.delivered:
            self.scheduler.notify(pipe)
        for event in publication.events:
            # As in cFE: reporting a bus error must not report the same error again.
            if event.event_id not in self._reporting:
                self._reporting.add(event.event_id)
                self.report(event)
                self._reporting.discard(event.event_id)
        return publication

    def telemetry(self, msg_id: int, payload: bytes, sender: str) -> Publication:
        """Publish a telemetry packet with the time now."""
        seconds, subseconds = self.mission_time()
        return self.publish(
            cfe.emit_telemetry(msg_id, payload, seconds=seconds, subseconds=subseconds), sender
        )

    def say(self, event: EventText, **values: object) -> None:
        """Report an event with its values."""
        self.report(Event.of(event, **values))

    def report(self, event: Event) -> None:
        """Report an event: it may be filtered or squelched, else it is printed and published."""
        for item in self.events.report(event, now=self.scheduler.now):
            self.print(f"EVS Port1 {self.profile.spacecraft_id}/{self.profile.processor_id}/{item}")
            self.telemetry(cfe.EVENT_MSG_ID, self.events.payload(item), item.app)

    def print(self, text: str) -> None:
        """Write a line on the console."""
        line = self.scheduler.now, text.rstrip()
        self.console.append(line)
        if self.listener:
            self.listener(*line)

    def spawn(self, steps: Task) -> None:
        """Start a task."""
        self.scheduler.spawn(steps)
