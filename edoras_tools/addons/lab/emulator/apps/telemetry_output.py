"""Telemetry Output (TO_LAB): which messages go to the ground, and to which address."""

from __future__ import annotations

from ipaddress import AddressValueError, IPv4Address
from typing import TYPE_CHECKING

import msgspec

from edoras_tools.addons.lab.emulator.messages import bus_id, to_link, whole_packet
from edoras_tools.addons.lab.emulator.scheduler import Sleep, Work
from edoras_tools.addons.lab.emulator.services.events import Event
from edoras_tools.cfs import software_bus
from edoras_tools.cfs import telemetry_output as facts
from edoras_tools.model import Endpoint
from edoras_tools.wire import cfe
from edoras_tools.wire.cfe import function_code_of, msg_id_of

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from edoras_tools.addons.lab.emulator.cfs import Cfs
    from edoras_tools.addons.lab.emulator.scheduler import Task
    from edoras_tools.addons.lab.emulator.services.software_bus import Pipe, SoftwareBus
    from edoras_tools.cfs.event_services import EventText
    from edoras_tools.cfs.profile import SimProfile


class Answer(msgspec.Struct, frozen=True):
    """The results of a command.

    Attributes:
        events: events of the software bus, then of TO.
        publish: MsgId and payload of a packet that the command requests, or None.
    """

    events: tuple[Event, ...] = ()
    publish: tuple[int, bytes] | None = None


class TelemetryOutput:
    """The table, the destination and the counters of Telemetry Output.

    Attributes:
        pipe: packets that wait for the next round.
        destination: IPv4 address that telemetry goes to; None before the first enable.
        commands: accepted commands.
        command_errors: refused commands.
    """

    def __init__(self, profile: SimProfile, bus: SoftwareBus) -> None:
        self.profile = profile
        self.bus = bus
        self.pipe: Pipe = bus.create_pipe(facts.PIPE, profile.to_pipe_depth)
        self.destination: str | None = None
        self.commands = 0
        self.command_errors = 0

    def subscribe(self, msg_ids: Iterable[int] = ()) -> None:
        """Subscribe to every MsgId of the table and to these, whose limit may be in the table too."""
        default = self.profile.to_default_limit
        for msg_id, limit in (dict.fromkeys(msg_ids, default) | dict(self.profile.to_limits)).items():
            self.bus.subscribe(self.pipe, msg_id, limit)

    def forward(self) -> tuple[bool, bytes | None]:
        """Remove one packet from the pipe.

        Returns:
            Whether there was one, and the datagram for the ground; None while output is not enabled.
        """
        packet = self.pipe.get()
        if packet is None:
            return False, None
        return True, whole_packet(packet) if self.destination else None

    def command(self, packet: bytes) -> Answer:
        """Process a command. Like the flight code, it trusts the payload's length."""
        function_code = function_code_of(packet)
        payload = packet[cfe.COMMAND_HEADER_BYTES :].ljust(16, b"\0")
        if function_code > facts.ENABLE:
            self.command_errors += 1
            return _says(facts.BAD_FUNCTION_CODE, line=344, code=function_code)
        self.commands += 1
        if function_code == facts.RESET:
            self.commands = self.command_errors = 0
            return Answer()
        if function_code == facts.ADD_PACKET:
            return self._add(payload)
        if function_code == facts.REMOVE_PACKET:
            return self._remove(self._msg_id(payload))
        if function_code == facts.REMOVE_ALL:
            for msg_id in list(self.pipe.limits):
                self.bus.unsubscribe(self.pipe, msg_id)
            return _says(facts.ALL_REMOVED, line=527)
        if function_code == facts.SEND_DATA_TYPES:
            return Answer(publish=(facts.DATA_TYPES_MSG_ID, bytes(64)))
        if function_code == facts.ENABLE:
            return self._enable(payload[:16].split(b"\0")[0].decode("ascii", "replace"))
        return _says(facts.NOTHING_DONE)

    def _enable(self, text: str) -> Answer:
        try:
            self.destination = str(IPv4Address(text))
        except AddressValueError:
            # An address that cannot be read becomes 0.0.0.0, which the host takes for itself.
            self.destination = self.profile.address
        return _says(facts.ENABLED, address=text)

    def _add(self, payload: bytes) -> Answer:
        msg_id, limit = self._msg_id(payload), payload[6] or self.profile.to_default_limit
        if not 0 < msg_id <= cfe.HIGHEST_MSG_ID:
            return _says(facts.NOT_ADDED, line=470, msg_id=msg_id, status=software_bus.BAD_ARGUMENT)
        exists = msg_id in self.pipe.limits
        self.bus.subscribe(self.pipe, msg_id, limit)
        priority, reliability = payload[4], payload[5]
        added = Event.of(
            facts.ADDED, line=473, msg_id=msg_id, priority=priority, reliability=reliability, limit=limit
        )
        return Answer(
            (self._bus_says(software_bus.DUPLICATE_SUBSCRIPTION, msg_id), added) if exists else (added,)
        )

    def _remove(self, msg_id: int) -> Answer:
        if not 0 < msg_id <= cfe.HIGHEST_MSG_ID:
            return _says(facts.NOT_REMOVED, line=494, msg_id=msg_id, status=software_bus.BAD_ARGUMENT)
        removed = Event.of(facts.REMOVED, line=497, msg_id=msg_id)
        if self.bus.unsubscribe(self.pipe, msg_id):
            return Answer((removed,))
        # cFE returns success, and TO relies on it.
        return Answer((self._bus_says(software_bus.NOTHING_TO_UNSUBSCRIBE, msg_id), removed))

    def _msg_id(self, payload: bytes) -> int:
        return bus_id(int.from_bytes(payload[:4], "little"), self.profile)

    def _bus_says(self, event: EventText, msg_id: int) -> Event:
        return Event.of(event, msg_id=msg_id, pipe=self.pipe.name, app=facts.NAME)

    def housekeeping(self) -> bytes:
        """Return the payload of housekeeping packet 0x880, 4 bytes."""
        return bytes([self.commands & 0xFF, self.command_errors & 0xFF, 0, 0])


