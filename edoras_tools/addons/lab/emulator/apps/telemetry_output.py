"""Telemetry Output (TO_LAB): which messages go to the ground, and to which address."""

from __future__ import annotations

from ipaddress import AddressValueError, IPv4Address
from typing import TYPE_CHECKING

from edoras_tools.addons.lab.emulator.messages import bus_id, to_link, whole_packet
from edoras_tools.addons.lab.emulator.scheduler import Sleep, Work
from edoras_tools.cfs import software_bus
from edoras_tools.cfs import telemetry_output as facts
from edoras_tools.model import Endpoint
from edoras_tools.wire import cfe
from edoras_tools.wire.cfe import function_code_of, msg_id_of

if TYPE_CHECKING:
    from collections.abc import Iterable

    from edoras_tools.addons.lab.emulator.cfs import Cfs
    from edoras_tools.addons.lab.emulator.scheduler import Task
    from edoras_tools.cfs.event_services import EventText


class TelemetryOutput:
    """Telemetry Output on an emulated cFS.

    Args:
        cfs: the cFS that it runs on.
        telemetry: MsgIds that go to the ground besides those of the table, which may have their limits.

    Attributes:
        pipe: packets that wait for the next round.
        destination: IPv4 address that telemetry goes to; None before the first enable.
        commands: accepted commands.
        command_errors: refused commands.
    """

    def __init__(self, cfs: Cfs, telemetry: Iterable[int] = ()) -> None:
        profile = cfs.profile
        self.pipe = cfs.bus.create_pipe(facts.PIPE, profile.to_pipe_depth)
        self.destination: str | None = None
        self.commands = 0
        self.command_errors = 0
        self._cfs = cfs
        cfs.executive.owns(pipe=facts.PIPE)
        cfs.open_telemetry_socket()
        cfs.events.register(facts.NAME, now=cfs.scheduler.now)
        self._command_pipe = cfs.create_pipe(facts.COMMAND_PIPE, facts.COMMAND_MSG_ID, facts.REQUEST_MSG_ID)
        limits = dict.fromkeys(telemetry, profile.to_default_limit) | dict(profile.to_limits)
        for msg_id, limit in limits.items():
            cfs.bus.subscribe(self.pipe, msg_id, limit)
        cfs.say(facts.INITIALIZED, version="Emulated")
        cfs.spawn(self._run())

    def forward(self) -> bool:
        """Send one packet of the pipe to the ground, once output is enabled; return whether there was one."""
        packet = self.pipe.get()
        if packet is not None and self.destination is not None:
            cfs = self._cfs
            ground = Endpoint(self.destination, cfs.profile.to_port)
            cfs.send(cfs.to_endpoint, ground, to_link(whole_packet(packet), cfs.profile))
        return packet is not None

    def command(self, packet: bytes) -> None:
        """Process a command. Like the flight code, it trusts the payload's length."""
        cfs = self._cfs
        function_code = function_code_of(packet)
        payload = packet[cfe.COMMAND_HEADER_BYTES :].ljust(16, b"\0")
        if function_code > facts.ENABLE:
            self.command_errors += 1
            cfs.say(facts.BAD_FUNCTION_CODE, line=344, code=function_code)
            return
        self.commands += 1
        if function_code == facts.RESET:
            self.commands = self.command_errors = 0
        elif function_code == facts.ADD_PACKET:
            self._add(payload)
        elif function_code == facts.REMOVE_PACKET:
            self._remove(self._msg_id(payload))
        elif function_code == facts.REMOVE_ALL:
            for msg_id in list(self.pipe.limits):
                cfs.bus.unsubscribe(self.pipe, msg_id)
            cfs.say(facts.ALL_REMOVED, line=527)
        elif function_code == facts.SEND_DATA_TYPES:
            cfs.telemetry(facts.DATA_TYPES_MSG_ID, bytes(64), facts.NAME)
        elif function_code == facts.ENABLE:
            self._enable(payload[:16].split(b"\0")[0].decode("ascii", "replace"))
        else:
            cfs.say(facts.NOTHING_DONE)

    def housekeeping(self) -> bytes:
        """Return the payload of housekeeping packet 0x880, 4 bytes."""
        return bytes([self.commands & 0xFF, self.command_errors & 0xFF, 0, 0])

    def _run(self) -> Task:
        """Wait for a time, send everything in the pipe, read the commands, and again."""
        cfs, profile = self._cfs, self._cfs.profile
        while cfs.executive.run_loop(facts.NAME):
            yield Sleep(profile.to_wake_ns)
            while self.forward():
                yield Work(profile.work_ns)
            while (packet := self._command_pipe.get()) is not None:
                if msg_id_of(packet) == facts.REQUEST_MSG_ID:
                    cfs.telemetry(facts.HOUSEKEEPING_MSG_ID, self.housekeeping(), facts.NAME)
                else:
                    self.command(packet)
                yield Work(profile.work_ns)

    def _enable(self, text: str) -> None:
        try:
            self.destination = str(IPv4Address(text))
        except AddressValueError:
            # An address that cannot be read becomes 0.0.0.0, which the host takes for itself.
            self.destination = self._cfs.profile.address
        self._cfs.say(facts.ENABLED, address=text)

    def _add(self, payload: bytes) -> None:
        cfs = self._cfs
        msg_id, limit = self._msg_id(payload), payload[6] or cfs.profile.to_default_limit
        if not 0 < msg_id <= cfe.HIGHEST_MSG_ID:
            cfs.say(facts.NOT_ADDED, line=470, msg_id=msg_id, status=software_bus.BAD_ARGUMENT)
            return
        if msg_id in self.pipe.limits:
            self._bus_says(software_bus.DUPLICATE_SUBSCRIPTION, msg_id)
        cfs.bus.subscribe(self.pipe, msg_id, limit)
        priority, reliability = payload[4], payload[5]
        cfs.say(facts.ADDED, line=473, msg_id=msg_id, priority=priority, reliability=reliability, limit=limit)

    def _remove(self, msg_id: int) -> None:
        cfs = self._cfs
        if not 0 < msg_id <= cfe.HIGHEST_MSG_ID:
            cfs.say(facts.NOT_REMOVED, line=494, msg_id=msg_id, status=software_bus.BAD_ARGUMENT)
            return
        if not cfs.bus.unsubscribe(self.pipe, msg_id):
            # cFE returns success, and TO relies on it.
            self._bus_says(software_bus.NOTHING_TO_UNSUBSCRIBE, msg_id)
        cfs.say(facts.REMOVED, line=497, msg_id=msg_id)

    def _msg_id(self, payload: bytes) -> int:
        return bus_id(int.from_bytes(payload[:4], "little"), self._cfs.profile)

    def _bus_says(self, event: EventText, msg_id: int) -> None:
        self._cfs.say(event, msg_id=msg_id, pipe=self.pipe.name, app=facts.NAME)