def _says(event: EventText, **values: object) -> Answer:
    return Answer((Event.of(event, **values),))


def start_output(cfs: Cfs, telemetry: Sequence[int]) -> None:
    """Start Telemetry Output's task.

    Args:
        telemetry: MsgIds that go to the ground, besides those of the table.
    """
    output = TelemetryOutput(cfs.profile, cfs.bus)
    cfs.executive.owns(pipe=facts.PIPE)
    cfs.open_telemetry_socket()
    cfs.events.register(facts.NAME, now=cfs.scheduler.now)
    commands = cfs.create_pipe(facts.COMMAND_PIPE, facts.COMMAND_MSG_ID, facts.REQUEST_MSG_ID)
    output.subscribe(telemetry)
    cfs.say(facts.INITIALIZED, version="Emulated")
    cfs.spawn(_run(cfs, output, commands))


def _run(cfs: Cfs, output: TelemetryOutput, commands: Pipe) -> Task:
    """Wait for a time, send everything in the pipe, read the commands, and again."""
    profile = cfs.profile
    while cfs.executive.run_loop(facts.NAME):
        yield Sleep(profile.to_wake_ns)
        more, data = output.forward()
        while more:
            if data is not None and output.destination is not None:
                ground = Endpoint(output.destination, profile.to_port)
                cfs.send(cfs.to_endpoint, ground, to_link(data, profile))
            yield Work(profile.work_ns)
            more, data = output.forward()
        while (packet := commands.get()) is not None:
            _command(cfs, output, packet)
            yield Work(profile.work_ns)


def _command(cfs: Cfs, output: TelemetryOutput, packet: bytes) -> None:
    if msg_id_of(packet) == facts.REQUEST_MSG_ID:
        cfs.telemetry(facts.HOUSEKEEPING_MSG_ID, output.housekeeping(), facts.NAME)
        return
    answer = output.command(packet)
    for event in answer.events:
        cfs.report(event)
    if answer.publish:
        cfs.telemetry(*answer.publish, facts.NAME)
